"""Headers of texts: names, units and the first row of data as a reader sees them, or a refusal with a cure."""

import re

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import header_units, text, text_header
from bayesperiodic.data.formats.text_header import Head, numbered


@pytest.fixture
def write(tmp_path):
    def written(content, encoding="utf-8"):
        path = tmp_path / "run.csv"
        path.write_bytes(content.encode(encoding))
        return path

    return written


@pytest.mark.parametrize(
    "names, expected",
    [
        (["a", "b"], ["a", "b"]), (["a", "a"], ["a (1)", "a (2)"]), (["a", "b", "a"], ["a (1)", "b", "a (2)"]),
        (["a", "a", "a (1)"], ["a (1)'", "a (2)", "a (1)"]), (["a", "a", "a (1)", "a (1)'"], ["a (1)''", "a (2)",
        "a (1)", "a (1)'"]), ([], []),
    ],
)  # fmt: skip
def test_repeated_names_differ_by_their_number(names, expected):
    assert numbered(names) == expected


@pytest.mark.parametrize(
    "head, remark",
    [
        (Head(["t"], 1, 0, ","), "separator ',', names in line 1"),
        (Head(["t"], 7, 0, "\t"), "separator tab, names in line 7"),
        (Head(["t"], 7, 0, " ", ["s"]), "separator blanks, names in line 6, units in the row below"),
        (Head(["1"], 0, 0, "|", [], False), "separator '|', no names: columns by number"),
        (Head(["1"], 0, 0, "x", [], False), "separator 'x', no names: columns by number"),
    ],
)
def test_remark_on_a_header(head, remark):
    assert head.remark == remark


@pytest.mark.parametrize("given", [";", ",", "\t", " ", r"\s+", "x"])
def test_separator_of_one_character_or_blanks(given):
    assert text_header.known_separator(given) == (" " if given == r"\s+" else given)


@pytest.mark.parametrize("given", ["", "ab", "\n", "\r", '"', 5, None])
def test_other_separators_are_refused(given):
    message = f"separator: must be one character, ' ' for any number of blanks, got {given!r}."
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        text_header.known_separator(given)


