import os
import subprocess
import sys
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.contour import ContourSet
from matplotlib.path import Path

import bayesperiodic as bp
from bayesperiodic.plot import COLOURS
from bayesperiodic.problem.fingerprint import fingerprint
from tests.problems import quadratic_damping


def labels(figure):
    return {text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text}


def test_fit_shows_units_the_band_and_the_residual(solved):
    problem, fit, posterior = solved
    figure = bp.plot.fit(problem, fit, bp.predict(problem, posterior))
    assert labels(figure) == {"force [N]", "residual [N]", "time in the period [s]"}
    legend = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert legend == ["90 % predictive band", "measured, 1 cycle", "MAP"]


def test_fit_draws_the_experiments_asked_for_and_single_points_as_such(solved):
    problem, fit, _ = solved
    run = problem.experiments[0]
    mask = np.arange(40) % 4 == 1
    both = problem.with_experiments([run, replace(run, name="$x^$", mask=mask, independent={})])
    residuals = {e.name: fit.residuals["run"] for e in both.experiments}
    other, fit = fit, replace(fit, residuals=residuals, fingerprint=fingerprint(both))
    assert len(bp.plot.fit(both, fit).axes) == 4
    top, below = bp.plot.fit(both, fit, experiments=["$x^$"]).axes
    assert top.get_title() == r"\$x^\$"
    top.figure.canvas.draw()
    for line, values in ((top.lines[0], run.outputs["force"]), (below.lines[0], fit.residuals["run"]["force"])):
        assert (line.get_linestyle(), line.get_marker()) == ("None", "o")
        assert np.array_equal(line.get_xydata(), np.stack([run.time, values], axis=-1)[mask])
    points = bp.plot.loops(both, fit).axes[0].lines[2]
    assert np.array_equal(points.get_xydata(), np.stack([run.inputs["x"], run.outputs["force"]], axis=-1)[mask])
    with pytest.raises(ValueError, match="experiments: must be .*got 'walk'"):
        bp.plot.fit(problem, other, experiments=["walk"])


def test_loops_are_closed_and_against_displacement_and_velocity(solved):
    problem, fit, _ = solved
    figure = bp.plot.loops(problem, fit)
    assert labels(figure) == {"x [m]", "rate of x [m/s]", "force [N]"}
    left, right = figure.axes
    x, y = right.lines[0].get_data()
    assert (x[0], y[0]) == (x[-1], y[-1])
    assert np.max(x) == pytest.approx(0.05 * 2 * np.pi * 2.0, rel=1e-3)
    with pytest.raises(ValueError, match="output: must be .*got 'torque'"):
        bp.plot.loops(problem, fit, output="torque")


def test_corner_laplace_ellipses_cover_the_draws(solved):
    _, fit, posterior = solved
    figure = bp.plot.corner(posterior, laplace=fit)
    axes = np.array(figure.axes).reshape(4, 4)
    draws = np.stack([posterior.draws("k"), posterior.draws("c")], axis=-1)
    for line, level in zip(axes[1, 0].lines[-2:], (0.5, 0.9), strict=True):
        inside = Path(line.get_xydata()).contains_points(draws)
        assert inside.mean() == pytest.approx(level, abs=0.04)
        assert line.get_xydata()[:-1].mean(axis=0) == pytest.approx([fit.theta["k"], fit.theta["c"]])
    assert axes[3, 0].get_xlabel() == "k\n[N/m]"


@pytest.mark.parametrize(("middle", "spread"), [(-2.5, 1e-4), (4e7, 3e4)])
def test_corner_ticks_show_complete_values(solved, middle, spread):
    """Also for values that differ in their last digits only or are large, for which matplotlib prints offsets."""
    _, _, posterior = solved
    data = posterior.tree.copy()
    group = data["posterior"].to_dataset().map(lambda values: middle + spread * values / values.std())
    data["posterior"] = group.drop_attrs()
    figure = bp.plot.corner(replace(posterior, tree=data), names=["k", "c"])
    figure.canvas.draw()
    assert not [
        axis.get_offset_text().get_text()
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        if axis.get_offset_text().get_text()
    ]
    shown = [float(tick.get_text().replace("−", "-")) for tick in figure.axes[2].get_xticklabels() if tick.get_text()]
    assert shown and all(abs(value - middle) < 1000 * spread for value in shown)


