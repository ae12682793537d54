"""Free runs of a model from measured states, with the measured inputs, and the growth of small differences in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from bayesperiodic.models.integration import complete_states, integration_kernels
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.coordinates import channel_and_delay, wrapped
from bayesperiodic.orbits.section import PoincareSection
from bayesperiodic.orbits.stretches import local_fit

# Phases of the first period at which the measured outputs are compared with those of a run.
START_PHASES = 16
# Steps of the integration in a period, fewest and most; largest error of a period, in units of the states' size.
FEWEST_STEPS_EACH, MOST_STEPS_EACH, STEP_ERROR = 128, 4096, 1e-3
# Fit of a start: candidates, iterations, halvings; relative step of derivatives, smallest relative singular value, and
# the decrease of the misfit that is none.
CANDIDATES, START_ITERATIONS, START_HALVINGS, START_STEP, LEAST_SLOPE, NO_DECREASE = 3, 10, 4, 1e-6, 1e-6, 1e-4
# Small difference of two runs, in units of the states' size.
APART_BY = 1e-7
# Degree of the splines of the measured inputs, and the samples beyond the ends of a run.
INPUT_SPLINE, BEYOND_RUN = 5, 12


class Runner:
    """A model with a forcing frequency [Hz], integrated in `steps` a period by a compiled Runge-Kutta method."""

    def __init__(self, model: Model, frequency: float, steps: int):
        self.model, self.frequency, self.steps = model, frequency, steps
        self.orders = np.array([model.orders[state] for state in model.states])
        self.size = int(self.orders.sum())

    def path(self, theta: np.ndarray, start: np.ndarray, table: np.ndarray, periods: int = 1) -> np.ndarray:
        """Return the states (periods·steps + 1, size) from a start; NaN in all if they overflow.

        `table` (2·steps·periods + 2, 3·inputs) contains u, u̇, ü at half steps.
        """
        path = np.empty((periods * self.steps + 1, self.size))
        function, kernels = self.model.kernels.residual_jacobian.address, integration_kernels()
        given = np.array(start, dtype=float), table, self.steps, theta, self.frequency, self.orders, len(path), path
        return path if kernels.runge_kutta(function, *given) else np.full_like(path, np.nan)

    def outputs(self, theta: np.ndarray, path: np.ndarray, table: np.ndarray, every: int = 1) -> np.ndarray:
        """Return the outputs (points, outputs) on every so many steps of a path."""
        y = path[::every]
        result = np.full((len(y), len(self.model.outputs)), np.nan)
        if np.isfinite(y[-1]).all():
            tau = np.arange(len(y)) * every / self.steps
            inputs = np.ascontiguousarray(table[: 2 * len(path) : 2 * every])
            states = complete_states(self.model, y, inputs, theta, tau, self.frequency)
            result = self.model.kernels.evaluate("outputs", states, inputs, theta, tau, self.frequency)
        return result

    def part(self, table: np.ndarray, period: int) -> np.ndarray:
        """Return the part of a table of inputs that belongs to one period."""
        return table[2 * self.steps * period : 2 * self.steps * (period + 1) + 2]


class Recorded:
    """What runs need of the recording of a section: starts, measured outputs of the first period, inputs."""

    def __init__(self, section: PoincareSection, model: Model, periods: int):
        measured = section.measured
        assert measured is not None
        self.samples, self.instants, self.stretch = measured
        self.section, self.model, self.periods = section, model, periods
        self.frequency = section.frequency
        # Channels that the model has as outputs, their columns, and which of them are angles.
        self.channels = [name for name in model.outputs if name in section.channels]
        self.columns = [section.channels.index(name) for name in self.channels]
        self.turning = np.isin(self.channels, [*section.angles, *model.angles])
        self.places = [model.outputs.index(name) for name in self.channels]
        signals = self.samples.signals[:, self.columns]
        self.scale = np.where(self.turning, 1.0, signals.std(axis=0))
        self.starts = np.flatnonzero(self.stretch[periods:] == self.stretch[:-periods])

    def first_period(self, start: int) -> np.ndarray:
        """Return the measured outputs (START_PHASES + 1, channels) over the period from a start."""
        at = self.instants[start] + np.arange(START_PHASES + 1) / (START_PHASES * self.frequency)
        at[-1] = min(at[-1], self.instants[start + 1])
        part = self.samples._replace(signals=self.samples.signals[:, self.columns])
        return local_fit(part, at, np.full(at.size, self.stretch[start]))[0]

    def table(self, start: int, steps: int) -> np.ndarray:
        """Return u, u̇, ü (2·steps·periods + 2, 3·inputs) at half steps from a start, by splines of the samples."""
        half = np.arange(2 * steps * self.periods + 2)
        if not self.model.inputs:
            return np.zeros((half.size, 0))
        time, stretch = self.samples.time, self.stretch[start]
        begin, end = self.instants[start], self.instants[start + self.periods]
        first, last = np.searchsorted(time, [begin, end]) + np.array([-BEYOND_RUN, BEYOND_RUN])
        span = slice(max(first, self.samples.starts[stretch]), min(last, self.samples.stops[stretch]))
        columns = [self.section.channels.index(name) for name in self.model.inputs]
        spline = make_interp_spline(time[span] - begin, self.samples.signals[span, columns], k=INPUT_SPLINE)
        at = np.minimum(half / (2 * steps * self.frequency), time[span][-1] - begin)
        return np.ascontiguousarray(np.hstack([spline(at, nu=order) for order in range(3)]))

    def misfit(self, outputs: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Return differences (…, phases, channels) of outputs from measured ones, in units of the channels' sd."""
        away = outputs - measured
        return np.where(self.turning, wrapped(away), away) / self.scale


