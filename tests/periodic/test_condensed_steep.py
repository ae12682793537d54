"""Forces that are steep at few points of the period, and joints that never slide."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.periodic.element_forces import Preconditioner, Steep, linearised, steep_points, times
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.solve import equations_for

Element = bp.elements.Element
SAMPLES = 128
PHASE = 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES
FREQUENCIES, RATIO, FORCED = np.array([20.0, 38.0, 61.0, 75.0]), 0.01, 35.0
SHAPES = np.array([[1.1, 0.2, 0.5, -0.9], [0.6, -0.8, 0.3, 0.7], [0.9, 0.9, -0.6, 0.2]])
STATIC, SLIDING, SPEED, WIDTH = 3.0, 2.0, 0.05, 1e-3
SPRINGS = 1e4 * (2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1))
ELASTIC = {
    "jenkins": {"width": 0.1},
    "dahl": {},
    "bouc_wen": {"exponent": 1.5, "shape": 0.5},
    "iwan": {"names": bp.elements.iwan_states("joint", 4), "width": 0.1, "chi": -0.5, "beta": 0.5},
}


def panel() -> bp.Model:
    """Return a panel of four modes with friction that falls with the speed."""
    return bp.Model.from_modes(
        "panel", frequencies=FREQUENCIES, damping_ratios=RATIO, shapes=SHAPES, forces={"force": 0},
        outputs={"x": (1, "displacement")}, condensed=True,
        elements=[Element("rub", bp.elements.stribeck, 2, {"width": WIDTH})],
    )  # fmt: skip


VALUES = {"rub_static": STATIC, "rub_sliding": SLIDING, "rub_speed": SPEED}


def panel_equations() -> tuple[PeriodicEquations, np.ndarray]:
    equations = equations_for(panel(), {"force": 12.0 * np.cos(PHASE)}, frequency=FORCED, samples=SAMPLES)
    return equations, np.array([STATIC, SLIDING, SPEED])


def test_sharp_friction_is_that_of_time_integration():
    """From the state at the start of the period, SciPy's integrator comes back to it, without leaving the solution."""
    force = 12.0 * np.cos(PHASE)
    solution = bp.solve_periodic(panel(), VALUES, {"force": force}, frequency=FORCED, samples=SAMPLES)
    assert solution.converged
    equations, theta = panel_equations()
    z, *_ = equations.find(theta, None)[0]
    q = equations.displacements(z, theta)[0]
    numbers = np.fft.rfftfreq(SAMPLES, 1.0 / SAMPLES)
    v = np.fft.irfft(2j * np.pi * FORCED * numbers[:, None] * np.fft.rfft(q, axis=0), SAMPLES, axis=0)

    def rates(t, state):
        modal, speeds = np.split(state, 2)
        at = SHAPES[2] @ speeds
        friction = (SLIDING + (STATIC - SLIDING) * np.exp(-((at / SPEED) ** 2))) * np.tanh(at / WIDTH)
        load = SHAPES[0] * 12.0 * np.cos(2.0 * np.pi * FORCED * t) - SHAPES[2] * friction
        omega = 2.0 * np.pi * FREQUENCIES
        return np.concatenate([speeds, load - 2.0 * RATIO * omega * speeds - omega**2 * modal])

    first = np.concatenate([q[0], v[0]])
    times_of = np.arange(SAMPLES + 1) / SAMPLES / FORCED
    run = solve_ivp(rates, (0.0, times_of[-1]), first, t_eval=times_of, method="LSODA", rtol=1e-8, atol=1e-12)
    exact = run.y[:4].T @ SHAPES[1]
    scale = np.ptp(exact)
    assert np.abs(solution.outputs["x"] - exact[:-1]).max() < 2e-3 * scale
    assert abs(exact[-1] - exact[0]) < 2e-3 * scale


@pytest.mark.parametrize(("frequency", "size"), [(40.0, 12.0), (55.0, 12.0), (61.0, 6.0)])
def test_solves_with_sharp_friction_converge_also_near_resonances(frequency, size):
    force = size * np.cos(PHASE)
    assert bp.solve_periodic(panel(), VALUES, {"force": force}, frequency=frequency, samples=SAMPLES).converged


def test_any_points_may_be_treated_apart():
    """Slopes of a force by position and by speed at random; with all harmonics the inverse is exact."""
    equations, theta = panel_equations()
    count, rng = 64, np.random.default_rng(3)
    forces = equations.forces(np.zeros((count, 1), dtype=complex), theta)
    stiffness, damping = 1e5 * rng.standard_normal((2, 2 * count, 1))
    rates, d_f = equations.rates(2 * count), equations.matrices(theta, 2 * count)[0].d_f
    forces = forces._replace(stiffness=stiffness, damping=1e-3 * damping)
    at = np.array([3, 17, 90])
    apart = Steep(at, np.zeros(3, dtype=int), *(part[at, 0] for part in (0.8 * stiffness, 5e-4 * damping)))
    x = rng.standard_normal((count, 1)) + 1j * rng.standard_normal((count, 1))
    x[0] = 0.5
    right = x + times(d_f, linearised(forces, rates, x))
    np.testing.assert_allclose(Preconditioner(forces, rates, d_f, count, apart)(right), x, atol=1e-9)


