"""Times between the points of an orbit, by local regression of those between measured crossings."""

from typing import NamedTuple

import numpy as np

from bayesperiodic.orbits.cycles import REFINING_DEGREE, VALUE_GROWTH, WIDENED, Estimate, errors_by_run
from bayesperiodic.orbits.return_map import ReturnMap
from bayesperiodic.orbits.section import PoincareSection


class ReturnTimes(NamedTuple):
    """Times from the points of an orbit to the next ones, and the error of their sum."""

    times: np.ndarray  # from the first point on, (period,) [s]
    sd: float  # of their sum, with the estimated bias [s]


def return_times_of(
    section: PoincareSection, maps: ReturnMap, estimate: Estimate, closest: int, shift: int
) -> ReturnTimes | None:
    """Return the times of a cycle from its point `shift` returns after the first one on; None for a forced section.

    A time is a smooth function of the point from which it is, fitted with the neighbours, weights and correction for
    noise of the return map. Errors of the closed points are propagated by its slopes. The method "boxes" has no fits:
    the times are those of the closest measured cycle, without errors.
    """
    if section.crossed is None or section.instants is None:
        return None
    period = len(estimate.points) // maps.steps
    if estimate.fits is None:
        return ReturnTimes(np.diff(section.instants[closest : closest + period + 1]), np.nan)
    returns = np.diff(section.instants)[maps.positions // maps.steps] / maps.steps
    phases, fits = maps.phases(np.arange(len(estimate.points))), estimate.fits

    def signals(index: np.ndarray, _: np.ndarray) -> np.ndarray:
        return returns[index, None]

    narrow = maps.regress(estimate.points, phases, fits.bandwidths, REFINING_DEGREE, signals)
    wide = maps.regress(fits.wide_points, phases, WIDENED * fits.bandwidths, REFINING_DEGREE, signals)
    pairs, runs, by_run = errors_by_run(maps, fits.narrow)
    d, errors = estimate.points.shape[1], np.zeros(len(by_run))
    for j, fit in enumerate(narrow):
        errors += by_run[:, d * j : d * (j + 1)] @ fit.slopes[:, 0]
        np.add.at(errors, runs[np.searchsorted(pairs, maps.positions[fit.neighbours])], fit.influence[:, 0])
    times, others = (np.array([float(fit.value[0]) for fit in fits_]) for fits_ in (narrow, wide))
    bias = float(np.sum(others - times)) / VALUE_GROWTH
    by_return = times.reshape(period, maps.steps).sum(axis=1)
    return ReturnTimes(np.roll(by_return, -shift), float(np.hypot(np.sqrt(np.sum(errors**2)), bias)))
