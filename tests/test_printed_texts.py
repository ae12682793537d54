"""Every printed text can be encoded in cp1252, the encoding of output that is redirected into a file on Windows."""

import ast
import io
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic._printing import SELDOM, printable, progress_bar
from tests import layout
from tests.problems import DUFFING, duffing_run

CP1252 = "cp1252"
# Modules whose texts are written to figures and HTML, or compared with what the user gives, but never printed.
NEVER_PRINTED = {
    "bayesperiodic/plot": "figures",
    "bayesperiodic/reporting": "HTML",
    "bayesperiodic/models/library.py": "descriptions, which are docstrings",
    "bayesperiodic/data/formats/header_units.py": "units of a file, which are read",
    "bayesperiodic/data/formats/text.py": "signs between thousands of a file, which are read",
    "bayesperiodic/data/formats/text_cells.py": "signs between thousands of a file, which are read",
    "bayesperiodic/data/units.py": "units of a user, which are read",
    "bayesperiodic/models/units.py": "units of a user, which are read",
    "studies/animations": "figures",
    "studies/damper/run.py": "one axis of a figure",
    "studies/landing_gear/figures.py": "figures",
}


def missing_in_cp1252(text: str) -> str:
    """Return the characters of a text that cp1252 lacks."""
    return "".join(sorted({c for c in text if c.encode(CP1252, "replace") == b"?" and c != "?"}))


def literals(path) -> list[tuple[int, str]]:
    """Return the texts in a module by line, parts of f-strings too, without docstrings and other lone texts."""
    tree = ast.parse(path.read_text("utf-8"))
    lone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in lone)
    return [(node.lineno, node.value) for node in texts if isinstance(node.value, str)]


@pytest.mark.parametrize("folder", ["bayesperiodic", "studies"])
def test_no_text_in_the_code_has_other_characters(folder):
    """Whatever is printed, warned of or raised is written in the code, but for what the user gave."""
    found, exempt = [], set()
    for path in sorted((layout.ROOT / folder).rglob("*.py")):
        place = path.relative_to(layout.ROOT).as_posix()
        other = [
            f"{place}:{line} {missing_in_cp1252(text)}" for line, text in literals(path) if missing_in_cp1252(text)
        ]
        reasons = {name for name in NEVER_PRINTED if place == name or place.startswith(f"{name}/")}
        exempt |= reasons if other else set()
        found += [] if reasons else other
    assert not found, "write these characters in words, as figures only can have them"
    assert exempt == {name for name in NEVER_PRINTED if name.startswith(folder)}, "an exemption that nothing needs"


TRUTH = {"m": 1.0, "ζ": 0.2, "κ": 1.0}
UNITS = {"q": "µm", "force": "N", "spannung": "Ω·A"}


@pytest.fixture(scope="module")
def greek():
    """Return results of a model whose parameters, units and experiments are called by characters that cp1252 lacks."""
    model = bp.Model(
        "σχήμα", states=["q"], inputs=["force"], parameters={"m": "kg", "ζ": "N s/m", "κ": "N/m"},
        equations=["m*ddq + ζ*dq + κ*q + 0.5*q**3 - force"],
        outputs={"spannung": "q"}, units=UNITS,
    )  # fmt: skip
    force = {"force": 0.5 * np.cos(2 * np.pi * np.arange(32) / 32)}
    run = bp.simulate(
        model, TRUTH, force, frequency=0.12, duration=250, sampling_rate=8, noise={"spannung": 0.02}, seed=1
    ).between(100, 250)  # fmt: skip
    experiment = replace(run.fold(32, frequency=0.12, harmonics=5), name="Δ1")
    priors = {"m": bp.LogNormal(1, 1), "ζ": bp.LogNormal(0.2, 1), "κ": bp.LogNormal(1, 0.5)}
    return results_of(run, bp.Problem(model, [experiment], priors=priors, scheme="fourier"))


@pytest.fixture(scope="module")
def plain():
    """Return results of the Duffing oscillator, whose short chains are warned of."""
    problem = bp.Problem(
        bp.models.duffing, [duffing_run()], priors={"c": bp.LogNormal(0.2, 1), "k": bp.LogNormal(1, 0.5)},
        fixed={"m": 1.0, "k3": 0.5},
    )  # fmt: skip
    force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    run = bp.simulate(bp.models.duffing, DUFFING, force, frequency=0.1, duration=50, sampling_rate=8)
    return results_of(run, problem)


