"""Parts of the robust covariance and of the test of the prior, against explicit sums, optimisation and closed forms."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

import bayesperiodic as bp
from bayesperiodic.estimation import conflict, covariance, modes, units
from bayesperiodic.estimation.gauss_newton import End, _step, inverse_hessian
from bayesperiodic.estimation.laplace import JointLaplace, joint_laplace
from bayesperiodic.estimation.modes import Mode, images, notable
from bayesperiodic.likelihood.input_noise import FROM_CYCLES, directions
from bayesperiodic.likelihood.mean_period import MeanPeriod
from tests.known import LINEAR, formula_model, linear_experiment

HIGHEST = 9
HARMONIC = np.array([0, *np.repeat(np.arange(1, HIGHEST + 1), 2)])
BLOCK = MeanPeriod("run", "y", 15.2, 19, HARMONIC, np.zeros(0), 32, 200.0, np.nan)


def test_a_variance_exceeds_its_estimate_by_the_mean_of_the_inverse_chi_square():
    assert covariance._excess(np.array([10.0, 3.5, 2.5, 0.5])) == pytest.approx([10 / 8, 3.5 / 1.5, 2.5, 1.0])


def smoothed(square, left):
    """Return squares over their expectation, smoothed over about √H harmonics with parabolic weights.

    One more value is as expected.
    """
    half, result = int(np.ceil(np.sqrt(HIGHEST + 1.0))), []
    for h in HARMONIC:
        weight = np.array([1.0 - ((h - k) / (half + 1)) ** 2 if abs(h - k) <= half else 0.0 for k in HARMONIC])
        expected = np.sum(weight * left)
        power = {k: np.sum(left[k == HARMONIC]) for k in range(HIGHEST + 1)}
        squared = sum((1.0 - ((h - k) / (half + 1)) ** 2) ** 2 * power[k] for k in power if abs(h - k) <= half)
        freedom, total = expected**2 / squared, np.sum(left)
        excess = freedom / (freedom - 2.0) / (total / (total - 2.0))
        result.append((np.sum(weight * square) + 1.0) / (expected + 1.0) * excess)
    return np.array(result)


def test_squares_are_smoothed_over_neighbouring_harmonics():
    generator = np.random.default_rng(0)
    square, left = generator.exponential(size=(2, 19)), generator.uniform(0.3, 0.8, (2, 19))
    each = [smoothed(*one) for one in zip(square, left, strict=True)]
    assert covariance._smoothed(BLOCK, square, left) == pytest.approx(np.array(each))


def spectra(unit):
    """Return white and autoregressive spectra of mean 1, and their prior probabilities, half of it for white noise."""
    lengths = np.geomspace(1e-3, 3.0, 40)
    density = stats.lognorm.pdf(lengths, 1.5, scale=0.03) * lengths
    shape = [unit**2 / (1.0 + (2 * np.pi * length * HARMONIC) ** 2) for length in (0.0, *lengths)]
    return [own / own.mean() for own in shape], np.array([0.5, *(0.5 * density / density.sum())])


def test_variance_of_a_residual_is_that_of_restricted_likelihood_averaged_over_the_spectra():
    """The size of each spectrum is found by a search; its prior is one value of variance 1."""
    generator = np.random.default_rng(1)
    unit = generator.uniform(0.8, 1.2, 19)
    s = generator.standard_normal((2, 19)) * np.exp(-HARMONIC / 3.0) * np.array([[1.0], [50.0]])
    r = generator.standard_normal(19) / (1.0 + HARMONIC / 3.0)
    information = s @ s.T + np.diag([2.0, 4000.0])
    others = information - s @ s.T
    logs, values = [], []
    shapes, prior = spectra(unit)
    for shape, probability in zip(shapes, prior, strict=True):

        def restricted(log_size, shape=shape):
            variance = np.exp(log_size) * shape
            total = (s / variance) @ s.T + others
            step = np.linalg.solve(total, (s / variance) @ r - s @ r)
            misfit = np.sum((r - step @ s) ** 2 / variance) + step @ others @ step + 2 * step @ (s @ r)
            taken = np.einsum("am,am->m", s, np.linalg.solve(total, s / variance))
            value = misfit + BLOCK.weight * np.sum(np.log(variance)) + np.linalg.slogdet(total)[1]
            value += log_size + np.exp(-log_size)
            return value, (r - step @ s) ** 2 / variance, np.maximum(BLOCK.weight - taken, 0.0)

        best = minimize_scalar(lambda x: restricted(x)[0], bounds=(-12.0, 8.0), method="bounded")  # noqa: B023
        value, square, left = restricted(best.x)
        logs.append(np.log(probability) - 0.5 * value)
        values.append(np.exp(best.x) * shape * smoothed(square, left))
    weight = np.exp(np.array(logs) - max(logs))
    found = covariance._residual_variance(BLOCK, s, r, unit, information)
    assert found == pytest.approx(weight @ np.array(values) / weight.sum(), rel=5e-3)


def test_a_prior_that_is_not_concave_has_no_pull_on_the_spectrum():
    """Beyond the median of a lognormal prior; the residual is refitted as if the prior were flat there.

    Then it does not matter what of it the parameters can explain.
    """
    generator = np.random.default_rng(3)
    s = generator.standard_normal((2, 19)) * np.exp(-HARMONIC / 3.0)
    for pull in (0.0, 0.5, 3.0):
        r = generator.standard_normal(19)
        alone = r - np.linalg.lstsq(s.T, r, rcond=None)[0] @ s
        r = alone + pull * s[0]
        flat = covariance._residual_variance(BLOCK, s, alone, np.ones(19), s @ s.T)
        for curvature in (0.0, 0.02, 0.1):
            found = covariance._residual_variance(BLOCK, s, r, np.ones(19), s @ s.T - np.diag([curvature, curvature]))
            assert found == pytest.approx(flat, rel=1e-4)


def test_degrees_of_freedom_are_those_of_satterthwaite():
    inverse = np.diag([2.0, 5.0])
    part = lambda a, b, freedom: covariance.VariancePart(np.diag([a, b]), np.eye(2), 1.0, freedom)  # noqa: E731
    found = covariance.degrees_of_freedom(inverse, {"u": part(1.5, 0.0, 8.0), "v": part(0.5, 2.5, 4.0)})
    assert found == pytest.approx([1 / (0.75**2 / 8 + 0.25**2 / 4), 1 / (0.5**2 / 4)])
    assert np.isinf(covariance.degrees_of_freedom(inverse, {})).all()


def test_negative_eigenvalues_are_removed_in_units_of_the_covariance():
    scale = np.diag([1.0, 1e3])
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    matrix = scale @ turn @ np.diag([2.0, -1.0]) @ turn.T @ scale
    found = covariance._without_negative(matrix, np.array([[1.0, 300.0], [300.0, 1e6]]))
    assert found == pytest.approx(scale @ turn @ np.diag([2.0, 0.0]) @ turn.T @ scale)


def test_shape_parameters_are_spread_over_99_percent_of_their_priors():
    first, second = bp.LogNormal(0.03, 1.5), bp.LogUniform(0.1, 10.0)
    problem = SimpleNamespace(noise=SimpleNamespace(shape_priors={"lengthscale": first, "floor": second}))
    points, log_prior = covariance._points(problem)
    z = stats.norm.ppf(0.995)
    lengths = np.exp(np.log(0.03) + 1.5 * np.linspace(-z, z, 60))
    floors = np.exp(np.log(0.1) + np.linspace(0.005, 0.995, 9) * np.log(100.0))
    assert points == pytest.approx(np.array([(a, b) for a in lengths for b in floors]))
    expected = stats.lognorm.logpdf(points[:, 0], 1.5, scale=0.03) + np.log(points[:, 0])
    assert np.ptp(log_prior - expected) < 1e-9


def test_covariance_under_an_uncertain_spectrum_is_that_of_a_mixture_with_the_coefficient_integrated_out():
    """One coefficient a of components with variances v·(1 + shape·k), by quadrature over a for every shape."""
    k, generator, prior = np.arange(24.0), np.random.default_rng(2), bp.LogNormal(0.5, 1.0)
    regressor, y = np.cos(k), np.cos(k) + 0.3 * np.sqrt(1.0 + 0.4 * k) * generator.standard_normal(24)
    noise = SimpleNamespace(
        shape_priors={"shape": prior}, spectrum=lambda _, values: (values[..., :1] * (1.0 + values[..., 1:] * k), None)
    )
    block = SimpleNamespace(size=24, weight=1.0)
    problem = SimpleNamespace(noise=noise, likelihood=SimpleNamespace(blocks=[block], names=("v", "shape")))
    now = 0.09 * (1.0 + 0.4 * k)
    here = np.sum(regressor * y / now) / np.sum(regressor**2 / now)
    fit = covariance._Linear(
        np.ones(1), np.array([[np.sum(regressor**2 / now)]]), [regressor[None]], [y - here * regressor]
    )
    estimate = SimpleNamespace(noise=np.array([0.09, 0.4]))
    found = covariance._mixture(problem, estimate, fit, (("v", "shape"), [0], 23.0))
    points, log_prior = covariance._points(problem)
    a, log_weights, squares = np.linspace(-4.0, 6.0, 20_001), [], []
    for shape, log_weight in zip(points[:, 0], log_prior, strict=True):
        own = 1.0 + shape * k
        best = np.sum(regressor * y / own) / np.sum(regressor**2 / own)
        v = np.sum((y - best * regressor) ** 2 / own) / 23.0
        log_density = stats.norm.logpdf(y[:, None], regressor[:, None] * a, np.sqrt(v * own)[:, None]).sum(axis=0)
        density = np.exp(log_density - log_density.max())
        log_weights.append(log_weight + log_density.max() + np.log(density.sum()))
        squares.append(np.sum(density * (a - here) ** 2) / density.sum())
    weights = np.exp(log_weights - np.max(log_weights))
    assert found[0, 0] == pytest.approx(np.sum(weights * squares) / weights.sum(), rel=1e-6)


@pytest.mark.parametrize("value", [-0.7, 0.0, 0.4, 2.5])
def test_score_of_an_estimate_under_a_normal_prior_is_that_of_the_sum_of_variances(value):
    prior = 2.0 * conflict.SCORES
    found = conflict._scores(prior, 5.0 * value, np.array([0.5, 3.0]))
    assert found == pytest.approx(5.0 * value / np.hypot(2.0, [0.5, 3.0]), rel=5e-3, abs=1e-9)


@pytest.mark.parametrize("value", [0.3, -0.95, 1.5, -1.2, 4.0])
def test_score_under_a_uniform_prior_is_that_of_the_tail_or_of_the_density(value):
    """Both are integrals of the normal distribution; the density relates to its maximum at the centre."""
    sd = 0.3
    prior = 2.0 * stats.norm.cdf(conflict.SCORES) - 1.0
    area = lambda x: x * stats.norm.cdf(x) + stats.norm.pdf(x)  # noqa: E731  ∫ Φ
    tail = 0.5 * sd * (area((1 - abs(value)) / sd) - area((-1 - abs(value)) / sd))
    density = lambda at: stats.norm.cdf((at + 1) / sd) - stats.norm.cdf((at - 1) / sd)  # noqa: E731
    drop = np.sqrt(2 * np.log(density(0.0) / max(density(abs(value)), 1e-300)))
    expected = np.sign(value) * min(-stats.norm.ppf(tail), drop)
    assert conflict._scores(prior, value, np.array([sd]))[0] == pytest.approx(expected, rel=0.01, abs=0.02)


@pytest.mark.parametrize(
    ("p", "joint", "smallest", "members"),
    [
        ([0.001, 0.5, np.nan], 0.2, 4 * 0.001, ("a",)),
        ([0.5, 0.6, 0.7], 0.002, 0.004, ("b", "c")),
        ([0.009, 0.006, 0.7], 0.001, 0.002, ("a", "b")),
        ([0.5, 0.6, 0.7], 0.006, 0.012, ()),
        ([0.9, 0.9, 0.9], 0.9, 1.0, ()),
        ([np.nan, np.nan, np.nan], np.nan, np.nan, ()),
    ],
)
def test_p_values_are_corrected_for_their_number(p, joint, smallest, members):
    """Twice for parameters and directions, and for the number of tested parameters."""
    found = conflict._summary(pd.DataFrame({"p": p}, index=["a", "b", "c"]), joint, np.array([0.29, 1.0, 0.31]))
    assert found.p == pytest.approx(smallest, nan_ok=True)
    assert (found.members, found.table["p"].tolist()) == (members, pytest.approx(p, nan_ok=True))


def test_the_p_value_of_a_single_parameter_is_not_corrected():
    found = conflict._summary(pd.DataFrame({"p": [0.3]}, index=["a"]), 0.009, np.ones(1))
    assert (found.p, found.members) == (0.009, ("a",))


def test_newton_steps_are_scaled_by_the_curvature_and_leave_out_flat_directions():
    hessian = np.array([[4.0, 1e3, 0.0], [1e3, 1e6, 0.0], [0.0, 0.0, 0.0]])
    gradient, held = np.array([1.0, 500.0, 7.0]), np.zeros(3, dtype=bool)
    expected = np.linalg.solve(hessian[:2, :2], gradient[:2])
    step, size = _step(hessian, gradient, held)
    assert step == pytest.approx([*expected, 0.0])
    assert size == pytest.approx(np.sqrt(expected @ hessian[:2, :2] @ expected))
    held[1] = True
    assert _step(hessian, gradient, held)[0] == pytest.approx([0.25, 0.0, 0.0])
    assert _step(hessian, gradient, ~np.zeros(3, dtype=bool)) == (pytest.approx(np.zeros(3)), 0.0)
    # Negative curvature is taken with the opposite sign: uphill.
    assert _step(np.diag([-4.0, 1.0]), np.ones(2), held[:2] & False)[0] == pytest.approx([0.25, 1.0])
    inverse, lost = inverse_hessian(hessian)
    assert inverse[:2, :2] == pytest.approx(np.linalg.inv(hessian[:2, :2]))
    assert lost.tolist() == [False, False, True] and not inverse[2].any()


def named(**supports):
    return SimpleNamespace(joint_prior=SimpleNamespace(supports=supports))


def test_images_of_an_optimum_are_its_signs_and_exchanges():
    ends, positive = (-np.inf, np.inf), (0.0, np.inf)
    found = images(named(a=ends, b=positive, c=ends), np.array([1.0, 2.0, 3.0]))
    signs = [[-1, 2, 3], [1, 2, -3], [-1, 2, -3]]
    assert found.tolist() == [*signs, [2, 1, 3], [3, 2, 1], [1, 3, 2]]
    assert images(named(**{"a[run]": positive, "b": positive}), np.array([1.0, 2.0])).shape == (0, 2)
    many = images(named(**dict.fromkeys([f"{name}[run]" for name in "abcde"], ends)), np.arange(1.0, 6.0))
    assert many.tolist() == [*(np.arange(1, 6) * (1 - 2 * np.eye(5))).tolist(), [-1, -2, -3, -4, -5]]
    assert len(images(named(**dict.fromkeys([f"{name}[run]" for name in "abcd"], ends)), np.ones(4))) == 15


def test_a_value_differs_from_another_by_more_than_the_smaller_sd():
    mode = Mode({"a": 3.0}, {"a": 0.5}, -1.0, 0.02, {}, pd.DataFrame())
    assert mode.differs("a", 2.4, 9.0) and not mode.differs("a", 2.6, 9.0)
    assert mode.differs("a", 2.6, 0.3) and mode.differs("a", 3.6, np.nan)
    assert repr(mode) == "a = 3 (objective -1, 2.0% of the mass)"
    masses = {0.02: True, 0.01: False, 0.0: False, np.nan: True}
    optima = [Mode({}, {}, 0.0, mass, {}, pd.DataFrame()) for mass in masses]
    assert [any(one is mode for one in notable(optima)) for mode in optima] == list(masses.values())


@pytest.mark.parametrize(("ratio", "said"), [(101.0, "1e+2 times"), (99.0, ""), (0.0099, "1e-2 times"), (1e3, "1e+3")])
def test_units_are_doubted_from_two_powers_of_ten_on(monkeypatch, ratio, said):
    scales = {name: units.Scales({"y": ratio * size}, {"y": size}) for name, size in (("a", 1.0), ("b", 5.0))}
    monkeypatch.setattr(units, "_scales", lambda problem, theta: scales)
    text = units.unit_error(None, np.ones(1))
    assert said in text and bool(text) == bool(said)
    scales["b"] = units.Scales({}, {})
    assert units.unit_error(None, np.ones(1)) == ""


def test_perturbations_are_waves_of_one_sd_and_their_derivatives():
    """The variance of a complex amplitude is shared by its cosine and its sine; that of the mean is its own."""
    variance = {"v": np.array([0.3, 0.02, 0.08])}
    e = bp.Experiment(
        "run", 3.0, {"y": np.zeros(16)}, {"u": np.zeros(16), "v": np.zeros(16)}, samples=8, periods=2, cycles=5,
        amplitude_variance=variance, harmonics={"v": 2, "u": 1, "y": 1},
    )  # fmt: skip
    phase = 2 * np.pi * np.arange(16) / 16
    expected = np.zeros((5, 16, 6))
    expected[0, :, 1] = np.sqrt(0.3)
    for h, row in ((1, 1), (2, 3)):
        rate, size = 2 * np.pi * h * 3.0 / 2, np.sqrt(0.5 * variance["v"][h])
        for order, (cosine, sine) in enumerate([(1, 0), (0, -1), (-1, 0)]):
            expected[row, :, 2 * order + 1] = (
                size * rate**order * (cosine * np.cos(h * phase) + sine * np.sin(h * phase))
            )
            wave = cosine * np.sin(h * phase) - sine * np.cos(h * phase)
            expected[row + 1, :, 2 * order + 1] = size * rate**order * wave
    order = [0, 1, 3, 2, 4]  # the mean, cosines, sines
    assert directions(e, ("u", "v"), FROM_CYCLES) == pytest.approx(expected[order], abs=1e-12)
    assert len(directions(bp.Experiment("run", 3.0, {"y": np.zeros(8)}, samples=8), (), FROM_CYCLES)) == 0


def test_nothing_is_tested_or_approximated_where_derivatives_or_the_density_do_not_exist():
    data = linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)
    priors = {"k": bp.LogNormal(800.0, 0.1), "c": bp.Uniform(0.0, 90.0), "coulomb": bp.Normal(20.0, 10.0)}
    problem = bp.Problem(LINEAR, [data], priors=priors)
    size = problem.likelihood.blocks[0].size
    here = SimpleNamespace(jacobian=[np.full((3, size), np.nan)], residuals=[np.ones(size)])
    estimate = SimpleNamespace(theta=np.array([880.0, 41.0, 22.0]), here=here, noise=np.array([9.0]))
    tested = conflict._tested(problem, estimate)
    assert np.isnan([tested.joint, tested.p]).all() and tested.members == ()
    assert tested.table[["prior_low", "prior_high"]].loc["c"].tolist() == pytest.approx([4.5, 85.5])
    assert np.isnan(covariance.robust_covariance(problem, estimate, np.eye(3))).all()
    assert conflict._by_the_data(problem, estimate) is estimate
    outside = SimpleNamespace(theta=np.array([880.0, 95.0, 22.0]), here=None, noise=None)
    found = joint_laplace(problem.density(), outside)
    assert found.mode == {} and found.covariance.isna().all(axis=None) and np.isnan(found.log_density)
    assert list(found.covariance) == list(found.covariance.index) == ["k", "c", "coulomb", "variance[force]"]


def end(theta, objective, status="converged", others=()):
    here = SimpleNamespace(other_orbits=dict.fromkeys(others, ""))
    return End(SimpleNamespace(theta=np.array([theta]), here=here, objective=objective), status, np.zeros(1))


def test_optima_are_more_than_one_sd_apart_converged_and_on_the_measured_orbits(monkeypatch):
    monkeypatch.setattr(modes, "_credible_images", lambda *_: np.empty((0, 1)))
    monkeypatch.setattr(modes, "prior_only", lambda problem, theta, hessian: np.zeros(1, dtype=bool))
    density = SimpleNamespace(problem=None)
    curved = SimpleNamespace(hessian_and_gradient=lambda iterate: (np.array([[4.0]]), None), density=density)

    def found(*ends):
        return [float(one.iterate.theta[0]) for one in modes.with_images(curved, ends, None)]

    assert found(end(3.0, -1.0), end(3.51, -5.0), end(3.49, -2.0), end(9.0, -4.0)) == [3.0, 9.0, 3.51]
    assert found(end(3.0, -1.0), end(9.0, -30.9), end(6.0, -31.1)) == [3.0, 9.0]
    assert found(end(3.0, -1.0, "stalled"), end(3.1, -1.0009), end(3.2, -1.0011)) == [3.1]
    assert found(end(3.0, -1.0, "stalled"), end(3.1, -1.0011)) == [3.0]
    assert found(end(3.0, -1.0), end(9.0, -4.0, "stalled"), end(6.0, -2.0, others=["run"])) == [3.0]
    assert found(end(3.0, -1.0, others=["run"]), end(9.0, -4.0)) == [9.0]
    # An image is climbed from where it is separate, and followed by its own images.
    images_of = {3.0: [3.1, -3.0], -3.0: [5.0], -8.0: [20.0]}
    monkeypatch.setattr(
        modes, "_credible_images", lambda _, here, __: np.array(images_of.get(float(here.theta[0]), []))[:, None]
    )
    started = []
    moving = SimpleNamespace(
        hessian_and_gradient=curved.hessian_and_gradient,
        density=density,
        at=lambda theta, here, noise: started.append(float(theta[0])) or SimpleNamespace(theta=theta),
        anchored=lambda iterate: iterate,
    )
    first = end(3.0, -1.0)
    first.iterate.noise = None
    climbed = lambda start: with_noise(end(float(start.theta[0]), -2.0))  # noqa: E731
    assert [float(one.iterate.theta[0]) for one in modes.with_images(moving, [first], climbed)] == [3.0, -3.0, 5.0]
    assert started == [-3.0, 5.0]
    # Images of optima that are left out, 30 below the best one, are not climbed from.
    far, started[:] = with_noise(end(-8.0, -40.0)), []
    assert [float(one.iterate.theta[0]) for one in modes.with_images(moving, [first, far], climbed)] == [3.0, -3.0, 5.0]
    assert started == [-3.0, 5.0]


@pytest.mark.parametrize("progress", [True, False])
def test_images_are_solved_block_by_block_and_counted(progress, monkeypatch, capsys):
    """Those of seven parameters, 21 exchanges, whose density is negligible unless the first one is 1 or 2."""
    monkeypatch.setattr(modes, "SHOWN_AFTER", 0.0)
    supports, sizes = dict.fromkeys("abcdefg", (0.0, np.inf)), []

    def at(points, noise):
        sizes.append(len(points))
        assert noise.shape == (len(points), 1)
        return SimpleNamespace(log_prob=np.where(points[:, 0] <= 2.0, 0.0, -7.0))

    problem = named(**supports)
    problem.joint_prior.log_prob = lambda points: np.zeros(len(points))
    density = SimpleNamespace(problem=problem, with_settings=lambda solver: SimpleNamespace(at=at))
    mode = SimpleNamespace(theta=np.arange(1.0, 8.0), noise=np.ones(1), here=SimpleNamespace(solver=None))
    found = modes._credible_images(SimpleNamespace(density=density), mode, progress)
    expected = images(problem, mode.theta)
    assert np.array_equal(found, expected[expected[:, 0] <= 2.0]) and len(found) == 16
    assert sum(sizes) == 22 and max(sizes) == modes.IMAGES_AT_ONCE
    assert ("0/22" in capsys.readouterr().err) == progress
    problem.joint_prior.log_prob = lambda points: np.where((points == mode.theta).all(axis=1), 0.0, -7.0)
    sizes.clear()
    assert modes._credible_images(SimpleNamespace(density=density), mode, progress).shape == (0, 7) and not sizes


def with_noise(one):
    one.iterate.noise = None
    return one


def test_masses_are_densities_times_the_volumes_of_the_laplace_approximations():
    covariances = [np.array([[4.0, 1.0], [1.0, 2.0]]), np.array([[0.09, 0.0], [0.0, 1e-8]])]
    names = ["a", "b"]
    laplaces = [
        JointLaplace({"a": 1.0}, pd.DataFrame(c, names, names), height)
        for c, height in zip(covariances, (-3.0, 6.0), strict=True)
    ]
    problem = SimpleNamespace(names=("a", "b"), logarithmic=np.array([True, False]))
    ends = [end(3.0, -1.0), End(SimpleNamespace(theta=np.array([5.0, -2.0]), objective=-4.0), "converged", None)]
    (mode,) = modes.weighed(problem, ends, laplaces)
    volumes = [np.exp(height) * np.sqrt(np.linalg.det(c)) for c, height in zip(covariances, (-3.0, 6.0), strict=True)]
    assert mode.mass == pytest.approx(volumes[1] / sum(volumes))
    assert (mode.theta, mode.objective) == ({"a": 5.0, "b": -2.0}, -4.0)
    assert mode.sd == pytest.approx({"a": 5.0 * 0.3, "b": 1e-4})
    laplaces[0] = replace(laplaces[0], covariance=pd.DataFrame(np.full((2, 2), np.nan), names, names))
    (mode,) = modes.weighed(problem, ends, laplaces)
    assert mode.mass == pytest.approx(1.0 / (1.0 + np.exp(-9.0)))
    laplaces[0] = replace(laplaces[0], log_density=np.nan)
    assert np.isnan(modes.weighed(problem, ends, laplaces)[0].mass)


def test_uncertain_spectra_of_several_channels_widen_each_parameter_as_its_own_channel_alone():
    """Each output has a parameter and a noise spectrum of its own, so that the problem falls into two."""
    formulas = {"left": lambda p, u: p.a * u.x, "right": lambda p, u: p.b * u.dx}
    random, tau = np.random.default_rng(4), np.arange(24) / 24
    x = {"x": np.cos(2 * np.pi * tau) + 0.5 * np.cos(6 * np.pi * tau)}
    rough = np.convolve(random.standard_normal(60), np.ones(6) / 6, "valid")[:48].reshape(2, 24)
    data = {
        "left": 2.0 * x["x"] + 0.1 * rough[0],
        "right": -6 * np.pi * (np.sin(2 * np.pi * tau) + 1.5 * np.sin(6 * np.pi * tau)) + 2.0 * rough[1],
    }
    sd = {}
    for channels in (["left"], ["right"], ["left", "right"]):
        names = [{"left": "a", "right": "b"}[channel] for channel in channels]
        model = formula_model("two", names, lambda p, u, s, own=channels: {c: formulas[c](p, u) for c in own})
        run = bp.Experiment("synthetic", 1.0, {channel: data[channel] for channel in channels}, x, samples=24)
        problem = bp.Problem(
            model,
            [run],
            priors=dict.fromkeys(names, bp.Normal(2.0, 50.0)),
            noise=bp.noise.Circulant(),
            scheme="fourier",
        )
        fit = bp.map_estimate(problem, progress=False)
        sd[len(channels)] = sd.get(len(channels), {}) | fit.sd
    assert sd[2] == pytest.approx(sd[1], rel=1e-4)
