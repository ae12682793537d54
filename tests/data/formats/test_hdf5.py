"""HDF5 files of other programs: columns, units, scales, dates and rates as written, or refused."""

import io
import warnings

import h5py
import numpy as np
import pytest
import xarray as xr

import bayesperiodic as bp
from tests.data.test_damaged_files import damaged

TIME = 0.01 * np.arange(60)
SWING = np.sin(5 * TIME)


@pytest.fixture
def made(tmp_path):
    """Return a function that makes a file by data sets, given as values and attributes."""

    def make(**sets):
        path = tmp_path / "run.h5"
        with h5py.File(path, "w") as file:
            for name, given in sets.items():
                values, stored = given if isinstance(given, tuple) else (given, {})
                file[name.replace("__", "/")] = values
                for key, value in stored.items():
                    file[name.replace("__", "/")].attrs[key] = value
        return path

    return make


def read(path, key="x", **arguments):
    return bp.Recording.from_file(path, outputs={"x": key}, **arguments)


def test_arrays_in_groups_with_their_units(made):
    path = made(a__t=TIME, a__x=(SWING, {"units": "mm"}), b__x=(2 * SWING, {"Unit": b"cm"}))
    run = read(path, ("a", "x"), time=("a", "t"))
    np.testing.assert_allclose(run.outputs["x"], 1e-3 * SWING)
    assert np.array_equal(run.time, TIME)
    np.testing.assert_allclose(read(path, ("b", "x"), sampling_rate=100.0).outputs["x"], 0.02 * SWING)
    with pytest.raises(ValueError, match=r"got 'x', the name of 2; give the group too: \('a', 'x'\), \('b', 'x'\)"):
        read(path, time=("a", "t"))
    with pytest.raises(ValueError, match="run.h5 does not say when channel 'a/x' was sampled"):
        read(path, ("a", "x"))


@pytest.mark.parametrize(
    "stored, rate",
    [
        ({"dt": 0.01}, 100.0), ({"sampling_rate": 51200}, 51200.0), ({"fs": 44100.0}, 44100.0),
        ({"Sample Rate": 250.0, "dt": 0.004}, 250.0), ({"dt": np.float32(0.001)}, 1000.0),
        ({"wf_increment": 1 / 48000}, 48000.0), ({"SamplingFrequency": np.array([8000])}, 8000.0),
    ],
)  # fmt: skip
def test_rate_in_the_attributes_of_an_array_is_taken(made, stored, rate):
    path = made(x=(SWING, stored))
    np.testing.assert_allclose(read(path).time, np.arange(60) / rate, rtol=1e-14)
    assert "times are those of its attributes" in str(bp.inspect(path))


@pytest.mark.parametrize("stored", [{"dt": 0.01, "fs": 200.0}, {"fs": "fast"}, {"dt": 0.0}, {"dt": np.nan}])
def test_unclear_rates_are_refused_and_overridden(made, stored):
    path = made(x=(SWING, stored))
    with pytest.raises(ValueError, match="time: must be known, got channel 'x' of run.h5, whose attributes"):
        read(path)
    assert read(path, sampling_rate=50.0).time[1] == 0.02


@pytest.mark.parametrize(
    "stored, step",
    [
        ({"sampling_rate": 1.0, "sampling_rate_unit": "kHz"}, 1e-3), ({"dt": 1.0, "dt_units": "ms"}, 1e-3),
        ({"dt": 1.0, "time_unit": "ms"}, 1e-3), ({"dt": 20, "wf_xunit_string": "us"}, 20e-6),
        ({"fs": 2.0, "sampling_unit": "kS/s"}, 5e-4), ({"dt": 0.01, "time_unit": "s", "fs": 100.0}, 0.01),
        ({"dt": 10.0, "fs": 0.1, "dt_unit": "ms", "fs_unit": "kHz"}, 0.01), ({"fs": 100.0, "unit": "ms"}, 0.01),
        ({"fs": 100.0, "y_unit": "mm", "Sample Rate Units": np.bytes_("Hz")}, 0.01),
    ],
)  # fmt: skip
def test_units_of_rates_and_intervals_are_converted(made, stored, step):
    np.testing.assert_allclose(read(made(x=(SWING, stored))).time, step * np.arange(60), rtol=1e-14)


