"""Mutation testing of a random sample of mutants: ``python -m tests.mutants --count 150 --seed 1``.

mutmut writes the mutants of the modules in `pyproject.toml` and records the tests that call each function. A mutant is
tested by the files of the folder in `tests/` that mirrors its own, if one of their tests calls the mutated function:
the shortest tests first, as many as take `BUDGET` seconds. It counts as survived if they pass.
"""

import argparse
import json
import os
import random
import sys
from pathlib import Path
from time import process_time

BUDGET = 60.0
SETTINGS = Path("mutants/mutmut-stats.json")


def tests_of(mutant: str, stats: dict) -> tuple[list[str], float]:
    """Return the tests of a mutant, and how long they take [s]."""
    folder = f"tests/{mutant.split('.')[1]}/"
    calling = stats["tests_by_mangled_function_name"].get(mutant.rpartition("__mutmut_")[0], [])
    files = {test.partition("::")[0] for test in calling if test.startswith(folder)}
    # A result that several tests share is computed in the first of them only, so whole files are taken.
    seconds = {test: time for test, time in stats["duration_by_test"].items() if test.partition("::")[0] in files}
    chosen, total = [], 0.0
    for test in sorted(seconds, key=seconds.__getitem__):
        total += seconds[test]
        if chosen and total > BUDGET:
            break
        chosen.append(test)
    return chosen, min(total, BUDGET)


def wilson(killed: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (E. B. Wilson, J. Am. Stat. Assoc. 22 (1927) 209-212)."""
    z, rate = 1.959964, killed / count
    centre, half = rate + z**2 / (2 * count), z * (rate * (1 - rate) / count + z**2 / (4 * count**2)) ** 0.5
    return (centre - half) / (1 + z**2 / count), (centre + half) / (1 + z**2 / count)


def run(names: list[str]) -> dict[str, str]:
    """Return the status of each mutant, by processes forked from one that has imported the tests but run none."""
    from mutmut.stats import status_by_exit_code
    from mutmut.utils.file_utils import setup_source_paths
    from mutmut.workers.isolation import get_mutant_runner

    setup_source_paths()
    stats = json.loads(SETTINGS.read_text())
    runner, statuses = get_mutant_runner(1), {}
    runner.startup()
    for number, name in enumerate(names, 1):
        tests, seconds = tests_of(name, stats)
        statuses[name] = "no tests"
        if tests:
            # The limits [s] are wide, since a machine at work must not kill mutants.
            runner.submit(name, tests, int(2 * (4 * seconds + 90)), seconds)
            statuses[name] = status_by_exit_code[runner.wait_for_result().exit_code]
        print(f"{number} {statuses[name]:9} {name}", flush=True)
    runner.signal_work_complete()
    runner.shutdown()
    return statuses


def main() -> None:
    """Print the mutants that survived and the rate of those killed with its 95 % interval."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("names", nargs="*", help="mutants instead of a sample")
    options = parser.parse_args()
    if not SETTINGS.exists():
        # One mutant is tested, so that the mutants are written and the callers recorded.
        os.system(f"{Path(sys.executable).parent}/mutmut run --max-children 1 '*.quantisation.*__mutmut_1'")
    known = sorted(
        name for path in Path("mutants").rglob("*.meta") for name in json.loads(path.read_text())["exit_code_by_key"]
    )
    statuses = run(options.names or random.Random(options.seed).sample(known, options.count))
    count, killed = len(statuses), sum(status in ("killed", "timeout") for status in statuses.values())
    low, high = wilson(killed, count)
    print("\n".join(f"{status}: {name}" for name, status in statuses.items() if status not in ("killed", "timeout")))
    print(f"{killed} of {count} mutants killed ({killed / count:.1%}, 95 % interval {low:.1%} to {high:.1%}), "
          f"of {len(known)}")


if __name__ == "__main__":
    main()
