"""Sampling of θ and the channel variances with emcee."""

import importlib.metadata
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import emcee
import numpy as np
import xarray as xr
from tqdm import tqdm

from bayesperiodic import checks
from bayesperiodic.inference import chains
from bayesperiodic.inference.checkpoint import backends, fingerprint
from bayesperiodic.inference.coordinates import SamplingDensity
from bayesperiodic.inference.estimate import MapEstimate
from bayesperiodic.inference.posterior import Posterior
from bayesperiodic.inference.problem import Problem
from bayesperiodic.parallel import available_cores

BLOCK = 250
OVERDISPERSION = 2.0
REDRAWS = 100
LENGTHS = 50.0
TAU_CHANGE = 0.05
RHAT = 1.005
QUANTILE_SPREAD = 0.25
PASSES = 2


def sample(
    problem: Problem,
    fit: MapEstimate,
    *,
    seed: int,
    ensembles: int = 4,
    walkers: int | None = None,
    max_steps: int = 20_000,
    checkpoint: str | Path | None = None,
    progress: bool = True,
) -> Posterior:
    """Sample the posterior of θ and the unknown channel variances with emcee's affine-invariant ensembles.

    Several independent ensembles start from draws of the Laplace approximation with doubled standard deviations.
    Parameters with positive support and the variances are sampled in their logarithms, where products become
    straight ridges; Jeffreys' prior 1/v is flat there. Seven steps in ten are differential-evolution moves, which mix
    three times faster than stretch moves on a normal target of six dimensions (tau 21 against 67), two are stretch
    moves, and one is a differential-evolution move of full length, which can jump between modes.

    Sampling stops when the chain is 50 autocorrelation times long after a fifth of it was dropped, that time has
    changed by less than 5 %, R-hat between the ensembles is at most 1.005 and their 5, 50 and 95 % quantiles agree
    within a quarter of a standard deviation, twice in succession.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
        Its point anchors the periodic solves and starts the walkers.
    seed : int
        The same seed gives the same draws, whatever the number of threads.
    ensembles : int
        At least 2.
    walkers : int, optional
        Of each ensemble, even and at least twice the number of parameters and unknown variances.
    max_steps : int
        Reaching it is reported as not converged.
    checkpoint : path, optional
        An HDF5 file; the same call resumes what it holds.
    progress : bool
        Show a progress bar with acceptance, tau and length in units of tau.

    Returns
    -------
    Posterior

    Raises
    ------
    ValueError
        For too few or an odd number of walkers, a start with no finite log-posterior, a checkpoint of another problem.

    References
    ----------
    D. Foreman-Mackey, D. W. Hogg, D. Lang, J. Goodman, emcee: the MCMC hammer, PASP 125 (2013) 306-312.
    C. J. F. ter Braak, A Markov chain Monte Carlo version of the genetic algorithm differential evolution, Statistics
    and Computing 16 (2006) 239-249.
    """
    checks.integer("ensembles", ensembles, 2)
    checks.integer("max_steps", max_steps, BLOCK)
    checks.integer("seed", seed, 0)
    anchored = problem.anchored(fit.theta)
    densities = [SamplingDensity(anchored, max(1, available_cores() // ensembles)) for _ in range(ensembles)]
    walkers = _checked_walkers(walkers, densities[0])
    samplers, starts = _samplers(problem, fit, densities, seed, walkers, checkpoint)
    converged, reason, passes = False, f"max_steps = {max_steps} reached", 0
    last = np.full(densities[0].dimension, np.inf)
    bar = tqdm(total=max_steps, unit="step", desc="sampling", disable=not progress)
    for steps in range(BLOCK, max_steps + 1, BLOCK):
        with ThreadPoolExecutor(available_cores()) as pool:
            list(pool.map(_advance, samplers, starts, [steps] * ensembles))
        kept = _kept(samplers, steps)
        tau = chains.autocorrelation_time(kept)
        shortfall = _shortfall(kept, tau, last)
        passes, last = (0 if shortfall else passes + 1), tau
        bar.update(steps - bar.n)
        bar.set_postfix_str(
            f"acceptance {_acceptance(samplers):.2f}, tau {tau.max():.0f}, length {kept.shape[1] / tau.max():.0f} tau"
        )
        if passes == PASSES:
            converged, reason = True, f"stop rule passed after {steps} steps of {ensembles} × {walkers} walkers"
            break
    else:
        reason += f" with {', '.join(shortfall) or 'the stop rule passed only once'}"
    bar.close()
    return _posterior(densities, samplers, steps, converged, reason, seed)


def _checked_walkers(walkers: int | None, density: SamplingDensity) -> int:
    needed = 2 * density.dimension
    if walkers is None:
        return max(32, needed + needed % 2)
    if checks.integer("walkers", walkers, 1) < needed or walkers % 2:
        raise ValueError(
            f"walkers: {walkers} is not allowed; it must be even and at least twice the dimension, {needed} for "
            f"{', '.join(density.labels)}."
        )
    return walkers


def _samplers(
    problem: Problem,
    fit: MapEstimate,
    densities: list[SamplingDensity],
    seed: int,
    walkers: int,
    checkpoint: str | Path | None,
) -> tuple[list[emcee.EnsembleSampler], list[np.ndarray | None]]:
    """Return the samplers and where they start; None where a checkpoint holds the last step."""
    settings = f"seed {seed}, {len(densities)} ensembles of {walkers} walkers"
    stores = backends(checkpoint, problem, settings, len(densities))
    samplers: list[emcee.EnsembleSampler] = []
    starts: list[np.ndarray | None] = []
    for density, sequence, store in zip(
        densities, np.random.SeedSequence(seed).spawn(len(densities)), stores, strict=True
    ):
        moves = [
            (emcee.moves.DEMove(), 0.7),
            (emcee.moves.DEMove(gamma0=1.0), 0.1),
            (emcee.moves.StretchMove(), 0.2),
        ]
        sampler = emcee.EnsembleSampler(walkers, density.dimension, density, moves=moves, vectorize=True, backend=store)
        generator = np.random.default_rng(sequence)
        if sampler.iteration == 0:
            sampler.random_state = np.random.RandomState(generator.integers(2**32, size=4)).get_state()
        starts.append(_start(density, fit, walkers, generator) if sampler.iteration == 0 else None)
        samplers.append(sampler)
    return samplers, starts


def _start(density: SamplingDensity, fit: MapEstimate, walkers: int, generator: np.random.Generator) -> np.ndarray:
    mean, covariance = density.laplace(fit)
    if not np.isfinite(covariance).all():
        raise ValueError("fit: its covariance is not finite, so there is no Laplace approximation to start from.")
    factor = OVERDISPERSION * np.linalg.cholesky(covariance)
    points = np.empty((0, mean.size))
    drawn = 0
    while len(points) < walkers and drawn < REDRAWS * walkers:
        candidates = mean + generator.standard_normal((walkers, mean.size)) @ factor.T
        drawn += walkers
        points = np.concatenate([points, candidates[np.isfinite(density(candidates))]])
    if len(points) < walkers:
        raise ValueError(
            f"fit: of {drawn} start points drawn around it {1 - len(points) / drawn:.1%} have no finite log-posterior, "
            "so the walkers cannot start; check the priors' support and the fit's status."
        )
    return points[:walkers]


def _advance(sampler: emcee.EnsembleSampler, start: np.ndarray | None, steps: int) -> None:
    missing, here = steps - sampler.iteration, start if sampler.iteration == 0 else None
    if missing > 0:
        sampler.run_mcmc(here, missing, skip_initial_state_check=True, progress=False)


def _kept(samplers: list[emcee.EnsembleSampler], steps: int) -> np.ndarray:
    """Return the chains (ensembles, steps, walkers, coordinates) up to a step, without their first fifth."""
    return np.stack([sampler.get_chain()[steps // 5 : steps] for sampler in samplers])


def _acceptance(samplers: list[emcee.EnsembleSampler]) -> float:
    return float(np.mean([sampler.acceptance_fraction for sampler in samplers]))


def _shortfall(kept: np.ndarray, tau: np.ndarray, last: np.ndarray) -> list[str]:
    """Return what the stop rule misses, in words."""
    found = []
    if (lengths := kept.shape[1] / tau.max()) < LENGTHS:
        found.append(f"length only {lengths:.0f} tau")
    if (change := np.max(np.abs(tau - last) / tau)) > TAU_CHANGE:
        found.append(f"tau changed by {change:.0%}")
    if (spread := chains.quantile_spread(kept).max()) > QUANTILE_SPREAD:
        found.append(f"quantiles of the ensembles {spread:.2f} sd apart")
    if not found and (worst := chains.rhat(kept).max()) > RHAT:
        found.append(f"R-hat {worst:.3f}")
    return found


def _posterior(
    densities: list[SamplingDensity],
    samplers: list[emcee.EnsembleSampler],
    last_step: int,
    converged: bool,
    reason: str,
    seed: int,
) -> Posterior:
    density, kept = densities[0], _kept(samplers, last_step)
    problem, calls = density.problem, sum(d.calls for d in densities)
    ensembles, steps, walkers, _ = kept.shape
    tau = chains.autocorrelation_time(kept)
    points = kept.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, -1)
    theta, variances = density.to_natural(points)
    lp = np.stack([s.get_log_prob()[last_step // 5 : last_step] for s in samplers])
    coords = {
        "chain": np.arange(ensembles * walkers),
        "draw": np.arange(steps),
        "channel": list(problem.channels),
        "ensemble": ("chain", np.repeat(np.arange(ensembles), walkers)),
    }
    units = problem.model.units
    variables: dict[str, Any] = {
        name: (("chain", "draw"), theta[..., i], {"units": units.get(name, "")}) for i, name in enumerate(problem.names)
    }
    squared = {
        f"units of {c}": f"{units[c]}²" if units[c].isalpha() else f"({units[c]})²"
        for c in problem.channels
        if c in units
    }
    variables["variance"] = (("chain", "draw", "channel"), variances, squared)
    stats = {"lp": (("chain", "draw"), lp.transpose(0, 2, 1).reshape(ensembles * walkers, steps))}
    data = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset(variables, coords=coords),
            "sample_stats": xr.Dataset(stats, coords={k: coords[k] for k in ("chain", "draw", "ensemble")}),
            "observed_data": _signals(problem, "outputs"),
            "constant_data": _signals(problem, "inputs"),
        }
    )
    data.attrs = {
        "seed": seed,
        "fingerprint": fingerprint(problem),
        "converged": int(converged),
        "reason": reason,
        "synthetic": int(any(e.synthetic for e in problem.experiments)),
        "bayesperiodic": importlib.metadata.version("bayesperiodic"),
        "emcee": emcee.__version__,
    }
    draws = steps * walkers * ensembles
    by_label = {label: float(t) for label, t in zip(density.labels, tau, strict=True)}
    return Posterior(
        data=data,
        converged=converged,
        reason=reason,
        tau=by_label,
        ess={label: draws / t for label, t in by_label.items()},
        rhat=dict(zip(density.labels, chains.rhat(kept).tolist(), strict=True)),
        acceptance=_acceptance(samplers),
        failures={s: n / calls for s, n in sum((d.failures for d in densities), Counter()).items()},
        log_posterior_calls=calls,
        seed=seed,
    )


def _signals(problem: Problem, kind: str) -> xr.Dataset:
    return xr.Dataset(
        {
            f"{experiment.name} {channel}": ((f"{experiment.name} time",), values)
            for experiment in problem.experiments
            for channel, values in getattr(experiment, kind).items()
        },
        coords={f"{experiment.name} time": experiment.time for experiment in problem.experiments},
    )
