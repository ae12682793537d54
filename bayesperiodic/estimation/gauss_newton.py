"""Staged Gauss-Newton iteration: noise parameters from the residuals, then a step in θ (eq. 7-8)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bayesperiodic._linalg import hessian_eigh, hessian_scale, scaled
from bayesperiodic.density.log_posterior import Linearisation, LogPosterior
from bayesperiodic.estimation.noise_changes import changes_by_variance
from bayesperiodic.likelihood.noise_estimate import estimate_noise
from bayesperiodic.problem.description import Description

MAX_STEPS = 100
MAX_STEP_HALVINGS = 30
# Largest factor by which a step changes a parameter.
LARGEST_FACTOR = 100.0
SCALED_STEP = 1e-8
CONVERGED_STEP, SMALL_GAIN = 1e-4, 1e-12
# A step that gains less than the rounding errors of the objective, which are up to 1e-7 [standard deviations].
NEGLIGIBLE_STEP = 1e-3
NO_CURVATURE = 1e-13
MAX_ROUNDS, PRESSED, LONGEST_MOVE = 10, 1e-3, 3.0
LOST_PART = 1e-6
# Part of the prior's variance that is left of a parameter on which the data say nothing.
UNINFORMED = 0.9
# Residuals whose sum of squares is no finite number.
OVERFLOWS = 1e150
# Change of the factors that ends the correction, and the largest part of its values that parameters may take up.
SETTLED_FACTOR, MOST_TAKEN = 1e-6, 0.99
# Status of a climb that was ended by what it reports to.
CLIMB_ENDED = "ended"


@dataclass(frozen=True)
class Iterate:
    """State of the iteration: θ, residuals and Jacobians there, their best noise parameters, and the objective."""

    theta: np.ndarray
    here: Linearisation
    noise: np.ndarray
    objective: float


# Called for every new iterate with it and the step [standard deviations]; True ends the climb.
Report = Callable[[Iterate, float], bool] | None


class End(NamedTuple):
    """End of an iteration, its status, as in `MapEstimate`, and the objective at each iterate."""

    iterate: Iterate
    status: str
    history: np.ndarray


def preference(end: End) -> tuple[int, float]:
    """Return the key of the end to choose: on as few orbits other than the measured ones as possible, and highest."""
    return -len(end.iterate.here.other_orbits), end.iterate.objective


@dataclass(frozen=True)
class Objective:
    """Density that the iteration maximises over θ, with the best noise parameters at every θ.

    The logarithms of the variances are multiplied by `log_variance_factor`, one or (blocks,): their best values are
    those of eq. (6) for 1, and those of eq. (7) for `bias_correction`. With `of_total` the density is over coordinates
    of the noise in which a model error beside known noise may be zero, see `Likelihood.log_prior`.
    """

    density: LogPosterior
    log_variance_factor: float | np.ndarray = 1.0
    of_total: bool = False

    def at(self, theta: np.ndarray, near: Linearisation, noise: np.ndarray) -> Iterate | None:
        """Return the iterate at θ, solved from the anchors of a near one; None if the log-posterior is not finite."""
        if not np.isfinite(self.density.problem.joint_prior.log_prob(theta)):
            return None
        return self.iterate(near.moved(theta), noise)

    def iterate(self, here: Linearisation, noise: np.ndarray, *, all_shapes: bool = False) -> Iterate | None:
        """Return the iterate of solved residuals; None if the log-posterior is not finite.

        The noise parameters are the best ones near `noise`, with `all_shapes` those of `estimate_noise`.
        """
        if not here.converged or not all(np.abs(r).max(initial=0.0) < OVERFLOWS for r in here.residuals):
            return None
        likelihood, factor = self.density.problem.likelihood, self.log_variance_factor
        noise = estimate_noise(likelihood, here.residuals, noise, factor, of_total=self.of_total, all_shapes=all_shapes)
        value = self.density.objective(here, noise, factor, of_total=self.of_total)
        return Iterate(here.theta, here, noise, value) if np.isfinite(value) else None

    def anchored(self, iterate: Iterate) -> Iterate:
        """Return the iterate with the solves anchored at it."""
        return replace(iterate, here=iterate.here.anchored())

    def moved(self, theta: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return θ after a step; parameters whose density is over the logarithm change by a factor.

        A step along the ridge of a product, which is straight in logarithms, stays on the ridge.
        """
        result, logs = theta + step, self.density.logarithmic
        with np.errstate(over="ignore"):
            result[logs] = theta[logs] * np.exp(step[logs] / theta[logs])
        return result

    def longest(self, theta: np.ndarray, step: np.ndarray) -> float:
        """Return the part of a step, at most 1, that changes parameters by no more than a factor `LARGEST_FACTOR`.

        These are the parameters whose density is over the logarithm. Solves with absurd values cost most.
        """
        logs = self.density.logarithmic
        change = np.max(np.abs(step[logs] / theta[logs]), initial=0.0)
        return float(min(1.0, np.log(LARGEST_FACTOR) / change)) if change > 0.0 else 1.0

    def hessian_and_gradient(self, iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
        """Return H of eq. (8) and the gradient of the objective, the prior's part included in both."""
        hessian, gradient = information(self.density.problem, iterate)
        gradient, hessian = self.density.add_prior(iterate.theta, gradient, hessian)
        return hessian, gradient


def information(problem: Description, iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
    """Return the data's part of H of eq. (8), (names, names), and of its gradient, (names,)."""
    changes = np.concatenate(problem.likelihood.whitened(iterate.here.jacobian, iterate.noise), axis=1)
    residuals = np.concatenate(problem.likelihood.whitened(iterate.here.residuals, iterate.noise))
    return changes @ changes.T, changes @ residuals


def inverse_hessian(hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse of H without its directions of no curvature, and which parameters belong to these.

    They are all parameters where H is not finite.
    """
    if not np.isfinite(hessian).all():
        return np.zeros(hessian.shape), np.ones(len(hessian), dtype=bool)
    values, vectors, scale = hessian_eigh(hessian)
    curved = np.abs(values) > NO_CURVATURE * np.abs(values).max()
    inverse = scaled((vectors[:, curved] / values[curved]) @ vectors[:, curved].T, scale)
    return inverse, np.any(np.abs(vectors[:, ~curved]) > LOST_PART, axis=1)


def bias_correction(problem: Description, iterate: Iterate) -> np.ndarray:
    """Return 1 − p/n of each block's variance (blocks,), for which the variances are those of eq. (7).

    Of the n values behind a variance the estimate of θ takes up p = tr(F C), with F their part of the information and
    C the inverse of H of eq. (8). Without priors the p of all variances sum to the number of parameters l; they are
    l/s each, as in eq. (7), where all s channels tell the same. The maximum over the variances is then that of the
    density with θ integrated out (D. A. Harville, J. Am. Statist. Assoc. 72 (1977) 320-338). Values whose variance is
    in part known count for both by the other part, see `NoiseChange`.
    """
    likelihood = problem.likelihood
    result = np.ones(len(likelihood.blocks))
    hessian = information(problem, iterate)[0] + problem.joint_prior.curvature(iterate.theta)
    if not np.isfinite(hessian).all():
        return result
    inverse, _ = inverse_hessian(hessian)
    changes = changes_by_variance(problem, iterate.here.jacobian, iterate.noise, least=0.0)
    for group, members in likelihood.groups():
        if (change := changes.get(group[0])) is not None and change.trace > 0.0:
            taken = float(np.sum(change.information * inverse)) / change.trace
            result[members] = 1.0 - np.clip(taken, 0.0, MOST_TAKEN)
    return result


def corrected(objective: Objective, end: End, report: Report = None) -> tuple[Objective, End]:
    """Climb again from the end of a climb with `bias_correction` at each new end, until its factors settle.

    Returns the last objective and end.
    """
    for _ in range(MAX_ROUNDS):
        factor = bias_correction(objective.density.problem, end.iterate)
        if np.all(np.abs(factor - objective.log_variance_factor) < SETTLED_FACTOR):
            break
        other = replace(objective, log_variance_factor=factor)
        again = resumed(other, end, report)
        if again is None:
            break
        objective, end = other, again
    return objective, end


def resumed(objective: Objective, end: End, report: Report = None, most: int = MAX_STEPS) -> End | None:
    """Climb on from the end of a climb with another objective; None if that is not finite there.

    Noise that is best near the end may be far from the best one: shapes of its spectrum are tried from all of their
    priors. Earlier values in the history are shifted so that it goes on where the objective changes.
    """
    start = objective.iterate(end.iterate.here, end.iterate.noise, all_shapes=True)
    if start is None:
        return None
    now, status, more = climb(objective, start, report=report, most=most)
    return End(now, status, np.concatenate([end.history + (start.objective - end.history[-1]), more[1:]]))


def climb(
    objective: Objective, start: Iterate, held: np.ndarray | None = None, report: Report = None,
    most: int = MAX_STEPS, halvings: int = MAX_STEP_HALVINGS,
) -> End:  # fmt: skip
    """Increase the objective from an anchored start until the steps are small, at most so many steps in a row.

    Where H is not positive definite (convex log-priors that outweigh the data) steps take its negative curvature with
    the opposite sign; directions without curvature are left out. Each solve starts from the previous iterate and is
    checked to lie on the same branch, so that a step cannot change to another periodic solution. A step whose solve
    fails is halved, `halvings` times at most. A parameter at the end of its prior's support is fixed while the gradient
    points outwards. Parameters `held` (names,) are fixed.
    """
    always = np.zeros(start.theta.size, dtype=bool) if held is None else held
    now, resting, history = start, always, [start.objective]
    for _ in range(MAX_ROUNDS):
        now, status, objectives = _ascend(objective, now, resting, report, most, halvings)
        history += objectives
        if status == CLIMB_ENDED:
            break
        ends = at_ends(objective, now)
        inwards = ends * objective.hessian_and_gradient(now)[1] < 0.0
        wanted = always | (ends != 0.0 if status == "stalled" else resting & ~inwards)
        if np.array_equal(wanted, resting):
            break
        resting = wanted
    return End(now, status, np.array(history))


def prior_only(problem: Description, theta: np.ndarray, hessian: np.ndarray) -> np.ndarray:
    """Return which parameters have the variance of the prior at θ, bool (names,); H of eq. (8) is (names, names).

    Priors without curvature at θ, such as uniform ones, have no variance to compare with.
    """
    curvature = problem.joint_prior.curvature(theta)
    curved = np.flatnonzero(np.diag(curvature) > 0.0)
    result = np.zeros(theta.size, dtype=bool)
    if curved.size and np.isfinite(hessian).all():
        inverse, lost = inverse_hessian(hessian)
        prior, _ = inverse_hessian(curvature[np.ix_(curved, curved)])
        result[curved] = (np.diag(inverse)[curved] > UNINFORMED * np.diag(prior)) & ~lost[curved]
    return result


def at_ends(objective: Objective, iterate: Iterate) -> np.ndarray:
    """Return −1 or 1 for parameters next to the lower or upper end of their support, 0 for others, (names,)."""
    hessian, _ = objective.hessian_and_gradient(iterate)
    low, high = np.transpose(list(objective.density.problem.joint_prior.supports.values()))
    near = PRESSED * np.minimum(hessian_scale(hessian), objective.density.problem.joint_prior.widths)
    return 1.0 * (high - iterate.theta < near) - (iterate.theta - low < near)


def _ascend(
    objective: Objective, start: Iterate, held: np.ndarray, report: Report, most: int, halvings: int
) -> tuple[Iterate, str, list[float]]:
    """Climb with the same parameters fixed; return the end, the status, and the objectives of all steps."""
    now = start
    history: list[float] = []
    for _ in range(most):
        hessian, gradient = objective.hessian_and_gradient(now)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            return now, "singular", history
        step, size = _step(_curved(objective, now, hessian), gradient, held)
        if size < SCALED_STEP:
            return now, "converged", history
        damping, trial = objective.longest(now.theta, step), None
        for _ in range(halvings):
            trial = objective.at(objective.moved(now.theta, damping * step), now.here, now.noise)
            if trial is not None and trial.objective > now.objective:
                break
            damping, trial = 0.5 * damping, None
            if size < CONVERGED_STEP:
                return now, "converged", history
        if trial is None:
            return now, "converged" if size < NEGLIGIBLE_STEP else "stalled", history
        gain, now = trial.objective - now.objective, objective.anchored(trial)
        history.append(now.objective)
        if report is not None and report(now, damping * size):
            return now, CLIMB_ENDED, history
        if size < CONVERGED_STEP and gain < SMALL_GAIN:
            return now, "converged", history
    return now, "iterations", history


def _curved(objective: Objective, iterate: Iterate, hessian: np.ndarray) -> np.ndarray:
    """Return H, with the curvature of a wide normal prior for parameters that have less.

    Without curvature (a log-normal prior has none at one point) a step would be left out or lead far away. The sd of
    this prior is three widths of the parameter's own prior, or the distance to its median.
    """
    prior = objective.density.problem.joint_prior
    longest = np.maximum(LONGEST_MOVE * prior.widths, np.abs(iterate.theta - prior.median()))
    weak = np.abs(np.diag(hessian)) * longest**2 < 1.0
    return np.where(np.diag(weak), np.diag(longest**-2.0), hessian) if weak.any() else hessian


def _step(hessian: np.ndarray, gradient: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the step uphill and its length in standard deviations, √(step·H·step), all directions together."""
    moving = np.flatnonzero(~held)
    step = np.zeros_like(gradient)
    if not moving.size:
        return step, 0.0
    values, vectors, scale = hessian_eigh(hessian[np.ix_(moving, moving)])
    values = np.abs(values)
    along, curved = vectors.T @ (scale * gradient[moving]), values > NO_CURVATURE * values.max()
    along = np.where(curved, along / np.where(curved, values, 1.0), 0.0)
    step[moving] = scale * (vectors @ along)
    return step, float(np.sqrt(np.sum(values * along**2)))
