"""Tables of nonlinear resonances: what amplitudes tell without phases, and the averaged equation beside.

``--replicates N`` makes N tables of each kind and system (default 200). A z is the deviation of an estimate from the
truth in units of its standard deviation.
"""

import argparse
import warnings
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy import stats

import bayesperiodic as bp
from studies import common
from studies.resonance import systems

REPLICATES, QUICK, FALSE_ALARM, COVERED = 200, 2, 0.01, 0.90
NINETY = float(stats.norm.ppf(0.95))


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, count = common.Stopwatch(), QUICK if options.quick else options.replicates or REPLICATES
    names = ["duffing"] if options.quick else [*systems.SYSTEMS]
    cases = [(name, kind) for name in names for kind in systems.KINDS] + [("duffing", systems.AVERAGED)]
    tasks = [(name, kind, number, options.seed) for name, kind in cases for number in range(count)]
    with watch.part("estimates", f"estimates from {len(tasks)} sets of tables"):
        lines = common.resumed(
            options.out / "parts" / "estimates.jsonl", tasks, systems.replicate,
            lambda line: (line["system"], line["kind"], line["number"], line["seed"]),
            common.source_key(systems.__file__),
        )  # fmt: skip
    with watch.part("speed", "densities of a table, and of the same data as harmonics with free delays"):
        speed = systems.speed(options.seed)
    found = {f"{name}: {kind}": summary(lines, name, kind) for name, kind in cases}
    low, high = stats.binom.interval(1.0 - FALSE_ALARM, count, COVERED)
    band = float(low) / count, float(high) / count
    checks = [
        common.row(f"{case}: 90 % intervals of {p} that contain it", share, *band)
        for case, of_case in found.items()
        if systems.AVERAGED not in case
        for p, share in of_case["coverage"].items()
    ]
    faster = "64 densities: time as harmonics with free delays over that as a table"
    checks.append(common.row(faster, speed["ratio"], 5.0, None))
    print("\n" + common.table_of_rows(checks) + "\n\n" + common.shown("by kind of data", _flat(found)))
    with watch.part("figures", "drawing"):
        figures = {"kinds": draw(found)} | {name.replace(" ", "_"): _response(name, options.seed) for name in names}
        paths = common.save_figures(options.out, figures)
    results = {"replicates": count, "seed": options.seed, "band": list(band), "checks": checks, "speed": speed} | found
    common.finish(options.out, results, watch, paths, synthetic=True)


def summary(lines: list[dict[str, Any]], name: str, kind: str) -> dict[str, Any]:
    """Return coverage, bias, spread and contraction of each parameter over the replicates of a case."""
    of_case = [line for line in lines if (line["system"], line["kind"]) == (name, kind)]
    names = [*systems.SYSTEMS[name].truth]
    z = {p: np.array([line["z"][p] for line in of_case]) for p in names}
    return {
        "converged": float(np.mean([line["status"] == "converged" for line in of_case])),
        "coverage": {p: float(np.mean(np.abs(values) < NINETY)) for p, values in z.items()},
        "bias": {p: float(values.mean()) for p, values in z.items()},
        "rms of z": {p: float(np.sqrt(np.mean(values**2))) for p, values in z.items()},
        "sd over that of the prior": {p: float(np.median([line["contraction"][p] for line in of_case])) for p in names},
        "seconds": float(np.median([line["seconds"] for line in of_case])),
    }


def _flat(found: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return coverage and bias of every parameter by case."""
    return {
        f"{case}, {p}": {"coverage": share, "bias [sd]": of_case["bias"][p], "rms of z": of_case["rms of z"][p]}
        for case, of_case in found.items()
        for p, share in of_case["coverage"].items()
    }


def draw(found: dict[str, dict[str, Any]]) -> Figure:
    """Draw coverage and remaining standard deviations of all cases."""
    figure = plt.figure(figsize=(9.0, 0.5 * len(found) + 2.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for place, of_case in enumerate(found.values()):
        for axes, quantity in ((left, "coverage"), (right, "sd over that of the prior")):
            for p, value in of_case[quantity].items():
                axes.plot(value, place, ".", color="black")
                axes.annotate(p, (value, place), xytext=(0, 4), textcoords="offset points", ha="center", fontsize=7)
    left.axvline(COVERED, lw=0.8, ls=":", color="black")
    left.set_xlabel("share of 90 % intervals that contain the truth")
    right.set_xlabel("standard deviation over that of the prior")
    right.set_xscale("log")
    left.set_yticks(range(len(found)), [*found])
    left.set_ylim(-0.6, len(found) - 0.4)
    left.invert_yaxis()
    return figure


def _response(name: str, seed: int) -> Figure:
    problem = systems.problem(name, systems.BOTH, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = bp.map_estimate(problem, checks=False, progress=False, starts=1)
    return common.titled(bp.plot.response(problem, fit), f"{name}, synthetic tables of amplitudes")
