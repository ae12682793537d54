"""Errors of the inputs in the likelihood: against dense normal distributions, differences and a static regression."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import sympy as sp
import xarray as xr
from scipy import stats

import bayesperiodic as bp
from bayesperiodic import _fourier
from bayesperiodic.diagnostics import calibration
from bayesperiodic.estimation.adequacy import misfit
from bayesperiodic.estimation.noise_changes import changes_by_variance
from bayesperiodic.likelihood.block import Block
from bayesperiodic.likelihood.input_noise import same
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers
from tests.known import formula_model, grid

QUIET = {"progress": False}
HARMONIC = np.array([0, 1, 2, 3, 1, 2, 3])


def block(channel: str, kind: type[Block] = MeanPeriod, weight: float = 1.0, measured: float = 0.02) -> Block:
    size = HARMONIC.size if kind is MeanPeriod else 2
    return kind("run", channel, weight * size, size, HARMONIC, np.empty(0), 16, 4.0 * size, measured)


NOISES = {
    "independent": bp.noise.Independent(),
    "measured": bp.noise.Measured(),
    "circulant": bp.noise.Circulant(),
    "flat": bp.noise.Independent(prior="flat"),
    "proper": bp.noise.Independent(prior=bp.InverseGamma(3, 2)),
}
BLOCKS = [block("x"), block("y"), block("multipliers", Multipliers)]


@pytest.fixture(params=NOISES)
def case(request: pytest.FixtureRequest) -> tuple[Likelihood, list[np.ndarray], np.ndarray, np.ndarray]:
    """Return a likelihood of blocks that share four errors, residuals, noise parameters, and the loadings."""
    random = np.random.default_rng(1)
    loadings = 0.3 * random.standard_normal((16, 4))
    likelihood = Likelihood(NOISES[request.param], BLOCKS, {}, {"run": loadings})
    residuals = [0.4 * random.standard_normal(b.size) for b in BLOCKS]
    return likelihood, residuals, np.exp(0.5 * random.standard_normal(len(likelihood.names)) - 1.0), loadings


def dense(likelihood: Likelihood, values: np.ndarray, loadings: np.ndarray) -> np.ndarray:
    """Return the covariance of all components."""
    plain = [np.ones(2) if not b.counted else None for b in BLOCKS]
    for i, b in enumerate(BLOCKS):
        if plain[i] is None:
            own = [likelihood.names.index(n) for n in likelihood.model.parameter_names(b)]
            plain[i] = np.broadcast_to(likelihood.model.spectrum(b, values[own])[0], b.size)
    return np.diag(np.concatenate(plain)) + loadings @ loadings.T


def test_the_likelihood_is_that_of_a_normal_distribution_with_the_dense_covariance(case):
    likelihood, residuals, values, loadings = case
    joined = np.concatenate(residuals)
    exact = stats.multivariate_normal(np.zeros(16), dense(likelihood, values, loadings)).logpdf(joined)
    assert likelihood(residuals, values) == pytest.approx(exact + 8 * np.log(2 * np.pi), rel=1e-10)
    assert likelihood.terms(residuals, values).sum() == pytest.approx(float(likelihood(residuals, values)), rel=1e-10)
    white = np.concatenate(likelihood.whitened(residuals, values))
    solved = np.linalg.solve(dense(likelihood, values, loadings), joined)
    assert white @ white == pytest.approx(joined @ solved, rel=1e-10)


def test_units_are_the_sds_that_white_noise_of_one_block_causes(case):
    """Of the rows of a root W of the precision, W·C·Wᵀ = 1 with the dense covariance C."""
    likelihood, _, values, loadings = case
    ends = np.cumsum([b.size for b in BLOCKS])
    root = np.concatenate(likelihood.whitened(np.split(np.eye(16), ends[:-1], axis=1), values), axis=1).T
    assert root @ dense(likelihood, values, loadings) @ root.T == pytest.approx(np.eye(16), abs=1e-9)
    for b, unit in zip(BLOCKS, likelihood.units(values), strict=True):
        place = slice(ends[BLOCKS.index(b)] - b.size, ends[BLOCKS.index(b)])
        assert unit == pytest.approx(np.sqrt(np.sum(root[place, place] ** 2, axis=1)), rel=1e-9)


def test_the_likelihood_is_exact_where_errors_explain_all_and_the_variance_vanishes():
    """As many errors as components: for V → 0 it tends to that of the errors alone, from every side."""
    random = np.random.default_rng(4)
    for noise, blocks in ((bp.noise.Independent(), BLOCKS[:1]), (bp.noise.Independent(), BLOCKS[:2])):
        size = sum(b.size for b in blocks)
        loadings = random.standard_normal((size, size))
        likelihood = Likelihood(noise, blocks, {}, {"run": loadings})
        residuals = [random.standard_normal(b.size) for b in blocks]
        alone = stats.multivariate_normal(np.zeros(size), loadings @ loadings.T).logpdf(np.concatenate(residuals))
        for v in 10.0 ** np.array([-12, -16, -22]):
            found = float(likelihood(residuals, np.full(len(likelihood.names), v)))
            assert found == pytest.approx(alone + 0.5 * size * np.log(2 * np.pi), abs=1e-3)
        for v in 10.0 ** np.array([-30, -40, -100, -200, -300]):
            assert likelihood(residuals, np.full(len(likelihood.names), v)) < found + 1e-3


def test_several_points_at_once_give_the_same_bits_as_single_ones(case):
    likelihood, residuals, values, _ = case
    many = [np.stack([r, 2 * r, -r]) for r in residuals]
    rows = np.stack([values, 1.5 * values, values])
    together = likelihood(many, rows)
    assert all(likelihood([r[i] for r in many], rows[i]) == together[i] for i in range(3))


def test_gradients_are_those_of_differences(case):
    likelihood, residuals, values, _ = case
    _, by_residual, by_value = likelihood.value_and_gradients(residuals, values)

    def density(r: list[np.ndarray], phi: np.ndarray) -> float:
        return float(likelihood(r, phi) + likelihood.log_prior(phi))

    for i in range(values.size):
        up, down = values.copy(), values.copy()
        up[i] *= np.exp(1e-5)
        down[i] *= np.exp(-1e-5)
        slope = (density(residuals, up) - density(residuals, down)) / 2e-5
        assert by_value[i] == pytest.approx(slope, rel=1e-6, abs=1e-7)
    for b, r in enumerate(residuals):
        for j in range(r.size):
            ends = [[*residuals[:b], r + sign * 1e-6 * np.eye(r.size)[j], *residuals[b + 1 :]] for sign in (1, -1)]
            slope = (density(ends[0], values) - density(ends[1], values)) / 2e-6
            assert by_residual[b][j] == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_changes_with_a_variance_are_those_of_the_dense_covariance(case):
    """With S the covariance and S' its derivative by ln v: J S⁻¹S'S⁻¹ Jᵀ and so on, for errors that blocks share."""
    likelihood, _, values, loadings = case
    random = np.random.default_rng(5)
    jacobian = [random.standard_normal((2, b.size)) for b in BLOCKS]
    joined, inverse = np.concatenate(jacobian, axis=1), np.linalg.inv(dense(likelihood, values, loadings))
    problem = SimpleNamespace(likelihood=likelihood, experiments=())
    found = changes_by_variance(problem, jacobian, values)
    assert found
    for name, change in found.items():
        ends = [values * np.where(np.array(likelihood.names) == name, np.exp(s * 1e-5), 1.0) for s in (1.0, -1.0)]
        up, down = (dense(likelihood, end, loadings) for end in ends)
        once = inverse @ (up - down) / 2e-5
        assert change.information == pytest.approx(joined @ once @ inverse @ joined.T, rel=1e-6, abs=1e-9)
        assert change.doubled == pytest.approx(joined @ once @ once @ inverse @ joined.T, rel=1e-6, abs=1e-9)
        assert change.trace == pytest.approx(np.trace(once), rel=1e-6)
        assert change.square == pytest.approx(np.trace(once @ once), rel=1e-6)


def test_simulated_noise_has_the_covariance(case):
    """20 000 draws; each of 136 elements within five standard errors: false-alarm rate below 1e-4."""
    likelihood, _, values, loadings = case
    draws = np.concatenate(likelihood.simulate(np.tile(values, (20_000, 1)), np.random.default_rng(3)), axis=1)
    wanted, found = dense(likelihood, values, loadings), np.cov(draws.T)
    error = np.sqrt((np.outer(np.diag(wanted), np.diag(wanted)) + wanted**2) / 20_000)
    assert np.abs((found - wanted) / error).max() < 5.0


def test_jeffreys_prior_is_the_root_of_the_information_and_proper():
    """Where the errors of the input can explain every component, 1/v alone would diverge as v → 0."""
    loadings = 0.5 * np.random.default_rng(2).standard_normal((7, 9))
    likelihood = Likelihood(bp.noise.Independent(), [block("x")], {}, {"run": loadings})
    added = np.linalg.eigvalsh(loadings @ loadings.T)
    gain = 7 / 28.0
    for v in (1e-6, 1e-2, 1.0, 1e4):
        information = 0.5 * np.sum((v * gain / (v * gain + added)) ** 2)
        expected = 0.5 * np.log(information / 3.5)
        assert likelihood.log_prior(np.array([v])) == pytest.approx(expected, rel=1e-9)
    ends = likelihood.log_prior(np.array([[1e-12], [1e-10]]))
    assert ends[1] - ends[0] == pytest.approx(np.log(100.0), rel=1e-6)


STATIC = formula_model("static", ["a", "c"], lambda p, u, s: {"y": p.a * u.x + p.c * u.x**3})
WIDE = {"a": bp.Uniform(-100.0, 100.0), "c": bp.Uniform(-100.0, 100.0)}
X_SD, Y_SD = 0.15, 0.1


def static_run(seed: int, points: int = 21, x_sd: float = X_SD) -> bp.Experiment:
    """Return a static nonlinear response, input and output with white noise."""
    random, tau = np.random.default_rng(seed), grid(points)
    x = 2 * np.sin(2 * np.pi * tau) + 0.5 * np.cos(4 * np.pi * tau)
    y = x + 0.3 * x**3 + Y_SD * random.standard_normal(points)
    return bp.Experiment("run", 1.0, {"y": y}, {"x": x + x_sd * random.standard_normal(points)}, samples=points)


def static(run: bp.Experiment, input_noise: object, **changes: object) -> bp.Problem:
    known = {"fixed": {"variance[y]": Y_SD**2}}
    return bp.Problem(STATIC, [run], priors=WIDE, input_noise=input_noise, **(known | changes))


def test_a_static_problem_is_orthogonal_distance_regression():
    """Estimates and standard deviations of ODRPACK (Boggs, Byrd, Schnabel 1987), of data with known variances."""
    odrpack = pytest.importorskip("odrpack")
    run = static_run(0)
    fit = bp.map_estimate(static(run, {"x": X_SD}), **QUIET)
    found = odrpack.odr_fit(
        lambda x, b: b[0] * x + b[1] * x**3, run.inputs["x"], run.outputs["y"], np.array([1.0, 0.3]),
        weight_x=X_SD**-2, weight_y=Y_SD**-2, partol=1e-14, sstol=1e-14,
    )  # fmt: skip
    assert list(fit.theta.values()) == pytest.approx(found.beta, rel=1e-6)
    # ODRPACK's covariance is scaled by the mean square of the residuals unless these are the known ones.
    unscaled = np.sqrt(np.diag(found.cov_beta))
    assert list(fit.sd.values()) == pytest.approx(unscaled, rel=1e-5)
    assert fit.inputs["run"]["x"] == pytest.approx(found.xplusd, abs=1e-5)


def test_tiny_noise_gives_the_estimate_of_exact_inputs():
    run = static_run(1)
    exact, tiny = (bp.map_estimate(static(run, noise), **QUIET) for noise in ("exact", {"x": 1e-10}))
    assert list(tiny.theta.values()) == pytest.approx(list(exact.theta.values()), rel=1e-8)
    assert list(tiny.sd.values()) == pytest.approx(list(exact.sd.values()), rel=1e-8)
    assert exact.input_errors == {} and not exact.input_sd["run"]["x"].any()


def test_a_white_covariance_is_that_of_its_standard_deviation():
    run, size = static_run(2), 21
    white = X_SD**2 * np.diag(np.r_[1.0, np.full(size - 1, 2.0)]) / size
    one, other = (bp.map_estimate(static(run, {"x": noise}), **QUIET) for noise in (X_SD, white))
    assert list(one.theta.values()) == pytest.approx(list(other.theta.values()), rel=1e-9)
    # The mean square of the errors of one value is that standard deviation.
    prior = np.concatenate([np.full((1, size), 1.0), *([np.cos(2 * np.pi * h * grid(size))] for h in range(1, 11))])
    assert np.mean(prior[0] ** 2) * white[0, 0] + np.sum(np.diag(white)[1:]) / 2 == pytest.approx(X_SD**2)


@pytest.mark.slow
def test_attenuation_is_corrected_and_the_intervals_cover():
    """100 recordings of y = a·x + c·x³ with noise of 14 % of the input; 90 % intervals, 99.9 % band 0.79 to 0.98."""
    covered, ends = [], {"exact": [], "joint": []}
    for seed in range(100):
        run = static_run(seed + 10, x_sd=0.2)
        for kind, noise in (("exact", "exact"), ("joint", {"x": 0.2})):
            fit = bp.map_estimate(static(run, noise), start={"a": 1.0, "c": 0.3}, checks=False, **QUIET)
            off = (fit.theta["c"] - 0.3) / fit.sd["c"]
            ends[kind].append(off)
            if kind == "joint":
                covered.append(abs(off) < 1.645)
    assert 0.79 < np.mean(covered) < 0.98
    assert np.mean(np.abs(ends["exact"]) < 1.645) < 0.5
    assert abs(np.mean(ends["joint"])) < 3.3 / 10


def test_results_carry_the_errors_of_their_inputs(tmp_path):
    """Draws, their file, predictions and diagnostics have the density of the estimate; other draws are refused."""
    run = static_run(3)
    problem = static(run, {"x": X_SD}, fixed={})
    fit = bp.map_estimate(problem, **QUIET)
    posterior = bp.sample(problem, fit, seed=1, ensembles=2, max_steps=600, **QUIET)
    assert posterior.converged
    assert posterior.draws("c").std() == pytest.approx(fit.sd["c"], rel=0.3)
    posterior.save(tmp_path / "draws.nc")
    again = bp.load(tmp_path / "draws.nc")
    fit.save(tmp_path / "fit.h5")
    assert same(again.input_errors, fit.input_errors) and same(
        bp.load(tmp_path / "fit.h5").input_errors, fit.input_errors
    )
    assert set(bp.compare(problem, fit, again).table["verdict"]) == {"fine"}
    assert bp.predict(problem, again).table.equals(bp.predict(problem, posterior).table)
    (terms,) = again.tree["log_likelihood"].to_dataset().data_vars.values()
    place = {"chain": 0, "draw": int(terms["draw"][0])}
    draw = {
        name: again.draws(name).reshape(again.tree["posterior"]["a"].shape)[0, place["draw"]] for name in again.names
    }
    frozen = problem.with_input_errors(fit.input_errors).anchored(fit.theta)
    value = frozen.log_likelihood({"a": draw["a"], "c": draw["c"]}, {"y": draw["variance[y]"]})
    assert float(terms.sel(place).sum()) == pytest.approx(float(value), rel=1e-9)
    expected = fit.input_errors["run"].expected
    moved = again.tree["input_noise"].to_dataset().assign({"run expected errors": ("run error", expected + 1.0)})
    again.tree["input_noise"] = xr.DataTree(moved)
    with pytest.raises(ValueError, match="posterior: must be draws from the density of `fit`, got .* errors of the in"):
        bp.compare(problem, fit, again)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("known", "input_noise: must be one of"),
        (3.0, "input_noise: must be 'exact', 'measured', 'joint' or a mapping of inputs, got 3.0"),
        ({"z": 1.0}, "input_noise: must be 'x', got 'z'"),
        ({"x": -1.0}, r"input_noise\['x'\]: must be at least 0, got -1"),
        ({"x": np.eye(3)}, r"input_noise\['x'\]: must be a symmetric covariance \(21, 21\)"),
        ({"x": 1e-18 * (np.eye(21) + np.eye(21, k=1))}, r"input_noise\['x'\]: must be a symmetric covariance"),
        ({"x": 1e3 * np.eye(21, k=1)}, r"input_noise\['x'\]: must be a symmetric covariance"),
        ({"x": -np.eye(21)}, r"input_noise\['x'\]: must be positive semidefinite"),
    ],
)
def test_impossible_noise_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        static(static_run(0), given)


def noisy_gain(seed: int, shared: float = 0.0, cycles: int = 40, size: float = 0.3, bend: float = 0.0) -> bp.Experiment:
    """Return the mean period of y = 2·x + bend·x² with white noise of both, some of that of x also in y."""
    random, time = np.random.default_rng(seed), np.arange(40 * cycles) / 40.0
    x = np.cos(2 * np.pi * time) + 0.5 * np.sin(6 * np.pi * time)
    error = size * random.standard_normal(time.size)
    y = 2.0 * x + bend * x**2 + 0.1 * random.standard_normal(time.size) + shared * error
    return bp.Recording(time, {"y": y}, {"x": x + error}, name="run").fold(64, frequency=1.0, harmonics=8)


GAIN = formula_model("gain", ["a"], lambda p, u, s: {"y": p.a * u.x})


def gained(run: bp.Experiment, **settings: object) -> bp.MapEstimate:
    return bp.map_estimate(bp.Problem(GAIN, [run], priors={"a": bp.Normal(0.0, 10.0)}, **settings), starts=1, **QUIET)


def test_noise_of_inputs_is_integrated_out_by_default_where_the_cycles_show_it():
    run = noisy_gain(1)
    fit = gained(run)
    assert same(fit.input_errors, gained(run, input_noise="measured").input_errors) and fit.input_errors
    assert not same(fit.input_errors, gained(run, input_noise="exact").input_errors)
    few = gained(noisy_gain(1, cycles=3))
    assert few.input_errors and few.input_sd["run"]["x"].any()
    single = replace(run, cycles=1)
    with pytest.warns(UserWarning, match="inputs are taken as exact. Take input_noise='measured'"):
        alone = gained(single)
    assert not alone.input_errors and not alone.input_sd["run"]["x"].any()
    problem = bp.Problem(GAIN, [single], priors={"a": bp.Normal(0.0, 10.0)})
    assert problem.input_noise == "exact" and problem.with_experiments([run]).noisy_inputs == {"run": ["x"]}


@pytest.mark.slow
def test_correlated_noise_of_input_and_output_is_found_and_used():
    """Of 60 recordings with independent noise at most 5 show a correlation at the level 1 % (false alarm 4e-4).

    With 0.6 of the error of x in y, the response to it is 2 − 0.6, and the expected error of a is so much smaller;
    the mean square of z over 60 recordings is between 0.4 and 1.6 (99.9 %), and smaller if the correlation is ignored.
    """
    assert sum(bool(noisy_gain(seed).error_slopes) for seed in range(60)) <= 5
    runs = [noisy_gain(100 + seed, 0.6) for seed in range(60)]
    slopes = np.array([run.error_slopes["x"]["y"] for run in runs])
    assert slopes.mean() == pytest.approx(0.6, abs=0.02)
    used = np.array([(f.theta["a"] - 2.0) / f.sd["a"] for f in map(gained, runs)])
    ignored = [gained(replace(run, error_slopes={})) for run in runs]
    assert 0.4 < np.mean(used**2) < 1.6
    assert np.mean([((f.theta["a"] - 2.0) / f.sd["a"]) ** 2 for f in ignored]) < 0.7 * np.mean(used**2)
    with pytest.raises(
        ValueError, match="input_noise: must be 'measured' where errors of inputs and outputs correlate"
    ):
        gained(runs[0], input_noise="joint")


def test_correlated_errors_give_the_estimate_of_outputs_without_them():
    """For y = a·x, errors 0.6 of those of x in y are none of those in y − 0.6·x = (a − 0.6)·x."""
    run = noisy_gain(3, 0.6)
    slope = np.full(run.error_slopes["x"]["y"].size, 0.6 + 0j)
    fit = gained(replace(run, error_slopes={"x": {"y": slope}}))
    x = _fourier.on_grid(_fourier.coefficients(run.inputs["x"])[: slope.size], 64)
    other = replace(run, error_slopes={}, outputs={"y": run.outputs["y"] - 0.6 * x})
    problem = bp.Problem(GAIN, [other], priors={"a": bp.Normal(-0.6, 10.0)})
    without = bp.map_estimate(problem, starts=1, **QUIET)
    assert fit.theta["a"] - 0.6 == pytest.approx(without.theta["a"], abs=1e-6 * fit.sd["a"])
    assert fit.sd["a"] == pytest.approx(without.sd["a"], rel=1e-6)
    assert fit.variances["y"] == pytest.approx(without.variances["y"], rel=1e-6)
    assert fit.inputs["run"]["x"] == pytest.approx(without.inputs["run"]["x"], abs=1e-8)


def test_robust_sd_is_at_least_what_noise_of_the_inputs_causes():
    """The mean of x, with an error of 0.2, is twice in the offset, which removes its residual from the data."""
    model = formula_model("line", ["a", "b"], lambda p, u, s: {"y": p.a * u.x + p.b})
    variance = np.full(17, 1e-6)
    variance[0] = 0.04
    problem = bp.Problem(
        model, [noisy_gain(3, size=1e-3)], priors=dict.fromkeys("ab", bp.Normal(0.0, 10.0)),
        input_noise={"x": np.diag(variance)},
    )  # fmt: skip
    fit = bp.map_estimate(problem, starts=1, **QUIET)
    assert fit.sd["b"] == pytest.approx(0.4, rel=0.1) and fit.robust_sd["b"] == pytest.approx(0.4, rel=0.1)


@pytest.mark.slow
def test_noise_of_inputs_is_no_misfit_of_the_model_and_a_wrong_model_is_one():
    """60 recordings of the right model at the level 1 %: more than 4 rejections have a probability of 3e-4."""
    priors = {"a": bp.Normal(0.0, 10.0)}
    wrong = formula_model("stiff", ["a"], lambda p, u, s: {"y": p.a + 1.8 * u.x})
    found = {GAIN: [], wrong: []}
    for model, texts in found.items():
        for seed in range(60 if model is GAIN else 5):
            problem = bp.Problem(model, [noisy_gain(300 + seed)], priors=priors)
            fit = bp.map_estimate(problem, starts=1, **QUIET)
            texts.append(misfit(problem.with_input_errors(fit.input_errors), fit))
    assert sum(map(bool, found[GAIN])) <= 4
    assert all("the residual is larger than the measured noise" in text for text in found[wrong])


def test_results_say_in_words_that_the_covariance_includes_the_noise_of_inputs():
    problem = bp.Problem(GAIN, [noisy_gain(1)], priors={"a": bp.Normal(0.0, 10.0)})
    fit = bp.map_estimate(problem, starts=1, **QUIET)
    assert repr(problem).endswith("independent noise, noise of x integrated out)")
    assert f"The noise of the inputs, included in the covariance, causes {fit.input_noise['y']:.3g} in y" in repr(fit)
    found = bp.predict(problem, bp.sample(problem, fit, seed=1, ensembles=2, max_steps=300, **QUIET))
    assert "the noise of the inputs" in found.note and found.note in repr(found) and found.verdict == "adequate"
    exact = bp.Problem(GAIN, problem.experiments, priors=problem.priors, input_noise="exact")
    assert repr(exact).endswith("independent noise)")
    assert "The noise of the inputs" not in repr(bp.map_estimate(exact, starts=1, **QUIET))


def test_errors_as_parameters_give_the_same_estimate():
    """Another route: amplitudes of the input's errors as parameters of an ordinary problem, all fitted together."""
    model = formula_model("lag", ["a", "b"], lambda p, u, s: {"y": p.a * s.w + p.b * s.w**3 + 0.1 * u.dx})
    random, time = np.random.default_rng(5), np.arange(40 * 30) / 40.0
    wave = 2 * np.pi * time
    exact = bp.Experiment.from_harmonics("run", 1.0, {"y": [0, 1]}, {"x": [0, 1, 0.4]}, samples=64)
    true = bp.solve_periodic(model, {"a": 2.0, "b": 1.0}, exact.inputs, frequency=1.0, samples=64).outputs["y"]
    y = _fourier.on_grid(_fourier.coefficients(true), 64)
    y = np.interp(time % 1.0, np.arange(65) / 64, np.append(y, y[0])) + 0.02 * random.standard_normal(time.size)
    x = np.cos(wave) + 0.4 * np.cos(2 * wave) + 0.2 * random.standard_normal(time.size)
    run = bp.Recording(time, {"y": y}, {"x": x}, name="run").fold(64, frequency=1.0, harmonics={"x": 4, "y": 12})
    given = {"priors": {"a": bp.Normal(0.0, 10.0), "b": bp.Normal(0.0, 10.0)}}
    fit = bp.map_estimate(bp.Problem(model, [run], **given), starts=1, **QUIET)
    problem = bp.Problem(model, [run], **given, input_noise="joint")
    assert len(problem.names) == 2 + 9 and not problem.noisy_inputs
    joint = bp.map_estimate(problem, starts=1, **QUIET)
    for name in ("a", "b"):
        assert joint.theta[name] == pytest.approx(fit.theta[name], abs=0.03 * fit.sd[name])
        assert joint.sd[name] == pytest.approx(fit.sd[name], rel=0.02)
    errors = {name.partition("[")[0]: value for name, value in joint.theta.items()}
    amplitudes = [errors["x_mean"], *(errors[f"x_cos{h}"] - 1j * errors[f"x_sin{h}"] for h in range(1, 5))]
    moved = run.inputs["x"] - _fourier.on_grid(np.array(amplitudes), 64)
    assert moved == pytest.approx(fit.inputs["run"]["x"], abs=0.05 * fit.input_sd["run"]["x"].max())