class Library(NamedTuple):
    """States of the model on its motion, from which starts are taken, and outputs over the period that follows."""

    states: np.ndarray  # (count, size)
    outputs: np.ndarray  # (count, START_PHASES + 1, channels)

    @property
    def size(self) -> np.ndarray:
        """Standard deviation of the states (size,), at least that of a small part of the largest."""
        spread = self.states.std(axis=0)
        return np.maximum(spread, 1e-9 * spread.max() + np.finfo(float).tiny)


def library_of(
    recorded: Recorded, runner: Runner, theta: np.ndarray, seeds: Sequence[np.ndarray], starts: np.ndarray
) -> Library:
    """Return the states of runs from seeds (size,), with the inputs from starts."""
    states, outputs, every = [], [], runner.steps // START_PHASES
    for number, start in enumerate(starts.tolist()):
        table = recorded.table(start, runner.steps)
        y = seeds[number % len(seeds)]
        for period in range(recorded.periods):
            part = runner.part(table, period)
            path = runner.path(theta, y, part)
            if not np.isfinite(path).all():
                break
            states.append(y)
            outputs.append(runner.outputs(theta, path, part, every)[:, recorded.places])
            y = path[-1]
    return Library(np.array(states), np.array(outputs))


def enough_steps(recorded: Recorded, theta: np.ndarray, library: Library, start: int) -> Runner | None:
    """Return a runner with so many steps that a period is accurate from states of the library; None without one."""
    steps = FEWEST_STEPS_EACH
    some = library.states[:: max(1, len(library.states) // 20)]
    while steps <= MOST_STEPS_EACH:
        coarse, fine = (Runner(recorded.model, recorded.frequency, n) for n in (steps, 2 * steps))
        one, other = (
            np.array([r.path(theta, y, recorded.table(start, r.steps))[-1] for y in some]) for r in (coarse, fine)
        )
        error = np.abs(one - other) / library.size
        if np.nanmax(error, initial=0.0) < STEP_ERROR and np.isfinite(error).mean() > 0.5:
            return coarse
        steps *= 2
    return None


def explained_state(
    recorded: Recorded, runner: Runner, theta: np.ndarray, library: Library, measured: np.ndarray, table: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the state (size,) that explains measured outputs of a period best, and its relative misfit.

    `measured` (phases, channels) are the first of the phases of a period, NaN for channels that are not known. The
    iterations of Gauss and Newton begin at the states of the library with the nearest outputs. Directions of the state
    that the outputs do not determine stay there. The misfit is the rms in units of the channels' standard deviations.
    """
    part, every = runner.part(table, 0), runner.steps // START_PHASES
    known = np.isfinite(measured)

    def residual(y: np.ndarray) -> np.ndarray:
        outputs = runner.outputs(theta, runner.path(theta, y, part), part, every)
        return recorded.misfit(outputs[: len(measured), recorded.places], measured)[known]

    distances = np.mean(recorded.misfit(library.outputs[:, : len(measured)], measured)[:, known] ** 2, axis=1)
    best, least = library.states[0], np.inf
    for candidate in np.argsort(distances)[:CANDIDATES]:
        y, cost = _gauss_newton(residual, library.states[candidate], library.size)
        if cost < least:
            best, least = y, cost
    return best, float(np.sqrt(least))


def _gauss_newton(
    residual: Callable[[np.ndarray], np.ndarray], y: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the state at the least mean square of the residual near y, and that mean square."""
    here = residual(y)
    cost = float(np.mean(here**2)) if np.isfinite(here).all() else np.inf
    for _ in range(START_ITERATIONS if np.isfinite(cost) else 0):
        steps = START_STEP * np.diag(size)
        slopes = np.stack([(residual(y + step) - here) / START_STEP for step in steps], axis=1)
        if not np.isfinite(slopes).all():
            break
        move, before = -np.linalg.lstsq(slopes, here, rcond=LEAST_SLOPE)[0] * size, cost
        for halving in range(START_HALVINGS):
            there = residual(y + move / 2**halving)
            new = float(np.mean(there**2))
            if new < cost:
                y, here, cost = y + move / 2**halving, there, new
                break
        if not cost < (1.0 - NO_DECREASE) * before:
            break
    return y, cost


class FreeRun(NamedTuple):
    """A run of the model over some periods."""

    outputs: np.ndarray  # of all steps (periods·steps + 1, outputs); NaN after an overflow
    growth: np.ndarray  # logarithm of the growth of a small difference in each period (periods,)


def free_run(
    runner: Runner, theta: np.ndarray, start: np.ndarray, table: np.ndarray, periods: int, size: np.ndarray
) -> FreeRun:
    """Return a run, and the growth of the difference of a second one, whose distance is reduced after each period.

    This is the method of Benettin, Galgani and Strelcyn, Phys. Rev. A 14 (1976) 2338-2345, with lengths in units of
    `size` (size,).
    """
    outputs, growth = np.full((periods * runner.steps + 1, len(runner.model.outputs)), np.nan), np.full(periods, np.nan)
    y, direction = start, np.full(size.size, size.size**-0.5)
    for period in range(periods):
        part = runner.part(table, period)
        path = runner.path(theta, y, part)
        other = runner.path(theta, y + APART_BY * size * direction, part)[-1]
        away = (other - path[-1]) / (APART_BY * size)
        length = float(np.linalg.norm(away))
        if not (np.isfinite(path).all() and 0.0 < length < np.inf):
            break
        outputs[period * runner.steps : (period + 1) * runner.steps + 1] = runner.outputs(theta, path, part)
        growth[period], direction, y = np.log(length), away / length, path[-1]
    return FreeRun(outputs, growth)


def section_points(
    section: PoincareSection, model: Model, outputs: np.ndarray, steps: int, discarded: int
) -> np.ndarray:
    """Return the coordinates (points, d) of a run at whole periods, from the first that is not discarded on."""
    taus, periods = np.arange(len(outputs)) / steps, len(outputs) // steps
    columns = []
    pairs = [channel_and_delay(name) for name in section.coordinates]
    last = periods - int(np.ceil(max(0.0, *(delay for _, delay in pairs))))
    for channel, delay in pairs:
        at = np.arange(discarded, last + 1) + delay
        values = outputs[:, model.outputs.index(channel)]
        columns.append(CubicSpline(taus, values)(at) if np.isfinite(values).all() else np.full(at.size, np.nan))
    return wrapped(np.stack(columns, axis=1), np.isin(section.coordinates, section.angles))
