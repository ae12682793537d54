"""Symbolic equations of a model, and their Lie symmetries by determining equations, solved by exact linear algebra."""

import math
from collections import defaultdict
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
MOST_TRIALS = 200
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
        return [self.jet(state, order)[-1] for state, order in self.orders.items()]

    @property
    def names(self) -> dict[sp.Symbol, str]:
        """The names of the parameters, the unknown ones first."""
        return {symbol: name for name, symbol in (self.parameters | self.known).items()}

    def jet(self, name: str, order: int = 2) -> list[sp.Symbol]:
        """Return the symbols of a state or an input and of its derivatives up to an order."""
        return [self.symbols["d" * k + name] for k in range(order + 1)]

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
    used, count = system.used, -1
    equations: list[sp.Expr] = []
    orders = {s: max((k for k, symbol in enumerate(system.jet(s)) if symbol in used), default=0) for s in system.orders}
    while len(equations) > count:
        count = len(equations)
        symbols = set().union(*(e.free_symbols for e in (*system.outputs.values(), *equations)))
        states = {s: order for s, order in orders.items() if symbols & set(system.jet(s))}
        highest = {system.jet(s, order)[-1] for s, order in states.items()}
        equations = [g for g in system.equations if g.free_symbols & highest]
    return replace(system, orders=states, equations=tuple(equations))


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


def _reduced(matrix: np.ndarray, modulus: int) -> tuple[np.ndarray, list[int]]:
    """Return the reduced row echelon form of an integer matrix modulo a prime, and its pivot columns."""
    rows = np.array(matrix, dtype=np.int64) % modulus
    pivots: list[int] = []
    for column in range(rows.shape[1]):
        top = len(pivots)
        below = np.flatnonzero(rows[top:, column])
        if not below.size:
            continue
        rows[[top, top + below[0]]] = rows[[top + below[0], top]]
        rows[top] = rows[top] * pow(int(rows[top, column]), -1, modulus) % modulus
        others = np.flatnonzero(rows[:, column])
        others = others[others != top]
        rows[others] = (rows[others] - rows[others, column, None] * rows[top] % modulus) % modulus
        pivots.append(column)
    return rows[: len(pivots)], pivots


def independent(rows: Sequence | np.ndarray, columns: int, modulus: int = PRIME) -> list[int]:
    """Return the positions of the rows that are no combination of those before, modulo a prime."""
    return _reduced(np.array(rows, dtype=np.int64).reshape(len(rows), columns).T, modulus)[1]


def nullspace(matrix: np.ndarray, modulus: int = PRIME) -> np.ndarray:
    """Return vectors (nullity, columns) that span the null space modulo a prime."""
    rows, pivots = _reduced(matrix, modulus)
    free = [c for c in range(matrix.shape[1]) if c not in pivots]
    vectors = np.eye(matrix.shape[1], dtype=np.int64)[free]
    vectors[:, pivots] = -rows[:, free].T % modulus
    return vectors


def _circuits(vectors: np.ndarray, weights: np.ndarray) -> list[tuple[int, ...]]:
    """Return supports of combinations of the vectors that contain no smaller support, the lightest first.

    The rows of reduced echelon forms are such combinations; the orders of the columns are random, with a fixed seed.
    """
    random = np.random.default_rng(0)
    supports: set[tuple[int, ...]] = set()
    columns = vectors.shape[1]
    for trial in range(MOST_TRIALS if len(vectors) > 1 else 1):
        # Heavy columns are the first pivots, so that each appears in one row only.
        order = np.lexsort((random.permutation(columns), -weights)) if trial % 2 else random.permutation(columns)
        for row in _reduced(vectors[:, order], PRIME)[0]:
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
    result = np.array(matrix.clear_denoms_rowwise()[1].to_Matrix().tolist(), dtype=np.int64).reshape(matrix.shape)
    return result // np.gcd.reduce(result, axis=1, keepdims=True)


