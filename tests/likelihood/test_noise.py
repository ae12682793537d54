"""Noise models against dense multivariate normals, eq. (6) and eq. (7) written out, and numerical derivatives."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, linalg, optimize, stats

import bayesperiodic as bp
from bayesperiodic import noise
from bayesperiodic.estimation.gauss_newton import Iterate, Objective, climb
from bayesperiodic.likelihood.block import Block
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers
from bayesperiodic.likelihood.noise_estimate import estimate_noise
from bayesperiodic.likelihood.samples import Samples
from bayesperiodic.likelihood.section_points import SectionPoints
from tests.known import LINEAR, difference, formula_model, grid, linear_experiment, linear_regressors

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
POINT = np.array([870.0, 37.0, 22.0])
LOG_2PI = np.log(2.0 * np.pi)
SHAPES = {"exponential": {"lengthscale": 0.04}, "matern": {"lengthscale": 0.04, "floor": 0.02}}
KERNELS = list(SHAPES)

TWO = formula_model(
    "two", ["k", "c"], lambda p, u, s: {"force": p.k * u.x + p.c * u.dx, "moment": p.k * u.dx - 2.0 * p.c * u.x}
)
TWO_PRIORS = {"k": bp.Normal(0.5, 2.0), "c": bp.Normal(2.0, 3.0)}


def run(samples: int, **changes) -> bp.Experiment:
    """Return an experiment of LINEAR with noise of standard deviation 3."""
    return replace(linear_experiment(TRUTH, 3.0, seed=1, samples=samples), **({"independent": {}} | changes))


def residual(experiment: bp.Experiment) -> np.ndarray:
    """Return y − ŷ at POINT on the grid."""
    return experiment.outputs["force"] - linear_regressors(0.05, 2.0, grid(experiment.samples)) @ POINT


def kernel_spectrum(kernel: str, harmonic: np.ndarray, lengthscale: float, floor: float = 0.0) -> np.ndarray:
    """Return the spectrum with mean 1 over these harmonics."""
    x = 2.0 * np.pi * harmonic * lengthscale
    correlated = 1.0 / (1.0 + x**2) if kernel == "exponential" else 1.0 / (3.0 + x**2) ** 2
    return (correlated / np.mean(correlated) + floor) / (1.0 + floor)


def circulant_covariance(kernel: str, samples: int, variance: float) -> np.ndarray:
    """Return the covariance of all points of the grid."""
    harmonic = np.abs(np.fft.fftfreq(samples, 1.0 / samples))
    spectrum = kernel_spectrum(kernel, harmonic, **SHAPES[kernel])
    return variance * linalg.circulant(np.fft.ifft(spectrum).real)


def log_likelihood(model, experiment: bp.Experiment, **values: float) -> float:
    """Return the package's log-likelihood at POINT."""
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS, noise=model)
    return float(problem.log_likelihood(POINT, {f"{kind}[force]": value for kind, value in values.items()}))


