"""Figure of the benchmark."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.benchmark.floor import STAGES
from studies.benchmark.problems import FORCE

SIZE = (18.0, 10.0)
MARKERS = "osD^vP*X"
COLOURS = [colormaps["tab20"](k) for k in range(20)]


def draw(found: Mapping[str, Any]) -> Figure:
    """Return the figure: methods relative to one warm log-posterior, and its stages relative to the floor."""
    figure = Figure(SIZE, layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.15, 1.0])[0]
    if found["problems"]:
        _contenders(left.subplots(), found["problems"])
    drawn = [part for part in ("floor", "posterior") if found.get(part)]
    places = dict(zip(drawn, right.subplots(max(len(drawn), 1), 1, squeeze=False)[:, 0], strict=False))
    if FORCE in found["floor"]:
        _floor(places["floor"], found["floor"][FORCE])
    if "posterior" in places:
        _posterior(places["posterior"], found["posterior"])
    return figure


def _contenders(ax: Axes, problems: Mapping[str, Any]) -> None:
    timed = {problem: [e for e in found["rows"] if e["ratio"]] for problem, found in problems.items()}
    names = list(dict.fromkeys(e["name"] for entries in timed.values() for e in entries))
    for marker, (problem, entries) in zip(MARKERS, timed.items(), strict=False):
        if not entries:
            continue
        y = [names.index(e["name"]) for e in entries]
        x = np.array([[e["ratio"][key] for key in ("median", "least", "largest")] for e in entries]).T
        kind = " (synthetic)" if problems[problem]["synthetic"] else ""
        ax.errorbar(x[0], y, xerr=[x[0] - x[1], x[2] - x[0]], fmt=marker, markersize=5, label=f"{problem}{kind}")
    ax.axvline(1.0, color="0.6", linewidth=1.0, zorder=0)
    ax.set(xscale="log", xlabel="time / one warm log-posterior of this package [1]")
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.invert_yaxis()
    ax.grid(axis="x", alpha=0.3)
    ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=2)
    ax.set_title("One log-posterior at equal accuracy: median and range over the repeats")


def _floor(ax: Axes, found: Mapping[str, Any]) -> None:
    bars: dict[str, dict[str, float]] = {}
    for scheme, entry in found["schemes"].items():
        bars[f"floor\n{scheme}"] = {k: v["median"] for k, v in entry["floor_us"].items() if k != "sum"}
        bars[f"warm\n{scheme}"] = dict(entry["stages_us"])
        bars[f"64 walkers\n{scheme}"] = {
            "batched, all stages": entry["us"]["batched"]["median"], "emcee itself": found["emcee_us"]["median"]
        }  # fmt: skip
    parts = list(dict.fromkeys(part for bar in bars.values() for part in bar))
    below = np.zeros(len(bars))
    for part, colour in zip(sorted(parts, key=lambda p: p in STAGES), COLOURS, strict=False):
        height = np.array([max(bar.get(part, 0.0), 0.0) for bar in bars.values()])
        ax.bar(range(len(bars)), height, bottom=below, label=part, color=colour)
        below += height
    ax.set_xticks(range(len(bars)), list(bars), fontsize=8)
    ax.set(ylabel="time of one log-posterior [µs]", title=f"{FORCE}: stages")
    ax.set_ylim(0.0, 1.05 * below.max())
    ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _posterior(ax: Axes, found: Mapping[str, Any]) -> None:
    values = {name: e["ess_per_second"] for name, e in found["samplers"].items() if "ess_per_second" in e}
    values |= {f"emcee, {name}": entry["ess_per_second"] for name, entry in found["emcee_around"].items()}
    names = sorted(values, key=lambda name: values[name])
    ax.barh(range(len(names)), [values[name] for name in names])
    ax.set_yticks(range(len(names)), names, fontsize=6)
    ax.set(xscale="log", xlabel="effective samples per second [1/s]", title="Duffing (synthetic): posterior")