@pytest.mark.parametrize("correlation", [0.0, 0.99])
def test_corner_draws_a_ridge_no_wider_than_it_is(solved, correlation):
    """Share of draws inside the 90 % contour; with 35 bins that of the ridge holds 96 % of them."""
    _, _, posterior = solved
    data, generator = posterior.tree.copy(), np.random.default_rng(5)
    shape = data["posterior"]["k"].shape
    one, other = generator.standard_normal((2, *shape))
    group = data["posterior"].to_dataset()
    group["k"] = (group["k"].dims, one)
    group["c"] = (group["c"].dims, correlation * one + np.sqrt(1 - correlation**2) * other)
    data["posterior"] = type(data)(group)
    ridge = replace(posterior, tree=data)
    axes = bp.plot.corner(ridge, names=["k", "c"]).axes[2]
    draws = np.stack([ridge.draws("k"), ridge.draws("c")], axis=-1)
    lines = next(c for c in axes.collections if isinstance(c, ContourSet) and not c.filled)
    inside = lines.get_paths()[0].contains_points(draws).mean()
    assert inside == pytest.approx(0.9, abs=0.03)


def test_corner_takes_the_noise_from_the_joint_laplace_approximation(solved):
    """In natural values v ± v·sd(ln v), whatever the prior, and whether variances belong to experiments or not."""
    _, fit, posterior = solved
    name = "variance[force]"
    joint = fit.joint_covariance * 9.0
    axes = bp.plot.corner(
        posterior, laplace=replace(fit, joint=replace(fit.joint, covariance=joint)), names=[name, "k"]
    ).axes
    values = axes[2].lines[-1].get_xydata()
    top = fit.joint_mode[name] * (1.0 + 3.0 * np.sqrt(fit.joint_covariance.loc[name, name] * -2.0 * np.log(0.1)))
    assert values[:, 0].max() == pytest.approx(top, rel=1e-3)
    assert np.ptp(values[:, 1]) == pytest.approx(2 * fit.sd["k"] * np.sqrt(-2.0 * np.log(0.1)), rel=1e-3)


def test_corner_draws_given_names_and_no_ellipse_without_an_approximation(solved):
    _, fit, posterior = solved
    figure = bp.plot.corner(posterior, laplace=fit, names=("coulomb", "k"))
    assert labels(figure) == {"k\n[N/m]", "coulomb\n[N]"}
    without = replace(fit, joint=replace(fit.joint, mode={}, covariance=fit.joint_covariance * np.nan))
    axes = np.array(bp.plot.corner(posterior, laplace=without).axes).reshape(4, 4)
    assert len(axes[1, 0].lines) == 2 and not axes[3, 0].lines
    assert len(bp.plot.corner(posterior, names=["k"]).axes[0].lines) == 1
    with pytest.raises(ValueError, match="names: must be one of 'k', 'c', .*got 'kk'"):
        bp.plot.corner(posterior, names=["kk"])
    for names in ("k", [], ["k", "k"]):
        with pytest.raises(ValueError, match="names: must be .*, got"):
            bp.plot.corner(posterior, names=names)
    with pytest.raises(ValueError, match="laplace: must be a result of this problem"):
        bp.plot.corner(posterior, laplace=replace(fit, fingerprint="model:1"))


def test_traces_show_every_parameter_with_its_diagnostics(solved):
    _, _, posterior = solved
    figure = bp.plot.traces(posterior)
    assert len(figure.axes) == 4
    assert "R-hat" in figure.axes[0].texts[0].get_text()


@pytest.fixture(scope="module")
def response():
    """Return a Duffing frequency response with two folds."""
    force = np.cos(2 * np.pi * np.arange(40) / 40)
    parameters = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
    start = bp.solve_periodic(
        bp.models.duffing, parameters, {"force": force}, frequency=0.1, samples=40, scheme="central4"
    )
    return bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, step=0.03, progress=False)


def lines(axes, style):
    return [line for line in axes.lines if line.get_linestyle() == style]


def test_branch_is_solid_where_stable_and_dashed_between_its_folds(response):
    figure = bp.plot.branch(response)
    (axes,) = figure.axes
    assert labels(figure) == {"frequency [Hz]", "amplitude of displacement [m]"}
    (dashed,) = lines(axes, "--")
    folds = [fold.frequency for fold in response.folds]
    assert sorted(dashed.get_xdata()[[0, -1]]) == sorted(folds)
    drawn = {*dashed.get_xdata(), *np.concatenate([line.get_xdata() for line in lines(axes, "-")])}
    assert drawn == set(response.values)
    (marked,) = [line for line in lines(axes, "None") if line.get_marker() == "o" and len(line.get_xdata())]
    assert list(marked.get_xdata()) == folds
    upper = response.folds[0].outputs["displacement"]
    assert marked.get_ydata()[0] == pytest.approx(np.ptp(upper) / 2)
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["stable", "unstable", "fold"]


