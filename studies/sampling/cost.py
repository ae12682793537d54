"""Overhead of sampling: in a pool of workers, and in one vectorised call on several cores."""

import importlib.util
import logging
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesperiodic as bp
from studies.common import Row, available_cores, row
from studies.gear import GEAR, RIG, gear_problem
from studies.timing import gain_of_cores, plain_loop, timed

LOG_POSTERIOR, SHORT = 5e-3, 1e-5
# Half a step is one task, of as many points as in a default run.
WALKERS, ENSEMBLES, STEPS = 8, 4, 100
PIECE = WALKERS * ENSEMBLES // 2
POOLS = ("process", "dask")
POINTS = 64
TURNS = 100_000
POOL_LIMIT, GAIN_LIMIT = 1.05, 0.9
LEAST_GAIN = 1.5
QUIET = 0.5
ONLY_LINUX = "not measurable here: only Linux holds a process on one core"


def run_cost(quick: bool) -> dict[str, Any]:
    """Measure the cost of sampling on this machine; a quick run omits the pools."""
    load = [*os.getloadavg()] if hasattr(os, "getloadavg") else None
    found: dict[str, Any] = {"load_average": load, "cores": available_cores()}
    found["vectorised"] = vectorised_gain(3 if quick else 15)
    able = hasattr(os, "sched_setaffinity")
    found["pools"] = None if quick or not able else pool_overhead()
    found["without_pools"] = "not measured in a quick run" if quick else "dask is not installed" if able else ONLY_LINUX
    return found


def rows(cost: dict[str, Any]) -> list[Row]:
    """Return the targets of the costs, without a verdict if this machine cannot measure them."""
    result, pools, vectorised = [], cost["pools"], cost["vectorised"]
    for name in POOLS:
        what = f"wall time of a pool of one {name} worker over that of one thread"
        if pools is None or name not in pools["ratios"]:
            result.append(row(what, None, 0.0, POOL_LIMIT, cost["without_pools"]))
        else:
            entry = pools["ratios"][name]
            result.append(row(what, entry["median"], 0.0, POOL_LIMIT, _quartiles(entry["quartiles"])))
    for drive in ("force", "displacement"):
        entry = vectorised[drive]
        what = f"gain of {vectorised['cores']} cores on a vectorised call over that of a plain loop, {drive}-driven"
        gain, plain = row(what, entry["ratio"], GAIN_LIMIT, None, _quartiles(entry["ratio_quartiles"])), entry["plain"]
        if plain < LEAST_GAIN:
            note = f"not measurable on this machine or under this load: a plain loop gains {plain:.2f}"
            gain |= {"met": None, "note": note}
        result.append(gain)
    return result


def _quartiles(pair: list[float]) -> str:
    return f"quartiles {pair[0]:.3f} … {pair[1]:.3f}"


def loaded(cost: dict[str, Any]) -> str:
    """Return a note if the machine was busy when the measurements began, else an empty string."""
    load = cost["load_average"]
    if load is None or load[0] <= QUIET * cost["cores"]:
        return ""
    return f"the machine was busy (load {load[0]:.1f} on {cost['cores']} cores): times are not for quoting"


class Pool(NamedTuple):
    """An executor with one worker held on a core."""

    executor: Any  # None for a thread of this process
    clock: Callable[[], float]  # Returns the processor time [s] that the worker has used


def pool_overhead(repeats: int = 3, pools: tuple[str, ...] = POOLS, seconds: float = LOG_POSTERIOR) -> dict[str, Any]:
    """Compare a sampling run on one thread with the same run handed to one worker.

    Both compute on the same core, the worker while this process waits on another one: then neither the cores' speeds
    nor other load on them affects the comparison. Runs alternate, thread, processes, thread, Dask, thread, and so on,
    and each is compared with the mean of its two neighbours. The workers have done a short run before, as starting
    processes takes seconds whatever the length of a run. Half a step of all ensembles is one task of 16 points, as
    large as the tasks of a default run.

    `repeats`: Of each pool, 20 s each. `pools`: "dask" is omitted if it is not installed. `seconds`: Of a
    log-posterior. Processor times are those of this process and the worker together; other load changes them little.
    """
    kinds = [name for name in pools if name != "dask" or importlib.util.find_spec("distributed")]
    core, *others = sorted(os.sched_getaffinity(0))
    with _only_on({core}):
        problem, fit = slow_problem(seconds)
    times: dict[str, list[np.ndarray]] = {name: [] for name in ("thread", *kinds)}
    chains: dict[str, bp.Posterior] = {}
    with ExitStack() as stack:
        workers = {"thread": Pool(None, float)} | {name: stack.enter_context(_POOLS[name](core)) for name in kinds}
        for name in kinds:
            _timed_run(*slow_problem(SHORT), workers[name], core, others)
        for name in ["thread", *(name for _ in range(repeats) for kind in kinds for name in (kind, "thread"))]:
            used, chains[name] = _timed_run(problem, fit, workers[name], core, others)
            times[name].append(used)
    for name, chain in chains.items():
        if not np.array_equal(chain.draws("k"), chains["thread"].draws("k")):
            raise RuntimeError(f"The chain of {name!r} is not that of the thread.")
    thread, count = np.array(times["thread"]), chains["thread"].log_posterior_calls
    between = 0.5 * (thread[1:] + thread[:-1])
    wall, processor = np.median(thread, axis=0) / count * 1e3
    ratios = {}
    for i, name in enumerate(kinds):
        walls, processors = np.transpose(np.array(times[name]) / between[i :: len(kinds)])
        quartiles = np.quantile(walls, [0.25, 0.5, 0.75]).tolist()
        ratios[name] = {
            "median": quartiles[1], "quartiles": quartiles[::2], "processor_time": float(np.median(processors))
        }  # fmt: skip
    return {
        "ratios": ratios,
        "milliseconds": {"wall": float(wall), "processor": float(processor)},
        "walkers": WALKERS,
        "log_posteriors": {"run": count, "piece": PIECE},
    }


