"""What a posterior expects to be measured, how stable its orbits are, and where they are."""

import numpy as np
import xarray as xr

from bayesperiodic.inference.labels import CHAIN, DRAW, EXPERIMENT, column
from bayesperiodic.inference.problem import Problem
from bayesperiodic.periodic.compiled import CONVERGED

MOST = {CHAIN: 20, DRAW: 5}


def posterior_predictive(problem: Problem, posterior: xr.Dataset, time: dict[str, str], seed: int) -> xr.Dataset:
    """Return replicates of the measured mean periods, noise included, at a few draws of a few walkers.

    Parameters
    ----------
    problem : Problem
        With its anchors at the estimate.
    posterior : Dataset
        Draws of all parameters, dims (chain, draw).
    time : dict of str to str
        Name of each experiment's time axis.
    seed : int

    Returns
    -------
    Dataset
        Variables ``<experiment> <channel>`` with dims (chain, draw, time axis); ``largest_multiplier``, the modulus of
        the largest Floquet multiplier, with dims (chain, draw, experiment). NaN where a solve fails.
    """
    chosen = posterior.isel({dim: _spread(posterior.sizes[dim], most) for dim, most in MOST.items()})
    shape = chosen.sizes[CHAIN], chosen.sizes[DRAW]
    theta, noise = (
        np.array([column(chosen, name).ravel() for name in names]).reshape(len(names), -1).T
        for names in (problem.names, problem.noise_names)
    )
    if not problem.noise_names:
        noise = np.empty((len(theta), 0))
    components = problem.likelihood.simulate(noise, np.random.default_rng(seed))
    solved, variables, largest = problem.responses.solve(theta, keep=True), {}, []
    for e in problem.experiments:
        observation, found = problem.observations[e.name], solved[e.name]
        own, components = components[: len(observation.blocks)], components[len(observation.blocks) :]
        failed = found.status != CONVERGED
        for channel, values in observation.replicates(found.response, own).items():
            values[failed] = np.nan
            variables[f"{e.name} {channel}"] = ((CHAIN, DRAW, time[e.name]), values.reshape(*shape, -1))
        largest.append(problem.responses.largest_multipliers(theta, e.name, found).reshape(shape))
    variables["largest_multiplier"] = ((CHAIN, DRAW, EXPERIMENT), np.stack(largest, axis=-1))
    return xr.Dataset(variables, coords=chosen.coords)


def orbits(problem: Problem, theta: np.ndarray, time: dict[str, str]) -> xr.Dataset:
    """Return the states, turns included, of every experiment's orbit at one θ (names,).

    Returns
    -------
    Dataset
        Variables ``<experiment> <state>`` over the experiment's time axis.
    """
    return xr.Dataset(
        {
            f"{name} {state}": ((time[name],), values)
            for name, solution in problem.solve(theta).items()
            for state, values in solution.states.items()
        },
        coords={time[e.name]: e.time for e in problem.experiments},
    )


def _spread(size: int, wanted: int) -> np.ndarray:
    """Return at most so many indices, equally spaced."""
    return np.linspace(0, size - 1, min(size, wanted)).astype(int)
