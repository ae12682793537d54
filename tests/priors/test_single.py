import math
from types import SimpleNamespace

import mpmath
import numpy as np
import pytest
from scipy import integrate, stats

import bayesperiodic as bp
from bayesperiodic.priors.joint import FromScipy, JointPrior, as_prior
from tests.known import difference

INFINITY = math.inf
CASES = {
    "Normal": (bp.Normal(2.0, 0.5), stats.norm(2.0, 0.5)),
    "LogNormal": (bp.LogNormal(3.0, 0.7), stats.lognorm(0.7, scale=3.0)),
    "TruncatedNormal": (bp.TruncatedNormal(1.0, 2.0, -1.5, 4.0), stats.truncnorm(-1.25, 1.5, 1.0, 2.0)),
    "TruncatedNormal, positive": (bp.TruncatedNormal(1.0, 2.0, 0.0, INFINITY), stats.truncnorm(-0.5, np.inf, 1.0, 2.0)),
    "TruncatedNormal, upper tail": (bp.TruncatedNormal(0.0, 1.0, 4.0, 7.0), stats.truncnorm(4.0, 7.0)),
    "TruncatedNormal, lower tail": (bp.TruncatedNormal(0.0, 0.5, -INFINITY, -4), stats.truncnorm(-np.inf, -8, 0, 0.5)),
    "HalfNormal": (bp.HalfNormal(2.5), stats.halfnorm(scale=2.5)),
    "Uniform": (bp.Uniform(-1.0, 4.0), stats.uniform(-1.0, 5.0)),
    "LogUniform": (bp.LogUniform(0.1, 300.0), stats.loguniform(0.1, 300.0)),
    "StudentT": (bp.StudentT(-1.0, 2.0, 3.5), stats.t(3.5, -1.0, 2.0)),
    "InverseGamma": (bp.InverseGamma(3.0, 2.0), stats.invgamma(3.0, scale=2.0)),
    "scipy.stats": (as_prior("prior", stats.gamma(2.5, scale=3.0)), stats.gamma(2.5, scale=3.0)),
}
PROBABILITIES = np.array([1e-6, 1e-3, 0.05, 0.3, 0.5, 0.8, 0.99, 1.0 - 1e-6])
ANALYTIC = {name: case for name, case in CASES.items() if name != "scipy.stats"}


def cases(table=None):
    table = CASES if table is None else table
    return pytest.mark.parametrize(("prior", "reference"), table.values(), ids=table.keys())


@cases()
def test_densities_agree_with_scipy_also_in_the_tails(prior, reference):
    x = np.concatenate([reference.rvs(200, random_state=np.random.default_rng(1)), reference.ppf(PROBABILITIES)])
    low, high = reference.support()
    x = np.concatenate([x, x[(x > low) & (x < high)] * 20.0])
    inside = (x > low) & (x < high)
    assert prior.log_prob(x[inside]) == pytest.approx(reference.logpdf(x[inside]), rel=1e-11, abs=1e-11)
    assert np.all(prior.log_prob(x[~inside]) == -np.inf)


@cases()
def test_densities_integrate_to_one(prior, reference):
    ends = reference.ppf([1e-13, 0.01, 0.5, 0.99, 1.0 - 1e-13])
    total = sum(
        integrate.quad(lambda t: math.exp(prior.log_prob(t)), a, b, epsabs=1e-13, epsrel=1e-12, limit=400)[0]
        for a, b in zip(ends[:-1], ends[1:], strict=True)
    )
    assert total == pytest.approx(1.0, abs=1e-10)


@cases()
def test_supports_equal_those_of_scipy(prior, reference):
    assert prior.support == reference.support()
    assert all(type(end) is float for end in prior.support)


@cases()
def test_quantile_is_the_inverse_of_the_distribution_function(prior, reference):
    x = prior.quantile(PROBABILITIES)
    assert reference.cdf(x) == pytest.approx(PROBABILITIES, rel=1e-9)
    assert tuple(prior.quantile(np.array([0.0, 1.0]))) == prior.support
    assert np.isnan(prior.quantile(np.array([-0.1, 1.1, np.nan]))).all()


