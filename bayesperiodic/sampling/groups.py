"""Groups of draws: labelled variables, replicates of the data, and terms of the log-likelihood."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.likelihood.section_points import SCALE
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, STATUSES
from bayesperiodic.problem.description import Description
from bayesperiodic.problem.fingerprint import fingerprint
from bayesperiodic.problem.parameters import CHAIN, CHANNEL, DRAW, EXPERIMENT, NOISE, column, full_name, pack, squared
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.chains import StoredChains

if TYPE_CHECKING:
    import xarray as xr

STEP, WALKER, OBSERVATION = "step", "walker", "observation"
LOG_LIKELIHOOD, POSTERIOR_PREDICTIVE = "log_likelihood", "posterior_predictive"
REPLICATES = 100
MODE = "mode"
INPUT_NOISE, EXPECTED, LOADINGS, CAUSED = "input_noise", "expected errors", "loadings", "caused"
# Draws at which the terms of the log-likelihood are stored, and the most numbers that these may take.
TERM_DRAWS, MOST_TERMS, DRAWS_TOGETHER = (500, 2000), 10_000_000, 256


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
    terms = np.empty((len(theta), len(likelihood.observations)))
    for k in range(0, len(theta), DRAWS_TOGETHER):
        part = slice(k, k + DRAWS_TOGETHER)
        simulation = density.solver.solve(theta[part], whole=True)
        terms[part] = likelihood.terms(density.comparisons.residuals(simulation, None), noise[part])
        terms[part][simulation.status != CONVERGED] = np.nan
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


def tree(
    density: LogPosterior, kept: StoredChains, log_density: np.ndarray, seed: int, modes: np.ndarray | None = None
) -> xr.DataTree:
    """Return draws in sampling coordinates, which are given back, as the groups of `Posterior.tree`."""
    import xarray as xr

    problem, lp = density.problem, convergence.as_chains(log_density)
    steps, walkers = log_density.shape[1:]
    moved, same = np.full(log_density.shape, np.nan), np.ones(log_density[:, 1:].shape, dtype=bool)
    for i in range(len(problem.names)):
        same &= kept[..., i][:, 1:] == kept[..., i][:, :-1]
    moved[:, 1:] = ~same
    largest = np.unravel_index(np.argmax(log_density), log_density.shape)
    best, _ = density.to_natural(np.array([kept[..., i][largest] for i in range(density.dimension)]))
    step, walker = (convergence.as_chains(index[None])[0] for index in np.indices((steps, walkers)))
    coords = {CHAIN: np.arange(len(lp)), DRAW: np.arange(lp.shape[1]), STEP: (DRAW, step), WALKER: (DRAW, walker)}
    posterior = _variables(density, kept, lp.shape).assign_coords(coords)
    status = np.where(np.isfinite(lp), CONVERGED, NOT_FINITE).astype(np.int8)
    flags = " ".join(s.replace(" ", "_") for s in STATUSES)
    meanings = {"flag_values": list(range(len(STATUSES))), "flag_meanings": flags}
    stats = {"lp": ((CHAIN, DRAW), lp), "status": ((CHAIN, DRAW), status, meanings)}
    stats |= {"acceptance_rate": ((CHAIN, DRAW), convergence.as_chains(moved))}
    if modes is not None:
        stats |= {MODE: ((CHAIN, DRAW), convergence.as_chains(modes.astype(np.int8)))}
    groups = {
        "posterior": posterior,
        "sample_stats": xr.Dataset(stats, coords=coords),
        LOG_LIKELIHOOD: log_likelihood_terms(density, posterior),
        POSTERIOR_PREDICTIVE: posterior_predictive(density, posterior, seed),
        "orbits": signals(problem, {run: s.states for run, s in density.solver.solutions(best).items()}),
        "observed_data": signals(problem, {e.name: e.outputs for e in problem.experiments}),
        "constant_data": signals(problem, {e.name: e.inputs for e in problem.experiments}),
    }
    if problem.input_errors:
        variables: dict[str, Any] = {}
        for name, errors in problem.input_errors.items():
            variables[f"{name} {EXPECTED}"] = ((f"{name} error",), errors.expected)
            variables[f"{name} {LOADINGS}"] = ((f"{name} component", f"{name} error"), errors.loadings)
            variables[f"{name} {CAUSED}"] = ((f"{name} component",), errors.caused)
        groups[INPUT_NOISE] = xr.Dataset(variables)
    result = xr.DataTree.from_dict(groups)
    result.attrs = {
        "fingerprint": fingerprint(problem),
        "synthetic": int(any(e.synthetic for e in problem.experiments)),
        "bayesperiodic": importlib.metadata.version("bayesperiodic"),
        "emcee": importlib.metadata.version("emcee"),
    }
    return result


def _variables(density: LogPosterior, kept: StoredChains, shape: tuple[int, ...]) -> xr.Dataset:
    """Return θ and noise parameters of draws as labelled variables (chains, draws, …), one after the other."""
    import xarray as xr

    problem = density.problem
    columns = density.natural_columns(lambda k: convergence.as_chains(kept.pop(k))) | _fixed_locals(problem)
    dims = {plain: (EXPERIMENT,) * (plain != name) for name, plain in problem.plain_names.items()}
    dims |= {name.partition("[")[0]: _noise_dims(problem, name) for name in problem.noise_names}
    channels = [*problem.channels, *problem.quantities, *filter(None, [problem.noise.pooled])]
    coords = {CHANNEL: channels, EXPERIMENT: [e.name for e in problem.experiments]}
    noises = {name.partition("[")[0] for name in problem.noise_names}
    attributes = {v: _noise_attributes(problem, v) if v in noises else _attributes(problem, v) for v in dims}
    packed = pack(shape, columns, dims, coords)
    return xr.Dataset({v: (*values, attributes[v]) for v, values in packed.items()}, coords=coords)


def _fixed_locals(problem: Description) -> dict[str, Callable[[], float]]:
    """Return what returns the values of local parameters in the experiments where they are fixed."""
    return {
        full_name(plain, (run,)): partial(float, parameter_map.fixed[plain])
        for plain in {plain for name, plain in problem.plain_names.items() if plain != name}
        for run, parameter_map in problem.parameter_maps.items()
        if plain in parameter_map.fixed
    }


def _noise_dims(problem: Description, name: str) -> tuple[str, ...]:
    """Return the dims, after chain and draw, of the variable of a noise parameter's full name."""
    if "[" not in name:
        return ()
    if name.startswith(f"{SCALE}["):
        return (EXPERIMENT,)
    return (CHANNEL,) if problem.noise.per == CHANNEL else (CHANNEL, EXPERIMENT)


def _attributes(problem: Description, parameter: str) -> dict[str, Any]:
    """Return the unit of a parameter, and the support of its prior, one for each experiment that has its own."""
    supports = problem.joint_prior.supports.items()
    each = {f"support of {name}": list(ends) for name, ends in supports if problem.plain_names[name] == parameter}
    return {"units": problem.units.get(parameter, "")} | each


def _noise_attributes(problem: Description, variable: str) -> dict[str, str]:
    """Return the noise model's name, and the unit of each channel's variance."""
    units = {c: problem.model.units.get(c, "") for c in problem.channels} | problem.quantities
    squares = {f"units of {c}": squared(unit) for c, unit in units.items() if unit and variable == "variance"}
    return {NOISE: problem.noise.name} | squares
