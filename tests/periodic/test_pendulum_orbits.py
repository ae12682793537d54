import numpy as np
import pytest

import bayesperiodic as bp
from studies import shooting
from tests.known import grid
from tests.pendulum import PENDULUM, ROTATIONS, TURN, pendulum_solution, rates_and_angles

LONG = [k for k in shooting.UNSTABLE if len(k.section) in (3, 5) and abs(k.multipliers[0]) > 100]
IDS = [f"period {len(k.section)}, winding {k.winding}, multiplier {k.multipliers[0]:.0f}" for k in LONG]


def disturbed(known: shooting.Known, angle: np.ndarray) -> np.ndarray:
    """Return an angle off by up to 0.1 rad (6 degrees)."""
    return angle + 0.1 * np.sin(2 * np.pi * 3 * grid(len(angle)) + 1)


@pytest.mark.parametrize("known", ROTATIONS, ids=lambda k: f"multiplier {k.multipliers[0]:.3f}")
@pytest.mark.parametrize(("scheme", "multipliers", "angle"), [("central2", 1e-5, 1e-5), ("central4", 1e-8, 1e-9)])
def test_unstable_rotations_have_the_multipliers_and_the_path_of_shooting(known, scheme, multipliers, angle):
    path = rates_and_angles(known, 800)
    solution = pendulum_solution(known, 800, scheme, disturbed(known, path[:, 0]))
    assert solution.converged and not solution.stable
    assert solution.multipliers == pytest.approx(np.array(known.multipliers), rel=multipliers)
    assert solution.states["phi"] == pytest.approx(path[:, 0], abs=angle)
    assert solution.outputs["rate"] == pytest.approx(path[:, 1], abs=20 * angle)
    assert solution.states["phi"][0] == pytest.approx(known.section[0][0], abs=angle)


def test_unstable_rotations_are_the_published_ones():
    found = [pendulum_solution(k, 400, "central4") for k in ROTATIONS]
    published = [
        ((-1.7059004086, -0.3021074361), (-0.5676231, 13.8571218)),
        ((11.1190767960, 0.0463496393), (-2.9184347, 5.8256325)),
    ]
    for solution, (multipliers, section) in zip(found, published, strict=True):
        assert solution.multipliers == pytest.approx(np.array(multipliers), rel=1e-8)
        assert (solution.states["phi"][0], solution.outputs["rate"][0]) == pytest.approx(section, abs=1e-7)


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("known", LONG, ids=IDS)
def test_orbits_of_periods_three_and_five_agree_with_shooting(known):
    path = rates_and_angles(known, 800)
    solution = pendulum_solution(known, 800, "central4", disturbed(known, path[:, 0]))
    assert solution.converged and not solution.stable
    assert solution.period == pytest.approx(len(known.section) * 2 * np.pi / 9.09)
    assert solution.states["phi"] == pytest.approx(path[:, 0], abs=2e-8)
    section = np.stack([solution.states["phi"], solution.outputs["rate"]], axis=-1)[::800]
    assert section == pytest.approx(np.array(known.section), abs=1e-6)
    assert solution.multipliers == pytest.approx(np.array(known.multipliers), rel=1e-5)


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("known", LONG, ids=IDS)
def test_orbits_of_periods_three_and_five_converge_with_the_backward_scheme(known):
    path = rates_and_angles(known, 800)
    solution = pendulum_solution(known, 800, "backward2", disturbed(known, path[:, 0]))
    assert solution.converged
    error = np.abs(solution.states["phi"] - path[:, 0]).max()
    assert 1e-6 < error < 1e-4
    assert solution.error_estimate()["phi"] == pytest.approx(error, rel=0.05)
    assert solution.multipliers == pytest.approx(np.array(known.multipliers), rel=1e-3)


@pytest.mark.parametrize(
    ("scheme", "samples"), [("central2", 200), ("backward2", 400), ("central4", 200), ("fourier", 12)]
)
@pytest.mark.parametrize("known", ROTATIONS, ids=lambda k: f"multiplier {k.multipliers[0]:.3f}")
def test_error_estimate_is_the_error_of_an_unstable_rotation(known, scheme, samples):
    solution = pendulum_solution(known, samples, scheme)
    error = np.abs(solution.states["phi"] - rates_and_angles(known, samples)[:, 0]).max()
    assert solution.error_estimate()["phi"] == pytest.approx(error, rel=0.1)


