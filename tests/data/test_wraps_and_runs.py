"""Wraps, runs, clipped levels and dropouts by their definition, for random values of many kinds: `faults`."""

import numpy as np
import pytest

from bayesperiodic.data import faults


@pytest.mark.parametrize("seed", range(5))
def test_runs_are_those_of_a_loop(seed):
    values = np.random.default_rng(seed).integers(0, 2 + seed, 40).astype(float)
    first = [k for k in range(40) if k == 0 or values[k] != values[k - 1]]
    starts, lengths = faults.runs(values)
    assert starts.tolist() == first and lengths.tolist() == np.diff([*first, 40]).tolist()
    assert [one.tolist() for one in faults.runs(values[:1])] == [[0], [1]]


def _by_definition(values, turn, step):
    """Return whether values wrap at a turn."""
    change = np.diff(values)
    if not 0.9 * turn < np.ptp(values) < 1.001 * turn + step:
        return False
    jumps = np.abs(change) > 0.65 * turn
    if not jumps.any() or jumps.all():
        return False
    steps = change - turn * np.round(change / turn)
    whole = values[0] + np.concatenate([[0.0], np.cumsum(steps)])
    smooth = np.mean(steps**2) < 0.5 * np.var(whole) and np.abs(steps).max() < 0.5 * turn
    return bool(smooth and np.median(np.abs(steps[jumps])) <= 3.0 * np.quantile(np.abs(steps[~jumps]), 0.99) + step)


@pytest.mark.parametrize("turn", [2.0 * np.pi, 360.0, 1.0])
@pytest.mark.parametrize("seed", range(30))
def test_wraps_are_those_of_their_definition(turn, seed):
    """wrap_of: slow motions with noise about an end of the range, of which some jump by other steps than a turn."""
    generator = np.random.default_rng(seed)
    slow, fast = generator.uniform(0.05, 0.4), generator.uniform(0.01, 0.2)
    whole = slow * np.sin(np.arange(200) / 15.0) + fast * generator.standard_normal(200)
    values = whole % 1.0 * generator.choice([1.0, 1.0, 0.97, 0.91, 0.89])
    if seed % 3 == 0:
        values[generator.integers(0, 200, 3)] = generator.choice([0.0, 1.0], 3)
    found, jumps = faults.wrap_of(turn * values, 0.0)
    expected = next((one for one in (2.0 * np.pi, 360.0, 1.0) if _by_definition(turn * values, one, 0.0)), 0.0)
    assert found == expected
    change = np.abs(np.diff(turn * values))
    assert jumps.tolist() == (np.flatnonzero(change > 0.65 * expected) + 1).tolist() * bool(expected)


@pytest.mark.parametrize("seed", range(20))
def test_stuck_stretches_are_those_of_their_definition(seed):
    """stuck_of: ten samples, and ten times the run in which the median sample is and the 99 % quantile of many runs."""
    generator = np.random.default_rng(seed)
    lengths = generator.choice([1, 1, 1, 2, 3, 9, 10, 11, 30], generator.integers(20, 160))
    values = np.repeat(generator.permutation(lengths.size).astype(float), lengths)
    for end in (values.max(), values.min()):
        values[np.isin(values, generator.choice(values, seed % 4))] = end
    first, length = faults.runs(values)
    by_size = np.repeat(np.sort(length), np.sort(length))
    half = 0.5 * values.size
    usual = 1.0
    if length.max() < half:
        usual = by_size[int(np.ceil(half)) - 1]
    if length.size > 100:
        usual = max(usual, np.quantile(length, 0.99))
    long = [(int(a), int(n)) for a, n in zip(first, length, strict=True) if n >= max(10, 10.0 * usual)]
    for end in (values.max(), values.min()):
        if sum(values[a] == end for a, _ in long) >= 3:
            long = [(a, n) for a, n in long if values[a] != end]
    assert faults.stuck_of(values) == [slice(a, a + n) for a, n in long]


def test_long_runs_are_compared_with_the_quantile_of_more_than_a_hundred():
    """Of 100 runs, 2 of 4 samples do not count: 10 are ten times the usual 1; of 101 they do."""
    for others, stuck in ((97, True), (98, False)):
        lengths = np.r_[np.ones(others, dtype=int), 4, 4, 12]
        values = np.repeat(np.random.default_rng(1).standard_normal(lengths.size), lengths)
        assert np.quantile(lengths, 0.99) > 1.2 and len(faults.stuck_of(values)) == stuck


