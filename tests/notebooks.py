"""Execution of the teaching notebooks; ``python -m tests.notebooks`` executes all and stores their outputs."""

import re
import sys
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "studies" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SECONDS_A_CELL = 600
# Prefix of a warning of the kernel: a temporary path and a line number.
WHERE = re.compile(r"^\S*ipykernel_\S+\.py:\d+: (\w+: .*)\n(?:  .*\n)?", re.MULTILINE)


def execute(path, folder):
    """Return a notebook executed in a folder; an error in a cell is raised."""
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(notebook, timeout=SECONDS_A_CELL, kernel_name="python3", resources=place).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            if output.output_type == "stream":
                output.text = WHERE.sub(r"\1\n", output.text)
    return notebook


def store(path, folder):
    """Execute a notebook and replace its file atomically."""
    import nbformat

    draft = path.with_suffix(".part")
    nbformat.write(execute(path, folder), draft)
    draft.replace(path)


if __name__ == "__main__":
    import tempfile

    for chosen in [Path(name) for name in sys.argv[1:]] or NOTEBOOKS:
        with tempfile.TemporaryDirectory() as scratch:
            store(chosen, scratch)
        print(f"{chosen.name}: {chosen.stat().st_size / 1e3:.0f} kB")
