"""Whether a section is one of chaos: neither periodic, nor quasi-periodic, nor without a return map."""

import numpy as np

from bayesperiodic.orbits.local import LocalMaps

LONGEST_PERIOD = 32
# Of the distance of two points taken at random.
SAME_POINT = 0.05
UNPREDICTED = 0.2
# Neighbours that part by less than this factor in so many steps do not part at all.
PARTED = 2.5
PARTING_STEPS = 6
PROBES = 400
NEIGHBOUR = 8


def check_chaos(maps: LocalMaps, section: np.ndarray) -> None:
    """Raise a ValueError for a section that holds no chaotic return map, and say what it seems to be.

    Parameters
    ----------
    maps : LocalMaps
    section : array (n, 2)
        All points in the order of time, in units of the attractor's size.
    """
    generator = np.random.default_rng(0)
    one, other = generator.integers(len(section), size=(2, 4 * PROBES))
    apart = np.median(_distance(maps, section[one], section[other]))
    for period in range(1, min(LONGEST_PERIOD, len(section) // 10) + 1):
        if np.median(_distance(maps, section[period:], section[:-period])) < SAME_POINT * apart:
            raise ValueError(
                f"section: a motion of period {period} is not allowed; its points come back to themselves every "
                f"{period} returns. Fold the recording with periods={period} instead."
            )
    centre = generator.choice(len(maps.arguments) - PARTING_STEPS, min(PROBES, len(section) // 4), replace=False)
    neighbour = _neighbours(maps, centre)
    now = np.median(_distance(maps, section[centre], section[neighbour]))
    images = _distance(maps, section[centre + 1], section[neighbour + 1])
    if np.median(images) > UNPREDICTED * apart:
        raise ValueError(
            f"section: images of neighbouring points {np.median(images) / apart:.0%} as far apart as any two points "
            "are not allowed; no return map is to be seen. A wrong frequency, or noise as large as the motion, is "
            "suspected."
        )
    later = np.median(_distance(maps, section[centre + PARTING_STEPS], section[neighbour + PARTING_STEPS]))
    if later < PARTED * now:
        raise ValueError(
            "section: a quasi-periodic motion is not allowed; neighbouring points stay together, so that it is not "
            "chaotic and shows no periodic orbits. Record it where it is chaotic."
        )


def _neighbours(maps: LocalMaps, centre: np.ndarray) -> np.ndarray:
    """Return a near neighbour of each point that is not its neighbour in time and has a future."""
    _, index = maps.nearest(maps.arguments[centre], NEIGHBOUR + 2 * PARTING_STEPS)
    far = (np.abs(index - centre[:, None]) > PARTING_STEPS) & (index < len(maps.arguments) - PARTING_STEPS)
    rank = np.cumsum(far, axis=1)
    column = np.argmax(rank >= np.minimum(NEIGHBOUR, rank[:, -1:]), axis=1)
    return index[np.arange(len(centre)), column]


def _distance(maps: LocalMaps, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(maps.wrap(one - other)).max(axis=1)
