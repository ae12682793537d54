import json

import pytest

from studies.__main__ import main


@pytest.mark.document
def test_quick_run_shows_that_the_error_falls_with_the_width(tmp_path, capsys):
    assert main(["elements", "--quick", "--out", str(tmp_path)]) == 0
    wide, narrow = json.loads((tmp_path / "results.json").read_text("utf-8"))["widths"]
    assert "synthetic" in capsys.readouterr().out
    assert (tmp_path / "loops.png").is_file() and (tmp_path / "width.png").is_file()
    assert wide["converged"] and narrow["converged"]
    assert abs(narrow["error"]["stiffness"]) < 0.01 < abs(wide["error"]["stiffness"])
