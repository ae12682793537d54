"""Cells of texts: what numbers show of their decimal sign, and numbers, dates and times of day in any notation."""

import itertools

import numpy as np
import pandas as pd
import pytest

from bayesperiodic.data.formats import text_cells
from bayesperiodic.data.formats.text_cells import CellEvidence


def column(*cells):
    return np.array(cells, dtype=object)


@pytest.mark.parametrize(
    "cell, decimal, thousands, either",
    [
        ("1.5", ".", "", ""), ("-1,5", ",", "", ""), (".5", ".", "", ""), ("+,5", ",", "", ""), ("2.", ".", "", ""),
        ("1.234", "", "", "."), ("-999,000", "", "", ","), ("0.234", ".", "", ""), ("1234.567", ".", "", ""),
        ("1,2345", ",", "", ""), ("1.234e5", ".", "", ""), ("1,5D-03", ",", "", ""),
        ("1,234,567", "", ",", ""), ("1.234,5", ",", ".", ""), ("1,234.5", ".", ",", ""), ("1'234.5", ".", "'", ""),
        ("1\u00a0234,5", ",", "\u00a0", ""), ("5", "", "", ""), ("1 234", "", "", ""), ("12.03.2026", "", "", ""),
        ("1,2,3", "", "", ""), ("x.y", "", "", ""), ("", "", "", ""),
    ],
)  # fmt: skip
def test_evidence_of_a_number(cell, decimal, thousands, either):
    """A sign before other than three digits, or after a zero, is a decimal one; a repeated one is not."""
    for cells in ([cell], ["7", "text", cell], [cell, ""]):
        seen = CellEvidence.of(cells)
        assert (seen.decimal, seen.thousands, seen.either) == ({*decimal}, {*thousands}, {*either})


@pytest.mark.parametrize(
    "cells, sign",
    [
        (["1.5"], "."), (["1,5"], ","), (["1,234,567"], "."), (["1.234.567"], ","), (["1.234,5"], ","),
        (["1.5", "1,5"], ""), (["1,5", "1,234,567"], ""), (["1'234'567"], ""), (["1'234.5"], "."), (["1.234"], ""),
        (["1.234", "1,5"], ","), ([], ""),
    ],
)  # fmt: skip
def test_decimal_sign_is_that_of_all_evidence(cells, sign):
    whole = CellEvidence()
    for cell in cells:
        whole |= CellEvidence.of([cell])
    assert whole == CellEvidence.of(cells) and whole.sign == sign


def test_refusal_of_commas_names_a_number_and_the_argument():
    either = "numbers such as '1,234', whose comma may be the decimal sign or stand between thousands; give decimal="
    assert text_cells.refusal(["5", "1,234"], False).startswith(either)
    other = "numbers such as '1,234', which do not all have one decimal sign; give decimal= and thousands="
    assert text_cells.refusal(["5", "1,234"], True) == other
    assert text_cells.refusal(["5", "1.5", "1,234"], True) == other
    assert text_cells.refusal(["5", "7"], True).startswith("numbers such as '5', ")
    assert text_cells.refusal([], True) == text_cells.refusal(["1,5", "OL"], True) == ""


@pytest.mark.parametrize(
    "cells, message",
    [
        (["1", "2", "OL"], "'OL' in data row 3, which is no number, as 2 others are"),
        (["OL", "1", " 2,5 "], "'OL' in data row 1, which is no number, as 2 others are"),
        (["1", "OL", "3", np.nan, "5", "OFF"], "'OL' in data row 2, which is no number, as 3 others are"),
        (["1", "OL"], ""), (["1", "2"], ""), (["a", "b", "3"], ""), ([], ""),
    ],
)  # fmt: skip
def test_a_text_among_more_numbers_is_named_with_its_row(cells, message):
    assert text_cells.other_than_numbers(column(*cells)) == message


