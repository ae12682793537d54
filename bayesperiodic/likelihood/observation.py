"""From a periodic response to what is compared with one experiment, and the derivatives of that."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import ComparedSignals, measured_channels, measured_variance
from bayesperiodic.likelihood.kinds import blocks_of
from bayesperiodic.likelihood.likelihood import Residuals
from bayesperiodic.models.model import Model

# Outputs (numbers) from which on their comparison with the data is shared among the cores.
SMALLEST_SHARED = 10_000


class Response(NamedTuple):
    """Response of a model in one experiment, or its derivatives along directions on the leading axis."""

    outputs: np.ndarray  # (…, points, channels), in the order of the model's outputs
    frequency: np.ndarray  # (…,) [Hz]
    log_multipliers: np.ndarray  # (…, multipliers), log|μ|, largest first, as many as were measured
    delay: np.ndarray  # (…,) of the measured outputs against the model's [s]


class GroupSolution(NamedTuple):
    """Solutions of experiments that are solved together, at several θ."""

    outputs: np.ndarray  # (experiments, solves, points, channels), in the order of the model's outputs
    frequency: np.ndarray  # (experiments, solves) [Hz]
    values: np.ndarray  # (experiments, solves, parameters + 1), all parameters, the delay last
    log_multipliers: list[np.ndarray]  # (solves, multipliers) of each experiment, log|μ|, largest first
    z: np.ndarray  # (experiments, solves, points, states), periodic parts of the states
    status: np.ndarray  # int (experiments, solves), index into `compiled.STATUSES`

    def response(self, members: Any, solves: Any = ...) -> Response:
        """Return the responses of one experiment (an index), θ on the leading axis; of several without multipliers."""
        at = members, solves
        multipliers = self.log_multipliers[members][solves] if isinstance(members, int) else np.empty(0)
        return Response(self.outputs[at], self.frequency[at], multipliers, self.values[at][..., -1])

    def at(self, solves: Any) -> "GroupSolution":
        """Return the solutions at some of the θ."""
        return GroupSolution(
            self.outputs[:, solves],
            self.frequency[:, solves],
            self.values[:, solves],
            [values[solves] for values in self.log_multipliers],
            self.z[:, solves],
            self.status[:, solves],
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

    Outputs are delayed and compared with the data (angles modulo 2π), each kind of data as its `Block` says. The orbit
    of an autonomous model, whose phase is free, is first turned until the first harmonics of its measured outputs agree
    best with those of the data. Other outputs are shifted only if the delay is a parameter.

    Attributes
    ----------
    channels : tuple of str
        Those measured, in the order of the model's outputs.
    picked : slice or list of int
        Their indices among the model's outputs, a slice, which does not copy, where they are consecutive.
    angles : list of bool
        Which of the channels are angles.
    blocks : tuple of Block
        The data of the experiment, one entry a vector of components.
    multipliers : int
        The number of Floquet multipliers that are compared.
    data : array (points, channels)
    caused : list of array (size,), optional
        What the expected errors of the inputs cause in the components of each block, see `input_noise`.
    """

    def __init__(self, experiment: Experiment, model: Model, delayed: bool, caused: Sequence[np.ndarray] | None = None):
        self.experiment, self.caused = experiment, caused
        self.channels, self.blocks = measured_channels(experiment, model), blocks_of(experiment, model)
        columns = [model.outputs.index(channel) for channel in self.channels]
        between = slice(columns[0], columns[-1] + 1)
        self.picked = between if len(columns) == between.stop - between.start else columns
        self.angles = [channel in model.angles for channel in self.channels]
        self._angle_places = np.flatnonzero(self.angles)
        self._free_phase = model.autonomous
        self._shifted = delayed or model.autonomous
        self.data = np.stack([experiment.outputs[channel] for channel in self.channels], axis=-1)
        logarithms = np.log(np.abs(experiment.measured_multipliers))
        self._measured = ComparedSignals(self.data, logarithms, np.array(experiment.frequency))
        self._points = len(self.data)
        self._ramp = np.arange(self._points)[:, None] / self._points
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
        return self._rate(self.data)

    def errors(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the components (…, size) of errors of the measured values (…, points, channels), an array a block."""
        shape = values.shape[:-2]
        signals = ComparedSignals(values, np.zeros((*shape, self.multipliers)), np.zeros(shape))
        return [block.errors(signals) for block in self.blocks]

    @cached_property
    def layout(self) -> tuple[Hashable, ...] | None:
        """What experiments have in common that are compared all at once; None where there is more to compare."""
        layouts = tuple(block.layout for block in self.blocks)
        return None if self._shifted or any(self.angles) or None in layouts else layouts

    def changes(self, response: Response, directions: Response) -> list[np.ndarray]:
        """Return the derivatives of the predicted components along directions, one array (directions, size) a block."""
        predicted, moved = self._signals(response), directions.outputs[..., self.picked]
        if self._shifted:
            turned = self._fraction_changes(response, directions)[:, None, None]
            moved = self._shift(moved, self._fraction(response)) - self._rate(predicted.values) * turned
        along = ComparedSignals(moved, directions.log_multipliers, directions.frequency)
        return [block.changes(predicted, along) for block in self.blocks]

    def vjp(self, response: Response, weights: list[np.ndarray]) -> Response:
        """Return the derivatives of Σ weights · predicted components by everything in a forced model's response.

        Where there is a `layout`, response and weights may be of several experiments, on the leading axis.
        """
        predicted, outputs, by_delay = self._signals(response), np.zeros(response.outputs.shape), 0.0
        by = ComparedSignals(outputs[..., self.picked], np.zeros(self.multipliers), np.zeros(()))
        for block, weight in zip(self.blocks, weights, strict=True):
            block.add_vjp(predicted, weight, by)
        values = by.values
        if self._shifted:
            fraction = float(response.frequency) / self.experiment.periods
            by_delay = -float(np.sum(values * self._rate(predicted.values))) * fraction
            values = self._shift(values, -self._fraction(response))
        outputs[..., self.picked] = values
        return Response(outputs, by.frequency, by.log_multipliers, np.array(by_delay))

    def predicted(self, response: Response) -> dict[str, np.ndarray]:
        """Return ŷ (…, points) of each measured channel, turned and delayed."""
        return dict(zip(self.channels, np.moveaxis(self._signals(response).values, -1, 0), strict=True))

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
        values = self._signals(response).values + noise
        turned = self.data - _fourier.within_half_turn(self.data - values)
        return {n: (turned if self.angles[c] else values)[..., c] for c, n in enumerate(self.channels)}

    def compared(self, response: Response, ahead: int = 0) -> dict[str, np.ndarray]:
        """Return y − ŷ (points,) of each channel, within the harmonics kept and zero where nothing was measured.

        ŷ is taken a number of forcing periods `ahead`.
        """
        predicted = np.roll(self._signals(response).values, -ahead * self.experiment.samples, axis=-2)
        pairs = zip(self.channels, np.moveaxis(self._difference(predicted), -1, 0), strict=True)
        return {channel: self.experiment.compared(channel, e) for channel, e in pairs}

    def _signals(self, response: Response) -> ComparedSignals:
        """Return the prediction of what was measured, the outputs turned and delayed."""
        values = response.outputs[..., self.picked]
        if self._shifted:
            values = self._shift(values, self._fraction(response), turning=True)
        return ComparedSignals(values, response.log_multipliers, response.frequency)

    def _difference(self, predicted: np.ndarray) -> np.ndarray:
        """Return y − ŷ (…, points, channels), angles within half a turn."""
        values = self.data - predicted
        for c in self._angle_places:
            values[..., c] = _fourier.within_half_turn(values[..., c])
        return values

    def _fraction(self, response: Response) -> np.ndarray:
        """Return by what fraction of the response period the outputs are shifted, (…,)."""
        fraction = np.asarray(response.delay) * response.frequency / self.experiment.periods
        if self._free_phase:
            amplitudes, reference = self._fundamentals(response.outputs), self._reference
            # In real numbers: the rounding of NumPy's complex products depends on how many there are.
            cosine = np.sum(amplitudes.real * reference.real - amplitudes.imag * reference.imag, axis=-1)
            sine = np.sum(amplitudes.real * reference.imag + amplitudes.imag * reference.real, axis=-1)
            fraction = fraction + np.arctan2(sine, cosine) / (2 * np.pi)
        return fraction

    def _fundamentals(self, outputs: np.ndarray) -> np.ndarray:
        """Return the complex amplitude of the first harmonic of each channel, (…, channels)."""
        return _fourier.coefficients(np.moveaxis(outputs[..., self.picked], -1, -2), 1)[..., 1]

    @cached_property
    def _reference(self) -> np.ndarray:
        """What multiplies the channels' fundamentals, so that the angle of the sum is by how much they are behind.

        With the variances of the measurement, where they are known, it is the likeliest phase; one channel's phase
        alone would bring its noise into all others. Angles, which may wind, have no part in it unless there is nothing
        else.
        """
        noise = np.array([measured_variance(self.experiment, channel) for channel in self.channels])
        known = bool(np.all(np.isfinite(noise) & (noise > 0.0)))
        weights = 1.0 / (noise if known else self.data.var(axis=0))
        angles = np.array(self.angles)
        weights[angles & ~angles.all()] = 0.0
        return weights * np.conj(_fourier.coefficients(self.data.T, 1)[:, 1])

    def _fraction_changes(self, response: Response, directions: Response) -> np.ndarray:
        delays = directions.delay * response.frequency + response.delay * directions.frequency
        changes = delays / self.experiment.periods
        if self._free_phase:
            moved = directions.outputs[..., self.picked]
            changes = changes + np.einsum("...pc,pc->...", moved, self._phase_gradient(response))
        return changes

    def _phase_gradient(self, response: Response) -> np.ndarray:
        """Return the derivatives (points, channels) of the outputs' phase [turns] by their values."""
        agreement = np.sum(self._fundamentals(response.outputs) * self._reference)
        wave = np.exp(-2j * np.pi * self._ramp[:, 0]) * 2.0 / self._points
        return np.imag(np.outer(wave, self._reference) / agreement) / (2 * np.pi)

    def _shift(self, signals: np.ndarray, fraction: np.ndarray, turning: bool = False) -> np.ndarray:
        """Return signals (…, points, channels) that come a fraction of the response period later."""
        phase = np.asarray(fraction)[..., None, None]
        trend = self._trend(signals) if turning else 0.0
        spectrum = np.fft.rfft(signals - trend * self._ramp, axis=-2)
        harmonic = np.arange(spectrum.shape[-2])[:, None]
        turn = np.exp(-2j * np.pi * harmonic * phase)
        if self._points % 2 == 0:
            turn[..., -1, :] = turn[..., -1, :].real
        shifted = np.fft.irfft(spectrum * turn, n=self._points, axis=-2)
        return shifted + trend * (self._ramp - phase)

    def _trend(self, signals: np.ndarray) -> np.ndarray:
        """Return what angles advance in a response period, (…, 1, channels), whole turns; zero for other channels."""
        ahead = 2.0 * signals[..., -1:, :] - signals[..., -2:-1, :]
        turns = np.rint((ahead - signals[..., :1, :]) / (2 * np.pi))
        return 2 * np.pi * np.where(self.angles, turns, 0.0)

    def _rate(self, predicted: np.ndarray) -> np.ndarray:
        """Return the derivative (points, channels) of the predicted outputs by their phase [per response period]."""
        trend = self._trend(predicted)
        spectrum = np.fft.rfft(predicted - trend * self._ramp, axis=0)
        spectrum *= 2j * np.pi * np.arange(len(spectrum))[:, None]
        if self._points % 2 == 0:
            spectrum[-1] = 0.0
        return np.fft.irfft(spectrum, n=self._points, axis=0) + trend


class _Part(NamedTuple):
    """Experiments whose residuals are computed together."""

    group: int  # index of the group of experiments that are solved together
    members: Any  # place in the group of an experiment that is compared alone; slice or list of int of others
    first: Observation
    data: list[np.ndarray]  # Fourier components (experiments, 1, size) a channel; empty if more than these is compared


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
                layouts.setdefault(observation.layout or observation.experiment.name, []).append(m)
            for members in layouts.values():
                together, first, data = [group[m] for m in members], group[members[0]], []
                at: Any = slice(None) if len(members) == len(group) else members
                if first.layout:
                    parts = zip(*(o.data_components() for o in together), strict=True)
                    data = [np.stack(components)[:, None] for components in parts]
                self._parts.append(_Part(g, at if data else members[0], first, data))
                blocks = range(stacks, stacks + len(first.blocks))
                places |= {o.experiment.name: [(b, m) for b in blocks] for m, o in enumerate(together)}
                stacks = blocks.stop
        self._places = [place for name in order for place in places[name]]

    def residuals(self, simulation: Simulation, threads: int | None = 1) -> Residuals:
        """Return the residual components at all θ, (solves, size) a block; None means one thread per core."""
        solves = simulation.status.size
        small = solves == 1 or max(group.outputs.size for group in simulation.groups) < SMALLEST_SHARED
        parts = 1 if small else min(threads or available_cores(), solves)
        with np.errstate(over="ignore", invalid="ignore"):
            if parts <= 1:
                return Residuals(self._stacks(simulation), self._places)
            slices = [slice(solves * k // parts, solves * (k + 1) // parts) for k in range(parts)]
            stacks = in_threads(lambda part: self._stacks(simulation.at(part)), slices, parts)
        return Residuals([np.concatenate(stack, axis=1) for stack in zip(*stacks, strict=True)], self._places)

    def _stacks(self, simulation: Simulation) -> list[np.ndarray]:
        """Return the residual components of all parts, an array (experiments, solves, size) a block."""
        result = []
        for group, members, first, data in self._parts:
            solved = simulation.groups[group]
            if data:
                signals = ComparedSignals(solved.outputs[members][..., first.picked], np.empty(0), np.empty(0))
                result += [part - block.errors(signals) for part, block in zip(data, first.blocks, strict=True)]
            else:
                result += [part[None] for part in first.residuals(solved.response(members))]
        return result

    def vjp(
        self, simulation: Simulation, weights: Residuals
    ) -> tuple[list[np.ndarray], list[np.ndarray], dict[str, np.ndarray]]:
        """Return the derivatives of Σ weights · predicted components by the responses at one θ.

        They are by the outputs (experiments, points, channels) and the delays (experiments,) of each group, and by
        log|μ| of the experiments whose multipliers were measured. The weights are arranged as the residuals at this θ.
        """
        by_outputs = [np.empty((len(group.outputs), *group.outputs.shape[2:])) for group in simulation.groups]
        by_delay, by_multipliers = [np.empty(len(group.outputs)) for group in simulation.groups], {}
        stacks = iter(weights.stacks)
        for group, members, first, data in self._parts:
            pulls = [next(stacks) if data else next(stacks)[0] for _ in first.blocks]
            pulled = first.vjp(simulation.groups[group].response(members, 0), pulls)
            by_outputs[group][members], by_delay[group][members] = pulled.outputs, pulled.delay
            by_multipliers[first.experiment.name] = pulled.log_multipliers
        return by_outputs, by_delay, by_multipliers