def results_of(run, problem):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = bp.map_estimate(problem, progress=False)
        posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=100, progress=False)
        (experiment,) = problem.experiments
        (solution,) = problem.solve(fit.theta).values()
        free = problem.names[-1]
        results = {
            "recording": run,
            "recording check": run.check(),
            "experiment": experiment,
            "model": problem.model,
            "element": bp.elements.Element(problem.names[-1], bp.elements.cubic, 0),
            "problem": problem,
            "estimate": fit,
            "estimate's checks": fit.checks,
            "posterior": posterior,
            "solution": solution,
            "structure": bp.structure(problem.model),
            "comparison": bp.compare(problem, fit, posterior),
            "identifiability": bp.identifiability(problem, fit, posterior),
            "prediction": bp.predict(problem, posterior, draws=30),
            "prior prediction": bp.prior_predictive(problem, draws=20),
            "profile": bp.profile(problem, fit, [free]),
            "missing terms": bp.missing_terms(problem, fit, max_terms=1),
            "branch": bp.continue_periodic(
                problem.model, solution, "frequency", until=1.02 * experiment.frequency
            ),
            "model comparison": bp.compare_models({"μ1": (problem, posterior), "μ2": (problem, posterior)}),
        }  # fmt: skip
    return results, [str(warning.message) for warning in caught]


def test_results_and_warnings_need_no_other_characters(plain):
    results, warned = plain
    texts = {name: repr(result) for name, result in results.items() if name != "model comparison"}
    assert not {name: missing_in_cp1252(text) for name, text in texts.items() if missing_in_cp1252(text)}
    assert not [text for text in warned if missing_in_cp1252(text)]


def test_results_with_any_names_can_be_printed_where_the_encoding_lacks_their_characters(greek, monkeypatch):
    """Python's own print raises a UnicodeEncodeError then, after hours of sampling; names stay as they are in UTF-8."""
    results, _ = greek
    lacking = [name for name, result in results.items() if missing_in_cp1252(repr(result))]
    assert {"estimate", "posterior", "problem", "experiment", "model", "element", "structure", "comparison"} <= set(
        lacking
    )
    for encoding in (CP1252, "ascii", "utf-8"):
        console = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict")
        monkeypatch.setattr(sys, "stdout", console)
        for name in lacking:
            print(results[name])
            assert str(results[name]) == (
                repr(results[name]) if encoding == "utf-8" else printable(repr(results[name]))
            )
        console.flush()
        shown = console.buffer.getvalue().decode(encoding)
        assert ("ζ" in shown) == (encoding == "utf-8")
        assert (r"\u03b6" in shown) == (encoding != "utf-8")


def test_text_is_unchanged_where_nothing_is_known_of_the_output(monkeypatch):
    outputs = [SimpleNamespace(encoding=encoding) for encoding in ("", "console", 850)]
    for output in (None, io.StringIO(), *outputs):
        monkeypatch.setattr(sys, "stdout", output)
        assert printable("θ = 1 → 2") == "θ = 1 → 2"


@pytest.mark.parametrize("arguments", [[], ["--help"], ["no-such-study"]])
def test_command_line_prints_in_cp1252(arguments):
    environment = os.environ | {"PYTHONIOENCODING": CP1252, "PYTHONPATH": str(layout.ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "studies", *arguments],
        cwd=layout.ROOT,
        env=environment,
        capture_output=True,
        check=False,
    )
    assert b"UnicodeEncodeError" not in done.stderr
    assert (done.returncode, bool(done.stdout)) == ((2, False) if "no-such-study" in arguments else (0, True))


def test_a_progress_bar_in_a_file_is_written_every_few_seconds_only(capsys, monkeypatch):
    clock = iter(np.arange(0.0, 1000.0, 0.1))
    monkeypatch.setattr("tqdm.std.time", lambda: next(clock))
    with progress_bar(total=1000) as bar:
        for _ in range(1000):
            bar.update()
    states = capsys.readouterr().err.split("\r")
    assert "1000/1000" in states[-1] and len(states) < 1000 * 0.2 / SELDOM + 5
