"""Rules of the Gauss-Newton iteration, of second-order effects and of normal shapes, on densities of closed form."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from bayesperiodic.estimation import fit_warnings, gauss_newton
from bayesperiodic.estimation.gauss_newton import End, Iterate, Objective, climb, inverse_hessian, prior_only, resumed
from bayesperiodic.estimation.laplace import JointLaplace, _moved_together

NAMES = ("a", "b")


class Fake:
    """An objective with the gradient and Hessian of a function of θ; iterates are points of it."""

    def __init__(self, value, slopes, supports=((-np.inf, np.inf),) * 2, widths=(10.0, 10.0), median=(0.0, 0.0)):
        prior = SimpleNamespace(
            supports=dict(zip(NAMES, supports, strict=True)), widths=np.array(widths), median=lambda: np.array(median)
        )
        self.density = SimpleNamespace(problem=SimpleNamespace(joint_prior=prior))
        self.value, self.slopes, self.supports, self.tried = value, slopes, supports, []

    def hessian_and_gradient(self, now):
        """Return those of the function."""
        return self.slopes(now.theta)

    def at(self, theta, here, noise):
        """Return the point at θ; None outside of the supports, or where the function is None."""
        self.tried.append(theta.tolist())
        inside = all(low < x < high for x, (low, high) in zip(theta, self.supports, strict=True))
        value = self.value(theta) if inside else None
        return None if value is None else Iterate(theta, None, None, float(value))

    def start(self, *theta):
        """Return the point at θ."""
        return self.at(np.array(theta, dtype=float), None, None)

    def moved(self, theta, step):
        """Return θ after a step."""
        return theta + step

    def longest(self, theta, step):
        """Return the whole step."""
        return 1.0

    def anchored(self, iterate):
        """Return the same point."""
        return iterate

    def iterate(self, here, noise, *, all_shapes):
        """Return the point at `here`, None if that is None."""
        return here and self.start(*here)


H = np.array([[4.0, 1.0], [1.0, 3.0]])
BEST = np.array([1.0, -2.0])


def parabola(**settings):
    return Fake(lambda x: -0.5 * (x - BEST) @ H @ (x - BEST), lambda x: (H, -H @ (x - BEST)), **settings)


def test_a_parabola_is_climbed_in_one_step():
    end = climb(parabola(), parabola().start(5.0, 5.0))
    assert end.status == "converged" and end.iterate.theta == pytest.approx(BEST)
    off = np.array([4.0, 7.0])
    assert end.history[0] == pytest.approx(-0.5 * off @ H @ off) and end.history[-1] == pytest.approx(0.0)
    assert np.all(np.diff(end.history) > 0.0)


@pytest.mark.parametrize("held, best", [((True, False), (5.0, -2.0 - 4.0 / 3)), ((False, True), (1.0 - 7 / 4, 5.0))])
def test_held_parameters_stay_and_the_others_take_their_conditional_maximum(held, best):
    end = climb(parabola(), parabola().start(5.0, 5.0), np.array(held))
    assert end.status == "converged" and end.iterate.theta == pytest.approx(best)
    both = climb(parabola(), parabola().start(5.0, 5.0), np.array([True, True]))
    assert both.status == "converged" and both.iterate.theta.tolist() == [5.0, 5.0] and len(both.history) == 1


def test_steps_are_halved_until_they_gain_and_as_often_as_allowed():
    """The full step leads to nowhere, and so does half of it."""

    def value(x):
        return None if x[0] < 2.5 and x[0] != 5.0 else -0.5 * (x - BEST) @ H @ (x - BEST)

    objective = Fake(value, parabola().slopes)
    end = climb(objective, objective.start(5.0, -2.0), np.array([False, True]), most=1)
    assert [x for x, _ in objective.tried[1:]] == pytest.approx([1.0, 3.0]) and end.status == "iterations"
    few = Fake(value, parabola().slopes)
    end = climb(few, few.start(5.0, -2.0), np.array([False, True]), halvings=1)
    assert end.status == "stalled" and end.iterate.theta.tolist() == [5.0, -2.0]


def test_a_step_that_gains_nothing_is_the_end_if_it_is_small():
    """Below a thousandth of a standard deviation the errors of the objective decide; otherwise it stalls."""
    for distance, status in ((0.9e-3, "converged"), (1.1e-3, "stalled")):
        flat = Fake(lambda x: 0.0, lambda x, d=distance: (np.diag([4.0, 1.0]), np.array([2.0 * d, 0.0])))
        end = climb(flat, flat.start(0.0, 0.0))
        assert end.status == status and len(end.history) == 1
    # A step below a ten-thousandth is tried once.
    tiny = Fake(lambda x: 0.0, lambda x: (np.diag([4.0, 1.0]), np.array([2.0 * 0.9e-4, 0.0])))
    assert climb(tiny, tiny.start(0.0, 0.0)).status == "converged" and len(tiny.tried) == 2
    resting = Fake(lambda x: 0.0, lambda x: (np.diag([4.0, 1.0]), np.array([2.0 * 0.9e-8, 0.0])))
    assert climb(resting, resting.start(0.0, 0.0)).status == "converged" and len(resting.tried) == 1


@pytest.mark.parametrize(("slope", "status", "steps"), [(2.1e-8, "converged", 1), (2.3e-8, "iterations", 3)])
def test_a_small_step_that_gains_less_than_1e_12_is_the_last(slope, status, steps):
    """Steps of 0.9e-4 standard deviations of ½, along which a line of this slope gains 0.945e-12 or 1.035e-12."""
    rising = Fake(lambda x: slope * x[0], lambda x: (np.diag([4.0, 1.0]), np.array([2.0 * 0.9e-4, 0.0])))
    _, ended, history = gauss_newton._ascend(rising, rising.start(0.0, 0.0), np.zeros(2, dtype=bool), None, 3, 10)
    assert ended == status and len(history) == steps


def test_what_the_climb_reports_to_ends_it():
    """Each report has the step in standard deviations, here the root of the sum of squares."""
    sizes = []
    objective = Fake(lambda x: -0.5 * (x @ x), lambda x: (2.0 * np.eye(2), -x))
    end = climb(objective, objective.start(3.0, 4.0), report=lambda now, size: sizes.append(size) or len(sizes) == 2)
    assert end.status == "ended" and sizes == pytest.approx([5.0 / np.sqrt(2), 2.5 / np.sqrt(2)])
    assert len(end.history) == 3 and climb(objective, objective.start(3.0, 4.0), most=3).status == "iterations"
    unknown = Fake(lambda x: 0.0, lambda x: (np.full((2, 2), np.nan), np.zeros(2)))
    assert climb(unknown, unknown.start(0.0, 0.0)).status == "singular"
    undefined = Fake(lambda x: 0.0, lambda x: (np.eye(2), np.array([0.0, np.nan])))
    assert climb(undefined, undefined.start(0.0, 0.0)).status == "singular"


def test_a_maximum_beyond_a_support_is_that_on_its_end():
    objective = parabola(supports=((2.0, 9.0), (-np.inf, np.inf)))
    end = climb(objective, objective.start(5.0, 5.0))
    assert end.iterate.theta == pytest.approx([2.0, -2.0 - 1.0 / 3], abs=2e-3)
    assert gauss_newton.at_ends(objective, end.iterate).tolist() == [-1.0, 0.0]


@pytest.mark.parametrize("widths, near", [((10.0, 10.0), 0.5e-3), ((0.1, 10.0), 1e-4)])
def test_ends_are_within_a_thousandth_of_a_standard_deviation_or_of_the_width_of_the_prior(widths, near):
    objective = Fake(lambda x: 0.0, lambda x: (np.diag([4.0, 1.0]), None), ((0.0, 1.0), (-5.0, np.inf)), widths)
    for theta, expected in (
        (0.99 * near, -1.0), (1.01 * near, 0.0), (1 - 0.99 * near, 1.0), (1 - 1.01 * near, 0.0),
    ):  # fmt: skip
        assert gauss_newton.at_ends(objective, objective.start(theta, 0.0)).tolist() == [expected, 0.0]
    assert gauss_newton.at_ends(objective, objective.start(0.5, -5.0 + 0.9e-3)).tolist() == [0.0, -1.0]


@pytest.mark.parametrize("curvature, weak", [(1.01, False), (0.99, True), (-1.01, False), (-0.99, True), (0.0, True)])
def test_curvatures_below_that_of_three_widths_of_the_prior_are_replaced(curvature, weak):
    """Or below that of the distance to its median, if this is larger."""
    objective = Fake(None, None, widths=(2.0, 1.0), median=(0.0, 1.0))
    for theta, longest in (((0.0, 1.0), 6.0), ((0.0, 5.0), 6.0), ((-8.0, 1.0), 8.0)):
        given = np.array([[curvature / longest**2, 0.001], [0.001, 4.0]])
        seen = gauss_newton._curved(objective, Iterate(np.array(theta), None, None, 0.0), given)
        expected = np.diag([longest**-2.0, max(3.0, abs(theta[1] - 1.0)) ** -2.0])
        if weak:
            assert seen[0, 0] == pytest.approx(expected[0, 0]) and seen[1, 1] == 4.0
        else:
            assert seen is given


def test_inverses_leave_out_directions_without_curvature_and_name_their_parameters():
    seen, lost = inverse_hessian(H)
    assert seen == pytest.approx(np.linalg.inv(H)) and lost.tolist() == [False, False]
    seen, lost = inverse_hessian(np.diag([4.0, 0.0]))
    assert seen == pytest.approx(np.diag([0.25, 0.0])) and lost.tolist() == [False, True]
    seen, lost = inverse_hessian(np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]]))
    assert seen == pytest.approx(np.array([[0.25, 0.25, 0.0], [0.25, 0.25, 0.0], [0.0, 0.0, 0.5]]))
    assert lost.tolist() == [True, True, False]
    seen, lost = inverse_hessian(np.array([[1.0, np.inf], [np.inf, 1.0]]))
    assert seen.tolist() == [[0.0, 0.0], [0.0, 0.0]] and lost.tolist() == [True, True]
    assert inverse_hessian(-H)[0] == pytest.approx(np.linalg.inv(-H))


@pytest.mark.parametrize("gain, only", [(0.1, True), (0.12, False)])
def test_parameters_with_nine_tenths_of_the_prior_s_variance_are_those_of_the_prior(gain, only):
    """1/(1 + gain) of it; uniform priors have no variance to compare with."""
    prior = np.diag([0.25, 0.0])
    problem = SimpleNamespace(joint_prior=SimpleNamespace(curvature=lambda theta: prior))
    seen = prior_only(problem, np.zeros(2), prior + np.diag([0.25 * gain, 1e-6]))
    assert seen.tolist() == [only, False]
    # What the other parameter takes up is not left to this one.
    coupled = prior + np.array([[4.0, 4.0], [4.0, 4.0]])
    assert prior_only(problem, np.zeros(2), coupled).tolist() == [True, False]
    assert prior_only(problem, np.zeros(2), np.full((2, 2), np.nan)).tolist() == [False, False]
    flat = SimpleNamespace(joint_prior=SimpleNamespace(curvature=lambda theta: 0.0 * prior))
    assert prior_only(flat, np.zeros(2), H).tolist() == [False, False]


def test_steps_of_positive_parameters_are_factors_of_a_hundred_at_most():
    objective = Objective(SimpleNamespace(logarithmic=np.array([True, False, True])))
    theta, step = np.array([2.0, -3.0, 5.0]), np.array([1.0, 4.0, -10.0])
    assert objective.moved(theta, step) == pytest.approx([2.0 * np.exp(0.5), 1.0, 5.0 * np.exp(-2.0)])
    assert theta.tolist() == [2.0, -3.0, 5.0]
    assert objective.longest(theta, step) == 1.0
    assert objective.longest(theta, 10.0 * step) == pytest.approx(np.log(100.0) / 20.0)
    assert objective.longest(theta, np.array([30.0, 1e9, 1.0])) == pytest.approx(np.log(100.0) / 15.0)
    assert objective.longest(theta, np.array([0.0, 1e9, 0.0])) == 1.0
    signed = Objective(SimpleNamespace(logarithmic=np.zeros(3, dtype=bool)))
    assert signed.longest(theta, 1e9 * step) == 1.0 and signed.moved(theta, step).tolist() == [3.0, 1.0, -5.0]


def test_histories_go_on_where_the_objective_changes():
    """Earlier values are shifted to that of the new objective at the end of the climb before."""
    objective = parabola()
    before = End(SimpleNamespace(here=(5.0, 5.0), noise=None), "converged", np.array([-7.0, -3.0, -1.0]))
    again = resumed(objective, before)
    first = objective.start(5.0, 5.0).objective
    assert again.history[:3] == pytest.approx([first - 6.0, first - 2.0, first]) and again.history[-1] == pytest.approx(
        0
    )
    assert again.history.size == 2 + climb(objective, objective.start(5.0, 5.0)).history.size
    assert resumed(objective, replace_here(before, None)) is None
    none = resumed(objective, before, most=0)
    assert none.iterate.theta.tolist() == [5.0, 5.0] and none.history == pytest.approx(
        [first - 6.0, first - 2.0, first]
    )


def replace_here(end, here):
    return end._replace(iterate=SimpleNamespace(here=here, noise=None))


def test_the_measured_orbits_come_before_the_objective():
    def end(objective, *others):
        return End(SimpleNamespace(objective=objective, here=SimpleNamespace(other_orbits=others)), "", None)

    assert gauss_newton.preference(end(-5.0)) > gauss_newton.preference(end(-1.0, "run"))
    assert gauss_newton.preference(end(-1.0, "run")) > gauss_newton.preference(end(-0.5, "run", "other"))
    assert gauss_newton.preference(end(-1.0)) > gauss_newton.preference(end(-1.1))


def test_local_parameters_of_different_experiments_are_moved_together():
    maps = {
        "one": SimpleNamespace(columns={"c": 0, "k": 2, "shift": 3}), "two": SimpleNamespace(columns={"c": 1, "k": 2}),
    }  # fmt: skip
    groups = _moved_together(SimpleNamespace(parameter_maps=maps))
    assert sorted(map(sorted, (group.items() for group in groups))) == sorted(
        [[("one", 0), ("two", 1)], [("one", 2), ("two", 2)], [("one", 3)]]
    )


def of_second_order(rate, change, solvable=1.0):
    """Return the names found for y = rate·a/w + change·(a/w)² and b by its first derivative."""
    widths = np.array([2.0, 3.0])
    jacobian = [np.array([[rate / 2.0, 0.0], [0.0, 1.0]])]
    likelihood = SimpleNamespace(whitened=lambda vectors, noise: vectors)
    prior = SimpleNamespace(widths=widths)
    problem = SimpleNamespace(names=NAMES, joint_prior=prior, likelihood=likelihood)

    def at(theta, here, noise):
        part = theta / widths
        if np.abs(part).max() > solvable:
            return None
        residual = [np.array([0.5 + rate * part[0] + change * part[0] ** 2, 3.0 * part[1]])]
        return Iterate(theta, SimpleNamespace(residuals=residual, jacobian=jacobian), noise, 0.0)

    objective = SimpleNamespace(density=SimpleNamespace(problem=problem), at=at)
    start = at(np.zeros(2), None, None)
    return fit_warnings.second_order(objective, start), [*fit_warnings.second_order_warnings(objective, start)]


@pytest.mark.parametrize(
    "rate, change, solvable, seen",
    [
        (0.0, 1.01, 1.0, True), (0.0, 0.99, 1.0, False), (0.0, -1.01, 1.0, True), (0.099, 1.2, 1.0, True),
        (0.101, 1.2, 1.0, False), (0.05, 0.96, 1.0, True), (0.0, 4.1, 0.5, True), (0.0, 3.9, 0.5, False),
        (0.0, 16.2, 0.25, True), (0.0, 15.8, 0.25, False), (0.0, 99.0, 0.2, False),
    ],
)  # fmt: skip
def test_changes_of_a_standard_deviation_without_a_derivative_are_of_second_order(rate, change, solvable, seen):
    """Within the width of the prior, a half or a quarter of it if solves fail, in either direction."""
    names, texts = of_second_order(rate, change, solvable)
    assert names == ["a"] * seen and len(texts) == seen
    assert all("The data depend on 'a' only to second order" in text for text in texts)


def of_shape(fall, covariance=((4.0, 0.6), (0.6, 0.25)), found=True):
    """Return the warnings for a log-density −fall(z) with z in standard deviations of each parameter's own move."""
    covariance, mode = np.array(covariance), np.array([1.0, 2.0])
    table = pd.DataFrame(covariance, [*NAMES], [*NAMES])
    asked = {}

    def evaluate(points):
        off = points - mode
        return SimpleNamespace(log_prob=np.array([-fall(*one) for one in off @ np.linalg.inv(covariance)]))

    density = SimpleNamespace(
        from_natural=lambda theta, noise: asked.update(theta=theta, noise=noise) or np.asarray(theta, dtype=float),
        evaluate=evaluate,
    )
    likelihood = SimpleNamespace(fixed={"variance[y]": 0.3})
    problem = SimpleNamespace(
        names=NAMES, likelihood=likelihood, noise_names=("variance[y]", "variance[z]"),
        vector=lambda values: np.array([values[name] for name in NAMES]),
    )  # fmt: skip
    objective = SimpleNamespace(density=SimpleNamespace(problem=problem, with_settings=lambda **settings: density))
    joint = JointLaplace({"a": 1.0, "b": 2.0}, table, -1.0)
    texts = [*fit_warnings.shape_warnings(objective, SimpleNamespace(here=SimpleNamespace(solver=None)), joint)]
    assert asked["noise"].tolist() == [0.3, 1.0]
    return texts


