"""Rules of `identifiability` at their limits, and their sentences, on single rows."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from bayesperiodic.diagnostics import identifiability

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


def test_widths_by_draws_have_the_monte_carlo_error_of_their_effective_number():
    """Of normal draws: half of the central 68 % interval has 1.1 times the relative error 1/√2n of the sd."""
    generator = np.random.default_rng(3)
    values = {"a": 0.2 * generator.standard_normal(40_000), "b": 0.5 * generator.standard_normal(40_000)}
    prior = SimpleNamespace(sample=lambda count, _: np.random.default_rng(4).standard_normal((count, 2)))
    problem = SimpleNamespace(names=("a", "b"), joint_prior=prior)
    posterior = SimpleNamespace(draws=values.get, ess={"a": 800.0, "b": 3200.0})
    information = SimpleNamespace(coordinates=lambda theta: theta)
    widths, errors = identifiability._widths(problem, None, posterior, information)
    assert widths == pytest.approx([0.2, 0.5], rel=0.03)
    # Of the contraction 1 − w², whose derivative is 2 w.
    assert errors == pytest.approx(2.0 * widths * widths * 1.1 / np.sqrt([1600.0, 6400.0]))
