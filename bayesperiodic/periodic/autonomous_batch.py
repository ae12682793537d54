"""Many parameter vectors times several orbits of an autonomous model, whose frequency is part of the solution."""

from collections.abc import Sequence

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
        """Follow every orbit to its parameter vectors; see `batch.Batch.solve`."""
        every = np.empty((len(self._sets), *parameters.shape[-2:]))
        every[:] = parameters
        found = [
            [_follow(e, a, theta) for theta in own] for e, a, own in zip(self._sets, self._anchors, every, strict=True)
        ]
        outputs = [
            [e.at_frequency(float(f.values[0])).outputs(f.z, theta) for f, theta in zip(row, own, strict=True)]
            for e, row, own in zip(self._sets, found, every, strict=True)
        ]
        return BatchSolution(
            np.array([[f.z if keep else f.z[:0] for f in row] for row in found]),
            np.array(outputs),
            np.array([[f.values[0] for f in row] for row in found]),
            np.array([[f.code for f in row] for row in found]),
            np.array([[len(f.history) for f in row] for row in found]),
        )


def _follow(equations: PeriodicEquations, anchor: Anchor, theta: np.ndarray) -> Found:
    """Solve from the anchor's linear prediction, or else in small steps; "other orbit" where one of them leaps."""
    there = _prediction(anchor, theta - anchor.parameters)
    found = _solve(equations, theta, there)
    straight = found.code == CONVERGED and not np.any(found.history[:, 2] < 1.0)
    if straight and not _is_far(equations, found, there, anchor.z):
        return found
    return _creep(equations, anchor, theta)


def _creep(equations: PeriodicEquations, anchor: Anchor, theta: np.ndarray) -> Found:
    """Follow the orbit from the anchor's parameters in small steps, shorter ones where they fail or leap."""
    change, largest = theta - anchor.parameters, equations.kernels.LARGEST_PART
    done, step, before = 0.0, largest, largest
    here, last = (anchor.z, anchor.frequency), _prediction(anchor, -before * change)
    while done < 1.0:
        ratio = step / before
        there = here[0] + ratio * (here[0] - last[0]), here[1] + ratio * (here[1] - last[1])
        found = _solve(equations, anchor.parameters + change * (done + step), there)
        if found.code != CONVERGED or _is_far(equations, found, there, here[0]):
            step *= 0.5
            if step < equations.kernels.SMALLEST_PART:
                return found._replace(code=OTHER_ORBIT) if found.code == CONVERGED else found
            continue
        here, last = (found.z, float(found.values[0])), here
        done, before = done + step, step
        step = min(2.0 * step, largest, 1.0 - done)
    return found


def _prediction(anchor: Anchor, change: np.ndarray) -> tuple[np.ndarray, float]:
    """Return z and the frequency that the anchor predicts after a change of the parameters."""
    if anchor.sensitivities is None or anchor.frequency_sensitivities is None:
        return anchor.z, anchor.frequency
    frequency = anchor.frequency + float(change @ anchor.frequency_sensitivities)
    return anchor.z + np.tensordot(change, anchor.sensitivities, 1), frequency if frequency > 0.0 else anchor.frequency


def _solve(equations: PeriodicEquations, theta: np.ndarray, start: tuple[np.ndarray, float]) -> Found:
    z, frequency = start
    return solve_autonomous(Family(equations.at_frequency(frequency), theta, (FREQUENCY,)), z, frequency)


def _is_far(equations: PeriodicEquations, found: Found, predicted: tuple[np.ndarray, float], start: np.ndarray) -> bool:
    """Return whether an orbit is no continuation of the one at the start: shrunk, of a shorter period, or far off."""
    z, frequency = predicted
    if collapsed(found.z, start) or has_shorter_period(found.z):
        return True
    limit, off = equations.kernels.FAR, np.max(np.abs(found.z - z), axis=0)
    far = (off > limit * np.ptp(start, axis=0)) & (off > limit * np.max(np.abs(z - start), axis=0))
    return bool(far.any()) or bool(abs(found.values[0] - frequency) > limit * frequency)
