"""Tables, figures and badges of the page, the formatting of numbers and units, and the template engine."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from math import floor, isfinite, isinf, isnan, log10
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

GOOD, CAUTION, BAD, NEUTRAL = "good", "caution", "bad", "neutral"
# A badge shows its tone by a sign as well as by a colour.
SIGNS = {GOOD: "✓", CAUTION: "!", BAD: "✕", NEUTRAL: "•"}


@dataclass(frozen=True)
class Badge:
    """A verdict of one or two words with its tone."""

    tone: str
    text: str


class Number(str):
    """A formatted number; columns that hold one are aligned to the right."""


Row = Mapping[str, str | Markup | Badge]


@dataclass(frozen=True)
class Table:
    """A table: rows as mappings from column titles to cells, where the first cell heads the row.

    A title such as "Laplace: sd" places the column "sd" under the common head "Laplace".
    """

    id: str
    caption: str
    rows: Sequence[Row]

    @property
    def columns(self) -> list[tuple[str, bool]]:
        """The title of each column, and whether it holds numbers."""
        titles = self.rows[0] if self.rows else ()
        return [(t.rpartition(": ")[2], any(isinstance(row[t], Number) for row in self.rows)) for t in titles]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The common heads with the number of columns below each; empty without any."""
        heads = [title.rpartition(": ")[0] for title in (self.rows[0] if self.rows else ())]
        return [(head, len(list(columns))) for head, columns in groupby(heads)] if any(heads) else []


@dataclass(frozen=True)
class Figure:
    """An image within the page, with a description for screen readers."""

    id: str
    source: str
    alt: str
    caption: str
    wide: bool = False


def code(name: str) -> Markup:
    """Return a name in the type of source code."""
    return Markup("<code>{}</code>").format(name)


NOTHING = "–"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SMALLEST, LARGEST = 1e-2, 1e6


def number(value: float, digits: int = 3) -> Number:
    """Format a number with a count of significant digits and a raised power of ten.

    Examples
    --------
    >>> from bayesperiodic.reporting.html import number
    >>> number(-0.5), number(1.2345e-9), number(float("nan"))
    ('−0.5', '1.23×10⁻⁹', '–')
    """
    if isnan(value):
        return Number(NOTHING)
    if isinf(value):
        return Number("∞" if value > 0 else "−∞")
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return Number(mantissa.replace("-", "−") + (_power_of_ten(int(exponent)) if exponent else ""))


def _power_of_ten(exponent: int) -> str:
    return f"×10{str(exponent).translate(RAISED)}"


def percent(fraction: float) -> Number:
    """Format a fraction in per cent with three significant digits."""
    return Number(NOTHING if isnan(fraction) else f"{number(100.0 * fraction)}\u00a0%")


def p_value(p: float) -> Number:
    """Format a p-value; values below 10⁻³⁰⁰ are given as such."""
    return Number("< 10⁻³⁰⁰") if p < 1e-300 else number(p, 2)


def counted(count: int, what: str) -> str:
    """Format a count with its noun."""
    return f"{count} {what}{'s' if count != 1 else ''}"


def unit(text: str) -> str:
    """Format a unit with raised powers, without line breaks.

    Examples
    --------
    >>> from bayesperiodic.reporting.html import unit
    >>> unit("m/s^2"), unit("")
    ('m/s²', '–')
    """
    raised = re.sub(r"\^(-?\d+)", lambda found: found[1].translate(RAISED), text).replace(" ", "\u00a0")
    return raised or NOTHING


@dataclass(frozen=True)
class Rounding:
    """Common rounding of the values of one quantity: a power of ten and a number of decimals.

    Examples
    --------
    >>> from bayesperiodic.reporting.html import Rounding
    >>> rounding = Rounding.of(768.123, 4.5678)
    >>> rounding.text(768.123), rounding.text(-4.5678), Rounding.of(5e-3, 2e-6).text(5e-3)
    ('768.12', '−4.57', '5.00000×10⁻³')
    >>> Rounding(-3, 1).interval(4e-3, 5.1e-3), Rounding(0, 1).interval(-1.0, 2.0)
    ('(4.0 … 5.1)×10⁻³', '−1.0 … 2.0')
    """

    exponent: int
    decimals: int

    @classmethod
    def of(cls, value: float, sd: float) -> "Rounding":
        """Return the rounding that shows three significant digits of the standard deviation."""
        known = [abs(x) for x in (value, sd) if isfinite(x) and x != 0.0]
        if not known:
            return cls(0, 3)
        size, step = max(known), abs(sd) if isfinite(sd) and sd != 0.0 else 1e-2 * max(known)
        exponent = 0 if SMALLEST <= size < LARGEST else floor(log10(size))
        return cls(exponent, max(0, 2 - floor(log10(step)) + exponent))

    def text(self, value: float) -> Number:
        """Format one value."""
        if not isfinite(value):
            return number(value)
        shown = f"{value / 10.0**self.exponent:.{self.decimals}f}".replace("-", "−")
        return Number(shown + (_power_of_ten(self.exponent) if self.exponent else ""))

    def sd(self, value: float) -> Number:
        """Format a standard deviation, with its own power of ten if the values have one."""
        return number(value) if self.exponent else self.text(value)

    def interval(self, low: float, high: float) -> Number:
        """Format the two ends of an interval."""
        if not isfinite(low) or not isfinite(high):
            return Number(NOTHING)
        plain, scale = Rounding(0, self.decimals), 10.0**self.exponent
        ends = f"{plain.text(low / scale)} … {plain.text(high / scale)}"
        return Number(f"({ends}){_power_of_ten(self.exponent)}" if self.exponent else ends)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("bayesperiodic.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.tests["badge"] = lambda value: isinstance(value, Badge)
    made.globals |= {"signs": SIGNS, "Badge": Badge}
    made.filters |= {"number": number, "percent": percent, "counted": counted}
    return made


def page(**content: Any) -> str:
    """Render the page; all text is escaped."""
    return _environment().get_template("page.html").render(content)
