"""Phases of channels in windows, their steps and drifts, for series whose steps and drifts are known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from bayesperiodic.data import clocks
from bayesperiodic.data.clocks import Drift, Phases, PhaseStep
from bayesperiodic.data.recording_check import RUINOUS, SERIOUS
from bayesperiodic.data.steadiness import Windows


def windows_of(amplitudes, overlap=1, cycles=1, slip=0.0):
    count, channels = amplitudes.shape[:2]
    first = 10 * np.arange(count)
    return Windows(
        first, first + 10, np.arange(count), overlap, cycles, amplitudes, np.full(channels, slip), np.zeros(channels)
    )


def test_phases_are_those_of_the_strongest_harmonics_in_cycles_of_the_fundamental():
    """The second channel has its third harmonic, whose phase is three times as large; windows do not overlap."""
    count, drift = 24, 0.03 * np.arange(24)
    amplitudes = np.zeros((count, 2, 5), dtype=complex)
    amplitudes[:, 0, 1] = 2.0 * np.exp(2j * np.pi * (0.4 + drift))
    amplitudes[:, 0, 3] = 0.5
    amplitudes[:, 1, 3] = 4.0 * np.exp(2j * np.pi * 3 * (0.1 + 2 * drift))
    amplitudes[:, 1, 0] = 99.0
    amplitudes[7, 1, 3] *= 3.0
    time = 0.25 * np.arange(500)
    seen = clocks.phases_of(windows_of(amplitudes, slip=0.5, cycles=2), time)
    assert seen.order.tolist() == [1, 3] and seen.length == 2
    np.testing.assert_allclose(np.diff(seen.turns, axis=0), np.column_stack([np.full(23, 0.03), np.full(23, 0.06)]))
    assert seen.turns[0] == pytest.approx([0.4, 0.1])
    np.testing.assert_allclose(np.exp(seen.sizes[:, 0]), 2.0)
    assert np.exp(seen.sizes[7, 1]) == pytest.approx(12.0)
    assert seen.slip == pytest.approx([0.5 / 2.0 / (2 * np.pi), 0.5 / 4.0 / (2 * np.pi)])
    assert np.array_equal(seen.start, 2.5 * np.arange(count)) and np.array_equal(seen.cycle, 2.0 * np.arange(count))
    apart = clocks.phases_of(windows_of(amplitudes, overlap=4, cycles=1), time)
    assert apart.cycle.tolist() == [0.75, 1.75, 2.75, 3.75, 4.75, 5.75] and apart.start[0] == 7.5


def phases(turns, sizes=None, slip=0.0, order=1, length=1):
    turns = np.asarray(turns, dtype=float)
    cycle = np.arange(float(len(turns)))
    sizes = np.zeros(turns.shape) if sizes is None else sizes
    channels = turns.shape[1]
    return Phases(2.0 * cycle, cycle, length, turns, sizes, np.full(channels, order), np.full(channels, slip))


@pytest.mark.parametrize(
    "spread, slip, limit", [(0.0, 0.0, 0.08), (0.01, 0.0, 6 * 0.014826), (0.0, 0.01, 0.08 + 0.02 * np.pi)]
)
def test_windows_are_alike_within_a_range_or_six_standard_deviations(spread, slip, limit):
    """The median deviation of the windows used is `spread`; the logarithms of the amplitudes are compared."""
    sizes = np.zeros((40, 2))
    sizes[:20, 1] = spread * np.array([-1.0, 1.0] * 10)
    sizes[[25, 26], 1] = np.array([0.99, 1.01]) * limit
    sizes[[27, 28], 0] = np.array([-0.99, -1.01]) * (0.08 + 2 * np.pi * slip)
    used = np.arange(40) < 20
    alike = clocks.alike(phases(np.zeros((40, 2)), sizes, slip), used)
    assert np.flatnonzero(~alike).tolist() == [26, 28]


def stepped(*steps, count=60, slope=0.0):
    series = slope * np.arange(float(count))
    for place, size in steps:
        series[place:] += size
    return series


@pytest.mark.parametrize("slope", [0.0, 0.2])
@pytest.mark.parametrize("steps", [[(20, 0.5)], [(20, 0.5), (40, -0.3)], [(4, 0.5)], [(56, -0.5)], [(30, 1e-3)], []])
def test_steps_of_a_line_have_their_place_and_size(steps, slope):
    """The window before the step, or that in which it is."""
    listed = sorted(clocks.steps_of(stepped(*steps, slope=slope), np.arange(60.0), 1e-6))
    assert len(listed) == len(steps)
    for (place, size), (k, found) in zip(steps, listed, strict=True):
        assert k in (place - 1, place) and found == pytest.approx(size, rel=1e-6)


@pytest.mark.parametrize("size, seen", [(0.99, 0), (1.01, 1)])
def test_least_step(size, seen):
    assert len(clocks.steps_of(stepped((30, size * 0.02)), np.arange(60.0), 0.02)) == seen
    assert len(clocks.steps_of(stepped((30, -size * 0.02)), np.arange(60.0), 0.02)) == seen


@pytest.mark.parametrize("gap, seen", [(4, 1), (5, 0)])
def test_four_windows_may_be_missing_at_a_step(gap, seen):
    cycle = np.arange(60.0)
    cycle[30:] += gap
    assert len(clocks.steps_of(stepped((30, 1.0)), cycle, 1e-3)) == seen


def test_curves_and_noise_are_no_steps():
    """40 series of 200 windows of white noise; none has a step by chance (1e-12)."""
    cycle = np.arange(200.0)
    for seed in range(40):
        assert clocks.steps_of(np.random.default_rng(seed).standard_normal(200), cycle, 1e-6) == []
    assert clocks.steps_of(np.exp(-cycle / 15), cycle, 1e-6) == []
    noise = np.random.default_rng(1).standard_normal(200)
    ((k, size),) = clocks.steps_of(noise + 12.0 * (cycle >= 77), cycle, 1e-6)
    assert abs(k - 77) <= 2 and size == pytest.approx(12.0, abs=2.0)


CHANNELS = ("u", "x", "y")


def test_steps_of_channels_relative_to_the_first_and_of_all():
    turns = np.zeros((60, 3))
    turns[20:, 1] += 0.05
    turns[30:, 2] -= 0.04
    every = np.ones(60, dtype=bool)
    listed, places = clocks.steps(CHANNELS, phases(turns, order=2), every)
    assert [(s.channel, s.other, s.order) for s in listed] == [("x", "u", 2), ("y", "u", 2)]
    assert [s.turns for s in listed] == pytest.approx([0.05, -0.04]) and [s.time for s in listed] == pytest.approx(
        [39, 59], abs=1.1
    )
    assert [p.tolist() for p in places] == [[k for k in (19, 20) if 2.0 * k == listed[0].time], [
        k for k in (29, 30) if 2.0 * k == listed[1].time]]  # fmt: skip
    # Of all channels together, and of the first one alone.
    listed, _ = clocks.steps(CHANNELS, phases(turns * 0 + stepped((25, 0.1))[:, None]), every)
    assert [(s.channel, s.other) for s in listed] == [("", "")] and listed[0].turns == pytest.approx(0.1)
    turns = np.zeros((60, 3))
    turns[25:, 0] += 0.1
    (first,), _ = clocks.steps(CHANNELS, phases(turns), every)
    assert (first.channel, first.other) == ("u", "x") and first.turns == pytest.approx(0.1)
    (alone,), places = clocks.steps(("u",), phases(turns[:, :1]), every)
    assert (alone.channel, alone.other, places) == ("u", "", [])


@pytest.mark.parametrize("slip", [0.0, 0.01])
@pytest.mark.parametrize("row", [0, 1])
def test_steps_below_rounding_or_a_sample_at_jumps_do_not_count(slip, row):
    """Of 1e-4 cycles relative to another channel, and of the larger slip of both."""
    for size, seen in ((0.95, 0), (1.05, 1)):
        given = phases(np.column_stack([np.zeros(60), stepped((30, size * (1e-4 + slip)))]))
        given.slip[row] = slip
        listed, _ = clocks.steps(("u", "x"), given, np.ones(60, dtype=bool))
        assert len(listed) == seen


def step(channel, other, time, turns=0.1):
    return PhaseStep(channel, other, time, turns, 1)


@pytest.mark.parametrize(
    "listed, expected",
    [
        ([("x", "u", 5.0)], [("x", "u", 5.0)]),
        ([("", "", 5.0), ("x", "u", 5.0), ("y", "u", 7.0)], [("u", "x", 5.0)]),
        ([("", "", 5.0), ("x", "u", 5.0), ("y", "u", 7.1)], [("x", "u", 5.0), ("y", "u", 7.1)]),
        ([("", "", 5.0), ("x", "u", 5.0)], [("x", "u", 5.0)]),
        ([("", "", 5.0), ("x", "u", 7.5)], [("", "", 5.0), ("x", "u", 7.5)]),
        ([("", "", 9.0), ("", "", 5.0)], [("", "", 5.0), ("", "", 9.0)]),
    ],
)
def test_a_step_of_all_others_is_one_of_the_first_channel(listed, expected):
    """Within two windows of 1 s."""
    result = clocks._attributed(CHANNELS, [step(*one) for one in listed], 1.0, 3)
    assert [(s.channel, s.other, s.time) for s in result] == expected
    if expected == [("u", "x", 5.0)]:
        assert result[0].turns == pytest.approx(-0.1) and result[0].order == 3


@pytest.mark.parametrize("drift, sigma", [(3e-5, 1e-3), (-3e-4, 1e-3), (1e-3, 1e-2)])
def test_drift_of_a_phase_is_its_slope_with_its_standard_error(drift, sigma):
    """By linear regression of 200 windows; within four standard errors, which follow from the noise to 30 %."""
    cycle = np.arange(200.0)
    noise = sigma * np.random.default_rng(2).standard_normal(200)
    given = phases(np.column_stack([np.zeros(200), drift * cycle + noise]))
    (found,) = clocks.drifts(given, np.ones(200, dtype=bool), [np.zeros(0, dtype=int)])
    se = sigma / np.sqrt(np.sum((cycle - cycle.mean()) ** 2))
    assert found.se == pytest.approx(se, rel=0.45) and abs(found.rate - drift) < 4 * se
    assert (found.row, found.steady) == (1, True) and found.turns == pytest.approx(found.rate * 199 * 200 / 199)
    assert [*clocks.drifts(given, cycle < 9, [np.zeros(0, dtype=int)])] == []


def test_drifts_beside_steps_and_of_the_drive_are_not_those_of_a_clock():
    """A step is fitted beside the drift; a drift of the drive's own frequency that a response follows is none."""
    cycle, every = np.arange(200.0), np.ones(200, dtype=bool)
    noise = 1e-3 * np.random.default_rng(2).standard_normal(200)
    jump = phases(np.column_stack([np.zeros(200), 0.3 * (cycle > 90) + noise]))
    assert (
        len([*clocks.drifts(jump, every, [np.array([90])])])
        == 0
        < len([*clocks.drifts(jump, every, [np.zeros(0, int)])])
    )
    both = phases(np.column_stack([np.zeros(200), 0.3 * (cycle > 90) + 1e-4 * cycle + noise]))
    (found,) = clocks.drifts(both, every, [np.array([90])])
    assert found.rate == pytest.approx(1e-4, rel=0.15)
    curved = phases(np.column_stack([np.zeros(200), 1e-2 * np.exp(-cycle / 80.0) + 1e-5 * noise]))
    assert [d.steady for d in clocks.drifts(curved, every, [np.zeros(0, int)])] == [False]
    # The frequency of the drive changes by 1e-5 a cycle, and the response follows it three cycles later.
    swept = 5e-6 * cycle**2
    late = phases(np.column_stack([swept, swept - 3e-5 * cycle + 1e-6 * noise]))
    assert [*clocks.drifts(late, every, [np.zeros(0, int)])] == []


