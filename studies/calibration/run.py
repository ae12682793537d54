"""Coverage of intervals: simulated campaigns of four problems, and of one with a wrong likelihood.

All data are synthetic, with white noise. Every replicate draws its truth from the priors, records it by time
integration, and runs fold, MAP estimate, Laplace approximation and emcee (`bp.calibrate`). The likelihood of the second
case is deliberately wrong: it counts a quarter more independent values than there are, as if every variance were a
fifth smaller. Chains are shorter than the stop rule of `bp.sample`; a rank rests on draws five autocorrelation times
apart, of which number and R-hat are stored, with the largest Monte Carlo error of a position, 0.5/√draws.

Replicates are saved as they end, results after each case; the same command computes missing replicates. Replicates run
in N processes with ``--processes N``, on a Dask cluster with ``--dask ADDRESS``, or in the processes of
``mpiexec -n 3 python -m mpi4py.futures -m studies calibration --mpi``.

``--scaling`` only measures the gain of a second worker and the cost of a task. Campaigns of the Duffing oscillator run
on Dask clusters of one and of two processes; between them, independent plain loops in two processes measure what the
machine can gain at that moment.
"""

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import get_context
from typing import Any

import cloudpickle
import numpy as np

import bayesperiodic as bp
from studies import common
from studies.common import TaskPool
from studies.gear import GEAR
from studies.timing import timed

CYCLES = 10
OVERCOUNT = 1.25


def damper() -> bp.Problem:
    """Return the problem of the damper: Dahl friction, 0.5 mm at 8 Hz, noise of 24 N in each sample of the force."""
    run = _run("8 Hz 0.5 mm", 8.0, {"displacement": (0.0, 5e-4)}, {"force": 20}, 256)
    priors = {"Kx": bp.LogNormal(800.0, 0.2), "Kw": bp.LogNormal(60.0, 0.2), "rho": bp.LogNormal(2.8e4, 0.3)}
    return _problem(bp.models.dahl, run, priors, {"K": 0.0, "F0": 0.0}, 24.0**2)


def miscounted() -> bp.Problem:
    """Return that of the Duffing oscillator with a likelihood that counts a quarter more independent values.

    The displacement is measured so well, with noise of 0.11 mm in each sample, that the priors hardly matter.
    """
    return duffing(1.1e-4, OVERCOUNT)


def duffing(sd: float = 5.5e-4, overcount: float = 1.0) -> bp.Problem:
    """Return the problem of the Duffing oscillator: 10 N at 5 Hz, noise of 0.55 mm in each sample."""
    run = _run("5 Hz 10 N", 5.0, {"force": (0.0, 10.0)}, {"displacement": 10}, 64, overcount)
    priors = {"c": bp.LogNormal(1.2, 0.3), "k": bp.LogNormal(900.0, 0.1), "k3": bp.LogNormal(4e5, 0.4)}
    return _problem(bp.models.duffing, run, priors, {"m": 0.45}, sd**2)


def landing_gear() -> bp.Problem:
    """Return the problem of the landing gear: 80 mm about 120 mm at 0.2 Hz, force and pressure measured.

    Both variances have the same prior, one in N², the other in Pa²: about 230 N and 230 Pa in each sample.
    """
    run = _run("0.2 Hz 80 mm", 0.2, {"displacement": (0.12, 0.08)}, {"force": 30, "pressure": 15}, 128)
    priors = {"theta4": bp.LogNormal(5.2e-3, 0.1), "theta6": bp.Normal(-2.3, 0.15), "theta16": bp.LogNormal(2.0, 0.5)}
    tied = {"theta11": "-1e5*theta4"}
    fixed = {name: value for name, value in GEAR.items() if name not in (*priors, *tied)}
    return _problem(bp.models.landing_gear("displacement"), run, priors, fixed, 230.0**2, tied)


def two_optima() -> bp.Problem:
    """Return the problem of a gain 1.5 + (a − 2)²: two optima, of different mass by the prior, one for a near 2."""
    model = bp.Model(
        "squared_gain", states=["w"], inputs=["x"], parameters=["a"], equations=lambda s, p, u: [s.dw + s.w - u.x],
        outputs=lambda s, p, u: {"y": (1.5 + (p.a - 2) ** 2) * u.x},
    )  # fmt: skip
    run = _run("1 Hz", 1.0, {"x": (0.0, 1.0)}, {"y": 3}, 20)
    return _problem(model, run, {"a": bp.Normal(2.4, 0.8)}, {}, 0.6**2)


def _problem(
    model: bp.Model, run: bp.Experiment, priors: Any, fixed: Any, variance: float, tied: Any = None
) -> bp.Problem:
    noise = bp.noise.Independent(prior=bp.LogNormal(variance, 0.5))
    return bp.Problem(model, [run], priors=priors, fixed=fixed, tied=tied, noise=noise, scheme="central4")


def _run(
    name: str, frequency: float, inputs: dict[str, tuple[float, float]], harmonics: dict[str, int], samples: int,
    overcount: float = 1.0,
) -> bp.Experiment:  # fmt: skip
    """Return an experiment's settings, with the mean and the amplitude of each input; its outputs are never used."""
    wave = np.sin(2 * np.pi * np.arange(samples) / samples)
    given = {channel: mean + amplitude * wave for channel, (mean, amplitude) in inputs.items()}
    counted = {channel: round(overcount * (2 * kept + 1)) for channel, kept in harmonics.items()}
    return bp.Experiment(
        name, frequency, dict.fromkeys(harmonics, wave), given, samples=samples, cycles=CYCLES,
        harmonics=harmonics | dict.fromkeys(inputs, 1), independent=counted, synthetic=True,
    )  # fmt: skip


