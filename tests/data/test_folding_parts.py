"""Parts of folding against direct computations: the spectrum of the noise, its extrapolation."""

import numpy as np
import pytest
from scipy.integrate import quad

from bayesperiodic import _fourier
from bayesperiodic.data import folding, harmonics, lines
from bayesperiodic.data.quantisation import repeated_variance
from bayesperiodic.data.signals import Signals


def signals(time, *values, inputs=0):
    names = tuple(f"y{i}" for i in range(len(values)))
    return Signals("record", time, names, np.array(values), inputs)


def design(phase, highest):
    """Return the real Fourier basis (samples, 2·highest + 1)."""
    columns = [np.ones(phase.size)]
    for h in range(1, highest + 1):
        columns += [np.cos(2 * np.pi * h * phase), np.sin(2 * np.pi * h * phase)]
    return np.column_stack(columns)


@pytest.mark.parametrize("row", [0, 1])
def test_noise_of_a_harmonic_is_the_mean_power_of_the_lines_beside_it(row):
    """36 cycles of 8 samples: lines 36 h ± 1 … 9 of the Fourier transform of the residual; 4·9 degrees of freedom."""
    cycles, per_cycle = 36, 8
    time = 1.5 + np.arange(cycles * per_cycle) / per_cycle / 0.3
    values = np.cos(2 * np.pi * 0.3 * time) + 0.1 * np.random.default_rng(1).standard_normal((2, time.size))
    values[1] *= 3.0
    fit = harmonics.fit_harmonics(time, values, 0.3, 3)
    one_cycle, noise = folding._noise(signals(time, *values), fit, row, lines.Sampling.of(time, 0.3, 3, cycles))
    basis = design(0.3 * time, 3)
    residual = values[row] - basis @ np.linalg.lstsq(basis, values[row], rcond=None)[0]
    power = np.abs(np.fft.fft(residual) / time.size) ** 2
    each = np.fft.fft(residual.reshape(cycles, per_cycle), axis=1) / per_cycle
    for h in (1, 2, 3):
        beside = [power[h * cycles + sign * j] for j in range(1, 10) for sign in (1, -1)]
        assert noise.variance[h] == pytest.approx(4.0 * np.mean(beside))
        assert noise.freedom[h] == pytest.approx(36.0)
        assert one_cycle[h] == pytest.approx(4.0 * np.sum(np.abs(each[:, h]) ** 2) / (cycles - 1))
    between = [power[j] for j in range(1, 60) if j % cycles]
    assert (noise.variance[0], noise.freedom[0]) == pytest.approx(lines._at_zero(np.array(between[:40])))
    assert noise.lines[1:] == pytest.approx(36.0)
    assert one_cycle[0] == pytest.approx(np.sum(np.abs(each[:, 0]) ** 2) / (cycles - 1))


@pytest.mark.parametrize("time", [0.45, 0.05])
@pytest.mark.parametrize("line", [0, 1, 7])
def test_power_of_noise_with_exponential_correlation_is_that_of_quadrature(time, line):
    expected = quad(lambda u: (1 - u) * np.exp(-u / time) * np.cos(2 * np.pi * line * u), 0, 1, epsabs=1e-13)[0]
    assert lines._exponential(time, 7)[line] == pytest.approx(expected, abs=1e-12)


def test_power_at_zero_is_the_mean_over_the_spectra_by_their_likelihoods():
    """Their levels are integrated out numerically, with the density 1/level."""
    power = np.random.default_rng(5).exponential(size=12) * (1.0 + 4.0 / np.arange(1, 13))
    line = np.arange(13)
    slow = [np.concatenate([[2.75], 1.0 / line[1:]])]
    for time in (0.45, 0.1, 0.05, 0.025):
        wave = [
            quad(lambda u, t=time, j=j: (1 - u) * np.exp(-u / t) * np.cos(2 * np.pi * j * u), 0, 1)[0] for j in line
        ]
        slow.append(np.array(wave))
    shapes = [np.ones(13), *(own / own[1] + floor for own in slow for floor in (0.0, 0.01, 0.1))]
    weights, values = [], []
    for number, shape in enumerate(shapes):

        def likelihood(log_level, shape=shape):
            return np.exp(-np.sum(log_level + np.log(shape[1:]) + power / (np.exp(log_level) * shape[1:])) + 20.0)

        centre = np.log(np.mean(power / shape[1:]))
        prior = 1.0 if number == 0 else 1.0 / (len(shapes) - 1)
        weights.append(prior * quad(likelihood, centre - 4.0, centre + 4.0, epsabs=0.0)[0])
        count = 8 if number == 0 else 2
        values.append(shape[0] * power[:count].sum() / shape[1 : count + 1].sum())
    share = np.array(weights) / np.sum(weights)
    expected, freedom = lines._at_zero(power)
    assert 0.02 < share[0] < 0.98
    assert expected == pytest.approx(np.exp(share @ np.log(values)), rel=1e-6)
    assert freedom == pytest.approx(1.0 / (share[0] / 16.0 + (1.0 - share[0]) / 2.0), rel=1e-6)


