"""Reading of columns from CSV, NPZ and MAT files."""

import codecs
import csv
import io
import itertools
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.times import dates

# Texts of missing values.
MISSING = [
    "", "nan", "NaN", "NAN", "-nan", "-NaN", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None", "1.#IND",
    "-1.#IND", "1.#QNAN", "-1.#QNAN",
]  # fmt: skip
# Lines among which the header is searched for, and separators of fields, in the order in which they are tried.
PREAMBLE, SEPARATORS = 1000, (",", ";", "\t")
# Bytes that are decoded at once, and columns per wanted column above which the others are not made numbers.
PART_BYTES, UNWANTED_RATIO = 2**20, 2

# Bytes of an array, against files that unpack to more than the memory.
LARGEST_ARRAY = 2**31
OTHERWISE = "read the part that you need with h5py or NumPy, and give it to from_arrays"
# Of MAT files, version 5: types of elements and of numbers, classes of arrays, flag of complex arrays, and the bytes in
# which the name of a variable ends.
INT32, MAT_MATRIX, COMPRESSED, COMPLEX, HEADER_BYTES = 5, 14, 15, 0x800, 4096
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", INT32: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
NUMERIC = {
    6: "double", 7: "single", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16", 12: "int32", 13: "uint32", 14: "int64",
    15: "uint64",
}  # fmt: skip

Stored = tuple[Iterable[str], Mapping[str, Any]]


@dataclass(frozen=True)
class Format:
    """A format of files with named columns.

    ``columns(file, wanted)`` returns all names in the file and the values of the wanted ones among them. Any error that
    it raises is reported with `kind`, unless its message begins with the name of an argument.
    """

    kind: str  # what a file must be, for errors
    columns: Callable[[Path, list[str]], Stored]

    def read(
        self, path: str | Path, wanted: Iterable[str], label: str | None = None, time: str | None = None
    ) -> dict[str, np.ndarray]:
        """Return named columns of numbers; the column `label` may contain text, and `time` dates."""
        wanted, file = [*wanted], existing(path)
        try:
            names, stored = self.columns(file, wanted)
        except Exception as error:  # whatever zipfile, zlib, NumPy and HDF5 raise for damaged files
            if str(error).startswith(("path: ", "column ")):
                raise
            reason = error if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise ValueError(f"path: must be {self.kind}, got {str(path)!r} ({reason}).") from None
        for column in wanted:
            _checks.one_of(f"column of {file.name}", column, names)
        return {column: _column(file, column, stored[column], column == label, column == time) for column in wanted}


def _column(file: Path, column: str, values: Any, text: bool, time: bool) -> np.ndarray:
    """Return a column of numbers, or of texts too; of times also as dates, and integers as they are."""
    argument, array = f"column {column!r} of {file.name}", np.squeeze(np.asarray(values))
    time = time and not text
    if time and (times := dates(argument, array)) is not None:
        array = times
    if array.dtype == object and not text:
        import pandas as pd

        cells = np.atleast_1d(array)
        rows = np.flatnonzero(pd.isna(pd.to_numeric(cells, errors="coerce")) & pd.notna(cells))
        got = f"{cells[rows[0]]!r} in data row {rows[0] + 1}" if rows.size else "numbers too long to be read"
        hint = (
            "; dates must be those of ISO 8601, others are read by pandas.to_datetime for from_arrays" if time else ""
        )
        raise ValueError(f"{argument}: must contain numbers, with a decimal point, got {got}{hint}.")
    if array.ndim != 1 or (array.dtype.kind not in ("fiubmM" if time else "fiub") and not text):
        raise ValueError(
            f"{argument}: must be one column of real numbers, got shape {np.shape(values)} and type {array.dtype}."
        )
    return array if text or time else array.astype(float)


