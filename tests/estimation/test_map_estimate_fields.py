"""Fields of an estimate, as `map_estimate._describe` and `check.checked` fill them in, and why there is none."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic.density.log_posterior import RIDGE_COORDINATES
from bayesperiodic.estimation import check, map_estimate
from bayesperiodic.estimation.gauss_newton import End
from bayesperiodic.problem.fingerprint import fingerprint
from tests.estimation.test_conflict import DESIGN, INPUT, problem_of
from tests.known import formula_model

SD, COUNT = 0.1, 11
FLAT = {"a": bp.Normal(1.0, 1e3), "b": bp.Normal(2.0, 1e3)}
PRODUCT = formula_model("product", ["a", "b"], lambda p, u, s: {"y": p.a * p.b * u.x})


@pytest.fixture(scope="module")
def problem():
    return problem_of(FLAT, (1.1, 1.8), SD, np.random.default_rng(2))


@pytest.mark.parametrize("checks", [False, True])
def test_fields_of_the_estimate_of_a_regression(problem, checks):
    """Least squares with s² = M/(n − p) and covariance s² (XᵀX)⁻¹; of Student's t with n − p degrees of freedom."""
    fit = bp.map_estimate(problem, starts=1, checks=checks, progress=False)
    y = problem.experiments[0].outputs["y"]
    best = np.linalg.lstsq(DESIGN, y, rcond=None)[0]
    rest = y - DESIGN @ best
    variance = rest @ rest / (COUNT - 2)
    assert fit.status == "converged" and [*fit.theta.values()] == pytest.approx(best, rel=1e-4)
    assert fit.covariance.to_numpy() == pytest.approx(variance * np.linalg.inv(DESIGN.T @ DESIGN), rel=1e-3)
    assert list(fit.covariance) == list(fit.covariance.index) == ["a", "b"]
    assert fit.degrees_of_freedom == pytest.approx({"a": COUNT - 2, "b": COUNT - 2}, rel=1e-3)
    assert fit.noise == pytest.approx({"variance[y]": variance}, rel=1e-4)
    assert fit.noise_prior == problem.noise.prior_text and fit.independent == {"y": COUNT}
    assert list(fit.solutions) == ["run"] and fit.solutions["run"].outputs["y"] == pytest.approx(
        DESIGN @ best, rel=1e-3
    )
    assert fit.residuals["run"]["y"] == pytest.approx(rest, abs=1e-4)
    assert fit.rms == pytest.approx({"y": np.sqrt(np.mean(rest**2))}, rel=1e-4)
    assert fit.fvu == pytest.approx({"y": np.mean(rest**2) / y.var()}, rel=1e-3)
    assert fit.inputs["run"]["x"] == pytest.approx(INPUT) and not fit.input_sd["run"]["x"].any()
    assert fit.input_errors == {} and fit.frequencies.empty and fit.tied == {}
    assert np.all(np.diff(fit.history) >= 0.0) and fit.at_ends == () and fit.other_orbits == {}
    assert fit.other_modes == () and fit.supports == dict.fromkeys("ab", (-np.inf, np.inf))
    (start,) = fit.starts
    assert start == {"objective": fit.history[-1]} | fit.theta
    assert fit.fingerprint == fingerprint(problem)
    assert (fit.joint is None, fit.checks is None) == (not checks, not checks)
    if checks:
        assert fit.joint_mode == pytest.approx(fit.theta | {"variance[y]": rest @ rest / COUNT}, rel=1e-3)
        split = fit.noise_split["y"]
        assert np.isnan(split.measurement) and split.total == pytest.approx(np.sqrt(variance * COUNT / 32), rel=1e-3)
        assert fit.misfit == "" and fit.undetermined == () and fit.input_nonlinearity == {"a": 0.0, "b": 0.0}
        assert abs(fit.doubling_shift["a"]) < 1e-6 and list(fit.doubling_shift) == ["a", "b"]
        # The noise of exact inputs causes none; the robust sd is finite and that of its covariance.
        assert fit.input_noise == {"y": 0.0}
        assert np.sqrt(np.diag(fit.robust_covariance)) == pytest.approx([*fit.robust_sd.values()])
        assert 0.0 < fit.whiteness["y"].p <= 1.0 and fit.prior_conflict.members == ()