def test_drifts_that_amplitudes_explain_are_not_steady_and_small_ones_are_harmless():
    """An amplitude that changes by 10 % may turn the phase by 0.2 rad; up to 0.05 rad it is harmless."""
    cycle, every = np.arange(100.0), np.ones(100, dtype=bool)
    noise = 1e-6 * np.random.default_rng(2).standard_normal(100)
    for turn, growth, steady in (
        (0.1, 0.0, [True]),
        (0.1, 0.1, [False]),
        (0.3, 0.1, [True]),
        (0.04, 0.1, []),
        (0.06, 0.1, [False]),
    ):
        sizes = np.column_stack([np.zeros(100), growth * cycle / 100])
        turns = turn / (2 * np.pi) * cycle / 100 + noise
        for order in (1, 3):
            given = phases(np.column_stack([np.zeros(100), turns / order]), sizes, order=order)
            assert [d.steady for d in clocks.drifts(given, every, [np.zeros(0, int)])] == steady


def test_channels_without_a_drift_do_not_hide_that_of_a_later_one():
    """Before it: nine windows without steps, a step in every second of 20 windows, no drift, a harmless one."""
    cycle, every = np.arange(100.0), np.ones(100, dtype=bool)
    noise = 1e-5 * np.random.default_rng(2).standard_normal((100, 3))
    turns = np.zeros((100, 6))
    turns[:, 3] = noise[:, 0]
    turns[:, 4] = 0.04 / (2 * np.pi) * cycle / 100 + 1e-2 * noise[:, 1]
    turns[:, 5] = 1e-3 * cycle + noise[:, 2]
    sizes = np.zeros((100, 6))
    sizes[:, 4] = 0.1 * cycle / 100
    places = [np.arange(91), np.r_[np.arange(0, 20, 2), np.arange(20, 100)], *[np.zeros(0, dtype=int)] * 3]
    assert [drift.row for drift in clocks.drifts(phases(turns, sizes), every, places)] == [5]


