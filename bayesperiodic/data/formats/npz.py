"""NPZ files: named arrays of NumPy."""

import io
import math
import warnings
import zipfile
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from bayesperiodic.data.formats.contents import LARGEST_ARRAY, OTHERWISE, Contents, Key, StoredChannel


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the arrays of an NPZ file; each is read when it is asked for."""
    channels: list[StoredChannel] = []
    with zipfile.ZipFile(file) as archive:
        members = [(member, member.filename.removesuffix(".npy")) for member in archive.infolist()]
        names = [name for _, name in members]
        for member, name in members:
            if names.index(name) < len(channels):
                continue  # a second one, which is refused when the array is read
            channels.append(StoredChannel(name, _size(archive, member), partial(_values, file, name)))
    return Contents("NPZ file", tuple(channels), word="column")


def _size(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> int:
    """Return the number of values that the header of an array states; 0 if it cannot be read."""
    try:
        with archive.open(member) as content:
            return _stated(content)[0]
    except Exception:  # whatever zipfile, zlib and NumPy raise for damaged members
        return 0


def _stated(content: IO[bytes]) -> tuple[int, int | None]:
    """Return number and bytes of the values that the header of an array states; the bytes of objects are not known."""
    version = np.lib.format.read_magic(content)
    header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in header:
        raise ValueError("it is a table with named columns")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers of Python 2
        shape, _, kind = header[version](content)
    return math.prod(shape), None if kind.hasobject else math.prod(shape) * kind.itemsize


def _values(file: Path, name: str) -> np.ndarray:
    """Return an array; the whole member is read, because only it has a checksum."""
    with zipfile.ZipFile(file) as archive:
        members = [member for member in archive.infolist() if member.filename.removesuffix(".npy") == name]
        if len(members) > 1:
            raise ValueError(f"it has two arrays {name!r}")
        if members[0].file_size > LARGEST_ARRAY:
            raise _too_large(name)
        stored = archive.read(members[0])
    return array_of(name, io.BytesIO(stored), len(stored))


def array_of(name: str, content: IO[bytes], size: int) -> np.ndarray:
    """Return the array of an NPY file of so many bytes, which are compared with its header before any are allocated."""
    stated = _stated(content)[1]
    if stated is not None and stated != size - content.tell():
        raise ValueError(f"its array {name!r} has another size than its header says")
    if size > LARGEST_ARRAY:
        raise _too_large(name)
    content.seek(0)
    return np.lib.format.read_array(content, allow_pickle=False)


def _too_large(name: str) -> ValueError:
    return ValueError(f"its array {name!r} has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}")
