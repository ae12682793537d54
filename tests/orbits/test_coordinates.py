"""Sections of more than two coordinates, delayed ones among them."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom

import bayesperiodic as bp
from bayesperiodic.orbits.cycles import eigenvalues, newton_step
from bayesperiodic.orbits.return_map import ReturnMap
from tests.orbits import harvester, wells

STATES = ("x", "y", "v")


def lines(time):
    """Return sums of incommensurate lines, known at every instant."""
    return np.sin(2 * np.pi * time) + 0.5 * np.sin(5.1 * time), np.cos(1.3 * time)


def recorded(time, noise=0.0, seed=0):
    errors = noise * np.random.default_rng(seed).standard_normal((2, time.size))
    return bp.Recording(time, dict(zip("xy", np.array(lines(time)) + errors, strict=True)), {})


def henon(points):
    """Return images and slopes of the Hénon map in three coordinates, x' = 1.76 − y² − 0.1 z, y' = x, z' = y."""
    x, y, z = points.T
    slopes = np.zeros((len(points), 3, 3))
    slopes[:, 0, 1], slopes[:, 0, 2], slopes[:, 1, 0], slopes[:, 2, 1] = -2.0 * y, -0.1, 1.0, 1.0
    return np.stack([1.76 - y**2 - 0.1 * z, x, y], axis=1), slopes


@cache
def henon_points(count):
    point, path = np.array([[0.1, 0.2, 0.0]]), []
    for _ in range(count + 100):
        point = henon(point)[0]
        path.append(point[0])
    return np.array(path[100:])


def closed_henon(guess):
    """Return the points and eigenvalues of the orbit near a guess, by Newton's method on the map."""
    points, p = np.array(guess), len(guess)
    for _ in range(20):
        image, slopes = henon(points)
        points = points + newton_by_blocks(image - np.roll(points, -1, axis=0), slopes)
    values = np.linalg.eigvals(np.linalg.multi_dot([np.eye(3), np.eye(3), *henon(points)[1][::-1]]))
    return points.reshape(p, 3), values[np.argsort(-np.abs(values))]


def newton_by_blocks(defect, slopes):
    p = len(defect)
    system = np.kron(np.eye(p), np.zeros((3, 3)))
    for j in range(p):
        k = (j + 1) % p
        system[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] += slopes[j]
        system[3 * j : 3 * j + 3, 3 * k : 3 * k + 3] -= np.eye(3)
    return -np.linalg.solve(system, defect.ravel()).reshape(p, 3)


def test_delayed_coordinates_are_the_channels_at_the_delayed_instants():
    names = ("x", "y[0.4]", "x[-0.32]", "x[-1.65]")
    section = bp.PoincareSection.from_recording(recorded(np.arange(9000) / 25.7), names, frequency=1.0, origin=0.3)
    at = section.instants
    expected = [lines(at)[0], lines(at + 0.4)[1], lines(at - 0.32)[0], lines(at - 1.65)[0]]
    np.testing.assert_allclose(section.points, np.stack(expected, axis=1), atol=2e-5)
    assert section.coordinates == names
    assert section.values == 2 * 9000
    np.testing.assert_allclose(section.cycle(20, 2)["x"], lines(at[20] + np.arange(128) / 64)[0], atol=2e-5)


def test_points_whose_delays_leave_a_stretch_are_left_out():
    time = np.arange(9000) / 23.7
    files = [recorded(time[:4000]), recorded(time[4100:])]
    section = bp.PoincareSection.from_recordings(files, ("x", "y", "x[-1.6]", "y[0.4]"), frequency=1.0)
    first, second = time[3999], time[4100]
    assert np.all((section.instants + 0.4 <= first + 1e-9) | (section.instants - 1.6 >= second - 1e-9))
    assert section.instants[0] == 2.0
    # Instants from 1.6 s before the first sample's end to 0.4 s after: whole numbers without a whole window of delays.
    between = np.arange(np.ceil(first - 0.4 + 1e-9), np.ceil(second + 1.6 - 1e-9))
    assert section.left_out == between.size
    assert np.isnan(section.increments).any(axis=1).sum() == 1


