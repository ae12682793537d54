"""Outliers that are noise: tails continued by a power law, and impulses of random size and sign; and faults' limits."""

import numpy as np
import pytest
from scipy import stats

from bayesperiodic.data import faults
from bayesperiodic.data.faults import heavy_tails

COUNT = 4000


def balanced(sizes, far, apart):
    """Return residuals with the median 0: as many others on each side as there are large ones."""
    places = 100 + apart * np.arange(len(sizes))
    outliers = 3000 + 50 * np.arange(len(far))
    large = np.concatenate([places, outliers]).astype(int)
    residuals = np.zeros(COUNT)
    rest = np.setdiff1d(np.arange(COUNT), large)
    signs = np.ones(COUNT)
    signs[large] = np.sign(np.concatenate([sizes, far]))
    below = COUNT // 2 - np.count_nonzero(signs[large] < 0)
    signs[rest[::2][:below]] = -1.0
    signs[rest[1::2][: max(below - rest[::2].size, 0)]] = -1.0
    residuals = signs / 1.4826
    residuals[large] = np.concatenate([sizes, far])
    assert np.count_nonzero(residuals < 0) == COUNT // 2
    return residuals + 3.0, outliers


@pytest.mark.parametrize(
    "sizes, far, apart, noise",
    [
        ([6.0] * 4, [9.0], 21, True), ([6.0] * 4, [9.0], 20, False), ([6.0] * 3, [9.0], 21, False),
        ([-6.0, 6.0, -6.0, 6.0], [-9.0], 21, True), ([6.0] * 4, [9.0] * 3, 21, True), ([6.0] * 4, [9.0] * 4, 21, False),
        ([6.0] * 5, [9.0] * 4, 21, True), ([3.9, 3.9, 7.0, 7.0], [9.0], 21, False),
        ([4.1, 4.1, 7.0, 7.0], [9.0], 21, True),
        ([8.1] * 4, [9.0], 21, False), ([7.9] * 4, [9.0], 21, True), ([6.0, 6.0, 6.0, 3.9], [9.0], 21, False),
    ],
)  # fmt: skip
def test_outliers_beyond_tails_are_noise(sizes, far, apart, noise):
    """Between 4 and 8 standard deviations 0.25 of 4000 normal values are expected: 4 are twice as many and three more.

    Those nearer than 4000/200 samples are one; as many as the outliers must be more than by chance.
    """
    assert 2.0 * 4000 * 2 * stats.norm.sf(4.0) + 3.0 == pytest.approx(3.507, abs=1e-3)
    residuals, outliers = balanced(sizes, far, apart)
    assert heavy_tails(residuals, outliers, np.zeros(COUNT)).tolist() == [noise] * len(far)


@pytest.mark.parametrize("factor, noise", [(0.98, True), (1.02, False)])
@pytest.mark.parametrize("sizes, other", [([6.0] * 5, 6.0), ([5.0, 5.0, 7.0, 7.0, 7.0, 7.0], 7.0)])
def test_tails_are_continued_by_a_power_law(factor, noise, sizes, other):
    """Of 6 or 7 values beyond 4, half beyond the median m: n (x/4)^(−ln 2/ln(m/4)) larger than x, one in a thousand."""
    count = len(sizes) + 1
    index = np.log(2.0) / np.log(other / 4.0)
    limit = 4.0 * (1e3 * count) ** (1.0 / index)
    residuals, outliers = balanced(sizes, [factor * limit], 30)
    assert heavy_tails(residuals, outliers, np.zeros(COUNT)).tolist() == [noise]
    # An outlier within the tails is one of them.
    every = np.append(outliers, 100)
    assert heavy_tails(residuals, every, np.zeros(COUNT)).tolist() == [noise, True]


def impulses(sizes, predicted=None):
    residuals, outliers = balanced([], sizes, 1)
    model = np.zeros(COUNT)
    model[outliers] = np.cos(np.arange(len(sizes))) if predicted is None else predicted
    return heavy_tails(residuals, outliers, model).tolist()


@pytest.mark.parametrize(
    "count, above, noise", [(10, 5, True), (9, 5, False), (10, 1, True), (10, 0, False), (10, 9, True), (10, 10, False)]
)
def test_impulses_are_ten_at_least_and_on_both_sides(count, above, noise):
    """The probabilities of 1 or none of 10, on either side, are 2.1 % and 0.2 %; 1 % is the limit."""
    sizes = np.linspace(10.0, 90.0, count) * np.where(np.arange(count) * 7 % count < above, 1.0, -1.0)
    assert np.count_nonzero(sizes > 0) == above
    assert impulses(sizes) == [noise] * count


@pytest.mark.parametrize("ratio, noise", [(2.4, False), (2.6, True)])
def test_impulses_differ_in_size(ratio, noise):
    """Of 11 sizes, the second and the last but one are the quantiles of 10 % and 90 %."""
    sizes = np.r_[9.9, 10.0, np.linspace(11.0, 20.0, 7), 10.0 * ratio, 99.0] * np.resize([1.0, -1.0], 11)
    assert impulses(sizes) == [noise] * 11


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("factor, noise", [(0.98, True), (1.02, False)])
def test_impulses_that_replace_the_signal_are_faults(sign, factor, noise):
    """If their correlation with the signal is more than 3/√n."""
    sizes = np.linspace(10.0, 90.0, 16) * np.resize([1.0, -1.0], 16)
    along = (sizes - sizes.mean()) / sizes.std()
    across = np.cos(np.arange(16.0))
    across -= across.mean() + along * (across @ along) / 16
    across /= across.std()
    share = factor * 3.0 / 4.0
    assert impulses(sizes, sign * share * along + np.sqrt(1.0 - share**2) * across) == [noise] * 16


