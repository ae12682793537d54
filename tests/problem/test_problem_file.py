"""Problem files: the same problem bit for bit, and the line of whatever is refused."""

import hashlib
import inspect
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import scipy.stats
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.likelihood.noise import NAMED
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.priors.joint import FromScipy
from bayesperiodic.priors.single import Univariate
from bayesperiodic.problem import problem_text
from tests.density import test_special_points as special_points
from tests.layout import ROOT
from tests.problems import CASES, DUFFING_PRIORS, duffing, duffing_run

SPRING = {
    "states": ["x"], "inputs": ["force"], "parameters": {"m": "kg", "c": "N s/m", "k": "N/m", "k3": "N/m^3"},
    "units": {"x": "m", "force": "N", "displacement": "m"}, "description": 'A "spring"\\\n\tof steel\x7f.',
}  # fmt: skip
# Constants whose texts SymPy changes: roots of numbers, fractions with large denominators, functions of numbers.
TEXTS = {
    "equations": ["m*ddx + c*dx*sqrt(2*c)/sqrt(2*c) + k*x + 0.1*2*k3*sin(1)/sin(1)*5*x**3 - 1*force - 0.001*1.38*2*m"],
    "outputs": {"displacement": "x*(1/3)*3 + 1e-17*abs(dx)*sin(x/x)"},
}
FUNCTIONS = {
    "equations": lambda s, p, u: [p.m * s.ddx + p.c * s.dx + p.k * s.x + p.k3 * s.x**3 / 3 - u.force - 0.123456789 * 0],
    "outputs": lambda s, p, u: {"displacement": s.x - 0.12345678901234567 * s.dx * abs(s.dx)},
}


def noisy_run(**changes):
    """Return a response with two channels whose amplitudes have measured variances."""
    variance = {"force": np.full(3, 1e-5), "displacement": np.full(8, 2e-5)}
    kept = {"force": 2, "displacement": 7}
    return duffing_run(
        harmonics=kept, amplitude_variance=variance, cycles=9, scatter={"force": 0.01, "displacement": 0.02}, **changes
    )


def table():
    """Return the rows of a sweep up."""
    omega = 2 * np.pi * (f := np.array([0.05, 0.08, 0.11]))
    c = 0.5 / (1.0 - omega**2 + 0.2j * omega)
    return bp.response_table(
        {"f": f, "A": abs(c), "phi": np.degrees(np.angle(c))}, frequency="f", outputs={"displacement": "A"},
        phases={"displacement": "phi"}, inputs={"force": 0.5}, sd={"displacement": "0.5%"}, sweep="up",
    )  # fmt: skip


def own_model(**given):
    return bp.Model("spring", **SPRING, **given)


def with_model(model):
    return bp.Problem(model, [duffing_run()], priors=DUFFING_PRIORS, fixed={"m": 1.0})


