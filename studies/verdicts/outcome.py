"""Verdicts of the diagnostics on one data set of a case, and whether they are correct."""

import time
from dataclasses import dataclass
from typing import Any

import pandas as pd

import bayesperiodic as bp
from studies.verdicts import cases

GOOD = (cases.DETERMINED, cases.FINE, cases.ADEQUATE)


@dataclass(frozen=True)
class Outcome:
    """Estimate, draws and the verdicts of every tool; without draws the last three are None."""

    case: cases.Case
    problem: bp.Problem
    fit: bp.MapEstimate
    identifiability: bp.Identifiability
    seconds: float
    posterior: Any = None
    comparison: Any = None
    prediction: Any = None

    @property
    def verdicts(self) -> dict[str, dict[str, str]]:
        """By tool and parameter; "all" for those on the whole."""
        found = {cases.IDENTIFIABILITY: self.identifiability.verdicts}
        if self.posterior is not None:
            found[cases.COMPARE] = dict(self.comparison.table["verdict"])
            found[cases.JOINT] = {"all": str(self.comparison.joint["verdict"])}
            found[cases.PREDICT] = dict(self.prediction.table["verdict"])
        return found

    @property
    def wrong(self) -> dict[str, str]:
        """Unexpected verdicts, by tool and parameter."""
        verdicts = self.verdicts
        return {
            f"{tool} {name}": verdicts[tool][name]
            for tool, rows in self.case.expected.items()
            if tool in verdicts
            for name, allowed in rows.items()
            if verdicts[tool][name] not in allowed
        }

    @property
    def named(self) -> bool:
        """Whether the expected tools name the fault; True if there is no fault."""
        faulty = {f"{tool} {name}" for tool, names in self.case.fault.items() for name in names}
        return not faulty & set(self.wrong)

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers behind the verdicts; those with a Monte Carlo error as pairs (value, error)."""
        found: dict[str, Any] = {}
        for name, row in self.identifiability.table.iterrows():
            columns = ["contraction"] if pd.isna(row["p_negative"]) else ["contraction", "p_negative"]
            found[str(name)] = {column: _pair(row, column) for column in columns}
        if self.posterior is None:
            return found
        for name, row in self.comparison.table.iterrows():
            found[str(name)] |= {c: _pair(row, c) for c in ("shift", "sd_ratio", "skewness", "wasserstein")}
        joint = self.comparison.joint
        found["joint"] = {key: _pair(joint, key) for key in ("share_50", "share_90", "share_95", "pareto_k")}
        found["joint"]["importance_efficiency"] = float(f"{float(joint['efficiency']):.5g}")
        return found

    def line(self) -> dict[str, Any]:
        """Return the stored results of a replicate."""
        warned = any(verdict not in GOOD for rows in self.verdicts.values() for verdict in rows.values())
        return {
            "right": not self.wrong,
            "named": self.named,
            "warned": warned,
            "converged": self.converged,
            "wrong": self.wrong,
            "verdicts": self.verdicts,
            "numbers": self.numbers,
            "seconds": round(self.seconds, 2),
        }

    @property
    def converged(self) -> bool:
        """Convergence of the estimate, and of the draws if any."""
        return self.fit.converged and (self.posterior is None or self.posterior.converged)


def examine(name: str, data_seed: int, sampler_seed: int, *, drawless: bool = False) -> Outcome:
    """Return the verdicts on the data of one seed, sampled with another seed, or `drawless` from the estimate alone."""
    start, case = time.perf_counter(), cases.CASES[name]()
    problem = case.problem(data_seed)
    fit = bp.map_estimate(problem, progress=False)
    if drawless:
        found = bp.identifiability(problem, fit)
        return Outcome(case, problem, fit, found, time.perf_counter() - start)
    posterior = bp.sample(problem, fit, seed=sampler_seed, progress=False, **case.sampling)
    found = bp.identifiability(problem, fit, posterior)
    judged = bp.compare(problem, fit, posterior), bp.predict(problem, posterior)
    return Outcome(case, problem, fit, found, time.perf_counter() - start, posterior, *judged)


def _pair(row: Any, column: str) -> list[float | None]:
    """Return a number and its Monte Carlo error to five digits, None if not finite."""
    pair = float(row[column]), float(row[f"{column}_mcse"])
    return [float(f"{value:.5g}") if abs(value) < float("inf") else None for value in pair]
