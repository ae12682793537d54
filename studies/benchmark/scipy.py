"""SciPy on one experiment: solve_ivp with compiled right-hand sides, solve_bvp with those of NumPy."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.interpolate import CubicSpline

from studies.benchmark.contenders import SLOW_DRAWS, Contest
from studies.benchmark.equations import NUMPY, FirstOrder
from studies.benchmark.integration import EQUILIBRIUM, ESTIMATE, LOOSE, PREDICTED, TABLE, TIMED_CYCLES, Peer

LSODA, RADAU, BVP = "LSODA", "Radau", "solve_bvp"
INITIAL = (LSODA, RADAU)
RELATIVE = tuple(10.0**-k for k in range(3, 13))
NODES, MOST_NODES = 201, 50_000


def add_scipy(contest: Contest, *, quick: bool = False) -> None:
    """Add solve_ivp (but for a quick run) and solve_bvp."""
    for method in () if quick else INITIAL:
        methods, error = contest.reference.tuned(partial(Initial, method=method), RELATIVE, 1)
        contest.add_until_steady(method, methods, error, "rtol")
    for start in (ESTIMATE,) if quick else (EQUILIBRIUM, ESTIMATE):
        tuned = contest.reference.tuned(partial(Boundary, start=start), RELATIVE, SLOW_DRAWS)
        contest.add_methods(f"{BVP} {start}", *tuned, "tol")


@dataclass(frozen=True)
class Initial(Peer):
    """solve_ivp through cycles of one experiment; the absolute tolerances are relative to the states' sizes."""

    method: str

    def cycles(self, p: np.ndarray, start: np.ndarray, count: int) -> float:
        """Return the log-likelihood of the last of so many cycles; NaN if SciPy fails."""
        case = self.case
        options = {"jac": case.compiled.jacobian_in_time} if self.method == RADAU else {}
        solved = solve_ivp(  # type: ignore[call-overload]
            case.compiled.rates_in_time, (0.0, count * case.period), start, self.method,
            (count - 1) * case.period + case.times, rtol=self.setting, atol=self.setting * case.scale,
            args=(p, self.table, case.period), **options,
        )  # fmt: skip
        return case.log_likelihood_of(p, solved.y.T) if solved.success else np.nan

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood after one cycle from the steady state; NaN for failure."""
        found = self.discretised.shoot(p, PREDICTED, LOOSE)
        return self.cycles(p, self.discretised.orbit, 1) if found else np.nan

    def prepared(self, p: np.ndarray, start: np.ndarray) -> Callable[[], Any]:
        """Return the integration through `TIMED_CYCLES` cycles."""
        return partial(self.cycles, p, start, TIMED_CYCLES)


@dataclass(frozen=True)
class Boundary(Peer):
    """solve_bvp with periodic conditions on one experiment, from the states at the estimate or at equilibrium."""

    start: str

    @cached_property
    def _signals(self) -> CubicSpline:
        times = np.arange(TABLE + 1) * (self.case.period / TABLE)
        return CubicSpline(times, np.vstack([self.table, self.table[:1]])[:, :-1], bc_type="periodic")

    @cached_property
    def _guess(self) -> tuple[np.ndarray, np.ndarray]:
        """The mesh (nodes,) and the states (size, nodes) on it; at the estimate those that solve_bvp ends with."""
        case, times = self.case, np.linspace(0.0, self.case.period, NODES)
        if self.start == EQUILIBRIUM:
            return times, np.repeat(case.start[:, None], NODES, axis=1)
        self.discretised.shoot(case.estimate, PREDICTED, LOOSE)
        guess = times, self.discretised.states(times)
        found = self._solve(case.estimate, *guess)
        return (found.x, found.y) if found.success else guess

    def _solve(self, p: np.ndarray, times: np.ndarray, guess: np.ndarray) -> Any:
        size, (f, by_y) = len(guess), functions(self.case.model)

        def inputs(t: np.ndarray) -> np.ndarray:
            return np.vstack([self._signals(t).T, t * self.case.experiment.frequency])

        def rates(t: np.ndarray, y: np.ndarray) -> np.ndarray:
            out = np.empty_like(y)
            f(y, inputs(t), p, out)
            return out

        def jacobian(t: np.ndarray, y: np.ndarray) -> np.ndarray:
            out = np.empty((size, *y.shape))
            by_y(y, inputs(t), p, out)
            return out

        return solve_bvp(
            rates, lambda a, b: a - b, times, guess, tol=self.setting, fun_jac=jacobian,
            bc_jac=lambda *_: (np.eye(size), -np.eye(size)), max_nodes=MOST_NODES,
        )  # fmt: skip

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood; NaN for failure."""
        found = self._solve(p, *self._guess)
        return self.case.log_likelihood_of(p, found.sol(self.case.times).T) if found.success else np.nan


@cache
def functions(model: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the rates of a model and their derivatives by y, on whole arrays."""
    first = FirstOrder(model, ())
    return first.function(NUMPY, first.rates), first.function(NUMPY, first.by_states(first.rates))
