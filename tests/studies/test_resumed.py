import shutil
from pathlib import Path

import bayesperiodic as bp
from studies.common import remembered, source_key


def test_results_of_an_older_package_are_stale(tmp_path, monkeypatch):
    copy = tmp_path / "bayesperiodic"
    shutil.copytree(Path(bp.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(bp, "__file__", str(copy / "__init__.py"))
    before = source_key(__file__)
    assert before == source_key(__file__)
    with (copy / "data" / "experiment.py").open("a", encoding="utf-8") as file:
        file.write("# changed\n")
    assert source_key(__file__) != before


def test_cached_part_is_recomputed_for_another_source(tmp_path):
    made = []

    def make():
        made.append(len(made))
        return made[-1], lambda: "pickled by value"

    path = tmp_path / "parts" / "A.pkl"
    assert [remembered(path, source, make)[0] for source in ("first", "first", "second")] == [0, 0, 1]
    assert remembered(path, "second", make)[1]() == "pickled by value"
    assert [file.name for file in path.parent.iterdir()] == ["A.pkl"]
