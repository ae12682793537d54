"""Where climbs start: measured orbits, coarse solves of condensed models, and draws, with stand-ins for solves."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayesperiodic.estimation import climbs
from bayesperiodic.estimation.gauss_newton import MAX_STEP_HALVINGS, MAX_STEPS, End
from bayesperiodic.periodic.batch import Anchor


def iterate(theta, objective=0.0, **here):
    given = {"other_orbits": {}, "solver": None}
    return SimpleNamespace(theta=np.array(theta), here=SimpleNamespace(**(given | here)), objective=objective)


def stand_ins(monkeypatch, **functions):
    for name, function in functions.items():
        monkeypatch.setattr(climbs, name, function)


class Condensed:
    """A condensed model, with or without internal states."""

    def __init__(self, owners=()):
        self.state_owners = owners


def anchors(*points):
    each = {str(n): SimpleNamespace(anchor=Anchor.__new__(Anchor)) for n in range(len(points))}
    for one, count in zip(each.values(), points, strict=True):
        object.__setattr__(one.anchor, "z", np.zeros((count, 1)))
    return each


@pytest.mark.parametrize(
    ("owners", "points", "coarse", "precise"),
    [((), (256,), True, True), ((), (255, 100), False, True), ((), (100, 256), True, True), (("f",), (), True, False),
     ((), None, True, False)],
)  # fmt: skip
def test_condensed_models_are_first_solved_coarsely_where_that_is_cheaper(monkeypatch, owners, points, coarse, precise):
    """With internal states always; without them from 256 points of a period on, and where there is no first orbit."""
    first = None if points is None else iterate([1.0], solver=SimpleNamespace(anchors=anchors(*points)))
    seen = []

    def replaced(**changes):
        seen.append(changes)
        return SimpleNamespace(equations={})

    problem = SimpleNamespace(
        model=Condensed(owners), replace=replaced, input_errors={}, anchors={}, equations={"run": 1.0, "two": 2.0}
    )
    stand_ins(
        monkeypatch, CondensedModel=Condensed, tables=lambda one: {}, first_iterate=lambda one, theta: first,
        replace=lambda equations, coarseness: (equations, coarseness),
    )  # fmt: skip
    found, start = climbs.on_fewer_points(problem, np.ones(1))
    assert (found is not None, start is not None) == (coarse, precise) and (start is first or owners)
    if coarse:
        assert found.equations == {"run": (1.0, 1000.0), "two": (2.0, 1000.0)}
        assert seen == [{"input_errors": None, "anchors": None}]
    stand_ins(monkeypatch, tables=lambda one: {"table": []})
    assert climbs.on_fewer_points(problem, np.ones(1)) == (None, None)
    stand_ins(monkeypatch, tables=lambda one: {}, CondensedModel=int)
    assert climbs.on_fewer_points(problem, np.ones(1)) == (None, None)


def test_coarse_climbs_end_at_one_standard_deviation_and_are_carried_to_the_problem(monkeypatch):
    calls, known = [], End(iterate([9.0]), "converged", None)
    first, ends = iterate([1.0]), [known]
    reached = End(iterate([2.0]), "converged", None)

    def climbed(*arguments):
        calls.append(arguments)
        return reached

    stand_ins(
        monkeypatch, first_iterate=lambda problem, theta: first if theta > 0.0 else None, climbed=climbed,
        objective_near=lambda problem, here: ("objective", problem, here is first.here),
        of_problem=lambda problem, one: ("no", (problem, one)),
    )  # fmt: skip
    assert climbs.coarsely("problem", "coarse", 1.0, "bar", ends, 3) == ("problem", reached.iterate)
    assert calls == [(("objective", "coarse", True), first, "bar", MAX_STEPS, ends, 3, 1.0)]
    climbs.coarsely("problem", "coarse", 1.0, "bar")
    assert calls[1][4:6] == ((), MAX_STEP_HALVINGS)
    reached = known
    assert climbs.coarsely("problem", "coarse", 1.0, "bar", ends) is known.iterate
    assert climbs.coarsely("problem", "coarse", -1.0, "bar") is None
    assert climbs.coarsely("problem", None, 1.0, "bar") is None


def test_an_iterate_of_another_problem_is_solved_again_from_its_orbits(monkeypatch):
    class Density:
        def __init__(self, problem, solver):
            self.given = problem, solver

        def linearise(self, theta):
            """Return what was given."""
            return (*self.given, theta.tolist())

    stand_ins(
        monkeypatch, LogPosterior=Density,
        objective_near=lambda problem, near: SimpleNamespace(near=near, iterate=lambda *given, all_shapes: given),
    )  # fmt: skip
    solver = SimpleNamespace(problem="same", carried=lambda problem, theta: ("carried", problem, theta.tolist()))
    one = iterate([1.0], solver=solver)
    one.noise = "noise"
    objective, same = climbs.of_problem("same", one)
    assert same is one and objective.near is one.here
    objective, other = climbs.of_problem("other", one)
    near = ("other", ("carried", "other", [1.0]), [1.0])
    assert objective.near == near and other == (near, "noise")


def starting(monkeypatch, initial, finite=(True, True), whole=True, prior=0.0):
    """Return the first iterate at θ, with linearisations at what `initial` gives or at θ, if they are finite."""
    near = iter(finite)
    stand_ins(
        monkeypatch, simultaneous_fit=lambda problem, theta: initial,
        linearised=lambda problem, theta, given: ("fitted" if given else "plain"),
        objective_near=lambda problem, here: SimpleNamespace(
            iterate=lambda one, noise: (one, noise) if next(near) else None
        ),
    )  # fmt: skip
    problem = SimpleNamespace(
        joint_prior=SimpleNamespace(log_prob=lambda theta: prior), likelihood=SimpleNamespace(guess=lambda: "guess"),
        observations={"run": SimpleNamespace(whole=whole), "point": SimpleNamespace(whole=False)},
    )  # fmt: skip
    return climbs.first_iterate(problem, np.ones(1))


def test_climbs_start_where_orbits_and_parameters_fit_together(monkeypatch):
    """Or else at the given parameters, unless only single points were measured, whose orbits the fit would give."""
    fitted, without = SimpleNamespace(states={"run": 1}), SimpleNamespace(states={})
    assert starting(monkeypatch, fitted) == ("fitted", "guess")
    assert starting(monkeypatch, fitted, (False, True)) == ("plain", "guess")
    assert starting(monkeypatch, without, (True,)) == ("plain", "guess")
    assert starting(monkeypatch, None, (True,)) == ("plain", "guess")
    assert starting(monkeypatch, None, (True,), whole=False) == ("plain", "guess")
    assert starting(monkeypatch, fitted, (False, True), whole=False) is None
    assert starting(monkeypatch, without, (True,), whole=False) is None
    assert starting(monkeypatch, None, (False,)) is None
    assert starting(monkeypatch, fitted, prior=-np.inf) is None


def test_linearisations_are_at_the_fitted_orbits_or_near_the_data_or_on_sheets(monkeypatch):
    stand_ins(
        monkeypatch, near_data=lambda problem, theta: problem.near, _on_sheets=lambda problem, here: ("sheets", here),
        LogPosterior=lambda problem, solver: SimpleNamespace(linearise=lambda theta: (solver, theta)),
        ResponseSolver=SimpleNamespace(start=lambda problem, theta, states: (theta, states)),
    )  # fmt: skip
    problem = SimpleNamespace(near="near", density=lambda: SimpleNamespace(linearise=lambda theta: ("here", theta)))
    initial = SimpleNamespace(theta="fitted", states={"run": 1})
    assert climbs.linearised(problem, "theta", initial) == (("fitted", {"run": 1}), "fitted")
    for without in (None, SimpleNamespace(theta="fitted", states={})):
        problem.near = "near"
        assert climbs.linearised(problem, "theta", without) == "near"
        problem.near = None
        assert climbs.linearised(problem, "theta", without) == ("sheets", ("here", "theta"))


def test_points_of_tables_are_put_on_their_best_sheets(monkeypatch):
    here = SimpleNamespace(theta="theta", solver=SimpleNamespace(on_best_sheets=lambda theta: ("best", theta)))
    stand_ins(
        monkeypatch, tables=lambda problem: problem,
        LogPosterior=lambda problem, solver: SimpleNamespace(linearise=lambda theta: (problem, solver, theta)),
    )  # fmt: skip
    assert climbs._on_sheets({}, here) is here
    assert climbs._on_sheets({"table": 1}, here) == ({"table": 1}, ("best", "theta"), "theta")


class Sheets:
    """A solver on a sheet of a table's branch; the best one for θ is given by θ."""

    def __init__(self, sheet):
        self.sheet = sheet

    def on_best_sheets(self, theta):
        """Return the solver on the best sheet."""
        return Sheets(int(theta[0]))

    def on_same_orbits(self, other):
        """Return whether the sheets are the same."""
        return self.sheet == other.sheet


