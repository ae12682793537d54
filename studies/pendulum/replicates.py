"""Table 1 of the paper over many recordings: errors, coverage, failures, and multipliers as data."""

import argparse
import time
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.pendulum import estimates, figures
from studies.pendulum import orbits as pendulum_orbits
from studies.pendulum.estimates import FREE, LONGEST_USED, PAPER_ERRORS, START_ERRORS
from studies.pendulum.orbits import Reference
from studies.pendulum.recording import PERIODS, section_of, simulate, with_noise

NOISE_LEVELS = (0.001, 0.01)


def run(options: argparse.Namespace) -> None:
    """Compute the replicates, and write their table."""
    watch = common.Stopwatch()
    print("All data are SYNTHETIC: simulated from the stated truth, with noise.")
    with watch.part("truths", "the true orbits, by shooting"):
        truths = _true_orbits(options.seed)
    lines: list[dict[str, Any]] = []
    with watch.part("replicates", f"{options.replicates} recordings at {len(NOISE_LEVELS)} noise levels"):
        tasks = [(options.seed + 1 + number, truths) for number in range(options.replicates)]
        for number, found in enumerate(common.each(_replicate, tasks), 1):
            lines += found
            print(f"  {number} of {len(tasks)}", flush=True)
    lines.sort(key=lambda line: (line["noise"], line["seed"]))
    table = {f"{noise:g}": _summary([line for line in lines if line["noise"] == noise]) for noise in NOISE_LEVELS}
    print(_account(table))
    folder = options.out / "table"
    paths = common.save_figures(folder, {"errors": figures.errors(lines)})
    results = {"synthetic": True, "seed": options.seed, "drive_periods": PERIODS, "table": table, "replicates": lines}
    results["start_errors"], results["paper_errors"] = START_ERRORS, PAPER_ERRORS
    common.finish(folder, results, watch, paths, synthetic=True)


def _true_orbits(seed: int) -> list[Reference]:
    section = section_of(simulate(PERIODS, seed))
    found = bp.find_orbits(section, periods=range(1, LONGEST_USED + 1))
    polished = bp.polish_orbits(bp.models.pendulum, found, pendulum_orbits.TRUTH, samples=pendulum_orbits.SAMPLES)
    return pendulum_orbits.references(polished)[0]


def _replicate(seed: int, truths: Sequence[Reference]) -> list[dict[str, Any]]:
    """Return the results of one recording, whose start and noise the seed determines, at every noise level."""
    recording, lines = simulate(PERIODS, seed), []
    for noise in NOISE_LEVELS:
        line: dict[str, Any] = {"seed": seed, "noise": noise, "errors": {}}
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                line |= _one(with_noise(recording, noise, seed), truths)
            except (ValueError, RuntimeError) as error:
                line["failure"] = f"{type(error).__name__}: {error}"
        lines.append(line | {"seconds": round(time.perf_counter() - start, 2)})
    return lines


def _one(recording: bp.Recording, truths: Sequence[Reference]) -> dict[str, Any]:
    """Return errors, sds and coverage of one recording."""
    orbits = bp.find_orbits(section_of(recording), periods=range(1, LONGEST_USED + 1))
    found = estimates.identify(orbits, which=("m and l", "k3"))
    fits = {"points": found.fits, "with eigenvalues": {}}
    for which in found.fits:
        fits["with eigenvalues"][which] = estimates.with_eigenvalues(found.selected, FREE[which])
    line: dict[str, Any] = {
        "orbits": len(orbits),
        "selected": len(found.selected),
        "lost": [list(pair) for pair in found.lost],
        "not_orbits": sum(pendulum_orbits.matched(orbit, truths) is None for orbit in found.selected),
        "pulls": pendulum_orbits.pulls(orbits, truths, np.inf),
        "converged": all(fit.converged for every in fits.values() for fit in every.values()),
    }
    for key, every in zip(("", "eigenvalue_"), fits.values(), strict=True):
        line[f"{key}errors"] = {n: e for fit in every.values() for n, e in estimates.errors(fit).items()}
        line[f"{key}sd"] = {n: fit.sd[n] / fit.theta[n] for fit in every.values() for n in fit.theta}
        line[f"{key}covers"] = {n: c for fit in every.values() for n, c in estimates.covers(fit).items()}
    line["scale"] = found.fits["m and l"].noise["scale"]
    return line


def _summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return medians, 90 % ranges and coverage over the recordings of one noise level."""
    whole = [line for line in lines if "failure" not in line]
    found: dict[str, Any] = {
        "recordings": len(lines),
        "failures": [line["failure"] for line in lines if "failure" in line],
        "lost_orbits": sum(len(line["lost"]) for line in whole),
        "selected_that_are_no_orbits": sum(line["not_orbits"] for line in whole),
        "selected_median": float(np.median([line["selected"] for line in whole])),
        "seconds_each": float(np.mean([line["seconds"] for line in lines])),
    }
    for name, paper in PAPER_ERRORS.items():
        size = np.abs([line["errors"][name] for line in whole])
        found[name] = {
            "median_error": float(np.median(size)),
            "range_90": [float(q) for q in np.quantile(size, [0.05, 0.95])],
            "paper": paper,
            "covered": _covering(line["covers"][name] for line in whole),
            "covered_with_eigenvalues": _covering(line["eigenvalue_covers"][name] for line in whole),
            "sd_with_eigenvalues_over_without": float(
                np.median([line["eigenvalue_sd"][name] / line["sd"][name] for line in whole])
            ),
        }
    for kind in ("eigenvalue", "point"):
        found[f"{kind}_bars"] = pendulum_orbits.covered([p for line in whole for p in line["pulls"][kind]])
    return found


def _covering(intervals: Iterable[bool]) -> dict[str, float]:
    return pendulum_orbits.covered([0.0 if covers else np.inf for covers in intervals])


def _account(table: dict[str, Any]) -> str:
    columns = ["median_error", "paper", "covered.cover", "covered.bars", "covered.band_low", "covered.band_high"]
    columns += ["covered_with_eigenvalues.cover", "sd_with_eigenvalues_over_without"]
    lines = []
    for noise, found in table.items():
        bars = found["eigenvalue_bars"]
        rows = {name: found[name] for name in PAPER_ERRORS}
        title = f"noise {float(noise):.1%}: relative errors, coverage of 90 % intervals"
        lines.append(common.shown(title, rows, columns))
        lines.append(
            f"failures {len(found['failures'])}, orbits lost {found['lost_orbits']}, selected but not true "
            f"{found['selected_that_are_no_orbits']}; eigenvalue error bars {bars['cover']} of {bars['bars']} "
            f"(band {bars['band_low']:.0f} … {bars['band_high']:.0f}); {found['seconds_each']:.1f} s each"
        )
    return "\n".join(lines)
