"""Figures of draws: all pairs and the marginal distributions, with the Laplace approximation."""

import inspect
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm

from bayesperiodic import _checks
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot import regions
from bayesperiodic.plot.grid import MANY_NAMES, arrange, interval_title, write_labels, write_legend
from bayesperiodic.plot.histograms import CORNER_OPTIONS, draw_histograms
from bayesperiodic.plot.style import (
    COLOURS,
    ENSEMBLES,
    LABEL_LENGTH,
    LAPLACE_STYLE,
    caveats_of,
    chosen,
    draw_marginal,
    draws_label,
    kind_of,
    panel_grid,
    panels,
    styled,
)
from bayesperiodic.problem.fingerprint import check_fingerprint, check_results
from bayesperiodic.problem.parameters import support
from bayesperiodic.sampling.draws import MODE, Posterior
from bayesperiodic.sampling.population_result import Population

REGION_LEVELS = (0.5, 0.9)
LEVELS_TEXT = "50 and 90 %"
MOST_NAMES_DRAWN = 8
# Length of the labels of many small panels.
SHORT_LABEL_LENGTH = 18
# Quantiles that a panel shows, and the margin around them.
PANEL_QUANTILES, PANEL_MARGIN = (0.003, 0.997), 0.06
BINS, HISTOGRAM_QUANTILES = 40, (0.0005, 0.9995)
TALLEST_LAPLACE = 2.5
PALE = 0.5
PALE_STYLE: dict[str, Any] = {"color": COLOURS["map"], "lw": 0.9, "alpha": PALE}
TRUTH_STYLE: dict[str, Any] = {"color": COLOURS["measured"], "lw": 1.1}
PRIOR_STYLE: dict[str, Any] = {"color": "0.35", "lw": 0.8, "ls": ":"}
ZERO_STYLE: dict[str, Any] = {"color": "0.75", "lw": 0.8, "zorder": 0.5}