def test_values_at_a_delay_are_missing_where_it_leads_out_of_a_stretch():
    section = bp.PoincareSection.from_recording(recorded(np.arange(9000) / 25.7), ("x", "y"), frequency=1.0)
    values = section.delayed("y[-2.5]")
    assert section.instants[0] == 0.0 and np.isnan(values[:3]).all()
    np.testing.assert_allclose(values[3:], lines(section.instants[3:] - 2.5)[1], atol=2e-5)


def test_errors_of_delayed_coordinates_are_independent_and_of_the_stated_size():
    """White noise; correlations of 32,000 errors within 4.5 standard errors, false-alarm rate 2e-4 for all 24."""
    # Slow signals, for which windows would be as long as a period.
    time = np.arange(32_000 * 64) / 64
    slow = np.stack([np.sin(0.7 * time), np.cos(1.3 * time)])
    errors = 1e-3 * np.random.default_rng(1).standard_normal(slow.shape)
    noisy, clean = (bp.Recording(time, dict(zip("xy", one, strict=True)), {}) for one in (slow + errors, slow))
    names = ("x", "x[-0.125]", "x[-0.5]", "y")
    sections = [bp.PoincareSection.from_recording(one, names, frequency=1.0, origin=0.11) for one in (noisy, clean)]
    errors = sections[0].points - sections[1].points
    np.testing.assert_allclose(sections[0].noise, errors.std(axis=0), rtol=0.08)
    scaled = errors / errors.std(axis=0)
    together = scaled.T @ scaled / len(scaled) - np.eye(4)
    following = scaled[1:].T @ scaled[:-1] / len(scaled)
    assert np.abs(np.triu(together, 1)).max() < 4.5 / np.sqrt(len(scaled))
    assert np.abs(following).max() < 4.5 / np.sqrt(len(scaled))


def test_steps_evaluate_the_recording_between_the_points():
    names = ("x", "y", "x[-0.25]")
    section = bp.PoincareSection.from_recording(recorded(np.arange(29000) / 98.7), names, frequency=1.0, origin=0.3)
    points, increments, _ = section.between(3)
    at = (section.instants[:, None] + np.arange(3) / 3).ravel()[: len(section) * 3 - 2]
    expected = np.stack([lines(at)[0], lines(at)[1], lines(at - 0.25)[0]], axis=1)
    np.testing.assert_allclose(points[: len(at)], expected, atol=1e-5)
    np.testing.assert_allclose(increments[: len(at) - 1], np.diff(expected, axis=0), atol=1e-5)
    assert np.isnan(points[len(at) :]).all()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("x", "x[-0.1]"), "at least 8 samples apart modulo a period, got 2.4"),
        (("x", "x[-2]"), "at least 8 samples apart modulo a period, got 0"),
        (("x", "x[a quarter]"), r"a number in brackets, .* such as 'x\[-0.25\]', got 'x\[a quarter\]'"),
        (("x", "y[inf]"), "a number in brackets"),
        (("x", "z[-0.25]"), "coordinates: must be .*got 'z'"),
        (("y[0.4]", "y[0.4]"), "must differ"),
        (("x[-0.25]",), "two or more outputs"),
    ],
)
def test_coordinates_that_are_refused(names, message):
    with pytest.raises(ValueError, match=message):
        bp.PoincareSection.from_recording(recorded(np.arange(9000) / 23.7), names, frequency=1.0)


def test_delays_that_are_refused_elsewhere():
    recording = recorded(np.arange(9000) / 23.7)
    with pytest.raises(ValueError, match="no delays of an angle"):
        bp.PoincareSection.from_recording(recording, ("x", "y", "x[-0.25]"), frequency=1.0, angles=["x"])
    section = bp.PoincareSection.from_recording(recording, ("x", "x[-0.4]"), frequency=1.0)
    with pytest.raises(ValueError, match="modulo 1/5 of a period, got 0 .*another number of steps"):
        section.between(5)
    alone = bp.PoincareSection.from_points(henon_points(500), STATES, frequency=1.0)
    with pytest.raises(ValueError, match="steps: must be 1 for points alone"):
        bp.find_orbits(alone, periods=[1], steps=2)


