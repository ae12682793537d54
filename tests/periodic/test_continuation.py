from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import sympy as sp
from scipy.optimize import brentq, root

import bayesperiodic as bp
from bayesperiodic.periodic.arclength import path_outcome
from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.solve import solve_free
from studies import shooting
from tests.known import CYCLE, SADDLE_NODE, grid
from tests.pendulum import PENDULUM, TURN, pendulum_solution, rates_and_angles
from tests.shooting import divided, pendulum_doubling, van_der_pol_cycle

DUFFING = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
ROESSLER = bp.Model(
    "roessler",
    states=["x", "y", "z"],
    parameters=["a", "b", "c"],
    equations=lambda s, p, u: [s.dx + s.y + s.z, s.dy - s.x - p.a * s.y, s.dz - p.b - s.z * (s.x - p.c)],
    outputs=lambda s, p, u: {"x": s.x},
)


def duffing_start(samples: int, scheme: str, mean: float = 0.0) -> bp.PeriodicSolution:
    force = {"force": mean + np.cos(TURN * grid(samples))}
    return bp.solve_periodic(bp.models.duffing, DUFFING, force, frequency=0.1, samples=samples, scheme=scheme)


def duffing_fold(guess: tuple[float, float, float]) -> np.ndarray:
    """Return (x, ẋ, frequency) where the solution of Poincaré's map has a multiplier 1, from near it."""

    def conditions(unknown: np.ndarray) -> list[float]:
        x, v, frequency = unknown

        def slope(t, y):
            return np.array([y[1], np.cos(TURN * t) - 0.2 * y[1] - y[0] - 0.5 * y[0] ** 3]) / frequency

        def jacobian(t, y):
            return np.array([[0.0, 1.0], [-1.0 - 1.5 * y[0] ** 2, -0.2]]) / frequency

        end, transfer = shooting.flow(slope, jacobian, 0.0, 1.0, np.array([x, v]), 1e-13)
        return [*(end - [x, v]), np.linalg.det(transfer - np.eye(2))]

    return root(conditions, guess, tol=1e-13).x


@pytest.fixture(scope="module")
def resonance():
    start = duffing_start(64, "fourier")
    return bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, progress=False)


@pytest.fixture(scope="module")
def rotation():
    """Return the pendulum's branch of period 1 from 13 to 9.09 rad/s."""
    start = pendulum_solution(shooting.STABLE[0], 200, "central4")
    return bp.continue_periodic(bp.models.pendulum, start, "frequency", until=9.09 / TURN, progress=False)


@pytest.fixture(scope="module")
def doubled(rotation):
    """Return the branch of period 2 that leaves the one of period 1, from its first solution to 9.09 rad/s."""
    first = bp.double_period(bp.models.pendulum, rotation.period_doublings[0], "frequency")
    return bp.continue_periodic(bp.models.pendulum, first, "frequency", until=9.09 / TURN, progress=False)


def test_folds_of_a_frequency_response_agree_with_the_poincare_map(resonance):
    upper, lower = duffing_fold((-0.2, 4.5, 0.3)), duffing_fold((-1.05, 0.62, 0.24))
    assert len(resonance.folds) == 2
    for fold, exact in zip(resonance.folds, (upper, lower), strict=True):
        assert fold.frequency == pytest.approx(exact[2], abs=1e-11)
        assert fold.states["x"][0] == pytest.approx(exact[0], abs=1e-6)
        assert min(abs(fold.multipliers - 1)) < 1e-6


@pytest.mark.parametrize(("samples", "scheme", "tolerance"), [(200, "central2", 3e-5), (200, "central4", 1e-8)])
def test_folds_by_difference_schemes_have_their_accuracy(samples, scheme, tolerance):
    start = duffing_start(samples, scheme)
    branch = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, step=0.02, progress=False)
    assert [fold.frequency for fold in branch.folds] == pytest.approx([0.303382264798, 0.242089115564], abs=tolerance)
    assert branch.complete