def test_lines_without_power_say_nothing_of_the_mean():
    assert lines._at_zero(np.zeros(5)) == (0.0, 16.0)


@pytest.mark.parametrize(("factor", "kept"), [(1.001, 4), (0.999, 2)])
def test_the_last_kept_harmonic_is_significant_at_one_percent_of_all_together(factor, kept):
    """With 2 and ν degrees of freedom P(F > f) = (1 + 2 f/ν)^(−ν/2); the largest of five has 1 % in all."""
    freedom = 6.0
    limit = 0.5 * freedom * ((0.01 / 5) ** (-2.0 / freedom) - 1.0)
    variance = np.full(6, 0.04)
    noise = folding.AmplitudeNoise(variance, np.full(6, 99.0), np.full(6, freedom), np.empty((0, 6)))
    size = np.array([5.0, 0.0, 3.0, 0.0, np.sqrt(factor * limit * 0.04), 0.0])
    assert folding._last_significant(size * np.exp(0.3j), noise) == kept
    assert folding._last_significant(np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]) + 0j, noise) == 1


def test_rounding_is_no_significant_harmonic_of_exact_data():
    noise = folding.AmplitudeNoise(np.zeros(4), np.full(4, 8.0), np.full(4, 8.0), np.empty((0, 4)))
    assert folding._last_significant(np.array([0.0, 2.0, 0.0, 1e-13]) + 0j, noise) == 1
    assert folding._last_significant(np.array([0.0, 2.0, 0.0, 1e-10]) + 0j, noise) == 3


def test_power_of_a_signal_is_that_of_its_amplitudes():
    amplitude = np.array([0.7, 1.0 + 0.4j, -0.3j])
    values = _fourier.on_grid(amplitude, 64)
    assert folding._power(np.abs(amplitude) ** 2) == pytest.approx(np.mean(values**2))


def test_exact_data_have_no_noise_and_the_degrees_of_freedom_of_the_lines():
    time = np.arange(64) / 8.0
    fit = harmonics.HarmonicFit(1.0, np.array([[0.5, 1.0, 0.0]], dtype=complex), np.zeros((1, 64)))
    one_cycle, noise = folding._noise(
        signals(time, np.round(np.cos(2 * np.pi * time), 9)), fit, 0, lines.Sampling.of(time, 1.0, 2, 8)
    )
    assert one_cycle.tolist() == noise.variance.tolist() == [0.0, 0.0, 0.0]
    assert noise.freedom.tolist() == noise.lines.tolist() == [16.0, 16.0, 16.0]


def test_repeated_quantisation_errors_count_with_three_degrees_of_freedom():
    """Values rounded to a coarse step, sampled at the same phases in every cycle: nothing averages out.

    The variance of the mean of a cycle of n samples is step²/12 over the number of different errors, at most n.
    """
    time = np.arange(20 * 16) / 16.0
    clean = 3.0 * np.cos(2 * np.pi * time) + np.sin(4 * np.pi * time)
    values = 0.25 * np.round((clean + 0.013) / 0.25)
    fit = harmonics.fit_harmonics(time, values[None], 1.0, 3)
    _, noise = folding._noise(signals(time, values), fit, 0, lines.Sampling.of(time, 1.0, 3, 20))
    repeated = 0.25**2 / 12 / 16
    assert noise.variance == pytest.approx(repeated * np.array([1.0, 4.0, 4.0, 4.0]), rel=1e-3)
    assert noise.freedom == pytest.approx(np.full(4, 3.0))


