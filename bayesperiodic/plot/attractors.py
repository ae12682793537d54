"""Figure of a measured attractor and of the one that a model predicts."""

from itertools import cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import _checks
from bayesperiodic.diagnostics.attractor import AttractorPrediction
from bayesperiodic.plot.branches import MOST_POINTS_DRAWN, PERIOD_MARKERS
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, axis_label, caveats, styled

MARGINAL_BINS = 60
MEASURED_POINTS: dict[str, Any] = {"color": "0.45"}
MODEL_POINTS: dict[str, Any] = {"color": COLOURS["map"]}


@styled
def attractor(prediction: AttractorPrediction, *, figure: Figure | None = None) -> Figure:
    """Draw the measured section and that of the model's free runs side by side, and their marginal densities.

    Of more than two coordinates the first two are drawn. Runs that leave the region of the recording are left out.

    Parameters
    ----------
    prediction : AttractorPrediction

    Examples
    --------
    >>> figure = bp.plot.attractor(attractor_prediction)
    >>> [axes.get_title() for axes in figure.axes[:2]]
    ['measured (2026 points)', 'model (1040 points)']
    """
    _checks.instance("prediction", prediction, AttractorPrediction)
    figure = figure or plt.figure(figsize=(8.4, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(3.0, 1.3))
    left = figure.add_subplot(grid[0, 0])
    right = figure.add_subplot(grid[0, 1], sharex=left, sharey=left)
    model = prediction.model_section.reshape(-1, len(prediction.coordinates))
    across, up = (axis_label(name, prediction.units.get(name, "")) for name in prediction.coordinates[:2])
    for ax, points, look, name in (
        (left, prediction.section, MEASURED_POINTS, "measured"),
        (right, model, MODEL_POINTS, "model"),
    ):
        shown = points[:: 1 + len(points) // MOST_POINTS_DRAWN]
        ax.plot(*shown[:, :2].T, ".", ms=2.0, mec="none", rasterized=True, **look)
        _orbit_points(ax, prediction)
        ax.set_title(f"{name} ({len(points)} points)", fontsize="medium")
        ax.set(xlabel=across)
    left.set_ylabel(up)
    right.tick_params(labelleft=False)
    if prediction.orbits:
        left.legend(frameon=False, fontsize="small")
    for column, label in enumerate((across, up)):
        ax = figure.add_subplot(grid[1, column])
        values = [prediction.section[:, column], model[:, column]]
        every = np.concatenate(values)
        edges = np.linspace(every.min(), every.max(), MARGINAL_BINS + 1).tolist()
        ax.hist(values[0], edges, density=True, label="measured", **MEASURED_POINTS)
        if values[1].size:
            ax.hist(values[1], edges, density=True, histtype="step", lw=1.4, label="model", **MODEL_POINTS)
        ax.set(xlabel=label, yticks=[])
        if column == 0:
            ax.set_ylabel("density")
            ax.legend(frameon=False, fontsize="small")
    notes = [f"attractor: {prediction.verdict}", caveats(prediction.synthetic, True)]
    if prediction.left:
        notes.append(f"{prediction.left} of {prediction.runs - prediction.unfitted} runs leave the region")
    figure.suptitle(", ".join(filter(None, notes)), fontsize="medium")
    return figure


def _orbit_points(ax: Axes, prediction: AttractorPrediction) -> None:
    """Draw the points of periodic orbits, one look for each period."""
    periods = sorted({len(points) for points in prediction.orbits.values()})
    for period, marker, colour in zip(periods, cycle(PERIOD_MARKERS), cycle(ENSEMBLES[1:]), strict=False):
        points = np.concatenate([points for points in prediction.orbits.values() if len(points) == period])
        look: dict[str, Any] = {"marker": marker, "color": colour, "ls": "", "mec": "black", "mew": 0.5}
        ax.plot(*points[:, :2].T, ms=max(6.5 - period, 3.5), label=f"period {period}", **look)
