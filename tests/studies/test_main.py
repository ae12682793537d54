"""Where ``python -m studies NAME`` writes."""

import subprocess
from pathlib import Path

import pytest

from studies.__main__ import main
from studies.benchmark import run as benchmark
from studies.overview import run as overview

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folders(monkeypatch):
    """Return the list of folders that studies are asked to write to, in place of running them."""
    asked = []
    for study in (overview, benchmark):
        monkeypatch.setattr(study, "run", lambda options: asked.append(options.out))
    return asked


@pytest.mark.parametrize(
    ("arguments", "folder"),
    [
        (["overview"], "output/overview"),
        (["overview", "--quick"], "output/quick/overview"),
        (["overview", "--publish"], "figures/overview"),
        (["overview", "--out", "elsewhere"], "elsewhere"),
        (["benchmark", "--guard"], "output/quick/benchmark"),
    ],
)
def test_the_folder_of_a_study_is_printed_at_its_end(arguments, folder, folders, capsys):
    assert main(arguments) == 0
    assert folders == [Path(folder)]
    assert capsys.readouterr().out.splitlines()[-1] == f"written to {folder}/"


@pytest.mark.parametrize("option", ["--quick", "--guard"])
def test_quick_runs_are_not_published(option, folders, capsys):
    assert main(["benchmark", "--publish", option]) == 1
    assert "--publish: must be a full run, got --quick or --guard." in capsys.readouterr().err
    assert folders == []


def test_a_folder_is_not_given_twice(folders, capsys):
    with pytest.raises(SystemExit):
        main(["overview", "--publish", "--out", "elsewhere"])
    assert "not allowed with argument" in capsys.readouterr().err


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a clone")
def test_git_ignores_what_a_study_writes_unless_it_is_published():
    def ignored(file):
        return subprocess.run(["git", "check-ignore", "-q", file], cwd=ROOT).returncode == 0

    assert ignored("output/pendulum/results.json") and ignored("output/quick/pendulum/corner.png")
    assert not ignored("figures/pendulum/new.png")