def test_branches_have_their_own_colours_labels_and_marks(response):
    doubled = replace(response, kinds=("period doubling", *response.kinds[1:]))
    figure = bp.plot.branch(response, doubled, labels=["one", "other"], measure="period")
    (axes,) = figure.axes
    assert [t.get_text() for t in axes.get_legend().get_texts()] == [
        "one",
        "other",
        "stable",
        "unstable",
        "fold",
        "period doubling",
    ]
    assert len({line.get_color() for line in axes.lines}) == 2
    assert axes.lines[0].get_ydata()[0] == pytest.approx(1 / response.values[0])
    assert axes.get_ylabel() == "period [s]"


def test_rotations_are_drawn_by_their_section_points_without_their_turns():
    parameters = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
    phi = 2 * np.pi * (np.arange(80) / 80 + 3) - 0.4
    start = bp.solve_periodic(
        bp.models.pendulum,
        parameters,
        frequency=13 / (2 * np.pi),
        samples=80,
        scheme="central4",
        winding=1,
        guess={"phi": phi},
    )
    branch = bp.continue_periodic(bp.models.pendulum, start, "frequency", until=2.0, progress=False)
    section = bp.plot.branch(branch, measure="section", angular=True).axes[0]
    assert section.get_xlabel() == "angular frequency [rad/s]"
    assert section.lines[0].get_xdata()[0] == pytest.approx(13.0)
    assert section.lines[0].get_ydata()[0] == pytest.approx(-0.386461826143287, abs=1e-5)
    amplitude = bp.plot.branch(branch).axes[0].lines[0].get_ydata()
    assert 0.1 < amplitude[0] < 1.0
    own = bp.plot.branch(branch, measure=lambda s: [s.outputs["rate"].min(), s.outputs["rate"].max()]).axes[0]
    low, high = (line.get_ydata() for line in own.lines[:2])
    assert np.all(low < high)
    assert len(low) == len(branch)


def test_error_names_what_cannot_be_drawn_of_branches(response):
    with pytest.raises(ValueError, match="output: must be .*got 'force'"):
        bp.plot.branch(response, output="force")
    with pytest.raises(ValueError, match="measure: must be .*got 'size'"):
        bp.plot.branch(response, measure="size")
    with pytest.raises(ValueError, match="labels: must be 1, one per branch, got 2"):
        bp.plot.branch(response, labels=["a", "b"])
    with pytest.raises(ValueError, match="more: branches must all vary 'frequency', got .'k3'."):
        bp.plot.branch(response, replace(response, vary="k3"))


def test_branch_draws_into_given_axes(response):
    figure, (left, right) = plt.subplots(1, 2)
    assert bp.plot.branch(response, ax=right) is figure
    assert not left.lines and right.lines
    other = plt.figure()
    assert bp.plot.branch(response, figure=other) is other


def test_a_given_figure_is_used_and_returned(solved):
    problem, fit, posterior = solved
    for draw in (
        lambda f: bp.plot.fit(problem, fit, figure=f),
        lambda f: bp.plot.loops(problem, fit, figure=f),
        lambda f: bp.plot.corner(posterior, figure=f),
        lambda f: bp.plot.traces(posterior, figure=f),
        lambda f: bp.plot.marginals(posterior, figure=f),
        lambda f: bp.plot.comparison(bp.compare(problem, fit, posterior), figure=f),
    ):
        figure = plt.figure()
        assert draw(figure) is figure


def test_colours_have_one_meaning_across_plots():
    assert len(set(COLOURS.values())) == len(COLOURS)


