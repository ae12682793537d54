"""Universal files: functions of data sets 58 and 58b, units of data set 164, read by pyuff."""

import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic.data.formats.contents import Clock, Contents, Key, StoredChannel, package, unique_names
from bayesperiodic.data.formats.decimals import step_error
from bayesperiodic.data.formats.uff_units import Units164, quotient, seconds_of, unit_of

SET_MARK = b"    -1"
BINARY_START = re.compile(rb" {4}-1 *[\r\n]+ *58[bB]")
FUNCTION_SET, UNIT_SET = 58, 164
# Lines of the header of a function, after the mark and with the number of the set.
HEADER_LINES = 13
FUNCTION_TYPES = {
    0: "a function of unknown type", 2: "an auto spectrum", 3: "a cross spectrum", 4: "a frequency response function",
    5: "a transmissibility", 6: "a coherence", 7: "an auto correlation", 8: "a cross correlation",
    9: "a power spectral density", 10: "an energy spectral density", 12: "a spectrum", 17: "an orbit",
    24: "a shock response spectrum", 27: "an order function",
}  # fmt: skip
UNKNOWN_FUNCTION, TIME_RESPONSE, FREQUENCY_RESPONSE = 0, 1, 4
# Specific data types of abscissas.
UNKNOWN_DATA, GENERAL_DATA, TIME_ABSCISSA, FREQUENCY_ABSCISSA = 0, 1, 17, 18
DIRECTIONS = {1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"}
DIRECTIONS |= {-key: value.replace("+", "-") for key, value in DIRECTIONS.items()}
COMPLEX_DATA, SINGLE_DATA, REAL_DATA = (5, 6), (2, 5), (2, 4)
IEEE_754 = 2
# Bytes that may follow the values of a binary set: the end of its last line of 80.
MOST_PADDING = 80
# Errors of times that are refused, of the step.
LARGEST_JITTER = 0.01


@dataclass(frozen=True, eq=False)
class _Set:
    """A function of a universal file: its header as pyuff reads it, and numbers as they are written."""

    number: int  # from 1, of all data sets of the file
    head: dict[str, Any]
    step: str
    start: str
    labels: tuple[str, str, str]  # of the units of abscissa, ordinate and denominator
    units: Units164 | None

    @property
    def even(self) -> bool:
        return bool(self.head["abscissa_spacing"] == 1)

    @property
    def place(self) -> str:
        """Node and direction, such as "12:+Z"; empty without."""
        name, node, way = self.head["rsp_ent_name"], self.head["rsp_node"], DIRECTIONS.get(self.head["rsp_dir"], "")
        if not node and not way:
            return ""
        return ":".join(([] if name in ("", "NONE") else [name]) + [str(node)] + ([way] if way else []))

    @property
    def title(self) -> str:
        return "" if self.head["id1"] == "NONE" else self.head["id1"]


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the functions of a universal file; those that are no time signals are refused as channels."""
    pyuff = package("pyuff", "pyuff", "universal files")
    blocks = _blocks(file)
    if not any(kind == FUNCTION_SET for kind, _ in blocks):
        kinds = ", ".join(sorted({str(kind) for kind, _ in blocks})) or "none"
        raise ValueError(f"it has no data set 58, but {kinds}")
    reader = pyuff.UFF(str(file))
    if [*reader.get_set_types()] != [kind for kind, _ in blocks]:
        raise ValueError("its data sets cannot be told apart, because one contains or lacks a mark -1")
    sets = _sets(reader, blocks)
    names, groups = _names(sets)
    clocks = _clocks(reader, sets)
    channels = [
        StoredChannel(
            name,
            int(one.head["num_pts"]),
            partial(_values, reader, one),
            group,
            quotient(*one.labels[1:], one.units)
            if (refusal := _refusal(one))
            else unit_of(one.head, one.labels[1], one.units),
            clock,
            _remarks(one),
            refusal,
            partial(_frequencies, reader, one) if one.head["func_type"] == FREQUENCY_RESPONSE else None,
        )
        for one, name, group, clock in zip(sets, names, groups, clocks, strict=True)
    ]
    return Contents("universal file", tuple(channels), _file_remarks(sets))


def _blocks(file: Path) -> list[tuple[int, list[bytes]]]:
    """Return number and first lines of each data set, between lines that are -1 in columns 5 and 6."""
    places: list[int] = []
    content, place = file.read_bytes(), -1
    while (place := content.find(SET_MARK, place + 1)) >= 0:
        end = place + len(SET_MARK)
        line = content[end : end + 80].splitlines()
        if line and line[0].strip():
            continue
        # The mark after binary values may stand in their line.
        within = len(places) % 2 and BINARY_START.match(content, places[-1])
        if within or place == 0 or content[place - 1 : place] in (b"\n", b"\r"):
            places.append(place)
    if len(places) % 2:
        raise ValueError("it is cut off")
    blocks = []
    for start, end in zip(places[::2], places[1::2], strict=True):
        lines = content[start : min(end, start + 100 * (HEADER_LINES + 1))].splitlines()[1 : HEADER_LINES + 1]
        number = lines[0][:6].strip() if lines else b""
        if not number.isdigit():
            raise ValueError(f"it has a data set whose number is {number[:6].decode('ascii', 'replace')!r}")
        blocks.append((int(number), lines))
    return blocks


def _sets(reader: Any, blocks: list[tuple[int, list[bytes]]]) -> list[_Set]:
    """Return the functions of a file, with the units that precede them, or else the first ones."""
    known = {k: Units164.of(_read(reader, k)) for k, (kind, _) in enumerate(blocks) if kind == UNIT_SET}
    sets = []
    for k, (kind, lines) in enumerate(blocks):
        if kind != FUNCTION_SET:
            continue
        head = _read(reader, k, header_only=True)
        _check_head(k + 1, head)
        before = [place for place in known if place < k]
        units = known[before[-1]] if before else next(iter(known.values()), None)
        form, abscissa, ordinate, denominator = (_text(lines[line]) for line in (7, 8, 9, 10))
        labels = (abscissa[47:67].strip(), ordinate[47:67].strip(), denominator[47:67].strip())
        sets.append(_Set(k + 1, head, form[43:56], form[30:43], labels, units))
    return sets


def _text(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace")


def _read(reader: Any, place: int, *, header_only: bool = False) -> dict[str, Any]:
    try:
        result: dict[str, Any] = reader.read_sets(place, header_only=header_only)
    except Exception:  # pyuff raises Exception itself, without the reason
        raise ValueError(f"its data set {place + 1} cannot be read by pyuff") from None
    return result


def _check_head(number: int, head: dict[str, Any]) -> None:
    """Raise a ValueError for a function that pyuff misreads without an error."""
    if (
        head["ord_data_type"] not in (*REAL_DATA, *COMPLEX_DATA)
        or head["abscissa_spacing"] not in (0, 1)
        or head["num_pts"] < 0
    ):
        raise ValueError(f"its data set {number} has an unknown form of data")
    if head["binary"] and (head["fp_format"] != IEEE_754 or head["byte_ordering"] not in (1, 2)):
        raise ValueError(
            f"its data set {number} has numbers of format {head['fp_format']} and byte order {head['byte_ordering']}, "
            "not those of IEEE 754"
        )
    if head["binary"] and head["n_ascii_lines"] != HEADER_LINES - 2:
        raise ValueError(f"its data set {number} has {head['n_ascii_lines']} lines before its values, not 11")
    if not np.isfinite([head["abscissa_min"], head["abscissa_inc"]]).all():
        raise ValueError(f"its data set {number} has an abscissa that is not finite")


def _data(reader: Any, one: _Set) -> tuple[np.ndarray, np.ndarray]:
    """Return abscissa and ordinate of a function, without what follows its values."""
    data = _read(reader, one.number - 1)
    x, y, size = data["x"], data["data"], int(one.head["num_pts"])
    # Of a text, the last line is filled with further values.
    parts = (2 if one.head["ord_data_type"] in COMPLEX_DATA else 1) + (not one.even)
    width = 4 if one.head["ord_data_type"] in SINGLE_DATA else 8
    spare = MOST_PADDING // (width * parts) if one.head["binary"] else 6 // parts - 1
    if not size <= y.size <= size + spare or x.size < size:
        raise ValueError(
            f"its data set {one.number} has {y.size} values, and its header says {size}; it is cut off or damaged"
        )
    return x[:size], y[:size]


def _values(reader: Any, one: _Set) -> np.ndarray:
    return _data(reader, one)[1]


def _frequencies(reader: Any, one: _Set) -> np.ndarray:
    """Return the abscissa of a frequency response function [Hz]."""
    kind, label = one.head["abscissa_spec_data_type"], one.labels[0]
    if kind not in (UNKNOWN_DATA, GENERAL_DATA, FREQUENCY_ABSCISSA) or label.strip().lower() not in ("", "none", "hz"):
        raise ValueError(f"its data set {one.number} has an abscissa that is no frequency in Hz, but {label!r}")
    return _data(reader, one)[0]


def _refusal(one: _Set) -> str:
    """Return why a function is no channel of a recording."""
    kind = one.head["func_type"]
    how = f"read it by pyuff.UFF(path).read_sets({one.number - 1})"
    if kind != TIME_RESPONSE and (kind != UNKNOWN_FUNCTION or one.head["abscissa_spec_data_type"] != TIME_ABSCISSA):
        return f"{FUNCTION_TYPES.get(kind, 'a function')} (type {kind}), which is no time signal; {how}"
    if one.head["ord_data_type"] in COMPLEX_DATA:
        return f"a complex time signal; {how}"
    return ""


def _clocks(reader: Any, sets: list[_Set]) -> list[Clock | None]:
    """Return the times of the time signals, one object for equal ones."""
    clocks = [None if _refusal(one) else _clock(reader, one) for one in sets]
    several = len({clock.start for clock in clocks if clock and not clock.refusal and not clock.stored}) > 1
    distinct: dict[Any, Clock] = {}
    result: list[Clock | None] = []
    for one, clock in zip(sets, clocks, strict=True):
        if clock and several and not clock.stored and not clock.refusal:
            clock = _with_start(one, clock)
        key = clock and (clock.start, clock.step, clock.stored, clock.refusal)
        result.append(clock and distinct.setdefault(key, clock))
    return result


def _with_start(one: _Set, clock: Clock) -> Clock:
    """Return a clock, refused if its start has too few digits for a file whose sets start at different times."""
    error = step_error(one.start.replace("-", "", 1) if one.start.strip().startswith("-") else one.start)
    error *= clock.step / one.head["abscissa_inc"]
    if error <= LARGEST_JITTER * clock.step:
        return clock
    refusal = (
        f"which starts at {clock.start:g} s, rounded to {2 * error:.2g} s with a step of "
        f"{clock.step:.3g} s, and other sets start at other times; sampling_rate= takes the start as it is written"
    )
    return replace(clock, refusal=refusal)


def _clock(reader: Any, one: _Set) -> Clock:
    """Return the times of a function, refused if they are rounded too coarsely or are no times."""
    kind, factor = one.head["abscissa_spec_data_type"], seconds_of(one.labels[0])
    if kind not in (UNKNOWN_DATA, GENERAL_DATA, TIME_ABSCISSA) or factor is None:
        return Clock(refusal=f"whose abscissa is no time, but of type {kind} in {one.labels[0]!r}")
    if not one.even:
        return _uneven_clock(reader, one, factor)
    step = one.head["abscissa_inc"]
    if step <= 0.0:
        return Clock(refusal=f"whose interval is {step:g}")
    return Clock(factor * one.head["abscissa_min"], factor * step, error=factor * step_error(one.step))


def _uneven_clock(reader: Any, one: _Set, factor: float) -> Clock:
    """Return times that are stored, with six digits in texts and as single numbers in binary sets."""
    if one.head["num_pts"] < 2:
        return Clock(refusal="of fewer than two samples")
    times, largest = _times(reader, one, factor), 0.0
    single = one.head["binary"] and one.head["ord_data_type"] in SINGLE_DATA
    end = float(np.abs(times).max())
    if single:
        largest = 0.5 * float(np.spacing(np.float32(end)))
    elif not one.head["binary"]:
        largest = 0.5 * 10.0 ** (np.floor(np.log10(end or 1.0)) - 5)
    step = float(times[-1] - times[0]) / (times.size - 1)
    digits = f"whose times are rounded to {2 * largest:.2g} s, with a mean step of {step:.3g} s"
    if not (np.diff(times) > 0.0).all() or largest > LARGEST_JITTER * step:
        return Clock(
            start=float(times[0]),
            refusal=f"{digits}, so that several are equal or displaced; give sampling_rate= if they are even",
        )
    return Clock(stored=lambda: times, remarks=(f"times are stored with an error of up to {largest:.2g} s",))


def _times(reader: Any, one: _Set, factor: float) -> np.ndarray:
    return factor * _data(reader, one)[0]


def _names(sets: list[_Set]) -> tuple[list[str], list[str]]:
    """Return names and groups: ID line 1 and the place, or the place alone if that line does not tell them apart."""
    titles = [one.title for one in sets]
    if len(sets) > 1 and len(set(titles)) == 1 and all(one.place for one in sets):
        return [*unique_names(one.place for one in sets)], [""] * len(sets)
    names = [one.title or one.place or f"set {one.number}" for one in sets]
    groups = [one.place if one.title else "" for one in sets]
    result = dict.fromkeys(range(len(sets)), "")
    for group in dict.fromkeys(groups):
        places = [k for k, other in enumerate(groups) if other == group]
        result.update(zip(places, unique_names(names[k] for k in places), strict=True))
    return [*result.values()], groups


def _remarks(one: _Set) -> tuple[str, ...]:
    if one.head["func_type"] == UNKNOWN_FUNCTION and not _refusal(one):
        return ("its type is not stated; it is taken as a time signal, because its abscissa is the time",)
    return ()


def _file_remarks(sets: list[_Set]) -> tuple[str, ...]:
    """Return what is not seen in a single set."""
    dates = [*dict.fromkeys(one.head["id3"] for one in sets if not _refusal(one))]
    if len(dates) < 2:
        return ()
    return (
        f"the sets have different dates ({dates[0]!r} to {dates[-1]!r}) and may be different runs; the times of each "
        "count from its start, and those of one recording must have started together",
    )
