"""Starts of condensed models on the orbits that the data show, and polished solves with large matrices."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.density.responses import ResponseSolver
from bayesperiodic.estimation.climbs import near_data, shown_displacements
from bayesperiodic.periodic import condensed_batch
from tests.periodic.test_condensed import FORCE, FREQUENCY, SAMPLES, VALUES, beam, solved

# A panel of two modes, with friction that falls with the speed at its second point.
DRIVE, POINTS, LOAD, PERIODS = 12.4, 64, 9.0, 80
TRUTH = {"rub_static": 4.0, "rub_sliding": 2.0, "rub_speed": 0.05}
SHAPES, OWN_FREQUENCIES, DAMPING, WIDTH = np.array([[0.5, 0.7], [0.6, 0.35], [0.9, -0.4]]), (12.1, 19.7), 0.02, 0.01
WAVE = LOAD * np.cos(2.0 * np.pi * np.arange(POINTS) / POINTS)


def integrated() -> tuple[np.ndarray, float]:
    """Return displacement and its relative change over the last period, by SciPy's integration of the two modes."""
    squares = (2.0 * np.pi * np.array(OWN_FREQUENCIES)) ** 2

    def rates(t, y):
        q, v = y[:2], y[2:]
        slide = SHAPES[1] @ v
        limit = TRUTH["rub_sliding"] + (TRUTH["rub_static"] - TRUTH["rub_sliding"]) * np.exp(
            -((slide / TRUTH["rub_speed"]) ** 2)
        )
        pushed = SHAPES[0] * LOAD * np.cos(2.0 * np.pi * DRIVE * t) - SHAPES[1] * limit * np.tanh(slide / WIDTH)
        return np.concatenate([v, pushed - squares * q - 2.0 * DAMPING * np.sqrt(squares) * v])

    times = (PERIODS - 2 + np.arange(2 * POINTS) / POINTS) / DRIVE
    y = solve_ivp(rates, (0.0, PERIODS / DRIVE), np.zeros(4), "LSODA", t_eval=times, rtol=1e-9, atol=1e-12).y
    before, after = np.split(SHAPES[2] @ y[:2], 2)
    return after, float(np.abs(after - before).max() / np.ptp(after))


@pytest.fixture(scope="module")
def panel() -> bp.Problem:
    """Return the problem of recordings of sliding, with priors at whose medians the panel can stick too."""
    model = bp.Model.from_modes(
        "panel", frequencies=OWN_FREQUENCIES, damping_ratios=DAMPING, shapes=SHAPES, forces={"force": 0},
        outputs={"w": (2, "displacement")}, condensed=True,
        elements=[bp.elements.Element("rub", bp.elements.stribeck, 1, {"width": WIDTH})],
    )  # fmt: skip
    w, change = integrated()
    assert change < 1e-5
    noisy = w + 0.01 * w.std() * np.random.default_rng(3).standard_normal(POINTS)
    run = bp.Experiment("run", DRIVE, {"w": noisy}, {"force": WAVE}, samples=POINTS)
    medians = {"rub_static": 8.0, "rub_sliding": 2.6, "rub_speed": 0.05}
    return bp.Problem(model, [run], priors={n: bp.LogNormal(median, 0.5) for n, median in medians.items()})


def test_the_sliding_orbit_is_that_of_the_data(panel):
    """From rest the panel sticks at the medians, and hardly moves."""
    data = panel.experiments[0].outputs["w"]
    stuck = panel.solve(panel.median())["run"].outputs["w"]
    assert np.ptp(stuck) < 0.1 * np.ptp(data)
    near = near_data(panel, panel.median())
    assert near.converged
    left = near.compared()["run"]["w"]
    assert np.sum(left**2) < 0.25 * np.sum((data - data.mean()) ** 2)


def test_an_estimate_from_medians_at_which_the_panel_sticks(panel):
    """Each parameter is within 3.5 standard deviations of that of SciPy's integration: 0.14 % of false alarms."""
    fit = bp.map_estimate(panel, progress=False)
    assert fit.status == "converged" and not fit.misspecified
    assert all(abs(fit.theta[name] - value) < 3.5 * fit.sd[name] for name, value in TRUTH.items())


def test_displacements_follow_from_outputs_whatever_the_elements():
    """Those of an independent symbolic solution, at other parameters of the elements; None with a mask."""
    whole = solved(4, condensed=False)
    outputs = {name: whole.outputs[name].copy() for name in ("x", "a")}
    run = bp.Experiment("run", FREQUENCY, outputs, {"force": FORCE}, samples=SAMPLES)
    fixed = VALUES | {"air_drag": 0.01}
    fixed.pop("spring_k3")
    problem = bp.Problem(beam(4), [run], priors={"spring_k3": bp.LogNormal(0.3, 0.5)}, fixed=fixed)
    parameters = problem.parameters(problem.median()[None], "run")[0]
    shown = shown_displacements(problem.equations["run"], parameters, run)
    states = np.stack([whole.states[f"x{i}"] for i in range(4)], axis=1)
    expected = np.stack([states[:, 3], states[:, 2] - states[:, 0]], axis=1)
    np.testing.assert_allclose(shown, expected, atol=1e-3 * np.ptp(expected, axis=0).max())
    masked = np.arange(SAMPLES) < 40
    part = bp.Experiment("run", FREQUENCY, outputs, {"force": FORCE}, samples=SAMPLES, mask=masked)
    assert shown_displacements(problem.equations["run"], parameters, part) is None


def test_one_step_of_newtons_gives_the_solution_of_the_fixed_matrix(panel, monkeypatch):
    near = near_data(panel, panel.median())
    there = panel.median() * np.array([1.02, 0.99, 1.01])

    def outputs():
        simulation = ResponseSolver(panel, near.solver.anchors).solve(there[None], keep=True, polish=True)
        assert simulation.status[0] == 0
        return simulation.at(0).response("run").outputs

    fixed = outputs()
    monkeypatch.setattr(condensed_batch, "LARGEST_INVERSE", 0)
    np.testing.assert_allclose(outputs(), fixed, rtol=0.0, atol=1e-9 * np.ptp(fixed))