@pytest.mark.parametrize("seed", range(10))
def test_slower_loggers_repeat_all_values_but_the_first(seed):
    """held_of: counted from the first sample of the second run."""
    generator = np.random.default_rng(seed)
    repeats, cut = int(generator.integers(2, 7)), int(generator.integers(0, 7))
    values = np.repeat(generator.standard_normal(40), repeats)[cut % repeats :]
    number, repeated = faults.held_of(values)
    assert number == repeats
    later = repeated[repeated >= repeats - cut % repeats]
    first = np.flatnonzero(np.r_[True, np.diff(values) != 0.0])
    assert later.tolist() == [k for k in range(first[1], values.size) if k not in first]


@pytest.mark.parametrize("levels, repeats", [(18, 3), (17, 1)])
def test_slower_loggers_have_eighteen_different_values(levels, repeats):
    values = np.repeat(np.resize(np.arange(float(levels)), 60), 3)
    assert faults.held_of(values)[0] == repeats


@pytest.mark.parametrize("seed", range(20))
def test_values_of_dropouts_are_those_of_their_definition(seed):
    generator = np.random.default_rng(seed)
    counts = generator.choice([1, 1, 2, 3], generator.integers(15, 30))
    counts[0] = generator.integers(4, 22)
    values = generator.permutation(np.repeat(generator.standard_normal(counts.size), counts))
    most, other = np.sort(counts)[[-1, -2]]
    dropped = counts.size >= 18 and most >= 6 and most >= 6 * other and most <= 0.45 * counts.sum()
    levels, numbers = np.unique(values, return_counts=True)
    assert faults.dropped_value(values) == (levels[numbers.argmax()] if dropped else None)


def test_long_recordings_are_screened_by_every_so_many_samples():
    """dropped_value and jumps: of 250,001 samples every third one."""
    values = np.arange(250_001.0)
    values[::3][:30_000] = -1.0
    assert faults.dropped_value(values) == -1.0
    values = np.arange(250_001.0)
    values[1::3][:30_000] = values[2::3][:30_000] = -1.0
    assert faults.dropped_value(values) is None


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("step", [0.0, 0.5])
def test_outliers_are_those_beyond_two_levels(seed, step, monkeypatch):
    """outliers_of: 8 robust standard deviations or two steps, and a fifth of the largest distance."""
    generator = np.random.default_rng(seed)
    residuals = generator.standard_normal(200) * generator.choice([0.0, 0.1, 1.0])
    residuals[generator.integers(0, 200, 9)] += generator.choice([3.0, -12.0, 90.0], 9)
    values, asked = residuals + 7.0, []
    monkeypatch.setattr(faults, "_lone", lambda far, *given: asked.append(far) or np.flatnonzero(far))
    found = faults.outliers_of(residuals.copy(), np.arange(200.0), values, step)
    distance = np.abs(residuals - np.median(residuals))
    scale = 1.4826 * np.median(distance) or np.quantile(distance, 0.9)
    least = max(8.0 * scale, 2.0 * step, 1e-9 * max(values.max(), -values.min()))
    expected = {least, max(least, 0.2 * distance.max())}
    assert len(asked) == len(expected)
    assert {far.tobytes() for far in asked} == {(distance > one).tobytes() for one in expected}
    assert found.tolist() == np.flatnonzero(distance > least).tolist()


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("offset", [0.0, 1e3])
@pytest.mark.parametrize("factor, seen", [(0.9, 0), (1.1, 1)])
def test_outliers_of_rounding_errors_do_not_count(sign, offset, factor, seen, monkeypatch):
    """Of a billionth of the largest value of either sign."""
    monkeypatch.setattr(faults, "_lone", lambda far, *_: np.flatnonzero(far))
    values = sign * (offset + np.resize([1.0, 2.0], 100))
    residuals = np.zeros(100)
    residuals[7] = factor * 1e-9 * (offset + 2.0)
    assert faults.outliers_of(residuals, np.arange(100.0), values, 0.0).size == seen


@pytest.mark.parametrize("step, known", [(1.1e-12, True), (0.9e-12, False)])
def test_steps_of_the_resolution_are_more_than_rounding(step, known, monkeypatch):
    """resolution: of a trillionth of the range."""
    monkeypatch.setattr(faults, "step_of", lambda values: step * 8.0)
    assert faults.resolution(np.array([-3.0, 5.0])) == (step * 8.0 if known else 0.0)
