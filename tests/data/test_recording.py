import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr

import bayesperiodic as bp

TIME = np.arange(200) / 50
FORCE, DISPLACEMENT = np.cos(TIME), 3.0 * np.sin(TIME)
CHANNELS = {"outputs": {"force": "F [N]"}, "inputs": {"displacement": "x"}}


@pytest.fixture
def csv(tmp_path):
    path = tmp_path / "run 7.csv"
    pd.DataFrame({"t": TIME, "x": DISPLACEMENT, "F [N]": FORCE, "note": "text"}).to_csv(path, index=False)
    return path


def rewrite(path, row, column, text):
    table = pd.read_csv(path, dtype=str)
    table.loc[row, column] = text
    table.to_csv(path, index=False)


def test_csv_columns_by_name_and_units_by_pair_or_factor(csv):
    recording = bp.Recording.from_csv(
        csv, time="t", **CHANNELS, units={"displacement": ("mm", "m"), "force": 2.0, "time": ("ms", "s")}
    )
    assert recording.inputs["displacement"] == pytest.approx(1e-3 * DISPLACEMENT)
    assert recording.outputs["force"] == pytest.approx(2.0 * FORCE)
    assert recording.time == pytest.approx(1e-3 * TIME)
    assert recording.name == "run 7"
    assert not recording.synthetic


def test_offset_units_are_converted_too(csv):
    recording = bp.Recording.from_csv(csv, time="t", outputs={"T": "x"}, units={"T": ("degC", "kelvin")})
    assert recording.outputs["T"] == pytest.approx(DISPLACEMENT + 273.15)


def test_sampling_rate_stands_in_for_a_time_column(csv):
    recording = bp.Recording.from_csv(csv, sampling_rate=50.0, **CHANNELS)
    assert recording.time == pytest.approx(TIME)
    assert recording.sampling_rate == pytest.approx(50.0)


def test_npz_mat5_and_mat73_give_the_same_recording(tmp_path):
    columns = {"t": TIME, "x": DISPLACEMENT, "F": FORCE}
    np.savez(tmp_path / "run.npz", **columns)
    scipy.io.savemat(tmp_path / "v5.mat", columns)
    with h5py.File(tmp_path / "v73.mat", "w") as file:
        for name, values in columns.items():
            file[name] = values[None]
    arguments = {"time": "t", "outputs": {"force": "F"}, "inputs": {"displacement": "x"}}
    for recording in (
        bp.Recording.from_npz(tmp_path / "run.npz", **arguments),
        bp.Recording.from_mat(tmp_path / "v5.mat", **arguments),
        bp.Recording.from_mat(tmp_path / "v73.mat", **arguments),
    ):
        assert np.array_equal(recording.outputs["force"], FORCE)
        assert np.array_equal(recording.inputs["displacement"], DISPLACEMENT)


def test_pickled_npz_is_refused(tmp_path):
    np.savez(tmp_path / "run.npz", t=TIME, F=np.array([{}] * 200, dtype=object))
    with pytest.raises(ValueError, match="pickled"):
        bp.Recording.from_npz(tmp_path / "run.npz", time="t", outputs={"force": "F"})


def test_error_for_other_files_names_the_right_reader(csv, tmp_path):
    with pytest.raises(ValueError, match=r"must be an NPZ file without .* a CSV or MAT file by from_csv or from_mat"):
        bp.Recording.from_npz(csv, time="t", **CHANNELS)
    np.save(tmp_path / "force.npy", FORCE)
    with pytest.raises(ValueError, match=r"must be an NPZ file of named arrays .numpy\.savez., got"):
        bp.Recording.from_npz(tmp_path / "force.npy", sampling_rate=50.0, outputs={"force": "force"})


@pytest.mark.parametrize("text", ["t;x;F\n0,5;1,5;2,5\n1,0;1,0;2,0\n", "t\tx\n0\t1\n1\t2\n", "0.0,1.5\n0.1,2.5\n"])
def test_error_for_csv_without_commas_or_header_states_the_expected_format(tmp_path, text):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(
        ValueError, match=r"whose first line names the columns, separated by commas, got .* first line is read as"
    ):
        bp.Recording.from_csv(tmp_path / "run.csv", time="t", outputs={"x": "x"})


