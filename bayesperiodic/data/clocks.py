"""Clocks of the channels, by their phases relative to the first one: steps, as of lost samples, and steady drifts."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from bayesperiodic.data.recording_check import HARMLESS_PHASE, RUINOUS, RUINOUS_BIAS, SERIOUS, Finding
from bayesperiodic.data.steadiness import ALLOWED_BIAS, SMALL_RANGE, Windows

# Windows on each side of a step, shortest and as a share of all, and the size of a step in robust standard deviations.
SHORTEST_SIDE, SIDES, SIGNIFICANT_STEP = 3, 20, 8.0
# Largest change of the phase on one side of a step, relative to the step: a slope or a transient has 0.5 and more.
FLAT = 1.0 / 3.0
# Windows that may be missing at a step, and most steps that are searched for.
MISSING, MOST_STEPS = 4, 50
# Windows, like those of the steady part in amplitude: largest distance in robust standard deviations.
ALIKE = 6.0
# Phase [cycles] that does not count for any purpose.
ROUNDING_PHASE = 1e-4
# False-alarm rate of a drift over all channels, fewest windows, and orders of polynomials that measure the noise.
DRIFT_FALSE_ALARM, FEWEST_WINDOWS, FEWEST_ORDERS, MOST_ORDERS = 1e-4, 10, 4, 16
# Changes of amplitude [1] that explain a drift of the phase [rad] twice as large; curvature of a clock's drift.
BY_AMPLITUDE, CURVED = 2.0, 0.1
MEDIAN_TO_SD = 1.4826
CLOCK = "clock"


@dataclass(frozen=True)
class Phases:
    """Phases and amplitudes of all channels in windows that do not overlap, (windows, channels)."""

    start: np.ndarray  # times at which the windows begin [s]
    cycle: np.ndarray  # number of cycles before each window
    length: int  # cycles in a window
    turns: np.ndarray  # phases of the strongest harmonics, in cycles of the fundamental
    sizes: np.ndarray  # logarithms of their amplitudes
    order: np.ndarray  # (channels,) these harmonics
    slip: np.ndarray  # (channels,) errors of the phase by one sample more or less at jumps of the signals [cycles]

    def chosen(self, used: np.ndarray) -> "Phases":
        """Return the selected windows."""
        start, cycle, turns, sizes = (values[used] for values in (self.start, self.cycle, self.turns, self.sizes))
        return replace(self, start=start, cycle=cycle, turns=turns, sizes=sizes)


@dataclass(frozen=True)
class Step:
    """A step of the phase of one channel, of all together if there is no other one."""

    channel: str
    other: str  # relative to which it is
    time: float  # [s]
    turns: float  # [cycles]
    order: int  # harmonic by which it was found


@dataclass(frozen=True)
class Drift:
    """A steady drift of the phase of one channel relative to the first one."""

    row: int  # of the channel
    rate: float  # relative difference of the frequencies
    se: float
    turns: float  # over the windows used [cycles]


def phases_of(every: Windows, time: np.ndarray) -> Phases:
    """Return the phases in windows of signals whose first group has these times."""
    part = every.apart()
    amplitudes = np.abs(part.amplitudes[:, :, 1:])
    order = 1 + amplitudes.mean(axis=0).argmax(axis=1)
    lines = np.take_along_axis(part.amplitudes, order[None, :, None], axis=2)[:, :, 0]
    sizes = np.maximum(np.abs(lines), np.finfo(float).tiny)
    turns = np.unwrap(np.angle(lines), axis=0) / (2.0 * np.pi * order)
    slip = part.slip / np.median(sizes, axis=0) / (2.0 * np.pi)
    cycle = part.place * part.cycles / part.overlap
    return Phases(time[part.first], cycle, part.cycles, turns, np.log(sizes), order, slip)


def alike(phases: Phases, used: np.ndarray) -> np.ndarray:
    """Return the windows (bool) whose amplitudes are those of the windows used, anywhere in the recording."""
    middle = np.median(phases.sizes[used], axis=0)
    spread = MEDIAN_TO_SD * np.median(np.abs(phases.sizes[used] - middle), axis=0)
    limit = np.maximum(SMALL_RANGE, ALIKE * spread) + 2.0 * np.pi * phases.slip
    return (np.abs(phases.sizes - middle) <= limit).all(axis=1)


def steps_of(series: np.ndarray, cycle: np.ndarray, least: float) -> tuple[list[tuple[int, float]], np.ndarray]:
    """Return the steps of a series of phases [cycles], as first windows after them and sizes, and the rest.

    Means over as many windows before and after a window, which may be that of the step, are compared with the usual
    differences of such means, and with the changes on both sides: a slope is no step, and neither is a transient.
    """
    rest, found = series.copy(), []
    length = float(np.median(np.diff(cycle))) if cycle.size > 1 else 1.0
    while len(found) < MOST_STEPS:
        best = (0.0, 0, 0.0)
        side = SHORTEST_SIDE
        while side == SHORTEST_SIDE or side * SIDES <= rest.size:
            if rest.size < 2 * side + 1:
                break
            sums = np.concatenate([[0.0], np.cumsum(rest)])
            mean = (sums[side:] - sums[:-side]) / side
            before, after = mean[: -side - 1], mean[side + 1 :]
            half = side // 2
            part = (sums[half:] - sums[:-half]) / half
            change = part[side - half :] - part[: part.size - (side - half)]  # within each stretch of so many windows
            inside = np.maximum(np.abs(change[: before.size]), np.abs(change[side + 1 :][: before.size]))
            jump = after - before
            near = cycle[side + 1 :][: jump.size] - cycle[side - 1 :][: jump.size] <= (MISSING + 2) * length
            usual = MEDIAN_TO_SD * float(np.median(np.abs(jump - np.median(jump))))
            limit = max(SIGNIFICANT_STEP * usual * max(1.0, (SIDES / rest.size) ** 2), least)
            score = np.where(near & (inside <= FLAT * np.abs(jump)), np.abs(jump) / limit, 0.0)
            k = int(np.argmax(score))
            if score[k] > max(best[0], 1.0):
                # The window between them belongs to the side to which it is nearer.
                middle = rest[k + side]
                first = k + side if abs(middle - after[k]) < abs(middle - before[k]) else k + side + 1
                best = (float(score[k]), first, float(jump[k]))
            side *= 2
        if not best[0]:
            break
        found.append(best[1:])
        rest[best[1] :] -= best[2]
    return found, rest


def steps(channels: Sequence[str], phases: Phases, used: np.ndarray) -> tuple[list[Step], np.ndarray]:
    """Return the steps of phases, and the phases relative to the first channel without them, (windows, channels − 1).

    Steps of one channel relative to the others count wherever the amplitudes are those of the windows used; steps of
    all together only where they are used.
    """
    found: list[Step] = []
    inside = phases.chosen(used)
    least = HARMLESS_PHASE + inside.slip.max()
    for k, turns in steps_of(inside.turns[:, 0], inside.cycle, least)[0]:
        found.append(Step("", "", float(inside.start[k]), turns, int(phases.order[0])))
    same = np.flatnonzero(alike(phases, used))
    near = phases.chosen(same)
    relative = phases.turns[:, 1:] - phases.turns[:, :1]
    apart: list[list[tuple[int, float]]] = []
    for row, channel in enumerate(channels[1:], 1):
        least = ROUNDING_PHASE + phases.slip[[0, row]].max()
        each, relative[same, row - 1] = steps_of(relative[same, row - 1], near.cycle, least)
        apart.append(each)
        for k, turns in each:
            found.append(Step(channel, channels[0], float(near.start[k]), turns, int(phases.order[row])))
    return _attributed(channels, found, phases, float(np.median(np.diff(phases.start)))), relative


def _attributed(channels: Sequence[str], found: list[Step], phases: Phases, length: float) -> list[Step]:
    """Return steps of the first channel alone as its own ones, not as those of all others or of all together."""
    together = [step for step in found if not step.other]
    result = [step for step in found if step.other]
    for step in together:
        near = [other for other in result if abs(other.time - step.time) <= 2.0 * length]
        if len(channels) > 1 and len({other.channel for other in near}) == len(channels) - 1:
            result = [other for other in result if other not in near]
            turns = -float(np.mean([other.turns for other in near]))
            result.append(Step(channels[0], channels[1], near[0].time, turns, int(phases.order[0])))
        elif not near:
            result.append(replace(step, channel="" if len(channels) > 1 else channels[0]))
    return sorted(result, key=lambda step: step.time)


def drifts(phases: Phases, relative: np.ndarray, bias: float) -> Iterator[Drift]:
    """Return the significant drifts of phases relative to the first channel (windows, channels − 1).

    The deviations from a constant are expanded in orthonormal polynomials: order 1 is the drift, orders from 3 on
    measure noise that may be slow. What changes of amplitudes explain is none, nor is a rest of a transient.
    """
    count = len(relative)
    orders = min(max(count // 4, FEWEST_ORDERS), MOST_ORDERS, count - 3)
    if count < FEWEST_WINDOWS:
        return
    middle = phases.cycle - phases.cycle.mean()
    scaled = middle / np.abs(middle).max()
    basis = np.linalg.qr(np.polynomial.legendre.legvander(scaled, orders + 2))[0].T
    growth = np.abs(basis[1] @ phases.sizes)
    limit = float(student.isf(0.5 * DRIFT_FALSE_ALARM / relative.shape[1], orders)) if relative.shape[1] else np.inf
    long = float(np.ptp(phases.cycle)) * count / (count - 1)
    for row in range(1, len(phases.order)):
        component = basis @ relative[:, row - 1]
        noise = float(np.sqrt(np.mean(component[3:] ** 2)))
        rate = float(component[1] / (basis[1] @ middle))
        angle = 2.0 * np.pi * phases.order[row] * abs(component[1])
        transient = bias > ALLOWED_BIAS and abs(component[2]) > CURVED * abs(component[1]) + limit * noise
        if abs(component[1]) <= limit * noise or transient or angle <= BY_AMPLITUDE * growth[[0, row]].max():
            continue
        if abs(rate) * long > ROUNDING_PHASE + phases.slip[[0, row]].max():
            yield Drift(row, rate, noise / abs(float(basis[1] @ middle)), rate * long)


def clock_drifts(phases: Phases, relative: np.ndarray, used: np.ndarray, bias: float) -> list[Drift]:
    """Return the drifts over the windows used, or over all of their amplitude if most of these are not used."""
    same = alike(phases, used)
    found = [*drifts(phases.chosen(used), relative[used], bias)]
    if not found and 2 * np.count_nonzero(used) < np.count_nonzero(same):
        found = [*drifts(phases.chosen(same), relative[same], 0.0)]
    return found


def step_findings(found: list[Step], rates: dict[str, float], frequency: float, windows: int) -> Iterator[Finding]:
    """Return the findings of steps, one for each channel; `rates` are the sampling rates [Hz]."""
    for channel, other in dict.fromkeys((step.channel, step.other) for step in found):
        mine = [step for step in found if (step.channel, step.other) == (channel, other)]
        at = np.array([[step.time, step.time] for step in mine])
        if other:
            worst = max(2.0 * np.pi * step.order * abs(step.turns) for step in mine)
            severity = RUINOUS if worst > RUINOUS_BIAS else SERIOUS
            text = "; ".join(_relative(step, rates, frequency) for step in mine[:3])
            cure = (
                "which delay is right is unknown: correct the times, or fold a part without a step, "
                "recording.between(start, stop)"
            )
        else:
            severity, largest = SERIOUS, max(mine, key=lambda step: abs(step.turns))
            delay = largest.turns / frequency
            samples = abs(delay) * (rates[channel] if channel else max(rates.values()))
            text = (
                f"the phase of {channel or 'all channels'} steps by {360.0 * largest.turns:.3g}° ({delay:.3g} s, "
                f"{samples:.3g} samples) at about {largest.time:.6g} s: samples were lost, or the clock or the drive "
                "stepped"
            )
            cure = "fold the parts before and after it: recording.between(start, stop)"
        text += f" ({len(mine)} steps)" if len(mine) > 1 else ""
        yield Finding("phase step", channel, severity, at, len(mine), len(mine) / windows, np.nan, text, cure)


def _relative(step: Step, rates: dict[str, float], frequency: float) -> str:
    """Return what a step of one channel relative to another one is."""
    delay = -step.turns / frequency
    loser, sooner = (step.channel, "earlier") if delay < 0.0 else (step.other, "later")
    return (
        f"{step.channel} is {sooner} by {abs(delay):.3g} s ({360.0 * abs(step.turns):.3g}°) against {step.other} from "
        f"about {step.time:.6g} s on, as after {abs(delay) * rates[loser]:.3g} lost samples of {loser}"
    )


def drift_findings(
    found: list[Drift], channels: Sequence[str], phases: Phases, span: tuple[float, float], cycles: int, total: int
) -> Iterator[Finding]:
    """Return the findings of drifts of phases."""
    for drift in found:
        channel, angle = channels[drift.row], 360.0 * drift.turns
        ppm, se, above = 1e6 * abs(drift.rate), 1e6 * drift.se, "above" if drift.rate > 0.0 else "below"
        severity = RUINOUS if np.pi * phases.order[drift.row] * abs(drift.turns) > RUINOUS_BIAS else SERIOUS
        yield Finding(
            CLOCK, channel, severity, np.array([span]), cycles, 1.0, np.nan,
            f"the phase of {channel} drifts steadily against {channels[0]}, by {angle:.3g}° over the cycles used "
            f"({cycles} of {total}), as if its frequency were {ppm:.4g} ± {se:.2g} ppm {above}: two clocks, or a "
            "system that changes",
            f"fold(clocks={{'second': [{channel!r}]}}) or fold(clocks='auto') folds each clock at its own frequency; "
            "with one clock, select a shorter part with recording.between",
        )  # fmt: skip