def block(kind: type[Block] = MeanPeriod, size: int = 9, count: float | None = None, **changes) -> Block:
    half = np.arange(1, (size + 1) // 2)
    positions = np.array([0, 1, 4, 5, 9, 13, 14, 17, 19])[:size] / 20
    given = {
        "experiment": "run",
        "channel": "force",
        "count": float(size) if count is None else count,
        "size": size,
        "harmonic": np.array([0, *half, *half]) if kind is MeanPeriod else np.empty(0),
        "position": positions if kind is Samples else np.empty(0),
        "points": max(20, size),
        "averaged": float(size),
        "measured": 0.7,
    }
    return kind(**(given | changes))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("samples", [40, 41])
def test_circulant_noise_is_a_multivariate_normal_with_circulant_covariance(kernel, samples):
    experiment = run(samples)
    covariance = circulant_covariance(kernel, samples, 7.0)
    normal = stats.multivariate_normal(np.zeros(samples), covariance)
    expected = normal.logpdf(residual(experiment)) + 0.5 * samples * LOG_2PI
    found = log_likelihood(noise.Circulant(kernel=kernel), experiment, variance=7.0, **SHAPES[kernel])
    assert found == pytest.approx(expected, rel=1e-10)
    assert np.diag(covariance) == pytest.approx(np.full(samples, 7.0), rel=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("samples", [40, 41])
def test_circulant_noise_with_kept_harmonics_is_normal_in_their_subspace(kernel, samples):
    """With an orthonormal basis Q of the waves kept the components are √((2H + 1)/n) · Qᵀe, up to a rotation."""
    kept, tau = 6, grid(samples)
    size, harmonic = 2 * kept + 1, np.arange(1, kept + 1)
    waves = 2.0 * np.pi * np.outer(tau, harmonic)
    basis, _ = np.linalg.qr(np.hstack([np.ones((samples, 1)), np.cos(waves), np.sin(waves)]))
    every = np.minimum(np.arange(samples), samples - np.arange(samples))
    spectrum = kernel_spectrum(kernel, every, **SHAPES[kernel])[: kept + 1]
    lags = spectrum[0] + 2.0 * np.cos(waves) @ spectrum[1:]
    covariance = 7.0 * linalg.toeplitz(lags) / samples

    experiment = run(samples, harmonics={"force": kept})
    normal = stats.multivariate_normal(np.zeros(size), basis.T @ covariance @ basis)
    expected = normal.logpdf(basis.T @ residual(experiment)) + 0.5 * size * (LOG_2PI - np.log(size / samples))
    found = log_likelihood(noise.Circulant(kernel=kernel), experiment, variance=7.0, **SHAPES[kernel])
    assert found == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("samples", [40, 41])
def test_circulant_noise_at_masked_points_is_the_marginal(kernel, samples):
    mask = np.random.default_rng(2).random(samples) < 0.4
    experiment = run(samples, mask=mask)
    covariance = circulant_covariance(kernel, samples, 7.0)[np.ix_(mask, mask)]
    normal = stats.multivariate_normal(np.zeros(mask.sum()), covariance)
    expected = normal.logpdf(residual(experiment)[mask]) + 0.5 * mask.sum() * LOG_2PI
    found = log_likelihood(noise.Circulant(kernel=kernel), experiment, variance=7.0, **SHAPES[kernel])
    assert found == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("kernel", KERNELS)
def test_unit_of_correlated_components_is_the_sd_that_white_noise_causes(kernel):
    """Of the rows of the inverse of Cholesky's factor of the covariance; not the sums of the rows."""
    mask = np.random.default_rng(2).random(40) < 0.4
    problem = bp.Problem(LINEAR, [run(40, mask=mask)], priors=PRIORS, noise=noise.Circulant(kernel=kernel))
    values = {"variance[force]": 7.0} | {f"{name}[force]": value for name, value in SHAPES[kernel].items()}
    (unit,) = problem.likelihood.units(np.array([values[name] for name in problem.likelihood.names]))
    root = np.linalg.inv(np.linalg.cholesky(circulant_covariance(kernel, 40, 7.0)[np.ix_(mask, mask)]))
    assert unit == pytest.approx(np.sqrt(np.sum(root**2, axis=1)), rel=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("changes", [{}, {"harmonics": {"force": 6}}, {"mask": np.arange(40) % 3 == 0}])
def test_circulant_noise_without_correlation_is_independent_noise(kernel, changes):
    experiment = run(40, **changes)
    shape = SHAPES[kernel] | {"lengthscale": 1e-9}
    found = log_likelihood(noise.Circulant(kernel=kernel), experiment, variance=7.0, **shape)
    assert found == pytest.approx(log_likelihood("independent", experiment, variance=7.0), rel=1e-10)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_spectrum_has_mean_one(kernel):
    shapes = [[1.0, lengthscale, floor] for lengthscale in (1e-6, 0.03, 10.0) for floor in (1e-9, 0.01, 100.0)]
    spectra = noise.Circulant(kernel=kernel).spectrum(block(size=41), np.array(shapes)[:, : 1 + len(SHAPES[kernel])])[0]
    assert spectra.mean(axis=-1) == pytest.approx(np.ones(9), rel=1e-13)


def two_channel_experiments(seed: int = 3) -> list[bp.Experiment]:
    """Return three runs of TWO, the channels with different noise."""
    generator, tau = np.random.default_rng(seed), grid(30)
    design = two_channel_design(tau)
    return [
        bp.Experiment(
            f"run {i}",
            1.0,
            {
                "force": design["force"] @ [1.0, 0.2] + 0.5 * generator.standard_normal(30),
                "moment": design["moment"] @ [1.0, 0.2] + 2.0 * generator.standard_normal(30),
            },
            {"x": np.sin(2 * np.pi * tau)},
            samples=30,
        )
        for i in range(3)
    ]


def two_channel_design(tau: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns that multiply k and c in each output of TWO, for x = sin(2πt) at 1 Hz."""
    x, rate = np.sin(2 * np.pi * tau), 2 * np.pi * np.cos(2 * np.pi * tau)
    return {"force": np.stack([x, rate], axis=1), "moment": np.stack([rate, -2.0 * x], axis=1)}


def moments(experiments: list[bp.Experiment], theta: np.ndarray) -> dict[str, float]:
    """Return M_β of eq. (6), each squared residual weighed by independent values per sample."""
    design, result = two_channel_design(grid(30)), {"force": 0.0, "moment": 0.0}
    for e in experiments:
        for channel, values in e.outputs.items():
            weight = e.independent[channel] / 30
            result[channel] += weight * float(np.sum((values - design[channel] @ theta) ** 2))
    return result


def taken(experiments: list[bp.Experiment], variances: dict[str, float]) -> dict[str, float]:
    """Return tr(F C) of each channel, F = XᵀX/v weighed by independent values per sample, C with the priors' part."""
    design, information = two_channel_design(grid(30)), dict.fromkeys(variances, np.zeros((2, 2)))
    for e in experiments:
        for channel in e.outputs:
            x, weight = design[channel], e.independent[channel] / 30
            information[channel] = information[channel] + weight * x.T @ x / variances[channel]
    covariance = np.linalg.inv(sum(information.values()) + np.diag([2.0**-2, 3.0**-2]))
    return {channel: float(np.trace(own @ covariance)) for channel, own in information.items()}


def unequal_experiments() -> list[bp.Experiment]:
    """Return runs of which one has fewer independent values of one channel, and one a single channel."""
    first, second, third = two_channel_experiments()
    first = replace(first, independent={"force": 30, "moment": 12})
    return [first, second, replace(third, outputs={"force": third.outputs["force"]}, independent={})]


def test_independent_noise_is_equation_6():
    """−½ Σ_β [n_β ln v_β + M_β/v_β], n_β counted over the experiments."""
    theta, variances = np.array([0.8, 0.3]), {"force": 0.3, "moment": 3.0}
    problem = bp.Problem(TWO, unequal_experiments(), priors=TWO_PRIORS)
    m = moments(unequal_experiments(), theta)
    expected = -0.5 * (90 * np.log(0.3) + m["force"] / 0.3 + 42 * np.log(3.0) + m["moment"] / 3.0)
    assert problem.log_likelihood(theta, variances) == pytest.approx(expected, rel=1e-10)
    assert problem.log_posterior(theta, variances) == pytest.approx(expected + problem.log_prior(theta), rel=1e-10)


def test_each_experiment_may_have_its_own_variances():
    experiments = two_channel_experiments()[:2]
    problem = bp.Problem(TWO, experiments, priors=TWO_PRIORS, noise=noise.Independent(per="experiment"))
    names = [f"variance[{channel}, {e.name}]" for e in experiments for channel in ("force", "moment")]
    assert list(problem.noise_names) == names
    theta, variances = np.array([0.8, 0.3]), np.array([0.3, 3.0, 0.4, 5.0])
    each = [moments([e], theta) for e in experiments]
    m = np.array([each[0]["force"], each[0]["moment"], each[1]["force"], each[1]["moment"]])
    expected = -0.5 * np.sum(30 * np.log(variances) + m / variances)
    assert problem.log_likelihood(theta, variances) == pytest.approx(expected, rel=1e-10)
    fit = bp.map_estimate(problem, progress=False)
    each = [moments([e], np.array(list(fit.theta.values()))) for e in experiments]
    m = np.array([each[0]["force"], each[0]["moment"], each[1]["force"], each[1]["moment"]])
    p = 30 - m / np.array(list(fit.noise.values()))
    assert np.all(p > 0.0) and 1.9 < p.sum() < 2.0


def test_measured_noise_adds_the_scatter_of_the_mean():
    """V = scatter²/cycles + v, or what the fold found for the mean in place of scatter²/cycles."""
    by_scatter = run(40, scatter={"force": 6.0}, cycles=9)
    by_fold = run(40, amplitude_variance={"force": np.array([1.0, 4.0, 2.0])})
    total = np.sum(residual(by_scatter) ** 2)
    for experiment, measured in ((by_scatter, 4.0), (by_fold, 4.0)):
        expected = -0.5 * (40 * np.log(measured + 5.0) + total / (measured + 5.0))
        assert log_likelihood("measured", experiment, variance=5.0) == pytest.approx(expected, rel=1e-10)


def test_jeffreys_prior_of_a_model_error_is_flat_in_the_log_total_variance():
    """∝ 1/(4 + v): the mass from zero to 4 is ln 2, and that from 4 to 4R is ln((1 + R)/2)."""
    problem = bp.Problem(LINEAR, [run(40, scatter={"force": 6.0}, cycles=9)], priors=PRIORS, noise="measured")

    def density(log_variance):
        return np.exp(problem.likelihood.log_prior(np.exp([log_variance])))

    assert integrate.quad(density, -60.0, np.log(4.0))[0] == pytest.approx(np.log(2.0), rel=1e-8)
    assert integrate.quad(density, np.log(4.0), np.log(400.0))[0] == pytest.approx(np.log(101 / 2), rel=1e-8)


@pytest.mark.parametrize("model", [noise.Independent, noise.Circulant])
def test_jeffreys_prior_is_constant_in_the_logarithm_and_the_flat_one_is_not(model):
    """1/v dv = d ln v, dv = v d ln v; priors of other noise parameters do not change the difference."""
    values = np.ones((3, len(model().shape_priors) + 1))
    values[:, 0] = 0.01, 1.0, 50.0
    jeffreys, flat = (Likelihood(model(prior=p), [block()], {}).log_prior(values) for p in ("jeffreys", "flat"))
    assert np.ptp(jeffreys) == pytest.approx(0.0, abs=1e-12)
    assert flat - jeffreys == pytest.approx(np.log(values[:, 0]), abs=1e-12)


@pytest.mark.parametrize("prior", [bp.InverseGamma(3.0, 2.0), bp.LogNormal(2.0, 0.7), stats.gamma(3.0, scale=2.0)])
@pytest.mark.parametrize("model", [noise.Independent, noise.Measured])
def test_a_proper_prior_is_normalised_over_the_logarithm(model, prior):
    likelihood = Likelihood(model(prior=prior), [block()], {})

    def density(log_variance):
        return np.exp(likelihood.log_prior(np.exp([log_variance])))

    assert integrate.quad(density, -25.0, 25.0, points=[0.0, 1.0])[0] == pytest.approx(1.0, rel=1e-6)


def test_priors_of_the_shape_are_normalised_over_the_logarithm():
    likelihood = Likelihood(noise.Circulant(), [block()], {"variance[force]": 1.0})

    def density(log_floor, log_lengthscale):
        return np.exp(likelihood.log_prior(np.exp([0.0, log_lengthscale, log_floor])))

    low, high = np.log([0.03, 0.01]) - 8.0 * np.array([1.5, 2.0]), np.log([0.03, 0.01]) + 8.0 * np.array([1.5, 2.0])
    x, y = (np.linspace(a, b, 61) for a, b in zip(low, high, strict=True))
    values = np.array([[density(b, a) for b in y] for a in x])
    assert integrate.simpson(integrate.simpson(values, x=y), x=x) == pytest.approx(1.0, rel=1e-6)
    assert likelihood.log_prior(np.array([3.0, 0.03, 0.01])) == pytest.approx(-np.log(2 * np.pi * 1.5 * 2.0), rel=1e-12)


def section(with_joint_covariance: bool) -> tuple[bp.Experiment, np.ndarray]:
    """Return an experiment of three correlated points and one multiplier, and the covariance of all four values."""
    mask = np.isin(np.arange(40), [3, 11, 30])
    root = np.random.default_rng(4).standard_normal((4, 4)) + 2.0 * np.eye(4)
    covariance = root @ root.T
    if not with_joint_covariance:
        covariance[3, :3] = covariance[:3, 3] = 0.0
    given = {"covariance": covariance} if with_joint_covariance else {"covariance": covariance[:3, :3]}
    sd = None if with_joint_covariance else np.sqrt(covariance[3:, 3])
    return run(40, mask=mask, multipliers=np.array([0.4]), multiplier_sd=sd, **given), covariance


@pytest.mark.parametrize("with_joint_covariance", [True, False])
def test_points_and_multipliers_have_their_joint_normal_density(with_joint_covariance):
    """The linear model's multiplier is exp(−1/frequency), the dummy state w obeying ẇ + w = x."""
    experiment, covariance = section(with_joint_covariance)
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS, fixed={"scale": 1.0})
    off = np.append(residual(experiment)[experiment.mask], np.log(0.4) + 0.5)
    normal = stats.multivariate_normal(np.zeros(4), covariance)
    expected = normal.logpdf(off) - normal.logpdf(np.zeros(4))
    assert problem.log_likelihood(POINT, {}) == pytest.approx(expected, rel=1e-6)


def test_the_scale_belongs_to_the_points_and_not_to_the_multipliers():
    experiment, covariance = section(True)
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS, noise=noise.Independent(prior=bp.InverseGamma(2.0, 1.0)))
    assert problem.noise_names == ("scale",)
    assert problem.counted == 3
    e = residual(experiment)[experiment.mask]
    square = e @ np.linalg.solve(covariance[:3, :3], e)
    one, four = (float(problem.log_likelihood(POINT, {"scale": s})) for s in (1.0, 4.0))
    assert four - one == pytest.approx(-0.5 * (3 * np.log(4.0) + square / 4.0 - square), rel=1e-9)


@pytest.mark.parametrize("size, expected", [(1e-3, 0.5), (1.0, 1.0), (30.0, 2.0)])
@pytest.mark.parametrize("prior", [bp.LogUniform(0.5, 2.0), stats.loguniform(0.5, 2.0)])
@pytest.mark.parametrize("start", [1e-6, 1.0, 1e6])
def test_a_variance_stays_within_the_support_of_its_prior(prior, size, expected, start):
    """Residuals of one variance s: the maximum of v^(−n/2)·exp(−n·s/(2v)) within the support is nearest to s."""
    likelihood = Likelihood(noise.Independent(prior=prior), [block()], {})
    residuals = [np.sqrt(size) * np.ones(likelihood.blocks[0].size)]
    unbound = estimate_noise(Likelihood(noise.Independent(), [block()], {}), residuals, np.ones(1), 1.0)
    residuals = [residuals[0] * np.sqrt(size / unbound[0])]
    (variance,) = estimate_noise(likelihood, residuals, np.array([start]), 1.0)
    assert variance == pytest.approx(expected, rel=1e-6)
    assert np.isfinite(likelihood.log_prior(np.array([variance])))


MODELS = [
    noise.Independent(prior="flat"),
    noise.Independent(prior=bp.InverseGamma(3.0, 2.0)),
    noise.Measured(),
    noise.Measured(prior=bp.LogNormal(1.0, 1.0)),
    noise.Circulant(),
    noise.Circulant(kernel="exponential", prior="flat", per="experiment"),
]
BLOCKS = [
    block(),
    block(count=6.5, experiment="other", measured=0.3, averaged=50.0),
    block(experiment="longer", averaged=200.0),
    block(Samples, size=7),
    block(Samples, size=5, count=3.5, channel="rate"),
    block(SectionPoints, size=4, channel="scale", measured=np.nan),
    block(Multipliers, size=2, count=0.0, channel="multipliers", measured=np.nan),
]


def situation(model) -> tuple[Likelihood, list[np.ndarray], np.ndarray]:
    """Return a likelihood on every kind of block, residuals and noise parameters."""
    generator = np.random.default_rng(6)
    likelihood = Likelihood(model, BLOCKS, {})
    residuals = [generator.standard_normal(b.size) for b in BLOCKS]
    start = likelihood.guess()
    return likelihood, residuals, start * np.exp(0.5 * generator.standard_normal(start.size))


@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_noise_gradients_equal_high_order_differences(model, share):
    likelihood, residuals, values = situation(model)
    _, by_residual, by_noise = likelihood.value_and_gradients(residuals, values, share)

    def total(moved, noise_values):
        return float(likelihood(moved, noise_values, share) + likelihood.log_prior(noise_values))

    for i in range(values.size):
        unit = np.eye(values.size)[i]
        expected = difference(lambda t, unit=unit: total(residuals, values * np.exp(t * unit)))
        assert by_noise[i] == pytest.approx(expected, rel=1e-8, abs=1e-8)
    for b, r in enumerate(residuals):
        for unit, found in zip(np.eye(r.size), by_residual[b], strict=True):

            def moved(t, b=b, unit=unit):
                return total([*residuals[:b], residuals[b] + t * unit, *residuals[b + 1 :]], values)

            expected = difference(moved)
            assert found == pytest.approx(expected, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_squares_of_whitened_residuals_are_the_quadratic_form(model):
    likelihood, residuals, values = situation(model)
    nothing = [np.zeros_like(r) for r in residuals]
    expected = -2.0 * (likelihood(residuals, values) - likelihood(nothing, values))
    white = likelihood.whitened(residuals, values)
    assert sum(w @ w for w in white) == pytest.approx(expected, rel=1e-12)
    together = likelihood.whitened([np.stack([r, 3.0 * r]) for r in residuals], values)
    for both, one in zip(together, white, strict=True):
        assert both == pytest.approx(np.stack([one, 3.0 * one]), rel=1e-12)


def test_many_residuals_at_once_equal_one_by_one():
    likelihood, residuals, values = situation(noise.Circulant())
    generator = np.random.default_rng(7)
    many = [generator.standard_normal((4, r.size)) for r in residuals]
    noise_values = values * np.exp(0.3 * generator.standard_normal((4, values.size)))
    each = [float(likelihood([r[i] for r in many], noise_values[i])) for i in range(4)]
    assert likelihood(many, noise_values) == pytest.approx(each, rel=1e-12)


def estimate(experiments: list[bp.Experiment], model="independent") -> tuple[bp.MapEstimate, np.ndarray]:
    fit = bp.map_estimate(bp.Problem(TWO, experiments, priors=TWO_PRIORS, noise=model), progress=False)
    return fit, np.array(list(fit.theta.values()))


@pytest.mark.parametrize(
    ("experiments", "counts"), [(two_channel_experiments, (90, 90)), (unequal_experiments, (90, 42))]
)
def test_each_channel_counts_the_parameters_that_its_values_take_up(experiments, counts):
    """Eq. (7) as v_β = M_β/(n_β − p_β), with p = tr(F C) from the regressors."""
    fit, theta = estimate(experiments())
    m, p = moments(experiments(), theta), taken(experiments(), fit.variances)
    assert fit.independent == dict(zip(("force", "moment"), counts, strict=True))
    assert 1.9 < sum(p.values()) < 2.0 and p["force"] > 1.5 * p["moment"]
    for channel, variance in fit.variances.items():
        assert variance == pytest.approx(m[channel] / (fit.independent[channel] - p[channel]), rel=1e-6)


def test_with_equation_7_the_estimate_maximises_equation_6_with_fewer_values():
    """With n − p for n; the variances at their best leave −½ Σ (n − p)_β ln M_β + ln p(θ)."""
    fit, theta = estimate(two_channel_experiments())
    left = {channel: 90 - p for channel, p in taken(two_channel_experiments(), fit.variances).items()}

    def objective(at):
        m = moments(two_channel_experiments(), at)
        prior = sum(float(p.log_prob(x)) for p, x in zip(TWO_PRIORS.values(), at, strict=True))
        return 0.5 * (left["force"] * np.log(m["force"]) + left["moment"] * np.log(m["moment"])) - prior

    best = optimize.minimize(objective, theta + 0.1, method="BFGS", options={"gtol": 1e-9})
    assert theta == pytest.approx(best.x, rel=1e-6)


def joint_maximum(problem: bp.Problem, share: float) -> Iterate:
    density = problem.density(coordinates="natural")
    objective = Objective(density, share)
    first = objective.iterate(density.linearise(problem.median()), problem.likelihood.guess())
    iterate, status, _ = climb(objective, first)
    assert status == "converged"
    return iterate


def test_without_the_correction_the_estimate_maximises_equation_6():
    """Over (θ, ln v) of eq. (6) written out, v = M/n there."""
    problem = bp.Problem(TWO, unequal_experiments(), priors=TWO_PRIORS)
    found = joint_maximum(problem, 1.0)

    def negative(x):
        m = moments(unequal_experiments(), x[:2])
        prior = sum(float(p.log_prob(v)) for p, v in zip(TWO_PRIORS.values(), x[:2], strict=True))
        return 0.5 * (90 * x[2] + m["force"] / np.exp(x[2]) + 42 * x[3] + m["moment"] / np.exp(x[3])) - prior

    best = optimize.minimize(negative, [0.5, 0.5, 0.0, 0.0], method="BFGS", options={"gtol": 1e-8})
    assert found.theta == pytest.approx(best.x[:2], rel=1e-6)
    assert found.noise == pytest.approx(np.exp(best.x[2:]), rel=1e-6)
    m = moments(unequal_experiments(), found.theta)
    assert found.noise == pytest.approx([m["force"] / 90, m["moment"] / 42], rel=1e-9)
    assert problem.log_posterior(found.theta, found.noise) == pytest.approx(-best.fun, rel=1e-10)


@pytest.mark.parametrize(
    "model",
    [
        noise.Independent(),
        noise.Independent(prior="flat"),
        noise.Independent(prior=bp.InverseGamma(3.0, 2.0)),
        noise.Measured(),
        noise.Circulant(),
        noise.Circulant(kernel="exponential"),
    ],
    ids=repr,
)
def test_without_the_correction_the_gradient_of_the_posterior_vanishes(model):
    experiments = [replace(e, scatter={"force": 0.6, "moment": 2.0}, cycles=4) for e in two_channel_experiments()]
    problem = bp.Problem(TWO, experiments, priors=TWO_PRIORS, noise=model)
    found = joint_maximum(problem, 1.0)
    hessian, _ = Objective(problem.density(coordinates="natural"), 1.0).hessian_and_gradient(found)
    in_sd = np.append(1.0 / np.sqrt(np.diag(hessian)), np.ones(found.noise.size))
    assert np.all(np.abs(problem.gradient(found.theta, found.noise) * in_sd) < 2e-5)


SHARE = 1.0 - 3.0 / 40.0


def spectral_residuals(seed: int = 8) -> tuple[list[Block], list[np.ndarray], float, float]:
    """Return two blocks of one channel, their residuals, M and n."""
    generator = np.random.default_rng(seed)
    blocks = [block(size=41, count=30.0), block(size=21, experiment="other", points=41, averaged=21.0)]
    residuals = [2.0 * generator.standard_normal(b.size) for b in blocks]
    total = sum(b.weight * r @ r for b, r in zip(blocks, residuals, strict=True))
    return blocks, residuals, float(total), 51.0


def best_noise(model, blocks, residuals, share: float = SHARE, fixed=None) -> np.ndarray:
    likelihood = Likelihood(model, blocks, fixed or {})
    return estimate_noise(likelihood, residuals, likelihood.guess(), share)


def test_the_flat_prior_counts_two_values_less():
    blocks, residuals, total, count = spectral_residuals()
    assert best_noise(noise.Independent(), blocks, residuals) == pytest.approx(total / (count * SHARE), rel=1e-12)
    flat = best_noise(noise.Independent(prior="flat"), blocks, residuals)
    assert flat == pytest.approx(total / (count * SHARE - 2.0), rel=1e-12)


def test_an_inverse_gamma_prior_gives_its_conjugate_mode():
    """Over ln v the density is v^(−n/2 − a) exp(−(M/2 + b)/v), with its maximum at (M/2 + b)/(n/2 + a)."""
    blocks, residuals, total, count = spectral_residuals()
    found = best_noise(noise.Independent(prior=bp.InverseGamma(3.0, 20.0)), blocks, residuals)
    assert found == pytest.approx((0.5 * total + 20.0) / (0.5 * count * SHARE + 3.0), rel=1e-7)


@pytest.mark.parametrize("measured", [0.5, 3.0, 30.0])
def test_the_model_error_is_found_beside_the_measurement_noise(measured):
    """The maximum of −½ [n' ln(m + v) + M/(m + v)] + ln v/(m + v) by bracketing, n' = n·share."""
    blocks, residuals, total, count = spectral_residuals()
    blocks = [replace(b, measured=measured) for b in blocks]
    found = best_noise(noise.Measured(), blocks, residuals)

    def negative(log_v):
        whole = measured + np.exp(log_v)
        return 0.5 * (count * SHARE * np.log(whole) + total / whole) - log_v + np.log(whole)

    best = optimize.minimize_scalar(negative, bracket=(-5.0, 0.0, 5.0), options={"xtol": 1e-12})
    assert found == pytest.approx(np.exp(best.x), rel=1e-5)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("points", [False, True])
def test_noise_estimate_maximises_the_density_of_the_spectrum(kernel, points):
    blocks = [block(Samples)] if points else spectral_residuals()[0]
    generator = np.random.default_rng(9)
    residuals = [np.cumsum(generator.standard_normal(b.size)) for b in blocks]
    likelihood = Likelihood(noise.Circulant(kernel=kernel), blocks, {})
    found = best_noise(likelihood.model, blocks, residuals)

    def density(values):
        many = [np.broadcast_to(r, (len(values), r.size)) for r in residuals]
        return likelihood(many, values, SHARE) + likelihood.log_prior(values)

    axes = [np.geomspace(1e-2, 1e3, 15), np.geomspace(1e-3, 3.0, 15), np.geomspace(1e-4, 1.0, 9)][: found.size]
    scanned = density(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, found.size))
    assert density(found[None])[0] > scanned.max()
    for unit in np.eye(found.size):
        assert difference(lambda t, unit=unit: float(density(found[None] * np.exp(t * unit))[0])) == pytest.approx(
            0, abs=1e-5
        )


def with_a_constant(size: int, constant: float) -> list[np.ndarray]:
    """Return white residuals beside a constant, of which a spectrum with a long or a short scale takes account."""
    white = np.random.default_rng(3).standard_normal(size)
    white[0] = constant
    return [white]


@pytest.mark.parametrize(("size", "constant"), [(61, 8.0), (201, 8.0), (201, 5.0), (201, 3.0)])
def test_the_best_of_several_optima_of_the_shape_is_found_from_any_start(size, constant):
    """At least as good as 37,000 values of a grid; near some of the starts the density is lower by 1 to 15."""
    blocks, residuals = [block(MeanPeriod, size)], with_a_constant(size, constant)
    likelihood = Likelihood(noise.Circulant(kernel="matern"), blocks, {})

    def density(values):
        many = [np.broadcast_to(r, (len(values), r.size)) for r in residuals]
        return likelihood(many, values) + likelihood.log_prior(values)

    axes = [np.geomspace(1e-2, 1e3, 41), np.geomspace(1e-4, 10.0, 41), np.geomspace(1e-4, 10.0, 22)]
    scanned = density(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)).max()
    starts = [np.array([1.0, lengthscale, 0.05]) for lengthscale in np.geomspace(1e-4, 3.0, 6)]
    near, best = (
        np.array(
            [density(estimate_noise(likelihood, residuals, start, 1.0, all_shapes=every)[None])[0] for start in starts]
        )
        for every in (False, True)
    )
    assert np.ptp(best) < 1e-6 and best.min() > scanned
    assert near.min() < best.max() - 1.0


@pytest.mark.parametrize("constant", [2.5, 3.0])
def test_an_estimate_has_the_best_shape_of_the_noise(constant):
    """A constant that the model lacks, beside white noise: as good as 1,600 values of a grid."""
    experiment = linear_experiment(TRUTH, 3.0, seed=1, samples=61)
    experiment = replace(experiment, independent={}, outputs={"force": experiment.outputs["force"] + constant})
    problem = bp.Problem(LINEAR, [experiment], priors=PRIORS, noise=noise.Circulant(kernel="matern"))
    start = dict(zip(problem.names, TRUTH, strict=True))
    fit = bp.map_estimate(problem, start=start, progress=False, checks=False)

    def density(values):
        return float(problem.log_posterior(problem.vector(fit.theta), dict(zip(fit.noise, values, strict=True))))

    axes = np.geomspace(3.0, 3e3, 8), np.geomspace(1e-4, 10.0, 25), np.geomspace(1e-3, 3.0, 8)
    assert density(fit.noise.values()) > max(map(density, itertools.product(*axes))) - 0.1


def test_fixed_noise_parameters_keep_their_values():
    blocks, residuals, *_ = spectral_residuals()
    found = best_noise(noise.Circulant(), blocks, residuals, fixed={"lengthscale[force]": 0.2, "floor[force]": 0.5})
    assert found[1:].tolist() == [0.2, 0.5]
    whole = kernel_spectrum("matern", blocks[0].harmonic, 0.2, 0.5)[:21]
    spectra = [whole[b.harmonic] * b.size / 41 for b in blocks]
    total = sum(b.weight * np.sum(r**2 / s) for b, r, s in zip(blocks, residuals, spectra, strict=True))
    assert found[0] == pytest.approx(total / (51.0 * SHARE), rel=1e-6)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: noise.Independent(per="run"), "per: must be one of 'channel', 'experiment', got 'run'"),
        (lambda: noise.Independent(prior="jeffrey"), "prior: must be .*got 'jeffrey'.*Did you mean 'jeffreys'"),
        (lambda: noise.Measured(prior=3.0), "prior: must be a prior .*got 3.0"),
        (lambda: noise.Circulant(prior=bp.Normal(1.0, 0.1)), r"prior: must have positive support, .*got Normal\(.*\)"),
        (lambda: noise.Circulant(kernel="gauss"), "kernel: must be one of 'matern', 'exponential', got 'gauss'"),
    ],
)
def test_error_names_the_bad_noise_argument(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": "circular"}, "noise: must be .*got 'circular'.*Did you mean 'circulant'"),
        ({"noise": 3}, "noise: must be a name or a model such as noise.Independent.*got 3"),
        (
            {"noise": "measured"},
            "noise: must be .*got 'measured'; experiment 'run' has no scatter of 'force'",
        ),
        ({"noise": "circulant", "fixed": {"length[force]": 0.1}}, r"fixed: must be .*got 'length\[force\]'"),
        ({"noise": "circulant", "fixed": {"floor[force]": -0.1}}, r"fixed\['floor\[force\]'\]: must be .*got -0.1"),
    ],
)
def test_error_names_the_bad_noise_of_a_problem(changes, message):
    with pytest.raises(ValueError, match=message):
        bp.Problem(LINEAR, [run(40)], **({"priors": PRIORS} | changes))


