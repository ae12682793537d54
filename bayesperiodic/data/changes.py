"""Changes of the amplitudes of cycles: decaying transients, drifts and steps, and their effects on the mean.

What is too weak to be detected cannot be left out, but has an expected squared effect, which belongs into the variance
of the mean. Each component of the amplitudes is a constant, noise, and at most one change of a given course, whose size
has a normal prior. Courses, sizes, and the noise (white, or with a part that lasts for some cycles) are averaged by
their posterior probabilities; levels of noise are integrated out, as with the g-prior of A. Zellner (1986).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular, toeplitz
from scipy.special import logsumexp

# Probabilities before the data: of a transient where the start was left out or not, of a drift, a step and a line
# beside the harmonics otherwise; and that a change is in any one component.
PROBABLE, POSSIBLE, DRIFTING, STEPPING, SOUNDING, SHARED = 0.9, 0.6, 0.4, 0.1, 0.1, 0.2
# Sizes of a change in standard deviations of its estimate.
SIZES, FREQUENT = np.array([3.0, 10.0, 100.0]), np.array([0.7, 0.2, 0.1])
# Correlation from one window to the next, and share of the variance, of noise that lasts; white noise is as probable
# as all others together.
MEMORIES, LASTING_SHARES, SLOW_NOISE = (0.5, 0.8), (0.3, 0.8, 1.0), 0.1
# Decay times of transients, in cycles and relative to the recording, their number, and the number of frequencies.
SHORTEST_DECAY, LONGEST_DECAY, DECAYS, FREQUENCIES = 0.3, 0.5, 12, 13
# Frequencies of slow transients near those of the harmonics, relative to 1/decay time, and places of steps.
NEAR, NEARBY, STEP_PLACES, FIRST_STEP, MOST_TONES = (0.7, 1.5), 0.7, 64, 2, 64
# Share of a channel's standard deviation below which noise does not count.
SMALLEST_NOISE = 1e-6
# Longest decay time relative to the recording of a transient of which a part can be left out, of a driven and of a
# free-running motion, whose drifts of the period look like slower ones; slower ones are drifts.
LONGEST_CUT, LONGEST_CUT_FREE = 0.5, 0.25
# Probability of a change from which its course is fitted, and longest decay time of it relative to the recording.
WORTH_A_FIT, LONGEST_FITTED = 0.2, 20.0
# Angle over the recording from which a change oscillates.
LEAST_TURN = 4.5
# Angle over the recording by which a turn differs from a whole or half one.
LEAST_OFFSET = 0.3
TRANSIENT, DRIFT, STEP, TONE = "transient", "drift", "step", "tone"


@dataclass(frozen=True)
class Courses:
    """Courses of changes over the cycles."""

    values: np.ndarray  # (courses, cycles, 2), the second column zero if there is one only
    single: np.ndarray  # (courses,)
    fades: np.ndarray  # (courses,) whether it ends at zero
    kind: np.ndarray  # (courses,)
    prior: np.ndarray  # (courses,) logarithms of probabilities
    place: np.ndarray  # (courses,) decay time, or first cycle after a step
    turn: np.ndarray  # (courses,) angle by which an oscillation turns in a cycle
    constant: float  # probability of no change
    longest: float  # decay time of a transient, relative to the recording

    def refined(self, index: int, shape: np.ndarray) -> "Courses":
        """Return the courses and one more: the best fit to components (cycles, components) near one of them."""
        from scipy.optimize import minimize

        count = len(shape)
        cycle = np.arange(count, dtype=float)
        tone = self.kind[index] == TONE
        if not (tone or self.fades[index]):
            return self
        scaled = shape - shape.mean(axis=0)
        floor = count * SMALLEST_NOISE**2

        def course(point: np.ndarray) -> np.ndarray:
            wave = np.exp(-cycle * np.exp(-point[0]) + 1j * point[1] * cycle)
            return np.column_stack([wave.real, wave.imag])

        def misfit(point: np.ndarray) -> float:
            flat = course(point)
            flat = flat - flat.mean(axis=0)
            u, d, _ = np.linalg.svd(flat, full_matrices=False)
            u = u[:, d > 1e-9 * d[0]]
            rest = np.sum(scaled**2, axis=0) - np.sum((u.T @ scaled) ** 2, axis=0)
            return float(np.log(np.maximum(rest, 0.0) + floor).sum())

        longest = np.log(LONGEST_FITTED * count)
        start = [longest if tone else np.log(self.place[index]), self.turn[index]]
        bounds = [(np.log(SHORTEST_DECAY), longest), (0.0, np.pi)]
        simplex = np.array([start, [start[0] - 0.3, start[1]], [start[0], start[1] + 0.5 / count]])
        simplex[2, 1] = simplex[2, 1] if simplex[2, 1] <= np.pi else start[1] - 0.5 / count
        best = minimize(misfit, start, method="Nelder-Mead", bounds=bounds, options={"initial_simplex": simplex})
        decay, turn = float(np.exp(best.x[0])), float(best.x[1])
        for whole in (0.0, np.pi):  # where sine and cosine are not told apart
            if abs(turn - whole) * count < LEAST_OFFSET:
                turn = whole
        return self._with(course(np.array([np.log(decay), turn])), index, decay, turn)

    def _with(self, values: np.ndarray, index: int, decay: float, turn: float) -> "Courses":
        """Return the courses and one more with half the prior probability of one of them."""
        count = self.values.shape[1]
        kind = TRANSIENT if decay <= self.longest * count else DRIFT
        prior = np.append(self.prior, self.prior[index] + np.log(0.5))
        prior[index] += np.log(0.5)
        return Courses(
            np.concatenate([self.values, values[None]]),
            np.append(self.single, np.abs(values[:, 1]).max() < 1e-9),
            # Where a slow course would end is no more known than where a drift would.
            np.append(self.fades, decay <= LONGEST_DECAY * count or turn * count > LEAST_TURN),
            np.append(self.kind, kind),
            prior,
            np.append(self.place, decay),
            np.append(self.turn, turn),
            self.constant,
            self.longest,
        )


@dataclass(frozen=True)
class _Posterior:
    """Probabilities of courses and moments of their sizes."""

    weight: np.ndarray  # (courses,)
    first: np.ndarray  # (courses, 2, components)
    second: np.ndarray  # (courses, 2, 2, components)
    error: np.ndarray  # (components,) of the mean by noise
    moving: np.ndarray  # (components,) probability of any change


@dataclass(frozen=True)
class Changes:
    """Changes of components of the amplitudes, and their effects on the means over cycles k, k + 1, …."""

    transient: np.ndarray  # (cycles, components) expected bias by a transient
    squares: np.ndarray  # (cycles, components) expected squares of it
    lasting: np.ndarray  # (cycles, components) expected squares of the bias by a drift or step
    probability: dict[str, float]  # of the kinds of changes
    moving: np.ndarray  # (components,) probability of any of them
    size: np.ndarray  # (components,) expected change by a drift or step
    error: np.ndarray  # (cycles, components) standard errors of the means by noise
    place: int  # most probable first cycle after a step
    swing: np.ndarray  # (components,) expected amplitude, in the first cycle, of a change that oscillates
    beat: tuple[float, float]  # probable number of cycles in which it does, and in which it decays
    oscillating: float  # probability of it

    @property
    def slow(self) -> bool:
        """Whether a drift or step is more probable than all else."""
        return self.probability[DRIFT] + self.probability[STEP] > 0.5

    @property
    def bias(self) -> np.ndarray:
        """Bias of all means together by a transient (cycles,), in standard errors."""
        return np.sqrt(np.sum((self.transient / self.error) ** 2, axis=1))


def courses(count: int, transient: float, longest: float) -> Courses:
    """Return courses over so many cycles, with this probability of a transient, and the longest decay time of one."""
    cycle = np.arange(count, dtype=float)
    every: list[tuple[np.ndarray, str, float, float, float]] = []
    decays = np.geomspace(SHORTEST_DECAY, max(LONGEST_DECAY * count, 2.0 * SHORTEST_DECAY), DECAYS)
    for decay in decays:
        linear = np.linspace(0.0, np.pi, FREQUENCIES)
        near = [0.0, *(a for a in np.array(NEAR) / decay if a < linear[1] / 1.5)]
        for angles, part in ((near, NEARBY), (linear[1:], 1.0 - NEARBY)):
            for angle in angles:
                course = np.exp(-cycle / decay + 1j * angle * cycle)
                kind = TRANSIENT if decay <= longest * count else DRIFT
                every.append((course, kind, transient * part / decays.size / len(angles), decay, angle))
    rest = 1.0 - transient
    fading = len(every)
    every.append((cycle / (count - 1), DRIFT, rest * DRIFTING, 0.0, 0.0))
    places = np.unique(np.linspace(FIRST_STEP, count - FIRST_STEP, STEP_PLACES).astype(int))
    every += [((cycle >= k).astype(float), STEP, rest * STEPPING / places.size, float(k), 0.0) for k in places]
    # Lines beside the harmonics, as of a subharmonic, do not decay, and have no effect on the mean.
    tones = np.arange(1, 1 + min(count // 2, MOST_TONES)) * max(1.0, count / 2 / MOST_TONES)
    turns = 2.0 * np.pi * tones / count
    every += [(np.exp(1j * turn * cycle), TONE, rest * SOUNDING / tones.size, 0.0, turn) for turn in turns]
    values = np.array([np.column_stack([course.real, course.imag]) for course, *_ in every])
    # The sine of the highest frequency is rounding.
    single = np.abs(values[:, :, 1]).max(axis=1) < 1e-9
    values[single, :, 1] = 0.0
    kinds, prior = np.array([k for _, k, *_ in every]), np.log([p for _, _, p, *_ in every])
    place, turn = np.array([p for *_, p, _ in every]), np.array([a for *_, a in every])
    constant = rest * (1.0 - DRIFTING - STEPPING - SOUNDING)
    return Courses(values, single, np.arange(len(every)) < fading, kinds, prior, place, turn, constant, longest)


def _covariances(count: int) -> list[tuple[float, np.ndarray]]:
    """Return logarithms of probabilities and Cholesky factors of the covariances of noise of variance one."""
    lasting = [
        (1.0 - share) * np.eye(count) + share * toeplitz(memory ** np.arange(count))
        for memory in MEMORIES
        for share in LASTING_SHARES
    ]
    priors = [1.0 - SLOW_NOISE, *np.full(len(lasting), SLOW_NOISE / len(lasting))]
    return [(float(np.log(p)), np.linalg.cholesky(c)) for p, c in zip(priors, [np.eye(count), *lasting], strict=True)]


def changes(shape: np.ndarray, transient: float, longest: float = LONGEST_CUT) -> Changes:
    """Return the expected changes of components (cycles, components), with this probability of a transient before.

    Transients that decay more slowly than the longest, relative to the recording, are drifts.
    """
    every = courses(len(shape), transient, longest)
    first = _posterior(shape, every, _independent(shape, None))
    best = int(np.argmax(first.weight))
    if first.weight.sum() < WORTH_A_FIT or every.kind[best] == STEP:
        return _effects(every, first)
    # Courses between those of the grid, and the correlation of what is noise beside the change.
    finer = every.refined(best, shape)
    course = every.values[best] if finer is every else finer.values[-1]
    return _effects(finer, _posterior(shape, finer, _independent(shape, course)))


def _posterior(shape: np.ndarray, every: Courses, independent: float) -> _Posterior:
    """Return probabilities of courses and moments of their sizes, with so many independent components of the noise."""
    count = len(shape)
    covariances = _covariances(count)
    scaled = shape - shape.mean(axis=0)
    floor = count * SMALLEST_NOISE**2
    kept = SIZES**2 / (1.0 + SIZES**2)
    columns = np.where(every.single, 1, 2)
    penalty = -0.5 * columns[:, None] * np.log1p(SIZES**2)  # (courses, sizes)
    degrees = count - 1
    nothing, something, coefficients, inverses, levels, white, means = [], [], [], [], [], [], []
    for prior, factor in covariances:
        z = solve_triangular(factor, np.column_stack([np.ones(count), scaled]), lower=True)
        flat = z[:, 0] / np.linalg.norm(z[:, 0])
        u = z[:, 1:] - flat[:, None] * (flat @ z[:, 1:])
        s = solve_triangular(factor, every.values.transpose(1, 0, 2).reshape(count, -1), lower=True)
        s = (s - flat[:, None] * (flat @ s)).reshape(count, -1, 2)
        total = np.einsum("kd,kd->d", u, u) + floor  # (components,)
        gram = np.einsum("kma,kmb->mab", s, s)
        gram[every.single, 1, 1] = 1.0
        gram += 1e-12 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        inverse = np.linalg.inv(gram)
        along = np.einsum("kma,kd->mad", s, u)
        coefficient = np.einsum("mab,mbd->mad", inverse, along)
        power = np.einsum("mad,mad->md", coefficient, along)
        remaining = np.maximum(total - kept[:, None, None] * power, 0.0) + 0.0  # (sizes, courses, components)
        determinant = -np.log(np.diag(factor)).sum() - np.log(np.linalg.norm(z[:, 0]))
        nothing.append(prior + determinant - 0.5 * degrees * np.log(total))
        something.append(
            prior + determinant - 0.5 * degrees * np.log(np.maximum(remaining, floor)) + penalty.T[:, :, None]
        )
        coefficients.append(coefficient)
        inverses.append(inverse)
        levels.append(np.maximum(remaining, floor) / degrees)
        means.append(1.0 / (z[:, 0] @ z[:, 0]))
        white.append(total / degrees * means[-1])
    none = np.array(nothing)  # (noises, components)
    some = np.array(something)  # (noises, sizes, courses, components)
    clear = logsumexp(some, axis=0) - logsumexp(none, axis=0)  # (sizes, courses, components)
    noise = np.sqrt(np.array(white[0]) * count)
    noisy = noise > 2.0 * SMALLEST_NOISE
    share = min(independent / max(noisy.sum(), 1), 1.0)
    total_gain = share * np.logaddexp(np.log1p(-SHARED), np.log(SHARED) + clear)[:, :, noisy].sum(axis=2)
    weight = total_gain + every.prior + np.log(FREQUENT)[:, None]
    constant = np.log(every.constant)
    weight = np.exp(weight - np.logaddexp(logsumexp(weight), constant))  # (sizes, courses)
    member = 1.0 / (1.0 + (1.0 / SHARED - 1.0) * np.exp(-np.clip(clear, -500, 500)))
    each = np.exp(some - logsumexp(some, axis=0)) * (
        weight[:, :, None] * member
    )  # (noises, sizes, courses, components)
    first = np.einsum("jsmd,s,jmad->mad", each, kept, np.array(coefficients))
    second = np.einsum(
        "jsmd,s,jmad,jmbd->mabd", each, kept**2, np.array(coefficients), np.array(coefficients), optimize=True
    )
    second += np.einsum("jsmd,s,jsmd,jmab->mabd", each, kept, np.array(levels), np.array(inverses), optimize=True)
    constant_part = (1.0 - each.sum(axis=(0, 1, 2))) * np.exp(none - logsumexp(none, axis=0))  # (noises, components)
    variances = np.einsum("jsmd,jsmd,j->jd", each, np.array(levels), np.array(means)) + constant_part * np.array(white)
    error = np.sqrt(variances.sum(axis=0))
    return _Posterior(weight.sum(axis=0), first, second, error, each.sum(axis=(0, 1, 2)))


def _effects(every: Courses, posterior: _Posterior) -> Changes:
    """Return the effects of changes."""
    weight, first, second = posterior.weight, posterior.first, posterior.second
    count = every.values.shape[1]
    remaining = np.arange(count, 0, -1.0)
    later = np.cumsum(every.values[:, ::-1], axis=1)[:, ::-1] / remaining[:, None]
    transient, drifting = every.kind == TRANSIENT, every.kind == DRIFT
    slow, asymptotic = drifting | (every.kind == STEP), drifting & every.fades
    # A transient ends at zero, so that its mean is the bias; of other changes the begin or the end is the right one.
    mean = np.einsum("mka,mad->kd", later[transient], first[transient])
    squares = _squares(later[transient], second[transient])
    lasting, either = _squares(later[asymptotic], second[asymptotic]), slow & ~asymptotic
    for side in (every.values[either], np.repeat(every.values[either, -1:], count, axis=1)):
        lasting += 0.5 * _squares(later[either] - side, second[either])
    probability = {kind: float(weight[every.kind == kind].sum()) for kind in (TRANSIENT, DRIFT, STEP, TONE)}
    steps = np.flatnonzero(every.kind == STEP)
    # Fractions of a turn are no oscillation that can be told from a drift.
    turning = (drifting | (every.kind == TONE)) & (every.turn * count > LEAST_TURN)
    fastest = int(np.argmax(np.where(turning, weight, 0.0)))
    ends = every.values[slow, -1] - every.values[slow, 0]
    return Changes(
        transient=mean,
        squares=squares,
        lasting=lasting,
        probability=probability,
        moving=posterior.moving,
        size=np.einsum("ma,mad->d", ends, first[slow]),
        error=posterior.error * np.sqrt(count / remaining)[:, None],
        place=int(every.place[steps[np.argmax(weight[steps])]]),
        swing=np.abs(np.einsum("mka,mad->mkd", every.values[turning], first[turning]))
        .max(axis=1, initial=0.0)
        .sum(axis=0),
        beat=(2.0 * np.pi / max(float(every.turn[fastest]), LEAST_TURN / count), float(every.place[fastest])),
        oscillating=float(weight[turning].sum()),
    )


def _squares(effects: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return expected squares (cycles, components) of effects (courses, cycles, 2) by second moments of their sizes."""
    return np.asarray(np.einsum("mka,mkb,mabd->kd", effects, effects, moments, optimize=True))


