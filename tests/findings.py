"""Pages on the surprises of other packages, made of the heads of the scripts in `findings/`.

``python -m tests.findings`` writes `findings/README.md` and `docs/reference/neighbours.md`. A head has three
paragraphs: "PACKAGE VERSION: what it does", "Seen with VERSIONS:" and what the script prints, and the sentences "Where
users meet it: …" and "What the package does: …".
"""

import re
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIST, PAGE = ROOT / "findings" / "README.md", ROOT / "docs" / "reference" / "neighbours.md"
HEAD = re.compile(
    r"(?P<package>\S+) (?P<version>[\d.]+):? (?P<text>.+?)\n\n"
    r"Seen with (?P<versions>.+?):\n(?P<output>(?:    .+\n)+)\n"
    r"Where users meet it: (?P<where>.+?)\nWhat the package does: (?P<cure>.+?)\n",
    re.DOTALL,
)
MADE = "<!-- Made of the heads of the scripts in findings/ by `python -m tests.findings`. -->\n\n"
LIST_HEAD = """# Surprises of other packages

What packages and formats do on valid input and users would not guess. Each script installs pinned versions in a
temporary folder, shows the behaviour without bayesperiodic, and fails if it changes: `findings/NAME.sh`.

| Package | What it does on valid input | Where users meet it | What bayesperiodic does | Script |
|---|---|---|---|---|
"""
PAGE_HEAD = """# What readers and neighbours do

What packages that are used with bayesperiodic do on valid input, and you would not guess, in the versions that were
tried. What users of bayesperiodic would meet, it gets right, with a test. Each is shown without bayesperiodic by a
script in `findings/`, which installs pinned versions in a temporary folder, and fails if the behaviour changes. More
traps of each format are in [Formats of files](files.md).
"""


class Surprise(NamedTuple):
    """The head of a script."""

    name: str
    package: str
    version: str
    text: str
    versions: str
    output: str
    where: str
    cure: str

    @property
    def summary(self):
        """The first sentence."""
        return re.split(r"(?<=\.)\s+(?=[A-Z0-9`])", joined(self.text))[0]


def joined(text):
    """Return a text in one line."""
    return " ".join(text.split())


def surprises():
    """Return the heads of all scripts, sorted by the package."""
    heads = []
    for script in sorted((ROOT / "findings").glob("*.sh")):
        comments = re.match(r"#!.*\n((?:#.*\n)+)", script.read_text("utf-8"))[1]
        head = HEAD.fullmatch(re.sub(r"^# ?", "", comments, flags=re.MULTILINE))
        assert head, f"{script.name}: must have the paragraphs described in tests/findings.py"
        heads.append(Surprise(script.stem, **head.groupdict()))
    return sorted(heads, key=lambda one: one.package.lower())


def pages():
    """Return the text of each page by its file."""
    heads = surprises()
    rows = [
        f"| {one.package} {one.version} | {one.summary} | {joined(one.where)} | {joined(one.cure)} "
        f"| [{one.name}]({one.name}.sh) |\n"
        for one in heads
    ]
    sections = []
    for package, group in groupby(heads, key=lambda one: f"{one.package} {one.version}"):
        sections.append(f"\n## {package}\n")
        for one in group:
            sections.append(
                f"\n{one.text[0].upper()}{one.text[1:]}\n\nSeen with {joined(one.versions)}:\n\n"
                f"```text\n{re.sub('^    ', '', one.output, flags=re.MULTILINE)}```\n\n"
                f"- Where users meet it: {joined(one.where)}\n- What bayesperiodic does: {joined(one.cure)}\n"
                f"- Script: `findings/{one.name}.sh`\n"
            )
    return {LIST: MADE + LIST_HEAD + "".join(rows), PAGE: MADE + PAGE_HEAD + "".join(sections)}


if __name__ == "__main__":
    for page, made in pages().items():
        page.write_text(made, "utf-8")
