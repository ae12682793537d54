import contextlib
import io
import json

import numpy as np
import pytest

import bayesperiodic as bp
from studies import common, common_resumed, flutter_campaigns, flutter_data, flutter_questions, flutter_rig
from studies.__main__ import main
from tests.flutter_rig import hopf
from tests.studies.here import InThisProcess

REAL = common.find_data(None, flutter_data.FILE)
real_data = pytest.mark.skipif(REAL is None, reason="the measured file is not to be had here, see flutter_data.py")
FOUR = ("stable_v15_6", "stable_v17_3", "unstable_v14_9", "unstable_v16_5")


def run(folder, *arguments):
    """Run the study on four synthetic cycles in this process, and return what it printed."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(common, "find_data", lambda *_: None)
        patch.setattr(common_resumed, "workers", InThisProcess)
        patch.setattr(flutter_data, "KINDS", {name: flutter_data.KINDS[name] for name in FOUR})
        assert main(["flutter", "--out", str(folder), *arguments]) == 0
    return printed.getvalue()


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Return the folder, the results and the printed account of a quick run."""
    folder = tmp_path_factory.mktemp("flutter")
    printed = run(folder, "--quick")
    return folder, json.loads((folder / "results.json").read_text(encoding="utf-8")), printed


def test_synthetic_rig_is_called_synthetic_and_fitted_within_its_noise(quick):
    folder, results, printed = quick
    assert "SYNTHETIC" in printed and flutter_data.SHA256 in printed
    assert results["data"] == {"path": "generated", "sha256": None, "synthetic": True}
    assert results["branches_kept_apart"] and results["status"] == "converged"
    for one in results["errors"].values():
        assert max(map(abs, one["amplitude_error"].values())) < 0.01 and abs(one["frequency_error"]) < 1e-3
    for record in results["records"].values():
        assert record["frequency_se"] < 0.003 * record["frequency"]
        assert record["spectral_frequency"] == pytest.approx(record["frequency"], rel=0.003)
    assert sorted(path.name for path in folder.glob("*.png")) == ["bifurcation.png", "contraction.png", "portraits.png"]


def test_scaled_springs_are_found_and_plain_ones_are_the_priors(quick):
    """Within 5 sds (false-alarm rate 6e-7 each) of the truth in units of the pitch sensor."""
    _, results, _ = quick
    table, true = results["contraction"], flutter_rig.TRUE
    for power, name in enumerate(("k_alpha2", "k_alpha3"), 1):
        row = table[f"{name} at gain 1"]["both"]
        assert abs(row["estimate"] - true[name] / true["gain_pitch"] ** power) < 5 * row["sd"]
        assert row["over_prior"] < 0.1 < table[name]["both"]["over_prior"]
    assert any("k_alpha3 → k_alpha3·t^2" in text for text in results["undetermined"])
    assert "k_alpha2 → k_alpha2/t, k_alpha3 → k_alpha3/t**2" in results["structure"]["text"]


def test_authors_hopf_point_is_that_of_the_eigenvalues(quick):
    known = quick[1]["authors_branch"]
    speed, frequency = hopf()
    assert known["hopf_speed"] == pytest.approx(speed, abs=0.05)
    assert known["hopf_frequency"] == pytest.approx(frequency, abs=0.005)
    assert quick[1]["authors_errors"]["unstable_v14_9"]["amplitude_error"] is None
    assert "fold at 14.936" in quick[1]["authors_errors"]["unstable_v14_9"]["why"]


def test_campaigns_are_resumed(tmp_path):
    printed = run(tmp_path, "--replicates", "1")
    assert "1 to do" in printed and "0 failures" in printed and "kept apart in 1" in printed
    assert "0 to do" in run(tmp_path, "--replicates", "1")
    (line,) = common_resumed._read(tmp_path / "campaigns" / flutter_campaigns.FILE)
    assert max(abs(line["pulls"][name]) for name in flutter_campaigns.STIFFNESSES) < 5.0


def test_records_that_drift_or_are_too_short_are_left_out_with_the_reason():
    time = flutter_data.STEP * np.arange(2000)
    still = np.cos(2 * np.pi * 2.45 * time)
    given = {"steady": still, "growing": still * (1 + 0.04 * time), "short": still[:400]}
    records = [
        flutter_data.Record(
            bp.Recording.from_arrays(time[: y.size], {"heave": y, "pitch": np.roll(y, 9)}, name=name), 15.0, {}
        )
        for name, y in given.items()
    ]
    admitted, refused = flutter_data.usable(records)
    assert list(admitted) == ["steady"]
    assert "is not steady" in refused["growing"] and "at least 3 cycles are needed" in refused["short"]


def test_speeds_within_a_quarter_are_left_out_together():
    speeds = {"a": 14.9, "b": 16.4, "c": 16.5, "d": 17.2, "e": 17.3}
    assert flutter_questions.groups(speeds) == [["a"], ["b", "c"], ["d", "e"]]


@real_data
def test_of_the_measured_records_the_one_that_drifts_is_left_out():
    records, data = flutter_data.read_records(None, 1)
    admitted, refused = flutter_data.usable(records)
    assert data["sha256"] == flutter_data.SHA256
    assert set(admitted) == set(flutter_data.KINDS) and set(refused) == {"unstable_v15_6"}
    for record in records:
        name = record.recording.name
        if name in admitted:
            e = admitted[name]
            assert e.frequency_se < 0.003 * e.frequency
            assert flutter_data.spectral_frequency(record, e) == pytest.approx(e.frequency, rel=0.003)
            assert record.speed == flutter_data.KINDS[name][0]
