"""The first stage of the estimator: the noise parameters that suit given residuals best (eq. 7)."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from bayesperiodic.inference.noise.blocks import CORRELATED, SCALE
from bayesperiodic.inference.noise.likelihood import Likelihood
from bayesperiodic.inference.noise.models import FLAT, JEFFREYS, VARIANCE, Independent

LOWEST, HIGHEST = 25.0, 8.0
TINY = np.finfo(float).tiny


def estimate_noise(
    likelihood: Likelihood, residuals: Sequence[np.ndarray], start: np.ndarray, share: float
) -> np.ndarray:
    """Return the noise parameters that suit given residuals best, (names,).

    For independent errors with the prior 1/v this is eq. (7) of [1]_, v = Σe²/(n·share); otherwise it maximises the
    log-likelihood, its logarithms multiplied by `share`, plus the log-prior.

    Parameters
    ----------
    likelihood : Likelihood
    residuals : sequence of array (size,)
        One a block.
    start : array (names,)
    share : float
        1 − l/Σn for the bias correction of eq. (7), 1 for the maximum of eq. (6).

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.
    """
    values = start.copy()
    for group, members in likelihood.groups():
        if not set(group) & set(likelihood.free):
            continue
        blocks = [likelihood.blocks[b] for b in members]
        chosen = [residuals[b] for b in members]
        total = sum(block.weight * float(r @ r) for block, r in zip(blocks, chosen, strict=True))
        count = sum(block.count for block in blocks)
        plain = isinstance(likelihood.model, Independent) or all(block.kind == CORRELATED for block in blocks)
        corrected = count * share - {JEFFREYS: 0.0, FLAT: 2.0}.get(str(likelihood.model.prior), np.inf)
        columns = [likelihood.names.index(name) for name in group]
        if plain and corrected > 0.0:
            values[columns[0]] = max(total / corrected, TINY)
            continue
        held = {name: values[i] for name, i in zip(group, columns, strict=True) if name in likelihood.fixed}
        part = Likelihood(likelihood.model, blocks, held)
        values[columns] = _maximise(part, chosen, values[columns], max(total / count, TINY), share)
    return values


def _maximise(
    part: Likelihood, residuals: Sequence[np.ndarray], start: np.ndarray, size: float, share: float
) -> np.ndarray:
    """Return the best values of one group's noise parameters, from a start and from variances of the given size."""
    free = [part.names.index(name) for name in part.free]

    def complete(logarithms: np.ndarray) -> np.ndarray:
        values = start.copy()
        values[free] = np.exp(logarithms)
        return values

    def negative(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        values = complete(logarithms)
        value = float(part(residuals, values, share) + part.log_prior(values))
        if not np.isfinite(value):
            return 1e300, np.zeros(len(free))
        return -value, -part.gradients(residuals, values, share)[1][free]

    variances = [part.names[i].startswith((VARIANCE, SCALE)) for i in free]
    centre = np.where(variances, np.log(size), np.log(part.guess()[free]))
    bounds = [(c - LOWEST, c + HIGHEST) for c in centre]
    here = np.clip(np.log(start[free]), *np.transpose(bounds))
    found = minimize(
        negative,
        min((here, centre), key=lambda x: negative(x)[0]),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"gtol": 1e-9, "ftol": 1e-15, "maxiter": 500},
    )
    return complete(found.x)