@cases()
def test_gradient_and_curvature_match_eighth_order_differences(prior, reference):
    x = prior.quantile(np.array([0.01, 0.2, 0.5, 0.9, 0.999]))
    low, high = prior.support
    width = reference.ppf(0.75) - reference.ppf(0.25)
    h = 0.02 * np.minimum(np.minimum(x - low, high - x), width)
    first = difference(prior.log_prob, x, h)
    second = difference(prior.gradient, x, h)
    assert np.all(np.abs(prior.gradient(x) - first) < 1e-7 * (np.abs(first) + 1 / width))
    assert np.all(np.abs(prior.curvature(x) + second) < 1e-7 * (np.abs(second) + 1 / width**2))


@cases()
def test_samples_follow_the_distribution(prior, reference):
    """Kolmogorov-Smirnov, false-alarm rate 0.1 % a prior; quartile counts within 4 binomial sd, 0.006 % each."""
    draws = prior.sample(5000, np.random.default_rng(7))
    assert draws.shape == (5000,)
    assert stats.kstest(draws, reference.cdf).pvalue > 1e-3
    for p in (0.25, 0.5, 0.75):
        assert abs(np.sum(draws < reference.ppf(p)) - 5000 * p) < 4 * math.sqrt(5000 * p * (1 - p))


@pytest.mark.parametrize("name", ["Normal", "LogNormal", "TruncatedNormal", "HalfNormal", "Uniform", "InverseGamma"])
def test_mean_of_samples_equals_the_mean_of_the_distribution(name):
    """Within 4 standard errors, false-alarm rate 0.006 % each."""
    prior, reference = CASES[name]
    draws = prior.sample(40_000, np.random.default_rng(8))
    assert abs(draws.mean() - reference.mean()) < 4 * reference.std() / math.sqrt(draws.size)


@cases()
def test_arrays_of_any_shape_keep_their_shape(prior, reference):
    x = prior.quantile(np.linspace(0.1, 0.9, 6)).reshape(2, 3)
    for function in (prior.log_prob, prior.gradient, prior.curvature):
        assert function(x).shape == (2, 3)
        assert function(x)[1, 2] == pytest.approx(function(x[1, 2]), rel=1e-12)
        assert np.ndim(function(float(x[0, 0]))) == 0
    assert prior.quantile(np.full((2, 3), 0.5)).shape == (2, 3)
    assert np.ndim(prior.quantile(0.5)) == 0


@cases()
def test_density_outside_the_support_is_zero_and_its_gradient_nan(prior, reference):
    low, high = prior.support
    outside = np.array([x for x in (low, low - 1.0, high, high + 1.0, np.nan)])
    assert np.all(prior.log_prob(outside) == -np.inf)
    assert np.isnan(prior.gradient(outside)).all() and np.isnan(prior.curvature(outside)).all()


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (40.0, INFINITY),
        (40.0, 41.0),
        (40.0, 40.0 + 1e-6),
        (1e4, 1e4 + 1e-3),
        (1e8, INFINITY),
        (-9.0, -8.5),
        (-INFINITY, -50.0),
        (-1e-12, 1e-12),
        (0.0, INFINITY),
    ],
)
def test_truncated_normal_is_exact_far_in_the_tail(low, high):
    """Against 60-digit quadrature of exp(−a t − t²/2) from the end next to the mean."""
    prior = bp.TruncatedNormal(0.0, 1.0, low, high)
    x = prior.quantile(np.array([0.001, 0.3, 0.5, 0.95]))
    assert np.all(np.diff(x) >= 0.0) and x[0] >= low and x[-1] <= high
    x = x[(x > low) & (x < high)]
    with mpmath.workdps(60):
        end = 0.0 if low < 0.0 < high else (low if low >= 0.0 else -high)
        start, stop = (low, high) if low < 0.0 < high else (0.0, mpmath.mpf(high) - low)
        reach = min(mpmath.mpf(stop), mpmath.mpf(150) / (1 + end))
        mass = mpmath.quad(lambda t: mpmath.exp(-end * t - t**2 / 2), mpmath.linspace(start, reach, 7))
        expected = [float(-((mpmath.mpf(abs(t)) - end) * (mpmath.mpf(abs(t)) + end)) / 2 - mpmath.log(mass)) for t in x]
    assert prior.log_prob(x) == pytest.approx(expected, rel=1e-13, abs=1e-13)


