"""Figures of the landing gear study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies.common import shared_legend
from studies.landing_gear.drop import SHORT, Dropped
from studies.landing_gear.identification import CONDUCTION, NEGATIVE, POSITIVE, UNDETERMINED, Identified, Verdict
from studies.landing_gear.quality import FALSE_ALARM, LIMIT, MEANINGS, Unit, deviations
from studies.landing_gear.rig import GEAR, RUNS, Run

CHANNELS = {
    "displacement": (1e3, "displacement [mm]"), "force": (1e-3, "force [kN]"), "pressure": (1e-6, "pressure [MPa]"),
}  # fmt: skip
TITLE = "SYNTHETIC data"
NORMAL_90 = 1.6448536269514722
SIGNS = {POSITIVE: ("#009E73", "o"), UNDETERMINED: ("#999999", "D"), NEGATIVE: ("#CC79A7", "v")}
# The scale of theta16 is linear up to here, logarithmic beyond [W/K].
LINEAR_TO, TICKS = 3.0, (-100, -50, -20, -10, -5, -3, -2, -1, 0, 1, 2, 3, 5, 10, 20)
STYLES: dict[str, dict[str, Any]] = {
    "eq. (9)": {"color": "#0072B2", "lw": 3.0}, "pressure line": {"color": "#E69F00", "ls": "--"},
    "lost motion": {"color": "#CC79A7"}, "all four": {"color": "#009E73"},
}  # fmt: skip
TRUTH_NAMES = {"A": "truth A: eq. (9) holds", "B": "truth B: lost motion, line lag, convection, friction heat"}


def _columns(truths: Mapping[str, Any], height: float, last: str, **options: Any) -> tuple[Figure, np.ndarray]:
    """Return a figure with a column per truth: displacement, force, pressure, and a last row."""
    figure = plt.figure(figsize=(5.0 * len(truths) + 1.0, height), layout="constrained")
    grid = figure.subplots(4, len(truths), squeeze=False, sharey="row", **options)
    for axes, truth in zip(grid[0], truths, strict=True):
        axes.set_title(TRUTH_NAMES[truth], fontsize=10)
    for axes, label in zip(grid[:, 0], (*(label for _, label in CHANNELS.values()), last), strict=True):
        axes.set_ylabel(label)
    return figure, grid


def histories(shown: Mapping[str, tuple[bp.Recording, Identified]]) -> Figure:
    """Draw recorded and fitted displacement, force and pressure of one experiment, one column per truth."""
    figure, grid = _columns(shown, 8.5, "residual force [N]", sharex=True)
    for column, (recording, identified) in zip(grid.T, shown.values(), strict=True):
        (experiment,), fit = identified.problem.experiments, identified.fit
        residuals = fit.residuals[experiment.name]
        until = 2.0 / experiment.frequency
        kept = recording.time <= until
        time = np.arange(2 * experiment.samples) / (experiment.samples * experiment.frequency)
        signals = {**recording.inputs, **recording.outputs}
        for axes, (channel, (scale, _)) in zip(column, CHANNELS.items(), strict=False):
            colours, recorded = bp.plot.COLOURS, scale * signals[channel][kept]
            axes.plot(recording.time[kept], recorded, ".", ms=2, color=colours["measured"], label="recorded")
            if channel in residuals:
                fitted = experiment.outputs[channel] - residuals[channel]
                axes.plot(time, scale * np.tile(fitted, 2), color=bp.plot.COLOURS["map"], lw=1.4, label="MAP")
        column[3].plot(time, np.tile(residuals["force"], 2), color=bp.plot.COLOURS["map"], lw=1.0)
        column[3].axhline(0.0, color="black", lw=0.6)
        column[3].set_xlabel("time [s]")
    shared_legend(figure, 2)
    name = next(iter(shown.values()))[0].name.replace(" Hz ", " Hz, ±")
    figure.suptitle(f"Landing gear at {name}, {TITLE}")
    return figure


def conductions(runs: Sequence[Run], verdicts: Mapping[str, Mapping[str, Verdict]], drive: str) -> Figure:
    """Draw theta16 by experiment: 90 % intervals of draws and of the Laplace approximation, and the sign verdict."""
    figure = plt.figure(figsize=(11.0, 4.2 * len(verdicts) + 1.0), layout="constrained")
    grid = figure.subplots(len(verdicts), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (truth, by_run) in zip(grid, verdicts.items(), strict=True):
        judged = [by_run[run.name] for run in runs]
        at = np.arange(len(judged))
        low, high = np.array([np.quantile(v.identified.posterior.draws(CONDUCTION), [0.05, 0.95]) for v in judged]).T
        laplace = np.array([v.identified.fit.interval(0.9)[CONDUCTION] for v in judged]).T
        axes.vlines(at - 0.1, low, high, color=bp.plot.COLOURS["mcmc"], lw=5, label="draws, 90 %")
        axes.vlines(at + 0.1, *laplace, color=bp.plot.COLOURS["laplace"], lw=2, label="Laplace, 90 %")
        axes.axhline(GEAR[CONDUCTION], color="black", lw=0.9, ls="--", label="true value 2 W/K")
        axes.axhline(0.0, color="black", lw=0.6)
        for sign, (colour, marker) in SIGNS.items():
            axes.plot([], [], marker, color=colour, label=f"sign: {sign}")
            for i in (i for i, v in enumerate(judged) if v.sign == sign):
                face = "white" if judged[i].misspecified else colour
                value = judged[i].identified.fit.theta[CONDUCTION]
                axes.plot(i, value, marker, color=colour, mfc=face, ms=8, mew=1.8, zorder=5)
        axes.set_yscale("symlog", linthresh=LINEAR_TO, linscale=1.5)
        axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axes.minorticks_off()
        ends = np.concatenate([low, high, *laplace, [-0.5, GEAR[CONDUCTION] + 0.5]])
        axes.set_ylim(1.2 * ends.min(), 1.2 * ends.max())
        axes.set_ylabel("theta16 [W/K]")
        axes.set_xlim(-0.6, len(judged) - 0.4)
        axes.set_title(TRUTH_NAMES[truth], fontsize=11)
    names = [f"{run.frequency:g} Hz\n±{1e3 * run.stroke:g} mm" for run in runs]
    grid[-1].set_xticks(range(len(runs)), names, fontsize=9)
    shared_legend(figure, 4, fontsize=9)
    figure.suptitle(
        f"Heat conduction theta16 by experiment, {drive} given, SYNTHETIC data\n"
        "(filled: model adequate, open: misspecified)"
    )
    return figure


def drops(dropped: Mapping[str, Dropped]) -> Figure:
    """Draw the drop test, a column per truth: the first 2.5 s, and by how much the displacement is off over 30 s."""
    figure, grid = _columns(dropped, 9.0, "displacement minus\npredicted median [mm]")
    for column, found in zip(grid.T, dropped.values(), strict=True):
        time, band, colours = found.true.time, found.band, bp.plot.COLOURS
        early = time <= SHORT
        for axes, (channel, (scale, _)) in zip(column, CHANNELS.items(), strict=False):
            true, low, median, high = (
                scale * signals[channel][early] for signals in (found.true.outputs, band.low, band.median, band.high)
            )
            axes.plot(time[early], true, color=colours["measured"], lw=2.6, label="true")
            axes.plot(time[early], median, "--", color=colours["mcmc"], lw=1.4, label="posterior median")
            axes.fill_between(time[early], low, high, color=colours["mcmc"], alpha=0.3, lw=0, label="90 % band")
            axes.tick_params(labelbottom=channel == "pressure")
        column[2].set_xlabel("time [s]")
        median = band.median["displacement"]
        low, high = 1e3 * (band.low["displacement"] - median), 1e3 * (band.high["displacement"] - median)
        column[3].fill_between(time, low, high, color=colours["mcmc"], alpha=0.3, lw=0)
        column[3].plot(time, 1e3 * (found.true.outputs["displacement"] - median), color=colours["measured"], lw=1.2)
        column[3].axhline(0.0, color=colours["mcmc"], ls="--", lw=1.0)
        column[3].set_xlabel("time [s], until the gas has cooled")
    shared_legend(figure, 3)
    figure.suptitle(f"Drop test, predicted from the shaker's experiments, {TITLE}")
    return figure


def quality(reference: Unit, units: Sequence[Unit]) -> Figure:
    """Draw the quality-control chart: every unit's deviation from the reference, a row per parameter."""
    figure, grid = plt.subplots(len(MEANINGS), 1, figsize=(9.0, 9.5), sharex=True, layout="constrained")
    number = np.arange(1, len(units) + 1)
    every = [deviations(reference, unit) for unit in units]
    for axes, (name, meaning) in zip(grid, MEANINGS.items(), strict=True):
        z = np.array([deviation[name] for deviation in every])
        out = np.abs(z) > LIMIT
        axes.axhspan(-LIMIT, LIMIT, color="#DDDDDD", lw=0)
        axes.plot(number[~out], z[~out], "o", ms=3, color=bp.plot.COLOURS["map"], label='"same"')
        axes.plot(number[out], z[out], "^", ms=4, color=bp.plot.COLOURS["laplace"], label='"different"')
        axes.set_yscale("symlog", linthresh=10.0, linscale=2.0)
        axes.set_yticks([-1000, -100, -10, -5, 0, 5, 10, 100, 1000])
        axes.set_yticklabels(["−1000", "−100", "−10", "−5", "0", "5", "10", "100", "1000"], fontsize=8)
        axes.set_ylim(-2.0 * max(10.0, np.abs(z).max()), 2.0 * max(10.0, np.abs(z).max()))
        axes.minorticks_off()
        axes.set_ylabel(f"{meaning}\n{name}", fontsize=9)
    for k, kind in enumerate(dict.fromkeys(unit.kind for unit in units)):
        members = np.flatnonzero([unit.kind == kind for unit in units])
        grid[0].text(
            number[members].mean(), 1.04, kind, ha="center", va="bottom", transform=grid[0].get_xaxis_transform()
        )
        for axes in grid if k else ():
            axes.axvline(number[members[0]] - 0.5, color="black", lw=0.6)
    grid[-1].set_xlabel("unit")
    shared_legend(figure, 2)
    figure.suptitle(
        "Deviation from the reference gear, in common standard deviations [1], SYNTHETIC data\n"
        f"(grey: ±{LIMIT:.2f}, a false alarm in {FALSE_ALARM:.0%} of good units)"
    )
    return figure


