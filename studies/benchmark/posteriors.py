"""Effective samples per second from the posterior of the Duffing oscillator, by this package and by other samplers.

The unknown variance is integrated out (Jeffreys' prior) or sampled; the posterior of the parameters is the same. emcee
in natural coordinates runs once, with the fastest log-posterior. With the others its chain would be the same, because
the densities agree, so that its effective samples per log-posterior are divided by their time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import emcee
import numpy as np

import bayesperiodic as bp
from studies.benchmark import peers
from studies.benchmark.integration import LOOSE, Method
from studies.benchmark.problems import Setting
from studies.timing import timed

WALKERS, STEPS = 16, 1500
PINTS_SAMPLERS = ("HaarioBardenetACMC", "DreamMCMC")
PINTS_CHAINS, PINTS_STEPS = 4, 4000
WARMUP, DRAWS = 30, 60
COLLAPSED = {"variances": "collapsed", "max_steps": 750}
OWN: dict[str, dict[str, Any]] = {
    "sample, default": {"max_steps": 750},
    "sample, variances integrated out": COLLAPSED,
    "sample, variances integrated out, 2 × 64 walkers": COLLAPSED | {"ensembles": 2, "walkers": 64},
    "sample, NUTS": {"sampler": "nuts", "ensembles": 2, "max_steps": 250},
}
NUMPYRO = "numpyro NUTS around diffrax"

Density = Callable[[np.ndarray], float]


def measure(setting: Setting, contest: Mapping[str, Any], methods: Sequence[Method], seed: int) -> dict[str, Any]:
    """Return the samplers, and emcee with every timed method.

    `setting`: Has one channel, all harmonics, and positive parameters that are the model's own. `contest`: Result of
    `contenders.measured`. `methods`: Those of the fastest method, one per experiment.
    """
    walked = _emcee(setting, methods, seed)
    found = {name: _own(setting, seed, options) for name, options in OWN.items()}
    found |= {f"PINTS {name}, this package's density": _pints(setting, name, seed) for name in PINTS_SAMPLERS}
    found[NUMPYRO] = _numpyro(setting, methods, seed)
    times = {
        row["name"]: row["milliseconds"]["median"]
        for row in contest["rows"]
        if row["milliseconds"] and "gradient" not in row["name"] and "batched" not in row["name"]
    }
    around = {
        name: {"ess_per_second": 1e3 * walked["ess_per_log_posterior"] / milliseconds, "milliseconds": milliseconds}
        for name, milliseconds in times.items()
    }
    return {"samplers": found, "emcee": walked, "emcee_around": around, "split": _split(found, walked, around)}


def _split(found: Mapping[str, Any], walked: Mapping[str, Any], around: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ratio of this package's best sampler to emcee with each method, split into sampler and solver."""
    measured = [name for name in OWN if "ess_per_second" in found.get(name, {})]
    best = max(measured, key=lambda name: found[name]["ess_per_second"])
    own = found[best]
    against = {
        name: {
            "ratio": own["ess_per_second"] / entry["ess_per_second"],
            "sampler": own["ess_per_log_posterior"] / walked["ess_per_log_posterior"],
            "solver": 1e-3 * entry["milliseconds"] / (own["seconds"] / own["log_posteriors"]),
        }
        for name, entry in around.items()
    }
    return {"best": best, "against": against}


def effective(chains: np.ndarray) -> float:
    """Return the smallest effective sample size of chains (steps, chains, coordinates), by emcee's autocorrelation."""
    tau = emcee.autocorr.integrated_time(chains, quiet=True)
    return float(chains.shape[0] * chains.shape[1] / np.max(tau))


def _account(ess: float, seconds: float, calls: int) -> dict[str, Any]:
    per = {"ess_per_second": ess / seconds, "ess_per_log_posterior": ess / calls}
    return {"ess": ess, "seconds": seconds, "log_posteriors": calls} | per


def collapsed(setting: Setting, ways: Sequence[Density]) -> Density:
    """Return ln p(θ) − n/2 ln M(θ), M the sum of squared residuals, from log-likelihoods at known variances."""
    count = sum(case.experiment.samples for case in setting.cases)

    def density(theta: np.ndarray) -> float:
        prior = setting.log_prior(theta)
        if not np.isfinite(prior):
            return -np.inf
        squares = 0.0
        for case, way in zip(setting.cases, ways, strict=True):
            squares += (case.constant - way(setting.parameters(theta, case)[0])) / case.weights[0]
        return prior - 0.5 * count * np.log(squares) if np.isfinite(squares) else -np.inf

    return density


