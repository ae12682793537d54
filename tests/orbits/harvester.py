"""The measured recording of the harvester in its 120 pieces, where it is at hand."""

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import bayesperiodic as bp

PATH = Path(os.environ.get("BAYESPERIODIC_DATA", "data")) / "harvester" / "harvester_pieces.npz"
needed = pytest.mark.skipif(not PATH.exists(), reason="needs the recording of the harvester")


@cache
def pieces():
    """Return the recordings of velocity [in units of the laser] and voltage [V], in the order of time."""
    with np.load(PATH) as file:
        channels = {"velocity": file["velocity"].astype(float), "voltage": file["voltage_V"].astype(float)}
        count, interval, numbers = file["velocity"].shape[1], float(file["interval_s"][0]), file["number"]
    times = interval * (count * (numbers[:, None] - 1) + np.arange(count))
    return [bp.Recording(time, {n: v[k] for n, v in channels.items()}, {}) for k, time in enumerate(times)]