@pytest.mark.parametrize(
    "cell, moment",
    [
        ("12:00", True), (" 12:00:01,5 ", True), ("12.03.2026", True), ("2026-03-12T10:00:00Z", True), ("12", False),
        ("12:0", False), (12.5, False), (None, False), ("12.03.2026x", False),
    ],
)  # fmt: skip
def test_moments_are_dates_and_times_of_day(cell, moment):
    assert text_cells.is_moment(cell) is moment


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    "cells, decimal, thousands, expected",
    [
        (["1,234.5", "2,345,678"], ".", None, [1234.5, 2345678]), (["1.234,5", "-2"], ",", None, [1234.5, -2]),
        (["1.234,5", "-2"], ",", ".", [1234.5, -2]), (["1 234,5", "+,5"], ",", None, [1234.5, 0.5]),
        (["1’234", " 7\t"], ".", None, [1234, 7]), (["1'234", "7"], ".", "'", [1234, 7]),
        (["1.5D+02", "1.5d-02", "1.5E2"], ".", None, [150, 0.015, 150]), (["Inf", "-infinity"], ".", None, [INF, -INF]),
        (["1,5", NAN, "2"], ",", None, [1.5, NAN, 2]), (["2,", "5"], ",", None, [2, 5]),
        (["1,234", "1'234"], ".", None, None),  # two signs between thousands
        (["1'234.5"], ".", ",", None), (["1,23"], ".", None, None), (["1,2345"], ".", None, None), (["12,34,567"], ".",
        None, None), (["1.5", "OL"], ".", None, None), (["1.234.5"], ".", None, None), ([".,5"], ",", None, None),
        (["1,234'567"], ".", None, None), (["."], ".", None, None),
    ],
)  # fmt: skip
def test_numbers_with_signs_between_thousands(cells, decimal, thousands, expected):
    read = text_cells.numbers(column(*cells), decimal, thousands)
    assert read is None if expected is None else np.array_equal(read, expected, equal_nan=True)


def hours(*values):
    return (np.array(values) * 3_600_000_000_000).astype("timedelta64[ns]")


@pytest.mark.parametrize(
    "times, expected, midnight",
    [
        ([1, 2, 3], [1, 2, 3], False), ([23, 1, 2], [23, 25, 26], True), ([22, 1, 23, 0.5], [22, 25, 47, 48.5], True),
        ([12, 0, 1], [12, 0, 1], False), ([12.5, 0, 1], [12.5, 24, 25], True), ([25, 1], [25, 1], False),
        ([24, 1], [24, 1], False), ([23.9, 1], [23.9, 25], True), ([5], [5], False),
    ],
)  # fmt: skip
def test_a_step_back_by_more_than_half_a_day_is_a_midnight(times, expected, midnight):
    """Times of 24 hours and more are no times of day."""
    given = hours(*times)
    for lost in (False, True):
        values = np.insert(given, 1, np.timedelta64("NaT", "ns")) if lost else given
        rolled, remark = text_cells.rolled(values)
        assert np.array_equal(np.delete(rolled, 1) if lost else rolled, hours(*expected))
        assert not lost or np.isnat(rolled[1])
        ending = "which go on after midnight" if midnight else "in seconds from the first one"
        assert remark == f"times of day, {ending}"
    assert np.array_equal(given, hours(*times))  # which is not changed


def seconds_of(values):
    return ((values - values[0]) / np.timedelta64(1, "ns") / 1e9).tolist()


