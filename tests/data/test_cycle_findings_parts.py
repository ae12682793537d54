"""Words and limits of findings about cycles: `cycle_findings`, `_changes` and `_vibrations` with given changes."""

import re
from dataclasses import replace

import numpy as np
import pytest

from bayesperiodic.data import cycle_findings as module
from bayesperiodic.data.changes import DRIFT, STEP, TONE, TRANSIENT, Changes
from bayesperiodic.data.recording_check import HARMLESS, SERIOUS, Finding
from bayesperiodic.data.steadiness import Steady
from tests.data.test_steady_limits import windows_of

TIME = np.arange(2000) / 5.0  # five samples a window of 1 s
COUNT = 40


def changed(kind, components, *, moving=1.0, size=0.0, lasting=0.0, error=0.01, place=17, **others):
    """Return changes of one kind, of so many components, whose standard errors are all 0.01."""
    probability = {name: float(name == kind) for name in (TRANSIENT, DRIFT, STEP, TONE)}
    each = {"moving": moving, "size": size, "swing": others.pop("swing", 0.0)}
    each = {name: np.broadcast_to(np.asarray(value, dtype=float), (components,)) for name, value in each.items()}
    rows = [np.broadcast_to(np.asarray(value, dtype=float), (COUNT, components)) for value in (lasting, error)]
    nothing = np.zeros((COUNT, components))
    beat, oscillating = others.pop("beat", (0.0, 0.0)), others.pop("oscillating", 0.0)
    return Changes(
        nothing, nothing, rows[0] ** 2, probability | others, each["moving"], each["size"], rows[1], place,
        each["swing"], beat, oscillating,
    )  # fmt: skip


def steady(effects, channels=1, jump=0.0, cycles=1, amplitudes=None, **fields):
    """Return a steady part of harmonics 0 to 2, whose means are 0.5, 2 and 1 in the first channel and twice these."""
    part = windows_of(np.ones((COUNT, channels)))
    part.amplitudes[:] = np.array([0.5, 2.0, 1.0]) * (1.0 + np.arange(channels))[:, None]
    if amplitudes is not None:
        part.amplitudes[:] = amplitudes
    part = replace(part, jump=np.broadcast_to(np.asarray(jump, dtype=float), (channels,)), cycles=cycles)
    level = slice(0, 5 * COUNT)
    given = {"bias": 0.0, "transient": 0.0} | fields
    return Steady(
        part, level, (0, 5 * COUNT), np.zeros((channels, 3)), np.zeros((2, channels)), changes=effects, **given
    )


def listed(*given, beating=None, **fields):
    count = fields.get("channels", 1)
    return [*module._changes("xyz"[:count], TIME, steady(*given, **fields), beating or {})]


# Components of a channel: the mean value, along harmonics 1 and 2, and across them.
MEAN, ALONG, HIGHER = np.eye(5)[:3]


