"""Regions of corner plots contain their share of the draws, and are as large as those of the true density."""

import re
from dataclasses import replace

import corner
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.contour import ContourSet
from scipy.integrate import cumulative_trapezoid
from scipy.stats import multivariate_normal, norm

import bayesperiodic as bp
from bayesperiodic.plot import grid, regions
from bayesperiodic.plot.style import ENSEMBLES
from bayesperiodic.problem.parameters import support
from bayesperiodic.sampling.convergence import arviz
from bayesperiodic.sampling.population_density import Hierarchy
from bayesperiodic.sampling.population_result import parameter_attributes
from bayesperiodic.sampling.population_units import Coordinate
from tests.drawn import faults, population_of, posterior_of

COUNT = 20_000
REAL, POSITIVE = (-np.inf, np.inf), (0.0, np.inf)


def quadrature_area(density, x, y, probability):
    """Return the area of the region of highest density with this probability, by the midpoint rule."""
    cell = (x[1] - x[0]) * (y[1] - y[0])
    values = np.sort(density(*np.meshgrid(x, y, indexing="ij")), axis=None)[::-1]
    shares = np.cumsum(values) * cell
    assert shares[-1] == pytest.approx(1.0, abs=1e-3)
    return np.searchsorted(shares, probability) * cell


def product_ridge(generator, spread, width):
    """Return a = exp(s), b = exp(w − s) for normal s and w; dA = exp(w) ds dw."""
    s, w = spread * generator.standard_normal(COUNT), width * generator.standard_normal(COUNT)
    x, y = np.linspace(-6 * spread, 6 * spread, 501), np.linspace(-6 * width, 6 * width, 501)
    across, along = np.meshgrid(x, y, indexing="ij")
    density = norm.pdf(across, scale=spread) * norm.pdf(along, scale=width) * np.exp(-along)
    order, cell = np.argsort(density, axis=None)[::-1], (x[1] - x[0]) * (y[1] - y[0])
    areas = np.exp(along).ravel()[order] * cell
    shares = np.cumsum(density.ravel()[order] * areas)

    def area(probability):
        return areas[: np.searchsorted(shares, probability)].sum()

    return np.stack([np.exp(s), np.exp(w - s)], axis=-1), area


def banana(generator, width):
    """Return x and y = x² + w; the map from the normal x and w keeps areas."""
    x, w = generator.standard_normal((2, COUNT))
    return np.stack([x, x**2 + width * w], axis=-1), lambda p: -2.0 * np.log(1.0 - p) * np.pi * width


def two_normals(generator, centres, sds):
    """Return draws of two normal distributions with round contours, each with half of the mass."""
    which = generator.integers(2, size=COUNT)
    points = np.array(centres)[which] + np.array(sds)[which, None] * generator.standard_normal((COUNT, 2))

    def density(x, y):
        at = np.stack([x, y], axis=-1)
        return sum(0.5 * multivariate_normal(c, s**2).pdf(at) for c, s in zip(centres, sds, strict=True))

    reach = [np.linspace(*ends, 601) for ends in ((-6.0, 11.0), (-6.0, 6.0))]
    return points, lambda p: quadrature_area(density, *reach, p)


def mirrored(generator, sd):
    """Return two small normal distributions at (1, 1) and (−1, −1)."""
    sign = np.where(generator.integers(2, size=COUNT) == 1, 1.0, -1.0)
    points = sign[:, None] * (1.0 + sd * generator.standard_normal((COUNT, 2)))
    return points, lambda p: 2.0 * -2.0 * np.log(1.0 - p) * np.pi * sd**2


def truncated(generator, both):
    """Return half or a quarter of a normal distribution."""
    x, y = generator.standard_normal((2, COUNT))
    points = np.stack([np.abs(x), np.abs(y) if both else y + 0.5 * np.abs(x)], axis=-1)
    return points, lambda p: -2.0 * np.log(1.0 - p) * np.pi / (4 if both else 2)


