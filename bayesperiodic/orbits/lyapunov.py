"""The largest Lyapunov exponent of pieces of a section, from the slopes of local return maps."""

from math import comb
from typing import NamedTuple

import numpy as np

from bayesperiodic.orbits.return_map import FEWEST_FITTED, KERNEL_REACH, SMALLEST_BANDWIDTH, ReturnMap

# Returns over which the direction of growth develops.
ALIGNING = 5
# Neighbours of a local fit, as a multiple of the number of quadratic terms.
FITTED_EACH = 3.0


class Growth(NamedTuple):
    """Mean logarithm of the growth of small differences in a return, and its standard error."""

    mean: float
    sd: float


def growth_of_pieces(pieces: np.ndarray, noise: np.ndarray, turn: np.ndarray) -> Growth:
    """Return the growth in a return from pieces (pieces, points, d) of consecutive points in units of their size.

    A vector is multiplied by the slopes of the return map at the points in their order, and its length is reduced to
    one each time (Eckmann and Ruelle, Rev. Mod. Phys. 57 (1985) 617-656, section V). The slopes are those of quadratic
    maps fitted to neighbours, without the attenuation by noise (d,), see `ReturnMap`; `turn` (d,) is a turn of angles,
    and infinite for others. The error is that of the mean over independent pieces. The systematic error of finite
    neighbourhoods is not included: it is that of other pieces of the same number, noise and attractor.
    """
    count, length, d = pieces.shape
    points, stretches = pieces.reshape(-1, d), np.repeat(np.arange(count), length)
    after = np.diff(points, axis=0)
    after -= np.where(np.isfinite(turn), turn, 0.0) * np.round(after / turn)
    increments = np.where((np.diff(stretches) == 0)[:, None], after, np.nan)
    maps = ReturnMap(points, increments, turn, not np.isfinite(turn).any(), noise, stretches)
    neighbours = max(FEWEST_FITTED, int(FITTED_EACH * comb(d + 2, 2)))
    phases = np.zeros(len(maps.arguments))
    while 8 * neighbours < maps.count:
        reach = np.median(maps.nearest(maps.arguments, phases, neighbours)[0][:, -1])
        if reach > KERNEL_REACH * SMALLEST_BANDWIDTH * noise.max():
            break
        neighbours = int(1.5 * neighbours)
    fit = maps.fit(maps.arguments, phases, neighbours, 2, influence=False, shrunk=True)
    slopes = fit.jacobian.reshape(count, length - 1, d, d)
    direction, growths = np.full((count, d), d**-0.5), []
    for step in range(length - 1):
        direction = np.einsum("pij,pj->pi", slopes[:, step], direction)
        size = np.linalg.norm(direction, axis=1)
        direction /= size[:, None]
        growths.append(np.log(size))
    each = np.mean(growths[ALIGNING:], axis=0)
    return Growth(float(each.mean()), float(each.std(ddof=1) / np.sqrt(count)))
