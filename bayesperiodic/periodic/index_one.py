"""Floquet multipliers of equations whose derivative matrix is singular (index 1).

Of the linearised equations M(t) ẏ = K(t) y, let Π(t) be the orthogonal projector on the left null space of M, whose
rank is constant. Where M + ΠK is regular, ΠK y = 0 are the algebraic equations, y = (M + ΠK)⁻¹ w with w = M y, and

    ẇ = (K + Ṁ) (M + ΠK)⁻¹ w

on the range of M, which this flow maps onto itself [1]_. No bases that are smooth in time are needed. The transfer
matrices of w between grid points are restricted to the range of M; their product has the finite multipliers, as many as
the rank of M.

References
----------
.. [1] R. Lamour, R. März, R. Winkler, How Floquet theory applies to index 1 differential algebraic equations, Journal
   of Mathematical Analysis and Applications 217, 1998, 372-394.
"""

import numpy as np

from bayesperiodic.periodic.floquet import Floquet, first_order_matrix, floquet, floquet_of, transfer_matrices

# Smallest singular value of the derivative matrix, equations and variables scaled, below which it counts as zero, and
# the largest condition number of M + ΠK.
SINGULAR_VALUE, SOLVABLE = 1e-12, 1e10
# Weights of a periodic central difference of order 8.
DIFFERENCE = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
HIGHER_INDEX = (
    "the matrix of the highest derivatives is singular, and the equations do not determine all states "
    "without further differentiation (index above 1)"
)
CHANGING_RANK = "the matrix of the highest derivatives is singular at some points of the orbit"


def orbit_floquet(
    linearisation: np.ndarray, orders: tuple[int, ...], sizes: np.ndarray, period: float
) -> Floquet | str:
    """Return multipliers and eigenfunctions of an orbit in variables divided by `sizes`, or why there are none.

    The linearisation (points, states, 3·states) is ∂g/∂(q, q̇, q̈). If the matrix of the highest derivatives is
    singular, the eigenfunctions are in bases of their own, see `Floquet.reduced`.
    """
    mass, rest = _scaled(linearisation, orders, sizes, period)
    values = np.linalg.svd(mass, compute_uv=False)
    if not np.isfinite(values).all():
        return "the linearised equations are not finite"
    if values[:, -1].min() > SINGULAR_VALUE:
        return floquet(first_order_matrix(linearisation, orders) * (sizes / sizes[:, None]), period)
    rank = np.sum(values > SINGULAR_VALUE, axis=1)
    if np.ptp(rank):
        return CHANGING_RANK
    return _reduced(mass, rest, int(rank[0]), period)


def _scaled(
    linearisation: np.ndarray, orders: tuple[int, ...], sizes: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return M and K (points, size, size) of M y' = K y, time in period/(2π), each equation's largest entry 1."""
    count, points = len(orders), len(linearisation)
    second = [i for i, order in enumerate(orders) if order == 2]
    mass, rest = np.zeros((2, points, sizes.size, sizes.size))
    for i, order in enumerate(orders):
        rate = count + second.index(i) if order == 2 else i
        mass[:, :count, rate] = linearisation[:, :, order * count + i]
        rest[:, :count, i] = -linearisation[:, :, i]
        if order == 2:
            rest[:, :count, rate] = -linearisation[:, :, count + i]
            mass[:, rate, i] = rest[:, rate, rate] = 1.0
    mass, rest = mass * sizes * (2 * np.pi / period), rest * sizes
    largest = np.max(np.maximum(np.abs(mass), np.abs(rest)), axis=(0, 2))[:, None]
    largest[largest == 0.0] = 1.0
    return mass / largest, rest / largest


def _reduced(mass: np.ndarray, rest: np.ndarray, rank: int, period: float) -> Floquet | str:
    left = np.linalg.svd(mass)[0]
    projector = left[:, :, rank:] @ np.swapaxes(left[:, :, rank:], 1, 2)
    regular = mass + projector @ rest
    if not np.max(np.linalg.cond(regular)) < SOLVABLE:
        return HIGHER_INDEX
    if rank == 0:
        return floquet_of(np.empty((len(mass), 0, 0)))
    step = 2 * np.pi / len(mass)
    change = sum(
        weight * (np.roll(mass, -k, axis=0) - np.roll(mass, k, axis=0)) for k, weight in enumerate(DIFFERENCE, 1)
    )
    # The projector makes the rates across the range of M zero instead of one, and changes nothing in the range.
    matrix = (rest + change / step) @ np.linalg.inv(regular) - projector
    basis = left[:, :, :rank]
    steps = np.swapaxes(np.roll(basis, -1, axis=0), 1, 2) @ transfer_matrices(matrix, step) @ basis
    return floquet_of(np.ascontiguousarray(steps), reduced=True)
