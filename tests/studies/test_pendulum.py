import contextlib
import io
import json

import numpy as np
import pytest

from studies import shooting
from studies.__main__ import main
from studies.pendulum import orbits
from studies.pendulum import recording as pendulum_recording
from studies.pendulum.orbits import shoot


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Return the results, the printed account and the folder of a quick run."""
    folder = tmp_path_factory.mktemp("pendulum")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["pendulum", "--quick", "--out", str(folder)]) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8")), printed.getvalue(), folder


@pytest.mark.slow
def test_orbits_found_without_noise_are_confirmed_by_shooting(quick):
    results, _, _ = quick
    found = results["found_without_noise"]
    assert found["polished"] >= 12 and found["not_confirmed_by_shooting"] == []
    assert found["largest_difference_from_shooting"] < 1e-7
    assert found["states_of_rest"] >= 1


@pytest.mark.slow
def test_chained_fits_find_more_orbits_than_boxes(quick):
    results, _, _ = quick
    for methods in results["eigenvalues"].values():
        chained, boxes = (sum(row["orbits"] for row in methods[name]) for name in ("chained", "boxes"))
        assert chained > boxes > 0


@pytest.mark.slow
def test_estimates_have_smaller_errors_than_in_the_paper(quick):
    """The paper's errors are 9.6, 0.3 and 11.6 %, on its own experiment; targets at 0.1 % noise 1, 0.25 and 1 %."""
    results, printed, _ = quick
    estimates = results["estimates"]
    two, one = estimates["m and l"]["parameters"], estimates["k3"]["parameters"]
    assert abs(two["m"]["relative_error"]) < 0.01
    assert abs(two["l"]["relative_error"]) < 0.0025
    assert abs(one["k3"]["relative_error"]) < 0.01
    assert results["data_reduction"]["numbers_used"] < 1e-3 * results["data_reduction"]["numbers_in_the_recording"]
    assert "SYNTHETIC" in printed


@pytest.mark.slow
def test_verdicts_of_all_five_parameters_agree_with_the_structural_analysis(quick):
    results, _, _ = quick
    verdicts = results["all_five"]["verdicts"]
    assert verdicts.pop("l") == "determined"
    assert verdicts == dict.fromkeys(("m", "k1", "k2", "k3"), "only in combination")
    assert "k1/(m*l**2)" in results["all_five"]["structure"]
    # The chain is too short and is reported as not converged.
    assert not results["all_five"]["converged"]


@pytest.mark.slow
def test_figures_are_drawn(quick):
    _, _, folder = quick
    assert {path.stem for path in folder.glob("*.png")} == {"section", "orbits", "corner", "ridge", "eigenvalues"}


def test_shooting_from_disturbed_points_returns_to_the_tabulated_orbits():
    for known in (shooting.UNSTABLE[0], shooting.UNSTABLE[3], shooting.UNSTABLE[5]):
        points = np.array(known.section)
        shot = shoot(pendulum_recording.TRUTH, known.omega, points + 1e-4)
        assert shot.converged and shot.winding == known.winding and shot.prime == len(points)
        assert orbits.distance(shot.points, points) < 1e-9
        assert shot.multipliers == pytest.approx(np.array(known.multipliers), rel=1e-5)


def test_measured_recording_is_not_labelled_synthetic(tmp_path):
    recording = pendulum_recording.with_noise(pendulum_recording.simulate(300, 3), 1e-3, 3)
    table = np.column_stack([recording.time, *recording.outputs.values()])
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="time,angle,rate", comments="")
    read, about = pendulum_recording.get(path, quick=False, seed=1)
    assert not about["synthetic"] and not read.synthetic
    assert about["values"] == 2 * recording.time.size and about["drive_periods"] in (299, 300)
    assert read.outputs["rate"] == pytest.approx(recording.outputs["rate"])
    assert not pendulum_recording.section_of(read).synthetic


def test_error_names_the_bad_argument(tmp_path, capsys):
    assert main(["pendulum", "--noise", "2", "--out", str(tmp_path)]) == 1
    assert "--noise: must be a fraction from 0 to 1, got 2.0" in capsys.readouterr().err
    assert main(["pendulum", "--data", str(tmp_path / "none.csv"), "--out", str(tmp_path)]) == 1
    assert "--data: must be an existing file" in capsys.readouterr().err
