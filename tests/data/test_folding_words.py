"""Refusals and warnings of folding, with the numbers in them, and small rules of it."""

import re
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from bayesperiodic import _fourier
from bayesperiodic.data import folding
from bayesperiodic.data.folding import AmplitudeNoise
from bayesperiodic.data.harmonics import Pace
from bayesperiodic.data.recording_check import RUINOUS, SERIOUS, Finding
from bayesperiodic.data.signals import Signals


def seen(total=100, used=slice(0, 500), inputs=0, size=500):
    group = Signals("run", np.arange(float(size)), ("x",), np.arange(float(size))[None], inputs)
    return SimpleNamespace(total=total, used=[used], groups=[group])


def warned(pace, cycles, inspection, estimated=True):
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        folding._warn("run", pace, cycles, inspection, estimated)
    return [str(one.message) for one in raised]


STEADY = Pace(1e-4, 10, 0.0, False)


@pytest.mark.parametrize(
    "cycles, total, said",
    [(51, 100, False), (50, 100, True), (51, 101, False), (50, 101, True), (3, 3, False), (1, 3, True)],
)
def test_less_than_half_of_the_cycles_is_warned_of(cycles, total, said):
    texts = warned(STEADY, cycles, seen(total, slice(250, 500)))
    assert len(texts) == said
    if said:
        assert texts[0].startswith(
            f"run: only the last {cycles} of {total} cycles are used, because those before differ from them: a long"
        )
        (other,) = warned(STEADY, cycles, seen(total, slice(0, 250)))
        assert other.startswith(f"run: only {cycles} of {total} cycles are used, because the others differ from them")


def test_drifts_and_wandering_phases_are_warned_of_with_their_size():
    (text,) = warned(Pace(1e-4, 10, 0.012, True, 0.01, 0.1), 40, seen())
    assert text.startswith(
        "run: the period changes by -1.20% over the 40 cycles used (of 100). The mean period and its"
    )
    wander = Pace(1e-4, 10, 0.0, False, 0.05, 0.0)
    (text,) = warned(wander, 40, seen())
    assert text.startswith(
        "run: the phase wanders irregularly by 18° of the response period over the 40 cycles used, while"
    )
    assert "its higher harmonics are smeared. Fold shorter parts with `between`" in text
    followed = Pace(1e-4, 10, 0.0, False, 0.05, 1e-4)
    (text,) = warned(followed, 40, seen())
    assert "The mean period follows the phase, and the standard error of the frequency contains its random walk" in text
    for other in (warned(followed, 40, seen(), False), warned(followed, 40, seen(inputs=1))):
        assert "smeared" in other[0]


@pytest.mark.parametrize(
    "pace, cycles", [(Pace(1e-4, 10, 0.012, True), 90), (Pace(1e-4, 10, 0.0, False, 0.05), 90), (STEADY, 40)]
)
def test_warnings_are_those_of_the_line_that_folds(pace, cycles):
    """Of a method that calls `fold_signals`, which calls `_warn`."""

    def fold_signals():
        folding._warn("run", pace, cycles, seen(), True)

    def fold():
        fold_signals()

    with pytest.warns(UserWarning, match="^run: ") as raised:
        _, line = fold(), sys._getframe().f_lineno
    assert [(one.filename, one.lineno, one.category) for one in raised] == [(__file__, line, UserWarning)]


def test_growth_of_amplitudes_is_the_slope_of_a_straight_line():
    sizes = np.column_stack([np.linspace(1.0, 1.2, 11), np.full(11, 3.0), 2.0 + 0.1 * (-1.0) ** np.arange(11)])
    expected = [np.polyfit(np.arange(11), column, 1)[0] * 11 / column.mean() for column in sizes.T]
    assert folding._drift(sizes) == pytest.approx(expected, abs=1e-12)
    assert folding._drift(sizes[:1]) == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("largest, refused", [(None, False), (0.05, False), (0.0499, True)])
