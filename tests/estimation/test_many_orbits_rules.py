"""Which orbits are included, dropped and tried again, with stand-ins for estimates, and values by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation import many_orbits
from bayesperiodic.estimation.many_orbits import OrbitsEstimate
from tests.estimation.test_conflict import INPUT, LINEAR, problem_of

NAMES = "abcde"


def fit(theta=1.0, **changes):
    given = {"theta": {"k": theta}, "other_orbits": {}, "converged": True, "status": "converged", "residuals": {}}
    return SimpleNamespace(**(given | changes))


def included(monkeypatch, accepted, fewest=1, theta=None):
    """Return what is reached, and the calls; `accepted` takes the names tried and how often they were."""
    calls = []

    def with_more(problem, experiments, start):
        names = "".join(one.name for one in experiments)
        calls.append((names, start))
        tried = sum(one == names for one, _ in calls)
        return fit(float(len(calls))) if accepted(names, tried) else f"no {names[-1]}"

    monkeypatch.setattr(many_orbits, "_with_more", with_more)
    monkeypatch.setattr(many_orbits, "_fewest", lambda problem: fewest)
    monkeypatch.setattr(many_orbits, "_at_solutions", lambda experiments, one: list(experiments))
    problem = SimpleNamespace(experiments=[SimpleNamespace(name=name) for name in NAMES])
    reached = many_orbits._one_after_the_other(problem, theta, False)
    return reached.theta, "".join(one.name for one in reached.included), reached.dropped, calls


def test_orbits_are_included_one_after_the_other_from_the_last_estimate(monkeypatch):
    theta, names, dropped, calls = included(monkeypatch, lambda names, tried: True, theta={"k": 0.5})
    assert (theta, names, dropped) == ({"k": 5.0}, NAMES, {})
    starts = [{"k": 0.5}, *({"k": float(n)} for n in range(1, 5))]
    assert calls == [(NAMES[: n + 1], start) for n, start in enumerate(starts)]


def test_the_first_ones_are_included_together_if_one_is_too_few(monkeypatch):
    theta, names, dropped, calls = included(monkeypatch, lambda names, tried: True, fewest=3)
    assert [names for names, _ in calls] == ["abc", "abcd", "abcde"] and calls[0][1] is None
    assert (theta, names, dropped) == ({"k": 3.0}, NAMES, {})


def test_an_orbit_that_fails_is_tried_once_more_at_the_end(monkeypatch):
    _, names, dropped, calls = included(monkeypatch, lambda names, tried: names[-1] != "b" or "e" in names)
    assert [names for names, _ in calls] == ["a", "ab", "ac", "acd", "acde", "acdeb"]
    assert (names, dropped) == ("acdeb", {})
    _, names, dropped, calls = included(monkeypatch, lambda names, tried: names[-1] not in "bd")
    assert [names for names, _ in calls] == ["a", "ab", "ac", "acd", "ace", "aceb", "aced"]
    assert (names, dropped) == ("ace", {"b": "no b", "d": "no d"})
    # Of those that are too few alone the first one is left out, until a group is included.
    _, names, dropped, calls = included(monkeypatch, lambda names, tried: names[0] != "a", fewest=2)
    assert [names for names, _ in calls] == ["ab", "bc", "bcd", "bcde", "bcdea"]
    assert (names, dropped) == ("bcdea", {})
    theta, names, dropped, _ = included(monkeypatch, lambda names, tried: False)
    assert (theta, names, dropped) == (None, "", {name: f"no {name}" for name in NAMES})


class Few:
    """A problem that needs at least two experiments, and has two parameters."""

    names = ("k", "c")
    experiments = (1, 2, 3)

    def __init__(self, experiments=None):
        self.given = experiments

    def with_experiments(self, experiments):
        """Return the problem with these, a ValueError for too few of them."""
        if len(experiments) < 2:
            raise ValueError("too few values")
        return Few(experiments)

    def median(self):
        """Return the medians of the priors."""
        return np.array([10.0, 20.0])

    def vector(self, theta):
        """Return the values in the order of the names."""
        return np.array([theta[name] for name in self.names])


def test_the_fewest_orbits_are_those_with_enough_values(monkeypatch):
    assert many_orbits._fewest(Few()) == 2
    monkeypatch.setattr(Few, "experiments", (1,))
    assert many_orbits._fewest(Few()) == 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        ({"other_orbits": {"a": "half", "b": "x"}}, "'a' turns into another orbit (half)"),
        ({"converged": False, "status": "stalled"}, "the estimate with it ends 'stalled'"),
    ],
)
def test_an_estimate_with_more_orbits_must_converge_on_the_measured_ones(monkeypatch, changes, said):
    result, theta, calls = fit(**({"residuals": {"a": "of a", "b": "of b"}} | changes)), {"c": 3.0}, []
    monkeypatch.setattr(many_orbits, "_fitted", lambda problem, start: calls.append((problem.given, start)) or result)
    monkeypatch.setattr(many_orbits, "_unexplained", lambda one, residual: shares[one.name, residual])
    runs, shares = [SimpleNamespace(name=name) for name in "ab"], {("a", "of a"): 0.1, ("b", "of b"): 0.5}
    reached = many_orbits._with_more(Few(), runs, theta)
    assert reached is result if said is None else reached == said
    assert calls == [(runs, theta)]
    if said is None:
        shares["b", "of b"] = 0.51
        assert many_orbits._with_more(Few(), runs, theta) == (
            "'b' turns into another orbit, which leaves 51% of the measured one unexplained"
        )
    result = None
    lost = "the model has no such orbit near the estimate from the others"
    assert many_orbits._with_more(Few(), runs, theta) == lost
    assert many_orbits._with_more(Few(), runs[:1], theta) == "too few values"


def test_further_orbits_are_fitted_from_the_estimate_and_the_first_ones_from_the_priors(monkeypatch):
    calls, problem, iterate = [], Few(), SimpleNamespace(theta=np.array([1.0, 2.0]))
    solver = SimpleNamespace(solutions=lambda theta, sensitivities: ("solutions", theta.tolist(), sensitivities))
    iterate.here = SimpleNamespace(solver=solver, other_orbits={"a": "half"}, compared=lambda: "residuals")
    end = SimpleNamespace(iterate=iterate, status="stalled")
    monkeypatch.setattr(many_orbits, "_with_guesses", lambda one, start: calls.append(start.tolist()) or one)
    monkeypatch.setattr(many_orbits, "end_from", lambda one, start: calls.append(start.tolist()) or end)
    monkeypatch.setattr(many_orbits, "first_iterate", lambda one, start: first)
    monkeypatch.setattr(many_orbits, "map_estimate", lambda one, **given: calls.append(given) or fit(solutions="s"))
    assert many_orbits._fitted(problem, {"c": 3.0}) == (
        {"k": 1.0, "c": 2.0}, "stalled", {"a": "half"}, "residuals", ("solutions", [1.0, 2.0], False)
    )  # fmt: skip
    assert calls == [[10.0, 3.0], [10.0, 3.0]]
    end = first = None
    assert many_orbits._fitted(problem, {"c": 3.0}) is None and many_orbits._fitted(problem, None) is None
    calls.clear()
    first = "an iterate"
    assert many_orbits._fitted(problem, None) == ({"k": 1.0}, "converged", {}, {}, "s")
    assert calls == [[10.0, 20.0], {"checks": False, "progress": False}]


def test_values_over_an_orbit_that_are_not_explained_are_relative_to_their_variance():
    """Of at least `FEWEST_JUDGED` values that vary; those of other points of the grid do not count."""
    points = 2 * many_orbits.FEWEST_JUDGED
    mask = np.arange(points) % 2 == 0
    y = np.where(mask, np.cos(2 * np.pi * np.arange(points) / points), 77.0)
    run = SimpleNamespace(name="run", samples=points, periods=1, mask=mask, winding={},
                          outputs={"y": y, "flat": np.full(points, 3.0)})  # fmt: skip
    residual = np.where(mask, 0.3, 55.0)
    residuals = {"y": residual, "flat": residual}
    assert many_orbits._unexplained(run, residuals) == pytest.approx(0.09 / np.var(y[mask]))
    run.winding = {"y": 1}
    assert many_orbits._unexplained(run, residuals) == 0.0
    run.winding, run.mask = {}, mask & (np.arange(points) < points - 2)
    assert many_orbits._unexplained(run, residuals) == 0.0
    run.mask = None
    assert many_orbits._unexplained(run, residuals) == pytest.approx(np.mean(residual**2) / np.var(y))


def test_residuals_in_standard_errors_are_whitened_by_the_covariance_of_the_values():
    """Values point by point, the channels of a point side by side; other parts of the covariance are left out."""
    root = np.random.default_rng(1).standard_normal((5, 5))
    covariance = root @ root.T + np.eye(5)
    mask = np.array([True, False, True, False])
    y, z = np.array([1.0, 9.0, 2.0, 9.0]), np.array([3.0, 9.0, 4.0, 9.0])
    run = SimpleNamespace(samples=4, periods=1, mask=mask, outputs={"y": y, "z": z}, covariance=covariance)
    values = np.array([1.0, 3.0, 2.0, 4.0])
    expected = np.sqrt(values @ np.linalg.inv(covariance[:4, :4]) @ values / 4)
    assert many_orbits._in_standard_errors(run, {"y": y, "z": z}) == pytest.approx(expected)


@pytest.mark.parametrize(("multiplier", "shown"), [(-12.345678 + 1e-9j, "-12.346"), (3.0 + 4.0j, "3+4j"), (0.5, "0.5")])
def test_orbits_are_listed_with_periods_multipliers_and_residuals(multiplier, shown):
    mask = np.array([True, False, True, False])
    y = np.array([1.0, 9.0, 2.0, 9.0])
    runs = [
        SimpleNamespace(name="one", periods=2, samples=2, mask=None, covariance=None, outputs={"y": y}),
        SimpleNamespace(name="two", periods=1, samples=4, mask=mask, covariance=4.0 * np.eye(2), outputs={"y": y}),
    ]
    solutions = {"one": SimpleNamespace(multipliers=np.array([multiplier, 0.1])),
                 "two": SimpleNamespace(multipliers=np.array([7.0]))}  # fmt: skip
    estimate = SimpleNamespace(solutions=solutions, residuals={"one": {"y": y}, "two": {"y": y}})
    table = OrbitsEstimate(SimpleNamespace(experiments=runs), estimate, {}).table
    assert table["periods"].tolist() == [2, 1] and table["multiplier"].tolist() == [shown, "7"]
    assert table["rms[y]"].tolist() == pytest.approx([np.sqrt(np.mean(y**2)), np.sqrt(2.5)])
    assert np.isnan(table.loc["one", "rms/sd"]) and table.loc["two", "rms/sd"] == pytest.approx(np.sqrt(2.5) / 2.0)


def test_all_orbits_are_fitted_together_with_their_covariances_from_the_first_solutions(monkeypatch):
    calls = []
    monkeypatch.setattr(many_orbits, "replace", lambda one, guess: (one.name, guess))
    monkeypatch.setattr(many_orbits, "_with_more", lambda *given: calls.append(given) or answer)
    monkeypatch.setattr(many_orbits, "_at_solutions", lambda runs, estimate: ("solved", runs))
    problem = SimpleNamespace(experiments=[SimpleNamespace(name=name) for name in "abc"])
    first = many_orbits._Reached({"k": 2.0}, [SimpleNamespace(name=n, guess=n.upper()) for n in "ca"], {"b": "lost"})
    answer, runs = fit(3.0), [("c", "C"), ("a", "A")]
    reached = many_orbits._together(problem, first)
    assert reached == ({"k": 3.0}, ("solved", runs), {"b": "lost"})
    assert calls == [(problem, runs, {"k": 2.0})]
    answer = "no orbit"
    assert many_orbits._together(problem, first) is None
    assert many_orbits._together(problem, first._replace(included=[])) is None and len(calls) == 2


def test_covariances_are_replaced_by_an_unknown_variance_of_each_channel():
    plain = problem_of({"a": bp.Normal(1.0, 1.0)}, (1.0, 0.0), 0.1, np.random.default_rng(1), fixed={"b": 0.0})
    assert many_orbits._without_covariances(plain) is None
    mask = np.arange(32) % 4 == 0
    given = {"samples": 32, "mask": mask, "covariance": 0.01 * np.eye(8)}
    run = bp.Experiment("run", 0.2, plain.experiments[0].outputs, {"x": INPUT}, **given)
    problem = bp.Problem(LINEAR, [run], priors={"a": bp.Normal(1.0, 1.0)}, fixed={"b": 0.0, "scale": 1.0})
    loose = many_orbits._without_covariances(problem)
    assert loose.experiments[0].covariance is None and loose.noise_names == ("variance[y]",)
    assert loose.fixed == {"b": {"run": 0.0}} and loose.free_noise == ("variance[y]",)


def test_parameters_that_are_not_known_yet_are_at_the_medians():
    assert many_orbits._of(Few(), {"c": 3.0, "other": 4.0}) == {"k": 10.0, "c": 3.0, "other": 4.0}
