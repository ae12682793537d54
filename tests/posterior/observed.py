"""Problems with every kind of observation, shared by the tests of the density and of its gradient."""

from dataclasses import replace
from functools import cache

import numpy as np

import bayesperiodic as bp
from studies import shooting
from tests.known import grid
from tests.pendulum import PENDULUM, pendulum_solution

SAMPLES = 200
DUFFING = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
DUFFING_PRIORS = {"c": bp.LogNormal(0.2, 0.3), "k": bp.Normal(1.0, 0.3), "k3": bp.LogNormal(0.5, 0.5)}
PENDULUM_PRIORS = {"l": bp.LogNormal(0.3, 0.05), "k3": bp.LogNormal(4.5e-4, 0.3)}
ROTATION = next(k for k in shooting.UNSTABLE if len(k.section) == 1 and abs(k.multipliers[0]) < 2)


def duffing_run(name: str = "run 1", frequency: float = 0.1, seed: int = 1, **changes) -> bp.Experiment:
    """Return a synthetic Duffing response with 1 % noise."""
    force = np.cos(2 * np.pi * grid(SAMPLES)) + 0.2 * np.sin(4 * np.pi * grid(SAMPLES))
    truth = bp.solve_periodic(bp.models.duffing, DUFFING, {"force": force}, frequency=frequency, samples=SAMPLES)
    x = truth.outputs["displacement"]
    noisy = x + 0.01 * np.ptp(x) * np.random.default_rng(seed).standard_normal(SAMPLES)
    if "harmonics" in changes:
        spectrum = np.fft.rfft(noisy)
        spectrum[changes["harmonics"]["displacement"] + 1 :] = 0.0
        noisy = np.fft.irfft(spectrum, SAMPLES)
    return bp.Experiment(name, frequency, {"displacement": noisy}, {"force": force}, samples=SAMPLES, **changes)


@cache
def rotation() -> bp.PeriodicSolution:
    """Return the pendulum's unstable rotation."""
    return pendulum_solution(ROTATION, SAMPLES, "central4")


def pendulum_run(seed: int = 1, sd: float = 0.01, **changes) -> bp.Experiment:
    """Return the rotation's angle, wrapped to (−π, π], and rate, with noise."""
    truth, generator = rotation(), np.random.default_rng(seed)
    angle = truth.outputs["angle"] + sd * generator.standard_normal(SAMPLES)
    rate = truth.outputs["rate"] + 5 * sd * generator.standard_normal(SAMPLES)
    outputs = {"angle": np.mod(angle + np.pi, 2 * np.pi) - np.pi, "rate": rate}
    arguments = {"samples": SAMPLES, "winding": ROTATION.winding, "guess": truth.states}
    return bp.Experiment("rotation", truth.frequency, outputs, **(arguments | changes))


def section_run(**changes) -> bp.Experiment:
    """Return the rotation's section point alone, with covariance and, unless unwanted, its unstable multiplier."""
    mask = np.arange(SAMPLES) % SAMPLES == 0
    covariance = np.array([[1e-4, 3e-4, 2e-4], [3e-4, 4e-3, -1e-4], [2e-4, -1e-4, 1e-2]])
    given = {"mask": mask, "covariance": covariance, "multipliers": [ROTATION.multipliers[0].real * 1.05]}
    return pendulum_run(**(given | changes))


def pendulum_problem(experiments: list[bp.Experiment], **changes) -> bp.Problem:
    """Return the problem of l and k3, the other parameters known."""
    fixed = {name: value for name, value in PENDULUM.items() if name not in PENDULUM_PRIORS}
    arguments = {"priors": PENDULUM_PRIORS, "fixed": fixed, "scheme": "central4"}
    return bp.Problem(bp.models.pendulum, experiments, **(arguments | changes))


def cycle_run(mu: float = 1.5, name: str = "cycle", turned: float = 0.2, seed: int = 3) -> bp.Experiment:
    """Return a van der Pol cycle, turned by a fraction of its period, with noise and a measured frequency."""
    truth = bp.solve_periodic(
        bp.models.van_der_pol, {"mu": mu, "omega": 1.0}, frequency=0.15, samples=SAMPLES, scheme="central4"
    )
    outputs = {}
    for channel, values in truth.outputs.items():
        spectrum = np.fft.rfft(values) * np.exp(-2j * np.pi * np.arange(SAMPLES // 2 + 1) * turned)
        noise = 0.01 * np.ptp(values) * np.random.default_rng(seed).standard_normal(SAMPLES)
        outputs[channel] = np.fft.irfft(spectrum, SAMPLES) + noise
    return bp.Experiment(
        name,
        truth.frequency * 1.0005,
        outputs,
        samples=SAMPLES,
        frequency_se=0.001 * truth.frequency,
        guess=truth.states,
    )


def named(experiment: bp.Experiment, name: str) -> bp.Experiment:
    """Return the experiment under another name."""
    return replace(experiment, name=name)
