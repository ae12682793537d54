"""Figures of measured and fitted periods: over time, and as loops of an output against an input."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.diagnostics.predictive import Prediction
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot.posterior import chosen
from bayesperiodic.plot.style import COLOURS, axis_label
from bayesperiodic.posterior.problem import Problem


def fit(
    problem: Problem,
    estimate: MapEstimate,
    prediction: Prediction | None = None,
    *,
    experiments: Sequence[str] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw each measured mean period with the fitted one, a predictive band and the residual below.

    Parameters
    ----------
    problem : Problem
    estimate : MapEstimate
    prediction : Prediction, optional
    experiments : sequence of str, optional
        By default all.
    figure : Figure, optional
        An empty figure to draw into.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown name.

    Examples
    --------
    >>> figure = bp.plot.fit(problem, fit)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['displacement [m]', 'residual [m]']
    """
    runs = chosen(experiments, tuple(e.name for e in problem.experiments), "experiments")
    shown = [(e, channel) for e in problem.experiments if e.name in runs for channel in e.outputs]
    figure = figure or plt.figure(figsize=(7.0, 4.6 * len(shown)), layout="constrained")
    grid = figure.add_gridspec(2 * len(shown), 1, height_ratios=[3, 1] * len(shown))
    for row, (e, channel) in enumerate(shown):
        top = figure.add_subplot(grid[2 * row])
        below = figure.add_subplot(grid[2 * row + 1], sharex=top)
        residual = estimate.residuals[e.name][channel]
        predicted = e.outputs[channel] - residual
        if prediction is not None:
            low, high = prediction.low[e.name][channel], prediction.high[e.name][channel]
            _band(top, e, low, high, f"{prediction.probability:.0%} predictive band")
            _band(below, e, low - predicted, high - predicted, "_")
        measured: dict[str, Any] = {"color": COLOURS["measured"]}
        fitted: dict[str, Any] = {"color": COLOURS["map"], "ls": "--"}
        _line(top, e, e.outputs[channel], "o", lw=1.6, label=_measured(problem, e.cycles), **measured)
        _line(top, e, predicted, "x", lw=1.2, label="MAP", **fitted)
        _line(below, e, residual, "o", lw=1.0, **measured)
        below.axhline(0.0, lw=1.0, **fitted)
        unit = problem.model.units.get(channel, "")
        top.set_ylabel(axis_label(channel, unit))
        below.set_ylabel(axis_label("residual", unit))
        below.set_xlabel("time in the period [s]")
        top.tick_params(labelbottom=False)
        top.set_title(axis_label(e.name, ""))
        top.legend(frameon=False)
    return figure


def _line(axes: Axes, e: Experiment, values: np.ndarray, marker: str, **look: Any) -> None:
    """Draw values over time, as points for masked data."""
    if e.mask is None:
        axes.plot(e.time, values, **look)
    else:
        axes.plot(e.time[e.mask], values[e.mask], **look | {"ls": "none", "marker": marker})


def _band(axes: Axes, e: Experiment, low: np.ndarray, high: np.ndarray, label: str) -> None:
    if e.mask is None:
        axes.fill_between(e.time, low, high, color=COLOURS["mcmc"], alpha=0.45, lw=0, label=label)
    else:
        axes.vlines(e.time[e.mask], low[e.mask], high[e.mask], color=COLOURS["mcmc"], alpha=0.45, lw=8, label=label)


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
    figure : Figure, optional

    Returns
    -------
    Figure

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
    output = problem.channels[0] if output is None else output
    _checks.one_of("output", output, problem.channels)
    input = next(iter(problem.model.inputs), "") if input is None else input
    _checks.one_of("input", input, problem.model.inputs)
    figure = figure or plt.figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for number, e in enumerate(problem.experiments):
        measured = e.outputs[output]
        predicted = measured - estimate.residuals[e.name][output]
        amplitudes = _fourier.coefficients(e.inputs[input])
        rate = _fourier.on_grid(_fourier.derivative(amplitudes, e.frequency / e.periods), measured.size)
        for axes, across in ((left, e.inputs[input]), (right, rate)):
            first = number == 0
            label = _measured(problem, e.cycles) if first else None
            _loop(axes, e, across, measured, "o", color=COLOURS["measured"], lw=1.6, label=label)
            label = "MAP" if first else None
            _loop(axes, e, across, predicted, "x", color=COLOURS["map"], lw=1.2, ls="--", label=label)
    unit = problem.model.units.get(input, "")
    left.set_xlabel(axis_label(input, unit))
    right.set_xlabel(axis_label(f"rate of {input}", f"{unit}/s" if unit else ""))
    left.set_ylabel(axis_label(output, problem.model.units.get(output, "")))
    left.legend(frameon=False)
    return figure


def _loop(axes: Axes, e: Experiment, across: np.ndarray, values: np.ndarray, marker: str, **look: Any) -> None:
    """Draw a closed curve, or points for masked data."""
    if e.mask is None:
        axes.plot(np.append(across, across[0]), np.append(values, values[0]), **look)
    else:
        axes.plot(across[e.mask], values[e.mask], **look | {"ls": "none", "marker": marker})


def _measured(problem: Problem, cycles: int) -> str:
    synthetic = any(e.synthetic for e in problem.experiments)
    return f"{'synthetic' if synthetic else 'measured'}, mean of {cycles} cycles"
