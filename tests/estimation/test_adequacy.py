"""Rules of the adequacy tests at their limits, and their sentences, on single rows."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.fft import dct

import bayesperiodic as bp
from bayesperiodic.estimation import adequacy
from bayesperiodic.estimation.unexplained import Unexplained
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.samples import Samples
from bayesperiodic.likelihood.section_points import SectionPoints
from tests.known import LINEAR, linear_experiment

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


def judged(extra, sd=3.0, known=True):
    """Return the table of a linear problem whose force has this error in addition to white noise."""
    run = linear_experiment(np.array([900.0, 40.0, 25.0]), sd, seed=1, samples=64)
    run = replace(run, outputs={"force": run.outputs["force"] + extra(2 * np.pi * np.arange(64) / 64)})
    priors = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
    problem = bp.Problem(LINEAR, [run], priors=priors, fixed={"variance[force]": sd**2} if known else {})
    fit = bp.map_estimate(problem, starts=1, progress=False)
    here = problem.density().linearise(problem.vector(fit.theta))
    return adequacy.adequacy(problem, here, problem.noise_values(fit.noise)[None], {})


@pytest.mark.parametrize("known", [True, False])
def test_table_of_the_tests_of_a_right_model(known):
    """Any p-value is below 1e-3 by chance once in a thousand; the seed is fixed."""
    table = judged(lambda _: 0.0, known=known)
    assert [*table.index] == ["run force", adequacy.ALL]
    assert table.loc["run force", ["experiment", "channel"]].tolist() == ["run", "force"]
    row = table.loc["run force"]
    assert 1e-3 < row["whiteness"] <= 1.0 and 1e-3 < row["harmonics"] <= 1.0 and 1e-3 < row["p"] <= 1.0
    assert table["verdict"].tolist() == ["adequate", "adequate"] and table.loc[adequacy.ALL, "p"] == row["p"]
    assert row["spectrum"] == adequacy.ASSUMED_SPECTRUM and np.isfinite(row["size"]) == known


@pytest.mark.parametrize("harmonic", [2, 4, 9])
def test_power_in_one_harmonic_is_found_and_the_harmonic_named(harmonic):
    """Even harmonics are in no term of the model; of five noise sds a sample, the whole misfit is 800 in χ² of 64."""
    table = judged(lambda phase: 15.0 * np.cos(harmonic * phase))
    row = table.loc["run force"]
    assert row["harmonics"] < 1e-6 and row["harmonic"] == harmonic and row["size"] < 1e-6 and row["p"] < 1e-5
    assert row["verdict"] == table.loc[adequacy.ALL, "verdict"] == "misspecified"
    assert 0.0 < row["model_error_share"] < 1.0


@pytest.mark.parametrize(
    "white, draws, every",
    [(False, 1, 1), (False, 5, 1), (False, 39, 1), (False, 40, 2), (False, 65, 3), (True, 5, None)],
)
def test_p_of_realised_residuals_are_means_over_about_twenty_draws_of_correlated_noise(
    monkeypatch, white, draws, every
):
    """Of white noise, whose size cancels, the medians of the variances are enough."""
    noise = np.random.default_rng(1).uniform(0.1, 0.9, (draws, 2))

    class Known:
        def __init__(self, problem, here, shape):
            self.shape = shape

        def spectral_tests(self, index):
            return self.shape[0], self.shape[1], 7.0 * self.shape[0]

        def spectrum(self, index):
            return None

        def consistency(self):
            return self.shape.sum() / 2

    monkeypatch.setattr(adequacy, "Whitened", Known)
    monkeypatch.setattr(adequacy, "_size", lambda problem, here, index, white: (0.5, 0.25))
    blocks = [replace(block(MeanPeriod, 5, 5.0), channel=channel) for channel in "yz"]
    blocks.insert(1, SimpleNamespace(counted=False))
    likelihood = SimpleNamespace(white=white, blocks=blocks)
    problem = SimpleNamespace(likelihood=likelihood, quantities=(), experiments=[])
    table = adequacy.adequacy(problem, None, noise, {})
    shapes = np.median(noise, axis=0)[None] if white else noise[::every]
    assert [*table.index] == ["run y", "run z", "all"]
    for row in ("run y", "run z"):
        assert table.loc[row, ["whiteness", "harmonics"]].tolist() == pytest.approx(shapes.mean(axis=0).tolist())
        assert table.loc[row, "harmonic"] == pytest.approx(7.0 * shapes[0, 0])
        assert table.loc[row, ["size", "model_error_share", "spectrum"]].tolist() == [0.5, 0.25, "assumed"]
    assert table.loc["all", "consistency"] == pytest.approx(shapes.mean())
    each = adequacy.holm(table[[*adequacy.ADEQUACY_TESTS]].to_numpy(dtype=float).ravel())
    assert table.loc["all", "p"] == pytest.approx(np.nanmin(each)) and table["verdict"].tolist() == ["adequate"] * 3
