"""Figures of the landing gear study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies.common import shared_legend, titled
from studies.landing_gear.drop import SHORT, Dropped
from studies.landing_gear.identification import (
    CONDUCTION,
    NEGATIVE,
    POSITIVE,
    PRIORS,
    UNDETERMINED,
    Identified,
    Verdict,
)
from studies.landing_gear.quality import LARGEST_DEVIATE, MEANINGS
from studies.landing_gear.rig import GEAR, RUNS, Run

CHANNELS = {
    "displacement": (1e3, "displacement [mm]"), "force": (1e-3, "force [kN]"), "pressure": (1e-6, "pressure [MPa]"),
}  # fmt: skip
# Factors of the errors in the drop test, the first time shown there [s], and the number of times.
ERRORS, EARLIEST = {"displacement": (1e3, "mm"), "force": (1.0, "N"), "pressure": (1e-3, "kPa")}, 0.05
DROP_POINTS = 700
TITLE = "SYNTHETIC data"
NORMAL_90 = 1.6448536269514722
SIGNS = {POSITIVE: ("#009E73", "o"), UNDETERMINED: ("#999999", "D"), NEGATIVE: ("#CC79A7", "v")}
# The scale of theta16 is linear up to here, logarithmic beyond [W/K].
LINEAR_TO, TICKS = 3.0, (-100, -50, -20, -10, -5, -3, -2, -1, 0, 1, 2, 3, 5, 10, 20)
STYLES: dict[str, dict[str, Any]] = {
    "eq. (9)": {"color": "#0072B2", "lw": 3.0}, "pressure line": {"color": "#E69F00", "ls": "--"},
    "lost motion": {"color": "#CC79A7", "ls": "-."}, "all four": {"color": "#009E73"},
}  # fmt: skip
TRUTH_NAMES = {"A": "truth A: eq. (9) holds", "B": "truth B: lost motion, line lag, convection, friction heat"}


def _columns(truths: Mapping[str, Any], labels: Sequence[str]) -> tuple[Figure, np.ndarray]:
    """Return a figure with a column per truth, a row per ordinate, and the time across."""
    figure = plt.figure(figsize=(5.0 * len(truths) + 1.0, 8.5), layout="constrained")
    grid = figure.subplots(len(labels), len(truths), squeeze=False, sharex=True, sharey="row")
    for axes, truth in zip(grid[0], truths, strict=True):
        axes.set_title(TRUTH_NAMES[truth], fontsize=10)
    for axes, label in zip(grid[:, 0], labels, strict=True):
        axes.set_ylabel(label)
    figure.align_ylabels()
    return figure, grid


def histories(shown: Mapping[str, tuple[bp.Recording, Identified]]) -> Figure:
    """Draw recorded and fitted displacement, force and pressure of one experiment, one column per truth."""
    figure, grid = _columns(shown, [*(label for _, label in CHANNELS.values()), "residual force [N]"])
    for column, (recording, identified) in zip(grid.T, shown.values(), strict=True):
        (experiment,), fit = identified.problem.experiments, identified.fit
        residuals = fit.residuals[experiment.name]
        until = 2.0 / experiment.frequency
        kept = recording.time <= until
        time = np.arange(2 * experiment.samples) / (experiment.samples * experiment.frequency)
        signals = {**recording.inputs, **recording.outputs}
        for axes, (channel, (scale, _)) in zip(column, CHANNELS.items(), strict=False):
            colours, recorded = bp.plot.COLOURS, scale * signals[channel][kept]
            dots: dict[str, Any] = {"ms": 2, "color": colours["measured"], "label": "recorded", "rasterized": True}
            axes.plot(recording.time[kept], recorded, ".", **dots)
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
        laplace = np.array([v.identified.fit.interval(0.9, robust=False)[CONDUCTION] for v in judged]).T
        axes.vlines(at - 0.1, low, high, color=bp.plot.COLOURS["mcmc"], lw=5, label="draws, 90 %")
        axes.vlines(at + 0.1, *laplace, color=bp.plot.COLOURS["laplace"], lw=2, label="Laplace, 90 %")
        axes.axhline(GEAR[CONDUCTION], color="black", lw=0.9, ls="--", label="true value 2 W/K")
        axes.axhline(0.0, color="black", lw=1.4)
        axes.axhspan(-1e9, 0.0, color="0.93", lw=0, zorder=0, label="wrong sign")
        for sign, (colour, marker) in SIGNS.items():
            axes.plot([], [], marker, color=colour, label=f"sign: {sign}")
            for i in (i for i, v in enumerate(judged) if v.sign == sign):
                face = "white" if judged[i].misspecified else colour
                value = judged[i].identified.fit.theta[CONDUCTION]
                axes.plot(i, value, marker, color=colour, mfc=face, ms=8, mew=1.8, zorder=5)
        axes.set_yscale("symlog", linthresh=LINEAR_TO, linscale=1.5)
        axes.set_yticks(TICKS, [f"{tick:g}".replace("-", "−") for tick in TICKS])
        axes.minorticks_off()
        ends = np.concatenate([low, high, *laplace, [-0.5, GEAR[CONDUCTION] + 0.5]])
        axes.set_ylim(1.2 * ends.min(), 1.2 * ends.max())
        axes.set_ylabel("theta16 [W/K]")
        axes.set_xlim(-0.6, len(judged) - 0.4)
        counts = ", ".join(f"{sign} in {sum(v.sign == sign for v in judged)}" for sign in SIGNS)
        axes.set_title(f"{TRUTH_NAMES[truth]}\nsign found: {counts} of {len(judged)} experiments", fontsize=10)
    names = [f"{run.frequency:g} Hz\n±{1e3 * run.stroke:g} mm" for run in runs]
    grid[-1].set_xticks(range(len(runs)), names, fontsize=9)
    shared_legend(figure, 4, fontsize=9)
    figure.suptitle(
        f"Do the data determine the sign of the heat conduction theta16? {drive.capitalize()} given, {TITLE}\n"
        "(filled: model adequate, open: misspecified)"
    )
    return figure


def drops(dropped: Mapping[str, Dropped]) -> Figure:
    """Draw the drop test, a column per truth: the displacement, and the errors of all outputs with the 90 % band."""
    errors = [f"{channel}\nerror [{unit}]" for channel, (_, unit) in ERRORS.items()]
    figure, grid = _columns(dropped, ["displacement [mm]", *errors])
    colours = bp.plot.COLOURS
    for column, found in zip(grid.T, dropped.values(), strict=True):
        time, true, band = found.true.time, found.true.outputs, found.band
        early, last = time <= SHORT, time.size - 1
        at = np.unique(np.geomspace(np.searchsorted(time, EARLIEST), last, DROP_POINTS).astype(int))
        time = time[at]
        displacement = [1e3 * signals["displacement"][at] for signals in (true, band.median)]
        column[0].plot(time, displacement[0], color=colours["measured"], lw=2.6, label="true")
        column[0].plot(time, displacement[1], "--", color=colours["mcmc"], lw=1.4, label="posterior median")
        for axes, (channel, (scale, _)) in zip(column[1:], ERRORS.items(), strict=True):
            low, off, high = (
                scale * (signals[channel] - band.median[channel])[at] for signals in (band.low, true, band.high)
            )
            axes.fill_between(time, low, high, color=colours["mcmc"], alpha=0.4, lw=0, label="90 % band")
            axes.axhline(0.0, color=colours["mcmc"], ls="--", lw=1.4)
            axes.plot(time, off, color=colours["measured"], lw=1.2)
            inside = (true[channel] >= band.low[channel]) & (true[channel] <= band.high[channel])
            shares = f"{100 * inside[early].mean():.0f} % of the first {SHORT:g} s, {100 * inside[~early].mean():.0f} %"
            axes.set_title(f"within the band: {shares} later", fontsize=9, loc="right")
        column[1].set_title("true − median", fontsize=9, loc="left")
        column[-1].set(xscale="log", xlim=(time[0], time[-1]), xlabel="time after the release [s]")
        column[-1].set_xticks([0.1, 0.3, 1, 3, 10, 30], ["0.1", "0.3", "1", "3", "10", "30"])
    shared_legend(figure, 3)
    figure.suptitle(
        f"Drop test predicted from periodic motions, {TITLE}\n"
        "The band includes the uncertainty of the parameters, but not the errors of the model",
        fontsize=11,
    )
    return figure


def corner(verdict: Verdict, truth: str) -> Figure:
    """Draw the posterior of one experiment; the title says what it tells of the sign of theta16."""
    one = verdict.identified
    truths = {name: GEAR[name] for name in PRIORS}
    figure = bp.plot.corner(one.posterior, laplace=one.fit, problem=one.problem, names=[*PRIORS], truths=truths)
    name, model = one.problem.experiments[0].name.replace(" Hz ", " Hz, ±"), TRUTH_NAMES[truth].partition(":")[0]
    adequate = "model misspecified" if verdict.misspecified else "model adequate"
    return titled(figure, f"{name}, {model}: sign of theta16 {verdict.sign}, {adequate}")


def quality(found: Mapping[str, Any]) -> Figure:
    """Draw the quality-control chart: every gear's deviation by its p-value, a row per parameter."""
    shape: dict[str, Any] = {"figsize": (9.0, 9.5), "sharex": True, "squeeze": False, "layout": "constrained"}
    figure, grid = plt.subplots(len(MEANINGS), 1, **shape)
    limit, kinds = found["limit"], found["kinds"].values()
    counts = [one["units"] for one in kinds]
    number, ends = np.arange(1, sum(counts) + 1), np.cumsum([0, *counts])
    for axes, (name, meaning) in zip(grid[:, 0], MEANINGS.items(), strict=True):
        z = np.concatenate([one["deviates"][name] for one in kinds])
        out, most = np.abs(z) > limit, 1.2 * max(5.0, np.abs(z).max())
        axes.axhspan(-limit, limit, color="#DDDDDD", lw=0)
        axes.plot(number[~out], z[~out], "o", ms=4, color=bp.plot.COLOURS["map"], label='"same"')
        axes.plot(number[out], z[out], "^", ms=5, color=bp.plot.COLOURS["laplace"], label='"different"')
        axes.set_ylim(-most, most)
        axes.set_ylabel(f"{meaning}\n{name}", fontsize=9)
        for end in ends[1:-1]:
            axes.axvline(end + 0.5, color="black", lw=0.6)
    for kind, start, end in zip(found["kinds"], ends[:-1], ends[1:], strict=True):
        words, middle = kind.replace(" ", "\n", 1), 0.5 * (start + end + 1)
        grid[0, 0].text(middle, 1.04, words, ha="center", va="bottom", transform=grid[0, 0].get_xaxis_transform())
    grid[-1, 0].set(xlabel="gear", xlim=(0.0, number[-1] + 1.0))
    shared_legend(figure, 2)
    figure.suptitle(
        "Deviation from the population of good gears, as the normal deviate with the same p-value, SYNTHETIC data\n"
        f"(grey: ±{limit:.2f}; false alarms in at most {found['false_alarm_rate']:.0%} of good gears; at "
        f"±{LARGEST_DEVIATE:g} whatever is larger)",
        fontsize="medium",
    )
    return figure


def over_amplitude(populations: Mapping[str, bp.Population]) -> Figure:
    """Draw theta16 by amplitude with the population over the experiments, one column per truth."""
    figure = plt.figure(figsize=(5.5 * len(populations), 5.0), layout="constrained")
    for part, (truth, found) in zip(
        figure.subfigures(1, len(populations), squeeze=False)[0], populations.items(), strict=True
    ):
        bp.plot.population(found, covariate="amplitude", figure=part)
        part.axes[0].set_xlabel("amplitude [m]")
        part.axes[0].axhline(0.0, color="black", lw=0.6)
        part.suptitle(TRUTH_NAMES[truth], fontsize="medium")
    figure.suptitle(f"Heat conduction by experiment, {TITLE}")
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
