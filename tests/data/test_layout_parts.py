"""Columns of times, numbers of cells, clocks and origins of `layout`, and units, one function at a time."""

import re
from decimal import Decimal
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic.data import layout, units
from bayesperiodic.data.formats.contents import Clock, Contents, StoredChannel
from bayesperiodic.data.layout import Layout

EPOCH = 1_774_000_000_123_456_789
TICKS = EPOCH + np.array([0, 1, 5, 9]) * 10**7


def made(values, unit="", refusal="", **given):
    """Return a layout of a channel x and times t, and the file's contents."""
    fields = {"outputs": {"x": "x"}, "inputs": {}, "time": "t", "sampling_rate": None, "units": {}, "missing": None}
    x = StoredChannel("x", 4, lambda: np.arange(4.0))
    t = StoredChannel("t", len(values), lambda: np.array(values), "", unit, refusal=refusal)
    return Layout("run.x", **fields | given), Contents("a file", (x, t), word="column")


@pytest.mark.parametrize(
    "values, unit, given, expected",
    [
        (TICKS, "", 1e-9, [0.0, 0.01, 0.05, 0.09]),
        (TICKS, "ns", None, [0.0, 0.01, 0.05, 0.09]),
        (TICKS, "", ("ns", "s"), [0.0, 0.01, 0.05, 0.09]),
        (TICKS, "ns", "s", [0.0, 0.01, 0.05, 0.09]),
        ([0, 5000, 10000], "", 1e-3, [0.0, 5.0, 10.0]),
        ([0, 5000, 10000], "ms", None, [0.0, 5.0, 10.0]),
        ([0, 5, 10], "", None, [0, 5, 10]),
        ([0.5, 1.5], "min", None, [30.0, 90.0]),
        ([0.5, 1.5], " ", None, [0.5, 1.5]),
        (np.array(["2026-01-31T12", "2026-01-31T13"], "M8[s]"), "mm", None, [0.0, 3600.0]),
        (np.array([1500, 2500], "m8[ms]"), "mm", None, [0.0, 1.0]),
        ([1.0, 2.0], "mm", 60.0, [60.0, 120.0]),
        ([1.0, 2.0], "min", 2.0, [2.0, 4.0]),
    ],
)
def test_time_column_is_in_seconds(values, unit, given, expected):
    """layout._time_column: integers of a known unit may be large; dates and durations have none."""
    time = layout._time_column(*made(values, unit, units={} if given is None else {"time": given}))
    assert time.tolist() == pytest.approx(expected, rel=1e-12) and time.dtype == float


@pytest.mark.parametrize(
    "values, unit, given, said",
    [
        (TICKS, "", None, "time (column 't' of run.x): must be in seconds, got 1774000000123456789, as ns since 1970"),
        (
            np.array([1500, 2500], "m8[ms]"),
            "",
            1e-3,
            "units['time']: must be left out for a column of dates or durations, which is converted to seconds, "
            "got 0.001 for column 't' of run.x.",
        ),
        (
            [1.0, 2.0],
            "",
            "ms",
            "units['time']: must be a factor or a pair such as ('ms', 's'), as times are in s, got 'm",
        ),
        (
            [1.0, 2.0],
            "mm",
            "s",
            "time (column 't' of run.x): must be in a unit of time, got ('s', 'mm')|units['time']: ",
        ),
        (
            [1.0, 2.0],
            "mm",
            None,
            "time (column 't' of run.x): must be in a unit of time, got 'mm'; give the column of times, "
            "or units={'time': …} as a factor.",
        ),
        ([1.0, 2.0], "", ("m", "s"), "time (column 't' of run.x): must be in a unit of time, got ('m', 's', '')"),
        ([1.0, 2.0], "", ("s", "m"), "time (column 't' of run.x): must be in a unit of time, got ('s', 'm', '')"),
        ([1.0, 2.0], "ms", ("s", "s"), "units['time']: must begin with the unit 'ms' of the file, got ('s', 's')"),
        ([1.0 + 1j, 2.0], "", None, "column 't' of run.x: must be one column of real numbers, got shape (2,)"),
    ],
)
def test_time_columns_of_other_units_are_refused(values, unit, given, said):
    pattern = "|".join(re.escape(one) for one in said.split("|"))
    with pytest.raises(ValueError, match=f"^(?:{pattern})"):
        layout._time_column(*made(values, unit, units={} if given is None else {"time": given}))
    with pytest.raises(ValueError, match=r"^column 't' of run.x: must be usable, got no times\.$"):
        layout._time_column(*made(values, unit, "no times"))


