"""Conflict between prior and data: the prior predictive distribution of the estimate by the data alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc, chdtri, ndtr, ndtri, stdtrit

from bayesperiodic._io import Storable
from bayesperiodic._linalg import column_space
from bayesperiodic.density.log_posterior import RIDGE_COORDINATES, LogPosterior
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.gauss_newton import Iterate, Objective, bias_correction, climb
from bayesperiodic.priors.joint import MultivariateNormal
from bayesperiodic.priors.single import LogNormal, TruncatedNormal
from bayesperiodic.problem.description import written_out

if TYPE_CHECKING:
    import pandas as pd

CONFLICT_LEVEL = 0.01
# Largest error, in widths of the prior, of a direction that is tested: the data have 1 % of the prior's information.
WIDENING = 10.0
# Factor by which the priors are widened where the data estimate alone.
ALMOST_FLAT = 100.0
# Expected gain in 2 ln L by a step without the prior, below which the MAP estimate is that of the data.
LEAST_CONFLICT_GAIN = 0.5
PRECISION = 1e-12
# Widths of the priors of parameters in conflict from which further starts of the estimate by the data are drawn.
START_WIDTHS = (3.0, 10.0, 30.0, 100.0, 30.0, 10.0)
# Midpoints of the normal scores of a prior, and their probabilities.
EDGES = np.linspace(-7.5, 7.5, 241)
SCORES, MASSES = 0.5 * (EDGES[1:] + EDGES[:-1]), np.diff(ndtr(EDGES))
# Of these the densities are compared, to find their maximum.
PEAKS = slice(5, -5, 10)
# Width of each part of a prior, in its spacing, for a density without ripples.
SMOOTHING = 0.75
# Distance in standard deviations at which the exponential function of a normal density is zero in floating point.
VANISHING = 39.0
VARIANCES = (np.arange(32) + 0.5) / 32
INTERVAL_TAILS = np.array([0.05, 0.95])
SMALLEST_PROBABILITY = 1e-300
SHARE = 0.3


@dataclass(frozen=True)
class PriorConflict(Storable):
    """Test of the prior against the estimate by the data alone.

    Attributes
    ----------
    table : DataFrame
        One row per parameter: the 90 % intervals of the data alone (``data_low``, ``data_high``) and of the prior
        (``prior_low``, ``prior_high``), and ``p``, the two-sided probability under the prior of an estimate at least as
        far out; NaN where the data have less than 1 % of the information of the prior.
    joint : float
        p of all parameters jointly, in the directions with at least 1 % of the information of the prior.
    p : float
        The smallest of these, corrected for their number (Bonferroni).
    members : tuple of str
        Parameters that conflict, if p is below 1 %: those whose own p is below 1 %, otherwise those of the direction
        that contributes most.
    """

    table: pd.DataFrame
    joint: float
    p: float
    members: tuple[str, ...]

    @property
    def text(self) -> str:
        """The conflict in words; "" if there is none."""
        if not self.members:
            return ""
        rows = [
            f"{name!r}: the data alone give {row['data_low']:.4g} to {row['data_high']:.4g}, the prior "
            f"{row['prior_low']:.4g} to {row['prior_high']:.4g}"
            for name, row in self.table.loc[[*self.members]].iterrows()
        ]
        p = f"p = {self.p:.2g}" if self.p > 1e-9 else "p < 1e-9"
        return f"Prior and data disagree ({p}; 90 % intervals): {'; '.join(rows)}"


def prior_conflict(problem: Problem, estimate: Iterate) -> tuple[PriorConflict, Iterate]:
    """Test the prior against the data, and return the test and the estimate by the data almost alone.

    Under the prior and the model, linearised at the estimate by the data, this estimate has the distribution of the
    prior convolved with the error of the estimate: for normal priors (θ_L − θ̄)ᵀ (Σ + F⁻¹)⁻¹ (θ_L − θ̄) is χ²
    distributed, F being the information of the data (Box, J. R. Statist. Soc. A 143 (1980) 383-430; Evans and Moshonov,
    Bayesian Analysis 1 (2006) 893-914). Positive parameters are taken by their logarithms. Other priors are convolved
    numerically, parameter by parameter, and their probabilities transformed to normal scores. p is averaged over
    the unknown size of the variances given the residual, which makes it that of Student's t and of F where the prior is
    exact.
    """
    # The estimate by the data may pass points of no meaning.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        alone = _by_the_data(problem, estimate)
        tested = _tested(problem, alone)
        if tested.members:
            # The maximum next to the prior may be a local one.
            alone = max(_from_elsewhere(problem, alone, tested.members), key=lambda iterate: iterate.objective)
            tested = _tested(problem, alone)
        return tested, alone


def _by_the_data(problem: Problem, estimate: Iterate) -> Iterate:
    """Return the estimate with widened priors; the given one if the prior has hardly moved it."""
    logs = problem.logarithmic
    width = np.where(logs, problem.joint_prior.log_widths, problem.joint_prior.widths)
    units = width * np.where(logs, estimate.theta, 1.0)
    changes = units[:, None] * np.concatenate(_white(problem, estimate.here.jacobian, estimate), axis=1)
    residuals = np.concatenate(_white(problem, estimate.here.residuals, estimate))
    if not np.isfinite(changes).all() or not residuals.any():
        return estimate
    basis = column_space(changes)
    rest = residuals - basis @ (basis.T @ residuals)
    # The variance without the misfit that the prior causes.
    freedom = max(residuals.size - basis.shape[1], 1)
    share = rest @ rest / freedom * residuals.size / (residuals @ residuals) if problem.free_noise else 1.0
    changes, residuals = (part / np.sqrt(np.clip(share, PRECISION, 1.0)) for part in (changes, residuals))
    vectors, sizes, components = np.linalg.svd(changes, full_matrices=False)
    along = sizes * (components @ residuals)
    step = vectors @ (along / (sizes**2 + WIDENING**-2))
    if np.sum(along**2 / (sizes**2 + WIDENING**-2)) < LEAST_CONFLICT_GAIN:
        return estimate
    factor = np.where(np.sum(changes**2, axis=1) > WIDENING**-2, np.maximum(ALMOST_FLAT, WIDENING * np.abs(step)), 1.0)
    objective = _almost_flat(problem, estimate, factor)
    first = objective.at(estimate.theta, estimate.here, estimate.noise)
    return estimate if first is None else climb(objective, objective.anchored(first)).iterate


def _from_elsewhere(problem: Problem, alone: Iterate, members: tuple[str, ...]) -> Iterator[Iterate]:
    """Yield the estimate found, and those from draws of the prior, which is widened for parameters in conflict."""
    inside = np.isin(problem.names, members)
    objective = _almost_flat(problem, alone, np.where(inside, ALMOST_FLAT, 1.0))
    factor, of_total = objective.log_variance_factor, objective.of_total
    value = objective.density.objective(alone.here, alone.noise, factor, of_total=of_total)
    yield replace(alone, objective=value)
    generator, median = np.random.default_rng(0), problem.joint_prior.median()
    wide = objective.density.problem.joint_prior
    for scale, theta in zip(START_WIDTHS, problem.joint_prior.sample(len(START_WIDTHS), generator), strict=True):
        factor = scale / ALMOST_FLAT
        drawn = wide.sample(1, generator)[0]
        logs = problem.logarithmic & inside
        theta[inside] = median[inside] + factor * (drawn[inside] - median[inside])
        theta[logs] = median[logs] * (drawn[logs] / median[logs]) ** factor
        here = objective.density.linearise(theta)
        first = objective.iterate(here, alone.noise)
        if first is not None:
            yield climb(objective, first).iterate


def _almost_flat(problem: Problem, near: Iterate, factor: np.ndarray) -> Objective:
    """Return the objective with the priors widened by factors (names,)."""
    wide = Problem(**written_out(problem) | {"priors": _widened(problem, factor)})
    wide = wide.with_input_errors(problem.input_errors)
    density = LogPosterior(wide, near.here.solver, coordinates=RIDGE_COORDINATES)
    return Objective(density, bias_correction(wide, near), of_total=True)


def _widened(problem: Problem, factor: np.ndarray) -> dict[Any, Any]:
    """Return normal priors, of the logarithm if positive, that are wider by factors (names,); the same where it is 1.

    The supports of other parameters than positive ones do not change. A joint prior is widened as a whole.
    """
    prior, blocks = problem.joint_prior, dict[Any, Any]()
    for key, block in prior.blocks.items():
        blocks[key] = block
        columns = [problem.names.index(name) for name in (key if isinstance(key, tuple) else (key,))]
        i, wider = columns[0], float(factor[columns].max())
        if wider > 1.0 and isinstance(key, tuple):
            blocks[key] = MultivariateNormal(block.mean, wider**2 * block.covariance)
        elif wider > 1.0 and problem.logarithmic[i]:
            blocks[key] = LogNormal(float(prior.median()[i]), float(wider * prior.log_widths[i]))
        elif wider > 1.0:
            blocks[key] = TruncatedNormal(float(prior.median()[i]), float(wider * prior.widths[i]), *block.support)
    return blocks


def _tested(problem: Problem, estimate: Iterate) -> PriorConflict:
    """Return the test at the estimate by the data, in units of the prior's widths."""
    import pandas as pd

    prior, logs = problem.joint_prior, problem.logarithmic
    slopes, centre = np.where(logs, estimate.theta, 1.0), prior.median()
    width = np.where(logs, prior.log_widths, prior.widths)
    offset = np.where(logs, np.log(estimate.theta / np.where(logs, centre, 1.0)), estimate.theta - centre)
    units = width[:, None] * prior.correlation_root
    changes = units.T @ (slopes[:, None] * np.concatenate(_white(problem, estimate.here.jacobian, estimate), axis=1))
    residuals = np.concatenate(_white(problem, estimate.here.residuals, estimate))
    if not np.isfinite(changes).all():
        changes = np.zeros_like(changes)
    vectors, sizes, components = np.linalg.svd(changes, full_matrices=False)
    tested = sizes > np.maximum(1.0 / WIDENING, PRECISION * sizes.max(initial=0.0))
    inverse = np.where(tested, 1.0 / np.where(tested, sizes, 1.0), WIDENING)
    alone = offset + units @ (vectors @ np.where(tested, inverse * (components @ residuals), 0.0))
    turned = units @ vectors
    unseen = np.maximum(np.sum(units**2, axis=1) - np.sum(turned**2, axis=1), 0.0)
    sd = np.sqrt(turned**2 @ inverse**2 + WIDENING**2 * unseen)
    freedom = max(problem.counted - len(problem.names), 1.0) if problem.free_noise else np.inf
    ratio = freedom / chdtri(freedom, VARIANCES) if np.isfinite(freedom) else np.ones(1)
    quantiles = [marginal.quantile(ndtr(SCORES)) for marginal in prior.marginals.values()]
    relative = [np.log(q / c) if log else q - c for q, c, log in zip(quantiles, centre, logs, strict=True)]
    scores = np.array([_scores(q, value, s * np.sqrt(ratio)) for q, value, s in zip(relative, alone, sd, strict=True)])
    p = np.where(sd < WIDENING * width, np.mean(2.0 * ndtr(-np.abs(scores)), axis=1), np.nan)
    deviations = scores * np.sqrt(width[:, None] ** 2 + np.outer(sd**2, ratio))
    along = (vectors.T @ np.linalg.solve(units, deviations))[tested]
    parts = along**2 / (1.0 + np.outer(sizes[tested] ** -2.0, ratio))
    joint = float(np.mean(chdtrc(tested.sum(), parts.sum(axis=0)))) if tested.any() else np.nan
    reach = stdtrit(min(freedom, 1e9), INTERVAL_TAILS[:, None]) * sd
    data = np.where(
        logs, np.where(logs, centre, 1.0) * np.exp(np.where(logs, alone + reach, 0.0)), centre + alone + reach
    )
    given = np.array([marginal.quantile(INTERVAL_TAILS) for marginal in prior.marginals.values()]).T
    columns = {"data_low": data[0], "data_high": data[1], "prior_low": given[0], "prior_high": given[1], "p": p}
    loads = np.abs(vectors[:, tested][:, np.argmax(parts.mean(axis=1))]) if tested.any() else np.zeros(len(p))
    return _summary(pd.DataFrame(columns, index=[*problem.names]), joint, loads)