@pytest.mark.parametrize(
    ("better", "finite", "ends"),
    [(True, True, [3, 3]), (True, False, []), (False, True, [2]), ("always", True, [2, 3, 4, 5, 6])],
)
@pytest.mark.parametrize("progress", [True, False])
def test_tables_are_climbed_again_on_better_sheets(monkeypatch, better, finite, ends, progress):
    """Until the sheets do not change, or the density is not finite or not higher; five times at most.

    Climbs end on sheet 3 with a higher density, or, if this is `always` so, on sheets with ever higher numbers.
    """
    climbs_to = []

    def climbed(objective, first, shown):
        assert shown is progress and objective.near.sheet == first[0].sheet and first[1] == "guess"
        climbs_to.append(3 if better is True else len(climbs_to) + 2)
        height = float(len(climbs_to)) if better else -1.0
        return End(iterate([climbs_to[-1]], height, solver=first[0]), "converged", None)

    def objective_near(problem, near):
        return SimpleNamespace(near=near, iterate=lambda here, noise: (here, noise) if finite else None)

    stand_ins(
        monkeypatch, tables=lambda problem: problem.tables, climbed=climbed, objective_near=objective_near,
        LogPosterior=lambda problem, solver: SimpleNamespace(linearise=lambda theta: problem.solved(solver, theta)),
    )  # fmt: skip

    def solved(solver, theta):
        assert solver.sheet == theta[0]
        return solver

    likelihood = SimpleNamespace(guess=lambda: "guess")
    problem = SimpleNamespace(tables={"t": 1}, solved=solved, likelihood=likelihood)
    first = End(iterate([1.0], 0.0, solver=Sheets(0)), "converged", None)
    found = climbs.on_best_sheets(problem, first, progress)
    assert climbs_to == ends
    assert (found is first) == (not better or not finite)
    if better and finite:
        assert found.iterate.objective == len(ends)
    problem.tables = {}
    assert climbs.on_best_sheets(problem, first, progress) is first and climbs_to == ends


