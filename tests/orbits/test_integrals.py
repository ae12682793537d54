"""Integrals of channels as coordinates of sections, against the motion that was simulated by other integrators."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom

import bayesperiodic as bp
from tests.orbits import wells

PERIODS, FREQUENCY = 1040, 1.0 / wells.PERIOD
NOISE = (1e-4, 1e-4, 1e-5)
NAMES = ("v", "v[-0.4]", "integral(y)")


def pieces(length=26, added=None):
    """Return recordings with gaps; `added` is a function of time and the number of the piece, in the velocity."""
    result = []
    for number, whole in enumerate(wells.recordings(PERIODS, NOISE, length)):
        part = whole.between(whole.time[0] + 0.05, whole.time[-1] - 0.2)
        outputs = dict(part.outputs)
        if added is not None:
            outputs["y"] = outputs["y"] + added(part.time, number)
        result.append(bp.Recording(part.time, outputs, {}, synthetic=True))
    return result


def section_of(recordings, names=NAMES):
    return bp.PoincareSection.from_recordings(recordings, names, frequency=FREQUENCY)


def errors_of(section):
    """Return the errors of the integral of the velocity, but for the constant of all, from the displacement."""
    true = wells.motion(PERIODS)[:: wells.SAMPLES, 0][np.round(section.instants * FREQUENCY).astype(int)]
    away = section.points[:, section.coordinates.index("integral(y)")] - true
    return away - away.mean()


def stated(section):
    return section.noise[section.coordinates.index("integral(y)")]


def sd_of(orbit):
    return np.sqrt(np.diag(orbit.covariance)).reshape(orbit.points.shape)


def test_the_integral_of_the_velocity_is_the_displacement_within_the_stated_error():
    """40 pieces with an offset each; the ratio of error to its estimate, from 39 constants, is in 0.6 to 1.5."""
    offsets = 0.05 * np.random.default_rng(1).standard_normal(40)
    section = section_of(pieces(added=lambda time, number: offsets[number]))
    away = errors_of(section)
    assert np.std(away) < 4e-4 * np.ptp(section.points[:, 2])
    assert 0.6 < np.std(away) / stated(section) < 1.5
    assert section.drifts == {"integral(y)": pytest.approx(stated(section), rel=1e-2)}


def test_a_double_well_of_two_states_by_scipy():
    """Velocity alone is measured; ten pieces of one long motion by SciPy's Runge-Kutta method of order eight."""
    omega, samples, length, count = 1.2, 64, 26, 10
    time = np.arange((30 + count * length) * samples) * 2.0 * np.pi / omega / samples

    def rates(t, z):
        return [z[1], z[0] - z[0] ** 3 - 0.3 * z[1] + 0.5 * np.cos(omega * t)]

    motion = solve_ivp(rates, (0.0, time[-1]), [0.1, 0.0], "DOP853", time, rtol=1e-9, atol=1e-9).y
    velocity = motion[1] + 1e-3 * np.random.default_rng(2).standard_normal(time.size) + 0.02
    spans = [slice((30 + k * length) * samples, (30 + (k + 1) * length) * samples - 5) for k in range(count)]
    recordings = [bp.Recording(time[span], {"velocity": velocity[span]}, {}) for span in spans]
    section = bp.PoincareSection.from_recordings(
        recordings, ("velocity", "integral(velocity)"), frequency=omega / (2.0 * np.pi)
    )
    true = np.interp(section.instants, time, motion[0])
    away = section.points[:, 1] - true
    assert np.ptp(motion[0]) > 2.5  # between both wells
    assert 0.4 < np.std(away) / section.noise[1] < 1.6
    assert np.std(away) < 5e-3 * np.ptp(true)


@pytest.mark.parametrize(("amplitude", "periods"), [(5e-4, 40.0), (5e-4, 15.0), (5e-3, 15.0)])
def test_drift_of_the_channel_is_part_of_the_stated_error(amplitude, periods):
    section = section_of(pieces(added=lambda t, _: amplitude * np.sin(2.0 * np.pi * FREQUENCY * t / periods)))
    away = np.std(errors_of(section))
    assert away > 10.0 * np.std(errors_of(section_of(pieces())))
    assert 0.7 < away / stated(section) < 1.4


