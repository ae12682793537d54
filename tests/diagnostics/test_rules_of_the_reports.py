"""Rules of `identifiability` and of the adequacy tests at their limits, and their sentences, on single rows."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.fft import dct

import bayesperiodic as bp
from bayesperiodic.diagnostics import identifiability
from bayesperiodic.estimation import adequacy
from bayesperiodic.estimation.unexplained import Unexplained
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.samples import Samples
from bayesperiodic.likelihood.section_points import SectionPoints

ROW = {
    "p_negative": np.nan, "p_negative_mcse": np.nan, "other_values": "", "profile": "", "collinearity": 1.0,
    "alone": 0.2, "structural": "", "together": 0.2, "contraction": 0.96154, "contraction_mcse": 0.0,
    "prior_sensitivity": np.nan, "likelihood_sensitivity": np.nan, "verdict": "",
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "determined"),
        ({"together": 0.333}, "determined"),
        ({"together": 0.334}, "only with the prior"),
        ({"together": 0.5, "collinearity": 5.0}, "only in combination"),
        ({"together": 0.5, "collinearity": 4.99}, "only with the prior"),
        ({"together": 9.0, "collinearity": 9.0, "alone": 1.01}, "only with the prior"),
        ({"together": 9.0, "collinearity": 9.0, "alone": 0.99}, "only in combination"),
        ({"alone": 10.01}, "not determined"),
        ({"alone": 9.99, "together": 12.0}, "only with the prior"),
        ({"structural": "a, b"}, "only in combination"),
        ({"structural": "a, b", "alone": 11.0}, "not determined"),
        ({"profile": "one-sided"}, "only with the prior"),
        ({"profile": "one-sided", "collinearity": 5.0}, "determined"),
        ({"profile": "closed"}, "determined"),
        ({"other_values": "3"}, "several values"),
        ({"other_values": "3", "together": 0.5}, "several values"),
        ({"p_negative": 0.5, "p_negative_mcse": 0.0}, "sign undetermined"),
        ({"p_negative": 0.974, "p_negative_mcse": 0.0}, "sign undetermined"),
        ({"p_negative": 0.026, "p_negative_mcse": 0.0}, "sign undetermined"),
        ({"p_negative": 0.976, "p_negative_mcse": 0.0}, "determined"),
        ({"p_negative": 0.024, "p_negative_mcse": 0.0}, "determined"),
        ({"p_negative": 0.94, "p_negative_mcse": 0.01}, "sign undetermined"),
        ({"p_negative": 0.95, "p_negative_mcse": 0.01}, "determined"),
    ],
)
def test_the_first_criterion_that_applies_is_the_verdict(changes, expected):
    assert identifiability._verdict(ROW | changes, True, 0.3) == expected


def test_a_sign_needs_a_size_and_several_values_need_one_that_is_determined():
    assert identifiability._verdict(ROW | {"p_negative": 0.5, "p_negative_mcse": 0.0}, False, 0.3) == "determined"
    several = ROW | {"other_values": "3", "together": 0.5}
    assert identifiability._verdict(several, False, 0.34) == "only with the prior"
    assert identifiability._verdict(several, False, 1.0 / 3.0) == "several values"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "contraction 0.962"),
        ({"contraction_mcse": 0.0123}, "contraction 0.962 ± 0.012"),
        ({"collinearity": 5.0}, "contraction 0.962, the other parameters widen it 5 times"),
        ({"collinearity": 4.99}, "contraction 0.962"),
        ({"collinearity": 1e6}, "contraction 0.962, the other parameters widen it infinitely"),
        ({"collinearity": 9.9e5}, "contraction 0.962, the other parameters widen it 9.9e+05 times"),
        ({"structural": "a, b"}, "contraction 0.962, by a structural symmetry"),
        (
            {"alone": 0.34},
            "contraction 0.962, the data alone would leave 0.34 prior sds with all other parameters known",
        ),
        ({"alone": 0.34, "profile": "one-sided"}, "contraction 0.962, profile one-sided"),
        ({"profile": "closed"}, "contraction 0.962"),
        ({"other_values": "3, 4"}, "contraction 0.962, 3, 4 at another optimum with more than 1 % of the mass"),
        ({"p_negative": 0.1234, "p_negative_mcse": 0.0}, "contraction 0.962, P(negative) = 0.123"),
        ({"p_negative": 0.1234, "p_negative_mcse": 0.0123}, "contraction 0.962, P(negative) = 0.123 ± 0.012"),
        ({"prior_sensitivity": 0.0512}, "contraction 0.962, sensitive to the prior (0.051 per doubling)"),
        ({"prior_sensitivity": 0.0499}, "contraction 0.962"),
    ],
)
def test_evidence_in_words(changes, expected):
    row = ROW | changes
    assert ", ".join([*identifiability._numbers(row), *identifiability._remarks(row)]) == expected


@pytest.mark.parametrize(
    ("prior", "likelihood", "expected"),
    [
        (0.2, 0.3, "prior and data disagree (p), confirmed by power-scaling (0.2 and 0.3 per doubling of prior and"),
        (0.04, 0.3, "prior and data disagree (p), not confirmed by"),
        (0.3, 0.04, "prior and data disagree (p), not confirmed by"),
        (np.nan, np.nan, "prior and data disagree (p), without draws to confirm it"),
    ],
)
def test_power_scaling_confirms_a_conflict_if_both_matter(prior, likelihood, expected):
    fit = SimpleNamespace(prior_conflict=SimpleNamespace(text="Prior and data disagree (p)"))
    row = ROW | {"prior_sensitivity": prior, "likelihood_sensitivity": likelihood}
    assert identifiability._against_the_prior(fit, row).startswith(expected)


EXPERIMENTS = pd.DataFrame(
    {"run": ["far", "near", "none"], "frequency": [2.0, 1.234, 3.0], "scale": [1.0, 2.0, 1.0],
     "a": [0.8, 0.512, np.nan], "b": [0.95, 0.91, 0.9]}
)  # fmt: skip
DIRECTIONS = pd.DataFrame({"gain": [8.9, 9.1], "parameters": ["a, bb", "c, d"], "combinations": ["a*bb", "c/d"]})


@pytest.mark.parametrize(
    ("verdict", "name", "structural", "expected"),
    [
        ("determined", "a", "", ""),
        ("several values", "a", "", "give a prior that excludes the other value, or measure an output that differs"),
        ("prior conflict", "a", "", "check units, prior and data"),
        ("only in combination", "a", "", "fix one of a, bb, or report a*bb"),
        ("only in combination", "a", "a, k", "fix one of a, k, or report k/a"),
        ("only in combination", "b", "", "report it with its prior, or fix it; no candidate experiment would reduce"),
        ("only in combination", "c", "", "report it with its prior, or fix it; no candidate"),
        ("only with the prior", "a", "", "measure near at 1.23 Hz with 2 times its amplitude: this would leave 51% of"),
        ("not determined", "b", "", "report it with its prior, or fix it; no candidate experiment would reduce its sd"),
    ],
)
def test_recommendations(verdict, name, structural, expected):
    experiments = EXPERIMENTS.assign(c=1.0)
    structure = SimpleNamespace(combinations=["k/a"])
    row = ROW | {"verdict": verdict, "structural": structural}
    found = identifiability._remedy(row, name, DIRECTIONS, experiments, structure)
    assert found.startswith(expected) and bool(found) == bool(expected)


def test_recommendations_without_amplitudes_candidates_or_combinations():
    row, structure = ROW | {"verdict": "not determined"}, SimpleNamespace(combinations=[])
    alike = EXPERIMENTS.assign(scale=1.0)
    found = identifiability._remedy(row, "a", DIRECTIONS, alike, structure)
    assert found == "measure near at 1.23 Hz: this would leave 51% of the sd"
    found = identifiability._remedy(row, "a", DIRECTIONS, EXPERIMENTS.iloc[:0], structure)
    assert found == "report it with its prior, or fix it; or measure another output"
    row = ROW | {"verdict": "only in combination", "structural": "a, k"}
    assert identifiability._remedy(row, "a", DIRECTIONS, alike, structure) == "fix one of a, k"


def test_half_width_is_that_of_one_sd_of_normal_draws():
    draws = 3.0 + 2.0 * stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    assert identifiability._half_width(draws) == pytest.approx(2.0, rel=1e-3)


def test_directions_are_described_with_their_gain_and_invariant_combinations():
    information = SimpleNamespace(
        gains=np.array([1e-20, 0.0, 8.0, 10.0]),
        directions=np.array([[1, 1, 0, 0], [1, -1, 0, 0], [0, 0, 0.6, 0.8], [0.04, 0, 0.8, -0.6]]).T / [1.4, 1.4, 1, 1],
        names=("a", "b", "c", "d"),
        logarithmic=np.array([True, True, False, False]),
    )
    table = identifiability._directions(information)
    assert table["gain"].tolist() == information.gains.tolist()
    assert table["contraction"].tolist() == pytest.approx([0.0, 0.0, 8 / 9, 10 / 11])
    # Directions without information are reduced to single parameters.
    assert table["parameters"].tolist() == ["a", "b", "c, d", "c, d"]
    assert table["combinations"].tolist() == ["", "", "d - 1.33*c", ""]
    assert table["direction"].tolist() == [
        "a -> a·t",
        "b -> b·t",
        "c -> c + 0.75·t, d -> d + t",
        "c -> c + t, d -> d - 0.75·t",
    ]


def test_distance_under_power_scaling_of_a_normal_is_that_of_quadrature():
    """Draws at quantiles; the distributions with weights exp(±…) are integrated on the same grid in long form."""
    x = stats.norm.ppf((np.arange(4000) + 0.5) / 4000)
    log_density = -0.5 * (x - 1.5) ** 2
    expected = []
    for power in (0.25, -0.2):
        weight = np.exp(power * log_density)
        p, q = np.arange(1, 4000) / 4000, np.cumsum(weight / weight.sum())[:-1]
        sides = []
        for a, b in ((p, q), (1 - p, 1 - q)):
            m = 0.5 * (a + b)
            js = sum(np.sum((u * np.log2(u / m) - 0.5 * (u - v) / np.log(2)) * np.diff(x)) for u, v in ((a, b), (b, a)))
            sides.append(np.sqrt(js / np.sum((a + b) * np.diff(x))))
        expected.append(max(sides) / np.log2(1.25))
    order = np.random.default_rng(0).permutation(4000)
    assert identifiability._sensitivity(x[order], log_density[order]) == pytest.approx(np.mean(expected), rel=1e-6)
    assert identifiability.cumulative_jensen_shannon(np.ones(5), np.full(5, 0.2)) == 0.0


TABLE = pd.DataFrame(
    {
        "whiteness": [0.5, 0.8, np.nan],
        "harmonics": [0.9, 1e-6, np.nan],
        "size": [np.nan, 0.5, np.nan],
        "amplitude": [np.nan, 1e-5, np.nan],
        "consistency": [np.nan, np.nan, 0.5],
        "harmonic": [2.0, 3.0, np.nan],
        "model_error_share": [np.nan, 0.123, np.nan],
        "spectrum": ["assumed", "assumed", ""],
        "verdict": ["adequate", "misspecified", "misspecified"],
    },
    index=["run x", "run y", "all"],
)


def test_rejections_in_words():
    """Holm: 1e-6 times 8 tests and 1e-5 times 7 are below 1 %."""
    assert adequacy.rejections(TABLE) == {
        "run y": "the residual has excess power in some harmonics (p = 1e-06), the amplitude differs from the "
        "predicted one (p = 1e-05); its strongest harmonic is 3, as where a force odd in the motion is missing, if the "
        "drive is a sine; 12.3% of the residual variance is model error"
    }
    plain = TABLE.assign(harmonic=np.nan, model_error_share=np.nan, amplitude=np.nan)
    assert adequacy.rejections(plain) == {"run y": "the residual has excess power in some harmonics (p = 1e-06)"}
    assert adequacy.rejections(TABLE.assign(harmonics=0.5, amplitude=0.2)) == {}


def test_a_noise_model_is_in_question_unless_the_noise_was_measured():
    assert adequacy.concerns_noise(TABLE)
    assert not adequacy.concerns_noise(TABLE.assign(verdict="adequate"))
    assert not adequacy.concerns_noise(TABLE.assign(spectrum=["assumed", "measured", ""]))
    assert adequacy.concerns_noise(TABLE.assign(spectrum=["measured", "assumed", ""]))
    assert not adequacy.concerns_noise(TABLE.assign(size=[np.nan, 1e-6, np.nan]))


def block(kind, size, count, harmonic=()):
    return kind("run", "y", count, size, np.array(harmonic, dtype=int), np.zeros(0), 16, 99.0, np.nan)


def test_components_of_the_lowest_harmonics_are_used():
    values = np.arange(14.0).reshape(2, 7)
    spectral = block(MeanPeriod, 7, 4.6, [0, 1, 2, 3, 1, 2, 3])
    part, harmonic = adequacy.used(spectral, values)
    assert harmonic.tolist() == [0, 1, 2, 1, 2] and part.tolist() == values[:, [0, 1, 2, 4, 5]].tolist()
    points, harmonic = adequacy.used(block(Samples, 7, 5.4), values)
    assert points == pytest.approx(dct(values, norm="ortho")[:, :5]) and harmonic.tolist() == [0, 1, 1, 2, 2]
    same, harmonic = adequacy.used(block(SectionPoints, 7, 3.0), values)
    assert same.tolist() == values.tolist() and harmonic.tolist() == [0, 1, 1, 2, 2, 3, 3]


def test_unequal_variances_reduce_the_degrees_of_freedom():
    variance = np.array([1.0, 8.0, 2.0])
    given = {"outputs": {"y": np.zeros(8)}, "samples": 8, "cycles": 5, "harmonics": {"y": 2}}
    e = bp.Experiment("run", 1.0, amplitude_variance={"y": variance}, **given)
    each = np.array([1.0, 2.0, 2.0, 0.5, 0.5])
    assert adequacy._evenness(e, block(MeanPeriod, 5, 5.0)) == pytest.approx(each.sum() ** 2 / (5 * np.sum(each**2)))
    assert adequacy._evenness(bp.Experiment("run", 1.0, **given), block(MeanPeriod, 5, 5.0)) == 1.0
    freedom = {"y": np.array([4.0, 8.0, 9.0])}
    e = bp.Experiment("run", 1.0, amplitude_variance={"y": variance}, amplitude_freedom=freedom, **given)
    found = adequacy.measured_spectrum(e, replace(block(MeanPeriod, 5, 5.0), harmonic=np.array([0, 1, 2, 1, 2])))
    assert found[0] == pytest.approx([5.0, 10.0, 2.5]) and found[1].tolist() == [4.0, 8.0, 9.0]
    assert adequacy.measured_spectrum(e, block(MeanPeriod, 7, 5.0)) is None
    assert adequacy.measured_spectrum(e, block(Samples, 5, 5.0)) is None
    zero = bp.Experiment("run", 1.0, amplitude_variance={"y": variance * [0, 1, 1]}, amplitude_freedom=freedom, **given)
    assert adequacy.measured_spectrum(zero, block(MeanPeriod, 5, 5.0)) is None


@pytest.mark.parametrize("own", [1.3, -0.4])
def test_p_of_the_amplitude_is_that_of_a_prediction_by_students_t(own):
    """Of rms values r of n replicates: t = (rms − mean)/(s √(1 + 1/n)) with n − 1 degrees of freedom."""
    measured = (1.0 + 0.1 * own) * np.sqrt(2.0) * np.cos(2 * np.pi * np.arange(8) / 8) + 4.0
    e = bp.Experiment("run", 1.0, outputs={"y": measured}, samples=8)
    sizes = np.array([0.9, 1.0, 1.1, 1.05])
    replicates = 7.0 + sizes[:, None] * np.sqrt(2.0) * np.sin(2 * np.pi * np.arange(8) / 8)
    replicates = np.concatenate([replicates, np.full((1, 8), np.nan)])
    problem = SimpleNamespace(experiments=[e])
    score = (1.0 + 0.1 * own - sizes.mean()) / (sizes.std(ddof=1) * np.sqrt(1.25))
    found = adequacy._amplitude(problem, block(MeanPeriod, 5, 5.0), {("run", "y"): replicates})
    assert found == pytest.approx(2.0 * stats.t.sf(abs(score), 3))
    assert np.isnan(adequacy._amplitude(problem, block(MeanPeriod, 5, 5.0), {}))
    assert np.isnan(adequacy._amplitude(problem, block(MeanPeriod, 5, 5.0), {("run", "y"): replicates[3:]}))


def test_p_of_the_harmonic_content_is_that_of_f_tests_by_bonferroni():
    """Without parameters: each harmonic, and the lowest 2ᵏ + 1, against the others."""
    harmonic = np.array([0, 1, 2, 3, 4, 5, 1, 2, 3, 4, 5])
    e = np.random.default_rng(2).standard_normal(11) + 6.0 * (harmonic == 4)
    sets = [harmonic == h for h in range(6)] + [harmonic <= h for h in (1, 2, 4)]
    p = [
        stats.f.sf((e[own] @ e[own] / own.sum()) / (e[~own] @ e[~own] / (~own).sum()), own.sum(), (~own).sum())
        for own in sets
    ]
    found = Unexplained(e, np.zeros((1, 11)), harmonic).harmonic_content()
    assert found == (pytest.approx(min(1.0, len(sets) * min(p))), 4.0)
