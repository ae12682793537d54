"""TDMS files, written here after NI's description of their internal structure."""

import datetime
import logging
import re
import struct
import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import tdms
from tests.data.test_damaged_files import damaged

META, NEW, RAW, INTERLEAVED, DAQMX = 2, 4, 8, 32, 128
RATE = 51_200.0
X = 3.0 * np.sin(np.arange(300) / 7)
# Numbers of types of values.
TYPES = {"<f8": 10, "<i2": 2, "<i4": 3, "<f4": 9, "|u1": 5, "stamp": 0x44}
EPOCH = np.datetime64("1904-01-01", "s")


def stamp(text):
    """Return seconds since 1904 and fractions of a second of an instant."""
    whole, _, fraction = text.partition(".")
    return int((np.datetime64(whole, "s") - EPOCH) / np.timedelta64(1, "s")), int(fraction or "0") * 2**64 // 10 ** len(
        fraction or "0"
    )


def text(value):
    return struct.pack("<I", len(value.encode())) + value.encode()


def prop(name, value):
    if isinstance(value, str):
        return text(name) + struct.pack("<I", 0x20) + text(value)
    if isinstance(value, tuple):
        return text(name) + struct.pack("<IQq", 0x44, value[1], value[0])
    if isinstance(value, int):
        return text(name) + struct.pack("<Ii", 3, value)
    return text(name) + struct.pack("<Id", 10, value)


def path(*names):
    return "".join("/'" + name.replace("'", "''") + "'" for name in names)


def index(kind, count):
    return struct.pack("<IIIQ", 20, TYPES[kind], 1, count)


def segment(objects, data, flags=META | NEW | RAW, length=None):
    """Return a segment of objects, each a path, the bytes of its index, and properties."""
    meta = struct.pack("<I", len(objects))
    for name, where, properties in objects:
        meta += text(name) + where + struct.pack("<I", len(properties))
        meta += b"".join(prop(key, value) for key, value in properties.items())
    total = len(meta) + len(data) if length is None else length
    return b"TDSm" + struct.pack("<iiQQ", flags, 4713, total, len(meta)) + meta + data


def channel(values, name="x", group="g", **properties):
    """Return a segment of one channel."""
    return segment([(path(group, name), index(values.dtype.str, len(values)), properties)], values.tobytes())


def read(folder, content, **arguments):
    file = folder / "run.tdms"
    file.write_bytes(content)
    return bp.Recording.from_file(file, **({"outputs": {"x": "x"}} | arguments))


def refused(folder, content, reason, **arguments):
    with pytest.raises(ValueError, match=reason) as error:
        read(folder, content, **arguments)
    assert "run.tdms" in str(error.value)


def test_waveform_has_its_rate_without_a_start_offset(tmp_path):
    """`time_track` of npTDMS needs both properties."""
    run = read(tmp_path, channel(X, wf_increment=1 / RATE, unit_string="mm"))
    np.testing.assert_allclose(run.time, np.arange(300) / RATE, rtol=1e-15)
    np.testing.assert_allclose(run.outputs["x"], X * 1e-3, rtol=1e-15)


def test_start_offset_shifts_the_times(tmp_path):
    run = read(tmp_path, channel(X, wf_increment=0.5, wf_start_offset=-2.0))
    np.testing.assert_allclose(run.time, np.arange(300) / 2 - 2.0)


def test_segments_are_joined(tmp_path):
    parts = [channel(X[:100], wf_increment=0.01), channel(X[100:150]), channel(X[150:])]
    run = read(tmp_path, b"".join(parts))
    np.testing.assert_array_equal(run.outputs["x"], X)
    np.testing.assert_allclose(run.time, np.arange(300) / 100)


def test_changed_increment_is_refused(tmp_path):
    """The package npTDMS applies the last increment to all samples."""
    content = channel(X, wf_increment=0.01) + channel(X, wf_increment=0.02)
    refused(tmp_path, content, r"whose wf_increment changes from 0.01 to 0.02 s at sample 300; sampling_rate=")
    assert read(tmp_path, content, sampling_rate=100.0).time.size == 600
    assert "changes from 0.01 to 0.02" in str(bp.inspect(tmp_path / "run.tdms"))


