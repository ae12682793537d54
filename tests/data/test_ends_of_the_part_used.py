"""What is found outside of the part used: ramps, steps of the phase, and beats of the whole recording."""

from dataclasses import replace

import numpy as np
import pytest

from bayesperiodic.data import cycle_findings
from bayesperiodic.data.recording_check import HARMLESS, SERIOUS
from bayesperiodic.data.steadiness import Steady
from tests.data.test_steady_limits import windows_of

TIME = np.arange(300) / 5.0  # five samples a window of 1 s
USED = "20 to 39.8 s are used (20 of 60 cycles)"
NUMBER = np.arange(60)


def parts_of(lines, first=20, last=40, level=None):
    """Return 60 windows of channels, the second at harmonic 2, and the part from window `first` to `last` − 1."""
    lines = np.asarray(lines, dtype=complex)
    lines = lines[:, None] if lines.ndim == 1 else lines
    every = windows_of(lines)
    every.amplitudes[:, 1:, 2], every.amplitudes[:, 1:, 1] = every.amplitudes[:, 1:, 1].copy(), 0.0
    part = every.chosen(slice(first, last))
    channels = lines.shape[1]
    return every, Steady(
        part, slice(5 * first, 5 * last), level or (5 * first, 5 * last), np.zeros((channels, 3)),
        np.zeros((2, channels)),
    )  # fmt: skip


def turned(turns, where, sizes=(1.0, 2.0), noise=0.0):
    """Return two channels, the second at harmonic 2, whose phase is turned by cycles of the fundamental there."""
    generator = np.random.default_rng(1)
    turns = np.broadcast_to(turns, (2,))
    angle = 2 * np.pi * np.where(where[:, None], turns * [1, 2], 0.0) + noise * generator.standard_normal((60, 2))
    return np.exp(1j * (angle + [3.1, -1.0])) * sizes


def outer(every, steady, before, frequency=1.0):
    return [*cycle_findings._outer_steps(TIME, every, steady, frequency, before, USED)]


@pytest.mark.parametrize("turns", [0.05, -0.05, 0.2])
@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("frequency", [1.0, 2.0])
def test_a_step_outside_of_the_part_used_is_that_from_before_to_after(turns, before, frequency):
    """Seen forwards in time: a phase that is larger before the part used steps down where that begins."""
    every, steady = parts_of(turned(turns, NUMBER < 20 if before else NUMBER >= 40))
    (seen,) = outer(every, steady, before, frequency)
    assert (seen.kind, seen.channel, seen.severity, seen.count, seen.share) == ("phase step", "", HARMLESS, 1, 1 / 20)
    at = 20.0 if before else 39.8
    assert seen.times.tolist() == [[at, at]] and np.isnan(seen.bias)
    step = -turns if before else turns
    assert seen.text == (
        f"the phase of all channels steps by {360 * step:.3g}° ({step / frequency:.3g} s, "
        f"{abs(5 * step / frequency):.3g} samples) at about {at:.6g} s: samples were lost, or the clock or the drive "
        f"stepped; {USED}"
    )
    assert seen.cure == "fold the parts before and after it: recording.between(start, stop)"
    # At the other end of the part nothing steps.
    assert outer(every, steady, not before, frequency) == []


@pytest.mark.parametrize("before", [True, False])
def test_without_windows_outside_there_is_no_step_there(before):
    every, steady = parts_of(turned(0.1, NUMBER < 20), 0, 60)
    assert outer(every, steady, before) == []
    # A window that overlaps the part used is not outside of it.
    every, steady = parts_of(turned(0.1, (NUMBER < 1) | (NUMBER >= 59)), 1, 59, (4, 296))
    assert outer(every, steady, before) == []
    every, steady = parts_of(turned(0.1, (NUMBER < 1) | (NUMBER >= 59)), 1, 59, (5, 295))
    assert len(outer(every, steady, before)) == 1


@pytest.mark.parametrize("turns, seen", [(0.99 / 180, 0), (1.01 / 180, 1), (-0.99 / 180, 0), (-1.01 / 180, 1)])
def test_steps_of_less_than_two_degrees_are_not_named(turns, seen):
    assert len(outer(*parts_of(turned(turns, NUMBER < 20)), True)) == seen


