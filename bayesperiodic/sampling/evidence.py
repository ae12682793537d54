"""Evidence of a model, the density of the data that it predicts, by bridge sampling."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from scipy.integrate import IntegrationWarning, quad

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import covariance_cholesky, in_one_thread
from bayesperiodic.density.log_posterior import Evaluation, LogPosterior
from bayesperiodic.density.problem import Problem
from bayesperiodic.likelihood.noise import VARIANCE
from bayesperiodic.likelihood.section_points import SCALE
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.priors.joint import FromScipy, as_prior, as_written
from bayesperiodic.priors.single import LOG_ROOT_TWO_PI, Uniform
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.problem.parameters import CHAIN, DRAW, SHIFT, local_name
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.draws import Posterior, refuse_robust
from bayesperiodic.sampling.proposals import AffineTransform, fit_mixture

# Draws of the posterior and of the mixture for each of the two estimates.
DRAWS_EACH = 4000
EVIDENCE_TOLERANCE, MOST_ITERATIONS = 1e-10, 1000
# Warnings: fewer than 200 of the draws of the mixture where the posterior is; a posterior RARE times as dense as the
# mixture, or failed solves, at a fraction of the draws; difference of the two estimates in standard errors, which a
# normal one exceeds once in 370 times.
OVERLAP, RARE, FRACTION, DIFFERENT_ESTIMATES = 0.05, 100.0, 0.01, 3.0
# Deviation from one of the integral of a prior that is not of this package or SciPy.
INTEGRAL = 1e-3


@dataclass(frozen=True)
class Evidence(Result):
    """Evidence of a model: the probability density of the data with all parameters integrated out.

    Attributes
    ----------
    log, log_error : float
        Natural logarithm of the evidence, a density over the values of the data in their units, and its Monte Carlo
        standard error. The error does not include modes that the draws of the posterior have missed.
    halves : tuple of float
        The two estimates, whose mean is `log`: each from a mixture fitted to one half of the ensembles and the draws of
        the other half.
    overlap : float
        Of posterior p and mixture q, ∫ p q/(s p + (1 − s) q), s being the share of the posterior's effective draws
        among all: 1 if they are equal, 0 if they are apart.
    missed : float
        Fraction of the posterior's draws at which it is more than 100 times as dense as the mixture.
    failed : float
        Fraction of the draws of the mixture, within the priors, without a periodic solution; the density is zero there.
    data : dict of str to float
        Independent values behind each vector of data, by experiment and channel. Evidences of other data cannot be
        compared.
    improper : dict of str to str
        Noise parameters with an improper prior, and that prior in words. It leaves a constant of the evidence unknown,
        which cancels in the ratio of two evidences with the same channels and the same improper priors.
    notes : tuple of str
        Limitations, in words.
    fingerprint : str
        Digests of the parts of the problem (model, experiments, priors, constants, noise, scheme).

    Examples
    --------
    >>> found = bp.evidence(problem, posterior)
    >>> found.improper
    {'variance[displacement]': 'independent noise, Jeffreys prior 1/v'}
    """

    log: float
    log_error: float
    halves: tuple[float, float]
    overlap: float
    missed: float
    failed: float
    data: dict[str, float]
    improper: dict[str, str]
    notes: tuple[str, ...]
    fingerprint: str

    def __repr__(self) -> str:
        values = f"{sum(self.data.values()):.0f} independent values"
        lines = [f"Evidence: ln p(data) = {self.log:.2f} ± {self.log_error:.2g}, a density over {values}", *self.notes]
        return "\n".join(lines)


@in_one_thread
def evidence(problem: Problem, posterior: Posterior) -> Evidence:
    """Compute the evidence of a model, ∫ p(y|θ, φ) p(θ) p(φ) dθ dφ, from draws of its posterior.

    The data y are what the likelihood compares: of each channel N values of the mean period at equally spaced instants,
    N the number of its Fourier components kept (2·harmonics + 1), or its values at the points of a mask; ln|μ| of
    measured multipliers; the frequency [Hz] of an autonomous model. Constants such as (2π)^(−n/2), which
    `Problem.log_likelihood` leaves out, are included. If only n of N values are independent, the density is that of n
    values. The ratio of two evidences is the ratio of the probabilities that the models give to the same data: the
    experiments must be the same, with the same harmonics. It depends on the priors' widths, also where these hardly
    influence the estimates.

    Bridge sampling [1]_ [2]_ in the sampling coordinates: mixtures of Student t distributions are fitted to the draws
    of one half of the ensembles, and compared with the draws of the other half. The error is that of [3]_ with the
    effective sample size of ArviZ.

    Parameters
    ----------
    problem : Problem
    posterior : Posterior
        From any sampler, in any coordinates.

    Returns
    -------
    Evidence

    Raises
    ------
    ValueError
        For a posterior of another problem or without variation, a prior of a parameter that is not normalised, and an
        autonomous model whose phase has another prior than a uniform one over the period.
    RuntimeError
        If no draw of the mixture has a periodic solution.

    Warns
    -----
    UserWarning
        If the draws have not converged, the mixture misses a part of the posterior, or solves fail.

    References
    ----------
    .. [1] X.-L. Meng, W. H. Wong, Simulating ratios of normalizing constants via a simple identity: a theoretical
       exploration, Statistica Sinica 6 (1996) 831-860.
    .. [2] A. Gelman, X.-L. Meng, Simulating normalizing constants: from importance sampling to bridge sampling to path
       sampling, Statistical Science 13 (1998) 163-185.
    .. [3] S. Frühwirth-Schnatter, Estimating marginal likelihoods for mixture and Markov switching models using bridge
       sampling techniques, Econometrics Journal 7 (2004) 143-167.

    Examples
    --------
    >>> found = bp.evidence(problem, posterior)
    >>> found.log_error < 0.02, found.data
    (True, {'synthetic duffing: displacement': 11.0})
    """
    _checks.instance("problem", problem, Problem)
    problem = check_results(problem, posterior=posterior)
    refuse_robust(posterior)
    _check_phases(problem)
    for name, prior in _priors(problem):
        _check_normalised(name, prior)
    density, points = _anchored(problem, posterior)
    generator, constant = np.random.default_rng(posterior.seed), _constant(problem)
    first, second = (
        bridge(density, points[fitted::2], points[1 - fitted :: 2], constant, generator) for fitted in (0, 1)
    )
    improper = _improper(problem)
    result = Evidence(
        log=float(np.mean([first.log, second.log])),
        log_error=float(0.5 * np.hypot(first.error, second.error)),
        halves=(first.log, second.log),
        overlap=min(first.overlap, second.overlap),
        missed=max(first.missed, second.missed),
        failed=max(first.failed, second.failed),
        data=_data(problem),
        improper=improper,
        notes=tuple(_notes(problem, improper)),
        fingerprint=posterior.fingerprint,
    )
    alarms = _alarms(posterior, result, (first.error, second.error))
    for alarm in alarms:
        warnings.warn(f"The evidence is unreliable: {alarm}", stacklevel=3)
    return replace(result, notes=(*(f"Unreliable: {alarm}" for alarm in alarms), *result.notes))


def _anchored(problem: Problem, posterior: Posterior) -> tuple[LogPosterior, np.ndarray]:
    """Return the density anchored at the best draw, and draws (ensembles, steps, walkers, dimension)."""
    lp = posterior.tree["sample_stats"]["lp"].transpose(CHAIN, DRAW).to_numpy()
    values = np.stack([posterior.draws(name) for name in (*problem.names, *problem.free_noise)], axis=-1)
    theta, free = np.split(values, [len(problem.names)], axis=1)
    guesses = posterior.guesses([*problem.observations], problem.model.states)
    density = problem.anchored(theta[int(np.argmax(lp))], guesses).density()
    points = density.from_natural(theta, problem.likelihood.complete(free))
    return density, np.stack([posterior.by_step(column) for column in points.T], axis=-1)


class Evaluated(Protocol):
    """A density that is known up to a factor."""

    def evaluate(self, points: np.ndarray, threads: int | None) -> Evaluation:
        """Return the log-density at points (points, dimension)."""


@dataclass(frozen=True)
class Bridge:
    """One estimate of the log-evidence, see `Evidence`."""

    log: float
    error: float
    overlap: float
    missed: float
    failed: float


def bridge(
    density: Evaluated, fitted: np.ndarray, used: np.ndarray, constant: float, generator: np.random.Generator
) -> Bridge:
    """Return the estimate from a mixture fitted to some draws (ensembles, steps, walkers, dimension), and from others.

    The mixture is fitted in coordinates u in which the draws have mean 0 and covariance 1.
    """
    pooled = fitted.reshape(-1, fitted.shape[-1])
    dimension = pooled.shape[1]
    covariance = np.cov(pooled, rowvar=False).reshape(dimension, dimension)
    try:
        covariance_cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError("posterior: draws must vary in all directions; sample longer, see max_steps.") from None
    transform = AffineTransform.of(pooled.mean(axis=0), covariance)

    # Early and late halves of the ensembles apart, as the size of the mixture is chosen by the last of them.
    groups = [half.reshape(len(fitted), -1, dimension) for half in np.array_split(transform.whiten(fitted), 2, axis=1)]
    fewest = min(group.shape[1] for group in groups)
    mixture = fit_mixture(np.concatenate([group[:, :fewest] for group in groups]))
    thin = max(1, min(used.shape[1] // 4, -(-used[..., 0].size // DRAWS_EACH)))
    kept = transform.whiten(used[:, ::thin])
    constant = constant + float(np.linalg.slogdet(transform.axes)[1])

    def log_ratios(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        evaluation = density.evaluate(transform.unwhiten(u), threads=None)
        return evaluation.log_prob + constant - mixture.log_density(u), evaluation.status

    at_draws = log_ratios(kept.reshape(-1, dimension))[0].reshape(kept.shape[:-1])
    at_mixture, status = log_ratios(mixture.draw(DRAWS_EACH, generator))
    return _estimate(at_draws, at_mixture, float(np.mean(status != CONVERGED)))


def _estimate(at_draws: np.ndarray, at_mixture: np.ndarray, failed: float) -> Bridge:
    """Return the estimate from ln(posterior/mixture) at draws (ensembles, steps, walkers) and at those of the mixture.

    The posterior is not normalised. Its draws count as many as are effective.
    """
    if not np.isfinite(at_mixture).any():
        raise RuntimeError("posterior: no draw of the mixture fitted to it has a periodic solution. Sample longer.")
    chains = convergence.as_chains(at_draws)
    clipped = np.maximum(chains, chains[np.isfinite(chains)].min())
    size = np.nan_to_num(convergence.effective_size(clipped), nan=chains.size)
    share = np.log(size / (size + at_mixture.size)), np.log(at_mixture.size / (size + at_mixture.size))

    def terms(log: float) -> tuple[np.ndarray, np.ndarray]:
        both = [np.logaddexp(share[0] + ratio - log, share[1]) for ratio in (at_mixture, chains)]
        return np.exp(at_mixture - log - both[0]), np.exp(-both[1])

    log = float(np.median(clipped))
    for _ in range(MOST_ITERATIONS):
        above, below = terms(log)
        change = float(np.log(above.mean() / below.mean()))
        log += change
        if abs(change) < EVIDENCE_TOLERANCE:
            break
    above, below = terms(log)
    by_draws = np.nan_to_num(convergence.mean_error(below)) / below.mean()
    error = float(np.hypot(above.std() / above.mean() / np.sqrt(above.size), by_draws))
    missed = float(np.mean(chains - log > np.log(RARE)))
    return Bridge(log, error, float(above.mean()), missed, failed)


def _data(problem: Problem) -> dict[str, float]:
    """Return the independent values behind each vector of data."""
    observed = [block for block in problem.likelihood.blocks if block.observed]
    return {f"{b.experiment}: {b.channel}": b.count if b.counted else float(b.size) for b in observed}


def _constant(problem: Problem) -> float:
    """Return what the log-likelihood leaves out: −n/2 ln 2π, and the units of whitened values."""
    scales = sum(block.log_scale for block in problem.likelihood.blocks)
    return scales - sum(_data(problem).values()) * LOG_ROOT_TWO_PI


def _priors(problem: Problem) -> Iterator[tuple[str, Any]]:
    """Yield the priors that the evidence integrates over, with what messages call them; not the improper ones."""
    for key, prior in problem.priors.items():
        yield f"priors[{key!r}]", prior
    if problem.noise.proper and problem.free_noise:
        yield "noise: prior", as_prior("prior", problem.noise.prior)


def _check_normalised(argument: str, prior: Any) -> None:
    """Refuse a prior whose integral is not one; those of this package and of SciPy are known to be normalised."""
    built_in = not isinstance(prior, FromScipy) and type(prior).__module__.startswith("bayesperiodic.")
    if built_in or (isinstance(prior, FromScipy) and as_written(prior.distribution).startswith("scipy.stats.")):
        return
    ends = [prior.support[0], *prior.quantile(np.linspace(0.0, 1.0, 17)[1:-1]), prior.support[1]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IntegrationWarning)
        total = sum(quad(lambda x: np.exp(float(prior.log_prob(np.array(x)))), *pair)[0] for pair in pairwise(ends))
    if not abs(total - 1.0) < INTEGRAL:
        raise ValueError(
            f"{argument}: must be normalised for an evidence, got {prior!r} with the integral {total:.4g}. An "
            "improper prior leaves the evidence undefined; give a proper one, such as a wide Normal, and test how the "
            "result depends on its width."
        )


def _check_phases(problem: Problem) -> None:
    """Refuse an autonomous model whose phase, which counts from that of the data, is not integrated over the period."""
    for e in problem.experiments if problem.model.autonomous else ():
        prior = problem.priors.get(name := local_name(SHIFT, e.name))
        whole = isinstance(prior, Uniform) and abs((prior.high - prior.low) * e.frequency - 1.0) < INTEGRAL
        if not whole:
            raise ValueError(
                f"problem: {name!r} must have a uniform prior over one period for an evidence, got "
                f"{prior or 'a known value'}. It counts from the phase of the data, so that any other prior would use "
                "these twice; leave it out, and it has this prior."
            )


def _improper(problem: Problem) -> dict[str, str]:
    kind = f"{problem.noise.name} noise, {problem.noise.prior_text}"
    names = () if problem.noise.proper else problem.free_noise
    return {name: kind for name in names if name.startswith((VARIANCE, SCALE))}


def _notes(problem: Problem, improper: dict[str, str]) -> Iterator[str]:
    """Yield what limits the comparison of evidences."""
    yield f"It can be compared with evidences of the same data alone: {', '.join(_data(problem))}."
    yield "It is that of the modes that the draws have reached: with others, it would be larger."
    if improper:
        yield (
            f"The prior of {', '.join(improper)} is improper ({', '.join(dict.fromkeys(improper.values()))}): the "
            "evidence has an unknown constant, which cancels only in ratios to models with the same channels and the "
            "same improper priors."
        )
    if any(b.counted and abs(b.weight - 1.0) > 1e-9 for b in problem.likelihood.blocks):
        yield "Correlated values are counted as fewer independent ones, as in the likelihood."


def _alarms(posterior: Posterior, result: Evidence, errors: tuple[float, float]) -> list[str]:
    """Return the reasons not to rely on the evidence, in words; `errors` are those of the halves."""
    alarms, (first, second) = [], result.halves
    if not posterior.converged:
        alarms.append(f"the draws have not converged ({posterior.reason}). Sample longer, see max_steps.")
    if result.overlap < OVERLAP:
        alarms.append(f"posterior and mixture overlap by {result.overlap:.2g} alone (should be at least {OVERLAP}).")
    if result.missed > FRACTION:
        alarms.append(f"the mixture fitted to one half of the draws misses {result.missed:.1%} of the other half.")
    if abs(first - second) > DIFFERENT_ESTIMATES * np.hypot(*errors):
        alarms.append(
            f"the two halves of the ensembles give {first:.2f} ± {errors[0]:.2g} and {second:.2f} ± {errors[1]:.2g}. "
            "Sample longer, see max_steps."
        )
    if result.failed > FRACTION:
        alarms.append(
            f"{result.failed:.1%} of the points of the mixture have no periodic solution, and count as impossible."
        )
    return alarms
