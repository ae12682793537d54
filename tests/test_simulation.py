import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from studies import shooting
from tests.known import grid
from tests.shooting import trajectory

OSCILLATOR = {"m": 1.3, "c": 0.4, "k": 20.0, "k3": 0.0}


def test_free_decay_has_its_closed_form():
    run = bp.simulate(
        bp.models.duffing,
        OSCILLATOR,
        {"force": np.zeros(8)},
        frequency=1.0,
        duration=6.0,
        sampling_rate=37.0,
        start={"x": 0.2, "dx": -0.1},
    )
    decay = 0.4 / 2.6
    omega = np.sqrt(20.0 / 1.3 - decay**2)
    t = run.time
    exact = np.exp(-decay * t) * (0.2 * np.cos(omega * t) + (-0.1 + decay * 0.2) / omega * np.sin(omega * t))
    assert run.outputs["displacement"] == pytest.approx(exact, abs=1e-9)
    assert run.synthetic


@pytest.mark.parametrize("kind", ["array", "function"])
def test_input_derivatives_reach_the_outputs(kind):
    model = bp.Model(
        "direct",
        states=["w"],
        inputs=["x"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dw + p.a * s.w - u.x],
        outputs=lambda s, p, u: {"same": u.x, "rate": u.dx, "acceleration": u.ddx},
    )
    f = 3.0
    signal = np.sin(2 * np.pi * grid(16)) if kind == "array" else (lambda t: np.sin(2 * np.pi * f * t))
    run = bp.simulate(model, {"a": 1.0}, {"x": signal}, frequency=f, duration=1.0, sampling_rate=101.0)
    angle, omega = 2 * np.pi * f * run.time, 2 * np.pi * f
    assert run.outputs["same"] == pytest.approx(np.sin(angle), abs=1e-12)
    assert run.outputs["rate"] == pytest.approx(omega * np.cos(angle), abs=1e-8 * omega)
    assert run.outputs["acceleration"] == pytest.approx(-(omega**2) * np.sin(angle), abs=1e-7 * omega**2)


def test_coupled_highest_derivatives_are_solved_for():
    model = bp.Model(
        "masses",
        states=["x", "y"],
        inputs=["u"],
        parameters=["b"],
        equations=lambda s, p, u: [2 * s.ddx + p.b * s.ddy + s.x - u.u, p.b * s.ddx + s.ddy + 3 * s.y],
        outputs=lambda s, p, u: {"balance": 2 * s.ddx + p.b * s.ddy + s.x - u.u},
    )
    run = bp.simulate(
        model, {"b": 0.7}, {"u": np.cos(2 * np.pi * grid(8))}, frequency=0.3, duration=9.0, sampling_rate=11.0
    )
    assert run.outputs["balance"] == pytest.approx(np.zeros(run.time.size), abs=1e-12)


