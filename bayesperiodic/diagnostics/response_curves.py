"""Response curves: what a table shows, and the model's branch through it at an estimate."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bayesperiodic import _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.measurements import Amplitude, PeakToPeak, Phase, RootMeanSquare
from bayesperiodic.data.sweep import Sweep
from bayesperiodic.density.log_posterior import Linearisation, LogPosterior
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import ResponseSolver, orbit_multipliers
from bayesperiodic.density.sweeps import tables
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.quantities import peak_to_peak
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.solve import solve_driven
from bayesperiodic.periodic.table_branch import between, follow

# Points of a branch for each passage of its table, about.
POINTS_A_PASSAGE = 150
Waves = Mapping[str, np.ndarray]  # signals (…, points) by channel


class Quantity(NamedTuple):
    """A number that a table shows for each frequency."""

    word: str
    channel: str
    harmonic: int = 1
    to: str = ""  # of a phase the channel whose phase is subtracted

    @property
    def label(self) -> str:
        """What it is, in words."""
        order = f", harmonic {self.harmonic}" if self.harmonic > 1 else ""
        return f"{self.word} of {self.channel}{order}" + (f" against {self.to}" if self.to else "")

    @property
    def is_phase(self) -> bool:
        """Whether it is a phase [rad]."""
        return self.word == Phase.word

    def of(self, waves: Waves) -> np.ndarray:
        """Return the quantity (…,) of signals."""
        signal = waves[self.channel]
        if self.word == PeakToPeak.word:
            return peak_to_peak(signal)
        if self.word == RootMeanSquare.word:
            return signal.std(axis=-1)
        c = _fourier.coefficients(signal, self.harmonic)[..., self.harmonic]
        if not self.is_phase:
            return np.abs(c)
        other = _fourier.coefficients(waves[self.to], self.harmonic)[..., self.harmonic]
        return np.angle(c * np.conj(other))


class Curve(NamedTuple):
    """The model's branch through a table at an estimate, in its order."""

    frequency: np.ndarray  # (points,) [Hz]
    waves: dict[str, np.ndarray]  # (points, samples) of outputs and inputs
    stable: np.ndarray  # bool (points,)
    folds: np.ndarray  # bool (points,)


def quantities(experiment: Experiment) -> dict[Quantity, float]:
    """Return what an experiment shows of its table, with the measured values."""
    waves: Waves = {**experiment.inputs, **experiment.outputs}
    result: dict[Quantity, float] = {}
    for channel in experiment.outputs:
        shown = [Quantity(Amplitude.word, channel)]
        shown += [Quantity(Phase.word, channel, to=name) for name in [*experiment.inputs][:1]]
        result |= {one: float(one.of(waves)) for one in shown}
    for one in experiment.measurements:
        to = one.to if isinstance(one, Phase) else ""
        result[Quantity(one.word, one.channel, getattr(one, "harmonic", 1), to)] = one.value
    return result


def predicted(problem: Problem, solver: ResponseSolver, theta: np.ndarray) -> dict[str, dict[Quantity, np.ndarray]]:
    """Return the quantities (solves,) of every point of a table at θ (solves, names); NaN where a solve fails.

    They are those that the sensors show.
    """
    simulation, result = solver.solve(theta), {}
    for e in (e for table in tables(problem).values() for e in table):
        observation, response = problem.observations[e.name], simulation.response(e.name)
        waves = {**e.inputs, **observation.predicted(response)} if e.outputs else {}
        off = observation.quantities(response)
        values, place = {}, dict.fromkeys(off, 0)
        if e.outputs:
            values = {shown: shown.of(waves) for shown in quantities(e) if shown.channel in e.outputs}
        for one in e.measurements:
            to = one.to if isinstance(one, Phase) else ""
            key = Quantity(one.word, one.channel, getattr(one, "harmonic", 1), to)
            values[key] = one.value - off[one.label][..., place[one.label]]
            place[one.label] += 1
        failed = simulation.statuses(e.name) != CONVERGED
        result[e.name] = {key: np.where(failed, np.nan, value) for key, value in values.items()}
    return result


def at_estimate(problem: Problem, fit: MapEstimate) -> ResponseSolver:
    """Return the solver anchored at an estimate's orbits."""
    guesses = {name: solution.states for name, solution in fit.solutions.items()}
    return ResponseSolver.start(problem, problem.vector(fit.theta), guesses)


def curves(problem: Problem, fit: MapEstimate) -> dict[Sweep, Curve]:
    """Return the model's branch through every table at an estimate, without the sensors."""
    theta, result = problem.vector(fit.theta), {}
    for sweep, table in tables(problem).items():
        parameters = [problem.parameters(theta[None], e.name)[0] for e in table]
        rows = [problem.equations[e.name] for e in table]
        parts = max(1, POINTS_A_PASSAGE // len(rows))
        fine, at = [rows[0]], [parameters[0]]
        for k in range(1, len(rows)):
            fine += [between(rows[k - 1], rows[k], part / parts) for part in range(1, parts)] + [rows[k]]
            at += [parameters[k - 1]] * (parts - 1) + [parameters[k]]
        first = fit.solutions[table[0].name]
        z = solve_driven(rows[0], at[0], first if first.frequency == rows[0].frequency else "static")[0].z
        with np.errstate(all="ignore"):
            passages = list(follow(fine, at, 0, z))
        folds, last, given = np.array([p.is_fold for p in passages]), 0, []
        for p in passages:
            last = last if p.point is None else p.point
            given.append(at[last])
        stable = np.array([_stable(p.equations, theta_of, p.z) for p, theta_of in zip(passages, given, strict=True)])
        outputs = np.array([p.equations.outputs(p.z, theta_of) for p, theta_of in zip(passages, given, strict=True)])
        for k in (np.flatnonzero(folds[1:]) + 1).tolist():  # a multiplier is 1: a fold ends the part before it
            stable[k] = stable[k - 1] != folds[k - 1]
        names, inputs = problem.model.outputs, problem.model.inputs
        result[sweep] = Curve(
            np.array([p.equations.frequency for p in passages]),
            {name: outputs[..., c] for c, name in enumerate(names)}
            | {name: np.array([p.equations.inputs[:, c] for p in passages]) for c, name in enumerate(inputs)},
            stable,
            folds,
        )
    return result


def _stable(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> bool:
    largest = orbit_multipliers(equations, parameters, z, 1)
    return bool(np.abs(largest).max(initial=0.0) < 1.0)


def residuals(problem: Problem, fit: MapEstimate, solver: ResponseSolver) -> dict[str, list[tuple[str, np.ndarray]]]:
    """Return the whitened residuals (size,) of every experiment's measured values, with their channels."""
    density = LogPosterior(problem, solver)
    here = Linearisation(problem.vector(fit.theta), solver, density.comparisons)
    noise = np.array([fit.noise[name] for name in problem.noise_names])
    white = problem.likelihood.whitened(list(here.residuals), noise)
    result: dict[str, list[tuple[str, np.ndarray]]] = {}
    for block, values in zip(problem.likelihood.blocks, white, strict=True):
        if block.observed:
            channel = problem.observations[block.experiment].compared_channels[block.place]
            result.setdefault(block.experiment, []).append((channel, values))
    return result
