"""Posterior prediction of a chaotic attractor: free runs of the model against the section of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics import free_runs
from bayesperiodic.diagnostics.attractor_orbits import orbit_table
from bayesperiodic.diagnostics.attractor_statistics import (
    CONSISTENT,
    DIFFERENT,
    FEWEST_PIECES,
    Runs,
    Statistics,
    region,
)
from bayesperiodic.diagnostics.free_runs import Recorded, Runner
from bayesperiodic.diagnostics.predictive import draws_of
from bayesperiodic.estimation.adequacy import ADEQUACY_LEVEL, ALL, UNTESTED
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.orbits.coordinates import channels_of, integrand_of
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.orbits.section import PoincareSection
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.problem.parameters import SHIFT
from bayesperiodic.sampling.draws import Posterior

if TYPE_CHECKING:
    import pandas as pd

# Returns at the start of a run that are left out; fewest returns and runs.
DISCARDED, SHORTEST_RUN, FEWEST_RUNS = 5, 20, 20
# A start is not fitted if the misfit of its first period exceeds this fraction of the outputs' standard deviation.
LARGEST_MISFIT = 0.5
# Runs of the library from which starts are taken, and attempts to draw parameters within the support of the prior.
LIBRARY_RUNS, DRAWING_ATTEMPTS = 40, 100
# Draws at which orbits are sought.
ORBIT_DRAWS = 20
# Forcing periods by which the inputs of an orbit and of the section differ in phase at most.
LARGEST_PHASE_ERROR = 1 / 64
# Standard errors from which on an orbit is named.
FAR_ORBIT = 4.0


@dataclass(frozen=True)
class AttractorPrediction(Result):
    """Free runs of a model from draws of its parameters, against the recording of a chaotic motion.

    Attributes
    ----------
    table : DataFrame
        Rows "density", "runs that leave", "runs that settle", "Lyapunov exponent" and "all". Columns: ``model`` and
        ``recording``, the values that are compared; ``low`` and ``high``, the central 90 % of the values of ``model``
        that chance gives; ``p``; and ``verdict``, "different" where p, adjusted by Holm's method for the four tests, is
        below 1 %, "consistent", or "not tested"; where more than 10 % of the starts could not be fitted, "all" is not
        "consistent" but "not tested". Density: half the sum of the absolute differences of the fractions of
        points in the bins, 0 to 1. Runs: their fraction, and that of the pieces of the recording of the same length,
        with its interval. Exponent [1/s]: that of local maps of as many points of both.
    exponents : DataFrame
        Rows "model" and "recording": the largest Lyapunov ``exponent`` [1/s] and its standard error ``sd``, and those
        of local maps of their sections, ``local_maps`` and ``local_maps_sd``. The model's exponent is that of two
        neighbouring runs, the recording's that of local maps, whose ``sd`` includes their error in the model's runs.
    section, model_section : array (count, d), array (runs, returns, d)
        Points of the recording, and of the runs that stay in its region, without the first five returns.
    coordinates : tuple of str
    units : dict of str to str
        Of the coordinates, if known.
    orbits : dict of str to array (period, d)
        Points of the orbits given.
    orbit_table : DataFrame
        A row for each of them: ``period``; ``draws``, at how many of up to 20 draws the model has an orbit whose points
        are within five standard errors, which include 1 % of the section's size; the largest multiplier, ``measured``
        and ``predicted`` (median of these draws), with their standard deviations ``measured_sd`` and ``predicted_sd``;
        ``z_multiplier``, the difference of log|multiplier| in standard deviations, and ``z_points``, the largest
        difference of a coordinate of the points, from measurement and draws together. NaN where the model has none, or
        the measured multiplier has no error.
    runs, unfitted, left, settled : int
        Number of runs, of those whose start could not be fitted, and, of the others, of those that leave the region of
        the recording or become periodic.
    pieces, periods : int
        Number of pieces of the recording, and forcing periods of a run.
    misfit : float
        Median of the rms misfit of the first period, in units of the standard deviations of the outputs.
    synthetic : bool
        True if the recording was simulated.

    Examples
    --------
    `attractor_prediction`: a pendulum whose mass and length were fitted to two unstable orbits of period 1.

    >>> attractor_prediction.verdict, attractor_prediction.left, attractor_prediction.settled
    ('consistent', 0, 0)
    >>> attractor_prediction.table.index.tolist()
    ['density', 'runs that leave', 'runs that settle', 'Lyapunov exponent', 'all']
    >>> attractor_prediction.missing_orbits
    []
    """

    table: pd.DataFrame
    exponents: pd.DataFrame
    section: np.ndarray
    model_section: np.ndarray
    coordinates: tuple[str, ...]
    units: dict[str, str]
    orbits: dict[str, np.ndarray]
    orbit_table: pd.DataFrame
    runs: int
    unfitted: int
    left: int
    settled: int
    pieces: int
    periods: int
    misfit: float
    synthetic: bool

    @property
    def verdict(self) -> str:
        """Verdict of all tests."""
        return str(self.table.loc[ALL, "verdict"])

    @property
    def orbit_draws(self) -> int:
        """Number of draws at which the orbits were sought."""
        return min(self.runs, ORBIT_DRAWS)

    def __repr__(self) -> str:
        different = [str(row) for row in self.table.index[self.table["verdict"] == DIFFERENT] if row != ALL]
        untested = [str(row) for row in self.table.index[self.table["verdict"] == UNTESTED] if row != ALL]
        verdict = {
            DIFFERENT: f"The model does not predict the measured attractor: {', '.join(different)}",
            CONSISTENT: "No test distinguishes the model's attractor from the measured one",
        }.get(self.verdict, "The tests have no verdict, because too few runs have a start or stay in the region")
        one, other = (
            f"{value:.3g} ± {sd:.2g} 1/s" if np.isfinite(value) else "unknown"
            for value, sd in self.exponents[["exponent", "sd"]].to_numpy()
        )
        lines = [
            f"Free runs over {self.periods} forcing periods from {self.runs} draws, {self.unfitted} without a fit of "
            f"their start (rms misfit of the first period {self.misfit:.1%})",
            self.table.to_string(float_format="{:.3g}".format, na_rep="-"),
            f"{verdict} (overall false alarm rate {ADEQUACY_LEVEL:.0%}).",
            f"Not tested: {', '.join(untested)}." if untested and self.verdict != UNTESTED else "",
            f"Largest Lyapunov exponent of the model {one}, of the recording {other} (standard errors).",
            self._on_orbits(),
        ]
        return "\n".join(filter(None, lines))

    @property
    def missing_orbits(self) -> list[str]:
        """Names of the orbits given that the model does not have at half of the draws or more."""
        return [] if self.orbit_table.empty else [
            str(name) for name, count in self.orbit_table["draws"].items() if 2 * count <= self.orbit_draws
        ]  # fmt: skip

    def _on_orbits(self) -> str:
        """Return how many orbits the model has, which it does not have, and which differ significantly."""
        if self.orbit_table.empty:
            return ""
        missing, count = self.missing_orbits, len(self.orbit_table)
        scores = self.orbit_table[["z_multiplier", "z_points"]].drop(missing).abs().max(axis=1)
        apart = [str(name) for name in scores.index[scores > FAR_ORBIT]]
        names = f", not {'; '.join(missing)}" if missing else ""
        far = f" More than {FAR_ORBIT:g} standard errors away: {'; '.join(apart)}." if apart else ""
        return f"Of {count} measured orbits the model has {count - len(missing)} near the measured points{names}.{far}"


@in_one_thread
def predict_attractor(
    problem: Problem,
    posterior: Posterior | MapEstimate,
    section: PoincareSection,
    *,
    runs: int = 100,
    periods: int = 30,
    orbits: Orbits | Sequence[Orbit] = (),
    seed: int = 0,
    progress: bool = True,
) -> AttractorPrediction:
    """Predict a chaotic attractor by free runs of the model, and test it against the section of a recording.

    Each run has the parameters of a draw and the measured inputs of a part of the recording, and starts from the state
    that explains the measured outputs of the first period best, hidden states included. After several periods a chaotic
    run has forgotten its start, so that only statistics are compared: the density of the section, the fractions of runs
    that leave the region of the recording or become periodic, and the largest Lyapunov exponent.

    Parameters
    ----------
    problem : Problem
        All experiments must have the same parameters of the model. Sensors are not supported.
    posterior : Posterior or MapEstimate
        Of the problem. Of a misspecified model the robust draws are used, and of an estimate normal draws with
        `covariance` or, if the model is misspecified, `robust_covariance`, within the supports of the priors.
    section : PoincareSection
        Of a recording of the forced system, which need not be part of the problem. Its coordinates must be outputs of
        the model, delayed or not, no integrals, and the model's inputs must be recorded.
    runs, periods : int
        Number of runs, at least 20, and their length in forcing periods, at least 20. The recording must contain at
        least 10 pieces of that length.
    orbits : Orbits or sequence of Orbit
        Of the section, or of another one at its phase, from `find_orbits`, such as those that are not part of the
        problem. Phases are compared where orbits have waveforms of the inputs.
    seed : int
    progress : bool
        Show a progress bar.

    Returns
    -------
    AttractorPrediction
        `plot.attractor` draws it.

    Raises
    ------
    ValueError
        For too few runs or periods, a section of points alone, of crossings or with integrals, one that is too short,
        coordinates or inputs that do not belong to the model, and draws of another problem.
    RuntimeError
        If the model has no motion from which runs could start, or fewer than 10 starts can be fitted.

    Notes
    -----
    Inputs are interpolated by splines of degree 5, with their noise.

    *Density.* The bins are boxes of all coordinates, as small as 20 points of the runs in each allow. The distance is
    compared with that of a random half of the recording from the other half, or of pieces as numerous as the runs from
    the rest, in pieces as long as the runs, which contain the dependence of consecutive points; it is scaled to the
    number of points. The density of the model is the mean over the draws: wide posteriors widen it.

    *Runs that leave* have an output beyond the range of the recording (without 0.1 % of the samples at each end) by
    more than 25 % of the range. *Runs that settle* repeat their points after up to 4 returns, within 2 % of the
    section's size over the last 10. Both are compared with the pieces of the recording by Fisher's exact test, and runs
    that leave are not part of the other tests.

    *Lyapunov exponent.* The recording's is that of local maps of its section. Their systematic error cancels in the
    comparison with the same maps of as many points of the runs, with the same noise; it is measured by the exponent of
    two neighbouring runs of the model. Local maps are not fitted to runs that settle.

    *Orbits* are solved by multiple shooting with the mean inputs of a forcing period, at the first 20 draws.

    A recording of one set-up cannot show that the model is right, only that these statistics do not contradict it.

    Examples
    --------
    The same pendulum with a shorter arm:

    >>> wrong = dataclasses.replace(pendulum_fit, theta=pendulum_fit.theta | {"l": 0.29})
    >>> bp.predict_attractor(pendulum_problem, wrong, pendulum_section, runs=40, progress=False).verdict
    'different'
    """
    _checks.instance("problem", problem, Problem)
    _checks.instance("posterior", posterior, (Posterior, MapEstimate))
    _checks.instance("section", section, PoincareSection)
    runs, periods = _checks.integer("runs", runs, FEWEST_RUNS), _checks.integer("periods", periods, SHORTEST_RUN)
    generator = np.random.default_rng(_checks.integer("seed", seed, 0))
    of = {"fit" if isinstance(posterior, MapEstimate) else "posterior": posterior}
    problem = check_results(problem, **of)
    experiment = _experiment_of(problem)
    recorded = _recorded(problem, section, periods)
    given = _orbits(recorded, section, orbits)
    thetas = np.ascontiguousarray(problem.parameters(_parameters(problem, posterior, runs, generator), experiment))
    middle = np.ascontiguousarray(np.median(thetas, axis=0))
    runner, library = _prepared(recorded, middle, _seeds(problem, posterior), generator)
    moved = _runs(recorded, runner, library, thetas, generator, progress)
    solved = orbit_table(recorded, runner, thetas[:ORBIT_DRAWS], library, given)
    pieces = _pieces(section, moved.points.shape[1])
    statistics = Statistics(recorded, moved, pieces, generator)
    table, exponents = statistics.table()
    return AttractorPrediction(
        table=table, exponents=exponents, section=section.points, model_section=moved.points[statistics.stays],
        coordinates=section.coordinates,
        units={name: u for name in section.coordinates if (u := _unit(problem, name))},
        orbits={orbit.name: orbit.points for orbit in given}, orbit_table=solved, runs=runs,
        unfitted=runs - len(moved.points), left=int(moved.left.sum()), settled=int(statistics.settled.sum()),
        pieces=len(pieces), periods=periods, misfit=float(np.median(moved.misfit)), synthetic=section.synthetic,
    )  # fmt: skip


def _experiment_of(problem: Problem) -> str:
    """Return an experiment with the parameters of all; raise a ValueError if they differ."""
    maps = problem.parameter_maps
    for parameter in problem.model.parameters:
        if len({(m.columns.get(parameter), m.fixed.get(parameter)) for m in maps.values()}) > 1:
            raise ValueError(
                f"problem: must have the same parameters of the model in all experiments, got several {parameter!r}."
            )
    return problem.experiments[0].name


def _recorded(problem: Problem, section: PoincareSection, periods: int) -> Recorded:
    """Return the recording of a section; raise a ValueError unless runs of the model can be compared with it."""
    model = problem.model
    sensed = [*problem.sensors.given, *(name for name in problem.names if name.split("[")[0] == SHIFT)]
    if sensed:
        raise ValueError(
            f"problem: must have no sensors and delays, got {', '.join(sensed)}. Make gains and offsets parameters of "
            "the model's outputs."
        )
    if section.measured is None:
        raise ValueError("section: must be of a recording, got points alone, which have neither starts nor inputs.")
    returns = np.diff(section.measured[1]) * section.frequency
    if np.abs(returns - np.round(returns)).max() > 1e-6:
        raise ValueError("section: must be of a forced system, once a forcing period, got crossings of a plane.")
    if any(map(integrand_of, channels_of(section.coordinates))):
        raise ValueError(
            f"section: must have no integrals, got {section.coordinates}, which are known but for a line in each "
            "stretch. Make one of the same recordings with delayed coordinates, and give no orbits of the other."
        )
    for name in channels_of(section.coordinates):
        _checks.one_of("section: coordinates", name, model.outputs)
    for name in model.inputs:
        _checks.one_of("section: inputs of the model", name, section.inputs)
    recorded = Recorded(section, model, periods)
    if recorded.starts.size < FEWEST_PIECES * periods:
        raise ValueError(
            f"section: must have at least {FEWEST_PIECES * periods} points with {periods} later ones in their unbroken "
            f"stretch, got {recorded.starts.size}. Record more periods, or give fewer periods a run."
        )
    return recorded


def _orbits(recorded: Recorded, section: PoincareSection, orbits: Orbits | Sequence[Orbit]) -> list[Orbit]:
    """Return orbits; raise a ValueError unless they belong to a section with these coordinates and this phase."""
    _checks.instance("orbits", orbits, (Orbits, list, tuple))
    given = list(orbits)
    for k, orbit in enumerate(given):
        _checks.instance(f"orbits[{k}]", orbit, Orbit)
        if (orbit.coordinates, orbit.angles) != (section.coordinates, section.angles) or orbit.cycle is None:
            raise ValueError(
                f"orbits[{k}]: must be of a section of a recording with the coordinates {section.coordinates}, got "
                f"{orbit.name!r} with {orbit.coordinates}."
            )
        here, there = (_input_phases(recorded, of) for of in (section, orbit))
        for name in here.keys() & there.keys():
            away = float(np.angle(there[name] / here[name])) / (2.0 * np.pi)
            if abs(away) > LARGEST_PHASE_ERROR:
                raise ValueError(
                    f"orbits[{k}]: must be of a section at the phase of `section`, got {orbit.name!r}, whose "
                    f"{name!r} is {away:+.3f} forcing periods off. Make both sections with the same origin, or give "
                    "find_orbits that of `section` first."
                )
    return given


def _input_phases(recorded: Recorded, of: PoincareSection | Orbit) -> dict[str, complex]:
    """Return the component at the forcing frequency, from the section's phase on, of inputs in which it dominates."""
    result = {}
    for name in recorded.model.inputs:
        if isinstance(of, Orbit):
            if of.waveform is None or name not in of.waveform.values:
                continue
            values = np.asarray(of.waveform.values[name])
            turns = np.arange(values.size) * of.period / values.size
        else:
            values = recorded.samples.signals[:, of.channels.index(name)]
            turns = recorded.frequency * (recorded.samples.time - recorded.instants[0])
        component = complex(np.mean((values - values.mean()) * np.exp(-2j * np.pi * turns)))
        if 2.0 * abs(component) ** 2 > 0.5 * values.var():
            result[name] = component
    return result


