"""Meaning of the channels of a file, and missing samples of files and arrays."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.formats.contents import Clock, Contents, Key, StoredChannel
from bayesperiodic.data.times import between, dates, seconds
from bayesperiodic.data.units import Units, from_file, is_duration, unit_of

DROP, INTERPOLATE = "drop", "interpolate"
# Successive samples that may be interpolated.
LONGEST_INTERPOLATION = 3

Times = np.ndarray | dict[str, np.ndarray]
Rate = float | Mapping[str, float] | None


@dataclass(frozen=True)
class Layout:
    """Meaning of the channels of a file, with the arguments of `Recording.from_file`."""

    file: str  # its name, for messages
    outputs: Mapping[str, Key]
    inputs: Mapping[str, Key]
    time: Key | None
    sampling_rate: Rate
    units: Units
    missing: str | None

    def __post_init__(self) -> None:
        example = "{'force': 'the column of the force'}"
        for kind in ("outputs", "inputs"):
            _checks.mapping(kind, getattr(self, kind), example)
        if not self.outputs:
            raise ValueError("outputs: must have at least one channel, got none.")
        if self.time is not None and self.sampling_rate is not None:
            raise ValueError(
                f"time: must be given or sampling_rate, and not both, got {self.time!r} and {self.sampling_rate!r}."
            )
        for key in self.units:
            _checks.one_of("units", key, ("time", *self.sources))
        if "time" in self.units and "time" in self.sources:
            raise ValueError(
                "units: must be those of the times by the name 'time', got a channel of this name too; rename it."
            )
        if isinstance(self.sampling_rate, Mapping):
            for key in self.sampling_rate:
                _checks.one_of("sampling_rate", key, self.sources)

    @property
    def sources(self) -> dict[str, Key]:
        """Keys in the file by channel."""
        return {**self.outputs, **self.inputs}

    @property
    def wanted(self) -> list[Key]:
        """Keys that are read, each once."""
        return [*dict.fromkeys([*([self.time] if self.time is not None else []), *self.sources.values()])]


def recordings(cls: Any, layout: Layout, contents: Contents, split: Key | None, name: str) -> Any:
    """Return the recording in a file; with `split`, one for each part in which this channel is constant."""
    given = None if layout.time is None else _time_column(layout, contents)
    columns = {channel: _Column.of(layout, contents, key) for channel, key in layout.sources.items()}
    times = _times(layout, contents, columns) if given is None else given
    every = {key: unit_of(layout.units.get(key), column.stored.unit) for key, column in columns.items()}
    units = {key: unit for key, unit in every.items() if unit}
    if split is None:
        return cls(*_signals(layout, columns, times), name, units=units)
    label = _label(layout, contents, split, columns, times)
    edges = [0, *(np.flatnonzero(label[1:] != label[:-1]) + 1).tolist(), label.size]
    return [
        cls(
            *_signals(
                layout,
                {key: column.part(first, last) for key, column in columns.items()},
                times[first:last] if isinstance(times, np.ndarray) else {k: t[first:last] for k, t in times.items()},
            ),
            f"{name} {i}: {split} {label[first]}",
            units=units,
        )
        for i, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True), 1)
    ]


@dataclass(frozen=True, eq=False)
class _Column:
    """Values of a channel of a file that were read."""

    stored: StoredChannel
    values: np.ndarray

    @classmethod
    def of(cls, layout: Layout, contents: Contents, key: Key, *, text: bool = False, time: bool = False) -> "_Column":
        stored = contents.find(layout.file, key)
        argument = f"{contents.word} {stored.label!r} of {layout.file}"
        if stored.refusal:
            raise ValueError(f"{argument}: must be usable, got {stored.refusal}.")
        return cls(stored, numbers(argument, stored.values(), text=text, time=time))

    def part(self, first: int, last: int) -> "_Column":
        return _Column(self.stored, self.values[first:last])


def numbers(argument: str, values: Any, *, text: bool = False, time: bool = False) -> np.ndarray:
    """Return values of a file as numbers; of times also as dates, and integers as they are."""
    array = np.asarray(values)
    array = array if array.ndim == 1 else np.squeeze(array)
    time = time and not text
    if time and (times := dates(argument, array)) is not None:
        array = times
    if array.dtype == object and not text:
        import pandas as pd

        cells = np.atleast_1d(array)
        if not any(isinstance(cell, str | bytes) for cell in cells.flat):
            try:  # Decimal, and Python's numbers among missing ones
                return np.array([np.nan if pd.isna(cell) else float(cell) for cell in cells])
            except (TypeError, ValueError):
                pass
        rows = np.flatnonzero(pd.isna(pd.to_numeric(cells, errors="coerce")) & pd.notna(cells))
        got = f"{cells[rows[0]]!r} in data row {rows[0] + 1}" if rows.size else f"{cells[0]!r}"
        hint = "; dates must be those of ISO 8601, give date_format= for others in a text" if time else ""
        raise ValueError(f"{argument}: must contain numbers, with a decimal point, got {got}{hint}.")
    if array.ndim != 1 or (array.dtype.kind not in ("fiubmM" if time else "fiub") and not text):
        raise ValueError(
            f"{argument}: must be one column of real numbers, got shape {np.shape(values)} and type {array.dtype}."
        )
    if array.dtype == float and array.base is None:  # as it was just read, a recording need not copy it
        array.flags.writeable = False
    return array if text or time else array.astype(float, copy=False)


def _label(layout: Layout, contents: Contents, split: Key, columns: Mapping[str, _Column], times: Times) -> np.ndarray:
    """Return the column that distinguishes records, which has one value per sample."""
    label = _Column.of(layout, contents, split, text=True).values
    import pandas as pd

    if any(lost := pd.isna(label).tolist()):
        row = lost.index(True) + 1
        raise ValueError(f"split: must be a column without empty cells, got {split!r}, empty in data row {row}.")
    sizes = {column.stored.label: column.values.size for column in columns.values()}
    if isinstance(times, np.ndarray) and layout.time is not None:
        sizes = {str(layout.time): times.size} | sizes
    for column, size in sizes.items():
        if size != label.size:
            raise ValueError(
                f"split: must be a column with one value per sample, got {split!r} with {label.size} values and "
                f"{column!r} with {size}."
            )
    return label


def _times(layout: Layout, contents: Contents, columns: Mapping[str, _Column]) -> Times:
    """Return the times of all channels [s] that are no channel: one array, or one for each if they differ."""
    clocks = {channel: column.stored.clock for channel, column in columns.items()}
    rates = (
        layout.sampling_rate
        if isinstance(layout.sampling_rate, Mapping)
        else dict.fromkeys(columns, layout.sampling_rate)
    )
    distinct = {id(clock) for clock in clocks.values() if clock}
    if isinstance(layout.sampling_rate, int | float | np.number) and len(distinct) > 1:
        different = {(clock.start, clock.step, clock.stored) for clock in clocks.values() if clock}
        if len(different) > 1:
            raise ValueError(
                f"sampling_rate: must be given by channel, as the channels of {layout.file} have times of their own, "
                f"got {layout.sampling_rate!r}; such as {{{next(iter(columns))!r}: {layout.sampling_rate!r}}}."
            )
    offsets = _offsets(layout, clocks)
    times, known = {}, {}
    for channel, column in columns.items():
        clock, rate = clocks[channel], rates.get(channel)
        key = (id(clock), column.values.size, rate, offsets[channel])
        if key not in known:
            known[key] = _clocked(layout, contents, column, rate)
            if offsets[channel]:
                known[key] = known[key] + offsets[channel]
        times[channel] = known[key]
    if len(known) == 1:
        return next(iter(known.values()))
    by_channel = isinstance(layout.sampling_rate, Mapping)
    if not (by_channel or any(clocks.values())):  # one rate, different lengths: refused by `Recording`
        return max(known.values(), key=len)
    return times


def _time_column(layout: Layout, contents: Contents) -> np.ndarray:
    """Return the channel of times of a file in seconds, from the first one if they are dates or durations."""
    column = _Column.of(layout, contents, layout.time, time=True)  # type: ignore[arg-type]
    named = column.stored.label
    if column.values.dtype.kind in "mM" and "time" in layout.units:
        raise ValueError(
            f"units['time']: must be left out for a column of dates or durations, which is converted to seconds, "
            f"got {layout.units['time']!r} for column {named!r} of {layout.file}."
        )
    argument = f"time (column {named!r} of {layout.file})"
    stored = "" if column.values.dtype.kind in "mM" else column.stored.unit
    given = "time" in layout.units or bool(stored)
    time = _checks.real_array(argument, seconds(argument, column.values, unit=given))
    return in_seconds(argument, time, layout.units.get("time"), stored)


def in_seconds(argument: str, time: np.ndarray, unit: Any, stored: str) -> np.ndarray:
    """Return times in seconds; raise a ValueError if the unit of the file or of the user is none of time."""
    if isinstance(unit, str) and unit != "s":
        raise ValueError(
            f"units['time']: must be a factor or a pair such as ('ms', 's'), as times are in s, got {unit!r}."
        )
    pair = (
        [unit]
        if isinstance(unit, str)
        else []
        if unit is None or isinstance(unit, int | float | np.number)
        else [*unit]
    )
    if (stored.strip() and not pair and unit is None and not is_duration(stored)) or not all(map(is_duration, pair)):
        raise ValueError(
            f"{argument}: must be in a unit of time, got {(*pair, stored) if pair else stored!r}; give the column of "
            "times, or units={'time': …} as a factor."
        )
    return from_file("time", time, unit, stored)


def _offsets(layout: Layout, clocks: Mapping[str, Clock | None]) -> dict[str, float]:
    """Return the time [s] of each channel's origin after the earliest one."""
    origins = {channel: clock.origin for channel, clock in clocks.items() if clock and clock.origin is not None}
    if not origins:
        return dict.fromkeys(clocks, 0.0)
    without = [channel for channel in clocks if channel not in origins]
    if without:
        raise ValueError(
            f"time: must be counted from one instant for all channels of {layout.file}, got dates for "
            f"{[*origins]} and none for {without}; read them separately, and join them by Recording.join if they "
            "started together."
        )
    first = min(origins.values())
    return {channel: between(origin, first) for channel, origin in origins.items()}


