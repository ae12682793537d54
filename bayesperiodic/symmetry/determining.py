"""Determining equations of Lie symmetries, solved by exact linear algebra modulo a prime and over the rationals."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np
import sympy as sp
from sympy.polys.fields import field
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.symmetry.system import System

PRIME = 2_147_483_629


def reduced(matrix: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Return the reduced row echelon form of an integer matrix modulo the prime, and its pivot columns."""
    rows = np.array(matrix, dtype=np.int64) % PRIME
    pivots: list[int] = []
    for column in range(rows.shape[1]):
        top = len(pivots)
        below = np.flatnonzero(rows[top:, column])
        if not below.size:
            continue
        rows[[top, top + below[0]]] = rows[[top + below[0], top]]
        rows[top] = rows[top] * pow(int(rows[top, column]), -1, PRIME) % PRIME
        others = np.flatnonzero(rows[:, column])
        others = others[others != top]
        rows[others] = (rows[others] - rows[others, column, None] * rows[top] % PRIME) % PRIME
        pivots.append(column)
    return rows[: len(pivots)], pivots


def rank(matrix: np.ndarray) -> int:
    """Return the rank modulo the prime."""
    return len(reduced(matrix)[1])


def nullspace(matrix: np.ndarray) -> np.ndarray:
    """Return vectors (nullity, columns) that span the null space modulo the prime."""
    rows, pivots = reduced(matrix)
    columns = matrix.shape[1]
    free = [c for c in range(columns) if c not in pivots]
    vectors = np.zeros((len(free), columns), dtype=np.int64)
    for vector, column in zip(vectors, free, strict=True):
        vector[column] = 1
        vector[pivots] = -rows[:, column] % PRIME
    return vectors


def independent_rows(matrix: np.ndarray) -> list[int]:
    """Return the indices of rows that span all rows."""
    return reduced(np.asarray(matrix).T)[1]