def _timed_run(
    problem: bp.Problem, fit: bp.MapEstimate, pool: Pool, core: int, others: list[int]
) -> tuple[np.ndarray, bp.Posterior]:
    """Return wall and processor seconds of a run, this process waiting on another core where a worker computes."""
    with _only_on({core} if pool.executor is None or not others else {others[0]}):
        before = time.perf_counter(), time.process_time() + pool.clock()
        posterior = bp.sample(
            problem, fit, seed=1, variances="collapsed", executor=pool.executor, ensembles=ENSEMBLES, walkers=WALKERS,
            max_steps=STEPS, progress=False,
        )  # fmt: skip
        after = time.perf_counter(), time.process_time() + pool.clock()
    return np.subtract(after, before), posterior


@contextmanager
def _process_pool(core: int) -> Iterator[Pool]:
    with ProcessPoolExecutor(1, get_context("spawn"), _stay_on, (core,)) as pool:
        yield Pool(pool, lambda: pool.submit(time.process_time).result())


@contextmanager
def _dask_pool(core: int) -> Iterator[Pool]:
    from distributed import Client, LocalCluster

    with (
        # A worker that is stopped while it sends a heartbeat logs long messages.
        LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
        ) as cluster,
        Client(cluster) as client,
    ):
        client.run(_stay_on, core)
        yield Pool(client, lambda: sum(client.run(time.process_time).values()))


_POOLS = {"process": _process_pool, "dask": _dask_pool}


def _stay_on(core: int) -> None:
    """Hold all threads of this process, and those that they start, on one core."""
    for thread in Path("/proc/self/task").iterdir():
        os.sched_setaffinity(int(thread.name), {core})


@contextmanager
def _only_on(cores: set[int]) -> Iterator[None]:
    """Hold this thread, and those that it starts, on some cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@dataclass(frozen=True)
class SlowPrior(bp.Normal):
    """A normal prior that is as slow as a large model, while everything else in a run is quick."""

    turns: int  # Of a plain loop for every value

    def log_prob(self, x: Any) -> Any:
        """Return the log-density, after the loop."""
        plain_loop(self.turns * np.size(x))
        return super().log_prob(x)


def slow_problem(seconds: float) -> tuple[bp.Problem, bp.MapEstimate]:
    """Return a problem of the Duffing oscillator whose log-posterior takes a given time on one core."""
    plain_loop(10)
    turn = min(timed(partial(plain_loop, TURNS), time.thread_time)[1] for _ in range(10)) / TURNS
    values, samples = {"m": 1.0, "c": 0.5, "k": 1.0, "k3": 0.1}, 40
    force = {"force": np.cos(2 * np.pi * np.arange(samples) / samples)}
    truth = bp.solve_periodic(bp.models.duffing, values, force, frequency=0.1, samples=samples, scheme="fourier")
    noise = 0.05 * np.random.default_rng(4).standard_normal(samples)
    outputs = {"displacement": truth.outputs["displacement"] + noise}
    run = bp.Experiment("run", 0.1, outputs, force, samples=samples, synthetic=True)
    fixed = {name: value for name, value in values.items() if name != "k"}
    prior = SlowPrior(1.0, 1.0, round(seconds / turn))
    problem = bp.Problem(bp.models.duffing, [run], priors={"k": prior}, fixed=fixed, scheme="fourier")
    return problem, bp.map_estimate(problem, progress=False)


def vectorised_gain(repeats: int = 15) -> dict[str, Any]:
    """Compare the gain of all cores on one call of 64 walkers × 14 experiments with that on a plain loop.

    The call is `Problem.log_likelihood`, on one thread and on as many as there are cores. The result has an entry of
    `gain_of_cores` for each drive.
    """
    cores, result = available_cores(), {}
    for drive in ("force", "displacement"):
        problem = gear_problem(drive, 4, scheme="central2")
        start = {name: GEAR[name] for name in problem.names}
        fit = bp.map_estimate(problem, start=start, checks=False, progress=False)
        mean, sd, noise = (np.array(list(values.values())) for values in (fit.theta, fit.sd, fit.noise))
        theta = mean + sd * np.random.default_rng(5).standard_normal((POINTS, mean.size))
        call = partial(problem.anchored(fit.theta).log_likelihood, theta, noise)
        result[drive] = gain_of_cores(call, cores, repeats)
    return {"cores": cores, "walkers": POINTS, "experiments": len(RIG), **result}
