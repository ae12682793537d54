"""The noise parameters that fit given residuals best."""

from collections.abc import Sequence

import numpy as np

from bayesperiodic._linalg import TINY
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.noise import FLAT_PRIOR, JEFFREYS, VARIANCE, Independent
from bayesperiodic.likelihood.section_points import SCALE

LOWEST_LOG_SCALE, HIGHEST_LOG_SCALE = 25.0, 8.0
# The same for variances beside errors of the inputs, where smaller ones make the linearisation ill-conditioned.
LOWEST_BESIDE_INPUTS = 14.0
# Distance from the end of a prior's support, in logarithms.
WITHIN = 1e-12
# Difference of log-densities that is none.
FLAT = 1e-11
# Shapes of a spectrum that are tried between two quantiles of their priors, of its first parameter and of any other.
TRIED_FIRST, TRIED_OTHERS, TRIED_TAIL = 25, 3, 5e-4
TRIED_VARIANCES = np.linspace(-6.0, 6.0, 13)  # logarithms of factors
SMALLER_VARIANCE = 0.2


def estimate_noise(
    likelihood: Likelihood,
    residuals: Sequence[np.ndarray],
    start: np.ndarray,
    log_variance_factor: float | np.ndarray,
    *,
    of_total: bool = False,
    all_shapes: bool = False,
) -> np.ndarray:
    """Return the noise parameters (names,) that fit residuals best, one array (size,) a block, from a start.

    The optimum is that near the start, with `all_shapes` the best one from shapes of the whole support of their priors.
    For independent errors with the prior 1/v this is eq. (7) of [1]_, v = Σe²/(n·f) with the factor f; otherwise it
    maximises the log-likelihood, its logarithms multiplied by f as in `Likelihood.__call__`, plus the log-prior. For
    `of_total` see `Likelihood.log_prior`.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.
    """
    if likelihood.shared and likelihood.free:
        without = Likelihood(likelihood.model, likelihood.blocks, likelihood.fixed)
        centre = estimate_noise(without, residuals, start, log_variance_factor)
        best = _maximise(likelihood, residuals, start, centre, log_variance_factor, of_total)
        return _best_of(likelihood, residuals, best, centre, log_variance_factor, of_total) if all_shapes else best
    values, moments = start.copy(), likelihood.moments(residuals)
    for group, members in likelihood.groups():
        if not set(group) & set(likelihood.free):
            continue
        blocks = [likelihood.blocks[b] for b in members]
        factor = float(np.broadcast_to(log_variance_factor, len(residuals))[members[0]])
        chosen = [residuals[b] for b in members]
        count = sum(block.count for block in blocks)
        plain = isinstance(likelihood.model, Independent) or not any(block.timed for block in blocks)
        corrected = count * factor - {JEFFREYS: 0.0, FLAT_PRIOR: 2.0}.get(str(likelihood.model.prior), np.inf)
        columns = [likelihood.names.index(name) for name in group]
        if plain and corrected > 0.0:
            values[columns[0]] = max(float(moments[group[0]]) / corrected, TINY)
            continue
        held = {name: values[i] for name, i in zip(group, columns, strict=True) if name in likelihood.fixed}
        part = Likelihood(likelihood.model, blocks, held)
        units = [likelihood.model.unit(block) for block in blocks]
        total = sum(b.weight * float(r @ r) / unit for b, r, unit in zip(blocks, chosen, units, strict=True))
        size = np.where([name.startswith((VARIANCE, SCALE)) for name in group], max(total / count, TINY), part.guess())
        values[columns] = _maximise(part, chosen, values[columns], size, factor, of_total)
        if all_shapes:
            values[columns] = _best_of(part, chosen, values[columns], size, factor, of_total)
    return values


