"""MAT files of MATLAB, version 5 or 7.3."""

import math
import struct
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _hdf5
from bayesperiodic.data.formats.contents import LARGEST_ARRAY, OTHERWISE, Contents, Key, StoredChannel

# Of MAT files, version 5: types of elements and of numbers, classes of arrays, flag of complex arrays, and the bytes in
# which the name of a variable ends.
INT32, MAT_MATRIX, COMPRESSED, COMPLEX, HEADER_BYTES = 5, 14, 15, 0x800, 4096
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", INT32: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
NUMERIC = {
    6: "double", 7: "single", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16", 12: "int32", 13: "uint32", 14: "int64",
    15: "uint64",
}  # fmt: skip


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the variables of a MAT file; each is read when it is asked for."""
    import h5py

    channels = _hdf5_channels(file) if h5py.is_hdf5(file) else _mat5_channels(file)
    return Contents("MAT file", tuple(channels), word="column")


def _hdf5_channels(file: Path) -> Iterator[StoredChannel]:
    import h5py

    with h5py.File(file, "r") as archive:
        for name in archive:
            if isinstance(name, str):  # bytes are no text
                try:
                    size = int(_hdf5.dataset(archive, name).size or 0)
                except ValueError:  # no array: refused when it is read
                    size = 0
                yield StoredChannel(name, size, partial(_hdf5_values, file, name))


def _hdf5_values(file: Path, name: str) -> Any:
    """Return a variable of a MAT file, version 7.3."""
    import h5py

    with h5py.File(file, "r") as archive:
        item = _hdf5.dataset(archive, name)
        kind = np.bytes_(item.attrs.get("MATLAB_class", b"double")).decode()
        if kind not in (*NUMERIC.values(), "logical") or item.attrs.get("MATLAB_empty"):
            raise ValueError(f"its variable {name!r} is empty or no array of numbers, but {kind}")
        return _hdf5.values(item, LARGEST_ARRAY, OTHERWISE)


def _mat5_channels(file: Path) -> Iterator[StoredChannel]:
    """Yield the variables of a MAT file, version 5, after MathWorks' "MAT-File Format".

    scipy.io.loadmat ends the process with a segmentation fault for some damaged files.
    """
    content = file.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("it has no header of version 5; an older version is converted by save('-v7') in MATLAB")
    seen: dict[str, StoredChannel] = {}
    for kind, data in _elements(memoryview(content)[128:], order):
        head = data
        if compressed := kind == COMPRESSED:
            head = memoryview(zlib.decompressobj().decompress(data, HEADER_BYTES))[8:]
        elif kind != MAT_MATRIX:
            raise ValueError(f"it contains an element of type {kind}")
        name, _, shape, _ = _variable(head, order)
        read = partial(_mat5_values, name, data, compressed, order)
        if name in seen:
            read = partial(_twice, name)
        seen[name] = StoredChannel(name, math.prod(shape), read)
    yield from seen.values()


def _twice(name: str) -> Any:
    raise ValueError(f"it has two variables {name!r}")


def _mat5_values(name: str, data: memoryview, compressed: bool, order: str) -> np.ndarray:
    """Return a variable of a MAT file, version 5."""
    if compressed:
        stream = zlib.decompressobj()
        whole = stream.decompress(data, HEADER_BYTES)
        data = memoryview(whole + stream.decompress(stream.unconsumed_tail, LARGEST_ARRAY))[8:]
        if not stream.eof:
            raise ValueError(
                f"its variable {name!r} is cut off or has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}"
            )
    return _array(*_variable(data, order), order)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield types and contents of the elements of a MAT file, version 5."""
    place = 0
    while place < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        start, step = place + 8, size if kind == COMPRESSED else size + -size % 8
        if kind >> 16:  # at most four bytes, in the place of the size
            kind, size, start, step = kind & 0xFFFF, kind >> 16, place + 4, 0
        if start + size > len(content):
            raise ValueError("it is cut off")
        yield kind, content[start : start + size]
        place += 8 + step


def _variable(data: memoryview, order: str) -> tuple[str, int, list[int], Iterator[tuple[int, memoryview]]]:
    """Return name, flags and shape of a variable, and its remaining elements."""
    parts = _elements(data, order)
    (flags, _), (kind, second) = struct.unpack(f"{order}II", next(parts)[1]), next(parts)
    # Objects of classes have no shape.
    shape, name = (np.frombuffer(second, f"{order}i4").tolist(), next(parts)[1]) if kind == INT32 else ([], second)
    return bytes(name).decode(), flags, shape, parts


def _array(name: str, flags: int, shape: list[int], parts: Iterator[tuple[int, memoryview]], order: str) -> np.ndarray:
    if flags & 0xFF not in NUMERIC or flags & COMPLEX:
        other = "complex" if flags & COMPLEX else f"of MATLAB class {flags & 0xFF}"
        raise ValueError(f"its variable {name!r} is no array of real numbers, but {other}")
    kind, values = next(parts)
    array = np.frombuffer(values, f"{order}{STORED[kind]}")
    if next(parts, None) is not None or min(shape) < 0 or array.size != math.prod(shape):
        raise ValueError(f"its variable {name!r} has another size than its header says")
    return array.reshape(shape)