def exponential(generator):
    """Return two exponential variables: the region is x + y < c, with 1 − (1 + c)·exp(−c) = p."""
    edges = {0.5: 1.678346990016661, 0.9: 3.889720169867429}
    return generator.exponential(size=(COUNT, 2)), lambda p: 0.5 * edges[p] ** 2


def correlated(generator, correlation):
    x, y = generator.standard_normal((2, COUNT))
    width = np.sqrt(1.0 - correlation**2)
    points = 5.0 + np.stack([x, correlation * x + width * y], axis=-1)
    return points, lambda p: -2.0 * np.log(1.0 - p) * np.pi * width


CASES = {
    "product ridge over one decade": (lambda g: product_ridge(g, 0.5, 0.02), POSITIVE, POSITIVE),
    "product ridge over three decades": (lambda g: product_ridge(g, 1.5, 0.002), POSITIVE, POSITIVE),
    "product ridge sampled in natural values": (lambda g: product_ridge(g, 0.5, 0.02), REAL, REAL),
    "banana": (lambda g: banana(g, 0.2), REAL, REAL),
    "thin banana": (lambda g: banana(g, 0.02), REAL, REAL),
    "two modes": (lambda g: two_normals(g, [(0.0, 0.0), (5.0, 1.0)], (1.0, 1.0)), REAL, REAL),
    "two modes of different widths": (lambda g: two_normals(g, [(0.0, 0.0), (5.0, 0.0)], (1.0, 0.2)), REAL, REAL),
    "mirrored sign": (lambda g: mirrored(g, 0.05), REAL, REAL),
    "mirrored sign, narrow": (lambda g: mirrored(g, 0.01), REAL, REAL),
    "truncated": (lambda g: truncated(g, both=False), (0.0, 9.0), REAL),
    "truncated twice": (lambda g: truncated(g, both=True), (0.0, np.inf), (0.0, 9.0)),
    "exponential": (exponential, POSITIVE, POSITIVE),
    "round": (lambda g: correlated(g, 0.0), REAL, REAL),
    "straight ridge": (lambda g: correlated(g, 0.9999), POSITIVE, POSITIVE),
}


CURVED = ("product ridge sampled in natural values", "thin banana")


def shoelace(polygon):
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


@pytest.mark.parametrize("case", CASES)
def test_regions_contain_their_share_of_the_draws_and_have_the_true_area(case):
    make, *supports = CASES[case]
    draws, area = make(np.random.default_rng(7))
    names = dict(zip("ab", draws.T, strict=True))
    figure = bp.plot.corner(posterior_of(names, dict(zip("ab", supports, strict=True))))
    for region, probability in zip(contours(figure.axes[2]), (0.9, 0.5), strict=True):
        (path,) = region.get_paths()
        assert path.contains_points(draws).mean() == pytest.approx(probability, abs=0.01)
        found = abs(sum(map(shoelace, path.to_polygons())))
        assert found == pytest.approx(area(probability), rel=0.15)
        assert len(path.to_polygons()) == 1 or case not in CURVED


@pytest.mark.parametrize("case", ["truncated twice", "exponential", "round"])
def test_marginal_densities_reach_the_end_of_the_support(case):
    make, first, _ = CASES[case]
    draws, _ = make(np.random.default_rng(3))
    found = regions.density(draws[:, :1], [first])
    exact = {"truncated twice": lambda x: 2.0 * norm.pdf(x), "exponential": lambda x: np.exp(-x)}
    density = exact.get(case, lambda x: norm.pdf(x, 5.0))(found.nodes[0])
    assert np.abs(found.values - density).max() < 0.08 * density.max()
    assert np.trapezoid(found.values, found.nodes[0]) == pytest.approx(1.0, abs=0.01)


def contours(axes):
    """Return the filled regions of a panel."""
    return [c for c in axes.collections if isinstance(c, ContourSet) and c.filled]