def test_response_is_unstable_exactly_between_the_folds(resonance):
    assert resonance.complete and resonance[-1].frequency == 0.4
    first, second = (k for k, kind in enumerate(resonance.kinds) if kind == "fold")
    stable = [solution.stable for solution in resonance]
    assert all(stable[:first]) and not any(stable[first + 1 : second]) and all(stable[second + 1 :])
    going = np.sign(np.diff(resonance.values))
    assert np.all(going[:first] == 1) and np.all(going[first:second] == -1) and np.all(going[second:] == 1)


def test_every_point_of_a_branch_solves_the_equation(resonance):
    """With spectral derivatives of its own, at the point's own frequency."""
    for solution in resonance:
        x, rate = solution.states["x"], 2j * np.pi * solution.frequency * np.arange(33)
        waves = np.fft.rfft(x)
        acceleration, speed = np.fft.irfft(rate**2 * waves, 64), np.fft.irfft(rate * waves, 64)
        balance = acceleration + 0.2 * speed + x + 0.5 * x**3 - np.cos(TURN * grid(64))
        assert np.abs(balance).max() < 1e-8 * max(1.0, np.abs(acceleration).max())
        assert solution.converged and solution.found_by == "continuation"


def test_steps_do_not_exceed_the_given_step(resonance):
    assert np.abs(np.diff(resonance.values)).max() <= 0.3 / 50 * (1 + 1e-9)


def test_branch_can_be_followed_back_over_its_folds(resonance):
    """From 0.4 Hz down the lower path ends where the branch came from."""
    branch = bp.continue_periodic(bp.models.duffing, resonance[-1], "frequency", until=0.1, step=0.02, progress=False)
    assert branch.complete and branch[-1].frequency == 0.1
    found = sorted(fold.frequency for fold in branch.folds)
    assert found == pytest.approx(sorted(fold.frequency for fold in resonance.folds), abs=1e-9)
    assert branch[-1].states["x"] == pytest.approx(resonance[0].states["x"], abs=1e-8)


def test_first_period_doubling_of_the_pendulum_agrees_with_shooting(rotation):
    known = shooting.DOUBLINGS[0]
    assert len(rotation.period_doublings) == 1 and not rotation.folds and rotation.complete
    found = rotation.period_doublings[0]
    assert TURN * found.frequency == pytest.approx(known.omega, abs=1e-6)
    assert found.multipliers == pytest.approx(np.array(known.multipliers), abs=1e-6)
    before = [s.stable for s in rotation if s.frequency > found.frequency]
    after = [s.stable for s in rotation if s.frequency < found.frequency]
    assert all(before) and not any(after)
    assert rotation[-1].multipliers == pytest.approx(np.array(shooting.UNSTABLE[0].multipliers), rel=1e-6)


def test_tabulated_doubling_is_again_that_of_shooting():
    known = shooting.DOUBLINGS[0]
    omega, _ = pendulum_doubling(11.77, 11.79, np.array(known.section), 1, tolerance=1e-11)
    assert omega == pytest.approx(known.omega, abs=1e-8)


def test_switching_leads_to_the_doubled_branch(rotation, doubled):
    first, parent = doubled[0], rotation.period_doublings[0]
    assert (first.periods, first.winding) == (2, {"phi": 2})
    assert first.stable and first.frequency < parent.frequency
    half = first.states["phi"][200:] - first.states["phi"][:200] - TURN
    assert 0.01 < np.abs(half).max() / np.ptp(parent.states["phi"] - TURN * parent.tau) < 0.2
    # The next doubling is on this branch and nothing else is.
    known = shooting.DOUBLINGS[1]
    assert len(doubled.period_doublings) == 1 and not doubled.folds and doubled.complete
    found = doubled.period_doublings[0]
    assert TURN * found.frequency == pytest.approx(known.omega, abs=1e-6)
    assert found.multipliers == pytest.approx(np.array(known.multipliers), abs=1e-6)
    assert doubled[-1].multipliers == pytest.approx(np.array(shooting.UNSTABLE[1].multipliers), rel=1e-6)


