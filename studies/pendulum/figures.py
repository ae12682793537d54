"""Figures of the pendulum study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies.pendulum import estimates
from studies.pendulum.recording import TRUTH, UNITS

BINS, SHOWN = 45, (0.001, 0.999)
TRUE = "#009E73"
METHODS = {"chained": ("#0072B2", "o", "-"), "boxes": ("#D55E00", "s", "--")}
SYNTHETIC = "synthetic data"


def figures(
    section: bp.PoincareSection, found: estimates.Identified, ridge: estimates.Ridge, table: Mapping[str, Any]
) -> dict[str, Figure]:
    """Return every figure of a run."""
    drawn = {
        "section": bp.plot.section(section, found.polished, units=UNITS),
        "orbits": bp.plot.orbits(found.selected, units=UNITS),
        "corner": bp.plot.corner(ridge.posterior, laplace=ridge.fit, names=estimates.NATURAL),
        "ridge": marginals(ridge, truth=section.synthetic),
    }
    if section.synthetic:
        drawn["section"].suptitle(SYNTHETIC, fontsize="medium")
        drawn["orbits"].suptitle(SYNTHETIC, x=0.99, ha="right", fontsize="medium")
    if table:
        drawn["eigenvalues"] = eigenvalues(table)
    return drawn


def marginals(ridge: estimates.Ridge, *, truth: bool) -> Figure:
    """Draw Laplace and MCMC of the parameters above, and of the combinations that the data determine below."""
    figure = plt.figure(figsize=(11.0, 5.4), layout="constrained")
    grid = figure.subplots(2, 5)
    for axes, name in zip(grid[0], estimates.NATURAL, strict=True):
        unit = bp.models.pendulum.units[name]
        _marginal(axes, ridge.posterior.draws(name), ridge.fit.theta[name], ridge.fit.sd[name], TRUTH[name], truth)
        axes.set_xlabel(f"{name} [{unit}]")
    draws = estimates.combinations({name: ridge.posterior.draws(name) for name in estimates.NATURAL})
    truths = estimates.combinations(TRUTH)
    for axes, name in zip(grid[1], estimates.DETERMINED, strict=False):
        value, sd = (float(ridge.combinations[column].loc[name]) for column in ("value", "laplace_sd"))
        _marginal(axes, draws[name], value, sd, truths[name], truth)
        text = name if name == "l" else f"{name} = k{name[1]}/(m l²)"
        axes.set_xlabel(f"{text} [{estimates.DETERMINED_UNITS[name]}]")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    grid[1, 4].set_axis_off()
    grid[1, 4].legend(handles, labels, loc="center", frameon=False)
    for row, text in zip(grid, ("parameters", "what the data determine"), strict=True):
        row[0].set_ylabel(f"{text}:\ndensity")
    notes = ["synthetic data"] * truth + ["NOT CONVERGED"] * (not ridge.posterior.converged)
    figure.suptitle(", ".join(["All five free, from unstable orbits alone", *notes]))
    return figure


def _marginal(axes: Axes, draws: np.ndarray, mean: float, sd: float, true: float, has_truth: bool) -> None:
    density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
    axes.stairs(density, edges, fill=True, color=bp.plot.COLOURS["mcmc"], label="MCMC")
    if np.isfinite(sd):
        x = np.linspace(min(edges[0], mean - 3 * sd), max(edges[-1], mean + 3 * sd), 300)
        normal = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes.plot(x, normal, color=bp.plot.COLOURS["laplace"], ls="--", lw=1.6, label="Laplace")
    if has_truth:
        axes.axvline(true, color=TRUE, lw=1.6, label="truth")
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=3)
    axes.ticklabel_format(axis="x", scilimits=(-3, 4))


def eigenvalues(table: Mapping[str, Any]) -> Figure:
    """Draw the median error of the unstable eigenvalue over the period, by noise and method, and the orbits found."""
    figure = plt.figure(figsize=(3.4 * len(table) + 0.8, 5.6), layout="constrained")
    above, below = figure.subplots(2, len(table), sharex=True, sharey="row", squeeze=False)
    for top, bottom, (noise, methods) in zip(above, below, table.items(), strict=True):
        for shift, (method, (colour, marker, style)) in zip((-0.2, 0.2), METHODS.items(), strict=True):
            rows = [row for row in methods[method] if row["candidates"] or row["orbits"]]
            matched = [row for row in rows if row["median_relative_error"] is not None]
            errors = [100 * row["median_relative_error"] for row in matched]
            top.semilogy([row["period"] for row in matched], errors, style, marker=marker, color=colour, label=method)
            periods = np.array([row["period"] for row in rows]) + shift
            bottom.bar(periods, [r["candidates"] for r in rows], 0.36, color="white", edgecolor=colour, hatch="///")
            bottom.bar(periods, [r["orbits"] for r in rows], 0.36, color=colour)
        top.set_title(f"noise {float(noise):.1%} of the attractor")
        bottom.set_xlabel("period [forcing periods]")
    above[0].set_ylabel("median error of the\nunstable eigenvalue [%]")
    below[0].set_ylabel("candidates found [1]\n(filled: true orbits)")
    above[-1].legend(frameon=False)
    figure.suptitle(f"Local fits, chained, and the paper's boxes ({SYNTHETIC})")
    return figure


def errors(lines: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the errors of m, l and k3 over noise seeds, beside the paper's."""
    noises = sorted({line["noise"] for line in lines})
    figure = plt.figure(figsize=(7.6, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for number, noise in enumerate(noises):
        for place, name in enumerate(estimates.PAPER_ERRORS):
            values = [100 * abs(x["errors"][name]) for x in lines if x["noise"] == noise and name in x["errors"]]
            box = axes.boxplot([values], positions=[place + 0.28 * (number - 0.5 * (len(noises) - 1))], widths=0.2,
                               whis=(5, 95), patch_artist=True, manage_ticks=False, medianprops={"color": "black"},
                               flierprops={"ms": 4})  # fmt: skip
            box["boxes"][0].set(facecolor=("#56B4E9", "#E69F00")[number % 2], hatch=("", "///")[number % 2])
            if place == 0:
                box["boxes"][0].set_label(f"noise {noise:.1%} of the attractor")
    for place, error in enumerate(estimates.PAPER_ERRORS.values()):
        label = "the paper's table 1" if place == 0 else None
        axes.plot([place - 0.4, place + 0.4], [100 * error] * 2, color="black", lw=2.0, label=label)
    axes.set_yscale("log")
    axes.set_xticks(range(len(estimates.PAPER_ERRORS)), [f"{name}" for name in estimates.PAPER_ERRORS])
    axes.set_xlabel("parameter")
    axes.set_ylabel("error [%]")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    seeds = len(lines) // len(noises)
    figure.suptitle(f"Errors over {seeds} recordings, boxes: quartiles, whiskers: 90 % ({SYNTHETIC})")
    return figure
