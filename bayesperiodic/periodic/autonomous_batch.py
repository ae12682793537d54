"""Many parameter vectors times several orbits of an autonomous model, whose frequency is part of the solution."""

from collections.abc import Sequence

import numpy as np

from bayesperiodic.periodic.batch import Anchor, BatchSolution
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, STALLED
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.factors import CyclicFactors
from bayesperiodic.periodic.family import Family, Found, solve_autonomous
from bayesperiodic.periodic.solve import collapsed, has_shorter_period

LARGEST_PART = 0.25
CORNER = np.zeros((1, 1))


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
        self._chords = [None if a.sensitivities is None else Chord(e, a) for e, a in zip(sets, anchors, strict=True)]

    def solve(self, parameters: np.ndarray, threads: int | None = None, *, keep: bool = False) -> BatchSolution:
        """Follow every orbit to its parameter vectors; see `batch.Batch.solve`."""
        every = np.empty((len(self._sets), *parameters.shape[-2:]))
        every[:] = parameters
        found = [
            [_follow(e, a, chord, theta) for theta in own]
            for e, a, chord, own in zip(self._sets, self._anchors, self._chords, every, strict=True)
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


class Chord:
    """Newton steps with the factors at an anchor, for orbits near it.

    Parameters
    ----------
    equations : PeriodicEquations
    anchor : Anchor
        With sensitivities.
    """

    def __init__(self, equations: PeriodicEquations, anchor: Anchor):
        self._equations = equations.at_frequency(anchor.frequency)
        self._factors, self._slopes, self._row = _bordered(self._equations, anchor.parameters, anchor.z)
        self._target = float(np.sum(self._row * anchor.z))
        self.orientation = self._factors.orientation(self._slopes, self._row[None], CORNER)

    def is_beyond_fold(self, theta: np.ndarray, found: Found) -> bool:
        """Return whether a fold lies between the anchor's orbit and another, so that it is on another branch."""
        equations = self._equations.at_frequency(float(found.values[0]))
        factors, slopes, row = _bordered(equations, theta, found.z)
        return factors.orientation(slopes, row[None], CORNER) * self.orientation < 0.0

    def solve(self, theta: np.ndarray, start: tuple[np.ndarray, float]) -> Found | None:
        """Return the orbit at other parameters, from a prediction; None where the steps do not shrink fast."""
        (z, frequency), history, previous = start, [], np.inf
        kernels = self._equations.kernels
        for _ in range(kernels.MAX_CHORDS):
            columns = self._equations.at_frequency(frequency).residual_jacobian(z, theta)
            missing = np.array([[self._target - np.sum(self._row * z)]])
            residual = -columns[None, :, : z.shape[1]]
            step = self._factors.solve_bordered(self._slopes, self._row[None], CORNER, residual, missing)
            if step is None:
                return None
            change, faster = np.ascontiguousarray(step[0][0]), float(step[1][0, 0])
            full = max(kernels.scaled_step(z, change), abs(faster) / frequency)
            if not full < min(kernels.FAR, kernels.CHORD_RATE * previous) or not frequency + faster > 0.0:
                return None
            z, frequency, previous = z + change, frequency + faster, full
            history.append((np.nan, full, 1.0))
            if full <= kernels.STEP_TOLERANCE:
                return Found(z, np.array([frequency]), CONVERGED, np.array(history))
        return None


def _follow(equations: PeriodicEquations, anchor: Anchor, chord: Chord | None, theta: np.ndarray) -> Found:
    """Solve from the anchor's linear prediction, or else in small steps; "other orbit" where one of them leaps."""
    there = _prediction(anchor, theta - anchor.parameters)
    near = chord.solve(theta, there) if chord is not None else None
    if near is not None and not _is_far(equations, near, there, anchor.z):
        return near
    found = _solve(equations, theta, there)
    if _continues(equations, chord, theta, found, there, anchor.z):
        return found
    return _creep(equations, anchor, chord, theta)


def _creep(equations: PeriodicEquations, anchor: Anchor, chord: Chord | None, theta: np.ndarray) -> Found:
    """Follow the orbit from the anchor's parameters in small steps, shorter ones where they fail or leap."""
    change, largest = theta - anchor.parameters, LARGEST_PART
    done, step, before = 0.0, largest, largest
    here, last = (anchor.z, anchor.frequency), _prediction(anchor, -before * change)
    while done < 1.0:
        ratio = step / before
        there = here[0] + ratio * (here[0] - last[0]), here[1] + ratio * (here[1] - last[1])
        at = anchor.parameters + change * (done + step)
        found = _solve(equations, at, there)
        if not _continues(equations, chord, at, found, there, here[0]):
            step *= 0.5
            if step < equations.kernels.SMALLEST_PART:
                return found._replace(code=OTHER_ORBIT) if found.code in (CONVERGED, STALLED) else found
            continue
        here, last = (found.z, float(found.values[0])), here
        done, before = done + step, step
        step = min(2.0 * step, largest, 1.0 - done)
    return found


def _continues(
    equations: PeriodicEquations,
    chord: Chord | None,
    theta: np.ndarray,
    found: Found,
    there: tuple[np.ndarray, float],
    start: np.ndarray,
) -> bool:
    """Return whether a solve has led to the continuation of the orbit at the start, and not to another branch."""
    if found.code != CONVERGED or _is_far(equations, found, there, start):
        return False
    return chord is None or not chord.is_beyond_fold(theta, found)


def _bordered(
    equations: PeriodicEquations, theta: np.ndarray, z: np.ndarray
) -> tuple[CyclicFactors, np.ndarray, np.ndarray]:
    """Return the factors of ∂g/∂z at an orbit, ∂g/∂frequency (1, points, states), and the phase condition's row."""
    columns = equations.residual_jacobian(z, theta)
    slopes = Family(equations, theta, (FREQUENCY,)).slopes(np.array([equations.frequency]), z, columns)
    return equations.factors(columns), slopes, equations.phase_row(z)


def _prediction(anchor: Anchor, change: np.ndarray) -> tuple[np.ndarray, float]:
    """Return z and the frequency that the anchor predicts after a change of the parameters."""
    if anchor.sensitivities is None or anchor.frequency_sensitivities is None:
        return anchor.z, anchor.frequency
    frequency = anchor.frequency + float(change @ anchor.frequency_sensitivities)
    return anchor.z + np.tensordot(change, anchor.sensitivities, 1), frequency if frequency > 0.0 else anchor.frequency


def _solve(equations: PeriodicEquations, theta: np.ndarray, start: tuple[np.ndarray, float]) -> Found:
    z, frequency = start
    return solve_autonomous(Family(equations.at_frequency(frequency), theta, (FREQUENCY,)), z, frequency, damped=False)


def _is_far(equations: PeriodicEquations, found: Found, predicted: tuple[np.ndarray, float], start: np.ndarray) -> bool:
    """Return whether an orbit is no continuation of the one at the start: shrunk, of a shorter period, or far off."""
    z, frequency = predicted
    if collapsed(found.z, start) or has_shorter_period(found.z):
        return True
    limit, off = equations.kernels.FAR, np.max(np.abs(found.z - z), axis=0)
    far = (off > limit * np.ptp(start, axis=0)) & (off > limit * np.max(np.abs(z - start), axis=0))
    return bool(far.any()) or bool(abs(found.values[0] - frequency) > limit * frequency)