def test_slow_channel_keeps_its_clock_and_start_times_are_told_apart(tmp_path):
    start, later = stamp("2026-01-31T12:00:00.25"), stamp("2026-01-31T12:00:01.75")
    content = channel(X, "x", wf_increment=0.01, wf_start_time=start) + channel(
        X[:7], "slow", wf_increment=0.5, wf_start_time=later
    )
    run = read(tmp_path, content, outputs={"x": "x", "slow": "slow"})
    np.testing.assert_allclose(run.times["x"], np.arange(300) / 100)
    np.testing.assert_allclose(run.times["slow"], 1.5 + np.arange(7) / 2, atol=1e-9)


def test_restarted_measurement_is_refused_and_a_continued_one_is_read(tmp_path):
    first, gap, joined = (stamp(f"2026-01-31T12:00:{second}") for second in ("00.0", "09.0", "03.0"))
    one = channel(X, wf_increment=0.01, wf_start_time=first)
    refused(tmp_path, one + channel(X, wf_start_time=gap), "from sample 300 starts 9 s after the first one and not 3 s")
    run = read(tmp_path, one + channel(X, wf_start_time=joined))
    np.testing.assert_allclose(run.time, np.arange(600) / 100, atol=1e-12)


def scaled(scale):
    return {
        "NI_Scaling_Status": "unscaled",
        "NI_Number_Of_Scales": 2,
        "NI_Scale[1]_Scale_Type": scale,
        "NI_Scale[1]_Linear_Slope": 0.5,
        "NI_Scale[1]_Linear_Y_Intercept": 3.0,
        "NI_Scale[1]_Linear_Input_Source": 0,
        "wf_increment": 0.01,
    }


def raw_daqmx(scale, counts):
    """Return a file of two channels of 16 bits as DAQmx writes them, in rows without scaling."""
    places = {"x": 0, "y": 2}
    objects = []
    for name, place in places.items():
        where = struct.pack("<IIIQI", 0x1269, 0xFFFFFFFF, 1, len(counts), 1)
        where += struct.pack("<IIIII", 3, 0, place, 0, 0) + struct.pack("<II", 1, 4)
        objects.append((path("g", name), where, scaled(scale)))
    return segment(objects, counts.tobytes(), META | NEW | RAW | DAQMX)


def test_raw_data_of_daqmx_are_scaled(tmp_path):
    counts = np.arange(20, dtype="<i2").reshape(10, 2) * 100
    run = read(tmp_path, raw_daqmx("Linear", counts), outputs={"x": "x", "y": "y"})
    np.testing.assert_allclose(run.outputs["x"], 0.5 * counts[:, 0] + 3.0)
    np.testing.assert_allclose(run.outputs["y"], 0.5 * counts[:, 1] + 3.0)


def test_last_chunk_of_daqmx_with_fewer_rows(tmp_path):
    """As DAQmx writes it when the measurement is stopped: the segment has a chunk of ten rows, and one of two."""
    counts = np.arange(24, dtype="<i2").reshape(12, 2)
    whole = raw_daqmx("Linear", counts[:10]) + counts[10:].tobytes()
    whole = whole[:12] + struct.pack("<Q", len(whole) - 28) + whole[20:]
    run = read(tmp_path, whole, outputs={"x": "x", "y": "y"})
    np.testing.assert_allclose(run.outputs["y"], 0.5 * counts[:, 1] + 3.0)


def test_scale_that_is_not_applied_is_refused(tmp_path):
    """The package npTDMS returns counts for a scale that it does not know."""
    counts = np.ones((10, 2), dtype="<i2")
    refused(tmp_path, raw_daqmx("Wheatstone", counts), r"a scale of type 'Wheatstone' \(NI_Scale\[1\]_Scale_Type\)")


def test_scale_or_unit_that_changes_is_refused(tmp_path):
    for old, new in (
        ({"unit_string": "mm"}, {"unit_string": "m"}),
        (scaled("Linear"), {"NI_Scale[1]_Linear_Slope": 2.0}),
    ):
        name = next(iter(new))
        content = channel(X, **({"wf_increment": 0.01} | old)) + channel(X, **new)
        refused(tmp_path, content, name.replace("[", r"\[").replace("]", r"\]") + " that changes from .* at sample 300")


