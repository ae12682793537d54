"""Periodic solutions of condensed models, and their Floquet multipliers in a basis of modes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.periodic.condensed import CondensedEquations, Forces, harmonics, on_grid, receptance, resized
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, Solved
from bayesperiodic.periodic.solution import NEWTON, PeriodicSolution, by_name, describe

# Lowest modes in which the linearised equations are solved; half of them give the error.
MOST_MODES, MOST_MODAL_STEPS = 16, 1024


@dataclass(frozen=True, repr=False)
class CondensedSolution(PeriodicSolution):
    """A periodic solution of a condensed model, see `Model.from_matrices`; a `PeriodicSolution` but for the following.

    Attributes
    ----------
    linearisation, twice_the_points : array
        Empty.
    of_modes : complex array (2·modes,)
        The multipliers, those of the 16 lowest modes at most; the elements bend the other modes statically. Those below
        about 1e-12 are rounding errors. None unless converged.
    multiplier_error : float
        Estimated error of the largest modulus: its change with half of the steps in time, and of the modes.
    changes : dict of str to float
        See `error_estimate`.
    """

    of_modes: np.ndarray
    multiplier_error: float
    changes: dict[str, float]

    @property
    def floquet(self) -> None:
        """None: there are no eigenfunctions."""
        return None

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers over the response period, complex (2·modes,), largest modulus first."""
        return self.of_modes

    @property
    def exponents(self) -> np.ndarray:
        """Floquet exponents log(multiplier)/period [1/s], complex (2·modes,)."""
        return self._others / self.period

    @property
    def _others(self) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return np.log(self.of_modes)

    @cached_property
    def stability_unknown(self) -> str:
        """Why the stability is unknown; empty if it is known."""
        if not self.converged:
            return f"the solve ended with the status {self.status!r}"
        largest = float(np.abs(self.of_modes[0]))
        if not abs(largest - 1.0) > self.multiplier_error:
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
    multipliers, error = modal_multipliers(equations, theta, z) if code == CONVERGED else (np.empty(0, complex), np.nan)
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
        linearisation=np.empty((0, 0, 0)),
        twice_the_points=np.empty((0, 0)),
        iterations=len(solved.history),
        residual=equations.scaled_residual(z, theta),
        history=solved.history,
        of_modes=multipliers,
        multiplier_error=error,
        changes=dict(zip(model.states, changes if code == CONVERGED else [np.nan] * len(changes), strict=True)),
    )


class _ModalEquations(NamedTuple):
    """Linearised equations in the coordinates of the lowest modes, of unit modal mass."""

    stiffness: np.ndarray  # (modes, modes)
    damping: np.ndarray
    at: np.ndarray  # (elements, modes), displacements of the elements
    compliance: np.ndarray  # (elements, elements), static one of the other modes

    def monodromy(self, forces: Forces, period: float) -> np.ndarray:
        """Return the map of (q, q̇) over the period, of as many steps as the forces have points.

        Each step is the exact motion of the linear structure between two points, at which the elements act for half of
        the step ([1]_). The error is of second order.

        References
        ----------
        .. [1] G. Strang, On the construction and comparison of difference schemes, SIAM Journal on Numerical Analysis 5
           (1968) 506-517.
        """
        modes, (steps, elements) = len(self.stiffness), forces.values.shape
        length, unit = period / steps, np.eye(elements)
        springs, dampers = (part[..., None] * unit for part in forces[1:])
        series = np.linalg.inv(unit + springs @ self.compliance)
        springs, dampers = series @ springs, series @ dampers @ series.transpose(0, 2, 1)
        # ∫ exp(−s D G) ds over half a step, D the dampers, G = at·atᵀ, is a block of a larger matrix's exponential.
        larger = np.zeros((steps, 2 * elements, 2 * elements))
        larger[:, :elements, :elements] = -0.5 * length * dampers @ (self.at @ self.at.T)
        larger[:, :elements, elements:] = 0.5 * length * unit
        acting = scipy.linalg.expm(larger)[:, :elements, elements:] if elements else springs
        kicks = np.tile(np.eye(2 * modes), (steps, 1, 1))
        kicks[:, modes:, :modes] -= self.at.T @ acting @ springs @ self.at
        kicks[:, modes:, modes:] -= self.at.T @ acting @ dampers @ self.at
        zero = np.zeros((modes, modes))
        free = np.block([[zero, np.eye(modes)], [-self.stiffness, -self.damping]])
        products = np.roll(kicks, -1, axis=0) @ scipy.linalg.expm(length * free) @ kicks
        while len(products) > 1:  # the number of points is a power of two
            products = products[1::2] @ products[::2]
        return np.asarray(products[0])


def _modal_equations(equations: CondensedEquations, theta: np.ndarray, count: int) -> _ModalEquations:
    linear, places = receptance(equations.model), equations.model.structure.weights
    modes, (mass, damping, stiffness) = linear.lowest_modes(theta, count), linear.sums(theta)
    modes = modes / np.sqrt(np.sum(modes * (mass @ modes), axis=0))
    inverse = np.linalg.inv(modes.T @ mass @ modes)
    at, within = places @ modes, modes.T @ stiffness @ modes
    compliance = places @ np.linalg.solve(stiffness, places.T) - at @ np.linalg.solve(within, at.T)
    return _ModalEquations(inverse @ within, inverse @ modes.T @ damping @ modes, at, compliance)


def modal_multipliers(equations: CondensedEquations, theta: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the Floquet multipliers in the lowest modes, largest first, and the error of the largest modulus."""
    period, d = equations.grid.periods / equations.frequency, harmonics(z)
    several = _modal_equations(equations, theta, MOST_MODES)
    fastest = float(np.sqrt(np.abs(np.linalg.eigvals(several.stiffness)).max()))
    steps = max(len(z), min(MOST_MODAL_STEPS, 1 << int(np.ceil(np.log2(max(1.0, period * fastest))))))
    grids = [equations.forces(resized(d, every * steps), theta)[0] for every in (1, 2, 4)]
    one, two, four = (several.monodromy(forces, period) for forces in grids)
    # Richardson's extrapolation of even powers of the step.
    coarse, fine = (two + (two - one) / 3.0, four + (four - two) / 3.0)
    values = np.linalg.eigvals(fine + (fine - coarse) / 15.0).astype(complex)
    values = values[np.argsort(-np.abs(values), kind="stable")]
    largest = float(np.abs(values[0]))
    error = abs(largest - float(np.abs(np.linalg.eigvals(fine)).max()))
    if len(several.stiffness) < len(equations.model.states):
        fewer = _modal_equations(equations, theta, MOST_MODES // 2)
        error += abs(
            float(np.abs(np.linalg.eigvals(fewer.monodromy(grids[2], period))).max())
            - float(np.abs(np.linalg.eigvals(four)).max())
        )
    return values, error
