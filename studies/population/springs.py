"""Simulated springs: Duffing oscillators with a known spread of the damping and none of the stiffness."""

from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.population.account import account

SPRINGS, QUICK_SPRINGS, NOISE, POINTS = 8, 4, 0.02, 64
DAMPING_SPREAD, SPRING_TRUTH = 0.3, {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
SPRING_PRIORS = {"c": bp.LogNormal(0.2, 1.0), "k": bp.LogNormal(1.0, 0.5)}
STIFFER = 1.3


def spring(damping: float, stiffness: float, generator: np.random.Generator) -> bp.Problem:
    """Return the problem of one simulated spring, a Duffing oscillator."""
    force = np.cos(2.0 * np.pi * np.arange(POINTS) / POINTS)
    truth = bp.solve_periodic(
        bp.models.duffing, SPRING_TRUTH | {"c": damping, "k": stiffness}, {"force": force}, frequency=0.1,
        samples=POINTS, scheme="fourier",
    )  # fmt: skip
    measured = truth.outputs["displacement"] + NOISE * generator.standard_normal(POINTS)
    run = bp.Experiment("run", 0.1, {"displacement": measured}, {"force": force}, samples=POINTS, synthetic=True)
    return bp.Problem(
        bp.models.duffing,
        [run],
        priors=SPRING_PRIORS,
        fixed={n: SPRING_TRUTH[n] for n in ("m", "k3")},
        scheme="fourier",
    )


def spring_population(count: int, seed: int) -> tuple[bp.Population, dict[str, Any]]:
    """Return the population of springs with equal stiffness, and the tests of a member and of a stiffer one."""
    generator = np.random.default_rng(seed)
    damping = SPRING_TRUTH["c"] * np.exp(DAMPING_SPREAD * generator.standard_normal(count + 2))
    problems = {f"spring {k + 1}": spring(c, 1.0, generator) for k, c in enumerate(damping[:count])}
    result = bp.population(problems, ["c", "k"], seed=seed, progress=False)
    tests = {
        "member": result.test(spring(damping[-2], 1.0, generator)),
        "stiffer": result.test(spring(damping[-1], STIFFER, generator)),
    }
    entries = account(result) | {
        "truth": {"spread[c]": DAMPING_SPREAD, "spread[k]": 0.0},
        "tests": {
            name: {"member": t.member, "p": t.table["p"].to_dict(), "verdict": t.verdict} for name, t in tests.items()
        },
        "joint_dimension": 3 * count + len(result.labels),
    }
    return result, entries
