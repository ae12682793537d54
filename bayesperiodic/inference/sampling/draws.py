"""From the chains of the samplers to a Posterior: natural values as labelled arrays, with units and diagnostics."""

import importlib.metadata

import emcee
import numpy as np
import xarray as xr

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.inference.labels import (
    CHAIN,
    CHANNEL,
    DRAW,
    EXPERIMENT,
    NOISE,
    full_name,
    local_names,
    pack,
    squared,
)
from bayesperiodic.inference.noise.blocks import SCALE
from bayesperiodic.inference.parameters import SHIFT
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling import chains
from bayesperiodic.inference.sampling.checkpoint import fingerprint
from bayesperiodic.inference.sampling.coordinates import SamplingDensity
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.inference.sampling.replicates import orbits, posterior_predictive
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, STATUSES

ENSEMBLE = "ensemble"


def gather(
    density: SamplingDensity,
    kept: np.ndarray,
    log_density: np.ndarray,
    *,
    converged: bool,
    reason: str,
    acceptance: float,
    seed: int,
) -> Posterior:
    """Return the posterior that chains in sampling coordinates hold.

    Parameters
    ----------
    density : SamplingDensity
        With the counts of calls and failures of all ensembles.
    kept : array (ensembles, steps, walkers, coordinates)
    log_density : array (ensembles, steps, walkers)
    converged, reason, acceptance, seed
        See `Posterior`.
    """
    problem, labels = density.problem, density.labels
    data = tree(problem, *density.to_natural(kept), log_density, seed)
    data.attrs |= {"seed": seed, "converged": int(converged), "reason": reason}
    tau = chains.autocorrelation_time(kept)
    return Posterior(
        data=data,
        converged=converged,
        reason=reason,
        tau=dict(zip(labels, tau.tolist(), strict=True)),
        ess=dict(zip(labels, (log_density.size / tau).tolist(), strict=True)),
        rhat=dict(zip(labels, chains.rhat(kept).tolist(), strict=True)),
        acceptance=acceptance,
        failures={status: count / density.calls for status, count in density.failures.items()},
        log_posterior_calls=density.calls,
        seed=seed,
    )


def tree(problem: Problem, theta: np.ndarray, noise: np.ndarray, log_density: np.ndarray, seed: int) -> xr.DataTree:
    """Return draws as the groups of `Posterior.data`.

    Parameters
    ----------
    problem : Problem
        With its anchors set.
    theta : array (ensembles, steps, walkers, names)
        Natural values.
    noise : array (ensembles, steps, walkers, noise_names)
    log_density : array (ensembles, steps, walkers)
    seed : int
        Of the replicates.
    """
    ensembles, steps, walkers = log_density.shape
    best = theta.reshape(-1, theta.shape[-1])[np.argmax(log_density)]
    theta, noise, lp = (_by_chain(values) for values in (theta, noise, log_density[..., None]))
    coords = {
        CHAIN: np.arange(ensembles * walkers),
        DRAW: np.arange(steps),
        ENSEMBLE: (CHAIN, np.repeat(np.arange(ensembles), walkers)),
    }
    posterior, time = _variables(problem, theta, noise).assign_coords(coords), _time_axes(problem)
    status = np.where(np.isfinite(lp[..., 0]), CONVERGED, NOT_FINITE).astype(np.int8)
    meanings = {
        "flag_values": list(range(len(STATUSES))),
        "flag_meanings": " ".join(s.replace(" ", "_") for s in STATUSES),
    }
    result = xr.DataTree.from_dict(
        {
            "posterior": posterior,
            "sample_stats": xr.Dataset(
                {"lp": ((CHAIN, DRAW), lp[..., 0]), "status": ((CHAIN, DRAW), status, meanings)}, coords=coords
            ),
            "posterior_predictive": posterior_predictive(problem, posterior, time, seed),
            "orbits": orbits(problem, best, time),
            "observed_data": _signals(problem, "outputs"),
            "constant_data": _signals(problem, "inputs"),
        }
    )
    result.attrs = {
        "fingerprint": fingerprint(problem),
        "synthetic": int(any(e.synthetic for e in problem.experiments)),
        "bayesperiodic": importlib.metadata.version("bayesperiodic"),
        "emcee": emcee.__version__,
    }
    return result


def _by_chain(values: np.ndarray) -> np.ndarray:
    """Return values (ensembles, steps, walkers, columns) as (chains, draws, columns)."""
    ensembles, steps, walkers, columns = values.shape
    return values.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, columns)


def _variables(problem: Problem, theta: np.ndarray, noise: np.ndarray) -> xr.Dataset:
    """Return θ (chains, draws, names) and noise parameters (chains, draws, noise_names) as labelled variables."""
    columns = {name: theta[..., i] for i, name in enumerate(problem.names)}
    columns |= _fixed_locals(problem, theta.shape[:-1])
    columns |= {name: noise[..., i] for i, name in enumerate(problem.noise_names)}
    dims = {name.partition("[")[0]: _dims(problem, name) for name in (*problem.names, *problem.noise_names)}
    coords = {CHANNEL: list(problem.channels), EXPERIMENT: [e.name for e in problem.experiments]}
    noises = {name.partition("[")[0] for name in problem.noise_names}
    return xr.Dataset(
        {
            variable: (
                *packed,
                _noise_attributes(problem, variable) if variable in noises else _unit(problem, variable),
            )
            for variable, packed in pack(columns, dims, coords).items()
        },
        coords=coords,
    )


def _fixed_locals(problem: Problem, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Return the values of local parameters in the experiments where they are fixed."""
    return {
        full_name(plain, (run,)): np.full(shape, parameter_map.fixed[plain])
        for plain in local_names(problem.names)
        for run, parameter_map in problem.parameter_maps.items()
        if plain in parameter_map.fixed
    }


def _dims(problem: Problem, name: str) -> tuple[str, ...]:
    """Return the dims, after chain and draw, of the variable that a full name belongs to."""
    if "[" not in name:
        return ()
    if name in problem.names or name.startswith(f"{SCALE}["):
        return (EXPERIMENT,)
    return (CHANNEL,) if problem.noise.per == CHANNEL else (CHANNEL, EXPERIMENT)


def _unit(problem: Problem, parameter: str) -> dict[str, str]:
    return {"units": "s" if parameter == SHIFT else problem.model.units.get(parameter, "")}


def _noise_attributes(problem: Problem, variable: str) -> dict[str, str]:
    """Return the noise model's name, and the unit of each channel's variance."""
    units = problem.model.units if variable == "variance" else {}
    each = {f"units of {channel}": squared(units[channel]) for channel in problem.channels if channel in units}
    return {NOISE: problem.noise.name} | each


def _signals(problem: Problem, kind: str) -> xr.Dataset:
    return xr.Dataset(
        {
            f"{experiment.name} {channel}": ((_time(experiment),), values)
            for experiment in problem.experiments
            for channel, values in getattr(experiment, kind).items()
        },
        coords={_time(experiment): experiment.time for experiment in problem.experiments},
    )


def _time_axes(problem: Problem) -> dict[str, str]:
    return {experiment.name: _time(experiment) for experiment in problem.experiments}


def _time(experiment: Experiment) -> str:
    """Return the name of an experiment's time axis, which no channel can have."""
    return f"{experiment.name} time [s]"