def test_doubled_branch_passes_through_the_tabulated_orbit(doubled):
    """At 11.48 rad/s, where the branch is stopped exactly; half a period's shift is the same orbit."""
    known = shooting.STABLE[1]
    branch = bp.continue_periodic(
        bp.models.pendulum, doubled[0], "frequency", until=known.omega / TURN, step=0.05, progress=False
    )
    orbit = branch[-1]
    assert orbit.frequency == known.omega / TURN
    path = rates_and_angles(known, 200)[:, 0]
    later = np.concatenate([path[200:], path[:200] + 2 * TURN]) - TURN
    error = min(np.abs(orbit.states["phi"] - p).max() for p in (path, later))
    assert error < 1e-6
    assert orbit.multipliers == pytest.approx(np.array(known.multipliers), rel=1e-6)


def test_second_switching_leads_to_the_branch_of_period_four(doubled):
    first = bp.double_period(bp.models.pendulum, doubled.period_doublings[0], "frequency")
    assert (first.periods, first.winding) == (4, {"phi": 4}) and first.stable
    branch = bp.continue_periodic(bp.models.pendulum, first, "frequency", until=9.4 / TURN, step=0.02, progress=False)
    assert [TURN * s.frequency for s in branch.period_doublings] == pytest.approx(
        [shooting.DOUBLINGS[2].omega], abs=1e-6
    )


def test_both_unstable_rotations_lie_on_one_branch_with_a_fold_between():
    """Down from 9.09 rad/s a doubling is passed back, then a fold, and up again the branch returns to 9.09 rad/s."""
    start = pendulum_solution(shooting.UNSTABLE[0], 200, "central4")
    branch = bp.continue_periodic(bp.models.pendulum, start, "frequency", until=4 / TURN, step=0.03, progress=False)
    doubling, fold = shooting.RETURN, shooting.FOLD
    assert [TURN * s.frequency for s in branch.period_doublings] == pytest.approx([doubling.omega], abs=1e-5)
    assert [TURN * s.frequency for s in branch.folds] == pytest.approx([fold.omega], abs=1e-5)
    assert branch.period_doublings[0].multipliers == pytest.approx(np.array(doubling.multipliers), abs=1e-5)
    assert branch.folds[0].multipliers == pytest.approx(np.array(fold.multipliers), abs=1e-3)
    assert branch.complete and branch.values[-1] == branch.values[0]
    assert branch[-1].multipliers == pytest.approx(np.array(shooting.UNSTABLE[3].multipliers), rel=1e-5)


def test_continuation_in_the_scale_of_an_input_gives_the_scaled_solution():
    """Three times the force, its mean included, along the branch and in the inputs that the solutions carry."""
    start = duffing_start(100, "central4", mean=0.4)
    branch = bp.continue_periodic(bp.models.duffing, start, "force", until=3.0, progress=False)
    direct = bp.solve_periodic(
        bp.models.duffing,
        DUFFING,
        {"force": 3 * start.inputs["force"]},
        frequency=0.1,
        samples=100,
        scheme="central4",
        guess=branch[-1],
    )
    assert direct.iterations <= 1
    assert branch.values[0] == 1.0 and branch.values[-1] == 3.0 and branch.complete
    assert branch[-1].inputs["force"] == pytest.approx(3 * start.inputs["force"])
    assert branch[-1].states["x"] == pytest.approx(direct.states["x"], abs=1e-9)


def test_scaling_one_of_several_inputs_leaves_the_others():
    model = bp.Model(
        "two_inputs",
        states=["x"],
        inputs=["u", "v"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dx + p.a * s.x - u.u - u.dv],
        outputs=lambda s, p, u: {"x": s.x},
    )
    tau = grid(64)
    inputs = {"u": np.cos(TURN * tau), "v": 0.5 * np.sin(2 * TURN * tau)}
    start = bp.solve_periodic(model, {"a": 2.0}, inputs, frequency=0.3, samples=64, scheme="fourier")
    branch = bp.continue_periodic(model, start, "v", until=-1.0, progress=False)
    rate = 2j * np.pi * 0.3
    exact = np.exp(2j * np.pi * tau) / (rate + 2) - rate * np.exp(4j * np.pi * tau) / (2 * rate + 2) / 1j * 0.5 * 2
    assert branch[-1].states["x"] == pytest.approx(exact.real, abs=1e-10)


