"""TDMS files of LabVIEW, DAQmx and DIAdem."""

import functools
import mmap
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic.data.formats.contents import BY_RATE, Clock, Contents, Key, StoredChannel, package, silenced

# Flags of segments whose samples stand in rows: interleaved data and raw data of DAQmx.
INTERLEAVED, DAQMX = 1 << 5, 1 << 7
INCREMENT, WAVE_START, WAVE_OFFSET, WAVE_AXIS = "wf_increment", "wf_start_time", "wf_start_offset", "wf_xunit_string"
# Scales that npTDMS applies; for others it returns the raw values.
SCALES_READ = (
    "Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add", "Subtract", "AdvancedAPI",
)  # fmt: skip
SCALE_PROPERTY = re.compile(r"NI_Scal|NI_Number_Of_Scales|unit_string|NI_UnitDescription")
# Values of properties that a segment leaves out.
IMPLIED_PROPERTIES = {WAVE_OFFSET: 0.0}
SCALE_TYPE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
# Seconds from 1904, from which dates of TDMS files count, to 1970 and to the end of the dates in nanoseconds.
UNIX_EPOCH, LAST_SECOND = 24_107 * 86_400, 358 * 365 * 86_400

Change = tuple[int, str, Any, Any]  # samples before it, name, and both values of a property


