"""Storage of results in HDF5 files, which are written atomically and read without executing stored code.

A file is composed in memory, because HDF5 itself crashes on a full disk, and ends with a checksum of its content, which
other readers of HDF5 ignore.
"""

import hashlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic._printing import Printed

HEADER = "bayesperiodic_result"
ARRAYS = "arrays"
SEAL = b"\nbayesperiodic sha256 "
OTHER = "path: must contain a result of this version of bayesperiodic"
REMEDY = "load it with the version that saved it, or compute it again"
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

        The file of a result with draws is a netCDF file, which xarray and ArviZ open (``arviz.from_netcdf``).

        Parameters
        ----------
        path : path
            The folder must exist.

        Raises
        ------
        OSError
            If the file cannot be written.
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


def write_sealed(path: str | Path, content: memoryview) -> None:
    """Write content and its checksum; an existing file is replaced when the new one is complete, or else stays."""
    with written_whole(path) as draft, draft.open("wb") as file:
        file.write(content)
        file.write(SEAL + hashlib.sha256(content).hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())


def read_sealed(path: str | Path) -> bytes:
    """Return the content of a file; raise a ValueError if its checksum is missing or wrong."""
    content, seal, digest = Path(path).read_bytes().rpartition(SEAL)
    if not seal:
        raise ValueError("it has no checksum; it was cut off, or not written by this version of bayesperiodic")
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise ValueError("its content has changed since it was written")
    return content


def in_folder(path: str | Path) -> Path:
    """Return the path; raise a FileNotFoundError if its folder does not exist."""
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"path: must be in an existing folder, got {str(path)!r}.")
    return target


def draft_prefix(path: Path) -> str:
    """Return how the names of temporary folders of a file begin, which a killed process leaves behind."""
    return f".{path.name}.draft-"


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Provide a temporary path whose file replaces `path` when the block ends without an error."""
    target = in_folder(path)
    with tempfile.TemporaryDirectory(prefix=draft_prefix(target), dir=target.parent) as folder:
        draft = Path(folder) / target.name
        yield draft
        os.replace(draft, target)


def load(path: str | Path) -> Any:
    """Load a saved result; the model is not needed and no stored code is executed.

    Parameters
    ----------
    path : path

    Returns
    -------
    Result
        An object of the class that was saved, such as `Experiment`, `MapEstimate` or `Posterior`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file contains no saved result or one of another version of this package, or has changed since it was
        written.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "fit.h5"
    >>> fit.save(path)
    >>> bp.load(path).theta == fit.theta
    True
    """
    import h5py

    if not Path(path).is_file():
        raise FileNotFoundError(f"path: must be an existing file, got {str(path)!r}.")
    try:
        content = io.BytesIO(read_sealed(path))
        with h5py.File(content, "r") as file:
            header = json.loads(file.attrs[HEADER])
            stored = file.get(ARRAYS, {})
            arrays = {key: stored[key][()] for key in stored}
        result = _decode(header, arrays, content)
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


def _decode(value: Any, arrays: dict[str, Any], whole: io.BytesIO) -> Any:
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    if "mapping" in value:
        return {key: _decode(item, arrays, whole) for key, item in value["mapping"]}
    if "sequence" in value:
        return tuple(_decode(item, arrays, whole) for item in value["sequence"])
    if "table" in value:
        import pandas as pd

        return pd.DataFrame(value["table"], index=value["index"])
    if "tree" in value:
        import xarray as xr

        with xr.open_datatree(whole, engine="h5netcdf") as tree:
            draws = tree.load().drop_nodes(ARRAYS, errors="ignore")
        del draws.attrs[HEADER]
        return draws
    name = str(value["result"])
    kind = _class(str(value.get("module")), name)
    if kind is None:
        raise ValueError(f"{OTHER}, got class {name!r}; {REMEDY}.")
    content = {field: _decode(item, arrays, whole) for field, item in value["fields"].items()}
    needed = {f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING}
    if not needed <= content.keys() <= {f.name for f in fields(kind)}:
        raise ValueError(f"{OTHER}, got other fields of {name}; {REMEDY}.")
    return kind(**content)


def _class(module: str, name: str) -> Any:
    """Return the `Storable` class of a module of this package, or None; no other module is imported."""
    path = Path(__file__).parent.joinpath(*module.split(".")).with_suffix(".py")
    if not MODULE.fullmatch(module) or not path.is_file():
        return None
    kind = vars(import_module(f"{__package__}.{module}")).get(name)
    defined = isinstance(kind, type) and issubclass(kind, Storable) and kind.__module__ == f"{__package__}.{module}"
    return kind if defined and is_dataclass(kind) else None
