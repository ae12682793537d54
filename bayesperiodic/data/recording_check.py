"""Check of a recording: faults of its sensors and its clock, and its steady part, before it is folded."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import toeplitz
from scipy.special import ndtr

from bayesperiodic import _fourier
from bayesperiodic._io import Result, Storable
from bayesperiodic._printing import printable
from bayesperiodic._verdicts import BAD, CAUTION, GOOD, with_tone
from bayesperiodic.data import faults
from bayesperiodic.data.aliases import SEARCHED, aliases, samples_per_cycle
from bayesperiodic.data.coverage import per_cycle
from bayesperiodic.data.faults import ChannelFaults
from bayesperiodic.data.harmonics import fit_harmonics
from bayesperiodic.data.quantisation import FEWEST_LEVELS, repeated_variance, rounded_step
from bayesperiodic.data.signals import GAP, LISTED_ALIASES, USUAL_STEPS

if TYPE_CHECKING:
    import pandas as pd

#: Severities of findings: without effect, a bias that counts, and a result that is wrong.
HARMLESS, SERIOUS, RUINOUS = with_tone("harmless", GOOD), with_tone("serious", CAUTION), with_tone("ruinous", BAD)
WRAPS, FEW_LEVELS = "wraps", "coarse"
# Levels (fewer than six bits) up to which rounding errors prevail in few harmonics, so that intervals by the residual
# of those kept can be too narrow; those of more levels are spread over the harmonics as noise is.
MOST_COARSE_LEVELS = 63
SEVERITIES = (HARMLESS, SERIOUS, RUINOUS)
# Bias in standard errors of all amplitudes together that is serious, and relative to the signal that is ruinous.
SERIOUS_BIAS, RUINOUS_BIAS = 0.5, 0.05
# Harmonics of a fit without the faulty samples, as many of them as these show: with this largest condition number.
FITTED_HARMONICS, LARGEST_FIT_CONDITION = (10, 5, 3, 2, 1), 1e3
# Share of the samples at each end that may be outliers where a signal is bounded by its range without them.
EXTREMES = 0.1
# Times of each finding that are listed.
MOST_TIMES_LISTED = 200
# Samples in a cycle of the strongest harmonic below which an estimated frequency is named with its aliases.
FEW_PER_CYCLE = 10.0


@dataclass(frozen=True)
class Finding(Storable):
    """A fault of a recording.

    Attributes
    ----------
    kind : str
        "constant", "wraps", "stuck", "held" (a slower logger), "clipped", "saturated" (flat tops of the mean period),
        "outliers", "heavy tails", "coarse" (2 to 63 levels with little noise), "gaps", "aliases", "ramp", "transient",
        "drift", "beating", "amplitude step", "mean step", "phase step" or "clock" (the phase of a channel drifts
        steadily against the first one).
    channel : str
        Empty for all channels together.
    severity : str
        "harmless", "serious" (the amplitudes are biased by more than half a standard error, all together) or "ruinous"
        (by more than 5 % of the signal, or unknown).
    times : array (parts, 2)
        Start and end of each part [s], at most 200.
    count : int
        Samples, or cycles for faults of cycles.
    share : float
        Fraction of the samples or cycles.
    bias : float
        Effect on all amplitudes of the channel together [standard errors]; NaN if unknown.
    text, cure : str
        What happened, and what to do.

    Examples
    --------
    >>> t = np.arange(0, 60, 0.01)
    >>> force = np.cos(2 * np.pi * t)
    >>> force[1000:1200] = force[1000]
    >>> (finding,) = bp.Recording.from_arrays(t, {"force": force}).check().findings
    >>> finding.kind, finding.severity, finding.count, finding.times.round(2).tolist()
    ('stuck', 'ruinous', 201, [[10.0, 12.0]])
    >>> finding.cure
    "recording.without(stuck=True, channel='force') leaves them out"
    """

    kind: str
    channel: str
    severity: str
    times: np.ndarray
    count: int
    share: float
    bias: float
    text: str
    cure: str = ""

    def __str__(self) -> str:
        return printable(f"{self.text}{'; ' + self.cure if self.cure else ''}")


def signal_faults(values: np.ndarray, *, drive: bool = False) -> ChannelFaults:
    """Return the faults of one channel that its samples alone show; a drive may be a sawtooth."""
    step = faults.resolution(values)
    wrap, jumps = faults.wrap_of(values, step)
    if drive and wrap and abs(np.sign(np.diff(values)[jumps - 1]).sum()) == jumps.size:
        wrap, jumps = 0.0, jumps[:0]
    stuck = faults.stuck_of(values)
    low, high = (np.zeros(0, dtype=int),) * 2 if wrap else faults.clipped_of(values, stuck)
    repeats, held = faults.held_of(values)
    brief = faults.brief_of(values, step) if repeats == 1 else held[:0]
    return ChannelFaults(step, wrap, jumps, stuck, low, high, brief=brief, held=held, repeats=repeats)


def bounded(values: np.ndarray) -> np.ndarray:
    """Return values (channels, samples) without rare extremes, for a first estimate of the frequency."""
    some = values[:, :: 1 + values.shape[1] // faults.SCREENED]
    low, high = np.quantile(some, [EXTREMES, 1.0 - EXTREMES], axis=1, keepdims=True)
    least, most = (
        np.where(high > low, end, wide) for end, wide in ((2 * low - high, -np.inf), (2 * high - low, np.inf))
    )
    if (values.min(axis=1, keepdims=True) >= least).all() and (values.max(axis=1, keepdims=True) <= most).all():
        return values
    return np.clip(values, least, most)


@dataclass(frozen=True)
class Effect:
    """What faulty samples of a channel do to its amplitudes."""

    bias: float  # of all amplitudes together [standard errors]
    relative: float  # size of the contamination relative to the signal
    predicted: np.ndarray  # at all samples
    noise: float  # standard deviation of the others about the prediction
    order: int  # highest harmonic of the prediction

    @property
    def severity(self) -> str:
        """Severity by the effect."""
        if not self.bias <= np.inf or self.relative > RUINOUS_BIAS:
            return RUINOUS
        return SERIOUS if self.bias > SERIOUS_BIAS else HARMLESS


UNKNOWN = Effect(np.nan, np.nan, np.zeros(0), np.nan, 0)


def effect_of(time: np.ndarray, values: np.ndarray, bad: np.ndarray, frequency: float, harmonics: int) -> Effect:
    """Return the effect of faulty samples (bool), by the mean period of the others; unknown if they do not show it."""
    used, good, best, order, amplitudes, variance = time[~bad], values[None, ~bad], np.inf, 0, None, np.nan
    for highest in FITTED_HARMONICS:
        if highest <= harmonics and used.size > 6 * highest and np.ptp(used) * frequency > 2.0:
            moments = _fourier.moments(frequency * used, 2 * highest)
            spectrum = np.linalg.eigvalsh(toeplitz(moments))
            if spectrum[0] * LARGEST_FIT_CONDITION > spectrum[-1]:
                trial = fit_harmonics(used, good, frequency, highest)
                # The Bayesian information criterion: needless harmonics predict nothing where samples are missing.
                least = max(float(trial.variances[0]), 1e-24 * float(values.var()))
                score = used.size * np.log(least) + 2 * highest * np.log(used.size)
                if score < best:
                    best, order, amplitudes, variance = score, highest, trial.amplitudes, float(trial.variances[0])
                del trial  # with residuals
    if amplitudes is None:
        return UNKNOWN
    predicted = _fourier.at_times(amplitudes, frequency * time)[0]
    noise = float(np.sqrt(variance))
    if not np.isfinite(predicted).all() or noise > 0.9 * float(good.std()):
        return UNKNOWN
    noise = max(noise, 1e-9 * float(max(good.max(), -good.min())))
    del used, good
    wrong = values - predicted
    wrong[~bad] = 0.0
    return _effect(wrong, time, frequency, order, predicted, noise)


def _effect(
    wrong: np.ndarray, time: np.ndarray, frequency: float, order: int, predicted: np.ndarray, noise: float
) -> Effect:
    """Return the effect of errors of the samples on the amplitudes up to an order."""
    sums = np.abs(_fourier.sums(wrong[None], frequency * time, order)[0]) / time.size
    size = float(np.sqrt(np.r_[1.0, np.full(order, 2.0)] @ sums**2))
    spread = max(float(predicted.std()), np.finfo(float).tiny)
    return Effect(size / (noise / np.sqrt(time.size)), size / spread, predicted, noise, order)


def clipped_effect(effect: Effect, time: np.ndarray, frequency: float, limits: Sequence[tuple[float, float]]) -> Effect:
    """Return the effect of limits (sign, level) on a signal with normal noise, by the mean of what exceeds them."""
    lost = np.zeros(time.size)
    for sign, level in limits:
        above = sign * (effect.predicted - level) / effect.noise
        lost -= sign * effect.noise * (above * ndtr(above) + np.exp(-0.5 * above**2) / np.sqrt(2.0 * np.pi))
    return _effect(lost, time, frequency, effect.order, effect.predicted, effect.noise)


def times_of(time: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the first and last times (parts, 2) of runs of samples."""
    if not samples.size:
        return np.zeros((0, 2))
    edges = np.flatnonzero(np.diff(samples) > 1)
    first, last = samples[np.r_[0, edges + 1]], samples[np.r_[edges, samples.size - 1]]
    return np.column_stack([time[first], time[last]])[:MOST_TIMES_LISTED]