def _best_of(
    part: Likelihood,
    residuals: Sequence[np.ndarray],
    near: np.ndarray,
    centre: np.ndarray,
    log_variance_factor: float | np.ndarray,
    of_total: bool,
) -> np.ndarray:
    """Return the best of the noise parameters (names,) near a start and of those from a grid of shapes.

    The grid is over the shape of one group of blocks after the other. The variance at each shape is the best of a list
    without errors of the inputs, which would be costly, or a smaller one, as of such errors.
    """

    def density(values: np.ndarray, likelihood: Likelihood = part) -> np.ndarray:
        prior = likelihood.log_prior(values, of_total=of_total)
        return np.asarray(likelihood(residuals, values, log_variance_factor) + prior)

    best, plain = near, Likelihood(part.model, part.blocks, part.fixed)
    for group, members in part.groups():
        free = [k for k, name in enumerate(part.names) if name in group and name in part.free]
        kinds = {k: part.names[k].partition("[")[0] for k in free}
        shaped = [k for k in free if kinds[k] in part.model.shape_priors]
        scales = [k for k in free if k not in shaped]
        if not shaped or not all(part.blocks[b].spectral for b in members):
            continue
        axes: list[np.ndarray] = []
        for k in shaped:
            ends = np.log(part.model.shape_priors[kinds[k]].quantile(np.array([TRIED_TAIL, 1.0 - TRIED_TAIL])))
            axes.append(np.exp(np.linspace(ends[0], ends[1], TRIED_OTHERS if axes else TRIED_FIRST)))
        shapes = np.tile(best, (TRIED_FIRST * TRIED_OTHERS ** (len(shaped) - 1), 1))
        shapes[:, shaped] = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=-1)
        several = np.repeat(shapes[None], len(TRIED_VARIANCES), axis=0)
        several[..., scales] = centre[scales] * np.exp(TRIED_VARIANCES)[:, None, None]
        chosen = np.argmax([density(each, plain) for each in several], axis=0)
        tried = several[chosen, np.arange(len(shapes))]
        if part.shared:
            smaller = tried.copy()
            smaller[:, scales] *= SMALLER_VARIANCE
            tried = np.concatenate([tried, smaller])
        there = _maximise(part, residuals, tried[np.argmax(density(tried))], centre, log_variance_factor, of_total)
        best = max(best, there, key=density)
    return best


def log_supports(likelihood: Likelihood) -> np.ndarray:
    """Return the ends of the priors' supports of the logarithms of the free noise parameters, (free, 2)."""
    kinds = [VARIANCE if name.startswith(SCALE) else name.partition("[")[0] for name in likelihood.free]
    with np.errstate(divide="ignore"):
        return np.log(np.reshape([likelihood.model.support(kind) for kind in kinds], (-1, 2)))


def _maximise(
    part: Likelihood,
    residuals: Sequence[np.ndarray],
    start: np.ndarray,
    centre: np.ndarray,
    log_variance_factor: float | np.ndarray,
    of_total: bool,
) -> np.ndarray:
    """Return the best noise parameters (names,) from a start and from a centre, within bounds about the centre."""
    from scipy.optimize import minimize

    free = [part.names.index(name) for name in part.free]

    def complete(logarithms: np.ndarray) -> np.ndarray:
        values = start.copy()
        values[free] = np.exp(logarithms)
        return values

    def negative(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        values = complete(logarithms)
        value, _, slopes = part.value_and_gradients(residuals, values, log_variance_factor, of_total=of_total)
        value += float(part.log_prior(values, of_total=of_total))
        return (-value, -slopes[free]) if np.isfinite(value) else (1e300, np.zeros(len(free)))

    middle = np.log(centre[free])
    lowest = LOWEST_BESIDE_INPUTS if part.shared else LOWEST_LOG_SCALE
    ends = log_supports(part)
    # Rounding must not leave the support.
    ends += np.where(np.isfinite(ends), [WITHIN, -WITHIN], 0.0)
    middle = np.clip(middle, *ends.T)
    bounds = list(np.clip(np.stack([middle - lowest, middle + HIGHEST_LOG_SCALE], axis=1), *ends.T[..., None]))
    here = np.clip(np.log(start[free]), *np.transpose(bounds))
    optimum = minimize(
        negative,
        min((here, middle), key=lambda x: negative(x)[0]),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"gtol": 1e-9, "ftol": 1e-15, "maxiter": 500},
    )
    # The density of a variance that is added to known ones is flat towards zero, where the search ends anywhere.
    zero = np.array([low for low, _ in bounds])
    return complete(zero if of_total and negative(zero)[0] <= optimum.fun + FLAT else optimum.x)
