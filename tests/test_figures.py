"""No text of a figure is clipped or overlaps another, whatever the number of parameters."""

import inspect
import io
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

import bayesperiodic as bp
from bayesperiodic.plot import style
from bayesperiodic.problem.fingerprint import fingerprint
from tests.drawn import faults, posterior_of, texts
from tests.problems import quadratic_damping

NAMES = ["k", "c", "theta16[run 7]", "variance[displacement]", "a_long_name_of_a_parameter", "m", "l", "k1", "v0"]
UNITS = {"k": "N/m", "c": "N s/m", "theta16[run 7]": "1", "variance[displacement]": "(m/s)²", "m": "kg", "k1": "N m"}
SCALES = [4e7, -3e-4, 1.0, 2.5e-9, 12_345.0, 0.1, -0.3, 1e3, 1.0]
SPREADS = [3e4, 1e-4, 0.2, 1e-9, 12.0, 0.03, 0.001, 900.0, 2.0]


@pytest.fixture(scope="module")
def draws():
    values = np.random.default_rng(4).standard_normal((len(NAMES), 2000))
    return {n: s + d * x for n, s, d, x in zip(NAMES, SCALES, SPREADS, values, strict=True)}


@pytest.fixture(scope="module")
def results(solved):
    """Return results of one problem, by kind."""
    problem, fit, posterior = solved
    return {
        "problem": problem,
        "fit": fit,
        "posterior": posterior,
        "prediction": bp.predict(problem, posterior, draws=40),
        "comparison": bp.compare(problem, fit, posterior),
        "profile": bp.profile(problem, fit),
    }


def corner(count, draws, results):
    truths = {"k": 4e7, "c": 0.0}
    chosen = NAMES[:count]
    return bp.plot.corner(posterior_of(draws, units=UNITS), names=chosen, truths=truths, show_titles=count < 9)


def modes(count, draws, results):
    which = np.arange(2000) % 2
    return bp.plot.corner(posterior_of(draws, units=UNITS, modes=which), names=NAMES[:count])


def marginals(count, draws, results):
    return bp.plot.marginals(posterior_of(draws, units=UNITS), names=NAMES[:count])


def traces(count, draws, results):
    return bp.plot.traces(posterior_of({name: draws[name] for name in NAMES[:count]}, units=UNITS))


def fit(count, draws, results):
    """Draw as many experiments, up to two, with input noise or without."""
    problem, estimate = several(min(count, 2), results)
    return bp.plot.fit(problem, estimate)


def several(count, results):
    run = results["problem"].experiments[0]
    names = [run.name, *(f"run {k}" for k in range(1, count))]
    problem = results["problem"].with_experiments([replace(run, name=name) for name in names])
    residuals = {name: results["fit"].residuals[run.name] for name in names}
    return problem, replace(results["fit"], residuals=residuals, fingerprint=fingerprint(problem))


def loops(count, draws, results):
    return bp.plot.loops(*several(min(count, 2), results))


def profile(count, draws, results):
    own = results["profile"]

    def repeated(values):
        return {name: values["k"] for name in NAMES[:count]}

    fields = {name: repeated(getattr(own, name)) for name in ("map", "sd", "values", "log_density", "paths", "limits")}
    units = {name: UNITS.get(name, "m") for name in NAMES}
    return bp.plot.profile(replace(own, **fields, best=repeated(own.best), units=units))


def comparison(count, draws, results):
    own = results["comparison"]
    table = pd.concat([own.table.loc[["k"]]] * count).set_axis(NAMES[:count]).assign(coordinate=NAMES[:count])
    table["verdict"] = (["fine", "too narrow", "wrong shape"] * 3)[:count]
    fields = {
        name: dict.fromkeys(NAMES[:count], getattr(own, name)["k"]) for name in ("quantiles", "edges", "densities")
    }
    return bp.plot.comparison(replace(own, table=table, units={n: UNITS.get(n, "m") for n in NAMES}, **fields))


def ranks(count, draws, results):
    uniform = np.random.default_rng(1).uniform(size=50)
    positions = {method: dict.fromkeys(NAMES[:count], uniform) for method in ("mcmc", "laplace")}
    rows = [(method, name, "too narrow") for method in positions for name in NAMES[:count]]
    table = pd.DataFrame(rows, columns=["method", "quantity", "verdict"])
    return bp.plot.ranks(bp.Calibration(table, positions, {}, 50, 50, 100.0, 1.0, 0.0))


