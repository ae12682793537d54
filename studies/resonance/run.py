"""Tables, jumps and resonance points of nonlinear resonances: what they determine, and whether the intervals cover.

``--replicates N`` makes N sets of data of each kind (default 25), of Duffing oscillators drawn from the prior. A z is
the deviation of an estimate from the truth in units of its standard deviation.
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
from studies.resonance import calibration, systems

REPLICATES, QUICK, FALSE_ALARM, COVERED = 25, 2, 0.01, 0.90
NINETY = float(stats.norm.ppf(0.95))
SAMPLED, LAPLACE, LEFT = "posterior", "Laplace approximation", "sd over that of the prior"


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, count = common.Stopwatch(), QUICK if options.quick else options.replicates or REPLICATES
    tasks = [(kind, number, options.seed) for number in range(count) for kind in calibration.KINDS]
    with watch.part("posteriors", f"posteriors of {len(tasks)} sets of data"):
        lines = common.resumed(
            options.out / "parts" / "posteriors.jsonl", tasks, calibration.replicate,
            lambda line: (line["kind"], line["number"], line["seed"]),
            calibration.source(),
        )  # fmt: skip
    with watch.part("speed", "densities of a table, and of the same data as harmonics with free delays"):
        speed = systems.speed(options.seed)
    found = {kind: summary([line for line in lines if line["kind"] == kind]) for kind in calibration.KINDS}
    averaged = {p: [line["averaged"][p] for line in lines if line["averaged"]] for p in calibration.PRIORS}
    low, high = stats.binom.interval(1.0 - FALSE_ALARM, count, COVERED)
    band = float(low) / count, float(high) / count
    checks = [
        common.row(f"{kind}: 90 % intervals of {p} that contain it", share, *band)
        for kind, of_kind in found.items()
        for p, share in of_kind[SAMPLED].items()
    ]
    faster = "64 densities: time as harmonics with free delays over that as a table"
    checks.append(common.row(faster, speed["ratio"], 5.0, None))
    closed = {p: z_summary(np.array(z)) for p, z in averaged.items()}
    print("\n" + common.table_of_rows(checks) + "\n\n" + common.shown("by kind of data", _flat(found)))
    print("\n" + common.shown("averaged equation, amplitudes", closed))
    with watch.part("figures", "drawing"):
        names = ["duffing"] if options.quick else [*systems.SYSTEMS]
        figures = {"kinds": draw(found, band)}
        figures |= {name.replace(" ", "_"): _response(name, options.seed) for name in names}
        paths = common.save_figures(options.out, figures)
    results = {"replicates": count, "seed": options.seed, "band": list(band), "checks": checks, "speed": speed}
    common.finish(options.out, results | {"averaged equation": closed} | found, watch, paths, synthetic=True)


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage of posteriors and Laplace approximations, z, and what is left of the priors' sd, of one kind."""
    ranks = {p: np.array([line["rank"][p] for line in lines]) for p in calibration.PRIORS}
    z = {p: z_summary(np.array([line["z"][p] for line in lines])) for p in calibration.PRIORS}
    return {
        "converged": float(np.mean([line["status"] == "converged" for line in lines])),
        "near a fold": float(np.mean([line["warned"] for line in lines])),
        "least effective number": float(min(line["effective"] for line in lines)),
        SAMPLED: {p: float(np.mean(np.abs(rank - 0.5) < 0.5 * COVERED)) for p, rank in ranks.items()},
        LAPLACE: {p: of_p["coverage"] for p, of_p in z.items()},
        "rms of z": {p: of_p["rms of z"] for p, of_p in z.items()},
        "median of z": {p: of_p["median of z"] for p, of_p in z.items()},
        LEFT: {p: float(np.median([line["contraction"][p] for line in lines])) for p in calibration.PRIORS},
        "seconds": float(np.median([line["seconds"] for line in lines])),
    }


def z_summary(z: np.ndarray) -> dict[str, float]:
    """Return coverage of 90 % intervals, median and spread; single values of z may be huge."""
    return {
        "coverage": float(np.mean(np.abs(z) < NINETY)),
        "median of z": float(np.median(z)),
        "rms of z": float(np.sqrt(np.mean(z**2))),
    }


def _flat(found: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return coverage and spread of every parameter by kind."""
    columns = (SAMPLED, LAPLACE, "rms of z", LEFT)
    return {f"{kind}, {p}": {c: of_kind[c][p] for c in columns} for kind, of_kind in found.items()
            for p in calibration.PRIORS}  # fmt: skip


def draw(found: dict[str, dict[str, Any]], band: tuple[float, float]) -> Figure:
    """Draw coverage and remaining standard deviations of all kinds."""
    figure = plt.figure(figsize=(9.0, 0.55 * len(found) + 2.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for shift, (p, marker) in zip((-0.2, 0.0, 0.2), zip(calibration.PRIORS, "os^", strict=True), strict=True):
        places = np.arange(len(found)) + shift
        for quantity, axes, face in ((SAMPLED, left, "black"), (LAPLACE, left, "none"), (LEFT, right, "black")):
            values = [of_kind[quantity][p] for of_kind in found.values()]
            label = {SAMPLED: f"{p}, {SAMPLED}", LAPLACE: f"{p}, {LAPLACE}", LEFT: None}[quantity]
            axes.plot(values, places, marker, ls="", color="black", mfc=face, ms=5, label=label)
    left.axvspan(*band, color="0.9", zorder=-1)
    left.axvline(COVERED, lw=0.8, ls=":", color="black")
    left.set_xlabel("share of 90 % intervals that contain the truth")
    right.set_xlabel("sd of logarithms over that of the prior")
    right.set_xscale("log")
    left.set_yticks(range(len(found)), [*found])
    left.set_ylim(-0.6, len(found) - 0.4)
    left.invert_yaxis()
    common.shared_legend(figure, 3)
    return figure


def _response(name: str, seed: int) -> Figure:
    problem = systems.problem(name, systems.BOTH, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = bp.map_estimate(problem, checks=False, progress=False, starts=1)
    return common.titled(bp.plot.response(problem, fit), f"{name}, synthetic tables of amplitudes")