CENTRAL = {"first": {-1: -0.5, 1: 0.5}, "second": {-1: 1.0, 0: -2.0, 1: 1.0}}
MATRICES = {
    "mass": np.diag([1.0, 0.3]), "stiffness": {"k": [[2.0, -1.0], [-1.0, 1.0 / 3.0]]}, "damping": 0.1 * np.eye(2),
    "forces": {"force": 0}, "outputs": {"displacement": (1, "displacement")},
}  # fmt: skip
SENSORS = {
    "displacement": bp.Sensor(gain=bp.LogNormal(1.0, 0.02), offset=0.01, cutoff=5.0, order=3),
    "force": bp.Sensor(delay=0.003),
}
JOINT = bp.MultivariateNormal([1.0, 0.5], [[0.01, 1e-3], [1e-3, 0.04]])
# What a problem may consist of, beside the cases of `tests.problems`.
MORE = {
    "own equations": lambda: with_model(own_model(**TEXTS)),
    "own angles": lambda: with_model(own_model(**TEXTS, angles=["x", "displacement"])),
    "own functions": lambda: with_model(own_model(**FUNCTIONS)),
    "numbers that are no fractions": lambda: with_output(
        lambda s: s.x - 0.5 * s.dx + 1e-3 * bp.smooth_sign(s.dx, 0.02) * abs(s.x) ** 1.5 / (0.1 + s.x**2)
    ),
    "matrices": lambda: with_matrices(),
    "table": lambda: duffing(*table()),
    "errors of inputs": lambda: duffing(noisy_run(), noise="measured"),
    "errors of inputs as parameters": lambda: duffing(noisy_run(), input_noise="joint"),
    "given errors of inputs": lambda: duffing(noisy_run(), input_noise={"force": np.float64(0.01)}),
    "no errors of inputs": lambda: duffing(noisy_run(), input_noise={}),
    "covariance of errors": lambda: duffing(noisy_run(), input_noise={"force": 1e-4 * np.eye(5)}),
    "sensors": lambda: duffing(duffing_run(), sensors=SENSORS),
    "joint prior": lambda: duffing(
        duffing_run(), priors={"c": bp.LogNormal(0.2, 0.3), ("k", "k3"): JOINT}, scheme="central4"
    ),
    "priors of SciPy": lambda: duffing(
        duffing_run(), priors={"c": scipy.stats.gamma(2, scale=0.1), "k": scipy.stats.norm(1.0, 0.3)},
        fixed={"m": 1, "k3": 0.5}, noise=bp.noise.Independent(prior=scipy.stats.invgamma(3.0)),
    ),
    "scheme as an object": lambda: duffing(duffing_run(), scheme=bp.Scheme("central2", 2, **CENTRAL)),
    "values by experiment": lambda: duffing(
        duffing_run('run "1" = β'), duffing_run("run 2", 0.13), local=["m"],
        fixed={"m": {'run "1" = β': 1.0, "run 2": 1.1}, "variance[displacement]": 1e-4},
    ),
    "jumps and resonances": lambda: special_points.problem_of(special_points.places(**special_points.TRUTH)),
    "orbit with a mask": lambda: CASES["section and multiplier"]()[0],
}  # fmt: skip
PROBLEMS = MORE | {name: lambda case=case: case()[0] for name, case in CASES.items()}


def written_and_read(problem, folder):
    problem.to_toml(folder / "problem.toml")
    return bp.Problem.from_toml(folder / "problem.toml")


@pytest.mark.parametrize("name", PROBLEMS)
def test_problem_and_its_density_come_back_bit_for_bit(name, tmp_path):
    problem = PROBLEMS[name]()
    again = written_and_read(problem, tmp_path)
    assert again.model.definition == problem.model.definition and again.model.units == problem.model.units
    assert (again.names, again.noise_names) == (problem.names, problem.noise_names)
    assert find_scheme(again.scheme) == find_scheme(problem.scheme)
    assert repr(again) == repr(problem) and again.priors == problem.priors and again.tied == problem.tied
    assert (again.fixed, again.local, again.noise) == (problem.fixed, problem.local, problem.noise)
    theta = problem.sample_prior(5, seed=1)
    variances = np.full((5, len(problem.noise_names)), 0.02)
    every = np.column_stack([theta[name] for name in problem.names]), variances
    density = problem.log_posterior(*every)
    assert np.array_equal(density, again.log_posterior(*every)) and np.isfinite(density).any()


def test_a_file_can_be_written_again_and_its_texts_are_those_of_the_user(tmp_path):
    problem = written_and_read(with_model(own_model(**TEXTS)), tmp_path)
    first = (tmp_path / "problem.toml").read_text("utf-8")
    assert TEXTS["equations"][0] in first and TEXTS["outputs"]["displacement"] in first
    assert problem.model.__doc__ == SPRING["description"]
    problem.to_toml(tmp_path / "problem.toml")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["problem.experiment1.h5", "problem.toml"]
    assert (tmp_path / "problem.toml").read_text("utf-8") == first


def subclasses(kind):
    return {one for each in kind.__subclasses__() for one in {each, *subclasses(each)}}


PRIORS = {
    "Normal": (0.3, 1.0 / 3.0), "LogNormal": (0.1, 0.7), "TruncatedNormal": (0.1, 0.3, -np.inf, 1e300),
    "HalfNormal": (1e-5,), "Uniform": (1e-3, 1e16), "LogUniform": (1e-3, 0.1 + 0.2), "StudentT": (0.0, 2.0, 3.0),
    "InverseGamma": (3.0, 1e-7),
}  # fmt: skip


