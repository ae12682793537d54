"""A gallery of cases with known answers, and what the diagnoses say of each: identifiability, compare, predict.

All data are synthetic, with noise. ``--replicates N`` repeats every case on N data sets and samples the first data set
with up to 20 seeds. Each replicate is saved in replicates.jsonl as it ends, and the same command does the missing ones.
"""

from __future__ import annotations

import argparse
from typing import Any

from studies import common
from studies.verdicts import figures, replicates
from studies.verdicts.cases import CASES, FINE
from studies.verdicts.outcome import Outcome, examine, numbers

QUICK = ("product_ridge", "linear", "prior_dominated", "misspecified")


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    if options.replicates < 0:
        raise ValueError(f"--replicates: {options.replicates} is not allowed; it must be at least 0.")
    watch = common.Stopwatch()
    print("All data are SYNTHETIC: simulated from the stated truths, with noise.")
    outcomes: dict[str, Outcome] = {}
    for name in QUICK if options.quick else CASES:
        with watch.part(name, name.replace("_", " ")):
            outcomes[name] = examine(name, replicates.first_seed(options.seed), options.seed)
        print(account(outcomes[name]))
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, figures.figures(outcomes))
    results: dict[str, Any] = {name: collect(outcome) for name, outcome in outcomes.items()}
    if options.replicates:
        with watch.part("replicates", f"{options.replicates} replicates of every case"):
            lines = replicates.replicates(options.out, tuple(outcomes), options.replicates, options.seed)
        results["replicates"] = replicates.summary(lines, outcomes)
        print(replicates.account(results["replicates"]))
    about = {"synthetic": True, "seed": options.seed, "quick": options.quick, "monte_carlo": "pairs: value, error"}
    results["study"] = about | {"seconds": watch.total(), "versions": common.versions()}
    path = common.write_results(options.out, results)
    print(f"figures (synthetic data): {', '.join(map(str, paths))}\nresults: {path}")


def collect(outcome: Outcome) -> dict[str, Any]:
    """Return the content of results.json on one case."""
    case, posterior, joint = outcome.case, outcome.drawn.posterior, outcome.drawn.comparison.joint
    return {
        "fault": case.title,
        "truth": dict(case.truth),
        "expected": {tool: {n: list(v) for n, v in rows.items()} for tool, rows in case.expected.items()},
        "named_by": {tool: list(names) for tool, names in case.fault.items()},
        "verdicts": outcome.verdicts,
        "right": not outcome.wrong,
        "wrong": outcome.wrong,
        "named": outcome.named,
        "converged": outcome.converged,
        "sampler": posterior.reason,
        "effective_sample_size": min(posterior.ess.values()),
        "map": outcome.fit.theta,
        "laplace_sd": {n: sd if sd < float("inf") else None for n, sd in outcome.fit.sd.items()},
        "numbers": numbers(outcome),
        "remedy": {n: text for n, text in outcome.identifiability.table["remedy"].items() if text},
        "recommendation": str(joint["recommendation"]) if joint["verdict"] != FINE else "",
        "p_values": outcome.p_values,
    }


def account(outcome: Outcome) -> str:
    """Return what is printed of a case."""
    said = [f"{tool}: {', '.join(f'{n} {v}' for n, v in rows.items())}" for tool, rows in outcome.verdicts.items()]
    verdict = f"WRONG ({outcome.wrong})" if outcome.wrong else "right"
    lines = [f"  fault: {outcome.case.title}; every verdict {verdict}; {outcome.drawn.posterior.reason}", *said]
    return "\n    ".join(lines)
