"""README and documentation pages: their code runs, their output is real, their links exist, the site builds.

The blocks of a page run in order in an empty folder with the file run.csv of the tour. Pages whose code continues the
tour (`docs/start/tour.md`) get the variables that its blocks define. Run by ``pytest -m document``, in minutes.
"""

import contextlib
import importlib.util
import io
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
TOUR = "docs/start/tour.md"
PAGES = [README, *sorted(DOCS.rglob("*.md"))]
# A block of code, and the output that the page shows below it.
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w])-?\d[\d,]*\.?\d*(?:e[+-]?\d+)?")
SAME = {"rel": 0.25, "abs": 0.1}
# Code that is shown but does not run here.
CLUSTER = "docs/how_to/running.md"
LINES, WORDS, PICTURES, EXAMPLE = 150, 1200, 4, 15
pytestmark = pytest.mark.document


def name(page):
    return page.relative_to(ROOT).as_posix()


BLOCKS = {name(page): BLOCK.findall(page.read_text("utf-8")) for page in PAGES}
BLOCKS = {page: blocks for page, blocks in BLOCKS.items() if blocks}


def printed(page, code, names):
    """Execute a block and return what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        exec(compile(code, page, "exec"), names)
    return output.getvalue()


@cache
def tour():
    """Return the variables of the tour and the content of its file."""
    names: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for code, shown in BLOCKS[TOUR]:
            assert_same_output(printed(TOUR, code, names), shown)
        for file in ("corner.png", "fit.png", "report.html", "posterior.nc"):
            assert Path(file).stat().st_size > 1000
        return names, Path("run.csv").read_text("utf-8")


def assert_same_output(output, shown):
    """Compare words strictly and numbers within a tolerance, as processors and versions round differently."""
    if shown:
        assert NUMBER.sub("#", output).split() == NUMBER.sub("#", shown).split()
        values = [[float(value.replace(",", "")) for value in NUMBER.findall(text)] for text in (output, shown)]
        assert values[0] == pytest.approx(values[1], **SAME)


def variables(page):
    """Return what a page's code starts from."""
    if "does not need the tour" in (ROOT / page).read_text("utf-8") or not page.startswith("docs/how_to/"):
        return {}
    import scipy.io

    return dict(tour()[0]) | {"scipy": scipy}


@pytest.mark.parametrize("page", [page for page in BLOCKS if page not in ("README.md", TOUR, CLUSTER)])
def test_code_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = variables(page)
    if names:
        (tmp_path / "run.csv").write_text(tour()[1], "utf-8")
    for code, shown in BLOCKS[page]:
        assert_same_output(printed(page, code, names), shown)


def test_tour_runs():
    names, _ = tour()
    assert names["fit"].converged and names["posterior"].converged


def test_fifteen_lines_of_the_readme(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ((code, shown),) = BLOCKS["README.md"]
    assert shown and len([line for line in code.splitlines() if line]) <= EXAMPLE
    assert_same_output(printed("README.md", code, {}), shown)
    assert Path("report.html").stat().st_size > 1000


def test_readme_is_within_its_limits():
    text = README.read_text("utf-8")
    assert len(text.splitlines()) <= LINES
    assert len(text.split()) <= WORDS
    assert len(re.findall(r"!\[", text)) <= PICTURES


@pytest.mark.parametrize("page", [name(page) for page in PAGES])
def test_linked_files_exist(page):
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    missing = []
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        file = (ROOT / page).parent / target
        if not re.match(r"\w+:", target) and not file.exists():
            # The build copies the notebooks to the tutorials.
            copied = file.suffix == ".ipynb" and (ROOT / "studies" / "notebooks" / file.name).exists()
            missing += [] if copied else [target]
    assert not missing


def test_every_figure_is_in_the_gallery():
    shown = (DOCS / "gallery.md").read_text("utf-8")
    figures = [f"../{name(file)}" for file in sorted((ROOT / "figures").rglob("*.png"))]
    assert [file for file in figures if f"({file})" not in shown] == []


def test_listed_messages_are_those_of_the_package():
    sources = "".join(file.read_text("utf-8") for file in (ROOT / "bayesperiodic").rglob("*.py"))
    # Messages are written over several lines, with values in braces.
    joined = re.sub(r"\"\s*\n\s*f?\"", "", sources)
    rows = re.findall(r"^\| `([^|]*)` \|", (DOCS / "reference" / "messages.md").read_text("utf-8"), flags=re.MULTILINE)
    parts = [part.strip(" ,:()[]") for row in rows for part in row.split("…")]
    assert len(rows) > 20 and [part for part in parts if part not in joined] == []


class Links(HTMLParser):
    """The addresses and the anchors of a page."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Collect the addresses and anchors of an element."""
        found = dict(attrs)
        self.anchors |= {found[key] for key in ("id", "name") if key in found}
        self.links += [found[key] for key in ("href", "src") if key in found]


def test_site_builds_without_warnings_and_broken_links(tmp_path):
    for package in ("sphinx", "furo", "myst_nb", "numpydoc"):
        if importlib.util.find_spec(package) is None:
            pytest.skip('building the site needs pip install -e ".[docs]"')
    shutil.copytree(ROOT, tmp_path / "clone", ignore=shutil.ignore_patterns(".*", "tests", "_build", "generated"))
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-n", "docs", "site"]
    done = subprocess.run(command, cwd=tmp_path / "clone", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "clone" / "site"
    texts = {file: file.read_text("utf-8") for file in site.rglob("*.html")}
    loaded = re.compile(r'<(?:script|img|link(?! rel="canonical"))[^>]*(?:src|href)="https?:')
    assert [file for file, text in texts.items() if loaded.search(text)] == []
    assert "<math" in texts[site / "explanation" / "method.html"]
    pages = {file: Links(text) for file, text in texts.items()}
    assert len(pages) > 100
    broken = []
    for page, found in pages.items():
        for link in found.links:
            path, _, anchor = link.partition("#")
            if re.match(r"\w+:|//|$", path) and (path or not anchor):
                continue
            target = (page.parent / unquote(path.partition("?")[0])).resolve() if path else page
            lost = not target.exists() or (anchor and target in pages and unquote(anchor) not in pages[target].anchors)
            broken += [f"{page.relative_to(site)}: {link}"] if lost else []
    assert not broken, "\n".join(broken[:20])
