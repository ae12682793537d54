"""Estimates from orbits that are included one after the other, against the truth of an independent integrator."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
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
    generator = np.random.default_rng(1)
    noise = {n: np.std(v) * generator.standard_normal(v.size) for n, v in first.outputs.items()}
    wrong = replace(first, name="wrong", outputs=noise)
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


def test_no_orbit_at_all_is_refused():
    given = problem((1.0,) * 6)
    far = {name: 30.0 * value for name, value in BEAM.items()}
    with pytest.raises(ValueError, match=r"problem: must have an orbit that the model has near the start, got none: "):
        bp.estimate_orbits(given.replace(experiments=given.experiments[:1]), start=far, progress=False)
    with pytest.raises(ValueError, match="start: must"):
        bp.estimate_orbits(given, start={"unknown": 1.0}, progress=False)
    with pytest.raises(ValueError, match="problem: must be a Problem"):
        bp.estimate_orbits("x")
