import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom

import bayesperiodic as bp
from studies import common, shooting
from studies.__main__ import main
from studies.harvester import beam, multiple_shooting, recording, synthetic
from studies.harvester.run import Chosen, alone_of, simplest

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


def test_the_frequency_of_the_drive_is_that_of_the_recording():
    """Another one than that of the study's own recording, with noise and a third harmonic."""
    time, generator = np.arange(60_000) / 2048.0, np.random.default_rng(3)
    angle = 2.0 * np.pi * 7.2345 * time
    drive = 4.0 * np.cos(angle) + 0.5 * np.cos(3.0 * angle) + 0.02 * generator.standard_normal(time.size)
    channels = {"velocity": np.sin(0.37 * time), "voltage": np.cos(0.9 * time), "drive": drive}
    short = recording._recording(time[:4000] + 40.0, {name: values[:4000] for name, values in channels.items()})
    assert recording.frequency_of([short, recording._recording(time, channels)]) == pytest.approx(7.2345, abs=2e-5)


def test_data_may_be_a_folder_with_the_file(tmp_path):
    (tmp_path / "harvester").mkdir()
    file = tmp_path / recording.RELATIVE
    with pytest.raises(FileNotFoundError, match="--data: must be an existing file, got '.*harvester_pieces.npz'"):
        common.find_data(tmp_path, recording.RELATIVE)
    file.touch()
    assert common.find_data(tmp_path, recording.RELATIVE) == (file, str(file))
    assert common.find_data(tmp_path / "harvester", recording.RELATIVE) == (file, str(file))


def rates_of_the_beam(z, drive):
    v = beam.SYNTHETIC
    force = np.polynomial.Polynomial([0.0, *(v[f"f{k}"] for k in range(1, 8))])
    piezo = np.polynomial.Polynomial([v[f"s{k}"] for k in range(5)])
    spring = force(z[0]) - v["damping"] * z[1] - v["cubic_damping"] * z[1] ** 3
    return [z[1], spring - v["back"] * z[2] - v["drive_gain"] * drive, -v["decay"] * z[2] - piezo(z[0]) * z[1]]


def periodic_motion():
    """Return a stable motion of the beam with a small drive about one of its wells, by SciPy, at 64 phases."""

    def rates(t, z):
        return rates_of_the_beam(z, 2.0 * np.cos(OMEGA * t))

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


def test_regression_has_the_derivatives_of_its_residuals():
    """Two motions about the wells: the gradient, exact in Kaufman's approximation, by central differences."""
    motion, tau = periodic_motion(), np.arange(64) / 64
    drive = 2.0 * np.cos(2.0 * np.pi * tau)
    each = [waves(scale * motion[1], motion[2] + 0.01 * motion[1] ** 2, drive) for scale in (1.0, -0.8)]
    z, given = np.array([0.3, -0.2, 1.1, 2.0, -1.0]), (each, 3, 2, (0.1, 5.0))
    costs = [
        [0.5 * np.sum(beam._residuals(z + step, *given) ** 2) for step in (1e-5 * one, -1e-5 * one)]
        for one in np.eye(5)
    ]
    gradient = beam._jacobian(z, *given).T @ beam._residuals(z, *given)
    expected = np.subtract(*np.transpose(costs)) / 2e-5
    np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.abs(expected).max())


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


def test_sensitivities_of_segments_are_those_of_scipy_and_of_differences():
    """Two segments of random starts: states by DOP853, derivatives by central differences of the integrator."""
    p, generator = beam.SYNTHETIC, np.random.default_rng(2)
    starts = np.column_stack([generator.uniform(-0.2, 0.2, 2), generator.uniform(-3.0, 3.0, 2), [0.1, -0.1]])
    step = 1.0 / (recording.FREQUENCY * multiple_shooting.STEPS)
    half = 0.5 * step * np.arange(2 * multiple_shooting.STEPS + 1)
    drive = np.stack([3.0 * np.cos(OMEGA * half), 4.0 * np.sin(OMEGA * half)])
    given = multiple_shooting.Segments(step, drive, *np.zeros((3, 2, 41)))
    columns = 3 + len(multiple_shooting.NAMES)
    path = multiple_shooting.run_of(p, given, starts, columns)
    for k, (size, course) in enumerate(((3.0, np.cos), (4.0, np.sin))):
        exact = solve_ivp(
            lambda t, z, size=size, course=course: rates_of_the_beam(z, size * course(OMEGA * t)),
            (0.0, half[-1]), starts[k], "DOP853", half[:: 2 * multiple_shooting.EVERY], rtol=1e-10, atol=1e-12,
        ).y.T  # fmt: skip
        np.testing.assert_allclose(path[k, :, :, 0], exact, atol=2e-4 * np.abs(exact).max(axis=0).max())
    changes = [(f"z{k}", 1e-5) for k in range(3)] + [(n, 1e-5 * abs(p[n])) for n in multiple_shooting.NAMES]
    for k, (name, change) in enumerate(changes):
        ends = []
        for sign in (1.0, -1.0):
            moved = starts + sign * change * (np.arange(3) == k)
            values = p | ({name: p[name] + sign * change} if k > 2 else {})
            ends.append(multiple_shooting.run_of(values, given, moved, 0)[..., 0])
        slopes = (ends[0] - ends[1]) / (2.0 * change)
        np.testing.assert_allclose(path[..., 1 + k], slopes, atol=1e-4 * np.abs(slopes).max(), err_msg=name)


