"""Bias and coverage of estimates whose inputs are noisy, taken as exact or with their noise integrated out.

A Duffing oscillator and a Dahl damper are recorded, in simulation, with noise of 1, 3 and 10 % of the input's rms.
``--replicates N`` records each N times (default 200). A z is the deviation of an estimate from the truth in units of
its standard deviation, of logarithms where the parameter is positive.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from studies import common
from studies.noisy_inputs.cases import CASES, COVERED, KINDS, LEVELS, replicate, source

REPLICATES, QUICK, FILE = 200, 4, "replicates.jsonl"
FALSE_ALARM = 0.01


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, count = common.Stopwatch(), QUICK if options.quick else options.replicates or REPLICATES
    tasks = [(c, level, n, options.seed) for n in range(count) for c in CASES for level in LEVELS]
    keys = "case", "level", "number", "seed"
    options.out.mkdir(parents=True, exist_ok=True)
    with watch.part("replicates", f"estimates from {len(tasks)} recordings"):
        lines = common.resumed(
            options.out / FILE, tasks, replicate, lambda line: tuple(line[k] for k in keys), source()
        )
    found = summary(lines)
    # A share of `count` data sets, with the probability of the nominal one to lie outside by chance.
    low, high = stats.binom.interval(1.0 - FALSE_ALARM, count, COVERED)
    band = float(low) / count, float(high) / count
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, {"coverage": draw(found, band)})
    checks = [
        common.row(f"{case}, {level} of the input, measured: 90 % intervals of {name} that contain it", one, *band)
        for case, by_level in found.items()
        for level, by_kind in by_level.items()
        for name, one in by_kind["measured"]["coverage"].items()
    ]
    print("\n" + table(found) + "\n\n" + common.table_of_rows(checks) + "\n")
    results = {"replicates": count, "seed": options.seed, "band": list(band), "cases": found, "checks": checks}
    common.finish(options.out, results, watch, paths, synthetic=True)


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return mean and standard deviation of z, coverage and unexplained variance, by case, level and treatment."""
    found: dict[str, Any] = {}
    for case in CASES:
        for level in LEVELS:
            own = [line for line in lines if line["case"] == case and line["level"] == level]
            for kind in KINDS:
                good = [line[kind] for line in own if "error" not in line[kind]]
                names = list(good[0]["z"]) if good else []
                # Where an estimate has no standard deviation, z is NaN, and the interval does not cover.
                every = {name: np.array([one["z"][name] for one in good]) for name in names}
                z = {name: values[np.isfinite(values)] for name, values in every.items()}
                found.setdefault(case, {}).setdefault(f"{level:.0%}", {})[kind] = {
                    "bias": {name: float(np.mean(values)) for name, values in z.items()},
                    "sd": {name: float(np.std(values)) for name, values in z.items()},
                    "coverage": {n: float(np.mean([one["covered"][n] for one in good])) for n in names},
                    "unexplained": float(np.median([one["unexplained"] for one in good])) if good else None,
                    "without_sd": sum(len(every[name]) - len(z[name]) for name in names),
                    "errors": [line[kind]["error"] for line in own if "error" in line[kind]],
                    "not_converged": sum(one["status"] != "converged" for one in good),
                }
    return found


def table(found: dict[str, Any]) -> str:
    """Return the text to print."""
    rows = {}
    for case, by_level in found.items():
        for level, by_kind in by_level.items():
            for kind, one in by_kind.items():
                rows[f"{case}, {level}, {kind}"] = {
                    name: f"{one['bias'][name]:+.2f} ± {one['sd'][name]:.2f}, {one['coverage'][name]:.1%}"
                    for name in one["coverage"]
                }
    return "\n\n".join(
        common.shown(
            f"{case}, synthetic: mean ± standard deviation of z, coverage of 90 % intervals",
            {key: row for key, row in rows.items() if key.startswith(case)},
        )
        for case in found
    )


def draw(found: dict[str, Any], band: Sequence[float]) -> Figure:
    """Return the coverage of 90 % intervals by the noise of the input."""
    figure, grid = plt.subplots(1, len(found), figsize=(8.0, 3.9), sharey=True, layout="constrained")
    for axes, (case, by_level) in zip(grid, found.items(), strict=True):
        names = list(next(iter(by_level.values()))["measured"]["coverage"])
        for number, name in enumerate(names):
            place = np.arange(len(by_level)) + 0.12 * (number - 0.5 * (len(names) - 1))
            for kind, filled in (("exact", "none"), ("measured", f"C{number}")):
                share = [by_kind[kind]["coverage"][name] for by_kind in by_level.values()]
                label = name if kind == "measured" else None
                axes.plot(place, share, ls="none", marker="o", mec=f"C{number}", mfc=filled, label=label)
        axes.axhspan(*band, color="0.85", zorder=0)
        axes.set(title=f"{case}, synthetic", xlabel="noise of the input [of its rms]", ylim=(0.0, 1.05))
        axes.set_xticks(np.arange(len(by_level)), list(by_level))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=5, frameon=False, handletextpad=0.1)
    grid[0].set_ylabel("coverage of 90 % intervals")
    figure.suptitle("filled: noise of the input integrated out; open: input taken as exact", fontsize="medium")
    return figure
