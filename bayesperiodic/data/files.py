"""Reading of columns from CSV, NPZ and MAT files, and conversion of their units."""

import csv
import itertools
import re
import warnings
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from bayesperiodic import _checks

# Lines among which the header is searched for.
PREAMBLE = 1000

Units = Mapping[str, float | Sequence[str]]

LONGEST_UNIT = 100
# Products, quotients and groups of names with an exponent of one digit; the only number is the 1 of "1/s".
SUPERSCRIPTS = "¹²³⁰⁴⁵⁶⁷⁸⁹"
UNIT_TOKEN = re.compile(
    rf"(?:[^\W\d{SUPERSCRIPTS}]|[°%])[^\W{SUPERSCRIPTS}]*"
    rf"(?:\s*(?:\*\*|\^)\s*[+-]?[0-9](?:\.5)?(?![\w.])|⁻?[{SUPERSCRIPTS}](?!\w))?"
    r"|1(?![\w.])|[()]|[*/·]|\s+"
)


def read_csv(path: str | Path, columns: Iterable[str], label: str | None = None) -> dict[str, np.ndarray]:
    """Return named columns of a CSV file; the header is the first line with all of these names.

    The column `label` may contain text.
    """
    import pandas as pd

    columns, file = [*columns], existing(path)
    try:
        names, lines, more = _header(file, columns)
        with file.open(encoding="utf-8-sig", newline="") as text, warnings.catch_warnings():
            _skip(text, lines)
            warnings.simplefilter("error", pd.errors.ParserWarning)
            # More columns than names hold the fields after trailing commas.
            table = pd.read_csv(
                text,
                header=None,
                names=range(len(names) + max(more, 0) + 1),
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
            )
    except (pd.errors.ParserError, pd.errors.ParserWarning) as error:
        _check_fields(file, names, lines)
        raise ValueError(f"path: must be a CSV file with a header line, got {str(path)!r} ({error}).") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {str(path)!r} ({error}).") from None
    if table.empty:
        raise ValueError(f"path: must be a CSV file with rows of data, got {str(path)!r}, which has none.")
    if table.iloc[:, len(names) :].notna().any(axis=None) or table[len(names) - 1].isna().any():
        _check_fields(file, names, lines)
    result = {}
    for column in columns:
        values = table[_place(path, names, column)]
        if column == label:
            result[column] = values.to_numpy()
            continue
        if not pd.api.types.is_numeric_dtype(values):
            row = np.flatnonzero(pd.to_numeric(values, errors="coerce").isna() & values.notna())
            got = f"{values.iloc[row[0]]!r} in data row {row[0] + 1}" if row.size else "numbers too long to be read"
            raise ValueError(
                f"column {column!r} of {file.name}: must contain numbers, with a decimal point, got {got}."
            )
        result[column] = _numbers(path, column, values.to_numpy())
    return result


def _header(file: Path, columns: list[str]) -> tuple[list[str], int, int]:
    """Return the names of the columns of a CSV file, the number of lines up to there, and of fields that follow."""
    with file.open(encoding="utf-8-sig", newline="") as lines:
        rows = csv.reader(lines, skipinitialspace=True)
        found = [([name.strip() for name in row], rows.line_num) for row in itertools.islice(rows, PREAMBLE) if row]
    if not found:
        raise ValueError(f"path: must be a CSV file with a header line, got {str(file)!r}, which is empty.")
    # Without a line of all names, that with most of them tells what is missing.
    place = max(range(len(found)), key=lambda i: len({*columns} & {*found[i][0]}))
    names, number = found[place]
    if not {*columns} <= {*names} and _is_no_header(names):
        raise ValueError(
            f"path: must be a CSV file whose first line names the columns, separated by commas, got {str(file)!r}, "
            f"whose first line is read as {names}. Numbers must have a decimal point."
        )
    return names, number, max((len(row) - len(names) for row, _ in found[place + 1 : place + 2]), default=0)


def _check_fields(file: Path, names: list[str], lines: int) -> None:
    """Raise a ValueError unless each row has one field per name, and equally many empty ones after them."""
    with file.open(encoding="utf-8-sig", newline="") as text:
        _skip(text, lines)
        fields = None
        data = (row for row in csv.reader(text, skipinitialspace=True) if any(field.strip() for field in row))
        for number, row in enumerate(data, 1):
            fields = fields or len(row)
            if len(row) < len(names) or len(row) != fields or any(field.strip() for field in row[len(names) :]):
                raise ValueError(
                    f"path: must be a CSV file with {len(names)} fields in each row, as many as there are names, got "
                    f"{len(row)} in data row {number} of {str(file)!r}."
                )


def _skip(text: TextIO, lines: int) -> None:
    """Read a file up to the end of its header."""
    rows = csv.reader(text, skipinitialspace=True)
    while rows.line_num < lines:
        next(rows)


