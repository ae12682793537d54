"""Time integration and shooting of one experiment, with the cheapest settings of sufficient accuracy.

The reference of a problem is its log-posterior at the draws by fully converged shooting with small steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from studies.benchmark.problems import Case, Setting
from studies.timing import timed

STEADY, SHOOTING = "Runge-Kutta until steady", "shooting"
EQUILIBRIUM, ESTIMATE, PREDICTED = "from equilibrium", "from the estimate's orbit", "from the predicted orbit"
STARTS = (EQUILIBRIUM, ESTIMATE, PREDICTED)
STEPS = (
    20, 25, 32, 40, 50, 64, 80, 100, 128, 160, 200, 256, 320, 400, 512, 640, 800, 1000, 1280, 1600, 2000, 2560, 3200,
    4000, 5120, 6400, 8000, 10_240, 12_800, 16_000, 20_480, 25_600, 32_000, 40_960, 51_200,
)  # fmt: skip
TOLERANCES = tuple(10.0**-k for k in range(1, 13))
REFERENCE_STEPS = 12_800, 25_600, 51_200, 102_400, 204_800
REFERENCE_TOLERANCE, REFERENCE_ERROR = 1e-10, 1e-5
MOST = 30
TIGHT, LOOSE = 1e-11, 1e-9
ALLOWED = 1e-2
# Fractions of the allowed error per experiment that are tried, because errors may add up.
TRIES = (1.0, 0.5, 0.25, 0.1)
# Fraction of the allowed error that the step size may use; the approach to the steady state may use the rest.
SHARE = 0.5
# Points of a period between which other packages interpolate the inputs.
TABLE = 16_384
# Cycles of other packages that are timed; the others cost about the same.
TIMED_CYCLES = 2


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
        """Path, its rates, both with derivatives by y(0) and p; states, outputs and changes by p at the samples."""
        case, rows = self.case, self.steps + 1
        size, count, samples = case.start.size, len(case.moving), case.experiment.samples
        shapes = [(rows, size)] * 2 + [(rows, size, size + count)] * 2
        shapes += [(samples, size), (samples, len(case.model.outputs)), (samples, size * count)]
        return tuple(np.empty(shape) for shape in shapes)

    @cached_property
    def anchor(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """y(0), (I − Φ)⁻¹ and dy(0)/dp at the estimate; None if shooting does not converge."""
        if not any(self._newton(self.case.estimate, self.case.first, tolerance) for tolerance in (TIGHT, LOOSE)):
            return None
        last, size = self._buffers[2][-1], self.case.start.size
        inverse = np.linalg.inv(np.eye(size) - last[:, :size])
        return self.orbit, inverse, inverse @ last[:, size:]

    def _newton(self, p: np.ndarray, start: np.ndarray, tolerance: float, most: int = MOST) -> int:
        case = self.case
        return case.compiled.newton(
            p, self._inputs, case.period, start.copy(), case.scale, tolerance, most, *self._buffers[:4]
        )

    def start(self, p: np.ndarray, kind: str) -> np.ndarray:
        """Return the start y(0)."""
        if kind == EQUILIBRIUM:
            return self.case.start.copy()
        assert self.anchor is not None
        y, _, slopes = self.anchor
        return y.copy() if kind == ESTIMATE else y + slopes @ (p[self.columns] - self.case.estimate[self.columns])

    @cached_property
    def columns(self) -> list[int]:
        """Indices of the moving parameters in p."""
        return [list(self.case.model.parameters).index(name) for name in self.case.moving]

    def settle(self, p: np.ndarray, kind: str, tolerance: float) -> int:
        """Integrate until steady; return the number of cycles, 0 for never."""
        case = self.case
        return case.compiled.steady(
            p, self._inputs, case.period, self.start(p, kind), case.scale, tolerance, *self._buffers[:2]
        )

    def shoot(self, p: np.ndarray, kind: str, tolerance: float) -> int:
        """Shoot, from an orbit with the matrix of the estimate; return the number of sweeps, 0 for failure."""
        case = self.case
        if kind == EQUILIBRIUM:
            return self._newton(p, case.start, tolerance)
        assert self.anchor is not None
        start, inverse = self.start(p, kind), self.anchor[1]
        return case.compiled.chord(
            p, self._inputs, case.period, start, inverse, case.scale, tolerance, MOST, *self._buffers[:2]
        )

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
        case, size = self.case, self.case.start.size
        _, _, wide, wide_rates, states, _, changes = self._buffers
        self.shoot(p, PREDICTED, tolerance)
        self._newton(p, self.orbit, np.inf, 1)
        outputs, last = self._outputs(p), wide[-1]
        slopes = np.linalg.solve(np.eye(size) - last[:, :size], last[:, size:])
        by_p, rates = (
            (part[:, :, size:] + part[:, :, :size] @ slopes).reshape(len(wide), -1) for part in (wide, wide_rates)
        )
        case.compiled.dense(by_p, rates, case.period / self.steps, changes)
        gradient = np.empty(len(case.moving))
        case.compiled.pulled(p, case.signals, states, changes, case.weighted_residuals(outputs), gradient)
        return case.log_likelihood(outputs), gradient @ case.slopes


@dataclass(frozen=True)
class Method:
    """A compiled method for the log-likelihood of one experiment."""

    discretised: Discretised
    setting: float  # Tolerance of the last change of y(0), relative to the scale of y
    kind: str = SHOOTING  # Or `STEADY`
    start: str = PREDICTED  # One of `STARTS`

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood; NaN where no orbit is found."""
        return self.discretised.log_likelihood(p) if self.run(p) else np.nan

    def run(self, p: np.ndarray) -> int:
        """Return the number of cycles integrated, 0 for failure."""
        run = self.discretised.settle if self.kind == STEADY else self.discretised.shoot
        return run(p, self.start, self.setting)

    def cycles(self, parameters: np.ndarray) -> float:
        """Return the mean number of cycles at the draws."""
        return float(np.mean([self.run(p) for p in parameters]))


