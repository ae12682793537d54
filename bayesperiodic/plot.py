"""Figures; every function takes the data and returns the matplotlib Figure.

One colour means one thing everywhere: measured, MAP, Laplace, MCMC.
"""

import textwrap
from collections.abc import Callable, Sequence
from typing import cast

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import checks, fourier
from bayesperiodic.diagnosis.predictive import Prediction
from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.estimation.profile import CLOSED, Profile
from bayesperiodic.inference.labels import unit as unit_of
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.periodic.continuation import FOLD, PERIOD_DOUBLING, Branch
from bayesperiodic.periodic.solution import PeriodicSolution

COLOURS = {"measured": "#000000", "map": "#0072B2", "laplace": "#D55E00", "mcmc": "#56B4E9"}
ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
LEVELS = (0.5, 0.9)
LABEL_LENGTH = 24
MEASURES = ("amplitude", "maximum", "section", "period")
PROFILES_ACROSS = 3
PROFILE_LEGEND = ("profile", "MAP", "Laplace", "solve failed")
AT_90, DEEPEST = -0.5 * 1.6449**2, -4.2
MARKERS = {FOLD: "o", PERIOD_DOUBLING: "D"}


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


def corner(
    posterior: Posterior,
    *,
    laplace: MapEstimate | None = None,
    names: Sequence[str] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw all pairs of parameters, with the Laplace approximation's ellipses on top.

    Contours of draws and ellipses hold 50 and 90 % of the probability. The ellipses of parameters are those of
    `MapEstimate.covariance`. Noise parameters are drawn as v ± v·sd(ln v) around the mode in sampling coordinates,
    independent of the parameters; what has no Laplace approximation has no ellipse.

    Parameters
    ----------
    posterior : Posterior
    laplace : MapEstimate, optional
    names : sequence of str, optional
        Full names such as "k", "theta16[run 7]" and "variance[force]", in the order of the rows; by default all.
    figure : Figure, optional

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown name, or an estimate of another problem.
    """
    import corner as corner_package

    names = _chosen(names, posterior.names)
    draws = np.stack([posterior.draws(name) for name in names], axis=-1)
    span = [tuple(np.quantile(draws[:, i], [0.0005, 0.9995])) for i in range(len(names))]
    titles = [_wrapped(name, _unit(posterior, name)) for name in names]
    margin = 0.9 + 0.17 * max(title.count("\n") for title in titles)
    size = 1.75 * len(names) + margin + 0.2
    figure = corner_package.corner(
        draws,
        labels=titles,
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
        mean, covariance = _laplace(names, laplace)
        _laplace_on_corner(np.array(figure.axes).reshape(len(names), len(names)), mean, covariance)
    _corner_legend(figure, posterior, laplace is not None, min(14, 4 * max(len(names), 2)))
    width, height = figure.get_size_inches()
    top = 0.98 if len(names) > 1 else 0.75
    figure.subplots_adjust(left=margin / width, bottom=margin / height, right=0.98, top=top)
    return figure


def _corner_legend(figure: Figure, posterior: Posterior, laplace: bool, fontsize: int) -> None:
    handles = [plt.Line2D([], [], color=COLOURS["mcmc"], lw=4, label=f"MCMC, {_levels()}")]
    if laplace:
        handles.append(plt.Line2D([], [], color=COLOURS["laplace"], lw=1.6, ls="--", label=f"Laplace, {_levels()}"))
    figure.legend(
        handles=handles,
        loc="upper right",
        bbox_to_anchor=(0.97, 0.97),
        frameon=False,
        fontsize=fontsize,
        title=_caveats(posterior) or None,
        title_fontsize=fontsize,
    )


def _chosen(names: Sequence[str] | None, every: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names to draw, checked."""
    if names is None:
        return every
    if isinstance(names, str) or not len(names):
        raise ValueError(f"names: {names!r} is not allowed; it must be a sequence of names, such as [{every[0]!r}].")
    for name in names:
        checks.one_of("names", name, every)
    if len(set(names)) < len(names):
        raise ValueError(f"names: {list(names)} is not allowed; a name is in it twice.")
    return tuple(names)


def _laplace(names: tuple[str, ...], fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (names,) and covariance (names, names) in natural values; NaN where there are none."""
    for name in names:
        checks.one_of("laplace", name, [*fit.theta, *fit.noise])
    theta, noise = [n for n in names if n in fit.theta], [n for n in names if n not in fit.theta]
    mean = np.array([fit.theta[n] if n in fit.theta else fit.joint_mode.get(n, np.nan) for n in names])
    covariance = pd.DataFrame(0.0, index=[*names], columns=[*names])
    covariance.loc[theta, theta] = fit.covariance.loc[theta, theta]
    modes = [fit.joint_mode.get(n, np.nan) for n in noise]
    covariance.loc[noise, noise] = fit.joint_covariance.reindex(noise, columns=noise) * np.outer(modes, modes)
    return mean, covariance.to_numpy()


def _laplace_on_corner(axes: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> None:
    variances = np.diag(covariance)
    drawn = np.flatnonzero(np.isfinite(mean) & np.isfinite(variances) & (variances > 0.0))
    for i in drawn:
        left, right = axes[i, i].get_xlim()
        x = np.linspace(left, right, 200)
        sd = np.sqrt(variances[i])
        density = np.exp(-0.5 * ((x - mean[i]) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes[i, i].plot(x, density, color=COLOURS["laplace"], lw=1.6, ls="--")
        axes[i, i].set_ylim(0.0, 1.1 * max(density.max(), axes[i, i].get_ylim()[1] / 1.1))
        for j in drawn[drawn < i]:
            sds = np.sqrt(variances[[j, i]])
            _ellipses(axes[i, j], mean[[j, i]], sds, covariance[i, j] / np.prod(sds))


def _ellipses(axes: Axes, centre: np.ndarray, sds: np.ndarray, correlation: float) -> None:
    """Draw the ellipses that hold the levels of a normal distribution of two quantities."""
    turn = np.linspace(0.0, 2 * np.pi, 200)
    across = np.cos(turn)
    up = correlation * across + np.sqrt(max(1.0 - correlation**2, 0.0)) * np.sin(turn)
    for level in LEVELS:
        radius = np.sqrt(-2.0 * np.log(1.0 - level))
        x, y = (c + radius * sd * wave for c, sd, wave in zip(centre, sds, (across, up), strict=True))
        axes.plot(x, y, color=COLOURS["laplace"], lw=1.4, ls="--", zorder=5)


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
        axes.set_ylabel(_wrapped(name, _unit(posterior, name)), fontsize=8)
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


def profile(profile: Profile, *, names: Sequence[str] | None = None, figure: Figure | None = None) -> Figure:
    """Draw each profile over the Laplace approximation's parabola, with the level that a 90 % interval reaches down to.

    Where the parabola leaves the profile, the standard deviation misleads; a profile that does not come down is named.
    Values over more than two decades have a logarithmic axis. A parabola without a finite standard deviation is left
    out.

    Parameters
    ----------
    profile : Profile
    names : sequence of str, optional
        Those to draw; by default all.
    figure : Figure, optional
        An empty figure to draw into.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For a name without a profile.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(50) / 50)
    >>> true = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                          frequency=0.1, samples=50)
    >>> run = bp.Experiment("run", 0.1, true.outputs, {"force": force}, samples=50)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.Normal(0.2, 0.1), "k": bp.Normal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5, "variance[displacement]": 0.01})
    >>> followed = bp.profile(problem, bp.map_estimate(problem, progress=False), ["k"])
    >>> figure = bp.plot.profile(followed)
    >>> figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    ('k [N/m]', 'relative log-density')
    """
    shown = profile.names if names is None else tuple(names)
    for name in shown:
        checks.one_of("names", name, profile.names)
    columns = min(len(shown), PROFILES_ACROSS)
    rows = -(-len(shown) // columns)
    figure = figure or plt.figure(figsize=(3.0 * columns + 0.8, 2.7 * rows + 0.6), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axes, name in zip(panels, shown, strict=False):
        _profile_panel(axes, profile, name)
    for axes in panels[len(shown) :]:
        axes.remove()
    for axes in panels[: len(shown) : columns]:
        axes.set_ylabel("relative log-density")
    drawn = {label: line for axes in figure.axes for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    legend = {label: drawn[label] for label in PROFILE_LEGEND if label in drawn}
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=len(legend), frameon=False)
    return figure


def _profile_panel(axes: Axes, profile: Profile, name: str) -> None:
    values, density = profile.values[name], profile.log_density[name]
    at, sd, found, bottom = profile.map[name], profile.sd[name], np.isfinite(density), DEEPEST - profile.improvement
    wide = values[0] > 0.0 and values[-1] > 100.0 * values[0]
    curve, peak, laplace, failed = PROFILE_LEGEND
    axes.plot(values[found], density[found], ".-", color=COLOURS["map"], lw=1.6, ms=5, label=curve)
    axes.plot(at, -profile.improvement, "o", color=COLOURS["map"], ms=6, label=peak)
    if np.isfinite(sd):
        x = np.geomspace(values[0], values[-1], 400) if wide else _laplace_range(profile, name)
        parabola = -profile.improvement - 0.5 * ((x - at) / sd) ** 2
        axes.plot(x, parabola, color=COLOURS["laplace"], lw=1.6, ls="--", zorder=1.5, label=laplace)
    if not found.all():
        low = np.full(np.sum(~found), 0.97 * bottom)
        axes.plot(values[~found], low, "x", color=COLOURS["measured"], ms=5, label=failed)
    axes.axhline(AT_90, color="grey", lw=0.8, ls=":", zorder=1)
    axes.annotate(
        "90%", (1, AT_90), (-3, 1), ("axes fraction", "data"), "offset points", color="grey", ha="right", va="bottom"
    )
    if profile.shape[name] != CLOSED:
        axes.annotate(profile.shape[name], (0.5, 0.03), xycoords="axes fraction", ha="center", va="bottom")
    if wide:
        axes.set_xscale("log")
    else:
        axes.locator_params(axis="x", nbins=3)
    axes.set_ylim(bottom, 0.35)
    axes.set_xlabel(_label(name, profile.units[name]))


def _laplace_range(profile: Profile, name: str) -> np.ndarray:
    """Return values as far as three standard deviations, where that is within the support and not far beyond."""
    values, reach, (low, high) = profile.values[name], 3.0 * profile.sd[name], profile.limits[name]
    margin = 0.5 * np.ptp(values)
    return np.linspace(
        min(values[0], max(low, values[0] - margin, profile.map[name] - reach)),
        max(values[-1], min(high, values[-1] + margin, profile.map[name] + reach)),
        400,
    )


def branch(
    branch: Branch,
    *more: Branch,
    measure: str | Callable[[PeriodicSolution], float | np.ndarray] = "amplitude",
    output: str | None = None,
    unit: str | None = None,
    labels: Sequence[str] | None = None,
    angular: bool = False,
    figure: Figure | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw branches of periodic solutions: stable parts solid, unstable ones dashed, folds and period doublings marked.

    Parameters
    ----------
    branch, *more : Branch
        Followed in the same quantity; each gets its own colour.
    measure : {"amplitude", "maximum", "section", "period"} or callable
        What is drawn of each solution. Of the output: half of its range, its largest value, or its values at
        tau = 0, 1, …, which tell an orbit of period p by p lines; or the response period; or a function of the
        solution that returns a number or an array (a line for each component). The turns of a rotating angle do not
        count.
    output : str, optional
        By default the first one.
    unit : str, optional
        That of what is drawn; by default the output's, or s for the period.
    labels : sequence of str, optional
        One for each branch, for the legend.
    angular : bool
        Show a frequency as the angular frequency in rad/s.
    figure : Figure, optional
        An empty figure to draw into.
    ax : Axes, optional
        Axes to draw into, instead.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown output or measure, branches followed in different quantities, or a wrong number of labels.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(50) / 50)
    >>> start = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                           frequency=0.1, samples=50, scheme="central4")
    >>> response = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, step=0.05, progress=False)
    >>> figure = bp.plot.branch(response)
    >>> figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    ('frequency [Hz]', 'amplitude of displacement [m]')
    """
    branches = (branch, *more)
    if len({b.vary for b in branches}) > 1:
        raise ValueError(f"more: {[b.vary for b in more]} is not allowed; all must vary {branch.vary!r}.")
    if labels is not None and len(labels) != len(branches):
        raise ValueError(f"labels: {len(labels)} are not allowed; there must be {len(branches)}, one for each branch.")
    output = next(iter(branch[0].outputs)) if output is None else output
    checks.one_of("output", output, branch[0].outputs)
    if not callable(measure):
        checks.one_of("measure", measure, MEASURES)
    if ax is None:
        ax = (figure or plt.figure(figsize=(7.0, 4.6), layout="constrained")).add_subplot()
    factor = 2 * np.pi if angular and branch.vary == "frequency" else 1.0
    for number, b in enumerate(branches):
        colour = ENSEMBLES[number % len(ENSEMBLES)]
        across, up = factor * b.values, _measures(b, measure, output)
        for stable, part in _runs(b):
            ax.plot(across[part], up[part], color=colour, lw=1.6, ls="-" if stable else "--", zorder=2 + stable)
        for kind, marker in MARKERS.items():
            at = np.array([k == kind for k in b.kinds])
            every = np.repeat(across[at], up.shape[1])
            ax.plot(every, up[at].ravel(), marker, color=colour, mfc="white", ms=6, mew=1.4, ls="none", zorder=4)
    ax.set_xlabel(
        "angular frequency [rad/s]" if factor != 1.0 else _label(branch.vary, branch.units.get(branch.vary, ""))
    )
    ax.set_ylabel(_measure_label(measure, output, branch.units.get(output, "") if unit is None else unit))
    ax.legend(handles=_branch_handles(branches, labels), frameon=False)
    return cast(Figure, ax.figure)


