"""Labels, ticks, titles, legend and arrangement of the panels of corner plots, in a grid (names, names) of axes."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from bayesperiodic.plot.style import TO_SUPERSCRIPTS

# Panels of more names are smaller, and their labels have this size [points].
MANY_NAMES, SMALL_LABEL_SIZE = 6, 7
# Room between panels [inches]; part of an axis at each end without ticks, whose labels would touch those of the next.
PANEL_GAP, FREE_END = 0.06, 0.08
TITLE_QUANTILES = (0.05, 0.5, 0.95)
# Range of the powers of ten of ticks without an offset or a common factor.
PLAIN_POWERS = (-5, 10)


def write_labels(grid: np.ndarray, labels: Sequence[str]) -> None:
    """Write the names and the ticks at the left and the lower edge."""
    last, small = len(grid) - 1, {"size": SMALL_LABEL_SIZE} if len(grid) > MANY_NAMES else {}
    for i, j in np.argwhere(np.tri(len(grid))).tolist():
        axes = grid[i, j]
        for axis in (axes.xaxis, axes.yaxis) if j < i else (axes.xaxis,):
            _set_ticks(axis)
        axes.tick_params(axis="x", labelbottom=i == last, labelrotation=45)
        axes.tick_params(axis="y", labelleft=j == 0 and i > 0)
        plt.setp(axes.get_xticklabels(), ha="right", rotation_mode="anchor")
        for axis in (axes.xaxis, axes.yaxis):
            axis.get_offset_text().set_visible(False)
        if i == last:
            axes.set_xlabel(_with_factor(axes.xaxis, labels[j]), **small)
        if j == 0 and i > 0:
            axes.set_ylabel(_with_factor(axes.yaxis, labels[i]), **small)
    grid[0, 0].figure.align_labels()


def write_legend(grid: np.ndarray, handles: list[Any], title: str) -> float:
    """Write the legend into the upper right corner, and return the height that it needs above a single panel."""
    figure = grid[0, 0].figure
    legend = figure.legend(handles=handles, title=title or None, loc="upper right", handlelength=1.4)
    return legend.get_window_extent().height if len(grid) == 1 else 0.0


def arrange(grid: np.ndarray, above: float) -> None:
    """Put panels of one size as closely as their labels allow; `above` is the height of the legend [pixels]."""
    figure, count, gap = grid[0, 0].figure, len(grid), PANEL_GAP * grid[0, 0].figure.dpi
    left = 2.0 * gap + max(axes.bbox.x0 - axes.get_tightbbox().x0 for axes in grid[:, 0])
    bottom = 2.0 * gap + max(axes.bbox.y0 - axes.get_tightbbox().y0 for axes in grid[-1])
    title = grid[0, 0].get_tightbbox().y1 - grid[0, 0].bbox.y1
    size = figure.bbox.size
    start, between = np.array([left, bottom]), np.array([gap, title + gap])
    each = (size - start - [0.0, above + gap]) / count
    for (i, j), axes in np.ndenumerate(grid):
        corner = start + each * [j, count - 1 - i]
        axes.set_position((*corner / size, *(each - between) / size))


def interval_title(draws: np.ndarray) -> str:
    """Return the median of draws (n,) with the distances to the ends of the central 90 % interval."""
    return with_errors(*np.quantile(draws, TITLE_QUANTILES))


def with_errors(low: float, middle: float, high: float) -> str:
    """Return a value and the distances to the ends of an interval, to two digits of the shorter one."""
    shorter = min(high - middle, middle - low)
    digits = 1 - int(np.floor(np.log10(shorter))) if shorter > 0.0 else 4
    if digits < -3 or digits > 6:
        power = int(np.floor(np.log10(max(abs(middle), shorter))))
        scaled = [value / 10.0**power for value in (low, middle, high)]
        return rf"{with_errors(*scaled)} $\times\,10^{{{power}}}$"
    texts = [f"{round(value, digits) + 0.0:.{max(digits, 0)}f}" for value in (middle, high - middle, middle - low)]
    return rf"${texts[0]}^{{+{texts[1]}}}_{{-{texts[2]}}}$"


def _set_ticks(axis: Any) -> None:
    """Set two or three ticks, away from the ends, and write them without an offset."""
    low, high = axis.get_view_interval()
    room = FREE_END * (high - low)
    for count in (3, 4, 5, 7):
        ticks = MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(low, high)
        ticks = ticks[(ticks >= low + room) & (ticks <= high - room)]
        if len(ticks) > 1:
            break
    axis.set_ticks(ticks)
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_powerlimits(PLAIN_POWERS)
    axis.set_major_formatter(formatter)


def _with_factor(axis: Any, label: str) -> str:
    """Return a label with the common factor of the ticks in its unit, because it would overlap the panels."""
    formatter = axis.get_major_formatter()
    formatter.set_locs(axis.get_majorticklocs().tolist())
    factor, (name, _, unit) = formatter.get_offset(), label.rpartition("\n[")
    if not factor:
        return label
    power = "10" + factor.removeprefix("1e").translate(TO_SUPERSCRIPTS)
    return f"{name}\n[{power} {unit}" if name else f"{label}\n[{power}]"
