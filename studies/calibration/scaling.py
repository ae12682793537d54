"""What a second worker gains, what a task costs, and what that means for a thousand workers.

Campaigns of the Duffing oscillator are farmed out to Dask clusters of one and of two processes on this machine. Between
them the same number of plain loops, that share nothing, run in processes of their own: what two of these gain is what
the machine has to give at that moment, and the farm is measured against it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from typing import Any

import cloudpickle
import numpy as np

import bayesperiodic as bp
from bayesperiodic._parallel import TaskPool
from studies.calibration.cases import duffing

ROUNDS, EACH, LOOP = 7, 6, 20_000_000
EMPTY = 500
STEPS = 250


def scaling(seed: int) -> dict[str, Any]:
    """Return the gains of two workers, seconds a replicate, the cost of a task, and sizes of what travels."""
    from distributed import Client, LocalCluster

    problem = duffing()
    with ExitStack() as stack:
        pool = stack.enter_context(ProcessPoolExecutor(2, get_context("spawn")))
        clients = {}
        for workers in (1, 2):
            cluster = stack.enter_context(LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None))
            clients[workers] = stack.enter_context(Client(cluster))

        def farm(workers: int, each: int, first: int) -> None:
            bp.calibrate(
                problem, replicates=each * workers, seed=first, executor=clients[workers], max_steps=STEPS,
                progress=False,
            )  # fmt: skip

        def loops(workers: int) -> None:
            for done in [pool.submit(plain_loop, LOOP) for _ in range(workers)]:
                done.result()

        for workers in (1, 2):
            farm(workers, 2, seed)
            loops(workers)
        times: dict[str, list[float]] = {"farm 1": [], "farm 2": [], "loop 1": [], "loop 2": []}
        for number in range(ROUNDS):
            for workers in (1, 2):
                times[f"loop {workers}"].append(_seconds(lambda w=workers: loops(w)))  # type: ignore[misc]
                times[f"farm {workers}"].append(_seconds(lambda w=workers, n=number: farm(w, EACH, n)))  # type: ignore[misc]
        overhead = _overhead(clients[2])
    return _account(times, overhead, problem)


def plain_loop(count: int) -> int:
    """Count in plain Python."""
    total = 0
    for k in range(count):
        total += k
    return total


def _overhead(client: Any) -> float:
    """Return seconds a task that does nothing, of many at once on two workers."""

    def empty() -> None:
        with TaskPool(client, None) as pool:
            for _ in pool.run(_nothing, range(EMPTY)):
                pass

    empty()
    return float(np.median([_seconds(empty) for _ in range(3)])) / EMPTY


def _nothing(_: None, task: int) -> int:
    return task


def _seconds(action: Callable[[], Any]) -> float:
    before = time.perf_counter()
    action()
    return time.perf_counter() - before


def _account(times: dict[str, list[float]], overhead: float, problem: bp.Problem) -> dict[str, Any]:
    gains = {what: 2.0 * np.array(times[f"{what} 1"]) / np.array(times[f"{what} 2"]) for what in ("farm", "loop")}
    ratio = gains["farm"] / gains["loop"]
    replicate = float(np.median(times["farm 1"])) / EACH
    return {
        "gain_of_two_workers": float(np.median(gains["farm"])),
        "gain_of_two_plain_loops": float(np.median(gains["loop"])),
        "ratio": float(np.median(gains["farm"]) / np.median(gains["loop"])),
        "ratios_of_rounds": ratio.tolist(),
        "seconds_a_replicate": replicate,
        "overhead_a_task_seconds": overhead,
        "problem_bytes": len(cloudpickle.dumps(problem)),
        "rounds": ROUNDS,
        "replicates_a_round_and_worker": EACH,
        "workers_one_scheduler_feeds": int(replicate / overhead),
    }
