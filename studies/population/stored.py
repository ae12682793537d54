"""What a population of stored units costs, stage by stage.

SYNTHETIC posteriors, so that making them takes little time: the damping of springs is measured with a known error and
falls with the temperature; draws from the closed form of each posterior replace those of one that was sampled, in a
file of its own.
"""

import cProfile
import pstats
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.population.springs import DAMPING_SPREAD, SPRING_PRIORS, SPRING_TRUTH, spring

STORED_DRAWS, SLOPE, TEMPERATURES, ERRORS = 20_000, -0.02, (10.0, 30.0), (0.05, 0.2)
KEPT_GROUPS, NEW_UNITS, LEAST = ("posterior", "sample_stats"), 20, 10
# Functions of every stage, with all that they call. Files are read, and their draws thinned, in a thread.
STAGES = {
    "reading": ("_draw",), "chains": ("sample_chains",), "shrinkage": ("shrink", "outside"),
    "evidence": ("evidence_for_spread",),
}  # fmt: skip


class StoredUnits(NamedTuple):
    """Paths and temperatures [°C] of units; estimates of ln(c/c₀), c₀ that of `SPRING_TRUTH`, and their errors."""

    paths: dict[str, Path]
    temperatures: dict[str, float]
    estimates: np.ndarray
    errors: np.ndarray


def stored_units(folder: Path, count: int, seed: int, *, whole: bool = False) -> StoredUnits:
    """Store posteriors whose prior of ln(c/c₀) is that of the springs; `whole`, with all groups that `sample` stores.

    The truths are normal with the spread of `DAMPING_SPREAD` about zero at the mean temperature, slope `SLOPE`.
    """
    generator = np.random.default_rng(seed)
    problem, prior = spring(SPRING_TRUTH["c"], 1.0, generator), SPRING_PRIORS["c"]
    sampled = bp.sample(problem, bp.map_estimate(problem, progress=False), seed=seed, progress=False)
    template = sampled.tree["posterior"].to_dataset()
    template = template.isel(draw=slice(0, STORED_DRAWS // template.sizes["chain"]))
    others = {} if whole else {name for name in sampled.tree.children if name not in KEPT_GROUPS}
    temperatures, errors = np.linspace(*TEMPERATURES, count), generator.uniform(*ERRORS, count)
    truths = SLOPE * (temperatures - temperatures.mean()) + DAMPING_SPREAD * generator.standard_normal(count)
    estimates, paths = truths + errors * generator.standard_normal(count), {}
    for number, (estimate, error) in enumerate(zip(estimates, errors, strict=True)):
        precision = error**-2 + prior.spread**-2
        values = estimate * error**-2 / precision + precision**-0.5 * generator.standard_normal(template["c"].shape)
        tree = sampled.tree.drop_nodes(others)
        tree["posterior"] = template.assign(c=template["c"].copy(data=SPRING_TRUTH["c"] * np.exp(values)))
        paths[f"spring {number + 1}"] = folder / f"{number + 1}.h5"
        one = replace(sampled, tree=tree, ess=dict.fromkeys(sampled.names, float(STORED_DRAWS)))
        one.save(paths[f"spring {number + 1}"])
    return StoredUnits(paths, dict(zip(paths, temperatures.tolist(), strict=True)), estimates, errors)


def stored_population(units: StoredUnits, seed: int) -> bp.Population:
    """Return the population of stored units, with the temperature as covariate."""
    return bp.population(units.paths, ["c"], covariates={"temperature": units.temperatures}, seed=seed, progress=False)


def stored(most: int, seed: int) -> dict[str, Any]:
    """Return processor seconds of all stages for 10, 100, … stored units, and of the test of another unit."""
    rows: dict[str, dict[str, Any]] = {}
    before, count = _memory(), LEAST
    while count <= most:
        with tempfile.TemporaryDirectory() as folder:
            units = stored_units(Path(folder), count, seed)
            profile, start = cProfile.Profile(time.process_time, builtins=False), time.process_time()
            found = profile.runcall(stored_population, units, seed)
            total = time.process_time() - start
        rows[str(count)] = _seconds(profile) | {
            "total": total, "calls": found.calls, "memory": _memory() - before, "converged": found.converged,
            "summary": found.summary().to_dict("index"), "largest_pareto_k": float(found.units["pareto_k"].max()),
            "log_bayes_factor": float(found.evidence["log_bayes_factor"]["c"]), "outside": len(found.outside),
        }  # fmt: skip
        count *= 10
    with tempfile.TemporaryDirectory() as folder:
        new = stored_units(Path(folder), NEW_UNITS, seed + 1, whole=True)
        start = time.process_time()
        members = [
            found.test(path, covariates={"temperature": new.temperatures[name]}).member
            for name, path in new.paths.items()
        ]
        tests = {"units": NEW_UNITS, "seconds_each": (time.process_time() - start) / NEW_UNITS, "members": sum(members)}
    truth = {"mean[c]": SPRING_TRUTH["c"], "slope[c, temperature]": SLOPE, "spread[c]": DAMPING_SPREAD}
    return {"synthetic": True, "seed": seed, "draws": STORED_DRAWS, "truth": truth, "units": rows, "tests": tests}


def _seconds(profile: cProfile.Profile) -> dict[str, float]:
    """Return the seconds of every stage, of a function and all that it calls."""
    every = pstats.Stats(profile).get_stats_profile().func_profiles
    return {stage: sum(every[name].cumtime for name in functions) for stage, functions in STAGES.items()}


def _memory() -> float:
    """Return the largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def stored_table(found: dict[str, Any]) -> str:
    """Return the measurements as text."""
    columns = [*STAGES, "total", "calls", "memory", "converged"]
    return (
        f"{common.shown('processor seconds by stage, evaluations, MB, by units (SYNTHETIC)', found['units'], columns)}"
        f"\ntest of another unit: {found['tests']['seconds_each']:.2f} s"
    )
