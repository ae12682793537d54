"""Damaged and crafted files are refused by one error that names the file; parts of them are never read as the whole."""

import io
import os
import pickle
import struct
import subprocess
import sys
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import scipy.io

import bayesperiodic as bp
from bayesperiodic.data.formats import mat, npz, text

TIME = np.arange(200) / 50
COLUMNS = {"t": TIME, "x": 3.0 * np.sin(TIME), "F": np.cos(TIME)}
CHANNELS = {"time": "t", "outputs": {"force": "F"}, "inputs": {"displacement": "x"}}
OTHERS = {"s": {"a": 1, "b": {"c": [1, 2, 3]}}, "cell": np.array([1, "a", [2.0]], dtype=object), "z": 1j * TIME}


def saved(kind, columns=COLUMNS):
    """Return the bytes of a file."""
    content = io.BytesIO()
    if kind.startswith("npz"):
        (np.savez_compressed if kind == "npz compressed" else np.savez)(content, **columns)
    elif kind.startswith("mat 5"):
        scipy.io.savemat(content, columns, do_compression=kind == "mat 5 compressed")
    elif kind.startswith("mat 7.3"):
        with h5py.File(content, "w", userblock_size=512) as file:
            for name, values in columns.items():
                file.create_dataset(name, data=values[None], compression="gzip" if "compressed" in kind else None)
    else:
        np.savetxt(content, np.transpose([*columns.values()]), delimiter=",", header=",".join(columns), comments="")
    return content.getvalue()


def read(path, kind):
    reader = {"npz": bp.Recording.from_npz, "mat": bp.Recording.from_mat, "csv": bp.Recording.from_csv}[kind[:3]]
    return reader(path, **CHANNELS)


def damaged(whole, generator):
    """Return a file cut off, with changed bytes or bits, or with a part left out, repeated or overwritten."""
    content, how = bytearray(whole), generator.integers(6)
    start, end = sorted(map(int, generator.integers(len(content), size=2)))
    if how == 0:
        return bytes(content[:end])
    if how == 1:
        for place in generator.integers(len(content), size=generator.integers(1, 20)):
            content[place] = generator.integers(256)
    elif how == 2:
        content[start] ^= 1 << int(generator.integers(8))
    elif how == 3:
        content[start : start + 64] = generator.bytes(len(content[start : start + 64]))
    elif how == 4:
        content[start : start + 4] = bytes([generator.choice([0, 0x7F, 0x80, 0xFF])]) * len(content[start : start + 4])
    else:
        content = content[:start] + content[end:] if generator.uniform() < 0.5 else content[:end] + content[start:]
    return bytes(content)


# Files whose data have checksums.
SEALED = ("npz", "npz compressed", "mat 5 compressed")


@pytest.mark.parametrize("kind", [*SEALED, "mat 5", "mat 7.3", "mat 7.3 compressed", "csv"])
def test_damaged_file_is_refused_or_read_as_a_whole(tmp_path, kind):
    """A changed digit of a file without checksums cannot be noticed, a missing part can."""
    whole, generator = saved(kind), np.random.default_rng(len(kind))
    path = tmp_path / "run 7"
    for _ in range(200):
        path.write_bytes(damaged(whole, generator))
        try:
            recording = read(path, kind)
        except ValueError as error:
            assert "run 7" in str(error) and "must" in str(error)
            continue
        if kind in SEALED:
            assert np.array_equal(recording.time, TIME) and np.array_equal(recording.outputs["force"], COLUMNS["F"])
        assert kind == "csv" or recording.time.size == 200


SURVIVOR = """
import sys, warnings
import bayesperiodic as bp
from tests.data.test_damaged_files import CHANNELS, damaged, saved
import numpy as np
whole, generator = saved("mat 5"), np.random.default_rng(2)
for _ in range(600):
    open("run.mat", "wb").write(damaged(whole, generator))
    try:
        bp.Recording.from_mat("run.mat", **CHANNELS)
    except ValueError:
        pass
"""


