"""First guesses of a model's periodic orbit from what a section measured: a whole cycle, or points alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic import fourier
from bayesperiodic.models.integrate import integrate
from bayesperiodic.periodic.equations import PeriodicEquations

if TYPE_CHECKING:
    from bayesperiodic.orbits.orbit import Orbit

NOISE_FLOOR = 5.0
MOST_TRIED = 12
TURN = 2 * np.pi


def seeds(
    orbit: Orbit, build: Callable[[int], PeriodicEquations], parameters: np.ndarray
) -> Iterator[tuple[PeriodicEquations, np.ndarray]]:
    """Yield the equations of a winding number and a guess z (points, states), the likeliest first.

    The measured cycle comes first. Where there is none, or it leads to nothing, the model is integrated over one
    forcing period from each section point, and its pieces are bent so that they meet; where that leaves the turns of an
    angle open, the windings follow in the order of how much bending they need.

    Parameters
    ----------
    orbit : Orbit
    build : callable
        Returns the equations for a winding number.
    parameters : array (parameters,)

    Raises
    ------
    ValueError
        If the section's coordinates do not tell the model's states.
    """
    winding = counted_turns(orbit)
    if orbit.cycle is not None:
        assert winding is not None
        equations = build(winding)
        yield equations, _from_cycle(orbit, equations, parameters, winding)
    for turns, z in _from_points(orbit, build(0), parameters):
        if winding is None or turns == winding:
            equations = build(turns)
            yield equations, z - equations.drift * equations.grid.tau[:, None]


def counted_turns(orbit: Orbit) -> int | None:
    """Return the winding number that the section counted, or that its cycle shows; None where neither can tell."""
    if orbit.winding is not None or orbit.cycle is None:
        return orbit.winding
    turns = [round(float(_end(orbit.cycle[name]) - orbit.cycle[name][0]) / TURN) for name in orbit.angles]
    return int(turns[0]) if turns else 0


def resampled_cycle(orbit: Orbit, winding: int, samples: int) -> np.ndarray:
    """Return the measured cycle (samples·period, 2) on another grid, closed, without harmonics that are mere noise.

    The gap between its end and its beginning is spread over the cycle. A harmonic is noise where it and all above it
    stay below five times the median amplitude of the upper half of the spectrum.
    """
    assert orbit.cycle is not None
    tau, columns = np.arange(samples * orbit.period) / samples, []
    for name in orbit.coordinates:
        values = np.asarray(orbit.cycle[name], dtype=float)
        turns = TURN * winding if name in orbit.angles else 0.0
        share = np.arange(values.size) / values.size
        gap = _end(values) - values[0] - turns
        amplitudes = fourier.coefficients(values - (turns + gap) * share + 0.5 * gap)
        floor = NOISE_FLOOR * np.median(np.abs(amplitudes[amplitudes.size // 2 :]))
        kept = np.flatnonzero(np.abs(amplitudes) > floor).max(initial=1)
        columns.append(fourier.on_grid(amplitudes[: kept + 1], tau.size) + turns * tau / orbit.period)
    return np.stack(columns, axis=-1)


def _end(values: np.ndarray) -> float:
    """Return where a cycle without its end point ends."""
    return float(3.0 * values[-1] - 3.0 * values[-2] + values[-3])


def _from_cycle(orbit: Orbit, equations: PeriodicEquations, parameters: np.ndarray, winding: int) -> np.ndarray:
    values = resampled_cycle(orbit, winding, equations.grid.samples)
    known = _phases(orbit, equations, parameters, values, equations.grid.tau, equations.inputs)[:, : equations.count]
    return known - equations.drift * equations.grid.tau[:, None]


def _from_points(
    orbit: Orbit, equations: PeriodicEquations, parameters: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield winding numbers and states (points, states), turns included, that go through the section points."""
    model, samples, periods = equations.model, equations.grid.samples, orbit.period
    tau = np.arange(periods, dtype=float)
    starts = _phases(orbit, equations, parameters, orbit.points, tau, equations.inputs[::samples], rates=True)
    half = fourier.on_grid(fourier.coefficients(equations.inputs[:samples].T), 2 * samples).T
    pieces = []
    for start in starts:
        piece = integrate(
            model,
            start,
            half,
            parameters,
            frequency=equations.frequency,
            samples=samples,
            steps=samples + 1,
            kept=samples + 1,
        )
        if piece is None:
            return
        pieces.append(piece[:, : equations.count])
    path = np.stack(pieces)
    missed = path[:, -1] - np.roll(starts[:, : equations.count], -1, axis=0)
    angle = next((i for i, state in enumerate(model.states) if state in model.angles), None)
    if angle is None:
        yield 0, _joined(path, missed, None, np.zeros(periods))
        return
    exact = missed[:, angle] / TURN
    choices = [(np.floor(turns), np.ceil(turns)) for turns in exact]
    ranked = sorted(product(*choices), key=lambda turns: float(np.sum((exact - np.array(turns)) ** 2)))
    for turns in ranked[:MOST_TRIED]:
        yield int(sum(turns)), _joined(path, missed, angle, np.array(turns))


def _joined(path: np.ndarray, missed: np.ndarray, angle: int | None, turns: np.ndarray) -> np.ndarray:
    """Return the pieces (periods, samples + 1, states) bent so that each ends where the next one starts."""
    periods, length, count = path.shape
    bend, before = missed.copy(), np.zeros((periods, count))
    if angle is not None:
        bend[:, angle] -= TURN * turns
        before[1:, angle] = TURN * np.cumsum(turns[:-1])
    # Errors grow along an unstable orbit, so most of the bending belongs to the end of a piece.
    share = (np.arange(length - 1) / (length - 1)) ** 2
    return (path[:, :-1] - share[:, None] * bend[:, None] + before[:, None]).reshape(-1, count)


def _phases(
    orbit: Orbit,
    equations: PeriodicEquations,
    parameters: np.ndarray,
    values: np.ndarray,
    tau: np.ndarray,
    inputs: np.ndarray,
    rates: bool = False,
) -> np.ndarray:
    """Return the states, then the rates of the second-order ones, (points, size), from the section's coordinates.

    Rates may stay untold unless they are asked for.
    """
    model, count = equations.model, equations.count
    columns = [model.outputs.index(name) for name in orbit.coordinates]
    second = [i for i, state in enumerate(model.states) if model.orders[state] == 2]
    places = [*range(count), *(count + i for i in second)]

    def outputs(phase: np.ndarray) -> np.ndarray:
        states = np.zeros((tau.size, 3 * count))
        states[:, places] = phase
        inputs_here = np.ascontiguousarray(inputs)
        return model.kernels.evaluate("outputs", states, inputs_here, parameters, tau, equations.frequency)[:, columns]

    offset = outputs(np.zeros(len(places)))
    slopes = np.stack([outputs(unit) - offset for unit in np.eye(len(places))], axis=-1)
    inverse = np.linalg.pinv(slopes)
    wanted = len(places) if rates else count
    phases = np.einsum("nip,np->ni", inverse, values - offset)
    told = np.allclose((inverse @ slopes)[:, :wanted], np.eye(len(places))[:wanted], atol=1e-6)
    if not told or not np.allclose(outputs(phases), values, rtol=1e-6, atol=1e-9):
        what = "states and rates" if rates else "states"
        raise ValueError(
            f"coordinates: {orbit.coordinates} are not allowed; the {what} of {model.name!r}, {list(model.states)}, "
            "must follow from them by linear equations. Make the section of outputs that are linear in these, such as "
            "a state and its rate."
        )
    return phases
