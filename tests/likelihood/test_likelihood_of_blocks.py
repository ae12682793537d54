"""A likelihood of blocks of all kinds at once, against the normal density of each, and its parts by name."""

import numpy as np
import pytest
from scipy import stats

from bayesperiodic import noise
from bayesperiodic.likelihood.likelihood import Likelihood, Residuals
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers
from bayesperiodic.likelihood.samples import Samples
from tests.known import difference

HARMONIC = np.array([0, 1, 2, 3, 1, 2, 3])
POSITION = np.array([0, 1, 4, 5, 9]) / 16


def block(kind, size, channel="y", experiment="run", weight=1.0):
    harmonic = HARMONIC if kind is MeanPeriod else np.empty(0)
    position = POSITION if kind is Samples else np.empty(0)
    return kind(experiment, channel, weight * size, size, harmonic, position, 16, 10.0 * size, 0.7)


# Two of a kind, one with half the weight, two channels at the points of a mask, and multipliers of two sizes.
BLOCKS = [
    block(MeanPeriod, 7), block(Samples, 5, "y", "masked"), block(MeanPeriod, 7, experiment="two"),
    block(MeanPeriod, 7, "z", weight=0.5), block(Multipliers, 2, "multipliers"),
    block(Samples, 5, "z", "masked", weight=0.5), block(Multipliers, 3, "multipliers", "two"),
]  # fmt: skip
FACTORS = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
GENERATOR = np.random.default_rng(8)
R = [GENERATOR.standard_normal((2, b.size)) for b in BLOCKS]
MODELS = {"circulant": noise.Circulant(kernel="exponential"), "white": noise.Independent()}


@pytest.fixture(params=MODELS)
def case(request):
    """Return a likelihood, parameters (2, names), and the covariance of each block at each of the two."""
    likelihood = Likelihood(MODELS[request.param], BLOCKS, {})
    values = np.exp(0.5 * np.random.default_rng(9).standard_normal((2, len(likelihood.names))) - 1.0)
    covariances = []
    for each in values:
        named = dict(zip(likelihood.names, each, strict=True))
        covariances.append([covariance_of(b, named, request.param == "circulant") for b in BLOCKS])
    return likelihood, values, covariances


def covariance_of(b, named, correlated):
    """Return the covariance of the components of a block, the weight not included.

    White noise: v · size/averaged. Correlated noise of variance v on 16 points: with S_h of mean 1 over all harmonics.
    """
    if isinstance(b, Multipliers):
        return np.eye(b.size)
    v = named[f"variance[{b.channel}]"]
    if not correlated:
        return v / 10.0 * np.eye(b.size)
    waves = np.minimum(np.arange(16), 16 - np.arange(16))
    power = 1.0 / (1.0 + (2 * np.pi * waves * named[f"lengthscale[{b.channel}]"]) ** 2)
    spectrum = power / power.mean()
    if isinstance(b, MeanPeriod):
        return np.diag(v * spectrum[HARMONIC] * 7 / 16)
    lag = np.rint(16 * (POSITION[:, None] - POSITION)).astype(int)
    return v * np.mean(spectrum[:, None, None] * np.cos(2 * np.pi * np.arange(16)[:, None, None] * lag / 16), axis=0)


def expected(covariances, residuals, factors):
    """Return −½ Σ weight [factor · ln|S| + rᵀS⁻¹r], by logpdf of SciPy less its (2π)^(−n/2)."""
    total = 0.0
    for b, s, r, factor in zip(BLOCKS, covariances, residuals, factors, strict=True):
        density = stats.multivariate_normal(cov=s).logpdf(r) + 0.5 * b.size * np.log(2 * np.pi)
        total += b.weight * (density + 0.5 * (1.0 - factor) * np.linalg.slogdet(s)[1])
    return total


@pytest.mark.parametrize("factors", [1.0, 0.8, FACTORS])
def test_the_likelihood_is_the_sum_of_those_of_its_blocks(case, factors):
    likelihood, values, covariances = case
    if likelihood.model.name == "independent" and np.ndim(factors):
        factors = np.where([b.counted for b in BLOCKS], 0.7, 0.4)
    each = np.broadcast_to(factors, len(BLOCKS)).copy()
    # Blocks with the same variance have the same factor.
    each[2] = each[0]
    found = likelihood(R, values, each)
    assert found == pytest.approx([expected(covariances[i], [r[i] for r in R], each) for i in range(2)], rel=1e-10)
    for i in range(2):
        one = [r[i] for r in R]
        value, by_residual, by_value = likelihood.value_and_gradients(one, values[i], each)
        assert value == pytest.approx(found[i], rel=1e-12)
        for b, s, r, slope in zip(BLOCKS, covariances[i], one, by_residual, strict=True):
            assert slope == pytest.approx(-b.weight * np.linalg.solve(s, r), rel=1e-9)
        for k in range(values.shape[1]):
            along = np.eye(values.shape[1])[k]

            def moved(x, along=along, one=one, i=i):
                there = values[i] * np.exp(x * along)
                return float(likelihood(one, there, each) + likelihood.log_prior(there))

            assert by_value[k] == pytest.approx(difference(moved), rel=1e-7, abs=1e-8)


