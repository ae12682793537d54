"""Command line of the package: ``python -m bayesperiodic inspect | check | fit | report FILE``."""

import argparse
import sys
from pathlib import Path
from typing import Any

from bayesperiodic._printing import printable

PROBLEM, FIT, POSTERIOR, PAGE = ".toml", ".fit.h5", ".posterior.nc", ".html"
# Arguments of `map_estimate` and `sample` that are no options of a problem file.
GIVEN = ("problem", "fit", "progress", "executor", "checkpoint")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bayesperiodic", description="Identification from periodic states.")
    commands = parser.add_subparsers(dest="command", required=True)
    files = "print what is in a file of measurements, and the call that reads it"
    checked = "look for faults in all channels of a file, or in a problem file and its recordings; status 1 if ruinous"
    for name, text in (("inspect", files), ("check", checked)):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("file", nargs="+")
        for option in ("format", "encoding", "separator", "decimal", "thousands", "date-format"):
            command.add_argument(f"--{option}", help="as for Recording.from_file, where it is not recognised")
        command.add_argument("--header", type=int, help="line of the names, from 1, or 0 for none")
        if name == "check":
            command.add_argument("--time", help="channel of the times, where it is not recognised")
            command.add_argument("--sampling-rate", type=float, help="sampling rate [Hz] of a file without times")
    fitted = f"estimate, and sample if there is a table [sample]; write PROBLEM{FIT} and PROBLEM{POSTERIOR}"
    page = f"write PROBLEM{PAGE} of the results of fit"
    for name, text in (("fit", fitted), ("report", page)):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("file", nargs=1, metavar=f"PROBLEM{PROBLEM}")
    options = vars(parser.parse_args(arguments))
    run, status = COMMANDS[options.pop("command")], 0
    for number, path in enumerate(options.pop("file")):
        try:
            print("\n" * (number > 0), end="")
            status = max(status, run(path, **options))
        except (OSError, ImportError, ValueError, RuntimeError) as error:
            print(f"error: {error}", file=sys.stderr)
            status = 1
    return status


def _inspect(path: str, **options: Any) -> int:
    from bayesperiodic.data.file_inspection import inspect

    print(inspect(path, **options))
    return 0


def _check(path: str, **options: Any) -> int:
    """Print the check of each recording; return 1 if one has ruinous faults or no mean period.

    Of a problem file whose recordings have none, the problem is built and printed too.
    """
    from bayesperiodic.data.file_inspection import as_recording
    from bayesperiodic.data.recording_check import RUINOUS
    from bayesperiodic.problem.problem_file import ProblemFile

    status, file = 0, ProblemFile(path) if path.endswith(PROBLEM) else None
    folded = file.recordings() if file else [(as_recording(path, **options), {})]
    for recording, fold in folded:
        frequency, periods = fold.get("frequency"), fold.get("periods", 1)
        known: Any = frequency[0] if isinstance(frequency, tuple) and frequency else frequency
        seen = recording.check(known, periods=1 if isinstance(periods, str) else periods)
        print(seen)
        status = max(status, int(bool(seen.reason) or seen.severity == RUINOUS))
    if file and not status:
        print(_problem_of(file)[0])
    return status


def _problem_of(file: Any) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Return the problem of a problem file, and the options of its estimate and its draws, none without a table."""
    from bayesperiodic.density.problem import Problem
    from bayesperiodic.estimation.map_estimate import map_estimate
    from bayesperiodic.sampling.sample import sample

    how = file.options(map_estimate, "map_estimate", GIVEN)
    draws = file.options(sample, "sample", GIVEN) if "sample" in file.content else {}
    return file.build(Problem), how, draws


def _fit(path: str) -> int:
    """Estimate, sample, and save the results; return 1 if one has not converged."""
    from bayesperiodic.estimation.map_estimate import map_estimate
    from bayesperiodic.problem.problem_file import ProblemFile
    from bayesperiodic.sampling.sample import sample

    file, wanted = ProblemFile(path), [_beside(path, FIT)]
    if "sample" in file.content:
        wanted.append(_beside(path, POSTERIOR))
    problem, how, draws = _problem_of(file)
    print(problem)
    with file.located("map_estimate"):
        results: list[Any] = [map_estimate(problem, **how)]
    print(results[0])
    results[0].save(wanted[0])
    if draws:
        with file.located("sample"):
            results.append(sample(problem, results[0], **draws))
        print(results[1])
        results[1].save(wanted[1])
    print(printable(f"Written: {', '.join(map(str, wanted))}."))
    failed = [type(one).__name__ for one in results if not one.converged]
    if failed:
        print(f"error: {path}: not converged: {', '.join(failed)}; see above.", file=sys.stderr)
    return int(bool(failed))


def _report(path: str) -> int:
    from bayesperiodic._io import load
    from bayesperiodic.density.problem import Problem
    from bayesperiodic.reporting import report

    page, fit, draws = _beside(path, PAGE), Path(path).with_suffix(FIT), Path(path).with_suffix(POSTERIOR)
    if not fit.is_file():
        raise FileNotFoundError(
            f"file: must have results, got no {str(fit)!r}; run python -m bayesperiodic fit {path}."
        )
    problem = Problem.from_toml(path)
    report(problem, load(fit), load(draws) if draws.is_file() else None, page)
    print(printable(f"Written: {page}."))
    return 0


def _beside(path: str, ending: str) -> Path:
    """Return the path of a result of a problem file; raise a FileExistsError rather than replace one."""
    target = Path(path).with_suffix(ending)
    if target.exists():
        raise FileExistsError(f"file: must be without results, got {str(target)!r}; move or remove it.")
    return target


COMMANDS = {"inspect": _inspect, "check": _check, "fit": _fit, "report": _report}

if __name__ == "__main__":
    sys.exit(main())
