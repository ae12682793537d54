"""MDF files, written here after ASAM MDF 4.1 and Vector's description of MDF 3.3, or by asammdf for variants."""

import io
import logging
import struct
import warnings
from pathlib import Path
from types import SimpleNamespace

import asammdf
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import mdf, mdf_blocks
from tests.data.test_damaged_files import damaged

TIME = np.arange(200) / 1000
X = 3.0 * np.sin(np.arange(200) / 7)
COUNTS = np.arange(200, dtype="<u2") * 300
UNSIGNED, SIGNED, FLOAT = 0, 2, 4
VALUE, MASTER, VIRTUAL = 0, 2, 3
# Coefficients of conversions by their type: linear, rational, table with and without interpolation.
LINEAR, RATIONAL, FORMULA, INTERPOLATED, TABLE, TEXTS = 1, 2, 3, 4, 5, 7


class Blocks:
    """Blocks of version 4, whose links are numbers of blocks."""

    def __init__(self):
        self.blocks = []

    def add(self, kind, links=(), data=b""):
        """Add a block and return its number."""
        self.blocks.append([kind, [*links], data])
        return len(self.blocks)

    def text(self, value):
        """Add a text, if there is one."""
        return self.add(b"TX", data=value.encode() + b"\0") if value else 0

    def bytes(self, flags=0, version=b"4.10"):
        """Return the file; the last block is the header."""
        order = [self.blocks[-1], *self.blocks[:-1]]
        sizes = [24 + 8 * len(links) + len(data) for _, links, data in order]
        places = 64 + np.concatenate([[0], np.cumsum([size + -size % 8 for size in sizes])])
        address = {0: 0, len(order): 64} | {k: int(places[k]) for k in range(1, len(order))}
        content = b"MDF     " + version.ljust(8) + b"hand    " + bytes(4) + struct.pack("<H", 410) + bytes(30)
        content += struct.pack("<HH", flags, 0)
        for (kind, links, data), size in zip(order, sizes, strict=True):
            content += struct.pack("<4sIQQ", b"##" + kind, 0, size, len(links))
            content += struct.pack(f"<{len(links)}Q", *(address[link] for link in links)) + data + bytes(-size % 8)
        return content


def channel(blocks, following, name, unit, kind, place, *, master=VALUE, sync=0, conversion=0, flags=0, bits=0):
    """Add a channel before the following one."""
    size, code = kind
    data = struct.pack("<BBBBIIIIBBH", master, sync, code, 0, place, size, flags, bits, 0, 0, 0) + bytes(48)
    links = (following, 0, blocks.text(name), 0, conversion, 0, blocks.text(unit), 0)
    return blocks.add(b"CN", links, data)


def conversion(blocks, kind, values, texts=(), unit=""):
    links = (0, blocks.text(unit), 0, 0, *texts)
    return blocks.add(
        b"CC",
        links,
        struct.pack("<BBHHHdd", kind, 0, 0, len(texts), len(values), 0, 0) + np.array(values, "<f8").tobytes(),
    )


def group(blocks, following, first, record, cycles, data, *, name="g", invalid=0, flags=0):
    """Add a data group with one channel group before the following one."""
    places = (0, first, blocks.text(name), 0, 0, 0)
    inner = blocks.add(b"CG", places, struct.pack("<QQHHIII", 0, cycles, flags, 0, 0, record, invalid))
    return blocks.add(b"DG", (following, inner, blocks.add(b"DT", data=data), 0), bytes(8))


def header(blocks, first):
    blocks.add(b"HD", (first, 0, 0, 0, 0, 0), struct.pack("<QhhBBBBdd", 1_769_860_800 * 10**9, 0, 0, 0, 0, 0, 0, 0, 0))


F8, U2 = (64, FLOAT), (16, UNSIGNED)


def simple(*, kind=0, values=(), texts=(), unit="mm", time_unit="s", sync=1, cycles=200, flags=0, version=b"4.10"):
    """Return a file of a time, a channel x of floats and a channel c of counts with a conversion."""
    blocks = Blocks()
    words = [blocks.text(word) for word in texts]
    converted = conversion(blocks, kind, values, words) if kind else 0
    last = channel(blocks, 0, "c", "N", U2, 16, conversion=converted)
    middle = channel(blocks, last, "x", unit, F8, 8)
    first = channel(blocks, middle, "t", time_unit, F8, 0, master=MASTER, sync=sync)
    table = np.rec.fromarrays([TIME, X, COUNTS], dtype=[("t", "<f8"), ("x", "<f8"), ("c", "<u2")])
    header(blocks, group(blocks, 0, first, 18, cycles, table.tobytes()))
    return blocks.bytes(flags, version)