def test_spikes_are_not_integrated():
    """Three of a size at which each one would shift what follows by several stated errors."""

    def spikes(time, number):
        values = np.zeros(time.size)
        values[np.random.default_rng([3, number]).integers(50, time.size - 50, 3)] = 0.1
        return values

    clean, spiky = section_of(pieces()), section_of(pieces(added=spikes))
    assert np.std(errors_of(spiky)) < 1.5 * np.std(errors_of(clean))
    assert np.abs(errors_of(spiky)).max() < 0.5 * 0.1 * wells.PERIOD / wells.SAMPLES


def test_a_delayed_integral_is_the_displacement_at_that_time_and_gaps_are_left_out():
    names = ("v", "integral(y)[-0.25]", "integral(y)")
    section = section_of(pieces(), names)
    late = np.round((section.instants * FREQUENCY - 0.25) * wells.SAMPLES).astype(int)
    away = section.points[:, 1] - wells.motion(PERIODS)[late, 0]
    assert np.std(away) < 1e-3 * np.ptp(section.points[:, 1])
    assert 0.5 < np.std(away) / section.noise[1] < 1.6
    # A window of one period, and the delay, in every piece of 26 periods less a little.
    assert len(section) == 40 * 25 and np.all(np.isnan(section.increments[24::25]))
    assert section.left_out == 39


def test_orbits_are_those_of_the_flow_and_experiments_leave_integrals_out(tmp_path):
    """Nine tenths of those of periods 1 and 2 with five close returns.

    The 90 % bars of v and its delay contain the true values; false-alarm rate 0.5 %, as if independent.
    """
    section = section_of(pieces())
    orbits = bp.find_orbits(section, periods=[1, 2], steps=3, waveforms=True)
    known = [one for one, returns in wells.known_orbits(PERIODS, 2) if returns >= 5]
    size, inside, count, matched = np.ptp(section.points, axis=0)[:2], 0, 0, 0
    for one in known:
        true = wells.coordinates_of(one, [("v", 0.0), ("v", -0.4)])
        nearest = min(
            (
                (np.abs(away / size).max(), np.abs(away) < 1.645 * sd_of(orbit)[:, :2])
                for orbit in orbits
                if orbit.period == len(true)
                for away in (np.roll(orbit.points[:, :2], k, axis=0) - true for k in range(orbit.period))
            ),
            key=lambda pair: pair[0],
            default=(np.inf, None),
        )
        if nearest[0] < 0.02:
            matched, inside, count = matched + 1, inside + int(nearest[1].sum()), count + nearest[1].size
    assert len(known) >= 4 and matched >= 0.9 * len(known)
    assert inside >= binom.ppf(0.005, count, 0.9)
    waveform = orbits[0].waveform
    assert "integral(y)" in waveform.values and "integral(y)" not in waveform.outputs
    assert set(orbits[0].experiment(whole=True).outputs) == {"x", "y", "v"}
    assert set(orbits[0].experiment(states={"x": "x", "v": "v"}).outputs) == {"v"}
    section.save(tmp_path / "section.h5")
    assert bp.load(tmp_path / "section.h5").drifts == section.drifts


def test_integrals_that_are_refused():
    short = [whole.between(whole.time[0], whole.time[0] + 9.0 * wells.PERIOD) for whole in pieces()]
    with pytest.raises(ValueError, match="recordings: must have 10 forcing periods or more without a break"):
        section_of(short)
    with pytest.raises(ValueError, match="coordinates: must be one of .*, got 'force'"):
        section_of(pieces(), ("v", "integral(force)"))
    with pytest.raises(ValueError, match="coordinates: must determine the drift of 'integral.y.', got errors of"):
        section_of(pieces(added=lambda t, _: 0.05 * np.sin(2.0 * np.pi * FREQUENCY * t / 15.0)))
    with pytest.raises(ValueError, match="section: must show a return map.*add one: .*'v\\[-0.25\\]'"):
        bp.find_orbits(section_of(pieces(), ("v", "integral(v)")), periods=[1])
    with pytest.raises(ValueError, match="coordinates: must have no integrals for crossings"):
        bp.PoincareSection.from_crossings(pieces(), ["integral(y)", "v"], channel="x")
    with pytest.raises(ValueError, match="coordinates: must have no integral of an angle"):
        bp.PoincareSection.from_recordings(pieces(), ("x", "integral(x)"), frequency=FREQUENCY, angles=["x"])
