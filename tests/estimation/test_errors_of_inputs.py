"""Errors of inputs given an estimate, by conditioning a normal distribution; models that are linear in the input."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation import covariance, map_estimate
from bayesperiodic.estimation.check import at_estimate
from tests.estimation.test_changes_with_variances import MODEL, POINTS, PRIORS, SPECTRA, run_of
from tests.known import formula_model, grid

KEPT = {"y": 4, "z": 2}
SD = 0.05
VARIANCE = {"y": 0.004, "z": 0.0009}


def solved(runs, input_noise):
    known = {f"variance[{channel}]": value for channel, value in VARIANCE.items()}
    problem = bp.Problem(MODEL, runs, priors=PRIORS, scheme="fourier", input_noise=input_noise, fixed=known)
    fit = bp.map_estimate(problem, starts=1, checks=False, progress=False)
    objective, peak = at_estimate(problem, fit)
    return objective.density.problem, peak, fit


def waves_of(sd):
    """Return the signals (errors, points) of mean, cosines and sines of three harmonics, each with one seventh."""
    order = np.arange(1, 4)[:, None]
    phase = 2 * np.pi * order * grid(POINTS)
    power = sd * np.sqrt(np.r_[1.0, np.full(6, 2.0)] / 7)
    return power[:, None] * np.concatenate([np.ones((1, POINTS)), np.cos(phase), np.sin(phase)])


def shown(signals, theta, frequency=0.1):
    """Return the components of what inputs (…, points) cause: the outputs in an orthonormal basis of kept harmonics."""
    rates = np.fft.irfft(np.fft.rfft(signals) * 2j * np.pi * frequency * np.arange(POINTS // 2 + 1), POINTS)
    parts = []
    for values, highest in ((theta[0] * signals + theta[1] * rates, KEPT["y"]), (theta[1] * signals, KEPT["z"])):
        parts.append(components(values, highest))
    return np.concatenate(parts, axis=-1)


def components(values, highest):
    phase = 2 * np.pi * np.arange(1, highest + 1)[:, None] * grid(POINTS)
    waves = np.sqrt(2.0) * np.concatenate([np.cos(phase), np.sin(phase)])
    basis = np.concatenate([np.ones((1, POINTS)), waves]) / np.sqrt(POINTS)
    return values @ basis.T * np.sqrt((2 * highest + 1) / POINTS)


def conditioned(run, theta, waves):
    """Return mean and covariance of the errors given the data, with white noise of the kept components."""
    loadings = shown(waves, theta)
    data = np.concatenate([components(run.outputs[channel], KEPT[channel]) for channel in "yz"])
    residual = data - shown(run.inputs["x"], theta)
    # An average over as many samples as points.
    variance = np.concatenate([np.full(2 * h + 1, VARIANCE[c] * (2 * h + 1) / POINTS) for c, h in KEPT.items()])
    spread = np.linalg.inv(np.eye(len(waves)) + (loadings / variance) @ loadings.T)
    return -spread @ (loadings / variance) @ residual, spread, residual, loadings


def test_expected_errors_and_their_covariance_are_those_given_the_data():
    waves = waves_of(SD)
    runs = [run_of(cycles=1), run_of("second", 2, cycles=1)]
    problem, peak, _ = solved(runs, {"x": SD})
    seen = covariance.estimated_inputs(problem, peak)
    assert [*seen.errors] == [*seen.covariances] == [*seen.sd] == ["run", "second"]
    left = {e.name: [] for e in runs}
    for block, part in zip(problem.likelihood.blocks, seen.residuals, strict=True):
        left[block.experiment].append(part)
    for run in runs:
        mean, spread, residual, loadings = conditioned(run, peak.theta, waves)
        assert seen.errors[run.name].expected == pytest.approx(mean, rel=1e-5, abs=1e-6)
        assert seen.covariances[run.name] == pytest.approx(spread, abs=1e-7)
        points = np.sqrt(np.sum((spread @ waves) * waves, axis=0))
        assert seen.sd[run.name]["x"] == pytest.approx(points, rel=1e-6)
        # The residual with the estimated inputs, whose squares do not depend on the order of components.
        rest = residual + mean @ loadings
        sizes = np.split(rest, [2 * KEPT["y"] + 1])
        for part, expected in zip(left[run.name], sizes, strict=True):
            assert np.sum(part**2) == pytest.approx(np.sum(expected**2), rel=1e-4)
        assert np.linalg.norm(seen.errors[run.name].caused) == pytest.approx(np.linalg.norm(mean @ loadings), rel=1e-5)
        assert np.sum(seen.errors[run.name].loadings ** 2) == pytest.approx(np.sum(loadings**2), rel=2e-3)


def test_inputs_without_errors_have_no_spread():
    problem, peak, _ = solved([run_of(cycles=1)], "exact")
    seen = covariance.estimated_inputs(problem, peak)
    assert seen.errors == {} == seen.covariances and seen.sd["run"]["x"].tolist() == [0.0] * POINTS
    assert all(np.array_equal(a, b) for a, b in zip(seen.residuals, peak.here.residuals, strict=True))
    assert covariance.caused_by_inputs(problem, {}) == {"y": 0.0, "z": 0.0}


def test_errors_that_change_nothing_are_left_out():
    """Of a hundred-millionth of the noise of the outputs; the spread of the input is that of the measurement."""
    problem, peak, _ = solved([run_of(cycles=1)], {"x": 1e-8})
    seen = covariance.estimated_inputs(problem, peak)
    assert seen.errors == {}
    assert seen.sd["run"]["x"] == pytest.approx(np.sqrt(np.sum(waves_of(1e-8) ** 2, axis=0)), rel=1e-6)


def in_unit(factor, p, u, s):
    return {"y": p.a * u.x + p.b * u.dx, "z": factor * p.b * u.x}


@pytest.mark.parametrize("unit", [1e-5, 1e3])
def test_robust_sds_do_not_depend_on_the_units_of_outputs(unit):
    """Of two outputs that share the errors of an input, with unknown variances; one output in another unit."""
    priors = {name: bp.Normal(0.0, 10.0) for name in "ab"}
    sds = []
    for factor in (1.0, unit):
        model, run = formula_model("static", ["a", "b"], partial(in_unit, factor)), run_of(cycles=1)
        outputs = {"y": run.outputs["y"], "z": factor * run.outputs["z"]}
        spectra = SPECTRA | {"z": factor**2 * SPECTRA["z"]}
        runs = [replace(run, outputs=outputs, amplitude_variance=spectra)]
        problem = bp.Problem(model, runs, priors=priors, scheme="fourier", input_noise={"x": SD})
        fit = bp.map_estimate(problem, starts=1, progress=False)
        sds.append([*fit.robust_sd.values(), *fit.sd.values()])
    assert sds[1] == pytest.approx(sds[0], rel=1e-3)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_noise_that_inputs_cause_is_their_spread_times_the_gain(factor):
    """Root mean square over the period, of two experiments; proportional to the noise of the input."""
    waves = waves_of(SD)
    problem, peak, fit = solved([run_of(cycles=1), run_of("second", 2, cycles=1)], {"x": SD})
    noise = {"x": factor * SD}
    loadings = covariance.input_loadings(problem, peak.theta, fit.solutions, noise)
    assert {name: one.shape for name, one in loadings.items()} == {"run": (14, 7), "second": (14, 7)}
    expected = shown(factor * waves, peak.theta)
    assert np.sum(loadings["run"] ** 2, axis=0) == pytest.approx(np.sum(expected**2, axis=1), rel=1e-6)
    caused = covariance.caused_by_inputs(problem, loadings)
    for channel, part in zip("yz", np.split(expected, [9], axis=1), strict=True):
        size = part.shape[1]
        assert caused[channel] == pytest.approx(np.sqrt(np.sum(part**2) / size), rel=1e-6)
    half = {"run": loadings["run"], "second": 0.0 * loadings["second"]}
    less = covariance.caused_by_inputs(problem, half)
    assert less == pytest.approx({channel: value / np.sqrt(2) for channel, value in caused.items()})


def robust(factor, names):
    """Return the robust covariance with the second channel in another unit, which is `factor` of the first one."""
    model = formula_model("static", ["a", "b"], lambda p, u, s: {"y": p.a * u.x + p.b * u.dx, "z": factor * p.b * u.x})
    runs = [run_of(name, seed, cycles=1) for seed, name in enumerate(names)]
    runs = [replace(run, outputs=run.outputs | {"z": factor * run.outputs["z"]}) for run in runs]
    known = {"variance[y]": VARIANCE["y"], "variance[z]": factor**2 * VARIANCE["z"]}
    problem = bp.Problem(model, runs, priors=PRIORS, scheme="fourier", input_noise={"x": SD}, fixed=known)
    fit = bp.map_estimate(problem, starts=1, checks=False, progress=False)
    objective, peak = at_estimate(problem, fit)
    density = objective.density.problem
    inverse = np.linalg.inv(covariance.uncertainty(density, peak, 1.0).information)
    return covariance.robust_covariance(density, peak, inverse), inverse


@pytest.mark.parametrize("names", [("run",), ("run", "second")])
def test_robust_covariance_does_not_depend_on_units_of_channels_that_share_errors(names):
    """The errors of an input are in both channels; one in mm instead of m is the same measurement."""
    expected, laplace = robust(1.0, names)
    for factor in (1e-5, 1e5):
        assert robust(factor, names)[0] == pytest.approx(expected, rel=1e-5)
    assert (np.diag(expected) < 4.0 * np.diag(laplace)).all()


def test_linear_models_have_no_nonlinearity_and_fine_grids_no_shift():
    """Of a static model each grid has the response of the same Fourier series."""
    problem, peak, fit = solved([run_of(cycles=1)], {"x": SD})
    spread = np.linalg.inv(covariance.uncertainty(problem, peak, 1.0).information)
    assert covariance.input_nonlinearity(problem, peak, fit.solutions, spread) == pytest.approx([0.0, 0.0], abs=1e-6)
    assert covariance.doubling_shift(problem, peak, fit.solutions, spread) == pytest.approx([0.0, 0.0], abs=1e-6)
    exact, at, other = solved([run_of(cycles=1)], "exact")
    assert covariance.input_nonlinearity(exact, at, other.solutions, spread).tolist() == [0.0, 0.0]


def test_nonlinearity_is_not_known_where_a_solve_fails(monkeypatch):
    problem, peak, fit = solved([run_of(cycles=1)], {"x": SD})
    spread = np.linalg.inv(covariance.uncertainty(problem, peak, 1.0).information)
    monkeypatch.setattr(covariance, "_solved", lambda *_: None)
    assert covariance.input_nonlinearity(problem, peak, fit.solutions, spread).tolist() == pytest.approx(
        [np.nan, np.nan], nan_ok=True
    )


def test_shifts_are_gauss_newton_steps_in_standard_deviations():
    """C Jᵀ S⁻¹ Δ over the root of the diagonal of C, with errors of the inputs in S."""
    problem, peak, _ = solved([run_of(cycles=1)], {"x": SD})
    sizes = [block.size for block in problem.likelihood.blocks]
    generator = np.random.default_rng(3)
    moved = [generator.standard_normal(size) for size in sizes]
    loadings = problem.likelihood.loadings["run"]
    variance = np.concatenate([np.full(n, VARIANCE[c] * n / POINTS) for c, n in zip("yz", sizes, strict=True)])
    inverse = np.linalg.inv(np.diag(variance) + loadings @ loadings.T)
    jacobian = np.concatenate(peak.here.jacobian, axis=1)
    spread = np.array([[4.0, 0.5], [0.5, 0.09]])
    expected = spread @ jacobian @ inverse @ np.concatenate(moved) / np.array([2.0, 0.3])
    assert covariance._shift(problem, peak, moved, spread) == pytest.approx(expected, rel=1e-8)
    twice = covariance._shift(problem, peak, [2.0 * part for part in moved], spread)
    assert twice == pytest.approx(2.0 * expected, rel=1e-8)


def test_estimate_that_still_moves_names_what_cannot_be_linearised(monkeypatch):
    monkeypatch.setattr(map_estimate, "MOST_LINEARISATIONS", 1)
    with pytest.warns(UserWarning, match=r"errors of the inputs could not .*: estimate or inputs still .*'joint'"):
        solved([run_of(cycles=1)], {"x": SD})
