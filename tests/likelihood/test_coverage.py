"""Coverage of 90 % intervals with correlated and with white errors, and the split of the residuals.

Recordings of 119 samples a cycle with a first-order autoregressive process, ρ = 0.9 from sample to sample, or with
white noise, folded to n = 800. 200 each; the count of covered truths must lie in the two-sided 99 % binomial band (a
false-alarm rate of 1 % each).
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import signal, stats

import bayesperiodic as bp
from bayesperiodic import noise
from bayesperiodic.estimation.result import NoiseSplit
from bayesperiodic.estimation.unexplained import of_periodogram
from tests.known import LINEAR, grid, linear_regressors

RECORDINGS, HARMONICS = 200, 20
FREQUENCY, PER_CYCLE, AMPLITUDE, SD = 2.0, 119.37, 0.05, 10.0
TRUTH = {"k": 900.0, "coulomb": 25.0}
DAMPING, CORRELATION = 40.0, 0.9
THETA = np.array([TRUTH["k"], DAMPING, TRUTH["coulomb"]])
FLAT = {"k": bp.Normal(900.0, 1e5), "coulomb": bp.Normal(25.0, 1e4)}
BAND = stats.binom.ppf([0.005, 0.995], RECORDINGS, 0.9)
COUNT = 2 * HARMONICS + 1


@cache
def folded(correlation: float, cycles: int, recordings: int = RECORDINGS) -> list[bp.Experiment]:
    time = np.arange(int(cycles * PER_CYCLE) + 2) / (PER_CYCLE * FREQUENCY)
    tau = FREQUENCY * time
    clean = linear_regressors(AMPLITUDE, FREQUENCY, tau) @ THETA
    x = AMPLITUDE * np.sin(2 * np.pi * tau)
    white = np.random.default_rng(1).standard_normal((recordings, 500 + time.size))
    errors = SD * np.sqrt(1.0 - correlation**2) * signal.lfilter([1.0], [1.0, -correlation], white)[:, 500:]
    return [
        bp.Recording.from_arrays(time, {"force": clean + e}, {"x": x}).fold(
            800, harmonics=HARMONICS, frequency=FREQUENCY
        )
        for e in errors
    ]


def fitted(experiment: bp.Experiment, model="independent", *, checks=True, **fixed: float) -> bp.MapEstimate:
    problem = bp.Problem(LINEAR, [experiment], priors=FLAT, fixed={"c": DAMPING} | fixed, noise=model)
    return bp.map_estimate(problem, starts=1, checks=checks, progress=False)  # linear


@cache
def all_fitted(correlation: float, cycles: int, model="independent") -> tuple[dict[tuple[str, bool], int], list[float]]:
    """Return how many intervals held their truth, by parameter and by whether they were robust, and all whiteness p."""
    count, p = {(name, robust): 0 for name in TRUTH for robust in (False, True)}, []
    for experiment in folded(correlation, cycles):
        fit = fitted(experiment, model)
        p.append(fit.whiteness["force"].p)
        for name, robust in count:
            low, high = fit.interval(0.9, robust=robust)[name]
            count[name, robust] += low < TRUTH[name] < high
    return count, p


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TRUTH))
def test_independent_noise_undercovers_with_correlated_errors(name):
    assert all_fitted(CORRELATION, 20)[0][name, False] < 0.6 * RECORDINGS


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TRUTH))
def test_robust_intervals_have_nominal_coverage_with_correlated_errors(name):
    assert BAND[0] <= all_fitted(CORRELATION, 20)[0][name, True] <= BAND[1]


@pytest.mark.campaign
@pytest.mark.parametrize("name", list(TRUTH))
@pytest.mark.parametrize("robust", [False, True])
def test_circulant_noise_has_nominal_coverage_with_correlated_errors(name, robust):
    """The true spectrum is that of the exponential kernel up to O(1/20); the length is estimated."""
    assert BAND[0] <= all_fitted(CORRELATION, 20, noise.Circulant(kernel="exponential"))[0][name, robust] <= BAND[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TRUTH))
@pytest.mark.parametrize("robust", [False, True])
def test_both_intervals_have_nominal_coverage_with_white_errors(name, robust):
    assert BAND[0] <= all_fitted(0.0, 6)[0][name, robust] <= BAND[1]


def test_robust_sd_equals_the_prior_sd_if_the_prior_dominates():
    experiment = folded(0.0, 6, 1)[0]
    priors = {"k": bp.Normal(900.0, 1e-3), "coulomb": bp.Normal(25.0, 1e-5)}
    fit = bp.map_estimate(bp.Problem(LINEAR, [experiment], priors=priors, fixed={"c": DAMPING}), progress=False)
    assert list(fit.robust_sd.values()) == pytest.approx([1e-3, 1e-5], rel=1e-6)


def stationary_on_the_circle(lengthscale: float, seed: int) -> bp.Experiment:
    """Return an experiment whose kept harmonics have errors with the exponential kernel's spectrum."""
    tau, generator = grid(200), np.random.default_rng(seed)
    harmonic = np.arange(HARMONICS + 1)
    power = 1.0 / (1.0 + (2 * np.pi * np.minimum(np.arange(200), 200 - np.arange(200)) * lengthscale) ** 2)
    power = power[: HARMONICS + 1] / power.sum()
    cosine, sine = generator.standard_normal((2, harmonic.size)) * np.sqrt(power * np.where(harmonic, 2.0, 1.0))
    waves = 2 * np.pi * np.outer(tau, harmonic)
    clean = linear_regressors(AMPLITUDE, FREQUENCY, tau) @ THETA
    return bp.Experiment(
        "run",
        FREQUENCY,
        {"force": clean + SD * (np.cos(waves) @ cosine + np.sin(waves) @ sine)},
        {"x": AMPLITUDE * np.sin(2 * np.pi * tau)},
        samples=200,
        harmonics={"force": HARMONICS},
    )


