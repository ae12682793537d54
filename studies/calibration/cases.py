"""The problems whose intervals the calibration study counts; of their recordings only the settings are used.

Every truth is drawn from the priors, so these are problems and not results: parameters of the size of the measured
magneto-rheological damper, a hardening Duffing oscillator below its resonance, and eq. (9) of the landing gear with the
displacement given. Noise is white, with the variance of the folded mean drawn from its prior too.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesperiodic as bp

CYCLES = 10
OVERCOUNT = 1.25


def damper() -> bp.Problem:
    """Return the problem of the damper: Dahl friction, 0.5 mm at 8 Hz, force measured to some newtons."""
    run = _run("8 Hz 0.5 mm", 8.0, {"displacement": (0.0, 5e-4)}, {"force": 20}, 256)
    priors = {"Kx": bp.LogNormal(800.0, 0.2), "Kw": bp.LogNormal(60.0, 0.2), "rho": bp.LogNormal(2.8e4, 0.3)}
    return _problem(bp.models.dahl, run, priors, {"K": 0.0, "F0": 0.0}, 3.0**2)


def miscounted() -> bp.Problem:
    """Return that of the Duffing oscillator with a likelihood that counts a quarter more independent values.

    The displacement is measured so well, to 0.02 mm, that the priors hardly matter.
    """
    return duffing(2e-5, OVERCOUNT)


def duffing(sd: float = 1e-4, overcount: float = 1.0) -> bp.Problem:
    """Return the problem of the Duffing oscillator: 10 N at 5 Hz, displacement measured to a tenth of a millimetre."""
    run = _run("5 Hz 10 N", 5.0, {"force": (0.0, 10.0)}, {"displacement": 10}, 64, overcount)
    priors = {"c": bp.LogNormal(1.2, 0.3), "k": bp.LogNormal(900.0, 0.1), "k3": bp.LogNormal(4e5, 0.4)}
    return _problem(bp.models.duffing, run, priors, {"m": 0.45}, sd**2)


def landing_gear() -> bp.Problem:
    """Return the problem of the landing gear: 80 mm about 120 mm at 0.2 Hz, force and pressure measured.

    Both variances have the same prior, one in N², the other in Pa²: about 50 N of 10 kN and 50 Pa of 2 MPa.
    """
    run = _run("0.2 Hz 80 mm", 0.2, {"displacement": (0.12, 0.08)}, {"force": 30, "pressure": 15}, 128)
    priors = {
        "theta4": bp.LogNormal(5.2e-3, 0.1),
        "theta6": bp.Normal(-2.3, 0.15),
        "theta16": bp.LogNormal(2.0, 0.5),
    }
    fixed = {
        "theta1": 80.0, "theta2": 0.0, "theta3": 8e3, "theta5": 1e6 / 293, "theta7": 0.0, "theta8": 150.0,
        "theta9": 1e-4, "theta10": 300.0, "theta12": 0.0, "theta15": 17.0, "theta17": -293.0,
    }  # fmt: skip
    return bp.Problem(
        bp.models.landing_gear("displacement"),
        [run],
        priors=priors,
        fixed=fixed,
        tied={"theta11": "-1e5*theta4"},
        noise=bp.noise.Independent(prior=bp.LogNormal(50.0**2, 0.5)),
        scheme="central4",
    )


def _problem(model: bp.Model, run: bp.Experiment, priors: Any, fixed: Any, variance: float) -> bp.Problem:
    noise = bp.noise.Independent(prior=bp.LogNormal(variance, 0.5))
    return bp.Problem(model, [run], priors=priors, fixed=fixed, noise=noise, scheme="central4")


def _run(
    name: str,
    frequency: float,
    inputs: dict[str, tuple[float, float]],
    harmonics: dict[str, int],
    samples: int,
    overcount: float = 1.0,
) -> bp.Experiment:
    """Return an experiment's settings, with the mean and the amplitude of each input; its outputs are never used."""
    wave = np.sin(2 * np.pi * np.arange(samples) / samples)
    return bp.Experiment(
        name,
        frequency,
        {channel: wave for channel in harmonics},
        {channel: mean + amplitude * wave for channel, (mean, amplitude) in inputs.items()},
        samples=samples,
        cycles=CYCLES,
        harmonics=harmonics | dict.fromkeys(inputs, 1),
        independent={channel: round(overcount * (2 * kept + 1)) for channel, kept in harmonics.items()},
        synthetic=True,
    )