def _measures(branch: Branch, measure: str | Callable, output: str) -> np.ndarray:
    """Return what is drawn of a branch, (points, lines)."""
    if callable(measure):
        return np.array([np.ravel(measure(solution)) for solution in branch])
    if measure == "period":
        return np.array([[solution.period] for solution in branch])
    waves = np.array([solution.outputs[output] - _turns(solution, output) for solution in branch])
    if measure == "amplitude":
        return 0.5 * np.ptp(waves, axis=1, keepdims=True)
    if measure == "maximum":
        return waves.max(axis=1, keepdims=True)
    points = np.array([solution.outputs[output][:: solution.samples] for solution in branch])
    if np.any(_turns(branch[0], output)):
        points[0] = np.angle(np.exp(1j * points[0]))
        points = np.unwrap(points, axis=0)
    return points


def _turns(solution: PeriodicSolution, output: str) -> np.ndarray:
    """Return the steady advance of an output that is a rotating angle, zero for any other."""
    values = solution.outputs[output]
    for state, turns in solution.winding.items():
        if turns and np.ptp(values - solution.states[state]) < 1e-6:
            return 2 * np.pi * turns / solution.periods * solution.tau
    return np.zeros_like(values)


def _runs(branch: Branch) -> list[tuple[bool, slice]]:
    """Return the stretches of the branch that are stable or unstable, each from its first to its last point.

    A fold or a period doubling belongs to both neighbours; its own verdict is rounding.
    """
    plain = [None if kind else solution.stable for solution, kind in zip(branch, branch.kinds, strict=True)]
    between = [True in pair and False not in pair for pair in zip(plain[:-1], plain[1:], strict=True)]
    starts = [i for i in range(len(between)) if i == 0 or between[i] != between[i - 1]]
    return [
        (between[first], slice(first, last + 1))
        for first, last in zip(starts, [*starts[1:], len(between)], strict=True)
    ]