def test_numbers_may_be_names_of_columns(tmp_path):
    pd.DataFrame({0: TIME, 1: FORCE}).to_csv(tmp_path / "run.csv", index=False)
    recording = bp.Recording.from_csv(tmp_path / "run.csv", time="0", outputs={"force": "1"})
    assert recording.outputs["force"] == pytest.approx(FORCE)


def test_error_for_channels_that_are_no_mapping_gives_an_example(csv):
    with pytest.raises(ValueError, match="outputs: must be a mapping, such as .*got 'x'"):
        bp.Recording.from_csv(csv, time="t", outputs="x")
    with pytest.raises(ValueError, match="inputs: must be a mapping, .*"):
        bp.Recording.from_arrays(TIME, {"force": FORCE}, DISPLACEMENT)
    with pytest.raises(ValueError, match="outputs: must be a mapping, .*"):
        bp.Experiment("run", 1.0, DISPLACEMENT, samples=TIME.size)


def test_arrays_may_be_pandas_or_xarray():
    recording = bp.Recording.from_arrays(
        pd.Series(TIME), {"force": xr.DataArray(FORCE, dims="time")}, {"displacement": pd.Series(DISPLACEMENT)}
    )
    table = pd.DataFrame({"force": FORCE})
    assert np.array_equal(bp.Recording.from_arrays(TIME, table).outputs["force"], FORCE)
    assert np.array_equal(recording.outputs["force"], FORCE)


def test_between_cuts_by_time():
    recording = bp.Recording.from_arrays(TIME, {"force": FORCE}).between(1.0, 2.0)
    assert (recording.time[0], recording.time[-1]) == (1.0, 2.0)
    with pytest.raises(ValueError, match="start, stop: must select at least two samples between 1 and 2 s, got 7, 8"):
        recording.between(7, 8)


def test_missing_column_error_suggests_the_nearest_name(csv):
    with pytest.raises(ValueError, match=r"column of run 7\.csv: must be .*got 'F \[M\]'.*Did you mean 'F \[N\]'"):
        bp.Recording.from_csv(csv, time="t", outputs={"force": "F [M]"})


def test_error_locates_the_non_numeric_cell(csv):
    rewrite(csv, 3, "x", "broken")
    with pytest.raises(
        ValueError, match=r"column 'x' of run 7\.csv: must contain numbers, .*got 'broken' in data row 4"
    ):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)


@pytest.mark.parametrize("text", ["nan", "inf", ""])
def test_error_locates_samples_that_are_not_finite(csv, text):
    rewrite(csv, 5, "x", text)
    with pytest.raises(
        ValueError, match=r"displacement \(column 'x' of run 7.csv\): must be finite, got (nan|inf) at index 5"
    ):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)


def test_error_locates_time_that_does_not_increase(csv):
    rewrite(csv, 10, "t", "0.1")
    with pytest.raises(ValueError, match=r"time: must increase, got 0\.1 s after 0\.18 s at index 10"):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"path": "nowhere.csv"}, FileNotFoundError, "path: must be an existing file, got 'nowhere.csv'"),
        ({"time": None}, ValueError, "time: must be given or sampling_rate, and not both, got None and None"),
        ({"sampling_rate": 1.0}, ValueError, "must be given or sampling_rate, and not both, got 't' and 1.0"),
        (
            {"units": {"force": ("N", "m")}},
            ValueError,
            r"units\['force'\]: must be two units of the same dimension, got \('N', 'm'\)",
        ),
        ({"units": {"force": ("N", "newtown")}}, ValueError, r"units\['force'\]"),
        ({"units": {"force": 0}}, ValueError, "units\\['force'\\]: must not be zero, got 0"),
        ({"units": {"forc": 1}}, ValueError, "units: must be .*got 'forc'.*Did you mean 'force'"),
        ({"outputs": {}}, ValueError, "outputs: must have at least one channel"),
    ],
)
def test_error_names_the_bad_argument(csv, changes, error, message):
    with pytest.raises(error, match=message):
        bp.Recording.from_csv(**({"path": csv, "time": "t", **CHANNELS} | changes))


def test_file_that_is_not_mat_is_rejected(csv):
    with pytest.raises(ValueError, match="must be a MAT file, got"):
        bp.Recording.from_mat(csv, time="t", outputs={"force": "F"})


def test_lengths_must_agree():
    with pytest.raises(ValueError, match=r"outputs\['force'\]: must have 200 values .*got 199"):
        bp.Recording.from_arrays(TIME, {"force": FORCE[1:]})
