"""Recognition of the format of a file by its first bytes, and its contents by the module of that format."""

import contextlib
import importlib
import re
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from bayesperiodic import _checks
from bayesperiodic.data.formats.contents import Clock, Contents, Key, existing


@dataclass(frozen=True)
class Format:
    """A format: its module in this folder, what a file must be, for errors, and the arguments that it takes."""

    module: str
    kind: str
    options: tuple[str, ...] = ()


FORMATS = {
    "csv": Format(
        "text",
        "a CSV file with a header line",
        ("encoding", "separator", "decimal", "thousands", "header", "date_format"),
    ),
    "npz": Format(
        "npz",
        "an NPZ file of named arrays (numpy.savez) without pickled objects, or be read by from_csv or from_mat",
    ),
    "mat": Format("mat", "a MAT file of version 5 or 7.3"),
    "uff": Format("uff", "a universal file with data sets 58"),
    "tdms": Format("tdms", "a TDMS file"),
    "mdf": Format("mdf", "an MDF file of version 3 or 4"),
    "lvm": Format("lvm", "a LabVIEW measurement file (.lvm)", ("encoding", "decimal")),
    "wav": Format("wav", "a WAV file of samples without compression"),
    "hdf5": Format("hdf5", "an HDF5 file"),
    "parquet": Format("parquet", "a Parquet file"),
    "excel": Format("excel", "an Excel workbook (.xlsx)", ("header", "date_format")),
}
# First bytes of files.
SIGNATURES = {
    b"TDSm": "tdms", b"MDF     ": "mdf", b"UnFinMF ": "mdf", b"PAR1": "parquet", b"RIFF": "wav", b"RIFX": "wav",
    b"RF64": "wav", b"MATLAB 5.0": "mat", b"LabVIEW Measurement": "lvm",
}  # fmt: skip
PICKLE = "a pickle of Python; load it by the program that wrote it, for from_arrays, as it is never unpickled here"
NETCDF3 = "a netCDF file of version 3; nccopy -k nc4 converts it"
# Files that no package of the extra `files` reads, and what to do with them.
OTHERS = {
    b"\xd0\xcf\x11\xe0": "an old Excel file (.xls); save it as .xlsx",
    b"\x1f\x8b": "a compressed file (gzip); unpack it first",
    b"BZh": "a compressed file (bzip2); unpack it first",
    b"\xfd7zXZ": "a compressed file (xz); unpack it first",
    b"TDSh": "an index of a TDMS file (.tdms_index); give the .tdms file beside it",
    b"ARROW1": "an Arrow or Feather file; read it by pandas.read_feather for from_dataframe",
    b"\x93NUMPY": "one array (.npy); read it by numpy.load for from_arrays",
    b"%PDF": "a PDF file",
    b"CDF\x01": NETCDF3,
    b"CDF\x02": NETCDF3,
    b"CDF\x05": NETCDF3,
    b"riff\x2e\x91\xcf\x11": "a Wave64 file (.w64); save it as .wav",
    b"fLaC": "a FLAC file; save it as .wav",
    b"\x80\x02": PICKLE,
    b"\x80\x03": PICKLE,
    b"\x80\x04": PICKLE,
    b"\x80\x05": PICKLE,
}
HDF5_SIGNATURE, MAT73 = b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3"
# Universal files begin with a line that has -1 in columns 5 and 6.
UFF_START = re.compile(rb"\s*^ {4}-1 *\r?$", re.MULTILINE)
LVM_START = re.compile(rb"(\xef\xbb\xbf)?\s*LabVIEW Measurement")
# Beginnings of messages that are complete.
COMPLETE = re.compile(r"[a-z_]+( of .{1,300}|\[.{1,300}\])?: must |[a-z]+ '.{1,300}' of ", re.DOTALL)


