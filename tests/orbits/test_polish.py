from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.orbits import polish as polish_module
from bayesperiodic.orbits.orbit import Orbits
from bayesperiodic.periodic.equations import PeriodicEquations
from studies import shooting
from tests.known import LINEAR
from tests.pendulum import GENTLE, PENDULUM, at_rest, measured, mirrored, repeated, shifted, wrapped

WILD = [k for k in shooting.UNSTABLE if abs(k.multipliers[0]) > 50]


def polish(*orbits, parameters=PENDULUM, **changes) -> Orbits:
    return bp.polish_orbits(bp.models.pendulum, orbits, parameters, **changes)


def points(orbit) -> np.ndarray:
    """Return the section points of an orbit's solution."""
    every = orbit.solution.samples
    return wrapped(np.stack([orbit.solution.outputs[c][::every] for c in ("angle", "rate")], axis=-1))


@pytest.mark.parametrize("cycle", [True, False], ids=["whole cycle", "points alone"])
def test_polished_orbits_agree_with_shooting(cycle):
    """At a noise of 0.1 % all are found, up to multipliers of 16,000, from points alone with their winding numbers."""
    known = [*GENTLE, *WILD]
    polished = polish(*(measured(k, cycle=cycle) for k in known))
    assert not polished.rejected and len(polished) == len(known)
    for orbit, k in zip(polished, known, strict=True):
        off = points(orbit) - wrapped(np.array(k.section))
        assert orbit.winding == k.winding and not orbit.equilibrium
        assert np.max(np.abs(off[:, 0])) < 1e-7 and np.max(np.abs(off[:, 1])) < 1e-6
        assert orbit.solution.multipliers[0] == pytest.approx(k.multipliers[0], rel=1e-4)


def test_one_percent_noise_loses_no_moderately_unstable_orbit():
    polished = polish(*(measured(k, noise=0.01, seed=3) for k in GENTLE), samples=400)
    assert len(polished) == len(GENTLE) == 9
    found = [orbit.solution.multipliers[0].real for orbit in polished]
    assert found == pytest.approx([k.multipliers[0].real for k in GENTLE], rel=1e-4)


def test_the_winding_number_is_found_from_points_with_four_percent_noise():
    """At a noise of 4 % the pieces between section points miss by half a turn; all orbits of period 3 are found."""
    known = [k for k in shooting.UNSTABLE if len(k.section) == 3]
    polished = polish(*(measured(k, noise=0.04, seed=1, cycle=False) for k in known), samples=400)
    assert [orbit.winding for orbit in polished] == [k.winding for k in known]
    found = [orbit.solution.multipliers[0].real for orbit in polished]
    assert found == pytest.approx([k.multipliers[0].real for k in known], rel=1e-3)


def test_an_uncounted_winding_number_follows_from_the_cycle():
    known = GENTLE[2]
    (orbit,) = polish(replace(measured(known), winding=None), samples=400)
    assert orbit.winding == known.winding == 4
    run = replace(measured(known), winding=None).experiment(states={"phi": "angle"})
    assert run.winding == 4


def test_a_repeated_orbit_is_reduced_to_its_prime_period():
    """Points are averaged over both repetitions, their covariance is halved, log|eigenvalue| halved with its sd."""
    once = measured(GENTLE[1])
    (orbit,) = polish(repeated(once, 2), samples=400)
    assert orbit.period == 2 and orbit.winding == GENTLE[1].winding
    assert orbit.name == f"{once.name}, 2 times, reduced to period 2"
    assert orbit.points == pytest.approx(once.points)
    assert orbit.covariance == pytest.approx(once.covariance / 2)
    assert orbit.eigenvalues == pytest.approx(once.eigenvalues)
    assert orbit.eigenvalue_sd[0] == pytest.approx(once.eigenvalue_sd[0])
    assert len(orbit.cycle["angle"]) == len(once.cycle["angle"])


def test_of_equal_orbits_the_one_with_most_returns_is_kept():
    one, two = measured(GENTLE[2]), measured(GENTLE[1])
    again = replace(shifted(one, 1), returns=31)
    polished = polish(one, two, repeated(two, 2), again, samples=400)
    assert [orbit.name for orbit in polished] == [two.name, again.name]
    reasons = dict((orbit.name, reason) for orbit, reason in polished.rejected)
    assert reasons[one.name] == f"the same orbit as {again.name!r}, shifted by 3 forcing periods"
    assert reasons[f"{two.name}, 2 times, reduced to period 2"] == f"the same orbit as {two.name!r}"


def test_mirror_images_are_partners_and_a_symmetric_orbit_is_its_own():
    symmetric = next(k for k in GENTLE if k.multipliers[0].real == pytest.approx(24.569, abs=1e-3))
    one, lone = measured(GENTLE[1]), measured(GENTLE[3])
    polished = polish(one, lone, shifted(mirrored(one), 1), measured(symmetric), samples=400)
    assert [orbit.partner for orbit in polished] == [2, None, 0, 3]


@pytest.mark.parametrize("angle", [0.0, np.pi], ids=["hanging", "upside down"])
def test_states_of_rest_are_marked(angle):
    (orbit,) = polish(at_rest(angle), samples=400)
    assert orbit.equilibrium and orbit.period == 1 and orbit.winding == 0
    assert np.ptp(orbit.solution.states["phi"]) < 1e-6