def test_property_set_after_the_data_applies(tmp_path):
    """LabVIEW appends a segment without data to do so."""
    late = segment([(path("g", "x"), struct.pack("<I", 0xFFFFFFFF), {"unit_string": "mm"})], b"", META | NEW)
    run = read(tmp_path, channel(X, wf_increment=0.01) + late)
    np.testing.assert_allclose(run.outputs["x"], X * 1e-3)


def test_interleaved_data(tmp_path):
    table = np.array([X[:40], -X[:40]]).T.copy()
    objects = [(path("g", name), index("<f8", 40), {"wf_increment": 0.01}) for name in "xy"]
    run = read(
        tmp_path, segment(objects, table.tobytes(), META | NEW | RAW | INTERLEAVED), outputs={"x": "x", "y": "y"}
    )
    np.testing.assert_array_equal(run.outputs["x"], X[:40])
    np.testing.assert_array_equal(run.outputs["y"], -X[:40])


def test_timestamps_keep_nanoseconds(tmp_path):
    """The package npTDMS cuts them off at microseconds, 5 % of a step at 51.2 kHz."""
    whole = stamp("2026-01-31T12:00:00")[0]
    stamps = b"".join(struct.pack("<Qq", int(k * 2**64 / RATE), whole) for k in range(300))
    content = segment(
        [(path("g", "x"), index("<f8", 300), {}), (path("g", "when"), index("stamp", 300), {})], X.tobytes() + stamps
    )
    run = read(tmp_path, content, time="when")
    np.testing.assert_allclose(run.time, np.arange(300) / RATE, atol=1.1e-9)


def test_channel_without_a_waveform_needs_a_rate(tmp_path):
    for properties in (
        {},
        {"wf_increment": 0.0},
        {"wf_increment": 1.0},
        {"wf_increment": 1.0, "wf_start_time": (0, 0)},
    ):
        refused(
            tmp_path,
            channel(X, **properties),
            "time: must be ",
        )
        assert read(tmp_path, channel(X, **properties), sampling_rate=10.0).sampling_rate == pytest.approx(10.0)
    slow = channel(X, wf_increment=1.0, wf_start_time=stamp("2026-01-31T12:00:00"))
    assert read(tmp_path, slow).sampling_rate == pytest.approx(1.0)


def test_axis_that_is_no_time_is_refused(tmp_path):
    refused(tmp_path, channel(X, wf_increment=2.0, wf_xunit_string="Hz"), "whose axis is in 'Hz', no time")


def test_names_with_quotes_and_slashes(tmp_path):
    content = channel(X, "it's x/y", "g'1", wf_increment=0.01) + channel(-X, "it's x/y", "g2", wf_increment=0.01)
    run = read(tmp_path, content, outputs={"x": ("g'1", "it's x/y")})
    np.testing.assert_array_equal(run.outputs["x"], X)
    refused(
        tmp_path, content, r"the name of 2; give the group too: \(\"g'1\", \"it's x/y\"\)", outputs={"x": "it's x/y"}
    )


def test_texts_are_listed_and_refused_as_numbers(tmp_path):
    words = ["on", "µ-off"]
    ends = np.cumsum([len(word.encode()) for word in words]).astype("<u4").tobytes()
    data = ends + "".join(words).encode()
    where = struct.pack("<IIIQQ", 28, 0x20, 1, 2, len(data))
    content = segment([(path("g", "x"), where, {"wf_increment": 0.01})], data)
    refused(tmp_path, content, "must contain numbers")
    assert "texts" in str(bp.inspect(tmp_path / "run.tdms"))


def test_number_of_samples_other_than_announced_is_remarked(tmp_path):
    read(tmp_path, channel(X, wf_increment=0.01, wf_samples=299))
    assert "wf_samples announces 299 samples, there are 300" in str(bp.inspect(tmp_path / "run.tdms"))