def _parameters(
    problem: Problem, posterior: Posterior | MapEstimate, runs: int, generator: np.random.Generator
) -> np.ndarray:
    """Return draws θ (runs, names)."""
    if isinstance(posterior, Posterior):
        shown = posterior.headline
        size = shown.draws(problem.names[0]).size
        return draws_of(problem, shown, generator.choice(size, runs, replace=size < runs))[0]
    covariance = (posterior.robust_covariance if posterior.misspecified else posterior.covariance).to_numpy()
    if not np.isfinite(covariance).all():
        raise ValueError("posterior: must have a finite covariance, got parameters that the data do not determine.")
    mean, ends = np.array([*posterior.theta.values()]), np.array([*problem.joint_prior.supports.values()]).T
    result = np.empty((0, mean.size))
    for _ in range(DRAWING_ATTEMPTS):
        draws = generator.multivariate_normal(mean, covariance, runs)
        result = np.vstack([result, draws[np.all((ends[0] < draws) & (draws < ends[1]), axis=1)]])
        if len(result) >= runs:
            return result[:runs]
    raise ValueError(
        "posterior: must have an estimate well within the prior, got one at its end. Use draws of `sample`."
    )


def _seeds(problem: Problem, posterior: Posterior | MapEstimate) -> list[np.ndarray]:
    """Return states and rates (size,) on the periodic solutions of the experiments, at tau = 0."""
    if isinstance(posterior, MapEstimate):
        solutions = posterior.solutions
    else:
        theta = np.array([np.median(posterior.draws(name)) for name in problem.names])
        guesses = posterior.guesses([*problem.observations], problem.model.states)
        solutions = problem.anchored(theta, guesses).density().solver.solutions(theta)
    return [_start(problem, one) for one in solutions.values() if one.converged]


