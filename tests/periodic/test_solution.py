import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from tests.known import RUNAWAY, complex_step_sensitivities, grid
from tests.periodic.test_factors import SLOW_SCHEMES

DUFFING = {"m": 0.45, "c": 1.3, "k": 900.0, "k3": 4e5}
FREQUENCY = 5.0
SCHEMES = ["central2", "backward2"]
FORWARD3 = bp.Scheme(
    "forward3",
    3,
    first={-1: -1 / 3, 0: -1 / 2, 1: 1.0, 2: -1 / 6},
    second={-1: 11 / 12, 0: -5 / 3, 1: 1 / 2, 2: 1 / 3, 3: -1 / 12},
)

COUPLED = bp.Model(
    "coupled",
    states=["x", "T"],
    inputs=["force"],
    parameters=["m", "c", "k", "h", "b"],
    equations=lambda s, p, u: [
        p.m * s.ddx + p.c * s.dx * sp.sqrt(1 + s.dx**2) + p.k * sp.sinh(s.x) - p.b * s.T - u.force,
        s.dT + p.h * s.T * (1 + s.x**2) - s.dx * s.x - u.dforce / 10,
    ],
    outputs=lambda s, p, u: {
        "position": s.x * p.b,
        "temperature": s.T + p.c * s.dx,
        "reaction": p.m * s.ddx + u.ddforce,
    },
)
COUPLED_AT = {"m": 1.2, "c": 0.4, "k": 30.0, "h": 2.0, "b": 0.7}


def manufactured_force(x, v, a):
    return DUFFING["m"] * a + DUFFING["c"] * v + DUFFING["k"] * x + DUFFING["k3"] * x**3


