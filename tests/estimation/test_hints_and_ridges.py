"""Hints where a fit fails, warnings about response tables, and profiles on the way back, with stand-ins for solves."""

from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation import fit_warnings, profile, units
from bayesperiodic.estimation.profile import Point, Ridge
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, STATUSES

LOST, GOOD = STATUSES[NOT_FINITE], STATUSES[CONVERGED]


def described(guesses, autonomous=True):
    """Return a problem of experiments with these guesses."""
    runs = [SimpleNamespace(name=name, guess=guess) for name, guess in guesses.items()]
    equations = {name: SimpleNamespace(name=name, static_guess=lambda p: ("static", p)) for name in guesses}
    return SimpleNamespace(
        experiments=runs, equations=equations, model=SimpleNamespace(autonomous=autonomous, name="oscillator"),
        parameters=lambda theta, name: [(name, theta.tolist())],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("guess", "start"),
    [(None, ("static", ("two", [[1.0, 2.0]]))), ("data", ("static", ("two", [[1.0, 2.0]]))),
     ({"x": 1}, ("given", {"x": 1}))],
)  # fmt: skip
def test_a_singular_term_is_looked_for_where_the_failed_solve_starts(monkeypatch, guess, start):
    """Of the first experiment whose status is "not finite"."""
    monkeypatch.setattr(units, "as_guess", lambda equations, given: ("given", given))
    monkeypatch.setattr(units, "singular_term", lambda equations, at, parameters: (equations.name, at, parameters))
    problem, theta = described({"one": {"x": 2}, "two": guess, "three": None}), np.array([1.0, 2.0])
    statuses = {"one": GOOD, "two": LOST, "three": LOST}
    assert units.singular_start(problem, theta, statuses) == ("two", start, ("two", [[1.0, 2.0]]))
    assert units.singular_start(problem, theta, dict.fromkeys(statuses, GOOD)) == ""
    monkeypatch.setattr(units, "CondensedEquations", SimpleNamespace)
    assert units.singular_start(problem, theta, statuses) == ""


@pytest.mark.parametrize(("guess", "start"), [(None, "static"), ("data", "static"), ({"x": 1}, {"x": 1})])
def test_cycles_that_are_not_isolated_are_named_where_a_solve_failed(monkeypatch, guess, start):
    asked = []
    monkeypatch.setattr(
        units,
        "is_one_of_many",
        lambda equations, parameters, near: asked.append((equations.name, parameters, near)) or many,
    )
    problem, theta = described({"one": None, "two": guess}), np.array([1.0, 2.0])
    statuses, many = {"one": GOOD, "two": LOST}, True
    text = units.not_isolated(problem, theta, statuses)
    assert asked == [("two", ("two", [[1.0, 2.0]]), start)]
    assert text == (
        f"model: must have isolated cycles, got 'oscillator': {units.MANY_CYCLES} If the model has them, but they are "
        "zero at this start, as a damping with a prior about zero, give start={…} where they are not, or priors with "
        "other medians."
    )
    many = False
    assert units.not_isolated(problem, theta, statuses) == ""
    many = True
    assert units.not_isolated(described({"one": None}, autonomous=False), theta, {"one": LOST}) == ""
    assert units.not_isolated(problem, theta, dict.fromkeys(statuses, GOOD)) == ""


def test_data_are_compared_with_the_linearised_model_for_three_experiments(monkeypatch):
    one = units.Scales({"frequency": 2.0, units.FREQUENCY: 3.0, "y": 0.123456}, {units.FREQUENCY: 4.0, "y": 5.0})
    scales = {"a": one, "b": units.Scales({"y": 1.0}, {})}
    monkeypatch.setattr(units, "_scales", lambda problem, theta: scales)
    first = "'a': frequency [Hz] 3 against 4, amplitude of 'y' 0.123 against 5"
    assert units.compared_with_data(None, None) == f"Measured against the linearised model: {first}."
    scales |= {name: one for name in "cd"}
    parts = "; ".join(first.replace("'a'", repr(name)) for name in "acd")
    assert units.compared_with_data(None, None) == f"Measured against the linearised model: {parts}."
    scales |= {name: one for name in "ef"}
    assert units.compared_with_data(None, None) == f"Measured against the linearised model: {parts}; and 2 more."
    scales.clear()
    assert units.compared_with_data(None, None) == ""


def orbit(frequency=1.0, stable=True, multipliers=(0.5,), converged=True):
    return SimpleNamespace(frequency=frequency, stable=stable, multipliers=np.array(multipliers), converged=converged)


