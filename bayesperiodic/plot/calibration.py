"""Where truths lie among the answers: histograms, distribution functions, coverage."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic.diagnosis.calibration import Calibration, coverage
from bayesperiodic.diagnosis.campaigns import METHODS
from bayesperiodic.diagnosis.uniformity import bin_count, binomial_band, ecdf_band, evaluation_points
from bayesperiodic.plot.style import COLOURS, wrapped_label

LEVEL = 0.99
# Of the histograms' axes, for the legend.
HEADROOM = 1.45
COLUMNS = {
    "truths in each bin / expected": "position of the truth in the posterior",
    "distribution function − diagonal": "position of the truth in the posterior",
    "coverage − probability": "probability of the interval",
}
LABELS = {"mcmc": "MCMC", "laplace": "Laplace"}
LINES = {"mcmc": "-", "laplace": "--"}


def ranks(calibration: Calibration, *, figure: Figure | None = None) -> Figure:
    """Draw rank histograms, empirical distribution functions and coverage of every quantity, MCMC and Laplace together.

    A row a quantity. Left the histogram of where the truth lies among the answers, flat if calibrated, with the band of
    99 % of each bin; a ∪ means intervals that are too narrow. In the middle the distribution function less the
    diagonal, with the band that holds all of it with 99 %. Right the coverage of central intervals less their
    probability, with the pointwise band of 99 %.

    Parameters
    ----------
    calibration : Calibration
    figure : Figure, optional
        An empty figure with a constrained layout to draw into.

    Returns
    -------
    Figure

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(32) / 32)
    >>> run = bp.Experiment("run", 0.1, {"displacement": force}, {"force": force}, samples=32, cycles=4,
    ...                     harmonics={"displacement": 5, "force": 5})
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"k": bp.LogNormal(1, 0.1)}, scheme="fourier",
    ...                      fixed={"m": 1, "c": 0.2, "k3": 0.5, "variance[displacement]": 1e-4})
    >>> found = bp.calibrate(problem, replicates=2, seed=1, max_steps=250, progress=False)
    >>> [axes.get_title() for axes in bp.plot.ranks(found).axes]
    ['truths in each bin / expected', 'distribution function − diagonal', 'coverage − probability']
    """
    names = calibration.names
    figure = figure or plt.figure(figsize=(10.5, 2.1 * len(names) + 1.0), layout="constrained")
    panels = figure.subplots(len(names), 3, squeeze=False)
    verdicts = calibration.table.set_index(["method", "quantity"])["verdict"]
    for row, name in zip(panels, names, strict=True):
        for method in METHODS:
            values = calibration.positions[method][name]
            values = np.sort(values[np.isfinite(values)])
            said = f"{LABELS[method]}: {verdicts[method, name]}"
            _histogram(row[0], values, method, said)
            _distribution(row[1], values, method)
            _coverage(row[2], values, method)
        row[0].set_ylim(0.0, HEADROOM * row[0].get_ylim()[1])
        row[0].set_ylabel(wrapped_label(name, ""))
        row[0].legend(frameon=False, fontsize="small", loc="upper center")
    for top, bottom, (title, label) in zip(panels[0], panels[-1], COLUMNS.items(), strict=True):
        top.set_title(title, fontsize="medium")
        bottom.set_xlabel(label)
    figure.suptitle(f"{calibration.replicates} synthetic campaigns; bands of 99 %", fontsize="medium")
    return figure


def _histogram(axes: Axes, values: np.ndarray, method: str, label: str) -> None:
    bins = bin_count(values.size)
    counts, edges = np.histogram(values, bins, (0.0, 1.0))
    expected = max(values.size, 1) / bins
    if method == METHODS[0] and values.size:
        low, high = binomial_band(values.size, np.array(1.0 / bins), 1.0 - LEVEL)
        axes.axhspan(float(low) * bins, float(high) * bins, color="grey", alpha=0.25, lw=0)
    axes.stairs(counts / expected, edges, color=COLOURS[method], ls=LINES[method], lw=1.6, label=label)
    axes.set_xlim(0.0, 1.0)


def _distribution(axes: Axes, values: np.ndarray, method: str) -> None:
    points = evaluation_points()
    if method == METHODS[0] and values.size:
        low, high = ecdf_band(values.size, LEVEL)
        axes.fill_between(points, low - points, high - points, color="grey", alpha=0.25, lw=0)
    steps = np.searchsorted(values, points, side="right") / max(values.size, 1)
    axes.plot(points, steps - points, color=COLOURS[method], ls=LINES[method], lw=1.4)
    axes.set_xlim(0.0, 1.0)


def _coverage(axes: Axes, values: np.ndarray, method: str) -> None:
    levels = evaluation_points()
    if method == METHODS[0] and values.size:
        low, high = binomial_band(values.size, levels, 1.0 - LEVEL)
        axes.fill_between(levels, low - levels, high - levels, color="grey", alpha=0.25, lw=0)
    axes.plot(
        levels, [coverage(values, level) - level for level in levels], color=COLOURS[method], ls=LINES[method], lw=1.4
    )
    axes.set_xlim(0.0, 1.0)
