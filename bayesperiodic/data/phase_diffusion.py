"""Random walk of an oscillation's phase: its variance per cycle, and what it adds to the error of the frequency."""

from typing import NamedTuple

import numpy as np
from scipy.special import softmax

# Cycles from which a random walk is looked for.
FEWEST_PHASES = 8
# Variances of the walk's step that are tried, so many of them, by what they contribute to the variance of the slope
# relative to the noise of one cycle; and the gain in ln L that shows a walk, with false alarms in about 1 %.
STEP_RANGE, STEPS_TRIED, LEAST_GAIN = (1e-1, 1e6), 60, 2.0


class Diffusion(NamedTuple):
    """Random walk of the phases of successive cycles, and their independent noise."""

    step: float  # variance of the walk's step in a cycle [cycles²]
    slopes: np.ndarray  # (orders,), variances of the coefficients of orthonormal polynomials in the phases [cycles²]


def phase_diffusion(phase: np.ndarray, basis: np.ndarray, least: float) -> Diffusion | None:
    """Return the random walk that phases (cycles,) show, mean values over a cycle each; None without evidence of one.

    The differences of successive phases have a tridiagonal covariance, which the discrete sine transform diagonalises:
    with the step's variance q and the noise's v, its eigenvalues are q (2 + cos ω)/3 + 2 v (1 − cos ω). The likelihood
    is that of the differences without their mean and linear trend (restricted likelihood). With equal probabilities v
    is `least`, that of the samples' white noise, or its maximum above; the result is the mean over q/v, with a prior
    flat in its logarithm. `basis` (orders, cycles) are the polynomials.
    """
    from scipy.fft import dst

    differences = np.diff(phase)
    count = differences.size
    if phase.size < FEWEST_PHASES:
        return None
    walked = np.cumsum(basis[:, ::-1], axis=1)[:, ::-1]
    # A step moves all later phases; means over a cycle have a sixth of it less, each on its own.
    spread = np.sum(walked**2, axis=1) - np.sum(basis**2, axis=1) / 6.0
    ratios = np.concatenate([[0.0], np.geomspace(*STEP_RANGE, STEPS_TRIED) / spread[1]])
    cosine = np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
    known = np.stack([np.ones(count), np.linspace(-1.0, 1.0, count)])
    moved, known = dst(differences, type=1, norm="ortho"), dst(known, type=1, norm="ortho")
    size = ratios[:, None] * (2.0 + cosine) / 3.0 + 2.0 * (1.0 - cosine)
    gram = np.einsum("an,rn,bn->rab", known, 1.0 / size, known)
    pull = (moved / size) @ known.T
    square = np.sum(moved**2 / size, axis=1) - np.sum(pull * np.linalg.solve(gram, pull[..., None])[..., 0], axis=1)
    freedom = count - len(known)
    noise = np.stack([np.maximum(square / freedom, least), np.full(ratios.size, least)])
    logarithm = freedom * np.log(noise) + square / noise + np.sum(np.log(size), axis=1) + np.linalg.slogdet(gram)[1]
    gain = -0.5 * (logarithm - logarithm[0, 0])[:, 1:]
    if gain.max() < LEAST_GAIN:
        return None
    share = softmax(gain)
    step = float(np.sum(share * noise[:, 1:] * ratios[1:]))
    return Diffusion(step, np.sum(share * noise[:, 1:]) + step * spread)
