"""Posterior prediction of branches of periodic solutions, such as response curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.predictive import BAND_QUANTILES, draws_of
from bayesperiodic.periodic.continuation import FOLD, Branch, continue_periodic
from bayesperiodic.periodic.equations import FREQUENCY
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.sampling.draws import Posterior

if TYPE_CHECKING:
    import pandas as pd

BAND_MEASURES = AMPLITUDE, MAXIMUM = "amplitude", "maximum"
# Values of the varied quantity in a band, and the fraction of the draws that must have an orbit at them.
BAND_POINTS, LEAST_FRACTION = 200, 0.5


@dataclass(frozen=True)
class BranchPrediction(Result):
    """Branches of periodic solutions, one for each of some draws of the posterior.

    Attributes
    ----------
    vary, experiment : str
        The varied quantity, and the experiment whose inputs and parameters are used.
    units : dict of str to str
        Of the varied quantity and the outputs, if known.
    curves : DataFrame
        One row per orbit, in the order of each branch: ``draw``; ``part``, the number of folds before it; ``value`` of
        the varied quantity; ``stable``; ``kind`` ("fold", "period doubling" or ""); and for each output its
        ``amplitude[output]``, half the range, and ``maximum[output]``.
    draws, failed, incomplete : int
        Number of draws, of those without an orbit at the start, and of those whose branch ended before the requested
        value.

    Examples
    --------
    >>> curves = bp.predict_branch(problem, posterior, "frequency", until=(0.06, 0.3), draws=5, progress=False)
    >>> curves.draws, curves.failed, len(curves.folds)
    (5, 0, 0)
    >>> band = curves.band()
    >>> bool((band["low"] < band["high"]).all())
    True
    """

    vary: str
    experiment: str
    units: dict[str, str]
    curves: pd.DataFrame
    draws: int
    failed: int
    incomplete: int

    @property
    def outputs(self) -> list[str]:
        """The model's outputs."""
        return [c[len(AMPLITUDE) + 1 : -1] for c in self.curves.columns if c.startswith(f"{AMPLITUDE}[")]

    @property
    def folds(self) -> pd.DataFrame:
        """Median and central 90 % of the varied quantity at each fold, and the number of draws that have it."""
        import pandas as pd

        at = self.curves[self.curves["kind"] == FOLD].groupby("part")["value"]
        levels = {name: at.quantile(q) for name, q in zip(("median", "low", "high"), BAND_QUANTILES, strict=True)}
        return pd.DataFrame(levels | {"draws": at.count()}).reset_index(drop=True)

    def band(self, output: str | None = None, measure: str = AMPLITUDE) -> pd.DataFrame:
        """Return the band of an output: one row per part between folds and value of the varied quantity.

        Parameters
        ----------
        output : str, optional
            By default the first one.
        measure : "amplitude" or "maximum"
            Half the range of the output over the period, or its maximum.

        Returns
        -------
        DataFrame
            ``part``, ``value``, ``median``, ``low`` and ``high`` (central 90 % of the draws that have an orbit there),
            ``stable`` (of most), ``fraction`` of the draws that have one; rows with less than half of them are left
            out.

        Raises
        ------
        ValueError
            For an unknown output or measure.

        Examples
        --------
        >>> curves = bp.predict_branch(problem, posterior, "force", until=2.0, draws=5, progress=False)
        >>> curves.band(measure="maximum").columns.tolist()
        ['part', 'value', 'median', 'low', 'high', 'stable', 'fraction']
        """
        import pandas as pd

        output = self.outputs[0] if output is None else output
        _checks.one_of("output", output, self.outputs)
        _checks.one_of("measure", measure, BAND_MEASURES)
        column, rows = f"{measure}[{output}]", []
        for part, curves in self.curves.groupby("part"):
            grid = np.linspace(curves["value"].min(), curves["value"].max(), BAND_POINTS)
            every, stable = np.full((2, self.draws, BAND_POINTS), np.nan)
            for i, (_, one) in enumerate(curves.groupby("draw")):
                ordered = one.sort_values("value")
                value = ordered["value"].to_numpy()
                every[i] = np.interp(grid, value, ordered[column], left=np.nan, right=np.nan)
                stable[i] = np.where(np.isnan(every[i]), np.nan, np.interp(grid, value, 1.0 * ordered["stable"]))
            fraction = np.mean(~np.isnan(every), axis=0)
            kept = fraction >= LEAST_FRACTION
            band = pd.DataFrame({"part": part, "value": grid[kept]})
            band[["median", "low", "high"]] = np.nanquantile(every[:, kept], BAND_QUANTILES, axis=0).T
            band["stable"] = np.nanmean(stable[:, kept], axis=0) > LEAST_FRACTION
            rows.append(band.assign(fraction=fraction[kept]))
        return pd.concat(rows, ignore_index=True)

    def __repr__(self) -> str:
        unit = self.units.get(self.vary, "")
        folds = self.folds[["median", "low", "high", "draws"]].astype(float)
        table = folds.set_axis([f"fold at [{unit or '-'}]", "5 %", "95 %", "draws"], axis=1)
        span = f"{self.curves['value'].min():.6g} to {self.curves['value'].max():.6g} {unit}"
        return (
            f"Branches of {self.experiment!r}, {self.vary} {span}"
            + (f"\n{table.to_string(float_format='{:.6g}'.format, index=False)}" if len(folds) else "\nNo folds.")
            + f"\nOf {self.draws} draws, {self.failed} have no orbit at the start, and {self.incomplete} branches end "
            "before the last value."
        )