@pytest.mark.parametrize(
    "values, expected",
    [
        ([5.0], [5.0]),
        (np.ones((3, 1)), [1.0, 1.0, 1.0]),
        (np.ones((1, 3)), [1.0, 1.0, 1.0]),
        ([True, False], [1.0, 0.0]),
        (np.array([3], np.uint8), [3.0]),
        (np.array([Decimal("1.5"), None], object), [1.5, np.nan]),
        (np.array([1, pd.NA, 2.5], object), [1.0, np.nan, 2.5]),
        (np.float32([1.5]), [1.5]),
        (np.zeros(0), []),
    ],
)
def test_numbers_of_a_column(values, expected):
    read = layout.numbers("x", values)
    assert read.dtype == float and read.shape == (len(expected),)
    assert np.array_equal(read, expected, equal_nan=True)
    text = layout.numbers("x", np.array(["a", 1], object), text=True)
    assert text.tolist() == ["a", 1]


@pytest.mark.parametrize("time", [False, True])
def test_numbers_that_were_just_read_are_not_copied(time):
    """They are protected, so that a recording need not copy them; parts of other arrays are not."""
    whole = np.arange(4.0)
    read = layout.numbers("x", whole, time=time)
    assert read is whole and not read.flags.writeable
    other = np.arange(8.0)
    part = layout.numbers("x", other[::2], time=time)
    assert part.flags.writeable and other.flags.writeable
    counts = np.arange(4)
    assert layout.numbers("x", counts, time=True) is counts and counts.flags.writeable


@pytest.mark.parametrize(
    "values, time, said",
    [
        (np.array([1, "x", "2"], object), False, "must contain numbers, with a decimal point, got 'x' in data row 2."),
        (np.array(["1", "2"], object), False, "must contain numbers, with a decimal point, got '1'."),
        (np.array([b"7", None], object), False, "must contain numbers, with a decimal point, got b'7'."),
        (np.array([None, [1]], object), False, "must contain numbers, with a decimal point, got [1] in data row 2."),
        (
            np.array(["a", "b"], object),
            True,
            "must contain numbers, with a decimal point, got 'a' in data row 1; dates must be those of ISO 8601, give "
            "date_format= for others in a text.",
        ),
        (np.ones((2, 2)), False, "must be one column of real numbers, got shape (2, 2) and type float64."),
        (np.array(5.0), False, "must be one column of real numbers, got shape () and type float64."),
        (np.ones((1, 1)), False, "must be one column of real numbers, got shape (1, 1) and type float64."),
        (np.array([1], "m8[s]"), False, "must be one column of real numbers, got shape (1,) and type timedelta64[s]."),
        (np.array([1j]), True, "must be one column of real numbers, got shape (1,) and type complex128."),
    ],
)
def test_cells_that_are_no_numbers_are_named(values, time, said):
    with pytest.raises(ValueError, match=f"^x: {re.escape(said)}$"):
        layout.numbers("x", values, time=time)


