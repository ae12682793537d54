import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import bayesperiodic as bp
from studies import shooting
from tests.known import grid
from tests.shooting import trajectory, van_der_pol_cycle

VAN_DER_POL = bp.models.van_der_pol
CYCLES = sorted(shooting.VAN_DER_POL.items())
LINEAR = bp.Model(
    "free_oscillator",
    states=["x"],
    parameters=["c", "k"],
    equations=lambda s, p, u: [s.ddx + p.c * s.dx + p.k * s.x],
    outputs=lambda s, p, u: {"x": s.x},
)
LORENZ = bp.Model(
    "lorenz",
    states=["x", "y", "z"],
    parameters=["sigma", "r", "b"],
    equations=lambda s, p, u: [
        s.dx - p.sigma * (s.y - s.x),
        s.dy - p.r * s.x + s.y + s.x * s.z,
        s.dz - s.x * s.y + p.b * s.z,
    ],
    outputs=lambda s, p, u: {"x": s.x},
)


def cycle(mu: float, samples: int = 200, scheme: str = "central4", **changes) -> bp.PeriodicSolution:
    arguments = {"frequency": 0.15, "samples": samples, "scheme": scheme} | changes
    return bp.solve_periodic(VAN_DER_POL, {"mu": mu, "omega": 1.0}, **arguments)


def circle(samples: int, amplitude: float = 2.0) -> dict[str, np.ndarray]:
    return {"x": amplitude * np.cos(2 * np.pi * grid(samples))}


def turning_point(solution: bp.PeriodicSolution) -> float:
    """Return the largest x, from the trigonometric interpolation of the grid."""
    amplitudes = np.fft.rfft(solution.states["x"]) / solution.samples
    harmonics = np.arange(len(amplitudes))

    def height(tau: float) -> float:
        waves = amplitudes * np.exp(2j * np.pi * harmonics * tau)
        return float(-2 * waves.sum().real + amplitudes[0].real)

    near = np.argmax(solution.states["x"]) / solution.samples
    bounds = (near - 1.5 / solution.samples, near + 1.5 / solution.samples)
    return -minimize_scalar(height, bounds=bounds, method="bounded", options={"xatol": 1e-12}).fun


@pytest.mark.parametrize(("mu", "known"), CYCLES)
def test_cycle_by_the_fourth_order_scheme_agrees_with_the_reference(mu, known):
    period, amplitude, multiplier = known
    solution = cycle(mu, 800)
    assert solution.converged and solution.stable
    assert solution.period == pytest.approx(period, rel=1e-5)
    assert turning_point(solution) == pytest.approx(amplitude, rel=1e-5)
    assert solution.multipliers[0] == pytest.approx(1.0, abs=1e-3)
    assert solution.multipliers[1] == pytest.approx(multiplier, rel=1e-5 if mu <= 2 else 5e-3)


@pytest.mark.parametrize(("mu", "known"), CYCLES)
def test_cycle_by_the_fourier_scheme_agrees_with_the_reference(mu, known):
    period, amplitude, multiplier = known
    solution = cycle(mu, 256, "fourier")
    assert solution.converged and solution.stable
    assert solution.period == pytest.approx(period, rel=1e-9)
    assert turning_point(solution) == pytest.approx(amplitude, rel=1e-9 if mu < 5 else 1e-5)
    assert solution.multipliers[0] == pytest.approx(1.0, abs=1e-6 if mu < 5 else 1e-4)
    assert solution.multipliers[1] == pytest.approx(multiplier, rel=1e-7 if mu < 5 else 1e-4)


def test_stability_does_not_depend_on_which_side_of_one_the_trivial_multiplier_is_computed():
    above, below = cycle(0.1, 200, "backward2"), cycle(0.1, 200, "central2")
    assert above.multipliers[0].real > 1.0 > below.multipliers[0].real
    assert above.stable and below.stable


def test_tabulated_cycle_is_again_that_of_shooting():
    assert van_der_pol_cycle(0.5, parts=6) == pytest.approx(shooting.VAN_DER_POL[0.5], rel=1e-11)


def test_omega_only_scales_the_time():
    slow = cycle(1.0)
    fast = bp.solve_periodic(VAN_DER_POL, {"mu": 1.0, "omega": 2.5}, frequency=0.4, samples=200, scheme="central4")
    assert fast.period == pytest.approx(slow.period / 2.5, rel=1e-11)
    assert fast.multipliers == pytest.approx(slow.multipliers, rel=1e-8)
    assert fast.frequency_sensitivities["omega"] == pytest.approx(fast.frequency / 2.5, rel=1e-10)


