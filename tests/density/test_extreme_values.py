"""At extreme parameters, noise and units the density is −inf or has a status: no warning of NumPy and no LinAlgError.

Warnings in the package are errors in the tests.
"""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import grid
from tests.problems import CASES

FACTORS = (1e-300, 1e-150, 1e-12, -1.0, 1e12, 1e150)
UNITS = [(1e-12, 1.0, 1.0), (1e12, 1e12, 1e-12), (1e-12, 1e-12, 1e12)]
NAMES = ("every sample", "circulant", "measured", "section and multiplier", "masked, correlated", "autonomous")


@cache
def case(name):
    problem, theta = CASES[name]()
    return problem, np.array(theta)


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("name", NAMES)
def test_densities_and_solves_are_silent(name, factor):
    problem, theta = case(name)
    there, noise = theta * factor, np.ones(len(problem.noise_names))
    for at, v in ((theta, noise * abs(factor)), (there, noise)):
        value, gradient = problem.value_and_gradient(at, v)
        assert value == -np.inf or (np.isfinite(value) and np.isfinite(gradient).all())
        assert not np.isnan(problem.log_posterior(at, v)) and not np.isnan(problem.log_likelihood(at, v))
    for coordinates in ("ridge", "natural"):
        density = problem.density(coordinates=coordinates)
        point = np.full(density.dimension, np.log(abs(factor)))
        assert not np.isnan(density.evaluate(np.tile(point, (2, 1))).log_prob).any()
        for far in (point, 1e5 * point):  # the logarithms of infinite values too, as a trajectory may reach
            value, gradient, _ = density.value_and_gradient(far)
            assert not np.isnan(value) and np.isfinite(gradient).all()
    assert {solution.status for solution in problem.solve(there).values()}
    assert problem.outputs(np.stack([there, theta]))[1].shape == (2,)
    anchored = problem.anchored(there)
    assert not np.isnan(anchored.log_posterior(there, noise))


@pytest.mark.parametrize("sensors", [False, True], ids=["plain", "sensors"])
@pytest.mark.parametrize("factor", [1e-300, 1e-150, 1e150])
def test_estimate_from_an_extreme_start_ends_with_a_status_or_one_message(factor, sensors):
    problem, theta = case("every sample")
    if sensors:
        problem = problem.replace(
            sensors={"displacement": bp.Sensor(gain=bp.LogNormal(1.0, 0.1), delay=bp.Normal(0, 0.1))}
        )
        theta = problem.median()
    start = dict(zip(problem.names, theta * factor, strict=True))
    try:
        fit = bp.map_estimate(problem, start=start, progress=False, checks=False)
    except ValueError as error:
        assert str(error).startswith("start: must ")
    else:
        assert fit.status and str(fit)


@pytest.mark.parametrize(("length", "time", "force"), UNITS)
def test_an_identification_is_silent_in_any_units(length, time, force):
    """The estimate in other units is that in SI units; all results print."""
    scale = {"m": force * time**2 / length, "c": force * time / length, "k": force / length, "k3": force / length**3}
    truth = {name: value * scale[name] for name, value in {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}.items()}
    run = bp.simulate(
        bp.models.duffing, truth, {"force": 0.5 * force * np.cos(2 * np.pi * grid(32))}, frequency=0.12 / time,
        duration=200 * time, sampling_rate=8 / time, noise={"displacement": 0.02 * length}, seed=1,
    ).between(100 * time, 200 * time)  # fmt: skip
    experiment = run.fold(32, frequency=0.12 / time, harmonics=7)
    priors = {"c": bp.LogNormal(truth["c"], 1.0), "k": bp.LogNormal(truth["k"], 0.5)}
    problem = bp.Problem(
        bp.models.duffing, [experiment], priors=priors, fixed={n: truth[n] for n in ("m", "k3")}, scheme="fourier"
    )
    fit = bp.map_estimate(problem, progress=False)
    posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=12, max_steps=50, progress=False)
    assert fit.converged and str(run.check()) and str(fit)
    for name, factor in scale.items():
        if name in fit.theta:
            assert fit.theta[name] / factor == pytest.approx({"c": 0.2, "k": 1.0}[name], rel=0.1)
    for result in (
        bp.predict(problem, posterior, draws=20),
        bp.compare(problem, fit, posterior),
        bp.profile(problem, fit, ["k"]),
        bp.identifiability(problem, fit, posterior, profile=False),
    ):
        assert str(result)


