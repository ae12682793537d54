"""Expressions as rational functions: every function of an argument becomes one more variable."""

from collections.abc import Iterable, Sequence
from functools import reduce
from typing import Any

import sympy as sp
from sympy.polys.fields import field


class Algebra:
    """The field of rational functions in which given expressions live.

    Transcendental functions and roots are variables of their own, so that two expressions are equal if their elements
    are; only sin² + cos² = 1, cosh² − sinh² = 1, sign² = 1 and the powers of roots are known relations. The converse
    holds unless the expressions contain other relations, such as tan = sin/cos. Denominators under roots are positive.

    Parameters
    ----------
    expressions : iterable of expressions
    moving : iterable of symbols
        What varies along a motion. The coefficients of its powers are polynomials of the other symbols.
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
        # Those that vary come first; functions before what they contain, so that relations can be eliminated.
        self.generators = sorted(generators, key=lambda s: s not in self._moving)
        self.size = sum(s in self._moving for s in self.generators)
        self.field = field(self.generators or [sp.Dummy("one")], sp.QQ, "lex")[0]
        self._divisors = [self.field.from_expr(r).numer for r in self._relations]

    def element(self, expression: sp.Expr) -> Any:
        """Return the element of the field; it must not contain functions that the given expressions did not."""
        return self.field.from_expr(self._replaced(expression))

    def numerators(self, expressions: Sequence[sp.Expr]) -> list[Any]:
        """Return polynomials in the ratios of the expressions, their relations eliminated."""
        elements = [self.element(e) for e in expressions]
        common = reduce(lambda a, b: a.lcm(b), (e.denom for e in elements))
        found = [e.numer * common.exquo(e.denom) for e in elements]
        return [n.rem(self._divisors) for n in found] if self._divisors else found

    def is_zero(self, expression: sp.Expr) -> bool:
        """Return whether an expression vanishes identically."""
        return not self.numerators([expression])[0]

    def split(self, polynomial: Any) -> dict[tuple[int, ...], dict[tuple[int, ...], Any]]:
        """Return {powers of what varies: {powers of the other generators: coefficient}}."""
        parts: dict[tuple[int, ...], dict[tuple[int, ...], Any]] = {}
        for powers, coefficient in polynomial.terms():
            parts.setdefault(powers[: self.size], {})[powers[self.size :]] = coefficient
        return parts

    def original(self, expression: sp.Expr) -> sp.Expr:
        """Return an expression of the generators with the functions in the place of their variables."""
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
