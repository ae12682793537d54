"""Errors of the inputs in the likelihood: against dense normal distributions, differences and a static regression."""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.posterior.likelihood import Likelihood
from bayesperiodic.posterior.noise import KNOWN, SPECTRAL, Block

HARMONIC = np.array([0, 1, 2, 3, 1, 2, 3])


def block(channel: str, kind: str = SPECTRAL, weight: float = 1.0, measured: float = 0.02) -> Block:
    size = HARMONIC.size if kind == SPECTRAL else 2
    return Block("run", channel, kind, weight * size, size, HARMONIC, np.empty(0), 16, 4.0 * size, measured)


NOISES = {
    "independent": bp.noise.Independent(),
    "measured": bp.noise.Measured(),
    "circulant": bp.noise.Circulant(),
    "flat": bp.noise.Independent(prior="flat"),
    "proper": bp.noise.Independent(prior=bp.InverseGamma(3, 2)),
}
BLOCKS = [block("x"), block("y"), block("multipliers", KNOWN)]


@pytest.fixture(params=NOISES)
def case(request: pytest.FixtureRequest) -> tuple[Likelihood, list[np.ndarray], np.ndarray, np.ndarray]:
    """A likelihood of two channels and two known values that share four errors, residuals, and noise parameters."""
    random = np.random.default_rng(1)
    loadings = 0.3 * random.standard_normal((16, 4))
    likelihood = Likelihood(NOISES[request.param], BLOCKS, {}, {"run": loadings})
    residuals = [0.4 * random.standard_normal(b.size) for b in BLOCKS]
    return likelihood, residuals, np.exp(0.5 * random.standard_normal(len(likelihood.names)) - 1.0), loadings


def dense(likelihood: Likelihood, values: np.ndarray, loadings: np.ndarray) -> np.ndarray:
    """Return the covariance of all components."""
    plain = [np.ones(2) if b.kind == KNOWN else None for b in BLOCKS]
    for i, b in enumerate(BLOCKS):
        if plain[i] is None:
            own = [likelihood.names.index(n) for n in likelihood.model.parameter_names(b)]
            plain[i] = likelihood.model.spectrum(b, values[own])[0]
    return np.diag(np.concatenate(plain)) + loadings @ loadings.T


def test_the_likelihood_is_that_of_a_normal_distribution_with_the_dense_covariance(case):
    likelihood, residuals, values, loadings = case
    joined = np.concatenate(residuals)
    exact = stats.multivariate_normal(np.zeros(16), dense(likelihood, values, loadings)).logpdf(joined)
    assert likelihood(residuals, values) == pytest.approx(exact + 8 * np.log(2 * np.pi), rel=1e-10)
    assert likelihood.terms(residuals, values).sum() == pytest.approx(float(likelihood(residuals, values)), rel=1e-10)
    white = np.concatenate(likelihood.whitened(residuals, values))
    solved = np.linalg.solve(dense(likelihood, values, loadings), joined)
    assert white @ white == pytest.approx(joined @ solved, rel=1e-10)


def test_several_points_at_once_give_the_same_bits_as_single_ones(case):
    likelihood, residuals, values, _ = case
    many = [np.stack([r, 2 * r, -r]) for r in residuals]
    rows = np.stack([values, 1.5 * values, values])
    together = likelihood(many, rows)
    assert all(likelihood([r[i] for r in many], rows[i]) == together[i] for i in range(3))


def test_gradients_are_those_of_differences(case):
    likelihood, residuals, values, _ = case
    by_residual, by_value = likelihood.gradients(residuals, values)

    def density(r: list[np.ndarray], phi: np.ndarray) -> float:
        return float(likelihood(r, phi) + likelihood.log_prior(phi))

    for i in range(values.size):
        up, down = values.copy(), values.copy()
        up[i] *= np.exp(1e-5)
        down[i] *= np.exp(-1e-5)
        slope = (density(residuals, up) - density(residuals, down)) / 2e-5
        assert by_value[i] == pytest.approx(slope, rel=1e-6, abs=1e-7)
    for b, r in enumerate(residuals):
        for j in range(r.size):
            ends = [[*residuals[:b], r + sign * 1e-6 * np.eye(r.size)[j], *residuals[b + 1 :]] for sign in (1, -1)]
            slope = (density(ends[0], values) - density(ends[1], values)) / 2e-6
            assert by_residual[b][j] == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_simulated_noise_has_the_covariance(case):
    """20 000 draws; each of 136 elements within five standard errors: false-alarm rate below 1e-4."""
    likelihood, _, values, loadings = case
    draws = np.concatenate(likelihood.simulate(np.tile(values, (20_000, 1)), np.random.default_rng(3)), axis=1)
    wanted, found = dense(likelihood, values, loadings), np.cov(draws.T)
    error = np.sqrt((np.outer(np.diag(wanted), np.diag(wanted)) + wanted**2) / 20_000)
    assert np.abs((found - wanted) / error).max() < 5.0


def test_jeffreys_prior_is_the_root_of_the_information_and_proper():
    """Where the errors of the input can explain every component, 1/v alone would diverge as v → 0."""
    loadings = 0.5 * np.random.default_rng(2).standard_normal((7, 9))
    likelihood = Likelihood(bp.noise.Independent(), [block("x")], {}, {"run": loadings})
    added = np.linalg.eigvalsh(loadings @ loadings.T)
    gain = 7 / 28.0
    for v in (1e-6, 1e-2, 1.0, 1e4):
        information = 0.5 * np.sum((v * gain / (v * gain + added)) ** 2)
        expected = 0.5 * np.log(information / 3.5)
        assert likelihood.log_prior(np.array([v])) == pytest.approx(expected, rel=1e-9)
    ends = likelihood.log_prior(np.array([[1e-12], [1e-10]]))
    assert ends[1] - ends[0] == pytest.approx(np.log(100.0), rel=1e-6)
