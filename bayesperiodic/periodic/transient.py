"""Guesses from a short time integration."""

import numpy as np

from bayesperiodic import fourier
from bayesperiodic.models.integrate import integrate
from bayesperiodic.periodic.equations import PeriodicEquations

PERIODS = 40
CYCLES = 120
NUDGE = 0.1


def settled_period(equations: PeriodicEquations, parameters: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """Return z (points, states) over the last of some tens of response periods after starting at rest at start[0].

    None if the integration fails or an angle does not advance by the turns wanted.
    """
    grid, count = equations.grid, equations.count
    second = [i for i, state in enumerate(equations.model.states) if equations.model.orders[state] == 2]
    half = fourier.on_grid(fourier.coefficients(equations.inputs.T), 2 * grid.points).T
    path = integrate(
        equations.model,
        np.concatenate([start[0], equations.drift[second] * equations.frequency]),
        half,
        parameters,
        frequency=equations.frequency,
        samples=grid.samples,
        steps=PERIODS * grid.points,
        kept=grid.points,
    )
    if path is None:
        return None
    z = path[:, :count] - equations.drift * (grid.tau[:, None] + (PERIODS - 1) * grid.periods)
    angles = equations.drift != 0.0
    turns = [state in equations.model.angles for state in equations.model.states]
    z[:, turns] -= 2 * np.pi * np.round(z[0, turns] / (2 * np.pi))
    slip = np.abs(z[-1] - z[0])[angles]
    return None if np.any(slip > np.pi) else z


def measured_cycle(equations: PeriodicEquations, parameters: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return z (points, states) and frequency [Hz] of the cycle that an autonomous model settles on; None without one.

    The integration starts near the equilibrium; the cycle is what lies between the last two upward passages of the
    widest moving state through the middle of its range.
    """
    grid, count, model = equations.grid, equations.count, equations.model
    equilibrium = equations.static_guess(parameters)[0]
    rates = sum(model.orders.values()) - count
    start = np.concatenate([equilibrium + NUDGE * np.maximum(np.abs(equilibrium), 1.0), np.zeros(rates)])
    path = integrate(
        model,
        start,
        np.empty((2, 0)),
        parameters,
        frequency=equations.frequency,
        samples=grid.samples,
        steps=CYCLES * grid.samples,
        kept=CYCLES * grid.samples // 4,
    )
    if path is None:
        return None
    state = path[:, int(np.argmax(np.ptp(path[:, :count], axis=0) / (1.0 + np.abs(path[:, :count]).max(axis=0))))]
    height = state - 0.5 * (state.max() + state.min())
    passages = np.flatnonzero((height[:-1] < 0.0) & (height[1:] >= 0.0))
    if len(passages) < 2:
        return None
    times = passages - height[passages] / (height[passages + 1] - height[passages])
    at = np.linspace(times[-2], times[-1], grid.points, endpoint=False)
    z = np.stack([np.interp(at, np.arange(len(path)), path[:, s]) for s in range(count)], axis=-1)
    return z, equations.frequency * grid.samples / float(times[-1] - times[-2])