def test_truncated_normal_tail_is_nearly_exponential():
    """P(X > x) = exp(−(x² − a²)/2)·erfcx ratio; at a = 1000 the median lies ln 2/a beyond a, to 1/a²."""
    median = bp.TruncatedNormal(0.0, 1.0, 1e3, INFINITY).quantile(0.5)
    assert (median - 1e3) * 1e3 == pytest.approx(math.log(2.0), rel=2e-6)


SMOOTH = {
    "norm": (stats.norm(1e6, 1.0), bp.Normal(1e6, 1.0)),
    "narrow norm": (stats.norm(-3.0, 1e-4), bp.Normal(-3.0, 1e-4)),
    "lognorm": (stats.lognorm(0.7, scale=3.0), bp.LogNormal(3.0, 0.7)),
    "wide lognorm": (stats.lognorm(2.0, scale=3.0), bp.LogNormal(3.0, 2.0)),
    "t": (stats.t(3.0, 5.0, 2.0), bp.StudentT(5.0, 2.0, 3.0)),
    "cauchy": (stats.cauchy(5.0, 2.0), bp.StudentT(5.0, 2.0, 1.0)),
    "invgamma": (stats.invgamma(3.0, scale=2.0), bp.InverseGamma(3.0, 2.0)),
}


@cases(SMOOTH)
def test_numerical_derivatives_of_scipys_densities_are_as_accurate_as_documented(prior, reference):
    wrapped, exact, x = FromScipy(prior), reference, prior.ppf(PROBABILITIES)
    width = prior.ppf(0.75) - prior.ppf(0.25)
    gradient, curvature = exact.gradient(x), exact.curvature(x)
    assert np.all(np.abs(wrapped.gradient(x) - gradient) < 1e-10 * (np.abs(gradient) + 1 / width))
    assert np.all(np.abs(wrapped.curvature(x) - curvature) < 1e-9 * (np.abs(curvature) + 1 / width**2))


@pytest.mark.parametrize("dof", [1.0, 1.5, 2.5, 3.0, 5.0, 10.0, 30.0])
@pytest.mark.parametrize("p", [1e-20, 1e-140, 1e-200, 1e-300])
def test_quantiles_of_student_t_far_in_the_tail_have_their_probability(dof, p):
    """The incomplete beta function of mpmath with 50 digits; SciPy's `stdtrit` is wrong there."""
    score = float(bp.StudentT(0.0, 1.0, dof).quantile(p))
    with mpmath.workdps(50):
        share = mpmath.mpf(dof) / (mpmath.mpf(dof) + mpmath.mpf(score) ** 2)
        found = mpmath.betainc(mpmath.mpf(dof) / 2, 0.5, 0, share, regularized=True) / 2
    assert score < 0.0 and float(found / mpmath.mpf(p)) == pytest.approx(1.0, rel=1e-11)


def test_numerical_derivatives_stay_inside_the_support():
    """At a distance d from the end of the support the curvature may lose 1e-13/d²."""
    exact, wrapped = bp.LogUniform(1.0, 1e5), FromScipy(stats.loguniform(1.0, 1e5))
    distance = np.array([1e-5, 1e-3, 1e-1])
    error = np.abs(wrapped.curvature(1.0 + distance) - exact.curvature(1.0 + distance))
    assert np.all(error < 1e-13 / distance**2 + 1e-9)


def test_scipy_priors_have_a_constructor_repr_and_compare_by_value():
    assert repr(FromScipy(stats.gamma(2.0, scale=3.0))) == "scipy.stats.gamma(2.0, scale=3.0)"
    assert FromScipy(stats.gamma(2.0, scale=3.0)) == FromScipy(stats.gamma(2.0, scale=3.0))
    assert FromScipy(stats.gamma(2.0)) != FromScipy(stats.gamma(2.0 + 1e-15))
    histograms = [stats.rv_histogram((np.array(n), np.arange(4.0)))() for n in ([1, 2, 1], [1, 2, 2], [1, 2, 1])]
    texts = [repr(FromScipy(h)) for h in histograms]
    assert texts[0] == texts[2] != texts[1]
    assert " at 0x" not in texts[0]


