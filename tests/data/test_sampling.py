"""Gaps, missing samples and slow sampling against least squares and closed forms."""

import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data import aliases, coverage, lines

EVEN = np.arange(0, 60, 0.05)


def sampled(kind):
    """Return the times of a sampling of a period of 1 s."""
    random = np.random.default_rng(1)
    return {
        "gap of half a period": EVEN[(EVEN < 30) | (EVEN > 30.5)],
        "gap of 17 periods": EVEN[(EVEN < 14) | (EVEN > 31.3)],
        "30 % missing": EVEN[random.random(EVEN.size) > 0.3],
        "70 % missing": EVEN[random.random(EVEN.size) > 0.7],
        "0.7 samples per period": np.arange(200) * 1.4137,
        "0.1 samples per period": np.arange(200) * 10.137,
        "bursts": EVEN[EVEN % 7.3 < 1.5],
        "rounded to ms": np.round(np.arange(200) * 1.4137, 3),
    }[kind]


KINDS = (
    "gap of half a period", "gap of 17 periods", "30 % missing", "70 % missing", "0.7 samples per period",
    "0.1 samples per period", "bursts", "rounded to ms",
)  # fmt: skip


def wave(time, frequency=1.0):
    return 1.0 + np.sin(2 * np.pi * frequency * time) + 0.3 * np.cos(4 * np.pi * frequency * time)


def design(phase, highest):
    columns = [np.ones(phase.size)]
    for h in range(1, highest + 1):
        columns += [np.cos(2 * np.pi * h * phase), np.sin(2 * np.pi * h * phase)]
    return np.column_stack(columns)


def amplitudes(e, channel="x", count=3):
    spectrum = np.fft.rfft(e.outputs[channel])[:count] / (e.outputs[channel].size / 2)
    spectrum[0] /= 2.0
    return spectrum


@pytest.mark.parametrize("kind", KINDS)
def test_exact_periods_are_recovered_at_any_times_that_cover_the_phases(kind):
    time = sampled(kind)
    e = bp.Recording.from_arrays(time, {"x": wave(time)}).fold(32, frequency=1.0, harmonics=2)
    assert amplitudes(e) == pytest.approx(np.array([1.0, -1j, 0.3]), abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_amplitudes_are_those_of_least_squares_and_their_variances_those_of_its_covariance(kind):
    """Variances are estimated from some 30 components of noise, with a part for changes that may be hidden in it.

    Their median of seven recordings is within a factor of two of the exact ones.
    """
    time, basis, ratios = sampled(kind), design(sampled(kind), 2), []
    for seed in range(7):
        y = wave(time) + 0.1 * np.random.default_rng(seed).standard_normal(time.size)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            e = bp.Recording.from_arrays(time, {"x": y}).fold(32, frequency=1.0, harmonics=2)
        covariance = 0.01 * np.linalg.inv(basis.T @ basis)
        variance = np.r_[covariance[0, 0], np.diag(covariance)[1::2] + np.diag(covariance)[2::2]]
        ratios.append(e.amplitude_variance["x"][1:] / variance[1:])
    ratio = np.median(ratios, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 2.0))
    found = np.linalg.lstsq(basis, y, rcond=None)[0]
    expected = np.r_[found[0], found[1::2] - 1j * found[2::2]]
    assert np.abs(amplitudes(e) - expected).max() < 2.0 * np.sqrt(variance.max())


def test_in_step_with_the_period_as_many_harmonics_as_phases_determine():
    time = np.arange(0, 100, 1 / 3)
    x = 1.0 + np.sin(2 * np.pi * time)
    run = bp.Recording.from_arrays(time, {"x": x + 1e-3 * np.random.default_rng(0).standard_normal(time.size)})
    assert run.fold(32, frequency=1.0).harmonics["x"] == 1
    with pytest.raises(ValueError, match=r"at most 1, .* got 2 \(with all samples at the phases 0, 0\.333, 0\.667"):
        run.fold(32, frequency=1.0, harmonics=2)
    twice = 0.1 + np.arange(200) / 2
    half = bp.Recording.from_arrays(twice, {"x": wave(twice)})
    with pytest.raises(ValueError, match=r"samples at three phases .* all samples at the phases 0, 0\.5"):
        half.fold(32, frequency=1.0)


def test_condition_of_the_normal_equations_is_that_of_their_eigenvalues():
    """Phases 0 to 0.7: the largest order whose condition is below 20, and the diagonal of the inverse."""
    phase = np.linspace(0, 0.7, 500, endpoint=False)
    time = (phase + np.arange(500)) / 1.0
    known, inflation = coverage.determined_harmonics(time, 1.0, 10)

    def gram(highest):
        basis = np.exp(2j * np.pi * np.outer(time, np.arange(-highest, highest + 1)))
        return np.conj(basis.T) @ basis / 500

    assert np.linalg.cond(gram(known)) < 20.0 < np.linalg.cond(gram(known + 1))
    assert inflation == pytest.approx(np.diag(np.linalg.inv(gram(known))).real[known:])


