"""Silverbox multisine: steady parts of the record or synthetic ones, mean period, model, priors and grid."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common

FILE = "silverbox/Schroeder80mV.csv"
ADDRESS = "nonlinearbenchmark.org (Silverbox), copy in github.com/biaslab/nsi-silverbox (commit 728f07e4)"
SHA256 = "b22cbcba9c59d9b4b1b379967b669dc32959e515b24784da3254505f8563e36c"
SAMPLING_RATE = 1e7 / 2**14
PERIOD, PERIODS = 1024, 9
FREQUENCY = SAMPLING_RATE / PERIOD
# The second one is steady from row 119,548 on; this row has the phase of the first one's beginning.
FIRST_ROWS = (10_824, 119_608)
W0 = 2 * np.pi * 65.0
TRUE = {"c": 0.104, "k1": 1.105, "k2": -0.037, "k3": 4.37, "g": 1.115, "u0": -0.006}
SYNTHETIC_LINES, SYNTHETIC_AMPLITUDE, SYNTHETIC_OFFSET = range(1, 336, 2), 3e-3, 6.1e-3
SYNTHETIC_NOISE = {"drive": 3e-5, "response": 3e-4}


def read_steady_parts(given: Path | None, seed: int) -> tuple[tuple[bp.Recording, bp.Recording], dict[str, Any]]:
    """Return both measured steady parts, or generated ones of the same kind, and their description."""
    found = common.find_data(given, FILE)
    if found is None:
        return generate(seed), common.described(found)
    whole = bp.Recording.from_csv(
        found[0],
        sampling_rate=SAMPLING_RATE,
        inputs={"drive": "V1"},
        outputs={"response": "V2"},
        name="Silverbox, Schroeder multisine",
    )
    first, second = (
        whole.between((row - 0.5) / SAMPLING_RATE, (row + PERIODS * PERIOD - 0.5) / SAMPLING_RATE) for row in FIRST_ROWS
    )
    rows = {"first_rows": FIRST_ROWS, "rows_each": PERIODS * PERIOD}
    return (first, second), common.described(found) | rows


def generate(seed: int) -> tuple[bp.Recording, bp.Recording]:
    """Return synthetic steady parts of the same kind: one period, integrated in time, repeated, with noise."""
    period = dict(zip(("drive", "response"), steady_period(), strict=True))
    generator = np.random.default_rng(seed)

    def part() -> bp.Recording:
        noisy = {
            name: np.tile(values, PERIODS) + SYNTHETIC_NOISE[name] * generator.standard_normal(PERIODS * PERIOD)
            for name, values in period.items()
        }
        time, drive = np.arange(PERIODS * PERIOD) / SAMPLING_RATE, {"drive": noisy.pop("drive")}
        return bp.Recording(time, noisy, drive, name="synthetic Silverbox, Schroeder multisine", synthetic=True)

    return part(), part()


def steady_period() -> tuple[np.ndarray, np.ndarray]:
    """Return a period of the drive and of the response; after one period the transient is below 1e-14.

    Schroeder's phases with this sign let the frequency fall with time, as in the measured drive.
    """
    lines = np.array(SYNTHETIC_LINES)
    phase = np.pi * np.arange(lines.size) * (np.arange(lines.size) + 1) / lines.size
    tau = np.arange(PERIOD)[:, None] / PERIOD
    drive = SYNTHETIC_OFFSET + SYNTHETIC_AMPLITUDE * np.cos(2 * np.pi * tau * lines + phase).sum(axis=1)
    run = bp.simulate(
        bp.models.silverbox, {"w0": W0, **TRUE}, {"drive": drive}, frequency=FREQUENCY, duration=2.0 / FREQUENCY,
        sampling_rate=SAMPLING_RATE,
    )  # fmt: skip
    return drive, run.outputs["response"][PERIOD : 2 * PERIOD]


DRIVE_LINES = 335
SCHEME = "central4"
PRIORS: dict[str, Any] = {
    "c": bp.LogNormal(0.05, 1.0),
    "k1": bp.LogNormal(0.8, 0.7),
    "k2": bp.Normal(0.0, 5.0),
    "k3": bp.LogNormal(1.0, 1.5),
    "g": bp.LogNormal(0.8, 0.7),
    "u0": bp.Normal(0.0, 0.05),
}


def fold(recording: bp.Recording, samples: int, response: int | None = None) -> bp.Experiment:
    """Return the mean period from the recording's first sample on.

    Generator and converter share a clock, so that the frequency is known exactly.
    """
    harmonics = {"drive": DRIVE_LINES} | ({} if response is None else {"response": response})
    return recording.fold(samples, frequency=FREQUENCY, harmonics=harmonics, origin=float(recording.time[0]))


def problem(experiment: bp.Experiment, noise: str = "independent") -> bp.Problem:
    """Return the problem with a noise model."""
    return bp.Problem(bp.models.silverbox, [experiment], priors=PRIORS, fixed={"w0": W0}, scheme=SCHEME, noise=noise)


def medians() -> dict[str, float]:
    """Return the medians of the priors."""
    return {name: float(prior.quantile(0.5)) for name, prior in PRIORS.items()}


def solve(theta: Mapping[str, float], experiment: bp.Experiment) -> bp.PeriodicSolution:
    """Return the periodic response, found from rest at full amplitude."""
    return bp.solve_periodic(
        bp.models.silverbox, {"w0": W0, **theta}, experiment.inputs, frequency=experiment.frequency,
        samples=experiment.samples, scheme=SCHEME,
    )  # fmt: skip


def spread(experiment: bp.Experiment) -> float:
    """Return the standard deviation of the measured mean response along the period [V]."""
    return float(experiment.outputs["response"].std())
