"""WAV files, written after their specification: samples at the right scale, or refused."""

import io
import struct
import warnings
import wave

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import wav as reader
from tests.data.test_damaged_files import damaged

# What follows the format in the identifier of an extensible header.
GUID = {"<": bytes.fromhex("00001000800000aa00389b71"), ">": bytes.fromhex("00000010800000aa00389b71")}
FRACTIONS = np.array([0.0, 0.25, -0.5, 0.75, -1.0, 0.125])


def chunk(name, content, order="<", size=None):
    return name + struct.pack(f"{order}I", len(content) if size is None else size) + content + bytes(len(content) % 2)


def packed(values, kind, bits, order):
    """Return the bytes of fractions of the full scale."""
    if kind == 3:
        return np.asarray(values, dtype=f"{order}f{bits // 8}").tobytes()
    whole = [round(value * 2 ** (bits - 1)) for value in np.ravel(values)]
    if bits == 8:
        return bytes(128 + value for value in whole)
    return b"".join(value.to_bytes(bits // 8, "little" if order == "<" else "big", signed=True) for value in whole)


def wav(
    values=FRACTIONS, kind=1, bits=16, order="<", *, channels=1, rate=51200, valid=None, extra=b"", after=b"",
    data_size=None, file_size=None, form_bits=None, block=None, tag=None,
):  # fmt: skip
    block = block or channels * bits // 8
    stated = form_bits or bits
    form = struct.pack(f"{order}HHIIHH", tag or kind, channels, rate, rate * block, block, stated)
    if valid:
        form = struct.pack(f"{order}H", 0xFFFE) + form[2:]
        form += struct.pack(f"{order}HHII", 22, valid, 0, kind) + GUID[order]
    data = chunk(b"data", packed(values, kind, bits, order), order, data_size)
    body = b"WAVE" + extra + chunk(b"fmt ", form, order) + data + after
    start = b"RIFF" if order == "<" else b"RIFX"
    return start + struct.pack(f"{order}I", len(body) if file_size is None else file_size) + body


@pytest.fixture
def read(tmp_path):
    def reader(content, key="channel 1", **arguments):
        path = tmp_path / "run.wav"
        path.write_bytes(content)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return bp.Recording.from_file(path, outputs={"x": key}, **arguments)

    return reader


@pytest.mark.parametrize("kind, bits", [(1, 8), (1, 16), (1, 24), (1, 32), (1, 64), (3, 32), (3, 64)])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("extensible", [False, True])
def test_samples_are_fractions_of_the_full_scale(read, kind, bits, order, extensible):
    run = read(wav(kind=kind, bits=bits, order=order, valid=bits if extensible else None))
    assert run.outputs["x"].tolist() == FRACTIONS.tolist()
    np.testing.assert_allclose(run.time, np.arange(6) / 51200, rtol=1e-15)


@pytest.mark.parametrize("kind, bits, given", [(1, 16, "as a fraction of the full scale"), (3, 32, "as stored")])
def test_remark_says_what_the_values_are(tmp_path, kind, bits, given):
    (tmp_path / "run.wav").write_bytes(wav(kind=kind, bits=bits))
    assert f"values are {given}: give the full scale" in str(bp.inspect(tmp_path / "run.wav"))


def test_24_bits_written_by_python_are_read_at_their_scale(tmp_path):
    with wave.open(str(tmp_path / "run.wav"), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(3)
        file.setframerate(48000)
        file.writeframes(packed(np.transpose([FRACTIONS, FRACTIONS / 2]), 1, 24, "<"))
    run = bp.Recording.from_file(
        tmp_path / "run.wav", outputs={"x": "channel 2"}, inputs={"u": "channel 1"}, units={"u": 20.0}
    )
    assert run.outputs["x"].tolist() == (FRACTIONS / 2).tolist()
    assert run.inputs["u"].tolist() == (20.0 * FRACTIONS).tolist()


def test_other_chunks_are_skipped(read):
    """A broadcast header before the format, a list of odd length and an index after the samples."""
    extra, after = chunk(b"bext", bytes(603)), chunk(b"LIST", b"INFOabc") + chunk(b"smpl", bytes(36))
    assert read(wav(extra=extra, after=after)).outputs["x"].tolist() == FRACTIONS.tolist()


def test_bytes_after_the_last_chunk_are_refused_unless_they_are_zero(read):
    """A part of a chunk shows that the file is cut off; some recorders fill the file with zeros."""
    assert read(wav() + bytes(5)).outputs["x"].tolist() == FRACTIONS.tolist()
    with pytest.raises(ValueError, match="it has bytes after its last chunk"):
        read(wav() + b"LIST")


def test_size_in_a_chunk_of_64_bits_is_used(read):
    """RF64, as of files beyond 4 GB."""
    body = wav()[12:]
    body = body.replace(b"data" + struct.pack("<I", 12), b"data" + b"\xff" * 4)
    long = chunk(b"ds64", struct.pack("<QQQI", len(body) + 40, 12, 6, 0))
    assert read(b"RF64" + b"\xff" * 4 + b"WAVE" + long + body).outputs["x"].tolist() == FRACTIONS.tolist()


def test_valid_bits_are_the_upper_ones_and_others_are_refused(read):
    """20 bits in 24, as the specification says; lower ones would be 16 times too small."""
    assert read(wav(bits=24, valid=20)).outputs["x"].tolist() == FRACTIONS.tolist()
    assert read(wav(bits=16, form_bits=12)).outputs["x"].tolist() == FRACTIONS.tolist()
    with pytest.raises(ValueError, match="samples of 24 bits have more than the 20 that its header says"):
        read(wav(FRACTIONS / 2**18, bits=24, valid=20))
    with pytest.raises(ValueError, match="have 24 of 24 bits in 4 bytes, which has several meanings"):
        read(wav(bits=32, form_bits=24))


@pytest.mark.parametrize("lost", [1, 2, 5, 11])
def test_file_that_is_cut_off_is_refused(read, lost):
    whole = wav()
    with pytest.raises(ValueError, match="path: must be a WAV file .*cut off"):
        read(whole[:-lost])
    resized = whole[:4] + struct.pack("<I", len(whole) - 8 - lost) + whole[8:-lost]
    with pytest.raises(ValueError, match="path: must be a WAV file .*cut off"):
        read(resized)


@pytest.mark.parametrize("size", [0, 4, 6, 11, 13, 14, 2**31, 2**32 - 1])
def test_wrong_size_of_the_samples_is_refused(read, size):
    with pytest.raises(ValueError, match="must be a WAV file"):
        read(wav(data_size=size))


def test_two_chunks_of_samples_are_refused(read):
    with pytest.raises(ValueError, match="it has 2 chunks of samples"):
        read(wav(after=chunk(b"data", bytes(12))))


@pytest.mark.parametrize("tag", [2, 6, 7, 0x11, 0x55, 0])
def test_compressed_samples_are_refused(read, tag):
    with pytest.raises(ValueError, match="must be a WAV file of samples without compression"):
        read(wav(tag=tag or 0x50))


@pytest.mark.parametrize("arguments", [{}, {"bits": 24, "valid": 24}, {"kind": 3, "bits": 32, "channels": 2}])
def test_damaged_file_is_refused_or_read_as_a_whole(tmp_path, arguments):
    whole, generator = wav(np.tile(FRACTIONS, 20), after=chunk(b"LIST", b"INFOabc"), **arguments), None
    path, generator = tmp_path / "run 7", np.random.default_rng(3)
    for _ in range(200):
        path.write_bytes(damaged(whole, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                bp.inspect(path, format="wav")
                run = bp.Recording.from_file(path, outputs={"x": "channel 1"}, format="wav", missing="drop")
            except ValueError as error:
                assert "must" in str(error)
                continue
        assert 2 <= run.time.size <= 120


def form(tag, channels, rate, block, bits, *, valid=None, inner=None, size=None, order="<"):
    """Return the format that a chunk states, after Microsoft's description."""
    content = struct.pack(f"{order}HHIIHH", tag, channels, rate, rate * block, block, bits)
    if inner is not None:
        content += struct.pack(f"{order}HHII", 22, valid, 0, inner) + bytes(12)
    found = reader._form(io.BytesIO(content), order, len(content) if size is None else size)
    return found.channels, found.rate, found.bits, found.valid


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    "arguments, given, expected",
    [
        ((1, 2, 8000, 4, 16), {}, (16, 16)), ((1, 1, 8000, 1, 8), {}, (8, 8)), ((1, 3, 8000, 9, 24), {}, (24, 24)),
        ((1, 1, 8000, 4, 32), {}, (32, 32)), ((1, 1, 8000, 8, 64), {}, (64, 64)), ((3, 2, 8000, 8, 32), {}, (32, 32)),
        ((3, 1, 8000, 8, 64), {}, (64, 64)), ((1, 1, 8000, 2, 12), {}, (16, 12)), ((1, 1, 8000, 1, 5), {}, (8, 8)),
        ((0xFFFE, 1, 8000, 4, 32), {"valid": 20,
         "inner": 1}, (32, 20)), ((0xFFFE, 1, 8000, 4, 32), {"valid": 0, "inner": 1},
        (32, 32)), ((0xFFFE, 1, 8000, 4, 32), {"valid": 32, "inner": 3}, (32, 32)),
    ],
)  # fmt: skip
def test_formats_of_samples(arguments, given, expected, order):
    assert form(*arguments, **given, order=order) == (arguments[1], 8000, *expected)


@pytest.mark.parametrize(
    "arguments, given, reason",
    [
        ((2, 1, 8000, 2, 16), {}, "its samples are of format 0x0002, and not linear PCM or floats"),
        ((0xFFFE, 1, 8000, 2, 16), {}, "its samples are of format 0xfffe, and not linear PCM or floats"),
        ((0xFFFE, 1, 8000, 2, 16), {"valid": 16, "inner": 1, "size": 39}, "its samples are of format 0xfffe"),
        ((0xFFFE, 1, 8000, 2, 16), {"valid": 16, "inner": 2}, "its samples are of format 0x0002"),
        ((1, 0, 8000, 2, 16), {}, "it has 0 channels of 8000 Hz in blocks of 2 bytes"),
        ((1, 1, 0, 2, 16), {}, "it has 1 channels of 0 Hz in blocks of 2 bytes"),
        ((1, 2, 8000, 3, 16), {}, "it has 2 channels of 8000 Hz in blocks of 3 bytes"),
        ((1, 1, 8000, 4, 24), {}, "its samples have 24 of 24 bits in 4 bytes, which has several meanings"),
        ((1, 1, 8000, 2, 17), {}, "its samples have 17 of 17 bits in 2 bytes"), ((1, 1, 8000, 2, 8), {},
         "its samples have 8 of 8 bits in 2"),
        ((3, 1, 8000, 2, 16), {}, "its samples have 16 of 16 bits in 2 bytes"), ((1, 1, 8000, 5, 40), {},
         "its samples have 40 of 40 bits"),
        ((0xFFFE, 1, 8000, 4, 32), {"valid": 33, "inner": 1}, "its samples have 33 of 32 bits in 4 bytes"),
    ],
)  # fmt: skip
def test_other_formats_are_refused_with_their_numbers(arguments, given, reason):
    with pytest.raises(ValueError, match=f"^{reason}"):
        form(*arguments, **given)


@pytest.mark.parametrize(
    "kind, bits, channels", [(1, 8, 1), (1, 16, 2), (1, 24, 3), (1, 32, 2), (3, 32, 2), (3, 64, 1)]
)
def test_channels_share_the_clock_of_their_rate(tmp_path, kind, bits, channels):
    """What `wav.contents` returns: samples of all channels in turn, with one remark on their scale."""
    table = np.transpose([FRACTIONS / 2**k for k in range(channels)])
    (tmp_path / "run").write_bytes(wav(table, kind, bits, channels=channels, rate=8000))
    whole = reader.contents(tmp_path / "run", [])
    given = "as stored" if kind == 3 else "as a fraction of the full scale"
    remark = f"values are {given}: give the full scale in the unit of the sensor as a factor, units={{'x': 10.0}}"
    assert (whole.kind, whole.word, whole.remarks, len(whole.channels)) == ("WAV file", "channel", (remark,), channels)
    for k, channel in enumerate(whole.channels):
        assert (channel.name, channel.samples, channel.unit) == (f"channel {k + 1}", 6, "")
        assert channel.values().tolist() == (FRACTIONS / 2**k).tolist()
        assert channel.clock is whole.channels[0].clock and (channel.clock.start, channel.clock.step) == (0.0, 1 / 8000)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"RIFX\0\0\0\0WAVX", "it does not begin as a WAV file"),
        (b"RIFZ\0\0\0\0WAVE", "it does not begin as a WAV file"),
        (b"RIFF\0\0\0\0WAVE", "it has 0 chunks of samples and no format"),
        (b"RIFF\0\0\0\0WAVE" + chunk(b"data", b""), "it has 1 chunks of samples and no format"),
        (wav()[:36], "it has 0 chunks of samples and a format"),
        (wav()[:40], "it has 0 chunks of samples and a format"),
        (wav() + wav()[36:], "it has 2 chunks of samples and a format"),
        (wav(extra=wav()[12:36]), "it has two chunks 'fmt '"), (wav() + wav()[36:-1], "it is cut off"),
        (wav(data_size=11), "its samples end within one"), (wav()[:-6] + b"\0", "it is cut off"),
        (wav(data_size=2**32 - 1), "the size of its samples is not stated, as in a file from a pipe; save it anew"),
        (wav() + b"\0\0\0\1", "it has bytes after its last chunk"),
    ],
)  # fmt: skip
def test_structure_of_other_files_is_named(tmp_path, content, message):
    (tmp_path / "run").write_bytes(content)
    with pytest.raises(ValueError, match=f"^{message}$"):
        reader._structure(tmp_path / "run")
