"""The Laplace approximation over all sampling coordinates together, from the exact Hessian."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from bayesperiodic.inference.estimation.gauss_newton import SINGULAR, Iterate, Objective, climb
from bayesperiodic.inference.linearisation import Linearisation
from bayesperiodic.inference.problem import Problem

STEP = 1e-3
NOISE_STEP = 1e-4


@dataclass(frozen=True)
class JointLaplace:
    """The mode of the density in sampling coordinates and the inverse of its exact Hessian.

    Attributes
    ----------
    mode : dict of str to float
        Natural values of the parameters and of the free noise parameters.
    covariance : DataFrame (coordinates × coordinates)
        Of the sampling coordinates, by the names of what they are made of: the logarithm of a parameter whose prior's
        support is (0, ∞) and of every noise parameter, any other parameter itself. NaN where there is no maximum.
    """

    mode: dict[str, float]
    covariance: pd.DataFrame


def logarithmic(problem: Problem) -> np.ndarray:
    """Return which parameters are sampled in their logarithm, (names,)."""
    return np.array([support == (0.0, np.inf) for support in problem.joint_prior.supports.values()])


def joint_laplace(problem: Problem, start: Iterate) -> JointLaplace:
    """Climb from the estimate to the mode in sampling coordinates and take the exact Hessian there.

    The Hessian over θ comes from central differences of the exact gradient; parameters local to experiments are moved
    together, because each experiment knows only its own.
    """
    objective = Objective(problem, 1.0, logarithmic(problem))
    first = objective.at(start.theta, start.here, start.noise)
    labels = [*problem.names, *problem.free_noise]
    nothing = pd.DataFrame(np.full((len(labels), len(labels)), np.nan), index=labels, columns=labels)
    if first is None:
        return JointLaplace({}, nothing)
    mode, _, _ = climb(objective, objective.anchored(first))
    free = [problem.noise_names.index(name) for name in problem.free_noise]
    values = [*mode.theta.tolist(), *mode.noise[free].tolist()]
    hessian = _hessian(problem, objective, mode, free)
    if not np.isfinite(hessian).all() or not np.all(np.diag(hessian) > 0.0):
        return JointLaplace(dict(zip(labels, values, strict=True)), nothing)
    scale = 1.0 / np.sqrt(np.diag(hessian))
    curvatures, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    if curvatures.min() < SINGULAR * curvatures.max():
        return JointLaplace(dict(zip(labels, values, strict=True)), nothing)
    covariance = (vectors / curvatures) @ vectors.T * np.outer(scale, scale)
    return JointLaplace(dict(zip(labels, values, strict=True)), pd.DataFrame(covariance, index=labels, columns=labels))


def _hessian(problem: Problem, objective: Objective, mode: Iterate, free: list[int]) -> np.ndarray:
    """Return −∂² log-density over the sampling coordinates."""
    count, logs = len(problem.names), objective.logarithmic
    by_theta = -_second_derivatives(problem, objective, mode) + problem.joint_prior.curvature(mode.theta)
    gradient = mode.here.forward(problem.likelihood.gradients(mode.here.residuals, mode.noise)[0])
    gradient = gradient + problem.joint_prior.gradient(mode.theta)
    slopes = np.where(logs, mode.theta, 1.0)
    hessian = np.zeros((count + len(free), count + len(free)))
    hessian[:count, :count] = by_theta * np.outer(slopes, slopes) - np.diag(np.where(logs, gradient * mode.theta, 0.0))
    for row, column in enumerate(free):
        changes = []
        for sign in (1.0, -1.0):
            noise = mode.noise.copy()
            noise[column] *= np.exp(sign * NOISE_STEP)
            by_residual, by_noise = problem.likelihood.gradients(mode.here.residuals, noise)
            changes.append(np.concatenate([mode.here.forward(by_residual) * slopes, by_noise[free]]))
        hessian[count + row] = -(changes[0] - changes[1]) / (2.0 * NOISE_STEP)
        hessian[:count, count + row] = hessian[count + row, :count]
    return 0.5 * (hessian + hessian.T)


def _second_derivatives(problem: Problem, objective: Objective, mode: Iterate) -> np.ndarray:
    """Return ∂² log-likelihood/∂θ² at the mode, (names, names)."""
    hessian, _ = objective.hessian_and_gradient(mode)
    sd = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(hessian)), np.finfo(float).tiny))
    result = np.zeros((len(problem.names),) * 2)
    for group in _moved_together(problem):
        ends = []
        for sign in (1.0, -1.0):
            theta = mode.theta.copy()
            theta[list(group.values())] += sign * STEP * sd[list(group.values())]
            ends.append(_gradients(problem, theta, mode))
        for experiment, column in group.items():
            result[:, column] += (ends[0][experiment] - ends[1][experiment]) / (2.0 * STEP * sd[column])
    return 0.5 * (result + result.T)


def _moved_together(problem: Problem) -> list[dict[str, int]]:
    """Return sets of columns of θ of which every experiment knows at most one, by experiment."""
    groups: dict[str, dict[str, int]] = {}
    for experiment, parameter_map in problem.parameter_maps.items():
        for name, column in parameter_map.columns.items():
            groups.setdefault(name, {})[experiment] = column
    return list(groups.values())


def _gradients(problem: Problem, theta: np.ndarray, mode: Iterate) -> dict[str, np.ndarray]:
    """Return each experiment's gradient of the log-likelihood by θ, at the noise parameters of the mode."""
    near = problem.with_responses(mode.here.responses)
    there = (
        near.linearised(theta)
        if problem.model.autonomous
        else Linearisation(theta, mode.here.responses, problem.comparisons)
    )
    if not there.converged:
        return dict.fromkeys(problem.observations, np.full(theta.size, np.nan))
    by_residual = problem.likelihood.gradients(there.residuals, mode.noise)[0]
    return there.by_experiment(by_residual, adjoint=not problem.model.autonomous)
