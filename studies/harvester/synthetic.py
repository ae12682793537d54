"""A simulated beam with a piezo element in 120 pieces, its unstable orbits, and what a search finds of them.

The true orbits come from a long simulation without noise and Newton's method on the flow, by SciPy.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.integrate import odeint
from scipy.interpolate import CubicSpline
from scipy.stats import binom, chi2, norm

import bayesperiodic as bp
from studies import shooting
from studies.harvester.beam import error_of
from studies.harvester.recording import FREQUENCY

# x'' = f1 x − f3 x³ − damping x' − back v − drive_gain a, v' = −decay v + coupling x'; a is the base's acceleration.
TRUTH = {
    "f1": 1300.0, "f3": 6.1e4, "damping": 10.0, "back": 206.0, "drive_gain": 25.0, "coupling": 0.633, "decay": 5.0,
}  # fmt: skip
MODEL = bp.Model(
    "piezo_duffing",
    states=["x", "v"],
    inputs=["drive"],
    parameters=[*TRUTH],
    equations=["ddx + damping*dx - f1*x + f3*x**3 + back*v + drive_gain*drive", "dv + decay*v - coupling*dx"],
    outputs={"displacement": "x", "velocity": "dx", "voltage": "v"},
)
AMPLITUDE = 4.6  # m/s²
# Pieces, their periods, periods between them, of the long simulation, and at its start, which are left out.
PIECES, LENGTH, PAUSE, LONG, SETTLING = 120, 26, 4, 10_000, 200
RATE = 2048.0  # Hz
# Coordinates of the sections, as many as states, of which the integral is nearly the displacement; others to compare
# with; and local maps a period.
COORDINATES, STEPS = ("voltage", "integral(voltage)[-0.3]", "integral(voltage)"), 3
DELAYED = ("voltage", "voltage[-0.4]", "voltage[-0.8]")
# Recordings that are searched, each with its seed.
SEARCHED = 3
NOISE = {"velocity": 0.02, "voltage": 2e-6, "drive": 2e-3}
# True orbits: periods, largest multiplier, and fewest close returns in the recording, all points of which are within
# this distance of the orbit, in ranges of the states.
PERIODS, LARGEST, FEWEST, CLOSE = (1, 2, 3, 4), 100.0, 3, 0.08
CANDIDATES = 50
# Points a period of the Fourier series of an orbit.
POINTS = 64
# An orbit is found if all coordinates of its points are within this distance, in ranges of the coordinates; half width
# of 90 % error bars in standard deviations, and the probability of the band of the number that they cover.
TOLERANCE, HALF_WIDTH, BAND = 0.02, 1.6448536, 0.99
# Of the estimates: recordings, points a period, largest error of a waveform as a fraction of it; standard deviation
# of the logarithms of the priors' medians about the truth, that of the priors, and probabilities of the intervals. The
# variances of an orbit are at least as stated: they contain bounds of the bias, so that residuals are mostly smaller.
RECORDINGS, SAMPLES, LARGEST_ERROR, MISTAKE, SPREAD, LEVELS = 10, 128, 0.05, 0.18, 0.3, (0.5, 0.9)
LARGEST_FACTOR = 1e6
# Guesses nearer to each other, and orbits nearer to each other than this are the same.
ALIKE, SAME = 0.02, 1e-5


class TrueOrbit(NamedTuple):
    """A periodic orbit of the flow."""

    states: np.ndarray  # x, x' and v at whole periods of the drive, (period, 3)
    multipliers: np.ndarray  # (3,)

    @property
    def period(self) -> int:
        """Number of drive periods."""
        return len(self.states)


def states_of(periods: int, rate: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times and states (samples, 3) of a motion without noise, after a transient."""
    angle = 2.0 * np.pi * np.arange(64) / 64
    start = np.random.default_rng(seed).uniform(-0.1, 0.1)
    run = bp.simulate(
        MODEL, TRUTH, {"drive": AMPLITUDE * np.cos(angle)}, frequency=FREQUENCY,
        duration=(SETTLING + periods) / FREQUENCY, sampling_rate=rate, start={"x": start},
    )  # fmt: skip
    kept = run.time >= (SETTLING - 1e-9) / FREQUENCY
    return run.time[kept], np.stack([run.outputs[n][kept] for n in ("displacement", "velocity", "voltage")], axis=1)


