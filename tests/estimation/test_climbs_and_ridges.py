"""Rules of starts, climbs and ridges, by objectives and problems of closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtri

import bayesperiodic as bp
from bayesperiodic.data.measurements import Amplitude, Phase
from bayesperiodic.data.sweep import Sweep
from bayesperiodic.estimation import climbs, modes, profile
from bayesperiodic.estimation.gauss_newton import End
from bayesperiodic.estimation.profile import Ridge
from bayesperiodic.models.model import CondensedModel
from tests.known import LINEAR, grid, linear_experiment


def sized(*points, states=1, scheme="central4", condensed=False):
    """Return a description with experiments of (samples, periods)."""
    model = object.__new__(CondensedModel) if condensed else SimpleNamespace()
    model.states = ["x"] * states
    runs = [SimpleNamespace(samples=samples, periods=periods) for samples, periods in points]
    return SimpleNamespace(experiments=runs, scheme=scheme, model=model)


@pytest.mark.parametrize(
    "points, states, scheme, starts",
    [
        ([(2000, 1)], 1, "central4", 8), ([(2001, 1)], 1, "central4", 7), ([(1000, 2)], 1, "central4", 8),
        ([(1000, 2)], 2, "central4", 4), ([(500, 1), (1500, 2)], 1, "central4", 4), ([(5333, 1)], 1, "central4", 3),
        ([(5334, 1)], 1, "central4", 2), ([(16000, 1)], 1, "central4", 1), ([(90000, 1)], 1, "central4", 1),
        ([(50, 1)] * 40, 1, "fourier", 8), ([(50, 1)] * 64, 1, "fourier", 5), ([(20, 1)] * 100, 1, "fourier", 8),
        ([(20, 1)] * 200, 1, "fourier", 4), ([(100, 1)] * 10, 1, "fourier", 8), ([(100, 1)] * 20, 1, "fourier", 4),
        ([(50, 2)] * 20, 1, "fourier", 4), ([(200, 1)] * 20, 1, "fourier", 1), ([(200, 1)] * 5, 2, "fourier", 2),
    ],
)  # fmt: skip
def test_sixteen_thousand_unknowns_are_cheap_and_longer_dense_grids_cost_more(points, states, scheme, starts):
    """Unknowns are states times points times periods; those of n > 50 points of a dense scheme count n/50 times."""
    factors = [max(1.0, n * p / 50) if scheme == "fourier" else 1.0 for n, p in points]
    unknowns = states * sum(n * p * factor for (n, p), factor in zip(points, factors, strict=True))
    assert starts == int(min(max(16_000 / unknowns, 1), 8))
    assert modes.default_starts(sized(*points, states=states, scheme=scheme)) == (starts, starts)
    # Tests that reject a condensed model lead to all eight.
    of_condensed = sized(*points, states=states, scheme=scheme, condensed=True)
    assert modes.default_starts(of_condensed) == (starts, 8)


def curved(hessian, supports=None):
    problem = SimpleNamespace()
    return SimpleNamespace(
        hessian_and_gradient=lambda iterate: (np.array(hessian, dtype=float), None),
        density=SimpleNamespace(problem=problem, logarithmic=np.zeros(len(hessian), dtype=bool)),
    )


def iterate(theta, objective=0.0, others=()):
    here = SimpleNamespace(other_orbits=dict.fromkeys(others, ""))
    return SimpleNamespace(theta=np.array(theta, dtype=float), objective=objective, here=here, noise=None)


def test_distances_are_those_of_the_marginal_normal_distribution(monkeypatch):
    """Without a parameter that the data do not narrow, by the covariance of the others."""
    hessian = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 9.0]])
    off, here = np.array([0.3, -0.2, 0.1]), iterate([1.0, 2.0, 3.0])
    idle = np.zeros(3, dtype=bool)
    monkeypatch.setattr(modes, "prior_only", lambda problem, theta, h: idle)
    assert modes._distance(curved(hessian), here.theta + off, here) == pytest.approx(np.sqrt(off @ hessian @ off))
    for idle in (np.array([False, True, False]), np.array([True, False, True])):
        covariance = np.linalg.inv(hessian)[np.ix_(~idle, ~idle)]
        expected = np.sqrt(off[~idle] @ np.linalg.solve(covariance, off[~idle]))
        assert modes._distance(curved(hessian), here.theta + off, here) == pytest.approx(expected)
    idle = np.ones(3, dtype=bool)
    assert modes._distance(curved(hessian), here.theta + off, here) == 0.0
    idle = np.zeros(3, dtype=bool)
    # Directions without curvature do not count, negative curvatures by their size.
    flat = np.diag([4.0, 0.0, -9.0])
    assert modes._distance(curved(flat), here.theta + off, here) == pytest.approx(np.sqrt(4 * 0.09 + 9 * 0.01))
    unknown = curved(np.full((3, 3), np.nan))
    assert modes._distance(unknown, here.theta, here) == 0.0
    assert modes._distance(unknown, here.theta + off, here) == np.inf


@pytest.mark.parametrize(
    "off, lower, others, status, known",
    [
        (0.29, 0.08, (), "converged", True), (0.31, 0.08, (), "converged", False),
        (0.29, 0.085, (), "converged", False),
        (0.1, 0.0099, (), "converged", True), (0.1, 0.0101, (), "converged", False), (0.1, 0.0, (), "converged", True),
        (0.1, -1e-9, (), "converged", False), (0.1, 0.005, ("run",), "converged", False),
        (0.1, 0.005, (), "stalled", False),
    ],
)  # fmt: skip
def test_an_iterate_leads_to_the_optimum_next_to_it(monkeypatch, off, lower, others, status, known):
    """Within 0.3 standard deviations, lower by at most the squared distance, and on as many other orbits."""
    monkeypatch.setattr(modes, "prior_only", lambda problem, theta, h: np.zeros(1, dtype=bool))
    ends = [End(iterate([9.0], -5.0), "converged", None), End(iterate([1.0], -2.0), status, None)]
    seen = modes.optimum_of(curved([[4.0]]), iterate([1.0 + 0.5 * off], -2.0 - lower, others), ends)
    assert seen is (ends[1] if known else None)


@pytest.mark.parametrize("counts", [(3, 8, 5), (2, 2, 2)])
def test_more_starts_follow_as_long_as_the_model_is_rejected(monkeypatch, counts):
    """At least `fewest`, then until the best end so far passes; a start that ends nowhere has none."""
    fewest, most, accepted = counts
    starting = [np.array([float(i)]) for i in range(most)]
    asked = []

    def misfit_at(problem, best, starts):
        asked.append((float(best.theta[0]), starts))
        return "" if starts >= accepted else "rejected"

    def reached(objective, ends, draw, progress, coarse):
        return None if draw[0] == 2.0 else End(iterate(draw, -abs(draw[0] - 3.0)), "converged", None)

    monkeypatch.setattr(climbs, "misfit_at", misfit_at)
    monkeypatch.setattr(climbs, "_from_draw", reached)
    objective = SimpleNamespace(density=SimpleNamespace(problem=None))
    first = End(iterate([0.0], -3.0), "converged", None)
    ends = climbs.from_draws(objective, starting, first, fewest, False)
    assert len(ends) == accepted and ends[0] is first
    assert [end is None for end in ends] == [i == 2 for i in range(accepted)]
    best = {3: 1.0, 4: 3.0, 5: 3.0}
    assert asked == [(best[n], n) for n in range(fewest, accepted + 1) if n < most]
    # The first start again is not climbed again.
    assert climbs.from_draws(objective, [starting[5 % most], starting[5 % most]], first, 2, False)[0] is first


def test_starts_outside_of_the_prior_or_without_orbits_are_none():
    problem = bp.Problem(
        LINEAR, [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)],
        priors={"k": bp.Uniform(800.0, 1000.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)},
    )  # fmt: skip
    assert climbs.first_iterate(problem, np.array([799.0, 30.0, 20.0])) is None
    assert climbs.first_iterate(problem, np.array([1001.0, 30.0, 20.0])) is None
    first = climbs.first_iterate(problem, np.array([801.0, 30.0, 20.0]))
    assert np.isfinite(first.objective) and first.theta == pytest.approx([801.0, 30.0, 20.0])
    assert climbs.in_wide_tables(problem, first.theta, np.empty((0, 3)), False) == []
    assert climbs.widened(problem) is None
    objective = climbs.objective_near(problem, first.here)
    end = climbs.climbed(objective, first, False)
    assert end.status == "converged" and climbs.on_best_sheets(problem, end, False) is end
    assert climbs.on_measured_orbits(problem, first.theta, end, False) is end
    # A climb that comes close to a known end is that end; one that is ended early is not converged.
    start = objective.at(first.theta + [50.0, 0.0, 0.0], first.here, first.noise)
    assert climbs.climbed(objective, start, False, ends=[end]) is end
    assert climbs.climbed(objective, first, False, most=1).status != "converged"
    draw = climbs._from_draw(objective, [end], np.array([950.0, 60.0, 10.0]), False)
    assert draw is end
    assert climbs._from_draw(objective, [end], np.array([700.0, 60.0, 10.0]), False) is None


def test_variances_that_are_left_are_relative_to_those_about_the_mean():
    """Over the measured points of all experiments; phases are compared with any phase, π/√3, amplitudes with zero."""
    mask = np.zeros(8, dtype=bool)
    mask[[1, 2, 5]] = True
    one = bp.Experiment("one", 1.0, {"y": 3.0 + np.arange(8.0)}, samples=8)
    other = bp.Experiment("other", 1.0, {"y": np.arange(8.0) ** 2}, samples=8, mask=mask)
    size = Amplitude("x", 2.0, sd=0.1)
    phase = Phase("x", 1.0, sd=0.1, to="force")
    third = bp.Experiment("third", 1.0, {}, samples=8, measurements=[size, phase])
    problem = SimpleNamespace(experiments=[one, other, third], channels=("y",), quantities=(size.label, phase.label))
    left = {
        "one": {"y": np.full(8, 0.5)}, "other": {"y": np.linspace(0.0, 0.7, 8)},
        "third": {size.label: np.array([0.3]), phase.label: np.array([0.2])},
    }  # fmt: skip
    seen = climbs.fractions_left(problem, left)
    y = np.concatenate([np.arange(8.0) - 3.5, np.array([1.0, 4.0, 25.0]) - 10.0])
    rest = np.concatenate([np.full(8, 0.5), np.linspace(0.0, 0.7, 8)[mask]])
    assert seen == pytest.approx(
        {"y": np.mean(rest**2) / np.mean(y**2), size.label: (0.3 / 2.0) ** 2, phase.label: 0.04 / (np.pi**2 / 3)}
    )
    # Points of one value have no variance, and are compared with zero.
    point = bp.Experiment("other", 1.0, {"y": np.full(8, 5.0)}, samples=8, mask=mask)
    alone = SimpleNamespace(experiments=[point], channels=("y",), quantities=())
    assert climbs.fractions_left(alone, {"other": {"y": np.ones(8)}})["y"] == pytest.approx(0.04)


@pytest.mark.parametrize("share, doubtful", [(0.99, False), (1.01, True)])
def test_ends_are_doubtful_on_other_orbits_or_with_most_of_the_variance_left(share, doubtful):
    values = np.array([1.0, -1.0, 1.0, -1.0])
    run = bp.Experiment("one", 1.0, {"y": values}, samples=4)
    problem = SimpleNamespace(experiments=[run], channels=("y",), quantities=())

    def end(others):
        left = {"one": {"y": np.sqrt(share * climbs.MOST_UNEXPLAINED) * values}}
        here = SimpleNamespace(other_orbits=others, compared=lambda: left)
        return End(SimpleNamespace(here=here), "converged", None)

    assert climbs._doubtful(problem, end({})) == doubtful and climbs._doubtful(problem, end({"one": "x"}))


def test_tables_are_widened_by_a_tenth_of_their_largest_value():
    """Each quantity by that of its own table; phases by 0.1 rad, frequencies by 2 % of them at least."""

    def point(name, sweep, frequency, amplitude, sd=0.01):
        values = [Amplitude("x", amplitude, sd=sd), Phase("x", 0.5, sd=0.02, to="force")]
        return bp.Experiment(name, frequency, {}, {"force": np.zeros(8)}, samples=8, measurements=values, sweep=sweep)

    coarse, fine = Sweep("up table", "up", 0.05), Sweep("fine", "down", 0.001)
    points = [point("a", coarse, 1.0, 2.0), point("b", coarse, 1.1, 5.0), point("c", fine, 1.0, 30.0, None)]
    points.append(point("d", fine, 1.2, 20.0))
    wave = np.sin(2 * np.pi * grid(8))
    alone = bp.Experiment("alone", 1.0, {"displacement": wave}, {"force": np.zeros(8)}, samples=8)
    kept = {}
    problem = SimpleNamespace(
        model=SimpleNamespace(autonomous=False), experiments=[*points, alone],
        replace=lambda experiments: kept.update({e.name: e for e in experiments}) or "wider",
    )  # fmt: skip
    assert climbs.widened(problem) == "wider" and [*kept] == ["a", "b", "c", "d", "alone"]
    assert kept["alone"] is alone
    for name, largest, resolution in (("a", 5.0, 0.05), ("b", 5.0, 0.05), ("c", 30.0, 0.02), ("d", 30.0, 0.02)):
        size, phase = kept[name].measurements
        assert size.sd == (None if name == "c" else pytest.approx(np.hypot(0.01, 0.1 * largest)))
        assert phase.sd == pytest.approx(np.hypot(0.02, 0.1)) and kept[name].sweep.resolution == resolution
        given = next(one for one in points if one.name == name)
        assert (size.value, phase.value) == tuple(one.value for one in given.measurements)
        assert kept[name].sweep.direction == given.sweep.direction


def ridge(prior, at, hessian=((4.0,),), column=0):
    """Return the ridge of a normal density; all parameters have this prior."""
    theta = np.atleast_1d(np.array(at, dtype=float))
    names = tuple("abc"[: theta.size])
    joint = SimpleNamespace(names=names, marginals=dict.fromkeys(names, prior))
    objective = curved(hessian)
    objective.density.problem.joint_prior = joint
    return Ridge(objective, column, iterate(theta))


def test_ridges_end_a_millionth_before_the_support_or_at_the_outermost_thousandth():
    assert ridge(bp.Normal(1.0, 2.0), 1.5).limits() == (-np.inf, np.inf)
    low, high = ridge(bp.Uniform(-10.0, 90.0), 2.0).limits()
    assert (low, high) == (pytest.approx(-10.0 + 12e-6, abs=1e-9), pytest.approx(90.0 - 88e-6, abs=1e-9))
    # The thousandth of a log-uniform prior of many decades is closer to its lower end.
    low, high = ridge(bp.LogUniform(1e-9, 1e3), 500.0, [[1e-2]]).limits()
    assert low == pytest.approx(1e-9 * 10 ** (12e-3), rel=1e-6) and high == pytest.approx(1e3 - 5e-4, abs=1e-7)
    assert ridge(bp.LogNormal(2.0, 0.3), 2.0).limits() == (pytest.approx(2e-6), np.inf)


@pytest.mark.parametrize("distance, at_once", [(0.9e-3, True), (1.1e-3, False)])
@pytest.mark.parametrize("end", [0.0, 10.0])
def test_a_peak_at_an_end_of_the_support_is_its_limit(distance, at_once, end):
    """Within a thousandth of a standard deviation, 0.5 here."""
    at = abs(end - 0.5 * distance)
    limits = ridge(bp.Uniform(0.0, 10.0), at).limits()
    assert (limits[end > 0.0] == at) == at_once


def test_steps_have_the_standard_deviation_or_the_width_of_the_prior():
    """Half of the data's are inside of ±0.674 standard deviations of a normal prior."""
    assert ridge(bp.Normal(0.0, 10.0), 0.0)._size() == pytest.approx(0.5)
    assert ridge(bp.Normal(0.0, 0.1), 0.0)._size() == pytest.approx(2 * ndtri(0.75) * 0.1)
    assert ridge(bp.Uniform(0.0, 8.0), 3.0, [[0.0]])._size() == pytest.approx(3.0)
    assert ridge(bp.Uniform(0.0, 8.0), 7.0, [[0.0]])._size() == pytest.approx(1.0)
    assert ridge(bp.Uniform(0.0, 8.0), 4.0, [[-1.0]])._size() == pytest.approx(4.0)
    assert ridge(bp.Uniform(0.0, 8.0), 4.0, [[np.nan]])._size() == pytest.approx(4.0)


