"""Hessian of the log-posterior over the sampling coordinates, against closed forms, and where there is none."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize

import bayesperiodic as bp
from bayesperiodic.density.log_posterior import RIDGE_COORDINATES, LogPosterior
from bayesperiodic.estimation import laplace
from bayesperiodic.estimation.gauss_newton import Iterate
from tests.known import LINEAR, grid, linear_experiment, linear_regressors

TRUTH, SD = np.array([900.0, 40.0, 25.0]), 3.0
PRIORS = {"k": bp.LogNormal(800.0, 0.2), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}


@pytest.mark.parametrize("known", [True, False])
def test_joint_laplace_is_that_of_the_closed_form_density_of_a_regression(known):
    """Over ln k, c, coulomb and ln v: −½ [n ln v + M/v] with the normal priors; mode by a search, exact Hessian."""
    run = linear_experiment(TRUTH, SD, seed=1)
    y, design, count = run.outputs["force"], linear_regressors(0.05, 2.0, grid(40)), 40
    mean, sd = np.array([np.log(800.0), 30.0, 20.0]), np.array([0.2, 20.0, 10.0])

    def minus(point):
        rest = y - design @ [np.exp(point[0]), *point[1:3]]
        v = SD**2 if known else np.exp(point[3])
        return 0.5 * (count * np.log(v) + rest @ rest / v + np.sum(((point[:3] - mean) / sd) ** 2))

    start = np.array([np.log(900.0), 40.0, 25.0, np.log(9.0)])[: 3 if known else 4]
    best = minimize(minus, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 9000}).x
    k, v = np.exp(best[0]), SD**2 if known else np.exp(best[3])
    rest, slopes = y - design @ [k, *best[1:3]], np.array([k, 1.0, 1.0])
    hessian = (design * slopes).T @ (design * slopes) / v + np.diag(sd**-2.0)
    hessian[0, 0] -= k * design[:, 0] @ rest / v
    if not known:
        beside = (design * slopes).T @ rest / v
        hessian = np.block([[hessian, beside[:, None]], [beside, rest @ rest / (2.0 * v)]])
    problem = bp.Problem(LINEAR, [run], priors=PRIORS, fixed={"variance[force]": SD**2} if known else {})
    density = LogPosterior(problem, problem.density().solver, coordinates=RIDGE_COORDINATES)
    theta = np.array([850.0, 35.0, 22.0])
    start = Iterate(theta, density.linearise(theta), np.array([SD**2]), np.nan)
    found = laplace.joint_laplace(density, start)
    labels = [*PRIORS] + ["variance[force]"] * (not known)
    assert [*found.mode] == [*found.covariance.index] == [*found.covariance.columns] == labels
    assert [*found.mode.values()][:3] == pytest.approx([k, *best[1:3]], rel=1e-5)
    scale = np.sqrt(np.diag(np.linalg.inv(hessian)))
    expected = np.linalg.inv(hessian) / np.outer(scale, scale)
    assert found.covariance.to_numpy() / np.outer(scale, scale) == pytest.approx(expected, abs=1e-4)
    if not known:
        assert found.mode["variance[force]"] == pytest.approx(v, rel=1e-5)
    other = dict(zip(labels, [880.0, 36.0, 21.0, 10.0], strict=False))
    point = np.array([np.log(880.0), 36.0, 21.0, np.log(10.0)])[: len(labels)]
    noise = np.array([other.get("variance[force]", SD**2)])
    there = float(density.at(np.array([[880.0, 36.0, 21.0]]), noise[None]).log_prob[0])
    assert found.log_density - there == pytest.approx(minus(point) - minus(best), abs=1e-6)


class Quadratic:
    """Gradients of two experiments' log-likelihoods, −½ θᵀ Hᵉ θ, of b and of a parameter a of each experiment."""

    def __init__(self):
        self.maps = {
            "one": SimpleNamespace(columns={"a": 0, "b": 2}), "two": SimpleNamespace(columns={"a": 1, "b": 2}),
        }  # fmt: skip
        self.parts = {"one": np.array([[4.0, 0.0, 1.0], [0, 0, 0], [1.0, 0.0, 3.0]])}
        self.parts["two"] = np.array([[0.0, 0, 0], [0.0, 9.0, -2.0], [0.0, -2.0, 5.0]])
        self.asked = []

    def gradients(self, problem, theta, mode):
        """Return the gradients at θ."""
        self.asked.append(theta - mode.theta)
        return {name: -part @ theta for name, part in self.parts.items()}


def test_local_parameters_are_moved_together_by_a_thousandth_of_their_sds(monkeypatch):
    quadratic = Quadratic()
    total = sum(quadratic.parts.values())
    monkeypatch.setattr(laplace, "_gradients", quadratic.gradients)
    problem = SimpleNamespace(names=("a[one]", "a[two]", "b"), parameter_maps=quadratic.maps)
    objective = SimpleNamespace(
        density=SimpleNamespace(problem=problem), hessian_and_gradient=lambda mode: (total, None)
    )
    mode = SimpleNamespace(theta=np.array([1.0, 2.0, 3.0]))
    assert laplace._second_derivatives(objective, mode) == pytest.approx(-total, rel=1e-9, abs=1e-9)
    steps = 1e-3 / np.sqrt(np.diag(total))
    expected = [sign * steps * part for part in ([1, 1, 0], [0, 0, 1]) for sign in (1, -1)]
    assert np.array(quadratic.asked) == pytest.approx(np.array(expected))


