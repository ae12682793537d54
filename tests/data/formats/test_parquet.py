"""Parquet files: one written by hand after the format's specification, and types that PyArrow and pandas write."""

import datetime
import decimal
import json
import os
import struct
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import parquet
from tests.data.test_damaged_files import damaged

COUNT = 64
TIME = np.arange(COUNT) / 50
X = np.sin(TIME)


def number(value):
    """Return an integer as Thrift's compact protocol writes it: zigzag, seven bits in a byte."""
    value, result = value << 1 if value >= 0 else ~(value << 1), b""
    while value > 127:
        result, value = result + bytes([value & 127 | 128]), value >> 7
    return result + bytes([value])


def varint(value):
    """Return a length as Thrift's compact protocol writes it."""
    return number(value // 2) if value % 2 == 0 else number(-(value + 1) // 2)


def struct_of(*fields):
    """Return a structure of Thrift: fields of number, type (5, 6 integer, 8 text, 9 list, 12 structure) and content."""
    result, last = b"", 0
    for place, kind, content in fields:
        result += bytes([(place - last) << 4 | kind])
        if kind in (5, 6):
            result += number(content)
        elif kind == 8:
            result += varint(len(content)) + content
        elif kind == 9:
            element, items = content
            result += bytes([len(items) << 4 | element]) + b"".join(items)
        else:
            result += content
        last = place
    return result + b"\0"


def by_hand(columns):
    """Return the bytes of a Parquet file of required doubles, plain and not compressed, without Arrow's metadata."""
    content, chunks = b"PAR1", []
    for name, values in columns.items():
        data = values.astype("<f8").tobytes()
        header = struct_of(
            (1, 5, 0), (2, 5, len(data)), (3, 5, len(data)),
            (5, 12, struct_of((1, 5, values.size), (2, 5, 0), (3, 5, 3), (4, 5, 3))),
        )  # fmt: skip
        meta = struct_of(
            (1, 5, 5), (2, 9, (5, [number(0)])), (3, 9, (8, [varint(len(name)) + name])), (4, 5, 0),
            (5, 6, values.size), (6, 6, len(header + data)), (7, 6, len(header + data)), (9, 6, len(content)),
        )  # fmt: skip
        chunks.append(struct_of((2, 6, len(content)), (3, 12, meta)))
        content += header + data
    root = struct_of((4, 8, b"schema"), (5, 5, len(columns)))
    leaves = [struct_of((1, 5, 5), (3, 5, 0), (4, 8, name)) for name in columns]
    size = next(iter(columns.values())).size
    group = struct_of((1, 9, (12, chunks)), (2, 6, len(content)), (3, 6, size))
    footer = struct_of(
        (1, 5, 1), (2, 9, (12, [root, *leaves])), (3, 6, size), (4, 9, (12, [group])), (6, 8, b"by hand")
    )
    return content + footer + struct.pack("<I", len(footer)) + b"PAR1"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.parquet"


def write(path, **columns):
    """Write columns, or pairs of a column and its unit."""
    given = {name: one if isinstance(one, tuple) else (one, None) for name, one in columns.items()}
    fields = [
        pa.field(name, column.type, metadata={"unit": unit} if unit else None) for name, (column, unit) in given.items()
    ]
    pq.write_table(pa.table([column for column, _ in given.values()], schema=pa.schema(fields)), path)


def read(path, **arguments):
    """Return times and values of x."""
    run = bp.Recording.from_file(path, **{"time": "t", "outputs": {"x": "x"}} | arguments)
    times = run.time["x"] if isinstance(run.time, dict) else run.time
    return times.tolist(), run.outputs["x"].tolist()


def test_file_written_by_hand_with_units_in_names(path):
    path.write_bytes(by_hand({b"t [ms]": 1e3 * TIME, b"F (kN)": X}))
    run = bp.Recording.from_file(path, time="t [ms]", outputs={"x": "F (kN)"})
    assert run.time == pytest.approx(TIME) and run.outputs["x"] == pytest.approx(1e3 * X)
    assert [channel.unit for channel in bp.inspect(path).channels] == ["ms", "kN"]


def test_units_of_fields_are_used(path):
    write(path, t=(pa.array([0, 1]), "ms"), x=(pa.array([1.5, 2.5]), "mm"))
    assert read(path) == ([0.0, 0.001], [0.0015, 0.0025])


def test_index_and_units_of_pandas(path):
    table = pd.DataFrame({"x": [1.5, 2.5]}, index=pd.Index([0.0, 0.5], name="t"))
    table.attrs["units"] = {"x": "mm"}
    table.to_parquet(path)
    assert read(path) == ([0.0, 0.5], [0.0015, 0.0025])
    pd.DataFrame({"x": [1.5, 2.5]}, index=pd.date_range("2026-03-12", periods=2, freq="ms")).to_parquet(path)
    assert read(path, time="index") == ([0.0, 0.001], [1.5, 2.5])
    assert "time='index'" in bp.inspect(path).code
    pd.DataFrame({"x": [1.5, 2.5]}, index=pd.RangeIndex(5, 9, 2)).to_parquet(path)
    assert "the index of the table in pandas, from 5 by 2, is not stored" in bp.inspect(path).remarks


TIMES = {
    "us, zone": (pa.array([10**15, 10**15 + 500_000], pa.timestamp("us", tz="Europe/Berlin")), 0.5),
    "ns": (pa.array([10**18 + 1, 10**18 + 3], pa.timestamp("ns")), 2e-9),
    "durations": (pa.array([2, 4], pa.duration("ms")), 0.002),
    "times of day": (pa.array([datetime.time(23, 59, 59, 500_000), datetime.time(0, 0, 0, 250_000)]), 0.75),
    "days": (pa.array([datetime.date(2026, 3, 12), datetime.date(2026, 3, 13)]), 86_400.0),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_have_the_unit_of_the_file(path, kind):
    column, step = TIMES[kind]
    write(path, t=column, x=pa.array([1.5, 2.5]))
    assert read(path)[0] == [0.0, step]
    assert "time='t'" in bp.inspect(path).code


NUMBERS = {
    "nulls": (pa.array([1.5, None, 2.5]), [1.5, 2.5]),
    "integers and nulls": (pa.array([1, None, 2]), [1.0, 2.0]),
    "decimals": (pa.array([decimal.Decimal("1.25"), None, decimal.Decimal("2.50")]), [1.25, 2.5]),
    "half floats": (pa.array(np.array([1.5, np.nan, 2.5], "f2")), [1.5, 2.5]),
    "truth values": (pa.array([True, None, False]), [1.0, 0.0]),
    "dictionary": (pa.array([1.5, None, 2.5]).dictionary_encode(), [1.5, 2.5]),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_nulls_are_missing_values(path, kind):
    column, expected = NUMBERS[kind]
    write(path, t=pa.array([0, 1, 2]), x=column)
    with pytest.raises(ValueError, match="must be finite, got nan at index 1"):
        read(path)
    assert read(path, missing="drop") == ([0.0, 2.0], expected)


def test_large_integers_with_nulls_are_refused(path):
    write(path, t=pa.array([0, 1]), x=pa.array([2**60 + 1, None]))
    with pytest.raises(ValueError, match=r"its column 2 has integers beyond 2\*\*53 and missing values"):
        read(path, missing="drop")


@pytest.mark.parametrize(
    "column",
    [pa.array([[1.0], [2.0]]), pa.array([{"a": 1.0, "b": 2.0}] * 2), pa.array([b"a", b"b"])],
    ids=["lists", "structures", "bytes"],
)
def test_nested_values_are_refused_and_do_not_shift_other_columns(path, column):
    write(path, t=pa.array([0, 1]), s=column, x=pa.array([1.5, 2.5]))
    assert read(path)[1] == [1.5, 2.5]
    with pytest.raises(ValueError, match="column 's' of run.parquet: must be usable, got values of type"):
        read(path, outputs={"x": "s"})


def test_repeated_names_get_numbers(path):
    pq.write_table(pa.table([pa.array([1.5, 2.5]), pa.array([3.0, 4.0])], names=["x", "x"]), path)
    arguments = {"time": None, "sampling_rate": 1.0}
    assert (
        read(path, outputs={"x": "x (2)"}, **arguments)[1] == read(path, outputs={"x": 2}, **arguments)[1] == [3.0, 4.0]
    )


@pytest.mark.parametrize("rows", [10**12, 10**9, 65, -1])
def test_stated_number_of_rows_is_checked(path, rows):
    whole = by_hand({b"t": TIME, b"x": X})
    start = whole.rindex(struct_of((1, 5, 1))[:1] + number(1))
    footer = whole[start:-8].replace(b"\x16" + number(COUNT), b"\x16" + number(rows))
    path.write_bytes(whole[:start] + footer + struct.pack("<I", len(footer)) + b"PAR1")
    with pytest.raises(ValueError, match="path: must be a Parquet file, got .*run.parquet"):
        read(path)


FUZZ = """
import sys, warnings
import numpy as np
import pytest
import bayesperiodic as bp
from bayesperiodic.data.formats import parquet
from tests.data.formats.test_parquet import TIME, X, by_hand
from tests.data.test_damaged_files import damaged
warnings.simplefilter("error")
import io, pandas as pd
compressed = io.BytesIO()
pd.DataFrame({"t": TIME, "x": X}).to_parquet(compressed)
generator = np.random.default_rng(7)
for whole in (by_hand({b"t": TIME, b"x": X}), compressed.getvalue()):
    for _ in range(200):
        open("run.parquet", "wb").write(damaged(whole, generator))
        for call in (lambda: bp.inspect("run.parquet", format="parquet"),
                     lambda: bp.Recording.from_file("run.parquet", format="parquet", time="t", outputs={"x": "x"})):
            try:
                call()
            except ValueError as error:
                assert "must" in str(error)
"""


def test_damaged_files_are_read_or_refused(tmp_path):
    """In a process of its own, which PyArrow must not end."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(os.path.abspath(path or ".") for path in sys.path)}
    done = subprocess.run([sys.executable, "-c", FUZZ], cwd=tmp_path, env=environment, capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


def test_damage_is_refused_here(path):
    path.write_bytes(damaged(by_hand({b"t": TIME, b"x": X}), np.random.default_rng(0))[:-9])
    with pytest.raises(ValueError, match="path: must be a Parquet file, got"):
        read(path, format="parquet")


def test_repeated_names_get_numbers_and_none_is_taken_silently(path):
    columns = [pa.array([0.0, 1.0]), pa.array([1.0, 2.0]), pa.array([3.0, 4.0]), pa.array([5.0, 6.0])]
    pq.write_table(pa.Table.from_arrays(columns, ["t", "x", "x", "x (2)"]), path)
    assert [channel.name for channel in bp.inspect(path).channels] == ["t", "x (1)", "x (2)'", "x (2)"]
    with pytest.raises(ValueError, match="column of run.parquet: must be one of"):
        read(path)
    assert read(path, outputs={"x": "x (2)"})[1] == [5.0, 6.0]


def test_columns_of_texts_and_of_one_date_are_not_the_time(path):
    date = pa.array([datetime.datetime(2026, 3, 12)] * 2)
    write(path, date=date, time=pa.array(["a", "b"]), zeit=pa.array([0.0, 1.0]), x=pa.array([1.0, 2.0]))
    assert "time='zeit'" in bp.inspect(path).code


def channels(path, **columns):
    """Return the channels of a file of columns by name."""
    write(path, **columns)
    return {channel.name: channel for channel in bp.inspect(path).channels}


@pytest.mark.parametrize(
    "column, remark",
    [
        (
            pa.array([1, 2], pa.timestamp("us", tz="Europe/Berlin")),
            "dates in us, stored in UTC, shown in Europe/Berlin",
        ),
        (pa.array([1, 2], pa.timestamp("ms")), "dates in ms, without a time zone"),
        (pa.array([decimal.Decimal("1.5")] * 2), "decimal numbers, read as the nearest floats"),
        (pa.array([1, 2], pa.time64("us")), "times of day, which go on after midnight"),
        (pa.array([1.0, 2.0]), None),
    ],
)
def test_what_a_user_would_not_guess_is_remarked(path, column, remark):
    remarks = channels(path, x=column)["x"].remarks
    assert remarks[:1] == ((remark,) if remark else ())


def test_unit_of_a_field_is_that_of_any_of_its_usual_keys(path):
    for key in ("unit", "Units", "UOM", "unit_string"):
        field = pa.field("x", pa.float64(), metadata={"a": "b", key: ' "mm" '})
        pq.write_table(pa.table([pa.array([1.5, 2.5])], schema=pa.schema([field])), path)
        assert read(path, time=None, sampling_rate=1.0)[1] == [0.0015, 0.0025]
    assert channels(path, **{"x [mm]": (pa.array([1.5]), "cm"), "y [mm]": pa.array([1.5])})["x [mm]"].unit == "cm"
    assert channels(path, **{"y [mm]": pa.array([1.5])})["y [mm]"].unit == "mm"


def of_pandas(path, **metadata):
    """Write two columns with the metadata of pandas."""
    table = pa.table({"t": [0.0, 1.0], "x": [1.5, 2.5]})
    stored = {key: json.dumps(value).encode() for key, value in metadata.items()}
    pq.write_table(table.replace_schema_metadata(stored), path)
    return bp.inspect(path)


def test_units_of_pandas_are_in_its_own_or_in_other_metadata(path):
    for given in (
        {"pandas": {"attributes": {"units": {"x": "mm"}}}}, {"pandas": {"attributes": {"unit": {"x": "mm"}}}},
        {"PANDAS_ATTRS": {"units": {"x": "mm"}}},
    ):  # fmt: skip
        assert [channel.unit for channel in of_pandas(path, **given).channels] == ["", "mm"]
    for given in ({"pandas": {"attributes": ["mm"]}}, {"pandas": {"attributes": {"units": "mm"}}}, {"pandas": {}}, {}):
        assert [channel.unit for channel in of_pandas(path, **given).channels] == ["", ""]


def test_index_of_pandas_is_remarked_and_shown_by_a_plain_name(path):
    seen = of_pandas(path, pandas={"index_columns": ["t"]})
    assert seen.channels[0].remarks == ("the index of the table in pandas",) and seen.channels[1].remarks == ()
    for start, step, shown in ((0, 1, False), (0, 2, True), (5, 1, True)):
        kind = {"kind": "range", "start": start, "stop": 9, "step": step}
        text = f"the index of the table in pandas, from {start} by {step}, is not stored"
        assert (text in of_pandas(path, pandas={"index_columns": [kind]}).remarks) == shown
    assert of_pandas(path, pandas={"index_columns": [{"kind": "other", "start": 5, "step": 2}]}).remarks == ()
    pd.DataFrame({"x": [1.5, 2.5]}, index=[0.0, 1.0]).to_parquet(path)
    assert [one.name for one in bp.inspect(path).channels] == ["x", "index"]
    pd.DataFrame({"x": [1.5, 2.5], "index": [3, 4]}, index=[0.0, 1.0]).to_parquet(path)
    assert [one.name for one in bp.inspect(path).channels] == ["x", "index", "__index_level_0__"]


@pytest.mark.parametrize(
    "columns, suggested",
    [
        ({"a": pa.array([1, 2]), "Time": pa.array([0.0, 1.0])}, "Time"), ({"a": pa.array([1, 2])}, None),
        ({"t": pa.array([0, 1]), "when": pa.array([1, 2], pa.timestamp("ms"))}, "when"),
        ({"t": pa.array([0, 1]), "d": pa.array([1, 2], pa.duration("ms"))}, "d"),
        ({"date": pa.array(["a", "b"])}, None),
        ({"t": pa.array([0.0, 1.0, 0.0])}, None), ({"t": pa.array([0.0])}, None), ({"zeit": pa.array([2, 1])}, "zeit"),
        ({"t": pa.array([[1.0], [2.0]]), "x": pa.array([1.0, 2.0])}, None),
    ],
)  # fmt: skip
def test_suggested_time_has_a_type_or_name_of_times_and_changes(path, columns, suggested):
    write(path, **columns)
    code = bp.inspect(path).code
    assert (f"time={suggested!r}" in code) if suggested else "time=" not in code


@pytest.mark.parametrize(
    "column, kind",
    [
        (pa.array([[1.0], [2.0]]), "list<element: double>"), (pa.array([{"a": 1.0}] * 2), "struct<a: double>"),
        (pa.array([b"a", b"b"]), "binary"), (pa.array([b"a", b"b"], pa.large_binary()), "large_binary"),
        (pa.array([b"a", b"b"], pa.binary(1)), "fixed_size_binary"),
    ],
)  # fmt: skip
def test_columns_of_other_types_are_refused_with_the_type(path, column, kind):
    write(path, x=column)
    with pytest.raises(ValueError, match=f"column 'x' of run.parquet: must be usable, got values of type {kind}"):
        read(path, time=None, sampling_rate=1.0)
    assert ("one array for each channel" in str(bp.inspect(path))) == ("binary" not in kind)


@pytest.mark.parametrize("value, exact", [(2**53, True), (-(2**53), True), (2**53 + 1, False), (-(2**53) - 1, False)])
def test_integers_with_nulls_are_those_that_floats_hold(path, value, exact):
    write(path, t=pa.array([0, 1, 2]), x=pa.array([value, None, 5]))
    if exact:
        assert read(path, missing="drop")[1] == [float(value), 5.0]
    else:
        with pytest.raises(
            ValueError, match=r"its column 2 has integers beyond 2\*\*53 and missing values; store it as fl"
        ):
            read(path, missing="drop")
    write(path, t=pa.array([0, 1, 2]), x=pa.array([2**31 - 1, None, 5], pa.int32()))
    assert read(path, missing="drop")[1] == [2.0**31 - 1, 5.0]
    write(path, t=pa.array([0, 1, 2]), x=pa.array([-128, None, 5], pa.int8()))
    assert read(path, missing="drop")[1] == [-128.0, 5.0]
    write(path, t=pa.array([0, 1]), x=pa.array([2**60, 2**60 + 2**8]))
    assert read(path)[1] == [2.0**60, 2.0**60 + 2**8]


@pytest.mark.parametrize("unit, kind", [("s", pa.time32), ("ms", pa.time32), ("us", pa.time64), ("ns", pa.time64)])
def test_times_of_day_with_nulls_go_on_after_midnight(path, unit, kind):
    second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    column = pa.array([86_399 * second, None, second, 3 * second], kind(unit))
    write(path, t=column, x=pa.array([1.0, 2.0, 3.0, 4.0]))
    with pytest.raises(ValueError, match="must be finite, got nan at index 1"):
        read(path)
    assert read(path, missing="drop") == ([0.0, 2.0, 4.0], [1.0, 3.0, 4.0])


def test_tables_without_rows_or_of_too_many_are_refused_with_their_size(path, monkeypatch):
    write(path, x=pa.array([], pa.float64()))
    with pytest.raises(ValueError, match="path: must be a Parquet file, got .*run.parquet' .it has no rows"):
        bp.inspect(path)
    write(path, t=pa.array(TIME), x=pa.array(X))
    for limit, refused in ((16 * COUNT, False), (16 * COUNT - 1, True)):
        monkeypatch.setattr(parquet, "LARGEST_ARRAY", limit)
        if refused:
            with pytest.raises(
                ValueError, match=f"its header states {COUNT} rows, more than .* GB or than fit in the fil"
            ):
                bp.inspect(path)
        else:
            assert len(bp.inspect(path).channels) == 2
    monkeypatch.setattr(parquet, "LARGEST_ARRAY", 2**31)
    monkeypatch.setattr(parquet, "VALUES_PER_BYTE", COUNT / path.stat().st_size * 0.999)
    with pytest.raises(ValueError, match=f"its header states {COUNT} rows, more than 2.15 GB or than fit in the file"):
        bp.inspect(path)


def test_row_groups_are_joined_and_columns_too_large_named(path, monkeypatch):
    table = pa.table({"t": TIME, "a.b": X, "x": 2 * X})
    pq.write_table(table, path, row_group_size=10, compression="none", use_dictionary=False)
    assert read(path) == (TIME.tolist(), (2 * X).tolist())
    size = sum(pq.ParquetFile(path).metadata.row_group(k).column(2).total_uncompressed_size for k in range(7))
    for limit in (size, size - 1):
        monkeypatch.setattr(parquet, "LARGEST_ARRAY", limit)
        monkeypatch.setattr(parquet, "BYTES_PER_VALUE", 1)
        if limit == size:
            assert parquet._values(path, 2).tolist() == (2 * X).tolist()
        else:
            with pytest.raises(ValueError, match="its column 3 has .* GB, more than .* GB"):
                parquet._values(path, 2)


def test_columns_have_units_of_fields_of_pandas_or_in_names_and_remarks(path):
    schema = pa.schema(
        [
            pa.field("t [ms]", pa.float64(), metadata={"unit": "s"}), pa.field("x", pa.float64()),
            pa.field("F [kN]", pa.float64()), pa.field("x", pa.int8()), pa.field("when", pa.timestamp("ms")),
            pa.field("v_mm_s", pa.float64()), pa.field("list", pa.list_(pa.int8())), pa.field("k", pa.int64()),
        ],
        metadata={"pandas": json.dumps({"index_columns": ["k"], "attributes": {"units": {"x": "mm", "F [kN]": "N"}}})},
    )  # fmt: skip
    columns = [[0.0, 1.0]] * 3 + [[1, 2]] * 2 + [[0.5, 1.5], [[1], [2]], [5, 7]]
    pq.write_table(pa.Table.from_arrays([*map(pa.array, columns, schema.types)], schema=schema), path)
    whole = parquet.contents(path, [])
    assert (whole.kind, whole.word, whole.remarks, whole.suggested_time) == ("Parquet file", "column", (), "when")
    names = ["t [ms]", "x (1)", "F [kN]", "x (2)", "when", "v_mm_s", "list", "k"]
    assert [(one.name, one.samples, one.group) for one in whole.channels] == [(name, 2, "") for name in names]
    assert [one.unit for one in whole.channels] == ["s", "mm", "N", "mm", "", "", "", ""]
    said = {one.name: one.remarks for one in whole.channels if one.remarks}
    assert said == {
        "when": ("dates in ms, without a time zone",), "k": ("the index of the table in pandas",),
        "v_mm_s": ("the name may say the unit 'mm/s', which is not used; units= converts",),
    }  # fmt: skip
    assert [one.name for one in whole.channels if one.refusal] == ["list"]
    assert [one.values().tolist() for one in whole.channels[:4]] == columns[:4]
    assert parquet.contents(path, ["x (1)"]).suggested_time == ""


@pytest.mark.parametrize(
    "metadata, unit",
    [
        (None, ""), ({}, ""), ({b"unit": b"mm"}, "mm"), ({b"UNITS": b' "kN" '}, "kN"), ({b"uom": b"\xb5m"}, "\ufffdm"),
        ({b"other": b"m", b"unit_string": "\u00b5m".encode(), b"unit": b"s"}, "\u00b5m"), ({b"other": b"m"}, ""),
    ],
)  # fmt: skip
def test_unit_is_the_first_of_its_names_in_the_metadata_of_a_field(metadata, unit):
    assert parquet._unit(metadata) == unit


@pytest.mark.parametrize(
    "column, kind, values",
    [
        (pa.array([decimal.Decimal("1.5"), None]), "f8", [1.5, np.nan]),
        (pa.array([1.5, 2.0], pa.float16()), "f8", [1.5, 2.0]),
        (pa.array([1.5, 2.0], pa.float32()), "f4", [1.5, 2.0]), (pa.array([1, None], pa.int8()), "f8", [1.0, np.nan]),
        (pa.array([1, 2], pa.int8()), "i1", [1, 2]), (pa.array([True, None]), "f8", [1.0, np.nan]),
        (pa.array([True, False]), "?", [True, False]), (pa.array([2**53, None]), "f8", [2.0**53, np.nan]),
        (pa.array([1.5, 1.5]).dictionary_encode(), "f8", [1.5, 1.5]),
        (pa.array([7, None], pa.int32()).dictionary_encode(), "f8", [7.0, np.nan]),
        (pa.array([datetime.date(1970, 1, 2), None]), "M8[ms]", [86_400_000, None]),
        (pa.array([5, None], pa.duration("us")), "m8[us]", [5, None]), (pa.array(["a", None]), "O", ["a", None]),
    ],
)  # fmt: skip
def test_values_of_each_type_are_numbers_dates_or_texts(path, column, kind, values):
    write(path, t=pa.array([0, 1]), x=column)
    seen = parquet._values(path, 1)
    assert seen.dtype == np.dtype(kind)
    times = seen.dtype.kind in "mM"
    np.testing.assert_equal([None if np.isnat(x) else x.astype(int) for x in seen] if times else seen.tolist(), values)


def test_integers_beyond_those_of_floats_have_no_missing_values(path):
    write(path, t=pa.array([0, 1]), x=pa.array([-(2**53) - 1, None]))
    with pytest.raises(
        ValueError, match="^its column 2 has integers beyond .* and missing values; store it as floats$"
    ):
        parquet._values(path, 1)
