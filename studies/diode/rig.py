"""The records of the circuit, their folds, the model's problem, and guesses of its orbits from the measured current."""

import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

import bayesperiodic as bp
from studies import common

FILE = "rl_diode/rl_diode_run_1.npz"
ADDRESS = "github.com/saul-diaz-mansilla/coupled-rlc-circuits (commit bfba72b4), RL_diode_run_1"
# Of the arrays frequency_Hz, interval_s, source_V and resistor_V made of the CSV files there.
SHA256 = "912e35104651f59265267e1bf345152f5e5c7878e1a72972a37ff802d430fa6e"
MODEL = bp.models.rl_diode
# The file does not state the resistor; L, R_L, 1/C_L, 1/C_j, 1/Q_0 and drift are proportional to it.
RESISTOR = 1000.0
START = {
    "L": 4.5e-3, "R_L": 80.0, "C_L": 6e-12, "V_f": 0.5, "C_j": 3e-12, "Q_0": 2e-11, "transit": 8e-7, "lifetime": 3e-6,
}  # fmt: skip
# Terms that the first model lacks, and where their estimation starts.
STARTS = {"drift": 3e8, "C_s": 0.0, "bypass": 0.0, "R_L": 60.0, "C_j": 4e-12, "Q_0": 1.6e-11, "transit": 6e-7}
TERMS = ("drift", "C_s", "bypass")
STEPS_OF_MODEL = {
    "two charges": (),
    "with drift of the stored charge": TERMS[:1],
    "with drift and a stray capacitance": TERMS[:2],
    "with drift, capacitance and bypass": TERMS,
}
PRIORS: dict[str, Any] = {name: bp.LogNormal(value, 0.7) for name, value in START.items()} | {
    # The instrument removes the mean of the current.
    "offset": bp.Normal(0.0, 1.0),
    "drift": bp.LogNormal(2e8, 1.0),
    "C_s": bp.Normal(0.0, 1e-11),
    "bypass": bp.Normal(0.0, 0.3),
}
# Frequencies [kHz] near which periodic records are fitted; the others are predicted.
FITTED = (110.0, 140.0, 170.0, 210.0, 230.0, 350.0)
RULE_OF_CHOICE = "fitted are the periodic records nearest to 110, 140, 170, 210, 230 and 350 kHz"
SAMPLES = 256
# Of the generated records: values, frequencies [kHz], samples, and the step of the 8-bit instruments [V].
TRUE = START | {
    "R_s": 0.26 * RESISTOR,
    "drift": 3.4e8,
    "R": RESISTOR,
    "C_s": 0.0,
    "bypass": 0.0,
    "offset": 0.0,
    "transit": 5.7e-7,
    "C_j": 4.3e-12,
}
SYNTHETIC = (110, 120, 140, 150, 170, 185, 190, 210, 220, 230, 250, 260, 285, 300, 320, 345, 350, 370, 400, 450, 500)
LENGTH, STEPS, AMPLITUDE, MEAN = 2500, {"source": 0.4, "resistor": 0.08}, 10.6, 0.12
SETTLED = 150
# Largest step [Hz] in which an orbit is followed to another record.
FOLLOWED = 1000.0
# Periods of the integration, steps between points, and halvings of the direct current in a guess.
REPEATED, INSIDE, HALVINGS = 14, 4, 30


class Fitted(NamedTuple):
    """A problem, its MAP point, and the internal resistance of the source over the resistor."""

    problem: bp.Problem
    fit: bp.MapEstimate
    share: float


class Record(NamedTuple):
    """One record: frequency [Hz], recording, fold (None if not periodic), what the test of the period said."""

    frequency: float
    recording: bp.Recording
    experiment: bp.Experiment | None
    evidence: str

    @property
    def period(self) -> int | None:
        """Response period in drive periods, None if there is none."""
        return self.experiment.periods if self.experiment else None


