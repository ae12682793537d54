"""Unidentifiable directions of the parameters, finite symmetry transformations, and identifiable combinations."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import sympy as sp
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.symmetry import determining
from bayesperiodic.symmetry.determining import Algebra, Generator, System, lie_derivative

# Sensitivities: complex step, number of random parameter values, Newton steps, relative size of zero singular values.
COMPLEX_STEP, VALUES, NEWTON_STEPS, ZERO_SINGULAR_VALUE = 1e-30, 4, 30, 1e-9
SMALL_SLOPE = 1e-7
# Flows: longest Lie series, and powers of a symbol whose series is tried.
LONGEST_SERIES, SYMBOL_POWERS = 5, (1, -1, 2)
# Operations that a sum in a denominator counts for.
AWKWARD = 5
X = sp.Symbol("x")


def series(expression: sp.Expr, values: Mapping[sp.Symbol, np.ndarray]) -> np.ndarray:
    """Return the power series of an expression of power series, complex arrays (order + 1, …).

    The sign of a series is that of the real part of its leading coefficient. A function that NumPy lacks raises a
    TypeError.
    """
    known: dict[sp.Expr, np.ndarray] = dict(values)
    template = next(iter(values.values()))

    def constant(number: Any) -> np.ndarray:
        result = np.zeros_like(template)
        result[0] = complex(number)
        return result

    def value(e: sp.Expr) -> np.ndarray:
        if e not in known:
            known[e] = combined(e)
        return known[e]

    def combined(e: sp.Expr) -> np.ndarray:
        if e.is_number:
            return constant(e)
        if e.is_Add:
            return sum(map(value, e.args[1:]), value(e.args[0]))
        if e.is_Mul:
            result = value(e.args[0])
            for factor in e.args[1:]:
                result = _product(result, value(factor))
            return result
        if e.is_Pow and e.exp.is_number:
            return _composed(X**e.exp, value(e.base))
        if e.is_Pow:
            return value(sp.exp(e.exp * sp.log(e.base), evaluate=False))
        if isinstance(e, sp.sign):
            return constant(1.0) * np.sign(value(e.args[0])[0].real)
        if len(e.args) != 1:
            raise TypeError(f"expression: must consist of functions of one argument, got {e.func}.")
        return _composed(e.func(X), value(e.args[0]))

    return value(expression)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of two power series."""
    return np.stack([sum((a[i] * b[k - i] for i in range(1, k + 1)), a[0] * b[k]) for k in range(len(a))])


def _composed(function: sp.Expr, inner: np.ndarray) -> np.ndarray:
    """Return a function of a power series, by Horner's rule with its derivatives of all orders."""
    rest = inner.copy()
    rest[0] = 0.0
    result = np.zeros_like(inner)
    for order in range(len(inner) - 1, -1, -1):
        result = _product(result, rest)
        result[0] += _compiled_derivative(function, order)(inner[0]) / math.factorial(order)
    return result


@cache
def _compiled_derivative(function: sp.Expr, order: int) -> Callable[[np.ndarray], np.ndarray]:
    return sp.lambdify(X, sp.diff(function, X, order), "numpy")


def differentiated(a: np.ndarray) -> np.ndarray:
    """Return the time derivative; its last coefficient is unknown and set to zero."""
    return np.concatenate([np.polynomial.polynomial.polyder(a), np.zeros_like(a[:1])])