def test_newtons_matrix_with_steep_points_solves_the_linearised_equations():
    """With all harmonics it is the exact inverse, and with few of them it is closer than without such points."""
    equations, theta = panel_equations()
    count = 256
    rng = np.random.default_rng(1)
    d = np.zeros((count, 1), dtype=complex)
    d[1], d[3] = 5e-4, 1e-4j
    forces, rates, d_f = equations.forces(d, theta), equations.rates(2 * count), equations.matrices(theta, 512)[0].d_f
    x = (rng.standard_normal((count, 1)) + 1j * rng.standard_normal((count, 1))) / (1.0 + np.arange(count))[:, None]
    x[0] = 0.5
    right = x + times(d_f, linearised(forces, rates, x))
    steep = steep_points(forces, rates, d_f)
    assert 0 < len(steep.points) < 100
    exact = Preconditioner(forces, rates, d_f, count, steep)(right)
    np.testing.assert_allclose(exact, x, atol=1e-9)
    chosen = Preconditioner(forces, rates, d_f)
    assert chosen.low < count // 2 and np.linalg.norm(chosen(right) - x) < 0.2 * np.linalg.norm(x)
    without = Preconditioner(forces, rates, d_f, chosen.low)
    assert np.linalg.norm(without(right) - x) > 3.0 * np.linalg.norm(chosen(right) - x)


def sticking(kind: str) -> bp.Model:
    """Return three masses with a joint between the first and the last."""
    return bp.Model.from_matrices(
        "sticking", mass=np.eye(3), stiffness=SPRINGS, damping={"alpha": np.eye(3)}, forces={"force": 0},
        outputs={"x": (2, "displacement")}, condensed=True,
        elements=[Element("joint", getattr(bp.elements, kind), (2, 0), ELASTIC[kind])],
    )  # fmt: skip


@pytest.mark.parametrize("kind", ELASTIC)
@pytest.mark.parametrize("limit", [1e4, 1e7, 1e10])
def test_joints_that_never_slide_are_springs(kind, limit):
    """The response is that of the linear structure with the joint's stiffness, and has no mean."""
    model, joint = sticking(kind), 4000.0
    values = {"alpha": 3.0, "joint_stiffness": joint, "joint_limit": limit}
    solution = bp.solve_periodic(model, values, {"force": 10.0 * np.cos(PHASE)}, frequency=14.0, samples=SAMPLES)
    rate, across = 2.0 * np.pi * 14.0, np.array([-1.0, 0.0, 1.0])
    dynamic = SPRINGS + joint * np.outer(across, across) + (3j * rate - rate**2) * np.eye(3)
    exact = (np.linalg.solve(dynamic, [10.0, 0.0, 0.0])[2] * np.exp(1j * PHASE)).real
    assert solution.converged
    np.testing.assert_allclose(solution.outputs["x"], exact, atol=3e-4 * np.abs(exact).max())


@pytest.mark.parametrize("kind", ["jenkins", "dahl", "iwan"])
def test_joints_that_hardly_slide_have_the_mean_of_those_that_slide_a_little(kind):
    """Two harmonics, so that the mean is not zero; at the lower limit it follows from the slip of each period.

    Bouc and Wen's slip is not in proportion to the force, and is left out.
    """
    force = 10.0 * np.cos(PHASE) + 6.0 * np.cos(2.0 * PHASE + 0.7)
    values = {"alpha": 3.0, "joint_stiffness": 4000.0}
    means = []
    for limit in (1e5, 1e9):
        given = values | {"joint_limit": limit}
        solution = bp.solve_periodic(sticking(kind), given, {"force": force}, frequency=14.0, samples=SAMPLES)
        assert solution.converged
        means.append(np.mean(solution.outputs["x"]))
    assert abs(means[0]) > 3e-4 * np.ptp(solution.outputs["x"])
    assert means[1] == pytest.approx(means[0], rel=0.05)
    step, name = 1.0, "joint_stiffness"
    ends = [
        bp.solve_periodic(
            sticking(kind), given | {name: 4000.0 + by}, {"force": force}, frequency=14.0, samples=SAMPLES
        ).outputs["x"]
        for by in (-step, step)
    ]
    slope = (ends[1] - ends[0]) / (2.0 * step)
    np.testing.assert_allclose(solution.sensitivities["x"][name], slope, atol=1e-3 * np.abs(slope).max())
    assert np.mean(solution.sensitivities["x"][name]) == pytest.approx(np.mean(slope), rel=0.05)
