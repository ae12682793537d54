"""Populations: how springs and friction dampers differ from unit to unit, and which unit is none of them.

Simulated springs with a known spread of the damping and none of the stiffness, one more like them and one that is not.
Measured: twelve steady-sine tests of a banded rotary friction damper with backlash (github.com/ARTS-Laboratory/
Dataset-Friction-Damper-with-Backlash, commit 0e09aa9d), friction force Kw and sharpness rho of Dahl's model by
amplitude, frequency and band tension; with ``--replicates N`` the first N tests are predicted from all others. Without
the files only the springs.
"""

import argparse
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common

FILES = (
    "test_2_30lb_0.5Hz_0.5in", "test_2_30lb_0.5Hz_1.5in", "test_2_30lb_1Hz_0.5in", "test_2_30lb_1Hz_1.5in",
    "test_2_36lb_0.5Hz_0.5in", "test_2_36lb_0.5Hz_1in", "test_2_36lb_1Hz_1.5in", "test_2_36lb_1Hz_1in",
    "test_3_30lb_0.5Hz_0.5in", "test_3_30lb_0.5Hz_1.5in", "test_3_30lb_1Hz_0.5in", "test_3_30lb_1Hz_1.5in",
)  # fmt: skip
ADDRESS = "github.com/ARTS-Laboratory/Dataset-Friction-Damper-with-Backlash (commit 0e09aa9d), CC BY-SA 4.0"
INCH, KIP = 0.0254, 4448.22
# The ramp up takes two cycles after a short rest, the ramp down the last one and a half of seven.
REST, FIRST_CYCLE, LAST_CYCLE, SAMPLES = 0.3, 2.0, 5.4, 400
DAHL_PRIORS: dict[str, Any] = {
    "Kx": bp.LogNormal(5e3, 1.0), "K": bp.Normal(0.0, 2e5), "F0": bp.Normal(0.0, 500.0),
    "Kw": bp.LogNormal(1e4, 0.5), "rho": bp.LogNormal(500.0, 1.0),
}  # fmt: skip
DAMPER_NAMES = ("Kw", "rho")

