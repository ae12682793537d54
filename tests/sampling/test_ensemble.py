"""Moves of several ensembles as one: the ensembles stay apart, and detailed balance holds."""

from dataclasses import replace

import emcee
import numpy as np
import pytest
from scipy import special, stats

from bayesperiodic.sampling.moves import WithinEnsembles, from_mixture, moves
from bayesperiodic.sampling.proposals import (
    StudentMixture,
    expected_time,
    fit_mixture,
    normal_mixture,
    with_tail,
)


def mixture(*means: float, weights: list[float] | None = None, width: float = 1.0) -> StudentMixture:
    """Return Student t distributions in one dimension."""
    count = len(means)
    factors = np.full((count, 1, 1), width)
    shares = np.full(count, 1.0 / count) if weights is None else np.array(weights)
    return StudentMixture(shares, np.array(means)[:, None], factors, np.full(count, 5.0))


def walked(log_prob, starts, used, steps, seed=1):
    """Return the chain (steps, walkers, dimension)."""
    sampler = emcee.EnsembleSampler(*starts.shape, log_prob, moves=used, vectorize=True)
    random = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(emcee.State(starts, random_state=random), steps, skip_initial_state_check=True)
    return sampler.get_chain()


@pytest.mark.parametrize("move", [emcee.moves.DEMove(), emcee.moves.StretchMove()])
def test_proposals_of_an_ensemble_depend_on_its_own_walkers_only(move):
    """Three ensembles, of which the walkers of the others are shifted; same random numbers."""
    generator, within = np.random.default_rng(1), WithinEnsembles(move, 3)
    moving, others = generator.standard_normal((2, 12, 2))
    within.setup(moving)
    proposed, factors = within.get_proposal(moving, [others], np.random.RandomState(1))
    assert np.all(np.any(proposed != moving, axis=1))
    for ensemble in range(3):
        own = np.repeat(np.arange(3), 4) == ensemble
        shifted = np.where(own[:, None], others, others + generator.standard_normal((12, 2)))
        again, same = within.get_proposal(moving, [shifted], np.random.RandomState(1))
        assert np.array_equal(again[own], proposed[own]) and np.array_equal(same[own], factors[own])
        assert np.all(np.any(again[~own] != proposed[~own], axis=1))


def test_a_target_of_two_unequal_modes_is_sampled_from_a_mixture_of_other_weights():
    """0.7 N(4, ½²) + 0.3 N(−4, ½²): weights, means and sds within 5 Monte Carlo errors, from weights of one half.

    False-alarm rate below 1e-5. Without the factor of the proposals the weights would be 0.5.
    """
    two = [stats.norm(4.0, 0.5), stats.norm(-4.0, 0.5)]

    def log_prob(x):
        return np.log(0.7 * two[0].pdf(x[:, 0]) + 0.3 * two[1].pdf(x[:, 0]) + 1e-300)

    starts = np.repeat([4.0, -4.0], 32)[:, None] + 0.1 * np.random.default_rng(2).standard_normal((64, 1))
    chain = walked(log_prob, starts, moves(2, from_mixture(mixture(4.0, -4.0, width=0.7))), 1200)[200:, :, 0]
    positive = chain > 0.0
    each = positive.reshape(1000, -1).mean(axis=0)
    assert abs(positive.mean() - 0.7) < 5.0 * each.std() / np.sqrt(each.size)
    for side, centre in ((chain[positive], 4.0), (chain[~positive], -4.0)):
        error = 5.0 / np.sqrt(side.size / 5.0)
        assert abs(side.mean() - centre) < 0.5 * error and abs(side.std() / 0.5 - 1.0) < error


def test_the_density_of_a_mixture_is_that_of_its_draws_and_integrates_to_one():
    """SciPy's multivariate t; the same after a linear map and its inverse."""
    generator = np.random.default_rng(3)
    factors = np.tril(generator.standard_normal((2, 3, 3))) + 2.0 * np.eye(3)
    own = StudentMixture(np.array([0.3, 0.7]), generator.standard_normal((2, 3)), factors, np.array([5.0, 30.0]))
    points = own.draw(400, generator)
    parts = [
        weight * stats.multivariate_t(mean, factor @ factor.T, df=degrees).pdf(points)
        for weight, mean, factor, degrees in zip(own.weights, own.means, factors, own.degrees, strict=True)
    ]
    assert own.log_density(points) == pytest.approx(np.log(np.sum(parts, axis=0)))
    origin, axes = generator.standard_normal(3), generator.standard_normal((3, 3))
    mapped = own.mapped(origin, axes).log_density(origin + points @ axes.T)
    assert mapped == pytest.approx(own.log_density(points) - np.linalg.slogdet(axes)[1])
    assert StudentMixture.from_lists(own.as_lists()).log_density(points) == pytest.approx(own.log_density(points))
    other = StudentMixture(np.ones(1), np.zeros((1, 3)), 4.0 * np.eye(3)[None], np.array([5.0]))
    drawn = other.draw(100_000, generator)
    ratios = np.exp(own.log_density(drawn) - other.log_density(drawn))
    assert abs(ratios.mean() - 1.0) < 5.0 * ratios.std() / np.sqrt(ratios.size)


