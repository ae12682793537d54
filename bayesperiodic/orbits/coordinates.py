"""The coordinates of a section: their names, delays, checks, and values."""

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.recording import Recording
from bayesperiodic.orbits.integrals import HALF_WINDOW, LARGEST_DRIFT, PHASES, View, high_passed, integrated, lines_of
from bayesperiodic.orbits.stretches import LONGEST_USUAL_STEP, SMALLEST_WINDOW, Stretches, smoothed, usual_step

DEGREES = 180.0 / np.pi
# Fraction of the returns that are shorter than the one with which windows and delays are compared.
SHORT_RETURN = 0.01
# A delayed coordinate: a channel, and in brackets the time after the instant of the section, in forcing periods or, for
# crossings, in seconds, with the unit s.
DELAYED = re.compile(r"(.*)\[([^\[\]]*?)( ?s)?\]", re.DOTALL)
# The integral of a channel over time.
INTEGRATED = re.compile(r"integral\((.*)\)", re.DOTALL)
# The time since the channel crossed the level of the section before.
INTERVAL = re.compile(r"interval\((.*)\)", re.DOTALL)


def channel_and_delay(coordinate: str) -> tuple[str, float]:
    """Return the channel of a coordinate and its delay, in forcing periods or in seconds, as its section has it."""
    match = DELAYED.fullmatch(coordinate)
    return (match[1], float(match[2])) if match else (crossed_of(coordinate) or coordinate, 0.0)


def crossed_of(coordinate: str) -> str | None:
    """Return the channel between whose crossings this coordinate is the time, or None."""
    match = INTERVAL.fullmatch(coordinate)
    return match[1] if match else None


def integrand_of(channel: str) -> str | None:
    """Return the channel of which this one is the integral, or None."""
    match = INTEGRATED.fullmatch(channel)
    return match[1] if match else None


def is_output(coordinate: str) -> bool:
    """Return whether a coordinate is neither delayed nor an integral or interval."""
    return not any(form.fullmatch(coordinate) for form in (DELAYED, INTEGRATED, INTERVAL))


def channels_of(coordinates: Sequence[str]) -> tuple[str, ...]:
    """Return the channels of coordinates, each once."""
    return tuple(dict.fromkeys(channel_and_delay(name)[0] for name in coordinates))


def columns_of(names: Sequence[str]) -> np.ndarray:
    """Return the position of each coordinate's channel among the channels."""
    channels = channels_of(names)
    return np.array([channels.index(channel_and_delay(name)[0]) for name in names])


def delays_of(names: Sequence[str]) -> np.ndarray:
    """Return the delay of each coordinate in forcing periods or in seconds."""
    return np.array([channel_and_delay(name)[1] for name in names])


def longest_window(names: Sequence[str], samples: float, steps: int = 1) -> float:
    """Return the shortest distance of two values of a channel, at this step or others, as a fraction of a step.

    `samples` is their number a period. Raises a ValueError if windows of the fewest samples overlap.
    """
    columns, delays = columns_of(names), delays_of(names)
    places = [np.sort(steps * delays[columns == column] % 1.0) for column in np.unique(columns)]
    shortest = min(float(np.diff(one, append=one[0] + 1.0).min()) for one in places)
    if shortest * samples < 2 * SMALLEST_WINDOW * steps * (1.0 - 1e-9):
        modulo, more = ("a period", "") if steps == 1 else (f"1/{steps} of a period", ", or another number of steps")
        raise ValueError(
            f"coordinates: must have values of a channel at least {2 * SMALLEST_WINDOW} samples apart modulo {modulo}, "
            f"got {shortest * samples / steps:.2g} for {list(names)}. Otherwise they share their noise: choose other "
            f"delays{more}."
        )
    return shortest


