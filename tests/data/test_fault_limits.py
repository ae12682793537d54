"""Limits of the rules for faulty samples: cases just inside and just outside, and closed forms of what is chance."""

import numpy as np
import pytest
from scipy.stats import poisson

from bayesperiodic.data import faults


def noise(count, seed=0, size=1.0):
    return size * np.random.default_rng(seed).standard_normal(count)


def with_runs(values, *runs):
    """Return values with runs of one value: pairs of the first sample and the length."""
    values = values.copy()
    for first, length in runs:
        values[first : first + length] = values[first]
    return values


@pytest.mark.parametrize(
    "count, runs, pairs, held",
    [
        (1100, [3], 0, [3]), (900, [3], 0, []), (900, [4], 0, [4]), (900, [3, 3], 0, [3, 3]), (1000, [3], 9, []),
        (1100, [4], 9, [4]), (800, [4], 9, []), (900, [2], 0, []), (5000, [3, 3, 3], 4, [3, 3, 3]),
        (900, [9, 3], 0, [9, 3]),
    ],
)  # fmt: skip
def test_short_runs_are_held_if_chance_gives_so_many_once_in_a_thousand(count, runs, pairs, held):
    """Of exact noise, the next value is the same one with the probability p of the pairs, one more than there are.

    In n samples n·p^(k−1) runs of k or more begin, which are Poisson-distributed.
    """
    places = [(40 + 60 * i, length) for i, length in enumerate(runs)]
    values = with_runs(noise(count), *places, *((count // 2 + 7 * i, 2) for i in range(pairs)))
    same = (pairs + sum(length == 2 for length in runs) + 1.0) / count
    least = min(held, default=max(runs))
    longer = sum(length >= least for length in runs)
    mean = count * same ** (least - 1)
    assert (mean < 0.05 * longer and poisson.sf(longer - 1, mean) < 1e-3 and least > 2) == bool(held)
    wanted = [k for first, length in places if length in held for k in range(first, first + length)]
    assert faults.brief_of(values, 0.0).tolist() == wanted


def test_runs_at_the_ends_of_the_range_and_without_noise_are_not_held():
    values = noise(2000)
    for end in (values.argmax(), values.argmin()):
        assert faults.brief_of(with_runs(values, (int(end), 8)), 0.0).size == 0
    smooth = with_runs(np.sin(np.arange(2000) / 300), (700, 5))
    assert faults.brief_of(smooth, 0.0).size == 0
    assert faults.brief_of(np.full(50, 2.0), 0.0).size == 0
    assert faults.brief_of(with_runs(values, (300, 5)), 3.0).size == 0  # noise below half of the step says nothing
    assert faults.brief_of(with_runs(values, (300, 5)), 0.01).tolist() == [*range(300, 305)]


@pytest.mark.parametrize("length, found", [(9, False), (10, True)])
def test_ten_samples_of_one_value_are_stuck(length, found):
    values = with_runs(noise(300), (77, length))
    assert faults.stuck_of(values) == [slice(77, 77 + length)] * found


@pytest.mark.parametrize("repeats", [2, 4])
@pytest.mark.parametrize("factor, found", [(9, False), (10, True)])
def test_stuck_stretches_are_ten_times_as_long_as_usual_ones(repeats, factor, found):
    values = with_runs(np.repeat(noise(80), repeats), (20 * repeats, factor * repeats))
    assert faults.stuck_of(values) == [slice(20 * repeats, (20 + factor) * repeats)] * found


@pytest.mark.parametrize("runs, stuck", [(1, 1), (2, 2), (3, 0), (4, 0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_three_stretches_at_an_end_of_the_range_are_clipped_and_not_stuck(runs, stuck, sign):
    values = sign * noise(600)
    limit = sign * 10.0
    for k in range(runs):
        values[50 + 100 * k : 70 + 100 * k] = limit
    assert len(faults.stuck_of(values)) == stuck
    values[570:590] = values[570]  # one within the range is stuck in any case
    assert faults.stuck_of(values)[-1] == slice(570, 590)


def test_signals_of_one_or_few_values_are_not_stuck():
    assert faults.stuck_of(np.zeros(50)) == [] and faults.stuck_of(np.repeat([0.0, 1.0] * 2, 30)) == []


@pytest.mark.parametrize(
    "runs, share, held",
    [(18, 1.0, True), (17, 1.0, False), (40, 0.92, True), (40, 0.87, False)],
)
def test_a_slower_logger_has_eighteen_values_and_nine_tenths_of_its_runs_alike(runs, share, held):
    """The first and the last run are cut and do not count; runs of two values that are equal are twice as long."""
    odd = round((1.0 - share) * runs)
    lengths = np.array([5, *([4] * odd + [5] * (runs - odd)), 5])
    values = np.repeat(np.arange(lengths.size) + 0.5, lengths)
    repeats, repeated = faults.held_of(values)
    assert (repeats == 5) == held and bool(repeated.size) == held
    if held and odd == 0:
        assert repeated.tolist() == [k for k in range(values.size) if k % 5]
        twice = np.delete(values, slice(5 * 9, 5 * 10))
        twice = np.insert(twice, 45, np.full(5, values[44]))
        assert faults.held_of(twice)[0] == (5 if runs > 18 else 1)


@pytest.mark.parametrize("turn", [1.0, 360.0])
@pytest.mark.parametrize("divisions, wraps", [(9, False), (11, True), (200, True)])
def test_range_of_a_wrapped_angle_that_is_sampled_coarsely_is_nine_tenths_of_a_turn(turn, divisions, wraps):
    values = turn * (np.arange(40 * divisions) % divisions) / divisions
    assert faults.wrap_of(values, 0.0)[0] == (turn if wraps else 0.0)


@pytest.mark.parametrize("turn", [1.0, 360.0])
@pytest.mark.parametrize("span, wraps", [(0.89, False), (1.0, True), (1.0005, True), (1.002, False)])
def test_range_of_a_wrapped_angle_is_a_turn(turn, span, wraps):
    """Up to 100.1 %."""
    place = np.linspace(0.0, 12.0, 1201)[:-1] % 1.0
    values = turn * span * place / np.ptp(place)
    assert faults.wrap_of(values, 0.0)[0] == (turn if wraps else 0.0)
    # The last step of a counter belongs to the range.
    assert faults.wrap_of(turn * 1.0015 * place / np.ptp(place), 0.001 * turn)[0] == turn


@pytest.mark.parametrize("steps, found", [(2**5, False), (2**6, True), (2**16, True)])
def test_counters_have_six_bits_at_least(steps, found):
    counts = np.round(0.013 * steps * np.arange(2000)) % steps
    turn, jumps = faults.wrap_of(0.37 * counts, 0.37)
    assert turn == pytest.approx(0.37 * steps if found else 0.0)
    assert jumps.tolist() == (np.flatnonzero(np.diff(counts) < 0) + 1).tolist() * found


def test_a_coarse_counter_with_nearly_the_range_of_an_angle_wraps_at_its_own():
    """In 64 steps of 5.8 V it jumps by 45, 4.08 V: less than 65 % of 2π."""
    counts = 19 * np.arange(500)
    turn, places = faults.wrap_of(5.8 / 64 * (counts % 64), 5.8 / 64)
    assert turn == pytest.approx(5.8) and places.tolist() == (np.flatnonzero(np.diff(counts // 64)) + 1).tolist()


def test_values_that_are_not_smooth_when_they_are_unwrapped_do_not_wrap():
    """White noise, whose steps have twice its variance, at both ends of the range; a slow motion there wraps."""
    white = np.random.default_rng(1).uniform(-0.24, 0.24, 1000)
    slow = 0.24 * np.sin(np.arange(1000) / 20)
    assert faults.wrap_of(white % 1.0, 0.0)[0] == 0.0 and faults.wrap_of(slow % 1.0, 0.0)[0] == 1.0


@pytest.mark.parametrize("count", [300, 30_000])
@pytest.mark.parametrize("size", [0.01, 3.0])
def test_noise_by_fourth_differences_is_its_standard_deviation(count, size):
    """The median of n values has a relative error of 1.17/√n; correlated ones some more: within five of them."""
    assert faults.fast_noise(noise(count, 1, size)) == pytest.approx(size, rel=8.0 / np.sqrt(min(count, 20_000)))
    slow = 100.0 * np.sin(np.arange(count) / 500)
    assert faults.fast_noise(slow + noise(count, 1, size)) == pytest.approx(size, rel=8.0 / np.sqrt(min(count, 20_000)))
    assert faults.fast_noise(np.repeat(noise(count, 1, size), 20)) > 0.1 * size
    assert faults.fast_noise(np.zeros(count)) == faults.fast_noise(np.arange(4.0)) == 0.0


def test_noise_of_a_long_recording_is_that_of_its_middle():
    values = np.concatenate([noise(15_000, 1, 9.0), noise(20_000, 2), noise(15_000, 3, 9.0)])
    assert faults.fast_noise(values) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_noise_at_the_same_phase_of_several_cycles(seed):
    """A signal of 40 cycles; the median has a relative error of 2 % here: within six of them."""
    phase = np.sort(np.random.default_rng(seed).uniform(0.0, 40.0, 8000))
    values = np.cos(2 * np.pi * phase) + noise(8000, seed, 0.1)
    assert faults.repeat_noise(phase, values, np.zeros(0, dtype=int)) == pytest.approx(0.1, rel=0.1)
    wrong = np.arange(0, 8000, 2)
    values[wrong] += noise(4000, seed + 5, 50.0)
    assert faults.repeat_noise(phase, values, wrong) == pytest.approx(0.1, rel=0.15)
    assert faults.repeat_noise(phase[:5], values[:5], np.zeros(0, dtype=int)) == 0.0


def test_noise_at_the_same_phase_of_three_samples_is_that_from_their_line():
    """At a quarter between its neighbours, √(1 + 1/16 + 9/16) of the noise of one; six samples are the fewest."""
    phase = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    values = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    rest = np.array([0.5, 1.0, 0.5, 0.0]) / np.sqrt(1.5)
    assert faults.repeat_noise(phase, values, np.zeros(0, int)) == pytest.approx(1.4826 * np.median(rest))
    assert faults.repeat_noise(phase[::-1] + 7.0, values[::-1], np.zeros(0, int)) == pytest.approx(
        1.4826 * np.median(rest)
    )
    quarter = np.array([0.0, 0.1, 0.4, 0.5, 0.8, 0.9])
    rest = np.array([0.25, 1.0, 0.75 / 1, 0.0])
    weights = np.array([0.25, 0.75, 0.25, 0.75])
    expected = rest / np.sqrt(1.0 + weights**2 + (1.0 - weights) ** 2)
    values = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert faults.repeat_noise(quarter, values, np.zeros(0, int)) == pytest.approx(1.4826 * np.median(expected))


@pytest.mark.parametrize(
    "samples, rows",
    [
        ([1, 2, 3], True), ([1, 2, 4, 5], False), ([1, 2, 3, 10], True), ([1, 2, 3, 10, 20], False), ([1, 5, 9], False),
        ([1, 2, 3, 10, 11, 20], True), ([4], False),
    ],
)  # fmt: skip
def test_clipped_samples_in_rows_are_three_in_a_row_and_half_beside_another(samples, rows):
    assert faults.in_rows(np.array(samples)) == rows


def piled(top, levels=100, others=1, scattered=False):
    """Return values with so many samples at the highest of some levels, in rows of three or scattered."""
    values = np.repeat(np.arange(levels) / levels, others)
    values = np.random.default_rng(0).permutation(values)
    if scattered:
        return np.insert(values, np.linspace(1, values.size - 1, top).astype(int), 1.0)
    return np.concatenate([values[:30], np.full(top, 1.0), values[30:]])


@pytest.mark.parametrize(
    "arguments, clipped",
    [
        ({"top": 6}, False), ({"top": 7}, True), ({"top": 5}, False), ({"top": 12, "others": 2}, False),
        ({"top": 13, "others": 2}, True), ({"top": 7, "levels": 17}, True), ({"top": 7, "levels": 16}, False),
        ({"top": 44, "levels": 55}, True), ({"top": 47, "levels": 53}, False), ({"top": 9, "scattered": True}, False),
        ({"top": 10, "scattered": True}, True),
    ],
)  # fmt: skip
def test_clipped_samples_are_six_times_more_than_at_other_levels(arguments, clipped):
    """Scattered ones are ten at least; of 18 levels at least, and 45 % of the samples at most."""
    values = piled(**arguments)
    for sign in (1.0, -1.0):
        low, high = faults.clipped_of(sign * values, [])
        assert (high if sign > 0 else low).tolist() == np.flatnonzero(values == 1.0).tolist() * clipped
        assert (low if sign > 0 else high).size == 0
    if clipped and "scattered" not in arguments:
        assert (
            faults.clipped_of(values, [slice(*(np.flatnonzero(values == 1.0)[[0, -1]] + [0, 1]))])[1].size == 0
        )  # stuck


@pytest.mark.parametrize("gap, clipped", [(19.0, True), (21.0, False)])
def test_scattered_samples_above_a_gap_are_an_exact_maximum(gap, clipped):
    values = piled(10, scattered=True)
    values[values == 1.0] = 0.99 + 0.01 * gap
    assert bool(faults.clipped_of(values, [])[1].size) == clipped


@pytest.mark.parametrize(
    "zeros, levels, others, dropped",
    [(6, 40, 1, True), (5, 40, 1, False), (12, 40, 2, True), (11, 40, 2, False), (44, 56, 1, True), (47, 53, 1, False),
     (7, 17, 1, True), (7, 16, 1, False)],
)  # fmt: skip
def test_a_value_of_dropouts_is_six_times_as_frequent_as_any_other_one(zeros, levels, others, dropped):
    values = np.concatenate([np.zeros(zeros), np.repeat(1.0 + np.arange(levels), others)])
    assert faults.dropped_value(np.random.default_rng(1).permutation(values)) == (0.0 if dropped else None)


@pytest.mark.parametrize("size, jump", [(4.9, False), (5.1, True)])
def test_a_jump_is_five_times_the_usual_step(size, jump):
    """Of steps that are equal but one."""
    steps = np.ones(200) * (-1.0) ** np.arange(200)
    steps[77] *= size
    quiet = 1e3 * np.cumsum((-1.0) ** np.arange(200))
    assert faults.jumps(np.array([np.cumsum(steps)])) == faults.jumps(np.array([quiet, np.cumsum(steps)])) == jump


@pytest.mark.parametrize("far, found", [(7.5, False), (8.6, True)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_outliers_are_eight_standard_deviations_from_the_middle(far, found, sign):
    """The standard deviation is the robust one of the sample itself; the middle is not zero."""
    residuals = noise(2001) + 3.0
    middle = np.median(residuals)
    scale = 1.4826 * np.median(np.abs(residuals - middle))
    residuals[500] = middle + sign * far * scale
    values = residuals.copy()
    values[499] = values[501] = middle
    assert faults.outliers_of(residuals, np.arange(2001) / 50, values, 0.0).tolist() == [500] * found
    assert faults.outliers_of(residuals, np.arange(2001) / 50, values, 5.0 * scale).size == 0  # below two steps


@pytest.mark.parametrize("often, kept", [(24, True), (33, False)])
def test_runs_at_one_phase_of_half_of_the_cycles_belong_to_the_signal(often, kept):
    """Of 60 cycles; with three times as many as expected by chance anywhere, 3·3/64·runs/cycles < 1 here."""
    phase = np.arange(60 * 50) / 50
    samples = 50 * np.arange(often) + 20
    assert (faults.single(samples, phase).size == often) == kept
    assert faults.single(np.zeros(0, dtype=int), phase).size == 0
    some = np.array([20, 21, 22, 777])
    assert faults.single(some, phase).tolist() == some.tolist()


def test_step_of_rounding_errors_is_none():
    values = np.round(noise(500), 2)
    assert faults.resolution(values) == pytest.approx(0.01)
    exact = np.sin(np.arange(500))
    assert faults.resolution(np.float64(1e6) + np.float64(2.0) ** -33 * np.round(exact * 8)) > 0.0
    assert faults.resolution(exact) == 0.0


def zigzag(count=600, **runs):
    """Return values 0, 1, 0, 1, … with other ones from some samples on, which one marks of them as far."""
    values, far = np.arange(count) % 2.0, np.zeros(count, dtype=bool)
    for first, some in runs.items():
        at = int(first[1:]) % count
        values[at : at + len(some)] = some
        far[at : at + len(some)] = True
    return values, far


@pytest.mark.parametrize(
    "first, some, lone",
    [
        ("k101", [2.6], True), ("k101", [2.4], False), ("k100", [3.6], True), ("k100", [3.4], False),
        ("k101", [-2.6], True), ("k101", [9.0, 9.2, 2.6], True), ("k101", [9.0, 9.2, 2.4], False),
        ("k101", [2.4, 9.2, 9.0], False), ("k0", [9.0, 2.6], True), ("k0", [9.0, 2.4], False),
        ("k598", [3.6, 9.0], True),
        ("k598", [3.4, 9.0], False), ("k0", [9.0], True), ("k599", [9.0], True),
        ("k0", [9.0, 9.2], True), ("k598", [9.2, 9.0], True),
    ],
)  # fmt: skip
def test_outliers_jump_in_and_out_by_two_steps_of_the_others_and_one_of_the_resolution(first, some, lone):
    """The others' steps are 1, of the resolution half a step: 2.5 before and after; none beyond an end."""
    values, far = zigzag(**{first: some})
    found = faults._lone(far, np.arange(600) / 50, values, 0.5)
    assert found.tolist() == np.flatnonzero(far).tolist() * lone
    inverse = faults._lone(far, 7.3 + np.arange(600) / 50, 3.0 - values, 0.5)
    assert inverse.tolist() == found.tolist()


def test_usual_steps_are_the_largest_but_a_hundredth_of_those_between_sound_samples():
    """Of 1997 steps, 18 or 22 are of 4 and the others of 1; those beside what is far do not count."""
    for peaks, lone in ((9, True), (11, False)):
        values, far = zigzag(2000, k1001=[7.9])
        values[3 : 3 + 40 * peaks : 40] = 4.0
        assert faults._lone(far, np.arange(2000) / 50, values, 0.0).tolist() == [1001] * lone


def test_without_sound_samples_that_vary_there_are_no_outliers():
    values, far = zigzag(k101=[9.0])
    phase = np.arange(600) / 50
    for which, given in ((~far & far, values), (~far | far, values), (far, np.where(far, 9.0, 2.0))):
        assert faults._lone(which, phase, given, 0.0).size == 0
    # No two sound samples in a row: any jump is more than the usual one.
    alternate = np.arange(600) % 2 == 1
    assert faults._lone(alternate, phase, np.where(alternate, 9.0, np.arange(600) / 600), 0.0).size == 300


@pytest.mark.parametrize("width, lone", [(9, False), (11, True)])
def test_runs_of_each_cycle_are_of_the_signal_unless_they_are_a_fifth_of_it(width, lone):
    """Of 50 samples a cycle."""
    phase = np.arange(600) / 50
    far = (np.arange(600) % 50 >= 20) & (np.arange(600) % 50 < 20 + width)
    values = np.where(far, 30.0 + np.arange(600), np.arange(600) % 2)
    assert faults._lone(far, phase, values, 0.0).tolist() == np.flatnonzero(far).tolist() * lone


@pytest.mark.parametrize("apart, every", [(11, True), (9, False)])
def test_all_samples_of_the_value_of_dropouts_are_lost_if_more_than_two_fifths_jump(apart, every):
    """Of 25 samples of 0.48 in a triangle wave of steps of 0.04, so many are dropouts at its peaks; others cross it."""
    place = np.arange(2000) / 100
    values = 4.0 * np.abs(place % 1.0 - 0.5) + 1e-6 * np.arange(2000)
    near = np.flatnonzero(np.abs(values - 0.48) < 0.01)[: 25 - apart]
    peaks = np.flatnonzero(np.diff(np.sign(np.diff(values))) < 0)[:apart] + 1
    values[near] = values[peaks] = 0.48
    assert faults.dropped_value(values) == 0.48 and near.size == 25 - apart and peaks.size == apart
    found = faults._lone(np.zeros(2000, dtype=bool), 0.618 * place, values, 0.0)
    assert found.tolist() == np.sort(np.concatenate([peaks, near]) if every else peaks).tolist()
