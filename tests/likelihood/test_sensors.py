"""Sensors of outputs and inputs, against closed forms of a linear oscillator and filters of SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter
from scipy.stats import binom

import bayesperiodic as bp
from bayesperiodic.likelihood.sensing import lowpass
from bayesperiodic.models.sensed import butterworth
from tests.known import grid
from tests.pendulum import PENDULUM
from tests.problems import (
    DUFFING_PRIORS,
    PENDULUM_PRIORS,
    POINTS,
    cycle_run,
    duffing,
    duffing_run,
    pendulum_problem,
    pendulum_run,
    section_run,
)

SAMPLES, FREQUENCIES, SD = 64, (0.1, 0.15, 0.2), 1e-3
TRUTH = {"m": 1.0, "c": 0.2, "k": 1.0}
PRIORS = {name: bp.LogNormal(value, 0.5) for name, value in TRUTH.items()}
OSCILLATOR = bp.Model(
    "oscillator",
    states=["x"],
    inputs=["force"],
    parameters={"m": "kg", "c": "N s/m", "k": "N/m"},
    equations=["m*ddx + c*dx + k*x - force"],
    outputs={"x": "x"},
    units={"x": "m", "force": "N"},
)
FORCE = sum(
    size * np.cos(2 * np.pi * h * grid(SAMPLES) + phase)
    for h, size, phase in ((1, 1.0, 0.0), (2, 0.3, 1.0), (3, 0.2, 2.0))
)
UNKNOWN = bp.Sensor(
    gain=bp.LogNormal(1.0, 0.1),
    offset=bp.Normal(0.0, 0.1),
    delay=bp.Normal(0.0, 0.1),
    cutoff=bp.LogNormal(1.0, 0.3),
    order=3,
)


def measured(signal, frequency, *, gain=1.0, offset=0.0, delay=0.0, cutoff=None, order=2):
    """Return a signal as a sensor shows it, its filter that of SciPy."""
    omega = 2 * np.pi * frequency * np.arange(signal.size // 2 + 1)
    response = gain * np.exp(-1j * omega * delay)
    if cutoff is not None:
        above, below = butter(order, 2 * np.pi * cutoff, analog=True)
        response = response * np.polyval(above, 1j * omega) / np.polyval(below, 1j * omega)
    return np.fft.irfft(np.fft.rfft(signal) * response, signal.size) + offset


def runs(seed=1, sd=SD, x=None, force=None):
    """Return responses of the oscillator in closed form, with noise, seen by sensors of output and input."""
    generator, experiments = np.random.default_rng(seed), []
    for frequency in FREQUENCIES:
        omega = 2 * np.pi * frequency * np.arange(SAMPLES // 2 + 1)
        response = 1.0 / (TRUTH["k"] - TRUTH["m"] * omega**2 + 1j * omega * TRUTH["c"])
        exact = np.fft.irfft(np.fft.rfft(FORCE) * response, SAMPLES)
        noise = sd * generator.standard_normal(SAMPLES)
        outputs = {"x": measured(exact, frequency, **(x or {})) + noise}
        inputs = {"force": measured(FORCE, frequency, **(force or {}))}
        experiments.append(bp.Experiment(f"{frequency:g} Hz", frequency, outputs, inputs, samples=SAMPLES))
    return experiments


def oscillator(experiments, **changes):
    return bp.Problem(OSCILLATOR, experiments, **({"priors": PRIORS, "scheme": "fourier"} | changes))


def estimated(problem):
    return bp.map_estimate(problem, progress=False, starts=1)


def scores(fit, truth):
    return {name: (fit.theta[name] - value) / fit.sd[name] for name, value in truth.items()}


@pytest.mark.parametrize("order", range(1, 11))
def test_the_filter_is_the_butterworth_filter_of_scipy(order):
    ratio = np.linspace(0.0, 4.0, 33)
    above, below = butter(order, 1.0, analog=True)
    expected = np.polyval(above, 1j * ratio) / np.polyval(below, 1j * ratio)
    np.testing.assert_allclose(lowpass(ratio, order).complex, expected, atol=1e-13)
    np.testing.assert_allclose(butterworth(order), below[::-1], rtol=1e-11)


def test_a_known_filter_gives_the_true_damping_and_an_ignored_one_does_not():
    seen = {"cutoff": 3.0, "order": 2}
    ignored = estimated(oscillator(runs(x=seen)))
    known = estimated(oscillator(runs(x=seen), sensors={"x": bp.Sensor(**seen)}))
    assert scores(ignored, {"c": 0.2})["c"] > 8.0
    assert abs(scores(known, {"c": 0.2})["c"]) < 4.0
    assert known.sd["c"] < 1e-4


@pytest.mark.parametrize(
    ("x", "force"),
    [
        ({"gain": 0.9, "offset": 0.1, "delay": 0.05, "cutoff": 2.0, "order": 4}, {}),
        ({}, {"gain": 1.3, "offset": 0.2, "delay": 0.03, "cutoff": 2.0, "order": 3}),
        ({"gain": 0.9, "delay": 0.05}, {"gain": 1.3, "delay": 0.03, "cutoff": 2.0}),
    ],
)
def test_known_sensors_of_outputs_and_inputs_are_corrected_exactly(x, force):
    given = {"x": bp.Sensor(**x), "force": bp.Sensor(**force)}
    problem = oscillator(runs(sd=0.0, x=x, force=force), sensors=given)
    solution = problem.solve(TRUTH)["0.15 Hz"]
    np.testing.assert_allclose(solution.inputs["force"], FORCE, atol=1e-12)
    outputs, _ = problem.outputs({name: [value] for name, value in TRUTH.items()})
    for e in problem.experiments:
        np.testing.assert_allclose(outputs[e.name]["x"][0], e.outputs["x"], atol=1e-11)


def test_unknown_sensors_of_inputs_are_parameters_of_the_model():
    seen = {"gain": 1.3, "offset": 0.2, "cutoff": 2.0}
    unknown = bp.Sensor(gain=bp.LogNormal(1, 0.5), offset=bp.Normal(0, 1), cutoff=bp.LogNormal(1, 1))
    problem = oscillator(runs(sd=0.0, force=seen), sensors={"force": unknown})
    theta = TRUTH | {f"{name}[force]": value for name, value in seen.items()}
    outputs, _ = problem.outputs({name: [value] for name, value in theta.items()})
    np.testing.assert_allclose(outputs["0.1 Hz"]["x"][0], problem.experiments[0].outputs["x"], atol=1e-11)
    solution = problem.solve(theta)["0.1 Hz"]
    np.testing.assert_allclose(solution.inputs["force"], FORCE, atol=1e-12)
    assert solution.parameters == TRUTH


def test_an_unknown_delay_is_found_beside_the_damping():
    late = runs(x={"delay": 0.05})
    of_output = estimated(oscillator(late, sensors={"x": bp.Sensor(delay=bp.Normal(0.0, 0.1))}))
    of_input = estimated(oscillator(late, sensors={"force": bp.Sensor(delay=bp.Normal(0.0, 0.1))}))
    assert max(map(abs, scores(of_output, TRUTH | {"delay[x]": 0.05}).values())) < 4.0
    np.testing.assert_allclose(of_input.theta["delay[force]"], -of_output.theta["delay[x]"], rtol=1e-6)


def test_the_delay_of_a_sensor_and_the_shift_of_all_outputs_are_one():
    (run, *_) = runs(x={"delay": 0.05})
    sensor = oscillator([run], sensors={"x": bp.Sensor(delay=bp.Normal(0.0, 0.1))})
    shift = oscillator([run], priors=PRIORS | {"shift": bp.Normal(0.0, 0.1)})
    both = oscillator([run], priors=PRIORS | {"shift": bp.Normal(0.0, 0.1)}, sensors={"x": bp.Sensor(delay=0.02)})
    point, variances = [1.0, 0.2, 1.0], {"x": 1e-6}
    expected = shift.log_likelihood([*point, 0.05], variances)
    np.testing.assert_allclose(sensor.log_likelihood([*point, 0.05], variances), expected, rtol=1e-12)
    np.testing.assert_allclose(both.log_likelihood([*point, 0.03], variances), expected, rtol=1e-10)


# Name -> problem and a point θ.
CASES = {
    "output": lambda: (
        duffing(duffing_run(), duffing_run("run 2", 0.13, seed=2), sensors={"displacement": UNKNOWN}),
        [0.21, 1.02, 0.48, 1.1, 0.02, 0.05, 0.8],
    ),
    "harmonics kept, local": lambda: (
        duffing(
            duffing_run(harmonics={"displacement": 7}),
            duffing_run("run 2", 0.13, seed=2, harmonics={"displacement": 7}),
            local=["gain[displacement]"],
            sensors={"displacement": UNKNOWN},
        ),
        [0.21, 1.02, 0.48, 1.1, 1.2, 0.02, 0.05, 0.8],
    ),
    "mask": lambda: (
        duffing(duffing_run(mask=POINTS), sensors={"displacement": UNKNOWN}),
        [0.21, 1.02, 0.48, 1.1, 0.02, 0.05, 0.8],
    ),
    "input": lambda: (
        duffing(duffing_run(), sensors={"force": replace(UNKNOWN, cutoff=bp.LogNormal(3.0, 0.3), order=2)}),
        [0.21, 1.02, 0.48, 1.1, 0.02, 3.0, 0.05],
    ),
    "known input, shift": lambda: (
        duffing(
            duffing_run(),
            priors=DUFFING_PRIORS | {"shift": bp.Normal(0.0, 0.1)},
            sensors={
                "force": bp.Sensor(gain=1.1, offset=0.02, delay=0.1, cutoff=2.0),
                "displacement": bp.Sensor(gain=bp.LogNormal(1.0, 0.1), cutoff=3.0),
            },
        ),
        [0.21, 1.02, 0.48, 1.1, 0.02],
    ),
    "section and multiplier": lambda: (
        pendulum_problem(
            [section_run()],
            fixed={n: v for n, v in PENDULUM.items() if n not in PENDULUM_PRIORS} | {"scale": 1.0},
            sensors=OF_PENDULUM,
        ),
        [0.31, 4.4e-4, 0.01, 0.002, 1.05, 90.0],
    ),
    "angle that winds": lambda: (
        pendulum_problem([pendulum_run()], sensors=OF_PENDULUM),
        [0.31, 4.4e-4, 0.01, 0.002, 1.05, 90.0],
    ),
    "autonomous": lambda: (
        bp.Problem(
            bp.models.van_der_pol,
            [cycle_run()],
            priors={"mu": bp.LogNormal(1.5, 0.3), "omega": bp.LogNormal(1.0, 0.1)},
            scheme="central4",
            sensors={"displacement": replace(UNKNOWN, cutoff=bp.LogNormal(0.5, 0.3), offset=0.0, order=2)},
        ),
        [1.45, 1.01, 1.1, 0.05, 0.5, 0.07],
    ),
}
OF_PENDULUM = {
    "angle": bp.Sensor(offset=bp.Normal(0.0, 0.1), delay=bp.Normal(0.0, 0.01)),
    "rate": bp.Sensor(gain=bp.LogNormal(1.0, 0.1), cutoff=bp.LogNormal(100.0, 0.3)),
}


@pytest.mark.parametrize("case", CASES)
def test_gradients_equal_differences_whatever_is_measured(case):
    problem, point = CASES[case]()
    theta = np.array(point)
    problem = problem.anchored(theta)
    noise = {name: 1e-4 for name in problem.free_noise}
    steps = 1e-6 * np.maximum(np.abs(theta), 1e-3)
    _, gradient = problem.value_and_gradient(theta, noise)
    forward = problem.gradient(theta, noise, method="forward")
    differences = []
    for step in np.diag(steps):
        down2, down, up, up2 = (float(problem.log_posterior(theta + k * step, noise)) for k in (-2, -1, 1, 2))
        differences.append((down2 - 8 * down + 8 * up - up2) / (12 * step.sum()))
    np.testing.assert_allclose(gradient[: theta.size], differences, rtol=2e-5, atol=1e-4)
    np.testing.assert_allclose(forward, gradient, rtol=1e-8, atol=1e-5)


@pytest.mark.parametrize("case", ["output", "input", "mask"])
def test_the_value_does_not_depend_on_the_other_points_of_a_batch(case):
    problem, point = CASES[case]()
    points = np.array(point) * (1.0 + 1e-4 * np.random.default_rng(0).standard_normal((9, len(point))))
    alone = [float(problem.log_likelihood(one, {"displacement": 1e-4})) for one in points]
    np.testing.assert_array_equal(problem.log_likelihood(points, {"displacement": 1e-4}), alone)


def test_noise_of_an_input_is_corrected_as_the_input_is():
    # The sensor halves the force; an error of the reading is then twice that of the force.
    plain = oscillator(runs(sd=0.01), input_noise={"force": 0.02})
    halved = [replace(e, inputs={"force": 0.5 * e.inputs["force"]}) for e in plain.experiments]
    known = oscillator(halved, input_noise={"force": 0.01}, sensors={"force": bp.Sensor(gain=0.5)})
    one, other = estimated(plain), estimated(known)
    np.testing.assert_allclose(list(other.theta.values()), list(one.theta.values()), rtol=1e-6)
    np.testing.assert_allclose(list(other.sd.values()), list(one.sd.values()), rtol=1e-5)
    for run in one.true_inputs.sd:
        np.testing.assert_allclose(other.true_inputs.sd[run]["force"], one.true_inputs.sd[run]["force"], rtol=1e-5)


def test_a_problem_says_which_parameters_delay_a_channel():
    late = bp.Sensor(delay=bp.Normal(0.0, 0.1))
    problem = oscillator(runs(), sensors={"x": late}, local=["delay[x]"])
    assert problem.delay_parameters("0.1 Hz") == {"x": ("delay[x, 0.1 Hz]",), "force": ()}
    both = oscillator(runs(), priors=PRIORS | {"shift": bp.Normal(0.0, 0.1)}, sensors={"force": late})
    assert both.delay_parameters("0.1 Hz") == {"x": ("shift[0.1 Hz]",), "force": ("delay[force]",)}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensors": [1]}, "sensors: must be a mapping"),
        ({"sensors": {"y": bp.Sensor()}}, "sensors: must be one of"),
        ({"sensors": {"x": 2.0}}, "must be a Sensor"),
        ({"sensors": {"force": bp.Sensor(cutoff=bp.LogNormal(1, 1), order=3)}}, "order must be at most 2"),
        ({"sensors": {"force": bp.Sensor(cutoff=0.05)}}, "the filter must pass at least 5%"),
        ({"sensors": {"0.1 Hz": bp.Sensor()}}, "sensors: must be one of"),
        ({"sensors": {"x": bp.Sensor(delay=0.1)}, "priors": PRIORS | {"gain[x]": bp.Normal(1, 1)}}, "gain"),
    ],
)
def test_impossible_sensors_are_refused_by_name(changes, words):
    with pytest.raises(ValueError, match=words):
        oscillator(runs(), **changes)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"gain": 0.0}, "gain: must not be 0"),
        ({"gain": "1"}, "gain: must be"),
        ({"delay": np.nan}, "delay: must be finite"),
        ({"delay": None}, "delay: must be a number or a prior"),
        ({"cutoff": -1.0}, "cutoff: must be > 0"),
        ({"cutoff": bp.Normal(1.0, 1.0)}, "cutoff: must be > 0"),
        ({"order": 0}, "order"),
        ({"order": 11}, "order: must be at most 10"),
    ],
)
def test_entries_that_make_no_sensor_are_refused_by_name(entries, words):
    with pytest.raises(ValueError, match=words):
        bp.Sensor(**entries)


def test_gain_and_filter_of_an_angle_are_refused():
    with pytest.raises(ValueError, match="must be without gain for an angle"):
        pendulum_problem([pendulum_run()], sensors={"angle": bp.Sensor(gain=1.1)})


def test_draws_and_results_have_the_parameters_of_sensors(tmp_path):
    unknown = bp.Sensor(gain=bp.LogNormal(1.0, 0.1), delay=bp.Normal(0.0, 0.1))
    problem = oscillator(
        runs(x={"gain": 0.9, "delay": 0.05}), priors=PRIORS | {"m": bp.LogNormal(1.0, 0.01)}, local=["delay[x]"],
        sensors={"x": unknown},
    )  # fmt: skip
    fit = estimated(problem)
    draws = bp.sample(problem, fit, seed=1, max_steps=100, progress=False)
    draws.save(tmp_path / "draws.nc")
    again = bp.load(tmp_path / "draws.nc")
    for name in ("gain[x]", "delay[x, 0.1 Hz]"):
        np.testing.assert_array_equal(again.draws(name), draws.draws(name))
        assert abs(draws.draws(name).mean() - fit.theta[name]) < fit.sd[name]
    assert "delay[x, 0.15 Hz]" in repr(fit)
    with pytest.raises(ValueError, match="sensors"):
        bp.predict(problem.replace(sensors={"x": replace(unknown, offset=1e-3)}), draws, draws=20)


def test_structure_knows_the_symmetries_of_gains_and_delays():
    gain, late = bp.Sensor(gain=bp.LogNormal(1.0, 0.1)), bp.Sensor(delay=bp.Normal(0.0, 0.1))
    of_force = bp.structure(OSCILLATOR, sensors={"force": gain})
    assert set(of_force.symmetries[0].parameters) == {"m", "c", "k", "gain[force]"}
    both = bp.structure(OSCILLATOR, sensors={"force": late, "x": late})
    assert both.combinations[0] in ("delay[force] - delay[x]", "delay[x] - delay[force]")
    assert bp.structure(OSCILLATOR, sensors={"x": late}).table.verdict["delay[x]"] == "determined"
    known = bp.structure(OSCILLATOR, sensors={"x": bp.Sensor(gain=2.0, delay=0.1)})
    assert list(known.table.index) == ["m", "c", "k"]


@pytest.mark.slow
def test_damping_and_delay_are_covered_as_often_as_stated():
    """Sixty data sets, 90 % intervals of c and of the delay; each count is outside of its band by chance in 1 %."""
    inside = {"c": 0, "delay[x]": 0}
    for seed in range(60):
        problem = oscillator(runs(seed, x={"delay": 0.05}), sensors={"x": bp.Sensor(delay=bp.Normal(0.0, 0.1))})
        fit = bp.map_estimate(problem, progress=False, starts=1, checks=False)
        interval = fit.interval(0.9)
        for name, truth in (("c", TRUTH["c"]), ("delay[x]", 0.05)):
            low, high = interval[name]
            inside[name] += bool(low < truth < high)
    low, high = binom.ppf([0.005, 0.995], 60, 0.9)
    assert all(low <= count <= high for count in inside.values()), inside
