"""What makes two problems different, and results of another problem."""

import inspect
import operator
from dataclasses import fields, replace

import numpy as np
import pytest
import sympy as sp
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.problem.fingerprint import changed_parts, check_results, fingerprint
from tests.known import LINEAR, grid

TAU = grid(32)
SPRING = {
    "states": ["x"],
    "inputs": ["force"],
    "parameters": ["m", "c", "k"],
    "equations": lambda s, p, u: [p.m * s.ddx + p.c * s.dx + p.k * sp.sin(s.x) - u.force],
    "outputs": lambda s, p, u: {"y": s.x},
}
RUN = bp.Experiment(
    "run", 0.2, {"y": np.cos(2 * np.pi * TAU)}, {"force": np.sin(2 * np.pi * TAU)}, samples=32, scatter={"y": 0.1}
)
PRIORS = {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1.0, 0.5)}
DEFINITION = {"priors": PRIORS, "fixed": {"m": 1.0}}


def mark(model=None, run=None, **changes):
    model = bp.Model("spring", **(SPRING | (model or {})))
    return fingerprint(bp.Problem(model, [replace(RUN, **(run or {}))], **(DEFINITION | changes)))


MODELS = {
    "equations": lambda s, p, u: [p.m * s.ddx + p.c * s.dx + 1.0000001 * p.k * sp.sin(s.x) - u.force],
    "outputs": lambda s, p, u: {"y": s.x + s.dx},
    "angles": ["x"],
    "parameters": ["c", "m", "k"],
}
OUTPUT_ANGLE = {"angles": ["y"]}
# A change of every field of an experiment that is not derived from others.
RUNS = {
    "name": "walk", "frequency": 0.21, "outputs": {"y": 1.0000001 * np.cos(2 * np.pi * TAU)},
    "inputs": {"force": 2 * np.sin(2 * np.pi * TAU)}, "scatter": {"y": 0.2}, "cycles": 3, "independent": {"y": 9},
    "harmonics": {"y": 3}, "mask": TAU < 0.5, "guess": {"x": np.cos(2 * np.pi * TAU)},
}  # fmt: skip
PROBLEMS = {
    "priors": PRIORS | {"k": bp.LogNormal(1.0, 0.50001)},
    "fixed": {"m": 1.0000001},
    "noise": bp.noise.Independent(prior="flat"),
    "scheme": "central4",
}


@pytest.mark.parametrize("field", MODELS)
def test_every_field_of_the_model_changes_the_fingerprint(field):
    assert changed_parts(mark(), mark(model={field: MODELS[field]})) == ["model"]
    assert mark(model=OUTPUT_ANGLE) not in (mark(), mark(model={"angles": ["x"]}))


def test_names_and_units_that_the_density_does_not_contain_do_not():
    renamed = fingerprint(bp.Problem(bp.Model("other", **SPRING, units={"x": "m"}), [RUN], **DEFINITION))
    assert mark() == renamed == mark(scheme=bp.Problem(bp.Model("a", **SPRING), [RUN], **DEFINITION).scheme)


@pytest.mark.parametrize("field", RUNS)
def test_every_field_of_an_experiment_changes_the_fingerprint(field):
    # "independent" follows from the mask and the harmonics and must be computed again.
    changes = {field: RUNS[field]} | ({} if field == "independent" else {"independent": {}})
    assert changed_parts(mark(run={"independent": {}}), mark(run=changes))[0] == "experiments"


def test_an_experiment_read_from_a_file_is_the_same(tmp_path):
    RUN.save(tmp_path / "run.h5")
    assert {field.name for field in fields(RUN)} >= RUNS.keys()
    again = bp.load(tmp_path / "run.h5")
    assert fingerprint(bp.Problem(bp.Model("spring", **SPRING), [again], **DEFINITION)) == mark()


@pytest.mark.parametrize("field", PROBLEMS)
def test_every_argument_of_the_problem_changes_the_fingerprint(field):
    part = {"fixed": "constants"}.get(field, field)
    assert changed_parts(mark(), mark(**{field: PROBLEMS[field]})) == [part]


