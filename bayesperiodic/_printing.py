"""Printed texts."""

import sys
from collections.abc import Mapping
from typing import Any

from tqdm import tqdm

# Seconds between two states of a progress bar in a terminal, and in a file, where each adds to the text.
OFTEN, SELDOM = 0.1, 5.0


def printable(text: str) -> str:
    r"""Return a text that the standard output can show; characters that its encoding lacks are escaped, as ``\u03b8``.

    The texts of this package need no more than cp1252, the encoding of files that output on Windows is redirected into.
    Names and units are the user's.
    """
    encoding = getattr(sys.stdout, "encoding", None)
    try:
        return text if encoding is None else text.encode(encoding, "backslashreplace").decode(encoding)
    except (LookupError, TypeError):  # of an output that names no encoding of Python's
        return text


class Printed:
    """Base class of objects that can be printed whatever characters are in the names and units that the user gave."""

    def __str__(self) -> str:
        return printable(repr(self))


def as_text(rows: Mapping[str, Any], columns: list[str] | None = None) -> str:
    """Return texts by row, as dicts by column or in the order of `columns`, as a table."""
    import pandas as pd

    return pd.DataFrame.from_dict(dict(rows), orient="index", columns=columns).to_string()


def written(theta: Mapping[str, float]) -> str:
    """Return the names and values of parameters, as in messages."""
    return ", ".join(f"{name} = {value:.6g}" for name, value in theta.items())


def progress_bar(**options: Any) -> tqdm:
    """Return a bar of tqdm, written to a standard error that is no terminal every few seconds only."""
    return tqdm(mininterval=OFTEN if sys.stderr.isatty() else SELDOM, **options)