def test_strong_nonlinearity_in_the_errors_is_reported():
    """The output a·exp(4x) with errors of x of 0.5: nothing like linear. With errors of 0.005 it is."""
    steep = formula_model("steep", ["a"], lambda p, u, s: {"y": p.a * sp.exp(4 * u.x)})
    tau = np.arange(21) / 21
    random = np.random.default_rng(2)
    for sd, curved in ((0.5, True), (0.005, False)):
        x = np.cos(2 * np.pi * tau)
        inputs = {"x": x + sd * random.standard_normal(21)}
        run = bp.Experiment("run", 1.0, {"y": np.exp(4 * x) + 0.1 * random.standard_normal(21)}, inputs, samples=21)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fit = bp.map_estimate(
                bp.Problem(steep, [run], priors={"a": bp.Normal(0.0, 10.0)}, input_noise={"x": sd}), starts=1, **QUIET
            )
        said = any("too large to be linearised" in str(warning.message) for warning in caught)
        assert said is curved and (fit.input_nonlinearity["a"] > 0.3) is curved


def test_the_band_of_a_value_contains_what_errors_of_inputs_leave_unknown():
    """D + L·A·Lᵀ with A = (1 + Lᵀ·D⁻¹·L)⁻¹, averaged over the components, by dense matrices."""
    loadings = 0.3 * np.random.default_rng(1).standard_normal((16, 4))
    for noise in (NOISES["independent"], NOISES["circulant"]):
        likelihood = Likelihood(noise, BLOCKS, {}, {"run": loadings})
        plain = Likelihood(noise, BLOCKS, {})
        values = np.exp(0.5 * np.random.default_rng(2).standard_normal((3, len(likelihood.names))) - 1.0)
        for row, found in zip(values, likelihood.value_variances(values)["run", "y"], strict=True):
            d = np.diag(dense(likelihood, row, 0.0 * loadings)).copy()
            left = loadings @ np.linalg.inv(np.eye(4) + (loadings.T / d) @ loadings) @ loadings.T
            expected = plain.value_variances(row)["run", "y"] + np.diag(left)[7:14].mean()
            assert found == pytest.approx(float(expected), rel=1e-9)


