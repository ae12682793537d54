from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.orbits.orbit import Orbits
from tests import shooting
from tests.known import LINEAR
from tests.orbits.measured import GENTLE, PENDULUM, at_rest, measured, mirrored, repeated, shifted, wrapped

WILD = [k for k in shooting.UNSTABLE if abs(k.multipliers[0]) > 50]


def polish(*orbits, parameters=PENDULUM, **changes) -> Orbits:
    return bp.polish_orbits(bp.models.pendulum, orbits, parameters, **changes)


def points(orbit) -> np.ndarray:
    """Return the section points of an orbit's solution."""
    every = orbit.solution.samples
    return wrapped(np.stack([orbit.solution.outputs[c][::every] for c in ("angle", "rate")], axis=-1))


@pytest.mark.parametrize("cycle", [True, False], ids=["whole cycle", "points alone"])
def test_polished_orbits_are_those_of_shooting(cycle):
    """At a noise of 0.1 % all are found, up to multipliers of 16,000, from points alone with their winding numbers."""
    known = [*GENTLE, *WILD]
    polished = polish(*(measured(k, cycle=cycle) for k in known))
    assert not polished.rejected and len(polished) == len(known)
    for orbit, k in zip(polished, known, strict=True):
        off = points(orbit) - wrapped(np.array(k.section))
        assert orbit.winding == k.winding and not orbit.equilibrium
        assert np.max(np.abs(off[:, 0])) < 1e-7 and np.max(np.abs(off[:, 1])) < 1e-6
        assert orbit.solution.multipliers[0] == pytest.approx(k.multipliers[0], rel=1e-4)


def test_a_noise_of_one_per_cent_does_not_lose_the_gentle_orbits():
    polished = polish(*(measured(k, noise=0.01, seed=3) for k in GENTLE), samples=400)
    assert len(polished) == len(GENTLE) == 9
    found = [orbit.solution.multipliers[0].real for orbit in polished]
    assert found == pytest.approx([k.multipliers[0].real for k in GENTLE], rel=1e-4)


def test_points_too_rough_for_the_nearest_winding_lead_to_the_one_that_fits():
    """At a noise of 4 % the pieces between section points miss by half a turn; all orbits of period 3 are found."""
    known = [k for k in shooting.UNSTABLE if len(k.section) == 3]
    polished = polish(*(measured(k, noise=0.04, seed=1, cycle=False) for k in known), samples=400)
    assert [orbit.winding for orbit in polished] == [k.winding for k in known]
    found = [orbit.solution.multipliers[0].real for orbit in polished]
    assert found == pytest.approx([k.multipliers[0].real for k in known], rel=1e-3)


def test_a_cycle_tells_the_winding_that_was_not_counted():
    known = GENTLE[2]
    (orbit,) = polish(replace(measured(known), winding=None), samples=400)
    assert orbit.winding == known.winding == 4
    run = replace(measured(known), winding=None).experiment(states={"phi": "angle"})
    assert run.winding == 4


def test_a_period_gone_round_twice_is_brought_to_its_prime_period():
    """Points averaged over both rounds, their covariance halved, log|eigenvalue| halved with its sd."""
    once = measured(GENTLE[1])
    (orbit,) = polish(repeated(once, 2), samples=400)
    assert orbit.period == 2 and orbit.winding == GENTLE[1].winding and orbit.name.endswith("2 times, once round")
    assert orbit.points == pytest.approx(once.points)
    assert orbit.covariance == pytest.approx(once.covariance / 2)
    assert orbit.eigenvalues == pytest.approx(once.eigenvalues)
    assert orbit.eigenvalue_sd[0] == pytest.approx(once.eigenvalue_sd[0])
    assert len(orbit.cycle["angle"]) == len(once.cycle["angle"])


def test_the_same_orbit_is_kept_once_with_the_most_returns():
    one, two = measured(GENTLE[2]), measured(GENTLE[1])
    again = replace(shifted(one, 1), returns=31)
    polished = polish(one, two, repeated(two, 2), again, samples=400)
    assert [orbit.name for orbit in polished] == [two.name, again.name]
    reasons = dict((orbit.name, reason) for orbit, reason in polished.rejected)
    assert reasons[one.name] == f"the same orbit as {again.name!r}, shifted by 3 forcing periods"
    assert reasons[f"{two.name}, 2 times, once round"] == f"the same orbit as {two.name!r}"


def test_mirror_images_are_partners_and_a_symmetric_orbit_its_own():
    symmetric = next(k for k in GENTLE if k.multipliers[0].real == pytest.approx(24.569, abs=1e-3))
    one, lone = measured(GENTLE[1]), measured(GENTLE[3])
    polished = polish(one, lone, shifted(mirrored(one), 1), measured(symmetric), samples=400)
    assert [orbit.partner for orbit in polished] == [2, None, 0, 3]