def test_multiple_shooting_returns_the_parameters_of_exact_segments():
    """Segments of the model without noise, from parameters two standard steps off."""
    p, generator = beam.SYNTHETIC, np.random.default_rng(3)
    truth = {name: p[name] for name in beam.parameters(7, 4)}
    step = 1.0 / (recording.FREQUENCY * multiple_shooting.STEPS)
    half = 0.5 * step * np.arange(2 * multiple_shooting.STEPS + 1)
    starts = np.column_stack([generator.uniform(-0.2, 0.2, 60), generator.uniform(-3.0, 3.0, 60), np.zeros(60)])
    drive = 4.6 * np.cos(OMEGA * half + generator.uniform(0.0, 6.28, 60)[:, None])
    base = np.sin(OMEGA * half[::4])[None] * generator.uniform(0.05, 0.15, 60)[:, None]
    empty = multiple_shooting.Segments(step, drive, base, base, base)
    path = multiple_shooting.run_of(truth, empty, starts, 0)[..., 0]
    given = empty._replace(velocity=path[:, :, 1] + truth["laser_gain"] * base, voltage=path[:, :, 2])
    scale = {name: 0.01 * abs(value) + 1e-3 for name, value in truth.items()}
    first = {name: value + 2.0 * scale[name] * (-1.0) ** k for k, (name, value) in enumerate(truth.items())}
    shot = multiple_shooting.estimate(given, first, scale, 0.2)
    assert shot.segments == 60 and max(shot.unexplained.values()) < 1e-5
    for name in ("f1", "f3", "s0", "drive_gain", "decay", "laser_gain"):
        assert shot.theta[name] == pytest.approx(truth[name], rel=2e-3), name


def test_orbits_of_the_flow_close_and_have_the_contraction_of_the_flow():
    """A guess near an orbit of period two; the product of the multipliers is exp(∫ divergence), by Liouville."""
    guess = synthetic.states_of(400, recording.FREQUENCY, 0)[1]
    away = np.abs((guess[2:] - guess[:-2]) / np.ptp(guess, axis=0)).max(axis=1)
    first = int(np.argmin(away))
    orbit = shooting.closed(synthetic.flow, np.arange(3.0), guess[first : first + 2], np.zeros(3), accuracy=1e-9)
    v = synthetic.TRUTH
    force = v["drive_gain"] * synthetic.AMPLITUDE

    def rates(t, z):
        spring = v["f1"] * z[0] - v["f3"] * z[0] ** 3
        return [
            z[1],
            spring - v["damping"] * z[1] - v["back"] * z[2] - force * np.cos(OMEGA * t),
            v["coupling"] * z[1] - v["decay"] * z[2],
        ]

    at = np.array([0.0, 1.0, 1.3, 2.0]) / recording.FREQUENCY
    path = solve_ivp(rates, (0.0, at[-1]), orbit.states[0], "DOP853", at, rtol=1e-11, atol=1e-13).y
    np.testing.assert_allclose(path[:, -1], orbit.states[0], atol=1e-6)
    np.testing.assert_allclose(path[:, 1], orbit.states[1], atol=1e-7)
    divergence = -(v["damping"] + v["decay"]) * at[-1]
    assert np.prod(orbit.multipliers).real == pytest.approx(np.exp(divergence), rel=1e-6)
    known = synthetic.TrueOrbit(orbit.states, orbit.multipliers)
    np.testing.assert_allclose(synthetic.states_at(known, np.array([1.3]))[0], path[:, 2], atol=1e-4)
    states = np.tile(orbit.states, (3, 1))[None]
    assert synthetic.close_returns(known, states, np.ones(3)) >= 4
    assert synthetic.close_returns(known, states + 0.2, np.full(3, 0.5)) == 0


