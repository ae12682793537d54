"""Steps and drifts of phases against their definition by least squares: `steps_of`, `drifts` and what they rest on."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from bayesperiodic.data import clocks
from bayesperiodic.data.clocks import Drift, PhaseStep
from bayesperiodic.data.cycle_findings import stepped
from tests.data.test_phases_of_clocks import phases


def nearby(jump, side, steady):
    """Return the usual jumps before and after each window that is not steady, the larger one; alone 4 times as much."""
    result = np.zeros(len(jump))
    for k in range(len(jump)):
        if steady is None or steady[k + side]:
            continue
        before = [abs(jump[j]) for j in range(k - 4 * side, k - side) if j >= 0]
        after = [abs(jump[j]) for j in range(k + side + 1, k + 5 * side + 1) if j < len(jump)]
        each = [np.median(part) for part in (before, after) if part]
        result[k] = 1.4826 * (max(each) if len(each) == 2 else 4.0 * sum(each))
    return result


@pytest.mark.parametrize("side", [3, 6])
@pytest.mark.parametrize("seed", range(4))
def test_usual_steps_near_windows_that_are_not_steady(side, seed):
    generator = np.random.default_rng(seed)
    jump = generator.standard_normal(40)
    for steady in (None, generator.random(40 + 2 * side) < 0.5, np.zeros(40 + 2 * side, dtype=bool)):
        expected = nearby(jump, side, steady)
        np.testing.assert_allclose(clocks._usual_nearby(jump, side, steady), expected)
    short = generator.standard_normal(2 * side)
    assert clocks._usual_nearby(short[:2], side, np.zeros(2 * side + 2, dtype=bool)).tolist() == [0.0, 0.0]


def largest(series, cycle, least, steady):
    """Return the score, place, size and middle of the largest step by a line and a step through windows about each."""
    count, best = len(series), (1.0, 0, 0.0, 0.0)
    change = np.diff(series)
    white = 1.4826 / np.sqrt(2.0) * np.median(np.abs(change - np.median(change)))
    few = max(1.0, (20 / count) ** 2)
    side = 3
    while 2 * side < count and (side == 3 or 20 * side <= count):
        number = np.r_[-side:0, 1 : side + 1]
        design = np.column_stack([np.ones(2 * side), number, np.sign(number)])
        variance = np.linalg.inv(design.T @ design)[2, 2]
        fits = [np.linalg.lstsq(design, series[k + number], rcond=None)[0] for k in range(side, count - side)]
        rest = [
            np.sum((series[k + number] - design @ fit) ** 2) for k, fit in zip(range(side, count), fits, strict=False)
        ]
        jump = 2.0 * np.array([fit[2] for fit in fits])
        usual = max(np.quantile(np.abs(jump), 0.15) / 0.189, white * 2.0 * np.sqrt(variance))
        usual = np.maximum(usual, nearby(jump, side, steady))
        limit = np.maximum(np.maximum(8.0 * few * usual, least), 5.0 * np.sqrt(np.array(rest) / (2 * side - 3)))
        for i, k in enumerate(range(side, count - side)):
            near = cycle[k + side] - cycle[k - side] <= (2 * side + 4) * np.median(np.diff(cycle))
            if near and abs(jump[i]) / limit[i] > best[0]:
                best = abs(jump[i]) / limit[i], k, jump[i], fits[i][0]
        side *= 2
    return best


@pytest.mark.parametrize("count", [10, 19, 60, 130])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("unsteady", [False, True])
def test_steps_are_those_of_a_line_and_a_step_one_after_the_other(count, seed, unsteady):
    """steps_of: the largest one is subtracted from the series, whose window there is put onto the line."""
    generator = np.random.default_rng(seed)
    cycle = np.cumsum(generator.choice([1.0, 1.0, 1.0, 2.0, 9.0], count) if seed else np.ones(count))
    series = 1e-3 * generator.standard_normal(count) + 0.01 * cycle
    for place in (count // 3, count // 2, 3 * count // 4):
        series[place:] += generator.choice([-1.0, 1.0, 0.05, 0.004])
    steady = generator.random(count) < 0.7 if unsteady else None
    rest, expected = series.copy(), []
    while len(expected) < 50:
        _, place, size, middle = largest(rest, cycle, 0.01, steady)
        if not size:
            break
        expected.append((place, size))
        rest[place], rest[place + 1 :] = middle - 0.5 * size, rest[place + 1 :] - size
    listed = clocks.steps_of(series, cycle, 0.01, steady)
    assert [place for place, _ in listed] == [place for place, _ in expected]
    assert [size for _, size in listed] == pytest.approx([size for _, size in expected])
    assert bool(listed) or count < 60 or unsteady or seed


def test_series_of_nine_windows_have_no_steps(monkeypatch):
    monkeypatch.setattr(clocks, "SIGNIFICANT_STEP", 0.0)
    monkeypatch.setattr(clocks, "SHARP", 0.0)
    series = np.r_[np.zeros(5), np.ones(5)]
    assert clocks.steps_of(series[:9], np.arange(9.0), 1e-6) == []
    assert len(clocks.steps_of(series, np.arange(10.0), 1e-6)) > 0


def test_fifty_steps_are_sought_at_most(monkeypatch):
    series = np.repeat(np.arange(60.0), 10)
    monkeypatch.setattr(clocks, "SIGNIFICANT_STEP", 0.0)
    assert len(clocks.steps_of(series, np.arange(600.0), 1e-6)) == 50


def polynomials(count, orders, others=None):
    """Return orthonormal polynomials over so many windows from order 1 on, orthogonal to other columns too."""
    place = np.linspace(-1.0, 1.0, count)
    first = np.ones((count, 1)) if others is None else others
    columns = np.column_stack([first, np.vander(place, orders + 3, increasing=True)[:, 1:]])
    return np.linalg.qr(columns)[0].T[first.shape[1] :]


NOTHING = np.zeros(0, dtype=int)


@pytest.mark.parametrize("count, orders", [(10, 4), (12, 4), (19, 4), (20, 5), (40, 10), (64, 16), (100, 16)])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("factor, seen", [(0.99, 0), (1.01, 1)])
def test_drifts_are_significant_by_the_next_orders(count, orders, channels, factor, seen):
    """drifts: by Student's t at 1e-4 for all channels together; orders 3, 4, … measure the noise, K/4 of them."""
    basis = polynomials(count, orders)
    noise = 1e-3 * np.resize([1.0, -1.0, 2.0], orders)
    level = 1e-4 / channels
    size = factor * student.isf(0.5 * level, orders) * np.sqrt(np.mean(noise**2))
    turns = np.zeros((count, channels + 1))
    turns[:, -1] = 0.3 + basis[0] * size + basis[2:].T @ noise
    listed = [*clocks.drifts(phases(turns), np.ones(count, dtype=bool), [NOTHING] * channels)]
    assert len(listed) == seen
    if seen:
        cycle = np.arange(count) - 0.5 * (count - 1)
        rate = abs(basis[0] @ cycle)
        (found,) = listed
        assert found.row == channels and abs(found.rate) == pytest.approx(size / rate)
        assert found.se == pytest.approx(np.sqrt(np.mean(noise**2)) / rate) and found.steady
        assert abs(found.turns) == pytest.approx(size / rate * count)


