"""Problems whose data are jumps and resonance points: likelihood, gradient, estimate and draws."""

import pickle

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.density.log_posterior import LogPosterior
from tests import harmonic_balance
from tests.known import grid

TRUTH = {"c": 0.1, "k": 1.0, "k3": 0.5}
PRIORS = {"c": bp.LogNormal(0.105, 0.2), "k": bp.LogNormal(1.02, 0.1), "k3": bp.LogNormal(0.48, 0.3)}
PLACE_SD, LEVEL_SD, AMPLITUDE_SD, SAMPLES = 2e-4, 1e-3, 0.01, 32
UNKNOWN_LEVELS = (0.5, 1.0)


def places(c: float, k: float, k3: float) -> np.ndarray:
    """Return the data by harmonic balance: folds of a frequency and a level sweep, resonance, backbone."""
    theta = 1.0, c, k, k3
    folds = [harmonic_balance.fold(theta, 0.2, direction) for direction in ("up", "down")]
    level = harmonic_balance.fold(theta, 0.2, "up", omega=2 * np.pi * 0.2)
    backbone = [harmonic_balance.backbone(theta, a)[0] for a in UNKNOWN_LEVELS]
    return np.array([*folds, level, *harmonic_balance.phase_resonance(theta, 0.2), *backbone])


SDS = np.array([PLACE_SD, PLACE_SD, LEVEL_SD, PLACE_SD, AMPLITUDE_SD, PLACE_SD, PLACE_SD])


def experiments(data: np.ndarray) -> list[bp.Experiment]:
    """Return the experiments with these data."""
    up, down, level, frequency, amplitude, *backbone = data.tolist()
    given = {"samples": SAMPLES}
    force, sd = {"force": 0.2}, {"frequency_sd": PLACE_SD} | given
    return [
        bp.jump("up", up, force, direction="up", sd=PLACE_SD, **given),
        bp.jump("down", down, force, direction="down", sd=PLACE_SD, **given),
        bp.jump("level", 0.2, {"force": level}, direction="up", vary="force", sd=LEVEL_SD, **given),
        bp.resonance_point("peak", frequency, {"displacement": amplitude}, force, amplitude_sd=AMPLITUDE_SD, **sd),
        *(
            bp.resonance_point(f"backbone {a}", f, {"displacement": a}, {"force": None}, **sd)
            for a, f in zip(UNKNOWN_LEVELS, backbone, strict=True)
        ),
    ]


def problem_of(data: np.ndarray, **changes) -> bp.Problem:
    given = {"priors": PRIORS, "fixed": {"m": 1.0}, "scheme": "fourier"} | changes
    return bp.Problem(bp.models.duffing, experiments(data), **given)


@pytest.fixture(scope="module")
def exact() -> bp.Problem:
    return problem_of(places(**TRUTH))


def log_likelihood(data: np.ndarray, theta: dict[str, float]) -> float:
    return float(np.sum(stats.norm.logpdf((data - places(**theta)) / SDS)))


def test_the_likelihood_is_that_of_normal_errors_about_harmonic_balance(exact):
    data = places(**TRUTH)
    thetas = [TRUTH, {"c": 0.102, "k": 1.001, "k3": 0.49}, {"c": 0.098, "k": 0.997, "k3": 0.52}]
    values = np.array([float(exact.log_likelihood(theta, {})) for theta in thetas])
    expected = np.array([log_likelihood(data, theta) for theta in thetas])
    np.testing.assert_allclose(values - values[0], expected - expected[0], rtol=2e-5, atol=1e-4)


def test_the_gradient_is_the_difference_of_the_density(exact):
    start = LogPosterior.start(exact)
    density = start.with_settings(solver=start.solver.anchored(exact.vector(TRUTH)))
    point = density.from_natural(exact.vector(TRUTH) * 1.001, np.empty(0))
    value, gradient, _ = density.value_and_gradient(point)
    ends = [density.evaluate(np.stack([point + h, point - h])).log_prob for h in 1e-4 * np.eye(3)]
    numeric = [(up - down) / 2e-4 for up, down in ends]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-3 * np.abs(gradient).max())
    assert value == pytest.approx(float(density.evaluate(point[None]).log_prob[0]), abs=1e-4)
    again = pickle.loads(pickle.dumps(density)).evaluate(point[None]).log_prob
    np.testing.assert_array_equal(again, density.evaluate(point[None]).log_prob)


def test_the_estimate_of_exact_data_is_the_truth_and_its_covariance_that_of_harmonic_balance(exact):
    fit = bp.map_estimate(
        exact.replace(priors={n: bp.LogNormal(p.median, 3.0) for n, p in PRIORS.items()}), progress=False
    )
    assert fit.converged
    truth = np.array(list(TRUTH.values()))
    slopes = [(places(*(truth + h)) - places(*(truth - h))) / 2e-4 / SDS for h in 1e-4 * np.eye(3)]
    sd = np.sqrt(np.diag(np.linalg.inv(np.array(slopes) @ np.array(slopes).T)))
    for (name, value), one in zip(TRUTH.items(), sd, strict=True):
        assert abs(fit.theta[name] - value) < 0.02 * one, name
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), sd, rtol=0.02)
    assert fit.solutions["up"].frequency == pytest.approx(places(**TRUTH)[0], rel=1e-4)


