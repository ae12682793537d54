"""Storage of results in HDF5 files, which are written atomically and read without executing stored code.

A file is composed in memory, because HDF5 itself crashes on a full disk, and ends with a checksum of its content, which
other readers of HDF5 ignore.
"""

import io
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import MISSING, fields, is_dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._files import read_sealed, write_sealed
from bayesperiodic._printing import Printed

HEADER = "bayesperiodic_result"
ARRAYS = "arrays"
OTHER = "path: must contain a result of this version of bayesperiodic"
REMEDY = "load it with the version that saved it, or compute it again"
# Bytes of a file, by default; its values are not larger.
LARGEST_FILE = 2.0**31
# Metadata of fields that are left out of files; they have defaults.
NOT_STORED = {"stored": False}
# Modules in files are paths below this package, without private names: nothing outside of it can be named.
MODULE = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*")


class Storable(Printed):
    """Base class of dataclasses of plain data that files may contain; `load` finds them in their modules."""


class Result(Storable):
    """Base class of frozen dataclasses of plain data, with a `save` method; `load` reads them."""

    def save(self, path: str | Path) -> None:
        """Write the result to an HDF5 file; an existing file is replaced when the new one is complete.

        Symbolic links stay, and the file to which they lead is written.

        The file of a result with draws is a netCDF file, which xarray and ArviZ open (``arviz.from_netcdf``).

        Parameters
        ----------
        path : path
            The folder must exist.

        Raises
        ------
        OSError
            If the file cannot be written, or the path leads to a folder, a device or a pipe.
        TypeError
            If the result contains something other than plain data, such as a function.
        """
        import h5py

        arrays: dict[str, Any] = {}
        trees: list[Any] = []
        header, content = json.dumps(_encode(self, arrays, trees)), io.BytesIO()
        dask = sys.modules.get("dask")  # With a Client, xarray would lock the content by name on the cluster.
        with dask.config.set(scheduler="synchronous") if dask else nullcontext():
            if trees:
                trees[0].to_netcdf(content, engine="h5netcdf")
        with h5py.File(content, "a" if trees else "w") as file:
            file.attrs[HEADER] = header
            for key, values in arrays.items():
                file.create_dataset(f"{ARRAYS}/{key}", data=values)
        write_sealed(path, content.getbuffer())


def load(path: str | Path, *, largest: float = LARGEST_FILE) -> Any:
    """Load a saved result; the model is not needed, no stored code is executed, and no other file is read.

    Parameters
    ----------
    path : path
    largest : float
        Largest size of the file [bytes], by default 2 GiB; the values in it are not compressed, and not larger.

    Returns
    -------
    Result
        An object of the class that was saved, such as `Experiment`, `MapEstimate` or `Posterior`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file contains no saved result or one of another version of this package, has changed since it was
        written, is too large, or refers to data in other files.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "fit.h5"
    >>> fit.save(path)
    >>> bp.load(path).theta == fit.theta
    True
    """
    return load_groups(path, None, largest=largest)


def load_groups(path: str | Path, groups: Sequence[str] | None, *, largest: float = LARGEST_FILE) -> Any:
    """Load a saved result as `load` does, but of its draws only some groups, which takes a third of the time."""
    import h5py

    from bayesperiodic import _hdf5

    if not Path(path).is_file():
        raise FileNotFoundError(f"path: must be an existing file, got {str(path)!r}.")
    if (size := os.path.getsize(path)) > _checks.positive("largest", largest):
        raise ValueError(
            f"path: must be a file of at most {largest / 1e9:.3g} GB, got {str(path)!r} with {size / 1e9:.3g} GB; "
            f"load(path, largest={size}) reads it."
        )
    try:
        content = read_sealed(path)
        with h5py.File(io.BytesIO(content), "r") as file:
            arrays = _hdf5.Arrays(file, ARRAYS, len(content))
            present = None if groups is None else [group for group in groups if group in file]
            result = _decode(json.loads(file.attrs[HEADER]), arrays, partial(_draws, content, present))
        if not isinstance(result, Storable):
            raise ValueError(f"it contains a {type(result).__name__}")
    except Exception as error:  # whatever HDF5, JSON, NumPy and xarray raise for files that someone has made up
        if str(error).startswith(OTHER):
            raise ValueError(f"{str(error).removesuffix('.')}: {str(path)!r}.") from None
        reason = f"{type(error).__name__}: {error}" if not isinstance(error, ValueError) else error
        raise ValueError(
            f"path: must be a file written by save(), got {str(path)!r} ({reason}); a checkpoint is read by "
            "sample(…, checkpoint=path)."
        ) from None
    return result