def test_a_mixture_is_fitted_with_as_many_components_as_the_draws_show():
    """Two separate normal distributions and one: two kinds of components, of equal and of doubled width."""
    generator = np.random.default_rng(4)
    centres = np.where(generator.random((4, 1500, 1)) < 0.7, 5.0, -5.0) * np.array([1.0, 0.0])
    fitted = fit_mixture(centres + generator.standard_normal((4, 1500, 2)))
    weights = [fitted.weights[fitted.means[:, 0] * sign > 0.0].sum() for sign in (1.0, -1.0)]
    assert weights == pytest.approx([0.7, 0.3], abs=0.03)
    assert len(fit_mixture(generator.standard_normal((4, 1500, 2))).weights) == 2


@pytest.mark.parametrize("distance", [0.0, 20.0])
def test_normal_distributions_fitted_to_groups_far_apart_have_the_moments_of_each(distance):
    """Members of one group only, or of all: shares, means and covariances of the points in each."""
    generator = np.random.default_rng(6)
    groups = [[3.0, 1.0] * generator.standard_normal((900, 2)), 0.5 * generator.standard_normal((300, 2)) + distance]
    groups = groups if distance else [np.concatenate(groups)]
    points = generator.permutation(np.concatenate(groups))
    weights, means, covariances = normal_mixture(points, len(groups))
    order, regular = np.argsort(-weights), 1e-6 * points.var(axis=0).min() * np.eye(2)
    assert weights[order] == pytest.approx([len(group) / len(points) for group in groups])
    assert means[order] == pytest.approx(np.array([group.mean(axis=0) for group in groups]))
    expected = np.array([np.cov(group.T, bias=True) + regular for group in groups])
    assert covariances[order] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_fitted_normal_distributions_are_at_least_as_likely_as_the_true_ones():
    """Three that overlap, in five coordinates, but for the gain at which the fit ends."""
    generator = np.random.default_rng(7)
    truth = np.array([0.5, 0.3, 0.2]), 2.5 * generator.standard_normal((3, 5)), np.array([1.0, 2.0, 0.5])
    group = generator.choice(3, 4000, p=truth[0])
    points = truth[1][group] + np.sqrt(truth[2][group])[:, None] * generator.standard_normal((4000, 5))

    def mean_log_density(weights, means, covariances):
        parts = zip(weights, means, covariances, strict=True)
        return np.log(sum(w * stats.multivariate_normal(m, c).pdf(points) for w, m, c in parts)).mean()

    known = mean_log_density(*truth[:2], truth[2][:, None, None] * np.eye(5))
    assert mean_log_density(*normal_mixture(points, 3)) > known - 0.01
    again = [normal_mixture(points, 3) for _ in range(2)]
    assert all(np.array_equal(*pair) for pair in zip(*again, strict=True))


def test_the_expected_time_of_a_proposal_equal_to_the_target_is_that_of_independent_draws():
    """All proposals accepted in four steps of five: at most 2/0.8 − 1 = 1.5, and more where the mixture is narrow."""
    own = mixture(0.0)
    points = own.draw(20_000, np.random.default_rng(5))
    assert expected_time(own, points, own.log_density(points) + 7.0, 1.0) == pytest.approx(1.0)
    with_others = expected_time(own, points, own.log_density(points), 0.8)
    assert 1.0 < with_others < 1.5
    narrow = mixture(0.0, width=0.3)
    assert expected_time(narrow, points, own.log_density(points), 0.8) > 1.5 * with_others