@pytest.mark.parametrize(
    "cells, step, remark",
    [
        (["10:00:00.5", "10:00:02"], 1.5, "in seconds"), (["10:00:00,5", " 10:00:02,25"], 1.75, "in seconds"),
        (["00:59.5", "01:00.25"], 0.75, "in seconds"), (["23:59:59", "00:00:01"], 2.0, "after midnight"),
        (["99:59.5", "100:00.25"], 0.75, "in seconds"), (["99:59:59", "100:00:01"], 2.0, "in seconds"),
        (["10:00:00.123456789", "10:00:01.123456789"], 1.0, "in seconds"),
        (["12.03.2026", "13.03.2026"], 86_400.0, "day, month, year"),
        (["12.03.2026 10:00:00.123456789", "12.03.2026 10:00:01.123456789"], 1.0, "day, month, year"),
        (["12.03.2026 10:00:00.000000001", "12.03.2026 10:00:00.000000003"], 2e-9, "day, month, year"),
        (["12.03.2026 10:00", "12.03.2026 10:01"], 60.0, "day, month, year"),
        (["12.03.2026 10:00:00", "12.03.2026 10:00:00.25"], 0.25, "day, month, year"),
        (["12.03.2026  10:00:00,75", "12.03.2026 10:00:01"], 0.25, "day, month, year"),
        (["12.03.2026T10:00:00", "12.03.2026T10:00:07"], 7.0, "day, month, year"),
        (["13/03/2026 11:59:59 AM", "13/03/2026 12:00:00PM"], 1.0, "day, month, year"),
        (["03/13/2026 11:59 AM", "03/13/2026 12:01 PM"], 120.0, "month, day, year"),
        (["03/13/2026 1:59:59 pm", "03/13/2026 2:00:00 pm"], 1.0, "month, day, year"),
        (["03/13/2026 12:59:59 PM", "03/13/2026 01:00:00 PM"], 1.0, "month, day, year"),
        (["03/13/2026 12:59:59 am", "03/13/2026 01:00:00 am"], 1.0, "month, day, year"),
        (["12-31-2026 10:00:00", "12-31-2026 10:00:03"], 3.0, "month, day, year"),
        (["2026.03.12 10:00:00", "2026.03.12 10:00:01.5"], 1.5, "year, month, day"),
        (["2026-03-12 10:00:00,5", "2026-03-12 10:00:01"], 0.5, "year, month, day"),
        (["2026/03/12", "2026/03/14"], 172_800.0, "year, month, day"),
    ],
)  # fmt: skip
def test_dates_and_times_in_one_order(cells, step, remark):
    values, said, refusal = text_cells.times(column(*cells), None)
    assert seconds_of(values) == [0.0, step] and said.endswith(remark) == (remark != "in seconds") and refusal == ""
    assert remark in said and said.startswith(("times of day, ", "dates read as "))
    values, *_ = text_cells.times(column(cells[0], np.nan, cells[1]), None)
    assert np.isnat(values[1]) and seconds_of(values[[0, 2]]) == [0.0, step]


@pytest.mark.parametrize(
    "cells",
    [
        ["OL", "10:00:00"], [1.5, "10:00:00"], [np.nan, np.nan], ["10:00:00", "OL"], ["10:00:00.0123456789"] * 2,
        ["10:00.5", "10:00:00.5"], ["10:99:00"], ["10:00:00", "10:00:60"], ["10:00:00", "1 days 10:00:00"],
        ["12.03.2026 10:00:00.0123456789"], ["12.03.2026", "OL"],
        ["31.13.2026"], ["2026-03-12T10:00:00", "2026-03-12T10:00:01"], ["12.03.2026 25:00:00"], ["12.03-2026"],
    ],
)  # fmt: skip
def test_other_texts_are_no_times_and_have_no_reason_to_be_refused(cells):
    """Dates after ISO 8601 are left to what reads all times; digits beyond nanoseconds would be lost."""
    assert text_cells.times(column(*cells), None) == (None, "", "")


