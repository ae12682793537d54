import os
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.reporting.pictures import Picture
from tests.known import LINEAR, formula_model, linear_experiment
from tests.problems import quadratic_damping
from tests.reporting.conftest import ATTACK, NAME
from tests.reporting.reading import Page, value


@pytest.fixture
def pictures_left_out(monkeypatch):
    """Make the figures without writing them as images, which takes most of the time of a report."""
    monkeypatch.setattr("bayesperiodic.reporting.pictures.embedded", lambda drawing, name: Picture("data:,", "[]"))


def test_estimates_are_those_of_fit_and_posterior(solved, page):
    """All that is shown is rounded to a hundredth of a standard deviation, at least."""
    _, fit, posterior = solved
    rows, summary, intervals = page.rows("table-estimates"), posterior.summary(), fit.interval(0.9)
    assert list(rows) == list(fit.theta)
    for name, (unit, at, sd, interval, freedom, robust, mean, spread, drawn) in rows.items():
        assert value(freedom) == pytest.approx(fit.degrees_of_freedom[name], rel=0.005)
        assert unit == LINEAR.units[name]
        low, high = interval.split(" … ")
        shown = [value(cell) for cell in (at, sd, low, high, robust, mean, spread, *drawn.split(" … "))]
        found = summary.loc[name]
        expected = [fit.theta[name], fit.sd[name], *intervals[name], fit.robust_sd[name], *found[["mean", "sd"]]]
        assert shown == pytest.approx([*expected, *found[["q05", "q95"]]], abs=0.006 * fit.sd[name])
    unit, independent, at, _, mean, spread, _ = page.rows("table-noise")["variance[force]"]
    assert (unit, independent) == ("N²", "40")
    assert value(at) == pytest.approx(fit.noise["variance[force]"], rel=0.01)
    assert [value(mean), value(spread)] == pytest.approx(list(summary.loc["variance[force]"][["mean", "sd"]]), rel=0.01)


def test_numbers_of_data_residual_and_draws_are_shown(solved, page):
    problem, fit, posterior = solved
    (run,) = problem.experiments
    assert page.rows("table-experiments") == {"run": ["measured", "2", "–", "1", "1", "40", "1"]}
    channels = page.rows("table-channels")
    assert channels["x"][:5] == ["run", "input", "m", "−0.05", "0.05"]
    assert value(channels["force"][4]) == pytest.approx(run.outputs["force"].max(), rel=1e-3)
    residual = page.rows("table-residuals")["force"]
    assert value(residual[1]) == pytest.approx(fit.rms["force"], rel=0.005)
    assert value(residual[2].removesuffix(" %")) == pytest.approx(100 * fit.fvu["force"], rel=0.005)
    assert value(residual[6]) == pytest.approx(fit.whiteness["force"].p, rel=0.05)
    for name, (size, tau, rhat) in page.rows("table-sampling").items():
        assert float(size) == pytest.approx(posterior.ess[name], abs=0.5)
        assert [float(tau), float(rhat)] == pytest.approx([posterior.tau[name], posterior.rhat[name]], rel=0.005)


def test_verdicts_are_shown_in_words(solved, scored, page):
    problem, fit, posterior = solved
    found = bp.identifiability(problem, fit, posterior, profile=False)
    for name, cells in page.rows("table-identifiability").items():
        assert cells == [f"✓ {found.table.loc[name, 'verdict']}", found.table.loc[name, "evidence"], "–"]
    verdicts = {name: cells[0].split(" ", 1)[1] for name, cells in page.rows("table-laplace").items()}
    assert verdicts == scored.table["verdict"].to_dict()
    assert page.rows("table-adequacy")["all"][0] == "✓ adequate"
    answers = page.text[page.text.index("Summary") : page.text.index("Data Experiments")]
    for words in ("3 of 3", "No test contradicts the model", "Every free parameter is determined by the data"):
        assert words in answers


def test_settings_seed_and_versions_are_shown(solved, page):
    settings, versions = page.rows("table-settings"), page.rows("table-versions")
    assert settings["Seed"] == [str(solved[2].seed)]
    assert settings["Difference scheme"] == ["central4"]
    assert "2 ensembles, 32 walkers each" in settings["Draws"][0]
    assert versions["numpy"] == [np.__version__]