SPRINGS, QUICK_SPRINGS, NOISE, POINTS = 8, 4, 0.02, 64
DAMPING_SPREAD, SPRING_TRUTH = 0.3, {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
SPRING_PRIORS = {"c": bp.LogNormal(0.2, 1.0), "k": bp.LogNormal(1.0, 0.5)}
STIFFER = 1.3


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    figures: dict[str, Figure] = {}
    with watch.part("springs", "sampling simulated springs one by one, and their population"):
        springs, account = spring_population(QUICK_SPRINGS if options.quick else SPRINGS, options.seed)
        figures["springs"] = common.titled(bp.plot.population(springs), "Simulated springs (synthetic data)")
    print(springs)
    results: dict[str, Any] = {"seed": options.seed, "springs": account}
    paths = [] if options.quick else find_tests(options.data)
    if paths:
        with watch.part("tests", "sampling the tests of the friction damper one by one"):
            every = {path.stem: sampled_test(path, options.seed) for path in paths}
            posteriors = {name: draws for name, draws in every.items() if draws is not None}
        with watch.part("dampers", "sampling their population, and that of all but one"):
            left_out = list(posteriors)[: options.replicates]
            dampers, results["dampers"] = damper_population(posteriors, left_out, options.seed)
            figures["forest"] = common.titled(bp.plot.population(dampers), "Friction damper, twelve tests")
            figures["amplitude"] = common.titled(
                bp.plot.population(dampers, covariate="amplitude"), "Friction damper, by amplitude [m]"
            )
        print(dampers)
    else:
        print(f"  the tests of the friction damper are not used; they are at {ADDRESS}")
    saved = common.save_figures(options.out, figures)
    common.finish(options.out, results, watch, saved, synthetic=not paths)


def spring(damping: float, stiffness: float, generator: np.random.Generator) -> bp.Problem:
    """Return the problem of one simulated spring, a Duffing oscillator."""
    force = np.cos(2.0 * np.pi * np.arange(POINTS) / POINTS)
    truth = bp.solve_periodic(
        bp.models.duffing, SPRING_TRUTH | {"c": damping, "k": stiffness}, {"force": force}, frequency=0.1,
        samples=POINTS, scheme="fourier",
    )  # fmt: skip
    measured = truth.outputs["displacement"] + NOISE * generator.standard_normal(POINTS)
    run = bp.Experiment("run", 0.1, {"displacement": measured}, {"force": force}, samples=POINTS, synthetic=True)
    return bp.Problem(
        bp.models.duffing,
        [run],
        priors=SPRING_PRIORS,
        fixed={n: SPRING_TRUTH[n] for n in ("m", "k3")},
        scheme="fourier",
    )


def spring_population(count: int, seed: int) -> tuple[bp.Population, dict[str, Any]]:
    """Return the population of springs with equal stiffness, and the tests of a member and of a stiffer one."""
    generator = np.random.default_rng(seed)
    damping = SPRING_TRUTH["c"] * np.exp(DAMPING_SPREAD * generator.standard_normal(count + 2))
    problems = {f"spring {k + 1}": spring(c, 1.0, generator) for k, c in enumerate(damping[:count])}
    result = bp.population(problems, ["c", "k"], seed=seed, progress=False)
    tests = {
        "member": result.test(spring(damping[-2], 1.0, generator)),
        "stiffer": result.test(spring(damping[-1], STIFFER, generator)),
    }
    account = _account(result) | {
        "truth": {"spread[c]": DAMPING_SPREAD, "spread[k]": 0.0},
        "tests": {
            name: {"member": t.member, "p": t.table["p"].to_dict(), "verdict": t.verdict} for name, t in tests.items()
        },
        "joint_dimension": 3 * count + len(result.labels),
    }
    return result, account


def find_tests(given: Path | None) -> list[Path]:
    """Return the files of the damper, from the folder given or the usual places; none if one is missing."""
    if given is not None:
        return [given / f"{name}.npz" for name in FILES]
    places = [common.find_data(None, f"friction_damper/{name}.npz") for name in FILES]
    return [place[0] for place in places if place is not None] if all(places) else []


def conditions(name: str) -> dict[str, float]:
    """Return amplitude [m], frequency [Hz] and band tension [N] of a test, from its name."""
    tension, frequency, amplitude = map(float, re.findall(r"_([\d.]+)(?:lb|Hz|in)", name))
    return {"amplitude": amplitude * INCH, "frequency": frequency, "tension": tension * KIP / 1000.0}


def sampled_test(path: Path, seed: int) -> bp.Posterior | None:
    """Return the posterior of Dahl's model on the steady cycles of one test; None if these determine too little."""
    data, frequency = np.load(path), conditions(path.stem)["frequency"]
    recording = bp.Recording(
        data["time_s"], {"force": KIP * data["force_kip"].astype(float)},
        {"displacement": INCH * data["displacement_in"].astype(float)}, name=path.stem,
    ).between(REST + FIRST_CYCLE / frequency, REST + LAST_CYCLE / frequency)  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the model is misspecified, which the population states
        try:
            problem = bp.Problem(bp.models.dahl, [recording.fold(SAMPLES)], priors=DAHL_PRIORS)
        except ValueError as error:  # fewer independent values than parameters
            print(f"  {path.stem} is left out: {error}")
            return None
        return bp.sample(problem, bp.map_estimate(problem, progress=False), seed=seed, progress=False)


def damper_population(
    posteriors: dict[str, bp.Posterior], chosen: list[str], seed: int
) -> tuple[bp.Population, dict[str, Any]]:
    """Return the population of all tests, and how some are predicted by all others."""

    def fit(names: list[str]) -> bp.Population:
        covariates = {what: {name: conditions(name)[what] for name in names} for what in conditions(names[0])}
        units = {name: posteriors[name] for name in names}
        return bp.population(units, DAMPER_NAMES, covariates=covariates, seed=seed, progress=False)

    result = fit(list(posteriors))
    predicted: dict[str, dict[str, Any]] = {}
    for left_out in chosen:
        others = fit([name for name in posteriors if name != left_out])
        intervals = {
            name: np.quantile(draws, [0.05, 0.95]).tolist()
            for name, draws in others.predict(conditions(left_out)).items()
        }
        medians = {name: float(np.median(posteriors[left_out].headline.draws(name))) for name in DAMPER_NAMES}
        inside = {name: bool(low <= medians[name] <= high) for name, (low, high) in intervals.items()}
        test = others.test(posteriors[left_out], covariates=conditions(left_out))
        predicted[left_out] = {"interval_90": intervals, "median": medians, "inside": inside, "member": test.member}
    counts = {name: sum(row["inside"][name] for row in predicted.values()) for name in DAMPER_NAMES}
    return result, _account(result) | {"tests": len(posteriors), "predicted": predicted, "inside_90": counts}


def _account(result: bp.Population) -> dict[str, Any]:
    """Return the entries of results.json for a population."""
    return {
        "summary": result.summary().to_dict("index"),
        "evidence": result.evidence.to_dict("index"),
        "verdicts": result.verdicts,
        "remarks": result.remarks,
        "largest_pareto_k": float(result.units["pareto_k"].max()),
        "calls": result.calls,
        "unit_calls": result.unit_calls,
        "converged": result.converged,
    }
