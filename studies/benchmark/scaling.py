"""Growth of time and memory with samples, experiments, walkers and parameters; time of the first calls."""

import os
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.benchmark.large import peak as peak
from studies.gear import GEAR, NOISE, gear_problem
from studies.timing import Action, interleaved, slope

SIZES = {"samples": (800, 1600, 3200), "experiments": (2, 4, 7, 14), "walkers": (16, 32, 64, 128)}
FREE = (1, 3, 7, 15)
WALKERS = 64

IMPORT = "import time; t = time.perf_counter(); import bayesperiodic; print(time.perf_counter() - t)"
# Names are loaded where they are first used.
NAMES = IMPORT.replace("bayesperiodic;", "bayesperiodic as bp; bp.Model, bp.Problem, bp.map_estimate, bp.sample;")
FIRST = """
import time, numpy as np, bayesperiodic as bp
model = bp.Model("first", states=["x"], inputs=["force"], parameters={"c": "N s/m", "k3": "N/m^3"},
    equations=lambda s, p, u: [s.ddx + p.c * s.dx + s.x + p.k3 * s.x**POWER - u.force],
    outputs=lambda s, p, u: {"displacement": s.x})
force = {"force": 0.1 * np.cos(2 * np.pi * np.arange(100) / 100)}
t = time.perf_counter()
bp.solve_periodic(model, {"c": 0.1, "k3": 0.5}, force, frequency=0.1, samples=100)
print(time.perf_counter() - t)
"""
MEMORY = """
import numpy as np
from studies.benchmark.scaling import at_truth, peak
problem, theta, noise = at_truth("force", 800, 14)
assert np.isfinite(problem.log_posterior(np.tile(theta, (64, 1)), noise)).all()
print(peak())
"""


def measure(seed: int) -> dict[str, Any]:
    """Return times and peaks of the batched call of the force-driven landing gear, with their exponents."""
    found = {
        axis: _fitted(sizes, [_batched(**{axis: size}, seed=seed) for size in sizes]) for axis, sizes in SIZES.items()
    }
    found["parameters"] = _fitted(FREE, [_gradient(free, seed) for free in FREE])
    return {"growth": found, "start": start()}


def _fitted(sizes: tuple[int, ...], calls: list[Callable[[], Any]], repeats: int = 15) -> dict[str, Any]:
    times = interleaved({str(size): Action(call) for size, call in zip(sizes, calls, strict=True)}, repeats)
    exponents = [slope(sizes, repeat) for repeat in zip(*times.values(), strict=True)]  # as a machine's speed drifts
    peaks = [_peak(call) for call in calls]
    return {
        "sizes": list(sizes), "seconds": [float(np.median(values)) for values in times.values()], "bytes": peaks,
        "time_exponent": float(np.median(exponents)), "memory_exponent": slope(sizes, peaks),
    }  # fmt: skip


def _peak(call: Callable[[], Any]) -> int:
    """Return the largest memory that NumPy's arrays take within a call that is not the first [bytes]."""
    call()
    tracemalloc.start()
    call()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


@cache
def at_truth(drive: str, samples: int, experiments: int, *, free: int = 3, seed: int = 1) -> Any:
    """Return the landing gear anchored at its true parameters, these, and variances of the noise's size."""
    problem = gear_problem(drive, seed, free=free, samples=samples, runs=experiments)
    theta = np.array([GEAR[name] for name in problem.names])
    spans = {c: np.mean([np.ptp(e.outputs[c]) for e in problem.experiments]) for c in problem.channels}
    noise = np.array([(NOISE * spans[channel]) ** 2 for channel in problem.channels])
    return problem.anchored(theta), theta, noise


def _batched(samples: int = 800, experiments: int = 14, walkers: int = WALKERS, seed: int = 1) -> Callable[[], Any]:
    problem, theta, noise = at_truth("force", samples, experiments, seed=seed)
    many = np.tile(theta, (walkers, 1)) * (1.0 + 1e-6 * np.random.default_rng(seed).standard_normal((walkers, 1)))
    return partial(problem.log_posterior, many, noise)


def _gradient(free: int, seed: int) -> Callable[[], Any]:
    problem, _, noise = at_truth("force", 800, 14, free=15, seed=seed)
    kept = dict(list(problem.priors.items())[:free])
    fixed = {name: GEAR[name] for name in problem.names if name not in kept}
    fewer = bp.Problem(problem.model, problem.experiments, priors=kept, fixed=fixed, scheme=problem.scheme)
    theta = np.array([GEAR[name] for name in fewer.names])
    return partial(fewer.anchored(theta).gradient, theta, noise)


def start() -> dict[str, float]:
    """Return start-up times [s] and the peak memory of a process [MB].

    First solve with an empty cache, first solve of a new model with the generic kernels cached, and the same solve from
    the cache.
    """
    fifth, third = (FIRST.replace("POWER", power) for power in "53")
    with tempfile.TemporaryDirectory() as cache:
        run = partial(_run, environment=os.environ | {"BAYESPERIODIC_CACHE": cache})
        return {
            "import_s": min(run(IMPORT) for _ in range(3)),
            "names_s": min(run(NAMES) for _ in range(3)),
            "empty_cache_s": run(fifth),
            "first_solve_s": run(third),
            "from_cache_s": min(run(third) for _ in range(3)),
            "peak_mb": _run(MEMORY, dict(os.environ)),
        }


def _run(text: str, environment: dict[str, str]) -> float:
    """Return the number that a fresh process prints last."""
    done = subprocess.run([sys.executable, "-c", text], env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def account(found: dict[str, Any]) -> str:
    """Return the text to print."""
    exponents = common.shown("growth with size", found["growth"], ["time_exponent", "memory_exponent"])
    first = common.shown("start-up times [s] and peak memory [MB]", {"": found["start"]})
    return f"{exponents}\n{first}"
