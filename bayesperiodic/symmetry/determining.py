"""Symbolic equations of a model, and their Lie symmetries by determining equations, solved by exact linear algebra."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np
import sympy as sp
from sympy.logic.boolalg import BooleanFunction
from sympy.polys.fields import field
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.models.model import Model

PRIME = 2_147_483_629
PARAMETER_WEIGHT = 100


@dataclass(frozen=True)
class System:
    """Equations g = 0 and measured outputs y of states, inputs, time and parameters."""

    # 1 or 2, of the states that the measured outputs depend on; 0 if known parameters removed the derivatives.
    orders: dict[str, int]
    inputs: tuple[str, ...]
    symbols: dict[str, sp.Symbol]  # jet variables: of states ("x", "dx", "ddx"), inputs, "tau" and "frequency"
    parameters: dict[str, sp.Symbol]  # the unknown ones
    known: dict[str, sp.Symbol]  # the known parameters
    equations: tuple[sp.Expr, ...]
    outputs: dict[str, sp.Expr]

    @property
    def expressions(self) -> tuple[sp.Expr, ...]:
        """The equations and the measured outputs."""
        return *self.equations, *self.outputs.values()

    @property
    def used(self) -> set[sp.Symbol]:
        """The symbols in the equations and the measured outputs."""
        return set().union(*(e.free_symbols for e in self.expressions))

    @property
    def signs(self) -> set[sp.Expr]:
        """The signs in the equations and the measured outputs."""
        return set().union(*(e.atoms(sp.sign) for e in self.expressions))

    @property
    def highest(self) -> list[sp.Symbol]:
        """The highest derivative of each state."""
        return [self.symbols["d" * order + state] for state, order in self.orders.items()]

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
            equations=tuple(with_signs(e) for e in model.equations),
            outputs={name: with_signs(expressions[name]) for name in outputs},
        )
    )


def _observed(system: System) -> System:
    """Return the system without the states and equations that no measured output depends on; update the orders."""
    used = system.used
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


def with_signs(expression: sp.Expr) -> sp.Expr:
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


def _reduced(matrix: np.ndarray) -> tuple[np.ndarray, list[int]]:
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


def _rank(matrix: np.ndarray) -> int:
    return len(_reduced(matrix)[1])


def nullspace(matrix: np.ndarray) -> np.ndarray:
    """Return vectors (nullity, columns) that span the null space modulo the prime."""
    rows, pivots = _reduced(matrix)
    columns = matrix.shape[1]
    free = [c for c in range(columns) if c not in pivots]
    vectors = np.zeros((len(free), columns), dtype=np.int64)
    for vector, column in zip(vectors, free, strict=True):
        vector[column] = 1
        vector[pivots] = -rows[:, column] % PRIME
    return vectors


def _circuits(vectors: np.ndarray, weights: np.ndarray, tries: int = 200) -> list[tuple[int, ...]]:
    """Return supports of combinations of the vectors that contain no smaller support, the lightest first.

    The rows of reduced echelon forms are such combinations; the orders of the columns are random, with a fixed seed.
    """
    random = np.random.default_rng(0)
    supports: set[tuple[int, ...]] = set()
    columns = vectors.shape[1]
    for trial in range(tries if len(vectors) > 1 else 1):
        # Heavy columns are the first pivots, so that each appears in one row only.
        order = np.lexsort((random.permutation(columns), -weights)) if trial % 2 else random.permutation(columns)
        for row in _reduced(vectors[:, order])[0]:
            supports.add(tuple(sorted(int(c) for c in order[np.flatnonzero(row)])))
    return sorted(supports, key=lambda support: (weights[list(support)].sum(), support))


def integer_circuits(vectors: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Return combinations of integer vectors with minimal supports, in the smallest integers."""
    circuits = []
    for support in _circuits(vectors, weights) if len(vectors) else []:
        rest = [c for c in range(vectors.shape[1]) if c not in support]
        exact = DomainMatrix.from_Matrix(sp.Matrix(vectors[:, rest].T.tolist() or [[0] * len(vectors)]))
        combination = integer_rows(exact.convert_to(sp.QQ).nullspace())[0]
        vector = combination @ vectors
        sign = np.sign(np.sign(vector).sum()) or np.sign(vector[support[0]])
        circuits.append(sign * vector // np.gcd.reduce(vector))
    return circuits


def integer_rows(matrix: DomainMatrix) -> np.ndarray:
    """Return the rows of a rational matrix, scaled to integers without common factor."""
    result = np.zeros(matrix.shape, dtype=np.int64)
    for i, row in enumerate(matrix.to_Matrix().tolist()):
        common = math.lcm(*(int(v.q) for v in row))
        result[i] = [int(v * common) for v in row]
        result[i] //= np.gcd.reduce(result[i])
    return result


Polynomial = dict[tuple[int, ...], Any]


class Algebra:
    """Field of rational functions that contains given expressions.

    Transcendental functions and roots are represented by variables. Two expressions are equal if their elements are.
    The converse holds for the relations sin² + cos² = 1, cosh² − sinh² = 1, sign² = 1 and powers of roots, not for
    others such as tan = sin/cos. Denominators under roots are assumed to be positive. Coefficients of powers of the
    `moving` symbols, which vary along a motion, are polynomials of the other symbols.
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

    def numerators(self, expressions: Sequence[sp.Expr]) -> list[Any]:
        """Return polynomials proportional to expressions of known functions, reduced by the relations."""
        elements = [self.field.from_expr(self._replaced(e)) for e in expressions]
        common = reduce(lambda a, b: a.lcm(b), (e.denom for e in elements))
        numerators = [e.numer * common.exquo(e.denom) for e in elements]
        return [n.rem(self._divisors) for n in numerators] if self._divisors else numerators

    def is_zero(self, expression: sp.Expr) -> bool:
        """Return whether an expression vanishes identically."""
        return not self.numerators([expression])[0]

    def split(self, polynomial: Any) -> dict[tuple[int, ...], Polynomial]:
        """Return {powers of the varying symbols: {powers of the other generators: coefficient}}."""
        parts: dict[tuple[int, ...], Polynomial] = {}
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


@dataclass(frozen=True)
class BasisField:
    """Basis element of the infinitesimal transformations of one parameter or state."""

    name: str
    moves: sp.Expr  # factor of the unknown coefficient: 1 for a parameter; 1, a state, or an input for a state
    field: dict[sp.Symbol, sp.Expr]  # change of each symbol, including the derivatives of the state
    is_parameter: bool

    @property
    def symbol(self) -> sp.Symbol:
        """The symbol of the parameter or state."""
        return next(iter(self.field))


def lie_derivative(field: Mapping[sp.Symbol, sp.Expr], expression: sp.Expr) -> sp.Expr:
    """Return the derivative of an expression along a vector field, away from kinks."""
    slopes = {s: sp.diff(expression, s).replace(sp.DiracDelta, lambda *_: sp.S.Zero) for s in field}
    return sp.Add(*(move * slopes[symbol] for symbol, move in field.items()))


def _terms(system: System) -> list[BasisField]:
    """Return the basis: every parameter, and every state with terms affine in the states and inputs."""
    basis = [BasisField(n, sp.S.One, {s: sp.S.One}, True) for n, s in system.parameters.items()]
    signals = [(n, order) for n, order in system.orders.items()] + [(n, 2) for n in system.inputs]
    for state, order in system.orders.items():
        targets = [system.symbols["d" * k + state] for k in range(order + 1)]
        chains = [[sp.S.One, *[sp.S.Zero] * order]]
        for name, highest in signals:
            jets = [system.symbols["d" * k + name] for k in range(highest + 1)]
            chains += [jets[k : k + order + 1] for k in range(highest - order + 1)]
        basis += [BasisField(state, c[0], dict(zip(targets, c, strict=True)), False) for c in chains]
    return basis


@dataclass(frozen=True)
class Determining:
    """Determining equations Σ_k z_k (X_k g) − Λ g = 0 and Σ_k z_k (X_k y) = 0, linear in z and Λ at every θ.

    The arguments of signs must keep their signs, which gives further rows like those of g. The coefficients of all
    powers of the varying symbols must vanish separately.
    """

    terms: tuple[BasisField, ...]  # the first columns
    algebra: Algebra
    rows: tuple[dict[int, Polynomial], ...]  # by column
    multipliers: tuple[bool, ...]  # the other columns: whether the element of Λ is on its diagonal

    @property
    def parameters(self) -> list[int]:
        """The terms of parameters."""
        return [k for k, term in enumerate(self.terms) if term.is_parameter]

    @property
    def weights(self) -> np.ndarray:
        """Weights of the terms, by which transformations of few parameters are preferred, (terms,)."""
        return np.array([PARAMETER_WEIGHT if term.is_parameter else 1 for term in self.terms])

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
        places = sorted(support)
        columns = [*places, *range(len(self.terms), self.matrix.shape[1])]
        part = self.matrix[:, columns]
        chosen = _reduced(part.T)[1]
        domain = sp.QQ[tuple(self.unknowns)]
        entries = [[domain.ring.from_dict(dict(self.rows[i].get(c, {}))) for c in columns] for i in chosen]
        matrix = DomainMatrix(entries, (len(chosen), len(columns)), domain)
        vector = matrix.to_field().to_sparse().nullspace().to_Matrix().row(0)
        exact = _primitive(list(vector)[: len(places)])
        return {c: self.algebra.original(e) for c, e in zip(places, exact, strict=True) if e != 0}


def determining_equations(system: System) -> Determining:
    """Return the determining equations of a system."""
    terms = _terms(system)
    groups = [system.equations, *((s.args[0],) for s in sorted(system.signs, key=sp.default_sort_key))]
    multipliers: list[bool] = []
    table: list[dict[int, sp.Expr]] = []
    for group in groups:
        for i, expression in enumerate(group):
            first = len(terms) + len(multipliers)
            multiplied = {first + j: -other for j, other in enumerate(group)}
            table.append({k: lie_derivative(t.field, expression) for k, t in enumerate(terms)} | multiplied)
            multipliers += [i == j for j in range(len(group))]
    table += [{k: lie_derivative(t.field, y) for k, t in enumerate(terms)} for y in system.outputs.values()]
    expressions = [e for row in table for e in row.values()]
    algebra = Algebra([*expressions, *system.parameters.values()], system.symbols.values())
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


@dataclass(frozen=True, eq=False)
class Generator:
    """An infinitesimal symmetry: the changes of the parameters and states that change."""

    parameters: dict[str, sp.Expr]
    states: dict[str, sp.Expr]
    field: dict[sp.Symbol, sp.Expr]  # by symbol, including derivatives of the states
    scaling: bool = False

    @property
    def _parts(self) -> tuple[dict, dict, dict]:
        return self.parameters, self.states, self.field

    def times(self, factor: sp.Expr) -> "Generator":
        """Return the generator multiplied by a function of the parameters."""
        parameters, states, moves = ({k: sp.factor(v * factor) for k, v in part.items()} for part in self._parts)
        return Generator(parameters, states, moves)

    def minus(self, other: "Generator", factor: sp.Expr) -> "Generator":
        """Return self − factor · other."""

        def difference(these: dict, its: dict) -> dict:
            moves = {k: sp.factor(these.get(k, 0) - factor * its.get(k, 0)) for k in dict.fromkeys((*these, *its))}
            return {k: v for k, v in moves.items() if v != 0}

        parameters, states, moves = map(difference, self._parts, other._parts)
        return Generator(parameters, states, moves)


def generators_of(equations: Determining) -> list[Generator]:
    """Return a maximal set of symmetries of the parameters that are independent at generic values."""
    terms, parameters, scalings = equations.terms, equations.parameters, _scalings(equations)
    values = dict(zip(equations.unknowns, equations.point, strict=True))
    rows = [[scaling.get(k, 0) * values[terms[k].symbol] % PRIME for k in parameters] for scaling in scalings]
    moves = np.array(rows, dtype=np.int64).reshape(len(scalings), len(parameters))
    vectors = nullspace(equations.matrix)[:, : len(terms)]
    wanted = _rank(vectors[:, parameters])
    chosen = [_generator(equations, {k: terms[k].symbol * w for k, w in s.items()}, s) for s in scalings]
    for support in _circuits(vectors, equations.weights) if len(chosen) < wanted else []:
        rest = [k for k in range(len(terms)) if k not in support]
        (move,) = nullspace(vectors[:, rest].T) if rest else np.ones((1, len(vectors)), dtype=np.int64)
        row = (move[:, None] * vectors[:, parameters] % PRIME).sum(axis=0) % PRIME
        if _rank(np.vstack([moves, row])) > len(moves):
            moves = np.vstack([moves, row])
            chosen.append(_generator(equations, equations.solution(support)))
        if len(chosen) == wanted:
            break
    return chosen


def _scalings(equations: Determining) -> list[dict[int, int]]:
    """Return {term: weight} of independent scalings of parameters and states."""
    terms = equations.terms
    columns = [k for k, t in enumerate(terms) if t.is_parameter or t.moves == t.symbol]
    diagonal = [len(terms) + j for j, on in enumerate(equations.multipliers) if on]
    index = {k: equations.unknowns.index(terms[k].symbol) for k in equations.parameters}
    table: list[dict[int, sp.Rational]] = []
    for row in equations.rows:
        parts: dict[tuple[int, ...], dict[int, sp.Rational]] = {}
        for place, column in enumerate([*columns, *diagonal]):
            for powers, coefficient in row.get(column, {}).items():
                raised = tuple(p + (i == index.get(column)) for i, p in enumerate(powers))
                parts.setdefault(raised, {})[place] = coefficient
        table += parts.values()
    size = len(columns) + len(diagonal)
    exact = DomainMatrix([[sp.QQ(row.get(c, 0)) for c in range(size)] for row in table], (len(table), size), sp.QQ)
    whole = integer_rows(exact.to_sparse().nullspace())
    parameters = [place for place, k in enumerate(columns) if terms[k].is_parameter]
    scalings: list[dict[int, int]] = []
    taken = np.empty((0, len(parameters)), dtype=np.int64)
    for vector in integer_circuits(whole, np.append(equations.weights[columns], np.zeros(len(diagonal), dtype=int))):
        if _rank(np.vstack([taken, vector[parameters]])) > len(taken):
            taken = np.vstack([taken, vector[parameters]])
            scalings.append({k: int(w) for k, w in zip(columns, vector, strict=False) if w})
    return scalings


def _generator(
    equations: Determining, moves: Mapping[int, sp.Expr], weights: Mapping[int, int] | None = None
) -> Generator:
    parameters: dict[str, sp.Expr] = {}
    states: dict[str, sp.Expr] = {}
    field: dict[sp.Symbol, sp.Expr] = {}
    for k, move in moves.items():
        term = equations.terms[k]
        part = parameters if term.is_parameter else states
        part[term.name] = part.get(term.name, sp.S.Zero) + move * (1 if weights else term.moves)
        for symbol, rate in term.field.items():
            field[symbol] = field.get(symbol, sp.S.Zero) + (weights[k] * symbol if weights else move * rate)
    return Generator(parameters, states, field, bool(weights))
