"""Excel workbooks: the table of each sheet, with dates and times of day."""

import contextlib
import datetime
import itertools
import re
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.formats import header_units, text_cells
from bayesperiodic.data.formats.contents import LARGEST_ARRAY, Contents, Key, StoredChannel, package
from bayesperiodic.data.formats.text_header import NUMBER_CELL, PREAMBLE, TIME_NAME, numbered

# Unpacked bytes per packed byte above which a member of a workbook is no sheet, if it is larger than this.
LARGEST_RATIO, SMALL_MEMBER = 250, 2**25
# Rows and columns that a table may have, those of Excel.
MOST_ROWS, MOST_SHEET_COLUMNS = 2**20, 2**14
STAMPS = (datetime.datetime, datetime.date)
CLOCKS = (datetime.time, datetime.timedelta)
NO_VALUE = ("", "#N/A", "#N/A N/A")
LITERAL = re.compile(r'"[^"]*"|\\.')  # in a format of cells
MICROSECONDS = 86_400e6  # in a day


@dataclass(frozen=True)
class _Sheet:
    """Table of a sheet: names, units, the first row of its data (from 0) and the rows."""

    names: list[str]
    units: list[str]
    first: int
    rows: list[tuple[Any, ...]]
    remark: str


def contents(file: Path, wanted: list[Key], *, header: int | None = None, date_format: str | None = None) -> Contents:
    """Return the columns of the tables of all sheets."""
    line = None if header is None else int(_checks.integer("header", header, 0))
    _refuse_bombs(file)
    channels: list[StoredChannel] = []
    remarks: list[str] = []
    times: list[str] = []
    with _opened(file) as book:
        sheets = {sheet.title: _rows(sheet) for sheet in book.worksheets}
    for sheet, rows in sheets.items():
        table = _table(rows, line) if rows else None
        if table is None:
            remarks.append(f"sheet {sheet!r} has no table of numbers")
            continue
        remarks.append(f"sheet {sheet!r}: {table.remark}")
        formulas = _formulas(file, sheet, table)
        percents = _percents(file, sheet, table)
        for place, name in enumerate(numbered(table.names)):
            channel = _channel(file, sheet, name, place, table, formulas.get(place), date_format)
            channels.append(_without_percent(channel, percents.get(place, set())))
            if not times and TIME_NAME.fullmatch(name) and _may_be_times(table, place):
                times.append(name)
    if not channels:
        raise ValueError("none of its sheets has a table of numbers")
    one = len({channel.group for channel in channels}) == 1
    return Contents(
        "Excel workbook",
        tuple(channels),
        tuple(remarks),
        word="column",
        suggested_time=times[0] if times and one else "",
    )


def _may_be_times(table: _Sheet, place: int) -> bool:
    """Return whether a column has no texts, and does not end as it begins."""
    cells = [row[place] for row in table.rows[table.first :] if place < len(row) and not _is_empty(row[place])]
    return len(cells) > 1 and not any(isinstance(cell, str) for cell in cells) and cells[0] != cells[-1]


@contextlib.contextmanager
def _opened(file: Path, *, formulas: bool = False, raw: bool = False) -> Iterator[Any]:
    """Open a workbook that is read row by row; with `raw`, dates are the numbers that are stored."""
    openpyxl = package("openpyxl", "openpyxl", "Excel workbooks")
    with file.open("rb") as content, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on styles and extensions, which have no values
        book = openpyxl.load_workbook(content, read_only=True, data_only=not formulas, keep_links=False)
        if raw:
            book._date_formats, book._timedelta_formats = set(), set()
        yield book


def _refuse_bombs(file: Path) -> None:
    """Raise a ValueError for a member that unpacks to much more than sheets do."""
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            large = member.file_size > SMALL_MEMBER and member.file_size > LARGEST_RATIO * member.compress_size
            if large or member.file_size > LARGEST_ARRAY:
                raise ValueError(f"its member {member.filename!r} unpacks to {member.file_size / 1e9:.3g} GB")


