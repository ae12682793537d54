"""Interleaved timing, gains of several cores, and the error of a gradient.

Every action runs once in each repeat; ratios are taken by repeat, and medians and ranges are reported.
"""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numba
import numpy as np

import bayesperiodic as bp

STEP = 0.05
LOOP = 5_000_000


def gradient_error(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> float:
    """Return the error of the gradient relative to its largest component, against five-point differences.

    Components and steps are in standard deviations of one parameter given the others; the differences are of the
    problem anchored at θ.
    """
    sd = _conditional_sd(warm, theta, noise)
    given = warm.gradient(theta, noise)[: theta.size] * sd
    shifts = np.concatenate([np.diag(k * STEP * sd) for k in (-2.0, -1.0, 1.0, 2.0)])
    two, one, minus_one, minus_two = warm.anchored(theta).log_posterior(theta - shifts, noise).reshape(4, -1)
    differences = (minus_two - 8.0 * minus_one + 8.0 * one - two) / (12.0 * STEP)
    return float(np.abs(given - differences).max() / np.abs(given).max())


def _conditional_sd(warm: bp.Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    changes = warm.likelihood.whitened(warm.density().linearise(theta).jacobian, noise)
    information = sum((own**2).sum(axis=-1) for own in changes)
    return 1.0 / np.sqrt(information + np.diag(warm.joint_prior.curvature(theta)))


class Action(NamedTuple):
    """A timed action."""

    run: Callable[[], Any]  # Returns its own seconds as a float, or anything else to be timed from outside
    of: int = 1  # Number of log-posteriors per run
    most: int = 10_000  # Largest number of repeats


def interleaved(actions: Mapping[str, Action], repeats: int) -> dict[str, np.ndarray]:
    """Return seconds (repeats,) per log-posterior of each action, NaN in omitted repeats.

    A first round, which fills caches, is not counted for actions that are repeated more than once.
    """
    found = {name: np.full(repeats, np.nan) for name in actions}
    for repeat in range(-1, repeats):
        for name, action in actions.items():
            if repeat >= action.most or (repeat < 0 and action.most == 1):
                continue
            own, seconds = timed(action.run)
            if repeat >= 0:
                found[name][repeat] = (own if isinstance(own, float) else seconds) / action.of
    return found


def timed(action: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> tuple[Any, float]:
    """Return the result of an action and its seconds."""
    before = clock()
    result = action()
    return result, clock() - before


def spread(values: np.ndarray) -> dict[str, float]:
    """Return median, least and largest of the finite values."""
    there = values[np.isfinite(values)]
    return {"median": float(np.median(there)), "least": float(there.min()), "largest": float(there.max())}


def slope(sizes: Any, values: Any) -> float:
    """Return the exponent of a power law fitted by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def gain_of_cores(call: Callable[[int], Any], cores: int, repeats: int) -> dict[str, Any]:
    """Compare the gain of all cores on a call, which takes the number of threads, with that on a plain loop.

    The plain loop is compiled, needs no memory, and runs once per core. All four are timed in turn within every repeat.
    """
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(plain_loop, [10] * cores))
        times = interleaved({
            "one": Action(lambda: call(1)),
            "many": Action(lambda: call(cores)),
            "loop_one": Action(lambda: [plain_loop(LOOP) for _ in range(cores)]),
            "loop_many": Action(lambda: list(pool.map(plain_loop, [LOOP] * cores))),
        }, repeats)  # fmt: skip
    gains, plain = times["one"] / times["many"], times["loop_one"] / times["loop_many"]
    return {
        "gain": float(np.median(gains)),
        "plain": float(np.median(plain)),
        "ratio": float(np.median(gains / plain)),
        "ratio_quartiles": np.quantile(gains / plain, [0.25, 0.75]).tolist(),
        "milliseconds": float(np.median(times["one"])) * 1e3,
    }


@numba.njit(nogil=True)
def plain_loop(count: int) -> float:
    """Return the result of `count` dependent divisions."""
    total = 0.0
    for k in range(count):
        total += 1.0 / (1.0 + k * total)
    return total
