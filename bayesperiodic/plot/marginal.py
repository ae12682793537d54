"""Marginal distributions: draws, and the Laplace approximation on top."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.plot.pairs import chosen, normal_approximation
from bayesperiodic.plot.style import COLOURS, caveats, unit_of, wrapped_label

ACROSS, BINS, SHOWN = 4, 40, (0.0005, 0.9995)


def marginals(
    posterior: Posterior,
    *,
    laplace: MapEstimate | None = None,
    names: Sequence[str] | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw the marginal distribution of every parameter, with the Laplace approximation's on top.

    Parameters
    ----------
    posterior : Posterior
    laplace : MapEstimate, optional
        What it says of noise parameters is told at `corner`.
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
    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
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
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for i, (axes, name) in enumerate(zip(panels, names, strict=False)):
        draws = posterior.draws(name)
        density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
        draw_marginal(axes, edges, density, float(mean[i]), float(sd[i]))
        axes.set_xlabel(wrapped_label(name, unit_of(posterior, name)))
    for axes in panels[len(names) :]:
        axes.remove()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    if said := caveats(posterior):
        figure.suptitle(said, x=0.99, ha="right", fontsize="medium")
    return figure


def panel_grid(count: int) -> tuple[int, int]:
    """Return how many columns and rows hold so many panels."""
    columns = min(count, ACROSS)
    return columns, -(-count // columns)


def draw_marginal(axes: Axes, edges: np.ndarray, density: np.ndarray, mean: float, sd: float) -> None:
    """Draw a histogram of draws, and a normal density where its sd is finite."""
    axes.stairs(density, edges, color=COLOURS["mcmc"], alpha=0.45, fill=True)
    axes.stairs(density, edges, color=COLOURS["mcmc"], lw=1.4, label="MCMC")
    if np.isfinite(sd) and sd > 0.0:
        width, reach = edges[-1] - edges[0], 3.0 * sd
        x = np.linspace(max(mean - reach, edges[0] - 0.5 * width), min(mean + reach, edges[-1] + 0.5 * width), 300)
        normal = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes.plot(x, normal, color=COLOURS["laplace"], lw=1.6, ls="--", label="Laplace")
    axes.set_ylim(bottom=0.0)
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=4)
    axes.spines[["left", "right", "top"]].set_visible(False)
