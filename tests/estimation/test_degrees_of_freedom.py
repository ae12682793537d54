"""Bias correction and degrees of freedom where the values behind several variances differ in number."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic import noise
from bayesperiodic.estimation.gauss_newton import Iterate, bias_correction
from tests.known import formula_model, grid

POINTS, DATA_SETS, SD = 64, 200, 0.1
X = np.cos(2 * np.pi * grid(POINTS)) + 0.5 * np.sin(4 * np.pi * grid(POINTS))
RATE = 2 * np.pi * 0.2 * (-np.sin(2 * np.pi * grid(POINTS)) + np.cos(4 * np.pi * grid(POINTS)))
BAND = stats.binom.ppf([0.005, 0.995], DATA_SETS, 0.9)

# Each of two channels alone tells about one parameter; both tell about the parameters of the second model.
APART = formula_model("apart", ["a", "b"], lambda p, u, s: {"A": p.a * u.x, "B": p.b * u.x})
TOGETHER = formula_model("together", ["a", "b"], lambda p, u, s: {"A": p.a * u.x + p.b * u.dx, "B": p.a * u.x})
ALIKE = formula_model("alike", ["a", "b"], lambda p, u, s: {"A": p.a * u.x + p.b * u.dx, "B": p.a * u.x + p.b * u.dx})
DESIGNS = {
    APART: (np.stack([X, 0 * X]), np.stack([0 * X, X])),
    TOGETHER: (np.stack([X, RATE]), np.stack([X, 0 * X])),
    ALIKE: (np.stack([X, RATE]), np.stack([X, RATE])),
}
FLAT = {"a": bp.Normal(1.0, 1e4), "b": bp.Normal(1.0, 1e4)}


def within(signals: np.ndarray, harmonics: int) -> np.ndarray:
    """Return signals (…, points) without the higher harmonics."""
    amplitudes = np.fft.rfft(signals)
    amplitudes[..., harmonics + 1 :] = 0.0
    return np.fft.irfft(amplitudes, POINTS)


def experiment(model: bp.Model, seed: int, harmonics: tuple[int, int], truth=(1.0, 1.0)) -> bp.Experiment:
    """Return an experiment whose channels keep 2·harmonics + 1 values, each with an error of standard deviation SD."""
    generator, outputs = np.random.default_rng(seed), {}
    for channel, highest, design in zip("AB", harmonics, DESIGNS[model], strict=True):
        white = generator.standard_normal(POINTS) * np.sqrt(POINTS / (2 * highest + 1))
        outputs[channel] = within(np.array(truth) @ design + SD * white, highest)
    kept = dict(zip("AB", harmonics, strict=True))
    return bp.Experiment("run", 0.2, outputs, {"x": X}, samples=POINTS, harmonics=kept | {"x": 2})


def fitted(
    model: bp.Model, run: bp.Experiment, priors=FLAT, *, checks=True, **changes
) -> tuple[bp.MapEstimate, bp.Problem]:
    problem = bp.Problem(model, [run], priors=priors, scheme="fourier", **changes)
    return bp.map_estimate(problem, starts=1, checks=checks, progress=False), problem  # linear


def parts(model: bp.Model, fit: bp.MapEstimate, harmonics: tuple[int, int]) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the information of each channel from its regressors, and the covariance without priors."""
    found = []
    for channel, highest, design in zip("AB", harmonics, DESIGNS[model], strict=True):
        columns = within(design, highest) * np.sqrt((2 * highest + 1) / POINTS)
        found.append(columns @ columns.T / fit.noise_split[channel].total ** 2)
    return found, np.linalg.inv(sum(found))


@pytest.mark.parametrize("harmonics", [(2, 30), (1, 30), (4, 4)])
def test_parameter_of_one_channel_has_the_degrees_of_freedom_of_its_regression(harmonics):
    """One parameter of N values: v = M/(N − 1), and t with N − 1 degrees of freedom, whatever the other channel has."""
    run = experiment(APART, 1, harmonics)
    fit, _ = fitted(APART, run)
    for channel, name, highest in zip("AB", "ab", harmonics, strict=True):
        count = 2 * highest + 1
        square = np.mean((run.outputs[channel] - fit.theta[name] * within(X, highest)) ** 2) * count
        assert fit.noise_split[channel].total ** 2 == pytest.approx(square / (count - 1), rel=1e-5)
        assert fit.degrees_of_freedom[name] == pytest.approx(count - 1, rel=1e-4)
        low, high = fit.interval(0.9)[name]
        assert (high - low) / 2 / fit.sd[name] == pytest.approx(stats.t.ppf(0.95, count - 1), rel=1e-4)


