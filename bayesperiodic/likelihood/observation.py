"""From a periodic response to what is compared with one experiment, and the derivatives of that."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from bayesperiodic import _fourier
from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.likelihood import Residuals
from bayesperiodic.likelihood.noise import CORRELATED, KNOWN, POINTS, SCALE, SPECTRAL, Block
from bayesperiodic.models.model import Model

# Outputs (numbers) from which on their comparison with the data is shared among the cores.
SMALLEST_SHARED = 10_000
LARGEST_TRANSFORM = 16_384
ROOT_TWO = math.sqrt(2.0)


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

    def response(self, member: int) -> Response:
        """Return the responses of one experiment, θ on the leading axis."""
        delay = self.values[member][..., -1]
        return Response(self.outputs[member], self.frequency[member], self.log_multipliers[member], delay)

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

    Outputs are delayed, compared with the data (angles modulo 2π), and taken at the points of the mask or as Fourier
    components within the harmonics kept. The orbit of an autonomous model, whose phase is free, is first turned until
    the first harmonics of its measured outputs agree best with those of the data. Other outputs are shifted only if the
    delay is a parameter.

    Attributes
    ----------
    channels : tuple of str
        Those measured, in the order of the model's outputs.
    columns : list of int
        Their indices among the model's outputs.
    angles : list of bool
        Which of the channels are angles.
    data : array (points, channels)
    caused : list of array (size,), optional
        What the expected errors of the inputs cause in the components of each block, see `input_noise`.
    """

    def __init__(self, experiment: Experiment, model: Model, delayed: bool, caused: Sequence[np.ndarray] | None = None):
        self.experiment, self.caused = experiment, caused
        self.channels = tuple(channel for channel in model.outputs if channel in experiment.outputs)
        self.columns = [model.outputs.index(channel) for channel in self.channels]
        self.angles = [channel in model.angles for channel in self.channels]
        self._free_phase = model.autonomous
        self._shifted = delayed or model.autonomous
        self.data = np.stack([experiment.outputs[channel] for channel in self.channels], axis=-1)
        self._points = len(self.data)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """What the noise model must know, one entry a vector of components."""
        e, found = self.experiment, []
        if e.covariance is not None:
            found.append(self._block(SCALE, CORRELATED, float(self._values), self._values))
        else:
            for channel in self.channels:
                kind = SPECTRAL if e.mask is None else POINTS
                size = len(self._harmonics[channel]) if e.mask is None else int(e.mask.sum())
                found.append(self._block(channel, kind, float(e.independent[channel]), size))
        if e.multipliers is not None:
            found.append(self._block("multipliers", KNOWN, 0.0, e.multipliers.size))
        if self._free_phase:
            found.append(self._block("frequency", KNOWN, 0.0, 1))
        return tuple(found)

    def _block(self, channel: str, kind: str, count: float, size: int) -> Block:
        e, mask = self.experiment, self.experiment.mask
        averaged = e.averaged or e.cycles * (self._points if mask is None else int(mask.sum()))
        return Block(
            e.name,
            channel,
            kind,
            count,
            size,
            self._harmonics[channel] if kind == SPECTRAL else np.empty(0),
            np.flatnonzero(mask) / self._points if kind == POINTS and mask is not None else np.empty(0),
            self._points,
            float(averaged),
            _measured_variance(e, channel),
        )

    @property
    def _values(self) -> int:
        mask = self.experiment.mask
        return (self._points if mask is None else int(mask.sum())) * len(self.channels)

    @cached_property
    def _harmonics(self) -> dict[str, np.ndarray]:
        """The harmonic of each spectral component, by channel."""
        result, highest = {}, _fourier.highest_harmonic(self._points)
        for channel in self.channels:
            kept = self.experiment.harmonics.get(channel)
            harmonics = np.arange(1, 1 + min(highest if kept is None else kept, highest))
            nyquist = [self._points // 2] if kept is None and self._points % 2 == 0 else []
            result[channel] = np.array([0, *harmonics, *harmonics, *nyquist])
        return result

    @cached_property
    def _joint(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what whitens the values, the regression of log|μ| on them, and what whitens the rest of log|μ|."""
        e, size = self.experiment, self._values
        count = 0 if e.multipliers is None else e.multipliers.size
        values, slopes = np.empty((0, 0)), np.zeros((count, 0))
        if e.covariance is not None:
            values, slopes = _whitening(e.covariance[:size, :size]), np.zeros((count, size))
        if e.multiplier_sd is not None:
            return values, slopes, np.diag(1.0 / e.multiplier_sd)
        if not count or e.covariance is None:
            return values, slopes, np.empty((0, 0))
        cross = e.covariance[size:, :size]
        slopes = np.linalg.solve(e.covariance[:size, :size], cross.T).T
        return values, slopes, _whitening(e.covariance[size:, size:] - slopes @ cross.T)

    @property
    def log_scale(self) -> float:
        """ln|∂ components/∂ data|: of values and multipliers with a given covariance, and of a measured frequency."""
        values, _, multipliers = self._joint
        scale = float(np.log(np.diag(values)).sum() + np.log(np.diag(multipliers)).sum())
        return scale - (math.log(self.experiment.frequency_se) if self._free_phase else 0.0)

    def data_components(self) -> list[np.ndarray]:
        """Return the Fourier components (size,) of each measured channel, without what errors of the inputs caused."""
        measured = [self._spectral(self.data[:, c], self._harmonics[name]) for c, name in enumerate(self.channels)]
        return measured if self.caused is None else [a - b for a, b in zip(measured, self.caused, strict=True)]

    def components(self, outputs: np.ndarray) -> list[np.ndarray]:
        """Return the Fourier components (…, size) of each measured channel of outputs (…, points, channels)."""
        pairs = zip(self.columns, self.channels, strict=True)
        return [self._spectral(outputs[..., column], self._harmonics[name]) for column, name in pairs]

    def spread(self, weights: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the transpose of `components` applied to weights (…, size) a channel: (…, points) a channel."""
        return [self._spread(own, self._harmonics[name]) for own, name in zip(weights, self.channels, strict=True)]

    def residuals(self, response: Response) -> list[np.ndarray]:
        """Return the residual components, one array (…, size) a block."""
        e = self.experiment
        known = [] if e.multipliers is None else [np.log(np.abs(e.multipliers)) - response.log_multipliers]
        frequency = [e.frequency - response.frequency] if self._free_phase else []
        found = self._components(self._difference(response), known, frequency)
        return found if self.caused is None else [a - b for a, b in zip(found, self.caused, strict=True)]

    def errors(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the components (…, size) of errors of the measured values (…, points, channels), an array a block."""
        e, shape = self.experiment, values.shape[:-2]
        known = [] if e.multipliers is None else [np.zeros((*shape, e.multipliers.size))]
        return self._components(values, known, [np.zeros(shape)] if self._free_phase else [])

    @cached_property
    def layout(self) -> tuple[Any, ...] | None:
        """What experiments have in common that are compared all at once; None where there is more to compare."""
        e = self.experiment
        if self._shifted or any(self.angles) or not (e.mask is None and e.covariance is None and e.multipliers is None):
            return None
        return self._points, self.channels, *(self._harmonics[channel].size for channel in self.channels)

    def changes(self, response: Response, directions: Response) -> list[np.ndarray]:
        """Return the derivatives of the predicted components along directions, one array (directions, size) a block."""
        e = self.experiment
        moved = directions.outputs[..., self.columns]
        if self._shifted:
            moved = self._shift(moved, self._fraction(response))
            moved = moved - self._rate(response) * self._fraction_changes(response, directions)[:, None, None]
        known = [] if e.multipliers is None else [directions.log_multipliers]
        return self._components(moved, known, [directions.frequency] if self._free_phase else [])

    def vjp(self, response: Response, weights: list[np.ndarray]) -> Response:
        """Return the derivatives of Σ weights · predicted components by everything in a forced model's response."""
        e, total, joint = self.experiment, np.zeros_like(self.data), np.zeros(0)
        if e.multipliers is not None:
            joint = weights[-1] @ self._joint[2]
        if e.covariance is not None:
            whitening, slopes, _ = self._joint
            at = slice(None) if e.mask is None else e.mask
            total[at] = (weights[0] @ whitening - slopes.T @ joint).reshape(-1, len(self.channels))
        else:
            for c, channel in enumerate(self.channels):
                if e.mask is not None:
                    total[e.mask, c] = weights[c]
                else:
                    total[:, c] = self._spread(weights[c], self._harmonics[channel])
        by_delay = 0.0
        if self._shifted:
            by_delay = -float(np.sum(total * self._rate(response))) * float(response.frequency) / e.periods
            total = self._shift(total, -self._fraction(response))
        outputs = np.zeros_like(response.outputs)
        outputs[:, self.columns] = total
        return Response(outputs, np.zeros(()), joint, np.array(by_delay))

    def predicted(self, response: Response) -> dict[str, np.ndarray]:
        """Return ŷ (…, points) of each measured channel, turned and delayed."""
        return dict(zip(self.channels, np.moveaxis(self._predicted(response), -1, 0), strict=True))

    def replicates(self, response: Response, components: list[np.ndarray]) -> dict[str, np.ndarray]:
        """Return possible measurements, ŷ plus noise (draws, points), by channel; NaN outside the mask.

        The response has draws on its leading axis, the noise one array (draws, size) a block. Angles are within half a
        turn of the data.
        """
        e, noise = self.experiment, np.full((len(components[0]), *self.data.shape), np.nan)
        if self.caused is not None:
            components = [a + b for a, b in zip(components, self.caused, strict=True)]
        if e.covariance is not None:
            values = solve_triangular(self._joint[0], components[0].T, lower=True).T
            mask = np.ones(self._points, dtype=bool) if e.mask is None else e.mask
            noise[:, mask] = values.reshape(len(values), -1, len(self.channels))
        else:
            for c in range(len(self.channels)):
                if e.mask is None:
                    noise[..., c] = _fourier.from_components(components[c], self._points)
                else:
                    noise[:, e.mask, c] = components[c]
        values = self._predicted(response) + noise
        turned = self.data - _fourier.within_half_turn(self.data - values)
        return {n: (turned if self.angles[c] else values)[..., c] for c, n in enumerate(self.channels)}

    def compared(self, response: Response, ahead: int = 0) -> dict[str, np.ndarray]:
        """Return y − ŷ (points,) of each channel, within the harmonics kept and zero where nothing was measured.

        ŷ is taken a number of forcing periods `ahead`.
        """
        difference, mask, result = self._difference(response, ahead), self.experiment.mask, {}
        for c, channel in enumerate(self.channels):
            e = difference[:, c]
            result[channel] = self.experiment.project(channel, e) if mask is None else np.where(mask, e, 0.0)
        return result

    def _difference(self, response: Response, ahead: int = 0) -> np.ndarray:
        """Return y − ŷ (…, points, channels), ŷ some forcing periods ahead, angles within half a turn."""
        predicted = self._predicted(response)
        if ahead:
            predicted = np.roll(predicted, -ahead * self.experiment.samples, axis=-2)
        difference = self.data - predicted
        for c in np.flatnonzero(self.angles):
            difference[..., c] = _fourier.within_half_turn(difference[..., c])
        return difference

    def _components(
        self, values: np.ndarray, multipliers: list[np.ndarray], frequency: list[np.ndarray]
    ) -> list[np.ndarray]:
        """Return the components of differences (…, points, channels), and of those of log|μ| and the frequency."""
        e, found = self.experiment, []
        picked = values if e.mask is None else values[..., e.mask, :]
        flat = picked.reshape(*picked.shape[:-2], picked.shape[-2] * picked.shape[-1])
        if e.covariance is not None:
            found.append(_times(self._joint[0], flat))
        else:
            for c, channel in enumerate(self.channels):
                column = picked[..., c]
                found.append(column if e.mask is not None else self._spectral(column, self._harmonics[channel]))
        for logarithms in multipliers:
            _, slopes, whitening = self._joint
            explained = _times(slopes, flat) if slopes.shape[1] else 0.0
            found.append(_times(whitening, logarithms - explained))
        found += [np.asarray(difference)[..., None] / e.frequency_se for difference in frequency]
        return found

    def _spectral(self, signal: np.ndarray, harmonic: np.ndarray) -> np.ndarray:
        """Return real Fourier components whose mean square is that of the signal within the harmonics."""
        result = np.empty((*signal.shape[:-1], harmonic.size))
        if signal.size <= LARGEST_TRANSFORM or signal.ndim < 3:
            self._transform(signal, result)
        else:  # In parts that stay in the cache; larger ones cost more for their memory than for the transform.
            step = max(1, LARGEST_TRANSFORM // self._points)
            for own, components in zip(signal, result, strict=True):
                for first in range(0, len(own), step):
                    self._transform(own[first : first + step], components[first : first + step])
        return result

    def _transform(self, signal: np.ndarray, result: np.ndarray) -> None:
        """Fill in the real Fourier components (…, size) of signals (…, points)."""
        size = result.shape[-1]
        highest, factor = (size - 1) // 2, math.sqrt(0.5 * size)
        amplitudes = _fourier.coefficients(signal, highest)
        np.multiply(amplitudes.real, factor, out=result[..., : highest + 1])
        np.multiply(amplitudes.imag[..., 1:], factor, out=result[..., highest + 1 : 2 * highest + 1])
        result[..., 0] *= ROOT_TWO
        if size % 2 == 0:
            result[..., -1] = np.sum(signal * (self._alternating / self._points), axis=-1) * math.sqrt(size)

    @cached_property
    def _alternating(self) -> np.ndarray:
        """The signal (points,) 1, −1, 1, … of the Nyquist harmonic."""
        return np.where(np.arange(self._points) % 2 == 0, 1.0, -1.0)

    def _spread(self, weights: np.ndarray, harmonic: np.ndarray) -> np.ndarray:
        """Return the transpose of `_spectral` applied to weights (size,), its inverse but for a factor."""
        return _fourier.from_components(weights, self._points) * harmonic.size / self._points

    def _predicted(self, response: Response) -> np.ndarray:
        """Return the model's outputs (…, points, channels), turned and delayed."""
        outputs = response.outputs[..., self.columns]
        return self._shift(outputs, self._fraction(response), turning=True) if self._shifted else outputs

    def _fraction(self, response: Response) -> np.ndarray:
        """Return by what fraction of the response period the outputs are shifted, (…,)."""
        fraction = np.asarray(response.delay) * response.frequency / self.experiment.periods
        if self._free_phase:
            own, reference = self._fundamentals(response.outputs), self._reference
            # In real numbers: the rounding of NumPy's complex products depends on how many there are.
            cosine = np.sum(own.real * reference.real - own.imag * reference.imag, axis=-1)
            sine = np.sum(own.real * reference.imag + own.imag * reference.real, axis=-1)
            fraction = fraction + np.arctan2(sine, cosine) / (2 * np.pi)
        return fraction

    def _fundamentals(self, outputs: np.ndarray) -> np.ndarray:
        """Return the complex amplitude of the first harmonic of each channel, (…, channels)."""
        return _fourier.coefficients(np.moveaxis(outputs[..., self.columns], -1, -2), 1)[..., 1]

    @cached_property
    def _reference(self) -> np.ndarray:
        """What multiplies the channels' fundamentals, so that the angle of the sum is by how much they are behind.

        With the variances of the measurement, where they are known, it is the likeliest phase; one channel's phase
        alone would bring its noise into all others. Angles, which may wind, have no part in it unless there is nothing
        else.
        """
        noise = np.array([_measured_variance(self.experiment, channel) for channel in self.channels])
        known = bool(np.all(np.isfinite(noise) & (noise > 0.0)))
        weights = 1.0 / (noise if known else self.data.var(axis=0))
        angles = np.array(self.angles)
        weights[angles & ~angles.all()] = 0.0
        return weights * np.conj(_fourier.coefficients(self.data.T, 1)[:, 1])

    def _fraction_changes(self, response: Response, directions: Response) -> np.ndarray:
        delays = directions.delay * response.frequency + response.delay * directions.frequency
        changes = delays / self.experiment.periods
        if self._free_phase:
            moved = directions.outputs[..., self.columns]
            changes = changes + np.einsum("...pc,pc->...", moved, self._phase_gradient(response))
        return changes

    def _phase_gradient(self, response: Response) -> np.ndarray:
        """Return the derivatives (points, channels) of the outputs' phase [turns] by their values."""
        agreement = np.sum(self._fundamentals(response.outputs) * self._reference)
        wave = np.exp(-2j * np.pi * np.arange(self._points) / self._points) * 2.0 / self._points
        return np.imag(np.outer(wave, self._reference) / agreement) / (2 * np.pi)

    def _shift(self, signals: np.ndarray, fraction: np.ndarray, turning: bool = False) -> np.ndarray:
        """Return signals (…, points, channels) that come a fraction of the response period later."""
        phase = np.asarray(fraction)[..., None, None]
        trend = self._trend(signals) if turning else 0.0
        spectrum = np.fft.rfft(signals - trend * np.arange(self._points)[:, None] / self._points, axis=-2)
        harmonic = np.arange(spectrum.shape[-2])[:, None]
        turn = np.exp(-2j * np.pi * harmonic * phase)
        if self._points % 2 == 0:
            turn[..., -1, :] = turn[..., -1, :].real
        shifted = np.fft.irfft(spectrum * turn, n=self._points, axis=-2)
        return shifted + trend * (np.arange(self._points)[:, None] / self._points - phase)

    def _trend(self, signals: np.ndarray) -> np.ndarray:
        """Return what angles advance in a response period, (…, 1, channels), whole turns; zero for other channels."""
        ahead = 2.0 * signals[..., -1:, :] - signals[..., -2:-1, :]
        turns = np.rint((ahead - signals[..., :1, :]) / (2 * np.pi))
        return 2 * np.pi * np.where(self.angles, turns, 0.0)

    def _rate(self, response: Response) -> np.ndarray:
        """Return the derivative (points, channels) of the predicted outputs by their phase [per response period]."""
        predicted = self._predicted(response)
        trend = self._trend(predicted)
        spectrum = np.fft.rfft(predicted - trend * np.arange(self._points)[:, None] / self._points, axis=0)
        spectrum *= 2j * np.pi * np.arange(len(spectrum))[:, None]
        if self._points % 2 == 0:
            spectrum[-1] = 0.0
        return np.fft.irfft(spectrum, n=self._points, axis=0) + trend


def _times(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return matrix · row of rows (…, size), row by row: the rounding of one product may depend on their number."""
    return (matrix @ rows[..., None])[..., 0]


def _whitening(covariance: np.ndarray) -> np.ndarray:
    """Return the inverse of the lower Cholesky factor."""
    return solve_triangular(np.linalg.cholesky(covariance), np.eye(len(covariance)), lower=True)


def _measured_variance(experiment: Experiment, channel: str) -> float:
    """Return the variance of one value of the mean period that the scatter of the cycles explains; NaN if unknown."""
    if channel in experiment.amplitude_variance:
        variance = experiment.amplitude_variance[channel]
        return float(variance[0] + 0.5 * np.sum(variance[1:]))
    if channel in experiment.scatter:
        return float(experiment.scatter[channel] ** 2 / experiment.cycles)
    return float("nan")


class _Part(NamedTuple):
    """Experiments whose residuals are computed together."""

    group: int  # index of the group of experiments that are solved together
    members: Any  # slice or list of int, their places in the group
    observations: list[Observation]
    data: list[np.ndarray]  # Fourier components (experiments, 1, size) a channel; empty if more than these is compared


class Comparisons:
    """Residual components of all experiments, computed together where experiments have the same layout.

    The groups are of experiments that are solved together, as in `Simulator.groups`, the order that of the blocks.
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
                own = [group[m] for m in members]
                each = zip(*(o.data_components() for o in own), strict=True) if own[0].layout else ()
                data = [np.stack(components)[:, None] for components in each]
                self._parts.append(_Part(g, slice(None) if len(own) == len(group) else members, own, data))
                blocks = range(stacks, stacks + len(own[0].blocks))
                places |= {o.experiment.name: [(b, m) for b in blocks] for m, o in enumerate(own)}
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
            found = in_threads(lambda part: self._stacks(simulation.at(part)), slices, parts)
        return Residuals([np.concatenate(own, axis=1) for own in zip(*found, strict=True)], self._places)

    def _stacks(self, simulation: Simulation) -> list[np.ndarray]:
        """Return the residual components of all parts, an array (experiments, solves, size) a block."""
        result = []
        for group, members, observations, data in self._parts:
            solved, first = simulation.groups[group], observations[0]
            if data:
                components = first.components(solved.outputs[members])
                result += [measured - own for measured, own in zip(data, components, strict=True)]
            else:
                (member,) = range(len(solved.outputs))[members] if isinstance(members, slice) else members
                result += [block[None] for block in first.residuals(solved.response(member))]
        return result

    def vjp(
        self, simulation: Simulation, weights: Residuals
    ) -> tuple[list[np.ndarray], list[np.ndarray], dict[str, np.ndarray]]:
        """Return the derivatives of Σ weights · predicted components by the responses at one θ.

        They are by the outputs (experiments, points, channels) and the delays (experiments,) of each group, and by
        log|μ| of the experiments whose multipliers were measured. The weights are arranged as the residuals at this θ.
        """
        by_outputs = [np.zeros((len(group.outputs), *group.outputs.shape[2:])) for group in simulation.groups]
        by_delay, by_multipliers = [np.zeros(len(group.outputs)) for group in simulation.groups], {}
        stacks = iter(weights.stacks())
        for group, members, observations, data in self._parts:
            first, own = observations[0], [next(stacks) for _ in observations[0].blocks]
            if data:
                for column, signal in zip(first.columns, first.spread(own), strict=True):
                    by_outputs[group][members, :, column] = signal
            else:
                response = simulation.at(0).response(first.experiment.name)
                found = first.vjp(response, [stack[0] for stack in own])
                by_outputs[group][members], by_delay[group][members] = found.outputs, found.delay
                by_multipliers[first.experiment.name] = found.log_multipliers
        return by_outputs, by_delay, by_multipliers