def _emcee(setting: Setting, methods: Sequence[Method], seed: int) -> dict[str, Any]:
    """Run emcee in natural coordinates as in its tutorial; a quarter of the steps is burn-in."""
    exact = [replace(method, setting=LOOSE) for method in methods]  # Walkers move further out than the draws.
    density, generator = collapsed(setting, exact), np.random.default_rng(seed)
    sd = np.array(list(setting.fit.sd.values()))
    start = setting.estimate + 0.1 * sd * generator.standard_normal((WALKERS, sd.size))
    sampler = emcee.EnsembleSampler(WALKERS, sd.size, density)
    sampler.random_state = np.random.RandomState(seed).get_state()
    _, seconds = timed(partial(sampler.run_mcmc, start, STEPS))
    return _account(effective(sampler.get_chain(discard=STEPS // 4)), seconds, WALKERS * STEPS)


def _own(setting: Setting, seed: int, options: Mapping[str, Any]) -> dict[str, Any]:
    if options.get("sampler") == "nuts" and (note := peers.missing("nutpie")):
        return {"note": note}
    posterior, seconds = timed(partial(bp.sample, setting.problem, setting.fit, seed=seed, progress=False, **options))
    ess = min(posterior.draws(name).size / posterior.tau[name] for name in setting.problem.names)  # As of the others.
    return _account(ess, seconds, posterior.log_posterior_calls) | {"note": posterior.reason}


def _pints(setting: Setting, name: str, seed: int) -> dict[str, Any]:
    """Run a sampler of PINTS on this package's density over θ and the logarithm of the variance."""
    if note := peers.missing("pints"):
        return {"note": note}
    import pints

    warm, size = setting.problem.anchored(setting.fit.theta), len(setting.problem.names)
    calls = 0

    class Posterior(pints.LogPDF):
        def n_parameters(self) -> int:
            return size + 1

        def __call__(self, x: Any) -> float:
            nonlocal calls
            calls += 1
            return float(warm.log_posterior(np.array(x[:size]), np.exp(np.array(x[size:]))))

    generator = np.random.default_rng(seed)
    sd = np.append(list(setting.fit.sd.values()), 0.05)
    centre = np.append(setting.estimate, np.log(setting.noise))
    starts = centre + 0.1 * sd * generator.standard_normal((PINTS_CHAINS, size + 1))
    np.random.seed(seed)  # noqa: NPY002 (PINTS draws from the global generator)
    controller = pints.MCMCController(Posterior(), PINTS_CHAINS, list(starts), sd, method=getattr(pints, name))
    controller.set_max_iterations(PINTS_STEPS)
    controller.set_log_to_screen(False)
    chains, seconds = timed(controller.run)
    kept = np.moveaxis(np.asarray(chains)[:, PINTS_STEPS // 4 :, :size], 0, 1)
    return _account(effective(kept), seconds, calls)


def _numpyro(setting: Setting, methods: Sequence[Method], seed: int) -> dict[str, Any]:
    """Run numpyro's NUTS along the axes of the Laplace approximation; neither compilation nor tuning is timed."""
    if note := peers.missing(*peers.NEEDED, "numpyro"):
        return {"note": note}
    import jax
    from numpyro.infer import MCMC, NUTS

    tuned = [peers.Integrated(method.discretised, 1e-6) for method in methods]
    centre, factor = np.log(setting.estimate), _axes(setting)
    kernel = NUTS(potential_fn=_potential(setting, tuned, centre, factor), adapt_mass_matrix=False)
    run = MCMC(kernel, num_warmup=WARMUP, num_samples=DRAWS, progress_bar=False)
    start = np.zeros(centre.size)
    run.warmup(jax.random.PRNGKey(seed), init_params=start, extra_fields=("num_steps",), collect_warmup=False)

    def sample() -> np.ndarray:
        run.run(run.post_warmup_state.rng_key, init_params=start, extra_fields=("num_steps",))
        return np.exp(centre + np.asarray(run.get_samples()) @ factor.T)

    draws, seconds = timed(sample)
    calls = int(np.sum(run.get_extra_fields()["num_steps"]))
    return _account(effective(draws[:, None, :]), seconds, calls) | {"note": "without compilation and tuning"}


def _axes(setting: Setting) -> np.ndarray:
    """Return a square root of the Laplace approximation's covariance of ln θ."""
    names = list(setting.problem.names)
    covariance = np.asarray(setting.fit.covariance.loc[names, names], dtype=float)
    return np.linalg.cholesky(covariance / np.outer(setting.estimate, setting.estimate))


def _potential(
    setting: Setting, tuned: Sequence[peers.Integrated], middle: np.ndarray, factor: np.ndarray
) -> Callable[[Any], Any]:
    """Return minus the log-density over z, traced by JAX, ln θ = middle + factor · z; priors are log-normal."""
    import jax.numpy as jnp

    priors = [setting.problem.priors[name] for name in setting.problem.names]
    centre = np.log([prior.median for prior in priors])
    spread = np.array([prior.spread for prior in priors])
    value = peers.traced(setting.problem.model).log_likelihood
    count = sum(case.experiment.samples for case in setting.cases)

    def potential(z: Any) -> Any:
        x, squares = middle + factor @ z, 0.0
        for case, one in zip(setting.cases, tuned, strict=True):
            p = jnp.asarray(case.estimate).at[jnp.asarray(one.discretised.columns)].set(jnp.exp(x))
            squares = squares - value(p, *one.parts) / case.weights[0]
        return 0.5 * count * jnp.log(squares) + 0.5 * jnp.sum(((x - centre) / spread) ** 2)

    return potential
