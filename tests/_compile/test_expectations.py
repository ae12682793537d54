"""Without the internals of Numba that are expected, public functions of it give the same values."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
# A name that `machine_code` imports; Numba itself has imported what needs it before.
GONE = """
import numba
from numba.core import ccallback, registry
numba.cfunc("void(float64[:,::1])")(lambda rows: None)
del registry.cpu_target
"""
# The first part of ln 2, on which the exponential function rests.
WRONG = """
from bayesperiodic._compile import machine_code
machine_code.LOG2_HIGH = 0.5
"""
VALUES = """
import json, warnings
import numpy as np
import bayesperiodic as bp
from bayesperiodic._compile.expectations import internals_expected
from bayesperiodic._compile.code_generation import compiled
from bayesperiodic._compile.grid_function import GridFunction
from tests.known import formula_model
import sympy as sp

def formula(p, u, s):
    x, y = p.a * u.x, p.a + u.dx
    piecewise = sp.Piecewise((x**3, ~((x > 0) & (y > 1)) | (x > 2)), (sp.tanh(y), True))
    return {"y": piecewise + sp.Abs(x) ** sp.Rational(5, 2) + sp.sign(y) + sp.Max(x, y, 1) * sp.exp(-x) + sp.atan(y)}

model = formula_model("functions", ["a"], formula)
generator = np.random.default_rng(1)
values = []
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for each in (model, bp.models.pendulum):
        kernels, points = each.kernels, 9
        grid = (
            generator.uniform(-1.0, 1.0, (points, 3 * kernels.states)),
            generator.normal(size=(points, 3 * kernels.inputs)),
            generator.uniform(0.5, 2.0, kernels.parameters), np.arange(points) / points, 1.3,
        )
        for name in ("residual", "residual_jacobian", "outputs", "derivatives"):
            values += kernels.evaluate(name, *grid).ravel().tolist()
        module = compiled(each.symbolic.vjp_source((0,)))
        sums = np.full((points + 1, 3 * kernels.states), np.nan)
        states = np.hstack([grid[0], generator.normal(size=(points, kernels.channels))])
        GridFunction(module.outputs_vjp)(states, *grid[1:], sums)
        values += sums.ravel()[: points * 3 * kernels.states + 1].tolist()
    MORE
print(json.dumps([values, [str(warning.message) for warning in caught], internals_expected()]))
"""
SOLUTION = """
    parameters, tau = {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, np.arange(64) / 64
    solution = bp.solve_periodic(
        bp.models.duffing, parameters, {"force": np.cos(2 * np.pi * tau)}, frequency=0.2, samples=64
    )
    values += solution.outputs["displacement"].tolist()
    values += np.sort(np.abs(solution.multipliers)).tolist()
    run = bp.simulate(bp.models.duffing, parameters, {"force": lambda t: np.cos(t)}, frequency=0.2, duration=20,
                      sampling_rate=10)
    values += run.outputs["displacement"].tolist()
"""


def run(folder: Path, before: str, more: str = "") -> tuple[np.ndarray, list[str], bool]:
    """Return values, warnings, and whether the expectations are met in a process that executes a text before."""
    program = before + VALUES.replace("    MORE\n", more)
    environment = os.environ | {"BAYESPERIODIC_CACHE": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    values, messages, met = json.loads(done.stdout)
    return np.array(values), messages, met


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    values, messages, met = run(tmp_path_factory.mktemp("expected"), "")
    assert met and not messages
    return values


@pytest.mark.parametrize(
    "before, reason",
    [(GONE, "ImportError: cannot import name 'cpu_target'"), (WRONG, "ArithmeticError: a test function")],
    ids=["missing name", "wrong value"],
)
def test_models_have_the_same_values_without_the_internals_and_one_warning(tmp_path, expected, before, reason):
    for _ in range(1 + (before == GONE)):  # compiled, and from the cache
        values, messages, met = run(tmp_path, before)
        assert not met and len(messages) == 1 and reason in messages[0]
        assert np.allclose(values, expected, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_periodic_solutions_and_simulations_are_the_same_without_the_internals(tmp_path):
    values, _, met = run(tmp_path / "gone", GONE, SOLUTION)
    expected, _, _ = run(tmp_path / "expected", "", SOLUTION)
    assert not met and np.allclose(values, expected, rtol=1e-10, atol=1e-12)
