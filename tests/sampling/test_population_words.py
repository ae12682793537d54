"""Verdicts on populations never claim more than the evidence."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from bayesperiodic.sampling.population_evidence import COLUMNS
from tests.drawn import population_of

NONE = np.nan


def population(evidence, *, robust=0, **changes):
    """Return a population with this row of evidence for a spread of 0.2 ± 0.05 m."""
    generator = np.random.default_rng(1)
    result = population_of({"mean[a]": generator.standard_normal(400), "spread[a]": 0.2 + 0.05 * generator.random(400)})
    units = {"unit": ["1", "2", "3"], "robust": [0, 0, robust], "pareto_k": 0.1, "effective": 900.0, "p": 0.5}
    return replace(
        result, evidence=pd.DataFrame([evidence], index=["a"], columns=COLUMNS), units=pd.DataFrame(units), **changes
    )


@pytest.mark.parametrize(
    ("evidence", "start"),
    [
        ((9.0, 1.0, NONE, NONE), "a differs between units: spread 0.23 ± 0.01 m, not explained by noise (Bayes"),
        ((4.0, 0.2, 4.1, 0.1), "a differs between units"),
        # Strong, but not beyond twice the error of one of the estimates.
        ((9.0, 3.5, NONE, NONE), "Whether a differs between units is undecided"),
        ((3.5, 0.4, 3.4, 0.1), "Whether a differs between units is undecided"),
        ((3.5, 0.1, 3.1, 0.1), "Whether a differs between units is undecided"),
        ((4.0, 0.1, 1.0, 0.1), "Whether a differs between units is undecided: two estimates of the evidence disagree"),
        ((0.3, 0.1, 0.2, 0.1), "Whether a differs between units is undecided: spread below 0.25 m"),
        ((-2.0, 0.1, -2.1, 0.1), "No spread of a is seen: below 0.25 m with 95 % probability"),
        ((-2.0, 0.6, -2.1, 0.1), "Whether a differs between units is undecided"),
        ((-2.0, 0.1, -1.6, 0.4), "Whether a differs between units is undecided"),
        ((NONE, NONE, NONE, NONE), "Whether a differs between units is undecided"),
    ],
)
def test_verdicts_need_evidence_beyond_twice_its_errors(evidence, start):
    assert population(evidence).verdicts["a"].startswith(start)


def test_bayes_factors_in_words_are_the_least_within_the_errors():
    assert f"(Bayes factor for a spread at least {np.exp(3.6):.2g})" in population((4.0, 0.2, 4.1, 0.1)).verdicts["a"]
    assert (
        f"(Bayes factor for no spread at least {np.exp(1.8):.2g})" in population((-2.0, 0.1, -2.1, 0.1)).verdicts["a"]
    )


def test_chains_that_have_not_converged_and_models_that_are_wrong_limit_the_verdict():
    evidence = (9.0, 1.0, NONE, NONE)
    verdict = population(evidence, converged=False, reason="most steps").verdicts["a"]
    assert verdict == "Whether a differs between units is undecided: the chains have not converged (most steps)."
    wrong = population(evidence, robust=1)
    assert "not explained by noise, but perhaps by the error of the model" in wrong.verdicts["a"]
    assert wrong.remarks[0].startswith("The model is misspecified in 1 of 3 units")
    assert "error of the model" not in population(evidence).verdicts["a"]
    beyond = population(evidence, covariates={"day": (0.0, 1.0)}).verdicts["a"]
    assert beyond.startswith("a differs between units beyond the covariates")
