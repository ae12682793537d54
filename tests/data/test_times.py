"""Times as dates and durations, against integer arithmetic and Python's fractions."""

import datetime
import re
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import bayesperiodic as bp
from bayesperiodic.data.times import between, channel_seconds, nanoseconds, seconds, shared

COUNT, STEP = 400, 10_000_019  # nanoseconds, no round number
NANOSECONDS = np.arange(COUNT) * STEP
START = np.datetime64("2026-03-29T00:59:58.123456789", "ns")  # two seconds before the clocks change
DATES = START + NANOSECONDS.astype("timedelta64[ns]")
EXACT = np.array([float(Fraction(int(n), 10**9)) for n in NANOSECONDS])
SIGNAL = np.sin(2 * np.pi * 3.0 * EXACT)


def zoned(zone):
    return pd.DatetimeIndex(DATES).tz_localize("UTC").tz_convert(zone)


@pytest.mark.parametrize(
    "time",
    [
        DATES, DATES - START, DATES - START + np.timedelta64(10**18, "ns"), pd.Series(DATES), pd.DatetimeIndex(DATES),
        pd.Series(DATES, index=np.arange(COUNT)[::-1]), pd.to_timedelta(NANOSECONDS, unit="ns"), list(DATES),
        pd.Series(pd.to_timedelta(NANOSECONDS, unit="ns")), zoned("Europe/Berlin"), pd.Series(zoned("Asia/Kolkata")),
        list(zoned("Europe/Berlin")), xr.DataArray(SIGNAL, coords={"time": DATES}, dims="time").time,
        xr.DataArray(SIGNAL, coords={"time": DATES}, dims="time")["time"].to_index(), DATES.astype(str),
        pd.Series(DATES.astype(str)), zoned("Europe/Berlin").map(lambda date: date.isoformat()),
    ],
    ids=str,
)  # fmt: skip
def test_dates_and_durations_become_seconds_from_the_first_sample(time):
    recording = bp.Recording.from_arrays(time, {"x": SIGNAL})
    assert np.array_equal(recording.time, EXACT)
    assert np.array_equal(bp.Recording(time, {"x": SIGNAL}, {}).time, EXACT)
    assert recording.fold(16, harmonics=1).frequency == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize(
    ("unit", "size"),
    [("W", 604_800), ("D", 86_400), ("h", 3600), ("m", 60), ("s", 1), ("10ms", Fraction(1, 100)),
     *((name, Fraction(1, 1000**power)) for power, name in enumerate(("ms", "us", "ns", "ps", "fs", "as"), 1))],
)  # fmt: skip
@pytest.mark.parametrize("kind", ["datetime64", "timedelta64"])
def test_every_resolution_of_numpy_is_converted_exactly(kind, unit, size):
    counts = np.array([3, 4, 7, 1_000_003])
    expected = [float(Fraction(size) * int(count - 3)) for count in counts]
    assert seconds("time", counts.astype(f"{kind}[{unit}]")).tolist() == expected


def test_dates_by_month_and_year_have_the_length_of_the_calendar():
    assert seconds("time", np.array(["2024-02", "2024-03", "2025-03"], "datetime64[M]")).tolist() == [
        0, 29 * 86_400, (29 + 365) * 86_400,
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"time: must be durations in weeks or a shorter unit, got timedelta64\[M\]"):
        bp.Recording.from_arrays(np.arange(3).astype("timedelta64[M]"), {"x": [1.0, 2.0, 3.0]})
    with pytest.raises(ValueError, match=r"time: must be durations in weeks or a shorter unit, got timedelta64"):
        bp.Recording.from_arrays(np.arange(3).astype("timedelta64"), {"x": [1.0, 2.0, 3.0]})


def test_python_dates_and_durations_are_converted():
    start, step = datetime.datetime(2026, 1, 31, 12), datetime.timedelta(microseconds=1500)
    for zone in (None, datetime.UTC, datetime.timezone(datetime.timedelta(hours=5))):
        dates = [start.replace(tzinfo=zone) + i * step for i in range(4)]
        assert bp.Recording.from_arrays(dates, {"x": range(4)}).time.tolist() == [0.0, 0.0015, 0.003, 0.0045]
    durations = [step + i * step for i in range(4)]
    assert bp.Recording.from_arrays(durations, {"x": range(4)}).time.tolist() == [0.0, 0.0015, 0.003, 0.0045]


