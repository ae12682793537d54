"""Sphinx: how the pages are built from the docstrings, the README and the texts beside this file."""

import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

from numpydoc.xref import DEFAULT_LINKS

import bayesperiodic as bp

README = Path(__file__).parents[1] / "README.md"
# A name of the package, whose file is elsewhere in it.
sys.modules["bayesperiodic.noise"] = bp.noise

project, author = "bayesperiodic", "the bayesperiodic authors"
release = importlib.metadata.version("bayesperiodic")

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "myst_parser", "numpydoc"]
templates_path, exclude_patterns = ["_templates"], ["_build"]
default_role, nitpicky, add_module_names, smartquotes = "autolink", True, False, False

html_theme, html_title = "furo", f"bayesperiodic {release}"
html_show_sourcelink = html_copy_source = False
# Some file systems take these for the pages of the classes of that name.
autosummary_filename_map = {f"bayesperiodic.{n}": f"bayesperiodic.{n}_function" for n in ("profile", "structure")}

# Types, shapes and units stand in the docstrings.
autodoc_typehints, autodoc_member_order = "none", "bysource"
numpydoc_show_class_members = False
# Classes of the package become links; those of others would need their inventories from the network.
numpydoc_xref_param_type, numpydoc_xref_ignore = True, "all"
numpydoc_xref_aliases = {name: name for name in DEFAULT_LINKS}
numpydoc_xref_aliases |= {n: f"bayesperiodic.{n}" for n in bp.__all__ if isinstance(getattr(bp, n), type)}


def landing_page(app: Any, page: str, source: list[str]) -> None:
    """Put the README, its links to files made relative to this folder, on the first page."""
    if page == "index":
        source[0] = re.sub(r"\]\((?!\w+:|#)", "](../", README.read_text("utf-8")) + source[0]


def typeset(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Put the equations of a ready-made model, and the units of its names, below its first paragraph."""
    if not isinstance(value, bp.Model):
        return
    kinds = {"States": value.states, "Inputs": value.inputs, "Parameters": value.parameters, "Outputs": value.outputs}
    equations = ["", ".. math::", "", *(f"   {row}" for row in value.latex().splitlines()), ""]
    units = [
        f":{kind}: {', '.join(f'``{n}`` [{value.units[n]}]' for n in names)}" for kind, names in kinds.items() if names
    ]
    below = lines.index("", next(number for number, line in enumerate(lines) if line))
    lines[below:below] = [*equations, *units]


def setup(app: Any) -> None:
    """Connect what is done here."""
    app.connect("source-read", landing_page)
    app.connect("autodoc-process-docstring", typeset)
