"""Header, separator and decimal sign of a text of columns, by evidence."""

import collections
import csv
import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TextIO

from bayesperiodic import _checks
from bayesperiodic.data.formats.encodings import Text
from bayesperiodic.data.formats.header_units import (
    MISSING,
    is_evident,
    is_possible,
    known,
    mostly_known,
    unbracketed,
    unit_row,
)

# Lines among which the header is searched for, separators of fields in the order in which they are tried, and one that
# stands for any number of blanks and tabs.
PREAMBLE, SEPARATORS, BLANKS = 1000, (",", ";", "\t", "|"), " "
# Lines and characters that are looked at for evidence, and rows below a header.
SAMPLE_LINES, SAMPLE_CHARACTERS, SAMPLE_ROWS = 1400, 2**20, 100
# Characters of a line of names that are divided in several ways.
LONGEST_LINE = 2**14
WORDS = {",": "','", ";": "';'", "\t": "tab", "|": "'|'", BLANKS: "blanks"}

EXPONENT = r"(?:[eE][+-]?[0-9]+|[dD][+-][0-9]{2,3})?"
GROUPS = r"[0-9]{1,3}(?:(?P<mark>[.,'’ \u00a0\u202f])[0-9]{3})(?:(?P=mark)[0-9]{3})*(?:[.,][0-9]+)?"
PLAIN_NUMBER = rf"(?:[0-9]+(?:\.[0-9]*|,[0-9]+)?|[.,][0-9]+){EXPONENT}|[Ii]nf(?:inity)?"
TIME_OF_DAY = r"[0-9]{1,2}:[0-5][0-9](?::[0-5][0-9])?(?:[.,][0-9]+)?(?: ?[AaPp][Mm])?"
DATE = rf"[0-9]{{1,4}}[-./][0-9]{{1,2}}[-./][0-9]{{1,4}}(?:[T ]+{TIME_OF_DAY})?(?:Z|[+-][0-9]{{2}}:?[0-9]{{2}})?"
NUMBER_CELL = re.compile(rf"[+-]?(?:{PLAIN_NUMBER}|{GROUPS})")
USABLE = re.compile(rf"[+-]?(?:{PLAIN_NUMBER}|{GROUPS})|{TIME_OF_DAY}|{DATE}")
NEARLY_A_NUMBER = re.compile(r"[+-][0-9]+:[0-9:.,]+")  # such as a negative time of day
TIME_NAME = re.compile(
    r"\W*(t|time|zeit|temps|tiempo|tempo|timestamp|zeitstempel|date|datum|datetime|uhrzeit|elapsed)\b.*", re.IGNORECASE
)
# Blanks between names of a line of names, from the finest division on.
NAME_BLANKS = (r"\s+", r"\s+(?![\[(/]|\S+[\])])", r"\s{2,}|\t")
COMMENT_MARK = re.compile(r"^\s*[#%]+\s*")


@dataclass(frozen=True)
class Head:
    """Names of the columns, lines up to the data, surplus fields of rows, the separator, and units below the names."""

    names: list[str]
    lines: int
    more: int
    separator: str
    units: list[str] = field(default_factory=list)
    titled: bool = True  # whether there is a line of names
    sample: list[list[str]] = field(default_factory=list)  # first rows of the data
    even: bool = True  # whether the row below the names has as many fields, apart from empty ones

    @property
    def remark(self) -> str:
        """What was recognised."""
        header = f"names in line {self.lines - bool(self.units)}" if self.titled else "no names: columns by number"
        return f"separator {WORDS.get(self.separator, repr(self.separator))}, {header}" + (
            ", units in the row below" if self.units else ""
        )


def rows_of(text: Iterable[str], separator: str, *, strict: bool = False) -> Iterator[list[str]]:
    """Return the fields of the rows of a text."""
    if separator == BLANKS:
        return (line.split() for line in text)
    return csv.reader(text, delimiter=separator, skipinitialspace=True, strict=strict)


