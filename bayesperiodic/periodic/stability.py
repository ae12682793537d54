"""Sensitivities of Floquet multipliers, from the second derivatives of the equations."""

import numpy as np

from bayesperiodic.models.model import Model
from bayesperiodic.periodic.equations import FREQUENCY
from bayesperiodic.periodic.floquet import first_order_matrix, matrix_change
from bayesperiodic.periodic.sensitivity import parameter_sensitivities
from bayesperiodic.periodic.solution import PeriodicSolution, equations_of


def multiplier_sensitivities(model: Model, solution: PeriodicSolution) -> dict[str, np.ndarray]:
    """Return ∂multiplier/∂parameter, and for a forced model ∂multiplier/∂frequency [per Hz].

    d log μ = ∫ wᵀ dA v / (wᵀ v) dt over the response period, with the eigenfunctions v of the linearised equations
    ẏ = A y and w of their adjoint; dA holds the direct change and that through the orbit. A multiplier that occurs
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
        raise ValueError(f"solution: status {solution.status!r} is not allowed; it must have converged and be regular.")
    names = [*model.parameters, FREQUENCY][: len(derivative.frequency)]
    orders = tuple(solution.orders.values())
    sizes = solution._sizes()
    scale = sizes / sizes[:, None]
    matrix = first_order_matrix(solution.linearisation, orders) * scale
    v, w = solution.floquet.eigenfunctions
    overlap = np.einsum("mnp,mnp->mn", w, v)
    state_rates, input_rates = equations.frequency_changes(z)
    result = {}
    for d, name in enumerate(names):
        frequency = 1.0 if name == FREQUENCY else float(derivative.frequency[d])
        direct = np.zeros(theta.size + 1)
        direct[-1] = frequency
        if name != FREQUENCY:
            direct[d] = 1.0
        states = equations.changes(derivative.states[d][None])[0] + frequency * state_rates
        change = np.empty((len(z), 3 * equations.count**2))
        model.jacobian_change(
            np.ascontiguousarray(np.concatenate([equations.states(z), states], axis=1)),
            np.ascontiguousarray(np.concatenate([equations.inputs, frequency * input_rates], axis=1)),
            np.concatenate([theta, direct]),
            equations.grid.tau,
            equations.frequency,
            change,
        )
        moved = matrix_change(solution.linearisation, change.reshape(solution.linearisation.shape), orders) * scale
        moved -= frequency / equations.frequency * matrix
        logarithmic = np.einsum("mnp,npq,mnq->mn", w, moved, v) / overlap
        result[name] = solution.multipliers * solution.period * logarithmic.mean(axis=1)
    return result
