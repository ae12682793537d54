"""Phases of channels: steps and drifts against brute force, whose they are, and their numbers in words."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from bayesperiodic.data import clocks
from bayesperiodic.data.clocks import Drift, Phases, PhaseStep
from bayesperiodic.data.recording_check import RUINOUS, SERIOUS
from tests.data.test_steady_limits import windows_of


def brute_force_step(series, cycle, least):
    """Return the largest step relative to its limit: window, size, and ratio, by a fit at each window and length."""
    count = len(series)
    length, neighbours = np.median(np.diff(cycle)), np.diff(series)
    white = 1.4826 * np.median(np.abs(neighbours - np.median(neighbours))) / np.sqrt(2)
    few = max(1.0, (20 / count) ** 2)
    best, side = (0, 0.0, 1.0), 3
    while 2 * side + 1 <= count and (side == 3 or 20 * side <= count):
        number = np.r_[-side:0, 1 : side + 1]
        design = np.column_stack([np.ones(2 * side), number, np.where(number > 0, 0.5, -0.5)])
        places, jumps, rests = range(side, count - side), [], []
        for k in places:
            values = series[k + number]
            fit = np.linalg.lstsq(design, values, rcond=None)[0]
            jumps.append(fit[2])
            rests.append(np.sqrt(np.sum((values - design @ fit) ** 2) / (2 * side - 3)))
        of_one = np.sqrt(np.linalg.inv(design.T @ design)[2, 2])
        usual = max(np.quantile(np.abs(jumps), 0.15) / 0.189, white * of_one)
        for k, jump, rest in zip(places, jumps, rests, strict=True):
            limit = max(8.0 * few * usual, least, 5.0 * rest)
            if cycle[k + side] - cycle[k - side] <= (2 * side + 4) * length and abs(jump) / limit > best[2]:
                best = (k, jump, abs(jump) / limit)
        side *= 2
    return best


@pytest.mark.parametrize("count", [10, 15, 60, 119, 120, 400])
@pytest.mark.parametrize("at", [0.3, 0.55])
def test_steps_are_those_of_a_fit_at_each_window_and_length(count, at):
    """Windows of 3, 6, 12, … cycles on each side, up to a twentieth of all, white noise and a slope."""
    generator, place, seen = np.random.default_rng(count), int(at * count), 0
    for size in np.geomspace(2.0, 60.0, 8):
        series = 1e-3 * generator.standard_normal(count) + 2e-3 * np.arange(count) / count
        series[place:] += 1e-3 * size
        cycle = np.arange(count) + 3.0 * (np.arange(count) >= count // 4)
        k, jump, _ = brute_force_step(series, cycle, 1e-3)
        listed = clocks.steps_of(series, cycle, 1e-3)
        assert bool(listed) == bool(jump)
        if listed:
            assert listed[0] == (k, pytest.approx(jump, rel=1e-6))
            seen += 1
    assert seen >= (1 if count > 20 else 0)


def test_long_recordings_show_steps_that_are_small_against_the_noise():
    """Of 7 standard deviations, more than 5, which are 20 of the error by 48 windows on each side, and 4 by 3."""
    for count, seen in ((100, 0), (1000, 1)):
        for seed in range(6):
            series = 1e-3 * np.random.default_rng(seed).standard_normal(count)
            series[count // 2 :] += 7e-3
            sizes = [size for _, size in clocks.steps_of(series, np.arange(count), 1e-4)]
            assert len(sizes) == seen and sizes == pytest.approx([7e-3] * seen, abs=2e-3)


@pytest.mark.parametrize("missing, seen", [(0, 1), (4, 1), (5, 0), (30, 0)])
def test_a_gap_of_more_than_four_windows_hides_a_step(missing, seen):
    series = 1e-4 * np.random.default_rng(1).standard_normal(60)
    series[30:] += 0.05
    cycle = 2.0 * (np.arange(60) + missing * (np.arange(60) >= 30))
    assert len(clocks.steps_of(series, cycle, 1e-3)) == seen


def test_steps_are_listed_with_their_signs_and_the_least_counts():
    series = 1e-5 * np.random.default_rng(2).standard_normal(100)
    series[30:] += 0.02
    series[70:] -= 0.05
    listed = sorted(clocks.steps_of(series, np.arange(100), 1e-3))
    assert [size for _, size in listed] == pytest.approx([0.02, -0.05], abs=1e-4)
    assert all(abs(k - at) <= 1 for (k, _), at in zip(listed, (30, 70), strict=True))
    assert len(clocks.steps_of(series, np.arange(100), 0.03)) == 1
    assert clocks.steps_of(series, np.arange(100), 0.06) == []
    assert clocks.steps_of(series[25:34], np.arange(9), 1e-3) == []
    # Lines and parabolas are no steps.
    assert clocks.steps_of(0.01 * np.arange(100) + 1e-4 * np.arange(100) ** 2, np.arange(100), 1e-6) == []


def phases(turns, sizes=None, order=None, slip=0.0, length=1):
    """Return phases (windows, channels) in windows of one second."""
    turns = np.asarray(turns, dtype=float)
    sizes = np.zeros(turns.shape) if sizes is None else np.asarray(sizes, dtype=float)
    number = np.arange(len(turns), dtype=float)
    channels = turns.shape[1]
    return Phases(
        number, length * number, length, turns, sizes, np.ones(channels) if order is None else np.array(order),
        np.broadcast_to(np.asarray(slip, dtype=float), channels),
    )  # fmt: skip


def test_phases_are_those_of_the_strongest_harmonic_in_cycles_of_the_fundamental():
    number = np.arange(10)
    every = windows_of(np.exp(2j * np.pi * (0.3 * number + 0.1))[:, None] * [2.0, 0.5], overlap=2, slip=0.3)
    every.amplitudes[:, 1, 2] = 4.0 * np.exp(2j * np.pi * (0.4 * number + 0.2))
    seen = clocks.phases_of(replace(every, cycles=3), 7.0 + 0.5 * np.arange(100))
    used = number[1::2]
    assert seen.start.tolist() == (7.0 + 0.5 * 5 * used).tolist() and seen.length == 3
    assert seen.cycle.tolist() == (1.5 * used).tolist() and seen.order.tolist() == [1, 2]
    # Unwrapped: 0.6 and 0.8 cycles of the harmonic from one window to the next are −0.4 and −0.2.
    assert np.diff(seen.turns[:, 0]) == pytest.approx(-0.4) and np.diff(seen.turns[:, 1]) == pytest.approx(-0.1)
    assert np.exp(2j * np.pi * seen.turns[0] * [1, 2]) == pytest.approx(
        np.exp(2j * np.pi * np.array([0.3 * 1 + 0.1, 0.4 * 1 + 0.2]))
    )
    assert np.exp(seen.sizes) == pytest.approx(np.tile([2.0, 4.0], (5, 1)))
    assert seen.slip == pytest.approx([0.3 / 2.0 / (2 * np.pi), 0.3 / 4.0 / (2 * np.pi)])
    some = seen.chosen(np.array([True, False, True, False, False]))
    assert some.start.tolist() == seen.start[[0, 2]].tolist() and some.cycle.tolist() == seen.cycle[[0, 2]].tolist()
    assert some.turns.tolist() == seen.turns[[0, 2]].tolist() and some.sizes.tolist() == seen.sizes[[0, 2]].tolist()


@pytest.mark.parametrize("spread, slip, limit", [(0.0, 0.0, 0.08), (0.02, 0.0, 6 * 1.4826 * 0.02), (0.0, 0.05, 0.08)])
@pytest.mark.parametrize("sign", [1, -1])
def test_windows_are_alike_within_eight_percent_or_six_standard_deviations(spread, slip, limit, sign):
    """The median deviation is 1/1.4826 of a standard deviation; the slip of a sample in radians is added."""
    limit += 2 * np.pi * slip
    sizes = np.zeros((40, 2))
    sizes[:30, 1] = spread * np.tile([1, -1, 1, -1, 1, -1], 5)
    used = np.arange(40) < 30
    sizes[30:, 1] = sign * limit * np.linspace(0.955, 1.045, 10)
    seen = clocks.alike(phases(np.zeros((40, 2)), sizes + [1.0, -3.0], slip=[0.0, slip]), used)
    assert seen[:30].all() and seen[30:].tolist() == [True] * 5 + [False] * 5


CHANNELS = ("u", "x", "y")


def stepping(steps, noise=1e-4, count=60):
    """Return phases of three channels that step at windows by cycles."""
    turns = noise * np.random.default_rng(6).standard_normal((count, 3))
    for row, at, size in steps:
        turns[at:, row] += size
    return phases(turns, order=[1, 2, 3])


@pytest.mark.parametrize(
    "steps, expected",
    [
        ([], []),
        ([(1, 20, 0.05)], [("x", "u", 20, 0.05, 2)]),
        ([(2, 20, -0.05), (1, 40, 0.03)], [("y", "u", 20, -0.05, 3), ("x", "u", 40, 0.03, 2)]),
        ([(0, 30, 0.05)], [("u", "x", 30, 0.05, 1)]),
        ([(0, 30, 0.05), (1, 30, 0.05), (2, 30, 0.05)], [("", "", 30, 0.05, 1)]),
        ([(0, 30, 0.05), (1, 30, 0.05)], [("y", "u", 30, -0.05, 3)]),
        ([(0, 15, 0.05), (2, 45, 0.04)], [("u", "x", 15, 0.05, 1), ("y", "u", 45, 0.04, 3)]),
    ],
)
def test_steps_belong_to_the_channel_that_steps_against_the_others(steps, expected):
    """Of the first channel where all others step against it, of all together where none does."""
    given = stepping(steps)
    listed, places = clocks.steps(CHANNELS, given, np.ones(60, dtype=bool))
    assert [(one.channel, one.other, one.order) for one in listed] == [
        (*names, order) for *names, _, _, order in expected
    ]
    for one, (_, _, at, size, _) in zip(listed, expected, strict=True):
        assert abs(one.time - at) <= 1.0 and one.turns == pytest.approx(size, abs=1e-3)
    relative = [
        {at for row, at, size in steps if row == own} ^ {at for row, at, _ in steps if row == 0} for own in (1, 2)
    ]
    assert all(
        len(there) == len(at) and all(min(abs(k - one) for one in at) <= 1 for k in there)
        for there, at in zip(places, relative, strict=True)
    )


def test_a_single_channel_steps_by_itself_and_only_where_it_is_used():
    given = stepping([(0, 20, 0.1)])
    one = phases(given.turns[:, :1])
    used = np.ones(60, dtype=bool)
    ((step,), places) = clocks.steps(("u",), one, used)
    assert (step.channel, step.other) == ("u", "") and places == []
    assert clocks.steps(("u",), one, np.arange(60) > 25) == ([], [])


@pytest.mark.parametrize("slip, seen", [(0.0, 1), (0.02, 1), (0.0499, 1), (0.051, 0)])
@pytest.mark.parametrize("row", [0, 1])
def test_relative_steps_within_a_sample_at_jumps_do_not_count(slip, seen, row):
    slips = np.zeros(2)
    slips[row] = slip
    turns = stepping([(1, 30, 0.05)], noise=1e-6).turns[:, :2]
    assert len(clocks.steps(("u", "x"), phases(turns, slip=slips), np.ones(60, dtype=bool))[0]) == seen


def test_steps_at_times_more_than_two_windows_apart_are_not_one():
    both = [PhaseStep("", "", 10.0, 0.05, 1), PhaseStep("x", "u", 12.0, 0.02, 2)]
    assert clocks._attributed(CHANNELS, both, 1.0, 1) == [both[1]]
    seen = clocks._attributed(CHANNELS, both, 0.99, 1)
    assert seen == sorted(both, key=lambda one: one.time)
    others = [PhaseStep("y", "u", 11.0, 0.04, 3), both[1], both[0]]
    assert clocks._attributed(CHANNELS, others, 1.0, 5) == [PhaseStep("u", "x", 11.0, pytest.approx(-0.03), 5)]


def test_steps_in_words():
    """0.1 cycles at 4 Hz are 25 ms and 36 degrees."""
    listed = [
        PhaseStep("x", "u", 2.0, 0.1, 2), PhaseStep("x", "u", 4.0, -0.05, 2), PhaseStep("x", "u", 6.0, 0.01, 2),
        PhaseStep("x", "u", 8.0, 0.01, 2), PhaseStep("", "", 3.0, 0.02, 1), PhaseStep("", "", 5.0, -0.04, 1),
        PhaseStep("y", "", 7.0, 0.03, 1),
    ]  # fmt: skip
    x, every, y = clocks.step_findings(listed, {"u": 1000.0, "x": 200.0, "y": 100.0}, 4.0, 50)
    assert (x.kind, x.channel, x.severity, x.count, x.share) == ("phase step", "x", RUINOUS, 4, 0.08)
    assert x.times.tolist() == [[2.0, 2.0], [4.0, 4.0], [6.0, 6.0], [8.0, 8.0]]
    assert x.text == (
        "x is earlier by 0.025 s (36°, up to whole cycles) against u from about 2 s on, as after 5 lost samples of x; "
        "x is later by 0.0125 s (18°, up to whole cycles) against u from about 4 s on, as after 12.5 lost samples of "
        "u; x is earlier by 0.0025 s (3.6°, up to whole cycles) against u from about 6 s on, as after 0.5 lost samples "
        "of x (4 steps)"
    )
    assert "which delay is right is unknown" in x.cure
    assert (every.channel, every.severity, every.count, every.share) == ("", SERIOUS, 2, 0.04)
    # The largest one, at the highest rate.
    assert every.text.startswith("the phase of all channels steps by -14.4° (-0.01 s, 10 samples) at about 5 s")
    assert every.text.endswith(" (2 steps)") and every.cure.startswith("fold the parts before and after it")
    assert y.text.startswith("the phase of y steps by 10.8° (0.0075 s, 0.75 samples) at about 7 s")
    assert (y.count, y.severity) == (1, SERIOUS) and "steps)" not in y.text


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("sign", [1, -1])
def test_relative_steps_are_ruinous_by_the_angle_of_their_harmonic(order, sign):
    limit = clocks.RUINOUS_BIAS / (2 * np.pi * order)
    for factor, severity in ((0.999, SERIOUS), (1.001, RUINOUS)):
        listed = [PhaseStep("x", "u", 1.0, sign * factor * limit, order), PhaseStep("x", "u", 2.0, 1e-6, order)]
        (seen,) = clocks.step_findings(listed, {"u": 1.0, "x": 1.0}, 1.0, 10)
        assert seen.severity == severity


def drifting(rate, count=80, noise=1e-4, seed=7, **settings):
    """Return phases of two channels, the second with a relative drift [cycles per cycle]."""
    generator = np.random.default_rng(seed)
    turns = np.column_stack([np.zeros(count), rate * np.arange(count) + noise * generator.standard_normal(count)])
    return phases(turns, **settings)


NONE = [np.zeros(0, dtype=int)]
ALL = np.ones(80, dtype=bool)


@pytest.mark.parametrize("rate", [1e-4, -1e-4, 3e-5])
@pytest.mark.parametrize("length", [1, 4])
def test_drifts_have_the_rate_and_error_of_linear_regression(rate, length):
    """Over windows of white noise; the error is that of 16 components, within 3.9 standard deviations of χ."""
    given = drifting(rate, length=length)
    (seen,) = clocks.drifts(given, ALL, NONE)
    slope = np.polynomial.polynomial.polyfit(given.cycle, given.turns[:, 1], 1)[1]
    assert seen.row == 1 and seen.steady and seen.rate == pytest.approx(slope, rel=1e-6)
    error = 1e-4 / np.sqrt(np.sum((given.cycle - given.cycle.mean()) ** 2))
    assert seen.se == pytest.approx(error, rel=0.7) and seen.turns == pytest.approx(slope * 80 * length, rel=1e-6)


def test_drifts_are_significant_from_student_s_t_on():
    """The false-alarm rate of 1e-4, over all channels, is shared; 16 orders measure the noise."""
    for channels in (1, 4):
        limit = student.isf(0.5e-4 / channels, 16)
        base = drifting(0.0).turns[:, 1]
        design = np.polynomial.legendre.legvander(np.linspace(-1, 1, 80), 18)
        component = np.linalg.qr(design)[0].T @ base
        noise = np.sqrt(np.mean(component[3:] ** 2))
        number = np.arange(80.0) - 39.5
        flat = base - number * (number @ base) / (number @ number)
        for factor, count in ((0.99, 0), (1.01, 1)):
            turns = flat + factor * limit * noise * number / np.linalg.norm(number)
            turns = np.column_stack([np.zeros(80), *([turns] + [np.zeros(80)] * (channels - 1))])
            assert len([*clocks.drifts(phases(1e3 * turns), ALL, NONE * channels)]) == count


@pytest.mark.parametrize("turns, seen", [(0.9e-4, 0), (1.1e-4, 1), (-0.9e-4, 0), (-1.1e-4, 1)])
def test_drifts_of_a_ten_thousandth_of_a_cycle_over_the_windows_used_do_not_count(turns, seen):
    given = drifting(turns / 80, noise=1e-8)
    assert len([*clocks.drifts(given, ALL, NONE)]) == seen
    assert [*clocks.drifts(replace(given, slip=np.array([0.0, 1e-3])), ALL, NONE)] == []
    assert [*clocks.drifts(replace(given, slip=np.array([1e-3, 0.0])), ALL, NONE)] == []


def test_drifts_are_of_ten_windows_at_least_and_of_those_used():
    given = drifting(1e-3)
    assert [*clocks.drifts(given, np.arange(80) < 9, NONE)] == []
    assert len([*clocks.drifts(given, np.arange(80) < 10, NONE)]) == 1
    half = replace(given, turns=np.where(np.arange(80)[:, None] < 40, given.turns, 0.5))
    (seen,) = clocks.drifts(half, np.arange(80) < 40, NONE)
    assert seen.rate == pytest.approx(1e-3, rel=0.05)


def test_a_drift_beside_steps_is_without_them():
    given = drifting(1e-4)
    given.turns[50:, 1] += 0.2
    (seen,) = clocks.drifts(given, ALL, [np.array([50])])
    assert seen.rate == pytest.approx(1e-4, rel=0.05)
    # Without a drift, steps that are known are none.
    flat = drifting(0.0)
    flat.turns[50:, 1] -= 0.2
    assert [*clocks.drifts(flat, ALL, [np.array([50])])] == []


def test_a_response_that_follows_its_drive_by_a_delay_has_no_drift():
    """The phase of the drive is a parabola or a cubic, its frequency the derivative; a delay of 0.4 cycles."""
    number = np.linspace(-1, 1, 80)
    generator = np.random.default_rng(8)
    for drive in (2.0 * number**2 + number**3, number**3 - 1.5 * number):
        frequency = np.gradient(drive)
        response = drive - 0.4 * frequency + 1e-6 * generator.standard_normal(80)
        given = phases(np.column_stack([drive, response]))
        assert [*clocks.drifts(given, ALL, NONE)] == []
        own = phases(np.column_stack([drive, response + 0.01 * number]))
        listed = [*clocks.drifts(own, ALL, NONE)]
        assert all(one.rate == pytest.approx(0.01 * 2 / 79, rel=0.25) for one in listed)
    # Of a parabola alone, whose frequency is a line, no other drift can be told.
    drive = 2.0 * number**2
    given = phases(np.column_stack([drive, drive + 0.01 * number]))
    assert [*clocks.drifts(given, ALL, NONE)] == []


@pytest.mark.parametrize("growth, turn, expected", [(0.0, 0.02, True), (0.1, 0.02, None), (0.1, 0.06, False)])
@pytest.mark.parametrize("row", [0, 1])
def test_drifts_that_changes_of_amplitudes_explain_are_no_clocks(growth, turn, expected, row):
    """Up to 0.05 rad they are harmless, above a transient or a change; amplitudes may change by half of the angle."""
    number = np.linspace(-0.5, 0.5, 80)
    sizes = np.zeros((80, 2))
    sizes[:, row] = growth * number
    given = replace(drifting(0.0, noise=1e-7), sizes=sizes)
    given.turns[:, 1] += turn / (2 * np.pi) * number
    assert [one.steady for one in clocks.drifts(given, ALL, NONE)] == ([] if expected is None else [expected])


@pytest.mark.parametrize("curved, steady", [(0.05, True), (0.3, False), (-0.3, False)])
def test_drifts_of_clocks_are_straight(curved, steady):
    place = np.linspace(-1, 1, 80)
    given = drifting(0.0, noise=1e-7)
    given.turns[:, 1] += 0.1 * (place + curved * np.sqrt(5 / 3) * 0.5 * (3 * place**2 - 1))
    assert [one.steady for one in clocks.drifts(given, ALL, NONE)] == [steady]


def test_windows_of_the_same_amplitude_show_a_drift_that_few_used_ones_do_not():
    given = drifting(4e-6)
    for used, seen in ((39, 1), (40, 0)):
        some = np.arange(80) < used
        assert [*clocks.drifts(given, some, NONE)] == []
        assert len(clocks.clock_drifts(given, some, NONE)) == seen
    other = replace(given, sizes=np.where(np.arange(80)[:, None] < 35, 0.0, 0.2) * np.ones(2))
    assert clocks.clock_drifts(other, np.arange(80) < 35, NONE) == []


def test_drifts_in_words():
    """0.05 cycles are 18 degrees."""
    listed = [Drift(1, 2e-5, 1.5e-6, 0.05, True), Drift(1, 1e-5, 1e-6, 0.02, False), Drift(2, -3e-5, 2e-6, -0.1, True)]
    above, changing, below = clocks.drift_findings(listed, CHANNELS, (2.0, 12.0), 30, 40)
    assert (above.kind, above.channel, above.severity) == ("clock", "x", RUINOUS)
    assert above.text == (
        "the phase of x drifts steadily against u, by 18° over the cycles used (30 of 40), as if its frequency were "
        "20 ± 1.5 ppm above: two clocks, or a system that changes"
    )
    assert "fold(clocks={'second': ['x']})" in above.cure and "fold(clocks='one')" in above.cure
    assert "of y drifts steadily against u, by -36° " in below.text and "30 ± 2 ppm below" in below.text
    assert (changing.kind, changing.channel, changing.severity) == ("drift", "x", SERIOUS)
    assert changing.text.startswith("the phase of x against u changes by 7.2° over the cycles used (30 of 40), but not")
    (free,) = clocks.drift_findings([Drift(1, 0.0157, 5e-4, 0.4, True)], CHANNELS, (2.0, 12.0), 30, 40)
    assert free.text.endswith(", or a response that does not follow the drive, such as a chaotic one")
    assert "bp.find_orbits" in free.cure and "bp.find_orbits" not in above.cure
    assert all(
        one.times.tolist() == [[2.0, 12.0]] and (one.count, one.share) == (30, 1.0) and np.isnan(one.bias)
        for one in (above, below, changing)
    )
