"""Unstable periodic orbits that a model predicts, against measured ones that are not part of its fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bayesperiodic.diagnostics import free_runs
from bayesperiodic.diagnostics.free_runs import Library, Recorded, Runner
from bayesperiodic.orbits.coordinates import wrapped
from bayesperiodic.orbits.orbit import Orbit

if TYPE_CHECKING:
    import pandas as pd

# Newton's iterations for an orbit, the largest step and the last one in units of the states' size.
ORBIT_ITERATIONS, LARGEST_MOVE, LAST_MOVE = 25, 0.2, 1e-6
# The model has an orbit if its points are within so many standard errors, which include a part of the section's size.
WITHIN_ERRORS, ADDED_ERROR = 5.0, 0.01
# Recorded periods of which the mean inputs are taken, in runs.
AVERAGED_RUNS = 40


class ModelOrbit(NamedTuple):
    """A periodic orbit of the model."""

    points: np.ndarray  # section points (period, d)
    multipliers: np.ndarray  # largest modulus first


def orbit_table(
    recorded: Recorded, runner: Runner, thetas: np.ndarray, library: Library, orbits: Sequence[Orbit]
) -> pd.DataFrame:
    """Return one row for each orbit, see `AttractorPrediction`; `thetas` (draws, parameters) are those of draws."""
    import pandas as pd

    table, rows = _mean_inputs(recorded, runner), {}
    size = np.ptp(recorded.section.points, axis=0)
    for orbit in orbits:
        turning = np.isin(orbit.coordinates, orbit.angles)
        near = []
        error = np.sqrt(np.diag(orbit.covariance).reshape(orbit.points.shape))
        for theta in thetas:
            solved = model_orbit(recorded, runner, theta, library, orbit, table)
            if solved is not None:
                away = wrapped(solved.points - orbit.points, turning) if turning.any() else solved.points - orbit.points
                if np.all(np.abs(away) < WITHIN_ERRORS * np.hypot(error, ADDED_ERROR * size)):
                    near.append((away, solved.multipliers[0]))
        value, sd = orbit.eigenvalues[0], orbit.eigenvalue_sd[0]
        row = {"period": orbit.period, "draws": len(near), "measured": value.real, "measured_sd": sd}
        row |= {"predicted": np.nan, "predicted_sd": np.nan, "z_multiplier": np.nan, "z_points": np.nan}
        if near:
            aways, values = np.array([a for a, _ in near]), np.array([m.real for _, m in near])
            spread = np.hypot(error, aways.std(axis=0))
            moduli = np.log(np.abs(values))
            row |= {"predicted": np.median(values), "predicted_sd": values.std()}
            row["z_multiplier"] = (moduli.mean() - np.log(abs(value))) / np.hypot(sd / abs(value), moduli.std())
            row["z_points"] = float(np.abs(aways.mean(axis=0) / spread).max())
        rows[orbit.name] = row
    return pd.DataFrame.from_dict(rows, "index")


def _mean_inputs(recorded: Recorded, runner: Runner) -> np.ndarray:
    """Return the mean of u, u̇, ü at half steps of a forcing period (2·steps + 2, 3·inputs)."""
    every = max(1, len(recorded.starts) // AVERAGED_RUNS)
    each = 2 * runner.steps
    tables = [recorded.table(start, runner.steps)[: each * recorded.periods] for start in recorded.starts[::every]]
    mean = np.mean(tables, axis=0).reshape(recorded.periods, each, -1).mean(axis=0)
    return np.ascontiguousarray(np.concatenate([mean, mean[:2]]))


def model_orbit(
    recorded: Recorded, runner: Runner, theta: np.ndarray, library: Library, orbit: Orbit, table: np.ndarray
) -> ModelOrbit | None:
    """Return the model's orbit near a measured one, by multiple shooting over forcing periods; None without one.

    `table` contains the inputs of one forcing period. Newton's method starts from the states that explain the closest
    measured cycle best, period by period.
    """
    assert orbit.cycle is not None
    count, n = orbit.period, runner.size
    phases = free_runs.START_PHASES
    measured = np.full((count * phases, len(recorded.channels)), np.nan)
    for column, name in enumerate(recorded.channels):
        if name in orbit.cycle:
            every = len(orbit.cycle[name]) // (count * phases)
            measured[:, column] = orbit.cycle[name][::every]
    states = np.array(
        [
            free_runs.explained_state(recorded, runner, theta, library, part, table)[0]
            for part in measured.reshape(count, phases, -1)
        ]
    )
    turning = _turning_states(recorded, runner)
    steps, size = free_runs.START_STEP * np.diag(library.size), library.size
    for _ in range(ORBIT_ITERATIONS):
        ends = np.array([runner.path(theta, y, table)[-1] for y in states])
        moved = np.array([[runner.path(theta, y + step, table)[-1] for step in steps] for y in states])
        slopes = ((moved - ends[:, None]) / (free_runs.START_STEP * size[:, None])).transpose(0, 2, 1)
        system = np.zeros((count, n, count, n))
        for j in range(count):
            system[j, :, j] += slopes[j]
            system[j, :, (j + 1) % count] -= np.eye(n)
        missed = ends - np.roll(states, -1, axis=0)
        missed[:, turning] = wrapped(missed[:, turning])
        if not (np.isfinite(slopes).all() and np.isfinite(missed).all()):
            return None
        step = np.linalg.lstsq(system.reshape(count * n, -1), missed.ravel(), rcond=None)[0].reshape(count, n)
        largest = float(np.abs(step / size).max())
        states = states - step * min(1.0, LARGEST_MOVE / max(largest, 1e-300))
        if largest < LAST_MOVE:
            product = np.eye(n)
            for one in slopes:
                product = one @ product
            values = np.linalg.eigvals(product)
            return ModelOrbit(
                _points(recorded, runner, theta, states, table), values[np.argsort(-np.abs(values), kind="stable")]
            )
    return None


def _turning_states(recorded: Recorded, runner: Runner) -> np.ndarray:
    """Return which of the variables of a state (size,) are angles."""
    model = runner.model
    angles = np.isin(model.states, model.angles)
    return np.append(angles, np.zeros(runner.size - angles.size, dtype=bool))


def _points(recorded: Recorded, runner: Runner, theta: np.ndarray, states: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return the section points (period, d) of an orbit from its states at whole periods (period, size)."""
    count, repeats = len(states), -(-3 // len(states))
    paths = [runner.outputs(theta, runner.path(theta, y, table), table) for y in states]
    once = np.concatenate([path[:-1] for path in paths])
    outputs = np.concatenate([once] * (2 * repeats + 1) + [paths[0][:1]])
    turning = [runner.model.outputs.index(name) for name in recorded.section.angles]
    outputs[:, turning] = np.unwrap(outputs[:, turning], axis=0)
    points = free_runs.section_points(recorded.section, runner.model, outputs, runner.steps, repeats * count)
    return points[:count]
