"""Recognition of files by their first bytes, contents of all formats, and numbers of few digits."""

import io
import re
import struct
import zipfile

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import contents, encodings, npz, recognise
from bayesperiodic.data.formats.contents import Clock, Contents, StoredChannel
from bayesperiodic.data.formats.decimals import decimal_error, step_error

HDF5 = b"\x89HDF\r\n\x1a\n"
MAT4 = struct.pack("<5i", 0, 2, 3, 0, 2) + b"x\0" + bytes(48)


def zipped(*names):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name in names:
            archive.writestr(name, "1")
    return content.getvalue()


@pytest.mark.parametrize(
    "name, content, form",
    [
        ("a", b"TDSm...", "tdms"), ("a", b"MDF     4.10", "mdf"), ("a", b"UnFinMF ", "mdf"), ("a", b"PAR1", "parquet"),
        ("a", b"RIFF", "wav"), ("a", b"RF64", "wav"), ("a", b"MATLAB 5.0 MAT-file", "mat"), ("a", b"MATLAB 7.3", "mat"),
        ("a", b"LabVIEW Measurement\t", "lvm"), ("a", b"\xef\xbb\xbf LabVIEW Measurement", "lvm"), ("a", HDF5, "hdf5"),
        ("a.mat", HDF5, "mat"), ("a.MAT", bytes(512) + HDF5, "mat"), ("a", bytes(1024) + HDF5, "hdf5"),
        ("a", bytes(2048) + HDF5, "hdf5"), ("a", bytes(256) + HDF5, "csv"), ("a", b"    -1\n    58\n", "uff"),
        ("a", b"\r\n\r\n    -1  \r\n    58", "uff"), ("a", b"   -1\n", "csv"), ("a", b"    -1 2\n", "csv"),
        ("a", b"\n" * 4090 + b"    -1\n", "uff"), ("a", b"\n" * 4091 + b"    -1\n", "csv"),
        ("a", zipped("a.npy", "b.npy"), "npz"), ("a", zipped("xl/workbook.xml", "b"), "excel"), ("a", b"t,x\n", "csv"),
        ("a.dat", MAT4, "csv"), ("a.mat", b"t,x\n0,1\n", "csv"), ("a.mat", MAT4[:19], "csv"),
        ("a.mat", struct.pack("<5i", 0, 2, 3, 0, 2) + b"xy", "csv"),
        ("a.mat", struct.pack("<5i", 0, -1, 3, 0, 2) + b"x\0", "csv"),
        ("a.mat", struct.pack("<5i", 0, 2, 3, 2, 2) + b"x\0", "csv"),
        ("a.mat", struct.pack("<5i", 60, 2, 3, 0, 2) + b"x\0", "csv"),
        ("a.mat", struct.pack("<5i", 3, 2, 3, 0, 2) + b"x\0", "csv"),
        ("a.mat", struct.pack("<5i", 100, 2, 3, 0, 2) + b"x\0", "csv"),
        ("a.mat", struct.pack("<5i", 0, 2, 3, 0, 1) + b"\0", "csv"),
    ],
)  # fmt: skip
def test_formats_are_recognised_by_their_first_bytes(tmp_path, name, content, form):
    path = tmp_path / name
    path.write_bytes(content)
    assert recognise.recognised(path) == form


@pytest.mark.parametrize(
    "name, content, what",
    [
        ("a", b"", "which is empty."), ("a", b"\x1f\x8b\x08", "a compressed file (gzip); unpack it first."),
        ("a", b"\xd0\xcf\x11\xe0", "an old Excel file (.xls); save it as .xlsx."),
        ("a", b"\x80\x04", "a pickle of Python; "),
        ("a", b"\x93NUMPY", "one array (.npy); read it by numpy.load for from_arrays."),
        ("a.mat", MAT4, "a MAT file of "
        "version 4; load it in MATLAB, and save it by save('run.mat', '-v7')."),
        ("a.mat", struct.pack(">5i", 1000, 2, 3, 1,
        2) + b"x\0", "a MAT file of version 4;"),
        ("a.mat", struct.pack("<5i", 52, 0, 3, 1, 2) + b"x\0", "a MAT file of"),
        ("a", zipped("a.npy", "b.txt"),
         "a ZIP archive that is no workbook and has no arrays of NumPy; unpack it first."),
    ],
)  # fmt: skip
def test_other_files_are_refused_with_what_they_are(tmp_path, name, content, what):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(f"path: must be a file of measurements, got {str(path)!r}, {what}")):
        bp.inspect(path)


