"""Text files of LabVIEW measurements (.lvm)."""

import contextlib
import re
from dataclasses import dataclass, field
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic.data.formats.contents import BY_RATE, Clock, Contents, Key, StoredChannel, package, silenced
from bayesperiodic.data.times import YEARS

# Lines that begin parts of the file, and first characters of rows of numbers.
CHANNEL_LINE, NAME_LINE, COMMENT_NAME = "Channels", "X_Value", "Comment"
SPECIAL_START, SPECIAL_END = "***Start_Special***", "***End_Special***"
ROW_START = frozenset("0123456789+-.,")
# Texts of missing samples.
LOST = ("", "nan", "-nan", "1.#qnan", "-1.#ind", "inf", "-inf")
# Rows at the end from which the digits of the times are taken, and relative error of a step that is none.
LAST_ROWS, EXACT_STEP = 20, 1e-6
SLASHED_DATE, LVM_TIME = re.compile(r"(\d{4})/(\d\d?)/(\d\d?)$"), re.compile(r"(\d\d?):(\d\d?):(\d\d?)(?:[.,](\d+))?$")
# Numbers as LabVIEW writes them by default.
SIX_DECIMALS = re.compile(r"\d+[.,]\d{6}")


@dataclass
class _Segment:
    """Rows of one segment, with the number and the width of the line of the names, and the texts of Delta_X."""

    first: int
    width: int
    steps: list[str]
    rows: list[str] = field(default_factory=list)


def contents(file: Path, wanted: list[Key], *, encoding: str | None = None, decimal: str | None = None) -> Contents:
    """Return the channels of all segments of a LabVIEW measurement file."""
    reader = package("lvm_read", "lvm-read", "LabVIEW measurement files")
    text, used = _decoded(file.read_bytes(), encoding)
    header = re.search(r"^Separator(.)", text, re.MULTILINE)
    separator = header.group(1) if header else "\t" if re.search(r"^Channels\t", text, re.MULTILINE) else ","
    lines, segments = _prepared(text, separator, decimal)
    with silenced("lvm_read"):
        # Of `read`, which prefers a pickled file beside the file, the part is used that reads lines.
        whole = reader.read_lines(lines, separator=separator)
    if whole["Segments"] != len(segments):
        raise ValueError("it has segments without a line of names")
    channels = [
        channel
        for k, rows in enumerate(segments)
        for channel in _channels(whole, whole[k], rows, f"segment {k + 1}" if len(segments) > 1 else "", separator)
    ]
    remarks = (f"in {used}", *((f"{len(segments)} segments, with times of their own",) if len(segments) > 1 else ()))
    return Contents("LabVIEW measurement file", tuple(channels), remarks)


def _decoded(content: bytes, encoding: str | None) -> tuple[str, str]:
    """Return the text, in UTF-8 or else in the encoding of Windows in Western Europe, and the encoding."""
    for name in [encoding] if encoding else ["utf-8-sig", "cp1252"]:
        with contextlib.suppress(UnicodeDecodeError, LookupError):
            return content.decode(name), name.removesuffix("-sig")
    if encoding:
        raise ValueError(f"encoding: must be Python's name of that of the file, got {encoding!r}; leave it out.")
    raise ValueError("its encoding is neither UTF-8 nor that of Windows; see encoding, such as encoding='utf-16'")


def _prepared(text: str, separator: str, decimal: str | None) -> tuple[list[str], list[_Segment]]:
    """Return lines as lvm-read expects them, and the segments.

    lvm-read takes a row for each line up to an empty one, and the number of columns from the line of the channels.
    """
    lines: list[str] = []
    segments: list[_Segment] = []
    at, opened, data, special, complete, steps = -1, False, False, False, text.endswith("\n"), [""]
    for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), 1):
        if data and (line[:1] in ROW_START or line[:1] == separator) and line.strip(separator):
            segments[-1].rows.append(line)
            lines.append(line)
        elif special or line.startswith(SPECIAL_START):
            special = not line.startswith(SPECIAL_END)
        elif line.strip(separator + " \t"):
            cells = [cell.strip() for cell in line.split(separator)]
            if data or (cells[0] == CHANNEL_LINE and not opened):
                lines.append("\n")
                opened, data = True, False
            if cells[0] == CHANNEL_LINE:
                at = len(lines)
            elif cells[0] == NAME_LINE and at >= 0:
                lines[at] = separator.join([*lines[at].strip().split(separator)[:2], *[""] * (len(cells) - 2)]) + "\n"
                segments.append(_Segment(number, len(cells), steps))
                data, opened, at, steps = True, False, -1, [""]
            elif cells[0] == "Delta_X":
                steps = [cell for cell in cells[1:] if cell]
            lines.append((separator.join(cells) if cells[0] != "Decimal_Separator" else line) + "\n")
    if decimal is not None:
        lines = [line for line in lines if not line.startswith("Decimal_Separator")]
        lines.insert(1, f"Decimal_Separator{separator}{decimal}\n")
    if special or not segments or not all(segment.rows for segment in segments):
        raise ValueError("it is cut off, or has no rows of numbers")
    if not complete and _is_shorter(segments[-1].rows[-2:], separator):
        raise ValueError("it seems to be cut off: its last line has no end; add one if its last number is complete")
    return lines, segments


