import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Anchor, Batch
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT
from bayesperiodic.periodic.equations import PeriodicEquations
from studies import shooting
from tests.known import GEAR, grid
from tests.pendulum import PENDULUM, pendulum_solution

DUFFING = np.array([0.45, 1.3, 900.0, 4e5])
# The landing gear, whose equations are singular at theta16 = 0.
GEAR_NAMES = list(GEAR)
GEAR_FREE = [GEAR_NAMES.index(name) for name in ("theta4", "theta6", "theta16")]
GEAR_THETA = np.array([GEAR[name] for name in GEAR_NAMES])
GEAR_SAMPLES = 400
# Frequency [Hz], force amplitude about 4.5 kN [N], displacement amplitude about 0.12 m [m].
GEAR_RUNS = ((0.05, 1500.0, 0.080), (0.3, 1100.0, 0.048), (1.0, 700.0, 0.021), (6.0, 600.0, 0.0021))


def build(force: np.ndarray, frequency: float = 5.0) -> PeriodicEquations:
    return PeriodicEquations.build(bp.models.duffing, {"force": force}, frequency=frequency, samples=force.size)


def anchored(equations: PeriodicEquations, guess: np.ndarray | None = None) -> Anchor:
    solved = equations.solve(DUFFING, equations.static_guess(DUFFING) if guess is None else guess)
    assert solved.code == CONVERGED
    return Anchor.at(equations, DUFFING, solved.z)


@pytest.fixture(scope="module")
def equations():
    return build(20.0 * np.cos(2 * np.pi * grid(200)))


@pytest.fixture(scope="module")
def batch(equations):
    return Batch([equations], [anchored(equations)])


def spread(count: int, sd: float = 0.02) -> np.ndarray:
    return DUFFING * (1 + sd * np.random.default_rng(1).standard_normal((count, 4)))


def alone(equations: PeriodicEquations, theta: np.ndarray) -> np.ndarray:
    solution = bp.solve_periodic(
        bp.models.duffing,
        dict(zip(bp.models.duffing.parameters, theta, strict=True)),
        {"force": equations.inputs[:, 0]},
        frequency=equations.frequency,
        samples=equations.grid.samples,
    )
    assert solution.converged
    return solution.outputs["displacement"]


def test_batch_equals_single_solves(equations, batch):
    parameters = spread(6)
    _, (outputs,), _, (status,), _ = batch.solve(parameters)
    assert not status.any()
    for theta, y in zip(parameters, outputs, strict=True):
        assert y[:, 0] == pytest.approx(alone(equations, theta), abs=1e-9 * np.ptp(y))


def test_kept_solutions_are_converged_to_rounding(equations, batch):
    """Those that are not end where the next chord step would be below 1e-9 of the amplitude."""
    parameters = spread(20, sd=0.005)
    (kept,), *_, (status,), _ = batch.solve(parameters, keep=True, polish=True)
    assert not status.any()
    for theta, z in zip(parameters, kept, strict=True):
        columns = equations.residual_jacobian(z, theta)
        (newton,) = equations.factors(columns).solve(columns[None, :, : equations.count])
        assert np.abs(newton).max() < 1e-13 * np.ptp(z)


def test_input_sets_times_parameter_vectors():
    tau = grid(200)
    sets = [build(f * np.cos(2 * np.pi * tau), nu) for f, nu in ((20.0, 5.0), (5.0, 3.0), (10.0, 12.0))]
    parameters = spread(5)
    _, outputs, _, status, _ = Batch(sets, [anchored(e) for e in sets]).solve(parameters)
    assert outputs.shape == (3, 5, 200, 1) and not status.any()
    for e, per_set in zip(sets, outputs, strict=True):
        for theta, y in zip(parameters, per_set, strict=True):
            assert y[:, 0] == pytest.approx(alone(e, theta), abs=1e-9 * np.ptp(y))


def test_sets_on_different_grids_are_refused(equations):
    other = build(np.ones(100))
    with pytest.raises(ValueError, match="sets: all must have the same model, scheme, samples and periods"):
        Batch([equations, other], [anchored(equations), anchored(other)])


def test_small_changes_need_no_factorisation(equations):
    """Chord steps with the anchor's factors count as iterations, too: two or three suffice after a small change."""
    _, (outputs,), _, (status,), (iterations,) = Batch([equations], [anchored(equations)]).solve(spread(20, sd=1e-3))
    assert not status.any() and np.all(iterations <= 3)
    assert np.all(np.ptp(outputs, axis=1) > 0)


