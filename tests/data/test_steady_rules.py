"""Rules of `steady_part` for given changes, and of `windows` for given shares, slow sampling and missing samples."""

import numpy as np
import pytest

from bayesperiodic.data import steadiness
from bayesperiodic.data.changes import DRIFT, STEP, TONE, TRANSIENT, Changes
from tests.data.test_steady_limits import windows_of

COMPONENTS = 5  # of one channel: the mean value, and along and across two harmonics


def answer(count, probability=None, bias=0.0, lasting=0.0, moving=0.1):
    """Return changes of so many cycles with this bias of the first component, in standard errors."""
    error, transient = np.full((count, COMPONENTS), 0.01), np.zeros((count, COMPONENTS))
    transient[:, 0] = 0.01 * np.broadcast_to(bias, (count,))
    squares = 1e-6 * (1.0 + np.arange(count))[:, None] * np.arange(1.0, COMPONENTS + 1)
    last = lasting * (1.0 + np.arange(count))[:, None] * np.ones(COMPONENTS)
    each = {kind: 0.0 for kind in (TRANSIENT, DRIFT, STEP, TONE)} | (probability or {})
    move = np.array([0.0, moving, 0.05, 0.0, 0.0])
    return Changes(transient, squares, last, each, move, move, error, 3, move, (1.0, 1.0), 0.0)


def parted(every, answers, driven=True):
    """Return the steady part by given changes, and what these were asked for."""
    asked, given = [], iter(answers)

    def changes(*arguments):
        asked.append(arguments)
        return next(given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steadiness, "changes", changes)
        patch.setattr(steadiness, "_trimmed", lambda part, usual: (0, len(part.first)))
        return steadiness.steady_part(every, driven), asked


@pytest.mark.parametrize("driven, longest", [(True, 0.5), (False, 0.25)])
@pytest.mark.parametrize("before, transient", [(0, 0.6), (7, 0.6), (8, 0.9), (30, 0.9)])
def test_changes_are_sought_once_with_the_probability_of_a_start_that_was_left_out(driven, longest, before, transient):
    """Windows of eighths of a cycle; a whole one must be before the part."""
    every = windows_of(np.r_[np.full(before, 0.2), np.ones(20 * 8 - 7)], overlap=8)
    effects = answer(20)
    steady, ((components, probability, decay),) = parted(every, [effects], driven)
    assert (probability, decay) == (transient, longest) and components.shape == (20, COMPONENTS)
    assert steady.changes is effects and len(steady.part.first) == 20 and steady.part.place[0] == before


@pytest.mark.parametrize(
    "count, probability, left",
    [(20, 0.51, True), (20, 0.49, False), (10, 0.51, True), (9, 0.94, False), (9, 0.96, True), (20, 0.96, True)],
)
@pytest.mark.parametrize("decay", [0.5, 3.0, 100.0])
def test_cycles_are_left_out_by_the_probability_of_a_transient_and_the_least_error(count, probability, left, decay):
    """Less than half of them unless it is clear, with three that remain; of fewer than ten only if it is."""
    bias = 6.0 * np.exp(-np.arange(count) / decay)
    most = count - 3 + 1 if probability > 0.95 else count // 2
    error = [(1.0 + 4.0 * bias[k] ** 2) / (count - k) for k in range(most)]
    first = error.index(min(error)) if left else 0
    effects, later = answer(count, {TRANSIENT: probability}, bias), answer(count - first, moving=0.7)
    steady, asked = parted(windows_of(np.ones(count)), [effects, later])
    assert steady.part.place.tolist() == [*range(first, count)] and steady.level == (0, 5 * count)
    assert steady.samples == slice(5 * first, 5 * count) and steady.bias == pytest.approx(bias[first])
    assert steady.transient == 0.1
    again = bool(first) and count - first >= 5
    assert len(asked) == 1 + again
    assert steady.changes is (None if count - first < 5 else later if again else effects)
    if again:
        assert asked[1][1:] == (0.6, 0.5) and np.array_equal(asked[1][0], asked[0][0][first:])
    # Squares of the mean value, of both components of harmonic 1, and of harmonic 2.
    assert steady.squares[0] == pytest.approx(1e-6 * (1 + first) * np.array([1.0, 2.0 + 4.0, 3.0 + 5.0]))


