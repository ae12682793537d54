"""HDF5 files of any layout: columns of numbers, with the attributes of netCDF and of measurement programs."""

import functools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bayesperiodic import _hdf5
from bayesperiodic.data.formats.contents import LARGEST_ARRAY, OTHERWISE, Clock, Contents, Key, StoredChannel
from bayesperiodic.data.formats.hdf5_attributes import (
    UNIT_NAMES,
    Packing,
    Since,
    attributes,
    meaning_of_integers,
    sampling,
    unused_scale,
)

# Columns of tables: at most so many, and a table is so many times longer than wide.
MOST_COLUMNS, SLENDER = 64, 10
MOST_NUMBERS = 10
UNREAD = "(unit of a type that is not read)"

Column = Callable[[np.ndarray], np.ndarray]
Scales = list[tuple[str, str]]


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the columns of numbers of an HDF5 file, with groups as groups; no links are followed."""
    channels: list[StoredChannel] = []
    numbers: list[str] = []
    clocks: dict[Any, Clock] = {}
    read = functools.lru_cache(maxsize=1)(partial(_array, file))
    _hdf5.check_heaps(file)
    with h5py.File(file, "r") as archive:
        scales = [
            (group, name)
            for group, name, item in _hdf5.walk(archive)
            if item is not None and item.ndim == 1 and attributes(item).get("CLASS") == "DIMENSION_SCALE"
        ]
        for group, name, item in _hdf5.walk(archive):
            if item is None:
                channels.append(StoredChannel(name, 0, _nothing, group, refusal="a link or data of another file"))
            elif item.shape == () and item.dtype.kind in "fiu":
                numbers.append(f"{group}/{name}".lstrip("/"))
            elif item.shape and not _is_dimension_only(item):
                channels += _channels(archive, read, group, name, item, scales, clocks)
        remarks = _remarks(archive, numbers)
    return Contents("HDF5 file", tuple(channels), remarks)


def _nothing() -> Any:
    raise ValueError("it is not in this file")


def _is_dimension_only(item: h5py.Dataset) -> bool:
    return str(attributes(item).get("NAME", "")).startswith(_hdf5.DIMENSION_ONLY.decode())


def _array(file: Path, group: str, name: str) -> np.ndarray:
    """Return an array as it is stored; the file is opened again, so that nothing is left open."""
    with h5py.File(file, "r") as archive:
        item = _hdf5.at(archive, group, name)
        return np.asarray(_hdf5.values(item, LARGEST_ARRAY, OTHERWISE))


def _channels(
    archive: h5py.File, read: Any, group: str, name: str, item: h5py.Dataset, scales: Scales, clocks: dict[Any, Clock]
) -> Iterator[StoredChannel]:
    """Yield the columns of an array, or the array with the reason why it has none."""
    columns = dict(_columns(name, item))
    samples = max(item.shape)
    if skipped := [
        field
        for field in item.dtype.names or ()
        if columns and not any(label.startswith(f"{name}.{field}") for label in columns)
    ]:
        yield StoredChannel(
            f"{name}.{skipped[0]}", samples, _nothing, group, refusal=f"fields {skipped}, which are no numbers"
        )
    if not columns:
        shape = " x ".join(map(str, item.shape))
        refusal = f"of shape {shape} and type {item.dtype}, which is no table of columns of numbers; {OTHERWISE}"
        yield StoredChannel(name, samples, _nothing, group, refusal=refusal)
        return
    stored = attributes(item)
    packing = Packing.of(stored, item)
    units = _units(item, stored, len(columns))
    since = Since.of(units[0], stored) if " since " in units[0] else None
    clock = _coordinate(archive, read, group, item, scales, clocks) or _clock(stored, clocks)
    remarks: tuple[str, ...] = (packing.remark,) if packing.remark else ()
    for key, value in attributes(archive[group]).items() if group and clock is None else ():
        if sampling({key: value}) is not None:
            remarks += (f"its group has an attribute {key} = {value}, which is not used; give sampling_rate=",)
    scale = packing.unused or unused_scale(stored)
    scale = scale or ("" if packing.remark else meaning_of_integers(stored, item.dtype))
    refusal = packing.refusal or (since.refusal or _scaled_dates(scale) if since else "")
    for (label, column), unit in zip(columns.items(), units, strict=True):
        shown = "" if since else f"{unit or 'stored values'} ({scale} not applied)" if scale else unit
        yield StoredChannel(
            label, samples, partial(_values, read, group, name, column, packing, since), group, shown, clock,
            remarks, refusal,
        )  # fmt: skip


def _scaled_dates(scale: str) -> str:
    return f"dates with an attribute {scale}, which is not applied; {OTHERWISE}" if scale else ""


def _units(item: h5py.Dataset, stored: dict[str, Any], columns: int) -> list[str]:
    """Return the unit of each column of an array, of one for all or a list."""
    key = next((key for key in UNIT_NAMES if key in item.attrs), None)
    if key is None or item.dtype.names:
        return [""] * columns
    if np.prod(item.attrs.get_id(key).shape) == 1:
        if key not in stored:
            return [UNREAD] * columns
        return [str(stored[key]) if isinstance(stored[key], str) else ""] * columns
    try:
        given = [one.decode("utf-8", "replace") if isinstance(one, bytes) else one for one in np.ravel(item.attrs[key])]
    except Exception:  # of types that h5py does not know, and of damaged files
        return [UNREAD] * columns
    texts = len(given) == columns and all(isinstance(one, str) for one in given)
    return [str(one) for one in given] if texts else [""] * columns


def _columns(name: str, item: h5py.Dataset) -> Iterator[tuple[str, Column]]:
    """Yield names and columns of an array: itself, those of a table named as in NumPy, or the fields of a structure."""
    kind = item.dtype
    longest = max(item.shape)
    if kind.names:
        if np.prod(item.shape) == longest and not kind.hasobject and set(kind.names) != {"r", "i"}:
            yield from _field_columns(name, kind)
        return
    if kind.kind not in "fiub" and not h5py.check_string_dtype(kind):
        return
    if np.prod(item.shape) == longest:
        yield name, np.ravel
        return
    if item.ndim != 2 or kind.kind not in "fiub":
        return
    width = min(item.shape)
    if width > MOST_COLUMNS or longest < SLENDER * width:
        return
    for k in range(width):
        if item.shape[0] == longest:
            yield f"{name}[:, {k}]", partial(_column, k=k)
        else:
            yield f"{name}[{k}, :]", partial(_row, k=k)


def _field_columns(name: str, kind: np.dtype[Any]) -> Iterator[tuple[str, Column]]:
    """Yield names and columns of the fields of a structure that are numbers, or a few numbers."""
    for field in kind.names or ():
        base, shape = kind[field].base, kind[field].shape
        if base.kind not in "fiub" or len(shape) > 1 or np.prod(shape) > MOST_COLUMNS:
            continue
        if np.prod(shape) == 1:
            yield f"{name}.{field}", partial(_field, field=field, k=0)
        else:
            for k in range(shape[0]):
                yield f"{name}.{field}[:, {k}]", partial(_field, field=field, k=k)


def _field(array: np.ndarray, field: str, k: int) -> np.ndarray:
    return array[field].reshape(array.size, -1)[:, k]


def _column(array: np.ndarray, k: int) -> np.ndarray:
    return array[:, k]


def _row(array: np.ndarray, k: int) -> np.ndarray:
    return array[k]


def _values(read: Any, group: str, name: str, column: Column, packing: Packing, since: Since | None) -> Any:
    values = packing.unpacked(column(read(group, name)))
    if values.dtype.kind in "OS":
        return np.array([one.decode("utf-8", "replace") if isinstance(one, bytes) else one for one in values])
    return values if since is None else since.dates(values)


def _clock(stored: dict[str, Any], clocks: dict[Any, Clock]) -> Clock | None:
    """Return the times after the attributes of an array, one object for equal ones."""
    clock = sampling(stored)
    if clock is None:
        return None
    return clocks.setdefault((clock.start, clock.step, clock.origin, clock.refusal), clock)


def _coordinate(
    archive: h5py.File, read: Any, group: str, item: h5py.Dataset, scales: Scales, clocks: dict[Any, Clock]
) -> Clock | None:
    """Return the times in the coordinate of a variable of netCDF, if only one dimension has its length.

    The list of its dimensions itself is not read, because h5py crashes on some damaged ones.
    """
    if item.ndim != 1 or "DIMENSION_LIST" not in item.attrs:
        return None
    above = [(place, label) for place, label in scales if f"{group}/".startswith(f"{place}/" if place else "")]
    same = [(*key, scale) for key in above if (scale := _hdf5.at(archive, *key)).shape == item.shape]
    if len(same) != 1:
        return None
    place, label, scale = same[0]
    stored = attributes(scale)
    packing, since = Packing.of(stored, scale), Since.of(str(stored.get("units", "")), stored)
    if since is None or scale.dtype.kind not in "fiu" or _is_dimension_only(scale):
        return None
    refusal = packing.refusal or since.refusal or _scaled_dates(packing.unused or unused_scale(stored))
    if (place, label) not in clocks:
        clocks[place, label] = Clock(
            stored=lambda: since.seconds(packing.unpacked(read(place, label))),
            origin=since.origin,
            refusal=refusal,
            remarks=(f"times are those of its coordinate {label!r}",),
        )
    return clocks[place, label]


def _remarks(archive: h5py.File, numbers: list[str]) -> tuple[str, ...]:
    """Return what may say the sampling rate, and what else is in the file."""
    remarks = []
    if numbers:
        shown = ", ".join(numbers[:MOST_NUMBERS]) + (" and more" if len(numbers) > MOST_NUMBERS else "")
        remarks.append(f"single numbers, which are not used: {shown}")
    for key, value in attributes(archive).items():
        if sampling({key: value}) is not None:
            remarks.append(f"the file has an attribute {key} = {value}, which is not used; give sampling_rate=")
        if key == "PYTABLES_FORMAT_VERSION":
            remarks.append("written by PyTables; a table of pandas is read by pandas.read_hdf for from_dataframe")
    return tuple(remarks)
