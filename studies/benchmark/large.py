"""Time and memory of folding a long recording, and of the orbit search in a section of many points.

Synthetic: a noisy sum of two harmonics, and the Hénon map with noise. Each size is a process of its own, after a run of
the smallest size that compiles what is needed, and imports no more than that: its memory is measured.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import bayesperiodic as bp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SAMPLES, POINTS = (10_000, 100_000, 1_000_000, 5_000_000), (10_000, 100_000, 500_000, 1_000_000)
QUICK = 2
# Targets: seconds and gigabytes of the named size.
FOLD_TARGET, ORBIT_TARGET = (5_000_000, 10.0, 0.6), (500_000, 300.0, 4.0)  # size, s, GB
SAMPLING_RATE, FREQUENCY, NOISE = 1000.0, 1.2345, 0.1
SCATTER, PERIODS = 1e-3, range(1, 7)


def fold(size: int) -> bp.Experiment:
    """Fold a recording of so many samples."""
    return recording_of(size).fold(128, frequency=FREQUENCY)


def recording_of(size: int) -> bp.Recording:
    """Return a recording of a force and a response."""
    generator = np.random.default_rng(0)
    time = np.arange(size) / SAMPLING_RATE
    force = np.cos(2 * np.pi * FREQUENCY * time)
    values = force + 0.3 * np.cos(4 * np.pi * FREQUENCY * time + 1.0) + NOISE * generator.standard_normal(size)
    return bp.Recording.from_arrays(time, {"y": values}, {"u": force})


def orbits(size: int) -> bp.Orbits:
    """Find orbits of the Hénon map in so many points."""
    points, x, y = np.empty((size + 100, 2)), 0.1, 0.1
    for k in range(len(points)):
        x, y = 1.0 - 1.4 * x * x + y, 0.3 * x
        points[k] = x, y
    points = points[100:] + SCATTER * np.random.default_rng(0).standard_normal((size, 2))
    section = bp.PoincareSection.from_points(points, ("x", "y"), frequency=1.0)
    return bp.find_orbits(section, periods=PERIODS)


ONE = """
import json, sys, time, warnings
from studies.benchmark import large
warnings.simplefilter("ignore")
large.{what}(large.SAMPLES[0])
begin = time.perf_counter()
large.{what}({size})
print(json.dumps({{"s": time.perf_counter() - begin, "GB": 1e-3 * large.peak()}}))
"""


def peak() -> float:
    """Return the peak memory of this process [MB], NaN if the system does not report it.

    A process started from a large one inherits its ``ru_maxrss``.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.is_file() else []
    return next((float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), float("nan"))


def measure(python: Path | str = sys.executable, *, quick: bool = False) -> dict[str, Any]:
    """Return seconds, peak memory [GB] and growth exponents by size."""
    return {
        what: _sizes(python, what, sizes[: QUICK if quick else None])
        for what, sizes in {"fold": SAMPLES, "orbits": POINTS}.items()
    }


def _sizes(python: Path | str, what: str, sizes: Sequence[int]) -> dict[str, Any]:
    from studies.timing import slope

    rows = []
    for size in sizes:
        code = ONE.format(what=what, size=size)
        done = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
    seconds = [row["s"] for row in rows]
    return {"sizes": list(sizes), "s": seconds, "GB": [row["GB"] for row in rows], "exponent": slope(sizes, seconds)}


def draw(found: dict[str, Any]) -> Figure:
    """Return time and memory over size, with what is linear, and the targets."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8.0, 4.0), layout="constrained")
    names = {"fold": ("samples", FOLD_TARGET, "o", "#0072B2"), "orbits": ("points", ORBIT_TARGET, "s", "#D55E00")}
    for what, (unit, (size, seconds, gigabytes), marker, colour) in names.items():
        own = found[what]
        label = f"folding, {unit}" if what == "fold" else f"orbits of periods 1 to 6, {unit} of the section"
        for ax, key, limit in zip(axes, ("s", "GB"), (seconds, gigabytes), strict=True):
            ax.loglog(own["sizes"], own[key], marker + "-", color=colour, label=label)
            ax.plot([size], [limit], marker, mfc="none", ms=10, color=colour, label=f"target, {size:,}")
        start = own["s"][-1] / own["sizes"][-1]
        axes[0].loglog(own["sizes"], [start * n for n in own["sizes"]], ":", lw=0.8, color=colour)
    axes[0].set(xlabel="size", ylabel="time [s]", title="Time (dotted: proportional to size)")
    axes[1].set(xlabel="size", ylabel="peak memory [GB]", title="Memory of the process")
    axes[1].set_yticks(ticks := [0.3, 0.5, 1.0, 2.0, 4.0], [f"{tick:g}" for tick in ticks])
    axes[1].minorticks_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle("Folding a recording, and finding orbits in a section (synthetic data)", fontsize="medium")
    return figure
