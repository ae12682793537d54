"""Command line of the studies."""

import argparse
import ast
import importlib
import sys
from pathlib import Path

import matplotlib

import studies


def main(arguments: list[str] | None = None) -> int:
    """List the studies or run one; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m studies", description="Without a name: list the studies.")
    parser.add_argument("name", nargs="?", help="the study to run")
    parser.add_argument("--data", type=Path, help="the measured file, instead of the places searched by default")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--out", type=Path, help="folder for results.json and figures (default output/NAME)")
    place.add_argument("--publish", action="store_true", help="into figures/NAME, the stored results that pages quote")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (default 1)")
    parser.add_argument("--quick", action="store_true", help="short chains, into output/quick/NAME; not for quoting")
    parser.add_argument("--format", choices=("png", "pdf", "svg"), default="png", help="figures as pdf or svg too")
    parser.add_argument("--noise", type=float, default=1e-3, help="pendulum: fraction of the attractor (default 0.001)")
    parser.add_argument(
        "--replicates",
        type=int,
        default=0,
        help="verdicts, pendulum, landing-gear, flutter: data sets (default 0); calibration: campaigns (default 20); "
        "noisy-inputs, missing-terms, coverage: data sets a case (default 200, 50, 200); recordings: good ones (500); "
        "population: tests that are predicted from the others, with --scaling most stored units",
    )
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument("--processes", type=int, help="calibration: so many processes on this machine (default: one)")
    workers.add_argument("--dask", metavar="ADDRESS", help="calibration: a Dask scheduler, such as tcp://host:8786")
    workers.add_argument("--mpi", action="store_true", help="calibration: MPI, below mpiexec … -m mpi4py.futures")
    parser.add_argument("--truth", choices=("A", "B"), help="landing-gear: which damper (default both)")
    parser.add_argument("--missing", action="store_true", help="landing-gear: what missing_terms finds, only that")
    parser.add_argument(
        "--populations", action="store_true", help="landing-gear: gears and theta16 as populations, only"
    )
    parser.add_argument(
        "--part",
        choices=("orbits", "parameters", "shooting"),
        help="harvester: known orbits, known parameters, or multiple shooting, only that",
    )
    parser.add_argument("--scaling", action="store_true", help="calibration, population: measure the cost, only that")
    parser.add_argument("--guard", action="store_true", help="benchmark: a quick run's ratios against those kept")
    parser.add_argument("--cold-start", action="store_true", help="benchmark: times in new environments, only that")
    options = parser.parse_args(arguments)
    known = {path.parent.name.replace("_", "-"): path for path in Path(studies.__path__[0]).glob("*/run.py")}
    if options.name is None:
        for name in sorted(known):
            print(f"{name:12s} {_first_line(known[name])}")
        return 0
    if options.name not in known:
        print(f"error: name: {options.name!r} is not a study; known: {', '.join(sorted(known))}.", file=sys.stderr)
        return 2
    matplotlib.use("Agg")
    matplotlib.rcParams["savefig.format"] = options.format
    package = known[options.name].parent.name
    options.quick = options.quick or options.guard
    try:
        if options.publish and options.quick:
            raise ValueError("--publish: must be a full run, got --quick or --guard.")
        options.out = options.out or folder_of(package, publish=options.publish, quick=options.quick)
        if options.replicates < 0:
            raise ValueError(f"--replicates: must be at least 0, got {options.replicates}.")
        importlib.import_module(f"studies.{package}.run").run(options)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"written to {options.out}/")
    return 0


def folder_of(package: str, *, publish: bool, quick: bool) -> Path:
    """Return the default folder of a study: ignored by git, or with `publish` the one of its stored results."""
    return Path("figures", package) if publish else Path("output", *(["quick"] if quick else []), package)


def _first_line(main_file: Path) -> str:
    """Return the first line of a study's docstring without importing it, which would load the compiler."""
    return (ast.get_docstring(ast.parse(main_file.read_text(encoding="utf-8"))) or "").splitlines()[0]


if __name__ == "__main__":
    sys.exit(main())
