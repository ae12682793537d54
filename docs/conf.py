"""Configuration of Sphinx: pages from the docstrings, the README and the texts in this folder."""

import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

from numpydoc.xref import DEFAULT_LINKS

import bayesperiodic as bp

README = Path(__file__).parents[1] / "README.md"
# A public name whose module is elsewhere in the package.
sys.modules["bayesperiodic.noise"] = bp.noise

project, author = "bayesperiodic", "the bayesperiodic authors"
release = importlib.metadata.version("bayesperiodic")

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "myst_parser", "numpydoc"]
templates_path, exclude_patterns = ["_templates"], ["_build"]
default_role, nitpicky, add_module_names, smartquotes = "autolink", True, False, False

html_theme, html_title = "furo", f"bayesperiodic {release}"
html_show_sourcelink = html_copy_source = False
# On file systems without case these names equal those of classes.
autosummary_filename_map = {f"bayesperiodic.{n}": f"bayesperiodic.{n}_function" for n in ("profile", "structure")}

# Types, shapes and units are in the docstrings.
autodoc_typehints, autodoc_member_order = "none", "bysource"
numpydoc_show_class_members = False
# Links to classes of the package only; those of other packages need their inventories from the network.
numpydoc_xref_param_type, numpydoc_xref_ignore = True, "all"
numpydoc_xref_aliases = {name: name for name in DEFAULT_LINKS}
numpydoc_xref_aliases |= {n: f"bayesperiodic.{n}" for n in bp.__all__ if isinstance(getattr(bp, n), type)}


def landing_page(app: Any, page: str, source: list[str]) -> None:
    """Insert the README as the first page, with links to files relative to this folder."""
    if page == "index":
        source[0] = re.sub(r"\]\((?!\w+:|#)", "](../", README.read_text("utf-8")) + source[0]


def typeset(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Insert the equations of a model of the library, and the units of its names, below its first paragraph."""
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
    """Connect the functions above to Sphinx."""
    app.connect("source-read", landing_page)
    app.connect("autodoc-process-docstring", typeset)
