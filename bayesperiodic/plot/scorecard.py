"""How Laplace compares with MCMC: marginals, quantiles, and the share of draws in Laplace's ellipsoids."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtri

from bayesperiodic.diagnosis.comparison import Comparison
from bayesperiodic.diagnosis.verdicts import END_SHIFT, ERRORS, FINE, LEVELS
from bayesperiodic.plot.marginal import draw_marginal, panel_grid
from bayesperiodic.plot.pairs import chosen
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, axis_label, said_of, wrapped_label

# Those of several lines that mean nothing else.
LOOKS = [(colour, style) for style in ("-", "-.") for colour in ENSEMBLES if colour not in COLOURS.values()]
LIMIT = 4.0


def comparison(comparison: Comparison, *, names: Sequence[str] | None = None, figure: Figure | None = None) -> Figure:
    """Draw a comparison of Laplace with MCMC: marginals, quantiles against quantiles, and ellipsoid coverage.

    Quantiles are distances from the MAP in sds of the draws; the grey band is as far as an end may be off. Named are
    the parameters with a verdict other than "fine", the six farthest from Laplace. Ellipsoids are those of all
    coordinates together, whatever names are drawn; their band is three Monte Carlo errors wide to each side.

    Parameters
    ----------
    comparison : Comparison
    names : sequence of str, optional
        Those to draw; by default all.
    figure : Figure, optional
        An empty figure with a constrained layout to draw into.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown name.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> figure = bp.plot.comparison(bp.compare(problem, fit, posterior))
    >>> [axes.get_xlabel().splitlines()[0] for axes in figure.axes]
    ['c', 'k', 'Laplace quantile − MAP [posterior sd]', "probability of Laplace's ellipsoid"]
    """
    names = chosen(names, tuple(comparison.table.index))
    columns, rows = panel_grid(len(names))
    size = max(2.4 * columns, 8.4), 2.5 * rows + 4.6
    figure = figure or plt.figure(figsize=size, layout="constrained")
    top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[2.5 * rows + 0.4, 4.2])[:, 0]
    panels = top.subplots(rows, columns, squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        about = comparison.table.loc[name].to_dict()
        draw_marginal(axes, comparison.edges[name], comparison.densities[name], about["map"], about["laplace_sd"])
        axes.set_title(about["verdict"], fontsize="medium")
        axes.set_xlabel(_coordinate_label(comparison, name))
    for axes in panels[len(names) :]:
        axes.remove()
    top.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if said := said_of(comparison.synthetic, comparison.converged):
        top.suptitle(said, x=0.99, ha="right", fontsize="medium")
    left, right = below.subplots(1, 2)
    _quantiles(left, comparison, names)
    _coverage(right, comparison)
    return figure


def _coordinate_label(comparison: Comparison, name: str) -> str:
    coordinate, unit = str(comparison.table.loc[name, "coordinate"]), comparison.units[name]
    if coordinate == name or not unit:
        return wrapped_label(coordinate, unit)
    return f"{wrapped_label(coordinate, '')}\n(in {unit})"


def _quantiles(axes: Axes, comparison: Comparison, names: Sequence[str]) -> None:
    table = comparison.table.loc[[*names]]
    wrong = table[table["verdict"] != FINE].sort_values("wasserstein", ascending=False).index[: len(LOOKS)]
    axes.axline((0.0, 0.0), slope=1.0, color=COLOURS["laplace"], lw=1.4, ls="--")
    reach = np.array([-LIMIT, LIMIT])
    axes.fill_between(reach, reach - END_SHIFT, reach + END_SHIFT, color="grey", alpha=0.25, lw=0)
    unnamed = "fine" if set(table["verdict"]) == {FINE} or len(wrong) == sum(table["verdict"] != FINE) else "others"
    for name in [*table.index.difference(wrong, sort=False), *wrong]:
        line = table.loc[name]
        if not np.isfinite(line["laplace_sd"]):
            continue
        across = ndtri(comparison.probabilities) * line["laplace_sd"] / line["sd"]
        up = (comparison.quantiles[name] - line["map"]) / line["sd"]
        if name in wrong:
            colour, style = LOOKS[int(np.flatnonzero(wrong == name)[0])]
            axes.plot(across, up, color=colour, ls=style, lw=2.0, label=axis_label(f"{name}: {line['verdict']}", ""))
        else:
            axes.plot(across, up, color="black", lw=0.8, label=unnamed)
    axes.set_xlim(-LIMIT, LIMIT)
    axes.set_ylim(-LIMIT, LIMIT)
    axes.set_aspect("equal")
    axes.set_xlabel("Laplace quantile − MAP [posterior sd]")
    axes.set_ylabel("MCMC quantile − MAP [posterior sd]")
    handles = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    axes.legend(handles.values(), handles.keys(), frameon=False, fontsize="small", loc="upper left")


def _coverage(axes: Axes, comparison: Comparison) -> None:
    across, shares, errors = comparison.probabilities, comparison.shares, comparison.shares_mcse
    axes.plot([0.0, 1.0], [0.0, 1.0], color=COLOURS["laplace"], lw=1.4, ls="--", label="Laplace")
    axes.fill_between(
        across, shares - ERRORS * errors, shares + ERRORS * errors, color=COLOURS["mcmc"], alpha=0.45, lw=0
    )
    axes.plot(across, shares, color=COLOURS["mcmc"], lw=1.8, label="MCMC")
    axes.plot(LEVELS, np.interp(LEVELS, across, shares), "o", color=COLOURS["mcmc"], ms=6)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    axes.set_aspect("equal")
    axes.set_xlabel("probability of Laplace's ellipsoid")
    axes.set_ylabel("share of the draws inside")
    axes.set_title(
        rf"jointly: {comparison.joint['verdict']}, $\hat{{k}}$ = {comparison.joint['pareto_k']:.2f}", fontsize="medium"
    )
    axes.legend(frameon=False, fontsize="small", loc="upper left")
