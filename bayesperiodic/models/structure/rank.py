"""The rank of exact sensitivities: how many directions of the parameters the outputs of rich motions react to."""

import numpy as np
import sympy as sp

from bayesperiodic.models.structure.series import differentiated, series
from bayesperiodic.models.structure.system import System

STEP = 1e-30
VALUES = 4
NEWTON_STEPS = 30
ZERO = 1e-9


def silent_directions(system: System) -> list[tuple[dict[sp.Symbol, float], np.ndarray]]:
    """Return, at several random values of the parameters, the directions to which no output reacts.

    The outputs' first derivatives by time, as many as there are initial values, are taken at many unrelated instants
    (states, inputs, their derivatives, time and frequency random), with their exact sensitivities to the parameters
    and to the states at that instant. What the states at the instants can undo is projected out. These derivatives
    carry all that the input-output equations contain [1]_.

    Returns
    -------
    list of (values, array (directions, parameters))
        The values of all parameters, and orthonormal rows in the logarithms of the unknown ones. Empty if the equations
        cannot be solved for the highest derivatives or contain functions that NumPy does not have.

    References
    ----------
    .. [1] A. Ovchinnikov, A. Pillay, G. Pogudin, T. Scanlon, Multi-experiment parameter identifiability of ODEs and
       model theory, SIAM Journal on Applied Algebra and Geometry 6, 2022, 339-367.
    """
    random = np.random.default_rng(7)
    found = []
    for _ in range(VALUES):
        theta = random.uniform(0.5, 1.5, len(system.parameters))
        known = random.uniform(0.5, 1.5, len(system.known))
        try:
            reactions = _reactions(system, theta, known, random)
        except (TypeError, NameError, np.linalg.LinAlgError):
            return []
        if len(reactions) < len(theta):
            return []
        _, size, directions = np.linalg.svd(reactions)
        values = dict(zip((*system.parameters.values(), *system.known.values()), [*theta, *known], strict=True))
        found.append((values, directions[np.count_nonzero(size > ZERO * size[0]) :]))
    return found


def _reactions(system: System, theta: np.ndarray, known: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return the rows of sensitivities to the logarithms of the parameters that no change of the states can undo."""
    order, points = sum(system.orders.values()) + 1, 20 + 3 * len(theta)
    taylor = _motions(system, theta, known, order, points, random)
    rows = []
    for values in taylor.transpose(1, 0, 3, 2).reshape(points, -1, taylor.shape[2]):
        if not np.all(np.isfinite(values)) or np.any(np.abs(values.imag) > 1e-12 * (1.0 + np.abs(values.real))):
            continue
        slopes = values.imag / STEP
        slopes[:, : len(theta)] *= theta
        size = np.abs(slopes).max(axis=1)
        slopes = slopes[size > 0.0] / size[size > 0.0, None]
        basis, singular, _ = np.linalg.svd(slopes[:, len(theta) :])
        rank = np.count_nonzero(singular > ZERO * max(singular, default=1.0))
        rows.append(basis[:, rank:].T @ slopes[:, : len(theta)])
    return np.concatenate(rows) if rows else np.empty((0, len(theta)))


def _motions(
    system: System, theta: np.ndarray, known: np.ndarray, order: int, points: int, random: np.random.Generator
) -> np.ndarray:
    """Return the outputs' Taylor coefficients (order + 1, points, directions, outputs); a direction a complex step."""
    starts = [system.symbols["d" * k + s] for s, highest in system.orders.items() for k in range(highest)]
    directions = len(theta) + len(starts)
    shape = (order + 3, points, directions)

    def fixed(number: np.ndarray | float) -> np.ndarray:
        result = np.zeros(shape, dtype=complex)
        result[0] = number
        return result

    values = {s: fixed(v) for s, v in zip(system.known.values(), known, strict=True)}
    for i, (symbol, value) in enumerate(zip(system.parameters.values(), theta, strict=True)):
        values[symbol] = fixed(value)
        values[symbol][0, :, i] += STEP * 1j
    frequency = random.uniform(0.3, 1.0, (points, 1))
    values[system.symbols["frequency"]] = fixed(frequency)
    values[system.symbols["tau"]] = fixed(random.uniform(0.0, 1.0, (points, 1)))
    values[system.symbols["tau"]][1] = frequency
    for name in system.inputs:
        signal = fixed(0.0) + random.uniform(-1.0, 1.0, (order + 3, points, 1))
        for prefix in ("", "d", "dd"):
            values[system.symbols[prefix + name]] = signal
            signal = differentiated(signal)
    for i, symbol in enumerate(starts):
        values[symbol] = fixed(random.uniform(-1.5, 1.5, (points, 1)))
        values[symbol][0, :, len(theta) + i] += STEP * 1j
    with np.errstate(all="ignore"):
        _follow(system, values, order)
        shortened = {symbol: v[: order + 1] for symbol, v in values.items()}
        return np.stack([series(y, shortened) for y in system.outputs.values()], axis=-1)


def _follow(system: System, values: dict[sp.Symbol, np.ndarray], order: int) -> None:
    """Fill in the Taylor coefficients of the states, one order of the equations after the other."""
    highest = [system.symbols["d" * n + s] for s, n in system.orders.items()]
    if not highest:
        return
    for symbol in highest:
        values[symbol] = np.zeros_like(next(iter(values.values())))
    jacobian = [[sp.diff(g, symbol) for symbol in highest] for g in system.equations]
    for k in range(order + 1):
        for _ in range(NEWTON_STEPS if k == 0 else 1):
            now = {symbol: v[: k + 1] for symbol, v in values.items()}
            residual = np.stack([series(g, now)[k] for g in system.equations], axis=-1)
            start = {symbol: v[:1] for symbol, v in values.items()}
            slopes = np.stack([np.stack([series(e, start)[0] for e in row], axis=-1) for row in jacobian], axis=-2)
            change = np.linalg.solve(slopes, residual[..., None])[..., 0]
            for i, symbol in enumerate(highest):
                values[symbol][k] -= change[..., i]
            if not np.any(np.abs(change.real) > 1e-13 * (1.0 + np.abs(values[highest[0]][k].real)[..., None])):
                break
        for state, n in system.orders.items():
            chain = [values[system.symbols["d" * j + state]] for j in range(n, -1, -1)]
            for rate, integral in zip(chain, chain[1:], strict=False):
                for j in range(k + 2):
                    integral[j + 1 : j + 2] = rate[j] / (j + 1)
