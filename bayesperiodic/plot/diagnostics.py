"""Figures of calibrations, comparisons of Laplace with MCMC and of models, and profiles."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtri

from bayesperiodic import _checks
from bayesperiodic.diagnostics import calibration as uniformity
from bayesperiodic.diagnostics.calibration import CALIBRATED_METHODS, Calibration
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.model_comparison import DECISIVE, SMALLEST_GAIN, ModelComparison
from bayesperiodic.diagnostics.verdicts import ELLIPSOID_LEVELS, END_SHIFT, ERRORS, FINE
from bayesperiodic.estimation.profile import CLOSED, Profile
from bayesperiodic.plot import style
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, LAPLACE_STYLE, axis_label, chosen, styled, wrapped_label

BAND_LEVEL = 0.99
# Factor on the height of the histogram axes, for the legend.
HEADROOM = 1.45
RANK_TITLES = "count per bin / expected", "distribution function − diagonal", "coverage − probability"
RANK_AXES = *["position of the truth in the posterior"] * 2, "probability of the interval"
METHOD_LABELS = {"mcmc": "MCMC", "laplace": "Laplace"}
METHOD_LINES = {"mcmc": "-", "laplace": "--"}
BAND_STYLE: dict[str, Any] = {"color": "grey", "alpha": 0.25, "lw": 0}


@styled
def ranks(calibration: Calibration, *, figure: Figure | None = None) -> Figure:
    """Draw rank histograms, empirical distribution functions and coverage of every quantity, for MCMC and Laplace.

    One row per quantity. Left: histogram of the positions of the truth, flat if calibrated, with the 99 % band of each
    bin; a ∪ shape indicates intervals that are too narrow. Middle: distribution function minus the diagonal, with its
    simultaneous 99 % band. Right: coverage of central intervals minus their probability, with the pointwise 99 % band.

    Parameters
    ----------
    calibration : Calibration

    Examples
    --------
    >>> [axes.get_title() for axes in bp.plot.ranks(calibration).axes]
    ['count per bin / expected', 'distribution function − diagonal', 'coverage − probability']
    """
    _checks.instance("calibration", calibration, Calibration)
    names = calibration.names
    figure = figure or plt.figure(figsize=(10.5, 2.1 * len(names) + 1.0), layout="constrained")
    grid = figure.subplots(len(names), 3, squeeze=False)
    verdicts = calibration.table.set_index(["method", "quantity"])["verdict"]
    for row, name in zip(grid, names, strict=True):
        for method in CALIBRATED_METHODS:
            values = calibration.positions[method][name]
            values = np.sort(values[np.isfinite(values)])
            _histogram(row[0], values, method, f"{METHOD_LABELS[method]}: {verdicts[method, name]}")
            points, size = uniformity.evaluation_points(), values.size
            banded = method == CALIBRATED_METHODS[0] and size
            steps = np.searchsorted(values, points, side="right") / max(size, 1)
            _deviation(row[1], steps, uniformity.ecdf_band(size, BAND_LEVEL) if banded else None, method)
            covered = np.array([uniformity.coverage(values, level) for level in points])
            band = uniformity.binomial_band(size, points, 1.0 - BAND_LEVEL) if banded else None
            _deviation(row[2], covered, band, method)
        row[0].set(ylim=(0.0, HEADROOM * row[0].get_ylim()[1]), ylabel=wrapped_label(name, ""))
        row[0].legend(frameon=False, fontsize="small", loc="upper center")
    for top, bottom, title, label in zip(grid[0], grid[-1], RANK_TITLES, RANK_AXES, strict=True):
        top.set_title(title, fontsize="medium")
        bottom.set_xlabel(label)
    figure.suptitle(f"{calibration.replicates} synthetic campaigns; bands of 99 %", fontsize="medium")
    return figure


def _histogram(axes: Axes, values: np.ndarray, method: str, label: str) -> None:
    bins = uniformity.bin_count(values.size)
    counts, edges = np.histogram(values, bins, (0.0, 1.0))
    expected = max(values.size, 1) / bins
    if method == CALIBRATED_METHODS[0] and values.size:
        low, high = uniformity.binomial_band(values.size, np.array(1.0 / bins), 1.0 - BAND_LEVEL)
        axes.axhspan(float(low) * bins, float(high) * bins, **BAND_STYLE)
    axes.stairs(counts / expected, edges, color=COLOURS[method], ls=METHOD_LINES[method], lw=1.6, label=label)
    axes.set_xlim(0.0, 1.0)


def _deviation(axes: Axes, values: np.ndarray, band: tuple[np.ndarray, np.ndarray] | None, method: str) -> None:
    """Draw a function of the evaluation points minus the points themselves, with its band."""
    points = uniformity.evaluation_points()
    if band is not None:
        axes.fill_between(points, band[0] - points, band[1] - points, **BAND_STYLE)
    axes.plot(points, values - points, color=COLOURS[method], ls=METHOD_LINES[method], lw=1.4)
    axes.set_xlim(0.0, 1.0)


# Looks of several lines, in colours without another meaning.
LOOKS = [(colour, style) for style in ("-", "-.") for colour in ENSEMBLES if colour not in COLOURS.values()]
LIMIT = 4.0


@styled
def comparison(comparison: Comparison, *, names: Sequence[str] | None = None, figure: Figure | None = None) -> Figure:
    """Draw a comparison of Laplace with MCMC: marginals, quantile-quantile plot, and coverage of the ellipsoids.

    Quantiles are distances from the MAP in sds of the draws; the grey band is the tolerance of the ends of an interval.
    The legend names parameters with another verdict than "fine", at most six with the largest distances from Laplace.
    Ellipsoids are those of all coordinates, independent of `names`; their band is ± three Monte Carlo errors.

    Parameters
    ----------
    comparison : Comparison
    names : sequence of str, optional
        By default all.

    Examples
    --------
    >>> figure = bp.plot.comparison(bp.compare(problem, fit, posterior))
    >>> [axes.get_xlabel().splitlines()[0] for axes in figure.axes]
    ['c', 'k', 'Laplace quantile − MAP [posterior sd]', 'probability of the Laplace ellipsoid']
    """
    _checks.instance("comparison", comparison, Comparison)
    names = chosen(names, tuple(comparison.table.index))
    columns, rows = style.panel_grid(len(names))
    figure = figure or plt.figure(figsize=(max(2.4 * columns, 8.4), 2.5 * rows + 4.6), layout="constrained")
    top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[2.5 * rows + 0.4, 4.2])[:, 0]
    marginals = style.panels(top, len(names))
    for axes, name in zip(marginals, names, strict=True):
        about = comparison.table.loc[name].to_dict()
        style.draw_marginal(axes, comparison.edges[name], comparison.densities[name], about["map"], about["laplace_sd"])
        axes.set_title(about["verdict"], fontsize="medium")
        axes.set_xlabel(_coordinate_label(comparison, name))
    top.legend(*marginals[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if text := style.caveats(comparison.synthetic, comparison.converged):
        top.suptitle(text, x=0.99, ha="right", fontsize="medium")
    left, right = below.subplots(1, 2)
    _quantiles(left, comparison, names)
    _interval_coverage(right, comparison)
    return figure


def _coordinate_label(comparison: Comparison, name: str) -> str:
    coordinate, unit = str(comparison.table.loc[name, "coordinate"]), comparison.units[name]
    if coordinate == name or not unit:
        return wrapped_label(coordinate, unit)
    return f"{wrapped_label(coordinate, '')}\n(in {unit})"


def _quantiles(axes: Axes, comparison: Comparison, names: Sequence[str]) -> None:
    table = comparison.table.loc[[*names]]
    wrong = table[table["verdict"] != FINE].sort_values("wasserstein", ascending=False).index[: len(LOOKS)]
    axes.axline((0.0, 0.0), slope=1.0, color=COLOURS["laplace"], lw=1.4, ls="--")
    reach = np.array([-LIMIT, LIMIT])
    axes.fill_between(reach, reach - END_SHIFT, reach + END_SHIFT, **BAND_STYLE)
    unnamed = "fine" if set(table["verdict"]) == {FINE} or len(wrong) == sum(table["verdict"] != FINE) else "others"
    plain: dict[str, Any] = {"color": "black", "lw": 0.8, "label": unnamed}
    looks = {
        name: {"color": colour, "ls": dashes, "lw": 2.0, "label": axis_label(f"{name}: {table.loc[name, 'verdict']}")}
        for name, (colour, dashes) in zip(wrong, LOOKS, strict=False)
    }
    for name in [*table.index.difference(wrong, sort=False), *wrong]:
        line = table.loc[name]
        if np.isfinite(line["laplace_sd"]):
            across = ndtri(comparison.probabilities) * line["laplace_sd"] / line["sd"]
            axes.plot(across, (comparison.quantiles[name] - line["map"]) / line["sd"], **looks.get(name, plain))
    labels = {"xlabel": "Laplace quantile − MAP [posterior sd]", "ylabel": "MCMC quantile − MAP [posterior sd]"}
    axes.set(xlim=(-LIMIT, LIMIT), ylim=(-LIMIT, LIMIT), aspect="equal", **labels)
    handles = style.legend_entries(axes)
    axes.legend(handles.values(), handles.keys(), frameon=False, fontsize="small", loc="upper left")


def _interval_coverage(axes: Axes, comparison: Comparison) -> None:
    across, shares, errors = comparison.probabilities, comparison.shares, ERRORS * comparison.shares_mcse
    axes.plot([0.0, 1.0], [0.0, 1.0], color=COLOURS["laplace"], lw=1.4, ls="--", label="Laplace")
    axes.fill_between(across, shares - errors, shares + errors, color=COLOURS["mcmc"], alpha=0.45, lw=0)
    axes.plot(across, shares, color=COLOURS["mcmc"], lw=1.8, label="MCMC")
    axes.plot(ELLIPSOID_LEVELS, np.interp(ELLIPSOID_LEVELS, across, shares), "o", color=COLOURS["mcmc"], ms=6)
    labels = {"xlabel": "probability of the Laplace ellipsoid", "ylabel": "fraction of the draws inside"}
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal", **labels)
    verdict, k = comparison.joint["verdict"], comparison.joint["pareto_k"]
    axes.set_title(rf"jointly: {verdict}, $\hat{{k}}$ = {k:.2f}", fontsize="medium")
    axes.legend(frameon=False, fontsize="small", loc="upper left")


PROFILES_ACROSS = 3
PROFILE_LEGEND = ("profile", "MAP", "Laplace", "solve failed")
AT_90, DEEPEST = -0.5 * 1.6449**2, -4.2


@styled
def profile(profile: Profile, *, names: Sequence[str] | None = None, figure: Figure | None = None) -> Figure:
    """Draw each profile with the parabola of the Laplace approximation and the level of a 90 % interval.

    If the parabola departs from the profile, the standard deviation is misleading. Profiles that are not closed are
    labelled. Axes over more than two decades are logarithmic. Parabolas without a finite sd are omitted.

    Parameters
    ----------
    profile : Profile
    names : sequence of str, optional
        By default all.

    Examples
    --------
    >>> figure = bp.plot.profile(bp.profile(problem, fit, ["k"]))
    >>> figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    ('k [N/m]', 'relative log-density')
    """
    _checks.instance("profile", profile, Profile)
    shown = chosen(names, profile.names)
    columns, rows = style.panel_grid(len(shown), PROFILES_ACROSS)
    figure = figure or plt.figure(figsize=(3.0 * columns + 0.8, 2.7 * rows + 0.6), layout="constrained")
    for number, axes in enumerate(style.panels(figure, len(shown), PROFILES_ACROSS, sharey=True)):
        _profile_panel(axes, profile, shown[number])
        if number % columns == 0:
            axes.set_ylabel("relative log-density")
    drawn = style.legend_entries(*figure.axes)
    legend = {label: drawn[label] for label in PROFILE_LEGEND if label in drawn}
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=len(legend), frameon=False)
    return figure


def _profile_panel(axes: Axes, profile: Profile, name: str) -> None:
    values, density = profile.values[name], profile.log_density[name]
    at, sd, solved, bottom = profile.map[name], profile.sd[name], np.isfinite(density), DEEPEST - profile.improvement
    wide = values[0] > 0.0 and values[-1] > 100.0 * values[0]
    curve, peak, laplace, failed = PROFILE_LEGEND
    axes.plot(values[solved], density[solved], ".-", color=COLOURS["map"], lw=1.6, ms=5, label=curve)
    axes.plot(at, -profile.improvement, "o", color=COLOURS["map"], ms=6, label=peak)
    if np.isfinite(sd):
        x = np.geomspace(values[0], values[-1], 400) if wide else _laplace_range(profile, name)
        parabola = -profile.improvement - 0.5 * ((x - at) / sd) ** 2
        axes.plot(x, parabola, zorder=1.5, label=laplace, **LAPLACE_STYLE)
    if not solved.all():
        low = np.full(np.sum(~solved), 0.97 * bottom)
        axes.plot(values[~solved], low, "x", color=COLOURS["measured"], ms=5, label=failed)
    axes.axhline(AT_90, color="grey", lw=0.8, ls=":", zorder=1)
    places = ("axes fraction", "data"), "offset points"
    axes.annotate("90 %", (1, AT_90), (-3, 1), *places, color="grey", ha="right", va="bottom")
    if profile.shape[name] != CLOSED:
        axes.annotate(profile.shape[name], (0.5, 0.03), xycoords="axes fraction", ha="center", va="bottom")
    if wide:
        axes.set_xscale("log")
    else:
        axes.locator_params(axis="x", nbins=3)
    axes.set(ylim=(bottom, 0.35), xlabel=axis_label(name, profile.units[name]))


def _laplace_range(profile: Profile, name: str) -> np.ndarray:
    """Return values within three standard deviations, limited by the support and half the drawn range beyond it."""
    at, reach, (low, high) = profile.map[name], 3.0 * profile.sd[name], profile.limits[name]
    first, last = profile.values[name][[0, -1]]
    margin = 0.5 * (last - first)
    start = min(first, max(low, first - margin, at - reach))
    return np.linspace(start, max(last, min(high, last + margin, at + reach)), 400)


@styled
def models(comparison: ModelComparison, *, figure: Figure | None = None) -> Figure:
    """Draw a comparison of models: differences of evidence, leave-one-out prediction and held-out experiments.

    One row per model, relative to the first. Bars are two standard errors, small circles single experiments. Outside
    the grey band a difference can decide: a probability above 95 %, or an ELPD difference above 4 that also exceeds its
    bar.

    Parameters
    ----------
    comparison : ModelComparison

    Examples
    --------
    >>> [axes.get_title() for axes in bp.plot.models(bp.compare_models(springs)).axes]
    ['evidence', 'one value left out', 'one experiment left out']
    """
    _checks.instance("comparison", comparison, ModelComparison)
    table, runs = comparison.table, comparison.experiments
    figure = figure or plt.figure(figsize=(10.5, 0.55 * len(table) + 1.8), layout="constrained")
    change = table["log_evidence"] - table["log_evidence"].iloc[0]
    error = np.hypot(table["log_evidence_error"], table["log_evidence_error"].iloc[0]) * (change != 0.0)
    one, several = ((table[f"{name}_difference"], table[f"{name}_difference_se"]) for name in ("elpd", "held_out"))
    panels = (
        ("evidence", "log evidence − that of the first", change, error, DECISIVE),
        ("one value left out", "ELPD − that of the first", *one, SMALLEST_GAIN),
        ("one experiment left out", "sum of ELPD − that of the first", *several, SMALLEST_GAIN),
    )
    rows = np.arange(len(table))
    for axes, (title, label, values, errors, band) in zip(figure.subplots(1, 3, sharey=True), panels, strict=True):
        axes.axvspan(-band, band, **BAND_STYLE)
        axes.axvline(0.0, color="grey", lw=0.8)
        axes.errorbar(values, rows, xerr=2.0 * errors, fmt="o", color=COLOURS["measured"], ms=5, capsize=3)
        axes.set(xlabel=label, ylim=(len(table) - 0.5, -0.5))
        axes.set_title(title, fontsize="medium")
        if np.isnan(np.asarray(values, dtype=float)).all():
            axes.annotate("not available", (0.5, 0.5), xycoords="axes fraction", ha="center", va="center")
    single = runs.pivot(index="model", columns="experiment", values="elpd").reindex(table.index)
    for _, differences in (single - single.iloc[0]).items():
        figure.axes[2].plot(differences, rows + 0.2, "o", color=COLOURS["mcmc"], ms=4, mfc="none", zorder=1)
    names = [wrapped_label(str(name), "") for name in table.index]
    chances = ["" if np.isnan(p) else f"\nprobability {p:.2g}" for p in table["probability"]]
    figure.axes[0].set_yticks(rows, [f"{name}{chance}" for name, chance in zip(names, chances, strict=True)])
    subject = wrapped_label(f"verdict on {table.index[0]}: {table['verdict'].iloc[0]}", "").replace("\n", " ")
    figure.suptitle(f"{subject}{', synthetic data' * comparison.synthetic}", fontsize="medium")
    return figure
