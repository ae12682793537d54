"""README and documentation pages: their code runs, their output is real, their links exist, the site builds.

Run by ``pytest -m document``, in minutes.
"""

import importlib.util
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest

from tests import pages
from tests.pages import BLOCKS, DOCS, PAGES, README, ROOT, TOUR, name

NUMBER = re.compile(r"(?<![\w])-?\d[\d,]*\.?\d*(?:e[+-]?\d+)?")
# Tolerances of printed numbers: of pages that print statistics of draws, and of others.
DRAWN, SAME = {"rel": 0.25, "abs": 0.1}, {"rel": 0.1, "abs": 2e-3}
DRAWING = (
    "README.md",
    TOUR,
    "docs/start/specimens.md",
    "docs/how_to/calibrate.md",
    "docs/how_to/compare_models.md",
    "docs/how_to/export.md",
    "docs/how_to/populations.md",
    "docs/how_to/priors.md",
    "docs/how_to/sampler.md",
    "docs/how_to/wrong_model.md",
)
# Code that is shown but does not run here.
CLUSTER = "docs/how_to/running.md"
LINES, WORDS, PICTURES, EXAMPLE = 150, 1200, 4, 15
# Characters of a line of code that the column of a page shows, and pages with longer lines.
LONGEST_LINE, WIDE = 88, ("README.md",)
pytestmark = pytest.mark.document


def assert_same_output(page, outputs):
    """Compare words strictly and numbers within a tolerance, as processors and versions round differently."""
    for output, (_, shown) in zip(outputs, BLOCKS[page], strict=True):
        if shown:
            assert NUMBER.sub("#", output).split() == NUMBER.sub("#", shown).split()
            values = [[float(value.replace(",", "")) for value in NUMBER.findall(text)] for text in (output, shown)]
            assert values[0] == pytest.approx(values[1], **(DRAWN if page in DRAWING else SAME))


@pytest.mark.parametrize("page", [page for page in BLOCKS if page not in ("README.md", TOUR, CLUSTER)])
def test_code_runs(page, tmp_path):
    assert_same_output(page, pages.run(page, tmp_path))
    assert [file.name for file in pages.pictures(page) if not (tmp_path / file.name).exists()] == []


def test_tour_runs():
    names, outputs, _ = pages.tour()
    assert_same_output(TOUR, outputs)
    assert names["fit"].converged and names["posterior"].converged


def test_fifteen_lines_of_the_readme(tmp_path):
    ((code, shown),) = BLOCKS["README.md"]
    assert shown and len([line for line in code.splitlines() if line]) <= EXAMPLE
    assert_same_output("README.md", pages.run("README.md", tmp_path))
    assert (tmp_path / "report.html").stat().st_size > 1000


@pytest.mark.parametrize("page", [page for page in BLOCKS if page not in WIDE])
def test_lines_of_code_fit_into_the_column_of_a_page(page):
    lines = "".join(code for code, _ in BLOCKS[page]).splitlines()
    assert [line for line in lines if len(line) > LONGEST_LINE] == []


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
    read = {file: Links(text) for file, text in texts.items()}
    assert len(read) > 100
    broken = []
    for page, found in read.items():
        for link in found.links:
            path, _, anchor = link.partition("#")
            if re.match(r"\w+:|//|$", path) and (path or not anchor):
                continue
            target = (page.parent / unquote(path.partition("?")[0])).resolve() if path else page
            lost = not target.exists() or (anchor and target in read and unquote(anchor) not in read[target].anchors)
            broken += [f"{page.relative_to(site)}: {link}"] if lost else []
    assert not broken, "\n".join(broken[:20])