def _clocked(layout: Layout, contents: Contents, column: _Column, rate: float | None) -> np.ndarray:
    """Return the times of a channel by a given rate, or as the file has them."""
    clock, size = column.stored.clock, column.values.size
    if rate is not None:
        start = clock.start if clock else 0.0
        return start + np.arange(size) / _checks.positive("sampling_rate", rate)
    if clock is None:
        raise ValueError(
            f"time: must be given or sampling_rate, and not both, got None and None; {layout.file} does not say when "
            f"{contents.word} {column.stored.label!r} was sampled."
        )
    if clock.refusal:
        raise ValueError(
            f"time: must be known, got {contents.word} {column.stored.label!r} of {layout.file}, {clock.refusal}."
        )
    if clock.error:
        warnings.warn(
            f"sampling_rate: {layout.file} gives the interval of {contents.word} {column.stored.label!r} with few "
            f"digits, so that its rate is {1.0 / clock.step:.9g} Hz with an error of up to "
            f"{1e6 * clock.error / clock.step:.2g} ppm; {rounded_rate(clock)}give sampling_rate= if you know it.",
            stacklevel=5,
        )
    return clock.times(size)


def rounded_rate(clock: Clock) -> str:
    """Return the words that name a round rate [Hz] within the error of the step, if there is one."""
    low, high = 1.0 / (clock.step + clock.error), 1.0 / (clock.step - clock.error)
    for digits in range(1, 7):
        rate = float(f"{1.0 / clock.step:.{digits - 1}e}")
        if low <= rate <= high:
            return f"{rate:.9g} Hz has the same digits; "
    return ""


