"""The table of a file's contents, its command, and optional packages."""

import subprocess
import sys

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic import __main__ as command
from bayesperiodic.data.formats import contents

LINES = "Rig 3\nt;x;note\nms;mm;\n0,0;1,5;a\n1,0;-1,7;b\n2,0;1,6;c\n"


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "lab run.csv"
    file.write_text(LINES)
    return file


def test_table_has_channels_units_ranges_remarks_and_a_call_that_runs(path):
    seen = bp.inspect(path)
    t, x, note = seen.channels
    assert (t.unit, x.unit, x.samples, x.low, x.high) == ("ms", "mm", 3, -1.7, 1.6)
    assert np.isnan(note.low) and any("text" in remark for remark in note.remarks)
    printed = str(seen)
    assert all(word in printed for word in ("lab run.csv", "channel", "unit", "range", "-1.7 to 1.6", "decimal comma"))
    assert "inputs={}, outputs={'x': 'x'}" in seen.code and "time='t'" in seen.code
    names = {"bp": bp}
    exec(seen.code, names)
    assert names["recording"].outputs["x"] == pytest.approx([1.5e-3, -1.7e-3, 1.6e-3])
    assert names["recording"].time == pytest.approx([0.0, 1e-3, 2e-3])


def test_doubtful_unit_is_remarked(tmp_path):
    (tmp_path / "run.csv").write_text("t [s],a [g],F [N]\n0,1,2\n1,2,3\n2,3,5\n")
    t, a, force = bp.inspect(tmp_path / "run.csv").channels
    assert any("units= must say what 'g' is: ('g_0', 'm/s**2')" in remark for remark in a.remarks)
    assert not any("units=" in remark for remark in (*t.remarks, *force.remarks))


def test_result_is_stored_and_loaded(path, tmp_path):
    seen = bp.inspect(path)
    seen.save(tmp_path / "seen.h5")
    assert str(bp.load(tmp_path / "seen.h5")) == str(seen)


def test_command_prints_the_same_and_reports_errors(path, capsys):
    assert command.main(["inspect", str(path)]) == 0
    assert capsys.readouterr().out.strip() == str(bp.inspect(path)).strip()
    assert command.main(["inspect", "no such file", str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith("error: path: must be an existing file") and "lab run.csv" in captured.out
    assert command.main(["inspect", str(path), "--decimal", "x"]) == 1
    assert "error: decimal: must be one of" in capsys.readouterr().err


def test_module_is_a_command(path):
    run = subprocess.run([sys.executable, "-m", "bayesperiodic", "inspect", path], capture_output=True, text=True)
    assert run.returncode == 0 and "outputs={'x': 'x'}" in run.stdout


def test_missing_package_is_named_with_the_command_that_installs_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyuff", None)
    (tmp_path / "run.uff").write_text("    -1\n    58\n")
    with pytest.raises(
        ImportError, match=r"format: must be one whose package is installed.*pyuff.*bayesperiodic\[files"
    ):
        bp.inspect(tmp_path / "run.uff")


def test_importing_the_package_imports_no_reader():
    code = (
        "import sys, bayesperiodic as bp; bp.Recording, bp.inspect\n"
        "print([n for n in ('pyuff', 'nptdms', 'asammdf', 'lvm_read', 'pyarrow', 'openpyxl') if n in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "head, message",
    [
        (b"", "which is empty"),
        (b"\x1f\x8b\x08\x00", "a compressed file .gzip.; unpack it first"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1", "an old Excel file ..xls.; save it as .xlsx"),
        (b"\x93NUMPY\x01\x00", "one array .*read it by numpy.load"),
        (b"TDSh", "an index of a TDMS file"),
    ],
)
def test_files_that_are_none_of_measurements_are_named(tmp_path, head, message):
    (tmp_path / "run.dat").write_bytes(head)
    with pytest.raises(ValueError, match=f"path: must be a file of measurements, got .*run.dat', {message}"):
        bp.inspect(tmp_path / "run.dat")


def test_unknown_format_and_foreign_arguments_are_refused(path):
    with pytest.raises(ValueError, match="format: must be one of .*, got 'cvs'. Did you mean 'csv'"):
        bp.inspect(path, format="cvs")
    with pytest.raises(ValueError, match="must be left out for 'lab run.csv', read as 'npz'"):
        bp.inspect(path, format="npz", decimal=",")


def test_names_that_repeat_get_numbers():
    assert [*contents.unique_names(["x", "x", "y", "x (2)", "x"])] == ["x", "x (2)", "y", "x (2) (2)", "x (3)"]
