"""Colours, labels and panels of all figures; each colour has one meaning everywhere."""

import functools
import inspect
import json
import re
import textwrap
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from scipy.stats import norm

from bayesperiodic import _checks
from bayesperiodic.problem.parameters import unit
from bayesperiodic.sampling.draws import Posterior

#: Colours of measurements, of the MAP estimate, of the Laplace approximation and of MCMC, in all figures.
COLOURS = {"measured": "#000000", "map": "#0072B2", "laplace": "#D55E00", "mcmc": "#56B4E9"}
#: Colours of Okabe and Ito, and of Tol, of different lightness: they can be told apart in grey too.
ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#882255", "#DDCC77", "#332288")
LAPLACE_STYLE: dict[str, Any] = {"color": COLOURS["laplace"], "lw": 1.6, "ls": "--"}
LABEL_LENGTH, PANELS_ACROSS = 24, 4
SHEET = "bayesperiodic.plot.figures"
Arguments = ParamSpec("Arguments")
# Entries of the docstrings of all figures, in their order, each with its first line.
SHARED_ENTRIES = {
    "figure : Figure": "figure : Figure, optional\n    To draw into: empty, with a constrained layout.",
    "Returns\n": "\nReturns\n-------\nFigure",
    "Raises\n": "\nRaises\n------\nValueError\n"
    "    For an object of another class, an unknown name or results of another problem.",
}
# What is there for problems without time histories.
OF_TABLES = "bp.plot.response(problem, fit) draws response tables"


def styled(draw: Callable[Arguments, Figure]) -> Callable[Arguments, Figure]:
    """Return a function that draws in the style of the package, without a change of matplotlib's settings.

    The entries of its docstring that are the same for all figures are added.
    """
    described, *rest = re.split(r"\n(?=\nRaises\n|\nWarns\n|\nExamples\n)", inspect.cleandoc(draw.__doc__ or ""))
    missing = [text for start, text in SHARED_ENTRIES.items() if start not in "\n".join([described, *rest])]

    @functools.wraps(draw)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Figure:
        # Loads the backend: Jupyter's switches the display of figures on, which the end of the context would undo.
        plt.draw_if_interactive()
        with plt.style.context(SHEET):
            return draw(*args, **kwargs)

    wrapped.__doc__ = "\n".join([described, *missing, *rest])
    return wrapped


def caveats_of(posterior: Posterior) -> str:
    """Return the caveats on draws, for the title of a figure."""
    text = caveats(bool(posterior.tree.attrs.get("synthetic")), posterior.converged)
    return ", ".join(filter(None, [text, "model misspecified" if posterior.misfit else ""]))


def kind_of(posterior: Posterior) -> str:
    """Return what the draws of `Posterior.headline` are, for the legend of a figure."""
    return "robust" if posterior.headline.is_robust else "MCMC"


def caveats(synthetic: bool, converged: bool) -> str:
    """Return the caveats on data and draws, for the title of a figure."""
    return ", ".join((["synthetic data"] if synthetic else []) + ([] if converged else ["NOT CONVERGED"]))


def draws_label(posterior: Posterior, name: str, length: int = LABEL_LENGTH) -> str:
    """Return the label of a quantity by its full name."""
    return wrapped_label(name, unit(posterior.tree["posterior"].to_dataset(), name), length)


def wrapped_label(name: str, unit: str, length: int = LABEL_LENGTH) -> str:
    """Return a label in short lines, broken also at _ and [, with the unit on the last one."""
    breakable = re.sub(r"(?<=_)(?=\w)|(?=\[)", "\v", name)
    lines = textwrap.fill(breakable, length, replace_whitespace=False).replace("\v", "")
    return axis_label(lines, unit).replace(" [", "\n[")


TO_SUPERSCRIPTS = str.maketrans("-−0123456789", "⁻⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def axis_label(name: str, unit: str = "") -> str:
    """Return a name with its unit, if any, escaped for matplotlib; powers in the unit are superscripts."""
    powers = re.sub(r"(?:\^|\*\*)\(?(-?\d+)\)?(?![\d./])", lambda match: match[1].translate(TO_SUPERSCRIPTS), unit)
    text = f"{name} [{powers}]" if unit not in ("", "1") else name
    return text.replace("$", r"\$")


def curve_id(curve: str, channel: str, experiment: str) -> str:
    """Return the group id (`gid`) of a curve, a band or points, by which the report finds what they show."""
    return json.dumps([curve, channel, experiment])


def chosen(names: Sequence[str] | None, every: tuple[str, ...], argument: str = "names") -> tuple[str, ...]:
    """Return the validated names to draw, by default all."""
    if names is None:
        return every
    if isinstance(names, str) or not len(names):
        raise ValueError(f"{argument}: must be a sequence of names, such as [{every[0]!r}], got {names!r}.")
    for name in names:
        _checks.one_of(argument, name, every)
    if len(set(names)) < len(names):
        raise ValueError(f"{argument}: must be different names, got {list(names)}.")
    return tuple(names)


def panel_grid(count: int, across: int = PANELS_ACROSS) -> tuple[int, int]:
    """Return the numbers of columns and rows of so many panels."""
    columns = min(count, across)
    return columns, -(-count // columns)


def panels(figure: FigureBase, count: int, across: int = PANELS_ACROSS, sharey: bool = False) -> list[Axes]:
    """Create so many panels in a grid."""
    columns, rows = panel_grid(count, across)
    grid = figure.subplots(rows, columns, sharey=sharey, squeeze=False).ravel()
    for axes in grid[count:]:
        axes.remove()
    return list(grid[:count])


def legend_entries(*panels: Axes) -> dict[str, Any]:
    """Return the last artist of each label in the panels."""
    return {label: artist for axes in panels for artist, label in zip(*axes.get_legend_handles_labels(), strict=True)}


def draw_marginal(axes: Axes, edges: np.ndarray, density: np.ndarray, mean: float, sd: float) -> None:
    """Draw a histogram of draws, and a normal density if its sd is finite."""
    axes.stairs(density, edges, color=COLOURS["mcmc"], alpha=0.45, fill=True)
    axes.stairs(density, edges, color=COLOURS["mcmc"], lw=1.4, label="MCMC")
    if np.isfinite(sd) and sd > 0.0:
        width, reach = edges[-1] - edges[0], 3.0 * sd
        x = np.linspace(max(mean - reach, edges[0] - 0.5 * width), min(mean + reach, edges[-1] + 0.5 * width), 300)
        axes.plot(x, norm.pdf(x, mean, sd), label="Laplace", **LAPLACE_STYLE)
    axes.set_ylim(bottom=0.0)
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=4)
    axes.spines[["left", "right", "top"]].set_visible(False)
