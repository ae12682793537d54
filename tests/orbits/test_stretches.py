"""Sections of recordings with gaps, and of several recordings."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import bayesperiodic as bp
from bayesperiodic import _io
from bayesperiodic.orbits import find
from bayesperiodic.orbits.cycles import refine
from bayesperiodic.orbits.return_map import ReturnMap
from tests.orbits import chaos, harvester
from tests.orbits.test_find import coupled, henon, map_orbit, map_section

BOTH = ("angle", "rate")
ANGLE = {"frequency": chaos.FREQUENCY, "angles": ("angle",)}
SIZE = np.array([chaos.SIZE["angle"], chaos.SIZE["rate"]])
PERIOD = 1.0 / chaos.FREQUENCY


def part(recording, first, last):
    """Return the samples first to last − 1."""
    samples = slice(first, last)
    return bp.Recording(recording.time[samples], {k: v[samples] for k, v in recording.outputs.items()}, {})


def section_of(*recordings):
    return bp.PoincareSection.from_recordings(recordings, BOTH, **ANGLE)


def pieces(periods, samples=40, seed=3, noise=0.0, longest=60):
    """Return a recording, the first and last samples of pieces of random length, and whether each is recorded."""
    recording = chaos.recording(periods, samples, noise)
    generator = np.random.default_rng(seed)
    lengths = generator.integers(10 * samples, longest * samples, periods)
    edges = np.concatenate([[0], np.cumsum(lengths)])
    edges = np.append(edges[edges < len(recording.time) - 10 * samples], len(recording.time))
    bounds = np.stack([edges[:-1], edges[1:]], axis=1)
    kept = np.arange(len(bounds)) % 4 != 1
    # One sample between pieces is an interval; a gap of a quarter of a period contains a point or not.
    bounds[kept, 1] -= generator.integers(0, 2, kept.sum()) * (samples // 4)
    return recording, bounds, kept


def gapped(periods, samples=40, noise=0.0, longest=60):
    """Return a recording as a whole and its pieces."""
    recording, bounds, kept = pieces(periods, samples, noise=noise, longest=longest)
    return recording, [part(recording, *ends) for ends in bounds[kept]], bounds[kept]


def turned(difference):
    return difference - 2 * np.pi * np.round(difference / (2 * np.pi)) * [1, 0]


def test_a_section_with_gaps_is_that_of_the_whole_without_the_points_in_gaps():
    recording, parts, bounds = gapped(1500)
    whole, section = section_of(recording), section_of(*parts)
    assert whole.stretches is None and whole.left_out == 0
    # The points of the whole are at every 40th sample.
    piece = np.full(len(recording.time), -1)
    for number, (first, last) in enumerate(bounds):
        # Pieces that continue each other are one stretch.
        joined = number > 0 and first == bounds[number - 1][1]
        piece[first:last] = piece[first - 1] if joined else number
    expected = piece[::40][: len(whole)]
    inside = expected >= 0
    np.testing.assert_allclose(section.instants, whole.instants[inside])
    assert np.abs(turned(section.points - whole.points[inside]) / SIZE).max() < 1e-9
    labels = expected[inside]
    np.testing.assert_array_equal(np.diff(section.stretches) == 0, np.diff(labels) == 0)
    assert len(np.unique(labels)) > 20
    last = np.flatnonzero(inside)[-1] - np.flatnonzero(inside)[0] + 1
    assert section.left_out == last - inside.sum() > 100
    unbroken = np.flatnonzero(np.diff(labels) == 0)
    assert np.all(np.isnan(np.delete(section.increments, unbroken, axis=0)))
    steps = np.diff(chaos.path(1500, 40)[::40], axis=0)[np.flatnonzero(inside)[unbroken]]
    np.testing.assert_allclose(section.increments[unbroken], steps, atol=1e-6)
    assert f"in {len(np.unique(labels))} unbroken stretches; {section.left_out} points in gaps left out" in repr(
        section
    )


def test_values_beside_gaps_come_from_one_side_only():
    # Behind each gap is a motion of another start. Points between the samples, at the edges too, agree with the path.
    samples, offset = 200, 3
    time = np.arange(301 * samples) * PERIOD / samples
    dense = [chaos.path(300, samples, start) for start in (0, 1)]
    # Every fifth sample is kept, so that the first and the last point have none to six beside them.
    kept = [slice(10 * k * samples - k, (10 * k + 9) * samples + 1 + k) for k in range(30)]
    parts, expected = [], []
    for number, samples_of in enumerate(kept):
        motion = dense[number % 2][samples_of]
        every = slice(offset % 5, None, 5)
        parts.append(bp.Recording(time[samples_of][every], {"angle": motion[every, 0], "rate": motion[every, 1]}, {}))
        numbers = np.arange(samples_of.start, samples_of.stop)[every]
        first, last = -(-numbers[0] // samples), numbers[-1] // samples
        expected.append(dense[number % 2][samples * np.arange(first, last + 1)])
    section = section_of(*parts)
    away = turned(section.points - np.concatenate(expected)) / SIZE
    assert np.abs(away).max() < 1e-3
    for number in range(30):
        mine = np.flatnonzero(section.stretches == number)
        cycle = section.cycle(mine[0], len(mine) - 1, samples=200)
        instant = round(section.instants[mine[0]] / PERIOD * samples)
        path = dense[number % 2][instant : instant + 200 * (len(mine) - 1)]
        away = turned(np.stack([cycle["angle"], cycle["rate"]], axis=1) - path) / SIZE
        assert np.abs(away).max() < 1e-3


def test_the_order_of_recordings_does_not_matter_and_continued_ones_are_joined():
    recording, parts, _ = gapped(600)
    section = section_of(*parts)
    again = section_of(*(parts[k] for k in np.random.default_rng(1).permutation(len(parts))))
    np.testing.assert_array_equal(again.points, section.points)
    np.testing.assert_array_equal(again.stretches, section.stretches)
    # Cut between any two samples: also beside the points.
    cuts = [0, 4000, 8001, 12017, len(recording.time)]
    halves = [part(recording, *ends) for ends in zip(cuts[:-1], cuts[1:], strict=True)]
    halves[2] = bp.Recording(
        halves[2].time, halves[2].outputs | {"angle": halves[2].outputs["angle"] % (2 * np.pi)}, {}
    )
    joined, whole = section_of(*halves[::-1]), section_of(recording)
    assert joined.stretches is None
    np.testing.assert_allclose(joined.points, whole.points, atol=1e-9)
    np.testing.assert_allclose(joined.increments, whole.increments, atol=1e-9)
    assert repr(joined) == repr(whole)


def test_a_recording_with_gaps_is_the_same_as_its_parts():
    recording, parts, _ = gapped(600)
    time = np.concatenate([one.time for one in parts])
    outputs = {name: np.concatenate([one.outputs[name] for one in parts]) for name in BOTH}
    one = bp.PoincareSection.from_recording(bp.Recording(time, outputs, {}), BOTH, **ANGLE)
    several = section_of(*parts)
    np.testing.assert_array_equal(one.instants, several.instants)
    np.testing.assert_array_equal(one.stretches, several.stretches)
    np.testing.assert_allclose(one.points, several.points, atol=1e-9)
    assert one.left_out == several.left_out


@pytest.mark.parametrize(("samples", "missing", "breaks"), [(40, 1, 0), (40, 2, 0), (40, 3, 1), (8, 1, 1)])
def test_missing_samples_are_a_gap_where_they_cannot_be_interpolated(samples, missing, breaks):
    """Three usual steps; with few samples a period, an eighth of it."""
    recording = chaos.recording(300, samples)
    first = 100 * samples + samples // 4
    kept = np.delete(np.arange(len(recording.time)), np.arange(first, first + missing))
    thinned = bp.Recording(recording.time[kept], {k: v[kept] for k, v in recording.outputs.items()}, {})
    section = bp.PoincareSection.from_recording(thinned, BOTH, **ANGLE)
    assert np.isnan(section.increments[:, 0]).sum() == breaks


def test_the_noise_of_points_in_pieces_is_stated_right():
    # As for one recording (test_section): the sd is that of the errors within 8 %.
    recording, parts, bounds = gapped(3000, 100, 0.001)
    section = section_of(*parts)
    clean = chaos.path(3000, 100)[np.round(section.instants * chaos.FREQUENCY * 100).astype(int)]
    errors = turned(section.points - clean)
    np.testing.assert_allclose(section.noise, errors.std(axis=0), rtol=0.08)
    assert np.all(section.noise < 0.5 * 0.001 * SIZE)


def test_orbits_in_pieces_are_those_of_the_whole():
    recording, parts, _ = gapped(9000, 40, 0.0005, longest=40)
    section = section_of(*parts)
    assert len(np.unique(section.stretches)) > 100
    whole = bp.find_orbits(section_of(recording), periods=[1, 2])
    orbits = bp.find_orbits(section, periods=[1, 2])
    # Those with few returns are found or not by chance, in recordings as short as the pieces together too.
    for some, others, fewest in ((orbits, whole, 9), (whole, orbits, 14)):
        often = [orbit for orbit in some if orbit.returns >= fewest]
        assert len(often) >= 8
        for orbit in often:
            alike = [o for o in others if (o.period, o.winding) == (orbit.period, orbit.winding)]
            away = [np.roll(o.points, shift, axis=0) - orbit.points for o in alike for shift in range(orbit.period)]
            assert min(np.abs(turned(one) / SIZE).max() for one in away) < 0.01, orbit
    # Three quarters of the points are kept, and of the returns.
    assert 0.6 < sum(o.returns for o in orbits) / sum(o.returns for o in whole) < 0.85
    shuffled = section_of(*(parts[k] for k in np.random.default_rng(1).permutation(len(parts))))
    assert repr(bp.find_orbits(shuffled, periods=[1, 2])) == repr(orbits)


@pytest.mark.parametrize("method", ["chained", "boxes"])
def test_maps_in_pieces_have_the_known_cycles_in_any_order(method):
    """Known numbers of prime cycles of the Hénon map on its attractor: 1, 1, 0, 1, 0, 2 for periods 1 to 6."""
    points = map_section(henon, 20_000).points
    parts = [points[k : k + 25] for k in range(0, len(points), 26)]
    generator = np.random.default_rng(2)
    section = bp.PoincareSection.from_points(
        [parts[k] for k in generator.permutation(len(parts))], ("x", "y"), frequency=1.0
    )
    periods = range(1, 7) if method == "chained" else [1, 2]
    orbits = bp.find_orbits(section, periods=periods, method=method)
    known = [1, 1, 0, 1, 0, 2][: periods[-1]]
    assert [sum(o.period == p for o in orbits) for p in periods] == known
    for orbit in orbits:
        exact, values = map_orbit(henon, orbit.points)
        np.testing.assert_allclose(orbit.points, exact, atol=1e-8 if method == "chained" else 5e-3)
        np.testing.assert_allclose(orbit.eigenvalues[0], values[0], rtol=1e-6 if method == "chained" else 0.1)


def test_errors_of_pairs_in_different_stretches_are_independent():
    # Stretches of one pair each: their order is that of independent observations, which changes no covariance.
    points = map_section(coupled, 4000, 0.001).points
    pairs = np.stack([points[:-1:2], points[1::2]], axis=1)
    fixed, _ = map_orbit(coupled, bp.find_orbits(map_section(coupled, 4000, 0.001), periods=[1])[0].points)
    covariances = []
    for order in (np.arange(len(pairs)), np.random.default_rng(4).permutation(len(pairs))):
        both = pairs[order].reshape(-1, 2)
        increments = np.diff(both, axis=0)
        increments[1::2] = np.nan
        stretches = np.arange(len(both)) // 2
        maps = ReturnMap(both, increments, np.full(2, np.inf), True, np.full(2, 1e-3), stretches)
        covariances.append(refine(maps, fixed, 32).covariance)
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-6)


def test_returns_are_counted_within_stretches_only():
    # Pieces of five points: none returns after five, and those after four are one for each piece.
    points = map_section(coupled, 2000).points
    section = bp.PoincareSection.from_points([points[k : k + 9] for k in range(0, 1800, 9)], ("x", "y"), frequency=1.0)
    maps = find._scaled(section, 32)[0]
    assert maps.followed(9).size == 0
    np.testing.assert_array_equal(maps.followed(8), np.arange(0, 1800, 9))
    assert len(maps.arguments) == 1600
    np.testing.assert_allclose(
        maps.arguments + maps.increments, maps.points[np.flatnonzero(np.arange(1800) % 9 > 0)], atol=1e-12
    )
    with pytest.raises(ValueError, match="with 1800 points in 200 unbroken stretches, none above 8, got"):
        bp.find_orbits(section, periods=[1, 9])
    short = bp.PoincareSection.from_points([points[k : k + 5] for k in range(0, 1800, 5)], ("x", "y"), frequency=1.0)
    with pytest.raises(ValueError, match="100 points with 7 returns in their unbroken stretch, .* got 0"):
        bp.find_orbits(short, periods=[1])


def test_crossings_in_gaps_are_none():
    # x = sin(2π t) crosses 0.5 upwards at t = 1/12 + n. A gap hides three crossings, another none; in a third, the
    # signal is below the level before and above after, so that a line through it would cross.
    time = np.arange(20_000) / 50.3
    hidden = ((time > 100.5) & (time < 103.5)) | ((time > 200.3) & (time < 200.7)) | ((time > 300.05) & (time < 300.2))
    at = time[~hidden]
    outputs = {"x": np.sin(2 * np.pi * at), "u": np.cos(0.7 * at), "v": np.sin(0.7 * at)}
    section = bp.PoincareSection.from_crossings(bp.Recording(at, outputs, {}), ("u", "v"), channel="x", level=0.5)
    every = 1 / 12 + np.arange(int(time[-1]) + 1)
    every = every[every < time[-1]]
    seen = [t for t in every if not hidden[np.searchsorted(time, t) - 1]]
    assert len(seen) == len(every) - 4
    np.testing.assert_allclose(section.instants, seen, atol=2e-5)
    assert section.frequency == pytest.approx(1.0, rel=1e-6)
    broken = np.flatnonzero(np.isnan(section.increments[:, 0]))
    np.testing.assert_allclose(section.instants[broken], np.array([100, 200, 299]) + 1 / 12, atol=2e-5)


def test_a_cycle_across_a_break_raises():
    _, parts, _ = gapped(600)
    section = section_of(*parts)
    last = int(np.flatnonzero(np.diff(section.stretches))[0])
    assert section.cycle(last - 2, 2)["rate"].size == 128
    for index, period in ((last - 2, 3), (last, 1), (len(section) - 2, 2), (-1, 1)):
        with pytest.raises(ValueError, match="in one unbroken stretch"):
            section.cycle(index, period)


def test_sections_with_breaks_are_saved_and_older_files_are_read(tmp_path):
    _, parts, _ = gapped(600)
    section = section_of(*parts)
    section.save(tmp_path / "section.h5")
    again = bp.load(tmp_path / "section.h5")
    np.testing.assert_array_equal(again.stretches, section.stretches)
    np.testing.assert_array_equal(again.cycle(5, 2)["rate"], section.cycle(5, 2)["rate"])
    assert repr(again) == repr(section)
    # A file of an older version has none of the three fields.
    arrays = {}
    whole = section_of(chaos.recording(300, 40))
    stored = _io._encode(whole, arrays, [])
    for name in ("stretches", "starts", "left_out"):
        del stored["fields"][name]
    older = _io._decode(stored, arrays, None)
    assert older.stretches is None and repr(older) == repr(whole)
    np.testing.assert_array_equal(older.cycle(5, 2)["rate"], whole.cycle(5, 2)["rate"])


def test_invalid_sets_of_recordings_raise():
    recording, parts, _ = gapped(600)
    with pytest.raises(ValueError, match=r"recording: must be a Recording, got list; from_recordings takes several"):
        bp.PoincareSection.from_recording(parts, BOTH, **ANGLE)
    with pytest.raises(ValueError, match=r"recordings: must be a list of recordings, got Recording; from_recording"):
        bp.PoincareSection.from_recordings(recording, BOTH, **ANGLE)
    with pytest.raises(ValueError, match="recordings: must be one or more, got none"):
        section_of()
    with pytest.raises(ValueError, match=r"recordings\[1\]: must be a Recording, got str"):
        section_of(recording, "second")
    for other in (part(recording, 100, 200), part(recording, 0, 2)):
        with pytest.raises(ValueError, match=r"recordings: must not overlap in time, got .*Count the times"):
            section_of(recording, other)
    with pytest.raises(ValueError, match="coordinates: must be .*got 'rate'"):
        section_of(parts[0], bp.Recording(parts[1].time, {"angle": parts[1].outputs["angle"]}, {}))


@harvester.needed
def test_points_of_a_measured_recording_in_pieces_are_those_of_an_interpolation_within_each():
    """Cubic splines through all samples of a piece, an independent estimate without smoothing.

    The voltage's noise is 2e-6 V, that of the velocity 0.01 to 0.03 with dropouts in 1.3 % of the samples, so that nine
    of ten points are compared within 0.1.
    """
    kept = np.flatnonzero(np.arange(120) % 5 != 2)
    given = harvester.pieces()
    recordings = [given[k] for k in np.random.default_rng(0).permutation(kept)]
    # At this phase some points are beside the ends of pieces.
    section = bp.PoincareSection.from_recordings(recordings, ("velocity", "voltage"), frequency=6.5, origin=0.07)
    instants, expected = [], []
    for one in (given[k] for k in kept):
        whole = 0.07 + np.arange(4000) / 6.5
        inside = whole[(whole >= one.time[0]) & (whole <= one.time[-1])]
        instants.append(inside)
        expected.append(CubicSpline(one.time, np.stack([*one.outputs.values()], axis=1))(inside))
    np.testing.assert_allclose(section.instants, np.concatenate(instants))
    away = np.abs(section.points - np.concatenate(expected))
    assert away[:, 1].max() < 2e-5
    assert np.quantile(away[:, 0], 0.9) < 0.1
    assert len(np.unique(section.stretches)) == 25
    assert section.left_out == 26 * 24
