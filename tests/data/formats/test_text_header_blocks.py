"""Headers of texts by parts: blocks of numbers, rows that would be lost, and names and units around them."""

import re

import pytest

from bayesperiodic.data.formats import text_header

ROWS = ["0.5,1.5,2", "1.5,2.5,3", "2.5,3.5,4"]


def block(lines, separator=",", start=0):
    return text_header._block([line + "\n" for line in lines], separator, start)


@pytest.mark.parametrize(
    "lines, separator, start, width, columns, first, covered",
    [
        (ROWS, ",", 0, 3, [0, 1, 2], 0, 21), (["Rig", "t,x,y", *ROWS], ",", 0, 3, [0, 1, 2], 2, 21),
        (["", "t,x,y", "", *ROWS], ",", 0, 3, [0, 1, 2], 1, 21),  # empty lines are no rows
        (ROWS, ",", 1, 3, [0, 1, 2], 1, 14), ([*ROWS, "7,8"], ",", 0, 3, [0, 1, 2], 0, 21),
        (["1;2", "3;4", "5;6"], ",", 0, None, None, None, None), (["1,2", "3,4", "5,6"], ",", 0, 2, [0, 1], 0, 6),
        (["a,1", "b,2", "c,3"], ",", 0, 2, [1], 0, 3), (["a,1", "b,nan", "c,"], ",", 0, 2, [1], 0, 1),
        (["a,1", "b,x", "c,y"], ",", 0, None, None, None, None), (["a,1", "b,2", "c,y", "d,z"], ",", 0, None, None,
        None, None), (["a,1", "b,2", "c,3", "d,z"], ",", 0, 2, [1], 0, 2), (["a,b"], ",", 0, None, None, None, None),
        (["OL,1,2", *ROWS], ",", 0, 3, [0, 1, 2], 1, 21), (["nan,1,2", *ROWS], ",", 0, 3, [0, 1, 2], 0, 21),
        (["nan,1,OL", *ROWS], ",", 0, 3, [0, 1, 2], 0, 21), (["1,2,OL", *ROWS], ",", 0, 3, [0, 1, 2], 0, 21),
        (["1,OL,OL", *ROWS], ",", 0, 3, [0, 1, 2], 1, 21), (["nan,nan,nan", *ROWS], ",", 0, 3, [0, 1, 2], 1, 21),
        (["# t x", "1 2", "  3\t4", "5  6 "], " ", 0, 2, [0, 1], 1, 6), (["% 1 2", "3 4"], " ", 0, 2, [0, 1], 0, 4),
        (['"a,b",1', '"c",2'], ",", 0, 2, [1], 0, 2), ([], ",", 0, None, None, None, None),
        (["x" * 140_000, "1,2"], ",", 0, None, None, None, None), (["x" * 140_000, "1 2"], " ", 0, 2, [0, 1], 1, 2),
    ],
)  # fmt: skip
def test_block_of_numbers_of_a_separator(lines, separator, start, width, columns, first, covered):
    """Columns are those that are mostly numbers in the last third of the rows of one width, of three rows at least."""
    seen = block(lines, separator, start)
    if width is None:
        assert seen is None or not seen.columns or seen.width == 1
        return
    assert (seen.width, seen.columns, seen.first, seen.separator) == (width, columns, first, separator)
    assert seen.covered == covered


def test_rows_have_the_numbers_of_their_last_lines():
    assert [number for number, _ in block(["", 't,"x', 'y"', "", "1,2"]).rows] == [3, 5]
    assert [number for number, _ in block(["", "t x", "", "1 2"], " ").rows] == [2, 4]


def test_the_block_of_most_characters_is_taken_among_those_of_the_first_five_widths():
    """The widths are those of most rows."""
    few = [",".join(["1.2345678"] * 9)]
    assert block(["1,2"] * 5 + few * 3).width == 9 and block(["1,2"] * 200 + few).width == 2
    others = [",".join("7" * width) for width in (3, 4, 5, 6)]
    assert block(["1,2"] * 3 + others * 2 + few).width == 6 and block(["1,2"] * 3 + others[:3] * 2 + few).width == 9


