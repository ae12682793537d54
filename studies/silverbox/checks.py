"""Checks of the Silverbox estimates: grid, starts, and repeatability of the residual."""

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

import bayesperiodic as bp
from studies.silverbox.data import DRIVE_LINES, fold, medians, problem, solve, spread

OTHER_START = {"c": 0.3, "k1": 1.6, "k2": 1.0, "k3": 20.0, "g": 2.0, "u0": 0.02}


class Discretisation(NamedTuple):
    """Error of the response on the grid, against one with twice the points."""

    difference: np.ndarray  # (points,)
    fraction: float  # Its root mean square over the measured standard deviation
    allowed: float  # A tenth of the standard error of the mean period, over the same


def discretisation(recording: bp.Recording, experiment: bp.Experiment, theta: Mapping[str, float]) -> Discretisation:
    """Return the error of the response at the estimate, against the response with twice the points."""
    finer = fold(recording, 2 * experiment.samples)
    difference = solve(theta, experiment).outputs["response"] - solve(theta, finer).outputs["response"][::2]
    error_of_mean = experiment.scatter["response"] / np.sqrt(experiment.cycles)
    return Discretisation(
        difference,
        float(np.sqrt(np.mean(difference**2))) / spread(experiment),
        0.1 * float(error_of_mean) / spread(experiment),
    )


def starts_from_rest(experiment: bp.Experiment, theta: Mapping[str, float]) -> tuple[list[dict[str, Any]], list[float]]:
    """Return how the solver finds the response from rest at full amplitude, and the seconds.

    With a fifth of the damping Newton's method stalls, and the drive is increased in steps.
    """
    points = {
        "prior medians": medians(),
        "estimate": theta,
        "estimate, a fifth of its damping": {**theta, "c": 0.2 * theta["c"]},
    }
    found, seconds = [], []
    for at, values in points.items():
        start = time.perf_counter()
        s = solve(values, experiment)
        seconds.append(time.perf_counter() - start)
        found.append({"at": at, "status": s.status, "found_by": s.found_by, "iterations": s.iterations})
    return found, seconds


def other_start(experiment: bp.Experiment, fit: bp.MapEstimate) -> dict[str, Any]:
    """Return the difference of the estimate from another start, in standard deviations."""
    other = bp.map_estimate(problem(experiment), start=OTHER_START)
    return {"start": OTHER_START, "status": other.status, "shift": _shift(fit, other)}


def repetition(experiment: bp.Experiment, fit: bp.MapEstimate, recording: bp.Recording) -> dict[str, Any]:
    """Return the part of the residual that a second recording reproduces, and the shift of the estimates.

    The reproducible part is model error; the rest is the noise of the mean period, whatever its spectrum.
    """
    again = fold(recording, experiment.samples, experiment.harmonics["response"])
    other = bp.map_estimate(problem(again))
    one, two = fit.residuals[experiment.name]["response"], other.residuals[again.name]["response"]
    return {
        "repeats": float(np.sqrt(max(np.mean(one * two), 0.0))),
        "does_not": float(np.sqrt(0.5 * np.mean((one - two) ** 2))),
        "map": other.theta,
        "shift": _shift(fit, other),
    }


def beyond_drive(experiment: bp.Experiment, fit: bp.MapEstimate) -> dict[str, float]:
    """Return the share of the residual in harmonics above the drive's last line, and data against model there."""
    residual = np.fft.rfft(fit.residuals[experiment.name]["response"])
    measured = np.fft.rfft(experiment.outputs["response"])
    power = np.abs(residual[1:]) ** 2
    strongest = DRIVE_LINES + 1 + int(np.argmax(np.abs(measured[DRIVE_LINES + 1 :])))
    ratio = measured[strongest] / (measured[strongest] - residual[strongest])
    return {
        "share_of_residual_power": float(power[DRIVE_LINES:].sum() / power.sum()),
        "strongest": strongest * experiment.frequency,
        "measured_over_model": float(np.abs(ratio)),
        "phase_of_measured_over_model": float(np.angle(ratio)),
    }


def _shift(fit: bp.MapEstimate, other: bp.MapEstimate) -> dict[str, float]:
    return {name: (other.theta[name] - fit.theta[name]) / fit.sd[name] for name in fit.theta}
