"""Twelve measured tests of a banded rotary friction damper with backlash, and Dahl's model of them."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.population.account import account

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
        try:
            member = bool(others.test(posteriors[left_out], covariates=conditions(left_out)).member)
        except ValueError as error:  # data that say no more than the unit's own prior decide nothing
            print(f"  {left_out}: membership is not decided: {error}")
            member = None
        predicted[left_out] = {"interval_90": intervals, "median": medians, "inside": inside, "member": member}
    counts = {name: sum(row["inside"][name] for row in predicted.values()) for name in DAMPER_NAMES}
    tried = {"predicted": predicted, "inside_90": counts} if predicted else {}
    return result, account(result) | {"tests": len(posteriors)} | tried