@pytest.mark.parametrize("kinds, slow", [({DRIFT: 0.3, STEP: 0.21}, True), ({DRIFT: 0.3, STEP: 0.19}, False)])
def test_squares_of_slow_changes_are_added(kinds, slow):
    """Those of the cycles used; without a second look, as of four cycles, from the first one used on."""
    plain = 1e-6 * np.array([1.0, 6.0, 8.0])
    steady, _ = parted(windows_of(np.ones(20)), [answer(20, kinds, lasting=1e-4)])
    assert steady.squares[0] == pytest.approx(plain + 1e-4 * np.array([1.0, 2.0, 2.0]) * slow)
    assert steady.transient == (0.0 if slow else 0.1)
    bias = np.r_[np.full(8, 9.0), np.zeros(12)]
    first = answer(20, {TRANSIENT: 0.6}, bias)
    steady, _ = parted(windows_of(np.ones(20)), [first, answer(12, kinds, lasting=1e-4)])
    assert steady.squares[0] == pytest.approx(9 * plain + 1e-4 * np.array([1.0, 2.0, 2.0]) * slow)
    assert steady.transient == 0.1 and len(steady.part.first) == 12
    few = answer(
        7, {TRANSIENT: 0.96} | ({} if not slow else {DRIFT: 0.51}), np.r_[9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0], 1e-4
    )
    steady, _ = parted(windows_of(np.ones(7)), [few])
    assert steady.squares[0] == pytest.approx(4 * plain + 4e-4 * np.array([1.0, 2.0, 2.0]) * slow)


def test_parts_of_four_cycles_are_not_searched_for_changes():
    for count, searched in ((4, 0), (5, 1)):
        steady, asked = parted(windows_of(np.ones(count)), [answer(count)])
        assert len(asked) == searched and (steady.changes is None) == (not searched)


def test_changes_within_each_half_are_those_of_its_slope():
    """Of 20 cycles: the first ten are level, and the others rise by 4 % of 1."""
    sizes = 1.0 + 0.004 * np.maximum(np.arange(20) - 9.0, 0.0)
    steady, _ = parted(windows_of(sizes), [answer(20)])
    later = sizes[10:]
    slope = np.polyfit(np.arange(10), later, 1)[0]
    assert steady.change == pytest.approx(np.array([[0.0], [10 * slope / later.mean()]]), abs=1e-12)


def test_the_part_is_trimmed_by_the_usual_distances_and_then_twice_by_the_largest(monkeypatch):
    asked = []
    monkeypatch.setattr(
        steadiness, "_trimmed", lambda part, usual: asked.append((len(part.first), usual)) or (1, 29 - len(asked))
    )
    monkeypatch.setattr(steadiness, "changes", lambda components, *_: answer(len(components)))
    steady = steadiness.steady_part(windows_of(np.ones(30)), True)
    assert asked == [(30, None), (27, np.max), (26, np.max)]
    assert steady.part.place.tolist() == [*range(3, 28)] and steady.level == (15, 140)


def asked_of(time, values, fundamental, shares, length=1):
    """Return what `windows` asks `_windows_of` for until the share of the windows is enough."""
    asked, given = [], iter(shares)

    def answered(*arguments):
        asked.append(arguments)
        return len(asked), next(given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steadiness, "_windows_of", answered)
        return steadiness.windows(time, values, fundamental, length), asked


@pytest.mark.parametrize("shares, lengths", [([0.75], [1]), ([0.74, 0.8], [1, 2]), ([0.1] * 9, [1, 2, 4, 8, 16, 32])])
def test_windows_are_doubled_while_a_quarter_has_too_few_samples(shares, lengths):
    """Until six of them are more than all 96 cycles."""
    time = np.arange(96 * 20) / 20.0
    number, asked = asked_of(time, np.cos(time)[None], 1.0, shares)
    assert number == len(asked) and [given[5] for given in asked] == lengths
    for given in asked:
        assert given[0] is time and given[2] == 1.0 and given[4] == 96 and given[6] == 5
        assert given[3] == pytest.approx(96.0, rel=1e-8) and given[3] > 96.0


@pytest.mark.parametrize("total, cycles", [(255, 1), (511, 1), (512, 2), (1024, 4), (1100, 4)])
def test_windows_of_long_recordings_and_of_a_least_length(total, cycles):
    time = np.arange(total * 10) / 10.0
    for length in (1, 3, 9):
        (given,) = asked_of(time, np.cos(time)[None], 1.0, [1.0], length)[1]
        assert given[4:6] == (total, max(length, cycles)) and given[6] == 4  # harmonics of 10 samples


