"""Combinations of parameters that no symmetry changes: all that the outputs depend on."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import sympy as sp
from sympy.polys.matrices import DomainMatrix

from bayesperiodic.models.structure import modular
from bayesperiodic.models.structure.directions import Directions
from bayesperiodic.models.structure.flow import Flow, flow_of
from bayesperiodic.models.structure.generators import Generator
from bayesperiodic.models.structure.system import System

AWKWARD = 5


def coefficients_of(system: System) -> dict[sp.Expr, bool]:
    """Return the coefficients of the equations and outputs, and whether one belongs to a term of the drive.

    An equation is first divided by the coefficient of its highest derivative. Arguments of functions count as well.
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
    """Return independent combinations of the parameters that move, which all symmetries leave alone.

    Coefficients of the equations come first, then the simplest others. There are as many as parameters that move less
    the directions in which they do, unless a symmetry has no closed form.
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
        if not directions.leave(candidate, symbols) or any(_normal(g.applied(candidate)) != 0 for g in generators):
            continue
        extended = np.vstack([slopes, directions.slope(candidate, moving)])
        if np.linalg.matrix_rank(extended, tol=1e-9) == len(extended):
            slopes = extended
            chosen.append(candidate)
    return chosen


def _others(
    system: System, moving: Sequence[sp.Symbol], generators: Sequence[Generator], flows: Sequence[Flow]
) -> list[sp.Expr]:
    """Return monomials that the scalings leave alone, of the parameters after the other symmetries made some zero."""
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
    vectors = modular.whole(DomainMatrix.from_Matrix(sp.Matrix(null)).convert_to(sp.QQ))
    symbols = [system.parameters[n] for n in left]
    products = [
        sp.Mul(*(moved.get(s, s) ** int(power) for s, power in zip(symbols, vector, strict=True)))
        for vector in modular.whole_circuits(vectors, np.ones(len(left), dtype=np.int64))
    ]
    return [sp.factor(sp.cancel(p)) for p in products]


def _weights_of_parameters(system: System, generator: Generator) -> dict[str, int]:
    """Return whole numbers for the parameters that move as under a scaling, whatever the others and the states do."""
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
    """Return the parameters after one each was made zero along the symmetries, and which by which symmetry."""
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