def read(folder, content, name="run.mf4", **arguments):
    file = folder / name
    if not isinstance(content, Path):
        file.write_bytes(content)
    return bp.Recording.from_file(file, **({"outputs": {"x": "x"}} | arguments))


def refused(folder, content, reason, **arguments):
    with pytest.raises(ValueError, match=reason) as error:
        read(folder, content, **arguments)
    assert "run.mf4" in str(error.value)


def test_channel_of_version_4_with_its_master_and_unit(tmp_path):
    run = read(tmp_path, simple())
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_allclose(run.outputs["x"], X * 1e-3, rtol=1e-15)
    assert [one.name for one in bp.inspect(tmp_path / "run.mf4").channels] == ["x", "c"]


def test_units_in_xml_and_of_the_conversion(tmp_path):
    """The unit of the channel precedes that of its conversion."""
    blocks = Blocks()
    scale = conversion(blocks, LINEAR, [0.0, 1.0], unit="cm")
    xml = blocks.add(b"MD", data=b"<CNunit xmlns='http://www.asam.net/mdf/v4'><TX>mm</TX></CNunit>\0")
    last = channel(blocks, 0, "cc", "", F8, 24, conversion=scale)
    third = channel(blocks, last, "both", "mm", F8, 16, conversion=scale)
    second = channel(blocks, third, "x", "", F8, 8)
    blocks.blocks[second - 1][1][6] = xml
    first = channel(blocks, second, "t", "s", F8, 0, master=MASTER, sync=1)
    header(blocks, group(blocks, 0, first, 32, 200, np.array([TIME, X, X, X]).T.tobytes()))
    run = read(tmp_path, blocks.bytes(), outputs={"x": "x", "both": "both", "cc": "cc"})
    for name, factor in (("x", 1e-3), ("both", 1e-3), ("cc", 1e-2)):
        np.testing.assert_allclose(run.outputs[name], X * factor, rtol=1e-14)


RAW = COUNTS.astype(float)


@pytest.mark.parametrize(
    "kind, values, expected",
    [
        (LINEAR, [2.0, 0.1], 0.1 * RAW + 2.0),
        (RATIONAL, [1.0, 0.0, 0.0, 0.0, 0.0, 1.0], RAW**2),  # beyond 32 bits
        (RATIONAL, [0.0, 2.0, 1.0, 0.0, 1.0, 5.0], (2 * RAW + 1) / (RAW + 5)),
        (INTERPOLATED, [0.0, 0.0, 30_000.0, 3.0, 60_000.0, 0.0], np.interp(RAW, [0, 3e4, 6e4], [0, 3, 0])),
        (TABLE, [0.0, 5.0, 40_000.0, 6.0], np.where(RAW <= 20_000, 5.0, 6.0)),
    ],
)
def test_conversions_of_version_4(tmp_path, kind, values, expected):
    run = read(tmp_path, simple(kind=kind, values=values), outputs={"c": "c"})
    np.testing.assert_allclose(run.outputs["c"], expected, rtol=1e-12)


def test_enumeration_has_texts_and_is_refused_as_numbers(tmp_path):
    content = simple(kind=TEXTS, values=[0.0, 300.0], texts=["off", "on µ", "other"])
    refused(
        tmp_path,
        content,
        "channel 'g/c' of run.mf4: must be one column of real numbers|must contain numbers",
        outputs={"c": "c"},
    )
    assert "texts, or not only numbers" in str(bp.inspect(tmp_path / "run.mf4"))