@styled
def corner(
    posterior: Posterior | Population,
    *,
    laplace: MapEstimate | None = None,
    problem: Problem | None = None,
    names: Sequence[str] | None = None,
    truths: Mapping[str, float] | None = None,
    labels: Sequence[str] | None = None,
    quantiles: Sequence[float] = (),
    show_titles: bool = False,
    figure: Figure | None = None,
    style: str = "regions",
    **options: Any,
) -> Figure:
    """Draw all pairs of parameters, with the ellipses of the Laplace approximation on top.

    Regions contain 50 and 90 % of the draws, where their density is highest; ellipses have 50 and 90 % of the
    probability of the normal distribution. The density of the draws is a kernel estimate in sampling coordinates, each
    panel with its own resolution. The ellipses of parameters are those of `MapEstimate.covariance`. Those of noise
    parameters are v ± v·sd(ln v) around the mode in sampling coordinates, independent of the parameters. Quantities
    without a Laplace approximation have no ellipse. Where the draws belong to several optima, see `Posterior.modes`,
    each has its own regions and colour, and its number at the mean. A grey line marks zero where a panel contains it.

    If the model is misspecified at the estimate from which was sampled, regions and densities are those of the robust
    draws (`Posterior.headline`); those of the draws, which take the error of the model for independent noise,
    are pale lines beside them, and so is the Laplace approximation.

    With style="corner" the package corner (Foreman-Mackey, J. Open Source Softw. 1 (2016) 24) draws histograms of all
    draws and contours of two-dimensional histograms, by default at its levels of 12, 39, 68 and 86 %. Several
    posteriors are drawn into one figure by `figure`, each in its own colour. The functions `overplot_points` and
    `overplot_lines` of corner draw into figures of both styles.

    Parameters
    ----------
    posterior : Posterior or Population
        Of a population, the draws of its parameters, see `Population.labels`.
    laplace : MapEstimate, optional
        For style="regions" only; not for a population.
    problem : Problem, optional
        Of the draws, whose priors are then drawn on the diagonal as thin lines; for style="regions" only; not for a
        population.
    names : sequence of str, optional
        Full names such as "k", "theta16[run 7]" and "variance[force]", or "spread[k]" of a population, in the order of
        the rows; by default all.
    truths : mapping of str to float, optional
        Values to mark by lines, such as the parameters of simulated data.
    labels : sequence of str, optional
        Of the axes, one per name; by default names and units.
    quantiles : sequence of float
        To mark by dashed lines on the diagonal.
    show_titles : bool
        Write the median and the ends of the central 90 % interval above the diagonal; of several posteriors, those of
        the last one.
    figure : Figure, optional
        Without axes, or with style="corner" one of the same quantities, which is drawn over.
    style : {"regions", "corner"}
    **options
        Of ``corner.corner``, for style="corner" only: bins, color, contour_kwargs, contourf_kwargs, data_kwargs, fig
        (the same as `figure`), fill_contours, hist_bin_factor, hist_kwargs, levels, no_fill_contours, pcolor_kwargs,
        plot_contours, plot_datapoints, plot_density, range, scale_hist, smooth, smooth1d, title_fmt, title_kwargs,
        title_quantiles, titles, truth_color. The label in `hist_kwargs` is that of the legend.

    Raises
    ------
    ValueError
        For an unknown name, an estimate or a problem of other draws, a wrong number of labels, or an option of the
        other style.

    Warns
    -----
    UserWarning
        For more than eight quantities, unless they are chosen by `names`.

    Examples
    --------
    >>> figure = bp.plot.corner(posterior, laplace=fit, problem=problem, names=["c", "k"])
    >>> len(figure.axes), figure.axes[2].get_xlabel().splitlines()
    (4, ['c', '[N s/m]'])
    >>> first = bp.plot.corner(posterior, style="corner", names=["c", "k"], bins=30, show_titles=True)
    >>> both = bp.plot.corner(posterior, style="corner", names=["c", "k"], figure=first)
    >>> units, spread = dict.fromkeys(["1", "2", "3"], posterior), {"k": bp.HalfNormal(0.01)}
    >>> springs = bp.population(units, ["k"], spread=spread, seed=1, progress=False)
    >>> len(bp.plot.corner(springs).axes)
    4
    """
    _check_style(style, {"laplace": laplace, "problem": problem}, options)
    if isinstance(posterior, Population):
        posterior = _of_population(posterior, {"laplace": laplace, "problem": problem})
    _checks.instance("posterior", posterior, Posterior)
    if problem is not None:
        check_results(problem, posterior=posterior)
    if names is None and len(posterior.names) > MOST_NAMES_DRAWN:
        warnings.warn(
            f"names: {len(posterior.names)} quantities are many for one figure; choose some, such as "
            f"names={list(posterior.names[:3])}.",
            stacklevel=3,
        )
    names = chosen(names, posterior.names)
    for name in _checks.mapping("truths", truths or {}, "{'k': 1.0}"):
        _checks.one_of("truths", name, posterior.names)
    if labels is not None and len(labels) != len(names):
        raise ValueError(f"labels: must be {len(names)}, one per name, got {len(labels)}.")
    if not all(0.0 < q < 1.0 for q in quantiles):
        raise ValueError(f"quantiles: must be between 0 and 1, got {list(quantiles)}.")
    side = (1.9, 1.55, 1.25)[(len(names) > 3) + (len(names) > MANY_NAMES)] * len(names) + 0.8
    figure = options.pop("fig", None) or figure or plt.figure(figsize=(max(side, 3.2), max(side, 3.2)))
    if isinstance(figure, Figure):  # and no part of one
        figure.set_layout_engine("none")
    length = SHORT_LABEL_LENGTH if len(names) > MANY_NAMES else LABEL_LENGTH
    labels = [draws_label(posterior, name, length) for name in names] if labels is None else labels
    if style == "corner":
        options |= {"quantiles": [*quantiles], "show_titles": show_titles}
        draw_histograms(figure, posterior, dict(zip(names, labels, strict=True)), truths or {}, options)
        return figure
    drawn = _Panels.of(figure, posterior, names, dict(truths or {}))
    handles = [*drawn.draw_draws(quantiles, show_titles)]
    if posterior.headline is not posterior:
        handles += drawn.draw_pale(np.stack([posterior.draws(name) for name in names], axis=-1))
    if laplace is not None:
        look = LAPLACE_STYLE | ({"alpha": PALE} if laplace.misspecified else {})
        handles += drawn.draw_laplace(*normal_approximation(posterior, names, laplace), look)
    if problem is not None:
        handles += drawn.draw_priors(problem)
    handles += drawn.draw_lines()
    write_labels(drawn.grid, labels)
    arrange(drawn.grid, write_legend(drawn.grid, handles, caveats_of(posterior)))
    return figure


