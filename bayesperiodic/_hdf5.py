"""Reading of arrays that are in an HDF5 file itself, with the size in the file checked before memory is allocated.

HDF5 follows links and external or virtual storage into other files, reads parts that were never written as zeros, and
unpacks some kilobytes to gigabytes. Here such arrays are refused.
"""

import io
import itertools
import math
import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

# Filters of chunks: deflate, shuffle, Fletcher's checksum. Deflate packs at most so many bytes into one.
FILTERS, DEFLATION = {1, 2, 3}, 1032
# First bytes of a heap of texts of different lengths.
HEAP = b"GCOL\x01"
# How netCDF marks dimensions without values.
DIMENSION_ONLY = b"This is a netCDF dimension but not a netCDF variable"


def dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return an array of a group; raise a ValueError unless it is in the file of the group."""
    item = _member(group, name)
    if not isinstance(item, h5py.Dataset):
        raise ValueError(f"its variable {name!r} is not an array in this file")
    return item


class Arrays:
    """Arrays of a group of a file by name, each read when it is asked for, and together not larger than the file."""

    def __init__(self, file: h5py.File, group: str, size: int):
        self._file, self._group, self._left = file, group, float(size)
        self._read: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._read:
            item = dataset(_member(self._file, self._group), name)
            self._left -= _check(item, self._left, "bytes than the file")
            self._read[name] = item[()]
        return self._read[name]


def _member(group: h5py.Group, name: str) -> h5py.Dataset | h5py.Group:
    link = group.get(name, getlink=True) if name and "/" not in name and name not in (".", "..") else None
    if not isinstance(link, h5py.HardLink):
        raise ValueError(f"its variable {name!r} is missing or not in this file, but a link")
    item = group[name]
    if isinstance(item, h5py.Group):
        return item
    if not isinstance(item, h5py.Dataset) or item.is_virtual or item.external:
        raise ValueError(f"its variable {name!r} is not an array in this file, but refers to other data")
    return item


def check_heaps(path: Path) -> None:
    """Raise a ValueError for a damaged heap of texts, with some of which HDF5 2.0 does not come to an end.

    A heap is a list of objects after a head of 16 bytes; an object is its number, counts and size, and its bytes.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        for start in [match.start() for match in re.finditer(HEAP, content)]:
            size = int.from_bytes(content[start + 8 : start + 16], "little")
            place, end = start + 16, start + size
            while place + 16 <= end:
                number, length = struct.unpack("<H6xQ", content[place : place + 16].ljust(16))
                place += 16 + length + -length % 8 if number else length
                if not (16 <= length or number) or place > end or end > len(content):
                    raise ValueError("a heap of its texts is damaged")


def walk(file: h5py.File) -> Iterator[tuple[str, str, h5py.Dataset | None]]:
    """Yield group, name and array of all members of a file but groups, None for those that are not in the file.

    Each group is visited once, also if several names lead to it.
    """
    groups, seen = [("", file["/"])], {h5py.h5o.get_info(file["/"].id).addr}
    while groups:
        path, group = groups.pop(0)
        for name in group:
            if not isinstance(name, str):  # bytes are no text
                continue
            try:
                item = _member(group, name)
            except ValueError:
                yield path, name, None
                continue
            if isinstance(item, h5py.Dataset):
                yield path, name, item
            elif (address := h5py.h5o.get_info(item.id).addr) not in seen:
                seen.add(address)
                groups.append((f"{path}/{name}" if path else name, item))


def at(file: h5py.File, path: str, name: str) -> h5py.Dataset:
    """Return an array of a file by the path of its group."""
    group = file["/"]
    for part in path.split("/") if path else ():
        group = _member(group, part)
    return dataset(group, name)


def values(item: h5py.Dataset, largest: float, remedy: str) -> Any:
    """Return the values of an array from `dataset`; raise a ValueError if some are missing, or they are too large."""
    _check(item, largest, f"than {largest / 1e9:.3g} GB; {remedy}")
    return item[()]


def check_all(content: bytes) -> None:
    """Raise a ValueError unless all arrays of a file are in it, completely, and together are not larger than it."""
    with h5py.File(io.BytesIO(content), "r") as file:
        groups, seen, left = [file], {h5py.h5o.get_info(file.id).addr}, float(len(content))
        while groups:
            group = groups.pop()
            for name in group:
                item = _member(group, name)
                if (address := h5py.h5o.get_info(item.id).addr) in seen:
                    continue
                seen.add(address)
                if isinstance(item, h5py.Group):
                    groups.append(item)
                elif not bytes(np.bytes_(item.attrs.get("NAME", b""))).startswith(DIMENSION_ONLY):
                    left -= _check(item, left, "bytes than the file")


def _check(item: h5py.Dataset, largest: float, limit: str) -> float:
    """Return the bytes of the values of an array; raise a ValueError if they are too many or some are missing."""
    name, size, plan = item.name.rpartition("/")[2], float(_stored_bytes(item)), item.id.get_create_plist()
    if size > largest:
        raise ValueError(f"its array {name!r} has more {limit}")
    packed = {plan.get_filter(k)[0] for k in range(plan.get_nfilters())}
    if not packed <= FILTERS:
        raise ValueError(
            f"parts of its variable {name!r} are missing or packed by a filter that is not read here ({packed}); "
            "h5repack -f GZIP=4 converts the file"
        )
    if size > DEFLATION * item.id.get_storage_size() or not _is_stored(item):
        raise ValueError(f"parts of its variable {name!r} are missing")
    if item.dtype.hasobject:
        size = 0.0
        for place in np.ndindex(item.shape):  # one by one, because all may refer to one long text
            size += len(item[place]) if h5py.check_string_dtype(item.dtype) else math.inf
            if size > largest:
                raise ValueError(f"its array {name!r} has more {limit}")
    return size


def _stored_bytes(item: h5py.Dataset) -> int:
    """Return the bytes of an array before it is read; of texts, those of their references."""
    return int(item.id.get_type().get_size()) * (item.size or 0)


def _is_stored(item: h5py.Dataset) -> bool:
    """Return whether all values of an HDF5 array are in the file; HDF5 reads missing parts as zeros."""
    if item.chunks is None:
        return bool(item.id.get_storage_size() >= _stored_bytes(item))
    places = [range(0, length, step) for length, step in zip(item.shape, item.chunks, strict=True)]
    if item.id.get_num_chunks() != math.prod(map(len, places)):
        return False
    stored: set[Any] = set()
    item.id.chunk_iter(lambda chunk: stored.add((chunk.chunk_offset, chunk.filter_mask)))
    return stored == {(place, 0) for place in itertools.product(*places)}
