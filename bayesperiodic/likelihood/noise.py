"""Noise models: what is assumed of the residuals, by name.

Every model gives each residual component its own variance V_j(φ), in a basis in which the components are independent:
Fourier components for whole periods. The log-likelihood is −½ Σ_j w_j [ln V_j + r_j²/V_j] with w_j independent values
per component. The noise parameters φ are positive, and densities are over their logarithms.
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.likelihood.block import PROPORTIONAL, Block
from bayesperiodic.priors.joint import as_prior
from bayesperiodic.priors.single import LogNormal, Prior

__all__ = ["Circulant", "Independent", "Measured", "Noise", "Relative"]

PER_CHANNEL, PER_EXPERIMENT = "channel", "experiment"
JEFFREYS, FLAT_PRIOR = "jeffreys", "flat"
VARIANCE = "variance"

# A residual correlated over a few per cent of a period is what smooth model errors leave.
LENGTHSCALE = LogNormal(0.03, 1.5)
FLOOR = LogNormal(0.01, 2.0)


@dataclass(frozen=True)
class Noise(ABC):
    """What the noise models share.

    A noise model is a subclass with a `name` and `spectrum`, the variances of the Fourier components of whole periods.
    Where these differ, values at the points of a mask also need `covariance`.

    Parameters
    ----------
    per : "channel" or "experiment"
        Whether a channel has the same noise parameters in all experiments, or its own in each.
    prior : "jeffreys", "flat", a prior with positive support, or a frozen scipy.stats distribution
        Of each variance: Jeffreys' 1/v, a constant density of v, or a proper one.

    Raises
    ------
    ValueError
        For another ``per``, or a prior that is none of these.

    Examples
    --------
    Every noise model has a name, which a `Problem` takes in its place, and a prior of its variances:

    >>> models = bp.noise.Independent(), bp.noise.Measured(), bp.noise.Circulant(prior=bp.InverseGamma(3, 2))
    >>> {noise.name: noise.prior_text for noise in models if isinstance(noise, bp.noise.Noise)}["circulant"]
    'prior InverseGamma(shape=3.0, scale=2.0)'
    """

    per: str = field(default=PER_CHANNEL, kw_only=True)
    prior: Any = field(default=JEFFREYS, kw_only=True)

    name: ClassVar[str]
    needs_scatter: ClassVar[bool] = False
    pooled: ClassVar[str] = ""  # name of the parameters in place of a channel's, if all channels have the same

    def unit(self, block: Block) -> float:
        """Return the part of one value's variance that is proportional to the parameter, for a parameter of 1.

        Parameters
        ----------
        block : Block

        Returns
        -------
        float
        """
        return 1.0

    @property
    def shape_priors(self) -> dict[str, Prior]:
        """The priors of the spectrum's parameters beyond the variance."""
        return {}

    @property
    def separate(self) -> bool:
        """Whether each experiment has its own noise parameters."""
        return self.per == PER_EXPERIMENT

    def __post_init__(self) -> None:
        _checks.one_of("per", self.per, (PER_CHANNEL, PER_EXPERIMENT))
        if isinstance(self.prior, str):
            _checks.one_of("prior", self.prior, (JEFFREYS, FLAT_PRIOR))
            return
        prior = as_prior("prior", self.prior)
        if prior.support[0] < 0.0:
            raise ValueError(f"prior: must have positive support, as a variance has, got {self.prior!r}.")
        object.__setattr__(self, "prior", prior)  # one of scipy.stats prints its address instead of its numbers

    @property
    def proper(self) -> bool:
        """Whether the prior of a variance can be normalised."""
        return not isinstance(self.prior, str)

    @property
    def spare(self) -> int:
        """How many more values than free parameters the prior of a variance needs: the flat one diverges with two."""
        return 2 if self.prior == FLAT_PRIOR else 0

    @property
    def prior_text(self) -> str:
        """The prior of a variance in words."""
        return {JEFFREYS: "Jeffreys prior 1/v", FLAT_PRIOR: "flat prior"}.get(self.prior, f"prior {self.prior!r}")

    def check(self, blocks: Sequence[Block]) -> None:
        """Refuse data that this noise model cannot be used for.

        Parameters
        ----------
        blocks : sequence of Block
            The residual components of all channels of all experiments.

        Raises
        ------
        ValueError
            If a scatter that the model needs is unknown.
        """
        for block in (b for b in blocks if b.timed):
            if self.needs_scatter and not block.measured > 0.0:
                raise ValueError(
                    f"noise: must be 'independent' without measured scatter, got {self.name!r}; experiment "
                    f"{block.experiment!r} has no scatter of {block.channel!r}. Give scatter and cycles."
                )

    def parameter_names(self, block: Block) -> tuple[str, ...]:
        """Return the names of the noise parameters of a block.

        Parameters
        ----------
        block : Block

        Returns
        -------
        tuple of str
            The variance first, each with the channel in brackets, followed by the experiment where each has its own
            noise; none where the errors are known.
        """
        return block.parameter_names(self)

    @abstractmethod
    def spectrum(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances of the residual components of a block, and their derivatives.

        Parameters
        ----------
        block : Block
        values : array (…, parameters)
            Of the block's noise parameters, the variance first.

        Returns
        -------
        variances : array (…, size) or (…, 1)
            V_j of the residual components; one where they are all the same, as those of white noise.
        slopes : array (…, size, parameters) or (…, 1, parameters)
            ∂ ln V_j/∂ ln φ. The leading axes may be missing where they do not depend on the values.
        """

    def alike(self, block: Block) -> Hashable:
        """Return what `spectrum` depends on besides the values: blocks with equal keys are evaluated together.

        Parameters
        ----------
        block : Block

        Returns
        -------
        hashable
            By default every block has its own spectrum.
        """
        return block.experiment, block.channel

    def covariance(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariance of the residuals at the points of a mask, and its derivatives.

        It is used only by models that override it; others take the values of a channel as independent, with the
        variances of `spectrum`.

        Parameters
        ----------
        block : Block
        values : array (parameters,)
            Of the block's noise parameters, the variance first.

        Returns
        -------
        covariance : array (size, size)
        slopes : array (parameters, size, size)
            By ln φ.
        """
        variances, slopes = self.spectrum(block, values)
        every = np.broadcast_to(variances, block.size)
        return np.diag(every), np.stack([np.diag(every * slope) for slope in slopes.T])

    @property
    def constant_prior(self) -> bool:
        """Whether `log_prior` of a variance is zero wherever it is."""
        return self.prior == JEFFREYS

    def support(self, kind: str) -> tuple[float, float]:
        """Return the ends of the prior's support of a noise parameter.

        Parameters
        ----------
        kind : str
            See `log_prior`.

        Returns
        -------
        low, high : float
        """
        if kind not in self.shape_priors and not self.proper:
            return 0.0, np.inf
        return (self.shape_priors[kind] if kind in self.shape_priors else self._proper_prior).support

    def log_prior(self, kind: str, value: np.ndarray, measured: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density of noise parameters over their logarithms, and its derivative.

        Parameters
        ----------
        kind : str
            "variance", "lengthscale" or "floor".
        value : array (…)
        measured : float or array (…)
            What the scatter of the cycles explains of the variance of the mean period.

        Returns
        -------
        log_density : array (…)
            Over ln φ; improper ones up to a constant.
        slope : array (…)
            By ln φ.
        """
        if kind in self.shape_priors:
            return _over_logarithm(self.shape_priors[kind], value)
        if self.constant_prior:
            return np.zeros_like(value), np.zeros_like(value)
        if self.prior == FLAT_PRIOR:
            return np.log(value), np.ones_like(value)
        return _over_logarithm(self._proper_prior, value)

    def log_prior_of_total(self, kind: str, value: np.ndarray, measured: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density of which the estimate is the maximum, over other coordinates than `log_prior`'s.

        Parameters
        ----------
        kind, value, measured
            See `log_prior`.

        Returns
        -------
        log_density, slope : array (…)
            By default those of `log_prior`, over ln φ. A variance that is added to a measured one has its maximum over
            ln φ above zero, whatever the data.
        """
        return self.log_prior(kind, value, measured)

    def _mean_variance(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean variance (…,) of a block's components, and the part that is proportional to the parameter."""
        variances, slopes = self.spectrum(block, values)
        return variances.mean(axis=-1), (variances * slopes[..., 0]).mean(axis=-1)

    @cached_property
    def _proper_prior(self) -> Prior:
        return as_prior("prior", self.prior)


@dataclass(frozen=True)
class Independent(Noise):
    """Independent, identically distributed errors of unknown variance, the paper's model.

    Each channel has one unknown variance v ([1]_, eq. 6-7), that of the error of one measured sample [channel's unit
    squared]: a property of the sensor, whose noise is white with the spectral density 2·v/sampling rate. Averaged over
    M samples and kept as N components (2·harmonics + 1 with whole periods), the mean period has the variance V = v·N/M
    at each instant, so that every harmonic has the same variance, whatever the number of harmonics kept. If
    every sample is an independent value, V = v, and the density is that of eq. (6).

    Parameters
    ----------
    per, prior
        See `Noise`.

    Raises
    ------
    ValueError
        For another ``per``, or a prior that is none of these.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> bp.noise.Independent(per="experiment").prior_text
    'Jeffreys prior 1/v'
    """

    name: ClassVar[str] = "independent"

    def spectrum(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return V = v·N/M, components over measured samples."""
        return values * (block.size / block.averaged), PROPORTIONAL

    def alike(self, block: Block) -> Hashable:
        """Return N/M."""
        return block.size / block.averaged


@dataclass(frozen=True)
class Measured(Noise):
    """Measurement noise known from the scatter of the cycles, plus an independent model error of unknown variance.

    V = scatter²/cycles + v. Where the fold measured the variance of every harmonic beside the harmonics, that takes the
    place of scatter²/cycles, smoothed over neighbouring harmonics; v is the mean square of the model error over the
    period, which does not depend on the numbers of samples and cycles. Jeffreys' prior means 1/(V) here, which is 1/v
    for large model errors and proper towards v = 0.

    The estimate of v is its maximum over ln(scatter²/cycles + v), in which this prior is flat: zero where the residual
    is no larger than the measured noise. Intervals then follow from the measured variances and their degrees of
    freedom, otherwise from the values that determine v. Draws take the measured variances for exact, and contain all v
    that prior and data allow: without a model error 90 % intervals of draws contain the truth in 99, 96 and 94 % for 3,
    11 and 29 more values than parameters.

    Parameters
    ----------
    per, prior
        See `Noise`; the prior is that of the model error's variance.

    Raises
    ------
    ValueError
        For another ``per``, or a prior that is none of these.

    Examples
    --------
    >>> bp.noise.Measured().name
    'measured'
    """

    name: ClassVar[str] = "measured"
    needs_scatter: ClassVar[bool] = True

    def spectrum(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return V = measured variance + v."""
        total = values + (block.spectrum_measured if block.spectrum_measured.size else block.measured)
        return total, (values / total)[..., None]

    def alike(self, block: Block) -> Hashable:
        """Return the measured variances."""
        return block.measured, block.spectrum_measured.tobytes()

    @property
    def constant_prior(self) -> bool:
        """False: Jeffreys' prior is not constant over ln v here."""
        return False

    def log_prior(self, kind: str, value: np.ndarray, measured: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density over ln v; Jeffreys' is that of 1/(measured + v)."""
        if self.prior != JEFFREYS:
            return super().log_prior(kind, value, measured)
        share = _share(value, measured)
        return np.log(share), 1.0 - share

    def log_prior_of_total(self, kind: str, value: np.ndarray, measured: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density over ln(measured + v), in which Jeffreys' prior is flat."""
        share = _share(value, measured)
        density, slope = self.log_prior(kind, value, measured)
        return density - np.log(share), slope - (1.0 - share)


@dataclass(frozen=True)
class Relative(Measured):
    """Measurement noise known from the scatter of the cycles, plus one relative model error of all channels.

    V = scatter²/cycles + ρ²·m, with m the mean square of the measured channel about its mean, in each experiment, and
    ρ² the only noise parameter, ``variance[relative]``. With `Measured` every channel has its own model error: if the
    model is wrong, a fit may reproduce one channel to the measurement noise and leave the error to another. Here all
    channels are reproduced to about the same fraction.

    Parameters
    ----------
    per, prior
        See `Noise`; the prior is that of ρ².

    Raises
    ------
    ValueError
        For another ``per``, or a prior that is none of these.

    Examples
    --------
    >>> bp.noise.Relative().name
    'relative'
    """

    name: ClassVar[str] = "relative"
    pooled: ClassVar[str] = "relative"

    def check(self, blocks: Sequence[Block]) -> None:
        """Refuse unknown scatter, and points of a channel that do not vary."""
        super().check(blocks)
        for block in (b for b in blocks if b.timed and not b.mean_square > 0.0):
            raise ValueError(
                f"noise: must be 'measured' or 'independent' for points at which a channel does not vary, got "
                f"{self.name!r}; the error of the model cannot be relative to {block.channel!r} of experiment "
                f"{block.experiment!r}, whose mask has {block.size} points of one value."
            )

    def unit(self, block: Block) -> float:
        """Return the mean square of the channel."""
        return block.mean_square

    def spectrum(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return V = measured variance + ρ²·m."""
        return super().spectrum(block, values * block.mean_square)

    def alike(self, block: Block) -> Hashable:
        """Return the measured variances and the mean square."""
        return super().alike(block), block.mean_square


@dataclass(frozen=True)
class Circulant(Noise):
    """Errors that are correlated along the period and stationary on the circle.

    Their covariance depends on the distance of two points alone, so that Fourier components are independent, with
    V_h = v·S_h·N/n: v is the variance of the error at each instant, all harmonics included, S the spectrum of the
    kernel with mean 1 over all harmonics of the grid of n points, and N the number of components that are kept. Both
    kernels become white noise as the correlation length goes to zero. This is exact for noise that repeats with the
    period, and to O(1/K) for the mean of K cycles of a stationary process. Values at the points of a mask take the
    dense covariance.

    Parameters
    ----------
    kernel : "matern" or "exponential"
        "matern": once differentiable errors (Matérn, ν = 3/2, [1]_) over a white floor, S ∝ (3 + (2πhℓ)²)⁻² + floor;
        for smooth model errors under measurement noise. "exponential": a first-order autoregressive process in
        continuous time, S ∝ 1/(1 + (2πhℓ)²).
    per : "channel" or "experiment"
    prior : "jeffreys", "flat" or a prior
        Of the variance. The correlation length ℓ, as a fraction of the response period, has the prior
        LogNormal(0.03, 1.5); the floor, as a multiple of the correlated part's variance, LogNormal(0.01, 2).

    Raises
    ------
    ValueError
        For another ``kernel`` or ``per``, or a prior that is none of these.

    References
    ----------
    .. [1] C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press, 2006, section 4.2.

    Examples
    --------
    >>> bp.noise.Circulant(kernel="exponential").shape_priors
    {'lengthscale': LogNormal(median=0.03, spread=1.5)}
    """

    kernel: str = field(default="matern", kw_only=True)

    name: ClassVar[str] = "circulant"

    def __post_init__(self) -> None:
        super().__post_init__()
        _checks.one_of("kernel", self.kernel, ("matern", "exponential"))

    @property
    def shape_priors(self) -> dict[str, Prior]:
        """The priors of the spectrum's shape."""
        shape: dict[str, Prior] = {"lengthscale": LENGTHSCALE}
        return shape | ({"floor": FLOOR} if self.kernel == "matern" else {})

    def check(self, blocks: Sequence[Block]) -> None:
        """Refuse experiments on different grids that share a correlation, see `Noise.check`."""
        super().check(blocks)
        points: dict[str, int] = {}
        for block in (b for b in blocks if b.timed):
            if (other := points.setdefault(self.parameter_names(block)[0], block.points)) != block.points:
                raise ValueError(
                    f"noise: must have per='experiment' for grids that differ, got {self.name!r}; experiments with "
                    f"{other} and {block.points} points in the response period share the correlation of "
                    f"{block.channel!r}. Or give all the same samples and periods."
                )

    def _mean_variance(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v·N/n twice, the mean over all harmonics of the grid."""
        variance = values[..., 0] * (block.size / block.points)
        return variance, variance

    def alike(self, block: Block) -> Hashable:
        """Return the grid and the harmonics."""
        return block.points, block.harmonic.tobytes()

    def spectrum(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return V = v·S_h·N/n, S with mean 1 over the harmonics of the grid."""
        variances, slopes = self._spectrum(block.points, values, block.harmonic)
        return variances * (block.size / block.points), slopes

    def covariance(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v·Σ_h S_h cos(2πh(t_i − t_j))/n at the points of a mask."""
        harmonic = np.minimum(np.arange(block.points), block.points - np.arange(block.points))
        variances, slopes = self._spectrum(block.points, values, harmonic)
        by_lag = np.fft.ifft(np.vstack([variances, slopes.T * variances])).real
        matrix = by_lag[:, np.abs(block.at[:, None] - block.at)]
        return matrix[0], matrix[1:]

    def _spectrum(self, points: int, values: np.ndarray, harmonic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v·S at harmonics and its logarithmic slopes, S with mean 1 over a grid of points."""
        on_grid, repeated = _harmonics_of_grid(points)
        power, slope = self._kernel_spectrum(on_grid, values)
        mean = np.sum(repeated * power, axis=-1, keepdims=True)
        mean_slope = np.sum(repeated * power * slope, axis=-1, keepdims=True) / mean
        power, slope = (power / mean).take(harmonic, axis=-1), (slope - mean_slope).take(harmonic, axis=-1)
        if self.kernel == "exponential":
            return values[..., :1] * power, np.stack([np.ones_like(slope), slope], axis=-1)
        floor = values[..., 2:3]
        total = power + floor
        slopes = [np.ones_like(slope), slope * power / total, floor / total - floor / (1.0 + floor)]
        return values[..., :1] * total / (1.0 + floor), np.stack(slopes, axis=-1)

    def _kernel_spectrum(self, harmonic: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the kernel's spectrum up to a factor, and its logarithmic slope by the correlation length."""
        square = (2 * np.pi * harmonic * values[..., 1:2]) ** 2
        if self.kernel == "exponential":
            return 1.0 / (1.0 + square), -2.0 * square / (1.0 + square)
        return (3.0 + square) ** -2, -4.0 * square / (3.0 + square)


@lru_cache
def _harmonics_of_grid(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the harmonics of a grid, and the fraction of its components that each has."""
    on_grid = np.arange(points // 2 + 1)
    return on_grid, np.where((on_grid == 0) | (2 * on_grid == points), 1.0, 2.0) / points


NAMED: dict[str, type[Noise]] = {model.name: model for model in (Independent, Measured, Relative, Circulant)}


def as_noise(given: str | Noise) -> Noise:
    """Return a noise model from its name or itself."""
    if isinstance(given, Noise):
        return given
    if not isinstance(given, str):
        raise ValueError(f"noise: must be a name or a model such as noise.Independent(), got {given!r}.")
    _checks.one_of("noise", given, NAMED)
    return NAMED[given]()


def _share(value: np.ndarray, measured: Any) -> np.ndarray:
    """Return the share of a variance in the sum with the measured one, 1 where that is not known."""
    known = np.where(np.asarray(measured) > 0.0, measured, 0.0)
    return np.where(known > 0.0, value / (known + value), 1.0)


def _over_logarithm(prior: Prior, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a prior's log-density over ln x, and its derivative by ln x."""
    return prior.log_prob(value) + np.log(value), prior.gradient(value) * value + 1.0
