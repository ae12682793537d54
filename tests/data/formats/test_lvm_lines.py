"""Lines of LabVIEW measurement files as lvm-read expects them, and checks of rows, headers and lengths."""

import numpy as np
import pytest

from bayesperiodic.data.formats import lvm
from bayesperiodic.data.formats.lvm import _Segment

HEAD = ["LabVIEW Measurement", "Separator;Comma", "Decimal_Separator;.", "***End_of_Header***;"]


def segment(*rows, names="X_Value;a;b;Comment", more=()):
    return ["Channels;2;;;;", *more, "***End_of_Header***;;;", names, *rows]


@pytest.mark.parametrize("mark", [",", "\t", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_lines_have_an_empty_one_before_each_segment_and_as_many_channels_as_names(mark, end):
    """A step is that of its own segment; empty lines and special blocks are left out."""
    special = ["***Start_Special***;", "Channels;7", "0;1", "***End_Special***;"]
    first = segment("0;1;2", "0.5;3;4;a remark", more=["Delta_X;0.5;;0.25", "Samples ; 2;2"])
    second = segment("7;8", ";9", names="X_Value;c")
    text = end.join([*HEAD, ";", *special, *first, "", ";;", *second, ""]).replace(";", mark)
    lines, segments = lvm._prepared(text, mark, None)
    expected = [
        *(line + "\n" for line in HEAD), "\n", "Channels;2;;\n", "Delta_X;0.5;;0.25\n", "Samples;2;2\n",
        "***End_of_Header***;;;\n", "X_Value;a;b;Comment\n", "0;1;2", "0.5;3;4;a remark", "\n", "Channels;2\n",
        "***End_of_Header***;;;\n", "X_Value;c\n", "7;8", ";9",
    ]  # fmt: skip
    assert lines == [line.replace(";", mark) for line in expected]
    start = len([*HEAD, ";", *special])
    assert segments == [
        _Segment(start + 5, 4, ["0.5", "0.25"], [row.replace(";", mark) for row in ("0;1;2", "0.5;3;4;a remark")]),
        _Segment(start + 12, 2, [""], [row.replace(";", mark) for row in ("7;8", ";9")]),
    ]


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("decimal", [".", ","])
def test_decimal_sign_that_is_given_replaces_that_of_the_file(stated, decimal):
    head = HEAD if stated else [*HEAD[:2], *HEAD[3:]]
    lines, _ = lvm._prepared("\n".join([*head, *segment("0;1;2"), ""]), ";", decimal)
    assert lines[:4] == [f"{HEAD[0]}\n", f"Decimal_Separator;{decimal}\n", f"{HEAD[1]}\n", f"{HEAD[3]}\n"]
    assert sum(line.startswith("Decimal_Separator") for line in lines) == 1


@pytest.mark.parametrize(
    "lines, reason",
    [
        (HEAD, "it is cut off, or has no rows of numbers"), (segment(""), "it is cut off, or has no rows of numbers"),
        ([*segment("0;1;2"), "", *segment("")], "it is cut off, or has no rows of numbers"),
        (["***Start_Special***", *segment("0;1;2", "")], "it is cut off, or has no rows of numbers"),
        ([*segment("0;1;2"), "***Start_Special***", ""], "it is cut off, or has no rows of numbers"),
        (["X_Value;a;b", "0;1;2", ""], "it is cut off, or has no rows of numbers"),
        (segment("0;1;2.50", "1;1;2.5"),
         "it seems to be cut off: its last line has no end; add one if its last number "),
        (segment("0;1;2.50", "1;1;2.55"), None), (segment("0;1;2.50", "1;1;2.5", ""), None),
        (segment("0;1;2.5", "1;1;2.50"), None), (segment("0;1;2.50", "1;1;2.5", "2;1;2.5"), None),
        (segment("0;1;2.5"), None),
    ],
)  # fmt: skip
def test_files_that_are_cut_off_have_no_rows_or_a_shorter_number_at_the_end(lines, reason):
    text = "\n".join([*HEAD, *lines])
    if reason is None:
        assert len(lvm._prepared(text, ";", None)[1]) == 1
        return
    with pytest.raises(ValueError, match=f"^{reason}"):
        lvm._prepared(text, ";", None)


@pytest.mark.parametrize(
    "rows, offset, reason",
    [
        (["0;1;2", "1;;3", "2;nan;4;a remark"], 0, None), (["0;1;2", "1;-1.#IND;Inf"], 0, None),
        (["0;1;2", "1;3"], 0, "row 2 after line 7 has 2 fields, and 4 have names"),
        (["0;1;2;3;4;5", "0;1;2"], 0, "row 1 after line 7 has 6 fields, and 4 have names"), (["0;1;2;3;4"], 0, None),
        (["0;1;2"], 1, "row 1 after line 7 has 3 fields, and 4 have names"), ([";0;1;2"], 1, None),
        (["0;1;2", "1;OL;2"], 0, "row 2 after line 7 has 'OL', no number with the decimal sign ',', which decimal= ch"),
        (["0;1;2", "1;1.5;x"], 0, "row 2 after line 7 has 'x', no number with the decimal sign ',', which decimal= ch"),
        (["0;1;2", "nan;1,5;2;x"], 0, None), (["OL;nan;1;2"], 1, None),
    ],
)  # fmt: skip
def test_rows_have_numbers_in_the_columns_of_channels(rows, offset, reason):
    """Numbers that lvm-read has made NaN have a text of a missing sample."""

    def number(cell):
        try:
            return float(cell.replace(",", "."))
        except ValueError:
            return np.nan

    table = np.array([[number(cell) for cell in [*row.split(";"), "", ""][offset : offset + 3]] for row in rows])
    if reason is None:
        lvm._check_rows(_Segment(7, 4, [""], rows), table, offset, ";", ",")
        return
    with pytest.raises(ValueError, match=f"^{reason}"):
        lvm._check_rows(_Segment(7, 4, [""], rows), table, offset, ";", ",")


@pytest.mark.parametrize(
    "stored, expected",
    [
        (5, [5, 5]), ([5, 7], [5, 7]), ([5, "", 7, ""], [5, 7]), ("mm", ["mm", "mm"]), ([], [None, None]),
        ("", [None, None]), ([np.nan, 5], [5, 5]), (["mm"], ["mm", "mm"]), (0.0, [0.0, 0.0]), (None, [None, None]),
        ([5, 6, 7], "its Key has 3 values for 2 channels"),
    ],
)  # fmt: skip
def test_entries_of_the_header_are_those_of_each_channel(stored, expected):
    whole = {} if stored is None else {"Key": stored if isinstance(stored, list | str) else [stored]}
    if isinstance(expected, list):
        assert lvm._each(whole, "Key", 2) == expected
        return
    with pytest.raises(ValueError, match=f"^{expected}$"):
        lvm._each(whole, "Key", 2)


@pytest.mark.parametrize(
    "values, announced, headings, expected",
    [
        ([1, 2, 3], None, "Yes", 3), ([1, 2, 3], 3, "Yes", 3), ([1, 2, np.nan], 2, "Yes", 2),
        ([1, 2, np.nan], 2, "No", 2),
        ([1, 2, 3], 2, "No", 3), ([1, np.nan, 3], 1, None, 3), ([1, np.nan, np.nan], 1, None, 1),
        ([1, 2, 3], 2, "Yes", "it has 3 rows, and 2 samples by its header"), ([1, np.nan], 2, "Yes", 2),
        ([1, 2, 3], 4, "No", "it is cut off: it has 3 rows, and 4 samples by its header"),
    ],
)  # fmt: skip
def test_channels_end_with_their_last_sample(values, announced, headings, expected):
    whole = {} if headings is None else {"Multi_Headings": headings}
    if isinstance(expected, int):
        assert lvm._length(np.array(values, float), announced, whole) == expected
        return
    with pytest.raises(ValueError, match=f"^{expected}$"):
        lvm._length(np.array(values, float), announced, whole)
