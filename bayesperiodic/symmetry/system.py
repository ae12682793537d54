"""Symbolic equations of a model, their power series, and the directions without sensitivity."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import sympy as sp
from sympy.logic.boolalg import BooleanFunction

from bayesperiodic.models.model import Model


@dataclass(frozen=True)
class System:
    """Equations g = 0 and measured outputs y of states, inputs, time and parameters.

    Attributes
    ----------
    orders : dict
        State -> 1 or 2, of those that the measured outputs depend on; 0 if known parameters removed the derivatives.
    inputs : tuple of str
    symbols : dict
        Name -> symbol of states ("x", "dx", "ddx"), inputs (likewise), "tau" and "frequency".
    parameters : dict
        Name -> symbol of the unknown parameters.
    known : dict
        Name -> symbol of the known parameters.
    equations : tuple of expression
    outputs : dict
        Name -> expression.
    """

    orders: dict[str, int]
    inputs: tuple[str, ...]
    symbols: dict[str, sp.Symbol]
    parameters: dict[str, sp.Symbol]
    known: dict[str, sp.Symbol]
    equations: tuple[sp.Expr, ...]
    outputs: dict[str, sp.Expr]

    @property
    def appearing(self) -> frozenset[str]:
        """The unknown parameters that the equations and the measured outputs contain."""
        used = set().union(*(e.free_symbols for e in (*self.equations, *self.outputs.values())))
        return frozenset(name for name, symbol in self.parameters.items() if symbol in used)

    @property
    def jets(self) -> tuple[sp.Symbol, ...]:
        """Jet variables: states, inputs, their derivatives, tau and frequency."""
        return tuple(self.symbols.values())

    def given(self, known: Iterable[str], values: Mapping[sp.Symbol, sp.Expr]) -> "System":
        """Return the system with known parameters, and with parameters replaced by expressions."""
        taken = {self.parameters[name] for name in known} | set(values)
        return _observed(
            replace(
                self,
                parameters={n: s for n, s in self.parameters.items() if s not in taken},
                known=self.known | {n: s for n, s in self.parameters.items() if s in taken and s not in values},
                equations=tuple(e.subs(values, simultaneous=True) for e in self.equations),
                outputs={n: e.subs(values, simultaneous=True) for n, e in self.outputs.items()},
            )
        )


def system_of(model: Model, outputs: Iterable[str]) -> System:
    """Return the symbolic system of a model with the measured outputs."""
    expressions = dict(zip(model.outputs, model.output_expressions, strict=True))
    return _observed(
        System(
            orders=dict(model.orders),
            inputs=model.inputs,
            symbols=model.state_symbols | model.input_symbols | model.time_symbols,
            parameters=dict(model.parameter_symbols),
            known={},
            equations=tuple(_with_signs(e) for e in model.equations),
            outputs={name: _with_signs(expressions[name]) for name in outputs},
        )
    )


def _observed(system: System) -> System:
    """Return the system without the states and equations that no measured output depends on; update the orders."""
    used = set().union(*(e.free_symbols for e in (*system.equations, *system.outputs.values())))
    left = {s: max((k for k in range(3) if system.symbols["d" * k + s] in used), default=0) for s in system.orders}
    system = replace(system, orders=left)
    pending = list(system.outputs.values())
    states: set[str] = set()
    rows: set[int] = set()
    while pending:
        used = pending.pop().free_symbols
        for state in set(system.orders) - states:
            if used & {system.symbols[d + state] for d in ("", "d", "dd")}:
                states.add(state)
                highest = system.symbols["d" * system.orders[state] + state]
                new = {i for i, g in enumerate(system.equations) if highest in g.free_symbols} - rows
                rows |= new
                pending += [system.equations[i] for i in new]
    return replace(
        system,
        orders={s: order for s, order in system.orders.items() if s in states},
        equations=tuple(g for i, g in enumerate(system.equations) if i in rows),
    )


def _with_signs(expression: sp.Expr) -> sp.Expr:
    """Return the expression with exact numbers, and with kinks and branches written as sums of signs."""
    exact = sp.nsimplify(expression, rational=True)
    exact = exact.replace(sp.Piecewise, _pieces).replace(sp.Heaviside, lambda x, *_: (1 + sp.sign(x)) / 2)
    exact = exact.replace(lambda e: isinstance(e, sp.Max | sp.Min), lambda e: e.rewrite(sp.Abs))
    return exact.replace(sp.Abs, lambda x: x * sp.sign(x))


def _pieces(*pieces: Any) -> sp.Expr:
    total, left = sp.S.Zero, sp.S.One
    for value, condition in pieces:
        weight = _weight(condition)
        total, left = total + left * weight * value, left * (1 - weight)
    return total


def _weight(condition: Any) -> sp.Expr:
    """Return the indicator function of a condition."""
    if condition in (sp.true, sp.false):
        return sp.Integer(1 if condition else 0)
    if isinstance(condition, sp.And):
        return sp.Mul(*map(_weight, condition.args))
    if isinstance(condition, sp.Or):
        return 1 - sp.Mul(*(1 - _weight(part) for part in condition.args))
    if isinstance(condition, sp.Not):
        return 1 - _weight(condition.args[0])
    if isinstance(condition, BooleanFunction) or not hasattr(condition, "gts"):
        return sp.Integer(0 if isinstance(condition, sp.Eq) else 1)
    return (1 + sp.sign(condition.gts - condition.lts)) / 2


def series(expression: sp.Expr, values: Mapping[sp.Symbol, np.ndarray]) -> np.ndarray:
    """Return the power series of an expression of power series, complex arrays (order + 1, …).

    The sign of a series is that of the real part of its leading coefficient.

    Raises
    ------
    TypeError
        For a function that NumPy does not know.
    """
    known: dict[sp.Expr, np.ndarray] = dict(values)
    template = next(iter(values.values()))

    def constant(number: Any) -> np.ndarray:
        result = np.zeros_like(template)
        result[0] = complex(number)
        return result

    def value(e: sp.Expr) -> np.ndarray:
        if e not in known:
            known[e] = combined(e)
        return known[e]

    def combined(e: sp.Expr) -> np.ndarray:
        if e.is_number:
            return constant(e)
        if e.is_Add:
            return sum(map(value, e.args[1:]), value(e.args[0]))
        if e.is_Mul:
            result = value(e.args[0])
            for factor in e.args[1:]:
                result = product(result, value(factor))
            return result
        if e.is_Pow and e.exp.is_number:
            return composed(_derivatives(lambda x: x**e.exp, e.exp, len(template)), value(e.base))
        if e.is_Pow:
            return value(sp.exp(e.exp * sp.log(e.base), evaluate=False))
        if isinstance(e, sp.sign):
            leading = np.sign(value(e.args[0])[0].real)
            return constant(1.0) * leading
        if len(e.args) != 1:
            raise TypeError(f"expression: must consist of functions of one argument, got {e.func}.")
        return composed(_derivatives(e.func, e.func, len(template)), value(e.args[0]))

    return value(expression)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of two power series."""
    return np.stack([sum((a[i] * b[k - i] for i in range(1, k + 1)), a[0] * b[k]) for k in range(len(a))])


