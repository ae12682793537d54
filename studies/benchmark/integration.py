"""Time integration and shooting of one experiment, with the cheapest settings of sufficient accuracy.

The reference of a problem is its log-posterior at the draws by fully converged shooting with small steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from studies.benchmark.problems import Case, Setting

Way = TypeVar("Way", bound=Callable[[np.ndarray], float])

STEADY, SHOOTING = "Runge-Kutta until steady", "shooting"
EQUILIBRIUM, ESTIMATE, PREDICTED = "from equilibrium", "from the estimate's orbit", "from the predicted orbit"
STARTS = (EQUILIBRIUM, ESTIMATE, PREDICTED)
STEPS = (
    20, 25, 32, 40, 50, 64, 80, 100, 128, 160, 200, 256, 320, 400, 512, 640, 800, 1000, 1280, 1600, 2000, 2560, 3200,
    4000, 5120, 6400, 8000, 10_240, 12_800, 16_000, 20_480, 25_600, 32_000, 40_960, 51_200,
)  # fmt: skip
TOLERANCES = tuple(10.0**-k for k in range(1, 13))
REFERENCE_STEPS = 25_600, 51_200, 102_400, 204_800
REFERENCE_TOLERANCE, REFERENCE_ERROR = 1e-10, 1e-5
MOST = 30
TIGHT, LOOSE = 1e-11, 1e-9


@dataclass(frozen=True)
class Discretised:
    """An experiment with a number of Runge-Kutta steps per period, and its orbit at the estimate."""

    case: Case
    steps: int

    @cached_property
    def _inputs(self) -> np.ndarray:
        return self.case.table(2 * self.steps)

    @cached_property
    def _buffers(self) -> tuple[np.ndarray, ...]:
        size, columns = self.case.start.size, self.case.start.size + len(self.case.moving)
        rows = self.steps + 1
        return (
            np.empty((rows, size)), np.empty((rows, size)), np.empty((rows, size, columns)),
            np.empty((rows, size, columns)), np.empty((self.case.experiment.samples, size)),
            np.empty((self.case.experiment.samples, len(self.case.model.outputs))),
            np.empty((self.case.experiment.samples, size * len(self.case.moving))),
        )  # fmt: skip

    @cached_property
    def anchor(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """At the estimate: y(0), (I − Φ)⁻¹ and dy(0)/dp; None where shooting does not converge."""
        if not any(self._newton(self.case.estimate, self.case.first, tolerance) for tolerance in (TIGHT, LOOSE)):
            return None
        last, size = self._buffers[2][-1], self.case.start.size
        inverse = np.linalg.inv(np.eye(size) - last[:, :size])
        return self._buffers[0][0].copy(), inverse, inverse @ last[:, size:]

    def _newton(self, p: np.ndarray, start: np.ndarray, tolerance: float) -> int:
        path, rates, wide, wide_rates = self._buffers[:4]
        return self.case.compiled.newton(
            p, self._inputs, self.case.period, start.copy(), self.case.scale, tolerance, MOST, path, rates, wide,
            wide_rates,
        )  # fmt: skip

    def start(self, p: np.ndarray, kind: str) -> np.ndarray:
        """Return y(0) to begin with."""
        if kind == EQUILIBRIUM:
            return self.case.start.copy()
        assert self.anchor is not None
        y, _, slopes = self.anchor
        if kind == ESTIMATE:
            return y.copy()
        return y + slopes @ (p[self.columns] - self.case.estimate[self.columns])

    @cached_property
    def columns(self) -> list[int]:
        """Where the moving parameters are in p."""
        return [list(self.case.model.parameters).index(name) for name in self.case.moving]

    def settle(self, p: np.ndarray, kind: str, tolerance: float) -> int:
        """Integrate until steady; return the number of cycles, 0 for never."""
        path, rates = self._buffers[:2]
        return self.case.compiled.steady(
            p, self._inputs, self.case.period, self.start(p, kind), self.case.scale, tolerance, path, rates
        )

    def shoot(self, p: np.ndarray, kind: str, tolerance: float) -> int:
        """Shoot, with the matrix of the estimate but from equilibrium; return the number of sweeps, 0 for failure."""
        if kind == EQUILIBRIUM:
            return self._newton(p, self.case.start, tolerance)
        assert self.anchor is not None
        path, rates = self._buffers[:2]
        return self.case.compiled.chord(
            p, self._inputs, self.case.period, self.start(p, kind), self.anchor[1], self.case.scale, tolerance, MOST,
            path, rates,
        )  # fmt: skip

    @property
    def orbit(self) -> np.ndarray:
        """The start y(0) of the cycle integrated last."""
        return self._buffers[0][0].copy()

    def states(self, times: np.ndarray) -> np.ndarray:
        """Return the states (size, times) of the cycle integrated last, linearly between its steps."""
        steps = np.linspace(0.0, self.case.period, self.steps + 1)
        return np.stack([np.interp(times, steps, column) for column in self._buffers[0].T])

    def log_likelihood(self, p: np.ndarray) -> float:
        """Return the log-likelihood of the cycle integrated last."""
        return self.case.log_likelihood(self._outputs(p))

    def _outputs(self, p: np.ndarray) -> np.ndarray:
        path, rates, _, _, states, outputs, _ = self._buffers
        self.case.compiled.dense(path, rates, self.case.period / self.steps, states)
        self.case.compiled.outputs(p, self.case.signals, states, outputs)
        return outputs

    def value_and_gradient(self, p: np.ndarray, tolerance: float) -> tuple[float, np.ndarray]:
        """Return the log-likelihood and its gradient by θ: chord steps, then one sweep of the variational equations."""
        path, rates, wide, wide_rates, states, _, changes = self._buffers
        self.shoot(p, PREDICTED, tolerance)
        self.case.compiled.newton(
            p, self._inputs, self.case.period, path[0].copy(), self.case.scale, np.inf, 1, path, rates, wide, wide_rates
        )
        outputs, size, count = self._outputs(p), self.case.start.size, len(self.case.moving)
        last = wide[-1]
        slopes = np.linalg.solve(np.eye(size) - last[:, :size], last[:, size:])
        self._changes(wide, wide_rates, slopes, changes)
        by_p = np.empty(count)
        weights = self.case.weighted_residuals(outputs)
        self.case.compiled.pulled(p, self.case.signals, states, changes, weights, by_p)
        return self.case.log_likelihood(outputs), by_p @ self.case.slopes

    def _changes(self, wide: np.ndarray, wide_rates: np.ndarray, slopes: np.ndarray, out: np.ndarray) -> None:
        """Fill the derivatives of the states by p (samples, size·moving)."""
        size, rows = self.case.start.size, len(wide)
        by_p, rates = (part[:, :, size:] + part[:, :, :size] @ slopes for part in (wide, wide_rates))
        self.case.compiled.dense(
            by_p.reshape(rows, -1), rates.reshape(rows, -1), self.case.period / self.steps, out
        )  # fmt: skip


@dataclass(frozen=True)
class Method:
    """A method for the log-likelihood of one experiment."""

    discretised: Discretised
    kind: str  # `STEADY` or `SHOOTING`
    start: str  # One of `STARTS`
    tolerance: float  # Of the last change of y(0), of its scale
    error: float = np.inf  # The largest at any draw
    sweeps: float = 0.0  # Cycles integrated, in the mean

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood; NaN where no orbit is found."""
        return self.discretised.log_likelihood(p) if self.run(p) else np.nan

    def run(self, p: np.ndarray) -> int:
        """Return the number of cycles integrated."""
        settle = self.discretised.settle if self.kind == STEADY else self.discretised.shoot
        return settle(p, self.start, self.tolerance)

    def judged(self, parameters: np.ndarray, exact: np.ndarray) -> "Method":
        """Return the same with its error and its sweeps at the draws; the error is infinite where it fails."""
        values, sweeps = [], []
        for p in parameters:
            sweeps.append(self.run(p))
            if not sweeps[-1]:
                return self
            values.append(self.discretised.log_likelihood(p))
        error = float(np.max(np.abs(np.array(values) - exact)))
        error = error if np.isfinite(error) else np.inf
        return Method(self.discretised, self.kind, self.start, self.tolerance, error, float(np.mean(sweeps)))


