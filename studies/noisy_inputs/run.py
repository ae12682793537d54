"""Bias and coverage of estimates whose inputs are noisy, taken as exact or with their noise integrated out.

A Duffing oscillator and a Dahl damper are recorded, in simulation, with noise of 1, 3 and 10 % of the input's rms.
``--replicates N`` records each N times (default 200). A z is the deviation of an estimate from the truth in units of
its standard deviation, of logarithms where the parameter is positive.
"""

import argparse
import warnings
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy import stats

import bayesperiodic as bp
from studies import common
from studies.damper import run as damper

LEVELS, KINDS = (0.01, 0.03, 0.1), ("exact", "measured")
REPLICATES, QUICK, FILE = 200, 4, "replicates.jsonl"
COVERED, FALSE_ALARM = 0.9, 0.01
STRIDE = 10_000
DUFFING = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 1.0}
DUFFING_HARMONICS = {1: 2.0, 3: 0.6}
CASES = ("duffing", "damper")

Task = tuple[str, float, int, int]


def duffing(level: float, seed: int) -> tuple[bp.Experiment, dict[str, Any], dict[str, float]]:
    """Return an experiment, free parameters with priors, and the truth."""
    force = _signal(DUFFING_HARMONICS)
    recording = bp.simulate(
        bp.models.duffing, DUFFING, {"force": force}, frequency=0.25, duration=120.0, sampling_rate=10.0,
        noise={"force": level * float(force.std()), "displacement": 0.02}, seed=seed,
    )  # fmt: skip
    priors = {name: bp.LogNormal(value, 1.0) for name, value in DUFFING.items() if name != "m"}
    return recording.fold(256, harmonics={"force": 9}), priors, DUFFING


def dahl(level: float, seed: int) -> tuple[bp.Experiment, dict[str, Any], dict[str, float]]:
    """Return an experiment, free parameters with priors, and the truth."""
    displacement = _signal(damper.SYNTHETIC_SHAPE)
    recording = bp.simulate(
        bp.models.dahl, damper.PUBLISHED, {"displacement": displacement}, frequency=damper.SYNTHETIC_FREQUENCY,
        duration=30.0, sampling_rate=100.0, seed=seed,
        noise={"displacement": level * float(displacement.std()), "force": damper.SYNTHETIC_NOISE["force"]},
    )  # fmt: skip
    return recording.fold(512, harmonics={"displacement": 16}), damper.PRIORS, damper.PUBLISHED


def _signal(harmonics: dict[int, Any]) -> np.ndarray:
    """Return a signal on 64 points from the complex amplitudes of its harmonics."""
    turn = 2j * np.pi * np.arange(64) / 64
    return np.real(sum(amplitude * np.exp(order * turn) for order, amplitude in harmonics.items()))


def replicate(task: Task) -> dict[str, Any]:
    """Return the z, coverage by 90 % intervals and unexplained variance of one recording: case, level, number, seed."""
    case, level, number, seed = task
    line: dict[str, Any] = {"case": case, "level": level, "number": number, "seed": seed, "source": source()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        experiment, priors, truth = (duffing if case == "duffing" else dahl)(level, STRIDE * seed + number)
        model = bp.models.duffing if case == "duffing" else bp.models.dahl
        fixed = {name: value for name, value in truth.items() if name not in priors}
        start = {name: truth[name] for name in priors}
        for kind in KINDS:
            problem = bp.Problem(model, [experiment], priors=priors, fixed=fixed, input_noise=kind)
            try:
                fit = bp.map_estimate(problem, start=start, progress=False)
            except (RuntimeError, ValueError) as error:
                line[kind] = {"error": f"{type(error).__name__}: {error}"}
                continue
            z = {name: _deviation(fit, name, truth[name], priors[name]) for name in priors}
            inside = {n: bool(2 * stats.t.sf(abs(z[n]), fit.degrees_of_freedom[n]) > 1 - COVERED) for n in z}
            line[kind] = {"z": z, "covered": inside, "unexplained": next(iter(fit.fvu.values())), "status": fit.status}
    return line


def _deviation(fit: bp.MapEstimate, name: str, truth: float, prior: Any) -> float:
    value, sd = fit.theta[name], fit.sd[name]
    if isinstance(prior, bp.LogNormal):
        return float(np.log(value / truth) * value / sd)
    return (value - truth) / sd


def source() -> str:
    """Return a key that identifies version and cases of the replicates."""
    return common.source_key(__file__, damper.__file__)


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
                z = {name: np.array([one["z"][name] for one in good]) for name in names}
                found.setdefault(case, {}).setdefault(f"{level:.0%}", {})[kind] = {
                    "bias": {name: float(np.mean(values)) for name, values in z.items()},
                    "sd": {name: float(np.std(values)) for name, values in z.items()},
                    "coverage": {n: float(np.mean([one["covered"][n] for one in good])) for n in names},
                    "unexplained": float(np.median([one["unexplained"] for one in good])) if good else None,
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
    figure, grid = plt.subplots(1, len(found), figsize=(8.0, 3.4), sharey=True, layout="constrained")
    for axes, (case, by_level) in zip(grid, found.items(), strict=True):
        names = list(next(iter(by_level.values()))["measured"]["coverage"])
        for number, name in enumerate(names):
            place = np.arange(len(by_level)) + 0.12 * (number - 0.5 * (len(names) - 1))
            for kind, filled in (("exact", "none"), ("measured", f"C{number}")):
                share = [by_kind[kind]["coverage"][name] for by_kind in by_level.values()]
                label = f"{name}" if kind == "measured" else None
                axes.plot(place, share, ls="none", marker="o", mec=f"C{number}", mfc=filled, label=label)
        axes.axhspan(*band, color="0.85", zorder=0)
        axes.set(title=f"{case}, synthetic", xlabel="noise of the input [of its rms]", ylim=(0.0, 1.05))
        axes.set_xticks(np.arange(len(by_level)), list(by_level))
        axes.legend(loc="lower left", frameon=False, title="filled: noise integrated out\nopen: taken as exact")
    grid[0].set_ylabel("coverage of 90 % intervals")
    return figure
