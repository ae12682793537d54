"""Figures; every function takes the data and returns the matplotlib Figure.

One colour means one thing everywhere: measured, MAP, Laplace, MCMC.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from bayesperiodic import checks, fourier
from bayesperiodic.diagnosis.predictive import Prediction
from bayesperiodic.inference.map_estimate import MapEstimate
from bayesperiodic.inference.posterior import Posterior
from bayesperiodic.inference.problem import Problem

COLOURS = {"measured": "#000000", "map": "#0072B2", "laplace": "#D55E00", "mcmc": "#56B4E9"}
ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
LEVELS = (0.5, 0.9)


def fit(
    problem: Problem, estimate: MapEstimate, prediction: Prediction | None = None, *, figure: Figure | None = None
) -> Figure:
    """Draw each measured mean period with the fitted one, a predictive band and the residual below.

    Parameters
    ----------
    problem : Problem
    estimate : MapEstimate
    prediction : Prediction, optional
    figure : Figure, optional
        An empty figure to draw into.

    Returns
    -------
    Figure
    """
    shown = [(e, channel) for e in problem.experiments for channel in e.outputs]
    figure = figure or plt.figure(figsize=(7.0, 4.6 * len(shown)), layout="constrained")
    grid = figure.add_gridspec(2 * len(shown), 1, height_ratios=[3, 1] * len(shown))
    for row, (e, channel) in enumerate(shown):
        top = figure.add_subplot(grid[2 * row])
        below = figure.add_subplot(grid[2 * row + 1], sharex=top)
        predicted = e.outputs[channel] - estimate.residuals[e.name][channel]
        if prediction is not None:
            band = f"{prediction.probability:.0%} predictive band"
            low, high = prediction.low[e.name][channel], prediction.high[e.name][channel]
            top.fill_between(e.time, low, high, color=COLOURS["mcmc"], alpha=0.45, lw=0, label=band)
            below.fill_between(e.time, low - predicted, high - predicted, color=COLOURS["mcmc"], alpha=0.45, lw=0)
        top.plot(e.time, e.outputs[channel], color=COLOURS["measured"], lw=1.6, label=_measured(problem, e.cycles))
        top.plot(e.time, predicted, color=COLOURS["map"], lw=1.2, ls="--", label="MAP")
        below.plot(e.time, estimate.residuals[e.name][channel], color=COLOURS["measured"], lw=1.0)
        below.axhline(0.0, color=COLOURS["map"], lw=1.0, ls="--")
        unit = problem.model.units.get(channel, "")
        top.set_ylabel(_label(channel, unit))
        below.set_ylabel(_label("residual", unit))
        below.set_xlabel("time in the period [s]")
        top.tick_params(labelbottom=False)
        top.set_title(e.name)
        top.legend(frameon=False)
    return figure


def loops(
    problem: Problem,
    estimate: MapEstimate,
    *,
    output: str | None = None,
    input: str | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw an output against an input and against that input's rate, measured and fitted, for every experiment.

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
    """
    output = problem.channels[0] if output is None else output
    checks.one_of("output", output, problem.channels)
    input = next(iter(problem.model.inputs), "") if input is None else input
    checks.one_of("input", input, problem.model.inputs)
    figure = figure or plt.figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for number, e in enumerate(problem.experiments):
        measured = e.outputs[output]
        predicted = measured - estimate.residuals[e.name][output]
        amplitudes = fourier.coefficients(e.inputs[input])
        rate = fourier.on_grid(fourier.derivative(amplitudes, e.frequency / e.periods), measured.size)
        for axes, across in ((left, e.inputs[input]), (right, rate)):
            first = number == 0
            axes.plot(
                _closed(across),
                _closed(measured),
                color=COLOURS["measured"],
                lw=1.6,
                label=_measured(problem, e.cycles) if first else None,
            )
            axes.plot(
                _closed(across),
                _closed(predicted),
                color=COLOURS["map"],
                lw=1.2,
                ls="--",
                label="MAP" if first else None,
            )
    unit = problem.model.units.get(input, "")
    left.set_xlabel(_label(input, unit))
    right.set_xlabel(_label(f"rate of {input}", f"{unit}/s" if unit else ""))
    left.set_ylabel(_label(output, problem.model.units.get(output, "")))
    left.legend(frameon=False)
    return figure


def corner(posterior: Posterior, *, laplace: MapEstimate | None = None, figure: Figure | None = None) -> Figure:
    """Draw all pairs of parameters, with the Laplace approximation's ellipses on top.

    Contours of draws and ellipses hold 50 and 90 % of the probability. The variances' Laplace approximation is
    v ± v·sqrt(2/n), independent of the parameters.

    Parameters
    ----------
    posterior : Posterior
    laplace : MapEstimate, optional
    figure : Figure, optional

    Returns
    -------
    Figure
    """
    import corner as corner_package

    names = posterior.names
    draws = np.stack([posterior.draws(name) for name in names], axis=-1)
    span = [tuple(np.quantile(draws[:, i], [0.0005, 0.9995])) for i in range(len(names))]
    size = 1.75 * len(names) + 0.6
    figure = corner_package.corner(
        draws,
        labels=[_label(n, _unit(posterior, n)) for n in names],
        levels=LEVELS,
        range=span,
        bins=35,
        smooth=1.0,
        color=COLOURS["mcmc"],
        plot_datapoints=False,
        fill_contours=True,
        hist_kwargs={"density": True, "lw": 1.4},
        contour_kwargs={"linewidths": 0.9, "colors": COLOURS["map"]},
        max_n_ticks=3,
        labelpad=0.12,
        fig=figure or plt.figure(figsize=(size, size)),
    )
    if laplace is not None:
        _laplace_on_corner(np.array(figure.axes).reshape(len(names), len(names)), names, laplace)
    handles = [plt.Line2D([], [], color=COLOURS["mcmc"], lw=4, label=f"MCMC, {_levels()}")]
    if laplace is not None:
        handles.append(plt.Line2D([], [], color=COLOURS["laplace"], lw=1.6, ls="--", label=f"Laplace, {_levels()}"))
    figure.legend(
        handles=handles,
        loc="upper right",
        bbox_to_anchor=(0.97, 0.97),
        frameon=False,
        fontsize=14,
        title=_caveats(posterior) or None,
        title_fontsize=14,
    )
    figure.subplots_adjust(left=0.1, bottom=0.1)
    return figure


