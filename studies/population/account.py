"""Entries of results.json on a population."""

from typing import Any

import bayesperiodic as bp


def account(result: bp.Population) -> dict[str, Any]:
    """Return the entries of results.json for a population."""
    return {
        "summary": result.summary().to_dict("index"),
        "evidence": result.evidence.to_dict("index"),
        "verdicts": result.verdicts,
        "remarks": result.remarks,
        "largest_pareto_k": float(result.units["pareto_k"].max()),
        "calls": result.calls,
        "unit_calls": result.unit_calls,
        "converged": result.converged,
    }