def test_every_prior_of_the_package_is_tested():
    kinds = {one.__name__ for one in subclasses(Univariate) - {FromScipy} if one.__module__.startswith("bayesperiodic")}
    assert {name for name in kinds if not name.startswith("_")} == PRIORS.keys()


@pytest.mark.parametrize("kind", PRIORS)
def test_every_prior_comes_back(kind, tmp_path):
    prior = getattr(bp, kind)(*PRIORS[kind])
    sensors = {"displacement": bp.Sensor(offset=prior)}
    assert written_and_read(duffing(duffing_run(), sensors=sensors), tmp_path).priors["offset[displacement]"] == prior


@pytest.mark.parametrize("name", NAMED)
def test_every_noise_model_comes_back(name, tmp_path):
    given = {"kernel": "exponential"} if name == "circulant" else {}
    noise = NAMED[name](per="experiment", prior=bp.InverseGamma(3.0, 2.0), **given)
    run = duffing_run(scatter={"displacement": 0.2}, cycles=9)
    assert written_and_read(duffing(run, noise=noise), tmp_path).noise == noise


ARGUMENTS = {"chain": [{"masses": 1}, {"masses": 3}], "landing_gear": [{"drive": "force"}, {"drive": "displacement"}]}


@pytest.mark.parametrize("name", [name for name in dir(bp.models) if not inspect.ismodule(getattr(bp.models, name))])
def test_every_model_of_the_library_is_called_by_its_name(name, tmp_path):
    entry, generator = getattr(bp.models, name), np.random.default_rng(1)
    for arguments in ARGUMENTS.get(name, [{}]):
        model = entry if isinstance(entry, Model) else entry(**arguments)
        channels = {c: generator.standard_normal(64) for c in (*model.outputs, *model.inputs)}
        run = bp.Experiment(
            "run", 1.0, {c: channels[c] for c in model.outputs}, {c: channels[c] for c in model.inputs}, samples=64,
            frequency_se=0.01,
        )  # fmt: skip
        free, *others = model.parameters
        problem = bp.Problem(model, [run], priors={free: bp.Normal(1, 0.1)}, fixed=dict.fromkeys(others, 1.0))
        again = written_and_read(problem, tmp_path)
        assert f'library = "{name}"' in (tmp_path / "problem.toml").read_text("utf-8")
        assert again.model.definition == model.definition and again.model is model


def with_output(output):
    return with_model(own_model(**FUNCTIONS | {"outputs": lambda s, p, u: {"displacement": output(s)}}))


def with_matrices(**changes):
    model = bp.Model.from_matrices("frame", **MATRICES, **changes)
    return bp.Problem(model, [duffing_run()], priors={"k": bp.LogNormal(1, 0.1)})


def with_prior(prior):
    return duffing(duffing_run(), priors=DUFFING_PRIORS | {"k": prior})


NO_TEXT = {
    "a number that its text changes": (
        lambda: with_output(lambda s: sp.pi * s.x / 3),
        r"outputs: must be texts, or .* got one of the text 'pi\*x/3', whose numbers differ",
    ),
    "a function without a text": (
        lambda: with_output(lambda s: sp.sign(s.x)),
        "outputs: must be texts, .* which is refused: outputs: functions in .* must be one of",
    ),
    "a condensed model": (lambda: with_matrices(condensed=True), "must have equations in a problem file, got 'frame'"),
    "a scheme": (
        lambda: duffing(duffing_run(), scheme=bp.Scheme("mine", 2, **CENTRAL)),
        "scheme: must be one of",
    ),
    "a noise model": (
        lambda: duffing(duffing_run(), noise=OwnNoise()),
        "noise: must be one of 'independent', .*, got a OwnNoise",
    ),
    "a prior": (lambda: with_prior(OwnPrior(0.0, 2.0)), r"priors\['k'\]: must be a prior of"),
    "a distribution": (lambda: with_prior(OwnScipy()(loc=1.0)), r"priors\['k'\]: must be a prior of"),
    "anchors": (lambda: duffing(duffing_run()).anchored([0.2, 1.0, 0.5]), "must be without anchors in a problem file"),
}


