"""Figures of estimates: fitted periods, loops, and posterior draws with the Laplace approximation."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter
from scipy.stats import norm

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.diagnostics.predictive import Prediction
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot import style
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, LAPLACE, axis_label, caveats_of, chosen, draws_label
from bayesperiodic.posterior.description import check_fingerprint, check_results
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.posterior import Posterior

MEASURED: dict[str, Any] = {"color": COLOURS["measured"], "marker": "o"}
FITTED: dict[str, Any] = {"color": COLOURS["map"], "ls": "--", "marker": "x"}
BAND: dict[str, Any] = {"color": COLOURS["mcmc"], "alpha": 0.45}
LEVELS, LEVELS_TEXT = (0.5, 0.9), "50% and 90%"
FEWEST_BINS, MOST_BINS = 35, 200
# Standard deviations of a normal distribution within which 90 % are.
NINETY = 1.645
BINS, SHOWN = 40, (0.0005, 0.9995)
# Range of the powers of ten of ticks without an offset or a common factor.
WHOLE = (-5, 10)
MOST_STEPS, BOX = 300, {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.5}


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
    figure : Figure, optional

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
    problem = check_results(problem, estimate=estimate)
    runs = chosen(experiments, tuple(e.name for e in problem.experiments), "experiments")
    if prediction is not None:
        _checks.contains(
            "prediction", prediction.median, runs, "give the one of this problem, predict(problem, posterior)"
        )
    shown = [(e, channel) for e in problem.experiments if e.name in runs for channel in e.outputs]
    noisy = [
        (e, name)
        for e in problem.experiments
        if e.name in runs and e.name in estimate.input_errors
        for name, sd in estimate.input_sd[e.name].items()
        if sd.any()
    ]
    heights = [3, 1] * len(shown) + [1] * len(noisy)
    figure = figure or plt.figure(figsize=(7.0, 4.6 * len(shown) + 1.3 * len(noisy)), layout="constrained")
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    for row, (e, channel) in enumerate(shown):
        top = figure.add_subplot(grid[2 * row])
        below = figure.add_subplot(grid[2 * row + 1], sharex=top)
        residual = estimate.residuals[e.name][channel]
        predicted = e.outputs[channel] - residual
        if prediction is not None:
            low, high = prediction.low[e.name][channel], prediction.high[e.name][channel]
            _band(top, e, low, high, f"{prediction.probability:.0%} predictive band")
            _band(below, e, low - predicted, high - predicted, "_")
        _curve(top, e, e.time, e.outputs[channel], lw=1.6, label=_measured(problem, e.cycles), **MEASURED)
        _curve(top, e, e.time, predicted, lw=1.2, label="MAP", **FITTED)
        _curve(below, e, e.time, residual, lw=1.0, **MEASURED)
        below.axhline(0.0, lw=1.0, color=COLOURS["map"], ls="--")
        unit = problem.model.units.get(channel, "")
        top.set(ylabel=axis_label(channel, unit), title=axis_label(e.name))
        below.set(ylabel=axis_label("residual", unit), xlabel="time in the period [s]")
        top.tick_params(labelbottom=False)
        top.legend(frameon=False)
    for row, (e, name) in enumerate(noisy, 2 * len(shown)):
        axes, half = figure.add_subplot(grid[row]), NINETY * estimate.input_sd[e.name][name]
        error = e.inputs[name] - estimate.inputs[e.name][name]
        axes.fill_between(e.time, error - half, error + half, lw=0, label="90 %", **BAND)
        axes.plot(e.time, error, lw=1.2, label="MAP", **FITTED | {"marker": None})
        axes.axhline(0.0, lw=1.0, color=COLOURS["measured"])
        if row == 2 * len(shown):
            axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.95), borderpad=0.0)
        axes.set(
            ylabel=axis_label(f"error of\n{name}", problem.model.units.get(name, "")), xlabel="time in the period [s]"
        )
    return figure


def _curve(axes: Axes, e: Experiment, x: np.ndarray, y: np.ndarray, closed: bool = False, **look: Any) -> None:
    """Draw a curve without markers, or points without a line for masked data."""
    if e.mask is None:
        at = np.arange(x.size + closed) % x.size
        axes.plot(x[at], y[at], **look | {"marker": None})
    else:
        axes.plot(x[e.mask], y[e.mask], **look | {"ls": "none"})


def _band(axes: Axes, e: Experiment, low: np.ndarray, high: np.ndarray, label: str) -> None:
    if e.mask is None:
        axes.fill_between(e.time, low, high, lw=0, label=label, **BAND)
    else:
        axes.vlines(e.time[e.mask], low[e.mask], high[e.mask], lw=8, label=label, **BAND)


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
    problem = check_results(problem, estimate=estimate)
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
        labels = (_measured(problem, e.cycles), "MAP") if number == 0 else (None, None)
        for axes, across in ((left, e.inputs[input]), (right, rate)):
            _curve(axes, e, across, measured, closed=True, lw=1.6, label=labels[0], **MEASURED)
            _curve(axes, e, across, predicted, closed=True, lw=1.2, label=labels[1], **FITTED)
    unit = problem.model.units.get(input, "")
    left.set(xlabel=axis_label(input, unit), ylabel=axis_label(output, problem.model.units.get(output, "")))
    right.set_xlabel(axis_label(f"rate of {input}", f"{unit}/s" if unit else ""))
    left.legend(frameon=False)
    return figure


def _measured(problem: Problem, cycles: int) -> str:
    synthetic = any(e.synthetic for e in problem.experiments)
    return f"{'synthetic' if synthetic else 'measured'}, mean of {cycles} cycles"


def corner(
    posterior: Posterior,
    *,
    laplace: MapEstimate | None = None,
    names: Sequence[str] | None = None,
    truths: Mapping[str, float] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw all pairs of parameters, with the ellipses of the Laplace approximation on top.

    Contours and ellipses contain 50 and 90 % of the probability. The ellipses of parameters are those of
    `MapEstimate.covariance`. Those of noise parameters are v ± v·sd(ln v) around the mode in sampling coordinates,
    independent of the parameters. Quantities without a Laplace approximation have no ellipse. Where the draws belong to
    several optima, see `Posterior.modes`, the mean of each is marked by its number.

    Parameters
    ----------
    posterior : Posterior
    laplace : MapEstimate, optional
    names : sequence of str, optional
        Full names such as "k", "theta16[run 7]" and "variance[force]", in the order of the rows; by default all.
    truths : mapping of str to float, optional
        Values to mark by lines, such as the parameters of simulated data.
    figure : Figure, optional

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown name, or an estimate of another problem.

    Examples
    --------
    >>> figure = bp.plot.corner(posterior, laplace=fit, names=["c", "k"])
    >>> len(figure.axes), figure.axes[2].get_xlabel().splitlines()
    (4, ['c', '[N s/m]'])
    """
    _checks.instance("posterior", posterior, Posterior)
    convergence.arviz()  # corner imports it
    import corner as corner_package

    names = chosen(names, posterior.names)
    for name in _checks.mapping("truths", truths or {}, "{'k': 1.0}"):
        _checks.one_of("truths", name, posterior.names)
    draws = np.stack([posterior.draws(name) for name in names], axis=-1)
    titles = [draws_label(posterior, name) for name in names]
    bins = _bins(draws)
    margin = 0.9 + 0.17 * max(title.count("\n") for title in titles)
    size = 1.75 * len(names) + margin + 0.2
    figure = corner_package.corner(
        draws,
        labels=titles,
        levels=LEVELS,
        range=[tuple(ends) for ends in np.quantile(draws, SHOWN, axis=0).T],
        bins=bins,
        hist_bin_factor=FEWEST_BINS / bins,
        smooth=1.0,
        color=COLOURS["mcmc"],
        plot_datapoints=False,
        fill_contours=True,
        hist_kwargs={"density": True, "lw": 1.4},
        contour_kwargs={"linewidths": 0.9, "colors": COLOURS["map"]},
        max_n_ticks=3,
        labelpad=0.12,
        truths=truths and [truths.get(name) for name in names],
        truth_color=COLOURS["map"],
        fig=figure or plt.figure(figsize=(size, size)),
    )
    _write_out_ticks(figure)
    handles = [plt.Line2D([], [], color=COLOURS["mcmc"], lw=4, label=f"MCMC, {LEVELS_TEXT}")]
    if laplace is not None:
        _laplace_on_corner(
            np.array(figure.axes).reshape(len(names), -1), *_normal_approximation(posterior, names, laplace)
        )
        handles.append(plt.Line2D([], [], label=f"Laplace, {LEVELS_TEXT}", **LAPLACE))
    handles += _modes_on_corner(np.array(figure.axes).reshape(len(names), -1), posterior, names)
    font = min(14, 4 * max(len(names), 2))
    place: dict[str, Any] = {"loc": "upper right", "bbox_to_anchor": (0.97, 0.97), "frameon": False}
    figure.legend(handles=handles, fontsize=font, title=caveats_of(posterior) or None, title_fontsize=font, **place)
    width, height = figure.get_size_inches()
    top = 0.98 if len(names) > 1 else 0.75
    figure.subplots_adjust(left=margin / width, bottom=margin / height, right=0.98, top=top)
    return figure