def composed(derivatives: list[Callable[[np.ndarray], np.ndarray]], inner: np.ndarray) -> np.ndarray:
    """Return a function of a power series, given its derivatives of all orders, by Horner's rule."""
    start = inner[0]
    rest = inner.copy()
    rest[0] = 0.0
    result = np.zeros_like(inner)
    for order in range(len(inner) - 1, -1, -1):
        result = product(result, rest)
        result[0] += derivatives[order](start) / math.factorial(order)
    return result


def differentiated(a: np.ndarray) -> np.ndarray:
    """Return the time derivative; its last coefficient is unknown and set to zero."""
    result = np.zeros_like(a)
    for k in range(1, len(a)):
        result[k - 1] = k * a[k]
    return result


@cache
def _compiled(key: Any, order: int, written: sp.Expr, x: sp.Symbol) -> Callable[[np.ndarray], np.ndarray]:
    return sp.lambdify(x, sp.diff(written, x, order), "numpy")


def _derivatives(function: Callable[[Any], Any], key: Any, count: int) -> list[Callable[[np.ndarray], np.ndarray]]:
    x = sp.Symbol("x")
    return [_compiled(key, order, function(x), x) for order in range(count)]


STEP = 1e-30
VALUES = 4
NEWTON_STEPS = 30
ZERO = 1e-9


def null_directions(system: System) -> list[tuple[dict[sp.Symbol, float], np.ndarray]]:
    """Return the parameter directions without effect on the outputs, at several random parameter values.

    The first time derivatives of the outputs, as many as there are initial values, are computed at many unrelated
    instants (with random states, inputs, their derivatives, time and frequency), with their exact sensitivities to the
    parameters and to the states at that instant. Effects that the states can compensate are projected out. These
    derivatives contain the information of the input-output equations [1]_.

    Returns
    -------
    list of (values, array (directions, parameters))
        Values of all parameters, and orthonormal rows in the logarithms of the unknown ones. Empty if the equations
        cannot be solved for the highest derivatives or contain functions that NumPy lacks.

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
            sensitivities = _sensitivities(system, theta, known, random)
        except (TypeError, NameError, np.linalg.LinAlgError):
            return []
        if len(sensitivities) < len(theta):
            return []
        _, size, directions = np.linalg.svd(sensitivities)
        values = dict(zip((*system.parameters.values(), *system.known.values()), [*theta, *known], strict=True))
        found.append((values, directions[np.count_nonzero(size > ZERO * size[0]) :]))
    return found


def _sensitivities(system: System, theta: np.ndarray, known: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return sensitivities to the logarithms of the parameters that changes of the states cannot compensate."""
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
    """Return Taylor coefficients of the outputs (order + 1, points, directions, outputs), with complex steps."""
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
    """Compute the Taylor coefficients of the states, order by order."""
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