@pytest.mark.parametrize(
    "lines, titled, line, message",
    [
        ([], False, None, None), ([], True, None, None), (["t,x,y"], True, None, None),
        (["t,x,-00:00:01"], True, None, "got None, as line 1 has neither names nor only numbers, ['t', 'x', '-00:"),
        (["t,x,-00:00:01"], True, 1, None), (["t,x,-00:00:01", "t,x,y"], True, None, None),
        (["OL,OL,OL"] * 2, True, None, "got None, as lines 1 and 2 are alike, ['OL', 'OL', 'OL']; give the number"),
        (["Rig", "", "OL,OL,OL", "OL,OL,OL"], True, None, "as lines 3 and 4 are alike"),
        (["OL,OL"] * 2, True, None, None),
        (["OL,,OL"] * 2, True, None, None), (["OL,OL,OL", "ol,OL,OL"], True, None, None),
        (["OL,OL,OL"] * 2, True, 1, None), (["OL,OL,OL"] * 2, False, None, None),
        (["OL,1,2"], False, None, "got None, and line 1 has the cell 'OL' above numbers, ['OL', '1', '2']; correct"),
        (["OL,1,2", "t,x,y"], False, None, None), (["OL,1,2"], False, 0, "got 0, and line 1 has the cell 'OL' above"),
        (["# OL,1,2"], False, None, None), ([" % OL,1,2"], False, None, None), (["OL,1"], False, None, None),
        (["t,x,y", "s,mm,N", "OL,1,2"], True, 1, "got 1, and line 3 has the cell 'OL' above numbers"),
        (["t,x,y", "by me", "# 1,2,3", "1,OL,OL"], True, 1, "got 1, and line 4 has the cell 'OL' above numbers"),
        (["OL,1,2", "t,x,y"], True, 2, None), (["OL,1,2", "t,x,y", "s,mm,N"], True, 2, None),
        (["t,x,y", "OL,1,2", "s,mm,N"], True, 1, "got 1, and line 2 has the cell 'OL' above numbers"),
        (["1,OL,OL"], False, None, "has the cell 'OL' above numbers, ['1', 'OL', 'OL']"),
    ],
)  # fmt: skip
def test_rows_of_the_table_above_the_data_are_not_lost(lines, titled, line, message):
    """Below a line of names that is given, all of them are looked at, and without one that next to the data."""
    seen = block([*lines, *ROWS], start=line or 0)
    if message is None:
        text_header._refuse_lost(seen, titled, line)
        return
    with pytest.raises(ValueError, match=f"^header: must be .*{re.escape(message)}"):
        text_header._refuse_lost(seen, titled, line)


UNITS = ["s", "mm", "N"]
AS_LINE = "header: must be given, got None, as line "


