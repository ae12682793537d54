"""Centres: equilibria that are surrounded by cycles of all amplitudes, as in conservative models."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from bayesperiodic.models.model import Model

# Random parameter values, starts of Newton's method for equilibria at each, its steps, and its relative accuracy.
DRAWS, EQUILIBRIUM_STARTS, EQUILIBRIUM_STEPS, FOUND_EQUILIBRIUM = 3, 24, 50, 1e-10
# Real part of an eigenvalue of a centre, in units of its imaginary part.
CENTRE = 1e-7
# A cycle around a centre: its amplitude, in units of the equilibrium, periods that are integrated, those compared at
# both ends, points of a cycle, the smallest range of a variable that is compared, in units of the largest, and the
# largest change of a range.
SMALL_CYCLE, CYCLES_INTEGRATED, CYCLES_COMPARED = 0.1, 30, 8
POINTS_A_CYCLE, MAIN_VARIABLE, SAME_RANGE = 40, 0.3, 0.02


class FirstOrder(NamedTuple):
    """Functions of the states and rates (size,) and the parameters: ẏ and, at rest, its derivatives (size, size)."""

    rate: Callable[..., np.ndarray]
    jacobian: Callable[..., np.ndarray]
    states: int  # their number; they are the first variables
    size: int

    def path_rate(self, _: float, at: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return ẏ for an integration in time."""
        return self.rate(at, parameters)


def has_centres(model: Model, zeros: Iterable[str] = ()) -> bool:
    """Return whether cycles of an autonomous model are not isolated, at random values of its parameters.

    That is so if an equilibrium has a pair of imaginary eigenvalues at all of them, and if a small motion along this
    pair keeps its amplitude. `zeros` are parameters that are zero.
    """
    if not model.autonomous:
        return False
    random, centres = np.random.default_rng(0), []
    system = _first_order(model)
    off = np.array([name in set(zeros) for name in model.parameters], dtype=bool)
    with np.errstate(all="ignore"):
        for _ in range(DRAWS):
            parameters = np.where(off, 0.0, random.uniform(0.5, 2.0, len(model.parameters)))
            oscillating = [
                (equilibrium, pair)
                for equilibrium in _equilibria(system, parameters, random)
                if (pair := _slowest_pair(system, equilibrium, parameters)) is not None
            ]
            if oscillating:
                centres.append(any(_keeps_amplitude(system, at, *pair, parameters) for at, pair in oscillating))
    return len(centres) > DRAWS // 2 and all(centres)


def _first_order(model: Model) -> FirstOrder:
    states, symbols = model.states, model.state_symbols
    second = [s for s in states if model.orders[s] == 2]
    variables = [symbols[s] for s in states] + [symbols["d" + s] for s in second]
    highest = [symbols["d" * model.orders[s] + s] for s in states]
    given = [*variables, *model.parameter_symbols.values(), model.time_symbols["frequency"]]
    equations, none = sp.Matrix(model.equations), dict.fromkeys(highest, 0)
    at_rest = equations.subs(none)
    matrices = equations.jacobian(highest).subs(none), at_rest, at_rest.jacobian(variables)
    mass, force, stiffness = (sp.lambdify(given, matrix, "numpy") for matrix in matrices)
    places = [len(states) + second.index(s) if s in second else i for i, s in enumerate(states)]
    turned = [states.index(s) for s in second]

    def filled(values: np.ndarray, rates: np.ndarray) -> np.ndarray:
        out = np.zeros(rates.shape)
        out[turned] = rates[len(states) :]
        out[places] = values
        return out

    def solved(right: Any, at: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return -np.linalg.solve(np.array(mass(*at, *parameters, 1.0), dtype=float), np.array(right, dtype=float))

    def rate(at: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return filled(solved(force(*at, *parameters, 1.0), at, parameters)[:, 0], at)

    def jacobian(at: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return filled(solved(stiffness(*at, *parameters, 1.0), at, parameters), np.eye(len(variables)))

    return FirstOrder(rate, jacobian, len(states), len(variables))


def _equilibria(system: FirstOrder, parameters: np.ndarray, random: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield different equilibria (size,) that Newton's method finds from random starts."""
    known: list[np.ndarray] = []
    for k in range(EQUILIBRIUM_STARTS):
        at = np.zeros(system.size)
        at[: system.states] = random.standard_normal(system.states) * 10.0 ** random.uniform(-1, 1)
        at = np.abs(at) if k % 2 else at
        try:
            for _ in range(EQUILIBRIUM_STEPS):
                matrix, rates = system.jacobian(at, parameters), system.rate(at, parameters)
                if not (np.isfinite(matrix).all() and np.isfinite(rates).all()):
                    break
                step = np.linalg.lstsq(matrix, rates, rcond=None)[0]
                at = at - step
                if np.max(np.abs(step)) <= FOUND_EQUILIBRIUM * max(1.0, np.max(np.abs(at))):
                    break
            else:
                continue
            rates = system.rate(at, parameters)
        except np.linalg.LinAlgError:
            continue
        near = any(np.allclose(at, other, rtol=1e-6, atol=1e-6) for other in known)
        if np.isfinite(at).all() and np.max(np.abs(rates)) < 1e-6 and not near:
            known.append(at)
            yield at


def _slowest_pair(
    system: FirstOrder, equilibrium: np.ndarray, parameters: np.ndarray
) -> tuple[complex, np.ndarray] | None:
    """Return the complex eigenvalue [1/s] that is nearest to the imaginary axis, and its vector; None without one."""
    try:
        values, vectors = np.linalg.eig(system.jacobian(equilibrium, parameters))
    except np.linalg.LinAlgError:
        return None
    turning = np.flatnonzero(values.imag > 1e-6 * np.abs(values).max())
    if not turning.size:
        return None
    first = turning[np.argmin(np.abs(values.real[turning]) / values.imag[turning])]
    return complex(values[first]), vectors[:, first]


def _keeps_amplitude(
    system: FirstOrder, equilibrium: np.ndarray, value: complex, vector: np.ndarray, parameters: np.ndarray
) -> bool:
    """Return whether an equilibrium is a centre, by its eigenvalue and by a motion that starts along the vector."""
    from scipy.integrate import solve_ivp

    if not abs(value.real) < CENTRE * value.imag:
        return False
    scale = SMALL_CYCLE * max(float(np.max(np.abs(equilibrium))), 1.0)
    start = equilibrium + scale * np.real(vector / vector[np.argmax(np.abs(vector))])
    times = 2 * np.pi / value.imag * np.linspace(0.0, CYCLES_INTEGRATED, POINTS_A_CYCLE * CYCLES_INTEGRATED + 1)
    try:
        path = solve_ivp(
            system.path_rate,
            (0.0, float(times[-1])),
            start,
            "DOP853",
            times,
            rtol=1e-8,
            atol=1e-8 * scale,
            args=(parameters,),
        )
    except (np.linalg.LinAlgError, ValueError):
        return False
    if path.y.shape[1] < len(times):
        return False
    part = POINTS_A_CYCLE * CYCLES_COMPARED
    first, last = np.ptp(path.y[:, :part], axis=1), np.ptp(path.y[:, -part:], axis=1)
    moving = first > MAIN_VARIABLE * first.max()
    return bool(np.all(np.abs(last[moving] / first[moving] - 1.0) < SAME_RANGE))
