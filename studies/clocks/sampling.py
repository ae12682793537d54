"""Gaps, missing samples and slow sampling: amplitudes and their stated errors against the truth."""

import warnings
from typing import Any

import numpy as np
from scipy import stats

import bayesperiodic as bp
from studies import common

# Truth: amplitudes of harmonics 0 to 3 of a period of 1 s, and the standard deviation of the noise.
AMPLITUDES, NOISE = np.array([1.0, -1j, 0.3, 0.0]), 0.1
EVEN = np.arange(0.0, 60.0, 0.05)
SLOW_SAMPLES, JITTER = 200, 0.3
KINDS = (
    "full", "gap of half a period", "gap of 17 periods", "two ends", "30 % missing", "70 % missing", "90 % missing",
    "0.7 samples per period", "0.1 samples per period", "0.1 samples per period, jitter", "bursts",
)  # fmt: skip
COVERED, FALSE_ALARM = 0.9, 0.01


def times(kind: str, random: np.random.Generator) -> np.ndarray:
    """Return the times [s] of a sampling."""
    slow = np.arange(SLOW_SAMPLES)
    if kind.endswith("missing"):
        return EVEN[random.random(EVEN.size) > float(kind.split()[0]) / 100.0]
    return {
        "full": EVEN,
        "gap of half a period": EVEN[(EVEN < 30.0) | (EVEN > 30.5)],
        "gap of 17 periods": EVEN[(EVEN < 14.0) | (EVEN > 31.3)],
        "two ends": EVEN[(EVEN < 8.0) | (EVEN > 51.3)],
        "0.7 samples per period": 1.4137 * slow,
        "0.1 samples per period": 10.137 * slow,
        "0.1 samples per period, jitter": 10.137 * slow + JITTER * random.standard_normal(SLOW_SAMPLES),
        "bursts": EVEN[EVEN % 7.3 < 1.5],
    }[kind]


def noise(time: np.ndarray, correlation: float, random: np.random.Generator) -> np.ndarray:
    """Return noise of a correlation time [s] at any times; 0 for white noise."""
    values = random.standard_normal(time.size)
    if correlation > 0.0:
        memory = np.exp(-np.diff(time) / correlation)
        for i, share in enumerate(memory, 1):
            values[i] = share * values[i - 1] + np.sqrt(1.0 - share**2) * values[i]
    return NOISE * values


def amplitudes_covered(kind: str, correlation: float, seed: int) -> dict[str, Any]:
    """Return errors of amplitudes [standard errors], and whether they are in their intervals, by harmonic."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    time = times(kind, random)
    x = np.real(np.exp(2j * np.pi * np.outer(time, np.arange(AMPLITUDES.size))) @ AMPLITUDES)
    recording = bp.Recording.from_arrays(time, {"x": x + noise(time, correlation, random)})
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        e = recording.fold(32, frequency=1.0, harmonics=AMPLITUDES.size - 1)
    found = np.fft.rfft(e.outputs["x"])[: AMPLITUDES.size] / 16.0
    found[0] /= 2.0
    ratio = np.abs(found - AMPLITUDES) ** 2 / e.amplitude_variance["x"]
    freedom = e.amplitude_freedom["x"]
    limit = np.r_[stats.f.ppf(COVERED, 1, freedom[0]), stats.f.ppf(COVERED, 2, freedom[1:])]
    return {
        "kind": kind, "correlation": correlation, "seed": seed, "ratio": ratio.tolist(),
        "inside": (ratio < limit).tolist(), "cycles": e.cycles, "warnings": [str(w.message) for w in warned],
    }  # fmt: skip


def coverage(replicates: int, correlation: float = 0.0, *, here: bool = False) -> list[common.Row]:
    """Return a row of coverage for each sampling, with the 99 % band of the intended one."""
    rows = []
    for kind in KINDS:
        tasks = [(kind, correlation, seed) for seed in range(replicates)]
        lines = [*common.each(amplitudes_covered, tasks, here=here)]
        inside = np.array([line["inside"] for line in lines])
        # Harmonics of one data set count as independent, which their errors of white noise are.
        low, high = stats.binom.interval(1.0 - FALSE_ALARM, inside.size, COVERED)
        rows.append(
            common.row(f"{kind}: coverage of amplitudes", float(inside.mean()), low / inside.size, high / inside.size)
        )
    return rows