@pytest.mark.parametrize("lost", [1, 8, 100, 2400, 2500])
def test_file_that_is_cut_off_is_refused(tmp_path, lost):
    """The package npTDMS reads what there is, or drops the last segment."""
    whole = channel(X, wf_increment=0.01) * 2
    refused(tmp_path, whole[:-lost], "must be a TDMS file, .* is cut off")
    refused(tmp_path, whole + whole[:20], "must be a TDMS file, .* is cut off")
    open_end = segment([(path("g", "x"), index("<f8", 300), {})], X.tobytes()[:-lost], length=2**64 - 1)
    refused(tmp_path, open_end, "must be a TDMS file, .* is cut off")


def test_index_beside_the_file_is_not_read(tmp_path):
    """The package npTDMS takes it in place of the file's own metadata, also if it is that of another file."""
    (tmp_path / "run.tdms_index").write_bytes(channel(X[:10], "other", wf_increment=9.0).replace(b"TDSm", b"TDSh"))
    np.testing.assert_array_equal(read(tmp_path, channel(X, wf_increment=0.01)).outputs["x"], X)


def test_big_endian_file(tmp_path):
    meta = struct.pack(">I", 1) + struct.pack(">I", 8) + b"/'g'/'x'" + struct.pack(">IIIQ", 20, 10, 1, 300)
    meta += struct.pack(">II", 1, 12) + b"wf_increment" + struct.pack(">Id", 10, 0.01)
    data = X.astype(">f8").tobytes()
    head = (
        b"TDSm" + struct.pack("<I", META | NEW | RAW | 64) + struct.pack(">IQQ", 4713, len(meta) + len(data), len(meta))
    )
    run = read(tmp_path, head + meta + data)
    np.testing.assert_array_equal(run.outputs["x"], X)
    assert run.sampling_rate == pytest.approx(100.0)


FIRST, AT_ZERO = stamp("2026-01-31T12:00:00"), {"wf_start_offset": 0.0}


@pytest.mark.parametrize(
    "properties, reason",
    [
        ({"wf_increment": "0.01"}, "whose wf_increment is '0.01' and wf_start_offset 0.0; sampling_rate= gives it"),
        ({"wf_increment": -0.01}, "whose wf_increment is -0.01 and wf_start_offset 0.0; sampling_rate= gives it"),
        ({"wf_increment": np.nan}, "whose wf_increment is nan and wf_start_offset 0.0; sampling_rate= gives it"),
        ({"wf_increment": 0.01, "wf_start_offset": np.inf}, "is 0.01 and wf_start_offset inf; sampling_rate= gives it"),
        (
            {"wf_increment": 0.01, "wf_start_time": 5},
            "whose wf_start_time is no timestamp, but 5; sampling_rate= gives",
        ),
        ({"wf_increment": 0.01, "wf_xunit_string": "ms"}, "whose axis is in 'ms', no time in seconds; sampling_rate="),
        ({"wf_increment": 1.0}, "whose wf_increment of 1 without wf_start_time is also that of samples without a wave"),
    ],
)
def test_unclear_times_of_a_waveform_are_refused_with_their_values_and_overridden(tmp_path, properties, reason):
    refused(tmp_path, channel(X, **properties), re.escape(reason))
    assert read(tmp_path, channel(X, **properties), sampling_rate=10.0).sampling_rate == pytest.approx(10.0)


@pytest.mark.parametrize("unit", ["", "s", "sec", "Sec", "seconds", " s "])
def test_axis_in_seconds_by_any_name_is_the_time(tmp_path, unit):
    assert read(tmp_path, channel(X, wf_increment=0.25, wf_xunit_string=unit)).time[-1] == pytest.approx(299 / 4)


def test_increment_of_one_second_with_an_offset_is_one(tmp_path):
    assert read(tmp_path, channel(X, wf_increment=1.0, wf_start_offset=0.5)).time[:2].tolist() == [0.5, 1.5]