def manufactured(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x(t) = 0.02 cos ωt + 0.006 sin(2ωt + 0.4) and the force that makes it an exact solution."""
    angle, omega = 2 * np.pi * grid(samples), 2 * np.pi * FREQUENCY
    x = 0.02 * np.cos(angle) + 0.006 * np.sin(2 * angle + 0.4)
    v = omega * (-0.02 * np.sin(angle) + 0.012 * np.cos(2 * angle + 0.4))
    a = omega**2 * (-0.02 * np.cos(angle) - 0.024 * np.sin(2 * angle + 0.4))
    return x, manufactured_force(x, v, a)


def solve_manufactured(scheme, samples: int) -> tuple[bp.PeriodicSolution, float]:
    exact, force = manufactured(samples)
    solution = bp.solve_periodic(
        bp.models.duffing,
        DUFFING,
        {"force": force},
        frequency=FREQUENCY,
        samples=samples,
        scheme=scheme,
        guess={"x": exact},
    )
    assert solution.converged
    return solution, np.max(np.abs(solution.states["x"] - exact))


@pytest.mark.parametrize(
    ("scheme", "order", "tolerance", "sizes"),
    [
        ("central2", 2.0, 0.05, (800, 1600, 3200)),
        ("backward2", 2.0, 0.05, (800, 1600, 3200)),
        ("central4", 4.0, 0.1, (100, 200, 400)),
        pytest.param(FORWARD3, 3.0, 0.1, (400, 800, 1600), marks=pytest.mark.slow),
    ],
)
def test_schemes_have_their_order_on_a_manufactured_solution(scheme, order, tolerance, sizes):
    errors = np.array([solve_manufactured(scheme, samples)[1] for samples in sizes])
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(order, abs=tolerance)


@pytest.mark.parametrize("samples", [63, 64])
def test_fourier_collocation_is_exact_to_rounding_on_a_smooth_solution(samples):
    solution, error = solve_manufactured("fourier", samples)
    assert error < 1e-12 and solution.error_estimate()["x"] < 1e-10


@pytest.mark.parametrize(("scheme", "samples"), [("central2", 200), ("backward2", 400), ("central4", 100)])
def test_error_estimate_is_the_error(scheme, samples):
    solution, error = solve_manufactured(scheme, samples)
    assert solution.error_estimate()["x"] == pytest.approx(error, rel=0.1)


@pytest.mark.parametrize("samples", [10, 13])
def test_fourier_error_estimate_is_the_error_of_states_of_both_orders(samples):
    """Two response periods a grid, even and odd numbers of points, against 128 points a forcing period."""
    force = lambda n: {"force": 20.0 * np.cos(2 * np.pi * np.arange(2 * n) / n)}  # noqa: E731
    exact, solution = (
        bp.solve_periodic(COUPLED, COUPLED_AT, force(n), frequency=1.0, samples=n, periods=2, scheme="fourier")
        for n in (16 * samples, samples)
    )
    assert exact.converged and solution.converged
    for state, estimate in solution.error_estimate().items():
        error = np.abs(solution.states[state] - exact.states[state][::16]).max()
        assert 1e-7 < error and estimate == pytest.approx(error, rel=0.1)


def test_error_estimate_of_a_failed_solve_is_not_a_number():
    solution = bp.solve_periodic(RUNAWAY, {"a": 1.0}, {"u": np.cos(2 * np.pi * grid(100))}, frequency=1.0, samples=100)
    assert not solution.converged and np.isnan(solution.error_estimate()["x"])
    assert solution.multipliers.size == 0 and not solution.stable


@pytest.mark.parametrize("scheme", SCHEMES)
def test_first_order_states_converge_at_second_order(scheme):
    model = bp.Model(
        "relaxation",
        states=["w"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dw + p.a * s.w**3 - u.u],
        outputs=lambda s, p, u: {"w": s.w},
    )
    errors = []
    for samples in (400, 800, 1600):
        angle = 2 * np.pi * grid(samples)
        exact = 1.0 + 0.5 * np.sin(angle)
        forcing = np.pi * np.cos(angle) + 2.0 * exact**3
        solution = bp.solve_periodic(
            model, {"a": 2.0}, {"u": forcing}, frequency=1.0, samples=samples, scheme=scheme, guess={"w": exact}
        )
        errors.append(np.max(np.abs(solution.states["w"] - exact)))
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_linear_oscillator_matches_the_transfer_function_to_the_scheme_error(scheme):
    """Against the exact H(iω), and to rounding against H with the scheme's own symbols for d/dt and d²/dt²."""
    samples, omega = 400, 2 * np.pi * FREQUENCY
    force = np.cos(2 * np.pi * grid(samples))
    parameters = DUFFING | {"k3": 0.0}
    solution = bp.solve_periodic(
        bp.models.duffing, parameters, {"force": force}, frequency=FREQUENCY, samples=samples, scheme=scheme
    )
    step = 1 / (samples * FREQUENCY)
    shift = np.exp(-1j * omega * step)
    one, two = {
        "central2": ((1 / shift - shift) / 2 / step, (1 / shift - 2 + shift) / step**2),
        "backward2": ((1.5 - 2 * shift + 0.5 * shift**2) / step, (2 - 5 * shift + 4 * shift**2 - shift**3) / step**2),
    }[scheme]
    discrete = 1 / (parameters["m"] * two + parameters["c"] * one + parameters["k"])
    exact = 1 / (-parameters["m"] * omega**2 + parameters["c"] * 1j * omega + parameters["k"])
    amplitude = 2 * np.mean(solution.states["x"] * np.exp(-2j * np.pi * grid(samples)))
    assert amplitude == pytest.approx(discrete, rel=1e-9)
    assert abs(amplitude - exact) / abs(exact) < 1.01 * abs(discrete - exact) / abs(exact)
    assert 0 < abs(discrete - exact) / abs(exact) < 2e-3


@pytest.mark.parametrize("scheme", [*SLOW_SCHEMES, "central4"])
def test_sensitivities_match_complex_steps_through_an_independent_solver(scheme):
    samples = 48
    force = 3.0 * np.cos(2 * np.pi * grid(samples)) + 0.5
    solution = bp.solve_periodic(COUPLED, COUPLED_AT, {"force": force}, frequency=0.6, samples=samples, scheme=scheme)
    assert solution.converged
    expected = complex_step_sensitivities(COUPLED, COUPLED_AT, {"force": force}, 0.6, samples, scheme)
    for channel, by_parameter in expected.items():
        for name, values in by_parameter.items():
            error = np.max(np.abs(solution.sensitivities[channel][name] - values))
            assert error <= 1e-8 * np.max(np.abs(values)), (channel, name)


def test_unstable_orbit_is_found():
    """Around an unstable equilibrium with multipliers e^±20; a march in time would leave it."""
    model = bp.Model(
        "inverted",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.ddx - p.a * s.x + 0.1 * s.x**3 - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    solution = bp.solve_periodic(model, {"a": 400.0}, {"u": np.cos(2 * np.pi * grid(800))}, frequency=1.0)
    assert solution.converged
    exact = -1 / (400 + 4 * np.pi**2)
    assert 2 * np.mean(solution.states["x"] * np.cos(2 * np.pi * grid(800))) == pytest.approx(exact, rel=1e-4)


def test_period_two_orbit_has_samples_per_forcing_period():
    model = bp.Model(
        "slow",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dx + p.a * s.x - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    tau = np.arange(400) / 200
    solution = bp.solve_periodic(model, {"a": 1.0}, {"u": np.cos(np.pi * tau)}, frequency=2.0, samples=200, periods=2)
    omega = 2 * np.pi * 1.0
    exact = (np.exp(1j * np.pi * tau) / (1j * omega + 1)).real
    assert solution.tau == pytest.approx(tau)
    assert solution.states["x"] == pytest.approx(exact, abs=1e-3 * np.abs(exact).max())


def test_rotation_keeps_its_turns():
    """φ̈ + c φ̇ = torque: turning at torque/c rad/s, once a period when torque = 2π f c."""
    model = bp.Model(
        "rotor",
        states=["phi"],
        inputs=["torque"],
        parameters=["c", "k"],
        angles=["phi"],
        equations=lambda s, p, u: [s.ddphi + p.c * s.dphi + p.k * sp.sin(s.phi) - u.torque],
        outputs=lambda s, p, u: {"rate": s.dphi},
    )
    torque = np.full(200, 2 * np.pi * 0.5 * 3.0)
    solution = bp.solve_periodic(
        model,
        {"c": 3.0, "k": 0.4},
        {"torque": torque + 0.5 * np.cos(2 * np.pi * grid(200))},
        frequency=0.5,
        samples=200,
        winding={"phi": 1},
        guess={"phi": 2 * np.pi * grid(200) + 0.1},
    )
    assert solution.converged
    assert solution.states["phi"][-1] - solution.states["phi"][0] == pytest.approx(2 * np.pi, rel=0.05)
    assert np.mean(solution.outputs["rate"]) == pytest.approx(2 * np.pi * 0.5)


def test_solve_without_equilibrium_returns_a_status():
    solution = bp.solve_periodic(RUNAWAY, {"a": 1.0}, {"u": np.cos(2 * np.pi * grid(100))}, frequency=1.0, samples=100)
    assert not solution.converged
    assert solution.status in ("stalled", "singular")
    assert solution.sensitivities == {}


def test_overflow_has_status_not_finite():
    model = bp.Model(
        "overflow",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dx + sp.exp(p.a * s.x) - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    solution = bp.solve_periodic(
        model, {"a": 1e6}, {"u": np.cos(2 * np.pi * grid(50))}, frequency=1.0, samples=50, guess={"x": np.ones(50)}
    )
    assert solution.status == "not finite"


def test_earlier_solution_as_guess_needs_no_iterations():
    _, force = manufactured(400)
    arguments = {"frequency": FREQUENCY, "samples": 400}
    first = bp.solve_periodic(bp.models.duffing, DUFFING, {"force": force}, **arguments)
    again = bp.solve_periodic(bp.models.duffing, DUFFING, {"force": force}, **arguments, guess=first)
    assert again.iterations <= 1
    assert again.states["x"] == pytest.approx(first.states["x"], rel=1e-9)


def test_a_solution_on_another_grid_or_of_fewer_periods_is_a_guess():
    _, force = manufactured(400)
    arguments = {"frequency": FREQUENCY, "samples": 400}
    coarse, _ = solve_manufactured("central2", 100)
    fine = bp.solve_periodic(bp.models.duffing, DUFFING, {"force": force}, **arguments, guess=coarse)
    assert fine.converged and fine.history[0, 1] < 2e-3
    twice = {"force": np.tile(force, 2)}
    doubled = bp.solve_periodic(bp.models.duffing, DUFFING, twice, **arguments, periods=2, guess=fine)
    assert doubled.iterations <= 1
    assert doubled.states["x"] == pytest.approx(np.tile(fine.states["x"], 2), rel=1e-9)
    with pytest.raises(ValueError, match="guess: must be a solution whose periods divide 3, got one of 2"):
        bp.solve_periodic(
            bp.models.duffing, DUFFING, {"force": np.tile(force, 3)}, **arguments, periods=3, guess=doubled
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": 3}, "samples: must be .*got 3"),
        ({"inputs": {"force": np.zeros(99)}}, r"inputs\['force'\]: must have 100 values .samples·periods., got 99"),
        ({"inputs": {"force": np.full(100, np.nan)}}, r"inputs\['force'\]: must be finite, got nan at index 0"),
        ({"inputs": {"forse": np.zeros(100)}}, "inputs: must be .*got 'forse'.*Did you mean 'force'"),
        ({"frequency": 0.0}, "frequency: must be > 0, got 0.0"),
        ({"winding": 1}, "winding: must be 0, got 1; no state of 'duffing' is an angle"),
        ({"winding": {"x": 1}}, "winding: must be .*got 'x'"),
        ({"scheme": "central3"}, "scheme: must be .*got 'central3'.*Did you mean 'central4'"),
        ({"parameters": {"m": 1.0, "c": 1.0, "k": 1.0}}, "parameters: must have .*got no 'k3'"),
        ({"parameters": DUFFING | {"k5": 1.0}}, "parameters: must be .*got 'k5'"),
        ({"guess": {"x": np.zeros(3)}}, r"guess\['x'\]: must have 100 values .*got 3"),
        ({"guess": "zero"}, "guess: must be .*got 'zero'"),
        ({"periods": 0}, "periods: must be .*got 0"),
    ],
)
def test_error_names_the_bad_argument(changes, message):
    arguments = {
        "model": bp.models.duffing,
        "parameters": DUFFING,
        "inputs": {"force": np.ones(100)},
        "frequency": 1.0,
        "samples": 100,
    }
    with pytest.raises(ValueError, match=message):
        bp.solve_periodic(**(arguments | changes))


def test_windings_of_two_angles_are_given_by_name():
    twin = bp.Model(
        "twin",
        states=["a", "b"],
        angles=["a", "b"],
        parameters=["k"],
        equations=lambda s, p, u: [s.dda + p.k * sp.sin(s.a - s.b), s.ddb + sp.cos(2 * sp.pi * s.tau)],
        outputs=lambda s, p, u: {"difference": s.a - s.b},
    )
    with pytest.raises(ValueError, match=r"winding: must name the angles .* as \{'a': 2\}, got 2"):
        bp.solve_periodic(twin, {"k": 1.0}, frequency=1.0, samples=20, winding=2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"first": {-1: -1.0, 1: 1.0}}, "first: must give 1 for the derivative of t\\*\\*1 at 0, got 2"),
        ({"second": {0: 1.0, 1: -2.0}}, "second: must give 0 for the derivative of t"),
        ({"order": 0}, "order: must be at least 1, got 0"),
    ],
)
def test_inconsistent_schemes_are_rejected(changes, message):
    good = {"order": 2, "first": {-1: -0.5, 1: 0.5}, "second": {-1: 1.0, 0: -2.0, 1: 1.0}}
    with pytest.raises(ValueError, match=message):
        bp.Scheme("mine", **(good | changes))