def test_ties_known_noise_and_local_parameters_change_the_fingerprint():
    tied = {"priors": {"k": PRIORS["k"]}, "tied": {"c": "0.2*k"}}
    assert changed_parts(mark(**tied), mark(**(tied | {"tied": {"c": "0.3*k"}}))) == ["constants"]
    assert changed_parts(mark(), mark(fixed={"m": 1.0, "variance[y]": 0.01})) == ["constants"]
    assert changed_parts(mark(), mark(local=["k"])) == ["priors"]


def test_models_that_differ_by_angles_only_have_other_densities():
    """The residual of an output is taken modulo 2π if it is an angle: half a turn more costs the same."""
    shifted = replace(RUN, outputs={"y": RUN.outputs["y"] + 2 * np.pi}, independent={})
    values = [
        bp.Problem(bp.Model("spring", **SPRING, angles=a), [shifted], **DEFINITION).log_likelihood([0.2, 1.0], [0.1])
        for a in ([], ["y"])
    ]
    assert values[1] - values[0] > 100.0


@pytest.fixture(scope="module")
def two():
    """Return the results of two problems with the same names and other data."""
    tau = grid(40)
    inputs = {"x": 0.05 * np.sin(2 * np.pi * tau)}
    found = []
    for scale in (1.0, 1.5):
        force = scale * (40.0 * np.sin(2 * np.pi * tau) + 25.0 * np.cos(2 * np.pi * tau))
        noise = np.random.default_rng(1).normal(size=40)
        run = bp.Experiment("run", 2.0, {"force": force + noise}, inputs, samples=40)
        priors = {"k": bp.LogNormal(800.0, 1.0), "c": bp.LogNormal(40.0, 1.0), "coulomb": bp.LogNormal(1.0, 1.0)}
        problem = bp.Problem(LINEAR, [run], priors=priors)
        fit = bp.map_estimate(problem, progress=False)
        settings = {"ensembles": 2, "walkers": 8, "max_steps": 250, "progress": False}
        found.append((problem, fit, bp.sample(problem, fit, seed=1, **settings)))
    return found


CALLS = {
    "identifiability": lambda p, own, f, d, path: bp.identifiability(p, f, profile=False),
    "identifiability with draws": lambda p, own, f, d, path: bp.identifiability(p, own, d, profile=False),
    "compare": lambda p, own, f, d, path: bp.compare(p, f, None),
    "compare draws": lambda p, own, f, d, path: bp.compare(p, own, d),
    "predict": lambda p, own, f, d, path: bp.predict(p, d, draws=20),
    "profile": lambda p, own, f, d, path: bp.profile(p, f),
    "report": lambda p, own, f, d, path: bp.report(p, f, None, path),
    "report draws": lambda p, own, f, d, path: bp.report(p, f, d, path),
    "plot.fit": lambda p, own, f, d, path: bp.plot.fit(p, f),
    "plot.loops": lambda p, own, f, d, path: bp.plot.loops(p, f),
}


@pytest.mark.parametrize("call", CALLS)
def test_results_of_other_data_are_refused_everywhere(two, call, tmp_path):
    (problem, own, _), (_, fit, posterior) = two
    with pytest.raises(ValueError, match=r"must be a result of this problem, got .* with other experiments; give"):
        CALLS[call](problem, own, fit, posterior, tmp_path / "report.html")


def test_draws_and_laplace_approximation_of_different_problems_are_not_drawn_together(two):
    (_, _, posterior), (_, fit, _) = two
    for plot in (bp.plot.corner, bp.plot.marginals):
        with pytest.raises(ValueError, match="laplace: must be a result of this problem"):
            plot(posterior, laplace=fit)


def test_confused_arguments_are_named(two):
    problem, fit, posterior = two[0]
    with pytest.raises(ValueError, match=r"estimate: must be a MapEstimate, got Posterior; give map_estimate"):
        bp.plot.fit(problem, posterior)
    with pytest.raises(ValueError, match=r"posterior: must be a Posterior, got MapEstimate; give sample\(problem, fit"):
        bp.predict(problem, fit)
    with pytest.raises(ValueError, match="problem: must be a Problem, got MapEstimate"):
        bp.compare(fit, problem, posterior)
    with pytest.raises(ValueError, match="fit: must be a MapEstimate, got Posterior"):
        bp.sample(problem, posterior, seed=1)
    check_results(problem, fit=fit, posterior=posterior)


