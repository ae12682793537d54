"""Floquet multipliers and eigenfunctions of linear periodic equations of any stability.

The multipliers are those of the equations linearised on the orbit, ẏ = A(t) y, not of a difference scheme's recurrence,
which has parasitic ones. Between neighbouring grid points A is interpolated and the equations are integrated by
collocation at three Gauss points (order 6, [1]_, table II.7.4), in up to 32 parts where the equations are stiff (beyond
that, multipliers near zero are overestimated). The transfer matrices are multiplied only while the products are well
conditioned; an orthogonal basis is swept through the remaining factors, period after period, until it is invariant.
This finds the invariant subspaces of each modulus, and each multiplier is computed from its own subspace.

References
----------
.. [1] Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, Springer, 1993.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from bayesperiodic.models.integration import dense_kernels

STENCIL = 8
GAUSS_NODES = np.array([0.5 - np.sqrt(15) / 10, 0.5, 0.5 + np.sqrt(15) / 10])
GAUSS_WEIGHTS = np.array([5, 8, 5]) / 18
GAUSS_MATRIX = np.array(
    [
        [5 / 36, 2 / 9 - np.sqrt(15) / 15, 5 / 36 - np.sqrt(15) / 30],
        [5 / 36 + np.sqrt(15) / 24, 2 / 9, 5 / 36 - np.sqrt(15) / 24],
        [5 / 36 + np.sqrt(15) / 30, 2 / 9 + np.sqrt(15) / 15, 5 / 36],
    ]
)
HARMLESS_ERROR, IN_RANGE = 1e3, 1e60
BASIS_SWEEPS, POWER_ROUNDS = 8, 60
DECOUPLED = 1e-11
STIFF, MOST_PARTS = 3.0, 32


@cache
def _kernels() -> ModuleType:
    return dense_kernels(Path(__file__).with_name("_kernels") / "floquet.py")


@dataclass(frozen=True)
class Floquet:
    """Multipliers and eigenfunctions."""

    exponents: np.ndarray  # (size,), log μ of the whole period, largest real part first; imaginary part in (−π, π]
    _steps: np.ndarray
    _every: int
    _along: np.ndarray
    _across: np.ndarray
    reduced: bool = False  # True if the equations contain algebraic ones: then not in the variables of the equations

    def leading(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return for the first multipliers v of ẏ = A y and w of the adjoint ẇ = −Aᵀ w, complex (count, points, size).

        They are normalised to unit length at each grid point.
        """
        result = np.empty((2, count, *self._steps.shape[:2]), dtype=complex)
        for adjoint, starts in ((False, self._along), (True, self._across)):
            for k in range(count):
                at = np.ascontiguousarray(starts[k])
                _kernels().eigenfunction(self._steps, at, self._every, adjoint, result[int(adjoint), k])
        return result[0], result[1]


def first_order_matrix(linearisation: np.ndarray, orders: tuple[int, ...]) -> np.ndarray:
    """Return A (points, size, size) [1/s] of ẏ = A y, y = δq and the rates of the second-order states.

    The linearisation (points, states, 3·states) is ∂g/∂(q, q̇, q̈). A numpy.linalg.LinAlgError is raised if the
    equations cannot be solved for the highest derivatives.
    """
    highest, lower = _split(linearisation, orders)
    solved, second = -np.linalg.solve(highest, lower), [i for i, order in enumerate(orders) if order == 2]
    matrix = np.zeros((len(solved), solved.shape[2], solved.shape[2]))
    matrix[:, : len(orders)] = solved
    for row, state in enumerate(second, len(orders)):
        matrix[:, row] = solved[:, state]
        matrix[:, state] = 0.0
        matrix[:, state, row] = 1.0
    return matrix


