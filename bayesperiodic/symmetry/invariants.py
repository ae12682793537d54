"""Unidentifiable directions of the parameters, finite symmetry transformations, and identifiable combinations."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.symmetry import determining
from bayesperiodic.symmetry.determining import Algebra, Generator
from bayesperiodic.symmetry.system import System, null_directions

SMALL = 1e-7


@dataclass(frozen=True)
class Directions:
    """Parameter directions without effect on the outputs.

    Attributes
    ----------
    rows : array (directions, parameters)
        Orthonormal in the logarithms of the parameters.
    names : tuple of str
        The parameters.
    values : dict
        Symbol -> value, including known parameters.
    points : int
        Number of parameter values with sensitivities; 0 if the rows are those of the symmetries.
    unexplained : tuple of str
        Parameters in directions that no symmetry explains.
    """

    rows: np.ndarray
    names: tuple[str, ...]
    values: dict[sp.Symbol, float]
    points: int = 0
    unexplained: tuple[str, ...] = ()

    @property
    def moved(self) -> list[str]:
        """The parameters that are not determined."""
        return [n for n, column in zip(self.names, self.rows.T, strict=True) if np.any(np.abs(column) > SMALL)]

    def alone(self, name: str) -> bool:
        """Return whether a parameter can change without any other."""
        column = self.names.index(name)
        return _rank(np.delete(self.rows, column, axis=1)) < len(self.rows)

    def partners(self, name: str) -> list[str]:
        """Return the other parameters that are fixed if this one is."""
        columns = dict(zip(self.names, self.rows.T, strict=True))
        return [n for n in self.moved if n != name and _rank(np.array([columns[name], columns[n]])) == 1]

    def smallest_set(self) -> tuple[str, ...]:
        """Return the first parameters that, if fixed, leave no direction."""
        chosen: list[int] = []
        for column in range(len(self.names)):
            if _rank(self.rows[:, [*chosen, column]]) > len(chosen):
                chosen.append(column)
        return tuple(self.names[column] for column in chosen)

    def slope(self, expression: sp.Expr, symbols: Sequence[sp.Symbol]) -> np.ndarray:
        """Return the derivatives of an expression with respect to log-parameters, the largest one scaled to ±1."""
        slope = np.array([float((s * sp.diff(expression, s)).subs(self.values)) for s in symbols])
        return slope / max(np.abs(slope).max(initial=0.0), np.finfo(float).tiny)

    def preserve(self, expression: sp.Expr, symbols: Sequence[sp.Symbol]) -> bool:
        """Return whether an expression is constant along all directions."""
        return bool(np.all(np.abs(self.rows @ self.slope(expression, symbols)) < SMALL))


def directions_of(system: System, generators: Sequence[Generator]) -> Directions:
    """Return the smallest set of directions by sensitivities, or those of the symmetries if there are none."""
    symbols = (*system.parameters.values(), *system.known.values())
    general = {s: 0.5 + (0.618 * k) % 1 for k, s in enumerate(symbols, 1)}
    names = tuple(system.parameters)
    found = null_directions(system) if names else []
    if not found:
        return Directions(_explained(system, generators, general), names, general)
    values, rows = min(found, key=lambda pair: len(pair[1]))
    explained = _explained(system, generators, values)
    rest = rows - rows @ explained.T @ explained
    unexplained = tuple(n for n, size in zip(names, np.abs(rest).max(axis=0, initial=0.0), strict=True) if size > SMALL)
    if unexplained and _has_moving_switches(system):
        return Directions(explained, names, values)
    return Directions(rows, names, values, len(found), unexplained)


def _explained(system: System, generators: Sequence[Generator], values: dict[sp.Symbol, float]) -> np.ndarray:
    moves = [[g.parameters.get(n, sp.S.Zero) / s for n, s in system.parameters.items()] for g in generators]
    slopes = np.array([[float(move.subs(values)) for move in row] for row in moves])
    return np.linalg.qr(slopes.reshape(len(generators), len(system.parameters)).T)[0].T


def _has_moving_switches(system: System) -> bool:
    """Return whether the location of a discontinuity may depend on a parameter."""
    switches = set().union(*(e.atoms(sp.sign) for e in (*system.equations, *system.outputs.values())))
    return any(switch.free_symbols & set(system.parameters.values()) for switch in switches)


def _rank(matrix: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=SMALL)) if matrix.size else 0


LONGEST = 5
POWERS = (1, -1, 2)


@dataclass(frozen=True)
class Flow:
    """A one-parameter group of transformations.

    Attributes
    ----------
    generator : Generator
        Generator in the normalisation of the transformation.
    amount : symbol
        Group parameter: a factor > 0 for scalings, otherwise a real number, 0 for the identity.
    images : dict
        Symbol -> image, for parameters, states and derivatives of states that change.
    factor : Matrix or None
        Factor of the transformed equations; None until the flow is verified.
    """

    generator: Generator
    amount: sp.Symbol
    images: dict[sp.Symbol, sp.Expr]
    factor: sp.Matrix | None = None

    def of(self, expression: sp.Expr) -> sp.Expr:
        """Return the image of an expression."""
        return expression.subs(self.images, simultaneous=True)


def flow_of(generator: Generator) -> Flow | None:
    """Return the finite transformation of a symmetry, if one of several normalisations has a closed form.

    The form of scalings is known. For others, the Lie series exp(δ X) of every symbol, its reciprocal or its square
    must terminate or be an exponential series.
    """
    if generator.weights is not None:
        factor = sp.Symbol("t", positive=True)
        images = {s: s * factor ** int(sp.cancel(move / s)) for s, move in generator.field.items() if move != 0}
        return Flow(generator, factor, images)
    amount = sp.Symbol("delta", real=True)
    moves = [*generator.parameters.values(), *generator.states.values()]
    constant = [move for move in moves if move.is_number]
    for unit in dict.fromkeys([*constant, sp.S.One, *sorted(generator.parameters.values(), key=sp.count_ops)]):
        scaled = generator.times(1 / unit)
        images = {}
        for symbol in (s for s, move in scaled.field.items() if move != 0):
            image = _image(scaled, symbol, amount)
            if image is None:
                break
            images[symbol] = image
        else:
            return _with_factor(Flow(scaled, amount, images))
    return None


def _with_factor(flow: Flow) -> Flow:
    """Return the flow in terms of t = exp(δ), if δ appears only in this form."""
    factor = sp.Symbol("t", positive=True)
    images = {s: e.subs(flow.amount, sp.log(factor)) for s, e in flow.images.items()}
    images = {s: _shortest(sp.powsimp(sp.expand_log(e))) for s, e in images.items()}
    if any(e.has(sp.log) for e in images.values()):
        return flow
    return Flow(flow.generator, factor, images)


def verified(system: System, flow: Flow) -> Flow | None:
    """Return the flow with the factor of the equations if exact substitution confirms it, else None.

    The outputs must be identical, and the transformed equations the old ones times an invertible matrix.
    """
    images = [flow.of(g) for g in system.equations]
    changes = [flow.of(y) - y for y in system.outputs.values()]
    highest = [system.symbols["d" * n + s] for s, n in system.orders.items()]
    before, after = sp.Matrix(system.equations), sp.Matrix(images)
    algebra = Algebra([*before, *after, *changes, *flow.images.values()], system.jets)
    if not all(algebra.is_zero(change) for change in changes):
        return None
    if not highest:
        return Flow(flow.generator, flow.amount, flow.images, sp.Matrix(0, 0, []))
    try:
        factor = (after.jacobian(highest) * before.jacobian(highest).inv()).applyfunc(sp.factor)
    except sp.matrices.exceptions.NonInvertibleMatrixError:
        return None
    if factor.det() == 0 or not all(algebra.is_zero(e) for e in after - factor * before):
        return None
    return Flow(flow.generator, flow.amount, flow.images, factor)


def _image(generator: Generator, symbol: sp.Symbol, amount: sp.Symbol) -> sp.Expr | None:
    for power in POWERS:
        image = _series(generator, symbol**power, amount)
        if image is not None and power == 2:
            return sp.sqrt(_shortest(image))
        if image is not None:
            return _shortest(image**power)
    return None


def _shortest(expression: sp.Expr) -> sp.Expr:
    factored = sp.factor(expression)
    if sp.fraction(factored)[1].atoms(sp.Add):
        return factored
    return min(sp.expand(expression), factored, key=sp.count_ops)


def _series(generator: Generator, start: sp.Expr, amount: sp.Symbol) -> sp.Expr | None:
    """Return exp(δ X) f if X^(n+1) f = c X^n f for a small n and an invariant c of X, which may be 0."""
    total, term = sp.S.Zero, start
    for order in range(LONGEST):
        following = sp.cancel(generator.applied(term))
        rate = sp.cancel(following / term)
        if following == 0:
            return total + amount**order / sp.factorial(order) * term
        if sp.cancel(generator.applied(rate)) == 0:
            begun = sum((rate * amount) ** j / sp.factorial(j) for j in range(order))
            return total + term * (sp.exp(rate * amount) - begun) / rate**order
        total += amount**order / sp.factorial(order) * term
        term = following
    return None


AWKWARD = 5


def coefficients_of(system: System) -> dict[sp.Expr, bool]:
    """Return the coefficients of the equations and outputs, and whether each belongs to a forcing term.

    An equation is first divided by the coefficient of its highest derivative. Arguments of functions are included.
    """
    highest = [system.symbols["d" * n + s] for s, n in system.orders.items()]
    parameters = (*system.parameters.values(), *system.known.values())
    drive = {system.symbols["tau"], *(system.symbols[d + n] for d in ("", "d", "dd") for n in system.inputs)}
    moving = set(system.jets)
    found: dict[sp.Expr, bool] = {}

    def collect(expression: sp.Expr) -> None:
        parts: dict[sp.Expr, sp.Expr] = {}
        for term in sp.Add.make_args(sp.expand(expression)):
            coefficient, rest = term.as_independent(*moving, as_Add=False)
            parts[rest] = parts.get(rest, sp.S.Zero) + coefficient
        leading = next((parts[h] for h in highest if h in parts), sp.S.One)
        for rest, coefficient in parts.items():
            ratio = sp.factor(sp.cancel(coefficient / leading)).as_independent(*parameters, as_Add=False)[1]
            if ratio.free_symbols:
                found[ratio] = found.get(ratio, False) or bool(rest.free_symbols & drive)
            for function in sorted(rest.atoms(sp.Function), key=sp.default_sort_key):
                for argument in function.args:
                    collect(argument)

    for expression in (*system.equations, *system.outputs.values()):
        collect(expression)
    return found


def combinations_of(
    system: System,
    generators: Sequence[Generator],
    flows: Sequence[Flow],
    directions: Directions,
    coefficients: Iterable[sp.Expr],
) -> list[sp.Expr]:
    """Return independent combinations of the undetermined parameters that are invariant under all symmetries.

    Coefficients of the equations come first, then the simplest others. Their number is that of the undetermined
    parameters minus that of the directions, unless a symmetry has no closed form.
    """
    symbols = tuple(system.parameters.values())
    moving = [system.parameters[n] for n in directions.moved]
    wanted = len(moving) - len(directions.rows)
    offered = sorted((c for c in coefficients if c.free_symbols & set(moving)), key=lambda e: (sp.count_ops(e), str(e)))
    plain = [c for c in offered if not c.atoms(sp.Add)]
    others = [c for c in offered if c.atoms(sp.Add)] + _others(system, moving, generators, flows)
    others.sort(key=lambda e: (sp.count_ops(e) + AWKWARD * bool(sp.fraction(e)[1].atoms(sp.Add)), str(e)))
    chosen: list[sp.Expr] = []
    slopes = np.empty((0, len(moving)))
    for candidate in dict.fromkeys([*plain, *others]):
        if len(chosen) == wanted:
            break
        if not directions.preserve(candidate, symbols) or any(_normal(g.applied(candidate)) != 0 for g in generators):
            continue
        extended = np.vstack([slopes, directions.slope(candidate, moving)])
        if np.linalg.matrix_rank(extended, tol=1e-9) == len(extended):
            slopes = extended
            chosen.append(candidate)
    return chosen


def _others(
    system: System, moving: Sequence[sp.Symbol], generators: Sequence[Generator], flows: Sequence[Flow]
) -> list[sp.Expr]:
    """Return scaling-invariant monomials of the parameters, after the other symmetries set some to zero."""
    rates = {g: _weights_of_parameters(system, g) for g in generators}
    curved = [f.generator for f in flows if len(rates[f.generator]) < len(f.generator.parameters)]
    moved, zero = _with_zeros(system, curved)
    scalings = [row for g, row in rates.items() if g not in zero.values()]
    bent = {n for g, row in rates.items() if g not in zero.values() for n in g.parameters if n not in row}
    left = [n for n, s in system.parameters.items() if s in moving and s not in zero and n not in bent]
    weights = sp.Matrix(len(scalings), len(left), lambda i, j: scalings[i].get(left[j], 0))
    null = [list(v) for v in weights.nullspace()] if scalings else sp.eye(len(left)).tolist()
    if not null:
        return []
    vectors = determining.integer_rows(DomainMatrix.from_Matrix(sp.Matrix(null)).convert_to(sp.QQ))
    symbols = [system.parameters[n] for n in left]
    products = [
        sp.Mul(*(moved.get(s, s) ** int(power) for s, power in zip(symbols, vector, strict=True)))
        for vector in determining.integer_circuits(vectors, np.ones(len(left), dtype=np.int64))
    ]
    return [sp.factor(sp.cancel(p)) for p in products]


def _weights_of_parameters(system: System, generator: Generator) -> dict[str, int]:
    """Return integer weights of the parameters that a symmetry scales, regardless of the others and the states."""
    rates = {n: sp.cancel(move / system.parameters[n]) for n, move in generator.parameters.items()}
    best: dict[str, sp.Expr] = {}
    for unit in rates.values():
        ratios = {n: sp.cancel(rate / unit) for n, rate in rates.items()}
        rational = {n: ratio for n, ratio in ratios.items() if ratio.is_Rational}
        best = max(best, rational, key=len)
    common = math.lcm(*(int(ratio.q) for ratio in best.values()))
    return {n: int(ratio * common) for n, ratio in best.items()}


def _with_zeros(
    system: System, generators: Sequence[Generator]
) -> tuple[dict[sp.Symbol, sp.Expr], dict[sp.Symbol, Generator]]:
    """Return the parameters after each symmetry set one to zero, and which symmetry set which parameter."""
    moved = {s: s for s in system.parameters.values()}
    zero: dict[sp.Symbol, Generator] = {}
    straight: dict[sp.Symbol, Generator] = {}
    for given in generators:
        generator = given
        for symbol, earlier in straight.items():
            generator = generator.minus(earlier, generator.field.get(symbol, sp.S.Zero))
        flow = flow_of(generator)
        unit = [] if flow is None else [s for s in moved if flow.generator.field.get(s) == 1 and s not in zero]
        if flow is None or not unit:
            continue
        images = {s: image.subs(flow.amount, -unit[0]) for s, image in flow.images.items()}
        moved = {s: sp.factor(images.get(s, s).subs(moved, simultaneous=True)) for s in moved}
        zero[unit[0]], straight[unit[0]] = given, flow.generator
    return moved, zero


def _normal(expression: sp.Expr) -> sp.Expr:
    return sp.simplify(expression) if expression.atoms(sp.Function) else sp.cancel(sp.together(expression))
