"""Force against displacement over a cycle, and what the fit leaves of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies.landing_gear.figures import TITLE, TRUTH_NAMES
from studies.landing_gear.identification import Identified


def loops(identified: Mapping[str, Sequence[Identified]]) -> Figure:
    """Draw mean period and fit of some experiments of each truth, the residual below, the displacement being given."""
    from matplotlib import pyplot as plt

    shown = [(truth, one) for truth, several in identified.items() for one in several]
    figure = plt.figure(figsize=(3.6 * len(shown), 6.8), layout="constrained")
    grid = figure.subplots(2, len(shown), squeeze=False, sharex="col")
    for (above, below), (truth, one) in zip(grid.T, shown, strict=True):
        _loop(above, below, one)
        name = one.problem.experiments[0].name.replace(" Hz ", " Hz, ±")
        above.set_title(f"{TRUTH_NAMES[truth].replace(': ', ':' + chr(10))}\n{name}", fontsize=9)
    grid[0, 0].set_ylabel("force [kN]")
    grid[1, 0].set_ylabel("residual force [N]")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), frameon=False, ncols=2, loc="outside lower center")
    figure.suptitle(f"Friction loops of the landing gear, displacement given, {TITLE}")
    return figure


def _loop(above: Axes, below: Axes, identified: Identified) -> None:
    (experiment,), colours = identified.problem.experiments, bp.plot.COLOURS
    residual = identified.fit.residuals[experiment.name]["force"]
    x, force = 1e3 * _closed(experiment.inputs["displacement"]), _closed(experiment.outputs["force"])
    above.plot(x, 1e-3 * force, color=colours["measured"], lw=1.8, label="recorded, mean period")
    above.plot(x, 1e-3 * (force - _closed(residual)), "--", color=colours["map"], lw=1.2, label="MAP")
    below.plot(x, _closed(residual), color=colours["measured"], lw=0.9)
    below.axhline(0.0, color="black", lw=0.6)
    below.set_xlabel("displacement [mm]")


def _closed(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[0])
