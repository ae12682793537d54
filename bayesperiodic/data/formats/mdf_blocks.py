"""Check of the blocks of an MDF file before asammdf reads them.

asammdf follows the links of a damaged file without end if they form a circle, and reads what there is of one that is
cut off. Layouts after ASAM MDF 4.2 and Vector's description of MDF 3.3.
"""

import io
import struct
from collections.abc import Iterator
from typing import Any, BinaryIO

from bayesperiodic.data.formats.contents import LARGEST_ARRAY

# Places of the first block, and of the flags of a file that is not finished.
FIRST_BLOCK, UNFINISHED_FLAGS = 64, 60
# By identifier of a block of version 4: the links that form a tree, in which each block has one place.
TREE = {
    b"##HD": (0, 1, 2, 3, 4), b"##DG": (0, 1), b"##CG": (0, 1, 4), b"##CN": (0, 1), b"##CA": (0,), b"##SR": (0,),
    b"##FH": (0,), b"##AT": (0,), b"##EV": (0,), b"##CH": (0, 1),
}  # fmt: skip
# The same of version 3: byte offsets of the links.
TREE_3 = {b"HD": (4,), b"DG": (4, 8), b"CG": (4, 8), b"CN": (4,)}
DATA_BLOCKS = (b"##DT", b"##SD", b"##RD", b"##DV", b"##DI")
# Flags of channel groups whose records have any length, and whose master is in another group.
VLSD, REMOTE_MASTER = 1, 8
# Largest ratio of the lengths of data before and after their compression (deflate).
DEFLATE_RATIO = 1100
# Conversions that refer to conversions, at most.
CONVERSIONS = 10
CUT_OFF, CIRCLE = "it is cut off or damaged", "it is damaged: its blocks form a circle"


