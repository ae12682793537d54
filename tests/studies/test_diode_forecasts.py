"""Probabilities of motions at records that were left out of the fit, and their log scores."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import bayesperiodic as bp
from studies.diode import held_out, prediction, rig
from studies.diode.held_out import Drive

VALUES = {name: rig.TRUE[name] for name in rig.MODEL.parameters}
FREQUENCY, AMPLITUDE = 140e3, 10.5
SOURCE = AMPLITUDE * np.cos(2 * np.pi * np.arange(rig.SAMPLES) / rig.SAMPLES)


def solved(values, frequency, source, guess):
    solution = bp.solve_periodic(
        rig.MODEL, values, {"source": np.tile(source, 2)}, frequency=frequency, periods=2, samples=rig.SAMPLES,
        guess=guess,
    )  # fmt: skip
    assert solution.status == "converged"
    return solution


@pytest.fixture(scope="module")
def orbit():
    """Return the solution of period two under the measured drive."""
    share = VALUES["R_s"] / rig.RESISTOR
    record = rig.folded(FREQUENCY, rig.unloaded(rig.generate(FREQUENCY, seed=1), share))
    experiment = rig.guessed(record.experiment, VALUES)[0]
    near = rig.solve(experiment, FREQUENCY, VALUES, experiment.guess)
    ahead = -rig.source_phase(experiment) / 2
    return solved(VALUES, FREQUENCY, SOURCE, {name: rig.moved(own, ahead) for name, own in near.states.items()})


def test_a_circuit_moves_under_its_drive_as_the_scaled_one_under_the_measured_drive(orbit):
    drive, values = Drive(0.03, -0.02), VALUES | {"C_s": 5e-12, "bypass": 0.14}
    frequency, amplitude = np.exp(drive)
    expected = solved(values, FREQUENCY * frequency, SOURCE * amplitude, orbit.states)
    found = solved(held_out.driven(values, drive), FREQUENCY, SOURCE, orbit.states)
    np.testing.assert_allclose(amplitude * found.outputs["resistor"], expected.outputs["resistor"], atol=1e-7)
    np.testing.assert_allclose(found.multipliers[:2], expected.multipliers[:2], atol=1e-6)


def test_the_effective_drive_is_that_under_which_the_record_was_made(orbit):
    """The record starts one period of the source later, has another mean, and begins at another phase."""
    drive = Drive(0.012, -0.008)
    made = solved(VALUES, FREQUENCY * np.exp(drive.frequency), SOURCE * np.exp(drive.amplitude), orbit.states)
    ahead = 0.5 + 0.1
    experiment = bp.Experiment(
        "made", FREQUENCY, {"resistor": rig.moved(made.outputs["resistor"], ahead) + 0.3},
        {"source": rig.moved(np.tile(SOURCE, 2), ahead)}, samples=rig.SAMPLES, periods=2,
    )  # fmt: skip
    fit = SimpleNamespace(theta=VALUES, solutions={})
    final = rig.Fitted(SimpleNamespace(experiments=[]), fit, VALUES["R_s"] / rig.RESISTOR)
    found = held_out.effective_drive(rig.Record(FREQUENCY, None, experiment, ""), final)
    np.testing.assert_allclose(found, drive, atol=1e-5)


def test_an_orbit_that_cannot_be_solved_has_no_effective_drive(monkeypatch):
    monkeypatch.setattr(rig, "solved", lambda record, final: (None, None))
    assert held_out.effective_drive(None, None) is None


def test_regions_of_the_next_drive_contain_it_as_often_as_stated():
    """Hotelling's statistic ranks uniformly among that of draws; false-alarm rate 0.1 % for each number of records."""
    generator = np.random.default_rng(5)
    root = np.array([[0.02, 0.0], [-0.015, 0.004]])
    for count in (3, 6):
        ranks = []
        for number in range(400):
            *known, following = (generator.standard_normal((count + 1, 2)) @ root.T).tolist()
            draws = np.array(held_out.drive_draws([Drive(*own) for own in known], 99, number))
            inverse = np.linalg.inv(np.transpose(known) @ np.array(known))
            far = np.einsum("ij,jk,ik->i", draws, inverse, draws)
            ranks.append(np.sum(far < np.array(following) @ inverse @ following))
        counts = np.bincount(np.array(ranks) // 20, minlength=5)
        assert scipy.stats.chisquare(counts).pvalue > 1e-3


def test_draws_of_the_drive_are_as_narrow_as_the_errors_of_a_right_model():
    """Of a model whose effective drives err by 1e-6, all draws are within 1e-3; t of 5 degrees, 1e-13 a draw."""
    errors = [Drive(*own) for own in 1e-6 * np.random.default_rng(6).standard_normal((6, 2))]
    assert np.abs(held_out.drive_draws(errors, 1000, 1)).max() < 1e-3


@pytest.mark.parametrize("count", [0, 2])
def test_the_scatter_of_two_records_is_refused(count):
    with pytest.raises(ValueError, match=f"effective drives of at least three records, got {count}"):
        held_out.drive_draws([Drive(0.1, 0.2), Drive(0.2, 0.1)][:count], 5, 1)


def test_draws_have_the_covariance_that_is_asked_for():
    """Covariances of logarithms are those of relative errors; 20,000 draws, tolerances of five standard errors."""
    names, theta = ["L", "C_j", "bypass"], {"L": 4e-3, "C_j": 5e-12, "bypass": 0.14}
    correlation = np.array([[1.0, 0.8, -0.5], [0.8, 1.0, 0.1], [-0.5, 0.1, 1.0]])
    sd, scale = np.array([0.01, 0.04, 0.014]), np.array([4e-3, 5e-12, 1.0])
    tables = [pd.DataFrame(c * np.outer(sd * scale, sd * scale), names, names) for c in (correlation, np.eye(3))]
    fit = SimpleNamespace(theta=theta, robust_covariance=tables[0], covariance=4.0 * tables[1])
    for robust, expected in ((True, correlation), (False, 4.0 * np.eye(3))):
        draws = prediction.draws_of(rig.Fitted(None, fit, 0.26), 20_000, seed=7, robust=robust)
        values = np.array([[np.log(d["L"]), np.log(d["C_j"]), d["bypass"]] for d in draws])
        found = np.cov(values.T) / np.outer(sd, sd)
        np.testing.assert_allclose(found, expected, atol=5 * 4.0 * np.sqrt(2 / 20_000))


def test_a_motion_of_no_draw_has_the_probability_of_half_a_draw():
    p = held_out.smoothed(["chaos"] * 90 + ["3"] * 10)
    assert sum(p.values()) == pytest.approx(1.0)
    assert p["chaos"] == pytest.approx(90.5 / 104.5)
    assert p["3"] == pytest.approx(10.5 / 104.5)
    assert {p[kind] for kind in "1245678"} == {0.5 / 104.5}


def test_neighbours_do_not_count_the_record_itself():
    measured = ["1", "2", "2", "3", "chaos"]
    p = held_out.neighbours(measured, 1)
    others = {"1": 1.5, "2": 1.5, "3": 1.5, "chaos": 1.5}
    near = {"1": 1, "2": 1, "3": 1}
    assert sum(p.values()) == pytest.approx(1.0)
    for kind in held_out.CLASSES:
        assert p[kind] == pytest.approx((near.get(kind, 0) + others.get(kind, 0.5) / 8.5) / 4)
    assert held_out.neighbours(["1", "chaos", *measured[2:]], 1) == p


def test_equal_probabilities_score_minus_the_logarithm_of_the_number_of_motions():
    rows = [{"equal": held_out.smoothed([])}] * 4
    table = held_out.log_scores(rows, ["1", "chaos", "5", "5"], "equal")["equal"]
    assert table["sum"] == table["expected"] == pytest.approx(-4 * np.log(9))
    assert table["expected_sd"] == pytest.approx(0.0, abs=1e-6)
    assert table["mean"] == pytest.approx(-np.log(9))
    assert (table["difference"], table["difference_sd"]) == (0.0, 0.0)


def test_a_calibrated_forecast_scores_as_it_expects_and_an_overconfident_one_does_not():
    """Motions drawn from the stated probabilities; a normal sum over 2,000 records, false-alarm rate 0.1 %.

    The overconfident forecast has the probabilities to the third power; its expected score is that of its own entropy.
    """
    generator = np.random.default_rng(8)
    p = generator.dirichlet(np.full(9, 0.7), 2000) * 0.99 + 0.01 / 9
    sharp = p**3 / np.sum(p**3, axis=1, keepdims=True)
    measured = [held_out.CLASSES[generator.choice(9, p=own)] for own in p]
    kinds = held_out.CLASSES
    rows = [
        {"calibrated": dict(zip(kinds, a, strict=True)), "sharp": dict(zip(kinds, b, strict=True))}
        for a, b in zip(p, sharp, strict=True)
    ]
    table = held_out.log_scores(rows, measured, "calibrated")
    entropies = scipy.stats.entropy(p, axis=1), scipy.stats.entropy(sharp, axis=1)
    for name, entropy in zip(table, entropies, strict=True):
        assert table[name]["expected"] == pytest.approx(-np.sum(entropy))
    far = {name: (own["sum"] - own["expected"]) / own["expected_sd"] for name, own in table.items()}
    assert abs(far["calibrated"]) < scipy.stats.norm.isf(0.5e-3)
    assert far["sharp"] < -10.0
    differences = np.array([np.log(b[own] / a[own]) for (a, b), own in (
        ((row["calibrated"], row["sharp"]), kind) for row, kind in zip(rows, measured, strict=True)
    )])  # fmt: skip
    assert table["sharp"]["right"] == np.sum(np.argmax(p, axis=1) == [held_out.CLASSES.index(own) for own in measured])
    assert table["sharp"]["difference"] == pytest.approx(differences.sum())
    assert table["sharp"]["difference_sd"] == pytest.approx(scipy.stats.sem(differences) * 2000)


def test_a_fitted_record_is_predicted_by_the_fit_and_the_drives_of_the_others(monkeypatch):
    experiment = bp.Experiment("1", 1.0, {"resistor": SOURCE}, {"source": SOURCE}, samples=rig.SAMPLES)
    records = [rig.Record(float(n), None, replace(experiment, name=str(n)), "") for n in range(6)]
    others = {float(n): held_out.LeftOut(f"without {n}", Drive(0.01 * n, 0.0)) for n in (1, 2, 4)}
    asked = []

    def draws(final, errors, count, seed):
        asked.append((final, [own.frequency for own in errors]))
        return {"robust": [final]}

    monkeypatch.setattr(held_out, "draws_by_forecast", draws)
    monkeypatch.setattr(
        held_out, "motions_at", lambda some, by: [{k: ["2" if "without" in v[0] else "1"] for k, v in by.items()}
                                                  for _ in some],
    )  # fmt: skip
    rows, motions = held_out.forecasts(records, "final", others, 1, 1)
    assert asked == [
        ("final", [0.01, 0.02, 0.04]), ("without 1", [0.02, 0.04]), ("without 2", [0.01, 0.04]),
        ("without 4", [0.01, 0.02]),
    ]  # fmt: skip
    assert [max(row["robust"], key=row["robust"].get) for row in rows] == ["1", "2", "2", "1", "2", "1"]
    assert motions == [{"robust": ["1"]}] * 6


def test_the_fit_without_a_record_has_all_other_fitted_ones(monkeypatch):
    used = [rig.Record(f, None, None, "") for f in (1.0, 2.0, 3.0)]
    monkeypatch.setattr(rig, "estimate", lambda some, free, share: ([own.frequency for own in some], free, share))
    monkeypatch.setattr(held_out, "effective_drive", lambda record, fit: (record.frequency, fit))
    fit, drive = held_out.left_out(used[1], used, ("drift",), 0.26)
    assert fit == ([1.0, 3.0], ("drift",), 0.26)
    assert drive == (2.0, fit)
