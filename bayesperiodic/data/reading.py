"""Columns of CSV, NPZ and MAT files, and conversion of units."""

import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks


def read_csv(path: str | Path, columns: Iterable[str]) -> dict[str, np.ndarray]:
    """Return named columns of a CSV file with a header line."""
    import pandas as pd

    try:
        table = pd.read_csv(existing(path), skipinitialspace=True, low_memory=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {str(path)!r} ({error}).") from None
    table.columns = [str(name).strip() for name in table.columns]
    columns, names = [*columns], [*table.columns]
    if not {*columns} <= {*names} and _is_no_header(names):
        raise ValueError(
            f"path: must be a CSV file whose first line names the columns, separated by commas, got {str(path)!r}, "
            f"whose first line is read as {names}. Numbers must have a decimal point."
        )
    result = {}
    for column in columns:
        values = _pick(path, table, column)
        if not pd.api.types.is_numeric_dtype(values):
            row = int(np.flatnonzero(pd.to_numeric(values, errors="coerce").isna() & values.notna())[0])
            raise ValueError(
                f"column {column!r} of {Path(path).name}: must contain numbers, with a decimal point, got "
                f"{values.iloc[row]!r} in data row {row + 1}."
            )
        result[column] = _numbers(path, column, values.to_numpy())
    return result


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
    """Return values multiplied by a factor or converted by a pair of units.

    Parameters
    ----------
    name : str
        Channel, for messages.
    values : array
    unit : float or (from, to)
        Factor, or two unit names such as ("mm", "m").

    Raises
    ------
    ValueError
        For a factor that is zero or not finite, an unknown unit, or units of different dimensions.
    """
    argument = f"units[{name!r}]"
    if isinstance(unit, int | float):
        factor = _checks.finite_number(argument, unit)
        if factor == 0.0:
            raise ValueError(f"{argument}: must not be zero, got {unit!r}.")
        return values * factor
    if isinstance(unit, str) or len(unit) != 2 or not all(isinstance(u, str) for u in unit):
        raise ValueError(f"{argument}: must be a factor or a pair such as ('mm', 'm'), got {unit!r}.")
    import pint

    try:
        return np.asarray(pint.UnitRegistry().Quantity(values, unit[0]).to(unit[1]).magnitude, dtype=float)
    except (pint.errors.PintError, AssertionError, TypeError, ValueError) as error:
        raise ValueError(
            f"{argument}: must be two units of the same dimension, got {tuple(unit)!r} ({error})."
        ) from None