class Bytes:
    """The bytes of an opened file, each read where it is needed."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._size = file, file.seek(0, io.SEEK_END)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, key: slice) -> bytes:
        start, stop = min(key.start or 0, self._size), min(key.stop, self._size)
        self._file.seek(start)
        return self._file.read(max(stop - start, 0))


def _unpack(form: str, content: Bytes, start: int) -> tuple[Any, ...]:
    """Return values at a place of a file; raise a struct.error if they are beyond its end."""
    return struct.unpack(form, content[start : start + struct.calcsize(form)])


def check(content: Bytes) -> None:
    """Raise a ValueError unless all blocks lie in the file, none leads back to itself, and all samples are there."""
    if content[:8].strip(b" \0") == b"UnFinMF" or _unpack("<HH", content, UNFINISHED_FLAGS) != (0, 0):
        raise ValueError(
            "it is not finalized: the program that wrote it was stopped, and its numbers of samples are unknown; "
            "asammdf.MDF(path).save(other) writes a finalized one"
        )
    try:
        _check_4(content) if content[8:9] == b"4" else _check_3(content)
    except struct.error:  # a link beyond the end
        raise ValueError(CUT_OFF) from None


def _check_4(content: Bytes) -> None:
    for address, kind, links in _walk(content):
        if kind == b"##DG":
            _check_data_group(content, address, links)
        elif kind == b"##CN":
            if links[5] and content[links[5] : links[5] + 4] not in (b"##CG", b"##AT"):
                _length(content, links[5])
            _check_conversion(content, links[4], 0)
    if content[FIRST_BLOCK : FIRST_BLOCK + 4] != b"##HD":
        raise ValueError(CUT_OFF)


def _block(content: Bytes, address: int) -> tuple[bytes, int, tuple[int, ...]]:
    """Return identifier, place of the data, and links of a block of version 4."""
    if not 0 < address <= len(content) - 24:
        raise ValueError(CUT_OFF)
    kind, _, length, count = _unpack("<4sIQQ", content, address)
    if not kind.startswith(b"##") or length < 24 + 8 * count or address + length > len(content):
        raise ValueError(CUT_OFF)
    return kind, address + 24 + 8 * count, _unpack(f"<{count}Q", content, address + 24)


def _walk(content: Bytes) -> Iterator[tuple[int, bytes, tuple[int, ...]]]:
    """Yield the blocks of version 4 that form a tree."""
    seen, waiting = {0}, [FIRST_BLOCK]
    while waiting:
        address = waiting.pop()
        if address in seen:
            raise ValueError(CIRCLE)
        seen.add(address)
        kind, _, links = _block(content, address)
        if kind in TREE and len(links) <= max(TREE[kind]):
            raise ValueError(CUT_OFF)
        yield address, kind, links
        waiting += [links[place] for place in TREE.get(kind, ()) if links[place]]


def _check_data_group(content: Bytes, address: int, links: tuple[int, ...]) -> None:
    """Raise a ValueError if a data group has fewer samples than its channel groups say, or more."""
    _, place, _ = _block(content, address)
    identifier, needed, least, exact, group, seen = _unpack("B", content, place)[0], 0, 2**62, True, links[1], set()
    while group:
        if group in seen:
            raise ValueError(CIRCLE)
        seen.add(group)
        kind, place, group_links = _block(content, group)
        if kind != b"##CG" or len(group_links) < 6:
            raise ValueError(CUT_OFF)
        _, cycles, flags, _, _, size, invalid = _unpack("<QQHHIII", content, place)
        exact &= not flags & VLSD
        width = identifier + size + (0 if flags & REMOTE_MASTER else invalid)
        needed += 0 if flags & VLSD else cycles * width
        least = min(least, max(width, 1))
        if cycles * width > LARGEST_ARRAY and cycles * width > DEFLATE_RATIO * len(content):
            raise ValueError(CUT_OFF)
        group = group_links[0]
    length = _length(content, links[2]) if links[2] else 0
    if length < needed or (exact and length >= needed + least):
        raise ValueError(f"{CUT_OFF}: a data group has {length} bytes and not {needed}")


def _length(content: Bytes, address: int) -> int:
    """Return the number of bytes in a data block or a list of them, unpacked, without those of invalidation bits."""
    total, seen, waiting = 0, set(), [address]
    while waiting:
        at = waiting.pop()
        if at in seen:
            raise ValueError(CIRCLE)
        seen.add(at)
        kind, place, links = _block(content, at)
        size = _unpack("<Q", content, at + 8)[0] - 24
        if kind == b"##DZ":
            original, _, _, _, size, packed = _unpack("<2sBBIQQ", content, place)
            if place + 24 + packed > len(content) or size > min(LARGEST_ARRAY, DEFLATE_RATIO * (packed + 100)):
                raise ValueError(CUT_OFF)
            kind = b"##" + original
        if kind in (b"##DL", b"##HL", b"##LD"):
            waiting += [link for link in links if link]
        elif kind in DATA_BLOCKS:
            total += size if kind != b"##DI" else 0
        else:
            raise ValueError(CUT_OFF)
    return total


def _check_conversion(content: Bytes, address: int, depth: int) -> None:
    """Raise a ValueError if the conversions of a channel refer to one another in a circle."""
    if not address:
        return
    kind, _, links = _block(content, address)
    if kind == b"##TX":
        return
    if kind != b"##CC" or depth > CONVERSIONS:
        raise ValueError(CIRCLE)
    for link in links[4:]:
        _check_conversion(content, link, depth + 1)


def _check_3(content: Bytes) -> None:
    """Raise a ValueError unless the blocks of version 2 or 3 form a tree, and all samples are there."""
    if content[24:26] != b"\0\0":
        raise ValueError("its numbers begin with the highest byte (Motorola), which asammdf does not read")
    seen, waiting = {0}, [(FIRST_BLOCK, b"HD")]
    while waiting:
        address, expected = waiting.pop()
        if address in seen:
            raise ValueError(CIRCLE)
        seen.add(address)
        kind, length = _unpack("<2sH", content, address)
        if kind != expected or length < max(TREE_3[kind]) + 4 or address + length > len(content):
            raise ValueError(CUT_OFF)
        links = [_unpack("<I", content, address + place)[0] for place in TREE_3[kind]]
        below = {b"HD": [b"DG"], b"DG": [b"DG", b"CG"], b"CG": [b"CG", b"CN"], b"CN": [b"CN"]}[kind]
        waiting += [(link, name) for link, name in zip(links, below, strict=True) if link]
        if kind == b"DG":
            _check_data_group_3(content, address, links[1])


def _check_data_group_3(content: Bytes, address: int, group: int) -> None:
    data, _, identifiers = _unpack("<IHH", content, address + 16)
    needed, seen = 0, set()
    while group:
        if group in seen:
            raise ValueError(CIRCLE)
        seen.add(group)
        size, cycles = _unpack("<HI", content, group + 20)
        needed += cycles * (size + identifiers)
        group = _unpack("<I", content, group + 4)[0]
    if data + needed > len(content):
        raise ValueError(f"{CUT_OFF}: a data group has {max(len(content) - data, 0)} bytes and not {needed}")