@pytest.mark.filterwarnings("ignore:The data do not change under")
def test_parameters_that_are_lost_have_infinite_variances_and_no_covariances():
    """Of the product a·b the data tell one direction only, and uniform priors have no curvature."""
    run = problem_of(FLAT, (1.1, 0.0), SD, np.random.default_rng(2)).experiments
    priors = {"a": bp.Uniform(0.1, 9.0), "b": bp.Uniform(0.1, 9.0)}
    fit = bp.map_estimate(bp.Problem(PRODUCT, run, priors=priors, scheme="fourier"), starts=1, progress=False)
    assert np.diag(fit.covariance).tolist() == [np.inf, np.inf] and fit.sd == {"a": np.inf, "b": np.inf}
    assert np.isnan(fit.covariance.loc["a", "b"]) and np.isnan(fit.covariance.loc["b", "a"])
    assert np.diag(fit.robust_covariance).tolist() == [np.inf, np.inf]
    assert np.isnan([*fit.doubling_shift.values()]).all()
    assert fit.undetermined == ("a -> a·t, b -> b·t^-1",)


def test_a_wrong_model_is_said_to_be_in_the_checks():
    """A third harmonic of five standard deviations of a value, which neither x nor its filtered signal has."""
    clean = problem_of(FLAT, (1.1, 1.8), 0.02, np.random.default_rng(2))
    run = clean.experiments[0]
    y = run.outputs["y"] + 0.5 * np.cos(6 * np.pi * np.arange(32) / 32)
    wrong = bp.Experiment("run", run.frequency, {"y": y}, {"x": INPUT}, samples=32,
                          harmonics={"y": 5, "x": 2}, independent={"y": 11})  # fmt: skip
    problem = bp.Problem(clean.model, [wrong], priors=FLAT, scheme="fourier")
    fit = bp.map_estimate(problem, starts=1, progress=False)
    assert fit.misspecified and "(run y: the residual has excess power in some harmonics (p = " in fit.misfit
    assert "its strongest harmonic is 3" in fit.misfit and "one start was tried" in fit.misfit


def test_parameters_at_an_end_are_named_if_the_data_act_upon_them(problem):
    priors = {"a": bp.Uniform(1.3, 9.0), "b": bp.Normal(2.0, 1e3)}
    one = bp.Problem(problem.model, problem.experiments, priors=priors, scheme="fourier")
    with pytest.warns(UserWarning, match="The estimate of 'a', 1.3, lies at the end"):
        fit = bp.map_estimate(one, starts=1, checks=False, progress=False)
    assert fit.at_ends == ("a",) and fit.supports["a"] == (1.3, 9.0)
    # A density that increases up to an end, and data that say nothing.
    priors = {"a": bp.Normal(1.0, 1e3), "b": bp.TruncatedNormal(9.0, 1e-4, 1.0, 2.0)}
    one = bp.Problem(problem.model, problem.experiments, priors=priors, scheme="fourier", fixed={"variance[y]": 1e8})
    assert bp.map_estimate(one, starts=1, checks=False, progress=False).at_ends == ()


