"""Factors of ∂g/∂z and of bordered systems, and the loading of the compiled functions."""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic import compiled
from bayesperiodic.periodic.equations import PeriodicEquations, empty_factors, null_vector
from bayesperiodic.periodic.schemes import CyclicGrid, find_scheme
from tests.known import grid

SCHEMES = ["backward2", "central2", "central4", "fourier"]
# Kernels of two states and these schemes take half a minute to compile, for few tests.
SLOW_TWO = pytest.param(2, marks=pytest.mark.slow)
SLOW_SCHEMES = [pytest.param(scheme, marks=pytest.mark.slow) for scheme in ("backward2", "central2")]
# Schemes with gaps between the offsets and without offsets before the point.
GAPS = bp.Scheme("gaps", 2, first={-3: -1 / 6, 3: 1 / 6}, second={-3: 1 / 9, 0: -2 / 9, 3: 1 / 9})
FORWARD = bp.Scheme("forward", 1, first={0: -1.0, 1: 1.0}, second={0: 1.0, 1: -2.0, 2: 1.0})
ORIGINAL = compiled._kernels
CALLED = """from numba import njit


@njit("float64(float64)", cache=CACHE)
def shifted(x):
    return x + {added} + SIZES[0]
"""
CALLING = """from numba import njit


@njit("float64(float64)", cache=CACHE)
def twice(x):
    return 2.0 * shifted(x)
"""


def linear():
    """Return the compiled linear algebra of one state."""
    return compiled.kernels("linear", 1, (2, 3, 2))


def growing(states: int) -> bp.Model:
    """Return ẇ = λ w + u with other states that decay or turn: multipliers e^λ, e^−3, e^±i√2, e^−2."""
    names = ["w", "x", "y", "z"][:states]
    rows = {
        "w": lambda s, p, u: s.dw - p.rate * s.w - u.u,
        "x": lambda s, p, u: s.dx + 3 * s.x - s.w / 10 - u.u,
        "y": lambda s, p, u: s.ddy + 2 * s.y + s.dx / 50 - u.u,
        "z": lambda s, p, u: s.dz + 2 * s.z - s.y / 20 - u.u,
    }
    return bp.Model(
        f"growing{states}",
        states=names,
        inputs=["u"],
        parameters=["rate"],
        equations=lambda s, p, u: [rows[name](s, p, u) for name in names],
        outputs=lambda s, p, u: {"out": s.w},
    )


def equations_of(model: bp.Model, scheme: str, samples: int) -> PeriodicEquations:
    wave = np.cos(2 * np.pi * grid(samples))
    return PeriodicEquations.build(model, {"u": wave}, frequency=1.0, samples=samples, scheme=scheme)


def dense(equations: PeriodicEquations, columns: np.ndarray) -> np.ndarray:
    """Return ∂g/∂z as a dense matrix, assembled from circulant differentiation matrices."""
    samples, count = equations.grid.points, equations.count
    first, second = np.zeros((2, samples, samples))
    weights = equations.grid.scheme.weights(samples)
    for matrix, row, order in ((first, weights[0], 1), (second, weights[1], 2)):
        for offset, weight in row.items():
            matrix += weight * np.roll(np.eye(samples), offset, axis=1) * (samples * equations.frequency) ** order
    blocks = columns[:, count:].reshape(samples, count, 3, count)
    result = np.zeros((samples, count, samples, count))
    for derivative, matrix in enumerate((np.eye(samples), first, second)):
        result += np.einsum("nes,nm->nems", blocks[:, :, derivative], matrix)
    return result.reshape(samples * count, samples * count)


@pytest.mark.parametrize("exponent", [-40.0, -20.0, 0.7, 20.0, 40.0])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_linear_solves_are_accurate_for_stable_and_unstable_orbits(scheme, exponent):
    """Against the transfer function with the scheme's own symbol for d/dt; multiplier e^λ over the period."""
    samples = 800 if scheme != "fourier" else 100
    equations = equations_of(growing(1), scheme, samples)
    solution = equations.solve(np.array([exponent]), np.zeros((samples, 1)))
    weights = equations.grid.scheme.weights(samples)[0]
    symbol = sum(w * np.exp(2j * np.pi * o / samples) for o, w in weights.items()) * samples
    exact = (np.exp(2j * np.pi * grid(samples)) / (symbol - exponent)).real
    assert solution.code == compiled.CONVERGED
    assert np.max(np.abs(solution.z[:, 0] - exact)) <= 1e-10 * np.max(np.abs(exact))