def _of_population(result: Population, of_problems: Mapping[str, Any]) -> Posterior:
    """Return the draws of a population's parameters as a figure takes them."""
    for name, value in of_problems.items():
        if value is not None:
            raise ValueError(f"{name}: must be None for a Population, which has none, got {type(value).__name__}.")
    groups = {"posterior": result.tree["posterior"].to_dataset(), "sample_stats": xr.Dataset()}
    return Posterior(
        xr.DataTree.from_dict(groups), result.converged, result.reason, result.tau, ess={}, rhat={},
        acceptance=np.nan, failures={}, log_posterior_calls=result.calls, seed=result.seed,
    )  # fmt: skip


def _check_style(style: str, of_regions: Mapping[str, Any], options: Mapping[str, Any]) -> None:
    """Raise a ValueError for an unknown style or option, or for options of the other style."""
    _checks.one_of("style", style, ("regions", "corner"))
    known = [name for name in inspect.signature(corner).parameters if name != "options"]
    for name in options:
        _checks.one_of("options", name, [*known, *CORNER_OPTIONS])
    other = [*options] if style == "regions" else [name for name, value in of_regions.items() if value is not None]
    if other:
        required = "corner" if style == "regions" else "regions"
        raise ValueError(f"style: must be {required!r} for the options {', '.join(other)}, got {style!r}.")


@dataclass(frozen=True)
class _Group:
    """Draws of one mode, or all draws."""

    label: str
    colour: str
    members: np.ndarray
    mark: str = ""


