"""A model as plain symbolic equations: what is measured, what is unknown, corners written with signs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp
from sympy.logic.boolalg import BooleanFunction

from bayesperiodic.models.model import Model


@dataclass(frozen=True)
class System:
    """Equations g = 0 and measured outputs y of states, inputs, time and parameters.

    Attributes
    ----------
    orders : dict
        State -> 1 or 2, of those that the measured outputs depend on; 0 where known parameters removed derivatives.
    inputs : tuple of str
    symbols : dict
        Name -> symbol of states ("x", "dx", "ddx"), inputs (likewise), "tau" and "frequency".
    parameters : dict
        Name -> symbol, of the unknown ones.
    known : dict
        Name -> symbol, of the parameters that are taken as known.
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
        """States, inputs, their derivatives, tau and frequency: all that varies along a motion or between them."""
        return tuple(self.symbols.values())

    def given(self, known: Iterable[str], values: Mapping[sp.Symbol, sp.Expr]) -> "System":
        """Return the system with parameters taken as known and expressions put in the place of parameters."""
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
    """Return the system without the states and equations that no measured output depends on.

    The orders are those that are left where a highest derivative lost its factor.
    """
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
    """Return the expression with exact numbers, and its corners and branches as sums of signs."""
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
    """Return 1 where the condition holds and 0 where it does not."""
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
