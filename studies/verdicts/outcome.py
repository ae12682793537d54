"""Verdicts of the diagnostics on one data set of a case, and whether they are correct."""

import time
from dataclasses import dataclass
from typing import Any

import pandas as pd

import bayesperiodic as bp
from studies.verdicts.cases import (
    ADEQUATE,
    CASES,
    COMPARE,
    DETERMINED,
    FINE,
    IDENTIFIABILITY,
    JOINT,
    PREDICT,
    Case,
)

GOOD = {IDENTIFIABILITY: DETERMINED, COMPARE: FINE, JOINT: FINE, PREDICT: ADEQUATE}


@dataclass(frozen=True)
class Drawn:
    """Draws and the verdicts based on them."""

    posterior: bp.Posterior
    comparison: bp.Comparison
    prediction: bp.Prediction


@dataclass(frozen=True)
class Outcome:
    """Estimate, draws and the verdicts of every tool."""

    case: Case
    problem: bp.Problem
    fit: bp.MapEstimate
    identifiability: bp.Identifiability
    sampled: Drawn | None  # None where the verdicts do without draws
    seconds: float

    @property
    def drawn(self) -> Drawn:
        """Draws and the verdicts based on them, if any."""
        if self.sampled is None:
            raise ValueError("drawless: requires draws, which this case does not have.")
        return self.sampled

    @property
    def verdicts(self) -> dict[str, dict[str, str]]:
        """By tool and parameter; "all" for those on the whole."""
        found = {IDENTIFIABILITY: self.identifiability.verdicts}
        if self.sampled is not None:
            found[COMPARE] = dict(self.sampled.comparison.table["verdict"])
            found[JOINT] = {"all": str(self.sampled.comparison.joint["verdict"])}
            found[PREDICT] = dict(self.sampled.prediction.table["verdict"])
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
    def warned(self) -> bool:
        """Whether any tool reports a problem."""
        return any(verdict != GOOD[tool] for tool, rows in self.verdicts.items() for verdict in rows.values())

    @property
    def converged(self) -> bool:
        """Convergence of the estimate, and of the draws if any."""
        return self.fit.converged and (self.sampled is None or self.sampled.posterior.converged)

    @property
    def p_values(self) -> dict[str, dict[str, float]]:
        """p-values of the possible discrepancy tests, by row of the prediction."""
        table = self.drawn.prediction.table.select_dtypes("number")
        return {
            str(row): {str(c): float(v) for c, v in values.items() if pd.notna(v)} for row, values in table.iterrows()
        }

    def line(self) -> dict[str, Any]:
        """Return the stored results of a replicate."""
        return {
            "right": not self.wrong,
            "named": self.named,
            "warned": self.warned,
            "converged": self.converged,
            "wrong": self.wrong,
            "verdicts": self.verdicts,
            "numbers": numbers(self),
            "seconds": round(self.seconds, 2),
        }


def examine(name: str, data_seed: int, sampler_seed: int, *, drawless: bool = False) -> Outcome:
    """Return the verdicts on the data of one seed, sampled with another seed, without draws if the case allows it."""
    start, case = time.perf_counter(), CASES[name]()
    problem = case.problem(data_seed)
    fit = bp.map_estimate(problem, progress=False)
    if drawless and case.drawless:
        found = bp.identifiability(problem, fit)
        return Outcome(case, problem, fit, found, None, time.perf_counter() - start)
    posterior = bp.sample(problem, fit, seed=sampler_seed, progress=False, **case.sampling)
    found = bp.identifiability(problem, fit, posterior)
    drawn = Drawn(posterior, bp.compare(problem, fit, posterior), bp.predict(problem, posterior))
    return Outcome(case, problem, fit, found, drawn, time.perf_counter() - start)


def numbers(outcome: Outcome) -> dict[str, Any]:
    """Return the numbers behind the verdicts; those with a Monte Carlo error as pairs (value, error)."""
    table = outcome.identifiability.table
    found: dict[str, Any] = {
        str(name): {"contraction": _pair(row, "contraction")} | _signed(row) for name, row in table.iterrows()
    }
    if outcome.sampled is None:
        return found
    comparison = outcome.sampled.comparison
    for name, row in comparison.table.iterrows():
        found[str(name)] |= {column: _pair(row, column) for column in ("shift", "sd_ratio", "skewness", "wasserstein")}
    found["joint"] = {key: _pair(comparison.joint, key) for key in ("share_50", "share_90", "share_95", "pareto_k")}
    found["joint"]["importance_efficiency"] = float(f"{float(comparison.joint['efficiency']):.5g}")
    return found


def _signed(row: pd.Series) -> dict[str, list[float | None]]:
    return {} if pd.isna(row["p_negative"]) else {"p_negative": _pair(row, "p_negative")}


def _pair(row: Any, column: str) -> list[float | None]:
    """Return a number and its Monte Carlo error to five digits, None if not finite."""
    pair = float(row[column]), float(row[f"{column}_mcse"])
    return [float(f"{value:.5g}") if abs(value) < float("inf") else None for value in pair]
