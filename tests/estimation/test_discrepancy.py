"""Discrepancy tests on components of known origin: p-values under the null, and power."""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.estimation.adequacy import consistency, excess, holm, measured_freedom
from bayesperiodic.estimation.unexplained import Unexplained, explained

HARMONIC = np.array([0, *range(1, 21), *range(1, 21)])
TRIALS = 1000


def sensitivities(generator: np.random.Generator, parameters: int = 3) -> np.ndarray:
    """Return derivatives of the kind that models have: large in the low harmonics."""
    return generator.standard_normal((parameters, HARMONIC.size)) * np.exp(-HARMONIC / 2.0)


def test_p_values_of_white_noise_are_uniform_or_conservative_after_any_fit():
    """1000 trials with 41 components, 3 parameters: KS of the whiteness p at 0.1 %, and binomial limits at 0.1 %."""
    generator = np.random.default_rng(1)
    whiteness, harmonics = np.empty(TRIALS), np.empty(TRIALS)
    changes = sensitivities(generator)
    for i in range(TRIALS):
        misfit = changes.T @ generator.normal(0.0, 50.0, 3)
        tested = Unexplained(7.0 * generator.standard_normal(HARMONIC.size) + misfit, changes, HARMONIC)
        whiteness[i], harmonics[i] = tested.whiteness().p, tested.harmonic_content()[0]
    assert stats.kstest(whiteness, "uniform").pvalue > 1e-3
    for level in (0.1, 0.05, 0.01):
        assert np.sum(whiteness <= level) <= stats.binom.ppf(0.999, TRIALS, level)
        assert np.sum(harmonics <= level) <= stats.binom.ppf(0.999, TRIALS, level)
    assert np.sum(harmonics <= 0.1) >= stats.binom.ppf(0.001, TRIALS, 0.05), "Bonferroni costs less than a factor 2"


def test_power_against_model_error_in_low_harmonics():
    """Of 200 residuals with 5 noise sds in both parts of harmonic 2 at least 95 % are found at 1 %, and it is named.

    So are smooth model errors of 12 noise sds in the mean that fall by 1/e in 4 harmonics, by either test.
    """
    generator = np.random.default_rng(2)
    # Like c, k and k3 of a Duffing oscillator the parameters move odd harmonics.
    changes = sensitivities(generator) * (HARMONIC % 2)
    peak = 5.0 * (HARMONIC == 2)
    found, named, smooth = 0, 0, np.zeros(2)
    for _ in range(200):
        noise = generator.standard_normal(HARMONIC.size)
        p, harmonic = Unexplained(noise + peak, changes, HARMONIC).harmonic_content()
        found, named = found + (p < 0.01), named + (harmonic == 2)
        error = 12.0 * np.exp(-HARMONIC / 4.0) * generator.standard_normal(HARMONIC.size)
        tested = Unexplained(noise + error, changes, HARMONIC)
        smooth += [tested.whiteness().p < 0.01, tested.harmonic_content()[0] < 0.01]
    assert found >= 190 and named >= 190
    assert np.all(smooth >= 190)


def test_explained_sums_are_those_of_a_regression_with_free_amplitudes():
    generator = np.random.default_rng(3)
    changes = np.zeros((3, HARMONIC.size))
    # Two parameters move harmonic 1 only and a third moves all: harmonics 3 and higher lose one degree of freedom.
    changes[:2, [1, 21]] = np.eye(2)
    changes[2] = generator.standard_normal(HARMONIC.size)
    components = generator.standard_normal(HARMONIC.size)
    tested = Unexplained(components, changes, HARMONIC)
    chosen = np.array([HARMONIC <= 1, HARMONIC == 1, HARMONIC == 5, HARMONIC > 4, HARMONIC >= 0])
    sets = np.array([[np.any(row[HARMONIC == h]) for h in range(21)] for row in chosen])
    square, freedom = explained(*(np.tensordot(sets.astype(float), part, 1) for part in tested.sums))
    for row, found, number in zip(chosen, square, freedom, strict=True):
        design = np.concatenate([changes.T, np.eye(HARMONIC.size)[:, row]], axis=1)
        _, _, rank, _ = np.linalg.lstsq(design, components, rcond=None)
        fitted = design @ np.linalg.lstsq(design, components, rcond=None)[0]
        assert number == rank - 3
        assert found == pytest.approx(tested.square - np.sum((components - fitted) ** 2), abs=1e-9)
    assert list(freedom) == [1, 0, 2, 32, 38]


def test_dependent_parameters_count_once_and_parameters_without_effect_not():
    generator = np.random.default_rng(4)
    changes, components = sensitivities(generator, 2), generator.standard_normal(HARMONIC.size)
    more = np.stack([changes[0], 1e6 * changes[1], changes[0] - changes[1], np.zeros(HARMONIC.size)])
    plain, ridge = Unexplained(components, changes, HARMONIC), Unexplained(components, more, HARMONIC)
    assert ridge.freedom == plain.freedom == HARMONIC.size - 2
    assert ridge.square == pytest.approx(plain.square)
    assert ridge.whiteness().p == pytest.approx(plain.whiteness().p)


def test_no_test_without_residual_degrees_of_freedom():
    everything = Unexplained(np.ones(3), np.eye(3), np.array([0, 1, 1]))
    assert everything.freedom == 0
    assert np.isnan(everything.whiteness().p) and np.isnan(everything.harmonic_content()[0])
    assert np.isnan(excess(1.0, 0.0, 1.0, np.inf)) and np.isnan(excess(1.0, 5.0, np.nan, np.inf))


