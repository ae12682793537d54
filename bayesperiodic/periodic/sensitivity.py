"""Derivatives of a periodic state by the implicit function theorem (de Kraker et al. 1997, eq. 4)."""

from typing import NamedTuple

import numpy as np

from bayesperiodic.periodic.equations import Derivatives, PeriodicEquations

SWEEPS = 3
SMALL = 1e-4


class Sensitivities(NamedTuple):
    """Derivatives along several directions, on the grid.

    Attributes
    ----------
    states : array (directions, points, states)
    outputs : array (directions, points, channels)
    frequency : array (directions,)
        Of the solution's frequency [Hz per unit]; zero for a driven model.
    """

    states: np.ndarray
    outputs: np.ndarray
    frequency: np.ndarray


def directional_sensitivities(
    equations: PeriodicEquations, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray
) -> Sensitivities | None:
    """Return derivatives along directions (directions, parameters) of the parameters; None if singular."""
    d, columns = equations.derivatives(z, parameters), equations.residual_jacobian(z, parameters)
    g, f = np.einsum("nep,dp->dne", d.g_theta, directions), np.einsum("ncp,dp->dnc", d.f_theta, directions)
    return respond(equations, z, columns, d, g, f)


def parameter_sensitivities(
    equations: PeriodicEquations, z: np.ndarray, parameters: np.ndarray
) -> Sensitivities | None:
    """Return derivatives to every parameter and, for a driven model, last to the frequency; None if singular.

    For an autonomous model the change of the orbit is orthogonal to the flow, states in units of their range.
    """
    d, columns = equations.derivatives(z, parameters), equations.residual_jacobian(z, parameters)
    g, f = np.moveaxis(d.g_theta, 2, 0), np.moveaxis(d.f_theta, 2, 0)
    if not equations.model.autonomous:
        g_frequency, f_frequency = frequency_derivatives(equations, z, columns, d)
        g, f = np.concatenate([g, g_frequency[None]]), np.concatenate([f, f_frequency[None]])
    return respond(equations, z, columns, d, g, f)


def input_sensitivities(
    equations: PeriodicEquations, z: np.ndarray, parameters: np.ndarray, directions: np.ndarray
) -> Sensitivities | None:
    """Return derivatives along perturbations (directions, points, 3·inputs) of (u, u̇, ü); None if singular."""
    d, columns = equations.derivatives(z, parameters), equations.residual_jacobian(z, parameters)
    g = np.einsum("neu,dnu->dne", d.g_u, directions)
    f = np.einsum("ncu,dnu->dnc", d.f_u, directions)
    return respond(equations, z, columns, d, g, f)


def frequency_derivatives(
    equations: PeriodicEquations, z: np.ndarray, columns: np.ndarray, d: Derivatives
) -> tuple[np.ndarray, np.ndarray]:
    """Return dg/dfrequency (points, states) and df/dfrequency (points, channels), z and inputs held in tau."""
    states, inputs = equations.frequency_changes(z)
    _, g_u, g_frequency, f_q, _, f_u, f_frequency = d
    g_q = columns[:, equations.count :].reshape(len(z), equations.count, -1)
    g = g_frequency[:, :, 0] + np.einsum("neq,nq->ne", g_q, states) + np.einsum("neu,nu->ne", g_u, inputs)
    f = f_frequency[:, :, 0] + np.einsum("ncq,nq->nc", f_q, states) + np.einsum("ncu,nu->nc", f_u, inputs)
    return g, f


def respond(
    equations: PeriodicEquations, z: np.ndarray, columns: np.ndarray, d: Derivatives, g: np.ndarray, f: np.ndarray
) -> Sensitivities | None:
    """Return the response to changes of g (directions, points, states) and f (directions, points, channels)."""
    if equations.model.autonomous:
        g_frequency, f_frequency = frequency_derivatives(equations, z, columns, d)
        factors = equations.bordered(columns, g_frequency[None], equations.phase_row(z)[None])
        solved = factors.solve_bordered(-g, np.zeros((len(g), 1)))
        if solved is None:
            return None
        z_change, frequency = solved[0], solved[1][:, 0]
        f = f + frequency[:, None, None] * f_frequency
    else:
        regular = equations.factors(columns)
        if not regular.regular:
            return None
        z_change, frequency = regular.solve(-g), np.zeros(len(g))
    return Sensitivities(z_change, f + np.einsum("ncq,dnq->dnc", d.f_q, equations.changes(z_change)), frequency)


def smallest_singular_vectors(
    equations: PeriodicEquations, z: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return approximate singular vectors of the smallest singular value of a regular ∂g/∂z, by inverse iteration.

    States are in units of their largest values, equations in those of their largest terms.

    Returns
    -------
    left : array (points, states)
        Over the equations.
    right : array (points, 3·states)
        The change of the states and of their time derivatives, scaled so that left · (∂g/∂z) · change is 1.
    """
    factors, amplitude = equations.factors(columns), np.abs(z).max(axis=0)
    size, _ = equations.scales(z, columns)
    units, terms = np.where(amplitude > 0, amplitude, 1.0), np.where(size > 0, size, 1.0)
    right = np.broadcast_to(units, z.shape)
    for _ in range(SWEEPS):
        left = factors.solve_transposed(right / units**2) * terms**2
        left /= np.linalg.norm(left / terms)
        right = factors.solve(left)
        right /= np.linalg.norm(right / units)
    left = left / terms**2
    change = equations.changes(right[None])[0]
    g_q = columns[:, equations.count :].reshape(len(z), equations.count, -1)
    return left / np.einsum("ne,neq,nq->", left, g_q, change), change


def stiffness_gradient(
    equations: PeriodicEquations,
    z: np.ndarray,
    parameters: np.ndarray,
    sensitivities: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
) -> np.ndarray:
    """Return the derivatives (parameters,) of left · (∂g/∂z) · right along the solutions, by central differences.

    Parameters
    ----------
    sensitivities : array (parameters, points, states)
        Of the solution z; the derivative by a parameter without sensitivities is 0.
    left, right
        As `smallest_singular_vectors` returns them.
    """
    amplitude, result = np.abs(z).max(axis=0), np.zeros(parameters.size)
    units = np.where(amplitude > 0.0, amplitude, 1.0)
    for p in np.flatnonzero(sensitivities.any(axis=(1, 2))):
        small = SMALL / np.max(np.abs(sensitivities[p]) / units)
        small = min(small, SMALL * abs(parameters[p])) if parameters[p] != 0.0 else small
        ends = []
        for step in (small, -small):
            moved = parameters.copy()
            moved[p] += step
            columns = equations.residual_jacobian(z + step * sensitivities[p], moved)
            g_q = columns[:, equations.count :].reshape(len(z), equations.count, -1)
            ends.append(np.einsum("ne,neq,nq->", left, g_q, right))
        result[p] = (ends[0] - ends[1]) / (2.0 * small)
    return result