def read(given: Path | None, seed: int, pool: Executor) -> tuple[list[Record], dict[str, Any], float]:
    """Return all records by frequency, folded where periodic, the file's description, and the source's resistance.

    The latter is relative to the resistor; the source is its voltage without load. The pool folds the records.
    """
    found = common.find_data(given, FILE)
    if found is None:
        recordings = [(1e3 * f, generate(1e3 * f, seed)) for f in SYNTHETIC]
    else:
        with np.load(found[0]) as data:
            recordings = [
                (
                    float(frequency),
                    bp.Recording.from_arrays(
                        interval * np.arange(source.size), {"resistor": resistor}, {"source": source},
                        name=f"{frequency / 1e3:g} kHz",
                    ),
                )
                for frequency, interval, source, resistor in zip(
                    data["frequency_Hz"], data["interval_s"], data["source_V"], data["resistor_V"], strict=True
                )
            ]  # fmt: skip
    frequencies, loaded = zip(*sorted(recordings, key=lambda one: one[0]), strict=True)
    under_load = pool.map(folded, frequencies, loaded)
    share = internal_share([record.experiment for record in under_load if record.experiment])
    records = pool.map(folded, frequencies, [unloaded(own, share) for own in loaded])
    return list(records), common.described(found), share


def internal_share(experiments: Sequence[bp.Experiment]) -> float:
    """Return the internal resistance of the source over the resistor, from the lines between the drive's harmonics.

    The source contains none of these; its voltage under load has them, times minus the ratio of the resistances. The
    ratio is the one of least squares over all records of more than one period.
    """
    common_part, power = 0.0, 0.0
    for experiment in experiments:
        source, resistor = (np.fft.rfft(own) for own in (experiment.inputs["source"], experiment.outputs["resistor"]))
        between = np.arange(source.size) % experiment.periods != 0
        weight = experiment.periods / experiment.inputs["source"].size
        common_part -= weight * float(np.sum((source * np.conj(resistor))[between].real))
        power += weight * float(np.sum(np.abs(resistor[between]) ** 2))
    if not power > 0.0:
        raise ValueError(
            "--data: must have records of more than one period, got none; they show the source's resistance."
        )
    return common_part / power


def unloaded(recording: bp.Recording, share: float) -> bp.Recording:
    """Return the recording with the voltage that the source has without load, less the mean, which is not measured."""
    source = recording.inputs["source"] + share * recording.outputs["resistor"]
    return replace(recording, inputs={"source": source - source.mean()})


def folded(frequency: float, recording: bp.Recording) -> Record:
    """Return a record with its fold over the response period that the test finds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            experiment = recording.fold(SAMPLES, frequency=frequency, periods="auto")
        except ValueError as error:
            return Record(frequency, recording, None, str(error))
    return Record(frequency, recording, experiment, "")


def generate(frequency: float, seed: int) -> bp.Recording:
    """Return a synthetic record: the model integrated in time, with the steps of 8-bit instruments."""
    wave = MEAN + AMPLITUDE * np.cos(2 * np.pi * np.arange(16) / 16)
    rate = 40.0 * frequency
    generator = np.random.default_rng([seed, int(frequency)])
    settled = SETTLED / frequency
    run = bp.simulate(
        MODEL, TRUE, {"source": wave}, frequency=frequency, duration=settled + (LENGTH - 1) / rate, sampling_rate=rate
    )
    run.inputs["source"] -= TRUE["R_s"] / RESISTOR * run.outputs["resistor"]  # under load
    values = {
        name: step * np.round((own[-LENGTH:] + 0.3 * step * generator.standard_normal(LENGTH)) / step)
        for (name, own), step in zip((run.inputs | run.outputs).items(), STEPS.values(), strict=True)
    }
    values["resistor"] = values["resistor"] - values["resistor"].mean()
    return replace(
        run, time=np.arange(LENGTH) / rate, outputs={"resistor": values["resistor"]},
        inputs={"source": values["source"]}, name=f"synthetic {frequency / 1e3:g} kHz",
    )  # fmt: skip


def fitted_records(records: Sequence[Record]) -> list[Record]:
    """Return the periodic records nearest to the frequencies that are fitted."""
    periodic = [record for record in records if record.experiment]
    chosen = {min(periodic, key=lambda own: abs(own.frequency - 1e3 * f)).frequency for f in FITTED}
    return [record for record in periodic if record.frequency in chosen]


def estimate(records: Sequence[Record], free: Sequence[str], share: float) -> Fitted:
    """Return the MAP point of some records with some of the model's three further terms."""
    values = START | dict.fromkeys(TERMS, 0.0) | {"R_s": share * RESISTOR}
    if free:
        values |= {name: value for name, value in STARTS.items() if name in START or name in free}
    start = {name: value for name, value in values.items() if name in START or name in free}
    experiments = []
    for record in records:
        assert record.experiment
        experiment, mean = guessed(record.experiment, values)
        experiments.append(experiment)
        start[f"offset[{experiment.name}]"] = -RESISTOR * mean
    priors = {name: prior for name, prior in PRIORS.items() if name not in TERMS or name in free}
    fixed = {"R": RESISTOR, "R_s": share * RESISTOR} | {name: 0.0 for name in TERMS if name not in free}
    problem = bp.Problem(MODEL, experiments, priors=priors, fixed=fixed, local=["offset"])
    return Fitted(problem, bp.map_estimate(problem, start=start, progress=False), share)


