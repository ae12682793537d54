"""When a sampling run is long enough."""

from collections.abc import Sequence

import numpy as np

from bayesperiodic.inference.sampling import chains

LENGTHS = 50.0
LENGTHS_ALONE = 500.0
TAU_CHANGE = 0.05
RHAT = 1.005
QUANTILE_SPREAD = 0.25
APART = 8.0


def shortfall(kept: np.ndarray, tau: np.ndarray, last: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Return what the stop rule misses, in words; nothing if it is passed.

    An ensemble of 32 walkers that is 50 autocorrelation times long holds 1600 independent draws, a walker alone would
    hold 50, so that it has to be 500 long; all else is the same for both. The mean of a walker scatters by its standard
    deviation over √(steps/tau); one that is eight times as far off stays in a mode of its own.

    Parameters
    ----------
    kept : array (ensembles, steps, walkers, coordinates)
    tau, last : array (coordinates,)
        Autocorrelation time [steps], now and at the check before.
    labels : sequence of str
        Names of the coordinates.
    """
    found = []
    if not np.isfinite(tau).all():
        still = [label for label, time in zip(labels, tau, strict=True) if not np.isfinite(time)]
        return [f"{', '.join(map(repr, still))} not moving, as every proposal is refused"]
    needed = LENGTHS if kept.shape[2] > 1 else LENGTHS_ALONE
    if (lengths := kept.shape[1] / tau.max()) < needed:
        found.append(f"length only {lengths:.0f} tau")
    if (change := np.max(np.abs(tau - last) / tau)) > TAU_CHANGE:
        found.append(f"tau changed by {change:.0%}" if np.isfinite(change) else "tau known from one check alone")
    if (spread := chains.quantile_spread(kept).max()) > QUANTILE_SPREAD:
        found.append(f"quantiles of the ensembles {spread:.2f} sd apart")
    if not found and (alone := _furthest(kept, tau)) > APART:
        found.append(f"walkers that stay apart, by {alone:.0f} standard errors")
    if not found and (worst := chains.rhat(kept).max()) > RHAT:
        found.append(f"R-hat {worst:.3f}")
    return found


def _furthest(kept: np.ndarray, tau: np.ndarray) -> float:
    """Return how far the mean of a walker is from that of all, at most, in standard errors of such a mean."""
    off = np.abs(kept.mean(axis=1) - kept.mean(axis=(0, 1, 2)))
    return float(np.max(off / (kept.std(axis=(0, 1, 2)) * np.sqrt(tau / kept.shape[1]))))