def skip(text: TextIO, lines: int, separator: str) -> Iterator[list[str]]:
    """Read a file up to the end of its header, and return an iterator over the rows that follow."""
    if separator == BLANKS:
        collections.deque(itertools.islice(text, lines), maxlen=0)
        return rows_of(text, separator)
    rows = csv.reader(text, delimiter=separator, skipinitialspace=True)
    while rows.line_num < lines:
        next(rows)
    return rows


def head(file: Text, wanted: list[str], separator: str | None, line: int | None) -> Head:
    """Return the header of a text: the line with all names that are wanted, or else that above the columns."""
    if line is None and wanted:
        best = _by_names(file, wanted, separator)
        if {*wanted} <= {*numbered(best.names), *best.names}:
            return _with_units(file, best)
    else:
        best = None
    seen = _by_evidence(file, separator, line)
    if best and (seen is None or {*wanted} & {*best.names}):
        if seen is None and not {*wanted} & {*best.names}:
            _refuse_others(file)
        if best.separator != BLANKS or {*wanted} & {*best.names}:
            return _with_units(file, best)
    if seen is None:
        _refuse_others(file)
        raise ValueError(
            f"path: must be a CSV file with a header line, or columns of numbers, got {file!r}, which has no rows of "
            "numbers that a comma, a semicolon, a tab or blanks separate."
        )
    return seen


def numbered(names: list[str]) -> list[str]:
    """Return names that differ: all of a repeated name get their number, such as "x (1)"."""
    counts = collections.Counter(names)
    if len(counts) == len(names):
        return names
    seen: collections.Counter[str] = collections.Counter()
    result, used = [], {*names}
    for name in names:
        seen[name] += 1
        new = name
        while counts[name] > 1 and (new == name or new in used):
            new = f"{name} ({seen[name]})" if new == name else f"{new}'"
        used.add(new)
        result.append(new)
    return result


def _refuse_others(file: Text) -> None:
    """Raise a ValueError for a text in a notation of its own."""
    with file.open() as text:
        start = text.read(500).lstrip()
    for mark, kind in (("<", "HTML or XML"), ("{", "JSON"), ("[{", "JSON"), ("[[", "JSON")):
        if start.startswith(mark):
            raise ValueError(f"path: must be a CSV file with a header line, got {file!r}, which seems to be {kind}.")


def _by_names(file: Text, wanted: list[str], separator: str | None) -> Head:
    """Return the header with all names, by the first separator for which the row below it has as many fields."""
    headers: list[Head] = []
    candidates = (separator,) if separator else (*SEPARATORS, BLANKS)
    for candidate in candidates:
        try:
            headers.append(_line_of_names(file, wanted, candidate))
        except csv.Error:  # a long line is one field for another separator than its own
            if separator:
                raise
            continue
        if headers[-1].even and {*wanted} <= {*headers[-1].names}:
            return headers[-1]
    complete = [one for one in headers if {*wanted} <= {*one.names, *numbered(one.names)}]
    if complete:
        return next((one for one in complete if one.even), complete[0])
    return max(headers, key=lambda one: (len({*wanted} & {*one.names}), len(one.names)))


def _line_of_names(file: Text, wanted: list[str], separator: str) -> Head:
    """Return the names in the line with most of those wanted.

    Without a line of all names, that with most of them tells what is missing.
    """
    most, names, number, more, following, even = -1, [""], 0, 0, False, True
    with file.open() as text:
        for line, row in _numbered_rows(text, separator):
            if line > PREAMBLE and not following:
                break
            if not row:
                continue
            if following:
                below = row[0].split() if separator == BLANKS else row
                more, following = len(below) - len(names), False
                even = more >= 0 and not any(map(str.strip, below[len(names) :])) and below[0][:1] != ","
                if most == len({*wanted}):
                    break
            for fields in _names_in(row, separator):
                if (count := len({*wanted} & {*fields, *numbered(fields)})) > most:
                    most, number, more, following, even = count, line, 0, True, True
                    names = fields[: max((i for i, name in enumerate(fields, 1) if name), default=len(fields))]
    if most < 0:
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r}, which is empty.")
    return Head(names, number, more, separator, even=even)


