"""Climbs to the optimum: from a start, from the measured orbits, and from draws of the priors."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from bayesperiodic._linalg import unwarned
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.initial_orbits import InitialEstimate, measured_orbits, simultaneous_fit
from bayesperiodic.density.log_posterior import NATURAL, Linearisation, LogPosterior
from bayesperiodic.density.orbit_check import MOST_UNEXPLAINED
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import InitialOrbit, ResponseSolver, initial_orbit
from bayesperiodic.density.sweeps import tables
from bayesperiodic.estimation.adequacy import misfit_at
from bayesperiodic.estimation.gauss_newton import (
    MAX_STEP_HALVINGS,
    MAX_STEPS,
    End,
    Iterate,
    Objective,
    climb,
    preference,
)
from bayesperiodic.estimation.modes import SEPARATE_SDS, SHOWN_AFTER, optimum_of
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.element_forces import times
from bayesperiodic.periodic.harmonics import harmonics, on_grid, resized
from bayesperiodic.problem.description import Description

# Choices of the sheets of tables' branches that are tried after the first.
MOST_SHEET_CHANGES = 5
# Factor of the errors of condensed solves in climbs that lead to the neighbourhood of an optimum.
COARSENESS = 1000.0
# Points from which on solves without internal states are worth such climbs.
MANY_POINTS = 256
# Gain of a step in units of the square of the least one [standard deviations] that ends such a climb: far from the data
# Gauss-Newton's steps are too long, and the errors of the solves hide what is gained.
SMALL_PART = 0.1
# Halvings of a step from a draw of a condensed model; solves that fail cost most.
HALVINGS_FROM_DRAWS = 3
# Standard deviation of a phase of which nothing is known [rad].
RANDOM_PHASE = np.pi / np.sqrt(3.0)
# Errors added to tables: of sizes, relative to the largest of the table, of phases [rad], and of relative frequencies.
WIDE_SHARE, WIDE_PHASE, WIDE_RESOLUTION = 0.1, 0.1, 0.02
# Harmonics that give the size of the forces, and the part of the harmonics, the highest, that give the noise.
FIRST_HARMONICS, OF_NOISE = 3, 0.25
# Smallest noise of an output, relative to its largest harmonic, and smallest singular values in a harmonic.
LEAST_NOISE, LEAST_SINGULAR = 1e-6, 1e-6


def objective_near(problem: Problem, near: Linearisation) -> Objective:
    """Return the objective whose solves start from a linearisation."""
    return Objective(LogPosterior(problem, near.solver, coordinates=NATURAL), of_total=True)


def of_problem(problem: Problem, iterate: Iterate) -> tuple[Objective, Iterate | None]:
    """Return objective and iterate, solved from the same orbits, of a problem with other errors of the inputs."""
    if iterate.here.solver.problem is problem:
        return objective_near(problem, iterate.here), iterate
    near = LogPosterior(problem, iterate.here.solver.carried(problem, iterate.theta)).linearise(iterate.theta)
    objective = objective_near(problem, near)
    return objective, objective.iterate(near, iterate.noise, all_shapes=True)


def on_fewer_points(problem: Problem, theta: np.ndarray) -> tuple[Problem | None, Iterate | None]:
    """Return the problem of a condensed model whose solves have larger errors, and the precise iterate at the start.

    The first is None for others, and where solves without internal states take few points. With such states the second
    is None.
    """
    model, first = problem.model, None
    if not isinstance(model, CondensedModel) or tables(problem):
        return None, None
    if not model.state_owners:
        first = first_iterate(problem, theta)
        orbits = [orbit.anchor for orbit in first.here.solver.anchors.values()] if first else []
        if first and max((len(a.z) for a in orbits if isinstance(a, Anchor)), default=0) < MANY_POINTS:
            return None, first
    coarse = problem.replace(input_errors=problem.input_errors or None, anchors=problem.anchors or None)
    equations: Mapping[str, Any] = problem.equations
    vars(coarse)["equations"] = {n: replace(e, coarseness=COARSENESS) for n, e in equations.items()}
    return coarse, first


def coarsely(
    problem: Problem, coarse: Problem | None, theta: np.ndarray, progress: bool, ends: Sequence[End] = (),
    halvings: int = MAX_STEP_HALVINGS,
) -> Iterate | None:  # fmt: skip
    """Return the iterate where a climb ends whose solves have larger errors; None if it does not begin.

    Friction and contact need many points, and such climbs end close to an optimum. One that comes close to one of the
    ends returns the iterate of that.
    """
    first = coarse and first_iterate(coarse, theta)
    if not (coarse and first):
        return None
    end = climbed(objective_near(coarse, first.here), first, progress, MAX_STEPS, ends, halvings, SEPARATE_SDS)
    return end.iterate if any(end is one for one in ends) else of_problem(problem, end.iterate)[1]


def rough(iterate: Iterate) -> End:
    """Return the end of a climb with larger errors, from which to climb on."""
    return End(iterate, "iterations", np.array([iterate.objective]))


def first_iterate(problem: Problem, theta: np.ndarray) -> Iterate | None:
    """Return the anchored iterate at a start; None if the log-posterior is not finite there."""
    if not np.isfinite(problem.joint_prior.log_prob(theta)):
        return None
    initial = simultaneous_fit(problem, theta)
    if initial is not None and initial.states:
        near = linearised(problem, theta, initial)
        iterate = objective_near(problem, near).iterate(near, problem.likelihood.guess())
        if iterate is not None:
            return iterate
    if initial is not None and not any(o.whole for o in problem.observations.values()):
        return None
    near = linearised(problem, theta, None)
    return objective_near(problem, near).iterate(near, problem.likelihood.guess())


def linearised(problem: Problem, theta: np.ndarray, initial: InitialEstimate | None) -> Linearisation:
    """Return residuals and Jacobian where orbits and parameters fit together, or else at θ."""
    if initial is None or not initial.states:
        return near_data(problem, theta) or _on_sheets(problem, problem.density().linearise(theta))
    return LogPosterior(problem, ResponseSolver.start(problem, initial.theta, initial.states)).linearise(initial.theta)


def _on_sheets(problem: Problem, here: Linearisation) -> Linearisation:
    """Return the same with the points of tables on the sheets of their branches that fit the data best at this θ.

    Orbits that are followed from another θ, at which the branch has other folds, may be on others.
    """
    if not tables(problem):
        return here
    return LogPosterior(problem, here.solver.on_best_sheets(here.theta)).linearise(here.theta)


def in_wide_tables(problem: Problem, theta: np.ndarray, draws: np.ndarray, progress: bool) -> list[np.ndarray]:
    """Return where climbs in tables with larger errors end, the best first, of each start; nothing without tables."""
    wide = widened(problem)
    first = wide and first_iterate(wide, theta)
    if not (wide and first):
        return []
    objective = objective_near(wide, first.here)
    ends: list[End] = [on_best_sheets(wide, climbed(objective, first, progress), progress)]
    lost = []
    for draw in draws:
        end = _from_draw(objective, ends, draw, progress)
        if end:
            ends.append(end)
        else:
            lost.append(draw)
    return [*(end.iterate.theta for end in sorted(ends, key=preference, reverse=True)), *lost]


def from_draws(
    objective: Objective, starting: Sequence[np.ndarray], end: End, fewest: int, progress: bool,
    coarse: Problem | None = None,
) -> list[End | None]:  # fmt: skip
    """Return the ends of the iterations from θ in turn, draws of the prior behind the first; the first end is given.

    Those of a `coarse` problem are not yet optima.

    After `fewest` starts, the others follow only as long as tests reject the model at the best end.
    """
    ends: list[End | None] = [end]
    problem: Any = objective.density.problem
    for draw in starting[1:]:
        reached = [one for one in ends if one]
        if len(ends) >= fewest and not misfit_at(problem, max(reached, key=preference).iterate, len(ends)):
            break
        ends.append(end if draw is starting[0] else _from_draw(objective, reached, draw, progress, coarse))
    return ends


def _from_draw(
    objective: Objective, ends: Sequence[End], theta: np.ndarray, progress: bool, coarse: Problem | None = None
) -> End | None:
    """Return the end of the iteration from a draw of the prior; None if there is no orbit or no finite density.

    It is solved from the orbits of the first end, condensed models from those that the data show. It is one of the ends
    where it comes close to that.
    """
    first, halvings = ends[0].iterate, MAX_STEP_HALVINGS
    problem: Any = objective.density.problem
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if isinstance(problem.model, CondensedModel):
            halvings = HALVINGS_FROM_DRAWS
            other = coarsely(problem, coarse, theta, progress, ends, halvings)
            if other is not None and (known := [end for end in ends if end.iterate is other]):
                return known[0]
            if other is not None:
                return rough(other)
            other = objective.iterate(linearised(problem, theta, None), problem.likelihood.guess())
        else:
            other = objective.at(theta, first.here, problem.likelihood.guess())
            other = other and objective.anchored(other)
        return None if other is None else climbed(objective, other, progress, ends=ends, halvings=halvings)


def climbed(
    objective: Objective, first: Iterate, progress: bool, most: int = MAX_STEPS, ends: Sequence[End] = (),
    halvings: int = MAX_STEP_HALVINGS, least: float = 0.0,
) -> End:  # fmt: skip
    """Climb with a progress bar, until a step is below the least [standard deviations] or gains as little.

    Where an iterate comes close to one of the ends, that is returned.
    """
    reached: list[End] = []
    heights = [first.objective]
    with tqdm(desc="MAP", unit="iteration", leave=False, disable=not progress, delay=SHOWN_AFTER) as bar:

        def report(iterate: Iterate, size: float) -> bool:
            bar.set_postfix_str(f"objective {iterate.objective:.6g}, step {size:.2g} sd", refresh=False)
            bar.update()
            known = optimum_of(objective, iterate, ends) if size < SEPARATE_SDS else None
            reached.extend([known] if known else [])
            gain, heights[0] = iterate.objective - heights[0], iterate.objective
            # Exact climbs, of which the least is zero, have their own criteria, and rounding may lower the objective.
            return known is not None or (least > 0.0 and (size < least or gain < SMALL_PART * least**2))

        end = climb(objective, first, report=report, most=most, halvings=halvings)
    return reached[0] if reached else end


def on_best_sheets(problem: Problem, end: End, progress: bool) -> End:
    """Return the end of a climb; where tables fit better on other sheets of their branches, the best from there."""
    for _ in range(MOST_SHEET_CHANGES if tables(problem) else 0):
        theta = end.iterate.theta
        solver = end.iterate.here.solver.on_best_sheets(theta)
        if end.iterate.here.solver.on_same_orbits(solver):
            break
        near = LogPosterior(problem, solver).linearise(theta)
        objective = objective_near(problem, near)
        first = objective.iterate(near, problem.likelihood.guess())
        if first is None:
            break
        other = climbed(objective, first, progress)
        if preference(other) <= preference(end):
            break
        end = other
    return end


def on_measured_orbits(problem: Problem, start: np.ndarray, end: End, progress: bool) -> End:
    """Return the end of a climb; if its orbits are not the measured ones, the best of those from the measured orbits.

    They are not if they differ in kind, or leave most of the variance of a channel unexplained.
    """
    if not _doubtful(problem, end):
        return end
    for near in _near_measured_orbits(problem, end.iterate, start):
        objective = objective_near(problem, near)
        first = objective.iterate(near, problem.likelihood.guess())
        if first is not None:
            end = max(end, climbed(objective, first, progress), key=preference)
        if not _doubtful(problem, end):
            break
    return end


def _doubtful(problem: Problem, end: End) -> bool:
    here = end.iterate.here
    left = fractions_left(problem, here.compared()).values()
    return bool(here.other_orbits) or max(left, default=0.0) > MOST_UNEXPLAINED


def _near_measured_orbits(problem: Problem, end: Iterate, start: np.ndarray) -> Iterator[Linearisation]:
    """Yield where to start again: near orbits that give the measured outputs, and where simultaneous fits of them end.

    Orbits and parameters are looked for from the start and from the estimate; of condensed models the orbits, at the
    estimate.
    """
    if isinstance(problem.model, CondensedModel):
        near = near_data(problem, end.theta)
        yield from [near] if near else []
        return
    if problem.model.autonomous or not all(e.outputs for e in problem.experiments):
        return
    orbits = end.here.solver.solutions(end.theta, sensitivities=False)
    solutions = {name: solution.states for name, solution in orbits.items()}
    for theta in (start, end.theta):
        measured = measured_orbits(problem, theta, solutions)
        for initial in (measured, simultaneous_fit(problem, measured.theta, measured.states)):
            if initial is not None and initial.states:
                yield linearised(problem, initial.theta, initial)


def fractions_left(problem: Problem, residuals: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, float]:
    """Return the fraction of each channel's variance that is left in residuals, of quantities of their mean square."""
    measured = {e.name: {c: _varying(e, y) for c, y in e.outputs.items()} | _scales(e) for e in problem.experiments}
    compared = (*problem.channels, *problem.quantities)
    power = {c: max(pooled(problem, c, measured) ** 2, np.finfo(float).tiny) for c in compared}
    return {c: pooled(problem, c, residuals) ** 2 / whole for c, whole in power.items()}


