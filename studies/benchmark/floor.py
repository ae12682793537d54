"""Time of a log-posterior and its stages, relative to a lower bound (the floor).

The floor is one compiled evaluation of residual and Jacobian, and LAPACK's factorisation and solve of the same band
matrix, for each experiment with its own matrix. Restoring the matrices between passes is not timed.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import emcee
import numpy as np
from scipy.linalg import lapack

import bayesperiodic as bp
from studies.benchmark.problems import SCHEMES, Setting
from studies.gear import gear_priors
from studies.solver.cost import lapack_band
from studies.timing import Action, gradient_error, interleaved, spread

WALKERS = 64
COPIED = 64 * 2**20
EMCEE_STEPS = 200
SWEEP, FACTOR, SOLVE = "sweep", "dgbtrf", "dgbtrs"
ALL_FREE = "gradient, 15 parameters"
STAGES = ("priors", "periodic solves, sums of squares", "likelihood", "the rest of the call")


def measure(setting: Setting, repeats: int) -> dict[str, Any]:
    """Return floor, stages and their ratios, by scheme."""
    found = {scheme: _of_scheme(setting, scheme, repeats) for scheme in SCHEMES}
    return {"schemes": found, "bandwidth_gb_per_s": bandwidth(repeats), "emcee_us": emcee_overhead(setting, repeats)}


def measure_folded(setting: Setting, repeats: int) -> dict[str, Any]:
    """Return floor and ratios with folded recordings, by scheme."""
    found = {}
    for scheme in SCHEMES:
        warm = setting.schemed(scheme)
        calls = _call_actions(warm, setting.near, setting.noise)
        found[scheme] = _ratios(interleaved(floor_actions(warm, setting.estimate)[0] | calls, repeats), calls)
    return {"schemes": found}


def _of_scheme(setting: Setting, scheme: str, repeats: int) -> dict[str, Any]:
    warm, noise, theta, near = setting.schemed(scheme), setting.noise, setting.theta, setting.near
    actions, size = floor_actions(warm, setting.estimate)
    all_free, at = with_all_free(setting, scheme)
    stages = _stages(warm, near, noise)
    calls = _call_actions(warm, near, noise)
    calls["far"] = Action(partial(walk, warm, theta[len(near) :], noise), len(theta) - len(near))
    calls[ALL_FREE] = Action(partial(gradients, all_free, at[None], noise))
    times = interleaved(actions | calls | stages, repeats)
    *parts, whole = (float(np.nanmedian(times[name])) * 1e6 for name in stages)
    return _ratios(times, calls) | {
        "stages_us": dict(zip(STAGES, [*parts, whole - sum(parts)], strict=True)),
        "bytes": size,
        "same_grid_error": same_grid_error(setting, warm),
        "gradient_error": {
            "gradient": gradient_error(warm, theta[0], noise), ALL_FREE: gradient_error(all_free, at, noise)
        },
    }  # fmt: skip


def floor_actions(warm: bp.Problem, theta: np.ndarray) -> tuple[dict[str, Action], int]:
    """Return the parts of the floor with the matrices of all experiments at θ, and the bytes that they move.

    A factorisation reads and writes the matrices, a solve reads them.
    """
    sweeps: list[Callable[[], Any]] = []
    bands: list[np.ndarray] = []
    solutions = warm.solve(theta)
    for name, equations in warm.equations.items():
        p = warm.parameters(theta[None], name)[0]
        z = np.stack(list(solutions[name].states.values()), axis=-1)
        columns = equations.residual_jacobian(z, p)
        arguments = equations.states(z), equations.inputs, p, equations.grid.tau, equations.frequency, columns
        sweeps.append(partial(equations.model.kernels.residual_jacobian, *arguments))
        band, lower = lapack_band(equations, columns)
        bands.append(band)
    generator = np.random.default_rng(1)
    rights = [generator.standard_normal(band.shape[1]) for band in bands]
    work = [np.array(band, order="F") for band in bands]
    pivots: list[np.ndarray] = []

    def sweep() -> None:
        for one in sweeps:
            one()

    def factor() -> float:
        for target, band in zip(work, bands, strict=True):
            target[:] = band
        before = time.perf_counter()
        pivots[:] = [lapack.dgbtrf(one, lower, lower, overwrite_ab=True)[1] for one in work]
        return time.perf_counter() - before

    def solve() -> float:
        copies = [np.array(right) for right in rights]
        before = time.perf_counter()
        for factors, own, right in zip(work, pivots, copies, strict=True):
            lapack.dgbtrs(factors, lower, lower, right, own, overwrite_b=True)
        return time.perf_counter() - before

    return {SWEEP: Action(sweep), FACTOR: Action(factor), SOLVE: Action(solve)}, 3 * sum(band.nbytes for band in bands)


def _call_actions(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> dict[str, Action]:
    many = np.resize(theta, (WALKERS, theta.shape[1]))
    return {
        "near": Action(partial(walk, warm, theta, noise), len(theta)),
        "call": Action(partial(call, warm, theta, noise), len(theta)),
        "batched": Action(partial(warm.log_posterior, many, noise), WALKERS),
        "gradient": Action(partial(gradients, warm, theta[:1], noise)),
    }


def _ratios(times: Mapping[str, np.ndarray], names: Iterable[str]) -> dict[str, Any]:
    parts = {name: times[name] for name in (SWEEP, FACTOR, SOLVE)}
    under = np.sum(list(parts.values()), axis=0)
    return {
        "floor_us": {name: spread(1e6 * values) for name, values in (parts | {"sum": under}).items()},
        "us": {name: spread(1e6 * times[name]) for name in names},
        "ratio": {name: spread(times[name] / under) for name in names},
    }


def with_all_free(setting: Setting, scheme: str) -> tuple[bp.Problem, np.ndarray]:
    """Return the problem of all 15 parameters, anchored at the estimate of the three, and these at the first draw."""
    stated = setting.problem
    other = bp.Problem(stated.model, stated.experiments, **gear_priors(15), scheme=scheme, input_noise="exact")
    both = stated.parameters(np.stack([setting.estimate, setting.theta[0]]), stated.experiments[0].name)
    estimate, at = (other.vector(dict(zip(stated.model.parameters, row, strict=True))) for row in both)
    return other.anchored(estimate), at


def walk(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> None:
    """Compute log-posteriors one by one on one core."""
    for one in theta:
        warm.log_prior(one) + warm.log_likelihood(one, noise, 1)


def call(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> None:
    """Compute log-posteriors one by one on all cores."""
    for one in theta:
        warm.log_posterior(one, noise)


def gradients(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> None:
    """Compute values and gradients one by one."""
    for one in theta:
        warm.value_and_gradient(one, noise)


def _stages(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> dict[str, Action]:
    density, points = warm.density(), [one[None] for one in theta]

    def compared(one: np.ndarray) -> Any:
        return density.comparisons.residuals(density.solver.solve(one, 1))

    residuals = [compared(one) for one in points]
    runs: tuple[Callable[[], Any], ...] = (
        lambda: [warm.log_prior(one) for one in theta],
        lambda: [compared(one) for one in points],
        lambda: [warm.likelihood(one, noise[None]) for one in residuals],
        lambda: walk(warm, theta, noise),
    )
    return {f"stage {number}": Action(run, len(theta)) for number, run in enumerate(runs)}


def same_grid_error(setting: Setting, warm: bp.Problem) -> float:
    """Return the largest difference at any draw from solves on the same grid that are anchored at the draw itself."""
    converged = [warm.anchored(theta).log_posterior(theta, setting.noise) for theta in setting.theta]
    return float(np.max(np.abs(warm.log_posterior(setting.theta, setting.noise) - np.array(converged))))


def bandwidth(repeats: int) -> dict[str, float]:
    """Return the memory bandwidth of one core in a copy [GB/s]."""
    source = np.ones(COPIED // 8)
    target = np.empty_like(source)
    times = interleaved({"copy": Action(lambda: np.copyto(target, source))}, repeats)["copy"]
    return spread(2e-9 * COPIED / times)


def emcee_overhead(setting: Setting, repeats: int) -> dict[str, float]:
    """Return emcee's own time per log-posterior [µs], measured with a trivial density."""
    size = len(setting.problem.names)
    start = np.random.default_rng(1).standard_normal((WALKERS, size))

    def run() -> None:
        sampler = emcee.EnsembleSampler(WALKERS, size, lambda x: np.zeros(len(x)), vectorize=True)
        sampler.run_mcmc(start, EMCEE_STEPS)

    times = interleaved({"emcee": Action(run, WALKERS * EMCEE_STEPS)}, max(3, repeats // 3))["emcee"]
    return spread(1e6 * times)