def test_no_damaged_mat_file_ends_the_process(tmp_path):
    """One in some 200 of these files is a segmentation fault in scipy.io.loadmat."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(os.path.abspath(path or ".") for path in sys.path)}
    done = subprocess.run([sys.executable, "-c", SURVIVOR], cwd=tmp_path, env=environment, capture_output=True)
    assert done.returncode == 0


class Payload:
    """An object that leaves a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickled_payload_is_not_executed(tmp_path):
    trace, path = tmp_path / "executed", tmp_path / "run.npz"
    np.savez(path, **COLUMNS | {"F": np.array([Payload(trace)] * 200, dtype=object)})
    with pytest.raises(ValueError, match="must be an NPZ file .* without pickled objects, .*run.npz"):
        bp.Recording.from_npz(path, **CHANNELS)
    path.write_bytes(pickle.dumps(Payload(trace)))
    for reader in (bp.Recording.from_npz, bp.Recording.from_mat, bp.Recording.from_csv):
        with pytest.raises(ValueError, match="path: must be .*run.npz"):
            reader(path, **CHANNELS)
    assert not trace.exists()


@pytest.mark.parametrize("kind", ["npz compressed", "mat 5 compressed", "mat 7.3 compressed"])
def test_file_that_unpacks_to_more_than_the_limit_is_refused(tmp_path, kind, monkeypatch):
    """The limit is 2 GB; here it is lowered instead of a file of that size."""
    path = tmp_path / "bomb"
    path.write_bytes(saved(kind, COLUMNS | {"F": np.zeros(1_000_000)}))
    assert path.stat().st_size < 50_000
    for module in (mat, npz):
        monkeypatch.setattr(module, "LARGEST_ARRAY", 7_000_000)
    with pytest.raises(ValueError, match=r"path: must be .*bomb.* more than 0\.007 GB"):
        read(path, kind)


@pytest.mark.parametrize("rows", [100, 201, 10**12, -1])
def test_header_with_another_size_is_refused(tmp_path, rows):
    whole = saved("npz")
    path = tmp_path / "run.npz"
    with zipfile.ZipFile(io.BytesIO(whole)) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b"(200,)", f"({rows},)".encode()))
    with pytest.raises(ValueError, match="path: must be an NPZ file .*run.npz"):
        bp.Recording.from_npz(path, **CHANNELS)
    path.write_bytes(saved("mat 5").replace(struct.pack("<ii", 1, 200), struct.pack("<ii", 1, max(rows % 2**31, 0))))
    with pytest.raises(ValueError, match="path: must be a MAT file .*run.npz.*another size than its header says"):
        bp.Recording.from_mat(path, **CHANNELS)


def test_two_arrays_of_one_name_are_refused(tmp_path):
    path = tmp_path / "run"
    with zipfile.ZipFile(path, "w") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        for name, values in (*COLUMNS.items(), ("x", TIME)):
            content = io.BytesIO()
            np.save(content, values)
            archive.writestr(f"{name}.npy", content.getvalue())
    with pytest.raises(ValueError, match="it has two arrays 'x'"):
        bp.Recording.from_npz(path, **CHANNELS)
    whole = saved("mat 5")
    path.write_bytes(whole + whole[128:])
    with pytest.raises(ValueError, match="it has two variables 't'"):
        bp.Recording.from_mat(path, **CHANNELS)


@pytest.mark.parametrize("kind", ["mat 5", "mat 5 compressed"])
def test_other_variables_of_a_mat_file_are_skipped_or_named(tmp_path, kind):
    path = tmp_path / "run.mat"
    path.write_bytes(saved(kind, COLUMNS | OTHERS | {"n": np.arange(200, dtype=np.int16), "on": TIME > 1}))
    recording = bp.Recording.from_mat(path, time="t", outputs={"n": "n", "on": "on"})
    assert recording.outputs["n"].tolist() == list(range(200)) and recording.outputs["on"].sum() == 149
    for name in OTHERS:
        with pytest.raises(ValueError, match=f"its variable '{name}' is no array of real numbers, but"):
            bp.Recording.from_mat(path, time="t", outputs={"x": name})
    with pytest.raises(ValueError, match=r"column of run.mat: must be one of 't', .*Did you mean 'x'"):
        bp.Recording.from_mat(path, time="t", outputs={"x": "X"})


