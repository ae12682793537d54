"""Groups of channels with times of their own: common windows, and one frequency for all of them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesperiodic.data.harmonics import (
    MINIMUM_CYCLES,
    HarmonicFit,
    Pace,
    cycle_scores,
    fit_harmonics,
    next_step,
    normal_equation,
    pace_of,
)
from bayesperiodic.data.signals import Signals, cycles_of
from bayesperiodic.data.steadiness import Windows, windows

# Gauss-Newton steps of a frequency.
STEPS = 20


@dataclass(frozen=True)
class Windowed:
    """Windows of all channels together, and their samples in each group."""

    all: Windows  # samples are those of the first group
    groups: list[Windows]

    def samples(self, part: Windows) -> list[slice]:
        """Return the samples of each group in a part of the windows."""
        ends = np.searchsorted(self.all.place, part.place[[0, -1]])
        return [slice(int(group.first[ends[0]]), int(group.last[ends[1]])) for group in self.groups]


def leading(groups: Sequence[Signals]) -> int:
    """Return the number of the first group with inputs, or of the first one if there are no inputs."""
    return next((i for i, group in enumerate(groups) if group.inputs), 0)


def common_span(groups: Sequence[Signals], frequency: float) -> list[slice]:
    """Return the samples of each group in the time that all have in common; raise a ValueError if it is too short."""
    if len(groups) == 1:
        return [slice(0, groups[0].time.size)]
    start, stop = max(group.time[0] for group in groups), min(group.time[-1] for group in groups)
    if (stop - start) * frequency < MINIMUM_CYCLES:
        spans = "; ".join(f"{', '.join(g.channels)}: {g.time[0]:g} to {g.time[-1]:g} s" for g in groups)
        raise ValueError(
            f"recording: must have at least {MINIMUM_CYCLES} cycles that all channels have in common, got "
            f"{groups[0].name!r} with {spans}; record at the same time, or correct the times."
        )
    return [within(group.time, np.array([start, stop])) for group in groups]


def within(time: np.ndarray, other: np.ndarray) -> slice:
    """Return the samples from the first to the last of other times."""
    return slice(*np.searchsorted(time, [other[0], np.nextafter(other[-1], np.inf)]).tolist())


def common_windows(groups: Sequence[Signals], frequency: float) -> Windowed:
    """Return the windows that all groups have in common, counted back from the ends of the groups."""
    cycles, length = min(cycles_of(group.time, frequency) for group in groups), 1
    while True:
        used = [group.time > group.time[-1] - cycles / frequency for group in groups]
        parts = [group if u.all() else group.part(u) for group, u in zip(groups, used, strict=True)]
        each = [windows(part.time, part.values, frequency, length) for part in parts]
        if len(groups) == 1:
            return Windowed(each[0], each)
        if len({(one.cycles, one.overlap) for one in each}) == 1:
            break
        # Slow sampling needs longer windows; else numbers of whole cycles are about a limit at which these begin.
        longest = max(one.cycles for one in each)
        cycles, length = (cycles, longest) if longest > length else (cycles - 1.0, length)
        if cycles < MINIMUM_CYCLES * length:
            raise ValueError(
                f"recording: must have samples of all channels in the same cycles, got {groups[0].name!r}, whose "
                f"channels have no common windows of {length} cycles; record longer, or fold them one by one."
            )
    first, numbers = each[0], []
    for i, (one, part, u) in enumerate(zip(each, parts, used, strict=True)):
        skipped = int(np.argmax(u))
        each[i] = replace(one, first=one.first + skipped, last=one.last + skipped)
        numbers.append(one.place - int(cycles_of(part.time, 1.0) / (one.cycles / one.overlap / frequency)))
    common = numbers[0]
    for others in numbers[1:]:
        common = np.intersect1d(common, others)
    each = [one.chosen(np.searchsorted(n, common).tolist()) for one, n in zip(each, numbers, strict=True)]
    harmonics = min(one.amplitudes.shape[2] for one in each)
    place = common - common[0] if common.size else common
    return Windowed(
        Windows(
            each[0].first, each[0].last, place, first.overlap, first.cycles,
            np.concatenate([one.amplitudes[:, :, :harmonics] for one in each], axis=1),
            np.concatenate([one.slip for one in each]),
            np.concatenate([one.jump for one in each]),
        ),
        each,
    )  # fmt: skip


@dataclass(frozen=True)
class CommonFit:
    """Fourier series of one frequency, fitted to groups of channels."""

    frequency: float
    each: list[HarmonicFit]

    @property
    def variances(self) -> np.ndarray:
        """Residual variance of each channel, (channels,)."""
        return np.concatenate([fit.variances for fit in self.each])


def fit_groups(groups: Iterable[Signals], frequency: float, harmonics: Iterable[int]) -> CommonFit:
    """Fit the harmonics of a frequency to groups of channels, each by least squares on its own samples."""
    pairs = zip(groups, harmonics, strict=True)
    return CommonFit(frequency, [fit_harmonics(g.time, g.values, frequency, highest) for g, highest in pairs])


def refine_groups(
    groups: Sequence[Signals], frequency: float, harmonics: Sequence[int], other: Iterable[str] = ()
) -> tuple[CommonFit, Pace]:
    """Return the fit at the least-squares frequency of all groups, and the uncertainty of that frequency.

    Gradients and information of the groups are added, without the channels of `other` clocks.
    """
    timed = [np.array([channel not in {*other} for channel in group.channels], dtype=float) for group in groups]
    duration = float(max(np.ptp(group.time) for group in groups))
    for _ in range(STEPS):
        terms = []
        for group, highest, counted in zip(groups, harmonics, timed, strict=True):
            terms.append(normal_equation(group.time, group.values, frequency, highest, counted))
        information = sum(term[-1] for term in terms)
        step = next_step(sum(term[-2] for term in terms), information, frequency, duration)
        if not step:
            break
        frequency += step
    fit = CommonFit(terms[0][0].frequency, [term[0] for term in terms])
    start = min(group.time[0] for group in groups)
    cycle = [np.floor((group.time - start) * fit.frequency).astype(int) for group in groups]
    count = max(int(number[-1]) for number in cycle) + 1
    scores = [
        cycle_scores(group.time, number, count, term[0], term[1], term[2])
        for group, number, term in zip(groups, cycle, terms, strict=True)
    ]
    score, quadrature = sum(each[0] for each in scores), sum(each[1] for each in scores)
    return fit, pace_of(np.asarray(score), np.asarray(quadrature), sum(each[2] for each in scores), information)