def test_equal_priors_have_the_same_repr():
    assert repr(bp.Normal(np.float64(800), 60)) == repr(bp.Normal(800.0, 60.0)) == "Normal(mean=800.0, sd=60.0)"
    assert bp.TruncatedNormal(1, 2, 0, np.inf) == bp.TruncatedNormal(1.0, 2.0, 0.0, INFINITY)


def random_joint(size, seed):
    generator = np.random.default_rng(seed)
    scale = 10.0 ** generator.uniform(-3, 3, size)
    root = generator.standard_normal((size, 2 * size))
    mean = generator.standard_normal(size) * scale
    return bp.MultivariateNormal(mean, root @ root.T / (2 * size) * np.outer(scale, scale))


@pytest.mark.parametrize("size", [1, 2, 5])
def test_multivariate_normal_agrees_with_scipy(size):
    prior = random_joint(size, seed=2)
    x = prior.sample(20, np.random.default_rng(3)).reshape(4, 5, size)
    sd = np.sqrt(np.diag(prior.covariance))
    reference = stats.multivariate_normal(np.zeros(size), prior.covariance / np.outer(sd, sd))
    expected = np.asarray(reference.logpdf((x - prior.mean) / sd)) - np.log(sd).sum()
    assert prior.log_prob(x) == pytest.approx(expected.reshape(4, 5), rel=1e-11, abs=1e-11)
    assert prior.log_prob(x[1, 2]) == pytest.approx(prior.log_prob(x)[1, 2], rel=1e-12)
    assert prior.log_prob(np.full(size, np.nan)) == -np.inf == prior.log_prob(np.full(size, np.inf))


def test_multivariate_normal_has_the_derivatives_of_its_density():
    prior = random_joint(3, seed=4)
    x = prior.sample(6, np.random.default_rng(5)).reshape(2, 3, 3)
    sd = np.sqrt(np.diag(prior.covariance))
    assert prior.gradient(x).shape == (2, 3, 3) and prior.curvature(x).shape == (2, 3, 3, 3)
    for i, step in enumerate(np.eye(3) * sd * 1e-3):
        first = (prior.log_prob(x + step) - prior.log_prob(x - step)) / (2 * step[i])
        second = (prior.gradient(x + step) - prior.gradient(x - step)) / (2 * step[i])
        assert np.all(np.abs(prior.gradient(x)[..., i] - first) * sd[i] < 1e-9 * (1 + np.abs(first) * sd[i]))
        assert prior.curvature(x)[..., i, :] * sd == pytest.approx(-second * sd, rel=1e-9)
    product = prior.curvature(x)[0, 0] @ prior.covariance * np.outer(sd, 1 / sd)
    assert product == pytest.approx(np.eye(3), abs=1e-10)


def test_multivariate_normal_samples_have_its_moments():
    """Means within 4 standard errors, χ² of the whitened squares by Kolmogorov-Smirnov at 0.1 %, 20,000 draws."""
    prior = random_joint(3, seed=6)
    draws = prior.sample(20_000, np.random.default_rng(7))
    assert draws.shape == (20_000, 3)
    assert np.all(np.abs(draws.mean(0) - prior.mean) < 4 * np.sqrt(np.diag(prior.covariance) / 20_000))
    offset = draws - prior.mean
    square = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(prior.covariance), offset)
    assert stats.kstest(square, stats.chi2(3).cdf).pvalue > 1e-3
    sd = np.sqrt(np.diag(prior.covariance))
    correlation = prior.covariance / np.outer(sd, sd)
    sampling_sd = (1 - correlation[0, 1] ** 2) / math.sqrt(20_000)
    assert abs(np.corrcoef(draws.T)[0, 1] - correlation[0, 1]) < 4 * sampling_sd


def test_multivariate_normal_repr_holds_all_its_numbers():
    size = 60
    covariance = np.eye(size) + 1e-3
    prior, other = bp.MultivariateNormal(np.zeros(size), covariance), covariance.copy()
    other[30, 31] = other[31, 30] = 2e-3
    assert "..." not in repr(prior)
    assert prior != bp.MultivariateNormal(np.zeros(size), other)
    assert prior == eval(repr(prior), {"MultivariateNormal": bp.MultivariateNormal})
    assert hash(prior) == hash(bp.MultivariateNormal(np.zeros(size), covariance))


