"""A problem does not change after its construction; `replace` validates as the constructor does."""

import copy
import pickle
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.likelihood.input_noise import InputErrors
from tests.known import LINEAR, linear_experiment
from tests.problems import DUFFING, DUFFING_PRIORS, duffing, duffing_run

PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.4), "coulomb": bp.Uniform(0.0, 50.0)}
AT = {"k": 870.0, "c": 37.0, "coulomb": 22.0}, {"force": 7.0}


def linear_problem(**changes) -> bp.Problem:
    run = linear_experiment(np.array([900.0, 40.0, 25.0]), 3.0, seed=1)
    return bp.Problem(**({"model": LINEAR, "experiments": [run], "priors": PRIORS} | changes))


@pytest.fixture(scope="module")
def problem() -> bp.Problem:
    return linear_problem()


@pytest.mark.parametrize("name", ["experiments", "priors", "likelihood", "joint_prior", "anything"])
def test_attributes_cannot_be_assigned_or_deleted(problem, name):
    for change in (lambda: setattr(problem, name, None), lambda: delattr(problem, name)):
        with pytest.raises(AttributeError, match=rf"{name}: must not be assigned.* problem.replace\("):
            change()
    with pytest.raises(AttributeError, match=r"problem.replace\(experiments=…\)"):
        problem.anchored(AT[0]).experiments = ()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
def test_copies_have_the_same_density_and_are_immutable(problem, copied: Callable):
    for original in (problem, problem.anchored(AT[0])):
        other = copied(original)
        assert other.log_posterior(*AT) == original.log_posterior(*AT)
        with pytest.raises(AttributeError, match="must not be assigned"):
            other.noise = None


@pytest.mark.parametrize(
    "changes",
    [
        {"priors": {"stiffness": bp.Normal(800.0, 60.0)}},
        {"priors": PRIORS, "fixed": {"k": 900.0}},
        {"noise": "loud"},
        {"experiments": []},
        {"model": bp.models.duffing},
        {"tied": {"k": "2*c"}},
        {"local": "k"},
        {"scheme": "none"},
        {"input_noise": "some"},
    ],
)
def test_replace_raises_as_the_constructor_does(problem, changes):
    with pytest.raises(ValueError) as of_constructor:
        linear_problem(**changes)
    with pytest.raises(ValueError) as of_replace:
        problem.replace(**changes)
    assert str(of_replace.value) == str(of_constructor.value)


def test_replace_names_its_arguments(problem):
    with pytest.raises(ValueError, match=r"replace: must be one of .*, got 'prior'. Did you mean 'priors'\?"):
        problem.replace(prior=PRIORS)


@pytest.mark.parametrize(
    ("changes", "removed"),
    [
        ({"priors": PRIORS | {"k": bp.Normal(880.0, 9.0)}}, ()),
        ({"fixed": {"c": 37.0, "variance[force]": 7.0}, "priors": {n: PRIORS[n] for n in ("k", "coulomb")}}, ("c",)),
        ({"noise": bp.noise.Independent(prior="flat")}, ()),
        ({"experiments": [linear_experiment(np.array([850.0, 40.0, 20.0]), 3.0, seed=2)]}, ()),
        ({"tied": {"k": "20*c"}, "priors": {n: PRIORS[n] for n in ("c", "coulomb")}}, ("k",)),
    ],
)
def test_a_replaced_problem_is_the_one_built_anew(changes, removed):
    """Also of an anchored problem, whose anchors are not kept."""
    theta = {name: value for name, value in AT[0].items() if name not in removed}
    built, before = linear_problem(**changes), linear_problem()
    for problem in (before, before.anchored(AT[0])):
        replaced = problem.replace(**changes)
        assert replaced.names == built.names
        assert replaced.log_posterior(theta, AT[1]) == built.log_posterior(theta, AT[1])
    assert before.log_posterior(*AT) == linear_problem().log_posterior(*AT) != built.log_posterior(theta, AT[1])


def test_settings_build_the_problem_again(problem):
    assert bp.Problem(**problem.settings).log_posterior(*AT) == problem.log_posterior(*AT)
    problem.settings["priors"] = {}
    assert problem.settings["priors"] == PRIORS