@pytest.mark.parametrize(
    "code, encoding, ending",
    [(6, "latin-1", b"\0z"), (7, "utf-8", b"\0z"), (8, "utf-16-le", b""), (9, "utf-16-be", b"")],
)
def test_texts_of_version_4_are_in_the_encoding_of_their_type(tmp_path, code, encoding, ending):
    """They end with a zero; what follows it does not count. Those of conversions are in UTF-8."""
    blocks, words = Blocks(), ["1.5 µm", "µ", "µé°"] * 20
    cells = [word.encode(encoding) + ending for word in words]
    size = max(map(len, cells))
    switch = conversion(blocks, TEXTS, [0.0, 300.0], [blocks.text(word) for word in ("off", "on µ", "other")])
    last = channel(blocks, 0, "c", "", U2, 8 + size, conversion=switch)
    middle = channel(blocks, last, "words", "", (8 * size, code), 8)
    first = channel(blocks, middle, "t", "s", F8, 0, master=MASTER, sync=1)
    kinds = [("t", "<f8"), ("words", f"S{size}"), ("c", "<u2")]
    table = np.rec.fromarrays([TIME[:60], np.array(cells), COUNTS[:60]], dtype=kinds)
    header(blocks, group(blocks, 0, first, 10 + size, 60, table.tobytes()))
    (tmp_path / "run.mf4").write_bytes(blocks.bytes())
    read_words, states = (one.values() for one in mdf.contents(tmp_path / "run.mf4", []).channels)
    assert read_words.tolist() == words
    assert states.tolist() == ["off", "on µ", *["other"] * 58]


def test_texts_of_version_3_are_in_latin_1(tmp_path):
    content = version_3().replace(struct.pack("<HHHH", 128, 16, 0, 0)[:6], struct.pack("<HHH", 128, 16, 7))
    assert content != version_3()
    words = np.array(["µ", "é", "a"] * 66 + ["m", "s"])
    rows = np.rec.fromarrays(
        [TIME, X, np.char.encode(words, "latin-1")], dtype=[("t", "<f8"), ("x", "<f8"), ("c", "S2")]
    )
    (tmp_path / "run.mdf").write_bytes(content[: -rows.nbytes] + rows.tobytes())
    _, seen = mdf.contents(tmp_path / "run.mdf", []).channels
    assert seen.values().tolist() == words.tolist()


@pytest.mark.parametrize("formula", ["X1*2", "__import__('pathlib').Path('executed').touch()"])
def test_formula_is_refused_and_not_evaluated(tmp_path, formula, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(tmp_path, simple(kind=FORMULA, texts=[formula]), "a conversion by a formula", outputs={"c": "c"})
    assert "by a formula" in str(bp.inspect("run.mf4")) and not Path("executed").exists()


def test_slow_group_keeps_its_times(tmp_path):
    """The package asammdf interpolates it in `to_dataframe`."""
    blocks, slow = Blocks(), np.arange(10) / 20 + 0.0125
    parts = []
    following = 0
    for name, time, values in (("slow", slow, np.arange(10.0)), ("fast", TIME, X)):
        last = channel(blocks, 0, "x", "mm", F8, 8)
        first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
        following = group(blocks, following, first, 16, time.size, np.array([time, values]).T.tobytes(), name=name)
        parts.append(following)
    header(blocks, following)
    refused(tmp_path, blocks.bytes(), r"the name of 2; give the group too: \('fast', 'x'\), \('slow', 'x'\)")
    run = read(tmp_path, blocks.bytes(), outputs={"x": ("fast", "x"), "y": ("slow", "x")})
    np.testing.assert_array_equal(run.times["x"], TIME)
    np.testing.assert_array_equal(run.times["y"], slow)
    np.testing.assert_allclose(run.outputs["y"], np.arange(10.0) * 1e-3)


def invalidated():
    """Return a file whose channel x has samples that are marked as invalid, from index 5 to 7."""
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 8, flags=2, bits=1)
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
    marks = np.zeros(200, "u1")
    marks[5:8] = 2
    table = np.rec.fromarrays([TIME, X, marks], dtype=[("t", "<f8"), ("x", "<f8"), ("m", "u1")])
    header(blocks, group(blocks, 0, first, 16, 200, table.tobytes(), invalid=1))
    return blocks.bytes()


def test_invalid_samples_are_missing(tmp_path):
    """The method `select` of asammdf returns them."""
    refused(tmp_path, invalidated(), r"must be finite, got nan at index 5 \(3 of 200")
    run = read(tmp_path, invalidated(), missing="drop")
    np.testing.assert_array_equal(run.time, np.delete(TIME, [5, 6, 7]))
    np.testing.assert_allclose(run.outputs["x"], np.delete(X, [5, 6, 7]) * 1e-3)