def circuits(vectors: np.ndarray, weights: np.ndarray, tries: int = 200) -> list[tuple[int, ...]]:
    """Return supports of combinations of the vectors that contain no smaller support, the lightest first.

    Every reduced echelon form consists of such combinations; forms for `tries` random orders of the columns, from a
    fixed seed, are used.
    """
    random = np.random.default_rng(0)
    found: set[tuple[int, ...]] = set()
    columns = vectors.shape[1]
    for trial in range(tries if len(vectors) > 1 else 1):
        # Heavy columns are the first pivots, so that each appears in one row only.
        order = np.lexsort((random.permutation(columns), -weights)) if trial % 2 else random.permutation(columns)
        for row in reduced(vectors[:, order])[0]:
            found.add(tuple(sorted(int(c) for c in order[np.flatnonzero(row)])))
    return sorted(found, key=lambda support: (weights[list(support)].sum(), support))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the matrix product modulo the prime."""
    total = np.zeros((len(a), b.shape[1]), dtype=np.int64)
    for column, row in zip(a.T, b, strict=True):
        total = (total + column[:, None] % PRIME * (row % PRIME)[None] % PRIME) % PRIME
    return total


def integer_circuits(vectors: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Return the combinations of integer vectors of `circuits`, in the smallest integers."""
    found = []
    for support in circuits(vectors, weights) if len(vectors) else []:
        rest = [c for c in range(vectors.shape[1]) if c not in support]
        exact = DomainMatrix.from_Matrix(sp.Matrix(vectors[:, rest].T.tolist() or [[0] * len(vectors)]))
        combination = integer_rows(exact.convert_to(sp.QQ).nullspace())[0]
        vector = combination @ vectors
        sign = np.sign(np.sign(vector).sum()) or np.sign(vector[support[0]])
        found.append(sign * vector // np.gcd.reduce(vector))
    return found


def integer_rows(matrix: DomainMatrix) -> np.ndarray:
    """Return the rows of a rational matrix, scaled to integers without common factor."""
    rows = matrix.to_Matrix()
    result = np.zeros(rows.shape, dtype=np.int64)
    for i in range(rows.shape[0]):
        row = list(rows.row(i))
        common = math.lcm(*(int(v.q) for v in row))
        result[i] = [int(v * common) for v in row]
        result[i] //= np.gcd.reduce(result[i])
    return result


class Algebra:
    """Field of rational functions that contains given expressions.

    Transcendental functions and roots are represented by variables. Two expressions are equal if their elements are.
    The converse holds for the relations sin² + cos² = 1, cosh² − sinh² = 1, sign² = 1 and powers of roots, not for
    others such as tan = sin/cos. Denominators under roots are assumed to be positive.

    Parameters
    ----------
    expressions : iterable of expressions
    moving : iterable of symbols
        Symbols that vary along a motion. Coefficients of their powers are polynomials of the other symbols.
    """

    def __init__(self, expressions: Iterable[sp.Expr], moving: Iterable[sp.Symbol]):
        self._moving = set(moving)
        self._symbols: dict[sp.Expr, sp.Symbol] = {}
        self._relations: list[sp.Expr] = []
        replaced = [self._replaced(e) for e in expressions]
        self._relate_circles()
        used = set().union(*(e.free_symbols for e in (*replaced, *self._relations)))
        plain = sorted(used - set(self._symbols.values()), key=str)
        generators = [*reversed(self._symbols.values()), *plain]
        # Varying symbols come first, and functions before their arguments, so that relations can be eliminated.
        self.generators = sorted(generators, key=lambda s: s not in self._moving)
        self.size = sum(s in self._moving for s in self.generators)
        self.field = field(self.generators or [sp.Dummy("one")], sp.QQ, "lex")[0]
        self._divisors = [self.field.from_expr(r).numer for r in self._relations]

    def element(self, expression: sp.Expr) -> Any:
        """Return the field element of an expression whose functions occur in the given expressions."""
        return self.field.from_expr(self._replaced(expression))

    def numerators(self, expressions: Sequence[sp.Expr]) -> list[Any]:
        """Return polynomials proportional to the expressions, reduced by the relations."""
        elements = [self.element(e) for e in expressions]
        common = reduce(lambda a, b: a.lcm(b), (e.denom for e in elements))
        found = [e.numer * common.exquo(e.denom) for e in elements]
        return [n.rem(self._divisors) for n in found] if self._divisors else found

    def is_zero(self, expression: sp.Expr) -> bool:
        """Return whether an expression vanishes identically."""
        return not self.numerators([expression])[0]

    def split(self, polynomial: Any) -> dict[tuple[int, ...], dict[tuple[int, ...], Any]]:
        """Return {powers of the varying symbols: {powers of the other generators: coefficient}}."""
        parts: dict[tuple[int, ...], dict[tuple[int, ...], Any]] = {}
        for powers, coefficient in polynomial.terms():
            parts.setdefault(powers[: self.size], {})[powers[self.size :]] = coefficient
        return parts

    def original(self, expression: sp.Expr) -> sp.Expr:
        """Return an expression with the variables replaced by the functions that they represent."""
        back = {symbol: function for function, symbol in self._symbols.items()}
        while expression.free_symbols & set(back):
            expression = expression.xreplace(back)
        return expression

    def _replaced(self, e: sp.Expr) -> sp.Expr:
        if e.is_Rational or e.is_Symbol:
            return e
        if e.is_Add or e.is_Mul:
            return e.func(*map(self._replaced, e.args))
        if e.is_Pow and e.exp.is_Integer:
            return self._replaced(e.base) ** e.exp
        if e.is_Pow and e.exp.is_Rational:
            return self._root(e.base, e.exp.q) ** e.exp.p
        if isinstance(e, sp.exp):
            return self._exponential(sp.expand(sp.cancel(e.exp)))
        arguments = [sp.factor(sp.cancel(a)) if a.free_symbols else a for a in e.args]
        return self._variable(e.func(*arguments) if e.args else e)

    def _exponential(self, exponent: sp.Expr) -> sp.Expr:
        result = sp.S.One
        for term in sp.Add.make_args(exponent):
            number, rest = term.as_coeff_Mul()
            whole = number.p if rest != 1 else sp.S.One
            result *= self._variable(sp.exp(term / whole)) ** whole
        return result

    def _root(self, base: sp.Expr, degree: int) -> sp.Expr:
        above, below = sp.fraction(sp.cancel(base))
        radicand = sp.expand(above * below ** (degree - 1))
        known = len(self._symbols)
        root = self._variable(sp.Pow(radicand, sp.Rational(1, degree), evaluate=False))
        if len(self._symbols) > known:
            self._relations.append(root**degree - self._replaced(radicand))
        return root / self._replaced(below)

    def _variable(self, function: sp.Expr) -> sp.Expr:
        if function.could_extract_minus_sign() and function.is_Mul:
            return -self._variable(-function)
        if function not in self._symbols:
            for argument in function.args:
                self._replaced(argument)
            symbol = sp.Dummy(str(function.func), real=True)
            if function.free_symbols & self._moving:
                self._moving.add(symbol)
            self._symbols[function] = symbol
            if isinstance(function, sp.sign):
                self._relations.append(symbol**2 - 1)
        return self._symbols[function]

    def _relate_circles(self) -> None:
        for odd, even, sign in ((sp.sin, sp.cos, 1), (sp.sinh, sp.cosh, -1)):
            for function, symbol in list(self._symbols.items()):
                if isinstance(function, odd) and (other := self._symbols.get(even(*function.args))):
                    self._relations.append(other**2 + sign * symbol**2 - 1)


Polynomial = dict[tuple[int, ...], Any]


@dataclass(frozen=True)
class Term:
    """Basis element of the infinitesimal transformations of one parameter or state.

    Attributes
    ----------
    name : str
        Name of the parameter or state.
    moves : expression
        Factor of the unknown coefficient: 1 for a parameter; 1, a state, or an input for a state.
    field : dict
        Symbol -> change, including the derivatives of the state.
    is_parameter : bool
    """

    name: str
    moves: sp.Expr
    field: dict[sp.Symbol, sp.Expr]
    is_parameter: bool

    def applied(self, expression: sp.Expr) -> sp.Expr:
        """Return the Lie derivative of an expression."""
        return lie_derivative(self.field, expression)


def lie_derivative(field: Mapping[sp.Symbol, sp.Expr], expression: sp.Expr) -> sp.Expr:
    """Return the derivative of an expression along a vector field, away from kinks."""
    slopes = {s: sp.diff(expression, s).replace(sp.DiracDelta, lambda *_: sp.S.Zero) for s in field}
    return sp.Add(*(move * slopes[symbol] for symbol, move in field.items()))


def terms_of(system: System) -> list[Term]:
    """Return the basis: every parameter, and every state with terms affine in the states and inputs."""
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
    """Determining equations Σ_k z_k (X_k g) − Λ g = 0 and Σ_k z_k (X_k y) = 0, linear in z and Λ at every θ.

    The arguments of signs must keep their signs, which gives further rows like those of g. The coefficients of all
    powers of the varying symbols must vanish separately.

    Attributes
    ----------
    terms : tuple of Term
        The first columns.
    algebra : Algebra
    rows : tuple of dict
        Column -> {powers of the parameters: coefficient}.
    multipliers : tuple of bool
        The other columns: whether the element of Λ is on its diagonal.
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
        return [int(v) for v in np.random.default_rng(1).integers(1, PRIME, len(self.unknowns))]

    @cached_property
    def matrix(self) -> np.ndarray:
        """Rows × columns modulo the prime, at random values of the parameters."""
        matrix = np.zeros((len(self.rows), len(self.terms) + len(self.multipliers)), dtype=np.int64)
        for i, row in enumerate(self.rows):
            for column, polynomial in row.items():
                matrix[i, column] = _modulo(polynomial, self.point)
        return matrix

    def solution(self, support: Iterable[int]) -> dict[int, sp.Expr]:
        """Return the z that vanishes outside the support, as polynomials without common factor.

        The support must determine z up to a factor.
        """
        own = sorted(support)
        columns = [*own, *range(len(self.terms), self.matrix.shape[1])]
        part = self.matrix[:, columns]
        chosen = independent_rows(part)
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
    """Return the coefficients of each power of the varying symbols in a row."""
    parts: dict[tuple[int, ...], dict[int, Polynomial]] = {}
    for column, polynomial in zip(row, algebra.numerators(list(row.values())), strict=True):
        for powers, coefficients in algebra.split(polynomial).items():
            parts.setdefault(powers, {})[column] = coefficients
    return list(parts.values())


def _modulo(polynomial: Polynomial, point: list[int]) -> int:
    total = 0
    for powers, coefficient in polynomial.items():
        value = int(coefficient.numerator) * pow(int(coefficient.denominator), -1, PRIME)
        for base, power in zip(point, powers, strict=True):
            value = value * pow(base, power, PRIME) % PRIME
        total += value
    return total % PRIME


def _primitive(vector: list[sp.Expr]) -> list[sp.Expr]:
    """Return the multiple of a vector of rational functions that consists of polynomials without common factor."""
    common = sp.lcm_list([sp.fraction(sp.together(e))[1] for e in vector])
    whole = [sp.cancel(e * common) for e in vector]
    shared = sp.gcd_list([e for e in whole if e != 0])
    return [sp.factor(sp.cancel(e / shared)) for e in whole]


HEAVY = 100


@dataclass(frozen=True, eq=False)
class Generator:
    """An infinitesimal symmetry.

    Attributes
    ----------
    parameters, states : dict
        Name -> change, of those that change.
    field : dict
        Symbol -> change, including derivatives of the states.
    weights : dict or None
        For scalings, name -> integer ratio of the change to the parameter or state.
    """

    parameters: dict[str, sp.Expr]
    states: dict[str, sp.Expr]
    field: dict[sp.Symbol, sp.Expr]
    weights: dict[str, int] | None = None

    def applied(self, expression: sp.Expr) -> sp.Expr:
        """Return the Lie derivative of an expression."""
        return lie_derivative(self.field, expression)

    def times(self, factor: sp.Expr) -> "Generator":
        """Return the generator multiplied by a function of the parameters."""
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
    """Return a maximal set of symmetries of the parameters that are independent at generic values."""
    scalings = _scalings(equations)
    moves = _moves_of_parameters(equations, scalings)
    count = len(equations.terms)
    vectors = nullspace(equations.matrix)[:, :count]
    heavy = np.array([HEAVY if term.is_parameter else 1 for term in equations.terms])
    parameters = [k for k, term in enumerate(equations.terms) if term.is_parameter]
    wanted = rank(vectors[:, parameters])
    chosen = [_generator(equations, {k: _own(equations, k) * w for k, w in s.items()}, s) for s in scalings]
    for support in circuits(vectors, heavy) if len(chosen) < wanted else []:
        rest = [k for k in range(count) if k not in support]
        (move,) = nullspace(vectors[:, rest].T) if rest else np.ones((1, len(vectors)), dtype=np.int64)
        row = product(move[None], vectors)[:, parameters]
        if rank(np.concatenate([moves, row])) > len(moves):
            moves = np.concatenate([moves, row])
            chosen.append(_generator(equations, equations.solution(support)))
        if len(chosen) == wanted:
            break
    return chosen


def _scalings(equations: Determining) -> list[dict[int, int]]:
    """Return {term: weight} of independent scalings of parameters and states."""
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
    whole = integer_rows(exact.to_sparse().nullspace())
    heavy = np.array([HEAVY if terms[k].is_parameter else 1 for k in columns] + [0] * len(diagonal))
    parameters = [place for place, k in enumerate(columns) if terms[k].is_parameter]
    found: list[dict[int, int]] = []
    taken = np.empty((0, len(parameters)), dtype=np.int64)
    for vector in integer_circuits(whole, heavy):
        if rank(np.concatenate([taken, vector[None, parameters]])) > len(taken):
            taken = np.concatenate([taken, vector[None, parameters]])
            found.append({k: int(w) for k, w in zip(columns, vector, strict=False) if w})
    return found


def _moves_of_parameters(equations: Determining, scalings: list[dict[int, int]]) -> np.ndarray:
    """Return the changes of the parameters by the scalings, modulo the prime at the point of the matrix."""
    values = dict(zip(equations.unknowns, equations.point, strict=True))
    parameters = [k for k, term in enumerate(equations.terms) if term.is_parameter]
    rows = [[s.get(k, 0) * values[_own(equations, k)] % PRIME for k in parameters] for s in scalings]
    return np.array(rows, dtype=np.int64).reshape(len(scalings), len(parameters))


def _own(equations: Determining, term: int) -> sp.Symbol:
    """Return the symbol of the parameter or state of a term."""
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
