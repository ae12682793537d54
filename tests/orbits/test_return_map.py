import numpy as np

from bayesperiodic.orbits.cycles import eigenvalues, has_shorter_period, newton_step, shift_between
from bayesperiodic.orbits.return_map import ReturnMap

OPEN = np.array([np.inf, np.inf])


def quadratic(points):
    x, y = points[:, 0], points[:, 1]
    return np.stack([0.3 + 1.4 * x - 0.5 * y + 0.7 * x**2 + 0.2 * x * y, 0.1 - 0.8 * x + 0.9 * y**2], axis=1)


def slopes(x, y):
    return np.array([[1.4 + 1.4 * x + 0.2 * y, -0.5 + 0.2 * x], [-0.8, 1.8 * y]])


def maps(count, noise, seed, width=None):
    generator = np.random.default_rng(seed)
    clean = generator.uniform(-1.0, 1.0, (count, 2))
    if width is not None:
        clean[:, 0] = width * generator.standard_normal(count)
    arguments = clean + noise * generator.standard_normal(clean.shape)
    images = quadratic(clean) + noise * generator.standard_normal(clean.shape)
    return ReturnMap(arguments, images - arguments, OPEN, True, np.full(2, noise))


def test_a_quadratic_map_is_recovered_exactly():
    fit = maps(500, 0.0, 1).fit(np.array([[0.2, -0.1]]), 80, 2)
    np.testing.assert_allclose(fit.value[0], quadratic(np.array([[0.2, -0.1]]))[0], atol=1e-12)
    np.testing.assert_allclose(fit.jacobian[0], slopes(0.2, -0.1), atol=1e-11)
    np.testing.assert_allclose(fit.hessian[0], [[[1.4, 0.2], [0.2, 0.0]], [[0.0, 0.0], [0.0, 1.8]]], atol=1e-9)


def test_noise_in_the_arguments_does_not_attenuate_slopes():
    # Points in a strip, like the leaves of an attractor; the strip's sd is 2.5 of the noise's, which takes 14 % from
    # ordinary slopes across it. False alarms: below 1e-3 for the four slopes (four standard errors).
    centre, errors, plain = np.array([[0.0, 0.2]]), [], []
    for seed in range(150):
        noisy = maps(2000, 0.02, seed, width=0.05)
        errors.append(noisy.fit(centre, 300, 2, influence=False).jacobian[0] - slopes(0.0, 0.2))
        noisy.noise = np.zeros(2)
        plain.append(noisy.fit(centre, 300, 2, influence=False).jacobian[0] - slopes(0.0, 0.2))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4.0 * np.std(errors, axis=0) / np.sqrt(150))
    assert np.mean(plain, axis=0)[0, 0] < -0.1


def test_influences_give_the_standard_deviation():
    # The mean stated variance is that of 300 replicates within 25 %, three standard errors of a variance.
    centre = np.array([[0.1, 0.2]])
    fits = [maps(1500, 0.02, seed).fit(centre, 150, 2) for seed in range(300)]
    actual = np.var([np.concatenate([fit.value, fit.derivatives[0, 1:3]]) for fit in fits], axis=0)
    stated = np.mean([(fit.influence[0, :, :3] ** 2).sum(axis=0) for fit in fits], axis=0)
    np.testing.assert_allclose(stated, actual, rtol=0.25)


def test_angles_wrap():
    generator = np.random.default_rng(3)
    angle = generator.uniform(0.0, 1.0, 800)
    other = generator.uniform(-1.0, 1.0, 800)
    image = np.stack([2.2 * angle + 0.3 * other, -0.4 * other], axis=1)
    arguments = np.stack([angle, other], axis=1)
    folded = np.stack([(angle + 0.37) % 1.0 - 0.37, other], axis=1)
    run = image - arguments
    turn = np.array([1.0, np.inf])
    known = ReturnMap(folded, run, turn, True, np.zeros(2)).fit(np.array([[0.5, 0.0]]), 60, 1)
    np.testing.assert_allclose(known.value[0] - [0.5, 0.0], [0.6, 0.0], atol=1e-12)
    modulo = run.copy()
    modulo[:, 0] -= np.round(modulo[:, 0])
    alone = ReturnMap(folded, modulo, turn, False, np.zeros(2)).fit(np.array([[0.5, 0.0]]), 60, 1)
    np.testing.assert_allclose(alone.jacobian, known.jacobian, atol=1e-12)
    np.testing.assert_allclose((alone.value - known.value) % 1.0 % 1.0, [[0.0, 0.0]], atol=1e-12)


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