def test_numbers_keep_their_origin_unless_no_float_holds_them():
    assert seconds("time", [5.0, 6.0]) == [5.0, 6.0]
    assert bp.Recording.from_arrays(np.array([5, 6]), {"x": [1, 2]}).time.tolist() == [5.0, 6.0]
    epoch = 1_774_000_000_123_456_789
    for kind in (np.int64, np.uint64):
        assert seconds("time", np.array([epoch, epoch + 1, epoch + 5], kind), unit=True).tolist() == [0, 1, 5]


@pytest.mark.parametrize(
    ("first", "step", "message"),
    [
        (1_774_000_000_123, 10, r"as ms since 1970; give times.astype\('datetime64\[ms\]'\)"),
        (1_774_000_000_123_456, 10_000, r"as us since 1970; give times.astype\('datetime64\[us\]'\)"),
        (1_774_000_000_123_456_789, 10**7, r"as ns since 1970; give times.astype\('datetime64\[ns\]'\)"),
        (0, 1_000, r"in steps of 1000, as us; give times.astype\('timedelta64\[us\]'\)"),
        (5, 10**7, r"in steps of 1e\+07, as ns; give times.astype\('timedelta64\[ns\]'\)"),
    ],
)
def test_integers_that_are_no_seconds_are_refused_with_their_unit(first, step, message):
    time = first + step * np.arange(COUNT)
    kinds = time, time.tolist(), time.astype(np.uint64), time.astype(object), pd.Series(time), np.ma.array(time)
    for given in (*kinds, {"x": time}):
        with pytest.raises(ValueError, match=rf"^time(\['x'\])?: must be in seconds, got .*{message}"):
            bp.Recording.from_arrays(given, {"x": SIGNAL})
    cure = re.search(r"astype\('(.*?)'\)", message.replace("\\", ""))[1]
    at = bp.Recording.from_arrays(time.astype(cure), {"x": SIGNAL}).time
    size = {"ms": 1e3, "us": 1e6, "ns": 1e9}[cure[-3:-1]]
    assert at == pytest.approx(step * np.arange(COUNT) / size, rel=1e-15)
    # As floats they are seconds.
    assert np.ptp(bp.Recording.from_arrays(time.astype(float), {"x": SIGNAL}).time) > 1e2 * size * at[1]


@pytest.mark.parametrize(("first", "step"), [(0, 1), (0, 10), (1_774_000_000, 1), (0, 3600), (1_774_000_000, 86_400)])
def test_integers_that_may_be_seconds_are_seconds(first, step):
    time = first + step * np.arange(COUNT)
    assert np.array_equal(bp.Recording.from_arrays(time, {"x": SIGNAL}).time, time)


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (99_999_999_999, 1, None), (10**11, 1, "ms"), (-(10**11), 1, "ms"), (10**14 - 1, 1, "ms"), (10**14, 1, "us"),
        (10**17 - 1, 1, "us"), (10**17, 1, "ns"), (0, 999, None), (0, 1000, "us"), (0, 1020, None), (0, 999_999, "us"),
        (0, 10**6, "ns"), (5000, -1001, "us"),
    ],
)  # fmt: skip
def test_integers_are_smaller_units_from_a_size_or_step_on(first, step, unit):
    """Of the year 5138, of 1000 s and no whole minutes, and of more than a second of microseconds."""
    values = first + step * np.arange(5)
    if unit is None:
        assert seconds("time", values) is values
        return
    got = f"{first}, as {unit} since 1970" if step == 1 else f"integers in steps of {abs(step):.6g}, as {unit}"
    kind = "datetime64" if step == 1 else "timedelta64"
    message = f"time: must be in seconds, got {got}; give times.astype('{kind}[{unit}]') for these (of a file, units="
    for given in (values, list(map(int, values)), np.ma.array(values), [*map(int, values), None]):
        with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
            seconds("time", np.array(given, dtype=object) if isinstance(given, list) else given)
    with pytest.raises(ValueError, match=re.escape(message).replace("time:", r"time\['x'\]:")):
        channel_seconds({"x": values})
    assert seconds("time", values, unit=True) is not None and seconds("time", values.astype(float)).dtype == float


def test_single_integers_and_tables_are_left_to_other_checks():
    for values in (np.array([10**12]), np.full((2, 2), 10**12), np.array([0.5, 10**12])):
        assert seconds("time", values) is values
    mixed = np.array([10**12, 1.5], dtype=object)
    assert seconds("time", mixed) is mixed


