"""Unstable periodic orbits in records that have no period: solved from the parts that nearly repeat, and passed by.

A record holds 11 to 50 periods of the source. That is too few to find orbits in the record alone; a part that nearly
repeats is enough to start the solution of the model's orbit, and the record then shows how near it passes to it.
"""

from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.diode import prediction, rig

LONGEST = 4
# Solutions are started from this many of the parts that repeat best.
STARTS = 3
PHASES = prediction.PHASES


def orbits(record: rig.Record, values: prediction.Draw) -> list[dict[str, Any]]:
    """Return unstable orbits of periods 1 to 4 that are found from a record without a period, at most one of each.

    `repeats` is the difference of the two parts of the record from which an orbit was found, `nearest` how near the
    record comes to the orbit over its period, and `median` how near at half the instants, all relative to the variance
    of the voltage. `index` is where the record is nearest, counted in phases from the first maximum of the source.
    """
    measured = by_phase(record)
    rows: list[dict[str, Any]] = []
    for period in range(1, LONGEST + 1):
        for start, repeats in recurrences(measured, period)[:STARTS]:
            found = _solved(_part(record, start, period), values)
            if found is None:
                continue
            orbit, multiplier = found
            far = passages(measured, orbit)
            rows.append({
                "period": period,
                "multiplier": multiplier,
                "repeats": repeats,
                "nearest": float(far.min()),
                "median": float(np.median(far)),
                "index": int(far.argmin()),
                "orbit": orbit,
            })  # fmt: skip
            break
    return rows


def _solved(experiment: bp.Experiment, values: prediction.Draw) -> tuple[np.ndarray, float] | None:
    """Return the orbit's voltage by phase of the source and its largest multiplier, None if it is not unstable."""
    guess = rig.guessed(experiment, values)[0].guess
    solution = rig.solve(experiment, experiment.frequency, values, guess)
    if solution.status != "converged":
        return None
    period, multiplier = experiment.periods, solution.multipliers[np.argmax(np.abs(solution.multipliers))]
    output = rig.moved(solution.outputs["resistor"], -rig.source_phase(experiment) / period)
    output = output.reshape(period * PHASES, -1)[:, 0]
    shorter = any(
        np.var(output - np.roll(output, part * PHASES)) < 1e-6 * np.var(output)
        for part in range(1, period)
        if period % part == 0
    )
    return None if shorter or abs(multiplier) <= 1.0 else (output, float(multiplier.real))


def by_phase(record: rig.Record) -> np.ndarray:
    """Return the resistor's voltage [V] at equal phases of the source, the first at its maximum, in whole periods."""
    time = record.recording.time - record.recording.time[0]
    begin = -rig.phase_of(record) % 1.0
    periods = int(np.floor(time[-1] * record.frequency - begin))
    at = (begin + np.arange(periods * PHASES) / PHASES) / record.frequency
    return np.interp(at, time, record.recording.outputs["resistor"])


def recurrences(values: np.ndarray, period: int) -> list[tuple[int, float]]:
    """Return the parts that nearly repeat after some periods, best first: first index, difference over the variance.

    Of parts that overlap by more than half, the best is kept.
    """
    length = period * PHASES
    count = values.size - 2 * length
    if count <= 0:
        return []
    parts = np.lib.stride_tricks.sliding_window_view(values, length)
    differences = np.var(parts[length : length + count] - parts[:count], axis=1) / (2.0 * np.var(values))
    found: list[tuple[int, float]] = []
    for start in np.argsort(differences):
        if all(abs(start - other) > length // 2 for other, _ in found):
            found.append((int(start), float(differences[start])))
    return found


def passages(values: np.ndarray, orbit: np.ndarray) -> np.ndarray:
    """Return how far values are from an orbit, over its period, from each index on, relative to their variance.

    Both begin at the same phase of the source; the orbit may start in any of its periods.
    """
    parts = np.lib.stride_tricks.sliding_window_view(values, orbit.size)
    return np.array([np.var(part - aligned(orbit, values, at)) for at, part in enumerate(parts)]) / np.var(values)


def aligned(orbit: np.ndarray, values: np.ndarray, index: int) -> np.ndarray:
    """Return an orbit that begins at the phase of an index, with the period first that is nearest to the values.

    Its mean is that of the values there, for the instrument removes the mean.
    """
    part = values[index : index + orbit.size]
    turned = [np.roll(orbit, -(index % PHASES) - turn) for turn in range(0, orbit.size, PHASES)]
    best = min(turned, key=lambda own: float(np.var(part - own)))
    return best + (part.mean() - best.mean())


def _part(record: rig.Record, start: int, period: int) -> bp.Experiment:
    """Return the mean of two successive periods of a response that nearly repeats, from an index on."""
    recording, points = record.recording, rig.SAMPLES * period
    time = recording.time - recording.time[0]
    begin = -rig.phase_of(record) % 1.0 + start / PHASES
    at = (begin + np.arange(2 * points) / rig.SAMPLES) / record.frequency
    resistor = np.interp(at, time, recording.outputs["resistor"]).reshape(2, points).mean(axis=0)
    mean, amplitude = prediction.source_of(record)
    source = mean + amplitude * np.cos(2 * np.pi * (start / PHASES + np.arange(points) / rig.SAMPLES))
    return bp.Experiment(
        name=recording.name, frequency=record.frequency, inputs={"source": source}, outputs={"resistor": resistor},
        samples=rig.SAMPLES, periods=period,
    )  # fmt: skip