def _varying(experiment: Experiment, output: np.ndarray) -> np.ndarray:
    """Return an output about its mean over the measured points; itself where the points of a mask have one value."""
    seen = output[experiment.measured_points]
    return output - seen.mean() if experiment.mask is None or np.ptp(seen) > 0.0 else output


def _scales(experiment: Experiment) -> dict[str, np.ndarray]:
    """Return what errors of measured quantities are compared with, by label: their values; of phases, any phase."""
    result: dict[str, list[float]] = {}
    for one in experiment.measurements:
        result.setdefault(one.label, []).append(RANDOM_PHASE if one.signed else one.value)
    return {label: np.array(values) for label, values in result.items()}


def pooled(problem: Problem, channel: str, signals: Mapping[str, Mapping[str, np.ndarray]]) -> float:
    """Return the root mean square of a channel over the measured points of all experiments, or of a quantity."""
    having = [(e, signals[e.name][channel]) for e in problem.experiments if channel in signals[e.name]]
    values = [part[e.measured_points] if channel in e.outputs else part for e, part in having]
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2)))


def widened(problem: Problem) -> Problem | None:
    """Return the problem with larger errors of its tables; None without tables.

    A row that was measured before a jump must be reached by the branch of the model, within the resolution of its
    frequency, and precise amplitudes leave each local optimum apart from the others. With larger errors the same rows
    have few optima, from which the climbs to those of the tables are short.
    """
    wide: dict[str, Experiment] = {}
    for table in tables(problem).values():
        largest = _largest(table)
        wide |= {e.name: _widened(e, largest) for e in table}
    if not wide:
        return None
    return problem.replace(experiments=[wide.get(e.name, e) for e in problem.experiments])


