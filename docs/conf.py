"""Configuration of Sphinx: pages from the docstrings, the notebooks and the texts in this folder."""

import importlib.metadata
import re
import shutil
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from numpydoc.xref import DEFAULT_LINKS

import bayesperiodic as bp

HERE = Path(__file__).parent
# Sphinx reads pages from this folder only. Copies keep their times, so that unchanged notebooks are not read again.
for notebook in (HERE.parent / "studies" / "notebooks").glob("*.ipynb"):
    shutil.copy2(notebook, HERE / "tutorials" / notebook.name)
shutil.copytree(HERE.parent / "studies" / "notebooks" / "sketches", HERE / "tutorials" / "sketches", dirs_exist_ok=True)
# Public names whose modules are elsewhere in the package.
sys.modules |= {f"bayesperiodic.{name}": getattr(bp, name) for name in ("noise", "elements", "measurements")}

project, author = "bayesperiodic", "the bayesperiodic authors"
release = importlib.metadata.version("bayesperiodic")

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "myst_nb", "numpydoc"]
templates_path, exclude_patterns = ["_templates"], ["_build"]
default_role, nitpicky, add_module_names, smartquotes = "autolink", True, False, False

# The notebooks are shown with the outputs that they store; `pytest -m document` executes them.
nb_execution_mode, nb_merge_streams = "off", True
myst_enable_extensions, myst_heading_anchors = ["attrs_block", "dollarmath"], 3

html_theme, html_title = "furo", f"bayesperiodic {release}"
html_static_path, html_css_files = ["_static"], ["cards.css"]
html_show_sourcelink = html_copy_source = html_show_copyright = False
html_math_renderer = "mathml"
# On file systems without case these names equal those of classes.
autosummary_filename_map = {f"bayesperiodic.{n}": f"bayesperiodic.{n}_function" for n in ("profile", "structure")}

# Types, shapes and units are in the docstrings.
autodoc_typehints, autodoc_member_order = "none", "bysource"
numpydoc_show_class_members = False
# Links to classes of the package only; those of other packages need their inventories from the network.
numpydoc_xref_param_type, numpydoc_xref_ignore = True, "all"
numpydoc_xref_aliases = {name: name for name in DEFAULT_LINKS}
numpydoc_xref_aliases |= {n: f"bayesperiodic.{n}" for n in bp.__all__ if isinstance(getattr(bp, n), type)}


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


def formula(writer: Any, node: nodes.Element) -> None:
    """Write a formula as MathML, which browsers show without scripts and without the network."""
    block = isinstance(node, nodes.math_block)
    # The converter leaves no space after names of functions, and sets the index of a letter with an accent below it.
    text = re.sub(r"\\ln(?=\s)", r"\\ln\,", node.astext()).replace(r"\hat{y}_", r"\hat{y}{}_")
    markup = tex2mathml(text, as_block=block)
    writer.body.append(
        f'<div class="math" style="overflow: auto hidden; padding: 0.2em 0">{markup}</div>' if block else markup
    )
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Connect the functions above to Sphinx."""
    app.connect("autodoc-process-docstring", typeset)
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
