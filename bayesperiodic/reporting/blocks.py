"""What a page is made of: sections, and in them words, tables, figures and equations."""

from dataclasses import dataclass, field
from typing import ClassVar

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
