"""Whether draws have another mode than the one that a point belongs to."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from bayesperiodic.diagnosis.distances import Sample

MASS, DEPTH, ERRORS = 0.05, 0.7, 3.0
GRID = 256
ENDS = (0.001, 0.999)


def has_other_mode(sample: Sample, point: float) -> bool:
    """Return whether more than 5 % of the draws lie beyond a valley of their density, as seen from a point.

    The density is a kernel estimate with Silverman's bandwidth for the effective sample size, in every batch. A valley
    is lower than 0.7 of the lower of the peaks on its two sides. Both the mass and the depth must hold by three Monte
    Carlo errors, so neither skewness nor the noise of a flat top makes a mode.
    """
    x = sample.whole
    spread = min(x.std(), float(np.subtract(*np.quantile(x, [0.75, 0.25]))) / 1.349) or x.std()
    if not spread > 0.0:
        return False
    bandwidth = 0.9 * spread * sample.size**-0.2
    low, high = np.quantile(x, ENDS)
    edges = np.linspace(low - 3 * bandwidth, high + 3 * bandwidth, GRID + 1)
    width = edges[1] - edges[0]
    inside = np.clip(((sample.batches - edges[0]) / width).astype(int), 0, GRID - 1)
    batches = len(inside)
    counts = np.bincount((inside + GRID * np.arange(batches)[:, None]).ravel(), minlength=batches * GRID)
    shares = counts.reshape(batches, GRID) / inside.shape[1]
    density = gaussian_filter1d(shares, bandwidth / width, mode="constant")
    return any(
        _separates(density, shares, at, point > edges[at] + 0.5 * width) for at in _valleys(density.mean(axis=0))
    )


def _valleys(density: np.ndarray) -> np.ndarray:
    """Return where a density has local minima."""
    falls, rises = np.diff(density)[:-1] < 0.0, np.diff(density)[1:] >= 0.0
    return np.flatnonzero(falls & rises) + 1


def _separates(density: np.ndarray, shares: np.ndarray, valley: int, point_above: bool) -> bool:
    """Return whether a valley is deep enough and the mass beyond it large enough, by the batches (batches, grid)."""
    mean = density.mean(axis=0)
    peaks = int(np.argmax(mean[:valley])), valley + int(np.argmax(mean[valley:]))
    peak = min(peaks, key=lambda place: mean[place])
    far = shares[:, :valley] if point_above else shares[:, valley:]
    return _beyond_errors(far.sum(axis=1) - MASS) and _beyond_errors(DEPTH * density[:, peak] - density[:, valley])


def _beyond_errors(values: np.ndarray) -> bool:
    """Return whether the mean over batches is above zero by three standard errors."""
    return bool(values.mean() > ERRORS * values.std(ddof=1) / np.sqrt(len(values)))
