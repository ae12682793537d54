"""Periodic solutions of condensed models, and their Floquet multipliers in a basis of modes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from bayesperiodic._linalg import unwarned
from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.periodic.condensed import CondensedEquations, receptance
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, Solved
from bayesperiodic.periodic.harmonics import harmonics, resized
from bayesperiodic.periodic.receptance import compiled
from bayesperiodic.periodic.solution import NEWTON, PeriodicSolution, by_name, describe

# Lowest modes in which the linearised equations are solved; half of them give the error, with these steps in time.
MOST_MODES, MODE_ERROR_STEPS = 16, 128
# Steps in time, and relative change of the largest modulus by twice as many, below which these are enough; with many
# steps, also that in units of the distance from the unit circle.
FEWEST_MODAL_STEPS, MANY_MODAL_STEPS, MOST_MODAL_STEPS, MODAL_ERROR, CLEAR_OF_CIRCLE = 64, 1024, 4096, 1e-8, 1e-3
# Points at which the linearised equations of internal states are evaluated, one after the other, and points a step.
POINTS_OF_MEMORY, POINTS_A_STEP = (4096, 8192, 16384), 8
LEAST_STEP_TURN = 1e-7  # of an undamped mode in a step, below which the formula of a critically damped one is taken


@dataclass(frozen=True, repr=False)
class CondensedSolution(PeriodicSolution):
    """A periodic solution of a condensed model, see `Model.from_matrices`.

    It is a `bayesperiodic.PeriodicSolution` but for the following. The stability is unknown where the error of the
    largest multiplier leaves the side of the unit circle open.

    Attributes
    ----------
    linearisation, twice_the_points : array
        Empty.
    of_modes : complex array (2·modes + internal states of elements,)
        The multipliers, those of the 16 lowest modes at most; the elements bend the other modes statically. Those below
        about 1e-12 are rounding errors. None unless converged.
    multiplier_error : float
        Estimated error of the largest modulus: its change with half of the steps in time (with internal states of
        elements, the largest of two such changes), and with half of the modes.
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
        """Floquet multipliers over the response period, complex as `of_modes`, largest modulus first."""
        return self.of_modes

    @property
    def exponents(self) -> np.ndarray:
        """Floquet exponents log(multiplier)/period [1/s], complex as `of_modes`."""
        return self._others / self.period

    @property
    def _others(self) -> np.ndarray:
        return np.log(np.where(self.of_modes == 0.0, np.finfo(float).tiny, self.of_modes))

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


@unwarned
def described(
    equations: PeriodicEquations,
    theta: np.ndarray,
    solved: Solved,
    found_by: str = NEWTON,
    sensitivities: bool = True,
    multipliers: bool = True,
) -> PeriodicSolution:
    """Return the result of a solve, condensed or not, as `solution.describe` does.

    Without `multipliers` those of a condensed one, which take most of the time, are left out.
    """
    if not isinstance(equations, CondensedEquations):
        return describe(equations, theta, solved, found_by, sensitivities)
    model, grid, code, z = equations.model, equations.grid, solved.code, solved.z
    names = (*model.parameters, FREQUENCY)
    of_outputs, of_states = {}, {}
    if code == CONVERGED and sensitivities:
        parts = [e.parameter_sensitivities(z, theta) for e in (equations, equations.of_all_states)]
        if parts[0] is None or parts[1] is None:
            code = SINGULAR
        else:
            of_outputs = by_name(parts[0].outputs, model.outputs, names)
            of_states = by_name(parts[1].outputs, model.states, names)
    outputs, residual = equations.outputs_and_residual(z, theta)
    states, coarse = equations.displacements(z, theta)
    changes = np.abs(coarse - states).max(axis=0).tolist()
    of_modes, error = np.empty(0, complex), np.nan
    if code == CONVERGED and multipliers:
        of_modes, error = modal_multipliers(equations, theta, z)
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
        residual=residual,
        history=solved.history,
        of_modes=of_modes,
        multiplier_error=error,
        changes=dict(zip(model.states, changes if code == CONVERGED else [np.nan] * len(changes), strict=True)),
    )


