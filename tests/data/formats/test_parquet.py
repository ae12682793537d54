"""Parquet files: one written by hand after the format's specification, and types that PyArrow and pandas write."""

import datetime
import decimal
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
