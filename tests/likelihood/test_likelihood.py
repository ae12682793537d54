"""Bookkeeping of the likelihood: variances of single values, groups of noise parameters, stacked residuals."""

import numpy as np
import pytest

from bayesperiodic import noise
from bayesperiodic.likelihood.likelihood import Likelihood, Residuals
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.samples import Samples
from bayesperiodic.likelihood.section_points import SectionPoints


def block(kind=MeanPeriod, size=9, **changes):
    half = np.arange(1, (size + 1) // 2)
    given = {
        "experiment": "run", "channel": "y", "count": float(size), "size": size,
        "harmonic": np.array([0, *half, *half]) if kind is MeanPeriod else np.empty(0),
        "position": np.array([0, 1, 4, 5, 9, 13, 14, 17, 19]) / 20 if kind is Samples else np.empty(0),
        "points": 20, "averaged": 10.0 * size, "measured": 0.7,
    }  # fmt: skip
    return kind(**(given | changes))


@pytest.mark.parametrize(("kind", "size"), [(MeanPeriod, 9), (Samples, 9)])
def test_variance_of_one_value_of_white_noise_is_that_of_a_mean_of_ten_samples(kind, size):
    """The values of nine components or points are means of ninety samples."""
    model = Likelihood(noise.Independent(), [block(kind, size)], {})
    found = model.value_variances(np.array([[3.0], [5.0]]))
    assert list(found) == [("run", "y")]
    assert found["run", "y"] == pytest.approx([0.3, 0.5])


def test_whole_sections_have_no_variance_of_their_own():
    blocks = [block(SectionPoints, 4, channel="scale"), block()]
    model = Likelihood(noise.Independent(), blocks, {})
    assert list(model.value_variances(np.array([2.0, 3.0]))) == [("run", "y")]


def test_groups_counts_and_measured_variances_are_by_name():
    blocks = [block(), block(experiment="two", count=6.0, measured=0.4), block(channel="z", measured=np.nan)]
    model = Likelihood(noise.Independent(), blocks, {"variance[z]": 2.0})
    assert (model.names, model.free) == (("variance[y]", "variance[z]"), ("variance[y]",))
    assert model.groups() == [(("variance[y]",), [0, 1]), (("variance[z]",), [2])]
    assert model.counts == {"variance[y]": 15.0, "variance[z]": 9.0}
    assert model.measured["variance[y]"] == pytest.approx((9 * 0.7 + 6 * 0.4) / 15)
    assert model.complete(np.array([[4.0], [5.0]])).tolist() == [[4.0, 2.0], [5.0, 2.0]]
    each = Likelihood(noise.Independent(per="experiment"), blocks, {})
    assert each.names == ("variance[y, run]", "variance[y, two]", "variance[z, run]")


def test_unknown_parameters_start_at_the_medians_of_their_priors():
    model = Likelihood(noise.Circulant(kernel="matern"), [block()], {"floor[y]": 0.2})
    start = dict(zip(model.names, model.guess(), strict=True))
    assert start == {"variance[y]": 1.0, "lengthscale[y]": pytest.approx(0.03), "floor[y]": 0.2}


def test_moments_are_weighted_squares_in_units_of_the_spectrum():
    r = [np.arange(1.0, 10.0), np.full(9, 2.0)]
    blocks = [block(count=4.5), block(experiment="two")]
    model = Likelihood(noise.Independent(), blocks, {})
    assert model.moments(r)["variance[y]"] == pytest.approx((0.5 * np.sum(r[0] ** 2) + 36.0) / (9 / 90.0))
    circulant = noise.Circulant(kernel="exponential")
    shaped = Likelihood(circulant, blocks, {"lengthscale[y]": 0.1})
    spectrum = circulant.spectrum(blocks[0], np.array([1.0, 0.1]))[0]
    expected = 0.5 * np.sum(r[0] ** 2 / spectrum) + np.sum(r[1] ** 2 / spectrum)
    assert shaped.moments(r)["variance[y]"] == pytest.approx(expected)


def test_stacked_residuals_behave_like_a_list():
    stacks = [np.arange(12.0).reshape(2, 2, 3), 100.0 + np.arange(4.0).reshape(1, 2, 2)]
    stacked = Residuals(stacks, [(0, 1), (1, 0), (0, 0)])
    parts = [stacks[0][1], stacks[1][0], stacks[0][0]]
    assert len(stacked) == 3 and all(np.array_equal(a, b) for a, b in zip(stacked, parts, strict=True))
    assert stacked.squares == pytest.approx(np.stack([np.sum(p**2, axis=-1) for p in parts], axis=-1))
    one = stacked.at(1)
    assert [x.tolist() for x in one] == [p[1].tolist() for p in parts]
    assert [x.tolist() for x in one.scaled(np.array([1.0, 2.0, 3.0]))] == [
        (f * p[1]).tolist() for f, p in zip((1.0, 2.0, 3.0), parts, strict=True)
    ]
    other = one.like([np.zeros(3), np.ones(2), np.full(3, 2.0)])
    assert [x.tolist() for x in other] == [[0.0] * 3, [1.0] * 2, [2.0] * 3]
    assert one.like(other) is other and Residuals.of(one) is one
    assert np.array_equal(Residuals.of(parts)[1], parts[1])


def test_names_and_values_of_fixed_noise_are_checked():
    with pytest.raises(ValueError, match="^fixed: must be 'variance"):
        Likelihood(noise.Independent(), [block()], {"variance[x]": 1.0})
    with pytest.raises(ValueError, match=r"^fixed\['variance\[y\]'\]: must be > 0, got 0.0"):
        Likelihood(noise.Independent(), [block()], {"variance[y]": 0.0})