@pytest.mark.parametrize("angle", [0.0, np.pi], ids=["hanging", "upside down"])
def test_rest_is_labelled(angle):
    (orbit,) = polish(at_rest(angle), samples=400)
    assert orbit.equilibrium and orbit.period == 1 and orbit.winding == 0
    assert np.ptp(orbit.solution.states["phi"]) < 1e-6


def test_a_candidate_that_is_no_orbit_is_not_replaced_by_one():
    """Points moved by a seventh of the attractor, on an orbit of period 1, and on one of two of the same winding."""
    one, two = measured(GENTLE[0]), measured(GENTLE[-1])
    moved = [replace(orbit, points=orbit.points + [0.0, 32.6 / 7]) for orbit in (one, two)]
    polished = polish(*moved, samples=400)
    assert len(polished) == 0
    for (orbit, reason), period in zip(polished.rejected, (1, 5), strict=True):
        assert orbit.solution is None
        assert reason.startswith(f"the solve landed on another orbit of period {period}: 'rate' at point ")


def test_a_multiplier_of_the_other_sign_is_another_orbit():
    flipped = replace(measured(GENTLE[0]), eigenvalues=np.array([1.7, 0.3]))
    polished = polish(flipped, samples=400)
    assert polished.rejected[0][1] == ("the solve landed on another orbit, of multiplier -1.706 where 1.7 was measured")
    vague = flipped.joint_covariance.copy()
    vague[2, 2] = 1.0
    assert len(polish(replace(flipped, joint_covariance=vague), samples=400)) == 1


def test_a_solve_that_fails_is_a_reason():
    k = shooting.UNSTABLE[-1]
    polished = polish(measured(k), parameters=PENDULUM | {"k3": 9e-4}, parameter_sd={"k3": 4.5e-4}, samples=400)
    assert polished.rejected[0][1] == "the periodic solve ended with 'stalled'"


def test_rough_parameters_may_move_an_orbit_by_what_their_doubt_allows():
    rough, orbit = PENDULUM | {"l": 0.31}, measured(GENTLE[0])
    assert len(polish(orbit, parameters=rough, samples=400, tolerance=1e-3)) == 0
    assert len(polish(orbit, parameters=rough, samples=400, tolerance=1e-3, parameter_sd={"l": 0.01})) == 1


def test_what_was_rejected_before_stays_rejected():
    before = Orbits((measured(GENTLE[0]),), rejected=((measured(GENTLE[1]), "too few returns"),), values=7, method="m")
    after = bp.polish_orbits(bp.models.pendulum, before, PENDULUM, samples=400)
    assert after.rejected[0][1] == "too few returns" and (after.values, after.method) == (7, "m")


def test_polished_orbits_are_saved_and_read_back(tmp_path):
    polished = polish(measured(GENTLE[0]), samples=400)
    polished.save(tmp_path / "orbits.h5")
    again = bp.load(tmp_path / "orbits.h5")
    assert again[0].solution.multipliers == pytest.approx(polished[0].solution.multipliers, rel=1e-12)
    assert again[0].experiment(samples=400).outputs["angle"][0] == polished[0].points[0, 0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": {"m": 1.0}}, "parameters: missing 'l'"),
        ({"parameter_sd": {"lenght": 1.0}}, "parameter_sd: 'lenght' is not known"),
        ({"parameter_sd": {"l": 0.0}}, r"parameter_sd\['l'\]: 0.0 is not allowed; it must be > 0"),
        ({"tolerance": 0.0}, "tolerance: 0.0 is not allowed"),
        ({"inputs": {"force": np.zeros(800)}}, "inputs: 'force' is not known"),
    ],
)
def test_bad_arguments_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        polish(measured(GENTLE[0]), **changes)


def test_models_that_do_not_fit_the_section_are_refused():
    orbit = measured(GENTLE[0])
    with pytest.raises(ValueError, match="coordinates: 'angle' is not known; allowed: 'force'"):
        bp.polish_orbits(LINEAR, [orbit], {"k": 1, "c": 1, "coulomb": 1}, inputs={"x": np.zeros(800)})
    with pytest.raises(ValueError, match="model: 'van_der_pol' is not allowed; it is autonomous"):
        bp.polish_orbits(bp.models.van_der_pol, [orbit], {"mu": 1.0, "omega": 1.0})
    with pytest.raises(ValueError, match="all must be of one section"):
        polish(orbit, replace(measured(GENTLE[1]), angles=()))
    twice = replace(orbit, coordinates=("rate", "rate"), angles=())
    with pytest.raises(
        ValueError, match=r"the states of 'pendulum', \['phi'\], must follow from them by linear equations"
    ):
        polish(twice)
