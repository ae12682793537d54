"""Figures of the flutter study."""

from collections.abc import Mapping

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies.common import shared_legend
from studies.flutter.questions import CHANNELS, closed, contraction, drawn_sizes, laplace_draws, sizes
from studies.flutter.rig import AUTHORS, RIG, SENSORS, Experiments, Fitted, Speeds, cycles

MEASURED, MODEL, THEIRS = "black", {True: "#0072B2", False: "#D55E00"}, "#999999"
KIND = {True: "stable", False: "unstable"}
GRID, COARSE = np.linspace(13.0, 19.0, 241), np.linspace(13.0, 19.0, 41)


def all_of(
    experiments: Experiments, speeds: Speeds, fits: Mapping[str, Fitted], fit: bp.MapEstimate,
    posterior: bp.Posterior | None, draws: int,
) -> dict[str, Figure]:  # fmt: skip
    """Return every figure by its name; without a posterior the bands are Laplace's, and there is no corner plot."""
    if posterior is None:
        chosen = laplace_draws(fit, draws)
    else:
        every = {name: posterior.draws(name).ravel() for name in fit.theta}
        chosen = {name: v[np.linspace(0, v.size - 1, draws).astype(int)] for name, v in every.items()}
    figures = {
        "bifurcation": bifurcation(experiments, speeds, fit, chosen),
        "portraits": portraits(experiments, speeds, fit),
        "contraction": contractions(fits, _kind(experiments)),
    }
    return figures if posterior is None else figures | {"corner": bp.plot.corner(posterior, laplace=fit)}


def amplitudes(values: Mapping[str, float]) -> dict[tuple[str, bool], np.ndarray]:
    """Return the amplitude of each channel over the grid of wind speeds, by branch; NaN where there is no cycle."""
    found = {(channel, kind): np.full(GRID.size, np.nan) for channel in CHANNELS for kind in KIND}
    try:
        branches = cycles(values).branches
    except ValueError:
        return found
    orbits = [orbit for along in branches for orbit in along]
    for kind in KIND:
        own = sorted((o for o in orbits if o.stable == kind), key=lambda orbit: orbit.parameters["U"])
        if len(own) > 1:
            speed = [orbit.parameters["U"] for orbit in own]
            for channel in CHANNELS:
                size = [sizes(orbit.outputs)[channel] for orbit in own]
                found[channel, kind] = np.interp(GRID, speed, size, left=np.nan, right=np.nan)
    return found


def bands(theta: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> dict[tuple[str, bool], np.ndarray]:
    """Return wind speeds and the 5 and 95 % quantiles of the draws' amplitudes (3, speeds), by channel and branch.

    Where fewer than half of the draws have the cycle, or θ itself has none, there is no band.
    """
    along = cycles(RIG | dict(theta))
    found: dict[tuple[str, bool], list[tuple[float, float, float]]] = {(c, k): [] for c in CHANNELS for k in KIND}
    for speed in COARSE:
        for kind in KIND:
            try:
                orbit = along.at(KIND[kind], speed)
            except ValueError:
                continue
            for channel, size in drawn_sizes(orbit, theta, draws).items():
                if np.mean(np.isfinite(size)) > 0.5:
                    found[channel, kind].append((speed, *np.nanquantile(size, [0.05, 0.95])))
    return {key: np.array(rows).reshape(-1, 3).T for key, rows in found.items()}


def bifurcation(
    experiments: Experiments, speeds: Speeds, fit: bp.MapEstimate, draws: Mapping[str, np.ndarray]
) -> Figure:
    """Draw amplitudes over wind speed: posterior bands of both branches, the authors' values, measurements."""
    drawn = bands(fit.theta, draws)
    best, theirs = amplitudes(RIG | fit.theta), amplitudes(RIG | AUTHORS | SENSORS)
    figure = plt.figure(figsize=(9.0, 8.0), layout="constrained")
    for axes, channel in zip(figure.subplots(2, 1, sharex=True), CHANNELS, strict=True):
        for kind in (True, False):
            colour, style = MODEL[kind], "-" if kind else "--"
            at, low, high = drawn[channel, kind]
            axes.fill_between(at, low, high, color=colour, alpha=0.25, lw=0, label=f"{KIND[kind]}, 90 % of draws")
            axes.plot(GRID, best[channel, kind], color=colour, ls=style, label=f"{KIND[kind]}, MAP")
            label = "authors' values" if kind else None
            axes.plot(GRID, theirs[channel, kind], color=THEIRS, lw=1.0, ls=style, label=label)
        for kind in (True, False):
            names = [name for name in experiments if name.startswith("unstable") != kind]
            axes.errorbar(
                [speeds[name] for name in names],
                [sizes(experiments[name].outputs)[channel] for name in names],
                [2.0 * experiments[name].scatter[channel] for name in names],
                fmt="o" if kind else "s", color=MEASURED, mfc=MODEL[kind], ms=6, capsize=3,
                label=f"{KIND[kind]}, measured ± 2 sd of one cycle",
            )  # fmt: skip
        axes.set_ylabel(f"amplitude of {channel} [sensor units]")
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel("wind speed [m/s]")
    shared_legend(figure, 3, fontsize=9)
    figure.suptitle(f"Flutter rig{_kind(experiments)}: limit cycles")
    return figure


def portraits(experiments: Experiments, speeds: Speeds, fit: bp.MapEstimate) -> Figure:
    """Draw pitch over heave, measured and fitted, a panel per cycle."""
    figure = plt.figure(figsize=(11.0, 6.0), layout="constrained")
    for axes, (name, e) in zip(figure.subplots(2, 4, sharex=True, sharey=True).flat, experiments.items(), strict=False):
        orbit = fit.solutions[name]
        kind = not name.startswith("unstable")
        for values, colour, label in ((e.outputs, MEASURED, "measured"), (orbit.outputs, MODEL[kind], "fitted")):
            axes.plot(*(closed(values[c]) for c in CHANNELS), color=colour, lw=1.4, label=f"{label}, {KIND[kind]}")
        axes.set_title(f"{speeds[name]:g} m/s, {KIND[kind]}", fontsize=10)
        axes.legend(frameon=False, fontsize=7, loc="lower right")
    for axes in figure.axes[4:]:
        axes.set_xlabel("heave [sensor units]")
    for axes in figure.axes[::4]:
        axes.set_ylabel("pitch [sensor units]")
    figure.suptitle(f"Flutter rig{_kind(experiments)}: measured and fitted cycles")
    return figure


def contractions(fits: Mapping[str, Fitted], kind_of_data: str) -> Figure:
    """Draw posterior sd over prior sd of each parameter, from the stable cycles, the unstable ones, and both."""
    table = contraction(fits)
    names = list(table)
    figure = plt.figure(figsize=(8.0, 5.5), layout="constrained")
    axes = figure.subplots()
    for number, (kind, colour) in enumerate(zip(fits, (MODEL[True], MODEL[False], MEASURED), strict=True)):
        at = np.arange(len(names)) + 0.26 * (number - 1)
        axes.barh(at, [table[name][kind]["over_prior"] for name in names], 0.24, color=colour, label=f"{kind} cycles")
    axes.axvline(1.0, color=THEIRS, lw=1.0, ls="--", label="prior")
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("Laplace sd over the prior's sd [1]")
    shared_legend(figure, 4)
    figure.suptitle(f"Flutter rig{kind_of_data}: information on each parameter")
    return figure


def _kind(experiments: Experiments) -> str:
    return ", synthetic data" if any(e.synthetic for e in experiments.values()) else ""
