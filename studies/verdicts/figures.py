"""Figures of the gallery of verdicts."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies.verdicts.cases import COMPARE, IDENTIFIABILITY, PREDICT
from studies.verdicts.outcome import Outcome

BINS, SHOWN = 50, (0.0005, 0.9995)
RIDGES = {"product_ridge": None, "sum_ridge": None, "scaling_symmetry": ["m", "k1", "k2", "k3", "l"]}
WIDTH = 72


def figures(outcomes: Mapping[str, Outcome]) -> dict[str, Figure]:
    """Return the gallery, and a corner of every ridge."""
    found = {"gallery": gallery(outcomes)}
    for name, names in RIDGES.items():
        if name in outcomes:
            outcome = outcomes[name]
            shown = list(outcome.problem.names) if names is None else names
            found[name] = bp.plot.corner(outcome.drawn.posterior, laplace=outcome.fit, names=shown)
    return found


def gallery(outcomes: Mapping[str, Outcome]) -> Figure:
    """Draw, for every case, the marginal of one parameter and what was said of it."""
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(11.0, 1.55 * len(outcomes) + 0.7), layout="constrained")
    grid = figure.subplots(len(outcomes), 2, squeeze=False, width_ratios=[1.0, 1.35])
    for (left, right), outcome in zip(grid, outcomes.values(), strict=True):
        _marginal(left, outcome)
        _words(right, outcome)
    handles = {label: h for row in grid for h, label in zip(*row[0].get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=3, frameon=False)
    figure.suptitle("synthetic data", x=0.99, ha="right", fontsize="medium")
    return figure


def _marginal(axes: Axes, outcome: Outcome) -> None:
    name, colours = outcome.case.shown, bp.plot.COLOURS
    draws = outcome.drawn.posterior.draws(name)
    density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
    axes.stairs(density, edges, color=colours["mcmc"], fill=True, label="MCMC")
    mean, sd, truth = outcome.fit.theta[name], outcome.fit.sd[name], outcome.case.truth[name]
    low, high = min(edges[0], truth), max(edges[-1], truth)
    margin = 0.06 * (high - low)
    x = np.linspace(low - margin, high + margin, 400)
    if np.isfinite(sd):
        normal = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes.plot(x, normal, color=colours["laplace"], lw=1.8, ls="--", label="Laplace")
        axes.set_ylim(0.0, 1.1 * max(density.max(), min(normal.max(), 1.6 * density.max())))
    axes.axvline(truth, color="black", lw=1.6, label="truth")
    axes.set_xlim(x[0], x[-1])
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=5, steps=[1, 2, 5, 10])
    axes.spines[["left", "right", "top"]].set_visible(False)
    unit = outcome.problem.model.units.get(name, "1")
    axes.set_xlabel(name if unit == "1" else f"{name} [{unit}]")


def _words(axes: Axes, outcome: Outcome) -> None:
    """Write what is wrong and what was said, the verdict that names the fault in bold."""
    case, said = outcome.case, outcome.verdicts
    axes.set_axis_off()
    axes.text(0.0, 1.0, textwrap.fill(f"wrong: {case.title}", WIDTH), va="top", fontsize=11, weight="bold")
    rows = {
        IDENTIFIABILITY: _grouped(said[IDENTIFIABILITY]),
        COMPARE: _grouped(said[COMPARE]),
        PREDICT: said[PREDICT]["all"],
    }
    for place, (tool, text) in zip((0.66, 0.40, 0.14), rows.items(), strict=True):
        bold = tool in case.fault
        axes.text(0.0, place, tool, va="center", fontsize=10, color="#555555")
        weight = "bold" if bold else "normal"
        axes.text(0.19, place, textwrap.fill(text, WIDTH), va="center", fontsize=9, weight=weight)
    mark = "as expected" if not outcome.wrong else "NOT AS EXPECTED"
    axes.text(1.0, 0.14, mark, va="center", ha="right", fontsize=10, style="italic")


def _grouped(verdicts: Mapping[str, str]) -> str:
    """Return verdicts in words, parameters with the same one together."""
    members: dict[str, list[str]] = {}
    for name, verdict in verdicts.items():
        members.setdefault(verdict, []).append(name)
    return "; ".join(f"{', '.join(names)} {verdict}" for verdict, names in members.items())
