"""SciPy on one experiment: solve_ivp with compiled right-hand sides, solve_bvp with those of NumPy."""

import time
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.interpolate import CubicSpline

from studies.benchmark.equations import NUMPY, FirstOrder
from studies.benchmark.integration import EQUILIBRIUM, LOOSE, PREDICTED, Discretised, loosest
from studies.benchmark.problems import Case

LSODA, RADAU, BVP = "LSODA", "Radau", "solve_bvp"
INITIAL = (LSODA, RADAU)
RELATIVE = tuple(10.0**-k for k in range(3, 13))
TABLE = 16_384
# Cycles that are timed; the others cost about the same.
TIMED_CYCLES = 2
NODES, MOST_NODES = 201, 50_000


@dataclass(frozen=True)
class Initial:
    """solve_ivp through cycles of one experiment."""

    discretised: Discretised  # Where starts come from
    method: str
    relative: float  # The relative tolerance, and the absolute one of the states' sizes

    @property
    def _case(self) -> Case:
        return self.discretised.case

    @cached_property
    def _table(self) -> np.ndarray:
        return self._case.table(TABLE)

    def cycles(self, p: np.ndarray, start: np.ndarray, count: int) -> np.ndarray:
        """Return the states (samples, size) of the last of so many cycles; NaN if SciPy fails."""
        case, samples = self._case, self._case.experiment.samples
        options = {"jac": case.compiled.jacobian_in_time} if self.method == RADAU else {}
        solved = solve_ivp(  # type: ignore[call-overload]
            case.compiled.rates_in_time,
            (0.0, count * case.period),
            start,
            self.method,
            (count - 1 + np.arange(samples) / samples) * case.period,
            rtol=self.relative,
            atol=self.relative * case.scale,
            args=(p, self._table, case.period),
            **options,
        )
        return solved.y.T if solved.success else np.full((samples, start.size), np.nan)

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood after one cycle from the steady state; NaN for failure."""
        if not self.discretised.shoot(p, PREDICTED, LOOSE):
            return np.nan
        return _log_likelihood(self._case, p, self.cycles(p, self.discretised.orbit, 1))

    def seconds(self, p: np.ndarray, start: str, count: float) -> float:
        """Return the seconds until steady: those of a few cycles, times as many as it takes."""
        y = self.discretised.start(p, start)
        before = time.perf_counter()
        _log_likelihood(self._case, p, self.cycles(p, y, TIMED_CYCLES))
        return (time.perf_counter() - before) * max(count, 1.0) / TIMED_CYCLES


def _log_likelihood(case: Case, p: np.ndarray, states: np.ndarray) -> float:
    outputs = np.empty((case.experiment.samples, len(case.model.outputs)))
    case.compiled.outputs(p, case.signals, np.ascontiguousarray(states), outputs)
    return case.log_likelihood(outputs)


def tune_initial(
    one: Discretised, method: str, parameters: np.ndarray, exact: np.ndarray, allowed: float
) -> Initial | None:
    """Return solve_ivp with the loosest tolerance that is accurate enough at the draws; None if there is none."""
    return loosest(partial(Initial, one, method), RELATIVE, parameters, exact, allowed)


class Boundary:
    """solve_bvp with periodic conditions on one experiment."""

    def __init__(self, case: Case, tolerance: float):
        self.case, self.tolerance, first = case, tolerance, FirstOrder(case.model, case.moving)
        self._rates = first.function(NUMPY, first.rates)
        self._jacobian = first.function(NUMPY, first.by_states(first.rates))
        nodes = case.table(TABLE)
        times = np.arange(TABLE + 1) * (case.period / TABLE)
        self._signals = CubicSpline(times, np.vstack([nodes, nodes[:1]])[:, :-1], bc_type="periodic")
        size = case.start.size
        self._ends = np.eye(size), -np.eye(size)

    def _inputs(self, t: np.ndarray) -> np.ndarray:
        return np.vstack([self._signals(t).T, t * self.case.experiment.frequency])

    def solve(self, p: np.ndarray, times: np.ndarray, guess: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log-likelihood (NaN for failure), the mesh (nodes,) and the states (size, nodes) on it."""
        case = self.case

        def rates(t: np.ndarray, y: np.ndarray) -> np.ndarray:
            out = np.empty_like(y)
            self._rates(y, self._inputs(t), p, out)
            return out

        def jacobian(t: np.ndarray, y: np.ndarray) -> np.ndarray:
            out = np.empty((y.shape[0], *y.shape))
            self._jacobian(y, self._inputs(t), p, out)
            return out

        found = solve_bvp(
            rates, lambda a, b: a - b, times, guess, tol=self.tolerance, fun_jac=jacobian,
            bc_jac=lambda *_: self._ends, max_nodes=MOST_NODES,
        )  # fmt: skip
        if not found.success:
            return np.nan, times, guess
        samples = case.experiment.samples
        states = found.sol(np.arange(samples) * (case.period / samples)).T
        return _log_likelihood(case, p, states), found.x, found.y

    def constant(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a mesh and static equilibrium on it."""
        return np.linspace(0.0, self.case.period, NODES), np.repeat(self.case.start[:, None], NODES, axis=1)


@dataclass(frozen=True)
class Solved:
    """solve_bvp from a mesh and the states on it, those of the estimate or of equilibrium."""

    boundary: Boundary
    times: np.ndarray  # (nodes,)
    guess: np.ndarray  # (size, nodes)

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood."""
        return self.boundary.solve(p, self.times, self.guess)[0]


def tune_boundary(
    one: Discretised, start: str, parameters: np.ndarray, exact: np.ndarray, allowed: float
) -> Solved | None:
    """Return solve_bvp with the loosest tolerance that is accurate enough at the draws; None if there is none."""

    def solved(relative: float) -> Solved:
        boundary = Boundary(one.case, relative)
        return Solved(boundary, *(boundary.constant() if start == EQUILIBRIUM else _at_the_estimate(one, boundary)))

    return loosest(solved, RELATIVE, parameters, exact, allowed)


def _at_the_estimate(one: Discretised, boundary: Boundary) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh that solve_bvp ends with at the estimate, and the states on it."""
    one.shoot(one.case.estimate, PREDICTED, LOOSE)
    times = np.linspace(0.0, one.case.period, NODES)
    guess = one.states(times)
    return boundary.solve(one.case.estimate, times, guess)[1:]
