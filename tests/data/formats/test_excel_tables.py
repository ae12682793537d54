"""Tables of sheets by their rows alone: names, units and the first row of data, cells of each kind, and refusals."""

import datetime
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from bayesperiodic.data.formats import excel
from bayesperiodic.data.formats.contents import StoredChannel

DATA = [(0.0, 1.5, 2), (0.5, 2.5, 3), (1.0, 3.5, 4)]
DATE, CLOCK = datetime.datetime(2026, 1, 31, 12), datetime.time(12, 30)
T, UNITS = ("t", "x", "y"), ("s", "mm", "N")


@pytest.mark.parametrize(
    "rows, line, names, units, first, remark",
    [
        ([T], None, [*T], ["", "", ""], 1, "names in row 1"), ([("Rig 3",),
        (), T], None, [*T], ["", "", ""], 3, "row 3"),
        ([T, UNITS], None, [*T], [*UNITS], 2, "names in row 1"),
        ([UNITS, T], None, [*T], [*UNITS], 2, "names in row 2"),
        ([T, ("Unit:", "[mm]", "(N)")], None, [*T], ["", "mm", "N"], 2, "names in row 1"),
        ([], None, ["column 1", "column 2", "column 3"], ["", "", ""], 0, "no names: columns by number"),
        ([("Rig 3",)], None, ["column 1", "column 2", "column 3"], ["", "", ""], 1, "no names: columns by number"),
        ([("t [ms]", "x", "F [kN]")], None, ["t [ms]", "x", "F [kN]"], ["ms", "", "kN"], 1, "names in row 1"),
        ([("t", None, "y")], None, ["t", "column 2", "y"], ["", "", ""], 1, "names in row 1"),
        ([T, UNITS], 1, [*T], [*UNITS], 2, "names in row 1"), ([T, UNITS, ("a", "b", "c")], 3, ["a", "b", "c"],
        [*UNITS], 3, "names in row 3"), ([UNITS, T], 2, [*T], [*UNITS], 2, "names in row 2"),
        ([T], 0, ["column 1", "column 2", "column 3"], ["", "", ""], 1, "no names: columns by number"),
        ([T, (1, 2, 3)], None, [*T], ["", "", ""], 1, "names in row 1"),
        ([("t", "x")], None, ["t", "x", "column 3"], ["", "", ""], 1, "names in row 1"),
        ([("t", "x", "y", "z")], None, ["t", "x", "y", "z"], ["", "", "", ""], 1, "names in row 1"),
    ],
)  # fmt: skip
def test_tables_of_sheets(rows, line, names, units, first, remark):
    table = excel._table([*rows, *DATA], line)
    assert (table.names, table.units, table.first) == (names, units, first) and remark in table.remark


@pytest.mark.parametrize(
    "rows, line, message",
    [
        ([T, ("OL", 1, 2)], None,
         "got None, and row 2 has the cell 'OL' beside numbers; correct the cell, or give the row"),
        ([T, (1, "OL", 2)], 1,
         "got 1, and row 2 has the cell 'OL' beside numbers; correct the cell, or give the row of"),
        ([T, ("Takte", "Impulse", "Worte")], None,
         "got None, as row 2 may be names or units, ['Takte', 'Impulse', 'Worte'];"),
        ([("a", "b", "c"),
        ("a", "b", "c")], None, "got None, as row 2 may be names or units, ['a', 'b', 'c']; give the"),
        ([("a", "b", "c"),
        ("t", "m", "N")], None, "got None, as row 2 may be names or units, ['t', 'm', 'N']; give the"),
        ([T, ("Takte", "Impulse", "Worte")], 1, "got 1, and row 2 has neither numbers nor known units."),
        ([("a", "b", "c"), UNITS, T], None,
         "got None, as row 2 may be units, and it is not the one below the names; give"),
    ],
)  # fmt: skip
def test_unclear_rows_above_a_table_are_refused_with_their_number(rows, line, message):
    with pytest.raises(ValueError, match=f"^header: must be .*{re.escape(message)}"):
        excel._table([*rows, *DATA], line)


def test_sheets_without_values_have_no_table():
    for rows in ([("a", "b"), ("c", "d")], [(None, ""), ("#N/A", None)], [("x",), ("1,5",)]):
        assert excel._table(rows, None) is None
    assert excel._table([*DATA], 5) is None


