"""Units whose posteriors are normal, so that populations of them have densities in closed form."""

import numpy as np

from bayesperiodic.sampling.population_units import Coordinate, UnitDraws

LINE = Coordinate(logarithmic=False, unit="m", support=(-np.inf, np.inf))


def gaussian_units(estimates, sds, seed, *, prior_mean=1.0, prior_sd=0.5, draws=2000):
    """Return units of independent normal estimates (units, names), drawn with a normal prior of every parameter."""
    covariances = np.stack([np.diag(sd**2) for sd in sds])
    return correlated_units(estimates, covariances, seed, prior_mean=prior_mean, prior_sd=prior_sd, draws=draws)


def correlated_units(estimates, covariances, seed, *, prior_mean=1.0, prior_sd=0.5, draws=2000):
    """Return units of normal estimates (units, names) with covariances (units, names, names)."""
    generator, units = np.random.default_rng(seed), {}
    for number, (estimate, given) in enumerate(zip(estimates, covariances, strict=True)):
        mean, covariance = with_prior(estimate, given, prior_mean, prior_sd)
        points = mean + generator.standard_normal((draws, len(estimate))) @ np.linalg.cholesky(covariance).T
        label = f"unit {number + 1}"
        units[label] = UnitDraws.of(
            [label], [LINE] * len(estimate), points,
            lambda x: -0.5 * np.sum(((x - prior_mean) / prior_sd) ** 2, axis=-1), draws,
        )  # fmt: skip
    return units


def with_prior(estimate, covariance, prior_mean, prior_sd):
    """Return mean and covariance of the posterior of a normal estimate with independent normal priors."""
    precision = np.linalg.inv(covariance)
    posterior = np.linalg.inv(precision + np.eye(len(estimate)) / prior_sd**2)
    return posterior @ (precision @ estimate + np.full(len(estimate), prior_mean) / prior_sd**2), posterior


def closed_form(estimates, covariances, design, prior_precision, spreads):
    """Return log-evidence (g,), coefficients (g, p) and their covariance (g, p, p) for covariances `spreads` (g, d, d).

    The normal linear model of D. V. Lindley and A. F. M. Smith (J. R. Statist. Soc. B 34 (1972) 1-41) with the units
    integrated out: estimates (n, d) about design (n, d, p) times coefficients with a prior of this precision (p,).
    """
    inverse = np.linalg.inv(covariances + spreads[:, None])
    weighted = np.einsum("ndp,gnde->gnpe", design, inverse)
    fisher = np.einsum("gnpe,neq->gpq", weighted, design) + np.diag(prior_precision)
    right = np.einsum("gnpe,ne->gp", weighted, estimates)
    covariance = np.linalg.inv(fisher)
    coefficients = np.einsum("gpq,gq->gp", covariance, right)
    log = 0.5 * np.linalg.slogdet(inverse)[1].sum(axis=1) - 0.5 * np.linalg.slogdet(fisher)[1]
    log += 0.5 * np.einsum("gp,gp->g", right, coefficients)
    return log - 0.5 * np.einsum("nd,gnde,ne->g", estimates, inverse, estimates), coefficients, covariance
