"""Texts of columns, such as CSV, as they come: separator, decimal sign, encoding and header are recognised."""

import csv
import io
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.formats import header_units, text_cells
from bayesperiodic.data.formats.contents import Contents, Key, StoredChannel
from bayesperiodic.data.formats.encodings import PART_BYTES, Text, opened
from bayesperiodic.data.formats.header_units import MISSING
from bayesperiodic.data.formats.text_cells import CellEvidence
from bayesperiodic.data.formats.text_header import (
    BLANKS,
    TIME_NAME,
    USABLE,
    Head,
    head,
    known_separator,
    line_number,
    numbered,
    rows_of,
    skip,
)  # fmt: skip

# Columns of a file, and per wanted one, above which the others are not made numbers; the separator of the wanted ones.
NARROW_COLUMNS, UNWANTED_RATIO, UNIT_SEPARATOR = 200, 2, "\x1f"
# Cells that pandas reads at once, and least rows.
PART_CELLS, PART_ROWS = 200_000, 2000
# Bytes at the end of a file among which rows of summaries are searched for, and their first words.
TAIL_BYTES = 2**14
SUMMARY = re.compile(
    r"\W*(mean|average|avg\.?|min(imum)?|max(imum)?|sum|total|std(ev)?\.?|st\.?dev\.?|rms|median|count|mittel(wert)?|summe"
    r"|end( of .*)?|ende)\W*",
    re.IGNORECASE,
)
TIME_UNITS = ("s", "ms", "us", "µs", "min", "h", "sec", "second", "Second")
LOGICAL = "logical values, 1 for True and 0 for False"
DECIMAL_SIGNS = {".": "decimal point", ",": "decimal comma"}


@dataclass(frozen=True)
class _Notation:
    """Decimal sign, the sign between thousands and the format of dates, None where they are recognised."""

    decimal: str | None
    thousands: str | None
    date_format: str | None


def contents(
    file: Path,
    wanted: list[Key],
    *,
    encoding: str | None = None,
    separator: str | None = None,
    decimal: str | None = None,
    thousands: str | None = None,
    header: int | None = None,
    date_format: str | None = None,
) -> Contents:
    """Return the columns of a text; those that are `wanted` are read at once, or all if there are none."""
    notation = _notation(decimal, thousands, date_format)
    given = None if separator is None else known_separator(separator)
    text, line = opened(file, encoding), line_number(header)
    keys: list[Any] = [key[1] if isinstance(key, tuple) and len(key) == 2 and not key[0] else key for key in wanted]
    try:
        top = head(text, [key for key in keys if isinstance(key, str)], given, line)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {text!r} ({error}).") from None
    names = numbered([name or f"column {k}" for k, name in enumerate(top.names, 1)])
    places = {}
    for key in keys:
        if isinstance(key, str):
            places[_place(file, top.names, names, key)] = key
        elif isinstance(key, int) and not isinstance(key, bool) and 1 <= key <= len(names):
            places[key - 1] = str(key)
    _refuse_summaries(text, top)
    read, sign, rows = _columns(text, top, [*places] or [*range(len(names))], notation)
    guessed = text.remark.startswith("encoding 'cp1252' of")
    units, refusals = header_units.in_names(top.names, guessed=guessed)
    refusals |= header_units.in_other_encoding(dict(enumerate(top.units))) if guessed else {}
    channels = []
    for place, name in enumerate(names):
        unit = (top.units[place] if place < len(top.units) else "") or units[place]
        values, remark, refusal = read.get(place) or (partial(_later, text, top, place, notation), "", "")
        channels.append(
            StoredChannel(
                name,
                rows,
                values if callable(values) else partial(_given, values),
                unit=unit,
                remarks=(*((remark,) if remark else ()), *header_units.remarks(name, unit)),
                refusal=refusals.get(place, "") or refusal,
            )
        )
    remarks = [top.remark + (f", {DECIMAL_SIGNS.get(sign, f'decimal {sign!r}')}" if sign else "")]
    return Contents(
        "CSV file",
        tuple(channels),
        (*remarks, *([text.remark] if text.remark else [])),
        word="column",
        suggested_time="" if places else _suggested_time(channels, read),
    )


def _given(values: np.ndarray) -> np.ndarray:
    return values


def _later(file: Text, top: Head, place: int, notation: _Notation) -> np.ndarray:
    """Return the values of a column that was not wanted at once."""
    values, _, refusal = _columns(file, top, [place], notation)[0][place]
    if refusal:
        raise ValueError(f"its column {place + 1} has {refusal}")
    return values


