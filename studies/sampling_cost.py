"""What sampling costs beside its log-posteriors: in a pool of workers, and in one vectorised call on several cores."""

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from multiprocessing import get_context
from typing import Any

import numba
import numpy as np

import bayesperiodic as bp
from bayesperiodic.parallel import available_cores
from studies.solver_cost import GEAR, RIG

SAMPLES = 800
LOG_POSTERIOR = 5e-3
WALKERS, ENSEMBLES, STEPS = 8, 2, 250
POINTS = 64
LOOP = 5_000_000


def gear_problem(drive: str = "force", samples: int = SAMPLES, free: tuple[str, ...] = ()) -> bp.Problem:
    """Return the problem of the landing gear with the 14 experiments of `RIG` (synthetic, noise of 0.3 % of the range).

    Parameters
    ----------
    drive : "force" or "displacement"
    samples : int
    free : tuple of str
        By default theta4, theta6 and theta16.
    """
    model, wave = bp.models.landing_gear(drive), np.cos(2 * np.pi * np.arange(samples) / samples)
    generator, experiments = np.random.default_rng(4), []
    for frequency, force, stroke in RIG:
        inputs = {drive: 4500.0 + force * wave if drive == "force" else 0.12 + stroke * wave}
        truth = bp.solve_periodic(model, GEAR, inputs, frequency=frequency, samples=samples)
        outputs = {name: y + 3e-3 * np.ptp(y) * generator.standard_normal(samples) for name, y in truth.outputs.items()}
        run = bp.Experiment(f"{frequency} Hz", frequency, outputs, inputs, samples=samples, synthetic=True)
        experiments.append(run)
    every = {
        "theta4": bp.LogNormal(GEAR["theta4"], 1.0),
        "theta6": bp.Normal(GEAR["theta6"], 2.5),
        "theta16": bp.Normal(GEAR["theta16"], 4.0),
    }
    priors = {name: every[name] for name in free or every}
    tied = {"theta11": "-1e5*theta4"}
    fixed = {name: value for name, value in GEAR.items() if name not in (*priors, *tied)}
    return bp.Problem(model, experiments, priors=priors, fixed=fixed, tied=tied)


def estimate(problem: bp.Problem) -> bp.MapEstimate:
    """Return the MAP estimate of a landing-gear problem, started from the truth."""
    return bp.map_estimate(problem, start={name: GEAR[name] for name in problem.names}, progress=False)


def pool_overhead(repeats: int = 5) -> dict[str, Any]:
    """Compare a sampling run on one thread with the same run in a pool of one worker, log-posteriors taking 5 ms.

    The pools have done a run before, as starting processes takes seconds whatever the length of a run. Repeats are
    interleaved. With a quarter of the walkers that are the default, a message is worth a quarter of the usual work.

    Parameters
    ----------
    repeats : int
        A minute each.

    Returns
    -------
    dict
        "process" and "dask": medians of the ratios of wall times, pool to serial; "quartiles" of these;
        "milliseconds" a log-posterior takes in the serial run; "samples" that make it so; "log_posteriors" a run;
        "target".
    """
    from distributed import Client, LocalCluster

    problem, fit = _sized()
    settings: dict[str, Any] = {"ensembles": ENSEMBLES, "walkers": WALKERS, "max_steps": STEPS, "progress": False}

    def run(executor: Any) -> tuple[float, bp.Posterior]:
        with _one_core() if executor is None else nullcontext():
            before = time.perf_counter()
            posterior = bp.sample(problem, fit, seed=1, variances="collapsed", executor=executor, **settings)
            return time.perf_counter() - before, posterior

    with (
        ProcessPoolExecutor(1, get_context("spawn")) as process,
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as dask,
    ):
        executors = {"serial": None, "process": process, "dask": dask}
        runs = [{name: run(executor) for name, executor in executors.items()} for _ in range(repeats + 1)][1:]
    times = {name: np.array([entry[name][0] for entry in runs]) for name in executors}
    posterior = runs[0]["serial"][1]
    for name in executors:
        if not np.array_equal(runs[0][name][1].draws("theta16"), posterior.draws("theta16")):
            raise RuntimeError(f"The chain of {name!r} is not that of the serial run.")
    ratios = {name: times[name] / times["serial"] for name in ("process", "dask")}
    return {
        **{name: float(np.median(values)) for name, values in ratios.items()},
        "quartiles": {name: np.quantile(values, [0.25, 0.75]).tolist() for name, values in ratios.items()},
        "milliseconds": float(np.median(times["serial"])) / posterior.log_posterior_calls * 1e3,
        "samples": problem.experiments[0].samples,
        "log_posteriors": posterior.log_posterior_calls,
        "target": 1.05,
    }


