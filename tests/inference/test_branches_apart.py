"""Stable and unstable cycles of the flutter rig at one wind speed: what is measured of one never meets the other."""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.autonomous_batch import Chord
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT
from bayesperiodic.periodic.family import Found
from tests.flutter_rig import RIG, SENSORS, hopf

SPEED, SAMPLES = 15.0, 32
FREE = ("k_alpha", "c_alpha", "c_h", "k_alpha2")
KINDS = {"stable": True, "unstable": False}


@cache
def cycles():
    values = RIG | SENSORS
    (point,) = bp.hopf_points(bp.models.flutter, values, "U", between=(5.0, 25.0))
    first = bp.emerging_cycle(bp.models.flutter, point, amplitude={"alpha": 0.01}, samples=SAMPLES, scheme="fourier")
    branch = bp.continue_periodic(bp.models.flutter, first, "U", until=14.0, step=1.0, progress=False)
    found = {s.stable: s for s in bp.solutions_at(bp.models.flutter, branch, SPEED)}
    return {name: found[stable] for name, stable in KINDS.items()}


@cache
def problem():
    experiments = [
        bp.Experiment(
            name, cycle.frequency, cycle.outputs, samples=SAMPLES, harmonics={"heave": 3, "pitch": 3},
            frequency_se=1e-3, guess=cycle.states,
        )
        for name, cycle in cycles().items()
    ]  # fmt: skip
    priors = {name: bp.LogNormal(RIG[name], 0.1) for name in FREE}
    fixed = {n: v for n, v in (RIG | SENSORS).items() if n not in FREE} | {"U": SPEED, "shift": 0.0}
    return bp.Problem(bp.models.flutter, experiments, priors=priors, fixed=fixed, scheme="fourier")


def test_neither_branch_is_ever_taken_for_the_other():
    """Draws of 12 %: half have their fold above 15 m/s and no cycle; the fate of the others is told by multipliers."""
    stated = problem()
    generator = np.random.default_rng(1)
    theta = np.array([RIG[name] for name in stated.names]) * np.exp(0.12 * generator.standard_normal((25, len(FREE))))
    lost = 0
    for name, solved in stated.responses.solve(theta).items():
        assert set(np.unique(solved.status)) <= {CONVERGED, OTHER_ORBIT}
        lost += int(np.sum(solved.status == OTHER_ORBIT))
        for i in np.flatnonzero(solved.status == CONVERGED):
            orbit = stated.anchored(theta[i]).solve(theta[i])[name]
            again = np.ptp(solved.response.outputs[i], axis=0)
            assert np.ptp(orbit.outputs["pitch"]) == pytest.approx(again[1], rel=1e-6)
            assert orbit.stable == KINDS[name]
    assert lost > 0


def test_a_fold_between_two_cycles_is_seen():
    stated = problem().anchored({name: RIG[name] for name in FREE})
    orbits = {}
    for name, cycle in cycles().items():
        z = np.stack([cycle.states[state] for state in bp.models.flutter.states], axis=-1)
        orbits[name] = Found(z, np.array([cycle.frequency]), CONVERGED, np.empty((0, 3)))
    parameters = np.array([(RIG | SENSORS | {"U": SPEED})[n] for n in bp.models.flutter.parameters])
    for name in KINDS:
        here = Chord(stated.responses.equations[name], stated.responses._anchors[name])
        assert [here.is_beyond_fold(parameters, orbits[other]) for other in KINDS] == [other != name for other in KINDS]


def test_without_a_cycle_there_is_no_posterior():
    """At this c_alpha the equilibrium is stable up to 19 m/s, and the fold is above 15."""
    theta = {name: RIG[name] for name in FREE} | {"c_alpha": 1.5 * RIG["c_alpha"]}
    assert hopf(RIG | {"c_alpha": theta["c_alpha"]})[0] > 19.0
    assert problem().log_likelihood(theta, {"heave": 1.0, "pitch": 1.0}) == -np.inf
    assert np.isfinite(problem().log_likelihood({n: RIG[n] for n in FREE}, {"heave": 1.0, "pitch": 1.0}))