def _encode(value: Any, arrays: dict[str, Any], trees: list[Any]) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        module = kind.__module__.removeprefix(f"{__package__}.")
        if _class(module, kind.__name__) is not kind:
            raise TypeError(f"result: must consist of plain data and results of bayesperiodic, got {kind.__name__}.")
        stored = [f.name for f in fields(value) if f.metadata.get("stored", True)]
        content = {name: _encode(getattr(value, name), arrays, trees) for name in stored}
        return {"result": kind.__name__, "module": module, "fields": content}
    if isinstance(value, np.ndarray):
        key = str(len(arrays))
        arrays[key] = value
        return {"array": key}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {"mapping": [[key, _encode(item, arrays, trees)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return {"sequence": [_encode(item, arrays, trees) for item in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if type(value).__name__ == "DataFrame":
        columns = {str(name): value[name].tolist() for name in value.columns}
        return {"table": columns, "index": [str(label) for label in value.index]}
    if type(value).__name__ == "DataTree":
        trees.append(value)
        return {"tree": True}
    raise TypeError(f"result: must consist of numbers, texts, arrays, tables and draws, got {type(value).__name__}.")


def _draws(content: bytes, groups: Sequence[str] | None) -> Any:
    """Return the draws in a file, all groups or some."""
    import xarray as xr

    from bayesperiodic import _hdf5

    _hdf5.check_all(content)  # before xarray follows its links
    if groups is None:
        with xr.open_datatree(io.BytesIO(content), engine="h5netcdf") as tree:
            draws = tree.drop_nodes(ARRAYS, errors="ignore").load()
    else:
        parts = [xr.load_dataset(io.BytesIO(content), engine="h5netcdf", group=group) for group in ("/", *groups)]
        draws = xr.DataTree.from_dict(dict(zip(("/", *groups), parts, strict=True)))
    del draws.attrs[HEADER]
    return draws


def _decode(value: Any, arrays: Any, draws: Callable[[], Any]) -> Any:
    """Return a value of the header; only arrays that it names are read."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[str(value["array"])]
    if "mapping" in value:
        return {key: _decode(item, arrays, draws) for key, item in value["mapping"]}
    if "sequence" in value:
        return tuple(_decode(item, arrays, draws) for item in value["sequence"])
    if "table" in value:
        import pandas as pd

        return pd.DataFrame(value["table"], index=value["index"])
    if "tree" in value:
        return draws()
    name = str(value["result"])
    kind = _class(str(value.get("module")), name)
    if kind is None:
        raise ValueError(f"{OTHER}, got class {name!r}; {REMEDY}.")
    given = {field: _decode(item, arrays, draws) for field, item in value["fields"].items()}
    needed = {f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING}
    if not needed <= given.keys() <= {f.name for f in fields(kind)}:
        raise ValueError(f"{OTHER}, got other fields of {name}; {REMEDY}.")
    return kind(**given)


def _class(module: str, name: str) -> Any:
    """Return the `Storable` class of a module of this package, or None; no other module is imported."""
    path = Path(__file__).parent.joinpath(*module.split(".")).with_suffix(".py")
    if not MODULE.fullmatch(module) or not path.is_file():
        return None
    kind = vars(import_module(f"{__package__}.{module}")).get(name)
    defined = isinstance(kind, type) and issubclass(kind, Storable) and kind.__module__ == f"{__package__}.{module}"
    return kind if defined and is_dataclass(kind) else None