def _notation(decimal: str | None, thousands: str | None, date_format: str | None) -> _Notation:
    """Return the notation that was given; a sign between thousands leaves the other one for decimals."""
    if decimal is not None:
        _checks.one_of("decimal", decimal, (".", ","))
    if thousands is not None:
        _checks.one_of("thousands", thousands, (".", ",", "'", "’", " ", "\u00a0", "\u202f"))
        if thousands == decimal:
            raise ValueError(f"thousands: must differ from decimal, got {thousands!r} for both.")
        if decimal is None and thousands in ",.":
            decimal = "," if thousands == "." else "."
    if date_format is not None:
        _checks.text("date_format", date_format)
        if "%" not in date_format:
            raise ValueError(f"date_format: must be a format such as '%d.%m.%Y %H:%M:%S.%f', got {date_format!r}.")
    return _Notation(decimal, thousands, date_format)


Read = dict[int, tuple[np.ndarray, str, str]]


def _columns(file: Text, top: Head, places: list[int], notation: _Notation) -> tuple[Read, str, int]:
    """Return columns with a remark and a refusal, the decimal sign if there are any, and the number of rows."""
    evidence = CellEvidence.of(cell for row in top.sample for cell in row[: len(top.names)])
    decimal = notation.decimal or evidence.sign or "."
    table, rows = _table(file, top, places, decimal)
    if top.separator == ";" and notation.decimal is None and not evidence.sign and evidence.either == {"."}:
        _refuse_groups(file, top)
    texts = {place: values for place, values in table.items() if values.dtype == object}
    for values in texts.values():
        evidence |= CellEvidence.of(cell.strip(" \t") for cell in values if isinstance(cell, str))
    sign = notation.decimal or evidence.sign
    if not sign and {",", "."} <= evidence.either and not evidence.decimal:
        raise ValueError(
            f"decimal: must be given for {file.path.name!r}, whose numbers have points and commas before three digits; "
            "give decimal='.' or decimal=','."
        )
    if (sign or ".") != decimal:
        decimal = sign or "."
        table, rows = _table(file, top, places, decimal)
    result: Read = {}
    for place, values in table.items():
        if values.dtype == object:
            result[place] = _converted(values, decimal, bool(sign), notation, top)
        else:
            result[place] = values, LOGICAL if values.dtype == bool else "", ""
    if notation.date_format and not any(values.dtype.kind in "mM" for values, _, _ in result.values()):
        cell = next((cell for values in texts.values() for cell in values if isinstance(cell, str)), "numbers")
        raise ValueError(
            f"date_format: must be that of all cells of a column of {file.path.name!r}, got {notation.date_format!r}, "
            f"and cells such as {cell!r}."
        )
    shown = sign or ("." if "," not in evidence.decimal | evidence.either else "")
    return result, shown if evidence.decimal | evidence.either | evidence.thousands else "", rows


def _refuse_groups(file: Text, top: Head) -> None:
    """Raise a ValueError if all points of a text stand before three digits and after no zero."""
    evidence, shown = CellEvidence(), ""
    with file.open() as text:
        for row in skip(text, top.lines, top.separator):
            cells = [cell.strip() for cell in row]
            evidence |= CellEvidence.of(cells)
            shown = shown or next((cell for cell in cells if text_cells.EITHER.fullmatch(cell)), "")
            if evidence.sign or "," in evidence.either:
                return
    raise ValueError(
        f"decimal: must be given for {file.path.name!r}, in whose numbers such as {shown!r} the points may be decimal "
        "or stand between thousands; give decimal='.' or decimal=','."
    )


def _converted(
    values: np.ndarray, decimal: str, sure: bool, notation: _Notation, top: Head
) -> tuple[np.ndarray, str, str]:
    """Return a column of texts as numbers, dates or durations if all of its cells are, with a remark and a refusal."""
    cells = [cell.strip(" \t") for cell in values if isinstance(cell, str)]
    if sure or not any("," in cell for cell in cells) or not text_cells.refusal(cells, sure):
        if (read := text_cells.numbers(values, decimal, notation.thousands)) is not None:
            return read, "numbers with signs between thousands, or exponents of Fortran", ""
    dates, remark, refusal = text_cells.times(values, notation.date_format)
    if dates is not None or refusal:
        return (values if dates is None else dates), remark, refusal
    if (
        top.titled
        and (row := next((k for k, cell in enumerate(values) if cell in top.names and cell), None)) is not None
    ):
        if all(USABLE.fullmatch(cell) for cell in cells[:row] if cell not in MISSING) and row:
            return (
                values,
                "",
                f"the name {values[row]!r} again in data row {row + 1}: the file has several tables; save each",
            )
    if decimal == "," and (bad := text_cells.other_than_numbers(values)):
        return values, "", bad
    return values, "", text_cells.refusal(cells, sure)