def test_mat_file_of_the_other_byte_order_is_read(tmp_path):
    """Written by hand after MathWorks' description of the format, with compressed and uncompressed elements."""

    def element(kind, content):
        return struct.pack(">II", kind, len(content)) + content + bytes(-len(content) % 8)

    def variable(name, values):
        parts = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 1, values.size))
        return element(14, parts + element(1, name.encode()) + element(9, values.astype(">f8").tobytes()))

    packed = zlib.compress(variable("F", COLUMNS["F"]))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\1\0MI"
    whole = head + variable("t", TIME) + struct.pack(">II", 15, len(packed)) + packed
    path = tmp_path / "run.mat"
    path.write_bytes(whole)
    recording = bp.Recording.from_mat(path, time="t", outputs={"force": "F"})
    assert np.array_equal(recording.time, TIME) and np.array_equal(recording.outputs["force"], COLUMNS["F"])


def test_mat_file_of_version_4_is_refused(tmp_path):
    scipy.io.savemat(tmp_path / "run.mat", COLUMNS, format="4")
    with pytest.raises(ValueError, match=r"must be a MAT file of version 5 or 7\.3, got .*converted by save"):
        bp.Recording.from_mat(tmp_path / "run.mat", **CHANNELS)


def change(file, which):
    """Change variable F of a MAT file, version 7.3."""
    if which == "text":
        file["F"].attrs["MATLAB_class"] = np.bytes_("char")
    elif which == "empty":
        file["F"].attrs["MATLAB_empty"] = 1
    elif which == "group":
        del file["F"]
        file["F/a"] = TIME
    else:
        del file["F"]
        if which == "other file":
            file["F"] = h5py.ExternalLink("secret.h5", "F")
        elif which == "bytes of another file":
            file.create_dataset("F", (1, 200), "f8", external=[("secret.h5", 0, 1600)])
        elif which == "nothing written":
            file.create_dataset("F", (1, 200), "f8")
        else:
            file.create_dataset("F", (1, 200), "f8", chunks=(1, 50))[0, :150] = 1.0


@pytest.mark.parametrize(
    "which",
    ["text", "empty", "group", "other file", "bytes of another file", "nothing written", "a part not written"],
)
def test_variable_that_is_no_array_in_the_file_is_refused(tmp_path, which):
    for name in ("run.mat", "secret.h5"):
        (tmp_path / name).write_bytes(saved("mat 7.3"))
    with h5py.File(tmp_path / "run.mat", "a") as file:
        change(file, which)
    with pytest.raises(ValueError, match="path: must be a MAT file of version 5 or 7.3, got .*run.mat.*variable 'F'"):
        bp.Recording.from_mat(tmp_path / "run.mat", **CHANNELS)


@pytest.mark.parametrize("values", [np.ones((200, 2)), TIME[:100], np.array(["a"] * 200), 1j * TIME, np.float64(3.0)])
def test_arrays_of_wrong_shape_or_type_are_refused(tmp_path, values):
    path = tmp_path / "run.npz"
    np.savez(path, **COLUMNS | {"F": values})
    with pytest.raises(
        ValueError, match=r"column 'F' of run.npz: must be one column|outputs\['force'\]: must have 200"
    ):
        bp.Recording.from_npz(path, **CHANNELS)


@pytest.mark.parametrize("place", [0, 5, 2000, -2])
def test_csv_file_with_bytes_zero_is_refused(tmp_path, place):
    """As a file system leaves them after a power failure; pandas ends a number there."""
    whole = bytearray(saved("csv"))
    whole[place] = 0
    (tmp_path / "run.csv").write_bytes(whole)
    with pytest.raises(ValueError, match="path: must be a CSV file in UTF-8, got .*run.csv.*, which contains bytes 0"):
        bp.Recording.from_csv(tmp_path / "run.csv", **CHANNELS)


