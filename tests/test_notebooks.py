"""The teaching notebooks: those marked ``document`` are executed, which takes minutes (``pytest -m document``)."""

import ast
import json
import re

import pytest

import bayesperiodic as bp
from tests.notebooks import NOTEBOOKS, execute

IMPORTED = {
    "bayesperiodic", "dataclasses", "ipywidgets", "matplotlib.pyplot", "numpy", "pandas", "pathlib", "sympy",
    "tempfile", "warnings",
}  # fmt: skip
LARGEST = 300_000

every = pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])


def cells(path, kind):
    """Return the sources of all cells of a kind."""
    return ["".join(c["source"]) for c in json.loads(path.read_text("utf-8"))["cells"] if c["cell_type"] == kind]


def test_there_are_nine_notebooks():
    assert [path.stem[0] for path in NOTEBOOKS] == list("123456789")


@every
def test_every_notebook_states_its_aims_and_has_exercises_with_answers(path):
    text = "\n".join(cells(path, "markdown"))
    assert text.startswith(f"# {path.stem[0]}. ") and "**Aims.**" in text
    exercises, answers = text.split("## Exercises")[1].split("### Answers")
    asked = re.findall(r"^\*\*(\d)\.\*\*", exercises, re.MULTILINE)
    assert len(asked) >= 3 and asked == re.findall(r"^\*\*(\d)\.\*\*", answers, re.MULTILINE)


@every
def test_notebooks_use_public_names_only(path):
    tree = ast.parse("\n".join(cells(path, "code")))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert {alias.name for alias in node.names} <= IMPORTED
        elif isinstance(node, ast.ImportFrom):
            assert node.module in IMPORTED - {"bayesperiodic"}
        elif isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")
            if isinstance(node.value, ast.Name) and node.value.id == "bp":
                assert node.attr in bp.__all__


@every
def test_stored_outputs_are_present_and_small(path):
    assert path.stat().st_size <= LARGEST
    code = [c for c in json.loads(path.read_text("utf-8"))["cells"] if c["cell_type"] == "code"]
    assert [c["execution_count"] for c in code] == list(range(1, len(code) + 1))
    outputs = [output for c in code for output in c["outputs"]]
    assert "display_data" in {output["output_type"] for output in outputs}
    assert "error" not in {output["output_type"] for output in outputs}
    assert not re.search(r"ipykernel|/home/|/tmp/|Traceback", json.dumps(outputs))


@pytest.mark.document
@every
def test_runs(path, tmp_path):
    pytest.importorskip("nbclient", reason='executing notebooks needs pip install "bayesperiodic[notebooks]"')
    execute(path, tmp_path)
