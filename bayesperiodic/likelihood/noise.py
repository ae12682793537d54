"""Noise models: what is assumed of the residuals, by name.

Every model gives each residual component its own variance V_j(φ), in a basis in which the components are independent:
Fourier components for whole periods. The log-likelihood is −½ Σ_j w_j [ln V_j + r_j²/V_j] with w_j independent values
per component. The noise parameters φ are positive, and densities are over their logarithms.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.priors.joint import as_prior
from bayesperiodic.priors.single import LogNormal, Prior

SPECTRAL, POINTS, CORRELATED, KNOWN = "spectral", "points", "correlated", "known"
SCALE = "scale"


@dataclass(frozen=True)
class Block:
    """Description of one vector of residual components.

    A `channel` is an output; "scale" for all section values of an experiment together, "multipliers" or "frequency".
    The `kind` is "spectral" for real Fourier components, which are independent and have variance v under white noise of
    variance v; "points" for values at the points of a mask; "correlated" for values whitened by their given covariance,
    up to one unknown factor; "known" for values in units of their known standard deviations.
    """

    experiment: str
    channel: str
    kind: str
    count: float  # independent values behind the components
    size: int  # number of components
    harmonic: np.ndarray  # (size,), of the response period, of each spectral component
    position: np.ndarray  # (size,), of each point, in response periods
    points: int  # grid points of the response period
    averaged: float  # measured samples behind the components
    measured: float  # variance of one value that the scatter of the cycles explains; NaN if unknown

    @property
    def weight(self) -> float:
        """Independent values per component."""
        return self.count / self.size

    @property
    def counted(self) -> bool:
        """Whether the variance is unknown, so that eq. (7) counts the values."""
        return self.kind != KNOWN


__all__ = ["Circulant", "Independent", "Measured", "Noise"]

CHANNEL, EXPERIMENT = "channel", "experiment"
JEFFREYS, FLAT = "jeffreys", "flat"
VARIANCE = "variance"

# A residual correlated over a few per cent of a period is what smooth model errors leave.
LENGTHSCALE = LogNormal(0.03, 1.5)
FLOOR = LogNormal(0.01, 2.0)


@dataclass(frozen=True)
class Noise(ABC):
    """What the noise models share.

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

    per: str = field(default=CHANNEL, kw_only=True)
    prior: Any = field(default=JEFFREYS, kw_only=True)

    name: ClassVar[str]
    flat: ClassVar[bool] = True
    needs_scatter: ClassVar[bool] = False

    @property
    def shape_priors(self) -> dict[str, Prior]:
        """The priors of the spectrum's parameters beyond the variance."""
        return {}

    def __post_init__(self) -> None:
        _checks.one_of("per", self.per, (CHANNEL, EXPERIMENT))
        if isinstance(self.prior, str):
            _checks.one_of("prior", self.prior, (JEFFREYS, FLAT))
            return
        prior = as_prior("prior", self.prior)
        if prior.support[0] < 0.0:
            raise ValueError(f"prior: must have positive support, as a variance has, got {self.prior!r}.")

    @property
    def proper(self) -> bool:
        """Whether the prior of a variance can be normalised."""
        return not isinstance(self.prior, str)

    @property
    def spare(self) -> int:
        """How many more values than free parameters the prior of a variance needs: the flat one diverges with two."""
        return 2 if self.prior == FLAT else 0

    @property
    def prior_text(self) -> str:
        """The prior of a variance in words."""
        return {JEFFREYS: "Jeffreys prior 1/v", FLAT: "flat prior"}.get(self.prior, f"prior {self.prior!r}")

    def check(self, blocks: Sequence[Block]) -> None:
        """Refuse data that this noise model cannot be used for.

        Parameters
        ----------
        blocks : sequence of Block
            The residual components of all channels of all experiments.

        Raises
        ------
        ValueError
            If a scatter that the model needs is unknown, or experiments on different grids share a correlation.
        """
        points: dict[str, int] = {}
        for block in (b for b in blocks if b.kind in (SPECTRAL, POINTS)):
            if self.needs_scatter and not block.measured > 0.0:
                raise ValueError(
                    f"noise: must be 'independent' without measured scatter, got {self.name!r}; experiment "
                    f"{block.experiment!r} has no scatter of {block.channel!r}. Give scatter and cycles."
                )
            if not self.flat and points.setdefault(self.label(block), block.points) != block.points:
                raise ValueError(
                    f"noise: must have per='experiment' for grids that differ, got {self.name!r}; experiments with "
                    f"{points[self.label(block)]} and {block.points} points in the response period share the "
                    f"correlation of {block.channel!r}. Or give all the same samples and periods."
                )

    def label(self, block: Block) -> str:
        """Return the text in brackets of the names of a block's noise parameters.

        Parameters
        ----------
        block : Block

        Returns
        -------
        str
            The channel, followed by the experiment where each has its own.
        """
        return block.channel if self.per == CHANNEL else f"{block.channel}, {block.experiment}"

    def parameter_names(self, block: Block) -> tuple[str, ...]:
        """Return the names of the noise parameters of a block.

        Parameters
        ----------
        block : Block

        Returns
        -------
        tuple of str
            The variance first; none where the errors are known.
        """
        if block.kind == KNOWN:
            return ()
        if block.kind == CORRELATED:
            return (SCALE if self.per == CHANNEL else f"{SCALE}[{block.experiment}]",)
        return tuple(f"{kind}[{self.label(block)}]" for kind in (VARIANCE, *self.shape_priors))

    def gain(self, block: Block) -> float:
        """Return the variance V that a variance v of 1 gives to the components of a block, if the spectrum is flat.

        Parameters
        ----------
        block : Block

        Returns
        -------
        float
        """
        return 1.0

    def level(self, value: np.ndarray, measured: Any) -> np.ndarray:
        """Return V of errors whose spectrum is flat.

        Parameters
        ----------
        value : array (…)
            The variance v [channel's unit squared], times `gain`.
        measured : float or array (…)
            What the scatter of the cycles explains of the variance of the mean period.

        Returns
        -------
        array (…)
        """
        return value

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
        variances : array (…, size)
            V_j of the residual components.
        slopes : array (…, size, parameters)
            ∂ ln V_j/∂ ln φ.
        """

    def covariance(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariance of the residuals at the points of a mask, and its derivatives.

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
        return np.diag(variances), np.stack([np.diag(variances * slope) for slope in slopes.T])

    def has_constant_prior(self, kind: str) -> bool:
        """Return whether `log_prior` of a kind of noise parameters is zero wherever they are.

        Parameters
        ----------
        kind : str
            "variance", "lengthscale" or "floor".

        Returns
        -------
        bool
        """
        return kind not in self.shape_priors and self.prior == JEFFREYS

    def log_prior(self, kind: str, value: np.ndarray, measured: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density of noise parameters over their logarithms, and its derivative.

        Parameters
        ----------
        kind : str
            "variance", "lengthscale" or "floor".
        value : array (…)
        measured : float or array (…)
            As in `level`.

        Returns
        -------
        log_density : array (…)
            Over ln φ; improper ones up to a constant.
        slope : array (…)
            By ln φ.
        """
        if kind in self.shape_priors:
            return _over_logarithm(self.shape_priors[kind], value)
        if self.has_constant_prior(kind):
            return np.zeros_like(value), np.zeros_like(value)
        if self.prior == FLAT:
            return np.log(value), np.ones_like(value)
        return _over_logarithm(self._proper_prior, value)

    def jeffreys_factor(self, block: Block, value: np.ndarray, added: np.ndarray) -> np.ndarray:
        """Return by what Jeffreys' prior of a variance is smaller where errors of the inputs add variances.

        With components of variances V + λ it is √(Σ 1/(V + λ)²), the root of the information, instead of 1/V; without
        it the density has no integral where errors of the inputs can explain all components.

        Parameters
        ----------
        block : Block
            One of those with this variance.
        value : array (…)
            The variance.
        added : array (components,)
            Variances λ that the inputs' errors add.

        Returns
        -------
        array (…)
            The logarithm.
        """
        total = self._mean_variance(block, value)[0][..., None]
        share = total / (total + added)
        return np.asarray(0.5 * np.log(np.add.reduce(share * share, axis=-1) / added.size))

    def jeffreys_slope(self, block: Block, value: np.ndarray, added: np.ndarray) -> np.ndarray:
        """Return the derivative of `jeffreys_factor` by the logarithm of the variance.

        Parameters
        ----------
        block, value, added
            As for `jeffreys_factor`.

        Returns
        -------
        array (…)
        """
        total, from_value = self._mean_variance(block, value)
        share = total[..., None] / (total[..., None] + added)
        slope = np.mean(share**2 * (1.0 - share), axis=-1) / np.mean(share**2, axis=-1)
        return np.asarray(slope * from_value / total)

    def _mean_variance(self, block: Block, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean variance (…,) of a block's components, and the part of it that the variance causes."""
        from_value = value * (self.gain(block) if self.flat else block.size / block.points)
        return self.level(from_value, block.measured) if block.kind != CORRELATED else from_value, from_value

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
        """Return V = v·N/M."""
        shape = (*values.shape[:-1], block.size)
        return np.broadcast_to(values[..., :1] * self.gain(block), shape), np.ones((*shape, 1))

    def gain(self, block: Block) -> float:
        """Return N/M, components over measured samples."""
        return block.size / block.averaged if block.kind in (SPECTRAL, POINTS) else 1.0


@dataclass(frozen=True)
class Measured(Noise):
    """Measurement noise known from the scatter of the cycles, plus an independent model error of unknown variance.

    V = scatter²/cycles + v, with the variance of the mean period that the fold found where there is one (corrected for
    correlation between cycles); v is the mean square of the model error over the period, which does not depend on the
    numbers of samples and cycles. Jeffreys' prior means 1/(V) here, which is 1/v for large model errors and proper
    towards v = 0.

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
        """Return V = scatter²/cycles + v."""
        shape = (*values.shape[:-1], block.size)
        total = np.broadcast_to(self.level(values[..., :1], block.measured), shape)
        return total, (values[..., :1] / total)[..., None]

    def level(self, value: np.ndarray, measured: Any) -> np.ndarray:
        """Return V = scatter²/cycles + v."""
        return value + measured

    def has_constant_prior(self, kind: str) -> bool:
        """Return False: Jeffreys' prior is not constant over ln v here."""
        return False

    def log_prior(self, kind: str, value: np.ndarray, measured: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density over ln v; Jeffreys' is that of 1/(measured + v)."""
        if self.prior != JEFFREYS:
            return super().log_prior(kind, value, measured)
        known = np.where(np.asarray(measured) > 0.0, measured, 0.0)
        share = np.where(known > 0.0, value / (known + value), 1.0)
        return np.log(share), 1.0 - share


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
    flat: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        _checks.one_of("kernel", self.kernel, ("matern", "exponential"))

    @property
    def shape_priors(self) -> dict[str, Prior]:
        """The priors of the spectrum's shape."""
        shape: dict[str, Prior] = {"lengthscale": LENGTHSCALE}
        return shape | ({"floor": FLOOR} if self.kernel == "matern" else {})

    def spectrum(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return V = v·S_h·N/n, S with mean 1 over the harmonics of the grid."""
        variances, slopes = self._spectrum(block.harmonic, block.points, values)
        return variances * (block.size / block.points), slopes

    def covariance(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v·Σ_h S_h cos(2πh(t_i − t_j))/n at the points of a mask."""
        harmonic = np.minimum(np.arange(block.points), block.points - np.arange(block.points))
        variances, slopes = self._spectrum(harmonic, block.points, values)
        point = np.rint(block.position * block.points).astype(int)
        by_lag = np.fft.ifft(np.vstack([variances, slopes.T * variances])).real
        found = by_lag[:, np.abs(point[:, None] - point[None, :])]
        return found[0], found[1:]

    def _spectrum(self, harmonic: np.ndarray, points: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v·S at harmonics and its logarithmic slopes, S with mean 1 over a grid of points."""
        on_grid = np.arange(points // 2 + 1)
        repeated = np.where((on_grid == 0) | (2 * on_grid == points), 1.0, 2.0) / points
        power, slope = self._kernel_spectrum(on_grid, values)
        mean = np.sum(repeated * power, axis=-1, keepdims=True)
        mean_slope = np.sum(repeated * power * slope, axis=-1, keepdims=True) / mean
        power, slope = self._kernel_spectrum(harmonic, values)
        power, slope = power / mean, slope - mean_slope
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


NAMED: dict[str, type[Noise]] = {model.name: model for model in (Independent, Measured, Circulant)}


def as_noise(given: str | Noise) -> Noise:
    """Return a noise model from its name or itself."""
    if isinstance(given, Noise):
        return given
    if not isinstance(given, str):
        raise ValueError(f"noise: must be a name or a model such as noise.Independent(), got {given!r}.")
    _checks.one_of("noise", given, NAMED)
    return NAMED[given]()


def _over_logarithm(prior: Prior, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a prior's log-density over ln x, and its derivative by ln x."""
    return prior.log_prob(value) + np.log(value), prior.gradient(value) * value + 1.0