def test_empty_line_of_a_single_column_is_a_missing_value(tmp_path):
    """Spreadsheets write an empty cell so; without it, all later samples were earlier by one step."""
    path = tmp_path / "run.csv"
    path.write_text("x\n1\n\n3\n4\n\n\n")
    arguments = {"sampling_rate": 1.0, "outputs": {"x": "x"}}
    with pytest.raises(ValueError, match=r"x .column 'x' of run.csv.: must be finite, got nan at index 1"):
        bp.Recording.from_csv(path, **arguments)
    recording = bp.Recording.from_csv(path, missing="drop", **arguments)
    assert recording.time.tolist() == [0.0, 2.0, 3.0] and recording.outputs["x"].tolist() == [1.0, 3.0, 4.0]
    assert bp.Recording.from_csv(path, missing="interpolate", **arguments).outputs["x"].tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize("text", ["t,x\n0,1\n0,5,nan\n", "t,x,\n0,1\n0,5,NA\n", "t,x\n0,5,nan\n0,6,nan\n"])
def test_field_without_a_name_is_refused_also_if_it_is_nan(tmp_path, text):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(ValueError, match="path: must be a CSV file with 2 fields in each row, .*got 3 in data row"):
        bp.Recording.from_csv(tmp_path / "run.csv", sampling_rate=1.0, outputs={"x": "x"})


PREAMBLE = "Messung µ-Schwinger, 20 °C\nt,x\n0,1\n0.5,2\n1,3\n"


@pytest.mark.parametrize("written", ["latin-1", "cp1252", "utf-16", "mac-roman", "cp850"])
def test_file_in_another_encoding_is_read_without_and_with_the_argument(tmp_path, written):
    """Here the letters in doubt are above the columns."""
    path, columns = tmp_path / "run.csv", {"time": "t", "outputs": {"x": "x"}}
    path.write_bytes(PREAMBLE.encode(written))
    for encoding in (None, written):
        assert bp.Recording.from_csv(path, encoding=encoding, **columns).outputs["x"].tolist() == [1.0, 2.0, 3.0]


def test_line_of_the_first_byte_of_another_encoding_is_counted(tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes("t,x,été\n".encode() + b"0,1,ok\n" * 400_000 + b"1,2,20\xb0\n")
    with pytest.raises(ValueError, match="whose line 400002 has the byte 0xb0"):
        bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"x": "x"})


