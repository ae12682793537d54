"""Symbols of states, inputs and parameters by name."""

import inspect
from collections.abc import Mapping
from typing import Any

import sympy as sp

from bayesperiodic import _checks

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