def test_multivariate_normal_copies_its_covariance():
    covariance = np.eye(2)
    prior = bp.MultivariateNormal([0.0, 0.0], covariance)
    covariance[0, 0] = 9.0
    assert prior.marginal(0) == bp.Normal(0.0, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        prior.covariance[0, 0] = 9.0


@pytest.fixture
def joint():
    block = bp.MultivariateNormal([1.0, 2.0], [[4.0, 1.0], [1.0, 9.0]])
    return JointPrior.of({("d", "a"): block, "b": bp.LogNormal(3.0, 0.5)}, ["a", "b", "c", "d"])


def test_blocks_of_a_joint_prior_follow_the_order_of_the_names(joint):
    assert joint.names == ("a", "b", "d")
    assert list(joint.blocks) == [("d", "a"), "b"]
    block, single = joint.blocks.values()
    theta = np.array([[2.5, 3.3, 0.5], [1.0, 2.0, 3.0]])
    assert joint.log_prob(theta) == pytest.approx(block.log_prob(theta[:, [2, 0]]) + single.log_prob(theta[:, 1]))
    gradient, curvature = joint.gradient(theta), joint.curvature(theta)
    assert gradient[:, [2, 0]] == pytest.approx(block.gradient(theta[:, [2, 0]]))
    assert gradient[:, 1] == pytest.approx(single.gradient(theta[:, 1]))
    precision = np.linalg.inv(block.covariance)
    assert curvature[0] == pytest.approx(
        np.array(
            [
                [precision[1, 1], 0.0, precision[0, 1]],
                [0.0, single.curvature(3.3), 0.0],
                [precision[0, 1], 0.0, precision[0, 0]],
            ]
        )
    )
    assert curvature.shape == (2, 3, 3)
    assert joint.curvature(theta[1]) == pytest.approx(curvature[1])
    assert joint.supports == {"a": (-INFINITY, INFINITY), "b": (0.0, INFINITY), "d": (-INFINITY, INFINITY)}
    assert joint.median() == pytest.approx([2.0, 3.0, 1.0])
    assert joint.marginals["a"] == bp.Normal(2.0, 3.0)


def test_joint_samples_are_correlated_within_a_block_only(joint):
    """Correlation 1/6 within 4 sd (false-alarm rate 0.006 %), independence of the other block likewise."""
    draws = joint.sample(20_000, np.random.default_rng(9))
    correlation = np.corrcoef(draws.T)
    assert abs(correlation[0, 2] - 1 / 6) < 4 / math.sqrt(20_000)
    assert abs(correlation[0, 1]) < 4 / math.sqrt(20_000)


def test_excluding_names_the_parameters_of_the_block(joint):
    assert joint.excluding(np.array([1.0, 1.0, 1.0])) == ()
    assert joint.excluding(np.array([1.0, -1.0, 1.0])) == ("b",)
    assert joint.excluding(np.array([1.0, 1.0, np.nan])) == ("d", "a")


def test_any_object_with_the_prior_functions_is_a_prior():
    normal = bp.Normal(0.0, 1.0)
    functions = ("support", "log_prob", "gradient", "curvature", "quantile", "sample")
    own = SimpleNamespace(**{name: getattr(normal, name) for name in functions})
    assert as_prior("priors['k']", own) is own


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: bp.Normal(0.0, 0.0), "sd: must be > 0, got 0.0"),
        (lambda: bp.Normal(np.nan, 1.0), "mean: must be finite, got nan"),
        (lambda: bp.LogNormal(-1.0, 1.0), "median: must be .*got -1.0"),
        (lambda: bp.LogNormal(1.0, 0.0), "spread: must be .*got 0.0"),
        (lambda: bp.Uniform(2.0, 1.0), "low: must be less than high = 1.0, got 2.0"),
        (lambda: bp.Uniform(0.0, np.inf), "high: must be finite, got inf"),
        (lambda: bp.TruncatedNormal(0.0, -1.0, 0.0, 1.0), "sd: must be .*got -1.0"),
        (lambda: bp.TruncatedNormal(0.0, 1.0, np.nan, 1.0), "low: must be a real number or infinite, got nan"),
        (lambda: bp.TruncatedNormal(0.0, 1.0, 0.0, "x"), "high: must be a real number or infinite, got 'x'"),
        (lambda: bp.TruncatedNormal(0.0, 1.0, 1.0, 1.0), "low: must be less than high = 1.0, got 1.0"),
        (lambda: bp.HalfNormal(0.0), "scale: must be .*got 0.0"),
        (lambda: bp.LogUniform(0.0, 1.0), "low: must be > 0, got 0.0"),
        (lambda: bp.LogUniform(2.0, 1.0), "low: must be less than high = 1.0, got 2.0"),
        (lambda: bp.StudentT(0.0, 0.0, 3.0), "scale: must be .*got 0.0"),
        (lambda: bp.StudentT(0.0, 1.0, 0.0), "dof: must be .*got 0.0"),
        (lambda: bp.InverseGamma(0.0, 1.0), "shape: must be .*got 0.0"),
        (lambda: bp.InverseGamma(1.0, "wide"), "scale: must be a real number, got 'wide'"),
        (lambda: bp.MultivariateNormal([0.0, np.nan], np.eye(2)), "mean: must be finite, got nan at index 1"),
        (
            lambda: bp.MultivariateNormal([0.0, 1.0], np.eye(3)),
            r"covariance: must have the shape \(2, 2\) .*got \(3, 3\)",
        ),
        (lambda: bp.MultivariateNormal([0.0, 1.0], "wide"), "covariance: must be a matrix of real numbers, got 'wide'"),
        (lambda: bp.MultivariateNormal([0.0], [[np.inf]]), r"covariance: must be finite, got \[\[inf\]\]"),
        (lambda: bp.MultivariateNormal([0, 0], [[1, 0.5], [0.4, 1]]), "covariance: must be symmetric, got"),
        (lambda: bp.MultivariateNormal([0, 0], [[1, 2], [2, 1]]), "covariance: must be positive definite, got"),
        (lambda: bp.MultivariateNormal([0, 0], [[1, 1], [1, 1]]), "covariance: must be positive definite, got"),
        (lambda: bp.MultivariateNormal([0, 0], [[0, 0], [0, 1]]), "covariance: must be positive definite, got"),
        (
            lambda: bp.MultivariateNormal([0, 0], np.eye(2)).log_prob(np.zeros(3)),
            "x: last axis must have 2 values, got shape",
        ),
    ],
)
def test_error_names_the_bad_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3.0, r"priors\['k'\]: must be a prior such as Normal\(mean, sd\), or a frozen .*got 3.0"),
        (bp.Normal, r"priors\['k'\]: must be a prior .*got <class .*Normal'>"),
        (stats.poisson(3.0), r"priors\['k'\]: must be continuous, got the discrete scipy.stats.poisson\(3.0\)"),
        (stats.norm, r"priors\['k'\]: must be frozen, got scipy.stats.norm. Give scipy.stats.norm\(…\)"),
        (stats.norm(0.0, -1.0), r"must be in the range of scipy.stats, got scipy.stats.norm\(0.0, -1.0\)"),
        (stats.norm([0.0, 1.0]), r"must be of one variable, .*got scipy.stats.norm\(\[0.0, 1.0\]\)"),
        (stats.multivariate_normal([0.0, 1.0]), r"priors\['k'\]: must be a prior such as .*got"),
        (bp.MultivariateNormal([0.0], [[1.0]]), r"got MultivariateNormal\(.*\). Give a tuple of names"),
    ],
)
def test_error_names_what_is_no_prior(value, message):
    with pytest.raises(ValueError, match=message):
        as_prior("priors['k']", value)


@pytest.mark.parametrize("size", [1e-300, 1e-151, 1e151, 1e300])
@pytest.mark.parametrize(
    "prior",
    [
        lambda size: bp.Normal(0.0, size),
        lambda size: bp.HalfNormal(size),
        lambda size: bp.LogNormal(1.0, size),
        lambda size: bp.StudentT(0.0, 1.0, size),
        lambda size: bp.StudentT(0.0, size, 4.0),
        lambda size: bp.TruncatedNormal(0.0, size, -1.0, math.inf),
        lambda size: bp.InverseGamma(3.0, size),
    ],
)
def test_sizes_whose_squares_are_no_floats_are_refused(prior, size):
    with pytest.raises(ValueError, match="must be between 1e-150 and 1e.150, got"):
        prior(size)
