"""What the Silverbox study fits: mean period, model, priors and grid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bayesperiodic as bp
from studies.silverbox.data import FREQUENCY, W0

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
        bp.models.silverbox,
        {"w0": W0, **theta},
        experiment.inputs,
        frequency=experiment.frequency,
        samples=experiment.samples,
        scheme=SCHEME,
    )


def spread(experiment: bp.Experiment) -> float:
    """Return the standard deviation of the measured mean response along the period [V]."""
    return float(experiment.outputs["response"].std())