def test_origins_count_from_the_earliest_one():
    """layout._offsets: in seconds; zero without origins."""
    layout_of = made([0.0])[0]
    start = np.datetime64("2026-01-31T12:00:00", "ns")
    clocks = {k: Clock(origin=start + np.timedelta64(n, "ms")) for k, n in (("a", 1500), ("b", 0), ("c", 250))}
    assert layout._offsets(layout_of, clocks) == {"a": 1.5, "b": 0.0, "c": 0.25}
    assert layout._offsets(layout_of, {"a": None, "b": Clock()}) == {"a": 0.0, "b": 0.0}
    for other in (None, Clock()):
        with pytest.raises(ValueError, match=r"got dates for \['a', 'b', 'c'\] and none for \['d'\]; read them separ"):
            layout._offsets(layout_of, clocks | {"d": other})


@pytest.mark.parametrize(
    "clock, rate, expected",
    [
        (None, 4.0, [0.0, 0.25, 0.5]),
        (Clock(2.0, 0.5), 4.0, [2.0, 2.25, 2.5]),
        (Clock(2.0, 0.5), None, [2.0, 2.5, 3.0]),
        (Clock(refusal="odd"), 2.0, [0.0, 0.5, 1.0]),
        (Clock(stored=lambda: np.array([1.0, 2.0, 4.0])), None, [1.0, 2.0, 4.0]),
    ],
)
def test_clocked_times_are_those_of_the_rate_or_of_the_file(clock, rate, expected):
    layout_of, contents = made([0.0])
    column = layout._Column(StoredChannel("x", 3, None, "g", clock=clock), np.zeros(3))
    assert layout._clocked(layout_of, contents, column, rate).tolist() == expected
    for refused, said in (
        (
            None,
            "time: must be given or sampling_rate, and not both, got None and None; run.x does not say when column 'g",
        ),
        (Clock(refusal="which is odd"), "time: must be known, got column 'g/x' of run.x, which is odd."),
    ):
        none = layout._Column(StoredChannel("x", 3, None, "g", clock=refused), np.zeros(3))
        with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
            layout._clocked(layout_of, contents, none, None)


@pytest.mark.parametrize(
    "step, error, said",
    [
        (0.0010004, 5e-7, "1000 Hz has the same digits; "),
        (0.0010006, 5e-7, "999 Hz has the same digits; "),
        (0.3, 1e-9, ""),
        (0.33, 0.005, "3 Hz has the same digits; "),
        (8.1e-6, 1e-8, "123500 Hz has the same digits; "),
        (1 / 123457.4, 4e-11, "123457 Hz has the same digits; "),
        (1 / 1234567.4, 4e-13, ""),
    ],
)
def test_round_rates_within_the_error_of_the_step(step, error, said):
    """rounded_rate: of the fewest digits, six at most."""
    assert layout.rounded_rate(Clock(0.0, step, error=error)) == said


def test_labels_of_parts_are_compared_with_all_columns_and_the_times():
    """layout._label: each has one value per sample."""
    layout_of, contents = made([1, 1, 2, 2])
    columns = {"x": SimpleNamespace(stored=SimpleNamespace(label="x"), values=np.arange(4.0))}
    assert layout._label(layout_of, contents, "t", columns, np.arange(4.0)).tolist() == [1, 1, 2, 2]
    assert layout._label(layout_of, contents, "t", columns, {"x": np.arange(9.0)}).tolist() == [1, 1, 2, 2]
    by_rate, _ = made([1, 1, 2, 2], time=None, sampling_rate=2.0)
    assert layout._label(by_rate, contents, "t", columns, np.arange(9.0)).size == 4
    with pytest.raises(ValueError, match="got 't' with 4 values and 't' with 9"):
        layout._label(layout_of, contents, "t", columns, np.arange(9.0))


@pytest.mark.parametrize("factor", [np.nan, np.inf, 0.0, np.float64(0.0)])
def test_factors_of_units_are_finite_numbers_other_than_zero(factor):
    """Of units.convert."""
    with pytest.raises(ValueError, match=r"^units\['x'\]: must "):
        units.convert("x", np.ones(2), factor)
    assert units.convert("x", np.ones(2), np.int64(-3)).tolist() == [-3.0, -3.0]


