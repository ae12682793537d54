"""Problems of condensed models: the density, its gradient, estimates and draws."""

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from tests.periodic.test_condensed import FORCE, SAMPLES, VALUES, beam, solved

PRIORS = {name: bp.LogNormal(value, 0.3) for name, value in VALUES.items()}
NOISE = {"variance[x]": 1e-4, "variance[a]": 1e-5}


def run(frequency, seed=1):
    """Return a synthetic experiment of a beam of 12 degrees of freedom with 1 % noise."""
    truth, random = solved(12, frequency=frequency).outputs, np.random.default_rng(seed)
    outputs = {n: truth[n] + 0.01 * np.ptp(truth[n]) * random.standard_normal(SAMPLES) for n in "xa"}
    return bp.Experiment(f"run {frequency}", frequency, outputs, {"force": FORCE}, samples=SAMPLES)


@cache
def problem(condensed=True, **priors):
    """Return a problem of a beam with two experiments."""
    given = dict(priors) or PRIORS
    fixed = {name: value for name, value in VALUES.items() if name not in given}
    scheme = None if condensed else "fourier"
    return bp.Problem(beam(12, condensed), [run(0.03), run(0.055, 2)], priors=given, fixed=fixed, scheme=scheme)


def points(count=7, width=0.01):
    """Return θ near the truth."""
    steps = np.random.default_rng(0).standard_normal((count, len(VALUES)))
    return np.array([VALUES[n] for n in problem().names]) * np.exp(width * steps)


def test_log_likelihood_is_that_of_the_solutions():
    """Also where several are evaluated together, to the last bit, in any number of threads."""
    given = problem()
    together = given.log_likelihood(points(), NOISE, threads=1)
    np.testing.assert_array_equal(given.log_likelihood(points(), NOISE, threads=2), together)
    for theta, value in zip(points(), together, strict=True):
        assert given.log_likelihood(theta, NOISE) == value
        expected = 0.0
        for e in given.experiments:
            truth = bp.solve_periodic(
                given.model, dict(zip(given.names, theta, strict=True)), e.inputs, frequency=e.frequency,
                samples=SAMPLES,
            )  # fmt: skip
            for channel, y in e.outputs.items():
                v = NOISE[f"variance[{channel}]"]
                expected -= 0.5 * (np.sum((y - truth.outputs[channel]) ** 2) / v + SAMPLES * np.log(v))
        assert value == pytest.approx(expected, abs=1e-5 * abs(expected))


def test_density_does_not_depend_on_the_anchors():
    """Near and far from them, where solutions are followed in steps."""
    theta = points(3, 0.3)
    here, there = problem(), problem().anchored(points(1, 0.1)[0])
    values = here.log_likelihood(theta, NOISE)
    assert np.isfinite(values).all()
    np.testing.assert_allclose(there.log_likelihood(theta, NOISE), values, rtol=1e-7)


@pytest.mark.parametrize("method", ["adjoint", "forward"])
def test_gradient_is_that_of_finite_differences(method):
    theta = dict(zip(problem().names, points(1)[0], strict=True))
    gradient = problem().gradient(theta, NOISE, method=method)
    for i, (name, value) in enumerate(theta.items()):
        ends = [problem().log_posterior(theta | {name: value * (1 + sign * 1e-5)}, NOISE) for sign in (1, -1)]
        assert gradient[i] == pytest.approx((ends[0] - ends[1]) / (2e-5 * value), rel=1e-4)


def test_estimate_recovers_the_parameters():
    """Each is within 4 standard deviations: by chance, one in 4000 runs with another seed is not."""
    fit = bp.map_estimate(problem())
    assert fit.converged
    sd = np.sqrt(np.diag(fit.covariance))
    for name, error in zip(problem().names, sd, strict=True):
        assert abs(fit.theta[name] - VALUES[name]) < 4 * error < VALUES[name]
    assert all(solution.stable for solution in fit.solutions.values())


def test_pickled_problem_has_the_same_density():
    given = problem()
    assert pickle.loads(pickle.dumps(given)).log_likelihood(points(1)[0], NOISE) == given.log_likelihood(
        points(1)[0], NOISE
    )


def test_saved_solution_is_read_again(tmp_path):
    solution = problem().solve(points(1)[0])["run 0.03"]
    solution.save(tmp_path / "solution.h5")
    again = bp.load(tmp_path / "solution.h5")
    np.testing.assert_array_equal(again.multipliers, solution.multipliers)
    assert again.stable == solution.stable and repr(again) == repr(solution)


@pytest.mark.slow
def test_draws_have_the_spread_of_the_laplace_approximation():
    """Within 10 %, as for nearly linear models, and at the estimate."""
    given = problem(spring_k3=PRIORS["spring_k3"], air_drag=PRIORS["air_drag"])
    fit = bp.map_estimate(given)
    draws = bp.sample(given, fit, seed=1, progress=False)
    table = draws.summary(robust=False)
    for name in given.names:
        sd = np.sqrt(fit.covariance.loc[name, name])
        assert table.loc[name, "sd"] == pytest.approx(sd, rel=0.1)
        assert abs(table.loc[name, "mean"] - fit.theta[name]) < 0.2 * sd


@pytest.mark.parametrize(
    "special",
    [
        bp.jump("special", 0.05, {"force": 0.2}, direction="up", step=0.01, samples=SAMPLES),
        bp.resonance_point(
            "special", 0.05, {"x": 0.3}, {"force": 0.2}, frequency_sd=0.001, amplitude_sd=0.01, samples=SAMPLES
        ),
    ],
)
def test_jumps_and_resonance_points_are_refused(special):
    with pytest.raises(ValueError, match="condition of experiment 'special': must be absent.*condensed=False"):
        bp.Problem(beam(12), [run(0.03), special], priors=PRIORS)


@pytest.mark.parametrize("unknown", [{"gain": bp.LogNormal(1.0, 0.1)}, {"delay": bp.Normal(0.0, 0.1)}])
def test_unknown_entries_of_the_inputs_sensors_are_refused(unknown):
    with pytest.raises(ValueError, match=r"must have symbolic equations for this.*condensed=False"):
        bp.Problem(beam(12), [run(0.03)], priors=PRIORS, sensors={"force": bp.Sensor(**unknown)})


def test_joint_errors_of_inputs_are_refused():
    noisy = replace(run(0.03), cycles=10, amplitude_variance={"force": np.full(9, 1e-4)})
    with pytest.raises(ValueError, match=r"must have symbolic equations for this.*condensed=False"):
        bp.Problem(beam(12), [noisy], priors=PRIORS, input_noise="joint")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"guess": "data"}, "guess of experiment"),
        ({"multipliers": [0.5], "multiplier_sd": [0.1]}, "multipliers of experiment"),
    ],
)
def test_data_that_condensed_models_do_not_predict_are_refused(changes, message):
    with pytest.raises(ValueError, match=f"{message}.*condensed"):
        bp.Problem(beam(12), [replace(run(0.03), **changes)], priors=PRIORS)