def test_a_model_error_cannot_be_relative_to_one_point():
    one = run(40, mask=np.arange(40) == 3, scatter={"force": 0.1}, cycles=4)
    with pytest.raises(ValueError, match="noise: must be .*got 'relative'; .* whose mask has 1 points of one value"):
        bp.Problem(LINEAR, [one], priors=PRIORS, noise="relative")


@pytest.mark.parametrize(
    ("model", "needed"), [(noise.Independent(), 3), (noise.Independent(prior="flat"), 5), (noise.Circulant(), 3)]
)
def test_improper_prior_is_rejected_if_the_data_can_be_fitted_exactly(model, needed):
    """Three free parameters fit three values; the flat prior diverges with two values more."""
    with pytest.raises(ValueError, match=rf"must have more than {needed} independent values .*, got only {needed}"):
        bp.Problem(LINEAR, [run(40, independent={"force": needed})], priors=PRIORS, noise=model)
    bp.Problem(LINEAR, [run(40, independent={"force": needed + 1})], priors=PRIORS, noise=model)
    proper = replace(model, prior=bp.InverseGamma(2.0, 1.0))
    bp.Problem(LINEAR, [run(40, independent={"force": needed})], priors=PRIORS, noise=proper)


def test_a_known_variance_needs_no_scatter():
    problem = bp.Problem(LINEAR, [run(40)], priors=PRIORS, noise="measured", fixed={"variance[force]": 9.0})
    assert problem.free_noise == ()


