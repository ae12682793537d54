"""The log-posterior density over sampling coordinates: prior, Jacobian, likelihood, and their derivatives."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaln

from bayesperiodic.density.initial_orbits import simultaneous_fit
from bayesperiodic.density.orbit_check import other_orbit
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.likelihood.likelihood import Residuals
from bayesperiodic.likelihood.noise import FLAT_PRIOR, JEFFREYS, Circulant, Independent
from bayesperiodic.likelihood.observation import Comparisons, Response, Simulation
from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.problem.description import Description

RIDGE_COORDINATES, NATURAL = "ridge", "natural"
SAMPLED, COLLAPSED = "sampled", "collapsed"


class Linearisation:
    """Residuals at one θ (names,) and their Jacobian (de Kraker et al. 1997, eq. 4-5).

    The `jacobian` needs a solver anchored at θ. With `polish` the solves are as accurate as possible;
    without it the residuals are those of `LogPosterior.evaluate`.
    """

    def __init__(self, theta: np.ndarray, solver: ResponseSolver, comparisons: Comparisons, polish: bool = True):
        self.theta, self.solver, self._comparisons, self._polish = theta, solver, comparisons, polish
        self._observations = solver.problem.observations

    @cached_property
    def _simulation(self) -> Simulation:
        return self.solver.solve(self.theta[None], keep=True, polish=self._polish)

    def moved(self, theta: np.ndarray) -> "Linearisation":
        """Return the residuals at another θ (names,), solved from the same anchors."""
        return Linearisation(theta, self.solver, self._comparisons)

    def anchored(self) -> "Linearisation":
        """Return the same with the anchors at its θ."""
        known = self._simulation if self._polish else None
        return Linearisation(self.theta, self.solver.anchored(self.theta, known), self._comparisons)

    @property
    def status(self) -> int:
        """The worst status code of the solves."""
        return int(self._simulation.status[0])

    @property
    def statuses(self) -> dict[str, str]:
        """Status of the solve of each experiment."""
        return {name: STATUSES[int(self._simulation.statuses(name)[0])] for name in self._observations}

    @property
    def beyond(self) -> bool:
        """Whether a branch does not reach the frequency of a point of its table."""
        return bool(self.solver.beyond(self._simulation))

    @property
    def converged(self) -> bool:
        """Whether all solves converged."""
        return self.status == CONVERGED

    @cached_property
    def residuals(self) -> Residuals:
        """Residual components, one array (size,) a block."""
        return self._comparisons.residuals(self._simulation).at(0)

    @cached_property
    def _responses(self) -> dict[str, Response]:
        here = self._simulation.at(0)
        return {name: here.response(name) for name in self._observations}

    @cached_property
    def jacobian(self) -> list[np.ndarray]:
        """Derivatives of the predicted components by θ, one array (names, size) a block; NaN where singular."""
        result = []
        for name, observation in self._observations.items():
            response = self._responses[name]
            directions = self.solver.jacobian(self.theta, name, response, self._simulation.z(name)[0])
            if directions is None:
                result += [np.full((self.theta.size, block.size), np.nan) for block in observation.blocks]
            else:
                result += observation.changes(response, directions)
        return result

    def compared(self) -> dict[str, dict[str, np.ndarray]]:
        """Return y − ŷ (points,) by experiment and channel, within the harmonics kept, and of measured quantities."""
        each = ((name, o, self._responses[name]) for name, o in self._observations.items())
        return {name: o.compared(response) | o.quantities(response) for name, o, response in each}

    def left_out(self) -> dict[str, dict[str, np.ndarray]]:
        """Return measured less predicted amplitudes of harmonics that were left out, by experiment and channel."""
        return {name: o.left_out(self._responses[name]) for name, o in self._observations.items()}

    @cached_property
    def other_orbits(self) -> dict[str, str]:
        """Why the model's orbit is not the measured one, by experiment, see `other_orbit`; without the others."""
        reasons = {name: other_orbit(o, self._responses[name]) for name, o in self._observations.items()}
        return {name: reason for name, reason in reasons.items() if reason}

    def vjp(self, by_residual: Sequence[np.ndarray], *, adjoint: bool) -> dict[str, np.ndarray]:
        """Return Σ by_residual · ∂residual/∂θ, (names,) by experiment; NaN where the derivatives do not exist.

        `by_residual` has one array (size,) a block. `adjoint` takes one transposed solve an experiment (driven models)
        instead of `jacobian`.
        """
        if adjoint:
            by_response = self._comparisons.vjp(self._simulation, self.residuals.like(by_residual), self.residuals)
            by_theta = self.solver.vjp(self.theta, self._simulation, *by_response)
            return {name: -gradient for name, gradient in by_theta.items()}
        products = (jacobian @ weights for jacobian, weights in zip(self.jacobian, by_residual, strict=True))
        return {name: -np.sum([next(products) for _ in o.blocks], axis=0) for name, o in self._observations.items()}


