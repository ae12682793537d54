import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import grid, linear_regressors


def test_band_has_its_closed_form_and_covers_the_data(solved):
    """The predictive variance of a linear model is v + xᵀ C x; 90 % of the 40 samples, binomial band at 99 %."""
    problem, fit, posterior = solved
    prediction = bp.predict(problem, posterior, draws=1000)
    design = linear_regressors(0.05, 2.0, grid(40))
    variance = posterior.draws("variance[force]").mean()
    sd = np.sqrt(variance + np.einsum("ni,ij,nj->n", design, fit.covariance.to_numpy(), design))
    low, high = prediction.low["run"]["force"], prediction.high["run"]["force"]
    assert (high - low) / 2 == pytest.approx(1.6449 * sd, rel=0.08)
    assert prediction.median["run"]["force"] == pytest.approx(design @ list(fit.theta.values()), abs=0.5)
    inside = np.sum((problem.experiments[0].outputs["force"] > low) & (problem.experiments[0].outputs["force"] < high))
    assert 30 <= inside <= 40
    assert prediction.failed == 0


def test_too_few_draws_are_refused(solved):
    problem, _, posterior = solved
    with pytest.raises(ValueError, match="draws: 5 is not allowed"):
        bp.predict(problem, posterior, draws=5)