@pytest.mark.parametrize(
    "unit, said",
    [
        ("mm", "must be a factor or a pair such as ('mm', 'm'), got 'mm'."),
        (("mm",), "must be a factor or a pair such as ('mm', 'm'), got ('mm',)."),
        (("mm", 1), "must be a factor or a pair such as ('mm', 'm'), got ('mm', 1)."),
        (
            ("m", "m" * 101),
            "must be units that are multiplied or divided, with exponents of one digit, such as 'kg*m/s**2', "
            f"got '{'m' * 100}…'.",
        ),
        (
            ("m", "2 m"),
            "must be units that are multiplied or divided, with exponents of one digit, such as 'kg*m/s**2', "
            "got '2 m'.",
        ),
        (("dB", "V"), "must be units that are not logarithmic, got ('dB', 'V'); convert the values first: reference*"),
        (
            ("V", "dBV"),
            "must be units that are not logarithmic, got ('V', 'dBV'); convert the values first: reference*",
        ),
        (
            ("mol/l", "pH"),
            "must be units that are not logarithmic, got ('mol/l', 'pH'); convert the values first: 10**-pH",
        ),
        (("m", "s"), "must be two units of the same dimension, got ('m', 's') ("),
        (("m", "furz"), "must be two units of the same dimension, got ('m', 'furz') ("),
    ],
)
def test_pairs_that_are_no_units_are_refused(unit, said):
    with pytest.raises(ValueError, match=f"^{re.escape('units[' + repr('x') + ']: ' + said)}"):
        units.convert("x", np.ones(2), unit)


@pytest.mark.parametrize(
    "text, angle, power, expected",
    [
        ("", "rad", 1.0, "rad"),
        ("1/s", "rad", 1.0, "rad/s"),
        ("N*m", "rad", 1.0, "rad*N*m"),
        ("", "rad", -1.0, "1/rad"),
        ("N*m", "rev", -1.0, "N*m/rev"),
        ("", "rad", 2.0, "1*rad**2"),
        ("s", "rev", -2.0, "s*rev**-2"),
    ],
)
def test_units_times_a_power_of_an_angle(text, angle, power, expected):
    assert units._times(text, angle, power) == expected


@pytest.mark.parametrize(
    "one, other, same",
    [
        ("mm", "millimeter", True),
        ("Nm", "N*m", True),
        ("m", "furz", False),
        ("furz", "furz", False),
        ("m", "mm", False),
        ("sec", "s", True),
        ("m s-2", "m/s**2", True),
    ],
)
def test_spellings_of_one_unit(one, other, same):
    assert units._is_same(one, other) == units._is_same(other, one) == same
    assert (
        units._spelled(" Volts ") == "V" and units._spelled("m/s2") == "m/s**2" and units._spelled("kNmm") == "(kN*mm)"
    )


@pytest.mark.parametrize(
    "stored, given, unit, factor",
    [("mm", {}, "m", 1e-3), ("mm", {"x": "mm"}, "mm", 1.0), ("mm", {"x": 2.0}, None, 2.0), ("", {}, None, 1.0),
     ("", {"x": ("mm", "m")}, "m", 1e-3), ("mm", {"time": 60.0}, "m", 1e-3)],
)  # fmt: skip
@pytest.mark.parametrize("split", [None, "step"])
def test_recordings_and_their_parts_have_the_units_of_their_values(stored, given, unit, factor, split):
    """layout.recordings: of each channel by its own name."""
    channels = [StoredChannel(name, 4, lambda: np.arange(4.0), "", stored if name == "x" else "") for name in "xty"]
    channels.append(StoredChannel("step", 4, lambda: np.array([1, 1, 2, 2])))
    made_of = Layout("run.x", {"x": "x"}, {"u": "y"}, "t", None, given, None)
    contents = Contents("a file", tuple(channels))
    seen = layout.recordings(lambda *fields, units: (*fields, units), made_of, contents, split, "r")
    parts = [seen] if split is None else seen
    names = ["r"] if split is None else ["r 1: step 1", "r 2: step 2"]
    assert [part[3] for part in parts] == names
    assert [part[4] for part in parts] == [{"x": unit} if unit else {}] * len(parts)
    np.testing.assert_allclose(np.concatenate([part[1]["x"] for part in parts]), factor * np.arange(4.0))
    np.testing.assert_allclose(np.concatenate([part[2]["u"] for part in parts]), np.arange(4.0))
    np.testing.assert_allclose(np.concatenate([part[0] for part in parts]), given.get("time", 1.0) * np.arange(4.0))