def warned(monkeypatch, solutions, jumps=None, condensed=None, smooth=()):
    """Return the warnings about the points of two tables, all measured at 1 Hz."""
    names = [*solutions]
    runs = [SimpleNamespace(name=name, frequency=1.0) for name in names]
    stand_ins = {
        "tables": lambda problem: {"up": runs[:1], "down": runs[1:]} if runs else {},
        "as_guess": lambda equations, solution: (equations, solution),
        "places": lambda problem, theta, near: {name: SimpleNamespace(sheet=(theta, near[name])) for name in names},
        "without_folds": lambda problem, theta: list(smooth),
    }
    seen = []
    stand_ins["early_jumps"] = lambda problem, theta, sheets: seen.append(sheets) or jumps or {}
    for name, function in stand_ins.items():
        monkeypatch.setattr(fit_warnings, name, function)
    if condensed:
        monkeypatch.setattr(fit_warnings, "CondensedModel", SimpleNamespace)
    problem = SimpleNamespace(
        vector=lambda theta: theta["k"], equations={name: f"equations {name}" for name in names}, model=condensed
    )
    texts = list(fit_warnings.table_warnings(problem, SimpleNamespace(theta={"k": 3.0}, solutions=solutions)))
    expected = {name: (3.0, (f"equations {name}", solution)) for name, solution in solutions.items()}
    assert seen == ([expected] if names else [])
    return texts


def test_good_points_of_tables_have_no_warnings(monkeypatch):
    assert warned(monkeypatch, {}) == []
    good = {"a": orbit(), "b": orbit(multipliers=(0.89, -0.95)), "c": orbit(multipliers=(1.0,), converged=False)}
    assert warned(monkeypatch, good) == []


def test_points_beyond_a_fold_are_listed_up_to_four(monkeypatch):
    beyond = {
        name: orbit(frequency=0.9 + 0.01 * n, stable=False, multipliers=(1.0,)) for n, name in enumerate("abcdef")
    }
    (text,) = warned(monkeypatch, beyond)
    assert text == (
        "6 points of response tables were measured where the model at the estimate has no orbit of their branch: 'a', "
        "'b', 'c', 'd' and 2 more; the branch of 'a' ends at a fold at 0.9 Hz. The model may lack a term, or sweep and "
        "resolution may not be those of the measurement."
    )
    listed = fit_warnings._listed
    assert (listed([*"abcde"]), listed([*"abcd"])) == ("'a', 'b', 'c', 'd' and 1 more", "'a', 'b', 'c', 'd'")
    (text,) = warned(monkeypatch, {"a": orbit(), "b": orbit(frequency=1.1)})
    assert text.startswith("1 points of response tables were measured where") and ": 'b'; the branch of 'b'" in text


def test_sweeps_that_jumped_early_are_named_from_two_points_on(monkeypatch):
    up, down = (SimpleNamespace(direction=one, table="t") for one in ("up", "down"))
    jumps = SimpleNamespace(items=lambda: [(up, ["a", "b"]), (down, ["c"])])
    (text,) = warned(monkeypatch, {"a": orbit()}, jumps)
    assert text == (
        "The sweep up of 't' has jumped at 'a', 2 points before the branch ends at the estimate. The sweep may have "
        "had the other direction, or a disturbance ended it early."
    )


def test_points_close_to_folds_and_unstable_ones_are_listed(monkeypatch):
    points = {
        "a": orbit(multipliers=(0.91,)),
        "b": orbit(stable=False, multipliers=(1.05,)),
        "c": orbit(multipliers=(0.2, 1.09)),
        "d": orbit(stable=None),
        "e": orbit(stable=False, converged=False),
    }
    close, unstable = warned(monkeypatch, points)
    assert close == (
        "2 points of response tables are close to a fold of the model at the estimate: 'a', 'c'. The posterior may end "
        "there, which standard deviations do not describe; sample it, or take profiles."
    )
    assert unstable.startswith(
        "1 points of response tables are fitted by unstable orbits: 'b'. They cannot be measured"
    )
    # Of elements that stick those are kept that are close to a fold without their memory.
    owned, plain = SimpleNamespace(state_owners=("f",)), SimpleNamespace(state_owners=())
    assert warned(monkeypatch, points, condensed=owned, smooth=("a",))[0].startswith(
        "1 points of response tables are close"
    )
    assert warned(monkeypatch, points, condensed=plain, smooth=("a",))[0].startswith("2 points")
    assert len(warned(monkeypatch, points, condensed=owned, smooth=("a", "c"))) == 1