def _laplace_on_corner(axes: np.ndarray, names: tuple[str, ...], laplace: MapEstimate) -> None:
    count = len(names)
    mean, covariance = np.zeros(count), np.zeros((count, count))
    parameters = [i for i, name in enumerate(names) if name in laplace.theta]
    covariance[np.ix_(parameters, parameters)] = laplace.covariance.to_numpy()
    for i, name in enumerate(names):
        if name in laplace.theta:
            mean[i] = laplace.theta[name]
        else:
            channel = name[len("variance[") : -1]
            mean[i] = laplace.variances[channel]
            covariance[i, i] = 2.0 / laplace.independent[channel] * mean[i] ** 2
    for i in range(count):
        left, right = axes[i, i].get_xlim()
        x = np.linspace(left, right, 200)
        sd = np.sqrt(covariance[i, i])
        density = np.exp(-0.5 * ((x - mean[i]) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes[i, i].plot(x, density, color=COLOURS["laplace"], lw=1.6, ls="--")
        axes[i, i].set_ylim(0.0, 1.1 * max(density.max(), axes[i, i].get_ylim()[1] / 1.1))
        for j in range(i):
            pair = covariance[np.ix_([j, i], [j, i])]
            values, vectors = np.linalg.eigh(pair)
            angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
            for level in LEVELS:
                wide, narrow = (2.0 * np.sqrt(-2.0 * np.log(1.0 - level) * v) for v in (values[1], values[0]))
                axes[i, j].add_patch(
                    Ellipse(
                        (mean[j], mean[i]),
                        wide,
                        narrow,
                        angle=angle,
                        fill=False,
                        color=COLOURS["laplace"],
                        lw=1.4,
                        ls="--",
                        zorder=5,
                    )
                )


def traces(posterior: Posterior, *, walkers: int = 4, figure: Figure | None = None) -> Figure:
    """Draw, for every parameter, the paths of a few walkers of each ensemble.

    Parameters
    ----------
    posterior : Posterior
    walkers : int
        Shown of each ensemble.
    figure : Figure, optional

    Returns
    -------
    Figure
    """
    checks.integer("walkers", walkers, 1)
    names = posterior.names
    group = posterior.data["posterior"]
    chains, steps = group.sizes["chain"], group.sizes["draw"]
    ensemble = group["ensemble"].to_numpy()
    figure = figure or plt.figure(figsize=(8.0, 1.25 * len(names) + 0.6), layout="constrained")
    rows = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    for axes, name in zip(rows, names, strict=True):
        paths = posterior.draws(name).reshape(chains, steps)
        for e in np.unique(ensemble):
            shown = paths[ensemble == e][:walkers, :: max(1, steps // 300)]
            across = np.arange(shown.shape[1]) * max(1, steps // 300)
            axes.plot(across, shown.T, color=ENSEMBLES[e % len(ENSEMBLES)], lw=0.4, alpha=0.6)
        axes.set_ylabel(_label(name, _unit(posterior, name)).replace(" [", "\n["), fontsize=8)
        axes.annotate(
            f"tau {posterior.tau[name]:.0f} steps, R-hat {posterior.rhat[name]:.3f}",
            (0.995, 0.97),
            xycoords="axes fraction",
            ha="right",
            va="top",
            fontsize=7,
            bbox={"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.5},
        )
    rows[-1].set_xlabel("step after burn-in; a colour is an independent ensemble")
    if caveats := _caveats(posterior):
        figure.suptitle(caveats)
    return figure


def _measured(problem: Problem, cycles: int) -> str:
    synthetic = any(e.synthetic for e in problem.experiments)
    return f"{'synthetic' if synthetic else 'measured'}, mean of {cycles} cycles"


def _caveats(posterior: Posterior) -> str:
    said = ["synthetic data"] if posterior.data.attrs.get("synthetic") else []
    return ", ".join(said + ([] if posterior.converged else ["NOT CONVERGED"]))


def _closed(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[0])


def _levels() -> str:
    return " and ".join(f"{level:.0%}" for level in LEVELS)


def _unit(posterior: Posterior, name: str) -> str:
    group = posterior.data["posterior"]
    if name.startswith("variance["):
        return str(group["variance"].attrs.get(f"units of {name[len('variance[') : -1]}", ""))
    return str(group[name].attrs.get("units", ""))


def _label(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name
