"""Response tables of condensed models: against harmonic balance with SciPy, and the symbolic route."""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.density.sweeps import _branches as branches_of
from bayesperiodic.density.sweeps import tables
from tests.density.test_sweeps import (
    THETA,
    check_that_a_sweep_starts_on_the_right_side_of_the_jump,
    check_that_points_one_by_one_may_be_on_any_stable_part,
    folds,
    predicted,
)
from tests.response_tables import FORCE, PRIORS, TRUTH, noisy, swept

Element = bp.elements.Element


def spring(d, k3):
    """Return a cubic force; of the element "x" its parameter is called x_k3."""
    return k3 * d**3


@cache
def duffing(condensed=True):
    """Return the oscillator of the tables as a model of matrices."""
    return bp.Model.from_matrices(
        "duffing", mass=np.eye(1), damping={"c": np.eye(1)}, stiffness={"k": np.eye(1)}, forces={"force": 0},
        outputs={"displacement": (0, "displacement")}, elements=[Element("x", spring, 0)], condensed=condensed,
    )  # fmt: skip


def problem_of(frequencies, amplitudes, sweep, condensed=True, force=FORCE, **more):
    """Return the problem of a table with amplitudes and phases."""
    table = {"f": frequencies, "c": amplitudes, "F": np.broadcast_to(force, np.shape(frequencies))}
    columns = {"frequency": "f", "outputs": {"displacement": "c"}, "inputs": {"force": "F"}}
    runs = bp.response_table(table, **columns, sweep=sweep)
    priors = {("x_k3" if name == "k3" else name): prior for name, prior in PRIORS.items()}
    return bp.Problem(duffing(condensed), runs, priors=priors, **more)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_a_sweep_starts_on_the_right_side_of_the_jump(direction):
    check_that_a_sweep_starts_on_the_right_side_of_the_jump(problem_of, direction)


def test_points_measured_one_by_one_may_be_on_any_stable_part():
    check_that_points_one_by_one_may_be_on_any_stable_part(problem_of)


@pytest.mark.parametrize("solves", [1, 12])
def test_points_beyond_the_fold_get_the_orbit_at_the_fold(solves):
    """Also where more solves are made than from which on folds of other models are solved first."""
    rows = np.array([0.15, 0.18, 0.199, 0.2, 0.20015])
    solver = ResponseSolver.start(problem_of(rows, swept(rows, "up"), "up"), THETA)
    beyond = THETA * [1.05, 1.0, 1.0]
    (fold,), (exact,) = folds(beyond)
    amplitudes, frequencies, simulation = predicted(solver, np.tile(beyond, (solves, 1)), solves - 1)
    assert simulation.status.tolist() == [0] * solves
    assert frequencies == pytest.approx(np.minimum(rows, fold), rel=3e-6)
    assert np.abs(amplitudes[2:]) == pytest.approx(exact, rel=1e-3)
    there = solver.anchored(beyond).anchored(THETA)
    again, frequencies, _ = predicted(there)
    assert frequencies.tolist() == rows.tolist() and again == pytest.approx(swept(rows, "up"), abs=1e-3)


@pytest.mark.parametrize("direction", ["up", None])
def test_density_and_gradient_are_those_of_the_symbolic_model(direction):
    """Before and beyond the fold of the last row."""
    rows = np.array([0.12, 0.15, 0.18, 0.199, 0.2])
    data, noise = noisy(swept(rows, "up"), 0.01, 3), {"variance[displacement]": 0.01}
    ours, other = (problem_of(rows, data, direction, condensed, scheme="fourier") for condensed in (True, False))
    ours, other = (p.anchored(dict(zip(p.names, THETA, strict=True))) for p in (ours, other))
    for theta in (THETA, THETA * [0.99, 1.01, 1.01], THETA * [1.02, 1.0, 1.0]):
        assert ours.log_likelihood(theta, noise) == pytest.approx(other.log_likelihood(theta, noise), rel=1e-5)
        gradients = [p.gradient(dict(zip(p.names, theta, strict=True)), noise) for p in (ours, other)]
        np.testing.assert_allclose(*gradients, rtol=2e-3, atol=1e-4 * np.abs(gradients[1]).max())