Polynomial = Mapping[tuple[int, ...], Any]  # coefficients by the powers of the symbols
VectorField = dict[sp.Symbol, sp.Expr]  # changes of symbols, including the derivatives of states


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
        for odd, even, sign in ((sp.sin, sp.cos, 1), (sp.sinh, sp.cosh, -1)):
            for function, symbol in self._symbols.items():
                if isinstance(function, odd) and (other := self._symbols.get(even(*function.args))):
                    self._relations.append(other**2 + sign * symbol**2 - 1)
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


def lie_derivative(field: VectorField, expression: sp.Expr) -> sp.Expr:
    """Return the derivative of an expression along a vector field, away from kinks."""
    slopes = {s: sp.diff(expression, s).replace(sp.DiracDelta, lambda *_: sp.S.Zero) for s in field}
    return sp.Add(*(move * slopes[symbol] for symbol, move in field.items()))


def _terms(system: System) -> list[VectorField]:
    """Return the basis: a change of every parameter, and changes of every state that are affine in states and inputs.

    The parameter or state is the first symbol of each.
    """
    basis = [{symbol: sp.S.One} for symbol in system.parameters.values()]
    signals = [*system.orders.items(), *((name, 2) for name in system.inputs)]
    for state, order in system.orders.items():
        chains = [[sp.S.One, *[sp.S.Zero] * order]]
        for name, highest in signals:
            chains += [system.jet(name, highest)[k : k + order + 1] for k in range(highest - order + 1)]
        basis += [dict(zip(system.jet(state, order), chain, strict=True)) for chain in chains]
    return basis


@dataclass(frozen=True)
class Determining:
    """Determining equations Σ_k z_k (X_k g) − Λ g = 0 and Σ_k z_k (X_k y) = 0, linear in z and Λ at every θ.

    The arguments of signs must keep their signs, which gives further rows like those of g. The coefficients of all
    powers of the varying symbols must vanish separately.
    """

    terms: list[VectorField]  # the first columns
    parameters: range  # the terms of parameters, which come first
    algebra: Algebra
    rows: list[Mapping[int, Polynomial]]  # by column
    multipliers: list[bool]  # the other columns: whether the element of Λ is on its diagonal

    @property
    def symbols(self) -> list[sp.Symbol]:
        """The parameter or state that each term changes."""
        return [next(iter(term)) for term in self.terms]

    @property
    def weights(self) -> np.ndarray:
        """Weights of the terms, by which transformations of few parameters are preferred, (terms,)."""
        return np.where(np.arange(len(self.terms)) < len(self.parameters), PARAMETER_WEIGHT, 1)

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
        chosen = independent(self.matrix[:, columns], len(columns))
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
            table.append({k: lie_derivative(term, expression) for k, term in enumerate(terms)} | multiplied)
            multipliers += [i == j for j in range(len(group))]
    table += [{k: lie_derivative(term, y) for k, term in enumerate(terms)} for y in system.outputs.values()]
    expressions = [e for row in table for e in row.values()]
    algebra = Algebra([*expressions, *system.parameters.values()], system.symbols.values())
    rows = [part for row in table for part in _coefficients(row, algebra)]
    return Determining(terms, range(len(system.parameters)), algebra, rows, multipliers)


def _coefficients(row: Mapping[int, sp.Expr], algebra: Algebra) -> list[Mapping[int, Polynomial]]:
    """Return, for each power of the varying symbols, the coefficients in the columns of a row."""
    parts: Any = defaultdict(lambda: defaultdict(dict))
    for column, polynomial in zip(row, algebra.numerators(list(row.values())), strict=True):
        for powers, coefficient in polynomial.terms():
            parts[powers[: algebra.size]][column][powers[algebra.size :]] = coefficient
    return list(parts.values())


def _modulo(polynomial: Polynomial, point: list[int]) -> int:
    total = 0
    for powers, coefficient in polynomial.items():
        monomial = math.prod(pow(base, power, PRIME) for base, power in zip(point, powers, strict=True))
        total += int(coefficient.numerator) * pow(int(coefficient.denominator), -1, PRIME) * monomial
    return total % PRIME


