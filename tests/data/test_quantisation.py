"""Quantisation errors that repeat in every cycle: against simulated converters."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.quantisation import repeated_variance, rounded_step, step_of


def quantised(values, step, offset=0.0):
    return np.round((values + offset) / step) * step - offset


def ten_tones(per_cycle: int, noise: float, seed: int, cycles: int = 40):
    """Return τ, ten tones of random phases, and them with noise (in steps), quantised at an eighth of their sd."""
    generator, tau = np.random.default_rng(seed), np.arange(per_cycle * cycles) / per_cycle
    order = np.arange(1, 11)
    phases = generator.uniform(0, 2 * np.pi, 10)
    y = np.sum(np.cos(2 * np.pi * order[:, None] * tau + phases[:, None]) / order[:, None], axis=0)
    step = y.std() / 8
    noisy = y + noise * step * generator.standard_normal(tau.size)
    return tau, y, quantised(noisy, step, step * generator.uniform())


def test_steps_are_found_and_exact_values_have_none():
    generator = np.random.default_rng(0)
    values = np.cumsum(generator.standard_normal(2000))
    assert step_of(quantised(values, 0.01)) == pytest.approx(0.01)
    assert step_of(1e5 + quantised(values, 2.5e-3, 1e-3)) == pytest.approx(2.5e-3)
    assert step_of(values) == 0.0
    relay = np.where(values > 0.0, 1.0, -1.0)
    assert step_of(relay) == 0.0 and step_of(relay, fewest=2) == 2.0


@pytest.mark.parametrize("per_cycle", [20, 20.7])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_two_levels_are_rounded_if_noise_moves_their_changes(per_cycle, noise):
    """A comparator of a sine, 20 cycles; without noise before it, it is a square wave. Three levels are rounded."""
    phase = np.arange(int(20 * per_cycle)) / per_cycle
    sine = np.sin(2 * np.pi * phase + 0.1) + noise * np.random.default_rng(2).standard_normal(phase.size)
    assert rounded_step(np.where(sine > 0.3, 1.5, -0.5), phase) == (2.0 if noise else 0.0)
    assert rounded_step(np.round(sine), phase) == 1.0


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.1, 0.2, 0.3, 0.5])
def test_repeated_part_of_the_error_is_that_of_a_simulated_converter(noise):
    """400 places, 4000 samples each: the mean error of a place repeats, the rest is the scatter of its samples."""
    generator = np.random.default_rng(1)
    places = generator.uniform(-5.0, 5.0, 400)
    error = quantised(places[:, None] + noise * generator.standard_normal((400, 4000)), 1.0) - places[:, None]
    scatter = error.var(axis=1, ddof=1).mean()
    expected = np.mean(error.mean(axis=1) ** 2) - scatter / 4000
    found = repeated_variance(1.0, np.array([0.0, 400.0]), 1, scatter=scatter)
    assert found == pytest.approx(expected, abs=0.006)
    total = np.mean(error**2)
    assert repeated_variance(1.0, np.array([0.0, 400.0]), 1, residual=total) == pytest.approx(expected, abs=0.03)
    assert repeated_variance(1.0, np.array([0.0, 400.0]), 20, scatter=scatter) == pytest.approx(found / 20)
    assert repeated_variance(1.0, np.array([0.0, 5.0]), 20, scatter=scatter) == pytest.approx(found / 10)
    assert repeated_variance(0.0, np.zeros(2), 1, scatter=scatter) == 0.0


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
def test_variance_of_the_mean_includes_errors_that_repeat(noise):
    """Harmonics 1 to 10 of 20 recordings with 100 samples a cycle: sampling error 7 %, and the errors are no noise."""
    stated = actual = 0.0
    for seed in range(20):
        tau, y, recorded = ten_tones(100, noise, seed)
        run = bp.Recording.from_arrays(tau, {"y": recorded}, {"x": y}).fold(64, frequency=1.0, harmonics=10)
        exact = 2 * np.fft.rfft(y[:100])[1:11] / 100
        error = 2 * np.fft.rfft(run.outputs["y"])[1:11] / 64 - exact
        stated += run.amplitude_variance["y"][1:].sum()
        actual += np.sum(np.abs(error) ** 2)
    assert stated / actual == pytest.approx(1.0, abs=0.3)


def test_harmonics_of_repeated_errors_are_not_kept():
    kept = [
        bp.Recording.from_arrays(tau, {"y": recorded}, {"x": y}).fold(128, frequency=1.0).harmonics["y"]
        for tau, y, recorded in (ten_tones(100, 0.0, seed) for seed in range(20))
    ]
    assert kept.count(10) >= 18


@pytest.mark.parametrize("away, step", [(0.0099, 0.5), (0.0101, 0.0), (-0.0099, 0.5), (-0.0101, 0.0)])
def test_levels_are_multiples_of_the_step_up_to_a_hundredth(away, step):
    """step_of: eight levels at least; the step is the smallest difference, of the first hundred thousand values."""
    values = 0.5 * np.array([7.0, 0.0, 1.0, 3.0, 4.0, 9.0, 12.0, 20.0 + away])
    assert step_of(values) == pytest.approx(step) and step_of(values[:-1]) == 0.0
    assert step_of(values[:-1], fewest=7) == 0.5
    long = np.concatenate([np.resize(values, 100_000), [0.123]])
    assert step_of(long) == pytest.approx(step) and step_of(long[1:]) == 0.0


@pytest.mark.parametrize("cycles", [5, 20])
@pytest.mark.parametrize("wrong", [1, 3])
def test_changes_of_two_levels_are_moved_by_noise(cycles, wrong):
    """rounded_step: more than 1.5 changes in order of phase for each one in a cycle.

    A lone wrong sample of many cycles with two changes each makes two more. Three levels are rounded in any case.
    """
    phase = np.arange(cycles * 40) / 40.0 + 1e-6
    values = np.where(phase % 1.0 < 0.5, 1.0, -1.0)
    assert rounded_step(values, phase) == 0.0
    values[[5 + 7 * k for k in range(wrong)]] = -1.0
    assert rounded_step(values, phase) == 2.0
    values[2] = 3.0
    assert rounded_step(values, phase) == 2.0


@pytest.mark.parametrize("scatter, residual", [(0.04, None), (None, 0.12)])
def test_errors_that_repeat_are_independent_between_levels_and_phases(scatter, residual):
    """repeated_variance: of the fewer of the phases and of the steps that the mean period passes, at least one."""
    given = {"scatter": scatter} if residual is None else {"residual": residual}
    one = repeated_variance(1.0, np.zeros(4), 9, **given)
    assert one > 0.0 and repeated_variance(1.0, np.array([0.0, 0.4]), 9, **given) == pytest.approx(one)
    assert repeated_variance(1.0, np.array([0.0, 3.0, 1.0]), 9, **given) == pytest.approx(one / 6)
    assert repeated_variance(1.0, np.array([0.0, 3.0, 1.0]), 5, **given) == pytest.approx(one / 5)
    large = {name: 9.0 * value for name, value in given.items()}
    assert repeated_variance(3.0, 3.0 * np.array([0.0, 3.0, 1.0]), 9, **large) == pytest.approx(9.0 * one / 6)
    beyond = {name: 1.2 for name in given}
    assert repeated_variance(1.0, np.zeros(4), 9, **beyond) == 0.0
    assert repeated_variance(1.0, np.zeros(4), 9, scatter=0.0) == pytest.approx(1.0 / 12.0, rel=1e-3)
    assert repeated_variance(1.0, np.zeros(4), 9) == pytest.approx(1.0 / 12.0, rel=1e-3)
