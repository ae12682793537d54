import json
import math
import os
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure
from PIL import Image

from studies import common


@pytest.mark.parametrize(("wanted", "stamp"), [("png", None), ("pdf", b"CreationDate"), ("svg", b"<dc:date>")])
def test_figures_are_saved_as_vectors_on_request_without_time_stamps(tmp_path, wanted, stamp):
    figure, ax = plt.subplots()
    ax.plot([0, 1], [0, 1])
    with mpl.rc_context({"savefig.format": wanted}):
        paths = common.save_figures(tmp_path, {"line": figure})
    assert [path.name for path in paths] == ["line.png", f"line.{wanted}"][: 1 + (wanted != "png")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    assert Image.open(paths[0]).size == tuple(common.DOTS_PER_INCH * figure.get_size_inches())
    assert stamp is None or stamp not in paths[-1].read_bytes()


def strict(text: str):
    """Return what a text of strict JSON contains; a ValueError for NaN and Infinity."""
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_results_are_strict_json_with_reasons(tmp_path):
    given = {"a": {"low": -math.inf, "high": [1.0, math.inf]}, "b": math.nan, "c": 2.5, "d": "NaN"}
    found = strict(common.write_results(tmp_path, given).read_text("utf-8"))
    assert found == {
        "a": {"low": None, "high": [1.0, None]}, "b": None, "c": 2.5, "d": "NaN",
        "null": {"a.low": "no lower bound", "a.high[1]": "no upper bound", "b": "not known"},
    }  # fmt: skip


@pytest.mark.parametrize("path", sorted(Path("figures").rglob("*.json")), ids=str)
def test_stored_results_are_strict_json(path):
    assert strict(path.read_text("utf-8"))


@pytest.mark.skipif(os.name == "nt", reason="needs symbolic links")
def test_results_and_figures_are_written_through_links(tmp_path):
    """The links stay, and nothing else is left in either folder."""
    disk, out = tmp_path / "disk", tmp_path / "out"
    disk.mkdir()
    out.mkdir()
    names = ["figure.png", "part.pickle", "results.json"]
    for name in names:
        (out / name).symlink_to(f"../disk/{name}")
    common.write_results(out, {"value": 1.0})
    common.save_figures(out, {"figure": Figure()})
    assert common.remembered(out / "part.pickle", "a", lambda: 7) == 7
    assert common.remembered(disk / "part.pickle", "a", lambda: 8) == 7
    assert all((out / name).is_symlink() for name in names) and json.loads((disk / "results.json").read_text())
    assert sorted(os.listdir(disk)) == sorted(os.listdir(out)) == names