SIZED = bp.Model(
    "sized_van_der_pol", states=["x"], parameters=["mu", "omega", "a"], outputs={"y": "x"},
    equations=["ddx - mu*omega*(1 - (x/a)**2)*dx + omega**2*x"],
)  # fmt: skip


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e-3, 1e6])
def test_cycle_does_not_depend_on_the_unit_of_its_state(unit):
    """A motion of millimetres in metres; far outside of its cycle van der Pol's oscillator only creeps."""
    how = {"frequency": 1.0, "samples": 200, "scheme": "fourier"}
    solution = bp.solve_periodic(SIZED, {"mu": 0.5, "omega": 6.0, "a": unit}, **how)
    plain = bp.solve_periodic(VAN_DER_POL, {"mu": 0.5, "omega": 6.0}, **how)
    assert solution.converged and solution.frequency == pytest.approx(plain.frequency, rel=1e-9)
    assert np.ptp(solution.states["x"]) == pytest.approx(unit * np.ptp(plain.states["x"]), rel=1e-3)
    assert solution.multipliers == pytest.approx(plain.multipliers, abs=1e-4)


def test_guess_as_array_or_as_solution_leads_to_the_same_cycle():
    settled = cycle(0.5)
    assert settled.found_by == "time integration"
    by_array = cycle(0.5, guess=circle(200))
    assert by_array.found_by == "newton"
    assert by_array.frequency == pytest.approx(settled.frequency, rel=1e-11)
    assert np.ptp(by_array.states["x"]) == pytest.approx(np.ptp(settled.states["x"]), rel=1e-3)
    other = cycle(0.6, guess=settled, frequency=123.0)
    assert other.converged and other.frequency == pytest.approx(cycle(0.6).frequency, rel=1e-11)
    again = cycle(0.5, guess=settled, frequency=123.0)
    assert again.iterations <= 1
    assert again.states["x"] == pytest.approx(settled.states["x"], abs=1e-9)


@pytest.mark.parametrize("lag", [0.0, 0.3])
def test_phase_of_a_cycle_is_closest_to_the_guess(lag):
    x = 2 * np.cos(2 * np.pi * (grid(200) - lag))
    solution = cycle(0.1, guess={"x": x})
    shifted = [np.sum((np.roll(solution.states["x"], k) - x) ** 2) for k in (-1, 0, 1)]
    assert shifted[1] < shifted[0] and shifted[1] < shifted[2]


def test_frequency_far_from_the_cycles_own_is_measured():
    assert cycle(1.0, frequency=0.02).frequency == pytest.approx(cycle(1.0).frequency, rel=1e-9)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_constant_guess_is_rejected_for_an_autonomous_model(value):
    with pytest.raises(ValueError, match="guess: must vary in time, got constant states; 'van_der_pol' is autonomous"):
        cycle(0.5, guess={"x": np.full(200, value)})


@pytest.mark.parametrize("amplitude", [0.01, 0.5])
def test_guess_that_falls_onto_the_equilibrium_ends_in_another_orbit(amplitude):
    solution = cycle(0.5, guess=circle(200, amplitude))
    assert np.ptp(solution.states["x"]) < 1e-9
    assert solution.status == "other orbit"
    assert not solution.stable


@pytest.mark.parametrize("cycles", [2, 3])
def test_several_cycles_in_a_guess_that_is_none_of_them_end_in_another_orbit(cycles):
    tau = grid(200)
    x = 2 * np.cos(2 * np.pi * cycles * tau) + 0.1 * np.cos(2 * np.pi * tau)
    solution = cycle(0.5, frequency=0.157 / cycles, guess={"x": x})
    assert solution.status == "other orbit"
    assert cycles * solution.frequency == pytest.approx(1 / shooting.VAN_DER_POL[0.5][0], rel=1e-5)


def test_one_cycle_counted_twice_is_another_orbit():
    once = cycle(0.5)
    solution = cycle(0.5, frequency=once.frequency / 2, guess={"x": np.tile(once.states["x"][::2], 2)})
    assert solution.status == "other orbit"


def test_fourier_estimates_the_error_of_the_frequency_too():
    coarse, fine = cycle(2.0, 48, "fourier"), cycle(2.0, 256, "fourier")
    true = abs(coarse.frequency - fine.frequency)
    assert coarse.error_estimate()["frequency"] == pytest.approx(true, rel=0.05)
    assert fine.error_estimate()["frequency"] < 1e-9 * fine.frequency


@pytest.mark.parametrize("damping", [0.1, -0.1])
@pytest.mark.parametrize("guess", ["static", "integration", circle(200)], ids=["static", "integration", "array"])
def test_linear_oscillator_with_damping_has_no_cycle(damping, guess):
    solution = bp.solve_periodic(LINEAR, {"c": damping, "k": 1.0}, frequency=0.15, samples=200, guess=guess)
    assert not solution.converged
    assert not solution.stable and solution.sensitivities == {} and solution.frequency_sensitivities == {}


def test_several_forcing_periods_are_refused():
    with pytest.raises(ValueError, match="periods: must be 1, got 2; 'van_der_pol' is autonomous"):
        cycle(0.5, periods=2)