def test_every_field_of_a_folded_response_of_two_forcing_periods():
    """Forcing at 2.5 Hz, response at 1.25 Hz: 16 whole cycles of 24 samples, with white noise."""
    generator, cycles, per_cycle = np.random.default_rng(5), 16, 24
    time = 7.0 + np.arange(cycles * per_cycle) / (1.25 * per_cycle)
    phase = 1.25 * time
    u = np.cos(4 * np.pi * phase) + 1e-3 * generator.standard_normal(time.size)
    y = (
        0.5
        + np.cos(2 * np.pi * phase + 0.4)
        + 0.3 * np.sin(4 * np.pi * phase)
        + 0.05 * generator.standard_normal(u.size)
    )
    given = Signals("record", time, ("u", "y"), np.array([u, y]), 1)
    found = folding.fold_signals([given], 20, 2, (2.5, 0.0), {"y": 3}, 1.0, None)
    basis = design(1.25 * (time - 1.0), 3)
    fitted = np.linalg.lstsq(basis, np.array([u, y]).T, rcond=None)[0].T
    grid = design(np.arange(40) / 40, 3)
    assert found["outputs"]["y"] == pytest.approx(grid @ fitted[1], abs=0.02)
    assert found["inputs"]["u"] == pytest.approx(np.cos(4 * np.pi * (np.arange(40) / 40 + 1.25)), abs=1e-3)
    exact = {"frequency": 2.5, "frequency_se": 0.0, "samples": 20, "periods": 2, "cycles": 16, "averaged": time.size}
    assert {key: found[key] for key in exact} == exact
    assert found["harmonics"] == {"u": 2, "y": 3} and found["independent"] == {"y": 7} and found["origin"] == 1.0
    assert list(found["outputs"]) == ["y"] and list(found["inputs"]) == ["u"]
    own = np.fft.fft(y.reshape(cycles, per_cycle), axis=1)[:, :4] / per_cycle
    variance = np.var(own, axis=0, ddof=1) * [1.0, 2.0, 2.0, 2.0]
    assert found["scatter"]["y"] == pytest.approx(np.sqrt(variance.sum()), rel=1e-2)
    assert found["amplitude_variance"]["y"].shape == found["amplitude_freedom"]["y"].shape == (4,)
    assert found["amplitude_variance"]["u"].shape == (3,)
    basis = design(phase, 9)
    rest = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    assert found["periodicity"] == pytest.approx(1.0 - rest.var(ddof=19) / y.var(ddof=1), abs=1e-3)
    size = np.abs(own[:, 1])
    slope = np.polyfit(np.arange(cycles), size, 1)[0] * cycles / size.mean()
    assert found["drift"]["y"] == pytest.approx(slope, rel=0.05)
    estimated = folding.fold_signals([given], 20, 2, None, None, "crossing", None)
    assert estimated["frequency"] == pytest.approx(2.5, rel=1e-3) and estimated["frequency_se"] > 0.0
    # Response and phase at the upward crossing of its fundamental: −π/2, the first after time 0.
    start = (-0.25 - 0.4 / (2 * np.pi)) % 1.0 / 1.25
    assert estimated["origin"] == pytest.approx(start, abs=0.02) and 0.0 <= estimated["origin"] < 0.8
    crossing = np.fft.rfft(estimated["outputs"]["y"])[1]
    assert np.angle(crossing) == pytest.approx(-0.5 * np.pi, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": 500_001}, "^samples: must be at most 500000 for 2 periods, got 500001"),
        ({"origin": "start"}, "^origin: must be a time .s. or 'crossing', got 'start'"),
        (
            {"harmonics": {"y": 12}},
            r"^harmonics\['y'\]: must be at most 11, which the samples and the grid resolve, got 12",
        ),
        ({"harmonics": {"z": 2}}, "^harmonics: must be one of|^harmonics: .*'z'"),
        (
            {"largest_drift": 1e-9},
            "^recording: must be steady, got 'record', in which the strongest harmonic of 'y' changes by",
        ),
        ({"given": (0.25, 0.0)}, r"^recording: must have at least 3 cycles, got 1.60 cycles in 'record'"),
    ],
)
def test_arguments_of_a_fold_are_checked(changes, message):
    time = np.arange(16 * 24) / (1.25 * 24)
    y = (1.0 + 0.001 * time) * np.cos(2 * np.pi * 1.25 * time)
    given = {"samples": 20, "periods": 2, "given": (2.5, 0.0), "harmonics": None, "origin": 0.0, "largest_drift": None}
    with pytest.raises(ValueError, match=message):
        folding.fold_signals([Signals("record", time, ("y",), y[None], 0)], **(given | changes))


@pytest.mark.parametrize("again", [True, False])
def test_error_of_repeated_rounding_is_that_of_the_scatter_at_each_phase(again):
    """Pooled over the phases, of n samples at each n − 1 count; none without samples that return to a phase."""
    points, cycles = 16, 12 if again else 1
    phase = np.arange(points * cycles) / points
    noise = np.random.default_rng(5).normal(0.0, 0.05, phase.size)
    values = 0.2 * np.round((np.cos(2 * np.pi * phase) + noise) / 0.2)
    amplitudes = np.array([0.1, 1.0 + 0j, 0.0])
    residuals = values - 0.1 - np.cos(2 * np.pi * phase)
    found = folding._repeated_error(values, residuals, amplitudes, phase + 3.0, points)
    by_phase = residuals.reshape(-1, points)
    scatter = ((by_phase - by_phase.mean(axis=0)) ** 2).sum() / max((cycles - 1) * points, 1)
    fitted = 0.1 + np.cos(2 * np.pi * np.arange(points) / points)
    expected = repeated_variance(0.2, fitted, points, scatter=scatter) if again else 0.0
    assert found == pytest.approx(expected, rel=1e-9) and (found > 0.0) == again
    assert folding._repeated_error(values + noise, residuals, amplitudes, phase, points) == 0.0
