"""Tests of what a model leaves unexplained, with p-values that are exact where the model is linear.

Whitened residual components r are those of white noise ε but for what fitting took out: r = ε − J δ. Whatever was
fitted, and however strong the priors were, the part of r orthogonal to the columns of J is that of ε alone. There the
power in any set of harmonics, against the rest, is a ratio of independent χ² variables, an F test whose degrees of
freedom are what the parameters leave; and the power that each harmonic adds to those above it is independent of theirs.
For a nonlinear model J is that at the point of the residual, so that its curvature counts only between that point and
the best fit.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy import stats

from bayesperiodic.inference.estimation.whiteness import of_periodogram

RANK = 1e-6
ABSORBED = 1e-3
NOT_TESTED = float("nan")


class Unexplained:
    """The part of whitened residual components that no change of the parameters explains.

    Parameters
    ----------
    components : array (size,)
        Independent, with one variance, where the model holds.
    changes : array (parameters, size)
        Their derivatives by the parameters; rows may be dependent or zero.
    harmonic : int array (size,)
        To which each component belongs.

    Attributes
    ----------
    square : float
        Sum of squares.
    freedom : int
        Degrees of freedom behind it.
    """

    def __init__(self, components: np.ndarray, changes: np.ndarray, harmonic: np.ndarray):
        self._basis = column_space(changes)
        self._rest = components - self._basis @ (self._basis.T @ components)
        self.square = float(self._rest @ self._rest)
        self.freedom = components.size - self._basis.shape[1]
        self.harmonics, self._group = np.unique(harmonic, return_inverse=True)

    @cached_property
    def _sums(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Sums over each harmonic: b bᵀ of the basis, b·e, e² of the residual e, and the number of components."""
        b, e = self._basis, self._rest
        each = np.eye(self.harmonics.size)[:, self._group]
        gram = np.einsum("hs,si,sj->hij", each, b, b, optimize=True)
        return gram, each @ (b * e[:, None]), each @ e**2, each.sum(axis=1)

    def explained(self, sets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sum of squares (sets,) that free amplitudes of sets of harmonics would explain, and their number.

        Parameters
        ----------
        sets : bool array (sets, harmonics)
        """
        gram, along, square, size = (np.tensordot(sets.astype(float), part, 1) for part in self._sums)
        values, vectors = np.linalg.eigh(gram)
        left = 1.0 - values
        # Combinations of the set's components that the parameters can produce themselves hold no information.
        absorbed = left < ABSORBED
        turned = np.einsum("srj,sr->sj", vectors, along) ** 2
        ratio = np.where(absorbed, -1.0 / np.maximum(values, 0.5), 1.0 / np.maximum(left, ABSORBED))
        return square + np.sum(turned * ratio, axis=1), np.rint(size - absorbed.sum(axis=1)).astype(int)

    def whiteness(self) -> float:
        """Return p of Bartlett's test: the cumulative power of the harmonics, the highest first, on a straight line."""
        tails = np.tri(self.harmonics.size, dtype=bool)[:, ::-1]
        square, freedom = self.explained(tails)
        pairs = np.diff(freedom, prepend=0) == 2
        power = np.diff(square, prepend=0.0)[pairs][::-1]
        return of_periodogram(np.maximum(power, 0.0)).p if power.size >= 2 else NOT_TESTED

    def harmonic_content(self) -> tuple[float, float]:
        """Return p of too much power in one harmonic or in the lowest 2ᵏ + 1, and the harmonic that has most.

        The smallest p of the F tests, times their number.
        """
        count = self.harmonics.size
        lowest = np.array([np.arange(count) <= 2**k for k in range(count.bit_length()) if 2**k < count - 1], dtype=bool)
        sets = np.concatenate([np.eye(count, dtype=bool), lowest.reshape(-1, count)])
        square, freedom = self.explained(sets)
        rest = self.freedom - freedom
        tested = (freedom > 0) & (rest > 0)
        if not tested.any():
            return NOT_TESTED, NOT_TESTED
        p = np.ones(len(sets))
        p[tested] = _f_test(square[tested], freedom[tested], (self.square - square)[tested], rest[tested])
        _, _, power, size = self._sums
        return min(1.0, float(p.min() * tested.sum())), float(self.harmonics[np.argmax(power / size)])


def column_space(changes: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (size, rank) of the span of rows (parameters, size), each taken at its own size."""
    length = np.linalg.norm(changes, axis=1)
    rows = changes[length > 0.0] / length[length > 0.0, None]
    if not rows.size:
        return np.empty((changes.shape[1], 0))
    _, values, basis = np.linalg.svd(rows, full_matrices=False)
    return basis[values > RANK * values[0]].T


def excess(variance: float, freedom: float, known: float, known_freedom: float) -> float:
    """Return p of a variance at least so far above a known one, which may itself have been estimated."""
    if not freedom > 0.0 or not known > 0.0:
        return NOT_TESTED
    if np.isinf(known_freedom):
        return float(stats.chi2.sf(freedom * variance / known, freedom))
    return float(stats.f.sf(variance / known, freedom, known_freedom))


def consistency(parts: Sequence[tuple[np.ndarray, np.ndarray, str]], known: frozenset[str]) -> float:
    """Return p of residuals that parameters of their own would explain far better than common ones: Chow's test.

    Parameters
    ----------
    parts : sequence of (array (size,), array (parameters, size), str)
        Whitened components of each block, their derivatives, and the group of blocks with one unknown variance.
    known : set of str
        Groups whose whitened variance is known to be 1.

    References
    ----------
    G. C. Chow, Tests of equality between sets of coefficients in two linear regressions, Econometrica 28 (1960)
    591-605.
    """
    own = [Unexplained(r, j, np.zeros(r.size, dtype=int)) for r, j, _ in parts]
    scale, freedoms = dict.fromkeys(known, 1.0), [np.inf]
    for group in {g for *_, g in parts} - known:
        members = [u for u, (*_, g) in zip(own, parts, strict=True) if g == group]
        freedom = sum(u.freedom for u in members)
        if freedom and (square := sum(u.square for u in members)) > 0.0:
            scale[group] = square / freedom
            freedoms.append(freedom)
    kept = [(u, r, j, g) for u, (r, j, g) in zip(own, parts, strict=True) if g in scale]
    if not kept:
        return NOT_TESTED
    r, j = (np.concatenate([part[i] / np.sqrt(scale[part[3]]) for part in kept], axis=-1) for i in (1, 2))
    common = Unexplained(r, j, np.zeros(r.size, dtype=int))
    square = common.square - sum(u.square / scale[g] for u, _, _, g in kept)
    freedom = common.freedom - sum(u.freedom for u, *_ in kept)
    return excess(square / freedom, freedom, 1.0, min(freedoms)) if freedom > 0 else NOT_TESTED


def holm(p: np.ndarray) -> np.ndarray:
    """Return p-values adjusted for their number; NaN for those not tested, which do not count.

    References
    ----------
    S. Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6 (1979) 65-70.
    """
    adjusted = np.full(p.shape, np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested], kind="stable")]
    steps = p[order] * np.arange(order.size, 0, -1)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(steps)) if order.size else steps
    return adjusted


def _f_test(square: np.ndarray, freedom: np.ndarray, other: np.ndarray, other_freedom: np.ndarray) -> np.ndarray:
    """Return p of a mean square at least so far above another."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = square / freedom / (np.maximum(other, 0.0) / other_freedom)
    return np.asarray(stats.f.sf(np.nan_to_num(ratio, nan=0.0, posinf=np.inf), freedom, other_freedom))
