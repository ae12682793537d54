import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.floquet import first_order_matrix, floquet, leading_multipliers
from tests.known import grid

PERIOD = 1.7


def damped_known(points: int) -> np.ndarray:
    """Return A(t) = [0 1; −10 cos t, −24 − 10 sin t] over 2π, whose exponents are exactly 0 and −24."""
    t = 2 * np.pi * grid(points)
    matrix = np.zeros((points, 2, 2))
    matrix[:, 0, 1] = 1.0
    matrix[:, 1, 0], matrix[:, 1, 1] = -10 * np.cos(t), -24 - 10 * np.sin(t)
    return matrix


def manufactured(points: int, exponents: np.ndarray, amount: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Return P(t) of period PERIOD, (points, size, size), and A(t) for which y = P(t) exp(B t) solves ẏ = A y.

    B (size, size), `exponents`, is given over the whole period.
    """
    size, angle = len(exponents), 2 * np.pi * grid(points)[:, None, None]
    c = amount * np.random.default_rng(4).standard_normal((4, size, size)) / np.sqrt(size)
    p = np.eye(size) + c[0] * np.cos(angle) + c[1] * np.sin(angle) + c[2] * np.cos(2 * angle) + c[3] * np.sin(2 * angle)
    rate = -c[0] * np.sin(angle) + c[1] * np.cos(angle) - 2 * c[2] * np.sin(2 * angle) + 2 * c[3] * np.cos(2 * angle)
    return p, (2 * np.pi * rate + p @ exponents) @ np.linalg.inv(p) / PERIOD


def wide_range() -> tuple[np.ndarray, np.ndarray]:
    """Return B and its eigenvalues: 40, a complex pair, −1, −40."""
    b = np.diag([40.0, 0.3, 0.3, -1.0, -40.0])
    b[1, 2], b[2, 1] = -2.0, 2.0
    return b, np.array([40.0, 0.3 + 2j, 0.3 - 2j, -1.0, -40.0])


def sine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest sine of the angle between two fields of vectors (points, size)."""
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    return float(np.linalg.norm(b - a * np.sum(a.conj() * b, axis=1, keepdims=True), axis=1).max())


@pytest.mark.parametrize("points", [800, 801])
def test_exponents_are_accurate_where_products_of_transfer_matrices_lose_all_digits(points):
    found = floquet(damped_known(points), 2 * np.pi)
    assert found.exponents / (2 * np.pi) == pytest.approx([0.0, -24.0], abs=1e-6)


@pytest.mark.parametrize("points", [400, 401])
def test_exponents_from_40_to_minus_40_with_a_complex_pair(points):
    b, exact = wide_range()
    found = floquet(manufactured(points, b)[1], PERIOD)
    assert found.exponents == pytest.approx(exact, abs=1e-8)


def test_multipliers_have_the_right_sign():
    """A frame that makes half a turn a period: A is periodic, and both multipliers are negative."""
    points = 200
    half = np.pi * grid(points)
    turn = np.array([[np.cos(half), -np.sin(half)], [np.sin(half), np.cos(half)]]).transpose(2, 0, 1)
    matrix = turn @ np.diag([1.0, -2.0]) @ turn.transpose(0, 2, 1) / PERIOD
    matrix += np.pi / PERIOD * np.array([[0.0, -1.0], [1.0, 0.0]])
    found = floquet(matrix, PERIOD)
    assert np.exp(found.exponents) == pytest.approx([-np.e, -np.exp(-2.0)], rel=1e-9)


@pytest.mark.parametrize("points", [200, 201])
def test_multipliers_of_equal_modulus_and_opposite_sign(points):
    """A frame of two axes that makes half a turn a period beside a third axis, all mixed by a periodic matrix."""
    half, zero, one = np.pi * grid(points), np.zeros(points), np.ones(points)
    turn = np.array([[np.cos(half), -np.sin(half), zero], [np.sin(half), np.cos(half), zero], [zero, zero, one]])
    turn = turn.transpose(2, 0, 1)
    rate = np.zeros((3, 3))
    rate[0, 1], rate[1, 0] = -np.pi, np.pi
    inner = turn @ np.diag([0.8, -2.0, 0.8]) @ turn.transpose(0, 2, 1) + rate
    p, still = manufactured(points, np.zeros((3, 3)))
    found = floquet(still + p @ inner @ np.linalg.inv(p) / PERIOD, PERIOD)
    expected = [-np.exp(0.8), np.exp(0.8), -np.exp(-2.0)]
    assert np.sort(np.exp(found.exponents).real) == pytest.approx(np.sort(expected), rel=1e-8)
    assert np.exp(found.exponents).imag == pytest.approx(np.zeros(3), abs=1e-9)


@pytest.mark.parametrize("points", [400, 401])
def test_eigenfunctions_agree_with_the_manufactured_system(points):
    """They are v = P(t) c and w = P(t)⁻ᵀ d with B c = λ c, Bᵀ d = λ d, each up to a factor."""
    b, exact = wide_range()
    p, matrix = manufactured(points, b)
    v, w = floquet(matrix, PERIOD).leading(matrix.shape[1])
    assert np.linalg.norm(v, axis=2) == pytest.approx(np.ones((5, points)))
    assert np.linalg.norm(w, axis=2) == pytest.approx(np.ones((5, points)))
    values, vectors = np.linalg.eig(b)
    adjoint = np.linalg.inv(vectors)
    for k, value in enumerate(exact):
        j = int(np.argmin(abs(values - value)))
        assert sine(p @ vectors[:, j], v[k]) < 1e-8
        assert sine(np.linalg.inv(p).transpose(0, 2, 1) @ adjoint[j], w[k]) < 1e-8


@pytest.mark.parametrize("exponents", [(5.5, 2.0, -5.5), (0.0, -3.0, -11.0), (1.2, 1.1, 0.9), (25.0, 24.0, -30.0)])
def test_left_and_right_eigenfunctions_are_biorthogonal_at_every_point(exponents):
    found = floquet(manufactured(400, np.diag(exponents))[1], PERIOD)
    v, w = found.leading(len(found.exponents))
    overlap = np.abs(np.einsum("anp,bnp->abn", w, v)).max(axis=2)
    assert found.exponents == pytest.approx(np.array(exponents), abs=1e-8)
    assert overlap - np.diag(np.diag(overlap)) == pytest.approx(np.zeros((3, 3)), abs=1e-9)
    assert np.abs(np.einsum("anp,anp->an", w, v)).min() > 0.1


def test_sum_of_the_exponents_is_the_integral_of_the_trace():
    """Liouville, for a matrix of which nothing else is known."""
    angle = 2 * np.pi * grid(600)[:, None, None]
    c = np.random.default_rng(5).standard_normal((3, 6, 6))
    matrix = c[0] + c[1] * np.cos(angle) + c[2] * np.sin(3 * angle)
    found = floquet(matrix, PERIOD)
    assert np.sum(found.exponents).real == pytest.approx(PERIOD * np.trace(c[0]), abs=1e-8)
    assert np.exp(np.sum(found.exponents)).imag == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("shift", [0, 1])
def test_exponents_converge_at_sixth_order(shift):
    b, exact = wide_range()
    errors = []
    for points in (100, 200, 400):
        found = floquet(manufactured(points + shift, b)[1], PERIOD)
        errors.append(abs(found.exponents[0] - exact[0]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:]) / np.log2(2 * (1 + shift / 200) / (1 + shift / 100))
    assert orders == pytest.approx(6.0, abs=0.1)


def test_constant_matrices_have_their_eigenvalues():
    """Complex pairs, ± pairs, which share no modulus but cancel in the trace, and a pair with equal moduli."""
    rng = np.random.default_rng(6)
    pair = np.array([[-0.2, -1.1], [1.1, -0.2]])
    signs = np.diag([0.7, -0.7, 0.7])
    signs[0, 2] = 0.3
    for matrix in (*rng.standard_normal((4, 5, 5)), pair, np.array([[0.0, 1.0], [-4.0, 0.0]])):
        exact = np.linalg.eigvals(matrix) * PERIOD
        exact.imag = np.angle(np.exp(1j * exact.imag))
        found = floquet(np.tile(matrix, (65, 1, 1)), PERIOD).exponents
        assert np.sort_complex(np.round(found, 9)) == pytest.approx(np.sort_complex(np.round(exact, 9)), abs=2e-9)
    assert np.exp(floquet(np.tile(signs, (65, 1, 1)), PERIOD).exponents) == pytest.approx(
        np.exp(PERIOD * np.array([0.7, 0.7, -0.7])), rel=1e-6
    )


@pytest.mark.parametrize("exponent", [600.0, -600.0, -1000.0])
def test_exponents_beyond_the_range_of_floating_point_numbers(exponent):
    """ẏ = a(t) y: the multiplier itself over- or underflows."""
    a = exponent * (1 + 0.5 * np.cos(2 * np.pi * grid(2000))) / PERIOD
    assert floquet(a[:, None, None], PERIOD).exponents == pytest.approx([exponent], rel=1e-5)


def test_solution_with_strong_friction_is_stable():
    """Dahl friction, ẇ = rho (v − |v| w), forgets by exp(−rho · 4 amplitude) a period, here e^−960."""
    displacement = 0.03 * np.sin(2 * np.pi * grid(800))
    theta = {"Kx": 100.0, "K": 1000.0, "F0": 0.0, "Kw": 50.0, "rho": 8000.0}
    solution = bp.solve_periodic(bp.models.dahl, theta, {"displacement": displacement}, frequency=1.0)
    assert solution.exponents.real == pytest.approx([-960.0], rel=1e-3)
    assert solution.stable


def test_first_order_matrix_of_mixed_orders_is_the_hand_written_one():
    """For m ẍ + b Ṫ + c ẋ + k x = 0 and r Ṫ + s ẍ + h T + e ẋ = 0: x of second, T of first order."""
    m, b, c, k, r, s, h, e = 2.0, 0.5, 0.3, 7.0, 1.5, 0.4, 0.8, 0.6
    linearisation = np.array([[[k, 0.0, c, b, m, 0.0], [0.0, h, e, r, s, 0.0]]])
    highest = np.array([[m, b], [s, r]])
    x_row, t_row = -np.linalg.solve(highest, [[k, 0.0, c], [0.0, h, e]])
    expected = np.array([[[0.0, 0.0, 1.0], t_row, x_row]])
    assert first_order_matrix(linearisation, (2, 1)) == pytest.approx(expected)


def test_first_order_matrix_of_two_second_order_states():
    m1, m2, k, c = 2.0, 3.0, 5.0, 0.7
    linearisation = np.array([[[2 * k, -k, c, 0.0, m1, 0.0], [-k, k, 0.0, 2 * c, 0.0, m2]]])
    expected = [
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [-2 * k / m1, k / m1, -c / m1, 0.0],
        [k / m2, -k / m2, 0.0, -2 * c / m2],
    ]
    assert first_order_matrix(linearisation, (2, 2)) == pytest.approx(np.array([expected]))


def test_equations_that_do_not_determine_the_highest_derivatives_are_refused():
    linearisation = np.array([[[1.0, 0.0, 1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 2.0, 2.0, 0.0, 0.0]]])
    with pytest.raises(np.linalg.LinAlgError):
        first_order_matrix(linearisation, (1, 1))


@pytest.mark.parametrize("points", [200, 201])
@pytest.mark.parametrize(("rate", "tolerance"), [(2e3, 5e-3), (1e4, 0.02)])
def test_exponent_of_a_stiff_equation_is_its_rate(points, rate, tolerance):
    """For ẇ = −rate (w − u) with up to fifty time constants a step of the grid."""
    matrix = np.full((points, 1, 1), -rate)
    exponent = floquet(matrix, 1.0).exponents[0]
    assert exponent.real == pytest.approx(-rate, rel=tolerance) and exponent.imag == 0.0


def test_multipliers_of_overly_stiff_equations_are_stable_and_positive():
    """Beyond the resolution of the integration; a false −1 would indicate a period doubling."""
    for points in (200, 201):
        multiplier = np.exp(floquet(np.full((points, 1, 1), -1e8), 1.0).exponents[0])
        assert 0.0 <= multiplier.real < 1.0 and multiplier.imag == 0.0


def test_leading_multipliers_are_exact_or_not_returned():
    """Constant matrices, their multipliers known: of either sign, pairs, nearly equal ones; a pair too far from 1."""
    tau = np.arange(100) / 100
    real = np.array([[1.0, 3.0], [0.5, -2.0]])
    largest = np.exp(3.0 * np.linalg.eigvals(real).max())
    for matrix in (real, 10.0 * real):
        found = leading_multipliers(np.tile(matrix, (100, 1, 1)), 3.0 / matrix[0, 0], 1)
        assert found == pytest.approx([largest], rel=1e-9)
    # Seen from axes that turn by half a turn in the period the multipliers change their signs.
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    axes = [np.cos(np.pi * t) * np.eye(2) + np.sin(np.pi * t) * turn for t in tau]
    seen = np.array([a @ real @ a.T + np.pi / 3.0 * turn for a in axes])
    assert leading_multipliers(seen, 3.0, 1) == pytest.approx([-largest], rel=1e-6)
    pair = leading_multipliers(np.tile(turn, (100, 1, 1)), 1.0, 2)
    assert sorted(pair, key=np.imag) == pytest.approx([np.exp(-1j), np.exp(1j)], rel=1e-9)
    near = np.tile(np.diag([-0.2, 0.1, 0.099]), (100, 1, 1))
    for count in (1, 2):
        assert leading_multipliers(near, 1.0, count) == pytest.approx(np.exp([0.1, 0.099])[:count], rel=1e-9)
    far = np.zeros((3, 3))
    far[:2, :2], far[2, 2] = 5.0 * turn, -40.0
    for count in (1, 3):
        assert leading_multipliers(np.tile(far, (100, 1, 1)), 1.0, count) is None
