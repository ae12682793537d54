"""Command line of the package: ``python -m bayesperiodic inspect FILE``."""

import argparse
import sys

from bayesperiodic.data.file_inspection import inspect


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bayesperiodic", description="Identification from periodic states.")
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("inspect", help="print what is in a file of measurements, and the call that reads it")
    command.add_argument("file", nargs="+")
    for option in ("format", "encoding", "separator", "decimal", "thousands", "date-format"):
        command.add_argument(f"--{option}", help="as for Recording.from_file, where it is not recognised")
    command.add_argument("--header", type=int, help="line of the names, from 1, or 0 for none")
    options = vars(parser.parse_args(arguments))
    options.pop("command")
    status = 0
    for number, path in enumerate(options.pop("file")):
        try:
            print("\n" * (number > 0) + str(inspect(path, **options)))
        except (OSError, ImportError, ValueError) as error:
            print(f"error: {error}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
