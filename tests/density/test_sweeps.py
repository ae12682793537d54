"""Orbits of points of response tables, against harmonic balance with SciPy."""

import numpy as np
import pytest

from bayesperiodic.density.responses import ResponseSolver
from tests.response_tables import ANGLES, TRUTH, harmonic_balance, noisy, problem_of, swept

F = np.linspace(0.1, 0.26, 40)
THETA = np.array([TRUTH["c"], TRUTH["k"], TRUTH["k3"]])


def predicted(solver, theta=THETA, solve=0):
    simulation = solver.solve(np.atleast_2d(theta))
    names = [e.name for e in solver.problem.experiments]
    signals = np.array([simulation.response(name).outputs[solve, :, 0] for name in names])
    frequencies = np.array([simulation.response(name).frequency[solve] for name in names])
    return 2 / signals.shape[1] * np.fft.rfft(signals, axis=1)[:, 1], frequencies, simulation


def check_that_a_sweep_starts_on_the_right_side_of_the_jump(make, direction):
    """Problems are made by a function of frequencies, amplitudes and direction."""
    expected = swept(F, direction)
    solver = ResponseSolver.start(make(F, noisy(expected, 0.01, 1), direction), THETA)
    amplitudes, frequencies, simulation = predicted(solver)
    assert simulation.status.tolist() == [0] and frequencies == pytest.approx(F, rel=1e-12)
    assert amplitudes == pytest.approx(expected, abs=1e-3)


def check_that_points_one_by_one_may_be_on_any_stable_part(make):
    mixed = np.where(np.arange(40) % 2 == 0, swept(F, "up"), swept(F, "down"))
    amplitudes, *_ = predicted(ResponseSolver.start(make(F, mixed, None), THETA))
    assert amplitudes == pytest.approx(mixed, abs=1e-3)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_a_sweep_starts_on_the_right_side_of_the_jump(direction):
    check_that_a_sweep_starts_on_the_right_side_of_the_jump(problem_of, direction)


def test_points_measured_one_by_one_may_be_on_any_stable_part():
    check_that_points_one_by_one_may_be_on_any_stable_part(problem_of)


def folds(theta):
    """Return frequencies and amplitudes at the first fold for parameters (sets, 3)."""
    f, amplitude = harmonic_balance(*np.atleast_2d(theta).T, ANGLES[ANGLES < 2.2])
    top, sets = np.argmax(f, axis=0), np.arange(f.shape[1])
    a, b, c = (f[top + k, sets] for k in (-1, 0, 1))
    return b + (a - c) ** 2 / (8 * (2 * b - a - c)), np.abs(amplitude[top, sets])


def test_points_beyond_the_fold_get_the_orbit_at_the_fold():
    rows = np.array([0.15, 0.18, 0.199, 0.2, 0.20015])
    solver = ResponseSolver.start(problem_of(rows, swept(rows, "up"), "up"), THETA)
    beyond = THETA * [1.05, 1.0, 1.0]
    _, frequencies, simulation = predicted(solver, beyond)
    (fold,), (exact,) = folds(beyond)
    assert rows[1] < fold < rows[2] and simulation.status.tolist() == [0]
    assert frequencies == pytest.approx(np.minimum(rows, fold), rel=3e-6)
    amplitudes, *_ = predicted(solver, beyond)
    assert np.abs(amplitudes[2:]) == pytest.approx(exact, rel=1e-3)


def test_the_density_falls_off_beyond_the_fold_by_the_stated_resolution():
    """One point beyond the fold: its log-density is a function of θ without a jump, and normal in the distance."""
    rows = np.array([0.15, 0.18, 0.2])
    problem = problem_of(rows, swept(rows, "up"), "up").anchored(dict(zip(("c", "k", "k3"), THETA, strict=True)))
    factors = 1.0 + np.linspace(0.0, 0.006, 61)
    at = {"c": TRUTH["c"] * factors, "k": np.ones(61), "k3": 0.3 * np.ones(61)}
    theta = np.stack([at["c"], at["k"], at["k3"]], axis=1)
    huge = {"variance[displacement]": 1e9}  # so that only the distance matters
    values = problem.log_likelihood(theta, huge)
    values = values - values[0]
    fold, _ = folds(theta)
    expected = -0.5 * (np.maximum(0.2 - fold, 0.0) / (1e-4 * 0.2)) ** 2
    assert fold[0] > 0.2 > fold[-1]
    assert values == pytest.approx(expected, abs=0.05 + 0.02 * np.abs(expected).max())
    assert np.all(np.diff(values) < 1e-6)


