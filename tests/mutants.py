"""Mutation testing of a random sample of mutants: ``python -m tests.mutants --count 100 --seed 1``.

mutmut writes the mutants of the modules in `pyproject.toml`. A mutant is tested in a process forked from one that has
collected the tests but run none, by the folder of `tests/` that mirrors its own and by the files of other folders that
name its function: first the files that name the function, then those that name its module, then the others, and of each
file the tests that name the function first, until a test fails or `BUDGET` seconds of processor time have passed.
Results are in `mutants.md`.
"""

import argparse
import ast
import functools
import json
import os
import random
import re
import resource
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest

BUDGET, LONGEST = 80.0, 250  # [s] of processor time; a test that has no end is stopped by the longer one
SURVIVED, KILLED = 0, 1
# A function of mutmut's: indentation, name and what follows; a last argument `strict`, or the comma in its place.
DEFINITION = re.compile(r"^( *)def (\S+__mutmut_\w+)\((.*?)(?=^\1[^\s)]|^[^\s)]|\Z)", re.MULTILINE | re.DOTALL)
STRICTLY, STRICT = "strict=True", re.compile(r",\s*(?:strict=\w+,?\s*)?(?=\))")


def write_mutants() -> list[str]:
    """Write the mutants of files that have changed, and return the names of all."""
    from mutmut import __main__ as mutmut

    mutmut.set_mutant_under_test("mutant_generation")
    Path("mutants").mkdir(exist_ok=True)
    mutmut.copy_src_dir()
    mutmut.copy_also_copy_files()
    mutmut.create_mutants(1)
    names: list[str] = []
    for path in Path("mutants").rglob("*.meta"):
        equal = of_equal_lengths(path.with_suffix("").read_text())
        every = json.loads(path.read_text())["exit_code_by_key"]
        names += [name for name in every if name.rpartition(".")[2] not in equal]
    return sorted(names)


def of_equal_lengths(text: str) -> set[str]:
    """Return the mutants in a text without `strict=True` of a `zip`, whose lengths are equal by construction."""

    def without(body: str) -> str:
        tree = ast.parse("def f(" + textwrap.dedent(body))
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "zip":
                node.keywords = [one for one in node.keywords if one.arg != "strict"]
        return ast.dump(tree)

    bodies = {match[2]: match[3] for match in DEFINITION.finditer(text)}
    equal = set()
    for name, body in bodies.items():
        before = bodies[f"{name.rpartition('__mutmut_')[0]}__mutmut_orig"]
        # Few texts are equal but for `strict=True`, and only these are parsed.
        fewer = body.count(STRICTLY) < before.count(STRICTLY)
        if fewer and STRICT.sub("", body) == STRICT.sub("", before) and without(body) == without(before):
            equal.add(name)
    return equal


def folder_of(mutant: str) -> str:
    """Return the folder of the tests of a mutant."""
    return f"tests/{mutant.split('.')[1]}"


@functools.cache
def tests_of(path: Path) -> tuple[str, dict[str, str]]:
    """Return the text of a file, and those of its functions by name."""
    text = path.read_text()
    return text, {one[1]: one[0] for one in re.finditer(r"^def (\w+)\(.*?(?=^\S|\Z)", text, re.MULTILINE | re.DOTALL)}


def ordered(mutant: str, items: list[pytest.Item]) -> list[pytest.Item]:
    """Return the tests of a mutant, those that are most likely to find it first."""
    module, _, function = mutant.rpartition("__mutmut_")[0].rpartition(".")
    module, (*owner, name) = module.rpartition(".")[2], function.removeprefix("x_").removeprefix("xǁ").split("ǁ")
    named = re.compile(owner[0] if name == "__init__" else rf"\.{name}\b" if owner else rf"\b{name}\b")

    @functools.cache
    def of_file(path: Path) -> tuple[bool, ...]:
        text = tests_of(path)[0]
        return not named.search(text), f"{(owner or [module])[0]}.{name}" not in text

    def is_near(item: pytest.Item) -> bool:
        return item.nodeid.startswith(folder_of(mutant) + "/")

    def rank(item: pytest.Item) -> tuple[bool, ...]:
        text, inside = tests_of(item.path)
        names_it = named.search(inside.get(getattr(item, "originalname", item.name), ""))
        last = module not in item.path.name, module not in text
        return not is_near(item), *of_file(item.path), not names_it, *last

    return sorted((item for item in items if is_near(item) or not of_file(item.path)[0]), key=rank)


class Tests:
    """Plugin of pytest that tests mutants in place of the code."""

    def __init__(self, mutants: list[str]):
        self.mutants, self.statuses, self._failed = mutants, dict[str, int](), False

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note that a test of this process has failed, and print the first one."""
        if report.failed and not self._failed:
            print(f"\n{report.nodeid} fails", file=sys.stderr, flush=True)
        self._failed |= report.failed

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Test each mutant in a process of its own, in place of the tests themselves."""
        for number, mutant in enumerate(self.mutants, 1):
            tests = ordered(mutant, session.items)
            child = os.fork()
            if not child:
                os._exit(self._status(mutant, tests))
            _, status, usage = os.wait4(child, 0)
            self.statuses[mutant] = os.waitstatus_to_exitcode(status)
            text = "survived" if self.statuses[mutant] == SURVIVED else "killed"
            print(f"\n{number} {text}: {mutant} ({usage.ru_utime:.1f} s)", flush=True)
        return True

    def _status(self, mutant: str, tests: list[pytest.Item]) -> int:
        """Return whether a test fails; in the process of the mutant."""
        os.environ["MUTANT_UNDER_TEST"] = mutant
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
        start = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        for item, following in zip(tests, [*tests[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if self._failed:
                return KILLED
            if resource.getrusage(resource.RUSAGE_SELF).ru_utime - start > BUDGET:
                break
        return SURVIVED


def run(mutants: list[str]) -> dict[str, int]:
    """Return the status of each mutant."""
    settings = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["mutmut"]
    os.environ["MUTANT_UNDER_TEST"] = ""
    os.chdir("mutants")
    # Its package and its tests take the place of those beside it.
    sys.path.insert(0, os.getcwd())
    sys.modules.pop("tests", None)
    tests = Tests(mutants)
    folders = sorted(str(path.parent) for path in Path("tests").glob("*/__init__.py"))
    pytest.main(["-q", "-s", *settings["pytest_add_cli_args"], *folders], plugins=[tests])
    return tests.statuses


def wilson(killed: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (E. B. Wilson, J. Am. Stat. Assoc. 22 (1927) 209-212)."""
    z, rate = 1.959964, killed / count
    centre, half = rate + z**2 / (2 * count), z * (rate * (1 - rate) / count + z**2 / (4 * count**2)) ** 0.5
    return (centre - half) / (1 + z**2 / count), (centre + half) / (1 + z**2 / count)


def main() -> None:
    """Print the mutants that survive, and the rate of those killed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=100, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("names", nargs="*", help="mutants to test instead, of those that are written")
    options = parser.parse_args()
    statuses = run(options.names or random.Random(options.seed).sample(write_mutants(), options.count))
    print("Not killed:", *(name for name, status in statuses.items() if status == SURVIVED), sep="\n")
    killed, count = sum(status != SURVIVED for status in statuses.values()), len(statuses)
    low, high = wilson(killed, count)
    print(f"{killed} of {count} killed: {killed / count:.1%} (95 % interval {low:.1%} to {high:.1%})")


if __name__ == "__main__":
    main()