def _numbered_rows(text: TextIO, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield rows with the number of their last line; with blanks, the row of one field is the line."""
    if separator == BLANKS:
        yield from ((number, [line.strip("\r\n")] if line.strip() else []) for number, line in enumerate(text, 1))
        return
    rows = csv.reader(text, delimiter=separator, skipinitialspace=True)
    yield from ((rows.line_num, row) for row in rows)


def _names_in(row: list[str], separator: str) -> Iterator[list[str]]:
    """Yield the names that a row may contain."""
    if separator == BLANKS:
        line = row[0].strip()
        for text in {COMMENT_MARK.sub("", line): 0, line: 0}:
            yield from (re.split(blanks, text) for blanks in NAME_BLANKS[: None if len(text) < LONGEST_LINE else 1])
        return
    fields = [name.strip() for name in row]
    yield fields
    if fields[0][:1] in ("#", "%"):
        yield [COMMENT_MARK.sub("", fields[0]), *fields[1:]]


def _with_units(file: Text, best: Head) -> Head:
    """Return a header with the units in the row below it, and the first rows of the data."""
    rows: list[tuple[int, list[str]]] = []
    with file.open() as text:
        lines = skip(text, best.lines, best.separator)
        number = best.lines
        for row in itertools.islice(lines, SAMPLE_ROWS):
            number = lines.line_num if hasattr(lines, "line_num") else number + 1
            if any(map(str.strip, row)):
                rows.append((number, [cell.strip() for cell in row]))
                if len(rows) > 3 and len(rows) * sum(map(len, row)) > SAMPLE_CHARACTERS // 8:
                    break
    units: list[str] = []
    first = next((k for k, (_, row) in enumerate(rows[:3]) if any(map(USABLE.fullmatch, row))), 0)
    for _, row in rows[:first]:
        units = units or _units_of(row, rows[first][1], len(best.names), best.separator) or []
    if units:
        best = Head(best.names, rows[first - 1][0], len(rows[first][1]) - len(best.names), best.separator)
        rows = rows[first:]
    elif rows and not first:
        units = _units_above(file, best, rows[0][1])
    return Head(best.names, best.lines, best.more, best.separator, units, True, [row for _, row in rows])


def _units_above(file: Text, best: Head, following: list[str]) -> list[str]:
    """Return the units in the row above names that were found."""
    upper: list[str] = []
    with file.open() as text:
        for number, row in _numbered_rows(text, best.separator):
            if number >= best.lines:
                break
            cells = row[0].split() if row and best.separator == BLANKS else row
            upper = [cell.strip() for cell in cells] if any(map(str.strip, cells)) else upper
    upper = _unmarked(upper, len(best.names), best.separator)
    units = _units_of(upper, following, len(best.names), best.separator) if upper else None
    if units and len(_filled(upper)) >= len(_filled(best.names)) and any(map(is_evident, units)):
        return units
    return []


def _units_of(row: list[str], following: list[str], count: int, separator: str) -> list[str] | None:
    """Return the units in a row below names and above numbers."""
    row = _unmarked(row, count, separator)
    if len(_filled(row)) > count or len(row) < count:
        return None
    if any(USABLE.fullmatch(cell) for cell in row if cell) or not any(map(USABLE.fullmatch, following)):
        return None
    units = unit_row(row[:count])
    if units and any(
        known(unit) and not _is_value(cell) for unit, cell in zip(units, following, strict=False) if unit != "-"
    ):
        return None
    if units and not mostly_known(units) and any(map(TIME_NAME.fullmatch, filter(None, units))):
        return None
    return units


def _is_value(cell: str) -> bool:
    return cell in MISSING or bool(USABLE.fullmatch(cell))


def _sample(file: Text) -> list[str]:
    """Return the first lines of a text."""
    lines, size = [], 0
    with file.open() as text:
        for line in itertools.islice(text, SAMPLE_LINES):
            lines.append(line)
            size += len(line)
            if size > SAMPLE_CHARACTERS and len(lines) >= 8:
                break
    return lines


Rows = list[tuple[int, list[str]]]


@dataclass(frozen=True)
class _Block:
    """Rows of a sample as a separator divides them: width, places of columns with values, and first row of data."""

    separator: str
    lines: list[str]
    rows: list[tuple[int, list[str]]]
    width: int
    columns: list[int]
    first: int
    covered: int  # characters in cells with values


def _block(lines: list[str], separator: str, start: int) -> _Block | None:
    """Return the block of data of a sample, as the separator divides it; None if there is none."""
    rows: list[tuple[int, list[str]]] = []
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True) if separator != BLANKS else None
    try:
        for number, row in enumerate(reader or (COMMENT_MARK.sub("", line).split() for line in lines), 1):
            if any(map(str.strip, row)):
                rows.append((reader.line_num if reader else number, [cell.strip() for cell in row]))
    except csv.Error:
        return None
    best: _Block | None = None
    widths = collections.Counter(len(row) for number, row in rows if number > start)
    for width, _ in widths.most_common(5):
        block = _of_width(separator, lines, rows, width, start)
        if block and (best is None or block.covered > best.covered):
            best = block
    return best


def _of_width(
    separator: str, lines: list[str], rows: list[tuple[int, list[str]]], width: int, start: int
) -> _Block | None:
    """Return the block of the rows with a number of fields."""
    data = [row for number, row in rows if len(row) == width and number > start]
    columns, covered = [], 0
    for place in range(width):
        cells = [row[place] for row in data[-max(len(data) // 3, 3) :] if row[place] not in MISSING]
        usable = [cell for cell in cells if USABLE.fullmatch(cell)]
        if usable and 2 * len(usable) >= len(cells):
            columns.append(place)
            covered += sum(map(len, usable))
    if not columns:
        return None
    for first, (number, row) in enumerate(rows):
        if number > start and len(row) == width:
            given = [row[k] for k in columns if row[k] not in MISSING]
            count = sum(map(bool, map(USABLE.fullmatch, given)))
            if given and 2 * count >= len(given) and (count == len(given) or _is_value(row[columns[0]])):
                return _Block(separator, lines, rows, width, columns, first, covered)
    return None


def _by_evidence(file: Text, separator: str | None, line: int | None) -> Head | None:
    """Return the header of the block of numbers that a separator makes of the first lines."""
    lines = _sample(file)
    start = line or 0
    blocks = [_block(lines, one, start) for one in ((separator,) if separator else (*SEPARATORS, BLANKS))]
    usable = [block for block in blocks if block]
    if not usable:
        return None
    best = max(usable, key=lambda block: block.covered)
    if best.width == 1 and not separator:
        best = _one_or_several(file, best, usable, line)
    others = [row for number, row in best.rows[: best.first] if number > start and len(row) > 1]
    if sum(all(map(USABLE.fullmatch, row)) for row in others) > 1:
        raise ValueError(
            f"path: must be a CSV file with one table, got {file!r}, which has rows of {best.width} fields after "
            "rows of numbers with other ones; save each table as a file of its own."
        )
    names, units = _names_above(best, line)
    _refuse_lost(best, bool(names), line)
    data = best.rows[best.first :]
    real = max((k + 1 for _, row in data for k, cell in enumerate(row[: best.width]) if cell), default=best.width)
    if line and names:
        real = max(i for i, name in enumerate(names, 1) if name)
    elif real < len(names) <= best.width:  # the last columns are empty
        real = len(names)
    commented = best.first > 0 and best.lines[best.rows[best.first - 1][0] - 1].lstrip()[:1] in ("#", "%")
    if len(names) != real and len(names) > 1 and not commented:
        raise ValueError(
            f"header: must be given for {file.path.name!r}, in which the line above the data has {len(names)} "
            f"fields for {real} columns; give the number of the line of names, or header=0 for none."
        )
    last = best.rows[best.first - 1][0] if best.first else 0
    if len(names) != real:
        names = [f"column {k + 1}" for k in range(real)]
        return Head(names, last, best.width - real, best.separator, [], False, [row for _, row in data])
    return Head(
        names, last or best.rows[0][0], best.width - real, best.separator, units, True, [row for _, row in data]
    )


def _refuse_lost(block: _Block, titled: bool, line: int | None) -> None:
    """Raise a ValueError for rows of the table, one cell of which is no number, between the header and the numbers."""
    above = [(number, row) for number, row in block.rows[: block.first] if number > (line or 0)]
    if titled and not line:
        if above and any(map(NEARLY_A_NUMBER.fullmatch, filter(None, above[-1][1]))):
            raise ValueError(
                f"header: must be given, got {line!r}, as line {above[-1][0]} has neither names nor only numbers, "
                f"{_checks.shortened(above[-1][1])}; give the number of the line of names, or header=0 for none."
            )
        if len(above) > 1 and above[-1][1] == above[-2][1] and len(_filled(above[-1][1])) == block.width:
            raise ValueError(
                f"header: must be given, got {line!r}, as lines {above[-2][0]} and {above[-1][0]} are alike, "
                f"{_checks.shortened(above[-1][1])}; give the number of the line of names."
            )
        return
    for number, row in above if line else above[-1:]:
        if len(row) != block.width or block.lines[number - 1].lstrip()[:1] in ("#", "%"):
            continue
        if any(USABLE.fullmatch(row[k]) for k in block.columns):
            cell = next((row[k] for k in block.columns if not _is_value(row[k])), row[0])
            raise ValueError(
                f"header: must be the number of a line with only rows of numbers below it, got {line!r}, and line "
                f"{number} has the cell {cell!r} above numbers, {_checks.shortened(row)}; correct the cell, or leave "
                "out the rows before it by header= and give columns by number."
            )


def _one_or_several(file: Text, best: _Block, blocks: list[_Block], line: int | None) -> _Block:
    """Return the block of one column, or of several where "1,5" is two numbers; the names above it decide."""
    for other in blocks:
        if other.width == 1 or len(other.columns) != other.width:
            continue
        names, _ = _names_above(other, line)
        if len(names) == other.width:
            return other
        single, _ = _names_above(best, line)
        if not single or line == 0:
            cell = best.rows[best.first][1][0]
            raise ValueError(
                f"separator: must be given for {file.path.name!r}, whose rows such as {cell!r} are one number or "
                f"{other.width}; give separator={other.separator!r}, or separator=';' and decimal= for one."
            )
    return best


def _names_above(block: _Block, line: int | None) -> tuple[list[str], list[str]]:
    """Return the names above the data of a block, and the units below the names."""
    if line == 0:
        return [], []
    above = block.rows[: block.first]
    following = block.rows[block.first][1]
    if line is None and not above:
        numbers = [str(k) for k in range(block.width + 1)]
        if block.width > 1 and following in (numbers[:-1], numbers[1:]) and len(block.rows) > 1:
            return following, []
        return [], []
    below: list[tuple[int, list[str]]] = []
    if line:
        below = [(number, row) for number, row in above if number > line]
        above = [(number, row) for number, row in above if number <= line]
    elif len(above) > 1 and len(above[-2][1]) >= len(_trimmed(above[-1][1])) > 0:
        units = _units_of(above[-1][1], following, block.width, block.separator) or []
        pairs = zip(above[-2][1], units, strict=False)
        full = len(_filled(above[-2][1])) == len(_filled(above[-1][1]))
        timed = any(map(TIME_NAME.fullmatch, above[-2][1]))
        if full and "t" in units and not timed and not any(map(is_evident, units)):
            raise ValueError(
                f"header: must be given, got None, as line {above[-1][0]} may be names or units, "
                f"{_checks.shortened(above[-1][1])}; give the number of the line of names."
            )
        if units and not any(unit == "t" and TIME_NAME.fullmatch(name) for name, unit in pairs):
            below, above = above[-1:], above[:-1]
    if not above or (line and above[-1][0] != line):
        raise ValueError(f"header: must be the number of the line of the names, or 0 for none, got {line!r}.")
    units = _units_around(block, above, below, line)
    names = above[-1][1]
    if block.separator == BLANKS:
        text = COMMENT_MARK.sub("", block.lines[above[-1][0] - 1]).strip()
        names = _blank_names(text, names, block.width)
    elif names[0][:1] in ("#", "%"):
        names = [COMMENT_MARK.sub("", names[0]), *names[1:]]
    names = _trimmed(names)
    if (
        line is None
        and not units
        and any(NUMBER_CELL.fullmatch(name) or re.fullmatch(DATE, name) for name in names if name)
    ):
        if len(above[-1][1]) == block.width and 2 * sum(map(_is_value, filter(None, names))) > len(block.columns):
            raise ValueError(
                f"header: must be given, got None, as line {above[-1][0]} has neither names nor only numbers, "
                f"{_checks.shortened(above[-1][1])}; give the number of the line of names, or header=0 for none."
            )
        return [], []
    return names, units


def _units_around(block: _Block, above: Rows, below: Rows, line: int | None) -> list[str]:
    """Return the units in the rows below the names, or in the row above them, which is the last one `above`."""
    following, width = block.rows[block.first][1], block.width
    for _, row in below:
        if units := _units_of(row, following, width, block.separator):
            return units
    if below:
        raise ValueError(
            f"header: must be the number of the line above the data, or of one above units, got {line!r}, and line "
            f"{below[-1][0]} is {_checks.shortened(below[-1][1])}, which are neither numbers nor known units."
        )
    names = above[-1][1]
    upper = _unmarked(above[-2][1], width, block.separator) if len(above) > 1 else []
    full = len(_filled(upper)) >= len(_filled(names)) > 0
    if full and (units := _units_of(upper, following, width, block.separator)):
        third = len(above) > 2 and len(_filled(above[-3][1])) >= len(_filled(upper))
        texts = third and not any(map(_is_value, _filled(above[-3][1])))
        if not texts and mostly_known(units) and any(map(is_evident, units)):
            return units
        if line is None and (any(map(is_evident, units)) or all(map(is_possible, filter(None, units)))):
            raise ValueError(
                f"header: must be given, got None, as line {above[-2][0]} may be units, {_checks.shortened(upper)}, "
                "and it is not the one below the names; give the number of the line of names."
            )
        if texts and any(map(is_evident, units)):
            return units
    timed = any(map(TIME_NAME.fullmatch, upper))
    if line is None and full and (timed or any(map(is_possible, map(unbracketed, names)))):
        texts = not any(map(_is_value, [*upper, *names])) and (timed or not any(map(known, upper)))
        if texts and not any(map(TIME_NAME.fullmatch, names)) and len(_filled(names)) == width:
            raise ValueError(
                f"header: must be given, got None, as line {above[-1][0]} may be names or units, "
                f"{_checks.shortened(names)}; give the number of the line of names."
            )
    return []


def _filled(row: list[str]) -> list[str]:
    return [cell for cell in row if cell]


def _unmarked(row: list[str], count: int, separator: str) -> list[str]:
    """Return the fields of a row without a mark of comments, which may be one of them; "%" may be a unit instead."""
    if not row or row[0][:1] not in ("#", "%"):
        return row
    text = COMMENT_MARK.sub("", row[0])
    if not text and (len(row) > count or (separator == BLANKS and row[0] != "%")):
        return row[1:]
    return row if row[0] == "%" else [text, *row[1:]]


def _trimmed(row: list[str]) -> list[str]:
    """Return fields without empty ones at the end."""
    return row[: max((i for i, field in enumerate(row, 1) if field), default=0)]


def _blank_names(text: str, fields: list[str], width: int) -> list[str]:
    """Return the names in a line of blanks, of which there are as many as columns if that is possible."""
    for blanks in NAME_BLANKS[: None if len(text) < LONGEST_LINE else 1]:
        if len(names := re.split(blanks, text)) == width:
            return names
    return fields


def known_separator(separator: str) -> str:
    """Return a separator that was given; blanks stand for any number of them."""
    if not isinstance(separator, str) or (len(separator) != 1 and separator != r"\s+") or separator in '\r\n"':
        raise ValueError(f"separator: must be one character, ' ' for any number of blanks, got {separator!r}.")
    return BLANKS if separator == r"\s+" else separator


def line_number(header: int | None) -> int | None:
    """Return the number of the line of names that was given."""
    return None if header is None else int(_checks.integer("header", header, 0))