def _place(path: str | Path, names: list[str], column: str) -> int:
    _checks.one_of(f"column of {Path(path).name}", column, names)
    if (count := names.count(column)) > 1:
        places = [i + 1 for i, name in enumerate(names) if name == column]
        raise ValueError(
            f"column of {Path(path).name}: must be the name of one column, got {column!r}, the name of {count} "
            f"(columns {', '.join(map(str, places))}); rename them in the file."
        )
    return names.index(column)


def read_npz(path: str | Path, columns: Iterable[str]) -> dict[str, np.ndarray]:
    """Return named arrays of an NPZ file, without loading pickled objects."""
    try:
        with np.load(existing(path), allow_pickle=False) as archive:
            return {c: _numbers(path, c, _pick(path, archive, c)) for c in columns}
    except (zipfile.BadZipFile, EOFError, AttributeError, TypeError) as error:
        raise ValueError(
            f"path: must be an NPZ file of named arrays (numpy.savez), got {str(path)!r} ({error})."
        ) from None
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise ValueError(
                f"path: must be an NPZ file without pickled objects, got {str(path)!r}. Save numeric arrays by "
                "numpy.savez, or read a CSV or MAT file by from_csv or from_mat."
            ) from None
        raise


def read_mat(path: str | Path, columns: Iterable[str]) -> dict[str, np.ndarray]:
    """Return named variables of a MAT file, version 5 or 7.3."""
    import h5py
    from scipy.io import loadmat

    file = existing(path)
    if h5py.is_hdf5(file):
        with h5py.File(file, "r") as archive:
            return {c: _numbers(path, c, np.asarray(_pick(path, archive, c))) for c in columns}
    try:
        variables = {name: value for name, value in loadmat(file).items() if not name.startswith("__")}
    except (ValueError, TypeError, NotImplementedError, EOFError) as error:
        raise ValueError(f"path: must be a MAT file, got {str(path)!r} ({error}).") from None
    return {c: _numbers(path, c, _pick(path, variables, c)) for c in columns}


def existing(path: str | Path) -> Path:
    """Return the path; raise a FileNotFoundError if there is no such file."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: must be an existing file, got {str(path)!r}.")
    return file


def _is_no_header(names: list[str]) -> bool:
    """Return whether a first line contains numbers, or separators other than commas."""
    if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
        return True
    try:
        return bool([float(name) for name in names])
    except ValueError:
        return False


def _pick(path: str | Path, source: Any, column: str) -> Any:
    _checks.one_of(f"column of {Path(path).name}", column, list(source.keys()))
    return source[column]


def _numbers(path: str | Path, column: str, values: Any) -> np.ndarray:
    argument = f"column {column!r} of {Path(path).name}"
    array = np.squeeze(np.asarray(values))
    if array.ndim != 1 or array.dtype.kind not in "fiub":
        raise ValueError(
            f"{argument}: must be one column of real numbers, got shape {np.shape(values)} and type {array.dtype}."
        )
    return array.astype(float)


def convert(name: str, values: np.ndarray, unit: float | Sequence[str]) -> np.ndarray:
    """Return the values of a channel, multiplied by a factor or converted by a pair of units such as ("mm", "m")."""
    argument = f"units[{name!r}]"
    if isinstance(unit, int | float):
        factor = _checks.finite_number(argument, unit)
        if factor == 0.0:
            raise ValueError(f"{argument}: must not be zero, got {unit!r}.")
        return values * factor
    if isinstance(unit, str) or len(unit) != 2 or not all(isinstance(u, str) for u in unit):
        raise ValueError(f"{argument}: must be a factor or a pair such as ('mm', 'm'), got {unit!r}.")
    for text in unit:
        if len(text) > LONGEST_UNIT or not _is_unit(text):
            shown = text if len(text) <= LONGEST_UNIT else f"{text[:LONGEST_UNIT]}…"
            raise ValueError(
                f"{argument}: must be units that are multiplied or divided, with exponents of one digit, such as "
                f"'kg*m/s**2', got {shown!r}."
            )
    import pint

    try:
        first, second = (text.replace("·", "*") for text in unit)
        return np.asarray(pint.UnitRegistry().Quantity(values, first).to(second).magnitude, dtype=float)
    except (pint.errors.PintError, AssertionError, TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(
            f"{argument}: must be two units of the same dimension, got {tuple(unit)!r} ({error})."
        ) from None


def _is_unit(text: str) -> bool:
    """Return whether a text consists of the permitted tokens, and no operator follows another one."""
    place, operator, depth = 0, False, 0
    while place < len(text):
        token = UNIT_TOKEN.match(text, place)
        if token is None:
            return False
        place, mark = token.end(), token.group().strip()
        if mark in ("*", "/", "·"):
            if operator:
                return False
            operator = True
        elif mark:
            operator = False
            depth += {"(": 1, ")": -1}.get(mark, 0)
    return depth == 0
