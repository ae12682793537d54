"""What the parameters leave of a residual, and tests of it: whiteness and harmonic content."""

from functools import cached_property, lru_cache

import numpy as np
from scipy.special import chdtri, fdtrc

from bayesperiodic._linalg import TINY, column_space
from bayesperiodic.estimation.result import Whiteness
from bayesperiodic.likelihood.block import Block

ABSORBED = 1e-3
# Part of the largest component below which the mean of residual and derivatives is a rounding error.
MATCHED = 1e-6
NOT_TESTED = float("nan")


class Unexplained:
    """Whitened residual components (size,), projected orthogonally to their derivatives (parameters, size).

    The components are independent with equal variances under the model; derivatives may be dependent or zero. `square`
    is the sum of squares, `freedom` the number of its degrees of freedom. A mean that data and model have in common to
    rounding, as a centred signal and a linear model, has no noise and is left out.
    """

    def __init__(self, components: np.ndarray, jacobian: np.ndarray, harmonic: np.ndarray):
        components, jacobian, harmonic = _without_matched_mean(components, jacobian, harmonic)
        self._basis = column_space(jacobian)
        self._rest = components - self._basis @ (self._basis.T @ components)
        self.square = float(self._rest @ self._rest)
        self.freedom = components.size - self._basis.shape[1]
        self.harmonics, self._group = np.unique(harmonic, return_inverse=True)

    @classmethod
    def of_measured_noise(
        cls, components: np.ndarray, jacobian: np.ndarray, harmonic: np.ndarray, behind: np.ndarray
    ) -> "Unexplained":
        """Return what is unexplained in units of measured standard deviations with degrees of freedom (highest + 1,).

        The square of each harmonic is F distributed. It is weighted so that it is the χ² quantile of its probability.
        """
        components, jacobian, harmonic = _without_matched_mean(components, jacobian, harmonic)
        first = cls(components, jacobian, harmonic)
        square, freedom = explained(*first.sums)
        free = np.maximum(freedom, 1)
        p = np.maximum(fdtrc(free, behind[first.harmonics], square / free), np.finfo(float).tiny)
        known = np.where((freedom > 0) & (square > 0.0), chdtri(free, p), square)
        factor = np.sqrt(np.divide(known, square, out=np.ones_like(square), where=known > 0.0))[first._group]
        return cls(components * factor, jacobian * factor, harmonic)

    @cached_property
    def sums(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Sums over each harmonic: b bᵀ of the basis, b·e, e² of the residual e, and the number of components."""
        order = np.argsort(self._group, kind="stable")
        b, e = self._basis[order], self._rest[order, None]
        starts = np.searchsorted(self._group[order], np.arange(self.harmonics.size))
        parts = (b[:, :, None] * b[:, None], b * e, e**2, np.ones_like(e))
        gram, along, square, size = (np.add.reduceat(part, starts, axis=0) for part in parts)
        return gram, along, square[:, 0], size[:, 0]

    def whiteness(self) -> Whiteness:
        """Return Bartlett's test of the cumulative power of the harmonics, the highest first.

        Harmonics of which the parameters take up a component or more have no power of two values, and are left out.
        """
        square, freedom = explained(*(np.cumsum(part[::-1], axis=0) for part in self.sums))
        pairs = np.diff(freedom, prepend=0) == 2
        power = np.diff(square, prepend=0.0)[pairs][::-1]
        return of_periodogram(np.maximum(power, 0.0))

    def harmonic_content(self) -> tuple[float, float]:
        """Return p of excess power in one harmonic or in the lowest 2ᵏ + 1 (Bonferroni), and the strongest harmonic."""
        count = self.harmonics.size
        last = [2**k for k in range(count.bit_length()) if 2**k < count - 1]
        square, freedom = explained(*(np.concatenate([p, np.cumsum(p, axis=0)[last]]) for p in self.sums))
        rest = self.freedom - freedom
        tested = (freedom > 0) & (rest > 0)
        if not tested.any():
            return NOT_TESTED, NOT_TESTED
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = square / freedom / (np.maximum(self.square - square, 0.0) / rest)
        p = np.where(tested, fdtrc(freedom, rest, np.maximum(np.nan_to_num(ratio, nan=0.0, posinf=np.inf), 0.0)), 1.0)
        _, _, power, size = self.sums
        return min(1.0, float(p.min() * tested.sum())), float(self.harmonics[np.argmax(power / size)])


def explained(
    gram: np.ndarray, along: np.ndarray, square: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of squares (sets,) explained by sets of harmonics, and their sizes, from sums over each set."""
    values, vectors = np.linalg.eigh(gram)
    left = 1.0 - values
    # Combinations of the components of a set that the parameters can produce have no information.
    absorbed = left < ABSORBED
    turned = np.einsum("srj,sr->sj", vectors, along) ** 2
    ratio = np.where(absorbed, -1.0 / np.maximum(values, 0.5), 1.0 / np.maximum(left, ABSORBED))
    return square + np.sum(turned * ratio, axis=1), np.rint(size - absorbed.sum(axis=1)).astype(int)


def _without_matched_mean(
    components: np.ndarray, jacobian: np.ndarray, harmonic: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return components, derivatives and harmonics without a mean that is matched to rounding."""
    size = np.abs(jacobian) / np.maximum(np.abs(jacobian).max(axis=1, keepdims=True), TINY)
    moved = size.max(axis=0, initial=0.0) > MATCHED
    kept = (harmonic > 0) | moved | (np.abs(components) > MATCHED * np.abs(components).max(initial=0.0))
    return (components, jacobian, harmonic) if kept.all() else (components[kept], jacobian[:, kept], harmonic[kept])


def of_periodogram(power: np.ndarray) -> Whiteness:
    """Test whether the squared amplitudes of harmonics 1, 2, … are those of white noise (Bartlett 1955).

    NaN of fewer than two of them, and if all are zero.
    """
    if power.size < 2 or power.sum() == 0.0:
        return Whiteness(NOT_TESTED, NOT_TESTED)
    harmonic = np.arange(1, power.size + 1)
    cumulative, count = np.cumsum(power)[:-1] / power.sum(), power.size - 1
    distance = max(np.max(harmonic[:-1] / count - cumulative), np.max(cumulative - (harmonic[:-1] - 1) / count))
    lag = 2.0 * np.pi / (2 * power.size + 1)
    return Whiteness(
        kolmogorov_tail(float(distance), count), float(np.sum(power * np.cos(lag * harmonic)) / power.sum())
    )


@lru_cache(maxsize=4096)  # which takes milliseconds; checks and tests of the model ask for the same ones
def kolmogorov_tail(distance: float, count: int) -> float:
    """Return the probability of a larger Kolmogorov-Smirnov distance of `count` uniform values, without rounding."""
    from scipy.stats import kstwo

    return float(kstwo.sf(distance, count))


def testable(r: np.ndarray, j: np.ndarray) -> bool:
    """Return whether residual components and their derivatives are finite."""
    return bool(np.isfinite(r).all() and np.isfinite(j).all())


def used(block: Block, *parts: np.ndarray) -> list[np.ndarray]:
    """Return the components (…, used) for the tests, points as cosine components along the period, and harmonics."""
    harmonic = block.wave_numbers
    number = min(block.size, int(np.rint(block.count))) if block.timed else block.size
    order = np.sort(np.argsort(harmonic, kind="stable")[:number])
    return [part[..., order] for part in (*map(block.along_period, parts), harmonic)]