def flow(start: float, end: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the state at the end and its derivative by that at the start, times in drive periods."""
    p = TRUTH
    force, omega = p["drive_gain"] * AMPLITUDE, 2.0 * np.pi * FREQUENCY

    def rates(t: float, z: np.ndarray) -> np.ndarray:
        x, y, v = z[:3]
        slope = p["f1"] - 3.0 * p["f3"] * x * x
        a, b, c = z[3:6], z[6:9], z[9:]
        result = np.empty(12)
        result[:3] = (
            y, (p["f1"] - p["f3"] * x * x) * x - p["damping"] * y - p["back"] * v - force * np.cos(omega * t),
            p["coupling"] * y - p["decay"] * v,
        )  # fmt: skip
        result[3:6], result[6:9] = b, slope * a - p["damping"] * b - p["back"] * c
        result[9:] = p["coupling"] * b - p["decay"] * c
        return result

    times = np.array([start, end]) / FREQUENCY
    first = np.concatenate([state, np.eye(3).ravel()])
    end_values = odeint(rates, first, times, tfirst=True, rtol=1e-11, atol=1e-12, mxstep=shooting.MOST_STEPS)[-1]
    return end_values[:3], end_values[3:].reshape(3, 3)


def first_whole(time: float) -> int:
    """Return the number of the first drive period that starts at this time [s] or later."""
    return int(np.ceil(time * FREQUENCY - 1e-9))


def recordings(seed: int) -> tuple[list[bp.Recording], np.ndarray]:
    """Return the pieces with noise, and the true states at whole periods of the drive, (pieces, periods, 3).

    The states are those of the same run: another run from the same start, with other steps, diverges from it.
    """
    time, states = states_of(PIECES * (LENGTH + PAUSE), RATE, seed)
    drive = AMPLITUDE * np.cos(2.0 * np.pi * FREQUENCY * time)
    generator = np.random.default_rng([seed, 1])
    channels = {"velocity": states[:, 1], "voltage": states[:, 2], "drive": drive}
    noisy = {n: v + NOISE[n] * generator.standard_normal(v.size) for n, v in channels.items()}
    pieces = []
    for first in (LENGTH + PAUSE) * np.arange(PIECES):
        inside = (time >= time[0] + first / FREQUENCY) & (time < time[0] + (first + LENGTH) / FREQUENCY)
        outputs = {name: noisy[name][inside] for name in ("velocity", "voltage")}
        pieces.append(bp.Recording(time[inside], outputs, {"drive": noisy["drive"][inside]}, synthetic=True))
    whole = first_whole(time[0]) + np.arange(PIECES * (LENGTH + PAUSE))
    every = CubicSpline(time, states)(np.minimum(whole / FREQUENCY, time[-1]))
    return pieces, every.reshape(PIECES, LENGTH + PAUSE, 3)[:, :LENGTH]


@cache
def orbits_of_the_flow() -> tuple[TrueOrbit, ...]:
    """Return the orbits near close returns of a long motion, whatever their multipliers."""
    section = states_of(LONG, FREQUENCY, 0)[1]
    size = np.ptp(section, axis=0)
    result: list[TrueOrbit] = []
    for period in PERIODS:
        away = np.abs((section[period:] - section[:-period]) / size).max(axis=1)
        guesses: list[np.ndarray] = []
        for first in np.argsort(away):
            if len(guesses) == CANDIDATES or away[first] > CLOSE:
                break
            guess = section[first : first + period]
            if all(_apart(guess / size, other / size) > ALIKE for other in guesses):
                guesses.append(guess)
        for guess in guesses:
            try:
                orbit = shooting.closed(flow, np.arange(period + 1.0), guess, np.zeros(3), accuracy=1e-9)
            except (RuntimeError, np.linalg.LinAlgError):
                continue
            known = [one.states for one in result if one.period == period]
            shorter = [
                _apart(np.roll(orbit.states, -k, axis=0)[:k], orbit.states[:k])
                for k in range(1, period)
                if period % k == 0
            ]
            if not any(a < SAME for a in shorter) and not any(_apart(orbit.states, one) < SAME for one in known):
                result.append(TrueOrbit(orbit.states, orbit.multipliers))
    return tuple(result)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest distance of the states of two orbits of one period, at the shift with the smallest."""
    return min(float(np.abs(np.roll(one, -k, axis=0) - other).max()) for k in range(len(one)))


def close_returns(orbit: TrueOrbit, states: np.ndarray, size: np.ndarray) -> int:
    """Return how many times the motion is close to the orbit at period + 1 successive points of one piece."""
    p = orbit.period
    chains = np.lib.stride_tricks.sliding_window_view(states, p + 1, axis=1).transpose(0, 1, 3, 2)
    count = 0
    for k in range(p):
        closed = np.roll(np.concatenate([orbit.states, orbit.states]), -k, axis=0)[: p + 1]
        count += int(np.sum(np.abs((chains - closed) / size).max((2, 3)) < CLOSE))
    return count


def states_at(orbit: TrueOrbit, at: np.ndarray) -> np.ndarray:
    """Return the states (…, 3) of an orbit at times in drive periods, by the Fourier series of its points."""
    course = []
    for k, state in enumerate(orbit.states):
        here = state
        for j in range(POINTS):
            course.append(here)
            here = flow(k + j / POINTS, k + (j + 1) / POINTS, here)[0]
    amplitudes = np.fft.rfft(course, axis=0) / len(course)
    amplitudes[1:] *= 2.0
    turns = 2j * np.pi * np.arange(len(amplitudes)) / orbit.period
    return (np.exp(np.multiply.outer(at, turns)) @ amplitudes).real


def integral_of_voltage(states: np.ndarray) -> np.ndarray:
    """Return the integral of the voltage over time (…,) but for a constant, by the second equation."""
    return (TRUTH["coupling"] * states[..., 0] - states[..., 2]) / TRUTH["decay"]


def constant_of(section: bp.PoincareSection, states: np.ndarray, first: int) -> float:
    """Return the constant of the integral of the voltage in a section, from the true states after `first` periods."""
    if COORDINATES[-1] not in section.coordinates:
        return 0.0
    assert section.instants is not None
    number = np.round(section.instants * FREQUENCY - first).astype(int)
    true = integral_of_voltage(states)[number // (LENGTH + PAUSE), number % (LENGTH + PAUSE)]
    return float(np.mean(section.points[:, section.coordinates.index(COORDINATES[-1])] - true))


def counted_orbits(states: np.ndarray) -> list[tuple[TrueOrbit, int]]:
    """Return the orbits that a search should find in a recording with these states, and their close returns."""
    size = np.ptp(states, axis=(0, 1))
    every = [(orbit, close_returns(orbit, states, size)) for orbit in orbits_of_the_flow()]
    return [(o, count) for o, count in every if abs(o.multipliers[0]) < LARGEST and count >= FEWEST]


def points_of(orbit: TrueOrbit, coordinates: Sequence[str], constant: float) -> np.ndarray:
    """Return the points (period, d) of an orbit at phase zero in coordinates, with the constant of the integral."""
    columns = []
    for name in coordinates:
        channel, _, delay = name.partition("[")
        states = states_at(orbit, np.arange(orbit.period) + float(delay.rstrip("]") or 0.0))
        columns.append(states[:, 2] if channel == "voltage" else integral_of_voltage(states) + constant)
    return np.stack(columns, axis=1)


def compared(
    true: list[tuple[TrueOrbit, int]], orbits: bp.Orbits, sections: list[bp.PoincareSection], constant: float
) -> list[dict[str, Any]]:
    """Return a row for each true orbit: whether it is found, and how many of its points are within their error bars."""
    rows, size = [], np.ptp(sections[0].points, axis=0)
    for orbit, returns in true:
        row: dict[str, Any] = {
            "period": orbit.period, "multiplier": float(orbit.multipliers[0].real), "returns": returns, "found": False
        }  # fmt: skip
        points, closest = points_of(orbit, sections[0].coordinates, constant), TOLERANCE
        for one in orbits:
            for k in range(orbit.period if one.period == orbit.period else 0):
                away = np.roll(points, -k, axis=0) - one.points
                if (distance := float(np.abs(away / size).max())) < closest:
                    inside = np.abs(away) < HALF_WIDTH * np.sqrt(np.diag(one.covariance)).reshape(away.shape)
                    row |= {
                        "found": True, "away": (closest := distance), "sections": one.sections,
                        "points": len(inside), "covered": int(inside[:, 0].sum()),
                        "values": inside.size, "values_covered": int(inside.sum()),
                        "estimate": float(one.eigenvalues[0].real), "estimate_sd": float(one.eigenvalue_sd[0]),
                    }  # fmt: skip
        rows.append(row)
    return rows


def estimate(phases: int, seed: int, *, quick: bool) -> dict[str, Any]:
    """Return the estimate from the orbits of one recording, with priors whose medians are off at random."""
    pieces, _ = recordings(seed)
    orbits = bp.find_orbits(sections_of(pieces, DELAYED, phases), periods=PERIODS[: 2 if quick else 3], steps=STEPS)
    used = [orbit for orbit in orbits if error_of(orbit) < LARGEST_ERROR]
    generator = np.random.default_rng([seed, 2])
    priors = {n: bp.LogNormal(v * np.exp(MISTAKE * generator.standard_normal()), SPREAD) for n, v in TRUTH.items()}
    runs = [orbit.experiment(samples=SAMPLES, whole=True) for orbit in used]
    noise = bp.noise.Independent(per="experiment", prior=bp.LogUniform(1.0, LARGEST_FACTOR))
    problem = bp.Problem(MODEL, runs, priors=priors, noise=noise)
    try:
        result = bp.estimate_orbits(problem, progress=False)
    except ValueError as error:
        return {"seed": seed, "orbits": len(used), "error": str(error)}
    fit, names = result.fit, [*TRUTH]
    away = np.array([fit.theta[name] - TRUTH[name] for name in names])
    covariance = fit.robust_covariance.loc[names, names].to_numpy()
    return {
        "seed": seed, "orbits": len(used), "dropped": len(result.dropped),
        "medians": {name: prior.median / TRUTH[name] for name, prior in priors.items()},
        "theta": dict(fit.theta), "robust_sd": dict(fit.robust_sd),
        "in_sd": {name: (fit.theta[name] - TRUTH[name]) / fit.robust_sd[name] for name in names},
        "distance": float(away @ np.linalg.solve(covariance, away)),
    }  # fmt: skip


def coverage(phases: int, seed: int, *, quick: bool) -> dict[str, Any]:
    """Return the estimates of several recordings, and how many intervals and joint regions contain the truth."""
    rows = [estimate(phases, seed + k, quick=quick) for k in range(2 if quick else RECORDINGS)]
    there = [row for row in rows if "error" not in row]
    in_sd = np.array([[*row["in_sd"].values()] for row in there]).reshape(len(there), len(TRUTH))
    distances = np.array([row["distance"] for row in there])
    counts = []
    for level in LEVELS:
        inside = np.abs(in_sd) < norm.ppf(0.5 + 0.5 * level)
        for kind, hits in (("each", inside.ravel()), ("joint", distances < chi2.ppf(level, len(TRUTH)))):
            band = [int(end) for end in binom.interval(BAND, hits.size, level)]
            counts.append({"level": level, "kind": kind, "count": int(hits.sum()), "of": hits.size, "band": band})
    rms = dict(zip(TRUTH, np.sqrt(np.mean(in_sd**2, axis=0)).tolist(), strict=True))
    return {"truth": TRUTH, "recordings": rows, "estimated": len(there), "rms_in_sd": rms, "counts": counts}


def coverage_table(results: dict[str, Any]) -> str:
    """Return the errors of all estimates in standard deviations, and the numbers inside intervals, as text."""
    rows = [{"seed": r["seed"], "orbits": r["orbits"]} | r.get("in_sd", {}) for r in results["recordings"]]
    lines = [
        "Errors in robust standard deviations",
        pd.DataFrame(rows).to_string(index=False, float_format="{:.2f}".format),
    ]
    lines.append(f"{results['estimated']} of {len(rows)} recordings give an estimate")
    for c in results["counts"]:
        lines.append(f"{c['level']:.0%} {c['kind']}: {c['count']} of {c['of']}, 99 % band {c['band']}")
    return "\n".join(lines)


def sections_of(pieces: list[bp.Recording], coordinates: tuple[str, ...], phases: int) -> list[bp.PoincareSection]:
    """Return the sections at several phases of the drive."""
    return [
        bp.PoincareSection.from_recordings(pieces, coordinates, frequency=FREQUENCY, origin=k / (phases * FREQUENCY))
        for k in range(phases)
    ]


def campaign(phases: int, seed: int, *, quick: bool) -> dict[str, Any]:
    """Return what searches find of the orbits of the flow, and how many true values the error bars contain."""
    result: dict[str, Any] = {"truth": TRUTH}
    given = [recordings(seed + k) for k in range(1 if quick else SEARCHED)]
    for name, coordinates in (("integrated", COORDINATES), ("delayed", DELAYED)):
        each = [_searched(*one, coordinates, phases, PERIODS[:2] if quick else PERIODS) for one in given]
        rows = [row for one in each for row in one["orbits"]]
        there = [row for row in rows if row["found"]]
        result[name] = {"coordinates": coordinates, "recordings": each, "found": len(there), "of": len(rows)}
        for kind, of in (("covered", "points"), ("values_covered", "values")):
            count = sum(row[of] for row in there)
            result[name][kind] = {
                "count": sum(row[kind] for row in there), "of": count,
                "band": [int(end) for end in binom.interval(BAND, count, 0.9)],
            }  # fmt: skip
    return result


def _searched(
    pieces: list[bp.Recording], states: np.ndarray, coordinates: tuple[str, ...], phases: int, wanted: Sequence[int]
) -> dict[str, Any]:
    """Return the rows of the orbits of one recording, and the number of all orbits that a search returns."""
    sections = sections_of(pieces, coordinates, phases)
    orbits = bp.find_orbits(sections, periods=wanted, steps=STEPS)
    true = [pair for pair in counted_orbits(states) if pair[0].period in wanted]
    rows = compared(true, orbits, sections, constant_of(sections[0], states, first_whole(pieces[0].time[0])))
    return {"orbits": rows, "found": sum(row["found"] for row in rows), "all_found": len(orbits)}


def table(results: dict[str, Any]) -> str:
    """Return the rows of the orbits, and the numbers found and covered, as text."""
    lines = []
    for name in ("integrated", "delayed"):
        part = results[name]
        lines.append(f"{name}: {', '.join(part['coordinates'])}")
        for one in part["recordings"]:
            lines.append(pd.DataFrame(one["orbits"]).to_string(float_format="{:.4g}".format, na_rep="-"))
        lines.append(f"{part['found']} of {part['of']} orbits are found")
        for kind in ("covered", "values_covered"):
            lines.append(f"{kind}: {part[kind]['count']} of {part[kind]['of']}, 99 % band {part[kind]['band']}")
    return "\n".join(lines)
