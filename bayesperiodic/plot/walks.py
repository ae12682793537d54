"""Paths of the walkers."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from bayesperiodic import checks
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.plot.style import ENSEMBLES, caveats, unit_of, wrapped_label


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

    Raises
    ------
    ValueError
        For less than one walker.

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
    >>> figure = bp.plot.traces(posterior, walkers=2)
    >>> [axes.get_ylabel().splitlines()[0] for axes in figure.axes]
    ['c', 'k', 'variance[displacement]']
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
    rows[-1].set_xlabel("step after burn-in; a colour is an independent ensemble")
    if said := caveats(posterior):
        figure.suptitle(said)
    return figure
