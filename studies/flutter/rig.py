"""Flutter rig: records or synthetic ones, known parameters, cycles by continuation from the Hopf point, problem.

Records are folded without an input.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.flutter import reference
from studies.flutter.reference import SENSORS

MODEL = bp.models.flutter
SAMPLES, SCHEME = 12, "fourier"
# The published values of the parameters that are estimated, and of the others.
AUTHORS = {name: reference.RIG[name] for name in ("c_h", "c_alpha", "k_alpha", "k_alpha2", "k_alpha3")}
RIG = {name: value for name, value in reference.RIG.items() if name not in AUTHORS}
# Near the estimate from the measured cycles; all eight kinds of cycles exist there.
TRUE = {
    "c_h": 6.8, "c_alpha": 0.254, "k_alpha": 56.5, "k_alpha2": 684.0, "k_alpha3": 4577.0, "gain_heave": 7.16,
    "gain_pitch": 0.752, "offset_heave": 3.357, "offset_pitch": 0.7213,
}  # fmt: skip
# With a larger k_alpha2 than the authors' the fold lies below all measured speeds, so that every cycle exists.
START = AUTHORS | SENSORS | {"k_alpha2": 900.0}
SPREADS = {
    "c_h": 0.3, "c_alpha": 0.3, "k_alpha": 0.1, "k_alpha2": 0.5, "k_alpha3": 0.5, "gain_heave": 0.3, "gain_pitch": 0.3,
}  # fmt: skip
PRIORS: dict[str, Any] = {n: bp.LogNormal(START[n], s) for n, s in SPREADS.items()} | {
    "offset_heave": bp.Normal(SENSORS["offset_heave"], 0.1),
    "offset_pitch": bp.Normal(SENSORS["offset_pitch"], 0.1),
}
SPRINGS = {"k_alpha2 at gain 1": "k_alpha2/gain_pitch", "k_alpha3 at gain 1": "k_alpha3/gain_pitch**2"}
FIRST_AMPLITUDE, LONGEST_STEP = 5e-3, 1.0
LOWEST_SPEED, HIGHEST_SPEED, SEARCHED = 8.0, 19.5, (5.0, 25.0)
FIRST_SHARE, ROUNDS = 0.01, 2


Experiments = Mapping[str, bp.Experiment]
Speeds = Mapping[str, float]  # By record [m/s]


class Fitted(NamedTuple):
    """A problem, its MAP point, and the error [Hz] that was allowed the model's frequencies."""

    problem: bp.Problem
    fit: bp.MapEstimate
    frequency_error: float


class Cycles(NamedTuple):
    """The Hopf point of a set of values, and the cycles that start there, unstable or stable, along the wind speed."""

    hopf: bp.HopfPoint
    branches: tuple[bp.Branch, ...]

    def at(self, name: str, speed: float) -> bp.PeriodicSolution:
        """Return the cycle at a speed [m/s] of the kind in a record's name, unstable or stable.

        Raises ValueError: If there is none; the message names the nearest fold or endpoint, and the Hopf point.
        """
        orbits, missing = list[bp.PeriodicSolution](), ""
        for branch in self.branches:
            try:
                orbits += bp.solutions_at(MODEL, branch, speed)
            except ValueError as error:
                missing = missing or str(error)
        kind = not name.startswith("unstable")
        fitting = [orbit for orbit in orbits if orbit.converged and orbit.stable == kind]
        if not fitting:
            missing = missing or f"no orbit there is {'stable' if kind else 'unstable'}."
            raise ValueError(
                f"speed: must have a cycle for {name!r}, got {speed:g} m/s; {missing} The Hopf point is at "
                f"{self.hopf.value:.6g} m/s."
            )
        return fitting[-1] if kind else fitting[0]


def cycles(values: Mapping[str, float], samples: int = SAMPLES) -> Cycles:
    """Return the cycles of a set of values, followed from its Hopf point through all folds up to the highest speed.

    Raises ValueError: Without a Hopf point.
    """
    points = bp.hopf_points(MODEL, values, "U", between=SEARCHED)
    if not points:
        raise ValueError(f"values: must have a Hopf point within {SEARCHED} m/s, got {dict(values)}.")
    point = points[0]
    first = bp.emerging_cycle(MODEL, point, amplitude={"alpha": FIRST_AMPLITUDE}, samples=samples, scheme=SCHEME)
    if not first.converged:
        raise ValueError(
            f"values: must have a cycle near the Hopf point, got {dict(values)}; the first cycle is {first.status}."
        )
    if first.parameters["U"] > point.value:
        return Cycles(point, (_along(first, HIGHEST_SPEED),))
    down = _along(first, LOWEST_SPEED)
    again = down[-1].parameters["U"] == first.parameters["U"] and len(down) > 1
    return Cycles(point, (down, _along(down[-1], HIGHEST_SPEED)) if again else (down,))


