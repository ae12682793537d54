"""Estimates from response tables of several systems against least squares in SciPy on responses by harmonic balance.

The tables are those of a sweep: SciPy integrates the equation of motion in time at each row, from where the row before
has ended. Amplitudes have normal errors of known size.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares, root

import bayesperiodic as bp

ORDERS, POINTS, ERROR = np.arange(14), 64, 0.003
WAVES = np.exp(2j * np.pi * np.outer(np.arange(POINTS) / POINTS, ORDERS))
WEIGHTS = np.where(ORDERS == 0, 1.0, 2.0) / POINTS


def model_of(name, parameters, force_of):
    """Return x'' + f(x, x'; θ) = force."""
    return bp.Model(
        name,
        states=["x"],
        inputs=["force"],
        parameters=dict.fromkeys(parameters, "1"),
        equations=lambda s, p, u: [s.ddx + force_of(s.x, s.dx, *(p[one] for one in parameters)) - u.force],
        outputs=lambda s, p, u: {"x": s.x},
    )


def cubic(x, v, c, k, k3):
    return c * v + k * x + k3 * x**3


def asymmetric(x, v, c, k, k2, k3):
    return c * v + k * x + k2 * x**2 + k3 * x**3


def van_der_pol(x, v, mu, k):
    return -mu * (1 - x**2) * v + k * x


class Table(NamedTuple):
    """Equation, truth, relative standard deviations of the priors, and rows in the order of the sweep."""

    force_of: object
    truth: dict
    spread: float
    frequency: np.ndarray
    force: np.ndarray
    sweep: str
    settling: int = 80  # periods
    start: tuple = (0.0, 0.0)
    samples: int = 64


def rows(first, last, count, force):
    """Return frequencies, and equal forces."""
    return np.linspace(first, last, count), np.full(count, force)


DUFFING, SOFTENING = {"c": 0.1, "k": 1.0, "k3": 0.3}, {"c": 0.1, "k": 1.0, "k3": -0.1}
TABLES = {
    "level up": Table(cubic, DUFFING, 0.3, np.full(14, 0.2), np.linspace(0.05, 0.7, 14), "up"),
    "level down": Table(cubic, DUFFING, 0.3, np.full(13, 0.2), np.linspace(0.7, 0.05, 13), "down"),
    "softening, up": Table(cubic, SOFTENING, 0.3, *rows(0.11, 0.2, 15, 0.16), "up"),
    "softening, down": Table(cubic, SOFTENING, 0.3, *rows(0.2, 0.11, 15, 0.16), "down"),
    "asymmetric": Table(
        asymmetric, {"c": 0.12, "k": 1.0, "k2": 0.3, "k3": 0.3}, 0.3, *rows(0.1, 0.24, 16, 0.15), "up"
    ),
    "van der Pol": Table(
        van_der_pol, {"mu": 0.4, "k": 1.0}, 0.3, *rows(0.13, 0.19, 13, 1.0), "up", 150, (1.0, 0.0), 128
    ),
}  # fmt: skip


def integrated(table):
    """Return complex amplitudes (rows, orders) of the steady motion at each row, by time integration."""
    state, result, values = np.array(table.start), [], tuple(table.truth.values())
    for f, force in zip(table.frequency, table.force, strict=True):

        def rates(t, s, f=f, force=force):
            return s[1], force * np.cos(2 * np.pi * f * t) - table.force_of(s[0], s[1], *values)

        times = (table.settling + np.arange(POINTS + 1) / POINTS) / f
        run = solve_ivp(rates, (0.0, times[-1]), state, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-9)
        assert np.allclose(run.y[:, 0], run.y[:, -1], atol=1e-5)
        state = run.y[:, -1]
        result.append(WEIGHTS * (WAVES.conj().T @ run.y[0, :-1]))
    return np.array(result)


def balanced(table, values, starts):
    """Return complex amplitudes (rows, orders) by harmonic balance, from starts."""
    result = []
    for f, force, start in zip(table.frequency, table.force, starts, strict=True):
        omega = 2 * np.pi * f

        def residual(u, omega=omega, force=force):
            c = u[: ORDERS.size] + 1j * np.concatenate([[0.0], u[ORDERS.size :]])
            x, v = np.real(WAVES @ c), np.real(WAVES @ (1j * omega * ORDERS * c))
            left = WEIGHTS * (WAVES.conj().T @ table.force_of(x, v, *values)) - (omega * ORDERS) ** 2 * c
            left[1] -= force
            return np.concatenate([left.real, left.imag[1:]])

        solved = root(residual, np.concatenate([start.real, start.imag[1:]]), options={"xtol": 1e-11})
        assert np.abs(solved.fun).max() < 1e-7
        result.append(solved.x[: ORDERS.size] + 1j * np.concatenate([[0.0], solved.x[ORDERS.size :]]))
    return np.array(result)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TABLES))