def exact(case: Case, parameters: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the log-likelihood at draws by shooting with small steps, and its change when the steps are doubled."""
    coarse = np.full(len(parameters), np.nan)
    for steps in (REFERENCE_STEPS[0] // 2, *REFERENCE_STEPS):
        one = Discretised(case, steps)
        fine = np.array([Method(one, SHOOTING, PREDICTED, REFERENCE_TOLERANCE)(p) for p in parameters])
        off = float(np.max(np.abs(fine - coarse)))
        if off < REFERENCE_ERROR:
            break
        coarse = fine
    return fine, off


def discretise(case: Case, parameters: np.ndarray, exact: np.ndarray, allowed: float) -> Discretised:
    """Return the experiment with the fewest steps that keep the error at all draws within the limit."""
    for steps in STEPS:
        one = Discretised(case, steps)
        if one.anchor is not None and _off(one, parameters, exact) <= allowed:
            return one
    raise RuntimeError(f"{case.experiment.name}: {STEPS[-1]} steps are not as accurate as {allowed:.1e}.")


def _off(one: Discretised, parameters: np.ndarray, exact: np.ndarray) -> float:
    for tolerance in (TIGHT, LOOSE):
        error = Method(one, SHOOTING, PREDICTED, tolerance).judged(parameters, exact).error
        if np.isfinite(error):
            return error
    return np.inf


def loosest(
    make: Callable[[Any], Way], settings: Sequence[Any], parameters: np.ndarray, exact: np.ndarray, allowed: float
) -> Way | None:
    """Return the method with the first of the settings that is accurate enough at the draws, None if there is none."""
    for one in settings:
        found = make(one)
        if np.max([abs(found(p) - e) for p, e in zip(parameters, exact, strict=True)]) <= allowed:
            return found
    return None


def tune(
    one: Discretised, kind: str, start: str, parameters: np.ndarray, exact: np.ndarray, allowed: float
) -> Method | None:
    """Return the method with the loosest tolerance that is accurate enough at every draw; None if there is none."""
    for tolerance in TOLERANCES:
        found = Method(one, kind, start, tolerance).judged(parameters, exact)
        if found.error <= allowed:
            return found
    return None


ALLOWED = 1e-2
# Fractions of the allowed error per experiment that are tried, because errors may add up.
TRIES = (1.0, 0.5, 0.25, 0.1)
# Fraction of the allowed error that the step size may use; the approach to the steady state may use the rest.
SHARE = 0.5


@dataclass(frozen=True)
class Reference:
    """Reference of all methods."""

    setting: Setting
    parameters: list[np.ndarray]  # (draws, parameters + 1): One an experiment
    exact: list[np.ndarray]  # (draws,): Log-likelihoods, one per experiment
    uncertainty: float  # By how much steps twice as long would change a log-posterior

    @property
    def each(self) -> float:
        """Allowed error per experiment, so that errors of either sign add up to the total allowed."""
        return ALLOWED / np.sqrt(len(self.exact))

    @property
    def log_posteriors(self) -> np.ndarray:
        """At the draws."""
        return self.log_priors + np.sum(self.exact, axis=0)

    @property
    def log_priors(self) -> np.ndarray:
        """At the draws."""
        return np.array([self.setting.log_prior(theta) for theta in self.setting.theta])

    def discretised(self) -> list[Discretised]:
        """Return every experiment with the fewest steps that are accurate enough."""
        return [
            discretise(case, p, e, SHARE * self.each)
            for case, p, e in zip(self.setting.cases, self.parameters, self.exact, strict=True)
        ]

    def tuned(
        self, choose: Callable[[int, np.ndarray, np.ndarray, float], Way | None], draws: int | None = None
    ) -> tuple[list[Way], float] | None:
        """Return the cheapest methods for all experiments' log-likelihoods that are accurate together, and their error.

        `choose` maps the experiment's number, parameters and log-likelihoods at the draws and the allowed error to the
        cheapest method or None. `draws` limits the draws for slow methods. The result is None if an experiment has no
        method.
        """
        at = slice(draws)
        for share in TRIES:
            found = []
            for k, (p, e) in enumerate(zip(self.parameters, self.exact, strict=True)):
                one = choose(k, p[at], e[at], share * self.each)
                if one is None:
                    return None
                found.append(one)
            values = np.array([[one(row) for row in p[at]] for one, p in zip(found, self.parameters, strict=True)])
            error = self.error(self.log_priors[at] + values.sum(axis=0))
            if error <= ALLOWED:
                return found, error
        return found, error

    def error(self, log_posteriors: np.ndarray) -> float:
        """Return the largest error of log-posteriors at the first draws, infinite if one is not finite."""
        off = np.abs(log_posteriors - self.log_posteriors[: len(log_posteriors)])
        return float(off.max()) if np.isfinite(off).all() else np.inf


def refer(setting: Setting) -> Reference:
    """Return the reference of a problem."""
    parameters = [setting.parameters(setting.theta, case) for case in setting.cases]
    found = [exact(case, p) for case, p in zip(setting.cases, parameters, strict=True)]
    reference = Reference(setting, parameters, [values for values, _ in found], sum(off for _, off in found))
    if not reference.uncertainty < 0.1 * ALLOWED:
        raise RuntimeError(f"{setting.name}: the reference is uncertain by {reference.uncertainty:.1e}.")
    return reference