def test_periodic_solver_and_time_integration_agree_on_the_steady_state():
    """Duffing, 60 cycles after rest, against the periodic solver at its own Richardson-extrapolated accuracy."""
    parameters = {"m": 1.0, "c": 1.5, "k": 30.0, "k3": 200.0}
    force = 4.0 * np.cos(2 * np.pi * grid(64))
    run = bp.simulate(
        bp.models.duffing, parameters, {"force": force}, frequency=1.0, duration=41.0, sampling_rate=100.0
    )
    last = run.outputs["displacement"][4000:4100]
    coarse, fine = (
        bp.solve_periodic(
            bp.models.duffing, parameters, {"force": 4.0 * np.cos(2 * np.pi * grid(n))}, frequency=1.0, samples=n
        ).states["x"][:: n // 100]
        for n in (800, 1600)
    )
    assert last == pytest.approx(fine + (fine - coarse) / 3, abs=1e-8)


@pytest.mark.parametrize("rate", [7.3, 90.0], ids=["seldom", "often"])
def test_driven_pendulum_agrees_with_another_integrator(rate):
    """Six forcing periods with turns over the top; the reference takes SciPy's steps at tolerances of 1e-13."""
    omega, start = 9.09, [1.0, 0.3]
    slope, _, period = shooting.pendulum(omega)
    parameters = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
    run = bp.simulate(
        bp.models.pendulum,
        parameters,
        frequency=1.0 / period,
        duration=6 * period,
        sampling_rate=rate / period,
        start={"phi": start[0], "dphi": start[1]},
    )
    exact = trajectory(slope, np.array([0.0, 6 * period]), np.array([start]), run.time)
    assert np.ptp(exact[:, 0]) > 2 * np.pi
    assert run.outputs["angle"] == pytest.approx(exact[:, 0], abs=1e-6)
    assert run.outputs["rate"] == pytest.approx(exact[:, 1], abs=1e-5)


@pytest.mark.parametrize("drive", [np.sin(2 * np.pi * grid(16)) + 0.3, np.sign(grid(64) - 0.5)], ids=["sine", "square"])
def test_arrays_and_functions_of_time_give_the_same_run(drive):
    """The first are integrated by compiled code, the second by SciPy's."""
    amplitudes = np.fft.rfft(drive)[: (drive.size + 1) // 2] * 2 / drive.size
    amplitudes[0] /= 2
    harmonic = np.arange(amplitudes.size)

    def signal(time):
        return (np.exp(2j * np.pi * np.multiply.outer(np.asarray(time), harmonic)) @ amplitudes).real

    arguments = {"frequency": 1.0, "duration": 5.0, "sampling_rate": 33.0, "start": {"x": 0.1}}
    one, other = (
        bp.simulate(bp.models.duffing, OSCILLATOR | {"k3": 50.0}, {"force": force}, **arguments)
        for force in (drive, signal)
    )
    assert one.outputs["displacement"] == pytest.approx(other.outputs["displacement"], abs=1e-8)
    assert one.inputs["force"] == pytest.approx(other.inputs["force"], abs=1e-12)


def test_a_stiff_run_under_periodic_inputs_takes_no_interpreted_step(monkeypatch):
    """A lag of 0.1 ms over 5 s, stiff, with the solution in closed form."""
    monkeypatch.setattr("bayesperiodic.simulation.solve_ivp", lambda *_, **__: pytest.fail("interpreted steps"))
    model = bp.Model(
        "lag",
        states=["x"],
        inputs=["u"],
        parameters={"delay": "s"},
        equations=lambda s, p, u: [p.delay * s.dx + s.x - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    run = bp.simulate(
        model, {"delay": 1e-4}, {"u": np.cos(2 * np.pi * grid(8))}, frequency=0.2, duration=5.0, sampling_rate=9.0
    )
    answer = (np.exp(2j * np.pi * 0.2 * run.time) / (1 + 2j * np.pi * 0.2 * 1e-4)).real
    assert run.outputs["x"][1:] == pytest.approx(answer[1:], abs=1e-9)


def test_noise_has_its_standard_deviation_and_its_seed():
    arguments = {
        "frequency": 1.0,
        "duration": 20.0,
        "sampling_rate": 100.0,
        "noise": {"displacement": 0.1, "force": 0.2},
    }
    clean = bp.simulate(bp.models.duffing, OSCILLATOR, {"force": np.ones(8)}, **(arguments | {"noise": None}))
    one, again = (bp.simulate(bp.models.duffing, OSCILLATOR, {"force": np.ones(8)}, seed=3, **arguments) for _ in "12")
    assert np.array_equal(one.outputs["displacement"], again.outputs["displacement"])
    assert np.std(one.outputs["displacement"] - clean.outputs["displacement"]) == pytest.approx(0.1, rel=0.08)
    assert np.std(one.inputs["force"]) == pytest.approx(0.2, rel=0.08)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning:scipy")
def test_a_run_that_blows_up_is_an_error():
    model = bp.Model(
        "blow",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dx - p.a * s.x**2 - 1 - u.u],
        outputs=lambda s, p, u: {"x": sp.sqrt(s.x**2)},
    )
    with pytest.raises(RuntimeError, match="The time integration of 'blow' failed"):
        bp.simulate(
            model, {"a": 1.0}, {"u": np.cos(2 * np.pi * grid(8))}, frequency=1.0, duration=10.0, sampling_rate=10.0
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration": 0.0}, "duration: must be .*got 0.0"),
        ({"start": {"y": 1.0}}, "start: must be one of 'x', 'dx', got 'y'"),
        ({"noise": {"y": 1.0}}, "noise: must be .*got 'y'"),
        ({"inputs": {}}, "inputs: must have .*got no 'force'"),
    ],
)
def test_error_names_the_bad_argument(changes, message):
    arguments = {
        "model": bp.models.duffing,
        "parameters": OSCILLATOR,
        "inputs": {"force": np.ones(8)},
        "frequency": 1.0,
        "duration": 1.0,
        "sampling_rate": 10.0,
    }
    with pytest.raises(ValueError, match=message):
        bp.simulate(**(arguments | changes))
