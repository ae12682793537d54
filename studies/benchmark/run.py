"""What a log-posterior and a posterior cost, against what a user would pick instead, and against the arithmetic.

Every contender has to be right before its time counts: |Δ log-posterior| ≤ 0.01 at draws of the posterior and at three
times their spread, against fully converged, fine shooting; each at its own cheapest step count or tolerance. Ratios
are of times taken side by side in one run, with linear algebra in one thread. Peers that are not installed are rows
that say so.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from studies import common, tasks

# What the guard compares with.
KEPT = Path("figures/benchmark/results.json")
# What each problem led to is kept here until the study ends.
PARTS = "parts"


@threadpool_limits.wrap(limits=1, user_api="blas")
def run(options: argparse.Namespace) -> None:
    """Run the study."""
    from studies.benchmark import figures, tables, targets  # compiles
    from studies.sampling.rows import table

    before = read_kept(KEPT) if options.guard else None
    if options.guard:
        options.quick, options.out = True, KEPT.parent.parent / "quick" / "benchmark"

    watch, kept = common.Stopwatch(), options.out / PARTS
    found: dict[str, Any] = {"seed": options.seed, "quick": options.quick, "cores": os.cpu_count()}
    found["load_average"] = [*os.getloadavg()] if hasattr(os, "getloadavg") else None
    found |= {"problems": {}, "floor": {}}
    for number, (name, make) in enumerate(problems(options).items()):
        with watch.part(name, f"{name}: every contender"):
            work = partial(_of_problem, name, make, options)
            one = tasks.remembered(kept / f"{number}.pkl", _source(options, name), work)
        found["problems"][name] = one["contest"]
        print(tables.problem(name, one["contest"]), flush=True)
        if "posterior" in one:
            found["posterior"] = one["posterior"]
            print(tables.posterior(one["posterior"]), flush=True)
        if "floor" in one:
            found["floor"][name] = one["floor"]
            print(tables.floor(name, one["floor"]), flush=True)
    if not options.quick:
        _rest(found, options, watch)
    found["checks"] = targets.rows(found)
    print("\nWhat must show\n" + table(found["checks"]) + "\n")
    with watch.part("figure", "drawing"):
        paths = common.save_figures(options.out, {"benchmark": figures.draw(found)})
    path = common.write_results(options.out, found | {"seconds": watch.total(), "versions": common.versions()})
    print(f"figures: {', '.join(map(str, paths))}\nresults: {path}")
    shutil.rmtree(kept, ignore_errors=True)
    if before is not None:
        guard(found, before)


def _of_problem(name: str, make: Callable[[], Any], options: argparse.Namespace) -> dict[str, Any]:
    """Return the contest of one problem, and what is measured on this one alone."""
    from studies.benchmark import posteriors
    from studies.benchmark.problems import DUFFING

    setting = make()
    result: dict[str, Any] = {}
    if name.startswith("landing gear"):
        result["floor"] = floor(setting, options.quick)  # before other packages start their threads
    result["contest"], methods = contest(setting, options.quick)
    if name == DUFFING and not options.quick:
        result["posterior"] = posteriors.measure(setting, result["contest"], methods, options.seed)
    return result


def _source(options: argparse.Namespace, name: str) -> str:
    """Return what tells kept parts of another version, or with other settings, apart."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    own = [common.sha256(path) for path in files]
    settings = map(str, (options.seed, options.quick, options.guard))
    return " ".join([common.versions()["bayesperiodic"], name, *settings, *own])


def _rest(found: dict[str, Any], options: argparse.Namespace, watch: common.Stopwatch) -> None:
    """Measure the pendulum's unstable orbit and how time and memory grow."""
    from studies.benchmark import pendulum, scaling

    with watch.part("pendulum", "an unstable orbit of the pendulum, by time integration"):
        found["pendulum"] = pendulum.measure(options.seed)
    print(pendulum.account(found["pendulum"]), flush=True)
    with watch.part("scaling", "growth of time and memory"):
        found["scaling"] = scaling.measure(options.seed)
    print(scaling.account(found["scaling"]), flush=True)


def read_kept(path: Path) -> dict[str, Any]:
    """Return the results that the guard compares with."""
    if not path.is_file():
        raise FileNotFoundError(f"--guard: {path} is not there; run the whole study first.")
    return json.loads(path.read_text(encoding="utf-8"))


def guard(found: dict[str, Any], before: dict[str, Any]) -> None:
    """Compare ratios, never seconds, with those kept; raise a RuntimeError if any is worse."""
    from studies.benchmark import guard as benchmark_guard

    lines = benchmark_guard.worse(found, before)
    print(f"guard: {benchmark_guard.compared(found, before)} ratios compared, tolerance {benchmark_guard.TOLERANCE:g}")
    if lines:
        raise RuntimeError("ratios are worse than those kept:\n" + "\n".join(lines))


def problems(options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Return what makes the problems, by name; a quick run takes the first three.

    The guard needs the draws of the whole run: what a contender takes depends on them, from the predicted orbit most.
    """
    from studies.benchmark import problems as made

    count, seed = (2, options.seed) if options.quick and not options.guard else (5, options.seed)
    every: dict[str, Callable[[], Any]] = {
        made.FORCE: lambda: made.gear("force", count, seed),
        made.DISPLACEMENT: lambda: made.gear("displacement", count, seed),
        made.DUFFING: lambda: made.duffing(count, seed),
    }
    if options.quick:
        return every
    return every | {
        made.DAMPER: lambda: made.damped(options.data, count, seed),
        made.SILVERBOX: lambda: made.silverbox(None, count, seed),
    }


def contest(setting: Any, quick: bool) -> tuple[dict[str, Any], Any]:
    """Return what all contenders take of one problem, and the methods of shooting from the predicted orbit.

    A quick run leaves out other packages and those of SciPy's methods that integrate.
    """
    from studies.benchmark import contenders, peers
    from studies.benchmark.integration import PREDICTED, SHOOTING
    from studies.benchmark.reference import refer

    contest = contenders.Contest(refer(setting))
    scheme = contenders.add_own(contest)
    compiled = contenders.add_compiled(contest)
    contenders.add_scipy(contest, compiled, quick=quick)
    if not quick:
        peers.add_peers(contest, compiled)
    return contenders.measured(contest, scheme, 3 if quick else 15), compiled.get((SHOOTING, PREDICTED), [])


def floor(setting: Any, quick: bool) -> dict[str, Any]:
    """Return the floor of the landing gear and the stages above it."""
    from studies.benchmark import floor as benchmark_floor

    return benchmark_floor.measure(setting, 5 if quick else 31)