@pytest.mark.parametrize("column", [0, 1, 2])
def test_tangents_are_the_conditional_means(column):
    """∂θ/∂θ_i along the ridge is C_ji/C_ii, and the curvature 1/C_ii, in whatever units."""
    hessian = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.2], [0.5, -0.2, 9.0]])
    units = np.array([1.0, 1e4, 1e-3])
    hessian = hessian * np.outer(units, units)
    covariance = np.linalg.inv(hessian)
    slope, curvature = ridge(bp.Normal(0.0, 1.0), [0.0] * 3, hessian, column)._tangent(None)
    assert slope == pytest.approx(covariance[:, column] / covariance[column, column], rel=1e-9)
    assert curvature == pytest.approx(1.0 / covariance[column, column], rel=1e-9)
    # A parameter that nothing depends on stays; without a Hessian all do.
    flat = hessian.copy()
    other = (column + 1) % 3
    flat[other], flat[:, other] = 0.0, 0.0
    slope, _ = ridge(bp.Normal(0.0, 1.0), [0.0] * 3, flat, column)._tangent(None)
    assert slope[other] == 0.0 and slope[column] == 1.0
    unknown = np.full((3, 3), np.nan)
    slope, curvature = ridge(bp.Normal(0.0, 1.0), [0.0] * 3, unknown, column)._tangent(None)
    assert slope.tolist() == np.eye(3)[column].tolist() and curvature == 0.0


