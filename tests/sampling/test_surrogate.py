"""The surrogate of prior and normal likelihood, against quadrature, sums of independent variables, and derivatives."""

import emcee
import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.priors.joint import JointPrior
from bayesperiodic.sampling.moves import by_surrogate
from bayesperiodic.sampling.proposals import AffineTransform
from bayesperiodic.sampling.starts import laplace_approximation, surrogate_of
from bayesperiodic.sampling.surrogate import Surrogate
from tests.sampling.test_targets import QUIET, known, model, run

SUM, ERROR = 2.0, 0.1


def walked(log_prob, starts, move, steps):
    """Return the chain (steps, walkers, dimension) after its first tenth."""
    sampler = emcee.EnsembleSampler(*starts.shape, log_prob, moves=[(move, 1.0)], vectorize=True)
    state = emcee.State(starts, random_state=np.random.RandomState(1).get_state())
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    return sampler.get_chain(discard=steps // 10)


def test_a_wrong_surrogate_leaves_the_density_unchanged():
    """A + b = 2 ± 0.1 with log-normal priors, the surrogate's sum 2.1 ± 0.15: the distribution of a by quadrature.

    Kolmogorov's distance of draws with the stated number of independent ones; false-alarm rate 1e-4. Without the volume
    of the logarithms, or without the surrogate's densities, it is several times larger.
    """
    priors = {"a": bp.LogNormal(1.0, 1.0), "b": bp.LogNormal(0.7, 0.8)}

    def log_density(theta):  # but for a constant
        z = np.log(theta / [1.0, 0.7]) / [1.0, 0.8]
        return -0.5 * ((theta.sum(axis=-1) - SUM) / ERROR) ** 2 - (0.5 * z**2 + np.log(theta)).sum(axis=-1)

    wrong, both = np.ones((2, 2)) / 0.15**2, np.array([True, True])
    surrogate = Surrogate(
        JointPrior.of(priors, priors), both, np.array([1.1, 1.0]), np.zeros(2), wrong,
        np.linalg.cholesky(np.linalg.inv(wrong + np.eye(2))),
    )  # fmt: skip
    transform = AffineTransform(np.array([0.1, -0.2]), np.array([[0.5, 0.1], [0.0, 0.4]]))

    def log_prob(u):
        x = transform.unwhiten(u)
        return log_density(np.exp(x)) + x.sum(axis=1)

    starts = transform.whiten(np.log([1.0, 1.0] + 0.2 * np.random.default_rng(3).uniform(-1, 1, (100, 2))))
    move = by_surrogate(surrogate, transform, 1.0)
    chain = walked(log_prob, starts, move, 1500)
    a = np.exp(transform.unwhiten(chain)[..., 0])
    tau = emcee.autocorr.integrated_time(a)[0]
    assert 0.3 < move.accepted / move.proposed < 1.0 and tau < 10.0
    at = np.linspace(1e-3, 2.6, 1500)
    density = np.exp(log_density(np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1))).sum(axis=1)
    cdf = np.cumsum(density) / density.sum()
    distance = stats.kstest(a.ravel(), lambda values: np.interp(values, at, cdf)).statistic
    assert distance < 2.23 * np.sqrt(tau / a.size) + 1e-3


def collinear(count, sums, sd, prior):
    """Return a problem whose outputs are sums of `count` parameters each, known up to `sd`, and its estimate."""
    names = [f"p{k}" for k in range(count * len(sums))]
    groups = {f"y{g}": names[g * count : (g + 1) * count] for g in range(len(sums))}
    added = model(
        f"sums{count}x{len(sums)}", names,
        lambda p: {channel: sum(getattr(p, name) for name in each) for channel, each in groups.items()},
    )  # fmt: skip
    problem = bp.Problem(
        added, [run(**dict(zip(groups, sums, strict=True)))], priors=dict.fromkeys(names, prior),
        fixed=known(**dict.fromkeys(groups, sd)), input_noise="exact",
    )  # fmt: skip
    return problem, bp.map_estimate(problem, start=dict.fromkeys(names, sums[0] / count), **QUIET)