@pytest.mark.parametrize("per_cycle, total, highest", [(3.37, 200, 5), (2.5, 200, 2), (7.9, 200, 5), (3.37, 30, 5)])
def test_windows_of_slow_sampling_have_three_samples_for_each_unknown(per_cycle, total, highest):
    """At most a sixth of all cycles; higher harmonics than the fifth, fitted to all samples, are subtracted before."""
    time = 0.3 + np.arange(round(total * per_cycle)) / per_cycle
    low = np.array([np.cos(2 * np.pi * time), 1.0 + np.sin(2 * np.pi * highest * time + 0.2)])
    high = 0.3 * np.cos(2 * np.pi * 7 * time) if highest == 5 else 0.0
    (given,) = asked_of(time, low + high, 1.0, [1.0])[1]
    cycles = min(int(np.ceil(3.0 * (2 * highest + 1) / per_cycle)), int(time.size / per_cycle + 1e-9) // 6)
    assert given[5:] == (max(cycles, 1), highest)
    np.testing.assert_allclose(given[1], low, atol=1e-9)
    (long,) = asked_of(time, low, 1.0, [1.0], 12)[1]
    assert long[5] == max(12, cycles)


def holed(lumps=(), thin=(), kept=20, empty=(), total=100, per_cycle=40, gap=0.0, gaps=()):
    """Return times of 1 Hz: cycles with all samples in a tenth, with fewer ones, without any, or with a gap."""
    every = []
    for k in range(total):
        phase = np.arange(per_cycle) / per_cycle
        if k in lumps:
            phase = 0.85 + 0.1 * phase
        if k in thin:
            phase = (1.0 + np.arange(kept)) / kept - 1.0 / per_cycle
        if k in gaps:
            phase = np.r_[0.0, gap + (1.0 - gap) * np.arange(1, per_cycle) / per_cycle]
        every.append(k + phase[: 0 if k in empty else None])
    return np.concatenate(every)


def windowed(time, values, cycles=1, highest=5):
    duration = np.ptp(time) + 1.0 / 40 + 1e-9
    return steadiness._windows_of(time, values, 1.0, duration, int(duration), cycles, highest)


@pytest.mark.parametrize("kept, few", [(20, False), (19, True)])
def test_windows_with_too_few_samples_or_phases_are_missing(kept, few):
    """_windows_of: half of the usual samples are enough; all in a tenth of a cycle determine nothing."""
    lumps, thin, empty = [20, 21, 22], [50, 51], [60]
    time = holed(lumps, thin, kept, empty)
    every, share = windowed(time, np.array([np.cos(2 * np.pi * time), np.sin(4 * np.pi * time)]))
    missing = {*lumps, *empty, *(thin if few else [])}
    assert every.place.tolist() == [k for k in range(100) if k not in missing]
    assert share == pytest.approx((100 - len(missing)) / 99)
    assert every.first.tolist() == np.searchsorted(time, every.place - 1e-6).tolist()
    assert every.last.tolist() == np.searchsorted(time, every.place + 1 - 1e-6).tolist()
    expected = np.zeros((2, 6), dtype=complex)
    expected[0, 1], expected[1, 2] = 1.0 / np.cos(2 * np.pi * time).std(), -1j / np.sin(4 * np.pi * time).std()
    np.testing.assert_allclose(every.amplitudes, np.broadcast_to(expected, every.amplitudes.shape), atol=1e-9)


@pytest.mark.parametrize("gap", [0.1, 0.13, 0.16, 0.18, 0.2, 0.22, 0.25, 0.3, 0.4])
def test_windows_with_a_gap_count_up_to_a_condition_number_of_thirty(gap):
    """_windows_of: of the normal equations of harmonics −5 … 5, whatever the number of samples."""
    time = holed(gap=gap, gaps=[10, 11])
    phase = time[(time > 9.99) & (time < 10.99)]
    waves = np.exp(2j * np.pi * np.outer(phase, np.arange(-5, 6)))
    size = np.linalg.eigvalsh(np.conj(waves.T) @ waves)
    assert abs(size[0] * 30.0 / size[-1] - 1.0) > 1e-3
    every, _ = windowed(time, np.cos(2 * np.pi * time)[None])
    assert ({10, 11} <= {*every.place.tolist()}) == bool(size[0] * 30.0 > size[-1])


@pytest.mark.parametrize("total, fine", [(60, 8), (100, 1)])
@pytest.mark.parametrize("step", [1.0, 3.0])
def test_slip_is_that_of_the_jumps_of_a_square_wave(total, fine, step):
    """Second differences of two steps at jumps of two, twice; relative to 40 samples and the standard deviation."""
    time = np.arange(total * 40) / 40.0
    values = np.array([step * np.where((time + 0.01) % 1.0 < 0.5, 1.0, -1.0), np.cos(2 * np.pi * time)])
    every, share = windowed(time, values)
    assert every.overlap == fine and share == 1.0
    assert every.slip[0] == pytest.approx(2.0 * 2.0 / 40) and every.jump[0] == every.slip[0]
    assert every.slip[1] == pytest.approx(2.0 * (2.0 * np.pi / 40) ** 2 / 40 * np.sqrt(2.0), rel=1e-2)
    assert every.jump[1] == 0.0
    slow = time[::6]
    assert windowed(slow, values[:, ::6], highest=1)[0].slip.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("start", [0, 13])
def test_whole_cycles_before_the_first_window_belong_to_it(start):
    """_windows_of: 770 cycles and a part of one are 256 windows of three and two cycles before them."""
    time = np.arange(-start, 770 * 40) / 40.0
    every = steadiness.windows(time, np.cos(2 * np.pi * time)[None], 1.0)
    assert every.cycles == 3 and every.first[0] == start and every.last[0] == start + 5 * 40
    assert every.first[1] == every.last[0] and len(every.first) == 256
