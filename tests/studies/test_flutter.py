import contextlib
import io
import json
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from studies import common
from studies.__main__ import main
from studies.flutter import questions, rig
from studies.flutter import run as flutter
from studies.flutter.reference import hopf

REAL = common.find_data(None, rig.FILE)
real_data = pytest.mark.skipif(REAL is None, reason="the measured file is missing, see studies/flutter/rig.py")
FOUR = ("stable_v15_6", "stable_v17_3", "unstable_v14_9", "unstable_v16_5")


def run(folder, *arguments):
    """Run the study in this process, synthetic rigs with four kinds of cycles, and return what it printed."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(common, "find_data", lambda *_: None)
        patch.setattr(common, "workers", lambda: ThreadPoolExecutor(1))
        patch.setattr(rig, "KINDS", {name: rig.KINDS[name] for name in FOUR})
        assert main(["flutter", "--out", str(folder), *arguments]) == 0
    return printed.getvalue()


def test_hopf_point_agrees_with_the_eigenvalues_and_a_speed_without_a_cycle_raises():
    along = rig.cycles(rig.RIG | rig.AUTHORS | rig.SENSORS)
    speed, frequency = hopf()
    assert along.hopf.value == pytest.approx(speed, abs=0.05)
    assert along.hopf.frequency == pytest.approx(frequency, abs=0.005)
    assert along.at("stable", 16.5).stable and not along.at("unstable", 16.5).stable
    with pytest.raises(ValueError, match="its fold at 14.936.*The Hopf point is at 18.27"):
        along.at("unstable", 14.9)


def test_half_range_is_that_of_the_interpolated_signal():
    tau = (np.arange(12) + 0.3) / 12
    assert questions.half_range(0.2 + np.cos(2 * np.pi * tau), flutter.CURVE) == pytest.approx(1.0, rel=1e-6)


def test_interval_of_a_spring_contains_its_estimates_from_all_kinds_of_cycles():
    rows = {"stable": (100.0, 3.0), "unstable": (105.0, 4.0), "both": (113.0, 5.0)}
    one = {kind: {"estimate": value, "sd": sd} for kind, (value, sd) in rows.items()}
    found = questions.model_error_of_springs(dict.fromkeys(rig.SPRINGS, one))["k_alpha2 at gain 1"]
    assert found["largest_difference_in_sds"] == pytest.approx(13.0 / np.sqrt(34.0))
    assert found["interval_with_model_error"] == pytest.approx([100.0 - 1.6449 * 3.0, 113.0 + 1.6449 * 5.0], abs=1e-3)
    assert found["relative_sd"]["both"] == pytest.approx(5.0 / 113.0)


@pytest.mark.slow
def test_quick_run_writes_all_results_and_labels_synthetic_data(tmp_path):
    printed = run(tmp_path, "--quick")
    assert "SYNTHETIC records" in printed
    results = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert results["data"]["synthetic"] and results["quick"] and results["branches_kept_apart"]
    for by_speed in results["checks"]["stable_cycles"]["24 points"].values():
        assert max(map(abs, by_speed.values())) < 1e-6
    assert set(results["predictions"]) >= {"unstable from stable", "stable from unstable"}
    assert {path.stem for path in tmp_path.glob("*.png")} == {"bifurcation", "portraits", "contraction"}


def test_synthetic_records_are_labelled_and_have_the_true_cycles():
    along = rig.cycles(rig.RIG | rig.TRUE)
    records = rig.generate(1)
    admitted, refused = rig.usable(records)
    assert not refused and set(admitted) == set(rig.KINDS)
    for record in records:
        e, orbit = admitted[record.recording.name], along.at(record.recording.name, record.speed)
        assert e.synthetic and e.frequency_se < 0.003 * e.frequency
        assert abs(e.frequency - orbit.frequency) < 5 * e.frequency_se
        assert questions.sizes(e.outputs) == pytest.approx(questions.sizes(orbit.outputs), rel=0.05)


def test_campaigns_are_resumable(tmp_path, monkeypatch):
    """The second time there is none to do."""
    printed = run(tmp_path, "--replicates", "1")
    assert "0 failures" in printed and "kept apart in 1" in printed
    monkeypatch.setattr(questions, "campaign", None)
    assert "1 campaigns, 0 failures" in run(tmp_path, "--replicates", "1")
    (line,) = json.loads((tmp_path / "campaigns" / "results.json").read_text(encoding="utf-8"))["campaigns"]
    assert max(abs(line["pulls"][name]) for name in questions.STIFFNESSES) < 5.0


def test_records_that_drift_or_are_too_short_are_excluded_with_a_reason():
    time = rig.STEP * np.arange(2000)
    still = np.cos(2 * np.pi * 2.45 * time)
    given = {"steady": still, "growing": still * (1 + 0.04 * time), "short": still[:400]}
    records = [
        rig.Record(bp.Recording.from_arrays(time[: y.size], {"heave": y, "pitch": np.roll(y, 9)}, name=name), 15.0, {})
        for name, y in given.items()
    ]
    admitted, refused = rig.usable(records)
    assert list(admitted) == ["steady"]
    assert "must be steady" in refused["growing"] and "at least 3 cycles" in refused["short"]


def test_amplitudes_of_draws_agree_with_branches_continued_at_their_values():
    along = rig.cycles(rig.RIG | rig.TRUE)
    changed = rig.TRUE | {"k_alpha2": 650.0, "c_h": 7.5, "gain_pitch": 0.8}
    other = rig.cycles(rig.RIG | changed)
    draws = {n: np.array([rig.TRUE[n], changed[n], rig.TRUE[n]]) for n in rig.TRUE}
    draws["k_alpha2"][2] = 250.0  # there is no cycle below the Hopf point then
    for name in ("stable", "unstable"):
        orbit = along.at(name, 16.5)
        found = questions.drawn_sizes(orbit, rig.TRUE, draws)
        here, there = (questions.sizes(o.outputs) for o in (orbit, other.at(name, 16.5)))
        for channel, size in found.items():
            assert size[:2] == pytest.approx([here[channel], there[channel]], rel=1e-4)
            assert np.isnan(size[2])


def test_laplace_draws_are_normal_in_the_logarithms_of_positive_parameters():
    """Sample moments of 20 000 draws, within five standard errors: false alarm below 1e-5."""
    names = ["k_alpha2", "gain_pitch", "offset_pitch"]
    spread = np.array([[0.04, 0.06, 0.0], [0.06, 0.1, 0.0], [0.0, 0.0, 0.25]])
    scale = np.array([600.0, 0.7, 1.0])
    covariance = pd.DataFrame(spread * np.outer(scale, scale), index=names, columns=names)
    fit = SimpleNamespace(theta={"k_alpha2": 600.0, "gain_pitch": 0.7, "offset_pitch": -0.2}, covariance=covariance)
    drawn = questions.laplace_draws(fit, 20_000)
    rows = np.stack([np.log(drawn["k_alpha2"] / 600.0), np.log(drawn["gain_pitch"] / 0.7), drawn["offset_pitch"] + 0.2])
    sds = np.sqrt(np.diag(spread))
    assert np.all(np.abs(rows.mean(axis=1)) < 5 * sds / np.sqrt(20_000))
    assert np.all(np.abs(np.cov(rows) - spread) < 5 * np.outer(sds, sds) * np.sqrt(2 / 20_000))


def test_speeds_within_a_quarter_metre_per_second_form_one_group():
    speeds = {"a": 14.9, "b": 16.4, "c": 16.5, "d": 17.2, "e": 17.3}
    assert questions.groups(speeds) == [["a"], ["b", "c"], ["d", "e"]]


@real_data
def test_measured_record_that_drifts_is_excluded():
    records, data = rig.read_records(None, 1)
    admitted, refused = rig.usable(records)
    assert data["sha256"] == rig.SHA256
    assert set(admitted) == set(rig.KINDS) and set(refused) == {"unstable_v15_6"}
    for record in records:
        name = record.recording.name
        if name in admitted:
            e = admitted[name]
            assert e.frequency_se < 0.003 * e.frequency
            assert rig.spectral_frequency(record, e) == pytest.approx(e.frequency, rel=0.003)
            assert record.speed == rig.KINDS[name][0]
