"""Accuracy and time of one log-posterior and its gradient, by method, on one problem."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.benchmark import integration
from studies.benchmark.floor import WALKERS, call, gradients, walk
from studies.benchmark.integration import EQUILIBRIUM, ESTIMATE, PREDICTED, SHOOTING, STEADY, Method, Reference
from studies.benchmark.kernels import MAX_CYCLES
from studies.benchmark.problems import SCHEMES, Setting
from studies.timing import Action, gradient_error, interleaved, spread

OWN_WARM = "this package, warm"
GRADIENT, OWN_GRADIENT = "shooting, value and gradient", "this package, value and gradient"
SLOW_REPEATS, SLOW_DRAWS = 3, 2
NEVER = f"not steady within {MAX_CYCLES} cycles, not converged, or not accurate enough with any setting"


@dataclass
class Contest:
    """All methods on one problem."""

    reference: Reference
    rows: list[dict[str, Any]] = field(default_factory=list)  # Name, errors and note of each method
    actions: dict[str, Action] = field(default_factory=dict)  # Of the methods that are timed
    compiled: dict[tuple[str, str], list[Method]] = field(default_factory=dict)  # By kind and start

    @property
    def setting(self) -> Setting:
        """The problem."""
        return self.reference.setting

    def add(
        self, name: str, error: float = np.inf, action: Action | None = None, note: str = "", off: float | None = None
    ) -> None:
        """Add a method with its largest |Δ log-posterior| at the draws; it is timed if that is within the limit.

        `note`: Its settings, or why it is not timed. `off`: Error of its gradient, relative to the largest component.
        """
        finite = error if np.isfinite(error) else None
        if action is not None and finite is None:
            action, note = None, NEVER
        elif action is not None and error > integration.ALLOWED:
            action, note = None, f"{note}{'; ' if note else ''}not accurate enough"
        if action is not None:
            self.actions[name] = action
        self.rows.append({"name": name, "error": finite, "note": note, "gradient_error": off})

    def add_methods(self, name: str, methods: Sequence[Any], error: float, label: str, *, slow: bool = True) -> None:
        """Add a method with its settings, one per experiment; a slow one is timed at two draws and three times only."""
        count, repeats = (SLOW_DRAWS, SLOW_REPEATS) if slow else (len(self.setting.theta), 10_000)
        action = Action(partial(self.integrate, methods, count), count, repeats)
        self.add(name, error, action, f"{label} {between([m.setting for m in methods])}")

    def add_until_steady(self, name: str, methods: Sequence[Any], error: float, label: str) -> None:
        """Add an integrator of another package, its cycles counted by the compiled method."""
        note = f"{label} {between([m.setting for m in methods])}"
        note += f"; {integration.TIMED_CYCLES} cycles timed, scaled to the number needed"
        for start in (EQUILIBRIUM, ESTIMATE):
            action = Action(partial(self._seconds, methods, start), 1, 1)
            self.add(f"{name} {start}", error if (STEADY, start) in self.compiled else np.inf, action, note)

    def integrate(self, methods: Sequence[Callable[[np.ndarray], float]], count: int) -> None:
        """Compute the log-posteriors of the first `count` draws."""
        for k in range(count):
            self.setting.log_prior(self.setting.theta[k])
            for method, parameters in zip(methods, self.reference.parameters, strict=True):
                method(parameters[k])

    def _seconds(self, methods: Sequence[Any], start: str) -> float:
        """Return the seconds of one log-posterior by integrations until steady."""
        every = zip(methods, self.compiled[STEADY, start], self.reference.parameters, strict=True)
        return sum(method.seconds(p[0], start, compiled.cycles(p)) for method, compiled, p in every)

    def value_and_gradient(self, k: int, both: Sequence[Callable[[np.ndarray], Any]]) -> tuple[float, np.ndarray]:
        """Return the log-posterior and its gradient at a draw from those of the log-likelihoods."""
        theta = self.setting.theta[k]
        value, gradient = self.setting.log_prior(theta), self.setting.problem.joint_prior.gradient(theta)
        for one, parameters in zip(both, self.reference.parameters, strict=True):
            own, by_theta = one(parameters[k])
            value, gradient = value + own, gradient + by_theta
        return value, gradient

    def gradient_error(self, gradient: np.ndarray) -> float:
        """Return the error of a gradient at the first draw against this package's, relative to the largest component.

        Components are scaled by the posterior's standard deviations.
        """
        problem, theta = self.setting.problem, self.setting.theta[0]
        exact = problem.gradient(theta, self.setting.noise, method="forward")[: gradient.size]
        sd = np.array(list(self.setting.fit.sd.values()))
        return float(np.abs((gradient - exact) * sd).max() / np.abs(exact * sd).max())


def between(values: Sequence[float]) -> str:
    """Return the range of values, one per experiment, as text."""
    low, high = min(values, default=np.nan), max(values, default=np.nan)
    return f"{low:.5g}" if low == high else f"{low:.5g} … {high:.5g}"


def add_own(contest: Contest) -> str | None:
    """Add this package with every scheme; return the cheapest sufficiently accurate scheme, or None."""
    setting, best = contest.setting, None
    theta, noise = setting.theta, setting.noise
    for scheme in SCHEMES:
        warm = setting.schemed(scheme)
        error = contest.reference.error(warm.log_posterior(theta, noise))
        best = best or (scheme if error <= integration.ALLOWED else None)
        many = np.resize(theta, (WALKERS, theta.shape[1]))
        for name, action in (
            (OWN_WARM, Action(partial(walk, warm, theta, noise), len(theta))),
            (f"{OWN_WARM}, all cores", Action(partial(call, warm, theta, noise), len(theta))),
            ("this package, batched, all cores", Action(partial(warm.log_posterior, many, noise), WALKERS)),
            ("this package, cold", Action(partial(_cold, setting, scheme), 1, SLOW_REPEATS)),
        ):
            contest.add(f"{name}, {scheme}", error, action)
        gradient = Action(partial(gradients, warm, theta[:SLOW_DRAWS], noise), SLOW_DRAWS)
        off = gradient_error(warm, theta[0], noise)
        contest.add(f"{OWN_GRADIENT}, {scheme}", error, gradient, off=off)
    return best


def _cold(setting: Setting, scheme: str) -> None:
    """Solve every experiment from static equilibrium."""
    for case in setting.cases:
        e, values = case.experiment, setting.parameters(setting.theta[:1], case)[0]
        solution = bp.solve_periodic(
            case.model, dict(zip(case.model.parameters, values[:-1].tolist(), strict=True)), e.inputs,
            frequency=e.frequency, samples=e.samples, scheme=scheme,
        )  # fmt: skip
        outputs = np.stack([solution.outputs[channel] for channel in case.model.outputs], axis=-1)
        case.log_likelihood(np.ascontiguousarray(outputs))


def add_compiled(contest: Contest) -> None:
    """Add the compiled Runge-Kutta method until steady and shooting on it, each from every start."""
    reference = contest.reference
    for kind, start in product((STEADY, SHOOTING), integration.STARTS):
        methods, error = reference.tuned(partial(Method, kind=kind, start=start), integration.TOLERANCES)
        steps = between([method.discretised.steps for method in methods])
        cycles = between([method.cycles(p) for method, p in zip(methods, reference.parameters, strict=False)])
        label = f"{steps} steps per cycle, {cycles} cycles, tolerance"
        contest.add_methods(f"{kind} {start}", methods, error, label, slow=kind == STEADY and start != PREDICTED)
        if methods:
            contest.compiled[kind, start] = methods
    if (SHOOTING, PREDICTED) in contest.compiled:
        methods = contest.compiled[SHOOTING, PREDICTED]
        both = [partial(method.discretised.value_and_gradient, tolerance=method.setting) for method in methods]
        values, slopes = zip(
            *(contest.value_and_gradient(k, both) for k in range(len(reference.log_priors))), strict=True
        )
        action = Action(lambda: [contest.value_and_gradient(k, both) for k in range(SLOW_DRAWS)], SLOW_DRAWS)
        off = contest.gradient_error(slopes[0])
        contest.add(GRADIENT, reference.error(np.array(values)), action, "against this package's gradient", off)


def measured(contest: Contest, scheme: str | None, repeats: int) -> dict[str, Any]:
    """Return times of all methods, and their ratios to one warm log-posterior of this package."""
    times = interleaved(contest.actions, repeats)

    def over(name: str, own: str) -> dict[str, float] | None:
        own = f"{own}, {scheme}"
        return spread(times[name] / times[own]) if name in times and own in times else None

    rows = []
    for row in contest.rows:
        name = row["name"]
        milliseconds = spread(1e3 * times[name]) if name in times else None
        rows.append(row | {"milliseconds": milliseconds, "ratio": over(name, OWN_WARM)})
    return {
        "synthetic": contest.setting.synthetic,
        "experiments": len(contest.setting.cases),
        "samples": contest.setting.cases[0].experiment.samples,
        "draws": len(contest.setting.theta),
        "allowed": integration.ALLOWED,
        "reference_uncertainty": contest.reference.uncertainty,
        "scheme": scheme,
        "rows": rows,
        "gradient_ratio": over(GRADIENT, OWN_GRADIENT),
    }
