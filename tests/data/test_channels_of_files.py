"""Meaning of the channels of files that are made in memory: times, rates, origins, units, parts, and refusals."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from bayesperiodic.data import layout
from bayesperiodic.data.formats.contents import Clock, Contents, StoredChannel

X = np.array([1.5, 2.5, 3.5, 4.5])
T = np.arange(4.0) / 2
MILLI = {"time": ("ms", "s")}


def channel(name="x", values=X, clock=None, unit="", group="", refusal=""):
    return StoredChannel(name, len(values), lambda: np.array(values), group, unit, clock, refusal=refusal)


def read(*channels, split=None, outputs=None, name="run", **given):
    """Return the signals of a file of channels, or of each of its parts."""
    arguments = {"inputs": {}, "time": None, "sampling_rate": None, "units": {}, "missing": None} | given
    made = layout.Layout("run.x", outputs or {"x": "x"}, *arguments.values())

    def kind(times, outputs, inputs, name, units):
        return SimpleNamespace(time=times, outputs=outputs, inputs=inputs, name=name, units=units)

    return layout.recordings(kind, made, Contents("a file", channels), split, name)


@pytest.mark.parametrize(
    "given, channels, time",
    [
        ({"time": "t"}, [channel("t", T)], T), ({"time": 2}, [channel("t", T)], T), ({"sampling_rate": 4.0}, [], T / 2),
        ({"time": "t"}, [channel("t", T, unit="ms")], T / 1e3),
        ({"time": "t", "units": MILLI}, [channel("t", T)], T / 1e3),
        ({"time": "t", "units": {"time": 60.0}}, [channel("t", T)], 60 * T),
        ({"time": "t", "units": {"time": 60.0}}, [channel("t", T, unit="mm")], 60 * T),
        ({"time": "t", "units": {"time": "s"}}, [channel("t", T, unit="ms")], T / 1e3),
        ({"time": "t"}, [channel("t", np.datetime64("2026-01-31", "ms") + (1000 * T).astype(int), unit="x")], T),
        ({"time": "t"}, [channel("t", (1000 * T).astype("m8[ms]"), unit="mm")], T),
        ({"time": "t"}, [channel("t", np.array([0, 2, 4, 6]) * 10**18 // 10**9, unit="ns")], 2.0 * np.arange(4)),
    ],
)  # fmt: skip
def test_times_are_those_of_a_channel_in_its_unit_or_of_a_rate(given, channels, time):
    seen = read(channel(), *channels, **given)
    np.testing.assert_allclose(seen.time, time, rtol=1e-14)
    assert np.array_equal(seen.outputs["x"], X) and seen.inputs == {} and seen.name == "run"


@pytest.mark.parametrize(
    "given, channels, message",
    [
        ({}, [],
         "time: must be given or sampling_rate, and not both, got None and None; run.x does not say when channel 'x'"),
        ({"time": "t", "sampling_rate": 4.0}, [channel("t", T)],
         "time: must be given or sampling_rate, and not both, got 't' a"),
        ({"time": "t", "units": {"time": "ms"}}, [channel("t", T)],
         "units['time']: must be a factor or a pair such as ('ms', 's')"),
        ({"time": "t"}, [channel("t", T, unit="mm")],
         "time (column 't' of run.x): must be in a unit of time, got 'mm'; give"),
        ({"time": "t", "units": {"time": ("mm", "s")}}, [channel("t", T, unit="m")],
         "time (column 't' of run.x): must be in a unit of time, got ('mm', 's', 'm'); give the column"),
        ({"time": "t", "units": MILLI}, [channel("t", T.astype("m8[s]"))],
         "units['time']: must be left out for a column of dates or durations, which is converted to seconds, got "),
        ({"time": "t"}, [channel("t", np.array(["a", "b", "c", "d"], object))],
         "channel 't' of run.x: must contain numbers, with a decimal point, got 'a' in data row 1; dates "
         "must be those of ISO 8601"),
        ({"time": "t"}, [channel("t", T, refusal="texts")], "channel 't' of run.x: must be usable, got texts."),
        ({"units": {"y": 1.0}, "sampling_rate": 1.0}, [], "units: must be one of 'time', 'x', got 'y'"),
        ({"sampling_rate": {"y": 1.0}}, [], "sampling_rate: must be 'x', got 'y'"),
        ({"sampling_rate": 0.0}, [], "sampling_rate: must be "), ({"inputs": "u"}, [], "inputs: must be a mapping"),
        ({"outputs": {"time": "x"}, "units": {"time": 1.0}, "sampling_rate": 1.0}, [],
         "units: must be those of the times by the name 'time', got a channel of this name too; rename it."),
        ({"missing": "fill", "sampling_rate": 1.0}, [], "missing: must be one of 'drop', 'interpolate', got 'fill'"),
    ],
)  # fmt: skip
def test_unclear_times_and_arguments_are_refused(given, channels, message):
    with pytest.raises(ValueError, match=re.escape(message).replace("must\\ be\\ 'x'", "must be (one of )?'x'")):
        read(channel(), *channels, **given)
    with pytest.raises(ValueError, match="^outputs: must have at least one channel, got none.$"):
        layout.Layout("run.x", {}, {}, None, 1.0, {}, None)


@pytest.mark.parametrize(
    "values, got",
    [
        (["1", "OL", "2"], "'OL' in data row 2"), ([1.5, "x", 2.0], "'x' in data row 2"), (["1", "2", "3"], "'1'"),
        ([1.0, None, 5], None), ([3, 4, 5], None), ([True, False, True], None),
    ],
)  # fmt: skip
def test_values_are_numbers_or_the_first_text_is_named(values, got):
    array = np.array(values, dtype=object if got or None in values else None)
    if got:
        with pytest.raises(ValueError, match=f"^x: must contain numbers, with a decimal point, got {got}.$"):
            layout.numbers("x", array)
        assert layout.numbers("x", array, text=True).tolist() == values
    else:
        expected = np.array([np.nan if value is None else float(value) for value in values])
        assert np.array_equal(layout.numbers("x", array), expected, equal_nan=True)
        assert layout.numbers("x", array).dtype == float


@pytest.mark.parametrize(
    "values", [np.ones((3, 2)), np.ones(3) * 1j, np.array(["2026-01-01"] * 3, "M8[D]"), np.array(["a", "b"])]
)
def test_other_arrays_are_refused_with_shape_and_type(values):
    got = re.escape(f"got shape {values.shape} and type {values.dtype}.")
    with pytest.raises(ValueError, match=f"^x: must be one column of real numbers, {got}$"):
        layout.numbers("x", values)
    assert layout.numbers("x", np.ones((3, 1))).shape == (3,)
    assert layout.numbers("x", np.arange(3), time=True).dtype == int


FAST, SLOW = Clock(0.0, 0.5), Clock(1.0, 0.25)


def test_channels_have_the_times_of_their_clocks():
    seen = read(channel("x", clock=FAST), channel("y", X, FAST), outputs={"x": "x", "y": "y"})
    assert np.array_equal(seen.time, T)
    seen = read(channel("x", clock=FAST), channel("y", X[:3], SLOW), outputs={"x": "x"}, inputs={"y": "y"})
    assert np.array_equal(seen.time["x"], T) and seen.time["y"].tolist() == [1.0, 1.25, 1.5]
    assert np.array_equal(seen.inputs["y"], X[:3])
    seen = read(channel("x", clock=SLOW), sampling_rate=2.0)
    assert seen.time.tolist() == [1.0, 1.5, 2.0, 2.5]
    both = {"outputs": {"x": "x", "y": "y"}}
    seen = read(channel("x", clock=FAST), channel("y", X, SLOW), sampling_rate={"x": 1.0}, **both)
    assert seen.time["x"].tolist() == [0, 1, 2, 3] and seen.time["y"][1] == 1.25
    with pytest.raises(
        ValueError, match=r"sampling_rate: must be given by channel, as the channels of run.x have times of .*'x': 2"
    ):
        read(channel("x", clock=FAST), channel("y", X, SLOW), sampling_rate=2.0, **both)
    alike = read(channel("x", clock=FAST), channel("y", X, Clock(0.0, 0.5)), sampling_rate=2.0, **both)
    assert np.array_equal(alike.time["y"], T)
    with pytest.raises(ValueError, match="time: must be known, got channel 'g/x' of run.x, whose axis is odd."):
        read(channel("x", clock=Clock(refusal="whose axis is odd"), group="g"))
    with pytest.raises(ValueError, match="does not say when channel .y."):
        read(channel("x", clock=FAST), channel("y"), **both)


def test_origins_shift_the_times_of_later_channels():
    start = np.datetime64("2026-01-31T12:00:00", "ns")
    clocks = [Clock(0.0, 0.5, origin=start + np.timedelta64(k * 250, "ms")) for k in (1, 0)]
    seen = read(channel("x", clock=clocks[0]), channel("y", X, clocks[1]), outputs={"x": "x", "y": "y"})
    np.testing.assert_allclose(seen.time["x"], T + 0.25)
    np.testing.assert_allclose(seen.time["y"], T)
    message = (
        "time: must be counted from one instant for all channels of run.x, got dates for ['x'] and none for ['y']; read"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        read(channel("x", clock=clocks[0]), channel("y", X, FAST), outputs={"x": "x", "y": "y"})


@pytest.mark.parametrize(
    "step, error, round_rate",
    [
        (1.95313e-5, 5e-11, "51200 Hz has the same digits; "),
        (2.26757e-5, 5e-11, "44100 Hz has the same digits; "),
        (0.3, 1e-9, ""),
    ],
)
def test_step_of_few_digits_is_warned_of_with_its_error_and_a_round_rate(step, error, round_rate):
    clock = Clock(0.0, step, error=error)
    assert layout.rounded_rate(clock) == round_rate
    said = f"run.x gives the interval of channel 'x' with few digits, so that its rate is {1 / step:.9g} Hz with an"
    with pytest.warns(
        UserWarning,
        match=re.escape(f"sampling_rate: {said} error of up to {1e6 * error / step:.2g} ppm; {round_rate}give samp"),
    ):
        read(channel(clock=clock))


def test_files_of_several_records_are_split_where_a_column_changes():
    step = channel("step", ["a", "a", "b", "b"])
    one, two = read(channel(), channel("t", T), step, split="step", time="t", name="r")
    assert (one.name, two.name) == ("r 1: step a", "r 2: step b")
    assert one.time.tolist() == [0.0, 0.5] and two.outputs["x"].tolist() == [3.5, 4.5]
    single = read(channel(), channel("step", [1, 1, 1, 1]), split="step", sampling_rate=2.0)
    assert [part.name for part in single] == ["run 1: step 1"] and np.array_equal(single[0].time, T)
    both = {"outputs": {"x": "x", "y": "y"}}
    own = read(channel("x", clock=FAST), channel("y", X, SLOW), step, split="step", **both)
    assert own[1].time["x"].tolist() == [1.0, 1.5] and own[1].time["y"].tolist() == [1.5, 1.75]
    with pytest.raises(
        ValueError, match="split: must be a column without empty cells, got 'step', empty in data row 3."
    ):
        read(channel(), channel("step", np.array([1, 1, np.nan, 2])), split="step", sampling_rate=1.0)
    with pytest.raises(
        ValueError, match="split: must be a column with one value per sample, got 'step' with 3 values and 'x' with 4"
    ):
        read(channel(), channel("step", [1, 1, 2]), split="step", sampling_rate=1.0)
    with pytest.raises(ValueError, match="got 'step' with 4 values and 't' with 3."):
        read(channel(), channel("t", T[:3]), channel("step", [1, 1, 2, 2]), split="step", time="t")


LOST = np.array([np.nan, 1.0, np.nan, 3.0, np.nan])
AT = np.array([0.0, 1.0, 2.0, 3.0, 4.0])


def test_missing_samples_of_one_or_several_channels():
    whole = np.arange(5.0)
    time, kept = layout.without_missing("time", AT, {"x": LOST}, "drop")
    assert time.tolist() == [1.0, 3.0] and kept["x"].tolist() == [1.0, 3.0]
    time, kept = layout.without_missing("time", AT, {"x": LOST, "y": whole}, "drop")
    assert time["x"].tolist() == [1.0, 3.0] and np.array_equal(time["y"], AT) and np.array_equal(kept["y"], whole)
    time, kept = layout.without_missing("time", AT, {"x": LOST, "y": whole}, "interpolate")
    assert time.tolist() == [1.0, 2.0, 3.0] and kept["x"].tolist() == [1.0, 2.0, 3.0] == kept["y"].tolist()
    time, kept = layout.without_missing("time", {"x": AT, "y": AT + 7}, {"x": LOST, "y": whole}, "interpolate")
    assert time["x"].tolist() == [1.0, 2.0, 3.0] and time["y"].size == 5
    time, kept = layout.without_missing("time", AT, {"x": whole, "y": whole}, None)
    assert time is AT and kept["x"] is whole
    with pytest.raises(
        ValueError, match=r"^x: must be finite, got nan at index 0 \(3 of 5 values are NaN or masked\); missing='dr"
    ):
        layout.without_missing("time", AT, {"x": LOST}, None)
    with pytest.raises(ValueError, match=r"^time\['x'\]: must be finite, got nan at index 0 \(3 of 5"):
        layout.without_missing("time", {"x": LOST}, {"x": whole}, None)
    time, kept = layout.without_missing("time", LOST, {"x": whole}, "drop")
    assert time.tolist() == [1.0, 3.0] == kept["x"].tolist()
    time, _ = layout.without_missing("time", AT, {"x": whole[1:]}, "drop")
    assert time is AT  # refused elsewhere


@pytest.mark.parametrize("gap, filled", [(3, True), (4, False)])
def test_three_successive_samples_are_filled_in_at_most(gap, filled):
    values = np.array([0.0, *[np.nan] * gap, 8.0, np.nan])
    time = np.arange(gap + 3.0)
    if filled:
        result = layout._interpolated("x", time, values)
        assert result[:-1].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0] and np.isnan(result[-1])
    else:
        message = (
            "missing: must be 'drop' for x, got 'interpolate', which fills in at most 3 successive values, and 4 are"
        )
        with pytest.raises(ValueError, match=f"^{message}"):
            layout._interpolated("x", time, values)
    assert np.isnan(layout._interpolated("x", time, np.full(gap + 3, np.nan))).all()