@pytest.mark.parametrize(
    "stored",
    [
        {"dt": 1.0, "dt_units": "ticks"}, {"fs": 1.0, "fs_unit": "mHz"}, {"fs": 1.0, "fs_unit": "ms"},
        {"fs": 1.0, "time_unit": "ms"}, {"dt": 1.0, "sampling_unit": "kHz"}, {"dt": 1.0, "dt_unit": 3},
        {"dt": 1.0, "dt_unit": "ms", "time_unit": "s"}, {"dt": 1.0, "time_unit": "ms since 2026-01-01"},
    ],
)  # fmt: skip
def test_unclear_units_of_rates_and_intervals_are_refused(made, stored):
    path = made(x=(SWING, stored))
    with pytest.raises(ValueError, match="got channel 'x' of run.h5, whose attributes .* do not say one unit"):
        read(path)
    assert read(path, sampling_rate=50.0).time[1] == 0.02


def starts_at(made, **stored):
    path = made(x=(SWING, {"dt": 0.01}), y=(SWING, {"dt": 10.0, "dt_unit": "ms"} | stored))
    return bp.Recording.from_file(path, outputs={"x": "x", "y": "y"}).times["y"][0]


def test_equal_starts_count_once_and_different_ones_are_refused(made):
    assert starts_at(made, t0=0.5, start_time=0.5, t0_unit="s") == 0.5
    assert starts_at(made, t0=500.0, time_unit="ms") == 0.5
    with pytest.raises(ValueError, match="whose attributes start_time = 0.25, t0 = 0.5 contradict each other"):
        read(made(x=(SWING, {"dt": 0.01, "t0": 0.5, "start_time": 0.25})))
    with pytest.raises(ValueError, match="whose attribute t0 = 0.5 has no unit"):
        read(made(x=(SWING, {"dt": 10.0, "dt_unit": "ms", "t0": 0.5})))
    dates = {"t0": "2026-01-31T12:00:00", "start_time": "2026-01-31T13:00:00"}
    with pytest.raises(ValueError, match="start_time = .* contradict each other"):
        read(made(x=(SWING, {"dt": 0.01} | dates)))


def test_start_is_used_with_a_rate_that_is_given(made):
    path = made(x=(SWING, {"dt": 0.01}), y=(SWING, {"fs": "fast", "t0": 0.5}))
    run = bp.Recording.from_file(path, outputs={"x": "x", "y": "y"}, sampling_rate={"x": 100.0, "y": 50.0})
    assert run.times["y"][:2].tolist() == [0.5, 0.52] and run.times["x"][0] == 0.0


def test_interval_of_single_precision_is_named_with_its_error(made):
    with pytest.warns(UserWarning, match="48000 Hz has the same digits"):
        read(made(x=(SWING, {"dt": np.float32(1 / 48000)})))


def test_starts_in_attributes_keep_channels_together(made):
    path = made(x=(SWING, {"dt": 0.01}), y=(SWING, {"dt": 0.01, "t0": 0.5}))
    run = bp.Recording.from_file(path, outputs={"x": "x", "y": "y"})
    assert run.times["y"][0] - run.times["x"][0] == pytest.approx(0.5)
    dated = [{"dt": 0.01, "start_time": f"2026-01-31T12:00:0{second}Z"} for second in (0, 2)]
    run = bp.Recording.from_file(made(x=(SWING, dated[0]), y=(SWING, dated[1])), outputs={"x": "x", "y": "y"})
    assert run.times["y"][0] - run.times["x"][0] == pytest.approx(2.0)
    with pytest.raises(ValueError, match="whose attribute t0 = yesterday is no start"):
        read(made(x=(SWING, {"dt": 0.01, "t0": "yesterday"})))


def test_rate_of_the_file_or_group_is_named_and_not_used(made):
    path = made(a__x=SWING)
    with h5py.File(path, "a") as file:
        file.attrs["fs"], file["a"].attrs["sampling_rate"] = 1000.0, 2000.0
    shown = str(bp.inspect(path))
    assert "the file has an attribute fs = 1000.0" in shown and "its group has an attribute sampling_rate" in shown
    with pytest.raises(ValueError, match="does not say when"):
        read(path)


