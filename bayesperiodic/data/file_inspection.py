"""What is in a file of measurements, and the call that reads it."""

import collections
import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic._io import Result, Storable
from bayesperiodic._printing import printable
from bayesperiodic.data.formats import header_units, recognise
from bayesperiodic.data.formats.contents import Clock, Contents, StoredChannel, unique_names
from bayesperiodic.data.recording import Recording
from bayesperiodic.data.times import dates
from bayesperiodic.data.units import in_si, is_known, kind_of, question

# Channels that are printed, and that the suggested call names.
MOST_PRINTED, MOST_SUGGESTED = 60, 6
# Words of phases that are positive where the response is late.
LAGS = ("lag", "nacheil")
# Kinds of units of frequencies and angles, and derived SI units, which are not divided into those of the base.
KIND_OF_HERTZ, KIND_OF_ANGLE, DERIVED = "1 / s", "rad", ("N", "Nm", "V", "A", "Pa", "J", "W", "ohm")


@dataclass(frozen=True)
class FileChannel(Storable):
    r"""A channel of a file.

    Attributes
    ----------
    group, name, unit : str
        As in the file; empty without.
    samples : int
    rate : float
        Mean sampling rate [Hz]; NaN if the file does not say it.
    first, last : float
        Times of the first and last sample [s] from the file's origin; NaN if the file does not say it.
    low, high : float
        Range in the file's unit, without missing samples; NaN for texts and for what cannot be read.
    remarks : tuple of str
        What a user would not guess.
    refused : bool
        Whether the channel cannot be read, or not without `sampling_rate` for its times; the last remark says why.

    Examples
    --------
    >>> import pathlib, tempfile, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
    >>> _ = path.write_text("t [s];x [mm]\n0,0;1,5\n0,1;1,7\n0,2;1,6\n")
    >>> channel = bp.inspect(path).channels[1]
    >>> channel.name, channel.unit, channel.samples, channel.low, channel.high
    ('x [mm]', 'mm', 3, 1.5, 1.7)
    """

    group: str
    name: str
    unit: str
    samples: int
    rate: float
    first: float
    last: float
    low: float
    high: float
    remarks: tuple[str, ...] = ()
    refused: bool = False


@dataclass(frozen=True, repr=False)
class FileInspection(Result):
    r"""Channels of a file, remarks, and the call that reads it, from `inspect`.

    Attributes
    ----------
    path, kind : str
    channels : tuple of FileChannel
    remarks : tuple of str
        On the whole file.
    code : str
        A call of `Recording.from_file`, in which inputs and outputs are still to be told apart; of `response_table` if
        there are frequencies and no times.

    Examples
    --------
    >>> import pathlib, tempfile, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
    >>> _ = path.write_text("t [s];x [mm]\n0,0;1,5\n0,1;1,7\n0,2;1,6\n")
    >>> seen = bp.inspect(path)
    >>> seen.kind, [channel.name for channel in seen.channels]
    ('CSV file', ['t [s]', 'x [mm]'])
    """

    path: str
    kind: str
    channels: tuple[FileChannel, ...]
    remarks: tuple[str, ...]
    code: str

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [
            ("group", "channel", "unit", "samples", "rate [Hz]", "first [s]", "last [s]", "range", "")
        ]
        listed: dict[str, int] = {remark: k for k, remark in enumerate(self.remarks, 1)}
        for channel in self.channels[:MOST_PRINTED]:
            notes = ", ".join(str(listed.setdefault(remark, len(listed) + 1)) for remark in channel.remarks)
            spread = "" if np.isnan(channel.low) else f"{channel.low:.6g} to {channel.high:.6g}"
            numbers = (_number(value) for value in (channel.rate, channel.first, channel.last))
            mark = f"{'refused ' if channel.refused else ''}{f'({notes})' if notes else ''}"
            rows.append((channel.group, channel.name, channel.unit, str(channel.samples), *numbers, spread, mark))
        keep = [k for k in range(9) if k in (1, 3) or any(row[k] for row in rows[1:])]
        widths = [max(len(row[k]) for row in rows) for k in keep]
        lines = [f"{self.kind} {self.path!r}, {len(self.channels)} channels", ""]
        for row in rows:
            cells = (
                row[k].rjust(w) if k in (3, 4, 5, 6) else row[k].ljust(w) for k, w in zip(keep, widths, strict=True)
            )
            lines.append("  ".join(cells).rstrip())
        if len(self.channels) > MOST_PRINTED:
            lines.append(f"… and {len(self.channels) - MOST_PRINTED} more")
        if listed:
            lines += ["", *(f"({k}) {remark}" for remark, k in listed.items())]
        return printable("\n".join([*lines, "", self.code]))

    __repr__ = __str__


