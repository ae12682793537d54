"""Courses of changes that are added, what is fitted, and which noise is compared: `changes` step by step."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import toeplitz

from bayesperiodic.data import changes as module


def wave(count, decay, turn):
    return np.exp(-np.arange(count) / decay + 1j * turn * np.arange(count))


@pytest.mark.parametrize(
    "decay, turn, kind, fades",
    [
        (9.9, 0.0, module.TRANSIENT, True), (10.1, 0.0, module.DRIFT, True), (19.9, 0.0, module.DRIFT, True),
        (20.1, 0.0, module.DRIFT, False), (200.0, 4.4 / 40, module.DRIFT, False), (200.0, 4.6 / 40, module.DRIFT, True),
    ],
)  # fmt: skip
@pytest.mark.parametrize("index", [0, 30])
def test_a_course_that_is_added_takes_half_of_the_probability_of_another_one(decay, turn, kind, fades, index):
    """Courses._with: of 40 cycles a transient up to a quarter, slow courses beyond a half have no known end."""
    every = module.courses(40, 0.6, 0.25)
    before = every.prior.copy()
    values = np.column_stack([wave(40, decay, turn).real, wave(40, decay, turn).imag])
    added = every._with(values, index, decay, turn)
    assert (added.kind[-1], added.fades[-1], added.place[-1], added.turn[-1]) == (kind, fades, decay, turn)
    assert added.single[-1] == (turn == 0.0) and np.array_equal(added.values[-1], values)
    expected = np.append(before, before[index] + np.log(0.5))
    expected[index] = before[index] + np.log(0.5)
    np.testing.assert_allclose(added.prior, expected)
    assert np.array_equal(every.prior, before) and (added.constant, added.longest) == (every.constant, every.longest)
    for name in ("values", "single", "fades", "kind", "place", "turn"):
        assert np.array_equal(getattr(added, name)[:-1], getattr(every, name))
    small = values * [1.0, 1e-10]
    assert every._with(small, index, decay, turn).single[-1]


@pytest.mark.parametrize("turn, count", [(1.3, 40), (0.4, 60), (np.pi, 30)])
def test_a_line_is_refined_to_one_that_hardly_decays(turn, count):
    """Courses.refined: its decay time begins at 20 times the recording, the longest one, and stays there."""
    generator = np.random.default_rng(2)
    shape = 1e-4 * generator.standard_normal((count, 3)) + 5.0
    shape[:, 1] += np.real(np.exp(0.4j) * wave(count, np.inf, turn))
    every = module.courses(count, 0.6, 0.5)
    tones = np.flatnonzero(every.kind == module.TONE)
    index = int(tones[np.argmin(np.abs(every.turn[tones] - turn))])
    finer = every.refined(index, shape)
    assert finer.turn[-1] == pytest.approx(turn, abs=3e-4) and finer.place[-1] > 5.0 * count
    assert finer.kind[-1] == module.DRIFT and finer.fades[-1]


@pytest.mark.parametrize("decay", [0.2, 0.45, 900.0])
def test_decay_times_are_refined_within_their_limits(decay):
    """From 0.3 cycles to 20 times 30 cycles; a slower course is as good as the slowest."""
    shape = np.column_stack([wave(30, decay, 0.0).real, -2.0 * wave(30, decay, 0.0).real])
    every = module.courses(30, 0.6, 0.5)
    real = every.fades & (every.turn == 0.0)
    index = int(np.flatnonzero(real)[np.argmin(np.abs(np.log(every.place[real] / decay)))])
    finer = every.refined(index, shape)
    assert finer.place[-1] == pytest.approx(np.clip(decay, 0.3, 600.0), rel=0.02) and finer.turn[-1] == 0.0


@pytest.mark.parametrize("apart", [0.25, 0.4])
@pytest.mark.parametrize("whole", [0.0, np.pi])
def test_turns_near_none_or_a_half_are_those(apart, whole):
    """Where sine and cosine are not told apart: 0.3 over all of 30 cycles."""
    turn = abs(whole - apart / 30)
    shape = np.column_stack([wave(30, 40.0, turn).real, wave(30, 40.0, turn).imag])
    every = module.courses(30, 0.6, 0.5)
    near = np.flatnonzero(every.fades & (np.abs(every.turn - whole) < 1e-9))
    index = int(near[np.argmax(every.place[near])])
    finer = every.refined(index, shape)
    assert (finer.turn[-1] == whole) == (apart < 0.3) and abs(finer.turn[-1] - turn) < 0.3 / 30


@pytest.mark.parametrize("weight, kind, fitted", [(0.201, "transient", 1), (0.199, "transient", 0), (0.9, "step", 0)])
def test_the_course_of_a_change_is_fitted_if_there_may_be_one(weight, kind, fitted, monkeypatch):
    """From a probability of a fifth of all changes on; a step is on the grid already."""
    shape = np.random.default_rng(1).standard_normal((12, 4))
    every = module.courses(12, 0.7, 0.3)
    index = int(np.flatnonzero(every.kind == kind)[3])
    weights = np.full(len(every.kind), 0.1 * weight / (len(every.kind) - 1))
    weights[index] = 0.9 * weight
    asked, refined = [], every._with(every.values[index] + 0.1, index, 1.0, 0.0)
    monkeypatch.setattr(module, "courses", lambda *given: asked.append(("courses", given)) or every)
    monkeypatch.setattr(module, "_independent", lambda *given: asked.append(("independent", given)) or 2.0)
    monkeypatch.setattr(
        module, "_posterior", lambda *given: asked.append(("posterior", given)) or SimpleNamespace(weight=weights)
    )
    monkeypatch.setattr(module, "_effects", lambda *given: given)
    monkeypatch.setattr(module.Courses, "refined", lambda self, *given: asked.append(("refined", given)) or refined)
    seen, posterior = module.changes(shape, 0.7, 0.3)
    assert seen is (refined if fitted else every) and posterior.weight is weights
    names = ["courses", "independent", "posterior", "refined", "independent", "posterior"]
    assert [name for name, _ in asked] == names[: 6 if fitted else 3]
    assert asked[0][1] == (12, 0.7, 0.3) and asked[1][1] == (shape, None) and asked[2][1] == (shape, every, 2.0)
    if fitted:
        assert asked[3][1] == (index, shape) and asked[5][1] == (shape, refined, 2.0)
        assert asked[4][1][0] is shape and np.array_equal(asked[4][1][1], refined.values[-1])
        # Without a finer course, that of the grid is subtracted.
        asked.clear()
        monkeypatch.setattr(module.Courses, "refined", lambda self, *_: self)
        assert module.changes(shape, 0.7, 0.3)[0] is every
        assert np.array_equal(asked[3][1][1], every.values[index])


def test_noise_is_white_or_has_a_part_that_lasts():
    """changes._covariances: nine tenths for white noise, the rest for two memories and three shares."""
    pairs = module._covariances(6)
    assert np.exp([prior for prior, _ in pairs]) == pytest.approx([0.9, *[0.1 / 6] * 6])
    expected = [np.eye(6)]
    for memory in (0.5, 0.8):
        for share in (0.3, 0.8, 1.0):
            expected.append((1.0 - share) * np.eye(6) + share * toeplitz(memory ** np.arange(6)))
    for (_, factor), covariance in zip(pairs, expected, strict=True):
        np.testing.assert_allclose(factor @ factor.T, covariance, atol=1e-12)
        assert np.all(np.triu(factor, 1) == 0.0)


def test_expected_squares_of_effects():
    """changes._squares: Σ e_a e_b E[s_a s_b] over the courses, by cycle and component."""
    generator = np.random.default_rng(1)
    effects, sizes = generator.standard_normal((3, 5, 2)), generator.standard_normal((3, 2, 4))
    moments = np.einsum("mad,mbd->mabd", sizes, sizes)
    expected = np.zeros((5, 4))
    for m in range(3):
        expected += (effects[m] @ sizes[m]) ** 2
    np.testing.assert_allclose(module._squares(effects, moments), expected)


@pytest.mark.parametrize("count, components", [(9, 4), (30, 6)])
@pytest.mark.parametrize("fitted", [False, True])
def test_effective_number_of_components_is_that_of_its_formula(count, components, fitted):
    """changes._independent: products of steps of different cycles, that are not next to each other."""
    generator = np.random.default_rng(count)
    shape = generator.standard_normal((count, components)) @ generator.standard_normal((components, components))
    course = np.column_stack([wave(count, 4.0, 0.3).real, wave(count, 4.0, 0.3).imag]) if fitted else None
    basis = np.ones((count, 1)) if course is None else np.column_stack([np.ones(count), course])
    left = np.eye(count) - basis @ np.linalg.solve(basis.T @ basis, basis.T)
    rest = left @ shape
    rest = rest / np.sqrt(np.sum(rest**2, axis=0) / (count - basis.shape[1]))
    steps = rest[1:] - rest[:-1]
    expected = np.array([[
        left[i + 1, j + 1] - left[i + 1, j] - left[i, j + 1] + left[i, j] for j in range(count - 1)
    ] for i in range(count - 1)])  # fmt: skip
    products = steps @ steps.T
    usual = np.trace(products) / np.trace(expected)
    pairs = [(i, j) for i in range(count - 1) for j in range(count - 1) if abs(i - j) > 1]
    square = np.mean([(products[i, j] - usual * expected[i, j]) ** 2 for i, j in pairs])
    number = np.median(np.diag(products)) ** 2 / square
    assert module._independent(shape, course) == pytest.approx(np.clip(number, 1.0, components))


def test_two_cycles_have_one_component_and_what_is_exact_all():
    assert module._independent(np.array([[0.0, 1.0], [1.0, 3.0]]), None) == 1.0
    assert module._independent(np.full((6, 3), 2.0), None) == 3.0


@pytest.mark.parametrize("size, counted", [(1.1e-6, True), (0.9e-6, False)])
def test_noise_of_a_millionth_does_not_count(size, counted):
    """Of its standard deviation about the mean, beside a component that does."""
    generator = np.random.default_rng(5)
    shape = generator.standard_normal((50, 2))
    other = generator.standard_normal(50)
    other = size * (other - other.mean()) / other.std(ddof=1)
    expected = module._independent(np.column_stack([shape, 1e3 * other]) if counted else shape, None)
    assert module._independent(np.column_stack([shape, other]), None) == pytest.approx(expected)