def test_measured_noise_has_the_measured_variance_of_every_harmonic():
    """V_h = (2H + 1)·(variance of a cosine amplitude)/2 + v, those of a power law, which smoothing does not change."""
    measured = np.concatenate([[5.0], 8.0 * np.arange(1.0, 7.0) ** -2.0])
    freedom = np.full(7, 1e6)
    experiment = run(
        40, harmonics={"force": 6}, amplitude_variance={"force": measured}, amplitude_freedom={"force": freedom}
    )
    harmonic = np.r_[0, 1:7, 1:7]
    variance = 13 * np.where(harmonic == 0, 1.0, 0.25) * measured[harmonic] + 2.0
    amplitudes = np.fft.rfft(residual(experiment))[:7] / 40 * np.r_[1.0, np.full(6, 2.0)]
    parts = np.sqrt(13) * np.r_[amplitudes[0].real, amplitudes[1:].real / 2**0.5, amplitudes[1:].imag / 2**0.5]
    expected = -0.5 * np.sum(np.log(variance) + parts**2 / variance)
    assert log_likelihood("measured", experiment, variance=2.0) == pytest.approx(expected, rel=1e-5)


def test_a_relative_model_error_is_the_same_fraction_of_every_channel():
    """V = scatter²/cycles + ρ²·m: a pure gain error of a tenth is found in both channels, in whatever units."""
    model = formula_model("gains", ["a"], lambda p, u, s: {"force": p.a * u.x, "moment": 1000.0 * p.a * u.x})
    wave, white = np.cos(2 * np.pi * grid(64)), np.random.default_rng(1).standard_normal((2, 64))
    outputs = {"force": wave + 1e-4 * white[0], "moment": 1100.0 * wave + 0.1 * white[1]}
    one = bp.Experiment(
        "run", 1.0, outputs, {"x": wave}, samples=64, cycles=9, scatter={"force": 3e-4, "moment": 0.3}
    )  # fmt: skip
    given = {"priors": {"a": bp.Normal(1.0, 10.0)}, "scheme": "fourier", "input_noise": "exact"}
    apart, even = (
        bp.map_estimate(bp.Problem(model, [one], noise=kind, **given), progress=False, starts=1)
        for kind in ("measured", "relative")
    )
    errors = [{"force": abs(f.theta["a"] - 1.0), "moment": abs(f.theta["a"] / 1.1 - 1.0)} for f in (apart, even)]
    assert min(errors[0].values()) < 1e-3 and max(errors[0].values()) > 0.08
    assert errors[1]["force"] == pytest.approx(errors[1]["moment"], rel=0.3) and list(even.noise) == [
        "variance[relative]"
    ]
    assert even.noise["variance[relative]"] == pytest.approx(2 * 0.05**2 / 2, rel=0.2)
    # The prior knows the measured noise in the same units: scatter²/cycles over the mean squares ½ and ½·1100².
    measured = bp.Problem(model, [one], noise="relative", **given).likelihood.measured["variance[relative]"]
    assert measured == pytest.approx(0.5 * (1e-8 / 0.5 + 1e-2 / (0.5 * 1100.0**2)), rel=1e-3)