def _signals(
    layout: Layout, columns: Mapping[str, _Column], times: Times
) -> tuple[Times, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return times, outputs and inputs, without missing samples and in the units asked for."""

    def label(key: str, column: str) -> str:
        return f"{key} (column {column!r} of {layout.file})"

    named = str(layout.time) if layout.time is not None else "\0"
    at = label("time", named)
    labels = {label(key, column.stored.label): key for key, column in columns.items()}
    given = {argument: columns[key].values for argument, key in labels.items()}
    each: Any = {argument: times[key] for argument, key in labels.items()} if isinstance(times, dict) else times
    kept, present = without_missing(at, each, given, layout.missing)
    timed: Times
    if isinstance(kept, dict):
        timed = {labels[argument]: _checks.measured(at, time) for argument, time in kept.items()}
    else:
        timed = _checks.measured(at, kept)
    values = {
        key: from_file(
            key, _checks.measured(argument, present[argument]), layout.units.get(key), columns[key].stored.unit
        )
        for argument, key in labels.items()
    }
    return timed, {key: values[key] for key in layout.outputs}, {key: values[key] for key in layout.inputs}


def without_missing(
    argument: str, time: Any, channels: Mapping[str, np.ndarray], missing: str | None
) -> tuple[Times, dict[str, np.ndarray]]:
    """Return times and values of channels without NaN, by default refused; the times by channel if they differ.

    `time` is an array, or a mapping with the keys of `channels`.
    """
    if missing is not None:
        _checks.one_of("missing", missing, (DROP, INTERPOLATE))
    times = (
        {f"{argument}[{key!r}]": values for key, values in time.items()} if isinstance(time, dict) else {argument: time}
    )
    for name, values in {**times, **channels}.items():
        if missing is None and values.ndim == 1 and values.size and np.isnan(values.min()):
            lost = np.flatnonzero(np.isnan(values))
            raise ValueError(
                f"{name}: must be finite, got nan at index {lost[0]} ({lost.size} of {values.size} values are NaN "
                f"or masked); missing={DROP!r} leaves such samples out, missing={INTERPOLATE!r} fills in single values."
            )
    each = time if isinstance(time, dict) else dict.fromkeys(channels, time)
    if missing is None or any(each[key].shape != values.shape for key, values in channels.items()):
        return time, dict(channels)  # shapes are checked by `Recording`
    if missing == INTERPOLATE:
        channels = {key: _interpolated(key, each[key], values) for key, values in channels.items()}
    keep = {key: ~(np.isnan(each[key]) | np.isnan(values)) for key, values in channels.items()}
    if missing == INTERPOLATE and not isinstance(time, dict):  # of the ends, in all channels
        keep = dict.fromkeys(keep, np.all([*keep.values()], axis=0))
    kept = {key: values[keep[key]] for key, values in channels.items()}
    first = next(iter(keep.values()), np.ones(np.shape(time), dtype=bool))
    if not isinstance(time, dict) and all(np.array_equal(first, mask) for mask in keep.values()):
        return time[first], kept
    return {key: each[key][keep[key]] for key in channels}, kept


def _interpolated(argument: str, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return an array with NaN between numbers replaced; those at the ends remain."""
    known = np.flatnonzero(~np.isnan(values) & ~np.isnan(time))
    if (longest := int(np.max(np.diff(known), initial=1)) - 1) > LONGEST_INTERPOLATION:
        raise ValueError(
            f"missing: must be {DROP!r} for {argument}, got {INTERPOLATE!r}, which fills in at most "
            f"{LONGEST_INTERPOLATION} successive values, and {longest} are missing."
        )
    return np.interp(time, time[known], values[known], left=np.nan, right=np.nan) if known.size else values
