"""The linear equations that infinitesimal symmetries of a system obey."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.models.structure import modular
from bayesperiodic.models.structure.algebra import Algebra
from bayesperiodic.models.structure.system import System

Polynomial = dict[tuple[int, ...], Any]


@dataclass(frozen=True)
class Term:
    """A direction in which a parameter or a state may move.

    Attributes
    ----------
    name : str
        Of the parameter or state.
    moves : expression
        1 for a parameter; for a state what multiplies the unknown coefficient: 1, a state, or an input.
    field : dict
        The move of every symbol, derivatives of the state included.
    is_parameter : bool
    """

    name: str
    moves: sp.Expr
    field: dict[sp.Symbol, sp.Expr]
    is_parameter: bool

    def applied(self, expression: sp.Expr) -> sp.Expr:
        """Return the change of an expression."""
        return sp.Add(*(move * derivative(expression, symbol) for symbol, move in self.field.items()))


def derivative(expression: sp.Expr, symbol: sp.Symbol) -> sp.Expr:
    """Return the derivative away from corners, where signs do not change."""
    return sp.diff(expression, symbol).replace(sp.DiracDelta, lambda *_: sp.S.Zero)


def terms_of(system: System) -> list[Term]:
    """Return all directions: every parameter, and every state by terms affine in the states and inputs."""
    found = [Term(n, sp.S.One, {s: sp.S.One}, True) for n, s in system.parameters.items()]
    signals = [(n, order) for n, order in system.orders.items()] + [(n, 2) for n in system.inputs]
    for state, order in system.orders.items():
        targets = [system.symbols["d" * k + state] for k in range(order + 1)]
        chains = [[sp.S.One, *[sp.S.Zero] * order]]
        for name, highest in signals:
            jets = [system.symbols["d" * k + name] for k in range(highest + 1)]
            chains += [jets[k : k + order + 1] for k in range(highest - order + 1)]
        found += [Term(state, c[0], dict(zip(targets, c, strict=True)), False) for c in chains]
    return found


@dataclass(frozen=True)
class Determining:
    """Σ_k z_k (X_k g) − Λ g = 0 and Σ_k z_k (X_k y) = 0 for all motions: linear in z and Λ, at every θ.

    The arguments of signs must keep their sign, which gives rows like those of g. Coefficients of different powers of
    what varies must vanish one by one.

    Attributes
    ----------
    terms : tuple of Term
        The first columns.
    algebra : Algebra
    rows : tuple of dict
        Column -> {powers of the parameters: coefficient}.
    multipliers : tuple of bool
        The other columns: whether a multiplier is on the diagonal of Λ.
    """

    terms: tuple[Term, ...]
    algebra: Algebra
    rows: tuple[dict[int, Polynomial], ...]
    multipliers: tuple[bool, ...]

    @property
    def unknowns(self) -> list[sp.Symbol]:
        """The symbols that the coefficients are polynomials of."""
        return self.algebra.generators[self.algebra.size :]

    @cached_property
    def point(self) -> list[int]:
        """Random values of the unknowns."""
        return [int(v) for v in np.random.default_rng(1).integers(1, modular.PRIME, len(self.unknowns))]

    @cached_property
    def matrix(self) -> np.ndarray:
        """Rows × columns modulo the prime, at random values of the parameters."""
        matrix = np.zeros((len(self.rows), len(self.terms) + len(self.multipliers)), dtype=np.int64)
        for i, row in enumerate(self.rows):
            for column, polynomial in row.items():
                matrix[i, column] = _modulo(polynomial, self.point)
        return matrix

    def solution(self, support: Iterable[int]) -> dict[int, sp.Expr]:
        """Return the z that vanishes outside the support, multipliers left out, in polynomials without common factor.

        The support must be one for which z is unique up to a factor.
        """
        own = sorted(support)
        columns = [*own, *range(len(self.terms), self.matrix.shape[1])]
        part = self.matrix[:, columns]
        chosen = modular.independent_rows(part)
        domain = sp.QQ[tuple(self.unknowns)]
        entries = [[domain.ring.from_dict(dict(self.rows[i].get(c, {}))) for c in columns] for i in chosen]
        matrix = DomainMatrix(entries, (len(chosen), len(columns)), domain)
        vector = matrix.to_field().to_sparse().nullspace().to_Matrix().row(0)
        exact = _primitive(list(vector)[: len(own)])
        return {c: self.algebra.original(e) for c, e in zip(own, exact, strict=True) if e != 0}


def determining_equations(system: System) -> Determining:
    """Return the determining equations of a system."""
    terms = terms_of(system)
    held = set().union(*(e.atoms(sp.sign) for e in (*system.equations, *system.outputs.values())))
    groups = [system.equations, *((s.args[0],) for s in sorted(held, key=sp.default_sort_key))]
    multipliers: list[bool] = []
    table: list[dict[int, sp.Expr]] = []
    for group in groups:
        for i, expression in enumerate(group):
            first = len(terms) + len(multipliers)
            multiplied = {first + j: -other for j, other in enumerate(group)}
            table.append({k: t.applied(expression) for k, t in enumerate(terms)} | multiplied)
            multipliers += [i == j for j in range(len(group))]
    table += [{k: t.applied(y) for k, t in enumerate(terms)} for y in system.outputs.values()]
    expressions = [e for row in table for e in row.values()]
    algebra = Algebra([*expressions, *system.parameters.values()], system.jets)
    rows = [part for row in table for part in _coefficients(row, algebra)]
    return Determining(tuple(terms), algebra, tuple(rows), tuple(multipliers))


def _coefficients(row: dict[int, sp.Expr], algebra: Algebra) -> list[dict[int, Polynomial]]:
    """Return what multiplies each power of what varies in a row."""
    parts: dict[tuple[int, ...], dict[int, Polynomial]] = {}
    for column, polynomial in zip(row, algebra.numerators(list(row.values())), strict=True):
        for powers, coefficients in algebra.split(polynomial).items():
            parts.setdefault(powers, {})[column] = coefficients
    return list(parts.values())


def _modulo(polynomial: Polynomial, point: list[int]) -> int:
    total = 0
    for powers, coefficient in polynomial.items():
        value = int(coefficient.numerator) * pow(int(coefficient.denominator), -1, modular.PRIME)
        for base, power in zip(point, powers, strict=True):
            value = value * pow(base, power, modular.PRIME) % modular.PRIME
        total += value
    return total % modular.PRIME


def _primitive(vector: list[sp.Expr]) -> list[sp.Expr]:
    """Return a multiple of a vector of rational functions: polynomials without a common factor."""
    common = sp.lcm_list([sp.fraction(sp.together(e))[1] for e in vector])
    whole = [sp.cancel(e * common) for e in vector]
    shared = sp.gcd_list([e for e in whole if e != 0])
    return [sp.factor(sp.cancel(e / shared)) for e in whole]