@pytest.mark.parametrize(
    "prior",
    [
        bp.LogUniform(1e-300, 1e300), bp.LogNormal(1.0, 200.0), bp.Uniform(0.0, 1e308), bp.HalfNormal(1e150),
        bp.StudentT(0.0, 1e150, 3.0), bp.InverseGamma(1e-3, 1e-3), bp.Normal(0.0, 1e-150),
        bp.TruncatedNormal(0.2, 1e-9, -np.inf, np.inf),
    ],
    ids=repr,
)  # fmt: skip
def test_priors_are_silent_everywhere(prior):
    x = np.concatenate([10.0 ** np.arange(-300, 301, 50), [0.0, -1.0, 1.7e308, 5e-324]])
    for function in (prior.log_prob, prior.gradient, prior.curvature):
        function(x)
        for value in x:
            function(value)
    probability = np.array([0.0, 1e-12, 1e-9, 0.5, 1.0 - 1e-9, 1.0])
    quantiles = prior.quantile(probability)
    assert np.all(quantiles[1:] >= quantiles[:-1])


def test_median_of_a_log_uniform_over_all_numbers_is_the_geometric_mean():
    assert float(bp.LogUniform(1e-300, 1e300).quantile(0.5)) == pytest.approx(1.0, rel=1e-12)
    assert float(bp.LogUniform(1e-200, 1e280).quantile(0.75)) == pytest.approx(1e160, rel=1e-10)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("force", [bp.elements.cubic, bp.elements.jenkins], ids=["cubic", "jenkins"])
@pytest.mark.parametrize("factor", (1e-300, 1e150, 1e300))
def test_densities_and_solves_of_condensed_models_are_silent(force, factor):
    """Each parameter at an extreme value, and all of them."""
    problem, theta = condensed(force)
    noise = np.full(len(problem.noise_names), 1e-4)
    for name in [*theta, None]:
        there = {key: value * factor if name in (key, None) else value for key, value in theta.items()}
        values = [there[key] for key in problem.names]
        value, gradient = problem.value_and_gradient(values, noise)
        assert value == -np.inf or (np.isfinite(value) and np.isfinite(gradient).all())
        assert not np.isnan(problem.log_posterior(values, noise))
        (solution,) = problem.solve(there).values()
        known = solution.converged and np.isfinite(solution.multipliers).all()
        assert repr(solution) and (known or solution.stable is None)


@cache
def condensed(force):
    """Return the problem of three masses with an element between two of them, and its parameters."""
    stiffness, u = np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]]), np.cos(2 * np.pi * np.arange(32) / 32)
    constants = {"width": 0.1} if force is bp.elements.jenkins else {}
    model = bp.Model.from_matrices(
        "three", mass={"m": np.eye(3)}, damping={"a": np.eye(3), "b": stiffness}, stiffness={"k": stiffness},
        forces={"f": 2}, outputs={"x": (2, "displacement"), "y": (1, "acceleration")}, condensed=True,
        elements=[bp.elements.Element("e", force, (1, 0), constants)],
    )  # fmt: skip
    theta = dict.fromkeys(model.parameters, 1.0) | {"a": 0.1, "b": 0.01}
    clean = bp.solve_periodic(model, theta, {"f": u}, frequency=0.1, samples=32).outputs
    random = np.random.default_rng(0)
    noisy = {name: y + 0.01 * random.standard_normal(32) for name, y in clean.items()}
    priors = {name: bp.LogNormal(value, 2.0) for name, value in theta.items()}
    run = bp.Experiment("run", 0.1, noisy, {"f": u}, samples=32)
    return bp.Problem(model, [run], priors=priors), theta
