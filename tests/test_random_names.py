"""Names of any script are kept apart from the model to the saved file, or refused."""

import keyword
import unicodedata

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import bayesperiodic as bp
from bayesperiodic._checks import MOST_LETTERS
from bayesperiodic.models.names import RESERVED
from tests.known import formula_model, grid

identifiers = st.one_of(
    st.from_regex(r"[^\W\d_]\w{0,11}", fullmatch=True),
    st.from_regex(r"[^\W\d_]\w{0,5}", fullmatch=True, alphabet=st.characters(min_codepoint=0xA0)),
    st.sampled_from([*keyword.kwlist, "E", "I", "S", "pi", "exp", "K", "\u212a", "µ", "μ", "k", "\uff4b", "ﬁ", "fi"]),
).filter(str.isidentifier)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=12)


def normal(name):
    return unicodedata.normalize("NFKC", name)


def model(names):
    """Return the model w' + w = x, y = Σ p_i x^i."""
    return formula_model(
        "named", names, lambda p, u, s: {"y": sum(p[name] * u.x**i for i, name in enumerate(names, 1))}
    )


@given(st.lists(identifiers, min_size=1, max_size=4))
def test_names_equal_to_python_are_refused_and_all_others_kept_apart(names):
    proper = all(normal(name) == name and not name.startswith("_") and name not in RESERVED for name in names)
    if proper and len({*names}) == len(names):
        made = model(names)
        assert [*made.parameters] == names and len({*made.parameter_symbols.values()}) == len(names)
        assert made.latex()
        compile(made.symbolic.kernel_source(), "kernels", "exec")
        return
    with pytest.raises(ValueError, match="^parameters: must"):
        model(names)


@given(st.text(st.characters(), max_size=3), st.sampled_from(["\ud800", " ", "\0", "-", "a" * MOST_LETTERS, "\n", "/"]))
def test_texts_that_are_no_names_are_refused(text, wrong):
    name = text + wrong + "x"
    assume(len(name) > MOST_LETTERS or not name.isidentifier())
    with pytest.raises(ValueError, match="^parameters: must") as refused:
        model(["k", name])
    str(refused.value).encode()
    with pytest.raises(ValueError, match="^outputs and inputs: must"):
        bp.Recording.from_arrays([0.0, 1.0], {name: [0.0, 1.0]})


@pytest.mark.parametrize("name", ["run \ud800", "\udfff", "run\0", 3, None, b"run"])
def test_names_that_cannot_be_written_to_a_file_are_refused(name):
    with pytest.raises(ValueError, match="name: must be a text of Unicode characters, got"):
        bp.Recording(np.arange(3.0), {"x": np.arange(3.0)}, {}, name)
    with pytest.raises(ValueError, match="name: must be a text of Unicode characters, got"):
        bp.Experiment(name, 1.0, {"x": [0.0, 1.0, 0.0, -1.0]}, samples=4)


def test_hard_names_are_the_same_in_kernels_results_and_files(tmp_path):
    check_names(tmp_path, ["lambda", "E", "μ", "exp", "变量_2"], "run <i>'1' & \"☃\"\n")


@pytest.mark.slow
@settings(max_examples=8)
@given(st.lists(identifiers, min_size=5, max_size=5, unique_by=normal), texts)
def test_accepted_names_are_the_same_in_kernels_results_and_files(tmp_path_factory, names, run):
    assume(all(normal(name) == name and name not in RESERVED for name in names))
    assume(not any(mark in run for mark in "/[]"))
    check_names(tmp_path_factory.mktemp("names"), names, run)


def check_names(folder, names, run):
    """Compare solution, estimate, draws and files of a model with these parameters with closed forms."""
    made, x = model(names), np.cos(2 * np.pi * grid(64))
    values = {name: 1.0 + i for i, name in enumerate(names)}
    solution = bp.solve_periodic(made, values, {"x": x}, frequency=0.5, samples=64)
    powers = {name: x**i for i, name in enumerate(names, 1)}
    exact = sum(values[name] * power for name, power in powers.items())
    assert solution.outputs["y"] == pytest.approx(exact, abs=1e-9)
    for name, power in powers.items():
        assert solution.sensitivities["y"][name] == pytest.approx(power, abs=1e-9)
    noise = 0.1 * np.random.default_rng(1).standard_normal(64)
    experiment = bp.Experiment(run, 0.5, {"y": exact + noise}, {"x": x}, samples=64)
    local = names[0]
    problem = bp.Problem(made, [experiment], priors={name: bp.Normal(1.0, 9.0) for name in names}, local=[local])
    fit = bp.map_estimate(problem, progress=False)
    design = np.stack([*powers.values()], axis=-1)
    least, *_ = np.linalg.lstsq(design, exact + noise)
    expected = dict(zip([f"{local}[{run}]", *names[1:]], least, strict=True))
    assert fit.theta == pytest.approx(expected, rel=0.05, abs=0.2)
    posterior = bp.sample(problem, fit, seed=1, ensembles=2, max_steps=250, progress=False)
    path = folder / "result.h5"
    for result in (fit, posterior):
        result.save(path)
        loaded = bp.load(path)
        assert [*(loaded.theta if result is fit else loaded.names)][: len(expected)] == [*expected]
    for name in expected:
        assert np.array_equal(loaded.draws(name), posterior.draws(name))
        assert np.mean(posterior.draws(name)) == pytest.approx(fit.theta[name], abs=3 * fit.sd[name])