@pytest.mark.parametrize("bad", ["latin-one", "base64", "", 8, "a\0b"])
def test_unknown_encoding_is_refused(tmp_path, bad):
    (tmp_path / "run.csv").write_text("t,x\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="encoding: must be one of Python's, such as 'utf-8', 'latin-1' .*, got "):
        bp.Recording.from_csv(tmp_path / "run.csv", sampling_rate=1.0, outputs={"x": "x"}, encoding=bad)


def test_text_that_ends_within_a_letter_is_refused(tmp_path):
    (tmp_path / "run.csv").write_bytes("t,x\n0,1\n1,2 µ".encode()[:-1])
    with pytest.raises(ValueError, match="must be a CSV file in UTF-8, got .*, whose line 3 has the byte 0xc2"):
        bp.Recording.from_csv(tmp_path / "run.csv", time="t", outputs={"x": "x"})


def test_message_on_a_column_of_a_wide_file_does_not_list_all(tmp_path):
    (tmp_path / "run.csv").write_text(",".join(f"c{i}" for i in range(20_000)) + "\n")
    with pytest.raises(ValueError, match=r"'c11', … \(20000 in all\), got 'c20000'. Did you mean 'c\d+'") as error:
        bp.Recording.from_csv(tmp_path / "run.csv", sampling_rate=1.0, outputs={"x": "c20000"})
    assert len(str(error.value)) < 400


def test_names_of_columns_in_another_encoding(tmp_path):
    (tmp_path / "run.csv").write_bytes("Zeit;µ\n0;1\n1;2\n".encode("latin-1"))
    recording = bp.Recording.from_csv(tmp_path / "run.csv", time="Zeit", outputs={"x": "µ"}, encoding="latin-1")
    assert recording.outputs["x"].tolist() == [1.0, 2.0]


WIDE = """
import resource, sys
import numpy as np
import bayesperiodic as bp
small, large, columns = "small.csv", "large.csv", int(sys.argv[1])
open(small, "w").write("t,x\\n0,1\\n1,2\\n")
bp.Recording.from_csv(small, time="t", outputs={"x": "x"})
with open(large, "w") as file:
    file.write(sys.argv[2].join(["t", *(f"c{i}" for i in range(1, columns))]) + "\\n")
    row = sys.argv[2].join(f"{i % 997 / 100:.4f}" for i in range(1, columns))
    for k in range(4_000_000 // columns):
        file.write(f"{k}{sys.argv[2]}{row}\\n")
    size = file.tell()
memory = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # kB on Linux
before = memory()
recording = bp.Recording.from_csv(large, time="t", outputs={"x": f"c{columns - 1}"}, inputs={"u": "c1"})
assert recording.outputs["x"][0] == (columns - 1) % 997 / 100 and recording.inputs["u"][-1] == 0.01
print((memory() - before) / size)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="measures memory as on Linux")
@pytest.mark.parametrize("columns, separator", [(20_000, ","), (5_000, "\t"), (40_000, ";")])
def test_wide_file_is_read_within_twice_its_size(tmp_path, columns, separator):
    """It was 18 times the size; a line may be longer than the longest field of the module csv."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(os.path.abspath(path or ".") for path in sys.path)}
    command = [sys.executable, "-c", WIDE, str(columns), separator]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert float(done.stdout) < 2.0


TABLES = [
    "0,1,a\n1,2,b\n", "0,1,\n1,,\n", "0,NA,a\n\n1,2,b\n\n", "0, 1 ,a\n1, 2,b\n", '0,"1",a\n1,"2","b,c"\n',
    "0,1,a\n1,2\n", "0,1,a\n1,2,b,\n", "0,1,a,\n1,2,b,\n", "0,1,a,\n1,2,b,3\n", "0,1,a\n1,2,b,c\n",
    "0,1,a\n,,\n2,3,b\n",
    "0,1,a\n , , \n", "0,x,a\n1,2,b\n", "0,1,a\r\n1,2,b\r\n", '0,1,"a\nb"\n1,2,c\n', '0,1,"a\n1,2,c\n', "", "\n\n",
    "0,1e3,a\n1,-inf,b\n", "0,1,a\n1,2,b,,,,,\n", "0,1,a\n1\n", "2026-01-31T12:00:00,1,a\n2026-01-31T12:00:01,2,b\n",
    "0,true,a\n1,false,b\n", "0,001,a\n1,2,b", "0,12345678901234567890,a\n1,2,b\n",
]  # fmt: skip


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("channel", ["x", "n"])
def test_wide_and_narrow_files_are_read_alike(tmp_path, monkeypatch, table, channel):
    (tmp_path / "run.csv").write_bytes(f"t,x,n\n{table}".encode())
    found = []
    for wide in (10**9, 0):  # as a narrow file and as a wide one
        monkeypatch.setattr(text, "NARROW_COLUMNS", wide)
        monkeypatch.setattr(text, "UNWANTED_RATIO", 0)
        try:
            run = bp.Recording.from_csv(tmp_path / "run.csv", time="t", outputs={"x": channel}, missing="drop")
            found.append((np.array(run.time).tolist(), run.outputs["x"].tolist()))
        except ValueError as error:
            found.append(str(error).split("(")[0])
    assert found[0] == found[1]
