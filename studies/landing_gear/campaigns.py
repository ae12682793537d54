"""Repeated campaigns of the landing gear: coverage of intervals under truth A, and rate of false misfit verdicts.

Every campaign has its own noise. Each experiment is sampled briefly (two ensembles of eight walkers, at most 600
steps), which is enough for intervals and signs; intervals of the Laplace approximation are counted too.
"""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

import bayesperiodic as bp
from studies import common
from studies.common import resumed
from studies.landing_gear import identification, rig, verdicts
from studies.landing_gear.identification import DISPLACEMENT, PRIORS, Identified, estimate, fold
from studies.landing_gear.rig import GEAR, RUNS, TRUTHS, Run, measure
from studies.landing_gear.verdicts import CONDUCTION, NEGATIVE, judge

FILE = "campaigns.jsonl"
FIRST_SEED = 100_000
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 8, "max_steps": 600, "variances": "collapsed", "progress": False}
LEVEL = 0.9
FAMILY = 0.01

Task = tuple[str, int]


def campaigns(folder: Path, count: int, seed: int, truth: str = "A") -> list[dict[str, Any]]:
    """Compute the campaigns missing from the file in the folder, and return all of them."""
    tasks: list[Task] = [(truth, FIRST_SEED * seed + number) for number in range(count)]
    return resumed(folder / FILE, tasks, campaign, lambda line: (line["truth"], line["seed"]), source())


def source() -> str:
    """Return a key that identifies the version of the campaigns."""
    modules = (identification, rig, verdicts)
    files = [Path(__file__), *(Path(str(module.__file__)) for module in modules)]
    text = common.versions()["bayesperiodic"] + "".join(common.sha256(path) for path in files)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def campaign(task: Task) -> dict[str, Any]:
    """Return the results of one campaign, by experiment."""
    truth, seed = task
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {run.name: _examine(run, truth, seed) for run in RUNS}
    return {"truth": truth, "seed": seed, "source": source(), "experiments": found}


def _examine(run: Run, truth: str, seed: int) -> dict[str, Any]:
    fitted = estimate([fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT)], DISPLACEMENT)
    stated, fit = fitted.problem, fitted.fit
    posterior = bp.sample(stated, fit, seed=seed, **SAMPLING)
    verdict = judge(Identified(stated, fit, posterior, 0.0))
    drawn = {name: np.quantile(posterior.draws(name), [0.5 - LEVEL / 2, 0.5 + LEVEL / 2]) for name in stated.names}
    laplace = fit.interval(LEVEL)
    return {
        "mcmc_covers": {name: bool(low < GEAR[name] < high) for name, (low, high) in drawn.items()},
        "laplace_covers": {name: bool(laplace[name][0] < GEAR[name] < laplace[name][1]) for name in stated.names},
        "sd": {name: float(posterior.draws(name).std()) for name in stated.names},
        "sign": verdict.sign,
        "misspecified": verdict.misspecified,
        "map_converged": fit.converged,
        "stop_rule": posterior.converged,
    }


def account(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return coverage over all experiments of all campaigns, and how often a sign or the model is called wrong.

    The band of a parameter is the two-sided 99 % one of the binomial distribution, familywise over the parameters.
    """
    every = [one for line in lines for one in line["experiments"].values()]
    tail = 0.5 * FAMILY / len(PRIORS)
    low, high = (float(binom.ppf(p, len(every), LEVEL)) for p in (tail, 1.0 - tail))
    covered = {
        kind: {name: sum(one[f"{kind}_covers"][name] for one in every) for name in PRIORS}
        for kind in ("mcmc", "laplace")
    }
    return {
        "campaigns": len(lines),
        "experiments": len(every),
        "band": [low, high],
        "covered": covered,
        "covered_by_experiment": {
            run.name: {
                name: sum(line["experiments"][run.name]["mcmc_covers"][name] for line in lines) for name in PRIORS
            }
            for run in RUNS
        },
        "median_sd_by_experiment": {
            run.name: {
                name: float(np.median([line["experiments"][run.name]["sd"][name] for line in lines])) for name in PRIORS
            }
            for run in RUNS
        },
        "called_negative": sum(one["sign"] == NEGATIVE for one in every),
        "called_misspecified": sum(one["misspecified"] for one in every),
        "map_not_converged": sum(not one["map_converged"] for one in every),
        "stop_rule_passed": sum(one["stop_rule"] for one in every),
    }


def table(found: Mapping[str, Any]) -> str:
    """Return the counts as text."""
    low, high = found["band"]
    lines = [f"  {found['campaigns']} campaigns, {found['experiments']} posteriors; 90 % intervals that cover:"]
    for kind, counts in found["covered"].items():
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        lines.append(f"    {kind:8s}{listed} (band {low:.0f} … {high:.0f})")
    lines.append(
        f"    {CONDUCTION} called negative {found['called_negative']} times, the model misspecified "
        f"{found['called_misspecified']} times; {found['map_not_converged']} estimates not converged"
    )
    return "\n".join(lines)
