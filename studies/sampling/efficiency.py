"""Effective samples per density evaluation and per second, by `bp.sample` and by samplers of other packages.

All sample the same density over parameters and unknown variances, the prior of variances being 1/v, and start from
draws of the Laplace approximation. emcee's default move has natural parameters and starts from a small ball, as in its
tutorial; the others have logarithms of positive parameters. dynesty takes the priors' quantile functions, and for 1/v,
which is improper, the log-uniform distribution within a factor of 100 of the estimate. Ensembles are evaluated in
blocks on all cores, other samplers point by point. zeus 2.5.4 runs with NumPy 2.4 and is compared if it is installed.
pocoMC 1.2.6 runs too, but spends minutes on training networks of PyTorch, and is left out.
"""

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import emcee
import numpy as np

import bayesperiodic as bp
from studies.benchmark.problems import duffing
from studies.damper import run as damper
from studies.gear import GEAR, gear_problem
from studies.sampling import ridge as sampling_ridge
from studies.timing import timed

ENSEMBLES, WALKERS, LIVE, REPLICAS = 4, 32, 500, 20
BALL = 0.1
LONG = 50.0  # Autocorrelation times; shorter runs have no verdict
DAMPER, DUFFING, RIDGE = "damper", "Duffing", "ridge"
OURS = ("bp.sample", "bp.sample, collapsed", "NUTS")
EVOLUTION = [(emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)]


class Case:
    """A posterior density, anchored at its MAP estimate, with its Laplace approximation in sampling coordinates."""

    def __init__(self, problem: bp.Problem, fit: bp.MapEstimate | None = None):
        self.fit = fit or bp.map_estimate(problem, progress=False)
        guesses = {name: solution.states for name, solution in self.fit.solutions.items()}
        self.problem, self.names = problem.anchored(self.fit.theta, guesses), [*problem.names, *problem.free_noise]
        self.positive = np.append(problem.logarithmic, np.ones(len(problem.free_noise), dtype=bool))
        self.mode = np.array([self.fit.joint_mode[name] for name in self.names])
        self.covariance = self.fit.joint_covariance.loc[self.names, self.names].to_numpy()

    def starts(self, size: int, generator: np.random.Generator, sd: float = 1.0) -> np.ndarray:
        """Return draws (size, names) of the Laplace approximation with `sd` times its sds, in natural values."""
        centre = np.log(self.mode, out=self.mode.copy(), where=self.positive)
        drawn = generator.multivariate_normal(centre, sd**2 * self.covariance, size)
        return np.exp(drawn, out=drawn, where=self.positive)


