"""Estimates from orbits that are included one after the other, against the truth of an independent integrator."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

import bayesperiodic as bp
from studies import shooting
from studies.harvester import synthetic
from tests.orbits.test_waveform import BEAM, beam, beam_orbits, double_well_orbits


def problem(factors, spread=0.4, **changes):
    """Return the problem of the beam's orbits with priors whose medians are `factors` times the truth."""
    orbits = sorted(beam_orbits(0), key=lambda one: (one.period, abs(one.eigenvalues[0])))
    runs = [one.experiment(samples=128, whole=True) for one in orbits]
    priors = {n: bp.LogNormal(f * v, spread) for (n, v), f in zip(BEAM.items(), factors, strict=True)}
    return bp.Problem(beam(), runs, **{"priors": priors, "fixed": {"scale": 1.0}} | changes)


def test_orbits_one_after_the_other_give_the_parameters():
    """Six parameters within five standard deviations, which are too small by a factor of 1.13: false alarms 0.01 %."""
    wide = problem((1.08, 0.95, 1.06, 1.08, 0.94, 1.05))
    estimate = bp.estimate_orbits(wide, progress=False)
    assert estimate.dropped == {} and len(estimate.problem.experiments) == len(wide.experiments)
    assert estimate.fit.converged
    for name, value in BEAM.items():
        assert abs(estimate.fit.theta[name] - value) < 5.0 * estimate.fit.sd[name]
    assert list(estimate.table.index) == [one.name for one in estimate.problem.experiments]
    for one in estimate.problem.experiments:
        residuals = estimate.fit.residuals[one.name]["v"][:: one.samples // 16]  # the 16 phases that are compared
        assert estimate.table.loc[one.name, "rms[v]"] == pytest.approx(np.sqrt(np.mean(residuals**2)))
    # The first solves start at the solutions, so that the estimate is where it was.
    again = bp.map_estimate(estimate.problem, start=estimate.fit.theta, checks=False, progress=False)
    assert again.theta == pytest.approx(estimate.fit.theta, rel=1e-6)
    text = str(estimate)
    assert text.startswith(f"OrbitsEstimate from {len(wide.experiments)} orbits")


def test_an_orbit_that_the_model_does_not_have_is_dropped_and_named():
    """The waveform of one orbit is replaced by noise of its size."""
    given = problem((1.02, 1.0, 1.0, 1.02, 1.0, 1.0), spread=0.1)
    first = given.experiments[0]
    wrong = replace(first, name="wrong", outputs=with_noise_for_waveform(first))
    estimate = bp.estimate_orbits(given.replace(experiments=[*given.experiments, wrong]), progress=False)
    assert list(estimate.dropped) == ["wrong"]
    assert [one.name for one in estimate.problem.experiments] == [one.name for one in given.experiments]
    assert "Dropped 'wrong': " in str(estimate)


def test_orbits_that_determine_the_noise_only_together_are_taken_in_together():
    """Two values of an orbit of period 1 determine no two parameters and a variance; within five sd of all."""
    orbits = [one for one in double_well_orbits(0, 2)[1] if abs(one.eigenvalues[0]) < 20]
    runs = [one.experiment(samples=960, states={"x": "x"}) for one in orbits]
    well = bp.Model(
        "well", states=["x"], inputs=["u"], parameters=["c", "a"], equations=["ddx + c*dx - a*x*(1 - x**2) - u"],
        outputs={"x": "x", "y": "dx"},
    )  # fmt: skip
    given = bp.Problem(well, runs, priors={"c": bp.LogNormal(0.2, 0.2), "a": bp.LogNormal(0.5, 0.2)})
    with pytest.raises(ValueError, match="independent values"):
        given.with_experiments(runs[:1])
    estimate = bp.estimate_orbits(given, progress=False)
    assert len(estimate.problem.experiments) >= 4
    for name, value in {"c": 0.2, "a": 0.5}.items():
        assert abs(estimate.fit.theta[name] - value) < 5.0 * estimate.fit.sd[name] < 0.05 * value


def with_noise_for_waveform(experiment):
    generator = np.random.default_rng(1)
    return {n: np.std(v) * generator.standard_normal(v.size) for n, v in experiment.outputs.items()}


def test_no_orbit_at_all_is_refused():
    given = problem((1.0,) * 6)
    wrong = replace(given.experiments[0], outputs=with_noise_for_waveform(given.experiments[0]))
    with pytest.raises(ValueError, match=r"problem: must have an orbit that the model has near the start, got none: "):
        bp.estimate_orbits(given.replace(experiments=[wrong]), progress=False)
    with pytest.raises(ValueError, match="start: must"):
        bp.estimate_orbits(given, start={"unknown": 1.0}, progress=False)
    with pytest.raises(ValueError, match="problem: must be a Problem"):
        bp.estimate_orbits("x")


# States (x, x', v) of four orbits of period 2 of `studies.harvester.synthetic` at whole periods of the drive, rounded.
PERIOD_2 = (
    [[0.1691, -3.8367, 0.1221], [-0.1569, -2.4849, -0.0643]],
    [[-0.1779, -2.4268, -0.0833], [0.1718, -3.2947, 0.1211]],
    [[0.1296, 1.797, 0.0705], [0.0531, -3.6903, -0.021]],
    [[-0.0555, -2.2498, -0.0047], [0.1651, -5.0761, 0.1173]],
)


@cache
def waveforms():
    """Return the velocity and voltage (32, 2) of these orbits at 16 phases a period, by shooting with SciPy."""
    result = []
    for guess in PERIOD_2:
        orbit = shooting.closed(synthetic.flow, np.arange(3.0), np.array(guess), np.zeros(3), accuracy=1e-9)
        course = []
        for k, state in enumerate(orbit.states):
            for j in range(16):
                course.append(state[1:])
                state = synthetic.flow(k + j / 16, k + (j + 1) / 16, state)[0]
        result.append(np.array(course))
    return result


def correlated_runs(seed, smooth=0.01, white=1e-4):
    """Return experiments of a hidden displacement; errors of the waveforms are smooth but for a hundredth of them."""
    generator, tau, runs = np.random.default_rng(seed), np.arange(32) / 16, []
    courses = [np.cos(np.pi * k * tau) for k in range(4)] + [np.sin(np.pi * k * tau) for k in range(1, 4)]
    mask = np.arange(256) % 8 == 0
    for k, clean in enumerate(waveforms()):
        size = clean.std(axis=0)
        common, rest = 0.5 * np.kron(np.transpose(courses), np.diag(smooth * size)), np.tile(white * size, 32)
        errors = common @ generator.standard_normal(14) + rest * generator.standard_normal(64)
        outputs = {name: np.zeros(256) for name in ("velocity", "voltage")}
        for name, values in zip(outputs, (clean + errors.reshape(32, 2)).T, strict=True):
            outputs[name][mask] = values
        drive = synthetic.AMPLITUDE * np.cos(np.pi * np.arange(256) / 64)
        runs.append(
            bp.Experiment(
                f"orbit {k}", synthetic.FREQUENCY, outputs, {"drive": drive}, samples=128, periods=2, mask=mask,
                covariance=common @ common.T + np.diag(rest**2), guess="data", synthetic=True,
            )
        )  # fmt: skip
    return runs


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_correlated_errors_and_a_hidden_state_need_no_accurate_start(seed):
    """Priors whose medians are 18 % off, standard errors 0.1 % or less: false alarms 0.2 % for the seven parameters."""
    generator = np.random.default_rng([seed, 1])
    medians = {n: v * np.exp(0.18 * generator.standard_normal()) for n, v in synthetic.TRUTH.items()}
    given = bp.Problem(
        synthetic.MODEL, correlated_runs(seed), priors={n: bp.LogNormal(v, 0.3) for n, v in medians.items()},
        fixed={"scale": 1.0},
    )  # fmt: skip
    estimate = bp.estimate_orbits(given, progress=False)
    assert estimate.dropped == {} and estimate.fit.converged
    assert estimate.problem.fixed == given.fixed and estimate.problem.noise_names == ("scale",)
    away = np.array([estimate.fit.theta[name] - value for name, value in synthetic.TRUTH.items()])
    names = [*synthetic.TRUTH]
    # Mean squares of 64 residuals, less what the seven parameters explain of 256.
    squares = estimate.table["rms/sd"] ** 2
    assert all(chi2.ppf(1e-5, 57) < 64.0 * one < chi2.isf(1e-5, 64) for one in squares)
    assert away @ np.linalg.solve(estimate.fit.covariance.loc[names, names], away) < chi2.isf(2e-3, 7)