@pytest.mark.parametrize(
    "lines, line, expected",
    [
        (["t,x,y"], 0, ([], [])), ([], None, ([], [])),
        (["Rig", "s,m,kN", "t,x,y", "s,mm,N"], None, (["t", "x", "y"], UNITS)),
        (["t,x,y", "s,mm,N"], None, (["t", "x", "y"], UNITS)), (["t,x,y", "s,mm,N"], 1, (["t", "x", "y"], UNITS)),
        (["t,x,y", "a word", "s,mm,N"], 1, (["t", "x", "y"], UNITS)),
        (["t,x,y", "s,mm,N", "a word"], 1, (["t", "x", "y"], UNITS)),
        (["s,mm,N", "t,x,y"], None, (["t", "x", "y"], UNITS)), (["s,mm,N", "t,x,y"], 2, (["t", "x", "y"], UNITS)),
        (["t,x,y,,"], None, (["t", "x", "y"], [])), (["# t,x,y"], None, (["t", "x", "y"], [])),
        (["%t,x,y"], None, (["t", "x", "y"], [])), (["#,t,x"], None, (["", "t", "x"], [])),
        (["a,2026-01-31,b"], None, ([], [])), (["a,5,b"], None, ([], [])), (["a,5,b"], 1, (["a", "5", "b"], [])),
        (["b,5,6"], None,
         AS_LINE + "1 has neither names nor only numbers, ['b', '5', '6']; give the number of the line "
         "of names, or header=0 for none."),
        (["5,6"], None, ([], [])), (["5,6,b"], 1, (["5", "6", "b"], [])), (["b,,5"], None, ([], [])),
        (["b,5,6", "s,mm,N"], None, (["b", "5", "6"], UNITS)),
        (["t,x,y", "", ""], 2, "header: must be the number of the line of the names, or 0 for none, got 2."),
        (["a,b,c", "t,F,V"], None,
         AS_LINE + "2 may be names or units, ['t', 'F', 'V']; give the number of the line of"),
        (["Time,b,c", "t,F,V"], None, (["t", "F", "V"], [])),
        (["a,b,c", "t,F,mm"], None, (["a", "b", "c"], ["t", "F", "mm"])),
        (["one,two,three", "V,worte,impulse"], None,
         AS_LINE + "2 may be names or units, ['V', 'worte', 'impulse']; give"),
        (["N,two,three", "V,worte,impulse"], None, (["V", "worte", "impulse"], [])),
        (["one,two,three", "V,,impulse"], None, (["V", "", "impulse"], [])),
        (["one,two", "V,worte,impulse"], None, (["V", "worte", "impulse"], [])),
        (["5,two,three", "V,worte,impulse"], None, (["V", "worte", "impulse"], [])),
        (["one,two,three", "V,worte,impulse"], 2, (["V", "worte", "impulse"], [])),
        (["Zeit,two,three", "worte,impulse,a"], None, AS_LINE + "2 may be names or units, ['worte', 'impulse', 'a'];"),
        (["Zeit,N,three", "worte,impulse,a"], None, AS_LINE + "2 may be names or units, ['worte', 'impulse', 'a'];"),
        (["Zeit,two,three", "t,impulse,a"], None, (["t", "impulse", "a"], [])),
        (["one,two,three", "worte,impulse,a"], None, (["worte", "impulse", "a"], [])),
        (["one,two,three", "[V],worte,impulse"], None, AS_LINE + "2 may be names or units, ['[V]', 'worte', 'impul"),
        (["t,x,y", "one,two,three"], 1, "header: must be the number of the line above the data, or of one above units, "
         "got 1, and line 2 is ['one', 'two', 'three'], which are neither numbers nor known units."),
        (["Rig", "a", "V,N,V", "t,x,y"], None, AS_LINE + "3 may be units, ['V', 'N', 'V'], and it is not the one below "
         "the names; give the number of the line of names."),
        (["V,N,V", "t,x,y"], 2, (["t", "x", "y"], [])), (["V,N,mm", "t,x,y"], 2, (["t", "x", "y"], ["V", "N", "mm"])),
    ],
)  # fmt: skip
def test_names_and_units_above_the_data(lines, line, expected):
    seen = block([*lines, *ROWS], start=line or 0)
    if isinstance(expected, tuple):
        assert text_header._names_above(seen, line) == expected
        return
    with pytest.raises(ValueError, match=f"^{re.escape(expected)}"):
        text_header._names_above(seen, line)


@pytest.mark.parametrize(
    "rows, names",
    [
        (["0,1,2", *ROWS], ["0", "1", "2"]), (["1,2,3", *ROWS], ["1", "2", "3"]), (["2,3,4", *ROWS], []),
        (["0,1,2"], []), (["0,2,1", *ROWS], []), (["0", "1", "2"], []), (["0,1,3", *ROWS], []),
    ],
)  # fmt: skip
def test_numbers_in_turn_are_names_if_there_are_rows_below_them(rows, names):
    assert text_header._names_above(block(rows), None) == (names, [])


@pytest.mark.parametrize(
    "row, count, separator, expected",
    [
        ([], 2, ",", []), (["t", "x"], 2, ",", ["t", "x"]), (["# t", "x"], 2, ",", ["t", "x"]),
        (["%t", "x"], 2, ",", ["t", "x"]), (["#", "t", "x"], 2, ",", ["t", "x"]), (["#", "x"], 2, ",", ["", "x"]),
        (["%", "x"], 2, ",", ["%", "x"]), (["%", "t", "x"], 2, ",", ["t", "x"]), (["#", "x"], 2, " ", ["x"]),
        (["%", "x"], 2, " ", ["%", "x"]), (["%%", "x"], 2, " ", ["x"]), (["%%", "x"], 2, ",", ["", "x"]),
        (["##", "t", "x"], 2, ",", ["t", "x"]), (["t", "#", "x"], 2, ",", ["t", "#", "x"]),
    ],
)  # fmt: skip
def test_marks_of_comments_are_left_out_of_a_row(row, count, separator, expected):
    assert text_header._unmarked(row, count, separator) == expected