@pytest.mark.usefixtures("pictures_left_out")
def test_given_verdicts_are_not_recomputed(solved, scored, tmp_path, monkeypatch):
    problem, fit, posterior = solved
    found, predicted = bp.identifiability(problem, fit, profile=False), bp.predict(problem, posterior, draws=20)
    for name in ("compare", "identifiability", "predict"):
        monkeypatch.setattr(f"bayesperiodic.reporting.contents.{name}", None)
    given = {"comparison": replace(scored, coordinates="sampling"), "identifiability": found, "prediction": predicted}
    written = Page(bp.report(problem, fit, posterior, tmp_path / "r.html", **given).read_text(encoding="utf-8"))
    assert "Laplace against MCMC in sampling coordinates" in written.text


def test_report_of_a_fit_alone_states_that_there_are_no_draws(solved, tmp_path):
    problem, fit, _ = solved
    written = Page(bp.report(problem, fit, None, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert len(written.rows("table-estimates")["k"]) == 6
    assert "There are no draws (MCMC)" in written.text and "table-sampling" not in written.tables
    assert {e.attributes["id"] for e in written.all("figure")} == {"figure-fit-1", "figure-loops"}


@pytest.mark.usefixtures("pictures_left_out")
def test_a_fit_alone_that_is_misspecified_is_said_to_be(solved, tmp_path):
    problem, fit, _ = solved
    rejected = replace(fit, checks=replace(fit.checks, misfit="The model is misspecified (a reason)"))
    for one, badge, words in ((fit, "not tested", "do not reject"), (rejected, "misspecified", "reject the model")):
        written = Page(bp.report(problem, one, None, tmp_path / "r.html").read_text(encoding="utf-8"))
        summary = written.text.partition("Does the model explain the data?")[2][:150]
        assert badge in summary and words in summary and "tests reject the model" not in summary


@pytest.mark.usefixtures("pictures_left_out")
def test_values_without_a_time_history_are_data_with_their_units(tmp_path):
    """The table of a linear oscillator: 3 amplitudes [mm] and phases."""
    f = np.array([3.0, 4.0, 5.0])
    h = 1.0 / (800.0 - (2 * np.pi * f) ** 2 + 2j * np.pi * f * 3.0)
    table = {"f": f, "x [mm]": 1e3 * abs(h), "phi": np.degrees(np.angle(h))}
    runs = bp.response_table(
        table, frequency="f", outputs={"displacement": "x [mm]"}, phases={"displacement": "phi"},
        inputs={"force": 1.0}, sd={"displacement": "1%"}, phase_sd={"displacement": 0.5},
    )  # fmt: skip
    priors = {"c": bp.LogNormal(3.0, 1.0), "k": bp.LogNormal(800.0, 1.0)}
    problem = bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1.0, "k3": 0.0})
    fit = bp.map_estimate(problem, progress=False)
    written = Page(bp.report(problem, fit, None, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "6 independent values of amplitude of displacement, phase of displacement" in written.text
    rows = [[cell.text for cell in row] for row in written.tables["table-measurements"]]
    assert len(rows) == 7
    (size,) = [row for row in rows if row[:2] == ["amplitude of displacement", runs[1].name]]
    assert size[2] == "m" and value(size[3]) == pytest.approx(abs(h[1]), rel=1e-3)
    assert value(size[4]) == pytest.approx(0.01 * abs(h[1]), rel=1e-2)
    (angle,) = [row for row in rows if row[:2] == ["phase of displacement", runs[2].name]]
    assert angle[2] == "rad" and value(angle[3]) == pytest.approx(np.angle(h[2]), rel=1e-3)
    units = [row[1].text for row in written.tables["table-residuals"][1:]]
    assert units == ["m", "rad"]


@pytest.mark.usefixtures("pictures_left_out")
def test_failed_prediction_is_reported(solved, scored, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("posterior: none of its draws has a periodic solution.")

    monkeypatch.setattr("bayesperiodic.reporting.contents.predict", fail)
    written = Page(bp.report(*solved, tmp_path / "r.html", comparison=scored).read_text(encoding="utf-8"))
    assert written.text.count("none of its draws has a periodic solution") == 2


@pytest.mark.usefixtures("pictures_left_out")
def test_fit_with_warnings_is_marked(solved, tmp_path):
    """Synthetic data, a search that stalled, an estimate at its end, a residual that is not white."""
    problem, fit, _ = solved
    problem = problem.with_experiments([replace(problem.experiments[0], synthetic=True)])
    white = {"force": replace(fit.whiteness["force"], p=1e-5)}
    wider = {name: (3.01 if name == "k" else 3.0) * sd for name, sd in fit.sd.items()}
    fit = replace(
        fit,
        status="stalled",
        search=replace(fit.search, at_ends=("k",)),
        checks=replace(fit.checks, whiteness=white, robust_sd=wider),
    )
    text = Page(bp.report(problem, fit, None, tmp_path / "r.html").read_text(encoding="utf-8")).text
    for words in ("! synthetic data", "✕ stalled", "lies at the end of its prior's support", "3 times as large (k)"):
        assert words in text
    assert "Robust 90 % interval" in text


@pytest.mark.usefixtures("pictures_left_out")
def test_single_points_are_labelled(solved, tmp_path):
    problem, _, _ = solved
    run = problem.experiments[0]
    masked = replace(run, mask=np.arange(40) % 4 == 1, independent={})
    problem = problem.with_experiments([masked])
    written = bp.report(problem, bp.map_estimate(problem, progress=False), None, tmp_path / "r.html")
    assert Page(written.read_text(encoding="utf-8")).rows("table-channels")["force"][1] == "output, at 10 points"


def test_text_is_escaped(hostile):
    source = hostile.read_text(encoding="utf-8")
    page = Page(source)
    assert not page.all("b", "iframe", "object", "link", "base", "button", "input") and len(page.all("script")) == 1
    assert all(e.attributes["src"].startswith("data:image/svg+xml;base64,") for e in page.all("img"))
    assert not [name for e in page.elements for name in e.attributes if name.startswith("on")]
    assert [e.text for e in page.all("h1")] == [ATTACK]
    assert ATTACK in next(e.text for e in page.all("title"))
    assert f"k[{NAME} again]" in page.rows("table-estimates")
    assert page.rows("table-channels")["force"][2] == "<b>N</b>"
    assert "NOT CONVERGED" in page.text


def test_report_loads_no_external_resources(written, hostile):
    for path in (written, hostile):
        source = path.read_text(encoding="utf-8")
        page = Page(source)
        sources = [
            e.attributes[a] for e in page.elements for a in ("src", "srcset", "data", "poster") if a in e.attributes
        ]
        assert sources and all(s.startswith("data:") for s in sources)
        assert all(e.attributes["href"].startswith("#") for e in page.all("a"))
        assert not re.search(r"@import|url\(", source)


def test_equations_are_typeset_and_symbols_match(page):
    equations = [e for e in page.all("math") if e.attributes.get("display") == "block"]
    assert [e.text for e in equations] == ["w˙+w=x", "force=c\u2062x˙+coulomb\u2062tanh(10\u2062x˙)+k\u2062x"]
    assert page.rows("table-parameters")["coulomb"][:3] == ["coulomb", "N", "free"]


def test_headings_are_in_order_and_links_have_targets(page):
    levels = [int(e.tag[1]) for e in page.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after - before <= 1 for before, after in zip(levels, levels[1:], strict=False))
    ids = [e.attributes["id"] for e in page.elements if "id" in e.attributes]
    assert len(set(ids)) == len(ids)
    targets = [e.attributes["href"][1:] for e in page.all("a")]
    targets += [label for e in page.elements for label in e.attributes.get("aria-labelledby", "").split()]
    assert set(targets) <= set(ids)


def test_every_picture_has_a_text_alternative(solved, page):
    (html,) = page.all("html")
    assert html.attributes["lang"] == "en"
    assert {e.tag for e in page.elements} >= {"title", "header", "nav", "main", "footer"}
    alts = [e.attributes["alt"] for e in page.all("img")]
    assert len(set(alts)) == len(alts) == 5 and min(map(len, alts)) > 60
    strongest = f"{solved[1].rms['force']:.3g}"
    assert any(f"root mean square is {strongest} N" in alt for alt in alts)
    assert all(e.attributes.get("scope") in ("row", "col", "colgroup") for e in page.all("th"))
    assert all(len({cell.tag for cell in row[1:]} - {"th", "td"}) == 0 for rows in page.tables.values() for row in rows)


def test_failed_write_keeps_the_old_page(solved, tmp_path, monkeypatch):
    problem, fit, _ = solved
    target = tmp_path / "report.html"
    target.write_text("old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        bp.report(problem, fit, None, target)
    assert target.read_text() == "old" and os.listdir(tmp_path) == ["report.html"]


def test_results_of_another_problem_are_rejected(solved, tmp_path):
    problem, fit, posterior = solved
    other = problem.with_experiments([linear_experiment(np.array([900.0, 40.0, 25.0]), 3.0, seed=2)])
    path = tmp_path / "report.html"
    with pytest.raises(
        ValueError, match="fit: must be a result of this problem, got one of a problem with other experiments"
    ):
        bp.report(other, fit, posterior, path)
    with pytest.raises(ValueError, match="posterior: must be a result of this problem, got .* other experiments"):
        bp.report(other, bp.map_estimate(other, progress=False), posterior, path)
    with pytest.raises(FileNotFoundError, match="path: must be in an existing folder"):
        bp.report(problem, fit, None, tmp_path / "nowhere" / "report.html")
    assert not os.listdir(tmp_path)


GAIN = formula_model("gain", ["a"], lambda p, u, s: {"y": p.a * u.x})


def gain_run(name="run", cycles=20):
    """Return the mean period of y = 2·x with white noise of x and y."""
    random, time = np.random.default_rng(cycles), np.arange(40 * cycles) / 40.0
    x = np.cos(2 * np.pi * time)
    y = 2.0 * x + 0.1 * random.standard_normal(time.size)
    recording = bp.Recording(time, {"y": y}, {"x": x + 0.2 * random.standard_normal(time.size)}, name=name)
    return recording.fold(64, frequency=1.0, harmonics={"x": 2, "y": 6})


def gain_page(folder, runs, noise):
    """Return the estimate and the report of a problem with noisy inputs."""
    problem = bp.Problem(GAIN, runs, priors={"a": bp.Normal(0.0, 10.0)}, input_noise=noise)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = bp.map_estimate(problem, starts=1, progress=False)
    return fit, Page(bp.report(problem, fit, None, folder / "r.html").read_text(encoding="utf-8"))


TREATED = {
    "measured": "The noise of the inputs (x), known from the scatter of the cycles, is integrated out: the covariance",
    "given": "The noise of the inputs (x), known from the problem, which states it, is integrated out:",
    "exact": "The inputs are taken as exact. Their noise would cause a standard deviation of",
    "joint": "The errors of the inputs are parameters, with priors by the scatter of the cycles. Their noise causes a",
}


@pytest.mark.usefixtures("pictures_left_out")
@pytest.mark.parametrize("noise", TREATED)
def test_treatment_of_the_inputs_noise_its_size_and_its_linearisation_are_stated(noise, tmp_path):
    fit, page = gain_page(tmp_path, [gain_run()], {"x": 0.05} if noise == "given" else noise)
    (text,) = [e.text for e in page.all("p") if e.attributes.get("id") == "input-noise"]
    assert text.startswith(TREATED[noise])
    assert [value(number) for number in re.findall(r"(?:deviation of|is) ([\d.×⁻⁰-⁹¹²³]+\d)", text)] == pytest.approx(
        [fit.input_noise["y"], fit.rms["y"]], rel=0.01
    )
    integrated = noise in ("measured", "given")
    linear = "What is not linear in it changes estimates by less than 0.01 standard deviations (a)."
    assert text.endswith(linear) is integrated
    (alt,) = [e.attributes["alt"] for e in page.all("img") if e.attributes["alt"].startswith("Line plot")]
    assert ("estimated error of x, measured minus estimated input, with its 90 % band" in alt) is integrated


@pytest.mark.usefixtures("pictures_left_out")
def test_experiments_with_too_few_cycles_are_named_as_exact(tmp_path):
    _, page = gain_page(tmp_path, [gain_run("long"), replace(gain_run("short", cycles=4), cycles=1)], "measured")
    assert "The inputs of short are taken as exact." in page.text
    shown = [e.text for e in page.all("figcaption")]
    assert "the estimated error of x" in shown[0] and "the estimated error" not in shown[1]


@pytest.mark.usefixtures("pictures_left_out")
def test_errors_that_are_not_linear_are_stated_by_the_largest_or_a_failed_solve(tmp_path):
    fit, _ = gain_page(tmp_path, [gain_run()], "measured")
    problem = bp.Problem(GAIN, [gain_run()], priors={"a": bp.Normal(0.0, 10.0)})
    for curved, stated in ((0.35, "by up to 0.35 standard deviations (a)"), (np.nan, "by up to – standard deviations")):
        other = replace(fit, checks=replace(fit.checks, input_nonlinearity={"a": curved}))
        page = Page(bp.report(problem, other, None, tmp_path / "r.html").read_text(encoding="utf-8"))
        assert f"What is not linear in it changes estimates {stated}" in page.text


@pytest.mark.usefixtures("pictures_left_out")
def test_noise_of_inputs_that_is_negligible_is_said_to_be(tmp_path):
    fit, page = gain_page(tmp_path, [gain_run()], {"x": 1e-6})
    assert not fit.input_errors
    assert (
        "The noise of the inputs (x), known from the problem, which states it, is negligible beside that of the"
        in page.text
    )
    assert "What is not linear" not in page.text and not any("error of x" in e.text for e in page.all("figcaption"))


@pytest.mark.usefixtures("pictures_left_out")
def test_missing_terms_have_a_section_where_they_are_given(solved, page, tmp_path):
    problem, fit = quadratic_damping()
    wanted = {"equation of x": ["dx*abs(dx)", "x**5"]}
    found = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False)
    read = Page(bp.report(problem, fit, None, tmp_path / "report.html", missing=found).read_text("utf-8"))
    rows = read.rows("table-missing")
    assert list(rows) == ["given model", "dx*abs(dx)"] and len(rows["given model"]) == len(rows["dx*abs(dx)"]) == 8
    step, cells = found.steps[0], rows["dx*abs(dx)"]
    assert cells[0] == "equation of x" and cells[4] == f"✓ {step.verdict}"
    assert rows["given model"][4:] == ["✕ misspecified", "–", "–", "–"]
    assert value(cells[2].removesuffix(" %")) == pytest.approx(100 * step.held_out, rel=0.01)
    assert [value(cells[i]) for i in (5, 6, 7)] == pytest.approx(
        [step.evidence_gain, step.coefficient, step.robust_sd], rel=0.01
    )
    assert found.stopped in read.text and f"Of {found.tested} candidates" in read.text
    ids = {e.attributes.get("id") for e in read.elements}
    assert {"missing", "figure-missing"} <= ids
    assert "Missing terms" not in page.text
    none = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False, max_terms=0)
    plain = Page(bp.report(problem, fit, None, tmp_path / "report.html", missing=none).read_text("utf-8"))
    assert "None was added. The search ended after 0 terms" in plain.text
    assert "figure-missing" not in {e.attributes.get("id") for e in plain.elements}
    with pytest.raises(ValueError, match="missing: must be missing_terms.* of this problem"):
        bp.report(*solved, tmp_path / "report.html", missing=found)


@pytest.mark.usefixtures("pictures_left_out")
def test_the_first_section_says_what_was_found_in_the_recordings(tmp_path):
    time, tau = np.arange(2000) / 100, np.arange(64) / 64
    direct = bp.Experiment("table 3", 1.0, *({c: np.cos(2 * np.pi * tau)} for c in "yx"), samples=64)
    rng = np.random.default_rng(5)
    x, y = (size * np.cos(2 * np.pi * time) + 0.01 * rng.standard_normal(time.size) for size in (1.0, 2.0))
    y[700], ramp = 2.6, np.minimum((20.0 - time) / 5.0, 1.0)
    recording = bp.Recording(time, {"y": ramp * y}, {"x": ramp * x}, name="ramped")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ramped = recording.fold(64, frequency=1.0)
    assert {finding.kind for finding in ramped.findings} == {"outliers", "ramp"}
    _, page = gain_page(tmp_path, [gain_run(cycles=30), ramped, direct], "exact")
    sections = [e for e in page.all("section")]
    assert sections[0].attributes["id"] == "recordings"
    rows = [[cell.text for cell in row] for row in page.tables["table-findings"][-2:]]
    for row, finding in zip(rows, ramped.findings, strict=True):
        assert row[:3] == ["ramped", finding.channel or "all", finding.kind]
        assert row[3].split()[-1] == finding.severity and row[6] == str(finding.count)
        assert value(row[4]) == pytest.approx(finding.times[0, 0], rel=1e-5)
        assert f"ramped: {' '.join(str(finding).split())}." in sections[0].text
    assert "Nothing was found in the recording of run." in sections[0].text
    assert "Not folded from a recording, so that none was checked: table 3." in sections[0].text


@pytest.mark.usefixtures("pictures_left_out")
def test_a_report_without_findings_has_no_table_of_them(tmp_path):
    _, page = gain_page(tmp_path, [gain_run(cycles=30)], "exact")
    assert "table-findings" not in page.tables
    assert "Nothing was found in the recording of run." in page.all("section")[0].text


@pytest.mark.usefixtures("pictures_left_out")
def test_a_misspecified_model_is_pointed_to_the_search(solved, scored, tmp_path):
    problem, fit, posterior = solved
    table = bp.predict(problem, posterior, draws=20).table.copy()
    table.loc["run force", "size"], table["verdict"] = 1e-9, "misspecified"
    rejected = replace(bp.predict(problem, posterior, draws=20), table=table)
    path = bp.report(*solved, tmp_path / "report.html", comparison=scored, prediction=rejected)
    assert "bp.missing_terms(problem, fit) looks for the term" in Page(path.read_text("utf-8")).text


@pytest.mark.skipif(os.name == "nt", reason="needs symbolic links")
def test_report_is_written_through_a_link(solved, tmp_path):
    problem, fit, _ = solved
    (tmp_path / "disk").mkdir()
    link, target = tmp_path / "report.html", tmp_path / "disk" / "page.html"
    link.symlink_to("disk/page.html")
    assert bp.report(problem, fit, None, link) == link
    assert link.is_symlink() and not target.is_symlink() and target.read_text(encoding="utf-8").startswith("<!DOCTYPE")
    assert os.listdir(tmp_path / "disk") == ["page.html"]


def test_of_many_experiments_those_with_the_largest_residuals_are_drawn(tmp_path, monkeypatch, pictures_left_out):
    """Of the residuals of three experiments, those of the second are enlarged; a note says how to draw the others."""
    problem, fit = quadratic_damping()
    monkeypatch.setattr("bayesperiodic.reporting.pictures.MOST_DRAWN", 1)
    residuals = {n: {c: e * (20.0 if n == "run 1" else 1.0) for c, e in r.items()} for n, r in fit.residuals.items()}
    path = bp.report(problem, replace(fit, residuals=residuals), None, tmp_path / "report.html")
    text = path.read_text(encoding="utf-8")
    assert re.findall(r'<figure id="figure-fit-\d+".*?(run \d)', text, re.DOTALL) == ["run 1"]
    assert "Drawn are the 1 of 3 experiments with the largest residual" in text
    monkeypatch.setattr("bayesperiodic.reporting.pictures.MOST_DRAWN", 3)
    whole = bp.report(problem, fit, None, tmp_path / "whole.html").read_text(encoding="utf-8")
    assert len(re.findall(r'<figure id="figure-fit-\d+"', whole)) == 3 and "Drawn are the" not in whole
