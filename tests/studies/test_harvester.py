import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from studies.__main__ import main
from studies.harvester import beam, recording

OMEGA = 2.0 * np.pi * recording.FREQUENCY


def test_times_of_all_channels_become_that_of_the_voltage():
    """Sines of which velocity and voltage are late, and the integral of the drive."""
    time = np.arange(16384) / 2048.0
    late = recording.Delays(0.004, 0.003)
    given = recording._recording(
        time,
        {
            "velocity": np.sin(OMEGA * (time - late.velocity)),
            "voltage": np.cos(OMEGA * (time - late.voltage)),
            "drive": 4.0 * np.cos(OMEGA * time),
        },
    )
    shifted = recording.aligned(given, late)
    at = shifted.time - late.voltage
    np.testing.assert_allclose(shifted.outputs["velocity"], np.sin(OMEGA * at), atol=1e-6)
    np.testing.assert_allclose(shifted.outputs["voltage"], np.cos(OMEGA * at), atol=1e-6)
    np.testing.assert_allclose(shifted.inputs["drive"], 4.0 * np.cos(OMEGA * at), atol=1e-5)
    middle = slice(at.size // 4, 3 * at.size // 4)
    np.testing.assert_allclose(shifted.inputs["base"][middle], 4.0 / OMEGA * np.sin(OMEGA * at)[middle], atol=2e-3)
    before, after = recording.divided([given], 0.25)
    assert before[0].time.size == 4096 and after[0].time[0] == time[4096]


def test_pieces_that_follow_each_other_are_one_recording(tmp_path):
    generator, numbers = np.random.default_rng(0), np.array([4, 1, 2])
    channels = {n: generator.standard_normal((3, 512)) for n in ("velocity", "voltage_V", "acceleration_g")}
    np.savez(tmp_path / "pieces.npz", number=numbers, interval_s=np.full(3, 1 / 2048), **channels)
    whole, about = recording.read(tmp_path / "pieces.npz")
    assert [one.time.size for one in whole] == [1024, 512] and about["pieces"] == 3
    np.testing.assert_array_equal(whole[0].outputs["velocity"], np.concatenate(channels["velocity"][1:]))
    assert whole[1].time[0] == pytest.approx(3 * 512 / 2048)
    np.testing.assert_allclose(whole[1].inputs["drive"], 9.80665 * channels["acceleration_g"][0])


def periodic_motion():
    """Return a stable motion of the beam with a small drive about one of its wells, by SciPy, at 64 phases."""
    v = beam.SYNTHETIC
    force = np.polynomial.Polynomial([0.0, *(v[f"f{k}"] for k in range(1, 8))])
    piezo = np.polynomial.Polynomial([v[f"s{k}"] for k in range(5)])

    def rates(t, z):
        drive = 2.0 * np.cos(OMEGA * t)
        spring = force(z[0]) - v["damping"] * z[1] - v["cubic_damping"] * z[1] ** 3
        return [z[1], spring - v["back"] * z[2] - v["drive_gain"] * drive, -v["decay"] * z[2] - piezo(z[0]) * z[1]]

    at = (300 + np.arange(64) / 64) / recording.FREQUENCY
    return solve_ivp(rates, (0.0, at[-1]), [0.16, 0.0, 0.0], "DOP853", at, rtol=1e-10, atol=1e-12).y


def waves(velocity, voltage, drive):
    """Return what the regression takes of an orbit with these channels at 64 phases a period."""
    period = velocity.size // 64
    run = SimpleNamespace(outputs={"velocity": velocity, "voltage": voltage}, inputs={"drive": drive})
    orbit = SimpleNamespace(period=period, frequency=recording.FREQUENCY, experiment=lambda **_: run)
    return beam._waves(orbit)


def test_regression_of_the_equations_gives_their_coefficients():
    """An exact motion about one well, of which a polynomial of degree three describes the force."""
    v, tau = beam.SYNTHETIC, np.arange(64) / 64
    motion = periodic_motion()
    drive = 2.0 * np.cos(2.0 * np.pi * tau)
    base = 2.0 / OMEGA * np.sin(2.0 * np.pi * tau)
    wave = waves(motion[1] + v["laser_gain"] * base, motion[2], drive)
    mean, gain = motion[0].mean(), v["laser_gain"]
    z = np.array([0.0, 1.0])
    _, piezo, residuals, _ = beam._equations(z, [wave], 3, 2, (1.0, gain))
    assert np.std(residuals[0]) < 1e-2 and np.std(residuals[1]) < 1e-2
    assert piezo[0] == pytest.approx(-v["decay"], rel=0.1)
    # The displacement is the integral of the velocity of the beam, without its mean.
    displacement, velocity, *_, given = wave.signals(gain, 0.0, 0.0)
    np.testing.assert_allclose(displacement, motion[0] - mean, atol=1e-6)
    np.testing.assert_allclose(velocity, motion[1], atol=1e-5)
    np.testing.assert_allclose(given, drive, atol=1e-9)


def test_delays_are_removed_and_derivatives_are_exact():
    """Two periods of sines, of which velocity and voltage are late."""
    time, late, later = np.arange(128) / (64 * recording.FREQUENCY), 0.01, 0.02
    drive, base = 2.0 * np.cos(OMEGA * time), 2.0 / OMEGA * np.sin(OMEGA * time)
    velocity = np.cos(0.5 * OMEGA * (time - late)) + 3.0 * base
    wave = waves(velocity, np.sin(1.5 * OMEGA * (time - later)), drive)
    x, v, acceleration, voltage, change, _ = wave.signals(3.0, late, later)
    # The velocity of the base is seen without delay, and its delay removed.
    early = 6.0 / OMEGA * (np.sin(OMEGA * (time + late)) - np.sin(OMEGA * time))
    np.testing.assert_allclose(v, np.cos(0.5 * OMEGA * time) + early, atol=1e-9)
    np.testing.assert_allclose(np.gradient(x, time)[1:-1], v[1:-1], atol=2e-2)
    steep = -0.5 * OMEGA * np.sin(0.5 * OMEGA * time) + 6.0 * (np.cos(OMEGA * (time + late)) - np.cos(OMEGA * time))
    np.testing.assert_allclose(acceleration, steep, atol=1e-7)
    np.testing.assert_allclose(voltage, np.sin(1.5 * OMEGA * time), atol=1e-9)
    np.testing.assert_allclose(change, 1.5 * OMEGA * np.cos(1.5 * OMEGA * time), atol=1e-7)


def test_model_is_that_of_the_equations():
    model = beam.model(7, 4)
    assert [*model.parameters] == beam.parameters(7, 4) == [*beam.SYNTHETIC]


@pytest.mark.slow
def test_study_runs_on_simulated_data(tmp_path, monkeypatch):
    """The quick study without the recording: orbits are found, and most parameters are near the truth."""
    monkeypatch.delenv("BAYESPERIODIC_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    assert main(["harvester", "--quick", "--out", str(tmp_path / "out")]) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text("utf-8"))
    assert results["recording"]["synthetic"] and len(results["orbits"]) >= 2
    assert results["delays"]["seconds"]["velocity"] == pytest.approx(0.0, abs=5e-4)
    assert results["estimates"]["drive_gain"][0] == pytest.approx(beam.SYNTHETIC["drive_gain"], rel=0.1)
    assert results["estimates"]["decay"][0] == pytest.approx(beam.SYNTHETIC["decay"], rel=0.15)
