"""Groups of draws that are computed with the model: replicates of the data, and terms of the log-likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.problem.description import Description
from bayesperiodic.problem.parameters import CHAIN, DRAW, EXPERIMENT, column

if TYPE_CHECKING:
    import xarray as xr

STEP, WALKER, OBSERVATION = "step", "walker", "observation"
LOG_LIKELIHOOD, POSTERIOR_PREDICTIVE = "log_likelihood", "posterior_predictive"
REPLICATES = 100
# Draws at which the terms of the log-likelihood are stored, and the most numbers that these may take.
TERM_DRAWS, MOST_TERMS = (500, 2000), 10_000_000


def posterior_predictive(density: LogPosterior, posterior: xr.Dataset, seed: int) -> xr.Dataset:
    """Return replicates of the measured mean periods, noise included, for some draws.

    Variables are ``<experiment> <channel>`` with dims (chain, draw, time axis), ``<experiment> <quantity>`` with dims
    (chain, draw, number), and ``largest_multiplier``, the modulus
    of the largest Floquet multiplier, with dims (chain, draw, experiment); NaN where a solve fails.
    """
    import xarray as xr

    problem = density.problem
    chosen, theta, noise = _some(problem, posterior, REPLICATES)
    shape = chosen.sizes[CHAIN], chosen.sizes[DRAW]
    components = problem.likelihood.simulate(noise, np.random.default_rng(seed))
    simulation, variables, largest = density.solver.solve(theta, keep=True, polish=True), {}, []
    for e in problem.experiments:
        observation, failed = problem.observations[e.name], simulation.statuses(e.name) != CONVERGED
        parts, components = components[: len(observation.blocks)], components[len(observation.blocks) :]
        for channel, values in observation.replicates(simulation.response(e.name), parts).items():
            values[failed] = np.nan
            variables[f"{e.name} {channel}"] = ((CHAIN, DRAW, time_axis(e.name)), values.reshape(*shape, -1))
        for label, values in observation.replicated(simulation.response(e.name), parts).items():
            values[failed] = np.nan
            variables[f"{e.name} {label}"] = ((CHAIN, DRAW, f"{e.name} {label} number"), values.reshape(*shape, -1))
        largest.append(density.solver.largest_multipliers(theta, e.name, simulation).reshape(shape))
    variables["largest_multiplier"] = ((CHAIN, DRAW, EXPERIMENT), np.stack(largest, axis=-1))
    return xr.Dataset(variables, coords=chosen.coords)


def _some(problem: Description, posterior: xr.Dataset, most: int) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """Return equally spaced draws of every chain, their θ (draws, names) and noise parameters (draws, noise_names)."""
    each = max(1, most // posterior.sizes[CHAIN])
    draws = posterior.sizes[DRAW]
    chosen = posterior.isel({DRAW: np.linspace(0, draws - 1, min(each, draws)).astype(int)})
    size = chosen.sizes[CHAIN] * chosen.sizes[DRAW]
    theta, noise = (
        np.array([column(chosen, name).ravel() for name in names]).reshape(len(names), size).T
        for names in (problem.names, problem.noise_names)
    )
    return chosen, theta, noise


def log_likelihood_terms(density: LogPosterior, posterior: xr.Dataset) -> xr.Dataset:
    """Return the terms of the log-likelihood at some draws of the group ``posterior`` as the only variable of a group.

    The observations have the coordinates experiment, channel, harmonic and weight, see `Likelihood.labels`.
    """
    import xarray as xr

    likelihood = density.problem.likelihood
    most = min(max(MOST_TERMS // len(likelihood.observations), TERM_DRAWS[0]), TERM_DRAWS[1])
    chosen, theta, noise = _some(density.problem, posterior, most)
    simulation = density.solver.solve(theta, whole=True)
    terms = likelihood.terms(density.comparisons.residuals(simulation, None), noise)
    terms[simulation.status != CONVERGED] = np.nan
    shaped = terms.reshape(chosen.sizes[CHAIN], chosen.sizes[DRAW], -1)
    coords = {name: chosen.coords[name] for name in (CHAIN, DRAW, STEP, WALKER)}
    group = xr.Dataset({"data": ((CHAIN, DRAW, OBSERVATION), shaped)}, coords=coords)
    labels = {name: (OBSERVATION, values) for name, values in likelihood.labels.items()}
    return group.assign_coords({OBSERVATION: [*likelihood.observations], **labels})


def time_axis(experiment: str) -> str:
    """Return the name of an experiment's time axis, which no channel can have."""
    return f"{experiment} time [s]"


def signals(problem: Description, by_run: Mapping[str, Mapping[str, np.ndarray]]) -> xr.Dataset:
    """Return signals (points,) by experiment and name as variables ``<experiment> <name>`` over time."""
    import xarray as xr

    values = {f"{run} {name}": (time_axis(run), x) for run, each in by_run.items() for name, x in each.items()}
    return xr.Dataset(values, coords={time_axis(e.name): e.time for e in problem.experiments})