FIRST = {
    "problem": ["calibrate", "compare", "identifiability", "map_estimate", "predict", "predict_branch", "profile",
                "prior_predictive", "sample"],
    "model": ["continue_periodic", "double_period", "emerging_cycle", "hopf_points",
              "multiplier_sensitivities", "polish_orbits", "simulate", "solutions_at", "solve_periodic", "structure"],
    "section": ["find_orbits", "plot.section"],
    "orbits": ["select_orbits", "plot.orbits"],
    "posterior": ["plot.corner", "plot.marginals", "plot.traces"],
    "branch": ["plot.branch"],
    "calibration": ["plot.ranks"],
    "comparison": ["plot.comparison"],
    "profile": ["plot.profile"],
}  # fmt: skip


@pytest.mark.parametrize(
    ("argument", "name"), [(argument, name) for argument, names in FIRST.items() for name in names]
)
@pytest.mark.parametrize("kind", ["experiment", "text", "none"])
def test_first_argument_of_another_class_is_named(argument, name, kind, two):
    problem, _, _ = two[0]
    given = {"experiment": problem.experiments[0], "text": "problem", "none": None}[kind]
    function = operator.attrgetter(name)(bp)
    wanted = inspect.signature(function).parameters.values()
    missing = [p for p in wanted if p.default is p.empty][1:]
    positional = [given for p in missing if p.kind is p.POSITIONAL_OR_KEYWORD]
    keywords = {p.name: 1 for p in missing if p.kind is p.KEYWORD_ONLY}
    with pytest.raises(ValueError, match=f"^{argument}: must be an? .*, got {type(given).__name__}"):
        function(given, *positional, **keywords)


@pytest.mark.parametrize("values", [1j * np.ones(4), np.ones(4, dtype=complex), ["a"] * 4, [{}] * 4])
def test_numbers_that_are_not_real_are_refused(values):
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must be an array of real numbers, got"):
        bp.Experiment("e", frequency=1.0, samples=4, outputs={"x": values})
    for value in (values[0], "1"):
        with pytest.raises(ValueError, match=r"frequency: must be a real number, got"):
            bp.Experiment("e", frequency=value, samples=4, outputs={"x": np.arange(4.0)})


def test_truths_are_marked_in_corner_plots(two):
    _, _, posterior = two[0]
    figure = bp.plot.corner(posterior, names=["k", "c"], truths={"k": 800.0})
    assert 800.0 in [x for line in figure.axes[0].lines for x in line.get_xdata()]
    with pytest.raises(ValueError, match="truths: must be one of .*got 'K'. Did you mean 'k'"):
        bp.plot.corner(posterior, truths={"K": 800.0})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scheme": "backward"}, "scheme: must be one of .*got 'backward'. Did you mean 'backward2'"),
        ({"priors": PRIORS | {"K": PRIORS["k"]}}, "priors: must be .*got 'K'. Did you mean 'k'"),
        ({"priors": PRIORS | {"c": (1.0, 0.5)}}, r"priors\['c'\]: must be .*Normal.*got \(1.0, 0.5\)"),
        ({"priors": PRIORS | {"c": bp.Normal(0.05, 1e-100)}}, r"priors\['c'\]: must be wider than .*fixed="),
        ({"priors": PRIORS | {"c": bp.Normal(0.05, 1e-18)}}, r"priors\['c'\]: must be wider than .*fixed="),
    ],
)
def test_first_tries_are_refused_at_the_problem(changes, message):
    with pytest.raises(ValueError, match=message):
        mark(**changes)


def test_equal_priors_of_scipy_in_a_noise_model_are_no_difference():
    """A frozen distribution prints its address, which differs from process to process."""
    one, other, wider = (
        mark(noise=bp.noise.Independent(prior=stats.invgamma(3.0, scale=scale))) for scale in (2.0, 2.0, 3.0)
    )
    assert one == other and changed_parts(one, wider) == ["noise"]
