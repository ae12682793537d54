"""Repeated campaigns of the landing gear: coverage of intervals under truth A, and rate of false misfit verdicts.

Every campaign has its own noise. Each experiment is sampled briefly (two ensembles of eight walkers, at most 600
steps), which is enough for intervals and signs; intervals of the Laplace approximation are counted too.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

import bayesperiodic as bp
from studies import common
from studies.landing_gear import identification, rig
from studies.landing_gear.identification import CONDUCTION, DISPLACEMENT, PRIORS, fold
from studies.landing_gear.rig import GEAR, RUNS, TRUTHS, Run, measure

FILE = "campaigns.jsonl"
FIRST_SEED = 100_000
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 8, "max_steps": 600, "variances": "collapsed", "progress": False}
LEVEL = 0.9
FAMILY = 0.01

Task = tuple[str, int]


def campaigns(folder: Path, count: int, seed: int, truth: str = "A") -> list[dict[str, Any]]:
    """Compute the campaigns missing from the file in the folder, and return all of them."""
    tasks: list[Task] = [(truth, FIRST_SEED * seed + number) for number in range(count)]
    return common.resumed(folder / FILE, tasks, campaign, lambda line: (line["truth"], line["seed"]), source())


def source() -> str:
    """Return a key that identifies the version of the campaigns."""
    return common.source_key(__file__, identification.__file__, rig.__file__)


def campaign(task: Task) -> dict[str, Any]:
    """Return the results of one campaign, by experiment."""
    truth, seed = task
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {run.name: _examine(run, truth, seed) for run in RUNS}
    return {"truth": truth, "seed": seed, "source": source(), "experiments": found}


def _examine(run: Run, truth: str, seed: int) -> dict[str, Any]:
    fitted = identification.estimate([fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT)], DISPLACEMENT)
    stated, fit = fitted.problem, fitted.fit
    posterior = bp.sample(stated, fit, seed=seed, **SAMPLING)
    verdict = identification.judge(identification.Identified(stated, fit, posterior))
    ends = [0.5 - LEVEL / 2, 0.5 + LEVEL / 2]
    mcmc = {name: np.quantile(posterior.draws(name), ends) for name in stated.names}
    return {
        "mcmc_covers": {name: bool(low < GEAR[name] < high) for name, (low, high) in mcmc.items()},
        "laplace_covers": {name: bool(low < GEAR[name] < high) for name, (low, high) in fit.interval(LEVEL).items()},
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
    by_run = {run.name: [line["experiments"][run.name] for line in lines] for run in RUNS}
    return {
        "campaigns": len(lines),
        "experiments": len(every),
        "band": [low, high],
        "covered": {kind: _covered(every, kind) for kind in ("mcmc", "laplace")},
        "covered_by_experiment": {run: _covered(own, "mcmc") for run, own in by_run.items()},
        "median_sd_by_experiment": {
            run: {name: float(np.median([one["sd"][name] for one in own])) for name in PRIORS}
            for run, own in by_run.items()
        },
        "called_negative": sum(one["sign"] == identification.NEGATIVE for one in every),
        "called_misspecified": sum(one["misspecified"] for one in every),
        "map_not_converged": sum(not one["map_converged"] for one in every),
        "stop_rule_passed": sum(one["stop_rule"] for one in every),
    }


def _covered(every: Sequence[Mapping[str, Any]], kind: str) -> dict[str, int]:
    return {name: sum(one[f"{kind}_covers"][name] for one in every) for name in PRIORS}


def table(found: Mapping[str, Any]) -> str:
    """Return the counts as text."""
    low, high = found["band"]
    title = (
        f"{found['campaigns']} campaigns, {found['experiments']} posteriors; 90 % intervals with the truth (band "
        f"{low:.0f} … {high:.0f})"
    )
    return (
        f"{common.shown(title, found['covered'])}\n{CONDUCTION} called negative {found['called_negative']} times, the "
        f"model misspecified {found['called_misspecified']} times; {found['map_not_converged']} estimates not converged"
    )