def test_several_optima_have_their_masses_and_a_joint_approximation_without_checks():
    """The sign of a and b is free: two optima of the same mass."""
    run = problem_of(FLAT, (1.1, 0.0), SD, np.random.default_rng(2)).experiments
    model = formula_model("square", ["a"], lambda p, u, s: {"y": p.a**2 * u.x})
    problem = bp.Problem(model, run, priors={"a": bp.Normal(0.3, 50.0)}, scheme="fourier")
    with pytest.warns(UserWarning, match="2 separate optima fit the data"):
        fit = bp.map_estimate(problem, starts=1, checks=False, progress=False)
    (other,) = fit.other_modes
    assert other.theta["a"] == pytest.approx(-fit.theta["a"], rel=1e-3) and other.mass == pytest.approx(0.5, abs=0.01)
    assert fit.joint is not None and fit.checks is None


@pytest.mark.parametrize(("tie", "slope"), [("2*a + a**2", 2.0 + 2.0 * 1.5), ("7", 0.0)])
def test_slopes_of_tied_parameters_are_those_by_free_ones_nan_where_experiments_differ(problem, tie, slope):
    runs = [problem.experiments[0], problem.experiments[0]]
    two = bp.Experiment("two", 0.2, runs[0].outputs, runs[0].inputs, samples=32, harmonics={"y": 5, "x": 2})
    one = bp.Problem(problem.model, [runs[0], two], priors={"a": bp.Normal(1.0, 1.0)}, tied={"b": tie})
    assert map_estimate._tied_slopes(one, np.array([1.5])) == {"b": {"a": pytest.approx(slope)}}
    local = bp.Problem(problem.model, [runs[0], two], priors={"a": bp.Normal(1.0, 1.0)}, tied={"b": tie}, local=("a",))
    found = map_estimate._tied_slopes(local, np.array([1.5, 2.5]))["b"]
    expected = {"a[run]": slope, "a[two]": 0.0} if slope == 0.0 else dict.fromkeys(["a[run]", "a[two]"], np.nan)
    assert found == pytest.approx(expected, nan_ok=True)


def end(theta, objective=0.0, status="converged"):
    here = SimpleNamespace(solver=SimpleNamespace(solutions=lambda theta, sensitivities: ("orbits", sensitivities)))
    return End(SimpleNamespace(theta=np.array(theta), here=here, objective=objective), status, np.zeros(1))


class WithErrors:
    """A problem with errors of inputs, whose linearisations about the iterates are counted."""

    def __init__(self, inputs=True, frequencies=False, errors=None):
        self.noisy_inputs, self.frequency_errors = inputs, {"run": 1} if frequencies else {}
        self.input_errors, self.input_noise = errors or {}, "measured"

    def with_input_errors(self, errors):
        """Return the problem with these errors."""
        return WithErrors(self.noisy_inputs, bool(self.frequency_errors), errors)


def linearised(monkeypatch, reached, finite=lambda count: True):
    """Return what is called; `reached` gives θ and the expected errors after a number of rounds."""
    calls = []

    def estimated_inputs(problem, now, loadings):
        assert isinstance(problem, WithErrors)
        calls.append(("about", float(now.theta[0]), loadings))
        expected = np.array([reached(len(calls))[1]])
        return SimpleNamespace(errors={"run": SimpleNamespace(expected=expected)})

    def climbed(objective, first, progress, most):
        assert (objective, progress) == (curved, "bar") and most in (1, 5)
        return end([reached(len(calls))[0]])

    curved = SimpleNamespace(hessian_and_gradient=lambda iterate: (np.array([[4.0]]), None))

    def input_loadings(problem, theta, orbits, noise):
        assert isinstance(problem, WithErrors)
        return float(theta[0]), orbits, noise

    monkeypatch.setattr(map_estimate, "input_loadings", input_loadings)
    monkeypatch.setattr(map_estimate, "estimated_inputs", estimated_inputs)

    def of_problem(problem, now):
        assert problem.input_errors["run"].expected[0] == reached(len(calls))[1] and now.theta[0] == calls[-1][1]
        return curved, "first" if finite(len(calls)) else None

    monkeypatch.setattr(map_estimate, "of_problem", of_problem)
    monkeypatch.setattr(map_estimate, "climbed", climbed)
    monkeypatch.setattr(map_estimate, "resumed", lambda objective, one: None)
    return calls