def _modes_on_corner(axes: np.ndarray, posterior: Posterior, names: tuple[str, ...]) -> list[Any]:
    """Mark the mean of every mode by its number, and return the entries of the legend."""
    handles = []
    for row, mode in posterior.modes.iterrows():
        look: dict[str, Any] = {"marker": f"${row}$", "color": COLOURS["map"], "ls": ""}
        for i, j in combinations(range(len(names)), 2):
            axes[j, i].plot(mode[names[i]], mode[names[j]], ms=9, zorder=5, **look)
        for i, name in enumerate(names):
            axes[i, i].axvline(mode[name], color=COLOURS["map"], lw=0.8, ls=":")
        mass = f"{100 * mode['mass']:.1f} ± {100 * mode['mcse_mass']:.1g} %"
        handles.append(plt.Line2D([], [], label=mass, ms=9, **look))
    return handles


def _bins(draws: np.ndarray) -> int:
    """Return the number of bins that resolves the narrowest ridge."""
    correlation = np.corrcoef(draws.T) if draws.shape[1] > 1 else np.zeros((1, 1))
    np.fill_diagonal(correlation, 0.0)
    across = np.sqrt(1.0 - np.nanmax(correlation**2, initial=0.0))
    # The range spans 6.6 standard deviations; three bins should span one standard deviation across the ridge.
    return int(np.clip(20.0 / max(across, 1e-9), FEWEST_BINS, MOST_BINS))


