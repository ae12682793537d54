"""Estimates from parts of the experiments, against weighted means in closed form."""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp

GAIN = bp.Model("gain", states=["w"], inputs=["u"], parameters=["a"], equations=["dw + w - u"], outputs={"y": "a*u"})
TIME = np.arange(64) / 64


def problem(gains, seed=1):
    """Return runs of different gains and amplitudes, with noise of 1 %."""
    generator, runs = np.random.default_rng(seed), []
    for i, gain in enumerate(gains):
        u = (i + 1.0) * np.cos(2 * np.pi * TIME)
        y = gain * u + 0.01 * (i + 1) * generator.standard_normal(64)
        runs.append(bp.Experiment(f"run {i}", 1.0 + i, {"y": y}, {"u": u}, samples=64))
    return bp.Problem(GAIN, runs, priors={"a": bp.Normal(1.0, 10.0)}, scheme="fourier", input_noise="exact")


def test_halves_by_amplitude_and_frequency_and_parts_by_a_mapping():
    given = problem([1.0, 1.0, 1.0, 1.0, 1.0])
    for by in ("amplitude", "frequency"):
        parts = bp.split_check(given, by=by, progress=False).parts
        assert sorted(map(len, parts.values())) == [2, 3] and parts[f"small {by}"][:2] == ("run 0", "run 1")
    found = bp.split_check(given, by={f"run {i}": "abcab"[i] for i in range(5)}, progress=False)
    assert found.parts == {"a": ("run 0", "run 3"), "b": ("run 1", "run 4"), "c": ("run 2",)}
    values, sd = (np.array([getattr(f, of)["a"] for f in found.fits.values()]) for of in ("theta", "sd"))
    mean = np.average(values, weights=sd**-2)
    p = stats.chi2.sf(np.sum(((values - mean) / sd) ** 2), 2)
    assert found.table.loc["a", "p_laplace"] == pytest.approx(p) and found.table.loc["a", "verdict"] == "agrees"


def test_a_gain_that_falls_with_the_amplitude_moves():
    found = bp.split_check(problem([1.0, 1.0, 0.9, 0.9]), progress=False)
    assert found.moved == ("a",) and "Moves with amplitude" in repr(found)


@pytest.mark.parametrize(
    ("count", "by", "match"),
    [
        (1, "amplitude", "at least two experiments"),
        (2, "size", "by"),
        (2, {"run 0": "a"}, "by"),
        (2, {"run 0": "a", "run 1": "a"}, "at least two parts"),
    ],
)
def test_splits_that_are_none_are_refused(count, by, match):
    with pytest.raises(ValueError, match=match):
        bp.split_check(problem([1.0] * count), by=by, progress=False)
