"""Profiles of the posterior density."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import checks
from bayesperiodic.inference.estimation.profile import CLOSED, Profile
from bayesperiodic.plot.style import COLOURS, axis_label

PROFILES_ACROSS = 3
PROFILE_LEGEND = ("profile", "MAP", "Laplace", "solve failed")
AT_90, DEEPEST = -0.5 * 1.6449**2, -4.2


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
    axes.set_xlabel(axis_label(name, profile.units[name]))


def _laplace_range(profile: Profile, name: str) -> np.ndarray:
    """Return values as far as three standard deviations, where that is within the support and not far beyond."""
    values, reach, (low, high) = profile.values[name], 3.0 * profile.sd[name], profile.limits[name]
    margin = 0.5 * np.ptp(values)
    return np.linspace(
        min(values[0], max(low, values[0] - margin, profile.map[name] - reach)),
        max(values[-1], min(high, values[-1] + margin, profile.map[name] + reach)),
        400,
    )
