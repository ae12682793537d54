"""Draws with the robust covariance, against the covariance that they must have."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.sampling.robust import reflected, stretched

GAIN = bp.Model(
    "gain", states=["w"], inputs=["u"], parameters=["a", "b"], equations=["dw + w - u"], outputs={"y": "a*u + b"}
)


@pytest.fixture(scope="module")
def wrong():
    """Return a gain fitted to a curve with a second harmonic, its estimate and draws."""
    time = np.arange(10 * 64) / 64
    u = np.cos(2 * np.pi * time)
    y = 2.0 * u + 1.0 + 0.3 * np.cos(4 * np.pi * time) + 0.05 * np.random.default_rng(1).standard_normal(time.size)
    run = bp.Recording.from_arrays(time, {"y": y}, {"u": u}).fold(64, frequency=1.0, harmonics={"y": 8})
    priors = {"a": bp.LogNormal(1.0, 2.0), "b": bp.Normal(0.0, 10.0)}
    problem = bp.Problem(GAIN, [run], priors=priors, scheme="fourier", input_noise="exact")
    fit = bp.map_estimate(problem, progress=False)
    return problem, fit, bp.sample(problem, fit, seed=1, max_steps=300, progress=False)


def test_points_get_the_covariance_and_keep_their_mean():
    generator = np.random.default_rng(1)
    points = generator.standard_normal((500, 3)) @ generator.standard_normal((3, 3)) * [1.0, 1e6, 1e-6] + 5.0
    root = generator.standard_normal((3, 3)) * [[2.0], [3e5], [1e-6]]
    moved = stretched(points, root @ root.T)
    np.testing.assert_allclose(np.cov(moved.T), root @ root.T, rtol=1e-6, atol=1e-12 * np.abs(root).max())
    np.testing.assert_allclose(moved.mean(axis=0), points.mean(axis=0))
    np.testing.assert_allclose(stretched(points, np.cov(points.T)), points)


def test_values_beyond_an_end_are_reflected():
    values = np.array([-0.25, 0.5, 1.25, 2.5])
    assert reflected(values, 0.0, 1.0).tolist() == [0.25, 0.5, 0.75, 0.5]
    assert reflected(values, 0.0, np.inf).tolist() == [0.25, 0.5, 1.25, 2.5]
    assert reflected(values, -np.inf, 1.0).tolist() == [-0.25, 0.5, 0.75, -0.5]


def test_robust_draws_have_the_robust_covariance_in_sampling_coordinates(wrong):
    _, fit, posterior = wrong
    robust = posterior.robust(fit)
    points = np.stack([np.log(robust.draws("a")), robust.draws("b")])
    slopes = np.array([1.0 / fit.theta["a"], 1.0])
    np.testing.assert_allclose(np.cov(points), fit.robust_covariance * np.outer(slopes, slopes), rtol=1e-6, atol=1e-12)
    assert np.array_equal(robust.draws("variance[y]"), posterior.draws("variance[y]"))
    assert robust.derive({"twice": "2*b"}).loc["twice", "sd"] == pytest.approx(2 * fit.robust_sd["b"], rel=1e-6)


def test_robust_intervals_come_first_where_the_model_is_misspecified(wrong):
    _, fit, posterior = wrong
    assert fit.misspecified and fit.interval() == fit.interval(robust=True) != fit.interval(robust=False)
    assert repr(fit).index("robust sd") < repr(fit).index("Laplace sd") and fit.misfit in repr(fit)
    table, plain = posterior.summary(), posterior.summary(robust=False)
    assert table.loc["b", "sd"] == pytest.approx(fit.robust_sd["b"], rel=1e-6)
    assert table["draws_sd"].to_dict() == plain["sd"].to_dict() and "draws_sd" not in plain
    assert fit.misfit in repr(posterior) and fit.misfit in table.attrs["interval"]
    labels = [text.get_text() for text in bp.plot.corner(posterior, laplace=fit).legends[0].texts]
    assert labels[:2] == ["robust, 50 and 90 %", "MCMC, model taken for right"]


def test_they_survive_a_file(wrong, tmp_path):
    _, fit, posterior = wrong
    for result in (fit, posterior):
        result.save(tmp_path / "result.h5")
        assert repr(bp.load(tmp_path / "result.h5")) == repr(result)


def test_diagnostics_of_the_density_refuse_robust_draws(wrong):
    problem, fit, posterior = wrong
    robust = posterior.robust(fit)
    calls = [
        lambda: bp.compare(problem, fit, robust), lambda: bp.predict(problem, robust), lambda: robust.robust(fit),
        lambda: bp.evidence(problem, robust),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(ValueError, match="posterior: must be draws from the posterior density"):
            call()
