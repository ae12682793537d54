"""Rules for whole texts of columns: signs of numbers, times, summaries, numbers of fields, and wide files."""

import csv
import re

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import text
from bayesperiodic.data.formats.contents import StoredChannel
from bayesperiodic.data.formats.text import _Notation
from bayesperiodic.data.formats.text_header import Head


@pytest.fixture
def write(tmp_path):
    def written(content):
        path = tmp_path / "run.csv"
        path.write_text(content, "utf-8")
        return path

    return written


@pytest.mark.parametrize(
    "given, expected",
    [
        ((None, None, None), (None, None, None)), ((",", None, None), (",", None, None)), ((None, ".", None),
        (",", ".", None)),
        ((None, ",", None), (".", ",", None)), ((None, "'", None), (None, "'", None)), ((",", " ", "%H"),
        (",", " ", "%H")),
        ((".", "\u202f", None), (".", "\u202f", None)),
    ],
)  # fmt: skip
def test_a_sign_between_thousands_leaves_the_other_one(given, expected):
    assert text._notation(*given) == _Notation(*expected)


@pytest.mark.parametrize(
    "given, message",
    [
        ((";", None, None), "decimal: must be one of '.', ',', got ';'"),
        ((None, "x", None), "thousands: must be one of '.', ',', \"'\""),
        ((",", ",", None), "thousands: must differ from decimal, got ',' for both."),
        ((None, None, "d.m.y"), "date_format: must be a format such as '%d.%m.%Y %H:%M:%S.%f', got 'd.m.y'."),
        ((None, None, 5), "date_format: must be "),
    ],
)
def test_other_signs_and_formats_are_refused(given, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        text._notation(*given)


@pytest.mark.parametrize(
    "content, remark",
    [
        ("t,x\n0,1\n1,2\n", "separator ',', names in line 1"), ("t,x\n0,1.5\n1,2\n", "names in line 1, decimal point"),
        ("t;x\n0;1,5\n1;2\n", "separator ';', names in line 1, decimal comma"),
        ("t;x\n0;1.5\n1;2\n", "line 1, decimal point"),
        ("t,x\n0,1.500\n1,2.500\n", "separator ',', names in line 1, decimal point"),
        ("t;x\n0;1'234\n1;2'345\n", "names in line 1"), ("t;x\n0;1,234\n1;2,345\n", "names in line 1"),
        ("t;x\n0;1,234,567\n1;2\n", "names in line 1, decimal point"), ("t;x\n0;1.234.567\n1;2\n", "decimal comma"),
        ("t;x\n0;a\n1;b\n", "names in line 1"), ("t;x\n0;12.03.2026\n1;13.03.2026\n", "names in line 1"),
        ("t,x\n0,1.500\n1,2\n", "names in line 1, decimal point"),
    ],
)  # fmt: skip
def test_decimal_sign_that_was_recognised_is_remarked(write, content, remark):
    shown = bp.inspect(write(content)).remarks[0]
    assert shown.endswith(remark)


@pytest.mark.parametrize(
    "cells, given, values, remark",
    [
        (["1,5", "2"], ",", [1.5, 2.0], ", decimal comma"), (["1", "2"], ",", [1, 2], ""),
        (["1.5", "2"], ".", [1.5, 2.0],
        ", decimal point"), (["1.234", "2"], ",", [1234.0, 2.0], ", decimal comma"),
        (["1.234", "2.500"], ".", [1.234, 2.5],
        ", decimal point"), (["1,234", "2"], ".", [1234.0, 2.0], ", decimal point"),
    ],
)  # fmt: skip
def test_decimal_sign_that_is_given_is_used_and_remarked_where_it_occurs(write, cells, given, values, remark):
    path = write("n;x\n" + "".join(f"{k};{cell}\n" for k, cell in enumerate(cells)))
    whole = text.contents(path, [], decimal=given)
    assert whole.channels[1].values().tolist() == values
    assert whole.remarks == (f"separator ';', names in line 1{remark}",)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32", "cp1252"])
@pytest.mark.parametrize("rows", [4, 4000])
def test_summaries_at_the_end_of_texts_of_any_encoding_are_refused(tmp_path, encoding, rows):
    path = tmp_path / "run.csv"
    body = "t,größe,state\n" + "".join(f"{k},{k}.5,max\n" for k in range(rows))
    assert (len(body) > text.TAIL_BYTES) == (rows > 1000)
    path.write_text(body, encoding)
    assert text.contents(path, ["t"]).channels[0].samples == rows  # of a column of texts the words are values
    for row in ("Mean,2.5,max", "7,Mittelwert,max", "  min ,1.5", "end of test,1,"):
        path.write_text(body + row + "\n", encoding)
        with pytest.raises(
            ValueError, match=f"whose row .*{row.split(',')[0].strip()}.* seems to be a summary; remove it"
        ):
            text.contents(path, ["t"])


@pytest.mark.parametrize("numbers, refused", [(0, False), (1, False), (2, True), (3, True), (4, True)])
def test_summaries_stand_in_columns_half_of_which_are_numbers(write, numbers, refused):
    """Of the first rows, to which the last one belongs here."""
    cells = [*(f"{k}.5" for k in range(numbers)), *["sum"] * (4 - numbers)]
    path = write("t,x\n" + "".join(f"{k},{cell}\n" for k, cell in enumerate([*cells[::-1]][:4])))
    if refused and numbers < 4:
        with pytest.raises(ValueError, match="seems to be a summary"):
            text.contents(path, ["t"])
    else:
        assert text.contents(path, ["t"]).channels[0].samples == 4


@pytest.mark.parametrize(
    "content, suggested",
    [
        ("t,x\n0,1\n1,2\n", "t"), ("a,x\n0,2\n1,2\n", None), ("x,Time [s]\n1,0\n2,1\n", "Time [s]"),
        ("t,x\n1,1\n0,2\n", None),
        ("t,x\n0,1\n0,2\n", None), ("t,x\n0,1\n", None), ("a [ms],x\n0,1\n1,2\n", "a [ms]"),
        ("a [mm],x\n0,2\n1,2\n", None),
        ("x [s],t\n0,1\n1,2\n", "t"), ("a,x\n10:00:00,1\n10:00:01,2\n", "a"), ("a,x\n10:00:00,1\n10:00:00,2\n", None),
        ("a,x\n2026-01-31T10:00:00,1\n2026-01-31T10:00:01,2\n", "a"), ("t,x\nOL,1\n1,2\n2,3\n", None),
    ],
)  # fmt: skip
def test_suggested_time_increases_and_has_a_name_a_unit_or_dates(write, content, suggested):
    try:
        code = bp.inspect(write(content)).code
    except ValueError:
        assert "OL" in content
        return
    assert (f"time={suggested!r}" in code) if suggested else "time=" not in code


ROWS = "".join(f"{k},{k + 0.5},{k % 3}\n" for k in range(40))


@pytest.mark.parametrize(
    "row, refused",
    [
        ("Mean,20,1", True), ("  max. ,39.5,2", True), ("RMS:,20,1", True), ("Mean,,", False), ("Mean,a,b", False),
        ("means,1,2", False), ("40,Sum,3", True), ("40,5,OL", False),
    ],
)  # fmt: skip
def test_summaries_stand_in_a_column_of_numbers_beside_numbers(write, row, refused):
    path = write("t,x,y\n" + ROWS + row + "\n")
    if refused:
        with pytest.raises(
            ValueError, match="path: must be a CSV file with a sample in each row, .* seems to be a summary; r"
        ):
            bp.inspect(path)
    else:
        assert bp.inspect(path).channels[0].samples == 41


@pytest.mark.parametrize("after, refused", [(19, True), (20, False)])
def test_summaries_are_among_the_last_twenty_rows(write, after, refused):
    path = write("t,x,y\n" + ROWS + "Mean,20,1\n" + "".join(f"{k},{k + 0.5},1\n" for k in range(after)))
    if refused:
        with pytest.raises(ValueError, match="seems to be a summary"):
            bp.inspect(path)
    else:
        assert bp.inspect(path).channels[1].samples == 41 + after


@pytest.mark.parametrize(
    "rows, fields, number",
    [("0,1\n1,2\n2,3,4\n", 3, 3), ("0,1\n1\n2,3\n", 1, 2), ("0,1\n\n1,2,3\n", 3, 2), ("0,1,5\n1,2\n", 3, 1)],
)
def test_rows_of_other_numbers_of_fields_are_named(write, rows, fields, number):
    message = f"with 2 fields in each row, as many as there are names, got {fields} in data row {number} of"
    with pytest.raises(ValueError, match=message):
        bp.Recording.from_csv(write("t,x\n" + rows), sampling_rate=1.0, outputs={"x": "x"}, missing="drop")


@pytest.mark.parametrize("limit", [1, 10**9])
@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_wide_files_are_read_like_narrow_ones(write, monkeypatch, limit, separator):
    monkeypatch.setattr(text, "NARROW_COLUMNS", limit)
    names = [f"c{k}" for k in range(9)]
    rows = [[f"{k * j % 7}.5" for j in range(9)] for k in range(30)]
    path = write("\n".join(separator.join(row) for row in [names, *rows]) + "\n\n")
    run = bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"a": "c8", "b": "c3"}, inputs={"u": "c0"})
    for channel, place in (("a", 8), ("b", 3), ("u", 0)):
        values = (run.outputs | run.inputs)[channel]
        assert values.tolist() == [k * place % 7 + 0.5 for k in range(30)]


