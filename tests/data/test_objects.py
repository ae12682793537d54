"""Recordings from tables of pandas, datasets of xarray and time series after SEP 005."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import bayesperiodic as bp

TIME = np.arange(400) / 100
X = np.cos(2 * np.pi * TIME)
SERIES = {"name": "F", "unit_str": "kN", "fs": 100.0, "data": X}


def test_units_in_names_of_a_table_are_those_of_the_same_table_in_a_file(tmp_path):
    """A table read by pandas, and a dictionary, are converted as the file is; attributes have priority."""
    table = pd.DataFrame({"t [ms]": 1e3 * TIME, "x [mm]": X, "F (kN)": X, "plain": X, "a [g]": X})
    table.to_csv(tmp_path / "run.csv", index=False)
    names = {"time": "t [ms]", "outputs": {"x": "x [mm]", "y": "plain"}, "inputs": {"force": "F (kN)"}}
    one, other = bp.Recording.from_dataframe(table, **names), bp.Recording.from_csv(tmp_path / "run.csv", **names)
    assert one.time == pytest.approx(TIME) == other.time
    for run in (one, other):
        assert run.outputs["x"] == pytest.approx(1e-3 * X) and run.inputs["force"] == pytest.approx(1e3 * X)
        assert run.outputs["y"] == pytest.approx(X)
    with pytest.raises(ValueError, match=r"units\['a'\]: must say what 'g'"):
        bp.Recording.from_dataframe(table, time="t [ms]", outputs={"a": "a [g]"})
    table.attrs["units"] = {"x [mm]": "cm"}
    assert bp.Recording.from_dataframe(table, **names).outputs["x"] == pytest.approx(1e-2 * X)
    responses = {"f [kHz]": [0.01, 0.02], "x [mm]": [3.0, 4.0]}
    for units in (None, {"x": ("mm", "m")}, {"x": 1e-3}):
        runs = bp.response_table(
            responses, frequency="f [kHz]", outputs={"x": "x [mm]"}, inputs={"force": 1.0}, units=units
        )
        assert [run.frequency for run in runs] == pytest.approx([10.0, 20.0])
        assert [run.measurements[0].value for run in runs] == pytest.approx([3e-3, 4e-3])


def test_columns_of_two_levels_and_an_index_of_dates():
    index = pd.date_range("2026-03-29T01:59:59", periods=400, freq="10ms", tz="UTC").tz_convert("Europe/Berlin")
    table = pd.DataFrame({("A", "x"): X, ("B", "x"): 2 * X}, index=index)
    table.attrs["units"] = {("A", "x"): "mm"}
    run = bp.Recording.from_dataframe(table, outputs={"x": ("A", "x"), "y": ("B", "x")})
    assert run.time == pytest.approx(TIME) and run.outputs["x"] == pytest.approx(1e-3 * X)
    assert np.array_equal(run.outputs["y"], 2 * X)
    with pytest.raises(ValueError, match="column of DataFrame: must be the name of one column, got 'x', the name of 2"):
        bp.Recording.from_dataframe(table, outputs={"x": "x"})


def test_index_of_numbers_is_a_column_by_its_name():
    table = pd.DataFrame({"x": X}, index=pd.Index(1e3 * TIME, name="t"))
    run = bp.Recording.from_dataframe(table, outputs={"x": "x"}, time="t", units={"time": ("ms", "s")})
    assert run.time == pytest.approx(TIME)
    with pytest.raises(ValueError, match="time: must be given or sampling_rate.*DataFrame does not say when"):
        bp.Recording.from_dataframe(table, outputs={"x": "x"})


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"outputs": {}}, "outputs: must have at least one channel, got none"),
        ({"outputs": {"x": "y"}}, "column of DataFrame: must be 'x', got 'y'"),
        ({"outputs": {"x": "x"}, "rate": 5.0}, "arguments: must be one of .*, got 'rate'"),
        ({"outputs": {"x": "x"}, "sampling_rate": 100.0, "units": {"x": ("m", "m")}}, "must begin with the unit 'mm'"),
        ({"outputs": {"x": "x"}, "sampling_rate": 100.0, "units": {"x": "s"}}, "two units of the same dimension"),
    ],
)
def test_wrong_arguments_have_one_error(arguments, message):
    table = pd.DataFrame({"x": X})
    table.attrs["units"] = {"x": "mm"}
    with pytest.raises(ValueError, match=message):
        bp.Recording.from_dataframe(table, **arguments)


def test_unit_wanted_is_given_alone_where_the_file_says_the_unit():
    table = pd.DataFrame({"x": X, "bare": X})
    table.attrs["units"] = {"x": "mm"}
    kept = bp.Recording.from_dataframe(table, outputs={"x": "x"}, sampling_rate=100.0, units={"x": "cm"})
    assert kept.outputs["x"] == pytest.approx(0.1 * X)
    with pytest.raises(ValueError, match="must be a factor or a pair such as .*the file does not say the unit"):
        bp.Recording.from_dataframe(table, outputs={"x": "bare"}, sampling_rate=100.0, units={"x": "cm"})


@pytest.mark.parametrize(
    "unit, factor",
    [("deg", np.pi / 180), ("m/s2", 1.0), ("gn", 9.80665), ("N/mm", 1e3), ("bar", 1e5), ("%", 0.01), ("Nm", 1.0),
     ("µm/m", 1e-6), ("", 1.0), ("-", 1.0), ("lbf", 4.4482216152605), ("kHz", 1e3),
     ("mNm", 1e-3), ("kNm/m", 1e3), ("Nm/rad", 1.0), ("V/Nm", 1.0), ("Ncm", 0.01), ("1/min", 1 / 60)],
)  # fmt: skip
def test_units_are_converted_to_si(unit, factor):
    run = bp.Recording.from_sep005([SERIES | {"unit_str": unit}], outputs={"x": "F"})
    assert run.outputs["x"] == pytest.approx(factor * X)


@pytest.mark.parametrize(
    "unit",
    ["g", "rpm", "EU", "dB", "counts/div", "C", "V/g", "k", "Mm/EU", "ms-2", "mil", "mg", "%RH", "PS", "kn", "Nms"],
)
def test_units_that_are_unknown_or_mean_two_things_are_refused(unit):
    with pytest.raises(ValueError, match=rf"units\['x'\]: must say what '{unit}' in the file is, got None; give"):
        bp.Recording.from_sep005([SERIES | {"unit_str": unit}], outputs={"x": "F"})
    run = bp.Recording.from_sep005([SERIES | {"unit_str": unit}], outputs={"x": "F"}, units={"x": 2.0})
    assert run.outputs["x"] == pytest.approx(2.0 * X)


def test_acceleration_in_g_is_no_gram():
    series = [SERIES | {"unit_str": "g"}]
    run = bp.Recording.from_sep005(series, outputs={"a": "F"}, units={"a": ("g_0", "m/s**2")})
    assert run.outputs["a"] == pytest.approx(9.80665 * X)


def test_dataset_keeps_the_times_of_each_dimension():
    data = xr.Dataset(
        {
            "F": ("t", X, {"units": "kN"}),
            "x": ("s", X[::4], {"units": "µm"}),
            "all": (("t", "s"), np.zeros((400, 100))),
        },
        coords={"t": ("t", 1e3 * TIME, {"units": "ms"}), "s": ("s", 1.0 + TIME[::4], {"units": "s"})},
    )
    run = bp.Recording.from_xarray(data, outputs={"x": "x"}, inputs={"force": "F"})
    assert run.times["x"] == pytest.approx(1.0 + TIME[::4]) and run.times["force"] == pytest.approx(TIME)
    assert run.inputs["force"] == pytest.approx(1e3 * X) and run.outputs["x"] == pytest.approx(1e-6 * X[::4])
    with pytest.raises(
        ValueError, match=r"variable 'all' of Dataset: must be usable, got dimensions .*; choose one column"
    ):
        bp.Recording.from_xarray(data, outputs={"x": "all"})
    with pytest.raises(ValueError, match="dataset: must have a name if it is a DataArray"):
        bp.Recording.from_xarray(xr.DataArray(X, dims="t"), outputs={"x": "x"})


def test_series_after_sep005_count_from_the_earliest_start():
    late = {
        "name": "x",
        "unit_str": "mm",
        "time": 0.1 + TIME[::4],
        "data": X[::4],
        "start_timestamp": "2026-01-01T02:00:01.5+02:00",
    }
    series = [SERIES | {"start_timestamp": "2026-01-01T00:00:00Z"}, late]
    run = bp.Recording.from_sep005(series, outputs={"x": "x"}, inputs={"force": "F"})
    assert run.times["force"] == pytest.approx(TIME) and run.times["x"] == pytest.approx(1.6 + TIME[::4])
    with pytest.raises(ValueError, match=r"counted from one instant .*got dates for \['x'\] and none for \['force'\]"):
        bp.Recording.from_sep005([SERIES, late], outputs={"x": "x"}, inputs={"force": "F"})


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"time": 2 * TIME}, "must have 'fs' and 'time' that agree, got 100.0 Hz and times of 50 Hz"),
        ({"fs": None, "time": -TIME}, "time: must increase, got -0.01 s after"),
        ({"data": X.reshape(2, 200)}, r"must have data of one dimension, got shape \(2, 200\)"),
        ({"fs": None}, "must have 'fs' or 'time', got neither"),
        ({"fs": 0.0}, r"channels\[0\]\['fs'\]: must be > 0, got 0.0"),
        ({"time": TIME[1:]}, "must have one time per value, got 399 and 400"),
        ({"start_timestamp": "yesterday"}, "must be a date after ISO 8601, got 'yesterday'"),
        ({"start_timestamp": "2300-01-01"}, r"\['start_timestamp'\]: must be of the years from 1678 to 2261, got 2300"),
        (
            {"fs": None, "time": np.datetime64("2300", "s") + np.arange(400)},
            r"\['time'\]: must be of the years from 1678 to 2261, got 2300-01-01",
        ),
        (
            {"fs": None, "time": 1.7e9 + TIME, "start_timestamp": "2026-01-01"},
            "must have times from 'start_timestamp' on",
        ),
    ],
)
def test_series_that_contradict_themselves_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        bp.Recording.from_sep005([SERIES | changes], outputs={"x": "F"})


def test_what_is_no_series_is_refused():
    for wrong in (SERIES, [X], None):
        with pytest.raises(ValueError, match="channels: must be a list of dictionaries after SEP 005, got"):
            bp.Recording.from_sep005(wrong, outputs={"x": "F"})
    with pytest.raises(ValueError, match=r"channels\[0\].*SEP 005 requires them"):
        bp.Recording.from_sep005([{"data": X}], outputs={"x": "F"})
    with pytest.raises(ValueError, match="channels: must have channels of different names, got 'F' 2 times"):
        bp.Recording.from_sep005([SERIES, SERIES], outputs={"x": "F"})


@pytest.mark.parametrize("kind", ["datetime64[us]", "timedelta64[us]"])
def test_series_with_dates_keep_their_starts(kind):
    start = np.datetime64("2024-01-01T10:00:00") if kind[0] == "d" else np.timedelta64(0, "s")
    time = start + (np.arange(400) * 10_000).astype("m8[us]")
    later = SERIES | {"name": "x", "unit_str": "m", "fs": None, "time": time + np.timedelta64(5, "s")}
    run = bp.Recording.from_sep005([SERIES | {"fs": None, "time": time}, later], outputs={"x": "x"}, inputs={"F": "F"})
    assert run.times["F"] == pytest.approx(TIME) and run.times["x"] == pytest.approx(5.0 + TIME)


@pytest.mark.parametrize("rate", [100, 100.0, np.int64(100), np.float32(100)])
def test_one_rate_for_channels_with_times_of_their_own_is_refused(rate):
    other = SERIES | {"name": "x", "fs": 50.0}
    with pytest.raises(ValueError, match="sampling_rate: must be given by channel"):
        bp.Recording.from_sep005([SERIES, other], outputs={"x": "x"}, inputs={"F": "F"}, sampling_rate=rate)


@pytest.mark.parametrize(
    "stored, pair", [("g", ("mm", "m")), ("rpm", ("mm", "m")), ("C", ("V", "V")), ("lb", ("V", "mV"))]
)
def test_pair_that_contradicts_a_doubtful_unit_is_refused(stored, pair):
    with pytest.raises(ValueError, match="must begin with the unit"):
        bp.Recording.from_sep005([SERIES | {"unit_str": stored}], outputs={"x": "F"}, units={"x": pair})


def test_packed_values_of_netcdf_are_decoded_first():
    data = xr.Dataset({"x": ("t", X, {"units": "mm", "scale_factor": 0.1})}, coords={"t": ("t", TIME, {"units": "s"})})
    with pytest.raises(
        ValueError, match="variable 'x' of Dataset: must be usable, got packed values, with 'scale_factor'"
    ):
        bp.Recording.from_xarray(data, outputs={"x": "x"})


def test_integer_labels_of_columns_are_names():
    table = pd.DataFrame(np.column_stack([TIME, 7 + TIME, 9 + TIME]))
    assert bp.Recording.from_dataframe(table, outputs={"x": 1}, sampling_rate=100.0).outputs["x"][0] == 7.0


@pytest.mark.parametrize(
    "unit, units, message",
    [
        ("mm", {}, "must be in a unit of time, got 'mm'"),
        ("", {"time": ("mm", "m")}, "must be in a unit of time"),
        ("s", {"time": "ms"}, "must be a factor or a pair such as"),
        ("", {"time": "ms"}, "must be a factor or a pair such as"),
    ],
)
def test_times_in_another_unit_are_refused(unit, units, message):
    table = pd.DataFrame({"t": TIME, "x": X})
    table.attrs["units"] = {"t": unit}
    with pytest.raises(ValueError, match=message):
        bp.Recording.from_dataframe(table, time="t", outputs={"x": "x"}, units=units)


def test_objects_that_are_numbers_are_read_and_empty_labels_refused():
    table = pd.DataFrame({"t": TIME, "x": pd.Series([*X], dtype=object), "label": ["a"] * 200 + [None] * 200})
    assert np.array_equal(bp.Recording.from_dataframe(table, time="t", outputs={"x": "x"}).outputs["x"], X)
    with pytest.raises(
        ValueError, match="split: must be a column without empty cells, got 'label', empty in data row 201"
    ):
        bp.Recording.from_dataframe(table, time="t", outputs={"x": "x"}, split="label")


def test_missing_date_at_the_start_is_left_out():
    index = pd.DatetimeIndex([pd.NaT, *pd.date_range("2024", periods=399, freq="10ms")])
    run = bp.Recording.from_dataframe(pd.DataFrame({"x": X}, index=index), outputs={"x": "x"}, missing="drop")
    assert run.time == pytest.approx(TIME[:-1]) and np.array_equal(run.outputs["x"], X[1:])


@pytest.mark.parametrize("kind", ["arrays", "frame", "xarray", "sep005"])
def test_arrays_of_the_user_are_neither_shared_nor_made_read_only(kind):
    time, x = TIME.copy(), X.copy()
    if kind == "arrays":
        run = bp.Recording.from_arrays(time, {"x": x})
    elif kind == "frame":
        run = bp.Recording.from_dataframe(pd.DataFrame({"t": time, "x": x}), time="t", outputs={"x": "x"})
    elif kind == "xarray":
        data = xr.Dataset({"x": ("time", x)}, {"time": ("time", time, {"units": "s"})})
        run = bp.Recording.from_xarray(data, outputs={"x": "x"})
    else:
        run = bp.Recording.from_sep005([{"name": "x", "data": x, "time": time, "unit_str": "m"}], outputs={"x": "x"})
    assert x.flags.writeable and time.flags.writeable
    x[:], time[:] = 7.0, 7.0
    np.testing.assert_array_equal(run.outputs["x"], X)
    np.testing.assert_allclose(run.time, TIME)
