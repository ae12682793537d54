"""Mutation testing of a random sample of mutants: ``python -m tests.mutants --count 100 --seed 1``.

mutmut writes the mutants of the modules in `pyproject.toml` and records the tests that call each function. A mutant is
tested by the folder of `tests/` that mirrors its own: the tests that call the mutated function, the quickest first, and
the others of their files, as many as take `BUDGET` seconds. It survives if they pass. Results are in `mutants.md`.
"""

import argparse
import json
import random
import subprocess
import sys
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

BUDGET = 40.0
STATISTICS = Path("mutants/mutmut-stats.json")
KILLED = ("killed", "timeout")
NOT_RUN = 255  # of an error before the tests, which mutmut calls a timeout


def chosen_tests(mutant: str, statistics: dict) -> tuple[list[str], float]:
    """Return the tests of a mutant, each with all its parameters, and how long they take [s]."""
    folder, function = f"tests/{mutant.split('.')[1]}/", mutant.rpartition("__mutmut_")[0]
    # pytest does not find some parameters again by their text, and then runs no test at all.
    calling = {test.partition("[")[0] for test in statistics["tests_by_mangled_function_name"].get(function, [])}
    # A result that several tests share is computed in the first of them only, so the others in its file follow.
    files = {test.partition("::")[0] for test in calling if test.startswith(folder)}
    seconds: dict[str, float] = {}
    for test, time in statistics["duration_by_test"].items():
        if test.partition("::")[0] in files:
            name = test.partition("[")[0]
            seconds[name] = seconds.get(name, 0.0) + time
    chosen, total = [], 0.0
    for test in sorted(seconds, key=lambda test: (test not in calling, seconds[test])):
        if chosen and total + seconds[test] > BUDGET:
            break
        chosen.append(test)
        total += seconds[test]
    return chosen, total


def run(names: list[str]) -> dict[str, str]:
    """Return the status of each mutant, tested in a process forked from one that has imported the tests."""
    from mutmut.stats import status_by_exit_code
    from mutmut.utils.file_utils import setup_source_paths
    from mutmut.workers.isolation import get_mutant_runner

    setup_source_paths()
    statistics = json.loads(STATISTICS.read_text())
    runner, statuses = get_mutant_runner(1), {}
    runner.startup()
    for number, name in enumerate(names, 1):
        tests, seconds = chosen_tests(name, statistics)
        statuses[name] = "no tests"
        if tests:
            # The limits are wide, so that no mutant is killed because the machine is busy.
            runner.submit(name, tests, int(8 * seconds + 240), seconds)
            code = runner.wait_for_result().exit_code
            statuses[name] = "not run" if code == NOT_RUN else status_by_exit_code[code]
        print(f"{number} {statuses[name]}: {name}", flush=True)
    runner.signal_work_complete()
    runner.shutdown()
    return statuses


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
    parser.add_argument("names", nargs="*", help="mutants to test instead")
    options = parser.parse_args()
    # Writes the mutants and records the calls, or those that have changed, and tests one mutant.
    mutmut = Path(sys.executable).with_name("mutmut")
    subprocess.run([mutmut, "run", "--max-children", "1", "bayesperiodic.data.folding.x_parts__mutmut_1"])
    metadata = [json.loads(path.read_text()) for path in Path("mutants").rglob("*.meta")]
    known = sorted(name for one in metadata for name in one["exit_code_by_key"])
    statuses = run(options.names or random.Random(options.seed).sample(known, options.count))
    print("Not killed:", *(f"{status}: {name}" for name, status in statuses.items() if status not in KILLED), sep="\n")
    killed, count = sum(status in KILLED for status in statuses.values()), len(statuses)
    low, high = wilson(killed, count)
    print(
        f"{killed} of {count} killed: {killed / count:.1%} (95 % interval {low:.1%} to {high:.1%}), drawn from "
        f"{len(known)}; {getrusage(RUSAGE_CHILDREN).ru_utime / 60:.0f} min of processor time"
    )


if __name__ == "__main__":
    main()
