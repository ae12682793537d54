"""Frequencies of experiments as the data and the model together determine them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.covariance import estimated_inputs
from bayesperiodic.estimation.gauss_newton import Iterate
from bayesperiodic.likelihood.orbit_frequency import FREQUENCY
from bayesperiodic.periodic.solution import PeriodicSolution

if TYPE_CHECKING:
    import pandas as pd


def updated_frequencies(
    problem: Problem, estimate: Iterate, solutions: Mapping[str, PeriodicSolution], covariance: np.ndarray
) -> pd.DataFrame:
    """Return measured and estimated frequencies of experiments whose frequency is uncertain, see `MapEstimate`."""
    import pandas as pd

    likelihood, given, rows = problem.likelihood, estimated_inputs(problem, estimate).covariances, {}
    spread = np.nan_to_num(covariance, posinf=0.0)
    for e in problem.experiments:
        members = [b for b, block in enumerate(likelihood.blocks) if block.experiment == e.name]
        if not e.frequency_se > 0.0:
            continue
        if problem.model.autonomous:
            (block,) = [b for b in members if likelihood.blocks[b].channel == FREQUENCY]
            slope = estimate.here.jacobian[block][:, 0]
            sd = np.sqrt(slope @ spread @ slope)
        elif e.name in given:
            # The expected errors given θ are −S⁻¹·Lᵀ·p·r, and change by S⁻¹·Lᵀ·p·∂ŷ/∂θ.
            precisions = likelihood.precisions(members, estimate.noise)
            weighed = np.concatenate(
                [np.broadcast_to(p, likelihood.blocks[b].size) for b, p in zip(members, precisions, strict=True)]
            )
            jacobian = np.concatenate([estimate.here.jacobian[b] for b in members], axis=1)
            slope = jacobian @ (weighed * (likelihood.loadings[e.name] @ given[e.name][-1]))
            sd = np.sqrt(given[e.name][-1, -1] + slope @ spread @ slope)
        else:
            sd = 1.0
        rows[e.name] = (e.frequency, e.frequency_se, solutions[e.name].frequency, e.frequency_se * min(float(sd), 1.0))
    return pd.DataFrame.from_dict(rows, orient="index", columns=["measured", "se", "estimate", "sd"], dtype=float)