def test_prediction_of_second_order_leaves_one_chord_step_after_a_tiny_change(equations):
    """Of a change by 1e-3 the third order is 1e-9; without the second order, or its mixed terms, two steps are taken.

    The step after the prediction would be 1e-6 of the amplitude, and shows whether the coefficients are right.
    """
    signs = np.array([[a, b, c, d] for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 1) for d in (-1, 0, 1)])
    parameters = DUFFING * (1.0 + 1e-3 * signs)
    _, (outputs,), _, (status,), (iterations,) = Batch([equations], [anchored(equations)]).solve(parameters)
    assert not status.any() and np.all(iterations == 1)
    for theta, y in zip(parameters[::7], outputs[::7], strict=True):
        assert y[:, 0] == pytest.approx(alone(equations, theta), abs=1e-8 * np.ptp(y))


STOPPED = bp.Model(
    "stopped", states=["q"], inputs=["force"], parameters=["c", "k", "stop", "gap"], outputs={"displacement": "q"},
    equations=["ddq + c*dq + k*q + 0.5*stop*(q - gap + abs(q - gap)) - force"],
)  # fmt: skip


def test_second_derivatives_that_a_stop_does_not_have_lose_no_solve():
    """At a contact that begins or ends the equations have no second derivative, and differences give any value."""
    theta, force = np.array([10.0, 900.0, 300.0, 0.01]), 20.0 * np.cos(2 * np.pi * grid(200))
    equations = PeriodicEquations.build(STOPPED, {"force": force}, frequency=2.0, samples=force.size)
    solved = equations.solve(theta, equations.static_guess(theta))
    assert solved.code == CONVERGED and solved.z.max() > 0.012
    changed = theta * (1 + 0.02 * np.random.default_rng(3).standard_normal((200, 4)))
    _, (outputs,), _, (status,), _ = Batch([equations], [Anchor.at(equations, theta, solved.z)]).solve(changed)
    assert not status.any()
    for one, y in zip(changed, outputs, strict=True):
        newton = equations.solve(one, solved.z)
        assert newton.code == CONVERGED
        assert y[:, 0] == pytest.approx(newton.z[:, 0], abs=1e-7 * np.ptp(y))


def near_a_jump():
    """Return equations 0.1 % below the frequency of a jump down, theta and the orbit of large amplitude there.

    With 30 % less damping its phase turns by 42 degrees at nearly the same amplitude, which a line makes 3.5 times.
    """
    theta, force = np.array([1.0, 0.05, 1.0, 0.3]), 0.1 * np.cos(2 * np.pi * grid(64))
    low, high, z = 0.12, 0.5, None
    while high - low > 1e-6:
        middle = min(1.01 * low, 0.5 * (low + high)) if z is not None else low
        equations = build(force, middle)
        solved = equations.solve(theta, equations.static_guess(theta) if z is None else z)
        if solved.code == CONVERGED and (z is None or np.ptp(solved.z) > 0.9 * np.ptp(z)):
            low, z = middle, solved.z
        else:
            high = middle
    equations = build(force, 0.999 * low)
    return equations, theta, equations.solve(theta, z).z


def test_near_a_fold_chords_reach_where_a_line_does_not():
    """Of every size of change in the damping; the anchor's symmetry once hid the direction that is nearly singular."""
    equations, theta, z = near_a_jump()
    factors = np.linspace(1.0, 0.7, 61)
    parameters = np.repeat(theta[None], factors.size, axis=0)
    parameters[:, 1] *= factors
    _, (outputs,), _, (status,), (iterations,) = Batch([equations], [Anchor.at(equations, theta, z)]).solve(parameters)
    assert not status.any()
    assert iterations.max() <= 6
    for one, y in zip(parameters, outputs, strict=True):
        z = equations.solve(one, z).z
        assert y[:, 0] == pytest.approx(z[:, 0], abs=1e-7 * np.ptp(z))


def test_unconverged_anchor_gives_the_exact_solution(equations):
    guess = Anchor(DUFFING, equations.static_guess(DUFFING), equations.frequency)
    _, (outputs,), _, (status,), _ = Batch([equations], [guess]).solve(DUFFING[None])
    assert status[0] == 0
    assert outputs[0, :, 0] == pytest.approx(alone(equations, DUFFING), abs=1e-9 * np.ptp(outputs))


