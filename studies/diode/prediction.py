"""What posterior draws predict where nothing was fitted: motions by time integration, and period doublings."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numba import njit

import bayesperiodic as bp
from studies import common
from studies.diode import rig

# Longest step of the integration [s]: the diode blocks within R·C_j.
STEP = 4e-9
TRANSIENT, KEPT, LONGEST = 120, 64, 8
# Instants a period at which motions are compared, and the share of the variance that a period may leave: smaller
# alternations are not counted, for they begin at zero.
PHASES, LEFT = 16, 1e-2
# Fewest draws a thread: so many are integrated in hardly more time than one.
TOGETHER = 12
ORDER = ("R", "R_s", "L", "R_L", "C_L", "V_f", "C_j", "Q_0", "transit", "lifetime", "drift", "bypass")
Draw = Mapping[str, float]


def draws_of(final: rig.Fitted, count: int, seed: int, *, robust: bool = True) -> list[dict[str, float]]:
    """Return draws of the parameters with the robust covariance, or with Laplace's as if the model were true.

    They are log-normal, but for the bypass, which can be zero: it is normal.
    """
    fit, known = final.fit, rig.values_of(final)
    names = [name for name in ORDER if name in fit.theta]
    table = fit.robust_covariance if robust else fit.covariance
    estimate, positive = np.array([fit.theta[name] for name in names]), np.array(names) != "bypass"
    scale = np.where(positive, estimate, 1.0)
    covariance = table.loc[names, names].to_numpy() / np.outer(scale, scale)
    sd = np.sqrt(np.diag(covariance))
    generator = np.random.default_rng(seed)
    normal = generator.multivariate_normal(np.zeros(len(names)), covariance / np.outer(sd, sd), count, method="eigh")
    values = np.where(positive, estimate * np.exp(normal * sd), estimate + normal * sd)
    return [dict(zip(names, row.tolist(), strict=True)) | {n: known[n] for n in ("R", "R_s")} for row in values]


def source_of(record: rig.Record) -> tuple[float, float]:
    """Return the mean and the amplitude of the source [V] at the frequency of a record."""
    values, time = next(iter(record.recording.inputs.values())), record.recording.time
    turn = 2 * np.pi * record.frequency * time
    columns = np.stack([np.ones(time.size), np.cos(turn), np.sin(turn)], axis=1)
    mean, cosine, sine = np.linalg.lstsq(columns, values, rcond=None)[0]
    return float(mean), float(np.hypot(cosine, sine))


def sweep(
    draws: Sequence[Draw], frequencies: Sequence[float], sources: Sequence[tuple[float, float]], kept: int = KEPT
) -> np.ndarray:
    """Return the resistor's voltage [V] in successive periods of the source (draws, frequencies, kept, phases).

    The first phase is that of the largest source. The mean over these periods is subtracted, as by the instrument. Each
    motion starts from the end of the one at the frequency before, as in a sweep in the laboratory; the first from that
    at 90 % of its frequency.
    """
    values = np.array([[draw[name] for name in ORDER] for draw in draws])
    found = np.empty((len(draws), len(frequencies), kept, PHASES))

    def part(numbers: np.ndarray) -> None:
        own, states, rows = np.ascontiguousarray(values[numbers].T), np.zeros((4, numbers.size)), found[numbers]
        _run(own, 0.9 * frequencies[0], *sources[0], states, TRANSIENT, rows[:, 0])
        for number, (frequency, (mean, amplitude)) in enumerate(zip(frequencies, sources, strict=True)):
            average = _run(own, frequency, mean, amplitude, states, TRANSIENT, rows[:, number])
            rows[:, number] -= average[:, None, None]
        found[numbers] = rows

    parts = min(common.available_cores(), max(1, len(draws) // TOGETHER))
    common.in_threads(part, np.array_split(np.arange(len(draws)), parts))
    return found


@njit(cache=True, inline="always")
def _rates(values, draw, source, i, v, q, m):
    """Return the rates of the four states, and the resistor's voltage."""
    root = np.sqrt(q * q + values[7, draw] * values[7, draw])
    blocked = 0.5 * (root - q) / values[6, draw]
    current = (source - v - values[5, draw] + blocked) / (values[0, draw] + values[1, draw])
    flow = (0.5 * (root + q) - m) / values[8, draw]
    charging = current - flow
    return (
        (v - values[3, draw] * i) / values[2, draw], (current - i) / values[4, draw], charging,
        flow - m / values[9, draw] - values[10, draw] * i * m,
        (current - values[11, draw] * charging) * values[0, draw],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _step(values, h, source, i, v, q, m, output):
    """Take a step of the classical Runge-Kutta method in all draws; the loop over them becomes vector instructions."""
    half = 0.5 * h
    for n in range(i.size):
        i0, v0, q0, m0 = i[n], v[n], q[n], m[n]
        a1, b1, c1, d1, output[n] = _rates(values, n, source[0], i0, v0, q0, m0)
        a2, b2, c2, d2, _ = _rates(values, n, source[1], i0 + half * a1, v0 + half * b1, q0 + half * c1, m0 + half * d1)
        a3, b3, c3, d3, _ = _rates(values, n, source[1], i0 + half * a2, v0 + half * b2, q0 + half * c2, m0 + half * d2)
        a4, b4, c4, d4, _ = _rates(values, n, source[2], i0 + h * a3, v0 + h * b3, q0 + h * c3, m0 + h * d3)
        i[n] = i0 + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        v[n] = v0 + h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
        q[n] = q0 + h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
        m[n] = m0 + h / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4)


