"""One replicate of a calibration: a truth from the prior, its recordings, and its rank in the estimates."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtr

from bayesperiodic import _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.recording import Recording
from bayesperiodic.estimation.map_estimate import map_estimate
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.posterior.joint_priors import as_prior
from bayesperiodic.posterior.noise import EXPERIMENT, VARIANCE, Independent
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling.posterior import Posterior
from bayesperiodic.sampling.sample import sample
from bayesperiodic.simulation import NotSettled, steady_cycle

MCMC, LAPLACE = "mcmc", "laplace"
METHODS = (MCMC, LAPLACE)
DONE, NO_STEADY_STATE = "done", "no steady state"
FEWEST_CYCLES = 3
# Steps between draws taken as independent, in autocorrelation times (which short chains underestimate), the least
# number of these draws, and the largest R-hat.
SPACING, FEWEST_DRAWS, LARGEST_RHAT = 5.0, 20, 1.1


@dataclass(frozen=True)
class Campaign:
    """Settings of all replicates."""

    problem: Problem
    seed: int
    source: str
    ensembles: int
    walkers: int | None
    max_steps: int


def check_supported(problem: Problem) -> None:
    """Raise a ValueError for an improper prior, or a problem whose recordings cannot be simulated."""
    noise = problem.noise
    if not isinstance(noise, Independent):
        raise ValueError(
            f"problem: must have the noise model noise.Independent, got {noise.name!r}. Recordings are simulated with "
            "independent errors: give noise.Independent(prior=…)."
        )
    if problem.free_noise and not noise.proper:
        raise ValueError(
            f"problem: must have proper priors, got the {noise.prior_text} of {problem.free_noise[0]!r}. Give "
            "noise.Independent(prior=bp.InverseGamma(…)) or another proper prior, or fix the variance."
        )
    if problem.model.autonomous:
        raise ValueError(f"problem: must have a forced model, got the autonomous {problem.model.name!r}.")
    for e in problem.experiments:
        turns = [e.winding] if isinstance(e.winding, int) else [*e.winding.values()]
        for what, found in (
            ("a mask", e.mask is not None),
            ("multipliers", e.multipliers is not None),
            (f"periods = {e.periods}", e.periods > 1),
            ("a winding number", any(turns)),
            ("a delay (shift)", problem.parameter_maps[e.name].delayed),
        ):
            if found:
                raise ValueError(
                    f"problem: experiments must have whole histories of one forcing period, got {e.name!r} with {what}."
                )


def replicate(campaign: Campaign, number: int) -> dict[str, Any]:
    """Return one replicate as a JSON object: its status, its truth, and the rank of the truth in each estimate.

    A replicate depends on the seed of the campaign and on its number only.
    """
    seeds = np.random.SeedSequence([campaign.seed, number]).spawn(4)
    truths, noise, chain, ties = (np.random.default_rng(seed) for seed in seeds)
    problem = campaign.problem
    theta = dict(zip(problem.names, problem.joint_prior.sample(1, truths)[0].tolist(), strict=True))
    variances = _drawn_variances(problem, truths)
    line: dict[str, Any] = {"source": campaign.source, "number": number, "theta": theta}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            measured = [_measured(problem, e, theta, variances, noise) for e in problem.experiments]
        except NotSettled:
            return line | {"status": NO_STEADY_STATE}
        except ValueError as error:
            return line | {"status": "fold failed", "error": str(error)}
        truth = theta | _folded_variances(problem, variances, [fraction for _, fraction in measured])
        return line | {"truth": truth} | _ranks(campaign, [again for again, _ in measured], truth, chain, ties)


def _drawn_variances(problem: Problem, generator: np.random.Generator) -> dict[str, float]:
    """Return all variances, drawn from the prior or fixed."""
    values = dict(problem.likelihood.fixed)
    for name in problem.free_noise:
        values[name] = float(as_prior("prior", problem.noise.prior).sample(1, generator)[0])
    return values


def _variance_name(problem: Problem, channel: str, experiment: str) -> str:
    inside = f"{channel}, {experiment}" if problem.noise.per == EXPERIMENT else channel
    return f"{VARIANCE}[{inside}]"


def _measured(
    problem: Problem,
    e: Experiment,
    theta: dict[str, float],
    variances: dict[str, float],
    generator: np.random.Generator,
) -> tuple[Experiment, float]:
    """Return a simulated repetition of an experiment, and the fraction of its cycles that the fold used.

    The variance of the samples is that of the folded mean times the samples per independent value of that mean.
    """
    vector = problem.vector(theta)
    values = dict(zip(problem.model.parameters, problem.parameters(vector[None], e.name)[0].tolist(), strict=True))
    cycle = steady_cycle(
        problem.model, values, e.inputs, frequency=e.frequency, samples=e.samples, start=_first_state(problem, e)
    )
    limit, cycles = _fourier.highest_harmonic(e.samples), max(e.cycles, FEWEST_CYCLES)
    size = cycles * e.samples
    kept = {channel: e.harmonics.get(channel, limit) for channel in (*e.inputs, *e.outputs)}
    outputs = {}
    for channel in e.outputs:
        mean_variance = variances[_variance_name(problem, channel, e.name)]
        sd = np.sqrt(mean_variance * size / (2 * kept[channel] + 1))
        outputs[channel] = np.tile(cycle[channel], cycles) + sd * generator.standard_normal(size)
    recording = Recording(
        np.arange(size) / (e.samples * e.frequency),
        outputs,
        {channel: np.tile(signal, cycles) for channel, signal in e.inputs.items()},
        name=e.name,
        synthetic=True,
    )
    again = recording.fold(e.samples, frequency=e.frequency, harmonics=kept)
    return replace(again, independent=e.independent, guess=e.guess), again.cycles / cycles


def _first_state(problem: Problem, e: Experiment) -> dict[str, float]:
    """Return the states and rates at τ = 0 of the guess of an experiment; empty without a guess."""
    found = {}
    for state, values in e.guess.items():
        found[state] = float(values[0])
        if problem.model.orders[state] == 2:
            rate = _fourier.derivative(_fourier.coefficients(values), e.frequency)
            found[f"d{state}"] = float(_fourier.on_grid(rate, values.size)[0])
    return found


def _folded_variances(problem: Problem, variances: dict[str, float], used: list[float]) -> dict[str, float]:
    """Return the free variances of the folded means, which are larger if the fold left out cycles."""
    result = {}
    for name in problem.free_noise:
        fractions = [
            fraction
            for e, fraction in zip(problem.experiments, used, strict=True)
            for channel in e.outputs
            if _variance_name(problem, channel, e.name) == name
        ]
        result[name] = variances[name] / float(np.mean(fractions))
    return result


def _ranks(
    campaign: Campaign,
    experiments: list[Experiment],
    truth: dict[str, float],
    chain: np.random.Generator,
    ties: np.random.Generator,
) -> dict[str, Any]:
    """Return the ranks of the truth in the Laplace approximation and among the draws."""
    problem = campaign.problem.with_experiments(experiments)
    try:
        fit = map_estimate(problem, progress=False)
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        return {"status": "no estimate", "error": str(error)}
    found: dict[str, Any] = {"map": fit.status, "stop_rule": False}
    if fit.converged:
        found[LAPLACE] = _laplace_cdf(fit, truth)
    try:
        posterior = sample(
            problem, fit, seed=int(chain.integers(2**32)), ensembles=campaign.ensembles, walkers=campaign.walkers,
            max_steps=campaign.max_steps, progress=False,
        )  # fmt: skip
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        return found | {"status": "no draws", "error": str(error)}
    found |= {"stop_rule": posterior.converged, "rhat": max(posterior.rhat.values())}
    found["failed"] = sum(posterior.failures.values())
    draws = independent_draws(posterior)
    if not found["rhat"] <= LARGEST_RHAT or draws is None:
        return found | {"status": "draws not usable"}
    found["draws"] = len(next(iter(draws.values())))
    return found | {"status": DONE, MCMC: {name: position(draws[name], value, ties) for name, value in truth.items()}}


def independent_draws(posterior: Posterior) -> dict[str, np.ndarray] | None:
    """Return draws of every quantity at steps five autocorrelation times apart; None for fewer than 20."""
    tau, group = max(posterior.tau.values()), posterior.data["posterior"]
    if not np.isfinite(tau):
        return None
    chains, steps = group.sizes["chain"], group.sizes["draw"]
    kept = np.arange(steps - 1, -1, -int(np.ceil(SPACING * tau)))
    if chains * kept.size < FEWEST_DRAWS:
        return None
    return {name: posterior.draws(name).reshape(chains, steps)[:, kept].ravel() for name in posterior.names}


def position(draws: np.ndarray, truth: float, generator: np.random.Generator) -> float:
    """Return the randomised normalised rank of the truth, uniform on (0, 1) if draws and truth are exchangeable."""
    rank = np.sum(draws < truth) + generator.integers(np.sum(draws == truth) + 1)
    return float((rank + generator.uniform()) / (draws.size + 1))


def _laplace_cdf(fit: MapEstimate, truth: dict[str, float]) -> dict[str, float]:
    """Return the distribution functions of the Laplace approximation at the truth.

    Student's t of `MapEstimate.interval` for parameters, the joint approximation of the logarithm for variances.
    """
    found = {}
    with np.errstate(invalid="ignore", divide="ignore"):
        for name, value in truth.items():
            if name in fit.theta:
                distance = (value - fit.theta[name]) / fit.sd[name]
                found[name] = float(stdtr(min(fit.degrees_of_freedom, 1e9), distance))
            else:
                sd = np.sqrt(fit.joint_covariance[name].to_dict()[name])
                found[name] = float(ndtr(np.log(value / fit.joint_mode[name]) / sd))
    return found
