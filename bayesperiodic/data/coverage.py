"""Phases of a period that samples cover, the harmonics that they determine, and frequencies that they confuse."""

import numpy as np
from scipy.linalg import toeplitz

from bayesperiodic import _fourier

# Largest condition number of the amplitudes' normal equations where phases are missing.
LARGEST_CONDITION = 20.0
# Samples per cycle below which harmonics above half of the sampling rate are fitted too, so many of them, and samples
# for each of their unknowns.
SLOW, MOST_SLOW_HARMONICS, SAMPLES_PER_UNKNOWN = 8.0, 10, 4
# Numbers of samples in equal parts of the period that are as good as equal: their range, in samples and relatively.
EVEN_COUNTS, EVEN_SHARE = 2, 0.2
# Phases of which a text lists single ones, how near they are to be one, and the shortest interval that is listed.
LISTED_PHASES, SAME_PHASE, LISTED_INTERVAL = 6, 1e-3, 0.05


def per_cycle(time: np.ndarray, frequency: float) -> float:
    """Return the mean number of samples in a cycle."""
    return float((time.size - 1) / (np.ptp(time) * frequency))


def covered_harmonics(time: np.ndarray, fundamental: float, points: int, asked: int = 0) -> int:
    """Return the highest harmonic that the samples and a grid resolve, 0 if there is none.

    These are the harmonics below half of the sampling rate. With few samples per cycle, or if more are asked for, they
    are those that the phases of the samples determine, wherever in the recording they are.
    """
    limit = min(_fourier.highest_harmonic(points), (time.size - 2) // 2)
    if limit < 1:
        return 0
    many = per_cycle(time, fundamental)
    below = min(int((many - 1.0) / 2.0), limit)
    if many >= SLOW and below >= asked:
        return below
    slow = 0 if many >= SLOW else min(MOST_SLOW_HARMONICS, max((time.size // SAMPLES_PER_UNKNOWN - 1) // 2, 1))
    return determined_harmonics(time, fundamental, min(max(below, slow, asked), limit))[0]


def resolved_harmonics(time: np.ndarray, fundamental: float, points: int, asked: int = 0) -> int:
    """Return the highest harmonic that the samples and a grid resolve; raise a ValueError if there is none."""
    if (highest := covered_harmonics(time, fundamental, points, asked)) < 1:
        raise ValueError(
            f"recording: must have samples at three phases of its period at least, to determine the fundamental, got "
            f"{per_cycle(time, fundamental):.3g} samples per cycle of {fundamental:.6g} Hz, with "
            f"{missing_phases(time, fundamental)}; sample faster, or out of step with the period, or check the "
            "frequency."
        )
    return highest


def determined_harmonics(time: np.ndarray, fundamental: float, highest: int) -> tuple[int, np.ndarray]:
    """Return the harmonics whose amplitudes the samples determine, and what their phases do to the variances.

    The normal equations of many harmonics are ill-conditioned if phases are missing: of clipped samples that are left
    out, of bursts, of sampling in step with the period. The factors (harmonics + 1,) are 1 for samples at all phases
    alike. The harmonics are 0 if not even the fundamental is determined.
    """
    phase = fundamental * time
    bins = 2 * highest + 1
    count = np.bincount(((phase - phase[0]) % 1.0 * bins).astype(int), minlength=bins)[:bins]
    if count.min() > 0 and np.ptp(count) <= max(EVEN_COUNTS, EVEN_SHARE * count.max()):
        return highest, np.ones(highest + 1)
    moments = _fourier.moments(phase, 2 * highest) / time.size
    known, unknown = 0, highest + 1
    while unknown - known > 1:
        middle = min(max(2 * known, 1), (known + unknown) // 2)
        size = np.linalg.eigvalsh(toeplitz(moments[: 2 * middle + 1]))
        known, unknown = (middle, unknown) if size[0] * LARGEST_CONDITION > size[-1] else (known, middle)
    inverse = np.linalg.inv(toeplitz(moments[: 2 * known + 1]))
    return known, np.diag(inverse).real[known:]


def missing_phases(time: np.ndarray, fundamental: float) -> str:
    """Return in words which phases of the period have no samples."""
    phase = np.sort(fundamental * (time - time[0]) % 1.0)
    step = np.diff(phase, append=phase[0] + 1.0)
    far = np.flatnonzero(step > SAME_PHASE)
    if far.size <= LISTED_PHASES:
        return (
            f"all samples at the phases {', '.join(f'{p:.3g}' for p in np.sort(phase[far]))} [cycles after the first]"
        )
    order = far[np.argsort(-step[far])]
    long = [k for k in order[:3] if step[k] > LISTED_INTERVAL] or [order[0]]
    parts = ", ".join(f"{phase[k]:.3g} to {phase[k] + step[k]:.3g}" for k in sorted(long))
    return f"no samples at the phases {parts} [cycles after the first]"
