"""What all readers have in common: each file is called by its format, and its channels by the word of the format."""

import io
import re
import sys

import h5py
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import excel, lvm, mdf, parquet, tdms, uff
from tests.data.formats import test_excel, test_lvm, test_mdf, test_parquet, test_tdms, test_uff, test_wav
from tests.data.test_damaged_files import saved


def hdf5():
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file["x"] = np.arange(5.0)
    return content.getvalue()


FILES = {
    "TDMS file": ("tdms", test_tdms.channel(test_tdms.X, wf_increment=0.01), "channel"),
    "MDF file": ("mf4", test_mdf.simple(), "channel"),
    "universal file": ("uff", test_uff.function(), "channel"),
    "WAV file": ("wav", test_wav.wav(), "channel"),
    "LabVIEW measurement file": ("lvm", (test_lvm.head() + test_lvm.segment()).encode("latin-1"), "channel"),
    "HDF5 file": ("h5", hdf5(), "channel"),
    "MAT file": ("mat", saved("mat 5"), "column"),
    "NPZ file": ("npz", saved("npz"), "column"),
    "CSV file": ("csv", b"t,x\n0,1\n1,2\n", "column"),
    "Excel workbook": ("xlsx", test_excel.workbook({"run": [["t", "x"], [0, 1.5], [1, 2.5]]}), "column"),
    "Parquet file": ("parquet", test_parquet.by_hand({b"t": test_parquet.TIME, b"x": test_parquet.X}), "column"),
}


@pytest.mark.parametrize("kind", FILES)
def test_files_are_called_by_their_format_and_their_channels_by_its_word(tmp_path, kind):
    ending, content, word = FILES[kind]
    path = tmp_path / f"run.{ending}"
    path.write_bytes(content)
    assert str(bp.inspect(path)).startswith(f"{kind} {str(path)!r}, ")
    with pytest.raises(ValueError, match=f"^{word} of run.{ending}: must be (one of )?'.*', got 'no such'"):
        bp.Recording.from_file(path, sampling_rate=1.0, outputs={"x": "no such"})
    with pytest.raises(ValueError, match=f"^{word} of run.{ending}: must be a number from 1 to "):
        bp.Recording.from_file(path, sampling_rate=1.0, outputs={"x": 99})


PACKAGES = [
    (tdms.contents, "nptdms", "TDMS files, which is read by npTDMS"),
    (mdf.contents, "asammdf", "MDF files, which is read by asammdf"),
    (uff.contents, "pyuff", "universal files, which is read by pyuff"),
    (lvm.contents, "lvm_read", "LabVIEW measurement files, which is read by lvm-read"),
    (excel.contents, "openpyxl", "Excel workbooks, which is read by openpyxl"),
    (parquet.contents, "pyarrow.parquet", "Parquet files, which is read by PyArrow"),
]


@pytest.mark.parametrize("contents, module, message", PACKAGES)
def test_package_of_a_format_that_is_missing_is_named(tmp_path, monkeypatch, contents, module, message):
    path = tmp_path / "run"
    path.write_bytes(test_excel.workbook({"run": [["t", "x"], [0, 1.5], [1, 2.5]]}))
    monkeypatch.setitem(sys.modules, module, None)
    start = f"format: must be one whose package is installed, got {message} (import of {module} halted"
    with pytest.raises(ImportError, match=f'^{re.escape(start)}.*; pip install "bayesperiodic.files.".$'):
        contents(path, [])