@pytest.mark.parametrize("harmonics", [(3, 20), (20, 3)])
def test_parameter_of_two_channels_has_those_of_satterthwaite(harmonics):
    """From the regressors: p = tr(F C) of each channel, and (Σ s)²/Σ s²/(n − p) with s the diagonal of C F C."""
    fit, _ = fitted(TOGETHER, experiment(TOGETHER, 2, harmonics))
    information, covariance = parts(TOGETHER, fit, harmonics)
    left = [2 * h + 1 - np.trace(f @ covariance) for h, f in zip(harmonics, information, strict=True)]
    shares = np.array([np.diag(covariance @ f @ covariance) for f in information])
    assert sum(left) == pytest.approx(2 * sum(harmonics) + 2 - 2)
    expected = shares.sum(axis=0) ** 2 / np.sum(shares**2 / np.array(left)[:, None], axis=0)
    assert list(fit.degrees_of_freedom.values()) == pytest.approx(expected, rel=1e-4)
    assert min(left) < expected[0] < sum(left)


def test_variances_maximise_the_density_with_the_parameters_integrated_out():
    """−½ Σ (n ln v + M/v) − ½ ln det Σ F/v at the best θ given v, written out, has its maximum at the variances."""
    harmonics = (3, 20)
    run = experiment(TOGETHER, 2, harmonics)
    fit, _ = fitted(TOGETHER, run)
    weights = np.array([(2 * h + 1) / POINTS for h in harmonics])
    columns = [within(d, h) for d, h in zip(DESIGNS[TOGETHER], harmonics, strict=True)]

    def marginal(variances):
        scale = weights / variances
        hessian = sum(w * x @ x.T for w, x in zip(scale, columns, strict=True))
        right = sum(w * x @ run.outputs[c] for w, x, c in zip(scale, columns, "AB", strict=True))
        theta = np.linalg.solve(hessian, right)
        squares = [np.sum((run.outputs[c] - theta @ x) ** 2) for c, x in zip("AB", columns, strict=True)]
        counts = weights * POINTS
        return -0.5 * (counts @ np.log(variances) + scale @ squares + np.linalg.slogdet(hessian)[1])

    best = np.array([fit.noise_split[channel].total ** 2 for channel in "AB"])
    for step in ([0.02, 0.0], [0.0, 0.02]):
        values = [marginal(best * np.exp(sign * np.array(step))) for sign in (-1.0, 0.0, 1.0)]
        assert values[1] > max(values[0], values[2])
        assert abs(values[2] - values[0]) < 0.03 * (values[1] - min(values))  # the maximum is 0.0002 away in ln v


def test_channels_that_tell_the_same_share_the_parameters_as_in_equation_7():
    """V = s·M/(nNs − l) with s = 2 channels of n = 9 values whose residuals are equal, and l = 2 parameters."""
    run = experiment(ALIKE, 3, (4, 4))
    same = bp.Experiment(
        "run", 0.2, dict.fromkeys("AB", run.outputs["A"]), {"x": X}, samples=POINTS, harmonics={"A": 4, "B": 4, "x": 2}
    )
    fit, _ = fitted(ALIKE, same)
    square = np.mean(fit.residuals["run"]["A"] ** 2) * 9
    totals = [fit.noise_split[channel].total ** 2 for channel in "AB"]
    assert totals == pytest.approx([2 * square / (9 * 2 - 2)] * 2, rel=1e-5)
    assert list(fit.degrees_of_freedom.values()) == pytest.approx([16.0, 16.0], rel=1e-4)


def test_a_parameter_that_the_prior_determines_takes_up_no_values():
    """Channel A of 5 values with b known to 1e-6 by its prior leaves 4 degrees of freedom, and 3 with b unknown."""
    priors = {"a": FLAT["a"], "b": bp.Normal(1.0, 1e-6)}
    for given, left in ((priors, 4.0), (FLAT, 3.0)):
        fit, _ = fitted(ALIKE, experiment(ALIKE, 4, (2, 2)), given, fixed={"variance[B]": 1e9})
        square = np.mean(fit.residuals["run"]["A"] ** 2) * 5
        assert fit.noise_split["A"].total ** 2 == pytest.approx(square / left, rel=1e-5)
        assert fit.degrees_of_freedom["a"] == pytest.approx(left, rel=1e-4)
        assert (fit.degrees_of_freedom["b"] > 1e9) == (given is priors)


@pytest.mark.parametrize("prior", ["flat", bp.InverseGamma(3.0, 0.02)])
def test_the_prior_of_the_variances_counts_as_values(prior):
    """θ has the t-distribution of n − 2 − l degrees of freedom with the flat prior, of n + 2a − l with a = 3."""
    fit, _ = fitted(APART, experiment(APART, 5, (4, 12)), noise=noise.Independent(prior=prior))
    more = -2 if prior == "flat" else 6
    assert list(fit.degrees_of_freedom.values()) == pytest.approx([8 + more, 24 + more], rel=1e-4)


