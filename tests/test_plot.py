import matplotlib.pyplot as plt
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.plot import COLOURS


def labels(figure):
    return {text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text}


def test_fit_shows_units_the_band_and_the_residual(solved):
    problem, fit, posterior = solved
    figure = bp.plot.fit(problem, fit, bp.predict(problem, posterior))
    assert labels(figure) == {"force [N]", "residual [N]", "time in the period [s]"}
    legend = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert legend == ["90% predictive band", "measured, mean of 1 cycles", "MAP"]


def test_loops_are_closed_and_against_displacement_and_velocity(solved):
    problem, fit, _ = solved
    figure = bp.plot.loops(problem, fit)
    assert labels(figure) == {"x [m]", "rate of x [m/s]", "force [N]"}
    left, right = figure.axes
    x, y = right.lines[0].get_data()
    assert (x[0], y[0]) == (x[-1], y[-1])
    assert np.max(x) == pytest.approx(0.05 * 2 * np.pi * 2.0, rel=1e-3)
    with pytest.raises(ValueError, match="output: 'torque' is not known"):
        bp.plot.loops(problem, fit, output="torque")


def test_corner_draws_laplace_ellipses_where_the_draws_are(solved):
    _, fit, posterior = solved
    figure = bp.plot.corner(posterior, laplace=fit)
    axes = np.array(figure.axes).reshape(4, 4)
    (ellipse, wide) = axes[1, 0].patches[-2:]
    assert ellipse.center == (fit.theta["k"], fit.theta["c"])
    draws = np.stack([posterior.draws("k"), posterior.draws("c")], axis=-1)
    for patch, level in ((ellipse, 0.5), (wide, 0.9)):
        path = patch.get_patch_transform().transform_path(patch.get_path())
        assert path.contains_points(draws).mean() == pytest.approx(level, abs=0.04)
    assert axes[3, 0].get_xlabel() == "k [N/m]"


def test_traces_show_every_parameter_with_its_diagnostics(solved):
    _, _, posterior = solved
    figure = bp.plot.traces(posterior)
    assert len(figure.axes) == 4
    assert "R-hat" in figure.axes[0].texts[0].get_text()


def test_a_given_figure_is_used_and_returned(solved):
    problem, fit, posterior = solved
    for draw in (
        lambda f: bp.plot.fit(problem, fit, figure=f),
        lambda f: bp.plot.loops(problem, fit, figure=f),
        lambda f: bp.plot.corner(posterior, figure=f),
        lambda f: bp.plot.traces(posterior, figure=f),
    ):
        figure = plt.figure()
        assert draw(figure) is figure


def test_one_colour_means_one_thing():
    assert len(set(COLOURS.values())) == len(COLOURS)
