"""Random walks of the phase: their evidence, the error of the frequency, and harmonics that are not smeared."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.harmonics import phase_diffusion

FREQUENCY, THIRD = 0.7, 0.3


def phases(cycles: int, step: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of a phase over cycles, with white noise, and the polynomials of orders 0 to 2 (3, cycles)."""
    basis = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, cycles), 2))[0].T
    walk = step / 4.0 * np.cumsum(random.standard_normal(16 * cycles)).reshape(cycles, 16).mean(axis=1)
    return walk + random.standard_normal(cycles), basis


@pytest.mark.parametrize("cycles", [12, 40, 100])
def test_white_noise_rarely_looks_like_a_random_walk(cycles):
    """Measured about 1 %; more than 14 of 200 have a probability of 0.2 % at 3 %."""
    random = np.random.default_rng(cycles)
    found = [phase_diffusion(*phases(cycles, 0.0, random), 1.0) is not None for _ in range(200)]
    assert sum(found) <= 14


def test_the_variance_of_the_slope_is_that_of_a_random_walk():
    """200 walks of 60 cycles: 90 % intervals of the slope's coefficient, 99.9 % band 0.83 to 0.965.

    The variance of the coefficient of a walk with unit steps is 60²/10 + 1/10 less 1/6 (sums of squares).
    """
    random, inside, steps, slopes = np.random.default_rng(1), 0, [], []
    for _ in range(200):
        phase, basis = phases(60, 10.0, random)
        found = phase_diffusion(phase, basis, 1.0)
        assert found is not None
        steps.append(found.step)
        slopes.append(found.slopes[1] / found.step)
        inside += abs(basis[1] @ phase) < 1.645 * np.sqrt(found.slopes[1])
    assert 0.83 <= inside / 200 <= 0.965
    assert np.mean(steps) == pytest.approx(100.0, rel=0.15)
    assert np.median(slopes) == pytest.approx(360.1 - 1.0 / 6.0, rel=0.02)


def walking(step: float, seed: int, cycles: int = 60) -> bp.Recording:
    """Return a free-running oscillation with a third harmonic, whose phase walks by `step` [cycles] in a cycle."""
    random, phase = np.random.default_rng(seed), np.arange(0.0, cycles, 1.0 / 25.0)
    time = phase / FREQUENCY
    phase = phase + step / 5.0 * np.cumsum(random.standard_normal(phase.size))
    x = np.cos(2 * np.pi * phase) + THIRD * np.cos(6 * np.pi * phase) + 0.01 * random.standard_normal(phase.size)
    return bp.Recording.from_arrays(time, {"x": x}, name="free")


@pytest.mark.filterwarnings("ignore:free")
def test_harmonics_of_a_wandering_phase_are_not_smeared():
    """Noise of 0.01 on 1500 samples: standard error 4e-4 of the third harmonic; the mean of four within four."""
    runs = [walking(0.01, seed).fold(64, origin="crossing") for seed in range(4)]
    third = [abs(np.fft.rfft(run.outputs["x"])[3]) * 2.0 / 64 for run in runs]
    assert np.mean(third) == pytest.approx(THIRD, abs=4 * 4e-4 / 2)
    given = walking(0.01, 0).fold(64, origin="crossing", frequency=runs[0].frequency)
    smeared = abs(np.fft.rfft(given.outputs["x"])[3]) * 2.0 / 64
    assert smeared < THIRD - 20 * 4e-4
    # Of a walk of 0.01² cycles² in a cycle: (2π)² · 1e-4 · 0.7 a second.
    found = [run.phase_diffusion for run in runs]
    assert np.mean(found) == pytest.approx((2 * np.pi) ** 2 * 1e-4 * FREQUENCY, rel=0.4)
    assert "Hz with a phase diffusion of" in repr(runs[0]) and "phase diffusion" not in repr(given)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:free")
def test_the_standard_error_of_the_frequency_covers_under_phase_diffusion():
    """60 recordings: 90 % intervals of the frequency, 99.9 % band 0.73 to 1; a tenth of the error would cover 0.2."""
    z = []
    for seed in range(60):
        run = walking(0.003, seed).fold(64, origin="crossing")
        z.append((run.frequency - FREQUENCY) / run.frequency_se)
    assert np.mean(np.abs(z) < 1.645) > 0.73


def test_a_frequency_with_an_error_is_accepted_within_it_and_refused_beyond():
    time = np.arange(0.0, 40.0, 0.05)
    x = np.cos(2 * np.pi * time) + 0.01 * np.random.default_rng(0).standard_normal(time.size)
    recording = bp.Recording.from_arrays(time, {"x": x}, name="run")
    with pytest.raises(ValueError, match="frequency: must be that of the recording"):
        recording.fold(32, frequency=1.0003)
    run = recording.fold(32, frequency=(1.0003, 2e-4))
    assert (run.frequency, run.frequency_se) == (1.0003, 2e-4) and "± 0.0002 Hz" in repr(run)
    assert run.middle["x"] == pytest.approx(20.0, abs=0.5)
    for far in ((1.0003, 1e-5), (1.003, 1e-2)):
        with pytest.raises(ValueError, match="frequency: must be that of the recording"):
            recording.fold(32, frequency=far)
    with pytest.raises(ValueError, match=r"frequency: must be a number or \(frequency, standard error\), got"):
        recording.fold(32, frequency=(1.0, 0.1, 0.1))
    with pytest.raises(ValueError, match=r"frequency\[1\]: must be"):
        recording.fold(32, frequency=(1.0, -0.1))
