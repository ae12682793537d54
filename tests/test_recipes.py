"""The recipes of CONTRIBUTING.md, carried out in a copy of the repository.

The first line of each block of a recipe names a file: "new" makes it, "at the end" appends to it. The block "use" is
run then, in one process for all recipes, so that they do not disturb each other either.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```python\n# (?:(\S+), (new|at the end)|use)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUN = """
import json, sys, traceback
failures = {}
for title, program in json.load(sys.stdin).items():
    try:
        exec(compile(program, title, "exec"), {"__name__": "recipe"})
    except BaseException:
        failures[title] = traceback.format_exc()
print(json.dumps(failures))
"""
# The most files that an addition touches.
MOST_FILES = {"A kind of data": 2}


class Recipe(NamedTuple):
    """What a recipe adds, and the code that uses it."""

    files: dict[str, tuple[str, str]]  # by path: "new" or "at the end", and the text
    use: str


def recipes() -> dict[str, Recipe]:
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    chapter = text.partition("\n## Recipes\n")[2].partition("\n## ")[0]
    parts = re.split(r"^### (.*)\n", chapter, flags=re.MULTILINE)[1:]
    result = {}
    for title, part in zip(parts[::2], parts[1::2], strict=True):
        blocks = BLOCK.findall(part)
        assert len(blocks) == part.count("```python"), f"{title}: each block names a file, or is 'use'"
        files = {path: (place, body) for path, place, body in blocks if path}
        result[title] = Recipe(files, "".join(body for path, _, body in blocks if not path))
    return result


RECIPES = recipes()


@pytest.fixture(scope="module")
def failures(tmp_path_factory):
    copy = tmp_path_factory.mktemp("copy")
    for folder in ("bayesperiodic", "studies"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for recipe in RECIPES.values():
        for path, (place, body) in recipe.files.items():
            file = copy / path
            assert file.exists() == (place == "at the end"), f"{path}: must be {'there' if place != 'new' else 'new'}"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text((file.read_text("utf-8") if place == "at the end" else "") + body, "utf-8")
    programs = json.dumps({title: recipe.use for title, recipe in RECIPES.items()})
    done = subprocess.run(
        [sys.executable, "-c", RUN], input=programs, cwd=copy, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(copy), "MPLBACKEND": "agg"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("title", RECIPES)
def test_recipe_is_complete_and_works(title, failures):
    assert RECIPES[title].use and title not in failures, failures.get(title)
    assert len(RECIPES[title].files) <= MOST_FILES.get(title, 2)


def test_there_is_a_recipe_for_every_kind():
    kinds = "noise model|scheme|prior|kind of data|reader|result|verdict|element|study"
    assert [title for title in RECIPES if re.fullmatch(f"An? ({kinds})", title)] == [*RECIPES]
    assert len(RECIPES) == len(kinds.split("|"))