def null_directions(system: System) -> list[tuple[dict[sp.Symbol, float], np.ndarray]]:
    """Return parameter values, and directions without effect on the outputs there, at several random values.

    The directions (directions, parameters) are orthonormal in the logarithms of the unknown parameters. The list is
    empty if the equations cannot be solved for the highest derivatives or contain functions that NumPy lacks.

    The first time derivatives of the outputs, as many as there are initial values, are computed at many unrelated
    instants (with random states, inputs, their derivatives, time and frequency), with their exact sensitivities to the
    parameters and to the states at that instant. Effects that the states can compensate are projected out. These
    derivatives contain the information of the input-output equations (A. Ovchinnikov, A. Pillay, G. Pogudin,
    T. Scanlon, SIAM Journal on Applied Algebra and Geometry 6, 2022, 339-367).
    """
    random = np.random.default_rng(7)
    samples = []
    for _ in range(VALUES):
        theta = random.uniform(0.5, 1.5, len(system.parameters))
        known = random.uniform(0.5, 1.5, len(system.known))
        try:
            sensitivities, size = _sensitivities(system, theta, known, random)
        except (TypeError, NameError, np.linalg.LinAlgError):
            return []
        if len(sensitivities) < len(theta):
            return []
        # Each parameter in the unit of its own effect, so that a large one does not hide the others.
        unit = np.where(size > 0.0, size, 1.0)
        _, singular, directions = np.linalg.svd(sensitivities / unit, full_matrices=False)
        without = directions[np.count_nonzero(singular > ZERO_SINGULAR_VALUE * singular[0]) :] / unit
        values = dict(zip((*system.parameters.values(), *system.known.values()), [*theta, *known], strict=True))
        samples.append((values, np.linalg.qr(without.T)[0].T))
    return samples


