"""NPZ files: named arrays of NumPy."""

import io
import math
import zipfile
from functools import partial
from pathlib import Path

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
            version = np.lib.format.read_magic(content)
            header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            return math.prod(header[version](content)[0])
    except Exception:  # whatever zipfile, zlib and NumPy raise for damaged members
        return 0


def _values(file: Path, name: str) -> np.ndarray:
    """Return an array; the whole member is read, because only it has a checksum."""
    with zipfile.ZipFile(file) as archive:
        members = [member for member in archive.infolist() if member.filename.removesuffix(".npy") == name]
        if len(members) > 1:
            raise ValueError(f"it has two arrays {name!r}")
        if members[0].file_size > LARGEST_ARRAY:
            raise ValueError(f"its array {name!r} has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}")
        content = io.BytesIO(archive.read(members[0]))
    array = np.lib.format.read_array(content, allow_pickle=False)
    if content.read(1):
        raise ValueError(f"its array {name!r} has another size than its header says")
    return array