def test_known_variances_leave_nothing_uncertain():
    fit, _ = fitted(APART, experiment(APART, 6, (2, 9)), fixed={"variance[A]": 0.01})
    assert np.isinf(fit.degrees_of_freedom["a"]) and fit.degrees_of_freedom["b"] == pytest.approx(18.0, rel=1e-4)
    low, high = fit.interval(0.9, robust=False)["a"]
    assert (high - low) / 2 / fit.sd["a"] == pytest.approx(1.6449, rel=1e-4)


@pytest.mark.parametrize("value", [1e-6, 1e4])
def test_a_variance_at_the_end_of_its_support_is_known(value):
    """The estimate is that with the variances fixed there."""
    low, high = (1e-9, value) if value < 1.0 else (value, 1e9)
    fit, _ = fitted(APART, experiment(APART, 6, (2, 9)), noise=noise.Independent(prior=bp.LogUniform(low, high)))
    known, _ = fitted(APART, experiment(APART, 6, (2, 9)), fixed={"variance[A]": value, "variance[B]": value})
    assert fit.noise == pytest.approx({"variance[A]": value, "variance[B]": value}, rel=1e-9)
    assert np.all(np.isinf(list(fit.degrees_of_freedom.values())))
    for name in "ab":
        assert fit.theta[name] == pytest.approx(known.theta[name], rel=1e-7, abs=1e-12)
        assert fit.sd[name] == pytest.approx(known.sd[name], rel=1e-5)


def test_draws_of_variances_at_the_end_of_their_support():
    """The marginal density of u = ln v is exp(−νu/2 − S exp(−u)/2) from the end on, with ν = n − 1."""
    run, bounds = experiment(APART, 6, (2, 9)), bp.LogUniform(1.0, 1e9)
    free, _ = fitted(APART, run)
    fit, problem = fitted(APART, run, noise=noise.Independent(prior=bounds))
    assert np.all(np.diag(fit.joint_covariance) > 0.0)
    posterior = bp.sample(problem, fit, progress=False, seed=1)
    for name, freedom in (("variance[A]", 4), ("variance[B]", 18)):
        u = np.log(posterior.draws(name))
        assert u.min() > 0.0
        grid = np.linspace(0.0, 20.0, 20_001)
        density = np.exp(-0.5 * freedom * (grid + free.noise[name] * np.exp(-grid)))
        mean = np.sum(grid * density) / np.sum(density)
        assert np.mean(u) == pytest.approx(mean, rel=0.1)


def test_the_correction_has_settled():
    """At the estimate it is again that with which the estimate was found."""
    fit, problem = fitted(TOGETHER, experiment(TOGETHER, 7, (2, 6)))
    theta = problem.vector(fit.theta)
    here = problem.anchored(theta).density().linearise(theta)
    share = bias_correction(problem, Iterate(theta, here, problem.noise_values(fit.noise), 0.0))
    found = [fit.noise_split[channel].total ** 2 for channel in "AB"]
    squares = [np.mean(fit.residuals["run"][channel] ** 2) for channel in "AB"]
    assert found == pytest.approx(np.array(squares) / share, rel=1e-5)


@cache
def covered(model: bp.Model, harmonics: tuple[int, int], spread: float = 0.0) -> dict[str, int]:
    """Return how many 90 % intervals hold the truth, which is drawn from the prior where it has a spread."""
    count = {"a": 0, "b": 0}
    for seed in range(DATA_SETS):
        truth = 1.0 + spread * np.random.default_rng(seed + 10_000).standard_normal(2)
        priors = {name: bp.Normal(1.0, spread) for name in "ab"} if spread else FLAT
        fit, _ = fitted(model, experiment(model, seed, harmonics, tuple(truth)), priors, checks=False)
        for (name, (low, high)), value in zip(fit.interval(0.9).items(), truth, strict=True):
            count[name] += low < value < high
    return count


@pytest.mark.slow
@pytest.mark.parametrize("values", [3, 5, 9, 61])
def test_interval_of_a_parameter_of_one_channel_has_nominal_coverage(values):
    """200 data sets, the other channel has 61 values; each parameter in the 99 % band, a false-alarm rate of 1 %."""
    for count in covered(APART, (values // 2, 30)).values():
        assert BAND[0] <= count <= BAND[1]


@pytest.mark.slow
@pytest.mark.parametrize("values", [5, 9])
def test_interval_of_parameters_of_two_channels_has_nominal_coverage(values):
    """As above, with channels that tell about the same parameters."""
    for count in covered(TOGETHER, (values // 2, 30)).values():
        assert BAND[0] <= count <= BAND[1]