@pytest.mark.parametrize(("theta", "errors", "rounds"), [(0.1, 0.1, 7), (0.1, 0.5, 17), (0.5, 0.1, 18)])
def test_errors_of_inputs_are_linearised_until_both_settle(monkeypatch, theta, errors, rounds):
    """Steps of θ below 1e-5 of its sd, 1/2, and of the errors below 1e-5; both shrink by a factor in each round.

    The steps are (1 − q) qⁿ⁻¹ of the distance, 1, for a factor q.
    """
    calls = linearised(monkeypatch, lambda n: (3.0 + theta**n, 2.0 + errors**n))
    problem, last = map_estimate._with_noisy_inputs(WithErrors(), end([4.0]), "bar")
    assert len(calls) == rounds
    assert last.iterate.theta[0] == pytest.approx(3.0 + theta**rounds, abs=1e-12)
    assert problem.input_errors["run"].expected == pytest.approx([2.0 + errors**rounds], abs=1e-12)
    about = [4.0, *(3.0 + theta**n for n in range(1, rounds))]
    assert [call[1] for call in calls] == pytest.approx(about)
    assert calls[0][2] == (4.0, ("orbits", False), "measured")


@pytest.mark.parametrize(("ratio", "later"), [(0.45, 1), (0.55, 5)])
def test_one_step_is_taken_between_linearisations_whose_moves_are_halved_each_time(monkeypatch, ratio, later):
    """The moves of θ shrink by a constant ratio; of the first there is none before."""
    linearised(monkeypatch, lambda n: (3.0 + ratio**n, 2.0))
    climbed, taken = map_estimate.climbed, []

    def counted(objective, first, progress, most):
        taken.append(most)
        return climbed(objective, first, progress, most)

    monkeypatch.setattr(map_estimate, "climbed", counted)
    map_estimate._with_noisy_inputs(WithErrors(), end([4.0]), "bar")
    assert len(taken) > 10 and taken == [5, 1, *[later] * (len(taken) - 2)]


@pytest.mark.parametrize(
    ("inputs", "frequencies", "said"), [(True, False, "inputs"), (False, True, "frequencies"),
                                        (True, True, "inputs and frequencies")],
)  # fmt: skip
def test_errors_that_do_not_settle_are_warned_of(monkeypatch, inputs, frequencies, said):
    calls = linearised(monkeypatch, lambda n: (float(n), 0.0))
    with pytest.warns(UserWarning) as caught:
        _, last = map_estimate._with_noisy_inputs(WithErrors(inputs, frequencies), end([4.0]), "bar")
    assert len(calls) == 40 and last.iterate.theta[0] == 40.0
    joint = ", or take input_noise='joint', in which those of the inputs are parameters" if inputs else ""
    assert str(caught[0].message) == (
        f"The errors of the {said} could not be linearised: estimate or {said} still move when this is repeated, by "
        f"more than 1e-05 of their standard deviations. Average more cycles{joint}."
    )
    # Nor if the density is not finite with the errors.
    calls = linearised(monkeypatch, lambda n: (1.0, 0.0), finite=lambda count: count < 2)
    with pytest.warns(UserWarning, match="could not be linearised"):
        _, last = map_estimate._with_noisy_inputs(WithErrors(inputs, frequencies), end([4.0]), "bar")
    assert len(calls) == 2 and last.iterate.theta[0] == 1.0


def test_exact_inputs_are_not_linearised():
    exact, first = WithErrors(inputs=False), end([4.0])
    assert map_estimate._with_noisy_inputs(exact, first, False) == (exact, first)


def test_the_last_end_is_climbed_on_from(monkeypatch):
    linearised(monkeypatch, lambda n: (3.0, 2.0))
    better = end([3.1])
    monkeypatch.setattr(map_estimate, "resumed", lambda objective, one: better)
    assert map_estimate._with_noisy_inputs(WithErrors(), end([3.0]), "bar")[1] is better


