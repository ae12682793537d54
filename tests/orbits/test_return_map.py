import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator
from scipy.stats import binom

import bayesperiodic as bp
from bayesperiodic.orbits.cycles import _bandwidths
from bayesperiodic.orbits.return_map import KERNEL_REACH, Atlas, ReturnMap, change_in_time, check_chaos

OPEN = np.array([np.inf, np.inf])


def quadratic(points):
    x, y = points[:, 0], points[:, 1]
    return np.stack([0.3 + 1.4 * x - 0.5 * y + 0.7 * x**2 + 0.2 * x * y, 0.1 - 0.8 * x + 0.9 * y**2], axis=1)


def slopes(x, y):
    return np.array([[1.4 + 1.4 * x + 0.2 * y, -0.5 + 0.2 * x], [-0.8, 1.8 * y]])


def maps(count, noise, seed, width=None):
    generator = np.random.default_rng(seed)
    clean = generator.uniform(-1.0, 1.0, (count, 2))
    if width is not None:
        clean[:, 0] = width * generator.standard_normal(count)
    arguments = clean + noise * generator.standard_normal(clean.shape)
    images = quadratic(clean) + noise * generator.standard_normal(clean.shape)
    return ReturnMap(arguments, images - arguments, OPEN, True, np.full(2, noise))


def test_a_quadratic_map_is_recovered_exactly():
    fit = maps(500, 0.0, 1).fit(np.array([[0.2, -0.1]]), np.zeros(1), 80, 2)
    np.testing.assert_allclose(fit.value[0], quadratic(np.array([[0.2, -0.1]]))[0], atol=1e-12)
    np.testing.assert_allclose(fit.jacobian[0], slopes(0.2, -0.1), atol=1e-11)
    np.testing.assert_allclose(fit.hessian[0], [[[1.4, 0.2], [0.2, 0.0]], [[0.0, 0.0], [0.0, 1.8]]], atol=1e-9)


def test_noise_in_the_arguments_does_not_attenuate_slopes():
    # Points in a strip of 2.5 times the sd of the noise, like the leaves of an attractor: ordinary slopes across it are
    # 14 % too small. False-alarm rate below 1e-3 for the four slopes (four standard errors).
    centre, errors, plain = np.array([[0.0, 0.2]]), [], []
    for seed in range(150):
        noisy = maps(2000, 0.02, seed, width=0.05)
        errors.append(noisy.fit(centre, np.zeros(1), 300, 2, influence=False).jacobian[0] - slopes(0.0, 0.2))
        noisy.noise = np.zeros(2)
        plain.append(noisy.fit(centre, np.zeros(1), 300, 2, influence=False).jacobian[0] - slopes(0.0, 0.2))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4.0 * np.std(errors, axis=0) / np.sqrt(150))
    assert np.mean(plain, axis=0)[0, 0] < -0.1


def test_influences_give_the_variance_of_replicates():
    # The mean stated variance is that of 300 replicates within 25 %, three standard errors of a variance.
    centre = np.array([[0.1, 0.2]])
    fits = [maps(1500, 0.02, seed).fit(centre, np.zeros(1), 150, 2) for seed in range(300)]
    actual = np.var([np.concatenate([fit.value, fit.derivatives[0, 1:3]]) for fit in fits], axis=0)
    stated = np.mean([(fit.influence[0, :, :3] ** 2).sum(axis=0) for fit in fits], axis=0)
    np.testing.assert_allclose(stated, actual, rtol=0.25)


@pytest.mark.parametrize("coordinates", [1, 2, 3, 5])
def test_influences_are_those_of_weighted_least_squares(coordinates):
    """Without noise each is w_i r_i (X'WX)⁻¹ x_i / (1 − h_i) with the leverage h_i, here by a design matrix."""
    generator = np.random.default_rng(5)
    points = generator.uniform(-1.0, 1.0, (900, coordinates))
    increments = np.sin(3.0 * points) - 0.5 * points[:, ::-1] ** 2
    fitted = ReturnMap(points, increments, np.full(coordinates, np.inf), True, np.zeros(coordinates))
    centre = points[:1] + 0.01
    fit = fitted.fit(centre, np.zeros(1), 200, 2)
    away = points[fit.neighbours[0]] - centre
    pairs = [away[:, i] * away[:, j] for i in range(coordinates) for j in range(i, coordinates)]
    design = np.column_stack([np.ones(len(away)), away, *pairs])
    weight = np.exp(-0.5 * np.sum(away**2, axis=1) / fit.bandwidth[0] ** 2)
    inverse = np.linalg.inv(design.T @ (weight[:, None] * design))
    images = points[fit.neighbours[0]] + increments[fit.neighbours[0]]
    coefficients = inverse @ design.T @ (weight[:, None] * images)
    residual = images - design @ coefficients
    leverage = weight * np.einsum("na,ab,nb->n", design, inverse, design)
    assert leverage.max() < 0.9
    expected = np.einsum("nk,nc->nkc", design @ inverse, residual * (weight / (1.0 - leverage))[:, None])
    np.testing.assert_allclose(fit.value[0], coefficients[0], atol=1e-9)
    np.testing.assert_allclose(fit.influence[0], expected[:, : 1 + coordinates], atol=1e-9)


