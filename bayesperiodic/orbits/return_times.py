"""Times between the points of an orbit, by local regression of those between measured crossings."""

from typing import NamedTuple

import numpy as np

from bayesperiodic.orbits.cycles import REFINING_DEGREE, VALUE_GROWTH, Estimate, PairRuns, errors_by_run
from bayesperiodic.orbits.return_map import ReturnMap
from bayesperiodic.orbits.section import PoincareSection


class ReturnTimes(NamedTuple):
    """Times from the points of a cycle, in the order of its estimate, to the next ones, with errors."""

    each: np.ndarray  # (period,) [s]
    errors: np.ndarray  # of each run of neighbours, independent of each other, (runs, period) [s]
    bias: float  # of their sum, estimated [s]

    @property
    def sd(self) -> float:
        """Standard error of their sum, with the estimated bias [s]."""
        return float(np.hypot(np.sqrt(np.sum(self.errors.sum(axis=1) ** 2)), self.bias))


def return_times_of(section: PoincareSection, maps: ReturnMap, estimate: Estimate, closest: int) -> ReturnTimes | None:
    """Return the times between the points of a cycle; None for a forced section.

    A time is a smooth function of the point from which it is, fitted with the neighbours, weights and correction for
    noise of the return map. Errors of the closed points are propagated by its slopes. The method "boxes" has no fits:
    the times are those from the point `closest` of the section on, without errors.
    """
    if section.crossed is None or section.instants is None:
        return None
    fits, count = estimate.fits, len(estimate.points)
    if fits is None:
        return ReturnTimes(np.diff(section.instants[closest : closest + count + 1]), np.empty((0, count)), np.nan)
    returns = np.diff(section.instants)[maps.positions]
    phases = maps.phases(np.arange(count))

    def signals(index: np.ndarray, _: np.ndarray) -> np.ndarray:
        return returns[index, None, None]

    size = np.array([np.ptp(returns)])
    narrow, wide = (
        maps.regress(estimate.points, phases, one.bandwidths, REFINING_DEGREE, signals, size)
        for one in (fits.narrow, fits.wide)
    )
    runs = PairRuns.of(maps, fits.narrow.fit, fits.wide.fit)
    by_run, d = errors_by_run(maps, fits.narrow.fit, runs), estimate.points.shape[1]
    errors = np.stack(
        [
            by_run[:, d * j : d * (j + 1)] @ fit.slopes[:, 0, 0]
            + runs.sums(maps, fit.neighbours, fit.influence[:, 0, 0])
            for j, fit in enumerate(narrow)
        ],
        axis=1,
    )
    each, others = (np.array([float(fit.value[0, 0]) for fit in some]) for some in (narrow, wide))
    moved = np.sum([fit.slopes[:, 0, 0] for fit in narrow] * maps.wrap(fits.wide.points - estimate.points))
    return ReturnTimes(each, errors, float(np.hypot(np.sum(others - each), moved)) / VALUE_GROWTH)
