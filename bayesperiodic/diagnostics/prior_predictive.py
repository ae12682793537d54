"""Prior predictive check: existence of the periodic orbit, and predicted outputs."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pandas as pd
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.diagnostics.predictive import Bands, bands
from bayesperiodic.periodic import arclength
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES
from bayesperiodic.posterior.problem import Problem

NO_ORBIT, OTHER, FAILED = "no orbit", "other orbit", "solver failed"
ENDS = {
    arclength.FOLD: (NO_ORBIT, "the branch ends in a fold"),
    arclength.EQUILIBRIUM: (NO_ORBIT, "the cycle shrinks to an equilibrium"),
    arclength.SHORTER: (NO_ORBIT, "the orbit merges with one of a shorter period"),
    arclength.ROUND_FOLDS: (OTHER, "the branch folds back to another orbit at the same parameters"),
    arclength.ARRIVED: (FAILED, "the orbit exists"),
    arclength.LOST: (FAILED, "the branch cannot be followed"),
}


@dataclass(frozen=True)
class PriorPredictive(Result):
    """Periodic solves and outputs over the prior.

    Attributes
    ----------
    table : DataFrame
        One row per experiment: the fractions of draws whose solve converged, with another orbit than the one that
        continues the orbit at the prior medians, without an orbit, and with a failed solve although no reason for the
        absence of an orbit was found; and the fraction of the measured values ``inside`` the central 90 % of the
        outputs of the draws. In the row "all" a draw counts by its worst experiment, in this order.
    causes : dict of str to float
        Fraction of all solves (draws times experiments) by cause of failure.
    outputs : Bands
        Median and central 90 % band of the outputs over the draws, without noise.
    draws : int

    Examples
    --------
    With a wide prior of k near resonance, one draw in 25 belongs to another branch:

    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.2, duration=200,
    ...                   sampling_rate=8, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 1.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> expected = bp.prior_predictive(problem, draws=50, progress=False)
    >>> expected.table.loc["all", ["converged", "other orbit", "no orbit"]].to_dict()
    {'converged': 0.96, 'other orbit': 0.04, 'no orbit': 0.0}
    >>> list(expected.causes)
    ['other orbit (stalled): the branch folds back to another orbit at the same parameters']
    >>> expected.outputs.low["synthetic duffing"]["displacement"].shape
    (32,)
    """

    table: pd.DataFrame
    causes: dict[str, float]
    outputs: Bands
    draws: int

    def __repr__(self) -> str:
        causes = "".join(f"\n  {fraction:.1%}: {cause}" for cause, fraction in self.causes.items())
        table = self.table.to_string(float_format="{:.1%}".format)
        head = f"Periodic solves and outputs for {self.draws} draws from the prior"
        return f"{head}\n{table}" + (f"\nfailed solves:{causes}" if causes else "")


@in_one_thread
def prior_predictive(problem: Problem, *, draws: int = 200, seed: int = 0, progress: bool = True) -> PriorPredictive:
    """Solve every experiment for draws from the prior, and classify failed solves.

    The solves start from the orbits at the prior medians. After a failure, the branch of orbits is continued by
    arclength along the straight line to the draw: if it ends in a fold, shrinks to an equilibrium or merges with an
    orbit of a shorter period, the model has no such orbit at the draw; if it reaches the draw, the solver has failed.
    The sampler assigns zero density in both cases, correctly in the first and wrongly in the second.

    Parameters
    ----------
    problem : Problem
    draws : int
        At least 20.
    seed : int
    progress : bool
        Show a progress bar over the failed solves.

    Returns
    -------
    PriorPredictive

    Raises
    ------
    ValueError
        For fewer than 20 draws, or a negative seed.
    RuntimeError
        If no draw has a periodic solution.

    Examples
    --------
    Priors that contain the measured period:

    >>> expected = bp.prior_predictive(problem, draws=50, progress=False)
    >>> float(expected.table.loc["synthetic duffing", "inside"])
    1.0
    """
    count = _checks.integer("draws", draws, 20)
    theta = problem.joint_prior.sample(count, np.random.default_rng(_checks.integer("seed", seed, 0)))
    density, runs = problem.density(), [e.name for e in problem.experiments]
    solved = density.simulator.solve(theta)
    verdicts, causes = {}, Counter[str]()
    failed = [(name, i) for name in runs for i in np.flatnonzero(solved.statuses(name) != CONVERGED)]
    for name in runs:
        verdicts[name] = np.full(count, STATUSES[CONVERGED], dtype=object)
    for name, i in tqdm(failed, desc="failed solves", disable=not (progress and failed)):
        verdicts[name][i], why = ENDS[density.simulator.path_outcome(theta[i], name)]
        causes[f"{verdicts[name][i]} ({STATUSES[solved.statuses(name)[i]]}): {why}"] += 1
    outputs, converged = density.outputs(theta)
    if not converged.any():
        raise RuntimeError(
            f"problem: none of {count} draws from its priors has a periodic solution in all experiments. Narrow the "
            "priors around values at which problem.solve(theta) converges."
        )
    prediction = bands(problem, outputs, converged, {})
    order = [STATUSES[CONVERGED], OTHER, NO_ORBIT, FAILED]
    worst = np.max([[order.index(v) for v in row] for row in verdicts.values()], axis=0)
    verdicts["all"] = np.array(order, dtype=object)[worst]
    rows = {name: {what: float(np.mean(row == what)) for what in order} for name, row in verdicts.items()}
    table = pd.DataFrame.from_dict(rows, orient="index")
    table["inside"] = [*(_inside(problem, prediction, e) for e in range(len(problem.experiments))), np.nan]
    fractions = {cause: number / (count * len(runs)) for cause, number in causes.most_common()}
    return PriorPredictive(table, fractions, prediction, count)


def _inside(problem: Problem, prediction: Bands, index: int) -> float:
    """Return the fraction of the measured values within the band."""
    e = problem.experiments[index]
    within = [
        (values >= prediction.low[e.name][channel]) & (values <= prediction.high[e.name][channel])
        for channel, values in e.outputs.items()
    ]
    return float(np.mean(within if e.mask is None else np.array(within)[:, e.mask]))