def test_an_estimate_is_saved_and_sampled_and_predicts(exact, tmp_path):
    fit = bp.map_estimate(exact, progress=False)
    fit.save(tmp_path / "fit.h5")
    assert bp.load(tmp_path / "fit.h5").theta == fit.theta
    posterior = bp.sample(exact, fit, max_steps=60, seed=1, progress=False)
    assert "none" in repr(posterior)
    assert np.isfinite(bp.predict(exact, posterior).table["p"]).all()


def test_experiments_of_special_points_are_saved_with_their_condition(exact, tmp_path):
    for i, experiment in enumerate(exact.experiments):
        experiment.save(tmp_path / f"{i}.h5")
        again = bp.load(tmp_path / f"{i}.h5")
        assert again.condition == experiment.condition and repr(again) == repr(experiment)


def test_special_points_beside_a_recorded_period():
    wave = np.cos(2 * np.pi * grid(SAMPLES))
    clean = bp.solve_periodic(
        bp.models.duffing, {"m": 1.0, **TRUTH}, {"force": 0.2 * wave}, frequency=0.1, samples=SAMPLES, scheme="fourier"
    )
    noise = 0.01 * np.random.default_rng(1).standard_normal(SAMPLES)
    run = bp.Experiment(
        "run", 0.1, {"displacement": clean.outputs["displacement"] + noise}, {"force": 0.2 * wave}, samples=SAMPLES
    )
    problem = bp.Problem(
        bp.models.duffing, [run, *experiments(places(**TRUTH))[:2]], priors=PRIORS, fixed={"m": 1.0}, scheme="fourier"
    )
    density = LogPosterior.start(problem)
    point = density.from_natural(problem.vector(TRUTH), np.array([1e-4]))
    density = density.with_settings(solver=density.solver.anchored(problem.vector(TRUTH)))
    _, gradient, _ = density.value_and_gradient(point)
    ends = [density.evaluate(np.stack([point + h, point - h])).log_prob for h in 1e-4 * np.eye(4)]
    np.testing.assert_allclose(gradient, [(up - down) / 2e-4 for up, down in ends], rtol=1e-4, atol=0.02)


def test_a_force_known_up_to_a_factor_is_a_gain_of_its_sensor():
    """Twice the force with half the gain is the same force."""
    peak = experiments(places(**TRUTH))[3]
    twice = bp.Experiment(
        "peak", peak.frequency, peak.outputs, {"force": 2.0 * peak.inputs["force"]}, samples=SAMPLES,
        harmonics=peak.harmonics, unmeasured=peak.unmeasured, condition=peak.condition,
    )  # fmt: skip
    given = {"priors": PRIORS, "fixed": {"m": 1.0}, "scheme": "fourier"}
    plain = bp.Problem(bp.models.duffing, [peak], **given)
    gained = bp.Problem(bp.models.duffing, [twice], sensors={"force": bp.Sensor(gain=bp.LogNormal(2.0, 0.1))}, **given)
    theta = {"c": 0.103, "k": 1.01, "k3": 0.45}
    expected = float(plain.log_likelihood(theta, {}) - plain.log_likelihood(TRUTH, {}))
    one, other = ({**values, "gain[force]": 2.0} for values in (theta, TRUTH))
    assert float(gained.log_likelihood(one, {}) - gained.log_likelihood(other, {})) == pytest.approx(expected, abs=1e-6)


def test_a_start_without_the_jump_is_refused_by_name():
    problem = problem_of(places(**TRUTH), priors=PRIORS | {"k3": bp.LogNormal(1e-4, 0.1)})
    with pytest.raises(ValueError, match=r"start: must have a finite log-posterior.*'up'"):
        bp.map_estimate(problem, progress=False)


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"sensors": {"displacement": bp.Sensor(gain=2.0)}}, "sensors: must be without one of 'displacement'"),
        ({"input_noise": {"force": 0.01}}, "input_noise: must not be of .'force'. in 'up'"),
    ],
)
def test_what_the_solver_of_special_points_does_not_know_is_refused(changes, text):
    with pytest.raises(ValueError, match=text):
        problem_of(places(**TRUTH), **changes)


def test_searches_that_need_time_histories_refuse_special_points(exact):
    fit = bp.map_estimate(exact, progress=False)
    with pytest.raises(ValueError, match="problem: must be without jumps and resonance points"):
        bp.missing_terms(exact, fit)


@pytest.mark.slow
def test_intervals_from_jumps_and_backbones_cover_the_truth():
    """60 data sets of parameters drawn from the prior; 90 % intervals, 99 % band of the binomial distribution.

    False-alarm rate 3 % (three parameters); the data are those of harmonic balance with normal errors, the priors
    those of the estimate. Fixed seed.
    """
    generator, inside, count = np.random.default_rng(64), np.zeros(3), 60
    wide = {"c": bp.LogNormal(0.08, 0.1), "k": bp.LogNormal(1.0, 0.03), "k3": bp.LogNormal(0.5, 0.1)}
    for _ in range(count):
        truth = {name: float(prior.quantile(generator.uniform())) for name, prior in wide.items()}
        data = places(**truth) + SDS * generator.standard_normal(SDS.size)
        problem = problem_of(data, priors=wide)
        fit = bp.map_estimate(problem, checks=False, progress=False)
        assert fit.converged
        sd = np.sqrt(np.diag(fit.covariance))
        z = np.array([(fit.theta[name] - truth[name]) for name in truth]) / sd
        inside += np.abs(z) < stats.norm.ppf(0.95)
    low, high = stats.binom.interval(0.99, count, 0.9)
    assert np.all((low <= inside) & (inside <= high)), inside
