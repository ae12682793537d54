"""Conversion of dates and durations to seconds."""

import datetime
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesperiodic import _checks

# Seconds in the units of NumPy's dates and durations, and the units in a second; all are exact as floats.
SECONDS = {"W": 604_800, "D": 86_400, "h": 3600, "m": 60, "s": 1}
PER_SECOND = {"ms": 1e3, "us": 1e6, "ns": 1e9, "ps": 1e12, "fs": 1e15, "as": 1e18}
# First year of which all dates have nanoseconds since 1970 in 64 bits, and the first year after the last one.
YEARS = (1678, 2262)
# Integers beyond this one are not all floats.
LARGEST_EXACT = 2**53
# Integers from which they are no seconds since 1970 (of the year 5138) but smaller units, with that unit.
SINCE_1970 = {"ms": 1e11, "us": 1e14, "ns": 1e17}
# Usual step [s] of integers from which they are no seconds but parts of them, unless they are whole minutes.
LONG_STEP, MINUTE = 1000, 60
ISO_DATE = re.compile(r"\s*\d{4}-\d\d")
# More decimals of a second than pandas keeps (3.0.1 drops the others without a word).
TOO_FINE = re.compile(r"[.,]\d{10}")


def dates(argument: str, values: Any) -> np.ndarray | None:
    """Return dates as an array of datetime64, durations as one of timedelta64; None for anything else.

    Dates are datetime64 arrays, objects of pandas or of Python's `datetime`, or texts after ISO 8601. Those with a time
    zone are converted to UTC, and those without are taken as UTC. Masked values are NaT. A ValueError is raised for
    texts or objects of which only some are dates.
    """
    if type(getattr(values, "dtype", None)).__name__ == "DatetimeTZDtype":  # of pandas; as an array it has objects
        import pandas as pd

        return np.asarray(pd.DatetimeIndex(values).tz_convert(None).to_numpy())
    array = np.asarray(values)
    masked = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else np.zeros(array.shape, bool)
    if array.dtype.kind in "mM":
        if masked.any():
            array = array.copy()
            array.view(np.int64)[masked] = np.iinfo(np.int64).min  # NaT of every unit
        return array
    if array.dtype.kind not in "OUT":
        return None
    import pandas as pd

    array = array.astype(object)
    array[masked] = None
    first = next((value for value in array.flat if pd.notna(value)), None)
    if isinstance(first, datetime.timedelta | np.timedelta64):
        return _read(argument, array, pd.to_timedelta)
    if isinstance(first, datetime.date | np.datetime64):
        return _read(argument, array, pd.to_datetime, utc=True)
    if isinstance(first, str) and ISO_DATE.match(first):
        if TOO_FINE.search(first):
            raise ValueError(
                f"{argument}: must have at most nine decimals of a second, got {first!r}; give seconds as numbers."
            )
        return _read(argument, array, pd.to_datetime, utc=True, format="ISO8601")
    return None


def seconds(argument: str, values: Any, *, unit: bool = False) -> Any:
    """Return dates and durations in seconds from the first of them that is not missing, NaT as NaN.

    Differences are those of integers, so that those below 2**53 units are the nearest floats. Integers that can hardly
    be seconds are refused, unless their `unit` is given; then those beyond 2**53 (as nanoseconds since 1970) are
    counted from the first one too, in their unit. Other values are returned as they are.
    """
    try:
        np.shape(values)
    except ValueError:  # lists of unequal length, which are refused as no real numbers
        return values
    times = dates(argument, values)
    if times is None:
        if not unit:
            _refuse_integers(argument, values)
        return _differences(values)
    base, step = np.datetime_data(times.dtype)
    if times.dtype.kind == "M" and base in ("Y", "M", "generic"):
        times, base, step = times.astype("datetime64[s]"), "s", 1
    if base not in SECONDS | PER_SECOND:
        raise ValueError(
            f"{argument}: must be durations in weeks or a shorter unit, got {times.dtype}, whose length in seconds is "
            "not defined."
        )
    lost = np.isnat(times)
    if lost.all():
        return np.full(times.shape, np.nan)
    steps = np.where(lost, 0, (times - times[~lost][0]).astype(np.int64)) * step
    return np.where(lost, np.nan, steps * float(SECONDS[base]) if base in SECONDS else steps / PER_SECOND[base])


