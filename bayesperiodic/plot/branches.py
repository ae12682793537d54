"""Figures of branches of periodic solutions, Poincaré sections and orbits."""

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle, pairwise
from typing import Any, cast

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import _checks
from bayesperiodic.diagnostics.branch_prediction import BranchPrediction
from bayesperiodic.orbits.coordinates import channel_and_delay, crossed_of
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.orbits.section import PoincareSection
from bayesperiodic.periodic.continuation import FOLD, PERIOD_DOUBLING, Branch
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, axis_label, styled

BRANCH_MEASURES = ("amplitude", "maximum", "section", "period")
STABILITIES = ("unstable", "stable", "stability unknown")
STABILITY_UNKNOWN, SPECIAL = 2, 3
BRANCH_STYLES: dict[str, dict[str, Any]] = {
    "stable": {"lw": 1.6, "ls": "-"},
    "unstable": {"lw": 1.6, "ls": "--"},
    "stability unknown": {"lw": 1.6, "ls": ":"},
    FOLD: {"marker": "o", "mfc": "white", "mew": 1.4, "ls": ""},
    PERIOD_DOUBLING: {"marker": "D", "mfc": "white", "mew": 1.4, "ls": ""},
}


@styled
def branch(
    branch: Branch | BranchPrediction,
    *more: Branch | BranchPrediction,
    measure: str | Callable[[PeriodicSolution], float | np.ndarray] = "amplitude",
    output: str | None = None,
    unit: str | None = None,
    labels: Sequence[str] | None = None,
    angular: bool = False,
    figure: Figure | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw branches of periodic solutions: stable parts solid, unstable ones dashed, with folds and period doublings.

    Of a prediction the median and the central 90 % band are drawn between folds, where half of the draws have an orbit,
    and the folds with their central 90 %.

    Parameters
    ----------
    branch, *more : Branch or BranchPrediction
        Continued in the same quantity, one colour per branch; of a prediction only amplitude and maximum.
    measure : {"amplitude", "maximum", "section", "period"} or callable
        Ordinate: half the range of the output, its maximum, or its values at tau = 0, 1, … (p lines for an orbit of
        period p), without the turns of a rotating angle; or the response period; or a function of the solution that
        returns a number or an array (one line per component).
    output : str, optional
        By default the first one.
    unit : str, optional
        Unit of the ordinate; by default that of the output, or s for the period.
    labels : sequence of str, optional
        One per branch, for the legend.
    angular : bool
        Show frequencies as angular frequencies in rad/s.
    ax : Axes, optional
        To draw into, instead of a figure.

    Raises
    ------
    ValueError
        For an unknown output or measure, branches in different quantities, or a wrong number of labels.

    Examples
    --------
    >>> start = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force,
    ...                           frequency=0.1, samples=32, scheme="central4")
    >>> response = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, step=0.05, progress=False)
    >>> figure = bp.plot.branch(response)
    >>> figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    ('frequency [Hz]', 'amplitude of displacement [m]')
    """
    _checks.instance("branch", branch, (Branch, BranchPrediction))
    branches = (branch, *more)
    if len({b.vary for b in branches}) > 1:
        raise ValueError(f"more: branches must all vary {branch.vary!r}, got {[b.vary for b in more]}.")
    if labels is not None and len(labels) != len(branches):
        raise ValueError(f"labels: must be {len(branches)}, one per branch, got {len(labels)}.")
    known = branch.outputs if isinstance(branch, BranchPrediction) else [*branch[0].outputs]
    output = known[0] if output is None else output
    _checks.one_of("output", output, known)
    if not callable(measure):
        _checks.one_of("measure", measure, BRANCH_MEASURES)
    if ax is None:
        ax = (figure or plt.figure(figsize=(7.0, 4.6), layout="constrained")).add_subplot()
    factor, drawn = 2 * np.pi if angular and branch.vary == "frequency" else 1.0, set[str]()
    for b, colour in zip(branches, cycle(ENSEMBLES), strict=False):
        draw: Any = _draw_prediction if isinstance(b, BranchPrediction) else _draw_branch
        drawn |= draw(ax, b, measure, output, factor, colour)
    varied = axis_label(branch.vary, branch.units.get(branch.vary, ""))
    ax.set_xlabel("angular frequency [rad/s]" if factor != 1.0 else varied)
    ax.set_ylabel(_measure_label(measure, output, branch.units.get(output, "") if unit is None else unit))
    looks: list[dict[str, Any]] = [{"color": c, "lw": 1.6, "label": t} for c, t in zip(cycle(ENSEMBLES), labels or [])]
    looks += [{"color": "black", "label": name} | look for name, look in BRANCH_STYLES.items() if name in drawn]
    ax.legend(handles=[plt.Line2D([], [], **look) for look in looks], frameon=False)
    return cast(Figure, ax.figure)


def _draw_branch(ax: Axes, branch: Branch, measure: Any, output: str, factor: float, colour: str) -> set[str]:
    """Draw the parts of a branch and its marked points, and return the styles that appear."""
    across, up = factor * branch.values, _measures(branch, measure, output)
    runs = _runs(branch)
    for stable, part in runs:
        ax.plot(across[part], up[part], color=colour, zorder=2 + (stable == 1), **BRANCH_STYLES[STABILITIES[stable]])
    for kind in (FOLD, PERIOD_DOUBLING):
        at = np.array([k == kind for k in branch.kinds])
        ax.plot(np.repeat(across[at], up.shape[1]), up[at].ravel(), color=colour, ms=6, zorder=4, **BRANCH_STYLES[kind])
    return {STABILITIES[stable] for stable, _ in runs} | {*branch.kinds}


def _draw_prediction(
    ax: Axes, prediction: BranchPrediction, measure: Any, output: str, factor: float, colour: str
) -> set[str]:
    """Draw the band of a prediction and its folds, and return the styles that appear."""
    for _, part in prediction.band(output, str(measure)).groupby("part"):
        value = factor * part["value"].to_numpy()
        ax.fill_between(value, part["low"], part["high"], color=colour, alpha=0.3, lw=0, zorder=2)
        for stable, at in _stretches(part["stable"].to_numpy()):
            ax.plot(value[at], part["median"].iloc[at], color=colour, zorder=3, **BRANCH_STYLES[STABILITIES[stable]])
    curves = prediction.curves
    heights = curves[curves["kind"] == FOLD].groupby("part")[f"{measure}[{output}]"].median()
    middle, low, high = factor * prediction.folds[["median", "low", "high"]].to_numpy().T
    look = BRANCH_STYLES[FOLD] | {"color": colour, "ms": 6, "zorder": 4}
    if len(middle):
        ax.errorbar(middle, heights, xerr=[middle - low, high - middle], **look)
    return {STABILITIES[int(stable)] for stable in curves["stable"]} | {*curves["kind"]}


def _measures(branch: Branch, measure: str | Callable, output: str) -> np.ndarray:
    """Return the ordinates of a branch, (points, lines)."""
    if callable(measure):
        return np.array([np.ravel(measure(solution)) for solution in branch])
    if measure == "period":
        return np.array([[solution.period] for solution in branch])
    waves = np.array([solution.wave(output) for solution in branch])
    if measure == "amplitude":
        return 0.5 * np.ptp(waves, axis=1, keepdims=True)
    if measure == "maximum":
        return waves.max(axis=1, keepdims=True)
    points = np.array([solution.outputs[output][:: solution.samples] for solution in branch])
    if np.any(branch[0].wave(output) != branch[0].outputs[output]):
        points[0] = np.angle(np.exp(1j * points[0]))
        points = np.unwrap(points, axis=0)
    return points


def _runs(branch: Branch) -> list[tuple[int, slice]]:
    """Return the parts of equal stability (an index of `STABILITIES`); special points belong to both neighbours."""
    plain = [
        SPECIAL if kind else STABILITY_UNKNOWN if solution.stable is None else int(solution.stable)
        for solution, kind in zip(branch, branch.kinds, strict=True)
    ]
    between = [
        0 if 0 in pair else STABILITY_UNKNOWN if STABILITY_UNKNOWN in pair else int(1 in pair)
        for pair in pairwise(plain)
    ]
    return [(stable, slice(part.start, part.stop + 1)) for stable, part in _stretches(between) if between]


def _stretches(flags: Sequence[int] | np.ndarray) -> list[tuple[int, slice]]:
    """Return the stretches of equal flags, with the flag."""
    starts = [0, *(np.flatnonzero(np.diff(flags)) + 1), len(flags)]
    return [(int(flags[begin]), slice(begin, end)) for begin, end in pairwise(starts)]


def _measure_label(measure: str | Callable, output: str, unit: str) -> str:
    if callable(measure):
        return axis_label(getattr(measure, "__name__", "measure").replace("_", " "), unit)
    if measure == "period":
        return "period [s]"
    return axis_label(f"{output} at tau = 0, 1, …" if measure == "section" else f"{measure} of {output}", unit)


MOST_POINTS_DRAWN = 20_000
PERIOD_MARKERS = "osD^vP*X"
ORBITS_ACROSS = 6
CLOSEST_CYCLE, MODEL_CYCLE = "closest measured cycle", "orbit of the model"
CYCLE_STYLES: dict[str, dict[str, Any]] = {
    CLOSEST_CYCLE: {"color": COLOURS["measured"], "lw": 2.2, "alpha": 0.45},
    MODEL_CYCLE: {"color": COLOURS["map"], "lw": 1.0},
}
POINT_STYLE: dict[str, Any] = {"color": ENSEMBLES[1], "marker": "o", "ls": "", "mec": "black", "mew": 0.6}


@styled
def section(
    section: PoincareSection,
    orbits: Orbits | Sequence[Orbit] = (),
    *,
    units: Mapping[str, str] | None = None,
    figure: Figure | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a Poincaré section with the points of periodic orbits by period (de Kraker et al. 1997, fig. 5).

    Of more than two coordinates the first two are drawn, of one each point and the next one.

    Parameters
    ----------
    section : PoincareSection
        At most 20,000 points are drawn.
    orbits : Orbits or sequence of Orbit
    units : mapping of str to str, optional
        Units of the coordinates; angles are in rad.
    ax : Axes, optional
        To draw into, instead of a figure.

    Examples
    --------
    >>> bp.plot.section(henon_section, units={"x": "m", "y": "m/s"}).axes[0].get_xlabel()
    'x [m]'
    """
    _checks.instance("section", section, PoincareSection)
    if ax is None:
        ax = (figure or plt.figure(figsize=(7.0, 5.2), layout="constrained")).add_subplot()
    every = 1 + len(section.points) // MOST_POINTS_DRAWN
    name = "section" if every == 1 else f"section, one point in {every}"
    plane = section.points[:, :2]
    if len(section.coordinates) == 1:
        # NaN across breaks.
        plane = np.column_stack([section.points[:-1], section.points[:-1] + section.increments])
    shown = plane[::every]
    ax.plot(*shown.T, ",", color="0.65", rasterized=True, zorder=1)
    handles = [plt.Line2D([], [], marker=".", ls="", color="0.65", label=f"{name} ({len(shown)})")]
    periods = sorted({orbit.period for orbit in orbits})
    for period, marker, colour in zip(periods, cycle(PERIOD_MARKERS), cycle(ENSEMBLES), strict=False):
        members = [orbit for orbit in orbits if orbit.period == period]
        points = np.concatenate(
            [np.column_stack([orbit.points, np.roll(orbit.points, -1, axis=0)])[:, :2] for orbit in members]
        )
        size = max(6.5 - period, 3.0)
        look: dict[str, Any] = {"marker": marker, "color": colour, "ls": "", "ms": size, "mec": "black", "mew": 0.4}
        # Longer orbits have many points, and cover none of the shorter ones.
        ax.plot(*points.T, zorder=3 + 1 / period, **look)
        noun = "orbit" if len(members) == 1 else "orbits"
        handles.append(plt.Line2D([], [], label=f"period {period}: {len(members)} {noun}", **look))
    across, up = _coordinate_labels(section, units)
    ax.set(xlabel=across, ylabel=up)
    ax.legend(handles=handles, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=1.3)
    return cast(Figure, ax.figure)


