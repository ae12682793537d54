import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import LINEAR, grid, linear_experiment

AMPLITUDES = [0.3, 1.0 - 2.0j, 0.0, 0.5j]


def test_harmonics_become_the_signal_they_describe():
    run = bp.Experiment.from_harmonics("run", 2.0, {"x": AMPLITUDES}, {"u": [1.0, 2.0]}, samples=50)
    tau = 2 * np.pi * grid(50)
    expected = 0.3 + np.cos(tau) + 2.0 * np.sin(tau) - 0.5 * np.sin(3 * tau)
    assert run.outputs["x"] == pytest.approx(expected, abs=1e-14)
    assert run.inputs["u"] == pytest.approx(1.0 + 2.0 * np.cos(tau), abs=1e-14)
    assert run.independent == {"x": 5} and run.harmonics == {"x": 3} and run.frequency == 2.0
    assert run.unmeasured == {"x": (2,)}


def test_estimate_compares_only_the_given_harmonics():
    """An estimate from the first harmonics equals that from the folded period projected onto them by least squares."""
    whole = linear_experiment([900.0, 45.0, 25.0], 3.0, seed=4)
    kept = np.fft.rfft(whole.outputs["force"])[:6] * 2 / 40
    kept[0] = kept[0].real / 2
    run = bp.Experiment.from_harmonics("run", 2.0, {"force": kept}, {"x": [0.0, -0.05j]}, samples=40)
    priors = {"k": bp.Normal(800.0, 1e6), "c": bp.Normal(40.0, 1e6), "coulomb": bp.Normal(20.0, 1e6)}
    fit = bp.map_estimate(bp.Problem(LINEAR, [run], priors=priors), progress=False)
    tau = 2 * np.pi * grid(40)
    v = 0.05 * 4 * np.pi * np.cos(tau)
    columns = np.stack([0.05 * np.sin(tau), v, np.tanh(v / 0.1)], axis=-1)
    spectrum = np.fft.rfft(columns, axis=0)[:6]
    stacked = np.concatenate([spectrum.real, spectrum.imag])
    data = np.fft.rfft(whole.outputs["force"])[:6]
    weights = np.sqrt([0.5, *[1.0] * 5] * 2)[:, None]
    expected = np.linalg.lstsq(weights * stacked, weights[:, 0] * np.concatenate([data.real, data.imag]), rcond=None)[0]
    assert list(fit.theta.values()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outputs": {"x": [1j, 1.0]}}, r"outputs\['x'\]: must have a real mean .harmonic 0., got 1j"),
        ({"outputs": {"x": [1.0, np.nan]}}, r"outputs\['x'\]: must be a vector of finite amplitudes .*got"),
        ({"outputs": {"x": []}}, r"outputs\['x'\]: must be a vector .*got \[\]"),
        ({"outputs": {"x": "abc"}}, r"outputs\['x'\]: must be an array of complex numbers, got 'abc'"),
        ({"inputs": {"u": [[1.0]]}}, r"inputs\['u'\]: must be a vector .*got \[\[.1"),
        ({"samples": 6}, r"samples: must be at least 7 for harmonic 3 of outputs\['x'\], got 6"),
        ({"samples": 2}, "samples: must be .*got 2"),
        ({"frequency": -1.0}, "frequency: must be .*got -1.0"),
    ],
)
def test_error_names_the_bad_harmonics(changes, message):
    arguments = {"name": "run", "frequency": 1.0, "outputs": {"x": AMPLITUDES}, "samples": 50}
    with pytest.raises(ValueError, match=message):
        bp.Experiment.from_harmonics(**(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"amplitude_variance": {"x": [1.0, -1.0]}},
            r"amplitude_variance\['x'\]: must be .* finite .*got \[1.0, -1.0\]",
        ),
        (
            {"amplitude_variance": {"x": [1.0, np.nan]}},
            r"amplitude_variance\['x'\]: must be .* finite .*got \[1.0, nan\]",
        ),
        ({"amplitude_freedom": {"x": [4.0]}}, r"amplitude_freedom\['x'\]: must be 2 values > 0, .*got \[4.0\]"),
        (
            {"amplitude_freedom": {"x": [4.0, 0.0]}},
            r"amplitude_freedom\['x'\]: must be 2 values > 0, .*got \[4.0, 0.0\]",
        ),
    ],
)
def test_error_names_the_bad_variance_of_amplitudes(changes, message):
    given = {"samples": 8, "harmonics": {"x": 1}, "amplitude_variance": {"x": [1.0, 2.0]}}
    with pytest.raises(ValueError, match=message):
        bp.Experiment("run", 1.0, {"x": np.cos(np.arange(8.0))}, **(given | changes))
