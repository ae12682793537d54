"""The study of response tables."""

import json

import numpy as np
import pytest

import bayesperiodic as bp
from studies.__main__ import main
from studies.resonance import calibration, systems


@pytest.mark.slow
def test_quick_run_makes_posteriors_of_all_kinds_and_is_faster_than_free_delays(tmp_path):
    folder = tmp_path / "resonance"
    assert main(["resonance", "--quick", "--out", str(folder)]) == 0
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    for kind in calibration.KINDS:
        assert results[kind]["converged"] == 1.0 and results[kind]["least effective number"] > 100
    left = {kind: results[kind]["sd over that of the prior"] for kind in calibration.KINDS}
    # Phases determine the damping, a backbone without a force says nothing of it.
    assert left[calibration.PHASE]["c"] < 0.2 < left[calibration.AMPLITUDE]["c"]
    assert left[calibration.BACKBONE]["c"] > 0.9 and left[calibration.ALL]["c"] < 0.05
    assert results["speed"]["ratio"] > 2.0  # of processor times; 5.1 to 6.5 on two busy cores
    assert results["speed"]["finite, table"] == 1.0 and results["speed"]["finite, improvised"] > 0.9


def test_weighted_draws_are_those_of_a_known_posterior():
    """Two resonance points of a backbone: the damping keeps its prior, whose moments of ln c are known."""
    rng = np.random.default_rng(1)
    problem, truth = calibration.drawn_problem(calibration.BACKBONE, rng)
    fit = bp.map_estimate(problem, start=truth, checks=False, progress=False)
    draws, weights, effective = calibration.weighted_draws(problem, fit, rng)
    mean = weights @ draws[:, 0]
    sd = np.sqrt(weights @ (draws[:, 0] - mean) ** 2)
    assert mean == pytest.approx(np.log(0.1), abs=4 * 0.15 / np.sqrt(effective))
    assert sd == pytest.approx(0.15, rel=4 / np.sqrt(2 * effective))


def test_the_averaged_equation_is_exact_for_a_linear_oscillator():
    omega = 2 * np.pi * np.linspace(0.1, 0.25, 30)
    amplitude = 0.2 / np.hypot(1.0 - omega**2, 0.1 * omega)
    given = {"f": omega / 2 / np.pi, "A": amplitude, "sd": np.full(30, 1e-3)}
    at, _ = systems.averaged(given, 0.2, {"c": 0.12, "k": 1.02, "k3": 1e-9})
    assert [at["c"], at["k"]] == pytest.approx([0.1, 1.0], rel=1e-4)