def test_each_optimum_has_its_own_regions_colour_and_number():
    draws, area = mirrored(np.random.default_rng(5), 1e-3)
    modes = (draws[:, 0] < 0.0).astype(np.int8)
    figure = bp.plot.corner(posterior_of({"a": draws[:, 0], "b": draws[:, 1]}, modes=modes))
    panel, first, second = figure.axes[2], *contours(figure.axes[2])[::2]
    assert not np.array_equal(first.get_facecolor(), second.get_facecolor())
    for region, mode in ((first, 0), (second, 1)):
        inside = region.get_paths()[0].contains_points(draws)
        assert inside[modes == mode].mean() == pytest.approx(0.9, abs=0.01) and not inside[modes != mode].any()
        found = abs(sum(map(shoelace, region.get_paths()[0].to_polygons())))
        assert found == pytest.approx(0.5 * area(0.9), rel=0.15)
    marks = {line.get_marker(): line.get_xydata()[0] for line in panel.lines if str(line.get_marker()).startswith("$")}
    assert marks["$0$"] == pytest.approx([1.0, 1.0], abs=1e-3) and marks["$1$"] == pytest.approx([-1, -1], abs=1e-3)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    share = 100.0 * np.mean(modes == 0)
    assert legend[0].startswith(f"optimum 0: {share:.1f} ±") and len(legend) == 2


def positions(axes, colour):
    """Return where lines of a colour cross the axes."""
    lines = [line for line in axes.lines if line.get_color() == colour]
    across = [line.get_xdata()[0] for line in lines if list(line.get_ydata()) == [0, 1]]
    return across, [line.get_ydata()[0] for line in lines if list(line.get_xdata()) == [0, 1]]


def test_zero_is_marked_where_the_sign_matters_and_truths_are_shown_also_beyond_the_draws():
    x, y = np.random.default_rng(2).standard_normal((2, 2000))
    figure = bp.plot.corner(posterior_of({"a": x, "b": 50.0 + y}), truths={"b": 70.0})
    top, _, panel, below = figure.axes
    assert positions(panel, "0.75") == ([0.0], []) and positions(top, "0.75") == ([0.0], [])
    assert positions(panel, "#000000") == ([], [70.0]) and positions(below, "#000000") == ([70.0], [])
    assert panel.get_ylim()[1] > 70.0 > 55.0 > panel.get_ylim()[0] > 40.0
    assert "truth" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_priors_are_thin_lines_on_the_diagonal(solved):
    problem, _, posterior = solved
    axes = bp.plot.corner(posterior, problem=problem, names=["k", "variance[force]"]).axes
    x, density = axes[0].lines[-1].get_data()
    assert density == pytest.approx(norm.pdf(x, 800.0, 60.0)) and axes[0].lines[-1].get_linewidth() < 1.0
    assert len(axes[3].lines) == 1
    with pytest.raises(ValueError, match="posterior: must be a result of this problem"):
        bp.plot.corner(posterior, problem=problem.with_experiments([replace(problem.experiments[0], name="other")]))