def test_drift_beyond_the_largest_one_is_refused(largest, refused):
    drift = {"x": 0.01, "y": -0.05}
    if refused:
        message = (
            "recording: must be steady, got 'run', in which the strongest harmonic of 'y' changes by -5.0%, more than "
            "largest_drift = 5.0%; leave it out, or select a steady part with `between`."
        )
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            folding._refuse_drift("run", drift, largest)
    else:
        folding._refuse_drift("run", drift, largest)
    with pytest.raises(ValueError, match="^largest_drift: must be "):
        folding._refuse_drift("run", drift, -0.1)


@pytest.mark.parametrize("share, refused", [(0.51, False), (0.49, True)])
def test_a_recording_whose_mean_period_explains_less_than_half_is_refused(share, refused):
    values = np.random.default_rng(0).standard_normal((2, 100))
    values /= values.std(axis=1, ddof=1)[:, None]
    inspection = SimpleNamespace(
        parts=[Signals("run", np.arange(100.0), ("x", "y"), values, 0)],
        channels=("x", "y"),
        groups=[SimpleNamespace(name="run")],
    )
    fit = SimpleNamespace(variances=np.array([1.0 - share, 0.02]), frequency=2.5)
    if not refused:
        assert folding._periodicity(inspection, fit) == pytest.approx(share)
        return
    with pytest.raises(
        ValueError, match="^recording: must be periodic, got 'run', whose mean period at 2.5 Hz"
    ) as error:
        folding._periodicity(inspection, fit)
    text = str(error.value)
    assert "explains only 49.0% of the variance of 'x' (periodicity 0.490, at least 0.5 is needed)" in text
    assert "'y' is periodic (98.0%): a sensor without a signal, or noise; leave the channel 'x' out" in text
    fit = SimpleNamespace(variances=np.array([1.2, 0.2]), frequency=2.5)
    with pytest.raises(
        ValueError, match="explains only 0.0% of the variance of 'x' .*; check the frequency and `periods`"
    ):
        folding._periodicity(inspection, fit)


@pytest.mark.parametrize(
    "given, expected", [(None, None), (2, (2.0, 0.0)), ((2.0, 0.1), (2.0, 0.1)), ([2.0, 1e-3], (2.0, 1e-3))]
)
def test_frequency_with_or_without_an_error(given, expected):
    assert folding.given_frequency(given) == expected


@pytest.mark.parametrize("given, name", [(0.0, "frequency"), ((2.0, 0.0), r"frequency\[1\]"),
((-1.0, 0.1), r"frequency\[0\]|frequency"),
                                         ((2.0,), "frequency"), ((2.0, 0.1, 3.0), "frequency")])  # fmt: skip
def test_other_frequencies_are_refused(given, name):
    with pytest.raises(ValueError, match=f"^({name}): must be "):
        folding.given_frequency(given)


@pytest.mark.parametrize("phase", [-3.0, -1.6, -1.5, 0.0, 1.0, 3.1])
def test_first_upward_crossing_of_the_fundamental(phase):
    """Of cos(2πft + φ) on a fine grid of the first period; amplitudes from it have a sine for a fundamental."""
    amplitudes = {"x": np.array([0.5, 2.0 * np.exp(1j * phase), 0.3j]), "u": np.array([0.0, 1.0 + 0j, 0.0])}
    start, turned = folding._from_crossing(amplitudes, "x", 4.0)
    time = np.linspace(0.0, 0.25, 200_001)
    wave = np.cos(2 * np.pi * 4.0 * time + phase)
    crossing = np.flatnonzero((wave[:-1] < 0.0) & (wave[1:] >= 0.0))
    assert start == pytest.approx(time[crossing[0]], abs=3e-6) or (start < 1e-9 and phase == -np.pi / 2)
    for channel in amplitudes:
        later = _fourier.at_times(amplitudes[channel][None], 4.0 * (start + np.arange(7) / 50))
        np.testing.assert_allclose(_fourier.at_times(turned[channel][None], 4.0 * np.arange(7) / 50), later, atol=1e-12)
    assert turned["x"][1] == pytest.approx(-2.0j)