def _sized() -> tuple[bp.Problem, bp.MapEstimate]:
    """Return the problem of theta16 alone, with as many samples as make a log-posterior take 5 ms on one core."""
    samples, cost = SAMPLES, 0.0
    for _ in range(3):
        problem = gear_problem(samples=samples, free=("theta16",))
        fit = estimate(problem)
        anchored, noise = problem.anchored(fit.theta), np.array(list(fit.noise.values()))
        theta = _draws(fit, WALKERS // 2)
        cost = _seconds(lambda: anchored.log_likelihood(theta, noise, 1), 20) / len(theta)  # noqa: B023
        if abs(cost / LOG_POSTERIOR - 1.0) < 0.1:
            break
        samples = max(100, 2 * round(0.5 * samples * LOG_POSTERIOR / cost))
    return problem, fit


def vectorised_gain(repeats: int = 15) -> dict[str, Any]:
    """Compare what all cores gain on one call of 64 walkers × 14 experiments with what they gain on a plain loop.

    The call is `Problem.log_likelihood`, on one thread and on as many as there are cores; the plain loop is compiled,
    needs no memory, and runs once a core. All four are timed in turn within every repeat.

    Returns
    -------
    dict
        "cores", and by drive: "gain" of the call, "gain_of_plain_loop", "ratio" (median of their ratios),
        "ratio_quartiles", "milliseconds" on one core.
    """
    cores, result = available_cores(), {}
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(_loop, [10] * cores))
        for drive in ("force", "displacement"):
            problem = gear_problem(drive)
            fit = estimate(problem)
            anchored, noise = problem.anchored(fit.theta), np.array(list(fit.noise.values()))
            theta = _draws(fit, POINTS)
            actions: dict[str, Callable[[], Any]] = {
                "one": lambda: anchored.log_likelihood(theta, noise, 1),  # noqa: B023
                "many": lambda: anchored.log_likelihood(theta, noise, cores),  # noqa: B023
                "loop_one": lambda: [_loop(LOOP) for _ in range(cores)],
                "loop_many": lambda: list(pool.map(_loop, [LOOP] * cores)),
            }
            rows = [{name: _seconds(action, 1) for name, action in actions.items()} for _ in range(repeats + 1)][1:]
            times = {name: np.array([row[name] for row in rows]) for name in actions}
            gains, plain = times["one"] / times["many"], times["loop_one"] / times["loop_many"]
            result[drive] = {
                "gain": float(np.median(gains)),
                "gain_of_plain_loop": float(np.median(plain)),
                "ratio": float(np.median(gains / plain)),
                "ratio_quartiles": np.quantile(gains / plain, [0.25, 0.75]).tolist(),
                "milliseconds": float(np.median(times["one"])) * 1e3,
            }
    return {"cores": cores, "walkers": POINTS, "experiments": len(RIG), "target_ratio": 0.9, **result}


def _draws(fit: bp.MapEstimate, size: int) -> np.ndarray:
    """Return θ (size, names) around an estimate, scattered by its standard deviations."""
    mean, sd = np.array(list(fit.theta.values())), np.array(list(fit.sd.values()))
    return mean + sd * np.random.default_rng(5).standard_normal((size, mean.size))


def _seconds(action: Callable[[], Any], calls: int) -> float:
    """Return the median time of a call."""
    times = []
    for _ in range(calls):
        before = time.perf_counter()
        action()
        times.append(time.perf_counter() - before)
    return float(np.median(times))


@contextmanager
def _one_core() -> Iterator[None]:
    """Hold this thread, and those that it starts, on one core."""
    if not hasattr(os, "sched_setaffinity"):
        raise RuntimeError("Only Linux holds a process on one core, and this comparison needs that.")
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@numba.njit(nogil=True)
def _loop(count: int) -> float:
    total = 0.0
    for k in range(count):
        total += 1.0 / (1.0 + k * total)
    return total