def iterate(value, objective):
    return SimpleNamespace(theta=np.array([value]), objective=objective)


class Back(Ridge):
    """A ridge whose climbs from a neighbour reach a known objective at a value, None where there is none."""

    def _climbed(self, start, value, known=None):
        self.objective.calls.append((float(start.theta[0]), value))
        assert (known and known.objective) == self.objective.before[int(value)]
        reached = self.objective.reached.get(value)
        return None if reached is None else iterate(value, reached)


def swept(objectives, reached, at=0.0):
    """Return the objectives after a sweep over points at 0, 1, 2, …, and where the climbs started."""
    objective = SimpleNamespace(calls=[], reached=reached, before=objectives)
    points = [Point(float(n), None if y is None else iterate(float(n), y)) for n, y in enumerate(objectives)]
    found = Back(objective, 0, iterate(at, 0.0))._swept(points)
    assert [one.value for one in found] == [one.value for one in points]
    return [one.iterate and one.iterate.objective for one in found], objective.calls


def test_a_sweep_climbs_from_its_neighbour_up_to_the_peak_and_beyond_while_that_improves():
    # The peak is at 2: the way there is climbed, and behind it only while a point has become better.
    plain = [-4.0, -1.0, 0.0, -1.0, -4.0]
    assert swept(plain, {}, 2.0) == (plain, [(0.0, 1.0), (1.0, 2.0)])
    better = {1.0: -0.5, 2.0: 0.0, 3.0: -0.5}
    assert swept(plain, better, 2.0) == ([-4.0, -0.5, 0.0, -1.0, -4.0], [(0.0, 1.0), (1.0, 2.0)])
    better = {2.0: 0.5, 3.0: -0.5, 4.0: -4.0}
    assert swept(plain, better, 2.0)[0] == [-4.0, -1.0, 0.5, -0.5, -4.0]
    assert swept(plain, better, 2.0)[1] == [(0.0, 1.0), (1.0, 2.0), (2.0, 3.0), (3.0, 4.0)]


def test_a_sweep_needs_a_gain_and_replaces_points_without_an_iterate():
    least = profile.LEAST_IMPROVEMENT
    plain = [-4.0, -1.0, 0.0]
    assert swept(plain, {1.0: -1.0 + 0.9 * least}, 2.0)[0] == plain
    assert swept(plain, {1.0: -1.0 + 1.1 * least}, 2.0)[0] == [-4.0, -1.0 + 1.1 * least, 0.0]
    assert swept([-4.0, None, 0.0], {1.0: -9.0}, 2.0)[0] == [-4.0, -9.0, 0.0]
    # From the last one that has an iterate; without any there is none to climb from.
    assert swept([-4.0, None, -1.0, 0.0], {}, 3.0)[1] == [(0.0, 1.0), (0.0, 2.0), (2.0, 3.0)]
    assert swept([None, -1.0, 0.0], {}, 2.0) == ([None, -1.0, 0.0], [(1.0, 2.0)])
    # A sweep that begins at the peak has nothing to repeat.
    assert swept([0.0, -1.0, -4.0], {1.0: 5.0}) == ([0.0, -1.0, -4.0], [])


class Tangent(Ridge):
    """A ridge along which the second parameter changes by half of the change of the first."""

    def _tangent(self, iterate):
        return np.array([1.0, 0.5]), 1.0

    def _meets(self, first, known):
        return known == "met"


@pytest.mark.parametrize(
    ("finite", "start"), [("both", [3.0, 6.0]), ("tangent", [3.0, 6.0]), ("plain", [3.0, 5.0]), ("none", None)]
)
@pytest.mark.parametrize("known", [None, "met", "other"])
def test_climbs_on_a_ridge_start_along_it_or_beside_it(monkeypatch, finite, start, known):
    """At (1, 5), to 3: along the ridge at (3, 6), with the others as they are at (3, 5), the better of both."""

    def at(theta, here, noise):
        assert (here, noise) == ("here", "noise")
        kind = "tangent" if theta.tolist() == [3.0, 6.0] else "plain"
        return SimpleNamespace(theta=theta, objective=-len(kind)) if finite in (kind, "both") else None

    if finite == "both":
        start = [3.0, 5.0]  # the better one
    monkeypatch.setattr(
        profile, "climb", lambda objective, first, held: SimpleNamespace(iterate=(first, held.tolist()))
    )
    objective = SimpleNamespace(at=at, anchored=lambda one: one.theta.tolist())
    ridge = Tangent(objective, 0, SimpleNamespace(theta=np.zeros(2)))
    here = SimpleNamespace(theta=np.array([1.0, 5.0]), here="here", noise="noise")
    found = ridge._climbed(here, 3.0, known)
    assert found == (known if start is None or known == "met" else (start, [True, False]))


