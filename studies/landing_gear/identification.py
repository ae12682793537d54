"""Identification of theta4, theta6 and theta16 of the landing gear, per experiment as in the paper, and jointly.

The other parameters are fixed at their true values, and theta11 is tied to theta4 (it represents the ambient pressure).
The harmonics kept are fixed, so that the number of independent values does not depend on the noise.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import bayesperiodic as bp
from studies.landing_gear.rig import GEAR

DISPLACEMENT, FORCE = "displacement", "force"
DRIVES = (DISPLACEMENT, FORCE)
SAMPLES = 800
KEPT = {
    DISPLACEMENT: {"displacement": 3, "force": 60, "pressure": 20},
    FORCE: {"displacement": 40, "force": 60, "pressure": 40},
}
# Area and volume as known from drawings and a data sheet; of the conduction only the order of magnitude.
# Its median is off zero, where the mean temperature is undetermined and solves are at their worst.
PRIORS = {"theta4": bp.LogNormal(5.2e-3, 0.1), "theta6": bp.Normal(-2.3, 0.3), "theta16": bp.Normal(3.0, 20.0)}
FIXED = {name: value for name, value in GEAR.items() if name not in (*PRIORS, "theta11")}
TIED = {"theta11": "-1e5*theta4"}
ENSEMBLES = 2
WALKERS, QUICK_WALKERS = 16, 8
MAX_STEPS, QUICK_STEPS = 20_000, 250


@dataclass(frozen=True)
class Identified:
    """Estimate and draws of one problem."""

    problem: bp.Problem
    fit: bp.MapEstimate
    posterior: bp.Posterior | None  # None without draws
    seconds: float  # Time of sampling


def fold(recording: bp.Recording, drive: str) -> bp.Experiment:
    """Return the mean period with the input that belongs to a direction."""
    signals = {**recording.inputs, **recording.outputs}
    outputs = {name: values for name, values in signals.items() if name != drive}
    turned = bp.Recording(
        recording.time, outputs, {drive: signals[drive]}, name=recording.name, synthetic=recording.synthetic
    )
    return turned.fold(SAMPLES, harmonics=KEPT[drive])


def problem(
    experiments: Sequence[bp.Experiment], drive: str, *, one_conduction: bool = False, scheme: str = "central2"
) -> bp.Problem:
    """Return the problem of one experiment, or of several that share theta4 and theta6, and theta16 if it is one."""
    return bp.Problem(
        bp.models.landing_gear(drive),
        experiments,
        priors=PRIORS,
        fixed=FIXED,
        tied=TIED,
        local=[] if one_conduction or len(experiments) == 1 else ["theta16"],
        noise=bp.noise.Independent(per="experiment"),
        scheme=scheme,
    )


def estimate(experiments: Sequence[bp.Experiment], drive: str, *, one_conduction: bool = False) -> Identified:
    """Return MAP and Laplace approximation."""
    stated = problem(experiments, drive, one_conduction=one_conduction)
    return Identified(stated, bp.map_estimate(stated, progress=False), None, 0.0)


def draw(
    estimated: Identified, seed: int, *, quick: bool, max_steps: int = MAX_STEPS, executor: int | None = None
) -> Identified:
    """Return the same with draws of the posterior, the variances integrated out."""
    stated, fit = estimated.problem, estimated.fit
    before = time.perf_counter()
    posterior = bp.sample(
        stated,
        fit,
        seed=seed,
        ensembles=ENSEMBLES,
        walkers=max(QUICK_WALKERS if quick else WALKERS, 2 * len(stated.names)),
        max_steps=QUICK_STEPS if quick else max_steps,
        variances="collapsed",
        executor=None if quick else executor,
        progress=False,
    )
    return Identified(stated, fit, posterior, time.perf_counter() - before)