def _sensitivities(
    system: System, theta: np.ndarray, known: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return sensitivities to the logarithms of the parameters that changes of the states cannot compensate.

    The second array (parameters,) is the largest sensitivity to each, what the states can compensate included.
    """
    order, points = sum(system.orders.values()) + 1, 20 + 3 * len(theta)
    taylor = _motions(system, theta, known, order, points, random)
    rows, largest = [], np.zeros(len(theta))
    for values in taylor.transpose(1, 0, 3, 2).reshape(points, -1, taylor.shape[2]):
        if not np.all(np.isfinite(values)) or np.any(np.abs(values.imag) > 1e-12 * (1.0 + np.abs(values.real))):
            continue
        slopes = values.imag / COMPLEX_STEP
        slopes[:, : len(theta)] *= theta
        size = np.abs(slopes).max(axis=1)
        slopes = slopes[size > 0.0] / size[size > 0.0, None]
        basis, singular, _ = np.linalg.svd(slopes[:, len(theta) :])
        rank = np.count_nonzero(singular > ZERO_SINGULAR_VALUE * max(singular, default=1.0))
        rows.append(basis[:, rank:].T @ slopes[:, : len(theta)])
        largest = np.maximum(largest, np.abs(slopes[:, : len(theta)]).max(axis=0, initial=0.0))
    return (np.concatenate(rows) if rows else np.empty((0, len(theta)))), largest


def _motions(
    system: System, theta: np.ndarray, known: np.ndarray, order: int, points: int, random: np.random.Generator
) -> np.ndarray:
    """Return Taylor coefficients of the outputs (order + 1, points, directions, outputs), with complex steps."""
    starts = [symbol for state, highest in system.orders.items() for symbol in system.jet(state, highest)[:-1]]
    directions = len(theta) + len(starts)
    shape = (order + 3, points, directions)

    def fixed(number: np.ndarray | float) -> np.ndarray:
        result = np.zeros(shape, dtype=complex)
        result[0] = number
        return result

    values = {s: fixed(v) for s, v in zip(system.known.values(), known, strict=True)}
    frequency = random.uniform(0.3, 1.0, (points, 1))
    values[system.symbols["frequency"]] = fixed(frequency)
    values[system.symbols["tau"]] = fixed(random.uniform(0.0, 1.0, (points, 1)))
    values[system.symbols["tau"]][1] = frequency
    for name in system.inputs:
        signal = fixed(0.0) + random.uniform(-1.0, 1.0, (order + 3, points, 1))
        for symbol in system.jet(name):
            values[symbol] = signal
            signal = differentiated(signal)
    varied = [*theta, *random.uniform(-1.5, 1.5, (len(starts), points, 1))]
    for i, (symbol, value) in enumerate(zip([*system.parameters.values(), *starts], varied, strict=True)):
        values[symbol] = fixed(value)
        values[symbol][0, :, i] += COMPLEX_STEP * 1j
    with np.errstate(all="ignore"):
        _follow(system, values, order)
        shortened = {symbol: v[: order + 1] for symbol, v in values.items()}
        return np.stack([series(y, shortened) for y in system.outputs.values()], axis=-1)


def _follow(system: System, values: dict[sp.Symbol, np.ndarray], order: int) -> None:
    """Compute the Taylor coefficients of the states, order by order."""
    highest = system.highest
    if not highest:
        return
    for symbol in highest:
        values[symbol] = np.zeros_like(next(iter(values.values())))
    jacobian = [[sp.diff(g, symbol) for symbol in highest] for g in system.equations]
    for k in range(order + 1):
        for _ in range(NEWTON_STEPS if k == 0 else 1):
            now = {symbol: v[: k + 1] for symbol, v in values.items()}
            residual = np.stack([series(g, now)[k] for g in system.equations], axis=-1)
            start = {symbol: v[:1] for symbol, v in values.items()}
            slopes = np.stack([np.stack([series(e, start)[0] for e in row], axis=-1) for row in jacobian], axis=-2)
            change = np.linalg.solve(slopes, residual[..., None])[..., 0]
            for i, symbol in enumerate(highest):
                values[symbol][k] -= change[..., i]
            if not np.any(np.abs(change.real) > 1e-13 * (1.0 + np.abs(values[highest[0]][k].real)[..., None])):
                break
        for state, n in system.orders.items():
            chain = [values[symbol] for symbol in reversed(system.jet(state, n))]
            for rate, integral in pairwise(chain):
                for j in range(k + 2):
                    integral[j + 1 : j + 2] = rate[j] / (j + 1)


@dataclass(frozen=True)
class Directions:
    """Parameter directions without effect on the outputs."""

    rows: np.ndarray  # orthonormal in the logarithms of the parameters, (directions, parameters)
    names: tuple[str, ...]  # of the parameters
    values: dict[sp.Symbol, float]  # of all parameters
    points: int = 0  # number of parameter values with sensitivities; 0 if the rows are those of the symmetries
    unexplained: tuple[str, ...] = ()  # parameters in directions that no symmetry explains

    @property
    def moved(self) -> list[str]:
        """The parameters that are not determined."""
        return [n for n, column in zip(self.names, self.rows.T, strict=True) if np.any(np.abs(column) > SMALL_SLOPE)]

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
        return bool(np.all(np.abs(self.rows @ self.slope(expression, symbols)) < SMALL_SLOPE))


def directions_of(system: System, generators: Sequence[Generator]) -> Directions:
    """Return the smallest set of directions by sensitivities, or those of the symmetries if there are none."""
    symbols = (*system.parameters.values(), *system.known.values())
    general = {s: 0.5 + (0.618 * k) % 1 for k, s in enumerate(symbols, 1)}
    names = tuple(system.parameters)
    samples = null_directions(system) if names else []
    if not samples:
        return Directions(_explained(system, generators, general), names, general)
    values, rows = min(samples, key=lambda pair: len(pair[1]))
    explained = _explained(system, generators, values)
    rest = rows - rows @ explained.T @ explained
    unexplained = tuple(
        n for n, size in zip(names, np.abs(rest).max(axis=0, initial=0.0), strict=True) if size > SMALL_SLOPE
    )
    # Sensitivities do not detect the effect of a parameter on the location of a discontinuity.
    located = {symbol for switch in system.signs for symbol in switch.free_symbols}
    if unexplained and located & set(system.parameters.values()):
        return Directions(explained, names, values)
    return Directions(rows, names, values, len(samples), unexplained)


def _explained(system: System, generators: Sequence[Generator], values: dict[sp.Symbol, float]) -> np.ndarray:
    moves = [[g.field.get(s, sp.S.Zero) / s for s in system.parameters.values()] for g in generators]
    slopes = np.array([[float(move.subs(values)) for move in row] for row in moves])
    return np.linalg.qr(slopes.reshape(len(generators), len(system.parameters)).T)[0].T


def _rank(matrix: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=SMALL_SLOPE)) if matrix.size else 0


@dataclass(frozen=True)
class Flow:
    """A one-parameter group of transformations."""

    generator: Generator  # in the normalisation of the transformation
    amount: sp.Symbol  # group parameter: a factor > 0 for scalings, otherwise a real number, 0 for the identity
    images: dict[sp.Symbol, sp.Expr]  # of the parameters, states and derivatives of states that change
    factor: sp.Matrix | None = None  # of the transformed equations; None until the flow is verified


def flow_of(system: System, generator: Generator) -> Flow | None:
    """Return the finite transformation of a symmetry, if one of several normalisations has a closed form.

    The form of scalings is known. For others, the Lie series exp(δ X) of every symbol, its reciprocal or its square
    must terminate or be an exponential series.
    """
    if generator.scaling:
        factor = sp.Symbol("t", positive=True)
        images = {s: s * factor ** int(sp.cancel(move / s)) for s, move in generator.field.items()}
        return Flow(generator, factor, images)
    amount = sp.Symbol("delta", real=True)
    constant = [move for move in generator.field.values() if move.is_number]
    rates = [generator.field[s] for s in system.parameters.values() if s in generator.field]
    for unit in dict.fromkeys([*constant, sp.S.One, *sorted(rates, key=sp.count_ops)]):
        scaled = generator.times(1 / unit)
        images = {}
        for symbol in scaled.field:
            image = _image(scaled, symbol, amount)
            if image is None:
                break
            images[symbol] = image
        else:
            # In terms of t = exp(δ), if δ appears only in this form.
            logarithm = sp.log(sp.Symbol("t", positive=True))
            powers = {s: sp.powsimp(sp.expand_log(e.subs(amount, logarithm))) for s, e in images.items()}
            powers = {s: _shortest(e) for s, e in powers.items()}
            by_factor = not any(e.has(sp.log) for e in powers.values())
            return Flow(scaled, *((logarithm.args[0], powers) if by_factor else (amount, images)))
    return None


def verified(system: System, flow: Flow) -> Flow | None:
    """Return the flow with the factor of the equations if exact substitution confirms it, else None.

    The outputs must be identical, and the transformed equations the old ones times an invertible matrix.
    """
    changes = [y.subs(flow.images, simultaneous=True) - y for y in system.outputs.values()]
    before = sp.Matrix(system.equations)
    after, highest = before.subs(flow.images, simultaneous=True), system.highest
    algebra = Algebra([*before, *after, *changes, *flow.images.values()], system.symbols.values())
    if not all(algebra.is_zero(change) for change in changes):
        return None
    if not highest:
        return replace(flow, factor=sp.Matrix(0, 0, []))
    try:
        factor = (after.jacobian(highest) * before.jacobian(highest).inv()).applyfunc(sp.factor)
    except sp.matrices.exceptions.NonInvertibleMatrixError:
        return None
    if factor.det() == 0 or not all(algebra.is_zero(e) for e in after - factor * before):
        return None
    return replace(flow, factor=factor)


def _image(generator: Generator, symbol: sp.Symbol, amount: sp.Symbol) -> sp.Expr | None:
    for power in SYMBOL_POWERS:
        if (image := _series(generator, symbol**power, amount)) is not None:
            return sp.sqrt(_shortest(image)) if power == 2 else _shortest(image**power)
    return None


def _shortest(expression: sp.Expr) -> sp.Expr:
    factored = sp.factor(expression)
    if sp.fraction(factored)[1].atoms(sp.Add):
        return factored
    return min(sp.expand(expression), factored, key=sp.count_ops)


def _series(generator: Generator, start: sp.Expr, amount: sp.Symbol) -> sp.Expr | None:
    """Return exp(δ X) f if X^(n+1) f = c X^n f for a small n and an invariant c of X, which may be 0."""
    total, term = sp.S.Zero, start
    for order in range(LONGEST_SERIES):
        following = sp.cancel(lie_derivative(generator.field, term))
        rate = sp.cancel(following / term)
        if following == 0:
            return total + amount**order / sp.factorial(order) * term
        if sp.cancel(lie_derivative(generator.field, rate)) == 0:
            begun = sum((rate * amount) ** j / sp.factorial(j) for j in range(order))
            return total + term * (sp.exp(rate * amount) - begun) / rate**order
        total += amount**order / sp.factorial(order) * term
        term = following
    return None


def coefficients_of(system: System) -> dict[sp.Expr, bool]:
    """Return the coefficients of the equations and outputs, and whether each belongs to a forcing term.

    An equation is first divided by the coefficient of its highest derivative. Arguments of functions are included.
    """
    parameters = (*system.parameters.values(), *system.known.values())
    drive = {system.symbols["tau"], *(symbol for name in system.inputs for symbol in system.jet(name))}
    moving = set(system.symbols.values())
    coefficients: dict[sp.Expr, bool] = {}

    def collect(expression: sp.Expr) -> None:
        parts: dict[sp.Expr, sp.Expr] = {}
        for term in sp.Add.make_args(sp.expand(expression)):
            coefficient, rest = term.as_independent(*moving, as_Add=False)
            parts[rest] = parts.get(rest, sp.S.Zero) + coefficient
        leading = next((parts[h] for h in system.highest if h in parts), sp.S.One)
        for rest, coefficient in parts.items():
            ratio = sp.factor(sp.cancel(coefficient / leading)).as_independent(*parameters, as_Add=False)[1]
            if ratio.free_symbols:
                coefficients[ratio] = coefficients.get(ratio, False) or bool(rest.free_symbols & drive)
            for function in sorted(rest.atoms(sp.Function), key=sp.default_sort_key):
                for argument in function.args:
                    collect(argument)

    for expression in system.expressions:
        collect(expression)
    return coefficients


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
        changes = (_normal(lie_derivative(g.field, candidate)) for g in generators)
        if not directions.preserve(candidate, symbols) or any(change != 0 for change in changes):
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
    parameters = system.parameters.values()
    rates = {g: _weights(g, [s for s in parameters if s in g.field]) for g in generators}
    bent = {g: {s for s in parameters if s in g.field and s not in row} for g, row in rates.items()}
    moved, zero = _with_zeros(system, [f.generator for f in flows if bent[f.generator]])
    scalings = [g for g in generators if g not in zero.values()]
    left = [s for s in moving if s not in zero and not any(s in bent[g] for g in scalings)]
    weights = sp.Matrix(len(scalings), len(left), lambda i, j: rates[scalings[i]].get(left[j], 0))
    null = [list(v) for v in weights.nullspace()] if scalings else sp.eye(len(left)).tolist()
    if not null:
        return []
    vectors = determining.integer_rows(DomainMatrix.from_Matrix(sp.Matrix(null)).convert_to(sp.QQ))
    products = [
        sp.Mul(*(moved[s] ** int(power) for s, power in zip(left, vector, strict=True)))
        for vector in determining.integer_circuits(vectors, np.ones(len(left), dtype=np.int64))
    ]
    return [sp.factor(sp.cancel(p)) for p in products]


def _weights(generator: Generator, parameters: Sequence[sp.Symbol]) -> dict[sp.Symbol, int]:
    """Return integer weights of the parameters that a symmetry scales, regardless of the others."""
    rates = {s: sp.cancel(generator.field[s] / s) for s in parameters}
    best: dict[sp.Symbol, sp.Expr] = {}
    for unit in rates.values():
        ratios = {s: sp.cancel(rate / unit) for s, rate in rates.items()}
        best = max(best, {s: ratio for s, ratio in ratios.items() if ratio.is_Rational}, key=len)
    common = math.lcm(*(int(ratio.q) for ratio in best.values()))
    return {s: int(ratio * common) for s, ratio in best.items()}


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
        flow = flow_of(system, generator)
        unit = [] if flow is None else [s for s in moved if flow.generator.field.get(s) == 1 and s not in zero]
        if flow is None or not unit:
            continue
        images = {s: image.subs(flow.amount, -unit[0]) for s, image in flow.images.items()}
        moved = {s: sp.factor(images.get(s, s).subs(moved, simultaneous=True)) for s in moved}
        zero[unit[0]], straight[unit[0]] = given, flow.generator
    return moved, zero


def _normal(expression: sp.Expr) -> sp.Expr:
    return sp.simplify(expression) if expression.atoms(sp.Function) else sp.cancel(sp.together(expression))
