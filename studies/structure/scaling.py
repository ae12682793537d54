"""Cost of chains of masses with a friction joint and a stop, by degrees of freedom."""

import time
from typing import Any

import numpy as np

import bayesperiodic as bp

COUNTS, SAMPLES, VECTORS, NOISE = (10, 30, 100, 300), 64, 32, 0.01
VALUES = {
    "alpha": 0.02,
    "beta": 0.01,
    "joint_stiffness": 1.0,
    "joint_limit": 0.1,
    "stop_k": 1.0,
    "stop_clearance": 0.15,
}
FREQUENCIES = (0.045, 0.06)


def chain(count: int) -> bp.Model:
    """Return a chain of masses and springs that is held at one end, with a joint at the other and a stop beside it."""
    springs = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    springs[-1, -1] = 1.0
    return bp.Model.from_matrices(
        "chain", mass=np.eye(count), stiffness=springs, damping={"alpha": np.eye(count), "beta": springs},
        forces={"force": count - 1},
        outputs={"end": (count - 1, "displacement"), "other": (count // 2, "acceleration")},
        elements=[
            bp.elements.Element("joint", bp.elements.jenkins, count - 1, {"width": 0.1}),
            bp.elements.Element("stop", bp.elements.gap, count - 2, {"width": 0.01}),
        ],
        condensed=True,
    )  # fmt: skip


def scaling(*, quick: bool = False) -> dict[str, dict[str, float]]:
    """Return by degrees of freedom the processor seconds of each stage."""
    costs = {}
    for count in COUNTS[:2] if quick else COUNTS:
        model, result = chain(count), {}
        wave = 0.2 * np.cos(2.0 * np.pi * np.arange(SAMPLES) / SAMPLES)
        random, experiments = np.random.default_rng(1), []
        start = time.process_time()
        for frequency in FREQUENCIES:
            solved = bp.solve_periodic(model, VALUES, {"force": wave}, frequency=frequency, samples=SAMPLES)
            outputs = {n: y + NOISE * np.ptp(y) * random.standard_normal(SAMPLES) for n, y in solved.outputs.items()}
            name = f"{frequency} Hz"
            experiments.append(bp.Experiment(name, frequency, outputs, {"force": wave}, samples=SAMPLES))
        result["two first solves, with multipliers [s]"] = time.process_time() - start
        priors = {n: bp.LogNormal(1.1 * v, 0.3) for n, v in VALUES.items() if n != "beta"}
        problem = bp.Problem(model, experiments, priors=priors, fixed={"beta": VALUES["beta"]})
        start = time.process_time()
        fit = bp.map_estimate(problem, progress=False)
        result["estimate [s]"] = time.process_time() - start
        result["a log-likelihood [ms]"] = 1e3 * density(problem, fit)
        costs[str(count)] = result
    return costs


def density(problem: bp.Problem, fit: bp.MapEstimate) -> float:
    """Return the processor seconds of one log-likelihood of draws of the Laplace approximation."""
    theta, noise = np.array([fit.theta[n] for n in problem.names]), dict(fit.noise)
    here = problem.anchored(theta)
    draws = np.random.default_rng(0).multivariate_normal(theta, fit.covariance, VECTORS)
    here.log_likelihood(draws[:1], noise)
    start = time.process_time()
    here.log_likelihood(draws, noise)
    return (time.process_time() - start) / VECTORS


def table(costs: dict[str, dict[str, Any]]) -> str:
    """Return the costs as text."""
    names = list(next(iter(costs.values())))
    lines = [f"{'degrees of freedom':40s}" + "".join(f"{count:>10s}" for count in costs)]
    return "\n".join([*lines, *(f"{n:40s}" + "".join(f"{row[n]:10.3g}" for row in costs.values()) for n in names)])
