"""From infinitesimal symmetries to finite transformations, accepted only if exact substitution confirms them."""

from dataclasses import dataclass

import sympy as sp

from bayesperiodic.models.structure.algebra import Algebra
from bayesperiodic.models.structure.generators import Generator
from bayesperiodic.models.structure.system import System

LONGEST = 5
POWERS = (1, -1, 2)


@dataclass(frozen=True)
class Flow:
    """A one-parameter group of transformations.

    Attributes
    ----------
    generator : Generator
        In the normalisation that the transformation belongs to.
    amount : symbol
        A factor > 0 for scalings, else a number, any of either sign near zero.
    images : dict
        Symbol -> its image, for parameters, states and the states' derivatives that move.
    factor : Matrix or None
        What the equations are multiplied by; None until the flow is verified.
    """

    generator: Generator
    amount: sp.Symbol
    images: dict[sp.Symbol, sp.Expr]
    factor: sp.Matrix | None = None

    def of(self, expression: sp.Expr) -> sp.Expr:
        """Return the image of an expression."""
        return expression.subs(self.images, simultaneous=True)


def flow_of(generator: Generator) -> Flow | None:
    """Return the finite form of a symmetry, if one of several normalisations has a closed one.

    Scalings are written down; otherwise the Lie series exp(δ X) of every symbol, its reciprocal or its square must
    end or become an exponential series.
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
    """Return the flow in terms of t = exp(δ), where δ appears only so."""
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
    """Return exp(δ X) f if X^(n+1) f is X^n f times a constant of X, perhaps 0, for a small n."""
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
