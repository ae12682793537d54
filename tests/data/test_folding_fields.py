"""Fields of folded recordings, one by one, for a given pace and groups of channels with times of their own."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from bayesperiodic.data import folding
from bayesperiodic.data.groups import fit_groups
from bayesperiodic.data.harmonics import HarmonicFit, Pace, followed_phase
from bayesperiodic.data.lines import Sampling
from bayesperiodic.data.recording_check import RUINOUS, SERIOUS, Finding
from bayesperiodic.data.signals import Signals


def two_groups():
    """Return an input and an output x of 24 samples a cycle, and y of 16, which begins 0.3 s later; 1.25 Hz."""
    generator = np.random.default_rng(2)
    fast, slow = np.arange(24 * 16) / 30.0, 0.3 + np.arange(16 * 15) / 20.0
    u = np.cos(2 * np.pi * 1.25 * fast) + 1e-3 * generator.standard_normal(fast.size)
    x = 0.5 + np.cos(2 * np.pi * 1.25 * fast + 0.4) + 0.02 * generator.standard_normal(fast.size)
    y = 2.0 * np.sin(2 * np.pi * 1.25 * slow) + 0.02 * generator.standard_normal(slow.size)
    return [
        Signals("record", fast, ("u", "x"), np.array([u, x]), 1), Signals("record", slow, ("y",), y[None], 0),
    ]  # fmt: skip


def folded(groups, pace=None, given=None, origin=0.0, periods=1, findings=(), harmonics=None):
    """Return the fields of `fold_signals`, with a pace and findings in place of those of the signals."""
    original = folding.inspect_clocks

    def inspected(*arguments):
        seen, others = original(*arguments)
        return replace(seen, pace=seen.pace if pace is None else pace, findings=findings), others

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folding, "inspect_clocks", inspected)
        return folding.fold_signals(groups, 16, periods, given, harmonics, origin, None)


@pytest.mark.parametrize("periods", [1, 2])
def test_pace_of_the_fold_is_that_of_the_forcing(periods):
    """Of p forcing periods in a response period: frequency and error p times as large, the diffusion (2π p)² f q."""
    (group, _) = two_groups()
    free = replace(group.part(slice(None)), channels=("v", "x"), inputs=0)
    pace = Pace(1e-4, 10, 0.002, False, 0.0, 1e-9)
    seen = folded([free], pace, periods=periods)
    rate = seen["frequency"] / periods
    assert rate == pytest.approx(1.25, rel=1e-3) and seen["frequency_se"] == pytest.approx(1e-4 * periods)
    assert seen["phase_diffusion"] == pytest.approx((2 * np.pi * periods) ** 2 * 1e-9 * rate)
    assert seen["period_drift"] == -0.002
    exact = folded([free], replace(pace, se=0.9e-12 * rate / periods), periods=periods)
    assert exact["frequency_se"] == exact["phase_diffusion"] == 0.0  # rounding
    given = folded([free], pace, given=(1.25 * periods, 3e-4), periods=periods)
    assert (given["frequency"], given["frequency_se"], given["phase_diffusion"]) == (1.25 * periods, 3e-4, 0.0)


def test_fields_of_groups_with_times_of_their_own():
    groups = two_groups()
    seen = folded(
        groups, harmonics={"x": 2}, findings=(Finding("drift", "x", "harmless", np.zeros((1, 2)), 1, 1.0, 0.0, "t"),)
    )
    assert [*seen["outputs"]] == ["x", "y"] and [*seen["inputs"]] == ["u"]
    assert seen["harmonics"] == {"u": 1, "x": 2, "y": 1} and seen["independent"] == {"x": 5, "y": 3}
    assert {channel: value.size for channel, value in seen["amplitude_variance"].items()} == {"u": 2, "x": 3, "y": 2}
    assert {channel: value.size for channel, value in seen["amplitude_freedom"].items()} == {"u": 2, "x": 3, "y": 2}
    assert [*seen["left_out"]] == ["x", "y"] and seen["left_out"]["x"].harmonic[0] == 3
    assert seen["averaged"] <= 16 * seen["cycles"] < 24 * seen["cycles"] and 12 <= seen["cycles"] <= 15
    assert [one.kind for one in seen["findings"]] == ["drift"] and seen["clocks"] == {}
    # The middle of each group's samples; of both about the same, as their windows are the same.
    assert seen["middle"]["u"] == seen["middle"]["x"] != seen["middle"]["y"]
    assert seen["middle"]["x"] == pytest.approx(seen["middle"]["y"], abs=0.1)
    inside = groups[0].time[groups[0].time >= 0.3]
    assert inside[0] < seen["middle"]["x"] < inside[-1] and seen["middle"]["x"] > 0.4 * inside[-1]
    assert seen["drift"].keys() == {"u", "x", "y"} and seen["origin"] == 0.0
    later = folded(groups, origin=2.0)
    assert later["middle"]["x"] == pytest.approx(seen["middle"]["x"] - 2.0, abs=1e-9) and later["origin"] == 2.0
    turned = np.fft.rfft(later["outputs"]["x"])[1] / np.fft.rfft(seen["outputs"]["x"])[1]
    assert np.angle(turned * np.exp(-2j * np.pi * 1.25 * 2.0)) == pytest.approx(0.0, abs=1e-2)
    assert folded(groups, origin="crossing")["middle"] == {}


@pytest.mark.parametrize("clocks, severity", [("one", SERIOUS), (None, RUINOUS), ("auto", RUINOUS)])
def test_drifts_of_a_stated_clock_are_serious(clocks, severity):
    both = [Finding(kind, "x", RUINOUS, np.zeros((1, 2)), 1, 1.0, 0.0, "t") for kind in ("clock", "jump")]
    seen = folding._with_stated_clock(both, clocks)
    assert [one.severity for one in seen] == [severity, RUINOUS] and [one.kind for one in seen] == ["clock", "jump"]


def test_amplitudes_and_samples_are_collected_by_channel():
    parts = two_groups()
    each = [SimpleNamespace(amplitudes=np.array([[1.0, 2.0], [3.0, 4.0]])), SimpleNamespace(amplitudes=np.ones((1, 3)))]
    amplitudes, sizes = folding._by_channel(parts, SimpleNamespace(each=each))
    assert {channel: values.tolist() for channel, values in amplitudes.items()} == {
        "u": [1.0, 2.0], "x": [3.0, 4.0], "y": [1.0, 1.0, 1.0],
    }  # fmt: skip
    assert sizes == {"u": 24 * 16, "x": 24 * 16, "y": 16 * 15}


@pytest.mark.parametrize("orders", [2, 4, 9])
def test_noise_of_each_channel_has_its_transient_and_its_missing_phases(orders):
    """Of each channel: the variance at its harmonics times a factor, plus squares times the channel's variance."""
    groups = two_groups()
    parts = [groups[0].part(slice(24, None)), groups[1].part(slice(16, None))]
    fit = fit_groups(parts, 1.25, [5, 3])
    inflation = [np.arange(1.0, 7.0), 2.0]
    squares = np.arange(1.0, 3 * orders + 1).reshape(3, orders) * 1e-6
    for steady in (SimpleNamespace(squares=squares), None):
        seen = SimpleNamespace(groups=groups, inflation=inflation, steady=steady)
        one_cycle, noise = folding._noises(seen, parts, fit, 14)
        assert [*one_cycle] == [*noise] == ["u", "x", "y"]
        for row, channel in enumerate("uxy"):
            k, i = (0, row) if row < 2 else (1, 0)
            sampling = Sampling.of(parts[k].time, 1.25, [5, 3][k], 14)
            alone, of_mean = folding._noise(parts[k], fit.each[k], i, sampling)
            added = np.zeros(of_mean.variance.size)
            count = min(orders, added.size) if steady else 0
            added[:count] = squares[row, :count] * np.var(groups[k].values[i])
            np.testing.assert_allclose(noise[channel].variance, of_mean.variance * inflation[k] + added)
            np.testing.assert_allclose(one_cycle[channel], alone)
            # Of the second group the noise is turned to the first sample of the first one.
            turn = np.exp(2j * np.pi * 1.25 * (parts[0].time[0] - parts[k].time[0]) * np.arange(added.size))
            np.testing.assert_allclose(noise[channel].beside, of_mean.beside * turn)
            assert np.array_equal(noise[channel].freedom, of_mean.freedom)