@styled
def orbits(
    orbits: Orbits | Sequence[Orbit], *, units: Mapping[str, str] | None = None, figure: Figure | None = None
) -> Figure:
    """Draw the phase portrait of each orbit: measured cycle, polished orbit of the model, and section points.

    Of more than two coordinates the first two are drawn.

    Parameters
    ----------
    orbits : Orbits or sequence of Orbit
        At least one.
    units : mapping of str to str, optional
        See `section`.

    Raises
    ------
    ValueError
        Without orbits, and for a section of one coordinate or with an interval among the first two.

    Examples
    --------
    >>> figure = bp.plot.orbits(bp.find_orbits(henon_section, periods=[1, 2]))
    >>> [axes.get_title().splitlines()[0] for axes in figure.axes]
    ['period 1, winding 0', 'period 2, winding 0']
    """
    _checks.instance("orbits", orbits, (Orbits, list, tuple))
    if not len(orbits):
        raise ValueError("orbits: must be at least one, got none.")
    if len(shown := orbits[0].coordinates[:2]) == 1 or any(map(crossed_of, shown)):
        raise ValueError(
            f"orbits: must have two coordinates or more, the first two no intervals, got {shown}. Draw their points "
            "with plot.section."
        )
    rows = -(-len(orbits) // ORBITS_ACROSS)
    columns = -(-len(orbits) // rows)
    figure = figure or plt.figure(figsize=(1.9 * columns + 0.6, 1.85 * rows + 0.7), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for number, (orbit, ax) in enumerate(zip(orbits, axes.flat, strict=False)):
        _portrait(ax, orbit)
        # The last panel of a column may be above an empty one.
        ax.tick_params(labelbottom=number + columns >= len(orbits))
    for ax in axes.flat[len(orbits) :]:
        ax.set_axis_off()
    across, up = _coordinate_labels(orbits[0], units)
    figure.supxlabel(across, fontsize="medium")
    figure.supylabel(up, fontsize="medium")
    drawn = {label for orbit in orbits for label in _cycles(orbit)}
    looks = {"section points": POINT_STYLE} | {label: look for label, look in CYCLE_STYLES.items() if label in drawn}
    handles = [plt.Line2D([], [], label=label, **look) for label, look in looks.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False, fontsize="small")
    return figure


def _portrait(ax: Axes, orbit: Orbit) -> None:
    for label, signals in _cycles(orbit).items():
        x, y = (np.angle(np.exp(1j * signals[c])) if c in orbit.angles else signals[c] for c in orbit.coordinates[:2])
        # Angles jump at ±π.
        jump = np.flatnonzero(np.abs(np.diff(x)) > np.pi) + 1 if orbit.angles else np.empty(0, dtype=int)
        ax.plot(np.insert(x, jump, np.nan), np.insert(y, jump, np.nan), **CYCLE_STYLES[label])
    ax.plot(*orbit.points[:, :2].T, ms=4.5, zorder=4, **POINT_STYLE)
    turns = "" if orbit.winding is None else f", winding {orbit.winding}".replace("-", "−")
    ax.set_title(f"period {orbit.period}{turns}\n$\\mu$ = {_multiplier(orbit)}", fontsize="x-small")
    ax.tick_params(labelsize="x-small")


def _cycles(orbit: Orbit) -> dict[str, Mapping[str, np.ndarray]]:
    """Return the measured cycle and that of the model, closed, in the first two coordinates, by their labels."""
    cycles: dict[str, Mapping[str, np.ndarray]] = {}
    if orbit.cycle is not None:
        cycles[CLOSEST_CYCLE] = _delayed(orbit.cycle, orbit)
    if orbit.solution is not None:
        outputs = _delayed(orbit.solution.outputs, orbit).items()
        cycles[MODEL_CYCLE] = {c: np.append(v, v[0]) for c, v in outputs}
    return cycles


def _delayed(signals: Mapping[str, np.ndarray], orbit: Orbit) -> dict[str, np.ndarray]:
    """Return the first two coordinates over the period, from the channels."""
    result, unit = {}, orbit.period if orbit.return_times is None else orbit.duration
    for coordinate in orbit.coordinates[:2]:
        channel, delay = channel_and_delay(coordinate)
        result[coordinate] = np.roll(signals[channel], -round(delay * len(signals[channel]) / unit))
    return result


def _multiplier(orbit: Orbit) -> str:
    value, sd = orbit.eigenvalues[0], orbit.eigenvalue_sd[0]
    if abs(value.imag) > 0.0:
        return f"{value:.3g}"
    return f"{value.real:.4g} ± {sd:.2g}" if np.isfinite(sd) else f"{value.real:.3g}, not estimated"


def _coordinate_labels(plane: PoincareSection | Orbit, units: Mapping[str, str] | None) -> list[str]:
    known = dict.fromkeys(plane.angles, "rad") | dict.fromkeys(filter(crossed_of, plane.coordinates), "s")
    known |= dict(units or {})
    labels = [axis_label(coordinate, known.get(coordinate, "")) for coordinate in plane.coordinates[:2]]
    return labels if len(labels) == 2 else [*labels, f"{labels[0]}, next"]
