"""Beats, steps and changes of cycles in words: the number of each in the text is that of its definition."""

from dataclasses import replace

import numpy as np
import pytest

from bayesperiodic.data import cycle_findings
from bayesperiodic.data.changes import changes
from bayesperiodic.data.recording_check import HARMLESS, SERIOUS
from bayesperiodic.data.steadiness import Steady
from tests.data.test_steady_limits import windows_of

TIME = np.arange(2000) / 5.0  # five samples a window of 1 s


@pytest.mark.parametrize("turns", [1.0, 2.5, 6.0])
@pytest.mark.parametrize("size", [0.1, 0.4])
@pytest.mark.parametrize("both", [False, True])
def test_beats_are_lines_beside_the_amplitude(turns, size, both):
    """One line beside the harmonic, or two of an amplitude that is modulated."""
    count = np.arange(60) / 60
    wave = np.exp(2j * np.pi * turns * count)
    line = 2.0 * np.exp(0.3j) * (1.0 + size * (wave + (np.conj(wave) if both else 0.0)) / (2.0 if both else 1.0))
    seen, amplitude = cycle_findings._beat(line)
    if both and turns < 1.75:
        return
    assert seen == pytest.approx(turns, abs=0.07) and amplitude == pytest.approx(size, rel=0.1)
    assert cycle_findings._beat(np.conj(line))[0] == pytest.approx(turns, abs=0.07)


def test_noise_and_constants_have_no_beat():
    generator = np.random.default_rng(1)
    assert cycle_findings._beat(1.0 + 0.1 * (generator.standard_normal(60) + 1j * generator.standard_normal(60))) == (
        0,
        0,
    )
    assert cycle_findings._beat(np.full(60, 2.0 + 0j)) == (0.0, 0.0)


@pytest.mark.parametrize("count, size, seen", [(12, 0.2, 1), (11, 0.2, 0), (30, 0.04, 0), (30, 0.06, 1)])
def test_slow_beats_of_five_percent_and_twelve_cycles_are_serious(count, size, seen):
    turns = 2.025
    line = 1.0 + size * np.exp(2j * np.pi * turns * np.arange(count) / count)
    listed = [*cycle_findings.slow_beats(("x",), TIME, windows_of(line), 2.0)]
    assert len(listed) == seen
    if seen:
        assert listed[0].text == f"the amplitude of x beats at {turns * 2.0 / count:.4g} Hz by {size:.1%}"
        assert (listed[0].severity, listed[0].count, listed[0].kind) == (SERIOUS, count, "beating")
        assert listed[0].times.tolist() == [[0.0, TIME[5 * count - 1]]] and "ramps" not in listed[0].cure


def test_a_beat_of_one_turn_may_be_ramps():
    line = 1.0 + 0.3 * np.exp(2j * np.pi * 1.025 * np.arange(40) / 40)
    (seen,) = cycle_findings.slow_beats(("x",), TIME, windows_of(line), 1.0)
    assert seen.text.endswith(", or ramps up and down") and seen.cure.endswith("; of ramps record the steady part")


@pytest.mark.parametrize(
    "count, size, severity", [(48, 0.03, HARMLESS), (48, 0.1, SERIOUS), (23, 0.1, None), (48, 0.005, None)]
)
def test_periodic_modulations_of_a_cycle_are_beats(count, size, severity):
    """From 1 % on, serious from 5 %; at least 24 cycles are needed."""
    sizes = (
        1.0
        + size * np.cos(2 * np.pi * 8.0 * np.arange(count) / 48)
        + 1e-4 * np.random.default_rng(0).standard_normal(count)
    )
    listed = [*cycle_findings._beats(("x",), TIME, windows_of(sizes), 3.0)]
    assert [one.severity for one in listed] == [severity] * (severity is not None)
    if severity:
        assert listed[0].text == f"the amplitude of x beats at {8 * 3.0 / 48:.4g} Hz by {size:.1%}"
        assert [*cycle_findings._beats(("x",), TIME, windows_of(2.0 * sizes, slip=2.0 * size), 3.0)] == []
        large = cycle_findings._beats(("x",), TIME, windows_of(9.0 * sizes, slip=0.1 * size), 3.0)
        assert [one.severity for one in large] == [severity]
    noise = 1.0 + 0.1 * np.random.default_rng(2).standard_normal(48)
    assert [*cycle_findings._beats(("x",), TIME, windows_of(noise), 3.0)] == []


def test_steps_of_the_phase_in_words():
    """0.05 cycles at 2 Hz are 18°, 0.025 s, and 2.5 samples at 100 Hz."""
    text = cycle_findings.stepped("x", -0.05, 12.5, 100.0, 2.0)
    assert text == (
        "the phase of x steps by -18° (-0.025 s, 2.5 samples) at about 12.5 s: samples were lost, or the clock or the "
        "drive stepped"
    )
    assert cycle_findings.stepped("", 0.05, 12.5, 100.0, 2.0).startswith(
        "the phase of all channels steps by 18° (0.025 s"
    )


def steady_of(components, bias=0.0, transient=0.0):
    """Return the steady part of a channel x whose amplitude of harmonic 1 and mean value are given by cycle."""
    amplitude, mean = components
    part = windows_of(amplitude, mean=mean)
    shape = np.column_stack([part.amplitudes[:, 0].real, part.amplitudes[:, 0, 1:].imag])
    return Steady(
        part, slice(0, 5 * len(part.first)),
        (0, 5 * len(part.first)), np.zeros((1, 3)), np.zeros((2, 1)), bias, transient,
        changes(shape, 0.6),
    )  # fmt: skip