def test_drift_over_all_windows_counts_if_few_are_used():
    cycle = np.arange(100.0)
    noise = 1e-3 * np.random.default_rng(2).standard_normal(100)
    given = phases(np.column_stack([np.zeros(100), 1e-4 * cycle + noise]))
    nothing = [np.zeros(0, dtype=int)]
    assert len(clocks.clock_drifts(given, cycle < 20, nothing)) == 1
    assert len(clocks.clock_drifts(given, cycle < 50, nothing)) == len([*clocks.drifts(given, cycle < 50, nothing)])


def test_findings_of_steps_name_delay_angle_and_lost_samples():
    """At 2 Hz and 100 samples/s, 0.02 cycles are 0.01 s, 7.2°, and one sample."""
    listed = [step("x", "u", 3.0, 0.02), step("x", "u", 5.0, 0.01), step("y", "u", 4.0, -0.04)]
    one, two = clocks.step_findings(listed, {"u": 50.0, "x": 100.0, "y": 200.0}, 2.0, 40)
    assert one.text == (
        "x is earlier by 0.01 s (7.2°, up to whole cycles) against u from about 3 s on, as after 1 lost samples of x; "
        "x is earlier by 0.005 s (3.6°, up to whole cycles) against u from about 5 s on, as after 0.5 lost samples of "
        "x (2 steps)"
    )
    assert two.text.startswith(
        "y is later by 0.02 s (14.4°, up to whole cycles) against u from about 4 s on, as after 1 "
    )
    assert "lost samples of u" in two.text and "steps)" not in two.text
    assert (one.kind, one.channel, one.count, one.share) == ("phase step", "x", 2, 0.05)
    assert one.times.tolist() == [[3.0, 3.0], [5.0, 5.0]] and "recording.between(start, stop)" in one.cure
    many = [*clocks.step_findings([step("x", "u", float(k), 0.1) for k in range(5)], {"x": 1.0, "u": 1.0}, 1.0, 9)]
    assert many[0].text.count("is earlier") == 3 and many[0].text.endswith("(5 steps)")


