import numpy as np

from bayesperiodic.orbits.cycles import eigenvalues, has_shorter_period, newton_step, shift_between


def test_newton_closes_a_linear_chain_in_one_step():
    generator = np.random.default_rng(0)
    jacobian = generator.standard_normal((1, 3, 2, 2))
    points = generator.standard_normal((3, 2))
    offsets = np.roll(points, -1, axis=0) - np.einsum("pij,pj->pi", jacobian[0], points)
    guess = points + 0.3
    defect = np.einsum("pij,pj->pi", jacobian[0], guess) + offsets - np.roll(guess, -1, axis=0)
    np.testing.assert_allclose(guess + newton_step(defect[None], jacobian)[0], points, atol=1e-12)


def test_small_eigenvalues_keep_their_digits():
    chain = np.array([[[3e4, 1.0], [0.0, 1e-7]], [[2.0, 0.5], [0.0, 3e-5]]])
    np.testing.assert_allclose(eigenvalues(chain), [6e4, 3e-12], rtol=1e-12)


def test_shifts_and_divisors_of_a_cycle():
    cycle = np.array([[0.0, 1.0], [0.3, -1.0], [0.7, 0.2]])
    assert shift_between(np.roll(cycle, -2, axis=0), cycle, lambda d: d) == (0.0, 2)
    assert has_shorter_period(np.tile(cycle, (2, 1)), lambda d: d, 1e-9)
    assert not has_shorter_period(cycle, lambda d: d, 1e-9)