@dataclass(frozen=True)
class _Text:
    """A text file and its encoding."""

    path: Path
    encoding: str

    def __repr__(self) -> str:
        return repr(str(self.path))

    def open(self) -> TextIO:
        """Return the opened file, with the ends of its lines as they are and without a byte order mark."""
        marked = codecs.lookup(self.encoding).name == "utf-8"
        return self.path.open(encoding="utf-8-sig" if marked else self.encoding, newline="")

    def check(self) -> None:
        """Raise a ValueError if the file is not in its encoding, or contains characters 0, at which numbers end."""
        name = "UTF-8" if self.encoding == "utf-8" else self.encoding
        line, decoder = 1, codecs.getincrementaldecoder(self.encoding)()
        with self.path.open("rb") as content:
            marked = content.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
            content.seek(0)
            for part in itertools.chain(iter(lambda: content.read(PART_BYTES), b""), [b""]):
                try:
                    text = decoder.decode(part, final=not part)
                except UnicodeDecodeError as error:
                    line += error.object[: error.start].count(b"\n")
                    other = "UTF-16, encoding='utf-16'" if marked else "Latin-1, encoding='latin-1'"
                    raise ValueError(
                        f"path: must be a CSV file in {name}, got {self!r}, whose line {line} has the byte "
                        f"0x{error.object[error.start]:02x}; it may be in {other}, or in that of the program which "
                        "wrote it, such as encoding='cp1252' of Windows."
                    ) from None
                if "\0" in text:
                    raise ValueError(
                        f"path: must be a CSV file in {name}, got {self!r}, which contains bytes 0; it was damaged "
                        f"when it was written, or is no text in {name}; see encoding, such as encoding='utf-16'."
                    )
                line += text.count("\n")


def csv_in(encoding: str) -> Format:
    """Return the format of CSV files in an encoding."""
    try:
        "".encode(encoding)
    except (LookupError, TypeError, ValueError):
        raise ValueError(
            f"encoding: must be one of Python's, such as 'utf-8', 'latin-1' or 'cp1252', got {encoding!r}."
        ) from None
    return Format("a CSV file with a header line", lambda path, wanted: _csv_columns(_Text(path, encoding), wanted))


def _csv_columns(file: _Text, wanted: list[str]) -> Stored:
    """Return names and wanted columns of a CSV file; the header is the first line with all of these names."""
    import pandas as pd

    file.check()
    try:
        names, lines, more, separator = _header(file, wanted)
        places = {column: _place(file.path, names, column) for column in wanted}
        with file.open() as text, warnings.catch_warnings():
            _skip(text, lines, separator)
            warnings.simplefilter("error", pd.errors.ParserWarning)
            width, source = len(names), text
            # More columns than names hold the fields after trailing commas.
            # The only column of a file may have empty cells, which are empty lines, but not at the end.
            alone, surplus = width == 1, max(more, 0) + 1
            if alone:
                source = io.StringIO(text.read().rstrip())
            elif UNWANTED_RATIO * len(places) < width:
                rows = csv.reader(text, delimiter=separator, skipinitialspace=True, strict=True)
                source = _narrowed(rows, [*places.values()], width, width + surplus)
                width, surplus = len(places) + 1, 1
                places, separator = {column: place for place, column in enumerate(places)}, ","
            missing: Any = dict(enumerate([MISSING] * width + [[""]] * surplus))
            table = pd.read_csv(
                source,
                skip_blank_lines=not alone,
                sep=separator,
                header=None,
                names=range(width + surplus),
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
                keep_default_na=False,
                na_values=missing,
            )
    except (pd.errors.ParserError, pd.errors.ParserWarning, _OtherFields) as error:
        _check_fields(file, names, lines, separator)
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r} ({error}).") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r} ({error}).") from None
    if table.empty:
        raise ValueError(f"path: must be a CSV file with rows of data, got {file!r}, which has none.")
    if table.iloc[:, width:].notna().any(axis=None) or table[width - 1].isna().any():
        _check_fields(file, names, lines, separator)
    return names, {column: table[place].to_numpy() for column, place in places.items()}


class _OtherFields(Exception):
    """A row of a wide file has another number of fields than there are names."""


