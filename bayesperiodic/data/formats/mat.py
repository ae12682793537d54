"""MAT files of MATLAB, version 5 or 7.3."""

import functools
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _hdf5
from bayesperiodic.data.formats.contents import LARGEST_ARRAY, OTHERWISE, Contents, Key, StoredChannel
from bayesperiodic.data.formats.hdf5_attributes import attributes

# Of MAT files, version 5: types of elements and of numbers, classes of arrays, flag of complex arrays, and the bytes in
# which the name of a variable ends.
INT32, MAT_MATRIX, COMPRESSED, COMPLEX, HEADER_BYTES = 5, 14, 15, 0x800, 4096
# Classes: those of the flags, of structures, sparse matrices and objects such as tables.
CLASS, STRUCTURE, SPARSE, OPAQUE = 0xFF, 2, 5, 17
# Structures in structures that are searched.
DEEPEST_STRUCTURE = 8
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", INT32: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
NUMERIC = {
    6: "double", 7: "single", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16", 12: "int32", 13: "uint32", 14: "int64",
    15: "uint64",
}  # fmt: skip
NUMERIC_KINDS = (*NUMERIC.values(), "logical")
# What to type in MATLAB for objects, whose format MathWorks does not document.
REMEDIES = {
    "table": "s = table2struct({0}, 'ToScalar', true); save('run.mat', '-struct', 's')",
    "timetable": (
        "s = table2struct(timetable2table({0}, 'ConvertRowTimes', false), 'ToScalar', true); "
        "s.t = seconds({0}.Properties.RowTimes - {0}.Properties.RowTimes(1)); save('run.mat', '-struct', 's')"
    ),
    "timeseries": "t = {0}.Time; x = squeeze({0}.Data); save('run.mat', 't', 'x')",
    "datetime": "t = seconds({0} - {0}(1)); save('run.mat', 't', '-append')",
    "duration": "t = seconds({0}); save('run.mat', 't', '-append')",
    "Simulink.SimulationData.Dataset": (
        "x = {0}.getElement(1).Values; t = x.Time; x = squeeze(x.Data); save('run.mat', 't', 'x')"
    ),
}


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the variables of a MAT file; each is read when it is asked for."""
    import h5py

    channels = _hdf5_channels(file) if h5py.is_hdf5(file) else _mat5_channels(file)
    return Contents("MAT file", tuple(channels), word="column")


def object_refusal(kind: str, name: str) -> str:
    """Return why an object of MATLAB cannot be read, and what to type there."""
    form = REMEDIES.get(kind, "save its numbers as plain arrays, such as x = double({0}.x); save('run.mat', 'x')")
    return f"a MATLAB object ({kind}), whose format is not documented; in MATLAB: {form.format(name)}"


def _hdf5_channels(file: Path) -> Iterator[StoredChannel]:
    import h5py

    _hdf5.check_heaps(file)
    with h5py.File(file, "r") as archive:
        for name in archive:
            if isinstance(name, str) and not name.startswith("#"):  # bytes are no text; objects are in "#refs#"
                try:
                    item = _hdf5.dataset(archive, name)
                    yield _hdf5_channel(file, "", name, item)
                except ValueError:  # no array: refused when it is read, if it is no sparse matrix
                    if not _sparse_rows(archive, name):
                        yield StoredChannel(name, 0, partial(_hdf5_values, file, "", name))
        for group, name, field in _hdf5.walk(archive):  # fields of structures
            if group and name == "jc" and (rows := _sparse_rows(archive, group)):
                whole, columns = group.replace("/", "."), int(field.size if field is not None else 1) - 1
                yield StoredChannel(whole, rows * columns, partial(_hdf5_sparse, file, group))
            elif group and _sparse_rows(archive, group):
                continue
            elif group and not group.startswith("#") and field is not None and not field.dtype.hasobject:
                yield _hdf5_channel(file, group, name, field)


def _hdf5_channel(file: Path, group: str, name: str, item: Any) -> StoredChannel:
    stored = attributes(item)
    whole = ".".join([*group.split("/"), name]) if group else name
    kind = str(stored.get("MATLAB_class", "double"))
    refusal = object_refusal(kind, whole) if "MATLAB_object_decode" in stored and kind not in NUMERIC_KINDS else ""
    return StoredChannel(whole, int(item.size or 0), partial(_hdf5_values, file, group, name), refusal=refusal)


def _hdf5_values(file: Path, group: str, name: str) -> Any:
    """Return a variable of a MAT file, version 7.3, or a field of a structure."""
    import h5py

    with h5py.File(file, "r") as archive:
        item = _hdf5.at(archive, group, name)
        stored = attributes(item)
        kind = str(stored.get("MATLAB_class", "double"))
        if kind not in NUMERIC_KINDS or stored.get("MATLAB_empty"):
            raise ValueError(f"its variable {name!r} is empty or no array of numbers, but {kind}")
        return np.transpose(_hdf5.values(item, LARGEST_ARRAY, OTHERWISE))


def _sparse_rows(archive: Any, path: str) -> int:
    """Return the number of rows of a sparse matrix of version 7.3, which is a group; 0 for others."""
    try:
        _hdf5.at(archive, path, "jc")
        return int(attributes(archive[path]).get("MATLAB_sparse", 0))
    except (ValueError, TypeError):
        return 0


def _hdf5_sparse(file: Path, path: str) -> np.ndarray:
    import h5py

    with h5py.File(file, "r") as archive:
        rows, names = _sparse_rows(archive, path), ("jc", "ir", "data")
        empty = "data" not in archive[path] and "ir" not in archive[path]
        arrays = [
            np.ravel(_hdf5.values(_hdf5.at(archive, path, name), LARGEST_ARRAY, OTHERWISE))
            for name in (names[:1] if empty else names)
        ]
    starts, places, values = (arrays[0], np.zeros(0, int), np.zeros(0)) if empty else arrays
    return _dense(path, (rows, len(starts) - 1), places, starts, values)


def _dense(name: str, shape: tuple[int, int], places: Any, starts: Any, values: Any) -> np.ndarray:
    """Return a sparse matrix of rows and starts of columns, as an array."""
    if values.dtype.kind not in "fiub":
        raise ValueError(f"its variable {name!r} is no matrix of real numbers")
    if 8 * math.prod(shape) > LARGEST_ARRAY:
        raise ValueError(f"its matrix {name!r} has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}")
    counts, places = np.diff(starts.astype(np.int64)), places.astype(np.int64)
    used = int(starts[-1]) if len(starts) else -1
    if len(counts) != shape[1] or not 0 <= used <= min(len(places), len(values)) or starts[0] or min(counts) < 0:
        raise ValueError(f"its matrix {name!r} has other starts of columns than its size")
    columns, places, result = np.repeat(np.arange(shape[1]), counts), places[:used], np.zeros(shape)
    if used and not 0 <= places.min() <= places.max() < shape[0]:
        raise ValueError(f"its matrix {name!r} has rows beyond its size")
    if len(np.unique(places * shape[1] + columns)) < used:
        raise ValueError(f"its matrix {name!r} has two values in one place")
    result[places, columns] = values[:used]
    return result


def _mat5_channels(file: Path) -> Iterator[StoredChannel]:
    """Yield the variables of a MAT file, version 5, after MathWorks' "MAT-File Format", and fields of structures.

    scipy.io.loadmat ends the process with a segmentation fault for some damaged files.
    """
    content = file.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("it has no header of version 5; an older version is converted by save('-v7') in MATLAB")
    seen: dict[str, StoredChannel] = {}
    elements = [*_elements(memoryview(content)[128:], order)]

    @functools.lru_cache(maxsize=1)  # the fields of a structure are read one after the other
    def unpacked(number: int) -> memoryview:
        kind, data = elements[number]
        return _unpacked(str(number + 1), data) if kind == COMPRESSED else data

    for number, (kind, data) in enumerate(elements):
        head = data
        if compressed := kind == COMPRESSED:
            head = memoryview(zlib.decompressobj().decompress(data, HEADER_BYTES))[8:]
        elif kind != MAT_MATRIX:
            raise ValueError(f"it contains an element of type {kind}")
        name, flags, shape, parts = _variable(head, order)
        refusal = object_refusal(_class_of(parts), name) if flags & CLASS == OPAQUE else ""
        read = partial(_twice, name) if name in seen else partial(_mat5_values, name, data, compressed, order)
        seen[name] = StoredChannel(name, math.prod(shape), read, refusal=refusal)
        if flags & CLASS == STRUCTURE:
            for path, size, problem in _fields(name, unpacked(number), order):
                values = partial(_field_values, partial(unpacked, number), path, order)
                seen[path] = StoredChannel(path, size, values, refusal=problem)
    seen.pop("", None)  # what objects refer to
    yield from seen.values()


def _twice(name: str) -> Any:
    raise ValueError(f"it has two variables {name!r}")


def _mat5_values(name: str, data: memoryview, compressed: bool, order: str) -> np.ndarray:
    """Return a variable of a MAT file, version 5."""
    return _array(*_variable(_unpacked(name, data) if compressed else data, order), order)


def _unpacked(name: str, data: memoryview) -> memoryview:
    """Return the content of a compressed element."""
    stream = zlib.decompressobj()
    whole = stream.decompress(data, HEADER_BYTES)
    whole += stream.decompress(stream.unconsumed_tail, LARGEST_ARRAY)
    if not stream.eof:
        raise ValueError(f"its variable {name!r} is cut off or has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}")
    return memoryview(whole)[8:]


def _field_values(load: Callable[[], memoryview], path: str, order: str) -> np.ndarray:
    """Return a field of a structure, with the names that lead to it joined by dots."""
    name, *labels = path.split(".")
    data = load()
    for label in labels:
        data = dict(_members(name, data, order))[label]
    _, flags, shape, parts = _variable(data, order)
    return _array(path, flags, shape, parts, order)


def _fields(name: str, data: memoryview, order: str) -> Iterator[tuple[str, int, str]]:
    """Yield path, size and refusal of the fields that are numbers or objects, also of structures in structures."""
    for label, member in _members(name, data, order):
        if not len(member):  # an empty array
            continue
        path = f"{name}.{label}"
        _, flags, shape, parts = _variable(member, order)
        if flags & CLASS in (*NUMERIC, SPARSE):
            yield path, math.prod(shape), ""
        elif flags & CLASS == OPAQUE:
            yield path, 0, object_refusal(_class_of(parts), path)
        elif flags & CLASS == STRUCTURE and path.count(".") < DEEPEST_STRUCTURE:
            yield from _fields(path, member, order)


def _members(name: str, data: memoryview, order: str) -> Iterator[tuple[str, memoryview]]:
    """Yield names and contents of the fields of a structure; none of an array of structures."""
    _, _, shape, parts = _variable(data, order)
    if math.prod(shape) != 1:
        return
    (_, length), (_, texts) = next(parts), next(parts)
    (size,) = struct.unpack(f"{order}i", length)
    if size <= 0:
        raise ValueError(f"its variable {name!r} has names of {size} characters")
    labels = [bytes(texts[k : k + size]).split(b"\0")[0].decode() for k in range(0, len(texts), size)]
    if len(set(labels)) < len(labels):
        raise ValueError(f"its variable {name!r} has two fields of one name")
    for label in labels:
        kind, member = next(parts)
        if kind != MAT_MATRIX:
            raise ValueError(f"its variable {name!r} has a field of type {kind}")
        yield label, member


def _class_of(parts: Iterator[tuple[int, memoryview]]) -> str:
    """Return the class of an object; what follows its name are the system of types and the class."""
    try:
        return bytes([next(parts), next(parts)][1][1]).decode()
    except (StopIteration, ValueError, struct.error):
        return "object"


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
    if flags & (CLASS | COMPLEX) == SPARSE:
        places, starts, stored = (np.frombuffer(part, f"{order}{STORED[kind]}") for kind, part in parts)
        return _dense(name, (shape[0], shape[1]), places, starts, stored)
    if flags & CLASS not in NUMERIC or flags & COMPLEX:
        other = "complex" if flags & COMPLEX else f"of MATLAB class {flags & CLASS}"
        raise ValueError(f"its variable {name!r} is no array of real numbers, but {other}")
    kind, values = next(parts)
    array = np.frombuffer(values, f"{order}{STORED[kind]}")
    if next(parts, None) is not None or min(shape) < 0 or array.size != math.prod(shape):
        raise ValueError(f"its variable {name!r} has another size than its header says")
    return array.reshape(shape, order="F")