def test_an_orbit_of_another_system_is_predicted_badly_by_the_others():
    """Linear oscillators: three of one stiffness, one of 1.5 times that, by closed forms."""
    model = bp.Model(
        "linear", states=["x"], inputs=["F"], parameters=["c", "k"], equations=["ddx + c*dx + k*x - F"],
        outputs={"x": "x"},
    )  # fmt: skip
    phase, generator = 2.0 * np.pi * np.arange(32) / 32, np.random.default_rng(2)
    runs = []
    for name, f, k in (("a", 0.2, 4.0), ("b", 0.3, 4.0), ("c", 0.4, 4.0), ("other", 0.25, 6.0)):
        w = 2.0 * np.pi * f
        x = (np.exp(1j * phase) / (k - w**2 + 0.3j * w)).real + 1e-3 * generator.standard_normal(32)
        runs.append(bp.Experiment(name, f, {"x": x}, {"F": np.cos(phase)}, samples=32))
    priors = {"c": bp.LogNormal(0.3, 0.5), "k": bp.LogNormal(4.0, 0.5)}
    problem = bp.Problem(model, runs, priors=priors)
    fit = bp.map_estimate(problem, checks=False, progress=False)
    shares = alone_of(bp.OrbitsEstimate(problem, fit, {}))
    w = 2.0 * np.pi * 0.25
    expected = abs(1.0 - (6.0 - w**2 + 0.3j * w) / (4.0 - w**2 + 0.3j * w)) ** 2
    assert shares["other"]["x"] == pytest.approx(expected, rel=0.05)
    alike = bp.OrbitsEstimate(problem.with_experiments(runs[:3]), fit, {})
    assert max(share["x"] for share in alone_of(alike).values()) < 1e-3


@pytest.mark.parametrize(
    ("shares", "degree"),
    [
        ([[0.30, 0.20, 0.25], [0.021, 0.010, 0.031], [0.020, 0.011, 0.030]], 5),
        ([[0.30, 0.20, 0.25], [0.030, 0.020, 0.041], [0.020, 0.011, 0.030]], 7),
        ([[0.02, 0.01, 0.03], [0.020, 0.010, 0.031], [0.025, 0.016, 0.035]], 3),
    ],
)
def test_the_lowest_degree_is_taken_that_predicts_as_well_as_the_best(shares, degree):
    tried = [
        Chosen(d, None, {f"orbit {k}": {"v": s, "u": s} for k, s in enumerate(row)}, None)
        for d, row in zip((3, 5, 7), shares, strict=True)
    ]
    assert simplest(tried).degree == degree


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


@pytest.mark.slow
def test_orbits_of_a_simulated_recording_are_found_with_error_bars_that_cover(tmp_path):
    """Periods 1 and 2 in 120 pieces, all found. False alarms with independent normal errors: 0.1 % and 0.04 %."""
    assert main(["harvester", "--part", "orbits", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "orbits" / "results.json").read_text("utf-8"))["integrated"]
    (orbits,) = (one["orbits"] for one in results["recordings"])
    assert len(orbits) >= 6 and results["found"] == results["of"] == len(orbits)
    assert all(abs(one["estimate"] - one["multiplier"]) < 4.0 * one["estimate_sd"] for one in orbits)
    count = results["covered"]
    assert count["count"] >= binom.ppf(1e-3, count["of"], 0.9)


@pytest.mark.slow
def test_parameters_of_simulated_recordings_are_found(tmp_path):
    """Two recordings, orbits of periods 1 and 2; all parameters within five robust sd: false alarms below 0.01 %."""
    assert main(["harvester", "--part", "parameters", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "parameters" / "results.json").read_text("utf-8"))
    assert results["estimated"] == len(results["recordings"]) == 2
    for one in results["recordings"]:
        assert all(abs(away) < 5.0 for away in one["in_sd"].values())
        assert all(sd < 0.01 * results["truth"][name] for name, sd in one["robust_sd"].items())


def test_multiple_shooting_needs_the_results_of_the_study(tmp_path, capsys):
    assert main(["harvester", "--part", "shooting", "--out", str(tmp_path)]) == 1
    assert "Run it without --part first" in capsys.readouterr().err