def test_without_outliers_or_scatter_nothing_is_noise():
    assert heavy_tails(np.arange(9.0), np.zeros(0, dtype=int), np.zeros(9)).size == 0
    still = np.zeros(90)
    still[7] = 9.0
    assert heavy_tails(still, np.array([7]), np.zeros(90)).tolist() == [False]


@pytest.mark.parametrize("different, spacing", [(97, 0.5), (98, 0.0), (100, 0.0)])
def test_spacing_of_values_that_return(different, spacing):
    """faults._spacing: the median difference of levels, if less than 98 % of the values differ."""
    values = np.r_[0.5 * np.arange(different - 1), 400.0, np.zeros(100 - different)]
    assert faults._spacing(np.random.default_rng(1).permutation(values)) == spacing


def test_spacing_is_that_of_the_first_values():
    values = np.concatenate([np.resize([0.0, 3.0], 20_000), np.arange(30_000.0) / 7])
    assert faults._spacing(values) == 3.0 and faults._spacing(values[::-1]) == 0.0


@pytest.mark.parametrize("step, held", [(0.0, True), (0.5, False), (2.0, False)])
def test_runs_of_rounded_noise_are_compared_with_its_step(step, held):
    """brief_of: of noise rounded to half of its size, erf(1/√32) = 20 % of the values equal the one before.

    A run of three is no fault of rounded values, whether the step is given or that of the values.
    """
    exact = 0.05 * np.random.default_rng(4).standard_normal(3000)
    rounded = 0.025 * np.round(exact / 0.025)
    assert faults.brief_of(rounded, 0.025 if step else 0.0).size == 0
    exact[700:703] = exact[700]
    expected = [700, 701, 702] if held else []
    assert faults.brief_of(exact, step * 0.05).tolist() == expected


@pytest.mark.parametrize("size, kept", [(0.51, True), (0.49, False)])
def test_noise_of_held_values_is_more_than_half_of_their_step(size, kept):
    values = np.random.default_rng(4).standard_normal(3000)
    values /= faults.fast_noise(values)
    values[900:960] = values[900]
    noise = faults.fast_noise(values)
    assert bool(faults.brief_of(values, noise / size).size) == kept


@pytest.mark.parametrize("runs, cycles, share", [(3, 12.0, 3 / 12 * 3 / 64), (64, 1.0, 3.0)])
def test_share_of_cycles_with_a_run_in_three_of_64_intervals(runs, cycles, share):
    assert faults._expected(runs, cycles) == pytest.approx(share)


def test_runs_at_about_one_phase_are_counted_once_in_each_cycle():
    """faults._often: in an interval of 1/64 cycle and its neighbours, those at the ends of the cycle among them."""
    phase = 2.0 + np.arange(10 * 128) / 128
    first = np.array([0, 1, 128, 2 * 128, 5 * 128 + 2, 6 * 128 - 1, 7 * 128 + 64, 8 * 128 + 66, 9 * 128 + 70])
    # Intervals 0 (cycles 0, 1, 2), 1 (5), 63 (5), 32 (7), 33 (8), 35 (9), of 9.99 cycles.
    expected = np.array([5, 5, 5, 5, 4, 4, 2, 2, 1]) / np.ptp(phase)
    assert faults._often(phase, first) == pytest.approx(expected)
    short = faults._often(phase[:64], np.array([3]))
    assert short.tolist() == [1.0]


@pytest.mark.parametrize("distance, left", [(24, []), (3, [20, 21, 22])])
def test_single_runs_are_kept_and_repeated_ones_are_not(distance, left):
    """single: of 12 cycles of 24 samples, the same three samples in each or in one."""
    phase = np.arange(12 * 24) / 24
    many = np.concatenate([np.arange(20, 23) + 24 * k for k in range(12 if distance == 24 else 1)])
    assert faults.single(many, phase).tolist() == left
    # Neighbouring samples belong to one run, which is kept as a whole.
    both = np.sort(np.append(many, [60, 61]))
    assert faults.single(both, phase).tolist() == sorted([*left, 60, 61])


@pytest.mark.parametrize("count, kept", [(15, True), (14, False)])
def test_many_single_runs_are_kept_in_few_cycles(count, kept):
    """single: of 1.5 cycles, each run is in one; three times the share n/1.5·3/64 expected by chance is twice of it."""
    assert (1.0 / 1.5 < 0.5 * 3.0 * count / 1.5 * 3.0 / 64.0) == kept
    phase = np.linspace(0.0, 1.5, 6000)
    samples = np.searchsorted(phase, np.arange(count) * 0.06 + 0.001)
    assert faults.single(samples, phase).tolist() == samples.tolist() * kept
