"""Forces and internal states of the elements of condensed models, as functions of their motion."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import sympy as sp

from bayesperiodic import _checks
from bayesperiodic.models.hysteresis import Hysteretic
from bayesperiodic.models.matrices import Element
from bayesperiodic.models.names import Names, with_derivatives


class ElementMotion(NamedTuple):
    """Forces of elements, and rates of their internal states.

    `symbols` are the displacements of the elements and the internal states, then their first and second derivatives.
    Internal states that depend on each other stand together.
    """

    forces: tuple[sp.Expr, ...]
    rates: tuple[sp.Expr, ...]
    symbols: tuple[sp.Symbol, ...]
    blocks: tuple[int, ...]  # number of internal states that depend on each other, in their order
    owners: tuple[int, ...]  # the element of each

    @property
    def of_elements(self) -> tuple[sp.Symbol, ...]:
        """Displacements of the elements, then their first and second derivatives."""
        count, every = len(self.forces), len(self.forces) + len(self.rates)
        return tuple(symbol for i, symbol in enumerate(self.symbols) if i % every < count)

    @property
    def states(self) -> tuple[sp.Symbol, ...]:
        """The internal states."""
        return self.symbols[len(self.forces) : len(self.forces) + len(self.rates)]


def motion_of_elements(
    elements: Sequence[Element], inner: Sequence[str], parameters: Mapping[str, sp.Symbol]
) -> ElementMotion:
    """Return forces and rates of elements with internal states `inner`; parameters are symbols by name."""
    count, symbols = len(elements), with_derivatives("s", tuple(inner))
    moving = with_derivatives("e", tuple(f"d{number}" for number in range(count)))
    d, v, a = (tuple(moving.values())[order * count : (order + 1) * count] for order in range(3))
    s, p = Names("states", symbols), Names("parameters", dict(parameters))
    forces: list[sp.Expr] = []
    rates: dict[sp.Symbol, sp.Expr] = {}
    blocks: list[list[sp.Symbol]] = []
    owners: dict[sp.Symbol, int] = {}
    for number, element in enumerate(elements):
        part = element.evaluate(d[number], v[number], s, p)
        mine = [symbols[state] for state in element.states]
        known = {d[number], v[number], *mine, *parameters.values()}
        forces.append(_of_element(part.force, known))
        rates |= _rates(part, mine, [symbols["d" + state] for state in element.states], known)
        blocks += _blocks(rates, mine)
        owners |= dict.fromkeys(mine, number)
    order = [state for block in blocks for state in block]
    names = [next(name for name, symbol in symbols.items() if symbol == state) for state in order]
    slopes, bends = ([symbols[mark + name] for name in names] for mark in ("d", "dd"))
    return ElementMotion(
        tuple(forces), tuple(rates[state] for state in order), (*d, *order, *v, *slopes, *a, *bends),
        tuple(map(len, blocks)), tuple(owners[state] for state in order),
    )  # fmt: skip


def _of_element(given: sp.Expr, known: set[sp.Symbol]) -> sp.Expr:
    if given.has(sp.I, sp.zoo, sp.nan, sp.oo, -sp.oo):
        raise ValueError(f"elements: must have real and finite forces, got {_checks.shortened(given)}.")
    if unknown := sorted(map(str, given.free_symbols - known)):
        raise ValueError(
            f"elements: must have forces of d, v, internal states and parameters, got {', '.join(unknown)}."
        )
    return given


def _rates(
    part: Hysteretic, states: list[sp.Symbol], slopes: list[sp.Symbol], known: set[sp.Symbol]
) -> dict[sp.Symbol, sp.Expr]:
    """Return the derivatives of the internal states of an element by time, of equations linear in them."""
    equations = sp.Matrix(part.equations)
    if len(equations) != len(states):
        raise ValueError(f"elements: must have one equation per internal state, got {len(equations)} of {len(states)}.")
    if not states:
        return {}
    at_rest, matrix = equations.subs(dict.fromkeys(slopes, 0)), equations.jacobian(slopes)
    if matrix.free_symbols & set(slopes) or matrix.det() == 0:
        raise ValueError(
            "elements: must have equations of internal states that are linear in their first derivatives, got "
            f"{_checks.shortened(part.equations)}; take condensed=False."
        )
    solved = -at_rest if matrix == sp.eye(len(states)) else -matrix.inv() * at_rest
    return {state: _of_element(rate, known) for state, rate in zip(states, solved, strict=True)}


def _blocks(rates: Mapping[sp.Symbol, sp.Expr], states: list[sp.Symbol]) -> list[list[sp.Symbol]]:
    """Return the states in blocks that do not depend on each other."""
    blocks: list[list[sp.Symbol]] = []
    for state in states:
        linked = rates[state].free_symbols
        joined = [b for b in blocks if linked & set(b) or any(state in rates[other].free_symbols for other in b)]
        blocks = [b for b in blocks if b not in joined] + [[*(other for b in joined for other in b), state]]
    return blocks
