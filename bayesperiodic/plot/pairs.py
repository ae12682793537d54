"""Figures of draws: all pairs and the marginal distributions, with the Laplace approximation."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from scipy.stats import norm

from bayesperiodic import _checks
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot import regions, style
from bayesperiodic.plot.style import (
    COLOURS,
    ENSEMBLES,
    LABEL_LENGTH,
    LAPLACE,
    SUPERSCRIPTS,
    caveats_of,
    chosen,
    draws_label,
    styled,
)
from bayesperiodic.problem.fingerprint import check_fingerprint, check_results
from bayesperiodic.problem.parameters import support
from bayesperiodic.sampling.draws import MODE, Posterior

LEVELS = (0.5, 0.9)
LEVELS_TEXT = "50 and 90 %"
MOST_NAMES = 8
# Panels of more names are smaller, and their labels have this size [points] and length.
MANY, SMALL, SHORT = 6, 7, 18
# Room between panels [inches]; part of an axis at each end without ticks, whose labels would touch those of the next.
ROOM, FREE = 0.06, 0.08
# Quantiles that a panel shows, and the margin around them; quantiles of titles.
SHOWN, MARGIN, TITLE = (0.003, 0.997), 0.06, (0.05, 0.5, 0.95)
BINS, TAILS = 40, (0.0005, 0.9995)
# Range of the powers of ten of ticks without an offset or a common factor.
WHOLE = (-5, 10)
TALLEST = 2.5
TRUTH: dict[str, Any] = {"color": COLOURS["measured"], "lw": 1.1}
PRIOR: dict[str, Any] = {"color": "0.35", "lw": 0.8, "ls": ":"}
ZERO: dict[str, Any] = {"color": "0.75", "lw": 0.8, "zorder": 0.5}


@styled
def corner(
    posterior: Posterior,
    *,
    laplace: MapEstimate | None = None,
    problem: Problem | None = None,
    names: Sequence[str] | None = None,
    truths: Mapping[str, float] | None = None,
    labels: Sequence[str] | None = None,
    quantiles: Sequence[float] = (),
    show_titles: bool = False,
    figure: Figure | None = None,
) -> Figure:
    """Draw all pairs of parameters, with the ellipses of the Laplace approximation on top.

    Regions contain 50 and 90 % of the draws, where their density is highest; ellipses have 50 and 90 % of the
    probability of the normal distribution. The density of the draws is a kernel estimate in sampling coordinates, each
    panel with its own resolution. The ellipses of parameters are those of `MapEstimate.covariance`. Those of noise
    parameters are v ± v·sd(ln v) around the mode in sampling coordinates, independent of the parameters. Quantities
    without a Laplace approximation have no ellipse. Where the draws belong to several optima, see `Posterior.modes`,
    each has its own regions and colour, and its number at the mean. A grey line marks zero where a panel contains it.

    Of the package corner (Foreman-Mackey, J. Open Source Softw. 1 (2016) 24) this has the layout and the arguments, so
    that its functions `overplot_points` and `overplot_lines` draw into the figure. It draws `Posterior.data` too.

    Parameters
    ----------
    posterior : Posterior
    laplace : MapEstimate, optional
    problem : Problem, optional
        Of the draws, whose priors are then drawn on the diagonal as thin lines.
    names : sequence of str, optional
        Full names such as "k", "theta16[run 7]" and "variance[force]", in the order of the rows; by default all.
    truths : mapping of str to float, optional
        Values to mark by lines, such as the parameters of simulated data.
    labels : sequence of str, optional
        Of the axes, one per name; by default names and units.
    quantiles : sequence of float
        To mark by dashed lines on the diagonal.
    show_titles : bool
        Write the median and the ends of the central 90 % interval above the diagonal.
    figure : Figure, optional

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        For an unknown name, an estimate or a problem of other draws, or a wrong number of labels.

    Warns
    -----
    UserWarning
        For more than eight quantities, unless they are chosen by `names`.

    Examples
    --------
    >>> figure = bp.plot.corner(posterior, laplace=fit, problem=problem, names=["c", "k"])
    >>> len(figure.axes), figure.axes[2].get_xlabel().splitlines()
    (4, ['c', '[N s/m]'])
    >>> import corner
    >>> same = corner.corner(posterior.data, var_names=["c", "k"])
    """
    _checks.instance("posterior", posterior, Posterior)
    if problem is not None:
        check_results(problem, posterior=posterior)
    if names is None and len(posterior.names) > MOST_NAMES:
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
    side = (1.9, 1.55, 1.25)[(len(names) > 3) + (len(names) > MANY)] * len(names) + 0.8
    figure = figure or plt.figure(figsize=(max(side, 3.2), max(side, 3.2)))
    if isinstance(figure, Figure):  # and no part of one
        figure.set_layout_engine("none")
    panels = _Panels.of(figure, posterior, names, dict(truths or {}))
    handles = [*panels.draw_draws(quantiles, show_titles)]
    if laplace is not None:
        handles += panels.draw_laplace(*normal_approximation(posterior, names, laplace))
    if problem is not None:
        handles += panels.draw_priors(problem)
    handles += panels.draw_lines()
    length = SHORT if len(names) > MANY else LABEL_LENGTH
    panels.write_labels([draws_label(posterior, name, length) for name in names] if labels is None else labels)
    panels.arrange(panels.write_legend(handles, caveats_of(posterior)))
    return figure


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
        draws = np.stack([posterior.draws(name) for name in names], axis=-1)
        ends = np.quantile(draws, SHOWN, axis=0).T
        for i, name in enumerate(names):
            if name in truths:
                ends[i] = min(ends[i, 0], truths[name]), max(ends[i, 1], truths[name])
        width = np.ptp(ends, axis=1)
        width[width == 0.0] = np.maximum(np.abs(ends[:, 0]), 1.0)[width == 0.0]
        limits = ends + MARGIN * np.stack([-width, width], axis=-1)
        grid = figure.subplots(len(names), len(names), squeeze=False)
        for (i, j), axes in np.ndenumerate(grid):
            axes.set_xlim(*limits[j])
            if j < i:
                axes.set_ylim(*limits[i])
            elif j > i:
                axes.set_axis_off()
        group = posterior.tree["posterior"].to_dataset()
        supports = [support(group, name) for name in names]
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
                own = self.draws[group.members][:, pair]
                draw_regions(axes, own, [self.supports[k] for k in pair], group.colour)
                if group.mark:
                    axes.plot(*own.mean(axis=0), marker=f"${group.mark}$", color="black", ms=6, zorder=6)
            for k, axes in enumerate(np.diag(self.grid)):
                found = regions.density(self.draws[group.members, k][:, None], [self.supports[k]])
                height = found.values * group.members.mean()
                axes.fill_between(found.nodes[0], height, color=group.colour, alpha=0.4, lw=0)
                axes.plot(found.nodes[0], height, color=group.colour, lw=1.4)
            look: dict[str, Any] = {"marker": f"${group.mark}$", "mec": "black", "mfc": "black"} if group.mark else {}
            yield plt.Line2D([], [], color=group.colour, lw=5, alpha=0.7, label=group.label, **look)
        for k, axes in enumerate(np.diag(self.grid)):
            axes.set_ylim(0.0, 1.08 * max(line.get_ydata().max() for line in axes.lines))
            for value in np.quantile(self.draws[:, k], [*quantiles]):
                axes.axvline(value, color="black", lw=0.8, ls="--")
            if show_titles:
                low, middle, high = np.quantile(self.draws[:, k], TITLE)
                axes.set_title(with_errors(low, middle, high))

    def draw_laplace(self, mean: np.ndarray, covariance: np.ndarray) -> Iterator[Any]:
        """Draw ellipses and densities of the normal distribution, and yield the entry of the legend."""
        variances = np.diag(covariance)
        known = np.isfinite(mean) & np.isfinite(variances) & (variances > 0.0)
        for k in np.flatnonzero(known).tolist():
            axes, sd = self.grid[k, k], np.sqrt(variances[k])
            x = np.union1d(self._across(k), np.linspace(mean[k] - 4.0 * sd, mean[k] + 4.0 * sd, 200))
            axes.plot(x, norm.pdf(x, mean[k], sd), **LAPLACE)
            highest = axes.get_ylim()[1]
            axes.set_ylim(0.0, min(max(highest, 1.08 * norm.pdf(0.0) / sd), TALLEST * highest))
        for axes, pair in self.pairs():
            if known[pair].all():
                draw_ellipses(axes, mean[pair], covariance[np.ix_(pair, pair)])
        yield plt.Line2D([], [], label=f"Laplace, {LEVELS_TEXT}", **LAPLACE)

    def draw_priors(self, problem: Problem) -> Iterator[Any]:
        """Draw the priors on the diagonal, and yield the entry of the legend."""
        for k, name in enumerate(self.names):
            if name in problem.joint_prior.marginals:
                x = self._across(k)
                density = np.exp(problem.joint_prior.marginals[name].log_prob(x))
                self.grid[k, k].plot(x, np.where(np.isfinite(density), density, np.nan), **PRIOR)
        yield plt.Line2D([], [], label="prior", **PRIOR)

    def draw_lines(self) -> Iterator[Any]:
        """Draw lines at zero and at the true values, and yield the entry of the legend."""
        for axes in np.diag(self.grid):
            axes.set_yticks([])
        for k, (low, high) in enumerate(self.limits):
            marks: list[tuple[float, dict[str, Any]]] = [(0.0, ZERO)] if low < 0.0 < high else []
            marks += [(self.truths[self.names[k]], TRUTH)] if self.names[k] in self.truths else []
            for value, look in marks:
                for i in range(k, len(self.names)):
                    self.grid[i, k].axvline(value, **look)
                for j in range(k):
                    self.grid[k, j].axhline(value, **look)
        if any(name in self.truths for name in self.names):
            yield plt.Line2D([], [], label="truth", **TRUTH)

    def write_labels(self, labels: Sequence[str]) -> None:
        """Write the names and the ticks at the left and the lower edge."""
        last, small = len(self.names) - 1, {"size": SMALL} if len(self.names) > MANY else {}
        for (i, j), axes in np.ndenumerate(self.grid):
            if j > i:
                continue
            for axis in (axes.xaxis, axes.yaxis) if j < i else (axes.xaxis,):
                _set_ticks(axis)
            axes.tick_params(axis="x", labelbottom=i == last, labelrotation=45)
            axes.tick_params(axis="y", labelleft=j == 0 and i > 0)
            plt.setp(axes.get_xticklabels(), ha="right", rotation_mode="anchor")
            for axis in (axes.xaxis, axes.yaxis):
                axis.get_offset_text().set_visible(False)
            if i == last:
                axes.set_xlabel(_with_factor(axes.xaxis, labels[j]), **small)
            if j == 0 and i > 0:
                axes.set_ylabel(_with_factor(axes.yaxis, labels[i]), **small)
        self.grid[0, 0].figure.align_labels()

    def write_legend(self, handles: list[Any], title: str) -> float:
        """Write the legend into the upper right corner, and return the height that it needs above a single panel."""
        figure = self.grid[0, 0].figure
        legend = figure.legend(handles=handles, title=title or None, loc="upper right", handlelength=1.4)
        return legend.get_window_extent().height if len(self.names) == 1 else 0.0

    def arrange(self, above: float) -> None:
        """Put panels of one size as closely as their labels allow; `above` is the height of the legend [pixels]."""
        figure, last = self.grid[0, 0].figure, len(self.names) - 1
        boxes = {place: (axes.get_tightbbox(), axes.bbox) for place, axes in np.ndenumerate(self.grid)}
        column, row = [boxes[i, 0] for i in range(last + 1)], [boxes[last, j] for j in range(last + 1)]
        left, bottom = (max(inner.p0[k] - outer.p0[k] for outer, inner in line) for k, line in enumerate((column, row)))
        outer, inner = boxes[0, 0]
        title, gap, (width, height) = outer.y1 - inner.y1, ROOM * figure.dpi, figure.bbox.size
        x, y = (left + 2.0 * gap) / width, (bottom + 2.0 * gap) / height
        top = 1.0 - (title + above + 2.0 * gap) / height
        each = [(1.0 - x - gap / width + gap / width) / (last + 1), (top - y + (title + gap) / height) / (last + 1)]
        for (i, j), axes in np.ndenumerate(self.grid):
            size = each[0] - gap / width, each[1] - (title + gap) / height
            axes.set_position((x + j * each[0], y + (last - i) * each[1], *size))


def _groups(posterior: Posterior) -> list[_Group]:
    """Return the draws of every optimum, or all if there is one."""
    table = posterior.modes
    if len(table) < 2:
        every = np.ones(posterior.draws(posterior.names[0]).size, dtype=bool)
        return [_Group(f"MCMC, {LEVELS_TEXT}", COLOURS["mcmc"], every)]
    mode = posterior.tree["sample_stats"].to_dataset()[MODE].to_numpy().ravel()
    label = "optimum {}: {:.1f} ± {:.1g} %"
    return [
        _Group(label.format(row, 100 * own["mass"], 100 * own["mcse_mass"]), colour, mode == row, str(row))
        for (row, own), colour in zip(table.iterrows(), cycle(ENSEMBLES), strict=False)
    ]


def draw_regions(axes: Axes, draws: np.ndarray, supports: list[regions.Support], colour: str) -> None:
    """Draw the regions that contain 50 and 90 % of the draws (n, 2)."""
    found = regions.density(draws, supports)
    half, most = found.levels(LEVELS)
    shown = found.values >= most
    crop = tuple(
        slice(max(np.flatnonzero(line)[0] - 2, 0), np.flatnonzero(line)[-1] + 3)
        for line in (shown.any(axis=1), shown.any(axis=0))
    )
    mesh = [values[crop] for values in (*found.nodes, found.values)]
    for level, opacity in ((most, 0.35), (half, 0.6)):
        axes.contourf(*mesh, levels=[level, np.inf], colors=[colour], alpha=opacity)
    axes.contour(*mesh, levels=[most, max(half, np.nextafter(most, np.inf))], colors=[colour], linewidths=0.9)


def draw_ellipses(axes: Axes, mean: np.ndarray, covariance: np.ndarray) -> None:
    """Draw the ellipses of the probability levels of a bivariate normal distribution."""
    sds = np.sqrt(np.diag(covariance))
    correlation = covariance[0, 1] / np.prod(sds)
    turn = np.linspace(0.0, 2 * np.pi, 200)
    across = np.cos(turn)
    up = correlation * across + np.sqrt(max(1.0 - correlation**2, 0.0)) * np.sin(turn)
    for level in LEVELS:
        radius = np.sqrt(-2.0 * np.log(1.0 - level))
        x, y = (m + radius * sd * wave for m, sd, wave in zip(mean, sds, (across, up), strict=True))
        axes.plot(x, y, zorder=5, **LAPLACE | {"lw": 1.2})


def with_errors(low: float, middle: float, high: float) -> str:
    """Return a value and the distances to the ends of an interval, to two digits of the shorter one."""
    shorter = min(high - middle, middle - low)
    digits = 1 - int(np.floor(np.log10(shorter))) if shorter > 0.0 else 4
    if digits < -3 or digits > 6:
        power = int(np.floor(np.log10(max(abs(middle), shorter))))
        scaled = [value / 10.0**power for value in (low, middle, high)]
        return rf"{with_errors(*scaled)} $\times\,10^{{{power}}}$"
    texts = [f"{round(value, digits) + 0.0:.{max(digits, 0)}f}" for value in (middle, high - middle, middle - low)]
    return rf"${texts[0]}^{{+{texts[1]}}}_{{-{texts[2]}}}$"


def _set_ticks(axis: Any) -> None:
    """Set two or three ticks, away from the ends, and write them without an offset."""
    low, high = axis.get_view_interval()
    room = FREE * (high - low)
    for count in (3, 4, 5, 7):
        ticks = MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(low, high)
        ticks = ticks[(ticks >= low + room) & (ticks <= high - room)]
        if len(ticks) > 1:
            break
    axis.set_ticks(ticks)
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_powerlimits(WHOLE)
    axis.set_major_formatter(formatter)


def _with_factor(axis: Any, label: str) -> str:
    """Return a label with the common factor of the ticks in its unit, because it would overlap the panels."""
    formatter = axis.get_major_formatter()
    formatter.set_locs(axis.get_majorticklocs().tolist())
    factor, (name, _, unit) = formatter.get_offset(), label.rpartition("\n[")
    if not factor:
        return label
    power = "10" + factor.removeprefix("1e").translate(SUPERSCRIPTS)
    return f"{name}\n[{power} {unit}" if name else f"{label}\n[{power}]"


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
        mean, covariance = normal_approximation(posterior, names, laplace)
        sd = np.sqrt(np.diag(covariance))
    columns, rows = style.panel_grid(len(names))
    figure = figure or plt.figure(figsize=(2.4 * columns + 0.4, 2.3 * rows + 0.6), layout="constrained")
    panels = style.panels(figure, len(names))
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        draws = posterior.draws(name)
        density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, TAILS)), density=True)
        style.draw_marginal(axes, edges, density, float(mean[i]), float(sd[i]))
        axes.set_xlabel(draws_label(posterior, name))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if text := caveats_of(posterior):
        figure.suptitle(text, x=0.99, ha="right", fontsize="medium")
    return figure
