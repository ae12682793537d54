import contextlib
import io
import json

import numpy as np
import pytest

from bayesperiodic.diagnostics.calibration import LARGEST_RHAT, check_supported
from studies.__main__ import main
from studies.calibration import run as calibration
from studies.calibration.run import OVERCOUNT


def run(folder, *arguments):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["calibration", "--out", str(folder), *arguments]) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8")), printed.getvalue()


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Return the folder, the results and the printed account of two campaigns of the two cheapest cases."""
    folder = tmp_path_factory.mktemp("calibration")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "CASES", {name: calibration.CASES[name] for name in ("duffing", "miscounted")})
        return folder, *run(folder, "--replicates", "2")


@pytest.mark.slow
def test_results_and_figures_are_written(found):
    folder, results, printed = found
    assert set(results) - {"null"} == {"duffing", "miscounted", "study"} and results["study"]["synthetic"]
    for name in ("duffing", "miscounted"):
        case = results[name]
        assert case["replicates"] == 2 and not case["failures"] and case["failed_solves"] == 0.0
        assert case["largest_rhat"] <= LARGEST_RHAT and case["largest_error_of_a_position"] < 0.15
        assert {row["verdict"] for row in case["table"]} == {"too few replicates"}
        assert [row["method"] for row in case["table"]] == 4 * ["mcmc"] + 4 * ["laplace"]
        assert all(sum(counts) == 2 for by_name in case["histograms"].values() for counts in by_name.values())
        assert len((folder / name / "replicates.jsonl").read_text().splitlines()) == 2
    assert {path.name for path in folder.glob("*.png")} == {"duffing.png", "miscounted.png"}
    assert "SYNTHETIC" in printed and "ranks are among" in printed


@pytest.mark.slow
def test_second_run_recomputes_nothing(found, monkeypatch):
    folder, results, _ = found
    monkeypatch.setattr(calibration, "CASES", {"duffing": calibration.CASES["duffing"]})
    before = (folder / "duffing" / "replicates.jsonl").read_bytes()
    again, _ = run(folder, "--replicates", "2")
    assert again["duffing"] == results["duffing"]
    assert (folder / "duffing" / "replicates.jsonl").read_bytes() == before


@pytest.mark.parametrize("name", calibration.CASES)
def test_every_case_can_be_simulated_and_only_one_miscounts(name):
    problem = calibration.CASES[name]()
    check_supported(problem)
    for experiment in problem.experiments:
        counted = {2 * experiment.harmonics[c] + 1: n for c, n in experiment.independent.items()}
        ratio = np.array([n / honest for honest, n in counted.items()])
        assert ratio == pytest.approx(OVERCOUNT if name == "miscounted" else 1.0, abs=0.02)


def test_bad_number_of_replicates_is_rejected(tmp_path, capsys):
    assert main(["calibration", "--out", str(tmp_path), "--replicates", "-1"]) == 1
    assert "--replicates: must be at least 0, got -1" in capsys.readouterr().err