@pytest.mark.parametrize("factor, seen", [(1.029, 1), (1.032, 0), (0.972, 1), (0.969, 0)])
@pytest.mark.parametrize("channel", [0, 1])
def test_amplitudes_outside_must_be_the_same_to_three_percent(factor, seen, channel):
    """Of each channel, by the logarithm of the ratio: ln 1.0305 = 0.03."""
    lines = turned(0.1, NUMBER < 20)
    lines[:20, channel] *= factor
    assert len(outer(*parts_of(lines), True)) == seen


@pytest.mark.parametrize("second, seen", [(0.1, 1), (0.1 + 0.9 / 180, 1), (0.1 + 1.1 / 180, 0), (0.0, 0), (-0.1, 0)])
def test_all_channels_step_by_the_same_time(second, seen):
    """The largest one is named."""
    listed = outer(*parts_of(turned([0.1, second], NUMBER < 20)), True)
    assert len(listed) == seen
    if seen:
        assert f"steps by {-360 * max(0.1, second):.3g}°" in listed[0].text


def test_noise_of_the_part_used_widens_the_limits():
    """Eight standard deviations of the part's phases, in cycles; 0.1 rad of noise at harmonic 1 hides 15 degrees."""
    assert outer(*parts_of(turned(15 / 360, NUMBER < 20, noise=0.1)), True) == []
    assert len(outer(*parts_of(turned(70 / 360, NUMBER < 20, noise=0.1)), True)) == 1


def test_a_phase_that_moves_outside_is_no_step():
    """Half of the windows are further from the median phase than a quarter of the step; a few are no matter."""
    lines = turned(0.1, NUMBER < 20)
    moving = np.exp(2j * np.pi * np.linspace(-0.08, 0.08, 20)[:, None] * [1, 2])
    few = np.where(NUMBER[:20, None] > 17, moving, 1.0)
    assert len(outer(*parts_of(np.concatenate([lines[:20] * few, lines[20:]])), True)) == 1
    assert outer(*parts_of(np.concatenate([lines[:20] * moving, lines[20:]])), True) == []


def findings(every, steady, channels=("x", "y"), frequency=1.0, total=60, ends=(0.0, 59.8)):
    channels = channels[: every.amplitudes.shape[1]]
    return [*cycle_findings.cycle_findings(channels, TIME, every, steady, frequency, total, ends)]


def test_ramps_and_the_rest_of_a_transient_are_named_with_times_and_cycles():
    every, steady = parts_of(np.ones((60, 2)), level=(90, 200))
    before, after, rest = findings(every, steady)
    assert [one.kind for one in (before, after, rest)] == ["ramp", "ramp", "transient"]
    assert before.text == f"the signals change until 18 s; {USED}" and before.times.tolist() == [[0.0, 18.0]]
    assert after.text == f"the signals change from 39.8 s; {USED}" and after.times.tolist() == [[39.8, 59.8]]
    assert rest.text == f"a rest of the transient is in the amplitudes until 20 s; {USED}"
    assert [(one.count, one.share) for one in (before, after, rest)] == [(18, 0.3), (20, 20 / 60), (2, 2 / 60)]
    assert all(one.severity == HARMLESS and one.channel == "" and np.isnan(one.bias) for one in (before, after, rest))
    twice = findings(every, steady, frequency=2.0)
    assert [one.count for one in twice] == [36, 40, 4]


@pytest.mark.parametrize("first, last, kinds", [(5, 295, 2), (4, 295, 1), (5, 296, 1), (4, 296, 0)])
def test_parts_of_a_cycle_at_the_ends_are_not_named(first, last, kinds):
    every, steady = parts_of(np.ones(60), 1, 59, (first, last))
    steady = replace(steady, samples=slice(first, last))
    # The last sample used is one before the end of the level.
    assert len(findings(every, steady, ends=(0.0, 59.8))) == kinds


def test_a_step_at_an_end_is_named_in_place_of_a_ramp_at_that_end_only():
    every, steady = parts_of(turned(0.1, NUMBER < 20))
    assert [one.kind for one in findings(every, steady)] == ["phase step", "ramp"]
    every, steady = parts_of(turned(0.1, NUMBER >= 40))
    assert [one.kind for one in findings(every, steady)] == ["ramp", "phase step"]


