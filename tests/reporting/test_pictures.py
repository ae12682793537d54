"""Values read from the images by the description of their panels, and the script of the report."""

import base64
import hashlib
import json
import re
import xml.etree.ElementTree as ElementTree
from importlib.resources import files

import matplotlib.pyplot as plt
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.reporting.pictures import Picture, embedded
from tests.problems import duffing, duffing_run
from tests.reporting.conftest import NAME
from tests.reporting.reading import Page

SVG = "{http://www.w3.org/2000/svg}"
SCRIPT = (files("bayesperiodic.reporting") / "templates" / "page.js").read_text(encoding="utf-8")
# Of the script and the descriptions of all figures, in an ordinary report.
MOST_BYTES = 300_000


class Image:
    """An image and its panels; values are read by linear interpolation between the limits of the axes."""

    def __init__(self, picture: Picture):
        source = base64.b64decode(picture.url.removeprefix("data:image/svg+xml;base64,")).decode()
        self.groups = {e.get("id"): e for e in ElementTree.fromstring(source).iter(f"{SVG}g")}
        self.panels = json.loads(picture.panels)

    def curves(self, curve, channel, experiment):
        """Yield each drawn curve of this name: its panel and its points (x, y)."""
        for panel in self.panels:
            for c in panel["curves"]:
                if (c["curve"], c["channel"], c["experiment"]) == (curve, channel, experiment):
                    yield panel, self.values(panel, self.groups[c["id"]], c["form"])

    def values(self, panel, group, form):
        """Return the values (points, 2) of a line, of markers or of a band."""
        if form == "points":
            at = np.array([[float(e.get("x")), float(e.get("y"))] for e in group.iter(f"{SVG}use")])
        else:
            numbers = [float(n) for n in re.findall(r"-?[\d.]+", next(group.iter(f"{SVG}path")).get("d"))]
            use = next(group.iter(f"{SVG}use"), None)
            shift = [0.0, 0.0] if use is None else [float(use.get("x")), float(use.get("y"))]
            at = np.reshape(numbers, (-1, 2)) + shift
        left, top, right, bottom = panel["box"]
        (x0, x1), (y0, y1) = panel["x"]["limits"], panel["y"]["limits"]
        x = x0 + (x1 - x0) * (at[:, 0] - left) / (right - left)
        return np.stack([x, y0 + (y1 - y0) * (bottom - at[:, 1]) / (bottom - top)], axis=1)


@pytest.fixture(scope="module")
def long_period():
    """Return a problem of 200 samples, of which matplotlib would draw fewer, and its estimate."""
    problem = duffing(duffing_run())
    return problem, bp.map_estimate(problem, starts=1, checks=False, progress=False)


@pytest.mark.parametrize("cropping", ["standard", "tight"])
def test_measured_fitted_and_residual_values_are_where_the_panels_say(long_period, cropping):
    problem, fit = long_period
    (run,) = problem.experiments
    with plt.rc_context({"savefig.bbox": cropping}):
        image = Image(embedded(bp.plot.fit(problem, fit), "fit"))
    residual, measured = fit.residuals[run.name]["displacement"], run.outputs["displacement"]
    shown = {"measured": measured, "MAP": measured - residual, "residual": residual}
    for curve, values in shown.items():
        ((panel, points),) = image.curves(curve, "displacement", run.name)
        assert panel["x"]["label"] == "time in the period [s]"
        assert panel["y"]["label"] == ("residual [m]" if curve == "residual" else "displacement [m]")
        np.testing.assert_allclose(points, np.stack([run.time, values], axis=1), atol=1e-4 * np.ptp(values), rtol=1e-4)


def test_single_points_are_where_the_panels_say(several):
    problem, fit = several
    masked = problem.experiments[1]
    image = Image(embedded(bp.plot.fit(problem, fit, experiments=[NAME]), "fit"))
    for channel in ("angle", "rate"):
        ((_, points),) = image.curves("measured", channel, NAME)
        at = masked.measured_points
        wanted = np.stack([masked.time[at], masked.outputs[channel][at]], axis=1)
        np.testing.assert_allclose(points, wanted, rtol=1e-4, atol=1e-4)


def test_bands_have_their_ends_at_every_sample(solved):
    problem, fit, posterior = solved
    prediction = bp.predict(problem, posterior, draws=40)
    image = Image(embedded(bp.plot.fit(problem, fit, prediction), "fit"))
    (_, points), _ = image.curves(f"{100 * prediction.probability:.0f} % predictive band", "force", "run")
    for time, low, high in zip(
        problem.experiments[0].time, prediction.low["run"]["force"], prediction.high["run"]["force"], strict=True
    ):
        ends = points[np.abs(points[:, 0] - time) < 1e-4, 1]
        assert [ends.min(), ends.max()] == pytest.approx([low, high], rel=1e-4, abs=1e-3)


