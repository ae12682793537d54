"""Corner plots by the package corner: histograms of draws and contours of their two-dimensional histograms."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bayesperiodic.plot.grid import TITLE_QUANTILES, arrange, interval_title, write_labels, write_legend
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, caveats_of, kind_of, legend_entries
from bayesperiodic.sampling.convergence import arviz
from bayesperiodic.sampling.draws import Posterior

#: Options of `corner.corner` that are passed on; the others set labels and ticks, or are those of ArviZ.
CORNER_OPTIONS = (
    "bins", "color", "contour_kwargs", "contourf_kwargs", "data_kwargs", "fig", "fill_contours", "hist_bin_factor",
    "hist_kwargs", "levels", "no_fill_contours", "pcolor_kwargs", "plot_contours", "plot_datapoints", "plot_density",
    "range", "scale_hist", "smooth", "smooth1d", "title_fmt", "title_kwargs", "title_quantiles", "titles",
    "truth_color",
)  # fmt: skip
TITLE_OPTIONS = ("title_fmt", "title_quantiles", "titles")
TRUTH_LABEL = "truth"
# Room beyond a true value outside the range of the draws, as a part of the axis.
ROOM_BEYOND = 0.05


def draw_histograms(
    figure: Figure,
    posterior: Posterior,
    labels: Mapping[str, str],
    truths: Mapping[str, float],
    options: dict[str, Any],
) -> None:
    """Draw the quantities named by the keys of `labels` into an empty figure, or over one of as many quantities.

    Labels, ticks and legend are written as in the other style, because those of corner overlap if they are long.
    """
    arviz()  # which corner imports
    from corner import corner

    names = tuple(labels)
    draws = np.stack([posterior.headline.draws(name) for name in names], axis=-1)
    if len(figure.axes) not in (0, len(names) ** 2):
        raise ValueError(f"figure: must have no axes or {len(names) ** 2}, got {len(figure.axes)}.")
    constant = [name for name, values in zip(names, draws.T, strict=True) if np.ptp(values) == 0.0]
    if constant and "range" not in options:
        raise ValueError(f"names: must be quantities that vary, got {', '.join(constant)}; leave them out.")
    before = figure.axes[0].get_legend_handles_labels()[1] if figure.axes else []
    before = [label for label in before if label != TRUTH_LABEL]
    defaults: dict[str, Any] = {"color": ENSEMBLES[len(before) % len(ENSEMBLES)], "truth_color": COLOURS["measured"]}
    defaults["title_quantiles"] = TITLE_QUANTILES
    if not any(name in options for name in TITLE_OPTIONS):
        defaults |= {"titles": [interval_title(values) for values in draws.T], "title_fmt": None}
    histogram = {"label": f"{kind_of(posterior)} {len(before) + 1}" if before else kind_of(posterior), "lw": 1.4}
    histogram |= {"density": True} if options.get("smooth1d") is None else {}  # a line otherwise
    settings = defaults | options | {"hist_kwargs": histogram | dict(options.get("hist_kwargs") or {})}
    marks = [truths.get(name) for name in names]
    several = len(names) > 1
    corner(draws, truths=marks if truths and several else None, fig=figure, **settings)
    if not several and marks[0] is not None:  # corner 2.3.0 cannot mark the truth of a single quantity
        figure.axes[0].axvline(marks[0], color=settings["truth_color"])
    grid = np.reshape(np.array(figure.axes, dtype=object), (len(names), len(names)))
    for k, value in enumerate(marks):
        if value is not None:
            grid[k, k].lines[-1].set_label(TRUTH_LABEL)
            if "range" not in options:
                _contain(grid, k, value)
    write_labels(grid, [*labels.values()])
    arrange(grid, _legend(grid, caveats_of(posterior)))


def _contain(grid: np.ndarray, k: int, value: float) -> None:
    """Extend the axes of a quantity to a value outside."""
    low, high = grid[k, k].get_xlim()
    room = ROOM_BEYOND * (max(high, value) - min(low, value))
    low, high = value - room if value < low else low, value + room if value > high else high
    for axes in grid[k:, k]:
        axes.set_xlim(low, high)
    for axes in grid[k, :k]:
        axes.set_ylim(low, high)


def _legend(grid: np.ndarray, caveats: str) -> float:
    """Write one legend of all posteriors, with the caveats on each; return its height as `write_legend` does."""
    figure, titles = grid[0, 0].figure, [caveats]
    for legend in figure.legends[:]:
        titles.insert(0, legend.get_title().get_text())
        legend.remove()
    handles = [
        Line2D([], [], color=_colour(handle), lw=1.4 if label == TRUTH_LABEL else 4.0, label=label)
        for label, handle in sorted(legend_entries(*np.diag(grid)).items(), key=lambda entry: entry[0] == TRUTH_LABEL)
    ]
    every = dict.fromkeys(part for title in titles for part in title.split(", ") if part)
    return write_legend(grid, handles, ", ".join(every))


def _colour(handle: Any) -> Any:
    """Return the colour of a histogram, which is a line if it is smoothed, or of a line."""
    return handle.get_color() if isinstance(handle, Line2D) else handle.get_edgecolor()
