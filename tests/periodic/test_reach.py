import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.arclength import path_outcome
from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.solve import solve_free
from studies import shooting
from tests.known import CYCLE, SADDLE_NODE, grid
from tests.pendulum import PENDULUM, TURN, pendulum_solution


def built(model: bp.Model, inputs: dict, frequency: float, **changes) -> PeriodicEquations:
    arguments = {"samples": 100, "scheme": "central2", "periods": 1, "winding": 0}
    return PeriodicEquations.build(model, inputs, frequency=frequency, **(arguments | changes))


@pytest.mark.parametrize(("a", "end"), [(4.0, "arrived"), (0.01, "arrived"), (-0.01, "fold"), (-5.0, "fold")])
def test_a_saddle_node_ends_the_branch(a, end):
    """ẋ = a − x² has the equilibria ±√a for a > 0 and none for a < 0."""
    equations = built(SADDLE_NODE, {"u": np.zeros(100)}, 1.0)
    anchor = Anchor.at(equations, np.array([1.0]), np.ones((100, 1)))
    assert path_outcome(equations, anchor, np.array([a])) == end


@pytest.mark.parametrize(("mu", "end"), [(2.0, "arrived"), (0.05, "arrived"), (-0.05, "equilibrium")])
def test_a_hopf_point_ends_the_branch(mu, end):
    """The cycle of radius √mu exists for mu > 0 only."""
    tau, theta = grid(100), np.array([1.0, 3.0])
    guess = {"x": np.cos(TURN * tau), "y": np.sin(TURN * tau)}
    equations, solved, _ = solve_free(built(CYCLE, {}, 3.0 / TURN, scheme="central4"), theta, guess)
    assert np.ptp(solved.z[:, 0]) == pytest.approx(2.0, rel=1e-4)
    assert path_outcome(equations, Anchor.at(equations, theta, solved.z), np.array([mu, 3.0])) == end


@pytest.mark.parametrize(("further", "end"), [(0.3, "arrived"), (0.7, "shorter period")])
def test_a_period_doubling_ends_the_branch(further, end):
    """An orbit of period 4 on the way to a heavier and longer pendulum merges with one of period 2."""
    known = next(k for k in shooting.UNSTABLE if len(k.section) == 4)
    solution = pendulum_solution(known, 400, "central4")
    equations = built(
        bp.models.pendulum, {}, known.omega / TURN, samples=400, scheme="central4", periods=4, winding=known.winding
    )
    theta = np.array([PENDULUM[name] for name in bp.models.pendulum.parameters])
    z = equations.solve(theta, (solution.states["phi"] - TURN * known.winding * solution.tau / 4)[:, None]).z
    there = theta * (1.0 + further * np.array([0.51, 0.189, 0, 0, 0, 0, 0, 0]))
    assert path_outcome(equations, Anchor.at(equations, theta, z), there) == end


def test_a_branch_may_come_back_after_two_folds():
    """A superharmonic resonance of the Duffing oscillator: twice the mass moves it over the drive's frequency."""
    equations = built(bp.models.duffing, {"force": 5.0 * np.cos(TURN * grid(200))}, 0.05, samples=200)
    theta = np.array([1.0, 0.1, 1.0, 0.5])
    anchor = Anchor.at(equations, theta, equations.solve(theta, equations.static_guess(theta)).z)
    assert path_outcome(equations, anchor, theta * [1.5, 1.0, 1.0, 1.0]) == "arrived"
    assert path_outcome(equations, anchor, theta * [2.0, 1.0, 1.0, 1.0]) == "round folds"
    assert path_outcome(equations, anchor, np.full(4, np.nan)) == "lost"


def test_a_branch_that_turns_back_past_its_start_ends_in_a_fold():
    """The upper of the two stable Duffing responses exists in a softer spring no longer."""
    equations = built(bp.models.duffing, {"force": 0.4 * np.cos(TURN * grid(100))}, 0.22)
    theta = np.array([1.0, 0.1, 1.0, 0.5])
    upper = equations.solve(theta, 2.0 * np.cos(TURN * grid(100))[:, None])
    assert np.ptp(upper.z) > 2.0
    assert path_outcome(equations, Anchor.at(equations, theta, upper.z), np.array([1.0, 0.1, 0.1, 0.2])) == "fold"
