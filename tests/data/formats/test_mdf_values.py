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