def _independent(shape: np.ndarray, course: np.ndarray | None) -> float:
    """Return the effective number of independent components of noise, by the products of different cycles' steps.

    A course (cycles, 2) is fitted and subtracted before.
    """
    step = np.diff(np.eye(len(shape)), axis=0)
    basis = np.ones((len(shape), 1)) if course is None else np.column_stack([np.ones(len(shape)), course])
    rest = shape - basis @ np.linalg.lstsq(basis, shape, rcond=None)[0]
    freedom = len(shape) - np.linalg.matrix_rank(basis)
    size = np.sqrt(np.sum(rest**2, axis=0) / freedom)
    noisy = size > SMALLEST_NOISE
    if not noisy.any():
        return float(shape.shape[1])
    steps = step @ (rest[:, noisy] / size[noisy])
    products = steps @ steps.T
    number = np.arange(len(steps))
    apart = np.abs(number[:, None] - number) > 1
    # The fit correlates what it leaves of white noise.
    fitted = np.eye(len(shape)) - basis @ np.linalg.pinv(basis)
    expected = step @ fitted @ step.T
    usual = np.trace(products) / np.trace(expected)
    square = float(np.mean((products - usual * expected)[apart] ** 2)) if apart.any() else 0.0
    if not square > 0.0:
        return 1.0
    return float(np.clip(np.median(np.diag(products)) ** 2 / square, 1.0, steps.shape[1]))