def noisy(supports, power, names=("variance[x]", "variance[y]")):
    """Return objective and mode of a likelihood −power·ln v of two variances, one of which is known, beside θ."""
    mode = SimpleNamespace(
        theta=np.array([2.0, 5.0]), noise=np.array([0.5, 3.0]), objective=-7.0,
        here=SimpleNamespace(residuals="r", vjp=lambda by, adjoint: {"one": np.array([by, 0.0]), "two": np.ones(2)}),
    )  # fmt: skip

    def value_and_gradients(residuals, noise):
        # The derivative of the likelihood by θ₀ is 4 ln v, so that its second one by θ₀ and ln v is 4.
        assert residuals == "r" and noise[0] == 0.5
        return 0.0, 4.0 * np.log(noise[1]), np.array([np.nan, -power])

    prior = SimpleNamespace(curvature=lambda theta: np.diag([0.5, 0.25]), gradient=lambda theta: np.array([0.1, 0.2]))
    problem = SimpleNamespace(
        names=("a", "b"), joint_prior=prior, likelihood=SimpleNamespace(value_and_gradients=value_and_gradients),
        noise_names=names, free_noise=names[1:],
    )  # fmt: skip
    density = SimpleNamespace(problem=problem, logarithmic=np.array([True, False]))
    return SimpleNamespace(density=density), mode


@pytest.mark.parametrize(
    ("ends", "added"), [((-9.0, 9.0), 0.0), ((np.log(3.0) - 5e-5, 9.0), 1.0), ((-9.0, np.log(3.0) + 5e-5), 1.0)]
)
def test_hessian_over_logarithms_and_at_an_end_of_the_support_of_a_variance(monkeypatch, ends, added):
    """There the density falls as exp(−slope·distance), whose variance is 1/slope²."""
    objective, mode = noisy(ends, power=6.0)
    monkeypatch.setattr(laplace, "_second_derivatives", lambda *_: -np.array([[3.0, 1.0], [1.0, 8.0]]))
    monkeypatch.setattr(laplace, "log_supports", lambda likelihood: np.array([ends]))
    gradient = 4.0 * np.log(3.0) + 1.0 + 0.1
    expected = np.array(
        [
            [2.0**2 * 3.5 - 2.0 * gradient, 2.0 * 1.0, -2.0 * 4.0],
            [2.0 * 1.0, 8.25, 0.0],
            [-2.0 * 4.0, 0.0, added * 6.0**2],
        ]
    )
    assert laplace._hessian(objective, mode, [1]) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    alone = laplace._hessian(objective, mode, [])
    assert alone == pytest.approx(expected[:2, :2])


@pytest.mark.parametrize(
    ("hessian", "exists"),
    [
        (np.diag([4.0, 1e-8]), True),
        (np.array([[1.0, 1.0 - 1e-9], [1.0 - 1e-9, 1.0]]), True),
        (np.array([[1.0, 1.0 - 1e-15], [1.0 - 1e-15, 1.0]]), False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), False),
        (np.diag([4.0, 0.0]), False),
        (np.diag([4.0, -1.0]), False),
        (np.diag([4.0, np.nan]), False),
    ],
)
def test_a_hessian_that_is_not_that_of_a_maximum_has_no_inverse(monkeypatch, hessian, exists):
    _, mode = noisy(None, 1.0)
    problem = SimpleNamespace(names=("a",), free_noise=("variance[y]",), noise_names=("variance[x]", "variance[y]"))
    monkeypatch.setattr(laplace, "Objective", lambda density: SimpleNamespace(at=at, anchored=lambda one: ("at", one)))
    monkeypatch.setattr(laplace, "climb", lambda objective, start: (mode, "converged", start))
    monkeypatch.setattr(laplace, "_hessian", lambda objective, one, free: hessian if free == [1] else None)
    at = lambda theta, here, noise: (theta, here, noise)  # noqa: E731
    mode.theta = np.array([2.0])
    start = SimpleNamespace(theta=1, here=2, noise=3)
    found = laplace.joint_laplace(SimpleNamespace(problem=problem), start)
    assert (found.mode, found.log_density) == ({"a": 2.0, "variance[y]": 3.0}, -7.0)
    expected = np.linalg.inv(hessian) if exists else np.full((2, 2), np.nan)
    names = ["a", "variance[y]"]
    pd.testing.assert_frame_equal(found.covariance, pd.DataFrame(expected, names, names), rtol=1e-5)


@pytest.mark.parametrize("free", [True, False])
def test_gradients_of_experiments_are_those_of_orbits_that_are_followed(free):
    """Of free-running models they are anchored first; NaN where a solve fails."""

    def there(anchored, converged=True):
        return SimpleNamespace(
            converged=converged, residuals="moved", anchored=lambda: there(True, converged),
            vjp=lambda by, adjoint: {"run": (by, adjoint, anchored)},
        )  # fmt: skip

    problem = SimpleNamespace(
        model=SimpleNamespace(autonomous=free), forward=free, observations=("run", "other"),
        likelihood=SimpleNamespace(value_and_gradients=lambda r, noise: (None, (r, noise), None)),
    )  # fmt: skip
    mode = SimpleNamespace(noise="noise", here=SimpleNamespace(moved=lambda theta: there(False)))
    assert laplace._gradients(problem, np.ones(3), mode) == {"run": (("moved", "noise"), not free, free)}
    mode.here = SimpleNamespace(moved=lambda theta: there(False, converged=False))
    lost = laplace._gradients(problem, np.ones(3), mode)
    assert [*lost] == ["run", "other"] and all(np.isnan(g).tolist() == [True] * 3 for g in lost.values())
