"""Time of a log-posterior and of a posterior, compared with time integration, other packages and linear algebra.

A method is timed only if it is accurate: |Δ log-posterior| ≤ 0.01 at draws of the posterior and at three times their
spread, against fully converged shooting with small steps; each with its cheapest step count or tolerance. Ratios are
of interleaved times in one run, with linear algebra in one thread. Folded recordings with cut harmonics, the usual
case, have rows of their own. An unstable period-3 orbit of the pendulum shows that time integration leaves it.
"""

import argparse
import json
import os
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_limits

import bayesperiodic as bp
from studies import common
from studies.benchmark import cold_start, contenders, peers, posteriors, scaling, targets
from studies.benchmark import floor as floors
from studies.benchmark import problems as made
from studies.benchmark.integration import PREDICTED, SHOOTING, refer
from studies.benchmark.kernels import NUMPY, FirstOrder
from studies.benchmark.problems import Setting
from studies.pendulum.orbits import distance, shoot
from studies.pendulum.recording import FREQUENCY, OMEGA, QUICK_PERIODS, TRUTH, section_of, simulate

# Results that the guard compares with.
KEPT = Path("figures/benchmark/results.json")
# Folder for the results of each problem until the study ends.
PARTS = "parts"
PERIOD, SAMPLES = 3, 800
ORBITS, TOLERANCE = 12, 1e-12
# Distance at which the orbit counts as left [rad], with 5 rad/s counted as 1 rad.
LEFT = 0.1
SIZE, HEIGHTS, MARKERS = (14.0, 8.4), [3.0, 1.0], "osD^vP*X"
# Those of Okabe and Ito, then greys.
COLOURS = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "0.5", "0.8", "0.2"


@threadpool_limits.wrap(limits=1, user_api="blas")
def run(options: argparse.Namespace) -> None:
    """Run the study, or with ``--cold-start`` measure first results in new environments."""
    if options.cold_start:
        cold_start.run(options)
        return
    before = read_kept(KEPT) if options.guard else None
    watch, kept = common.Stopwatch(), options.out / PARTS
    found: dict[str, Any] = {"seed": options.seed, "quick": options.quick, "cores": os.cpu_count()}
    found["load_average"] = [*os.getloadavg()] if hasattr(os, "getloadavg") else None
    found |= {"problems": {}, "floor": {}}
    for name, make in folded(options).items():
        with watch.part(name, f"{name}: log-posterior, gradient and batch over the floor"):
            found["floor"][name] = floors.measure_folded(make(), 5 if options.quick else 31)
        print(targets.floor(name, found["floor"][name]), flush=True)
    for number, (name, make) in enumerate(problems(options).items()):
        with watch.part(name, f"{name}: all methods"):
            work = partial(_of_problem, name, make, options)
            one = common.remembered(kept / f"{number}.pkl", _source(options, name), work)
        found["problems"][name] = one["contest"]
        print(targets.problem(name, one["contest"]), flush=True)
        if "posterior" in one:
            found["posterior"] = one["posterior"]
            print(targets.posterior(one["posterior"]), flush=True)
        if "floor" in one:
            found["floor"][name] = one["floor"]
            print(targets.floor(name, one["floor"]), flush=True)
    if not options.quick:
        with watch.part("pendulum", "an unstable orbit of the pendulum, by time integration"):
            found["pendulum"] = measure(options.seed)
        print(account(found["pendulum"]), flush=True)
        with watch.part("scaling", "growth of time and memory"):
            found["scaling"] = scaling.measure(options.seed)
        print(scaling.account(found["scaling"]), flush=True)
    found["checks"] = targets.rows(found)
    print("\nTargets\n" + common.table_of_rows(found["checks"]) + "\n")
    with watch.part("figure", "drawing"):
        paths = common.save_figures(options.out, {"benchmark": draw(found)})
    common.finish(options.out, found, watch, paths, synthetic=False)
    shutil.rmtree(kept, ignore_errors=True)
    if before is not None:
        guard(found, before)


