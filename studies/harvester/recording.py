"""The measured recording of a bistable beam with a piezo element, and a simulated one in its place."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

import bayesperiodic as bp
from studies import common
from studies.harvester.beam import SYNTHETIC, model, parameters

RELATIVE = "harvester/harvester_pieces.npz"
ADDRESS = "github.com/americocunhajr/BistableX, DataExperimental/poincare_analysis/chaos_symmetric, files 1 to 120"
GRAVITY = 9.80665  # m/s²
DIGITS = 5  # of the frequency in Hz: in 480 s the phase is right within 0.003 periods
FREQUENCY = 6.5  # of simulated recordings [Hz]
# Corner of the filter without which the integral of the acceleration drifts [Hz], and its order.
CORNER, ORDER = 2.0, 4
# Of the simulated recording: drive periods, samples a period, amplitude of the base [m/s²], noise by channel.
PERIODS, SAMPLES, AMPLITUDE = 3000, 320, 4.6
NOISE = {"velocity": 0.02, "voltage": 2e-6, "drive": 0.01}


class Delays(NamedTuple):
    """Times by which velocity and voltage are later than the drive [s]."""

    velocity: float
    voltage: float


def read(path: Path) -> tuple[list[bp.Recording], dict[str, Any]]:
    """Return one recording for each run of consecutive pieces, and what is said about them."""
    with np.load(path) as file:
        order = np.argsort(file["number"])
        numbers, interval = file["number"][order], float(file["interval_s"][0])
        channels = {
            "velocity": file["velocity"][order].astype(float),
            "voltage": file["voltage_V"][order].astype(float),
            "drive": GRAVITY * file["acceleration_g"][order].astype(float),
        }
    length, recordings = channels["drive"].shape[1], []
    for pieces in np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers) != 1) + 1):
        time = interval * (length * (numbers[pieces[0]] - 1) + np.arange(length * pieces.size))
        recordings.append(_recording(time, {name: values[pieces].ravel() for name, values in channels.items()}))
    about = {"synthetic": False, "file": path.name, "sha256": common.sha256(path), "pieces": int(numbers.size)}
    return recordings, about


def frequency_of(recordings: list[bp.Recording]) -> float:
    """Return the frequency of the drive [Hz], by its periods in the longest recording."""
    longest = max(recordings, key=lambda one: one.time.size)
    return round(bp.Recording(longest.time, {"drive": longest.inputs["drive"]}, {}).fold().frequency, DIGITS)


def simulated(seed: int) -> tuple[list[bp.Recording], dict[str, Any]]:
    """Return a simulated recording of the beam with a restoring force of degree seven."""
    values = SYNTHETIC
    omega, angle = 2.0 * np.pi * FREQUENCY, 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES
    beam = model(7, 4)
    run = bp.simulate(
        beam, {name: values[name] for name in parameters(7, 4)},
        {"drive": AMPLITUDE * np.cos(angle), "base": AMPLITUDE / omega * np.sin(angle)},
        frequency=FREQUENCY, duration=PERIODS / FREQUENCY,
        sampling_rate=SAMPLES * FREQUENCY, start={"x": 0.1},
        noise=NOISE, seed=seed,
    )  # fmt: skip
    channels = {"velocity": run.outputs["velocity"], "voltage": run.outputs["voltage"], "drive": run.inputs["drive"]}
    settled = 20 * SAMPLES
    kept = {name: channel[settled:] for name, channel in channels.items()}
    return [_recording(run.time[settled:], kept, synthetic=True)], {"synthetic": True, "missing": ADDRESS}


def _recording(time: np.ndarray, channels: dict[str, np.ndarray], synthetic: bool = False) -> bp.Recording:
    """Return a recording with the velocity of the base, integrated from its acceleration, as a second input."""
    rate = (time.size - 1) / (time[-1] - time[0])
    drive = channels["drive"] - channels["drive"].mean()
    integral = np.cumsum(0.5 * (drive[1:] + drive[:-1])) / rate
    filtered = sosfiltfilt(butter(ORDER, CORNER, "highpass", fs=rate, output="sos"), np.append(0.0, integral))
    outputs = {name: channels[name] for name in ("velocity", "voltage")}
    return bp.Recording(time, outputs, {"drive": channels["drive"], "base": filtered}, synthetic=synthetic)


def aligned(recording: bp.Recording, delays: Delays) -> bp.Recording:
    """Return the recording with the times of its channels shifted to that of the voltage."""
    time = recording.time
    late = {"velocity": delays.velocity - delays.voltage, "voltage": 0.0}
    margin = abs(late["velocity"]) + abs(delays.voltage)
    inside = (time >= time[0] + margin) & (time <= time[-1] - margin)
    outputs = {n: CubicSpline(time, v)(time[inside] + late[n]) for n, v in recording.outputs.items()}
    inputs = {n: CubicSpline(time, v)(time[inside] - delays.voltage) for n, v in recording.inputs.items()}
    return bp.Recording(time[inside], outputs, inputs, synthetic=recording.synthetic)


def divided(recordings: list[bp.Recording], share: float) -> tuple[list[bp.Recording], list[bp.Recording]]:
    """Return the recordings up to a share of the time, and those after it."""
    total = sum(one.time.size for one in recordings)
    before: list[bp.Recording] = []
    after: list[bp.Recording] = []
    count = 0
    for one in recordings:
        kept = int(np.clip(share * total - count, 0, one.time.size))
        count += one.time.size
        if kept > 1:
            before.append(one.between(one.time[0], one.time[kept - 1]))
        if one.time.size - kept > 1:
            after.append(one.between(one.time[kept], one.time[-1]))
    return before, after