def _largest(table: Iterable[Experiment]) -> dict[str, float]:
    """Return the largest value of each measured quantity."""
    largest: dict[str, float] = {}
    for one in (one for e in table for one in e.measurements if not one.signed):
        largest[one.label] = max(largest.get(one.label, 0.0), one.value)
    return largest


def _widened(experiment: Experiment, largest: dict[str, float]) -> Experiment:
    assert experiment.sweep is not None
    measurements = [
        one if one.sd is None else replace(one, sd=float(np.hypot(one.sd, _added_error(one.label, largest))))
        for one in experiment.measurements
    ]
    resolution = max(experiment.sweep.resolution, WIDE_RESOLUTION)
    return replace(experiment, measurements=measurements, sweep=replace(experiment.sweep, resolution=resolution))


def _added_error(label: str, largest: dict[str, float]) -> float:
    return WIDE_SHARE * largest[label] if label in largest else WIDE_PHASE


def near_data(problem: Description, theta: np.ndarray) -> Linearisation | None:
    """Return residuals and Jacobian at θ (names,) on the orbits that the data show, or from rest where that fails.

    None for models that are not condensed, and where experiments have guesses, anchors or are no whole periods.
    Friction and contact let several orbits exist at the same parameters, and from rest the solve leads to one with
    small motions. The frequency response of the linear structure is known at any parameters: from outputs and inputs
    follow the forces of the elements, without their laws, and from the forces their displacements, which start the
    solve.
    """
    of_others = problem.anchors or tables(problem) or any(e.condition or e.guess for e in problem.experiments)
    if not isinstance(problem.model, CondensedModel) or of_others:
        return None
    anchors = {e.name: _shown_orbit(problem, e, theta) for e in problem.experiments}
    density = LogPosterior(problem, ResponseSolver(problem, anchors))
    return Linearisation(theta, density.solver, density.comparisons)