@pytest.mark.parametrize(
    "first, later, passed",
    [
        (AT_ZERO, {"wf_start_offset": 3.0}, None), (AT_ZERO, {"wf_start_offset": 3.0049}, None),
        (AT_ZERO, {"wf_start_offset": 3.0051}, "3.0051"), (AT_ZERO, {"wf_start_offset": 2.9949}, "2.9949"),
        ({"wf_start_offset": 0.5}, {"wf_start_offset": 3.5}, None), ({"wf_start_offset": 0.5}, {"wf_start_offset": 3.0},
        "2.5"), ({"wf_start_time": FIRST}, {"wf_start_time": stamp("2026-01-31T12:00:03.004")}, None),
        ({"wf_start_time": FIRST}, {"wf_start_time": stamp("2026-01-31T12:00:03.006")}, "3.006"),
        ({"wf_start_time": FIRST, "wf_start_offset": 0.0},
         {"wf_start_time": stamp("2026-01-31T12:00:02"), "wf_start_offset": 1.0}, None),
        ({"wf_start_time": FIRST, "wf_start_offset": 0.0},
         {"wf_start_time": stamp("2026-01-31T12:00:03"), "wf_start_offset": 1.0}, "4"),
    ],
)  # fmt: skip
def test_a_later_segment_continues_the_first_one_to_half_a_step(tmp_path, first, later, passed):
    """300 samples of 0.01 s are 3 s; of start and offset, the later segment may change either or both."""
    content = channel(X, wf_increment=0.01, **first) + channel(X, **later)
    if passed is None:
        start = first.get("wf_start_offset", 0.0)
        np.testing.assert_allclose(read(tmp_path, content).time, start + np.arange(600) / 100, atol=1e-9)
    else:
        refused(
            tmp_path, content, f"whose segment from sample 300 starts {passed} s after the first one and not 3 s, as"
        )


@pytest.mark.parametrize("start", [{}, {"wf_start_time": FIRST}])
def test_an_offset_that_only_a_later_segment_states_is_none_of_the_first_samples(tmp_path, start):
    """The first 300 samples of 0.01 s start at zero; an offset of 3 s continues them, one of 5 s does not."""
    one = channel(X, wf_increment=0.01, **start)
    continued = read(tmp_path, one + channel(X, wf_start_offset=3.0))
    np.testing.assert_allclose(continued.time, np.arange(600) / 100, atol=1e-9)
    refused(
        tmp_path, one + channel(X, wf_start_offset=5.0), "from sample 300 starts 5 s after the first one and not 3 s"
    )


def test_each_later_segment_is_compared(tmp_path):
    parts = [channel(X, wf_increment=0.01, **AT_ZERO)] + [channel(X, wf_start_offset=start) for start in (3.0, 7.0)]
    refused(tmp_path, b"".join(parts), "whose segment from sample 600 starts 7 s after the first one and not 6 s")


def days(date):
    return (datetime.date.fromisoformat(date) - datetime.date(1904, 1, 1)).days


@pytest.mark.parametrize(
    "seconds, fraction, date",
    [
        (0, 0, "1904-01-01T00:00:00"), (86_400, 2**63, "1904-01-02T00:00:00.5"),
        (1, 2**34 * 3, "1904-01-01T00:00:01.000000003"),
        (1, 2**33, "1904-01-01T00:00:01"), (-1, 0, None), (days("2262-01-01") * 86_400, 0, None),
        (days("2261-01-01") * 86_400, 0, "2261-01-01"),
    ],
)  # fmt: skip
def test_timestamps_of_the_years_of_nanoseconds_are_dates(seconds, fraction, date):
    """Fractions are of 2**64, rounded to nanoseconds (2**34.1 of them)."""
    given = type("Stamp", (), {"seconds": seconds, "second_fractions": fraction})
    if date is None:
        with pytest.raises(ValueError, match="it has timestamps before 1904 or after 2261"):
            tdms._dates(given)
    else:
        assert tdms._dates(given) == np.datetime64(date, "ns")


def of_group(properties, **channels):
    """Return a segment of a group with properties, and a channel x of it."""
    objects = [(path("g"), struct.pack("<I", 0xFFFFFFFF), properties)]
    return segment([*objects, (path("g", "x"), index("<f8", len(X)), {"wf_increment": 0.01} | channels)], X.tobytes())


