"""Rows of tables beyond folds at many parameters: compiled folds against the continuation along the branch."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.density import sheets
from bayesperiodic.density.responses import ResponseSolver
from tests import harmonic_balance

ROWS = np.array([0.15, 0.17, 0.185, 0.195, 0.199, 0.2])
THETA = np.array([0.1, 1.0, 0.3])
PRIORS = {"c": bp.LogNormal(0.1, 1.0), "k": bp.LogNormal(1.0, 0.3), "k3": bp.LogNormal(0.3, 1.0)}


def solver_of(force) -> ResponseSolver:
    """Return the solver of an upper sheet whose amplitudes are those of a backbone."""
    amplitude = np.sqrt(((2 * np.pi * ROWS) ** 2 - 1.0 + 0.6).clip(0.2) / 0.225)
    runs = bp.response_table(
        {"f": ROWS, "A": amplitude, "F": np.broadcast_to(force, ROWS.shape)}, frequency="f",
        outputs={"displacement": "A"}, inputs={"force": "F"}, sweep="up", sd={"displacement": 0.1}, samples=64,
    )  # fmt: skip
    problem = bp.Problem(bp.models.duffing, runs, priors=PRIORS, fixed={"m": 1.0}, scheme="central4")
    return ResponseSolver.start(problem, THETA)


def responses(solver: ResponseSolver, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies and amplitudes (rows, θ)."""
    simulation, each = solver.solve(theta), [solver.problem.experiments[k].name for k in range(ROWS.size)]
    assert not simulation.status.any()
    outputs = np.stack([simulation.response(name).outputs[..., 0] for name in each])
    frequency = np.stack([simulation.response(name).frequency for name in each])
    return frequency, np.abs(np.fft.rfft(outputs, axis=-1)[..., 1]) * 2 / outputs.shape[-1]


FORCES = {"constant": 0.2, "drop at resonance": 0.2 - 0.02 * (ROWS - 0.15) / 0.05}


@pytest.mark.parametrize("force", FORCES.values(), ids=[*FORCES])
def test_compiled_folds_are_those_of_the_continuation(force, monkeypatch):
    theta = THETA * np.exp(np.random.default_rng(1).normal(0.0, [0.03, 0.003, 0.01], (60, 3)))
    solver = solver_of(force)
    followed = []
    trace = sheets.Sheet._follow
    monkeypatch.setattr(sheets.Sheet, "_follow", lambda *given: (followed.append(1), trace(*given)))
    frequency, amplitude = responses(solver, theta)
    beyond = np.any(frequency != ROWS[:, None], axis=0)
    assert 15 < beyond.sum() and len(followed) < 0.2 * beyond.sum()
    monkeypatch.setattr(sheets.Sheet, "_fold", lambda *given: None)
    slowly, there = responses(solver_of(force), theta)
    assert frequency == pytest.approx(slowly, rel=1e-9) and amplitude == pytest.approx(there, rel=1e-6)


def test_rows_beyond_the_fold_are_those_of_harmonic_balance():
    theta = THETA * [[1.06, 1.0, 1.0], [1.03, 1.0, 0.99], [0.9, 1.0, 1.0]] * np.ones((3, 3))
    theta = np.concatenate([theta] * 4)  # so many that the folds are solved first
    frequency, _ = responses(solver_of(0.2), theta)
    folds = [harmonic_balance.fold((1.0, *one), 0.2, "up") for one in theta]
    assert frequency == pytest.approx(np.minimum(ROWS[:, None], folds), rel=5e-6)


def test_a_response_does_not_depend_on_the_others_that_are_solved_with_it():
    theta = THETA * np.exp(np.random.default_rng(2).normal(0.0, [0.05, 0.003, 0.02], (24, 3)))
    solver = solver_of(0.2)
    together, alone = responses(solver, theta), [responses(solver_of(0.2), one[None]) for one in theta]
    for whole, parts in zip(together, zip(*alone, strict=True), strict=True):
        assert whole == pytest.approx(np.concatenate(parts, axis=1), rel=1e-9)
