"""Stable and unstable cycles of the flutter rig at one wind speed are never confused."""

from functools import cache

import numpy as np

import bayesperiodic as bp
from bayesperiodic.periodic.arclength import ARRIVED
from bayesperiodic.periodic.batch import phase_bordered
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT
from studies.flutter.reference import RIG, SENSORS, hopf

SPEED, SAMPLES = 15.0, 16
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


def test_stable_and_unstable_cycles_are_never_confused():
    """Draws with an sd of 12 %, half with the fold above 15 m/s; checked by continuation and by multipliers."""
    stated, generator = problem(), np.random.default_rng(1)
    theta = np.array([RIG[name] for name in stated.names]) * np.exp(0.12 * generator.standard_normal((600, len(FREE))))
    solver = stated.density().solver
    solved = solver.solve(theta)
    statuses = np.array([solved.statuses(name) for name in KINDS])
    stable, unstable = (np.ptp(solved.response(name).outputs[..., 1], axis=1) for name in KINDS)
    assert set(np.unique(statuses)) == {CONVERGED, OTHER_ORBIT}
    both = np.all(statuses == CONVERGED, axis=0)
    assert 200 < both.sum() < 400 and np.all(unstable[both] < 0.99 * stable[both])
    for i in (*np.flatnonzero(both)[:5], *np.flatnonzero(~both)[:15]):
        for name, kind in KINDS.items():
            ending = solver.path_outcome(theta[i], name)
            assert (ending == ARRIVED) == (solved.statuses(name)[i] == CONVERGED), ending
            if ending == ARRIVED:
                alone = solver.solve(theta[i : i + 1], keep=True)
                assert (solver.largest_multipliers(theta[i : i + 1], name, alone)[0] < 1.0) == kind


def test_determinant_changes_sign_between_cycles_on_both_sides_of_a_fold():
    """The unstable cycle has one more real multiplier above 1, so that the determinant has the other sign."""
    stated = problem()
    parameters = np.array([(RIG | SENSORS | {"U": SPEED})[n] for n in bp.models.flutter.parameters])
    found = []
    for name, cycle in cycles().items():
        z = np.stack([cycle.states[state] for state in bp.models.flutter.states], axis=-1)
        equations = stated.equations[name].at_frequency(cycle.frequency)
        found.append(phase_bordered(equations, parameters, z).orientation)
    assert found[0] * found[1] == -1.0


def test_log_likelihood_without_a_cycle_is_minus_infinity():
    """At this c_alpha the equilibrium is stable up to 19 m/s, and the fold is above 15."""
    theta = {name: RIG[name] for name in FREE} | {"c_alpha": 1.5 * RIG["c_alpha"]}
    assert hopf(RIG | {"c_alpha": theta["c_alpha"]})[0] > 19.0
    assert problem().log_likelihood(theta, {"heave": 1.0, "pitch": 1.0}) == -np.inf
    assert np.isfinite(problem().log_likelihood({n: RIG[n] for n in FREE}, {"heave": 1.0, "pitch": 1.0}))
