"""Priors of one parameter. A parameter whose prior has the support (0, ∞) is sampled in its logarithm."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from scipy import special

from bayesperiodic import _checks

LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)
ROOT_HALF_PI = math.sqrt(0.5 * math.pi)
ROOT_TWO = math.sqrt(2.0)
# Scales between which squares, and their inverses, are floats.
SMALLEST_SCALE, LARGEST_SCALE = 1e-150, 1e150
# Logarithm of dof/t² below which the distribution of Student's t is its first term, to rounding.
FAR_TAIL = -40.0
LEGENDRE_NODES, LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(20)


class LogDensity(Protocol):
    """Probability density of one parameter, or of n parameters jointly."""

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the normalised log-density, −inf outside the support.

        Parameters
        ----------
        x : array (…) or (…, n)
            In the parameters' units.

        Returns
        -------
        array (…)
        """

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return ∂ log p/∂x, (…) or (…, n), NaN outside the support."""

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −∂² log p/∂x², (…) or (…, n, n), NaN outside the support; negative where log p is convex."""

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size,) or (size, n)."""


@runtime_checkable
class Prior(LogDensity, Protocol):
    """Interface of the priors of one parameter."""

    @property
    def support(self) -> tuple[float, float]:
        """The open interval outside of which the density is zero."""

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the inverse of the distribution function, (…); NaN unless the probability is between 0 and 1."""


def _scale(argument: str, value: Any) -> float:
    """Return a positive number whose square is a float."""
    number = _checks.positive(argument, value)
    if not SMALLEST_SCALE <= number <= LARGEST_SCALE:
        raise ValueError(f"{argument}: must be between {SMALLEST_SCALE:g} and {LARGEST_SCALE:g}, got {value!r}.")
    return number