def _is_shorter(rows: list[str], separator: str) -> bool:
    """Return whether the last row ends with a shorter number than the one before."""
    ends = [row.rsplit(separator, 1)[-1] for row in rows]
    return len(ends[-1]) < len(ends[0])


def _channels(whole: Any, segment: Any, rows: _Segment, group: str, separator: str) -> list[StoredChannel]:
    """Return the channels of a segment."""
    kind, table, names = whole.get("X_Columns", "One"), segment["data"], segment["Channel names"]
    count, width = int(segment[CHANNEL_LINE]), len(segment["Channel names"])
    first = {"No": 0, "One": 1, "Multi": 1}.get(kind)
    if first is None:
        raise ValueError(f"its X_Columns is {kind!r} and not No, One or Multi")
    columns = range(first, first + count * (2 if kind == "Multi" else 1), 2 if kind == "Multi" else 1)
    needed = columns[-1] + 1 if count > 0 else 0
    if count < 1 or not needed <= width <= needed + 1 or (width > needed and names[-1] != COMMENT_NAME):
        raise ValueError(f"it has {count} channels by its header, and the names {names} from line {rows.first} on")
    offset = 1 if kind == "No" else 0
    _check_rows(rows, table[:, :needed], offset, separator, whole["Decimal_Separator"])
    given = {
        key: _each(segment, key, count)
        for key in ("Samples", "Y_Unit_Label", "X_Dimension", "Delta_X", "X0", "Date", "Time")
    }
    lengths = [_length(table[:, j], n, whole) for j, n in zip(columns, given["Samples"], strict=True)]
    clocks: dict[Any, Clock | None] = {}
    channels = []
    for k, j in enumerate(columns):
        x = 2 * k if kind == "Multi" else 0 if kind == "One" else None
        key = (x, lengths[k], *(given[name][k] for name in ("X_Dimension", "Delta_X", "X0", "Date", "Time")))
        if key not in clocks:
            error = _error(rows.steps[min(k, len(rows.steps) - 1)], whole["Decimal_Separator"])
            clocks[key] = _clock(whole, rows, table[: lengths[k]], key, error, separator)
        unit = str(given["Y_Unit_Label"][k] or "")
        values = partial(np.array, table[: lengths[k], j])
        channels.append(StoredChannel(names[j], lengths[k], values, group, unit, clocks[key]))
    repeated = {one.name for one in channels if sum(other.name == one.name for other in channels) > 1}
    if repeated:
        raise ValueError(f"it has several channels {sorted(repeated)[0]!r}")
    return channels


def _check_rows(rows: _Segment, table: np.ndarray, offset: int, separator: str, decimal: str) -> None:
    """Raise a ValueError if a row has another number of fields than there are names, or a text in place of a number."""
    least, most = table.shape[1] + offset, rows.width + 1
    fields = [row.count(separator) + 1 for row in rows.rows]
    if wrong := next((one for one in {*fields} if not least <= one <= most), 0):
        raise ValueError(
            f"row {fields.index(wrong) + 1} after line {rows.first} has {wrong} fields, and {rows.width} have names"
        )
    for place in np.flatnonzero(np.isnan(table).any(axis=1)).tolist():
        cells = rows.rows[place].split(separator)[offset : offset + table.shape[1]]
        for cell in cells:
            if np.isnan(_number(cell.replace(decimal, "."))) and cell.strip().lower() not in LOST:
                raise ValueError(
                    f"row {place + 1} after line {rows.first} has {cell!r}, no number with the decimal sign "
                    f"{decimal!r}, which decimal= changes"
                )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _each(segment: Any, key: str, count: int) -> list[Any]:
    """Return a value of the header for each channel; with a time for each channel, every other cell is empty."""
    values = segment.get(key, [])
    values = [values] if isinstance(values, str) else values
    given = [
        value for value in ([values] if isinstance(values, str) else values) if value not in ("",) and value == value
    ]
    if len(given) in (0, 1):
        return (given or [None]) * count
    if len(given) != count:
        raise ValueError(f"its {key} has {len(given)} values for {count} channels")
    return given


