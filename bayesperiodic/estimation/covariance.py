"""Diagnostics of an estimate: robust covariance, uncertain noise parameters, discretisation, noise of the inputs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from bayesperiodic import _fourier
from bayesperiodic._linalg import TINY, covariance_eigh, hessian_scale, scaled
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.density.responses import orbit_multipliers
from bayesperiodic.density.special_points import again_special
from bayesperiodic.estimation.gauss_newton import Iterate, information, inverse_hessian
from bayesperiodic.estimation.noise_changes import NoiseChange, changes_by_measured, changes_by_variance
from bayesperiodic.likelihood.block import Block
from bayesperiodic.likelihood.input_noise import (
    InputErrors,
    InputNoise,
    directions,
    error_waves,
    errors_of_outputs,
    expected_errors,
)
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.noise import LENGTHSCALE, VARIANCE
from bayesperiodic.likelihood.observation import Response
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.condensed import equations_for
from bayesperiodic.periodic.equations import PeriodicEquations, Sensitivities
from bayesperiodic.periodic.solution import PeriodicSolution, periodic_part
from bayesperiodic.periodic.solve import solve_driven, solve_free
from bayesperiodic.problem.model_inputs import sensor_values

# Correlation lengths tried, in response periods, and the prior probability of white noise, the alternative to them.
LENGTHSCALES = np.geomspace(1e-3, 3.0, 40)
WHITE_PROBABILITY = 0.5
SPECTRUM_ROUNDS, SETTLED_SPECTRUM = 10, 1e-3
LEAST_INFORMATION = 1e-12
# Values that the noise model's variance is worth as a prior of that of a single block; it limits how far that departs
# where the fit takes up most values of the block, as where these are no more than the parameters.
PRIOR_VALUES = 1.0
# Pairs of errors of the inputs that are tried.
INPUT_PROBES = 8
# Change of the logarithm of a variance in a difference.
VARIANCE_STEP = 1e-4


def robust_covariance(
    problem: Problem, estimate: Iterate, covariance: np.ndarray, held: np.ndarray | None = None
) -> np.ndarray:
    """Return C (J + P) C, with C the inverse of H of eq. (8), P the prior's curvature and J the scores' variance.

    J takes the variance of each Fourier component from the residual: a first-order autoregressive spectrum, or white
    noise, is fitted to it, the residual is divided by that spectrum (prewhitening, D. W. K. Andrews, J. C. Monahan,
    Econometrica 60 (1992) 953-966), and the remaining spectrum is smoothed over neighbouring harmonics. Most outputs
    depend on the low harmonics, which the fit removes from the residual. Therefore the spectrum is fitted by restricted
    likelihood (see `bias_correction`), with the parameters integrated out, J is averaged over the posterior of the
    correlation length, and raised for the few values behind each smoothed one. It is at least what the known noise of
    the inputs causes. Components that are no Fourier components keep the variance of the noise model. Parameters that
    are held at an end of their support, `held` (names,), take up nothing of the residual, whose spectrum contains what
    the end prevents them from fitting.
    """
    likelihood, prior = problem.likelihood, problem.joint_prior.curvature(estimate.theta)
    changes, residuals = (
        likelihood.whitened(vectors, estimate.noise) for vectors in (estimate.here.jacobian, estimate.here.residuals)
    )
    information = prior + sum(s @ s.T for s in changes)
    if not np.isfinite(information).all():
        return np.full_like(covariance, np.nan)
    free = np.flatnonzero(~held) if held is not None else np.arange(len(information))
    fitted, of_free = [s[free] for s in changes], information[np.ix_(free, free)]
    variances = residual_variances(likelihood, fitted, residuals, estimate.noise, of_free)
    middle = prior + sum((s * variance) @ s.T for s, variance in zip(changes, variances, strict=True))
    return covariance @ middle @ covariance


def residual_variances(
    likelihood: Likelihood,
    changes: Sequence[np.ndarray],
    residuals: Sequence[np.ndarray],
    noise: np.ndarray,
    information: np.ndarray,
) -> list[np.ndarray]:
    """Return the variances of whitened components, one array (size,) a block, as `robust_covariance` describes them.

    `changes` (parameters, size) and residuals (size,) are whitened, `information` is that of all blocks and priors.
    """
    units, known = likelihood.units(noise), []
    for block, s, r, unit, least in zip(
        likelihood.blocks, changes, residuals, units, _caused_variances(likelihood, noise), strict=True
    ):
        variance = np.ones(block.size)
        if block.spectral:
            variance = _residual_variance(block, s, r, unit, information) if r.any() else np.zeros(block.size)
        known.append(np.maximum(variance, least))
    return known


def _caused_variances(likelihood: Likelihood, noise: np.ndarray) -> list[np.ndarray]:
    """Return the variances of whitened components that the noise of the inputs causes, one array (size,) a block."""
    result = [np.zeros(block.size) for block in likelihood.blocks]
    for shared in likelihood.shared:
        vectors = [np.zeros((shared.parts[0].shape[1], block.size)) for block in likelihood.blocks]
        for b, part in zip(shared.members, shared.parts, strict=True):
            vectors[b] = part.T
        white = likelihood.whitened(vectors, noise)
        result = [variance + np.sum(moved**2, axis=0) for variance, moved in zip(result, white, strict=True)]
    return result


def _residual_variance(
    block: Block, s: np.ndarray, r: np.ndarray, unit: np.ndarray, information: np.ndarray
) -> np.ndarray:
    """Return the variance (size,) of a block's whitened residual r, averaged over the spectra that it may have.

    For every spectrum r is fitted again by least squares; the information of other blocks and the prior on θ is kept.
    The variance of the noise model counts as `PRIOR_VALUES` more values.
    """
    shape, log_prior = _shapes(block, unit)
    scale = hessian_scale(information)
    others = scaled(information - s @ s.T, scale)
    values, vectors = np.linalg.eigh(0.5 * (others + others.T))
    others = (vectors * np.maximum(values, LEAST_INFORMATION)) @ vectors.T
    s = s * scale[:, None]
    # Where the prior is not concave its pull, which balances s r, has no end: the block alone decides there.
    score = vectors @ (np.where(values > LEAST_INFORMATION, 1.0, 0.0) * (vectors.T @ (s @ r)))
    gram = (s / shape[:, None, :]) @ s.T
    pull = (r / shape) @ s.T
    size = np.ones(len(shape))
    for _ in range(SPECTRUM_ROUNDS):
        total = gram / size[:, None, None] + others
        step = np.linalg.solve(total, (pull / size[:, None] - score)[..., None])[..., 0]
        square = (r - step @ s) ** 2 / shape
        taken = np.einsum("am,gam->gm", s, np.linalg.solve(total, s / shape[:, None, :])) / size[:, None]
        # Expected squares: the independent values per component, less those removed by the fit.
        left = np.maximum(block.weight - taken, 0.0)
        before = size
        size = (square.sum(axis=1) + PRIOR_VALUES) / (left.sum(axis=1) + PRIOR_VALUES)
        if np.allclose(size, before, rtol=SETTLED_SPECTRUM, atol=0.0):
            break
    misfit = square.sum(axis=1) / size + np.einsum("ga,ab,gb->g", step, others, step) + 2.0 * step @ score
    logarithms = block.weight * np.sum(np.log(size[:, None] * shape), axis=1) + np.linalg.slogdet(total)[1]
    logarithms += PRIOR_VALUES * (np.log(size) + 1.0 / size)
    ratios = _smoothed(block, square / size[:, None], left)
    return softmax(log_prior - 0.5 * (misfit + logarithms)) @ (size[:, None] * shape * ratios)


def _shapes(block: Block, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return spectra (spectra, size) in units of the noise model, white and autoregressive, and their log-priors."""
    lengths = np.concatenate([[0.0], LENGTHSCALES])
    shape = unit**2 / (1.0 + (2 * np.pi * lengths[:, None] * block.harmonic) ** 2)
    weight = np.exp(LENGTHSCALE.log_prob(LENGTHSCALES)) * LENGTHSCALES
    weight = np.concatenate([[WHITE_PROBABILITY], (1.0 - WHITE_PROBABILITY) * weight / weight.sum()])
    return shape / shape.mean(axis=1, keepdims=True), np.log(weight)