def _suggested_time(channels: list[StoredChannel], read: Read) -> str:
    """Return the name of the column that seems to hold the times: by its name or its dates, and increasing."""
    named = [TIME_NAME.fullmatch(channel.name) is not None for channel in channels]
    dated = []
    for place, (channel, name) in enumerate(zip(channels, named, strict=True)):
        values, _, refusal = read[place]
        texts = values.dtype == object and all(map(text_cells.is_moment, (*values[:100], *values[-100:])))
        if refusal:
            continue
        if values.dtype.kind in "mM" or texts:
            dated += [channel.name] if values.size > 1 and values[0] != values[-1] else []
        elif values.dtype.kind in "fiu" and values.size > 1 and (np.diff(values) > 0).all():
            if name:
                return channel.name
            dated += [channel.name] if channel.unit in TIME_UNITS else []
    return dated[0] if dated else ""


def _table(file: Text, top: Head, places: list[int], decimal: str) -> tuple[dict[int, np.ndarray], int]:
    """Return wanted columns of a text as pandas reads them, and the number of rows."""
    import pandas as pd

    others = pd.errors.ParserError, pd.errors.ParserWarning
    try:
        try:
            return _read(file, top, places, decimal, max(top.more, 0))
        except others:  # rows with another number of fields than the first; one more that is empty is none
            return _read(file, top, places, decimal, max(top.more, 0) + 1)
    except (*others, _OtherFields) as error:
        _check_fields(file, top)
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r} ({error}).") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r} ({error}).") from None


def _read(file: Text, top: Head, places: list[int], decimal: str, surplus: int) -> tuple[dict[int, np.ndarray], int]:
    """Return wanted columns of a text whose rows have so many surplus fields at most, and the number of rows."""
    import pandas as pd

    names, separator, lines = top.names, top.separator, top.lines
    with file.open() as text, warnings.catch_warnings():
        skip(text, lines, separator)
        warnings.simplefilter("error", pd.errors.ParserWarning)
        source: Any = text
        if file.last_comment > lines:
            source = io.StringIO("".join(line for line in text if not line.lstrip().startswith("#")))
        width = len(names)
        at = {place: place for place in places}
        # The only column of a file may have empty cells, which are empty lines, but not at the end.
        alone = width == 1
        if alone:
            source = io.StringIO(source.read().rstrip(" \t\r\n"))
        elif NARROW_COLUMNS < width > len(places) * UNWANTED_RATIO or separator == BLANKS and top.more > 0:
            source = _narrowed(rows_of(source, separator, strict=True), places, width, width + max(top.more, 0) + 1)
            at = {place: k for k, place in enumerate(places)}
            width, surplus, separator = len(places) + 1, 0, UNIT_SEPARATOR
        missing: Any = dict(enumerate([MISSING] * width + [[""]] * surplus))
        options: dict[str, Any] = {
            "skip_blank_lines": not alone,
            "sep": r"\s+" if separator == BLANKS else separator,
            "decimal": decimal,
            "header": None,
            "names": range(width + surplus),
            "index_col": False,
            "skipinitialspace": _has_blanks(file, top),
            "low_memory": False,
            "keep_default_na": False,
            "na_values": missing,
        }
        start = source.tell() if source is not text else None
        table = _in_parts(source, options, {*at.values(), *range(width - 1, width + surplus)})
        if table is None:
            if start is None:
                text.seek(0)
                skip(text, lines, top.separator)
            else:
                source.seek(start)
            frame = pd.read_csv(source, **options)
            table = {k: frame[k].to_numpy() for k in frame}
    if not table[width - 1].size:
        raise ValueError(f"path: must be a CSV file with rows of data, got {file!r}, which has none.")
    if any(pd.notna(table[k]).any() for k in range(width, width + surplus)) or pd.isna(table[width - 1]).any():
        _check_fields(file, top)
    return {place: table[k] for place, k in at.items()}, table[width - 1].size


def _has_blanks(file: Text, top: Head) -> bool:
    """Return whether there are blanks in the data; those at the beginning of fields take pandas a fifth of its time."""
    if file.blanks:
        return True
    with file.open() as text:
        skip(text, top.lines, top.separator)
        return " " in text.read(PART_BYTES)