def _when(times: np.ndarray) -> str:
    """Return times in words."""
    shown = [f"{a:.6g} s" if a == b else f"{a:.6g} to {b:.6g} s" for a, b in times[:3]]
    return ("at " if times[0, 0] == times[0, 1] else "from ") + ", ".join(shown) + (", …" if len(times) > 3 else "")


def _finding(
    channel: str,
    kind: str,
    time: np.ndarray,
    samples: np.ndarray,
    what: str,
    effect: Effect,
    frequency: float | None,
    inside: bool,
) -> Finding:
    """Return the finding of samples that have an effect if they are inside the part used."""
    severity = (effect.severity if frequency else SERIOUS) if inside else HARMLESS
    times, share = times_of(time, samples), samples.size / time.size
    size = "" if np.isnan(effect.bias) else f", a bias of {effect.bias:.3g} standard errors"
    size = size if inside else ", not used"
    cure = f"recording.without({kind}=True, channel={channel!r}) leaves them out"
    if kind == "clipped" and frequency and times.size and np.diff(times).max() * frequency > GAP:
        cure = "record again with a larger range"
    text = f"{channel} {what} {_when(times)} ({samples.size} samples, {share:.2g} of all{size})"
    return Finding(kind, channel, severity, times, samples.size, share, effect.bias, text, cure)


