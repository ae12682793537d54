"""What posterior draws predict where nothing was fitted: motions by time integration, and period doublings."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numba import njit

import bayesperiodic as bp
from studies.diode import rig

# Longest step of the integration [s]: the diode blocks within R·C_j.
STEP = 4e-9
TRANSIENT, KEPT, LONGEST = 120, 64, 8
# Instants a period at which motions are compared, and the share of the variance that a period may leave: smaller
# alternations are not counted, for they begin at zero.
PHASES, LEFT = 16, 1e-2
ORDER = ("R", "R_s", "L", "R_L", "C_L", "V_f", "C_j", "Q_0", "transit", "lifetime", "drift")
Draw = Mapping[str, float]


def draws_of(final: rig.Fitted, count: int, seed: int) -> list[dict[str, float]]:
    """Return draws of the parameters: log-normal with the robust standard deviations and Laplace's correlations."""
    fit, known = final.fit, rig.values_of(final)
    names = [name for name in ORDER if name in fit.theta]
    covariance = fit.covariance.loc[names, names].to_numpy()
    sd = np.sqrt(np.diag(covariance))
    estimate = np.array([fit.theta[name] for name in names])
    relative = np.array([fit.robust_sd[name] for name in names]) / estimate
    correlation = covariance / np.outer(sd, sd)
    generator = np.random.default_rng(seed)
    normal = generator.multivariate_normal(np.zeros(len(names)), correlation, size=count, method="eigh")
    values = estimate * np.exp(normal * relative)
    return [dict(zip(names, row.tolist(), strict=True)) | {n: known[n] for n in ("R", "R_s")} for row in values]


def source_of(record: rig.Record) -> tuple[float, float]:
    """Return the mean and the amplitude of the source [V] at the frequency of a record."""
    values, time = next(iter(record.recording.inputs.values())), record.recording.time
    turn = 2 * np.pi * record.frequency * time
    columns = np.stack([np.ones(time.size), np.cos(turn), np.sin(turn)], axis=1)
    mean, cosine, sine = np.linalg.lstsq(columns, values, rcond=None)[0]
    return float(mean), float(np.hypot(cosine, sine))


def sweep(
    draw: Draw, frequencies: Sequence[float], sources: Sequence[tuple[float, float]], kept: int = KEPT
) -> np.ndarray:
    """Return the resistor's voltage [V] in successive periods of the source (frequencies, kept, phases).

    The first phase is that of the largest source. The mean over these periods is subtracted, as by the instrument. Each
    motion starts from the end of the one at the frequency before, as in a sweep in the laboratory; the first from that
    at 90 % of its frequency.
    """
    values = tuple(float(draw[name]) for name in ORDER)
    found = np.empty((len(frequencies), kept, PHASES))
    state, _ = _run(values, 0.9 * frequencies[0], *sources[0], (0.0, 0.0, 0.0, 0.0), TRANSIENT, found[0])
    for row, frequency, (mean, amplitude) in zip(found, frequencies, sources, strict=True):
        state, average = _run(values, frequency, mean, amplitude, state, TRANSIENT, row)
        row -= average
    return found


@njit(cache=True, inline="always")
def _rates(values, source, i, v, q, m):
    """Return the rates of the four states, and the resistor's voltage; numbers, for arrays would be allocated."""
    resistor, internal, coil, losses, winding, forward, junction, corner, transit, lifetime, drift = values
    root = np.sqrt(q * q + corner * corner)
    current = (source - v - forward + 0.5 * (root - q) / junction) / (resistor + internal)
    flow = (0.5 * (root + q) - m) / transit
    return (
        (v - losses * i) / coil, (current - i) / winding, current - flow, flow - m / lifetime - drift * i * m,
        current * resistor,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _run(values, frequency, mean, amplitude, state, transient, found):
    """Fill values (periods, phases) after a transient by the classical Runge-Kutta method; return state, mean."""
    steps = PHASES * int(np.ceil(1.0 / (frequency * STEP * PHASES)))
    h = 1.0 / (frequency * steps)
    source = mean + amplitude * np.cos(np.pi * np.arange(2 * steps + 1) / steps)
    i, v, q, m = state
    total = 0.0
    for period in range(transient + len(found)):
        for j in range(steps):
            a1, b1, c1, d1, output = _rates(values, source[2 * j], i, v, q, m)
            if period >= transient:
                total += output
                if j * PHASES % steps == 0:
                    found[period - transient, j * PHASES // steps] = output
            half, s = 0.5 * h, source[2 * j + 1]
            a2, b2, c2, d2, _ = _rates(values, s, i + half * a1, v + half * b1, q + half * c1, m + half * d1)
            a3, b3, c3, d3, _ = _rates(values, s, i + half * a2, v + half * b2, q + half * c2, m + half * d2)
            a4, b4, c4, d4, _ = _rates(values, source[2 * j + 2], i + h * a3, v + h * b3, q + h * c3, m + h * d3)
            i += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            v += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
            q += h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
            m += h / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4)
    return (i, v, q, m), total / (steps * len(found))


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


def probabilities(motions: Sequence[int | None]) -> dict[str, float]:
    """Return the fraction of draws by period as text, and of "chaos"."""
    labels = pd.Series(["chaos" if own is None else str(own) for own in motions])
    return {str(key): float(value) for key, value in labels.value_counts(normalize=True).items()}


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