def curved(count, seed):
    """Return draws of u₀ | u₁, u₂ ~ N(u₁² − 2u₁u₂, 0.1), u₁ and u₂ standard normal, in four ensembles."""
    wide = np.random.default_rng(seed).standard_normal((4, count, 3))
    narrow = wide[..., 1] ** 2 - 2.0 * wide[..., 1] * wide[..., 2] + 0.1 * wide[..., 0]
    return np.concatenate([narrow[..., None], wide[..., 1:]], axis=2)


def test_a_tail_in_many_dimensions_is_covered_along_its_direction():
    """Logarithms of gamma variates, which have a tail exp(0.5 x), among normal ones, turned at random.

    The component has mean and covariance of the draws, but three times the sd along the tail.
    """
    random, dimension, count = np.random.default_rng(4), 20, 20_000
    plain = random.standard_normal((count, dimension))
    plain[:, 0] = np.log(random.gamma(0.5, size=count))
    plain[:, 0] = (plain[:, 0] - special.digamma(0.5)) / np.sqrt(special.polygamma(1, 0.5))
    turn = stats.ortho_group.rvs(dimension, random_state=random)
    draws = plain @ turn.T
    log_density = stats.norm.logpdf(plain[:, 1:]).sum(axis=1)
    natural = special.digamma(0.5) + np.sqrt(special.polygamma(1, 0.5)) * plain[:, 0]
    log_density += 0.5 * natural - np.exp(natural)
    normal = StudentMixture(
        np.ones(1), draws.mean(axis=0)[None], np.linalg.cholesky(np.cov(draws.T))[None], np.array([30.0])
    )
    tailed = with_tail(normal, draws)
    assert tailed.weights.sum() == pytest.approx(1.0)
    factor = tailed.factors[-1]
    assert np.allclose(factor, np.tril(factor)) and np.all(np.diag(factor) > 0.0)
    expected = np.cov(draws.T) + 8.0 * np.outer(turn[:, 0], turn[:, 0])
    assert np.allclose(factor @ factor.T, expected, atol=0.3)
    before, after = (expected_time(one, draws, log_density, 0.8) for one in (normal, tailed))
    assert after < 0.5 * before


def test_a_tail_in_one_dimension_is_wider_than_the_draws():
    draws = np.random.default_rng(5).standard_normal((400, 1))
    tailed = with_tail(mixture(0.0), draws)
    assert tailed.means[-1, 0] == pytest.approx(draws.mean())
    assert tailed.factors[-1, 0, 0] == pytest.approx(3.0 * draws.std(), rel=1e-5)
    assert tailed.weights.tolist() == pytest.approx([0.9, 0.1])


def test_curvature_of_draws_is_found_and_the_mixture_follows_it():
    """The density is N(u₀; u₁² − 2u₁u₂, 0.1) N(u₁) N(u₂)."""
    fitted = fit_mixture(curved(1500, 1))
    assert fitted.curvature == pytest.approx(np.array([[1.0, -2.0, 0.0]]), abs=0.01)
    points = curved(1500, 2).reshape(-1, 3)
    known = stats.norm(points[:, 1] ** 2 - 2.0 * points[:, 1] * points[:, 2], 0.1).logpdf(points[:, 0])
    known += stats.norm.logpdf(points[:, 1:]).sum(axis=1)
    assert expected_time(fitted, points, known, 0.8) < 2.5
    assert fitted.straightened(fitted.straightened(points), 1.0) == pytest.approx(points)
    assert StudentMixture.from_lists(fitted.as_lists()).log_density(points) == pytest.approx(fitted.log_density(points))


def test_draws_of_a_curved_mixture_have_its_density():
    """The mean of the ratio of two densities over draws of one is 1, within 5 standard errors; E u₀ = E u₁² = 1."""
    own = fit_mixture(curved(1500, 1))
    drawn = own.draw(100_000, np.random.default_rng(3))
    other = replace(own, curvature=np.array([[0.9, -1.9, 0.1]]), factors=0.9 * own.factors)
    ratios = np.exp(other.log_density(drawn) - own.log_density(drawn))
    assert abs(ratios.mean() - 1.0) < 5.0 * ratios.std() / np.sqrt(ratios.size)
    assert drawn[:, 0].mean() == pytest.approx((drawn[:, 1] ** 2).mean(), abs=0.1)


def test_straight_draws_are_not_bent():
    """A quadratic form must raise the log-density of draws left out by 0.01; false-alarm rate below 1e-3."""
    assert fit_mixture(np.random.default_rng(4).standard_normal((4, 1500, 5))).curvature.size == 0
