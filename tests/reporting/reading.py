"""What a reader of a page finds in it: its elements in order, its tables, its words."""

from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "img", "br", "hr", "link", "input"}


@dataclass
class Element:
    """An element with its attributes and the words within it."""

    tag: str
    attributes: dict[str, str]
    words: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The words, with single spaces between them."""
        return " ".join("".join(self.words).split())


class Page(HTMLParser):
    """Elements of a page in the order in which they begin; raises for tags that do not match."""

    def __init__(self, source: str):
        super().__init__(convert_charrefs=True)
        self.elements: list[Element] = []
        self.tables: dict[str, list[list[Element]]] = {}
        self._open: list[Element] = []
        self._table = ""
        self.feed(source)
        self.close()
        assert not self._open, [e.tag for e in self._open]

    def handle_starttag(self, tag, attrs):
        """Begin an element."""
        element = Element(tag, {name: value or "" for name, value in attrs})
        self.elements.append(element)
        if tag not in VOID:
            self._open.append(element)
        if tag == "table":
            self._table = element.attributes["id"]
            self.tables[self._table] = []
        elif tag == "tr":
            self.tables[self._table].append([])
        elif tag in ("th", "td"):
            self.tables[self._table][-1].append(element)

    def handle_endtag(self, tag):
        """End the innermost element."""
        assert self._open.pop().tag == tag

    def handle_data(self, data):
        """Give words to all open elements."""
        for element in self._open:
            element.words.append(data)

    def all(self, *tags: str) -> list[Element]:
        """Return the elements of these kinds."""
        return [e for e in self.elements if e.tag in tags]

    def rows(self, table: str) -> dict[str, list[str]]:
        """Return the cells of a table's rows by what heads the row."""
        rows = self.tables[table]
        return {row[0].text: [cell.text for cell in row[1:]] for row in rows if row[0].attributes.get("scope") == "row"}

    @property
    def text(self) -> str:
        """All that is said on the page."""
        return next(e for e in self.elements if e.tag == "body").text


def value(cell: str) -> float:
    """Return the number that a cell shows."""
    raised = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")
    mantissa, _, power = cell.replace("×10", " ").translate(raised).partition(" ")
    return float(mantissa) * 10.0 ** int(power or 0)