def test_parts_are_fitted_at_the_given_frequency_or_at_the_followed_phase():
    groups = two_groups()
    free = [replace(groups[1], time=groups[1].time + 5.0)]
    limits = [3]
    fit = fit_groups(free, 1.2501, limits)
    steady, walks = Pace(1e-3, 10, 0.0, False), Pace(1e-3, 10, 0.0, False, 0.0, 1e-4)
    parts, given = folding._at_phases(free, fit, walks, 2, (2.5, 0.0), limits)
    assert parts is free and given.frequency == 1.25
    np.testing.assert_allclose(given.each[0].amplitudes, fit_groups(free, 1.25, limits).each[0].amplitudes)
    with pytest.raises(ValueError, match=r"^frequency: must be that of the recording, .* as 2.5002 Hz .* got 2.6 Hz"):
        folding._at_phases(free, fit, replace(steady, se=1e-5), 2, (2.6, 0.0), limits)
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folding, "_refuse_frequency", lambda *given: asked.append(given))
        _, other = folding._at_phases([free[0].part(slice(9)), *free], fit, steady, 2, (2.5, 0.3), [3, 3])
    assert asked == [(fit, other, steady, np.ptp(free[0].time), 2, 0.15)]
    assert folding._at_phases(free, fit, steady, 1, None, limits) == (free, fit)
    both = fit_groups(groups, 1.25, [3, 3])
    assert folding._at_phases(groups, both, walks, 1, None, [3, 3]) == (groups, both)
    driven = fit_groups(groups[:1], 1.25, [3])
    assert folding._at_phases(groups[:1], driven, walks, 1, None, [3])[1] is driven
    (moved,), again = folding._at_phases(free, fit, walks, 1, None, limits)
    ahead = followed_phase(free[0].time, free[0].values, fit.each[0], 1e-4)
    assert np.abs(ahead).max() > 1e-4 and again.frequency == 1.2501
    np.testing.assert_allclose(moved.time, free[0].time + ahead / 1.2501, rtol=1e-12)
    assert again.each[0].variances[0] < fit.each[0].variances[0]


