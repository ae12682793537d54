"""Texts of columns, such as CSV."""

import codecs
import csv
import io
import itertools
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from bayesperiodic import _checks
from bayesperiodic.data.formats.contents import Contents, Key, StoredChannel

# Texts of missing values.
MISSING = [
    "", "nan", "NaN", "NAN", "-nan", "-NaN", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None", "1.#IND",
    "-1.#IND", "1.#QNAN", "-1.#QNAN",
]  # fmt: skip
# Lines among which the header is searched for, and separators of fields, in the order in which they are tried.
PREAMBLE, SEPARATORS = 1000, (",", ";", "\t")
# Bytes that are decoded at once, and columns per wanted column above which the others are not made numbers.
PART_BYTES, UNWANTED_RATIO = 2**20, 2


Stored = tuple[list[str], dict[str, Any]]


@dataclass(frozen=True)
class _Text:
    """A text file and its encoding."""

    path: Path
    encoding: str

    def __repr__(self) -> str:
        return repr(str(self.path))

    def open(self) -> TextIO:
        """Return the opened file, with the ends of its lines as they are and without a byte order mark."""
        marked = codecs.lookup(self.encoding).name == "utf-8"
        return self.path.open(encoding="utf-8-sig" if marked else self.encoding, newline="")

    def check(self) -> None:
        """Raise a ValueError if the file is not in its encoding, or contains characters 0, at which numbers end."""
        name = "UTF-8" if self.encoding == "utf-8" else self.encoding
        line, decoder = 1, codecs.getincrementaldecoder(self.encoding)()
        with self.path.open("rb") as content:
            marked = content.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
            content.seek(0)
            for part in itertools.chain(iter(lambda: content.read(PART_BYTES), b""), [b""]):
                try:
                    text = decoder.decode(part, final=not part)
                except UnicodeDecodeError as error:
                    line += error.object[: error.start].count(b"\n")
                    other = "UTF-16, encoding='utf-16'" if marked else "Latin-1, encoding='latin-1'"
                    raise ValueError(
                        f"path: must be a CSV file in {name}, got {self!r}, whose line {line} has the byte "
                        f"0x{error.object[error.start]:02x}; it may be in {other}, or in that of the program which "
                        "wrote it, such as encoding='cp1252' of Windows."
                    ) from None
                if "\0" in text:
                    raise ValueError(
                        f"path: must be a CSV file in {name}, got {self!r}, which contains bytes 0; it was damaged "
                        f"when it was written, or is no text in {name}; see encoding, such as encoding='utf-16'."
                    )
                line += text.count("\n")


def contents(file: Path, wanted: list[Key], *, encoding: str = "utf-8") -> Contents:
    """Return the columns of a text; those that are `wanted` are read at once."""
    try:
        "".encode(encoding)
    except (LookupError, TypeError, ValueError):
        raise ValueError(
            f"encoding: must be one of Python's, such as 'utf-8', 'latin-1' or 'cp1252', got {encoding!r}."
        ) from None
    names, columns = _csv_columns(_Text(file, encoding), [str(key) for key in wanted])
    rows = len(next(iter(columns.values()), ()))
    channels = [StoredChannel(name, rows, partial(columns.__getitem__, name)) for name in names if name in columns]
    return Contents("CSV file with a header line", tuple(channels), word="column")


def _csv_columns(file: _Text, wanted: list[str]) -> Stored:
    """Return names and wanted columns of a CSV file; the header is the first line with all of these names."""
    import pandas as pd

    file.check()
    try:
        names, lines, more, separator = _header(file, wanted)
        places = {column: _place(file.path, names, column) for column in wanted}
        with file.open() as text, warnings.catch_warnings():
            _skip(text, lines, separator)
            warnings.simplefilter("error", pd.errors.ParserWarning)
            width, source = len(names), text
            # More columns than names hold the fields after trailing commas.
            # The only column of a file may have empty cells, which are empty lines, but not at the end.
            alone, surplus = width == 1, max(more, 0) + 1
            if alone:
                source = io.StringIO(text.read().rstrip())
            elif UNWANTED_RATIO * len(places) < width:
                rows = csv.reader(text, delimiter=separator, skipinitialspace=True, strict=True)
                source = _narrowed(rows, [*places.values()], width, width + surplus)
                width, surplus = len(places) + 1, 1
                places, separator = {column: place for place, column in enumerate(places)}, ","
            missing: Any = dict(enumerate([MISSING] * width + [[""]] * surplus))
            table = pd.read_csv(
                source,
                skip_blank_lines=not alone,
                sep=separator,
                header=None,
                names=range(width + surplus),
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
                keep_default_na=False,
                na_values=missing,
            )
    except (pd.errors.ParserError, pd.errors.ParserWarning, _OtherFields) as error:
        _check_fields(file, names, lines, separator)
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r} ({error}).") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r} ({error}).") from None
    if table.empty:
        raise ValueError(f"path: must be a CSV file with rows of data, got {file!r}, which has none.")
    if table.iloc[:, width:].notna().any(axis=None) or table[width - 1].isna().any():
        _check_fields(file, names, lines, separator)
    return names, {column: table[place].to_numpy() for column, place in places.items()}


