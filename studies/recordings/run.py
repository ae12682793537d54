"""False alarms of the check of recordings in good ones, and the smallest faults that it finds.

500 good simulated recordings (``--replicates N``) of driven, subharmonic, autonomous and friction oscillators, with
white, coloured, slow or quantised noise, 5 to 300 cycles of 20 to 200 samples, are checked and folded. Then faults of
growing size are put into 50 recordings of 60 cycles.
"""

import argparse
from collections import Counter
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from studies import common
from studies.recordings.cases import FAULTS, SYSTEMS, alarm, power, source

GOOD, FAULTY, QUICK_GOOD, QUICK_FAULTY, FILE = 500, 50, 40, 4, "good.jsonl"
# Largest share of good recordings with a serious finding; share in which a fault is found; bias in standard errors.
ALLOWED, SHARE, BIAS = 0.01, 0.9, 0.5


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    count = QUICK_GOOD if options.quick else options.replicates or GOOD
    options.out.mkdir(parents=True, exist_ok=True)
    tasks = [(number, options.seed) for number in range(count)]
    with watch.part("good", f"checking {count} good recordings"):
        lines = common.resumed(options.out / FILE, tasks, alarm, lambda line: (line["number"], line["seed"]), source())
    alarms = summary(lines)
    each = QUICK_FAULTY if options.quick else FAULTY
    with watch.part("faulty", f"looking for the smallest faults that are found in {SHARE:.0%} of {each} recordings"):
        arguments = [(fault, each, SHARE, BIAS, options.seed) for fault in FAULTS]
        found = dict(zip(FAULTS, common.each(power, arguments, here=options.quick), strict=True))
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, {"power": draw(found)})
    note = "steps of the sizes are 10 to 40 %"
    checks = [
        common.row("good recordings with serious findings, or refused", alarms["serious"], 0.0, ALLOWED),
        common.row("good recordings with warnings", alarms["warned"], 0.0, ALLOWED),
        *(
            common.row(f"{fault}: size found, relative to the biased one", one["found"] / one["biased"], 0.0, 1.0, note)
            for fault, one in found.items()
        ),
        *(
            common.row(f"{fault}: bias where it is not found [stated standard errors]", one["hidden"], 0.0, BIAS)
            for fault, one in found.items()
        ),
    ]  # fmt: skip
    print("\n" + common.shown("good recordings, synthetic", {"all": alarms} | by_system(lines)))
    print("\n" + common.shown(f"smallest faults, synthetic: found in {SHARE:.0%}; biased by {BIAS} sd", found))
    print("\n" + common.table_of_rows(checks) + "\n")
    results = {
        "recordings": count, "seed": options.seed, "false_alarms": alarms, "by_system": by_system(lines),
        "each": each, "faults": found, "checks": checks,
    }  # fmt: skip
    common.finish(options.out, results, watch, paths, synthetic=True)


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Return shares of recordings with serious findings, refusals and warnings, and quantiles of the cycles kept."""
    kept = [line["kept"] for line in lines if not line["refused"]]
    return {
        "serious": float(np.mean([bool(line["kinds"] or line["refused"]) for line in lines])),
        "refused": float(np.mean([bool(line["refused"]) for line in lines])),
        "warned": float(np.mean([bool(line["warnings"]) for line in lines])),
        "kept_1_percent": float(np.quantile(kept, 0.01)) if kept else None,
        "kept_10_percent": float(np.quantile(kept, 0.1)) if kept else None,
        "kept_mean": float(np.mean(kept)) if kept else None,
        "kinds": dict(Counter(kind for line in lines for kind in line["kinds"])),
    }


def by_system(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary of each system."""
    return {s: summary([line for line in lines if line["name"].startswith(s)]) for s in SYSTEMS}


def draw(found: dict[str, dict[str, float]]) -> Figure:
    """Return the sizes that are found relative to those with a bias, and the bias of those that are not found."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), sharey=True, layout="constrained")
    place = np.arange(len(found))
    left.barh(place, [one["found"] / one["biased"] for one in found.values()], color="C0")
    left.axvline(1.0, color="0.3", lw=1.0)
    left.set(
        xscale="log", xlabel=f"size found in {SHARE:.0%}, relative to\nthat with a bias of {BIAS} sd of white noise"
    )
    right.barh(place, [one["hidden"] for one in found.values()], color="C1")
    right.axvline(BIAS, color="0.3", lw=1.0)
    right.set(xlabel="largest mean bias where it is not found\n[stated standard errors]")
    left.set_yticks(place, [fault.split(" [")[0] for fault in found])
    left.invert_yaxis()
    figure.suptitle("synthetic", fontsize="medium")
    return figure