def test_profiles_are_drawn_over_their_parabolas_with_the_level_of_the_interval(solved):
    problem, fit, _ = solved
    profile = bp.profile(problem, fit)
    figure = bp.plot.profile(profile)
    assert labels(figure) == {"k [N/m]", "c [N s/m]", "coulomb [N]", "relative log-density"}
    for axes, name in zip(figure.axes, profile.names, strict=True):
        curve, peak, parabola, level = axes.lines
        assert (curve.get_color(), parabola.get_color()) == (COLOURS["map"], COLOURS["laplace"])
        assert parabola.get_linestyle() == "--"
        assert np.array_equal(curve.get_xydata(), np.stack([profile.values[name], profile.log_density[name]], axis=-1))
        assert peak.get_xydata().tolist() == [[fit.theta[name], 0.0]]
        low, high = fit.theta[name] + np.array([-1.0, 1.0]) * 1.6449 * fit.sd[name]
        assert np.interp([low, high], *parabola.get_data()) == pytest.approx(level.get_ydata(), abs=1e-3)
        assert [text.get_text() for text in axes.texts] == ["90 %"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["profile", "MAP", "Laplace"]
    assert len(bp.plot.profile(profile, names=["c"]).axes) == 1
    other = plt.figure()
    assert bp.plot.profile(profile, figure=other) is other
    with pytest.raises(ValueError, match="names: must be .*got 'kk'"):
        bp.plot.profile(profile, names=["kk"])


def test_open_failed_and_improved_profiles_are_distinguished(solved):
    problem, fit, _ = solved
    plain = bp.profile(problem, fit, ["c", "coulomb"])
    c, coulomb = plain.values["c"] ** 12, plain.values["coulomb"]
    profile = replace(
        plain,
        map=plain.map | {"c": c[6]},
        sd=plain.sd | {"c": np.inf},
        values={"c": c, "coulomb": coulomb},
        log_density={"c": np.zeros(c.size), "coulomb": np.where(coulomb > coulomb[-3], np.nan, -1.0)},
        limits=plain.limits | {"c": (c[0], c[-1])},
        improvement=1.0,
    )
    left, right = bp.plot.profile(profile).axes
    assert (left.get_xscale(), right.get_xscale()) == ("log", "linear")
    assert [text.get_text() for text in left.texts] == ["90 %", "flat"]
    assert len(left.lines) == 3
    marks = next(line for line in right.lines if line.get_marker() == "x")
    assert list(marks.get_xdata()) == list(coulomb[-2:])
    peak = next(line for line in right.lines if line.get_marker() == "o")
    assert list(peak.get_ydata()) == [-1.0]
    assert right.get_ylim()[0] < -5.0


def test_marginals_have_the_area_one_and_laplace_on_top(solved):
    _, fit, posterior = solved
    figure = bp.plot.marginals(posterior, laplace=fit)
    assert labels(figure) == {"k\n[N/m]", "c\n[N s/m]", "coulomb\n[N]", "variance[force]\n[N²]"}
    for axes, name in zip(figure.axes[:3], ("k", "c", "coulomb"), strict=True):
        values, edges, _ = axes.patches[0].get_data()
        assert np.sum(values * np.diff(edges)) == pytest.approx(1.0)
        assert [edges[0], edges[-1]] == pytest.approx(np.quantile(posterior.draws(name), [0.0005, 0.9995]))
        (normal,) = axes.lines
        assert (normal.get_color(), normal.get_linestyle()) == (COLOURS["laplace"], "--")
        x, density = normal.get_data()
        assert x[np.argmax(density)] == pytest.approx(fit.theta[name], abs=0.02 * fit.sd[name])
        assert density.max() == pytest.approx(1 / (fit.sd[name] * np.sqrt(2 * np.pi)), rel=1e-3)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["MCMC", "Laplace"]
    assert not bp.plot.marginals(posterior, names=["c"]).axes[0].lines
    with pytest.raises(ValueError, match="names: must be .*got 'kk'"):
        bp.plot.marginals(posterior, names=["kk"])


def test_a_comparison_shows_marginals_quantiles_and_coverage(solved):
    problem, fit, posterior = solved
    found = bp.compare(problem, fit, posterior)
    figure = bp.plot.comparison(found)
    *panels, quantiles, coverage = figure.axes
    assert [axes.get_title() for axes in panels] == ["fine"] * 3
    assert {axes.get_xlabel() for axes in panels} == {"k\n[N/m]", "c\n[N s/m]", "coulomb\n[N]"}
    diagonal, *curves = quantiles.lines
    assert len(curves) == 3 and [t.get_text() for t in quantiles.get_legend().get_texts()] == ["fine"]
    for line in curves:
        x, y = line.get_data()
        assert y[4:-4] == pytest.approx(x[4:-4], abs=0.25)
    line = next(line for line in coverage.lines if line.get_label() == "MCMC")
    assert np.array_equal(line.get_xydata(), np.stack([found.probabilities, found.shares], axis=-1))
    assert coverage.lines[-1].get_ydata() == pytest.approx([found.joint[f"share_{level}"] for level in (50, 90, 95)])
    assert len(bp.plot.comparison(found, names=["c"]).axes) == 3
    with pytest.raises(ValueError, match="names: must be .*got 'variance.force.'"):
        bp.plot.comparison(found, names=["variance[force]"])


def test_comparison_plot_names_the_verdict_and_the_coordinates(solved):
    problem, fit, posterior = solved
    found = bp.compare(problem, fit, replace(posterior, converged=False), coordinates="sampling")
    table = found.table.assign(verdict=["fine", "too wide", "fine", "wrong shape"])
    table.loc["k", "laplace_sd"] = np.inf
    figure = bp.plot.comparison(replace(found, table=table))
    *panels, quantiles, _ = figure.axes
    assert [axes.get_title() for axes in panels] == ["fine", "too wide", "fine", "wrong shape"]
    assert panels[1].get_xlabel() == "ln c\n(in N s/m)"
    assert not panels[0].lines
    assert {t.get_text() for t in quantiles.get_legend().get_texts()} == {
        "fine",
        "c: too wide",
        "variance[force]: wrong shape",
    }
    assert figure.subfigs[0].get_suptitle() == "NOT CONVERGED"


@pytest.fixture(scope="module")
def lacking():
    """Return a problem without its quadratic damping, the estimate, and what is missing."""
    problem, fit = quadratic_damping()
    wanted = {"equation of x": ["dx*abs(dx)", "x**5"]}
    found = bp.missing_terms(problem, fit, wanted, equations=False, outputs=False)
    return problem, fit, found


def test_missing_terms_show_what_each_leaves_and_the_residual_against_its_variable(lacking):
    problem, fit, found = lacking
    left, before, with_it = bp.plot.missing_terms(problem, fit, found).axes
    names = [t.get_text() for t in left.get_yticklabels()]
    assert names == ["given model", "+ dx*abs(dx)\nin equation of x"] and left.get_xscale() == "log"
    held_out, own = (line.get_xdata() for line in left.lines)
    assert held_out.tolist() == [found.before.held_out, found.steps[0].held_out]
    assert own.tolist() == [fit.fvu["displacement"], found.steps[0].unexplained["displacement"]]
    assert before.get_xlabel() == "rate of x [m/s]" and with_it.get_title() == "with dx*abs(dx)"
    assert before.get_ylabel() == "residual of displacement in run 0 [m]" and before.get_ylim() == with_it.get_ylim()
    speed = fit.solutions["run 0"].states["x"]
    rate = np.gradient(np.tile(speed, 3), 1 / 64 / 0.12)[64:128]
    for axes, estimate in ((before, fit), (with_it, found.fit())):
        x, y = axes.lines[1].get_data()
        assert np.array_equal(y, estimate.residuals["run 0"]["displacement"])
        assert x == pytest.approx(rate, abs=0.02 * np.ptp(rate))


def test_missing_terms_of_two_variables_are_drawn_by_colour(lacking):
    problem, fit, found = lacking
    x, dx = (problem.model.state_symbols[name] for name in ("x", "dx"))
    [(name, (term, width))] = found._terms.items()
    for expression in (dx * x**2, x**2 * dx):
        other = replace(found, _terms={name: (replace(term, expression=expression), width)})
        axes = bp.plot.missing_terms(problem, fit, other).axes[1:]
        assert [a.get_xlabel() for a in axes] == ["x [m]", "x [m]", ""] and axes[2].get_ylabel() == "rate of x [m/s]"
        (points,) = axes[0].collections
        assert np.array_equal(points.get_offsets()[:, 1], fit.residuals["run 0"]["displacement"])


def test_missing_terms_without_any_or_of_another_problem(lacking, solved):
    problem, fit, found = lacking
    none = replace(found, steps=(), _terms={})
    left, right = bp.plot.missing_terms(problem, fit, none).axes
    assert right.get_xlabel() == "time in the period [s]" and len(left.get_yticks()) == 1
    with pytest.raises(ValueError, match="found: must be what missing_terms.* returns for this problem"):
        bp.plot.missing_terms(*solved[:2], found)


def test_a_backend_that_switches_on_the_display_of_figures_when_it_is_loaded_keeps_it_on(tmp_path):
    backend = "import matplotlib\nfrom matplotlib.backends.backend_agg import *\nmatplotlib.interactive(True)\n"
    (tmp_path / "late_backend.py").write_text(backend, "utf-8")
    code = (
        "import matplotlib.pyplot as plt\nfrom bayesperiodic.plot.style import styled\n"
        "styled(plt.figure)()\nprint(plt.isinteractive())"
    )
    path = os.pathsep.join([str(tmp_path), *sys.path])
    environment = os.environ | {"MPLBACKEND": "module://late_backend", "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