def test_a_cubic_map_in_three_coordinates_is_recovered_exactly():
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 3))
    u, v, w = points.T
    image = np.stack([1.0 + u - 2.0 * v * w + w**3, u * v + 3.0 * w**2, 0.5 * v - u * v * w], axis=1)
    maps = ReturnMap(points, image - points, np.full(3, np.inf), True, np.zeros(3))
    centre = np.array([[0.2, -0.1, 0.3]])
    fit = maps.fit(centre, np.zeros(1), 200, 3)
    a, b, c = centre[0]
    slopes = [[1.0, -2.0 * c, -2.0 * b + 3.0 * c**2], [b, a, 6.0 * c], [-b * c, 0.5 - a * c, -a * b]]
    np.testing.assert_allclose(fit.jacobian[0], slopes, atol=1e-9)
    np.testing.assert_allclose(fit.hessian[0, 0], [[0, 0, 0], [0, 0, -2], [0, -2, 6 * c]], atol=1e-7)
    np.testing.assert_allclose(fit.hessian[0, 2], -np.array([[0, c, b], [c, 0, a], [b, a, 0]]), atol=1e-7)
    away = np.array([[0.1, 0.2, -0.1]])
    x, y, z = (centre + away)[0]
    exact = [1.0 + x - 2.0 * y * z + z**3, x * y + 3.0 * z**2, 0.5 * y - x * y * z]
    np.testing.assert_allclose(maps.predict(fit, away)[0], exact, atol=1e-9)


def test_newton_closes_a_linear_chain_of_four_coordinates_in_one_step():
    generator = np.random.default_rng(0)
    jacobian, points = generator.standard_normal((1, 3, 4, 4)), generator.standard_normal((3, 4))
    offsets = np.roll(points, -1, axis=0) - np.einsum("pij,pj->pi", jacobian[0], points)
    guess = points + 0.3
    defect = np.einsum("pij,pj->pi", jacobian[0], guess) + offsets - np.roll(guess, -1, axis=0)
    np.testing.assert_allclose(guess + newton_step(defect[None], jacobian)[0], points, atol=1e-12)