def test_a_model_error_is_zero_where_the_residual_is_no_larger_than_the_measured_noise():
    """The total variance is the larger one of the measured and that of the residual, M/n' with n' = n·share."""
    blocks, residuals, total, count = spectral_residuals()
    for measured in (1.5 * total / (count * SHARE), 0.5 * total / (count * SHARE)):
        likelihood = Likelihood(noise.Measured(), [replace(b, measured=measured) for b in blocks], {})
        found = estimate_noise(likelihood, residuals, likelihood.guess(), SHARE, of_total=True)
        expected = max(total / (count * SHARE), measured)
        assert found[0] + measured == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("freedom", [4.0, 10.0])
def test_a_parameter_of_one_harmonic_has_the_degrees_of_freedom_of_its_measured_variance(freedom):
    """The residual is a thousandth of the measured noise, so that the model error is zero."""
    model = formula_model("gain", ["a"], lambda p, u, s: {"force": p.a * u.x})
    wave = np.cos(2 * np.pi * grid(32))
    one = bp.Experiment(
        "run", 1.0, {"force": 2.0 * wave + 1e-4 * np.sin(4 * np.pi * grid(32))}, {"x": wave}, samples=32, cycles=9,
        harmonics={"force": 2, "x": 1}, amplitude_variance={"force": np.full(3, 0.01)},
        amplitude_freedom={"force": np.array([50.0, freedom, 50.0])},
    )  # fmt: skip
    priors = {"a": bp.Normal(0.0, 1e3)}
    problem = bp.Problem(model, [one], priors=priors, noise="measured", input_noise="exact")
    fit = bp.map_estimate(problem, starts=1, progress=False)
    # Half of the variance of a complex amplitude is in phase with the input.
    assert fit.sd["a"] == pytest.approx(np.sqrt(0.5 * 0.01), rel=0.02)
    assert fit.degrees_of_freedom["a"] == pytest.approx(freedom, rel=0.02)


def test_values_of_a_model_without_a_covariance_of_its_own_are_independent():
    problem = bp.Problem(LINEAR, [run(12)], priors=PRIORS)
    (block,) = problem.likelihood.blocks
    covariance, slopes = noise.Independent().covariance(block, np.array([2.5]))
    assert np.array_equal(covariance, 2.5 * np.eye(block.size)) and np.array_equal(slopes, [2.5 * np.eye(block.size)])
