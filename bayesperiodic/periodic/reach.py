"""Whether a branch of orbits gets from one parameter vector to another, and if not, what ends it."""

from itertools import islice

import numpy as np

from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.family import PARAMETERS, Family
from bayesperiodic.periodic.trace import trace

ARRIVED, ROUND_FOLDS, FOLD, EQUILIBRIUM, SHORTER, LOST = (
    "arrived",
    "round folds",
    "fold",
    "equilibrium",
    "shorter period",
    "lost",
)
STEP, MOST_POINTS = 0.1, 300


def reach(equations: PeriodicEquations, anchor: Anchor, parameters: np.ndarray) -> str:
    """Return how the branch through an anchor ends on the straight way from its parameters to others.

    Returns
    -------
    str
        "arrived" where it leads to an orbit there; "round folds" where it does after turning back and forth, so that it
        is not the orbit that small steps follow; "fold" where it turns back for good or past its start; "equilibrium"
        where the cycle of an autonomous model shrinks to nothing (a Hopf point); "shorter period" where an orbit merges
        with one of fewer forcing periods (a period doubling); "lost" where the continuation fails, so that nothing is
        known.
    """
    change = parameters - anchor.parameters
    autonomous = equations.model.autonomous
    free = (PARAMETERS, FREQUENCY) if autonomous else (PARAMETERS,)
    here = equations.at_frequency(anchor.frequency) if autonomous else equations
    values = np.array([0.0, anchor.frequency]) if autonomous else np.zeros(1)
    family = Family(here, anchor.parameters, free, parameter_change=change)
    once, folded = equations.kernels.repetitions(anchor.z, equations.grid.periods), False
    before = anchor.z
    with np.errstate(all="ignore"):
        for point in islice(trace(family, anchor.z, values, until=1.0, step=STEP), MOST_POINTS):
            if autonomous and _is_reversed(point.z, before):
                return EQUILIBRIUM
            if equations.kernels.repetitions(point.z, equations.grid.periods) > once:
                return SHORTER
            if point.values[0] == 1.0:
                return ROUND_FOLDS if folded else ARRIVED
            folded |= bool(point.tangent[1][0] < 0.0)
            before = point.z
    return FOLD if folded else LOST


def _is_reversed(z: np.ndarray, before: np.ndarray) -> bool:
    """Return whether a cycle has passed through zero: beyond a Hopf point it is the same one half a period later."""
    return bool(np.sum((z - z.mean(axis=0)) * (before - before.mean(axis=0))) <= 0.0)
