"""The same orbits found in sections of one motion at several phases of the forcing, and their mirror images.

An orbit is found where the map along it is closer to a polynomial than elsewhere, which depends on the phase of the
section. Its waveform does not: waveforms at different phases are compared, and the best of each orbit is kept.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from bayesperiodic.orbits.coordinates import channel_and_delay, wrapped
from bayesperiodic.orbits.orbit import TURN, Orbit
from bayesperiodic.orbits.section import PoincareSection
from bayesperiodic.orbits.waveform import INDEPENDENT, Waveform

# Largest distance of waveforms of the same orbit, rms over the phases of each channel, in standard errors of it.
SAME_WAVEFORM = 3.0
# Largest error of a phase that counts as a sixteenth of a period.
EXACT_PHASE = 1e-6


def phases_of(sections: Sequence[PoincareSection]) -> list[int]:
    """Return by how many sixteenths of the forcing period each section is later than the first, from 0 to 15.

    Raises a ValueError unless the sections differ in their phase alone.
    """
    first = sections[0]
    for one in sections:
        if one.measured is None or one.crossed is not None:
            raise ValueError(
                "section: must be sections of recordings at phases of a forcing where there are several, got one of "
                f"{'crossings' if one.crossed else 'points'}. Use find_orbits for each."
            )
        for name in ("frequency", "coordinates", "angles", "others", "inputs"):
            if getattr(one, name) != getattr(first, name):
                raise ValueError(
                    f"section: must be sections with the same {name} where there are several, got "
                    f"{getattr(first, name)} and {getattr(one, name)}."
                )
    late = []
    for one in sections:
        assert one.instants is not None and first.instants is not None
        sixteenths = INDEPENDENT * (((one.instants[0] - first.instants[0]) * first.frequency) % 1.0)
        if abs(sixteenths - round(sixteenths)) > EXACT_PHASE * max(1.0, abs(one.instants[0] * first.frequency)):
            raise ValueError(
                "section: must be sections whose origins differ by multiples of a sixteenth of the forcing period, "
                f"got {sixteenths / INDEPENDENT:.4g} of it."
            )
        late.append(round(sixteenths) % INDEPENDENT)
    return late


def merged(orbits: Sequence[Sequence[Orbit]], late: Sequence[int]) -> list[Orbit]:
    """Return each orbit once, at the phase of the first section, from the section where its errors are smallest.

    `orbits` are those with waveforms of each section, and the sections are `late` sixteenths of the period later.
    """
    every = [_earlier(orbit, sixteenths) for some, sixteenths in zip(orbits, late, strict=True) for orbit in some]
    if not every:
        return []
    size = _sizes(every)
    result: list[Orbit] = []
    for orbit in sorted(every, key=lambda one: _error(one, size)):
        same = next((k for k, other in enumerate(result) if _is_same(orbit, other, size)), None)
        if same is None:
            result.append(orbit)
        else:
            result[same] = replace(result[same], sections=result[same].sections + 1)
    return sorted(result, key=lambda one: (one.period, abs(one.eigenvalues[0])))


def with_late_partners(orbits: Sequence[Orbit]) -> tuple[Orbit, ...]:
    """Return the orbits with their mirror images half a forcing period later, where there is none at once.

    A forcing that changes its sign within half a period, in a symmetric system, has such pairs of orbits.
    """
    known = [one for one in orbits if one.waveform is not None and not one.angles and one.return_times is None]
    if not known:
        return tuple(orbits)
    size, result = _sizes(known), []
    for orbit in orbits:
        if orbit.partner is None and any(orbit is one for one in known):
            for number, other in enumerate(orbits):
                if any(other is one for one in known) and _is_same(orbit, other, size, mirrored=True):
                    orbit = replace(orbit, partner=number, partner_delay=0.5)
                    break
        result.append(orbit)
    return tuple(result)


def _sizes(orbits: Sequence[Orbit]) -> np.ndarray:
    """Return the largest range of each output of the waveforms, (outputs,); of an angle one radian."""
    ranges = []
    for orbit in orbits:
        assert orbit.waveform is not None
        ranges.append([np.ptp(orbit.waveform.values[name]) for name in orbit.waveform.outputs])
    names = () if orbits[0].waveform is None else orbits[0].waveform.outputs
    largest = np.max(ranges, axis=0)
    return np.where(np.isin(names, orbits[0].angles) | (largest == 0.0), 1.0, largest)


def _outputs(orbit: Orbit, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the waveforms of the outputs and their standard errors at 16 phases a period, (outputs, phases) each."""
    assert orbit.waveform is not None
    sd, names = orbit.waveform.sd, orbit.waveform.outputs
    every = orbit.waveform.noise.shape[1] // (INDEPENDENT * orbit.period)
    return tuple(
        np.stack([by_name[name][::every] for name in names]) / size[:, None] for by_name in (orbit.waveform.values, sd)
    )