@pytest.mark.parametrize("sync, what", [(2, "angles"), (3, "distances"), (4, "indices")])
def test_master_that_is_no_time_is_refused(tmp_path, sync, what):
    refused(tmp_path, simple(sync=sync), f"which is recorded over {what} \\('t'\\) and not over time")
    assert read(tmp_path, simple(sync=sync), sampling_rate=10.0).time[1] == pytest.approx(0.1)


def test_time_is_found_beside_another_master(tmp_path):
    """The last master of a group is that of asammdf."""
    blocks = Blocks()
    last = channel(blocks, 0, "angle", "rad", F8, 16, master=MASTER, sync=2)
    middle = channel(blocks, last, "x", "mm", F8, 8)
    first = channel(blocks, middle, "t", "s", F8, 0, master=MASTER, sync=1)
    header(blocks, group(blocks, 0, first, 24, 200, np.array([TIME, X, 2 * X]).T.tobytes()))
    run = read(tmp_path, blocks.bytes(), outputs={"x": "x", "angle": "angle"})
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_array_equal(run.outputs["angle"], 2 * X)


def test_group_without_a_master_has_no_times(tmp_path):
    """The package asammdf returns 0, 1, 2."""
    blocks = Blocks()
    header(blocks, group(blocks, 0, channel(blocks, 0, "x", "mm", F8, 0), 8, 200, X.tobytes()))
    refused(tmp_path, blocks.bytes(), "time: must be given or sampling_rate")
    assert read(tmp_path, blocks.bytes(), sampling_rate=100.0).time[1] == pytest.approx(0.01)


def test_virtual_master(tmp_path):
    blocks = Blocks()
    step = conversion(blocks, LINEAR, [0.5, 0.001])
    last = channel(blocks, 0, "x", "mm", F8, 0)
    first = channel(blocks, last, "t", "s", (0, UNSIGNED), 0, master=VIRTUAL, sync=1, conversion=step)
    header(blocks, group(blocks, 0, first, 8, 200, X.tobytes()))
    np.testing.assert_allclose(read(tmp_path, blocks.bytes()).time, 0.5 + TIME, rtol=1e-12)


def test_integer_times_with_a_conversion(tmp_path):
    """Nanoseconds in integers of 64 bits, as loggers write them."""
    blocks = Blocks()
    scale = conversion(blocks, LINEAR, [0.0, 1e-9])
    last = channel(blocks, 0, "x", "mm", F8, 8)
    first = channel(blocks, last, "t", "s", (64, UNSIGNED), 0, master=MASTER, sync=1, conversion=scale)
    table = np.rec.fromarrays([np.arange(200, dtype="<u8") * 19_531, X], dtype=[("t", "<u8"), ("x", "<f8")])
    header(blocks, group(blocks, 0, first, 16, 200, table.tobytes()))
    np.testing.assert_allclose(read(tmp_path, blocks.bytes()).time, np.arange(200) * 19_531e-9, rtol=1e-14)


def test_times_in_another_unit_are_refused(tmp_path):
    refused(tmp_path, simple(time_unit="ms"), "whose times 't' have the unit 'ms'; sampling_rate=")


def test_times_that_do_not_increase_are_refused(tmp_path):
    content = simple().replace(struct.pack("<dd", TIME[20], X[20]), struct.pack("<dd", TIME[10], X[20]))
    with pytest.raises(ValueError, match="time: must increase"):
        read(tmp_path, content)


def test_samples_beyond_their_record_are_refused(tmp_path):
    """The package asammdf returns other bytes."""
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 12)
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
    header(blocks, group(blocks, 0, first, 16, 200, np.array([TIME, X]).T.tobytes()))
    refused(tmp_path, blocks.bytes(), "samples that lie beyond the end of the records")


@pytest.mark.parametrize("flags", [1, 4, 32])
def test_file_that_is_not_finalized_is_refused(tmp_path, flags):
    refused(tmp_path, simple(flags=flags), "it is not finalized")
    refused(tmp_path, simple().replace(b"MDF     ", b"UnFinMF "), "it is not finalized")
    assert [one.name for one in tmp_path.iterdir()] == ["run.mf4"]


