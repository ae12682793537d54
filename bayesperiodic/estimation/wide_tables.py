"""Response tables with larger errors, whose fits lead to the neighbourhood of those of the tables themselves.

A row that was measured before a jump must be reached by the branch of the model, within the resolution of its
frequency, and precise amplitudes leave each local optimum apart from the others. With larger errors the same rows
have few optima, from which the climbs to those of the tables are short.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.sweeps import tables

# Errors that are added: of sizes, relative to the largest of the table, of phases [rad], and of relative frequencies.
WIDE_SHARE, WIDE_PHASE, WIDE_RESOLUTION = 0.1, 0.1, 0.02


def widened(problem: Problem) -> Problem | None:
    """Return the problem with larger errors of its tables; None without tables."""
    wide: dict[str, Experiment] = {}
    for table in tables(problem).values():
        largest = _largest(table)
        wide |= {e.name: _widened(e, largest) for e in table}
    if not wide:
        return None
    return problem.replace(experiments=[wide.get(e.name, e) for e in problem.experiments])


def _largest(table: Iterable[Experiment]) -> dict[str, float]:
    """Return the largest value of each measured quantity."""
    largest: dict[str, float] = {}
    for one in (one for e in table for one in e.measurements if not one.signed):
        largest[one.label] = max(largest.get(one.label, 0.0), one.value)
    return largest


def _widened(experiment: Experiment, largest: dict[str, float]) -> Experiment:
    assert experiment.sweep is not None
    measurements = [
        one if one.sd is None else replace(one, sd=float(np.hypot(one.sd, _error(one.label, largest))))
        for one in experiment.measurements
    ]
    resolution = max(experiment.sweep.resolution, WIDE_RESOLUTION)
    return replace(experiment, measurements=measurements, sweep=replace(experiment.sweep, resolution=resolution))


def _error(label: str, largest: dict[str, float]) -> float:
    return WIDE_SHARE * largest[label] if label in largest else WIDE_PHASE