def sample_findings(
    channel: str,
    time: np.ndarray,
    values: np.ndarray,
    fault: ChannelFaults,
    frequency: float | None,
    harmonics: int,
    used: slice,
) -> Iterator[Finding]:
    """Return the findings of one channel; stuck and clipped samples count if the mean period of the others differs.

    Those outside of the part used are harmless.
    """
    total = values.size
    if fault.wrap:
        yield Finding(
            WRAPS, channel, RUINOUS, times_of(time, fault.wraps), fault.wraps.size, fault.wraps.size / total, np.nan,
            f"{channel} jumps by {fault.wrap:.6g} {fault.wraps.size} times, first "
            f"{_when(times_of(time, fault.wraps))}: the sensor wraps at its range",
            f"recording.unwrapped({channel!r}, {fault.wrap:.6g}) removes the jumps",
        )  # fmt: skip
        return
    if fault.repeats > 1:
        yield _held(channel, time, fault)
    bad = np.zeros(total, dtype=bool)
    for part in fault.stuck:
        bad[part] = True
    bad[np.concatenate([fault.brief, fault.low, fault.high, fault.outliers])] = True
    if fault.tails.size:
        yield _tails(channel, time, fault.tails)
    if fault.saturation is not None and not fault.low.size and not fault.high.size:
        yield _saturated(channel, time, fault.saturated, fault)
    if bad.any():
        yield from _bad_findings(channel, time, values, fault, bad, frequency, harmonics, used)
    if frequency:
        yield from _coarse(channel, time[used], values[used], bad[used], frequency, harmonics)