def normal(*u, covariance=((4.0, 0.6), (0.6, 0.25))):
    return 0.5 * np.array(u) @ np.array(covariance) @ np.array(u)


@pytest.mark.parametrize(
    "distance, factor, seen",
    [(1, 4.1, 1), (1, 3.9, 0), (-2, 4.1, 1), (-2, 3.9, 0), (4, 9.0, 0), (-4, 0.24, 1), (4, 0.26, 0), (2, 0.24, 1)],
)
@pytest.mark.parametrize("name", NAMES)
def test_falls_of_four_times_or_a_quarter_of_the_normal_one_are_named(monkeypatch, distance, factor, seen, name):
    """Steeper falls matter up to two standard deviations; each parameter takes the others with it."""
    monkeypatch.setattr(fit_warnings, "tables", lambda problem: {"table": []})
    row, sd = NAMES.index(name), {"a": 2.0, "b": 0.5}[name]

    def fall(*u):
        # Moves of one parameter by z standard deviations are u = z/sd along it alone.
        alone = abs(u[1 - row]) < 1e-9
        there = alone and abs(u[row] * sd - distance) < 1e-9
        return normal(*u) * (factor if there else 1.0)

    texts = of_shape(fall)
    assert len(texts) == seen
    if seen:
        assert f"where {name!r} moves by {distance:+g} standard deviations" in texts[0]
        assert f"falls by {factor * 0.5 * distance**2:.3g} instead of {0.5 * distance**2:g}," in texts[0]


def test_shapes_are_those_of_tables_with_a_covariance(monkeypatch):
    monkeypatch.setattr(fit_warnings, "tables", lambda problem: {})
    unused = SimpleNamespace(density=SimpleNamespace(problem=None))
    table = pd.DataFrame(np.eye(2), [*NAMES], [*NAMES])
    assert [*fit_warnings.shape_warnings(unused, None, None)] == []
    assert [*fit_warnings.shape_warnings(unused, None, JointLaplace({}, table, 0.0))] == []
    monkeypatch.setattr(fit_warnings, "tables", lambda problem: {"table": []})
    unknown = replace(JointLaplace({}, table, 0.0), covariance=table * np.nan)
    assert [*fit_warnings.shape_warnings(unused, None, unknown)] == []