def test_steps_end_at_nine_tenths_of_the_way_to_the_support_or_at_the_limit():
    assert profile._next(1.0, 0.5, np.inf, np.inf) == 1.5 and profile._next(1.0, -0.5, -np.inf, -np.inf) == 0.5
    assert profile._next(1.0, 0.5, 10.0, 9.99) == 1.5 and profile._next(1.0, 9.5, 10.0, 9.99) == pytest.approx(9.1)
    assert profile._next(1.0, -0.5, 0.0, 0.01) == 0.5 and profile._next(1.0, -0.95, 0.0, 0.01) == pytest.approx(0.1)
    assert profile._next(9.95, 1.0, 10.0, 9.99) == 9.99 and profile._next(0.05, -1.0, 0.0, 0.01) == 0.01
    assert profile._root(-1.0, iterate([0.0], -3.0)) == 2.0 and profile._root(-3.0, iterate([0.0], -1.0)) == 0.0


@pytest.mark.parametrize("level", [0.5, 1.0, 1.6449])
def test_profiles_cross_a_level_where_their_roots_do(level):
    """Roots |x − 2|/0.5 of a parabola; NaN where solves fail, infinite where the limit is reached before."""
    values = np.linspace(1.0, 3.5, 11)
    roots = np.abs(values - 2.0) / 0.5
    assert profile._crossing(values, roots, level, np.inf) == pytest.approx(2.0 + 0.5 * level)
    failing = np.where(values == 2.25, np.nan, roots)
    assert profile._crossing(values, failing, level, np.inf) == pytest.approx(2.0 + 0.5 * level, abs=1e-9)
    few = values < 2.0 + 0.5 * level
    assert np.isnan(profile._crossing(values[few], roots[few], level, np.inf))
    assert profile._crossing(values[few], roots[few], level, values[few][-1]) == np.inf
    ended = np.where(few, roots, np.nan)
    assert np.isnan(profile._crossing(values, ended, level, values[-1]))
    assert np.isnan(profile._crossing(values, roots + 9.0, level, np.inf))
    # Of several crossings the last one counts.
    twice = np.where(values > 3.0, 0.1, roots)
    assert profile._crossing(values, twice, level, 3.5) == np.inf


