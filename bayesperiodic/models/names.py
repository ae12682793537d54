"""Symbols of states, inputs and parameters by name, and expressions of them as texts."""

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

import sympy as sp
from sympy.printing.str import StrPrinter

from bayesperiodic import _checks
from bayesperiodic._expressions import FLOAT_FUNCTION, parse

DERIVATIVES = ("", "d", "dd")
RESERVED = ("tau", "frequency", "variance", "shift", "chain", "draw", "ensemble", "channel", "experiment")
# Texts of the TypeErrors of NumPy, math and `if` when they are given symbols.
NUMERIC_ONLY = ("ufunc", "truth value", "expression to float", "to integer", "'Symbol'")


class Names:
    """Symbols as attributes or keys, such as ``s.dx``, ``p.k3`` and ``p["k3"]``."""

    def __init__(self, kind: str, symbols: Mapping[str, sp.Symbol]):
        self._kind, self._symbols = kind, dict(symbols)

    def __getattr__(self, name: str) -> sp.Symbol:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self[name]
        except ValueError as error:
            raise AttributeError(str(error)) from None

    def __getitem__(self, name: str) -> sp.Symbol:
        _checks.one_of(self._kind, name, self._symbols)
        return self._symbols[name]


def with_derivatives(space: str, names: tuple[str, ...]) -> dict[str, sp.Symbol]:
    """Return the symbols of names and their derivatives, by name."""
    return {d + n: sp.Symbol(f"{space}_{d}_{n}", real=True) for d in DERIVATIVES for n in names}


def called(argument: str, given: Any, spaces: tuple[Names, ...]) -> Any:
    """Return what the function of (s, p, u) returns, or `given` itself if it is no function."""
    if not callable(given):
        return given
    try:
        inspect.signature(given).bind(*spaces)
    except TypeError as error:
        raise ValueError(f"{argument}: must be a function of (s, p, u), got {given!r}: {error}.") from None
    try:
        return given(*spaces)
    except TypeError as error:
        if not any(text in str(error) for text in NUMERIC_ONLY):
            raise
        raise ValueError(
            f"{argument}: must use SymPy's functions of states, parameters and inputs (import sympy as sp; "
            "sp.cos(s.x), sp.sign(s.dx), and sp.Piecewise instead of if), got an error of a function of numbers: "
            f"{error}"
        ) from error


def check_derivative_names(argument: str, space: str, names: tuple[str, ...]) -> None:
    """Raise a ValueError where names, or their derivatives, are no different identifiers."""
    for name in names:
        for derivative in (f"d{name}", f"dd{name}"):
            if derivative in names:
                raise ValueError(
                    f"{argument}: must not contain derivatives, got {derivative!r} and {name!r}; leave {derivative!r} "
                    f"out and write {space}.{derivative}."
                )
    _checks.identifiers(argument, [d + n for d in DERIVATIVES for n in names], RESERVED)


def as_expression(argument: str, text: str, spaces: Iterable[Mapping[str, sp.Symbol]]) -> sp.Expr:
    """Return a text as an expression of states, inputs, parameters and time, by their plain names."""
    spaces = tuple(spaces)
    symbols = {name: symbol for space in spaces for name, symbol in space.items()}
    if "=" in text:
        raise ValueError(f"{argument}: must be without '=', got {text!r}; write left = right as left - (right).")
    parsed = parse(argument, text, symbols)
    for name in parsed.names:
        if sum(name in space for space in spaces) > 1:
            raise ValueError(f"{argument}: must have a single meaning of {name!r}, got {text!r}; rename one of them.")
    return parsed.symbolic(argument, symbols)[0]


def as_text(expression: sp.Expr, spaces: Iterable[Mapping[str, sp.Symbol]]) -> str:
    """Return an expression as a text; `as_expression` may refuse it, or return one that differs by rounding."""
    names = {symbol: name for space in spaces for name, symbol in space.items()}
    return str(_TextPrinter(names).doprint(expression))


class _TextPrinter(StrPrinter):
    """SymPy's texts with plain names, and with floats that are no fractions."""

    def __init__(self, names: Mapping[sp.Symbol, str]):
        super().__init__()
        self.names = names

    def _print_Symbol(self, expr: Any) -> str:  # noqa: N802  SymPy calls it by the class
        return self.names[expr]

    def _print_Float(self, expr: Any) -> str:  # noqa: N802
        return f"{FLOAT_FUNCTION}({float(expr)!r})"

    def _print_Abs(self, expr: Any) -> str:  # noqa: N802
        return f"abs({self._print(expr.args[0])})"