def test_small_eigenvalues_of_three_keep_their_digits():
    chain = np.array([[[3e4, 1.0, 2.0], [0.0, 0.3, 5.0], [0.0, 0.0, 1e-7]], np.diag([2.0, 0.1, 3e-5])])
    np.testing.assert_allclose(eigenvalues(chain), [6e4, 0.03, 3e-12], rtol=1e-12)
    turning = np.array([np.diag([5.0, 1.0, 1.0]) @ [[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]])
    np.testing.assert_allclose(np.sort_complex(eigenvalues(turning)), [0.6 - 0.8j, 0.6 + 0.8j, 5.0], rtol=1e-12)


def test_orbits_of_a_map_in_three_coordinates():
    section = bp.PoincareSection.from_points(henon_points(5000), STATES, frequency=1.0)
    orbits = bp.find_orbits(section, periods=range(1, 5))
    assert len(orbits) >= 3
    for orbit in orbits:
        points, values = closed_henon(orbit.points)
        np.testing.assert_allclose(orbit.points, points, atol=1e-6)
        np.testing.assert_allclose(orbit.eigenvalues, values, rtol=1e-4)
        # The determinant of the map is −0.1 everywhere.
        np.testing.assert_allclose(np.prod(orbit.eigenvalues).real, (-0.1) ** orbit.period, rtol=1e-3)
    assert orbits.prediction_error[0] < 1e-3
    assert {"sd[x]", "sd[y]", "sd[v]"} <= set(orbits.table)


def test_the_motion_of_the_wells_agrees_with_another_integrator():
    """The orbits of tests/orbits/wells.py close, and have their multipliers, by SciPy's DOP853."""

    def rates(time, state):
        x, y, v = state
        return [y, 0.3 * np.cos(0.8 * time) - 0.2 * y + 0.5 * x * (1 - x**2) + 0.1 * v, -0.088 * v - 0.5 * y]

    known = [one for one, returns in wells.known_orbits(1300, 2) if returns >= 3][:2]
    assert len(known) == 2
    for orbit in known:
        span = len(orbit.states) * wells.PERIOD
        starts = orbit.states[0] + np.vstack([np.zeros(3), 1e-5 * np.eye(3), -1e-5 * np.eye(3)])
        ends = [solve_ivp(rates, (0, span), one, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1] for one in starts]
        np.testing.assert_allclose(ends[0], orbit.states[0], atol=1e-7)
        slopes = np.stack([(ends[1 + k] - ends[4 + k]) / 2e-5 for k in range(3)], axis=1)
        np.testing.assert_allclose(max(np.linalg.eigvals(slopes), key=abs), orbit.multipliers[0], rtol=1e-4)


def test_coordinates_that_do_not_determine_the_next_point_are_refused_with_the_one_to_add():
    section = bp.PoincareSection.from_recordings(wells.recordings(1300, (0, 0, 0)), ("x", "v"), frequency=FREQUENCY)
    with pytest.raises(ValueError, match=r"return map, .*2 coordinates .*a delayed one, with 'x\[-0.5\]' errors are 0"):
        bp.find_orbits(section, periods=[1])
    alone = bp.PoincareSection.from_points(henon_points(2000)[:, ::2], ("x", "z"), frequency=1.0)
    with pytest.raises(ValueError, match="add one: another output"):
        bp.find_orbits(alone, periods=[1])
    more = bp.PoincareSection.from_recordings(
        wells.recordings(1300, (0, 0, 0)), ("x", "v", "x[-0.5]"), frequency=FREQUENCY
    )
    assert bp.find_orbits(more, periods=[1]).prediction_error[0] < 0.005


FREQUENCY = 1.0 / wells.PERIOD


def compared(names, delays, steps, noise, periods):
    """Return how many known orbits there are, the orbits, and standardised errors of points and log|multiplier|.

    Known are those of periods 1 to 4 with |multiplier| < 100 and at least three returns.
    """
    section = bp.PoincareSection.from_recordings(wells.recordings(periods, noise), names, frequency=FREQUENCY)
    orbits = bp.find_orbits(section, periods=range(1, 5), steps=steps)
    size, known, matched, points, logarithms = np.ptp(section.points, axis=0), 0, 0, [], []
    for one, returns in wells.known_orbits(periods, 4):
        wanted = abs(one.multipliers[0]) < 100 and returns >= 3
        known += wanted
        exact = wells.coordinates_of(one, delays)
        for orbit in orbits:
            if orbit.period != len(exact):
                continue
            shifts = [np.roll(exact, -k, axis=0) for k in range(len(exact))]
            near = min(shifts, key=lambda shifted, orbit=orbit: np.abs((shifted - orbit.points) / size).max())
            if np.abs((near - orbit.points) / size).max() < 0.03:
                matched += wanted
                sd = np.sqrt(np.diag(orbit.joint_covariance))
                points.append((orbit.points - near).ravel() / sd[: near.size])
                logarithms.append(np.log(abs(orbit.eigenvalues[0] / one.multipliers[0])) / sd[near.size])
                break
    return known, matched, orbits, np.concatenate(points), np.array(logarithms)


@cache
def wells_orbits():
    section = bp.PoincareSection.from_recordings(
        wells.recordings(1300, (0, 0, 0)), ("v", "v[-0.25]", "y"), frequency=FREQUENCY
    )
    return section, bp.find_orbits(section, periods=[2])


def test_orbits_in_delayed_coordinates_are_those_of_the_flow():
    section, orbits = wells_orbits()
    assert len(orbits) >= 2
    known = [one for one, _ in wells.known_orbits(1300, 2) if len(one.states) == 2]
    for orbit in orbits:
        points = [wells.coordinates_of(one, [("v", 0.0), ("v", -0.25), ("y", 0.0)]) for one in known]
        off = [[np.abs(np.roll(p, -k, axis=0) - orbit.points).max() for k in range(2)] for p in points]
        best = int(np.argmin(np.min(off, axis=1)))
        assert np.min(off) < 0.01 * np.ptp(section.points, axis=0).max()
        assert abs(np.log(orbit.eigenvalues[0] / known[best].multipliers[0])) < 0.3


def test_experiments_leave_delayed_coordinates_out():
    orbit = wells_orbits()[1][0]
    experiment = orbit.experiment(states={"x": "v", "y": "y"})
    assert set(experiment.outputs) == {"v", "y"}
    np.testing.assert_array_equal(experiment.outputs["y"][experiment.mask], orbit.points[:, 2])
    np.testing.assert_array_equal(experiment.outputs["v"][experiment.mask], orbit.points[:, 0])
    kept = [0, 2, 3, 5]
    np.testing.assert_array_equal(experiment.covariance, orbit.covariance[np.ix_(kept, kept)])
    with pytest.raises(ValueError, match="orbits: must be of a section without delays and integrals"):
        bp.polish_orbits(bp.models.pendulum, [orbit], dict.fromkeys(bp.models.pendulum.parameters, 1.0))


def test_portraits_draw_the_first_two_coordinates(tmp_path):
    section, orbits = wells_orbits()
    assert bp.plot.section(section, orbits).axes[0].get_ylabel() == "v[-0.25]"
    lines = bp.plot.orbits(orbits).axes[0].lines
    x, y = lines[0].get_data()
    np.testing.assert_allclose(y[16:], x[:-16])
    orbits.save(tmp_path / "orbits.h5")
    assert repr(bp.load(tmp_path / "orbits.h5")) == repr(orbits)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "noise", "fraction"),
    [
        (STATES, (1e-4, 1e-4, 1e-5), 0.9),
        (("v", "v[-0.25]", "v[-0.5]"), (0.0, 0.0, 1e-5), 0.5),
    ],
)
def test_orbits_of_three_states_in_120_pieces(names, noise, fraction):
    """At least the given fraction of the known orbits; 90 % intervals cover at least as often as stated.

    False alarms 0.5 % for the points (one-sided, as if independent) and for the multipliers each. Stated covariances
    include the estimated bias, so that coverage may be higher.
    """
    delays = [(name.partition("[")[0], float(name.partition("[")[2].rstrip("]") or 0.0)) for name in names]
    known, matched, orbits, points, logarithms = compared(names, delays, 3, noise, 3120)
    logarithms = logarithms[np.isfinite(logarithms)]
    inside = np.mean(np.abs(points) < 1.645)
    print(f"{names}: {matched} of {known} orbits, {len(orbits)} in all; {inside:.3f} of {points.size} points inside")
    assert matched >= fraction * known
    if names == STATES:
        for orbit in orbits:
            exact = wells.orbit(orbit.points)
            assert exact is not None, orbit
            assert np.abs((exact.states - orbit.points) / np.ptp(wells.motion(3120), axis=0)).max() < 0.03
    assert np.sum(np.abs(points) < 1.645) >= binom.ppf(0.005, points.size, 0.9)
    assert np.sum(np.abs(logarithms) < 1.645) >= binom.ppf(0.005, logarithms.size, 0.9)


