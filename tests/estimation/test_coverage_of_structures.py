"""Coverage of the intervals of a beam of 32 degrees of freedom, whose data an independent harmonic balance makes."""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from tests.periodic.test_condensed import FORCE, FREQUENCY, SAMPLES, VALUES, beam, harmonic_balance

SETS, PROBABILITY, NOISE = 100, 0.9, 0.02


@pytest.mark.slow
def test_intervals_of_a_beam_cover_the_truth():
    """Of 100 data sets, noise 2 % of each output's rms; each count is in its 99.7 % band: 1.2 % of false alarms."""
    exact, random, inside = harmonic_balance(32, 27), np.random.default_rng(66), []
    priors = {name: bp.LogNormal(1.3 * value, 1.0) for name, value in VALUES.items()}
    for _ in range(SETS):
        outputs = {n: y + NOISE * y.std() * random.standard_normal(SAMPLES) for n, y in exact.items()}
        experiment = bp.Experiment("run", FREQUENCY, outputs, {"force": FORCE}, samples=SAMPLES)
        fit = bp.map_estimate(bp.Problem(beam(32), [experiment], priors=priors), starts=1, checks=False, progress=False)
        assert fit.status == "converged"
        intervals = fit.interval(PROBABILITY)
        inside.append([intervals[n][0] < value < intervals[n][1] for n, value in VALUES.items()])
    counts = np.sum(inside, axis=0)
    low, high = stats.binom.interval(0.997, SETS, PROBABILITY)
    assert np.all((low <= counts) & (counts <= high)), counts