@pytest.mark.parametrize("progress", [True, False])
def test_starts_in_wide_tables_are_the_ends_the_best_first_and_then_the_draws_without_one(monkeypatch, progress):
    """Of four starts, the objective of whose ends is their value, the third has no orbit."""
    seen = []

    def climbed(objective, first, shown):
        seen.append((objective, shown))
        return End(iterate(first.theta, first.theta[0]), "converged", None)

    def on_best_sheets(problem, end, shown):
        seen.append((problem, shown))
        return end

    def from_draw(objective, ends, draw, shown):
        seen.append((objective, shown))
        assert [float(end.iterate.theta[0]) for end in ends] == [one for one in (0.0, 1.0, 3.0) if one < draw[0]]
        return None if draw[0] == 2.0 else climbed(objective, iterate(draw), shown)

    for name, stand_in in {
        "widened": lambda problem: "wide", "first_iterate": lambda problem, theta: iterate(theta),
        "objective_near": lambda problem, near: "objective", "climbed": climbed, "on_best_sheets": on_best_sheets,
        "_from_draw": from_draw,
    }.items():  # fmt: skip
        monkeypatch.setattr(climbs, name, stand_in)
    starts = climbs.in_wide_tables(None, np.zeros(1), np.array([[1.0], [2.0], [3.0]]), progress)
    assert [float(theta[0]) for theta in starts] == [3.0, 1.0, 0.0, 2.0]
    assert {shown for _, shown in seen} == {progress} and seen[1] == ("wide", progress)
    assert {first for first, _ in seen} == {"objective", "wide"}
    monkeypatch.setattr(climbs, "first_iterate", lambda problem, theta: None)
    assert climbs.in_wide_tables(None, np.zeros(1), np.array([[1.0]]), progress) == []