def test_ends_are_moved_and_restated_for_another_objective(monkeypatch):
    first, asked = end([1.0], -5.0, "stalled"), []
    monkeypatch.setattr(map_estimate, "of_problem", lambda problem, iterate: (None, iterate and "moved"))
    found = map_estimate._moved("problem", first)
    assert (found.iterate, found.status, found.history.tolist()) == ("moved", "stalled", [0.0])
    assert map_estimate._moved("problem", None) is None
    monkeypatch.setattr(map_estimate, "of_problem", lambda problem, iterate: (None, None))
    assert map_estimate._moved("problem", first) is None
    monkeypatch.setattr(map_estimate, "resumed", lambda objective, one, most: asked.append((one, most)) or "resumed")
    for least in (-5.0, -4.9):
        assert map_estimate._restated("objective", first, least) == "resumed"
    assert asked == [(first, map_estimate.MAX_STEPS), (first, 0)]


@pytest.mark.parametrize(
    ("near", "fewest", "least"), [(True, 1, map_estimate.SEPARATE_SDS), (False, 1, 0.0), (False, 3, 0.0)]
)
def test_the_first_end_is_climbed_to_unless_tests_decide_on_more_starts(monkeypatch, near, fewest, least):
    calls = []
    monkeypatch.setattr(
        map_estimate, "climbed", lambda *given, halvings, least: calls.append((*given, halvings, least)) or "end"
    )
    monkeypatch.setattr(map_estimate, "on_best_sheets", lambda problem, one, bar: (problem, one, bar))
    objective = SimpleNamespace(density=SimpleNamespace(problem="problem"))
    assert map_estimate._first_end(objective, "first", near, fewest, "bar", 4) == ("problem", "end", "bar")
    assert calls == [(objective, "first", "bar", 4, least)]
    first = end([1.0]).iterate
    rough = map_estimate._first_end(objective, first, True, 2, "bar")
    assert rough.iterate is first and len(calls) == 1


def test_an_estimate_that_is_near_is_climbed_to_without_short_steps(monkeypatch):
    """A step is halved 8 times and no more, and the climb from there ends."""
    tried, here = [], SimpleNamespace(theta=np.zeros(1), noise=None, here=None, objective=0.0)

    class Refused:
        density = SimpleNamespace(problem=SimpleNamespace(joint_prior=SimpleNamespace(
            widths=np.ones(1), median=lambda: np.zeros(1), supports={"a": (-np.inf, np.inf)}
        )))  # fmt: skip

        def hessian_and_gradient(self, iterate):
            return np.eye(1), np.ones(1)

        def longest(self, theta, step):
            return 1.0

        def moved(self, theta, step):
            return theta + step

        def at(self, theta, near, noise):
            tried.append(float(theta[0]))

    for name, value in {
        "on_fewer_points": lambda problem, theta: (None, None), "coarsely": lambda *given: None,
        "first_iterate": lambda problem, theta: here, "objective_near": lambda problem, near: Refused(),
        "on_best_sheets": lambda problem, one, bar: one, "on_measured_orbits": lambda problem, theta, one, bar: one,
        "_with_noisy_inputs": lambda problem, one, bar: (problem, one),
    }.items():  # fmt: skip
        monkeypatch.setattr(map_estimate, name, value)
    assert map_estimate.end_from("problem", np.zeros(1)).status == "stalled"
    assert tried == [0.5**k for k in range(8)]


