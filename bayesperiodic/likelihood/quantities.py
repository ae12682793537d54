"""Amplitudes, phases and sizes that an instrument shows in place of a time history."""

import math
from abc import abstractmethod
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy.special import chndtrix, i0e, i1e, ndtr

from bayesperiodic import _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.measurements import Amplitude, Measurement, PeakToPeak, Phase, RootMeanSquare
from bayesperiodic.likelihood.block import (
    NO_PARAMETERS,
    PROPORTIONAL,
    Block,
    ComparedSignals,
    common,
    compared_channels,
    times,
)
from bayesperiodic.models.model import Model

TWO_PI = 2.0 * math.pi
# Standard deviations from the likeliest amplitude within which its density is that of a normal distribution.
NEARLY_NORMAL = 1e-4
# Amplitude in standard deviations from which on Rice's distribution is normal to a thousandth of them.
LARGEST_RICE = 30.0
# Points of a wave's finest harmonic at which its extremes are looked for, and Newton steps from there.
POINTS_A_WAVE, EXTREME_STEPS = 16, 4


@dataclass(frozen=True, eq=False)
class Quantities(Block):
    """Values of one kind and channel, of known standard deviations, by which they are divided, or of an unknown one."""

    values: np.ndarray = field(default_factory=lambda: np.empty(0))  # (size,) measured
    known: np.ndarray = field(default_factory=lambda: np.empty(0))  # (size,) standard deviations; empty if unknown

    kind: ClassVar[type[Measurement]]
    words: ClassVar[str] = "{0.channel}"
    of_each: ClassVar[tuple[str, ...]] = "values", "known"

    @classmethod
    def of(cls, experiment: Experiment, model: Model) -> "list[Any]":
        """Return a block for each channel that has measurements of this kind."""
        channels: dict[str, list[Any]] = {}
        for one in experiment.measurements:
            if type(one) is cls.kind:
                channels.setdefault(one.channel, []).append(one)
        return [cls._of_channel(experiment, model, given) for given in channels.values()]

    @classmethod
    def _of_channel(cls, experiment: Experiment, model: Model, given: list[Any]) -> "Quantities":
        first, size = given[0], len(given)
        values = np.array([one.value for one in given])
        known = np.empty(0) if first.sd is None else np.array([one.sd for one in given])
        # A relative error of a phase is one of the complex amplitude, in rad.
        mean_square = 1.0 if first.signed else float(np.mean(values**2))
        more: dict[str, Any] = {"values": values, "known": known, **cls.arguments(experiment, model, given)}
        if known.size:
            more |= {"count": 0.0, "log_scale": cls.normalisation(values, known)}
        else:
            more |= {"count": float(size), "mean_square": mean_square, "measured": 0.0}
        place = compared_channels(experiment, model).index(first.channel)
        return cls(**{**common(experiment, first.label, place, size=size), "averaged": float(size), **more})

    @classmethod
    def arguments(cls, experiment: Experiment, model: Model, given: list[Any]) -> dict[str, Any]:
        """Return further fields of the block of these measurements."""
        return {}

    @classmethod
    def normalisation(cls, values: np.ndarray, sds: np.ndarray) -> float:
        """Return the log-density of the values less that of the components, ln N(0, 1) each."""
        return -float(np.sum(np.log(sds)))

    @abstractmethod
    def quantity(self, values: np.ndarray) -> np.ndarray:
        """Return the quantities (…, size) of signals (…, points, channels)."""

    @abstractmethod
    def slopes(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the place of a channel and the derivatives (size, points) of the quantities at signals (points, …)."""

    def difference(self, predicted: np.ndarray) -> np.ndarray:
        """Return measured less predicted quantities (…, size), in their unit."""
        return self.values - predicted

    def off(self, values: np.ndarray) -> np.ndarray:
        """Return `difference` for signals (…, points, channels)."""
        return self.difference(self.quantity(values))

    @property
    def unit(self) -> np.ndarray:
        """What the differences are divided by: the standard deviations if these are known, else one."""
        return self.known if self.known.size else np.ones(self.size)

    def shown(self, predicted: np.ndarray) -> np.ndarray:
        """Return the components (…, size) of data less prediction."""
        return self.difference(predicted) / self.unit

    def steepness(self, predicted: np.ndarray) -> np.ndarray:
        """Return the derivatives (size,) of predicted components, those of `shown` with the other sign."""
        return 1.0 / self.unit

    def replicate(self, values: np.ndarray, components: np.ndarray) -> np.ndarray:
        """Return possible measurements (draws, size) of signals (draws, points, channels), with errors (draws, size).

        The errors are normal, with variance 1 where the standard deviation is known.
        """
        return self.quantity(values) + components * self.unit

    @property
    def alike_in(self) -> tuple[Hashable, ...]:
        """Channel, number of values and points, and whether the standard deviations are known."""
        return type(self), self.place, self.size, self.points, self.counted

    @property
    def sizes(self) -> np.ndarray:
        """The measured values (size,) as components, of phases one radian."""
        return (np.ones(self.size) if self.kind.signed else self.values) / self.unit

    @property
    def counted(self) -> bool:
        """Whether the standard deviation is unknown."""
        return not self.known.size

    def compare(self, predicted: ComparedSignals, difference: ComparedSignals) -> np.ndarray:
        """Return measured less predicted quantities."""
        return self.shown(self.quantity(predicted.values))

    def _slopes(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        steep = self.steepness(self.quantity(values))[:, None]
        for place, slopes in self.slopes(values):
            yield place, steep * slopes

    def changes(self, predicted: ComparedSignals, directions: ComparedSignals) -> np.ndarray:
        """Return the derivatives of the quantities along directions."""
        pairs = self._slopes(predicted.values)
        return np.sum([directions.values[..., place] @ slopes.T for place, slopes in pairs], axis=0)

    def add_vjp(self, predicted: Any, weights: np.ndarray, total: ComparedSignals) -> None:
        """Add the transposed derivatives."""
        for place, slopes in self._slopes(predicted.values):
            total.values[..., place] += weights @ slopes

    def parameter_names(self, noise: Any) -> tuple[str, ...]:
        """Return the variance, unless the standard deviations are known."""
        if self.known.size:
            return ()
        name = noise.pooled or (f"{self.channel}, {self.experiment}" if noise.separate else self.channel)
        return (f"variance[{name}]",)

    def alike(self, noise: Any) -> Any:
        """Return what the variance is proportional to, and whether it is known."""
        return self.counted, noise.unit(self)

    def spectrum(self, noise: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance, one for all values."""
        if self.known.size:
            return np.ones((*values.shape[:-1], 1)), NO_PARAMETERS
        return values * noise.unit(self), PROPORTIONAL

    def places(self, even: bool, dense: bool) -> tuple[str, np.ndarray, str]:
        """Return the values by their number."""
        return self.channel, np.arange(self.size), ""


@dataclass(frozen=True, eq=False)
class OfHarmonics(Quantities):
    """Quantities of single harmonics."""

    lines: np.ndarray = field(default_factory=lambda: np.empty(0))  # (size,), harmonic of the response period

    @classmethod
    def arguments(cls, experiment: Experiment, model: Model, given: list[Any]) -> dict[str, Any]:
        """Return the harmonics; a ValueError is raised if the grid has too few points for them."""
        lines, points = np.array([one.harmonic for one in given]), experiment.measured_points.size
        if lines.max() > _fourier.highest_harmonic(points):
            raise ValueError(
                f"samples of experiment {experiment.name!r}: must be at least {2 * lines.max() + 1} in the response "
                f"period for harmonic {lines.max()} of {given[0].channel!r}, got {points}."
            )
        return {"lines": lines}

    @property
    def alike_in(self) -> tuple[Hashable, ...]:
        """The harmonics too."""
        return *super().alike_in, tuple(self.lines.tolist())

    @cached_property
    def _waves(self) -> np.ndarray:
        """What the complex amplitudes are sums with, (size, points)."""
        at = np.arange(self.points) / self.points
        return np.exp(-1j * TWO_PI * np.outer(self.lines, at)) * (2.0 / self.points)

    @cached_property
    def _real_waves(self) -> np.ndarray:
        return np.concatenate([self._waves.real, self._waves.imag])

    def amplitudes(self, signal: np.ndarray) -> np.ndarray:
        """Return the complex amplitudes (…, size) of signals (…, points)."""
        parts = times(self._real_waves, signal)
        return parts[..., : self.size] + 1j * parts[..., self.size :]


@dataclass(frozen=True, eq=False)
class Amplitudes(OfHarmonics):
    """Moduli of harmonics; with known standard deviations the components are signed roots of Rice's deviance."""

    kind: ClassVar[type[Measurement]] = Amplitude

    @classmethod
    def normalisation(cls, values: np.ndarray, sds: np.ndarray) -> float:
        """Return the log-density of Rice's distribution at its maximum over the true amplitude."""
        a = values / sds
        best = np.array([likeliest_amplitude(one) for one in a])
        return float(np.sum(np.log(a / sds) + _rice(a, best) + 0.5 * math.log(TWO_PI)))

    def quantity(self, values: np.ndarray) -> np.ndarray:
        """Return the moduli."""
        return np.abs(self.amplitudes(values[..., self.place]))

    def slopes(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the derivatives, zero at a modulus of zero."""
        c = self.amplitudes(values[..., self.place])
        unit = np.conj(c) / np.maximum(np.abs(c), np.finfo(float).tiny)
        yield self.place, np.real(unit[:, None] * self._waves)

    def replicate(self, values: np.ndarray, components: np.ndarray) -> np.ndarray:
        """Return amplitudes with the distribution of Rice if the standard deviations are known."""
        if not self.known.size:
            return np.abs(super().replicate(values, components))
        true = self.quantity(values) / self.known
        far = np.minimum(true, LARGEST_RICE)
        small = np.sqrt(np.maximum(chndtrix(ndtr(components), 2.0, far**2), 0.0))
        normal = true + components + 0.5 / np.maximum(true, 1.0)
        return np.where(true < LARGEST_RICE, small, normal) * self.known

    @cached_property
    def _likeliest(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Measured and likeliest amplitudes in standard deviations, root of the curvature, log-density there."""
        a = self.values / self.known
        best = np.vectorize(likeliest_amplitude, otypes=[float])(a)
        ratio = np.where(a * best > 0.0, _bessel_ratio(a * best) / np.maximum(a * best, np.finfo(float).tiny), 0.5)
        curvature = 1.0 - a**2 * (1.0 - ratio - (ratio * a * best) ** 2)
        return a, best, np.sqrt(np.maximum(curvature, 0.0)), _rice(a, best)

    def shown(self, predicted: np.ndarray) -> np.ndarray:
        """Return the signed roots of the deviance, which are nearly normal with variance 1."""
        if not self.known.size:
            return super().shown(predicted)
        a, best, root, top = self._likeliest
        off = best - predicted / self.known
        deviance = 2.0 * np.maximum(top - _rice(a, best - off), 0.0)
        return np.where(np.abs(off) < NEARLY_NORMAL, root * off, np.copysign(np.sqrt(deviance), off))

    def steepness(self, predicted: np.ndarray) -> np.ndarray:
        """Return the derivatives of the roots."""
        if not self.known.size:
            return super().steepness(predicted)
        a, best, root, _ = self._likeliest
        here, r = predicted / self.known, self.shown(predicted)
        near = np.abs(best - here) < NEARLY_NORMAL
        slope = a * _bessel_ratio(a * here) - here
        return np.where(near, root, slope / np.where(near | (r == 0.0), 1.0, r)) / self.known


@dataclass(frozen=True, eq=False)
class RelativePhases(OfHarmonics):
    """Phases of harmonics against those of other channels, within half a turn of the measured ones."""

    against: tuple[int, ...] = ()  # place of the other channel, -1 for an input
    of_inputs: np.ndarray = field(default_factory=lambda: np.empty(0))  # (size,), phase of the input

    kind: ClassVar[type[Measurement]] = Phase
    of_each: ClassVar[tuple[str, ...]] = "values", "known", "of_inputs"

    @classmethod
    def arguments(cls, experiment: Experiment, model: Model, given: list[Any]) -> dict[str, Any]:
        """Return the harmonics, and phases of inputs."""
        result = super().arguments(experiment, model, given)
        channels, against, of_inputs = compared_channels(experiment, model), [], []
        for one in given:
            against.append(channels.index(one.to) if one.to in channels else -1)
            phase = 0.0
            if one.to not in channels:
                c = _fourier.coefficients(experiment.inputs[one.to], one.harmonic)[one.harmonic]
                if not abs(c) > 1e-9 * np.abs(experiment.inputs[one.to]).max(initial=0.0):
                    raise ValueError(
                        f"measurements of experiment {experiment.name!r}: must be phases against an input that has "
                        f"harmonic {one.harmonic}, got {one.to!r} without it."
                    )
                phase = float(np.angle(c))
            of_inputs.append(phase)
        return {**result, "against": tuple(against), "of_inputs": np.array(of_inputs)}

    @property
    def alike_in(self) -> tuple[Hashable, ...]:
        """What the phases are against too."""
        return *super().alike_in, self.against

    def _ratios(self, values: np.ndarray) -> Iterator[tuple[np.ndarray, int, np.ndarray]]:
        """Yield the amplitudes (…, size) of the channel, then of others, their place and which entries they are of."""
        yield self.amplitudes(values[..., self.place]), self.place, np.ones(self.size)
        for place in sorted({one for one in self.against if one >= 0}):
            yield self.amplitudes(values[..., place]), place, -1.0 * (np.array(self.against) == place)

    def quantity(self, values: np.ndarray) -> np.ndarray:
        """Return the phases."""
        return sum((sign * np.angle(c) for c, _, sign in self._ratios(values)), -self.of_inputs)

    def difference(self, predicted: np.ndarray) -> np.ndarray:
        """Return the differences within half a turn."""
        return _fourier.within_half_turn(self.values - predicted)

    def slopes(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the derivatives by the channel, and by the others."""
        for c, place, sign in self._ratios(values):
            size = np.maximum(np.abs(c), np.finfo(float).tiny)
            yield place, np.imag((sign * np.conj(c) / size**2)[:, None] * self._waves)


@dataclass(frozen=True, eq=False)
class RootMeanSquares(Quantities):
    """Root mean squares about the mean."""

    kind: ClassVar[type[Measurement]] = RootMeanSquare

    def quantity(self, values: np.ndarray) -> np.ndarray:
        """Return the root mean square."""
        return values[..., self.place].std(axis=-1)[..., None]

    def slopes(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the derivative."""
        signal = values[..., self.place]
        about = signal - signal.mean()
        yield self.place, about[None] / (self.points * max(float(signal.std()), np.finfo(float).tiny))


@dataclass(frozen=True, eq=False)
class PeakToPeaks(Quantities):
    """Ranges of the trigonometric polynomial through the points."""

    kind: ClassVar[type[Measurement]] = PeakToPeak

    def quantity(self, values: np.ndarray) -> np.ndarray:
        """Return the range."""
        return peak_to_peak(values[..., self.place])[..., None]

    def slopes(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the derivative, the weights that interpolate at the extremes."""
        total, at = np.zeros(self.points), np.arange(self.points) / self.points
        orders = np.arange(1, _fourier.highest_harmonic(self.points) + 1)
        for sign in (1.0, -1.0):
            where = _extreme(values[..., self.place], sign)[0]
            waves = np.cos(TWO_PI * np.outer(orders, where - at)).sum(axis=0)
            total += sign * (1.0 + 2.0 * waves) / self.points
        yield self.place, total[None]


def peak_to_peak(signal: np.ndarray) -> np.ndarray:
    """Return the range (…,) of the trigonometric polynomials through signals (…, points)."""
    return _extreme(signal, 1.0)[1] + _extreme(signal, -1.0)[1]


def _extreme(signal: np.ndarray, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Return place (…,) in periods and value of the largest value of sign · signals (…, points)."""
    c = sign * _fourier.coefficients(signal)
    orders, fine = np.arange(c.shape[-1]), POINTS_A_WAVE * c.shape[-1]
    at = np.argmax(_fourier.on_grid(c, fine), axis=-1) / fine
    for _ in range(EXTREME_STEPS):
        waves = c * np.exp(1j * TWO_PI * orders * at[..., None])
        slope = np.real(np.sum(1j * TWO_PI * orders * waves, axis=-1))
        curve = np.real(np.sum((1j * TWO_PI * orders) ** 2 * waves, axis=-1))
        with np.errstate(invalid="ignore", divide="ignore"):
            step = np.where(curve < 0.0, -slope / curve, 0.0)
        at = at + np.clip(step, -0.5 / fine, 0.5 / fine)
    return at, np.real(np.sum(c * np.exp(1j * TWO_PI * orders * at[..., None]), axis=-1))


def _bessel_ratio(x: np.ndarray) -> np.ndarray:
    """Return I₁(x)/I₀(x)."""
    return i1e(x) / i0e(x)


def _rice(a: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the log-density of amplitudes in standard deviations, less ln a."""
    with np.errstate(invalid="ignore"):
        return -0.5 * (a - true) ** 2 + np.log(i0e(a * true))


def likeliest_amplitude(measured: float) -> float:
    """Return the true amplitude that makes a measured one likeliest, both in standard deviations."""
    from scipy.optimize import brentq

    if measured**2 <= 2.0:
        return 0.0
    low = 1e-3 * math.sqrt(measured**2 - 2.0)
    return float(brentq(lambda true: measured * _bessel_ratio(measured * true) - true, low, measured, xtol=1e-15))
