"""Unit conversion of measured columns."""

from collections.abc import Sequence

import numpy as np

from bayesperiodic import checks


def convert(name: str, values: np.ndarray, unit: float | Sequence[str]) -> np.ndarray:
    """Return values multiplied by a factor or converted by a pair of units.

    Parameters
    ----------
    name : str
        The channel, for messages.
    values : array
    unit : float or (from, to)
        A factor, or two unit names such as ("mm", "m").

    Raises
    ------
    ValueError
        For a factor that is zero or not finite, an unknown unit, or two units of different dimension.
    """
    argument = f"units[{name!r}]"
    if isinstance(unit, int | float):
        factor = checks.finite_number(argument, unit)
        if factor == 0.0:
            raise ValueError(f"{argument}: 0 is not allowed; a factor must differ from zero.")
        return values * factor
    if isinstance(unit, str) or len(unit) != 2 or not all(isinstance(u, str) for u in unit):
        raise ValueError(f"{argument}: {unit!r} is not allowed; give a factor or a pair such as ('mm', 'm').")
    import pint

    try:
        return np.asarray(pint.UnitRegistry().Quantity(values, unit[0]).to(unit[1]).magnitude, dtype=float)
    except (pint.errors.PintError, AssertionError, TypeError, ValueError) as error:
        raise ValueError(f"{argument}: {tuple(unit)!r} is not allowed; {error}.") from None