def test_loops_name_the_experiments_of_their_curves(long_period):
    problem, fit = long_period
    (run,) = problem.experiments
    image = Image(embedded(bp.plot.loops(problem, fit), "loops"))
    (left, points), (right, _) = image.curves("measured", "displacement", "run 1")
    assert (left["x"]["label"], right["x"]["label"]) == ("force [N]", "rate of force [N/s]")
    assert right["y"]["label"] == "displacement [m]"
    closed = np.arange(201) % 200
    wanted = np.stack([run.inputs["force"][closed], run.outputs["displacement"][closed]], axis=1)
    np.testing.assert_allclose(points, wanted, atol=1e-4, rtol=1e-4)


def test_inner_panels_of_a_corner_have_the_labels_of_their_row_and_column(solved):
    _, fit, posterior = solved
    image = Image(embedded(bp.plot.corner(posterior, laplace=fit, names=["k", "c", "coulomb"]), "corner"))
    names = [(axis["label"].split()[0] if axis else None) for p in image.panels for axis in (p["x"], p["y"])]
    pairs = set(zip(names[::2], names[1::2], strict=True))
    assert {("k", "c"), ("k", "coulomb"), ("c", "coulomb"), ("k", None), ("c", None), ("coulomb", None)} <= pairs


def test_axes_are_described_if_values_can_be_read_from_them():
    figure, ((first, second), _) = plt.subplots(2, 2)
    first.set(xscale="log", xlim=(1.0, 100.0), xlabel=r"cost [\$]", yscale="symlog", ylabel="y")
    second.set(ylabel="two\nlines")
    a, b, *_ = json.loads(embedded(figure, "scales").panels)
    assert a["x"] == {"label": "cost [$]", "limits": [1.0, 100.0], "scale": "log"} and a["y"] is None
    assert b["x"] is None and b["y"]["label"] == "two lines"
    left, top, right, bottom = a["around"]
    assert left < a["box"][0] < a["box"][2] <= right and top <= a["box"][1] < a["box"][3] < bottom


def test_responses_name_their_table_and_show_measured_points():
    f = np.linspace(0.1, 0.2, 6)
    c = 0.5 / (1.0 - (2 * np.pi * f) ** 2 + 0.4j * np.pi * f) + 0.01 * np.cos(7 * np.arange(6))
    given = {"frequency": "f", "outputs": {"displacement": "c"}, "inputs": {"force": 0.5}}
    runs = bp.response_table({"f": f, "c": c}, **given)
    priors = {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)}
    problem = bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1, "k3": 0})
    fit = bp.map_estimate(problem, starts=1, progress=False)
    image = Image(embedded(bp.plot.response(problem, fit), "response"))
    (_, amplitude), (_, phase) = image.curves("measured", "displacement", runs[0].sweep.table)
    np.testing.assert_allclose(amplitude, np.stack([f, np.abs(c)], axis=1), rtol=1e-3)
    np.testing.assert_allclose(phase, np.stack([f, np.degrees(np.angle(c))], axis=1), rtol=1e-3, atol=0.05)
    ((_, left),) = image.curves("residual", "displacement", runs[0].sweep.table)
    assert len(left) == 12
    assert {c["experiment"] for p in image.panels for c in p["curves"]} == {runs[0].sweep.table}


def test_only_the_script_of_the_package_may_run(written, hostile):
    """The browser runs what has the digest that the page states, and loads nothing."""
    for path in (written, hostile):
        page = Page(path.read_text(encoding="utf-8"))
        (script,) = page.all("script")
        assert "".join(script.words) == SCRIPT and script.attributes == {"type": "module"}
        (policy,) = [e.attributes["content"] for e in page.all("meta") if "http-equiv" in e.attributes]
        digest = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
        rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
        assert rules["default-src"] == "'none'" and rules["script-src"] == f"'sha256-{digest}'"
        assert rules["img-src"] == "data:" and rules["base-uri"] == rules["form-action"] == "'none'"


def test_script_makes_text_of_text_and_opens_no_connection():
    addresses = re.findall(r"\w+://[^\"']*", SCRIPT)
    assert addresses == [SVG.strip("{}")]
    assert not re.search(
        r"</|innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|Function\(|fetch|XMLHttp", SCRIPT
    )


def test_names_in_the_descriptions_are_those_of_the_problem(hostile):
    page = Page(hostile.read_text(encoding="utf-8"))
    (figure,) = [e for e in page.all("figure") if e.attributes["id"] == "figure-fit-1"]
    panels = json.loads(figure.attributes["data-panels"])
    assert {c["experiment"] for p in panels for c in p["curves"]} == {NAME}
    assert panels[0]["y"]["label"] == "force [<b>N</b>]"


def test_script_and_descriptions_are_small(written, hostile, several_written):
    for path in (written, hostile, several_written):
        page = Page(path.read_text(encoding="utf-8"))
        described = [e.attributes["data-panels"] for e in page.all("figure")]
        assert all(described) and len(SCRIPT.encode()) + sum(len(d.encode()) for d in described) < MOST_BYTES


def test_page_is_complete_without_its_script(page):
    """Whatever the script adds is not there, and all figures are images with a text and a caption."""
    assert not page.all("button", "input", "fieldset", "output", "noscript")
    assert not [e.tag for e in page.elements if {"hidden", "onclick"} & e.attributes.keys()]
    assert len(page.all("figure")) == len(page.all("img")) == len(page.all("figcaption"))
