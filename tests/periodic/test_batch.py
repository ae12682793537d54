import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Anchor, solve_batch
from bayesperiodic.periodic.equations import PeriodicEquations
from tests.known import grid

DUFFING = np.array([0.45, 1.3, 900.0, 4e5])


@pytest.fixture(scope="module")
def equations():
    force = 20.0 * np.cos(2 * np.pi * grid(200))
    return PeriodicEquations.build(
        bp.models.duffing, {"force": force}, frequency=5.0, samples=200, scheme="central2", periods=1, winding=0
    )


@pytest.fixture(scope="module")
def anchor(equations):
    z = equations.solve(DUFFING, equations.static_guess(DUFFING)).z
    return Anchor(DUFFING, z, equations.parameter_sensitivities(z, DUFFING).states)


def spread(count: int) -> np.ndarray:
    return DUFFING * (1 + 0.02 * np.random.default_rng(1).standard_normal((count, 4)))


def test_batch_equals_single_solves(equations, anchor):
    parameters = spread(6)
    outputs, status, _ = solve_batch(equations, parameters, anchor)
    assert not status.any()
    for theta, y in zip(parameters, outputs, strict=True):
        alone = bp.solve_periodic(
            bp.models.duffing,
            dict(zip(bp.models.duffing.parameters, theta, strict=True)),
            {"force": equations.inputs[:, 0]},
            frequency=5.0,
            samples=200,
        )
        assert y[:, 0] == pytest.approx(alone.outputs["displacement"], rel=1e-8, abs=1e-12)


def test_bits_do_not_depend_on_the_number_of_threads(equations, anchor):
    parameters = spread(37)
    one = solve_batch(equations, parameters, anchor, threads=1)
    for threads in (2, 3, 8):
        many = solve_batch(equations, parameters, anchor, threads=threads)
        assert all(np.array_equal(a, b) for a, b in zip(one, many, strict=True))


def test_a_failed_solve_leaves_its_neighbours_alone(equations, anchor):
    parameters = spread(5)
    parameters[2] = np.nan
    outputs, status, _ = solve_batch(equations, parameters, anchor)
    assert status[2] != 0 and not status[[0, 1, 3, 4]].any()
    assert np.isfinite(outputs[[0, 1, 3, 4]]).all()