@dataclass(frozen=True)
class Peer:
    """A method of another package on one experiment."""

    discretised: Discretised  # Source of the starts
    setting: Any  # Tolerance or number of harmonics

    @property
    def case(self) -> Case:
        """The experiment."""
        return self.discretised.case

    @cached_property
    def table(self) -> np.ndarray:
        """The inputs."""
        return self.case.table(TABLE)

    def prepared(self, p: np.ndarray, start: np.ndarray) -> Callable[[], Any]:
        """Return the integration through `TIMED_CYCLES` cycles."""
        raise NotImplementedError

    def seconds(self, p: np.ndarray, start: str, count: float) -> float:
        """Return the seconds until steady, scaled from a few cycles to the number needed."""
        _, seconds = timed(self.prepared(p, self.discretised.start(p, start)))
        return seconds * max(count, 1.0) / TIMED_CYCLES


def exact(case: Case, parameters: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the log-likelihood at draws by shooting with small steps, and its change when the steps are doubled."""
    coarse = np.full(len(parameters), np.nan)
    for steps in REFERENCE_STEPS:
        method = Method(Discretised(case, steps), REFERENCE_TOLERANCE)
        fine = np.array([method(p) for p in parameters])
        off = float(np.max(np.abs(fine - coarse)))
        if off < REFERENCE_ERROR:
            break
        coarse = fine
    return fine, off


def loosest(
    make: Callable[[Any], Any], settings: Sequence[Any], parameters: np.ndarray, exact: np.ndarray, allowed: float
) -> Any:
    """Return the method with the first of the settings that is accurate enough at the draws, None if there is none.

    A method is called with p and returns the log-likelihood, NaN where it fails.
    """
    for one in settings:
        found = make(one)
        if all(abs(found(p) - e) <= allowed for p, e in zip(parameters, exact, strict=True)):
            return found
    return None


def discretise(case: Case, parameters: np.ndarray, exact: np.ndarray, allowed: float) -> Discretised:
    """Return the experiment with the fewest steps that keep the error at all draws within the limit."""
    for steps in STEPS:
        one = Discretised(case, steps)
        if one.anchor is not None and loosest(partial(Method, one), (TIGHT, LOOSE), parameters, exact, allowed):
            return one
    raise RuntimeError(f"{case.experiment.name}: {STEPS[-1]} steps are not as accurate as {allowed:.1e}.")


@dataclass(frozen=True)
class Reference:
    """Reference of all methods."""

    setting: Setting
    parameters: list[np.ndarray]  # (draws, parameters + 1), one per experiment
    exact: list[np.ndarray]  # Log-likelihoods (draws,), one per experiment
    uncertainty: float  # Change of a log-posterior with steps twice as long

    @property
    def each(self) -> float:
        """Allowed error per experiment, so that errors of either sign add up to the total allowed."""
        return ALLOWED / np.sqrt(len(self.exact))

    @cached_property
    def log_priors(self) -> np.ndarray:
        """Log-priors at the draws."""
        return np.array([self.setting.log_prior(theta) for theta in self.setting.theta])

    @cached_property
    def discretised(self) -> list[Discretised]:
        """Every experiment with the fewest steps that are accurate enough."""
        allowed = SHARE * self.each
        every = zip(self.setting.cases, self.parameters, self.exact, strict=True)
        return [discretise(case, p, e, allowed) for case, p, e in every]

    def tuned(
        self, make: Callable[[Discretised, Any], Any], settings: Sequence[Any], draws: int | None = None
    ) -> tuple[list[Any], float]:
        """Return the cheapest methods, one per experiment, that are accurate together, and their error.

        `make` returns the method of an experiment with one of the settings, which are in the order of their costs.
        `draws` limits the draws for slow methods. Without a method for each experiment the list is empty.
        """
        at = slice(draws)
        for share in TRIES:
            found: list[Any] = []
            for one, p, e in zip(self.discretised, self.parameters, self.exact, strict=True):
                found.append(loosest(partial(make, one), settings, p[at], e[at], share * self.each))
                if found[-1] is None:
                    return [], np.inf
            values = np.array([[one(row) for row in p[at]] for one, p in zip(found, self.parameters, strict=True)])
            error = self.error(self.log_priors[at] + values.sum(axis=0))
            if error <= ALLOWED:
                break
        return found, error

    def error(self, log_posteriors: np.ndarray) -> float:
        """Return the largest error of log-posteriors at the first draws, infinite if one is not finite."""
        off = np.abs(log_posteriors - (self.log_priors + np.sum(self.exact, axis=0))[: len(log_posteriors)])
        return float(off.max()) if np.isfinite(off).all() else np.inf


def refer(setting: Setting) -> Reference:
    """Return the reference of a problem."""
    parameters = [setting.parameters(setting.theta, case) for case in setting.cases]
    found = [exact(case, p) for case, p in zip(setting.cases, parameters, strict=True)]
    reference = Reference(setting, parameters, [values for values, _ in found], sum(off for _, off in found))
    if not reference.uncertainty < 0.1 * ALLOWED:
        raise RuntimeError(f"{setting.name}: the reference is uncertain by {reference.uncertainty:.1e}.")
    return reference
