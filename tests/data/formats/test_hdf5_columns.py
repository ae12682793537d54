"""Columns of HDF5 files: shapes and types that are tables, units of several columns, and remarks."""

import h5py
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import hdf5


@pytest.fixture
def make(tmp_path):
    """Return a function that makes a file of data sets with attributes, and of attributes of groups."""

    def made(sets, groups=None):
        path = tmp_path / "run.h5"
        with h5py.File(path, "w") as file:
            for name, given in sets.items():
                values, stored = given if isinstance(given, tuple) else (given, {})
                file[name] = values
                for key, value in stored.items():
                    file[name].attrs[key] = value
            for name, stored in (groups or {}).items():
                for key, value in stored.items():
                    file[name].attrs[key] = value
        return path

    return made


def names(path):
    return [channel.label for channel in hdf5.contents(path, []).channels if not channel.refusal]


@pytest.mark.parametrize(
    "shape, expected",
    [
        ((5,), ["x"]), ((5, 1), ["x"]), ((1, 1, 5), ["x"]), ((20, 2), ["x[:, 0]", "x[:, 1]"]),
        ((2, 20), ["x[0, :]", "x[1, :]"]),
        ((19, 2), None), ((640, 64), 64), ((650, 65), None), ((20, 2, 1), None), ((40, 3), 3),
    ],
)  # fmt: skip
def test_tables_are_ten_times_as_long_as_wide_and_have_64_columns_at_most(make, shape, expected):
    values = np.arange(np.prod(shape)).reshape(shape)
    path = make({"x": values})
    whole = hdf5.contents(path, [])
    if expected is None:
        (channel,) = whole.channels
        text = f"of shape {' x '.join(map(str, shape))} and type int64, which is no table of columns of numb"
        assert channel.refusal.startswith(text) and channel.samples == max(shape)
        return
    assert names(path) == expected or len(names(path)) == expected
    long = values if shape[0] == max(shape) else values.T
    for k, channel in enumerate(whole.channels):
        assert np.array_equal(channel.values(), long.reshape(max(shape), -1)[:, k]) and channel.samples == max(shape)


def test_fields_of_structures_are_columns(make):
    kind = [
        ("name", "S3"),
        ("t", "f8"),
        ("x", "i4", (2,)),
        ("one", "f4", (1,)),
        ("wide", "f8", (65,)),
        ("cube", "f8", (2, 2)),
    ]
    table = np.zeros(6, dtype=kind)
    table["t"], table["x"], table["one"] = np.arange(6), np.arange(12).reshape(6, 2), np.arange(6)[:, None] + 0.5
    channels = {one.name: one for one in hdf5.contents(make({"a/v": table}), []).channels}
    assert [*channels] == ["v.name", "v.t", "v.x[:, 0]", "v.x[:, 1]", "v.one"]
    assert channels["v.name"].refusal == "fields ['name', 'wide', 'cube'], which are no numbers"
    assert channels["v.x[:, 1]"].values().tolist() == [1, 3, 5, 7, 9, 11] and channels["v.t"].group == "a"
    assert channels["v.one"].values().tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5] and channels["v.t"].samples == 6
    (channel,) = hdf5.contents(make({"v": table.reshape(2, 3)}), []).channels
    assert channel.refusal.startswith("of shape 2 x 3 and type ")
    (channel,) = hdf5.contents(make({"v": np.array([1 + 2j, 3.0])}), []).channels
    assert "complex128, which is no table of columns of numbers" in channel.refusal


@pytest.mark.parametrize(
    "stored, units",
    [
        ({"units": "mm"}, ["mm", "mm"]), ({"units": np.array(["mm", "N"], dtype=h5py.string_dtype())}, ["mm", "N"]),
        ({"unit": np.array([b"mm", b"N"])}, ["mm", "N"]),
        ({"units": np.array([b"\xb5m", "\u00b5m".encode()])}, ["\ufffdm", "\u00b5m"]),
        ({"units": np.array([b"mm", b"N", b"s"])}, ["", ""]),
        ({"units": np.array([1.0, 2.0])}, ["", ""]), ({"units": 5}, ["", ""]), ({}, ["", ""]),
        ({"Units": "s"}, ["s", "s"]),
        ({"units": np.array(["mm"], dtype=h5py.string_dtype())}, ["mm", "mm"]),
        ({"units": "mm", "unit": "m"}, ["mm", "mm"]),
    ],
)  # fmt: skip
def test_units_are_one_for_all_columns_or_a_list(make, stored, units):
    path = make({"x": (np.zeros((40, 2)), stored)})
    assert [one.unit for one in hdf5.contents(path, []).channels] == units


def test_units_of_types_that_are_not_read_are_asked_for(make, tmp_path):
    path = make({"x": np.zeros(5), "y": np.zeros((40, 2))})
    with h5py.File(path, "a") as file:
        file["x"].attrs["units"] = file["y"].ref
    (x, *_) = hdf5.contents(path, []).channels
    assert x.unit == "(unit of a type that is not read)"


def test_texts_and_truth_values_are_columns(make):
    path = make(
        {
            "s": np.array([b"a", b"\xb5"]),
            "v": np.array(["c", "µ"], dtype=h5py.string_dtype()),
            "b": np.array([True, False]),
        }
    )
    channels = {one.name: one for one in hdf5.contents(path, []).channels}
    assert channels["v"].values().tolist() == ["c", "µ"] and channels["s"].values().tolist() == ["a", "\ufffd"]
    assert channels["b"].values().tolist() == [True, False]


