"""Blocks of MDF files, built after ASAM MDF 4.1 and Vector's description of MDF 3.3: sound or named."""

import io
import struct
import zlib

import numpy as np
import pytest

from bayesperiodic.data.formats import mdf, mdf_blocks
from tests.data.formats.test_mdf import (
    F8,
    FLOAT,
    LINEAR,
    MASTER,
    TIME,
    UNSIGNED,
    Blocks,
    X,
    channel,
    conversion,
    group,
    header,
    read,
    refused,
    version_3,
)

TABLE = np.array([TIME, X]).T.tobytes()
HALF = len(TABLE) // 2


def checked(content):
    """Return the message on a file, empty if it is sound."""
    try:
        mdf_blocks.check(mdf_blocks.Bytes(io.BytesIO(content)))
    except ValueError as error:
        return str(error)
    return ""


def packed(blocks, data, kind=b"DT", original=None, stated=None):
    """Add data compressed by deflate, with the size that its header states."""
    content = zlib.compress(data)
    size = len(data) if original is None else original
    form = struct.pack("<2sBBIQQ", kind, 0, 0, 0, size, len(content) if stated is None else stated)
    return blocks.add(b"DZ", data=form + content)


def listed(blocks, *parts, following=0):
    """Add a list of data blocks of one length."""
    return blocks.add(b"DL", (following, *parts), struct.pack("<B3xIQ", 1, len(parts), HALF))


def file_of(data, cycles=200, **arguments):
    """Return a file of a time and a channel x whose data block a function adds."""
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 8, conversion=arguments.pop("cc", lambda _: 0)(blocks))
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
    form = struct.pack("<QQHHIII", 0, cycles, arguments.pop("flags", 0), 0, 0, 16, arguments.pop("invalid", 0))
    inner = blocks.add(b"CG", (0, first, blocks.text("g"), 0, 0, 0), form)
    header(blocks, blocks.add(b"DG", (0, inner, data(blocks), 0), bytes(8)))
    return blocks.bytes()


DATA = {
    "one block": lambda b: b.add(b"DT", data=TABLE),
    "compressed": lambda b: packed(b, TABLE),
    "a list": lambda b: listed(b, b.add(b"DT", data=TABLE[:HALF]), b.add(b"DT", data=TABLE[HALF:])),
    "two lists": lambda b: listed(
        b, b.add(b"DT", data=TABLE[:HALF]), following=listed(b, b.add(b"DT", data=TABLE[HALF:]))
    ),
    "a list of compressed ones": lambda b: b.add(
        b"HL", (listed(b, packed(b, TABLE[:HALF]), packed(b, TABLE[HALF:])),), struct.pack("<HB5x", 1, 0)
    ),
}


@pytest.mark.parametrize("form", DATA)
def test_samples_in_any_arrangement_of_blocks_are_read(tmp_path, form):
    run = read(tmp_path, file_of(DATA[form]))
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_allclose(run.outputs["x"], 1e-3 * X, rtol=1e-15)


@pytest.mark.parametrize("form", DATA)
@pytest.mark.parametrize("cycles", [199, 201])
def test_one_sample_less_or_more_than_stated_is_refused_in_any_arrangement(form, cycles):
    message = checked(file_of(DATA[form], cycles))
    assert message == f"it is cut off or damaged: a data group has {len(TABLE)} bytes and not {16 * cycles}"


@pytest.mark.parametrize(
    "extra, cycles, sound", [(0, 200, True), (15, 200, True), (16, 200, False), (0, 0, False), (-1, 200, False)]
)
def test_a_part_of_a_record_may_follow_the_last_one(extra, cycles, sound):
    data = TABLE + bytes(extra) if extra >= 0 else TABLE[:extra]
    assert (checked(file_of(lambda b: b.add(b"DT", data=data), cycles)) == "") == sound


def test_bytes_of_invalidation_bits_are_part_of_a_record():
    wide = bytes(17 * 200)
    assert checked(file_of(lambda b: b.add(b"DT", data=wide), invalid=1)) == ""
    assert "has 3200 bytes and not 3400" in checked(file_of(DATA["one block"], invalid=1))
    # A block of these bits alone is none of samples.
    split = file_of(lambda b: listed(b, b.add(b"DT", data=TABLE), b.add(b"DI", data=bytes(200))))
    assert checked(split) == ""