def test_stated_clock_makes_drifts_serious():
    drift = Finding("clock", "x", RUINOUS, np.zeros((1, 2)), 1, 1.0, np.nan, "text", "cure")
    other = Finding("clipped", "x", RUINOUS, np.zeros((1, 2)), 1, 1.0, np.nan, "text", "cure")
    assert [one.severity for one in folding._with_stated_clock([drift, other], "one")] == [SERIOUS, RUINOUS]
    assert [one.severity for one in folding._with_stated_clock([drift, other], None)] == [RUINOUS, RUINOUS]


@pytest.mark.parametrize("seed", range(3))
def test_means_over_two_neighbours_on_each_side(seed):
    generator = np.random.default_rng(seed)
    values, weights = generator.standard_normal(9) + 1j * generator.standard_normal(9), generator.random(9)
    expected = [values[0] / weights[0]] + [
        values[max(h - 2, 1) : h + 3].sum() / weights[max(h - 2, 1) : h + 3].sum() for h in range(1, 9)
    ]
    np.testing.assert_allclose(folding.neighbours_mean(values, weights), expected)
    assert folding.neighbours_mean(values, np.zeros(9)).tolist() == [0.0] * 9


def noise_of(beside, count=6):
    return AmplitudeNoise(np.ones(count), np.full(count, 8.0), np.full(count, 8.0), beside)


def test_errors_of_outputs_that_follow_those_of_inputs():
    """With a slope of 2 − 3j and little noise of their own; of independent errors none, once in a hundred."""
    generator = np.random.default_rng(4)
    draw = lambda: generator.standard_normal((10, 6)) + 1j * generator.standard_normal((10, 6))  # noqa: E731
    u, own = draw(), draw()
    noise = {"u": noise_of(u), "x": noise_of((2.0 - 3.0j) * u + 0.01 * own), "y": noise_of(draw())}
    amplitudes = {name: np.ones(6, dtype=complex) for name in noise}
    kept = {"u": 5, "x": 4, "y": 5}
    slopes = folding._error_slopes(noise, ["u"], kept, amplitudes)
    assert [*slopes] == ["u"] and [*slopes["u"]] == ["x"] and slopes["u"]["x"].shape == (5,)
    np.testing.assert_allclose(slopes["u"]["x"][1:], 2.0 - 3.0j, atol=0.02)
    mean = np.sum(np.conj(u[:, 0]) * noise["x"].beside[:, 0]) / np.sum(np.abs(u[:, 0]) ** 2)
    assert slopes["u"]["x"][0] == pytest.approx(mean.real)
    assert folding._error_slopes(noise, [], kept, amplitudes) == {}
    small = noise | {"u": noise_of(0.9e-12 * u / np.abs(u).max())}
    assert folding._error_slopes(small, ["u"], kept, amplitudes) == {}
    least = noise | {"u": noise_of(1.1e-12 * u / np.abs(u).max())}
    assert [*folding._error_slopes(least, ["u"], kept, amplitudes)] == ["u"]
    # An exact input, or one whose noise is in no output, does not hide the next one.
    for other in (0.0 * u, draw()):
        three = {"v": noise_of(other), **noise}
        both = folding._error_slopes(three, ["v", "u"], kept | {"v": 5}, amplitudes | {"v": amplitudes["u"]})
        assert [*both] == ["u"] and both["u"]["x"] == pytest.approx(slopes["u"]["x"])


