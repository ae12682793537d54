"""Good simulated recordings, and recordings with one fault of a given size."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import bayesperiodic as bp
from studies import common

Rates = Callable[[float, np.ndarray], list[float]]

NOISES = ("white", "coloured", "slow", "quantised")
# Time [s] at which all transients are gone, and the longest recording [s].
SETTLED, LONGEST = 200.0, 400.0
# Frequency [Hz] of the drive (None without one), periods of the response, duration [s] of the response period.
SYSTEMS: dict[str, tuple[float | None, int, float]] = {
    "driven": (0.2, 1, 5.0),
    "subharmonic": (0.6 / np.pi, 2, 2 * np.pi / 0.6),
    "autonomous": (None, 1, 7.0),
    "friction": (0.5, 1, 2.0),
}
CYCLES, PER_CYCLE = (5, 300), (20, 200)
# Largest standard deviation of an amplitude that wanders over one to five cycles.
WANDER = 0.02

# Of recordings with faults.
SAMPLES, COUNT, NOISE = 50, 60, 0.01
SHAPE = {1: np.exp(0.4j), 3: 0.2 * np.exp(1j)}
# Natural frequency [cycles per cycle] and decay time [cycles] of the transients, and length [cycles] of the ramp.
NATURAL, DECAY, RAMP = 1.37, 4.0, 5.0
CHANGES = frozenset({"ramp", "transient", "drift", "amplitude step", "mean step", "phase step", "beating"})


def _rates(system: str) -> Rates:
    drive = 2 * np.pi * (SYSTEMS[system][0] or 0.0)
    if system == "driven":
        return lambda t, y: [y[1], np.cos(drive * t) - 0.2 * y[1] - y[0] - 0.5 * y[0] ** 3]
    if system == "subharmonic":
        return lambda t, y: [y[1], 0.28 * np.cos(drive * t) - 0.3 * y[1] + y[0] - y[0] ** 3]
    if system == "friction":
        return lambda t, y: [y[1], 2 * np.cos(drive * t) - 0.2 * y[1] - 5 * y[0] - 0.5 * np.tanh(y[1] / 0.05)]
    return lambda t, y: [y[1], 1.5 * (1 - y[0] ** 2) * y[1] - y[0]]


@functools.cache
def motion(system: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return the displacement of a system as a function of time [s]."""
    end = SETTLED + LONGEST + 1.0
    states: Any = solve_ivp(_rates(system), (0, end), [0.3, 0.1], rtol=1e-8, atol=1e-9, dense_output=True).sol
    return lambda t: states(t)[0]


def good(number: int, seed: int) -> tuple[bp.Recording, float | None, int]:
    """Return a good recording, the frequency to give or None, and the periods of the response."""
    rng = np.random.default_rng([seed, number])
    system, kind = [*SYSTEMS][number % len(SYSTEMS)], str(rng.choice(NOISES))
    frequency, periods, duration = SYSTEMS[system]
    cycles = min(int(np.exp(rng.uniform(*np.log(CYCLES)))), int(LONGEST / duration))
    per_cycle = int(rng.integers(*PER_CYCLE))
    time = np.arange(cycles * per_cycle + rng.integers(per_cycle)) * duration / per_cycle
    time = SETTLED + time[time < LONGEST]
    values = motion(system)(time)
    error = rng.standard_normal(time.size + 20 * per_cycle)
    if kind in ("coloured", "slow"):
        decay = 0.9 if kind == "coloured" else np.exp(-1.0 / (per_cycle * rng.uniform(1.0, 5.0)))
        error = lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], error)
    size = 10.0 ** rng.uniform(-4.0, -1.0)
    if kind == "slow":  # of the amplitude
        values = values * (
            1.0 + min(size, WANDER) * error[20 * per_cycle :]
        ) + size * values.std() * rng.standard_normal(time.size)
    else:
        values = values + size * values.std() * error[20 * per_cycle :]
    if kind == "quantised":
        step = np.ptp(values) / 2.0 ** rng.integers(6, 15)
        values = np.round(values / step) * step
    inputs = {"drive": np.cos(2 * np.pi * frequency * time)} if frequency else {}
    name = f"{system}, {kind}, {cycles} cycles of {per_cycle} samples, noise {size:.1e}"
    given = frequency if rng.random() < 0.5 else None
    return bp.Recording.from_arrays(time, {"x": values}, inputs, name=name), given, periods


