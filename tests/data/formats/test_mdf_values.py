"""Values of channels of MDF files, by objects in place of those of asammdf."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayesperiodic.data.formats import mdf


@pytest.mark.parametrize("times, alone", [(None, True), ([], False), ([np.zeros(3)], True)])
@pytest.mark.parametrize("version, kind, number", [(4, 0, True), (4, 6, False), (3, 16, True), (3, 7, False)])
def test_times_are_read_once_with_the_first_channel_of_numbers(times, alone, version, kind, number):
    """Samples without times are read for the others, and for texts."""
    channel = SimpleNamespace(name="x", data_type=kind, conversion=None)
    group = SimpleNamespace(channels=[None, channel], channel_group=SimpleNamespace(cycles_nr=3))
    seen, values = [], np.array([1.0, 2.0, 3.0])

    def get(samples_only=False, **options):
        seen.append((samples_only, options))
        signal = SimpleNamespace(samples=values, invalidation_bits=np.array([0, 1, 0]), timestamps=np.arange(3.0))
        return (values, signal.invalidation_bits) if samples_only else signal

    kept = None if times is None else [*times]
    read = mdf._values(SimpleNamespace(groups=[None, group], get=get), version, 1, 1, kept)
    assert np.array_equal(read, [1.0, np.nan, 3.0], equal_nan=True)
    options = {"group": 1, "index": 1, "raw": True, "ignore_invalidation_bits": True}
    assert seen == [(alone or not number, options)]
    if times is not None:
        assert [one.tolist() for one in kept] == [[0.0, 1.0, 2.0]] * (number and not times) + [[0.0] * 3] * len(times)


@pytest.mark.parametrize(
    "version, kind, bits, known, expected",
    [
        (4, 2, 64, [], [5, 6, 7]), (4, 3, 64, [], [0, 1, 2]), (4, 3, 0, [], [0, 1, 2]), (4, 2, 0, [], [5, 6, 7]),
        (3, 1, 64, [], [5, 6, 7]), (3, 1, 0, [], [0, 1, 2]), (3, 3, 64, [], [5, 6, 7]),
        (4, 3, 64, [8, 9, 10], [8, 9, 10]),
        (4, 2, 64, [8, 9, 10], [8, 9, 10]),
    ],
)  # fmt: skip
def test_times_are_known_or_computed_by_asammdf_or_stored(version, kind, bits, known, expected):
    """Virtual masters have no samples: those of type 3 in version 4, and those without bits in version 3."""
    master = SimpleNamespace(name="t", data_type=0, conversion=None, channel_type=kind, bit_count=bits)
    group = SimpleNamespace(channels=[None, master], channel_group=SimpleNamespace(cycles_nr=3))

    def get(samples_only, **options):
        assert samples_only and (options["group"], options["index"]) == (1, 1)
        return np.array([5, 6, 7]), None

    def get_master(group):
        assert group == 1
        return np.arange(3)

    mdf_file = SimpleNamespace(groups=[None, group], get=get, get_master=get_master)
    times = mdf._times(mdf_file, version, 1, 1, [np.array(known)] if known else [])
    assert times.tolist() == expected and times.dtype == float


def master(kind=2, sync=1, bits=64, form=4, conversion=None, **more):
    given = {
        "name": "t",
        "unit": "s",
        "flags": 0,
        "byte_offset": 0,
        "bit_offset": 0,
        "sampling_rate": 1.0,
        "start_offset": 0,
    }
    return SimpleNamespace(
        **given | more, channel_type=kind, sync_type=sync, bit_count=bits, data_type=form, conversion=conversion
    )


def conversion(kind, **blocks):
    return SimpleNamespace(conversion_type=kind, unit="", referenced_blocks=blocks)


def group_of(*channels, size=8, flags=0):
    inner = SimpleNamespace(flags=flags, samples_byte_nr=size, cycles_nr=3, cg_master_index=0)
    return SimpleNamespace(channels=[*channels], channel_group=inner)


PLAIN = {
    "a double": ((master(),), 4, True), "two masters": ((master(), master()), 4, False),
         "no master": ((master(0),), 4, False),
    "virtual": ((master(3),), 4, False), "single": ((master(bits=32),), 4, False),
         "integers": ((master(form=0),), 4, False),
    "other double": ((master(form=5),), 4, True), "converted": ((master(conversion=conversion(1)),), 4, False),
    "not converted": ((master(conversion=conversion(0)),), 4, True), "invalid bits": ((master(flags=2),), 4, False),
    "all invalid": ((master(flags=1),), 4, False), "other flags": ((master(flags=4),), 4, True),
    "version 3": ((master(1, form=2),), 3, True), "version 3, integers": ((master(1, form=0),), 3, False),
    "version 3, converted": ((master(1, form=3, conversion=conversion(0)),), 3, False),
    "version 3, not converted": ((master(1, form=3, conversion=conversion(65535)),), 3, True),
    "version 3, flags": ((master(1, form=16, flags=3),), 3, True),
         "version 3, master of version 4": ((master(2, form=2),), 3, False),
}  # fmt: skip


@pytest.mark.parametrize("case", PLAIN)
def test_plain_times_are_doubles_as_they_are_stored(case):
    channels, version, plain = PLAIN[case]
    for flags, remote in ((0, False), (8, version == 4), (1, False)):
        whole = SimpleNamespace(groups=[None, group_of(*channels, flags=flags)])
        assert mdf._is_plain(whole, version, 1) is (plain and not remote)


FORMULA = "by a formula; read it by asammdf with raw=True, and convert it for from_arrays"


@pytest.mark.parametrize(
    "version, channel, reason",
    [
        (4, master(0), ""), (4, master(0, conversion=conversion(1)), ""),
        (4, master(0, conversion=conversion(3)), f"a conversion {FORMULA}"),
        (4, master(0, conversion=conversion(7, a=conversion(1), b=conversion(3))), f"a conversion {FORMULA}"),
        (4, master(0, conversion=conversion(7, a=b"text")), ""),
        (3, master(0, conversion=conversion(10)), f"a conversion {FORMULA}"),
        (3, master(0, conversion=conversion(3)), ""), (4, master(0, conversion=conversion(10)), ""),
        (3, master(0, conversion=conversion(7)), "a conversion that is exponential; read it by asammdf with raw=True"),
        (3, master(0, conversion=conversion(8)), "a conversion that is logarithmic; read it by asammdf with raw=True"),
        (4, master(1), "texts or bytes of any length, which are not read"),
        (4, master(5), "texts or bytes of any length"),
        (4, master(7), "texts or bytes of any length"), (3, master(1), ""),
        (4, master(0, byte_offset=1), "samples that lie beyond the end of the records"),
        (4, master(0, bit_offset=1), "samples that lie"),
        (4, master(0, byte_offset=1, bits=56), ""), (4, master(3, bits=65), ""), (4, master(6, bits=65), ""),
        (4, master(0, bits=65), "samples that lie"), (3, master(0, bits=65), "samples that lie"),
        (3, master(0, start_offset=1), "samples"),
        (3, master(0, bits=0, start_offset=99), ""), (3, master(0, bits=56, additional_byte_offset=1), ""),
        (3, master(0, bits=57, additional_byte_offset=1), "samples that lie"), (4, master(0, start_offset=99), ""),
        (4, master(0, flags=1), "samples that are all marked as invalid"), (4, master(0, flags=3), ""),
        (4, master(0, flags=2), ""),
        (3, master(0, flags=1), ""),
    ],
)  # fmt: skip
def test_values_that_asammdf_does_not_return_are_refused(version, channel, reason):
    refusal = mdf._refusal(version, group_of(channel), channel)
    assert refusal.startswith(reason) and bool(refusal) == bool(reason)