@pytest.mark.parametrize("count", [40, 41, 120, 121])
@pytest.mark.parametrize(
    "answers", [[(3, "first")], [(None, "first"), (2, "again")], [(None, "first"), (None, "last")]]
)
def test_a_response_period_is_sought_in_the_later_half_too(count, answers, monkeypatch):
    """If this has six drive cycles at least, of ten samples here; without a period the first evidence counts."""
    time = 7.0 + np.arange(float(count))
    values = np.random.default_rng(1).standard_normal((2, count))
    calls = []

    def answer(*arguments):
        calls.append(arguments)
        return answers[len(calls) - 1]

    monkeypatch.setattr(folding, "response_period", answer)
    seen = folding._response_period(Signals("run", time, ("u", "x"), values, 1), 0.1)
    twice = answers[0][0] is None and count > 100
    assert len(calls) == 1 + twice and seen == ((2, "again") if twice and answers[1][0] else answers[0])
    assert np.array_equal(calls[0][0], time) and np.array_equal(calls[0][1], values)
    assert calls[0][2:] == (("u", "x"), 0.1)
    if twice:
        assert np.array_equal(calls[1][0], time[count // 2 :]) and np.array_equal(calls[1][1], values[:, count // 2 :])
        assert calls[1][2:] == (("u", "x"), 0.1, 6)


@pytest.mark.parametrize("count, sought", [(119, True), (118, False)])
def test_the_later_half_has_six_cycles_at_least(count, sought, monkeypatch):
    """Of 119 samples, ten in a cycle, the last 60."""
    calls = []
    monkeypatch.setattr(folding, "response_period", lambda *given: calls.append(given) or (None, None))
    signals = Signals("run", np.arange(float(count)), ("x",), np.arange(float(count))[None], 0)
    assert folding._response_period(signals, 0.1) == (None, None) and len(calls) == 1 + sought


def test_periods_of_several_groups_have_their_least_common_multiple(monkeypatch):
    groups = two_groups()
    answers = {"u": (4, "four"), "y": (6, "six")}
    monkeypatch.setattr(folding, "_response_period", lambda group, drive: answers[group.channels[0]])
    assert folding.automatic_periods(groups, 1.25) == (12, "six")
    assert folding.automatic_periods(groups[::-1], 1.25) == (12, "six")
    answers["y"] = (3, "three")
    assert folding.automatic_periods(groups, 1.25) == (12, "four")
    answers["y"] = (None, pd.DataFrame({"periods": [1], "between": [0.4], "channel": ["y"], "verdict": ["none"]}))
    with pytest.raises(
        ValueError, match=r"^recording: must be periodic, got 'record', .* 1 to 1 drive periods of 0.8 s"
    ):
        folding.automatic_periods(groups, 1.25)


def test_automatic_periods_are_those_of_the_drive(monkeypatch):
    """Its frequency is refined, and all groups are cut to the cycles that can be counted."""
    groups, seen = two_groups(), []
    monkeypatch.setattr(folding, "_response_period", lambda *given: seen.append(given) or (1, "one"))
    assert folding.automatic_periods(groups, None) == (1, "one")
    assert [drive for _, drive in seen] == pytest.approx([1.25, 1.25], rel=1e-4)
    assert all(np.array_equal(one.time, group.time) for (one, _), group in zip(seen, groups, strict=True))
    with pytest.raises(ValueError, match="^frequency: must be given for periods='auto', because 'record' has no input"):
        folding.automatic_periods(groups[1:], None)
    seen.clear()
    folding.automatic_periods(groups, 1.3)
    assert [drive for _, drive in seen] == [1.3, 1.3]


def test_fold_of_times_with_an_origin_and_of_asked_harmonics(monkeypatch):
    """The inspection gets times from the origin, the grid of all periods, and the most harmonics that are asked for."""
    seen = []

    def stop(*given):
        seen.append(given)
        raise InterruptedError

    monkeypatch.setattr(folding, "inspect_clocks", stop)
    groups = two_groups()
    for harmonics, most in ((None, 0), (5, 5), ({"x": 3, "y": 4}, 4)):
        with pytest.raises(InterruptedError):
            folding.fold_signals(groups, 20, 3, (1.25, 0.1), harmonics, 4.0, None, "one")
        given, clocks, periods, frequency, points, asked = seen.pop()
        assert (clocks, periods, frequency, points, asked) == ("one", 3, 1.25, 60, most)
        for one, group in zip(given, groups, strict=True):
            np.testing.assert_allclose(one.time, group.time - 4.0)
    for origin in (0.0, "crossing"):
        with pytest.raises(InterruptedError):
            folding.fold_signals(groups, 20, 3, None, None, origin, None)
        assert seen[-1][0] is groups and seen[-1][3] is None


def test_fold_without_a_steady_part_is_refused_with_the_reason(monkeypatch):
    for lacking in ("steady", "fit", "sizes"):
        fields = {"steady": 1, "fit": 1, "sizes": 1, "reason": "recording: must be good.", lacking: None}
        monkeypatch.setattr(folding, "inspect_clocks", lambda *_, fields=fields: (SimpleNamespace(**fields), {}))
        with pytest.raises(ValueError, match=r"^recording: must be good\.$"):
            folding.fold_signals(two_groups(), 20, 1, None, None, 0.0, None)


@pytest.mark.parametrize("shares, refused", [((0.51, 0.95), None), ((0.49, 0.91), "y1"), ((0.89, 0.49), None)])
def test_channels_that_are_not_periodic_are_refused_with_a_cure(shares, refused):
    """At half of the variance; a channel of nine tenths shows that it is a fault of the other one."""
    time, generator = np.arange(200.0), np.random.default_rng(1)
    values = generator.standard_normal((2, 200))
    part = Signals("run", time, ("x", "y"), values, 0)
    variance = np.var(values, axis=1, ddof=1) * (1.0 - np.array(shares))
    seen = SimpleNamespace(parts=[part], channels=["x", "y"], groups=[part])
    fit = SimpleNamespace(variances=variance, frequency=0.05)
    if min(shares) > 0.5:
        assert folding._periodicity(seen, fit) == pytest.approx(0.51)
        return
    with pytest.raises(
        ValueError, match="^recording: must be periodic, got 'run', whose mean period at 0.05 Hz"
    ) as told:
        folding._periodicity(seen, fit)
    worst, good = ("x", "y") if shares[0] < shares[1] else ("y", "x")
    assert f"explains only 49.0% of the variance of '{worst}' (periodicity 0.490, at least 0.5 is nee" in str(
        told.value
    )
    if refused:
        assert (
            f"; 'y' is periodic (91.0%): a sensor without a signal, or noise; leave the channel '{worst}' out."
            in str(told.value)
        )
    else:
        assert f"'{good}' is periodic" not in str(told.value) and "check the frequency and `periods`" in str(told.value)


def test_fit_of_a_constant_channel_has_no_share_below_zero():
    part = Signals("run", np.arange(9.0), ("x",), np.arange(9.0)[None], 0)
    seen = SimpleNamespace(parts=[part], channels=["x"], groups=[part])
    fit = HarmonicFit(1.0, np.zeros((1, 2), dtype=complex), 100.0 * np.ones((1, 9)))
    with pytest.raises(ValueError, match=r"explains only 0.0% of the variance of 'x' \(periodicity -"):
        folding._periodicity(seen, fit)
