"""Synthetic campaigns of the flutter rig: coverage of the nonlinear stiffnesses' intervals, separation of the branches.

Each campaign has the eight kinds of cycles of the true model, with its own noise of the measured records' size, folded
and fitted in the same way except for the noise: with a true model the scatter of the cycles estimates the noise of each
record (`bp.noise.Measured`). The sensors' scales are fixed, since they and the stiffnesses are not separately
identifiable.
"""

import argparse
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import binom

import bayesperiodic as bp
from studies import common
from studies.flutter import rig
from studies.flutter.questions import FREE_SCALES, errors
from studies.flutter.rig import TRUE, estimate

FILE = "campaigns.jsonl"
FIRST_SEED = 100_000
STIFFNESSES = ("k_alpha2", "k_alpha3")
LEVEL, ALARM = 0.9, 0.01


def run(options: argparse.Namespace) -> None:
    """Compute the campaigns missing from the file in the folder, and report on all of them."""
    watch = common.Stopwatch()
    print("All data are SYNTHETIC: cycles of a stated truth, with noise.")
    folder = options.out / "campaigns"
    with watch.part("campaigns", f"{options.replicates} campaigns"):
        tasks = [(FIRST_SEED * options.seed + number,) for number in range(options.replicates)]
        lines = common.resumed(folder / FILE, tasks, campaign, lambda line: (line["seed"],), source())
    found = account(lines)
    print(table(found))
    results = {"synthetic": True, "seed": options.seed, "truth": TRUE, "account": found, "campaigns": lines}
    common.finish(folder, results, watch, synthetic=True)


def source() -> str:
    """Return a key that identifies the version of the campaigns."""
    return common.source_key(__file__, rig.__file__)


def campaign(task: tuple[int]) -> dict[str, Any]:
    """Return the results of one campaign."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        records = rig.generate(task[0])
        experiments, refused = rig.usable(records)
        speeds = {record.recording.name: record.speed for record in records}
        try:
            known = {name: TRUE[name] for name in FREE_SCALES}
            fitted = estimate(experiments, speeds, start=TRUE, known=known, noise=bp.noise.Measured())
        except ValueError as error:
            return {"seed": task[0], "source": source(), "refused": refused, "failure": str(error)}
    fit, intervals = fitted.fit, fitted.fit.interval(LEVEL)
    return {
        "seed": task[0],
        "source": source(),
        "refused": refused,
        "converged": fit.converged,
        "covers": {name: bool(low < TRUE[name] < high) for name, (low, high) in intervals.items()},
        "pulls": {name: (fit.theta[name] - TRUE[name]) / fit.sd[name] for name in fit.theta},
        "sd": fit.sd,
        "kept_apart": all(one["as_measured"] for one in errors(fitted, experiments).values()),
    }


def account(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return coverage, in the two-sided 99 % band of the binomial distribution, failures and swaps."""
    whole = [line for line in lines if "failure" not in line]
    return {
        "campaigns": len(lines),
        "failures": [line["failure"] for line in lines if "failure" in line],
        "level": LEVEL,
        "band": [float(binom.ppf(p, len(whole), LEVEL)) for p in (ALARM / 2, 1 - ALARM / 2)] if whole else None,
        "covered": {
            name: sum(line["covers"][name] for line in whole) for name in (whole[0]["covers"] if whole else ())
        },
        "kept_apart": sum(line["kept_apart"] for line in whole),
        "not_converged": sum(not line["converged"] for line in whole),
        "records_refused": sum(len(line["refused"]) for line in lines),
    }


def table(found: Mapping[str, Any]) -> str:
    """Return the counts as text."""
    covered = ", ".join(f"{name} {found['covered'].get(name)}" for name in STIFFNESSES)
    return (
        f"  {found['campaigns']} campaigns, {len(found['failures'])} failures; {found['level']:.0%} intervals cover "
        f"{covered} (band {found['band']}); branches kept apart in {found['kept_apart']}, not converged "
        f"{found['not_converged']}"
    )