@pytest.mark.parametrize("mu", [0.1, 0.5, 2.0])
def test_cycle_in_reversed_time_is_found_and_unstable(mu):
    """With −μ the same cycle is run through backwards: same period, the inverse of the multiplier."""
    period, _, multiplier = shooting.VAN_DER_POL[mu]
    solution = cycle(-mu, 400, guess=circle(400))
    assert solution.converged and not solution.stable
    assert solution.period == pytest.approx(period, rel=1e-6)
    assert solution.multipliers == pytest.approx([1 / multiplier, 1.0], rel=1e-3)


def test_integration_cannot_find_an_unstable_cycle():
    assert cycle(-0.5).status == "other orbit"


def without_shift(solution: bp.PeriodicSolution, exact: bp.PeriodicSolution) -> np.ndarray:
    """Return the difference on the grid, after a shift of the exact one that leaves no part along the flow."""
    samples = solution.samples
    amplitudes = np.fft.rfft(exact.states["x"]) / exact.samples
    harmonics = np.arange(len(amplitudes))
    lag = (np.argmax(solution.states["x"]) / samples - np.argmax(exact.states["x"]) / exact.samples) % 1.0
    for _ in range(10):
        waves = amplitudes * np.exp(2j * np.pi * np.outer(grid(samples) - lag, harmonics))
        flow = 2 * (2j * np.pi * harmonics * waves).real.sum(axis=1)
        difference = solution.states["x"] - (2 * waves.real.sum(axis=1) - amplitudes[0].real)
        lag -= np.sum(flow * difference) / np.sum(flow**2)
    return difference


@pytest.mark.parametrize(
    ("scheme", "mu", "tolerance"), [("central2", 1.0, 0.05), ("backward2", 1.0, 0.1), ("central4", 2.0, 0.1)]
)
def test_error_estimate_is_the_error(scheme, mu, tolerance):
    """Against Fourier collocation, whose phase is shifted until the difference has no part along the flow."""
    samples = 400
    solution, exact = cycle(mu, samples, scheme), cycle(mu, 256, "fourier")
    estimate, difference = solution.error_estimate(), without_shift(solution, exact)
    assert estimate["x"] == pytest.approx(np.abs(difference).max(), rel=tolerance)
    true = abs(solution.frequency - 1 / shooting.VAN_DER_POL[mu][0])
    assert estimate["frequency"] == pytest.approx(true, rel=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [200, 400, 401, 601])
def test_fourier_error_estimate_of_an_unresolved_stiff_cycle_has_the_size_of_the_error(samples):
    """Relaxation oscillation, μ = 20: jumps of 1/400 of the period, errors of 0.2 to 0.6 against central4 at 12,800."""
    exact = cycle(20.0, 12_800, frequency=1 / 34.7)
    solution = cycle(20.0, samples, "fourier", frequency=exact.frequency, guess=exact)
    estimate, error = solution.error_estimate(), np.abs(without_shift(solution, exact)).max()
    assert solution.converged and error > 0.15
    assert estimate["x"] == pytest.approx(error, rel=0.4)
    assert estimate["frequency"] == pytest.approx(abs(solution.frequency - exact.frequency), rel=0.1)


def test_published_unstable_orbit_of_three_first_order_states():
    """The orbit AB of Lorenz' equations, D. Viswanath, Nonlinearity 16 (2003) 1035-1056: T = 1.5586522107162."""
    period, start = 1.5586522107162, np.array([-13.763610682134, -19.578751942452, 27.0])

    def slope(t, y):
        return np.array([10 * (y[1] - y[0]), 28 * y[0] - y[1] - y[0] * y[2], y[0] * y[1] - 8 / 3 * y[2]])

    def jacobian(t, y):
        return np.array([[-10.0, 10.0, 0.0], [28.0 - y[2], -1.0, -y[0]], [y[1], y[0], -8 / 3]])

    end, transfer = shooting.flow(slope, jacobian, 0.0, period, start)
    assert end == pytest.approx(start, abs=1e-10)
    path = trajectory(slope, np.array([0.0, period]), [start], period * grid(128))
    disturbance = 0.5 * np.sin(2 * np.pi * 3 * grid(128))
    guess = {name: path[:, k] + disturbance for k, name in enumerate("xyz")}
    parameters = {"sigma": 10.0, "r": 28.0, "b": 8 / 3}
    solution = bp.solve_periodic(LORENZ, parameters, frequency=0.65, samples=128, scheme="fourier", guess=guess)
    assert solution.converged and not solution.stable
    assert solution.period == pytest.approx(period, rel=1e-11)
    expected = np.sort(np.linalg.eigvals(transfer).real)[::-1]
    assert solution.multipliers[:2] == pytest.approx(expected[:2], rel=1e-6)
    assert np.sum(solution.exponents) == pytest.approx(-(10 + 1 + 8 / 3), rel=1e-7)
