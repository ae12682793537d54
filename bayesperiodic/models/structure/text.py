"""Expressions as text in the user's names, in the order of the model, readable by `bayesperiodic.expressions`."""

from collections.abc import Mapping

import sympy as sp


def written(expression: sp.Expr, names: Mapping[sp.Symbol, str]) -> str:
    """Return an expression as text such as "k1/(m*l**2)".

    Parameters
    ----------
    expression : expression
    names : dict
        Symbol -> name, in the order in which factors and terms are written.
    """
    order = {symbol: place for place, symbol in enumerate(names)}
    number, rest = sp.factor_terms(expression).as_coeff_Mul()
    negative = number.is_negative
    above = [(sp.Integer(abs(number.p)), sp.S.One)] if abs(number.p) != 1 else []
    below = [(sp.Integer(number.q), sp.S.One)] if number.q != 1 else []
    for factor in sorted(sp.Mul.make_args(rest), key=lambda f: _place(f, order)):
        base, power = (factor, sp.S.One) if isinstance(factor, sp.exp) else factor.as_base_exp()
        if base.is_Add and power.is_Integer and _terms(base, order)[0].as_coeff_Mul()[0] < 0:
            base, negative = -base, negative ^ (power.is_odd)
        if base != 1:
            rational = power.is_Rational
            (below if rational and power < 0 else above).append((base, abs(power) if rational else power))
    several = len(above) + len(below) > 1 or bool(negative)
    upper = "*".join(_power(base, power, names, several) for base, power in above) or "1"
    lower = "*".join(_power(base, power, names, True) for base, power in below)
    fraction = upper if not below else f"{upper}/{lower}" if len(below) == 1 else f"{upper}/({lower})"
    return f"-{fraction}" if negative else fraction


def _terms(total: sp.Expr, order: Mapping[sp.Symbol, int]) -> list[sp.Expr]:
    return sorted(total.args, key=lambda term: (len(term.free_symbols), _place(term, order)))


def _place(factor: sp.Expr, order: Mapping[sp.Symbol, int]) -> tuple[bool, int, str]:
    places = sorted(order.get(s, len(order)) for s in factor.free_symbols)
    return not factor.as_base_exp()[0].is_Symbol, places[0] if places else -1, str(factor)


def _power(base: sp.Expr, power: sp.Expr, names: Mapping[sp.Symbol, str], beside: bool) -> str:
    text = _base(base, names)
    simple = base.is_Atom or base.is_Function
    if power == 1:
        return f"({text})" if base.is_Add and beside else text
    exponent = str(power) if power.is_Integer else f"({written(power, names)})"
    return f"{text}**{exponent}" if simple else f"({text})**{exponent}"


def _base(base: sp.Expr, names: Mapping[sp.Symbol, str]) -> str:
    if base.is_Symbol:
        return names.get(base, str(base))
    if base.is_Add:
        order = {symbol: place for place, symbol in enumerate(names)}
        first, *others = [written(term, names) for term in _terms(base, order)]
        return first + "".join(f" - {t[1:]}" if t.startswith("-") else f" + {t}" for t in others)
    if base.is_Function:
        return f"{base.func.__name__.lower()}({', '.join(written(a, names) for a in base.args)})"
    return str(base.xreplace({s: sp.Symbol(n) for s, n in names.items()}))