def test_stable_orbits_of_periods_one_two_and_four_are_stable():
    for known, tolerance in zip(shooting.STABLE[1:], (5e-8, 1e-6), strict=True):
        solution = pendulum_solution(known, 400, "central4")
        assert solution.stable
        assert solution.multipliers == pytest.approx(np.array(known.multipliers), rel=tolerance)
    locked = pendulum_solution(shooting.STABLE[0], 400, "central4")
    assert locked.stable
    expected = np.sort_complex(np.array(shooting.STABLE[0].multipliers))
    assert np.sort_complex(locked.multipliers) == pytest.approx(expected, rel=1e-8)


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("known", [ROTATIONS[1], LONG[0]], ids=["period 1", "period 3"])
def test_mirrored_orbit_turns_the_other_way_with_the_same_multipliers(known):
    angle = disturbed(known, rates_and_angles(known, 400)[:, 0])
    one = pendulum_solution(known, 400, "central4", angle)
    other = pendulum_solution(known, 400, "central4", -angle, winding=-known.winding)
    assert other.winding == {"phi": -known.winding}
    assert other.states["phi"] == pytest.approx(-one.states["phi"], abs=1e-9)
    assert other.multipliers == pytest.approx(one.multipliers, rel=1e-9)


def test_solution_keeps_whole_turns_of_the_guess():
    known = ROTATIONS[0]
    angle = rates_and_angles(known, 400)[:, 0] + 6 * np.pi
    solution = pendulum_solution(known, 400, "central4", angle)
    assert solution.states["phi"] == pytest.approx(angle, abs=1e-7)


def test_period_two_guess_that_ends_on_the_period_one_orbit_has_status_other_orbit():
    """At 11.9 rad/s, above the first doubling, no orbit of period 2 is near the rotation."""
    once = pendulum_solution(shooting.DOUBLINGS[0]._replace(omega=11.9), 200, "central4")
    assert once.converged
    tau = np.arange(400) / 200
    tiled = np.concatenate([once.states["phi"], once.states["phi"] + TURN])
    twice = {"frequency": once.frequency, "samples": 200, "scheme": "central4", "periods": 2, "winding": 2}
    guess = {"phi": tiled + 0.05 * np.cos(np.pi * tau)}
    ended = bp.solve_periodic(bp.models.pendulum, PENDULUM, **twice, guess=guess)
    assert ended.states["phi"] == pytest.approx(tiled, abs=1e-8)
    assert ended.status == "other orbit"
    assert not ended.converged and ended.multipliers.size == 0 and ended.sensitivities == {}
    # From a guess of period 1 the same orbit converges, with squared multipliers.
    asked = bp.solve_periodic(bp.models.pendulum, PENDULUM, **twice, guess={"phi": tiled})
    assert asked.converged
    assert np.sort_complex(asked.multipliers) == pytest.approx(np.sort_complex(once.multipliers**2), rel=1e-6)


def test_period_four_guess_that_ends_on_the_period_one_orbit_has_status_other_orbit():
    once = pendulum_solution(shooting.DOUBLINGS[0]._replace(omega=11.9), 200, "central4")
    tau = np.arange(800) / 200
    tiled = np.tile(once.states["phi"] - TURN * once.tau, 4) + TURN * tau
    ended = bp.solve_periodic(
        bp.models.pendulum,
        PENDULUM,
        frequency=once.frequency,
        samples=200,
        scheme="central4",
        periods=4,
        winding=4,
        guess={"phi": tiled + 0.05 * np.cos(np.pi * tau)},
    )
    assert ended.states["phi"] == pytest.approx(tiled, abs=1e-8)
    assert ended.status == "other orbit"


def test_period_two_orbit_is_not_mistaken_for_a_repetition():
    known = shooting.STABLE[1]
    solution = pendulum_solution(known, 200, "central4", disturbed(known, rates_and_angles(known, 200)[:, 0]))
    assert solution.converged
    half = solution.states["phi"][200:] - solution.states["phi"][:200] - TURN
    assert np.abs(half).max() > 0.1


def test_saved_orbit_is_read_back_completely(tmp_path):
    solution = pendulum_solution(ROTATIONS[1], 200, "central4")
    solution.save(tmp_path / "orbit.h5")
    again = bp.load(tmp_path / "orbit.h5")
    assert again.multipliers.tolist() == solution.multipliers.tolist()
    assert again.error_estimate() == solution.error_estimate()
    assert again.stable == solution.stable and again.winding == solution.winding
    by_parameter = bp.multiplier_sensitivities(bp.models.pendulum, solution)
    for name, values in bp.multiplier_sensitivities(bp.models.pendulum, again).items():
        assert values.tolist() == by_parameter[name].tolist()
    restarted = bp.solve_periodic(
        bp.models.pendulum,
        PENDULUM,
        frequency=again.frequency,
        samples=200,
        scheme=again.scheme,
        winding=again.winding,
        guess=again,
    )
    assert restarted.converged and restarted.iterations <= 1