def test_labels_quantiles_and_titles_are_those_of_corner():
    x = np.random.default_rng(2).standard_normal(20_000)
    draws = {"a": 10.0 + 0.1 * x, "b": -x}
    figure = bp.plot.corner(posterior_of(draws), labels=["one", "two"], quantiles=[0.16, 0.84], show_titles=True)
    assert [figure.axes[k].get_xlabel() for k in (2, 3)] == ["one", "two"]
    dashed = [line.get_xdata()[0] for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    assert dashed == pytest.approx(np.quantile(draws["a"], [0.16, 0.84]))
    value, more, less = map(float, re.findall(r"[\d.]+", figure.axes[0].get_title()))
    assert [value, value + more, value - less] == pytest.approx(np.quantile(draws["a"], [0.5, 0.95, 0.05]), abs=0.006)
    for arguments, message in (
        ({"labels": ["one"]}, "labels: must be 2, one per name, got 1"),
        ({"quantiles": [16]}, r"quantiles: must be between 0 and 1, got \[16\]"),
    ):
        with pytest.raises(ValueError, match=message):
            bp.plot.corner(posterior_of(draws), **arguments)


@pytest.mark.parametrize(
    ("interval", "title"),
    [
        ((1.0, 2.0, 4.5), "$2.0^{+2.5}_{-1.0}$"),
        ((4.361e3, 9.912e3, 22.263e3), "$9900^{+12400}_{-5600}$"),
        ((-0.0016, -0.00001, 0.0016), "$0.0000^{+0.0016}_{-0.0016}$"),
        ((1.2e-9, 1.5e-9, 1.9e-9), r"$1.50^{+0.40}_{-0.30}$ $\times\,10^{-9}$"),
    ],
)
def test_titles_have_two_digits_of_the_shorter_error(interval, title):
    assert grid.with_errors(*interval) == title


def test_the_density_of_one_quantity_vanishes_in_the_tails():
    draws = np.exp(0.5 * np.random.default_rng(0).standard_normal(8000))[:, None]
    values = regions.density(draws, [POSITIVE]).values
    assert max(values[0], values[-1]) < 0.015 * values.max()


@pytest.mark.slow
def test_many_quantities_need_a_choice():
    draws = {f"p{k}": values for k, values in enumerate(np.random.default_rng(1).standard_normal((9, 400)))}
    with pytest.warns(UserWarning, match=r"names: 9 quantities are many for one figure; choose some, such as names="):
        bp.plot.corner(posterior_of(draws))
    assert len(bp.plot.corner(posterior_of(draws), names=[*draws]).axes) == 81


def test_figures_and_draws_work_with_corner_and_arviz(solved):
    _, _, posterior = solved
    names = ["k", "c"]
    figure = bp.plot.corner(posterior, names=names)
    corner.overplot_lines(figure, [800.0, None], color="C1")
    corner.overplot_points(figure, np.array([[800.0, 30.0]]), color="C1")
    assert positions(figure.axes[0], "C1")[0] == [800.0]
    assert figure.axes[2].lines[-1].get_xydata().tolist() == [[800.0, 30.0]]
    theirs = corner.corner(posterior.data, var_names=names, bins=10)
    assert [theirs.axes[k].get_xlabel() for k in (2, 3)] == names
    assert arviz().plot_pair(posterior.data, var_names=names) is not None


@pytest.mark.parametrize("style", ["regions", "corner"])
def test_populations_are_drawn_with_their_units_and_supports(style):
    generator = np.random.default_rng(2)
    draws = {"mean[a]": 1.0 + 0.1 * generator.standard_normal(4000), "spread[a]": generator.gamma(6.0, 0.05, 4000)}
    result = population_of(draws)
    figure = bp.plot.corner(result, style=style, truths={"spread[a]": 2.0})
    assert [figure.axes[k].get_xlabel() for k in (2, 3)] == ["mean[a]\n[m]", "spread[a]\n[m]"]
    low, high = figure.axes[2].get_ylim()
    assert low < np.quantile(draws["spread[a]"], 0.01) < 2.0 < high
    legend = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert "MCMC" in legend and "truth" in legend
    if style == "regions":
        x, density = figure.axes[3].lines[0].get_data()
        quartiles = np.quantile(draws["spread[a]"], [0.25, 0.5, 0.75])
        shares = np.interp(quartiles, x, cumulative_trapezoid(density, x, initial=0.0))
        assert shares == pytest.approx([0.25, 0.5, 0.75], abs=0.03)
    title = bp.plot.corner(replace(result, converged=False), style=style).legends[0].get_title().get_text()
    assert title == "NOT CONVERGED"


def test_the_attributes_of_a_population_are_those_of_its_parameters():
    """Logarithmic parameters have dimensionless spreads, slopes are per unit of the covariate."""
    spreads = {"k": bp.HalfNormal(0.1), "b": bp.Uniform(0.0, 2.0)}
    hierarchy = Hierarchy(("k", "b"), ("day",), spreads, {"k": 1.0, "b": 1.0}, True, np.inf)
    coordinates = [Coordinate(True, "N/m", POSITIVE), Coordinate(False, "m", REAL)]
    attributes = {label: [*parameter_attributes(hierarchy, coordinates, label).values()] for label in hierarchy.labels}
    assert attributes == {
        "mean[k]": ["N/m", [0.0, np.inf]],
        "mean[b]": ["m", [-np.inf, np.inf]],
        "slope[k, day]": ["1 per day", [-np.inf, np.inf]],
        "slope[b, day]": ["m per day", [-np.inf, np.inf]],
        "spread[k]": ["1", [0.0, np.inf]],
        "spread[b]": ["m", [0.0, 2.0]],
        "correlation[k, b]": ["1", [-1.0, 1.0]],
    }


def test_what_populations_do_not_have_is_refused(solved):
    problem, fit, _ = solved
    for argument in ({"laplace": fit}, {"problem": problem}):
        with pytest.raises(ValueError, match=f"{next(iter(argument))}: must be None for a Population"):
            bp.plot.corner(population_of({"mean[a]": np.arange(8.0)}), **argument)
    with pytest.raises(ValueError, match=r"name.*: .*mean\[a\]"):
        bp.plot.corner(population_of({"mean[a]": np.arange(8.0)}), names=["a"])


def two_quantities(seed, size=4000):
    a, b = np.random.default_rng(seed).standard_normal((2, size))
    return {"a": 10.0 + 0.1 * a, "b": 1e-7 * np.exp(b)}


def histogram(axes, number=0):
    """Return heights and edges of a step histogram."""
    x, y = axes.patches[number].get_xy().T
    return y[1:-1:2], np.append(x[1:-1:2], x[-1])


def test_the_style_corner_draws_histograms_and_quantiles_of_all_draws():
    draws = two_quantities(2)
    drawn = posterior_of(draws, units={"a": "m", "b": "kg"})
    figure = bp.plot.corner(drawn, style="corner", bins=30, quantiles=[0.16, 0.5, 0.84], show_titles=True)
    for place, name in ((0, "a"), (3, "b")):
        heights, edges = np.histogram(draws[name], bins=30, density=True)
        assert histogram(figure.axes[place])[0] == pytest.approx(heights)
        assert histogram(figure.axes[place])[1] == pytest.approx(edges)
        assert figure.axes[place].get_xlim() == pytest.approx((draws[name].min(), draws[name].max()))
        dashed = [line.get_xdata()[0] for line in figure.axes[place].lines]
        assert dashed == pytest.approx(np.quantile(draws[name], [0.16, 0.5, 0.84]))
        low, middle, high = np.quantile(draws[name], [0.05, 0.5, 0.95])
        assert figure.axes[place].get_title() == grid.with_errors(low, middle, high)
    points = figure.axes[2].lines[0].get_xydata()
    assert points == pytest.approx(np.stack([draws["a"], draws["b"]], axis=-1))
    assert [figure.axes[k].get_xlabel() for k in (2, 3)] == ["a\n[m]", "b\n[10⁻⁶ kg]"]
    assert faults(figure) == []


def test_the_style_corner_draws_several_posteriors_into_one_figure():
    first, second = two_quantities(3), two_quantities(4, size=1000)
    second["a"] += 1.0
    one = bp.plot.corner(posterior_of(first), style="corner", hist_kwargs={"label": "first"}, truths={"a": 10.0})
    both = bp.plot.corner(posterior_of(second), style="corner", fig=one)
    assert both is one and len(both.axes) == 4
    for number, draws in enumerate((first, second)):
        assert histogram(both.axes[0], number)[0] == pytest.approx(np.histogram(draws["a"], 20, density=True)[0])
    low, high = (f(np.append(first["a"], second["a"])) for f in (np.min, np.max))
    assert both.axes[0].get_xlim() == pytest.approx((low, high)) == both.axes[2].get_xlim()
    (legend,) = both.legends
    assert [text.get_text() for text in legend.get_texts()] == ["first", "MCMC 2", "truth"]
    colours = [line.get_color() for line in legend.get_lines()]
    assert [to_hex(colour).upper() for colour in colours] == [*ENSEMBLES[:2], "#000000"]
    assert faults(both) == []
    with pytest.raises(ValueError, match="figure: must have no axes or 1, got 4"):
        bp.plot.corner(posterior_of(first), style="corner", names=["a"], figure=both)


@pytest.mark.parametrize("names", [["a"], ["a", "b"]])
def test_the_style_corner_marks_truths_also_beyond_the_draws(names):
    draws = two_quantities(5)
    figure = bp.plot.corner(posterior_of(draws), style="corner", names=names, truths={"a": 12.0})
    assert positions(figure.axes[0], "#000000") == ([12.0], [])
    assert figure.axes[0].get_xlim()[1] > 12.0 and figure.axes[0].get_xlim()[0] == pytest.approx(draws["a"].min())
    if len(names) > 1:
        assert positions(figure.axes[2], "#000000") == ([12.0], []) and positions(figure.axes[3], "#000000") == ([], [])
        assert figure.axes[2].get_xlim() == figure.axes[0].get_xlim()
    assert faults(figure) == []


def test_options_of_the_other_style_are_refused(solved):
    problem, fit, posterior = solved
    for arguments, message in (
        ({"style": "histograms"}, "style: must be one of 'regions', 'corner', got 'histograms'"),
        ({"bins": 30, "smooth": 1.0}, "style: must be 'corner' for the options bins, smooth, got 'regions'"),
        ({"style": "corner", "laplace": fit}, "style: must be 'regions' for the options laplace, got 'corner'"),
        ({"style": "corner", "laplace": fit, "problem": problem}, "options laplace, problem, got 'corner'"),
        ({"style": "corner", "bin": 30}, "options: must be one of .*, got 'bin'. Did you mean 'bins'"),
        ({"truth": {"k": 1.0}}, "options: must be one of .*, got 'truth'. Did you mean 'truths'"),
    ):
        with pytest.raises(ValueError, match=message):
            bp.plot.corner(posterior, **arguments)
    constant = posterior_of({"a": np.full(40, 3.0), "b": np.linspace(0.0, 1.0, 40)})
    with pytest.raises(ValueError, match="names: must be quantities that vary, got a; leave them out"):
        bp.plot.corner(constant, style="corner")


def test_caveats_on_every_posterior_of_a_figure_are_stated():
    draws = two_quantities(6)
    figure = bp.plot.corner(replace(posterior_of(draws), converged=False), style="corner")
    bp.plot.corner(posterior_of(draws), style="corner", figure=figure)
    assert figure.legends[0].get_title().get_text() == "NOT CONVERGED"


def test_supports_are_stored_with_the_draws_and_guessed_without(solved):
    _, _, posterior = solved
    group = posterior.tree["posterior"].to_dataset()
    assert [support(group, name) for name in posterior.names] == [REAL, POSITIVE, REAL, POSITIVE]
    old = posterior_of({"a": np.arange(1.0, 9.0), "b": np.arange(-4.0, 4.0)}).tree["posterior"].to_dataset()
    assert [support(old, name) for name in "ab"] == [POSITIVE, REAL]


def test_quantities_that_do_not_vary_and_few_draws_are_drawn():
    draws = {"a": np.full(40, 3.0), "b": np.linspace(0.0, 1.0, 40)}
    bp.plot.corner(posterior_of(draws)).canvas.draw()


def test_the_style_is_applied_in_figures_only():
    before = dict(plt.rcParams)
    figure = bp.plot.marginals(posterior_of({"a": np.linspace(1.0, 2.0, 100)}))
    assert dict(plt.rcParams) == before
    figure.canvas.draw()
    sizes = {label.get_size() for label in figure.axes[0].get_xticklabels()}
    assert sizes == {8.0} != {plt.rcParams["font.size"]}
    with plt.style.context("bayesperiodic.plot.figures"):
        colours = {entry["color"].upper() for entry in plt.rcParams["axes.prop_cycle"]}
    assert colours == {*ENSEMBLES}