@pytest.mark.filterwarnings("ignore")
def test_slope_and_curvature_at_the_mode_are_those_of_the_density():
    problem, fit = collinear(3, (4.0, 5.0), 0.15, bp.LogNormal(1.0, 0.5))
    density = problem.anchored(
        problem.vector(fit.theta), {name: one.states for name, one in fit.solutions.items()}
    ).density(variances="collapsed")
    surrogate, (mode, _) = surrogate_of(density, fit), laplace_approximation(density, fit)
    assert surrogate.logarithmic.all()

    def by_surrogate(x):
        return float(surrogate.log_density(surrogate.values(x[None]))[0] + x.sum())

    def derivatives(function, step=1e-3):
        steps = step * np.eye(mode.size)
        slope = [(function(mode + h) - function(mode - h)) / (2 * step) for h in steps]
        curvature = [
            [
                (function(mode + h + k) - function(mode + h - k) - function(mode - h + k) + function(mode - h - k))
                / (4 * step**2)
                for k in steps
            ]
            for h in steps
        ]
        return np.array(slope), np.array(curvature)

    exact = derivatives(lambda x: density.evaluate(x[None]).log_prob[0])
    slope, curvature = derivatives(by_surrogate)
    assert slope == pytest.approx(exact[0], abs=0.05)
    assert curvature == pytest.approx(exact[1], rel=1e-3, abs=0.8)
    y = surrogate.values(mode + 0.1 * np.random.default_rng(0).standard_normal((5, mode.size)))
    numeric = [
        [
            (surrogate.log_density((one + h)[None])[0] - surrogate.log_density((one - h)[None])[0]) / 2e-6
            for h in 1e-6 * np.eye(mode.size)
        ]
        for one in y
    ]
    assert surrogate.gradient(y) == pytest.approx(np.array(numeric), rel=1e-5, abs=1e-4)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("sums", [(9.0, 25.0), (9.0, 16.0, 25.0)])
def test_ten_parameters_to_each_sum_that_the_data_determine(sums):
    """Each has the density p(a)·f(S − a), f being that of the sum of nine others and of the noise, by convolution.

    Kolmogorov's distances of 20 and 30 parameters: false-alarm rate 1e-3.
    """
    problem, fit = collinear(10, sums, 0.05, bp.LogNormal(1.0, 1.0))
    posterior = bp.sample(problem, fit, seed=1, ensembles=2, max_steps=6000, **QUIET)
    assert posterior.converged, posterior.reason
    assert min(posterior.ess.values()) > 0.02 * posterior.log_posterior_calls
    step = 5e-3
    at = step * np.arange(1, 2**14)
    prior = stats.lognorm(1.0).pdf(at) * step
    prior[0] += stats.lognorm(1.0).cdf(0.5 * step)
    nine = np.fft.irfft(np.fft.rfft(np.append(0.0, prior), 2**16) ** 9)
    kernel = stats.norm(0.0, 0.05).pdf(step * np.arange(-100, 101)) * step
    nine = np.convolve(nine, kernel)[100:-100]
    for group, total in enumerate(sums):
        places = np.arange(1, round(total / step))
        density = prior[places - 1] * nine[round(total / step) - places]
        cdf = np.cumsum(density) / density.sum()
        for k in range(10 * group, 10 * group + 10):
            draws = posterior.draws(f"p{k}")
            distance = stats.kstest(draws, lambda v, c=cdf, x=places * step: np.interp(v, x, c)).statistic
            assert distance < 2.3 / np.sqrt(posterior.ess[f"p{k}"]) + 2e-3, (k, distance)


@pytest.mark.filterwarnings("ignore")
def test_no_surrogate_where_the_prior_has_no_curvature(monkeypatch):
    problem, fit = collinear(3, (4.0, 5.0), 0.15, bp.LogNormal(1.0, 0.5))
    density = problem.anchored(
        problem.vector(fit.theta), {name: one.states for name, one in fit.solutions.items()}
    ).density(variances="collapsed")
    assert surrogate_of(density, fit) is not None
    monkeypatch.setattr(JointPrior, "curvature", lambda self, theta: np.full((theta.size, theta.size), np.nan))
    assert surrogate_of(density, fit) is None
