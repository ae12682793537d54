"""Missing samples of arrays; those of files are in `test_recording`."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import bayesperiodic as bp

TIME = np.arange(600) / 100
ANGLE = 0.5 * np.sin(2 * np.pi * TIME)
LOST = np.arange(TIME.size) % 17 == 3


@pytest.mark.parametrize(
    "values",
    [
        np.where(LOST, np.nan, ANGLE),
        np.ma.array(np.where(LOST, 1e20, ANGLE), mask=LOST),
        pd.Series(np.where(LOST, np.nan, ANGLE)).astype("Float64"),
        pd.array(np.where(LOST, np.nan, ANGLE), dtype="Float64"),
        pd.Series([None if lost else x for lost, x in zip(LOST, ANGLE, strict=True)], dtype=object),
        [pd.NA if lost else x for lost, x in zip(LOST, ANGLE, strict=True)],
        xr.DataArray(np.where(LOST, np.nan, ANGLE), dims="time"),
    ],
    ids=lambda values: f"{type(values).__name__} {getattr(values, 'dtype', '')}",
)
def test_missing_samples_are_refused_left_out_or_interpolated(values):
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must be finite, got nan at index 3 \(36 of 600 .*") as error:
        bp.Recording.from_arrays(TIME, {"x": values})
    assert "missing='drop'" in str(error.value) and "missing='interpolate'" in str(error.value)
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must be finite, got nan at index 3 \(36 of 600"):
        bp.Recording(TIME, {"x": values}, {})
    dropped = bp.Recording.from_arrays(TIME, {"x": values}, {"u": ANGLE}, missing="drop")
    # Only the channel with missing samples loses them; its times are then its own.
    for kept, whole in ((dropped.time["x"], TIME), (dropped.outputs["x"], ANGLE)):
        assert np.array_equal(kept, whole[~LOST])
    assert np.array_equal(dropped.time["u"], TIME) and np.array_equal(dropped.inputs["u"], ANGLE)
    alone = bp.Recording.from_arrays(TIME, {"x": values}, missing="drop")
    assert np.array_equal(alone.time, TIME[~LOST])
    run = dropped.fold(64, harmonics=1)
    assert abs(np.fft.rfft(run.outputs["x"])[1]) / 32 == pytest.approx(0.5, abs=1e-6)
    filled = bp.Recording.from_arrays(TIME, {"x": values}, missing="interpolate")
    middle = (ANGLE[np.flatnonzero(LOST) - 1] + ANGLE[np.flatnonzero(LOST) + 1]) / 2
    assert np.array_equal(filled.time, TIME) and filled.outputs["x"][LOST] == pytest.approx(middle)


def test_interpolation_is_over_three_samples_and_linear_in_time():
    time, x = np.array([0.0, 1.0, 2.0, 4.0, 8.0]), np.array([0.0, np.nan, np.nan, np.nan, 8.0])
    assert bp.Recording.from_arrays(time, {"x": x}, missing="interpolate").outputs["x"] == pytest.approx(time)
    with pytest.raises(ValueError, match=r"missing: must be 'drop' for outputs\['x'\], .*at most 3 .*, and 4 are"):
        bp.Recording.from_arrays(range(6), {"x": [0, None, None, None, None, 5]}, missing="interpolate")
    with pytest.raises(ValueError, match="missing: must be one of 'drop', 'interpolate', got 'fill'"):
        bp.Recording.from_arrays(time, {"x": x}, missing="fill")


def test_lengths_are_checked_whatever_is_missing():
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must have 600 values .*got 599"):
        bp.Recording.from_arrays(TIME, {"x": ANGLE[1:]}, missing="drop")
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must be one-dimensional, got shape \(600, 1\)"):
        bp.Recording.from_arrays(TIME, {"x": ANGLE[:, None]}, missing="drop")


def test_channels_may_be_called_as_the_arguments_are():
    run = bp.Recording.from_arrays([0, 1, 2], {"time": [1, None, 3]}, {"outputs": [4, 5, 6]}, missing="drop")
    assert run.outputs["time"].tolist() == [1.0, 3.0] and run.inputs["outputs"].tolist() == [4.0, 5.0, 6.0]
    assert run.times["time"].tolist() == [0.0, 2.0] and run.times["outputs"].tolist() == [0.0, 1.0, 2.0]


def test_masks_are_not_ignored_in_an_experiment():
    masked = np.ma.array(np.cos(2 * np.pi * np.arange(16) / 16), mask=np.arange(16) == 5)
    with pytest.raises(ValueError, match=r"must be finite, got nan at index 5 \(1 of 16 values are masked, NaN or inf"):
        bp.Experiment("run", 1.0, {"x": masked}, samples=16)


def test_a_cell_of_a_file_with_one_row_is_located(tmp_path):
    (tmp_path / "run.csv").write_text("0\nx\n\n")
    with pytest.raises(ValueError, match="column '0' of run.csv: must contain numbers, .* got 'x' in data row 1"):
        bp.Recording.from_csv(tmp_path / "run.csv", sampling_rate=2.0, outputs={"c": "0"})


def written(folder, *, rows=6, last="1.5"):
    """Write a file of times, a displacement, a force and the number of a part, and return what names its columns."""
    lines = ["t [s],x [mm],u [N],part"]
    lines += [f"{k},{2 * k},{3 * k if k < rows - 1 else last},{k // 3}" for k in range(rows)]
    (folder / "run.csv").write_text("\n".join(lines) + "\n")
    return {"time": "t [s]", "outputs": {"x": "x [mm]"}, "inputs": {"u": "u [N]"}}


def test_recordings_of_a_file_and_its_parts_have_the_units_of_their_values(tmp_path):
    names = written(tmp_path)
    run = bp.Recording.from_file(tmp_path / "run.csv", **names)
    assert run.units == {"x": "m", "u": "N"}
    parts = bp.Recording.from_file(tmp_path / "run.csv", **names, split="part")
    assert [part.units for part in parts] == [run.units] * 2
    assert [part.name for part in parts] == ["run 1: part 0", "run 2: part 1"]
    np.testing.assert_allclose(np.concatenate([part.outputs["x"] for part in parts]), run.outputs["x"])
    assert [part.time.tolist() for part in parts] == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    given = bp.Recording.from_file(tmp_path / "run.csv", **names, units={"x": "mm", "u": 2.0})
    assert given.units == {"x": "mm"} and given.inputs["u"][1] == 6.0 and given.outputs["x"][1] == 2.0


def test_values_that_are_not_finite_are_named_with_channel_column_and_file(tmp_path):
    names = written(tmp_path, last="inf")
    with pytest.raises(ValueError, match=r"^u \(column 'u \[N\]' of run.csv\): must be finite, got inf at index 5"):
        bp.Recording.from_file(tmp_path / "run.csv", **names)


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"outputs": {}}, "outputs: must have at least one channel, got none"),
        ({"outputs": ["x [mm]"]}, "outputs: must be a mapping"), ({"inputs": ["x [mm]"]}, "inputs: must be a mapping"),
        ({"sampling_rate": 10.0}, r"time: must be given or sampling_rate, and not both, got 't \[s\]' and 10.0"),
        ({"units": {"y": "mm"}}, "units: must be one of 'time', 'x', 'u', got 'y'"),
        ({"units": {"time": "s"}, "outputs": {"time": "x [mm]"}}, "units: must be those of the times by"),
        ({"time": None, "sampling_rate": {"y": 10.0}}, "sampling_rate: must be one of 'x', 'u', got 'y'"),
        ({"time": None}, "time: must be given or sampling_rate"), ({"split": "no"}, "must be one of"),
    ],
)  # fmt: skip
def test_what_names_the_columns_of_a_file_is_checked(tmp_path, changes, reason):
    names = written(tmp_path)
    with pytest.raises(ValueError, match=reason):
        bp.Recording.from_file(tmp_path / "run.csv", **names | changes)
