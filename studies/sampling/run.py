"""Accuracy and cost of sampling: a ridge known by quadrature, three samplers, pools of workers and cores.

The ridge is computed; the damper is measured or synthetic, see studies/damper/run.py.
"""

import argparse
from typing import Any

from studies import common
from studies.sampling import damper
from studies.sampling import figures as sampling_figures
from studies.sampling import ridge as sampling_ridge


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    from studies.sampling import cost as sampling_cost  # compiles

    watch = common.Stopwatch()
    with watch.part("cost", "overhead of a pool of workers, and gain of several cores"):
        cost = sampling_cost.run_cost(options.quick)
    busy = sampling_cost.loaded(cost)
    if busy:
        print(f"  note: {busy}")
    with watch.part("ridge", "the ridge a·b = 1, with known spread"):
        ridge = sampling_ridge.sample_ridge(options.seed, options.quick)
    with watch.part("damper", "the damper by three samplers"):
        sampled, data = damper.sample_damper(options)
    found: dict[str, Any] = {
        "ridge": sampling_ridge.collect(ridge),
        "damper": damper.collect(sampled, data),
        "cost": cost | {"note": busy},
    }
    found["checks"] = [
        *sampling_ridge.rows(found["ridge"]),
        *damper.rows(found["damper"], options.quick),
        *sampling_cost.rows(cost),
    ]
    with watch.part("figures", "drawing"):
        figures = {
            "ridge": sampling_figures.draw_ridge(ridge),
            "samplers": sampling_figures.draw_samplers(sampled, found["damper"]),
            "costs": sampling_figures.draw_costs(cost, busy),
        }
        paths = common.save_figures(options.out, figures)
    print("\n" + tables(found) + "\n")
    results = {"seed": options.seed, "quick": options.quick} | found
    path = common.write_results(options.out, results | {"seconds": watch.total(), "versions": common.versions()})
    what = " (synthetic data)" if data["synthetic"] else ""
    print(f"figures{what}: {', '.join(map(str, paths))}\nresults: {path}")


def tables(found: dict[str, Any]) -> str:
    """Return the text to print."""
    kind = "SYNTHETIC data" if found["damper"]["data"]["synthetic"] else "measured data"
    lines = [f"The damper by three samplers, {kind}", damper.table(found["damper"]), ""]
    pools = found["cost"]["pools"]
    if pools is not None:
        lines += [
            f"Pools of one worker against a thread: {pools['walkers']} walkers, {pools['log_posteriors']['piece']} "
            f"log-posteriors a message; each {pools['milliseconds']['wall']:.2f} ms by the clock, "
            f"{pools['milliseconds']['processor']:.2f} ms of processor time",
            *(
                f"  {name}: wall time × {ratio['median']:.3f}, processor time × {ratio['processor_time']:.3f}"
                for name, ratio in pools["ratios"].items()
            ),
            "",
        ]
    lines += ["Targets", common.table_of_rows(found["checks"])]
    return "\n".join([*lines, *([f"Note: {found['cost']['note']}."] if found["cost"]["note"] else [])])