@pytest.mark.parametrize(
    "values, exact",
    [([0, 2**53], True), ([-(2**53), 0], True), ([0, 2**53 + 1], False), ([-(2**53) - 1, 0], False), ([], True)],
)
def test_integers_that_floats_hold_are_not_shifted(values, exact):
    array = np.array(values, dtype=np.int64)
    read = seconds("time", array, unit=True)
    assert read is array if exact else read.tolist() == [value - values[0] for value in values]


def test_masked_dates_are_missing():
    masked = np.ma.array(DATES[:3], mask=[True, False, False])
    read = seconds("time", masked)
    assert np.isnan(read[0]) and read[1:].tolist() == [0.0, float(STEP) / 1e9]
    assert np.isnan(seconds("time", np.ma.array(DATES[:3], mask=True))).all()


def test_channels_with_the_same_times_share_an_array():
    a, b = np.arange(3.0), np.arange(4.0)
    result = shared({"x": a, "y": a.copy(), "z": b, "u": b.copy(), "v": a, "w": np.array([0.0, 1.0, 3.0])})
    assert result["x"] is result["y"] is result["v"] is a and result["z"] is result["u"] is b
    assert result["w"].tolist() == [0.0, 1.0, 3.0] and [*result] == [*"xyzuvw"]


def test_dates_of_channels_count_from_the_earliest_one_that_is_not_missing():
    first = np.array(["NaT", "2026-01-01T00:00:02"], "datetime64[s]")
    read = channel_seconds({"x": first, "y": first[1:] - np.timedelta64(1, "s"), "z": first[1]})
    assert np.isnan(read["x"][0]) and [read["x"][1], read["y"][0], read["z"][0]] == [1.0, 0.0, 1.0]
    durations = channel_seconds({"x": np.array([1500, 2000], "m8[ms]"), "y": np.array([1], "m8[s]")})
    assert durations["x"].tolist() == [0.5, 1.0] and durations["y"].tolist() == [0.0]


def test_integers_of_a_file_need_a_unit(tmp_path):
    path = tmp_path / "run.csv"
    pd.DataFrame({"t": 1_774_000_000_123_456_789 + NANOSECONDS, "x": SIGNAL}).to_csv(path, index=False)
    with pytest.raises(
        ValueError, match=r"time \(column 't' of .*\): must be in seconds, .*units=\{'time': \('ns', 's'\)\}"
    ):
        bp.Recording.from_csv(path, time="t", outputs={"x": "x"})
    run = bp.Recording.from_csv(path, time="t", outputs={"x": "x"}, units={"time": ("ns", "s")})
    assert run.time == pytest.approx(EXACT, rel=1e-14)


@pytest.mark.parametrize("time", [DATES, pd.Series(DATES), list(pd.DatetimeIndex(DATES)), DATES.astype(str)], ids=type)
def test_missing_times_are_refused_or_left_out(time):
    lost = [0, 1, 7]
    if isinstance(time, np.ndarray):
        time = np.ma.array(time, mask=np.isin(np.arange(COUNT), lost))
    else:
        time = pd.Series([pd.NaT if i in lost else date for i, date in enumerate(time)])
    with pytest.raises(ValueError, match=r"time: must be finite, got nan at index 0 \(3 of 400 .*missing='drop'"):
        bp.Recording.from_arrays(time, {"x": SIGNAL})
    recording = bp.Recording.from_arrays(time, {"x": SIGNAL}, missing="drop")
    rest = np.delete(NANOSECONDS, lost)
    assert recording.time.tolist() == ((rest - rest[0]) / 1e9).tolist()
    assert np.array_equal(recording.outputs["x"], np.delete(SIGNAL, lost))


def test_texts_with_picoseconds_are_refused():
    """Pandas would drop the digits, see findings/pandas_digits_of_seconds.sh."""
    texts = [f"2026-01-01T00:00:00.12345678{k:02d}" for k in range(10)]
    with pytest.raises(
        ValueError, match=r"^time: must have at most nine decimals of a second, got '2026-01-01T00:00:00"
    ):
        bp.Recording.from_arrays(texts, {"x": np.arange(10.0)})


