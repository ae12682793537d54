"""How steep the friction of the landing gear may be: theta10 from 30 to 3000 s/m, solved from static equilibrium."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.landing_gear.identification import DISPLACEMENT, DRIVES, FORCE, KEPT, SAMPLES
from studies.landing_gear.rig import HARMONICS, MEAN_COMPRESSION, Run
from studies.landing_gear.truth import GEAR

SLOPES = (30.0, 100.0, 300.0, 1000.0, 3000.0)


def solve(run: Run, slope: float, drive: str) -> tuple[bp.PeriodicSolution, bool]:
    """Return the gear's motion in an experiment, and whether the solver warned that the grid is too coarse."""
    gear = GEAR | {"theta10": slope}
    phase = np.exp(2j * np.pi * np.outer(np.arange(SAMPLES) / SAMPLES, list(HARMONICS)))
    moved = MEAN_COMPRESSION + run.stroke * (phase @ list(HARMONICS.values())).real
    found, warned = _solve(run, gear, DISPLACEMENT, moved)
    if drive == FORCE:
        amplitudes = np.fft.rfft(found.outputs["force"])
        amplitudes[KEPT[FORCE]["force"] + 1 :] = 0.0
        found, warned = _solve(run, gear, FORCE, np.fft.irfft(amplitudes, SAMPLES))
    return found, warned


def _solve(run: Run, gear: Mapping[str, float], drive: str, signal: np.ndarray) -> tuple[bp.PeriodicSolution, bool]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = bp.solve_periodic(
            bp.models.landing_gear(drive), gear, {drive: signal}, frequency=run.frequency, samples=SAMPLES
        )
    return found, any("steps of the grid" in str(warning.message) for warning in told)


def account(runs: Sequence[Run]) -> dict[str, Any]:
    """Return by direction and slope how the solves of all experiments ended, and how many warned."""
    result: dict[str, Any] = {}
    for drive in DRIVES:
        result[drive] = {}
        for slope in SLOPES:
            every = [solve(run, slope, drive) for run in runs]
            statuses = Counter(found.status for found, _ in every)
            result[drive][f"{slope:g}"] = {"status": dict(statuses), "warned": sum(warned for _, warned in every)}
    return result


def line(found: Mapping[str, Any]) -> str:
    """Return what is printed."""
    every = [one for by_slope in found.values() for one in by_slope.values()]
    total = sum(sum(one["status"].values()) for one in every)
    converged = sum(one["status"].get("converged", 0) for one in every)
    warned = ", ".join(f"{one['warned']} at {slope} s/m" for slope, one in found[FORCE].items() if one["warned"])
    return (
        f"  friction slope 30 to 3000 s/m: {converged} of {total} solves converged on {SAMPLES} points; force given, "
        f"the solver warned that this is too coarse for {warned or 'none'}"
    )
