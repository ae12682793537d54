"""What a log-posterior and a posterior cost, against what a user would pick instead, and against the arithmetic.

Every contender has to be right before its time counts: |Δ log-posterior| ≤ 0.01 at draws of the posterior and at three
times their spread, against fully converged, fine shooting; each at its own cheapest step count or tolerance. Ratios
are of times taken side by side in one run. Peers that are not installed are rows that say so.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import Any

from studies import common


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    from studies import benchmark_figures, benchmark_tables, benchmark_targets  # compiles
    from studies.sampling_rows import table

    watch = common.Stopwatch()
    found: dict[str, Any] = {"seed": options.seed, "quick": options.quick, "cores": os.cpu_count()}
    found["load_average"] = [*os.getloadavg()] if hasattr(os, "getloadavg") else None
    found |= {"problems": {}, "floor": {}}
    for name, make in problems(options).items():
        with watch.part(name, f"{name}: one log-posterior by every contender"):
            setting = make()
            found["problems"][name] = contest(setting, options.quick)
        print(benchmark_tables.problem(name, found["problems"][name]), flush=True)
        if name.startswith("landing gear"):
            with watch.part(f"floor, {name}", f"{name}: the floor"):
                found["floor"][name] = floor(setting, options.quick)
            print(benchmark_tables.floor(name, found["floor"][name]), flush=True)
    found["checks"] = benchmark_targets.rows(found)
    print("\nWhat must show\n" + table(found["checks"]) + "\n")
    with watch.part("figure", "drawing"):
        paths = common.save_figures(options.out, {"benchmark": benchmark_figures.draw(found)})
    path = common.write_results(options.out, found | {"seconds": watch.total(), "versions": common.versions()})
    print(f"figures: {', '.join(map(str, paths))}\nresults: {path}")


def problems(options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Return what makes the problems, by name; a quick run takes the first three."""
    from studies import benchmark_problems as made

    count, seed = (2, options.seed) if options.quick else (5, options.seed)
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


def contest(setting: Any, quick: bool) -> dict[str, Any]:
    """Return what all contenders take of one problem; a quick run leaves out those of SciPy that integrate."""
    from studies import benchmark_contenders as contenders
    from studies.benchmark_reference import refer

    contest = contenders.Contest(refer(setting))
    scheme = contenders.add_own(contest)
    compiled = contenders.add_compiled(contest)
    contenders.add_scipy(contest, compiled, quick=quick)
    return contenders.measured(contest, scheme, 3 if quick else 15)


def floor(setting: Any, quick: bool) -> dict[str, Any]:
    """Return the floor of the landing gear and the stages above it."""
    from studies import benchmark_floor

    return benchmark_floor.measure(setting, 5 if quick else 31)
