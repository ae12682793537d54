"""Figures of posterior draws: corner plot, marginals and traces, with the Laplace approximation."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import ScalarFormatter
from scipy.stats import norm

from bayesperiodic import _checks
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, caveats_of, unit_of, wrapped_label
from bayesperiodic.sampling.posterior import Posterior

LEVELS = (0.5, 0.9)
FEWEST_BINS, MOST_BINS = 35, 200
# Range of the powers of ten of ticks without an offset or a common factor.
WHOLE = (-5, 10)


def corner(
    posterior: Posterior,
    *,
    laplace: MapEstimate | None = None,
    names: Sequence[str] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw all pairs of parameters, with the ellipses of the Laplace approximation on top.

    Contours and ellipses contain 50 and 90 % of the probability. The ellipses of parameters are those of
    `MapEstimate.covariance`. Those of noise parameters are v ± v·sd(ln v) around the mode in sampling coordinates,
    independent of the parameters. Quantities without a Laplace approximation have no ellipse.

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

    Examples
    --------
    >>> figure = bp.plot.corner(posterior, laplace=fit, names=["c", "k"])
    >>> len(figure.axes), figure.axes[2].get_xlabel().splitlines()
    (4, ['c', '[N s/m]'])
    """
    import corner as corner_package

    names = chosen(names, posterior.names)
    draws = np.stack([posterior.draws(name) for name in names], axis=-1)
    span = [tuple(np.quantile(draws[:, i], [0.0005, 0.9995])) for i in range(len(names))]
    titles = [wrapped_label(name, unit_of(posterior, name)) for name in names]
    bins = _bins(draws)
    margin = 0.9 + 0.17 * max(title.count("\n") for title in titles)
    size = 1.75 * len(names) + margin + 0.2
    figure = corner_package.corner(
        draws,
        labels=titles,
        levels=LEVELS,
        range=span,
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
        fig=figure or plt.figure(figsize=(size, size)),
    )
    _write_out_ticks(figure)
    if laplace is not None:
        mean, covariance = normal_approximation(names, laplace)
        _laplace_on_corner(np.array(figure.axes).reshape(len(names), len(names)), mean, covariance)
    _corner_legend(figure, posterior, laplace is not None, min(14, 4 * max(len(names), 2)))
    width, height = figure.get_size_inches()
    top = 0.98 if len(names) > 1 else 0.75
    figure.subplots_adjust(left=margin / width, bottom=margin / height, right=0.98, top=top)
    return figure


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
        title=caveats_of(posterior) or None,
        title_fontsize=fontsize,
    )


def chosen(names: Sequence[str] | None, every: tuple[str, ...], argument: str = "names") -> tuple[str, ...]:
    """Return the validated names to draw, by default all."""
    if names is None:
        return every
    if isinstance(names, str) or not len(names):
        raise ValueError(f"{argument}: must be a sequence of names, such as [{every[0]!r}], got {names!r}.")
    for name in names:
        _checks.one_of(argument, name, every)
    if len(set(names)) < len(names):
        raise ValueError(f"{argument}: must be different names, got {list(names)}.")
    return tuple(names)


def normal_approximation(names: tuple[str, ...], fit: MapEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (names,) and covariance (names, names) in natural values; NaN if undefined."""
    _checks.contains("laplace", [*fit.theta, *fit.noise], names, "give an estimate of the same problem")
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
        density = norm.pdf(x, mean[i], np.sqrt(variances[i]))
        axes[i, i].plot(x, density, color=COLOURS["laplace"], lw=1.6, ls="--")
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


def _levels() -> str:
    return " and ".join(f"{level:.0%}" for level in LEVELS)


ACROSS, BINS, SHOWN = 4, 40, (0.0005, 0.9995)


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
        Full names such as "k", "theta16[run 7]" and "variance[force]"; by default all.
    figure : Figure, optional
        An empty figure to draw into.

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
    names = chosen(names, posterior.names)
    mean, sd = np.full((2, len(names)), np.nan)
    if laplace is not None:
        mean, covariance = normal_approximation(names, laplace)
        sd = np.sqrt(np.diag(covariance))
    columns, rows = panel_grid(len(names))
    figure = figure or plt.figure(figsize=(2.4 * columns + 0.4, 2.3 * rows + 0.6), layout="constrained")
    shown = panels(figure, len(names))
    for i, (axes, name) in enumerate(zip(shown, names, strict=True)):
        draws = posterior.draws(name)
        density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
        draw_marginal(axes, edges, density, float(mean[i]), float(sd[i]))
        axes.set_xlabel(wrapped_label(name, unit_of(posterior, name)))
    figure.legend(*shown[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if text := caveats_of(posterior):
        figure.suptitle(text, x=0.99, ha="right", fontsize="medium")
    return figure


def panel_grid(count: int, across: int = ACROSS) -> tuple[int, int]:
    """Return the numbers of columns and rows of so many panels."""
    columns = min(count, across)
    return columns, -(-count // columns)


def panels(figure: FigureBase, count: int, across: int = ACROSS, sharey: bool = False) -> list[Axes]:
    """Create so many panels in a grid."""
    columns, rows = panel_grid(count, across)
    grid = figure.subplots(rows, columns, sharey=sharey, squeeze=False).ravel()
    for axes in grid[count:]:
        axes.remove()
    return list(grid[:count])


def draw_marginal(axes: Axes, edges: np.ndarray, density: np.ndarray, mean: float, sd: float) -> None:
    """Draw a histogram of draws, and a normal density if its sd is finite."""
    axes.stairs(density, edges, color=COLOURS["mcmc"], alpha=0.45, fill=True)
    axes.stairs(density, edges, color=COLOURS["mcmc"], lw=1.4, label="MCMC")
    if np.isfinite(sd) and sd > 0.0:
        width, reach = edges[-1] - edges[0], 3.0 * sd
        x = np.linspace(max(mean - reach, edges[0] - 0.5 * width), min(mean + reach, edges[-1] + 0.5 * width), 300)
        axes.plot(x, norm.pdf(x, mean, sd), color=COLOURS["laplace"], lw=1.6, ls="--", label="Laplace")
    axes.set_ylim(bottom=0.0)
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=4)
    axes.spines[["left", "right", "top"]].set_visible(False)


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
    _checks.integer("walkers", walkers, 1)
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
        axes.set_ylabel(wrapped_label(name, unit_of(posterior, name)), fontsize=8)
        axes.annotate(
            f"tau {posterior.tau[name]:.0f} steps, R-hat {posterior.rhat[name]:.3f}",
            (0.995, 0.97),
            xycoords="axes fraction",
            ha="right",
            va="top",
            fontsize=7,
            bbox={"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.5},
        )
    rows[-1].set_xlabel("step after burn-in (one colour per ensemble)")
    if text := caveats_of(posterior):
        figure.suptitle(text)
    return figure