@pytest.mark.parametrize("name", NO_TEXT)
def test_what_texts_do_not_describe_is_refused_and_nothing_is_written(name, tmp_path):
    make, message = NO_TEXT[name]
    with pytest.raises(ValueError, match=message):
        make().to_toml(tmp_path / "problem.toml")
    assert not [*tmp_path.iterdir()]


class OwnNoise(bp.noise.Independent):
    """A noise model of a user with the name of another one."""


class OwnPrior(bp.Uniform):
    """A prior of a user."""


class OwnScipy(scipy.stats.rv_continuous):
    """A distribution of a user."""

    def _pdf(self, x):
        return np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)


@pytest.mark.parametrize(
    ("text", "message"),
    [("independent", "got another noise"), ("own", r"got one that is refused: noise: must be one of .*, got 'own'")],
)
def test_what_has_been_written_is_read_and_compared(text, message, monkeypatch, tmp_path):
    """Here the entry of a table is lost, as that of a later version may be forgotten."""
    monkeypatch.setattr(problem_text, "_noise", lambda noise: text)
    with pytest.raises(ValueError, match=f"^problem: must be a problem that texts describe, {message}"):
        duffing(duffing_run(), noise=bp.noise.Independent(per="experiment")).to_toml(tmp_path / "problem.toml")
    assert not [*tmp_path.iterdir()]


def test_errors_of_inputs_of_an_estimate_are_refused(tmp_path):
    problem = duffing(noisy_run())
    fit = bp.map_estimate(problem, checks=False, progress=False)
    with pytest.raises(ValueError, match="without input_errors .* write problem.replace()"):
        problem.with_input_errors(fit.input_errors).to_toml(tmp_path / "problem.toml")


# A file that somebody has written, one statement a line.
WRITTEN = """
noise = {kind = "circulant", kernel = "exponential"}
scheme = "central4"
input_noise = "exact"
local = ["c"]

[model]
name = "spring"  # a comment
states = ["x"]
inputs = ["force"]
parameters = ["m", "c", "k", "k3"]
equations = [
    "m*ddx + c*dx + k*x + k3*x**3 - force",
]
outputs = {displacement = "x"}
angles = []

[[experiments]]
recording = "run.csv"
time = "t"
sha256 = "DIGEST"
inputs = {force = "F"}
outputs = {displacement = "x_mm"}
units = {displacement = ["mm", "m"]}
between = [1.0, 40.0]
fold = {samples = 32, harmonics = {displacement = 5}}

[[experiments]]
table = "table.csv"
frequency = "f"
outputs = {displacement = {1 = "A"}}
phases = {displacement = {1 = "phi"}}
inputs = {force = 0.5}
samples = 32

[priors]
c = {kind = "LogNormal", median = 0.2, spread = 0.3}
k = {kind = "scipy.stats.norm", args = [1.0], scale = 0.1}

[fixed]
m = 1

[tied]
k3 = "0.5*k"

[sensors.displacement]
gain = {kind = "LogNormal", median = 1.0, spread = 0.02}
offset = 0.0

[map_estimate]
starts = 1

[sample]
seed = 1
"""