@pytest.mark.parametrize("factor, steady", [(0.98, True), (1.02, False)])
def test_steady_drifts_are_curved_by_a_tenth_and_what_noise_allows(factor, steady):
    basis = polynomials(40, 10)
    noise, size = 1e-3 * np.resize([1.0, -1.0], 10), 0.2
    bend = factor * (0.1 * size + student.isf(0.5e-4, 10) * 1e-3)
    for sign in (1.0, -1.0):
        turns = np.column_stack([np.zeros(40), basis[0] * size + sign * basis[1] * bend + basis[2:].T @ noise])
        (found,) = clocks.drifts(phases(turns), np.ones(40, dtype=bool), [NOTHING])
        assert found.steady == steady


@pytest.mark.parametrize("slip", [0.0, 0.01])
@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("factor, seen", [(0.99, 0), (1.01, 1)])
def test_drifts_of_rounding_or_a_sample_at_jumps_do_not_count(slip, row, factor, seen):
    """A tenth of a thousandth of a cycle over the windows, and the larger slip of both channels."""
    cycle = np.arange(40.0)
    size = factor * (1e-4 + slip)
    given = phases(np.column_stack([np.zeros(40), size * cycle / 40]))
    given.slip[row] = slip
    assert len([*clocks.drifts(given, np.ones(40, dtype=bool), [NOTHING])]) == seen


@pytest.mark.parametrize("order", [1, 3])
def test_noise_of_a_phase_is_at_least_that_of_the_amplitudes(order):
    """clocks._noise: the changes of both logarithms over 2π and the harmonic are added in squares."""
    basis = polynomials(40, 6)[2:]
    sizes = np.zeros((50, 3))
    sizes[5:45, 0] = basis.T @ np.full(6, 0.3)
    sizes[5:45, 2] = basis.T @ np.full(6, 0.4)
    given = replace(phases(np.zeros((50, 3)), sizes), order=np.array([order, 7, order]))
    numbers = np.arange(5, 45)
    by_size = 0.5 / (2 * np.pi * order)
    assert clocks._noise(given, numbers, 2, basis, np.full(6, 0.1 * by_size)) == pytest.approx(by_size)
    assert clocks._noise(given, numbers, 2, basis, np.full(6, 2.0 * by_size)) == pytest.approx(2.0 * by_size)


