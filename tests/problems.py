"""Problems with every kind of observation, shared by the tests of densities, gradients, samplers and predictions."""

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
DELAY = {"shift": bp.Normal(0.0, 0.1)}
POINTS = np.arange(SAMPLES) % 20 == 3
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
    """Return the rotation's section point with covariance and, by default, its unstable multiplier."""
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


def duffing(*experiments: bp.Experiment, **changes) -> bp.Problem:
    arguments = {"priors": DUFFING_PRIORS, "fixed": {"m": 1.0}}
    return bp.Problem(bp.models.duffing, experiments, **(arguments | changes))


# Name -> problem and a point θ.
CASES = {
    "every sample": lambda: (duffing(duffing_run()), [0.21, 1.02, 0.48]),
    "harmonics kept, tied": lambda: (
        duffing(
            duffing_run(harmonics={"displacement": 7}),
            priors={"c": bp.LogNormal(0.2, 0.3), "k": bp.Normal(1.0, 0.3)},
            tied={"k3": "0.5*k**2"},
        ),
        [0.21, 1.02],
    ),
    "circulant": lambda: (
        duffing(duffing_run(harmonics={"displacement": 9}), noise="circulant"),
        [0.21, 1.02, 0.48],
    ),
    "measured": lambda: (
        duffing(duffing_run(scatter={"displacement": 0.2}, cycles=9), noise="measured"),
        [0.21, 1.02, 0.48],
    ),
    "local and delayed": lambda: (
        duffing(
            duffing_run(),
            duffing_run("run 2", 0.13, seed=2),
            priors=DUFFING_PRIORS | DELAY,
            local=["c"],
            noise=bp.noise.Independent(per="experiment"),
        ),
        [0.21, 0.19, 1.02, 0.48, 0.05, -0.03],
    ),
    "angle of a rotation": lambda: (pendulum_problem([pendulum_run()]), [0.301, 4.6e-4]),
    "delayed angle": lambda: (
        pendulum_problem([pendulum_run()], priors=PENDULUM_PRIORS | DELAY),
        [0.301, 4.6e-4, 0.02],
    ),
    "section and multiplier": lambda: (
        pendulum_problem([section_run()], noise=bp.noise.Independent(prior=bp.InverseGamma(3.0, 2.0))),
        [0.301, 4.6e-4],
    ),
    "masked, correlated": lambda: (
        pendulum_problem([pendulum_run(mask=POINTS, multipliers=[-1.75], multiplier_sd=[0.1])], noise="circulant"),
        [0.301, 4.6e-4],
    ),
    "autonomous": lambda: (
        bp.Problem(
            bp.models.van_der_pol,
            [cycle_run()],
            priors={"mu": bp.LogNormal(1.5, 0.3), "omega": bp.Normal(1.0, 0.2)},
            scheme="central4",
        ),
        [1.52, 1.003, 0.05],
    ),
}


C2 = 0.3


@cache
def quadratic_damping() -> tuple[bp.Problem, bp.MapEstimate]:
    """Return three synthetic recordings of a Duffing oscillator with C2·ẋ·|ẋ|, and the estimate without that term."""
    model = bp.Model(
        "duffing_with_quadratic_damping", states=["x"], inputs=["force"], parameters=["m", "c", "k", "k3", "c2"],
        equations=lambda s, p, u: [
            p.m * s.ddx + p.c * s.dx + p.c2 * s.dx * abs(s.dx) + p.k * s.x + p.k3 * s.x**3 - u.force
        ],
        outputs=lambda s, p, u: {"displacement": s.x},
    )  # fmt: skip
    runs = []
    for number, (frequency, size) in enumerate(((0.12, 0.6), (0.17, 1.0), (0.22, 1.4))):
        recording = bp.simulate(
            model, DUFFING | {"c2": C2}, {"force": size * np.cos(2 * np.pi * grid(64))}, frequency=frequency,
            duration=24 / frequency, sampling_rate=40 * frequency, noise={"displacement": 0.002}, seed=number,
        ).between(12 / frequency, 24 / frequency)  # fmt: skip
        runs.append(replace(recording.fold(64), name=f"run {number}"))
    priors = DUFFING_PRIORS | {"c": bp.LogNormal(0.4, 1.0)}
    problem = bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1.0}, scheme="fourier")
    return problem, bp.map_estimate(problem, progress=False)
