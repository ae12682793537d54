"""White noise on recordings of 119 samples a cycle, folded to n = 800: do 90 % intervals cover 90 %.

300 recordings each; the count of covered truths must lie in the two-sided 99 % binomial band (a false-alarm rate of 1 %
a number of harmonics).
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from tests.known import LINEAR, linear_regressors

RECORDINGS = 300
FREQUENCY, PER_CYCLE, CYCLES, AMPLITUDE = 2.0, 119.37, 6, 0.05
TRUTH = np.array([900.0, 40.0, 25.0])
FLAT = {"k": bp.Normal(900.0, 1e5), "coulomb": bp.Normal(25.0, 1e4)}
BAND = stats.binom.ppf([0.005, 0.995], RECORDINGS, 0.9)


@cache
def folded(harmonics: int) -> list[bp.Experiment]:
    time = np.arange(int(CYCLES * PER_CYCLE) + 2) / (PER_CYCLE * FREQUENCY)
    clean = linear_regressors(AMPLITUDE, FREQUENCY, FREQUENCY * time) @ TRUTH
    x = AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * time)
    generator = np.random.default_rng(harmonics)
    return [
        bp.Recording.from_arrays(time, {"force": clean + 10.0 * generator.standard_normal(time.size)}, {"x": x}).fold(
            800, harmonics=harmonics
        )
        for _ in range(RECORDINGS)
    ]


def covered(experiments: list[bp.Experiment]) -> int:
    count = 0
    for experiment in experiments:
        fit = bp.map_estimate(bp.Problem(LINEAR, [experiment], priors=FLAT, fixed={"c": TRUTH[1]}), progress=False)
        low, high = fit.interval(0.9)["coulomb"]
        count += low < TRUTH[2] < high
    return count


@pytest.mark.slow
@pytest.mark.parametrize("harmonics", [5, 20, 40])
def test_interval_of_a_friction_regressor_has_nominal_coverage(harmonics):
    assert BAND[0] <= covered(folded(harmonics)) <= BAND[1]


@pytest.mark.slow
def test_interval_without_projection_misses_nominal_coverage():
    assert not BAND[0] <= covered([replace(e, harmonics={}) for e in folded(5)]) <= BAND[1]


@pytest.mark.slow
def test_counting_every_sample_makes_the_interval_undercover():
    naive = [replace(e, independent={"force": 800}) for e in folded(20)]
    assert covered(naive) < BAND[0]
