"""Repeated tests of a friction damper: how far apart two estimates are, in units of their standard deviations.

The tests are measured by A. Coble and others, github.com/ARTS-Laboratory/Dataset-Friction-Damper-with-Backlash.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import bayesperiodic as bp
from studies import common

FOLDER, SERIES = "friction_damper", (2, 3)
TESTS = ("30lb_0.5Hz_0.5in", "30lb_0.5Hz_1.5in", "30lb_1Hz_0.5in", "30lb_1Hz_1.5in")
INCH, KIP = 0.0254, 4448.22
PRIORS: dict[str, Any] = {
    "Kx": bp.LogNormal(5e3, 1.0), "F0": bp.Normal(0.0, 1e3), "Kw": bp.LogNormal(1e4, 1.0),
    "rho": bp.LogNormal(5e2, 1.0),
}  # fmt: skip
# Harmonics of the force that are compared: fewer would not determine four parameters and a variance.
HARMONICS = 15
FAR, CONFIDENCE = 1.96, 0.95
SDS = ("sd", "robust_sd")


def path_of(series: int, test: str) -> Path | None:
    """Return the file of a test, None if it is missing."""
    found = common.find_data(None, f"{FOLDER}/test_{series}_{test}.npz")
    return found and found[0]


def estimate(path: Path) -> bp.MapEstimate:
    """Return the estimate from the steady part of a test."""
    data = np.load(path)
    recording = bp.Recording.from_arrays(
        data["time_s"], {"force": KIP * data["force_kip"]}, {"displacement": INCH * data["displacement_in"]}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem = bp.Problem(
            bp.models.dahl, [recording.fold(harmonics={"force": HARMONICS})], priors=PRIORS, fixed={"K": 0.0}
        )
        return bp.map_estimate(problem, progress=False)


def repeats() -> dict[str, Any] | None:
    """Return z of all parameters of all pairs, by the kind of interval, and what a share of large ones says."""
    files = {(series, test): path_of(series, test) for test in TESTS for series in SERIES}
    paths = {key: path for key, path in files.items() if path is not None}
    if len(paths) < len(files):
        return None
    fits = {key: estimate(path) for key, path in paths.items()}
    result: dict[str, Any] = {"pairs": len(TESTS), "parameters": len(PRIORS)}
    result["misspecified"] = sum(fit.misspecified for fit in fits.values())
    result["unexplained"] = [fit.fvu["force"] for fit in fits.values()]
    for kind in SDS:
        z = [
            (one.theta[q] - other.theta[q]) / np.hypot(getattr(one, kind)[q], getattr(other, kind)[q])
            for one, other in ([fits[series, test] for series in SERIES] for test in TESTS)
            for q in PRIORS
        ]
        far = int(np.sum(np.abs(z) > FAR))
        share = stats.binomtest(far, len(z)).proportion_ci(CONFIDENCE)
        result[kind] = {
            "z": list(map(float, z)),
            "far": far,
            "of": len(z),
            "share": [float(share.low), float(share.high)],
            "rms": float(np.sqrt(np.mean(np.square(z)))),
        }
    return result