def test_file_that_does_not_exist_or_arguments_of_other_formats_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="path: must be an existing file, got '.*no.csv'."):
        bp.inspect(tmp_path / "no.csv")
    with pytest.raises(FileNotFoundError, match="path: must be an existing file"):
        bp.inspect(tmp_path)
    path = tmp_path / "run.csv"
    path.write_text("t,x\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="format: must be one of .*, got 'text'"):
        bp.inspect(path, format="text")
    np.savez(tmp_path / "run.npz", t=np.arange(3.0))
    with pytest.raises(
        ValueError, match="^decimal: must be left out for 'run.npz', read as 'npz', which takes none of thes"
    ):
        bp.inspect(tmp_path / "run.npz", decimal=",")
    path.write_bytes(b"LabVIEW Measurement\t\n")
    with pytest.raises(
        ValueError, match="^header: must be left out for 'run.csv', read as 'lvm', which takes encoding, dec"
    ):
        bp.inspect(path, header=1)


def raised(error):
    with recognise.one_error("a file of a kind", "run.x"):
        raise error


@pytest.mark.parametrize(
    "error, message",
    [
        (ValueError("it is cut off"), "path: must be a file of a kind, got 'run.x' (it is cut off)."),
        (KeyError("a"), "path: must be a file of a kind, got 'run.x' (KeyError: 'a')."),
        (ValueError("x: must be 1"), "x: must be 1"),
        (ValueError("x['a']: must be 1"), "x['a']: must be 1"),
        (ValueError("column of run.csv: must be 1"), "column of run.csv: must be 1"),
        (ValueError("column 'x' of run.csv"), "column 'x' of run.csv"),
        (TypeError("x: must be 1"), "path: must be a file of a kind, got 'run.x' (TypeError: x: must be 1)."),
    ],
)
def test_any_error_of_a_package_is_one_of_the_file(error, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        raised(error)
    with pytest.raises(ImportError, match="^missing$"):
        raised(ImportError("missing"))


def test_package_that_is_not_installed_is_named_with_its_extra():
    with pytest.raises(
        ImportError, match=r"got odd files, which is read by Odd \(No module.*pip install \"bayesperiodic.files"
    ):
        contents.package("no_such_module", "Odd", "odd files")


CHANNELS = tuple(StoredChannel(name, 1, np.zeros, group) for name, group in (("x", "a"), ("x", "b"), ("y", "")))


@pytest.mark.parametrize("key, place", [(1, 0), (3, 2), (("a", "x"), 0), (["b", "x"], 1), ("y", 2), (("", "y"), 2)])
def test_channels_are_found_by_name_number_or_group(key, place):
    assert Contents("a file", CHANNELS).find("run.x", key) is CHANNELS[place]


@pytest.mark.parametrize(
    "key, message",
    [
        (0, "channel of run.x: must be a number from 1 to 3, got 0."), (4, "must be a number from 1 to 3, got 4."),
        (("c", "x"), "channel of run.x: must be one of ('a', 'x'), ('b', 'x'), ('', 'y'), got ('c', 'x')."),
        ("x", "channel of run.x: must be the name of one channel, got 'x', the name of 2; give the group too: ('a', "
              "'x'), ('b', 'x')."), ("z", "channel of run.x: must be one of 'x', 'x', 'y', got 'z'"),
              (True, "must be one of"),
    ],
)  # fmt: skip
def test_other_keys_are_refused_with_those_that_are_there(key, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Contents("a file", CHANNELS).find("run.x", key)


def test_numbers_may_be_names_and_labels_have_the_group():
    one = Contents("a file", (StoredChannel("1", 1, np.zeros), *CHANNELS), numbered=False)
    assert one.find("run.x", 1).name == "1" and [channel.label for channel in CHANNELS] == ["a/x", "b/x", "y"]
    assert Clock(start=2.0, step=0.5).times(3).tolist() == [2.0, 2.5, 3.0]
    assert Clock(start=2.0, step=0.5, stored=lambda: np.arange(2)).times(3).tolist() == [0, 1]


@pytest.mark.parametrize(
    "text, half", [("1.95313E-05", 5e-11), ("0.25", 5e-3), ("100", 0.5), ("1.5D-3", 5e-5), (" +2. ", 0.5), (".5", 0.05)]
)
def test_error_of_a_decimal_number_is_half_a_unit_of_its_last_digit(text, half):
    assert half < decimal_error(text) < 1.001 * half


@pytest.mark.parametrize(
    "text, error",
    [
        ("0.0025", 0), ("0.00250000", 0), ("0.00390625", 0), ("1.953125E-05", 0), ("1.95313E-05", 5e-11), ("0.0333", 0),
        ("0.03333", 5e-6), ("0", 0), ("-0.03333", 0), ("0.00122", 0), ("0.001221", 5e-7), ("0.0008192", 5e-8),
        ("1E3", 0),
    ],
)  # fmt: skip
def test_steps_of_three_digits_and_reciprocals_of_six_are_exact(text, error):
    """1/0.0008192 is 1220.703125, of ten digits; 1/0.00390625 is 256."""
    assert step_error(text) == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize("text", ["", "x", "1,5", "1e", "0x5", "nan", "1.5 s"])
def test_texts_that_are_no_numbers_are_named(text):
    with pytest.raises(ValueError, match=f"^{re.escape(repr(text.strip()))} is no number$"):
        step_error(text)


@pytest.mark.parametrize(
    "content, encoding, remark",
    [
        (b"t,x\n", "utf-8", ""), ("t,µ\n".encode(), "utf-8", ""),
        ("t,µ".encode("utf-16"), "utf-16", "by its byte order"),
        ("t,µ".encode("utf-32"), "utf-32", "by its byte order"),
        (b"\xef\xbb\xbft,x", "utf-8", "'utf-8', by its byte order"),
        ("t,µ\n".encode("cp1252"), "cp1252", "read as the characters 'µ': if they are others"),
        ("€ äöüßÄÖÜé\n".encode("cp1252"), "cp1252",
         "'€', 'Ä', 'Ö', 'Ü', 'ß', 'ä', 'é', 'ö': if they are others, give enc"),
    ],
)  # fmt: skip
def test_encoding_is_that_of_the_bytes(tmp_path, content, encoding, remark):
    """The first eight characters are shown."""
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    text = encodings.opened(path, None)
    assert (
        (text.encoding, repr(text)) == (encoding, repr(str(path)))
        and remark in text.remark
        and bool(remark) == bool(text.remark)
    )
    with text.open() as lines:
        assert lines.read() == content.decode("utf-8-sig" if encoding == "utf-8" else encoding)
    given = encodings.opened(path, encoding)
    assert given.remark == f"encoding {encoding!r}, as given"


@pytest.mark.parametrize(
    "content, encoding, line, byte",
    [
        ("µ,x\n0,1\n".encode() + b"\xb0\n", None, 3, "b0"), ("µ".encode()[:1] + b"\nt\n", "utf-8", 1, "c2"),
        (b"t\n\n\n\x81", "cp1252", 4, "81"), (b"t,x\n\xff", "ascii", 2, "ff"), (b"t\n0,1\n\x81\xc2\xb5", None, 3, "81"),
    ],
)  # fmt: skip
def test_byte_that_is_not_in_the_encoding_is_named_with_its_line(tmp_path, content, encoding, line, byte):
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    name = "UTF-8" if encoding in (None, "utf-8") else encoding
    message = f"path: must be a CSV file in {name}, got .*, whose line {line} has the byte 0x{byte}; it may"
    with pytest.raises(ValueError, match=message):
        encodings.opened(path, encoding)


@pytest.mark.parametrize("content, last", [
    (b"t\n# a\n0\n", 2), (b"# a\n", 1), (b"t # a\n", 0), (b"t\n #N/A\n", 0), (b"t\n \t# a", 2), (b"a\r# b\r\n# c", 2),
    (b"a\n\n\n#", 4), ("µ\n#".encode("utf-16"), 2),
])  # fmt: skip
def test_last_comment_is_that_line_that_begins_with_its_mark(tmp_path, content, last):
    """Lines are counted by line feeds, and the mark of N/A is none of a comment."""
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    assert encodings.opened(path, None).last_comment == last


@pytest.mark.parametrize("part", [2, 3, 5, 64])
def test_texts_are_checked_alike_in_parts_of_any_size(tmp_path, part, monkeypatch):
    path = tmp_path / "run.csv"
    path.write_bytes("µ\n0 1\n#a\n  # b\nc\n".encode())
    monkeypatch.setattr(encodings, "PART_BYTES", part)
    text = encodings.opened(path, None)
    assert (text.last_comment, text.encoding) == (4, "utf-8") and text.blanks == (part < 64)
    path.write_bytes(b"0\n1\n2\n\xb5")
    assert encodings.opened(path, None).encoding == "cp1252"
    with pytest.raises(ValueError, match="whose line 4 has the byte 0xb5"):
        encodings.opened(path, "utf-8")


def test_arrays_of_an_npz_file_have_the_sizes_of_their_headers(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, t=np.arange(3.0), x=np.zeros((2, 4)), o=np.array([None], dtype=object))
    whole = npz.contents(path, [])
    assert [(one.name, one.samples) for one in whole.channels] == [("t", 3), ("x", 8), ("o", 1)]
    assert whole.word == "column" and whole.kind == "NPZ file"
    with pytest.raises(ValueError, match="Object arrays cannot be loaded"):
        whole.channels[2].values()
    with pytest.warns(UserWarning, match="format 3.0"):
        np.savez(path, t=np.zeros(3, dtype=[("Ω", "f8")]))
    with pytest.raises(ValueError, match="it is a table with named columns"):
        npz.contents(path, []).channels[0].values()
    assert npz.contents(path, []).channels[0].samples == 0


def test_a_damaged_archive_is_no_file_of_measurements(tmp_path):
    path = tmp_path / "run.zip"
    path.write_bytes(b"PK\x03\x04 and no directory")
    with pytest.raises(ValueError, match="^path: must be a file of measurements, got '.*run.zip' .BadZipFile: "):
        recognise.contents(path, None, [], {})