def test_samples_of_any_length_are_not_counted():
    """A channel group of them states the number of its samples and no length; others beside it are counted."""
    assert checked(file_of(lambda b: b.add(b"SD", data=TABLE[:1001]), flags=mdf_blocks.VLSD)) == ""
    blocks = Blocks()
    last = channel(blocks, 0, "x", "mm", F8, 8)
    first = channel(blocks, last, "t", "s", F8, 0, master=MASTER, sync=1)
    counted = struct.pack("<QQHHIII", 0, 200, 0, 0, 0, 15, 0)
    inner = blocks.add(b"CG", (0, first, blocks.text("g"), 0, 0, 0), counted)
    any_length = struct.pack("<QQHHIII", 1, 3, mdf_blocks.VLSD, 0, 0, 40, 0)
    outer = blocks.add(b"CG", (inner, 0, 0, 0, 0, 0), any_length)
    data = blocks.add(b"DT", data=bytes(200 * 16 + 100))
    header(blocks, blocks.add(b"DG", (0, outer, data, 0), b"\1" + bytes(7)))
    assert checked(blocks.bytes()) == ""


@pytest.mark.parametrize(
    "data",
    [
        lambda b: packed(b, TABLE, stated=10**6),  # beyond the end of the file
        lambda b: packed(b, TABLE, original=2**31 + 1),
        lambda b: packed(b, b"", original=1100 * 108 + 1),  # deflate packs 1030 bytes in one
        lambda b: b.add(b"TX", data=TABLE),
        lambda b: packed(b, TABLE, kind=b"TX"),
    ],
)
def test_data_that_cannot_be_are_called_damaged(data):
    assert checked(file_of(data)) == "it is cut off or damaged"


def linked(content, kind, place, target):
    """Return a file in which the link of the first block of a kind leads to the first one of another kind."""
    content = bytearray(content)
    start = content.index(kind) + 24 + 8 * place
    content[start : start + 8] = struct.pack("<Q", content.index(target))
    return bytes(content)


def converted(blocks):
    """Add a conversion that refers to another one."""
    return conversion(blocks, LINEAR, [0.0, 1.0], [conversion(blocks, LINEAR, [0.0, 1.0], [blocks.text("name")])])


@pytest.mark.parametrize(
    "form, kind, place, target",
    [
        ("one block", b"##DG", 0, b"##DG"),
        ("one block", b"##CG", 0, b"##CG"),
        ("one block", b"##CN", 0, b"##CN"),
        ("a list", b"##DL", 0, b"##DL"),
        ("a list of compressed ones", b"##DL", 1, b"##HL"),
    ],
)
def test_links_that_form_a_circle_are_called_so(form, kind, place, target):
    assert checked(linked(file_of(DATA[form]), kind, place, target)) == "it is damaged: its blocks form a circle"


@pytest.mark.parametrize("depth, sound", [(0, True), (10, True), (11, False)])
def test_conversions_may_refer_to_ten_others_in_turn(depth, sound):
    def chain(blocks):
        last = blocks.text("name")
        for _ in range(depth + 1):
            last = conversion(blocks, LINEAR, [0.0, 1.0], [last])
        return last

    content = file_of(DATA["one block"], cc=chain)
    assert checked(content) == ("" if sound else "it is damaged: its blocks form a circle")
    assert "circle" in checked(linked(file_of(DATA["one block"], cc=converted), b"##CC", 4, b"##CC"))
    assert "circle" in checked(linked(file_of(DATA["one block"], cc=converted), b"##CC", 4, b"##DG"))


@pytest.mark.parametrize("kind, place", [(b"##DG", 1), (b"##DG", 2), (b"##CG", 1), (b"##CN", 0), (b"##CN", 4)])
@pytest.mark.parametrize("target", [-24, -23, 2**63])
def test_links_beyond_the_end_are_called_damage(kind, place, target):
    """24 bytes before the end, where the head of a block would have space, are no block either."""
    content = bytearray(file_of(DATA["one block"], cc=converted) + bytes(24))
    start = content.index(kind) + 24 + 8 * place
    content[start : start + 8] = struct.pack("<Q", target if target > 0 else len(content) + target)
    assert checked(bytes(content)) == "it is cut off or damaged"


def test_blocks_that_end_with_the_file_are_whole():
    blocks = Blocks()
    blocks.add(b"HD", (0,) * 6, bytes(32))
    content = blocks.bytes()
    assert checked(content) == "" and checked(content[:-1]) == "it is cut off or damaged"
    for kind, count in ((b"##HD", 5), (b"##HD", 4)):  # of its tree it needs five links
        short = bytearray(content)
        short[64 + 16 : 64 + 24] = struct.pack("<Q", count)
        assert (checked(bytes(short)) == "") == (count == 5), kind
    other = bytearray(content)
    other[64:66] = b"xx"
    assert checked(bytes(other)) == "it is cut off or damaged"
    long = bytearray(content)
    long[64 + 16 : 64 + 24] = struct.pack("<Q", 11)  # 24 + 88 bytes are more than its 104
    assert checked(bytes(long)) == "it is cut off or damaged"


