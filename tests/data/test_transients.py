"""Runs from rest: the bias that their transient leaves, against the closed form of a linear oscillator and SciPy."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp

PER_CYCLE = 50


def from_rest(quality, ratio, cycles):
    """Return times [cycles of the drive], the steady motion and the transient of a linear oscillator from rest."""
    drive, natural = 2 * np.pi, 2 * np.pi * ratio
    rate = natural / (2 * quality)
    time = np.arange(cycles * PER_CYCLE) / PER_CYCLE
    size = 1 / (natural**2 - drive**2 + 2j * rate * drive)
    damped = np.sqrt(natural**2 - rate**2)
    sine = ((-1j * drive * size).real - rate * size.real) / damped
    transient = np.exp(-rate * time) * (sine * np.sin(damped * time) - size.real * np.cos(damped * time))
    return time, np.real(size * np.exp(1j * drive * time)) / abs(size), transient / abs(size)


def left(quality, ratio, cycles, noise, seed=0):
    """Return the bias of harmonics 0 to 5 together [standard errors] and the serious findings; NaN for a refusal."""
    time, steady, transient = from_rest(quality, ratio, cycles)
    deviation = noise * np.std(steady)
    x = steady + transient + deviation * np.random.default_rng(seed).standard_normal(time.size)
    recording = bp.Recording.from_arrays(time, {"x": x}, {"force": np.cos(2 * np.pi * time)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            run, check = recording.fold(64), recording.check()
        except ValueError:
            return np.nan, ["refused"]
    used = (time > check.start - 1e-9) & (time < check.stop + 1e-9)
    wave = np.exp(-2j * np.pi * np.outer(np.arange(6), time[used]))
    bias = wave @ transient[used] / used.sum() * np.array([1, 2, 2, 2, 2, 2])
    error = deviation * np.sqrt(np.array([1, 2, 2, 2, 2, 2]) / used.sum())
    return np.linalg.norm(bias / error), [f.kind for f in run.findings if f.severity != "harmless"]


@pytest.mark.parametrize(("quality", "cycles"), [(50, 10), (100, 20), (200, 10), (200, 30)])
def test_light_damping_is_named(quality, cycles):
    """The transient decays in 16 to 64 cycles: it grows as the response, beats with it, or lies between its lines."""
    for ratio in (1.0, 1.02, 0.97, 0.9, 1.2, 1.5, 0.7):
        bias, serious = left(quality, ratio, cycles, 0.01)
        assert serious, (ratio, bias)


@pytest.mark.slow
def test_transients_are_left_out():
    """Of what is folded without a serious finding, the bias is below 0.3 standard errors in half, 0.6 in 90 %."""
    cases = [
        (q, n, r, s) for q, n in ((3, 60), (10, 60), (20, 150)) for r in (1.0, 1.2, 0.7) for s in (1e-3, 1e-2, 5e-2)
    ]
    found = [left(quality, ratio, cycles, noise) for quality, cycles, ratio, noise in cases]
    bias = [one for one, serious in found if not serious]
    assert len(bias) > 0.7 * len(cases)
    assert np.median(bias) < 0.3 and np.quantile(bias, 0.9) < 0.6


@pytest.mark.parametrize(("damping", "stop", "few"), [(0.1, 150.0, True), (0.2, 150.0, True), (0.5, 250.0, False)])
def test_a_ramp_behind_a_transient(damping, stop, few):
    """A Duffing oscillator from rest, whose drive ramps down over the last 100 s; five cycles take 25 s."""
    frequency = 0.2
    time = np.arange(0, stop, 0.05)

    def ramp(t):
        return np.clip((stop - t) / 100.0, 0.0, 1.0)

    def rates(t, y):
        return [y[1], ramp(t) * np.cos(2 * np.pi * frequency * t) - damping * y[1] - y[0] - 0.5 * y[0] ** 3]

    x = solve_ivp(rates, (0, stop), [0, 0], rtol=1e-8, atol=1e-10, t_eval=time).y[0]
    x += 0.01 * np.random.default_rng(1).standard_normal(time.size)
    force = ramp(time) * np.cos(2 * np.pi * frequency * time)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        recording = bp.Recording.from_arrays(time, {"x": x}, {"force": force})
        run, check = recording.fold(64), recording.check()
    assert check.stop <= stop - 100.0 + 0.1
    assert abs(np.fft.rfft(run.inputs["force"])[1]) / 32 == pytest.approx(1.0, abs=1e-4)
    assert any("a rest of the transient is in the part used" in str(w.message) for w in said) == few