def _shown_orbit(problem: Description, experiment: Experiment, theta: np.ndarray) -> InitialOrbit:
    name, equations = experiment.name, problem.equations[experiment.name]
    assert isinstance(equations, CondensedEquations)
    shown = shown_displacements(equations, problem.parameters(theta[None], name)[0], experiment)
    orbit = None if shown is None else initial_orbit(problem, name, theta, "static", (equations, shown))
    return orbit if orbit and orbit.derivatives else initial_orbit(problem, name, theta, "static")


@unwarned
def shown_displacements(
    equations: CondensedEquations, parameters: np.ndarray, experiment: Experiment
) -> np.ndarray | None:
    """Return displacements of the elements (points, elements) that fit the measured outputs; None without such.

    In each harmonic the forces f minimise the squares of the outputs' errors in units of the noise, and of f in units
    of the largest force, which keeps it finite where the outputs do not show it. Sensors are taken as ideal.
    """
    channels = [c for c in equations.model.outputs if c in experiment.outputs]
    if experiment.mask is not None or not channels or not equations.count:
        return None
    measured = harmonics(np.stack([experiment.outputs[c] for c in channels], axis=1))
    count, points = len(measured), 1 << (2 * len(measured) - 1).bit_length()
    noise = np.median(np.abs(measured[int((1.0 - OF_NOISE) * count) :]), axis=0)
    noise = np.maximum(noise, LEAST_NOISE * np.abs(measured).max(axis=0))
    if not (count > FIRST_HARMONICS and np.all(noise > 0.0)):
        return None
    weights = np.stack([_contained(experiment, c, count) for c in channels], axis=1) / noise
    matrices, load = equations.matrices(parameters, points)[0], equations.input_harmonics(points)
    rows = [equations.model.outputs.index(c) for c in channels]
    gains = matrices.y_f[:count, rows] * weights[..., None]
    missing = weights * (times(matrices.y_u[:, rows], load)[:count] - measured)
    first = [
        np.linalg.lstsq(*pair, rcond=LEAST_SINGULAR)[0]
        for pair in zip(gains[:FIRST_HARMONICS], missing[:FIRST_HARMONICS], strict=True)
    ]
    largest = float(np.abs(first).max())
    if not 0.0 < largest < np.inf:
        return None
    transposed = np.swapaxes(gains.conj(), -1, -2)
    forces = np.linalg.solve(
        transposed @ gains + np.eye(equations.count) / largest**2, times(transposed, missing)[..., None]
    )
    acting = resized(forces[..., 0], points)
    return on_grid(times(matrices.d_u, load) - times(matrices.d_f, acting), points)


def _contained(experiment: Experiment, channel: str, count: int) -> np.ndarray:
    """Return 1 for the harmonics that the output contains and 0 for others, (harmonics,)."""
    result = 1.0 * (np.arange(count) <= experiment.harmonics.get(channel, count))
    result[[h for h in experiment.unmeasured.get(channel, ()) if h < count]] = 0.0
    return result