def inspect(
    path: str | Path,
    *,
    format: str | None = None,
    encoding: str | None = None,
    separator: str | None = None,
    decimal: str | None = None,
    thousands: str | None = None,
    header: int | None = None,
    date_format: str | None = None,
) -> FileInspection:
    """Return what is in a file of measurements: channels, units, rates, ranges, remarks, and the call that reads it.

    Parameters
    ----------
    path : path
    format, encoding, separator, decimal, thousands, header, date_format
        As for `Recording.from_file`, where they are not recognised.

    Returns
    -------
    FileInspection

    Raises
    ------
    FileNotFoundError, ImportError, ValueError
        As for `Recording.from_file`.

    Examples
    --------
    >>> import pathlib, tempfile, numpy as np, scipy.io.wavfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.wav"
    >>> scipy.io.wavfile.write(path, 8000, np.arange(-100, 100, dtype="int16"))
    >>> seen = bp.inspect(path)
    >>> seen.channels[0].rate, seen.channels[0].samples, seen.channels[0].unit
    (8000.0, 200, '')
    """
    options = {
        "encoding": encoding,
        "separator": separator,
        "decimal": decimal,
        "thousands": thousands,
        "header": header,
        "date_format": date_format,
    }
    whole = _with_times(recognise.contents(path, format, (), options))
    channels = tuple(_summary(channel) for channel in whole.channels)
    given = {key: value for key, value in {"format": format, **options}.items() if value is not None}
    return FileInspection(str(path), whole.kind, channels, whole.remarks, _code(path, whole, channels, given))


def _summary(channel: StoredChannel) -> FileChannel:
    """Return a channel with its range and its times."""
    remarks, low, high, refused = [*channel.remarks], np.nan, np.nan, bool(channel.refusal)
    if channel.refusal:
        remarks.append(channel.refusal)
    else:
        try:
            low, high, note = _range(channel.values())
        except ValueError as error:
            note, refused = str(error), True
        remarks += [note] if note else []
    if hint := question(channel.unit):
        remarks.append(f"units= must say what {channel.unit!r} is: {hint}")
    rate, first, last = np.nan, np.nan, np.nan
    if clock := channel.clock:
        remarks += clock.remarks
        if clock.refusal:
            remarks.append(f"times are refused: {clock.refusal}")
            refused = True
        elif channel.samples:
            try:
                rate, first, last = _times(clock, channel.samples)
            except ValueError as error:
                remarks.append(str(error))
                refused = True
            if clock.error:
                remarks.append(
                    f"the interval has few digits: rate {rate:.9g} Hz with an error of up to "
                    f"{1e6 * clock.error / clock.step:.2g} ppm; sampling_rate= overrides it"
                )
    return FileChannel(
        channel.group,
        channel.name,
        channel.unit,
        channel.samples,
        rate,
        first,
        last,
        low,
        high,
        tuple(remarks),
        refused,
    )


def _times(clock: Clock, samples: int) -> tuple[float, float, float]:
    """Return mean rate, first and last time."""
    if clock.stored is None:
        return 1.0 / clock.step, clock.start, clock.start + (samples - 1) * clock.step
    times = np.asarray(clock.stored(), dtype=float)
    length = float(times[-1] - times[0])
    return (times.size - 1) / length if length > 0.0 else np.nan, float(times[0]), float(times[-1])


