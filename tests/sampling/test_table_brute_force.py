"""Posteriors of response tables against the density on a grid, whose orbits SciPy finds by shooting."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.special import i0e, logsumexp

import bayesperiodic as bp
from tests.response_tables import FORCE, PRIORS, TRUTH, harmonic_balance, noisy, swept

SIDE, WIDTH = 13, 4.5  # points of the grid along each axis, and its half width [standard deviations]
STEPS, TOLERANCE = 8, 1e-9
NAMES = [*PRIORS]


def shot(values, frequency, force, first):
    """Return first harmonics of x'' + c x' + k x + k3 x³ = force·cos(2π f t) for θ (sets, 3), by Newton's method.

    All sets are integrated together with their variational equations, from x and x' `first` (2,) or (2, sets).
    """
    c, k, k3 = values.T
    sets, omega = len(values), 2 * np.pi * frequency
    start = np.array(np.broadcast_to(np.reshape(first, (2, -1)), (2, sets)))

    def rates(t, state):
        x, v, *rest, _, _ = state.reshape(8, sets)
        matrix, stiff = np.reshape(rest, (2, 2, sets)), k + 3 * k3 * x**2
        a = force * np.cos(omega * t) - c * v - k * x - k3 * x**3
        turned = np.exp(-1j * omega * t) * x * 2 * frequency
        changes = [matrix[1], -c * matrix[1] - stiff * matrix[0]]
        return np.concatenate([v, a, *np.reshape(changes, (4, sets)), turned.real, turned.imag])

    for _ in range(STEPS):
        unit = np.repeat([1.0, 0.0, 0.0, 1.0], sets).reshape(4, sets)
        state = np.concatenate([*start, *unit, np.zeros(2 * sets)])
        end = solve_ivp(rates, (0.0, 1.0 / frequency), state, method="DOP853", rtol=1e-9, atol=1e-9).y[:, -1]
        x, v, *rest, real, imaginary = end.reshape(8, sets)
        matrix = np.moveaxis(np.reshape(rest, (2, 2, sets)), -1, 0) - np.eye(2)
        gap = np.array([x, v]) - start
        start = start - np.linalg.solve(matrix, gap.T[..., None])[..., 0].T
        if np.abs(gap).max() < TOLERANCE:
            return real + 1j * imaginary, start
    raise AssertionError(f"the shooting has not converged at {frequency}")


def log_likelihoods(values, measured, force, firsts, sd, *, phases):
    """Return the log-likelihoods (sets,) of complex amplitudes, or of their moduli by the distribution of Rice."""
    total = np.zeros(len(values))
    for (f, y), first in zip(measured, firsts, strict=True):
        c, _ = shot(values, f, force, first)
        if phases:
            total -= np.abs(y - c) ** 2 / (2 * sd**2)
        else:
            total += -((abs(y) - np.abs(c)) ** 2) / (2 * sd**2) + np.log(i0e(abs(y) * np.abs(c) / sd**2))
    return total


def marginal(fit, log_likelihood, name):
    """Return the logarithm of a parameter's marginal density over its logarithm, as a spline, and where it is known.

    The grid follows the Laplace approximation, with this parameter along its first axis: so sums over the others,
    which are exact to within rounding errors for smooth densities, give the marginal density.
    """
    names = [name, *(other for other in NAMES if other != name)]
    mode = np.log([fit.joint_mode[one] for one in names])
    axes = np.linalg.cholesky(fit.joint_covariance.loc[names, names].to_numpy())
    line = np.linspace(-WIDTH, WIDTH, SIDE)
    u = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    logs = mode + u @ axes.T
    prior = sum(-0.5 * ((logs[:, i] - np.log(PRIORS[n].median)) / PRIORS[n].spread) ** 2 for i, n in enumerate(names))
    values = np.exp(logs[:, [names.index(one) for one in NAMES]])
    log_density = (log_likelihood(values) + prior).reshape(SIDE, -1)
    x = mode[0] + line * axes[0, 0]
    return CubicSpline(x, logsumexp(log_density, axis=1) - log_density.max()), x


def check(problem, fit, log_likelihood, seed):
    """Compare mean, standard deviation and 5 and 95 % quantiles of draws with those of the grid."""
    draws = bp.sample(problem, fit, seed=seed, progress=False)
    assert draws.converged
    for name in NAMES:
        spline, x = marginal(fit, log_likelihood, name)
        fine = np.linspace(x[0], x[-1], 2001)
        weights = np.exp(spline(fine))
        weights /= weights.sum()
        mean = weights @ fine
        sd = np.sqrt(weights @ (fine - mean) ** 2)
        sampled, size = np.log(draws.draws(name).ravel()), draws.summary().loc[name, "ess"]
        # Four Monte Carlo errors of a normal posterior: exceeded by one of 1,300 runs (12 comparisons).
        assert abs(sampled.mean() - mean) < 4 * sd / np.sqrt(size)
        assert abs(sampled.std() / sd - 1.0) < 4 / np.sqrt(2 * size)
        for level in (0.05, 0.95):
            below = np.interp(np.quantile(sampled, level), fine, np.cumsum(weights))
            assert abs(below - level) < 4 * np.sqrt(level * (1 - level) / size)


def first_states(frequencies, amplitudes):
    """Return displacement and velocity at t = 0 by the first harmonic, from which the shooting starts."""
    return [(a.real, -2 * np.pi * f * a.imag) for f, a in zip(frequencies, amplitudes, strict=True)]


@pytest.mark.slow
def test_amplitudes_alone_without_a_fold():
    """Amplitudes of a weakly forced oscillator, whose response has one branch."""
    force, sd, rows = 0.02, 0.004, np.linspace(0.14, 0.18, 14)
    f, c = (part[:, 0] for part in harmonic_balance(*(TRUTH[name] for name in NAMES), force=force))
    assert np.all(np.diff(f) > 0.0)
    exact = np.interp(rows, f, c.real) + 1j * np.interp(rows, f, c.imag)
    sizes = np.abs(noisy(exact, sd, 3))
    columns = {"frequency": "f", "outputs": {"displacement": "A"}, "inputs": {"force": force}}
    runs = bp.response_table({"f": rows, "A": sizes}, **columns, sd={"displacement": sd})
    problem = bp.Problem(bp.models.duffing, runs, priors=PRIORS, fixed={"m": 1.0})
    measured, starts = [*zip(rows, sizes, strict=True)], first_states(rows, exact)

    def log_likelihood(values):
        return log_likelihoods(values, measured, force, starts, sd, phases=False)

    check(problem, bp.map_estimate(problem, progress=False), log_likelihood, seed=1)


@pytest.mark.slow
def test_amplitudes_and_phases_on_both_sides_of_a_fold():
    """A sweep through a jump; the errors are so small that no point of the grid loses an orbit."""
    sd, rows = 0.01, np.array([0.1, 0.12, 0.14, 0.15, 0.16, 0.17, 0.18, 0.19, 0.195, 0.205, 0.21, 0.22, 0.24, 0.26])
    exact = swept(rows, "up")
    table = noisy(exact, sd, 4)
    columns = {"frequency": "f", "outputs": {"displacement": "c"}, "inputs": {"force": FORCE}}
    runs = bp.response_table({"f": rows, "c": table}, **columns, sweep="up")
    # The variance is that of each of the samples, whose mean errors of a harmonic's two parts are given.
    known = {"variance[displacement]": runs[0].samples / 2 * sd**2}
    problem = bp.Problem(bp.models.duffing, runs, priors=PRIORS, fixed={"m": 1.0} | known)
    measured, starts = [*zip(rows, table, strict=True)], first_states(rows, exact)

    def log_likelihood(values):
        return log_likelihoods(values, measured, FORCE, starts, sd, phases=True)

    check(problem, bp.map_estimate(problem, progress=False), log_likelihood, seed=2)