def _rows(sheet: Any) -> list[tuple[Any, ...]]:
    """Return all rows of a sheet, without empty ones at the end; the size that it states is not relied on."""
    sheet.reset_dimensions()
    rows: list[tuple[Any, ...]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as of a date beyond those of Excel
        for row in sheet.iter_rows(values_only=True):
            if len(rows) >= MOST_ROWS or len(row) > MOST_SHEET_COLUMNS:
                raise ValueError(f"its sheet {sheet.title!r} has more rows or columns than Excel allows")
            rows.append(row)
    while rows and all(cell is None for cell in rows[-1]):
        rows.pop()
    return rows


def _is_value(cell: Any) -> bool:
    """Return whether a cell is a number, a date or a time."""
    return isinstance(cell, int | float | datetime.date | datetime.time | datetime.timedelta)


def _is_empty(cell: Any) -> bool:
    return cell is None or (isinstance(cell, str) and cell.strip() in NO_VALUE)


def _table(rows: list[tuple[Any, ...]], line: int | None) -> _Sheet | None:
    """Return the table of a sheet: its columns of values, and the names and units above them."""
    start = line or 0
    width = max(map(len, rows))
    part = rows[start : start + PREAMBLE + 400]
    part = part[-max(len(part) // 3, 3) :]  # below what may stand above the table
    values = [sum(_is_value(row[k]) for row in part if k < len(row)) for k in range(width)]
    filled = [sum(not _is_empty(row[k]) for row in part if k < len(row)) for k in range(width)]
    columns = [k for k in range(width) if values[k] and 2 * values[k] >= filled[k]]
    first = next((r for r in range(start, len(rows)) if _is_data(rows[r], columns)), None)
    if not columns or first is None:
        return None
    above = [r for r in range(first) if any(not _is_empty(cell) for cell in rows[r])]
    if line is not None:
        above = [r for r in above if r < line]
    elif not any(isinstance(cell, str) for r in above[-1:] for cell in rows[r]):
        above = []
    tops = [rows[r] for r in above[-1:] if sum(isinstance(cell, str) for cell in rows[r]) > 1]
    real = max(k + 1 for row in [*rows[first:], *tops] for k, cell in enumerate(row) if not _is_empty(cell))
    _refuse_lost(rows, first, line, columns)
    between = [r for r in range(line, first) if any(not _is_empty(c) for c in rows[r])] if line else []
    if line is None and len(above) > 1 and len(_given(rows[above[-2]])) >= len(_given(rows[above[-1]])):
        _refuse_doubtful(_texts(rows[above[-2]], real), _texts(rows[above[-1]], real), above[-1] + 1)
        if header_units.unit_row(_texts(rows[above[-1]], real)):
            between, above = above[-1:], above[:-1]
    units = _units_around(rows, above, between, real, line) if line != 0 else [""] * real
    if not above or line == 0:
        return _Sheet([f"column {k + 1}" for k in range(real)], units, first, rows, "no names: columns by number")
    texts = _texts(rows[above[-1]], real)
    if real > 1 and sum(map(bool, texts)) == 1 and line is None:
        return _Sheet([f"column {k + 1}" for k in range(real)], units, first, rows, "no names: columns by number")
    names = [text or f"column {k}" for k, text in enumerate(texts, 1)]
    given, _ = header_units.in_names(names)
    units = [one or other for one, other in zip(units, given, strict=True)]
    return _Sheet(names, units, first, rows, f"names in row {above[-1] + 1}")


def _given(row: tuple[Any, ...]) -> list[Any]:
    return [cell for cell in row if not _is_empty(cell)]


def _refuse_lost(rows: list[tuple[Any, ...]], first: int, line: int | None, columns: list[int]) -> None:
    """Raise a ValueError for rows above the data that are rows of the table with a cell that is no number."""
    for r in range(line, first) if line else range(max(first - 1, 0), first):
        cells = [rows[r][k] for k in columns if k < len(rows[r]) and not _is_empty(rows[r][k])]
        text = next((cell for cell in cells if not _is_value(cell)), None)
        if text is not None and any(map(_is_value, cells)):
            raise ValueError(
                f"header: must be the number of a row with only rows of numbers below it, got {line!r}, and row "
                f"{r + 1} has the cell {str(text)!r} beside numbers; correct the cell, or give the row of names."
            )


def _refuse_doubtful(upper: list[str], lower: list[str], row: int) -> None:
    """Raise a ValueError for a row of texts that may be names or units."""
    units = header_units.unit_row(lower) or []
    evident, timed = any(map(header_units.is_evident, units)), any(map(TIME_NAME.fullmatch, upper))
    unknown = timed and not units and not any(map(TIME_NAME.fullmatch, lower)) and all(upper) and all(lower)
    if upper == lower or unknown or ("t" in units and not timed and not evident):
        raise ValueError(
            f"header: must be given, got None, as row {row} may be names or units, {_checks.shortened(lower)}; give "
            "the number of the row of names."
        )


def _units_around(
    rows: list[tuple[Any, ...]], above: list[int], between: list[int], real: int, line: int | None
) -> list[str]:
    """Return the units in the rows below the names, or in the row above them, which is the last one `above`."""
    for r in between:
        if units := header_units.unit_row(_texts(rows[r], real)):
            return units
    if between:
        raise ValueError(
            f"header: must be the number of the row above the data, or of one above units, got {line!r}, and row "
            f"{between[-1] + 1} has neither numbers nor known units."
        )
    if len(above) > 1 and len(_given(rows[above[-2]])) >= len(_given(rows[above[-1]])):
        units = header_units.unit_row(_texts(rows[above[-2]], real)) or []
        third = len(above) > 2 and len(_given(rows[above[-3]])) >= len(_given(rows[above[-2]]))
        if any(map(header_units.is_evident, units)):
            if third and line is None:
                raise ValueError(
                    f"header: must be given, got None, as row {above[-2] + 1} may be units, and it is not the one "
                    "below the names; give the number of the row of names."
                )
            return units
    return [""] * real


def _is_data(row: tuple[Any, ...], columns: list[int]) -> bool:
    """Return whether a row has values in the columns of values."""
    cells = [row[k] if k < len(row) else None for k in columns]
    return any(map(_is_value, cells)) and all(_is_value(cell) or _is_empty(cell) for cell in cells)


def _texts(row: tuple[Any, ...], count: int) -> list[str]:
    """Return the cells of a row as texts."""
    return [str(row[k]).strip() if k < len(row) and row[k] is not None else "" for k in range(count)]


def _channel(
    file: Path, sheet: str, name: str, place: int, table: _Sheet, formula: int | None, date_format: str | None
) -> StoredChannel:
    """Return a column of a table."""
    cells = [row[place] if place < len(row) else None for row in table.rows[table.first :]]
    kinds = {type(cell) for cell in cells if not _is_empty(cell)}
    remark, refusal = "", ""
    if bad := next((cell for cell in cells if isinstance(cell, str) and NUMBER_CELL.fullmatch(cell.strip())), None):
        refusal = (
            f"numbers that are stored as texts, such as {bad!r} in row {table.first + cells.index(bad) + 1}; convert "
        )
        refusal += "them in Excel (Data, Text to Columns)"
    elif formula is not None:
        refusal = f"a formula without a value in row {formula}; open and save the file in Excel, which computes it"
    elif any(issubclass(kind, STAMPS) for kind in kinds) and len(kinds) > 1 and kinds & {*CLOCKS, int, float, str}:
        refusal = "dates among other values, or times beyond 24 h among times of day; format the column as numbers"
    elif any(issubclass(kind, STAMPS) for kind in kinds):
        remark = "dates, to the microsecond"
    elif kinds and kinds <= {*CLOCKS}:
        remark = "times of day or durations"
    if kinds == {str} and date_format is not None:
        texts = np.array([None if _is_empty(cell) else cell for cell in cells], dtype=object)
        dates, remark, _ = text_cells.times(texts, date_format)
        if dates is not None:
            return StoredChannel(name, len(cells), dates.copy, sheet, table.units[place], remarks=(remark,))
    read = partial(_values, file, sheet, place, table.first, cells)
    remarks = (*((remark,) if remark else ()), *header_units.remarks(name, table.units[place]))
    return StoredChannel(name, len(cells), read, sheet, table.units[place], remarks=remarks, refusal=refusal)


def _percents(file: Path, sheet: str, table: _Sheet) -> dict[int, set[bool]]:
    """Return whether numbers are shown in percent, by the place of columns with this unit."""
    places = [place for place, unit in enumerate(table.units) if "%" in unit]
    result: dict[int, set[bool]] = {place: set() for place in places}
    if places:
        with _opened(file) as book, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            book[sheet].reset_dimensions()
            for row in book[sheet].iter_rows(min_row=table.first + 1):
                for place in places:
                    if place < len(row) and isinstance(row[place].value, int | float):
                        result[place].add("%" in LITERAL.sub("", row[place].number_format or ""))
    return result


def _without_percent(channel: StoredChannel, percents: set[bool]) -> StoredChannel:
    """Return a channel without the unit of percents if its cells show them, as these store a hundredth."""
    if True not in percents:
        return channel
    if len(percents) > 1 or channel.unit != "%":
        return replace(
            channel,
            refusal=channel.refusal
            or f"the unit {channel.unit!r} and cells in the format of percents, which store a hundredth; format all "
            "cells as numbers",
        )
    remark = "cells in the format of percents, which store a hundredth: a ratio without a unit"
    return replace(channel, unit="", remarks=(*channel.remarks, remark))


def _values(file: Path, sheet: str, place: int, first: int, cells: list[Any]) -> np.ndarray:
    """Return the cells of a column as numbers, dates, durations or texts."""
    given = [cell for cell in cells if not _is_empty(cell)]
    if given and all(isinstance(cell, STAMPS + CLOCKS) for cell in given):
        return _moments(file, sheet, place, first, cells, isinstance(given[0], STAMPS))
    if all(isinstance(cell, int | float) for cell in given):
        if given and all(isinstance(cell, bool) for cell in given) and len(given) == len(cells):
            return np.array(cells)
        return np.array([np.nan if _is_empty(cell) else float(cell) for cell in cells])
    return np.array([np.nan if _is_empty(cell) else cell for cell in cells], dtype=object)


def _moments(file: Path, sheet: str, place: int, first: int, cells: list[Any], dated: bool) -> np.ndarray:
    """Return dates or times of day by the days that are stored, as openpyxl 3.1 rounds them to milliseconds."""
    with _opened(file, raw=True) as book:
        rows = _rows(book[sheet])[first:]
        epoch = np.datetime64(book.epoch)
    days = [row[place] if place < len(row) else None for row in rows]
    result = np.full(len(cells), np.timedelta64("NaT", "us"), "timedelta64[us]")
    for k, (day, cell) in enumerate(zip(days, cells, strict=True)):
        if _is_empty(cell):
            continue
        if not isinstance(day, int | float):  # a date that is stored as a text of ISO 8601
            if not dated or not isinstance(day, datetime.datetime):
                raise ValueError(f"its cell in row {first + k + 1} is no date that can be read, {day!r}")
            result[k] = np.datetime64(day, "us") - epoch
            continue
        result[k] = np.timedelta64(round(day * MICROSECONDS), "us")
    result = _on_grid(result)
    return epoch + result if dated else text_cells.rolled(result)[0]


def _on_grid(times: np.ndarray) -> np.ndarray:
    """Return times in microseconds as multiples of the longest unit that all of them have within their resolution."""
    known = times[~np.isnat(times)].astype(np.int64)
    for unit in (1_000_000, 1000, 100, 10):
        rounded = np.round(known / unit).astype(np.int64) * unit
        if (np.abs(rounded - known) <= 1).all():
            times[~np.isnat(times)] = rounded.astype("timedelta64[us]")
            break
    return times


def _formulas(file: Path, sheet: str, table: _Sheet) -> dict[int, int]:
    """Return the first row (from 1) with a formula whose value is not stored, by the place of its column."""
    size = len(table.names)
    if not any(len(row) < size or None in row[:size] for row in table.rows[table.first :]):
        return {}
    with _opened(file, formulas=True) as book:
        rows = _rows(book[sheet])
    result: dict[int, int] = {}
    for number, (row, values) in enumerate(itertools.zip_longest(rows, table.rows, fillvalue=()), 1):
        for place, cell in enumerate(row if number > table.first else ()):
            formula = (isinstance(cell, str) and cell.startswith("=")) or type(cell).__name__.endswith("Formula")
            if formula and (place >= len(values) or values[place] is None):
                result.setdefault(place, number)
    return result