def test_a_distant_solution_is_rejected():
    """Points moved by a seventh of the attractor, on an orbit of period 1, and on one of two of the same winding."""
    one, two = measured(GENTLE[0]), measured(GENTLE[-1])
    moved = [replace(orbit, points=orbit.points + [0.0, 32.6 / 7]) for orbit in (one, two)]
    polished = polish(*moved, samples=400)
    assert len(polished) == 0
    for (orbit, reason), period in zip(polished.rejected, (1, 5), strict=True):
        assert orbit.solution is None
        assert reason.startswith(f"the solution is another orbit of period {period}: 'rate' at point ")


def test_a_multiplier_of_opposite_sign_is_rejected():
    flipped = replace(measured(GENTLE[0]), eigenvalues=np.array([1.7, 0.3]))
    polished = polish(flipped, samples=400)
    assert polished.rejected[0][1] == ("the solution is another orbit: its multiplier is -1.706, the measured one 1.7")
    vague = flipped.joint_covariance.copy()
    vague[2, 2] = 1.0
    assert len(polish(replace(flipped, joint_covariance=vague), samples=400)) == 1


def test_a_failed_solve_is_the_reason_for_rejection():
    k = shooting.UNSTABLE[-1]
    polished = polish(measured(k), parameters=PENDULUM | {"k3": 9e-4}, parameter_sd={"k3": 4.5e-4}, samples=400)
    assert polished.rejected[0][1] == "the periodic solve ended with 'stalled'"


def test_parameter_uncertainty_widens_the_accepted_distance():
    rough, orbit = PENDULUM | {"l": 0.31}, measured(GENTLE[0])
    assert len(polish(orbit, parameters=rough, samples=400, tolerance=1e-3)) == 0
    assert len(polish(orbit, parameters=rough, samples=400, tolerance=1e-3, parameter_sd={"l": 0.01})) == 1


def test_earlier_rejections_are_kept():
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
        ({"parameters": {"m": 1.0}}, "parameters: must have .*got no 'l'"),
        ({"parameter_sd": {"lenght": 1.0}}, "parameter_sd: must be .*got 'lenght'"),
        ({"parameter_sd": {"l": 0.0}}, r"parameter_sd\['l'\]: must be > 0, got 0.0"),
        ({"tolerance": 0.0}, "tolerance: must be .*got 0.0"),
        ({"inputs": {"force": np.zeros(800)}}, "inputs: must be .*got 'force'"),
    ],
)
def test_invalid_arguments_raise(changes, message):
    with pytest.raises(ValueError, match=message):
        polish(measured(GENTLE[0]), **changes)


def phases_of(unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return states and rates from coordinates x and ẋ + 1000·x², and those of a circle of the size `unit`."""
    model = bp.Model(
        "curved", states=["x"], inputs=["u"], parameters=["c"], outputs={"x": "x", "bent": "dx + 1000*x**2"},
        equations=["ddx + c*dx + x - u"],
    )  # fmt: skip
    tau = np.arange(20) / 20
    phases = unit * np.stack([np.cos(2 * np.pi * tau), np.sin(2 * np.pi * tau)], axis=-1)
    values = phases + 1000.0 * phases[:, :1] ** 2 * [0.0, 1.0]
    equations = PeriodicEquations.build(model, {"u": np.zeros(20)}, frequency=1.0, samples=20, scheme="fourier")
    polisher = SimpleNamespace(model=model, samples=1, theta=np.array([0.1]))
    orbit = SimpleNamespace(coordinates=("x", "bent"))
    return polish_module._Polisher._phases(polisher, orbit, equations, values, rates=True), phases


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_curved_coordinates_are_refused(unit):
    with pytest.raises(ValueError, match="must determine the states and rates of 'curved', .*, by linear equations"):
        phases_of(unit)


@pytest.mark.parametrize("unit", [1e-10, 1e-13])
def test_coordinates_that_are_not_curved_at_the_size_of_the_orbit_determine_it(unit):
    """The curvature is 1000·unit of them."""
    phases, exact = phases_of(unit)
    assert phases == pytest.approx(exact, abs=3e3 * unit**2)


def test_models_that_do_not_match_the_section_raise():
    orbit = measured(GENTLE[0])
    with pytest.raises(ValueError, match="coordinates: must be 'force', got 'angle'"):
        bp.polish_orbits(LINEAR, [orbit], {"k": 1, "c": 1, "coulomb": 1}, inputs={"x": np.zeros(800)})
    with pytest.raises(ValueError, match="model: must be a forced one, got 'van_der_pol'"):
        bp.polish_orbits(bp.models.van_der_pol, [orbit], {"mu": 1.0, "omega": 1.0})
    with pytest.raises(ValueError, match="orbits: must be of one section"):
        polish(orbit, replace(measured(GENTLE[1]), angles=()))
    twice = replace(orbit, coordinates=("rate", "rate"), angles=())
    with pytest.raises(ValueError, match=r"must determine the states of 'pendulum', \['phi'\], by linear equations"):
        polish(twice)
