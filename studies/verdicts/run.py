"""Gallery of cases with known answers, and the verdicts of identifiability, compare and predict on each.

All data are synthetic, with noise. ``--replicates N`` repeats every case on N data sets instead, and samples the first
data set with up to 20 seeds. Each replicate is saved in replicates.jsonl as it ends, and the same command computes
missing ones.
"""

import argparse
import textwrap
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.verdicts import cases
from studies.verdicts.cases import CASES, COMPARE, FINE, IDENTIFIABILITY, PREDICT, Outcome, examine

DATA, SAMPLER = "data", "sampler"
MOST_SAMPLER_SEEDS = 20
ALWAYS_SAMPLED = 50
# The data seed of the gallery itself, and of the replicates with other sampler seeds, is this times the seed.
STRIDE = 1000
FILE = "replicates.jsonl"

Task = tuple[str, str, int, int]


def replicate(task: Task) -> dict[str, Any]:
    """Return one replicate: case, what varies, number, seed of the study.

    Where `identifiability` alone names the fault, data sets from number 50 on are judged without draws.
    """
    name, kind, number, seed = task
    found: dict[str, Any] = {"case": name, "kind": kind, "number": number, "seed": seed, "source": source()}
    data = STRIDE * seed + (number if kind == DATA else 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            case = CASES[name]()
            enough = case.drawless or (number >= ALWAYS_SAMPLED and set(case.fault) == {IDENTIFIABILITY})
            return found | examine(name, data, STRIDE * seed + number, drawless=kind == DATA and enough).line()
        except (RuntimeError, ValueError) as error:
            return found | {"error": f"{type(error).__name__}: {error}"}


def source() -> str:
    """Return a key that identifies version and cases of the replicates."""
    return common.source_key(cases.__file__)


def replicates(folder: Path, names: Sequence[str], count: int, seed: int) -> list[dict[str, Any]]:
    """Compute the replicates missing from the file in the folder, and return all of them."""
    tasks: list[Task] = []
    for number in range(count):
        tasks += [(name, DATA, number, seed) for name in names]
        tasks += [(name, SAMPLER, number, seed) for name in names if number < MOST_SAMPLER_SEEDS]
    keys = "case", "kind", "number", "seed"
    return common.resumed(folder / FILE, tasks, replicate, lambda line: tuple(line[key] for key in keys), source())


def summary(lines: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """Return the counts of each case: other data, and other sampler seeds on the first data set."""
    found = {}
    for name in names:
        own = [line for line in lines if line["case"] == name]
        by_kind = {kind: [line for line in own if line["kind"] == kind] for kind in (DATA, SAMPLER)}
        found[name] = {kind: _counts(members) for kind, members in by_kind.items()}
        found[name][SAMPLER]["verdicts_that_flip"] = _flips(by_kind[SAMPLER], CASES[name]())
    return found


def _counts(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return how many replicates are right, name the fault, warn and converged; shares with their errors."""
    whole = [line for line in lines if "error" not in line]
    counts: dict[str, Any] = {"replicates": len(lines), "errors": [line["error"] for line in lines if "error" in line]}
    for key in ("right", "named", "warned", "converged"):
        number = sum(line[key] for line in whole)
        share = number / len(lines)
        # Laplace's rule of succession keeps the error of a share of 0 or 1 from being zero.
        smoothed = (number + 1) / (len(lines) + 2)
        error = float(np.sqrt(smoothed * (1.0 - smoothed) / len(lines)))
        counts |= {key: number, f"{key}_share": [share, float(f"{error:.2g}")]}
    counts["sampled"] = sum(COMPARE in line["verdicts"] for line in whole)
    wrong = Counter(f"{what}: {verdict}" for line in whole for what, verdict in line["wrong"].items())
    seconds = [line["seconds"] for line in whole]
    return counts | {"wrong": dict(wrong), "seconds_each": round(float(np.mean(seconds)), 2) if seconds else None}


def _flips(lines: Sequence[Mapping[str, Any]], case: cases.Case) -> dict[str, list[str]]:
    """Return the expected verdicts that differ between sampler seeds."""
    by_name: dict[str, set[str]] = {}
    for line in lines:
        for tool, rows in case.expected.items():
            for name in rows if tool in line.get("verdicts", {}) else ():
                by_name.setdefault(f"{tool} {name}", set()).add(line["verdicts"][tool][name])
    return {what: sorted(verdicts) for what, verdicts in by_name.items() if len(verdicts) > 1}


def account_of_replicates(found: Mapping[str, Any]) -> str:
    """Return the counts as a table to print."""
    every = {f"{name}, {kind}": counts for name, kinds in found.items() for kind, counts in kinds.items()}
    columns = ["replicates", "sampled", "right", "named", "warned", "converged", "seconds_each"]
    lines = [common.shown("replicates by case, with other data or other seeds of the sampler", every, columns)]
    for name, c in every.items():
        lines += [f"{name}: {number} times {what}" for what, number in c["wrong"].items()]
        lines += [f"{name}: flips: {what}: {', '.join(v)}" for what, v in c.get("verdicts_that_flip", {}).items()]
        lines += [f"{name}: {error}" for error in c["errors"]]
    return "\n".join(lines)


BINS, SHOWN = 50, (0.0005, 0.9995)
RIDGES = {
    "product_ridge": "Only a·b is determined: the draws follow a hyperbola, the Laplace ellipse its tangent",
    "sum_ridge": "Only a + b is determined: the draws follow a line, and so does the Laplace ellipse",
    "scaling_symmetry": "A pendulum's m, k1, k2, k3 are determined only up to a common factor: ridges from the origin",
}
SHOWN_OF = {"scaling_symmetry": ["m", "k1", "k2", "k3", "l"]}
WIDTH = 72


def _figures(outcomes: Mapping[str, Outcome]) -> dict[str, Figure]:
    found = {"gallery": _gallery(outcomes)}
    for name, title in RIDGES.items():
        if name in outcomes:
            o = outcomes[name]
            names = SHOWN_OF.get(name, list(o.problem.names))
            truths = {n: o.case.truth[n] for n in names}
            drawn = bp.plot.corner(o.posterior, laplace=o.fit, problem=o.problem, names=names, truths=truths)
            found[name] = common.titled(drawn, title)
    return found


def _gallery(outcomes: Mapping[str, Outcome]) -> Figure:
    figure = plt.figure(figsize=(11.0, 1.55 * len(outcomes) + 0.7), layout="constrained")
    grid = figure.subplots(len(outcomes), 2, squeeze=False, width_ratios=[1.0, 1.35])
    for (left, right), outcome in zip(grid, outcomes.values(), strict=True):
        _marginal(left, outcome)
        _words(right, outcome)
    common.shared_legend(figure, 3, loc="outside upper left")
    figure.suptitle("synthetic data", x=0.99, ha="right", fontsize="medium")
    return figure


def _marginal(axes: Axes, outcome: Outcome) -> None:
    name, colours = outcome.case.shown, bp.plot.COLOURS
    draws = outcome.posterior.draws(name)
    density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
    axes.stairs(density, edges, color=colours["mcmc"], fill=True, label="MCMC")
    mean, sd, truth = outcome.fit.theta[name], outcome.fit.sd[name], outcome.case.truth[name]
    low, high = min(edges[0], truth), max(edges[-1], truth)
    margin = 0.06 * (high - low)
    x = np.linspace(low - margin, high + margin, 400)
    if np.isfinite(sd):
        normal = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes.plot(x, normal, color=colours["laplace"], lw=1.8, ls="--", label="Laplace")
        axes.set_ylim(0.0, 1.1 * max(density.max(), min(normal.max(), 1.6 * density.max())))
    axes.axvline(truth, color="black", lw=1.6, label="truth")
    axes.set_xlim(x[0], x[-1])
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=5, steps=[1, 2, 5, 10])
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.set_xlabel(common.axis_label(name, outcome.problem.model.units.get(name, "")))


def _words(axes: Axes, outcome: Outcome) -> None:
    case, verdicts = outcome.case, outcome.verdicts
    axes.set_axis_off()
    axes.text(0.0, 1.0, textwrap.fill(heading(case.title), WIDTH), va="top", fontsize=11, weight="bold")
    rows = {
        IDENTIFIABILITY: _grouped(verdicts[IDENTIFIABILITY]),
        COMPARE: _grouped(verdicts[COMPARE]),
        PREDICT: verdicts[PREDICT]["all"],
    }
    for place, (tool, text) in zip((0.66, 0.40, 0.14), rows.items(), strict=True):
        axes.text(0.0, place, tool, va="center", fontsize=10, color="#555555")
        weight = "bold" if tool in case.fault else "normal"
        axes.text(0.19, place, textwrap.fill(text, WIDTH), va="center", fontsize=9, weight=weight)
    mark = "as expected" if not outcome.wrong else "NOT AS EXPECTED"
    axes.text(1.0, 0.14, mark, va="center", ha="right", fontsize=10, style="italic")


def heading(title: str) -> str:
    """Return a fault as a sentence."""
    return "Nothing is wrong" if title == "nothing" else title[0].upper() + title[1:]


def _grouped(verdicts: Mapping[str, str]) -> str:
    members: dict[str, list[str]] = {}
    for name, verdict in verdicts.items():
        members.setdefault(verdict, []).append(name)
    return "; ".join(f"{', '.join(names)} {verdict}" for verdict, names in members.items())


QUICK = ("product_ridge", "linear", "prior_dominated", "misspecified")


def run(options: argparse.Namespace) -> None:
    """Run the study, or with ``--replicates`` the cases on other data."""
    watch, names = common.Stopwatch(), QUICK if options.quick else tuple(CASES)
    print("All data are SYNTHETIC: simulated from the stated truths, with noise.")
    if options.replicates:
        folder = options.out / "replicates"
        folder.mkdir(parents=True, exist_ok=True)
        with watch.part("replicates", f"{options.replicates} replicates of every case"):
            counts = summary(replicates(folder, names, options.replicates, options.seed), names)
        print(account_of_replicates(counts))
        common.finish(folder, {"synthetic": True, "seed": options.seed, "cases": counts}, watch, synthetic=True)
        return
    outcomes: dict[str, Outcome] = {}
    for name in names:
        with watch.part(name, name.replace("_", " ")):
            outcomes[name] = examine(name, STRIDE * options.seed, options.seed)
        print(_account(outcomes[name]))
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, _figures(outcomes))
    results: dict[str, Any] = {name: _collect(outcome) for name, outcome in outcomes.items()}
    about = {"synthetic": True, "seed": options.seed, "quick": options.quick, "monte_carlo": "pairs: value, error"}
    results["study"] = about | {"seconds": watch.total(), "versions": common.versions()}
    path = common.write_results(options.out, results)
    print(f"figures (synthetic data): {', '.join(map(str, paths))}\nresults: {path}")


def _collect(outcome: Outcome) -> dict[str, Any]:
    case, posterior, joint = outcome.case, outcome.posterior, outcome.comparison.joint
    p_values = outcome.prediction.table.select_dtypes("number")
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
        "numbers": outcome.numbers,
        "remedy": {n: text for n, text in outcome.identifiability.table["remedy"].items() if text},
        "recommendation": str(joint["recommendation"]) if joint["verdict"] != FINE else "",
        "p_values": {str(row): values.dropna().to_dict() for row, values in p_values.iterrows()},
    }


def _account(outcome: Outcome) -> str:
    verdicts = [f"{tool}: {', '.join(f'{n} {v}' for n, v in rows.items())}" for tool, rows in outcome.verdicts.items()]
    verdict = f"WRONG ({outcome.wrong})" if outcome.wrong else "right"
    lines = [f"  fault: {outcome.case.title}; every verdict {verdict}; {outcome.posterior.reason}", *verdicts]
    return "\n    ".join(lines)