@pytest.mark.parametrize(
    "cells, reason, help",
    [
        (["11:59:59 AM", "12:00:00 PM"], "times of twelve hours", ["%I:%M:%S %p"]),
        (["10:00", "10:01"], "times such as '10:00', which may be hours and minutes or minutes", ["%H:%M", "%M:%S"]),
        (["12.03.26", "13.03.26"], "dates such as '12.03.26', in which the year has no four digits",
         ["%d.%m.%y %H:%M:%S"]),
        (["03/12/2026", "04/12/2026"], "dates such as '03/12/2026', in which day and month", ["%m/%d/%Y", "%d/%m/%Y"]),
        (["03-12-2026 10:00"] * 2, "'03-12-2026 10:00', in which day", ["%m-%d-%Y %H:%M", "%d-%m-%Y %H:%M"]),
        (["03/12/2026 10:00:00 AM"] * 2, "day and month may be", ["%m/%d/%Y %I:%M:%S %p", "%d/%m/%Y %I:%M:%S %p"]),
    ],
)  # fmt: skip
def test_times_of_several_meanings_are_refused_with_the_formats(cells, reason, help):
    """Each of the formats reads the cells, but that with a time of day dates without one."""
    values, remark, refusal = text_cells.times(column(*cells), None)
    assert values is None and remark == "" and reason in refusal and "; give date_format=" in refusal
    for form in help:
        assert repr(form) in refusal
        if form != "%d.%m.%y %H:%M:%S":
            read, said, refused = text_cells.times(column(*cells), form)
            assert refused == "" and not np.isnat(read).any()
            assert "times of day" in said if "%Y" not in form else said == f"dates in the format {form!r}, as given"


@pytest.mark.parametrize(
    "cells, form, step",
    [
        (["12.03.26 10:00:00", "12.03.26 10:00:02"], "%d.%m.%y %H:%M:%S", 2.0), (["10h05", "10h06"], "%Hh%M", 60.0),
        (["71 10:00", "72 10:00"], "%j %H:%M", 86_400.0), (["23:59", "00:01"], "%H:%M", 120.0),
        (["2026-03-12 10:00 +0100", "2026-03-12 10:00 +0000"], "%Y-%m-%d %H:%M %z", 3600.0),
        (["03/12/26 10:00", "03/13/26 10:00"], "%x %H:%M", 86_400.0),
        (["W05-3 2026", "W05-4 2026"], "W%V-%u %G", 86_400.0),
        (["Thu Mar 12 10:00:00 2026", "Thu Mar 12 10:00:01 2026"], "%c", 1.0),
        (["Mar 26", "Apr 26"], "%b %y", 31 * 86_400.0),
        (["12 1900", "01 1901"], "%m %Y", 31 * 86_400.0), (["18:00 -0500", "20:00 -0500"], "%H:%M %z", 7200.0),
        (["00:30 +1200", "00:31 +1200"], "%H:%M %z", 60.0), (["23:59 -0500", "00:01 -0500"], "%H:%M %z", 120.0),
    ],
)  # fmt: skip
def test_dates_in_a_format_that_is_given(cells, form, step):
    values, remark, refusal = text_cells.times(column(*cells), form)
    assert seconds_of(values) == [0.0, step] and refusal == "" and values.dtype.kind in "mM"
    assert (values.dtype.kind == "m") == ("times of day" in remark) == (not any(c in form for c in "jdyxcGY"))
    assert np.isnat(text_cells.times(column(cells[0], None, cells[1]), form)[0]).tolist() == [False, True, False]
    assert text_cells.times(column(*cells), "%S") == text_cells.times(column("x", *cells), form) == (None, "", "")


@pytest.mark.parametrize("mark, order", [*itertools.product("./-", ["%d{0}%m{0}%Y", "%m{0}%d{0}%Y", "%Y{0}%m{0}%d"])])
def test_all_days_of_a_year_in_any_order_are_read_or_refused(mark, order):
    """A year has days beyond 12, which tell the orders apart; with points, the day is the first."""
    days = pd.date_range("2026-01-01", "2026-12-31")
    values, _, refusal = text_cells.times(column(*days.strftime(order.format(mark))), None)
    iso, american = order.startswith("%Y") and mark == "-", order.startswith("%m") and mark == "."
    assert refusal == ""
    if iso or american:
        assert values is None
    else:
        assert np.array_equal(values.astype("datetime64[D]"), days.to_numpy().astype("datetime64[D]"))
