"""Accuracy and time of one log-posterior and its gradient, by method, on one problem."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.benchmark.integration import (
    ALLOWED,
    EQUILIBRIUM,
    ESTIMATE,
    PREDICTED,
    SHOOTING,
    STARTS,
    STEADY,
    Method,
    Reference,
    tune,
)
from studies.benchmark.problems import SCHEMES, Setting
from studies.benchmark.scipy import BVP, INITIAL, tune_boundary, tune_initial
from studies.timing import Action, gradient_error, interleaved, ratio, spread

OWN_WARM, OWN_CALL, OWN_BATCHED, OWN_COLD = (
    "this package, warm", "this package, warm, all cores", "this package, batched, all cores", "this package, cold",
)  # fmt: skip
GRADIENT, OWN_GRADIENT = "shooting, value and gradient", "this package, value and gradient"
WALKERS = 64
SLOW_REPEATS, SLOW_DRAWS = 3, 2

# Methods of all experiments by kind and start.
Compiled = dict[tuple[str, str], list[Method]]


@dataclass(frozen=True)
class Row:
    """One method."""

    name: str
    error: float  # The largest |Δ log-posterior| at the draws
    action: Action | None  # None if it is not installed or never accurate enough
    note: str = ""  # Settings, or why there is no time
    gradient_error: float | None = None  # The largest of any component, relative to the largest component


@dataclass
class Contest:
    """All methods on one problem."""

    reference: Reference
    rows: list[Row] = field(default_factory=list)

    @property
    def setting(self) -> Setting:
        """The problem."""
        return self.reference.setting

    def add(self, name: str, error: float, action: Action, note: str = "", gradient_error: float | None = None) -> None:
        """Add a method; it is not timed if it is less accurate than allowed."""
        right = error <= ALLOWED
        note = note if right else f"{note + '; ' if note else ''}not accurate enough"
        self.rows.append(Row(name, error, action if right else None, note, gradient_error))

    def gradient_error(self, gradient: np.ndarray) -> float:
        """Return the error of a gradient at the first draw against this package's, relative to the largest component.

        Components are scaled by the posterior's standard deviations.
        """
        problem, theta = self.setting.problem, self.setting.theta[0]
        exact = problem.gradient(theta, self.setting.noise, method="forward")[: gradient.size]
        sd = np.array(list(self.setting.fit.sd.values()))
        return float(np.abs((gradient - exact) * sd).max() / np.abs(exact * sd).max())

    def refuse(self, name: str, why: str) -> None:
        """Add a method that cannot be timed."""
        self.rows.append(Row(name, np.inf, None, why))


def add_own(contest: Contest) -> str | None:
    """Add this package with every scheme; return the cheapest sufficiently accurate scheme, or None."""
    setting, best = contest.setting, None
    for scheme in SCHEMES:
        warm = setting.schemed(scheme)
        error = contest.reference.error(warm.log_posterior(setting.theta, setting.noise))
        best = best or (scheme if error <= ALLOWED else None)
        many = np.resize(setting.theta, (WALKERS, len(setting.problem.names)))
        for name, action in (
            (OWN_WARM, Action(partial(_one_by_one, setting, warm), len(setting.theta))),
            (OWN_CALL, Action(partial(_calls, setting, warm), len(setting.theta))),
            (OWN_BATCHED, Action(partial(warm.log_posterior, many, setting.noise), WALKERS)),
        ):
            contest.add(f"{name}, {scheme}", error, action)
        contest.add(f"{OWN_COLD}, {scheme}", error, Action(partial(_cold, setting, scheme), 1, SLOW_REPEATS))
        gradient = Action(partial(_gradients, setting, warm, SLOW_DRAWS), SLOW_DRAWS)
        off = gradient_error(warm, setting.theta[0], setting.noise)
        contest.add(f"{OWN_GRADIENT}, {scheme}", error, gradient, gradient_error=off)
    return best


def _one_by_one(setting: Setting, warm: bp.Problem) -> None:
    for theta in setting.theta:
        warm.log_prior(theta) + warm.log_likelihood(theta, setting.noise, 1)


def _calls(setting: Setting, warm: bp.Problem) -> None:
    for theta in setting.theta:
        warm.log_posterior(theta, setting.noise)


def _gradients(setting: Setting, warm: bp.Problem, count: int) -> None:
    for theta in setting.theta[:count]:
        warm.value_and_gradient(theta, setting.noise)


def _cold(setting: Setting, scheme: str) -> None:
    """Solve every experiment from static equilibrium."""
    theta = setting.theta[:1]
    for case in setting.cases:
        e, values = case.experiment, setting.parameters(theta, case)[0]
        solution = bp.solve_periodic(
            case.model, dict(zip(case.model.parameters, values[:-1].tolist(), strict=True)), e.inputs,
            frequency=e.frequency, samples=e.samples, scheme=scheme,
        )  # fmt: skip
        outputs = np.stack([solution.outputs[channel] for channel in case.model.outputs], axis=-1)
        case.log_likelihood(np.ascontiguousarray(outputs))


def add_compiled(contest: Contest) -> Compiled:
    """Add the compiled Runge-Kutta method until steady and shooting on it, each from every start."""
    reference, every, found = contest.reference, contest.reference.discretised(), {}
    for kind in (STEADY, SHOOTING):
        for start in STARTS:
            name = f"{kind} {start}"
            tuned = reference.tuned(lambda k, *rest: tune(every[k], kind, start, *rest))  # noqa: B023
            if tuned is None:
                contest.refuse(name, "not steady within 5000 cycles, or not accurate enough at any tolerance")
                continue
            methods, error = tuned
            slow = kind == STEADY and start != PREDICTED
            count = SLOW_DRAWS if slow else len(contest.setting.theta)
            action = Action(partial(integrate, contest, methods, count), count, SLOW_REPEATS if slow else 10_000)
            contest.add(name, error, action, _steps(methods))
            found[kind, start] = methods
    if (SHOOTING, PREDICTED) in found:
        _add_gradient(contest, found[SHOOTING, PREDICTED])
    return found


def _steps(methods: Sequence[Method]) -> str:
    steps, sweeps = [m.discretised.steps for m in methods], [m.sweeps for m in methods]
    between = f"{min(steps)}" if len(set(steps)) == 1 else f"{min(steps)} … {max(steps)}"
    return f"{between} steps per cycle, {min(sweeps):.3g} … {max(sweeps):.3g} cycles"


def integrate(contest: Contest, methods: Sequence[Callable[[np.ndarray], float]], count: int) -> None:
    """Compute the log-posteriors of the first `count` draws."""
    setting, reference = contest.setting, contest.reference
    for k in range(count):
        setting.log_prior(setting.theta[k])
        for method, parameters in zip(methods, reference.parameters, strict=True):
            method(parameters[k])


def _add_gradient(contest: Contest, methods: Sequence[Method]) -> None:
    """Add shooting with the variational equations."""
    setting, reference = contest.setting, contest.reference

    def both(k: int) -> tuple[float, np.ndarray]:
        value, gradient = setting.log_prior(setting.theta[k]), setting.problem.joint_prior.gradient(setting.theta[k])
        for method, parameters in zip(methods, reference.parameters, strict=True):
            own, by_theta = method.discretised.value_and_gradient(parameters[k], method.tolerance)
            value, gradient = value + own, gradient + by_theta
        return value, gradient

    values, gradients = zip(*(both(k) for k in range(len(setting.theta))), strict=True)
    contest.add(
        GRADIENT, reference.error(np.array(values)), Action(lambda: [both(k) for k in range(SLOW_DRAWS)], SLOW_DRAWS),
        "against this package's gradient", contest.gradient_error(gradients[0]),
    )  # fmt: skip


def add_scipy(contest: Contest, compiled: Compiled, *, quick: bool = False) -> None:
    """Add solve_ivp (but for a quick run), its cycles counted by the compiled method, and solve_bvp."""
    reference = contest.reference
    every = [m.discretised for m in next(iter(compiled.values()))]
    for method in () if quick else INITIAL:
        tuned = reference.tuned(lambda k, *rest: tune_initial(every[k], method, *rest), 1)  # noqa: B023
        for start in (EQUILIBRIUM, ESTIMATE):
            name = f"{method} {start}"
            if tuned is None or (STEADY, start) not in compiled:
                contest.refuse(name, "not accurate enough at any tolerance, or not steady within 5000 cycles")
                continue
            ready, error = tuned
            tolerances = [one.relative for one in ready]
            note = f"rtol {min(tolerances):.0e} … {max(tolerances):.0e}; 2 cycles timed, scaled to the number needed"
            seconds = partial(seconds_until_steady, contest, ready, start, [m.sweeps for m in compiled[STEADY, start]])
            contest.add(name, error, Action(seconds, 1, 1), note)
    for start in (ESTIMATE,) if quick else (EQUILIBRIUM, ESTIMATE):
        found = reference.tuned(lambda k, *rest: tune_boundary(every[k], start, *rest), SLOW_DRAWS)  # noqa: B023
        if found is None:
            contest.refuse(f"{BVP} {start}", "not accurate enough at any tolerance, or not converged")
            continue
        solved, error = found
        tolerances = [one.boundary.tolerance for one in solved]
        action = Action(partial(integrate, contest, solved, SLOW_DRAWS), SLOW_DRAWS, SLOW_REPEATS)
        contest.add(f"{BVP} {start}", error, action, f"tol {min(tolerances):.0e} … {max(tolerances):.0e}")


def seconds_until_steady(contest: Contest, ready: Sequence[Any], start: str, cycles: Sequence[float]) -> float:
    """Return the seconds of one log-posterior by integrations until steady."""
    parameters = contest.reference.parameters
    return sum(one.seconds(p[0], start, n) for one, p, n in zip(ready, parameters, cycles, strict=True))


def measured(contest: Contest, scheme: str | None, repeats: int) -> dict[str, Any]:
    """Return times of all methods, and their ratios to one warm log-posterior of this package."""
    actions = {row.name: row.action for row in contest.rows if row.action is not None}
    times = interleaved(actions, repeats)
    under = times.get(f"{OWN_WARM}, {scheme}")
    found = []
    for row in contest.rows:
        entry: dict[str, Any] = {"name": row.name, "error": row.error if np.isfinite(row.error) else None}
        entry |= {"note": row.note, "gradient_error": row.gradient_error, "milliseconds": None, "ratio": None}
        if row.name in times:
            entry["milliseconds"] = spread(1e3 * times[row.name])
            entry["ratio"] = None if under is None else ratio(times[row.name], under)
        found.append(entry)
    return {
        "synthetic": contest.setting.synthetic,
        "experiments": len(contest.setting.cases),
        "samples": contest.setting.cases[0].experiment.samples,
        "draws": len(contest.setting.theta),
        "allowed": ALLOWED,
        "reference_uncertainty": contest.reference.uncertainty,
        "scheme": scheme,
        "rows": found,
        "gradient_ratio": _gradient_ratio(times, scheme),
    }


def _gradient_ratio(times: Any, scheme: str | None) -> dict[str, float] | None:
    own = times.get(f"{OWN_GRADIENT}, {scheme}")
    return None if own is None or GRADIENT not in times else ratio(times[GRADIENT], own)
