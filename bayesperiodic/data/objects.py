"""Contents of objects in memory: tables of pandas, datasets of xarray, time series after SEP 005."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.formats import header_units
from bayesperiodic.data.formats.contents import Clock, Contents, StoredChannel
from bayesperiodic.data.times import dates, nanoseconds, seconds
from bayesperiodic.data.units import from_file, is_duration

# Relative difference of "fs" and "time" that is no rounding.
CONTRADICTION = 1e-4
# Attributes of netCDF by which values are decoded.
PACKED = ("scale_factor", "add_offset", "_FillValue", "missing_value")
# Seconds from a start beyond which they are counted from another one, such as 1970.
LONGEST_DELAY = 1e8


def dataframe(table: Any) -> Contents:
    """Return the columns of a DataFrame, and its index if it has a name; units also from names such as "x [mm]"."""
    import pandas as pd

    _checks.instance("table", table, pd.DataFrame)
    units = table.attrs.get("units")
    units = dict(units) if isinstance(units, Mapping) else {}
    clock = _of_coordinate("index", table.index, "")
    labels = [str(label[-1] if isinstance(label, tuple) else label) for label in table.columns]
    channels, in_names = [], header_units.in_names(labels)[0]
    for place, label in enumerate(table.columns):
        group, name = ("", label) if not isinstance(label, tuple) else (str(label[0]), label[-1])
        if isinstance(label, tuple) and len(label) > 2:
            raise ValueError(f"table: must have names of columns with at most two levels, got {label!r}.")
        column = table.iloc[:, place]
        unit = units.get(label, column.attrs.get("units", ""))
        values = column.to_numpy
        if str(column.dtype).startswith("pint["):  # of pint-pandas
            unit, values = str(column.dtype)[5:-1], column.pint.magnitude.to_numpy
        unit = (unit if isinstance(unit, str) else "") or in_names[place]
        channels.append(StoredChannel(str(name), len(table), _copied(values), group, unit, clock))
    if table.index.name is not None and str(table.index.name) not in [channel.name for channel in channels]:
        channels.append(StoredChannel(str(table.index.name), len(table), _copied(table.index.to_numpy), clock=clock))
    return Contents("DataFrame", tuple(_distinct("table", channels)), word="column", numbered=False)


def dataset(data: Any) -> Contents:
    """Return variables and coordinates of one dimension of an xarray object."""
    import xarray as xr

    _checks.instance("dataset", data, (xr.Dataset, xr.DataArray))
    if isinstance(data, xr.DataArray):
        if data.name is None:
            raise ValueError("dataset: must have a name if it is a DataArray, got None; give data.rename('x').")
        data = data.to_dataset()
    clocks = {
        name: _of_coordinate(str(name), data[name].to_numpy(), _unit(data[name]))
        for name in data.coords
        if data[name].dims == (name,)
    }
    channels = []
    for name, variable in data.variables.items():
        dimensions = tuple(map(str, variable.dims))
        refusal = f"dimensions {dimensions}; choose one column by isel or sel" if len(dimensions) != 1 else ""
        if packed := [key for key in PACKED if key in variable.attrs]:
            refusal = f"packed values, with {packed[0]!r} in attrs; decode them first by xarray.decode_cf(dataset)"
        clock = clocks.get(variable.dims[0]) if dimensions else None
        read, size, unit = variable.to_numpy, int(variable.size), _unit(variable)
        channels.append(StoredChannel(str(name), size, _copied(read), unit=unit, clock=clock, refusal=refusal))
    return Contents("Dataset", tuple(channels), word="variable")


def sep005(series: Any) -> Contents:
    """Return the channels of time series after SEP 005."""
    if not isinstance(series, list | tuple) or not all(isinstance(one, Mapping) for one in series):
        raise ValueError(
            f"channels: must be a list of dictionaries after SEP 005, got {_checks.shortened(series)}; one channel is "
            "[channel]."
        )
    return Contents("the list", tuple(_distinct("channels", [_sep005(k, one) for k, one in enumerate(series)])))


def _sep005(place: int, one: Mapping[str, Any]) -> StoredChannel:
    argument = f"channels[{place}]"
    _checks.contains(argument, one, ("data", "name", "unit_str"), "SEP 005 requires them")
    data = np.array(one["data"], dtype=object) if _is_ragged(one["data"]) else np.asarray(one["data"])
    if data.ndim != 1:
        raise ValueError(
            f"{argument}: must have data of one dimension, got shape {data.shape}; give each column as a channel."
        )
    rate, time, stamp = one.get("fs"), one.get("time"), one.get("start_timestamp")
    origin = _instant(f"{argument}['start_timestamp']", stamp) if stamp is not None else None
    if rate is None and time is None:
        raise ValueError(f"{argument}: must have 'fs' or 'time', got neither.")
    clock = None
    if time is None:
        clock = Clock(step=1.0 / _checks.positive(f"{argument}['fs']", rate), origin=origin)
    else:
        stamped = _of_coordinate(f"{argument}['time']", np.asarray(time), "")
        if stamped is not None and stamped.stored is not None:
            if origin is not None and stamped.origin is not None:
                raise ValueError(f"{argument}: must have dates or 'start_timestamp', and not both, got both.")
            times, origin = stamped.stored(), origin if stamped.origin is None else stamped.origin
        else:
            times = _checks.real_array(f"{argument}['time']", seconds(f"{argument}['time']", time))
        if times.shape != data.shape:
            raise ValueError(f"{argument}: must have one time per value, got {times.size} and {data.size} values.")
        if origin is not None and times.size and abs(times[0]) > LONGEST_DELAY:
            raise ValueError(
                f"{argument}: must have times from 'start_timestamp' on, got {times[0]:.9g} s after {stamp!r}; "
                "leave one of them out."
            )
        if rate is not None:
            length = float(times[-1] - times[0]) if times.size > 1 else 0.0
            mean = (times.size - 1) / length if length else np.inf if times.size > 1 else float(rate)
            if not abs(mean / _checks.positive(f"{argument}['fs']", rate) - 1.0) < CONTRADICTION:
                raise ValueError(
                    f"{argument}: must have 'fs' and 'time' that agree, got {rate!r} Hz and times of {mean:.6g} Hz; "
                    "leave the wrong one out."
                )
        clock = Clock(stored=lambda: times, origin=origin)
    group = str(one.get("group") or "")
    return StoredChannel(str(one["name"]), data.size, _copied(lambda: data), group, str(one["unit_str"] or ""), clock)


def _copied(read: Callable[[], Any]) -> Callable[[], np.ndarray]:
    """Return a reader of arrays that the user does not have, as a recording keeps them."""
    return lambda: np.array(read())


def _is_ragged(values: Any) -> bool:
    """Return whether values are sequences of different lengths, which NumPy makes no array of."""
    return isinstance(values, list | tuple) and len({np.size(value) for value in values}) > 1


def _instant(argument: str, stamp: Any) -> np.datetime64:
    """Return a date after ISO 8601 in UTC."""
    times = dates(argument, np.array([stamp], dtype=object))
    if times is None or np.isnat(times[0]):
        raise ValueError(f"{argument}: must be a date after ISO 8601, got {stamp!r}.")
    return nanoseconds(argument, times[0])


def _of_coordinate(argument: str, values: Any, unit: str) -> Clock | None:
    """Return a clock of dates, durations, or numbers with a unit of time; None for other coordinates."""
    array = np.asarray(values) if getattr(values, "dtype", None) is None else values
    times = dates(argument, array) if np.asarray(array).dtype.kind in "mMO" else None
    if times is not None and times.ndim == 1 and not np.isnat(times).all():
        first = times[~np.isnat(times)][0]
        origin = nanoseconds(argument, first) if times.dtype.kind == "M" else None
        shift = 0.0 if origin is not None else first / np.timedelta64(1, "ns") * 1e-9
        return Clock(stored=lambda: seconds(argument, times) + shift, origin=origin)
    if np.asarray(array).dtype.kind in "fiu" and is_duration(unit):
        return Clock(stored=partial(_in_seconds, np.asarray(array), unit))
    return None


def _in_seconds(values: np.ndarray, unit: str) -> np.ndarray:
    return from_file("time", values.astype(float), "s", unit)


def _unit(variable: Any) -> str:
    """Return the unit of a variable of xarray."""
    unit = variable.attrs.get("units", "")
    return unit if isinstance(unit, str) else ""


def _distinct(argument: str, channels: list[StoredChannel]) -> list[StoredChannel]:
    """Return channels whose names differ within their groups."""
    names = [(channel.group, channel.name) for channel in channels]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(
                f"{argument}: must have channels of different names, got {name[-1]!r} {names.count(name)} times."
            )
    return channels
