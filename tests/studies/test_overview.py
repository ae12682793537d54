import json

import pytest

from studies.__main__ import main


@pytest.mark.document
def test_quick_run(tmp_path, capsys):
    assert main(["overview", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text("utf-8"))
    assert "synthetic" in capsys.readouterr().out and (tmp_path / "overview.png").is_file()
    assert (tmp_path / "recording.png").is_file()
    assert len(results["folds_hz"]) == 2 and min(results["orbits"].values()) >= 1
    assert results["posterior"]["a"] == results["posterior"]["b"] == "only in combination"