def test_results_do_not_depend_on_threads_or_on_the_other_points(batch):
    parameters = spread(37)
    one = batch.solve(parameters, threads=1)
    for threads in (2, 3, 8):
        many = batch.solve(parameters, threads=threads)
        assert all(np.array_equal(a, b) for a, b in zip(one, many, strict=True))
    part = batch.solve(parameters[5:9])
    assert np.array_equal(part[0][0], one[0][0, 5:9])


def test_failed_solve_does_not_affect_the_other_points(batch):
    parameters = spread(5)
    parameters[2] = np.nan
    _, (outputs,), _, (status,), _ = batch.solve(parameters)
    assert status[2] != 0 and not status[[0, 1, 3, 4]].any()
    assert np.isfinite(outputs[[0, 1, 3, 4]]).all()


def test_a_failure_in_the_first_set_rejects_the_others_only_with_whole(equations):
    together, parameters = Batch([equations] * 2, [anchored(equations)] * 2), spread(3)
    parameters[1, 3] *= -1e4
    apart, whole = together.solve(parameters), together.solve(parameters, whole=True)
    assert apart.status[:, 1].all() and apart.iterations[1, 1] > 0 == whole.iterations[1, 1]
    alone = together.solve(parameters[1:2], whole=True)
    assert np.all(whole.status[:, 1] == apart.status[0, 1]) and np.array_equal(alone.status[:, 0], whole.status[:, 1])
    for part, other in zip(apart, whole, strict=True):
        assert np.array_equal(part[:, [0, 2]], other[:, [0, 2]])


def test_solves_stay_on_the_branch_of_the_anchor():
    """On the bistable Duffing curve, results either continue the anchor's upper branch or say "other orbit"."""
    tau = grid(200)
    equations = build(0.4 * np.cos(2 * np.pi * tau), 0.22)
    theta = np.array([1.0, 0.1, 1.0, 0.5])
    upper = equations.solve(theta, np.cos(2 * np.pi * tau)[:, None] * 2.0)
    lower = equations.solve(theta, np.cos(2 * np.pi * (tau - 0.5))[:, None] * 0.4)
    assert upper.code == lower.code == 0 and np.ptp(upper.z) > 2.5 * np.ptp(lower.z)
    batch = Batch([equations], [Anchor.at(equations, theta, upper.z)])
    damping = np.linspace(0.1, 0.4, 40)  # the upper branch ends on the way
    parameters = np.tile(theta, (40, 1))
    parameters[:, 1] = damping
    _, (outputs,), _, (status,), _ = batch.solve(parameters)
    followed, still = upper.z, True
    for c, y, code in zip(damping, outputs[:, :, 0], status, strict=True):
        step = equations.solve(np.array([1.0, c, 1.0, 0.5]), followed)
        still &= step.code == 0 and np.ptp(step.z) > 0.7 * np.ptp(followed)
        if not still:
            assert code == OTHER_ORBIT or code != 0
        else:
            followed = step.z
            assert code == 0 and y == pytest.approx(followed[:, 0], rel=1e-6, abs=1e-8)
    assert not still


def test_distant_solves_agree_with_a_continuation_in_small_steps():
    """Spreads by a factor e^0.5 in every parameter: Newton's iteration alone fails or slips on three of 400."""
    tau, theta = grid(200), np.array([1.0, 0.1, 1.0, 0.5])
    equations = build(20.0 * np.cos(2 * np.pi * tau), 0.3)
    start = equations.solve(theta, equations.static_guess(theta))
    parameters = theta * np.exp(0.5 * np.random.default_rng(0).standard_normal((400, 4)))
    batch = Batch([equations], [Anchor.at(equations, theta, start.z)])
    _, (outputs,), _, (status,), (iterations,) = batch.solve(parameters)
    for hardest in np.argsort(iterations)[-12:]:
        z, arrived = start.z, True
        for share in np.linspace(0.0, 1.0, 201):
            step = equations.solve(theta + share * (parameters[hardest] - theta), z)
            arrived &= step.code == CONVERGED and np.max(np.abs(step.z - z)) < 0.15 * np.ptp(z)
            z = step.z
        assert (status[hardest] == CONVERGED) == arrived
        if arrived:
            assert outputs[hardest, :, 0] == pytest.approx(z[:, 0], abs=1e-8 * np.ptp(z))
    assert np.sum(status != CONVERGED) < 3


