"""Many parameter vectors times several orbits of an autonomous model, whose frequency is part of the solution."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesperiodic.periodic.batch import Anchor, BatchSolution
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.family import Family, Found, solve_autonomous
from bayesperiodic.periodic.solve import collapsed, has_shorter_period


class AutonomousBatch:
    """Orbits with their anchors, ready to be followed to many parameter vectors.

    Parameters
    ----------
    sets : sequence of PeriodicEquations
        Of one autonomous model on one grid.
    anchors : sequence of Anchor
        One an orbit.
    """

    def __init__(self, sets: Sequence[PeriodicEquations], anchors: Sequence[Anchor]):
        self._sets, self._anchors = tuple(sets), tuple(anchors)

    def solve(self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False) -> BatchSolution:
        """Follow every orbit to every parameter vector (solves, parameters); see `batch.Batch.solve`."""
        found = [[_follow(e, a, theta) for theta in parameters] for e, a in zip(self._sets, self._anchors, strict=True)]
        outputs = [
            [e.at_frequency(float(f.values[0])).outputs(f.z, theta) for f, theta in zip(row, parameters, strict=True)]
            for e, row in zip(self._sets, found, strict=True)
        ]
        return BatchSolution(
            np.array([[f.z if keep else f.z[:0] for f in row] for row in found]),
            np.array(outputs),
            np.array([[f.values[0] for f in row] for row in found]),
            np.array([[f.code for f in row] for row in found]),
            np.array([[len(f.history) for f in row] for row in found]),
        )


def _follow(equations: PeriodicEquations, anchor: Anchor, theta: np.ndarray) -> Found:
    """Solve from the anchor's linear prediction, or else in small steps; "other orbit" where that leads elsewhere."""
    found, predicted = _step(equations, anchor, theta)
    if found.code == CONVERGED and not _is_far(equations, found, predicted, anchor):
        return found
    z, frequency = anchor.z, anchor.frequency
    steps = equations.kernels.PATH_STEPS
    for part in range(1, steps + 1):
        between = anchor.parameters + (theta - anchor.parameters) * (part / steps)
        here = replace(anchor, z=z, frequency=frequency, sensitivities=None)
        found, predicted = _step(equations, here, between)
        if found.code != CONVERGED:
            return found
        if _is_far(equations, found, predicted, here):
            return found._replace(code=OTHER_ORBIT)
        z, frequency = found.z, float(found.values[0])
    return found


def _step(equations: PeriodicEquations, anchor: Anchor, theta: np.ndarray) -> tuple[Found, tuple[np.ndarray, float]]:
    z, frequency = anchor.z, anchor.frequency
    if anchor.sensitivities is not None and anchor.frequency_sensitivities is not None:
        change = theta - anchor.parameters
        z = z + np.tensordot(change, anchor.sensitivities, 1)
        frequency = frequency + float(change @ anchor.frequency_sensitivities)
        frequency = frequency if frequency > 0.0 else anchor.frequency
    here = equations.at_frequency(frequency)
    found = solve_autonomous(Family(here, theta, (FREQUENCY,)), z, frequency)
    return found, (z, frequency)


def _is_far(equations: PeriodicEquations, found: Found, predicted: tuple[np.ndarray, float], anchor: Anchor) -> bool:
    """Return whether an orbit is no continuation of the anchor's: shrunk, of a shorter period, or far off."""
    z, frequency = predicted
    if collapsed(found.z, anchor.z) or has_shorter_period(found.z):
        return True
    limit, off = equations.kernels.FAR, np.max(np.abs(found.z - z), axis=0)
    far = (off > limit * np.ptp(anchor.z, axis=0)) & (off > limit * np.max(np.abs(z - anchor.z), axis=0))
    return bool(far.any()) or bool(abs(found.values[0] - frequency) > limit * frequency)
