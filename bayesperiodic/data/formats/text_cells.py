"""Numbers, dates and times of day in the notations of texts."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic.data.formats.text_header import DATE, EXPONENT, GROUPS, NUMBER_CELL, TIME_OF_DAY

GROUPED, PLAIN_COMMA = re.compile(rf"[+-]?{GROUPS}"), re.compile(rf"[+-]?[0-9]*,[0-9]+{EXPONENT}")
PLAIN_POINT = re.compile(rf"[+-]?(?:[0-9]+\.[0-9]*|\.[0-9]+){EXPONENT}")
# What may be one decimal sign or one between thousands: not after a zero, and with three digits on the right.
EITHER = re.compile(r"[+-]?[1-9][0-9]{0,2}[.,][0-9]{3}")
TIME, DATED = re.compile(TIME_OF_DAY), re.compile(DATE)
DATE_PARTS = re.compile(r"([0-9]{1,4})([-./])([0-9]{1,2})\2([0-9]{1,4})([T ]+.*)?")
OF_DATES = re.compile("%[bBcdDeFgGhjmsVxyY]")  # in a format; without one, pandas takes 1 January 1900
DURATION = r"[0-9]+:[0-5][0-9](?::[0-5][0-9])?(?:[.,][0-9]+)?"
HALF_DAY, DAY = np.timedelta64(12, "h"), np.timedelta64(24, "h")
MOST_DECIMALS = 9  # of a second, which nanoseconds hold


@dataclass(frozen=True)
class CellEvidence:
    """Which signs numbers show: proofs of a decimal sign and of one between thousands, and what may be either."""

    decimal: frozenset[str] = frozenset()
    thousands: frozenset[str] = frozenset()
    either: frozenset[str] = frozenset()

    @classmethod
    def of(cls, cells: Iterable[str]) -> "CellEvidence":
        """Return the evidence of cells of a text."""
        decimal, thousands, either = set[str](), set[str](), set[str]()
        for cell in cells:
            if not ("," in cell or "." in cell) or not NUMBER_CELL.fullmatch(cell):
                continue
            if EITHER.fullmatch(cell):
                either.add("," if "," in cell else ".")
            elif PLAIN_COMMA.fullmatch(cell) or PLAIN_POINT.fullmatch(cell):
                decimal.add("," if "," in cell else ".")
            elif match := GROUPED.fullmatch(cell):
                thousands.add(match["mark"])
                decimal |= {other for other in ",." if other in cell and other != match["mark"]}
        return cls(frozenset(decimal), frozenset(thousands), frozenset(either))

    def __or__(self, other: "CellEvidence") -> "CellEvidence":
        return CellEvidence(self.decimal | other.decimal, self.thousands | other.thousands, self.either | other.either)

    @property
    def sign(self) -> str:
        """The decimal sign; "" if the cells do not say it or contradict each other."""
        signs = {*self.decimal, *({",": ".", ".": ","}[mark] for mark in self.thousands if mark in ",.")}
        return signs.pop() if len(signs) == 1 else ""


def refusal(cells: list[str], sure: bool) -> str:
    """Return why numbers with commas cannot be read, if they are not dates or texts."""
    numbers = [cell for cell in cells if NUMBER_CELL.fullmatch(cell)]
    if len(numbers) < len(cells) or not numbers:
        return ""
    shown = next((cell for cell in numbers if "," in cell), numbers[0])
    if not sure and all(EITHER.fullmatch(cell) for cell in numbers if "," in cell):
        return (
            f"numbers such as {shown!r}, whose comma may be the decimal sign or stand between thousands; give "
            "decimal=',' or decimal='.'"
        )
    return f"numbers such as {shown!r}, which do not all have one decimal sign; give decimal= and thousands="


def other_than_numbers(values: np.ndarray) -> str:
    """Return why texts most of which are numbers cannot be read: the first of the others."""
    others = [k for k, cell in enumerate(values) if isinstance(cell, str) and not NUMBER_CELL.fullmatch(cell.strip())]
    given = sum(isinstance(cell, str) for cell in values)
    if not others or 2 * len(others) >= given:
        return ""
    return f"{values[others[0]]!r} in data row {others[0] + 1}, which is no number, as {given - len(others)} others are"


def is_moment(cell: object) -> bool:
    """Return whether a cell is a date or a time of day."""
    return isinstance(cell, str) and bool(TIME.fullmatch(cell.strip()) or DATED.fullmatch(cell.strip()))


def numbers(values: np.ndarray, decimal: str, thousands: str | None) -> np.ndarray | None:
    """Return texts as numbers, if all of them are numbers with a decimal sign and one sign between thousands."""
    import pandas as pd

    if thousands:
        marks = re.escape(thousands)
    else:
        marks = "".join({*".,'’ \u00a0\u202f"} - {decimal}).replace("'", "'")
        marks = f"[{re.escape(marks)}]"
    sign = re.escape(decimal)
    pattern = re.compile(
        rf"[+-]?(?:[0-9]{{1,3}}(?:(?P<mark>{marks})[0-9]{{3}})(?:(?P=mark)[0-9]{{3}})*|[0-9]+|(?={sign}[0-9]))"
        rf"(?:{sign}[0-9]*)?{EXPONENT}|[+-]?[Ii]nf(?:inity)?"
    )
    missing = np.asarray(pd.isna(values))
    result, used = np.full(values.size, np.nan), set[str]()
    for place in np.flatnonzero(~missing):
        if (match := pattern.fullmatch(text := values[place].strip(" \t"))) is None:
            return None
        if match["mark"]:
            used.add(match["mark"])
            text = text.replace(match["mark"], "")
        result[place] = float(text.replace(decimal, ".").replace("D", "e").replace("d", "e"))
    return result if len(used) < 2 else None


def times(values: np.ndarray, date_format: str | None) -> tuple[np.ndarray | None, str, str]:
    """Return texts as dates or times of day, a remark, and why they are refused; None for other texts."""
    import pandas as pd

    given = np.asarray(pd.notna(values))
    if not given.any() or not isinstance(first := values[given][0], str):
        return None, "", ""
    texts = pd.Series(values, dtype=object).where(given)
    if date_format is not None:
        return _formatted(texts, date_format)
    first = first.strip()
    if TIME.fullmatch(first):
        return _times_of_day(texts.str.strip())
    if DATED.fullmatch(first) and (parts := DATE_PARTS.fullmatch(first)):
        return _dates(texts.str.strip(), parts)
    return None, "", ""


def _formatted(texts: Any, date_format: str) -> tuple[np.ndarray | None, str, str]:
    """Return texts as dates or times of day in a format that was given."""
    import pandas as pd

    try:
        read = pd.to_datetime(texts, format=date_format, utc="%z" in date_format)
    except (ValueError, TypeError, OverflowError):
        return None, "", ""
    values = (read.dt.tz_convert(None) if "%z" in date_format else read).to_numpy()
    remark = f"dates in the format {date_format!r}, as given"
    if not OF_DATES.search(date_format):
        return *rolled((values - np.datetime64("1900-01-01")) % DAY), ""  # in UTC where the format has a zone
    return values, remark, ""


def _times_of_day(texts: Any) -> tuple[np.ndarray | None, str, str]:
    """Return times of day as durations, which go on after midnight."""
    import pandas as pd

    given = texts[texts.notna()]
    if given.str.lower().str.endswith("m").any():
        return None, "", "times of twelve hours; give date_format='%I:%M:%S %p'"
    # pandas takes 99 minutes as 1:39.
    short = given.str.count(":") == 1
    if not given.str.fullmatch(DURATION).all() or short.any() != short.all():
        return None, "", ""
    if short.any():
        if not given.str.contains(r"[.,]").any():
            return (
                None,
                "",
                (
                    f"times such as {given.iloc[0]!r}, which may be hours and minutes or minutes and seconds; give "
                    "date_format='%H:%M' or date_format='%M:%S'"
                ),
            )
        texts = "0:" + texts
    texts = texts.str.replace(",", ".")
    if given.str.contains(rf"[.,][0-9]{{{MOST_DECIMALS + 1}}}").any():
        return None, "", ""
    try:
        values = pd.to_timedelta(texts).to_numpy()
    except (ValueError, OverflowError):
        return None, "", ""
    return *rolled(values), ""


def rolled(values: np.ndarray) -> tuple[np.ndarray, str]:
    """Return times of day with a day added after each midnight."""
    known = ~np.isnat(values)
    steps = np.diff(values[known])
    if not (steps < -HALF_DAY).any() or (values[known] >= DAY).any():
        return values, "times of day, in seconds from the first one"
    days = np.concatenate([[0], np.cumsum(steps < -HALF_DAY)])
    rolled = values.copy()
    rolled[known] += days * DAY
    return rolled, "times of day, which go on after midnight"


def _dates(texts: Any, parts: re.Match[str]) -> tuple[np.ndarray | None, str, str]:
    """Return dates by the order of day, month and year that all of them show."""
    import pandas as pd

    mark, clock = parts[2], parts[5] or ""
    if len(parts[1]) == 4:
        if mark == "-" and "," not in clock:  # ISO 8601, which all readers of times take
            return None, "", ""
        orders = {"year, month, day": "%Y{0}%m{0}%d"}
    elif len(parts[4]) == 4:
        orders = {"day, month, year": "%d{0}%m{0}%Y", "month, day, year": "%m{0}%d{0}%Y"}
        if mark == ".":
            orders.popitem()
    else:
        return (
            None,
            "",
            (
                f"dates such as {parts[0]!r}, in which the year has no four digits; give date_format=, such as "
                "'%d.%m.%y %H:%M:%S'"
            ),
        )
    texts = texts.str.replace(",", ".").str.replace("T", " ").str.replace(r" +", " ", regex=True)
    suffix = ""
    if clock.strip():
        suffix = " %H:%M" if clock.count(":") == 1 else " %H:%M:%S"
        if clock[-2:].lower() in ("am", "pm"):
            texts = texts.str.replace(r" ?([AaPp][Mm])$", r" \1", regex=True)
            suffix = suffix.replace("%H", "%I") + " %p"
        elif clock.count(":") == 2 and (fraction := texts.str.contains(r":[0-9]{1,2}\.[0-9]")).fillna(False).any():
            texts = texts.where(fraction.fillna(True).astype(bool), texts + ".0")
            suffix += ".%f"
    if texts.str.contains(rf"\.[0-9]{{{MOST_DECIMALS + 1}}}").fillna(False).any():
        return None, "", ""
    read: dict[str, np.ndarray] = {}
    for order, pattern in orders.items():
        try:
            read[order] = pd.to_datetime(texts, format=pattern.format(mark) + suffix).to_numpy()
        except (ValueError, OverflowError):
            continue
    if len(read) > 1:
        example = "%m/%d/%Y" + suffix
        return (
            None,
            "",
            (
                f"dates such as {parts[0]!r}, in which day and month may be exchanged; give date_format={example!r} or "
                f"date_format={example.replace('%m/%d', '%d/%m')!r}".replace("/", mark)
            ),
        )
    for order, values in read.items():
        return values, f"dates read as {order}", ""
    return None, "", ""