class Known(Ridge):
    """A ridge whose maxima are a known function of the parameter, None where no solve converges."""

    def _climbed(self, start, value, known=None):
        self.objective.climbs.append((float(start.theta[0]), value, known))
        best = self.objective.best(value)
        return None if best is None else iterate([value], best)


def known_ridge(best, at=0.0, prior=None):
    prior = bp.Normal(at, 1e6) if prior is None else prior
    joint = SimpleNamespace(names=("a",), marginals={"a": prior})
    density = SimpleNamespace(problem=SimpleNamespace(joint_prior=joint))

    def hessian_and_gradient(iterate):
        return np.array([[1.0]]), None

    objective = SimpleNamespace(density=density, best=best, climbs=[], hessian_and_gradient=hessian_and_gradient)
    return Known(objective, 0, iterate([at], best(at)))


def outwards(best, step, at=0.0, prior=None):
    """Return values and objectives of the points that begin with a step, NaN where there is none."""
    each = known_ridge(best, at, prior)
    points = each._outwards(profile.Point(at, each.peak), step, best(at))
    return [one.value for one in points], [one.iterate.objective if one.iterate else np.nan for one in points]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    "first, expected",
    [(0.5, np.arange(1, 7) / 2), (0.1, [0.1, *(0.4 + 0.5 * np.arange(6))]), (2.0, np.arange(1, 7) / 2),
     (0.9, 0.9 + 0.5 * np.arange(5)), (1.1, np.arange(1, 7) / 2)],
)  # fmt: skip
def test_points_of_a_normal_density_are_half_a_standard_deviation_apart_down_to_a_drop_of_2_8(first, expected, sign):
    """Steps grow threefold at most, and one of twice the drop or more is shortened to a quarter at least."""
    values, objectives = outwards(lambda x: 3.0 - 0.5 * x**2, sign * first)
    np.testing.assert_allclose(values, sign * np.array(expected), rtol=1e-12)
    np.testing.assert_allclose(objectives, 3.0 - 0.5 * np.square(expected), rtol=1e-12)
    assert abs(values[-2]) <= 2.8 < abs(values[-1])