def test_coloured_noise_has_intervals_as_wide_as_white_noise_where_it_is_white():
    """The correlation of the noise integrated out, errors of the input eliminated: sds within 30 % of white noise."""
    run = noisy_gain(3)
    assert gained(run, noise="circulant").sd["a"] == pytest.approx(gained(run).sd["a"], rel=0.3)


def test_calibration_records_the_noise_of_inputs():
    """The recordings' input has the noise that the problem says: its fit has errors, of the measured size."""
    run = noisy_gain(1)
    prior = bp.noise.Independent(prior=bp.InverseGamma(3.0, 0.02))
    problem = bp.Problem(GAIN, [run], priors={"a": bp.Normal(2.0, 0.2)}, noise=prior)
    again = calibration._measured(problem, run, {"a": 2.0}, {"variance[y]": 0.01}, np.random.default_rng(1))
    ratio = again.amplitude_variance["x"].mean() / run.amplitude_variance["x"].mean()
    assert 0.5 < ratio < 2.0 and again.cycles >= 0.9 * run.cycles
    with pytest.raises(ValueError, match="problem: must have another input_noise than 'joint'"):
        bp.calibrate(
            bp.Problem(GAIN, [run], priors={"a": bp.Normal(2.0, 0.2)}, noise=prior, input_noise="joint"),
            replicates=1, seed=1,
        )  # fmt: skip


