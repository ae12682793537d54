"""Tests of single channels and of tables of measured quantities: units of the noise, p-values and sentences by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic import noise
from bayesperiodic.data.recording_check import HARMLESS
from bayesperiodic.estimation import adequacy, climbs
from bayesperiodic.estimation.adequacy import Whitened
from bayesperiodic.estimation.result import orbit_advice
from bayesperiodic.estimation.table_tests import serial_correlation
from bayesperiodic.estimation.unexplained import Unexplained
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.section_points import SectionPoints

HARMONIC = np.array([0, 1, 2, 3, 4, 1, 2, 3, 4])
VARIANCE, FREEDOM = np.array([1.0, 8.0, 2.0, 4.0, 6.0]), np.array([4.0, 8.0, 9.0, 7.0, 5.0])
# Of components, from those of complex amplitudes: N times the mean's, and N/4 times that of harmonics.
BY_SPECTRUM = 9 * (VARIANCE * [1.0, 0.25, 0.25, 0.25, 0.25])[HARMONIC]
GENERATOR = np.random.default_rng(4)
R, J = GENERATOR.standard_normal((3, 9)), GENERATOR.standard_normal((3, 2, 9))


def block(channel="y", measured=0.7, kind=MeanPeriod, size=9, count=9.0):
    harmonic = HARMONIC if kind is MeanPeriod else np.zeros(0)
    return kind("run", channel, count, size, harmonic, np.zeros(0), 16, 90.0, measured)


def run(channels="yz", spectrum="y", **changes):
    given = {"amplitude_variance": {c: VARIANCE for c in spectrum}, "amplitude_freedom": {c: FREEDOM for c in spectrum}}
    outputs, kept = {c: np.zeros(16) for c in channels}, dict.fromkeys(channels, 4)
    return bp.Experiment("run", 1.0, outputs, samples=16, cycles=5, harmonics=kept, **(given | changes))


def whitened(blocks, fixed=(), loadings=None, values=None, experiment=None, residuals=R):
    """Return the tests of blocks whose noise has these known variances, and others of `values`."""
    likelihood = Likelihood(noise.Independent(), blocks, dict(fixed), loadings)
    problem = SimpleNamespace(likelihood=likelihood, noise=noise.Independent(), experiments=[experiment or run()])
    size = [one.size for one in blocks]
    here = SimpleNamespace(
        residuals=[r[:n] for r, n in zip(residuals, size, strict=False)],
        jacobian=[j[:, :n] for j, n in zip(J, size, strict=False)],
    )
    values = {**dict.fromkeys(likelihood.names, 1.0), **dict(fixed), **(values or {})}
    return problem, here, Whitened(problem, here, np.array([values[name] for name in likelihood.names]))


def test_components_are_in_units_of_the_measured_spectrum_the_scatter_or_the_estimated_noise():
    """A variance of one sample of 3, of which 90 are behind 9 values: 3 · 9/90 each."""
    blocks = [block(), block("z", measured=0.4), block("w", measured=np.nan)]
    _, _, white = whitened(blocks, values={"variance[w]": 3.0}, experiment=run("yzw"))
    for index, variance in enumerate([BY_SPECTRUM, np.full(9, 0.4), np.full(9, 0.3)]):
        r, j, harmonic = white.in_units_of_noise(index)
        assert r == pytest.approx(R[index] / np.sqrt(variance)) and harmonic.tolist() == HARMONIC.tolist()
        assert j == pytest.approx(J[index] / np.sqrt(variance))
    assert [(white.spectrum(i) is None, white.in_measured_units(i) is None) for i in range(3)] == [
        (False, False),
        (True, True),
        (True, True),
    ]
    for index, variance in enumerate([0.7, 0.4, 0.3]):
        expected = Unexplained(R[index] / np.sqrt(variance), J[index] / np.sqrt(variance), HARMONIC)
        found = white.in_measured_sd(index)
        assert (found.square, found.freedom) == (pytest.approx(expected.square), 7)
    own = Unexplained.of_measured_noise(R[0] / np.sqrt(BY_SPECTRUM), J[0] / np.sqrt(BY_SPECTRUM), HARMONIC, FREEDOM)
    assert white.in_measured_units(0).square == pytest.approx(own.square)


def test_half_of_the_values_have_half_of_the_weight():
    _, _, white = whitened([block(count=4.5)], experiment=run("y", ""))
    r, j, harmonic = white.in_units_of_noise(0)
    # Of 9 components of 4.5 values the lowest 4 are used.
    lowest, factor = [0, 1, 2, 5], np.sqrt(0.5 / 0.7)
    assert harmonic.tolist() == [0, 1, 2, 1] and r == pytest.approx(factor * R[0, lowest])
    assert j == pytest.approx(factor * J[0][:, lowest])


def test_components_that_errors_of_an_input_move_together_are_decorrelated():
    """Two channels with the joint covariance V + L Lᵀ in units of V: squares sum to rᵀ(V + L Lᵀ)⁻¹r."""
    loading = np.random.default_rng(7).standard_normal((18, 2))
    blocks = [block(measured=0.7), block("z", measured=0.4)]
    _, _, white = whitened(blocks, loadings={"run": loading}, experiment=run("yz", ""))
    covariance = np.diag(np.repeat([0.7, 0.4], 9)) + loading @ loading.T
    r = np.concatenate([R[0], R[1]])
    parts = [white.in_units_of_noise(i) for i in range(2)]
    assert sum(np.sum(part[0] ** 2) for part in parts) == pytest.approx(r @ np.linalg.solve(covariance, r))
    information = sum(part[1] @ part[1].T for part in parts)
    slopes = np.concatenate([J[0], J[1]], axis=1)
    assert information == pytest.approx(slopes @ np.linalg.solve(covariance, slopes.T))


@pytest.mark.parametrize(("known", "tested"), [(4.0, True), (3.9, False)])
def test_whiteness_is_tested_where_the_spectrum_is_assumed_or_measured_with_four_values(known, tested):
    """At the median over the harmonics."""
    experiment = run(amplitude_freedom={"y": np.array([1.0, 1.0, known, 9.0, 9.0])})
    blocks = [block(), block("z"), block("scale", kind=SectionPoints, size=4, count=4.0)]
    _, _, white = whitened(blocks, experiment=experiment)
    p, harmonics, strongest = white.spectral_tests(0)
    own = white.in_measured_units(0)
    assert np.isfinite(p) == tested and (harmonics, strongest) == own.harmonic_content()
    assert p == pytest.approx(own.whiteness().p if tested else np.nan, nan_ok=True)
    plain = Unexplained(R[1], J[1], HARMONIC)
    assert white.spectral_tests(1) == pytest.approx((plain.whiteness().p, *plain.harmonic_content()))
    assert np.isnan(white.spectral_tests(2)).all(), "values of a section have no order in time"
    _, _, lost = whitened(blocks, residuals=np.where(np.arange(3)[:, None] == 1, np.nan, R), experiment=experiment)
    assert np.isnan(lost.spectral_tests(1)).all() and np.isfinite(lost.spectral_tests(0)[1:]).all()


def test_known_variances_are_those_of_groups_all_of_whose_parameters_are_fixed():
    _, _, white = whitened([block(), block("z")], {"variance[z]": 2.0})
    assert white.groups == ["variance[y]", "variance[z]"] and white.known == {"variance[z]"}
    assert white.parts[1][0] == pytest.approx(R[1] / np.sqrt(2.0 * 9 / 90))


def test_common_parameters_are_not_tested_without_all_derivatives():
    _, _, white = whitened([block(), block("z")], {"variance[z]": 2.0})
    expected = adequacy.consistency(
        [(r, j, g) for (r, j, _), g in zip(white.parts, white.groups, strict=True)], frozenset({"variance[z]"})
    )
    assert white.consistency() == pytest.approx(expected) and 0.0 < expected < 1.0
    _, _, white = whitened([block(), block("z")], residuals=np.where(np.arange(3)[:, None] == 0, np.nan, R))
    assert np.isnan(white.consistency())


def left(r, j):
    """Return the sum of squares of what the parameters leave."""
    rest = r - j.T @ np.linalg.lstsq(j.T, r, rcond=None)[0]
    return rest @ rest


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_common_parameters_are_tested_by_chow(scale):
    """F of two parameters that two blocks of 9 values have in common against two of each, or χ² of known variances."""
    y, z = scale * R[0], scale * (R[1] + J[1].T @ [0.7, 0.3])
    both, slopes = np.concatenate([y, z]), np.concatenate([J[0], J[1]], axis=1)
    apart = left(y, J[0]) + left(z, J[1])
    more = left(both, slopes) - apart
    same = adequacy.consistency([(y, J[0], "v"), (z, J[1], "v")], frozenset())
    assert same == pytest.approx(stats.f.sf(more / 2 / (apart / 14), 2, 14))
    known = adequacy.consistency([(y, J[0], "v"), (z, J[1], "v")], frozenset({"v"}))
    assert known == pytest.approx(stats.chi2.sf(more, 2))
    # Each with a variance of its own, in whose units both are compared; the fewest degrees of freedom count.
    units = [np.sqrt(left(r, j) / 7) for r, j in ((y, J[0]), (z, J[1]))]
    both = np.concatenate([y / units[0], z / units[1]])
    slopes = np.concatenate([J[0] / units[0], J[1] / units[1]], axis=1)
    own = adequacy.consistency([(y, J[0], "v"), (z, J[1], "w")], frozenset())
    assert own == pytest.approx(stats.f.sf((left(both, slopes) - 14) / 2, 2, 7))
    mixed = adequacy.consistency([(y, J[0], "v"), (z, J[1], "w")], frozenset({"w"}))
    both, slopes = np.concatenate([y / units[0], z]), np.concatenate([J[0] / units[0], J[1]], axis=1)
    assert mixed == pytest.approx(stats.f.sf((left(both, slopes) - 7 - left(z, J[1])) / 2, 2, 7))


def test_blocks_that_cannot_be_compared_are_left_out_of_the_test_of_common_parameters():
    """Exact ones of unknown variance, or without degrees of freedom; a single one has nothing in common."""
    exact = (np.zeros(9), J[2], "w")
    two = [(R[0], J[0], "v"), (R[1], J[1], "v")]
    expected = adequacy.consistency(two, frozenset())
    assert adequacy.consistency([*two, exact], frozenset()) == pytest.approx(expected)
    full = (R[2][:2], J[2][:, :2], "u")
    assert adequacy.consistency([*two, full], frozenset()) == pytest.approx(expected)
    assert np.isnan(adequacy.consistency([exact, full], frozenset()))
    assert np.isnan(adequacy.consistency(two[:1], frozenset())) and np.isnan(adequacy.consistency([], frozenset()))


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_size_of_a_residual_against_a_known_variance_is_a_chi_square(factor):
    problem, here, white = whitened(
        [block(measured=np.nan), block("z", measured=np.nan)], {"variance[y]": 2.0}, residuals=factor * R
    )
    r, j = factor * R[0] / np.sqrt(0.2), J[0] / np.sqrt(0.2)
    rest = r - j.T @ np.linalg.lstsq(j.T, r, rcond=None)[0]
    # The spectrum of y was measured, which is taken where its variance is not.
    relative = white.in_measured_units(0)
    p, share = adequacy._size(problem, here, 0, white)
    assert share == pytest.approx(max(0.0, 1.0 - 7.0 / (rest @ rest)))
    assert p == pytest.approx(stats.chi2.sf(relative.square, relative.freedom))
    assert np.isnan(adequacy._size(problem, here, 1, white)).all(), "an unknown variance is no measure"
    problem, here, white = whitened([block(measured=np.nan)], {"variance[y]": 2.0}, residuals=factor * R,
                                    experiment=run("y", ""))  # fmt: skip
    assert adequacy._size(problem, here, 0, white)[0] == pytest.approx(stats.chi2.sf(rest @ rest, 7))


def test_size_of_a_residual_against_the_scatter_of_cycles_is_an_f_test():
    """Five cycles of 9 values: (5 − 1) · 9 degrees of freedom."""
    experiment = run("y", "", independent={"y": 9})
    problem, here, white = whitened([block(measured=0.4)], experiment=experiment, residuals=1.5 * R)
    r, j = 1.5 * R[0] / np.sqrt(0.4), J[0] / np.sqrt(0.4)
    rest = r - j.T @ np.linalg.lstsq(j.T, r, rcond=None)[0]
    p, share = adequacy._size(problem, here, 0, white)
    assert p == pytest.approx(stats.f.sf(rest @ rest / 7, 7, 36))
    assert share == pytest.approx(max(0.0, 1.0 - 7 / (rest @ rest)))


def test_residuals_without_freedom_or_size_have_no_p():
    problem, here, white = whitened([block(measured=0.4)], experiment=run("y", ""))
    here.jacobian[0] = np.eye(9)
    white = Whitened(problem, here, np.ones(1))
    assert np.isnan(adequacy._size(problem, here, 0, white)).all()
    problem, here, white = whitened([block(measured=0.4)], experiment=run("y", ""), residuals=0.0 * R)
    assert adequacy._size(problem, here, 0, white)[1] == 0.0
    here.residuals[0] = np.full(9, np.nan)
    assert np.isnan(adequacy._size(problem, here, 0, white)).all()


def table_of(known=True, scale=1.0, lost=False):
    """Return the row of a quantity measured in five experiments, its residuals in units of the noise and slopes."""
    generator = np.random.default_rng(3)
    r, j = scale * generator.standard_normal(5), generator.standard_normal((1, 5))
    order = [2, 0, 1, 4, 3]
    experiments = [SimpleNamespace(name=str(n), frequency=float(order.index(n))) for n in range(5)]
    blocks = [SimpleNamespace(channel="size", experiment=str(n)) for n in range(5)]
    problem = SimpleNamespace(experiments=experiments, likelihood=SimpleNamespace(blocks=blocks))
    parts = [(r[n : n + 1], np.full((1, 1), np.nan) if lost else j[:, n : n + 1], np.zeros(1)) for n in range(5)]
    white = SimpleNamespace(parts=parts, groups=["variance[size]"] * 5, known={"variance[size]"} if known else set())
    return adequacy._table_row(problem, "size", white), r[order], j[:, order]


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_row_of_a_table_has_the_chi_square_of_what_the_parameters_leave_and_its_serial_correlation(scale):
    row, r, j = table_of(scale=scale)
    left = r @ r - (j[0] @ r) ** 2 / (j[0] @ j[0])
    assert row["size"] == pytest.approx(stats.chi2.sf(left, 4))
    assert row["whiteness"] == serial_correlation(r, j)
    assert {key: row[key] for key in ("experiment", "channel", "spectrum")} == {
        "experiment": "all", "channel": "size", "spectrum": "",
    }  # fmt: skip
    assert np.isnan(table_of(known=False)[0]["size"]) and np.isnan(table_of(lost=True)[0]["size"])


def test_experiments_with_faults_that_matter_are_faulty():
    findings = {"a": [HARMLESS], "b": [HARMLESS, "serious"], "c": [], "d": ["serious"]}
    experiments = [
        SimpleNamespace(name=name, findings=[SimpleNamespace(severity=one) for one in each])
        for name, each in findings.items()
    ]
    assert adequacy.faulty(SimpleNamespace(experiments=experiments)) == {"b", "d"}


def test_misfit_of_an_estimate_is_that_of_its_checks_or_of_its_solutions(monkeypatch):
    given = {"other_orbits": {}, "prior_conflict": SimpleNamespace(members=()), "starts": ({}, {})}
    fit = SimpleNamespace(**given, checks=SimpleNamespace(misfit="The model is misspecified (a)"))
    assert adequacy.misfit(None, fit) == "The model is misspecified (a); the verdicts take the model for right"
    for changes in ({"checks": SimpleNamespace(misfit="")}, {"other_orbits": {"run": "period"}},
                    {"prior_conflict": SimpleNamespace(members=("a",))}):  # fmt: skip
        assert adequacy.misfit(None, SimpleNamespace(**(vars(fit) | changes))) == ""
    seen = []
    here = SimpleNamespace()
    problem = SimpleNamespace(
        vector=lambda theta: np.array([*theta.values()]),
        anchored=lambda theta, guesses: seen.append((theta.tolist(), guesses)) or problem,
        density=lambda: SimpleNamespace(linearise=lambda theta: here),
        noise_values=lambda values: np.array([*values.values()]),
        noise_names=("variance[y]",),
    )
    fit = SimpleNamespace(
        **given, checks=None, theta={"a": 2.0}, noise={"variance[y]": 3.0, "other": 4.0},
        solutions={"run": SimpleNamespace(states="orbit")},
    )  # fmt: skip

    def misfit_at(one, estimate, starts):
        assert one is problem and estimate.here is here and estimate.theta.tolist() == [2.0]
        return f"{estimate.noise.tolist()} after {starts}"

    monkeypatch.setattr(adequacy, "misfit_at", misfit_at)
    assert adequacy.misfit(problem, fit) == "[3.0] after 2; the verdicts take the model for right"
    assert seen == [([2.0], {"run": "orbit"})]
    fit.checks = SimpleNamespace(misfit=None)
    assert adequacy.misfit(problem, fit).startswith("[3.0] after 2")


@pytest.mark.parametrize(
    ("starts", "said"), [(1, "; one start was tried, and others may lead to a better fit"), (2, "")]
)
@pytest.mark.parametrize("by_noise", [True, False])
def test_misfit_names_the_noise_model_where_that_would_explain_it_too(monkeypatch, starts, said, by_noise):
    """Holm: 1e-6 times the number of tests is below 1 %."""
    table = pd.DataFrame(
        {"whiteness": [1e-6, np.nan], "harmonics": [0.5, np.nan], "size": np.nan, "amplitude": np.nan,
         "consistency": [np.nan, 0.5], "harmonic": np.nan, "model_error_share": np.nan,
         "spectrum": ["assumed" if by_noise else "measured", ""], "verdict": "misspecified"},
        index=["run y", "all"],
    )  # fmt: skip
    given = []
    monkeypatch.setattr(adequacy, "adequacy", lambda *arguments: given.append(arguments) or table)
    here = SimpleNamespace(converged=True)
    estimate = SimpleNamespace(here=here, noise=np.array([1.0, 2.0]))
    reason = "run y: the residual is not white (p = 1e-06)"
    expected = (
        f"The model or the noise model is misspecified ({reason})" if by_noise
        else f"The model is misspecified ({reason}); bp.missing_terms(problem, fit) looks for the term that is missing"
    )  # fmt: skip
    found = adequacy.misfit_at("problem", estimate, starts)
    assert found.startswith(expected + said) and (said or found == expected)
    ((problem, linearised, values, replicates),) = given
    assert (problem, linearised, values.tolist(), replicates) == ("problem", here, [[1.0, 2.0]], {})
    table["whiteness"] = 0.5
    assert adequacy.misfit_at(None, estimate, starts) == ""
    here.converged = False
    assert adequacy.misfit_at(None, estimate, starts) == "" and len(given) == 2


def test_verdicts_of_rows_without_tests_with_faults_and_of_a_misfit(monkeypatch):
    """Holm for one row: 1e-5 times all seven tests; the last row has the smallest of all."""
    tests = {"a": (1e-5, 0.5, 3.0), "b": (0.5, 0.6, 2.0), "c": (np.nan, np.nan, np.nan), "d": (0.7, 0.8, 1.0)}
    names = [*tests]

    class Known:
        def __init__(self, problem, here, shape):
            pass

        def spectral_tests(self, index):
            return tests[names[index]]

        def spectrum(self, index):
            return None if index else 1

        def consistency(self):
            return np.nan

    monkeypatch.setattr(adequacy, "Whitened", Known)
    monkeypatch.setattr(adequacy, "_size", lambda problem, here, index, white: (np.nan, 0.25))
    blocks = [replace(block(), experiment=name) for name in names]
    fault = [SimpleNamespace(severity="serious")]
    experiments = [SimpleNamespace(name=name, findings=fault if name in "bc" else []) for name in names]
    problem = SimpleNamespace(
        likelihood=SimpleNamespace(white=True, blocks=blocks), quantities=(), experiments=experiments
    )
    table = adequacy.adequacy(problem, None, np.ones((1, 1)), {})
    assert [*table.index] == ["a y", "b y", "c y", "d y", "all"]
    assert table["verdict"].tolist() == [
        "misspecified",
        "recording not sound",
        "not tested",
        "adequate",
        "misspecified",
    ]
    assert table["p"].tolist() == pytest.approx([6e-5, 1.0, np.nan, 1.0, 6e-5], nan_ok=True)
    assert table["spectrum"].tolist() == ["measured", "assumed", "assumed", "assumed", ""]
    assert table["channel"].tolist() == ["y"] * 4 + ["all"] and table["experiment"].tolist() == [*names, "all"]
    tests["a"] = (0.5, 0.5, 3.0)
    table = adequacy.adequacy(problem, None, np.ones((1, 1)), {})
    sound = ["adequate", "recording not sound", "not tested", "adequate", "recording not sound"]
    assert table["verdict"].tolist() == sound
    for experiment in experiments:
        experiment.findings = []
    assert adequacy.adequacy(problem, None, np.ones((1, 1)), {}).loc["all", "verdict"] == "adequate"


@pytest.mark.parametrize("correlated", [True, False])
def test_quantities_have_a_row_each_and_their_blocks_none(monkeypatch, correlated):
    """After those of channels; with the noise of the first of the draws, or the medians of white noise."""
    shapes, asked = [], []

    class Known:
        def __init__(self, problem, here, shape):
            assert (problem.quantities, here) == (("size", "phase"), "here")
            shapes.append(self)
            self.shape = shape.tolist()

        def spectral_tests(self, index):
            assert index == 1
            return 0.5, 0.5, 2.0

        def spectrum(self, index):
            return None

        def consistency(self):
            return 0.3

    def table_row(problem, quantity, white):
        asked.append((problem.quantities, white.shape))
        return {"experiment": "all", "channel": quantity, "whiteness": 1e-9, "size": 0.25, "spectrum": ""}

    def size(problem, here, index, white):
        assert (problem.quantities, here, index, white) == (("size", "phase"), "here", 1, shapes[0])
        return 0.5, 0.25

    def amplitude(problem, one, replicates):
        assert (problem.quantities, one.channel, replicates) == (("size", "phase"), "y", "replicates")
        return 0.75

    for name, function in {"Whitened": Known, "_table_row": table_row, "_size": size, "_amplitude": amplitude}.items():
        monkeypatch.setattr(adequacy, name, function)
    blocks = [block("size"), block("y"), block("phase")]
    likelihood = SimpleNamespace(white=not correlated, blocks=blocks)
    problem = SimpleNamespace(likelihood=likelihood, quantities=("size", "phase"), experiments=[])
    table = adequacy.adequacy(problem, "here", np.array([[1.0], [7.0], [3.0]]), "replicates")
    assert [*table.index] == ["run y", "size", "phase", "all"]
    assert asked == [(("size", "phase"), [1.0 if correlated else 3.0])] * 2 and len(shapes) == (3 if correlated else 1)
    assert table["size"].tolist() == pytest.approx([0.5, 0.25, 0.25, np.nan], nan_ok=True)
    assert table["amplitude"].tolist() == pytest.approx([0.75, np.nan, np.nan, np.nan], nan_ok=True)
    assert table["harmonic"].tolist() == pytest.approx([2.0, np.nan, np.nan, np.nan], nan_ok=True)
    assert table["verdict"].tolist() == ["adequate", "misspecified", "misspecified", "misspecified"]
    assert table.loc["all", "consistency"] == pytest.approx(0.3)
    # Nine tests: of three rows, and of all of them together.
    assert table["p"].tolist() == pytest.approx([1.0, 9e-9, 9e-9, 9e-9])


def test_advice_on_other_orbits_names_them():
    assert orbit_advice(SimpleNamespace(other_orbits={"a": "", "b": ""})) == (
        "first fit the measured orbit of 'a', 'b', see fit.other_orbits"
    )
    assert orbit_advice(SimpleNamespace(other_orbits={})) == ""


def test_outputs_vary_about_their_mean_unless_all_points_of_a_mask_are_equal():
    output = np.array([1.0, 4.0, 4.0, 3.0])
    seen = SimpleNamespace(mask="given", measured_points=np.array([1, 2]))
    assert climbs._varying(seen, output).tolist() == output.tolist()
    seen.measured_points = np.array([0, 3])
    assert climbs._varying(seen, output).tolist() == (output - 2.0).tolist()
    constant = SimpleNamespace(mask=None, measured_points=slice(None))
    assert climbs._varying(constant, np.full(4, 3.0)).tolist() == [0.0] * 4
