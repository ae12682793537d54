"""Headers of texts by the names that are wanted: the line of names, the separator, and units around it."""

import csv

import pytest

from bayesperiodic.data.formats import text_header
from bayesperiodic.data.formats.text_header import Head


@pytest.mark.parametrize(
    "lines, separator, names, number, more, even",
    [
        (["t,x", "0,1"], ",", ["t", "x"], 1, 0, True), (["t,x", "0,1,"], ",", ["t", "x"], 1, 1, True),
        (["t,x", "0,1, ,"], ",", ["t", "x"], 1, 2, True), (["t,x", "0,1,2"], ",", ["t", "x"], 1, 1, False),
        (["t,x", "0"], ",", ["t", "x"], 1, -1, False), (["t,x,,", "0,1,2,3"], ",", ["t", "x"], 1, 2, False),
        (["t,,x", "0,,1"], ",", ["t", "", "x"], 1, 0, True), (["t;x", ",5;1"], ";", ["t", "x"], 1, 0, False),
        (["t,x"], ",", ["t", "x"], 1, 0, True), (["Rig,t", "t,x", "0,1"], ",", ["t", "x"], 2, 0, True),
        (["Rig", "", "t,x", "", "0,1,2"], ",", ["t", "x"], 3, 1, False),
        (["", "t,y", "0,1"], ",", ["t", "y"], 2, 0, True),
        (["a,b", "c,x,t", "x,t", "0,1"], ",", ["c", "x", "t"], 2, -1, False),
        (["a,b", "0,1"], ",", ["a", "b"], 1, 0, True),
        (["# t,x", "0,1"], ",", ["t", "x"], 1, 0, True), (["#t,x,", "0,1"], ",", ["t", "x"], 1, 0, True),
        (['"t","x', 'y",x', "0,1,2"], ",", ["t", "x\\ny", "x"], 2, 0, True),
        (["# t  x", "0 1"], " ", ["t", "x"], 1, 0, True), (["  t x", " 0 1 2 "], " ", ["t", "x"], 1, 1, False),
        (["a", "t x", "", "0 1"], " ", ["t", "x"], 2, 0, True),
        (["t  force F  x", "0 1 2"], " ", ["t", "force", "F", "x"], 1,
        -1, False), (["t,x"], ";", ["t,x"], 1, 0, True), ([","], ",", ["", ""], 1, 0, True),
    ],
)  # fmt: skip
def test_line_of_names_is_the_first_with_most_of_those_wanted(text, lines, separator, names, number, more, even):
    """The row below it has as many fields, or `more`; it is even if those are empty."""
    head = text_header._line_of_names(text(*lines), ["t", "x"], separator)
    assert head == Head([name.replace("\\n", "\n") for name in names], number, more, separator, even=even)


@pytest.mark.parametrize("wanted, line", [(["x (2)"], 2), (["x"], 2), (["t", "x (1)"], 2), (["a"], 1), (["x (3)"], 1)])
def test_names_that_are_repeated_are_found_by_their_number(text, wanted, line):
    assert text_header._line_of_names(text("a,b,c", "t,x,x", "0,1,2"), wanted, ",").lines == line


@pytest.mark.parametrize("lines", [998, 999, 1000, 1001])
@pytest.mark.parametrize("separator", [",", " "])
def test_names_are_in_the_first_thousand_lines(text, lines, separator):
    """The line after a row that has some of them is looked at too."""
    rows = [*["a comment"] * lines, f"t{separator}x", f"0{separator}1"]
    head = text_header._line_of_names(text(*rows), ["t", "x"], separator)
    assert head.lines == (lines + 1 if lines < 1000 else 1)
    rows[lines - 1] = f"t{separator}y"
    head = text_header._line_of_names(text(*rows), ["t", "x"], separator)
    assert head.lines == (lines + 1 if lines < 1001 else 1)


def test_empty_text_has_no_line_of_names(text):
    for separator in ", ":
        with pytest.raises(ValueError, match="^path: must be a CSV file with a header line, got .*, which is empty.$"):
            text_header._line_of_names(text(""), ["t"], separator)


@pytest.mark.parametrize(
    "lines, wanted, given, separator, names",
    [
        (["t;x", "0,5;1,5"], ["t", "x"], None, ";", ["t", "x"]), (["t;x", "0,5;1,5"], ["t"], ";", ";", ["t", "x"]),
        (["t x", "0 1"], ["x"], None, " ", ["t", "x"]), (["t|x", "0|1"], ["x"], None, "|", ["t", "x"]),
        (["t\tx", "0\t1"], ["x"], None, "\t", ["t", "x"]), (["t;x,y", "0;1"], ["t"], None, ";", ["t", "x,y"]),
        (["t,x;y", "0,1"], ["t"], None, ",", ["t", "x;y"]), (["t;x", "0,5;1,5"], ["t", "z"], None, ";", ["t", "x"]),
        (["t;x", "0,5;1,5"], ["z"], None, ";", ["t", "x"]), (["t;x", "0,5;1,5"], ["z"], ",", ",", ["t;x"]),
        (["t,x", "0,1,2"], ["t", "x"], None, ",", ["t", "x"]),
        (["t,x,x", "0,1,2"], ["x (2)"], None, ",", ["t", "x", "x"]),
        (["a,x", "t;x", "0,5;1"], ["t"], None, ";", ["t", "x"]), (["t", "0"], ["t"], None, ",", ["t"]),
    ],
)  # fmt: skip
def test_separator_is_the_first_of_which_names_and_row_below_have_as_many_fields(
    text, lines, wanted, given, separator, names
):
    """Without all names it is that with most of those wanted, and of these with most names."""
    head = text_header._by_names(text(*lines), wanted, given)
    assert (head.separator, head.names) == (separator, names)