@njit(cache=True, nogil=True, error_model="numpy")
def _run(values, frequency, mean, amplitude, states, transient, found):
    """Fill outputs (draws, periods, phases) after a transient, move states (4, draws), and return means (draws,)."""
    steps = PHASES * int(np.ceil(1.0 / (frequency * STEP * PHASES)))
    h = 1.0 / (frequency * steps)
    source = mean + amplitude * np.cos(np.pi * np.arange(2 * steps + 1) / steps)
    output, total = np.zeros(states.shape[1]), np.zeros(states.shape[1])
    for period in range(transient + found.shape[1]):
        for j in range(steps):
            here = source[2 * j], source[2 * j + 1], source[2 * j + 2]
            _step(values, h, here, states[0], states[1], states[2], states[3], output)
            if period >= transient:
                total += output
                if j * PHASES % steps == 0:
                    found[:, period - transient, j * PHASES // steps] = output
    return total / (steps * found.shape[1])


def period_of(values: np.ndarray) -> int | None:
    """Return the period of values (periods, phases), None for chaos or a period above the longest that is tested.

    It is the shortest whose mean leaves at most 1 % of the variance.
    """
    for period in range(1, LONGEST + 1):
        whole = values[: len(values) // period * period].reshape(-1, period, values.shape[1])
        if np.mean((whole - whole.mean(axis=0)) ** 2) <= LEFT * np.var(values):
            return period
    return None


def measured_period(record: rig.Record) -> int | None:
    """Return the period of a record by the same rule, None if the test found none."""
    if record.experiment is None:
        return None
    every = record.experiment.outputs["resistor"].reshape(record.experiment.periods, -1)
    return period_of(np.tile(every, (LONGEST, 1)))


def probabilities(motions: Sequence[str]) -> dict[str, float]:
    """Return the fraction of draws by motion."""
    return {str(key): float(value) for key, value in pd.Series(motions).value_counts(normalize=True).items()}


def doubling(draw: Draw, experiment: bp.Experiment, until: float, step: float = 2000.0) -> float | None:
    """Return the frequency [Hz] at which the orbit of an experiment doubles its period, by linear interpolation.

    The orbit is followed in frequency; None if it does not double before `until`, or cannot be solved.
    """
    values = {**draw, "C_s": 0.0, "offset": 0.0}
    frequency, guess = experiment.frequency, experiment.guess
    before: tuple[float, float] | None = None
    way = float(np.sign(until - frequency)) * step
    while (until - frequency) * way >= 0.0:
        solution = bp.solve_periodic(
            rig.MODEL, values, experiment.inputs, frequency=frequency, periods=experiment.periods,
            samples=experiment.samples, guess=guess,
        )  # fmt: skip
        if solution.status != "converged":
            return None
        least = float(np.min(solution.multipliers.real))
        if before is not None and (least + 1.0) * (before[1] + 1.0) <= 0.0:
            return float(before[0] + (before[1] + 1.0) / (before[1] - least) * (frequency - before[0]))
        before, guess = (frequency, least), solution.states
        frequency += way
    return None


def multiplier_sd(record: rig.Record, solution: bp.PeriodicSolution, sample: Sequence[Draw]) -> float | None:
    """Return the standard deviation over draws of the real part of the largest multiplier of a record's orbit."""
    experiment, found = record.experiment, []
    assert experiment
    for draw in sample:
        own = bp.solve_periodic(
            rig.MODEL, {**draw, "C_s": 0.0, "offset": 0.0}, experiment.inputs, frequency=experiment.frequency,
            periods=experiment.periods, samples=experiment.samples, guess=solution.states,
        )  # fmt: skip
        if own.status == "converged":
            found.append(float(own.multipliers[0].real))
    return float(np.std(found, ddof=1)) if len(found) > 1 else None