def test_texts_that_are_no_dates_are_named():
    texts = ["2026-01-31T12:00:00", "2026-01-31T12:00:01", "noon"]
    with pytest.raises(ValueError, match="time: must be dates, such as 2026-01-31.*, got 'noon' at index 2"):
        bp.Recording.from_arrays(texts, {"x": [1, 2, 3]})
    with pytest.raises(ValueError, match="time: must be dates, .*all of one kind, got 'noon' at index 1"):
        bp.Recording.from_arrays([datetime.datetime(2026, 1, 1), "noon"], {"x": [1, 2]})
    with pytest.raises(ValueError, match="time: must be an array of real numbers, got .*31.01.2026"):
        bp.Recording.from_arrays(["31.01.2026 12:00", "31.01.2026 12:01"], {"x": [1, 2]})


@pytest.mark.parametrize(
    "time", [[[1], [2, 3]], ["a", "b"], None, {"x": ["a", "b"]}, pd.period_range("2026", periods=2)], ids=str
)
def test_what_is_no_time_is_refused_as_such(time):
    with pytest.raises(ValueError, match=r"time(\['x'\])?: must be (an array of real numbers|one-dimensional), got"):
        bp.Recording.from_arrays(time, {"x": [1, 2]})


def test_times_by_channel_are_those_of_all_channels():
    with pytest.raises(ValueError, match="time: must be 'x', got 't'|time: must be one of 'x', got 't'"):
        bp.Recording.from_arrays({"t": [1, 2]}, {"x": [1, 2]})
    with pytest.raises(ValueError, match="time: must have 'x', 'y', got no 'y'"):
        bp.Recording.from_arrays({"x": [1, 2]}, {"x": [1, 2], "y": [1, 2]})
    with pytest.raises(ValueError, match="time: must be dates or durations of all channels, .* numbers of 'y'"):
        bp.Recording.from_arrays({"x": DATES, "y": EXACT}, {"x": SIGNAL, "y": SIGNAL})


def test_dates_of_several_channels_are_counted_from_the_earliest_one():
    late = DATES + np.timedelta64(2, "s")
    run = bp.Recording.from_arrays({"x": late, "y": DATES}, {"x": SIGNAL, "y": SIGNAL})
    assert run.time["y"][0] == 0.0 and run.time["x"] == pytest.approx(run.time["y"] + 2.0, abs=1e-9)


@pytest.mark.parametrize(
    "first, second, days",
    [
        (np.datetime64("1970-01-01", "ns"), np.datetime64("2290-01-01", "D"), 320 * 365 + 78),
        (np.datetime64(0, "fs"), np.datetime64("2026-03-01", "s"), 56 * 365 + 14 + 59),
        (np.datetime64(0, "as"), np.datetime64("2026-03-01", "us"), 56 * 365 + 14 + 59),
        (np.datetime64("1970-01", "M"), np.datetime64("1970-01-31", "ns"), 30),
    ],
)
def test_dates_of_channels_in_different_units_lose_nothing(first, second, days):
    """NumPy 2.4 converts both to the smaller unit, in which the later one may be another date; 2.5 raises an error."""
    read = channel_seconds({"x": first + np.arange(3), "y": second + np.arange(3)})
    assert read["x"][0] == 0.0 and read["y"][0] == days * 86_400.0
    assert np.all(np.diff(read["x"]) > 0.0) and np.all(np.diff(read["y"]) > 0.0)


def test_dates_and_durations_of_channels_are_refused():
    with pytest.raises(
        ValueError, match="^time: must be dates of all .* or durations of all, got both; convert one kind of them.$"
    ):
        channel_seconds({"x": DATES, "y": DATES - START})


def test_zoned_dates_beyond_nanoseconds_keep_their_unit():
    time = pd.DatetimeIndex(np.array(["2500-01-01T00:00:00", "2500-01-01T00:00:01"], "datetime64[us]"), tz="UTC")
    assert seconds("time", time).tolist() == [0.0, 1.0] and seconds("time", pd.Series(time)).tolist() == [0.0, 1.0]


def test_time_between_dates_of_centuries_is_exact():
    first, last = np.datetime64("1678-01-01", "ns"), np.datetime64("2261-12-31", "ns")
    assert between(last, first) == (datetime.date(2261, 12, 31) - datetime.date(1678, 1, 1)).days * 86_400.0
    assert between(first, last) == -between(last, first)


