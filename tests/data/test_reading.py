"""Any CSV file is read as Python's own reader of tables reads it, or refused by one error."""

import csv
import io
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import bayesperiodic as bp

NUMBER = re.compile(r"[ \t]*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?[ \t]*")
# What pandas and the documentation take for a missing value.
MISSING = {"", "nan", "NaN", "NA", "N/A", "null", "-nan"}
# Columns of nothing else are logical, as a gate or a trigger is stored.
LOGICAL = {"True": 1.0, "false": 0.0}
JUNK = [
    "x", "1;5", "1_000", "0x1F", "\u0661", "1d3", "True", "false", "inf", "-Infinity", "--1", "1e", "1 2",
    "\u22121", "1e400", "'1'", "#N/A!", "1.2.3", "1\ufeff", "1\u00a0", "\u20281",
]  # fmt: skip
floats = st.floats(-1e99, 1e99, allow_nan=False).filter(lambda x: x == 0.0 or abs(x) > 1e-90)


@st.composite
def cells(draw, damage):
    """Return the text of one cell."""
    kind = draw(st.integers(0, 19))
    if damage and kind == 0:
        return draw(st.sampled_from(JUNK))
    if damage and kind < 3:
        return draw(st.sampled_from(sorted(MISSING)))
    number = draw(floats)
    form = draw(st.sampled_from(["{!r}", "{:.17g}", "{:.6e}", "{:+.4E}", " {!r}", "{!r} ", "{:.0f}."]))
    return form.format(number)


names = st.text(st.characters(exclude_categories=["Cs", "Cc", "Zl", "Zp"]), min_size=1, max_size=8).filter(
    lambda name: name.strip() == name and name[0] != "\ufeff"
)


@st.composite
def files(draw, damage):
    """Return names of the columns, fields of the rows, and the text of a file."""
    header = draw(st.lists(names, min_size=1, max_size=5, unique=not damage))
    count = len(header)
    more = draw(st.integers(0, 2))  # empty fields after each row
    rows = []
    for _ in range(draw(st.integers(2, 8))):
        row = [draw(cells(damage)) for _ in range(count)] + [""] * more
        if damage and draw(st.integers(0, 15)) == 0:
            row = draw(st.sampled_from([row[:-1], [*row, "1"], [*row, ""], row[1:], [*row[:1], "2", *row[1:]]]))
        rows.append(row)
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator=end, quoting=draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL])))
    for line in draw(st.lists(st.sampled_from(["# rig", "Date, 1", "", "  "]), max_size=3)):
        text.write(line + end)
    writer.writerow([*header, *[""] * (more if draw(st.booleans()) else 0)])
    for row in rows:
        writer.writerow(row)
        if draw(st.integers(0, 15)) == 0 and count > 1:
            text.write(end)
    whole = text.getvalue()
    if draw(st.booleans()):
        whole = whole[: -len(end)]
    return header, rows, ("\ufeff" if draw(st.booleans()) else "") + whole


def value(cell):
    """Return the number of a cell, NaN for a missing one, None for anything else."""
    if cell.strip(" \t") in MISSING:
        return np.nan
    return float(cell) if NUMBER.fullmatch(cell) else None


def expected(header, rows, used):
    """Return the columns, or None if the file has to be refused."""
    if len(header) > 1:
        rows = [row for row in rows if len(row) > 1 or any(cell.strip() for cell in row)]
    else:
        last = max((i for i, row in enumerate(rows, 1) if row), default=0)
        rows = [row or [""] for row in rows[:last]]
    if not rows:
        return None
    count = len(header)
    if min(map(len, rows)) < count or any(any(map(str.strip, row[count:])) for row in rows):
        return None
    if any(header.count(name) > 1 for name in used):
        return None
    columns = {name: [row[header.index(name)] for row in rows] for name in used}
    columns = {
        name: [LOGICAL[cell] for cell in column] if LOGICAL.keys() >= {*column} else [*map(value, column)]
        for name, column in columns.items()
    }
    if any(x is None for values in columns.values() for x in values):
        return None
    return {name: np.array(values) for name, values in columns.items()}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("csv") / "run.csv"


@given(files(damage=False), st.data())
def test_intact_files_are_read_exactly(path, file, data):
    header, rows, text = file
    path.write_bytes(text.encode())
    used = data.draw(st.lists(st.sampled_from(header), min_size=1, unique=True))
    channels = {f"c{i}": name for i, name in enumerate(used)}
    recording = bp.Recording.from_csv(path, sampling_rate=2.0, outputs=channels)
    wanted = expected(header, rows, used)
    for channel, name in channels.items():
        np.testing.assert_array_max_ulp(recording.outputs[channel], wanted[name], 1)


@given(files(damage=True), st.sampled_from([None, "drop", "interpolate"]), st.data())
def test_damaged_files_are_read_as_they_are_or_refused(path, file, missing, data):
    header, rows, text = file
    path.write_bytes(text.encode())
    used = data.draw(st.lists(st.sampled_from(header), min_size=1, unique=True))
    channels = {f"c{i}": name for i, name in enumerate(used)}
    wanted = expected(header, rows, used)
    try:
        recording = bp.Recording.from_csv(path, sampling_rate=2.0, outputs=channels, missing=missing)
    except ValueError as error:
        assert "run" in str(error) and "must" in str(error)
        lost = wanted is not None and not all(np.isfinite(values).all() for values in wanted.values())
        assert wanted is None or lost or len({*map(len, rows)}) > 1, "an intact file is refused"
        return
    assert wanted is not None, "a damaged file is read"
    lost = np.any([np.isnan(values) for values in wanted.values()], axis=0)
    assert missing or not lost.any()
    assert all(np.isfinite(values[~lost]).all() for values in wanted.values())
    for channel, name in channels.items():
        if missing == "interpolate":
            inside = np.isin(np.arange(lost.size) / 2.0, recording.time)
            assert inside[~lost].all()
            measured = wanted[name][inside]
            known = ~np.isnan(measured)
            np.testing.assert_array_max_ulp(recording.outputs[channel][known], measured[known], 1)
        else:  # samples are left out of their own channel
            keep = ~np.isnan(wanted[name])
            np.testing.assert_allclose(recording.times[channel], np.flatnonzero(keep) / 2.0)
            np.testing.assert_array_max_ulp(recording.outputs[channel], wanted[name][keep], 1)


