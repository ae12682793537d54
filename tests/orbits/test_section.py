import numpy as np
import pytest

import bayesperiodic as bp
from tests.orbits import chaos

ANGLE = {"frequency": chaos.FREQUENCY, "angles": ("angle",)}
BOTH = ("angle", "rate")


def replaced(**channels):
    recording = chaos.recording(300, 40)
    return bp.Recording(recording.time, recording.outputs | channels, {})


def test_points_between_samples_agree_with_a_denser_recording():
    dense = chaos.recording(400, 160)
    thin = bp.Recording(dense.time[::4], {name: values[::4] for name, values in dense.outputs.items()}, {})
    origin = dense.time[3]
    section = bp.PoincareSection.from_recording(thin, BOTH, origin=origin, **ANGLE)
    expected = np.stack([dense.outputs["angle"][3::160], dense.outputs["rate"][3::160]], axis=1)
    away = section.points - expected[: len(section.points)]
    away[:, 0] -= 2 * np.pi * np.round(away[:, 0] / (2 * np.pi))
    assert np.abs(away / [6.28, 32.6]).max() < 2e-4
    np.testing.assert_allclose(section.increments, np.diff(expected, axis=0)[: len(section) - 1], atol=4e-3)


def test_points_are_exact_at_an_incommensurate_sampling_rate():
    # sin and cos of two incommensurate lines: known at every instant.
    time = np.arange(9000) / 23.7

    def signals(t):
        return np.stack([np.sin(2 * np.pi * t) + 0.5 * np.sin(5.1 * t), np.cos(1.3 * t)], axis=1)

    values = signals(time)
    section = bp.PoincareSection.from_recording(
        bp.Recording(time, {"x": values[:, 0], "y": values[:, 1]}, {}), ("x", "y"), frequency=1.0, origin=0.3
    )
    np.testing.assert_allclose(section.instants, 0.3 + np.arange(len(section)))
    np.testing.assert_allclose(section.points, signals(section.instants), atol=1e-5)


@pytest.mark.parametrize("samples", [40, 100])
def test_noise_of_dense_samples_is_averaged_without_bias(samples):
    # The stated sd is that of the errors within 8 %; their mean over any tenth of the rates is zero within four
    # standard errors, which independent ones exceed in one of 800 tests.
    section = bp.PoincareSection.from_recording(chaos.recording(3000, samples, 0.001), BOTH, **ANGLE)
    errors = section.points - chaos.path(3000, samples)[::samples]
    errors[:, 0] -= 2 * np.pi * np.round(errors[:, 0] / (2 * np.pi))
    single = 0.001 * np.array([6.28, 32.6])
    np.testing.assert_allclose(section.noise, errors.std(axis=0), rtol=0.08)
    assert np.all(section.noise < {40: 0.75, 100: 0.5}[samples] * single)
    for tenth in np.array_split(np.argsort(section.points[:, 1]), 10):
        assert np.all(np.abs(errors[tenth].mean(axis=0)) < 4.0 * errors.std(axis=0) / np.sqrt(len(tenth)))


def test_turns_are_counted_and_wrapped_angles_give_the_same():
    recording = chaos.recording(1000, 40)
    folded = recording.outputs["angle"] % (2 * np.pi)
    running = bp.PoincareSection.from_recording(recording, BOTH, **ANGLE)
    wrapped = bp.PoincareSection.from_recording(
        bp.Recording(recording.time, recording.outputs | {"angle": folded}, {}), BOTH, **ANGLE
    )
    np.testing.assert_allclose(wrapped.increments, running.increments, atol=1e-9)
    np.testing.assert_allclose(running.increments[:, 0], np.diff(chaos.path(1000, 40)[::40, 0]), atol=1e-4)
    assert np.all((running.points[:, 0] > -np.pi) & (running.points[:, 0] <= np.pi))
    assert running.winds
    assert not bp.PoincareSection.from_points(running.points, BOTH, **ANGLE).winds


def test_the_measured_cycle_connects_the_points():
    section = bp.PoincareSection.from_recording(chaos.recording(1000, 40), BOTH, **ANGLE)
    cycle = section.cycle(17, 3)
    assert cycle["angle"].shape == (192,)
    np.testing.assert_allclose([cycle["angle"][0], cycle["rate"][0]], section.points[17], atol=1e-3)
    run = section.points[17, 0] + np.cumsum(section.increments[17:19, 0])
    np.testing.assert_allclose(cycle["angle"][[64, 128]], run, atol=1e-4)
    assert np.abs(np.diff(cycle["angle"])).max() < 1.0