def test_excess_over_a_variance_that_was_itself_estimated():
    """2000 pairs of estimates with 20 and 12 degrees of freedom: p is uniform, by KS at 0.1 %."""
    generator = np.random.default_rng(5)
    residual, scatter = generator.chisquare(20, 2000) / 20, generator.chisquare(12, 2000) / 12
    p = [excess(r, 20, s, 12) for r, s in zip(residual, scatter, strict=True)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert excess(1.8307, 10, 1.0, np.inf) == pytest.approx(0.05, abs=1e-5)


def parts(generator: np.random.Generator, changes: np.ndarray, difference: float) -> list:
    """Return three blocks of two groups with sds 1 and 5, the second block with other parameters."""
    groups, sds, offsets = ["a", "a", "b"], [1.0, 1.0, 5.0], [0.0, difference, 0.0]
    return [
        (sd * generator.standard_normal(HARMONIC.size) + offset * j[0], j, group)
        for group, sd, offset, j in zip(groups, sds, offsets, changes, strict=True)
    ]


def test_common_parameters_are_accepted_and_different_ones_found():
    """600 trials, KS at 0.1 %; 200 trials with a parameter that differs by 9 standard deviations, 95 % at 1 %."""
    generator = np.random.default_rng(6)
    changes = generator.standard_normal((3, 3, HARMONIC.size))
    p = np.array([consistency(parts(generator, changes, 0.0), frozenset()) for _ in range(600)])
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    difference = 9.0 / np.linalg.norm(changes[1, 0])
    found = [consistency(parts(generator, changes, difference), frozenset()) < 0.01 for _ in range(200)]
    assert sum(found) >= 190


def test_a_known_variance_counts_against_common_parameters():
    """A measured frequency, alone in its group, is fitted by its own parameter and not by the common one."""
    generator = np.random.default_rng(7)
    changes = np.ones((1, HARMONIC.size))
    data = (generator.standard_normal(HARMONIC.size), changes, "a")
    known = frozenset(["known"])
    assert consistency([data, (np.array([0.5]), np.ones((1, 1)), "known")], known) > 0.05
    assert consistency([data, (np.array([8.0]), np.ones((1, 1)), "known")], known) < 1e-6
    assert np.isnan(consistency([data], known))
    assert np.isnan(consistency([(np.ones(1), np.ones((1, 1)), "a")], frozenset()))


def test_holm_adjusts_step_by_step():
    adjusted = holm(np.array([0.01, 0.04, np.nan, 0.03, 0.005]))
    assert adjusted[[0, 1, 3, 4]] == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert np.isnan(adjusted[2])
    assert np.isnan(holm(np.array([np.nan]))).all()


def test_freedom_of_a_measured_variance_is_that_of_its_harmonics_together():
    """Three equal parts with 4, 8 and 8 degrees of freedom: 9/(1/4 + 1/8 + 1/8) = 18 (Satterthwaite)."""
    variance = {"x": np.array([1.0, 2.0, 2.0])}
    given = {"outputs": {"x": np.zeros(8)}, "samples": 8, "cycles": 5, "harmonics": {"x": 2}}
    freedom = {"x": np.array([4.0, 8.0, 8.0])}
    measured = bp.Experiment("run", 1.0, amplitude_variance=variance, amplitude_freedom=freedom, **given)
    assert measured_freedom(measured, "x") == pytest.approx(18.0)
    by_cycles = bp.Experiment("run", 1.0, amplitude_variance=variance, **given)
    assert measured_freedom(by_cycles, "x") == pytest.approx(18.0)
    assert measured_freedom(bp.Experiment("run", 1.0, scatter={"x": 0.1}, **given), "x") == 20
    for cycles, expected in ((2, 4.5), (1, np.inf)):  # 9/(1/1 + 1/2 + 1/2) of two cycles
        few = bp.Experiment("run", 1.0, amplitude_variance=variance, **given | {"cycles": cycles})
        assert measured_freedom(few, "x") == pytest.approx(expected)


@pytest.mark.parametrize("behind", [4.0, 20.0])
def test_p_values_in_units_of_measured_noise_are_uniform(behind):
    """500 trials at 21 harmonics, the mean with 2 degrees of freedom: KS of whiteness and binomial limits at 0.1 %."""
    generator, changes = np.random.default_rng(3), sensitivities(np.random.default_rng(2))
    freedom = np.full(21, behind)
    freedom[0] = 2.0
    spectrum = 1.0 / (1.0 + np.arange(21.0) ** 2)
    whiteness, harmonics = np.empty(500), np.empty(500)
    for i in range(500):
        noise = np.sqrt(spectrum)[HARMONIC] * generator.standard_normal(HARMONIC.size)
        sd = np.sqrt(spectrum * generator.chisquare(freedom) / freedom)[HARMONIC]
        misfit = changes.T @ generator.normal(0.0, 50.0, 3)
        tested = Unexplained.of_measured_noise((noise + misfit) / sd, changes / sd, HARMONIC, freedom)
        whiteness[i], harmonics[i] = tested.whiteness().p, tested.harmonic_content()[0]
    assert stats.kstest(whiteness, "uniform").pvalue > 1e-3
    for level in (0.1, 0.05, 0.01):
        assert np.sum(whiteness <= level) <= stats.binom.ppf(0.999, 500, level)
        assert np.sum(harmonics <= level) <= stats.binom.ppf(0.999, 500, level)