def _along(first: bp.PeriodicSolution, until: float) -> bp.Branch:
    return bp.continue_periodic(MODEL, first, "U", until=until, step=LONGEST_STEP, progress=False)


def problem(
    experiments: Sequence[bp.Experiment], speeds: Speeds, *, frequency_error: float,
    known: Mapping[str, float] | None = None, noise: Any = "circulant",
) -> bp.Problem:  # fmt: skip
    """Return the problem of some cycles, the model's frequency allowed an error [Hz] beside the measured one's.

    The delay of the outputs is fixed: cycles are compared at the phase at which the fundamentals of both sensors agree
    best.
    """
    known = known or {}
    allowed = [replace(e, frequency_se=math.hypot(e.frequency_se, frequency_error)) for e in experiments]
    fixed: dict[str, Any] = {**RIG, **known, "U": {e.name: speeds[e.name] for e in experiments}, "shift": 0.0}
    priors = {name: prior for name, prior in PRIORS.items() if name not in known}
    return bp.Problem(MODEL, allowed, priors=priors, fixed=fixed, noise=noise, scheme=SCHEME)


def estimate(
    experiments: Experiments, speeds: Speeds, start: Mapping[str, float] = START,
    known: Mapping[str, float] | None = None, noise: Any = "circulant",
) -> Fitted:  # fmt: skip
    """Return the MAP point; the frequency error allowed is the root mean square error of the last fit but one.

    A model whose frequency errors exceed the standard errors must not be weighted by these. Continuation starts at the
    medians of the priors, on orbits of the correct branch, and ends at `start`.
    """
    known = known or {}
    along = cycles({**RIG, **START, **known})
    guessed = [replace(e, guess=along.at(name, speeds[name]).states) for name, e in experiments.items()]
    error = FIRST_SHARE * float(np.mean([e.frequency for e in guessed]))
    point = {name: value for name, value in start.items() if name in PRIORS and name not in known}
    measured = float(np.sqrt(np.mean([e.frequency_se**2 for e in guessed])))
    for number in range(ROUNDS + 1):
        stated = problem(guessed, speeds, frequency_error=error, known=known, noise=noise)
        fit = bp.map_estimate(stated, start=point, checks=number == ROUNDS, progress=False)
        found = Fitted(stated, fit, error)
        if number < ROUNDS:
            missed = [found.fit.solutions[e.name].frequency - e.frequency for e in guessed]
            error = math.sqrt(max(float(np.mean(np.square(missed))) - measured**2, 0.0))
            point = dict(found.fit.theta)
    return found


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
    """One record: recording, wind speed [m/s] and control of the cycle."""

    recording: bp.Recording
    speed: float
    control: dict[str, float]


def read_records(given: Path | None, seed: int) -> tuple[list[Record], dict[str, Any]]:
    """Return the measured records, or generated ones of the same kind, and their description."""
    found = common.find_data(given, FILE)
    if found is None:
        return generate(seed), common.described(found)
    with np.load(found[0], allow_pickle=False) as file:
        names = [key.removesuffix(META) for key in file.files if key.endswith(META)]
        records = [_record(key, file[key].astype(float), file[key + META]) for key in names]
    return records, common.described(found)


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


def usable(records: list[Record]) -> tuple[dict[str, bp.Experiment], dict[str, str]]:
    """Return the mean cycles of the records that the rule admits, and why the others are left out, both by name.

    τ = 0 where the fundamental of heave crosses its mean upwards.
    """
    admitted, refused = {}, {}
    settings: dict[str, Any] = {"harmonics": HARMONICS, "origin": "crossing", "largest_drift": LARGEST_DRIFT}
    for recording in (record.recording for record in records):
        try:
            with warnings.catch_warnings():
                # The number of cycles used is in the study's results.
                warnings.filterwarnings("ignore", r".*: only (the last )?\d+ of \d+ cycles are used")
                warnings.filterwarnings("default", r".*: the phase wanders irregularly")
                admitted[recording.name] = recording.fold(SAMPLES, **settings)
        except ValueError as error:
            refused[recording.name] = str(error)
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
