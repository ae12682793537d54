"""The authors' values by continuation, against eigenvalues and a long time integration that know nothing of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.flutter.reference import hopf, settled
from studies.flutter.rig import AUTHORS, RIG, SAMPLES, SENSORS, cycles

SPEEDS = (15.6, 16.5, 17.3)
STATES = ("h", "alpha", "w")
# The study's grid, and one on which the series has converged.
GRIDS = (SAMPLES, 2 * SAMPLES)
CURVE = 4000


def account() -> dict[str, Any]:
    """Return the Hopf point and the stable cycles by both ways, and by how much they differ, by points of the grid."""
    by_grid = {points: cycles(RIG | AUTHORS | SENSORS, points) for points in GRIDS}
    point, (speed, frequency) = by_grid[SAMPLES].hopf, hopf()
    return {
        "hopf_speed": {"continuation": point.value, "eigenvalues": speed},
        "hopf_frequency": {"continuation": point.frequency, "eigenvalues": frequency},
        "stable_cycles": {
            f"{points} points": {f"{at:g} m/s": _differences(along.at("stable", at), at) for at in SPEEDS}
            for points, along in by_grid.items()
        },
    }


def _differences(orbit: bp.PeriodicSolution, speed: float) -> dict[str, float]:
    """Return the relative differences of the frequency and of each state's amplitude from a time integration's."""
    frequency, states = settled(speed)
    return {"frequency": float(orbit.frequency / frequency) - 1.0} | {
        name: half_range(orbit.states[name]) / half_range(own) - 1.0 for name, own in zip(STATES, states, strict=True)
    }


def half_range(values: np.ndarray) -> float:
    """Return half the range of a periodic signal, between its samples too, by its Fourier series."""
    return 0.5 * float(np.ptp(np.fft.irfft(np.fft.rfft(values), CURVE))) * CURVE / values.size


def line(found: Mapping[str, Any]) -> str:
    """Return what is printed."""
    speed, frequency = found["hopf_speed"], found["hopf_frequency"]
    off = {
        points: max(abs(one[name]) for one in by_speed.values() for name in STATES)
        for points, by_speed in found["stable_cycles"].items()
    }
    told = ", ".join(f"{most:.1e} with {points}" for points, most in off.items())
    return (
        f"  the authors' values: Hopf point {speed['continuation']:.4f} m/s, {frequency['continuation']:.5f} Hz "
        f"(eigenvalues {speed['eigenvalues']:.4f}, {frequency['eigenvalues']:.5f}); amplitudes of stable cycles off a "
        f"time integration's by at most {told}"
    )