def test_an_orbit_of_period_two_does_not_become_one_of_period_one():
    """It exists while the rotation of period 1 has a multiplier below −1; where it merges with it, it is lost."""
    known, frequency = shooting.STABLE[0], 11.5 / (2 * np.pi)
    rotation = bp.continue_periodic(
        bp.models.pendulum, pendulum_solution(known, 200, "central4"), "frequency", until=frequency, progress=False
    )
    doubled = bp.double_period(bp.models.pendulum, rotation.period_doublings[0], "frequency")
    branch = bp.continue_periodic(bp.models.pendulum, doubled, "frequency", until=frequency, progress=False)
    orbit, theta = branch[-1], np.array([PENDULUM[name] for name in bp.models.pendulum.parameters])
    equations = PeriodicEquations.build(
        bp.models.pendulum, {}, frequency=frequency, samples=200, scheme="central4", periods=2, winding=orbit.winding
    )
    periodic = orbit.states["phi"] - 2 * np.pi * known.winding * 2 * orbit.tau / 2
    parameters = np.tile(theta, (41, 1))
    column = bp.models.pendulum.parameters.index("a")
    parameters[:, column] *= np.linspace(0.9, 1.1, 41)
    anchor = Anchor.at(equations, theta, equations.solve(theta, periodic[:, None]).z)
    (z,), _, _, (status,), _ = Batch([equations], [anchor]).solve(parameters, keep=True, polish=True)
    one, lost = rotation[-1], 0
    for values, found, code in zip(parameters, z[:, :, 0], status, strict=True):
        one = bp.solve_periodic(
            bp.models.pendulum, dict(zip(PENDULUM, values, strict=True)), frequency=frequency, samples=200,
            scheme="central4", winding=known.winding, guess=one,
        )  # fmt: skip
        if one.multipliers.real.min() < -1.0:
            assert code == CONVERGED and np.max(np.abs(found - np.roll(found, 200))) > 0.05
        else:
            assert code == OTHER_ORBIT
            lost += 1
    assert 10 < lost < 31


def rig(drive: str, scheme: str) -> list[PeriodicEquations]:
    wave = np.cos(2 * np.pi * grid(GEAR_SAMPLES))
    return [
        PeriodicEquations.build(
            bp.models.landing_gear(drive),
            {drive: 4500.0 + force * wave if drive == "force" else 0.12 + stroke * wave},
            frequency=frequency,
            samples=GEAR_SAMPLES,
            scheme=scheme,
        )
        for frequency, force, stroke in GEAR_RUNS
    ]


@pytest.mark.parametrize(
    "spread",
    [(5e-6, 1e-5, 1e-2), (0.05, 0.05, 0.05), (5e-6, 1e-5, 2.0), (5e-6, 1e-5, 5.0)],
    ids=["posterior", "5 %", "theta16 twice its value", "theta16 five times its value"],
)
@pytest.mark.parametrize("scheme", ["backward2", "central2"])
@pytest.mark.parametrize("drive", [pytest.param("force", marks=pytest.mark.slow), "displacement"])
def test_solves_with_reused_factors_equal_solves_from_scratch(drive, scheme, spread):
    """Spreads are standard deviations relative to theta4, theta6 and theta16; many theta16 are negative.

    At theta16 = -0.006 the smallest singular value is 1/350 of the anchor's, and 350 times as much is left after a step
    of 1e-9 with the anchor's factors, unless the step minds the softest direction.
    """
    sets = rig(drive, scheme)
    anchors = [Anchor.at(e, GEAR_THETA, e.solve(GEAR_THETA, e.static_guess(GEAR_THETA)).z) for e in sets]
    parameters = np.tile(GEAR_THETA, (60, 1))
    parameters[:, GEAR_FREE] *= 1.0 + np.array(spread) * np.random.default_rng(1).standard_normal((60, 3))
    parameters[:, GEAR_NAMES.index("theta11")] = -1e5 * parameters[:, GEAR_NAMES.index("theta4")]
    found = Batch(sets, anchors).solve(parameters, keep=True, polish=True)
    assert not found.status.any()
    for equations, z in zip(sets, found.z, strict=True):
        for i in (3, 17, 40):
            alone = equations.solve(parameters[i], equations.static_guess(parameters[i]))
            assert alone.code == 0
            assert np.all(np.abs(z[i] - alone.z).max(axis=0) <= 1e-7 * np.abs(alone.z).max(axis=0))