@harvester.needed
def test_two_coordinates_of_the_harvester_are_refused_and_a_third_delayed_one_passes():
    """The beam has three states, of which velocity and voltage are measured."""
    section = bp.PoincareSection.from_recordings(
        harvester.pieces(), ("velocity", "voltage"), frequency=6.5, origin=0.25 / 6.5
    )
    with pytest.raises(ValueError, match=r"return map, .* with '(velocity|voltage)\[-0\.(25|5)\]' errors are [12]\."):
        bp.find_orbits(section, periods=[1])
    section = bp.PoincareSection.from_recordings(
        harvester.pieces(), ("velocity", "voltage", "voltage[-0.25]"), frequency=6.5, origin=0.25 / 6.5
    )
    assert bp.find_orbits(section, periods=[1]).prediction_error[0] < 0.04


@pytest.mark.slow
@harvester.needed
def test_an_orbit_of_the_harvester_is_the_same_half_a_period_later():
    """The orbit of period 3 with the most returns, from independent local maps; false-alarm rate 0.3 %.

    Sections half a period apart have no point in common, and the multiplier does not depend on the phase.
    """
    names = ("voltage", "voltage[-0.25]", "voltage[-0.5]", "voltage[-0.75]")
    logarithms, variances = [], []
    for origin in (0.25, 0.75):
        section = bp.PoincareSection.from_recordings(harvester.pieces(), names, frequency=6.5, origin=origin / 6.5)
        orbit = max(bp.find_orbits(section, periods=[3], steps=5), key=lambda one: one.returns)
        assert orbit.returns >= 15
        logarithms.append(np.log(orbit.eigenvalues[0].real))
        variances.append(orbit.joint_covariance[orbit.points.size, orbit.points.size])
    assert abs(logarithms[1] - logarithms[0]) < 3.0 * np.sqrt(sum(variances))