@pytest.mark.parametrize("copied", [lambda e: e, copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_mappings_refuse_changes(problem, copied: Callable):
    other = copied(problem)
    run = other.experiments[0]
    made = run.outputs, run.independent, other.fixed, other.priors, other.settings["priors"]
    for mapping in (*made, other.observations, other.equations):
        for change in ("__setitem__", "x", 0.0), ("__delitem__", "x"), ("update", {"x": 0.0}), ("pop", "x"), ("clear",):
            with pytest.raises(TypeError, match="read-only"):
                getattr(mapping, change[0])(*change[1:])
    assert not run.outputs["force"].flags.writeable
    with pytest.raises(TypeError, match="read-only"):
        problem.replace(priors={n: PRIORS[n] for n in ("k", "c")}, fixed={"coulomb": 22.0}).fixed["coulomb"].clear()


def test_arrays_and_mappings_that_the_user_changes_do_not_change_the_problem():
    displacement = duffing_run()
    y, u = np.array(displacement.outputs["displacement"]), np.array(displacement.inputs["force"])
    variance, mask = {"force": np.full(5, 1e-6)}, np.ones(y.size, dtype=bool)
    given = bp.Experiment(
        "run", 0.1, {"displacement": y}, {"force": u}, samples=y.size, amplitude_variance=variance, cycles=9, mask=mask
    )
    priors = dict(DUFFING_PRIORS)
    problem = bp.Problem(bp.models.duffing, [given], priors=priors, fixed={"m": 1.0})
    at = {"c": 0.21, "k": 1.02, "k3": 0.48}, {"displacement": 1e-3}
    before = float(problem.log_posterior(*at))
    y *= 1000.0
    u *= 1000.0
    variance["force"] *= 1000.0
    mask[:5] = False
    priors["k"] = bp.Normal(7.0, 0.1)
    arrays = [given.outputs["displacement"], given.inputs["force"], given.amplitude_variance["force"], given.mask]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0
    assert float(problem.log_posterior(*at)) == before
    assert float(problem.replace().log_posterior(*at)) == before


def arrays_of(value):
    """Yield all arrays in the fields, mappings and sequences of an object."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, Mapping):
        yield from (array for item in value.values() for array in arrays_of(item))
    elif isinstance(value, list | tuple):
        yield from (array for item in value for array in arrays_of(item))
    elif is_dataclass(value):
        yield from (array for member in fields(value) for array in arrays_of(getattr(value, member.name)))


def table_of_amplitudes():
    rows = {"f": np.array([0.1, 0.12]), "x": np.array([0.6, 0.8]), "phase": np.array([-10.0, -20.0])}
    return bp.response_table(
        rows, outputs={"displacement": "x"}, inputs={"force": 0.5}, frequency="f", phases={"displacement": "phase"}
    )


@pytest.mark.parametrize(
    ("made", "least"),
    [(lambda: [duffing_run()], 2), (lambda: [folded_run()], 9), (table_of_amplitudes, 2)],
    ids=["arrays", "folded", "table"],
)
def test_every_array_of_an_experiment_is_read_only(made, least):
    arrays = list(arrays_of(made()))
    assert len(arrays) >= least and not any(array.flags.writeable for array in arrays if array.size)


def folded_run():
    force = {"force": 0.5 * np.cos(2 * np.pi * np.arange(32) / 32)}
    run = bp.simulate(
        bp.models.duffing, DUFFING, force, frequency=0.1, duration=200, sampling_rate=8, noise={"displacement": 0.01},
        seed=1,
    )  # fmt: skip
    return run.between(100, 200).fold(32, frequency=0.1, harmonics=5)


@pytest.mark.parametrize("condensed", [False, True])
def test_matrices_and_weights_that_the_user_changes_do_not_change_the_model(condensed):
    stiffness, weights = np.array([[2.0, -1.0], [-1.0, 1.0]]), np.array([0.6, 0.8])
    mass, damping, wave = np.eye(2), 0.1 * np.eye(2), {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    model = bp.Model.from_matrices(
        "two", mass={"m": mass}, damping=damping, stiffness={"k": stiffness}, forces={"force": weights},
        outputs={"x": (weights, "displacement")}, condensed=condensed,
        elements=[bp.elements.Element("stop", bp.elements.cubic, weights)],
    )  # fmt: skip

    def response():
        theta = {"m": 1.0, "k": 1.1, "stop_k3": 0.2}
        return bp.solve_periodic(model, theta, wave, frequency=0.1, samples=32).outputs["x"]

    before = response()
    for array in (mass, damping, stiffness, weights):
        array *= 3.0
    assert np.array_equal(response(), before)


def test_anchors_and_errors_of_inputs_leave_the_problem_as_it_is():
    run = duffing_run(harmonics={"displacement": 7, "force": 1})
    problem = duffing(run, input_noise={"force": 0.05})
    at = {"c": 0.21, "k": 1.02, "k3": 0.48}, {"displacement": 1e-3}
    before = float(problem.log_posterior(*at))
    random = np.random.default_rng(1)
    size = problem.observations[run.name].blocks[0].size
    errors = InputErrors(np.zeros(3), 0.05 * random.standard_normal((size, 3)), 0.01 * random.standard_normal(size))
    noisy = problem.with_input_errors({run.name: errors})
    with pytest.raises(ValueError, match="input_errors: must be 'run 1', got 'run 7'"):
        problem.with_input_errors({"run 7": errors})
    with pytest.raises(ValueError, match=r"input_errors\['run 1'\]: must be 3 errors and"):
        problem.replace(input_errors={run.name: InputErrors(np.zeros(2), np.zeros((size, 2)), np.zeros(size))})
    assert abs(float(noisy.log_posterior(*at)) - before) > 1.0
    assert noisy.replace(**noisy.settings).log_posterior(*at) == noisy.log_posterior(*at)
    assert noisy.anchored(at[0]).input_errors[run.name] is errors
    assert noisy.with_input_errors({}).input_errors == noisy.replace().input_errors == {}
    assert float(problem.log_posterior(*at)) == float(noisy.replace().log_posterior(*at)) == before


def test_a_planned_experiment_has_the_likelihood_of_its_own_problem():
    runs = duffing_run(), duffing_run("run 2", 0.13, seed=2)
    noise = bp.noise.Independent(per="experiment")
    joint = bp.MultivariateNormal([1.0, 0.5], [[0.04, 0.01], [0.01, 0.02]])
    priors = {"c": bp.LogNormal(0.2, 0.3), ("k", "k3"): joint}
    problem = duffing(*runs, priors=priors, local=["c"], noise=noise)
    planned = problem.planned(runs[1], dict.fromkeys(problem.noise_names, 1e-3))
    alone = duffing(runs[1], priors={"c": priors["c"], "k": bp.Normal(1.0, 0.2), "k3": bp.Normal(0.5, 0.2)})
    assert planned.names == ("c[run 2]", "k", "k3") and planned.free_noise == ()
    theta = np.array([0.19, 1.02, 0.48])
    expected = alone.log_likelihood(theta, {"displacement": 1e-3})
    assert float(planned.log_likelihood(theta, {})) == pytest.approx(float(expected), rel=1e-12)
