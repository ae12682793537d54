"""A periodic orbit of a section as an experiment: section points, unstable eigenvalues, or the whole measured cycle."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic import checks, fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.orbits.seeds import counted_turns, resampled_cycle

if TYPE_CHECKING:
    from bayesperiodic.orbits.orbit import Orbit

MOST_BIAS = 0.5


def orbit_experiment(
    orbit: Orbit, *, samples: int, multipliers: bool, whole: bool, states: Mapping[str, str] | None
) -> Experiment:
    """Return an orbit as an experiment; see `Orbit.experiment`."""
    checks.integer("samples", samples, 4)
    winding = counted_turns(orbit) if orbit.solution is None else sum(orbit.solution.winding.values())
    if winding is None:
        raise ValueError(f"winding: that of {orbit.name!r} is not known; polish the orbit with a model first.")
    points = samples * orbit.period
    covariance: np.ndarray | None = None
    if whole:
        outputs, mask = _whole(orbit, samples)
    else:
        covariance, mask = orbit.covariance, np.arange(points) % samples == 0
        outputs = {name: np.zeros(points) for name in orbit.coordinates}
        for name, values in zip(orbit.coordinates, orbit.points.T, strict=True):
            outputs[name][mask] = values
    experiment = Experiment(
        orbit.name,
        orbit.frequency,
        outputs,
        _inputs(orbit, points),
        samples=samples,
        periods=orbit.period,
        winding=winding if orbit.solution is None else orbit.solution.winding,
        mask=mask,
        covariance=covariance,
        guess=_guess(orbit, samples, winding, states),
        synthetic=orbit.synthetic,
    )
    return _with_multipliers(orbit, experiment) if multipliers else experiment


def _with_multipliers(orbit: Orbit, experiment: Experiment) -> Experiment:
    """Return the experiment with the unstable eigenvalues that are data, and their covariance with the points."""
    size = orbit.points.size
    sd = np.sqrt(np.diag(orbit.joint_covariance)[size:])
    with np.errstate(invalid="ignore"):
        known = np.isfinite(sd) & (np.abs(orbit.eigenvalue_bias) <= MOST_BIAS * sd) & np.isreal(orbit.eigenvalues)
    unstable = np.abs(orbit.eigenvalues) > 1.0
    kept, left = np.flatnonzero(unstable & known), np.flatnonzero(unstable & ~known)
    if left.size:
        why = "complex" if np.iscomplex(orbit.eigenvalues[left[0]]) else "not estimated, or biased by more than sd/2"
        warnings.warn(
            f"The eigenvalue {orbit.eigenvalues[left[0]]:.4g} of {orbit.name!r} is left out; it is {why}.",
            UserWarning,
            stacklevel=4,
        )
        # Multipliers are compared largest first, so none may be used below one that is left out.
        kept = kept[kept < left[0]]
    if not kept.size:
        return experiment
    values = orbit.eigenvalues[kept].real
    if experiment.covariance is None:
        return replace(experiment, multipliers=values, multiplier_sd=sd[kept])
    rows = np.concatenate([np.arange(size), size + kept])
    return replace(experiment, multipliers=values, covariance=orbit.joint_covariance[np.ix_(rows, rows)])


def _whole(orbit: Orbit, samples: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the measured cycle on the grid, and the points at which it was measured."""
    if orbit.cycle is None:
        raise ValueError(f"whole: True is not allowed; {orbit.name!r} has no measured cycle, so leave it out.")
    measured = len(orbit.cycle[orbit.coordinates[0]]) // orbit.period
    if samples % measured:
        raise ValueError(
            f"samples: {samples} is not allowed; the cycle has {measured} a forcing period, so take a multiple of it."
        )
    every, points = samples // measured, samples * orbit.period
    outputs = {name: np.zeros(points) for name in orbit.coordinates}
    for name in orbit.coordinates:
        outputs[name][::every] = orbit.cycle[name]
    return outputs, np.arange(points) % every == 0


def _inputs(orbit: Orbit, points: int) -> dict[str, np.ndarray]:
    if orbit.solution is None:
        return {}
    return {name: _on_grid(values, points) for name, values in orbit.solution.inputs.items()}


def _on_grid(values: np.ndarray, points: int) -> np.ndarray:
    return values if values.size == points else fourier.on_grid(fourier.coefficients(values), points)


def _guess(orbit: Orbit, samples: int, winding: int, states: Mapping[str, str] | None) -> dict[str, np.ndarray]:
    """Return the states from which the first solve starts: of the solution, or named coordinates of the cycle."""
    if states is not None:
        if orbit.cycle is None:
            raise ValueError(
                f"states: they are not allowed; {orbit.name!r} has no measured cycle. Polish it with a model first."
            )
        cycle = resampled_cycle(orbit, winding, samples)
        for name in states.values():
            checks.one_of("states", name, orbit.coordinates)
        return {state: cycle[:, orbit.coordinates.index(name)] for state, name in states.items()}
    solution = orbit.solution
    if solution is None:
        raise ValueError(
            f"states: they are needed; {orbit.name!r} is not polished, so tell which coordinate is which state of the "
            "model, such as states={'phi': 'angle'}."
        )
    tau = np.arange(samples * orbit.period) / samples
    guess = {}
    for name, values in solution.states.items():
        turns = 2 * np.pi * solution.winding.get(name, 0) / solution.periods
        guess[name] = _on_grid(values - turns * solution.tau, tau.size) + turns * tau
    return guess