def test_scale_of_a_group_is_that_of_its_channels_without_one(tmp_path):
    scale = {key.replace("[1]", "[0]"): value for key, value in scaled("Linear").items() if "Source" not in key}
    scale |= {"NI_Number_Of_Scales": 1, "wf_increment": 7.0}
    content = of_group(scale | {"unit_string": "mm", "wf_start_offset": 9.0})
    run = read(tmp_path, content)
    np.testing.assert_allclose(run.outputs["x"], 1e-3 * (0.5 * X + 3.0))
    assert run.time[0] == 0.0  # only scales and units are
    np.testing.assert_allclose(read(tmp_path, of_group(scale | {"unit_string": "mm"}, unit_string="m")).outputs["x"],
                               0.5 * X + 3.0)  # fmt: skip
    refused(tmp_path, of_group(scale | {"NI_Scale[0]_Scale_Type": "Wheatstone"}), "a scale of type 'Wheatstone'")
    np.testing.assert_allclose(read(tmp_path, of_group({"unit_string": "mm"})).outputs["x"], X)


def test_unit_of_a_scale_is_used_where_there_is_no_other(tmp_path):
    run = read(tmp_path, channel(X, wf_increment=0.01, NI_UnitDescription="mm"))
    np.testing.assert_allclose(run.outputs["x"], 1e-3 * X)
    run = read(tmp_path, channel(X, wf_increment=0.01, NI_UnitDescription="mm", unit_string="cm"))
    np.testing.assert_allclose(run.outputs["x"], 1e-2 * X)


@pytest.mark.parametrize(
    "announced, remarked", [(300, False), (100, False), (1, False), (0, False), (-7, False), (301, True), (200, True)]
)
def test_samples_are_whole_records_of_those_that_are_announced(tmp_path, announced, remarked):
    read(tmp_path, channel(X, wf_increment=0.01, wf_samples=announced))
    shown = f"wf_samples announces {announced} samples, there are 300"
    assert (shown in str(bp.inspect(tmp_path / "run.tdms"))) == remarked


def test_damaged_file_is_read_or_refused_by_one_error(tmp_path, capfd):
    start = stamp("2026-01-31T12:00:00")
    whole = channel(X, wf_increment=0.01, wf_start_time=start, unit_string="mm") + raw_daqmx(
        "Linear", np.ones((50, 2), dtype="<i2")
    )
    generator, file, levels = np.random.default_rng(1), tmp_path / "run.tdms", logging.getLogger("nptdms").level
    for _ in range(200):
        file.write_bytes(damaged(whole, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                bp.inspect(file)
            except ValueError as error:
                assert "run.tdms" in str(error)
    assert capfd.readouterr() == ("", "") and logging.getLogger("nptdms").level == levels


def test_channels_of_groups_have_units_and_share_equal_clocks(tmp_path):
    """Of equal rates and starts there is one clock, of others each its own."""
    parts = [
        channel(X, "x", "g", wf_increment=0.5, unit_string="mm"), channel(X[:9], "y", "g", wf_increment=0.5),
        channel(X[:5], "x", "h", wf_increment=0.25, NI_UnitDescription="N"), channel(X[:5], "z", "h"),
        channel(X[:5], "w", "h", wf_increment=0.5, wf_start_offset=1.0, unit_string="A", NI_UnitDescription="V"),
    ]  # fmt: skip
    (tmp_path / "run").write_bytes(b"".join(parts))
    whole = tdms.contents(tmp_path / "run", [])
    assert (whole.kind, whole.word, whole.remarks, whole.suggested_time) == ("TDMS file", "channel", (), "")
    assert [(one.group, one.name, one.samples, one.unit) for one in whole.channels] == [
        ("g", "x", 300, "mm"), ("g", "y", 9, ""), ("h", "x", 5, "N"), ("h", "z", 5, ""), ("h", "w", 5, "A")
    ]  # fmt: skip
    first, second, third, fourth, fifth = (one.clock for one in whole.channels)
    assert first is second and first is not third and fourth is None and first is not fifth
    assert [(clock.start, clock.step) for clock in (first, third, fifth)] == [(0.0, 0.5), (0.0, 0.25), (1.0, 0.5)]
    assert all(one.values().tolist() == X[: one.samples].tolist() for one in whole.channels)
    assert not any(one.refusal or one.remarks for one in whole.channels)