@pytest.mark.parametrize("word", ["N/A", "NaN", "n/a"])
@pytest.mark.parametrize("width", [1, 2])
def test_first_row_of_missing_values_is_a_sample(path, word, width):
    """N/A is newton per ampere too, so that the row was taken for units and the sample lost."""
    rows = ["ab"[:width], word * width, "1" * width, "2" * width, "3" * width]
    path.write_text("\n".join(",".join(row if row != word * width else [word] * width) for row in rows) + "\n")
    with pytest.raises(ValueError, match="must be finite"):
        bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"a": "a"})
    recording = bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"a": "a"}, missing="drop")
    np.testing.assert_array_equal(recording.times["a"], [0.5, 1.0, 1.5])


@pytest.mark.parametrize("blank", ["\u00a0", "\u2028", "\u3000"])
@pytest.mark.parametrize("place", [1, 2])
def test_blanks_of_other_alphabets_are_no_part_of_a_number(path, blank, place):
    """At the end of a file of one column they were dropped, elsewhere refused."""
    cells = ["0.5", "1.5", "2.5"]
    cells[place] += blank
    path.write_text("\n".join(["a", *cells]), encoding="utf-8")
    with pytest.raises(ValueError, match="must contain numbers"):
        bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"a": "a"})


@pytest.mark.parametrize("word", ["na", "k.A.", "pp", "EU", "pk"])
def test_words_for_no_unit_are_no_units(path, word):
    """Each of them is a unit of pint, "pp" of 0.35 mm."""
    path.write_text(f"t,x\ns,{word}\n0,1\n1,2\n")
    with pytest.raises(ValueError, match=r"units\['x'\]: must say what"):
        bp.Recording.from_file(path, time="t", outputs={"x": "x"})
    recording = bp.Recording.from_file(path, time="t", outputs={"x": "x"}, units={"x": 1.0})
    np.testing.assert_array_equal(recording.outputs["x"], [1.0, 2.0])


def test_byte_order_mark_before_the_first_number_is_no_part_of_it(path):
    """As where files are joined; elsewhere it shows damage."""
    path.write_text("a,b\n\ufeff1.5,1\n2,3\n", encoding="utf-8")
    recording = bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"a": "a"})
    np.testing.assert_array_equal(recording.outputs["a"], [1.5, 2.0])
    path.write_text("a,b\n1.5,1\n\ufeff2,3\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must contain numbers"):
        bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"a": "a"})


@pytest.mark.parametrize(
    ("cells", "wanted"),
    [
        (["True", "False", "True"], [1, 0, 1]),
        (["TRUE", "false", "FALSE"], [1, 0, 0]),
        (["True", "1.5", "False"], None),
        (["True", "", "False"], None),
    ],
)
def test_logical_columns_are_ones_and_zeros(path, cells, wanted):
    path.write_text("\n".join(["gate,x", *(f"{cell},{k}" for k, cell in enumerate(cells)), ""]))
    if wanted is None:
        with pytest.raises(ValueError, match="must"):
            bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"gate": "gate"})
        return
    recording = bp.Recording.from_csv(path, sampling_rate=2.0, outputs={"gate": "gate"})
    np.testing.assert_array_equal(recording.outputs["gate"], wanted)
    assert "logical values, 1 for True and 0 for False" in str(bp.inspect(path))


@given(
    st.lists(
        st.tuples(st.sampled_from(["a", "b", "1.5", "a, b", "-2", "ß"]), st.integers(2, 5)), min_size=1, max_size=6
    ),
    st.lists(st.booleans(), min_size=30, max_size=30),
    st.booleans(),
)
def test_segments_of_a_split_file_make_up_the_file(path, parts, lost, restart):
    """Each segment is a run of equal labels, with its own times; rows without a value are left out of it."""
    labels = [label for label, count in parts for _ in range(count)]
    rows = np.arange(len(labels))
    first = np.array([i for _, count in parts for i in range(count)])
    times = first if restart else rows
    lost = np.array(lost[: rows.size])
    lost[first < 2] = False
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["run", "t", "x"])
        table.writerows(
            [label, t, "" if gone else 7.0 * i] for label, t, i, gone in zip(labels, times, rows, lost, strict=True)
        )
    merged = any(one == other for (one, _), (other, _) in zip(parts, parts[1:], strict=False))
    arguments = {"time": "t", "outputs": {"x": "x"}, "split": "run", "missing": "drop"}
    if merged and restart:
        with pytest.raises(ValueError, match="time: must increase"):
            bp.Recording.from_csv(path, **arguments)
        return
    runs = bp.Recording.from_csv(path, **arguments)
    assert len(runs) == 1 + sum(one != other for one, other in zip(labels, labels[1:], strict=False))
    assert np.concatenate([run.outputs["x"] for run in runs]).tolist() == (7.0 * rows[~lost]).tolist()
    assert np.concatenate([run.time for run in runs]).tolist() == times[~lost].tolist()