def test_what_points_on_a_line_do_not_determine_is_left_out():
    """The normal equations are singular: on the line the map is fitted all the same."""
    along = np.linspace(-1.0, 1.0, 400)[:, None]
    points = along * [0.6, 0.8]
    fitted = ReturnMap(points, quadratic(points) - points, OPEN, True, np.zeros(2))
    fit = fitted.fit(points[150:250:20], np.zeros(5), 60, 2)
    np.testing.assert_allclose(fit.value, quadratic(points[150:250:20]), atol=1e-9)
    along_line = np.einsum("mij,j->mi", fit.jacobian, [0.6, 0.8])
    exact = np.array([slopes(*point) @ [0.6, 0.8] for point in points[150:250:20]])
    np.testing.assert_allclose(along_line, exact, atol=1e-6)


def test_fits_of_given_bandwidths_are_those_of_as_many_neighbours():
    noisy, centres = maps(1500, 0.02, 1), np.array([[0.1, 0.2], [-0.6, 0.5], [0.9, -0.9]])
    phases, counts = np.zeros(3), (80, 250, 120)
    alone = [noisy.fit(centre[None], phases[:1], count, 3) for centre, count in zip(centres, counts, strict=True)]
    together = noisy.fit_within(centres, phases, np.array([fit.bandwidth[0] for fit in alone]) * (1.0 + 1e-12), 3)
    for k, fit in enumerate(alone):
        np.testing.assert_allclose(together.value[k], fit.value[0], rtol=1e-9)
        np.testing.assert_allclose(together.derivatives[k], fit.derivatives[0], rtol=1e-6, atol=1e-9)
        for neighbour, influence in zip(fit.neighbours[0], fit.influence[0], strict=True):
            same = together.influence[k][together.neighbours[k] == neighbour].sum(axis=0)
            np.testing.assert_allclose(same, influence, rtol=1e-6, atol=1e-6)
        assert np.count_nonzero(np.any(together.influence[k], axis=(1, 2))) == fit.neighbours.size


def test_where_points_are_few_the_bandwidth_is_larger():
    fit = maps(1500, 0.0, 1).fit_within(np.array([[0.1, 0.2], [3.0, 3.0]]), np.zeros(2), np.array([0.1, 0.1]), 2)
    assert fit.bandwidth[0] == 0.1 and fit.bandwidth[1] > 0.5
    np.testing.assert_allclose(fit.value, quadratic(np.array([[0.1, 0.2], [3.0, 3.0]])), atol=1e-6)


@pytest.mark.parametrize(("bend", "steps"), [(0.0, 2), (2e3, 0)])
def test_a_neighbourhood_is_one_step_narrower_than_the_widest_that_agrees(bend, steps):
    """A quadratic map is fitted exactly by all that have an eighth of the points, 72 to 576; a quintic one by none.

    Median of 20 maps.
    """
    found, point = [], np.array([[0.0, 0.1]])
    for seed in range(20):
        noisy = maps(6000, 1e-3, seed)
        noisy.increments[:, 0] += bend * noisy.arguments[:, 0] ** 5
        narrowest = noisy.nearest(point, np.zeros(1), 72)[0][0, -1] / KERNEL_REACH
        found.append(_bandwidths(noisy, point, 32)[0] / narrowest)
    assert np.median(found) == pytest.approx(2.0 ** (0.5 * steps), rel=1e-9)


def test_increments_modulo_a_turn_give_the_same_map():
    generator = np.random.default_rng(3)
    angle = generator.uniform(0.0, 1.0, 800)
    other = generator.uniform(-1.0, 1.0, 800)
    image = np.stack([2.2 * angle + 0.3 * other, -0.4 * other], axis=1)
    arguments = np.stack([angle, other], axis=1)
    folded = np.stack([(angle + 0.37) % 1.0 - 0.37, other], axis=1)
    run = image - arguments
    turn = np.array([1.0, np.inf])
    known = ReturnMap(folded, run, turn, True, np.zeros(2)).fit(np.array([[0.5, 0.0]]), np.zeros(1), 60, 1)
    np.testing.assert_allclose(known.value[0] - [0.5, 0.0], [0.6, 0.0], atol=1e-12)
    modulo = run.copy()
    modulo[:, 0] -= np.round(modulo[:, 0])
    alone = ReturnMap(folded, modulo, turn, False, np.zeros(2)).fit(np.array([[0.5, 0.0]]), np.zeros(1), 60, 1)
    np.testing.assert_allclose(alone.jacobian, known.jacobian, atol=1e-12)
    np.testing.assert_allclose((alone.value - known.value) % 1.0 % 1.0, [[0.0, 0.0]], atol=1e-12)


