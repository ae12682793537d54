"""Discrete symmetries: changes of signs and exchanges of two parameters that leave the measured outputs unchanged."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from itertools import combinations

import numpy as np
import sympy as sp

from bayesperiodic.symmetry.determining import Generator, System
from bayesperiodic.symmetry.invariants import Flow, verified

ODD = (sp.sin, sp.tan, sp.asin, sp.atan, sp.sinh, sp.tanh, sp.asinh, sp.atanh, sp.sign)
EVEN_FUNCTIONS = (sp.cos, sp.cosh, sp.Abs)
# Largest number of independent sign changes of which all combinations are compared, to find those of few parameters.
MOST_COMBINED = 10
# Random points at which exchanges are tried before the substitution, and the relative error there.
TRIAL_POINTS, ERROR = 2, 1e-9
IDENTITY = sp.Symbol("none")


def discrete_flows(system: System, generators: Sequence[Generator], determined: Iterable[str]) -> list[Flow]:
    """Return independent sign changes that are no scalings, and exchanges of two determined parameters.

    Exact substitution confirms each, see `invariants.verified`.
    """
    images = [*_sign_changes(system, generators), *_exchanges(system, list(determined))]
    flows = [verified(system, Flow(Generator({}), IDENTITY, image)) for image in images]
    return [flow for flow in flows if flow]


def _sign_changes(system: System, generators: Sequence[Generator]) -> list[dict[sp.Symbol, sp.Expr]]:
    """Return the images of changed symbols by sign changes of parameters and states that are no scalings by −1."""
    members = [[symbol] for symbol in system.parameters.values()] + [system.jet(state) for state in system.orders]
    bits = {symbol: 1 << i for i, symbols in enumerate(members) for symbol in symbols}
    constraints: list[int] = []
    for expression in system.equations:
        _parity(sp.expand(expression), bits, constraints)
    constraints += [_parity(sp.expand(y), bits, constraints) for y in system.outputs.values()]
    basis = _null_space(constraints, len(members))
    parameter_bits = (1 << len(system.parameters)) - 1
    scalings = [{s: sp.cancel(move / s) % 2 for s, move in g.field.items()} for g in generators if g.scaling]
    taken = [sum({bits[s] for s, odd in scaling.items() if odd}) & parameter_bits for scaling in scalings]
    several = range(1, 1 << len(basis)) if len(basis) <= MOST_COMBINED else [1 << i for i in range(len(basis))]
    changes = [reduce(int.__xor__, (b for i, b in enumerate(basis) if chosen >> i & 1)) for chosen in several]
    result = []
    for change in sorted(changes, key=lambda f: ((f & parameter_bits).bit_count(), f.bit_count(), f)):
        if _is_independent(change & parameter_bits, taken):
            taken.append(change & parameter_bits)
            result.append({s: -s for i, symbols in enumerate(members) if change >> i & 1 for s in symbols})
    return result


def _parity(e: sp.Expr, bits: Mapping[sp.Symbol, int], constraints: list[int]) -> int:
    """Return the symbols whose sign changes change the sign of an expression, as a sum of bits.

    Sign changes under which it is neither even nor odd have an odd number of bits in common with a constraint.
    """
    if e.is_Symbol or e.is_number:
        return bits.get(e, 0)
    parities = [_parity(argument, bits, constraints) for argument in e.args]
    if e.is_Add:
        constraints += [parities[0] ^ other for other in parities[1:]]
        return parities[0]
    if e.is_Mul:
        return reduce(int.__xor__, parities)
    if e.is_Pow and e.exp.is_Integer:
        return parities[0] if e.exp % 2 else 0
    if isinstance(e, ODD):
        return parities[0]
    if not isinstance(e, EVEN_FUNCTIONS):
        constraints += parities
    return 0


def _null_space(rows: Iterable[int], size: int) -> list[int]:
    """Return independent sets of bits that have an even number in common with every row."""
    vectors = [1 << i for i in range(size)]
    for row in rows:
        odd = [v for v in vectors if (v & row).bit_count() % 2]
        if odd:
            vectors = [v ^ odd[0] if (v & row).bit_count() % 2 else v for v in vectors if v != odd[0]]
    return vectors


def _is_independent(vector: int, others: Iterable[int]) -> bool:
    """Return whether a set of bits is no sum of others modulo 2."""
    reduced: list[int] = []
    for candidate in (*others, vector):
        for row in reduced:
            candidate = min(candidate, candidate ^ row)
        reduced.append(candidate)
    return bool(reduced[-1])


def _exchanges(system: System, determined: Sequence[str]) -> list[dict[sp.Symbol, sp.Expr]]:
    """Return the images of exchanges of two parameters, alone or with two states, that hold at random points."""
    symbols = sorted(system.used, key=str)
    highest, equations = system.highest, sp.Matrix(system.equations)
    slopes = equations.jacobian(highest) if highest and system.equations else sp.zeros(0, 0)
    pairs = [
        (system.jet(a), system.jet(b))
        for a, b in combinations(system.orders, 2)
        if system.orders[a] == system.orders[b]
    ]
    states = [dict(zip(a + b, b + a, strict=True)) for a, b in pairs]
    try:
        evaluated = sp.lambdify(symbols, [equations, slopes, sp.Matrix(list(system.outputs.values()))], "numpy")
        exchanges = []
        for a, b in combinations([system.parameters[n] for n in determined], 2):
            for moved in ({}, *states):
                image = {a: b, b: a} | moved
                columns = [highest.index(image.get(h, h)) for h in highest]
                if _holds(evaluated, symbols, image, columns):
                    exchanges.append(image)
                    break
    except (TypeError, NameError, AttributeError, np.linalg.LinAlgError):
        return []
    return exchanges


def _holds(
    evaluated: Callable[..., list[np.ndarray]],
    symbols: Sequence[sp.Symbol],
    image: Mapping[sp.Symbol, sp.Symbol],
    columns: list[int],
) -> bool:
    """Return whether equations and outputs do not change at random points, up to a factor of the equations."""
    random = np.random.default_rng(11)
    for _ in range(TRIAL_POINTS):
        values = dict(zip(symbols, random.uniform(0.5, 1.5, len(symbols)), strict=True))
        before = evaluated(*values.values())
        after = evaluated(*(values.get(image.get(s, s), 1.0) for s in symbols))
        if not np.allclose(after[2], before[2], rtol=ERROR, atol=ERROR):
            return False
        if before[1].size:
            factor = after[1][:, columns] @ np.linalg.inv(before[1])
            if not np.allclose(after[0], factor @ before[0], rtol=ERROR, atol=ERROR):
                return False
    return True
