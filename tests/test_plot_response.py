"""Figures of response tables: what is drawn is the table, the branch and its folds."""

from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.diagnostics.response_curves import Quantity, curves
from tests.known import LINEAR, linear_experiment
from tests.response_tables import noisy, problem_of, swept, true_branch

F = np.linspace(0.1, 0.26, 20)


@cache
def solved():
    problem = problem_of(F, noisy(swept(F, "up"), 0.01, 5), "up")
    return problem, bp.map_estimate(problem, checks=False, progress=False)


def lines(axes, label):
    return [line for line in axes.lines if line.get_label() == label]


@pytest.mark.parametrize("word, size", [("peak-to-peak value", np.ptp), ("rms value", np.std)])
def test_sizes_along_a_branch_are_of_the_signal_between_the_points_too(word, size):
    coarse, fine = (2 * np.pi * np.arange(n) / n for n in (16, 40_000))
    wave = [np.cos(t + 0.3) + 0.4 * np.cos(2 * t + 1.0) for t in (coarse, fine)]
    assert Quantity(word, "x").of({"x": wave[0]}) == pytest.approx(size(wave[1]), rel=1e-7)


def test_every_residual_is_drawn_below_its_channel():
    problem, fit = solved()
    below = bp.plot.response(problem, fit).axes[0]
    shown = np.concatenate([line.get_ydata() for line in below.lines if line.get_marker() not in ("None", "")])
    white = np.concatenate(problem.likelihood.whitened(
        list(problem.density().linearise(problem.vector(fit.theta)).residuals), np.array(list(fit.noise.values()))
    ))  # fmt: skip
    observed = np.concatenate([np.full(b.size, b.observed) for b in problem.likelihood.blocks])
    assert np.sort(shown) == pytest.approx(np.sort(white[observed]), abs=1e-4)


def test_the_measured_table_and_both_folds_are_drawn():
    problem, fit = solved()
    _, amplitude, _ = bp.plot.response(problem, fit).axes
    (points,) = lines(amplitude, "measured, sweep up")
    assert points.get_xdata() == pytest.approx(F)
    assert points.get_ydata() == pytest.approx(np.abs(noisy(swept(F, "up"), 0.01, 5)), rel=1e-6)
    (folds,) = lines(amplitude, "fold")
    frequencies, _, turns = true_branch()
    assert folds.get_xdata() == pytest.approx(frequencies[turns], abs=2e-3)
    assert len(lines(amplitude, "jump")) == 1 and lines(amplitude, "MAP, unstable")


def test_the_branch_is_stable_outside_the_folds_and_unstable_between_them():
    problem, fit = solved()
    (curve,) = curves(problem, fit).values()
    low, high = sorted(curve.frequency[curve.folds])
    first, second = np.flatnonzero(curve.folds)
    between = np.arange(curve.frequency.size)
    between = (between > first) & (between < second)
    assert np.all(curve.stable[~between & ~curve.folds]) and not np.any(curve.stable[between])
    assert np.all((curve.frequency[between] > low) & (curve.frequency[between] < high))


def test_phases_are_drawn_beside_the_branch_without_jumps_of_a_turn():
    problem, fit = solved()
    _, _, phase = bp.plot.response(problem, fit).axes
    (points,) = lines(phase, "measured, sweep up")
    branch = np.concatenate([line.get_ydata() for line in lines(phase, "MAP")])
    assert np.ptp(points.get_ydata()) < 200.0
    assert np.nanmin(branch) - 20.0 < points.get_ydata().min() <= points.get_ydata().max() < np.nanmax(branch) + 20.0


def test_a_problem_without_a_table_is_refused():
    problem = bp.Problem(
        LINEAR, [linear_experiment(np.array([1e3, 10.0, 5.0]), 1.0, 1)], priors={"k": bp.LogNormal(1e3, 1.0)},
        fixed={"c": 10.0, "coulomb": 5.0},
    )  # fmt: skip
    fit = bp.map_estimate(problem, checks=False, progress=False)
    with pytest.raises(ValueError, match="must have experiments of a table of responses"):
        bp.plot.response(problem, fit)


def test_reports_show_the_table(tmp_path):
    problem, fit = solved()
    fit = bp.map_estimate(problem, start=fit.theta, progress=False)
    page = bp.report(problem, fit, None, tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'id="figure-response"' in page and "Measured responses over frequency" in page


def test_parts_of_the_branch_end_at_folds():
    """Folds have a multiplier of 1, whose rounding error does not decide how the part that ends there is drawn."""
    problem, fit = solved()
    (curve,) = curves(problem, fit).values()
    first, last = np.flatnonzero(curve.folds)
    for fold, before in ((first, True), (last, False)):
        assert curve.stable[fold - 1] == curve.stable[fold] == before and curve.stable[fold + 1] == (not before)
