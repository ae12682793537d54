"""Evidence for a spread against none: by the density at zero, and by bridge sampling where that is undecided."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import logsumexp

from bayesperiodic.sampling.evidence import bridge
from bayesperiodic.sampling.population_chains import Chains, sample_chains
from bayesperiodic.sampling.population_coordinates import Decoupled
from bayesperiodic.sampling.population_density import PopulationDensity

if TYPE_CHECKING:
    import pandas as pd

# Draws at which the density at zero is averaged, points of its normalisation, and the spread that is taken for zero,
# relative to the smallest kernel.
CONDITIONAL_DRAWS, SPREAD_POINTS, NO_SPREAD = 200, 40, 1e-2
# Log Bayes factors beyond this need no second estimate.
DECIDED = 5.0
COLUMNS = ["log_bayes_factor", "error", "bridge", "bridge_error"]


def evidence_for_spread(density: PopulationDensity, chains: Chains, seed: int) -> pd.DataFrame:
    """Return the log Bayes factor of a spread against none, one row per parameter with a free spread.

    Columns: log_bayes_factor, by the ratio of posterior to prior density at zero (Savage and Dickey; J. M. Dickey, Ann.
    Math. Statist. 42 (1971) 204-223), the posterior one averaged over draws of all else; error, its error by the number
    of each unit's draws that matter without a spread, which are few where units are far apart; bridge and bridge_error,
    by bridge sampling of both populations, NaN where the first is beyond ±5.
    """
    import pandas as pd

    rows = {}
    for name in density.structure.free:
        log, error = _density_at_zero(density, chains, name)
        row = {"log_bayes_factor": log, "error": error, "bridge": np.nan, "bridge_error": np.nan}
        if abs(log) < DECIDED:
            structure = density.structure
            without = density.with_structure(replace(structure, spread=dict(structure.spread) | {name: 0.0}))
            others = sample_chains(without, seed, progress=False)
            parts = [_log_evidence(d, c, seed) for d, c in ((density, chains), (without, others))]
            row["bridge"] = parts[0][0] - parts[1][0]
            row["bridge_error"] = float(np.hypot(parts[0][1], parts[1][1]))
        rows[name] = row
    return pd.DataFrame.from_dict(rows, orient="index", columns=COLUMNS)


def _log_evidence(density: PopulationDensity, chains: Chains, seed: int) -> tuple[float, float]:
    generator, coordinates, draws = np.random.default_rng(seed), Decoupled(density), chains.draws
    inside = coordinates.decoupled(draws.reshape(-1, density.dimension)).reshape(draws.shape)
    first, second = (bridge(coordinates, inside[k::2], inside[1 - k :: 2], 0.0, generator) for k in (0, 1))
    return 0.5 * (first.log + second.log), 0.5 * float(np.hypot(first.error, second.error))


def _density_at_zero(density: PopulationDensity, chains: Chains, name: str) -> tuple[float, float]:
    """Return ln of prior over posterior density of a spread at zero, and its error."""
    structure, place = density.structure, density.labels.index(f"spread[{name}]")
    points = chains.draws.reshape(-1, density.dimension)
    points = points[np.linspace(0, len(points) - 1, CONDITIONAL_DRAWS).round().astype(int)]
    at = structure.names.index(name)
    kernels = [np.diag(unit.kernel).reshape(-1, len(structure.names))[:, at].min() for unit in density.units]
    low = np.log(NO_SPREAD * np.sqrt(min(kernels)))
    high = max(chains.draws[..., place].max() + 2.0, low + 5.0)
    grid = np.linspace(low, high, SPREAD_POINTS)
    every = np.repeat(points, SPREAD_POINTS, axis=0)
    every[:, place] = np.tile(grid, len(points))
    # Over the logarithm of the spread; below the grid the density of the spread itself is constant.
    logs = density.evaluate(every).log_prob.reshape(len(points), SPREAD_POINTS)
    weights = np.full(SPREAD_POINTS, grid[1] - grid[0])
    weights[[0, -1]] *= 0.5
    weights[0] += 1.0
    at_zero = logs[:, 0] - low - logsumexp(logs, b=weights, axis=1)
    prior = float(structure.spread[name].log_prob(np.exp(low)))
    densest = every[::SPREAD_POINTS][[np.argmax(logs[:, 0])]]
    return prior - float(logsumexp(at_zero) - np.log(len(points))), _error(density, densest)


def _error(density: PopulationDensity, point: np.ndarray) -> float:
    """Return the standard error of the log-likelihood at a point (1, dimension)."""
    parameters, total = density.structure.parameters(point), 0.0
    for group in density.groups:
        for row in range(len(group.places)):
            log = density.log_terms(group, parameters, slice(row, row + 1))[0].ravel()
            total += float(np.exp(logsumexp(2.0 * log) - 2.0 * logsumexp(log)))
    return float(np.sqrt(total))
