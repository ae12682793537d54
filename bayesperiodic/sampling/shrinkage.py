"""What the population says of each of its units: shrunken draws, importance weights, and units that lie outside."""

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.membership import USABLE_WEIGHTS, Expected, UnitEstimate
from bayesperiodic.sampling.population_chains import Chains
from bayesperiodic.sampling.population_density import Members, Parameters, PopulationDensity

# Draws of the population with which the units are drawn.
SHRUNKEN_DRAWS = 500


class Shrunken(NamedTuple):
    """Units under the population; arrays of members have the order of the units."""

    draws: np.ndarray  # (members, draws, names), sampling coordinates, joint with the draws of the population
    pareto_k: np.ndarray  # (members,), of the weights of the unit's draws under the population
    effective: np.ndarray  # (members,), effective number of these draws
    log_likelihood: np.ndarray  # (units, draws)
    points: np.ndarray  # (draws, coordinates of the population)


def shrink(density: PopulationDensity, chains: Chains, seed: int) -> Shrunken:
    """Return draws of every unit from the joint posterior of population and units."""
    generator, size = np.random.default_rng(seed), len(density.structure.names)
    points = chains.draws.reshape(-1, density.dimension)
    points = points[generator.choice(len(points), SHRUNKEN_DRAWS, replace=False)]
    parameters = density.structure.parameters(points)
    by_unit: dict[int, tuple[np.ndarray, float, float, np.ndarray]] = {}
    for group in density.groups:
        for row, place in enumerate(group.places):
            by_unit[place] = _one(density, group, parameters, row, generator)
    parts = [by_unit[place] for place in range(len(density.units))]
    counts = [len(unit.members) for unit in density.units]
    draws = [part[0].reshape(SHRUNKEN_DRAWS, -1, size).swapaxes(0, 1) for part in parts]
    k, effective = (np.repeat([part[column] for part in parts], counts) for column in (1, 2))
    return Shrunken(np.concatenate(draws), k, effective, np.stack([part[3] for part in parts]), points)


def _one(
    density: PopulationDensity, group: Members, parameters: Parameters, row: int, generator: np.random.Generator
) -> tuple[np.ndarray, float, float, np.ndarray]:
    """Return draws (draws, d), k̂, effective size and log-likelihoods (draws,) of one unit."""
    part = slice(row, row + 1)
    terms, constant = density.log_terms(group, parameters, part)
    log, count = terms[0], group.features.shape[2]
    total = logsumexp(log, axis=0)
    log_weights = logsumexp(log - total, axis=1)
    weights = np.exp(log_weights - logsumexp(log_weights))
    chosen = np.argmax(log + generator.gumbel(size=log.shape), axis=0)
    mean, covariance = (values[0] for values in density.moments(group, parameters, part))
    dimension, kernel = mean.shape[-1], group.kernels[row]
    centres = group.features[row, 1 : 1 + dimension, chosen]
    spread, degrees = covariance - kernel, density.structure.degrees
    if np.isfinite(degrees):
        offset = centres - mean
        distance = np.einsum("ka,kab,kb->k", offset, np.linalg.inv(covariance), offset)
        rate = generator.gamma(0.5 * (degrees + dimension), 2.0 / (degrees + distance))
        spread = spread / rate[:, None, None]
    gain = spread @ np.linalg.inv(spread + kernel)
    left = spread - gain @ spread
    values, vectors = np.linalg.eigh(0.5 * (left + left.swapaxes(1, 2)))
    noise = np.sqrt(np.maximum(values, 0.0)) * generator.standard_normal(values.shape)
    drawn = mean + np.einsum("kab,kb->ka", gain, centres - mean) + np.einsum("kab,kb->ka", vectors, noise)
    natural = group.centre[row] + group.scale[row] * drawn
    log_likelihood = total - np.log(count) + constant[0]
    return natural, convergence.pareto_k(log_weights), float(1.0 / np.sum(weights**2)), log_likelihood


def outside(density: PopulationDensity, shrunken: Shrunken, estimates: list[UnitEstimate]) -> np.ndarray:
    """Return the p-value of every member under the population of the others (members, names).

    The draws of the population are weighted by one over the likelihood of the unit. NaN where its data do not determine
    the parameter without the prior.
    """
    parameters, size = density.structure.parameters(shrunken.points), len(density.structure.names)
    rows = []
    for group_row, (unit, given) in enumerate(zip(density.units, estimates, strict=True)):
        log_weights = -shrunken.log_likelihood[group_row]
        weights = np.exp(log_weights - logsumexp(log_weights))
        usable = convergence.pareto_k(log_weights) <= USABLE_WEIGHTS
        for member, covariates in enumerate(density.covariates_of(group_row)):
            at = slice(member * size, (member + 1) * size)
            alone = UnitEstimate(given.mean[at], given.covariance[at, at], given.pareto_k)
            expected = Expected.of(parameters, covariates, density.structure.degrees, weights if usable else None)
            known = given.pareto_k <= USABLE_WEIGHTS and len(unit.members) == 1
            rows.append(expected.single(alone) if known else np.full(size, np.nan))
    return np.array(rows)
