"""Is a 90 % interval a 90 % interval: simulated campaigns of three problems, and of one whose likelihood is wrong.

All data are synthetic. Every replicate draws its truth from the priors, records it by time integration, and goes
through fold, MAP point, Laplace approximation and emcee (`bp.calibrate`). The likelihood of the second case is
deliberately wrong: it counts a quarter more independent values than there are, as if every variance were a fifth
smaller. Replicates are saved as they end, results after each case, and the same command does what is missing.
``--processes N`` has the replicates done by N processes, ``--dask ADDRESS`` by a Dask cluster, ``--mpi`` by the
processes of ``mpiexec -n 3 python -m mpi4py.futures -m studies calibration --mpi``. ``--scaling`` measures what a
second worker gains, and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.calibration.cases import OVERCOUNT, damper, duffing, landing_gear, miscounted
from studies.calibration.scaling import scaling

CASES: dict[str, Callable[[], bp.Problem]] = {
    "duffing": duffing,
    "miscounted": miscounted,
    "damper": damper,
    "landing_gear": landing_gear,
}
DEFAULT, QUICK = 20, 5
STRIDE = 4
STEPS = 250
BINS = 20


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    if options.replicates < 0:
        raise ValueError(f"--replicates: {options.replicates} is not allowed; it must be at least 0.")
    if options.scaling:
        print(f"scaling: {common.write_results(options.out / 'scaling', scaling(options.seed))}")
        return
    count = options.replicates or (QUICK if options.quick else DEFAULT)
    watch = common.Stopwatch()
    print(f"All data are SYNTHETIC: {count} campaigns of every case, their truths drawn from the priors.")
    results: dict[str, Any] = {}
    about = {"synthetic": True, "seed": options.seed, "replicates": count, "steps": STEPS, "overcount": OVERCOUNT}
    with executor_of(options) as executor:
        for number, (name, case) in enumerate(CASES.items()):
            with watch.part(name, name.replace("_", " ")):
                found = bp.calibrate(
                    case(), replicates=count, seed=STRIDE * options.seed + number, folder=options.out / name,
                    executor=executor, max_steps=STEPS,
                )  # fmt: skip
            print(found)
            results[name] = collect(found)
            study = about | {"cases": list(results), "seconds": watch.total(), "versions": common.versions()}
            paths = common.save_figures(options.out, {name: bp.plot.ranks(found)})
            path = common.write_results(options.out, results | {"study": study})
            print(f"figure (synthetic data): {paths[0]}\nresults so far: {path}")


@contextmanager
def executor_of(options: argparse.Namespace) -> Iterator[Any]:
    """Provide who does the replicates."""
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


def collect(one: bp.Calibration) -> dict[str, Any]:
    """Return the content of results.json on one case; NaN becomes None."""
    rows = one.table.to_dict("records")
    return {
        "replicates": one.replicates,
        "failures": one.failures,
        "stop_rule_passed": one.stop_rule,
        "independent_draws": one.draws,
        "failed_solves": one.failed_solves,
        "table": [{key: None if value != value else value for key, value in row.items()} for row in rows],
        "histograms": {
            method: {name: np.histogram(values, BINS, (0.0, 1.0))[0].tolist() for name, values in by_name.items()}
            for method, by_name in one.positions.items()
        },
    }