def test_a_beat_of_the_whole_recording_is_named_in_place_of_ramps_but_not_of_a_transient():
    beating = 1.0 + 0.3 * np.exp(2j * np.pi * 2.025 * NUMBER / 60)
    every, steady = parts_of(beating, level=(90, 200))
    beat, rest = findings(every, steady)
    assert (beat.kind, beat.severity, beat.channel, rest.kind) == ("beating", SERIOUS, "x", "transient")
    assert f"beats at {2.025 / 60:.4g} Hz by 30.0%" in beat.text
    # Where all of the recording but a cycle is level, beats are looked for in the part used only.
    every, steady = parts_of(1.0 + 0.3 * np.exp(2j * np.pi * 2.025 * NUMBER / 20), 0, 20)
    every, ends = every.chosen(slice(0, 20)), (0.0, 19.8)
    assert findings(every, steady, total=20, ends=ends) == []
    assert [one.kind for one in findings(every, steady, total=21, ends=ends)] == ["beating"]


def test_each_channel_has_its_own_slow_beat():
    lines = np.ones((60, 2), dtype=complex)
    lines[:, 1] += 0.2 * np.exp(-2j * np.pi * 3.025 * NUMBER / 60)
    every, _ = parts_of(lines)
    (seen,) = cycle_findings.slow_beats(("x", "y"), TIME, every, 2.0)
    assert seen.channel == "y" and f"y beats at {2 * 3.025 / 60:.4g} Hz by 20.0%" in seen.text
    assert seen.times.tolist() == [[0.0, 59.8]] and seen.count == 60 and seen.share == 1.0


@pytest.mark.parametrize("course", ["none", "line", "parabola", "both"])
@pytest.mark.parametrize("cycles", [5, 9, 14, 20])
def test_a_beat_beside_a_trend_has_its_own_size_and_frequency(course, cycles):
    """A parabola over the whole recording is no beat, and takes up nothing of one of several turns."""
    place = np.linspace(-1.0, 1.0, 60)
    trend = (0.3 * place if course in ("line", "both") else 0.0) + (
        0.2 * (place**2 - np.mean(place**2)) if course in ("parabola", "both") else 0.0
    )
    noise = 1e-4 * np.random.default_rng(3).standard_normal(60)
    assert [*cycle_findings._beats(("x",), TIME, windows_of(1.0 + trend + noise), 3.0)] == []
    beat = 0.08 * np.cos(2 * np.pi * cycles * NUMBER / 60 + 0.7)
    both = np.column_stack([1.0 + trend + noise, 2.0 * (1.0 + trend + beat + noise)])
    (seen,) = cycle_findings._beats(("x", "y"), TIME, windows_of(both), 3.0)
    assert (seen.kind, seen.channel, seen.severity, seen.count) == ("beating", "y", SERIOUS, 60)
    assert f"the amplitude of y beats at {3.0 * cycles / 60:.4g} Hz by " in seen.text
    assert float(seen.text.split(" by ")[1].strip("%")) == pytest.approx(8.0, abs=0.2)
    assert seen.times.tolist() == [[0.0, 59.8]] and seen.share == 1.0


@pytest.mark.parametrize("count, cycles", [(24, 6), (40, 12), (64, 30), (64, 3)])
def test_lines_count_as_beats_from_three_times_the_limit_of_fisher_s_test_on(count, cycles):
    """The mean power of ten lines on each side, two apart, times ln(lines/1e-4); sums in place of the FFT."""
    number, seen, expected = np.arange(count), [], []
    noise = np.random.default_rng(4).standard_normal(count)
    sizes = np.geomspace(0.02, 20.0, 80)
    for size in sizes:
        values = 10.0 + 0.3 * (noise + size * np.cos(2 * np.pi * cycles * number / count))
        rest = values - np.polyval(np.polyfit(number, values, 2), number)
        wave = np.exp(-2j * np.pi * np.outer(np.arange(2, count // 2 + 1), number) / count)
        power = np.abs(wave @ (rest * (0.5 - 0.5 * np.cos(2 * np.pi * number / (count - 1))))) ** 2
        line = int(np.argmax(power))
        away = np.abs(np.arange(power.size) - line)
        about = power[(away >= 3) & (away <= 12)]
        fine = about.size >= 6 and power[line] >= 3.0 * about.mean() * np.log(power.size / 1e-4)
        expected.append(bool(fine and np.sqrt(2) * rest.std() / values.mean() > 0.01))
        seen.append(len([*cycle_findings._beats(("x",), np.arange(5 * count) / 5.0, windows_of(values), 1.0)]) == 1)
    assert seen == expected and any(seen) and not all(seen)