class Draws:
    """An objective whose iterates at draws are finite for positive θ."""

    def __init__(self, model):
        likelihood = SimpleNamespace(guess=lambda: "guess")
        self.density = SimpleNamespace(problem=SimpleNamespace(model=model, likelihood=likelihood))

    def at(self, theta, here, noise):
        """Return what was given."""
        return ("at", theta, here, noise) if theta > 0.0 else None

    def anchored(self, one):
        """Return that it was anchored."""
        return ("anchored", one)

    def iterate(self, here, noise):
        """Return what was given."""
        return ("solved", here, noise) if here[1] > 0.0 else None


@pytest.mark.parametrize("condensed", [True, False])
def test_draws_are_solved_from_the_first_end_or_from_the_data(monkeypatch, condensed):
    calls, coarse = [], []

    def coarsely(*arguments):
        coarse.append(arguments)
        return answer

    stand_ins(
        monkeypatch, CondensedModel=Condensed, coarsely=coarsely,
        climbed=lambda objective, first, progress, ends, halvings: calls.append((first, ends, halvings)) or "end",
        linearised=lambda problem, theta, initial: ("near", theta, initial),
    )  # fmt: skip
    objective, ends = Draws(Condensed() if condensed else None), [End(iterate([9.0]), "converged", None)]
    answer = None
    assert climbs._from_draw(objective, ends, 1.0, "bar", "coarse") == "end"
    assert climbs._from_draw(objective, ends, -1.0, "bar", "coarse") is None
    if not condensed:
        assert calls == [(("anchored", ("at", 1.0, ends[0].iterate.here, "guess")), ends, MAX_STEP_HALVINGS)]
        assert coarse == []
        return
    assert calls == [(("solved", ("near", 1.0, None), "guess"), ends, 3)]
    problem = objective.density.problem
    assert coarse == [(problem, "coarse", theta, "bar", ends, 3) for theta in (1.0, -1.0)]
    answer = ends[0].iterate
    assert climbs._from_draw(objective, ends, 1.0, "bar", "coarse") is ends[0]
    answer = iterate([5.0], -2.5)
    rough = climbs._from_draw(objective, ends, 1.0, "bar", "coarse")
    assert (rough.iterate, rough.status, rough.history.tolist()) == (answer, "iterations", [-2.5])
    assert len(calls) == 1


