"""Quality control as the paper proposes it: whether a new gear equals the reference, and which parameter differs.

SYNTHETIC units under three experiments each, good or with too little gas, worn friction, or less oil. A parameter is
called "different" if it deviates from the reference, which is measured several times, by more than their combined
standard deviations allow, at a false-alarm rate of 1 % per unit over all parameters. The area theta4 is machined and
known; the gas's heat capacity theta15 is proportional to its amount, theta5/theta6.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, norm

import bayesperiodic as bp
from studies import common
from studies.landing_gear.identification import DISPLACEMENT, estimate, fold
from studies.landing_gear.rig import GEAR, RUNS, Changed, measure

CAMPAIGN = ("0.2 Hz 80 mm", "1 Hz 36 mm", "4 Hz 8 mm")
PRIORS = {
    "theta3": bp.LogNormal(8e3, 0.3),
    "theta5": bp.LogNormal(GEAR["theta5"], 0.1),
    "theta6": bp.Normal(-2.5, 0.3),
    "theta8": bp.LogNormal(150.0, 0.5),
    "theta16": bp.Normal(3.0, 20.0),
}
TIED = {"theta15": f"{GEAR['theta15'] * GEAR['theta6'] / GEAR['theta5']!r}*theta5/theta6"}
FIXED = {name: value for name, value in GEAR.items() if name not in (*PRIORS, *TIED)}
MEANINGS = {
    "theta3": "oil damping", "theta5": "gas charge", "theta6": "gas volume", "theta8": "friction",
    "theta16": "heat conduction",
}  # fmt: skip
GOOD = "good"
LOST_GAS, WORN, LOST_OIL = 0.02, 0.2, 0.01
CHANGES: dict[str, dict[str, float]] = {
    GOOD: {},
    "low gas charge": {name: (1 - LOST_GAS) * GEAR[name] for name in ("theta5", "theta15")},
    "worn friction": {"theta8": (1 - WORN) * GEAR["theta8"]},
    # The same gas in a volume larger by the oil that left.
    "leaking oil": {name: GEAR[name] / (1 + LOST_OIL) for name in ("theta5", "theta6")},
}
FAULTS: dict[str, Changed] = {kind: frozenset(changes.items()) for kind, changes in CHANGES.items()}
FALSE_ALARM = 0.01
LIMIT = float(norm.isf(0.5 * FALSE_ALARM / len(PRIORS)))
POWER = 0.9
# More tasks than that are shared among processes.
SERIALLY = 10
REFERENCE_SEED, FIRST_UNIT = 5000, 10_000


@dataclass(frozen=True)
class Unit:
    """Estimate of one gear."""

    kind: str
    theta: dict[str, float]
    sd: dict[str, float]
    converged: bool


def examine(kind: str, seed: int) -> Unit:
    """Return the estimate of one unit of a kind; seeds differ in the noise of the instruments."""
    experiments = [fold(measure(run, (), seed, FAULTS[kind]), DISPLACEMENT) for run in RUNS if run.name in CAMPAIGN]
    fit = estimate(experiments, DISPLACEMENT, one_conduction=True, priors=PRIORS, fixed=FIXED, tied=TIED).fit
    return Unit(kind, dict(fit.theta), dict(fit.sd), fit.converged)


def examine_all(references: int, each: int, seed: int) -> tuple[Unit, list[Unit]]:
    """Return the reference, the mean of its measurements, and `each` units of each kind."""
    tasks = [(GOOD, REFERENCE_SEED * (seed + 1) + k) for k in range(references)]
    tasks += [(kind, FIRST_UNIT * (seed + 1) + k) for k, kind in enumerate(np.repeat(list(FAULTS), each).tolist())]
    found = list(common.each(examine, tasks, here=len(tasks) <= SERIALLY))
    units = found[:references]
    theta = {name: float(np.mean([unit.theta[name] for unit in units])) for name in PRIORS}
    sd = {name: float(np.sqrt(np.mean([unit.sd[name] ** 2 for unit in units]) / references)) for name in PRIORS}
    return Unit(GOOD, theta, sd, all(unit.converged for unit in units)), found[references:]


def deviations(reference: Unit, unit: Unit) -> dict[str, float]:
    """Return the deviation of a unit from the reference in combined standard deviations, by parameter."""
    return {n: (unit.theta[n] - reference.theta[n]) / float(np.hypot(unit.sd[n], reference.sd[n])) for n in PRIORS}


def account(reference: Unit, units: Sequence[Unit]) -> dict[str, Any]:
    """Return the entries of results.json: how often each parameter is called different, by kind of unit."""
    typical = {name: np.sqrt(np.mean([unit.sd[name] ** 2 for unit in units])) for name in PRIORS}
    found: dict[str, Any] = {
        "experiments": list(CAMPAIGN),
        "limit": LIMIT,
        "false_alarm_rate": FALSE_ALARM,
        "reference": {"theta": reference.theta, "sd": reference.sd},
        "relative_change_found_in_90_percent": {
            name: float((LIMIT + norm.ppf(POWER)) * np.hypot(typical[name], reference.sd[name]) / abs(GEAR[name]))
            for name in PRIORS
        },
        "kinds": {},
    }
    for kind in CHANGES:
        every = [deviations(reference, unit) for unit in units if unit.kind == kind]
        different = {name: sum(abs(z[name]) > LIMIT for z in every) for name in PRIORS}
        flagged = sum(any(abs(v) > LIMIT for v in z.values()) for z in every)
        right = sum(all((abs(z[n]) > LIMIT) == (n in CHANGES[kind]) for n in PRIORS) for z in every)
        found["kinds"][kind] = {
            "changed": {name: value / GEAR[name] - 1.0 for name, value in CHANGES[kind].items()},
            "units": len(every),
            "not_converged": sum(not unit.converged for unit in units if unit.kind == kind),
            "called_different": different,
            "units_with_any": flagged,
            "units_with_all_verdicts_right": right,
            "error_rate": _rate(flagged if kind == GOOD else len(every) - flagged, len(every)),
        }
    return found


def _rate(wrong: int, count: int) -> dict[str, Any]:
    """Return a rate with the exact 95 % interval of a binomial share."""
    chances = np.linspace(0.0, 1.0, 2001)
    inside = chances[(binom.cdf(wrong, count, chances) >= 0.025) & (binom.sf(wrong - 1, count, chances) >= 0.025)]
    return {"wrong": wrong, "of": count, "rate": wrong / count, "interval_95": [float(inside[0]), float(inside[-1])]}


def table(found: Mapping[str, Any]) -> str:
    """Return the counts to print."""
    title = f"quality control: units that differ by more than {found['limit']:.2f} standard deviations, by kind of unit"
    different = [f"called_different.{name}" for name in PRIORS]
    return common.shown(title, found["kinds"], ["units", "units_with_any", *different])