def test_file_without_a_header_block_is_refused(tmp_path):
    content = simple()
    assert content[64:68] == b"##HD"
    refused(tmp_path, content[:64] + b"##TX" + content[68:], "must be an MDF file .* is cut off or damaged")


@pytest.mark.parametrize("cycles", [199, 201, 2**40])
def test_number_of_samples_other_than_stored_is_refused(tmp_path, cycles):
    refused(tmp_path, simple(cycles=cycles), "must be an MDF file .* is cut off or damaged")


def test_blocks_that_form_a_circle_are_refused(tmp_path):
    """The package asammdf follows them without end."""
    content = bytearray(simple())
    place = content.index(b"##DG")
    content[place + 24 : place + 32] = struct.pack("<Q", place)
    refused(tmp_path, bytes(content), "its blocks form a circle")


def test_duplicated_names_in_a_group_get_numbers(tmp_path):
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 16)
    middle = channel(blocks, last, "x", "mm", F8, 8)
    first = channel(blocks, middle, "t", "s", F8, 0, master=MASTER, sync=1)
    header(blocks, group(blocks, 0, first, 24, 200, np.array([TIME, X, 2 * X]).T.tobytes()))
    run = read(tmp_path, blocks.bytes(), outputs={"x": "x", "y": "x (2)"})
    np.testing.assert_allclose(run.outputs["y"], 2 * run.outputs["x"])


@pytest.mark.parametrize("identifiers", [1, 2])
def test_unsorted_file(tmp_path, identifiers):
    """Records of two groups in turn, each after its identifier."""
    blocks, kind = Blocks(), {1: "u1", 2: "<u2"}[identifiers]
    groups, following = [], 0
    for number, name in ((2, "y"), (1, "x")):
        last = channel(blocks, 0, name, "mm", F8, 8)
        first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
        data = struct.pack("<QQHHIII", number, 200, 0, 0, 0, 16, 0)
        following = blocks.add(b"CG", (following, first, blocks.text(name), 0, 0, 0), data)
        groups.append(following)
    numbers = np.tile(np.array([1, 2], kind), 200)
    times, values = np.repeat(TIME, 2), np.array([X, -X]).T.ravel()
    table = np.rec.fromarrays([numbers, times, values], dtype=[("n", kind), ("t", "<f8"), ("v", "<f8")])
    data = blocks.add(b"DT", data=table.tobytes())
    header(blocks, blocks.add(b"DG", (0, following, data, 0), bytes([identifiers]) + bytes(7)))
    run = read(tmp_path, blocks.bytes(), outputs={"x": "x", "y": "y"})
    np.testing.assert_allclose(run.outputs["x"], X * 1e-3)
    np.testing.assert_allclose(run.outputs["y"], -X * 1e-3)


def version_3(*, time_bits=64, rate=0.0, kind=0, values=(0.0, 1.0), unit=b"\xb5m", order="<"):
    """Return a file of version 3.3 of a time, floats x and counts c with a conversion."""

    def fixed(text, size):
        return text.ljust(size, b"\0")

    def coefficients(kind, values, unit):
        size = 46 + 8 * len(values)
        head = struct.pack(f"{order}2sHHdd", b"CC", size, 0, 0, 0) + fixed(unit, 20)
        count = len(values) // 2 if kind == 1 else len(values)  # of pairs in a table
        return head + struct.pack(f"{order}HH{len(values)}d", kind, count, *values)

    def one(following, cc, master, name, start, bits, code, rate=0.0):
        head = struct.pack(f"{order}2sHIIIIIH", b"CN", 228, following, cc, 0, 0, 0, master)
        rest = struct.pack(f"{order}HHHHdddIIH", start, bits, code, 0, 0, 0, rate, 0, 0, 0)
        return head + fixed(name, 32) + bytes(128) + rest

    width = time_bits // 8
    dg = 64 + 208
    cg, cn, sizes = dg + 28, dg + 58, 46 + 8 * len(values)
    cc = cn + 3 * 228
    data = cc + 46 + 16 + sizes
    content = b"MDF     3.30    hand    " + struct.pack("<HHHH", order == ">", 0, 330, 0) + bytes(32)
    content += struct.pack(f"{order}2sHIIIH", b"HD", 208, dg, 0, 0, 1) + b"31:01:2026" + b"12:00:00" + bytes(128)
    content += struct.pack(f"{order}QhH", 1_769_860_800 * 10**9, 0, 0) + bytes(32)
    content = content.ljust(dg, b"\0")
    content += struct.pack(f"{order}2sHIIIIHHI", b"DG", 28, 0, cg, 0, data, 1, 0, 0)
    content += struct.pack(f"{order}2sHIIIHHHII", b"CG", 30, 0, cn, 0, 0, 3, width + 10, 200, 0)
    content += one(cn + 228, 0, 1, b"t", 0, time_bits, 3 if width else 0, rate)
    content += one(cn + 456, cc, 0, b"x", 8 * width, 64, 3)
    content += one(0, cc + 62, 0, b"c", 8 * width + 64, 16, 0)
    content += coefficients(0, (0.0, 1.0), unit) + coefficients(kind, values, b"N")
    columns = [TIME, X, COUNTS] if width else [X, COUNTS]
    kinds = [("t", f"{order}f8"), ("x", f"{order}f8"), ("c", f"{order}u2")][0 if width else 1 :]
    return content + np.rec.fromarrays(columns, dtype=kinds).tobytes()


