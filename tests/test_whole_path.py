"""From a time integration to the parameters that it was made with: fold, periodic solver and estimator together."""

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import grid

TRUTH = {"Kx": 768.0, "K": 300.0, "F0": -3.0, "Kw": 57.4, "rho": 27_500.0}
PRIORS = {
    "Kx": bp.LogNormal(1e3, 1.0),
    "K": bp.Normal(0.0, 5e3),
    "F0": bp.Normal(0.0, 50.0),
    "Kw": bp.LogNormal(50.0, 1.0),
    "rho": bp.LogNormal(2e4, 1.5),
}


@pytest.mark.filterwarnings("ignore:Twice as many points")
def test_parameters_of_a_noise_free_dahl_damper_are_recovered():
    """Discretisation, folding and the finite number of harmonics together stay below 0.1 % of the friction terms."""
    displacement = 0.0126 * np.cos(2 * np.pi * grid(64)) + 0.0004 * np.sin(6 * np.pi * grid(64))
    recording = bp.simulate(
        bp.models.dahl, TRUTH, {"displacement": displacement}, frequency=0.8397, duration=8.0, sampling_rate=100.0
    )
    experiment = recording.fold(1600, harmonics=40)
    fit = bp.map_estimate(bp.Problem(bp.models.dahl, [experiment], priors=PRIORS))
    assert experiment.frequency == pytest.approx(0.8397, rel=1e-8)
    for name in ("Kx", "Kw", "rho"):
        assert fit.theta[name] == pytest.approx(TRUTH[name], rel=1e-3)
    assert fit.theta["K"] == pytest.approx(300.0, abs=3.0)
    assert fit.theta["F0"] == pytest.approx(-3.0, abs=1e-3 * 57.4)