def models(count, draws, results):
    names = [f"model {k} with a name of some length" for k in range(count)]
    columns = dict.fromkeys(["log_evidence", "elpd_difference", "held_out_difference"], -3.0 * np.arange(count))
    columns |= dict.fromkeys(["log_evidence_error", "elpd_difference_se", "held_out_difference_se"], 0.2)
    table = pd.DataFrame(columns | {"probability": 1 / count, "verdict": "preferred"}, index=names)
    rows = [(name, run, -1.0 * k) for k, name in enumerate(names) for run in ("run 1", "run 2")]
    runs = pd.DataFrame(rows, columns=["model", "experiment", "elpd"])
    return bp.plot.models(bp.ModelComparison(table, runs, "", (), True))


def missing_terms(count, draws, results):
    problem, estimate = quadratic_damping()
    candidates = {"equation of x": ["dx*abs(dx)", "x**5"]}
    found = bp.missing_terms(problem, estimate, candidates, equations=False, outputs=False, max_terms=count - 1)
    return bp.plot.missing_terms(problem, estimate, found)


def summary(count, draws, results):
    return bp.plot.summary(results["problem"], results["fit"], results["posterior"])


def branch(count, draws, results):
    force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    parameters = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
    start = bp.solve_periodic(bp.models.duffing, parameters, force, frequency=0.1, samples=32, scheme="central4")
    found = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, progress=False)
    return bp.plot.branch(*[found] * count, labels=[f"force {k} N" for k in range(count)])


def henon():
    x = np.zeros((2000, 2))
    for k in range(1999):
        x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    return bp.PoincareSection.from_points(x[100:], ("x", "y"), frequency=1.0)


def section(count, draws, results):
    found = henon()
    return bp.plot.section(found, bp.find_orbits(found, periods=range(1, count + 1)), units={"x": "m", "y": "m/s"})


def orbits(count, draws, results):
    found = [orbit for orbit in bp.find_orbits(henon(), periods=range(1, 8))]
    return bp.plot.orbits((found * 9)[:count], units={"x": "m", "y": "m/s"})


def attractor(count, draws, results):
    """Draw orbits of as many periods, up to seven, in coordinates with units."""
    points, orbits = henon().points, bp.find_orbits(henon(), periods=range(1, min(count, 7) + 1))
    coordinates = ("a_long_name_of_a_coordinate", "a_long_name_of_a_coordinate[-0.25]")
    result = bp.AttractorPrediction(
        table=pd.DataFrame({"verdict": ["different"]}, ["all"]), exponents=pd.DataFrame(), section=points,
        model_section=points[None, ::2], coordinates=coordinates, units=dict.fromkeys(coordinates, "m/s"),
        orbits={orbit.name: orbit.points for orbit in orbits}, orbit_table=pd.DataFrame(), runs=100, unfitted=2,
        left=12, settled=0, pieces=60, periods=30, misfit=0.01, synthetic=True,
    )  # fmt: skip
    return bp.plot.attractor(result)


def recording(count, draws, results):
    """Draw a recording with faults of every kind that can be together."""
    time = np.concatenate([np.arange(0.0, 20.0, 0.01), np.arange(20.2, 60.0, 0.01)])
    x = np.cos(2 * np.pi * time) + 0.01 * np.random.default_rng(3).standard_normal(time.size)
    x[[500, 4000]], x[3000:3050] = 20.0, x[3000]
    names = [name.translate(str.maketrans("[] ", "___")) for name in NAMES[:count]]
    values = {name: np.clip(scale * x, -0.9 * abs(scale), np.inf) for name, scale in zip(names, SCALES, strict=False)}
    name = "a recording with a long name, which was measured on a rainy day by a careful engineer"
    return bp.plot.recording(bp.Recording.from_arrays(time, values, name=name))


def elements(count, draws, results):
    friction = {
        f"{name}, a width": lambda d, v, s, k=k: bp.elements.jenkins(s, "joint", v, 2e5, 10, 0.05 * (k + 1))
        for k, name in enumerate(NAMES[:count])
    }
    return bp.plot.elements(friction, 2e-4)


def response(count, draws, results):
    f = np.linspace(0.1, 0.2, 6)
    c = 0.5 / (1.0 - (2 * np.pi * f) ** 2 + 0.4j * np.pi * f) + 0.01 * np.cos(7 * np.arange(6))
    runs = bp.response_table({"f": f, "c": c}, frequency="f", outputs={"displacement": "c"}, inputs={"force": 0.5})
    priors = {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)}
    table = bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1, "k3": 0})
    return bp.plot.response(table, bp.map_estimate(table, progress=False))


