"""What a page is made of: sections, and in them words, tables, figures and equations."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from math import floor, isfinite, isinf, isnan, log10
from typing import ClassVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

# Badges say by a word and a sign what they say by a colour.
GOOD, CAUTION, BAD, NEUTRAL = "good", "caution", "bad", "neutral"


@dataclass(frozen=True)
class Paragraph:
    """Some sentences."""

    text: str
    kind: ClassVar[str] = "paragraph"


@dataclass(frozen=True)
class Note:
    """What a reader must not miss."""

    tone: str
    text: str
    kind: ClassVar[str] = "note"


@dataclass(frozen=True)
class Heading:
    """The heading of a part of a section."""

    id: str
    text: str
    kind: ClassVar[str] = "heading"


@dataclass(frozen=True)
class Badge:
    """A verdict in a word or two, with its tone; a cell of a table or the head of an answer."""

    tone: str
    text: str


@dataclass(frozen=True)
class Column:
    """The head of a column; neighbours of the same group share a second head above them."""

    title: str
    numeric: bool = True
    group: str = ""


Row = tuple[str | Markup | Badge, ...]


@dataclass(frozen=True)
class Table:
    """A table whose first column heads the rows."""

    id: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    kind: ClassVar[str] = "table"

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The second heads, with the number of columns that each spans; empty if there are none."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and column.group and found[-1][0] == column.group:
                found[-1] = (column.group, found[-1][1] + 1)
            else:
                found.append((column.group, 1))
        return found if any(name for name, _ in found) else []


@dataclass(frozen=True)
class Figure:
    """A picture within the page; `alt` says what it shows to those who do not see it."""

    id: str
    source: str
    alt: str
    caption: str
    wide: bool = False
    kind: ClassVar[str] = "figure"


@dataclass(frozen=True)
class Equations:
    """Equations as MathML, and as LaTeX to be copied."""

    id: str
    label: str
    rows: tuple[Markup, ...]
    latex: str = ""
    kind: ClassVar[str] = "equations"


@dataclass(frozen=True)
class Answer:
    """The answer to one of the questions that a reader has."""

    question: str
    badge: Badge
    text: str


@dataclass(frozen=True)
class Answers:
    """Answers side by side."""

    items: tuple[Answer, ...]
    kind: ClassVar[str] = "answers"


Block = Paragraph | Note | Heading | Table | Figure | Equations | Answers


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    id: str
    title: str
    blocks: list[Block] = field(default_factory=list)


def code(name: str) -> Markup:
    """Return a name as the user wrote it, set apart from words."""
    return Markup("<code>{}</code>").format(name)


NOTHING = "–"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SMALLEST, LARGEST = 1e-3, 1e6


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, powers of ten raised.

    Examples
    --------
    >>> from bayesperiodic.reporting.html import number
    >>> number(-0.5), number(1.2345e-9), number(float("nan"))
    ('−0.5', '1.23×10⁻⁹', '–')
    """
    if isnan(value):
        return NOTHING
    if isinf(value):
        return "∞" if value > 0 else "−∞"
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return mantissa.replace("-", "−") + (power_of_ten(int(exponent)) if exponent else "")


def power_of_ten(exponent: int) -> str:
    """Return "×10⁻³" and the like."""
    return f"×10{str(exponent).translate(RAISED)}"


def percent(share: float) -> str:
    """Return a share in per cent, with three significant digits."""
    return NOTHING if isnan(share) else f"{number(100.0 * share)}\u00a0%"


def p_value(p: float) -> str:
    """Return a p-value; what is below 10⁻³⁰⁰ is said to be so.

    Examples
    --------
    >>> from bayesperiodic.reporting.html import p_value
    >>> p_value(0.0), p_value(0.0312)
    ('< 10⁻³⁰⁰', '0.031')
    """
    return "< 10⁻³⁰⁰" if p < 1e-300 else number(p, 2)


def counted(what: str, count: int) -> str:
    """Return a number of things in words."""
    return f"{count} {what}{'s' if count != 1 else ''}"


def unit(text: str) -> str:
    """Return a unit with its powers raised, on one line.

    Examples
    --------
    >>> from bayesperiodic.reporting.html import unit
    >>> unit("m/s^2"), unit("")
    ('m/s²', '–')
    """
    return re.sub(r"\^(-?\d+)", lambda found: found[1].translate(RAISED), text).replace(" ", "\u00a0") or NOTHING


@dataclass(frozen=True)
class Rounding:
    """How the numbers of one quantity are rounded, so that all of them can be compared.

    Attributes
    ----------
    exponent : int
        Of the power of ten that is written behind.
    decimals : int
    """

    exponent: int
    decimals: int

    @classmethod
    def of(cls, value: float, sd: float) -> "Rounding":
        """Return the rounding that shows three significant digits of the standard deviation.

        Examples
        --------
        >>> from bayesperiodic.reporting.html import Rounding
        >>> rounding = Rounding.of(768.123, 4.5678)
        >>> rounding.text(768.123), rounding.text(-4.5678)
        ('768.12', '−4.57')
        >>> Rounding.of(5e-3, 2e-6).text(5e-3)
        '5.00000×10⁻³'
        """
        known = [abs(x) for x in (value, sd) if isfinite(x) and x != 0.0]
        if not known:
            return cls(0, 3)
        size, step = max(known), abs(sd) if isfinite(sd) and sd != 0.0 else 1e-2 * max(known)
        exponent = 0 if 10.0 * SMALLEST <= size < LARGEST else floor(log10(size))
        return cls(exponent, max(0, 2 - floor(log10(step)) + exponent))

    def text(self, value: float) -> str:
        """Return one number."""
        if not isfinite(value):
            return number(value)
        shown = f"{value / 10.0**self.exponent:.{self.decimals}f}".replace("-", "−")
        return shown + (power_of_ten(self.exponent) if self.exponent else "")

    def sd(self, value: float) -> str:
        """Return a standard deviation; beside numbers with a power of ten it has its own."""
        return number(value) if self.exponent else self.text(value)

    def interval(self, low: float, high: float) -> str:
        """Return the two ends of an interval.

        Examples
        --------
        >>> from bayesperiodic.reporting.html import Rounding
        >>> Rounding(-3, 1).interval(4e-3, 5.1e-3), Rounding(0, 1).interval(-1.0, 2.0)
        ('(4.0 … 5.1)×10⁻³', '−1.0 … 2.0')
        """
        if not isfinite(low) or not isfinite(high):
            return NOTHING
        plain = Rounding(0, self.decimals)
        ends = f"{plain.text(low / 10.0**self.exponent)} … {plain.text(high / 10.0**self.exponent)}"
        return f"({ends}){power_of_ten(self.exponent)}" if self.exponent else ends


SIGNS = {"good": "✓", "caution": "!", "bad": "✕", "neutral": "•"}


@cache
def environment() -> Environment:
    """Return the template engine; whatever it is given is escaped."""
    made = Environment(
        loader=PackageLoader("bayesperiodic.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.tests["badge"] = lambda value: isinstance(value, Badge)
    return made


def page(title: str, subtitle: str, badges: Sequence[Badge], sections: Sequence[Section], written: str) -> str:
    """Return the page.

    Parameters
    ----------
    title, subtitle : str
    badges : sequence of Badge
        Shown beside the title.
    sections : sequence of Section
    written : str
        When.
    """
    template = environment().get_template("page.html")
    return template.render(
        title=title, subtitle=subtitle, badges=badges, sections=sections, written=written, signs=SIGNS
    )
