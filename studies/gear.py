"""Landing gear of eq. (9) in fourteen synthetic experiments: parameters, inputs, priors and static equilibrium."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import bayesperiodic as bp

# The scale of a nose gear: pressures of 1 to 2.3 MPa, forces to 11 kN, 0.8 mol of nitrogen.
GEAR = {
    "theta1": 80.0, "theta2": 0.0, "theta3": 8e3, "theta4": 5e-3, "theta5": 1e6 / 293, "theta6": -2.5, "theta7": 0.0,
    "theta8": 150.0, "theta9": 1e-4, "theta10": 300.0, "theta11": -500.0, "theta12": 0.0, "theta15": 17.0,
    "theta16": 2.0, "theta17": -293.0,
}  # fmt: skip
# Frequency [Hz], force amplitude about 4.5 kN [N], displacement amplitude about 0.12 m [m].
RIG = (
    (0.05, 1500, 0.080), (0.1, 1400, 0.070), (0.15, 1300, 0.060), (0.2, 1200, 0.055), (0.3, 1100, 0.048),
    (0.4, 1000, 0.041), (0.5, 900, 0.035), (0.7, 800, 0.028), (1.0, 700, 0.021), (1.4, 650, 0.015), (2.0, 600, 0.0097),
    (3.0, 600, 0.0060), (4.0, 600, 0.0040), (6.0, 600, 0.0021),
)  # fmt: skip
SAMPLES, NOISE, INPUT_NOISE = 800, 3e-3, 2e-4
CYCLES, SAMPLES_PER_CYCLE = 20, 353.275
HARMONICS = {"displacement": 40, "force": 60, "pressure": 40}
FINE = "central4"


def measured(
    model: bp.Model, truth: Mapping[str, float], runs: Any, samples: int, seed: int, scheme: str = FINE,
    harmonics: Mapping[str, int] | None = None,
) -> list[bp.Experiment]:  # fmt: skip
    """Return synthetic experiments with independent noise of 0.3 % of the range, a run being (frequency, inputs).

    With `harmonics` by channel they are recordings folded into `samples` points: 20 cycles at 353.275 samples per
    cycle, interpolated in the periodic solution, with noise of 0.02 % on inputs too.
    """
    generator, found = np.random.default_rng(seed), []
    cycle = np.arange(round(CYCLES * SAMPLES_PER_CYCLE)) / SAMPLES_PER_CYCLE
    for frequency, inputs in runs:
        points, name = len(next(iter(inputs.values()))), f"{frequency} Hz"
        solved = bp.solve_periodic(model, truth, inputs, frequency=frequency, samples=points, scheme=scheme)
        if harmonics is None:
            noisy = {c: y + NOISE * np.ptp(y) * generator.standard_normal(samples) for c, y in solved.outputs.items()}
            found.append(bp.Experiment(name, frequency, noisy, inputs, samples=samples, synthetic=True))
            continue
        noise = dict.fromkeys(inputs, INPUT_NOISE) | dict.fromkeys(solved.outputs, NOISE)
        signals = {
            name: CubicSpline(np.arange(points + 1) / points, np.append(values, values[0]), bc_type="periodic")(cycle)
            + noise[name] * np.ptp(values) * generator.standard_normal(cycle.size)
            for name, values in {**inputs, **solved.outputs}.items()
        }
        outputs, given = ({name: signals[name] for name in names} for names in (solved.outputs, inputs))
        recording = bp.Recording(cycle / frequency, outputs, given, name=name, synthetic=True)
        found.append(recording.fold(samples, harmonics=dict(harmonics)))
    return found


def gear_runs(drive: str, samples: int = SAMPLES) -> list[tuple[float, dict[str, np.ndarray]]]:
    """Return frequencies and inputs of the 14 experiments."""
    wave = np.cos(2 * np.pi * np.arange(samples) / samples)
    return [
        (frequency, {drive: 4500.0 + force * wave if drive == "force" else 0.12 + stroke * wave})
        for frequency, force, stroke in RIG
    ]


def gear_priors(free: int) -> dict[str, Any]:
    """Return priors, ties and fixed values of theta4, theta6 and theta16, or of all 15 parameters."""
    if free == 15:
        scale = GEAR | {"theta2": 9.81, "theta7": 1 / 293, "theta12": 0.1}
        return {"priors": {name: bp.Normal(value, 0.01 * abs(scale[name])) for name, value in GEAR.items()}}
    priors = {
        "theta4": bp.LogNormal(GEAR["theta4"], 1.0),
        "theta6": bp.Normal(GEAR["theta6"], 2.5),
        "theta16": bp.Normal(GEAR["theta16"], 4.0),
    }
    tied = {"theta11": "-1e5*theta4"}
    fixed = {name: value for name, value in GEAR.items() if name not in (*priors, *tied)}
    return {"priors": priors, "tied": tied, "fixed": fixed}


def gear_problem(
    drive: str, seed: int, *, free: int = 3, samples: int = SAMPLES, runs: int = 14, scheme: str = FINE,
    cut: bool = False,
) -> bp.Problem:  # fmt: skip
    """Return the problem of theta4, theta6 and theta16, or of all 15 parameters under priors.

    The experiments are mean periods with all harmonics, or with `cut` folded recordings with some. Inputs are taken as
    exact, because these problems measure the cost of densities and samplers that others have too, and variances are
    integrated out of them, which is not possible with noisy inputs.
    """
    model, inputs = bp.models.landing_gear(drive), gear_runs(drive, samples)[:runs]
    experiments = measured(model, GEAR, inputs, samples, seed, scheme, HARMONICS if cut else None)
    return bp.Problem(model, experiments, **gear_priors(free), scheme=scheme, input_noise="exact")


def gear_at_rest(experiment: bp.Experiment, p: Mapping[str, float]) -> np.ndarray:
    """Return static equilibrium under the mean input, the gas as warm as the wall."""
    wall = -p["theta17"]
    if "displacement" in experiment.inputs:
        return np.array([wall])
    mean = float(experiment.inputs["force"].mean())

    def balance(q: float) -> float:
        pressure = p["theta5"] * wall / (1.0 + p["theta6"] * q + p["theta7"] * wall)
        return p["theta4"] * pressure + p["theta11"] + p["theta1"] * p["theta2"] - mean

    return np.array([brentq(balance, -0.1, -0.99 / p["theta6"]), 0.0, wall])