DATA = {",": "0.5,1.5,2\n1.5,2.5,3\n2.5,3.5,4\n", ";": "0,5;1,5;2\n1,5;2,5;3\n2,5;3,5;4\n"}
DATA |= {mark: DATA[","].replace(",", mark) for mark in "\t| "}
NONE = ["", "", ""]
LAYOUTS = {
    "names": ("t,x,y\n", ["t", "x", "y"], NONE, "separator ',', names in line 1"),
    "names after a preamble": ("Rig 3\n\nt,x,y\n", ["t", "x", "y"], NONE, "separator ',', names in line 3"),
    "a preamble with separators": ("Rig,3\nBy,me\nt,x,y\n", ["t", "x", "y"], NONE, "separator ',', names in line 3"),
    "units": ("t,x,y\ns,mm,N\n", ["t", "x", "y"], ["s", "mm", "N"], "names in line 1, units in the row below"),
    "units in brackets": ("t,x,y\n[s],(mm),[N]\n", ["t", "x", "y"], ["s", "mm", "N"], "units in the row below"),
    "a title of the units": ("t,x,y\nUnit:,mm,N\n", ["t", "x", "y"], ["", "mm", "N"], "units in the row below"),
    "units with empty cells": ("t,x,y\n,mm,N\n", ["t", "x", "y"], ["", "mm", "N"], "units in the row below"),
    "units above": ("s,mm,N\nt,x,y\n", ["t", "x", "y"], ["s", "mm", "N"], "names in line 1, units in the row below"),
    "units after an empty line": ("t,x,y\n\ns,mm,N\n", ["t", "x", "y"], ["s", "mm", "N"], "units in the row below"),
    "a comment of names": ("# t,x,y\n", ["t", "x", "y"], NONE, "names in line 1"),
    "two comments": ("# by hand\n% t,x,y\n", ["t", "x", "y"], NONE, "names in line 2"),
    "comments of names and units": ("# t,x,y\n# s,mm,N\n", ["t", "x", "y"], ["s", "mm", "N"], "units in the row below"),
    "no names": ("", ["column 1", "column 2", "column 3"], NONE, "separator ',', no names: columns by number"),
    "a preamble without names": ("By me\n", ["column 1", "column 2", "column 3"], NONE, "no names: columns by number"),
    "numbers as names": ("0,1,2\n", ["0", "1", "2"], NONE, "separator ',', names in line 1"),
    "numbers from one on": ("1,2,3\n", ["1", "2", "3"], NONE, "separator ',', names in line 1"),
    "an empty name": ("t,,y\n", ["t", "column 2", "y"], NONE, "separator ',', names in line 1"),
    "repeated names": ("t,x,x\n", ["t", "x (1)", "x (2)"], NONE, "separator ',', names in line 1"),
    "quoted names": ('"t","x,1","y ""a"""\n', ["t", "x,1", 'y "a"'], NONE, "separator ',', names in line 1"),
    "tabs": ("t\tx\ty\n", ["t", "x", "y"], NONE, "separator tab, names in line 1"),
    "bars": ("t|x|y\n", ["t", "x", "y"], NONE, "separator '|', names in line 1"),
    "semicolons": ("t;x;y\n", ["t", "x", "y"], NONE, "separator ';', names in line 1, decimal comma"),
    "blanks": ("  t   x y\n", ["t", "x", "y"], NONE, "separator blanks, names in line 1"),
    "blanks within names": ("time [s]   x   force F\n", ["time [s]", "x", "force F"], ["s", "", ""], "blanks, names"),
    "units after blanks": ("# t x y\n# s mm N\n", ["t", "x", "y"], ["s", "mm", "N"], "separator blanks, names in line"),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_headers(write, layout):
    """Without and with the names, which a reader of the file would give; the data are the same below all of them."""
    head, names, units, remark = LAYOUTS[layout]
    mark = next((one for one in ";\t|" if one in head), " " if "blanks" in layout or "blanks" in remark else ",")
    path = write(head + DATA[mark])
    seen = bp.inspect(path)
    assert [channel.name for channel in seen.channels] == names
    assert [channel.unit for channel in seen.channels] == units
    assert [channel.samples for channel in seen.channels] == [3, 3, 3] and remark in seen.remarks[0]
    keys = [1, 2, 3] if "column 1" in names else names
    scale = {"mm": 1e-3}
    run = bp.Recording.from_file(path, time=keys[0], outputs={"x": keys[1], "y": keys[2]})
    np.testing.assert_allclose(run.time, [0.5, 1.5, 2.5])
    np.testing.assert_allclose(run.outputs["x"], scale.get(units[1], 1.0) * np.array([1.5, 2.5, 3.5]))
    np.testing.assert_allclose(run.outputs["y"], [2, 3, 4])


REFUSED = {
    "a broken cell": ("t,x,y\nOL,0,1\n", {},
                      "got None, as line 2 has neither names nor only numbers, .*'OL'.*; give the number"),
    "two broken rows": ("t,x,y\nOL,OL,OL\nOL,OL,OL\n", {}, "got None, as lines 2 and 3 are alike, .*; give the number"),
    "two lines of names": ("CH1,CH2,CH3\nt,F,V\n", {},
                           "as line 2 may be names or units, .*; give the number of the line"),
    "units above that may be names": ("V,N,V\nt,x,y\n", {}, "as line 1 may be units, .* give the number of the line"),
    "more names than columns": ("t,x,y,z\n", {}, "line above the data has 4 fields for 3 columns; give the number of"),
    "fewer names than columns": ("t,x\n", {},
                                 "line above the data has 2 fields for 3 columns; .* or header=0 for none"),
    "a line that is empty": ("t,x,y\n\n", {"header": 2},
                             "header: must be the number of the line of the names, or 0 for none, got 2"),
    "a line beyond the end": ("t,x,y\n", {"header": 50}, "path: must be a CSV file .* no rows of numbers"),
    "a line of no units": ("t,x,y\nTakte,Impulse,Stufen\n", {"header": 1},
                           "got 1, and line 2 is .*neither numbers nor known units"),
    "rows of two widths": ("0,1\n1,2\n2,3\n", {},
                           "must be a CSV file with one table, .* rows of 3 fields after rows of numbers with other"),
    "a negative line": ("t,x,y\n", {"header": -1}, "header: must be "),
    "a line that is no number": ("t,x,y\n", {"header": "one"}, "header: must be "),
    "nearly a number": ("t,x,y\n-00:00:01,1,2\n", {},
                        "got None, as line 2 has neither names nor only numbers, .*; give the number"),
    "a broken first row": ("OL,1,2\n", {"header": 0},
                           "got 0, and line 1 has the cell 'OL' above numbers, .*; correct the cell"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_unclear_headers_are_refused_with_the_line_and_what_to_give(write, case):
    head, arguments, message = REFUSED[case]
    path = write(head + DATA[","])
    for call in (bp.inspect, lambda path, **given: bp.Recording.from_file(path, outputs={"x": 2}, time=1, **given)):
        with pytest.raises(ValueError, match=message):
            call(path, **arguments)


@pytest.mark.parametrize(
    "content, kind",
    [
        (" <html>\na,b\n", "HTML or XML"), ("<?xml?>", "HTML or XML"), ('{"t": 1}', "JSON"), ('[{"t": 1}]', "JSON"),
        ("\n\n[[a, b]]", "JSON"),
    ],
)  # fmt: skip
def test_other_notations_are_named(write, content, kind):
    with pytest.raises(
        ValueError, match=f"path: must be a CSV file with a header line, got .*, which seems to be {kind}"
    ):
        bp.inspect(write(content))
    with pytest.raises(ValueError, match=f"seems to be {kind}"):
        bp.Recording.from_file(write(content), time="no", outputs={"x": "name"})


@pytest.mark.parametrize("content", ["a letter\nwithout numbers\n", "\n \n", "[a]\nb\n"])
def test_texts_without_numbers_are_refused_with_what_is_looked_for(write, content):
    with pytest.raises(
        ValueError, match="or columns of numbers, got .* no rows of numbers that a comma, a semicolon, a tab"
    ):
        bp.inspect(write(content))


@pytest.mark.parametrize(
    "content, which", [("0,5\n1,5\n", "2; give separator=','"), ("0,5\n", "are one number or 2; give")]
)
def test_a_comma_that_separates_or_not_is_decided_by_the_names_or_the_user(write, content, which):
    """With as many names as there are fields it separates, with one name it is decimal."""
    with pytest.raises(ValueError, match=f"separator: must be given for 'run.csv', whose rows such as '0,5' .*{which}"):
        bp.inspect(write(content))
    for names, values in (("t,x\n", [0.0, 5.0]), ("x\n", [0.5])):
        path = write(names + "0,5\n1,5\n")
        assert len(bp.inspect(path).channels) == len(values)
        run = bp.Recording.from_file(path, sampling_rate=1.0, outputs={"x": len(values)})
        assert run.outputs["x"][0] == values[-1]
    run = bp.Recording.from_file(write("0,5\n1,5\n"), separator=";", decimal=",", sampling_rate=1.0, outputs={"x": 1})
    assert run.outputs["x"].tolist() == [0.5, 1.5]


@pytest.mark.parametrize("lines", [998, 999, 1000, 1001])
def test_names_are_searched_for_in_a_thousand_lines(write, lines):
    """After as many lines the names are in the next one; 1400 lines are looked at for rows of numbers."""
    path = write("a comment\n" * lines + "t,x\n" + "0,1.5\n1,2.5\n")
    run = bp.Recording.from_file(path, time="t", outputs={"x": "x"})
    assert run.time.size == 2 and f"names in line {lines + 1}" in bp.inspect(path).remarks[0]


def test_rows_of_numbers_are_searched_for_in_1400_lines(write):
    for lines, seen in ((1395, True), (1400, False)):
        path = write("a comment\n" * lines + "0.5,1.5\n1.5,2.5\n2.5,3.5\n3.5,4.5\n")
        if seen:
            assert bp.inspect(path).channels[0].samples == 4
        else:
            with pytest.raises(ValueError, match="which has no rows of numbers"):
                bp.inspect(path)


@pytest.mark.parametrize(
    "given, line", [(0, "no names: columns by number"), (1, "names in line 1"), (3, "names in line 3")]
)
def test_line_of_names_that_is_given_is_used(write, given, line):
    """Above the data, lines of texts between it and the data are units or nothing."""
    content = "a,b,c\n" + DATA[","] if given < 3 else "a,b,c\nd,e,f\ng,h,i\n" + DATA[","]
    path = write(content)
    seen = bp.inspect(path, header=given)
    names = {0: ["column 1", "column 2", "column 3"], 1: ["a", "b", "c"], 3: ["g", "h", "i"]}[given]
    assert [channel.name for channel in seen.channels] == names and line in seen.remarks[0]
    assert seen.channels[0].samples == 3


def test_missing_name_is_asked_for_with_those_that_are_there(write):
    path = write("Rig 3\nt,x,y\n" + DATA[","])
    with pytest.raises(ValueError, match="column of run.csv: must be one of 't', 'x', 'y', got 'z'"):
        bp.Recording.from_file(path, time="t", outputs={"x": "z"})
    with pytest.raises(ValueError, match="column of run.csv: must be a number from 1 to 3, got 4"):
        bp.Recording.from_file(path, time="t", outputs={"x": 4})


MARKED = {
    "two marked lines": ("% s mm N\n% t x y\n", " "), "marked names": ("# t x y\n# s mm N\n", " "),
    "percent below": ("% t x y\n% s mm N\n", " "), "doubled marks": ("## s mm N\n## t x y\n", " "),
    "a mark without a blank": ("%s mm N\n%t x y\n", " "), "commas": ("#s,mm,N\n#t,x,y\n", ","),
}  # fmt: skip


@pytest.mark.parametrize("case", MARKED)
def test_marks_of_comments_do_not_shift_the_units(write, case):
    """The marks # of Gnuplot and % of MATLAB stand before the first field, with a blank or without."""
    head, mark = MARKED[case]
    path = write(head + DATA[mark])
    run = bp.Recording.from_file(path, time="t", outputs={"x": "x", "y": "y"})
    assert run.outputs["x"] == pytest.approx(1e-3 * np.array([1.5, 2.5, 3.5]), rel=1e-12)
    assert run.outputs["y"].tolist() == [2, 3, 4] and run.time.tolist() == [0.5, 1.5, 2.5]
    assert [one.unit for one in bp.inspect(path).channels] == ["s", "mm", "N"]


@pytest.mark.parametrize("head", ["%,mm,N\na,x,y\n", "a,x,y\n%,mm,N\n"])
def test_percent_in_a_row_of_units_is_one_of_them(write, head):
    path = write(head + DATA[","])
    for wanted in ([], ["a", "x"]):
        assert [one.unit for one in text.contents(path, wanted).channels] == ["%", "mm", "N"]


def test_a_field_without_end_is_refused_for_the_separator_that_was_given(write):
    """Longer than the 131072 characters that Python's module csv takes; for other separators it may be several."""
    path = write("a,b\n" + "1" * 140_000 + ",2\n")
    with pytest.raises(ValueError, match="path: must be a CSV file with a header line, got .*run.csv.*field larger"):
        text.contents(path, ["a"], separator=",")


@pytest.mark.parametrize(
    "names, units",
    [
        (["x [mm]", "y [smoot]"], ["mm", "smoot"]), (["x (mm)", "y (smoot)"], ["mm", ""]),
        (["x [a]b", "y [smoot]"], ["", ""]), (["x [1]", "y [mm]"], ["", "mm"]), (["x [1]", "y [2]"], ["", ""]),
        (["x (1)", "y (mm)"], ["", "mm"]),
    ],
)  # fmt: skip
def test_what_stands_in_square_brackets_beside_a_known_unit_is_one_that_the_user_must_explain(names, units):
    """In round brackets it may be an argument; a number is an index."""
    assert header_units.in_names(names, guessed=False) == (units, {})


@pytest.mark.parametrize(
    "name, unit, said",
    [
        ("x_mm", "", "mm"), ("v_mm_s", "", "mm/s"), ("a_mm_s2", "", "mm/s2"), ("v_mm_s", "m", ""), ("v_own_s", "", "s"),
        ("x_one", "", ""), ("x" * 298 + "_mm", "", ""), ("x" * 297 + "_mm", "", "mm"), ("x_mm_kg", "", "kg"),
    ],
)  # fmt: skip
def test_units_at_the_end_of_names_are_said_to_be_unused(name, unit, said):
    """Of names up to 300 characters."""
    assert header_units.unused(name, unit) == said
    text = f"the name may say the unit {said!r}, which is not used; units= converts"
    assert header_units.remarks(name, unit) == ((text,) if said else ())


@pytest.mark.parametrize(
    "cells, units",
    [
        (["N/A", "NaN", ""], None), (["N/A", "mm", ""], ["N/A", "mm", ""]), (["(s)", "[mm]"], ["s", "mm"]),
        (["one", "two"], None), (["one", "two", "mm/s"], ["one", "two", "mm/s"]),
        (["N", "one"], None), (["N", "m", "one"], ["N", "m", "one"]), (["-", "-"], None),
    ],
)  # fmt: skip
def test_rows_of_units_have_known_ones_and_not_missing_values_alone(cells, units):
    assert header_units.unit_row(cells) == units


def test_texts_are_units_up_to_thirty_characters_that_do_not_begin_with_a_number():
    assert header_units.known("m*" * 14 + "mm") and not header_units.known("m*" * 15 + "m")
    assert [header_units.known(text) for text in ("", "N", "1/s", "2 m", "smoots", "dB", "C")] == [
        False, True, True, False, False, True, True
    ]  # fmt: skip


@pytest.mark.parametrize(
    "texts, evident, possible",
    [
        (["mm", "kN", "rad/s", "Hz"], True, True), (["s"], True, True), (["N", "m", "V"], False, True),
        (["Sek.", "Minuten"], True, False), (["g", "t"], False, False), (["C", "F"], False, False),
        (["one/two", "mx", ""], False, False),
    ],
)  # fmt: skip
def test_units_are_evident_if_they_are_no_names_and_possible_if_they_have_one_meaning(texts, evident, possible):
    """A ton and a gram are letters that are seldom units; C and F are coulomb and degrees."""
    assert [*map(header_units.is_evident, texts)] == [evident] * len(texts)
    assert [*map(header_units.is_possible, texts)] == [possible] * len(texts)


def test_brackets_around_units_and_titles_of_their_row_are_left_out():
    given = {
        " [mm] ": "mm",
        "(s)": "s",
        "[mm)": "[mm)",
        " mm": "mm",
        "Unit:": "",
        "EINHEITEN": "",
        "()": "",
        "(m": "(m",
    }
    assert {text: header_units.unbracketed(text) for text in given} == given


@pytest.mark.parametrize(
    "names, units",
    [
        (["Force (N)"], ["N"]), (["F (N)"], ["N"]), (["Fx (N)"], [""]), (["Last links (N)"], ["N"]), (["q (N)"], [""]),
        (["qa (N)", "qb (m)"], ["N", "m"]), (["q (N)", "qb (m)"], ["", "m"]), (["qa (N)", "qb (N)"], ["", ""]),
        (["qa (N)", "qb (m)", "qc"], ["", "", ""]), (["qa (N)", "qb (mm)", "qc"], ["N", "mm", ""]),
        (["U [in]"], ["in?"]), (["F [min]"], ["min?"]), (["time [min]"], ["min"]), (["Dauer [h]"], ["h"]),
        (["ab {mm}"], ["mm?"]), (["<mm> ab"], ["mm?"]), (["ab <x>"], [""]), (["time_ms"], ["ms?"]),
        (["t_min"], ["min?"]),
        (["x_min"], [""]), (["x_mm"], [""]), (["time <min>"], ["min?"]), (["x <min>"], [""]),
        (["a" * 295 + " [mm]"], ["mm"]), (["a" * 296 + " [mm]"], [""]), (["a" * 297 + "_ms"], ["ms?"]),
        (["a" * 298 + "_ms"], [""]),
    ],
)  # fmt: skip
def test_units_in_names(names, units):
    """Letters in parentheses are units of their quantity, or of columns with other units, but no index or argument.

    What may be something else has a question mark; names end with their 300th character.
    """
    assert header_units.in_names(names) == (units, {})


def test_units_in_an_encoding_that_is_guessed_are_refused_if_they_are_not_known():
    refused = header_units.in_names(["x [Âµm]", "y [µm]", "z [mx]"], guessed=True)[1]
    assert refused == {0: "its unit 'Âµm' in an encoding that is not known; give encoding="}
