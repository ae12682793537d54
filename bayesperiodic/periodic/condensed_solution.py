"""Periodic solutions of condensed models, and their Floquet multipliers in a basis of modes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.periodic.condensed import CondensedEquations, Forces, harmonics, on_grid, receptance, resized
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, Solved
from bayesperiodic.periodic.floquet import Floquet
from bayesperiodic.periodic.index_one import orbit_floquet
from bayesperiodic.periodic.solution import NEWTON, PeriodicSolution, by_name, describe

# Lowest modes in which the linearised equations are integrated; half of them give the error.
MODES = 16


@dataclass(frozen=True, repr=False)
class CondensedSolution(PeriodicSolution):
    """A periodic solution of a condensed model, see `Model.from_matrices`; a `PeriodicSolution` but for the following.

    Attributes
    ----------
    linearisation : array (points, modes, 3·modes)
        The linearised equations on the orbit in the lowest modes, at most 16, at the points of the elements' grid. The
        elements bend the other modes too, statically.
    fewer_modes : array (points, modes, 3·modes)
        The same in half of these modes, for `multiplier_error`; empty if there are as many modes as degrees of freedom.
    changes : dict of str to float
        See `error_estimate`.
    """

    fewer_modes: np.ndarray
    changes: dict[str, float]

    @cached_property
    def _linearised(self) -> Floquet | str:
        if not self.converged:
            return f"the solve ended with the status {self.status!r}"
        return self._floquet(self.linearisation)

    def _floquet(self, linearisation: np.ndarray) -> Floquet | str:
        modes = linearisation.shape[1]
        return orbit_floquet(linearisation, (2,) * modes, in_units(modes, self.period)[0], self.period)

    @cached_property
    def multiplier_error(self) -> float:
        """Estimated error of the largest multiplier's modulus: its change if half of the modes are left out."""
        if not self.converged or not self.fewer_modes.size:
            return 0.0
        fewer = self._floquet(self.fewer_modes)
        if isinstance(fewer, str) or self.floquet is None:
            return np.inf
        return float(abs(np.exp(fewer.exponents[0].real) - np.exp(self.floquet.exponents[0].real)))

    @cached_property
    def stability_unknown(self) -> str:
        """Why the stability is unknown; empty if it is known."""
        if isinstance(self._linearised, str):
            return self._linearised
        largest = float(np.exp(self._linearised.exponents[0].real))
        if abs(largest - 1.0) <= self.multiplier_error:
            return f"the largest multiplier has the modulus {largest:.3g}, with an error of {self.multiplier_error:.1g}"
        return ""

    def error_estimate(self) -> dict[str, float]:
        """Return the largest change of each state if the elements' forces are evaluated at half of the points.

        The error is smaller than that where the response is resolved.
        """
        return dict(self.changes)


def described(
    equations: PeriodicEquations, theta: np.ndarray, solved: Solved, found_by: str = NEWTON, sensitivities: bool = True
) -> PeriodicSolution:
    """Return the result of a solve, condensed or not, as `solution.describe` does."""
    if not isinstance(equations, CondensedEquations):
        return describe(equations, theta, solved, found_by, sensitivities)
    model, grid, code, z = equations.model, equations.grid, solved.code, solved.z
    every, names = equations.of_all_states, (*model.parameters, FREQUENCY)
    of_outputs, of_states = {}, {}
    if code == CONVERGED and sensitivities:
        parts = [e.parameter_sensitivities(z, theta) for e in (equations, every)]
        if parts[0] is None or parts[1] is None:
            code = SINGULAR
        else:
            of_outputs = by_name(parts[0].outputs, model.outputs, names)
            of_states = by_name(parts[1].outputs, model.states, names)
    states, outputs = every.outputs(z, theta), equations.outputs(z, theta)
    coarse = on_grid(resized(harmonics(z), len(z) // 2), len(z) // 2)
    changes = np.abs(every.outputs(coarse, theta) - states).max(axis=0).tolist()
    several, fewer = np.empty((0, 0, 0)), np.empty((0, 0, 0))
    if code == CONVERGED:
        modes = normalised_modes(equations, theta)
        several = linearised_modes(equations, theta, z, modes)
        if modes.shape[1] < len(model.states):
            fewer = linearised_modes(equations, theta, z, modes[:, : MODES // 2])
    return CondensedSolution(
        model=model.name,
        autonomous=False,
        status=STATUSES[code],
        found_by=found_by,
        frequency=equations.frequency,
        samples=grid.samples,
        periods=grid.periods,
        winding={},
        scheme=grid.scheme,
        parameters=dict(zip(model.parameters, theta.tolist(), strict=True)),
        orders=model.orders,
        tau=grid.tau,
        states={name: states[:, i].copy() for i, name in enumerate(model.states)},
        inputs={name: equations.inputs[:, i].copy() for i, name in enumerate(model.inputs)},
        outputs={name: outputs[:, i].copy() for i, name in enumerate(model.outputs)},
        sensitivities=of_outputs,
        state_sensitivities=of_states,
        frequency_sensitivities=dict.fromkeys(model.parameters, 0.0) if of_outputs else {},
        linearisation=several,
        twice_the_points=np.empty((0, 0)),
        iterations=len(solved.history),
        residual=equations.scaled_residual(z, theta),
        history=solved.history,
        fewer_modes=fewer,
        changes=dict(zip(model.states, changes if code == CONVERGED else [np.nan] * len(changes), strict=True)),
    )


def normalised_modes(equations: CondensedEquations, theta: np.ndarray) -> np.ndarray:
    """Return the lowest undamped modes (n, modes) of unit modal mass."""
    linear = receptance(equations.model)
    modes = linear.lowest_modes(theta, MODES)
    return modes / np.sqrt(np.sum(modes * (linear.sums(theta)[0] @ modes), axis=0))


def in_units(modes: int, period: float) -> np.ndarray:
    """Return the factors (2·modes, 2·modes) of a first-order matrix for rates in units of 2π/period."""
    sizes = np.repeat([1.0, 2 * np.pi / period], modes)
    return sizes / sizes[:, None]


def linearised_modes(
    equations: CondensedEquations, theta: np.ndarray, z: np.ndarray, modes: np.ndarray
) -> np.ndarray:
    """Return ∂g/∂(q, q̇, q̈) (points, modes, 3·modes) in the coordinates q of the lowest modes (n, modes).

    The other modes follow the forces of the elements statically, which makes these springs in series.
    """
    places, sums = equations.model.structure.weights, receptance(equations.model).sums(theta)
    mass, damping, stiffness = (modes.T @ matrix @ modes for matrix in sums)
    at = places @ modes
    compliance = places @ np.linalg.solve(sums[2], places.T) - at @ np.linalg.solve(stiffness, at.T)
    forces: Forces = equations.forces(harmonics(z), theta)[0]
    springs, dampers = (part[..., None] * np.eye(len(at)) for part in forces[1:])
    series = np.linalg.inv(np.eye(len(at)) + springs @ compliance)
    springs, dampers = series @ springs, series @ dampers @ series.transpose(0, 2, 1)
    parts = [stiffness + at.T @ springs @ at, damping + at.T @ dampers @ at]
    inertia = np.broadcast_to(mass, parts[0].shape)
    return np.ascontiguousarray(np.concatenate([*parts, inertia], axis=2))
