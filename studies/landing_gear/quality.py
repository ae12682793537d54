"""Quality control as the paper proposes it: whether a new gear is like the good ones, or which parameter differs.

SYNTHETIC gears under three experiments each. Good ones, which are equal, are the population; new ones are good too, or
have too little gas, worn friction, or less oil, and each is tested by `Population.test` at a false-alarm rate of 1 %
per gear. The area theta4 is machined and known; the gas's heat capacity theta15 is proportional to its amount,
theta5/theta6. And theta16 as a population over the experiments on one gear: whether it is constant.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest, norm

import bayesperiodic as bp
from studies import common
from studies.landing_gear import identification
from studies.landing_gear.identification import CONDUCTION, DISPLACEMENT, estimate, fold
from studies.landing_gear.rig import GEAR, RUNS, TRUTHS, Changed, Run, measure
from studies.population.account import account as account_of_population

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
# Differences between good gears that are expected, by parameter; of positive ones relative.
SPREADS = {
    "theta3": bp.HalfNormal(0.02), "theta5": bp.HalfNormal(2e-3), "theta6": bp.HalfNormal(0.01),
    "theta8": bp.HalfNormal(0.02), "theta16": bp.HalfNormal(0.2),
}  # fmt: skip
FALSE_ALARM = 0.01
# Chains of a gear pass the stop rule with these.
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 24, "progress": False}
REFERENCE_SEED, FIRST_UNIT = 5000, 10_000
# Spread of theta16 over the experiments, if there is one, and a prior in each that is wider than any data, as it is
# divided out of the draws [W/K].
CONDUCTION_SPREAD, WIDE = bp.HalfNormal(5.0), {**identification.PRIORS, CONDUCTION: bp.Normal(3.0, 100.0)}
# That of the smallest p-value above zero.
LARGEST_DEVIATE = 38.0
# A new gear: its kind and its test.
Tested = tuple[str, bp.MembershipTest]
# A gear or an experiment: its problem, by which it can be sampled again under a population, and its draws.
Drawn = tuple[bp.Problem, bp.Posterior]


def examine(kind: str, seed: int) -> Drawn:
    """Return the draws of one gear of a kind; seeds differ in the noise of the instruments."""
    experiments = [fold(measure(run, (), seed, FAULTS[kind]), DISPLACEMENT) for run in RUNS if run.name in CAMPAIGN]
    found = estimate(experiments, DISPLACEMENT, one_conduction=True, priors=PRIORS, fixed=FIXED, tied=TIED)
    return found.problem, bp.sample(found.problem, found.fit, seed=seed, **SAMPLING)


def examine_all(references: int, each: Mapping[str, int], seed: int) -> tuple[bp.Population, list[Tested]]:
    """Return the population of good gears, and the tests of so many new ones of each kind."""
    kinds = [kind for kind, count in each.items() for _ in range(count)]
    tasks = [(GOOD, REFERENCE_SEED * (seed + 1) + k) for k in range(references)]
    tasks += [(kind, FIRST_UNIT * (seed + 1) + k) for k, kind in enumerate(kinds)]
    gears = list(common.each(examine, tasks))
    units = {f"gear {k + 1}": gear for k, gear in enumerate(gears[:references])}
    population = bp.population(units, list(PRIORS), spread=SPREADS, seed=seed, progress=False)
    tests = [population.test(one, false_alarm=FALSE_ALARM) for one in gears[references:]]
    return population, list(zip(kinds, tests, strict=True))


def account(population: bp.Population, tested: Sequence[Tested]) -> dict[str, Any]:
    """Return the entries of results.json: how often each parameter is called different, by kind of unit."""
    found: dict[str, Any] = {
        "experiments": list(CAMPAIGN), "false_alarm_rate": FALSE_ALARM, "reference": account_of_population(population),
        "limit": float(norm.isf(0.5 * tested[0][1].level)), "kinds": {},
    }  # fmt: skip
    for kind, changes in CHANGES.items():
        every = [test for one, test in tested if one == kind]
        flagged = sum(not test.member for test in every)
        wrong = flagged if kind == GOOD else len(every) - flagged
        found["kinds"][kind] = {
            "changed": {name: value / GEAR[name] - 1.0 for name, value in changes.items()},
            "units": len(every),
            "called_different": {name: sum(name in test.differing for test in every) for name in PRIORS},
            "units_with_any": flagged,
            "units_with_all_verdicts_right": sum({*test.differing} == {*changes} & {*PRIORS} for test in every),
            "error_rate": {
                "wrong": wrong,
                "of": len(every),
                "interval_95": list(binomtest(wrong, len(every)).proportion_ci(0.95)),
            },
            "deviates": {name: [deviate(test, name) for test in every] for name in PRIORS},
            "example": every[0].verdict,
        }
    return found


def deviate(test: bp.MembershipTest, name: str) -> float:
    """Return the normal deviate with the p-value of a parameter, with the sign of its deviation, of limited size."""
    row = test.table.loc[name]
    size = min(float(norm.isf(0.5 * row["p"])), LARGEST_DEVIATE)
    return float(np.copysign(size, row["estimate"] - row["expected"]))


def table(found: Mapping[str, Any]) -> str:
    """Return the counts to print."""
    different = [f"called_different.{name}" for name in PRIORS]
    return common.shown(
        "quality control: gears called different", found["kinds"], ["units", "units_with_any", *different]
    )


def drawn_run(run: Run, truth: str, seed: int) -> Drawn:
    """Return the draws of one experiment with the displacement given."""
    found = estimate([fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT)], DISPLACEMENT, priors=WIDE)
    return found.problem, identification.draw(found, seed, quick=False).posterior


def conductions(runs: Sequence[Run], truth: str, seed: int) -> bp.Population:
    """Return theta16 as a population over the experiments, with the amplitude as covariate [m]."""
    drawn = common.each(drawn_run, [(run, truth, seed) for run in runs])
    units = {run.name: one for run, one in zip(runs, drawn, strict=True)}
    amplitude = {run.name: run.stroke for run in runs}
    return bp.population(
        units, [CONDUCTION], spread={CONDUCTION: CONDUCTION_SPREAD}, covariates={"amplitude": amplitude}, seed=seed,
        progress=False,
    )  # fmt: skip