MODEL = WRITTEN[WRITTEN.index("name =") : WRITTEN.index("[[exp")]
TABLE = WRITTEN[WRITTEN.index("[[experiments]]\ntable") : WRITTEN.index("[priors]")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a problem file and its data."""
    place = tmp_path_factory.mktemp("written")
    t = np.arange(0, 50, 0.05)
    x = 0.5 * np.cos(2 * np.pi * 0.2 * t - 0.3) + 1e-3 * np.random.default_rng(1).standard_normal(t.size)
    pd.DataFrame({"t": t, "x_mm": 1e3 * x, "F": np.cos(2 * np.pi * 0.2 * t)}).to_csv(place / "run.csv", index=False)
    pd.DataFrame({"f": [0.05, 0.1], "A": [0.55, 0.8], "phi": [-5.0, -11.0]}).to_csv(place / "table.csv", index=False)
    digest = hashlib.sha256((place / "run.csv").read_bytes()).hexdigest()
    (place / "problem.toml").write_text(WRITTEN.replace("DIGEST", digest), encoding="utf-8")
    return place


def test_a_written_file_gives_the_objects_of_python(folder):
    problem = bp.Problem.from_toml(folder / "problem.toml")
    model = bp.Model(
        "spring", states=["x"], inputs=["force"], parameters=["m", "c", "k", "k3"],
        equations=["m*ddx + c*dx + k*x + k3*x**3 - force"], outputs={"displacement": "x"},
    )  # fmt: skip
    recording = bp.Recording.from_file(
        folder / "run.csv", time="t", inputs={"force": "F"}, outputs={"displacement": "x_mm"},
        units={"displacement": ("mm", "m")},
    )  # fmt: skip
    runs = bp.response_table(
        folder / "table.csv", frequency="f", outputs={"displacement": {1: "A"}}, phases={"displacement": {1: "phi"}},
        inputs={"force": 0.5}, samples=32,
    )  # fmt: skip
    expected = bp.Problem(
        model, [recording.between(1.0, 40.0).fold(32, harmonics={"displacement": 5}), *runs],
        priors={"c": bp.LogNormal(0.2, 0.3), "k": scipy.stats.norm(1.0, scale=0.1)}, fixed={"m": 1},
        tied={"k3": "0.5*k"}, local=["c"], noise=bp.noise.Circulant(kernel="exponential"),
        scheme="central4", input_noise="exact", sensors={"displacement": bp.Sensor(gain=bp.LogNormal(1.0, 0.02))},
    )  # fmt: skip
    at = expected.median(), np.full(len(expected.noise_names), 0.1)
    assert repr(problem) == repr(expected) and np.isfinite(expected.log_posterior(*at))
    assert problem.log_posterior(*at) == expected.log_posterior(*at)


def test_a_file_of_an_editor_of_windows_is_read(folder):
    """It begins with a mark of the encoding, and its lines end with two characters."""
    path = folder / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + (folder / "problem.toml").read_bytes().replace(b"\n", b"\r\n"))
    assert repr(bp.Problem.from_toml(path)) == repr(bp.Problem.from_toml(folder / "problem.toml"))
    path.write_bytes(path.read_bytes().replace(b"median = 0.2", b"median = -0.2"))
    line = line_of(WRITTEN, "median = 0.2")
    with pytest.raises(ValueError, match=f"windows.toml:{line}: median"):
        bp.Problem.from_toml(path)


def line_of(text, part):
    """Return the number of the line in which a part of a text begins, from 1."""
    return text[: text.index(part)].count("\n") + 1


def changed(folder, old, new):
    """Return the path of the file with a text changed, which is there once."""
    text = (folder / "problem.toml").read_text("utf-8")
    assert text.count(old) == 1
    path = folder / "changed.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


REFUSED = {
    "no TOML": ("states = [", "states = = [", "states", "Invalid value"),
    "a key twice": ("[fixed]", "[fixed]\nm = 2", "m = 1", "Cannot overwrite"),
    "an unknown key": ("local =", "locl =", "locl", "problem file: must be one of .* Did you mean 'local'"),
    "an unknown argument": ("states =", "state =", "state =", r"model: must be one of .* Did you mean 'states'"),
    "no argument that is needed": ("inputs = {force = 0.5}\n", "", "[[experiments]]\ntable", "must have 'inputs'"),
    "an unknown library model": (MODEL, 'library = "dufing"\n\n', "dufing", "Did you mean"),
    "a module for a model": (MODEL, 'library = "elements"\n\n', "elements", "must be one of"),
    "arguments of a library model": ('name = "spring"', 'library = "duffing"', "states", "model: must be 'library'"),
    "code for an equation": (
        "k3*x**3",
        "x.__class__",
        "equations",
        r"equations: must consist of .* an attribute \(a dot\)",
    ),
    "a call in an equation": ("k3*x**3", "open(x)", "equations", "Did you mean|must be one of"),
    "an unknown name in an equation": ("k3*x**3", "k3*y**3", "equations", "equations: names .* must be one of"),
    "code for a tied parameter": ('0.5*k"', '().__class__"', "k3 = ", r"tied\['k3'\]: must consist of"),
    "an unknown prior": (
        '"LogNormal", median = 0.2',
        '"LogNorml", median = 0.2',
        "median = 0.2",
        "Did you mean 'LogNormal'",
    ),
    "no prior": (
        'c = {kind = "LogNormal", median = 0.2, spread = 0.3}',
        "c = 0.2",
        "c = 0.2",
        r"priors\['c'\]: must be a table, got 0.2",
    ),
    "a wrong number in a prior": ("median = 0.2", "median = -0.2", "median = -0.2", "median: must be > 0, got -0.2"),
    "an argument that a prior lacks": ("median = 0.2, ", "", "c = {", r"priors\['c'\]: must have 'median'"),
    "a prior of no parameter": ("k = {kind", "q = {kind", "q = {", "priors: must be one of"),
    "a discrete distribution": (
        "scipy.stats.norm",
        "scipy.stats.poisson",
        "k = {",
        "must be a continuous distribution",
    ),
    "a module of SciPy": ("scipy.stats.norm", "scipy.stats.__loader__", "k = {", "must be a continuous distribution"),
    "a function of SciPy": (
        "scipy.stats.norm",
        "scipy.stats.rv_continuous",
        "k = {",
        "must be a continuous distribution",
    ),
    "an argument SciPy lacks": ("scale = 0.1", "sigma = 0.1", "sigma", "sigma"),
    "an unknown noise model": ('"circulant"', '"circular"', "noise", "Did you mean 'circulant'"),
    "an unknown kernel": ('"exponential"', '"gauss"', "noise", "kernel: must be one of"),
    "an unknown scheme": ('"central4"', '"central5"', "scheme", "Did you mean 'central4'"),
    "an unknown local parameter": ('local = ["c"]', 'local = ["q"]', "local", "local: must be one of"),
    "a free and fixed parameter": ("m = 1\n", "m = 1\nk = 2\n", "[fixed]", "fixed: 'k' has a prior too"),
    "a fixed text": ("m = 1\n", 'm = "1"\n', 'm = "1"', r"fixed\['m'\]: must be a real number"),
    "an unknown entry of a sensor": ("offset =", "ofset =", "ofset", "Did you mean 'offset'"),
    "a sensor of nothing": ("[sensors.displacement]", "[sensors.q]", "[sensors.q]", "sensors"),
    "no data file": ('"run.csv"', '"none.csv"', "none.csv", "recording: must be an existing file"),
    "a number for a file": ('"table.csv"', "1", "table = 1", "table: must be a text"),
    "two data files": (
        'recording = "run.csv"',
        'recording = "run.csv"\nsaved = "x.h5"',
        "[[experiments]]\nrec",
        "must have one of 'saved', 'recording' and 'table'",
    ),
    "another digest": ('sha256 = "', 'sha256 = "0', "sha256", "sha256: must be that of"),
    "a path beside the data file": (
        'time = "t"',
        'time = "t"\npath = "other.csv"',
        "path",
        "must be one of .* got 'path'",
    ),
    "an unknown column": ('"x_mm"', '"y_mm"', "y_mm", "got 'y_mm'"),
    "an unknown unit": ('["mm", "m"]', '["mn", "m"]', "mn", "mn"),
    "too much cut off": ("[1.0, 40.0]", "[60.0, 70.0]", "between", "must select at least two samples"),
    "one limit": ("[1.0, 40.0]", "[60.0]", "between", r"between: must be \[start, stop\]"),
    "a wrong argument of fold": ("samples = 32, h", "samples = 2, h", "fold", "samples: must be an integer >= 4"),
    "an unknown argument of fold": ("samples = 32, h", "sample = 32, h", "fold", "Did you mean 'samples'"),
    "a file that is no result": (
        'recording = "run.csv"',
        'saved = "run.csv"',
        "time =",
        r"experiments\[0\]: must be one of 'saved', 'sha256'",
    ),
    "an unknown column of a table": ('1 = "A"', '1 = "B"', "B", "'B'"),
    "a wrong argument of a table": (
        'frequency = "f"',
        'frequency = "f"\nsweep = "left"',
        "left",
        "sweep: must be 'up'",
    ),
    "the same name twice": (TABLE, f"{TABLE}\n{TABLE}", "[[experiments]]", "experiments: names must differ"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_the_line_of_whatever_is_refused_is_named(name, folder):
    old, new, marker, message = REFUSED[name]
    path = changed(folder, old, new)
    line = line_of(path.read_text("utf-8"), marker)
    with pytest.raises(ValueError, match=message) as caught:
        bp.Problem.from_toml(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


@pytest.mark.parametrize("value", ["3", "{a = 1}"])
def test_values_of_wrong_types_are_refused_with_a_line(value, folder):
    """Every value in the file is replaced in turn; what is accepted has a meaning in Python too."""
    text = (folder / "problem.toml").read_text("utf-8")
    accepted = []
    path = folder / "changed.toml"
    for place in re.finditer(r"^(\w+) = (.+?)(?=  #|$)", text.partition("[map_estimate]")[0], re.MULTILINE):
        if place[2] == "[":
            continue
        path.write_text(f"{text[: place.start(2)]}{value}{text[place.end(2) :]}", encoding="utf-8")
        try:
            bp.Problem.from_toml(path)
            accepted.append(place[1])
        except ValueError as error:
            assert re.match(rf"{re.escape(str(path))}:\d+: .+ must ", str(error))
    assert accepted == (["m", "gain", "offset"] if value == "3" else [])


def test_a_file_that_is_no_text_or_is_missing_is_refused(tmp_path):
    path = tmp_path / "problem.toml"
    with pytest.raises(FileNotFoundError):
        bp.Problem.from_toml(path)
    path.write_bytes(b"\xff\xfe[\x00")
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}: must be TOML in UTF-8"):
        bp.Problem.from_toml(path)
    path.write_text("noise = 'measured'")
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}: model: must be given"):
        bp.Problem.from_toml(path)


def test_a_saved_file_that_has_changed_or_is_no_experiment_is_refused(tmp_path):
    problem, path = duffing(duffing_run()), tmp_path / "problem.toml"
    problem.to_toml(path)
    line = path.read_text("utf-8").split("\n").index('saved = "problem.experiment1.h5"') + 1
    replace(duffing_run(), frequency=0.11).save(tmp_path / "problem.experiment1.h5")
    with pytest.raises(ValueError, match=f":{line + 1}: sha256: must be that of .*problem.experiment1.h5"):
        bp.Problem.from_toml(path)
    path.write_text(re.sub("sha256.*", "", path.read_text("utf-8")), encoding="utf-8")
    assert bp.Problem.from_toml(path).experiments[0].frequency == 0.11
    bp.Recording.from_arrays(*recorded()).check().save(tmp_path / "problem.experiment1.h5")
    with pytest.raises(ValueError, match=f":{line}: saved: must be a Experiment, got RecordingCheck"):
        bp.Problem.from_toml(path)


def recorded():
    t = np.arange(0, 50, 0.05)
    return t, {"x": np.cos(2 * np.pi * 0.2 * t)}


def test_files_are_replaced_by_a_problem_with_other_data(tmp_path):
    path = tmp_path / "problem.toml"
    duffing(duffing_run(), duffing_run("run 2", 0.13)).to_toml(path)
    again = written_and_read(duffing(duffing_run(frequency=0.12)), tmp_path)
    assert [e.frequency for e in again.experiments] == [0.12]


def test_the_file_in_the_documentation_is_a_problem(folder, tmp_path):
    page = (ROOT / "docs" / "how_to" / "problem_file.md").read_text("utf-8")
    (text,) = re.findall(r"^```toml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    t = np.arange(0, 300, 0.05)
    columns = {"t": t, "F": np.cos(2 * np.pi * 0.2 * t), "x_mm": 500 * np.cos(2 * np.pi * 0.2 * t - 0.3)}
    noise = np.random.default_rng(1).standard_normal((2, t.size))
    columns = columns | {"F": columns["F"] + 0.01 * noise[0], "x_mm": columns["x_mm"] + 5.0 * noise[1]}
    pd.DataFrame(columns).to_csv(tmp_path / "run1.csv", index=False)
    path = tmp_path / "spring.toml"
    path.write_text(text, encoding="utf-8")
    assert bp.Problem.from_toml(path).names == ("c", "k", "k3")
    path.write_text(text.replace("median = 0.2", "median = -0.2"), encoding="utf-8")
    with pytest.raises(ValueError) as caught:
        bp.Problem.from_toml(path)
    assert f"error: {str(caught.value).removeprefix(f'{tmp_path}/')}" in page
