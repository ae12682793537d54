"""The log-posterior where the conduction theta16 of the landing gear passes zero, at which ∂g/∂z is singular.

There the mean temperature of the gas decouples. Its limit exists, so that the log-posterior is smooth; solves that take
the factors of an anchor at theta16 = 2 must not show where they change their ways.
"""

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import GEAR, grid

SAMPLES, NEAREST, FARTHEST = 400, 0.002, 2.0
# Frequency [Hz], force amplitude about 6.6 kN [N], displacement amplitude about 0.12 m [m].
RUNS = ((0.3, 1100.0, 0.048), (1.0, 700.0, 0.021), (6.0, 600.0, 0.0021))
# 0.3 % of full scale in the mean of a thousand samples.
SD = {"displacement": 2e-6, "force": 2.0, "pressure": 250.0}


def problem(drive: str) -> bp.Problem:
    """Return three runs at the true parameters with noise, theta16 free, anchored at theta16 = 2."""
    model, wave, experiments = bp.models.landing_gear(drive), np.cos(2 * np.pi * grid(SAMPLES)), []
    generator = np.random.default_rng(1)
    for frequency, force, stroke in RUNS:
        signal = 6600.0 + force * wave if drive == "force" else 0.12 + stroke * wave
        true = bp.solve_periodic(model, GEAR, {drive: signal}, frequency=frequency, samples=SAMPLES, scheme="central4")
        outputs = {n: y + SD[n] * generator.standard_normal(SAMPLES) for n, y in true.outputs.items()}
        experiments.append(
            bp.Experiment(f"{frequency} Hz", frequency, outputs, {drive: signal}, samples=SAMPLES, synthetic=True)
        )
    fixed = {name: value for name, value in GEAR.items() if name != "theta16"}
    fixed |= {f"variance[{name}]": SD[name] ** 2 for name in model.outputs}
    return bp.Problem(
        model, experiments, priors={"theta16": bp.Normal(3.0, 20.0)}, fixed=fixed, scheme="central4"
    ).anchored({"theta16": 2.0})


@pytest.fixture(scope="module", params=["displacement", "force"])
def stated(request):
    """Return the problem and the tolerances of the density and its slope, relative to their ranges."""
    # Under a given force the discretised work of a cycle is not quite zero, and its error in the mean temperature is
    # divided by theta16: 2e-7 W even with this scheme, 5e-6 W with central2.
    return problem(request.param), *{"displacement": (5e-8, 1e-6), "force": (4e-6, 1e-3)}[request.param]


def log_posterior(stated: bp.Problem, values: np.ndarray) -> np.ndarray:
    return stated.log_posterior({"theta16": values}, {})


def both_sides(count: int) -> np.ndarray:
    """Return theta16 on a logarithmic grid on both sides of zero, ascending."""
    one = np.geomspace(NEAREST, FARTHEST, count)
    return np.concatenate([-one[::-1], one])


def test_log_posterior_is_smooth_through_the_singular_value(stated):
    """On 600 points a polynomial of degree 12 through zero leaves a few millionths of the density's range."""
    at, share, _ = stated
    values = both_sides(300)
    density = log_posterior(at, values)
    left = density - np.polynomial.Chebyshev.fit(values, density, 12)(values)
    assert np.abs(left).max() < share * np.ptp(density)


def test_gradient_equals_central_differences_of_the_log_posterior(stated):
    """Central differences over 1 % of theta16, at least 1e-3, from solves that start at the anchor at 2."""
    at, _, share = stated
    values = both_sides(12)
    step = np.maximum(0.01 * np.abs(values), 1e-3)
    slope = (log_posterior(at, values + step) - log_posterior(at, values - step)) / (2 * step)
    gradient = np.array([at.anchored({"theta16": v}).gradient({"theta16": v}, {})[0] for v in values])
    assert slope == pytest.approx(gradient, abs=share * np.abs(gradient).max())