@pytest.mark.parametrize("count, more", [(10, False), (11, True)])
def test_single_numbers_are_named_ten_of_them(make, count, more):
    path = make({"x": np.zeros(5), **{f"g/n{k:02d}": float(k) for k in range(count)}, "text": "abc"})
    (remark,) = hdf5.contents(path, []).remarks
    shown = ", ".join(f"g/n{k:02d}" for k in range(10))
    assert remark == f"single numbers, which are not used: {shown}" + (" and more" if more else "")


def test_remarks_on_rates_of_files_and_groups(make):
    sets = {"g/x": np.zeros(5), "g/y": (np.zeros(5), {"dt": 0.5}), "z": np.zeros(5)}
    path = make(
        sets, {"g": {"fs": 100.0, "other": 1}, "/": {"dt": 0.5, "PYTABLES_FORMAT_VERSION": "2.1", "note": "text"}}
    )
    whole = hdf5.contents(path, [])
    assert whole.remarks == (
        "written by PyTables; a table of pandas is read by pandas.read_hdf for from_dataframe",
        "the file has an attribute dt = 0.5, which is not used; give sampling_rate=",
    )
    x, y, z = sorted(whole.channels, key=lambda one: one.name)
    assert x.remarks == ("its group has an attribute fs = 100.0, which is not used; give sampling_rate=",)
    assert y.remarks == z.remarks == () and x.clock is z.clock is None and y.clock.step == 0.5


def test_equal_attributes_of_times_are_one_clock(make):
    path = make({name: (np.zeros(5), {"dt": 0.5, "t0": start}) for name, start in (("x", 0.0), ("y", 0.0), ("z", 1.0))})
    x, y, z = hdf5.contents(path, []).channels
    assert x.clock is y.clock and z.clock is not x.clock and z.clock.start == 1.0


def test_links_are_refused_with_what_they_are(make):
    path = make({"x": np.zeros(5)})
    with h5py.File(path, "a") as file:
        file["link"] = h5py.SoftLink("/x")
        file["other"] = h5py.ExternalLink("secret.h5", "x")
    channels = {one.name: one for one in hdf5.contents(path, []).channels}
    assert {name: one.refusal for name, one in channels.items() if one.refusal} == dict.fromkeys(
        ("link", "other"), "a link or data of another file"
    )
    with pytest.raises(ValueError, match="it is not in this file"):
        channels["other"].values()


def coordinates(path, units="seconds since 2026-01-31", extra=(), **stored):
    """Make a variable of netCDF with a coordinate of its length."""
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(6) / 2
        file["x"] = np.arange(6.0)
        for name, values in extra:
            file[name] = values
            file[name].make_scale(name)
        file["time"].attrs["units"] = units
        for key, value in stored.items():
            file["time"].attrs[key] = value
        file["time"].make_scale("time")
        file["x"].dims[0].attach_scale(file["time"])
    return {one.name: one for one in hdf5.contents(path, []).channels}


def test_coordinate_of_the_length_of_a_variable_is_its_time(tmp_path):
    path = tmp_path / "run.nc"
    clock = coordinates(path)["x"].clock
    assert clock.stored().tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5] and clock.remarks == (
        "times are those of its coordinate 'time'",
    )
    assert clock.origin == np.datetime64("2026-01-31") and clock.refusal == ""
    assert (
        coordinates(path, "ms")["x"].clock.stored()[1] == 0.0005 and coordinates(path, "ms")["x"].clock.origin is None
    )
    assert coordinates(path, "ms", scale_factor=2.0)["x"].clock.stored()[1] == 0.001
    assert coordinates(path, "mm")["x"].clock is None
    assert coordinates(path, extra=[("longer", np.arange(7.0))])["x"].clock is not None
    assert coordinates(path, extra=[("alike", np.arange(6.0))])["x"].clock is None  # which of both is not known
    assert "dates with an attribute gain = 2.0, which is not applied" in coordinates(path, gain=2.0)["x"].clock.refusal
    assert "of calendar 'noleap'" in coordinates(path, calendar="noleap")["x"].clock.refusal
    assert bp.inspect(path).channels


def test_arrays_of_a_file_are_channels_with_clocks_and_remarks(make):
    sets = {
        "a/x": (np.arange(5.0), {"units": "mm", "dt": 0.5}), "a/y": (np.arange(5), {"dt": 0.5}),
        "b/x": (np.arange(7.0), {"dt": 0.25}), "rate": 5.0, "b/count": 7, "text": "none", "z": np.arange(3.0),
    }  # fmt: skip
    whole = hdf5.contents(make(sets), [])
    assert (whole.kind, whole.word, whole.suggested_time, whole.numbered) == ("HDF5 file", "channel", "", True)
    assert [(one.group, one.name, one.samples, one.unit) for one in whole.channels] == [
        ("", "z", 3, ""), ("a", "x", 5, "mm"), ("a", "y", 5, ""), ("b", "x", 7, "")
    ]  # fmt: skip
    first, second, third, fourth = (one.clock for one in whole.channels)
    assert second is third and (first, second.step, fourth.step) == (None, 0.5, 0.25)
    assert [one.values().tolist() for one in whole.channels] == [[0, 1, 2], [*range(5)], [*range(5)], [*range(7)]]
    (remark,) = whole.remarks
    assert "rate" in remark and "b/count" in remark and "text" not in remark