def test_continuation_of_a_limit_cycle_in_its_parameter_agrees_with_shooting():
    start = bp.solve_periodic(
        bp.models.van_der_pol, {"mu": 0.5, "omega": 1.0}, frequency=0.15, samples=400, scheme="central4"
    )
    branch = bp.continue_periodic(bp.models.van_der_pol, start, "mu", until=2.0, step=0.1, progress=False)
    assert branch.vary == "mu" and branch.units["mu"] == "1" and branch.complete
    assert not branch.folds and not branch.period_doublings
    assert all(solution.stable for solution in branch)
    assert branch.values == pytest.approx([solution.parameters["mu"] for solution in branch])
    for solution, mu in ((branch[0], 0.5), (branch[-1], 2.0)):
        assert solution.period == pytest.approx(shooting.VAN_DER_POL[mu][0], rel=1e-6)
    middle = branch[len(branch) // 2]
    period, _, _ = van_der_pol_cycle(middle.parameters["mu"], parts=6, tolerance=1e-11)
    assert middle.period == pytest.approx(period, rel=1e-6)


@pytest.mark.slow
def test_period_doubling_of_a_limit_cycle_agrees_with_shooting():
    """Rössler's equations, a = b = 0.2, against shooting with the period as a further state."""
    start = bp.solve_periodic(ROESSLER, {"a": 0.2, "b": 0.2, "c": 2.6}, frequency=0.17, samples=200, scheme="central4")
    branch = bp.continue_periodic(ROESSLER, start, "c", until=3.0, step=0.1, progress=False)

    def cycle(c: float, point: np.ndarray, parts: int) -> shooting.Orbit:
        def slope(t, y):
            return np.array([y[3] * (-y[1] - y[2]), y[3] * (y[0] + 0.2 * y[1]), y[3] * (0.2 + y[2] * (y[0] - c)), 0.0])

        def jacobian(t, y):
            field = slope(t, y) / y[3]
            inner = y[3] * np.array([[0.0, -1.0, -1.0], [1.0, 0.2, 0.0], [y[2], 0.0, y[0] - c]])
            return np.block([[inner, field[:3, None]], [np.zeros((1, 4))]])

        times, states = divided(slope, jacobian, np.array([0.0, 1.0]), point[None], parts)
        return shooting.shoot(slope, jacobian, times, states, np.zeros(4), 0, tolerance=1e-11)

    def point(solution: bp.PeriodicSolution) -> np.ndarray:
        return np.array([*(values[0] for values in solution.states.values()), solution.period])

    (found,) = branch.period_doublings
    near = point(found)
    exact = brentq(lambda c: np.prod(1 + cycle(c, near, 2).multipliers).real, 2.82, 2.84, xtol=1e-9)
    assert exact == pytest.approx(2.8324, abs=1e-4)
    assert found.parameters["c"] == pytest.approx(exact, abs=2e-6)
    first = bp.double_period(ROESSLER, found, "c")
    assert first.converged and first.stable
    assert first.samples == 400 and first.periods == 1
    twice = bp.continue_periodic(ROESSLER, first, "c", until=3.0, step=0.1, progress=False)[-1]
    known = cycle(3.0, point(twice), 4)
    assert known.states[0, 3] > 11.0
    assert twice.period == pytest.approx(known.states[0, 3], rel=1e-6)
    across = np.abs(np.array(known.multipliers) - 1.0) > 1e-3
    largest = known.multipliers[across][0]
    assert min(abs(twice.multipliers - largest)) < 1e-4 * abs(largest)


def test_iteration_can_be_stopped_early(resonance):
    start = duffing_start(64, "fourier")
    points = bp.iterate_periodic(bp.models.duffing, start, "frequency", until=0.4)
    for (value, solution, kind), expected, known in zip(islice(points, 5), resonance.values, resonance, strict=False):
        assert value == solution.frequency == pytest.approx(expected, rel=1e-12)
        assert kind == "" and solution.states["x"] == pytest.approx(known.states["x"], rel=1e-9)
    points.close()
    assert next(points, None) is None


def test_branch_is_a_sequence(resonance):
    assert len(resonance) == len(resonance.values) == len(list(resonance))
    assert resonance[0].frequency == 0.1 and resonance[-1].frequency == 0.4
    assert [s.frequency for s in resonance[2:4]] == resonance.values[2:4].tolist()
    assert "2 folds" in repr(resonance) and "stuck" not in repr(resonance)


def test_branch_as_a_dataset(doubled):
    data = doubled.data
    assert dict(data.sizes) == {"point": len(doubled), "state": 1, "tau": 400, "output": 2, "multiplier": 2}
    assert data["states"].dims == ("point", "state", "tau")
    assert data.attrs == {"model": "pendulum", "vary": "frequency"}
    assert data["value"].attrs["units"] == "Hz"
    k = doubled.kinds.index("period doubling")
    assert data["kind"].values[k] == "period doubling" and set(data["kind"].values) == {"", "period doubling"}
    assert data["value"].values[k] == doubled.period_doublings[0].frequency
    for point in (0, k, -1):
        at = data.isel(point=point)
        assert at["states"].sel(state="phi").values.tolist() == doubled[point].states["phi"].tolist()
        assert at["outputs"].sel(output="rate").values.tolist() == doubled[point].outputs["rate"].tolist()
        multipliers = at["multiplier_real"].values + 1j * at["multiplier_imaginary"].values
        assert multipliers.tolist() == doubled[point].multipliers.tolist()
        assert bool(at["stable"]) == doubled[point].stable


def test_saved_branch_is_read_back_completely(resonance, tmp_path):
    resonance.save(tmp_path / "branch.h5")
    again = bp.load(tmp_path / "branch.h5")
    assert isinstance(again, bp.Branch) and len(again) == len(resonance)
    assert again.data.identical(resonance.data)
    assert again.kinds == resonance.kinds and again.complete == resonance.complete
    assert [f.frequency for f in again.folds] == [f.frequency for f in resonance.folds]


def test_branch_that_ends_early_is_incomplete():
    """The solution x = √a exists for a ≥ 0 only."""
    model = bp.Model(
        "root",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.dx + s.x - sp.sqrt(p.a) - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    start = bp.solve_periodic(model, {"a": 1.0}, {"u": np.cos(TURN * grid(50))}, frequency=1.0, samples=50)
    branch = bp.continue_periodic(model, start, "a", until=-1.0, progress=False)
    assert not branch.complete
    assert 0.0 <= branch.values[-1] < 0.01
    assert "stuck" in repr(branch)


def test_solution_without_a_multiplier_near_minus_one_is_not_doubled(resonance):
    with pytest.raises(ValueError, match="solution: must have a multiplier near -1, got"):
        bp.double_period(bp.models.duffing, resonance[0], "frequency")


def test_error_names_the_unknown_quantity_of_a_doubling(rotation):
    with pytest.raises(ValueError, match="vary: must be one of 'm', 'l', .*got 'k4'. Did you mean 'k"):
        bp.double_period(bp.models.pendulum, rotation.period_doublings[0], "k4")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vary": "k4"}, "vary: must be one of .*'force', 'frequency', got 'k4'. Did you mean 'k'"),
        ({"until": 0.1}, "until: must differ from the start value of frequency, got 0.1"),
        ({"until": -0.1}, "until: must be > 0, got -0.1"),
        ({"until": np.nan}, "until: must be .*got nan"),
        ({"step": 0.0}, "step: must be > 0, got 0.0"),
        ({"vary": "force", "until": 1.0}, "until: must differ from the start value of force, got 1.0"),
        ({"model": bp.models.dahl}, "model: must be 'duffing', as of the solution, got 'dahl'"),
    ],
)
def test_error_names_the_bad_argument(resonance, changes, message):
    arguments = {"model": bp.models.duffing, "solution": resonance[0], "vary": "frequency", "until": 0.2} | changes
    with pytest.raises(ValueError, match=message):
        bp.continue_periodic(**arguments, progress=False)