def test_what_is_no_drift_of_a_clock():
    """clocks._others: a constant, steps between the windows used, and the frequency of the first channel."""
    cycle = np.arange(48.0)
    numbers = np.r_[4:20, 24:48]
    middle = cycle[numbers] - cycle[numbers].mean()
    scaled = middle / np.abs(middle).max()
    turns = np.zeros((48, 2))
    turns[numbers, 0] = 0.2 + 0.5 * scaled + 0.3 * scaled**3
    given = phases(turns)
    places = np.array([2, 3, 10, 30, 47])
    others = clocks._others(given, numbers, middle, places)
    rate = 0.9 * scaled**2
    rate -= rate.mean()
    assert others.shape == (40, 4) and np.all(others[:, 0] == 1.0)
    assert np.array_equal(others[:, 1], numbers > 10) and np.array_equal(others[:, 2], numbers > 30)
    np.testing.assert_allclose(others[:, 3], rate / np.abs(rate).max(), atol=1e-9)
    for factor, varies in ((1.01, True), (0.99, False)):
        turns[numbers, 0] = 0.5 * scaled + factor * 1e-4 / (2.0 * np.abs(scaled).max()) * scaled**2
        slow = clocks._others(phases(turns), numbers, middle, np.array([2]))
        mean = scaled.mean()
        largest = np.abs(scaled - mean).max() * factor * 1e-4
        assert (slow.shape[1] == 2) == (largest > 1e-4)
        assert largest == pytest.approx(factor * 1e-4, rel=1e-6) and (largest > 1e-4) == varies


@pytest.mark.parametrize("count, seen", [(10, 1), (9, 0)])
def test_drifts_need_ten_windows(count, seen):
    turns = np.column_stack([np.zeros(count), 0.01 * np.arange(count)])
    assert len([*clocks.drifts(phases(turns), np.ones(count, dtype=bool), [NOTHING])]) == seen


@pytest.mark.parametrize("used, steady, seen", [(49, True, 1), (51, True, 0), (49, False, 0)])
def test_all_windows_count_if_less_than_half_of_them_are_used(used, steady, seen, monkeypatch):
    """clock_drifts: for steady drifts only."""
    given, asked = phases(np.zeros((100, 2))), []

    def drifts(_, chosen, steps):
        asked.append((int(chosen.sum()), steps))
        yield from [Drift(1, 1e-5, 1e-6, 0.1, steady)] if chosen.all() else []

    monkeypatch.setattr(clocks, "drifts", drifts)
    assert len(clocks.clock_drifts(given, np.arange(100) < used, "steps")) == seen
    assert asked == [(used, "steps"), (100, "steps")][: 2 if used < 50 else 1]
    first = [Drift(1, 1e-5, 1e-6, 0.1, False)]
    monkeypatch.setattr(clocks, "drifts", lambda *_: iter(first))
    assert clocks.clock_drifts(given, np.arange(100) < used, "steps") == first


def test_findings_of_the_largest_step_are_in_samples_of_the_channel_or_the_fastest():
    listed = [PhaseStep("", "", 3.0, 0.01, 1), PhaseStep("x", "", 4.0, 0.2, 1), PhaseStep("", "", 5.0, -0.03, 1)]
    every, one = clocks.step_findings(listed, {"x": 50.0, "u": 100.0}, 2.0, 10)
    assert every.text == stepped("", -0.03, 5.0, 100.0, 2.0) + " (2 steps)"
    assert one.text == stepped("x", 0.2, 4.0, 50.0, 2.0) and (one.channel, one.count, one.share) == ("x", 1, 0.1)
    assert every.times.tolist() == [[3.0, 3.0], [5.0, 5.0]] and np.isnan(one.bias)
    assert every.cure == one.cure == "fold the parts before and after it: recording.between(start, stop)"


@pytest.mark.parametrize("rate, free", [(0.99e-3, False), (1.01e-3, True), (-1.01e-3, True)])
def test_clocks_that_differ_by_a_thousandth_may_be_a_chaotic_response(rate, free):
    (found,) = clocks.drift_findings([Drift(1, rate, 1e-6, 0.02, True)], "ux", (1.0, 9.0), 40, 50)
    chaotic = ", or a response that does not follow the drive, such as a chaotic one"
    assert found.text.endswith("two clocks, or a system that changes" + chaotic * free)
    assert found.cure.endswith("bp.PoincareSection and bp.find_orbits" if free else "with recording.between")
    assert found.share == 1.0 and np.isnan(found.bias)


@pytest.mark.parametrize("left, seen", [(0.095, 0), (0.105, 1)])
def test_a_tenth_of_a_drift_is_beside_changes_of_the_drive(left, seen):
    """drifts: of the frequency of the first channel, x + a x², which the second one may follow by its delay.

    Orthogonal to it, sin θ of a linear drift is left, with tan θ = a |x² − mean|/|x|.
    """
    x = np.linspace(-1.0, 1.0, 48)
    bent = x**2 - np.mean(x**2)
    a = left / np.sqrt(1.0 - left**2) * np.linalg.norm(x) / np.linalg.norm(bent)
    drive = 0.5 * x**2 + a * x**3 / 3.0
    given = phases(np.column_stack([drive, drive + 0.02 * np.arange(48.0)]))
    listed = [*clocks.drifts(given, np.ones(48, dtype=bool), [NOTHING])]
    assert len(listed) == seen
    if seen:
        assert listed[0].rate == pytest.approx(0.02) and listed[0].turns == pytest.approx(0.02 * 48)
