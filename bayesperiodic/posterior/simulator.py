"""The periodic solves behind a problem: every experiment, for many parameter vectors, from anchors."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic._parallel import available_cores, in_threads
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.arclength import LOST, path_outcome
from bayesperiodic.periodic.batch import Anchor, AutonomousBatch, Batch, BatchSolution
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, SINGULAR
from bayesperiodic.periodic.equations import PeriodicEquations, Solved
from bayesperiodic.periodic.floquet import first_order_matrix, leading_multipliers
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.sensitivity import Sensitivities, directional_sensitivities
from bayesperiodic.periodic.solution import PeriodicSolution, describe, logarithmic_changes
from bayesperiodic.periodic.solve import solve_driven, solve_free
from bayesperiodic.posterior.observation import Observation, Response
from bayesperiodic.posterior.parameters import ParameterMap, ParameterMaps

SMALLEST_SHARED = 100_000


class Misfits:
    """Experiments that are solved together and have their channels, whole periods, in common.

    Parameters
    ----------
    observations : sequence of Observation
        For which `possible` is true.
    """

    def __init__(self, observations: Sequence[Observation]):
        self._columns = np.array(observations[0].columns)
        self._data = np.stack([o.data for o in observations])
        self._kept = [np.array([o.layout[2 + c] for o in observations if o.layout]) for c in range(len(self._columns))]
        self._points = self._data.shape[1]
        self._weights = [self._parseval(kept) for kept in self._kept]
        self._whole = all(weights is None for weights in self._weights)

    @property
    def blocks(self) -> int:
        """The number of sums."""
        return len(self._data) * len(self._columns)

    @staticmethod
    def possible(observations: Sequence[Observation]) -> bool:
        """Return whether nothing but whole periods of the same channels is compared."""
        layouts = [o.layout for o in observations]
        return None not in layouts and len({layout[:2] for layout in layouts if layout}) == 1

    def solved(self, batch: Batch, parameters: np.ndarray, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Solve the experiments for many parameter vectors, and return sums of squares and how the solves ended.

        Parameters
        ----------
        batch : Batch
            Of these experiments.
        parameters : array (experiments, solves, parameters)
        threads : int or None
            By default one a core.

        Returns
        -------
        squares : array (experiments · channels, solves)
            Channels run fastest.
        status : int array (experiments, solves)
        """
        if self._whole:
            squares, status = batch.squares(parameters, self._data, self._columns, threads)
            return squares.transpose(0, 2, 1).reshape(self.blocks, -1), status
        found = batch.solve(parameters, threads)
        small = found.outputs.size < SMALLEST_SHARED
        return self.squares(found.outputs, 1 if small else threads or available_cores()), found.status

    def orbits(self, batch: Batch, parameters: np.ndarray) -> tuple[BatchSolution, np.ndarray]:
        """Solve the experiments for one parameter vector each; return the solution and sums of squares (blocks,).

        Parameters
        ----------
        batch : Batch
            Of these experiments.
        parameters : array (experiments, 1, parameters)
        """
        solved, squares = batch.orbits(parameters, self._data, self._columns)
        return solved, squares.reshape(-1) if self._whole else self.squares(solved.outputs, 1)[:, 0]

    def squares(self, outputs: np.ndarray, threads: int) -> np.ndarray:
        """Return the sums of squares (experiments · channels, solves), channels running fastest.

        Parameters
        ----------
        outputs : array (experiments, solves, points, channels)
            In the order of the model's outputs.
        threads : int
        """
        experiments, channels = len(outputs), len(self._columns)
        result = np.empty((experiments, channels, outputs.shape[1]))

        def one(part: slice) -> None:
            for c, column in enumerate(self._columns):
                difference = outputs[part, :, :, column] - self._data[part, None, :, c]
                result[part, c] = self._sums(difference, c, part)

        parts = min(threads, experiments)
        with np.errstate(over="ignore", invalid="ignore"):
            in_threads(
                one, [slice(experiments * k // parts, experiments * (k + 1) // parts) for k in range(parts)], threads
            )
        return result.reshape(experiments * channels, -1)

    def pulled(self, outputs: np.ndarray, by_square: np.ndarray) -> np.ndarray:
        """Return the derivatives of Σ by_square · squares by the outputs, (experiments, points, channels).

        Parameters
        ----------
        outputs : array (experiments, points, channels)
            Overwritten by the result.
        by_square : array (experiments · channels,)
            In the order of `squares`.
        """
        factors = 2.0 * by_square.reshape(len(outputs), -1)
        outputs[..., np.delete(np.arange(outputs.shape[-1]), self._columns)] = 0.0
        for c, column in enumerate(self._columns):
            own, kept = outputs[..., column], self._kept[c]
            own -= self._data[..., c]
            if self._weights[c] is not None:
                own[...] = self._within(own, kept)
            own *= (factors[:, c] * kept / self._points)[:, None]
        return outputs

    def _within(self, signals: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return signals (experiments, points) within as many real components."""
        amplitudes = np.fft.rfft(signals, axis=-1)
        for own, size in zip(amplitudes, kept, strict=True):
            own[size // 2 + 1 :] = 0.0
        return np.fft.irfft(amplitudes, self._points, axis=-1)

    def _sums(self, difference: np.ndarray, channel: int, part: slice) -> np.ndarray:
        """Return the sums of squares (experiments, solves) of so many real components, by Parseval's theorem."""
        weights = self._weights[channel]
        if weights is None:
            return np.einsum("ebi,ebi->eb", difference, difference)
        amplitudes = np.fft.rfft(difference, axis=-1)[..., : weights.shape[1]]
        return np.einsum("ebh,eh->eb", amplitudes.real**2 + amplitudes.imag**2, weights[part])

    def _parseval(self, kept: np.ndarray) -> np.ndarray | None:
        """Return the weights (experiments, harmonics) of squared Fourier sums; None where all components are kept."""
        if (kept == self._points).all():
            return None
        weights = np.full((len(kept), kept.max() // 2 + 1), 2.0)
        weights[:, 0] = 1.0
        for own, size in zip(weights, kept, strict=True):
            own[(size + 1) // 2 :] = 0.0
            if size % 2 == 0:
                own[size // 2] = 1.0
            own *= size / self._points**2
        return weights


class SolvedResponse(NamedTuple):
    """Responses of one experiment to several θ.

    Attributes
    ----------
    response : Response
        Its leading axis runs over the θ.
    z : array (solves, points, states)
    status : int array (solves,)
        Index into `compiled.STATUSES`.
    """

    response: Response
    z: np.ndarray
    status: np.ndarray

    def one(self, index: int) -> tuple[Response, np.ndarray]:
        """Return the response to a single θ, and its z."""
        return Response(*(part[index] for part in self.response)), self.z[index]


class Orbits(NamedTuple):
    """Solutions of experiments that are solved together, at one θ.

    Attributes
    ----------
    values : array (experiments, parameters + 1)
        All parameters, the delay last.
    z : array (experiments, points, states)
    outputs : array (experiments, points, channels)
    squares : array (experiments · measured channels,)
        As `Misfits.solved` returns them.
    """

    values: np.ndarray
    z: np.ndarray
    outputs: np.ndarray
    squares: np.ndarray


class Responses:
    """Solves the experiments of a problem for any θ.

    Parameters
    ----------
    model : Model
    experiments : tuple of Experiment
    maps : mapping of str to ParameterMap
        By experiment.
    scheme : str or Scheme
    """

    def __init__(
        self,
        model: Model,
        experiments: tuple[Experiment, ...],
        maps: Mapping[str, ParameterMap],
        scheme: str | Scheme,
    ):
        self.model, self.experiments, self.maps, self.scheme = model, experiments, maps, scheme
        self._anchors: dict[str, Anchor] | None = None
        self._derivatives: dict[str, Sensitivities | None] = {}

    @cached_property
    def equations(self) -> dict[str, PeriodicEquations]:
        """The discretised equations of every experiment."""
        return {
            e.name: PeriodicEquations.build(
                self.model,
                e.inputs,
                frequency=e.frequency,
                samples=e.samples,
                scheme=self.scheme,
                periods=e.periods,
                winding=e.winding,
            )
            for e in self.experiments
        }

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions and the factors at the anchors are made again; the anchors are kept, to the last bit.
        return {key: value for key, value in self.__dict__.items() if key not in ("equations", "_batches")}

    def parameters(self, theta: np.ndarray, experiment: str) -> np.ndarray:
        """Return every parameter of the model (points, parameters) in an experiment from θ (points, names)."""
        return np.ascontiguousarray(self.maps[experiment].values(theta)[:, :-1])

    def anchored(self, theta: np.ndarray) -> "Responses":
        """Return the same with its anchors at a θ (names,), solved from the present ones or else from the start."""
        other = Responses(self.model, self.experiments, self.maps, self.scheme)
        other.__dict__["equations"] = self.equations
        found = self.solve(theta[None], keep=True) if self._anchors is not None else {}
        other._anchors = {}
        for name, equations in self.equations.items():
            parameters = self.parameters(theta[None], name)[0]
            if name in found and found[name].status[0] == CONVERGED:
                here, z = equations.at_frequency(float(found[name].response.frequency[0])), found[name].z[0]
            else:
                here, (z, code, *_) = self._from_start(name, parameters)
                if code != CONVERGED:
                    other._anchors[name] = Anchor(parameters, z, equations.frequency)
                    other._derivatives[name] = None
                    continue
            moving = np.flatnonzero(self.maps[name].slopes(theta)[:-1].any(axis=1))
            directions = np.eye(parameters.size)[moving]
            derivative = directional_sensitivities(here, z, parameters, directions)
            other._anchors[name] = Anchor.of(here, parameters, z, derivative, moving)
            other._derivatives[name] = derivative and derivative._replace(
                outputs=np.tensordot(directions, derivative.outputs, (0, 0)),
                frequency=directions.T @ derivative.frequency,
            )
        return other

    def _from_start(self, experiment: str, parameters: np.ndarray) -> tuple[PeriodicEquations, Solved]:
        """Solve from the experiment's own guess, or from the equilibrium by all means."""
        equations = self.equations[experiment]
        guess = next(e.guess for e in self.experiments if e.name == experiment) or "static"
        if self.model.autonomous:
            return solve_free(equations, parameters, guess)[:2]
        return equations, solve_driven(equations, parameters, guess)[0]

    @cached_property
    def groups(self) -> list[tuple[Experiment, ...]]:
        """Experiments on the same grid and with the same parameters free, which are solved together."""
        groups: dict[tuple[Any, ...], list[Experiment]] = {}
        for e in self.experiments:
            groups.setdefault((e.samples, e.periods, *self.maps[e.name].columns), []).append(e)
        return [tuple(group) for group in groups.values()]

    @cached_property
    def _batches(self) -> list[tuple[tuple[Experiment, ...], ParameterMaps, Batch | AutonomousBatch]]:
        """The groups with what solves them."""
        assert self._anchors is not None
        kind = AutonomousBatch if self.model.autonomous else Batch
        return [
            (
                group,
                ParameterMaps([self.maps[e.name] for e in group]),
                kind([self.equations[e.name] for e in group], [self._anchors[e.name] for e in group]),
            )
            for group in self.groups
        ]

    def solve(
        self, theta: np.ndarray, threads: int | None = None, *, keep: bool = False, whole: bool = False
    ) -> dict[str, SolvedResponse]:
        """Solve every experiment for θ (solves, names); the result does not depend on the number of threads.

        Parameters
        ----------
        theta : array (solves, names)
        threads : int, optional
        keep : bool
            Return the periodic parts z too.
        whole : bool
            A θ counts only if every solve converges; others may then be left out where one has failed.
        """
        result = {}
        for experiments, maps, batch in self._batches:
            values = maps.values(theta)
            parameters = values[..., :-1]
            wanted = keep or any(e.multipliers is not None for e in experiments)
            if isinstance(batch, AutonomousBatch):
                solved = batch.solve(parameters, threads, keep=wanted, whole=whole)
            else:
                solved = batch.solve(parameters, threads, keep=wanted)
            for i, e in enumerate(experiments):
                status = solved.status[i].copy()
                logarithms = self._log_multipliers(e, solved.z[i], solved.frequency[i], parameters[i], status)
                response = Response(solved.outputs[i], solved.frequency[i], logarithms, values[i, :, -1])
                result[e.name] = SolvedResponse(response, solved.z[i], status)
        return {e.name: result[e.name] for e in self.experiments}

    def squares(
        self, theta: np.ndarray, misfits: Sequence[Misfits], threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of squares (blocks, solves) of each of `groups`, one below the other, and the worst status.

        For a driven model without measured multipliers.

        Parameters
        ----------
        theta : array (solves, names)
        misfits : sequence of Misfits
            One of each of `groups`.
        threads : int, optional
        """
        found = []
        for (_, maps, batch), own in zip(self._batches, misfits, strict=True):
            assert isinstance(batch, Batch)
            found.append(own.solved(batch, maps.values(theta)[..., :-1], threads))
        squares, status = zip(*found, strict=True)
        if len(found) == 1:
            return squares[0], status[0].max(axis=0)
        return np.concatenate(squares), np.concatenate(status).max(axis=0)

    def orbits(self, theta: np.ndarray, misfits: Sequence[Misfits]) -> tuple[list[Orbits], int]:
        """Return the solutions of each of `groups` at one θ (names,), and the worst status.

        For a driven model without measured multipliers.

        Parameters
        ----------
        theta : array (names,)
        misfits : sequence of Misfits
            One of each of `groups`.
        """
        result, worst = [], CONVERGED
        for (_, maps, batch), own in zip(self._batches, misfits, strict=True):
            assert isinstance(batch, Batch)
            values = maps.values(theta[None])
            solved, squares = own.orbits(batch, values[..., :-1])
            result.append(Orbits(values[:, 0], solved.z[:, 0], solved.outputs[:, 0], squares))
            worst = max(worst, int(solved.status.max()))
        return result, worst

    def pulled_outputs(self, orbits: Sequence[Orbits], weights: Sequence[np.ndarray]) -> np.ndarray:
        """Return Σ weights · ∂outputs/∂θ over all experiments, (names,), by one transposed solve each.

        Parameters
        ----------
        orbits : sequence of Orbits
        weights : sequence of array (experiments, points, channels)
            One of each of `groups`.
        """
        parts = []
        for (_, maps, batch), orbit, own in zip(self._batches, orbits, weights, strict=True):
            assert isinstance(batch, Batch)
            by_parameter = np.zeros(orbit.values.shape)
            by_parameter[:, maps.moving] = batch.vjp(orbit.values[:, :-1], orbit.z, own, maps.moving)
            parts.append(maps.pulled(orbit.values, by_parameter))
        return np.concatenate(parts).sum(axis=0)

    def path_outcome(self, theta: np.ndarray, experiment: str) -> str:
        """Return how the branch through an experiment's anchor ends on the way to θ, see `arclength.path_outcome`."""
        assert self._anchors is not None
        anchor, parameters = self._anchors[experiment], self.parameters(theta[None], experiment)[0]
        return LOST if anchor.sensitivities is None else path_outcome(self.equations[experiment], anchor, parameters)

    def _log_multipliers(
        self, experiment: Experiment, z: np.ndarray, frequency: np.ndarray, parameters: np.ndarray, status: np.ndarray
    ) -> np.ndarray:
        """Return log|μ| (solves, multipliers) of those that were measured; "other orbit" where a sign differs."""
        if experiment.multipliers is None:
            return np.zeros((len(z), 0))
        measured = experiment.multipliers
        result = np.full((len(z), measured.size), np.nan)
        for i in np.flatnonzero(status == CONVERGED):
            equations = self.equations[experiment.name].at_frequency(float(frequency[i]))
            found = orbit_multipliers(equations, parameters[i], z[i], measured.size)
            if found.size < measured.size:
                status[i] = SINGULAR
            elif np.any(np.sign(found.real) != np.sign(measured)):
                status[i] = OTHER_ORBIT
            else:
                result[i] = np.log(np.abs(found))
        return result

    def largest_multipliers(self, theta: np.ndarray, experiment: str, solved: SolvedResponse) -> np.ndarray:
        """Return the modulus (solves,) of the largest multiplier at θ (solves, names); NaN where the solve failed."""
        parameters, result = self.parameters(theta, experiment), np.full(len(theta), np.nan)
        for i in np.flatnonzero(solved.status == CONVERGED):
            equations = self.equations[experiment].at_frequency(float(solved.response.frequency[i]))
            result[i] = np.abs(orbit_multipliers(equations, parameters[i], solved.z[i], 1)).max(initial=0.0)
        return result

    def solutions(self, theta: np.ndarray) -> dict[str, PeriodicSolution]:
        """Return the periodic solution of every experiment at one θ (names,), with its sensitivities."""
        solutions = {}
        for name, solved in self.solve(theta[None], keep=True).items():
            equations = self.equations[name].at_frequency(float(solved.response.frequency[0]))
            parameters = self.parameters(theta[None], name)[0]
            code = int(solved.status[0])
            solutions[name] = describe(equations, parameters, Solved(solved.z[0], code, np.empty((0, 3))))
        return solutions

    def changes(self, theta: np.ndarray, experiment: str, response: Response, z: np.ndarray) -> Response | None:
        """Return the derivatives of the response at the anchor by θ, (names, …); None where they do not exist.

        Parameters
        ----------
        theta : array (names,)
            Where the anchors are.
        experiment : str
        response, z
            There.
        """
        slopes, derivative = self.maps[experiment].slopes(theta), self._derivatives[experiment]
        if derivative is None:
            return None
        outputs = np.tensordot(slopes[:-1], derivative.outputs, (0, 0))
        multipliers = np.zeros((theta.size, 0))
        if response.log_multipliers.size:
            multipliers = self._multiplier_changes(theta, experiment, z, response)
        return Response(outputs, slopes[:-1].T @ derivative.frequency, multipliers, slopes[-1])

    def _multiplier_changes(self, theta: np.ndarray, experiment: str, z: np.ndarray, response: Response) -> np.ndarray:
        """Return ∂ log|μ|/∂θ at the anchor, (names, multipliers)."""
        assert self._anchors is not None
        anchor, directions = self._anchors[experiment], self.maps[experiment].slopes(theta)[:-1].T
        assert anchor.sensitivities is not None and anchor.frequency_sensitivities is not None
        equations = self.equations[experiment].at_frequency(float(response.frequency))
        parameters, count = self.parameters(theta[None], experiment)[0], response.log_multipliers.size
        solution = _described(equations, parameters, z)
        every = logarithmic_changes(
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

    def pulled(
        self, theta: np.ndarray, solved: Mapping[str, tuple[Response, np.ndarray]], weights: Mapping[str, Response]
    ) -> dict[str, np.ndarray]:
        """Return Σ weights · derivatives of a driven model's responses by θ (names,), NaN where they do not exist.

        That of the outputs takes one transposed solve an experiment.

        Parameters
        ----------
        theta : array (names,)
        solved : mapping of str to (Response, array (points, states))
            Of every experiment, there.
        weights : mapping of str to Response
        """
        result: dict[str, np.ndarray] = {}
        for experiments, maps, batch in self._batches:
            assert isinstance(batch, Batch)
            names = [e.name for e in experiments]
            values = maps.values(theta[None])[:, 0]
            z, outputs = np.stack([solved[n][1] for n in names]), np.stack([weights[n].outputs for n in names])
            by_parameter = np.zeros(values.shape)
            by_parameter[:, maps.moving] = batch.vjp(values[:, :-1], z, outputs, maps.moving)
            by_parameter[:, -1] = [weights[n].delay for n in names]
            result |= dict(zip(names, maps.pulled(values, by_parameter), strict=True))
        for name, (response, z) in solved.items():
            if response.log_multipliers.size:
                changes = self._multiplier_changes(theta, name, z, response)
                result[name] = result[name] + changes @ weights[name].log_multipliers
        return result


def orbit_multipliers(equations: PeriodicEquations, parameters: np.ndarray, z: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` largest multipliers of a solution z, or fewer, without an autonomous orbit's trivial 1."""
    if not count:
        return np.empty(0)
    easy = None if equations.model.autonomous else _easy_multipliers(equations, parameters, z, count)
    if easy is not None:
        return easy
    solution = _described(equations, parameters, z)
    return _without_trivial(solution, solution.multipliers)[:count]


def _easy_multipliers(
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
    return describe(equations, parameters, Solved(z, CONVERGED, np.empty((0, 3))), sensitivities=False)


def _without_trivial(solution: PeriodicSolution, values: np.ndarray) -> np.ndarray:
    """Return values, one a multiplier, without that of an autonomous orbit's trivial multiplier 1."""
    if not solution.autonomous or not values.size:
        return values
    return np.delete(values, np.argmin(np.abs(solution.exponents)))
