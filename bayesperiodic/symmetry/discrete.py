"""Discrete symmetries: changes of signs and exchanges of two parameters that leave the measured outputs unchanged."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations, islice, product

import numpy as np
import sympy as sp

from bayesperiodic.symmetry.determining import Generator, System, independent, nullspace
from bayesperiodic.symmetry.invariants import Flow, verified

ODD = (sp.sin, sp.tan, sp.asin, sp.atan, sp.sinh, sp.tanh, sp.asinh, sp.atanh, sp.sign)
EVEN_FUNCTIONS = (sp.cos, sp.cosh, sp.Abs)
# Largest number of independent sign changes of which all combinations are compared, to find those of few parameters.
MOST_COMBINED = 10
# Random points at which exchanges are tried before the substitution, and the relative error there.
TRIAL_POINTS, ERROR = 2, 1e-9
IDENTITY = sp.Symbol("none")


def discrete_flows(system: System, generators: Sequence[Generator], determined: Iterable[str]) -> list[Flow]:
    """Return independent sign changes that are no scalings, and exchanges of determined parameters; all verified."""
    images = [*_sign_changes(system, generators), *_exchanges(system, list(determined))]
    flows = [verified(system, Flow(Generator({}), IDENTITY, image)) for image in images]
    return [flow for flow in flows if flow]


def _sign_changes(system: System, generators: Sequence[Generator]) -> list[dict[sp.Symbol, sp.Expr]]:
    """Return the images of changed symbols by sign changes of parameters and states that are no scalings by −1."""
    members = [[symbol] for symbol in system.parameters.values()] + [system.jet(state) for state in system.orders]
    units = np.eye(len(members), dtype=int)
    places = {symbol: unit for symbols, unit in zip(members, units, strict=True) for symbol in symbols}
    constraints: list[np.ndarray] = []
    for expression in system.equations:
        _parity(sp.expand(expression), places, constraints)
    constraints += [_parity(sp.expand(y), places, constraints) for y in system.outputs.values()]
    basis = nullspace(np.array(constraints).reshape(-1, len(members)), 2)
    several = np.array(list(product((0, 1), repeat=len(basis)))) if len(basis) <= MOST_COMBINED else np.eye(len(basis))
    changes = (several @ basis).astype(int) % 2
    parameters = system.parameters.values()
    changes = changes[np.lexsort((*changes.T, changes.sum(1), changes[:, : len(parameters)].sum(1)))]
    scalings = [[sp.cancel(g.field.get(s, 0) / s) % 2 for s in parameters] for g in generators if g.scaling]
    rows = [*scalings, *changes[:, : len(parameters)]]
    chosen = [k - len(scalings) for k in independent(rows, len(parameters), 2)]
    return [{s: -s for i in np.flatnonzero(changes[k]) for s in members[i]} for k in chosen if k >= 0]


def _parity(e: sp.Expr, places: Mapping[sp.Symbol, np.ndarray], constraints: list[np.ndarray]) -> np.ndarray:
    """Return where the places (members,) are 1 of symbols whose sign changes change the sign of an expression.

    Sign changes under which it is neither even nor odd have an odd number of places in common with a constraint.
    """
    even = np.zeros_like(next(iter(places.values())))
    if e.is_Symbol or e.is_number:
        return places.get(e, even)
    parities = [_parity(argument, places, constraints) for argument in e.args]
    if e.is_Add:
        constraints += [parities[0] ^ other for other in parities[1:]]
        return parities[0]
    if e.is_Mul:
        return np.bitwise_xor.reduce(parities)
    if isinstance(e, ODD) or (e.is_Pow and e.exp.is_Integer and e.exp % 2):
        return parities[0]
    if not isinstance(e, EVEN_FUNCTIONS) and not (e.is_Pow and e.exp.is_Integer):
        constraints += parities
    return even


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
    points = np.random.default_rng(11).uniform(0.5, 1.5, (TRIAL_POINTS, len(symbols)))
    try:
        evaluated = sp.lambdify(symbols, [equations, slopes, sp.Matrix(list(system.outputs.values()))], "numpy")
        trials = [(dict(zip(symbols, point, strict=True)), *evaluated(*point)) for point in points]

        def holds(image: Mapping[sp.Symbol, sp.Symbol]) -> bool:
            columns = [highest.index(image.get(h, h)) for h in highest]
            for values, residual, slope, outputs in trials:
                moved = evaluated(*(values.get(image.get(s, s), 1.0) for s in symbols))
                if not np.allclose(moved[2], outputs, rtol=ERROR, atol=ERROR):
                    return False
                expected = moved[1][:, columns] @ np.linalg.solve(slope, residual) if slope.size else moved[0]
                if not np.allclose(moved[0], expected, rtol=ERROR, atol=ERROR):
                    return False
            return True

        exchanges: list[dict[sp.Symbol, sp.Expr]] = []
        for a, b in combinations([system.parameters[n] for n in determined], 2):
            images = ({a: b, b: a} | moved for moved in ({}, *states))
            exchanges += islice(filter(holds, images), 1)
    except (TypeError, NameError, AttributeError, np.linalg.LinAlgError):
        return []
    return exchanges
