import re
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.periodic import solve
from studies import shooting
from tests.known import grid
from tests.pendulum import PENDULUM

RESONANT = {"m": 1.0, "c": 0.05, "k": 1.0, "k3": 1.0}
RESONANCE = [(1.0, 0.25), (3.0, 0.3), (10.0, 0.4)]

DRY = bp.Model(
    "dry_friction",
    states=["x"],
    inputs=["force"],
    parameters=["m", "c", "k", "r", "v0"],
    equations=lambda s, p, u: [p.m * s.ddx + p.c * s.dx + p.k * s.x + p.r * bp.smooth_sign(s.dx, p.v0) - u.force],
    outputs=lambda s, p, u: {"x": s.x},
)
# ẇ + w follows the smooth sign of a rate that is prescribed, so that the width in steps is known.
SWITCH = bp.Model(
    "switch",
    states=["w"],
    inputs=["x"],
    parameters=["width"],
    equations=lambda s, p, u: [s.dw + s.w - sp.tanh(u.dx / p.width)],
    outputs=lambda s, p, u: {"w": s.w},
)


def spectral(values: np.ndarray, frequency: float, order: int) -> np.ndarray:
    rate = 2j * np.pi * frequency * np.arange(len(values) // 2 + 1)
    return np.fft.irfft(rate**order * np.fft.rfft(values), len(values))


@pytest.mark.parametrize(("amplitude", "frequency"), RESONANCE)
def test_resonance_is_found_by_amplitude_continuation(amplitude, frequency):
    """Plain Newton from rest does not get there; with 128 points the equation holds in spectral derivatives."""
    force = amplitude * np.cos(2 * np.pi * grid(128))
    arguments = {"frequency": frequency, "samples": 128, "scheme": "fourier"}
    solution = bp.solve_periodic(bp.models.duffing, RESONANT, {"force": force}, **arguments)
    assert solution.converged
    assert solution.found_by == "input amplitude"
    x = solution.states["x"]
    acceleration, rate = spectral(x, frequency, 2), 0.05 * spectral(x, frequency, 1)
    assert acceleration + rate + x + x**3 == pytest.approx(force, abs=1e-9 * np.abs(acceleration).max())
    from_zero = bp.solve_periodic(
        bp.models.duffing, RESONANT, {"force": force}, **arguments, guess={"x": np.zeros(128)}
    )
    assert not from_zero.converged


def test_amplitude_continuation_scales_the_input_about_its_mean():
    """The force is the logarithm of the input, so that there is none without the input's mean."""
    model = bp.Model(
        "logarithmic",
        states=["x"],
        inputs=["u"],
        parameters=["c"],
        equations=lambda s, p, u: [s.ddx + p.c * s.dx + s.x + s.x**3 - sp.log(u.u)],
        outputs=lambda s, p, u: {"x": s.x},
    )
    amplitude, frequency = RESONANCE[1]
    force = amplitude * np.cos(2 * np.pi * grid(128))
    solution = bp.solve_periodic(
        model, {"c": 0.05}, {"u": np.exp(force)}, frequency=frequency, samples=128, scheme="fourier"
    )
    assert solution.converged
    assert solution.found_by == "input amplitude"
    x = solution.states["x"]
    terms = spectral(x, frequency, 2) + 0.05 * spectral(x, frequency, 1) + x + x**3
    assert terms == pytest.approx(force, abs=1e-8 * np.abs(x**3).max())


def test_model_without_inputs_falls_back_on_a_time_integration():
    model = bp.Model(
        "duffing_in_tau",
        states=["x"],
        parameters=["c", "k3", "a"],
        equations=lambda s, p, u: [s.ddx + p.c * s.dx + s.x + p.k3 * s.x**3 - p.a * sp.cos(2 * sp.pi * s.tau)],
        outputs=lambda s, p, u: {"x": s.x},
    )
    amplitude, frequency = RESONANCE[1]
    arguments = {"frequency": frequency, "samples": 128, "scheme": "central4"}
    solution = bp.solve_periodic(model, {"c": 0.05, "k3": 1.0, "a": amplitude}, **arguments)
    assert solution.converged and solution.stable
    assert solution.found_by == "time integration"
    force = amplitude * np.cos(2 * np.pi * grid(128))
    again = bp.solve_periodic(bp.models.duffing, RESONANT, {"force": force}, **arguments, guess=solution.states)
    assert again.iterations <= 1
    assert again.states["x"] == pytest.approx(solution.states["x"], abs=1e-8)


@pytest.mark.filterwarnings("ignore:A smooth sign")
@pytest.mark.parametrize("width", [1e-3, 1e-4])
@pytest.mark.parametrize("scheme", ["central2", "backward2"])
def test_dry_friction_is_solved_by_sharpness_continuation(width, scheme):
    """Stick and slip: against a time integration of the same equation, after its transient."""
    parameters = {"m": 1.0, "c": 0.05, "k": 1.0, "r": 0.6, "v0": width}
    solution = bp.solve_periodic(
        DRY,
        parameters,
        {"force": np.cos(2 * np.pi * grid(800))},
        frequency=0.1,
        samples=800,
        scheme=scheme,
        guess={"x": np.zeros(800)},
    )
    assert solution.converged
    assert solution.found_by == "sharpness"

    def slope(t, y):
        friction = 0.6 * np.tanh(y[1] / width)
        return [y[1], np.cos(2 * np.pi * 0.1 * t) - 0.05 * y[1] - y[0] - friction]

    at = 10.0 * (4 + grid(800))
    path = solve_ivp(slope, (0.0, 50.0), [0.0, 0.0], method="LSODA", rtol=1e-8, atol=1e-10, t_eval=at).y[0]
    assert np.ptp(path) > 1.0
    assert solution.states["x"] == pytest.approx(path, abs=1e-3)


@pytest.mark.filterwarnings("ignore:A smooth sign")
def test_landing_gear_with_sharp_friction_is_solved_from_its_equilibrium():
    gear = bp.models.landing_gear("force")
    values = [80.0, 0.0, 8e3, 5e-3, 1e6 / 293, -2.5, 0.0, 150.0, 1e-4, 3e5, -500.0, 0.0, 17.0, 2.0, -293.0]
    parameters = dict(zip(gear.parameters, values, strict=True))
    force = 4500 + 600 * np.cos(2 * np.pi * grid(400))
    solution = bp.solve_periodic(gear, parameters, {"force": force}, frequency=1.0, samples=400)
    assert solution.converged
    assert solution.found_by == "sharpness"
    assert solution.residual < 1e-8


def test_model_without_smooth_signs_is_not_sharpened():
    solution = bp.solve_periodic(
        bp.models.duffing,
        RESONANT,
        {"force": 3.0 * np.cos(2 * np.pi * grid(128))},
        frequency=0.3,
        samples=128,
        guess={"x": np.zeros(128)},
    )
    assert not solution.converged
    assert solution.found_by == "newton"


def test_integration_finds_the_locked_rotation_of_the_pendulum():
    known = shooting.STABLE[0]
    solution = bp.solve_periodic(
        bp.models.pendulum,
        PENDULUM,
        frequency=known.omega / (2 * np.pi),
        samples=400,
        scheme="central4",
        winding=1,
        guess="integration",
    )
    assert solution.converged and solution.stable
    found = solution.states["phi"][0], solution.outputs["rate"][0]
    assert found == pytest.approx(known.section[0], abs=1e-7)


def test_time_integration_fallback_leaves_an_unstable_equilibrium():
    """Two wells: Newton's method from rest stays on the crest, an integration falls into a well."""
    parameters = {"m": 1.0, "c": 0.5, "k": -1.0, "k3": 1.0}
    arguments = {"frequency": 0.15, "samples": 200, "scheme": "central4"}
    force = {"force": 0.2 * np.cos(2 * np.pi * grid(200))}
    crest = bp.solve_periodic(bp.models.duffing, parameters, force, **arguments)
    well = bp.solve_periodic(bp.models.duffing, parameters, force, **arguments, guess="integration")
    assert crest.converged and not crest.stable
    assert crest.states["x"].mean() == pytest.approx(0.0, abs=1e-9)
    assert well.converged and well.stable
    assert abs(well.states["x"].mean()) == pytest.approx(1.0, abs=0.05)


def switch(steps: float, samples: int) -> bp.PeriodicSolution:
    """Return a solution in which the argument of the sign crosses from −1 to 1 within the given number of 100 steps."""
    width = steps * (2 * np.pi) ** 2 / 100 / 2
    return bp.solve_periodic(
        SWITCH, {"width": width}, {"x": np.sin(2 * np.pi * grid(samples))}, frequency=1.0, samples=samples
    )


@pytest.mark.parametrize("steps", [0.3, 2.5, 3.9])
def test_warning_states_the_samples_that_resolve_a_narrow_transition(steps):
    with pytest.warns(UserWarning, match="The transition of a smooth sign of 'switch' takes") as caught:
        switch(steps, 100)
    assert len(caught) == 1 and caught[0].filename == __file__
    told, samples = re.search(r"takes ([\d.]+) steps of the grid; (\d+) samples", str(caught[0].message)).groups()
    assert float(told) == pytest.approx(steps, rel=0.05)
    assert int(samples) == pytest.approx(100 * 4 / steps, rel=0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        switch(steps, int(samples) + 2)


def test_a_transition_that_turns_back_before_the_sign_changes_counts():
    """An argument that goes from 3 to 0.5 in one step would go from −1 to 1 in 0.8; above 1 nothing counts."""
    for lowest, steps in ((0.5, 0.8), (1.5, np.inf)):
        arguments = np.array([[3.0], [lowest], [3.0], [4.0]])
        equations = SimpleNamespace(
            model=SimpleNamespace(smooth_signs=("one",)), evaluate=lambda *_, values=arguments: values
        )
        assert solve._steps_of_transitions(equations, np.empty(0), np.empty(0)) == pytest.approx(steps)


def test_resolved_transition_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        switch(4.1, 100)


def test_sign_that_is_never_crossed_gives_no_warning():
    """The locked rotation never stops, however narrow the friction's transition."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = bp.solve_periodic(
            bp.models.pendulum, PENDULUM | {"v0": 1e-4}, frequency=13 / (2 * np.pi), samples=200, winding=1
        )
    assert solution.converged and solution.outputs["rate"].min() > 1.0