def test_crossings_are_at_the_known_instants():
    # x = sin(2π t) crosses 0.5 upwards at t = 1/12 + n, where the other two channels are known.
    time = np.arange(20000) / 50.3
    outputs = {"x": np.sin(2 * np.pi * time), "u": np.cos(0.7 * time), "v": np.sin(0.7 * time)}
    recording = bp.Recording(time, outputs, {})
    section = bp.PoincareSection.from_crossings(recording, ("u", "v"), channel="x", level=0.5)
    at = 1 / 12 + np.arange(len(section))
    np.testing.assert_allclose(section.instants, at, atol=2e-5)
    np.testing.assert_allclose(section.points, np.stack([np.cos(0.7 * at), np.sin(0.7 * at)], axis=1), atol=2e-5)
    assert section.frequency == pytest.approx(1.0, rel=1e-6)
    down = bp.PoincareSection.from_crossings(recording, ("u", "v"), channel="x", level=0.5, direction=-1)
    np.testing.assert_allclose(down.instants, 5 / 12 + np.arange(len(down)), atol=2e-5)


def test_a_section_is_saved_and_loaded(tmp_path):
    section = bp.PoincareSection.from_recording(chaos.recording(300, 40), BOTH, **ANGLE)
    section.save(tmp_path / "section.h5")
    again = bp.load(tmp_path / "section.h5")
    np.testing.assert_array_equal(again.points, section.points)
    np.testing.assert_array_equal(again.cycle(5, 2)["rate"], section.cycle(5, 2)["rate"])
    assert repr(again) == repr(section)


def degrees():
    return np.degrees(chaos.recording(300, 40).outputs["angle"])


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"angle": lambda: degrees() % 360.0}, "must be an angle in radians, got jumps of 35.*degrees"),
        ({"angle": degrees}, "Convert degrees with numpy.radians"),
        ({"angle": lambda: chaos.recording(300, 40).outputs["angle"] % np.pi}, "half a turn"),
        ({"rate": lambda: np.degrees(chaos.recording(300, 40).outputs["rate"])}, "the rate seems to be in degrees"),
    ],
)
def test_angles_in_other_units_raise(channels, message):
    recording = replaced(**{name: make() for name, make in channels.items()})
    with pytest.raises(ValueError, match=message):
        bp.PoincareSection.from_recording(recording, BOTH, **ANGLE)


def test_invalid_recordings_raise():
    recording = chaos.recording(300, 40)
    with pytest.raises(ValueError, match=r"coordinates: must be .*got 'rat'.*'rate'"):
        bp.PoincareSection.from_recording(recording, ("angle", "rat"), frequency=chaos.FREQUENCY)
    with pytest.raises(ValueError, match="angles: must be .*got 'phi'"):
        bp.PoincareSection.from_recording(recording, BOTH, frequency=chaos.FREQUENCY, angles=("phi",))
    with pytest.raises(ValueError, match="coordinates: must be two or more outputs"):
        bp.PoincareSection.from_recording(recording, ("angle",), **ANGLE)
    with pytest.raises(ValueError, match="section: must have at least 200 points, got 51"):
        bp.PoincareSection.from_recording(chaos.recording(50, 40), BOTH, **ANGLE)
    with pytest.raises(ValueError, match="samples a period, got 4.*from_points"):
        bp.PoincareSection.from_recording(chaos.recording(300, 4), BOTH, frequency=chaos.FREQUENCY)
    with pytest.raises(ValueError, match="frequency: must be .*got 0"):
        bp.PoincareSection.from_recording(recording, BOTH, frequency=0)
    with pytest.raises(ValueError, match=r"direction: must be 1 \(upwards\) or -1 \(downwards\), got 2"):
        clocked = bp.Recording(recording.time, recording.outputs | {"clock": recording.time}, {})
        bp.PoincareSection.from_crossings(clocked, BOTH, channel="clock", direction=2)


def test_invalid_points_raise():
    points = chaos.points(300)
    with pytest.raises(ValueError, match="shape"):
        bp.PoincareSection.from_points(points.T, BOTH, **ANGLE)
    with pytest.raises(ValueError, match=r"points\[:, 1\] \(rate\): must be finite, got nan at index 3"):
        bp.PoincareSection.from_points(np.where(np.arange(301)[:, None] == [[-1, 3]], np.nan, points), BOTH, **ANGLE)
    with pytest.raises(ValueError, match="must be an angle in radians, got a range of 3.*degrees"):
        bp.PoincareSection.from_points(points * [180 / np.pi, 1.0], BOTH, **ANGLE)
    with pytest.raises(ValueError, match="must have at least 200 points, got 51"):
        bp.PoincareSection.from_points(points[:51], BOTH, **ANGLE)


def test_a_periodic_recording_raises():
    time = np.arange(20000) / 50
    outputs = {"x": np.sin(2 * np.pi * time), "y": np.cos(2 * np.pi * time)}
    with pytest.raises(ValueError, match="must be chaotic, got a motion of period 1"):
        bp.PoincareSection.from_recording(bp.Recording(time, outputs, {}), ("x", "y"), frequency=1.0)