def test_estimates_are_those_of_least_squares_on_responses_by_harmonic_balance(name):
    """Within a fiftieth of a standard deviation, and the standard deviations within a hundredth.

    The prior medians are 10 % above the truth; amplitudes have errors of 0.003, so that their distribution is normal.
    """
    table = TABLES[name]
    exact = integrated(table)
    sizes = np.abs(exact[:, 1]) + ERROR * np.random.default_rng(1).standard_normal(len(exact))
    columns = {"f": table.frequency, "F": table.force, "A": sizes}
    runs = bp.response_table(
        columns, frequency="f", outputs={"x": "A"}, inputs={"force": "F"}, sd={"x": ERROR}, sweep=table.sweep,
        samples=table.samples,
    )  # fmt: skip
    priors = {p: bp.Normal(1.1 * value, table.spread * abs(value)) for p, value in table.truth.items()}
    model = model_of(name.replace(",", "").replace(" ", "_"), list(table.truth), table.force_of)
    fit = bp.map_estimate(bp.Problem(model, runs, priors=priors), progress=False)

    def residuals(values):
        amplitude = np.abs(balanced(table, values, exact)[:, 1])
        prior = [(v - 1.1 * t) / (table.spread * abs(t)) for v, t in zip(values, table.truth.values(), strict=True)]
        return np.concatenate([(sizes - amplitude) / ERROR, prior])

    reference = least_squares(residuals, list(table.truth.values()), x_scale=np.abs(list(table.truth.values())))
    sd = np.sqrt(np.diag(np.linalg.inv(reference.jac.T @ reference.jac)))
    assert fit.converged
    off = (np.array([fit.theta[p] for p in table.truth]) - reference.x) / sd
    assert np.abs(off).max() < 0.02
    assert [fit.sd[p] for p in table.truth] == pytest.approx(sd, rel=0.01)


@pytest.mark.parametrize("start", [None, {"c": 0.05, "k": 1.0, "k3": -0.15}])
def test_estimates_start_on_the_sheets_that_fit_best(start):
    """At the prior median the peak is that of a linear spring; with less damping than the truth it does not end.

    Then the branch from the first row does not lead to the last ones. Within 4.5 standard deviations: 2e-5.
    """
    truth = {"c": 0.05, "k": 1.0, "k3": -0.15}
    table = Table(cubic, truth, 0.3, *rows(0.18, 0.12, 25, 0.06), "down", settling=120)
    noise = 0.01 * np.random.default_rng(3).standard_normal(25)[::-1]
    columns = {"f": table.frequency, "A": np.abs(integrated(table)[:, 1]) * (1 + noise)}
    runs = bp.response_table(
        columns, frequency="f", outputs={"x": "A"}, inputs={"force": 0.06}, sd={"x": "1%"}, sweep="down", samples=128
    )
    priors = {"c": bp.LogNormal(0.08, 1), "k": bp.LogNormal(1, 0.3), "k3": bp.Normal(0, 0.3)}
    model = model_of("softening_to_the_end", list(truth), cubic)
    fit = bp.map_estimate(bp.Problem(model, runs, priors=priors), start=start, progress=False)
    assert fit.converged and not fit.misspecified
    for name, value in truth.items():
        assert abs(fit.theta[name] - value) < 4.5 * fit.sd[name]


def test_points_are_found_that_the_branch_from_the_first_one_does_not_lead_to():
    """With little damping a softening peak has no fold in the table: the last points have a branch of their own.

    They are compared with time integration from rest.
    """
    theta = {"c": 0.04, "k": 1.0, "k3": -0.16}
    table = Table(cubic, {"c": 0.05, "k": 1.0, "k3": -0.15}, 0.3, *rows(0.18, 0.12, 25, 0.06), "down", settling=120)
    columns = {"f": table.frequency, "A": np.abs(integrated(table)[:, 1])}
    runs = bp.response_table(
        columns, frequency="f", outputs={"x": "A"}, inputs={"force": 0.06}, sd={"x": "1%"}, sweep="down", samples=128
    )
    priors = {name: bp.Normal(value, 0.01) for name, value in theta.items()}  # whose medians are the first anchors
    problem = bp.Problem(model_of("softening_without_end", list(theta), cubic), runs, priors=priors)
    orbits = sorted(problem.solve(theta).values(), key=lambda orbit: orbit.frequency)
    amplitude = [2 * np.abs(np.fft.rfft(orbit.outputs["x"])[1]) / orbit.outputs["x"].size for orbit in orbits]
    low = integrated(table._replace(truth=theta, frequency=np.linspace(0.12, 0.14, 9), force=np.full(9, 0.06)))
    assert amplitude[:9] == pytest.approx(np.abs(low[:, 1]), rel=0.01)
    assert min(amplitude[9:14]) > 0.8