def test_whitened_vectors_and_units_have_the_covariance_of_the_noise(case):
    likelihood, values, covariances = case
    for i in range(2):
        white = likelihood.whitened([np.eye(b.size) for b in BLOCKS], values[i])
        for b, s, w in zip(BLOCKS, covariances[i], white, strict=True):
            assert w @ w.T == pytest.approx(b.weight * np.linalg.inv(s), rel=1e-9, abs=1e-9)
        single = likelihood.whitened([r[i] for r in R], values[i])
        for b, s, r, w in zip(BLOCKS, covariances[i], R, single, strict=True):
            assert w.shape == (b.size,) and w @ w == pytest.approx(b.weight * r[i] @ np.linalg.solve(s, r[i]))
        # Of white noise of variance one: the root of the sum of squares of what it causes.
        for unit, w in zip(likelihood.units(values[i]), white, strict=True):
            assert unit == pytest.approx(np.linalg.norm(w, axis=0))


def test_simulated_noise_has_the_covariance_of_each_block(case):
    """500 draws: each entry within five of its errors, √((s_ii s_jj + s_ij²)/N); at most one run in 100 fails."""
    likelihood, values, covariances = case
    draws = likelihood.simulate(np.repeat(values[:1], 500, axis=0), np.random.default_rng(1))
    for s, r in zip(covariances[0], draws, strict=True):
        error = np.sqrt((np.outer(np.diag(s), np.diag(s)) + s**2) / 500)
        assert np.all(np.abs(r.T @ r / 500 - s) < 5.0 * error)


def test_terms_are_those_of_values_and_sum_to_the_likelihood(case):
    likelihood, values, covariances = case
    terms = likelihood.terms(R, values)
    assert terms.shape == (2, len(likelihood.observations))
    assert terms.sum(axis=-1) == pytest.approx(likelihood(R, values))
    names = np.array([name.partition(":")[0] for name in likelihood.observations])
    for i in range(2):
        by_run = {name: 0.0 for name in ("run", "masked", "two")}
        for b, s, r in zip(BLOCKS, covariances[i], R, strict=True):
            by_run[b.experiment] -= 0.5 * b.weight * (np.linalg.slogdet(s)[1] + r[i] @ np.linalg.solve(s, r[i]))
        assert {name: terms[i, names == name].sum() for name in by_run} == pytest.approx(by_run)


def test_a_covariance_that_is_not_positive_definite_has_no_density_and_no_gradients():
    class Bad(noise.Circulant):
        def covariance(self, block, values):
            """Return a covariance with a negative eigenvalue for a variance above 1."""
            matrix, slopes = super().covariance(block, values)
            return (matrix, slopes) if values[0] < 1.0 else (-matrix, slopes)

    masked = [BLOCKS[1]]
    likelihood = Likelihood(Bad(kernel="exponential"), masked, {})
    values = np.array([[0.5, 0.1], [2.0, 0.1]])
    found = likelihood([R[1]], values)
    assert np.isfinite(found).tolist() == [True, False] and found[1] == -np.inf
    assert likelihood.value_and_gradients([R[1][0]], values[0])[0] == pytest.approx(found[0])
    value, by_residual, by_value = likelihood.value_and_gradients([R[1][0]], values[1])
    prior = likelihood._prior_slopes(values[1], False)
    assert value == -np.inf and not by_residual[0].any() and by_value == pytest.approx(prior)


def test_sizes_of_spectra_are_checked():
    class Wrong(noise.Independent):
        shapes = ((2,), (2, 1))

        def spectrum(self, block, values):
            """Return variances and slopes of these shapes."""
            return np.ones(self.shapes[0]), np.ones(self.shapes[1])

    for shapes in (((2,), (2, 1)), ((7,), (7, 2)), ((1,), (2, 1)), ((1, 1), (1, 1))):
        Wrong.shapes = shapes
        with pytest.raises(
            ValueError, match=r"noise: must have a spectrum of shapes .* \(…, 7\) .* for 'y' of 'run', "
        ):
            Likelihood(Wrong(), [BLOCKS[0]], {})
    for shapes in (((7,), (7, 1)), ((7,), (1, 1)), ((1,), (1, 1))):
        Wrong.shapes = shapes
        assert Likelihood(Wrong(), [BLOCKS[0]], {}).white == (shapes[0] == (1,))


def test_kinds_of_blocks_are_told_apart(case):
    likelihood, _, _ = case
    correlated = likelihood.model.name != "independent"
    assert (likelihood.white, likelihood.correlated) == (not correlated, correlated)
    # Multipliers count by their number, others by their independent values; the masked points of both channels too.
    assert likelihood.values == pytest.approx(7 + 5 + 7 + 3.5 + 2 + 2.5 + 3)
    counts = {"variance[y]": 19.0, "variance[z]": 6.0}
    assert {name: likelihood.counts[name] for name in counts} == pytest.approx(counts)
    assert [b for _, members in likelihood.groups() for b in members] == [0, 1, 2, 3, 5]


def test_components_of_some_blocks_are_removed_without_changing_the_others():
    stacks = [np.arange(12.0).reshape(2, 2, 3), 100.0 + np.arange(4.0).reshape(1, 2, 2)]
    stacked = Residuals(stacks, [(0, 1), (1, 0), (0, 0)])
    left = stacked.without([0])
    assert [part.any() for part in left] == [False, True, True]
    assert np.array_equal(left[2], stacks[0][0]) and left[1] is not None and left.stacks[1] is stacks[1]
    assert stacked[0].any(), "the given ones are kept"
    assert [part.any() for part in stacked.without([0, 1, 2])] == [False] * 3