def _start(problem: Problem, solution: PeriodicSolution) -> np.ndarray:
    """Return the states and the rates of the second-order ones at tau = 0, the latter by differences."""
    orders, step = problem.model.orders, 1.0 / (solution.samples * solution.frequency)
    rates = [(z[1] - z[0]) / step for name, z in solution.states.items() if orders[name] == 2]
    return np.array([*(z[0] for z in solution.states.values()), *rates])


def _prepared(
    recorded: Recorded, middle: np.ndarray, seeds: list[np.ndarray], generator: np.random.Generator
) -> tuple[Runner, free_runs.Library]:
    """Return what integrates the model accurately, and states on its motion at one θ; RuntimeError without motion."""
    coarse = Runner(recorded.model, recorded.frequency, free_runs.FEWEST_STEPS_EACH)
    some = generator.choice(recorded.starts, LIBRARY_RUNS)
    library = free_runs.library_of(recorded, coarse, middle, seeds, some) if seeds else None
    runner = free_runs.enough_steps(recorded, middle, library, some[0]) if library and len(library.states) else None
    if library is None or runner is None:
        raise RuntimeError(
            "posterior: its parameters must give a bounded motion of the model with the measured inputs, got none that "
            f"at most {free_runs.MOST_STEPS_EACH} steps a period integrate. Check units and the phase of the forcing."
        )
    return runner, library


