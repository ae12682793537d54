"""Parquet files: columns with units in the metadata of their fields, times with units and zones."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic.data.formats import header_units
from bayesperiodic.data.formats.contents import LARGEST_ARRAY, Contents, Key, StoredChannel, package
from bayesperiodic.data.formats.text_header import numbered

# Keys of units in the metadata of a field, in lower case.
UNIT_KEYS = (b"unit", b"units", b"uom", b"unit_string")
# Bytes per value of a column that is made an array, and values per byte of a file that its header may state.
BYTES_PER_VALUE, VALUES_PER_BYTE = 16, 10_000


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the columns of a Parquet file; each is read when it is asked for."""
    parquet = package("pyarrow.parquet", "PyArrow", "Parquet files")
    content = parquet.ParquetFile(file, memory_map=False)
    rows, schema = content.metadata.num_rows, content.schema_arrow
    if not 0 <= rows * BYTES_PER_VALUE <= LARGEST_ARRAY or rows > VALUES_PER_BYTE * file.stat().st_size:
        raise ValueError(
            f"its header states {rows} rows, more than {LARGEST_ARRAY / 1e9:.3g} GB or than fit in the file"
        )
    if not rows:
        raise ValueError("it has no rows")
    pandas, index = _pandas(schema.metadata)
    units, _ = header_units.in_names(schema.names)
    channels, remarks = [], []
    plain = "index" not in schema.names
    names = ["index" if plain and one in index and one.startswith("__index_level_") else one for one in schema.names]
    for place, name in enumerate(numbered(names)):
        kind, remark = schema.field(place).type, []
        if schema.names[place] in index:
            remark.append("the index of the table in pandas")
        unit = _unit(schema.field(place).metadata) or pandas.get(schema.names[place], "")
        channels.append(
            StoredChannel(
                name,
                rows,
                partial(_values, file, place),
                unit=unit or units[place],
                remarks=(*remark, *_remarks(kind), *header_units.remarks(name, unit or units[place])),
                refusal=_refusal(kind),
            )
        )
    remarks += [
        f"the index of the table in pandas, {index_range}, is not stored" for index_range in _ranges(schema.metadata)
    ]
    named = [c for c in channels if c.name.lower() in ("t", "time", "zeit", "timestamp", "date")]
    dated = [c for c, f in zip(channels, schema, strict=True) if _is_time(f.type)]
    suggested = next((c.name for c in [*dated, *named] if not wanted and _may_be_times(c)), "")
    return Contents("Parquet file", tuple(channels), tuple(remarks), word="column", suggested_time=suggested)


def _is_time(kind: Any) -> bool:
    from pyarrow import types

    return bool(types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind))


def _may_be_times(channel: StoredChannel) -> bool:
    """Return whether a column has no texts, and does not end as it begins."""
    if channel.refusal:
        return False
    values = channel.values()
    return values.dtype.kind in "fiumM" and values.size > 1 and bool(values[0] != values[-1])


def _unit(metadata: dict[bytes, bytes] | None) -> str:
    """Return the unit in the metadata of a field."""
    for key, value in (metadata or {}).items():
        if key.lower() in UNIT_KEYS:
            return value.decode("utf-8", errors="replace").strip().strip('"')
    return ""


def _pandas(metadata: dict[bytes, bytes] | None) -> tuple[dict[str, str], set[str]]:
    """Return units by column, from `attrs` or from the metadata of pandas, and the names of columns of the index."""
    given = json.loads((metadata or {}).get(b"pandas", b"{}"))
    index = {one for one in given.get("index_columns", []) if isinstance(one, str)}
    attributes = given.get("attributes") or json.loads((metadata or {}).get(b"PANDAS_ATTRS", b"{}"))
    units = attributes.get("units", attributes.get("unit", {})) if isinstance(attributes, dict) else {}
    return ({str(k): str(v) for k, v in units.items()} if isinstance(units, dict) else {}), index