def _narrowed(rows: Iterable[list[str]], places: list[int], width: int, most: int) -> TextIO:
    """Return the wanted fields of all rows as CSV, with a last column of zeros; rows have `width` to `most` fields.

    The table of all columns of a wide file would take several times the memory of the file.
    """
    narrow = io.TextIOWrapper(io.BytesIO(), "utf-8", newline="")
    writer = csv.writer(narrow)
    for row in rows:
        if len(row) < 2 and not any(map(str.strip, row)):
            continue
        short = len(row) < width and any(map(str.strip, row))
        if short or len(row) > most or any(map(str.strip, row[width:])):
            raise _OtherFields("rows have different numbers of fields")
        writer.writerow([*(row[place] if place < len(row) else "" for place in places), "0"])
    narrow.seek(0)
    return narrow


def _header(file: _Text, columns: list[str]) -> tuple[list[str], int, int, str]:
    """Return the names of the columns of a CSV file and three facts: lines up to there, surplus fields, separator.

    The separator is the first one for which a line contains all columns, or else that with most of them.
    """
    headers: list[tuple[list[str], int, int, str]] = []
    for separator in SEPARATORS:
        try:
            headers.append((*_line_of_names(file, columns, separator), separator))
        except csv.Error:  # a long line is one field for another separator than its own
            if not headers and separator == SEPARATORS[-1]:
                raise
            continue
        if {*columns} <= {*headers[-1][0]}:
            return headers[-1]
    best = max(headers, key=lambda header: len({*columns} & {*header[0]}))
    if _is_no_header(best[0]):
        raise ValueError(
            "path: must be a CSV file whose first line names the columns, separated by commas, semicolons or tabs, got "
            f"{file!r}, whose first line is read as {_checks.shortened(best[0])}. Numbers must have a decimal point."
        )
    return best


def _line_of_names(file: _Text, columns: list[str], separator: str) -> tuple[list[str], int, int]:
    """Return the names in the line with most columns, the number of lines up to there, and of fields that follow.

    Without a line of all names, that with most of them tells what is missing.
    """
    most, names, number, more, following = -1, [""], 0, 0, False
    with file.open() as text:
        rows = csv.reader(text, delimiter=separator, skipinitialspace=True)
        for row in filter(None, itertools.islice(rows, PREAMBLE)):
            if following:
                more, following = len(row) - len(names), False
                if most == len({*columns}):
                    break
            fields = [name.strip() for name in row]
            if (count := len({*columns} & {*fields})) > most:
                most, number, more, following = count, rows.line_num, 0, True
                names = fields[: max((i for i, name in enumerate(fields, 1) if name), default=len(fields))]
    if most < 0:
        raise ValueError(f"path: must be a CSV file with a header line, got {file!r}, which is empty.")
    return names, number, more


def _check_fields(file: _Text, names: list[str], lines: int, separator: str) -> None:
    """Raise a ValueError unless each row has one field per name, and equally many empty ones after them."""
    with file.open() as text:
        fields, rows = None, _skip(text, lines, separator)
        data = (row for row in rows if any(field.strip() for field in row))
        for number, row in enumerate(data, 1):
            fields = fields or len(row)
            if len(row) < len(names) or len(row) != fields or any(field.strip() for field in row[len(names) :]):
                raise ValueError(
                    f"path: must be a CSV file with {len(names)} fields in each row, as many as there are names, got "
                    f"{len(row)} in data row {number} of {file!r}."
                )


def _skip(text: TextIO, lines: int, separator: str) -> Iterator[list[str]]:
    """Read a file up to the end of its header, and return an iterator over the rows that follow."""
    rows = csv.reader(text, delimiter=separator, skipinitialspace=True)
    while rows.line_num < lines:
        next(rows)
    return rows


def _place(file: Path, names: list[str], column: str) -> int:
    _checks.one_of(f"column of {file.name}", column, names)
    if (count := names.count(column)) > 1:
        places = [i + 1 for i, name in enumerate(names) if name == column]
        raise ValueError(
            f"column of {file.name}: must be the name of one column, got {column!r}, the name of {count} "
            f"(columns {', '.join(map(str, places))}); rename them in the file."
        )
    return names.index(column)


