"""Matrices in files of programs of finite elements, of MATLAB and of Python."""

import re
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from bayesperiodic import _checks, _hdf5
from bayesperiodic.data import units
from bayesperiodic.data.formats import npz, recognise
from bayesperiodic.data.formats.contents import LARGEST_ARRAY, Contents, StoredChannel, existing

MATRIX_MARKET, ONE_ARRAY = b"%%MatrixMarket", b"\x93NUMPY"
# Arrays of a sparse matrix of SciPy in an NPZ file.
SCIPY_SPARSE = {"format", "shape", "data"}
# Those that contain numbers of rows, columns and diagonals.
SPARSE_PLACES = frozenset({"row", "col", "indices", "offsets"})
FORMATS_OF_MATRICES = "a MatrixMarket, NPZ, NPY, MAT or HDF5 file"


def read_matrix(path: str | Path, name: str | None = None, unit: str | None = None) -> np.ndarray:
    """Return a matrix from a file of MatrixMarket (.mtx), NPZ, NPY, MAT (version 5 or 7.3) or HDF5.

    The format is recognised by the first bytes. Sparse matrices of MatrixMarket, MATLAB and SciPy (``save_npz``)
    become arrays; of a symmetric matrix of MatrixMarket, of which a file has one triangle, both are returned. Links to
    other files and pickled objects are not followed.

    Parameters
    ----------
    path : str or pathlib.Path
    name : str, optional
        Of the array in the file; not needed if there is one. Fields of structures are "s.K", members of groups "s/K".
    unit : str, optional
        Of the values in the file, such as "N/mm" or "t", which are converted to SI. By default the values are returned
        as they are. Matrices with rotations beside displacements have several units: convert them yourself.

    Returns
    -------
    array (rows, columns)

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        For another or a damaged file, a name that is not in it, and what is no real matrix, has two values in one
        place, or is larger than 2 GB.

    Warns
    -----
    UserWarning
        If all values on one side of the diagonal are zero: the file may have one triangle of a symmetric matrix.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "beam.npz"
    >>> np.savez(path, M=np.eye(2), K=[[2.0, -1.0], [-1.0, 1.0]])
    >>> model = bp.Model.from_matrices("beam", mass=bp.read_matrix(path, "M", "t"),
    ...     stiffness=bp.read_matrix(path, "K", "kN/mm"), forces={"force": 0}, outputs={"x": (1, "displacement")})
    >>> bp.read_matrix(path, "K", "kN/mm").tolist()
    [[2000000.0, -1000000.0], [-1000000.0, 1000000.0]]
    """
    file = existing(path)
    with file.open("rb") as content:
        head = content.read(len(MATRIX_MARKET))
    whole = _contents(file, head)
    names = [channel.label for channel in whole.channels]
    argument = f"name of a matrix in {file.name!r}"
    if not names:
        raise ValueError(f"path: must be a file with a matrix, got {str(path)!r} without arrays.")
    if name is None and len(names) > 1:
        raise ValueError(f"{argument}: must be given, one of {', '.join(map(repr, names))}, got None.")
    if name is not None:
        _checks.one_of(argument, name, names)
    chosen = whole.channels[0 if name is None else names.index(name)]
    if chosen.refusal:
        raise ValueError(f"{argument}: must be a matrix, got {chosen.label!r}, {chosen.refusal}.")
    matrix = _real_matrix(argument, chosen)
    _warn_of_triangle(file, chosen.label, matrix)
    return matrix * _factor(unit)


def _contents(file: Path, head: bytes) -> Contents:
    """Return the arrays of a file, each read when it is asked for; any error of a package is one of the file."""
    if head == MATRIX_MARKET:
        return _of_one(file, "a MatrixMarket file (.mtx)", _market_values)
    if head.startswith(ONE_ARRAY):
        return _of_one(file, "a file of one array (.npy)", _array_values)
    form = recognise.recognised(file)
    if form == "hdf5":
        with recognise.one_error("an HDF5 file", file):
            return _hdf5_contents(file)
    if form not in ("npz", "mat"):
        raise ValueError(
            f"path: must be {FORMATS_OF_MATRICES}, got {str(file)!r}, {recognise.FORMATS[form].kind}; read a text by "
            "numpy.loadtxt."
        )
    whole = recognise.contents(file, form, [], {})
    if form == "npz" and {channel.name for channel in whole.channels} >= SCIPY_SPARSE:
        return _of_one(file, "an NPZ file of a sparse matrix of SciPy", partial(_scipy_values, whole=whole))
    return whole


def _of_one(file: Path, kind: str, read: Any) -> Contents:
    def values() -> Any:
        with recognise.one_error(kind, file):
            return read(file)

    return Contents(kind, (StoredChannel(file.stem, 0, values),))