@pytest.mark.parametrize("turns, order, severity", [(0.0078, 1, SERIOUS), (0.0081, 1, RUINOUS), (0.0078, 2, RUINOUS)])
def test_steps_are_ruinous_by_their_angle_at_the_harmonic(turns, order, severity):
    """From 0.05 rad of the strongest harmonic on."""
    (found,) = clocks.step_findings([PhaseStep("x", "u", 1.0, -turns, order)], {"x": 1.0, "u": 1.0}, 1.0, 9)
    assert found.severity == severity


def test_findings_of_steps_of_all_channels():
    (found,) = clocks.step_findings(
        [step("", "", 3.0, 0.01), step("", "", 5.0, -0.03)], {"x": 50.0, "u": 100.0}, 2.0, 10
    )
    assert (found.channel, found.severity, found.count, found.share) == ("", SERIOUS, 2, 0.2)
    assert "recording.between(start, stop)" in found.cure and "(2 steps)" in found.text and "5" in found.text


def test_findings_of_drifts_name_angle_difference_and_cycles():
    drift = Drift(1, 3e-5, 2e-6, 0.02, True)
    (found,) = clocks.drift_findings([drift], CHANNELS, (1.0, 9.0), 40, 50)
    assert (found.kind, found.channel, found.severity, found.count) == ("clock", "x", RUINOUS, 40)
    assert found.text == (
        "the phase of x drifts steadily against u, by 7.2° over the cycles used (40 of 50), as if its frequency were "
        "30 ± 2 ppm above: two clocks, or a system that changes"
    )
    assert "fold(clocks={'second': ['x']})" in found.cure and found.times.tolist() == [[1.0, 9.0]]
    (below,) = clocks.drift_findings([replace(drift, rate=-3e-5, turns=-0.02)], CHANNELS, (1.0, 9.0), 40, 50)
    assert "by -7.2° over" in below.text and "30 ± 2 ppm below" in below.text
    (other,) = clocks.drift_findings([replace(drift, row=2, steady=False)], CHANNELS, (1.0, 9.0), 40, 50)
    assert (other.kind, other.channel, other.severity) == ("drift", "y", SERIOUS)
    assert "the phase of y against u changes by 7.2° over the cycles used (40 of 50), but not steadily" in other.text
