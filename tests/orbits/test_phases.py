"""Orbits of sections at several phases against orbits by shooting with SciPy's integrators."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

import bayesperiodic as bp
from bayesperiodic.orbits.phases import _earlier, merged
from tests.orbits import test_waveform as wells
from tests.orbits.test_waveform import INDEPENDENT, PERIOD, double_well_orbits, true_orbit


@cache
def sections():
    """Return sections of the double well at four phases, with a delayed coordinate in place of the rate."""
    x, y, times = wells.clean_motions()
    generator, pieces = np.random.default_rng([0, 3]), []
    for k in range(wells.PIECES):
        signals = {"x": x[k], "y": y[k], "u": 0.3 * np.cos(wells.OMEGA * times)}
        noisy = {n: s + wells.NOISE[n] * generator.standard_normal(s.size) for n, s in signals.items()}
        time = times + k * (wells.PIECE + 1) * PERIOD
        pieces.append(bp.Recording(time, {"y": noisy["y"], "x": noisy["x"]}, {"u": noisy["u"]}))
    return [
        bp.PoincareSection.from_recordings(pieces, ("x", "y"), frequency=1.0 / PERIOD, origin=k / INDEPENDENT * PERIOD)
        for k in (0, 4, 8, 13)
    ]


@cache
def found():
    return bp.find_orbits(sections(), periods=[1, 2, 3], steps=2)


def test_every_orbit_is_returned_once_at_the_first_phase_with_errors_that_hold():
    """False alarms: 0.1 % of each joint statistic, of about 20 orbits."""
    orbits, truths = found(), []
    for orbit in orbits:
        truth = true_orbit(orbit)
        if truth is None or abs(orbit.eigenvalues[0]) > 100:
            continue
        wave = orbit.waveform
        error = np.stack([wave.values["x"], wave.values["y"]]) - truth
        every = truth.shape[1] // (INDEPENDENT * orbit.period)
        at = error[:, ::every].T.ravel()
        assert at @ np.linalg.solve(wave.covariance(("x", "y"), every), at) < chi2.ppf(0.999, at.size)
        each = truth.shape[1] // orbit.period
        away = (orbit.points - truth[:, ::each].T).ravel()
        assert away @ np.linalg.solve(orbit.covariance, away) < chi2.ppf(0.999, away.size)
        truths.append((orbit.period, truth))
    alone = [one for one in double_well_orbits(0, 2)[1] if abs(one.eigenvalues[0]) < 100]
    assert len(truths) >= len(alone)
    for k, (period, truth) in enumerate(truths):
        for other_period, other in truths[:k]:
            if period == other_period:
                each = truth.shape[1] // period
                shifts = [np.abs(np.roll(other, each * j, axis=1) - truth).max() for j in range(period)]
                assert min(shifts) > 0.01
    assert max(one.sections for one in orbits) == 4
    periods = [(one.period, abs(one.eigenvalues[0])) for one in orbits]
    assert periods == sorted(periods)
    assert len({one.name for one in orbits}) == len(orbits)


def test_errors_are_those_of_the_section_where_they_are_smallest():
    (late,) = (bp.find_orbits(sections()[1], periods=[1], steps=2, waveforms=True),)
    for orbit in found():
        if orbit.period == 1:
            here = np.mean([np.mean(sd**2) for sd in orbit.waveform.sd.values()])
            for other in late:
                turned = _earlier(other, 4)
                same = np.abs(turned.waveform.values["x"] - orbit.waveform.values["x"]).max() < 0.05
                if same:
                    assert here <= 1.001 * np.mean([np.mean(sd**2) for sd in other.waveform.sd.values()])


def test_orbits_that_differ_in_one_channel_are_not_merged_by_large_errors_of_another():
    """Two orbits, in one of which the errors of y are larger than its range."""
    one, other = [orbit for orbit in found() if orbit.period == 2][:2]

    def vague(orbit):
        errors = orbit.waveform.errors.copy()
        errors[:, list(orbit.waveform.values).index("y")] *= 1e5
        return replace(orbit, waveform=replace(orbit.waveform, errors=errors))

    assert np.mean(vague(other).waveform.sd["y"] ** 2) > np.ptp(one.waveform.values["y"]) ** 2
    assert [len(merged([[one], [vague(orbit)]], [0, 0])) for orbit in (one, other)] == [1, 2]


def test_mirror_images_are_half_a_period_later():
    """Signs of x and half a period changed at once leave the double well with its cosine as it is."""
    orbits, pairs = found(), 0
    for orbit in orbits:
        if orbit.partner is None:
            continue
        assert orbit.partner_delay == 0.5
        other = orbits[orbit.partner]
        here, there = orbit.waveform.values["x"], other.waveform.values["x"]
        each = here.size // orbit.period
        shifted = [np.abs(-np.roll(there, each // 2 + each * k) - here).max() for k in range(orbit.period)]
        assert min(shifted) < 0.1
        pairs += 1
    # All orbits of the period-1 class have one, or are their own.
    assert pairs >= 4


def test_an_angle_keeps_its_turns_at_an_earlier_phase():
    """An angle of two turns in three periods; the values are those of a straight line and a sine."""
    orbit = next(one for one in found() if one.period == 3)
    count = orbit.waveform.noise.shape[1]
    tau = 3.0 * np.arange(count) / count

    def line(t):
        return 2.0 * np.pi * 2.0 * t / 3.0 + 0.1 * np.sin(2.0 * np.pi * t)

    wave = replace(orbit.waveform, values={**orbit.waveform.values, "x": line(tau + 0.25)})
    turning = replace(orbit, angles=("x",), winding=2, waveform=wave)
    np.testing.assert_allclose(_earlier(turning, 4).waveform.values["x"], line(tau), atol=1e-12)


def test_delayed_points_are_values_of_the_waveform_between_its_phases():
    orbit = next(one for one in found() if one.period == 2)
    count = orbit.waveform.noise.shape[1]

    def course(t):
        return np.sin(np.pi * t) + 0.3 * np.cos(2.0 * np.pi * t)

    wave = replace(orbit.waveform, values={**orbit.waveform.values, "x": course(2.0 * np.arange(count) / count + 0.5)})
    delayed = replace(orbit, coordinates=("x", "x[-0.33]"), waveform=wave)
    tau = np.arange(2)
    expected = np.stack([course(tau), course(tau - 0.33)], axis=1)
    np.testing.assert_allclose(_earlier(delayed, 8).points, expected, atol=2e-5)


def test_sections_that_cannot_be_compared_are_refused():
    first = sections()[0]
    with pytest.raises(ValueError, match="section: must be at least one section"):
        bp.find_orbits([], periods=[1])
    with pytest.raises(ValueError, match="section: must be at least one section, for the method 'chained'"):
        bp.find_orbits([first], periods=[1], method="boxes")
    with pytest.raises(ValueError, match="section: must be a PoincareSection, got"):
        bp.find_orbits([first, "x"], periods=[1])
    with pytest.raises(ValueError, match=r"sections with the same coordinates .*, got \('x', 'y'\) and \('y', 'x'\)"):
        bp.find_orbits([first, replace(first, coordinates=("y", "x"))], periods=[1])
    moved = replace(first, instants=first.instants + 0.01 * PERIOD)
    with pytest.raises(ValueError, match="multiples of a sixteenth of the forcing period, got 0.01 of it"):
        bp.find_orbits([first, moved], periods=[1])
    points = bp.PoincareSection.from_points(first.points, ("x", "y"), frequency=1.0 / PERIOD)
    with pytest.raises(ValueError, match="got one of points. Use find_orbits for each"):
        bp.find_orbits([first, points], periods=[1])
    assert merged([[], []], [0, 4]) == []