def _primitive(vector: list[sp.Expr]) -> list[sp.Expr]:
    """Return the multiple of a vector of rational functions that consists of polynomials without common factor."""
    common = sp.lcm_list([sp.fraction(sp.together(e))[1] for e in vector])
    whole = [sp.cancel(e * common) for e in vector]
    shared = sp.gcd_list([e for e in whole if e != 0])
    return [sp.factor(sp.cancel(e / shared)) for e in whole]


@dataclass(frozen=True, eq=False)
class Generator:
    """An infinitesimal symmetry."""

    field: VectorField  # without zeros, parameters first
    scaling: bool = False

    def times(self, factor: sp.Expr) -> "Generator":
        """Return the generator multiplied by a function of the parameters."""
        return Generator({s: sp.factor(move * factor) for s, move in self.field.items()})

    def minus(self, other: "Generator", factor: sp.Expr) -> "Generator":
        """Return self − factor · other."""
        moves = {s: self.field.get(s, 0) - factor * other.field.get(s, 0) for s in self.field | other.field}
        return Generator({s: reduced for s, move in moves.items() if (reduced := sp.factor(move)) != 0})


def generators_of(equations: Determining) -> list[Generator]:
    """Return a maximal set of symmetries of the parameters that are independent at generic values."""
    parameters, symbols, scalings = equations.parameters, equations.symbols, _scalings(equations)
    values = dict(zip(equations.unknowns, equations.point, strict=True))
    rows = [[weights.get(k, 0) * values[symbols[k]] % PRIME for k in parameters] for weights in scalings]
    vectors = nullspace(equations.matrix)[:, : len(symbols)]
    wanted = len(independent(vectors[:, parameters], len(parameters)))
    supports = _circuits(vectors, equations.weights) if len(rows) < wanted else []
    for support in supports:
        rest = [k for k in range(len(symbols)) if k not in support]
        (move,) = nullspace(vectors[:, rest].T)
        rows.append(list((move[:, None] * vectors[:, parameters] % PRIME).sum(axis=0) % PRIME))
    generators = []
    for i in independent(rows, len(parameters)):
        if i < len(scalings):
            moves = {k: w * symbols[k] if k in parameters else sp.Integer(w) for k, w in scalings[i].items()}
        else:
            moves = equations.solution(supports[i - len(scalings)])
        field: VectorField = {}
        for k, move in moves.items():
            for symbol, rate in equations.terms[k].items():
                field[symbol] = field.get(symbol, sp.S.Zero) + move * rate
        generators.append(Generator({s: move for s, move in field.items() if move != 0}, i < len(scalings)))
    return generators


def _scalings(equations: Determining) -> list[dict[int, int]]:
    """Return {term: weight} of independent scalings of parameters and states."""
    parameters, symbols = equations.parameters, equations.symbols
    columns = [k for k, s in enumerate(symbols) if k in parameters or equations.terms[k][s] == s]
    diagonal = [len(symbols) + j for j, on in enumerate(equations.multipliers) if on]
    index = {k: equations.unknowns.index(symbols[k]) for k in parameters}
    table: list[dict[int, sp.Rational]] = []
    for row in equations.rows:
        parts: dict[tuple[int, ...], dict[int, sp.Rational]] = defaultdict(dict)
        for place, column in enumerate([*columns, *diagonal]):
            for powers, coefficient in row.get(column, {}).items():
                raised = tuple(p + (i == index.get(column)) for i, p in enumerate(powers))
                parts[raised][place] = coefficient
        table += parts.values()
    size = len(columns) + len(diagonal)
    exact = DomainMatrix([[sp.QQ(row.get(c, 0)) for c in range(size)] for row in table], (len(table), size), sp.QQ)
    whole = integer_rows(exact.to_sparse().nullspace())
    circuits = integer_circuits(whole, np.append(equations.weights[columns], np.zeros(len(diagonal), dtype=int)))
    chosen = independent([vector[: len(parameters)] for vector in circuits], len(parameters))
    return [{k: int(w) for k, w in zip(columns, circuits[i], strict=False) if w} for i in chosen]
