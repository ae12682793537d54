"""MDF files, versions 2 to 4, of measurements in vehicles."""

import contextlib
import functools
import gc
import html
import re
import sys
import weakref
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from bayesperiodic.data.formats import mdf_blocks
from bayesperiodic.data.formats.contents import (
    BY_RATE,
    Clock,
    Contents,
    Key,
    StoredChannel,
    package,
    silenced,
    unique_names,
)

# Kinds of channels that are masters, and of what, in version 4; in version 3, the kind 1 is a time.
MASTERS, TIME_AXIS, VIRTUAL = {4: (2, 3), 3: (1,)}, 1, 3
AXES = {0: "an unknown quantity", 2: "angles", 3: "distances", 4: "indices"}
# Place of the data of groups whose records stood in turn in the file, and which asammdf has sorted.
SORTED = 1
# Channels of version 4 with samples of any length, of which asammdf reads beyond the end of a damaged file.
VARIABLE = (1, 5, 7)
# Flags of channels of version 4: all samples are invalid, or those with a bit.
ALL_INVALID, INVALID_BIT = 1, 2
# Conversions of numbers by few coefficients, and those that are refused: by a formula, which asammdf evaluates as code,
# and in version 3 exponential ones, which programs compute in different ways.
COEFFICIENTS = {4: (1, 2), 3: (0, 6, 9)}
# Types of numbers, of floats among them, bits of those that are read as they are, and conversions that change nothing.
NUMBERS, FLOATS = {4: (0, 1, 2, 3, 4, 5), 3: (0, 1, 2, 3, *range(9, 17))}, {4: (4, 5), 3: (2, 3, 11, 12, 15, 16)}
DOUBLE_BITS, NO_CONVERSION = 64, {4: (0,), 3: (65535,)}
REFUSED = {4: {3: "by a formula"}, 3: {10: "by a formula", 7: "that is exponential", 8: "that is logarithmic"}}
# Encodings of texts by their type in version 4; those of conversions are in UTF-8.
TEXT_ENCODINGS = {6: "latin-1", 8: "utf-16-le", 9: "utf-16-be"}
IN_XML = re.compile(r"<TX[^>]*>(.*?)</TX>", re.DOTALL)


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the channels of an MDF file but its masters, which are their times; each is read when it is asked for."""
    asammdf = package("asammdf", "asammdf", "MDF files")
    with contextlib.ExitStack() as stack:
        content = stack.enter_context(file.open("rb"))
        mdf_blocks.check(mdf_blocks.Bytes(content))
        mdf = _opened(asammdf, content)
        weakref.finalize(mdf, stack.pop_all().close)
    version = 4 if mdf.version >= "4" else 3
    labels = [*unique_names(_group_name(group, k, len(mdf.groups)) for k, group in enumerate(mdf.groups, 1))]
    channels = [channel for k, label in enumerate(labels) for channel in _channels(mdf, version, k, label)]
    return Contents("MDF file", tuple(channels), (f"version {mdf.version}",))


def _opened(asammdf: Any, content: BinaryIO) -> Any:
    """Return the file as asammdf reads it.

    It gets no name, as it deletes a file whose name ends in .bz2 or .gzip. Bus messages remain as they are: databases
    that decode them may be attached.
    """
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        try:
            with silenced("asammdf"):
                return asammdf.MDF(
                    content, process_bus_logging=False, use_display_names=False, add_array_components=False
                )
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
        gc.collect()  # its object of a damaged file prints an error when it is deleted
    finally:
        sys.unraisablehook = hook
    raise ValueError(reason)


def _group_name(group: Any, number: int, count: int) -> str:
    """Return the name of a group: that of the acquisition or the comment, or a number if there are several."""
    stated = getattr(group.channel_group, "acq_name", "") or getattr(group.channel_group, "comment", "")
    line = next(iter(_text(stated).splitlines()), "")
    return line if line and not line.startswith("<") else f"group {number}" if count > 1 else ""


def _origin(mdf: Any) -> np.datetime64 | None:
    """Return the time of the file, from which those of all channels count."""
    start = getattr(mdf.header, "abs_time", 0)  # nanoseconds, from version 3.20
    return np.datetime64(start, "ns") if 0 < start < 2**63 else None


def _channels(mdf: Any, version: int, k: int, label: str) -> Iterator[StoredChannel]:
    """Yield the channels of a group, of its masters those that are no times."""
    group = mdf.groups[k]
    inner = group.channel_group
    times: list[np.ndarray] = []
    clock, samples = _clock(mdf, version, k, times), int(inner.cycles_nr)
    plain = clock is not None and not clock.refusal and _is_plain(mdf, version, k)
    if version == 4 and group.data_location == SORTED and not inner.flags & mdf_blocks.VLSD:
        length = sum(block.original_size for block in group.get_data_blocks())
        if length != samples * (inner.samples_byte_nr + inner.invalidation_bytes_nr):
            raise ValueError(f"{mdf_blocks.CUT_OFF}: group {label!r} has not the {samples} samples of its header")
    listed = [
        (i, channel)
        for i, channel in enumerate(group.channels)
        if channel.channel_type not in MASTERS[version] or (version == 4 and channel.sync_type != TIME_AXIS)
    ]
    for name, (i, channel) in zip(unique_names(channel.name for _, channel in listed), listed, strict=True):
        yield StoredChannel(
            name,
            samples,
            partial(_values, mdf, version, k, i, times if plain else None),
            label,
            _unit(channel),
            clock,
            refusal=_refusal(version, group, channel),
        )


def _unit(channel: Any) -> str:
    """Return the unit of a channel, before that of its conversion."""
    conversion = channel.conversion
    return _text(getattr(channel, "unit", "") or (conversion.unit if conversion else ""))


def _text(stated: Any) -> str:
    """Return a text that may be within XML."""
    text = str(stated or "").strip(" \0\r\n\t")
    inner = IN_XML.search(text) if text.startswith("<") else None
    return html.unescape(inner.group(1)).strip() if inner else text


def _refusal(version: int, group: Any, channel: Any) -> str:
    """Return why the values of a channel are not those that asammdf returns."""
    for conversion in _conversions(channel.conversion):
        if how := REFUSED[version].get(conversion.conversion_type):
            return f"a conversion {how}; read it by asammdf with raw=True, and convert it for from_arrays"
    if version == 4 and channel.channel_type in VARIABLE:
        return "texts or bytes of any length, which are not read"
    virtual = channel.channel_type in (VIRTUAL, 6) if version == 4 else channel.bit_count == 0
    if version == 4:
        bits = 8 * channel.byte_offset + channel.bit_offset + channel.bit_count
    else:
        bits = channel.start_offset + 8 * getattr(channel, "additional_byte_offset", 0) + channel.bit_count
    if not virtual and bits > 8 * group.channel_group.samples_byte_nr:
        return "samples that lie beyond the end of the records"
    if version == 4:
        if channel.flags & ALL_INVALID and not channel.flags & INVALID_BIT:
            return "samples that are all marked as invalid"
    return ""


def _conversions(conversion: Any) -> Iterator[Any]:
    """Yield a conversion and those that it refers to."""
    if hasattr(conversion, "conversion_type"):
        yield conversion
        blocks = conversion.referenced_blocks if hasattr(conversion, "referenced_blocks") else None
        for block in (blocks or {}).values():
            yield from _conversions(block)


def _is_plain(mdf: Any, version: int, k: int) -> bool:
    """Return whether a group has times of its own that are stored as they are, which asammdf returns with a channel."""
    group = mdf.groups[k]
    remote = version == 4 and group.channel_group.flags & mdf_blocks.REMOTE_MASTER
    masters = [one for one in group.channels if one.channel_type in MASTERS[version]]
    if remote or len(masters) != 1 or (version == 4 and masters[0].channel_type == VIRTUAL):
        return False
    (master,) = masters
    converted = master.conversion and master.conversion.conversion_type not in NO_CONVERSION[version]
    lost = version == 4 and master.flags & (ALL_INVALID | INVALID_BIT)
    return bool(master.bit_count == DOUBLE_BITS and master.data_type in FLOATS[version] and not converted and not lost)


def _values(mdf: Any, version: int, k: int, i: int, times: list[np.ndarray] | None = None) -> Any:
    """Return the physical values of a channel, NaN where they are marked as invalid, texts as such.

    The times of the group are kept in `times`, as reading them alone takes as long as a channel.
    """
    channel = mdf.groups[k].channels[i]
    with silenced("asammdf"):
        options: dict[str, Any] = {"group": k, "index": i, "raw": True, "ignore_invalidation_bits": True}
        if times is None or times or channel.data_type not in NUMBERS[version]:
            values, invalid = mdf.get(**options, samples_only=True)
        else:
            with contextlib.redirect_stdout(None):  # to which asammdf writes of channels of damaged files
                signal = mdf.get(**options)
            values, invalid = signal.samples, signal.invalidation_bits
            times.append(signal.timestamps)
        if conversion := channel.conversion:
            # asammdf computes squares of integers in 32 bits, and products of short floats in those.
            if conversion.conversion_type in COEFFICIENTS[version] and values.dtype.kind in "fiu":
                values = values.astype(float)
            values = conversion.convert(values)
    if len(values) != mdf.groups[k].channel_group.cycles_nr:
        raise ValueError(f"its channel {channel.name!r} has {len(values)} samples and not those that its group says")
    if values.dtype.kind == "S":
        encoding = TEXT_ENCODINGS.get(channel.data_type, "utf-8") if version == 4 else "latin-1"
        size = values.itemsize
        text = np.frompyfunc(lambda one: one.ljust(size, b"\0").decode(encoding, "replace").partition("\0")[0], 1, 1)
        values = text(values).astype(str)
    lost = None if invalid is None else np.asarray(invalid, dtype=bool)
    if lost is not None and lost.any() and values.ndim == 1 and values.dtype.kind in "fiub":
        values = np.where(lost, np.nan, values)
    return np.asarray(values)


def _clock(mdf: Any, version: int, k: int, known: list[np.ndarray]) -> Clock | None:
    """Return the times of a group by its master; one without is None."""
    group = mdf.groups[k].channel_group
    if version == 4 and group.flags & mdf_blocks.REMOTE_MASTER and mdf.version >= "4.20":
        return _clock(mdf, version, group.cg_master_index, []) if group.cg_master_index != k else None
    masters = [(i, one) for i, one in enumerate(mdf.groups[k].channels) if one.channel_type in MASTERS[version]]
    if not masters:
        return None
    times = [(i, one) for i, one in masters if version == 3 or one.sync_type == TIME_AXIS]
    if not times:
        axis = AXES.get(masters[0][1].sync_type, "an unknown quantity")
        return Clock(refusal=f"which is recorded over {axis} ({masters[0][1].name!r}) and not over time; {BY_RATE}")
    (i, master), refusal = times[0], _refusal(version, mdf.groups[k], times[0][1])
    conversion = master.conversion
    if len(times) > 1:
        refusal = f"{len(times)} channels of time"
    elif version == 3 and master.bit_count == 0 and not master.sampling_rate:
        refusal = "no sampling rate"
    elif conversion and conversion.conversion_type not in (*COEFFICIENTS[version][:1], 0, 65535):
        refusal = "a conversion that is not linear"
    elif (unit := _unit(master)) not in ("", "s", "sec", "Sec", "seconds"):
        refusal = f"the unit {unit!r}"
    if refusal:
        return Clock(refusal=f"whose times {master.name!r} have {refusal}; {BY_RATE}")
    return Clock(stored=functools.cache(partial(_times, mdf, version, k, i, known)), origin=_origin(mdf))


def _times(mdf: Any, version: int, k: int, i: int, known: list[np.ndarray]) -> np.ndarray:
    """Return the times of a group [s] from the start of the file, those that are known as they are."""
    if known:
        return np.asarray(known[0], dtype=float)
    master = mdf.groups[k].channels[i]
    if (version == 4 and master.channel_type == VIRTUAL) or (version == 3 and master.bit_count == 0):
        with silenced("asammdf"):
            return np.asarray(mdf.get_master(k), dtype=float)
    return np.asarray(_values(mdf, version, k, i), dtype=float)
