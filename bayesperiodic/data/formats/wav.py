"""WAV files: samples as a fraction of the full scale."""

import struct
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bayesperiodic.data.formats.contents import Clock, Contents, Key, StoredChannel

PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
ORDERS = {b"RIFF": "<", b"RIFX": ">", b"RF64": "<"}
# Of a chunk whose size is in the chunk ds64, or that was written to a pipe.
UNKNOWN_SIZE = 2**32 - 1


@dataclass(frozen=True)
class _Form:
    """Format of the samples: `valid` of the `bits` of an integer are used, the upper ones."""

    channels: int
    rate: int
    bits: int
    valid: int


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the channels of a WAV file, integers divided by their full scale, floats as they are."""
    from scipy.io import wavfile

    form, size = _structure(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # of what `_structure` has checked
        rate, samples = wavfile.read(file)
    if samples.size * form.bits != 8 * size or rate != form.rate:
        raise ValueError(f"it has {samples.size} samples of {form.bits} bits in {size} bytes")
    table, clock = samples.reshape(-1, form.channels), Clock(step=1.0 / rate)
    if form.valid < form.bits and (table & (2 ** (8 * samples.dtype.itemsize - form.valid) - 1)).any():
        raise ValueError(f"its samples of {form.bits} bits have more than the {form.valid} that its header says")
    # SciPy returns 24 bits as the upper ones of 32, so that the full scale is that of its type.
    scale = 1.0 if samples.dtype.kind == "f" else 2.0 ** (8 * samples.dtype.itemsize - 1)
    middle = 128.0 if samples.dtype.kind == "u" else 0.0
    channels = tuple(
        StoredChannel(f"channel {k + 1}", len(table), partial(_scaled, table[:, k], middle, scale), clock=clock)
        for k in range(form.channels)
    )
    given = "as stored" if samples.dtype.kind == "f" else "as a fraction of the full scale"
    remark = f"values are {given}: give the full scale in the unit of the sensor as a factor, units={{'x': 10.0}}"
    return Contents("WAV file", channels, (remark,))


def _scaled(values: np.ndarray, middle: float, scale: float) -> np.ndarray:
    if scale == 1.0:  # floats
        return values
    result = np.subtract(values, middle, dtype=float)
    result /= scale
    return result


def _structure(file: Path) -> tuple[_Form, int]:
    """Return the format and the bytes of the samples; raise a ValueError unless both are certain and complete.

    SciPy reads a file whose chunk of samples is cut off, has another size, or occurs twice.
    """
    length = file.stat().st_size
    form, sizes, long = None, [], None
    with file.open("rb") as content:
        order = ORDERS.get(content.read(4))
        content.read(4)
        if order is None or content.read(4) != b"WAVE":
            raise ValueError("it does not begin as a WAV file")
        while len(head := content.read(8)) == 8:
            name, size = struct.unpack(f"{order}4sI", head)
            start = content.tell()
            if name == b"data" and size == UNKNOWN_SIZE:
                if long is None:
                    raise ValueError("the size of its samples is not stated, as in a file from a pipe; save it anew")
                size = long
            if start + size > length:
                raise ValueError("it is cut off")
            if name == b"ds64":
                long = struct.unpack("<QQ", content.read(16))[1]
            elif name == b"fmt ":
                form = _form(content, order, size) if form is None else _twice(name)
            elif name == b"data":
                sizes.append(size)
            content.seek(start + size + size % 2)
        if form is None or len(sizes) != 1:
            raise ValueError(f"it has {len(sizes)} chunks of samples and {'a' if form else 'no'} format")
    if sizes[0] % (form.channels * form.bits // 8):
        raise ValueError("its samples end within one")
    if head.strip(b"\0"):
        raise ValueError("it has bytes after its last chunk")
    return form, sizes[0]


def _twice(name: bytes) -> _Form:
    raise ValueError(f"it has two chunks {name.decode()!r}")


def _form(content: BinaryIO, order: str, size: int) -> _Form:
    """Return the format of the samples."""
    tag, channels, rate, _, block, bits = struct.unpack(f"{order}HHIIHH", content.read(16))
    valid = bits
    if tag == EXTENSIBLE and size >= 40:
        _, valid, _, tag = struct.unpack(f"{order}HHII", content.read(12))
        valid = valid or bits
    if tag not in (PCM, FLOAT):
        raise ValueError(f"its samples are of format {tag:#06x}, and not linear PCM or floats")
    if not channels or not rate or block % channels:
        raise ValueError(f"it has {channels} channels of {rate} Hz in blocks of {block} bytes")
    whole = 8 * (block // channels)
    allowed = (32, 64) if tag == FLOAT else (8, 16, 24, 32, 64)
    if whole not in allowed or not whole - 8 < bits <= whole or not 0 < valid <= bits:
        raise ValueError(f"its samples have {valid} of {bits} bits in {whole // 8} bytes, which has several meanings")
    if tag == PCM and whole == 8:
        return _Form(channels, rate, whole, whole)
    return _Form(channels, rate, whole, valid if tag == PCM else whole)