@pytest.mark.parametrize("period", [1.4137, 0.7, 1 / 2.4])
def test_an_unknown_frequency_with_aliases_is_refused_with_their_names(period):
    time = np.arange(200) * period
    y = np.sin(2 * np.pi * time) + 0.02 * np.random.default_rng(0).standard_normal(200)
    rate = 1.0 / period
    base = abs(1.0 - np.round(1.0 / rate) * rate)
    with pytest.raises(ValueError, match=r"frequency: must be given .* \(aliases\)") as error:
        bp.Recording.from_arrays(time, {"x": y}).fold(32)
    assert f"do not tell {base:.3f}"[:-1] in str(error.value)


def test_an_estimated_frequency_with_few_samples_is_named_with_its_aliases():
    time = np.arange(400) / 6.3
    y = np.sin(2 * np.pi * time) + 0.02 * np.random.default_rng(0).standard_normal(400)
    with pytest.warns(UserWarning, match=r"has 6\.3 samples per cycle, and 5\.\d+, 7\.3\d*, .* \(aliases\) explain"):
        e = bp.Recording.from_arrays(time, {"x": y}).fold(32)
    assert e.frequency == pytest.approx(1.0, abs=1e-4)


def test_irregular_times_tell_a_frequency_from_its_aliases():
    random = np.random.default_rng(3)
    time = np.arange(300) * 1.4137 + 0.2 * random.standard_normal(300)
    e = bp.Recording.from_arrays(time, {"x": wave(time) + 0.05 * random.standard_normal(300)}).fold(32)
    assert e.frequency == pytest.approx(1.0, abs=1e-4)
    assert not [finding for finding in e.findings if finding.kind == "aliases"]


def test_aliases_are_sums_and_differences_with_the_sampling_rate():
    time = np.arange(300) * 0.25
    found = aliases.aliases(time, np.sin(2 * np.pi * 0.7 * time)[None], 0.7)
    assert found[:4] == pytest.approx([3.3, 4.7, 7.3, 8.7], abs=1e-3)


@pytest.mark.parametrize(("gap", "counted"), [(20.0, True), (4000.0, False)])
def test_cycles_over_a_gap_are_counted_where_the_frequency_is_known_well_enough(gap, counted):
    """Ten noisy cycles and thirty, 20 or 4000 cycles apart."""
    time = np.concatenate([np.arange(0, 10, 0.05), 10.0 + gap + np.arange(0, 30, 0.05)])
    y = wave(time) + 0.3 * np.random.default_rng(0).standard_normal(time.size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        e = bp.Recording.from_arrays(time, {"x": y}).fold(32)
    assert (e.averaged > 610) == counted
    assert bool([f for f in e.findings if "cannot be counted" in f.text]) != counted
    assert abs(e.frequency - 1.0) < 4.0 * e.frequency_se


def test_noise_left_at_lines_beside_harmonics_is_that_of_the_projection():
    """White noise of variance 1 in residuals r = (1 − P) y has the mean square vᴴ(1 − P)v at the line v."""
    time = EVEN[(EVEN < 22) | (EVEN > 31.3)]
    sampling = lines.Sampling.of(time, 1.0, 2, 60)
    basis, _ = np.linalg.qr(design(time, 2))
    phase = time - time[0]
    for h in (1, 2):
        for k in range(4):
            line = np.exp(2j * np.pi * (h + sampling.side[k]) * phase) / np.sqrt(time.size)
            left = 1.0 - np.sum(np.abs(basis.T @ line) ** 2)
            assert sampling.left[k, h] == pytest.approx(left, abs=0.02)


def test_a_stuck_part_is_left_out_and_the_rest_folded_over_the_gap():
    y = wave(EVEN) + 0.02 * np.random.default_rng(0).standard_normal(EVEN.size)
    y[300:700] = y[300]
    e = bp.Recording.from_arrays(EVEN, {"x": y}).without(stuck=True).fold(32, harmonics=2)
    assert e.averaged > 780
    assert amplitudes(e) == pytest.approx(np.array([1.0, -1j, 0.3]), abs=0.01)


def test_response_period_is_found_in_spite_of_gaps():
    time = EVEN[(EVEN < 14) | (EVEN > 31.3)]
    drive, x = np.cos(2 * np.pi * time), np.cos(2 * np.pi * time) + 0.3 * np.cos(np.pi * time)
    x += 0.01 * np.random.default_rng(0).standard_normal(x.size)
    assert bp.Recording.from_arrays(time, {"x": x}, {"force": drive}).fold(32, periods="auto").periods == 2


@pytest.mark.parametrize("missing", [[(12.5, 12.745)], [(8.999, 9.001), (14.999, 15.011)]])
@pytest.mark.parametrize("ramps", [True, False])
def test_few_missing_samples_do_not_change_the_estimated_frequency(missing, ramps):
    time = np.arange(3000) / 100
    size = np.clip(np.minimum(time / 5, (30 - time) / 3), 0, 1) if ramps else 1.0
    y = size * np.cos(2 * np.pi * 0.84 * time) + 0.01 * np.random.default_rng(1).standard_normal(time.size)
    kept = ~np.any([(time > a) & (time < b) for a, b in missing], axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        e = bp.Recording.from_arrays(time[kept], {"y": y[kept]}).fold(64)
    assert e.frequency == pytest.approx(0.84, rel=1e-3)