class Target:
    """The density over natural parameters or logarithms of positive ones, with the number of evaluations."""

    def __init__(self, case: Case, coordinates: str = "ridge"):
        self.density, self.calls = case.problem.density(coordinates=coordinates), 0
        self.logarithmic = case.positive.copy()
        self.logarithmic[: len(case.problem.names)] = self.density.logarithmic

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the log-density at points (points, names)."""
        self.calls += len(points)
        return self.density.evaluate(points, None if len(points) > 1 else 1).log_prob

    def run(self, sample: Callable[[], list[np.ndarray]], steps: int) -> "Run":
        """Time a sampler that returns chains (steps, walkers, names), and remove the first quarter."""
        chains, seconds = timed(sample)
        values = np.stack(chains)[:, steps // 4 :]
        natural = np.exp(values, out=values, where=self.logarithmic)
        return Run(natural, self.calls, seconds, f"{steps} steps, the first quarter removed")


@dataclass(frozen=True)
class Run:
    """The draws of a sampler in natural values."""

    values: np.ndarray  # (ensembles, steps, walkers, names)
    calls: int  # Density evaluations, with those of the burn-in or tuning; gradients of NUTS
    seconds: float
    reason: str
    converged: bool | None = None  # By the stop rule of `bp.sample` or of dynesty
    # Weights (draws,) of nested sampling, and realisations of its errors: draws (…, names) and their weights.
    weights: np.ndarray | None = None
    replicas: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    @cached_property
    def length(self) -> float:
        """Length in the longest autocorrelation times; of nested sampling infinite, or zero if it was stopped."""
        if self.weights is not None:
            return np.inf if self.converged else 0.0
        times = [emcee.autocorr.integrated_time(e, tol=0, quiet=True, has_walkers=True) for e in self.values]
        return float(self.values.shape[1] / np.max(np.mean(times, axis=0)))

    @cached_property
    def ess(self) -> float:
        """Smallest effective sample size: ArviZ's of chains as in `Posterior.tree`, or Kish's of weights."""
        import arviz

        if self.weights is not None:
            return float(1.0 / np.sum(self.weights**2))
        halves = np.split(self.values, [self.values.shape[1] // 2], axis=1)
        chains = np.concatenate([h.swapaxes(1, 2).reshape(len(h), -1, h.shape[-1]) for h in halves], axis=1)
        return min(float(arviz.ess(x, method="bulk")) for x in np.moveaxis(chains, -1, 0))

    def moments(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Return mean and sd of every quantity with their Monte Carlo errors, from batches or replicas.

        What a draw contributes to the sd is, to first order, ((x − mean)² − sd²)/(2 sd).
        """
        mean, sd = _weighted(self.values.reshape(-1, len(names)), self.weights)
        if self.weights is None:
            parts = self.values, (self.values - mean) ** 2 / (2.0 * sd)
            errors = [list(map(sampling_ridge.standard_error, np.moveaxis(part, -1, 0))) for part in parts]
        else:
            errors = np.std([_weighted(*replica) for replica in self.replicas], axis=0).tolist()
        keys, table = ("mean", "sd", "mean_error", "sd_error"), np.transpose([mean, sd, *errors]).tolist()
        return {name: dict(zip(keys, row, strict=True)) for name, row in zip(names, table, strict=True)}

    def account(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the entry of results.json."""
        found = {key: getattr(self, key) for key in ("converged", "reason", "length", "seconds")}
        found |= {"evaluations": self.calls, "ess_min": self.ess, "ess_per_second": self.ess / self.seconds}
        return found | {"ess_per_1000": 1e3 * self.ess / self.calls, "moments": self.moments(names)}


def _weighted(values: np.ndarray, weights: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    mean = np.average(values, axis=0, weights=weights)
    return mean, np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weights))


def _own(case: Case, seed: int, steps: int, **options: Any) -> Run:
    sample = partial(bp.sample, case.problem, case.fit, seed=seed, max_steps=steps, progress=False, **options)
    posterior, seconds = timed(sample)
    values = np.stack([posterior.by_step(posterior.draws(name)) for name in case.names], axis=-1)
    return Run(values, posterior.log_posterior_calls, seconds, posterior.reason, posterior.converged)


def _ensembles(
    case: Case, seed: int, steps: int, *, module: str = "emcee", coordinates: str = "ridge", **options: Any
) -> Run:
    """Run independent ensembles of emcee or zeus, whose interfaces are the same, one after the other."""
    target, generator = Target(case, coordinates), np.random.default_rng(seed)
    sampler_of = importlib.import_module(module).EnsembleSampler

    def one(number: int) -> np.ndarray:
        np.random.seed(ENSEMBLES * seed + number)  # noqa: NPY002 (the generator of both)
        start = case.starts(WALKERS, generator, BALL if coordinates == "natural" else 1.0)
        start = np.log(start, out=start, where=target.logarithmic)
        sampler = sampler_of(*start.shape, target, vectorize=True, **options)
        sampler.run_mcmc(start, steps, progress=False)
        return sampler.get_chain()

    return target.run(lambda: list(map(one, range(ENSEMBLES))), steps)


def _pints(case: Case, seed: int, steps: int) -> Run:
    """Run PopulationMCMC with its ten temperatures; the Laplace approximation's covariance is the first proposal's."""
    import pints

    target = Target(case)

    class Density(pints.LogPDF):
        def n_parameters(self) -> int:
            return len(case.names)

        def __call__(self, x: Any) -> float:
            return float(target(np.array(x)[None])[0])

    starts = case.starts(ENSEMBLES, np.random.default_rng(seed))
    starts = np.log(starts, out=starts, where=target.logarithmic)
    np.random.seed(seed)  # noqa: NPY002 (PINTS draws from the global generator)
    method = pints.PopulationMCMC
    controller = pints.MCMCController(Density(), ENSEMBLES, [*starts], case.covariance, method=method)
    controller.set_max_iterations(steps)
    controller.set_log_to_screen(False)
    return target.run(lambda: [*np.asarray(controller.run())[:, :, None]], steps)


def _dynesty(case: Case, seed: int, calls: int) -> Run:
    """Run dynamic nested sampling, by default weighted towards the posterior, with at most so many evaluations."""
    import dynesty
    from dynesty.utils import jitter_run, resample_run

    problem, size, generator = case.problem, len(case.problem.names), np.random.default_rng(seed)

    def transform(u: np.ndarray) -> np.ndarray:
        theta = [problem.priors[name].quantile(p) for name, p in zip(problem.names, u[:size], strict=True)]
        return np.append(theta, case.mode[size:] * 100.0 ** (2.0 * u[size:] - 1.0))

    def log_likelihood(x: np.ndarray) -> float:
        noise = problem.noise_values(dict(zip(problem.free_noise, x[size:], strict=True)))
        return float(problem.log_likelihood(x[:size], noise, threads=1))

    sampler = dynesty.DynamicNestedSampler(log_likelihood, transform, len(case.names), nlive=LIVE, rstate=generator)
    _, seconds = timed(partial(sampler.run_nested, maxcall=calls, print_progress=False))
    found = sampler.results
    others = [jitter_run(resample_run(found, generator), generator) for _ in range(REPLICAS)]
    replicas = tuple((one.samples, one.importance_weights()) for one in others)
    values, count = found.samples[None, :, None], int(np.sum(found.ncall))
    ended, reason = count < calls, f"{LIVE} live points, at most {calls} evaluations"
    return Run(values, count, seconds, reason, ended, found.importance_weights(), replicas)


class Contender(NamedTuple):
    """A sampler."""

    run: Callable[..., Run]
    steps: tuple[int, int]  # In a full and in a quick run
    package: str = "emcee"


CONTENDERS = {
    OURS[0]: Contender(_own, (20_000, 150)),
    OURS[1]: Contender(partial(_own, variances="collapsed"), (20_000, 150)),
    OURS[2]: Contender(partial(_own, sampler="nuts"), (20_000, 250), "nutpie"),
    "emcee": Contender(partial(_ensembles, coordinates="natural"), (4500, 200)),
    "emcee, DE": Contender(partial(_ensembles, moves=EVOLUTION), (2000, 200)),
    "zeus": Contender(partial(_ensembles, module="zeus", verbose=False), (700, 40), "zeus"),
    "PINTS, population": Contender(_pints, (20_000, 2000), "pints"),
    "dynesty": Contender(_dynesty, (300_000, 5000), "dynesty"),
}


def cases(data: Path | None, seed: int, quick: bool) -> tuple[dict[str, Case], dict[str, Any]]:
    """Return the cases, of a quick run the damper and the ridge, and a description of the damper's data."""
    recording, about = damper.read_recording(data, seed)
    problem = bp.Problem(bp.models.dahl, [recording.fold()], priors=damper.PRIORS, input_noise="exact")
    found = {DAMPER: Case(problem)}
    if not quick:
        setting, gear = duffing(1, seed, cut=True), gear_problem("displacement", seed, runs=2)
        start = {name: GEAR[name] for name in gear.names}
        found[DUFFING] = Case(setting.problem, setting.fit)
        found["landing gear"] = Case(gear, bp.map_estimate(gear, start=start, progress=False))
    return found | {RIDGE: Case(sampling_ridge.ridge_problem(sampling_ridge.CUT))}, about


def sample_all(case: Case, seed: int, quick: bool) -> dict[str, Run | str]:
    """Return the run of every contender, or the reason why there is none."""
    found: dict[str, Run | str] = {}
    for name, contender in CONTENDERS.items():
        if importlib.util.find_spec(contender.package) is None:
            found[name] = f"{contender.package} is not installed"
        elif name == OURS[1] and not case.problem.free_noise:
            found[name] = "no unknown variance to integrate out"
        else:
            run = found[name] = contender.run(case, seed, contender.steps[quick])
            print(f"  {name}: {run.calls} evaluations, {run.seconds:.0f} s, {run.ess:.0f} effective; {run.reason}")
    return found