def test_group_whose_block_is_of_another_kind_or_too_short_is_called_damaged():
    content = file_of(DATA["one block"])
    assert checked(linked(content, b"##DG", 1, b"##CN")) == "it is cut off or damaged"
    short = bytearray(content)
    start = content.index(b"##CG")
    short[start + 16 : start + 24] = struct.pack("<Q", 5)
    assert checked(bytes(short)) == "it is cut off or damaged"


def changed(place, form, *values):
    content = bytearray(version_3())
    content[place : place + struct.calcsize(form)] = struct.pack(form, *values)
    return bytes(content)


HD, DG = 64, 272
CG, CN = DG + 28, DG + 58


@pytest.mark.parametrize(
    "content, message",
    [
        (version_3(), ""),
        (version_3()[:-1], "it is cut off or damaged: a data group has 3599 bytes and not 3600"),
        (version_3() + b"more", ""),
        (changed(DG + 20, "<H", 1), ""),  # the number of channel groups says nothing
        (changed(DG + 4, "<I", DG), "it is damaged: its blocks form a circle"),
        (changed(CG + 4, "<I", CG), "it is damaged: its blocks form a circle"),
        (changed(CN + 4, "<I", CN), "it is damaged: its blocks form a circle"),
        (changed(HD + 4, "<I", CG), "it is cut off or damaged"),  # no data group
        (changed(DG + 8, "<I", CN), "it is cut off or damaged"),
        (changed(CG + 8, "<I", CN + 3 * 228), "it is cut off or damaged"),
        (changed(CN + 4, "<I", 2**31), "it is cut off or damaged"),
        (changed(CN + 2, "<H", 7), "it is cut off or damaged"),  # shorter than its links
        (changed(CN + 2, "<H", 8), ""),
        (changed(CN + 2, "<H", 60_000), "it is cut off or damaged"),
        (changed(CG + 22, "<I", 201), "it is cut off or damaged: a data group has 3600 bytes and not 3618"),
        (changed(DG + 22, "<H", 1), "it is cut off or damaged: a data group has 3600 bytes and not 3800"),
        (changed(DG + 16, "<I", 10**6), "it is cut off or damaged: a data group has 0 bytes and not 3600"),
    ],
)
def test_blocks_of_version_3(content, message):
    """A link of 4 bytes at byte 4 of a channel, at 4 and 8 of a group; the data are 200 records of 18 bytes."""
    assert checked(content) == message


def test_refusals_say_what_helps(tmp_path):
    content = bytearray(file_of(DATA["one block"]))
    content[60:62] = b"\1\0"
    refused(
        tmp_path, bytes(content), r"it is not finalized: .* asammdf.MDF\(path\).save\(other\) writes a finalized one"
    )
    refused(tmp_path, version_3(order=">"), r"begin with the highest byte \(Motorola\), which asammdf does not read")


@pytest.mark.parametrize(
    "kind, converted, flags, kept",
    [
        (F8, False, 0, True), (F8, True, 0, False), (F8, False, 2, False), ((32, FLOAT), False, 0, False),
        ((64, UNSIGNED), False, 0, False),
    ],
)  # fmt: skip
def test_times_that_are_stored_as_they_are_are_read_with_a_channel(tmp_path, monkeypatch, kind, converted, flags, kept):
    """And not once more, as that would take as long as a channel; other ones are converted when they are asked for."""
    time = np.arange(200) if kind[1] == UNSIGNED else 1.0 + TIME
    blocks, size = Blocks(), kind[0] // 8
    scale = conversion(blocks, LINEAR, [0.0, 2.0]) if converted else 0
    last = channel(blocks, 0, "x", "mm", F8, size)
    first = channel(blocks, last, "t", "s", kind, 0, master=MASTER, sync=1, conversion=scale, flags=flags)
    stored = time.astype({F8: "f8", (32, FLOAT): "f4", (64, UNSIGNED): "u8"}[kind])
    table = np.rec.fromarrays([stored, X, np.zeros(200, "u1")], dtype=[("t", stored.dtype), ("x", "f8"), ("m", "u1")])
    header(blocks, group(blocks, 0, first, size + 8, 200, table.tobytes(), invalid=1))
    (tmp_path / "run.mf4").write_bytes(blocks.bytes())
    (x,) = mdf.contents(tmp_path / "run.mf4", []).channels
    assert np.array_equal(x.values(), X) and np.array_equal(x.values(), X)
    read_again = []
    values = mdf._values
    monkeypatch.setattr(mdf, "_values", lambda *given: read_again.append(given) or values(*given))
    assert np.array_equal(x.clock.times(200), stored * (2.0 if converted else 1.0))
    assert bool(read_again) != kept
