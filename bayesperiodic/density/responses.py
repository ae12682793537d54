"""Periodic responses of all experiments of a problem at any θ, solved from anchors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.initial_orbits import Guesses, experiments_guesses
from bayesperiodic.density.sheets import FoldSolves, Sheet, SheetPoint
from bayesperiodic.density.special_points import (
    PointDerivatives,
    special_anchor,
    special_equations,
    special_values,
)
from bayesperiodic.density.sweeps import SAME_ORBIT, Place, distance, places, tables
from bayesperiodic.likelihood.observation import GroupSolution, Response, Simulation
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.arclength import PATH_LOST, path_outcome
from bayesperiodic.periodic.batch import Anchor, AutonomousBatch, Batch
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, SINGULAR
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.condensed_batch import CondensedBatch
from bayesperiodic.periodic.condensed_solution import described, modal_multipliers
from bayesperiodic.periodic.equations import PeriodicEquations, Sensitivities, Solved
from bayesperiodic.periodic.floquet import first_order_matrix, leading_multipliers
from bayesperiodic.periodic.solution import PeriodicSolution, as_guess, logarithmic_jacobian
from bayesperiodic.periodic.solve import solve_driven, solve_free
from bayesperiodic.periodic.special import SpecialEquations, SpecialPoint
from bayesperiodic.periodic.special_batch import SpecialAnchor, SpecialBatch
from bayesperiodic.problem.description import Description
from bayesperiodic.problem.model_inputs import without_sensors
from bayesperiodic.problem.parameters import ParameterMaps

NO_HISTORY = np.empty((0, 3))
# Relative step of differences of orbits at folds.
FOLD_DIFFERENCE = 1e-5


class InitialOrbit(NamedTuple):
    """Orbit from which the periodic solves of an experiment start."""

    guess: Any  # states (points,) by name, or "static", from which to solve where the anchor fails
    anchor: Anchor | SpecialAnchor
    derivatives: PointDerivatives | None  # by all parameters; None where they do not exist
    sheet: int | None = None  # of the branch of a table, see `sweeps`; None if it is not known


class ResponseSolver:
    """Periodic solutions of a problem's experiments at any θ, solved from anchors, and their derivatives at one θ."""

    def __init__(self, problem: Description, anchors: Mapping[str, InitialOrbit]):
        self.problem, self.anchors = problem, anchors
        self._changes: tuple[np.ndarray, Simulation] | None = None

    @classmethod
    def start(cls, problem: Description, theta: np.ndarray, guesses: Guesses | None = None) -> "ResponseSolver":
        """Return the solver anchored at θ (names,), solved from guesses, the experiments' own or the equilibrium.

        Points of tables without a guess start from the branch that leads through the table.
        """
        near = None
        if guesses is None:
            chosen: dict[str, Any] = experiments_guesses(problem, theta)
        else:
            _checks.same_names("guesses", guesses, [e.name for e in problem.experiments])
            chosen = {e.name: replace(e, guess=guesses[e.name]).guess for e in problem.experiments}
            near = {name: as_guess(problem.equations[name], guess) for name, guess in chosen.items() if guess}
        on_branch, anchors = places(problem, theta, near), {}
        for name, guess in chosen.items():
            if name in on_branch:
                anchors[name] = _placed(problem, name, theta, guess or "static", on_branch[name])
            else:
                anchors[name] = initial_orbit(problem, name, theta, guess or "static")
        return cls(problem, anchors)

    def __getstate__(self) -> dict[str, Any]:
        # The factors at the anchors are computed again; the anchors are kept to the last bit.
        kept = {key: value for key, value in self.__dict__.items() if key not in ("_batches", "_specials", "_sheets")}
        return kept | {"_changes": None}

    def anchored(self, theta: np.ndarray, simulation: Simulation | None = None) -> "ResponseSolver":
        """Return the solver anchored at θ (names,), solved from the present anchors, else from the guesses.

        `simulation` is a polished one there with z, if it is known.
        """
        simulation, anchors = simulation or self.solve(theta[None], keep=True, polish=True), {}
        derivatives = self._derivatives(simulation)
        lost = [name for name, orbit in self.anchors.items() if simulation.statuses(name)[0] != CONVERGED]
        again = {}
        if any(self.anchors[name].sheet is not None for name in lost):
            near = {name: orbit.anchor for name, orbit in self.anchors.items() if orbit.sheet is not None}
            z = {name: anchor.z for name, anchor in near.items() if isinstance(anchor, Anchor)}
            again = places(self.problem, theta, z)
        for name, orbit in self.anchors.items():
            if name in self._specials:
                anchors[name] = self._special_orbit(name, theta, None if name in lost else simulation)
            elif name in lost and name in again:
                anchors[name] = _placed(self.problem, name, theta, orbit.guess, again[name])
            elif name in lost or orbit.sheet is None:
                solved = None if name in lost else self._solved(simulation, name)
                known = derivatives.get(name) if solved else None
                anchors[name] = initial_orbit(self.problem, name, theta, orbit.guess, solved, known)
            else:
                here = Place(orbit.sheet, *self._solved(simulation, name), not self._is_beyond(name, simulation))
                known = derivatives.get(name)
                anchors[name] = _placed(self.problem, name, theta, orbit.guess, here, known)
        return ResponseSolver(self.problem, anchors)

    def carried(self, problem: Description, theta: np.ndarray) -> "ResponseSolver":
        """Return the solver of a problem with inputs close to these, solved at θ (names,) from orbits near it.

        They are the anchors of experiments of a condensed model, of others the solutions at θ.
        """
        if isinstance(problem.model, CondensedModel) and not (self._specials or self._sheets):
            anchors = {}
            for name, orbit in self.anchors.items():
                assert isinstance(orbit.anchor, Anchor)
                near = problem.equations[name], orbit.anchor.z
                anchors[name] = initial_orbit(problem, name, theta, orbit.guess, near)
            return ResponseSolver(problem, anchors)
        guesses = {name: one.states for name, one in self.solutions(theta, sensitivities=False).items()}
        return ResponseSolver.start(problem, theta, guesses)

    def _derivatives(self, simulation: Simulation) -> dict[str, tuple[np.ndarray, Sensitivities | None]]:
        """Return indices of parameters and the derivatives by them, of the experiments that are solved by a `Batch`.

        They are those at the first of the solves, which are meaningless where it failed.
        """
        result: dict[str, tuple[np.ndarray, Sensitivities | None]] = {}
        for (experiments, maps, batch, _), solved in zip(self._batches, simulation.groups, strict=True):
            if isinstance(batch, Batch):
                moving = np.array(maps.moving, dtype=int)
                every = batch.sensitivities(solved.parameters[:, 0], solved.z[:, 0], moving)
                result |= {e.name: (moving, one) for e, one in zip(experiments, every, strict=True)}
        return result

    def on_best_sheets(self, theta: np.ndarray) -> "ResponseSolver":
        """Return the solver with the points of tables on the sheets that fit the data best at θ (names,)."""
        best, anchors = places(self.problem, theta), dict(self.anchors)
        for name in best:
            anchors[name] = _placed(self.problem, name, theta, self.anchors[name].guess, best[name])
        return ResponseSolver(self.problem, anchors)

    def beyond(self, simulation: Simulation) -> list[str]:
        """Return the points of tables that the branch does not reach at the first of the solves, see `sweeps`."""
        return [e.name for e in self.problem.experiments if self._is_beyond(e.name, simulation)]

    def _is_beyond(self, experiment: str, simulation: Simulation) -> bool:
        if self.anchors[experiment].sheet is None:
            return False
        return bool(simulation.response(experiment).frequency[0] != self._measured_frequency(experiment))

    def _solved(self, simulation: Simulation, experiment: str, i: int = 0) -> tuple[PeriodicEquations, np.ndarray]:
        """Return the equations at the frequency, and the scale of the input, of one of the solves, and its z."""
        response = simulation.response(experiment)
        frequency = float(response.frequency[i])
        if experiment in self._specials:
            special = self._specials[experiment]
            values = special_values(special, frequency, float(response.scale[i]))
            return special.at(values), simulation.z(experiment)[i]
        return self.problem.equations[experiment].at_frequency(frequency), simulation.z(experiment)[i]

    def _special_orbit(self, experiment: str, theta: np.ndarray, simulation: Simulation | None) -> InitialOrbit:
        """Return the anchor of a special point at θ (names,): that of a solve from the anchor, or found anew."""
        special, guess = self._specials[experiment], None
        if simulation is not None:
            response, before = simulation.response(experiment), self.anchors[experiment].anchor
            assert isinstance(before, SpecialAnchor)
            values = special_values(special, float(response.frequency[0]), float(response.scale[0]))
            guess = SpecialPoint(simulation.z(experiment)[0], values, before.point.vector)
            if special.is_fold:
                parameters = self.problem.parameters(theta[None], experiment)[0]
                guess = special.null_vector(guess, parameters, special.row(guess.vector))
        return _special_orbit(self.problem, experiment, theta, special, guess)

    @cached_property
    def _specials(self) -> dict[str, SpecialEquations]:
        """The equations of the special points, by experiment."""
        return _specials(self.problem)

    @cached_property
    def groups(self) -> list[tuple[Experiment, ...]]:
        """Experiments on the same grid and with the same parameters free, which are solved together."""
        groups: dict[tuple[Any, ...], list[Experiment]] = {}
        for e in self.problem.experiments:
            kind = () if e.condition is None else (type(e.condition).__name__, e.condition.free)
            columns = self.problem.parameter_maps[e.name].columns
            groups.setdefault((kind, e.samples, e.periods, *columns), []).append(e)
        return [tuple(group) for group in groups.values()]

    @cached_property
    def _places(self) -> dict[str, tuple[int, int]]:
        """Group and member of every experiment."""
        return {e.name: (g, m) for g, group in enumerate(self.groups) for m, e in enumerate(group)}

    @cached_property
    def _batches(
        self,
    ) -> list[
        tuple[tuple[Experiment, ...], ParameterMaps, Batch | AutonomousBatch | SpecialBatch | CondensedBatch, bool]
    ]:
        """The groups, their parameters, their solver, and whether multipliers were measured."""
        return [
            (
                group,
                ParameterMaps([self.problem.parameter_maps[e.name] for e in group]),
                self._batch([e.name for e in group]),
                any(self.problem.observations[e.name].multipliers for e in group),
            )
            for group in self.groups
        ]

    @property
    def sheets(self) -> dict[str, int | None]:
        """Sheet of the branch of each point of a table, None for other experiments."""
        return {name: orbit.sheet for name, orbit in self.anchors.items()}

    def on_same_orbits(self, other: "ResponseSolver") -> bool:
        """Return whether another solver at the same θ has the same orbits of points of tables, on the same sheets.

        Sheets are counted anew where the branch is followed: folds may have come into being since.
        """
        pairs = [
            (orbit.anchor, other.anchors[n].anchor) for n, orbit in self.anchors.items() if orbit.sheet is not None
        ]
        orbits = ((a.z, b.z) for a, b in pairs if isinstance(a, Anchor) and isinstance(b, Anchor))
        return self.sheets == other.sheets and all(distance(z, there) < SAME_ORBIT for z, there in orbits)

    @cached_property
    def _sheets(self) -> list[Sheet]:
        """The sheets of the tables' branches."""
        result: list[Sheet] = []
        for table in tables(self.problem).values():
            of_sheets: dict[int, list[SheetPoint]] = {}
            for row, name in enumerate(e.name for e in table):
                orbit = self.anchors[name]
                if orbit.sheet is not None and isinstance(orbit.anchor, Anchor):
                    point = SheetPoint(row, *self._places[name], orbit.anchor)
                    of_sheets.setdefault(orbit.sheet, []).append(point)
            result += [Sheet(self.problem, table, points) for points in of_sheets.values()]
        return result

    def _batch(self, names: list[str]) -> Batch | AutonomousBatch | SpecialBatch | CondensedBatch:
        """Return the solver of experiments of one group."""
        anchors: list[Any] = [self.anchors[name].anchor for name in names]
        if names[0] in self._specials:
            return SpecialBatch([self._specials[name] for name in names], anchors)
        sets: list[Any] = [self.problem.equations[name] for name in names]
        if isinstance(self.problem.model, CondensedModel):
            return CondensedBatch(sets, anchors)
        return (AutonomousBatch if self.problem.model.autonomous else Batch)(sets, anchors)

    def solve(
        self,
        theta: np.ndarray,
        threads: int | None = None,
        *,
        keep: bool = False,
        polish: bool = False,
        whole: bool = False,
    ) -> Simulation:
        """Solve every experiment for θ (solves, names); the result does not depend on the number of threads.

        With `keep` the periodic parts z are returned too; with `polish` the solves are as accurate as possible, as
        wherever multipliers are measured. With `whole` a θ counts only if every solve converges; where one has failed,
        other experiments may be skipped.
        """
        groups, keep = [], keep or bool(self._sheets)
        every = [maps.values(theta) for _, maps, *_ in self._batches]
        folds, without = self._folds(every, threads)
        for (experiments, maps, batch, multipliers), values, left_out in zip(
            self._batches, every, without, strict=True
        ):
            parameters, sensors = values[..., : maps.count], values[..., maps.count :]
            if isinstance(batch, SpecialBatch):
                groups.append(_special_solution(batch, parameters, sensors, threads))
                continue
            if isinstance(batch, AutonomousBatch):
                solved = batch.solve(parameters, threads, keep=keep or multipliers, whole=whole)
            else:
                given: dict[str, Any] = {"keep": keep or multipliers, "polish": polish or multipliers}
                given |= {"whole": whole} if isinstance(batch, Batch) else {}
                solved = batch.solve(parameters, threads, **given, without=left_out)
            status, logarithms = solved.status, [np.empty((len(theta), 0))] * len(experiments)
            if multipliers:
                status = status.copy()
                logarithms = [
                    self._log_multipliers(e, solved.z[i], solved.frequency[i], parameters[i], status[i])
                    for i, e in enumerate(experiments)
                ]
            of_all = solved.outputs, solved.frequency, parameters, sensors, logarithms, solved.z, status
            groups.append(GroupSolution(*of_all, np.ones(status.shape)))
        for sheet, of_sheet in zip(self._sheets, folds, strict=True):
            sheet.reach(groups, of_sheet)
        return Simulation(groups, self._places)

    def _folds(
        self, values: Sequence[np.ndarray], threads: int | None
    ) -> tuple[list[FoldSolves], list[np.ndarray | None]]:
        """Return the folds at the ends of sheets, and which solves (experiments, solves) of each group lie beyond one.

        `values` are the parameters of each group, (experiments, solves, parameters).
        """
        folds: list[FoldSolves] = []
        without: list[np.ndarray | None] = [None] * len(values)
        for sheet in self._sheets:
            first = sheet.points[0]
            count = self._batches[first.group][1].count
            folds.append(sheet.beyond_folds(values[first.group][first.member, :, :count], threads))
            if folds[-1].beyond.any():
                for point, beyond in zip(sheet.points, folds[-1].beyond, strict=True):
                    left_out = without[point.group]
                    if left_out is None:
                        left_out = without[point.group] = np.zeros(values[point.group].shape[:2], dtype=bool)
                    left_out[point.member] = beyond
        return folds, without

    def path_outcome(self, theta: np.ndarray, experiment: str) -> str:
        """Return how the branch through an experiment's anchor ends on the way to θ, see `arclength.path_outcome`."""
        anchor = self.anchors[experiment].anchor
        condensed = isinstance(self.problem.model, CondensedModel)
        if condensed or isinstance(anchor, SpecialAnchor) or anchor.sensitivities is None:
            return PATH_LOST
        parameters = self.problem.parameters(theta[None], experiment)[0]
        return path_outcome(self.problem.equations[experiment], anchor, parameters)

    def _log_multipliers(
        self, experiment: Experiment, z: np.ndarray, frequency: np.ndarray, parameters: np.ndarray, status: np.ndarray
    ) -> np.ndarray:
        """Return log|μ| (solves, multipliers) of those that were measured; "other orbit" where a sign differs."""
        measured = experiment.measured_multipliers
        if not measured.size:
            return np.empty((len(z), 0))
        result = np.full((len(z), measured.size), np.nan)
        for i in np.flatnonzero(status == CONVERGED):
            equations = self.problem.equations[experiment.name].at_frequency(float(frequency[i]))
            multipliers = orbit_multipliers(equations, parameters[i], z[i], measured.size)
            if multipliers.size < measured.size:
                status[i] = SINGULAR
            elif np.any(np.sign(multipliers.real) != np.sign(measured)):
                status[i] = OTHER_ORBIT
            else:
                result[i] = np.log(np.abs(multipliers))
        return result

    def largest_multipliers(self, theta: np.ndarray, experiment: str, simulation: Simulation) -> np.ndarray:
        """Return the modulus (solves,) of the largest multiplier at θ (solves, names); NaN where the solve failed."""
        parameters, result = self.problem.parameters(theta, experiment), np.full(len(theta), np.nan)
        for i in np.flatnonzero(simulation.statuses(experiment) == CONVERGED).tolist():
            equations, z = self._solved(simulation, experiment, i)
            result[i] = np.abs(orbit_multipliers(equations, parameters[i], z, 1)).max(initial=0.0)
        return result

    def solutions(self, theta: np.ndarray, *, sensitivities: bool = True) -> dict[str, PeriodicSolution]:
        """Return the periodic solution of every experiment at one θ (names,), with its sensitivities or without.

        Inputs and outputs are those of the model, without the sensors. Without sensitivities, condensed solutions have
        no multipliers either.
        """
        simulation, solutions = self.solve(theta[None], keep=True, polish=True), {}
        for e in self.problem.experiments:
            (here, z), code = self._solved(simulation, e.name), int(simulation.statuses(e.name)[0])
            here, parameters = without_sensors(self.problem, here, self._at_scale(e, simulation), theta)
            solved = Solved(z, code, NO_HISTORY)
            solutions[e.name] = described(
                here, parameters, solved, sensitivities=sensitivities, multipliers=sensitivities
            )
        return solutions

    def _at_scale(self, experiment: Experiment, simulation: Simulation) -> Experiment:
        """Return an experiment with the level of the input that is an unknown of its special point."""
        special, scale = self._specials.get(experiment.name), float(simulation.response(experiment.name).scale[0])
        if special is None or scale == 1.0:
            return experiment
        inputs = {name: (scale if name in special.free else 1.0) * u for name, u in experiment.inputs.items()}
        return replace(experiment, inputs=inputs)

    def jacobian(self, theta: np.ndarray, experiment: str, response: Response, z: np.ndarray) -> Response | None:
        """Return the derivatives of a response at the anchor by θ, (names, …); None where they do not exist."""
        parameter_map, derivative = self.problem.parameter_maps[experiment], self.anchors[experiment].derivatives
        if self.anchors[experiment].sheet is not None and response.frequency != self._measured_frequency(experiment):
            return self._changes_at_fold(theta, experiment)
        if derivative is None:
            return None
        of_model, of_sensors = np.split(parameter_map.slopes(theta), [parameter_map.count])
        outputs = np.tensordot(of_model, derivative.outputs, (0, 0))
        multipliers = np.zeros((theta.size, 0))
        if response.log_multipliers.size:
            multipliers = self._multiplier_jacobian(theta, experiment, z, response)
        scale = of_model.T @ derivative.scale
        return Response(outputs, of_model.T @ derivative.frequency, multipliers, of_sensors.T, scale)

    def _measured_frequency(self, experiment: str) -> float:
        return self.problem.equations[experiment].frequency

    def _changes_at_fold(self, theta: np.ndarray, experiment: str) -> Response:
        """Return the derivatives of a response that is that at a fold, by differences."""
        steps = FOLD_DIFFERENCE * np.where(theta != 0.0, np.abs(theta), self.problem.joint_prior.widths)
        if self._changes is None or not np.array_equal(self._changes[0], theta):
            around = np.concatenate([theta[None], theta + np.diag(steps), theta - np.diag(steps)])
            self._changes = theta, self.solve(around, polish=True)
        response, count = self._changes[1].response(experiment), theta.size
        measured = self._measured_frequency(experiment)
        centre, ends = (response.outputs[0], response.frequency[0]), []
        for sign, part in ((1.0, slice(1, count + 1)), (-1.0, slice(count + 1, None))):
            outputs, frequency = response.outputs[part], response.frequency[part]
            # Where the branch reaches the point on one side, the derivative is that on the other side.
            at_fold = frequency != measured
            width = np.where(at_fold, sign * steps, 0.0)
            outputs = np.where(at_fold[:, None, None], outputs, centre[0])
            ends.append((outputs, np.where(at_fold, frequency, centre[1]), width))
        (y_up, f_up, up), (y_down, f_down, down) = ends
        width = np.where(up > down, up - down, np.inf)
        of_sensors = self.problem.parameter_maps[experiment].slopes(theta)[
            self.problem.parameter_maps[experiment].count :
        ]
        by_outputs = (y_up - y_down) / width[:, None, None]
        return Response(by_outputs, (f_up - f_down) / width, np.zeros((count, 0)), of_sensors.T)

    def _multiplier_jacobian(self, theta: np.ndarray, experiment: str, z: np.ndarray, response: Response) -> np.ndarray:
        """Return ∂ log|μ|/∂θ at the anchor, (names, multipliers)."""
        anchor = self.anchors[experiment].anchor
        parameter_map = self.problem.parameter_maps[experiment]
        directions = parameter_map.slopes(theta)[: parameter_map.count].T
        assert isinstance(anchor, Anchor) and anchor.sensitivities is not None
        assert anchor.frequency_sensitivities is not None
        equations = self.problem.equations[experiment].at_frequency(float(response.frequency))
        parameters, count = self.problem.parameters(theta[None], experiment)[0], response.log_multipliers.size
        solution = _described(equations, parameters, z)
        every = logarithmic_jacobian(
            equations,
            parameters,
            z,
            solution,
            np.tensordot(directions, anchor.sensitivities, (1, 0)),
            directions,
            directions @ anchor.frequency_sensitivities,
            None if solution.autonomous else count,
        ).real
        return np.array([_without_trivial(solution, row)[:count] for row in every])

    def vjp(
        self,
        theta: np.ndarray,
        simulation: Simulation,
        by_outputs: Sequence[np.ndarray],
        by_sensors: Sequence[np.ndarray],
        by_multipliers: Mapping[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return the derivatives of a scalar by θ, (names,) by experiment, from those that `Comparisons.vjp` returns.

        The simulation is of a driven model, at this θ alone, with z. Each experiment takes one transposed solve; NaN
        where the derivatives do not exist.
        """
        result: dict[str, np.ndarray] = {}
        for g, (experiments, maps, batch, _) in enumerate(self._batches):
            assert isinstance(batch, Batch | CondensedBatch)
            solved = simulation.groups[g]
            parameters = solved.parameters[:, 0]
            values = np.concatenate([parameters, solved.sensors[:, 0]], axis=1)
            by_parameter = np.zeros(values.shape)
            by_parameter[:, maps.moving] = batch.vjp(parameters, solved.z[:, 0], by_outputs[g], maps.moving)
            by_parameter[:, maps.count :] = by_sensors[g]
            result |= zip((e.name for e in experiments), maps.vjp(values, by_parameter), strict=True)
        for name, by_logarithm in by_multipliers.items():
            if by_logarithm.size:
                response = simulation.at(0).response(name)
                jacobian = self._multiplier_jacobian(theta, name, simulation.z(name)[0], response)
                result[name] = result[name] + jacobian @ by_logarithm
        return result


def initial_orbit(
    problem: Description,
    experiment: str,
    theta: np.ndarray,
    guess: Any,
    solved: tuple[PeriodicEquations, np.ndarray] | None = None,
    known: tuple[np.ndarray, Sensitivities | None] | None = None,
) -> InitialOrbit:
    """Return the orbit at θ (names,): one that is solved, or solved from the guess with all fallbacks.

    Of condensed models the former may be displacements from which to solve. `known` are indices of parameters and the
    derivatives by them, if they are known.
    """
    specials = _specials(problem)
    if experiment in specials:
        return _special_orbit(problem, experiment, theta, specials[experiment], None)
    equations, parameters = problem.equations[experiment], problem.parameters(theta[None], experiment)[0]
    if solved is None:
        if problem.model.autonomous:
            here, (z, code, *_), *_ = solve_free(equations, parameters, guess)
        else:
            here, (z, code, *_) = equations, solve_driven(equations, parameters, guess)[0]
    else:
        (here, z), code = solved, CONVERGED
        if isinstance(here, CondensedEquations):  # on as many points as it takes there
            z, code, *_ = here.find(parameters, z)[0]
    if code != CONVERGED:
        return InitialOrbit(guess, Anchor(parameters, z, equations.frequency), None)
    if known is None:
        parameter_map = problem.parameter_maps[experiment]
        moving = np.flatnonzero(parameter_map.slopes(theta)[: parameter_map.count].any(axis=1))
        known = moving, here.sensitivities_along(z, parameters, np.eye(parameters.size)[moving])
    (moving, derivative), by_all = known, None
    if derivative is not None:
        by_all = PointDerivatives(
            np.zeros((parameters.size, *derivative.outputs.shape[1:])), *np.zeros((2, parameters.size))
        )
        by_all.outputs[moving], by_all.frequency[moving] = derivative.outputs, derivative.frequency
    return InitialOrbit(guess, Anchor.of(here, parameters, z, derivative, moving), by_all)


def _placed(
    problem: Description,
    experiment: str,
    theta: np.ndarray,
    guess: Any,
    place: Place,
    known: tuple[np.ndarray, Sensitivities | None] | None = None,
) -> InitialOrbit:
    """Return the orbit of a point of a table on its branch; without derivatives if the branch does not reach it."""
    if place.reached:
        solved = place.equations, place.z
        return initial_orbit(problem, experiment, theta, guess, solved, known)._replace(sheet=place.sheet)
    parameters = problem.parameters(theta[None], experiment)[0]
    measured = problem.equations[experiment].frequency
    return InitialOrbit(guess, Anchor(parameters, place.z, measured), None, place.sheet)


def _specials(problem: Description) -> dict[str, SpecialEquations]:
    """Return the equations of the special points of a problem, by experiment."""
    of_points = [e for e in problem.experiments if e.condition is not None]
    return {e.name: special_equations(e, problem.equations[e.name]) for e in of_points}


def _special_orbit(
    problem: Description, experiment: str, theta: np.ndarray, special: SpecialEquations, guess: SpecialPoint | None
) -> InitialOrbit:
    """Return the anchor of a special point at θ (names,), from a guess or found along a branch."""
    parameter_map = problem.parameter_maps[experiment]
    moving = np.flatnonzero(parameter_map.slopes(theta)[: parameter_map.count].any(axis=1))
    parameters = problem.parameters(theta[None], experiment)[0]
    return InitialOrbit("static", *special_anchor(special, parameters, moving, guess))


def _special_solution(
    batch: SpecialBatch, parameters: np.ndarray, sensors: np.ndarray, threads: int | None
) -> GroupSolution:
    """Return the solutions of experiments at special points."""
    solved = batch.solve(parameters, threads)
    logarithms = [np.empty((parameters.shape[1], 0))] * len(parameters)
    given = parameters, sensors, logarithms, solved.z, solved.status, batch.scale(solved)
    return GroupSolution(solved.outputs, batch.frequency(solved), *given)


def orbit_multipliers(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` largest multipliers of a solution z, or fewer, without an autonomous orbit's trivial 1."""
    if not count:
        return np.empty(0)
    if isinstance(equations, CondensedEquations):
        return modal_multipliers(equations, parameters, z, error=False)[0][:count]
    easy = None if equations.model.autonomous else _leading_multipliers_directly(equations, parameters, z, count)
    if easy is not None:
        return easy
    solution = _described(equations, parameters, z)
    return _without_trivial(solution, solution.multipliers)[:count]


def _leading_multipliers_directly(
    equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray, count: int
) -> np.ndarray | None:
    """Return the largest multipliers of a driven model where `floquet.leading_multipliers` finds them."""
    orders = tuple(equations.model.orders.values())
    columns = equations.residual_jacobian(z, parameters)[:, equations.count :]
    try:
        matrix = first_order_matrix(columns.reshape(len(z), equations.count, -1), orders)
    except np.linalg.LinAlgError:
        return None
    period = equations.grid.periods / equations.frequency
    spread = np.ptp(z, axis=0)
    sizes = np.where(spread > 0.0, spread, 1.0)
    sizes = np.concatenate([sizes, 2 * np.pi / period * sizes[[order == 2 for order in orders]]])
    return leading_multipliers(matrix * (sizes / sizes[:, None]), period, count)


def _described(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray) -> PeriodicSolution:
    return described(equations, parameters, Solved(z, CONVERGED, NO_HISTORY), sensitivities=False)


def _without_trivial(solution: PeriodicSolution, values: np.ndarray) -> np.ndarray:
    """Return values, one a multiplier, without that of an autonomous orbit's trivial multiplier 1."""
    if not solution.autonomous or not values.size:
        return values
    return np.delete(values, np.argmin(np.abs(solution.exponents)))