def test_file_of_version_3(tmp_path):
    run = read(tmp_path, version_3())
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_allclose(run.outputs["x"], X * 1e-6, rtol=1e-15)
    assert [one.group for one in bp.inspect(tmp_path / "run.mf4").channels] == ["", ""]
    refused(tmp_path, version_3(order=">"), "begin with the highest byte")


@pytest.mark.parametrize(
    "kind, values, expected",
    [
        (0, (2.0, 0.1), 0.1 * RAW + 2.0),
        (9, (1.0, 0.0, 0.0, 0.0, 0.0, 1.0), RAW**2),  # beyond 32 bits
        (6, (0.0, 1.0, 2.0, 3.0, 5.0, 0.0), (1.0 - 3.0 * (RAW - 5.0)) / (2.0 * (RAW - 5.0))),
        (1, (0.0, 0.0, 6e4, 3.0), RAW / 2e4),
    ],
)
def test_conversions_of_version_3(tmp_path, kind, values, expected):
    run = read(tmp_path, version_3(kind=kind, values=values), outputs={"c": "c"})
    np.testing.assert_allclose(run.outputs["c"], expected, rtol=1e-12)


@pytest.mark.parametrize("kind, how", [(7, "that is exponential"), (8, "that is logarithmic")])
def test_exponential_conversions_of_version_3_are_refused(tmp_path, kind, how):
    content = version_3(kind=kind, values=(1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
    refused(tmp_path, content, f"a conversion {how}", outputs={"c": "c"})


def test_virtual_times_of_version_3(tmp_path):
    np.testing.assert_allclose(read(tmp_path, version_3(time_bits=0, rate=0.001)).time, TIME, rtol=1e-12)
    refused(tmp_path, version_3(time_bits=0), "whose times 't' have no sampling rate")


def signals():
    return [
        asammdf.Signal(X, TIME, name="x", unit="mm"),
        asammdf.Signal(COUNTS, TIME, name="c", conversion={"a": 0.1, "b": 2.0}),
    ]


@pytest.mark.parametrize("version", ["2.14", "3.00", "3.30", "4.00", "4.10", "4.11", "4.20"])
@pytest.mark.parametrize("compression", [0, 1, 2])
def test_versions_and_compressions_of_asammdf(tmp_path, version, compression):
    if version < "4" and compression:
        return
    with asammdf.MDF(version=version) as mdf:
        mdf.append(signals())
        path = Path(mdf.save(tmp_path / "run", compression=compression))
    run = bp.Recording.from_file(path, outputs={"x": "x", "c": "c"})
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_allclose(run.outputs["x"], X * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(run.outputs["c"], RAW * 0.1 + 2.0, rtol=1e-12)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_groups_in_columns_with_masters_elsewhere(tmp_path):
    with asammdf.MDF(version="4.20", column_storage=True) as mdf:
        mdf.append(signals())
        path = mdf.save(tmp_path / "run.mf4")
    run = bp.Recording.from_file(path, outputs={"x": "x"})
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_allclose(run.outputs["x"], X * 1e-3)


@pytest.mark.parametrize("name", ["run.gzip", "run.bz2", "run.zip", "run.mf4z"])
def test_file_is_not_deleted_for_its_name(tmp_path, name):
    """The package asammdf deletes an uncompressed file of the name run.gzip or run.bz2 when it closes it."""
    read(tmp_path, simple(), name)
    assert (tmp_path / name).read_bytes() == simple()


def one_channel(*, master=None, kind=F8, time=TIME, name="g", x=None, extra=(), record=16):
    """Return a file of a group of a master, by default of time, a channel x, and others after them."""
    blocks = Blocks()
    following = 0
    for one in reversed(extra):
        following = one(blocks, following)
    following = channel(blocks, following, "x", "mm", F8, 8, **(x or {}))
    given = {"master": MASTER, "sync": 1} | {k: v(blocks) if callable(v) else v for k, v in (master or {}).items()}
    first = channel(blocks, following, "t", given.pop("unit", "s"), kind, 0, **given)
    header(blocks, group(blocks, 0, first, record, 200, np.array([time, X]).T.tobytes(), name=name))
    return blocks.bytes()


@pytest.mark.parametrize("unit", ["", "s", "sec", "Sec", "seconds"])
def test_times_in_seconds_by_any_name_are_taken(tmp_path, unit):
    np.testing.assert_array_equal(read(tmp_path, one_channel(master={"unit": unit})).time, TIME)


@pytest.mark.parametrize(
    "master, reason",
    [
        ({"unit": "min"}, "have the unit 'min'"),
        ({"conversion": lambda b: conversion(b, TABLE, [0.0, 5.0, 1.0, 6.0])}, "have a conversion that is not linear"),
        ({"conversion": lambda b: conversion(b, FORMULA, [], [b.text("X1")])}, "have a conversion that is not linear"),
        ({"flags": 1}, "have samples that are all marked as invalid"),
        ({"sync": 9}, None),
    ],
)  # fmt: skip
def test_other_times_are_refused_and_a_rate_takes_their_place(tmp_path, master, reason):
    content = one_channel(master=master)
    which = (
        f"whose times 't' {reason}" if reason else "which is recorded over an unknown quantity .'t'. and not over time"
    )
    refused(tmp_path, content, f"time: must be known, got channel 'g/x' of run.mf4, {which}.*; sampling_rate= gives it")
    assert read(tmp_path, content, sampling_rate=10.0).time[1] == pytest.approx(0.1)


def test_two_channels_of_time_are_refused(tmp_path):
    second = lambda blocks, following: channel(blocks, following, "t2", "s", F8, 8, master=MASTER, sync=1)  # noqa: E731
    refused(tmp_path, one_channel(extra=[second]), "whose times 't' have 2 channels of time; sampling_rate= gives it")


def test_times_marked_as_invalid_are_missing(tmp_path):
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 8)
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1, flags=2, bits=0)
    marks = np.zeros(200, "u1")
    marks[5:8] = 1
    table = np.rec.fromarrays([TIME, X, marks], dtype=[("t", "<f8"), ("x", "<f8"), ("m", "u1")])
    header(blocks, group(blocks, 0, first, 16, 200, table.tobytes(), invalid=1))
    refused(tmp_path, blocks.bytes(), r"time.*: must be finite, got nan at index 5 \(3 of 200")
    assert read(tmp_path, blocks.bytes(), missing="drop").time.size == 197


def test_times_of_single_precision_are_taken(tmp_path):
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 4)
    first = channel(blocks, last, "t", "s", (32, FLOAT), 0, master=MASTER, sync=1)
    table = np.rec.fromarrays([TIME.astype("f4"), X], dtype=[("t", "<f4"), ("x", "<f8")])
    header(blocks, group(blocks, 0, first, 12, 200, table.tobytes()))
    time = read(tmp_path, blocks.bytes()).time
    assert time.dtype == float and np.array_equal(time, TIME.astype("f4"))