def _npz_columns(file: Path, wanted: list[str]) -> Stored:
    """Return names and wanted arrays of an NPZ file; whole members are read, because only they have a checksum."""
    arrays = {}
    with zipfile.ZipFile(file) as archive:
        members = [(member, member.filename.removesuffix(".npy")) for member in archive.infolist()]
        for member, name in members:
            if name not in wanted:
                continue
            if name in arrays:
                raise ValueError(f"it has two arrays {name!r}")
            _check_size(name, member.file_size)
            content = io.BytesIO(archive.read(member))
            arrays[name] = np.lib.format.read_array(content, allow_pickle=False)
            if content.read(1):
                raise ValueError(f"its array {name!r} has another size than its header says")
    return [name for _, name in members], arrays


def _mat_columns(file: Path, wanted: list[str]) -> Stored:
    """Return names and wanted arrays of a MAT file, version 5 or 7.3."""
    import h5py

    return (_hdf5_columns if h5py.is_hdf5(file) else _mat5_columns)(file, wanted)


def _hdf5_columns(file: Path, wanted: list[str]) -> Stored:
    """Return names and wanted arrays of a MAT file, version 7.3."""
    import h5py

    from bayesperiodic import _hdf5

    arrays = {}
    with h5py.File(file, "r") as archive:
        names = [name for name in archive if isinstance(name, str)]  # bytes are no text
        for name in {*wanted} & {*names}:
            item = _hdf5.dataset(archive, name)
            kind = np.bytes_(item.attrs.get("MATLAB_class", b"double")).decode()
            if kind not in (*NUMERIC.values(), "logical") or item.attrs.get("MATLAB_empty"):
                raise ValueError(f"its variable {name!r} is empty or no array of numbers, but {kind}")
            arrays[name] = _hdf5.values(item, LARGEST_ARRAY, OTHERWISE)
    return names, arrays


def _mat5_columns(file: Path, wanted: list[str]) -> Stored:
    """Return names and wanted arrays of a MAT file, version 5, after MathWorks' "MAT-File Format".

    scipy.io.loadmat ends the process with a segmentation fault for some damaged files.
    """
    content = file.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("it has no header of version 5; an older version is converted by save('-v7') in MATLAB")
    names, arrays = [], {}
    for kind, data in _elements(memoryview(content)[128:], order):
        stream = zlib.decompressobj()
        if compressed := kind == COMPRESSED:
            data = memoryview(stream.decompress(data, HEADER_BYTES))[8:]
        elif kind != MAT_MATRIX:
            raise ValueError(f"it contains an element of type {kind}")
        name, *_ = _variable(data, order)
        names.append(name)
        if name not in wanted:
            continue
        if name in arrays:
            raise ValueError(f"it has two variables {name!r}")
        if compressed:
            data = memoryview(bytes(data) + stream.decompress(stream.unconsumed_tail, LARGEST_ARRAY))
            if not stream.eof:
                raise ValueError(
                    f"its variable {name!r} is cut off or has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}"
                )
        arrays[name] = _array(*_variable(data, order), order)
    return names, arrays


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


NPZ = Format(
    "an NPZ file of named arrays (numpy.savez) without pickled objects, or be read by from_csv or from_mat",
    _npz_columns,
)
MAT = Format("a MAT file of version 5 or 7.3", _mat_columns)


def _check_size(name: str, size: int) -> None:
    if size > LARGEST_ARRAY:
        raise ValueError(f"its array {name!r} has more than {LARGEST_ARRAY / 1e9:.3g} GB; {OTHERWISE}")


def existing(path: str | Path) -> Path:
    """Return the path; raise a FileNotFoundError if there is no such file."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: must be an existing file, got {str(path)!r}.")
    return file


def _is_no_header(names: list[str]) -> bool:
    """Return whether a first line contains numbers, or separators other than commas."""
    if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
        return True
    try:
        return bool([float(name) for name in names])
    except ValueError:
        return False
