"""Clocks of the channels, by their phases relative to the first one: steps, as of lost samples, and steady drifts."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from bayesperiodic.data.cycle_findings import HARMLESS_PHASE, stepped
from bayesperiodic.data.recording_check import RUINOUS, RUINOUS_BIAS, SERIOUS, Finding
from bayesperiodic.data.steadiness import SMALL_RANGE, Windows

# Windows on each side of a step, shortest and as a share of all, and the size of a step in robust standard deviations.
SHORTEST_SIDE, SIDES, SIGNIFICANT_STEP = 3, 20, 8.0
# Size of a step in standard deviations of what remains beside it: a transient is curved.
SHARP = 5.0
# Sides on which a step outside of the steady part is compared with the usual differences, as a transient beats, and by
# how much it must exceed these where it has such a side alone.
NEIGHBOURS, SIDE_ALONE = 4, 4.0
# Windows that may be missing at a step, and most steps that are searched for.
MISSING_WINDOWS, MOST_PHASE_STEPS = 4, 50
# Windows, like those of the steady part in amplitude: largest distance in robust standard deviations.
ALIKE = 6.0
# Phase [cycles] that does not count for any purpose.
ROUNDING_PHASE = 1e-4
# False-alarm rate of a drift over all channels, fewest windows, and orders of polynomials that measure the noise.
DRIFT_FALSE_ALARM, FEWEST_WINDOWS, FEWEST_ORDERS, MOST_ORDERS = 1e-4, 10, 4, 16
# Drift of the phase [rad] that a relative change of amplitudes explains, and up to which it is harmless then; curvature
# of a clock's drift.
TURN_BY_AMPLITUDE, HARMLESS_TURN, CURVED = 2.0, 0.05, 0.1
# Quantile of the differences of means that are no steps although there may be many, and that of a normal distribution.
FEW, FEW_TO_SD, MEDIAN_TO_SD = 0.15, 0.189, 1.4826
# Least part of a drift that changes of the drive's frequency leave.
LEAST_DETERMINED = 0.1
# Difference of two clocks [ppm], ten times that of usual quartzes, from which on the response may be free of the drive.
LARGEST_OF_CLOCKS = 1000.0
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
class PhaseStep:
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
    steady: bool  # as that of a clock, and not of a transient or a system whose amplitudes change


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


def steps_of(
    series: np.ndarray, cycle: np.ndarray, least: float, steady: np.ndarray | None = None
) -> list[tuple[int, float]]:
    """Return the steps of a series of phases [cycles]: windows in which they are, and sizes.

    A straight line and a step are fitted to as many windows before and after each window, which may contain the step;
    the step is compared with those elsewhere, and outside of the `steady` windows (bool) also with those near it.
    Slopes, slow curves and beats, as of a transient, are no steps.
    """
    rest, listed = series.copy(), list[tuple[int, float]]()
    if series.size < FEWEST_WINDOWS:
        return listed
    length, next_ones = float(np.median(np.diff(cycle))), np.diff(series)
    white = MEDIAN_TO_SD / np.sqrt(2.0) * float(np.median(np.abs(next_ones - np.median(next_ones))))
    few = max(1.0, (SIDES / series.size) ** 2)
    while len(listed) < MOST_PHASE_STEPS:
        best = (1.0, 0, 0.0, 0.0)
        side = SHORTEST_SIDE
        while 2 * side + 1 <= rest.size and (side == SHORTEST_SIDE or side * SIDES <= rest.size):
            number = np.arange(-side, side + 1.0)
            design = np.column_stack([np.ones(number.size), number, np.sign(number)])[number != 0.0]
            beside = np.delete(np.lib.stride_tricks.sliding_window_view(rest, number.size), side, axis=1)
            inverse = np.linalg.pinv(design)
            fitted = beside @ inverse.T
            jump, size_of_one = 2.0 * fitted[:, 2], 2.0 * float(np.linalg.norm(inverse[2]))
            curved = np.sqrt(np.sum((beside - fitted @ design.T) ** 2, axis=1) / (2 * side - design.shape[1]))
            usual = float(np.quantile(np.abs(jump), FEW)) / FEW_TO_SD
            usual = np.maximum(max(usual, white * size_of_one), _usual_nearby(jump, side, steady))
            near = cycle[2 * side :] - cycle[: -2 * side] <= (2 * side + MISSING_WINDOWS) * length
            limit = np.maximum(np.maximum(SIGNIFICANT_STEP * few * usual, least), SHARP * curved)
            score = np.where(near, np.abs(jump) / limit, 0.0)
            k = int(np.argmax(score))
            if score[k] > best[0]:
                best = (float(score[k]), k + side, float(jump[k]), float(fitted[k, 0]))
            side *= 2
        _, k, size, middle = best
        if not size:
            break
        listed.append((k, size))
        rest[k] = middle - 0.5 * size
        rest[k + 1 :] -= size
    return listed


def _usual_nearby(jump: np.ndarray, side: int, steady: np.ndarray | None) -> np.ndarray:
    """Return the usual steps near each window outside of the steady ones, zero for these.

    It is the larger one of those before and after it: both are small beside lost samples, and the earlier ones large
    in a transient. Without windows on a side, where the transient may be, it is several times that of the other one.
    """
    usual = np.zeros(jump.size)
    for k in [] if steady is None else np.flatnonzero(~steady[side:-side]):
        parts = jump[max(k - NEIGHBOURS * side, 0) : max(k - side, 0)], jump[k + side + 1 :][: NEIGHBOURS * side]
        each = [float(np.median(np.abs(part))) for part in parts if part.size]
        usual[k] = MEDIAN_TO_SD * (max(each) if len(each) == 2 else SIDE_ALONE * sum(each))
    return usual


def steps(channels: Sequence[str], phases: Phases, used: np.ndarray) -> tuple[list[PhaseStep], list[np.ndarray]]:
    """Return the steps of phases, and the windows of each channel but the first in which its relative phase steps.

    Steps of one channel relative to the others count wherever the amplitudes are those of the windows used, unless the
    phase changes as much nearby, as in a transient; steps of all together only where they are used.
    """
    listed: list[PhaseStep] = []
    inside = phases.chosen(used)
    least = HARMLESS_PHASE + inside.slip.max()
    for k, turns in steps_of(inside.turns[:, 0], inside.cycle, least):
        listed.append(PhaseStep("", "", float(inside.start[k]), turns, int(phases.order[0])))
    same = np.flatnonzero(alike(phases, used))
    near = phases.chosen(same)
    places = []
    for row, channel in enumerate(channels[1:], 1):
        least = ROUNDING_PHASE + phases.slip[[0, row]].max()
        each = steps_of(near.turns[:, row] - near.turns[:, 0], near.cycle, least, used[same])
        places.append(same[[k for k, _ in each]])
        for k, turns in each:
            listed.append(PhaseStep(channel, channels[0], float(near.start[k]), turns, int(phases.order[row])))
    return _attributed(channels, listed, float(np.median(np.diff(phases.start))), int(phases.order[0])), places


def _attributed(channels: Sequence[str], listed: list[PhaseStep], length: float, order: int) -> list[PhaseStep]:
    """Return steps of the first channel alone as its own ones, not as those of all others or of all together."""
    together = [step for step in listed if not step.other]
    result = [step for step in listed if step.other]
    for step in together:
        near = [other for other in result if abs(other.time - step.time) <= 2.0 * length]
        if len(channels) > 1 and len({other.channel for other in near}) == len(channels) - 1:
            result = [other for other in result if other not in near]
            turns = -float(np.mean([other.turns for other in near]))
            result.append(PhaseStep(channels[0], channels[1], near[0].time, turns, order))
        elif not near:
            result.append(replace(step, channel="" if len(channels) > 1 else channels[0]))
    return sorted(result, key=lambda step: step.time)


def drifts(phases: Phases, used: np.ndarray, steps: Sequence[np.ndarray]) -> Iterator[Drift]:
    """Return the significant drifts of phases relative to the first channel in the windows used.

    The deviations from a constant, which may step and follow the frequency of the first channel, are expanded in
    orthonormal polynomials: order 1 is the drift, orders from 3 on measure noise that may be slow.
    """
    level = DRIFT_FALSE_ALARM / max(len(steps), 1)
    for row, places in enumerate(steps, 1):
        numbers = np.setdiff1d(np.flatnonzero(used), places)
        if numbers.size < FEWEST_WINDOWS:
            continue
        middle = phases.cycle[numbers] - phases.cycle[numbers].mean()
        others = _others(phases, numbers, middle, places)
        orders = min(max(numbers.size // 4, FEWEST_ORDERS), MOST_ORDERS, numbers.size - 2 - others.shape[1])
        if orders < FEWEST_ORDERS:
            continue
        polynomials = np.polynomial.legendre.legvander(middle / np.abs(middle).max(), orders + 2)[:, 1:]
        basis = np.linalg.qr(np.column_stack([others, polynomials]))[0].T[others.shape[1] - 1 :]
        component = basis @ (phases.turns[numbers, row] - phases.turns[numbers, 0])
        noise, size = _noise(phases, numbers, row, basis[3:], component[3:]), abs(float(component[1]))
        limit = -float(stdtrit(orders, 0.5 * level)) * noise
        per_cycle = float(basis[1] @ middle)
        if abs(per_cycle) < LEAST_DETERMINED * float(np.linalg.norm(middle)):
            continue  # the drive drifts likewise
        turns = float(component[1]) / per_cycle * float(np.ptp(middle)) * numbers.size / (numbers.size - 1)
        if size <= limit or abs(turns) <= ROUNDING_PHASE + phases.slip[[0, row]].max():
            continue
        growth = float(np.abs(basis[1] @ phases.sizes[numbers][:, [0, row]]).max())
        by_amplitude = 2.0 * np.pi * phases.order[row] * size <= TURN_BY_AMPLITUDE * growth
        if by_amplitude and 2.0 * np.pi * phases.order[row] * abs(turns) < HARMLESS_TURN:
            continue
        steady = not by_amplitude and abs(component[2]) <= CURVED * size + limit
        yield Drift(row, float(component[1]) / per_cycle, noise / abs(per_cycle), turns, steady)


def _noise(phases: Phases, numbers: np.ndarray, row: int, basis: np.ndarray, component: np.ndarray) -> float:
    """Return the standard deviation of components of a relative phase [cycles], not below that by the amplitudes.

    White noise turns a line as much as it changes its size; a few phases can be alike by chance.
    """
    both = [0, row]
    sizes = basis @ phases.sizes[numbers][:, both] / (2.0 * np.pi * phases.order[both])
    return float(np.sqrt(max(np.mean(component**2), np.mean(np.sum(sizes**2, axis=1)))))


def _others(phases: Phases, numbers: np.ndarray, middle: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return a constant, steps, and the frequency of the first channel in the windows with these numbers, (windows, …).

    A response follows the frequency of its drive by its delay.
    """
    jumps = numbers[:, None] > places
    jumps = jumps[:, jumps.any(axis=0) & ~jumps.all(axis=0)]
    scaled = middle / np.abs(middle).max()
    series = np.polynomial.legendre.legfit(scaled, phases.turns[numbers, 0], min(MOST_ORDERS, numbers.size // 4))
    rate = np.polynomial.legendre.legval(scaled, np.polynomial.legendre.legder(series))
    rate -= rate.mean()
    varies = [rate / np.abs(rate).max()] if np.abs(rate).max() > ROUNDING_PHASE else []
    return np.column_stack([np.ones(numbers.size), jumps, *varies])


def clock_drifts(phases: Phases, used: np.ndarray, steps: Sequence[np.ndarray]) -> list[Drift]:
    """Return the drifts over the windows used, or over all of their amplitude if most of these are not used."""
    same = alike(phases, used)
    listed = [*drifts(phases, used, steps)]
    if not listed and 2 * np.count_nonzero(used) < np.count_nonzero(same):
        listed = [drift for drift in drifts(phases, same, steps) if drift.steady]
    return listed


def step_findings(
    listed: list[PhaseStep], rates: dict[str, float], frequency: float, windows: int
) -> Iterator[Finding]:
    """Return the findings of steps, one for each channel; `rates` are the sampling rates [Hz]."""
    for channel, other in dict.fromkeys((step.channel, step.other) for step in listed):
        mine = [step for step in listed if (step.channel, step.other) == (channel, other)]
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
            rate = rates[channel] if channel else max(rates.values())
            text = stepped(channel, largest.turns, largest.time, rate, frequency)
            cure = "fold the parts before and after it: recording.between(start, stop)"
        text += f" ({len(mine)} steps)" if len(mine) > 1 else ""
        yield Finding("phase step", channel, severity, at, len(mine), len(mine) / windows, np.nan, text, cure)


def _relative(step: PhaseStep, rates: dict[str, float], frequency: float) -> str:
    """Return what a step of one channel relative to another one is."""
    delay = -step.turns / frequency
    loser, sooner = (step.channel, "earlier") if delay < 0.0 else (step.other, "later")
    return (
        f"{step.channel} is {sooner} by {abs(delay):.3g} s ({360.0 * abs(step.turns):.3g}°, up to whole cycles) "
        f"against {step.other} from about {step.time:.6g} s on, as after {abs(delay) * rates[loser]:.3g} lost samples "
        f"of {loser}"
    )


def drift_findings(
    listed: list[Drift], channels: Sequence[str], span: tuple[float, float], cycles: int, total: int
) -> Iterator[Finding]:
    """Return the findings of drifts of phases."""
    for drift in listed:
        channel, angle = channels[drift.row], 360.0 * drift.turns
        if not drift.steady:
            yield Finding(
                "drift", channel, SERIOUS, np.array([span]), cycles, 1.0, np.nan,
                f"the phase of {channel} against {channels[0]} changes by {angle:.3g}° over the cycles used ({cycles} "
                f"of {total}), but not steadily: a transient, or a drive or a system that changes",
                "record longer, or select a steadier part with recording.between(start, stop)",
            )  # fmt: skip
            continue
        ppm, se, above = 1e6 * abs(drift.rate), 1e6 * drift.se, "above" if drift.rate > 0.0 else "below"
        free = ppm > LARGEST_OF_CLOCKS
        # Of two clocks, a drift that is found biases the mean phase by eight of its standard errors or more.
        yield Finding(
            CLOCK, channel, RUINOUS, np.array([span]), cycles, 1.0, np.nan,
            f"the phase of {channel} drifts steadily against {channels[0]}, by {angle:.3g}° over the cycles used "
            f"({cycles} of {total}), as if its frequency were {ppm:.4g} ± {se:.2g} ppm {above}: two clocks, or a "
            "system that changes" + ", or a response that does not follow the drive, such as a chaotic one" * free,
            f"fold(clocks={{'second': [{channel!r}]}}) or fold(clocks='auto') folds each clock at its own frequency; "
            "if there was one clock, say so by fold(clocks='one'), or select a shorter part with recording.between"
            + "; a chaotic response is not folded: bp.PoincareSection and bp.find_orbits" * free,
        )  # fmt: skip