def test_columns_of_values_have_them_in_half_of_their_cells():
    """Counted in the last third of the rows, below what may stand above a table."""
    half = [("t", "x")] + [(float(k), "OL" if k % 2 else 1.0) for k in range(30)]
    assert excel._table(half, None).first == 1
    table = excel._table([("t", "x")] + [(float(k), "OL" if k % 3 else 1.0) for k in range(30)], None)
    assert table.names == ["t", "x"] and table.first == 1
    # Notes are none, although a third of them are numbers: the first row is one of the table.
    notes = [(float(k), *(("ok", "ok") if k % 3 else (1.0, 2.0))) for k in range(1, 31)]
    assert excel._table([("t", "a", "b"), *notes], None).first == 1


@pytest.mark.parametrize(
    "cells, expected",
    [
        ([0.5, 2, None], [0.5, 2.0, np.nan]), ([1, "#N/A", ""], [1.0, np.nan, np.nan]), ([True, False], [True, False]),
        ([True, None], [1.0, np.nan]), ([True, 5], [1.0, 5.0]), ([None, None], [np.nan, np.nan]),
    ],
)  # fmt: skip
def test_cells_of_numbers(cells, expected):
    values = excel._values(Path("x"), "s", 0, 0, cells)
    assert np.array_equal(values, expected, equal_nan=values.dtype == float)
    assert values.dtype == (bool if isinstance(expected[0], bool) else float)
    texts = excel._values(Path("x"), "s", 0, 0, ["a", None, 1])
    assert texts.dtype == object and texts[0] == "a" and texts[1] != texts[1] and texts[2] == 1


def column(cells, formula=None, date_format=None, name="x", unit=""):
    table = excel._Sheet([name], [unit], 4, [()] * 4 + [(cell,) for cell in cells], "")
    return excel._channel(Path("run.xlsx"), "sheet", name, 0, table, formula, date_format)


@pytest.mark.parametrize(
    "cells, remarks, refusal",
    [
        ([1.0, None], (), ""), ([DATE, None], ("dates, to the microsecond",), ""),
        ([CLOCK], ("times of day or durations",), ""),
        ([CLOCK, datetime.timedelta(1)], ("times of day or durations",), ""), (["a", "b"], (), ""),
        ([1.0, " 1,5 "], (),
         "numbers that are stored as texts, such as ' 1,5 ' in row 6; convert them in Excel (Data, Text"),
        ([DATE, 1.0], (),
         "dates among other values, or times beyond 24 h among times of day; format the column as numbers"),
        ([DATE, CLOCK], (), "dates among other values"), ([DATE, "a"], (), "dates among other values"),
        ([DATE, datetime.date(2026, 1, 31)], ("dates, to the microsecond",), ""),
    ],
)  # fmt: skip
def test_columns_of_each_kind_of_cells(cells, remarks, refusal):
    seen = column(cells)
    assert seen.remarks == remarks and seen.refusal.startswith(refusal) and bool(seen.refusal) == bool(refusal)
    assert (seen.name, seen.group, seen.samples) == ("x", "sheet", len(cells))
    shown = column([1.0], formula=7).refusal
    assert shown == "a formula without a value in row 7; open and save the file in Excel, which computes it"


def test_texts_of_dates_in_a_format_that_is_given():
    seen = column(["31.01.26", None, "01.02.26"], date_format="%d.%m.%y", unit="s")
    assert seen.remarks == ("dates in the format '%d.%m.%y', as given",) and seen.unit == "s" and seen.samples == 3
    assert np.isnat(seen.values()).tolist() == [False, True, False]
    assert (seen.values()[2] - seen.values()[0]) / np.timedelta64(1, "D") == 1.0
    assert column(["31.01.26"], date_format="%Y").values().tolist() == ["31.01.26"]
    assert column(["31.01.26"]).values().dtype == object


@pytest.mark.parametrize(
    "times, expected",
    [
        ([0, 999_999, 2_000_001], [0, 1_000_000, 2_000_000]), ([0, 999_998, 2_000_000], [0, 999_998, 2_000_000]),
        ([0, 1001, 1999], [0, 1000, 2000]), ([0, 101, 299], [0, 100, 300]), ([0, 11, 29], [0, 10, 30]),
        ([0, 3, 6], [0, 3, 6]),
        ([0, 12, 29], [0, 12, 29]), ([], []),
    ],
)  # fmt: skip
def test_times_are_multiples_of_the_longest_unit_within_a_microsecond(times, expected):
    given = np.array([*times, "NaT"], "timedelta64[us]")
    result = excel._on_grid(given)
    assert result[:-1].astype(int).tolist() == expected and np.isnat(result[-1])


