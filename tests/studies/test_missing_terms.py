import json

import numpy as np
import pytest

import bayesperiodic as bp
from studies.__main__ import main
from studies.missing_terms import cases
from studies.missing_terms import run as missing


@pytest.mark.slow
def test_quick_run(tmp_path, capsys):
    """Two sets of recordings a case: most of the true terms come first, and no right model gets a term."""
    assert main(["missing-terms", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text("utf-8"))
    assert "(synthetic data)" in capsys.readouterr().out and (tmp_path / "shares.png").is_file()
    assert results["replicates"] == 2 and len(results["checks"]) == len(cases.CASES) == 11
    by_kind = {
        kind: [one for one in results["cases"].values() if bool(one["missing"]) is kind] for kind in (True, False)
    }
    assert sum(one["shares"][cases.RIGHT] for one in by_kind[True]) >= len(by_kind[True]) - 1
    assert sum(one["shares"][cases.NONE] for one in by_kind[False]) >= len(by_kind[False]) - 0.5
    assert main(["missing-terms", "--quick", "--out", str(tmp_path)]) == 0  # nothing is computed again
    assert json.loads((tmp_path / "results.json").read_text("utf-8"))["cases"] == results["cases"]


@pytest.mark.parametrize(
    ("steps", "term", "expected"),
    [
        ([], "x**5 in equation of x", cases.NONE),
        ([], "", cases.NONE),
        ([("x**5 in equation of x", [])], "x**5 in equation of x", cases.RIGHT),
        ([("x**5 in y", [])], "x**5 in equation of x", cases.OTHER),
        ([("x in y", ["x**5 in equation of x"])], "x**5 in equation of x", cases.ALTERNATIVE),
        ([("x in y", []), ("x**5 in equation of x", [])], "x**5 in equation of x", cases.OTHER),
        ([("x in y", [])], "", cases.OTHER),
    ],
)
def test_the_first_step_decides(steps, term, expected):
    assert cases.outcome([{"term": name, "alternatives": others} for name, others in steps], term) == expected


def test_coloured_noise_has_the_stated_size_and_correlation():
    size = 20_000
    clean = bp.Recording(np.arange(size), {"y": np.zeros(size)}, {"u": np.zeros(size)}, name="still", synthetic=True)
    noisy = cases._coloured(clean, {"y": 0.01, "u": 0.1}, seed=1)
    assert noisy.outputs["y"].std() == pytest.approx(0.01, rel=0.05)
    assert noisy.inputs["u"].std() == pytest.approx(0.1, rel=0.05)
    lag, error = round(cases.CORRELATION * cases.PER_CYCLE), noisy.outputs["y"]
    assert error[lag:] @ error[:-lag] / (error @ error) == pytest.approx(np.exp(-1.0), abs=0.05)


def test_failed_searches_are_counted():
    step = {"term": "x in y", "alternatives": [], "coefficient": 1.0, "verdict": "adequate"}
    fine = {"outcome": cases.OTHER, "steps": [step], "seconds": 1.0}
    lines = [
        {"case": case} | (fine if number else {"outcome": cases.ERROR, "error": "ValueError: no"})
        for case in cases.CASES
        for number in range(2)
    ]
    found = missing.summary(lines)["Duffing"]
    assert found["shares"][cases.ERROR] == found["shares"][cases.OTHER] == 0.5 and found["count"] == 2
    assert found["instead"] == {"x in y": 1} and found["errors"] == ["ValueError: no"]