class _OtherFields(Exception):
    """A row of a wide file has another number of fields than there are names."""


def _narrowed(rows: Iterable[list[str]], places: list[int], width: int, most: int) -> TextIO:
    """Return the wanted fields of all rows as CSV, with a last column of zeros; rows have `width` to `most` fields.

    The table of all columns of a wide file would take several times the memory of the file.
    """
    narrow = io.TextIOWrapper(io.BytesIO(), "utf-8", newline="")
    writer = csv.writer(narrow)
    for row in rows:
        if len(row) < 2 and not any(map(str.strip, row)):
            continue
        short = len(row) < width and any(map(str.strip, row))
        if short or len(row) > most or any(map(str.strip, row[width:])):
            raise _OtherFields("rows have different numbers of fields")
        writer.writerow([*(row[place] if place < len(row) else "" for place in places), "0"])
    narrow.seek(0)
    return narrow


def _header(file: _Text, columns: list[str]) -> tuple[list[str], int, int, str]:
    """Return the names of the columns of a CSV file and three facts: lines up to there, surplus fields, separator.

    The separator is the first one for which a line contains all columns, or else that with most of them.
    """
    headers: list[tuple[list[str], int, int, str]] = []
    for separator in SEPARATORS:
        try:
            headers.append((*_line_of_names(file, columns, separator), separator))
        except csv.Error:  # a long line is one field for another separator than its own
            if not headers and separator == SEPARATORS[-1]:
                raise
            continue
        if {*columns} <= {*headers[-1][0]}:
            return headers[-1]
    best = max(headers, key=lambda header: len({*columns} & {*header[0]}))
    if _is_no_header(best[0]):
        raise ValueError(
            "path: must be a CSV file whose first line names the columns, separated by commas, semicolons or tabs, got "
            f"{file!r}, whose first line is read as {_checks.shortened(best[0])}. Numbers must have a decimal point."
        )
    return best


def _line_of_names(file: _Text, columns: list[str], separator: str) -> tuple[list[str], int, int]:
    """Return the names in the line with most columns, the number of lines up to there, and of fields that follow.

    Without a line of all names, that with most of them tells what is missing.
    """
    most, names, number, more, following = -1, [""], 0, 0, False
    with file.open() as text:
        rows = csv.reader(text, delimiter=separator, skipinitialspace=True)
        for row in filter(None, itertools.islice(rows, PREAMBLE)):
            if following:
                more, following = len(row) - len(names), False
                if most == len({*columns}):
                    break
            fields = [name.strip() for name in row]
            if (count := len({*columns} & {*fields})) > most:
                most, number, more, following = count, rows.line_num, 0, True
                names = fields[: max((i for i, name in enumerate(fields, 1) if name), default=len(fields))]
    if most < 0:
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r}, which is empty.")
    return names, number, more


def _check_fields(file: _Text, names: list[str], lines: int, separator: str) -> None:
    """Raise a ValueError unless each row has one field per name, and equally many empty ones after them."""
    with file.open() as text:
        fields, rows = None, _skip(text, lines, separator)
        data = (row for row in rows if any(field.strip() for field in row))
        for number, row in enumerate(data, 1):
            fields = fields or len(row)
            if len(row) < len(names) or len(row) != fields or any(field.strip() for field in row[len(names) :]):
                raise ValueError(
                    f"path: must be a CSV file with {len(names)} fields in each row, as many as there are names, got "
                    f"{len(row)} in data row {number} of {file!r}."
                )


def _skip(text: TextIO, lines: int, separator: str) -> Iterator[list[str]]:
    """Read a file up to the end of its header, and return an iterator over the rows that follow."""
    rows = csv.reader(text, delimiter=separator, skipinitialspace=True)
    while rows.line_num < lines:
        next(rows)
    return rows


def _place(file: Path, names: list[str], column: str) -> int:
    _checks.one_of(f"column of {file.name}", column, names)
    if (count := names.count(column)) > 1:
        places = [i + 1 for i, name in enumerate(names) if name == column]
        raise ValueError(
            f"column of {file.name}: must be the name of one column, got {column!r}, the name of {count} "
            f"(columns {', '.join(map(str, places))}); rename them in the file."
        )
    return names.index(column)


def _is_no_header(names: list[str]) -> bool:
    """Return whether a first line contains numbers, or separators other than commas."""
    if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
        return True
    try:
        return bool([float(name) for name in names])
    except ValueError:
        return False
