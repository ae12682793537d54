"""Expressions of truncated power series in time, many at once."""

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import sympy as sp


def series(expression: sp.Expr, values: Mapping[sp.Symbol, np.ndarray]) -> np.ndarray:
    """Return the power series of an expression of power series, complex arrays (order + 1, …).

    Signs are those of the leading coefficients' real parts.

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
            raise TypeError(f"{e.func} is not known here.")
        return composed(_derivatives(e.func, e.func, len(template)), value(e.args[0]))

    return value(expression)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of two power series."""
    return np.stack([sum((a[i] * b[k - i] for i in range(1, k + 1)), a[0] * b[k]) for k in range(len(a))])


def composed(derivatives: list[Callable[[np.ndarray], np.ndarray]], inner: np.ndarray) -> np.ndarray:
    """Return a function of a power series, from its derivatives of all orders, by Horner's rule."""
    start = inner[0]
    rest = inner.copy()
    rest[0] = 0.0
    result = np.zeros_like(inner)
    for order in range(len(inner) - 1, -1, -1):
        result = product(result, rest)
        result[0] += derivatives[order](start) / math.factorial(order)
    return result


def differentiated(a: np.ndarray) -> np.ndarray:
    """Return the derivative by time; the last coefficient is lost and set to zero."""
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