def test_points_of_a_mask_need_white_noise():
    run = replace(static_run(4), mask=np.arange(21) < 15, independent={}, harmonics={})
    with pytest.raises(
        ValueError, match="input_noise: must be 'joint' or 'exact' for points of a mask with 'circulant' noise, got"
    ):
        bp.Problem(STATIC, [run], priors=WIDE, noise="circulant", input_noise={"x": X_SD})
    fit = bp.map_estimate(static(run, {"x": X_SD}), **QUIET)
    odr = pytest.importorskip("odrpack").odr_fit(
        lambda x, b: b[0] * x + b[1] * x**3, run.inputs["x"][:15], run.outputs["y"][:15], np.array([1.0, 0.3]),
        weight_x=X_SD**-2, weight_y=Y_SD**-2, partol=1e-14, sstol=1e-14,
    )  # fmt: skip
    assert list(fit.theta.values()) == pytest.approx(odr.beta, rel=1e-5)


def test_a_single_channel_has_the_dense_covariance_too():
    random = np.random.default_rng(5)
    loadings, r, v = (
        0.3 * random.standard_normal((7, 5)),
        random.standard_normal((3, 7)),
        np.array([[0.3], [1.0], [9.0]]),
    )
    likelihood = Likelihood(bp.noise.Independent(), [block("x")], {}, {"run": loadings})
    for i in range(3):
        covariance = 0.25 * v[i] * np.eye(7) + loadings @ loadings.T
        exact = stats.multivariate_normal(np.zeros(7), covariance).logpdf(r[i]) + 3.5 * np.log(2 * np.pi)
        assert likelihood([r], v)[i] == pytest.approx(exact, rel=1e-10)
        assert likelihood([r[i]], v[i]) == likelihood([r], v)[i]