def _measure_label(measure: str | Callable, output: str, unit: str) -> str:
    if callable(measure):
        return _label(getattr(measure, "__name__", "measure").replace("_", " "), unit)
    if measure == "period":
        return "period [s]"
    return _label(f"{output} at tau = 0, 1, …" if measure == "section" else f"{measure} of {output}", unit)


def _branch_handles(branches: Sequence[Branch], labels: Sequence[str] | None) -> list[plt.Line2D]:
    handles = [
        plt.Line2D([], [], color=ENSEMBLES[number % len(ENSEMBLES)], lw=1.6, label=label)
        for number, label in enumerate(labels or [])
    ]
    for stable, style in ((True, "-"), (False, "--")):
        if any(stable == verdict for b in branches for verdict, _ in _runs(b)):
            name = "stable" if stable else "unstable"
            handles.append(plt.Line2D([], [], color="black", lw=1.6, ls=style, label=name))
    for kind, marker in MARKERS.items():
        if any(kind in b.kinds for b in branches):
            handles.append(plt.Line2D([], [], color="black", marker=marker, mfc="white", mew=1.4, ls="", label=kind))
    return handles


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
    return unit_of(posterior.data["posterior"].to_dataset(), name)


def _wrapped(name: str, unit: str) -> str:
    """Return a label of short lines, the unit on its own."""
    return _label(textwrap.fill(name, LABEL_LENGTH), unit).replace(" [", "\n[")


def _label(name: str, unit: str) -> str:
    text = name.replace("$", r"\$")
    return f"{text} [{unit}]" if unit else text
