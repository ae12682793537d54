"""Periodic orbits of the pendulum: found, polished, compared with shooting, multipliers by two methods.

The shooting reference of `studies.shooting` is independent of the package.
"""

import multiprocessing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binom
from tqdm import tqdm

import bayesperiodic as bp
from studies import shooting
from studies.pendulum.recording import COORDINATES, OMEGA, TRUTH
from studies.shooting import TURN

# Tolerance of the integration, accuracy of the orbit.
TOLERANCE, ACCURACY = 1e-11, 1e-9


class Shot(NamedTuple):
    """Orbit to which shooting converges from given points."""

    points: np.ndarray  # (period, 2): φ in (−π, π] and φ̇ at tau = 0, 1, …
    winding: int
    multipliers: np.ndarray  # (2,): Largest modulus first
    prime: int  # Forcing periods after which the points repeat
    converged: bool


def shoot(parameters: Mapping[str, float], omega: float, points: np.ndarray) -> Shot:
    """Return the orbit that multiple shooting, one segment per forcing period, converges to from points.

    The turns of each segment are those of its first integration.
    """
    p, states = parameters, np.array(points, dtype=float)
    inertia = p["m"] * p["l"] ** 2
    changes = {"width": p["v0"], "g": p["g"], "lift": p["a"], "length": p["l"]}
    changes |= {f"c{i}": p[f"k{i}"] / inertia for i in (1, 2, 3)}
    advance = shooting.pendulum_flow(omega, TOLERANCE, **changes)
    times = TURN / omega * np.arange(len(states) + 1)
    ends = [advance(times[0], times[1], state)[0][0] for state in states]
    turns = np.round((np.array(ends) - np.roll(states[:, 0], -1)) / TURN)
    states[1:, 0] += TURN * np.cumsum(turns)[:-1]
    winding = int(turns.sum())
    try:
        orbit = shooting.closed(advance, times, states, [TURN * winding, 0.0], accuracy=ACCURACY)
    except (RuntimeError, np.linalg.LinAlgError):
        return Shot(states, winding, np.full(2, np.nan), 0, False)
    wrapped = orbit.states.copy()
    wrapped[:, 0] = -((-wrapped[:, 0] + np.pi) % TURN - np.pi)
    return Shot(wrapped, winding, orbit.multipliers, _prime(wrapped), True)


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest difference of points (period, 2), angles modulo a turn, rates in units of 5 rad/s a rad."""
    off = np.asarray(one) - np.asarray(other)
    return float(max(np.abs((off[:, 0] + np.pi) % TURN - np.pi).max(), np.abs(off[:, 1]).max() / 5.0))


def _prime(points: np.ndarray) -> int:
    period = len(points)
    for shift in range(1, period):
        if period % shift == 0 and distance(points, np.roll(points, -shift, axis=0)) < 1e-6:
            return shift
    return period


SAMPLES = 800
METHODS = ("chained", "boxes")
# Classes of prime orbits under cyclic shifts and φ → −φ that close returns and Newton's method found (lower bounds).
KNOWN_CLASSES = {1: 3, 2: 4, 3: 9, 4: 9, 5: 18}
WANTED_CLASSES = {1: 3, 2: 4, 3: 9, 4: 9, 5: 17}
MATCHED = 0.15
TWO_SIDED_90 = 1.6448536269514722


@dataclass(frozen=True)
class Reference:
    """A true orbit, by shooting."""

    period: int
    winding: int
    points: np.ndarray  # (period, 2)
    multipliers: np.ndarray  # (2,)
    equilibrium: bool
    off: float  # By how much the polished orbit's section points differ [rad, 5 rad/s]


class Confirmed(NamedTuple):
    """Polished orbits, those to which shooting from them converges, and the names of unconfirmed ones."""

    polished: bp.Orbits
    truths: list[Reference]
    refuted: list[str]


def true_orbits(orbits: bp.Orbits) -> Confirmed:
    """Return polished orbits and those that shooting confirms.

    Of a pair of symmetric partners one is integrated and the other mirrored.
    """
    polished = bp.polish_orbits(bp.models.pendulum, orbits, TRUTH, samples=SAMPLES)
    found: dict[int, Reference] = {}
    refuted, in_worker = [], multiprocessing.parent_process() is not None
    for number, orbit in enumerate(tqdm(polished, desc="shooting", unit="orbit", disable=in_worker)):
        assert orbit.solution is not None
        points = np.stack([orbit.solution.outputs[c][:: orbit.solution.samples] for c in COORDINATES], axis=-1)
        if orbit.partner is not None and orbit.partner in found:
            one = found[orbit.partner]
            found[number] = _nearest(replace(one, winding=-one.winding, points=-one.points), points)
            continue
        shot = shoot(TRUTH, OMEGA, points)
        off = distance(shot.points, points)
        if shot.converged and shot.prime == orbit.period and shot.winding == orbit.winding and off < 1e-3:
            equilibrium = orbit.equilibrium
            found[number] = Reference(orbit.period, shot.winding, shot.points, shot.multipliers, equilibrium, off)
        else:
            refuted.append(orbit.name)
    return Confirmed(polished, list(found.values()), refuted)


def _nearest(truth: Reference, points: np.ndarray) -> Reference:
    """Return the same orbit with the first point for which it is nearest to the points."""
    shifted = [np.roll(truth.points, shift, axis=0) for shift in range(truth.period)]
    offs = [distance(candidate, points) for candidate in shifted]
    return replace(truth, points=shifted[int(np.argmin(offs))], off=min(offs))


def classes(orbits: bp.Orbits) -> dict[int, int]:
    """Return by period how many orbits there are, symmetric partners counted once."""
    counts = dict.fromkeys(KNOWN_CLASSES, 0)
    for number, orbit in enumerate(orbits):
        if orbit.partner is None or orbit.partner >= number or orbit.partner == number:
            counts[orbit.period] = counts.get(orbit.period, 0) + 1
    return counts


def matched(orbit: bp.Orbit, truths: Sequence[Reference]) -> Reference | None:
    """Return the true orbit of a candidate, with the same first point; None if there is none."""
    candidates = [
        _nearest(truth, orbit.points)
        for truth in truths
        if truth.period == orbit.period and orbit.winding in (None, truth.winding)
    ]
    best = min(candidates, key=lambda truth: truth.off, default=None)
    return best if best is not None and best.off < MATCHED else None


def eigenvalue_table(orbits: bp.Orbits, truths: Sequence[Reference]) -> list[dict[str, Any]]:
    """Return by period: candidates, true orbits among them, and the errors of the unstable eigenvalue."""
    rows = []
    for period in KNOWN_CLASSES:
        members = [(orbit, matched(orbit, truths)) for orbit in orbits if orbit.period == period]
        pairs = [(o, t) for o, t in members if t is not None and not t.equilibrium]
        errors = np.array([abs(o.eigenvalues[0] / t.multipliers[0] - 1.0) for o, t in pairs])
        rows.append(
            {
                "period": period,
                "candidates": len(members),
                "orbits": sum(t is not None for _, t in members),
                "estimated": sum(bool(np.isfinite(o.eigenvalue_sd[0])) for o, _ in pairs),
                "median_relative_error": float(np.median(errors)) if errors.size else None,
            }
        )
    return rows


def pulls(orbits: bp.Orbits, truths: Sequence[Reference], largest: float) -> dict[str, list[float]]:
    """Return errors over standard deviations of log|eigenvalue| and of the points, of orbits with |μ| up to a limit."""
    found: dict[str, list[float]] = {"eigenvalue": [], "point": []}
    for orbit in orbits:
        truth = matched(orbit, truths)
        if truth is None or truth.equilibrium or abs(truth.multipliers[0]) > largest:
            continue
        sd = orbit.eigenvalue_sd[0] / abs(orbit.eigenvalues[0])
        if np.isfinite(sd):
            found["eigenvalue"].append(float(np.log(abs(orbit.eigenvalues[0] / truth.multipliers[0])) / sd))
        off = orbit.points - truth.points
        off[:, 0] = (off[:, 0] + np.pi) % TURN - np.pi
        found["point"] += list(off.ravel() / np.sqrt(np.diag(orbit.covariance)))
    return found


def covered(pulls: Sequence[float]) -> dict[str, float]:
    """Return how many 90 % error bars cover, of how many, and the two-sided 99 % binomial band."""
    count = len(pulls)
    low, high = binom.interval(0.99, count, 0.9) if count else (0.0, 0.0)
    inside = int(np.sum(np.abs(pulls) <= TWO_SIDED_90))
    return {"bars": count, "cover": inside, "band_low": float(low), "band_high": float(high)}