def longest_window_of_crossings(names: Sequence[str], channel: str, rate: float, returns: np.ndarray) -> float:
    """Return the shortest time [s] between two values of a channel, at this crossing and the next one.

    The names are those of the coordinates, the rate is that of the samples, and the times between the crossings of the
    channel are `returns` [s]. Raises a ValueError if windows of the fewest samples overlap.
    """
    every = (channel, *(name for name in names if not crossed_of(name)))
    columns, delays = columns_of(every), delays_of(every)
    until_next, least = float(np.quantile(returns, SHORT_RETURN)), 2 * SMALLEST_WINDOW / rate
    places = [np.sort(delays[columns == column]) for column in np.unique(columns)]
    shortest = min(float(np.diff(one, append=one[0] + until_next).min()) for one in places)
    if shortest < least * (1.0 - 1e-9):
        raise ValueError(
            f"coordinates: must have values of a channel {least:.3g} s ({2 * SMALLEST_WINDOW} samples) apart or more, "
            f"and so long before the first one of the next crossing, {until_next:.3g} s later, got {shortest:.2g} s "
            f"for {list(every)}. Otherwise they share their noise: choose other delays."
        )
    return shortest


def coordinate_values(
    samples: Stretches, names: Sequence[str], instants: np.ndarray, stretch: np.ndarray, unit: float, longest: float,
    drifts: Mapping[str, float],
) -> tuple[np.ndarray, np.ndarray | None]:  # fmt: skip
    """Return the coordinates (instants, d) at given instants, and the standard deviation (d,) of their errors.

    The unit of delays and the longest window are in seconds. `drifts` are the errors of integrated channels.
    """
    values, noise = np.empty((instants.size, len(names))), np.empty(len(names))
    delays, columns = delays_of(names), columns_of(names)
    first, last = samples.time[samples.starts[stretch]], samples.time[samples.stops[stretch] - 1]
    for delay in np.unique(delays):
        here = delays == delay
        part = samples._replace(signals=samples.signals[:, columns[here]])
        at = np.clip(instants + delay * unit, first, last)
        values[:, here], noise[here] = smoothed(part, at, stretch, longest)
    noise = np.hypot(noise, [drifts.get(channel_and_delay(name)[0], 0.0) for name in names])
    return values, None if np.isnan(noise).any() else noise


def with_integrals(
    samples: Stretches, names: Sequence[str], origin: float, frequency: float, longest: float
) -> tuple[Stretches, dict[str, float]]:
    """Return samples with the integrals of channels in their columns, and the standard deviations of their errors."""
    channels, period = channels_of(names), 1.0 / frequency
    columns = {name: k for k, name in enumerate(channels) if integrand_of(name)}
    measured = [name for name in names if channel_and_delay(name)[0] not in columns]
    summed = [channel_and_delay(name) for name in names if name not in measured]
    of_sums = [delay for _, delay in summed]
    delays = np.array([0.0, *delays_of(measured), *np.add.outer(of_sums, [-HALF_WINDOW, HALF_WINDOW]).ravel()])
    part = samples._replace(signals=samples.signals[:, [channels.index(name) for name in channels_of(measured)]])
    views: dict[str, list[View]] = {name: [] for name in columns}
    for phase in range(PHASES):
        at, stretch, _ = samples.instants(frequency, origin + phase * period / PHASES, (delays.min(), delays.max()))
        known = [high_passed(samples, columns[name], at + d * period, stretch, period)[1] for name, d in summed]
        if measured:
            known += [*coordinate_values(part, measured, at, stretch, period, longest, {})[0].T]
        for name, k in columns.items():
            whole = high_passed(samples, k, at, stretch, period)[0]
            views[name].append(View(at, stretch, whole, np.stack(known, axis=1)))
    lines = {name: lines_of(samples, k, views[name]) for name, k in columns.items()}
    for name, k in columns.items():
        samples = integrated(samples, k, lines[name])
        error = lines[name].sd / float(np.std(samples.signals[:, k]))
        if not error < LARGEST_DRIFT:
            raise ValueError(
                f"coordinates: must determine the drift of {name!r}, got errors of {error:.0%} of the standard "
                "deviation. Add a delayed coordinate, or record with less drift and noise or in longer pieces."
            )
    return samples, {name: one.sd for name, one in lines.items()}