@dataclass(frozen=True)
class _Panels:
    """Panels of a corner plot; `limits` are those of every quantity, (names, 2)."""

    grid: np.ndarray
    names: tuple[str, ...]
    draws: np.ndarray
    supports: list[regions.Support]
    limits: np.ndarray
    truths: dict[str, float]
    groups: list[_Group]

    @classmethod
    def of(cls, figure: Figure, posterior: Posterior, names: tuple[str, ...], truths: dict[str, float]) -> "_Panels":
        """Return the empty panels, with their limits."""
        draws = np.stack([posterior.headline.draws(name) for name in names], axis=-1)
        ends = np.quantile(draws, PANEL_QUANTILES, axis=0).T
        for i, name in enumerate(names):
            if name in truths:
                ends[i] = min(ends[i, 0], truths[name]), max(ends[i, 1], truths[name])
        width = np.ptp(ends, axis=1)
        width[width == 0.0] = np.maximum(np.abs(ends[:, 0]), 1.0)[width == 0.0]
        limits = ends + PANEL_MARGIN * np.stack([-width, width], axis=-1)
        grid = figure.subplots(len(names), len(names), squeeze=False)
        for (i, j), axes in np.ndenumerate(grid):
            axes.set_xlim(*limits[j])
            if j < i:
                axes.set_ylim(*limits[i])
            elif j > i:
                axes.set_axis_off()
        supports = [support(posterior.tree["posterior"].to_dataset(), name) for name in names]
        return cls(grid, names, draws, supports, limits, truths, _groups(posterior))

    def pairs(self) -> Iterator[tuple[Axes, list[int]]]:
        """Yield the panels below the diagonal, with the indices across and up."""
        for j, i in combinations(range(len(self.names)), 2):
            yield self.grid[i, j], [j, i]

    def _across(self, k: int) -> np.ndarray:
        return np.linspace(self.limits[k, 0], self.limits[k, 1], 400)

    def draw_draws(self, quantiles: Sequence[float], show_titles: bool) -> Iterator[Any]:
        """Draw regions and densities of all groups, and yield the entries of the legend."""
        for group in self.groups:
            for axes, pair in self.pairs():
                points = self.draws[group.members][:, pair]
                draw_regions(axes, points, [self.supports[k] for k in pair], group.colour)
                if group.mark:
                    axes.plot(*points.mean(axis=0), marker=f"${group.mark}$", color="black", ms=6, zorder=6)
            for k, axes in enumerate(np.diag(self.grid)):
                estimate = regions.density(self.draws[group.members, k][:, None], [self.supports[k]])
                height = estimate.values * group.members.mean()
                axes.fill_between(estimate.nodes[0], height, color=group.colour, alpha=0.4, lw=0)
                axes.plot(estimate.nodes[0], height, color=group.colour, lw=1.4)
            look: dict[str, Any] = {"marker": f"${group.mark}$", "mec": "black", "mfc": "black"} if group.mark else {}
            yield plt.Line2D([], [], color=group.colour, lw=5, alpha=0.7, label=group.label, **look)
        for k, axes in enumerate(np.diag(self.grid)):
            axes.set_ylim(0.0, 1.08 * max(line.get_ydata().max() for line in axes.lines))
            for value in np.quantile(self.draws[:, k], [*quantiles]):
                axes.axvline(value, color="black", lw=0.8, ls="--")
            if show_titles:
                axes.set_title(interval_title(self.draws[:, k]))

    def draw_pale(self, draws: np.ndarray) -> Iterator[Any]:
        """Draw outlines of the regions of draws whose intervals are not valid, and yield the entry of the legend."""
        for axes, pair in self.pairs():
            estimate = regions.density(draws[:, pair], [self.supports[k] for k in pair])
            half, most = estimate.levels(REGION_LEVELS)
            look = {"colors": [PALE_STYLE["color"]], "linewidths": PALE_STYLE["lw"], "alpha": PALE, "zorder": 4}
            axes.contour(*estimate.nodes, estimate.values, levels=[most, max(half, np.nextafter(most, np.inf))], **look)
        for k, axes in enumerate(np.diag(self.grid)):
            estimate, highest = regions.density(draws[:, k][:, None], [self.supports[k]]), axes.get_ylim()[1]
            axes.plot(estimate.nodes[0], estimate.values, **PALE_STYLE)
            axes.set_ylim(0.0, min(max(highest, 1.08 * estimate.values.max()), TALLEST_LAPLACE * highest))
        yield plt.Line2D([], [], label="MCMC, model taken for right", **PALE_STYLE)

    def draw_laplace(self, mean: np.ndarray, covariance: np.ndarray, look: Mapping[str, Any]) -> Iterator[Any]:
        """Draw ellipses and densities of the normal distribution, and yield the entry of the legend."""
        variances = np.diag(covariance)
        known = np.isfinite(mean) & np.isfinite(variances) & (variances > 0.0)
        for k in np.flatnonzero(known).tolist():
            axes, sd = self.grid[k, k], np.sqrt(variances[k])
            x = np.union1d(self._across(k), np.linspace(mean[k] - 4.0 * sd, mean[k] + 4.0 * sd, 200))
            axes.plot(x, norm.pdf(x, mean[k], sd), **look)
            highest = axes.get_ylim()[1]
            axes.set_ylim(0.0, min(max(highest, 1.08 * norm.pdf(0.0) / sd), TALLEST_LAPLACE * highest))
        for axes, pair in self.pairs():
            if known[pair].all():
                draw_ellipses(axes, mean[pair], covariance[np.ix_(pair, pair)], look)
        yield plt.Line2D([], [], label=f"Laplace, {LEVELS_TEXT}", **look)

    def draw_priors(self, problem: Problem) -> Iterator[Any]:
        """Draw the priors on the diagonal, and yield the entry of the legend."""
        for k, name in enumerate(self.names):
            if name in problem.joint_prior.marginals:
                x = self._across(k)
                density = np.exp(problem.joint_prior.marginals[name].log_prob(x))
                self.grid[k, k].plot(x, np.where(np.isfinite(density), density, np.nan), **PRIOR_STYLE)
        yield plt.Line2D([], [], label="prior", **PRIOR_STYLE)

    def draw_lines(self) -> Iterator[Any]:
        """Draw lines at zero and at the true values, and yield the entry of the legend."""
        for axes in np.diag(self.grid):
            axes.set_yticks([])
        for k, (low, high) in enumerate(self.limits):
            marks: list[tuple[float, dict[str, Any]]] = [(0.0, ZERO_STYLE)] if low < 0.0 < high else []
            marks += [(self.truths[self.names[k]], TRUTH_STYLE)] if self.names[k] in self.truths else []
            for value, look in marks:
                for i in range(k, len(self.names)):
                    self.grid[i, k].axvline(value, **look)
                for j in range(k):
                    self.grid[k, j].axhline(value, **look)
        if any(name in self.truths for name in self.names):
            yield plt.Line2D([], [], label="truth", **TRUTH_STYLE)