def test_forces_that_change_along_the_table_are_interpolated():
    """The branch meets the solutions at the rows, and its folds lie where the symbolic model has them."""
    rows = np.linspace(0.12, 0.24, 7)
    force = np.linspace(0.8, 1.3, 7) * FORCE
    given = [
        problem_of(rows, swept(rows, "up"), "up", condensed, force, scheme="fourier") for condensed in (True, False)
    ]
    passages = []
    for problem in given:
        (table,) = tables(problem).values()
        [branch] = branches_of(problem, THETA, table)
        passages.append(branch)
    ours, other = passages
    assert [(p.sheet, p.point) for p in ours] == [(p.sheet, p.point) for p in other]
    assert sum(p.is_fold for p in ours) == 2
    for here, there in zip(ours, other, strict=True):
        assert here.equations.frequency == pytest.approx(there.equations.frequency, rel=1e-6)
        x, y = (p.equations.outputs(p.z, np.array([*THETA])) for p in (here, there))
        assert x == pytest.approx(y, abs=1e-3 * np.abs(y).max())


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["up", None])
def test_estimate_is_that_of_the_symbolic_model(direction):
    rows = np.linspace(0.12, 0.24, 9)
    data = noisy(swept(rows, "up"), 0.01, 3)
    ours, other = (
        bp.map_estimate(problem_of(rows, data, direction, condensed, scheme="fourier"), progress=False)
        for condensed in (True, False)
    )
    assert ours.converged and other.converged
    for name, value in other.theta.items():
        assert ours.theta[name] == pytest.approx(value, abs=0.02 * other.sd[name])
        assert ours.sd[name] == pytest.approx(other.sd[name], rel=0.02)
        assert abs(value - TRUTH[name.removeprefix("x_")]) < 4 * other.sd[name]


def chain_with_slider(frequencies, force, stiffness, limit, damping, steps=400, periods=80):
    """Return complex amplitudes (masses, frequencies) of a chain whose last mass is held by an exact elastic slider.

    The chain is that of three unit masses and springs with one end fixed, the force acts on the first mass. The steps
    are those of Verlet; the force of the slider follows the displacement and is cut off at its limit.
    """
    springs = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    x, v, sum_ = np.zeros((3, len(frequencies))), np.zeros((3, len(frequencies))), 0.0
    slider, h = np.zeros(len(frequencies)), 1.0 / (np.asarray(frequencies) * steps)

    def acceleration(x, v, slider, step):
        a = -springs @ x - damping * v
        a[0] += force * np.cos(2 * np.pi * step / steps)
        a[2] -= slider
        return a

    for step in range(1, steps * periods + 1):
        half = v + 0.5 * h * acceleration(x, v, slider, step - 1)
        x = x + h * half
        slider = np.clip(slider + stiffness * h * half[2], -limit, limit)
        v = half + 0.5 * h * acceleration(x, half, slider, step)
        if step > steps * (periods - 4):
            sum_ = sum_ + x * np.exp(-2j * np.pi * step / steps)
    return sum_ / (2 * steps)


@pytest.mark.slow
def test_a_table_of_a_chain_with_friction_gives_its_parameters():
    """The joint sticks at four rows and slides at the others; the branch has no fold, and no warning names one.

    Each parameter is within three standard deviations and the error by the rounded slider: 1 % of false alarms.
    """
    truth, force = {"alpha": 0.05, "joint_stiffness": 0.5, "joint_limit": 0.15}, 0.12
    rows, random = np.array([0.05, 0.07, 0.08, 0.1, 0.108, 0.115, 0.13]), np.random.default_rng(3)
    exact = chain_with_slider(rows, force, *(truth[n] for n in ("joint_stiffness", "joint_limit", "alpha")))[[0, 2]]
    data = exact + 0.01 * np.abs(exact).max() * (np.array([1.0, 1j]) @ random.standard_normal((2, 2, len(rows))))
    springs = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    model = bp.Model.from_matrices(
        "chain", mass=np.eye(3), stiffness=springs, damping={"alpha": np.eye(3)}, forces={"force": 0},
        outputs={"first": (0, "displacement"), "last": (2, "displacement")}, condensed=True,
        elements=[Element("joint", bp.elements.jenkins, 2, {"width": 0.05})],
    )  # fmt: skip
    table = {"f": rows, "a": data[0], "b": data[1]}
    runs = bp.response_table(
        table, frequency="f", outputs={"first": "a", "last": "b"}, inputs={"force": force}, sweep="up"
    )
    problem = bp.Problem(model, runs, priors={n: bp.LogNormal(1.2 * value, 0.5) for n, value in truth.items()})
    fit = bp.map_estimate(problem, start={n: 1.1 * value for n, value in truth.items()}, checks=False, progress=False)
    assert fit.converged
    for name, value in truth.items():
        assert abs(fit.theta[name] - value) < 3.0 * fit.sd[name] + 0.002 * value
