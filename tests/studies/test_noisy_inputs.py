import json

import pytest

from studies.__main__ import main
from studies.noisy_inputs import run as noisy


@pytest.mark.slow
def test_quick_run(tmp_path, capsys):
    """Four recordings a case: rho is off by many standard deviations only if the displacement is taken as exact."""
    assert main(["noisy-inputs", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text("utf-8"))
    assert "(synthetic data)" in capsys.readouterr().out and (tmp_path / "coverage.png").is_file()
    assert results["replicates"] == 4 and len(results["checks"]) == 24
    rho = [by_kind["measured"]["sd"]["rho"] for by_kind in results["cases"]["damper"].values()]
    exact = [by_kind["exact"]["sd"]["rho"] for by_kind in results["cases"]["damper"].values()]
    assert max(rho) < 2.0 < min(exact)
    assert main(["noisy-inputs", "--quick", "--out", str(tmp_path)]) == 0  # nothing is computed again
    assert json.loads((tmp_path / "results.json").read_text("utf-8"))["cases"] == results["cases"]


def test_failed_estimates_are_counted_and_not_averaged():
    fine = {"z": {"a": 1.0}, "covered": {"a": True}, "unexplained": 0.1, "status": "converged"}
    lines = [
        {"case": case, "level": level, "exact": fine, "measured": fine if level < 0.05 else {"error": "ValueError: no"}}
        for case in noisy.CASES
        for level in noisy.LEVELS
    ]
    found = noisy.summary(lines)["duffing"]
    assert found["1%"]["measured"]["bias"] == {"a": 1.0} and found["1%"]["measured"]["errors"] == []
    assert found["10%"]["measured"]["errors"] == ["ValueError: no"] and found["10%"]["measured"]["bias"] == {}
