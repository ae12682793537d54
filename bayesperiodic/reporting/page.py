"""From sections to one HTML page."""

from collections.abc import Sequence
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from bayesperiodic.reporting.blocks import Badge, Section

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
