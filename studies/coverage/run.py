"""Coverage of 90 % intervals by Laplace, robust and by draws, where model, noise or bounds are not ideal.

``--replicates N`` makes N data sets of each case (default 200); the first half of them is sampled too.
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from studies import common
from studies.coverage import cases
from studies.coverage.repeats import SDS, repeats

# One in SAMPLED data sets is sampled, which takes most of the time.
REPLICATES, QUICK, SAMPLED, FALSE_ALARM = 200, 2, 2, 0.01
KINDS = {cases.LAPLACE: "Laplace", cases.ROBUST: "robust", cases.DRAWS: "draws"}
Counts = Mapping[str, Mapping[str, Any]]


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, count = common.Stopwatch(), QUICK if options.quick else options.replicates or REPLICATES
    sampled = -(-count // SAMPLED)
    tasks = cases.tasks(count, sampled, options.seed)
    with watch.part("data sets", f"intervals in {len(tasks)} tasks"):
        lines = common.resumed(
            options.out / "parts" / "data_sets.jsonl",
            tasks,
            cases.replicate,
            lambda line: (line["case"], line["kind"], line["number"], line["seed"]),
            cases.source(),
        )
    found = summary(lines)
    numbers = {kind: sampled if kind == cases.DRAWS else count for kind in KINDS}
    bands = {kind: band(number) for kind, number in numbers.items()}
    with watch.part("repeats", "repeated tests of a friction damper"):
        repeated = None if options.quick else repeats()
    with watch.part("figure", "drawing"):
        paths = common.save_figures(options.out, {"coverage": draw(found, bands)})
    print("\n" + table(found, bands) + "\n\n" + "\n".join(page_rows(found, bands)) + "\n")
    if repeated:
        print("repeated tests: " + ", ".join(f"{repeated[k]['far']} of {repeated[k]['of']} far by {k}" for k in SDS))
    results = {"seed": options.seed, "data_sets": numbers, "bands": bands, "cases": found, "repeats": repeated}
    common.finish(options.out, results, watch, paths, synthetic=True)


def band(count: int) -> list[float]:
    """Return the shares of `count` data sets between which right intervals cover, but for false alarms."""
    return [float(end) / count for end in stats.binom.interval(1.0 - FALSE_ALARM, count, cases.COVERED)]


def summary(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the share of intervals that contain the truth, by case, parameter and kind of interval."""
    found: dict[str, Any] = {}
    for name in cases.CASES:
        own = [line for line in lines if line["case"] == name]
        good = [line for line in own if "error" not in line]
        names = {q: None for line in good for each in line["covered"].values() for q in each}
        covered = {
            q: {kind: _share([line["covered"][kind][q] for line in good if kind in line["covered"]]) for kind in KINDS}
            for q in names
        }
        found[name] = {
            "covered": covered,
            "misspecified": _share([line["misspecified"] for line in good if cases.LAPLACE in line["covered"]]),
            "errors": [line["error"] for line in own if "error" in line],
        }
    return found


def _share(values: Sequence[bool]) -> float:
    return float(np.mean(values)) if values else np.nan


def rows(found: Counts) -> list[tuple[str, str, Mapping[str, float]]]:
    """Return case, parameter and coverage by kind of interval."""
    return [(name, q, shares) for name, one in found.items() for q, shares in one["covered"].items()]


def table(found: Counts, bands: Mapping[str, Sequence[float]]) -> str:
    """Return the text to print; a star marks what is outside the band."""
    shown = {}
    for name, q, shares in rows(found):
        marks = {kind: "" if bands[kind][0] <= share <= bands[kind][1] else " *" for kind, share in shares.items()}
        shown[f"{name}: {q}"] = {KINDS[kind]: f"{share:.1%}{marks[kind]}" for kind, share in shares.items()} | {
            "misspecified": f"{found[name]['misspecified']:.1%}",
            "errors": len(found[name]["errors"]),
        }
    limits = ", ".join(f"{KINDS[kind]} {low:.1%} to {high:.1%}" for kind, (low, high) in bands.items())
    title = f"synthetic: coverage of 90 % intervals; * outside the 99 % band ({limits})"
    return common.shown(title, shown)


def page_rows(found: Counts, bands: Mapping[str, Sequence[float]]) -> list[str]:
    """Return the rows of the table of the page, in percent, with what is outside of the band in bold."""
    lines = []
    for name, q, shares in rows(found):
        texts = [f"{100 * shares[kind]:.0f}" for kind in KINDS]
        marked = [
            text if bands[kind][0] <= shares[kind] <= bands[kind][1] else f"**{text}**"
            for kind, text in zip(KINDS, texts, strict=True)
        ]
        lines.append(f"| {name} | {q} | {' | '.join(marked)} |")
    return lines


def draw(found: Counts, bands: Mapping[str, Sequence[float]]) -> Figure:
    """Return the coverage of each parameter of each case, with the bands."""
    each = rows(found)
    figure, axes = plt.subplots(figsize=(7.0, 0.22 * len(each) + 1.2), layout="constrained")
    height = np.arange(len(each))[::-1]
    axes.axvspan(*bands[cases.DRAWS], color="0.93", zorder=0)
    axes.axvspan(*bands[cases.LAPLACE], color="0.85", zorder=0)
    axes.axvline(cases.COVERED, color="0.6", lw=0.8, zorder=0)
    for (kind, label), marker, colour in zip(KINDS.items(), ("o", "x", "+"), ("C0", "C3", "k"), strict=True):
        axes.plot([shares[kind] for *_, shares in each], height, ls="none", marker=marker, color=colour, label=label)
    axes.set_yticks(height, [f"{name}: {q}" for name, q, _ in each])
    axes.set(xlabel="coverage of 90 % intervals", title="synthetic data")
    axes.legend(frameon=False, loc="lower left")
    return figure