class Univariate(Prior, ABC):
    """Base of the priors of one parameter; only points inside the support reach their formulas.

    What overflows there is infinite or NaN, for which densities have a status.
    """

    # Checks of the arguments, by name; they return plain floats, so that equal priors print alike.
    _arguments: ClassVar[Mapping[str, Callable[[str, Any], float]]] = {}

    def __post_init__(self) -> None:
        for name, check in self._arguments.items():
            object.__setattr__(self, name, check(name, getattr(self, name)))

    @property
    def support(self) -> tuple[float, float]:
        """The whole line."""
        return -math.inf, math.inf

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Return the log-density."""
        return self._where_inside(self._log_density, x, -np.inf)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return d log p/dx."""
        return self._where_inside(self._gradient, x, np.nan)

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Return −d² log p/dx²."""
        return self._where_inside(self._curvature, x, np.nan)

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the inverse of the distribution function."""
        p = np.asarray(probability, dtype=float)
        low, high = self.support
        result = np.full(p.shape, np.nan)
        result[p == 0.0], result[p == 1.0] = low, high
        inside = (p > 0.0) & (p < 1.0)
        with np.errstate(over="ignore", divide="ignore"):  # of distributions wider than the numbers, to infinity
            result[inside] = self._quantile(p[inside])
        return result[()]

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws."""
        return self.quantile(generator.uniform(size=size))

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def _where_inside(self, function: Callable[[np.ndarray], Any], x: np.ndarray, outside: float) -> np.ndarray:
        low, high = self.support
        if np.ndim(x) == 0:
            # Not as an array without axes, with which everything takes several times as long.
            number: Any = np.float64(x)
            number = np.float64(function(number) if low < number < high else outside)
            return number
        x = np.ascontiguousarray(x, dtype=float)
        inside = (x > low) & (x < high)
        if np.count_nonzero(inside) == x.size:
            result = np.empty(x.shape)
            result[...] = function(x)
            return result
        result = np.full(x.shape, outside)
        result[inside] = function(x[inside])
        return result

    # Squares are products in the formulas: x**2 of a number and of an array may differ in the last bit.
    @abstractmethod
    def _log_density(self, x: np.ndarray) -> Any: ...

    @abstractmethod
    def _gradient(self, x: np.ndarray) -> Any: ...

    @abstractmethod
    def _curvature(self, x: np.ndarray) -> Any: ...

    @abstractmethod
    def _quantile(self, p: np.ndarray) -> np.ndarray: ...


def _bound(argument: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if math.isnan(number):
        raise ValueError(f"{argument}: must be a real number or infinite, got {value!r}.")
    return number


class _Positive(Univariate):
    support = (0.0, math.inf)


class _Interval(Univariate):
    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.low < self.high:
            raise ValueError(f"low: must be less than high = {self.high!r}, got {self.low!r}.")

    @property
    def support(self) -> tuple[float, float]:
        """The interval."""
        return self.low, self.high


@dataclass(frozen=True)
class Normal(Univariate):
    """The normal distribution, the paper's prior (de Kraker et al. 1997, section 3).

    Parameters
    ----------
    mean : float
        In the parameter's unit.
    sd : float
        > 0, in the same unit.

    Raises
    ------
    ValueError
        If the mean is not finite, or sd not finite and > 0.

    Examples
    --------
    >>> bp.Normal(mean=10.0, sd=2.0).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [6.71, 10.0, 13.29]
    """

    mean: float
    sd: float

    _arguments = {"mean": _checks.finite_number, "sd": _scale}

    def _log_density(self, x: np.ndarray) -> Any:
        score = (x - self.mean) / self.sd
        return -0.5 * (score * score) - (math.log(self.sd) + LOG_ROOT_TWO_PI)

    def _gradient(self, x: np.ndarray) -> Any:
        return -(x - self.mean) / self.sd**2

    def _curvature(self, x: np.ndarray) -> Any:
        return 1.0 / self.sd**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.mean + self.sd * special.ndtri(p)


@dataclass(frozen=True)
class LogNormal(_Positive):
    """The distribution of a positive number whose logarithm is normal.

    Parameters
    ----------
    median : float
        > 0, in the parameter's unit.
    spread : float
        Standard deviation of the logarithm, > 0.

    Raises
    ------
    ValueError
        If median or spread is not finite and > 0.

    Examples
    --------
    >>> bp.LogNormal(median=10.0, spread=0.5).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [4.394, 10.0, 22.76]
    """

    median: float
    spread: float

    _arguments = {"median": _checks.positive, "spread": _scale}

    def _log_density(self, x: np.ndarray) -> Any:
        logarithm = np.log(x)
        score = (logarithm - math.log(self.median)) / self.spread
        return -0.5 * (score * score) - logarithm - (math.log(self.spread) + LOG_ROOT_TWO_PI)

    def _gradient(self, x: np.ndarray) -> Any:
        return -(1.0 + self._score(x) / self.spread) / x

    def _curvature(self, x: np.ndarray) -> Any:
        return (1.0 / self.spread**2 - 1.0 - self._score(x) / self.spread) / x**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.median * np.exp(self.spread * special.ndtri(p))

    def _score(self, x: np.ndarray) -> np.ndarray:
        return (np.log(x) - math.log(self.median)) / self.spread


@dataclass(frozen=True)
class TruncatedNormal(_Interval):
    """The normal distribution within an interval, normalised there.

    The density is measured from the end of the interval next to the mean, so that it stays exact where the interval
    lies far in a tail.

    Parameters
    ----------
    mean : float
        Of the normal distribution, in the parameter's unit; it may lie outside the interval.
    sd : float
        Of the normal distribution, > 0, in the same unit.
    low, high : float
        low < high, in the same unit; either may be infinite.

    Raises
    ------
    ValueError
        If the mean is not finite, sd not finite and > 0, an end NaN, or low not below high.

    Examples
    --------
    >>> prior = bp.TruncatedNormal(mean=1.0, sd=2.0, low=0.0, high=float("inf"))
    >>> prior.support
    (0.0, inf)
    >>> prior.quantile([0.0, 0.5, 0.95]).round(3).tolist()
    [0.0, 1.794, 4.635]
    """

    mean: float
    sd: float
    low: float
    high: float

    _arguments = {"mean": _checks.finite_number, "sd": _scale, "low": _bound, "high": _bound}

    @cached_property
    def _tail(self) -> tuple[float, float, float, float]:
        """End of the interval next to the mean, direction into it, its distance to the mean and the width, in sd."""
        width = (self.high - self.low) / self.sd
        if self.mean <= self.low:
            return self.low, 1.0, (self.low - self.mean) / self.sd, width
        if self.mean >= self.high:
            return self.high, -1.0, (self.mean - self.high) / self.sd, width
        return self.mean, 1.0, 0.0, width

    @cached_property
    def _mass(self) -> float:
        """The integral of exp(−distance t − t²/2) over the interval."""
        _, _, distance, width = self._tail
        if self.low < self.mean < self.high:
            below, above = self._erf_of_ends
            return ROOT_HALF_PI * (above - below)
        return float(_tail_mass(distance, np.array(width)))

    @cached_property
    def _erf_of_ends(self) -> tuple[float, float]:
        low, high = (self.low - self.mean) / self.sd, (self.high - self.mean) / self.sd
        return math.erf(low / ROOT_TWO), math.erf(high / ROOT_TWO)

    def _log_density(self, x: np.ndarray) -> Any:
        end, direction, distance, _ = self._tail
        t = direction * (x - end) / self.sd
        return -t * (distance + 0.5 * t) - math.log(self._mass) - math.log(self.sd)

    def _gradient(self, x: np.ndarray) -> Any:
        return -(x - self.mean) / self.sd**2

    def _curvature(self, x: np.ndarray) -> Any:
        return 1.0 / self.sd**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        end, direction, distance, width = self._tail
        if self.low < self.mean < self.high:
            t = self._scores_about_the_mean(p)
        else:
            t = _tail_quantile(distance, width, self._mass, p if direction > 0.0 else 1.0 - p)
        return np.clip(end + direction * self.sd * t, self.low, self.high)

    def _scores_about_the_mean(self, p: np.ndarray) -> np.ndarray:
        below, above = self._erf_of_ends
        centre = (1.0 - p) * below + p * above
        left = special.ndtr((self.low - self.mean) / self.sd) + p * 0.5 * (above - below)
        right = special.ndtr((self.mean - self.high) / self.sd) + (1.0 - p) * 0.5 * (above - below)
        tails = np.where(centre < 0.0, special.ndtri(left), -special.ndtri(right))
        return np.where(np.abs(centre) < 0.5, ROOT_TWO * special.erfinv(centre), tails)


@dataclass(frozen=True)
class HalfNormal(_Positive):
    """The distribution of the modulus of a normal number of mean zero.

    Parameters
    ----------
    scale : float
        Standard deviation of the normal number, > 0, in the parameter's unit.

    Raises
    ------
    ValueError
        If the scale is not finite and > 0.

    Examples
    --------
    >>> bp.HalfNormal(scale=2.0).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [0.125, 1.349, 3.92]
    """

    scale: float

    _arguments = {"scale": _scale}

    def _log_density(self, x: np.ndarray) -> Any:
        score = x / self.scale
        return -0.5 * (score * score) + (math.log(2.0) - math.log(self.scale) - LOG_ROOT_TWO_PI)

    def _gradient(self, x: np.ndarray) -> Any:
        return -x / self.scale**2

    def _curvature(self, x: np.ndarray) -> Any:
        return 1.0 / self.scale**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.scale * ROOT_TWO * special.erfinv(p)


@dataclass(frozen=True)
class Uniform(_Interval):
    """The uniform distribution on an interval.

    Parameters
    ----------
    low, high : float
        low < high, in the parameter's unit.

    Raises
    ------
    ValueError
        If an end is not finite, or low not below high.

    Examples
    --------
    >>> bp.Uniform(low=2.0, high=4.0).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [2.1, 3.0, 3.9]
    """

    low: float
    high: float

    _arguments = {"low": _checks.finite_number, "high": _checks.finite_number}

    def _log_density(self, x: np.ndarray) -> Any:
        return -math.log(self.high - self.low)

    def _gradient(self, x: np.ndarray) -> Any:
        return 0.0

    def _curvature(self, x: np.ndarray) -> Any:
        return 0.0

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.low + (self.high - self.low) * p


@dataclass(frozen=True)
class LogUniform(_Interval):
    """The distribution on a positive interval whose logarithm is uniform: every decade is as probable as another.

    Its log-density is convex, so that it flattens the peak of a posterior instead of sharpening it.

    Parameters
    ----------
    low, high : float
        0 < low < high, in the parameter's unit.

    Raises
    ------
    ValueError
        If an end is not finite and > 0, or low not below high.

    Examples
    --------
    >>> bp.LogUniform(low=1.0, high=100.0).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [1.259, 10.0, 79.433]
    """

    low: float
    high: float

    _arguments = {"low": _checks.positive, "high": _checks.positive}

    @cached_property
    def _width(self) -> float:
        if self.high < 2.0 * self.low:
            return math.log1p((self.high - self.low) / self.low)
        return math.log(self.high) - math.log(self.low)

    def _log_density(self, x: np.ndarray) -> Any:
        return -np.log(x) - math.log(self._width)

    def _gradient(self, x: np.ndarray) -> Any:
        return -1.0 / x

    def _curvature(self, x: np.ndarray) -> Any:
        return -1.0 / x**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return np.clip(np.exp(math.log(self.low) + p * self._width), self.low, self.high)


@dataclass(frozen=True)
class StudentT(Univariate):
    """Student's t distribution, a bell with heavy tails: data may overrule it.

    Parameters
    ----------
    mean : float
        The centre, in the parameter's unit, also where dof ≤ 1 leaves it no mean.
    scale : float
        > 0, in the same unit; the standard deviation is scale · √(dof/(dof − 2)) where dof > 2.
    dof : float
        Degrees of freedom, > 0.

    Raises
    ------
    ValueError
        If the mean is not finite, or scale or dof not finite and > 0.

    Examples
    --------
    >>> bp.StudentT(mean=10.0, scale=2.0, dof=4.0).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [5.736, 10.0, 14.264]
    """

    mean: float
    scale: float
    dof: float

    _arguments = {"mean": _checks.finite_number, "scale": _scale, "dof": _scale}

    def _log_density(self, x: np.ndarray) -> Any:
        constant = special.betaln(0.5 * self.dof, 0.5) + 0.5 * math.log(self.dof) + math.log(self.scale)
        score = self._score(x)
        return -0.5 * (self.dof + 1.0) * np.log1p(score * score / self.dof) - constant

    def _gradient(self, x: np.ndarray) -> Any:
        score = self._score(x)
        return -(self.dof + 1.0) * score / (self.dof + score**2) / self.scale

    def _curvature(self, x: np.ndarray) -> Any:
        square = self._score(x) ** 2
        return (self.dof + 1.0) * (self.dof - square) / (self.dof + square) ** 2 / self.scale**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        # The density in the tail is a power of the distance; `stdtrit` of SciPy 1.17.1 is wrong there, or +inf.
        share = 2.0 / self.dof * (np.log(p * self.dof) + special.betaln(0.5 * self.dof, 0.5))
        tail = -np.exp(0.5 * (math.log(self.dof) - np.minimum(share, FAR_TAIL)))
        return self.mean + self.scale * np.where(share < FAR_TAIL, tail, special.stdtrit(self.dof, p))

    def _score(self, x: np.ndarray) -> np.ndarray:
        return (x - self.mean) / self.scale


@dataclass(frozen=True)
class InverseGamma(_Positive):
    """The distribution of the reciprocal of a gamma-distributed number, the conjugate prior of a variance.

    Parameters
    ----------
    shape : float
        > 0; the mean is scale/(shape − 1) where shape > 1.
    scale : float
        > 0, in the parameter's unit; the mode is scale/(shape + 1).

    Raises
    ------
    ValueError
        If shape or scale is not finite and > 0.

    Examples
    --------
    >>> bp.InverseGamma(shape=3.0, scale=2.0).quantile([0.05, 0.5, 0.95]).round(3).tolist()
    [0.318, 0.748, 2.446]
    """

    shape: float
    scale: float

    _arguments = {"shape": _checks.positive, "scale": _scale}

    def _log_density(self, x: np.ndarray) -> Any:
        constant = self.shape * math.log(self.scale) - math.lgamma(self.shape)
        return constant - (self.shape + 1.0) * np.log(x) - self.scale / x

    def _gradient(self, x: np.ndarray) -> Any:
        return (self.scale / x - (self.shape + 1.0)) / x

    def _curvature(self, x: np.ndarray) -> Any:
        return (2.0 * self.scale / x - (self.shape + 1.0)) / x**2

    def _quantile(self, p: np.ndarray) -> np.ndarray:
        return self.scale / special.gammainccinv(self.shape, p)


def _tail_mass(distance: float, t: np.ndarray) -> np.ndarray:
    """Return ∫₀ᵗ exp(−distance s − s²/2) ds for distance ≥ 0 to full relative precision."""
    t = np.asarray(t, dtype=float)
    exponent = t * (distance + 0.5 * t)
    short = np.where(exponent < 1.0, t, 0.0)[..., None]
    s = 0.5 * short * (1.0 + LEGENDRE_NODES)
    integral = 0.5 * short[..., 0] * (np.exp(-s * (distance + 0.5 * s)) @ LEGENDRE_WEIGHTS)
    end = special.erfcx((distance + t) / ROOT_TWO)
    long = ROOT_HALF_PI * (special.erfcx(distance / ROOT_TWO) - np.exp(-exponent) * end)
    return np.where(exponent < 1.0, integral, long)


def _tail_quantile(distance: float, width: float, mass: float, p: np.ndarray) -> np.ndarray:
    """Return t with `_tail_mass` p · mass; the mass is concave in t, so Newton from the left never oversteps."""
    t = p * mass
    for _ in range(100):
        with np.errstate(over="ignore"):
            step = (p * mass - _tail_mass(distance, t)) * np.exp(t * (distance + 0.5 * t))
        t = np.clip(t + step, 0.0, width)
        if np.all(np.abs(step) <= 4.0 * np.finfo(float).eps * t):
            break
    return t
