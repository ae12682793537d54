"""Floquet multipliers of equations whose derivative matrix is singular (index 1).

Of the linearised equations M(t) ẏ = K(t) y, let Π(t) be the orthogonal projector on the left null space of M, whose
rank is constant. Where M + ΠK is regular, ΠK y = 0 are the algebraic equations, y = (M + ΠK)⁻¹ w with w = M y, and

    ẇ = (K + Ṁ) (M + ΠK)⁻¹ w

on the range of M, which this flow maps onto itself [1]_. No bases that are smooth in time are needed. The transfer
matrices of w between grid points are restricted to the range of M; their product has the finite multipliers, as many as
the rank of M. Directions that decay faster than the grid follows (very small singular values of M) are treated in the
same way.

References
----------
.. [1] R. Lamour, R. März, R. Winkler, How Floquet theory applies to index 1 differential algebraic equations, Journal
   of Mathematical Analysis and Applications 217, 1998, 372-394.
"""

import numpy as np

from bayesperiodic.periodic.floquet import (
    MOST_PARTS,
    Floquet,
    first_order_matrix,
    floquet,
    floquet_of,
    transfer_matrices,
)

# Singular value of the derivative matrix, equations and variables scaled, below which it counts as zero, and largest
# condition number of M + ΠK.
SINGULAR_VALUE, SOLVABLE = 1e-12, 1e10
# Product of the largest rate and the period, over the squared number of parts of all steps, up to which collocation
# damps a decaying direction to nothing, by exp(−24/TOO_FAST).
TOO_FAST = 0.3
# Weights of a periodic central difference of order 8.
DIFFERENCE = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
HIGHER_INDEX = (
    "the matrix of the highest derivatives is singular or nearly so, and the equations do not determine all states "
    "without further differentiation (index above 1), or some vibrate too fast for the grid"
)
GROWING = "the matrix of the highest derivatives is nearly singular, and a motion grows too fast for the grid"
CHANGING_RANK = "the matrix of the highest derivatives is singular at some points, or in some directions nearly so"


def orbit_floquet(
    linearisation: np.ndarray, orders: tuple[int, ...], sizes: np.ndarray, period: float
) -> Floquet | str:
    """Return multipliers and eigenfunctions of an orbit in variables divided by `sizes`, or why there are none.

    The linearisation (points, states, 3·states) is ∂g/∂(q, q̇, q̈). If the matrix of the highest derivatives is
    singular, or nearly so, there are as many as its rank, and the eigenfunctions are in other bases, see
    `Floquet.reduced`.
    """
    mass, rest = _scaled(linearisation, orders, sizes, period)
    if not (np.isfinite(mass).all() and np.isfinite(rest).all()):
        return "the linearised equations are not finite"
    values = np.linalg.svd(mass, compute_uv=False)
    rank = np.sum(values > 2 * np.pi / (TOO_FAST * (MOST_PARTS * len(mass)) ** 2), axis=1)
    if rank.min() < sizes.size and not np.ptp(rank):
        return _reduced(mass, rest, int(rank[0]))
    if values[:, -1].min() <= SINGULAR_VALUE:
        return CHANGING_RANK
    return floquet(first_order_matrix(linearisation, orders) * (sizes / sizes[:, None]), period)


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


def _reduced(mass: np.ndarray, rest: np.ndarray, rank: int) -> Floquet | str:
    left, values, right = np.linalg.svd(mass)
    null, fast = left[:, :, rank:], values[:, rank:]
    algebraic = np.swapaxes(null, 1, 2) @ rest @ np.swapaxes(right[:, rank:], 1, 2)
    mass = mass - (null * fast[:, None]) @ right[:, rank:]
    projector = null @ np.swapaxes(null, 1, 2)
    regular = mass + projector @ rest
    if not np.max(np.linalg.cond(regular)) < SOLVABLE:
        return HIGHER_INDEX
    if fast.min() <= SINGULAR_VALUE < fast.max():
        return CHANGING_RANK
    if fast.min() > SINGULAR_VALUE and np.max(np.linalg.eigvals(algebraic / fast[:, :, None]).real) > 0.0:
        return GROWING
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