def channel_seconds(times: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the times of channels in seconds; dates from the earliest one of all channels."""
    read = {channel: dates(f"time[{channel!r}]", values) for channel, values in times.items()}
    dated = {channel: values for channel, values in read.items() if values is not None}
    if dated and len(dated) < len(read):
        other = next(channel for channel in read if channel not in dated)
        raise ValueError(
            f"time: must be dates or durations of all channels, or numbers of all, got dates of {next(iter(dated))!r} "
            f"and numbers of {other!r}; convert them to seconds from one instant."
        )
    if not dated:
        for channel, values in times.items():
            _refuse_integers(f"time[{channel!r}]", values)
        return {channel: _checks.real_array(f"time[{channel!r}]", values) for channel, values in times.items()}
    kinds = {values.dtype.kind for values in dated.values()}
    if len(kinds) > 1:
        raise ValueError("time: must be dates of all channels or durations of all, got both; convert one kind of them.")
    result = {}
    for channel, values in dated.items():
        argument = f"time[{channel!r}]"
        result[channel] = np.atleast_1d(_checks.real_array(argument, seconds(argument, values)))
    firsts = {channel: _first(values) for channel, values in dated.items()}
    starts = (round(np.nanmin(result[name]) * 10**18) + first for name, first in firsts.items() if first is not None)
    earliest = min(starts, default=0)
    return {
        channel: result[channel] + (0.0 if first is None else (first - earliest) / 10**18)
        for channel, first in firsts.items()
    }


def nanoseconds(argument: str, date: Any) -> np.datetime64:
    """Return a date in nanoseconds; raise a ValueError if they do not reach it, where NumPy 2.4 returns another."""
    year = int(np.datetime64(date, "Y").astype(int)) + 1970
    if not YEARS[0] <= year < YEARS[1]:
        raise ValueError(f"{argument}: must be of the years from {YEARS[0]} to {YEARS[1] - 1}, got {date}.")
    return np.datetime64(date, "ns")


def between(later: np.datetime64, earlier: np.datetime64) -> float:
    """Return the time [s] between two dates in nanoseconds, which NumPy's difference is only up to 292 years."""
    return (int(later.astype(np.int64)) - int(earlier.astype(np.int64))) / 10**9


def _first(times: np.ndarray) -> int | None:
    """Return the first date that is not missing in attoseconds since 1970, or the first duration; None without one."""
    given = times[~np.isnat(times)] if times.ndim else times[None][~np.isnat(times[None])]
    if not given.size:
        return None
    if times.dtype.kind == "M" and np.datetime_data(times.dtype)[0] in ("Y", "M"):
        given = given.astype("datetime64[s]")
    base, step = np.datetime_data(given.dtype)
    unit = SECONDS[base] * 10**18 if base in SECONDS else 10**18 // int(PER_SECOND[base])
    return int(given[0].astype(np.int64)) * step * unit


def shared(times: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the times of channels, one array for those that have the same ones."""
    distinct: list[np.ndarray] = []
    result = {}
    for channel, time in times.items():
        same = (other for other in distinct if other is time or (other.size == time.size and (other == time).all()))
        result[channel] = next(same, time)
        if result[channel] is time and not any(time is other for other in distinct):
            distinct.append(time)
    return result


def _refuse_integers(argument: str, values: Any) -> None:
    """Raise a ValueError for integers that are milli-, micro- or nanoseconds by their size or their steps."""
    array = values.compressed() if isinstance(values, np.ma.MaskedArray) else np.asarray(values)
    if array.dtype.kind == "O" and not any(isinstance(one, float) and one == one for one in array.flat):
        # Python's integers, and others among which some are missing.
        array = np.array([one for one in array.flat if isinstance(one, int | np.integer)])
    if array.dtype.kind not in "iu" or array.ndim != 1 or array.size < 2:
        return
    first, steps = int(array[0]), np.abs(np.diff(array.astype(np.int64)))
    epoch = next((unit for unit, least in reversed(SINCE_1970.items()) if abs(first) >= least), "")
    step = float(np.median(steps))
    if not epoch and (step < LONG_STEP or not (steps % MINUTE).any()):
        return
    if epoch:
        guess, kind, unit = f"{first}, as {epoch} since 1970", "datetime64", epoch
    else:
        unit = "us" if step < PER_SECOND["us"] else "ns"
        guess, kind = f"integers in steps of {step:.6g}, as {unit}", "timedelta64"
    raise ValueError(
        f"{argument}: must be in seconds, got {guess}; give times.astype('{kind}[{unit}]') for these (of a file, "
        f"units={{'time': ({unit!r}, 's')}}), or floats if they are seconds."
    )


def _differences(values: Any) -> Any:
    """Return integers that are too large for floats as differences from the first one, other values as they are."""
    array = values if np.ma.isMaskedArray(values) else np.asarray(values)
    if array.dtype.kind not in "iu" or not array.size or max(-int(array.min()), int(array.max())) <= LARGEST_EXACT:
        return values
    return (array - array.flat[0]).astype(np.int64)


def _read(argument: str, array: np.ndarray, read: Any, **options: Any) -> np.ndarray:
    """Return objects as dates or durations by a function of pandas; the error names the first that is none."""
    try:
        index = read(array, **options)
    except (TypeError, ValueError, OverflowError):
        import pandas as pd

        bad = np.flatnonzero(pd.isna(read(array, **options, errors="coerce")) & pd.notna(array))
        got = f"{_checks.shortened(array[bad[0]])} at index {bad[0]}" if bad.size else _checks.shortened(array)
        raise ValueError(
            f"{argument}: must be dates, such as 2026-01-31T12:00:00.01 (ISO 8601), or durations, all of one kind, got "
            f"{got}."
        ) from None
    return np.asarray((index.tz_convert(None) if getattr(index, "tz", None) else index).to_numpy())
