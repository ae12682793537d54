"""Branches of periodic solutions."""

from collections.abc import Callable, Sequence
from typing import cast

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import checks
from bayesperiodic.periodic.continuation import FOLD, PERIOD_DOUBLING, Branch
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.plot.style import ENSEMBLES, axis_label

MEASURES = ("amplitude", "maximum", "section", "period")
MARKERS = {FOLD: "o", PERIOD_DOUBLING: "D"}


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
        "angular frequency [rad/s]" if factor != 1.0 else axis_label(branch.vary, branch.units.get(branch.vary, ""))
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
        return axis_label(getattr(measure, "__name__", "measure").replace("_", " "), unit)
    if measure == "period":
        return "period [s]"
    return axis_label(f"{output} at tau = 0, 1, …" if measure == "section" else f"{measure} of {output}", unit)


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
