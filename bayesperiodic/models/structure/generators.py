"""A readable basis of the infinitesimal symmetries: scalings first, each moving as few parameters as possible."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import sympy as sp
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.models.structure import modular
from bayesperiodic.models.structure.determining import Determining, derivative

HEAVY = 100


@dataclass(frozen=True, eq=False)
class Generator:
    """An infinitesimal symmetry.

    Attributes
    ----------
    parameters, states : dict
        Name -> move, of those that move.
    field : dict
        Symbol -> move, derivatives of the states included.
    weights : dict or None
        Name -> whole number, if every move is that multiple of the parameter or state itself.
    """

    parameters: dict[str, sp.Expr]
    states: dict[str, sp.Expr]
    field: dict[sp.Symbol, sp.Expr]
    weights: dict[str, int] | None = None

    def applied(self, expression: sp.Expr) -> sp.Expr:
        """Return the change of an expression."""
        return sp.Add(*(move * derivative(expression, symbol) for symbol, move in self.field.items()))

    def times(self, factor: sp.Expr) -> "Generator":
        """Return the generator with all its moves multiplied by a function of the parameters."""
        parts = [{k: sp.factor(v * factor) for k, v in part.items()} for part in _parts(self)]
        return Generator(*parts)

    def minus(self, other: "Generator", factor: sp.Expr) -> "Generator":
        """Return self − factor · other."""
        parts = []
        for own, its in zip(_parts(self), _parts(other), strict=True):
            moves = {k: sp.factor(own.get(k, 0) - factor * its.get(k, 0)) for k in dict.fromkeys((*own, *its))}
            parts.append({k: v for k, v in moves.items() if v != 0})
        return Generator(*parts)


def generators_of(equations: Determining) -> list[Generator]:
    """Return symmetries that move parameters, as many as are independent of each other at generic values."""
    scalings = _scalings(equations)
    moves = _moves_of_parameters(equations, scalings)
    count = len(equations.terms)
    vectors = modular.nullspace(equations.matrix)[:, :count]
    heavy = np.array([HEAVY if term.is_parameter else 1 for term in equations.terms])
    parameters = [k for k, term in enumerate(equations.terms) if term.is_parameter]
    wanted = modular.rank(vectors[:, parameters])
    chosen = [_generator(equations, {k: _own(equations, k) * w for k, w in s.items()}, s) for s in scalings]
    for support in modular.circuits(vectors, heavy) if len(chosen) < wanted else []:
        rest = [k for k in range(count) if k not in support]
        (move,) = modular.nullspace(vectors[:, rest].T) if rest else np.ones((1, len(vectors)), dtype=np.int64)
        row = modular.product(move[None], vectors)[:, parameters]
        if modular.rank(np.concatenate([moves, row])) > len(moves):
            moves = np.concatenate([moves, row])
            chosen.append(_generator(equations, equations.solution(support)))
        if len(chosen) == wanted:
            break
    return chosen


def _scalings(equations: Determining) -> list[dict[int, int]]:
    """Return {term: weight} of independent symmetries that multiply parameters and states by powers of one number."""
    terms, rows = equations.terms, equations.rows
    columns = [k for k, t in enumerate(terms) if t.is_parameter or t.moves == _own(equations, k)]
    diagonal = [len(terms) + j for j, on in enumerate(equations.multipliers) if on]
    index = {k: equations.unknowns.index(_own(equations, k)) for k in columns if terms[k].is_parameter}
    table: list[dict[int, sp.Rational]] = []
    for row in rows:
        parts: dict[tuple[int, ...], dict[int, sp.Rational]] = {}
        for place, column in enumerate([*columns, *diagonal]):
            for powers, coefficient in row.get(column, {}).items():
                raised = tuple(p + (i == index.get(column)) for i, p in enumerate(powers))
                parts.setdefault(raised, {})[place] = coefficient
        table += parts.values()
    size = len(columns) + len(diagonal)
    exact = DomainMatrix([[sp.QQ(row.get(c, 0)) for c in range(size)] for row in table], (len(table), size), sp.QQ)
    whole = modular.whole(exact.to_sparse().nullspace())
    heavy = np.array([HEAVY if terms[k].is_parameter else 1 for k in columns] + [0] * len(diagonal))
    parameters = [place for place, k in enumerate(columns) if terms[k].is_parameter]
    found: list[dict[int, int]] = []
    taken = np.empty((0, len(parameters)), dtype=np.int64)
    for vector in modular.whole_circuits(whole, heavy):
        if modular.rank(np.concatenate([taken, vector[None, parameters]])) > len(taken):
            taken = np.concatenate([taken, vector[None, parameters]])
            found.append({k: int(w) for k, w in zip(columns, vector, strict=False) if w})
    return found


def _moves_of_parameters(equations: Determining, scalings: list[dict[int, int]]) -> np.ndarray:
    """Return how the scalings move the parameters, modulo the prime at the point of the matrix."""
    values = dict(zip(equations.unknowns, equations.point, strict=True))
    parameters = [k for k, term in enumerate(equations.terms) if term.is_parameter]
    rows = [[s.get(k, 0) * values[_own(equations, k)] % modular.PRIME for k in parameters] for s in scalings]
    return np.array(rows, dtype=np.int64).reshape(len(scalings), len(parameters))


def _own(equations: Determining, term: int) -> sp.Symbol:
    """Return the symbol of the parameter or state that a term moves."""
    return next(iter(equations.terms[term].field))


def _generator(
    equations: Determining, moves: Mapping[int, sp.Expr], weights: Mapping[int, int] | None = None
) -> Generator:
    parameters: dict[str, sp.Expr] = {}
    states: dict[str, sp.Expr] = {}
    field: dict[sp.Symbol, sp.Expr] = {}
    named = {}
    for k, move in moves.items():
        term = equations.terms[k]
        part = parameters if term.is_parameter else states
        part[term.name] = part.get(term.name, sp.S.Zero) + move * (1 if weights else term.moves)
        for symbol, rate in term.field.items():
            field[symbol] = field.get(symbol, sp.S.Zero) + (weights[k] * symbol if weights else move * rate)
        if weights:
            named[term.name] = weights[k]
    return Generator(parameters, states, field, named or None)


def _parts(generator: Generator) -> tuple[dict, dict, dict]:
    return generator.parameters, generator.states, generator.field