@pytest.mark.parametrize(
    "cells, times",
    [
        ([0.0, 1.0], True), ([0.0], False), ([0.0, 1.0, 0.0], False), ([0.0, "a", 1.0], False),
        ([None, 0.0, "", 1.0], True),
        ([DATE, CLOCK], True), ([], False),
    ],
)  # fmt: skip
def test_times_change_from_the_first_to_the_last_cell(cells, times):
    table = excel._Sheet(["t"], [""], 1, [("t",), *((cell,) for cell in cells), ()], "")
    assert excel._may_be_times(table, 0) == times


@pytest.mark.parametrize(
    "unit, percents, left, remarked, refused",
    [
        ("%", {True}, "", True, False), ("%", {False}, "%", False, False), ("%", set(), "%", False, False),
        ("%", {True, False}, "%", False, True), ("%/s", {True}, "%/s", False, True),
    ],
)  # fmt: skip
def test_cells_in_the_format_of_percents_are_ratios(unit, percents, left, remarked, refused):
    seen = excel._without_percent(StoredChannel("x", 1, np.zeros, unit=unit), percents)
    assert seen.unit == left and bool(seen.remarks) == remarked and bool(seen.refusal) == refused
    assert not remarked or seen.remarks == (
        "cells in the format of percents, which store a hundredth: a ratio without a unit",
    )
    assert not refused or seen.refusal.startswith(
        f"the unit {unit!r} and cells in the format of percents, which store a hund"
    )
    before = excel._without_percent(StoredChannel("x", 1, np.zeros, unit="%/s", refusal="other"), {True})
    assert before.refusal == "other"


class Sheet:
    """A sheet of given rows."""

    title = "one"

    def __init__(self, rows):
        self.rows = rows

    def reset_dimensions(self):
        """Forget the stated size."""

    def iter_rows(self, values_only):
        """Return the values of the rows."""
        assert values_only
        return iter(self.rows)


def test_sheets_have_the_size_of_those_of_excel_at_most(monkeypatch):
    monkeypatch.setattr(excel, "MOST_ROWS", 3)
    monkeypatch.setattr(excel, "MOST_SHEET_COLUMNS", 2)
    assert excel._rows(Sheet([(1, 2), (None, 3), (None, None)])) == [(1, 2), (None, 3)]
    for rows in ([(1,)] * 4, [(1, 2, 3)]):
        with pytest.raises(ValueError, match="its sheet 'one' has more rows or columns than Excel allows"):
            excel._rows(Sheet(rows))
    assert excel._rows(Sheet([(None,), ()])) == []


@pytest.mark.parametrize(
    "row, columns, data",
    [
        ((1, 2), [0, 1], True), ((1, None), [0, 1], True), ((1,), [0, 1], True), ((None, "#N/A"), [0, 1], False),
        ((1, "x"), [0, 1], False), ((1, "x"), [0], True), ((DATE, CLOCK), [0, 1], True), ((), [0], False),
        ((1, 2), [], False),
        ((True, " "), [0, 1], True), (("x", 1), [1], True), (("x", "y"), [0, 1], False),
    ],
)  # fmt: skip
def test_rows_of_data_have_values_and_nothing_else_in_the_columns_of_values(row, columns, data):
    assert excel._is_data(row, columns) is data


def test_cells_of_a_row_are_texts_without_blanks_around_them():
    assert excel._texts((" a ", None, 5, 1.5, "b"), 4) == ["a", "", "5", "1.5"]
    assert excel._texts(("a",), 3) == ["a", "", ""] and excel._texts((), 0) == []
    assert excel._given((" ", None, "#N/A", "#N/A N/A", 0, "x", False)) == [0, "x", False]


ABOVE = [("t", "x"), (1, "OL"), ("s", "mm"), ("OL", 2), (3, 4)]
BESIDE = (
    "header: must be the number of a row with only rows of numbers below it, got {!r}, and row {} has the cell 'OL' "
)


