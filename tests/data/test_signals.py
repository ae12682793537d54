"""Sampled signals: gaps, cycles, crossings, and steps of the frequency."""

import numpy as np
import pytest

from bayesperiodic.data import signals


def recorded(time, *values, inputs=0):
    names = tuple(f"y{i}" for i in range(len(values)))
    return signals.Signals("record", time, names, np.array(values), inputs)


def test_gaps_are_longer_than_a_quarter_period_and_than_three_usual_steps():
    time = 0.5 * np.cumsum([0.0, 1.0, 1.0, 2.9, 1.0, 1.0, 3.1, 1.0, 1.0, 6.0, 1.0])
    assert signals.gaps(time, 2.0).tolist() == [5, 8]
    assert signals.gaps(time, 5.95).tolist() == [5, 8]
    assert signals.gaps(time, 6.25).tolist() == [8]
    assert signals.gaps(time, 12.05).tolist() == []


def test_the_longest_stretch_ends_at_gaps_of_more_than_thirty_steps():
    time = 0.5 * np.cumsum([0.0, 1.0, 1.0, 30.5, 1.0, 1.0, 29.5, 1.0, 1.0, 40.0, 1.0])
    part, values = signals._longest_stretch(recorded(time, np.arange(11.0), np.arange(11.0) ** 2))
    assert part.tolist() == time[3:9].tolist()
    assert values.tolist() == [[3, 4, 5, 6, 7, 8], [9, 16, 25, 36, 49, 64]]


def test_cycles_include_the_step_of_the_last_sample():
    assert signals.cycles_of(2.0 + np.arange(30) / 10.0, 4.0) == pytest.approx(12.0, rel=1e-8)
    assert signals.cycles_of(np.arange(30) / 10.0, 1.0) >= 3.0


def test_a_signal_rises_only_after_it_was_below_the_mean_by_a_quarter_of_its_sd():
    """The expected crossings come from a loop over the samples with the state "below"."""
    signal = np.array([-2.0, 2.0, 0.1, -0.1, 2.0, -2.0, 0.1, 2.0, -0.1, 0.1, 2.0, -2.0, 2.0])
    signal = np.concatenate([signal, -signal.sum(keepdims=True)])
    assert signal.mean() == pytest.approx(0.0, abs=1e-15)
    level, rising = 0.25 * signal.std(), []
    below = False
    for i, value in enumerate(signal):
        if value < -level:
            below = True
        elif value > level:
            rising += [i] if below else []
            below = False
    assert signals._rising(signal + 5.0).tolist() == rising == [1, 7, 12]


@pytest.mark.parametrize(("change", "found"), [(0.0067, []), (0.0080, [6])])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_of_the_period_exceeds_eight_times_the_noise_of_single_periods(change, found, sign):
    """6 and 24 periods, their logarithms ±0.001 about their means: |difference| √(6·24/30) > 8 · 0.002, or 0.0073.

    The median of neighbours changes the means by up to 0.0004.
    """
    logs = 0.001 * (-1.0) ** np.arange(30) + sign * change * (np.arange(30) >= 6)
    rising = np.concatenate([[0.0], np.cumsum(np.exp(logs))])
    time = np.stack([rising - 0.01, rising], axis=1).ravel()
    signal = np.tile([-1.0, 1.0], rising.size)
    assert signals._steps(time, signal, 1 + 2 * np.arange(rising.size)) == found


def test_a_step_of_the_period_is_larger_than_a_thousandth():
    for change, found in ((0.00095, []), (0.00105, [15])):
        rising = np.concatenate([[0.0], np.cumsum(np.exp(change * (np.arange(30) >= 15)))])
        time = np.stack([rising - 0.01, rising], axis=1).ravel()
        assert signals._steps(time, np.tile([-1.0, 1.0], 31), 1 + 2 * np.arange(31)) == found
    assert signals._steps(time[:14], np.tile([-1.0, 1.0], 7), 1 + 2 * np.arange(7)) == []


def test_steps_at_several_places_are_found_and_a_jump_of_the_phase_is_none():
    logs = np.repeat([0.0, 0.2, 0.5, 0.1], [7, 5, 9, 4])
    logs[3] = 0.4
    rising = np.concatenate([[0.0], np.cumsum(np.exp(logs))])
    time = np.stack([rising - 0.01, rising], axis=1).ravel()
    assert signals._steps(time, np.tile([-1.0, 1.0], 26), 1 + 2 * np.arange(26)) == [7, 12, 21]


def test_constant_channels_are_named():
    wave, rest = np.array([0.0, 1.0, 0.0]), np.full(3, 2.5)
    with pytest.raises(
        ValueError, match=r"^outputs\['y1'\]: must vary, got the constant 2.5; leave the channel out\.$"
    ):
        recorded(np.arange(3.0), wave, rest, inputs=1)
    remedy = ", and write it in the model as a parameter with its value in `fixed`"
    with pytest.raises(ValueError, match=rf"^inputs\['y0'\]: must vary, got the constant 2.5; .* out{remedy}\.$"):
        recorded(np.arange(3.0), rest, wave, inputs=1)
