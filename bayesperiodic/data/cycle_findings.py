"""What is not steady in the cycles of a recording: ramps, transients, drifts, steps, beats, and phases that step."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bayesperiodic.data.changes import DRIFT, STEP, TONE, TRANSIENT, Changes
from bayesperiodic.data.harmonics import MINIMUM_CYCLES
from bayesperiodic.data.recording_check import HARMLESS, SERIOUS, SERIOUS_BIAS, Finding
from bayesperiodic.data.steadiness import Steady, Windows

# Probability from which a change that is there oscillates, and from which a component has it.
PROBABLE_KIND = 0.5
# Bias by a transient that is listed, in standard errors, and probability that there is no change where one is.
ALLOWED_BIAS, CHANGE_FALSE_ALARM = 0.3, 0.01
# Beat relative to the amplitude that is serious, and step of the phase [cycles] that is harmless.
LARGE_BEAT, HARMLESS_PHASE = 0.05, 1.0 / 180.0
# Drift and step relative to the amplitude whose effect is in the errors stated, and that are no fault.
HARMLESS_DRIFT, HARMLESS_STEP = 0.015, 0.005
# Effect of a drift or step on the mean, in standard errors, from which it is serious: slow noise has smaller ones.
SERIOUS_CHANGE = 2.0
# Change between neighbouring cycles that is a step, in standard deviations of the other changes.
STEP_FROM_CYCLE = 8.0
# Amplitude of a beat relative to the mean one, its false-alarm rate, and the cycles needed.
HARMLESS_BEAT, BEAT_FALSE_ALARM, FEWEST_FOR_BEATS = 0.01, 1e-4, 24
# Beats of the whole recording: turns with one line beside the harmonic or two, step of the number of turns, share of
# the variance of the amplitude that they explain, and fewest windows.
LEAST_TURNS, STEP_OF_TURNS, EXPLAINED, FEWEST_FOR_SLOW_BEATS = (0.9, 1.75), 0.125, 0.9, 12
# Turns below which a beat looks like a ramp up and down.
TURNS_OF_A_RAMP = 1.5
# Range of the logarithm of an amplitude that differs in its phase only: in itself, and in standard deviations.
SAME_SIZE, SAME_IN_NOISE = 0.03, 4.0
BEATING, PHASE_STEP = "beating", "phase step"


def cycle_findings(
    channels: Sequence[str],
    time: np.ndarray,
    every: Windows,
    steady: Steady,
    frequency: float,
    total: int,
    ends: tuple[float, float],
) -> Iterator[Finding]:
    """Return the findings about the cycles: what was left out, and what changes in the part that is used.

    Times are those of the first group of channels; `ends` are the first and the last that all channels have in common.
    """
    start, stop = float(time[steady.samples.start]), float(time[steady.samples.stop - 1])
    level = [float(time[i]) for i in (steady.level[0], steady.level[1] - 1)]
    used = f"{start:.6g} to {stop:.6g} s are used ({len(steady.part.first) * steady.part.cycles} of {total} cycles)"
    beats, slow = [*_beats(channels, time, steady.part, frequency)], []
    if beats or (level[1] - level[0]) * frequency < total - 1.0:
        slow = [*slow_beats(channels, time, every, frequency)]
    yield from slow or beats
    named = {beat.channel: beat.severity for beat in slow or beats}
    for kind, a, b, what in (
        ("ramp", ends[0], level[0], "the signals change until"),
        ("ramp", level[1], ends[1], "the signals change from"),
        ("transient", level[0], start, "a rest of the transient is in the amplitudes until"),
    ):
        if (b - a) * frequency < 1.0:
            continue
        count = int((b - a) * frequency)
        stepping = [*_outer_steps(time, every, steady, frequency, a < start, used)] if kind == "ramp" else []
        yield from stepping
        if not stepping and not (slow and kind == "ramp"):
            place = b if what.endswith("until") else a
            yield Finding(
                kind, "", HARMLESS, np.array([[a, b]]), count, count / total, np.nan, f"{what} {place:.6g} s; {used}"
            )
    yield from _changes(channels, time, steady, named)


def slow_beats(channels: Sequence[str], time: np.ndarray, every: Windows, frequency: float) -> Iterator[Finding]:
    """Return beats of the whole recording that have a steady part by their slowness only, or none."""
    part = every.apart()
    if len(part.first) < FEWEST_FOR_SLOW_BEATS:
        return
    for i, channel in enumerate(channels):
        line = part.lines[:, i]
        turns, amplitude = _beat(line)
        if turns and amplitude > LARGE_BEAT:
            beat = turns * frequency / (len(line) * part.cycles)
            yield Finding(
                BEATING, channel, SERIOUS, np.array([[time[part.first[0]], time[part.last[-1] - 1]]]), len(line), 1.0,
                np.nan, f"the amplitude of {channel} beats at {beat:.4g} Hz by {amplitude:.1%}"
                + (", or ramps up and down" if turns < TURNS_OF_A_RAMP else ""),
                "a second frequency is in the signals: remove its source, or average whole beats"
                + ("; of ramps record the steady part" if turns < TURNS_OF_A_RAMP else ""),
            )  # fmt: skip


def _beat(line: np.ndarray) -> tuple[float, float]:
    """Return the turns of a beat over a series of complex amplitudes, and its relative size; zero if there is none."""
    count = np.arange(len(line)) / len(line)
    rest = line - line.mean()
    total = float(np.sum(np.abs(rest) ** 2))
    for least, signs in zip(LEAST_TURNS, ((1.0,), (1.0, -1.0)), strict=True):
        best = (0.0, 0.0, 0.0)
        for turns in np.arange(least, len(line) / 4, STEP_OF_TURNS):
            for sign in (1.0, -1.0)[: 3 - len(signs)]:
                wave = np.exp(2j * np.pi * sign * turns * np.outer(count, signs))
                basis = np.column_stack([np.ones(len(line)), wave])
                size = np.linalg.lstsq(basis, line, rcond=None)[0]
                explained = 1.0 - float(np.sum(np.abs(line - basis @ size) ** 2)) / max(total, np.finfo(float).tiny)
                if explained > best[0] and abs(size[0]) > 0.0:
                    best = (explained, float(turns), float(np.abs(size[1:]).sum() / np.abs(size).max()))
        if best[0] > EXPLAINED:
            return best[1], best[2]
    return 0.0, 0.0


def _outer_steps(
    time: np.ndarray, every: Windows, steady: Steady, frequency: float, before: bool, used: str
) -> Iterator[Finding]:
    """Return a step of the phase of all channels at an end of the part used, if the amplitudes are the same outside."""
    outside = every.last <= steady.level[0] if before else every.first >= steady.level[1]
    if not outside.any():
        return
    harmonic, inside = every.strongest, steady.part.lines
    mean = inside.mean(axis=0)
    ratio, scatter = every.lines[outside] / mean, np.std(inside / mean, axis=0)
    typical = np.angle(np.median(ratio.real, axis=0) + 1j * np.median(ratio.imag, axis=0))
    turns = np.angle(ratio * np.exp(-1j * typical))
    turn = (typical + np.median(turns, axis=0)) / (2.0 * np.pi) / harmonic
    noise = scatter / (2.0 * np.pi) / harmonic
    same = np.median(np.abs(np.log(np.abs(ratio))), axis=0) < SAME_SIZE + SAME_IN_NOISE * scatter
    # The straddling cycles apart, the phase outside is as constant as that inside.
    constant = np.median(np.abs(turns), axis=0) / (2.0 * np.pi) / harmonic < np.abs(turn) / 4.0
    stepping = np.abs(turn) > STEP_FROM_CYCLE * noise + HARMLESS_PHASE
    if not same.all() or not (stepping & constant).any():
        return
    together = bool(stepping.all() and np.ptp(turn) < STEP_FROM_CYCLE * noise.max() + HARMLESS_PHASE)
    if not together:
        return
    at = float(time[steady.level[0] if before else steady.level[1] - 1])
    largest, rate = float(turn[np.argmax(np.abs(turn))]), (time.size - 1) / float(np.ptp(time))
    yield Finding(
        PHASE_STEP, "", HARMLESS, np.array([[at, at]]), 1, 1.0 / len(steady.part.first), np.nan,
        f"{stepped('', -largest if before else largest, at, rate, frequency)}; {used}",
        "fold the parts before and after it: recording.between(start, stop)",
    )  # fmt: skip


def _changes(
    channels: Sequence[str], time: np.ndarray, steady: Steady, beating: Mapping[str, str]
) -> Iterator[Finding]:
    """Return what is clearly not steady in the part used: the rest of a transient, drifts and steps.

    Beats that are `beating` by channel, with their severity, are not listed again unless they are more severe.
    """
    part, effects = steady.part, steady.changes
    start, stop = float(time[steady.samples.start]), float(time[steady.samples.stop - 1])
    every, cycles = np.array([[start, stop]]), len(part.first) * part.cycles
    if steady.transient > 1.0 - CHANGE_FALSE_ALARM and steady.bias > ALLOWED_BIAS:
        # The last cycles are used in any case, and their scatter contains the transient.
        ended = len(part.first) > MINIMUM_CYCLES
        yield Finding(
            "transient", "", SERIOUS if steady.bias > SERIOUS_BIAS or not ended else HARMLESS, every, cycles, 1.0,
            steady.bias, f"a rest of the transient is in the part used, {start:.6g} to {stop:.6g} s, and biases the "
            f"amplitudes by {'' if ended else 'at least '}{steady.bias:.2g} standard errors",
            "record longer, or begin later with recording.between",
        )  # fmt: skip
    if effects is None:
        return
    fading = sum(effects.probability[kind] for kind in (TRANSIENT, DRIFT, TONE))
    if fading > 1.0 - CHANGE_FALSE_ALARM and effects.oscillating > PROBABLE_KIND:
        for finding in _vibrations(channels, steady, effects, every):
            if beating.get(finding.channel) not in (SERIOUS, finding.severity):
                yield finding
        return
    if not effects.slow:
        return
    shape = (len(channels), -1)
    moving, size = effects.moving.reshape(shape), effects.size.reshape(shape)
    bias = np.sqrt(effects.lasting[0]).reshape(shape) / effects.error[0].reshape(shape)
    level = np.abs(part.amplitudes.mean(axis=0))
    step = effects.probability[STEP] > effects.probability[DRIFT]
    at = float(time[part.first[effects.place]])
    for i, channel in enumerate(channels):
        strongest = 1 + int(np.argmax(level[i, 1:]))
        for what, harmonics in (("amplitude", np.arange(1, level.shape[1])), ("mean value", np.zeros(1, dtype=int))):
            worst = int(harmonics[np.argmax(moving[i, harmonics] * bias[i, harmonics])])
            if moving[i, worst] < 1.0 - CHANGE_FALSE_ALARM or np.abs(size[i, worst]) <= part.jump[i]:
                continue
            effect = float(np.sqrt(np.sum(bias[i, harmonics] ** 2)))
            relative = float(size[i, worst] / level[i, strongest])
            small = abs(relative) < (HARMLESS_STEP if step else HARMLESS_DRIFT)
            change = f"{relative:+.2%}"
            which = f"the mean value of {channel}"
            if worst:
                which = f"the amplitude of {channel}" + (f" at harmonic {worst}" if worst != strongest else "")
            which += f" {'steps' if step else 'changes'} by {change}{'' if worst == strongest else ' of the amplitude'}"
            which += f" at about {at:.6g} s" if step else " over the part used"
            yield Finding(
                f"{what.split()[0]} step" if step else "drift", channel,
                HARMLESS if small or effect <= SERIOUS_CHANGE else SERIOUS, np.array([[at, at]]) if step else every,
                1 if step else cycles, 1.0 / len(part.first) if step else 1.0, effect,
                f"{which}: {effect:.2g} standard errors of its mean amplitudes, which are added to their errors",
                "fold the parts before and after it: recording.between(start, stop)" if step else
                "select a steadier part with recording.between(start, stop)",
            )  # fmt: skip


def _vibrations(channels: Sequence[str], steady: Steady, effects: Changes, times: np.ndarray) -> Iterator[Finding]:
    """Return oscillations of the cycles about their mean that are not over at the end of the part used."""
    part = steady.part
    shape = (len(channels), -1)
    level = np.abs(part.amplitudes.mean(axis=0))[:, 1:].max(axis=1)
    swing, moving = effects.swing.reshape(shape), effects.moving.reshape(shape)
    bias = np.sqrt(effects.lasting[0]).reshape(shape) / effects.error[0].reshape(shape)
    beat, decay = (number * part.cycles for number in effects.beat)
    cycles = len(part.first) * part.cycles
    for i, channel in enumerate(channels):
        clear = moving[i] > PROBABLE_KIND
        relative = float(np.where(clear, swing[i], 0.0).max() / level[i])
        effect = float(np.sqrt(np.sum(bias[i, clear] ** 2)))
        if relative <= part.jump[i] / level[i] or not clear.any():
            continue
        lasting = not 0.0 < decay < cycles
        serious = (relative > LARGE_BEAT and effect > SERIOUS_BIAS) or (
            relative > HARMLESS_BEAT and effect > SERIOUS_CHANGE
        )
        yield Finding(
            BEATING if lasting else "transient", channel, SERIOUS if serious else HARMLESS,
            times, cycles, 1.0, effect,
            f"the cycles of {channel} beat with a period of {beat:.3g} cycles by {relative:.1%} of the amplitude"
            + ("" if lasting else f", decaying in {decay:.2g} cycles") + f": {effect:.2g} standard errors of its mean "
            "amplitudes; a vibration that is not over, a second frequency, or a response period of several cycles",
            "record longer, begin later with recording.between, or fold with the `periods` of the response",
        )  # fmt: skip


def stepped(channel: str, turns: float, at: float, rate: float, frequency: float) -> str:
    """Return a step of the phase [cycles] of a channel, or of all, in words; `rate` is the sampling rate [Hz]."""
    delay = turns / frequency
    return (
        f"the phase of {channel or 'all channels'} steps by {360.0 * turns:.3g}° ({delay:.3g} s, "
        f"{abs(delay) * rate:.3g} samples) at about {at:.6g} s: samples were lost, or the clock or the drive stepped"
    )


def _beats(channels: Sequence[str], time: np.ndarray, part: Windows, frequency: float) -> Iterator[Finding]:
    """Return periodic modulations of the amplitudes, by Fisher's test of the largest line of their spectrum."""
    sizes = part.sizes
    count = len(sizes)
    if count < FEWEST_FOR_BEATS:
        return
    place = np.linspace(-1.0, 1.0, count)
    trend = np.polynomial.polynomial.polyfit(place, sizes, 2)
    rest = sizes - np.polynomial.polynomial.polyval(place, trend).T
    spectrum = np.abs(np.fft.rfft(rest * np.hanning(count)[:, None], axis=0))[2:] ** 2
    for i, channel in enumerate(channels):
        power = spectrum[:, i]
        line = int(np.argmax(power))
        # Against the lines about it, so that slow noise is no beat.
        near = np.r_[power[max(line - 12, 0) : max(line - 2, 0)], power[line + 3 : line + 13]]
        if near.size < 6 or power[line] < np.mean(near) * -np.log(BEAT_FALSE_ALARM / spectrum.shape[0]) * 3.0:
            continue
        amplitude = float(np.sqrt(2.0 * rest[:, i].var()) / sizes[:, i].mean())
        slip = float(part.slip[i] / sizes[:, i].mean())
        if amplitude > HARMLESS_BEAT + slip:
            beat = (line + 2) * frequency / (count * part.cycles)
            yield Finding(
                BEATING, channel, SERIOUS if amplitude > LARGE_BEAT + slip else HARMLESS,
                np.array([[time[part.first[0]], time[part.last[-1] - 1]]]),
                count, 1.0, np.nan, f"the amplitude of {channel} beats at {beat:.4g} Hz by {amplitude:.1%}",
                "a second frequency is in the signals: remove its source, or average whole beats",
            )  # fmt: skip