def modal_multipliers(
    equations: CondensedEquations, theta: np.ndarray, z: np.ndarray, *, error: bool = True
) -> tuple[np.ndarray, float]:
    """Return the Floquet multipliers in the lowest modes, largest first, and the error of the largest modulus.

    Without `error` what only estimates it is left out, and it is NaN.

    The maps over the period with steps h, h/2, h/4, … are extrapolated in even powers of h ([1]_) until the largest
    modulus does not change any more. With internal states of elements, which have kinks, they are not extrapolated.
    They are NaN, with an infinite error, where the map overflows.

    References
    ----------
    .. [1] W. B. Gragg, On extrapolation algorithms for ordinary initial value problems, SIAM Journal on Numerical
       Analysis 2 (1965) 384-403.
    """
    motion = _Linearised(equations, theta, harmonics(z), MOST_MODES)
    try:
        values, size = _of_memory(motion, error) if equations.model.state_owners else _extrapolated(motion)
    except np.linalg.LinAlgError:  # of a map that overflows
        return np.full(2 * len(motion.modes.stiffness), np.nan, dtype=complex), np.inf
    if error and len(motion.modes.stiffness) < len(equations.model.states):
        fewer = _Linearised(equations, theta, harmonics(z), MOST_MODES // 2)
        of_fewer, of_all = (np.abs(np.linalg.eigvals(m.monodromy(MODE_ERROR_STEPS))).max() for m in (fewer, motion))
        size += abs(float(of_fewer - of_all))
    return values[np.argsort(-np.abs(values), kind="stable")], size if error else np.nan


def _extrapolated(motion: _Linearised) -> tuple[np.ndarray, float]:
    """Return the multipliers for steps that become small, and the error of the largest modulus."""
    steps, row, largest = FEWEST_MODAL_STEPS, [motion.monodromy(FEWEST_MODAL_STEPS)], []
    while True:
        values = np.linalg.eigvals(row[-1]).astype(complex)
        largest.append(float(np.abs(values).max()))
        error = abs(largest[-1] - largest[-2]) if len(largest) > 1 else np.inf
        clear = CLEAR_OF_CIRCLE * abs(largest[-1] - 1.0) if steps >= MANY_MODAL_STEPS else 0.0
        if steps >= MOST_MODAL_STEPS or (len(row) > 2 and error <= max(clear, MODAL_ERROR * largest[-1])):
            return values, error
        steps, before, row = 2 * steps, row, [motion.monodromy(2 * steps)]
        for order, coarse in enumerate(before, start=1):
            row.append(row[-1] + (row[-1] - coarse) / (4.0**order - 1.0))


def _of_memory(motion: _Linearised, error: bool) -> tuple[np.ndarray, float]:
    """Return the multipliers with internal states, and the error of the largest modulus.

    Elements begin to slide and reverse between two points: the error is of order one and irregular in their number,
    and the larger of the last two changes estimates it.
    """
    largest = []
    for points in POINTS_OF_MEMORY if error else POINTS_OF_MEMORY[-1:]:
        values = np.linalg.eigvals(motion.monodromy(points // POINTS_A_STEP, points)).astype(complex)
        largest.append(float(np.abs(values).max()))
    return values, float(np.abs(np.diff(largest)).max(initial=0.0))


class _Linearised:
    """Linearised equations of a solution of harmonics d in the coordinates of the lowest modes."""

    def __init__(self, equations: CondensedEquations, theta: np.ndarray, d: np.ndarray, count: int):
        self._equations, self._theta, self._d = equations, theta, d
        self.modes = modes = receptance(equations.model).lowest(theta, count, equations.model.structure.weights)
        self._period, size = equations.grid.periods / equations.frequency, len(modes.stiffness)
        (elements, _), zero = modes.at.shape, np.zeros_like(modes.at)
        self._places = np.block([[modes.at, zero], [zero, modes.at]])
        self._forcing = np.ascontiguousarray(np.concatenate([zero, modes.at], axis=1).T)
        self._diagonal = not any((a - np.diag(np.diag(a))).any() for a in (modes.stiffness, modes.damping))
        self._size, self._elements = size, elements
        self._inner = len(equations.model.state_owners)
        self._known: tuple[np.ndarray, ...] = ()

    def _couplings(self, points: int) -> tuple[np.ndarray, ...]:
        """Return springs and dampers of the elements in series with the other modes, (points, elements, elements).

        With internal states w, also the derivatives of the forces by w, and those of the rates of w by displacements,
        velocities and w.
        """
        unit, forces = np.eye(self._elements), self._equations.forces(resized(self._d, points), self._theta)
        springs, dampers = (part[..., None] * unit for part in forces[1:3])
        flexible, series = self.modes.compliance, np.broadcast_to(unit, springs.shape)
        if flexible.any():
            series = np.linalg.inv(unit + springs @ flexible)
            springs, dampers = series @ springs, series @ dampers @ series.transpose(0, 2, 1)
        if forces.memory is None:
            return springs, dampers
        slopes, count = forces.memory.slopes, self._elements
        of_states = series @ slopes[:, :count, 0, count:]
        by_d, by_v = slopes[:, count:, 0, :count], slopes[:, count:, 1, :count]
        # The other modes take part of displacements and velocities; changes of `series` in time are neglected.
        left = unit - flexible @ springs
        inside = slopes[:, count:, 0, count:] - by_d @ flexible @ of_states
        relaxed = np.linalg.inv(np.eye(self._inner) + by_v @ flexible @ of_states)
        return springs, dampers, of_states, relaxed @ by_d @ left, relaxed @ by_v @ left, relaxed @ inside

    def _free(self, length: float) -> np.ndarray:
        """Return the motion without elements over a time."""
        stiffness, damping = self.modes.stiffness, self.modes.damping
        if not self._diagonal:
            zero, one = np.zeros_like(stiffness), np.eye(self._size)
            return np.asarray(scipy.linalg.expm(length * np.block([[zero, one], [-stiffness, -damping]])))
        decay, squares = 0.5 * np.diag(damping), np.diag(stiffness)
        turn = np.sqrt((squares - decay**2).astype(complex))
        turn = np.where(np.abs(turn) * length < LEAST_STEP_TURN, LEAST_STEP_TURN / length, turn)
        forth, back = np.exp((-decay + 1j * turn) * length), np.exp((-decay - 1j * turn) * length)
        even, odd = (0.5 * (forth + back)).real, ((forth - back) / (2j * turn)).real
        result, q = np.zeros((2 * self._size, 2 * self._size)), np.arange(self._size)
        v = q + self._size
        result[q, q], result[q, v] = even + decay * odd, odd
        result[v, q], result[v, v] = -squares * odd, even - decay * odd
        return result

    def monodromy(self, steps: int, points: int = 0) -> np.ndarray:
        """Return the map of (q, q̇) and internal states over the period in steps, of second order.

        The elements are evaluated at these points, by default at those of the solution, or the steps if more.

        Each step is the exact motion of the linear structure between two points, at which the elements act for half of
        the step ([1]_), with their mean over it.

        References
        ----------
        .. [1] G. Strang, On the construction and comparison of difference schemes, SIAM Journal on Numerical Analysis 5
           (1968) 506-517.
        """
        points = points or max(steps, 2 * len(self._d), MODE_ERROR_STEPS)
        if not self._known or points != len(self._known[0]):
            self._known = self._couplings(points)
        length, means = self._period / steps, [_means(part, steps) for part in self._known]
        result = np.eye(2 * self._size + self._inner)
        kicks = self._kicks_of_states(length, *means) if self._inner else self._kicks(length, *means)
        free = self._free(length)
        compiled().monodromy(free, self._diagonal, self._places, self._forcing, kicks, result)
        return result

    def _kicks(self, length: float, springs: np.ndarray, dampers: np.ndarray) -> np.ndarray:
        """Return the impulses of the elements in steps, by their displacements and velocities."""
        # The middle rule of velocities; two halves of a step make the kick of a whole one.
        halves = 0.5 * length * np.concatenate([springs, dampers], axis=2)
        kicks = 2.0 * halves
        if dampers.any():
            unit = np.eye(self._elements)
            halves = np.linalg.solve(unit + 0.25 * length * dampers @ (self.modes.at @ self.modes.at.T), halves)
            kicks = 2.0 * halves - halves @ (self._places @ self._forcing) @ halves
        kicks[0] = halves[0]
        return kicks

    def _kicks_of_states(
        self,
        length: float,
        springs: np.ndarray,
        dampers: np.ndarray,
        of_states: np.ndarray,
        by_d: np.ndarray,
        by_v: np.ndarray,
        by_states: np.ndarray,
    ) -> np.ndarray:
        """Return impulses and internal states w after steps, by displacements, velocities and w; see `_couplings`."""
        count, inner = self._elements, self._inner
        forces = np.concatenate([springs, dampers, of_states], axis=2)
        rates = np.concatenate([by_d, by_v, by_states], axis=2)
        # Velocities and w change by the middle rule in half of a step, displacements being held.
        change = np.concatenate([-(self.modes.at @ self.modes.at.T) @ forces, rates], axis=1)
        unit, still = np.eye(2 * count + inner), np.zeros((len(forces), count, 2 * count + inner))
        change = np.concatenate([still, change], axis=1)
        middle = np.linalg.inv(unit - 0.25 * length * change)
        half = middle @ (unit + 0.25 * length * change)
        impulses = 0.5 * length * forces @ middle
        kicks = np.concatenate([impulses + impulses @ half, (half @ half)[:, 2 * count :]], axis=1)
        kicks[0] = np.concatenate([impulses[0], half[0, 2 * count :]])
        return np.ascontiguousarray(kicks)


def _means(values: np.ndarray, count: int) -> np.ndarray:
    """Return the means (count, …) of periodic values (points, …) around fewer points, a power of two both."""
    every = len(values) // count
    if every == 1:
        return values
    sums = [np.roll(values, every // 2 - shift, axis=0).reshape(count, every, -1).mean(axis=1) for shift in (0, 1)]
    return 0.5 * (sums[0] + sums[1]).reshape(count, *values.shape[1:])