@pytest.mark.parametrize("exponent", [-40.0, 40.0])
@pytest.mark.parametrize("states", [1, SLOW_TWO, 4])
@pytest.mark.parametrize("scheme", ["backward2", "central2"])
def test_segments_agree_with_the_folded_band_and_are_used(scheme, states, exponent):
    equations = equations_of(growing(states), scheme, 800)
    theta = np.array([exponent])
    z = np.random.default_rng(1).standard_normal((800, states))
    columns = equations.residual_jacobian(z, theta)
    factors = empty_factors(equations.grid, states)
    assert equations.factorise(columns, z, factors)
    segments = factors.ends[0]
    assert 1 < segments <= compiled.MAX_SEGMENTS or exponent < 0 and segments >= 1
    right = np.random.default_rng(2).standard_normal((800, states))
    solved = right.copy()
    equations.kernels.back_substitute(equations.grid.packed, factors, solved)
    expected = equations.factors(columns).solve(right)
    assert np.max(np.abs(solved - expected) / np.abs(expected).max(axis=0)) < 1e-8  # some 10 roundings of 1/h²


@pytest.mark.parametrize(
    "scheme", [*SCHEMES, GAPS, pytest.param(FORWARD, marks=pytest.mark.slow)], ids=lambda s: getattr(s, "name", s)
)
@pytest.mark.parametrize("states", [1, 4])
def test_derivatives_are_weighted_sums_of_neighbours(scheme, states):
    equations = equations_of(growing(states), scheme, 40)
    z = np.random.default_rng(7).standard_normal((40, states))
    drift = np.arange(1.0, states + 1.0)
    first, second = equations.grid.scheme.weights(40)
    rate, acceleration = (sum(w * np.roll(z, -o, axis=0) for o, w in own.items()) for own in (first, second))
    expected = [z + drift * equations.grid.tau[:, None], 40 * rate + drift, 40**2 * acceleration]
    assert equations.states(z, drift) == pytest.approx(np.concatenate(expected, axis=1), rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("exponent", [-40.0, 1.0, 40.0])
@pytest.mark.parametrize("scheme", [*SLOW_SCHEMES, "central4"])
def test_transposed_solves_by_segments_and_by_the_band_match_dense_algebra(scheme, exponent):
    states = 2
    equations = equations_of(growing(states), scheme, 120)
    z = np.random.default_rng(1).standard_normal((120, states))
    columns = equations.residual_jacobian(z, np.array([exponent]))
    factors = empty_factors(equations.grid, states)
    assert equations.factorise(columns, z, factors)
    assert (factors.ends[0] > 0) == (scheme != "central4")
    right = np.random.default_rng(2).standard_normal((120, states))
    solved = right.copy()
    adjoint = compiled.kernels("adjoint", states, equations.grid.stencil)
    adjoint.back_substitute_transposed(equations.grid.packed, factors, solved)
    expected = np.linalg.solve(dense(equations, columns).T, right.ravel())
    assert solved.ravel() == pytest.approx(expected, rel=1e-8, abs=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("states", [1, SLOW_TWO])
@pytest.mark.parametrize("scheme", ["backward2", "central2", "central4"])
def test_bands_of_any_length_are_factored_with_row_exchanges(scheme, states):
    """Random bands without dominance, one with a column of zeros, against dense algebra."""
    shape, random = CyclicGrid(find_scheme(scheme), 800, 1), np.random.default_rng(2)
    functions, lower = compiled.kernels("batch", states, shape.stencil), shape.packed.half_width * states + states - 1
    for size in (lower + 1, 3 * lower, 3 * lower + 1, 3 * lower + 2, 60):
        matrix = np.tril(np.triu(random.standard_normal((size, size)), -lower), lower)
        band, pivots = rows_of_band(matrix, lower), np.empty(size, dtype=np.int64)
        assert functions.factor(band, lower, lower, pivots)
        assert np.any(pivots != np.arange(size))
        right = random.standard_normal((2, size))
        for solve, dense_matrix in ((functions.solve, matrix), (functions.solve_transposed, matrix.T)):
            x = right.copy()
            solve(band, lower, lower, pivots, x)
            assert x @ dense_matrix.T == pytest.approx(right, rel=0, abs=1e-9)
        matrix[:, size // 3] = 0.0
        assert not functions.factor(rows_of_band(matrix, lower), lower, lower, pivots)


def rows_of_band(matrix: np.ndarray, lower: int) -> np.ndarray:
    """Return the rows of a band side by side, with room for the fill-in."""
    band = np.zeros((len(matrix), 3 * lower + 1))
    for i, j in np.argwhere(matrix):
        band[i, j - i + lower] = matrix[i, j]
    return band


def test_a_march_that_grows_too_fast_is_left_for_the_folded_band():
    equations = equations_of(growing(1), "central2", 200)
    theta = np.array([-2000.0])  # the leapfrog's parasitic solution grows by e^2000 in a period
    z = np.ones((200, 1))
    factors = empty_factors(equations.grid, 1)
    columns = equations.residual_jacobian(z, theta)
    assert equations.factorise(columns, z, factors)
    assert factors.ends[0] == 0
    right = np.random.default_rng(3).standard_normal((200, 1))
    solved = right.copy()
    equations.kernels.back_substitute(equations.grid.packed, factors, solved)
    assert solved.ravel() == pytest.approx(np.linalg.solve(dense(equations, columns), right.ravel()), rel=1e-9)


@pytest.mark.parametrize("states", [1, SLOW_TWO, 4])
@pytest.mark.parametrize("scheme", [*SCHEMES, GAPS], ids=lambda s: getattr(s, "name", s))
def test_many_sides_and_the_transpose_match_dense_algebra(scheme, states):
    equations = equations_of(growing(states), scheme, 30)
    z = np.ones((30, states))
    columns = equations.residual_jacobian(z, np.array([1.5]))
    matrix, factors = dense(equations, columns), equations.factors(columns)
    right = np.random.default_rng(4).standard_normal((5, 30, states))
    flat = right.reshape(5, -1)
    assert factors.regular
    assert factors.solve(right).reshape(5, -1) == pytest.approx(np.linalg.solve(matrix, flat.T).T, rel=1e-8, abs=1e-10)
    transposed = np.linalg.solve(matrix.T, flat.T).T
    assert factors.solve_transposed(right).reshape(5, -1) == pytest.approx(transposed, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("scheme", [*SLOW_SCHEMES, "central4", "fourier"])
@pytest.mark.parametrize("rate", [0.0, 1e-13, 1.5])
def test_bordered_systems_are_solved_where_the_block_is_singular(scheme, rate):
    """ẇ = u has a constant as null vector; a border fixes the mean and frees a constant force."""
    equations = equations_of(growing(2), scheme, 41)
    columns = equations.residual_jacobian(np.ones((41, 2)), np.array([rate]))
    matrix = dense(equations, columns)
    generator = np.random.default_rng(5)
    rows, borders = generator.standard_normal((2, 2, 41, 2))
    rows[0, :, 0] += 1.0
    borders[0, :, 0] += 1.0
    corner, right, below = generator.standard_normal((2, 2)), generator.standard_normal((3, 41, 2)), np.ones((3, 2))
    factors = equations.bordered(columns, borders, rows, corner)
    solved = factors.solve_bordered(right, below)
    whole = np.block([[matrix, borders.reshape(2, -1).T], [rows.reshape(2, -1), corner]])
    expected = np.linalg.solve(whole, np.concatenate([right.reshape(3, -1), below], axis=1).T).T
    assert solved is not None
    assert factors.orientation == np.linalg.slogdet(whole)[0]
    assert np.concatenate([solved[0].reshape(3, -1), solved[1]], axis=1) == pytest.approx(expected, rel=1e-7, abs=1e-7)
    if rate < 1e-10:
        null = null_vector(equations.grid, columns, 2, equations.frequency)
        assert np.abs(matrix @ null.ravel()).max() < 1e-9


@pytest.mark.parametrize("half", [1, 2, 5])
def test_factors_solve_random_systems_that_need_pivoting(half):
    generator = np.random.default_rng(half)
    size = 60
    matrix = np.triu(np.tril(generator.standard_normal((size, size)), half), -half)
    np.fill_diagonal(matrix, 1e-8 * np.diag(matrix))
    right = generator.standard_normal((3, size))
    expected = np.linalg.solve(matrix, right.T).T
    band, pivots = rows_of_band(matrix, half), np.empty(size, dtype=np.int64)
    assert linear().factor(band, half, half, pivots)
    linear().solve(band, half, half, pivots, right)
    assert right == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_singular_and_not_finite_matrices_are_detected():
    for bad in (0.0, np.nan):
        band = rows_of_band(np.eye(5), 1)
        band[2, 1] = bad
        assert not linear().factor(band, 1, 1, np.empty(5, dtype=np.int64))


@pytest.mark.parametrize("exponent", [-40.0, -20.0, 20.0, 40.0])
def test_folded_band_is_accurate_for_stable_and_unstable_orbits(exponent):
    """W' = λ w + u on the cyclic grid of central2, multiplier e^λ over the period, against the discrete closed form."""
    shape = CyclicGrid(find_scheme("central2"), 800)
    size, half, tau = shape.points, shape.packed.half_width, shape.tau
    symbol = 1j * np.sin(2 * np.pi / size) * size - exponent
    forcing, expected = np.cos(2 * np.pi * tau), (np.exp(2j * np.pi * tau) / symbol).real
    matrix = np.zeros((size, 3 * half + 1))
    for i in range(size):
        row = shape.packed.place[i]
        matrix[row, half] -= exponent
        for neighbour, weight in zip(shape.packed.neighbours[i], shape.packed.first, strict=True):
            matrix[row, shape.packed.place[neighbour] - row + half] += weight
    right = np.empty((1, size))
    right[0, shape.packed.place] = forcing
    pivots = np.empty(size, dtype=np.int64)
    assert linear().factor(matrix, half, half, pivots)
    linear().solve(matrix, half, half, pivots, right)
    assert right[0, shape.packed.place] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("scheme", "half_width"), [("central2", 2), ("backward2", 6)])
@pytest.mark.parametrize("points", [20, 21])
def test_folded_order_has_the_expected_half_width(scheme, half_width, points):
    shape = CyclicGrid(find_scheme(scheme), points)
    assert sorted(shape.packed.place) == list(range(points))
    assert shape.packed.half_width == half_width


def test_changed_kernels_recompile_their_callers(monkeypatch, tmp_path):
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path))
    for added, states in ((1.0, 0), (3.0, 0), (3.0, 2), (1.0, 0)):
        texts = {"linear": CALLED.format(added=added), "newton": CALLING}
        monkeypatch.setattr(compiled, "source", texts.__getitem__)
        monkeypatch.setattr(compiled, "_kernels", cache(ORIGINAL.__wrapped__))
        caller = compiled.kernels("newton", states, (1, 1, 1))
        assert caller.twice(1.0) == 2.0 * (1.0 + added + states)


def test_an_interrupted_compilation_ends_the_other_process(monkeypatch, tmp_path):
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path))
    monkeypatch.setattr(compiled, "available_cores", lambda: 2)
    started = []
    real = compiled.subprocess.Popen
    monkeypatch.setattr(
        compiled.subprocess, "Popen", lambda command, **o: started.append(real(["sleep", "60"], **o)) or started[0]
    )
    with pytest.raises(KeyboardInterrupt), compiled._other_process("newton", (1, 2, 3, 2)):
        raise KeyboardInterrupt
    assert started[0].returncode not in (None, 0)


@pytest.mark.parametrize(
    ("executable", "starts"), [("python3", True), ("python missing", False), ("application", False)]
)
def test_a_failure_of_the_other_process_that_compiles_is_made_up_for(monkeypatch, tmp_path, executable, starts):
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiled, "available_cores", lambda: 2)
    monkeypatch.setattr(compiled, "source", {"linear": CALLED.format(added=1.0), "newton": CALLING}.__getitem__)
    monkeypatch.setattr(compiled, "_kernels", cache(ORIGINAL.__wrapped__))
    script = tmp_path / executable
    if "missing" not in executable:
        script.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\nexit 1\n")
        script.chmod(0o700)
    monkeypatch.setattr(compiled.sys, "executable", str(script))
    assert compiled.kernels("newton", 2, (1, 1, 1)).twice(1.0) == 8.0
    assert (tmp_path / "started").exists() == starts