def refused(monkeypatch, given=True, excluding=(), statuses=None, blocked=None, experiments=1, **changes):
    """Return why there is no start at a = 1.25 and b = 3, with stand-ins for what is looked at."""
    texts = {"not_isolated": "", "singular_start": "", "compared_with_data": "Measured.", "unit_error": "Units."}
    for name, text in (texts | changes).items():
        monkeypatch.setattr(map_estimate, name, lambda *_, text=text: text)
    initial = SimpleNamespace(blocked=blocked)
    monkeypatch.setattr(map_estimate, "simultaneous_fit", lambda problem, theta: initial)
    near = SimpleNamespace(statuses={"run": "converged"} if statuses is None else statuses)
    monkeypatch.setattr(map_estimate, "linearised", lambda problem, theta, one: near if one is initial else None)
    prior = SimpleNamespace(excluding=lambda theta: list(excluding), supports={"a": (0.0, 5.0), "b": (-1.0, np.inf)})
    problem = SimpleNamespace(names=("a", "b"), joint_prior=prior, experiments=[None] * experiments)
    return map_estimate._not_finite(problem, np.array([1.25, 3.0]), given)


START = "start: must have a finite log-posterior, got a = 1.25, b = 3, where the periodic solve ended "


def test_a_start_outside_of_the_prior_is_named_with_the_support(monkeypatch):
    assert refused(monkeypatch, excluding=["b"]) == (
        "start: must be inside the prior's support (-1, inf), got b = 3, where the log-posterior is not finite."
    )
    assert "(0, 5), got a = 1.25, b = 3, where" in refused(monkeypatch, excluding=["a", "b"])


@pytest.mark.parametrize(("count", "where"), [(1, "it is an orbit"), (2, "the other experiments' orbits are")])
def test_an_orbit_that_cannot_be_followed_from_its_guess_is_named(monkeypatch, count, where):
    text = refused(monkeypatch, blocked="run 7", experiments=count, given=False)
    assert text == (
        "start: must be a point from which the orbits can be followed, got a = 1.25, b = 3 (the priors' medians); "
        f"'run 7' cannot be followed from its guess to parameters at which {where}. Leave it out if it may be no "
        "orbit, or give start={…} nearer to the truth."
    )


def test_failed_solves_are_named_with_their_cures(monkeypatch):
    cures = (
        "start={…}, or priors with other medians, at which problem.solve(theta) converges, or try draws of the priors "
        "by starts=8."
    )
    assert refused(monkeypatch) == (
        f"{START}well, but the outputs or the noise are not finite. Give {cures} Measured. Units."
    )
    failed = {"run": "no convergence", "two": "converged", "three": "singular"}
    assert refused(monkeypatch, statuses=failed, compared_with_data="", unit_error="") == (
        f"{START}without the orbit of 'run' (no convergence), 'three' (singular). Give {cures}"
    )
    assert refused(monkeypatch, not_isolated="cycles") == "cycles"
    assert refused(monkeypatch, singular_start="1/x", unit_error="") == (
        f"{START}well, but the outputs or the noise are not finite, because the equations contain 1/x. Give "
        "guess={…} in fold, with states at which they are finite, or start={…}. Measured."
    )
    unresolved = {"run": map_estimate.STATUSES[map_estimate.NOT_RESOLVED]}
    assert "). Give more samples, an odd number of them, or another scheme, such as Problem(scheme='back" in refused(
        monkeypatch, statuses=unresolved
    )


def test_an_estimate_gets_the_joint_approximation_that_it_lacks(monkeypatch):
    seen = []
    density = SimpleNamespace(with_settings=lambda coordinates: coordinates)
    monkeypatch.setattr(check, "at_estimate", lambda problem, fit: (SimpleNamespace(density=density), "peak"))
    monkeypatch.setattr(check, "joint_laplace", lambda sampled, peak: seen.append((sampled, peak)) or "joint")
    monkeypatch.setattr(check, "replace", lambda fit, joint: (fit, joint))
    bare, given = SimpleNamespace(joint=None), SimpleNamespace(joint=pd.DataFrame())
    assert check.with_joint("problem", bare) == (bare, "joint") and seen == [(RIDGE_COORDINATES, "peak")]
    assert check.with_joint("problem", given) is given
