"""Evaluations of the density that units cost one by one, against one joint problem with local parameters.

SYNTHETIC Duffing springs with three parameters each, the noise known. Counted are evaluations of a single unit's
density, each a periodic solve: a joint log-posterior of N units has N. Measured for a few numbers of units and
extrapolated to 200.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.population.springs import DAMPING_SPREAD, NOISE, SPRING_PRIORS, SPRING_TRUTH, spring

COUNTS, QUICK_COUNTS, EXTRAPOLATED = (10, 20, 40), (3, 5), 200
PRIORS: dict[str, Any] = SPRING_PRIORS | {"k3": bp.LogNormal(0.5, 0.5)}
FIXED = {"m": SPRING_TRUTH["m"], "variance[displacement]": NOISE**2}
# The burn-in takes at most 1000 steps; joint chains that have not passed the stop rule by then end here.
ENSEMBLES, JOINT_STEPS, QUICK_STEPS = 2, 2000, 400
# Units that are sampled one by one; the others cost the same.
ALONE = 10


def scaling(seed: int, *, quick: bool = False) -> dict[str, Any]:
    """Return evaluations and processor seconds of both ways, by the number of units, and the extrapolation."""
    counts = QUICK_COUNTS if quick else COUNTS
    generator = np.random.default_rng(seed)
    damping = SPRING_TRUTH["c"] * np.exp(DAMPING_SPREAD * generator.standard_normal(max(counts)))
    runs = [
        replace(spring(c, 1.0, generator).experiments[0], name=f"spring {k + 1}") for k, c in enumerate(damping)
    ]  # fmt: skip
    alone = [_measured([run], seed, JOINT_STEPS) for run in runs[:ALONE]]
    unit = {key: float(np.mean([one[key] for one in alone])) for key in ("evaluations", "effective", "seconds")}
    rows = {}
    for count in counts:
        joint = _measured(runs[:count], seed, QUICK_STEPS if quick else JOINT_STEPS)
        # What the joint chains need for as many effective draws as a unit's have.
        share = unit["effective"] / joint["effective"]
        needed = joint["burn_in"] + share * joint["after_burn_in"]
        seconds = joint["seconds"] * needed / joint["evaluations"]
        rows[count] = joint | {
            "evaluations_for_equal_effective": needed,
            "seconds_for_equal_effective": seconds,
            "evaluations_one_by_one": count * unit["evaluations"],
            "times_fewer_evaluations": needed / (count * unit["evaluations"]),
            "times_fewer_seconds": seconds / (count * unit["seconds"]),
        }
    return {
        "synthetic": True, "seed": seed, "unit": unit | {"sampled": len(alone)},
        "joint": {str(count): one for count, one in rows.items()}, "extrapolated": _extrapolated(rows),
    }  # fmt: skip


def _measured(runs: Sequence[bp.Experiment], seed: int, steps: int) -> dict[str, Any]:
    """Return evaluations of single units, effective draws of the worst parameter, and processor seconds of sampling."""
    problem = bp.Problem(
        bp.models.duffing, runs, priors=PRIORS, fixed=FIXED, local=list(PRIORS) if len(runs) > 1 else [],
        scheme="fourier",
    )  # fmt: skip
    fit = bp.map_estimate(problem, progress=False)
    start = time.process_time()
    posterior = bp.sample(problem, fit, seed=seed, ensembles=ENSEMBLES, max_steps=steps, progress=False)
    seconds = time.process_time() - start
    kept = posterior.draws(problem.names[0]).size
    return {
        "coordinates": len(problem.names),
        "evaluations": len(runs) * posterior.log_posterior_calls,
        "burn_in": len(runs) * (posterior.log_posterior_calls - kept),
        "after_burn_in": len(runs) * kept,
        "effective": float(min(posterior.ess[name] for name in problem.names)),
        "tau": float(max(posterior.tau[name] for name in problem.names)),
        "converged": posterior.converged,
        "seconds": seconds,
    }


def _extrapolated(rows: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Return the ratio at 200 units by a power law through all counts, and as it is at the largest count."""
    counts, ratios = np.array(list(rows)), np.array([one["times_fewer_evaluations"] for one in rows.values()])
    slope, level = np.polyfit(np.log(counts), np.log(ratios), 1)
    return {
        "units": EXTRAPOLATED,
        "exponent": float(slope),
        "times_fewer_evaluations": float(np.exp(level + slope * np.log(EXTRAPOLATED))),
        "measured_at_the_largest": float(ratios[-1]),
    }


def table(found: dict[str, Any]) -> str:
    """Return the measurements as text."""
    columns = ["coordinates", "evaluations", "effective", "tau", "converged", "times_fewer_evaluations"]
    columns += ["times_fewer_seconds"]
    end = found["extrapolated"]
    return (
        f"{common.shown('joint problems, by units (SYNTHETIC data)', found['joint'], columns)}\n"
        f"one unit alone: {found['unit']['evaluations']:.0f} evaluations, {found['unit']['effective']:.0f} effective "
        f"draws; extrapolated to {end['units']} units: {end['times_fewer_evaluations']:.0f} times fewer evaluations"
    )
