"""Monte Carlo errors from the means of batches of draws."""

from __future__ import annotations

import numpy as np
from scipy import stats

import bayesperiodic as bp

BATCHES = 5


def standard_error(posterior: bp.Posterior, values: np.ndarray) -> float:
    """Return the Monte Carlo error of the mean of what was computed from the draws, (draws,) as `Posterior.draws`.

    Each ensemble, or chain of NUTS, is cut into consecutive batches. Their means know of the dependence in time, of
    walkers on each other, and of ensembles that disagree.
    """
    group = posterior.data["posterior"]
    by_chain = values.reshape(group.sizes["chain"], group.sizes["draw"])
    ensemble = group["ensemble"].to_numpy()
    means = [
        batch.mean()
        for number in np.unique(ensemble)
        for batch in np.array_split(by_chain[ensemble == number], BATCHES, axis=1)
    ]
    return float(stats.sem(means))
