"""From a periodic response to what is compared with one experiment, and the derivatives of that."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import (
    NO_SCALE,
    Block,
    ComparedSignals,
    compared_channels,
    measured_channels,
    measured_variance,
)
from bayesperiodic.likelihood.kinds import blocks_of
from bayesperiodic.likelihood.likelihood import Residuals
from bayesperiodic.likelihood.quantities import Quantities
from bayesperiodic.likelihood.sensing import Sensing, SensorNames
from bayesperiodic.models.model import Model

# Outputs (numbers) from which on their comparison with the data is shared among the cores.
SMALLEST_SHARED = 10_000
NONE = np.empty(0)


class Response(NamedTuple):
    """Response of a model in one experiment, or its derivatives along directions on the leading axis."""

    outputs: np.ndarray  # (…, points, channels), in the order of the model's outputs
    frequency: np.ndarray  # (…,) [Hz]
    log_multipliers: np.ndarray  # (…, multipliers), log|μ|, largest first, as many as were measured
    sensors: np.ndarray  # (…, names) of the sensors' parameters, the delay of all outputs [s] last
    scale: np.ndarray = NO_SCALE  # (…,) of an input, where that is an unknown


class GroupSolution(NamedTuple):
    """Solutions of experiments that are solved together, at several θ."""

    outputs: np.ndarray  # (experiments, solves, points, channels), in the order of the model's outputs
    frequency: np.ndarray  # (experiments, solves) [Hz]
    parameters: np.ndarray  # (experiments, solves, parameters) of the model
    sensors: np.ndarray  # (experiments, solves, names) of the sensors, the delay of all outputs last
    log_multipliers: list[np.ndarray]  # (solves, multipliers) of each experiment, log|μ|, largest first
    z: np.ndarray  # (experiments, solves, points, states), periodic parts of the states
    status: np.ndarray  # int (experiments, solves), index into `compiled.STATUSES`
    scale: np.ndarray  # (experiments, solves) of an input, where that is an unknown, else 1

    def response(self, members: Any, solves: Any = ...) -> Response:
        """Return the responses of one experiment (an index), θ on the leading axis; of several without multipliers."""
        at = members, solves
        multipliers = self.log_multipliers[members][solves] if isinstance(members, int) else np.empty(0)
        return Response(self.outputs[at], self.frequency[at], multipliers, self.sensors[at], self.scale[at])

    def at(self, solves: Any) -> "GroupSolution":
        """Return the solutions at some of the θ."""
        return GroupSolution(
            self.outputs[:, solves],
            self.frequency[:, solves],
            self.parameters[:, solves],
            self.sensors[:, solves],
            [values[solves] for values in self.log_multipliers],
            self.z[:, solves],
            self.status[:, solves],
            self.scale[:, solves],
        )


class Simulation:
    """Solutions of all experiments at several θ; `status` (solves,) is the worst code of the experiments."""

    def __init__(self, groups: Sequence[GroupSolution], places: Mapping[str, tuple[int, int]]):
        self.groups, self._places = groups, places
        worst = [np.maximum.reduce(group.status) for group in groups]
        self.status = worst[0] if len(worst) == 1 else np.maximum.reduce(worst)

    def at(self, solves: Any) -> "Simulation":
        """Return the solutions at some of the θ (a mask or indices)."""
        return Simulation([group.at(solves) for group in self.groups], self._places)

    def response(self, experiment: str) -> Response:
        """Return the responses of an experiment, θ on the leading axis."""
        group, member = self._places[experiment]
        return self.groups[group].response(member)

    def z(self, experiment: str) -> np.ndarray:
        """Return the periodic parts (solves, points, states) of an experiment, if they were kept."""
        group, member = self._places[experiment]
        return self.groups[group].z[member]

    def statuses(self, experiment: str) -> np.ndarray:
        """Return the status codes (solves,) of an experiment."""
        group, member = self._places[experiment]
        return self.groups[group].status[member]


class Observation:
    """Comparison of a response with one experiment.

    Outputs pass through their sensors and are compared with the data (angles modulo 2π), each kind of data as its
    `Block` says. The orbit of an autonomous model, whose phase is free, is first turned until the first harmonics of
    its measured outputs agree best with those of the data.

    Attributes
    ----------
    channels : tuple of str
        Those with a measured time history, in the order of the model's outputs.
    compared_channels : tuple of str
        These, and then the others of which something was measured.
    picked : slice or list of int
        The indices of all compared channels among the model's outputs, a slice, which does not copy, where they are
        consecutive.
    angles : list of bool
        Which of the channels are angles.
    blocks : tuple of Block
        The data of the experiment, one entry a vector of components.
    sensing : Sensing
    multipliers : int
        The number of Floquet multipliers that are compared.
    data : array (points, channels)
    caused : list of array (size,), optional
        What the expected errors of the inputs cause in the components of each block, see `input_noise`.
    """

    def __init__(
        self, experiment: Experiment, model: Model, sensors: SensorNames, caused: Sequence[np.ndarray] | None = None
    ):
        self.experiment, self.caused = experiment, caused
        self.channels, self.blocks = measured_channels(experiment, model), blocks_of(experiment, model)
        self.compared_channels = compared_channels(experiment, model)
        columns = [model.outputs.index(channel) for channel in self.compared_channels]
        between = slice(columns[0], columns[-1] + 1) if columns else slice(0, 0)
        self.picked = between if columns == list(range(between.start, between.stop)) else columns
        self.angles = [c in model.angles and c in self.channels for c in self.compared_channels]
        self._angle_places = [c for c, angle in enumerate(self.angles) if angle]
        self._free_phase = model.autonomous and bool(self.channels)
        self.sensing = Sensing(self.compared_channels, sensors, experiment.periods, delayed=model.autonomous)
        histories = [experiment.outputs[channel] for channel in self.channels]
        self.data = np.reshape(histories, (len(histories), experiment.measured_points.size)).T
        logarithms = np.log(np.abs(experiment.measured_multipliers))
        self._measured = ComparedSignals(self.data, logarithms, np.array(experiment.frequency))
        self._points = len(self.data)
        self._ramp = np.arange(self._points)[:, None] / self._points
        self._harmonic = np.arange(self._points // 2 + 1.0)
        self.multipliers = logarithms.size

    @property
    def whole(self) -> bool:
        """Whether the outputs were measured along the whole period."""
        return bool(self.experiment.measured_points.all())

    def residuals(self, response: Response) -> list[np.ndarray]:
        """Return the residual components, one array (…, size) a block."""
        measured, predicted = self._measured, self._signals(response)
        difference = ComparedSignals(
            self._difference(predicted.values),
            measured.log_multipliers - predicted.log_multipliers,
            measured.frequency - predicted.frequency,
            measured.scale - predicted.scale,
        )
        return self._less_caused([block.compare(predicted, difference) for block in self.blocks])

    def _less_caused(self, components: list[np.ndarray]) -> list[np.ndarray]:
        """Return the components without what the expected errors of the inputs caused."""
        return components if self.caused is None else [a - b for a, b in zip(components, self.caused, strict=True)]

    def data_components(self) -> list[np.ndarray]:
        """Return the components (size,) of the measured values, without what errors of the inputs caused."""
        return self._less_caused(self.errors(self.data))

    @cached_property
    def measured_rate(self) -> np.ndarray:
        """Derivative (points, channels) of the measured outputs by their phase [per response period]."""
        trend = self._trend(self.data)
        spectrum = np.fft.rfft(self.data - trend * self._ramp, axis=0)
        spectrum *= self._at_nyquist(2j * np.pi * self._harmonic[:, None])
        return np.fft.irfft(spectrum, n=self._points, axis=0) + trend

    def errors(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the components (…, size) of errors of the measured values (…, points, channels), an array a block."""
        shape = values.shape[:-2]
        signals = ComparedSignals(values, np.zeros((*shape, self.multipliers)), np.zeros(shape))
        return [block.errors(signals) for block in self.blocks]

    @cached_property
    def layout(self) -> tuple[Hashable, ...] | None:
        """What experiments have in common that are compared all at once; None where there is more to compare."""
        layouts = tuple(block.layout for block in self.blocks)
        if self._free_phase or any(self.angles) or None in layouts:
            return None
        return *layouts, self.sensing.layout

    @cached_property
    def alike_in(self) -> tuple[Hashable, ...] | None:
        """What experiments without a `layout` have in common that are compared all at once; None if they are not."""
        alike = [block.alike_in for block in self.blocks]
        if self.caused is not None or self._free_phase or self.sensing.active or not alike or None in alike:
            return None
        return *alike, self.compared_channels

    def changes(self, response: Response, directions: Response) -> list[np.ndarray]:
        """Return the derivatives of the predicted components along directions, one array (directions, size) a block."""
        predicted, moved = self._signals(response), directions.outputs[..., self.picked]
        if self.sensing.active:
            moved = self._sensed_changes(moved, response, directions)
        along = ComparedSignals(moved, directions.log_multipliers, directions.frequency, directions.scale)
        return [block.changes(predicted, along) for block in self.blocks]

    def vjp(self, response: Response, weights: list[np.ndarray], shown: Sequence[np.ndarray]) -> Response:
        """Return the derivatives of Σ weights · predicted components by everything in a forced model's response.

        Where there is a `layout`, response and weights may be of several experiments, on the leading axis, and `shown`
        are the predicted components.
        """
        outputs, sensors = np.zeros(response.outputs.shape), np.zeros(response.sensors.shape)
        by = ComparedSignals(outputs[..., self.picked], np.zeros(self.multipliers), np.zeros(()))
        if self.layout is not None:
            given = response.sensors, response.frequency
            for block, weight, components in zip(self.blocks, weights, shown, strict=True):
                if self.sensing.active:
                    weight, by_sensors = block.through_sensor_vjp(self.sensing, components, *given, weight)
                    sensors += by_sensors
                block.add_vjp(None, weight, by)
            outputs[..., self.picked] = by.values
            return Response(outputs, by.frequency, by.log_multipliers, sensors)
        predicted = self._signals(response)
        for block, weight in zip(self.blocks, weights, strict=True):
            block.add_vjp(predicted, weight, by)
        values = by.values
        if self.sensing.active:
            values, sensors = self._sensed_vjp(values, response)
        outputs[..., self.picked] = values
        return Response(outputs, by.frequency, by.log_multipliers, sensors)

    def predicted(self, response: Response) -> dict[str, np.ndarray]:
        """Return ŷ (…, points) of each measured channel, as its sensor shows it."""
        return dict(zip(self.channels, np.moveaxis(self._histories(response), -1, 0), strict=True))

    def replicates(self, response: Response, components: list[np.ndarray]) -> dict[str, np.ndarray]:
        """Return possible measurements, ŷ plus noise (draws, points), by channel; NaN outside the mask.

        The response has draws on its leading axis, the noise one array (draws, size) a block. Angles are within half a
        turn of the data.
        """
        noise = np.full((len(components[0]), *self.data.shape), np.nan)
        if self.caused is not None:
            components = [a + b for a, b in zip(components, self.caused, strict=True)]
        for block, component in zip(self.blocks, components, strict=True):
            block.simulate(component, noise)
        values = self._histories(response) + noise
        turned = self.data - _fourier.within_half_turn(self.data - values)
        return {n: (turned if self.angles[c] else values)[..., c] for c, n in enumerate(self.channels)}

    def replicated(self, response: Response, components: list[np.ndarray]) -> dict[str, np.ndarray]:
        """Return possible values (draws, size) of what was measured without a time history, see `replicates`."""
        values, pairs = self._signals(response).values, zip(self.blocks, components, strict=True)
        return {b.channel: b.replicate(values, part) for b, part in pairs if isinstance(b, Quantities)}

    def compared(self, response: Response, ahead: int = 0) -> dict[str, np.ndarray]:
        """Return y − ŷ (points,) of each channel, within the harmonics kept and zero where nothing was measured.

        ŷ is taken a number of forcing periods `ahead`.
        """
        predicted = np.roll(self._signals(response).values, -ahead * self.experiment.samples, axis=-2)
        pairs = zip(self.channels, np.moveaxis(self._difference(predicted), -1, 0), strict=True)
        return {channel: self.experiment.compared(channel, e) for channel, e in pairs}

    def quantities(self, response: Response) -> dict[str, np.ndarray]:
        """Return measured less predicted values (size,) of what was measured without a time history, by its label."""
        values = self._signals(response).values
        return {b.channel: b.off(values) for b in self.blocks if isinstance(b, Quantities)}

    def left_out(self, response: Response) -> dict[str, np.ndarray]:
        """Return measured less predicted amplitudes (harmonics,) of the harmonics left out, by channel with any."""
        without = self.experiment.left_out
        predicted, result = self._signals(response).values, {}
        for place, channel in enumerate(self.channels):
            if channel in without:
                above = np.zeros(without[channel].harmonic.max() + 1, dtype=complex)
                above[without[channel].harmonic] = without[channel].amplitude
                e = self.data[:, place] + _fourier.on_grid(above, self._points) - predicted[:, place]
                e = _fourier.within_half_turn(e) if self.angles[place] else e
                result[channel] = _fourier.coefficients(e)[without[channel].harmonic]
        return result

    def _histories(self, response: Response) -> np.ndarray:
        """Return the prediction (…, points, channels) of the measured time histories."""
        return self._signals(response).values[..., : len(self.channels)]

    def _signals(self, response: Response) -> ComparedSignals:
        """Return the prediction of what was measured, the outputs turned and passed through their sensors."""
        values = response.outputs[..., self.picked]
        if self.sensing.active:
            values = self._sensed(values, response)
        return ComparedSignals(values, response.log_multipliers, response.frequency, response.scale)

    def _difference(self, predicted: np.ndarray) -> np.ndarray:
        """Return y − ŷ (…, points, channels), angles within half a turn."""
        values = self.data - predicted[..., : len(self.channels)]
        for c in self._angle_places:
            values[..., c] = _fourier.within_half_turn(values[..., c])
        return values

    def _phase(self, response: Response) -> np.ndarray | None:
        """Return by what fraction (…,) of the response period the orbit of an autonomous model is turned."""
        if not self._free_phase:
            return None
        amplitudes = self._fundamentals(response)
        reference = self._reference
        # In real numbers: the rounding of NumPy's complex products depends on how many there are.
        cosine = np.sum(amplitudes.real * reference.real - amplitudes.imag * reference.imag, axis=-1)
        sine = np.sum(amplitudes.real * reference.imag + amplitudes.imag * reference.real, axis=-1)
        return np.arctan2(sine, cosine) / (2 * np.pi)

    def _fundamentals(self, response: Response) -> np.ndarray:
        """Return the complex amplitude of the first harmonic that each channel would show, (…, channels)."""
        bare = _fourier.coefficients(np.moveaxis(response.outputs[..., self.picked], -1, -2), 1)[..., 1]
        return self._own_factors(response)[0] * bare

    def _own_factors(self, response: Response) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors (…, channels) of the first harmonic without the common delay, and their slopes by all.

        The slopes (parameters + 1, channels) are those at one response, the frequency last.
        """
        return self.sensing.first_harmonic(response.sensors, response.frequency)

    @cached_property
    def _reference(self) -> np.ndarray:
        """What multiplies the channels' fundamentals, so that the angle of the sum is by how much they are behind.

        With the variances of the measurement, where they are known, it is the likeliest phase; one channel's phase
        alone would bring its noise into all others. Angles, which may wind, have no part in it unless there is nothing
        else.
        """
        histories, others = len(self.channels), len(self.compared_channels) - len(self.channels)
        noise = np.array([measured_variance(self.experiment, channel) for channel in self.channels])
        known = bool(np.all(np.isfinite(noise) & (noise > 0.0)))
        weights = 1.0 / (noise if known else self.data.var(axis=0))
        angles = np.array(self.angles[:histories])
        weights[angles & ~angles.all()] = 0.0
        return np.append(weights * np.conj(_fourier.coefficients(self.data.T, 1)[:, 1]), np.zeros(others))

    def _phase_changes(self, response: Response, directions: Response) -> np.ndarray:
        """Return the derivatives (directions,) of the turn of an autonomous model's orbit along directions."""
        first, slopes = self._own_factors(response)
        wave = np.exp(-2j * np.pi * self._ramp[:, 0]) * 2.0 / self._points
        bare = wave @ response.outputs[..., self.picked]
        moved = np.einsum("n,dnc->dc", wave, directions.outputs[..., self.picked]) * first
        moved += (_with_frequency(directions) @ slopes) * bare
        agreement = np.sum(bare * first * self._reference)
        return np.imag(moved @ self._reference / agreement) / (2 * np.pi)

    def _factors(self, response: Response) -> np.ndarray:
        """Return what multiplies the harmonics of the channels, complex (…, harmonics, channels)."""
        return self._at_nyquist(self._factors_between(response))

    def _factors_between(self, response: Response) -> np.ndarray:
        """Return the factors before that of the Nyquist harmonic is made real."""
        phase, result = self._phase(response), []
        for c in range(len(self.compared_channels)):
            factors = self.sensing.factors(c, response.sensors, response.frequency, self._harmonic, phase=phase)
            result.append(np.ones(self._harmonic.size) if factors is None else factors.complex)
        return np.stack(np.broadcast_arrays(*result), axis=-1)

    def _at_nyquist(self, factors: np.ndarray) -> np.ndarray:
        """Return factors (…, harmonics, channels), real ones at the Nyquist harmonic."""
        if self._points % 2 == 0:
            factors = np.array(factors, dtype=complex)
            factors[..., -1, :] = factors[..., -1, :].real
        return factors

    def _sensed(self, signals: np.ndarray, response: Response) -> np.ndarray:
        """Return signals (…, points, channels) as the sensors show them."""
        trend = self._trend(signals)
        spectrum = np.fft.rfft(signals - trend * self._ramp, axis=-2) * self._factors(response)
        result = np.fft.irfft(spectrum, n=self._points, axis=-2)
        if self._angle_places:
            phase = self._phase(response)
            lags = [
                self.sensing.lag(c, response.sensors, response.frequency) for c in range(len(self.compared_channels))
            ]
            lag = np.stack(np.broadcast_arrays(*lags), axis=-1)[..., None, :]
            lag = lag if phase is None else lag + phase[..., None, None]
            result += trend * (self._ramp - lag)
        for c, place in self.sensing.offset_places():
            result[..., c] += response.sensors[..., place, None]
        return result

    def _slopes(self, response: Response) -> np.ndarray:
        """Return the derivatives of `_factors` by all parameters, the frequency last, (parameters + 1, …)."""
        given, factors = (response.sensors, response.frequency, self._harmonic), self._factors_between(response)
        result = np.zeros((response.sensors.shape[-1] + 1, *factors.shape), dtype=complex)
        for c in range(len(self.compared_channels)):
            for relative, by in self.sensing.slopes(c, *given):
                slope = factors[:, c] if relative is None else factors[:, c] * relative.complex
                for place, scale in by:
                    result[place, :, c] += slope * scale
        return self._at_nyquist(result)

    def _sensed_changes(self, moved: np.ndarray, response: Response, directions: Response) -> np.ndarray:
        """Return the derivatives of `_sensed` along directions in which the signals move."""
        signals, factors = response.outputs[..., self.picked], self._factors(response)
        trend, along = self._trend(signals), _with_frequency(directions)
        spectrum = np.fft.rfft(signals - trend * self._ramp, axis=-2)
        changes = np.tensordot(along, self._slopes(response), (1, 0))
        turned = np.zeros(len(along))
        if self._free_phase:
            turned = self._phase_changes(response, directions)
            turn = -2j * np.pi * self._harmonic[:, None] * self._factors_between(response)
            changes += self._at_nyquist(turned[:, None, None] * turn)
        every = np.fft.rfft(moved, axis=-2) * factors + spectrum * changes
        result = np.fft.irfft(every, n=self._points, axis=-2)
        if self._angle_places:
            lag = np.zeros((len(along), len(self.compared_channels)))
            for c in range(len(self.compared_channels)):
                for place, slope in self.sensing.lag_slopes(c, response.sensors, response.frequency):
                    lag[:, c] += along[:, place] * slope
            result -= trend * (lag + turned[:, None])[:, None]
        for c, place in self.sensing.offset_places():
            result[..., c] += along[:, place, None]
        return result

    def _sensed_vjp(self, weights: np.ndarray, response: Response) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of Σ weights · `_sensed` by the signals and by the sensors of a driven model."""
        signals, factors = response.outputs[..., self.picked], self._factors(response)
        trend = self._trend(signals)
        pulled, spectrum = np.fft.rfft(weights, axis=0), np.fft.rfft(signals - trend * self._ramp, axis=0)
        halves = np.full((self._harmonic.size, 1), 2.0 / self._points)
        halves[0] = 1.0 / self._points
        if self._points % 2 == 0:
            halves[-1] = 1.0 / self._points
        by_factors = np.conj(pulled) * spectrum * halves
        sensors = np.real(np.tensordot(self._slopes(response)[:-1], by_factors, 2))
        for c, place in self.sensing.offset_places():
            sensors[place] += np.sum(weights[:, c])
        for c in self._angle_places:
            for place, slope in self.sensing.lag_slopes(c, response.sensors, response.frequency):
                if place < sensors.size:
                    sensors[place] -= trend[0, c] * slope * np.sum(weights[:, c])
        return np.fft.irfft(pulled * np.conj(factors), n=self._points, axis=0), sensors

    def _trend(self, signals: np.ndarray) -> np.ndarray:
        """Return what angles advance in a response period, (…, 1, channels), whole turns; zero for other channels."""
        ahead = 2.0 * signals[..., -1:, :] - signals[..., -2:-1, :]
        turns = np.rint((ahead - signals[..., :1, :]) / (2 * np.pi))
        return 2 * np.pi * np.where(self.angles, turns, 0.0)


def _with_frequency(directions: Response) -> np.ndarray:
    """Return the changes (directions, parameters + 1) of the sensors and of the frequency."""
    return np.concatenate([directions.sensors, np.asarray(directions.frequency)[:, None]], axis=1)


class _Part(NamedTuple):
    """Experiments whose residuals are computed together."""

    group: int  # index of the group of experiments that are solved together
    members: Any  # place in the group of an experiment that is compared alone; slice or list of int of others
    together: list[Observation]
    data: list[np.ndarray]  # Fourier components (experiments, 1, size) a channel; empty if more than these is compared
    alike: list[Block]  # those of all experiments as one; empty if they have data, or are not alike

    @property
    def first(self) -> Observation:
        """The first of the experiments, which has what all have in common."""
        return self.together[0]


class Comparisons:
    """Residual components of all experiments, computed together where experiments have the same layout.

    The groups are of experiments that are solved together, as in `ResponseSolver.groups`, the order that of the blocks.
    """

    def __init__(self, groups: Sequence[Sequence[Observation]], order: Iterable[str]):
        self._parts: list[_Part] = []
        places: dict[str, list[tuple[int, int]]] = {}
        stacks = 0
        for g, group in enumerate(groups):
            layouts: dict[Any, list[int]] = {}
            for m, observation in enumerate(group):
                key = observation.layout or observation.alike_in or observation.experiment.name
                layouts.setdefault(key, []).append(m)
            for members in layouts.values():
                together, first = [group[m] for m in members], group[members[0]]
                at: Any = slice(None) if len(members) == len(group) else members
                data, alike = [], []
                if first.layout:
                    parts = zip(*(o.data_components() for o in together), strict=True)
                    data = [np.stack(components)[:, None] for components in parts]
                elif first.alike_in:
                    alike = [type(one[0]).stacked(one) for one in zip(*(o.blocks for o in together), strict=True)]
                else:
                    at = members[0]
                self._parts.append(_Part(g, at, together, data, alike))
                blocks = range(stacks, stacks + len(first.blocks))
                places |= {o.experiment.name: [(b, m) for b in blocks] for m, o in enumerate(together)}
                stacks = blocks.stop
        self._places = [place for name in order for place in places[name]]

    @np.errstate(over="ignore", invalid="ignore")
    def residuals(self, simulation: Simulation, threads: int | None = 1) -> Residuals:
        """Return the residual components at all θ, (solves, size) a block; None means one thread per core."""
        solves = simulation.status.size
        small = solves == 1 or max(group.outputs.size for group in simulation.groups) < SMALLEST_SHARED
        parts = 1 if small else min(threads or available_cores(), solves)
        if parts <= 1:
            return Residuals(self._stacks(simulation), self._places)
        slices = [slice(solves * k // parts, solves * (k + 1) // parts) for k in range(parts)]
        stacks = in_threads(lambda part: self._stacks(simulation.at(part)), slices, parts)
        return Residuals([np.concatenate(stack, axis=1) for stack in zip(*stacks, strict=True)], self._places)

    def _stacks(self, simulation: Simulation) -> list[np.ndarray]:
        """Return the residual components of all parts, an array (experiments, solves, size) a block."""
        result = []
        for part in self._parts:
            solved, members, first = simulation.groups[part.group], part.members, part.first
            if part.alike:
                predicted = ComparedSignals(solved.outputs[members][..., first.picked], NONE, solved.frequency[members])
                measured = np.array([[o.experiment.frequency] for o in part.together])
                difference = ComparedSignals(NONE, NONE, measured - predicted.frequency)
                result += [block.compare(predicted, difference) for block in part.alike]
            elif part.data:
                signals = ComparedSignals(solved.outputs[members][..., first.picked], NONE, NONE)
                sensors, frequency = solved.sensors[members], solved.frequency[members]
                for measured, block in zip(part.data, first.blocks, strict=True):
                    shown = block.errors(signals)
                    if first.sensing.active:
                        shown = block.through_sensor(first.sensing, shown, sensors, frequency)
                    result.append(measured - shown)
            else:
                result += [components[None] for components in first.residuals(solved.response(members))]
        return result

    def vjp(
        self, simulation: Simulation, weights: Residuals, residuals: Residuals
    ) -> tuple[list[np.ndarray], list[np.ndarray], dict[str, np.ndarray]]:
        """Return the derivatives of Σ weights · predicted components by the responses at one θ.

        They are by the outputs (experiments, points, channels) and sensors (experiments, names) of each group, and by
        log|μ| of the experiments whose multipliers were measured. The weights are arranged as the residuals at this θ.
        """
        by_outputs = [np.empty((len(group.outputs), *group.outputs.shape[2:])) for group in simulation.groups]
        by_sensors, by_multipliers = [np.empty(group.sensors[:, 0].shape) for group in simulation.groups], {}
        stacks, left = iter(weights.stacks), iter(residuals.stacks)
        for part in self._parts:
            group = simulation.groups[part.group]
            pulls, rests = ([next(stack) for _ in part.first.blocks] for stack in (stacks, left))
            if part.data:
                shown = [data[:, 0] - rest for data, rest in zip(part.data, rests, strict=True)]
                pulled = part.first.vjp(group.response(part.members, 0), pulls, shown)
                by_outputs[part.group][part.members] = pulled.outputs
                by_sensors[part.group][part.members] = pulled.sensors
                continue
            places = np.arange(len(group.outputs))[part.members]
            for k, (m, observation) in enumerate(zip(np.atleast_1d(places).tolist(), part.together, strict=True)):
                pulled = observation.vjp(group.response(m, 0), [pull[k] for pull in pulls], [])
                by_outputs[part.group][m], by_sensors[part.group][m] = pulled.outputs, pulled.sensors
                by_multipliers[observation.experiment.name] = pulled.log_multipliers
        return by_outputs, by_sensors, by_multipliers