def alarm(task: tuple[int, int]) -> dict[str, Any]:
    """Return what the fold of a good recording says."""
    number, seed = task
    recording, frequency, periods = good(number, seed)
    line = {"number": number, "seed": seed, "source": source(), "name": recording.name, "refused": "", "kinds": []}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            check = recording.check(frequency, periods=periods)
            run = recording.fold(64, frequency=frequency, periods=periods)
        except ValueError as error:
            return line | {"refused": str(error), "kept": 0.0, "warnings": []}
    kinds = [finding.kind for finding in run.findings if finding.severity != "harmless"]
    return line | {"kinds": kinds, "warnings": [str(w.message) for w in said], "kept": run.cycles / max(check.total, 1)}


def source() -> str:
    """Return the key of the package and this study."""
    return common.source_key(__file__)


def signal(time: np.ndarray, shift: "np.ndarray | float" = 0.0) -> np.ndarray:
    """Return the steady response at times [cycles]."""
    return np.real(sum(a * np.exp(2j * np.pi * h * (time + shift)) for h, a in SHAPE.items()))


def _outlier(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    x[rng.integers(1, x.size - 1)] += size
    return x


def _dropouts(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.permutation(x.size) < max(round(size * x.size), 1), 0.0, x)


def _stuck(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    first = rng.integers(1, x.size - 2 * SAMPLES)
    x[first : first + round(size)] = x[first]
    return x


def _clipped(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return np.minimum(x, np.quantile(x, 1.0 - size))


def _saturated(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Limit the signal, without its noise."""
    clean = signal(time)
    return x + np.minimum(clean, np.quantile(clean, 1.0 - size)) - clean


def _held(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Hold values for five samples."""
    for first in rng.choice(x.size // 8 - 1, round(size), replace=False) * 8:
        x[first : first + 5] = x[first]
    return x


def _wrapped(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return (2.0 * x + 2.0 * np.pi - np.quantile(2.0 * x, 1.0 - size)) % (2.0 * np.pi)


def _phase(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return x + signal(time, (time > COUNT / 2) * size / 360.0) - signal(time)


def _amplitude(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return x + (time > COUNT / 2) * size * signal(time)


def _transient(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return x + size * np.exp(-time / DECAY) * np.cos(2 * np.pi * NATURAL * time + 1.0)


def _ramp(x: np.ndarray, time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    return x - size * np.clip(1.0 - time / RAMP, 0.0, 1.0) * signal(time)


# Fault: function, sizes, channels, kinds of findings that name it; whether it is already in the noise-free values.
FAULTS: dict[str, tuple[Callable[..., np.ndarray], np.ndarray, int, frozenset[str]]] = {
    "outlier [amplitudes]": (_outlier, np.geomspace(0.01, 5.0, 24), 1, frozenset({"outliers"})),
    "dropouts [share]": (_dropouts, np.geomspace(3e-4, 0.3, 24), 1, frozenset({"outliers"})),
    "stuck [samples]": (_stuck, np.unique(np.geomspace(2, 100, 24).round()), 1, frozenset({"stuck"})),
    "clipped [share]": (_clipped, np.geomspace(3e-4, 0.3, 24), 1, frozenset({"clipped"})),
    "saturated before the noise [share]": (_saturated, np.geomspace(3e-4, 0.3, 24), 1, frozenset({"saturated"})),
    "holds of 5 samples [number]": (_held, np.unique(np.geomspace(1, 100, 24).round()), 1, frozenset({"stuck"})),
    "wrapped [share]": (_wrapped, np.geomspace(3e-4, 0.3, 24), 1, frozenset({"wraps"})),
    "phase step [degrees]": (_phase, np.geomspace(0.01, 30.0, 24), 1, CHANGES),
    "amplitude step": (_amplitude, np.geomspace(1e-4, 0.3, 24), 1, CHANGES),
    "transient, 1 channel [amplitudes]": (_transient, np.geomspace(1e-4, 1.0, 24), 1, CHANGES),
    "transient, 20 channels [amplitudes]": (_transient, np.geomspace(1e-4, 1.0, 24), 20, CHANGES),
    "ramp": (_ramp, np.geomspace(1e-3, 1.0, 24), 1, CHANGES),
}


def faulty(fault: str, size: float | None, number: int, seed: int) -> tuple[bp.Recording, float]:
    """Return a recording with a fault (None: without), and its effect on an amplitude of the mean over channels.

    The effect is in standard errors of white noise.
    """
    change, _, channels, _ = FAULTS[fault]
    rng = np.random.default_rng([seed, number])
    time = np.arange(COUNT * SAMPLES) / SAMPLES
    clean = [signal(time) + NOISE * rng.standard_normal(time.size) for _ in range(channels)]
    scale = 2.0 if fault.startswith("wrapped") else 1.0
    bad = [scale * x if size is None else change(x.copy(), time, size, rng) for x in clean]
    wave = np.exp(-2j * np.pi * np.outer([1, 3], time))
    difference = np.mean([2.0 * wave @ (b / scale - c) / time.size for b, c in zip(bad, clean, strict=True)], axis=0)
    error = NOISE * np.sqrt(2.0 / (time.size * channels))
    drive = np.cos(2 * np.pi * time) + 1e-3 * rng.standard_normal(time.size)
    outputs = {f"x{i}": x for i, x in enumerate(bad)}
    recording = bp.Recording.from_arrays(time, outputs, {"drive": drive}, name="faulty")
    return recording, float(np.max(np.abs([difference.real, difference.imag]))) / error


def is_named(fault: str, size: float, number: int, seed: int) -> bool:
    """Return whether the fold of a recording with a fault is refused, or has a finding that names it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            run = faulty(fault, size, number, seed)[0].fold(64, frequency=1.0)
        except ValueError:
            return True
    return any(finding.kind in FAULTS[fault][3] for finding in run.findings)


def hidden(fault: str, size: float, numbers: range, seed: int) -> float:
    """Return the mean bias of the first channel's amplitudes [stated standard errors] where the fault is not named.

    It is the largest of both harmonics and both parts, against the folds without the fault; NaN if it is always named.
    """
    biases = []
    for number in numbers:
        if not is_named(fault, size, number, seed):
            runs = [faulty(fault, size_, number, seed)[0].fold(64, frequency=1.0) for size_ in (size, None)]
            bad, clean = (2.0 * np.fft.rfft(run.outputs["x0"])[[*SHAPE]] / 64 for run in runs)
            error = np.sqrt(runs[0].amplitude_variance["x0"][[*SHAPE]])
            biases.append([(bad - clean).real / error, (bad - clean).imag / error])
    return float(np.abs(np.mean(biases, axis=0)).max()) if biases else np.nan


def power(fault: str, count: int, share: float, bias: float, seed: int) -> dict[str, float]:
    """Return the smallest size that is found in this share of recordings, and that with this bias; NaN for none.

    `hidden` is the largest bias of smaller sizes where they are not found.
    """
    _, sizes, _, _ = FAULTS[fault]

    def found(size: float) -> bool:
        missed = 0
        for number in range(count):
            missed += not is_named(fault, size, number, seed)
            if missed > (1.0 - share) * count:
                return False
        return True

    low, high = 0, len(sizes)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if found(sizes[middle]) else (middle + 1, high)
    effects = [np.mean([faulty(fault, size, number, seed)[1] for number in range(min(count, 10))]) for size in sizes]
    biased = next((float(size) for size, effect in zip(sizes, effects, strict=True) if effect >= bias), np.nan)
    silent = [hidden(fault, size, range(min(count, 10)), seed) for size in sizes[:low]]
    return {
        "found": float(sizes[low]) if low < len(sizes) else np.nan,
        "biased": biased,
        "hidden": float(np.nanmax([0.0, *silent])),
    }