def test_unconverged_solution_is_refused(resonance):
    failed = replace(resonance[0], status="stalled")
    with pytest.raises(ValueError, match="solution: must have converged, got status 'stalled'"):
        bp.continue_periodic(bp.models.duffing, failed, "k", until=2.0, progress=False)
    with pytest.raises(ValueError, match="solution: must have converged, got status 'stalled'"):
        bp.double_period(bp.models.duffing, failed, "k")


def test_frequency_of_an_autonomous_model_cannot_be_varied():
    start = bp.solve_periodic(bp.models.van_der_pol, {"mu": 0.5, "omega": 1.0}, frequency=0.15, samples=100)
    with pytest.raises(ValueError, match="vary: must be one of 'mu', 'omega', got 'frequency'"):
        bp.continue_periodic(bp.models.van_der_pol, start, "frequency", until=0.3, progress=False)


def test_parameters_of_a_forced_model_can_be_varied_too(rotation):
    """More of the drive's amplitude; solved again at the end with that value."""
    branch = bp.continue_periodic(bp.models.pendulum, rotation[0], "a", until=0.12, step=0.002, progress=False)
    again = bp.solve_periodic(
        bp.models.pendulum,
        PENDULUM | {"a": 0.12},
        frequency=rotation[0].frequency,
        samples=200,
        scheme="central4",
        winding=1,
        guess=branch[-1],
    )
    assert branch.units["a"] == "m" and branch[-1].parameters["a"] == 0.12
    assert again.iterations <= 1 and again.states["phi"] == pytest.approx(branch[-1].states["phi"], abs=1e-9)