def test_derivatives_at_a_fold_are_those_of_the_residuals():
    rows = np.array([0.15, 0.18, 0.199, 0.2])
    problem = problem_of(rows, swept(rows, "up"), "up")
    density = problem.density().with_settings(solver=ResponseSolver.start(problem, THETA), coordinates="natural")
    beyond = THETA * [1.05, 1.0, 1.0]
    here = density.linearise(beyond)
    assert here.beyond and here.converged
    for p, step in enumerate(1e-4 * beyond):
        ends = [density.linearise(beyond + sign * step * np.eye(3)[p]).residuals for sign in (1, -1)]
        for block, (up, down) in enumerate(zip(*ends, strict=True)):
            slope = -(up - down) / (2 * step)
            assert here.jacobian[block][p] == pytest.approx(slope, rel=2e-3, abs=2e-3 * (1 + np.abs(slope).max()))


def test_the_gradient_beyond_a_fold_points_back():
    rows = np.array([0.15, 0.18, 0.199, 0.2])
    problem = problem_of(rows, swept(rows, "up"), "up").anchored(dict(zip(("c", "k", "k3"), THETA, strict=True)))
    value, gradient = problem.value_and_gradient(THETA * [1.05, 1.0, 1.0], {"variance[displacement]": 0.01})
    assert np.isfinite(value) and gradient[0] < 0.0


def test_a_solver_anchored_beyond_the_fold_returns_to_the_branch():
    rows = np.array([0.15, 0.18, 0.199, 0.2])
    solver = ResponseSolver.start(problem_of(rows, swept(rows, "up"), "up"), THETA)
    there = solver.anchored(THETA * [1.05, 1.0, 1.0])
    again, frequencies, _ = predicted(there)
    assert frequencies.tolist() == rows.tolist() and again == pytest.approx(swept(rows, "up"), abs=1e-3)


def test_the_posterior_is_that_of_harmonic_balance_with_the_fold_as_its_end():
    """At 200 θ around a posterior that a point just below the fold cuts off: the same density up to a constant.

    Where a sheet ends within five resolutions of the point, the two differ by construction.
    """
    rows, sd = np.array([0.12, 0.15, 0.17, 0.185, 0.195, 0.1985, 0.20015]), 0.03
    data = noisy(swept(rows, "up"), sd, 3)
    samples = 64
    known = {"m": 1.0, "variance[displacement]": samples / 2 * sd**2}
    problem = problem_of(rows, data, "up", fixed=known).anchored(dict(zip(("c", "k", "k3"), THETA, strict=True)))
    spread = np.array([[1e-4, 0.0, 0.0], [0.0, 4e-4, -8e-4], [0.0, -8e-4, 2.2e-3]])
    rng = np.random.default_rng(1)
    theta = np.exp(np.log([0.0999, 1.035, 0.281]) + rng.multivariate_normal(np.zeros(3), spread, 200))
    found = problem.log_likelihood(theta, {"variance[displacement]": known["variance[displacement]"]})
    fine = np.linspace(0.1, 2.2, 500)
    f, amplitude = harmonic_balance(*theta.T, fine)
    top, expected = np.argmax(f, axis=0), np.empty(200)
    for k, last in enumerate(top):
        part = slice(0, last + 1)
        parts = [np.interp(rows, f[part, k], values[part, k]) for values in (amplitude.real, amplitude.imag)]
        expected[k] = -0.5 * np.sum(np.abs(data - parts[0] - 1j * parts[1]) ** 2) / sd**2
    margin = (f.max(axis=0) - rows[-1]) / (1e-4 * rows[-1])
    inside, outside = margin > 0.1, margin < -5.0
    assert inside.sum() > 50 and outside.sum() > 20
    offset = found[inside] - expected[inside]
    assert np.ptp(offset) < 0.05
    assert np.all(found[outside] - expected[outside] - offset.mean() < -5.0)