def test_measured_orbits_are_looked_for_from_the_start_and_from_the_estimate(monkeypatch):
    def fitted(problem, theta, states):
        return SimpleNamespace(theta=theta + 0.5, states=states if theta < 5.0 else {})

    stand_ins(
        monkeypatch, CondensedModel=Condensed, simultaneous_fit=fitted,
        near_data=lambda problem, theta: None if theta is None else ("near", theta),
        measured_orbits=lambda problem, theta, solutions: SimpleNamespace(theta=theta, states=solutions),
        linearised=lambda problem, theta, initial: (theta, initial.states),
    )  # fmt: skip
    runs = [SimpleNamespace(outputs={"y": 1}), SimpleNamespace(outputs={"y": 1})]
    problem = SimpleNamespace(model=SimpleNamespace(autonomous=False), experiments=runs)
    solver = SimpleNamespace(
        solutions=lambda theta, sensitivities: {"run": SimpleNamespace(states=(theta, sensitivities))}
    )
    last = SimpleNamespace(theta=7.0, here=SimpleNamespace(solver=solver))
    states = {"run": (7.0, False)}
    assert list(climbs._near_measured_orbits(problem, last, 1.0)) == [(1.0, states), (1.5, states), (7.0, states)]
    runs[1].outputs = {}
    assert list(climbs._near_measured_orbits(problem, last, 1.0)) == []
    runs[1].outputs, problem.model.autonomous = {"y": 1}, True
    assert list(climbs._near_measured_orbits(problem, last, 1.0)) == []
    problem.model = Condensed()
    assert list(climbs._near_measured_orbits(problem, last, 1.0)) == [("near", 7.0)]
    last.theta = None
    assert list(climbs._near_measured_orbits(problem, last, 1.0)) == []


@pytest.mark.parametrize("progress", [True, False])
def test_the_best_climb_from_measured_orbits_is_taken_until_it_is_not_doubtful(monkeypatch, progress):
    """Of four starts the first is not finite, the second is worse and the third good."""
    shown = []

    def climbed(objective, first, bar):
        shown.append(bar)
        return End(iterate([first], -first), "converged", None)

    stand_ins(
        monkeypatch, climbed=climbed, _doubtful=lambda problem, end: end.iterate.objective < -1.0,
        _near_measured_orbits=lambda problem, end, start: iter([0.0, 9.0, 1.0, 0.5]),
        objective_near=lambda problem, near: SimpleNamespace(iterate=lambda here, noise: here or None),
    )  # fmt: skip
    problem = SimpleNamespace(likelihood=SimpleNamespace(guess=lambda: "guess"))
    first = End(iterate([3.0], -3.0), "converged", None)
    found = climbs.on_measured_orbits(problem, None, first, progress)
    assert found.iterate.objective == -1.0 and shown == [progress, progress]
    good = End(iterate([3.0], -0.5), "converged", None)
    assert climbs.on_measured_orbits(problem, None, good, progress) is good and len(shown) == 2
    stand_ins(monkeypatch, _near_measured_orbits=lambda problem, end, start: iter([9.0]))
    assert climbs.on_measured_orbits(problem, None, first, progress) is first