def repaired(found: Mapping[str, Any]) -> Figure:
    """Draw theta16 by experiment under eq. (9) and the best model, and the prediction errors of all models."""
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(10.0, 8.5), sharex=True, layout="constrained")
    runs = list(next(iter(found["models"].values()))["scores"])
    order = [run.name for run in RUNS if run.name in runs]
    place = np.arange(len(order))
    for k, (model, one) in enumerate(found["theta16"].items()):
        values = np.array([one["estimates"][f"{CONDUCTION}[{name}]"] for name in order])
        top.errorbar(
            place + 0.12 * (2 * k - 1), values[:, 0], NORMAL_90 * values[:, 1], fmt="o", ms=4, capsize=2,
            color=STYLES[model]["color"], label=model,
        )  # fmt: skip
    top.axhline(GEAR[CONDUCTION], color="black", lw=0.8, ls=":", label="truth")
    top.axhline(0.0, color="black", lw=0.8)
    top.set_yscale("symlog", linthresh=LINEAR_TO, linscale=1.5)
    top.set_yticks(
        [t for t in TICKS if abs(t) != 1], [f"{t:g}".replace("-", "−") for t in TICKS if abs(t) != 1], fontsize=8
    )
    top.minorticks_off()
    top.set_ylabel("theta16 [W/K], 90 % interval")
    top.legend(frameon=False)
    for model, one in found["models"].items():
        errors = [one["errors_held_out"][name]["force"] for name in order]
        bottom.plot(place, errors, "o", ms=4, **{"lw": 1.0, "ls": "-"} | STYLES[model], label=model)
    bottom.axhline(found["noise_of_the_mean"]["force"], color="black", lw=0.8, ls=":", label="noise of the mean period")
    bottom.set_yscale("log")
    bottom.set_ylabel("rms error of the force [N]\nin experiments held out")
    bottom.set_xticks(place, [name.replace(" Hz ", " Hz\n±") for name in order], fontsize=8)
    bottom.legend(frameon=False, ncols=2)
    figure.suptitle("Extended models of truth B, SYNTHETIC data")
    return figure


def loops(identified: Mapping[str, Sequence[Identified]]) -> Figure:
    """Draw friction loops of some experiments and their residuals, a row per truth, the displacement being given."""
    most = max(map(len, identified.values()))
    figure = plt.figure(figsize=(7.0 * most, 5.0 * len(identified) + 0.4), layout="constrained")
    parts = figure.subfigures(len(identified), most, squeeze=False)
    for row, (truth, several) in zip(parts, identified.items(), strict=True):
        for part, one in zip(row, several, strict=True):
            above, below = part.subfigures(2, 1, height_ratios=(1.8, 1.0))
            bp.plot.loops(one.problem, one.fit, output="force", figure=above)
            experiment, axes = one.problem.experiments[0], below.subplots()
            residual = one.fit.residuals[experiment.name]["force"]
            axes.plot(experiment.inputs["displacement"], residual, color=bp.plot.COLOURS["map"], lw=0.9)
            axes.set(xlabel="displacement [m]", ylabel="residual force [N]")
            above.suptitle(f"{TRUTH_NAMES[truth]}\n{experiment.name.replace(' Hz ', ' Hz, ±')}", fontsize=9)
    figure.suptitle(f"Friction loops of the landing gear, displacement given, {TITLE}")
    return figure