def _of_problem(name: str, make: Callable[[], Setting], options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of one problem, and the measurements made on this problem only.

    A quick run omits other packages and SciPy's integrators.
    """
    setting, quick = make(), options.quick
    result: dict[str, Any] = {}
    if name.startswith("landing gear"):
        result["floor"] = floors.measure(setting, 5 if quick else 31)  # before other packages start their threads
    contest = contenders.Contest(refer(setting))
    scheme = contenders.add_own(contest)
    contenders.add_compiled(contest)
    peers.add_scipy(contest, quick=quick)
    if not quick:
        peers.add_peers(contest)
    result["contest"] = contenders.measured(contest, scheme, 3 if quick else 15)
    if name == made.DUFFING and not quick:
        methods = contest.compiled[SHOOTING, PREDICTED]
        result["posterior"] = posteriors.measure(setting, result["contest"], methods, options.seed)
    return result


def _source(options: argparse.Namespace, name: str) -> str:
    key = common.source_key(*map(str, sorted(Path(__file__).parent.glob("*.py"))))
    return f"{key} {name} {options.seed} {options.quick} {options.guard}"


def read_kept(path: Path) -> dict[str, Any]:
    """Return the kept results for the guard."""
    if not path.is_file():
        raise FileNotFoundError(f"--guard: {path} does not exist; run the study with --publish first.")
    return json.loads(path.read_text(encoding="utf-8"))


def guard(found: dict[str, Any], before: dict[str, Any]) -> None:
    """Compare ratios, never seconds, with those kept; raise a RuntimeError if any is worse."""
    lines = targets.worse(found, before)
    print(f"guard: {len(targets.pairs(found, before))} ratios compared, tolerance {targets.TOLERANCE:g}")
    if lines:
        raise RuntimeError("ratios are worse than the kept ones:\n" + "\n".join(lines))


def problems(options: argparse.Namespace) -> dict[str, Callable[[], Setting]]:
    """Return the functions that make the problems, by name; a quick run takes the first three.

    The guard uses the draws of the full run, because the time of a method depends on them.
    """
    count, seed = (2, options.seed) if options.quick and not options.guard else (5, options.seed)
    every: dict[str, Callable[[], Setting]] = {
        made.FORCE: lambda: made.gear("force", count, seed),
        made.DISPLACEMENT: lambda: made.gear("displacement", count, seed),
        made.DUFFING: lambda: made.duffing(count, seed),
        made.DAMPER: lambda: made.damped(options.data, count, seed),
        made.SILVERBOX: lambda: made.silverbox(None, count, seed),
    }
    return dict(list(every.items())[: 3 if options.quick else None])


def folded(options: argparse.Namespace) -> dict[str, Callable[[], Setting]]:
    """Return the functions that make the problems with folded recordings and cut harmonics, by name."""
    return {
        made.FORCE + made.FOLDED: lambda: made.gear("force", 5, options.seed, cut=True),
        made.DUFFING + made.FOLDED: lambda: made.duffing(5, options.seed, cut=True),
    }


def measure(seed: int) -> dict[str, Any]:
    """Return the orbit's multiplier and the distance of the integration from it after each period (SYNTHETIC)."""
    found = bp.find_orbits(section_of(simulate(QUICK_PERIODS, seed)), periods=[PERIOD])
    polished = bp.polish_orbits(bp.models.pendulum, found, TRUTH, samples=SAMPLES)
    orbit = next(one for one in polished if one.period == PERIOD and not one.equilibrium)
    shot = shoot(TRUTH, OMEGA, orbit.points)
    if not shot.converged or orbit.solution is None:
        raise RuntimeError("The period-3 orbit of the pendulum is not confirmed by shooting.")
    off = distances(shot.points[0])
    left = next((k + 1 for k, d in enumerate(off) if d > LEFT), None)
    return {
        "synthetic": True,
        "status": orbit.solution.status,
        "multipliers": orbit.solution.multipliers.real.tolist(),
        "multipliers_by_shooting": shot.multipliers.real.tolist(),
        "distances": off,
        "left_after_periods": left,
    }


def distances(start: np.ndarray) -> list[float]:
    """Return the distance of the integration from its start after each of the orbit's periods, angles modulo a turn."""
    model = bp.models.pendulum
    rates, p = FirstOrder(model, ()), np.array([*(TRUTH[name] for name in model.parameters), FREQUENCY])
    function = rates.function(NUMPY, rates.rates)

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        out = np.empty(2)
        function(y, [t * FREQUENCY], p, out)
        return out

    at = PERIOD / FREQUENCY * np.arange(1, ORBITS + 1)
    path = solve_ivp(slope, (0.0, at[-1]), start, "DOP853", at, rtol=TOLERANCE, atol=TOLERANCE).y
    return [distance(point[None], start[None]) for point in path.T]


def account(found: dict[str, Any]) -> str:
    """Return the text to print."""
    steps = ", ".join(f"{d:.0e}" for d in found["distances"])
    largest = max(map(abs, found["multipliers"]))
    return (
        f"  period-3 orbit (SYNTHETIC), multiplier {largest:.4g}: this package {found['status']}; DOP853 at 1e-12, "
        f"started on the orbit, deviates by {steps} rad after each period; it leaves the orbit after "
        f"{found['left_after_periods']} periods"
    )


def draw(found: Mapping[str, Any]) -> Figure:
    """Return the figure: methods relative to one warm log-posterior, and its stages relative to the floor."""
    with plt.style.context("bayesperiodic.plot.figures"):
        figure = Figure(SIZE, layout="constrained")
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.0, 1.0])[0]
        if found["problems"]:
            _contenders(left.subplots(), found["problems"])
        drawn = [part for part in ("posterior", "floor") if found.get(part)]
        rows: Any = right.subplots(max(len(drawn), 1), 1, squeeze=False, height_ratios=HEIGHTS[: max(len(drawn), 1)])
        places = dict(zip(drawn, rows[:, 0], strict=False))
        if made.FORCE in found["floor"]:
            _floor(places["floor"], found["floor"][made.FORCE])
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
        bars = [x[0] - x[1], x[2] - x[0]]
        ax.errorbar(x[0], y, xerr=bars, fmt=marker, markersize=5, mec="black", mew=0.5, label=f"{problem}{kind}")
    ax.axvline(1.0, color="0.6", linewidth=1.0, zorder=0)
    ax.set(xscale="log", xlabel="time / one warm log-posterior of this package")
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.grid(axis="x", alpha=0.3)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=2)
    ax.set_title("Time of one log-posterior at equal accuracy,\nrelative to this package (median, range)")


