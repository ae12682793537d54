"""Vectors of residual components, and what the kinds of data have in common.

A kind of data is a subclass of `Block` in a file of its own, listed in `kinds.KINDS`. It says how a response is
compared with the data of an experiment, and what the noise model must know of the components.
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.models.model import Model

# Slopes of a variance that is proportional to the only noise parameter, and of variances that are known.
PROPORTIONAL, NO_PARAMETERS = np.ones((1, 1)), np.ones((1, 0))


NO_SCALE = np.zeros(())


class ComparedSignals(NamedTuple):
    """What is compared: responses, their differences from the data, or derivatives along directions."""

    values: np.ndarray  # (…, points, channels) of the measured channels, turned and delayed
    log_multipliers: np.ndarray  # (…, multipliers), log|μ|, largest first
    frequency: np.ndarray  # (…,) [Hz]
    scale: np.ndarray = NO_SCALE  # (…,) of an input, where that is an unknown


def _nothing() -> np.ndarray:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class Block(ABC):
    """One vector of residual components of an experiment; here of values in units of their known standard deviations.

    A `channel` is an output; "scale" for all section values of an experiment together, or the name of what was measured
    besides the outputs, such as "multipliers".
    """

    experiment: str
    channel: str
    count: float  # independent values behind the components
    size: int  # number of components
    harmonic: np.ndarray = field(default_factory=_nothing)  # (size,), of the response period, of Fourier components
    position: np.ndarray = field(default_factory=_nothing)  # (points compared,), in response periods
    points: int = 0  # grid points of the response period
    averaged: float = 1.0  # measured samples behind the components
    measured: float = float("nan")  # variance of one value that the scatter of the cycles explains; NaN if unknown
    spectrum_measured: np.ndarray = field(default_factory=_nothing)  # (size,), of each Fourier component, if known
    mean_square: float = 1.0  # of the measured channel about its mean
    place: int = 0  # of the channel among the measured ones
    log_scale: float = 0.0  # ln|∂ components/∂ data| of values that are divided by known standard deviations

    words: ClassVar[str] = "{0.size} values of {0.channel}"  # what is compared, a format of the block
    of_each: ClassVar[tuple[str, ...]] = ()  # fields in which blocks differ that are alike
    observed: ClassVar[bool] = True  # whether the components are measured values
    timed: ClassVar[bool] = False  # whether the components are values of one channel along the period
    spectral: ClassVar[bool] = False  # whether they are Fourier components of one channel

    @property
    def counted(self) -> bool:
        """Whether the variance is unknown, so that eq. (7) counts the values."""
        return False

    @classmethod
    @abstractmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Any]":
        """Return the blocks of this kind that an experiment has, none if it has no data of this kind."""

    @abstractmethod
    def compare(self, predicted: ComparedSignals, difference: ComparedSignals) -> np.ndarray:
        """Return the components (…, size) of data minus prediction; the difference has angles within half a turn."""

    @abstractmethod
    def changes(self, predicted: ComparedSignals, directions: ComparedSignals) -> np.ndarray:
        """Return the derivatives (directions, size) of the predicted components at one prediction."""

    @abstractmethod
    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the derivatives of Σ weights · predicted components by one prediction to the arrays of `total`.

        Of blocks with a `layout` those of several experiments are added at once, without the prediction.
        """

    def errors(self, signals: ComparedSignals) -> np.ndarray:
        """Return the components (…, size) of errors of the outputs, zero if another instrument measured them."""
        return np.zeros((*signals.values.shape[:-2], self.size))

    def simulate(self, components: np.ndarray, errors: np.ndarray) -> None:  # noqa: B027
        """Fill in the errors (draws, points, channels) of the outputs with these components (draws, size)."""

    @cached_property
    def at(self) -> np.ndarray:
        """Indices on the grid of the points in `position`, (points compared,)."""
        return np.rint(self.position * self.points).astype(int)

    @property
    def weight(self) -> float:
        """Independent values per component."""
        return self.count / self.size if self.counted else 1.0

    @property
    def description(self) -> str:
        """What is compared, in words."""
        return self.words.format(self)

    @property
    def layout(self) -> Hashable:
        """What blocks have in common whose experiments are compared all at once; None if they are not."""
        return None

    @property
    def alike_in(self) -> tuple[Hashable, ...] | None:
        """What blocks without a `layout` have in common that are compared all at once; None if they are not."""
        return None

    @classmethod
    def stacked(cls, blocks: "Sequence[Block]") -> "Block":
        """Return blocks that are alike as one, for signals (blocks, solves, points, channels)."""
        each = {name: np.stack([getattr(b, name) for b in blocks]) for name in cls.of_each}
        fields: dict[str, Any] = {name: x.reshape(len(blocks), 1, -1) for name, x in each.items() if x.size}
        return replace(blocks[0], **fields)

    def through_sensor(self, sensing: Any, components: np.ndarray, values: Any, frequency: Any) -> np.ndarray:
        """Return components (…, size) as a sensor with parameters (…, names) shows them, of blocks with a `layout`."""
        raise NotImplementedError

    def through_sensor_vjp(
        self, sensing: Any, shown: np.ndarray, values: np.ndarray, frequency: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of Σ weights · `through_sensor`, whose result is `shown`, by components and values."""
        raise NotImplementedError

    def parameter_names(self, noise: Any) -> tuple[str, ...]:
        """Return the names of the noise parameters under a noise model, the variance first."""
        return ()

    def alike(self, noise: Any) -> Hashable:
        """Return what `spectrum` depends on besides the values and the number of components."""
        return None

    def spectrum(self, noise: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return variances and slopes at values (…, parameters), see `Noise.spectrum`."""
        return np.ones((*values.shape[:-1], 1)), NO_PARAMETERS

    def mean_variance(self, noise: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean variance (…,) of the components, and the part that is proportional to the parameter."""
        return values[..., 0], values[..., 0]

    def is_dense(self, noise: Any) -> bool:
        """Return whether the components are correlated under a noise model."""
        return False

    def whole_period(self) -> "Block | None":
        """Return the same with the harmonics of all values of the period; None if the block is of no time history."""
        return None

    def places(self, even: bool, dense: bool) -> tuple[str, np.ndarray, str]:
        """Return what the independent parts are called, the number of each component's part, and the end of the name.

        `even` if all components have the same variance, `dense` if they are correlated.
        """
        return self.channel, np.arange(self.size), ""

    def independent(self, r: np.ndarray, even: bool) -> np.ndarray:
        """Return components (…, size) as the independent values that `places` names."""
        return r

    def by_instants(self, even: bool) -> bool:
        """Return whether the independent parts of Fourier components are values at instants."""
        return even

    def along_period(self, part: np.ndarray) -> np.ndarray:
        """Return components (…, size) as waves along the period, those of `wave_numbers`."""
        return part

    @property
    def wave_numbers(self) -> np.ndarray:
        """The waves along the period, (size,), in half-periods of cosines where there are no harmonics."""
        return (np.arange(self.size) + 1) // 2


class LinearBlock(Block):
    """A kind of data whose components are a linear function of what is predicted."""

    @abstractmethod
    def components(self, moved: ComparedSignals) -> np.ndarray:
        """Return the components (…, size) of differences or derivatives."""

    def compare(self, predicted: ComparedSignals, difference: ComparedSignals) -> np.ndarray:
        """Return the components of the difference."""
        return self.components(difference)

    def changes(self, predicted: ComparedSignals, directions: ComparedSignals) -> np.ndarray:
        """Return the components of the derivatives."""
        return self.components(directions)

    def errors(self, signals: ComparedSignals) -> np.ndarray:
        """Return the components of errors."""
        return self.components(signals)


class Timed(LinearBlock):
    """Values of one output along the period, whose variance is a noise parameter."""

    timed: ClassVar[bool] = True
    words: ClassVar[str] = "{0.channel}"

    @property
    def counted(self) -> bool:
        """True: the variance is a noise parameter."""
        return True

    def parameter_names(self, noise: Any) -> tuple[str, ...]:
        """Return the variance and the parameters of the spectrum's shape."""
        channel = noise.pooled or self.channel
        label = f"{channel}, {self.experiment}" if noise.separate else channel
        return tuple(f"{kind}[{label}]" for kind in ("variance", *noise.shape_priors))

    def alike(self, noise: Any) -> Hashable:
        """Return what the noise model's spectrum depends on."""
        return noise.alike(self)

    def spectrum(self, noise: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the spectrum of the noise model."""
        return noise.spectrum(self, values)

    def mean_variance(self, noise: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return those of the noise model."""
        return noise._mean_variance(self, values)


def common(experiment: Experiment, channel: str, place: int = 0, **more: Any) -> dict[str, Any]:
    """Return what blocks of outputs have in common: names, grid, averaged samples and measured variance; and `more`."""
    e = experiment
    averaged = e.averaged or e.cycles * int(e.measured_points.sum())
    return {
        "experiment": e.name,
        "channel": channel,
        "points": e.measured_points.size,
        "averaged": float(averaged),
        "measured": measured_variance(e, channel),
        "mean_square": float(np.var(e.outputs[channel][e.measured_points])) if channel in e.outputs else 1.0,
        "place": place,
        **more,
    }


def measured_channels(experiment: Experiment, model: Model) -> tuple[str, ...]:
    """Return the outputs with a measured time history, in the order of the model."""
    return tuple(channel for channel in model.outputs if channel in experiment.outputs)


def compared_channels(experiment: Experiment, model: Model) -> tuple[str, ...]:
    """Return these, and then the other outputs of which something was measured."""
    histories, every = measured_channels(experiment, model), experiment.channels
    return *histories, *(c for c in model.outputs if c in every and c not in histories)


def measured_variance(experiment: Experiment, channel: str) -> float:
    """Return the variance of one value of the mean period that the scatter of the cycles explains; NaN if unknown."""
    if channel in experiment.amplitude_variance:
        variance = np.array(experiment.amplitude_variance[channel])
        variance[[h for h in experiment.unmeasured.get(channel, ()) if h < variance.size]] = 0.0
        return float(variance[0] + 0.5 * np.sum(variance[1:]))
    if channel in experiment.scatter:
        return float(experiment.scatter[channel] ** 2 / experiment.cycles)
    return float("nan")


def times(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return matrix · row of rows (…, size), row by row: the rounding of one product may depend on their number."""
    return (matrix @ rows[..., None])[..., 0]