def _range(values: Any) -> tuple[float, float, str]:
    """Return the range of the values of a channel, and a remark on them."""
    array = np.squeeze(np.asarray(values))
    if (times := dates("values", array) if array.dtype.kind in "OUTmM" else None) is not None:
        ends = [times.flat[0], times.flat[-1]]
        if times.dtype.kind == "m":
            return (
                np.nan,
                np.nan,
                "durations from {:.9g} to {:.9g} s".format(*(one / np.timedelta64(1, "s") for one in ends)),
            )
        return np.nan, np.nan, f"dates from {ends[0]} to {ends[1]}"
    if array.dtype.kind not in "fiub":
        return np.nan, np.nan, "texts, or not only numbers" if array.dtype.kind in "OUT" else f"of type {array.dtype}"
    if array.ndim > 1:
        how = "load it and give its rows or columns to Recording.from_arrays"
        return np.nan, np.nan, f"no column, but an array of shape {array.shape}; {how}"
    finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    lost = array.size - finite.size
    note = f"{lost} of {array.size} values are missing; missing='drop' leaves them out" if lost else ""
    return (float(finite.min()), float(finite.max()), note) if finite.size else (np.nan, np.nan, note)


def as_recording(
    path: str | Path,
    *,
    time: str | None = None,
    sampling_rate: float | None = None,
    format: str | None = None,
    **options: Any,
) -> Recording:
    """Return all usable channels of a file as outputs, without missing samples; the options are those of `inspect`.

    Units that `units` would have to decide are left as they are, because no fault depends on them.
    """
    whole = recognise.contents(path, format, (), options)
    whole = _with_times(whole) if time is None and sampling_rate is None else replace(whole, suggested_time=time or "")
    usable, units = _usable(whole, tuple(map(_summary, whole.channels))), dict[str, Any]()
    usable = {key: column for key, column in usable.items() if _known_values(whole.find(str(path), column)) > 1}
    stored = {key: whole.find(str(path), column).unit for key, column in usable.items()}
    units = {key: 1.0 for key, unit in stored.items() if unit.endswith("?") or question(unit)}
    if whole.suggested_time:
        units |= _unused_units(whole, {"time": whole.suggested_time})
    return Recording.from_file(
        path, outputs=usable, time=whole.suggested_time or None, sampling_rate=sampling_rate, units=units,
        format=format, missing="drop", **options,
    )  # fmt: skip


def _known_values(channel: StoredChannel) -> int:
    """Return the number of values that are not missing."""
    return int(np.count_nonzero(~np.isnan(np.asarray(channel.values(), dtype=float))))


def _with_times(whole: Contents) -> Contents:
    """Return contents with the channel that seems to hold the times by its name, where nothing else says them."""
    if whole.suggested_time or any(channel.clock for channel in whole.channels):
        return whole
    names = collections.Counter(channel.name for channel in whole.channels)
    for channel in whole.channels:
        named = names[channel.name] == 1 and header_units.TIMES_NAME.fullmatch(channel.name)
        if named and not channel.refusal and channel.samples > 1:
            values = np.squeeze(np.asarray(channel.values()))
            if values.dtype.kind in "fiu" and values.ndim == 1 and (np.diff(values.astype(float)) > 0).all():
                return replace(whole, suggested_time=channel.name)
    return whole