@pytest.mark.parametrize(
    "row, following, count, expected",
    [
        (["s", "mm"], ["0", "1"], 2, ["s", "mm"]), (["s", "mm", ""], ["0", "1"], 2, ["s", "mm"]),
        (["s", "mm", "N"], ["0", "1"], 2, None), (["s"], ["0", "1"], 2, None), (["s", "5"], ["0", "1"], 2, None),
        (["s", "mm"], ["a", "b"], 2, None), (["s", "mm"], ["0", "b"], 2, None), (["s", "-"], ["0", "b"], 2, ["s", "-"]),
        (["s", "mm"], ["0", "nan"], 2, ["s", "mm"]), (["s", "mm"], ["0", ""], 2, ["s", "mm"]),
        (["one", "two"], ["0", "1"], 2, None), (["(s)", "[mm]"], ["0", "1"], 2, ["s", "mm"]),
        (["# s", "mm"], ["0", "1"], 2, ["s", "mm"]), (["s", "mm"], ["0"], 2, ["s", "mm"]),
        (["mm", "tempo", "dauer"], ["0", "1", "2"], 3, None), (["mm", "worte", "dauer"], ["0", "1", "2"], 3,
        ["mm", "worte", "dauer"]), (["mm", "t", "N"], ["0", "1", "2"], 3, ["mm", "t", "N"]),
        (["", "mm"], ["0", "1"], 2, ["", "mm"]), (["one", "mm"], ["0", "x"], 2, None), (["mm", "one"], ["0", "x"], 2,
        ["mm", "one"]),
    ],
)  # fmt: skip
def test_rows_of_units_stand_above_numbers(row, following, count, expected):
    """Without as many fields or above a text in place of a number there are none; "-" is a column without a unit."""
    assert text_header._units_of(row, following, count, ",") == expected


@pytest.mark.parametrize(
    "text, fields, width, expected",
    [
        ("t x y", ["t", "x", "y"], 3, ["t", "x", "y"]), ("t [s] x [mm]", ["t"], 2, ["t [s]", "x [mm]"]),
        ("time (s)  x / mm", [], 2, ["time (s)", "x / mm"]), ("force F  way x", [], 2, ["force F", "way x"]),
        ("force F\tway x", [], 2, ["force F", "way x"]), ("a b", ["a", "b"], 3, ["a", "b"]),
    ],
)  # fmt: skip
def test_names_between_blanks_are_as_many_as_columns_if_that_is_possible(text, fields, width, expected):
    assert text_header._blank_names(text, fields, width) == expected


@pytest.mark.parametrize("more, divided", [(0, True), (1, False)])
def test_lines_of_names_of_sixteen_kilobytes_are_divided_at_each_blank_only(more, divided):
    line = "x" * (2**14 - 10 + more) + "  force F"
    assert len(line) == 2**14 - 1 + more
    names = ["x" * (2**14 - 10 + more), "force F"]
    assert text_header._blank_names(line, ["fields"], 2) == (names if divided else ["fields"])
    assert (names in text_header._names_in([line], " ")) == divided


def test_first_lines_are_a_sample(text, monkeypatch):
    """Up to 1400, and after eight up to a number of characters."""
    monkeypatch.setattr(text_header, "SAMPLE_LINES", 12)
    assert text_header._sample(text(*["1,2"] * 20)) == ["1,2\n"] * 12
    for characters, count in ((20, 8), (32, 9), (31, 8), (43, 11), (44, 12), (47, 12), (48, 12)):
        monkeypatch.setattr(text_header, "SAMPLE_CHARACTERS", characters)
        assert len(text_header._sample(text(*["1,2"] * 20))) == count


@pytest.mark.parametrize("separator", [",", " "])
@pytest.mark.parametrize(
    "characters, count", [(8, 4), (8 * 11, 4), (8 * 12, 5), (8 * 14, 5), (8 * 15, 6), (10**6, 100)]
)
def test_first_rows_below_the_names_are_a_sample(text, monkeypatch, separator, characters, count):
    """Of a hundred at most, and after three up to a number of characters; rows of blanks are none."""
    monkeypatch.setattr(text_header, "SAMPLE_CHARACTERS", characters)
    rows = [separator.join(["10", "5"]), "", "  "] * 100
    head = text_header._with_units(text("t x", *rows), text_header.Head(["t", "x"], 1, 0, separator))
    assert head.sample == [["10", "5"]] * min(count, 34) and (head.names, head.units, head.lines) == (["t", "x"], [], 1)
