"""Comparison of the orbit that a model was solved for with the measured one.

At the same parameters a model may have several orbits, such as one of period 1 beside the measured one of period 2, and
a fit follows the one at which it started. An orbit that starts in another forcing period than the measured one is the
same orbit, but its residual is large.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import fdtrc

from bayesperiodic import _fourier
from bayesperiodic.likelihood.observation import Observation, Response

ORBIT_LEVEL = 1e-3
# Variance of the subharmonics: its least fraction of the measured variance, and of the measured one for the same orbit.
PRESENT, FOLLOWED = 1e-3, 0.25
LOG_ODDS = 7.0
SAME = 1e-6
# Fraction of a channel's variance above which the model may follow another orbit than the measured one.
MOST_UNEXPLAINED = 0.5


def other_orbit(observation: Observation, response: Response) -> str:
    """Return why the orbit of a response is not the measured one, in words; empty if no difference is seen.

    Compared are the turns of angles, the prime period, and, for orbits of several forcing periods, their order. The
    model's orbit is taken to have a shorter period where its subharmonics have less than a quarter of the variance of
    the measured ones, which are tested against the noise (false-alarm rate 0.1 % by channel and period): measured
    inputs and their noise give every orbit weak subharmonics. At the points of a mask the measured period is taken as
    given. Orders differ where another one makes the data e⁷ times as likely.
    """
    if observation.experiment.condition is not None:  # whose solver tells one special point from another
        return ""
    reason = next(_differences(observation, response), "") if observation.channels else ""
    if not reason:
        return ""
    share = max(unexplained(observation, response).values())
    return f"{reason}; {share:.1%} of the variance of the recording is unexplained"


def unexplained(observation: Observation, response: Response) -> dict[str, float]:
    """Return the mean square of each channel's residual over the variance of its measured values.

    Of a single value it is that over its square.
    """
    measured = observation.data[observation.experiment.measured_points]
    power = measured.var(axis=0) if len(measured) > 1 else measured[0] ** 2
    power = np.maximum(power, np.finfo(float).tiny).tolist()
    left = observation.compared(response).items()
    with np.errstate(over="ignore"):
        return {c: float(np.sum(e**2)) / len(measured) / size for (c, e), size in zip(left, power, strict=True)}


def _differences(observation: Observation, response: Response) -> Iterator[str]:
    e, outputs = observation.experiment, np.stack(list(observation.predicted(response).values()), axis=-1)
    angles = observation.angles[: len(observation.channels)]
    (model, model_turns), (data, turns) = (_unwound(x, angles) for x in (outputs, observation.data))
    if observation.whole:
        for channel, predicted, measured in zip(observation.channels, model_turns, turns, strict=True):
            if predicted != measured:
                yield f"the model's {channel} makes {predicted} turns in a period, the recorded one {measured}"
    for period in [d for d in range(1, e.periods) if e.periods % d == 0]:
        followed = _followed(observation, model, data, period)
        if followed < FOLLOWED:
            yield (
                f"the model's orbit has period {period}, the recording has period {e.periods} ({followed:.0%} of the "
                "variance of its subharmonics)"
            )
    odds = [_log_likelihood(observation, response, ahead) for ahead in range(e.periods)]
    if (ahead := int(np.argmax(odds))) and odds[ahead] - odds[0] > LOG_ODDS:
        yield f"the model's orbit is the measured one delayed by {ahead} of {e.periods} forcing periods"


def _unwound(signals: np.ndarray, angles: list[bool]) -> tuple[np.ndarray, np.ndarray]:
    """Return signals (points, channels) without jumps and turns of angles, and their turns (channels,)."""
    values = np.where(angles, np.unwrap(signals, axis=0), signals)
    ahead = np.unwrap(np.stack([values[-1], signals[0]]), axis=0)[1]
    turns = np.where(angles, np.rint((ahead - values[0]) / (2 * np.pi)), 0.0).astype(int)
    return values - 2 * np.pi * turns * np.arange(len(values))[:, None] / len(values), turns


def _followed(observation: Observation, model: np.ndarray, measured: np.ndarray, period: int) -> float:
    """Return the variance of the model's subharmonics of a shorter period over that of the measured ones, if any."""
    e, power = observation.experiment, np.zeros(2)
    if not observation.whole:
        off = np.abs(model - np.roll(model, period * e.samples, axis=0))
        return 0.0 if np.all(off <= SAME * np.ptp(model, axis=0)) else np.inf
    for c, channel in enumerate(observation.channels):
        highest = min(e.harmonics.get(channel, len(model)), _fourier.highest_harmonic(len(model)))
        lines = np.arange(1, highest + 1)
        lines = lines[lines % (e.periods // period) != 0]
        predicted, data = (np.abs(_fourier.coefficients(x[:, c], highest)[lines]) ** 2 for x in (model, measured))
        variance = 2.0 * measured[:, c].var()
        if data.sum() > PRESENT * variance and _significant(observation, channel, lines, data):
            power += np.array([predicted.sum(), data.sum()]) / variance
    return float(power[0] / power[1]) if power[1] else np.inf


def _significant(observation: Observation, channel: str, lines: np.ndarray, power: np.ndarray) -> bool:
    """Return whether squared amplitudes (lines,) exceed the measured noise, or else those of the higher lines."""
    e = observation.experiment
    noise, freedom = e.amplitude_variance.get(channel), 2.0 * lines.size * max(e.cycles - 1, 1)
    if noise is None and channel in e.scatter:
        noise = np.full(lines[-1] + 1, 2.0 * e.scatter[channel] ** 2 / e.cycles / (lines[-1] + 0.5))
    if noise is not None:
        power = power / np.maximum(noise[lines], np.finfo(float).tiny)
        return bool(fdtrc(2 * lines.size, freedom, power.mean()) < ORBIT_LEVEL)
    low, high = np.array_split(power, 2)
    if not high.size:
        return True
    ratio = low.mean() / max(high.mean(), np.finfo(float).tiny)
    return bool(fdtrc(2 * low.size, 2 * high.size, ratio) < ORBIT_LEVEL)


def _log_likelihood(observation: Observation, response: Response, ahead: int) -> float:
    """Return the log-likelihood of the data, maximised over the variances, some forcing periods ahead."""
    e, left = observation.experiment, observation.compared(response, ahead)
    counts = {c: e.independent[c] if observation.whole else np.count_nonzero(e.measured_points) for c in left}
    with np.errstate(over="ignore"):
        squares = {c: max(float(np.sum(x**2)), np.finfo(float).tiny) for c, x in left.items()}
    return float(sum(-0.5 * counts[c] * np.log(squares[c]) for c in left))
