"""What `identifiability` takes from estimates and draws, and what `Identifiability.__repr__` prints, by hand."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from bayesperiodic.diagnostics import identifiability

ROW = {
    "verdict": "determined", "contraction": 0.96154, "contraction_mcse": 0.0, "p_negative": np.nan,
    "p_negative_mcse": np.nan, "together": 0.2, "alone": 0.104, "prior_sensitivity": np.nan, "profile": "",
    "remarks": "", "remedy": "",
}  # fmt: skip


def printed(rows, converged=True, condition=1234.5):
    """Return the lines of the result with these rows, and the entries of its table by row."""
    table = pd.DataFrame.from_dict({name: ROW | row for name, row in rows.items()}, orient="index")
    result = identifiability.Identifiability(table, None, None, condition, None, None, converged, "By the draws.")
    lines = repr(result).splitlines()
    assert lines[0] == "Identifiability of the parameters (data sd: left by the data alone, in prior sds)"
    return lines[1], {line.split()[0]: line.split()[1:] for line in lines[2 : 2 + len(rows)]}, lines[2 + len(rows) :]


def test_the_table_is_printed_with_errors_and_without_empty_columns():
    title, rows, _ = printed({"a": {}, "b": {"together": 3.21}})
    assert title.split() == ["verdict", "contraction", "data", "sd", "others", "known"]
    assert rows == {"a": ["determined", "0.962", "0.2", "0.1"], "b": ["determined", "0.962", "3.2", "0.1"]}
    title, rows, _ = printed(
        {
            "a": {"contraction_mcse": 0.0123, "prior_sensitivity": 0.0512, "profile": "closed"},
            "b": {"p_negative": 0.25, "p_negative_mcse": 0.0346},
            "c": {"p_negative": 0.75, "p_negative_mcse": 0.0},
        }
    )
    headings = ["verdict", "contraction", "P(negative)", "data", "sd", "others", "known", "prior", "sensitivity"]
    assert title.split() == [*headings, "profile"]
    assert rows == {
        "a": ["determined", "0.962", "±", "0.012", "-", "0.2", "0.1", "0.051", "closed"],
        "b": ["determined", "0.962", "0.250", "±", "0.035", "0.2", "0.1", "-", "-"],
        "c": ["determined", "0.962", "0.750", "0.2", "0.1", "-", "-"],
    }


@pytest.mark.parametrize(
    ("determined", "names"),
    [((), "no parameter"), (("a",), "a"), (("a", "c"), "a and c"), (("a", "b", "c"), "a, b and c")],
)
def test_determined_parameters_are_listed(determined, names):
    rows = {name: {} if name in determined else {"verdict": "not determined"} for name in "abc"}
    assert printed(rows)[2][0] == f"The data determine {names}."


def test_parameters_with_the_same_verdict_remarks_and_remedy_are_listed_together_in_the_order_of_the_table():
    """Not in that of the alphabet; a determined parameter is listed only with remarks or a remedy."""
    _, _, lines = printed(
        {
            "e": {"verdict": "only with the prior", "remedy": "fix it"},
            "d": {"verdict": "not determined", "remarks": "by symmetry", "remedy": "fix one of d, c"},
            "c": {"verdict": "not determined", "remarks": "by symmetry", "remedy": "fix one of d, c"},
            "b": {},
            "a": {"remarks": "at another orbit"},
            "f": {"remedy": "give a guess"},
            "g": {"verdict": "only with the prior", "remedy": "fix it"},
        }
    )
    assert lines == [
        "The data determine b, a and f.",
        "e, g: only with the prior. Recommendation: fix it.",
        "d, c: not determined, by symmetry. Recommendation: fix one of d, c.",
        "a: determined, at another orbit.",
        "f: determined. Recommendation: give a guess.",
        "The condition number of the Fisher information is 1.23e+03.",
        "By the draws.",
    ]
    assert printed({"a": {}}, converged=False)[2][-1] == (
        "The draws have NOT CONVERGED; these results are provisional."
    )


def mode(theta, sd, mass=np.nan, covariance=None):
    names = list(theta)
    covariance = np.eye(len(names)) if covariance is None else covariance
    return SimpleNamespace(theta=theta, sd=sd, mass=mass, joint_covariance=pd.DataFrame(covariance, names, names))


def fitted(theta, sd, others=(), masses=(1.0,), **changes):
    given = {
        "other_modes": others, "modes": pd.DataFrame({"mass": masses}), "starts": ({},),
        "degrees_of_freedom": dict.fromkeys(theta, 7.0),
    }  # fmt: skip
    one = mode(theta, sd, covariance=changes.pop("covariance", None))
    return SimpleNamespace(**vars(one), **(given | changes))


def described(supports, names=None, free=False):
    return SimpleNamespace(
        names=tuple(supports),
        joint_prior=SimpleNamespace(supports=supports),
        plain_names=names or {name: name for name in supports},
        model=SimpleNamespace(autonomous=free),
    )


LINE = (-np.inf, np.inf)


def test_probability_of_a_negative_value_is_that_of_students_t_at_each_optimum_by_mass():
    problem = described({"a": LINE, "b": (0.0, np.inf), "c": (-np.inf, 0.0), "shift[run]": LINE})
    theta, sd = {"a": 1.2, "b": 1.0, "c": -1.0, "shift[run]": 0.1}, {"a": 0.8, "b": 1.0, "c": 1.0, "shift[run]": 1.0}
    other = mode({"a": -0.5, "shift[run]": 0.2}, {"a": 0.25, "shift[run]": 1.0})
    fit = fitted(theta, sd, [other], [0.75, 0.25])
    expected = 0.75 * stats.t.cdf(-1.5, 7.0) + 0.25 * stats.t.cdf(2.0, 7.0)
    assert identifiability._negative(problem, fit, None, "a") == pytest.approx((expected, 0.0))
    fit.degrees_of_freedom["a"] = np.inf
    expected = 0.75 * stats.norm.cdf(-1.5) + 0.25 * stats.norm.cdf(2.0)
    assert identifiability._negative(problem, fit, None, "a") == pytest.approx((expected, 0.0))
    for name in "bc":
        assert np.isnan(identifiability._negative(problem, fit, None, name)).tolist() == [True, True]
    # The zero of the delay of a free-running model is that of an arbitrary phase.
    for free, name, known in [(True, "shift", False), (False, "shift", True), (True, "a", True)]:
        one = described({"shift[run]": LINE}, {"shift[run]": name}, free)
        assert np.isfinite(identifiability._negative(one, fit, None, "shift[run]")).tolist() == [known] * 2


@pytest.mark.parametrize(("negative", "bounded"), [(30, 0.3), (0, 1 / 52), (100, 51 / 52)])
def test_probability_of_a_negative_value_by_draws_has_a_binomial_error(negative, bounded):
    """At least that of one draw in ESS + 2."""
    draws = np.where(np.arange(100) < negative, -1.0, 1.0)
    posterior = SimpleNamespace(draws=lambda name: draws, ess={"a": 50.0})
    found = identifiability._negative(described({"a": LINE}), None, posterior, "a")
    assert found == pytest.approx((negative / 100, np.sqrt(bounded * (1 - bounded) / 50)))


@pytest.mark.parametrize(("spread", "known"), [(0.47, True), (0.53, False)])
@pytest.mark.parametrize("drawn", [True, False])
def test_a_size_is_known_if_its_width_is_less_than_half_of_the_priors(spread, known, drawn):
    """Half of the central 68 % interval of |b|, with b normal, is half of Φ⁻¹(0.921) − Φ⁻¹(0.579) = 0.605.

    Both optima, ±5, have the same absolute value.
    """
    score = 0.5 * (1.0 + stats.norm.cdf([-1.0, 1.0]))
    width = 0.5 * np.diff(stats.norm.ppf(score))[0] * spread / 0.5
    normal = lambda count, _: np.random.default_rng(5).standard_normal((count, 2)) * [9.0, 1.0]  # noqa: E731
    problem = SimpleNamespace(names=("a", "b"), joint_prior=SimpleNamespace(sample=normal))
    draws = 0.5 * width * np.random.default_rng(6).standard_normal(40_000)
    posterior = SimpleNamespace(draws=lambda name: {"b": 5.0 + draws}[name])
    other = mode({"a": 0.0, "b": -5.0}, {"a": 1.0, "b": 0.5 * width})
    fit = fitted({"a": 0.0, "b": 5.0}, {"a": 1.0, "b": 0.5 * width}, [other], [0.5, 0.5])
    assert identifiability._size_known(problem, fit, posterior if drawn else None, "b") is known


def test_a_size_is_that_of_optima_by_their_masses():
    """1 ± 0.01 with 90 % and 3 ± 0.01 with 10 %: the central 68 % are those of the first one."""
    prior = SimpleNamespace(sample=lambda count, _: np.random.default_rng(5).standard_normal((count, 1)))
    problem = SimpleNamespace(names=("a",), joint_prior=prior)
    for masses, known in (([0.9, 0.1], True), ([0.1, 0.9], True), ([0.5, 0.5], False)):
        fit = fitted({"a": 1.0}, {"a": 0.01}, [mode({"a": 3.0}, {"a": 0.01})], masses)
        assert identifiability._size_known(problem, fit, None, "a") is known


def test_widths_of_several_optima_contain_the_distance_between_them():
    """σ² = Σ m (σₘ² + (θₘ − θ̄)²), of ln a and of b, in prior sds."""
    first, second = np.array([[0.04, 0.01], [0.01, 0.09]]), np.array([[0.01, 0.0], [0.0, 0.25]])
    other = mode({"a": np.e**2, "b": 1.0}, {}, covariance=second)
    fit = fitted({"a": 1.0, "b": 5.0}, {}, [other], [0.75, 0.25], covariance=first)
    information = SimpleNamespace(
        coordinates=lambda theta: np.column_stack([np.log(theta[:, 0]), theta[:, 1]]), prior_sd=np.array([2.0, 4.0])
    )
    widths, errors = identifiability._widths(SimpleNamespace(names=("a", "b")), fit, None, information)
    within = 0.75 * np.diag(first) + 0.25 * np.diag(second)
    between = 0.75 * 0.25 * np.array([2.0, 4.0]) ** 2
    assert widths == pytest.approx(np.sqrt(within + between) / [2.0, 4.0]) and errors.tolist() == [0.0, 0.0]


def test_basis_names_draws_or_optima_and_starts():
    fit = fitted({"a": 1.0, "b": 2.0}, {}, starts=({}, {}, {}))
    posterior = SimpleNamespace(ess={"a": 812.4, "b": 400.6, "variance[y]": 3.0})
    assert identifiability._basis(fit, posterior) == (
        "The verdicts rest on 401 or more effective draws of each parameter, and hold for the modes that these have "
        "reached."
    )
    assert identifiability._basis(fit, None).startswith(
        "No draws: the verdicts rest on the Laplace approximation at the only optimum found from 3 starts"
    )
    fit.other_modes = [mode({}, {}, 0.3), mode({}, {}, 0.009)]
    assert identifiability._basis(fit, None).startswith(
        "No draws: the verdicts rest on the Laplace approximations at 2 optima, found from 3 starts"
    )


def symmetry(moves, parameters):
    return SimpleNamespace(transformation=moves, parameters=parameters)


@pytest.mark.parametrize(("ratio", "credible"), [(0.0101, True), (0.0099, False)])
def test_images_under_discrete_symmetries_need_one_percent_of_the_density_and_a_distance(ratio, credible):
    """Change of a to −a, and the exchange of b and c; the values of an image move by more than one sd each."""
    fit = fitted({"a": 2.0, "b": 1.0, "c": 5.0}, {"a": 1.0, "b": 3.9, "c": 4.1})
    structure = SimpleNamespace(
        discrete=[
            symmetry({"a": "-a", "w": "-w"}, ("a",)),
            symmetry({"b": "c", "c": "b"}, ("b", "c")),
            symmetry({"a": "-a", "fixed": "-fixed"}, ("a", "fixed")),
        ]
    )

    def log_prior(theta):
        return np.log(ratio) if theta["a"] < 0.0 or theta["b"] > theta["c"] else 0.0

    problem = SimpleNamespace(log_prior=log_prior)
    found = identifiability._structural_images(problem, fit, structure)
    assert found == ({"a": [-2.0], "b": [5.0]} if credible else {})
    assert identifiability._structural_images(problem, fit, None) == {}


def test_partners_are_the_parameters_of_all_symmetries_of_one():
    structure = SimpleNamespace(symmetries=[symmetry({}, ("a", "b")), symmetry({}, ("c", "d")), symmetry({}, "da")])
    assert identifiability._partners(structure, "a") == "a, b, d"
    assert identifiability._partners(structure, "c") == "c, d"
    assert identifiability._partners(structure, "k") == identifiability._partners(None, "a") == ""