class Evaluation(NamedTuple):
    """Log-densities at several points."""

    log_prob: np.ndarray  # (points,), −inf where a periodic solve fails or the prior is zero
    moments: np.ndarray  # (points, collapsed), M of eq. (6) of each collapsed variance; NaN where a solve fails
    status: np.ndarray  # int (points,), worst status code of the periodic solves; "converged" where nothing was solved


class SamplingCoordinates:
    """Coordinates of a problem's posterior density.

    A parameter whose prior's support is (0, ∞) is replaced by its logarithm, any other is its own coordinate; the
    logarithms of the free noise parameters follow. `coordinates` "natural" takes no logarithms of parameters,
    `variances` "collapsed" leaves out the variances that can be integrated out in closed form. `labels` are the names
    of the coordinates, those of parameters first, `free` the noise parameters among them, `collapsed` the variances
    that are integrated out.
    """

    def __init__(self, problem: Description, *, coordinates: str = RIDGE_COORDINATES, variances: str = SAMPLED):
        self.problem, self.coordinates = problem, coordinates
        self.logarithmic = problem.logarithmic & (coordinates == RIDGE_COORDINATES)
        self._logarithms = np.flatnonzero(self.logarithmic)
        self.collapsed = collapsible(problem) if variances == COLLAPSED else ()
        self.free = tuple(name for name in problem.free_noise if name not in self.collapsed)
        self.labels = (*problem.names, *self.free)
        self.noise_columns = [problem.noise_names.index(name) for name in self.free]
        fixed = problem.likelihood.fixed
        self._noise = np.array([fixed.get(name, 1.0) for name in problem.noise_names])

    @property
    def dimension(self) -> int:
        """Number of sampling coordinates."""
        return len(self.labels)

    @np.errstate(over="ignore")
    def to_natural(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (…, names) and all noise parameters (…, noise_names) of points; integrated variances are 1."""
        count = len(self.problem.names)
        theta, noise = np.array(points[..., :count]), np.empty((*points.shape[:-1], self._noise.size))
        np.exp(theta, out=theta, where=self.logarithmic)
        noise[...] = self._noise
        noise[..., self.noise_columns] = np.exp(points[..., count:])
        return theta, noise

    def natural_columns(self, column: Callable[[int], np.ndarray]) -> dict[str, Callable[[], np.ndarray | float]]:
        """Return by name what returns the values of `to_natural`, from what returns those of a coordinate."""

        def value(k: int) -> np.ndarray:
            logarithmic = k >= self.logarithmic.size or self.logarithmic[k]
            with np.errstate(over="ignore"):
                return np.asarray(np.exp(column(k)) if logarithmic else column(k))

        fixed = dict(zip(self.problem.noise_names, self._noise, strict=True))
        columns: dict[str, Callable[[], np.ndarray | float]] = {name: partial(float, v) for name, v in fixed.items()}
        return columns | {label: partial(value, k) for k, label in enumerate(self.labels)}

    def from_natural(self, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return coordinates (…, dimension) from θ (…, names) and all noise parameters (…, noise_names)."""
        points = np.log(theta, out=np.array(theta), where=self.logarithmic)
        return np.concatenate([points, np.log(noise[..., self.noise_columns])], axis=-1)


class LogPosterior(SamplingCoordinates):
    """Log-posterior density over the sampling coordinates of a problem, the Jacobian determinant included.

    Its value depends on the point alone: periodic solves start from the fixed anchors of the solver.
    """

    def __init__(
        self,
        problem: Description,
        solver: ResponseSolver,
        *,
        coordinates: str = RIDGE_COORDINATES,
        variances: str = SAMPLED,
        comparisons: Comparisons | None = None,
    ):
        super().__init__(problem, coordinates=coordinates, variances=variances)
        self.solver = solver
        self.comparisons = comparisons or Comparisons(
            [[problem.observations[e.name] for e in group] for group in solver.groups], problem.observations
        )

    @classmethod
    def start(cls, problem: Description) -> "LogPosterior":
        """Return the density with the problem's anchors, by default near the medians of the priors.

        Where every experiment of a forced model has a guess of its orbit, the anchors are where orbits and parameters
        fit together, see `simultaneous_fit`: at the medians other orbits may be nearer, or none may exist.
        """
        if problem.anchors:
            return cls(problem, ResponseSolver(problem, problem.anchors))
        median = problem.median()
        estimate = simultaneous_fit(problem, median)
        if estimate is not None and estimate.states:
            return cls(problem, ResponseSolver.start(problem, estimate.theta, estimate.states))
        return cls(problem, ResponseSolver.start(problem, median))

    def with_settings(
        self, *, solver: ResponseSolver | None = None, coordinates: str | None = None, variances: str | None = None
    ) -> "LogPosterior":
        """Return the density with other anchors, coordinates or treatment of the variances."""
        return LogPosterior(
            self.problem,
            solver or self.solver,
            coordinates=coordinates or self.coordinates,
            variances=variances or (COLLAPSED if self.collapsed else SAMPLED),
            comparisons=self.comparisons,
        )

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def log_prior(self, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the log-prior density over the coordinates (…,) at θ (…, names) and noise parameters."""
        prior = self.problem.joint_prior.log_prob(theta) + self.problem.likelihood.log_prior(noise)
        if self._logarithms.size:
            prior = prior + np.log(theta[..., self._logarithms]).sum(axis=-1)
        return np.asarray(prior)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def add_prior(
        self, theta: np.ndarray, gradient: np.ndarray, curvature: np.ndarray | None = None
    ) -> tuple[np.ndarray, Any]:
        """Add the derivatives of the log-prior over the coordinates to those of the log-likelihood at θ (names,).

        They are the gradient (names,) and, if it is given, minus the Hessian (names, names).
        """
        logs, prior = self._logarithms, self.problem.joint_prior
        # Callers check that both are finite.
        gradient = gradient + prior.gradient(theta)
        if logs.size:
            gradient[logs] += 1.0 / theta[logs]
        if curvature is not None:
            curvature = curvature + prior.curvature(theta)
            curvature[logs, logs] += theta[logs] ** -2
        return gradient, curvature

    def log_likelihood(self, theta: np.ndarray, noise: np.ndarray, threads: int | None = None) -> Evaluation:
        """Return log-likelihoods at θ (points, names) and noise (points, noise_names), see `collapsed`.

        The values do not depend on the number of threads, by default one per core.
        """
        simulation = self.solver.solve(theta, threads, whole=True)
        status, good = simulation.status, simulation.status == CONVERGED
        if not (count := np.count_nonzero(good)):
            return self._nothing(status)
        if count < good.size:
            simulation, noise = simulation.at(good), noise[good]
        residuals, likelihood = self.comparisons.residuals(simulation, threads), self.problem.likelihood
        if self.collapsed:
            by_name = likelihood.moments(residuals)
            moments = np.stack([by_name[name] for name in self.collapsed], axis=-1)
            # Of these blocks the integral contains all that depends on the residuals; what is left is ln|S|.
            values = likelihood(residuals.without(self._integrated), noise) + np.sum(self._integrals(moments), axis=-1)
            values = np.where(np.isfinite(values), values, -np.inf)
        else:
            values, moments = likelihood(residuals, noise), np.empty((count, 0))
        return Evaluation(_placed(values, good, -np.inf), _placed(moments, good, np.nan), status)

    def _nothing(self, status: np.ndarray) -> Evaluation:
        """Return the evaluation of points that all have the density zero."""
        return Evaluation(np.full(len(status), -np.inf), np.full((len(status), len(self.collapsed)), np.nan), status)

    def at(self, theta: np.ndarray, noise: np.ndarray, threads: int | None = None) -> Evaluation:
        """Return the log-density over the coordinates at natural values; arguments as in `log_likelihood`."""
        prior = self.log_prior(theta, noise)
        inside = np.isfinite(prior)
        if not (count := np.count_nonzero(inside)):
            return self._nothing(np.full(len(theta), CONVERGED))
        if count < inside.size:
            theta, noise, prior = theta[inside], noise[inside], prior[inside]
        likelihood, moments, status = self.log_likelihood(theta, noise, threads)
        log_prob, moments = _placed(prior + likelihood, inside, -np.inf), _placed(moments, inside, np.nan)
        return Evaluation(log_prob, moments, _placed(status, inside, CONVERGED))

    def evaluate(self, points: np.ndarray, threads: int | None = 1) -> Evaluation:
        """Return the log-density at points (points, dimension), by default in one thread."""
        return self.at(*self.to_natural(points), threads)

    def value_and_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray, int]:
        """Return the log-density at one point (dimension,), its gradient, and the status code.

        Variances are not integrated out. The value is −inf and the gradient zero where a solve fails or a derivative
        does not exist (status "singular").
        """
        theta, noise = self.to_natural(point)
        value, by_theta, by_noise, status = self.value_and_gradient_at(theta, noise)
        if np.isfinite(value):  # else θ may be infinite
            by_theta[self.logarithmic] *= theta[self.logarithmic]
        return value, np.concatenate([by_theta, by_noise[self.noise_columns]]), status

    def value_and_gradient_at(
        self, theta: np.ndarray, noise: np.ndarray, *, forward: bool = False
    ) -> tuple[float, np.ndarray, np.ndarray, int]:
        """Return the log-density at θ (names,) and noise, its gradients by θ and ln φ, and the status code.

        A driven model takes one periodic solve and one transposed solve an experiment; with `forward`, or if the model
        is autonomous, one solve a parameter.
        """
        zeros = np.zeros(theta.size), np.zeros(noise.size)
        prior = float(self.log_prior(theta, noise))
        if not np.isfinite(prior):
            return -np.inf, *zeros, CONVERGED
        forward = forward or self.problem.forward
        here = Linearisation(theta, self.solver, self.comparisons, polish=forward)
        if not here.converged:
            return -np.inf, *zeros, here.status
        value, by_residual, by_noise = self.problem.likelihood.value_and_gradients(here.residuals, noise)
        if not np.isfinite(value):
            return -np.inf, *zeros, CONVERGED
        forward |= here.beyond
        if forward or any(o.multipliers for o in self.problem.observations.values()):
            here = here.anchored()
        by_theta = np.add.reduce(list(here.vjp(by_residual, adjoint=not forward).values()))
        by_theta, _ = self.add_prior(theta, by_theta)
        if not (np.isfinite(by_theta).all() and np.isfinite(by_noise).all()):
            return -np.inf, *zeros, SINGULAR
        return prior + value, by_theta, by_noise, CONVERGED

    def linearise(self, theta: np.ndarray) -> Linearisation:
        """Solve at one θ (names,) from the present anchors, and return residuals and Jacobian there."""
        return Linearisation(theta, self.solver.anchored(theta), self.comparisons)

    def objective(
        self,
        here: Linearisation,
        noise: np.ndarray,
        log_variance_factor: float | np.ndarray,
        *,
        of_total: bool = False,
    ) -> float:
        """Return the log-density over the coordinates where all solves have converged.

        For `log_variance_factor` see `Likelihood.__call__`, for `of_total` `Likelihood.log_prior`.
        """
        prior = self.problem.joint_prior.log_prob(here.theta) + np.sum(np.log(here.theta[self.logarithmic]))
        likelihood = self.problem.likelihood
        return float(
            (likelihood(here.residuals, noise, log_variance_factor) + likelihood.log_prior(noise, of_total=of_total))
            + prior
        )

    def outputs(self, theta: np.ndarray) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
        """Return the predicted outputs at θ (draws, names) and whether the solves converged, see `Problem.outputs`."""
        simulation = self.solver.solve(theta)
        predicted = {name: o.predicted(simulation.response(name)) for name, o in self.problem.observations.items()}
        return predicted, simulation.status == CONVERGED

    def _integrals(self, moments: np.ndarray) -> np.ndarray:
        """Return ln ∫ exp(−½ [n ln v + M/v]) p(v) dv of each collapsed variance."""
        with np.errstate(divide="ignore"):
            return gammaln(self._shapes) - self._shapes * np.log(0.5 * moments)

    @cached_property
    def _integrated(self) -> list[int]:
        """Indices of the blocks whose variances are integrated out."""
        return [b for names, members in self.problem.likelihood.groups() if names[0] in self.collapsed for b in members]

    @cached_property
    def _shapes(self) -> np.ndarray:
        """Shape parameters of the inverse-gamma distributions of the collapsed variances."""
        counts = np.array([self.problem.likelihood.counts[name] for name in self.collapsed])
        return 0.5 * counts - (1.0 if self.problem.noise.prior == FLAT_PRIOR else 0.0)

    def with_variances(
        self, points: Any, log_prob: np.ndarray, moments: np.ndarray, generator: np.random.Generator
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Draw the collapsed variances of points (…, dimension) from their conditional distribution.

        It is InvGamma(n/2, M/2), with the flat prior InvGamma(n/2 − 1, M/2). What is returned are the coordinates (…,)
        of the density with all variances.
        """
        precisions = generator.gamma(self._shapes, size=moments.shape)  # in units of 2/M
        logarithms = np.log(precisions)
        log_prob = log_prob + np.sum(self._shapes * logarithms - precisions - gammaln(self._shapes), axis=-1)
        variances = np.log(0.5 * moments) - logarithms
        count = len(self.problem.names)
        columns = {name: points[..., count + i] for i, name in enumerate(self.free)}
        columns |= {name: variances[..., i] for i, name in enumerate(self.collapsed)}
        return [points[..., k] for k in range(count)] + [columns[name] for name in self.problem.free_noise], log_prob


def _placed(values: np.ndarray, where: np.ndarray, outside: float) -> np.ndarray:
    """Return values (count, …) at the true places of a mask (points,), and another value elsewhere."""
    if len(values) == where.size:
        return values
    result = np.full((where.size, *values.shape[1:]), outside, dtype=values.dtype)
    result[where] = values
    return result


def collapsible(problem: Description) -> tuple[str, ...]:
    """Return the free variances that can be integrated out in closed form, those with the prior 1/v or a flat one.

    The errors must be independent, or of whole periods with a spectrum of known shape, and the inputs exact.
    """
    if problem.likelihood.shared:
        return ()
    noise, counts = problem.noise, problem.likelihood.counts
    shaped = isinstance(noise, Circulant) and all(b.spectral or not b.counted for b in problem.likelihood.blocks)
    closed = (isinstance(noise, Independent) or shaped) and noise.prior in (JEFFREYS, FLAT_PRIOR)
    known = all(name in counts for name in problem.free_noise)
    return tuple(name for name in problem.free_noise if closed and name in counts and (known or not shaped))