def coordinate_names(
    coordinates: Sequence[str], angles: Iterable[str], *, forced: bool = True
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of coordinates and of those that are angles; raise a ValueError unless they are valid."""
    unit, example = ("forcing periods", "-0.25") if forced else ("seconds with the unit", "-0.25 s")
    given = [coordinates] if isinstance(coordinates, str) else list(_checks.several("coordinates", coordinates))
    names, delayed = [], set()
    for name in given:
        match = DELAYED.fullmatch(name) if isinstance(name, str) else None
        if match is None:
            names.append(name if not isinstance(name, str) else integrand_of(name) or crossed_of(name) or name)
            continue
        try:
            _checks.finite_number("delay", float(match[2] if (match[3] is None) == forced else ""))
        except ValueError:
            raise ValueError(
                f"coordinates: must have a number in brackets, the delay in {unit}, such as "
                f"{match[1] + f'[{example}]'!r}, got {name!r}."
            ) from None
        names.append(integrand_of(match[1]) or match[1])
        delayed.add(match[1])
    _checks.identifiers("coordinates", dict.fromkeys(names))
    if len(names) < (2 if forced else 1):
        raise ValueError(f"coordinates: must be {'two' if forced else 'one'} or more outputs, got {coordinates!r}.")
    if len(set(given)) < len(given):
        raise ValueError(f"coordinates: must differ, got {given!r}.")
    angle_names = (angles,) if isinstance(angles, str) else _checks.several("angles", angles)
    for name in angle_names:
        _checks.one_of("angles", name, given)
    if len(angle_names) > 1:
        raise ValueError(f"angles: must name at most one coordinate, got {angle_names!r}.")
    if forced and any(map(crossed_of, given)):
        raise ValueError(f"coordinates: must have intervals for crossings only, got {given!r}. Use delayed ones.")
    if not forced and any(integrand_of(channel_and_delay(name)[0]) for name in given):
        raise ValueError(f"coordinates: must have no integrals for crossings, got {given!r}. Use delayed coordinates.")
    if any(map(crossed_of, angle_names)):
        raise ValueError(f"angles: must be coordinates that are no intervals, got {angle_names!r}.")
    if any(integrand_of(channel_and_delay(name)[0]) in angle_names for name in given):
        raise ValueError(f"coordinates: must have no integral of an angle, got {given!r}. Integrate another channel.")
    if any(channel_and_delay(name)[0] in delayed for name in angle_names):
        raise ValueError(f"coordinates: must have no delays of an angle, got {given!r}. Delay another channel.")
    return tuple(given), angle_names


def coordinate_signals(
    recording: Recording, coordinates: Sequence[str], angles: Iterable[str], *, forced: bool = True
) -> tuple[tuple[str, ...], tuple[str, ...], np.ndarray]:
    """Return the names of the coordinates and of their angles, and values (samples, channels), angles unwrapped."""
    names, angle_names = coordinate_names(coordinates, angles, forced=forced)
    channels = channels_of(names)
    measured = [integrand_of(name) or name for name in channels]
    for name in measured:
        _checks.one_of("coordinates", name, recording.outputs)
    if isinstance(recording.time, Mapping):
        raise ValueError(
            f"recording: must have the same times for all channels, got {recording!r}; leave other channels out, or "
            "record the coordinates together."
        )
    signals = np.stack([recording.outputs[name] for name in measured], -1)
    for name in angle_names:
        k = channels.index(name)
        _check_angle(name, signals[:, k])
        signals[:, k] = np.unwrap(signals[:, k])
        for other in range(len(channels)):
            if other != k:
                _check_rate(name, channels[other], recording.time, signals[:, k], signals[:, other])
    return names, angle_names, signals


def given_recordings(recordings: Iterable[Recording]) -> list[Recording]:
    """Return recordings as a list; raise a ValueError unless they are some."""
    if isinstance(recordings, Recording) or not isinstance(recordings, Iterable):
        raise ValueError(
            f"recordings: must be a list of recordings, got {type(recordings).__name__}; from_recording takes one."
        )
    given = list(recordings)
    if not given:
        raise ValueError("recordings: must be one or more, got none.")
    for k, recording in enumerate(given):
        _checks.instance(f"recordings[{k}]", recording, Recording)
    return given


def other_channels(
    recordings: Sequence[Recording], coordinates: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the channels of all recordings that are none of the coordinates, inputs last, and the inputs."""
    outputs, inputs = (
        tuple(c for c in getattr(recordings[0], kind) if all(c in getattr(one, kind) for one in recordings))
        for kind in ("outputs", "inputs")
    )
    return tuple(c for c in (*outputs, *inputs) if c not in channels_of(coordinates)), inputs


def with_others(recording: Recording, signals: np.ndarray, others: Sequence[str]) -> np.ndarray:
    """Return signals (samples, channels) with those of other channels in further columns."""
    every = {**recording.outputs, **recording.inputs}
    return np.column_stack([signals, *(every[name] for name in others)])


def unwrapped(samples: Stretches, turning: np.ndarray) -> Stretches:
    """Return signals whose angles are continuous where recordings are joined."""
    signals = samples.signals.copy()
    for channel in np.flatnonzero(turning):
        signals[:, channel] = np.unwrap(signals[:, channel])
    return samples._replace(signals=signals)


def _check_angle(name: str, values: np.ndarray) -> None:
    """Raise a ValueError for an angle that jumps by other than 2π, or moves half a turn between samples."""
    step = np.abs(np.diff(values))
    smooth, largest, extent = float(np.quantile(step, 0.9)), float(step.max()), float(np.ptp(values))
    jumps = largest > 0.75 * extent and largest > 4.0 * smooth
    if jumps and abs(extent / 360.0 - 1.0) < 0.1:
        raise ValueError(
            f"outputs[{name!r}]: must be an angle in radians, got jumps of {largest:.4g}. It seems to be in degrees: "
            "convert it with numpy.radians."
        )
    if jumps and largest > 1.0 and abs(extent / (2.0 * np.pi) - 1.0) > 0.1:
        raise ValueError(
            f"outputs[{name!r}]: must be an angle that is continuous or jumps by a turn (6.283 rad), got jumps of "
            f"{largest:.4g}. Check the unit, and whether the angle covers half a turn only (arctan instead of arctan2)."
        )
    if np.quantile(np.abs(wrapped(np.diff(values))), 0.9) > 0.75 * np.pi or smooth > 2.0 * np.pi:
        raise ValueError(
            f"outputs[{name!r}]: must move by less than half a turn (3.14 rad) between samples, got steps of "
            f"{smooth:.4g}. Convert degrees with numpy.radians, or sample faster."
        )


def _check_rate(name: str, other: str, time: np.ndarray, angle: np.ndarray, rate: np.ndarray) -> None:
    """Raise a ValueError if the other coordinate is the rate of the unwrapped angle in another unit."""
    step = np.diff(time)
    short = step <= LONGEST_USUAL_STEP * usual_step(time)
    measured = np.diff(angle)[short]
    expected = (0.5 * (rate[1:] + rate[:-1]) * step)[short]
    scale, product = np.sqrt(np.sum(measured**2) * np.sum(expected**2)), np.sum(measured * expected)
    if scale == 0.0 or product < 0.98 * scale:
        return
    ratio = product / np.sum(expected**2)
    for factor, quantity in ((DEGREES, "angle"), (1.0 / DEGREES, "rate")):
        if abs(ratio / factor - 1.0) < 0.1:
            raise ValueError(
                f"outputs[{name!r}]: must be the integral of {other!r}, got {ratio:.3g} times it; the {quantity} seems "
                "to be in degrees. Use radians and radians per second."
            )


def wrapped(values: np.ndarray, turning: np.ndarray | bool = True) -> np.ndarray:
    """Return values (…, coordinates), with those that are turning angles in (−π, π]."""
    return np.where(turning, np.pi - (np.pi - values) % (2.0 * np.pi), values)
