"""Conversion of units, whose text never reaches an evaluator before it has been checked."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from bayesperiodic import _checks

Units = Mapping[str, float | Sequence[str]]

LONGEST = 100
# Products, quotients and groups of names with an exponent of one digit; the only number is the 1 of "1/s".
SUPERSCRIPTS = "¹²³⁰⁴⁵⁶⁷⁸⁹"
TOKEN = re.compile(
    rf"(?:[^\W\d{SUPERSCRIPTS}]|[°%])[^\W{SUPERSCRIPTS}]*"
    rf"(?:\s*(?:\*\*|\^)\s*[+-]?[0-9](?:\.5)?(?![\w.])|⁻?[{SUPERSCRIPTS}](?!\w))?"
    r"|1(?![\w.])|[()]|[*/·]|\s+"
)


def convert(name: str, values: np.ndarray, unit: float | Sequence[str]) -> np.ndarray:
    """Return the values of a channel, multiplied by a factor or converted by a pair of units such as ("mm", "m")."""
    argument = f"units[{name!r}]"
    if isinstance(unit, int | float):
        factor = _checks.finite_number(argument, unit)
        if factor == 0.0:
            raise ValueError(f"{argument}: must not be zero, got {unit!r}.")
        return values * factor
    if isinstance(unit, str) or len(unit) != 2 or not all(isinstance(u, str) for u in unit):
        raise ValueError(f"{argument}: must be a factor or a pair such as ('mm', 'm'), got {unit!r}.")
    for text in unit:
        if len(text) > LONGEST or not _is_unit(text):
            shown = text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
            raise ValueError(
                f"{argument}: must be units that are multiplied or divided, with exponents of one digit, such as "
                f"'kg*m/s**2', got {shown!r}."
            )
    import pint

    try:
        first, second = (text.replace("·", "*") for text in unit)
        return np.asarray(pint.UnitRegistry().Quantity(values, first).to(second).magnitude, dtype=float)
    except (pint.errors.PintError, AssertionError, TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(
            f"{argument}: must be two units of the same dimension, got {tuple(unit)!r} ({error})."
        ) from None


def _is_unit(text: str) -> bool:
    """Return whether a text consists of the permitted tokens, and no operator follows another one."""
    place, operator, depth = 0, False, 0
    while place < len(text):
        token = TOKEN.match(text, place)
        if token is None:
            return False
        place, mark = token.end(), token.group().strip()
        if mark in ("*", "/", "·"):
            if operator:
                return False
            operator = True
        elif mark:
            operator = False
            depth += {"(": 1, ")": -1}.get(mark, 0)
    return depth == 0