def _hdf5_contents(file: Path) -> Contents:
    import h5py

    _hdf5.check_heaps(file)
    with h5py.File(file, "r") as archive:
        places = [(group, name, item is None) for group, name, item in _hdf5.walk(archive)]

    def values(group: str, name: str) -> Any:
        with recognise.one_error("an HDF5 file", file), h5py.File(file, "r") as archive:
            return _hdf5.values(_hdf5.at(archive, group, name), LARGEST_ARRAY, "read the part that you need with h5py")

    link = "a link or data of another file"
    return Contents(
        "HDF5 file",
        tuple(
            StoredChannel(name, 0, partial(values, group, name), group, refusal=link if other else "")
            for group, name, other in places
        ),
    )


def _array_values(file: Path) -> np.ndarray:
    """Return the array of an NPY file."""
    with file.open("rb") as content:
        return npz.array_of(file.stem, content, file.stat().st_size)


def _market_values(file: Path) -> np.ndarray:
    """Return the matrix of a MatrixMarket file."""
    rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(str(file))
    if field not in ("real", "integer", "double", "unsigned-integer"):
        raise ValueError(f"its values are {field}, and must be real numbers")
    if 8 * rows * columns > LARGEST_ARRAY:
        raise ValueError(f"it has {rows} x {columns} values, more than {LARGEST_ARRAY / 1e9:.3g} GB")
    if (entries if layout == "coordinate" else entries // 2) > file.stat().st_size:
        raise ValueError(f"it says that it has {entries} values, more than it has bytes")
    matrix: Any = scipy.io.mmread(str(file))
    if layout != "coordinate":
        return np.asarray(matrix)
    places = matrix.row.astype(np.int64) * columns + matrix.col
    if len(np.unique(places)) < len(places):
        twice = " or, of a symmetric matrix, on both sides of the diagonal" * (symmetry != "general")
        raise ValueError(f"it has two values in one place{twice}")
    return np.asarray(matrix.toarray())


def _scipy_values(file: Path, whole: Contents) -> np.ndarray:
    """Return a matrix of scipy.sparse.save_npz; its arrays have been read, so that their sizes are checked."""
    arrays = {channel.name: channel.values() for channel in whole.channels}
    shape = [int(n) for n in np.ravel(arrays["shape"])]
    if len(shape) != 2 or min(shape) < 0 or 8 * shape[0] * shape[1] > LARGEST_ARRAY:
        raise ValueError(f"it has the shape {shape}")
    # SciPy does not compare all of them with the shape.
    for name in SPARSE_PLACES.intersection(arrays):
        places = arrays[name]
        if places.dtype.kind not in "iu" or np.any((places > max(shape)) | (places < -max(shape))):
            raise ValueError(f"its {name!r} do not fit its shape {shape}")
    pointers = np.ravel(arrays.get("indptr", 0))
    if pointers.dtype.kind not in "iu" or np.any(pointers[1:] < pointers[:-1]):
        raise ValueError("its 'indptr' decrease")
    matrix: Any = scipy.sparse.load_npz(file)
    if matrix.format in ("csr", "csc", "bsr"):
        matrix.check_format(full_check=True)
    return np.asarray(matrix.toarray())


def _real_matrix(argument: str, chosen: StoredChannel) -> np.ndarray:
    values = np.asarray(chosen.values())
    if values.dtype.kind not in "fiub" or values.ndim != 2 or not values.size:
        raise ValueError(
            f"{argument}: must be a matrix of real numbers, got {chosen.label!r} of shape {values.shape} and type "
            f"{values.dtype}."
        )
    return values.astype(float)


def _warn_of_triangle(file: Path, name: str, matrix: np.ndarray) -> None:
    below, above = np.tril(matrix, -1).any(), np.triu(matrix, 1).any()
    if matrix.shape[0] == matrix.shape[1] and below != above:
        warnings.warn(
            f"{file.name}: all values of {name!r} {'above' if below else 'below'} the diagonal are zero; if it is one "
            "triangle of a symmetric matrix, take K + K.T - np.diag(np.diag(K)).",
            UserWarning,
            stacklevel=3,
        )


def _factor(unit: str | None) -> float:
    """Return the value of a unit in SI."""
    if unit is None:
        return 1.0
    _checks.text("unit", unit)
    try:
        return float(units.convert("matrix", np.ones(1), (unit, units.in_si(unit)))[0])
    except ValueError as error:
        reason = re.sub(r"^units\['matrix'\]: must be ", "", str(error)).rstrip(".")
        raise ValueError(f"unit: must be a unit such as 'N/mm', got {unit!r} ({reason}).") from None