def _length(values: np.ndarray, announced: Any, whole: Any) -> int:
    """Return the number of samples of a channel, without the empty cells after the last one."""
    if announced is None:
        return values.size
    if announced > values.size:
        raise ValueError(f"it is cut off: it has {values.size} rows, and {announced} samples by its header")
    if np.isnan(values[int(announced) :]).all():
        return int(announced)
    if str(whole.get("Multi_Headings", "No")) == "Yes":
        raise ValueError(f"it has {values.size} rows, and {announced} samples by its header")
    return values.size


def _error(text: str, decimal: str) -> float:
    """Return half a unit of the last digit of a step; 0 if it is the step of a round rate, and not much shortened."""
    number = Decimal(text.replace(decimal, ".") or "0")
    step, half = float(number), 0.5 * 10.0 ** int(number.as_tuple().exponent)
    if not number.is_finite() or step <= 0.0:
        return 0.0
    rounded = abs(step * float(f"{1.0 / step:.3e}") - 1.0) < 1e-9
    shortest = number.as_tuple().digits[-1] != 0 and not SIX_DECIMALS.fullmatch(text)
    return 0.0 if rounded and (half <= 1e-3 * step or shortest) else half


def _clock(
    whole: Any, rows: _Segment, table: np.ndarray, key: tuple[Any, ...], error: float, separator: str
) -> Clock | None:
    """Return the times of a channel, by its column of times or by X0 and Delta_X."""
    place, samples, dimension, step, start, date, time = key
    absolute = whole.get("Time_Pref") == "Absolute"
    origin = None if absolute else _origin(date, time)
    if dimension not in (None, "Time"):
        return Clock(refusal=f"whose axis is {dimension!r} and not time; {BY_RATE}")
    times = None if place is None else table[:, place]
    if times is None or np.isnan(times).all() or samples < 2:
        if not step or step < 0:
            return None
        return Clock(float(start or 0.0), float(step), origin=origin, error=error if error > EXACT_STEP * step else 0.0)
    if np.isnan(times).any():
        return Clock(refusal=f"some of whose times are missing; {BY_RATE}")
    texts = [row.split(separator)[place] for row in rows.rows[:samples][-LAST_ROWS:]]
    digit = max(_digit(texts, whole["Decimal_Separator"]), 4 * np.spacing(np.abs(times).max()))
    mean = float(times[-1] - times[0]) / (samples - 1)
    if np.abs(times - times[0] - mean * np.arange(samples)).max() > digit:
        return Clock(stored=partial(np.array, times), origin=origin)
    uncertain = digit / (samples - 1)
    if step and abs(step - mean) > uncertain + error + EXACT_STEP * mean:
        return Clock(refusal=f"whose times are {mean:.9g} s apart, while Delta_X is {step!r} s; {BY_RATE}")
    if step and error < uncertain:
        mean, uncertain = float(step), error
    return Clock(float(times[0]), mean, origin=origin, error=uncertain if uncertain > EXACT_STEP * mean else 0.0)


def _digit(texts: list[str], decimal: str) -> float:
    """Return the value of the last digit of numbers, of the one with most digits."""
    exponents = [Decimal(text.strip().replace(decimal, ".")).as_tuple().exponent for text in texts]
    return 10.0 ** min(int(exponent) for exponent in exponents)


def _origin(date: Any, time: Any) -> np.datetime64 | None:
    """Return date and time of a segment, which LabVIEW writes with up to 19 decimals of a second."""
    day, clock = SLASHED_DATE.match(str(date).strip()), LVM_TIME.match(str(time).strip())
    if not day or not clock:
        return None
    year, month, dom = map(int, day.groups())
    hours, minutes, seconds = map(int, clock.groups()[:3])
    if not YEARS[0] <= year < YEARS[1]:
        return None
    passed = (hours * 3600 + minutes * 60 + seconds) * 10**9 + int((clock.group(4) or "0")[:9].ljust(9, "0"))
    return np.datetime64(f"{year:04d}-{month:02d}-{dom:02d}", "ns") + np.timedelta64(passed, "ns")