def contents(path: str | Path, form: str | None, wanted: Iterable[Key], options: dict[str, Any]) -> Contents:
    """Return the contents of a file of a format, by default that which its first bytes show.

    `wanted` are the keys that the caller needs, by which the header of a text is found. `options` are arguments of a
    format, None where they are left to it.
    """
    file = existing(path)
    if form is not None:
        _checks.one_of("format", form, FORMATS)
    name = form or recognised(file)
    chosen = FORMATS[name]
    given = {key: value for key, value in options.items() if value is not None}
    if other := [key for key in given if key not in chosen.options]:
        allowed = ", ".join(chosen.options) or "none of these arguments"
        raise ValueError(f"{other[0]}: must be left out for {file.name!r}, read as {name!r}, which takes {allowed}.")
    module = importlib.import_module(f"bayesperiodic.data.formats.{chosen.module}")
    with one_error(chosen.kind, path):
        whole: Contents = module.contents(file, [*wanted], **given)
    clocks = {id(one.clock): _clock(chosen.kind, path, one.clock) for one in whole.channels}
    guard = partial(partial, _guarded, chosen.kind, path)
    channels = [
        replace(
            one,
            values=guard(one.values),
            clock=clocks[id(one.clock)],
            frequencies=guard(one.frequencies) if one.frequencies else None,
        )
        for one in whole.channels
    ]
    return replace(whole, channels=tuple(channels))


def recognised(file: Path) -> str:
    """Return the name of the format of a file."""
    with file.open("rb") as content:
        head = content.read(4096)
    if not head:
        raise ValueError(f"path: must be a file of measurements, got {str(file)!r}, which is empty.")
    for start, what in OTHERS.items():
        if head.startswith(start):
            raise ValueError(f"path: must be a file of measurements, got {str(file)!r}, {what}.")
    for start, name in SIGNATURES.items():
        if head.startswith(start):
            return name
    if file.suffix.lower() == ".mat" and _is_mat4(head):
        raise ValueError(
            f"path: must be a file of measurements, got {str(file)!r}, a MAT file of version 4; load it in MATLAB, and "
            "save it by save('run.mat', '-v7')."
        )
    if head.startswith(MAT73):
        return "mat"
    if any(head[place : place + 8] == HDF5_SIGNATURE for place in (0, 512, 1024, 2048)):
        return "mat" if file.suffix.lower() == ".mat" else "hdf5"
    if head.startswith(b"PK\x03\x04"):
        return _zipped(file)
    if UFF_START.match(head):
        return "uff"
    return "lvm" if LVM_START.match(head) else "csv"


def _is_mat4(head: bytes) -> bool:
    """Return whether a file begins with a matrix of a MAT file of version 4, in either order of bytes.

    Its head is the type, the numbers of rows and columns, whether it is complex, and the length of its name.
    """
    if len(head) < 20:
        return False
    for order, machine in (("<", 0), (">", 1)):
        kind, rows, columns, is_complex, length = struct.unpack(f"{order}5i", head[:20])
        name = head[20 : 20 + length]
        plausible = kind // 1000 == machine and kind // 100 % 10 == 0 and kind // 10 % 10 <= 5 and kind % 10 <= 2
        plausible &= min(rows, columns) >= 0 and is_complex in (0, 1) and length >= 2
        if plausible and name[-1:] == b"\0":
            return True
    return False


def _zipped(file: Path) -> str:
    """Return whether a ZIP file is a workbook or holds arrays."""
    with one_error("a file of measurements", file), zipfile.ZipFile(file) as archive:
        names = archive.namelist()
    if any(name.startswith("xl/") for name in names):
        return "excel"
    if names and all(name.endswith(".npy") for name in names):
        return "npz"
    raise ValueError(
        f"path: must be a file of measurements, got {str(file)!r}, a ZIP archive that is no workbook and has no arrays "
        "of NumPy; unpack it first."
    )


def _clock(kind: str, path: str | Path, clock: Clock | None) -> Clock | None:
    """Return a clock, of whose stored times any error is one of the file."""
    if clock is None or clock.stored is None:
        return clock
    return replace(clock, stored=partial(_guarded, kind, path, clock.stored))


def _guarded(kind: str, path: str | Path, read: Callable[[], Any]) -> Any:
    """Return values of a file; any error is one of the file."""
    with one_error(kind, path):
        return read()


@contextlib.contextmanager
def one_error(kind: str, path: str | Path) -> Iterator[None]:
    """Raise whatever a package raises for a damaged file as one ValueError, and complete messages as they are."""
    try:
        yield
    except ImportError:
        raise
    except Exception as error:
        if isinstance(error, ValueError) and COMPLETE.match(str(error)):
            raise
        reason = error if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        raise ValueError(f"path: must be {kind}, got {str(path)!r} ({reason}).") from None