CYCLE = np.arange(40)
NOISE = 1e-3 * np.random.default_rng(5).standard_normal((2, 40))


@pytest.mark.parametrize(
    "course, mean, kind, severity, said",
    [
        (0.03 * CYCLE / 39, 0.0, "drift", SERIOUS, "the amplitude of x changes by +2."),
        (-0.008 * CYCLE / 39, 0.0, "drift", HARMLESS, "the amplitude of x changes by -0.8"),
        (0.0, 0.04 * CYCLE / 39, "drift", SERIOUS, "the mean value of x changes by +"),
        (0.03 * (CYCLE >= 17), 0.0, "amplitude step", SERIOUS, "the amplitude of x steps by +"),
        (0.0045 * (CYCLE >= 17), 0.0, "amplitude step", HARMLESS, "the amplitude of x steps by +0."),
        (0.0, -0.03 * (CYCLE >= 17), "mean step", SERIOUS, "the mean value of x steps by -"),
    ],
)
def test_changes_are_named_with_size_place_and_severity(course, mean, kind, severity, said):
    """Relative to the amplitude of 1; the steps are at 17 s."""
    steady = steady_of((1.0 + course + 0.5 * NOISE[0], 0.2 + mean + 0.5 * NOISE[1]))
    (seen,) = cycle_findings._changes(("x",), TIME, steady, {})
    assert (seen.kind, seen.severity, seen.channel) == (kind, severity, "x") and seen.text.startswith(said)
    change = np.ravel(course + mean * np.ones(40))
    size = float(seen.text.split(" by ")[1].split("%")[0])
    assert size == pytest.approx(100 * (change[-1] - change[0]), rel=0.15, abs=0.1)
    if "step" in kind:
        assert (
            "at about 17 s: " in seen.text
            and seen.times.tolist() == [[17.0, 17.0]]
            and (seen.count, seen.share) == (1, 1 / 40)
        )
        assert seen.cure == "fold the parts before and after it: recording.between(start, stop)"
    else:
        assert (
            "over the part used: " in seen.text
            and seen.times.tolist() == [[0.0, 39.8]]
            and (seen.count, seen.share) == (40, 1.0)
        )
        assert seen.cure == "select a steadier part with recording.between(start, stop)"
    assert ("% of the amplitude " in seen.text) == ("mean" in said)
    effect = float(seen.text.split(": ")[1].split()[0])
    assert seen.bias == pytest.approx(effect, rel=0.05) and "which are added to their errors" in seen.text


@pytest.mark.parametrize(
    "bias, transient, severity", [(0.29, 1.0, None), (0.31, 1.0, HARMLESS), (0.51, 1.0, SERIOUS), (0.6, 0.98, None)]
)
def test_rest_of_a_transient_is_named_by_its_bias(bias, transient, severity):
    steady = steady_of((1.0 + NOISE[0], NOISE[1]), bias, transient)
    listed = [*cycle_findings._changes(("x",), TIME, steady, {})]
    assert [(one.kind, one.severity) for one in listed] == [("transient", severity)] * (severity is not None)
    if severity:
        assert (
            f"is in the part used, 0 to 39.8 s, and biases the amplitudes by {bias:.2g} standard errors"
            in listed[0].text
        )
        few = replace(steady, part=steady.part.chosen(slice(0, 3)), samples=slice(0, 15), changes=None)
        (least,) = cycle_findings._changes(("x",), TIME, few, {})
        assert least.severity == SERIOUS and f"by at least {bias:.2g} standard errors" in least.text


def test_a_vibration_is_named_with_its_period_and_decay():
    wave = 0.2 * np.exp(-CYCLE / 30.0) * np.cos(2 * np.pi * CYCLE / 5.0)
    steady = steady_of((1.0 + wave + 0.1 * NOISE[0], 0.1 * NOISE[1]))
    (seen,) = cycle_findings._changes(("x",), TIME, steady, {})
    assert (seen.kind, seen.channel, seen.count) == ("transient", "x", 40)
    words = seen.text.split()
    assert float(words[words.index("of", 4) + 1]) == pytest.approx(5.0, rel=0.02)
    assert "by 2" in seen.text or "by 19" in seen.text
    assert float(seen.text.split("decaying in ")[1].split()[0]) == pytest.approx(30.0, rel=0.2)
    beating = {"x": seen.severity}
    assert [*cycle_findings._changes(("x",), TIME, steady, beating)] == []


def test_a_channel_at_rest_does_not_hide_the_vibration_of_the_next_one():
    wave = 0.2 * np.cos(2 * np.pi * CYCLE / 5.5)
    part = windows_of(np.column_stack([1.0 + NOISE[0], 2.0 * (1.0 + wave + NOISE[1])]))
    shape = np.concatenate([part.amplitudes.real, part.amplitudes.imag[:, :, 1:]], axis=2).reshape(40, -1)
    still = dict(samples=slice(0, 200), level=(0, 200), squares=np.zeros((2, 3)), change=np.zeros((2, 2)))
    steady = Steady(part, **still, transient=0.0, changes=changes(shape, 0.6))
    (seen,) = cycle_findings._changes(("u", "x"), TIME, steady, {})
    assert seen.channel == "x" and "with a period of 5.5" in seen.text