def test_packed_numbers_of_netcdf_are_unpacked(tmp_path):
    """Written by xarray as integers of 16 bits with scale, offset and a value for missing samples."""
    values = 20.0 + 0.5 * np.arange(60)
    values[7] = np.nan
    table = xr.Dataset({"x": ("time", values, {"units": "mm"})}, {"time": ("time", TIME, {"units": "s"})})
    packing = {"dtype": "int16", "scale_factor": 0.5, "add_offset": 20.0, "_FillValue": -999, "zlib": True}
    table.to_netcdf(tmp_path / "run.nc", engine="h5netcdf", encoding={"x": packing})
    with pytest.raises(ValueError, match="x .*must be finite, got nan at index 7"):
        read(tmp_path / "run.nc")
    run = read(tmp_path / "run.nc", missing="drop")
    np.testing.assert_allclose(run.outputs["x"], 1e-3 * np.delete(values, 7))
    np.testing.assert_allclose(run.time, np.delete(TIME, 7))
    assert "multiplied by 0.5 and 20 is added" in str(bp.inspect(tmp_path / "run.nc"))


def test_unsigned_and_valid_numbers_of_netcdf(made):
    stored = np.array([0, 100, 200, 255, 90], dtype=np.uint8)
    path = made(x=(stored.view(np.int8), {"_Unsigned": "true", "_FillValue": np.int8(-1), "scale_factor": 0.1}))
    run = read(path, sampling_rate=1.0, missing="drop")
    np.testing.assert_allclose(run.outputs["x"], [0.0, 10.0, 20.0, 9.0])
    path = made(x=(np.array([1.0, 2.0, 900.0, 3.0]), {"valid_range": np.array([0.0, 10.0])}))
    assert read(path, sampling_rate=1.0, missing="drop").outputs["x"].tolist() == [1.0, 2.0, 3.0]


def test_several_missing_values_of_netcdf(made):
    path = made(x=(np.array([1.0, -99.0, 2.0, -98.0, 3.0]), {"missing_value": np.array([-99.0, -98.0])}))
    assert read(path, sampling_rate=1.0, missing="drop").outputs["x"].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    "key, value",
    [
        ("valid_range", "0 to 5"), ("valid_min", "zero"), ("valid_max", [1.0, 2.0]), ("missing_value", "-99"),
        ("valid_range", 5.0),
    ],
)  # fmt: skip
def test_odd_limits_concern_their_array_only(made, key, value):
    path = made(x=(SWING, {key: value}), y=(SWING, {"units": "mm"}))
    assert np.array_equal(read(path, "y", sampling_rate=1.0).outputs["x"], 1e-3 * SWING)
    assert [one.refused for one in bp.inspect(path).channels] == [True, False]
    assert f"an attribute {key} = " in str(bp.inspect(path))
    with pytest.raises(ValueError, match=f"'x' of run.h5: must be usable, got an attribute {key} = .*, which is no "):
        read(path, sampling_rate=1.0)


@pytest.mark.parametrize("start", ["2024-03-05_10-00-00", "2024-03-05 10-00-00", "2024-13-05", "9999-01-01"])
def test_odd_start_concerns_its_array_only(made, start):
    path = made(x=(SWING, {"dt": 0.01, "start_time": start}), y=(SWING, {"dt": 0.02}))
    assert read(path, "y").time[1] == 0.02
    assert f"whose attribute start_time = {start} is no start" in str(bp.inspect(path))
    with pytest.raises(ValueError, match="is no start in seconds or after ISO 8601"):
        read(path)
    assert read(path, sampling_rate=50.0).time[1] == 0.02


def test_dates_with_a_scale_are_refused(made):
    path = made(time=(TIME, {"units": "seconds since 2026-01-01", "scale_factor": "1/100"}), x=SWING)
    with pytest.raises(ValueError, match="must be usable, got dates with an attribute scale_factor = 1/100"):
        read(path, time="time")


