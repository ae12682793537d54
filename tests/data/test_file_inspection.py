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


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_units_of_names_are_written_into_the_call(ending, tmp_path):
    """Times by a name with its unit; a name such as v_mm_s says a quotient. The call is run."""
    file = tmp_path / f"run{ending}"
    columns = {"time_ms": [0, 1, 3], "x_mm": [2.0, 3.0, 2.5], "v_mm_s": [5.0, 6.0, 7.0], "F_kN": [1.0, 2.0, 3.0]}
    columns |= {"F_N": [4.0, 5.0, 6.0], "n_max": [1.0, 2.0, 3.0]}
    if ending == ".npz":
        np.savez(file, **columns)
    else:
        file.write_text("\n".join(",".join(map(str, row)) for row in (columns, *zip(*columns.values(), strict=True))))
    names = {"bp": bp}
    exec(bp.inspect(file).code, names)
    run = names["recording"]
    assert run.time == pytest.approx([0.0, 1e-3, 3e-3])
    expected = {"x_mm": [2e-3, 3e-3, 2.5e-3], "v_mm_s": [5e-3, 6e-3, 7e-3], "f_kn": [1e3, 2e3, 3e3]}
    expected |= {"f_n": [4.0, 5.0, 6.0], "n_max": [1.0, 2.0, 3.0]}
    assert {name: values.tolist() for name, values in run.outputs.items()} == {
        name: pytest.approx(values) for name, values in expected.items()
    }


@pytest.mark.parametrize("name", ["t_max", "temperature", "times_x", "time_of_flight", "tempo_mm"])
def test_other_names_are_no_times(name, tmp_path):
    np.savez(tmp_path / "run.npz", **{name: [1.0, 2.0, 3.0], "x": [1.0, 2.0, 1.0]})
    assert "sampling_rate=…" in bp.inspect(tmp_path / "run.npz").code


def test_names_of_times_that_do_not_increase_are_no_times(tmp_path):
    np.savez(tmp_path / "run.npz", t=[1.0, 2.0, 2.0], x=[1.0, 2.0, 1.0])
    assert "sampling_rate=…" in bp.inspect(tmp_path / "run.npz").code


def test_call_of_a_table_of_responses_reads_it(tmp_path):
    """Frequencies without times; phases by their unit, of the other sign if the name says that they are lags."""
    (tmp_path / "fig.csv").write_text("f / Hz;X / mm;phase lag / deg\n6,5;1,5;2\n7;2,5;10\n7,5;2;90\n")
    code = bp.inspect(tmp_path / "fig.csv").code
    assert "lag=True" in code
    names = {"bp": bp}
    exec(code.replace("{…: …}", "{'force': 3.0}"), names)
    runs = names["runs"]
    assert [run.frequency for run in runs] == [6.5, 7.0, 7.5]
    c = [complex(run.outputs["x_mm"] @ np.exp(-2j * np.pi * np.arange(run.samples) / run.samples)) for run in runs]
    assert np.degrees(np.angle(c)) == pytest.approx([-2.0, -10.0, -90.0])
    assert 2 * np.abs(c) / runs[0].samples == pytest.approx([1.5e-3, 2.5e-3, 2e-3])
    (tmp_path / "run.csv").write_text("f / Hz;X / mm;phi / deg\n6,5;1,5;-2\n7;2,5;-10\n")
    assert "lag" not in bp.inspect(tmp_path / "run.csv").code


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