def test_points_lead_up_to_a_jump_of_the_density_and_go_on_behind_it():
    """By a root of 2 at 1.04; steps are shortened to a hundredth of the first one, and begin with it again behind."""
    values, _ = outwards(lambda x: -0.5 * x**2 - 2.0 * (x > 1.04), 0.5)
    behind = next(k for k, value in enumerate(values) if value > 1.04)
    assert values[behind] - values[behind - 1] < 0.005 / 0.25 and values[behind + 1] == values[behind] + 0.5
    np.testing.assert_allclose(values[:2], [0.5, 1.0])
    assert values[-1] > np.sqrt(2.8**2 - 4.0) >= values[-2]


@pytest.mark.parametrize("end, failed", [(1.01, 5), (2.45, 5)])
def test_profiles_end_at_the_fifth_failure_after_steps_that_are_shorter_each_time(end, failed):
    values, objectives = outwards(lambda x: None if x > end else -0.5 * x**2, 0.5)
    missing = np.isnan(objectives)
    assert missing.sum() == failed and missing[-1]
    last = max(value for value, none in zip(values, missing, strict=True) if not none)
    assert last <= end < min(value for value, none in zip(values, missing, strict=True) if none)
    first = int(np.argmax(missing))
    assert values[first] - values[first - 1] == pytest.approx(0.5)
    assert values[first + 1] - values[first - 1] == pytest.approx(0.125)