def _runs(
    recorded: Recorded, runner: Runner, library: free_runs.Library, thetas: np.ndarray,
    generator: np.random.Generator, progress: bool,
) -> Runs:  # fmt: skip
    """Return one run for each draw of the model's parameters (runs, parameters)."""
    low, high = region(recorded)
    points, growth, left, misfits = [], [], [], []
    starts = generator.choice(recorded.starts, len(thetas), replace=recorded.starts.size < len(thetas))
    bar = tqdm(thetas, desc="free runs", unit="run", disable=not progress)
    for theta, start in zip(bar, starts, strict=True):
        table = recorded.table(start, runner.steps)
        y, misfit = free_runs.explained_state(recorded, runner, theta, library, recorded.first_period(start), table)
        misfits.append(misfit)
        if not misfit < LARGEST_MISFIT:
            continue
        run = free_runs.free_run(runner, theta, y, table, recorded.periods, library.size)
        shown = run.outputs[:, recorded.places]
        left.append(not np.all((low <= shown) & (shown <= high) | recorded.turning))
        points.append(free_runs.section_points(recorded.section, runner.model, run.outputs, runner.steps, DISCARDED))
        growth.append(float(run.growth[DISCARDED:].mean()))
    if len(points) < FEWEST_PIECES:
        raise RuntimeError(
            f"posterior: must explain the measured outputs over single periods, got {len(points)} of {len(thetas)} "
            f"starts with a misfit below {LARGEST_MISFIT:.0%} of their standard deviations. Check the model, the "
            "units, and the phase of the section against that of the forcing."
        )
    return Runs(np.array(points), np.array(growth), np.array(left), np.array(misfits))


def _pieces(section: PoincareSection, length: int) -> np.ndarray:
    """Return the positions (pieces, length) of consecutive points of unbroken stretches."""
    measured = section.measured
    assert measured is not None
    ends = np.append(np.flatnonzero(np.diff(measured[2])) + 1, len(section))
    begins = np.append(0, ends[:-1])
    firsts = [np.arange(b, e - length + 1, length) for b, e in zip(begins, ends, strict=True)]
    return np.concatenate(firsts)[:, None] + np.arange(length)


def _unit(problem: Problem, coordinate: str) -> str:
    """Return the unit of a coordinate, "" if it is unknown."""
    return problem.model.units.get(channels_of([coordinate])[0], "")