@pytest.mark.slow
def test_residuals_whitened_by_the_true_noise_are_white():
    """Uniform p from 300 runs with known noise parameters (KS at 0.1 %); before whitening hardly any passes 1 %."""
    known = {"variance[force]": SD**2, "lengthscale[force]": 0.08}
    runs = [stationary_on_the_circle(0.08, seed) for seed in range(300)]
    fits = [fitted(run, noise.Circulant(kernel="exponential"), **known) for run in runs]
    assert stats.kstest([fit.whiteness["force"].p for fit in fits], "uniform").pvalue > 1e-3
    raw = [of_periodogram(np.abs(np.fft.rfft(fit.residuals["run"]["force"])[1 : HARMONICS + 1]) ** 2).p for fit in fits]
    assert np.mean(np.array(raw) < 0.01) > 0.5


@pytest.mark.slow
def test_residuals_of_white_noise_are_white():
    """Uniform p from 200 folded recordings, KS at 0.1 %."""
    assert stats.kstest(all_fitted(0.0, 6)[1], "uniform").pvalue > 1e-3


@cache
def splits(amplitude: float) -> list[NoiseSplit]:
    """Return the noise splits of 100 recordings of white noise with an unmodelled harmonic 8 of this amplitude."""
    wave = amplitude * np.cos(2 * np.pi * 8 * grid(800) + 0.3)
    runs = [replace(e, outputs={"force": e.outputs["force"] + wave}) for e in folded(0.0, 20, 100)]
    return [fitted(run).noise_split["force"] for run in runs]


@pytest.mark.slow
def test_measurement_noise_is_that_of_the_mean_of_20_cycles():
    """Each sd of 19 · 41 degrees of freedom is within four standard errors, of 100 (a false-alarm rate of 0.6 %).

    A few recordings lose cycles to what could be the rest of a transient, or its square is added: in the mean the
    stated sd is about 1 % too large, and at most 2 %.
    """
    cycles = np.array([e.cycles for e in folded(0.0, 20, 100)])
    assert np.mean(cycles) > 19.0 and np.median(cycles) == 20
    ratio = np.array([split.measurement for split in splits(0.0)]) / (SD * np.sqrt(COUNT / (cycles * PER_CYCLE)))
    away = (ratio - 1.0) * np.sqrt(2 * (cycles - 1) * COUNT)
    assert away.min() > -4.0 and np.count_nonzero(away > 4.0) <= 5
    error = 4.0 / np.sqrt(2 * 19 * COUNT * ratio.size)
    assert 1.0 - error < ratio.mean() < 1.02 + error


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.0, 4.0])
def test_model_error_is_the_excess_over_measurement_noise(amplitude):
    """The mean of total² less measured² over 100 recordings is amplitude²/2 within four standard errors.

    The wave is in none of the regressors, which have odd harmonics only, so that eq. (7) raises its share by 41/39.
    """
    found = splits(amplitude)
    excess = np.array([split.total**2 - split.measurement**2 for split in found])
    expected = 0.5 * amplitude**2 * COUNT / (COUNT - 2)
    assert abs(excess.mean() - expected) < 4.0 * excess.std(ddof=1) / 10.0
    assert [split.model**2 for split in found] == pytest.approx(np.maximum(excess, 0.0), rel=1e-9, abs=1e-12)


@cache
def with_white_noise(harmonics: int) -> list[bp.Experiment]:
    """Return recordings of six cycles with white noise, folded with an estimated frequency."""
    time = np.arange(int(6 * PER_CYCLE) + 2) / (PER_CYCLE * FREQUENCY)
    clean = linear_regressors(AMPLITUDE, FREQUENCY, FREQUENCY * time) @ THETA
    x, generator = AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * time), np.random.default_rng(harmonics)
    noisy = [clean + SD * generator.standard_normal(time.size) for _ in range(RECORDINGS)]
    return [bp.Recording.from_arrays(time, {"force": y}, {"x": x}).fold(800, harmonics=harmonics) for y in noisy]


def covered(experiments: list[bp.Experiment]) -> int:
    ends = [fitted(experiment, checks=False).interval(0.9)["coulomb"] for experiment in experiments]
    return sum(low < TRUTH["coulomb"] < high for low, high in ends)


@pytest.mark.slow
@pytest.mark.parametrize("harmonics", [5, 40])
def test_interval_of_a_friction_regressor_has_nominal_coverage(harmonics):
    assert BAND[0] <= covered(with_white_noise(harmonics)) <= BAND[1]


@pytest.mark.slow
def test_interval_without_projection_misses_nominal_coverage():
    assert not BAND[0] <= covered([replace(e, harmonics={}) for e in with_white_noise(5)]) <= BAND[1]


@pytest.mark.slow
def test_counting_every_sample_makes_the_interval_undercover():
    assert covered([replace(e, independent={"force": 800}) for e in with_white_noise(40)]) < BAND[0]