def test_profiles_end_at_the_limit_of_the_prior_or_after_sixty_points():
    """A flat density between 0 and 10 with its peak at 2: the limits are 8e-6 before 10 and 2e-6 behind 0.

    Steps grow to half of the way to the end at most, and then leave a tenth of it.
    """
    flat = bp.Uniform(0.0, 10.0)
    above, _ = outwards(lambda x: 0.0, 1.0, at=2.0, prior=flat)
    np.testing.assert_allclose(above, [3.0, 6.0, *(10.0 - 10.0 ** -np.arange(6.0)), 10.0 - 8e-6], atol=1e-9)
    below, _ = outwards(lambda x: 0.0, -0.5, at=2.0, prior=flat)
    np.testing.assert_allclose(below, [1.5, *(0.75 * 10.0 ** -np.arange(6.0)), 2e-6], atol=1e-9)
    rising, _ = outwards(lambda x: x, 1.0)
    assert len(rising) == 60
    assert outwards(lambda x: 0.0, 1.0, at=10.0, prior=flat) == ([], [])


def test_drops_count_from_the_highest_point():
    """A density that rises to 4 above the peak, and falls as a normal one."""
    values, _ = outwards(lambda x: 4.0 - 0.5 * (x - 3.0) ** 2, 0.5)
    assert values[-1] - 3.0 > 2.8 >= values[-2] - 3.0


@pytest.mark.parametrize(
    ("least", "size", "gain", "ended"),
    [(0.0, 1e-9, -1e-13, False), (0.0, 2.0, 0.0, False), (0.5, 2.0, 0.024, True), (0.5, 2.0, 0.026, False),
     (0.5, 0.4, 1.0, True)],
)  # fmt: skip
def test_only_rough_climbs_end_by_small_steps_and_gains(monkeypatch, least, size, gain, ended):
    """The objective of an exact climb may become lower by rounding; it ends by its own criteria."""
    said = []

    def climb(objective, first, report, **_):
        said.append(report(SimpleNamespace(objective=first.objective + gain, theta=np.zeros(1)), size))
        return End(first, "converged", np.zeros(0))

    monkeypatch.setattr(climbs, "climb", climb)
    monkeypatch.setattr(climbs, "optimum_of", lambda *_: None)
    climbs.climbed(None, SimpleNamespace(objective=3.0), False, least=least)
    assert said == [ended]