@pytest.mark.parametrize(
    "x, reason",
    [
        ({"master": 1}, "texts or bytes of any length, which are not read"),
        ({"flags": 1}, "samples that are all marked as invalid"),
        (
            {"conversion": FORMULA},
            "a conversion by a formula; read it by asammdf with raw=True, and convert it for from",
        ),
    ],
)
def test_channels_that_are_not_read_are_refused_with_the_reason(tmp_path, x, reason):
    blocks = Blocks()
    given = x | ({"conversion": conversion(blocks, FORMULA, [], [blocks.text("X1")])} if "conversion" in x else {})
    last = channel(blocks, 0, "x", "mm", F8, 8, **given)
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
    header(blocks, group(blocks, 0, first, 16, 200, np.array([TIME, X]).T.tobytes()))
    refused(tmp_path, blocks.bytes(), f"channel 'g/x' of run.mf4: must be usable, got {reason}")


@pytest.mark.parametrize("place, sound", [(8, True), (9, False), (7, True)])
def test_samples_end_with_their_record(tmp_path, place, sound):
    """Of records of 16 bytes, those of 8 bytes begin at byte 8 at most."""
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, place)
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
    header(blocks, group(blocks, 0, first, 16, 200, np.array([TIME, X]).T.tobytes()))
    (tmp_path / "run.mf4").write_bytes(blocks.bytes())
    assert ("beyond the end of the records" not in str(bp.inspect(tmp_path / "run.mf4"))) == sound