def _unused_units(whole: Contents, columns: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the units that names of columns say and that are not used, with the SI unit, by the keys of columns."""
    result = {}
    for key, column in columns.items():
        stored = whole.find("", column)
        said = stored.unit[:-1] if stored.unit.endswith("?") else header_units.unused(stored.name, stored.unit)
        if said and is_known(said) and not question(said) and (target := _target(said)) != said:
            result[key] = (said, target)
    return result


def _target(unit: str) -> str:
    """Return the SI unit of a unit; units of frequencies stay, because Hz and rad/s differ by a factor."""
    if unit in DERIVED or kind_of(unit) == KIND_OF_HERTZ:
        return unit
    return unit[1:] if unit[1:] in DERIVED else in_si(unit).replace(" ", "")


def _usable(whole: Contents, channels: tuple[FileChannel, ...]) -> dict[str, Any]:
    """Return the channels of numbers, except that of the times, by names that channels of a model may have."""
    usable = [one for one in channels if not np.isnan(one.low) and one.name != whole.suggested_time]
    names = [channel.name for channel in channels]
    result: dict[str, Any] = {}
    for name, channel in zip(unique_names(_identifier(one.name) for one in usable), usable, strict=True):
        key = re.sub(r"[^0-9A-Za-z_]+", "_", name).strip("_")
        while key in result:
            key += "_"
        result[key] = channel.name if names.count(channel.name) == 1 else (channel.group, channel.name)
    return result


def _code(path: str | Path, whole: Contents, channels: tuple[FileChannel, ...], options: dict[str, Any]) -> str:
    """Return a call that reads the usable channels."""
    usable, timed = _usable(whole, channels), bool(whole.suggested_time)
    if not timed and not options and (table := _table_code(path, usable, channels)):
        return table
    pairs = [f"{name!r}: {key!r}" for name, key in usable.items()]
    shown = ", ".join(pairs[:MOST_SUGGESTED])
    arguments = [repr(str(path)), f"inputs={{}}, outputs={{{shown}}}"]
    if timed:
        arguments.append(f"time={whole.suggested_time!r}")
    elif any(np.isnan(one.rate) and not np.isnan(one.low) for one in channels):
        arguments.append("sampling_rate=…")
    listed = dict([*usable.items()][:MOST_SUGGESTED]) | ({"time": whole.suggested_time} if timed else {})
    if units := _unused_units(whole, listed):
        arguments.append(f"units={units}")
    arguments += [f"{key}={value!r}" for key, value in options.items()]
    more = f"  # and {len(pairs) - MOST_SUGGESTED} more" if len(pairs) > MOST_SUGGESTED else ""
    return f"recording = bp.Recording.from_file({', '.join(arguments)}){more}"


def _table_code(path: str | Path, usable: Mapping[str, Any], channels: tuple[FileChannel, ...]) -> str:
    """Return a call that reads a table of responses: frequencies, amplitudes and perhaps phases; "" for other files."""
    kinds = {channel.name: kind_of(channel.unit) for channel in channels}
    kinds = {key: kinds.get(column, "") for key, column in usable.items()}
    frequencies, phases = (
        [key for key, kind in kinds.items() if kind == one] for one in (KIND_OF_HERTZ, KIND_OF_ANGLE)
    )
    outputs = [key for key in kinds if key not in frequencies + phases]
    clocked = any(not np.isnan(channel.rate) for channel in channels)
    if clocked or len(frequencies) != 1 or not outputs or len(phases) > len(outputs):
        return ""
    arguments = [repr(str(path)), f"frequency={usable[frequencies[0]]!r}"]
    arguments.append(f"outputs={ {key: usable[key] for key in outputs} }".replace("{ ", "{").replace(" }", "}"))
    if phases:
        pairs = {output: usable[phase] for output, phase in zip(outputs, phases, strict=False)}
        arguments.append(f"phases={pairs}")
        if any(word in str(column).lower() for column in pairs.values() for word in LAGS):
            arguments.append("lag=True")
    return f"runs = bp.response_table({', '.join(arguments)}, inputs={{…: …}})"


def _identifier(name: str) -> str:
    """Return a name of a channel of a model, which is a Python identifier."""
    word = re.sub(r"\W+", "_", re.sub(r"[\[(].*?[\])]", "", name)).strip("_").lower() or "x"
    return f"x{word}" if word[0].isdigit() else f"{word}_" if keyword.iskeyword(word) else word


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.9g}"