def _groups(posterior: Posterior) -> list[_Group]:
    """Return the draws of every optimum, or all if there is one."""
    table = posterior.modes
    if len(table) < 2:
        every = np.ones(posterior.draws(posterior.names[0]).size, dtype=bool)
        return [_Group(f"{kind_of(posterior)}, {LEVELS_TEXT}", COLOURS["mcmc"], every)]
    mode = posterior.tree["sample_stats"].to_dataset()[MODE].to_numpy().ravel()
    label = "optimum {}: {:.1f} ± {:.1g} %"
    return [
        _Group(label.format(row, 100 * optimum["mass"], 100 * optimum["mcse_mass"]), colour, mode == row, str(row))
        for (row, optimum), colour in zip(table.iterrows(), cycle(ENSEMBLES), strict=False)
    ]


def draw_regions(axes: Axes, draws: np.ndarray, supports: list[regions.Support], colour: str) -> None:
    """Draw the regions that contain 50 and 90 % of the draws (n, 2)."""
    estimate = regions.density(draws, supports)
    half, most = estimate.levels(REGION_LEVELS)
    shown = estimate.values >= most
    crop = tuple(
        slice(max(np.flatnonzero(line)[0] - 2, 0), np.flatnonzero(line)[-1] + 3)
        for line in (shown.any(axis=1), shown.any(axis=0))
    )
    mesh = [values[crop] for values in (*estimate.nodes, estimate.values)]
    for level, opacity in ((most, 0.35), (half, 0.6)):
        axes.contourf(*mesh, levels=[level, np.inf], colors=[colour], alpha=opacity)
    axes.contour(*mesh, levels=[most, max(half, np.nextafter(most, np.inf))], colors=[colour], linewidths=0.9)


def draw_ellipses(
    axes: Axes, mean: np.ndarray, covariance: np.ndarray, look: Mapping[str, Any] = LAPLACE_STYLE
) -> None:
    """Draw the ellipses of the probability levels of a bivariate normal distribution."""
    sds = np.sqrt(np.diag(covariance))
    correlation = covariance[0, 1] / np.prod(sds)
    turn = np.linspace(0.0, 2 * np.pi, 200)
    up = correlation * np.cos(turn) + np.sqrt(max(1.0 - correlation**2, 0.0)) * np.sin(turn)
    circle = sds * np.column_stack([np.cos(turn), up])
    for level in REGION_LEVELS:
        axes.plot(*(mean + np.sqrt(-2.0 * np.log(1.0 - level)) * circle).T, zorder=5, **{**look, "lw": 1.2})


def normal_approximation(
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


@styled
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
        mean, covariance = normal_approximation(posterior, names, laplace)
        sd = np.sqrt(np.diag(covariance))
    columns, rows = panel_grid(len(names))
    figure = figure or plt.figure(figsize=(2.4 * columns + 0.4, 2.3 * rows + 0.6), layout="constrained")
    grid = panels(figure, len(names))
    for i, (axes, name) in enumerate(zip(grid, names, strict=True)):
        draws = posterior.draws(name)
        density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, HISTOGRAM_QUANTILES)), density=True)
        draw_marginal(axes, edges, density, float(mean[i]), float(sd[i]))
        axes.set_xlabel(draws_label(posterior, name))
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if text := caveats_of(posterior):
        figure.suptitle(text, x=0.99, ha="right", fontsize="medium")
    return figure