@pytest.mark.parametrize(
    ("moved", "shift", "lower", "met"),
    [(0.09, 0.0, 0.0, True), (0.11, 0.0, 0.0, False), (0.0, 0.09, 0.0, True), (0.0, 0.11, 0.0, False),
     (0.08, 0.08, 0.0, False), (0.0, 0.0, -1e-9, False)],
)  # fmt: skip
def test_an_iterate_meets_a_known_one_within_a_tenth_of_noise_and_prior(moved, shift, lower, met):
    """By the residuals in units of the noise of the known one, 2, and the parameters in widths of their priors, 4."""
    likelihood = SimpleNamespace(whitened=lambda residuals, noise: [r / noise for r in residuals])
    problem = SimpleNamespace(likelihood=likelihood, joint_prior=SimpleNamespace(widths=np.array([4.0, 4.0])))
    ridge = Ridge(SimpleNamespace(density=SimpleNamespace(problem=problem)), 0, None)

    def one(residual, theta, objective, noise):
        here = SimpleNamespace(residuals=[np.array([1.0, residual]), np.array([3.0])])
        return SimpleNamespace(theta=np.array([1.0, theta]), here=here, noise=noise, objective=objective)

    known = one(5.0, 7.0, -3.0 + lower, 2.0)
    assert ridge._meets(one(5.0 + 2.0 * moved, 7.0 - 4.0 * shift, -3.0, 9.0), known) is met


def test_profiles_are_extended_where_the_way_back_raises_an_end(monkeypatch):
    """Outwards from both ends of the points, at first the peak, by half of its standard deviation, 0.2."""
    asked, answers = [], [[1.2], [2.1], [], [2.3], [], []]

    class Followed(Ridge):
        def _size(self):
            return 0.2

        def _outwards(self, start, step, top):
            asked.append((start.value, step, top))
            return [Point(value, iterate(value, value)) for value in answers.pop(0)]

        def _swept(self, points):
            asked.append([point.value for point in points])
            return points

    peak = SimpleNamespace(theta=np.array([2.0]), objective=1.5)
    points = Followed(None, 0, peak).followed()
    assert [point.value for point in points] == [1.2, 2.0, 2.1, 2.3]
    assert asked == [
        (2.0, pytest.approx(-0.1), 1.5), (2.0, pytest.approx(0.1), 1.5), [1.2, 2.0, 2.1], [2.1, 2.0, 1.2],
        (1.2, pytest.approx(-0.1), 2.1), (2.1, pytest.approx(0.1), 2.1), [1.2, 2.0, 2.1, 2.3], [2.3, 2.1, 2.0, 1.2],
        (1.2, pytest.approx(-0.1), 2.3), (2.3, pytest.approx(0.1), 2.3),
    ]  # fmt: skip
    answers[:] = [[3.0]] * 10
    assert len(Followed(None, 0, peak).followed()) == 11, "five times at most"


def test_names_of_profiles_are_those_of_free_parameters():
    problem = SimpleNamespace(names=("a", "b"))
    assert profile._checked_names(problem, None) == ("a", "b")
    assert profile._checked_names(problem, ["b", "a", "b"]) == ("b", "a")
    with pytest.raises(ValueError, match=r"^names: must be a sequence of names such as \('a', 'b'\), got 'a'\.$"):
        profile._checked_names(problem, "a")
    with pytest.raises(ValueError, match="^names: must be one of 'a', 'b', got 'c'"):
        profile._checked_names(problem, ["c"])


def test_a_followed_profile_has_nan_where_there_is_no_iterate(monkeypatch):
    points = [Point(1.0, iterate(1.0, -2.0)), Point(3.0, None)]
    monkeypatch.setattr(profile.Ridge, "followed", lambda self: points)
    monkeypatch.setattr(profile.Ridge, "limits", lambda self: (0.0, bp.Normal(0.0, 1.0).support[1]))
    limits, values, density, paths = profile._followed(("objective", iterate(1.0, -2.0)), 0)
    assert limits == (0.0, np.inf) and values.tolist() == [1.0, 3.0]
    assert density[0] == -2.0 and paths[0].tolist() == [1.0] and np.isnan([density[1], paths[1, 0]]).all()