def _ranges(metadata: dict[bytes, bytes] | None) -> list[str]:
    """Return index ranges of pandas, which hold times if they have a step."""
    given = json.loads((metadata or {}).get(b"pandas", b"{}"))
    ranges = [one for one in given.get("index_columns", []) if isinstance(one, dict) and one.get("kind") == "range"]
    return [
        f"from {one.get('start')} by {one.get('step')}"
        for one in ranges
        if (one.get("start"), one.get("step")) != (0, 1)
    ]


def _remarks(kind: Any) -> tuple[str, ...]:
    """Return what a user would not guess about a column."""
    from pyarrow import types

    if types.is_timestamp(kind):
        return (f"dates in {kind.unit}, {f'stored in UTC, shown in {kind.tz}' if kind.tz else 'without a time zone'}",)
    if types.is_decimal(kind):
        return ("decimal numbers, read as the nearest floats",)
    if types.is_time(kind):
        return ("times of day, which go on after midnight",)
    return ()


def _refusal(kind: Any) -> str:
    """Return why a column cannot be used."""
    from pyarrow import types

    if type(kind).__name__.endswith("ExtensionType") or types.is_nested(kind):
        return f"values of type {kind}; read it by pyarrow.parquet for from_arrays, one array for each channel"
    if (
        types.is_binary(kind)
        or types.is_large_binary(kind)
        or types.is_fixed_size_binary(kind)
        or types.is_interval(kind)
    ):
        return f"values of type {kind}"
    return ""


def _values(file: Path, place: int) -> np.ndarray:
    """Return a column as numbers, dates, durations or texts; nulls are missing values."""
    import pyarrow as arrow
    from pyarrow import compute, parquet, types

    content = parquet.ParquetFile(file, memory_map=False)
    groups = content.metadata.num_row_groups
    parts = [content.metadata.row_group(k) for k in range(groups)]
    name = content.schema_arrow.names[place]
    leaves = [part.column(k) for part in parts for k in range(part.num_columns)]
    size = sum(leaf.total_uncompressed_size for leaf in leaves if leaf.path_in_schema.split(".")[0] == name)
    if not 0 <= size <= LARGEST_ARRAY:
        raise ValueError(f"its column {place + 1} has {size / 1e9:.3g} GB, more than {LARGEST_ARRAY / 1e9:.3g} GB")
    rows = content.metadata.num_rows
    read = content.reader.read_column(place)
    if len(read) != rows:
        raise ValueError(f"its column {place + 1} has {len(read)} values, and {rows} rows are stated")
    kind = read.type
    if types.is_dictionary(kind):
        read, kind = compute.cast(read, kind.value_type), kind.value_type
    if types.is_decimal(kind) or types.is_float16(kind):
        read = compute.cast(read, arrow.float64())
    elif types.is_time(kind):
        return _times_of_day(read, kind, arrow, compute)
    elif types.is_date(kind):
        read = compute.cast(read, arrow.timestamp("ms"))
    elif types.is_boolean(kind) and read.null_count:
        read = compute.cast(compute.cast(read, arrow.int8()), arrow.float64())
    elif types.is_integer(kind) and read.null_count:
        if (
            largest := compute.max(compute.abs_checked(read)).as_py() if kind.bit_width == 64 else 0
        ) and largest > 2**53:
            raise ValueError(f"its column {place + 1} has integers beyond 2**53 and missing values; store it as floats")
        read = compute.cast(read, arrow.float64())
    return np.asarray(read.to_numpy())


def _times_of_day(read: Any, kind: Any, arrow: Any, compute: Any) -> np.ndarray:
    """Return times of day as durations that go on after midnight."""
    from bayesperiodic.data.formats.text_cells import rolled

    integers = compute.cast(read, arrow.int32() if kind.bit_width == 32 else arrow.int64())
    values = compute.cast(integers, arrow.int64()).to_numpy()
    missing = np.isnan(values) if values.dtype.kind == "f" else np.zeros(values.shape, bool)
    whole = np.where(missing, 0, values).astype(f"timedelta64[{kind.unit}]")
    whole[missing] = np.timedelta64("NaT", kind.unit)
    return rolled(whole)[0]
