"""The records of the flutter rig, or a rig generated in their image; folded without an input."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.flutter.rig import RIG, SAMPLES, TRUE, cycles

FILE = "flutter/flutter_cbc_500hz.npz"
ADDRESS = "github.com/Kyounghyunlee/ML_Hopf.jl (commit b8ce1fd5), src/measured_data, gathered in one NPZ"
SHA256 = "0046876cdab6f92c483fa53dd6fea37883397b136bdc1bbeb8dd302e31e03726"
PREFIX, META = "CBC_", "_meta"
STEP, ROWS = 0.002, 10_000
HARMONICS = 5
LARGEST_DRIFT = 0.1
RULE = (
    f"a record counts if it has three cycles, is periodic, and its fundamental grows or shrinks by at most "
    f"{LARGEST_DRIFT:.0%} over the record; the wind speed is the one written in the record"
)
# Speeds written in the records [m/s], and one cycle's scatter of heave and pitch as folded from them.
KINDS = {
    "stable_v14_9": (14.9, 7.3e-4, 4.3e-4),
    "stable_v15_6": (15.6, 8.2e-4, 4.0e-4),
    "stable_v16_5": (16.5, 2.9e-3, 1.1e-3),
    "stable_v17_3": (17.3, 1.5e-3, 4.9e-4),
    "unstable_v14_9": (14.9, 1.4e-3, 5.3e-4),
    "unstable_v15_6_2": (16.4, 1.1e-3, 4.7e-4),
    "unstable_v16_5": (16.5, 1.4e-3, 5.3e-4),
    "unstable_v17_3": (17.2, 6.9e-4, 2.1e-4),
}


class Record(NamedTuple):
    """One record: what was recorded, at which wind speed [m/s], and how its cycle was held."""

    recording: bp.Recording
    speed: float
    control: dict[str, float]

    @property
    def stable(self) -> bool:
        """Whether the cycle is one that the rig stays on by itself, as the record's name tells."""
        return not self.recording.name.startswith("unstable")


def read_records(given: Path | None, seed: int) -> tuple[list[Record], dict[str, Any]]:
    """Return the measured records, or generated ones of the same kind, and what to report about them."""
    found = common.find_data(given, FILE)
    if found is None:
        return generate(seed), {"path": "generated", "sha256": None, "synthetic": True}
    path, name = found
    with np.load(path, allow_pickle=False) as file:
        names = [key.removesuffix(META) for key in file.files if key.endswith(META)]
        records = [_record(key, file[key].astype(float), file[key + META]) for key in names]
    return records, {"path": name, "sha256": common.sha256(path), "synthetic": False}


def _record(key: str, rows: np.ndarray, meta: np.ndarray) -> Record:
    """Return a record: rows heave, heave target, control, pitch, mean heave; in `meta` the speed comes first."""
    heave, target, control, pitch = rows[:4]
    recording = bp.Recording.from_arrays(
        STEP * np.arange(heave.size), {"heave": heave, "pitch": pitch}, name=key.removeprefix(PREFIX)
    )
    missed = {
        "rms_of_control": float(control.std()),
        "rms_of_heave_less_target": float((heave - target - np.mean(heave - target)).std()),
        "rms_of_heave": float(heave.std()),
    }
    return Record(recording, float(meta[0]), missed)


def generate(seed: int) -> list[Record]:
    """Return synthetic records: the cycles of the true model, stable and unstable, with white noise on the sensors.

    The noise gives one cycle, within the harmonics kept, the scatter of the measured records.
    """
    generator = np.random.default_rng(seed)
    along = cycles(RIG | TRUE)
    time, records = STEP * np.arange(ROWS), []
    for name, (speed, *scatter) in KINDS.items():
        orbit = along.at(name, speed)
        phase = orbit.frequency * time + generator.uniform()
        spread = np.sqrt(1.0 / (STEP * orbit.frequency) / (2 * HARMONICS + 1))
        outputs = {
            channel: _at(orbit.outputs[channel], phase) + sd * spread * generator.standard_normal(ROWS)
            for channel, sd in zip(("heave", "pitch"), scatter, strict=True)
        }
        records.append(Record(bp.Recording(time, outputs, {}, name=name, synthetic=True), speed, {}))
    return records


def _at(values: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return a periodic signal at phases in periods, by its Fourier series."""
    amplitudes = np.fft.rfft(values)[: (values.size + 1) // 2] / values.size
    amplitudes[1:] *= 2.0
    waves = np.exp(2j * np.pi * phase[:, None] * np.arange(amplitudes.size))
    return np.real(waves @ amplitudes)


def fold(record: Record) -> bp.Experiment:
    """Return the mean cycle, τ = 0 where the fundamental of heave crosses its mean upwards."""
    return record.recording.fold(SAMPLES, harmonics=HARMONICS, origin="crossing", largest_drift=LARGEST_DRIFT)


def usable(records: list[Record]) -> tuple[dict[str, bp.Experiment], dict[str, str]]:
    """Return the mean cycles of the records that the rule admits, and why the others are left out, both by name."""
    admitted, refused = {}, {}
    for record in records:
        try:
            admitted[record.recording.name] = fold(record)
        except ValueError as error:
            refused[record.recording.name] = str(error)
    return admitted, refused


def spectral_frequency(record: Record, experiment: bp.Experiment) -> float:
    """Return the frequency [Hz] of the highest peak of heave's spectrum over the cycles used: another estimate.

    Hann window, padded to sixteen times the length, and a parabola through the logarithms at the peak.
    """
    end = float(record.recording.time[-1])
    used = record.recording.between(end - experiment.cycles / experiment.frequency, end)
    heave = used.outputs["heave"]
    power = np.log(np.abs(np.fft.rfft((heave - heave.mean()) * np.hanning(heave.size), 16 * heave.size)) + 1e-300)
    top = int(np.argmax(power))
    left, middle, right = power[top - 1 : top + 2]
    shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
    return float((top + shift) * record.recording.sampling_rate / (16 * heave.size))
