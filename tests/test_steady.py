"""The steady cycle by time integration, against closed forms and the periodic solver."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.simulation import NotSettled, steady_cycle
from tests.known import GEAR, RUNAWAY, grid

WAVE = np.cos(2 * np.pi * grid(16))


def test_a_linear_oscillator_has_its_closed_form_response():
    """A transient of some hundred periods is not integrated in full."""
    values = {"m": 1.0, "c": 0.02, "k": 1.0, "k3": 0.0}
    found = steady_cycle(bp.models.duffing, values, {"force": WAVE}, frequency=0.1, samples=40)
    rate = 2 * np.pi * 0.1
    amplitude = 1.0 / (1.0 - rate**2 + 1j * rate * 0.02)
    expected = (amplitude * np.exp(2j * np.pi * grid(40))).real
    assert found["displacement"] == pytest.approx(expected, abs=1e-8 * abs(amplitude))


def test_slow_thermal_transient_is_integrated_to_the_steady_state():
    """The gas starts at 0 K and its time constant is 8 s: the periodic solver agrees to 1e-8 of the range."""
    stroke, model = 0.12 + 0.01 * WAVE, bp.models.landing_gear("displacement")
    found = steady_cycle(model, GEAR, {"displacement": stroke}, frequency=4.0, samples=200)
    inputs = {"displacement": 0.12 + 0.01 * np.cos(2 * np.pi * grid(200))}
    solved = bp.solve_periodic(model, GEAR, inputs, frequency=4.0, samples=200, scheme="fourier")
    pressure = solved.outputs["pressure"]
    assert found["pressure"] == pytest.approx(pressure, abs=1e-8 * np.ptp(pressure))


@pytest.mark.parametrize(
    ("model", "values", "inputs"),
    [
        (RUNAWAY, {"a": 1.0}, {"u": WAVE}),
        (bp.models.duffing, {"m": 1.0, "c": -0.1, "k": 1.0, "k3": 0.0}, {"force": WAVE}),
    ],
    ids=["no cycle", "an unstable one"],
)
def test_motion_that_does_not_settle_raises(model, values, inputs):
    with pytest.raises(NotSettled, match=model.name):
        steady_cycle(model, values, inputs, frequency=0.1, samples=40)
