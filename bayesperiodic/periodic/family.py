"""Periodic equations with further scalar unknowns: a period, a parameter, the frequency, the scale of an input."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, SINGULAR, STALLED
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.sensitivity import frequency_derivatives

INPUTS, PARAMETERS = "inputs", "parameters"


class Found(NamedTuple):
    """What the bordered Newton iteration ended with."""

    z: np.ndarray
    values: np.ndarray
    code: int
    history: np.ndarray


@dataclass(frozen=True)
class Family:
    """Equations that depend on free scalars.

    Attributes
    ----------
    equations : PeriodicEquations
    parameters : array (parameters,)
    free : tuple of str
        "frequency", "inputs" or "parameters" (what multiplies `input_change` or `parameter_change`), or a parameter's
        name.
    input_change : array (points, 3·inputs)
        The inputs are those of `equations` plus a scalar times this.
    parameter_change : array (parameters,)
        The parameters are `parameters` plus a scalar times this.
    """

    equations: PeriodicEquations
    parameters: np.ndarray
    free: tuple[str, ...]
    input_change: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    parameter_change: np.ndarray = field(default_factory=lambda: np.empty(0))

    def at(self, values: np.ndarray) -> tuple[PeriodicEquations, np.ndarray]:
        """Return equations and parameters at values of the free scalars."""
        equations, parameters = self.equations, self.parameters
        for name, value in zip(self.free, values, strict=True):
            if name == FREQUENCY:
                equations = equations.at_frequency(float(value))
            elif name == INPUTS:
                equations = equations.with_inputs(equations.inputs + value * self.input_change)
            elif name == PARAMETERS:
                parameters = parameters + value * self.parameter_change
            else:
                parameters = parameters.copy()
                parameters[self.equations.model.parameters.index(name)] = value
        return equations, parameters

    def slopes(self, values: np.ndarray, z: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return ∂g/∂(free scalars), (scalars, points, states)."""
        equations, parameters = self.at(values)
        d = equations.derivatives(z, parameters)
        result = np.empty((len(self.free), *z.shape))
        for k, name in enumerate(self.free):
            if name == FREQUENCY:
                result[k] = frequency_derivatives(equations, z, columns, d)[0]
            elif name == INPUTS:
                result[k] = np.einsum("neu,nu->ne", d.g_u, self.input_change)
            elif name == PARAMETERS:
                result[k] = d.g_theta @ self.parameter_change
            else:
                result[k] = d.g_theta[:, :, equations.model.parameters.index(name)]
        return result


def solve_family(
    family: Family,
    z: np.ndarray,
    values: np.ndarray,
    rows: np.ndarray,
    corner: np.ndarray,
    targets: np.ndarray,
    value_scales: np.ndarray,
) -> Found:
    """Solve g(z, values) = 0 and rows·z + corner·values = targets by a damped Newton method with step halving.

    It stops as the compiled iteration for z alone does.

    Parameters
    ----------
    family : Family
    z : array (points, states)
    values : array (scalars,)
    rows : array (scalars, points, states)
    corner : array (scalars, scalars)
    targets : array (scalars,)
    value_scales : array (scalars,)
        Steps of the scalars are judged against these, or their size if that is larger.
    """
    kernels = family.equations.kernels
    count, previous = family.equations.count, np.inf
    history: list[tuple[float, float, float]] = []
    z, values = z.copy(), values.copy()
    equations, parameters = family.at(values)
    columns = equations.residual_jacobian(z, parameters)
    for _ in range(kernels.MAX_ITERATIONS):
        size, rounding = equations.scales(z, columns)
        before = kernels.norm(columns, size)
        if not np.isfinite(before):
            return Found(z, values, NOT_FINITE, np.array(history).reshape(-1, 3))
        missing = targets - np.einsum("rps,ps->r", rows, z) - corner @ values
        step = equations.factors(columns).solve_bordered(
            family.slopes(values, z, columns), rows, corner, -columns[None, :, :count], missing[None]
        )
        if step is None:
            return Found(z, values, SINGULAR, np.array(history).reshape(-1, 3))
        z_step, value_step = np.ascontiguousarray(step[0][0]), step[1][0]
        full = max(
            kernels.scaled_step(z, z_step), float(np.max(abs(value_step) / np.maximum(value_scales, abs(values))))
        )
        damping, accepted = 1.0, False
        for _ in range(kernels.MAX_HALVINGS):
            trial, trial_values = z + damping * z_step, values + damping * value_step
            if FREQUENCY not in family.free or trial_values[family.free.index(FREQUENCY)] > 0.0:
                equations, parameters = family.at(trial_values)
                columns = equations.residual_jacobian(trial, parameters)
                after = kernels.norm(columns, size)
                rounded = kernels.norm(columns, rounding) <= 1.0
                if after <= (1.0 - 1e-4 * damping) * before or full <= kernels.STEP_TOLERANCE or rounded:
                    accepted = True
                    break
            damping *= 0.5
        history.append((before, full, damping))
        if not accepted:
            return Found(z, values, STALLED, np.array(history))
        z, values = trial, trial_values
        if full <= kernels.STEP_TOLERANCE or (
            damping == 1.0
            and (
                rounded
                or (full < kernels.CHORD_RATE * previous < np.inf and full**2 <= kernels.STEP_TOLERANCE * previous)
            )
        ):
            return Found(z, values, CONVERGED, np.array(history))
        previous = full if damping == 1.0 else np.inf
    return Found(z, values, STALLED, np.array(history))


def solve_autonomous(family: Family, z: np.ndarray, frequency: float) -> Found:
    """Solve for an orbit of unknown frequency, its phase the one that stays closest to the guess.

    The phase condition is ∫ q_guess'·(q − q_guess) dτ = 0.
    """
    row = family.equations.phase_row(z)
    target = np.array([np.sum(row * z)])
    start = np.array([frequency])
    return solve_family(family, z, start, row[None], np.zeros((1, 1)), target, start)
