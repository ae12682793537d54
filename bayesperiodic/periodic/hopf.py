"""Hopf points of autonomous models, and the cycles that start there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.models.model import Model, parameter_vector
from bayesperiodic.models.sensed import of_a_channel
from bayesperiodic.periodic.arclength import ParametrisedEquations
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.floquet import first_order_matrix
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.solution import PeriodicSolution, describe

INTERVALS, EQUILIBRIUM_SAMPLES = 64, 4
OSCILLATING = 1e-9


@dataclass(frozen=True)
class HopfPoint(Result):
    """Hopf point: a pair of complex eigenvalues of an equilibrium crosses the imaginary axis.

    Attributes
    ----------
    model : str
    vary : str
        The varied parameter.
    value : float
        Of that parameter.
    frequency : float
        Of the oscillation that starts there [Hz].
    parameters : dict of str to float
    equilibrium : dict of str to float
        The states.
    mode : complex array (states,)
        Amplitudes of the states in the oscillation, in the model's order, the largest of them 1.

    Examples
    --------
    >>> hopf_point.vary, hopf_point.equilibrium, round(hopf_point.frequency, 4)
    ('mu', {'x': 0.0}, 0.9549)
    """

    model: str
    vary: str
    value: float
    frequency: float
    parameters: dict[str, float]
    equilibrium: dict[str, float]
    mode: np.ndarray

    def __repr__(self) -> str:
        return f"HopfPoint({self.model!r}, {self.vary} = {self.value:.6g}, {self.frequency:.6g} Hz)"


def hopf_points(
    model: Model, parameters: Mapping[str, float], vary: str, *, between: tuple[float, float]
) -> tuple[HopfPoint, ...]:
    """Find the Hopf points of an equilibrium along a parameter, by the eigenvalues of the linearised equations.

    Parameters
    ----------
    model : Model
        An autonomous one.
    parameters : mapping of str to float
        A value for every parameter; that of `vary` is ignored. So are delays and sensors of the outputs, such as
        ``shift[run 1]`` in `MapEstimate.theta`, which no equilibrium depends on.
    vary : str
        A parameter.
    between : (low, high)
        Searched range. A pair of eigenvalues that crosses the axis twice within 1/64 of the range is not found.

    Returns
    -------
    tuple of HopfPoint
        In the order of the parameter's values.

    Raises
    ------
    ValueError
        For a model that is not autonomous, unknown or missing names, values that are not finite or not in order.

    Examples
    --------
    >>> point, = bp.hopf_points(bp.models.van_der_pol, {"mu": 0.0, "omega": 6.0}, "mu", between=(-1.0, 1.5))
    >>> abs(point.value) < 1e-9, round(point.frequency, 6)
    (True, 0.95493)
    """
    from scipy.optimize import brentq

    _checks.instance("model", model, Model)
    if not model.autonomous:
        raise ValueError(f"model: must be autonomous, got {model.name!r}, which is driven and has no equilibrium.")
    _checks.one_of("vary", vary, model.parameters)
    low, high = (_checks.finite_number(f"between[{i}]", value) for i, value in enumerate(between))
    if not low < high:
        raise ValueError(f"between: must be in ascending order, got {between!r}.")
    given = {name: value for name, value in parameters.items() if not of_a_channel(name)} | {vary: low}
    theta = parameter_vector(model, given)
    equations = PeriodicEquations.build(model, None, frequency=1.0, samples=EQUILIBRIUM_SAMPLES, scheme="fourier")

    def at(value: float) -> np.ndarray:
        return np.where(np.array(model.parameters) == vary, value, theta)

    def growth(value: float) -> float:
        return _leading(equations, at(value))[0].real

    points = []
    rates = [(value, growth(value)) for value in np.linspace(low, high, INTERVALS + 1)]
    for (a, before), (b, after) in pairwise(rates):
        if before * after < 0.0 or (after == 0.0 and before != 0.0):
            value = float(brentq(growth, a, b, xtol=1e-13 * max(abs(a), abs(b)), rtol=1e-14))
            points.append(_describe(equations, at(value), vary, value))
    return tuple(points)


def emerging_cycle(
    model: Model,
    point: HopfPoint,
    *,
    amplitude: Mapping[str, float],
    samples: int = 800,
    scheme: str | Scheme | None = None,
) -> PeriodicSolution:
    """Step from a Hopf point onto the branch of cycles that starts there, stable or unstable.

    Parameters
    ----------
    model : Model
    point : HopfPoint
    amplitude : mapping of one str to float
        A state, and the amplitude of its first harmonic in the cycle wanted; small against the sizes at which the
        equations are nonlinear.
    samples, scheme : see `solve_periodic`

    Returns
    -------
    PeriodicSolution
        At the value of the varied parameter at which the model has that cycle; or with the status of the failed solve.

    Raises
    ------
    ValueError
        If the point is of another model, for more than one state, an unknown one or one that the oscillation does not
        move, an amplitude ≤ 0.

    Examples
    --------
    >>> bp.emerging_cycle(bp.models.van_der_pol, hopf_point, amplitude={"x": 0.5}, samples=100).status
    'converged'
    """
    _checks.instance("model", model, Model)
    _checks.instance("point", point, HopfPoint)
    if point.model != model.name:
        raise ValueError(f"model: must be {point.model!r}, as of the point, got {model.name!r}.")
    if len(amplitude) != 1:
        example = f"{{{model.states[0]!r}: 0.01}}"
        raise ValueError(f"amplitude: must be that of one state, such as {example}, got {dict(amplitude)!r}.")
    ((state, size),) = amplitude.items()
    _checks.one_of("amplitude", state, model.states)
    size = _checks.positive(f"amplitude[{state!r}]", size)
    component = point.mode[model.states.index(state)]
    if not abs(component) > OSCILLATING:
        moving = [name for name, part in zip(model.states, point.mode, strict=True) if abs(part) > OSCILLATING]
        raise ValueError(f"amplitude: must be of a state that the oscillation moves, {moving}, got {state!r}.")
    equations = PeriodicEquations.build(model, None, frequency=point.frequency, samples=samples, scheme=scheme)
    theta = np.array([point.parameters[n] for n in model.parameters])
    shape = point.mode * size / component
    wave = np.exp(2j * np.pi * equations.grid.tau)
    z = np.array([point.equilibrium[n] for n in model.states]) + np.real(wave[:, None] * shape)
    rows = np.zeros((2, *z.shape))
    rows[:, :, model.states.index(state)] = 2.0 / len(z) * np.stack([wave.real, wave.imag])
    values = np.array([point.value, point.frequency])
    parametrised = ParametrisedEquations(equations, theta, (point.vary, FREQUENCY))
    scales = np.maximum(np.abs(values), 1.0)
    solved = parametrised.solve(z, values, (rows, np.zeros((2, 2))), np.array([size, 0.0]), scales)
    equations, theta = parametrised.at(solved.values)
    return describe(equations, theta, solved, "Hopf point", sensitivities=False)


def _leading(equations: PeriodicEquations, theta: np.ndarray) -> tuple[complex, np.ndarray, np.ndarray]:
    """Return the oscillating eigenvalue [1/s] of largest real part (NaN without one), its vector, the equilibrium."""
    z, count = equations.static_guess(theta), equations.count
    columns = equations.residual_jacobian(z, theta)[:1, count:].reshape(1, count, -1)
    values, vectors = np.linalg.eig(first_order_matrix(columns, tuple(equations.model.orders.values()))[0])
    turning = np.flatnonzero(values.imag > OSCILLATING * np.abs(values).max())
    if not turning.size:
        return complex(np.nan, np.nan), np.full(len(values), np.nan), z[0]
    first = turning[np.argmax(values.real[turning])]
    return complex(values[first]), vectors[:, first], z[0]


def _describe(equations: PeriodicEquations, theta: np.ndarray, vary: str, value: float) -> HopfPoint:
    model = equations.model
    eigenvalue, vector, equilibrium = _leading(equations, theta)
    mode = vector[: equations.count] / vector[np.argmax(np.abs(vector[: equations.count]))]
    return HopfPoint(
        model=model.name,
        vary=vary,
        value=value,
        frequency=eigenvalue.imag / (2 * np.pi),
        parameters=dict(zip(model.parameters, theta.tolist(), strict=True)),
        equilibrium=dict(zip(model.states, equilibrium.tolist(), strict=True)),
        mode=mode,
    )
