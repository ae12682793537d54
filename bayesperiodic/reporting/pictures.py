"""Figures of the report: what they show, their images, and where in them values are."""

import base64
import io
import json
from collections.abc import Iterator
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import BboxBase

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.sweeps import tables
from bayesperiodic.reporting.contents import ReportInputs, rms
from bayesperiodic.reporting.html import number
from bayesperiodic.sampling.draws import Posterior

MOST_PANELS = 7
# Experiments whose period is drawn; each takes about half a second and 80 kB.
MOST_DRAWN = 24
SCALES = ("linear", "log")
POINTS_PER_INCH = 72.0


class Picture(NamedTuple):
    """An image as a data URL, and its panels with what they show, in JSON."""

    url: str
    panels: str


def drawn(given: ReportInputs) -> list[Experiment]:
    """Return the experiments whose period is drawn: all, or those with the largest residuals, in their order."""
    every, residuals = [e for e in given.problem.experiments if e.outputs], given.fit.residuals
    whole = {channel: max(size, np.finfo(float).tiny) for channel, size in given.fit.rms.items()}
    deviations = [max(rms(left) / whole[c] for c, left in residuals[e.name].items()) for e in every]
    kept = np.sort(np.argsort(np.negative(deviations), kind="stable")[:MOST_DRAWN])
    return [every[i] for i in kept.tolist()]


def has_tables(problem: Problem) -> bool:
    """Return whether there are points of response tables, which `plot.response` draws."""
    return bool(tables(problem))


def embedded(drawing: Figure, name: str) -> Picture:
    """Return a figure as an SVG image, reproducibly, and close it.

    Groups of panels and curves have ids, by which the script finds them in the image.
    """
    curves = [[*_named_curves(axes, place)] for place, axes in enumerate(drawing.axes)]
    buffer = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": name, "svg.fonttype": "path", "savefig.bbox": "standard"}):
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    panels = [_panel(axes, drawing) | {"curves": drawn} for axes, drawn in zip(drawing.axes, curves, strict=True)]
    plt.close(drawing)
    url = f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
    return Picture(url, json.dumps(panels, ensure_ascii=False, separators=(",", ":")))


def _named_curves(axes: Axes, place: int) -> Iterator[dict[str, str]]:
    """Give ids to the panel and its curves; yield for each what it is, from its `plot.style.curve_id`, and its form."""
    axes.set_gid(f"panel-{place}")
    for count, artist in enumerate(a for a in axes.get_children() if a.get_gid()):
        curve, channel, experiment = json.loads(str(artist.get_gid()))
        artist.set_gid(f"curve-{place}-{count}")
        yield {
            "id": f"curve-{place}-{count}",
            "curve": curve,
            "channel": channel,
            "experiment": experiment,
            "form": _form(artist),
        }


def _form(artist: Artist) -> str:
    """Return how the values of an artist are drawn; of a line all points are kept in the image."""
    if not isinstance(artist, Line2D):
        return "band" if isinstance(artist, Collection) else "other"
    if artist.get_linestyle() == "None":
        return "points"
    with plt.rc_context({"path.simplify": False}):
        artist.recache(always=True)
    return "line"


def _panel(axes: Axes, drawing: Figure) -> dict[str, Any]:
    """Return a panel's place in the image, in points from above left, with labels, limits and scales of its axes.

    A panel without a label has that of the one above, below or beside it with the same limits.
    """
    box, every = axes.bbox, drawing.axes
    column = [a for a in every if np.allclose([a.bbox.x0, a.bbox.x1], [box.x0, box.x1])]
    row = [a for a in every if np.allclose([a.bbox.y0, a.bbox.y1], [box.y0, box.y1])]
    xlabels = [axes.get_xlabel(), *(a.get_xlabel() for a in column if a.get_xlim() == axes.get_xlim())]
    ylabels = [axes.get_ylabel(), *(a.get_ylabel() for a in row if a.get_ylim() == axes.get_ylim())]
    x = {"label": _plain(xlabels), "limits": axes.get_xlim(), "scale": axes.get_xscale()}
    y = {"label": _plain(ylabels), "limits": axes.get_ylim(), "scale": axes.get_yscale()}
    around = axes.get_tightbbox() or box
    return {"box": _place(box, drawing), "around": _place(around, drawing), "x": _known(x), "y": _known(y)}


def _plain(labels: list[str]) -> str:
    """Return the first label that is not empty, as it is read."""
    return " ".join(next(filter(None, labels), "").replace(r"\$", "$").split())


def _known(axis: dict[str, Any]) -> dict[str, Any] | None:
    """Return the axis if values can be read from it."""
    return axis if axis["label"] and axis["scale"] in SCALES else None


def _place(box: BboxBase, drawing: Figure) -> list[float]:
    """Return left, top, right and bottom of a box [pt]."""
    scale, height = POINTS_PER_INCH / drawing.dpi, POINTS_PER_INCH * drawing.get_figheight()
    sides = box.x0 * scale, height - box.y1 * scale, box.x1 * scale, height - box.y0 * scale
    return [round(float(side), 6) for side in sides]


def most_correlated(posterior: Posterior) -> tuple[list[str], str]:
    """Return the names of the most correlated quantities, and a sentence on the strongest correlation."""
    names = posterior.names
    correlations = np.atleast_2d(np.corrcoef(np.stack([posterior.draws(name) for name in names])))
    np.fill_diagonal(correlations, 0.0)
    correlations = np.nan_to_num(correlations)
    kept = np.sort(np.argsort(-np.abs(correlations).max(axis=0), kind="stable")[:MOST_PANELS])
    strongest = ""
    if len(names) > 1:
        i, j = sorted(np.unravel_index(np.argmax(np.abs(correlations)), correlations.shape))
        value = number(float(correlations[i, j]), 2)
        strongest = f" The strongest correlation is {value}, between {names[i]} and {names[j]}."
    return [names[i] for i in kept], strongest