def predict_branch(
    problem: Problem,
    posterior: Posterior,
    vary: str,
    *,
    until: float | tuple[float, float],
    draws: int = 50,
    experiment: str | None = None,
    progress: bool = True,
) -> BranchPrediction:
    """Follow the periodic solution of an experiment along a quantity for draws of the posterior.

    Every branch is continued through folds, stable and unstable (see `continue_periodic`), without measurement noise
    and without the sensors: inputs and outputs are those of the model.

    Parameters
    ----------
    problem : Problem
    posterior : Posterior
    vary : str
        "frequency", a parameter's name, or an input's name (its scale, 1 at the start).
    until : float or pair of float
        Where the branches end; from the experiment's value to one, or between two on both sides of it.
    draws : int
        Draws of the posterior, spread evenly over it.
    experiment : str, optional
        The experiment whose orbit is followed; by default the first one.
    progress : bool
        Show a progress bar.

    Returns
    -------
    BranchPrediction
        `plot.branch` draws it.

    Raises
    ------
    ValueError
        For an unknown experiment or quantity, an end equal to the start value, or draws of another problem.
    RuntimeError
        If no draw has a periodic solution at the start.

    Examples
    --------
    >>> curves = bp.predict_branch(problem, posterior, "frequency", until=0.2, draws=5, progress=False)
    >>> figure = bp.plot.branch(curves)
    """
    import pandas as pd

    _checks.instance("problem", problem, Problem)
    count = _checks.integer("draws", draws, 1)
    names = [e.name for e in problem.experiments]
    name = names[0] if experiment is None else experiment
    _checks.one_of("experiment", name, names)
    problem = check_results(problem, posterior=posterior)
    size = posterior.draws(problem.names[0]).size
    points, _ = draws_of(problem, posterior, np.linspace(0, size - 1, count).astype(int))
    guesses = posterior.guesses([*problem.observations], problem.model.states)
    solver = problem.anchored(np.median(points, axis=0), guesses).density().solver
    ends = [float(end) for end in np.atleast_1d(np.asarray(until, dtype=float))]
    curves, failed, incomplete = [], 0, 0
    for draw, theta in enumerate(tqdm(points, desc=f"branches in {vary}", unit="draw", disable=not progress)):
        start = solver.solutions(theta)[name]
        if not start.converged:
            failed += 1
            continue
        branches = [
            continue_periodic(problem.sensors.plain_model, start, vary, until=end, progress=False) for end in ends
        ]
        incomplete += not all(branch.complete for branch in branches)
        curves.append(_curve(draw, branches))
    if not curves:
        raise RuntimeError("posterior: none of its draws has a periodic solution. Give draws of this problem.")
    units = problem.model.units | ({FREQUENCY: "Hz"} if vary == FREQUENCY else {})
    return BranchPrediction(vary, name, dict(units), pd.concat(curves, ignore_index=True), count, failed, incomplete)


def _curve(draw: int, branches: Sequence[Branch]) -> pd.DataFrame:
    """Return the orbits of a draw, those of the first branch in reverse order if there are two."""
    import pandas as pd

    first, *more = branches
    order = [(branch, i) for branch in more for i in range(1, len(branch))]
    backwards = range(len(first))[::-1] if more else range(len(first))
    order = [(first, i) for i in backwards] + order
    columns: dict[str, list] = {
        "value": [branch.values[i] for branch, i in order],
        "stable": [bool(branch[i].stable) for branch, i in order],
        "kind": [branch.kinds[i] for branch, i in order],
    }
    for output in first[0].outputs:
        waves = [branch[i].wave(output) for branch, i in order]
        columns[f"{AMPLITUDE}[{output}]"] = [0.5 * float(np.ptp(wave)) for wave in waves]
        columns[f"{MAXIMUM}[{output}]"] = [float(wave.max()) for wave in waves]
    table = pd.DataFrame(columns)
    folds = (table["kind"] == FOLD).to_numpy()
    table.insert(0, "draw", draw)
    table.insert(1, "part", np.cumsum(folds) - folds)
    # A fold is the end of one part and, without its kind, the start of the next.
    starts = table[folds].assign(kind="")
    starts["part"] += 1
    return pd.concat([starts, table]).sort_values("part", kind="stable", ignore_index=True)