def test_branch_from_a_fold_away_from_its_target_is_incomplete():
    force = {"force": 0.4 * np.cos(2 * np.pi * grid(100))}
    start = bp.solve_periodic(
        bp.models.duffing, {"m": 1, "c": 0.1, "k": 1, "k3": 0.5}, force, frequency=0.08, samples=100, scheme="central4"
    )
    fold = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, progress=False).folds[0]
    away = bp.continue_periodic(bp.models.duffing, fold, "frequency", until=0.4, progress=False)
    assert len(away) == 1 and not away.complete and "stuck" in repr(away)
    back = bp.continue_periodic(bp.models.duffing, fold, "frequency", until=0.25, progress=False)
    assert back.complete and back[-1].frequency == pytest.approx(0.25)


def test_branch_through_a_thousandfold_resonance_is_complete():
    """Through a linear resonance from far above it, whose amplitudes are known in closed form."""
    tau = np.arange(16) / 16
    values = {"m": 1.0, "c": 0.02, "k": 1.0, "k3": 0.0}
    start = bp.solve_periodic(
        bp.models.duffing, values, {"force": np.cos(2 * np.pi * tau)}, frequency=8 / (2 * np.pi), samples=16,
        scheme="fourier",
    )  # fmt: skip
    branch = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.5 / (2 * np.pi), progress=False)
    assert branch.complete and not branch.folds and len(branch) < 1000
    omega = 2 * np.pi * branch.values
    amplitude = np.array([np.sqrt(2.0) * s.states["x"].std() for s in branch])
    assert np.allclose(amplitude, 1.0 / np.abs(1.0 - omega**2 + 0.02j * omega), rtol=1e-6)
    assert amplitude.max() > 1000 * amplitude[0]
    assert np.diff(branch.values).min() > -1.0001 * abs(branch.values[-1] - branch.values[0]) / 50


def built(model: bp.Model, inputs: dict, frequency: float, **changes) -> PeriodicEquations:
    return PeriodicEquations.build(model, inputs, frequency=frequency, **({"samples": 100} | changes))


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


def test_a_parameter_may_be_called_inputs():
    """ẋ + k x = u has the gain 1/(k + iω)."""
    relaxation = bp.Model(
        "relaxation",
        states=["x"],
        inputs=["u"],
        parameters=["inputs"],
        equations=lambda s, p, u: [s.dx + p.inputs * s.x - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    wave = np.exp(1j * TURN * grid(21))
    start = bp.solve_periodic(
        relaxation, {"inputs": 1.0}, {"u": wave.real}, frequency=1.0, samples=21, scheme="fourier"
    )
    branch = bp.continue_periodic(relaxation, start, "inputs", until=2.0, progress=False)
    assert branch[-1].parameters == {"inputs": 2.0}
    assert branch[-1].states["x"] == pytest.approx((wave / (2.0 + 1j * TURN)).real, abs=1e-9)