def test_harmonics_above_those_kept_are_left_out_with_their_variances():
    amplitudes = {"x": np.arange(6) * (1 + 1j), "y": np.arange(3.0) + 0j}
    noise = {
        "x": AmplitudeNoise(np.arange(5.0), 10.0 + np.arange(5), np.zeros(5), np.empty((0, 5))),
        "y": AmplitudeNoise(np.arange(3.0), np.ones(3), np.zeros(3), np.empty((0, 3))),
    }
    left = folding._left_out(amplitudes, noise, {"x": 2, "y": 2})
    assert [*left] == ["x"]
    one = left["x"]
    fields = [getattr(one, name) for name in one.__dataclass_fields__]
    assert [np.asarray(values).tolist() for values in fields[:4]] == [
        [3, 4],
        [3 + 3j, 4 + 4j],
        [3.0, 4.0],
        [13.0, 14.0],
    ]


@pytest.mark.parametrize(
    "given, expected", [(None, {}), (3, {"x": 3, "y": 3}), ({"y": 2}, {"y": 2}), ({"x": np.int64(4)}, {"x": 4})]
)
def test_harmonics_that_are_asked_for(given, expected):
    assert folding._chosen(given, ["x", "y"]) == expected
    for wrong, message in (
        (0, r"harmonics\['x'\]: must be"),
        ({"z": 2}, "harmonics: must be one of 'x', 'y', got 'z'"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            folding._chosen(wrong, ["x", "y"])


@pytest.mark.parametrize("count, refused", [(4, False), (5, True)])
def test_harmonics_beyond_the_limit_are_refused_with_it(count, refused):
    parts = [Signals("run", np.arange(40) / 10, (name,), np.arange(40.0)[None], 0) for name in "xy"]
    folding._refuse_undetermined({"x": 9}, parts, [9, 4], 1.0)
    if refused:
        with pytest.raises(
            ValueError, match=r"^harmonics\['y'\]: must be at most 4, which the samples and the grid resolve, got 5"
        ):
            folding._refuse_undetermined({"y": count}, parts, [9, 4], 1.0)
    else:
        folding._refuse_undetermined({"y": count}, parts, [9, 4], 1.0)


@pytest.mark.parametrize(
    "ratio, difference, error, refused",
    [
        (3.9, 0.01, 0.0, False),
        (4.1, 0.01, 0.0, True),
        (4.1, 2.7e-4, 0.0, False),
        (4.1, 0.004, 1e-5, False),
        (4.1, 0.006, 1e-5, True),
    ],
)
def test_a_frequency_that_leaves_four_times_the_variance_is_refused(ratio, difference, error, refused):
    """If its phase drifts over 10 s by more than 1°, or by a twentieth of a cycle of one with an error."""
    pace = Pace(1e-3, 10, 0.0, False)
    one = SimpleNamespace(frequency=1.0, variances=np.array([1.0, 1.0]), each=())
    two = SimpleNamespace(frequency=1.0 + difference, variances=np.array([ratio, ratio]), each=())
    pace_never = SimpleNamespace(se=1e-3, differs=lambda *_: False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folding, "explains_more", lambda *given: given == (one, two))
        if refused:
            with pytest.raises(
                ValueError, match="^frequency: must be that of the recording, which is estimated as 2 Hz"
            ) as caught:
                folding._refuse_frequency(one, two, pace_never, 10.0, 2, error)
            assert f"got {2 * (1 + difference):.9g} Hz, whose phase drifts by {3600 * difference:.2g}°" in str(
                caught.value
            )
            assert "with a standard error of 0.002 Hz" in str(caught.value)
        else:
            folding._refuse_frequency(one, two, pace_never, 10.0, 2, error)
        with pytest.raises(ValueError, match="^frequency: must be that of the recording"):
            compared = (two.frequency - 1.0, 10.0, error)
            always = SimpleNamespace(se=1e-3, differs=lambda *given: given == compared)
            folding._refuse_frequency(one, two, always, 10.0, 2, error)
        patch.setattr(folding, "explains_more", lambda *_: False)
        if not refused:
            folding._refuse_frequency(one, two, SimpleNamespace(se=1e-3, differs=lambda *_: True), 10.0, 2, error)
    assert pace.differs(0.1, 10.0) and not pace.differs(1e-4, 10.0)
