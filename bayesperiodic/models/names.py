"""Symbols of states, inputs and parameters by name."""

from collections.abc import Mapping

import sympy as sp

from bayesperiodic import _checks

DERIVATIVES = ("", "d", "dd")


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
