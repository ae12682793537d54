"""The gallery again and again: other data, other sampler seeds; resumed where it was interrupted."""

from __future__ import annotations

import hashlib
import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common
from studies.tasks import resumed
from studies.verdicts import cases
from studies.verdicts import outcome as verdicts_outcome
from studies.verdicts.cases import CASES, COMPARE, IDENTIFIABILITY
from studies.verdicts.outcome import Outcome, examine

DATA, SAMPLER = "data", "sampler"
MOST_SAMPLER_SEEDS = 20
ALWAYS_SAMPLED = 50
STRIDE = 1000
FILE = "replicates.jsonl"

Task = tuple[str, str, int, int]


def first_seed(seed: int) -> int:
    """Return the data seed of the gallery itself, and of the replicates with other sampler seeds."""
    return STRIDE * seed


def replicate(task: Task) -> dict[str, Any]:
    """Return one replicate: case, what varies, number, seed of the study.

    Where `identifiability` alone names the fault, data sets from number 50 on are judged without draws.
    """
    name, kind, number, seed = task
    found: dict[str, Any] = {"case": name, "kind": kind, "number": number, "seed": seed, "source": source()}
    data = first_seed(seed) + (number if kind == DATA else 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if kind == DATA and number >= ALWAYS_SAMPLED and set(CASES[name]().fault) == {IDENTIFIABILITY}:
                return found | _before_sampling(name, data).line()
            return found | examine(name, data, first_seed(seed) + number, drawless=kind == DATA).line()
        except (RuntimeError, ValueError) as error:
            return found | {"error": f"{type(error).__name__}: {error}"}


def _before_sampling(name: str, data_seed: int) -> Outcome:
    """Return what is said of the data of one seed from the estimate alone."""
    start, case = time.perf_counter(), CASES[name]()
    problem = case.problem(data_seed)
    fit = bp.map_estimate(problem, progress=False)
    return Outcome(case, problem, fit, bp.identifiability(problem, fit), None, time.perf_counter() - start)


def source() -> str:
    """Return what tells replicates of other cases, or of another version, apart."""
    files = [Path(str(module.__file__)) for module in (cases, verdicts_outcome)]
    text = common.versions()["bayesperiodic"] + "".join(common.sha256(path) for path in files)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def replicates(folder: Path, names: Sequence[str], count: int, seed: int) -> list[dict[str, Any]]:
    """Do the replicates that the file in the folder lacks, and return all of them."""
    tasks: list[Task] = []
    for number in range(count):
        tasks += [(name, DATA, number, seed) for name in names]
        tasks += [(name, SAMPLER, number, seed) for name in names if number < MOST_SAMPLER_SEEDS]
    return resumed(folder / FILE, tasks, replicate, _task, source())


def _task(line: Mapping[str, Any]) -> Task:
    return line["case"], line["kind"], line["number"], line["seed"]


def summary(lines: Sequence[Mapping[str, Any]], outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    """Return the counts of each case: other data, and other sampler seeds on the first data set."""
    found = {}
    for name, outcome in outcomes.items():
        own = [line for line in lines if line["case"] == name]
        by_kind = {kind: [line for line in own if line["kind"] == kind] for kind in (DATA, SAMPLER)}
        found[name] = {kind: _counts(members) for kind, members in by_kind.items()}
        found[name][SAMPLER]["verdicts_that_flip"] = _flips(by_kind[SAMPLER], outcome)
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


def _flips(lines: Sequence[Mapping[str, Any]], outcome: Outcome) -> dict[str, list[str]]:
    """Return the verdicts, of those that are expected, that are not the same for every sampler seed."""
    said: dict[str, set[str]] = {}
    for line in lines:
        for tool, rows in outcome.case.expected.items():
            for name in rows if tool in line.get("verdicts", {}) else ():
                said.setdefault(f"{tool} {name}", set()).add(line["verdicts"][tool][name])
    return {what: sorted(verdicts) for what, verdicts in said.items() if len(verdicts) > 1}


def account(found: Mapping[str, Any]) -> str:
    """Return the counts as a table to print."""
    lines = [f"  {'case':18s} {'kind':8s} replicates sampled right named warned converged  s each"]
    for name, kinds in found.items():
        for kind, c in kinds.items():
            lines.append(
                f"  {name:18s} {kind:8s} {c['replicates']:10d} {c['sampled']:7d} {c['right']:5d} {c['named']:5d} "
                f"{c['warned']:6d} {c['converged']:9d}  {c['seconds_each']}"
            )
            lines += [f"      {number} times {what}" for what, number in c["wrong"].items()]
            lines += [f"      flips: {what}: {', '.join(v)}" for what, v in c.get("verdicts_that_flip", {}).items()]
            lines += [f"      {error}" for error in c["errors"]]
    return "\n".join(lines)