CASES: dict[str, Callable[[], bp.Problem]] = {
    "duffing": duffing, "miscounted": miscounted, "damper": damper, "landing_gear": landing_gear,
    "two_optima": two_optima,
}  # fmt: skip
DEFAULT, QUICK = 20, 5
STRIDE = 5
# The stop rule of `sample` takes 500 steps at least, so no chain can pass it. Ranks need independent draws instead.
STEPS = 250
BINS = 20


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    if options.scaling:
        print(f"scaling: {common.write_results(options.out / 'scaling', scaling(options.seed))}")
        return
    count = options.replicates or (QUICK if options.quick else DEFAULT)
    watch = common.Stopwatch()
    print(f"All data are SYNTHETIC: {count} campaigns of every case, their truths drawn from the priors.")
    results: dict[str, Any] = {}
    about = {"synthetic": True, "seed": options.seed, "replicates": count, "steps": STEPS, "overcount": OVERCOUNT}
    with _executor_of(options) as executor:
        for number, (name, case) in enumerate(CASES.items()):
            with watch.part(name, name.replace("_", " ")):
                found = bp.calibrate(
                    case(), replicates=count, seed=STRIDE * options.seed + number, folder=options.out / name,
                    executor=executor, max_steps=STEPS,
                )  # fmt: skip
            print(found)
            results[name] = _collect(found)
            study = about | {"cases": list(results), "seconds": watch.total(), "versions": common.versions()}
            paths = common.save_figures(options.out, {name: bp.plot.ranks(found)})
            path = common.write_results(options.out, results | {"study": study})
            print(f"figure (synthetic data): {paths[0]}\nresults so far: {path}")


@contextmanager
def _executor_of(options: argparse.Namespace) -> Iterator[Any]:
    if options.dask:
        from distributed import Client

        with Client(options.dask) as client:
            yield client
    elif options.mpi:
        from mpi4py.futures import MPIPoolExecutor

        with MPIPoolExecutor() as pool:
            yield pool
    else:
        yield options.processes


def _collect(one: bp.Calibration) -> dict[str, Any]:
    return {
        "replicates": one.replicates,
        "failures": one.failures,
        "stop_rule_passed": one.stop_rule,
        "independent_draws": one.draws,
        "largest_error_of_a_position": 0.5 / one.draws**0.5 if one.draws else None,
        "largest_rhat": one.rhat,
        "failed_solves": one.failed_solves,
        "table": one.table.to_dict("records"),
        "histograms": {
            method: {name: np.histogram(values, BINS, (0.0, 1.0))[0].tolist() for name, values in by_name.items()}
            for method, by_name in one.positions.items()
        },
    }


ROUNDS, EACH, LOOP = 7, 6, 60_000_000
EMPTY = 500
SCALING_STEPS = 250


def scaling(seed: int) -> dict[str, Any]:
    """Return the gain of two workers, seconds per replicate, the cost of a task, and message sizes."""
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
                problem, replicates=each * workers, seed=first, executor=clients[workers], max_steps=SCALING_STEPS,
                progress=False,
            )  # fmt: skip

        def loops(workers: int) -> None:
            for done in [pool.submit(sum, range(LOOP)) for _ in range(workers)]:
                done.result()

        for workers in (1, 2):
            farm(workers, 2, seed)
            loops(workers)
        times: dict[str, list[float]] = {"farm 1": [], "farm 2": [], "loop 1": [], "loop 2": []}
        for number in range(ROUNDS):
            for workers in (1, 2):
                times[f"loop {workers}"].append(timed(partial(loops, workers))[1])
                times[f"farm {workers}"].append(timed(partial(farm, workers, EACH, number))[1])
        overhead = _overhead(clients[2])
    gain, plain = (2.0 * np.array(times[f"{what} 1"]) / np.array(times[f"{what} 2"]) for what in ("farm", "loop"))
    replicate = float(np.median(times["farm 1"])) / EACH
    return {
        "gain_of_two_workers": float(np.median(gain)),
        "gain_of_two_plain_loops": float(np.median(plain)),
        "ratio": float(np.median(gain) / np.median(plain)),
        "ratios_of_rounds": (gain / plain).tolist(),
        "seconds_a_replicate": replicate,
        "overhead_a_task_seconds": overhead,
        "problem_bytes": len(cloudpickle.dumps(problem)),
        "rounds": ROUNDS,
        "replicates_a_round_and_worker": EACH,
        "workers_one_scheduler_feeds": int(replicate / overhead),
    }


def _overhead(client: Any) -> float:
    """Return the seconds of an empty task, among many on two workers."""

    def empty() -> None:
        with TaskPool(client, None) as pool:
            for _ in pool.run(_nothing, range(EMPTY)):
                pass

    empty()
    return float(np.median([timed(empty)[1] for _ in range(3)])) / EMPTY


def _nothing(_: None, task: int) -> int:
    return task
