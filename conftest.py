"""Objects that the examples in the docstrings use without making them.

An example gets every object below whose name it contains and does not assign. Each is made at its first use and kept
for the test run.
"""

import dataclasses
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from _pytest.doctest import DoctestItem

import bayesperiodic as bp

PENDULUM = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}


@cache
def henon_section() -> bp.PoincareSection:
    """Return 1,900 points of the Hénon map."""
    x = np.zeros((2000, 2))
    for k in range(1999):
        x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    return bp.PoincareSection.from_points(x[100:], ("x", "y"), frequency=1.0)


@cache
def pendulum_recording() -> bp.Recording:
    """Return 2,000 forcing periods of a driven pendulum in chaotic motion."""
    return bp.simulate(
        bp.models.pendulum, PENDULUM, frequency=1.4467, duration=1400, sampling_rate=60, start={"phi": 1}
    )


@cache
def pendulum_section() -> bp.PoincareSection:
    """Return the section of that recording."""
    return bp.PoincareSection.from_recording(
        pendulum_recording(), ("angle", "rate"), frequency=1.4467, angles=["angle"]
    )


@cache
def pendulum_orbits() -> bp.Orbits:
    """Return the orbits of period 1 in that recording."""
    return bp.find_orbits(pendulum_section(), periods=[1], waveforms=True)


@cache
def pendulum_problem() -> bp.Problem:
    """Return the problem of mass and length of the pendulum from two of these orbits."""
    runs = [orbit.experiment(states={"phi": "angle"}) for orbit in list(pendulum_orbits())[:2]]
    priors = {name: bp.LogNormal(PENDULUM[name], 0.1) for name in ("m", "l")}
    fixed = {name: value for name, value in PENDULUM.items() if name not in priors}
    return bp.Problem(bp.models.pendulum, runs, priors=priors, fixed=fixed)


@cache
def pendulum_fit() -> bp.MapEstimate:
    """Return the estimate of this problem."""
    return bp.map_estimate(pendulum_problem(), checks=False, progress=False)


@cache
def attractor_prediction() -> bp.AttractorPrediction:
    """Return the prediction of the recording by this estimate."""
    return bp.predict_attractor(
        pendulum_problem(), pendulum_fit(), pendulum_section(), runs=40, orbits=pendulum_orbits(), progress=False
    )


@cache
def duffing_calibration() -> bp.Calibration:
    """Return two replicates of the calibration of a stiffness."""
    force = FORCE["force"]
    run = bp.Experiment("run", 0.1, {"displacement": force}, {"force": force}, samples=32, cycles=4,
                        harmonics={"displacement": 5, "force": 5})  # fmt: skip
    fixed = {"m": 1, "c": 0.2, "k3": 0.5, "variance[displacement]": 1e-4}
    priors = {"k": bp.LogNormal(1, 0.1)}
    problem = bp.Problem(bp.models.duffing, [run], priors=priors, scheme="fourier", fixed=fixed)
    return bp.calibrate(problem, replicates=2, seed=1, max_steps=250, progress=False)


FORCE = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}


PARAMETERS = {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}


@cache
def duffing_solution() -> bp.PeriodicSolution:
    """Return the periodic response of a Duffing oscillator to one harmonic force."""
    return bp.solve_periodic(bp.models.duffing, PARAMETERS, FORCE, frequency=0.1, samples=32, scheme="fourier")


@cache
def duffing_branch() -> bp.Branch:
    """Return its frequency response from there to 0.4 Hz."""
    return bp.continue_periodic(bp.models.duffing, duffing_solution(), "frequency", until=0.4, progress=False)


@cache
def hopf_point() -> bp.HopfPoint:
    """Return where the equilibrium of van der Pol's oscillator loses its stability."""
    return bp.hopf_points(bp.models.van_der_pol, {"mu": 0.0, "omega": 6.0}, "mu", between=(-1.0, 1.5))[0]


@cache
def duffing_run() -> bp.Experiment:
    """Return its folded response from a simulation with noise."""
    recording = bp.simulate(
        bp.models.duffing, PARAMETERS, FORCE, frequency=0.1, duration=400, sampling_rate=4,
        noise={"displacement": 0.01}, seed=1,
    )  # fmt: skip
    return recording.fold(32)


@cache
def duffing_problem() -> bp.Problem:
    """Return the problem of its damping and stiffness."""
    priors = {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)}
    fixed = {"m": 1, "k3": 0.5}
    return bp.Problem(bp.models.duffing, [duffing_run()], priors=priors, fixed=fixed, scheme="fourier")


@cache
def duffing_fit() -> bp.MapEstimate:
    """Return the estimate of this problem."""
    return bp.map_estimate(duffing_problem(), progress=False)


@cache
def duffing_posterior() -> bp.Posterior:
    """Return draws of this problem."""
    return bp.sample(duffing_problem(), duffing_fit(), seed=1, ensembles=2, progress=False)


@cache
def duffing_springs() -> dict[str, tuple[bp.Problem, bp.Posterior]]:
    """Return this problem and that of a linear spring, each with draws."""
    priors = duffing_problem().priors
    linear = bp.Problem(bp.models.duffing, [duffing_run()], priors=priors, fixed={"m": 1, "k3": 0}, scheme="fourier")
    draws = bp.sample(linear, bp.map_estimate(linear, progress=False), seed=1, ensembles=2, progress=False)
    return {"cubic": (duffing_problem(), duffing_posterior()), "linear": (linear, draws)}


EXAMPLES: dict[str, Callable[[], Any]] = {
    "np": lambda: np,
    "bp": lambda: bp,
    "dataclasses": lambda: dataclasses,
    "force": lambda: FORCE,
    "solution": duffing_solution,
    "branch": duffing_branch,
    "hopf_point": hopf_point,
    "run": duffing_run,
    "problem": duffing_problem,
    "fit": duffing_fit,
    "posterior": duffing_posterior,
    "springs": duffing_springs,
    "calibration": duffing_calibration,
    "henon_section": henon_section,
    "pendulum_parameters": lambda: PENDULUM,
    "pendulum_recording": pendulum_recording,
    "pendulum_section": pendulum_section,
    "pendulum_orbits": pendulum_orbits,
    "pendulum_problem": pendulum_problem,
    "pendulum_fit": pendulum_fit,
    "attractor_prediction": attractor_prediction,
}


@pytest.fixture(autouse=True)
def example_objects(request: pytest.FixtureRequest, doctest_namespace: dict[str, Any]) -> Iterator[None]:
    """Provide the objects above that an example uses."""
    names: set[str] = set()
    if isinstance(request.node, DoctestItem) and request.node.dtest is not None:
        source = "".join(example.source for example in request.node.dtest.examples)
        assigned = set(re.findall(r"^(?:.*, )?(\w+)(?:, \w+)* = ", source, re.MULTILINE))
        names = set(re.findall(r"(?<![\w.])\w+\b(?!=)", source)) & EXAMPLES.keys() - assigned
        doctest_namespace.update({name: EXAMPLES[name]() for name in names})
    yield
    for name in names:
        del doctest_namespace[name]


@pytest.fixture(autouse=True)
def close_figures() -> Iterator[None]:
    """Close the figures of a test or an example."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
