"""Parameters of which the data know only the square."""

import warnings
from typing import Any

import numpy as np
import pytest

import bayesperiodic as bp

EVEN = bp.Model(
    "even",
    states=["x"],
    inputs=["force"],
    parameters={"c": "N s/m", "k": "N/m", "k2": "N/m²"},
    equations=lambda s, p, u: [s.ddx + p.c * s.dx + p.k * s.x + p.k2 * s.x**2 - u.force],
    outputs=lambda s, p, u: {"x": s.x},
    units={"x": "m", "force": "N"},
)
SAMPLES, FORCE, SD = 32, 0.05, 0.003


def problem(prior: Any, *, phases: bool = False) -> bp.Problem:
    """Return a table of amplitudes of a linear oscillator, with errors; or its recorded periods."""
    frequency, rng = np.linspace(0.1, 0.22, 9), np.random.default_rng(1)
    omega = 2 * np.pi * frequency
    response = FORCE / (1.0 - omega**2 + 0.1j * omega)
    noisy = response + SD * (rng.standard_normal(9) + 1j * rng.standard_normal(9))
    given = {"priors": {"c": bp.LogNormal(0.1, 0.5), "k": bp.LogNormal(1.0, 0.2), "k2": prior}, "scheme": "central4"}
    wave = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    if phases:
        runs = [
            bp.Experiment(f"{f:.3f}", float(f), {"x": np.real(a * np.exp(1j * wave))}, {"force": FORCE * np.cos(wave)},
                          samples=SAMPLES)
            for f, a in zip(frequency, noisy, strict=True)
        ]  # fmt: skip
        return bp.Problem(EVEN, runs, fixed={"variance[x]": SD**2}, **given)
    table = {"f": frequency, "A": np.abs(noisy), "sd": np.full(9, SD)}
    runs = bp.response_table(
        table, frequency="f", outputs={"x": "A"}, inputs={"force": FORCE}, sd={"x": "sd"}, samples=SAMPLES
    )
    return bp.Problem(EVEN, runs, **given)


def texts(one: bp.Problem) -> tuple[bp.MapEstimate, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = bp.map_estimate(one, starts=1, checks=False, progress=False)
    return fit, [str(entry.message) for entry in caught if "second order" in str(entry.message)]


def test_an_even_term_at_zero_is_warned_of_where_only_amplitudes_are_known():
    one = problem(bp.Normal(0.0, 0.5))
    fit, (text,) = texts(one)
    assert "'k2'" in text and "'c'" not in text and fit.sd["k2"] == pytest.approx(0.5, rel=1e-3)
    # The density itself: at half the standard deviation of the normal approximation it is far below its 0.125.
    ends = [{**fit.theta, "k2": k2} for k2 in (-0.25, 0.0, 0.25)]
    low, middle, high = (float(one.log_posterior(theta, {})) for theta in ends)
    assert low == pytest.approx(high, abs=1e-3) and middle - low > 5.0


@pytest.mark.parametrize("prior", [bp.Normal(0.0, 1e-3), bp.Normal(0.2, 0.5)])
def test_priors_within_which_nothing_changes_and_estimates_off_zero_are_not_warned_of(prior):
    assert texts(problem(prior))[1] == []


def test_recorded_periods_know_the_sign_of_an_even_term():
    assert texts(problem(bp.Normal(0.0, 0.5), phases=True))[1] == []
