"""Probabilities of the motion at a record that was not fitted, for a model that is slightly wrong, and their log score.

Each fitted record is left out once. The model of the others explains its waveform best at an effective drive: the
source with another amplitude and frequency. How far these are from the measured drive, over the fitted records, is the
model's error at the next record; it includes what the estimate from few records errs by.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from studies.diode import prediction, rig

# The motions that are predicted: periods, and none of these.
CLASSES = (*map(str, range(1, prediction.LONGEST + 1)), "chaos")
# Added to the count of each motion (Jeffreys' prior of multinomial probabilities): none has the probability zero.
ADDED = 0.5
# Records on each side that the neighbours' forecast counts, and how many records the frequencies of all others weigh.
NEIGHBOURS, WEIGHT = 2, 1.0
# Records before one at which a sweep to it begins.
RUN_UP = 2
# Powers of frequency and of amplitude with which an effective drive scales parameters; the others do not change.
POWERS = dict.fromkeys(("L", "C_L", "C_j", "C_s", "transit", "lifetime"), (1, 0)) | {
    "V_f": (0, -1), "Q_0": (1, -1), "drift": (-1, 1),
}  # fmt: skip


class Drive(NamedTuple):
    """An effective drive: logarithms of its frequency and its amplitude over the measured ones."""

    frequency: float
    amplitude: float


def driven(draw: prediction.Draw, drive: Drive) -> dict[str, float]:
    """Return the parameters of the circuit that moves under the measured drive as this one under an effective drive.

    Its time is that of the effective drive's periods, and its voltages and currents are divided by the amplitude.
    """
    return {
        name: value * np.exp(np.dot(POWERS[name], drive)) if name in POWERS else value for name, value in draw.items()
    }


def effective_drive(record: rig.Record, final: rig.Fitted) -> Drive | None:
    """Return the drive at which the model explains a periodic record best, None if it cannot be solved."""
    start = rig.solved(record, final)[0]
    if start is None:
        return None
    experiment = record.experiment
    assert experiment
    values, measured = rig.values_of(final), experiment.outputs["resistor"]
    measured = measured - measured.mean()
    turned = [np.roll(start.outputs["resistor"], n * experiment.samples) for n in range(experiment.periods)]
    turn = experiment.samples * int(np.argmin([np.var(own - measured) for own in turned]))
    guess: Any = {name: np.roll(own, turn) for name, own in start.states.items()}

    def residuals(drive: np.ndarray) -> np.ndarray:
        solution = rig.solve(experiment, experiment.frequency, driven(values, Drive(*drive)), guess)
        if solution.status != "converged":
            return np.full(measured.size, np.nan)
        output = np.exp(drive[1]) * solution.outputs["resistor"]
        return output - output.mean() - measured

    try:
        best = least_squares(residuals, np.zeros(2), x_scale=0.01, diff_step=[1e-4, 1e-4])
    except ValueError:  # a residual that is not finite
        return None
    return Drive(*best.x.tolist()) if best.success else None


class LeftOut(NamedTuple):
    """What the fit of the other records says on a fitted one: that fit, and the effective drive of this record."""

    fit: rig.Fitted
    drive: Drive | None


def left_out(record: rig.Record, used: Sequence[rig.Record], free: Sequence[str], share: float) -> LeftOut:
    """Return the fit of all fitted records but one, and the effective drive of this one."""
    fit = rig.estimate([other for other in used if other.frequency != record.frequency], free, share)
    return LeftOut(fit, effective_drive(record, fit))


def drive_draws(errors: Sequence[Drive], count: int, seed: int) -> list[Drive]:
    """Return draws of the effective drive of a further record, of which those of some records are known.

    These are normal with zero mean and unknown covariance. With Jeffreys' prior of the covariance, the next one has a
    t-distribution, whose regions contain it with the stated probability whatever the covariance is.
    """
    known = np.array(errors, float).reshape(len(errors), len(Drive._fields))
    freedom = len(known) - known.shape[1] + 1
    if freedom < 2:
        raise ValueError(
            f"errors: must be the effective drives of at least three records, got {len(known)}; fit more records."
        )
    generator = np.random.default_rng(seed)
    root = np.linalg.cholesky(known.T @ known / freedom)
    normal = generator.standard_normal((count, known.shape[1])) @ root.T
    drawn = normal / np.sqrt(generator.chisquare(freedom, (count, 1)) / freedom)
    return [Drive(*row) for row in drawn.tolist()]


def draws_by_forecast(
    final: rig.Fitted, errors: Sequence[Drive], count: int, seed: int
) -> dict[str, list[dict[str, float]]]:
    """Return draws as if the model were true, with the robust covariance, and with effective drives of a new record."""
    robust = prediction.draws_of(final, count, seed)
    drives = drive_draws(errors, count, seed + 1)
    return {
        "posterior": prediction.draws_of(final, count, seed, robust=False),
        "robust": robust,
        "next record": [driven(draw, drive) for draw, drive in zip(robust, drives, strict=True)],
    }


def motions_at(
    records: Sequence[rig.Record], draws: Mapping[str, Sequence[prediction.Draw]]
) -> list[dict[str, list[str]]]:
    """Return the motions of the draws of each forecast at all records, in a sweep of their frequencies."""
    sources = [prediction.source_of(record) for record in records]
    together = [draw for some in draws.values() for draw in some]
    swept = prediction.sweep(together, [record.frequency for record in records], sources)
    of_draws = [[label(prediction.period_of(values)) for values in own] for own in swept]
    ends = np.cumsum([0, *(len(some) for some in draws.values())])
    return [
        {
            name: [own[number] for own in of_draws[first:last]]
            for name, first, last in zip(draws, ends[:-1], ends[1:], strict=True)
        }
        for number in range(len(records))
    ]


def label(period: int | None) -> str:
    """Return the name of a motion: its period, or "chaos"."""
    return "chaos" if period is None else str(period)


def smoothed(motions: Sequence[str]) -> dict[str, float]:
    """Return the probabilities of all motions from counts, each with `ADDED` added, so that none is zero."""
    counts = Counter(motions)
    return {kind: (counts[kind] + ADDED) / (len(motions) + ADDED * len(CLASSES)) for kind in CLASSES}


def neighbours(measured: Sequence[str], number: int) -> dict[str, float]:
    """Return probabilities from the motions of the nearest records, without a model.

    The frequencies of the motions in all other records count as `WEIGHT` further neighbours.
    """
    others = smoothed([*measured[:number], *measured[number + 1 :]])
    near = [*measured[max(number - NEIGHBOURS, 0) : number], *measured[number + 1 : number + 1 + NEIGHBOURS]]
    return {kind: (near.count(kind) + WEIGHT * others[kind]) / (len(near) + WEIGHT) for kind in CLASSES}


def forecasts(
    records: Sequence[rig.Record], final: rig.Fitted, others: Mapping[float, LeftOut], count: int, seed: int
) -> tuple[list[dict[str, dict[str, float]]], list[dict[str, list[str]]]]:
    """Return the probabilities of each forecast at each record, and the motions of the draws of the final fit.

    `others` is, by the frequency of each fitted record, what the fit of the other ones says. A fitted record is
    predicted by that fit, and by the effective drives of the other fitted records.
    """
    errors = {frequency: own.drive for frequency, own in others.items() if own.drive}
    motions = motions_at(records, draws_by_forecast(final, list(errors.values()), count, seed))
    measured = [label(prediction.measured_period(record)) for record in records]
    rows = []
    for number, record in enumerate(records):
        at = motions[number]
        if record.frequency in others:
            known = [drive for frequency, drive in errors.items() if frequency != record.frequency]
            draws = draws_by_forecast(others[record.frequency].fit, known, count, seed)
            at = motions_at(records[max(number - RUN_UP, 0) : number + 1], draws)[-1]
        row = {name: smoothed(own) for name, own in at.items()}
        row["neighbours"] = neighbours(measured, number)
        row["all others"] = smoothed([*measured[:number], *measured[number + 1 :]])
        rows.append(row)
    return rows, motions


def log_scores(
    rows: Sequence[Mapping[str, Mapping[str, float]]], measured: Sequence[str], reference: str = "posterior"
) -> dict[str, dict[str, float]]:
    """Return the sum of ln p of the measured motions of each forecast, and what a calibrated one expects.

    `right` is at how many records the measured motion is the most probable one.
    `expected` and `expected_sd` are the mean and the standard deviation of the sum if the motions had the stated
    probabilities independently; `difference` is the sum less that of a reference, and `difference_sd` its standard
    error from the differences of the records.
    """
    scores = {name: np.array([np.log(row[name][kind]) for row, kind in zip(rows, measured, strict=True)])
              for name in rows[0]}  # fmt: skip
    table = {}
    for name, own in scores.items():
        p = np.array([[*row[name].values()] for row in rows])
        means = np.sum(p * np.log(p), axis=1, keepdims=True)
        difference = own - scores[reference]
        table[name] = {
            "right": sum(max(row[name].values()) == row[name][kind] for row, kind in zip(rows, measured, strict=True)),
            "sum": float(own.sum()),
            "mean": float(own.mean()),
            "expected": float(means.sum()),
            "expected_sd": float(np.sqrt(np.sum(p * (np.log(p) - means) ** 2))),
            "difference": float(difference.sum()),
            "difference_sd": float(np.sqrt(difference.size) * np.std(difference, ddof=1)),
        }
    return table
