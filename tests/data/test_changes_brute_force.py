"""Changes of the amplitudes against their definition: covariances of every course and size, one after the other."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from bayesperiodic.data import changes as module

SIZES, FREQUENT, SHARED = (3.0, 10.0, 100.0), (0.7, 0.2, 0.1), 0.2


def noises(count):
    """Return probabilities and correlations: white noise 0.9, and six kinds with a part that lasts for some cycles."""
    yield 0.9, np.eye(count)
    for memory in (0.5, 0.8):
        for share in (0.3, 0.8, 1.0):
            yield 0.1 / 6, (1.0 - share) * np.eye(count) + share * toeplitz(memory ** np.arange(count))


def evidence(y, covariance):
    """Return the density of y but a common factor: constant and level of the noise unknown, priors flat and 1/σ."""
    inverse = np.linalg.inv(covariance)
    weight = inverse.sum()
    rest = inverse - np.outer(inverse.sum(axis=1), inverse.sum(axis=0)) / weight
    square = y @ rest @ y + len(y) * 1e-12
    return np.linalg.det(covariance) ** -0.5 * weight**-0.5 * square ** (-0.5 * (len(y) - 1))


def brute_force(shape, every, independent):
    """Return the probability of each course, and by component moments of its sizes, and of any change."""
    count, components = shape.shape
    ratio = np.zeros((3, len(every.kind), components))
    first = np.zeros((3, len(every.kind), 2, components))
    second = np.zeros((3, len(every.kind), 2, 2, components))
    none = np.array([sum(p * evidence(y, c) for p, c in noises(count)) for y in shape.T])
    for m, values in enumerate(every.values):
        s = values[:, : 1 if every.single[m] else 2]
        for p, covariance in noises(count):
            inverse = np.linalg.inv(covariance)
            centred = s - inverse.sum(axis=0) @ s / inverse.sum()
            gram = centred.T @ inverse @ centred
            for k, size in enumerate(SIZES):
                whole = covariance + size**2 * centred @ np.linalg.solve(gram, centred.T)
                for d, y in enumerate(shape.T):
                    given = p * evidence(y, whole) / none[d]
                    kept = size**2 / (1.0 + size**2)
                    fit = np.linalg.solve(gram, centred.T @ inverse @ (y - inverse.sum(axis=0) @ y / inverse.sum()))
                    mean, r = kept * fit, y - inverse.sum(axis=0) @ y / inverse.sum()
                    level = (r @ inverse @ r - kept * fit @ gram @ fit) / (count - 1)
                    part = slice(s.shape[1])
                    ratio[k, m, d] += given
                    first[k, m, part, d] += given * mean
                    second[k, m, part, part, d] += given * (np.outer(mean, mean) + kept * level * np.linalg.inv(gram))
    share = min(independent / components, 1.0)
    gain = np.prod(((1.0 - SHARED) + SHARED * ratio) ** share, axis=2)
    weight = gain * np.exp(every.prior) * np.array(FREQUENT)[:, None]
    weight /= weight.sum() + every.constant
    member = SHARED * ratio / (1.0 - SHARED + SHARED * ratio)
    each = weight[:, :, None] * member / ratio
    return (
        weight.sum(axis=0), (each[:, :, None] * first).sum(axis=0), (each[:, :, None, None] * second).sum(axis=0),
        (each * ratio).sum(axis=(0, 1)),
    )  # fmt: skip


def example(kind, count=7):
    generator, cycle = np.random.default_rng(4), np.arange(count)
    shape = generator.standard_normal((count, 3))
    course = {"none": 0.0, "transient": 9.0 * np.exp(-cycle / 1.5), "drift": 1.5 * cycle, "step": 5.0 * (cycle >= 4)}
    shape[:, 1] += course[kind]
    return 0.01 * shape


@pytest.mark.parametrize("kind", ["none", "transient", "drift", "step"])
def test_probabilities_and_sizes_of_changes_are_those_of_their_definition(kind):
    shape = example(kind)
    every = module.courses(len(shape), 0.6, 0.5)
    seen = module._posterior(shape, every, 2.0)
    weight, first, second, moving = brute_force(shape, every, 2.0)
    np.testing.assert_allclose(seen.weight, weight, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(seen.first, first, rtol=1e-4, atol=1e-8)
    seen.second[every.single, 1, 1] = 0.0  # of a column of zeros
    np.testing.assert_allclose(seen.second, second, rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(seen.moving, moving, rtol=1e-4)


def test_error_of_the_means_is_that_of_the_noise_beside_the_changes():
    """Without a change, the variance of the mean by generalised least squares, by the probabilities of the noises."""
    shape = 0.01 * np.random.default_rng(8).standard_normal((7, 1))
    every = module.courses(7, 1e-9, 0.5)
    every.prior[:] = np.log(1e-12)
    seen = module._posterior(shape, every, 1.0)
    weights, variances = [], []
    for p, covariance in noises(7):
        inverse = np.linalg.inv(covariance)
        r = shape[:, 0] - inverse.sum(axis=0) @ shape[:, 0] / inverse.sum()
        weights.append(p * evidence(shape[:, 0], covariance))
        variances.append((r @ inverse @ r) / 6 / inverse.sum())
    assert seen.error[0] == pytest.approx(np.sqrt(np.average(variances, weights=weights)), rel=1e-6)


@pytest.mark.parametrize("transient, count, longest", [(0.6, 20, 0.5), (0.9, 8, 0.25), (0.6, 200, 0.5)])
def test_courses_and_their_probabilities(transient, count, longest):
    """Transients and their angles share the probability given; a drift, steps, lines and a constant share the rest."""
    every, cycle = module.courses(count, transient, longest), np.arange(count)
    probability = np.exp(every.prior)
    assert probability.sum() + every.constant == pytest.approx(1.0)
    decaying = every.fades
    assert probability[decaying].sum() == pytest.approx(transient)
    rest = 1.0 - transient
    linear = ~decaying & (every.kind == module.DRIFT)
    assert [
        probability[one].sum() / rest for one in (linear, every.kind == module.STEP, every.kind == module.TONE)
    ] == (pytest.approx([0.4, 0.1, 0.1]))
    assert every.constant == pytest.approx(0.4 * rest)
    decays = np.unique(every.place[decaying])
    np.testing.assert_allclose(decays, np.geomspace(0.3, 0.5 * count, 12))
    for decay in decays:
        these = decaying & (every.place == decay)
        turns = every.turn[these]
        assert np.array_equal(turns[-12:], np.linspace(0.0, np.pi, 13)[1:]) and turns[0] == 0.0
        near = turns[:-12]
        slow = [0.0, *(angle for angle in (0.7 / decay, 1.5 / decay) if angle < np.pi / 12 / 1.5)]
        assert near == pytest.approx(slow) and probability[these][: near.size].sum() == pytest.approx(
            0.7 * transient / 12
        )
        assert {*every.kind[these]} == {module.TRANSIENT if decay <= longest * count else module.DRIFT}
    wave = np.exp(-cycle / np.where(decaying, every.place, np.inf)[:, None] + 1j * every.turn[:, None] * cycle)
    waves = decaying | (every.kind == module.TONE)
    np.testing.assert_allclose(every.values[waves, :, 0], wave.real[waves], atol=1e-9)
    np.testing.assert_allclose(
        every.values[waves, :, 1], np.where(every.single[waves, None], 0.0, wave.imag[waves]), atol=1e-9
    )
    np.testing.assert_allclose(every.values[linear][0, :, 0], np.linspace(0.0, 1.0, count))
    steps = every.kind == module.STEP
    assert every.place[steps].min() == 2 and every.place[steps].max() == count - 2
    assert np.array_equal(every.values[steps][:, :, 0], cycle >= every.place[steps][:, None])
    assert steps.sum() == min(count - 3, 64)
    tones = every.turn[every.kind == module.TONE]
    np.testing.assert_allclose(tones, np.pi * np.arange(1, tones.size + 1) / tones.size if count > 128 else
                               2 * np.pi * np.arange(1, count // 2 + 1) / count)  # fmt: skip
    assert np.array_equal(every.single, np.abs(every.values[:, :, 1]).max(axis=1) == 0.0)


def test_effects_are_means_over_the_later_cycles():
    """Of a transient its mean from cycle k on; of a drift or step the difference to its first or last value."""
    shape = example("step")
    every = module.courses(7, 0.6, 0.5)
    weight, first, second, moving = brute_force(shape, every, 2.0)
    seen = module._effects(every, module._posterior(shape, every, 2.0))
    transient, squares, lasting = np.zeros((7, 3)), np.zeros((7, 3)), np.zeros((7, 3))
    size = np.zeros(3)
    for m, values in enumerate(every.values):
        slow = every.kind[m] in (module.DRIFT, module.STEP)
        size += slow * (values[-1] - values[0]) @ first[m]
        for k in range(7):
            mean = values[k:].mean(axis=0)
            by = lambda effect, m=m: np.einsum("a,b,abd->d", effect, effect, second[m])  # noqa: E731
            if every.kind[m] == module.TRANSIENT:
                transient[k] += mean @ first[m]
                squares[k] += by(mean)
            elif slow and every.fades[m]:
                lasting[k] += by(mean)
            elif slow:
                lasting[k] += 0.5 * (by(mean - values[k]) + by(mean - values[-1]))
    np.testing.assert_allclose(seen.transient, transient, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(seen.squares, squares, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(seen.lasting, lasting, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(seen.size, size, rtol=1e-4)
    assert seen.probability == {
        kind: pytest.approx(weight[every.kind == kind].sum(), rel=1e-4)
        for kind in (module.TRANSIENT, module.DRIFT, module.STEP, module.TONE)
    }
    assert seen.place == 4 and seen.moving == pytest.approx(moving, rel=1e-4)
    error = module._posterior(shape, every, 2.0).error
    np.testing.assert_allclose(seen.error, error * np.sqrt(7 / np.arange(7, 0, -1.0))[:, None])
    np.testing.assert_allclose(seen.bias, np.sqrt(np.sum((seen.transient / seen.error) ** 2, axis=1)))
    assert seen.slow == (seen.probability[module.DRIFT] + seen.probability[module.STEP] > 0.5)
    # Without noise, standard errors are about those of the least noise that counts, and never zero.
    exact = module.changes(np.zeros((7, 2)), 0.6).error * np.sqrt(np.arange(7, 0, -1.0))[:, None]
    assert exact.min() > 1e-6 and exact.max() < 2e-6


@pytest.mark.parametrize("turn", [0.9, 1.7])
def test_a_beat_is_named_by_its_turn_and_decay(turn):
    """Of 40 cycles; a component that decays and turns has both within the scatter by noise of a hundredth."""
    cycle = np.arange(40)
    shape = 0.01 * np.random.default_rng(1).standard_normal((40, 4))
    shape[:, 2] += np.exp(-cycle / 30.0) * np.cos(turn * cycle + 0.3)
    seen = module.changes(shape, 0.6)
    assert seen.oscillating > 0.99 and seen.beat == (
        pytest.approx(2 * np.pi / turn, rel=0.01),
        pytest.approx(30, rel=0.15),
    )
    assert seen.swing[2] == pytest.approx(1.0, rel=0.1) and np.delete(seen.swing, 2).max() < 0.05


@pytest.mark.parametrize("decay, turn", [(3.0, 0.0), (6.0, 0.7), (2.0, np.pi)])
def test_a_course_is_refined_to_that_of_the_components(decay, turn):
    """Without noise but rounding; the new course takes half of the probability of that from which it came."""
    cycle = np.arange(30)
    wave = np.exp(-cycle / decay + 1j * turn * cycle)
    shape = np.column_stack([1.0 + wave.real, 2.0 - 0.5 * wave.real + 0.3 * wave.imag, -wave.real])
    every = module.courses(30, 0.6, 0.5)
    index = int(np.argmin(np.abs(every.place - decay) + 20 * np.abs(every.turn - turn) + 1e3 * ~every.fades))
    before = np.exp(every.prior[index])
    finer = every.refined(index, shape)
    assert finer.place[-1] == pytest.approx(decay, rel=1e-3) and finer.turn[-1] == pytest.approx(turn, abs=1e-3)
    assert np.exp(finer.prior[[index, -1]]) == pytest.approx([0.5 * before] * 2)
    assert len(finer.kind) == len(every.kind) + 1 and finer.kind[-1] == module.TRANSIENT and finer.fades[-1]
    assert finer.single[-1] == (turn in (0.0, np.pi))
    np.testing.assert_allclose(finer.values[-1, :, 0], wave.real, atol=1e-3)
    step = int(np.flatnonzero(every.kind == module.STEP)[0])
    assert every.refined(step, shape) is every


def test_number_of_independent_components():
    """Of white noise of its own in each component nearly all, of one noise in all components one."""
    generator = np.random.default_rng(3)
    white = generator.standard_normal((200, 20))
    assert module._independent(white, None) == pytest.approx(20.0, rel=0.25)
    one = white[:, :1] * np.linspace(1.0, 5.0, 20)
    assert module._independent(one, None) == pytest.approx(1.0, rel=0.3)
    groups = np.repeat(white[:, :4], 5, axis=1)
    assert module._independent(groups, None) == pytest.approx(4.0, rel=0.35)
    course = np.column_stack([np.exp(-np.arange(200) / 20), np.zeros(200)])
    assert module._independent(white + 50 * course[:, :1], course) == pytest.approx(20.0, rel=0.25)
    assert module._independent(np.zeros((9, 5)), None) == 5.0
    # Components without noise do not count.
    assert module._independent(np.column_stack([white, np.zeros((200, 30))]), None) == pytest.approx(20.0, rel=0.25)
