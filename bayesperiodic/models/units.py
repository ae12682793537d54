"""Units of expressions: products and powers of the units of the symbols in them, compared in base units."""

import re
from collections.abc import Mapping

import sympy as sp

Unit = dict[str, float]  # exponents of the symbols of units

BASE: dict[str, Unit] = {
    "N": {"kg": 1, "m": 1, "s": -2}, "Pa": {"kg": 1, "m": -1, "s": -2}, "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3}, "Hz": {"s": -1}, "C": {"A": 1, "s": 1}, "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2}, "Ω": {"kg": 1, "m": 2, "s": -3, "A": -2}, "rad": {},
    "F": {"kg": -1, "m": -2, "s": 4, "A": 2}, "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
}  # fmt: skip
FROM_SUPERSCRIPTS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
UNIT_POWER = re.compile(r"([^\W\d_]+)\^?(-?\d+)?")


def parsed(text: str) -> Unit | None:
    """Return a unit from a text such as ``"N s/m^2"`` or ``"J/(kg K)"``; None if it is empty or not understood."""
    plain = text.translate(FROM_SUPERSCRIPTS).replace("·", " ").replace("*", " ").replace("(", " ").replace(")", " ")
    over, *under = plain.split("/")
    if not over.strip() or len(under) > 1:
        return None
    unit: Unit = {}
    for sign, part in zip((1.0, -1.0), (over, *under), strict=False):
        for word in part.split():
            if word == "1":
                continue
            if not (factor := UNIT_POWER.fullmatch(word)):
                return None
            unit = product(unit, {factor[1]: sign * float(factor[2] or 1)})
    return unit


def product(one: Unit, other: Unit, power: float = 1.0) -> Unit:
    """Return one times a power of the other."""
    total = {name: one.get(name, 0.0) + power * other.get(name, 0.0) for name in (*one, *other)}
    return {name: exponent for name, exponent in total.items() if exponent}


def written(unit: Unit) -> str:
    """Return a unit as text, such as ``"N/m^2"``; "1" for none."""

    def side(sign: int) -> str:
        factors = {name: sign * exponent for name, exponent in unit.items() if sign * exponent > 0}
        return " ".join(name if exponent == 1 else f"{name}^{exponent:g}" for name, exponent in factors.items())

    over, under = side(1), side(-1)
    return (over or "1") + (f"/({under})" if " " in under else f"/{under}" if under else "")


def same(one: Unit, other: Unit) -> bool:
    """Return whether two units have the same dimension; those of Hz and rad/s are the same, as nothing is converted."""
    total: Unit = {}
    for name, exponent in product(one, other, -1.0).items():
        total = product(total, BASE.get(name, {name: 1}), exponent)
    return not total


def unit_of(expression: sp.Expr, units: Mapping[sp.Symbol, Unit]) -> Unit | None:
    """Return the unit of an expression; None where that of a symbol in it is not known.

    A number may have any unit if it is added, and in the argument of a function. A ValueError is raised for a sum of
    different dimensions, and for a function of what has one.
    """
    if expression.is_number:
        return {}
    if isinstance(expression, sp.Symbol):
        return units.get(expression)
    parts = [unit_of(part, units) for part in expression.args]
    known = [summand for summand in parts if summand is not None]
    if isinstance(expression, sp.Mul):
        total: Unit = {}
        for summand in known:
            total = product(total, summand)
        return total if len(known) == len(parts) else None
    if isinstance(expression, sp.Pow):
        base, power = parts[0], expression.args[1]
        return product({}, base, float(power)) if base is not None and power.is_number else None
    if isinstance(expression, sp.Add):
        sized = [u for u, part in zip(parts, expression.args, strict=True) if u is not None and not part.is_number]
        for summand in sized[1:]:
            if not same(sized[0], summand):
                raise ValueError(f"a sum of {written(sized[0])} and {written(summand)}")
        return sized[0] if sized else None
    if isinstance(expression, sp.Abs):
        return parts[0]
    numbers = expression.args[0].atoms(sp.Number) - {sp.Integer(1), sp.Integer(-1)}
    if parts[0] and not same(parts[0], {}) and not numbers:
        raise ValueError(f"{expression.func.__name__} of a quantity in {written(parts[0])}")
    return {}