def values_of(final: Fitted) -> dict[str, float]:
    """Return all parameters at the MAP point, without the offset."""
    known = {"R": RESISTOR, "R_s": final.share * RESISTOR, "offset": 0.0}
    return {name: final.fit.theta.get(name, 0.0) for name in MODEL.parameters} | known


def orbit(record: Record, values: Mapping[str, float]) -> bp.Experiment:
    """Return the experiment of a record with an orbit from its measured current."""
    assert record.experiment
    return guessed(record.experiment, values)[0]


def solved(record: Record, final: Fitted) -> tuple[bp.PeriodicSolution | None, float | None]:
    """Return the periodic solution of a record at the MAP point, and the variance that it does not explain.

    Of a record that was not fitted it is the best of two: from the measured current, and from the fitted record of the
    nearest frequency whose period divides this one, followed in frequency.
    """
    experiment = record.experiment
    assert experiment
    if experiment.name in final.fit.solutions:
        solution = final.fit.solutions[experiment.name]
        return solution, unexplained(experiment, solution)
    values = values_of(final)
    found = [solve(experiment, experiment.frequency, values, orbit(record, values).guess)]
    near = [e for e in final.problem.experiments if experiment.periods % e.periods == 0]
    if near:
        nearest = min(near, key=lambda own: abs(own.frequency - experiment.frequency))
        ahead = (source_phase(experiment) - source_phase(nearest)) / nearest.periods
        guess: Any = {
            name: np.tile(moved(own, ahead), experiment.periods // nearest.periods)
            for name, own in final.fit.solutions[nearest.name].states.items()
        }
        steps = int(np.ceil(abs(nearest.frequency - experiment.frequency) / FOLLOWED)) + 1
        for frequency in np.linspace(nearest.frequency, experiment.frequency, steps):
            followed = solve(experiment, float(frequency), values, guess)
            guess = followed.states if followed.status == "converged" else guess
        found.append(followed)
    right = [(own, unexplained(experiment, own)) for own in found if own.status == "converged"]
    return min(right, key=lambda own: own[1], default=(None, None))


def source_phase(experiment: bp.Experiment) -> float:
    """Return the phase of the source [periods of the source]."""
    return float(np.angle(np.fft.rfft(experiment.inputs["source"])[experiment.periods]) / (2 * np.pi))


def moved(values: np.ndarray, ahead: float) -> np.ndarray:
    """Return values over a period as they are `ahead` periods later."""
    amplitudes = np.fft.rfft(values)
    return np.fft.irfft(amplitudes * np.exp(2j * np.pi * ahead * np.arange(amplitudes.size)), values.size)


def solve(experiment: bp.Experiment, frequency: float, values: Mapping[str, float], guess: Any) -> bp.PeriodicSolution:
    """Return the periodic solution under the source of an experiment, at a frequency."""
    return bp.solve_periodic(
        MODEL, values, experiment.inputs, frequency=frequency, periods=experiment.periods,
        samples=experiment.samples, guess=guess,
    )  # fmt: skip


def unexplained(experiment: bp.Experiment, solution: bp.PeriodicSolution) -> float:
    """Return the fraction of the resistor's variance that a solution does not explain.

    A solution is as good as the same some periods of the source later; the best is taken.
    """
    measured = experiment.outputs["resistor"]
    turned = [np.roll(solution.outputs["resistor"], n * experiment.samples) for n in range(experiment.periods)]
    return float(min(np.var(own - measured) for own in turned) / np.var(measured))


def phase_of(record: Record) -> float:
    """Return the phase of the source at the begin of a record [periods of the source]."""
    time = record.recording.time - record.recording.time[0]
    turn = np.exp(-2j * np.pi * record.frequency * time)
    return float(np.angle(np.sum(record.recording.inputs["source"] * turn)) / (2 * np.pi))


def stroboscopic(record: Record) -> np.ndarray:
    """Return the measured voltages of the resistor at the maxima of the source."""
    time = record.recording.time - record.recording.time[0]
    resistor = record.recording.outputs["resistor"]
    at = (np.arange(int(time[-1] * record.frequency) + 2) - phase_of(record)) / record.frequency
    at = at[(at >= time[1]) & (at <= time[-2])]
    smooth = np.convolve(resistor, np.ones(3) / 3.0, "same")
    return np.interp(at, time, smooth)


def guessed(experiment: bp.Experiment, values: Mapping[str, float]) -> tuple[bp.Experiment, float]:
    """Return the experiment with an orbit from its measured current, and the current's mean [A] that was removed.

    The charges are integrated along the current, whose mean is such that the voltages of all parts sum to the
    source's mean.
    """
    points = experiment.samples * experiment.periods
    rate = experiment.frequency / experiment.periods
    current = experiment.outputs["resistor"] / RESISTOR
    current = current - current.mean()
    constants = tuple(values[name] for name in ("Q_0", "transit", "lifetime", "drift"))
    source = float(np.mean(experiment.inputs["source"]))
    low, high = 0.0, float(np.ptp(current))
    for _ in range(HALVINGS):
        mean = 0.5 * (low + high)
        q, m = _charges(current + mean, 1.0 / (rate * points), *constants)
        depleted = 0.5 * (np.sqrt(q**2 + values["Q_0"] ** 2) - q)
        total = (
            (RESISTOR + values["R_s"] + values["R_L"]) * mean + values["V_f"] - float(depleted.mean()) / values["C_j"]
        )
        low, high = (low, mean) if total > source else (mean, high)
    amplitudes = np.fft.rfft(current + mean)
    turn = 2j * np.pi * rate * np.arange(amplitudes.size)
    coil = turn * values["L"] + values["R_L"]
    through = amplitudes / (1.0 + turn * values["C_L"] * coil)
    i, v = (np.fft.irfft(own, points) for own in (through, coil * through))
    return replace(experiment, guess={"i": i, "v": v, "q": q, "m": m}), mean


@njit(cache=True, nogil=True)
def _charges(current, step, corner, transit, lifetime, drift):
    """Return the charges (2, points) that follow a periodic current [A], by Heun's method."""
    points, h = current.size, step / INSIDE
    q = m = lifetime * np.abs(current).mean()
    found = np.empty((2, points))
    for _ in range(REPEATED):
        for j in range(points):
            after = current[(j + 1) % points]
            for part in range(INSIDE):
                now = current[j] + (after - current[j]) * (part + 0.5) / INSIDE
                flow = (0.5 * (q + np.sqrt(q * q + corner * corner)) - m) / transit
                dq, dm = now - flow, flow - m / lifetime - drift * now * m
                q1, m1 = q + h * dq, m + h * dm
                flow = (0.5 * (q1 + np.sqrt(q1 * q1 + corner * corner)) - m1) / transit
                q += 0.5 * h * (dq + now - flow)
                m += 0.5 * h * (dm + flow - m1 / lifetime - drift * now * m1)
            found[0, (j + 1) % points], found[1, (j + 1) % points] = q, m
    return found