@pytest.mark.parametrize(
    "first, line, columns, row",
    [
        (4, None, [0, 1], 4), (4, 0, [0, 1], 4), (4, 1, [0, 1], 2), (4, 2, [0, 1], 4), (4, 3, [0, 1], 4),
        (3, None, [0, 1], None),
        (2, None, [0, 1], 2), (2, None, [0], None), (2, None, [1], None), (2, 1, [0, 1], 2), (3, 2, [0, 1], None),
        (0, None, [0, 1], None), (1, None, [0, 1], None), (0, 0, [0, 1], None), (4, 1, [1], None), (4, None, [1], None),
        (4, None, [0, 1, 2], 4),
    ],
)  # fmt: skip
def test_rows_of_the_table_above_the_data_are_not_lost(first, line, columns, row):
    """Below the names that are given all rows are looked at, else that next to the data."""
    if row is None:
        excel._refuse_lost(ABOVE, first, line, columns)
        return
    with pytest.raises(ValueError, match=f"^{re.escape(BESIDE.format(line, row))}beside numbers; correct the cell, or"):
        excel._refuse_lost(ABOVE, first, line, columns)


ROWS = [
    ("Rig", None, None),
    ("s", "mm", "N"),
    ("t", "x", "y"),
    ("Unit:", "m", "kN"),
    ("one", "two", "three"),
    ("t", "x"),
]


@pytest.mark.parametrize(
    "above, between, line, expected",
    [
        ([2], [], None, ["", "", ""]), ([1, 2], [], None, ["s", "mm", "N"]), ([0, 1, 2], [], None, ["s", "mm", "N"]),
        ([2], [3], 3, ["", "m", "kN"]), ([2], [4, 3], 3, ["", "m", "kN"]), ([2], [3, 1], 3, ["", "m", "kN"]),
        ([1, 2], [3], 3, ["", "m", "kN"]), ([4, 2], [], None, ["", "", ""]), ([0, 2], [], None, ["", "", ""]),
        ([1, 5], [], None, ["s", "mm", "N"]), ([4, 1, 2], [], 3, ["s", "mm", "N"]), ([], [], None, ["", "", ""]),
        ([4, 1, 2], [], None,
         "got None, as row 2 may be units, and it is not the one below the names; give the number of"),
        ([2, 4], [], None, ["", "", ""]), ([5, 1, 2], [], None, ["s", "mm", "N"]),
        ([2], [4], 3, "got 3, and row 5 has neither numbers nor known units."),
        ([2], [4, 0], 3, "got 3, and row 1 has neither numbers nor known units."),
    ],
)  # fmt: skip
def test_units_are_below_the_names_or_above_them(above, between, line, expected):
    if isinstance(expected, list):
        assert excel._units_around(ROWS, above, between, 3, line) == expected
        return
    with pytest.raises(ValueError, match=f"^header: must be .*{re.escape(expected)}"):
        excel._units_around(ROWS, above, between, 3, line)


@pytest.mark.parametrize(
    "upper, lower, refused",
    [
        (["t", "x"], ["s", "mm"], False), (["t", "x"], ["one", "two"], True), (["a", "x"], ["one", "two"], False),
        (["a", "x"], ["a", "x"], True), (["a", "x"], ["t", "N"], True), (["t", "x"], ["t", "N"], False),
        (["a", "x"], ["t", "mm"], False), (["t", "x"], ["time", "two"], False), (["t", ""], ["one", "two"], False),
        (["t", "x"], ["one", ""], False), (["a", "x"], ["N", "m"], False),
    ],
)  # fmt: skip
def test_rows_of_texts_that_may_be_names_or_units_are_refused(upper, lower, refused):
    if not refused:
        excel._refuse_doubtful(upper, lower, 7)
        return
    message = f"header: must be given, got None, as row 7 may be names or units, {lower}; give the number of the row of"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        excel._refuse_doubtful(upper, lower, 7)


@pytest.mark.parametrize(
    "size, packed, refused", [(100, True, False), (101, True, True), (101, False, False), (1000, False, False),
                              (1001, False, True)]
)  # fmt: skip
def test_members_that_unpack_to_much_more_than_sheets_are_refused(tmp_path, monkeypatch, size, packed, refused):
    """Zeros are packed to fewer than 50 bytes."""
    for name, value in {"SMALL_MEMBER": 100, "LARGEST_RATIO": 2, "LARGEST_ARRAY": 1000}.items():
        monkeypatch.setattr(excel, name, value)
    with zipfile.ZipFile(tmp_path / "a", "w") as archive:
        archive.writestr("small", "1")
        archive.writestr("b", bytes(size), zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED)
    if not refused:
        excel._refuse_bombs(tmp_path / "a")
        return
    with pytest.raises(ValueError, match=f"^its member 'b' unpacks to {size / 1e9:.3g} GB$"):
        excel._refuse_bombs(tmp_path / "a")
