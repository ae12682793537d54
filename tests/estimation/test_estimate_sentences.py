"""When an estimate gives a warning and what that says; ends of profile intervals; whiteness and the split of noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from bayesperiodic.estimation import check, map_estimate, profile
from bayesperiodic.estimation.climbs import pooled
from bayesperiodic.estimation.modes import Mode
from bayesperiodic.estimation.result import FitCheck, MapEstimate, NoiseSplit
from bayesperiodic.estimation.unexplained import of_periodogram
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers


def fitted(**changes):
    """Return an estimate of a and b with one channel y that needs no warning."""
    given = {
        "other_orbits": {}, "input_noise": {"y": 0.0}, "rms": {"y": 2.0}, "without_noise": (),
        "doubling_shift": {"a": 0.0, "b": np.nan}, "at_ends": (), "theta": {"a": 1.25, "b": 3.0},
        "prior_conflict": SimpleNamespace(text=""), "fvu": {"y": 0.1}, "converged": True, "other_modes": (),
        "undetermined": (), "noise_split": {}, "input_errors": {}, "input_nonlinearity": {"a": 0.29, "b": 0.0},
        "checks": True, "over_logarithm": {}, "misspecified": False, "noisy_inputs": False, "_on_frequencies": list,
        "solutions": {},
    }  # fmt: skip
    return SimpleNamespace(**(given | changes))


def problem(rates=0, noise="exact"):
    return SimpleNamespace(
        names=("a", "b"),
        free_noise=("variance[y]",),
        logarithmic=np.array([True, False]),
        input_noise=noise,
        model=SimpleNamespace(autonomous=False, input_derivatives=lambda: {"u": rates} if rates else {}),
        experiments=[
            SimpleNamespace(samples=40, sweep=None, measurements=()),
            SimpleNamespace(samples=64, sweep=None, measurements=()),
        ],
        joint_prior=SimpleNamespace(supports={"a": (0.0, 5.0), "b": (-np.inf, np.inf)}),
    )


def warnings_of(rates=0, noise="exact", **changes):
    return list(map_estimate.estimation_warnings(problem(rates, noise), fitted(**changes)))


def test_a_good_estimate_has_no_warning():
    assert warnings_of() == []


def test_another_orbit_is_named():
    (text,) = warnings_of(other_orbits={"run": "it has half the period"})
    assert text.startswith(
        "Experiment 'run' was fitted by another orbit than the recorded one: it has half the period."
    )


@pytest.mark.parametrize(("rates", "how"), [(0, ""), (1, ", differentiated,")])
def test_noise_of_the_inputs_counts_from_a_tenth_of_the_residual_on(rates, how):
    (text,) = warnings_of(rates, input_noise={"y": 0.21})
    assert text == (
        f"The noise of the measured inputs{how} causes 0.21 in 'y', 10% of the residual's 2, but the inputs are taken "
        "as exact. Take input_noise='measured', which needs at least 2 cycles, or give the noise in input_noise={…}."
    )
    assert warnings_of(rates, input_noise={"y": 0.2}) == []
    assert warnings_of(rates, "measured", input_noise={"y": 0.21}) == []


def test_errors_of_inputs_that_are_not_linear_are_named_by_the_largest_or_a_failed_solve():
    (text,) = warnings_of(input_nonlinearity={"a": 0.31, "b": 0.2})
    assert "changes 'a' by 0.31 of its standard deviation. Average more cycles, or compare with input_noise=" in text
    (text,) = warnings_of(input_nonlinearity={"a": 0.31, "b": np.nan})
    assert "changes 'b' by nan" in text


def test_shifts_by_a_tenth_of_an_sd_are_named_by_the_largest():
    (text,) = warnings_of(doubling_shift={"a": 0.11, "b": -0.456})
    assert text == (
        "Twice as many points would move 'b' by -0.46 of its standard deviation; take more samples than 64, or a "
        "scheme of higher order."
    )
    assert warnings_of(doubling_shift={"a": 0.1, "b": -0.1}) == []
    (text,) = warnings_of(doubling_shift={"a": 9.0}, without_noise=("y",))
    assert text.startswith("The data of 'y' contain no noise: the residual's rms of 2 is a rounding error")
    assert text.endswith("or give its variance, fixed={'variance[y]': …}.")


def test_ends_of_the_support_and_conflicts_are_named():
    (text,) = warnings_of(at_ends=("a",))
    assert text.startswith("The estimate of 'a', 1.25, lies at the end of its prior's support (0, 5); standard")
    (text,) = warnings_of(prior_conflict=SimpleNamespace(text="Prior and data disagree"))
    assert text.startswith("Prior and data disagree. The estimate is a compromise")


def test_unexplained_variance_counts_from_one_half_on_unless_it_is_measured_noise(monkeypatch):
    monkeypatch.setattr(check, "unit_error", lambda problem: "Check the units.")
    first, units = warnings_of(fvu={"y": 0.512})
    assert first.startswith("The estimate leaves 51.2% of the variance of 'y' unexplained. If this is not noise")
    assert units == "Check the units."
    assert warnings_of(fvu={"y": 0.5}) == []
    assert warnings_of(fvu={"y": 0.6}, noise_split={"y": NoiseSplit(2.0, 1.9, 3.0)}) == ["Check the units."]
    assert len(warnings_of(fvu={"y": 0.6}, noise_split={"y": NoiseSplit(2.0, 2.0, 3.0)})) == 2
    assert warnings_of(converged=False) == ["Check the units."]


def test_other_optima_are_listed_up_to_three():
    modes = tuple(Mode({"a": float(i)}, {"a": 0.1}, 0.0, mass, {}, pd.DataFrame()) for i, mass in enumerate([0.1] * 4))
    (text,) = warnings_of(other_modes=modes, modes=pd.DataFrame({"mass": [0.6, *[0.1] * 4]}))
    assert text.startswith(
        "5 separate optima fit the data: the estimate, with 60% of the posterior mass by Laplace, and"
    )
    assert "a = 2 (" in text and "a = 3 (" not in text


def test_parameters_without_effect_and_directions_are_named():
    found = warnings_of(
        undetermined=("b: no output depends on it", "a combination of a and b", "a -> a·t, b -> b + t", "a -> a + t")
    )
    assert found[0] == "The data do not depend on 'b'; its posterior equals its prior. Fix it."
    assert found[1].startswith("The data do not determine a combination of a and b: near the estimate")
    assert found[2].startswith("The data do not change under a -> a·t, b -> b + t; or under a -> a + t, for any t.")
    assert found[2].endswith("or report the combination that does not change.") and len(found) == 3
    (text,) = warnings_of(undetermined=("a -> a·t, b -> b·t^-1",))
    assert text.endswith(" b: LogNormal priors, if the signs are known, make sampling easier.")
    (text,) = warnings_of(undetermined=("a -> a + 1·x", "a -> a + 2·x", "a -> a + 3·x", "a -> a + 4·x", "a -> a + 5·x"))
    assert "a -> a + 3·x; and 2 more, for any t." in text


def test_noise_parameters_are_named_in_short_without_the_word_variance():
    assert [map_estimate._short(name) for name in ("variance[y, run]", "scale", "floor[y]")] == [
        "y, run",
        "scale",
        "floor[y]",
    ]


def test_root_mean_square_is_pooled_over_the_measured_points():
    experiments = [
        SimpleNamespace(name="one", outputs={"y": 0}, measured_points=np.ones(3, dtype=bool)),
        SimpleNamespace(name="two", outputs={"y": 0}, measured_points=np.array([True, False])),
        SimpleNamespace(name="three", outputs={}),
    ]
    signals = {"one": {"y": np.array([1.0, 2.0, 3.0])}, "two": {"y": np.array([4.0, 50.0])}, "three": {}}
    found = pooled(SimpleNamespace(experiments=experiments), "y", signals)
    assert found == pytest.approx(np.sqrt((1 + 4 + 9 + 16) / 4))


def test_whiteness_is_the_distance_of_the_cumulative_periodogram():
    power = np.array([4.0, 1.0, 2.0, 0.5])
    found = of_periodogram(power)
    assert found.p == pytest.approx(stats.kstest(np.array([4.0, 5.0, 7.0]) / 7.5, "uniform").pvalue)
    assert found.lag1 == pytest.approx(power @ np.cos(2 * np.pi / 9 * np.arange(1, 5)) / 7.5)
    for nothing in (np.zeros(3), np.ones(1)):
        assert np.isnan([of_periodogram(nothing).p, of_periodogram(nothing).lag1]).all()


def test_noise_is_split_by_channel_and_whiteness_is_corrected_for_the_experiments():
    def block(channel, measured, kind=MeanPeriod):
        harmonic = [np.array([0, 1, 1, 2, 2, 3, 3])] if kind is MeanPeriod else []
        return kind("run", channel, 6.6, 7, *harmonic, measured=measured)

    generator = np.random.default_rng(0)
    blocks = [block("y", 0.1), block("y", 0.3), block("z", 50.0), block("w", 1.0, Multipliers)]
    residuals = list(generator.standard_normal((4, 7)))
    likelihood = SimpleNamespace(blocks=blocks, whitened=lambda vectors, noise: vectors)
    given = SimpleNamespace(channels=("y", "z", "w"), likelihood=likelihood)
    derivatives = [np.zeros((1, 7))] * 4
    estimate = SimpleNamespace(here=SimpleNamespace(residuals=residuals, jacobian=derivatives), noise=None)
    split = check.noise_split(given, estimate.here.residuals, np.array([0.9, 0.7, 0.5, 1.0]))
    total = (residuals[0] @ residuals[0] + residuals[1] @ residuals[1]) / (7 * 0.9 + 7 * 0.7)
    assert list(split) == ["y", "z"]
    expected = NoiseSplit(np.sqrt(0.2), np.sqrt(total - 0.2), np.sqrt(total))
    assert (split["y"].measurement, split["y"].model, split["y"].total) == pytest.approx(
        (expected.measurement, expected.model, expected.total)
    )
    assert (split["z"].measurement, split["z"].model) == pytest.approx((np.sqrt(50.0), 0.0))
    white = check.channel_whiteness(given, estimate)
    each = [of_periodogram(np.bincount([0, 1, 1, 2, 2, 3, 3], r**2)[1:]) for r in residuals[:2]]
    assert white["y"].p == pytest.approx(min(1.0, 2 * min(e.p for e in each)))
    assert white["y"].lag1 == pytest.approx(np.mean([e.lag1 for e in each]))
    assert np.isnan([white["w"].p, white["w"].lag1]).all()


def test_end_of_an_interval_is_where_the_roots_cross_the_level():
    values = np.array([-3.0, -1.0, 0.0, 1.0, 2.0, 4.0])
    roots = np.abs(values)
    assert profile._crossing(values, roots, 1.7, np.inf) == pytest.approx(1.7)
    assert profile._crossing(values, roots, 2.0, np.inf) == pytest.approx(2.0)
    assert profile._crossing(values, roots, 4.5, 4.0) == np.inf
    assert np.isnan(profile._crossing(values, roots, 4.5, np.inf))
    assert profile._crossing(values, np.array([3.0, 1.0, 0.0, np.nan, 2.0, 4.0]), 1.0, np.inf) == pytest.approx(1.0)
    assert np.isnan(profile._crossing(values, roots + 2.0, 1.0, np.inf))
    # Of two crossings the last one counts.
    again = profile._crossing(values, np.array([3.0, 1.0, 0.0, 3.0, 1.0, 3.0]), 1.5, np.inf)
    assert 2.0 < again < 4.0


def test_steps_end_nine_tenths_of_the_way_to_the_end_or_at_the_limit():
    assert profile._next(1.0, 50.0, np.inf, np.inf) == 51.0
    assert profile._next(1.0, 50.0, 11.0, 10.5) == pytest.approx(10.0)
    assert profile._next(1.0, 50.0, 11.0, 9.0) == 9.0
    assert profile._next(1.0, 0.5, 11.0, 9.0) == 1.5
    assert profile._next(1.0, -50.0, 0.0, 0.01) == pytest.approx(0.1)
    assert profile._next(1.0, -50.0, -np.inf, -np.inf) == -49.0
    assert profile._root(3.0, SimpleNamespace(objective=1.0)) == pytest.approx(2.0)
    assert profile._root(1.0, SimpleNamespace(objective=3.0)) == 0.0


def test_a_printed_estimate_lists_what_is_known_of_it():
    checks = FitCheck(
        robust_sd={"a": 0.0612, "b": 0.4}, whiteness={"y": SimpleNamespace(p=0.0321), "z": SimpleNamespace(p=np.nan)},
        noise_split={"y": NoiseSplit(1.5, 1.25, 2.0), "z": NoiseSplit(np.nan, 1.0, 1.0)}, input_noise={},
        input_nonlinearity={}, doubling_shift={"a": 0.01, "b": np.nan}, prior_conflict=SimpleNamespace(text=""),
        undetermined=(),
    )  # fmt: skip
    fit = fitted(
        status="converged", sd={"a": 0.0512, "b": 0.3}, checks=checks, rms={"y": 2.0, "z": 0.5},
        noise={"variance[y]": 4.0, "variance[z]": 0.25}, noise_prior="prior 1/v", fvu={"y": 0.1234, "z": 0.5},
    )  # fmt: skip
    table = [
        "            estimate Laplace sd robust sd",
        "a               1.25     0.0512    0.0612",
        "b                  3        0.3       0.4",
    ]
    noise = ["variance[y]        4          -         -", "variance[z]     0.25          -         -"]
    residuals = [
        "Residuals",
        "   rms unexplained variance measurement noise model error whiteness p",
        "y    2               12.34%               1.5        1.25       0.032",
        "z  0.5               50.00%                 -           -           -",
    ]
    untested = "Whiteness of 'z' is not tested: the parameters leave fewer than two harmonics."
    expected = ["MapEstimate (converged)", *table, *noise, *residuals, "The noise has the prior 1/v.", untested]
    assert MapEstimate.__repr__(fit).split("\n") == expected
    fit.converged, fit.status, fit.noise = False, "stalled", {}
    fit.other_orbits, checks.prior_conflict.text = {"run": "half the period"}, "Prior and data disagree"
    fit.checks = replace(checks, undetermined=("a: no output depends on it",))
    fit.other_modes = (
        Mode({"a": 2.0}, {"a": 0.1}, -1.0, 0.2, {}, pd.DataFrame()),
        Mode({"a": 3.0}, {"a": 0.1}, -1.0, 0.001, {}, pd.DataFrame()),
    )
    assert MapEstimate.__repr__(fit).split("\n") == [
        "MapEstimate (NOT CONVERGED: stalled; try another start, or starts=8)",
        *["  estimate Laplace sd robust sd", "a     1.25     0.0512    0.0612", "b        3        0.3       0.4"],
        *residuals,
        "The orbit is another one than the recorded one in 'run': half the period.",
        "Prior and data disagree.",
        untested,
        "Not determined by the data: a: no output depends on it.",
        "Another optimum: a = 2 (objective -1, 20.0% of the mass).",
    ]
    fit.without_noise = ("y", "z")
    assert MapEstimate.__repr__(fit).startswith("MapEstimate (stalled; y, z without noise)\n")
    assert repr(fit.checks).split("\n") == [
        "FitCheck", "  robust sd shift on twice the points", "a    0.0612                      0.01",
        "b       0.4                       nan", "Residuals", "  measurement noise model error whiteness p",
        "y               1.5        1.25       0.032", "z                 -           -           -",
        "Prior and data disagree.", untested, "Not determined by the data: a: no output depends on it.",
    ]  # fmt: skip
    fit.checks = None
    lines = MapEstimate.__repr__(fit).split("\n")
    assert lines[1:3] == ["  estimate Laplace sd", "a     1.25     0.0512"]
    assert "Not checked, see bp.check(problem, fit)." in lines


def test_channels_of_rounding_errors_are_without_noise_if_their_variance_is_unknown():
    fit = fitted(independent={"y": 9.0, "z, run": 9.0}, fvu={"y": 0.9e-16, "z": 0.9e-16, "w": 0.0, "v": 1.1e-16})
    assert MapEstimate.without_noise.fget(fit) == ("y", "z")
    fit.independent = {"relative": 18.0}  # of all channels
    assert MapEstimate.without_noise.fget(fit) == ("y", "z", "w")


@pytest.mark.parametrize("shift, named", [(-7.66, True), (1.01, True), (0.99, False), (np.nan, False)])
def test_a_misfit_names_the_grid_where_this_moves_the_estimate(shift, named):
    wrong = "The model is misspecified (x)"
    text = check._of_grid(wrong, ["a", "b"], np.array([0.1, shift]))
    assert (text != wrong) == named and check._of_grid("", ["a", "b"], np.array([0.1, shift])) == ""
    if named:
        assert text.startswith(f"{wrong}. The error of the grid may be the cause: twice as many points would move 'b' ")
        assert f"by {shift:.2g} of its standard deviation; first take more samples" in text


def test_frequencies_that_model_and_data_determine_better_than_the_recording_are_listed_up_to_three():
    """By less than four fifths of the standard error of the recording."""
    names = ["one", "two", "three", "four", "five"]
    columns = {"estimate": 1.0, "sd": [0.079, 0.081, 0.01, 0.02, 0.03], "measured": 1.5, "se": 0.1}
    table = pd.DataFrame(columns, index=names)
    fit = SimpleNamespace(frequencies=table, input_errors={"one": None})
    (text,) = MapEstimate._on_frequencies(fit)
    assert text == (
        "Frequencies by data and model: 1 ± 0.079 Hz in 'one' (recording: 1.5 ± 0.1 Hz), 1 ± 0.01 Hz in 'three' "
        "(recording: 1.5 ± 0.1 Hz), 1 ± 0.02 Hz in 'four' (recording: 1.5 ± 0.1 Hz) and 1 more."
    )
    fit.frequencies = table[:4]
    assert MapEstimate._on_frequencies(fit)[0].endswith("in 'four' (recording: 1.5 ± 0.1 Hz).")
    for nothing in (table[1:2], None):
        fit.frequencies = nothing
        assert MapEstimate._on_frequencies(fit) == []
    assert MapEstimate._on_frequencies(SimpleNamespace(frequencies=table, input_errors={})) == []