def _floor(ax: Axes, found: Mapping[str, Any]) -> None:
    bars: dict[str, dict[str, float]] = {}
    for scheme, entry in found["schemes"].items():
        bars[f"floor, {scheme}"] = {k: v["median"] for k, v in entry["floor_us"].items() if k != "sum"}
        bars[f"warm, {scheme}"] = dict(entry["stages_us"])
        bars[f"64 walkers, {scheme}"] = {
            "batched, all stages": entry["us"]["batched"]["median"], "emcee itself": found["emcee_us"]["median"]
        }  # fmt: skip
    parts = list(dict.fromkeys(part for bar in bars.values() for part in bar))
    rows, left = range(len(bars)), np.zeros(len(bars))
    for part, colour in zip(sorted(parts, key=lambda p: p in floors.STAGES), COLOURS, strict=False):
        width = np.array([max(bar.get(part, 0.0), 0.0) for bar in bars.values()])
        ax.barh(rows, width, left=left, label=part, color=colour, edgecolor="black", linewidth=0.4)
        left += width
    ax.set_yticks(rows, list(bars))
    ax.invert_yaxis()
    ax.set(xlabel="time of one log-posterior [µs]", title=f"Where the time goes ({made.FORCE})")
    ax.legend(loc="upper center", bbox_to_anchor=(0.2, -0.3), ncols=3)


def _posterior(ax: Axes, found: Mapping[str, Any]) -> None:
    values = {name: e["ess_per_second"] for name, e in found["samplers"].items() if "ess_per_second" in e}
    values |= {f"emcee, {name}": entry["ess_per_second"] for name, entry in found["emcee_around"].items()}
    names = sorted(values, key=lambda name: values[name])
    own = [name.startswith("sample") for name in names]
    colours = [bp.plot.COLOURS["map"] if one else "0.75" for one in own]
    ax.barh(range(len(names)), [values[name] for name in names], color=colours, edgecolor="black", linewidth=0.4)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set(
        xscale="log",
        xlabel="effective samples per second [1/s]",
        title="Sampling rate, Duffing (synthetic)\n(blue: this package)",
    )