@pytest.mark.parametrize(
    "names, expected",
    [
        (["g"], ["g"]), ([""], [""]), (["", ""], ["group 1", "group 2"]), (["g", "g"], ["g", "g (2)"]),
        (["a\nmore", "b\r\n"], ["a", "b"]), (["<x/>", "b"], ["group 1", "b"]), (["<TX>a &amp; b</TX>"], ["a & b"]),
    ],
)  # fmt: skip
def test_names_of_groups(tmp_path, names, expected):
    """The first line of the text, without XML around it; a number where there is none and several groups."""
    blocks, following = Blocks(), 0
    for name in reversed(names):
        last = channel(blocks, 0, "x", "mm", F8, 8)
        first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
        following = group(blocks, following, first, 16, 200, np.array([TIME, X]).T.tobytes(), name=name)
    header(blocks, following)
    (tmp_path / "run.mf4").write_bytes(blocks.bytes())
    assert [one.group for one in bp.inspect(tmp_path / "run.mf4").channels] == expected


@pytest.mark.parametrize("stated, text", [
    (" mm\0", "mm"), (None, ""), ("<x><TX xml='1'> mm </TX></x>", "mm"), ("<x>mm</x>", "<x>mm</x>"), ("a<TX>b</TX>",
    "a<TX>b</TX>"), ("<TX>&lt;5&amp;</TX>", "<5&"), ("<TX>a\nb</TX>", "a\nb"),
])  # fmt: skip
def test_texts_within_xml(stated, text):
    assert mdf._text(stated) == text


def test_instants_of_files_are_their_origin(tmp_path):
    path = tmp_path / "run.mf4"
    for start, origin in (
        (1_769_860_800 * 10**9, np.datetime64("2026-01-31T12:00:00", "ns")), (0, None), (2**63, None),
        (2**63 - 1, np.datetime64(2**63 - 1, "ns")),
    ):  # fmt: skip
        path.write_bytes(simple().replace(struct.pack("<Q", 1_769_860_800 * 10**9), struct.pack("<Q", start)))
        assert {one.clock.origin for one in mdf.contents(path, []).channels} == {origin}
    assert mdf._origin(SimpleNamespace(header=SimpleNamespace())) is None  # before version 3.20


@pytest.mark.parametrize("content", [simple(kind=LINEAR, values=[0, 1.0]), invalidated(), version_3()])
def test_damaged_file_is_read_or_refused_by_one_error(tmp_path, content, capfd):
    generator, file, level = np.random.default_rng(3), tmp_path / "run.mf4", logging.getLogger("asammdf").level
    for _ in range(200):
        file.write_bytes(damaged(content, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                bp.inspect(file, format="mdf")
            except ValueError as error:
                assert "run.mf4" in str(error)
    assert capfd.readouterr() == ("", "") and logging.getLogger("asammdf").level == level
    assert [one.name for one in tmp_path.iterdir()] == ["run.mf4"]


def test_places_beyond_the_end_of_a_file_are_empty():
    """Links of damaged files are any numbers of 64 bits."""
    content = mdf_blocks.Bytes(io.BytesIO(b"abc"))
    assert len(content) == 3
    assert [content[1:9], content[3:4], content[2**64 - 8 : 2**64]] == [b"bc", b"", b""]