def test_columns_that_were_not_wanted_are_read_when_they_are_asked_for(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,x,y,z\n0,1.5,a,1,\n1,2.5,b,2,\n".replace(",\n", "\n"))
    whole = text.contents(path, ["x"])
    channels = {channel.name: channel for channel in whole.channels}
    assert channels["x"].values().tolist() == [1.5, 2.5] and channels["z"].values().tolist() == [1, 2]
    assert channels["y"].values().tolist() == ["a", "b"] and channels["t"].samples == 2
    path.write_text("t;x\n0;1,234\n1;2,345\n")
    with pytest.raises(
        ValueError, match="its column 2 has numbers such as '1,234', whose comma may be the decimal sign or"
    ):
        text.contents(path, ["t"]).channels[1].values()


def test_several_columns_of_a_name_need_the_number(write):
    path = write("t,x,x\n0,1,2\n1,2,3\n")
    with pytest.raises(
        ValueError, match=r"must be the name of one column, got 'x', the name of 2 \(columns 2, 3\); give its"
    ):
        bp.Recording.from_csv(path, time="t", outputs={"x": "x"})
    assert bp.Recording.from_csv(path, time="t", outputs={"x": "x (1)"}).outputs["x"].tolist() == [1, 2]


@pytest.mark.parametrize("content", ["t,x\n", "t,x\n\n\n", "x\n"])
def test_names_without_rows_are_refused(write, content):
    with pytest.raises(
        ValueError, match="path: must be a CSV file with rows of data, got .*, which has none|no rows of numbers"
    ):
        bp.Recording.from_csv(write(content), sampling_rate=1.0, outputs={"x": "x"})


def test_second_table_is_named_with_the_row_of_its_name(write):
    content = "t,x\n0,1\n1,2\nt,x\n0,5\n"
    with pytest.raises(
        ValueError, match="got the name 'x' again in data row 3: the file has several tables; save each"
    ):
        bp.Recording.from_csv(write(content), sampling_rate=1.0, outputs={"x": "x"})


def test_logical_values_are_remarked_and_read_as_ones_and_zeros(write):
    path = write("t,x\n0,True\n1,False\n2,True\n")
    assert bp.inspect(path).channels[1].remarks == ("logical values, 1 for True and 0 for False",)
    assert np.array_equal(bp.Recording.from_csv(path, time="t", outputs={"x": "x"}).outputs["x"], [1.0, 0.0, 1.0])


@pytest.mark.parametrize("limit", [1, 10**9])
@pytest.mark.parametrize(
    "third, number",
    [
        ("5,6,7", None), ("5,6,7,", None), (" , , ", None), ("5,,7", None), ("5,6,", None), ("5,6", 3), ("5", 3),
        ("5,6,7,8", 3), (",", None), (" , ", None), ("5,6,7,,", 3), ("5,6,7, ,9", 3), ("5,6,7,,,,", 3),
    ],
)  # fmt: skip
def test_rows_have_as_many_fields_as_there_are_names_in_wide_files_too(write, monkeypatch, limit, third, number):
    """One more field that is empty is none; a row of blanks, or an empty cell, is a missing sample."""
    monkeypatch.setattr(text, "NARROW_COLUMNS", limit)
    path = write(f"a,b,c\n1,2,3\n3,4,5\n{third}\n7,8,9\n")
    if number:
        with pytest.raises(ValueError, match=f"3 fields in each row, .* in data row {number} of '.*run.csv'"):
            text.contents(path, ["b"])
    else:
        values = text.contents(path, ["b"]).channels[1].values()
        cell = third.split(",")[1].strip()
        assert values[[0, 1, 3]].tolist() == [2, 4, 8]
        assert np.isnan(values[2]) if not cell else values[2] == float(cell)


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_parts_of_different_kinds_are_read_below_a_preamble(write, monkeypatch, separator):
    """The first rows of a column are numbers, the last are texts; those of the others are all read."""
    monkeypatch.setattr(text, "PART_ROWS", 3)
    monkeypatch.setattr(text, "PART_CELLS", 3)
    rows = [[f"{k}.5", f"{10 + k}", f"{k}" if k < 8 else "bad"] for k in range(12)]
    table = "\n".join(separator.join(row) for row in [["time", "x", "b"], *rows])
    channels = text.contents(write(f"Recorded\n\n{table}\n"), []).channels
    assert [channel.name for channel in channels] == ["time", "x", "b"]
    assert channels[0].values().tolist() == [k + 0.5 for k in range(12)]
    assert channels[1].values().tolist() == [10 + k for k in range(12)]
    assert [str(value) for value in channels[2].values()] == [row[2] for row in rows]


@pytest.mark.parametrize("columns", [3, 201])
@pytest.mark.parametrize(
    "tails, sound",
    [((0, 0, 0), True), ((1, 1, 1), True), ((1, 2, 0), True), ((0, 1, 0), True), ((2, 1, 0), True), ((0, 2, 0), False),
     ((1, 3, 1), False)],
)  # fmt: skip
def test_rows_may_end_with_one_separator_more_than_the_first_one(tmp_path, columns, tails, sound):
    """In files of many columns too, of which few are read."""
    rows = [[str(k), str(1.5 * k), *["7"] * (columns - 2)] for k in range(3)]
    names = ["t", "x", *(f"c{k}" for k in range(columns - 2))]
    lines = [",".join(names), *(",".join(row) + "," * tail for row, tail in zip(rows, tails, strict=True))]
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
    given = {"time": "t", "outputs": {"x": "x"}}
    if sound:
        assert bp.Recording.from_file(tmp_path / "run.csv", **given).outputs["x"].tolist() == [0.0, 1.5, 3.0]
        return
    with pytest.raises(ValueError, match=f"{columns} fields in each row.* got {columns + tails[1]} in data row 2 of"):
        bp.Recording.from_file(tmp_path / "run.csv", **given)


def column_of(place, values, unit=""):
    return StoredChannel(f"c{place}", len(values), values.copy, unit=unit)


MOMENTS = [f"10:{k // 60:02d}:{k % 60:02d}" for k in range(250)]


@pytest.mark.parametrize(
    "place, suggested", [(None, "c1"), (0, ""), (99, ""), (100, "c1"), (149, "c1"), (150, ""), (249, "")]
)
def test_texts_are_times_if_the_first_and_last_hundred_are(place, suggested):
    """Those between them are not looked at; a column that is refused does not hide those after it."""
    texts = np.array(MOMENTS, dtype=object)
    if place is not None:
        texts[place] = "OL"
    numbers = np.arange(250.0)
    columns = [numbers, texts, numbers]
    channels = [column_of(k, values) for k, values in enumerate(columns)]
    for refusal in ("", "numbers such as '1,5'"):
        read = {k: (values, "", refusal if k == 0 else "") for k, values in enumerate(columns)}
        assert text._suggested_time(channels, read) == suggested


@pytest.mark.parametrize(
    "columns, suggested",
    [
        ([("s", [0, 1], ""), ("s", [0, 1], "")], "c0"), ([("s", [0, 1], "refused"), ("s", [0, 1], "")], "c1"),
        ([("s", [0, 1], "refused"), ("", [0, 1], "refused")], ""), ([("mm", [0, 1], ""), ("ms", [0.0, 0.5], "")], "c1"),
        ([("s", [1, 1], ""), ("h", [0, 1, 1], "")], ""), ([("min", [5], "")], ""), ([("s", [True, False], "")], ""),
        ([("s", [False, True], "")], ""), ([("Second", np.array([1, 2], dtype="u1"), "")], "c0"),
        ([("", np.array([1, 5], dtype="M8[s]"), "")], "c0"), ([("", np.array([5, 1], dtype="m8[s]"), "")], "c0"),
        ([("", np.array([5, 5], dtype="m8[s]"), "")], ""), ([("", np.array([5], dtype="M8[s]"), "")], ""),
        ([("s", ["a", "b"], "")], ""),
    ],
)  # fmt: skip
def test_suggested_time_is_the_first_usable_column_that_increases_or_has_dates(columns, suggested):
    arrays = [np.array(v, dtype=object) if isinstance(v[0], str) else np.asarray(v) for _, v, _ in columns]
    channels = [column_of(k, values, columns[k][0]) for k, values in enumerate(arrays)]
    read = {k: (values, "", columns[k][2]) for k, values in enumerate(arrays)}
    assert text._suggested_time(channels, read) == suggested


@pytest.mark.parametrize("key", ["x", ("", "x"), 2])
def test_wanted_columns_are_read_at_once_by_name_number_or_an_empty_group(write, monkeypatch, key):
    """They are not read a second time, and no time is suggested then."""
    path = write("t,x\n0,1.5\n1,2.5\n")
    whole = text.contents(path, [key])
    monkeypatch.setattr(text, "_columns", None)
    assert whole.channels[1].values().tolist() == [1.5, 2.5] and whole.suggested_time == ""
    with pytest.raises(TypeError):
        whole.channels[0].values()


@pytest.mark.parametrize("key", ["z", ("", "z")])
def test_wanted_column_that_is_not_there_is_named(write, key):
    with pytest.raises(ValueError, match="column of run.csv: must be one of 't', 'x', got 'z'"):
        text.contents(write("t,x\n0,1.5\n1,2.5\n"), [key])


@pytest.mark.parametrize("key", [0, 3, -1, True, ("a", "x"), ("", "x", "y")])
def test_other_keys_are_left_to_the_reader_of_all_formats(write, key):
    """All columns are read then."""
    assert text.contents(write("t,x\n0,1.5\n1,2.5\n"), [key]).channels[1].values().tolist() == [1.5, 2.5]


HEAD = Head(["t", "x"], 1, 0, ";")


@pytest.mark.parametrize(
    "cells, decimal, sure, given, titled, expected",
    [
        (["1.234,5", "2"], ",", True, {}, True,
         ([1234.5, 2.0], "numbers with signs between thousands, or exponents of Fortran", "")),
        (["1.5D+01", "2"], ".", False, {}, True,
         ([15.0, 2.0], "numbers with signs between thousands, or exponents of Fortran", "")),
        (["1,234", "2"], ".", False, {}, True,
         (None, "", "numbers such as '1,234', whose comma may be the decimal sign or stand between thousands; give "
          "decimal=',' or decimal='.'")),
        (["1,234", "2"], ".", True, {}, True,
         ([1234.0, 2.0], "numbers with signs between thousands, or exponents of Fortran", "")),
        (["1,234", "2"], ".", True, {"thousands": "'"}, True,
         (None, "", "numbers such as '1,234', which do not all have one decimal sign; give decimal= and thousands=")),
        (["1,5", "OL", "2"], ",", True, {}, True, (None, "",
         "'OL' in data row 2, which is no number, as 2 others are")),
        (["1.5", "OL", "2"], ".", True, {}, True, (None, "", "")),
        (["1", "2", "x", "3"], ".", False, {}, True,
         (None, "", "the name 'x' again in data row 3: the file has several tables; save each")),
        (["1", "", "nan", "x"], ".", False, {}, True,
         (None, "", "the name 'x' again in data row 4: the file has several tables; save each")),
        (["1", "2", "x", "3"], ".", False, {}, False, (None, "", "")),
        (["x", "1", "2"], ".", False, {}, True, (None, "", "")), (["a", "x"], ".", False, {}, True, (None, "", "")),
        (["1", "2", "y"], ".", False, {}, True, (None, "", "")),
        (["10:00", "10:01"], ".", False, {}, True,
         (None, "", "times such as '10:00', which may be hours and minutes or minutes and seconds; give "
          "date_format='%H:%M' or date_format='%M:%S'")),
    ],
)  # fmt: skip
def test_columns_of_texts_are_numbers_or_refused_with_a_reason(cells, decimal, sure, given, titled, expected):
    values, remark, refusal = expected
    head = Head(["t", "x", ""], 1, 0, ";", titled=titled)
    notation = _Notation(None, given.get("thousands"), None)
    read = text._converted(np.array(cells, dtype=object), decimal, sure, notation, head)
    assert read[0].tolist() == (cells if values is None else values) and read[1:] == (remark, refusal)


@pytest.mark.parametrize("form", [None, "%H:%M:%S"])
def test_columns_of_times_are_durations(form):
    cells = np.array(["10:00:00", "10:00:01"], dtype=object)
    values, said, refusal = text._converted(cells, ".", False, _Notation(None, None, form), HEAD)
    assert np.diff(values) == np.timedelta64(1, "s") and said.startswith("times of day, in seconds") and refusal == ""


@pytest.mark.parametrize(
    "rows, expected",
    [
        ([["1", "2", "3"], ["4", "5", "6", " "]], [["3", "1"], ["6", "4"]]), ([["1", "2", "é\n"]], [["é\n", "1"]]),
        ([["", " "], ["1", "2", "3"]], [["", ""], ["3", "1"]]), ([["1", "2", ""]], [["", "1"]]),
        ([[], [" "], ["1", "2", "3"]], [["3", "1"]]), ([["1", "2"]], None), ([["1"]], None),
        ([["1", "2", "3", "4"]], None),
        ([["1", "2", "3", "", ""]], None), ([["1", "2", "3", "", "5"]], None), ([], []),
    ],
)  # fmt: skip
def test_wanted_fields_of_rows_have_a_column_of_zeros_behind_them(rows, expected):
    """Lines of blanks alone are none; a row of fewer fields has none but blanks."""
    if expected is None:
        with pytest.raises(text._OtherFields, match="^rows have different numbers of fields$"):
            text._narrowed(rows, [2, 0], 3, 4)
        return
    with text._narrowed(rows, [2, 0], 3, 4) as narrow:
        assert [*csv.reader(narrow, delimiter="\x1f")] == [[*row, "0"] for row in expected]