def test_values_of_netcdf_that_were_not_written_are_missing(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        item = file.create_dataset("x", (5,), "f4", fillvalue=np.float32(9.969209968386869e36))
        item[...] = [1, 2, item.fillvalue, 4, 5]
    run = read(tmp_path / "run.h5", sampling_rate=1.0, missing="drop")
    assert run.outputs["x"].tolist() == [1.0, 2.0, 4.0, 5.0]


@pytest.mark.parametrize("unit, size", [("seconds", 1.0), ("milliseconds", 1e-3), ("hours", 3600.0)])
def test_dates_of_netcdf(made, unit, size):
    path = made(time=(TIME, {"units": f"{unit} since 2026-1-31 12:00:00 +01:00"}), x=SWING)
    run = read(path, time="time")
    np.testing.assert_allclose(run.time, size * TIME, atol=1e-9)
    assert "from 2026-01-31T11:00:00.0" in str(bp.inspect(path))


def test_coordinate_of_a_variable_is_its_time(tmp_path):
    """Written by xarray, with other rates of other variables."""
    dates = np.datetime64("2026-01-31T12:00:00", "ns") + (1e9 * TIME).round().astype("timedelta64[ns]")
    slow = dates[::2] + np.timedelta64(250, "ms")
    table = xr.Dataset({"x": ("time", SWING), "y": ("slow", SWING[::2])}, {"time": dates, "slow": slow})
    table.to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    run = bp.Recording.from_file(tmp_path / "run.nc", outputs={"x": "x", "y": "y"})
    np.testing.assert_allclose(run.times["x"], TIME, atol=1e-9)
    np.testing.assert_allclose(run.times["y"], 0.25 + TIME[::2], atol=1e-9)


def test_dimension_without_a_coordinate_is_no_time(tmp_path):
    """NetCDF keeps such a dimension as an array of zeros, here with a unit of dates; its name says what it is."""
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["time"], file["x"] = np.zeros(60), SWING
        file["time"].make_scale("This is a netCDF dimension but not a netCDF variable.        60")
        file["time"].attrs["units"] = "seconds since 2026-01-01"
        file["x"].dims[0].attach_scale(file["time"])
    with pytest.raises(ValueError, match="does not say when channel 'x' was sampled"):
        read(tmp_path / "run.h5")


@pytest.mark.parametrize(
    "unit, calendar", [("days since 2026-01-01", "noleap"), ("fortnights since 2026-01-01", ""), ("s since 1-1-1", "")]
)
def test_dates_that_are_no_dates_of_numpy_are_refused(made, unit, calendar):
    path = made(time=(TIME, {"units": unit} | ({"calendar": calendar} if calendar else {})), x=SWING)
    with pytest.raises(ValueError, match="'time' of run.h5: must be usable, got dates .*xarray"):
        read(path, time="time")


def test_dates_finer_than_nanoseconds_are_refused(made):
    path = made(time=(1e-10 * np.arange(60), {"units": "seconds since 2026-01-01"}), x=SWING)
    with pytest.raises(ValueError, match="its dates are finer than nanoseconds"):
        read(path, time="time")


@pytest.mark.parametrize(
    "stored",
    [
        {"gain": 0.5}, {"Sensitivity": "10 mV/g"}, {"offset": 3}, {"conversion": 1e-6}, {"multiplier": 0.01},
        {"resolution": 3e-4}, {"LSB": 3e-4}, {"gain_factor": 2.0}, {"full_scale": 1.0}, {"counts_per_volt": 3276.8},
        {"zero_level": 1.0}, {"ADC bias": 0.5}, {"Coefficients": [0.0, 0.01]}, {"cal_multiplier": "0.01 V"},
        {"Scale_Factor": 0.01}, {"scale_factor": [0.01, 0.01]}, {"scale_factor": "1/100"}, {"scale_factor": np.nan},
        {"add_offset": "2", "scale_factor": 0.1}, {"scale_factor": np.full(100, 0.1)}, {"gain": np.full((1, 1), 0.5)},
    ],
)  # fmt: skip
def test_scale_of_no_convention_is_decided_by_the_user(made, stored):
    path = made(x=(SWING, stored | {"units": "V"}))
    with pytest.raises(ValueError, match=r"units\['x'\]: must say what 'V \(.* not applied\)' in the file is"):
        read(path, sampling_rate=100.0)
    assert np.allclose(read(path, sampling_rate=100.0, units={"x": 0.5}).outputs["x"], 0.5 * SWING)


@pytest.mark.parametrize(
    "stored", [{"range": 10.0}, {"Input Range": "±10 V"}, {"counts": 4096}, {"adc_range": [-5, 5]}]
)
def test_counts_with_a_range_are_not_taken_as_volts(made, stored):
    """Of floats, and with the range of the type itself or that of netCDF for the values, they are no counts."""
    counts = np.round(1000 * SWING).astype("i2")
    for units in ({"units": "V"}, {}):
        with pytest.raises(ValueError, match=r"units\['x'\]: must say what '.* not applied\)' in the file is"):
            read(made(x=(counts, stored | units)), sampling_rate=100.0)
    np.testing.assert_allclose(
        read(made(x=(counts, stored)), sampling_rate=100.0, units={"x": 1e-3}).outputs["x"], 1e-3 * counts
    )
    for kept, other in (
        (SWING, stored),
        (counts, {"range": np.array([-32768, 32767])}),
        (counts, {"range": 65536, "valid_range": np.array([-1000, 1000]), "sample_count": 60}),
        (counts, {"scale_factor": 1.0, "actual_range": np.array([-990, 998])}),
    ):
        run = read(made(x=(kept, other | {"units": "V"})), sampling_rate=100.0)
        np.testing.assert_array_equal(run.outputs["x"], kept)


def test_scale_that_changes_nothing_is_ignored(made):
    path = made(x=(SWING, {"gain": 1.0, "offset": 0, "units": "V", "zero_level": 0.0, "multiplier": 1}))
    assert np.array_equal(read(path, sampling_rate=100.0).outputs["x"], SWING)
    other = {"calibration_date": "2024-03-05", "sensor_id": 7, "resolution": -1.0, "scale_type": "linear"}
    path = made(x=(SWING, other | {"units": "V", "valid_range": np.array([-2.0, 2.0]), "factory": 3}))
    assert np.array_equal(read(path, sampling_rate=100.0).outputs["x"], SWING)


def test_columns_of_tables_and_fields_of_structures(made):
    table = np.stack([TIME, SWING, 2 * SWING], axis=1)
    fields = np.array([*zip(TIME, SWING, range(60), strict=True)], dtype=[("t", "f8"), ("x", ">f4"), ("n", "i2")])
    block = np.zeros(60, dtype=[("index", "i8"), ("block", "f8", (2,)), ("note", "S4")])  # as pandas.to_hdf writes them
    block["block"] = table[:, 1:]
    units = {"units": np.array(["s", "mm", "cm"], dtype=h5py.string_dtype())}
    path = made(
        data=(table, units),
        rows=table.T,
        fields=fields,
        block=block,
        cube=np.zeros((20, 3, 2)),
        square=np.zeros((9, 9)),
    )
    run = read(path, "data[:, 2]", time="data[:, 0]")
    np.testing.assert_allclose(run.outputs["x"], 0.02 * SWING)
    assert np.array_equal(read(path, "rows[1, :]", time="rows[0, :]").outputs["x"], SWING)
    run = bp.Recording.from_file(path, time="fields.t", outputs={"x": "fields.x", "n": "fields.n"})
    np.testing.assert_allclose(run.outputs["x"], SWING, rtol=1e-6)
    assert run.outputs["n"].tolist() == [*range(60)] and np.array_equal(run.time, TIME)
    assert np.array_equal(read(path, "block.block[:, 1]", time="fields.t").outputs["x"], 2 * SWING)
    with pytest.raises(ValueError, match=r"must be usable, got fields \['note'\], which are no numbers"):
        read(path, "block.note", time="fields.t")
    assert "'data': 'data[:, 0]', 'data_2': 'data[:, 1]'" in bp.inspect(path).code
    for name in ("cube", "square"):
        with pytest.raises(
            ValueError, match=f"'{name}' of run.h5: must be usable, got of shape .* no table of columns"
        ):
            read(path, name, sampling_rate=1.0)


@pytest.mark.parametrize("values", [SWING + 1j, np.array(["a"] * 60, dtype=object)])
def test_arrays_of_other_types_are_refused(made, values):
    path = made(x=values)
    assert bp.inspect(path).channels[0].name == "x"
    with pytest.raises(ValueError, match="'x' of run.h5: must"):
        read(path, sampling_rate=1.0)


def test_links_are_shown_and_not_followed(made, tmp_path):
    path = made(y=SWING)
    (tmp_path / "secret.h5").write_bytes(path.read_bytes())
    with h5py.File(path, "a") as file:
        file["x"] = h5py.ExternalLink("secret.h5", "y")
        file["soft"] = h5py.SoftLink("/y")
        file.create_dataset("raw", (60,), "f8", external=[("secret.h5", 0, 480)])
        file["loop/again"] = file["/"]
    shown = bp.inspect(path)
    assert {one.name: one.refused for one in shown.channels} == {"y": False, "x": True, "soft": True, "raw": True}
    for name in ("x", "soft", "raw"):
        with pytest.raises(ValueError, match=f"'{name}' of run.h5: must be usable, got a link or data of another file"):
            read(path, name, sampling_rate=100.0)
    assert read(path, "y", sampling_rate=100.0).time.size == 60


def test_array_with_parts_that_were_not_written_is_refused(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("x", (60,), "f8", chunks=(20,))[:40] = 1.0
    with pytest.raises(ValueError, match="path: must be an HDF5 file, got .*parts of its variable 'x' are missing"):
        read(tmp_path / "run.h5", sampling_rate=1.0)


def test_units_with_the_exponents_of_netcdf(made):
    path = made(x=(SWING, {"units": "mm s-2"}))
    np.testing.assert_allclose(read(path, sampling_rate=100.0).outputs["x"], 1e-3 * SWING)


@pytest.mark.parametrize("start", [b"CDF\x01", b"CDF\x02", b"CDF\x05"])
def test_netcdf_of_version_3_is_refused_with_its_conversion(tmp_path, start):
    (tmp_path / "run.nc").write_bytes(start + bytes(100))
    with pytest.raises(ValueError, match="a netCDF file of version 3; nccopy -k nc4 converts it"):
        bp.inspect(tmp_path / "run.nc")


@pytest.mark.parametrize("name", ["run.h5", "run.mat"])
def test_damaged_heap_of_texts_is_refused_before_it_is_read(made, tmp_path, name):
    """HDF5 2.0 does not come to an end for some of them."""
    whole = bytearray(made(x=(SWING, {"units": "mm"})).read_bytes())
    place = whole.index(b"GCOL")
    assert whole[place + 16 : place + 18] == b"\1\0" and whole[place + 24 : place + 26] == b"\2\0"  # number and size
    whole[place + 30] = 1
    (tmp_path / name).write_bytes(whole)
    with pytest.raises(ValueError, match="path: must be .*a heap of its texts is damaged"):
        bp.inspect(tmp_path / name)


def test_single_numbers_are_named(made):
    assert "single numbers, which are not used: fs" in str(bp.inspect(made(fs=100.0, x=SWING)))


@pytest.mark.parametrize("packed", [None, "gzip"])
def test_damaged_file_is_refused_or_read_as_a_whole(tmp_path, packed):
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for name in ("a/x", "a/y"):
            item = file.create_dataset(name, data=SWING, compression=packed)
            item.attrs.update({"dt": 0.01, "units": "mm", "scale_factor": 2.0, "_FillValue": -1.0})
        file["t"] = TIME
        file["t"].attrs["units"] = "seconds since 2026-01-01"
        file["t"].make_scale("time")
        file["table"] = np.zeros((60, 3))
        file["a/x"].dims[0].attach_scale(file["t"])
    whole, generator = content.getvalue(), np.random.default_rng(3)
    path = tmp_path / "run 7"
    for _ in range(200):
        path.write_bytes(damaged(whole, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "sampling_rate: run 7")
            for read_it in (
                lambda: bp.inspect(path, format="hdf5"),
                lambda: read(path, ("a", "x"), format="hdf5", missing="drop"),
                lambda: read(path, ("a", "y"), format="hdf5", missing="drop"),
            ):
                try:
                    read_it()
                except ValueError as error:
                    assert "must" in str(error)