def _summary(table: pd.DataFrame, joint: float, loads: np.ndarray) -> PriorConflict:
    """Return the result; `loads` (names,) are the parts of the parameters in the direction of the largest deviation."""
    p = table["p"].to_numpy()
    known = p[~np.isnan(p)]
    if np.isnan(joint) or len(p) == 1:
        smallest = joint
    else:
        smallest = float(min(1.0, 2.0 * joint, *(2.0 * known.size * known)))
    members: tuple[str, ...] = ()
    if smallest < CONFLICT_LEVEL:
        outlying = p < CONFLICT_LEVEL
        members = tuple(table.index[outlying if outlying.any() else loads > SHARE * loads.max()])
    return PriorConflict(table, joint, smallest, members)


def _white(problem: Problem, components: Any, estimate: Iterate) -> list[np.ndarray]:
    return problem.likelihood.whitened(components, estimate.noise)


def _scores(prior: np.ndarray, value: float, sd: np.ndarray) -> np.ndarray:
    """Return the normal scores (n,) of an estimate with the standard deviations (n,) of its error.

    The prior is given by its quantiles at SCORES, relative to its median. The score is that of the tail probability,
    but not larger than that of the density relative to its maximum: no value within the support of a uniform prior is
    in conflict with it.
    """
    spacing = np.gradient(prior)
    spread, smooth = (np.sqrt(sd[:, None] ** 2 + (share * spacing) ** 2) for share in (12**-0.5, SMOOTHING))
    reach, weights, exponents = VANISHING * smooth.max(axis=0), MASSES / smooth, -0.5 / smooth**2

    def density(at: float) -> np.ndarray:
        near = np.abs(at - prior) < reach
        return np.sum(np.exp((at - prior[near]) ** 2 * exponents[:, near]) * weights[:, near], axis=1)

    each = (value - prior) / spread
    below, above = (np.maximum(ndtr(sign * each) @ MASSES, SMALLEST_PROBABILITY) for sign in (1.0, -1.0))
    tail = np.where(below < above, ndtri(below), -ndtri(above))
    highest = np.max([density(at) for at in (0.0, *prior[PEAKS])], axis=0)
    drop = np.sqrt(2.0 * np.log(np.maximum(highest / np.maximum(density(value), SMALLEST_PROBABILITY * highest), 1.0)))
    return np.sign(tail) * np.minimum(np.abs(tail), drop)