@pytest.mark.parametrize("date, unit", [("1677-12-31", "D"), ("2262-01-01", "s"), ("9999-12-31", "us"), ("1300", "Y")])
def test_dates_that_nanoseconds_do_not_reach_are_refused(date, unit):
    with pytest.raises(ValueError, match=f"time: must be of the years from 1678 to 2261, got {date}"):
        nanoseconds("time", np.datetime64(date, unit))
    assert nanoseconds("time", np.datetime64("2261-12-31", unit)).astype("datetime64[D]").astype(object).year == 2261


def test_dates_are_no_values_of_a_channel():
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must be an array of real numbers, got .*datetime64\[ns\]"):
        bp.Recording.from_arrays(EXACT, {"x": DATES})
    with pytest.raises(ValueError, match="outputs.*: must be an array of real numbers"):
        bp.Experiment("run", 1.0, {"x": (DATES - START)[:8]}, samples=8)
    with pytest.raises(ValueError, match="start, stop: must be an array of real numbers, got"):
        bp.Recording.from_arrays(DATES, {"x": SIGNAL}).between(DATES[3], DATES[9])


@pytest.mark.parametrize("separator", ["T", " "])
@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_iso_dates_of_a_file_are_times(tmp_path, separator, zone):
    table = pd.DataFrame({"date": [text.replace("T", separator) + zone for text in DATES.astype(str)], "x": SIGNAL})
    table["step"] = np.arange(COUNT) // 200
    table.to_csv(tmp_path / "run.csv", index=False)
    columns = {"time": "date", "outputs": {"x": "x"}}
    assert np.array_equal(bp.Recording.from_csv(tmp_path / "run.csv", **columns).time, EXACT)
    first, second = bp.Recording.from_csv(tmp_path / "run.csv", **columns, split="step")
    assert np.array_equal(np.concatenate([first.time, second.time]), EXACT)
    with pytest.raises(ValueError, match=r"units\['time'\]: must be left out for a column of dates"):
        bp.Recording.from_csv(tmp_path / "run.csv", **columns, units={"time": ("ms", "s")})
    table.loc[[0, 5], "date"] = ""
    table.to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(ValueError, match=r"time \(column 'date' of run.csv\): must be finite, got nan at index 0 \(2"):
        bp.Recording.from_csv(tmp_path / "run.csv", **columns)
    time = bp.Recording.from_csv(tmp_path / "run.csv", **columns, missing="drop").time
    assert np.array_equal(time, np.delete(NANOSECONDS - STEP, [0, 5]) / 1e9)
    table.loc[7, "date"] = "yesterday"
    table.to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(ValueError, match="column 'date' of run.csv: must be dates, .* got 'yesterday' at index 7"):
        bp.Recording.from_csv(tmp_path / "run.csv", **columns)


def test_dates_without_a_known_order_are_refused_with_the_way_to_read_them(tmp_path):
    pd.DataFrame({"date": ["31 Jan 2026 12:00", "31 Jan 2026 12:01"], "x": [1, 2]}).to_csv(
        tmp_path / "run.csv", index=False
    )
    with pytest.raises(ValueError, match="got '31 Jan 2026 12:00' in data row 1; .*date_format="):
        bp.Recording.from_csv(tmp_path / "run.csv", time="date", outputs={"x": "x"})
    run = bp.Recording.from_csv(tmp_path / "run.csv", time="date", outputs={"x": "x"}, date_format="%d %b %Y %H:%M")
    assert run.time.tolist() == [0.0, 60.0]


def test_dates_and_large_integers_of_an_npz_file_are_times(tmp_path):
    epoch = START.astype(np.int64) + NANOSECONDS
    np.savez(tmp_path / "run.npz", date=DATES, epoch=epoch, x=SIGNAL)
    run = bp.Recording.from_npz(tmp_path / "run.npz", time="date", outputs={"x": "x"})
    assert np.array_equal(run.time, EXACT)
    with pytest.raises(ValueError, match="column 'date' of run.npz: must be one column of real numbers, .*datetime64"):
        bp.Recording.from_npz(tmp_path / "run.npz", sampling_rate=1.0, outputs={"x": "date"})
    columns = {"time": "epoch", "outputs": {"x": "x"}, "units": {"time": ("ns", "s")}}
    assert bp.Recording.from_npz(tmp_path / "run.npz", **columns).time == pytest.approx(EXACT, rel=1e-15)
    pd.DataFrame({"epoch": epoch, "x": SIGNAL}).to_csv(tmp_path / "run.csv", index=False)
    assert bp.Recording.from_csv(tmp_path / "run.csv", **columns).time == pytest.approx(EXACT, rel=1e-15)
