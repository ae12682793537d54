import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp

CASES = [
    (bp.Normal(2.0, 0.5), stats.norm(2.0, 0.5), np.array([-1.0, 0.3, 2.0, 5.0])),
    (bp.LogNormal(3.0, 0.7), stats.lognorm(0.7, scale=3.0), np.array([0.1, 2.0, 3.0, 40.0])),
    (bp.Uniform(-1.0, 4.0), stats.uniform(-1.0, 5.0), np.array([-0.9, 0.0, 3.9])),
]


@pytest.mark.parametrize(("prior", "reference", "x"), CASES)
def test_densities_quantiles_and_supports_agree_with_scipy(prior, reference, x):
    assert prior.log_prob(x) == pytest.approx(reference.logpdf(x))
    probability = np.array([0.01, 0.5, 0.9])
    assert prior.quantile(probability) == pytest.approx(reference.ppf(probability))
    assert prior.support == reference.support()


@pytest.mark.parametrize(("prior", "reference", "x"), CASES)
def test_gradient_and_curvature_match_differences(prior, reference, x):
    h = 1e-5
    first = (reference.logpdf(x + h) - reference.logpdf(x - h)) / (2 * h)
    second = (prior.gradient(x + h) - prior.gradient(x - h)) / (2 * h)
    assert prior.gradient(x) == pytest.approx(first, rel=1e-6, abs=1e-6)
    assert prior.curvature(x) == pytest.approx(-second, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(("prior", "reference", "x"), CASES)
def test_samples_follow_the_distribution(prior, reference, x):
    """Kolmogorov-Smirnov, false-alarm rate 0.1 % a prior."""
    assert stats.kstest(prior.sample(5000, np.random.default_rng(7)), reference.cdf).pvalue > 1e-3


def test_outside_the_support_the_density_is_zero():
    assert np.all(bp.LogNormal(1.0, 1.0).log_prob(np.array([-1.0, 0.0])) == -np.inf)
    assert np.all(bp.Uniform(0.0, 1.0).log_prob(np.array([-0.1, 1.1])) == -np.inf)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: bp.Normal(0.0, 0.0), "sd: 0.0 is not allowed"),
        (lambda: bp.Normal(np.nan, 1.0), "mean: nan is not allowed"),
        (lambda: bp.LogNormal(-1.0, 1.0), "median: -1.0 is not allowed"),
        (lambda: bp.Uniform(2.0, 1.0), "low: 2.0 is not allowed; it must be less than high = 1.0"),
    ],
)
def test_bad_parameters_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
