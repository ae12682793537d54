"""Recording of the chaotic pendulum: simulated with noise, or read from a file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common

OMEGA = 9.09
FREQUENCY = OMEGA / (2 * np.pi)
TRUTH = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
KNOWN = {"a": 0.11, "g": 9.81, "v0": 0.05}
COORDINATES, ANGLES = ("angle", "rate"), ("angle",)
UNITS = {"angle": "rad", "rate": "rad/s"}
# Size of the attractor: a turn, and the range of the rate.
SIZE = {"angle": 6.28, "rate": 32.6}
PERIODS, QUICK_PERIODS, SETTLING = 42_754, 6_000, 50
SAMPLES = 40


def simulate(periods: int, seed: int) -> bp.Recording:
    """Return a recording without noise; the seed chooses where on the attractor it starts."""
    start = np.random.default_rng(seed).uniform([-np.pi, -5.0], [np.pi, 5.0])
    whole = bp.simulate(
        bp.models.pendulum, TRUTH, frequency=FREQUENCY, duration=(SETTLING + periods) / FREQUENCY,
        sampling_rate=SAMPLES * FREQUENCY, start={"phi": start[0], "dphi": start[1]},
    )  # fmt: skip
    # The drive's phase stays: the settling takes whole periods.
    return whole.between(SETTLING / FREQUENCY, whole.time[-1])


def with_noise(recording: bp.Recording, fraction: float, seed: int) -> bp.Recording:
    """Return a synthetic recording with independent normal noise, a fraction of the attractor's size."""
    generator = np.random.default_rng([seed, round(1e6 * fraction)])
    outputs = {
        name: values + fraction * SIZE[name] * generator.standard_normal(values.size)
        for name, values in recording.outputs.items()
    }
    return replace(recording, outputs=outputs)


def get(data: Path | None, quick: bool, seed: int) -> tuple[bp.Recording, dict[str, Any]]:
    """Return the recording without added noise, simulated unless a file is given, and its description.

    A file has the columns time [s], angle [rad] and rate [rad/s], of a pendulum driven at ω = 9.09 rad/s, whose pivot
    moves by a = 0.11 m; k1, k2 and k3 have the values of `TRUTH` where they are fixed.
    """
    found = common.find_data(data, "") if data else None
    if data is None:
        recording = simulate(QUICK_PERIODS if quick else PERIODS, seed)
    else:
        recording = bp.Recording.from_csv(data, time="time", outputs={name: name for name in COORDINATES})
    size = {"values": sum(v.size for v in recording.outputs.values())}
    return recording, common.described(found) | size | {"drive_periods": int(np.ptp(recording.time) * FREQUENCY)}


def section_of(recording: bp.Recording) -> bp.PoincareSection:
    """Return the section at the drive's phase 0, where the pivot is lowest."""
    return bp.PoincareSection.from_recording(recording, COORDINATES, frequency=FREQUENCY, angles=ANGLES)
