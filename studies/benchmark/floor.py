"""Time of a log-posterior and its stages, relative to a lower bound (the floor).

The floor is one compiled evaluation of residual and Jacobian, and LAPACK's factorisation and solve of the same band
matrix, for each experiment with its own matrix. Restoring the matrices between passes is not timed.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import emcee
import numpy as np
from scipy.linalg import lapack

import bayesperiodic as bp
from studies.benchmark.problems import SCHEMES, Setting
from studies.gear import gear_priors
from studies.solver.cost import lapack_band
from studies.timing import Action, gradient_error, interleaved, ratio, spread

WALKERS = 64
COPIED = 64 * 2**20
EMCEE_STEPS = 200
SWEEP, FACTOR, SOLVE = "sweep", "dgbtrf", "dgbtrs"
ALL_FREE = "gradient, 15 parameters"
FOLDED_ROWS = ("near", "call", "batched", "gradient")
STAGES = ("priors", "periodic solves, sums of squares", "likelihood", "the rest of the call")


class Floor:
    """The matrices of all experiments at the estimate.

    `warm`: Anchored at θ. `theta` (names,).
    """

    def __init__(self, warm: bp.Problem, theta: np.ndarray):
        self._sweeps: list[Callable[[], Any]] = []
        self._bands: list[np.ndarray] = []
        generator, solutions = np.random.default_rng(1), warm.solve(theta)
        for name, equations in warm.equations.items():
            p = warm.parameters(theta[None], name)[0]
            z = np.stack(list(solutions[name].states.values()), axis=-1)
            columns = equations.residual_jacobian(z, p)
            arguments = equations.states(z), equations.inputs, p, equations.grid.tau, equations.frequency, columns
            self._sweeps.append(partial(equations.model.kernels.residual_jacobian, *arguments))
            band, self._lower = lapack_band(equations, columns)
            self._bands.append(band)
        self._right = [generator.standard_normal((1, band.shape[1]))[0] for band in self._bands]
        self._work = [np.array(band, order="F") for band in self._bands]
        self._pivots: list[np.ndarray] = []

    @property
    def bytes(self) -> int:
        """Bytes that a factorisation reads and writes, and a solve reads, over all matrices."""
        return 3 * sum(band.nbytes for band in self._bands)

    def sweep(self) -> None:
        """Fill residuals and Jacobians."""
        for one in self._sweeps:
            one()

    def factor(self) -> float:
        """Return the seconds of the factorisations."""
        for work, band in zip(self._work, self._bands, strict=True):
            work[:] = band
        before = time.perf_counter()
        self._pivots = [lapack.dgbtrf(w, self._lower, self._lower, overwrite_ab=True)[1] for w in self._work]
        return time.perf_counter() - before

    def solve(self) -> float:
        """Return the seconds of the solves with the last factors."""
        rights = [np.array(right) for right in self._right]
        before = time.perf_counter()
        for work, pivots, right in zip(self._work, self._pivots, rights, strict=True):
            lapack.dgbtrs(work, self._lower, self._lower, right, pivots, overwrite_b=True)
        return time.perf_counter() - before


def measure(setting: Setting, repeats: int) -> dict[str, Any]:
    """Return floor, stages and their ratios, by scheme."""
    found = {scheme: _of_scheme(setting, scheme, repeats) for scheme in SCHEMES}
    return {"schemes": found, "bandwidth_gb_per_s": bandwidth(repeats), "emcee_us": emcee_overhead(setting, repeats)}


def measure_folded(setting: Setting, repeats: int) -> dict[str, Any]:
    """Return floor and ratios with folded recordings, by scheme."""
    return {"schemes": {scheme: _of_folded(setting, scheme, repeats) for scheme in SCHEMES}}


def _of_folded(setting: Setting, scheme: str, repeats: int) -> dict[str, Any]:
    warm, noise, theta = setting.schemed(scheme), setting.noise, setting.theta[: len(setting.theta) // 2]
    times = interleaved(_floor_actions(Floor(warm, setting.estimate)) | _call_actions(warm, theta, noise), repeats)
    return _ratios(times, FOLDED_ROWS)


def _floor_actions(floor: Floor) -> dict[str, Action]:
    return {SWEEP: Action(floor.sweep), FACTOR: Action(floor.factor), SOLVE: Action(floor.solve)}


def _call_actions(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> dict[str, Action]:
    many = np.resize(theta, (WALKERS, theta.shape[1]))
    return {
        "near": Action(partial(_walk, warm, theta, noise), len(theta)),
        "call": Action(partial(_calls, warm, theta, noise), len(theta)),
        "batched": Action(partial(warm.log_posterior, many, noise), WALKERS),
        "gradient": Action(partial(_gradient, warm, theta[0], noise)),
    }


def _ratios(times: Mapping[str, np.ndarray], names: Sequence[str]) -> dict[str, Any]:
    under = times[SWEEP] + times[FACTOR] + times[SOLVE]
    return {
        "floor_us": {name: spread(1e6 * times[name]) for name in (SWEEP, FACTOR, SOLVE)} | {"sum": spread(1e6 * under)},
        "us": {name: spread(1e6 * times[name]) for name in names},
        "ratio": {name: ratio(times[name], under) for name in names},
    }


def _of_scheme(setting: Setting, scheme: str, repeats: int) -> dict[str, Any]:
    warm, noise, theta = setting.schemed(scheme), setting.noise, setting.theta
    floor, half = Floor(warm, setting.estimate), len(theta) // 2
    all_free, at = with_all_free(setting, scheme)
    stages = _stages(setting, warm, theta[:half])
    actions = _floor_actions(floor) | _call_actions(warm, theta[:half], noise)
    actions["far"] = Action(partial(_walk, warm, theta[half:], noise), len(theta) - half)
    actions[ALL_FREE] = Action(partial(_gradient, all_free, at, noise))
    actions |= {f"stage {name}": Action(run, half) for name, run in stages.items()}
    times = interleaved(actions, repeats)
    return _ratios(times, ("near", "far", "call", "batched", "gradient", ALL_FREE)) | {
        "stages_us": _differences({name: float(np.nanmedian(times[f"stage {name}"])) * 1e6 for name in stages}),
        "bytes": floor.bytes,
        "same_grid_error": same_grid_error(setting, warm),
        "gradient_error": {
            "gradient": gradient_error(warm, theta[0], noise), ALL_FREE: gradient_error(all_free, at, noise)
        },
    }  # fmt: skip


def with_all_free(setting: Setting, scheme: str) -> tuple[bp.Problem, np.ndarray]:
    """Return the problem of all 15 parameters, anchored at the estimate of the three, and these at the first draw."""
    stated = setting.problem
    other = bp.Problem(stated.model, stated.experiments, **gear_priors(15), scheme=scheme)
    both = stated.parameters(np.stack([setting.estimate, setting.theta[0]]), stated.experiments[0].name)
    estimate, at = (other.vector(dict(zip(stated.model.parameters, row, strict=True))) for row in both)
    return other.anchored(estimate), at


def _walk(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> None:
    """Compute log-posteriors one by one on one core."""
    for one in theta:
        warm.log_prior(one) + warm.log_likelihood(one, noise, 1)


def _calls(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> None:
    for one in theta:
        warm.log_posterior(one, noise)


def _gradient(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> None:
    warm.value_and_gradient(theta, noise)


def _stages(setting: Setting, warm: bp.Problem, theta: np.ndarray) -> dict[str, Callable[[], Any]]:
    """Return the cumulative stages of a call."""
    noise, points = setting.noise, [one[None] for one in theta]
    density = warm.density()

    def compared(one: np.ndarray) -> Any:
        return density.comparisons.residuals(density.simulator.solve(one, 1))

    residuals = [compared(one) for one in points]
    return {
        "priors": lambda: [warm.log_prior(one) for one in theta],
        "solves": lambda: [compared(one) for one in points],
        "likelihood": lambda: [warm.likelihood(one, noise[None]) for one in residuals],
        "whole": lambda: _walk(warm, theta, noise),
    }


def _differences(times: dict[str, float]) -> dict[str, float]:
    parts = [times["priors"], times["solves"], times["likelihood"]]
    parts.append(times["whole"] - sum(parts))
    return dict(zip(STAGES, parts, strict=True))


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
