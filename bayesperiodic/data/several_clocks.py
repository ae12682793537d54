"""Channels of several clocks: their times on that of the first one, by the frequencies that each clock measures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.inspection import Inspection, inspect
from bayesperiodic.data.signals import Signals

# One clock, as is stated, or as many as the phases of the channels show.
ONE, AUTO = "one", "auto"
# Standard errors by which frequencies of one clock may differ.
SAME_CLOCK = 4.0

Clocks = str | Mapping[str, Sequence[str]]


def inspect_clocks(
    groups: list[Signals], clocks: Clocks | None, periods: int, frequency: float | None, points: int, asked: int = 0
) -> tuple[Inspection, dict[str, tuple[str, ...]]]:
    """Return what signals are like on the first clock, and the channels of the other clocks.

    The frequency is that of the first clock, of the channels that are not named, or of the clock with the first channel
    if all are named. Times of the others are multiplied by the ratio of the frequencies that both clocks measure.
    """
    channels = [channel for group in groups for channel in group.channels]
    if clocks is None or isinstance(clocks, str):
        _checks.one_of("clocks", clocks or ONE, (ONE, AUTO))
        seen = inspect(groups, periods, frequency, points, asked=asked)
        others = _found(seen) if clocks == AUTO else {}
        if not others:
            return seen, {}
    else:
        others = _given(clocks, channels)
    first = [channel for channel in channels if all(channel not in named for named in others.values())]
    rate = None if frequency is None else frequency / periods
    if rate is None:
        rate = _frequency(inspect(_only(groups, first), periods, None, points))
    scale = dict.fromkeys(channels, 1.0)
    for named in others.values():
        measured = _frequency(inspect(_only(groups, named), periods, rate * periods, points))
        scale |= dict.fromkeys(named, measured / rate)
    scaled = []
    for group in groups:
        for factor in dict.fromkeys(scale[channel] for channel in group.channels):
            part = _only([group], [channel for channel in group.channels if scale[channel] == factor])
            scaled += [replace(one, time=one.time * factor) for one in part]
    other = [channel for named in others.values() for channel in named]
    return inspect(scaled, periods, frequency, points, other, asked), others


def _given(clocks: Mapping[str, Sequence[str]], channels: list[str]) -> dict[str, tuple[str, ...]]:
    """Return the channels of clocks other than the first, from all that were named."""
    _checks.mapping("clocks", clocks, "{'second': ['x']}")
    others = {}
    for name, named in clocks.items():
        several = (named,) if isinstance(named, str) else _checks.several(f"clocks[{name!r}]", named)
        others[_checks.text("clocks", name)] = several
        for channel in others[name]:
            _checks.one_of(f"clocks[{name!r}]", channel, channels)
    every = [channel for named in others.values() for channel in named]
    if repeated := [channel for channel in channels if every.count(channel) > 1]:
        raise ValueError(f"clocks: must name each channel once, got {repeated[0]!r} {every.count(repeated[0])} times.")
    if len(every) == len(channels):
        others = {name: named for name, named in others.items() if channels[0] not in named}
    return others


def _found(seen: Inspection) -> dict[str, tuple[str, ...]]:
    """Return the channels whose frequencies differ from that of the first one, by clock."""
    clocks: list[list[str]] = []
    rates: list[tuple[float, float]] = []
    for drift in [drift for drift in seen.drifts if drift.steady]:
        same = (i for i, (r, se) in enumerate(rates) if abs(drift.rate - r) <= SAME_CLOCK * np.hypot(drift.se, se))
        number = next(same, len(clocks))
        if number == len(clocks):
            clocks.append([])
            rates.append((drift.rate, drift.se))
        clocks[number].append(seen.channels[drift.row])
    return {f"clock {i}": tuple(named) for i, named in enumerate(clocks, 2)}


def _only(groups: Iterable[Signals], channels: Sequence[str]) -> list[Signals]:
    """Return the groups with some of their channels."""
    result = []
    for group in groups:
        rows = [i for i, channel in enumerate(group.channels) if channel in channels]
        if rows:
            names, inputs = tuple(group.channels[i] for i in rows), sum(i < group.inputs for i in rows)
            result.append(replace(group, channels=names, values=group.values[rows], inputs=inputs))
    return result


def _frequency(seen: Inspection) -> float:
    if seen.fit is None:
        raise ValueError(seen.reason)
    return seen.fit.frequency