def _coarse(
    channel: str, time: np.ndarray, values: np.ndarray, bad: np.ndarray, frequency: float, harmonics: int
) -> Iterator[Finding]:
    """Return the finding of few levels with little noise, whose rounding errors are no noise, see `quantisation`.

    Noise beyond the outer levels is cut off, so that no noise helps two of them.
    """
    if bad.all():
        return
    sound = ~bad if bad.any() else slice(None)
    phase, good = frequency * time, values[sound]
    step = rounded_step(good, phase[sound])
    levels = round(float(np.ptp(good)) / step) + 1 if step else 0
    if not 2 <= levels <= MOST_COARSE_LEVELS:
        return
    effect, error, bias = effect_of(time, values, bad, frequency, harmonics), np.nan, np.nan
    if effect.predicted.size:
        cycles = max(int(np.ptp(phase)), 1)
        one = effect.predicted[: values.size // cycles]
        error = float(np.sqrt(repeated_variance(step, one, values.size, residual=effect.noise**2)))
        bias = error / max(effect.noise / np.sqrt(values.size), 1e-9 * step)
    if levels > 2 and not bias > SERIOUS_BIAS:
        return
    size = f", and change the mean period by about {error / good.std():.1%} of its rms, {bias:.3g} standard errors"
    several = f"has only {levels} levels, steps of {step:.3g}, and little noise between them"
    two = f"has only two levels, {step:.3g} apart, and changes between them at other phases in every cycle"
    yield Finding(
        FEW_LEVELS, channel, SERIOUS, np.array([[time[0], time[-1]]]), values.size, 1.0, bias,
        f"{channel} {several if levels > 2 else two}: its rounding errors repeat in every cycle, do not average out"
        f"{size if bias > SERIOUS_BIAS else ''}",
        "take noise='measured' and input_noise='measured', whose variances contain them, or record with a smaller "
        "range" + ("; levels that are exact, as those of a switch, need nothing" if levels < FEWEST_LEVELS else ""),
    )  # fmt: skip


def _bad_findings(
    channel: str,
    time: np.ndarray,
    values: np.ndarray,
    fault: ChannelFaults,
    bad: np.ndarray,
    frequency: float | None,
    harmonics: int,
    used: slice,
) -> Iterator[Finding]:
    """Return the findings of stuck and clipped samples and outliers, which are the bad ones (bool)."""
    total = values.size
    every = effect_of(time[used], values[used], bad[used], frequency, harmonics) if frequency else UNKNOWN
    if every.predicted.size:  # at the other samples too
        predicted = values.astype(float)
        predicted[used] = every.predicted
        every = replace(every, predicted=predicted)

    def finding(kind: str, samples: np.ndarray, what: str, limits: Sequence[tuple[float, float]] = ()) -> Finding:
        only = np.isin(np.arange(total), samples)
        effect = every
        if limits and every.predicted.size:
            at = replace(every, predicted=every.predicted[used])
            effect = clipped_effect(at, time[used], frequency or 1.0, limits)
        elif every.predicted.size:
            kept = np.where(bad & ~only, every.predicted, values)
            effect = effect_of(time[used], kept[used], only[used], frequency or 1.0, harmonics)
        return _finding(channel, kind, time, samples, what, effect, frequency, bool(only[used].any()))

    still = np.zeros(total, dtype=bool)
    still[fault.brief] = True
    for part in fault.stuck:
        still[part] = _moves(every, part, fault.step, used)
    samples = np.flatnonzero(still)
    if samples.size:
        first = samples[np.diff(samples, prepend=-2) > 1]
        level = ", ".join(f"{values[i]:.6g}" for i in first[:3]) + (", …" if first.size > 3 else "")
        yield finding("stuck", samples, f"is stuck at {level}")
    clipped = [
        (end, sign)
        for end, sign in ((fault.low, -1.0), (fault.high, 1.0))
        if end.size and (fault.noisy and not faults.in_rows(end) or _beyond(every, values, end, sign))
    ]
    if clipped:
        samples = np.sort(np.concatenate([end for end, _ in clipped]))
        level = " and ".join(f"{values[end[0]]:.6g}" for end, _ in clipped)
        if fault.noisy:
            limits = [(sign, float(values[end[0]])) for end, sign in clipped]
            yield finding("clipped", samples, f"is clipped at {level}", limits)
        else:
            yield _saturated(channel, time, samples, fault, level)
    if fault.outliers.size:
        low, high = values[fault.outliers].min(), values[fault.outliers].max()
        which = f"reads {low:.6g}" if low == high else f"has outliers between {low:.6g} and {high:.6g}"
        yield finding("outliers", fault.outliers, which)


def _held(channel: str, time: np.ndarray, fault: ChannelFaults) -> Finding:
    """Return the finding of a slower logger."""
    delay = 0.5 * (fault.repeats - 1)
    return Finding(
        "held", channel, SERIOUS, np.array([[time[0], time[-1]]]), fault.held.size, fault.held.size / time.size, np.nan,
        f"{channel} repeats each value {fault.repeats} times: a slower logger or a hold, which delays it by "
        f"{delay:g} samples ({delay * float(np.median(np.diff(time))):.3g} s) and weakens its harmonics",
        f"recording.without(stuck=True, channel={channel!r}) keeps one sample of each value",
    )  # fmt: skip


def _tails(channel: str, time: np.ndarray, samples: np.ndarray) -> Finding:
    """Return the finding of heavy tails."""
    share = samples.size / time.size
    return Finding(
        "heavy tails", channel, HARMLESS, times_of(time, samples), samples.size, share, 0.0,
        f"{channel} has noise of heavy tails: {samples.size} samples ({share:.2g} of all) are more than "
        f"{faults.FAR:g} standard deviations of the others from the mean period. It biases nothing, and is in the "
        "standard errors",
    )  # fmt: skip


def _saturated(channel: str, time: np.ndarray, samples: np.ndarray, fault: ChannelFaults, level: str = "") -> Finding:
    """Return the finding of flat tops of a mean period, which are those of a sensor or of the motion itself."""
    saturation, bias = fault.saturation, np.nan
    if saturation is not None:
        level = level or " and ".join(f"{v:.6g}" for v in (saturation.low, saturation.high) if np.isfinite(v))
        bias = fault.saturation_bias
    sensor = saturation is not None and saturation.like_a_sensor and bias > SERIOUS_BIAS
    share, times = samples.size / time.size, times_of(time, samples)
    size = "" if np.isnan(bias) else f", with a bias of {bias:.3g} standard errors"
    return Finding(
        "saturated", channel, SERIOUS if sensor else HARMLESS, times, samples.size, share, bias,
        f"{channel} stays at {level} {_when(times)} ({samples.size} samples, {share:.2g} of all), where a smooth "
        f"continuation of the others goes beyond. Either a sensor or a stop limits it{size}, or it is limited itself, "
        "as a force of friction or contact",
        f"if it is the sensor: record again with a larger range, or recording.without(clipped=True, "
        f"channel={channel!r})",
    )  # fmt: skip


def _moves(effect: Effect, part: slice, step: float, used: slice) -> bool:
    """Return whether the mean period changes where the values do not; unknown outside of the part used."""
    if not effect.predicted.size or part.start < used.start or part.stop > used.stop:
        return True
    return bool(np.ptp(effect.predicted[part]) > max(4.0 * effect.noise, 3.0 * step))


def _beyond(effect: Effect, values: np.ndarray, samples: np.ndarray, sign: float) -> bool:
    """Return whether the mean period goes beyond the level of clipped samples."""
    if not effect.predicted.size:
        return True
    excess = sign * (effect.predicted[samples] - values[samples])
    return bool(np.median(excess) > max(effect.noise, 1e-6 * float(np.ptp(values))))


def clock_findings(time: np.ndarray) -> Iterator[Finding]:
    """Return the gaps of the time axis."""
    step = np.diff(time)
    usual = float(np.median(step))
    ends = np.flatnonzero(step > USUAL_STEPS * usual)
    if ends.size:
        lost = int(np.round(step[ends] / usual - 1.0).sum())
        yield Finding(
            "gaps", "", HARMLESS, np.column_stack([time[ends], time[ends + 1]])[:MOST_TIMES_LISTED], lost,
            lost / (lost + time.size), np.nan,
            f"{lost} samples are missing in {ends.size} gaps, the longest of {step.max():.3g} s",
        )  # fmt: skip


def sampling_findings(
    time: np.ndarray, values: np.ndarray, frequency: float, whole: np.ndarray, counted: slice
) -> list[Finding]:
    """Return aliases of an estimated frequency, and the parts over whose gaps its cycles cannot be counted."""
    findings, some = [], slice(-SEARCHED, None)
    if per_cycle(time, frequency) < FEW_PER_CYCLE:
        others = aliases(time[some], values[:, some], frequency)
        if (many := samples_per_cycle(time[some], values[:, some], frequency, others)) < FEW_PER_CYCLE:
            listed = ", ".join(f"{other:.6g}" for other in others[:LISTED_ALIASES])
            findings.append(
                Finding(
                    "aliases", "", SERIOUS, np.array([[time[0], time[-1]]]), time.size, 1.0, np.nan,
                    f"{frequency:.6g} Hz has {many:.3g} samples per cycle, and {listed} Hz (aliases) explain them as "
                    "well", "give `frequency=`, or sample faster or at irregular times",
                )
            )  # fmt: skip
    lost = np.array([[whole[0], time[0]], [time[-1], whole[-1]]])
    lost = lost[[counted.start > 0, counted.stop < whole.size]]
    if len(lost):
        findings.append(
            Finding(
                "gaps", "", HARMLESS, lost, 1, float(np.ptp(lost, axis=1).sum() / np.ptp(whole)), np.nan,
                f"the cycles in gaps cannot be counted with the error of the frequency; only {time[0]:.6g} to "
                f"{time[-1]:.6g} s are used", "give `frequency=`",
            )
        )  # fmt: skip
    return findings


def refuse(name: str, findings: Iterable[Finding]) -> None:
    """Raise a ValueError for ruinous findings, and warn once of serious ones."""
    listed = [*findings]
    ruinous = [finding for finding in listed if finding.severity == RUINOUS]
    if ruinous:
        raise ValueError(f"recording: must be sound, got {name!r}, in which {'. '.join(map(str, ruinous))}.")
    serious = [finding for finding in listed if finding.severity == SERIOUS]
    if serious:
        warnings.warn(f"{name}: {'. '.join(map(str, serious))}.", UserWarning, stacklevel=4)


@dataclass(frozen=True)
class RecordingCheck(Result):
    """What `Recording.check` found.

    Attributes
    ----------
    name : str
        Of the recording.
    table : DataFrame
        A row for each channel: ``lowest`` and ``highest`` value, ``resolution`` (step of quantised values, 0 if they
        are not), ``bits`` that the range uses, numbers of ``clipped``, ``stuck`` and ``outliers`` samples and of
        ``wraps``.
    findings : tuple of Finding
        The worst ones first.
    frequency : float
        Fundamental frequency [Hz], NaN if there is none.
    cycles, total : int
        Cycles of the part that `fold` uses, and of the recording.
    start, stop : float
        Times of the part that `fold` uses [s].
    jitter : float
        Standard deviation of the steps of time, without gaps, relative to their median.
    bad : dict of str to dict of str to array (faulty samples,)
        Numbers of the samples by channel and kind ("outliers", "stuck", "clipped"), for `Recording.without`.
    reason : str
        Why there is no frequency or no steady part; empty otherwise.

    Examples
    --------
    >>> t = np.arange(0, 60, 0.01)
    >>> rising = np.minimum(t / 10, 1) * np.cos(2 * np.pi * t)
    >>> check = bp.Recording.from_arrays(t, {"x": rising}, name="run 1").check()
    >>> check.sentence
    '50 of 60 cycles at 1 Hz are used, 10 to 59.99 s.'
    >>> print(*check.findings)
    the signals change until 10 s; 10 to 59.99 s are used (50 of 60 cycles)
    """

    name: str
    table: "pd.DataFrame"
    findings: tuple[Finding, ...]
    frequency: float
    cycles: int
    total: int
    start: float
    stop: float
    jitter: float
    bad: dict[str, dict[str, np.ndarray]]
    reason: str = ""

    @property
    def severity(self) -> str:
        """The worst severity of the findings; "harmless" without any."""
        return max((finding.severity for finding in self.findings), key=SEVERITIES.index, default=HARMLESS)

    def __repr__(self) -> str:
        lines = [f"Recording {self.name!r}: {self.sentence}", self.table.to_string(float_format="{:.5g}".format)]
        lines += [f"{finding.severity}: {finding}." for finding in self.findings]
        return "\n".join(lines + ([] if self.findings else ["Nothing was found."]))

    @property
    def sentence(self) -> str:
        """The part that `Recording.fold` uses, or the reason why there is none."""
        if self.reason:
            return f"no mean period: {self.reason}"
        jitter = f", steps of time vary by {self.jitter:.1%}" if self.jitter > 1e-3 else ""
        return (
            f"{self.cycles} of {self.total} cycles at {self.frequency:.6g} Hz are used, {self.start:.6g} to "
            f"{self.stop:.6g} s{jitter}."
        )