ORIGIN = np.datetime64("2026-01-31T12:00:00", "ns")
CLOCK, EARLY = Clock(1.0, 0.5), Clock(0.0, 0.5, origin=ORIGIN)
LATE = Clock(0.0, 0.25, origin=ORIGIN + np.timedelta64(2, "s"))


@pytest.mark.parametrize(
    "clocks, sizes, rate, expected",
    [
        ((None, None), (3, 3), 2.0, [0.0, 0.5, 1.0]), ((None, None), (2, 4), 2.0, [0.0, 0.5, 1.0, 1.5]),
        ((None, None), (4, 2), 2.0, [0.0, 0.5, 1.0, 1.5]), ((CLOCK, CLOCK), (3, 3), None, [1.0, 1.5, 2.0]),
        ((CLOCK, CLOCK), (3, 2), None, {"x": [1.0, 1.5, 2.0], "y": [1.0, 1.5]}),
        ((CLOCK, None), (2, 2), 4.0, {"x": [1.0, 1.25], "y": [0.0, 0.25]}),
        ((CLOCK, Clock(1.0, 0.5)), (2, 2), 4.0, {"x": [1.0, 1.25], "y": [1.0, 1.25]}),
        ((CLOCK, None), (2, 2), {"y": 4.0}, {"x": [1.0, 1.5], "y": [0.0, 0.25]}),
        ((None, None), (2, 2), {"x": 2.0, "y": 4.0}, {"x": [0.0, 0.5], "y": [0.0, 0.25]}),
        ((None, None), (2, 3), {"x": 2.0, "y": 2.0}, {"x": [0.0, 0.5], "y": [0.0, 0.5, 1.0]}),
        ((LATE, EARLY), (2, 2), None, {"x": [2.0, 2.25], "y": [0.0, 0.5]}),
        ((LATE, EARLY), (2, 2), {"x": 1.0}, {"x": [2.0, 3.0], "y": [0.0, 0.5]}),
    ],
)  # fmt: skip
def test_times_are_one_array_or_those_of_each_channel(clocks, sizes, rate, expected):
    """layout._times: of one rate and different lengths those of the longest channel."""
    layout_of = Layout("run.x", {"x": "x", "y": "y"}, {}, None, rate, {}, None)
    contents = Contents("a file", ())
    columns = {
        name: layout._Column(StoredChannel(name, size, None, clock=clock), np.zeros(size))
        for name, clock, size in zip("xy", clocks, sizes, strict=True)
    }
    seen = layout._times(layout_of, contents, columns)
    if isinstance(expected, dict):
        assert {name: time.tolist() for name, time in seen.items()} == expected
    else:
        assert seen.tolist() == expected


def test_channels_of_a_text_without_times_have_the_rates_that_are_given(tmp_path):
    (tmp_path / "run.csv").write_text("x,y\n1,2\n3,4\n5,6\n")
    names = {"outputs": {"x": "x"}, "inputs": {"y": "y"}}
    run = bp.Recording.from_csv(tmp_path / "run.csv", **names, sampling_rate={"x": 2.0, "y": 4.0})
    assert run.times["x"].tolist() == [0.0, 0.5, 1.0] and run.times["y"].tolist() == [0.0, 0.25, 0.5]
