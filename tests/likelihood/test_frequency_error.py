"""The error of a measured frequency: against recordings that are folded at other frequencies, and against draws."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation.covariance import input_loadings

QUIET = {"progress": False}
STATES = ["q", "r"]
INPUTS = bp.Model(
    "input", states=STATES, inputs=["F"], parameters=["c", "k"],
    equations=["ddq + c*dq + k*q + 3*q**3 - F - 0.2*dF", "dr + 4*r - q*dq"], outputs={"q": "q + 0.1*ddq", "r": "r"},
)  # fmt: skip
EXPLICIT = bp.Model(
    "explicit", states=STATES, parameters=["c", "k"],
    equations=["ddq + c*dq + k*q + 3*q**3 - cos(2*pi*tau) - 0.3*sin(4*pi*tau)", "dr + 4*r - q*dq"],
    outputs={"q": "q + 0.1*ddq", "r": "r + 0.1*frequency*cos(2*pi*tau)"},
)  # fmt: skip
BOTH = bp.Model(
    "both", states=STATES, inputs=["F"], parameters=["c", "k"],
    equations=["ddq + c*dq + k*q + 3*q**3 - cos(2*pi*tau) - F", "dr + 4*r - q*dq"], outputs={"q": "q", "r": "r"},
)  # fmt: skip
TRUTH, FREQUENCY = {"c": 0.4, "k": 5.0}, 0.31


def force(tau):
    """Return a signal of two forcing periods."""
    return np.cos(2 * np.pi * tau - 0.4) + 0.4 * np.sin(6 * np.pi * tau) + 0.3 * np.sin(np.pi * tau)


def recorded(model: bp.Model, periods: int, starts: int, cycles: int = 12) -> list[bp.Recording]:
    """Return steady noise-free recordings that start at several phases, from a periodic solution on a fine grid."""
    samples = 256
    inputs = {name: force(np.arange(samples * periods) / samples) for name in model.inputs}
    solution = bp.solve_periodic(
        model, TRUTH, inputs, frequency=FREQUENCY, samples=samples, periods=periods, scheme="fourier"
    )
    length = periods / FREQUENCY
    recordings = []
    for start in 3.0 + length * np.arange(starts) / starts:
        time, at = start + length * np.arange(int(cycles * 41.3)) / 41.3, {}
        for name, signal in (inputs | solution.outputs).items():
            amplitudes = np.fft.rfft(signal)[:64] * 2.0 / signal.size
            amplitudes[0] *= 0.5
            at[name] = np.real(np.exp(2j * np.pi * np.multiply.outer(time / length, np.arange(64))) @ amplitudes)
        recordings.append(
            bp.Recording.from_arrays(time, {n: at[n] for n in model.outputs}, {n: at[n] for n in model.inputs})
        )
    return recordings


def folded(recording: bp.Recording, frequency: float, periods: int, origin: float) -> bp.Experiment:
    kept = {name: 9 for name in (*recording.inputs, *recording.outputs)}
    run = recording.fold(48, frequency=frequency, periods=periods, harmonics=kept, origin=origin, name="run")
    return replace(run, frequency_se=1e-5)


def residual(problem: bp.Problem, theta: dict[str, float]) -> np.ndarray:
    return np.concatenate(
        problem.anchored(theta).density(coordinates="natural").linearise(problem.vector(theta)).residuals
    )


@pytest.mark.parametrize(
    ("model", "periods", "settings"),
    [
        (INPUTS, 2, {}),
        (EXPLICIT, 1, {}),
        (BOTH, 2, {}),
        (BOTH, 2, {"fixed": {"shift": 0.3}}),
    ],
)
def test_the_direction_of_the_error_is_that_of_folding_at_other_frequencies(model, periods, settings):
    """Outside reference: the same recordings folded at f ± δ, and residuals of the model there.

    What leaks from harmonic to harmonic, by less than 1/cycles of their noise, averages out over the start phases.
    """
    # Of a common shift of all signals only what it does to the residual is left out: nothing at the true parameters.
    theta = TRUTH if model is INPUTS else {"c": 0.45, "k": 5.2}
    priors = {"c": bp.LogNormal(0.4, 1.0), "k": bp.LogNormal(5.0, 1.0)}
    step, differences, along = 2e-6 * FREQUENCY, [], []
    for recording in recorded(model, periods, starts=32):
        low, here, high = (
            bp.Problem(model, [folded(recording, frequency, periods, 8 / FREQUENCY)], priors=priors,
                       scheme="fourier", input_noise="exact", **settings)
            for frequency in (FREQUENCY - step, FREQUENCY, FREQUENCY + step)
        )  # fmt: skip
        differences.append((residual(high, theta) - residual(low, theta)) / (2.0 * step))
        at = here.vector(theta)
        solutions = here.anchored(theta).density().solver.solutions(at)
        (loadings,) = input_loadings(here, at, solutions, "exact").values()
        along.append(-loadings[:, 0] / here.experiments[0].frequency_se)
    expected = np.mean(differences, axis=0)
    assert np.mean(along, axis=0) == pytest.approx(expected, abs=1e-3 * np.abs(expected).max())