class _Mapped(mmap.mmap):
    """A file in memory, of which no more is read than there is."""

    def readinto(self, buffer: Any) -> int:
        start = self.tell()
        count = min(len(buffer), len(self) - start)
        with memoryview(self) as content:
            memoryview(buffer)[:count] = content[start : start + count]
        self.seek(start + count)
        return count


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the channels of a TDMS file; each is read when it is asked for."""
    nptdms = package("nptdms", "npTDMS", "TDMS files")
    with file.open("rb") as content:
        # An index beside the file, which may be another file's, is not read by this way.
        mapped = _Mapped(content.fileno(), 0, access=mmap.ACCESS_READ)
    with silenced("nptdms"):
        changes, rows = _structure(mapped)
        opened = _opened(nptdms, mapped, keep_open=True, read_metadata_only=True)
    whole = functools.cache(partial(_opened, nptdms, mapped)) if rows else lambda: opened
    clocks: dict[Any, Clock | None] = {}
    channels = []
    for group in opened.groups():
        for channel in group.channels():
            if len(channel) > len(mapped):
                raise ValueError(f"its channel {channel.path} has more samples than there are bytes")
            properties = _properties(opened, group, channel)
            late = [change for change in changes.get(channel.path, []) if change[0] < len(channel)]
            clock = _clock(properties, late)
            shared = clocks.setdefault(clock and (clock.start, clock.step, clock.origin, clock.refusal), clock)
            channels.append(
                StoredChannel(
                    channel.name,
                    len(channel),
                    partial(_values, whole, group.name, channel.name),
                    group.name,
                    str(properties.get("unit_string") or properties.get("NI_UnitDescription") or ""),
                    shared,
                    refusal=_refusal(properties, late),
                    remarks=_remarks(properties, len(channel)),
                )
            )
    return Contents("TDMS file", tuple(channels))


def _opened(nptdms: Any, mapped: _Mapped, **options: Any) -> Any:
    mapped.seek(0)
    with silenced("nptdms"):
        return nptdms.TdmsFile(mapped, raw_timestamps=True, **options)


def _structure(mapped: _Mapped) -> tuple[dict[str, list[Change]], bool]:
    """Return the changes of properties by path, and whether samples stand in rows, which are best read at once.

    npTDMS keeps the last value of a property, and reads what there is of a file that is cut off.
    """
    from nptdms.reader import TdmsReader

    changes: dict[str, list[Change]] = {}
    segments = []

    class Reader(TdmsReader):
        def _read_segment_metadata(self, *arguments: Any) -> Any:
            segment, properties = super()._read_segment_metadata(*arguments)
            segments.append(segment)
            for path, pairs in (properties or {}).items():
                if (known := self.object_metadata.get(path)) and known.num_values:
                    for name, value in pairs:
                        if (before := known.properties.get(name, IMPLIED_PROPERTIES.get(name, value))) != value:
                            changes.setdefault(path, []).append((known.num_values, name, before, value))
            return segment, properties

    mapped.seek(0)
    Reader(mapped).read_metadata()
    if not segments or segments[-1].next_segment_pos != len(mapped):
        raise ValueError("it is cut off, or followed by something else")
    for segment in segments:
        in_rows = segment.toc_mask & (INTERLEAVED | DAQMX)
        if segment.segment_incomplete or (segment.final_chunk_lengths_override is not None and not in_rows):
            raise ValueError(
                "it is cut off: a segment is incomplete, as after a crash of the program that wrote it; what there is "
                "is read by nptdms.TdmsFile for from_arrays"
            )
    return changes, any(segment.toc_mask & (INTERLEAVED | DAQMX) for segment in segments)


def _properties(opened: Any, group: Any, channel: Any) -> Mapping[str, Any]:
    """Return the properties of a channel, with the scales of its group or file where it has none."""
    for other in (group.properties, opened.properties):
        if any(map(SCALE_TYPE.match, other)) and not any(map(SCALE_TYPE.match, channel.properties)):
            return {key: value for key, value in other.items() if SCALE_PROPERTY.match(key)} | channel.properties
    return dict(channel.properties)


def _values(opened: Any, group: str, name: str) -> Any:
    """Return the scaled values of a channel, timestamps as dates in nanoseconds."""
    with silenced("nptdms"):
        channel = opened()[group][name]
        values = channel[:]
    if len(values) != len(channel):
        raise ValueError(f"its channel {name!r} has {len(values)} samples and not {len(channel)}")
    return _dates(values) if hasattr(values, "second_fractions") else values


def _dates(stamp: Any) -> Any:
    """Return timestamps, one or an array, as dates in nanoseconds, where npTDMS cuts off at microseconds."""
    seconds, fractions = np.int64(stamp.seconds), np.uint64(stamp.second_fractions)
    if np.any((seconds < 0) | (seconds > LAST_SECOND)):
        raise ValueError("it has timestamps before 1904 or after 2261")
    nanoseconds = ((fractions >> np.uint64(32)) * np.uint64(10**9) + np.uint64(2**31)) >> np.uint64(32)
    return (seconds - UNIX_EPOCH).astype("M8[s]").astype("M8[ns]") + nanoseconds.astype(np.int64).astype("m8[ns]")


def _clock(properties: Mapping[str, Any], changes: list[Change]) -> Clock | None:
    """Return the times of a waveform, None for a channel without them."""
    step, offset = properties.get(INCREMENT), properties.get(WAVE_OFFSET, 0.0)
    if step is None or step == 0:
        return None
    if not all(isinstance(number, int | float) and np.isfinite(number) for number in (step, offset)) or step < 0:
        return Clock(refusal=f"whose {INCREMENT} is {step!r} and {WAVE_OFFSET} {offset!r}; {BY_RATE}")
    axis = str(properties.get(WAVE_AXIS, "")).strip()
    if axis not in ("", "s", "sec", "Sec", "seconds"):
        return Clock(refusal=f"whose axis is in {axis!r}, no time in seconds; {BY_RATE}")
    for samples, name, before, value in changes:
        if name == INCREMENT:
            return Clock(
                refusal=f"whose {INCREMENT} changes from {before!r} to {value!r} s at sample {samples}; {BY_RATE}"
            )
    starts = {name: _first(name, properties, changes) for name in (WAVE_START, WAVE_OFFSET)}
    start, offset = starts[WAVE_START], float(starts[WAVE_OFFSET] or 0.0)
    if start is not None and not hasattr(start, "second_fractions"):
        return Clock(refusal=f"whose {WAVE_START} is no timestamp, but {start!r}; {BY_RATE}")
    if start is not None and start.seconds == 0 and start.second_fractions == 0:
        start = None  # as of a waveform without it
    if step == 1 and start is None and offset == 0.0:
        return Clock(
            refusal=f"whose {INCREMENT} of 1 without {WAVE_START} is also that of samples without a waveform; {BY_RATE}"
        )
    if gap := _gap(start, float(step), offset, changes):
        return Clock(refusal=gap)
    return Clock(offset, float(step), origin=None if start is None else _dates(start))


def _first(name: str, properties: Mapping[str, Any], changes: list[Change]) -> Any:
    """Return the value of a property for the first samples."""
    return next((before for _, changed, before, _ in changes if changed == name), properties.get(name))


def _gap(start: Any, step: float, offset: float, changes: list[Change]) -> str:
    """Return the refusal of a channel whose later segments do not continue the first one."""
    now = {WAVE_START: start, WAVE_OFFSET: offset}
    for samples in sorted({samples for samples, name, *_ in changes if name in now}):
        now |= {name: value for place, name, _, value in changes if place == samples and name in now}
        passed = np.nan if start is None and now[WAVE_START] is not None else float(now[WAVE_OFFSET] or 0.0) - offset
        if start is not None:
            passed += (_dates(now[WAVE_START]) - _dates(start)) / np.timedelta64(1, "ns") * 1e-9
        if not abs(passed - samples * step) <= 0.5 * step:
            return (
                f"whose segment from sample {samples} starts {passed:.9g} s after the first one and not "
                f"{samples * step:.9g} s, as if the measurement had been restarted; {BY_RATE} if it was not"
            )
    return ""


def _refusal(properties: Mapping[str, Any], changes: list[Change]) -> str:
    """Return why the values of a channel are not those that npTDMS returns."""
    for key, value in properties.items():
        if SCALE_TYPE.match(key) and value not in SCALES_READ:
            return f"a scale of type {value!r} ({key}), which npTDMS does not apply"
    for samples, name, before, value in changes:
        if SCALE_PROPERTY.match(name):
            return f"a {name} that changes from {before!r} to {value!r} at sample {samples}; split the file there"
    return ""


def _remarks(properties: Mapping[str, Any], samples: int) -> tuple[str, ...]:
    announced = properties.get("wf_samples")
    if isinstance(announced, int) and announced > 0 and samples % announced:
        return (f"wf_samples announces {announced} samples, there are {samples}",)
    return ()
