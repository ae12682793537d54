"""Attributes of HDF5 files: packing and dates after the conventions of netCDF, rates, starts and their units."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from bayesperiodic.data.formats import hdf5_attributes
from bayesperiodic.data.formats.hdf5_attributes import Packing, Since, sampling


@pytest.mark.parametrize(
    "value, expected",
    [
        (0.5, 0.5), (np.int16(7), 7), ("mm", "mm"), (b"mm", "mm"), (np.bytes_("\u00b5m".encode()), "µm"),
        (np.array([5]), 5), (np.array([[5.0]]), 5.0), (np.arange(3), (0, 1, 2)), (np.zeros(64), (0.0,) * 64),
        (np.zeros(65), "65 values"), (["a", "b"], "2 values"), (np.array(["a"], dtype=object), "a"),
        (np.bytes_(b"\xb5m"), "\ufffdm"), (h5py.Empty("f8"), None), (np.zeros(0), None), (1j, None), (True, None),
    ],
)  # fmt: skip
def test_attributes_are_numbers_texts_or_how_many_there_are(tmp_path, value, expected):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        if isinstance(value, np.ndarray) and value.dtype == object:
            file.attrs.create("a", value, dtype=h5py.string_dtype())
        else:
            file.attrs["a"] = value
        file.attrs["other"] = 1
        assert hdf5_attributes.attributes(file) == ({} if expected is None else {"a": expected}) | {"other": 1}


def item(kind):
    return SimpleNamespace(dtype=np.dtype(kind))


@pytest.mark.parametrize(
    "kind, stored, packing, remark",
    [
        ("i2", {}, Packing(), ""), ("f8", {}, Packing(missing=(9.969209968386869e36,)), ""),
        ("f2", {}, Packing(), ""), ("O", {"scale_factor": 2.0}, Packing(), ""),
        ("S5", {"_FillValue": 1}, Packing(), ""),
        ("i2", {"scale_factor": 0.5}, Packing(0.5), "stored values are multiplied by 0.5 and 0 is added"),
        ("i2", {"add_offset": 2}, Packing(1.0, 2.0), "stored values are multiplied by 1 and 2 is added"),
        ("i2", {"scale_factor": 1.0, "add_offset": 0.0}, Packing(), ""),
        ("i2", {"scale_factor": 0.0}, Packing(unused="scale_factor = 0.0"), ""),
        ("i2", {"scale_factor": np.inf, "add_offset": 1.0}, Packing(unused="scale_factor = inf, add_offset = 1.0"), ""),
        ("i2", {"scale_factor": (1.0, 2.0)}, Packing(unused="scale_factor = (1.0, 2.0)"), ""),
        ("i2", {"_FillValue": -9, "missing_value": (-8, -7)}, Packing(missing=(-9.0, -8.0, -7.0)), ""),
        ("i2", {"missing_value": "nan"}, Packing(missing=(np.nan,)), ""),
        ("i2", {"valid_range": (-5, 5)}, Packing(low=-5.0, high=5.0), ""),
        ("i2", {"valid_min": -5, "valid_max": 5}, Packing(low=-5.0, high=5.0), ""),
        ("i2", {"valid_range": (-5, 5), "valid_min": -3}, Packing(low=-3.0, high=5.0), ""),
        ("i1", {"_Unsigned": "TRUE", "_FillValue": -1}, Packing(missing=(255.0,), unsigned=True), ""),
        ("i2", {"_Unsigned": "true", "_FillValue": -1, "missing_value": 0},
         Packing(missing=(65535.0, 0.0), unsigned=True),
         ""), ("i2", {"_Unsigned": "false", "_FillValue": -1}, Packing(missing=(-1.0,)), ""),
    ],
)  # fmt: skip
def test_packing_after_the_conventions_of_netcdf(kind, stored, packing, remark):
    seen = Packing.of(stored, item(kind))
    assert repr(seen) == repr(packing) and seen.remark == remark  # NaN is not equal to itself


@pytest.mark.parametrize(
    "stored, what",
    [
        ({"_FillValue": (1, 2)}, "_FillValue = (1, 2), which is no number"),
        ({"valid_range": (1, 2, 3)}, "valid_range = (1, 2, 3), which is no range"),
        ({"valid_min": "zero"}, "valid_min = zero, which is no number"),
        ({"missing_value": "65 values"}, "missing_value = 65 values, which is no number"),
    ],
)
def test_other_limits_are_refused_with_their_attribute(stored, what):
    refusal = Packing.of(stored, item("f8")).refusal
    assert refusal.startswith(f"an attribute {what}; ") and "give it to from_arrays" in refusal


def test_limits_belong_to_the_valid_values():
    """Values of the stored type are compared, before scale and offset."""
    values = np.arange(-3, 4).astype("i2")
    packing = Packing(0.5, 10.0, missing=(0.0,), low=-2.0, high=2.0)
    assert np.array_equal(packing.unpacked(values), [np.nan, 9, 9.5, np.nan, 10.5, 11, np.nan], equal_nan=True)
    assert Packing().unpacked(values) is values and Packing(missing=(7.0,)).unpacked(values).dtype == np.int16
    assert Packing(offset=1.0).unpacked(values).tolist() == [*range(-2, 5)]
    assert Packing(scale=3.0).unpacked(values).tolist() == [*range(-9, 10, 3)]
    words = np.array(["a"])
    assert Packing(2.0).unpacked(words) is words
    assert Packing(unsigned=True).unpacked(np.array([-1, 5], "i1")).tolist() == [255, 5]
    assert Packing(unsigned=True).unpacked(np.array([-1.0, 5.0])).tolist() == [-1.0, 5.0]


@pytest.mark.parametrize(
    "text, date",
    [
        ("2026-01-31", "2026-01-31"), ("2026-1-31 12:00", "2026-01-31T12:00"), ("2026-01-31T12:00:00+02:00",
        "2026-01-31T10:00"), ("2026-01-31T12:00:00.123456789Z", "2026-01-31T12:00:00.123456789"), ("1678-01-01",
        "1678-01-01"), ("2261-12-31", "2261-12-31"), ("1677-12-31", None), ("2262-01-01", None), ("1-1-1", None),
        ("2026-13-01", None), ("now", None), ("NaT", None), ("20260131", None),
    ],
)  # fmt: skip
def test_dates_after_iso_8601_in_the_years_of_nanoseconds(text, date):
    seen = hdf5_attributes._date(text)
    assert seen is None if date is None else seen == np.datetime64(date, "ns") and seen.dtype == "datetime64[ns]"


@pytest.mark.parametrize(
    "unit, size",
    [
        ("s", 1), ("Seconds", 1), ("ms", 1e-3), ("usec", 1e-6), ("µs", 1e-6), ("ns", 1e-9), ("min", 60),
        ("hours", 3600),
        ("h", 3600), ("days", 86_400), (" s ", 1), ("mm", None), ("", None), ("m", None),
    ],
)  # fmt: skip
def test_units_of_time(unit, size):
    since = Since.of(unit, {})
    assert since is None if size is None else since.seconds(3) == pytest.approx(3 * size, rel=1e-15)
    assert since is None or since.seconds(np.arange(3.0)).tolist() == [
        0.0,
        pytest.approx(size),
        pytest.approx(2 * size),
    ]
    since = Since.of(f"{unit} since 2026-01-31", {})
    assert (since.origin is None) == bool(since.refusal) == (size is None) if since else not unit.strip()


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.uint64, np.float64])
def test_dates_end_where_nanoseconds_do(kind):
    """Integers are refused like floats: NumPy multiplies and adds them modulo 2**64."""
    since = Since.of("days since 2000-01-01", {})
    days = int((np.datetime64("2262-01-01") - np.datetime64("2000-01-01")).astype(int))
    assert since.dates(np.array([days], kind))[0] == np.datetime64("2262-01-01")
    for beyond in ([days + 200], [0, 2 * days], *([] if kind == np.uint64 else [[-10 * days]])):
        with pytest.raises(ValueError, match="its dates are outside of the years from 1678 to 2261"):
            since.dates(np.array(beyond, kind))
    assert since.dates(np.array([], kind)).size == 0


def test_dates_that_cannot_be_read_are_refused_with_what_reads_them():
    for unit, stored, what in (
        ("days since 2026-01-01", {"calendar": "360_day"}, "dates in 'days since 2026-01-01' of calendar '360_day'; "),
        ("weeks since 2026-01-01", {}, "dates in 'weeks since 2026-01-01' of calendar 'standard'; "),
        ("days since noon", {}, "dates since 'noon'; "),
    ):
        assert (
            Since.of(unit, stored).refusal == f"{what}read it by xarray.open_dataset, and give seconds to from_arrays"
        )
    assert Since.of("days since 2026-01-01", {"calendar": "Gregorian"}).refusal == ""


@pytest.mark.parametrize(
    "unit, count, step", [("days", 2, 86_400e9), ("ms", 7, 1e6), ("ns", 5, 1), ("minutes", 3, 60e9)]
)
def test_dates_of_integers_and_floats(unit, count, step):
    """By integer arithmetic of NumPy; a missing float is a missing date."""
    since = Since.of(f"{unit} since 2026-01-31T12:00:00", {})
    expected = np.datetime64("2026-01-31T12:00:00", "ns") + (np.arange(-count, count) * int(step)).astype("m8[ns]")
    for kind in ("i4", "i8", "f8"):
        assert np.array_equal(since.dates(np.arange(-count, count).astype(kind)), expected)
    lost = since.dates(np.array([0.0, np.nan, 1.0, np.inf]))
    assert np.isnat(lost).tolist() == [False, True, False, True] and lost[2] == expected[count + 1]
    assert since.dates(np.zeros(0)).size == 0


@pytest.mark.parametrize("part, exact", [(0.0, True), (0.9e-3, True), (1.1e-3, False), (-1.1e-3, False), (0.5, False)])
def test_dates_may_be_rounded_by_a_thousandth_of_their_step(part, exact):
    since = Since.of("ns since 2026-01-31", {})
    values = np.array([0.0, 1.0 + part, 2.0, 3.0])
    if exact:
        assert (since.dates(values) - since.origin).astype(int).tolist() == [0, 1, 2, 3]
    else:
        with pytest.raises(
            ValueError, match="its dates are finer than nanoseconds; read them with xarray and give seconds"
        ):
            since.dates(values)
    assert since.dates(np.array([0.3, 0.3])).size == 2  # without a step


@pytest.mark.parametrize("years, inside", [(292.0, True), (293.0, False), (-293.0, False)])
def test_dates_beyond_the_years_of_nanoseconds_are_refused(years, inside):
    """2**63 ns are 292.3 years of 365.2425 days."""
    since = Since.of("days since 1970-01-01", {})
    if inside:
        assert since.dates(np.array([years * 365.0]))[0] < np.datetime64("2262-01-01")
        return
    with pytest.raises(ValueError, match="its dates are outside of the years from 1678 to 2261"):
        since.dates(np.array([0.0, years * 365.2425]))


@pytest.mark.parametrize(
    "stored, start, step",
    [
        ({"dt": 0.01}, 0.0, 0.01), ({"Sampling Rate": 250}, 0.0, 0.004), ({"dt": 0.01, "t0": 2.0}, 2.0, 0.01),
        ({"dt": 10.0, "dt_unit": "ms", "t0": 2.0, "t0_unit": "s"}, 2.0, 0.01),
        ({"fs": 0.1, "fs_unit": "kHz", "t0": 99_999_999.0}, 99_999_999.0, 0.01),
        ({"dt": 0.01, "fs": 100.0 * (1 + 1e-13)}, 0.0, 0.01), ({"dt": 1.0, "time_unit": "min"}, 0.0, 60.0),
        ({"dt": 0.01, "sampling_unit": "Hz", "fs": 100.0}, 0.0, 0.01),
        ({"fs": 2.0, "sampling_unit": "GHz"}, 0.0, 5e-10),
    ],
)  # fmt: skip
def test_times_by_rate_or_interval_and_start(stored, start, step):
    clock = sampling(stored)
    assert clock.refusal == "" and (clock.start, clock.origin, clock.error) == (start, None, 0.0)
    assert clock.step == pytest.approx(step, rel=1e-12)
    shown = [f"{key} = {value}" for key, value in stored.items() if "t0" != key]
    assert clock.remarks[0].startswith("times are those of its attributes ") and all(
        x in clock.remarks[0] for x in shown
    )


@pytest.mark.parametrize(
    "stored, what",
    [
        ({"dt": 0.01, "fs": 100.0 * (1 + 1e-11)},
         "whose attributes dt = 0.01, fs = 100.000000001 contradict each other"),
        ({"fs": -1.0}, "whose attributes say fs = -1.0"), ({"fs": 0}, "whose attributes say fs = 0"),
        ({"fs": np.inf}, "whose attributes say fs = inf"), ({"fs": (1, 2)}, "whose attributes say fs = (1, 2)"),
        ({"fs": 1.0, "fs_unit": "mHz"}, "whose attributes fs = 1.0, fs_unit = mHz do not say one unit"),
        ({"dt": 1.0, "sampling_unit": "kHz"}, "whose attributes dt = 1.0, sampling_unit = kHz do not say one unit"),
        ({"fs": 1.0, "sampling_unit": "ms"}, "whose attributes fs = 1.0, sampling_unit = ms do not say one unit"),
        ({"dt": 1.0, "t0": 1e8}, "whose attribute t0 = 100000000.0 is no start in seconds or after ISO 8601"),
        ({"dt": 1.0, "t0": -1e8}, "whose attribute t0 = -100000000.0 is no start in seconds or after ISO 8601"),
        ({"dt": 1.0, "t0": np.nan}, "whose attribute t0 = nan is no start in seconds or after ISO 8601"),
        ({"dt": 1.0, "dt_unit": "ms", "t0": 2.0}, "whose attribute t0 = 2.0 has no unit"),
        ({"dt": 1.0, "t0": 1.0, "start_time": 2.0},
         "whose attributes t0 = 1.0, start_time = 2.0 contradict each other"),
    ],
)  # fmt: skip
def test_times_that_attributes_leave_open_are_refused_with_the_attributes(stored, what):
    assert sampling(stored).refusal == what


@pytest.mark.parametrize(
    "more, start",
    [({"fs": -1.0}, 2.5), ({"fs_unit": "mHz", "t0": 0.0}, 0.0), ({"sampling_unit": "ms"}, 0.0025), ({"dt": 1.0}, 2.5)],
)
def test_start_and_origin_remain_where_attributes_leave_the_rate_open(more, start):
    """They are used with a rate that the user gives."""
    clock = sampling({"fs": 100.0, "t0": 2.5, "start_time": "2026-01-31T12:00:00"} | more)
    assert clock.refusal and np.isnan(clock.step)
    assert (clock.start, clock.origin) == (start, np.datetime64("2026-01-31T12:00:00", "ns"))
    clock = sampling({"fs": 100.0, "t0": 2.5, "start_time": "now"} | more)
    assert clock.refusal and (clock.start, clock.origin) == (0.0, None)


@pytest.mark.parametrize("place", [0, 1])
def test_first_and_last_dates_of_nanoseconds(place):
    """From 1 - 2**63 to 2**63 - 1, as the number before them is no date."""
    for origin, low, high in ((0, 1 - 2**63, 2**63 - 1), (-5, 6 - 2**63, 2**63 - 1), (5, 1 - 2**63, 2**63 - 6)):
        since = Since(1, np.datetime64(origin, "ns"))
        for end, inside in ((low, 1), (high, -1)):
            values = [0, 0]
            for values[place], sound in ((end, True), (end + inside, True), (end - inside, False)):
                if not -(2**63) <= values[place] < 2**63:
                    continue
                if sound:
                    dates = since.dates(np.array(values, np.int64))
                    assert dates.astype(np.int64).tolist() == [origin + value for value in values]
                    continue
                with pytest.raises(ValueError, match="its dates are outside of the years from 1678 to 2261"):
                    since.dates(np.array(values, np.int64))


@pytest.mark.parametrize(
    "stored, unit, expected",
    [
        ({}, 10**9, (0.0, None, "")), ({"t0": 2.5}, 10**9, (2.5, None, "")), ({"t0": 2.5}, 10**6, (0.0025, None, "")),
        ({"t0": 2.5, "wf_start_offset": 2.5}, 10**9, (2.5, None, "")), ({"t0": 0}, None, (0.0, None, "")),
        ({"t0": 2.5}, None, (0.0, None, "whose attribute t0 = 2.5 has no unit")),
        ({"t0": 2.5, "t_start": 3.5}, 10**9, (0.0, None,
         "whose attributes t0 = 2.5, t_start = 3.5 contradict each other")),
        ({"t0": 2.5, "start_time": "2026-01-31"}, 10**9, (2.5, np.datetime64("2026-01-31", "ns"), "")),
        ({"start_time": "2026-01-31", "t0": "2026-01-30", "t_start": 1}, 10**9,
         (0.0, None, "whose attributes start_time = 2026-01-31, t0 = 2026-01-30 contradict each other")),
        ({"t0": 2.5, "start_time": "noon"}, 10**9,
         (0.0, None, "whose attribute start_time = noon is no start in seconds or after ISO 8601")),
        ({"gain": 2.0, "t0": np.float32(0.1)}, 10**9, (0.1, None, "")),
    ],
)  # fmt: skip
def test_start_and_origin_of_attributes(stored, unit, expected):
    """Equal ones count once; of single precision, the decimal number is meant."""
    assert hdf5_attributes._start(stored, unit) == expected


def test_zero_start_needs_no_unit_and_other_attributes_say_no_times():
    clock = sampling({"dt": 1.0, "dt_unit": "ms", "t0": 0.0})
    assert (clock.refusal, clock.start) == ("", 0.0)
    clock = sampling({"dt": 1.0, "start_time": "2026-01-31T12:00:00+01:00"})
    assert clock.origin == np.datetime64("2026-01-31T11:00:00", "ns") and clock.start == 0.0
    assert sampling({"t0": 1.0, "rate": "fast", "units": "mm"}) is None
    assert sampling({"dt": np.float32(1 / 48000)}).error == pytest.approx(0.5e-12, rel=1e-3)  # of 2.0833333e-05
    assert sampling({"dt": np.float32(1 / 48), "dt_unit": "ms"}).error == pytest.approx(
        0.5e-12, rel=1e-3
    )  # 0.020833334


@pytest.mark.parametrize(
    "stored, said",
    [
        ({"gain": 0.5}, "gain = 0.5"), ({"gain": 1.0}, ""), ({"offset": 0.0}, ""), ({"offset": 1.0}, "offset = 1.0"),
        ({"zero_level": 0}, ""), ({"full_scale": 1.0}, "full_scale = 1.0"), ({"resolution": 1.0}, ""),
        ({"resolution": -1.0}, ""), ({"resolution": 2.0}, "resolution = 2.0"), ({"gain": -1.0}, "gain = -1.0"),
        ({"gain": (1.0, 1.0)}, ""), ({"gain": (1.0, 2.0)}, "gain = (1.0, 2.0)"), ({"gain": "auto"}, "gain = auto"),
        ({"my_calib": "yes"}, ""), ({"my_calib": "2.0 V"}, "my_calib = 2.0 V"), ({"scale_factor": 2.0}, ""),
        ({"calibration_date": 2.0}, ""), ({"wf_start_offset": 2.0}, ""), ({"sensor": 2.0}, ""), ({"factory": 2.0}, ""),
        ({"name": "x", "add_offset": 2.0, "calibration_date": 1.0, "my_calib": "yes", "slope": 1.0, "gain": 3},
         "gain = 3"),
    ],
)  # fmt: skip
def test_scales_of_no_convention_are_named_unless_they_change_nothing(stored, said):
    """A factor of 1 and an offset of 0 do not; a resolution of -1 is unknown in Neurodata Without Borders."""
    assert hdf5_attributes.unused_scale(stored) == said


@pytest.mark.parametrize(
    "stored, kind, said",
    [
        ({"range": 10}, "i2", "range = 10"), ({"range": 10}, "f4", ""),
        ({"Range": (-5.0, 5.0)}, "i2", "Range = (-5.0, 5.0)"),
        ({"range": (-32768, 32767)}, "i2", ""), ({"range": (-32767, 32768)}, "i2", ""), ({"range": 65_536}, "i2", ""),
        ({"range": 65_535}, "i2", "range = 65535"), ({"range": (0, 255)}, "u1", ""), ({"range": 256}, "u1", ""),
        ({"range": "±10 V"}, "i2", "range = ±10 V"), ({"valid_range": 10}, "i2", ""),
        ({"adc_counts": 4096}, "i4", "adc_counts = 4096"),
        ({"range": 0, "name": "x", "fsr": 5}, "i2", "fsr = 5"),
    ],
)  # fmt: skip
def test_ranges_of_a_converter_say_what_integers_mean_and_those_of_their_type_do_not(stored, kind, said):
    assert hdf5_attributes.meaning_of_integers(stored, np.dtype(kind)) == said


@pytest.mark.parametrize(
    "key, of",
    [
        ("fs_unit", "rate"), ("Sampling Rate Units", "rate"), ("rate_unit", "rate"), ("unit_freq", "rate"),
        ("dt_units", "step"),
        ("increment unit string", "step"), ("wf_increment_unit_label", "step"), ("period_unit_name", "step"),
        ("t0_unit", "start"),
        ("start unit", "start"), ("time_unit", ""), ("x-unit", ""), ("wf_xunit_string", ""), ("sampling_unit", ""),
        ("unit", None), ("units", None), ("fs", None), ("y_unit", None), ("time", None), ("temperature_unit", None),
    ],
)  # fmt: skip
def test_attributes_of_units_say_of_what(key, of):
    assert hdf5_attributes._unit_of(key) == of


@pytest.mark.parametrize(
    "units, factors",
    [
        ({}, (1.0, 10**9, 10**9, "")), ({"fs_unit": "kHz"}, (1e3, 10**9, 10**9, "")),
        ({"fs_unit": " GHz "}, (1e9, 10**9, 10**9, "")),
        ({"dt_unit": "ms"}, (1.0, 10**6, None, "")), ({"dt_unit": "ms", "t0_unit": "us"}, (1.0, 10**6, 10**3, "")),
        ({"t0_unit": "ms"}, (1.0, 10**9, 10**6, "")), ({"time_unit": "ms"}, (1.0, 10**6, 10**6, "step")),
        ({"time_unit": "s"}, (1.0, 10**9, 10**9, "")), ({"sampling_unit": "Hz"}, (1.0, 10**9, 10**9, "")),
        ({"sampling_unit": "MHz"}, (1e6, 10**9, 10**9, "rate")),
        ({"x_unit": "ms", "dt_unit": "ms"}, (1.0, 10**6, 10**6, "step")),
        ({"x_unit": "ms", "t_unit": "s"}, None), ({"fs_unit": "kHz", "rate_unit": "Hz"}, None),
        ({"fs_unit": "ms"}, None),
        ({"dt_unit": "Hz"}, None), ({"dt_unit": "mm"}, None), ({"time_unit": "mm"}, None),
        ({"dt_unit": "ms since 2026-01-31"}, None),
        ({"x_unit": "ms", "sampling_unit": "s"}, None),
        ({"sampling_unit": "kHz", "time_unit": "s"}, (1e3, 10**9, 10**9, "rate")),
    ],
)  # fmt: skip
def test_factors_of_units_of_rates_steps_and_starts(units, factors):
    """In hertz and nanoseconds; the unit of a start is not known beside a step in another one than seconds."""
    seen = hdf5_attributes._factors(units)
    assert seen == (factors and dict(zip(("rate", "step", "start", "other"), factors, strict=True)))


@pytest.mark.parametrize(
    "value, numbers",
    [
        (5, [5.0]), (np.float32(0.5), [0.5]), ((1, 2.5), [1.0, 2.5]), ("NaN", [np.nan]), (" nan ", [np.nan]),
        ("5", None),
        ((1, "a"), None), ((), []), ("65 values", None),
    ],
)  # fmt: skip
def test_numbers_of_attributes(value, numbers):
    np.testing.assert_equal(hdf5_attributes._numbers(value), numbers)


@pytest.mark.parametrize(
    "stored, step, error",
    [
        ({"dt": np.float32(0.033333)}, 0.033333, 5e-7), ({"dt": np.float32(33.333), "dt_unit": "ms"}, 0.033333, 5e-7),
        ({"dt": 0.033333}, 0.033333, 0.0), ({"fs": np.float32(30.0003)}, 1 / 30.0003, 0.0),
        ({"dt": np.float32(0.25)}, 0.25, 0.0),
        ({"dt": np.float16(0.1)}, 0.1, 0.0),
    ],
)  # fmt: skip
def test_step_of_single_precision_has_the_error_of_its_digits(stored, step, error):
    clock = sampling(stored)
    assert clock.step == pytest.approx(step, rel=1e-12) and clock.error == pytest.approx(error, rel=0.01)
