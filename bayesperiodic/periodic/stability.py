"""Sensitivities of Floquet multipliers, from the second derivatives of the equations."""

import numpy as np

from bayesperiodic.models.model import Model
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.floquet import change_factors, first_order_matrix
from bayesperiodic.periodic.sensitivity import parameter_sensitivities
from bayesperiodic.periodic.solution import PeriodicSolution, equations_of


def multiplier_sensitivities(model: Model, solution: PeriodicSolution) -> dict[str, np.ndarray]:
    r"""Return ∂multiplier/∂parameter, and for a forced model ∂multiplier/∂frequency [per Hz].

    .. math::

        \mathrm{d} \log \mu = \int \frac{w^T \, \mathrm{d}A \, v}{w^T v} \, \mathrm{d}t

    over the response period, with the eigenfunctions v of the linearised equations ẏ = A y and w of their adjoint; dA
    holds the direct change and that through the orbit. A multiplier that occurs
    twice has no derivative, and the result is not finite or large there.

    Parameters
    ----------
    model : Model
        That of the solution.
    solution : PeriodicSolution
        A converged one.

    Returns
    -------
    dict of str to complex array (multipliers,)
        In the order of ``solution.multipliers``.

    Raises
    ------
    ValueError
        If the solution has not converged or is one of another model.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(200) / 200)
    >>> solution = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                              frequency=0.1, samples=200)
    >>> by_parameter = bp.multiplier_sensitivities(bp.models.duffing, solution)
    >>> mu = solution.multipliers                    # Liouville: the product of the multipliers is exp(-c/m · period)
    >>> round(float(sum(by_parameter["c"] / mu).real), 6) == -10.0
    True
    """
    equations, theta, z = equations_of(model, solution)
    derivative = parameter_sensitivities(equations, z, theta) if solution.converged else None
    if solution.floquet is None or derivative is None:
        raise ValueError(
            f"solution: status {solution.status!r} is not allowed; it must have converged and be regular. Solve again "
            "from another guess."
        )
    names = [*model.parameters, FREQUENCY][: len(derivative.frequency)]
    directions = np.eye(len(names), theta.size)
    frequency = derivative.frequency if model.autonomous else np.eye(len(names))[-1]
    logarithmic = logarithmic_changes(equations, theta, z, solution, derivative.states, directions, frequency)
    return {name: solution.multipliers * change for name, change in zip(names, logarithmic, strict=True)}


def logarithmic_changes(
    equations: PeriodicEquations,
    theta: np.ndarray,
    z: np.ndarray,
    solution: PeriodicSolution,
    states: np.ndarray,
    directions: np.ndarray,
    frequency: np.ndarray,
    count: int | None = None,
) -> np.ndarray:
    """Return the changes of log μ along directions, complex (directions, multipliers).

    Parameters
    ----------
    equations : PeriodicEquations
    theta : array (parameters,)
    z : array (points, states)
        A solution.
    solution : PeriodicSolution
        The same, with its Floquet multipliers.
    states : array (directions, points, states)
        Changes of z.
    directions : array (directions, parameters)
        Changes of the parameters.
    frequency : array (directions,)
        Changes of the frequency [Hz].
    count : int, optional
        How many of the largest multipliers are wanted; by default all.
    """
    assert solution.floquet is not None
    model, orders, sizes = equations.model, tuple(solution.orders.values()), solution._sizes()
    v, w = solution.floquet.leading(len(solution.multipliers) if count is None else count)
    v, w = v * sizes, w / sizes
    matrix, jacobian = first_order_matrix(solution.linearisation, orders), solution.linearisation
    moved_by, seen = change_factors(jacobian, orders, matrix, v, w)
    overlap = np.einsum("mnp,mnp->mn", w, v)
    stretching = np.einsum("mnp,npq,mnq->mn", w, matrix, v)
    state_rates, input_rates = equations.frequency_changes(z)
    along = equations.changes(states)
    here, change = equations.states(z), np.empty((len(z), jacobian[0].size))
    result = np.empty((len(directions), len(v)), dtype=complex)
    for d, direction in enumerate(directions):
        model.jacobian_change(
            np.ascontiguousarray(np.concatenate([here, along[d] + frequency[d] * state_rates], axis=1)),
            np.ascontiguousarray(np.concatenate([equations.inputs, frequency[d] * input_rates], axis=1)),
            np.concatenate([theta, direction, frequency[d : d + 1]]),
            equations.grid.tau,
            equations.frequency,
            change,
        )
        moved = np.einsum("mne,nej,mnj->mn", moved_by, change.reshape(jacobian.shape), seen, optimize=True)
        moved -= frequency[d] / equations.frequency * stretching
        result[d] = solution.period * (moved / overlap).mean(axis=1)
    return result
