import numpy as np
import pytest

from bayesperiodic.periodic.compiled import kernels
from bayesperiodic.periodic.schemes import CyclicGrid, backward2, central2

linear = kernels("linear", 1, (2, 3, 2))
factor, solve = linear.factor, linear.solve


def banded(matrix: np.ndarray, half: int) -> np.ndarray:
    size = len(matrix)
    band = np.zeros((size, 3 * half + 1))
    for i in range(size):
        for j in range(max(0, i - half), min(size, i + half + 1)):
            band[i, j - i + half] = matrix[i, j]
    return band


@pytest.mark.parametrize("half", [1, 2, 5])
def test_factors_solve_random_systems_that_need_pivoting(half):
    generator = np.random.default_rng(half)
    size = 60
    matrix = np.triu(np.tril(generator.standard_normal((size, size)), half), -half)
    np.fill_diagonal(matrix, 1e-8 * np.diag(matrix))
    right = generator.standard_normal((3, size))
    expected = np.linalg.solve(matrix, right.T).T
    band, pivots = banded(matrix, half), np.empty(size, dtype=np.int64)
    assert factor(band, half, half, pivots)
    solve(band, half, half, pivots, right)
    assert right == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_singular_and_not_finite_matrices_are_detected():
    for bad in (0.0, np.nan):
        band = banded(np.eye(5), 1)
        band[2, 1] = bad
        assert not factor(band, 1, 1, np.empty(5, dtype=np.int64))


@pytest.mark.parametrize("exponent", [-40.0, -20.0, 20.0, 40.0])
def test_folded_band_is_accurate_for_stable_and_unstable_orbits(exponent):
    """W' = λ w + u on the cyclic grid of central2, multiplier e^λ over the period, against the discrete closed form."""
    grid = CyclicGrid(central2, 800)
    size, half = grid.points, grid.half_width
    tau = grid.tau
    symbol = 1j * np.sin(2 * np.pi / size) * size - exponent
    forcing, expected = np.cos(2 * np.pi * tau), (np.exp(2j * np.pi * tau) / symbol).real
    matrix = np.zeros((size, 3 * half + 1))
    for i in range(size):
        row = grid.place[i]
        matrix[row, half] -= exponent
        for neighbour, weight in zip(grid.neighbours[i], grid.first, strict=True):
            matrix[row, grid.place[neighbour] - row + half] += weight
    right = np.empty((1, size))
    right[0, grid.place] = forcing
    pivots = np.empty(size, dtype=np.int64)
    assert factor(matrix, half, half, pivots)
    solve(matrix, half, half, pivots, right)
    assert right[0, grid.place] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("scheme", "half_width"), [(central2, 2), (backward2, 6)])
@pytest.mark.parametrize("points", [20, 21])
def test_folded_order_has_the_expected_half_width(scheme, half_width, points):
    grid = CyclicGrid(scheme, points)
    assert sorted(grid.place) == list(range(points))
    assert grid.half_width == half_width