def test_a_field_without_end_is_one_of_another_separator(text):
    """Python's module csv takes 131072 characters."""
    line = "t;" + ";".join(f"name {k}" for k in range(20_000))
    lines = text(line, ";".join("0" * 20_001))
    assert text_header._by_names(lines, ["t"], None).separator == ";"
    with pytest.raises(csv.Error, match="field larger than field limit"):
        text_header._by_names(lines, ["t"], ",")


@pytest.mark.parametrize(
    "lines, number, separator, units",
    [
        (["s,mm", "t,x"], 2, ",", ["s", "mm"]), (["Rig", "s,mm", "", "t,x"], 4, ",", ["s", "mm"]),
        (["s,mm", "Rig", "t,x"], 3, ",", []), (["t,x", "s,mm"], 1, ",", []),
        (["s,mm", "t,x", "s,kN"], 2, ",", ["s", "mm"]),
        (["N,m", "t,x"], 2, ",", []), (["s", "t,x"], 2, ",", []), (["s,", "t,x"], 2, ",", []),
        (["s,mm,", "t,x"], 2, ",",
        ["s", "mm"]), (["s,mm,N", "t,x"], 2, ",", []), (["# s,mm", "# t,x"], 2, ",", ["s", "mm"]),
        (["# s mm", "# t x"], 2, " ", ["s", "mm"]), ([" s  mm ", "t x"], 2, " ", ["s", "mm"]),
        (["s mm", "", "t x"], 3, " ",
        ["s", "mm"]), (["s, mm ", "t,x"], 2, ",", ["s", "mm"]), (["s,5", "t,x"], 2, ",", []),
    ],
)  # fmt: skip
def test_units_may_stand_in_the_row_above_the_names(text, lines, number, separator, units):
    """As many as there are names, one of which is evident."""
    head = Head(["t", "x"], number, 0, separator)
    assert text_header._units_above(text(*lines), head, ["0", "1"]) == units


@pytest.mark.parametrize(
    "below, units, lines, rows",
    [
        (["0,1", "2,3"], [], 1, 2), (["s,mm", "0,1"], ["s", "mm"], 2, 1), (["", "s,mm", "0,1"], ["s", "mm"], 3, 1),
        (["a word", "s,mm", "0,1"], ["s", "mm"], 3, 1), (["s,mm", "a word", "0,1"], ["s", "mm"], 3, 1),
        (["a", "b", "s,mm", "0,1"], [], 1, 4), (["a", "s,mm", "b", "0,1"], [], 1, 4), (["one,two", "0,1"], [], 1, 2),
        (["s,mm", "m,kN", "0,1"], ["s", "mm"], 3, 1), ([], [], 1, 0),
    ],
)  # fmt: skip
def test_units_are_in_the_two_rows_below_the_names(text, below, units, lines, rows):
    head = text_header._with_units(text("t,x", *below), Head(["t", "x"], 1, 0, ","))
    assert (head.names, head.units, head.lines, len(head.sample)) == (["t", "x"], units, lines, rows)
    assert head.more == 0 and head.separator == "," and head.titled


def test_surplus_fields_are_those_of_the_first_row_below_the_units(text):
    assert text_header._with_units(text("t,x", "s,mm", "0,1,"), Head(["t", "x"], 1, 0, ",")).more == 1
    assert text_header._with_units(text("t,x", "0,1,"), Head(["t", "x"], 1, 5, ",")).more == 5


@pytest.mark.parametrize("given, expected", [(None, None), (0, 0), (3, 3)])
def test_numbers_of_lines_are_integers_from_zero(given, expected):
    assert text_header.line_number(given) == expected
    for other in (-1, 1.5, "1"):
        with pytest.raises(ValueError, match="^header: must be "):
            text_header.line_number(other)


@pytest.mark.parametrize("separator, fields", [(",", [["a", "b "], ["c"]]), (" ", [["a,", "b"], ["c"]])])
def test_rows_are_those_below_the_header(text, separator, fields):
    """Lines of a field in quotes count too."""
    with text("one", "two", "a, b ", "c").open() as lines:
        assert [*text_header.skip(lines, 2, separator)] == fields
    with text('"one', 'two"', "a, b ", "c").open() as lines:
        assert [*text_header.skip(lines, 2, separator)] == fields
    assert [*text_header.rows_of(["a, b ", "c"], separator)] == fields
