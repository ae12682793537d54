"""Figure of a table of responses with the model's branch."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.sweep import Sweep
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.sweeps import tables
from bayesperiodic.diagnostics.predictive import draws_of
from bayesperiodic.diagnostics.response_curves import (
    Curve,
    Quantity,
    at_estimate,
    curves,
    predicted,
    quantities,
    residuals,
)
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, axis_label, curve_id, legend_entries, styled
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.sampling.draws import Posterior

MOST_DRAWS = 200
BANDS = {"90 %": (0.05, 0.95, 0.25), "50 %": (0.25, 0.75, 0.45)}
MARKERS = "osD^vP*X"


@styled
def response(
    problem: Problem, fit: MapEstimate, posterior: Posterior | None = None, *, figure: Figure | None = None
) -> Figure:
    """Draw tables of responses with the model's branch at the estimate, and the residuals below.

    Stable parts of the branch are solid, unstable ones dashed; folds are circles; dotted lines lead over the jumps of
    the measured sweep. With a posterior, bands show the central 50 and 90 % of the predicted values at the
    measured frequencies, each on the sheet of the branch that the point is on. Residuals are in units of the noise:
    real and imaginary part for a measured amplitude and phase.

    Parameters
    ----------
    problem : Problem
        With experiments of `response_table`.
    fit : MapEstimate
    posterior : Posterior, optional

    Raises
    ------
    ValueError
        For an object of another class, results of another problem, or a problem without a table.

    Examples
    --------
    >>> f = np.linspace(0.1, 0.2, 6)
    >>> omega = 2 * np.pi * f
    >>> c = 0.5 / (1.0 - omega**2 + 0.2j * omega) + 0.01 * np.cos(7 * np.arange(6))
    >>> runs = bp.response_table({"f": f, "c": c}, frequency="f", outputs={"displacement": "c"}, inputs={"force": 0.5})
    >>> table = bp.Problem(bp.models.duffing, runs, priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                    fixed={"m": 1, "k3": 0})
    >>> figure = bp.plot.response(table, bp.map_estimate(table, progress=False))
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['residual [sd]', 'amplitude of displacement [m]', 'phase of displacement against force [°]']
    """
    given: dict[str, Any] = {} if posterior is None else {"posterior": posterior}
    problem = check_results(problem, fit=fit, **given)
    every = tables(problem)
    if not every:
        raise ValueError("problem: must have experiments of a table of responses, see response_table, got none.")
    shown: dict[str, list[Quantity]] = {}
    for one in dict.fromkeys(q for table in every.values() for e in table for q in quantities(e)):
        shown.setdefault(one.channel, []).append(one)
    rows = max(len(panels) for panels in shown.values())
    figure = figure or plt.figure(figsize=(7.0 * len(shown), 3.2 * rows + 1.6), layout="constrained")
    grid = figure.add_gridspec(rows + 1, len(shown), height_ratios=[3] * rows + [1.3])
    solver, branches, panels = at_estimate(problem, fit), curves(problem, fit), []
    central = predicted(problem, solver, problem.vector(fit.theta)[None])
    drawn = None if posterior is None else predicted(problem, solver, _some_draws(problem, posterior))
    left = residuals(problem, fit, solver)
    for column, (channel, of_channel) in enumerate(shown.items()):
        below = figure.add_subplot(grid[rows, column])
        for row, quantity in enumerate(of_channel):
            axes = figure.add_subplot(grid[row, column], sharex=below)
            panels.append(axes)
            axes.tick_params(labelbottom=False)
            unit = "°" if quantity.is_phase else problem.units.get(channel, "")
            axes.set_ylabel(axis_label(quantity.label, unit))
            for (sweep, table), colour, marker in zip(every.items(), _colours(len(every)), MARKERS * 9, strict=False):
                of_table = [e for e in table if quantity in quantities(e)]
                if not of_table:
                    continue
                near = _draw_branch(axes, branches[sweep], of_table, quantity, central, colour)
                if drawn is not None:
                    _draw_bands(axes, of_table, quantity, drawn, solver.sheets, near)
                jumps = _jumps(of_table, solver.sheets) if sweep.direction else []
                look = colour if len(every) > 1 else COLOURS["measured"]
                _draw_points(axes, sweep, of_table, quantity, near, marker, look, jumps)
            low, high = _span([e.frequency for table in every.values() for e in table])
            axes.set_xlim(low, high)
        _draw_residuals(below, channel, every, left)
    panels[0].legend(*zip(*[(a, t) for t, a in legend_entries(*panels).items()], strict=True), frameon=False)
    return figure


def _gid(curve: str, channel: str, table: Sequence[Experiment]) -> str:
    """Return the group id of what is drawn of a table, whose name and direction stand for its experiments."""
    sweep = table[0].sweep
    names = [] if sweep is None else [sweep.table, *([f"sweep {sweep.direction}"] if sweep.direction else [])]
    return curve_id(curve, channel, ", ".join(names))


def _colours(count: int) -> Sequence[str]:
    return [COLOURS["map"]] if count == 1 else [ENSEMBLES[k % len(ENSEMBLES)] for k in range(count)]


def _some_draws(problem: Problem, posterior: Posterior) -> np.ndarray:
    size = posterior.draws(posterior.names[0]).size
    return draws_of(problem, posterior, np.linspace(0, size - 1, min(size, MOST_DRAWS)).astype(int))[0]


def _span(frequencies: Sequence[float]) -> tuple[float, float]:
    low, high = min(frequencies), max(frequencies)
    margin = 0.04 * (high - low) or 0.04 * high
    return low - margin, high + margin


def _scaled(quantity: Quantity, values: np.ndarray) -> np.ndarray:
    """Return values as they are drawn: phases in degrees."""
    return np.degrees(values) if quantity.is_phase else values


def _near(quantity: Quantity, values: np.ndarray, centre: np.ndarray | float) -> np.ndarray:
    """Return phases within half a turn of others."""
    if not quantity.is_phase:
        return values
    return centre + np.mod(values - centre + np.pi, 2 * np.pi) - np.pi


def _draw_points(
    axes: Axes, sweep: Sweep, table: Sequence[Experiment], quantity: Quantity, near: np.ndarray, marker: str,
    colour: str, jumps: Sequence[int],
) -> None:  # fmt: skip
    values = _scaled(quantity, _near(quantity, np.array([quantities(e)[quantity] for e in table]), near))
    label = "measured" if sweep.direction is None else f"measured, sweep {sweep.direction}"
    look: dict[str, Any] = {"ls": "", "marker": marker, "ms": 4, "color": colour, "label": label}
    f = np.array([e.frequency for e in table])
    axes.plot(f, values, zorder=5, gid=_gid("measured", quantity.channel, table), **look)
    gid = _gid("jump", quantity.channel, table)
    for k in jumps:
        axes.plot(f[k : k + 2], values[k : k + 2], ls=":", lw=1.2, color="black", label="jump", zorder=2, gid=gid)


def _draw_branch(
    axes: Axes, curve: Curve, table: Sequence[Experiment], quantity: Quantity, central: Any, colour: str
) -> np.ndarray:
    """Draw the branch, as the sensors show it, with its folds; return its values at the points, (points,)."""
    values = quantity.of(curve.waves)
    values = np.unwrap(values) if quantity.is_phase else values
    values = values + _of_sensors(curve, table, quantity, central, values)
    near = np.array([_on_branch(curve, values, e, quantity, central) for e in table])
    values = _scaled(quantity, values)
    low, high = _span([e.frequency for e in table])
    inside = (curve.frequency >= low) & (curve.frequency <= high)
    values = np.where(inside, values, np.nan)
    starts = [0, *(np.flatnonzero(np.diff(curve.stable)) + 1), len(values)]
    for begin, end in pairwise(starts):
        stable = bool(curve.stable[begin])
        part = slice(max(begin - 1, 0), end)
        style: dict[str, Any] = {"ls": "-", "label": "MAP"} if stable else {"ls": "--", "label": "MAP, unstable"}
        style |= {"gid": _gid(style["label"], quantity.channel, table)}
        axes.plot(curve.frequency[part], values[part], color=colour, lw=1.4, zorder=3, **style)
    at = curve.folds
    if at.any():
        look: dict[str, Any] = {"marker": "o", "mfc": "white", "mew": 1.4, "ls": "", "ms": 6}
        look |= {"gid": _gid("fold", quantity.channel, table)}
        axes.plot(curve.frequency[at], values[at], color=colour, label="fold", zorder=4, **look)
    return near


def _on_branch(curve: Curve, values: np.ndarray, e: Experiment, quantity: Quantity, central: Any) -> float:
    """Return the value of the branch at a point of the table that is the nearest to the predicted one."""
    shown = float(central[e.name][quantity][0])
    at = np.flatnonzero(np.isclose(curve.frequency, e.frequency, rtol=1e-12))
    if not at.size or not np.isfinite(shown):
        return float(values[np.argmin(np.abs(curve.frequency - e.frequency))])
    return float(values[at[np.argmin(np.abs(_near(quantity, values[at], shown) - shown))]])


def _of_sensors(
    curve: Curve, table: Sequence[Experiment], quantity: Quantity, central: Any, values: np.ndarray
) -> np.ndarray:
    """Return what sensors add to the values along the branch, interpolated in the frequency; zero without sensors."""
    f, added = [], []
    for e in sorted(table, key=lambda e: e.frequency):
        shown = float(central[e.name][quantity][0])
        bare = _on_branch(curve, values, e, quantity, central)
        if not np.isfinite(shown) or bare == 0.0:
            continue
        off = _near(quantity, np.array(shown), bare) - bare if quantity.is_phase else shown / bare - 1.0
        f.append(e.frequency)
        added.append(float(off))
    if not f:
        return np.zeros_like(values)
    between = np.interp(curve.frequency, f, added)
    return between if quantity.is_phase else between * values


def _draw_bands(
    axes: Axes, table: Sequence[Experiment], quantity: Quantity, drawn: Any, sheets: Any, near: np.ndarray
) -> None:
    """Draw central parts of predicted values, points on the same sheet connected."""
    ends = [0, *(k + 1 for k in _jumps(table, sheets)), len(table)]
    for begin, end in pairwise(ends):
        part = table[begin:end]
        f = np.array([e.frequency for e in part])
        levels = near[begin:end].tolist()
        values = np.array([_near(quantity, drawn[e.name][quantity], a) for e, a in zip(part, levels, strict=True)])
        values = _scaled(quantity, values)
        for label, (low, high, alpha) in BANDS.items():
            bounds = np.nanquantile(values, [low, high], axis=1)
            look: dict[str, Any] = {"color": COLOURS["mcmc"], "alpha": alpha, "lw": 0, "label": label, "zorder": 1}
            look |= {"gid": _gid(f"{label} of the draws", quantity.channel, table)}
            if len(part) > 1:
                axes.fill_between(f, *bounds, **look)
            else:
                axes.bar(f, bounds[1] - bounds[0], 0.01 * float(f[0]), bounds[0], **look)


def _jumps(table: Sequence[Experiment], sheets: Any) -> list[int]:
    """Return the points after which the sheet of the branch changes."""
    return [k for k, (a, b) in enumerate(pairwise(table)) if sheets[a.name] != sheets[b.name]]


def _draw_residuals(axes: Axes, channel: str, every: Any, left: Any) -> None:
    for table, colour, marker in zip(every.values(), _colours(len(every)), MARKERS * 9, strict=False):
        parts = [(e.frequency, values) for e in table for name, values in left[e.name] if name == channel]
        at = [frequency for frequency, values in parts for _ in values]
        heights = [height for _, values in parts for height in values]
        gid = _gid("residual", channel, table)
        axes.plot(at, heights, ls="", marker=marker, ms=3, color=colour, mfc="none", gid=gid)
    axes.axhline(0.0, lw=1.0, color="black")
    for line in (-2.0, 2.0):
        axes.axhline(line, lw=0.8, ls=":", color="black")
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("residual [sd]")
