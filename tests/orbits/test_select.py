from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.orbits.polish import orbit_information
from studies import shooting
from tests.pendulum import GENTLE, PENDULUM, at_rest, measured, mirrored, section_problem


@pytest.fixture(scope="module")
def polished() -> bp.Orbits:
    wild = next(k for k in shooting.UNSTABLE if abs(k.multipliers[0]) > 100)
    orbits = [*(measured(k) for k in GENTLE), at_rest(), measured(wild)]
    return bp.polish_orbits(bp.models.pendulum, orbits, PENDULUM, samples=400)


def test_the_information_is_the_inverse_covariance_of_the_estimate(polished):
    """Over a flat prior and at scale 1, relative to the values: the Laplace covariance of the same orbit alone."""
    orbit, names = polished[2], ["l", "k3"]
    problem = section_problem([orbit.experiment(samples=400)], *names)
    at = problem.density().linearise(np.array([PENDULUM[name] for name in names]))
    changes = np.concatenate(problem.likelihood.whitened(at.jacobian, np.ones(1)), axis=1)
    expected = changes @ changes.T * np.outer([0.3, 4.5e-4], [0.3, 4.5e-4])
    assert orbit_information(orbit, names) == pytest.approx(expected, rel=1e-5)


def test_an_eigenvalue_adds_information(polished):
    orbit = polished[2]
    more = orbit_information(orbit, ["l", "k3"], bp.models.pendulum) - orbit_information(orbit, ["l", "k3"])
    mu = orbit.solution.multipliers
    by = bp.multiplier_sensitivities(bp.models.pendulum, orbit.solution)
    slopes = np.array([0.3 * by["l"][0] / mu[0], 4.5e-4 * by["k3"][0] / mu[0]]).real
    assert more == pytest.approx(np.outer(slopes, slopes) / 0.02**2, rel=1e-9)


def test_unsuitable_orbits_are_left_out_with_the_reason(polished):
    doubtful = replace(polished, orbits=(replace(polished[0], quality=1e-5), *polished[1:]))
    chosen = bp.select_orbits(doubtful, ["m", "l"], least_gain=1e-9)
    reasons = {orbit.name: reason for orbit, reason in chosen.rejected}
    assert reasons[polished[0].name] == "disagrees with its returns: quality 1e-05 < 0.001"
    assert reasons["rest"] == "a state of rest"
    assert reasons[polished[-1].name].startswith("too unstable: multiplier of modulus ")
    assert [orbit.name for orbit in chosen] == [orbit.name for orbit in polished[1:9]]


def test_no_standard_deviation_rises_by_more_than_the_limit(polished):
    names = ["m", "l"]
    chosen = bp.select_orbits(polished, names, least_gain=0.05)
    left = [orbit for orbit, reason in chosen.rejected if reason.startswith("little information")]
    assert left and len(left) + len(chosen) == 9
    every = sum(orbit_information(orbit, names) for orbit in polished[:9])
    some = sum(orbit_information(orbit, names) for orbit in chosen)
    rises = np.sqrt(np.linalg.eigvals(np.linalg.solve(some, every)).real) - 1
    assert 0 < rises.max() <= 0.05
    for orbit in chosen:
        fewer = some - orbit_information(orbit, names)
        assert np.sqrt(np.linalg.eigvals(np.linalg.solve(fewer, every)).real).max() - 1 > 0.05


def test_unidentifiable_parameters_do_not_stop_the_selection(polished):
    """Of m, k1, k2 and k3 only the ratios k/m are identifiable: the information is singular."""
    assert len(bp.select_orbits(polished, ["m", "k1", "k2", "k3"])) >= 4


def test_both_partners_may_be_selected(polished):
    pair = [measured(GENTLE[1]), mirrored(measured(GENTLE[1], seed=1)), measured(GENTLE[0])]
    both = bp.polish_orbits(bp.models.pendulum, [at_rest(), *pair], PENDULUM, samples=400)
    chosen = bp.select_orbits(both, ["m", "l"], least_gain=1e-6)
    assert [orbit.partner for orbit in chosen] == [1, 0, None]


def test_invalid_arguments_raise(polished):
    with pytest.raises(ValueError, match="parameters: must be .*got 'mass'"):
        bp.select_orbits(polished, ["mass"])
    with pytest.raises(ValueError, match="largest_multiplier: must be .*got -1"):
        bp.select_orbits(polished, ["m"], largest_multiplier=-1)
    with pytest.raises(ValueError, match="orbits: must be polished, got"):
        bp.select_orbits(bp.Orbits((measured(GENTLE[0]),)), ["m"])
