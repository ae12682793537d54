"""The teaching notebooks: they use public names alone, are stored small and executed, and run.

To execute them, which takes some minutes: ``pytest -m notebook``, with the extra `notebooks`.
"""

import ast
import json
from pathlib import Path

import pytest

import bayesperiodic as bp

FOLDER = Path(__file__).parents[2] / "studies" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 300_000
SECONDS = 600
IMPORTED = {"bayesperiodic", "matplotlib", "numpy", "os", "pandas", "pathlib", "sympy", "tempfile", "time"}
PARTS = ("**Aims.**", "## Exercises", "### Worked answers")

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == kind]


def source(cell: dict) -> str:
    return "".join(cell["source"])


def test_there_are_notebooks():
    assert NOTEBOOKS


@each
def test_it_is_small_executed_and_without_errors(path):
    assert path.stat().st_size <= LARGEST
    counts = [cell["execution_count"] for cell in cells(path, "code")]
    assert counts == list(range(1, len(counts) + 1))
    outputs = [output for cell in cells(path, "code") for output in cell["outputs"]]
    assert outputs and not [output for output in outputs if output["output_type"] == "error"]
    assert not [text for text in ("/tmp/", "/home/", "/root/", "Traceback") if text in json.dumps(outputs)]


@each
def test_it_states_its_aims_and_has_exercises_with_answers(path):
    text = "\n".join(source(cell) for cell in cells(path, "markdown"))
    assert [part for part in PARTS if part in text] == list(PARTS)


@each
def test_it_uses_public_names_alone(path):
    modules, used = set(), set()
    for node in ast.walk(ast.parse("\n".join(source(cell) for cell in cells(path, "code")))):
        if isinstance(node, ast.Import):
            modules |= {name.name.partition(".")[0] for name in node.names}
            assert [n.asname for n in node.names if n.name.startswith("bayesperiodic")] in ([], ["bp"])
        elif isinstance(node, ast.ImportFrom):
            assert node.module != "bayesperiodic"
            modules.add(str(node.module).partition(".")[0])
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "bp":
            used.add(node.attr)
        elif isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")
    assert modules <= IMPORTED
    assert used and used <= set(bp.__all__)


@pytest.mark.notebook
@each
def test_it_runs(path, tmp_path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=resources).execute()