def derivative_factors(
    linearisation: np.ndarray, orders: tuple[int, ...], matrix: np.ndarray, v: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a (multipliers, points, states) and b (…, 3·states) for which wᵀ dA v = aᵀ d∂g/∂(q, q̇, q̈) b.

    `matrix` is A, see `first_order_matrix`; v and w are (multipliers, points, size).
    """
    count = len(orders)
    second = [i for i, order in enumerate(orders) if order == 2]
    rows = [count + second.index(i) if order == 2 else i for i, order in enumerate(orders)]
    seen = np.zeros((*v.shape[:2], 3 * count), dtype=complex)
    seen[..., :count] = v[..., :count]
    seen[..., [count + i for i in second]] = v[..., count:]
    highest = np.einsum("npq,mnq->mnp", matrix[:, rows], v)
    seen[..., [order * count + i for i, order in enumerate(orders)]] = highest
    transposed = np.swapaxes(_split(linearisation, orders)[0], 1, 2)
    return -np.linalg.solve(transposed[None], w[..., rows, None])[..., 0], seen


def _split(linearisation: np.ndarray, orders: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    count = linearisation.shape[1]
    highest = linearisation[:, :, [order * count + i for i, order in enumerate(orders)]]
    rates = [count + i for i, order in enumerate(orders) if order == 2]
    return highest, np.concatenate([linearisation[:, :, :count], linearisation[:, :, rates]], axis=2)


def floquet(matrix: np.ndarray, period: float) -> Floquet:
    """Return multipliers and eigenfunctions of ẏ = A(t) y.

    `matrix` (points, size, size) is A [1/s] on an equidistant grid of one period [s], end point excluded.
    """
    return floquet_of(transfer_matrices(matrix, period / len(matrix)))


def floquet_of(steps: np.ndarray, *, reduced: bool = False) -> Floquet:
    """Return multipliers and eigenfunctions from the transfer matrices (points, size, size) of one period."""
    points, size, _ = steps.shape
    if not size:
        return Floquet(
            np.empty(0, dtype=complex), steps, 1, np.empty((0, points, 0)), np.empty((0, points, 0)), reduced
        )
    groups, length = _harmless_products(steps)
    splits, right = _invariant_bases(groups)
    _, left = _invariant_bases(np.swapaxes(groups[::-1], 1, 2), splits)
    left = np.roll(left[::-1], 1, axis=0)
    modes: list[tuple[complex, np.ndarray, np.ndarray]] = []
    for start, stop in zip([0, *splits], [*splits, size], strict=True):
        modes += _block(groups, *_eigenspaces(right, left, start, stop))
    exponents, v, w = (np.array(part) for part in zip(*modes, strict=True))
    order = np.argsort(-exponents.real, kind="stable")
    return Floquet(exponents[order], steps, length, v[order], w[order], reduced)


def leading_multipliers(matrix: np.ndarray, period: float, count: int) -> np.ndarray | None:
    """Return the largest multipliers of ẏ = A(t) y, complex (count,) or fewer; None if they require `floquet`.

    Power iteration over the period converges quickly if the largest multiplier is real and well separated; if the
    product of all transfer matrices is well conditioned, the multipliers are its eigenvalues. `matrix` and `period`
    are those of `floquet`.
    """
    points, size, _ = matrix.shape
    steps = transfer_matrices(matrix, period / points)
    if count == 1:
        dominant, logarithm, sign = _kernels().dominant_multiplier(
            steps, np.full(size, 1.0 / np.sqrt(size)), POWER_ROUNDS, DECOUPLED
        )
        if dominant:
            with np.errstate(over="ignore"):
                return np.array([sign * np.exp(logarithm)], dtype=complex)
    products, _ = _harmless_products(steps)
    if len(products) > 1:
        return None
    values = np.linalg.eigvals(products[0]).astype(complex)
    return values[np.argsort(-np.abs(values), kind="stable")][:count]


def transfer_matrices(matrix: np.ndarray, step: float) -> np.ndarray:
    """Return those of ẏ = A y, (points, size, size), from each grid point to the next."""
    width = min(STENCIL, len(matrix))
    first = 1 - width // 2
    stiffness = step * float(np.max(np.linalg.norm(matrix, axis=(1, 2))))
    parts = 1 if stiffness < STIFF else 2 * min(int(np.ceil(0.5 * stiffness / STIFF)), MOST_PARTS // 2)
    weights, result = _interpolation(width, first, parts), np.empty_like(matrix)
    compiled = _kernels().transfer_matrices
    compiled(np.ascontiguousarray(matrix), weights, first, step / parts, GAUSS_MATRIX, GAUSS_WEIGHTS, result)
    return result


@cache
def _interpolation(width: int, first: int, parts: int) -> np.ndarray:
    """Return the weights (parts, Gauss points, width) of grid points from `first` on, for each part of a step."""
    nodes = np.arange(width) + first

    def lagrange(at: float) -> list[np.floating]:
        return [np.prod([(at - m) / (k - m) for m in nodes if m != k]) for k in nodes]

    return np.array([[lagrange(node) for node in (part + GAUSS_NODES) / parts] for part in range(parts)])


def _harmless_products(steps: np.ndarray) -> tuple[np.ndarray, int]:
    """Return products of neighbouring transfer matrices and how many steps each spans (the last may span fewer)."""
    products, length = steps, 1
    while len(products) > 1:
        padded = products if len(products) % 2 == 0 else np.concatenate([products, np.eye(steps.shape[1])[None]])
        longer = padded[1::2] @ padded[0::2]
        if not _kernels().largest_condition(longer, IN_RANGE) < HARMLESS_ERROR:
            break
        products, length = longer, 2 * length
    return products, length


def _invariant_bases(groups: np.ndarray, splits: list[int] | None = None) -> tuple[list[int], np.ndarray]:
    """Sweep an orthogonal basis through the factors until its subspaces are invariant.

    Returns the sizes j for which its first j vectors span the subspace of the j largest multipliers (to rounding), and
    the basis before each factor, (factors, size, size).
    """
    size = groups.shape[1]
    basis = np.ascontiguousarray(np.linalg.qr(np.random.default_rng(0).standard_normal((size, size)))[0])
    before = np.empty(groups.shape)
    for _ in range(BASIS_SWEEPS if len(groups) > 1 else 0):
        start = basis.copy()
        _kernels().sweep(np.ascontiguousarray(groups), basis, before)
        turned = start.T @ basis
        if all(np.linalg.norm(turned[j:, :j]) < DECOUPLED for j in (range(1, size) if splits is None else splits)):
            break
    if len(groups) == 1:
        before[0], turned = basis, np.ones((size, size))
    if splits is None:
        splits = [j for j in range(1, size) if np.linalg.norm(turned[j:, :j]) < DECOUPLED]
    return splits, before


def _eigenspaces(right: np.ndarray, left: np.ndarray, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Return bases (factors, size, stop − start) of a block's invariant subspace, of A's and of the adjoint's."""
    x, y = right[:, :, start:stop], left[:, :, start:stop]
    if start:
        q, p = right[:, :, :start], left[:, :, :start]
        overlap, back = np.swapaxes(p, 1, 2) @ q, np.swapaxes(p, 1, 2)
        x = x - q @ np.linalg.solve(overlap, back @ x)
        y = y - p @ np.linalg.solve(np.swapaxes(overlap, 1, 2), np.swapaxes(q, 1, 2) @ y)
    return x, y


def _block(groups: np.ndarray, x: np.ndarray, y: np.ndarray) -> list[tuple[complex, np.ndarray, np.ndarray]]:
    """Return for each multiplier of a block its logarithm and the eigenfunctions (factors, size) before the factors."""
    after, width = np.roll(y, -1, axis=0), x.shape[2]
    small = np.linalg.solve(np.swapaxes(after, 1, 2) @ np.roll(x, -1, axis=0), np.swapaxes(after, 1, 2) @ groups @ x)
    gram = np.linalg.inv(np.swapaxes(y, 1, 2) @ x)
    if width == 1:  # one real multiplier: the bases are its eigenfunctions but for the signs
        factors = small[:, 0, 0]
        with np.errstate(divide="ignore"):
            exponent = np.log(complex(np.prod(np.sign(factors)))) + np.sum(np.log(np.abs(factors)))
        signs, back = np.cumprod([1.0, *np.sign(factors[:-1])]), np.cumprod(np.sign(factors[::-1]))[::-1]
        along, across = x[:, :, 0] * signs[:, None], y[:, :, 0] * (gram[:, 0, 0] * back)[:, None]
        return [(complex(exponent), along.astype(complex), across.astype(complex))]
    product, growth = np.eye(width), 0.0
    for matrix in small:
        product = matrix @ product
        scale = np.linalg.norm(product)
        product, growth = product / scale, growth + np.log(scale)
    values, vectors = np.linalg.eig(product)
    adjoint = np.linalg.inv(vectors)
    modes = []
    for value, c, d in zip(values, vectors.T, adjoint, strict=True):
        with np.errstate(divide="ignore"):
            exponent = complex(np.log(complex(value)) + growth)
        along, across = np.empty((2, len(groups), groups.shape[1]), dtype=complex)
        for g, matrix in enumerate(small):
            along[g] = x[g] @ c
            c = matrix @ c
            c = c / np.linalg.norm(c)
        for g in range(len(groups) - 1, -1, -1):
            d = small[g].T @ d
            d = d / np.linalg.norm(d)
            across[g] = y[g] @ (gram[g].T @ d)
        modes.append((exponent, along, across))
    return modes