def _error(orbit: Orbit, size: np.ndarray) -> float:
    return float(np.sqrt(np.mean(_outputs(orbit, size)[1] ** 2)))


def _is_same(one: Orbit, other: Orbit, size: np.ndarray, *, mirrored: bool = False) -> bool:
    """Return whether two waveforms agree within their errors after some shift by whole forcing periods.

    All channels must agree: large errors of one say nothing about another. With `mirrored`, whether one is the other
    with all signs changed, half a period later.
    """
    if one.period != other.period:
        return False
    (here, sd), (there, other_sd) = _outputs(one, size), _outputs(other, size)
    if mirrored:
        there = -np.roll(there, INDEPENDENT // 2, axis=1)
    for shift in range(one.period):
        difference = np.roll(there, INDEPENDENT * shift, axis=1) - here
        for k, name in enumerate(() if one.waveform is None else one.waveform.outputs):
            if name in one.angles:
                difference[k] -= TURN * np.round(difference[k] / TURN)
        if np.all(np.mean(difference**2, axis=1) < SAME_WAVEFORM**2 * np.mean(sd**2 + other_sd**2, axis=1)):
            return True
    return False


def _earlier(orbit: Orbit, sixteenths: int) -> Orbit:
    """Return the orbit seen from a phase of the section that is some sixteenths of the period earlier."""
    if not sixteenths:
        return orbit
    waveform = orbit.waveform
    assert waveform is not None
    turns = TURN * (orbit.winding or 0)
    count = waveform.noise.shape[1]
    by = count // (INDEPENDENT * orbit.period) * sixteenths
    source = np.arange(count) - by
    values = {
        name: np.asarray(v)[source % count] + (turns * (source // count) if name in orbit.angles else 0.0)
        for name, v in waveform.values.items()
    }
    parts = waveform.bias.shape[1]
    spread = np.repeat(waveform.bias, count // parts, axis=1)[:, source % count]
    bias = np.sqrt(np.mean(spread.reshape(len(spread), parts, -1) ** 2, axis=2))
    turned = Waveform(
        values, waveform.inputs, waveform.errors[:, :, source % count], bias, waveform.noise[:, source % count]
    )
    points, covariance = _points(orbit, turned)
    d = points.shape[1]
    joint = np.zeros_like(orbit.joint_covariance)
    joint[:-d, :-d], joint[-d:, -d:] = covariance, orbit.joint_covariance[-d:, -d:]
    cycle = {name: v for name, v in values.items() if orbit.cycle is not None and name in orbit.cycle}
    return replace(orbit, points=points, joint_covariance=joint, waveform=turned, cycle=cycle)


def _points(orbit: Orbit, waveform: Waveform) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (period, d) of a waveform at whole tau, and their covariance (period·d, period·d)."""
    channels, each = list(waveform.values), waveform.noise.shape[1] // orbit.period
    common = waveform.common_errors
    values, errors, noise = [], [], []
    for name in orbit.coordinates:
        channel, delay = channel_and_delay(name)
        at, row = each * (np.arange(orbit.period) + delay), channels.index(channel)
        index = np.round(at).astype(int) % (each * orbit.period)
        # Angles have no delay, so that the spline is evaluated at its nodes.
        course = np.asarray(waveform.values[channel])
        if channel not in orbit.angles:
            course = np.append(course, course[0])
            values.append(CubicSpline(np.arange(course.size), course, bc_type="periodic")(at))
        else:
            values.append(course[index])
        errors.append(common[:, row, index])
        noise.append(waveform.noise[row, index])
    flat = np.stack(errors, axis=-1).reshape(len(common), -1)
    covariance = flat.T @ flat + np.diag(np.stack(noise, axis=-1).ravel() ** 2)
    return wrapped(np.stack(values, axis=-1), np.isin(orbit.coordinates, orbit.angles)), covariance
