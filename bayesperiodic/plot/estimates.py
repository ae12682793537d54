"""Figures of estimates: fitted periods, loops, and traces of the draws."""

import functools
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.predictive import Prediction
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot.style import (
    COLOURS,
    ENSEMBLES,
    OF_TABLES,
    axis_label,
    caveats_of,
    chosen,
    curve_id,
    draws_label,
    styled,
)
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.sampling.draws import Posterior

MEASURED_STYLE: dict[str, Any] = {"color": COLOURS["measured"], "marker": "o"}
FITTED_STYLE: dict[str, Any] = {"color": COLOURS["map"], "ls": "--", "marker": "x"}
PREDICTION_STYLE: dict[str, Any] = {"color": COLOURS["mcmc"], "alpha": 0.45}
# Standard deviations of a normal distribution within which 90 % are.
NINETY = 1.645
MOST_STEPS, BOX = 300, {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.5}


@styled
def fit(
    problem: Problem,
    estimate: MapEstimate,
    prediction: Prediction | None = None,
    *,
    experiments: Sequence[str] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw each measured mean period with the fitted one, a predictive band and the residual below.

    Where the noise of the inputs is estimated too, further panels show what it is: measured minus estimated input, with
    a band of 90 % (1.645 standard deviations given the estimate).

    Parameters
    ----------
    problem : Problem
    estimate : MapEstimate
    prediction : Prediction, optional
    experiments : sequence of str, optional
        By default all.

    Examples
    --------
    >>> figure = bp.plot.fit(problem, fit)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['displacement [m]', 'residual [m]']
    """
    problem = check_results(problem, estimate=estimate)
    runs = chosen(experiments, tuple(e.name for e in problem.experiments), "experiments")
    if prediction is not None:
        _checks.contains(
            "prediction", prediction.median, runs, "give the one of this problem, predict(problem, posterior)"
        )
    drawn = [e for e in problem.experiments if e.name in runs]
    shown = [(e, channel) for e in drawn for channel in e.outputs]
    inexact = [e for e in drawn if e.name in estimate.input_errors]
    noisy = [(e, name) for e in inexact for name, sd in estimate.input_sd[e.name].items() if sd.any()]
    if not shown:
        raise ValueError(f"experiments: must have time histories, got {', '.join(runs)}; {OF_TABLES}.")
    heights = [3, 1] * len(shown) + [1] * len(noisy)
    figure = figure or plt.figure(figsize=(7.0, 4.6 * len(shown) + 1.3 * len(noisy)), layout="constrained")
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    for row, (e, channel) in enumerate(shown):
        top = figure.add_subplot(grid[2 * row])
        below = figure.add_subplot(grid[2 * row + 1], sharex=top)
        draw_period(top, below, problem, estimate, e, channel, prediction)
    for row, (e, name) in enumerate(noisy, 2 * len(shown)):
        axes, half = figure.add_subplot(grid[row]), NINETY * estimate.input_sd[e.name][name]
        error = e.inputs[name] - estimate.inputs[e.name][name]
        gid = curve_id(f"error of {name}", name, e.name)
        axes.fill_between(e.time, error - half, error + half, lw=0, label="90 %", gid=gid, **PREDICTION_STYLE)
        axes.plot(e.time, error, lw=1.2, label="MAP", gid=gid, **FITTED_STYLE | {"marker": None})
        axes.axhline(0.0, lw=1.0, color=COLOURS["measured"])
        if row == 2 * len(shown):
            axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.95), borderpad=0.0)
        label = axis_label(f"error of\n{name}", problem.model.units.get(name, ""))
        axes.set(ylabel=label, xlabel="time in the period [s]")
    return figure


def draw_period(
    top: Axes,
    below: Axes,
    problem: Problem,
    estimate: MapEstimate,
    e: Experiment,
    channel: str,
    prediction: Prediction | None = None,
) -> None:
    """Draw a measured mean period with the fitted one, and the residual below."""
    residual = estimate.residuals[e.name][channel]
    predicted = e.outputs[channel] - residual
    gid = functools.partial(curve_id, channel=channel, experiment=e.name)
    if prediction is not None:
        low, high = prediction.low[e.name][channel], prediction.high[e.name][channel]
        label = f"{100 * prediction.probability:.0f} % predictive band"
        _band(top, e, low, high, label, gid(label))
        _band(below, e, low - predicted, high - predicted, "_", gid(label))
    label = _measured(problem, e.cycles)
    _curve(top, e, e.time, e.outputs[channel], lw=1.6, label=label, gid=gid(_origin(problem)), **MEASURED_STYLE)
    _curve(top, e, e.time, predicted, lw=1.2, label="MAP", gid=gid("MAP"), **FITTED_STYLE)
    _curve(below, e, e.time, residual, lw=1.0, gid=gid("residual"), **MEASURED_STYLE)
    below.axhline(0.0, lw=1.0, color=COLOURS["map"], ls="--")
    unit = problem.model.units.get(channel, "")
    top.set(ylabel=axis_label(channel, unit), title=axis_label(e.name))
    below.set(ylabel=axis_label("residual", unit), xlabel="time in the period [s]")
    top.tick_params(labelbottom=False)
    top.legend(frameon=False)


def _curve(axes: Axes, e: Experiment, x: np.ndarray, y: np.ndarray, closed: bool = False, **look: Any) -> None:
    """Draw a curve without markers, or points without a line for masked data."""
    at = e.measured_points
    if at.all():
        at = np.arange(x.size + closed) % x.size
        axes.plot(x[at], y[at], **look | {"marker": None})
    else:
        axes.plot(x[at], y[at], **look | {"ls": "none"})


def _band(axes: Axes, e: Experiment, low: np.ndarray, high: np.ndarray, label: str, gid: str) -> None:
    at = e.measured_points
    if at.all():
        axes.fill_between(e.time, low, high, lw=0, label=label, gid=gid, **PREDICTION_STYLE)
    else:
        axes.vlines(e.time[at], low[at], high[at], lw=8, label=label, gid=gid, **PREDICTION_STYLE)


@styled
def loops(
    problem: Problem,
    estimate: MapEstimate,
    *,
    output: str | None = None,
    input: str | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw an output against an input and against the rate of the input, measured and fitted, for every experiment.

    Parameters
    ----------
    problem : Problem
    estimate : MapEstimate
    output, input : str, optional
        By default the first of each.

    Raises
    ------
    ValueError
        For an unknown name, or a model without inputs.

    Examples
    --------
    >>> figure = bp.plot.loops(problem, fit)
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['force [N]', 'rate of force [N/s]']
    """
    problem = check_results(problem, estimate=estimate)
    if not problem.channels:
        raise ValueError(f"problem: must have time histories, got none; {OF_TABLES}.")
    output = problem.channels[0] if output is None else output
    _checks.one_of("output", output, problem.channels)
    input = next(iter(problem.model.inputs), "") if input is None else input
    _checks.one_of("input", input, problem.model.inputs)
    figure = figure or plt.figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for number, e in enumerate(e for e in problem.experiments if output in e.outputs):
        measured = e.outputs[output]
        predicted = measured - estimate.residuals[e.name][output]
        amplitudes = _fourier.coefficients(e.inputs[input])
        rate = _fourier.on_grid(_fourier.derivative(amplitudes, e.frequency / e.periods), measured.size)
        labels = (_measured(problem, e.cycles), "MAP") if number == 0 else (None, None)
        gids = [curve_id(curve, output, e.name) for curve in (_origin(problem), "MAP")]
        for axes, across in ((left, e.inputs[input]), (right, rate)):
            _curve(axes, e, across, measured, closed=True, lw=1.6, label=labels[0], gid=gids[0], **MEASURED_STYLE)
            _curve(axes, e, across, predicted, closed=True, lw=1.2, label=labels[1], gid=gids[1], **FITTED_STYLE)
    unit = problem.model.units.get(input, "")
    left.set(xlabel=axis_label(input, unit), ylabel=axis_label(output, problem.model.units.get(output, "")))
    right.set_xlabel(axis_label(f"rate of {input}", f"{unit}/s" if unit else ""))
    left.legend(frameon=False)
    return figure


def _origin(problem: Problem) -> str:
    return "synthetic" if any(e.synthetic for e in problem.experiments) else "measured"


def _measured(problem: Problem, cycles: int) -> str:
    return f"{_origin(problem)}, {f'mean of {cycles} cycles' if cycles > 1 else '1 cycle'}"


@styled
def traces(posterior: Posterior, *, walkers: int = 4, figure: Figure | None = None) -> Figure:
    """Draw the traces of a few walkers of each ensemble for every parameter.

    Parameters
    ----------
    posterior : Posterior
    walkers : int
        Number of walkers per ensemble.

    Raises
    ------
    ValueError
        For fewer than one walker.

    Examples
    --------
    >>> figure = bp.plot.traces(posterior, walkers=2)
    >>> [axes.get_ylabel().splitlines()[0] for axes in figure.axes]
    ['c', 'k', 'variance[displacement]']
    """
    _checks.instance("posterior", posterior, Posterior)
    _checks.integer("walkers", walkers, 1)
    names = posterior.names
    steps = posterior.by_step(posterior.draws(names[0])).shape[1]
    shown = np.arange(0, steps, max(1, steps // MOST_STEPS))
    figure = figure or plt.figure(figsize=(8.0, 1.25 * len(names) + 0.6), layout="constrained")
    rows = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    for axes, name in zip(rows, names, strict=True):
        for e, paths in enumerate(posterior.by_step(posterior.draws(name))[:, shown]):
            axes.plot(shown, paths[:, :walkers], color=ENSEMBLES[e % len(ENSEMBLES)], lw=0.4, alpha=0.6)
        axes.set_ylabel(draws_label(posterior, name), fontsize=8)
        text = f"tau {posterior.tau[name]:.0f} steps, R-hat {posterior.rhat[name]:.3f}"
        axes.annotate(text, (0.995, 0.97), xycoords="axes fraction", ha="right", va="top", fontsize=7, bbox=BOX)
    rows[-1].set_xlabel("step after burn-in (one colour per ensemble)")
    if text := caveats_of(posterior):
        figure.suptitle(text)
    return figure