def _in_parts(source: Any, options: dict[str, Any], kept: set[int]) -> dict[int, np.ndarray] | None:
    """Return the kept columns, which pandas reads part by part, or None if parts of one are of different kinds.

    It takes two thirds of the time of the whole at once.
    """
    import pandas as pd

    try:
        rows = max(PART_CELLS // len(options["names"]), PART_ROWS)
        with pd.read_csv(source, chunksize=rows, **options) as parts:
            tables = [{k: part[k].to_numpy() for k in kept} for part in parts]
    except pd.errors.EmptyDataError:
        return {k: np.empty(0) for k in options["names"]}
    if not tables:
        return {k: np.empty(0) for k in options["names"]}
    columns = {}
    for k in [*tables[0]]:
        kinds = {table[k].dtype.str for table in tables}
        if len(kinds) > 1 and not kinds <= {"<i8", "<f8"}:
            return None
        columns[k] = tables[0][k] if len(tables) == 1 else np.concatenate([table.pop(k) for table in tables])
    return columns


class _OtherFields(Exception):
    """A row of a wide file has another number of fields than there are names."""


def _narrowed(rows: Iterable[list[str]], places: list[int], width: int, most: int) -> TextIO:
    """Return the wanted fields of all rows as CSV, with a last column of zeros; rows have `width` to `most` fields.

    The table of all columns of a wide file would take several times the memory of the file.
    """
    narrow = io.TextIOWrapper(io.BytesIO(), "utf-8", newline="")
    writer = csv.writer(narrow, delimiter=UNIT_SEPARATOR)
    for row in rows:
        if len(row) < 2 and not any(map(str.strip, row)):
            continue
        short = len(row) < width and any(map(str.strip, row))
        if short or len(row) > most or any(map(str.strip, row[width:])):
            raise _OtherFields("rows have different numbers of fields")
        writer.writerow([*(row[place] if place < len(row) else "" for place in places), "0"])
    narrow.seek(0)
    return narrow


def _check_fields(file: Text, top: Head) -> None:
    """Raise a ValueError unless each row has one field per name, and equally many empty ones after them."""
    names = top.names
    with file.open() as text:
        fields, rows = None, skip(text, top.lines, top.separator)
        data = (row for row in rows if any(field.strip() for field in row))
        for number, row in enumerate(data, 1):
            if row[0].lstrip().startswith("#") and file.last_comment > top.lines:
                continue
            fields = fields or len(row)
            if len(row) < len(names) or len(row) != fields or any(field.strip() for field in row[len(names) :]):
                raise ValueError(
                    f"path: must be a CSV file with {len(names)} fields in each row, as many as there are names, got "
                    f"{len(row)} in data row {number} of {file!r}."
                )


def _refuse_summaries(file: Text, top: Head) -> None:
    """Raise a ValueError if the last rows are no samples but summaries of them, such as "Mean;1.5"."""
    if file.encoding.lower().replace("-", "").startswith(("utf16", "utf32")):
        with file.open() as text:
            ending = text.read()[-TAIL_BYTES:]
    else:
        with file.path.open("rb") as content:
            content.seek(0, 2)
            content.seek(max(content.tell() - TAIL_BYTES, 0))
            ending = content.read().decode(file.encoding, errors="replace")
    columns = [
        place for place in range(len(top.names))
        if 2 * sum(place < len(row) and bool(USABLE.fullmatch(row[place])) for row in top.sample) >= len(top.sample)
    ]  # fmt: skip
    try:
        rows = [*rows_of(ending.splitlines()[1:], top.separator)]
    except csv.Error:
        return
    for row in rows[-20:]:
        cell = next((row[k] for k in columns if k < len(row) and SUMMARY.fullmatch(row[k])), None)
        if cell is not None and any(map(USABLE.fullmatch, map(str.strip, row))):
            raise ValueError(
                f"path: must be a CSV file with a sample in each row, got {file!r}, whose row {_checks.shortened(row)} "
                "after the data seems to be a summary; remove it."
            )


def _place(file: Path, raw: list[str], names: list[str], column: str) -> int:
    if raw.count(column) <= 1:
        _checks.one_of(f"column of {file.name}", column, [*names, *raw] if column in raw else names)
        return raw.index(column) if column in raw else names.index(column)
    places = [i + 1 for i, name in enumerate(raw) if name == column]
    raise ValueError(
        f"column of {file.name}: must be the name of one column, got {column!r}, the name of {len(places)} "
        f"(columns {', '.join(map(str, places))}); give its number, or rename them in the file."
    )
