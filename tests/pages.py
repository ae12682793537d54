"""Code of README and the documentation pages: what it prints, and the pictures that it saves.

``python -m tests.pages docs/start/table.md …`` executes pages, writes what their blocks print into the blocks ``text``
below them, and copies the pictures that they show from `figures/jobs` and `figures/how_to` to these folders.

The blocks of a page run in order in an empty folder with the file run.csv of the tour. Pages whose code continues the
tour (`docs/start/tour.md`) get the variables that its blocks define.
"""

import contextlib
import io
import re
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
TOUR = "docs/start/tour.md"
PAGES = [README, *sorted(DOCS.rglob("*.md"))]
# A block of code, and the output that the page shows below it.
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"\]\(\S*(figures/(?:jobs|how_to)/\w+\.png)\)")


def name(page):
    return page.relative_to(ROOT).as_posix()


BLOCKS = {name(page): BLOCK.findall(page.read_text("utf-8")) for page in PAGES}
BLOCKS = {page: blocks for page, blocks in BLOCKS.items() if blocks}


def pictures(page):
    """Return the files in `figures` that the code of a page saves under their names."""
    return [ROOT / picture for picture in PICTURE.findall((ROOT / page).read_text("utf-8"))]


def printed(page, folder, names):
    """Execute the blocks of a page in a folder, and return what each of them prints."""
    outputs = []
    with contextlib.chdir(folder):
        for code, _ in BLOCKS[page]:
            with contextlib.redirect_stdout(io.StringIO()) as output:
                exec(compile(code, page, "exec"), names)
            outputs.append(output.getvalue())
    return outputs


@cache
def tour():
    """Return the variables of the tour, what its blocks print, and the content of its file."""
    names: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        outputs = printed(TOUR, folder, names)
        for file in ("corner.png", "fit.png", "report.html", "posterior.nc"):
            assert (Path(folder) / file).stat().st_size > 1000
        return names, outputs, (Path(folder) / "run.csv").read_text("utf-8")


def run(page, folder):
    """Execute a page in an empty folder, and return what its blocks print."""
    if "does not need the tour" in (ROOT / page).read_text("utf-8") or not page.startswith("docs/how_to/"):
        return printed(page, folder, {})
    import scipy.io

    names, _, file = tour()
    (Path(folder) / "run.csv").write_text(file, "utf-8")
    return printed(page, folder, dict(names) | {"scipy": scipy})


def store(page):
    """Execute a page, and store what it shows anew."""
    with tempfile.TemporaryDirectory() as folder:
        outputs = iter(run(page, folder))
        for picture in pictures(page):
            picture.parent.mkdir(exist_ok=True)
            shutil.copy(Path(folder) / picture.name, picture)
    text = (ROOT / page).read_text("utf-8")
    (ROOT / page).write_text(BLOCK.sub(lambda block: _with_output(block, next(outputs)), text), "utf-8")


def _with_output(block, output):
    code, shown = block.groups()
    lines = "".join(f"{line.rstrip()}\n" for line in output.splitlines())
    return block[0] if shown is None else f"```python\n{code}```\n\n```text\n{lines}```"


if __name__ == "__main__":
    import matplotlib

    matplotlib.use("Agg")
    for chosen in sys.argv[1:]:
        store(chosen)