def population(count, draws, results):
    units = {f"unit {k}, of a name of some length": results["posterior"] for k in range(count + 2)}
    springs = bp.population(units, ["k"], spread={"k": bp.HalfNormal(0.01)}, seed=1, progress=False)
    return bp.plot.population(springs)


DRAWERS = [
    attractor, branch, comparison, corner, elements, fit, loops, marginals, missing_terms, models, modes, orbits,
    population, profile, ranks, recording, response, section, summary, traces,
]  # fmt: skip


def test_every_public_figure_is_looked_at():
    drawn = {name for name in bp.plot.__all__ if inspect.isfunction(getattr(bp.plot, name))}
    assert drawn <= {drawer.__name__ for drawer in DRAWERS}


# Figures of more than so many are the same.
MOST = {response: 1, summary: 1, fit: 2, loops: 2, missing_terms: 2}


@pytest.mark.parametrize(("drawer", "count"), [(d, n) for d in DRAWERS for n in (1, 2, 9) if n <= MOST.get(d, 9)])
def test_no_text_is_clipped_or_overlaps_another(drawer, count, draws, results):
    assert not faults(drawer(count, draws, results))


@pytest.mark.slow
@pytest.mark.parametrize("drawer", DRAWERS)
def test_vector_files_are_small(drawer, draws, results):
    file = io.BytesIO()
    drawer(2, draws, results).savefig(file, format="svg")
    assert file.tell() < 250_000


def lightness(colour):
    """Return the lightness L* (CIE 1976) of a colour, 0 for black and 100 for white; a step of 2 can just be seen."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return 116.0 * np.cbrt(max(linear @ [0.2126, 0.7152, 0.0722], (4 / 29) ** 3)) - 16.0


def test_colours_can_be_told_apart_in_grey():
    """The lightness of colours of lines differs by 9, of the others by 8, and Laplace is dashed besides."""
    with plt.style.context(style.SHEET):
        cycle = plt.rcParams["axes.prop_cycle"].by_key()["color"]
    assert cycle == [*style.ENSEMBLES]
    for least, colours in ((9.0, style.ENSEMBLES), (8.0, style.COLOURS.values())):
        assert np.diff(np.sort([lightness(colour) for colour in colours])).min() > least
    assert style.LAPLACE_STYLE["ls"] == "--"


def test_clipped_and_overlapping_texts_are_found():
    figure, axes = plt.subplots(figsize=(3.0, 2.0))
    axes.text(0.5, 0.5, "one")
    figure.text(0.98, 0.5, "too long")
    axes.text(0.52, 0.51, "other")
    axes.text(0.2, 0.2, "turned", rotation=45)
    axes.text(0.32, 0.2, "beside", rotation=45)
    assert faults(figure) == ["clipped: 'too long'", "overlap: 'one' and 'other'"]
    assert {"one", "turned"} <= {text.get_text() for text in texts(figure)}


def test_summary_shows_the_worst_parameters_and_the_verdicts(results):
    problem, fit, posterior = (results[name] for name in ("problem", "fit", "posterior"))
    found = bp.identifiability(problem, fit, posterior, profile=False).table
    worst = found["contraction"].nsmallest(2).index
    figure = bp.plot.summary(problem, fit, posterior)
    top, below, *panels = figure.axes
    assert np.array_equal(below.lines[0].get_ydata(), fit.residuals["run"]["force"])
    assert (top.get_ylabel(), below.get_ylabel()) == ("force [N]", "residual [N]")
    shown = [panels[2].get_xlabel(), panels[3].get_xlabel()]
    assert [label.split("\n")[0] for label in shown] == [name for name in problem.names if name in worst]
    (words,) = figure.subfigs[1].subfigs[1].texts
    text = " ".join(words.get_text().split())
    assert f"Fit: {100 * (1 - fit.fvu['force']):.4g} % of the variance of force explained" in text
    assert "Determined: k, c, coulomb." in text and "Laplace approximation: fine." in text and "converged" in text
    bad = bp.plot.summary(problem, fit, replace(posterior, converged=False))
    assert "Draws: NOT CONVERGED" in bad.subfigs[1].subfigs[1].texts[0].get_text()
    with pytest.raises(ValueError, match="fit: must be a result of this problem"):
        bp.plot.summary(problem, replace(fit, fingerprint="model:1"), posterior)