@pytest.fixture(scope="module")
def atlas():
    return Atlas(maps(4000, 0.0, 1), 72)


def test_an_atlas_reproduces_a_quadratic_map_between_the_centres(atlas):
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (200, 2))
    found, jacobian, bandwidth = atlas.at(points, np.zeros(len(points)))
    assert found == pytest.approx(quadratic(points), abs=1e-9)
    assert jacobian == pytest.approx(np.array([slopes(x, y) for x, y in points]), abs=1e-7)
    assert np.isfinite(bandwidth).all()


def test_fits_about_the_points_agree_with_the_atlas(atlas):
    points = np.random.default_rng(3).uniform(-0.8, 0.8, (50, 2))
    for one, other in zip(
        atlas.at(points, np.zeros(len(points)))[:2], atlas.exactly(points, np.zeros(len(points)))[:2], strict=True
    ):
        assert one == pytest.approx(other, abs=1e-7)


def test_an_atlas_is_undefined_far_from_the_data(atlas):
    assert np.isinf(atlas.at(np.array([[3.0, 3.0]]), np.zeros(1))[2]).all()


def logistic(count, seed, drift=0.0, noise=1e-3):
    """Return the maps of x' = a x (1 − x) with noise, whose a moves from 3.8 by `drift` over the recording."""
    generator = np.random.default_rng(seed)
    points, x = np.empty(count), generator.uniform(0.2, 0.8)
    for k in range(-50, count):
        x = (3.8 + drift * max(k, 0) / count) * x * (1.0 - x)
        if k >= 0:
            points[k] = x
    points = (points + noise * generator.standard_normal(count))[:, None]
    return ReturnMap(points, np.diff(points, axis=0), np.array([np.inf]), True, np.array([noise]))


def test_a_trend_of_the_map_in_time_is_seen_and_none_is_seen_without():
    """P-values of 200 recordings are uniform: 99.9 % bands of the numbers below 0.05 and 0.3; all of a drift are small.

    The drift by 1 % changes images by a standard deviation of 0.002, with noise of 0.002 in them.
    """
    without = np.array([change_in_time(logistic(600, seed)) for seed in range(200)])
    for level in (0.05, 0.3):
        low, high = binom.interval(0.999, without.size, level)
        assert low <= np.sum(without < level) <= high
    assert max(change_in_time(logistic(600, seed, drift=0.038)) for seed in range(20)) < 1e-3


def test_too_few_points_show_no_trend():
    assert change_in_time(logistic(12, 0, drift=0.04)) == 1.0


def test_noise_as_large_as_the_motion_is_not_called_periodic_without_doubt():
    with pytest.raises(ValueError, match="of period 1, or points that differ by little more than their noise. Use"):
        check_chaos(logistic(600, 0, noise=0.3), lambda error: "")


def test_more_points_are_asked_for_where_no_delayed_coordinate_helps():
    """Smooth curves through random values once a period, which no coordinates determine."""
    values = np.random.default_rng(3).uniform(size=(2, 401))
    time = np.arange(400 * 32) / 32.0
    x, y = PchipInterpolator(np.arange(401), values, axis=1)(time)
    recording = bp.Recording(time, {"x": x, "y": y}, {})
    section = bp.PoincareSection.from_recording(recording, ("x", "y"), frequency=1.0)
    with pytest.raises(ValueError, match=r"delayed ones do not help, .* points may be too few for local maps: record"):
        bp.find_orbits(section, periods=[1])


def test_the_refusal_names_a_map_that_changes():
    """Two logistic maps, whose images are mirrored in the second half."""
    now, points = np.array([0.3, 0.4]), []
    for k in range(1200):
        now = 3.99 * now * (1.0 - now)
        now = now if k < 600 else 1.0 - now
        points.append(now)
    section = bp.PoincareSection.from_points(np.array(points), ("x", "y"), frequency=1.0)
    with pytest.raises(ValueError, match="The return map changes during the recording"):
        bp.find_orbits(section, periods=[1])


def test_a_recording_whose_parameters_drift_is_warned_of():
    """One channel of the Roessler system, by SciPy, whose a drifts by 10 %; a constant one raises no warning."""
    for end, seen in ((0.22, True), (0.2, False)):
        times = np.arange(0.0, 2000.0, 0.1)

        def rates(t, state, end=end):
            x, y, z = state
            return [-y - z, x + (0.2 + (end - 0.2) * t / 2000.0) * y, 0.2 + z * (x - 5.7)]

        x = solve_ivp(rates, (0.0, 2000.0), [3.0, 0.0, 0.1], "DOP853", times, rtol=1e-7, atol=1e-7).y[0]
        noisy = x + 0.05 * np.random.default_rng(1).standard_normal(x.size)
        section = bp.PoincareSection.from_crossings(
            bp.Recording(times, {"x": noisy}, {}), ["x[1.5 s]"], channel="x", level=0.0
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            bp.find_orbits(section, periods=[1])
        assert any("the return map changes during the recording (p = " in str(one.message) for one in caught) == seen