def _write_out_ticks(figure: Figure) -> None:
    """Remove offsets of ticks, and move their common factors into the labels, because they would overlap panels."""
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        formatter = axis.get_major_formatter()
        if isinstance(formatter, ScalarFormatter):
            formatter.set_useOffset(False)
            formatter.set_powerlimits(WHOLE)
            formatter.set_locs(axis.get_majorticklocs().tolist())
            if (factor := formatter.get_offset()) and (label := axis.get_label_text()):
                name, _, unit = label.partition("\n[")
                axis.set_label_text(f"{name}\n[{' '.join(filter(None, [factor, unit or ']']))}")
            axis.get_offset_text().set_visible(False)


def _normal_approximation(
    posterior: Posterior, names: tuple[str, ...], fit: MapEstimate
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (names,) and covariance (names, names) in natural values; NaN if undefined."""
    check_fingerprint("laplace", fit, posterior.fingerprint)
    theta, noise = [n for n in names if n in fit.theta], [n for n in names if n not in fit.theta]
    mean = pd.Series(fit.joint_mode | fit.theta, dtype=float).reindex([*names])
    covariance = pd.DataFrame(0.0, index=[*names], columns=[*names])
    covariance.loc[theta, theta] = fit.covariance.loc[theta, theta]
    scale = np.outer(mean[noise], mean[noise])
    covariance.loc[noise, noise] = fit.joint_covariance.reindex(noise, columns=noise) * scale
    return mean.to_numpy(), covariance.to_numpy()


def _laplace_on_corner(axes: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> None:
    variances = np.diag(covariance)
    drawn = np.flatnonzero(np.isfinite(mean) & np.isfinite(variances) & (variances > 0.0))
    for i in drawn:
        left, right = axes[i, i].get_xlim()
        x = np.linspace(left, right, 200)
        density = norm.pdf(x, mean[i], np.sqrt(variances[i]))
        axes[i, i].plot(x, density, **LAPLACE)
        axes[i, i].set_ylim(0.0, 1.1 * max(density.max(), axes[i, i].get_ylim()[1] / 1.1))
        for j in drawn[drawn < i]:
            sds = np.sqrt(variances[[j, i]])
            _ellipses(axes[i, j], mean[[j, i]], sds, covariance[i, j] / np.prod(sds))


def _ellipses(axes: Axes, centre: np.ndarray, sds: np.ndarray, correlation: float) -> None:
    """Draw the ellipses of the probability levels of a bivariate normal distribution."""
    turn = np.linspace(0.0, 2 * np.pi, 200)
    across = np.cos(turn)
    up = correlation * across + np.sqrt(max(1.0 - correlation**2, 0.0)) * np.sin(turn)
    for level in LEVELS:
        radius = np.sqrt(-2.0 * np.log(1.0 - level))
        x, y = (c + radius * sd * wave for c, sd, wave in zip(centre, sds, (across, up), strict=True))
        axes.plot(x, y, color=COLOURS["laplace"], lw=1.4, ls="--", zorder=5)


def marginals(
    posterior: Posterior,
    *,
    laplace: MapEstimate | None = None,
    names: Sequence[str] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw the marginal distribution of every parameter, with the Laplace approximation on top.

    Parameters
    ----------
    posterior : Posterior
    laplace : MapEstimate, optional
        For noise parameters see `corner`.
    names : sequence of str, optional
        See `corner`.
    figure : Figure, optional

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown name, or an estimate of another problem.

    Examples
    --------
    >>> figure = bp.plot.marginals(posterior, laplace=fit)
    >>> [axes.get_xlabel().splitlines()[0] for axes in figure.axes]
    ['c', 'k', 'variance[displacement]']
    """
    _checks.instance("posterior", posterior, Posterior)
    names = chosen(names, posterior.names)
    mean, sd = np.full((2, len(names)), np.nan)
    if laplace is not None:
        mean, covariance = _normal_approximation(posterior, names, laplace)
        sd = np.sqrt(np.diag(covariance))
    columns, rows = style.panel_grid(len(names))
    figure = figure or plt.figure(figsize=(2.4 * columns + 0.4, 2.3 * rows + 0.6), layout="constrained")
    panels = style.panels(figure, len(names))
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        draws = posterior.draws(name)
        density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
        style.draw_marginal(axes, edges, density, float(mean[i]), float(sd[i]))
        axes.set_xlabel(draws_label(posterior, name))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if text := caveats_of(posterior):
        figure.suptitle(text, x=0.99, ha="right", fontsize="medium")
    return figure


def traces(posterior: Posterior, *, walkers: int = 4, figure: Figure | None = None) -> Figure:
    """Draw the traces of a few walkers of each ensemble for every parameter.

    Parameters
    ----------
    posterior : Posterior
    walkers : int
        Number of walkers per ensemble.
    figure : Figure, optional

    Returns
    -------
    Figure

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
        place: dict[str, Any] = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
        axes.annotate(text, (0.995, 0.97), fontsize=7, bbox=BOX, **place)
    rows[-1].set_xlabel("step after burn-in (one colour per ensemble)")
    if text := caveats_of(posterior):
        figure.suptitle(text)
    return figure