def test_the_fit_is_drawn_with_the_errors_of_the_input():
    run = static_run(6)
    problem = static(run, {"x": X_SD})
    estimate = bp.map_estimate(problem, **QUIET)
    figure = bp.plot.fit(problem, estimate)
    assert [axes.get_ylabel() for axes in figure.axes] == ["y", "residual", "error of\nx"]
    (drawn, _), error = figure.axes[-1].lines, run.inputs["x"] - estimate.inputs["run"]["x"]
    assert drawn.get_ydata() == pytest.approx(error)
    exact = static(run, "exact")
    assert len(bp.plot.fit(exact, bp.map_estimate(exact, **QUIET)).axes) == 2
    plt.close("all")


def test_replicates_are_of_what_was_measured_with_the_noisy_input():
    """Without noise a replicate plus the compared residual, without what the input's errors cause, is the data."""
    run = static_run(7)
    problem = static(run, {"x": X_SD})
    fit = bp.map_estimate(problem, **QUIET)
    frozen = problem.with_input_errors(fit.input_errors)
    here = frozen.anchored(fit.theta).density().linearise(frozen.vector(fit.theta))
    seen, (residual,) = frozen.observations["run"], here.residuals
    response = here.solver.solve(here.theta[None]).response("run")
    (replicate,) = seen.replicates(response, [np.zeros((1, residual.size))])["y"]
    assert np.abs(seen.caused[0]).max() > 0.05
    assert replicate + _fourier.from_components(residual, 21) == pytest.approx(run.outputs["y"], abs=1e-9)
