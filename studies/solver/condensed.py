"""Cost of a finite-element beam with a cubic spring, condensed against symbolic: log-likelihood and response curve.

Run ``python -m studies.solver.condensed``; processor time, of a response curve the least of three. The symbolic model
of 32 degrees of freedom compiles for about a minute; ``python -m studies.solver.condensed 8 100 300`` leaves it out.
"""

import sys
import time
from typing import Any

import numpy as np

import bayesperiodic as bp

VALUES = {"alpha": 0.05, "beta": 0.005, "spring_k3": 1.0}
SAMPLES, FREQUENCY, POINTS, MOST_SYMBOLIC, BRANCHES = 128, 0.5, 64, 32, 3


def matrices(degrees: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mass and stiffness matrix of a cantilever of unit length, mass and lowest frequency of about 0.56 Hz."""
    count = degrees // 2
    h = 1.0 / count
    mass, stiffness = np.zeros((2, degrees + 2, degrees + 2))
    for i in range(count):
        at = slice(2 * i, 2 * i + 4)
        mass[at, at] += h / 420 * np.array([
            [156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
            [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
        ])  # fmt: skip
        stiffness[at, at] += 1.0 / h**3 * np.array([
            [12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
            [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2],
        ])  # fmt: skip
    return mass[2:, 2:], stiffness[2:, 2:]


def beam(degrees: int, condensed: bool) -> bp.Model:
    """Return the beam, with a force, a cubic spring and two sensors."""
    mass, stiffness = matrices(degrees)
    tip = degrees - 2
    return bp.Model.from_matrices(
        "beam", mass=mass, stiffness=stiffness, damping={"alpha": mass, "beta": stiffness}, forces={"force": tip},
        outputs={"x": (tip, "displacement"), "a": (2 * (degrees // 4), "acceleration")}, condensed=condensed,
        elements=[bp.elements.Element("spring", bp.elements.cubic, tip)],
    )  # fmt: skip


def problem(model: bp.Model, experiment: bp.Experiment) -> bp.Problem:
    """Return the problem of the beam's damping and spring."""
    return bp.Problem(model, [experiment], priors={n: bp.LogNormal(v, 0.3) for n, v in VALUES.items()})


def cost(given: bp.Problem, count: int, repeats: int) -> tuple[float, float, float]:
    """Return seconds to the first value, milliseconds a further one, and the share of values that are finite."""
    theta = np.array([VALUES[n] for n in given.names]) * np.exp(
        0.01 * np.random.default_rng(0).standard_normal((count, len(VALUES)))
    )
    noise = dict.fromkeys(given.noise_names, 1e-4)
    start = time.process_time()
    given.log_likelihood(theta[:1], noise, threads=1)
    first = time.process_time() - start
    given.log_likelihood(theta, noise, threads=1)
    start, values = time.process_time(), np.empty(0)
    for _ in range(repeats):
        values = given.log_likelihood(theta, noise, threads=1)
    return first, 1e3 * (time.process_time() - start) / repeats / count, float(np.isfinite(values).mean())


def branch_cost(model: bp.Model) -> tuple[float, int]:
    """Return milliseconds a point of the response curve over the bent first resonance, and the number of points."""
    force = 0.05 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
    start = bp.solve_periodic(model, VALUES, {"force": force}, frequency=0.3, samples=SAMPLES)
    best, points = np.inf, 0
    for _ in range(BRANCHES):
        begin = time.process_time()
        branch = bp.continue_periodic(model, start, "frequency", until=1.2, progress=False)
        best, points = min(best, time.process_time() - begin), len(branch)
    return 1e3 * best / points, points


def main(degrees: list[int]) -> None:
    """Print the tables."""
    force = 0.1 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
    print("degrees  build [s]  first [s]  warm [ms]  symbolic warm [ms]  ratio")
    for count in degrees:
        start = time.process_time()
        model = beam(count, True)
        build = time.process_time() - start
        how: dict[str, Any] = {"frequency": FREQUENCY, "samples": SAMPLES}
        truth = bp.solve_periodic(model, VALUES, {"force": force}, **how)
        run = bp.Experiment("run", FREQUENCY, truth.outputs, {"force": force}, samples=SAMPLES)
        first, warm, finite = cost(problem(model, run), POINTS, 20)
        row = f"{count:7d}  {build:9.2f}  {first:9.2f}  {warm:9.4f}"
        if count <= MOST_SYMBOLIC:
            _, slow, converged = cost(problem(beam(count, False), run), 16, 2)
            row += f"  {slow:18.4f}  {slow / warm:5.0f}" + ("" if converged == 1.0 else f"  ({converged:.0%} finite)")
        print(row + ("" if finite == 1.0 else f"  ({finite:.0%} finite)"), flush=True)
    print("response curve with multipliers\ndegrees  points  a point [ms]")
    for count, condensed in [(2, False), *((count, True) for count in degrees)]:
        milliseconds, points = branch_cost(beam(count, condensed))
        print(f"{count:7d}  {points:6d}  {milliseconds:12.2f}" + ("" if condensed else "  (symbolic)"), flush=True)


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]] or [8, 32, 100, 300])