def _smoothed(block: Block, square: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return squares over their expectation (spectra, size), smoothed over harmonics, as means of unknown variances."""
    from scipy.ndimage import convolve1d

    count = int(block.harmonic.max()) + 1
    half = int(np.ceil(np.sqrt(count)))
    window = 1.0 - (np.arange(-half, half + 1) / (half + 1.0)) ** 2
    place = (count * np.arange(len(left))[:, None] + block.harmonic).ravel()
    sums = [np.bincount(place, part.ravel(), count * len(left)).reshape(-1, count) for part in (square, left)]
    power, expected = (convolve1d(part, window, mode="constant") for part in sums)
    doubled = convolve1d(sums[1], window**2, mode="constant")
    freedom = expected**2 / np.maximum(doubled, LEAST_INFORMATION)
    ratio = (power + PRIOR_VALUES) / (expected + PRIOR_VALUES) * _excess(freedom)
    return (ratio / _excess(left.sum(axis=1, keepdims=True)))[:, block.harmonic]


def _excess(freedom: np.ndarray) -> np.ndarray:
    """Return the mean ratio ν/(ν − 2) of a variance to its estimate with ν degrees of freedom."""
    return np.maximum(freedom, 1.0) / np.maximum(freedom - 2.0, 1.0)


class VariancePart(NamedTuple):
    """Part of the covariance C of θ (names, names) that an unknown variance is responsible for.

    With F and G the `information` and `doubled` of its `NoiseChange`, `once` is C F C, `added` C G C − C F C F C.
    `left` are the values that the estimate of θ does not take up, `freedom` these and what the prior of the variance is
    worth, or what it was measured with.
    """

    once: np.ndarray
    added: np.ndarray
    left: float
    freedom: float

    @classmethod
    def of(cls, change: NoiseChange, inverse: np.ndarray, left: float, freedom: float) -> "VariancePart":
        """Return the part of a variance with this change; `inverse` is C."""
        once, twice = inverse @ change.information @ inverse, inverse @ change.doubled @ inverse
        return cls(once, twice - once @ change.information @ inverse, max(left, 1.0), freedom)


def variance_parts(
    problem: Problem, estimate: Iterate, inverse: np.ndarray, log_variance_factor: float | np.ndarray
) -> dict[str, VariancePart]:
    """Return the part of each unknown or measured variance.

    `inverse` is C, the factor what `bias_correction` returns. A measured variance has a number for a name.
    """
    likelihood, parts = problem.likelihood, {}
    changes = changes_by_variance(problem, estimate.here.jacobian, estimate.noise)
    factors = np.broadcast_to(log_variance_factor, len(likelihood.blocks))
    for (name, *_), members in likelihood.groups():
        if (change := changes.get(name)) is not None:
            left, one = change.square * float(factors[members[0]]), (change.square / change.trace) ** 2
            freedom = max(left + _worth(problem, estimate, name, one), one)
            parts[name] = VariancePart.of(change, inverse, left, freedom)
    measured = changes_by_measured(problem, estimate.here.jacobian, estimate.noise)
    for number, (change, freedom) in enumerate(measured):
        parts[str(number)] = VariancePart.of(change, inverse, freedom, freedom)
    return parts


class Uncertainty(NamedTuple):
    """Information of the data on θ, inverse of H of eq. (8), and the covariance with uncertain noise parameters."""

    information: np.ndarray  # (names, names)
    inverse: np.ndarray  # (names, names)
    lost: np.ndarray  # (names,) parameters of directions without curvature
    parts: dict[str, VariancePart]
    covariance: np.ndarray  # (names, names)


def uncertainty(problem: Problem, estimate: Iterate, log_variance_factor: float | np.ndarray) -> Uncertainty:
    """Return the uncertainty at an estimate; the factor is what `bias_correction` returns."""
    data, _ = information(problem, estimate)
    inverse, lost = inverse_hessian(data + problem.joint_prior.curvature(estimate.theta))
    parts = variance_parts(problem, estimate, inverse, log_variance_factor)
    return Uncertainty(data, inverse, lost, parts, with_uncertain_noise(problem, estimate, inverse, parts))


def degrees_of_freedom(inverse: np.ndarray, parts: Mapping[str, VariancePart]) -> np.ndarray:
    """Return the degrees of freedom of Student's t of each parameter (names,), by Satterthwaite's approximation.

    The variance of θ_i, the diagonal of C, is the sum of the parts of all unknown variances, and of what known
    variances and the prior are responsible for. An estimate from ν values has its relative uncertainty √(2/ν) (F. E.
    Satterthwaite, Biometrics Bulletin 2 (1946) 110-114).
    """
    uncertain = np.zeros(len(inverse))
    with np.errstate(divide="ignore", invalid="ignore"):
        for part in parts.values():
            uncertain += np.nan_to_num(np.diag(part.once) / np.diag(inverse)) ** 2 / part.freedom
        return 1.0 / uncertain


def _worth(problem: Problem, estimate: Iterate, variance: str, one: float) -> float:
    """Return how many values the prior of a variance is worth: 2a for InverseGamma(a, b), −2 for the flat one.

    `one` is what one value counts, less than 1 if its variance is in part known.

    It is −2 ∂²/∂(ln v)² of −½(n − p) ln v − ½ M/v + ln p(v) at its maximum, less n − p.
    """
    likelihood, noise = problem.likelihood, problem.noise
    if not noise.proper:
        return -one * noise.spare
    ends = estimate.noise[likelihood.names.index(variance)] * np.exp(np.array([-VARIANCE_STEP, VARIANCE_STEP]))
    density, slopes = noise.log_prior_of_total(VARIANCE, ends, likelihood.measured[variance])
    inside = np.isfinite(density).all()  # the end of a support holds a variance
    return -float(slopes.sum() + (slopes[1] - slopes[0]) / VARIANCE_STEP) if inside else np.inf


# Values tried of the first parameter of a spectrum's shape and of any other, between these quantiles of their priors.
MANY_SHAPES, FEW_SHAPES = 60, 9
SHAPE_TAIL = 0.005
UPDATES, JITTER = 3, 1e-12


def with_uncertain_noise(
    problem: Problem, estimate: Iterate, covariance: np.ndarray, parts: Mapping[str, VariancePart]
) -> np.ndarray:
    """Return the covariance of θ (names, names) with uncertain noise parameters, `parts` those of the variances.

    Unknown variances make the weights of the channels and of the prior uncertain, which increases the covariance by
    4 (C G C − C F C F C)/ν each (M. G. Kenward, J. H. Roger, Biometrics 53 (1997) 983-997), nothing where the values
    behind one variance determine θ alone; Student's t accounts for the rest. For unknown shapes of the spectrum θ is
    estimated again by linear least squares for shapes from the whole support of their prior. Their posterior is that of
    the restricted likelihood (see `bias_correction`), with θ integrated out; the covariance is that of the mixture
    about the estimate. The changes of the covariance by several channels are added.
    """
    groups = problem.likelihood.groups()
    shaped = [
        (names, members) for names, members in groups if _is_shaped(problem, names, members) and names[0] in parts
    ]
    if not np.all(np.diag(covariance) > 0.0):
        return covariance
    result = covariance.copy()
    for part in parts.values():
        result += 4.0 / part.freedom * _without_negative(part.added, covariance)
    if not shaped:
        return result
    fit = _with_errors(problem, estimate, covariance)
    for group, members in shaped:
        result += (
            scaled(_mixture(problem, estimate, fit, (group, members, parts[group[0]].left)), fit.scale) - covariance
        )
    return _without_negative(result, covariance)


def _without_negative(matrix: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix (names, names) in units of a covariance without its negative eigenvalues."""
    values, vectors, sd = covariance_eigh(matrix, np.sqrt(np.diag(covariance)))
    return scaled((vectors * np.maximum(values, 0.0)) @ vectors.T, sd)


def _is_shaped(problem: Problem, group: tuple[str, ...], members: list[int]) -> bool:
    """Return whether a group of unknown noise parameters, for whole periods, has others than a variance."""
    shaped = any(name.partition("[")[0] in problem.noise.shape_priors for name in group)
    spectral = all(problem.likelihood.blocks[b].spectral for b in members)
    return shaped and spectral and set(group) <= set(problem.free_noise)


class _Linear(NamedTuple):
    """Linear least squares for θ, in standard deviations (names,), together with the errors of the inputs."""

    scale: np.ndarray  # (names,)
    hessian: np.ndarray  # (names + errors, names + errors)
    changes: list[np.ndarray]  # (names + errors, size) of the predicted components, one a block
    residuals: list[np.ndarray]  # (size,) with the estimated inputs


def _with_errors(problem: Problem, estimate: Iterate, covariance: np.ndarray) -> _Linear:
    """Return the least squares whose solution, with the errors of the inputs eliminated, is the estimate."""
    likelihood, scale = problem.likelihood, np.sqrt(np.diag(covariance))
    count, first = sum(one.parts[0].shape[1] for one in likelihood.shared), scale.size
    changes = [np.pad(s * scale[:, None], ((0, count), (0, 0))) for s in estimate.here.jacobian]
    hessian = np.eye(scale.size + count)
    hessian[:first, :first] = scaled(problem.joint_prior.curvature(estimate.theta), scale)
    for one in likelihood.shared:
        last = first + one.parts[0].shape[1]
        for b, part in zip(one.members, one.parts, strict=True):
            changes[b][first:last] = part.T
        first = last
    for jacobian, precision in zip(changes, likelihood.precisions(range(len(changes)), estimate.noise), strict=True):
        hessian += (jacobian * precision) @ jacobian.T
    return _Linear(scale, hessian, changes, estimated_inputs(problem, estimate).residuals)


def _mixture(
    problem: Problem, estimate: Iterate, fit: _Linear, shaped: tuple[tuple[str, ...], list[int], float]
) -> np.ndarray:
    """Return the covariance of θ, in units of `fit`, for the mixture over one group's noise parameters, others fixed.

    `shaped` are these parameters, the indices of their blocks, and the values that determine the variance.
    """
    group, members, freedom = shaped
    likelihood, blocks = problem.likelihood, [problem.likelihood.blocks[b] for b in members]
    s = np.concatenate([fit.changes[b] for b in members], axis=1)
    r = np.concatenate([fit.residuals[b] for b in members])
    weight = np.concatenate([np.full(block.size, block.weight) for block in blocks])
    here = estimate.noise[[likelihood.names.index(name) for name in group]]
    now = weight / _spectra(problem, blocks, here)
    others = fit.hessian - (s * now) @ s.T + JITTER * np.eye(len(s))
    pull, names = -(s * now) @ r, fit.scale.size
    points, log_prior = _points(problem)
    shapes = _spectra(problem, blocks, np.column_stack([np.ones(len(points)), points]))
    precision = weight / shapes
    gram, along = np.array([(s * one) @ s.T for one in precision]), (precision * r) @ s.T
    variance = np.sum(precision * r**2, axis=1) / freedom
    for _ in range(UPDATES):
        total = gram / variance[:, None, None] + others
        step = np.linalg.solve(total, (along / variance[:, None] + pull)[..., None])[..., 0]
        square = np.sum(precision * (r - step @ s) ** 2, axis=1)
        variance = np.maximum(square / freedom, TINY)
    misfit = square / variance + np.sum((step @ others - 2.0 * pull) * step, axis=1)
    logarithms = np.sum(weight * np.log(variance[:, None] * shapes), axis=1) + np.linalg.slogdet(total)[1]
    probabilities, mean = softmax(log_prior - 0.5 * (misfit + logarithms)), step[:, :names]
    return np.tensordot(probabilities, np.linalg.inv(total)[:, :names, :names], 1) + (probabilities * mean.T) @ mean


def _spectra(problem: Problem, blocks: list[Block], values: np.ndarray) -> np.ndarray:
    """Return the variances of the components of all blocks, (…, components)."""
    every = (np.broadcast_to(problem.noise.spectrum(b, values)[0], (*values.shape[:-1], b.size)) for b in blocks)
    return np.concatenate(list(every), axis=-1)


def _points(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return shape parameters (points, parameters) spread over their priors, and their log-weights."""
    axes, weights = [], []
    for number, prior in enumerate(problem.noise.shape_priors.values()):
        ends = np.log(prior.quantile(np.array([SHAPE_TAIL, 1.0 - SHAPE_TAIL])))
        values = np.exp(np.linspace(ends[0], ends[1], MANY_SHAPES if number == 0 else FEW_SHAPES))
        axes.append(values)
        weights.append(prior.log_prob(values) + np.log(values))
    grid = np.meshgrid(*axes, indexing="ij")
    log_prior = sum(np.meshgrid(*weights, indexing="ij"))
    return np.stack([axis.ravel() for axis in grid], axis=-1), np.asarray(log_prior).ravel()


def doubling_shift(
    problem: Problem, estimate: Iterate, solutions: Mapping[str, PeriodicSolution], covariance: np.ndarray
) -> np.ndarray:
    """Return the change of the estimate on twice as many points, in sds (names,), by a Gauss-Newton step.

    NaN if a solve fails.
    """
    finer: list[np.ndarray] = []
    for e in problem.experiments:
        drive = problem.drive(e, problem.input_errors.get(e.name))
        response = _solved(problem, estimate.theta, e, solutions[e.name], drive, finer=2)
        if response is None:
            return np.full(estimate.theta.size, np.nan)
        finer += problem.observations[e.name].residuals(response)
    moved = [there - here for there, here in zip(finer, estimate.here.residuals, strict=True)]
    return _shift(problem, estimate, moved, covariance)


def _shift(problem: Problem, estimate: Iterate, moved: list[np.ndarray], covariance: np.ndarray) -> np.ndarray:
    """Return the Gauss-Newton step of θ, in sds (names,), for changes of the residuals, one array (size,) a block."""
    changes = problem.likelihood.whitened(estimate.here.jacobian, estimate.noise)
    white = problem.likelihood.whitened(moved, estimate.noise)
    right = np.sum([s @ r for s, r in zip(changes, white, strict=True)], axis=0)
    with np.errstate(invalid="ignore"):
        return covariance @ right / np.sqrt(np.diag(covariance))


def input_nonlinearity(
    problem: Problem, estimate: Iterate, solutions: Mapping[str, PeriodicSolution], covariance: np.ndarray
) -> np.ndarray:
    """Return how much of an sd each estimate is changed by what is not linear in the errors of the inputs (names,).

    The root mean square over pairs of opposite errors, normal given the estimate; NaN if one of the solves fails.
    """
    random, shifts = np.random.default_rng(0), []
    roots = {name: np.linalg.cholesky(one) for name, one in estimated_inputs(problem, estimate).covariances.items()}
    for _ in range(INPUT_PROBES if roots else 0):
        moved: list[np.ndarray] = []
        for e in problem.experiments:
            observation = problem.observations[e.name]
            here = list(estimate.here.residuals)[len(moved) :][: len(observation.blocks)]
            if e.name not in roots:
                moved += [np.zeros_like(part) for part in here]
                continue
            errors, measured = roots[e.name] @ random.standard_normal(len(roots[e.name])), problem.input_errors[e.name]
            ends = []
            for sign in (1.0, -1.0):
                other = replace(measured, expected=measured.expected + sign * errors)
                response = _solved(problem, estimate.theta, e, solutions[e.name], problem.drive(e, other))
                if response is None:
                    return np.full(estimate.theta.size, np.nan)
                ends.append(observation.residuals(response))
            moved += [0.5 * (up + down) - part for up, down, part in zip(*ends, here, strict=True)]
        shifts.append(_shift(problem, estimate, moved, covariance))
    return np.sqrt(np.mean(np.square(shifts), axis=0)) if shifts else np.zeros(estimate.theta.size)


def _solved(
    problem: Problem,
    theta: np.ndarray,
    experiment: Experiment,
    near: PeriodicSolution,
    drive: tuple[Mapping[str, np.ndarray], float],
    finer: int = 1,
) -> Response | None:
    """Return the response to inputs (points,) and frequency, solved on a finer grid, at the points.

    None if the solve fails; the frequency of an autonomous model is that of the near solution at first.
    """
    points, (inputs, frequency) = finer * experiment.samples * experiment.periods, drive
    equations = equations_for(
        problem.model,
        {n: _fourier.on_grid(_fourier.coefficients(u), points) for n, u in inputs.items()},
        frequency=near.frequency if problem.model.autonomous else frequency,
        samples=finer * experiment.samples,
        scheme=problem.scheme,
        periods=experiment.periods,
        winding=experiment.winding,
    )
    parameters, sensors = problem.parameter_maps[experiment.name].split(theta)
    if experiment.condition is not None:
        return again_special(experiment, equations, (parameters, sensors), near, finer)
    if problem.model.autonomous:
        equations, solved, _ = solve_free(equations, parameters, near)
    else:
        solved, _ = solve_driven(equations, parameters, near)
    if solved.code != CONVERGED:
        return None
    count = experiment.measured_multipliers.size
    multipliers = orbit_multipliers(equations, parameters, solved.z, count)
    outputs = equations.outputs(solved.z, parameters)[::finer]
    return Response(outputs, np.array(equations.frequency), np.log(np.abs(multipliers)), sensors)


def input_loadings(
    problem: Problem, theta: np.ndarray, solutions: Mapping[str, PeriodicSolution], noise: InputNoise
) -> dict[str, np.ndarray]:
    """Return L (components of all blocks, errors) of every experiment with errors, at its periodic solution.

    The errors are those of the inputs, and last that of the frequency, if it has one. Without experiments whose problem
    is singular.
    """
    loadings = {}
    for e in problem.experiments:
        changes, solution = directions(e, problem.model.inputs, noise), solutions[e.name]
        rates, of_frequency = np.zeros(len(changes)), problem.frequency_errors.get(e.name)
        if of_frequency is not None:
            turned = of_frequency.direction(e, problem.model.inputs)
            changes, rates = np.concatenate([changes, turned[None]]), np.append(rates, of_frequency.se)
        if not len(changes):
            continue
        for column, name in enumerate(3 * problem.model.inputs):
            changes[..., column] = problem.sensors.corrected_changes(e, name, changes[..., column])
        equations = problem.equations[e.name].at_frequency(solution.frequency)
        parameters, z = problem.parameters(theta[None], e.name)[0], periodic_part(equations, solution.states)
        moved = equations.input_sensitivities(z, parameters, changes, rates)
        if moved is not None:
            caused = predicted_changes(problem, e, equations, theta, z, moved)
            loadings[e.name] = (caused - _common(problem, e, noise)).T
    return loadings


def predicted_changes(
    problem: Problem,
    experiment: Experiment,
    equations: PeriodicEquations,
    theta: np.ndarray,
    z: np.ndarray,
    moved: Sensitivities,
) -> np.ndarray:
    """Return the changes of the predicted components of all blocks (directions, components) along sensitivities."""
    parameters, sensors = problem.parameter_maps[experiment.name].split(theta)
    count, size = experiment.measured_multipliers.size, len(moved.frequency)
    here = Response(equations.outputs(z, parameters), np.array(equations.frequency), np.empty(count), sensors)
    along = Response(moved.outputs, moved.frequency, np.zeros((size, count)), np.zeros((size, sensors.size)))
    return np.concatenate(problem.observations[experiment.name].changes(here, along), axis=1)


def _common(problem: Problem, experiment: Experiment, noise: InputNoise) -> np.ndarray:
    """Return what goes with each error of inputs and frequency in that of the outputs (errors, components)."""
    observation, of_frequency = problem.observations[experiment.name], problem.frequency_errors.get(experiment.name)
    errors = errors_of_outputs(experiment, observation.channels, noise)
    if of_frequency is not None:
        turns = np.array([of_frequency.turns[channel] for channel in observation.channels])
        errors = np.concatenate([errors, -(turns * observation.measured_rate)[None]])
    return np.concatenate(observation.errors(errors), axis=1)


def caused_by_inputs(problem: Problem, loadings: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the standard deviation that the inputs' noise causes in each channel, root mean square over experiments.

    The variance is averaged over the period.
    """
    variances: dict[str, list[float]] = {channel: [0.0] for channel in problem.channels}
    for name, every in loadings.items():
        blocks, matrix = problem.observations[name].blocks, every[:, :-1] if name in problem.frequency_errors else every
        for block, part in zip(blocks, np.split(matrix, np.cumsum([b.size for b in blocks])[:-1]), strict=True):
            if block.channel in variances:
                variances[block.channel].append(float(np.sum(np.mean(part**2, axis=0))))
    return {channel: float(np.sqrt(np.mean(v[1:] or v))) for channel, v in variances.items()}


class InputEstimate(NamedTuple):
    """Errors of the inputs given an estimate: expected ones with loadings there, and what has no errors of inputs."""

    errors: dict[str, InputErrors]
    covariances: dict[str, np.ndarray]  # (errors, errors) of the errors
    sd: dict[str, dict[str, np.ndarray]]  # (points,) of the estimated inputs, by experiment and input
    residuals: list[np.ndarray]  # components y − ŷ with the estimated inputs, one array (size,) a block


def estimated_inputs(
    problem: Problem, estimate: Iterate, loadings: Mapping[str, np.ndarray] | None = None
) -> InputEstimate:
    """Return the errors of the inputs given the estimate, by default with the loadings of the problem."""
    likelihood, errors, covariances, sd = problem.likelihood, {}, {}, {}
    residuals = list(estimate.here.residuals)
    for e in problem.experiments:
        members = [b for b, block in enumerate(likelihood.blocks) if block.experiment == e.name]
        before = problem.input_errors.get(e.name)
        if before is not None:
            sizes = [likelihood.blocks[b].size for b in members]
            for b, part in zip(members, before.parts(sizes), strict=True):
                residuals[b] = residuals[b] + part
        matrix = likelihood.loadings.get(e.name) if loadings is None else loadings.get(e.name)
        where, waves = error_waves(e, problem.input_noise)
        covariance = np.eye(len(where) + (e.name in problem.frequency_errors))
        if matrix is not None:
            expected = np.zeros(matrix.shape[1]) if before is None else before.expected
            sizes, response = [residuals[b].size for b in members], matrix + _common(problem, e, problem.input_noise).T
            moved = np.split(response @ expected, np.cumsum(sizes)[:-1])
            exact = [residuals[b] - part for b, part in zip(members, moved, strict=True)]
            precisions = likelihood.precisions(members, estimate.noise)
            expected, covariance, remaining = expected_errors(matrix, exact, precisions)
            if remaining.any():
                errors[e.name] = InputErrors(expected, remaining, response @ expected)
                covariances[e.name] = covariance
        sd[e.name] = {name: np.zeros_like(u) for name, u in e.inputs.items()}
        measured = _fourier.on_grid(waves, e.samples * e.periods)
        for name in set(where):
            mine = np.flatnonzero([owner == name for owner in where])
            signals = problem.sensors.corrected_changes(e, name, measured, sensor_values(problem, e, estimate.theta))
            sd[e.name][name] = np.sqrt(np.sum((covariance[np.ix_(mine, mine)] @ signals[mine]) * signals[mine], axis=0))
    return InputEstimate(errors, covariances, sd, residuals)
