"""How often `bp.missing_terms` finds the term that a model lacks, and how often it finds none where none is missing.

Oscillators, a damper, a pendulum and a self-excited oscillator are recorded, in simulation, with a term that the fitted
model lacks, and without any. ``--replicates N`` records each N times (default 50). Counted is the first term that the
search adds.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from studies import common
from studies.missing_terms.cases import ALTERNATIVE, CASES, ERROR, NONE, OTHER, OUTCOMES, RIGHT, replicate, source

REPLICATES, QUICK, FILE = 50, 2, "replicates.jsonl"
# Wanted shares of data sets in which the true term comes first, and in which a right model is left alone.
FOUND, LEFT_ALONE = 0.9, 0.95
COLOURS = {RIGHT: "#009E73", ALTERNATIVE: "#E69F00", OTHER: "#D55E00", NONE: "0.75", ERROR: "k"}


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, count = common.Stopwatch(), QUICK if options.quick else options.replicates or REPLICATES
    tasks = [(case, number, options.seed) for number in range(count) for case in CASES]
    options.out.mkdir(parents=True, exist_ok=True)
    with watch.part("replicates", f"searches in {len(tasks)} sets of recordings"):
        lines = common.resumed(
            options.out / FILE, tasks, replicate, lambda line: (line["case"], line["number"], line["seed"]), source()
        )
    found = summary(lines)
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, {"shares": draw(found)})
    checks = [_check(case, one) for case, one in found.items()]
    print("\n" + table(found) + "\n\n" + common.table_of_rows(checks) + "\n")
    results = {"replicates": count, "seed": options.seed, "cases": found, "checks": checks}
    common.finish(options.out, results, watch, paths, synthetic=True)


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return by case the missing term, the number of data sets, the shares of outcomes, and what else was found."""
    found: dict[str, Any] = {}
    for case, make in CASES.items():
        own = [line for line in lines if line["case"] == case]
        good = [line for line in own if line["outcome"] != ERROR]
        first = [line["steps"][0] for line in good if line["steps"]]
        wrong = [line["steps"][0]["term"] for line in good if line["outcome"] in (ALTERNATIVE, OTHER)]
        right = [line["steps"][0] for line in good if line["outcome"] == RIGHT]
        found[case] = {
            "missing": make().missing,
            "count": len(own),
            "shares": {name: sum(line["outcome"] == name for line in own) / max(len(own), 1) for name in OUTCOMES},
            "with_alternatives": sum(bool(step["alternatives"]) for step in right),
            "instead": {term: wrong.count(term) for term in dict.fromkeys(wrong)},
            "coefficient": float(np.median([step["coefficient"] for step in right])) if right else None,
            "further_terms": sum(len(line["steps"]) > 1 for line in good),
            "adequate_after": sum(line["steps"][0]["verdict"] == "adequate" for line in good if line["steps"]),
            "steps": len(first),
            "seconds": float(np.median([line["seconds"] for line in good])) if good else None,
            "errors": [line["error"] for line in own if line["outcome"] == ERROR],
        }
    return found


def _check(case: str, one: dict[str, Any]) -> common.Row:
    if one["missing"]:
        return common.row(f"{case}: right term first", one["shares"][RIGHT], FOUND, 1.0)
    return common.row(f"{case}, model is right: no term found", one["shares"][NONE], LEFT_ALONE, 1.0)


def table(found: dict[str, Any]) -> str:
    """Return the text to print."""
    rows = {
        case: {"n": one["count"]}
        | {name: f"{share:.0%}" for name, share in one["shares"].items()}
        | {"instead": ", ".join(f"{term} ({n})" for term, n in one["instead"].items()), "median s": one["seconds"]}
        for case, one in found.items()
    }
    return common.shown("synthetic recordings: first term of the search", rows)


def draw(found: dict[str, Any]) -> Figure:
    """Return the shares of outcomes by case, with the targets."""
    figure, axes = plt.subplots(figsize=(8.0, 4.6), layout="constrained")
    names = list(found)
    place = np.arange(len(names))[::-1]
    left = np.zeros(len(names))
    for outcome in OUTCOMES:
        width = np.array([found[name]["shares"][outcome] for name in names])
        if outcome == ERROR and not width.any():
            continue
        axes.barh(place, width, left=left, height=0.7, color=COLOURS[outcome], label=outcome)
        left += width
    for at, name in zip(place, names, strict=True):
        target = FOUND if found[name]["missing"] else LEFT_ALONE
        axes.plot([target, target], [at - 0.45, at + 0.45], color="k", lw=1.5, label="target" if at == 0 else None)
    axes.set_yticks(place, [name if found[name]["missing"] else f"{name}: model is right" for name in names])
    count = max(one["count"] for one in found.values())
    axes.set(xlim=(0.0, 1.0), xlabel=f"share of {count} synthetic data sets a case")
    axes.set_title("The first term that the search adds")
    common.shared_legend(figure, 6, handlelength=1.2, columnspacing=1.0)
    return figure