@pytest.mark.parametrize("kind, words, least", [(DRIFT, "changes", 0.015), (STEP, "steps", 0.005)])
@pytest.mark.parametrize("factor, severity", [(0.99, HARMLESS), (1.01, SERIOUS)])
@pytest.mark.parametrize(
    "component, which",
    [
        (ALONG, "the amplitude of x {} by {:+.2%}"), (HIGHER, "the amplitude of x at harmonic 2 {} by {:+.2%}"),
        (MEAN, "the mean value of x {} by {:+.2%}"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_changes_are_relative_to_the_strongest_amplitude(kind, words, least, factor, severity, component, which, sign):
    """Small ones are harmless whatever they do; the bias of 0.03 is three standard errors."""
    relative = sign * factor * least
    effects = changed(kind, 5, moving=component, size=2.0 * relative * component, lasting=0.03 * component)
    (seen,) = listed(effects)
    text = which.format(words, relative) + (" of the amplitude" if component is not ALONG else "")
    where = " at about 17 s" if kind == STEP else " over the part used"
    assert seen.text == f"{text}{where}: 3 standard errors of its mean amplitudes, which are added to their errors"
    assert seen.severity == severity and seen.bias == pytest.approx(3.0)
    name = "drift" if kind == DRIFT else "mean step" if component is MEAN else "amplitude step"
    assert (seen.kind, seen.channel) == (name, "x")
    expected = ([[17.0, 17.0]], 1, 1 / 40) if kind == STEP else ([[0.0, TIME[199]]], 40, 1.0)
    assert (seen.times.tolist(), seen.count, seen.share) == expected


@pytest.mark.parametrize("lasting, severity", [(0.0199, HARMLESS), (0.0201, SERIOUS)])
def test_changes_of_two_standard_errors_are_serious(lasting, severity):
    (seen,) = listed(changed(DRIFT, 5, moving=ALONG, size=0.2 * ALONG, lasting=lasting * ALONG))
    assert seen.severity == severity


def test_effects_of_all_harmonics_are_added_in_squares_but_not_that_of_the_mean():
    """Along and across harmonics 1 and 2; the worst harmonic is that of the largest bias."""
    lasting = np.array([0.07, 0.03, 0.04, 0.0, 0.0])
    mean, amplitude = sorted(
        listed(changed(STEP, 5, size=0.2, lasting=lasting)), key=lambda one: one.text, reverse=True
    )
    assert mean.bias == pytest.approx(7.0) and amplitude.bias == pytest.approx(5.0)
    assert "at harmonic 2 steps by +10.00% of the amplitude" in amplitude.text and ": 5 standard" in amplitude.text
    # What does not move is not the worst one.
    moving = np.array([0.0, 1.0, 0.5, 0.0, 0.0])
    (seen,) = listed(changed(STEP, 5, moving=moving, size=0.2, lasting=lasting))
    assert "at harmonic" not in seen.text and seen.bias == pytest.approx(5.0)


@pytest.mark.parametrize("moving, jump, seen", [(0.991, 0.0, 1), (0.989, 0.0, 0), (1.0, 0.19, 1), (1.0, 0.21, 0)])
def test_changes_are_certain_and_larger_than_samples_at_jumps(moving, jump, seen):
    for sign in (1.0, -1.0):
        given = changed(DRIFT, 5, moving=moving * ALONG, size=0.2 * sign * ALONG, lasting=0.03 * ALONG)
        assert len(listed(given, jump=jump)) == seen


def test_changes_of_several_channels_are_told_apart():
    """The second channel's amplitude is 4; that of the third does not change enough."""
    size = np.r_[0.0 * MEAN, 0.4 * ALONG, 0.2 * ALONG]
    effects = changed(STEP, 15, moving=np.r_[MEAN * 0, ALONG, ALONG], size=size, lasting=0.5 * size, place=3)
    (seen,) = listed(effects, channels=3, jump=[0.0, 0.1, 0.3])
    assert seen.channel == "y" and seen.text.startswith("the amplitude of y steps by +10.00% at about 3 s: 20 standard")
    assert listed(None) == []


@pytest.mark.parametrize("drift, step, seen", [(0.3, 0.21, 1), (0.3, 0.19, 0), (0.6, 0.4, 1), (0.4, 0.6, 2)])
def test_drifts_and_steps_are_more_probable_than_all_else(drift, step, seen):
    effects = changed(None, 5, size=0.2 * ALONG, moving=ALONG, lasting=0.03 * ALONG, **{DRIFT: drift, STEP: step})
    said = [one.kind for one in listed(effects)]
    assert said == [[], ["drift"], ["amplitude step"]][seen]


VIBRATION = {"beat": (4.0, 25.0), "oscillating": 1.0}


@pytest.mark.parametrize(
    "probability, oscillating, seen",
    [({TRANSIENT: 0.991}, 0.51, 1), ({TRANSIENT: 0.989}, 0.51, 0), ({TRANSIENT: 0.991}, 0.49, 0),
     ({TRANSIENT: 0.4, DRIFT: 0.3, TONE: 0.295}, 0.51, 1), ({TRANSIENT: 0.4, STEP: 0.6}, 0.51, 0)],
)  # fmt: skip
def test_vibrations_are_certain_and_probably_oscillate(probability, oscillating, seen):
    given = changed(None, 5, swing=0.2 * ALONG, lasting=0.01 * ALONG, **VIBRATION | {"oscillating": oscillating})
    given.probability.update(probability)
    assert [one.kind for one in listed(given) if "beat with" in one.text] == ["transient"] * seen


@pytest.mark.parametrize("cycles", [1, 3])
@pytest.mark.parametrize(
    "decay, kind, said",
    [(25.0, "transient", ", decaying in {:.2g} cycles"), (0.0, "beating", ""), (41.0, "beating", "")],
)
def test_vibrations_are_named_with_period_decay_and_effect(cycles, decay, kind, said):
    """In cycles, of which a window has one or three; the largest swing of a channel counts, and all its effects."""
    given = changed(
        TONE, 10, swing=[9.0, 0.1, 0.2, 0.05, 0.0, 0.0, 0.8, 0.0, 0.0, 0.0], oscillating=1.0, beat=(4.0, decay),
        moving=[0.4, 0.6, 1.0, 0.0, 0.0, 0.0, 0.51, 0.0, 0.0, 0.0], lasting=[0.9, 0.03, 0.04, 0.9, 0.9] + [0.05] * 5,
    )  # fmt: skip
    one, two = listed(given, channels=2, cycles=cycles)
    text = (
        "the cycles of {} beat with a period of {:.3g} cycles by {} of the amplitude" + said.format(decay * cycles)
        + ": 5 standard errors of its mean amplitudes; a vibration that is not over, a second frequency, or a response "
        "period of several cycles"
    )  # fmt: skip
    assert one.text == text.format("x", 4.0 * cycles, "10.0%") and two.text == text.format("y", 4.0 * cycles, "20.0%")
    assert (one.kind, one.severity, one.count, one.share) == (kind, SERIOUS, 40 * cycles, 1.0)
    assert one.bias == pytest.approx(5.0) and one.times.tolist() == [[0.0, TIME[199]]]


@pytest.mark.parametrize(
    "relative, effect, severity",
    [(0.051, 0.51, SERIOUS), (0.049, 0.51, HARMLESS), (0.051, 0.49, HARMLESS), (0.0101, 2.01, SERIOUS),
     (0.0099, 2.01, HARMLESS), (0.0101, 1.99, HARMLESS), (0.2, 9.0, SERIOUS)],
)  # fmt: skip
def test_vibrations_are_serious_by_size_and_effect(relative, effect, severity):
    given = changed(TONE, 5, swing=2.0 * relative * ALONG, moving=ALONG, lasting=0.01 * effect * ALONG, **VIBRATION)
    assert [one.severity for one in listed(given)] == [severity]
    assert listed(given, jump=2.01 * relative) == []
    assert len(listed(given, jump=1.99 * relative)) == 1
    # Listed again only if they are more severe than the beat that is known.
    for known, seen in ((SERIOUS, 0), (severity, 0), (HARMLESS, int(severity == SERIOUS))):
        assert len(listed(given, beating={"x": known})) == seen


@pytest.mark.parametrize("transient, bias, count, severity", [
    (0.991, 0.301, 40, HARMLESS), (0.989, 0.31, 40, None), (0.991, 0.299, 40, None), (0.991, 0.501, 40, SERIOUS),
    (0.991, 0.499, 40, HARMLESS), (0.991, 0.31, 4, HARMLESS), (0.991, 0.31, 3, SERIOUS),
])  # fmt: skip
def test_rest_of_a_transient_in_the_part_used(transient, bias, count, severity):
    given = steady(None, transient=transient, bias=bias)
    given = replace(given, part=given.part.chosen(slice(0, count)))
    seen = [*module._changes("x", TIME, given, {})]
    assert [(one.severity, one.kind, one.channel, one.count) for one in seen] == [
        (severity, "transient", "", count)
    ] * (severity is not None)
    if severity:
        least = "at least " if count == 3 else ""
        assert seen[0].text == (
            f"a rest of the transient is in the part used, 0 to 39.8 s, and biases the amplitudes by {least}{bias:.2g} "
            "standard errors"
        )
        assert seen[0].bias == bias and seen[0].cure == "record longer, or begin later with recording.between"


def whole(
    level=(0, 200), used=(0, 200), ends=(0.0, 39.8), total=40, beats=(), slow=(), steps=(), effects=None, rate=1.0
):
    """Return all findings about the cycles of a steady part, with given beats and steps, and what these are asked."""
    part = steady(effects)
    part = replace(part, level=level, samples=slice(*used))
    part = replace(part, part=part.part.chosen(slice(used[0] // 5, used[1] // 5)))
    every, asked = windows_of(np.ones(60)), []

    def named(name, answers):
        def answer(*given):
            asked.append((name, given))
            yield from answers

        return answer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_beats", named("beats", beats))
        patch.setattr(module, "slow_beats", named("slow", slow))
        patch.setattr(module, "_outer_steps", named("steps", steps))
        patch.setattr(module, "_changes", named("changes", ()))
        seen = [*module.cycle_findings("x", TIME, every, part, rate, total, ends)]
    return seen, asked, part, every


BEAT = Finding("beating", "x", SERIOUS, np.zeros((1, 2)), 40, 1.0, np.nan, "it beats")
JUMP = Finding("phase step", "", HARMLESS, np.zeros((1, 2)), 1, 0.1, np.nan, "it steps")


def test_cycles_before_and_after_the_steady_part_are_ramps_and_transients():
    """cycle_findings: of 60 cycles those from 10 s to 40 s have one level, those from 15 s on are used."""
    seen, asked, part, every = whole((50, 200), (75, 200), (0.0, 59.8), 60)
    used = "15 to 39.8 s are used (25 of 60 cycles)"
    assert [(one.kind, one.channel, one.severity) for one in seen] == [
        ("ramp", "", HARMLESS), ("ramp", "", HARMLESS), ("transient", "", HARMLESS),
    ]  # fmt: skip
    assert [one.text for one in seen] == [
        f"the signals change until 10 s; {used}", f"the signals change from 39.8 s; {used}",
        f"a rest of the transient is in the amplitudes until 15 s; {used}",
    ]  # fmt: skip
    assert [one.times.tolist() for one in seen] == [[[0.0, 10.0]], [[39.8, 59.8]], [[10.0, 15.0]]]
    assert [one.count for one in seen] == [10, 20, 5] and [one.share for one in seen] == [10 / 60, 20 / 60, 5 / 60]
    (beats, slow, before, after, changes) = asked
    assert beats == ("beats", ("x", TIME, part.part, 1.0)) and slow == ("slow", ("x", TIME, every, 1.0))
    assert before == ("steps", (TIME, every, part, 1.0, True, used)) and after[1][4] is False
    assert changes == ("changes", ("x", TIME, part, {}))


@pytest.mark.parametrize("first, ends, count", [(5, 39.8, 1), (4, 39.8, 0), (0, 40.9, 1), (0, 40.7, 0)])
def test_less_than_a_cycle_is_not_listed(first, ends, count):
    seen, *_ = whole((first, 200), (first, 200), (0.0, ends), 41)
    assert len(seen) == count
    fast, *_ = whole((first, 200), (first, 200), (0.0, ends), 41, rate=0.5)
    assert fast == []


def test_steps_of_the_phase_and_slow_beats_are_no_ramps():
    seen, *_ = whole((50, 200), (75, 200), (0.0, 39.8), 40, steps=(JUMP,))
    assert [one.kind for one in seen] == ["phase step", "transient"]
    seen, asked, *_ = whole((50, 200), (75, 200), (0.0, 39.8), 40, slow=(BEAT,))
    assert [one.kind for one in seen] == ["beating", "transient"] and asked[-1][1][3] == {"x": SERIOUS}


@pytest.mark.parametrize("last, asked_again", [(200, False), (196, False), (195, True)])
def test_slow_beats_are_sought_if_there_are_others_or_cycles_are_left_out(last, asked_again):
    """Where the first and the last sample of the level are less than 39 of 40 cycles apart."""
    for beats in ((), (BEAT,)):
        seen, asked, *_ = whole((0, last), (0, last), (0.0, TIME[last - 1]), 40, beats=beats)
        assert ("slow" in [name for name, _ in asked]) == (asked_again or bool(beats))
        assert [one.kind for one in seen] == ["beating"] * len(beats)
        assert asked[-1][1][3] == ({"x": SERIOUS} if beats else {})
    # Slow ones take the place of those of the part used.
    slow = replace(BEAT, severity=HARMLESS, text="slowly")
    seen, asked, *_ = whole(beats=(BEAT,), slow=(slow,))
    assert [one.text for one in seen] == ["slowly"] and asked[-1][1][3] == {"x": HARMLESS}


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize(
    "turn, noise, wrong, seen",
    [(0.05, 1e-4, None, True), (-0.05, 1e-4, None, True), (0.005, 1e-4, None, False), (0.0065, 1e-4, None, True),
     (0.05, 1e-4, "size", False), (0.05, 1e-4, "wander", False), (0.05, 1e-4, "one", False), (0.05, 0.05, None, False)],
)  # fmt: skip
def test_steps_of_all_phases_at_an_end_of_the_part_used(before, turn, noise, wrong, seen):
    """_outer_steps: from half a degree and eight standard deviations on, if the amplitudes outside are the same.

    The second channel has its second harmonic, which turns twice as much.
    """
    generator = np.random.default_rng(1)
    phase = noise * 2 * np.pi * generator.standard_normal((60, 2))
    outside = np.arange(60) < 10 if before else np.arange(60) >= 50
    phase[outside] += 2 * np.pi * turn * np.array([1.0, 2.0 if wrong != "one" else 0.0])
    if wrong == "wander":
        phase[outside] += np.pi * turn * np.array([1.0, 2.0]) * np.linspace(-1.0, 1.0, 10)[:, None]
    amplitudes = np.zeros((60, 2, 3), dtype=complex)
    amplitudes[:, 0, 1], amplitudes[:, 1, 2] = 2.0 * np.exp(1j * phase[:, 0]), 3.0 * np.exp(1j * phase[:, 1])
    if wrong == "size":
        amplitudes[outside] *= 1.05
    every = windows_of(np.ones((60, 2)))
    every.amplitudes[:] = amplitudes
    part = every.chosen(np.flatnonzero(~outside).tolist())
    level = (int(part.first[0]), int(part.last[-1]))
    given = Steady(part, slice(*level), level, np.zeros((2, 3)), np.zeros((2, 2)))
    found = [*module._outer_steps(TIME, every, given, 1.25, before, "used")]
    assert len(found) == seen
    if seen:
        at = TIME[level[0] if before else level[1] - 1]
        one = found[0]
        assert one.times.tolist() == [[at, at]] and (one.kind, one.severity, one.count) == ("phase step", HARMLESS, 1)
        assert one.share == 1 / 50 and one.text.endswith("; used")
        said = float(re.search(r"steps by (\S+)°", one.text)[1])
        assert said == pytest.approx(360.0 * turn * (-1.0 if before else 1.0), rel=0.02 + 20 * noise / abs(turn))
        delay, samples = map(float, re.search(r"\((\S+) s, (\S+) samples\)", one.text).groups())
        assert delay == pytest.approx(said / 360.0 / 1.25, rel=1e-2) and samples == pytest.approx(
            abs(delay) * 5.0, rel=1e-2
        )
    nowhere = replace(given, level=(0, 300))
    assert [*module._outer_steps(TIME, every, nowhere, 1.25, before, "used")] == []
