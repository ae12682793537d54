"""Smooth stand-ins for sign and absolute value, each with a width named in the units of its argument."""

import sympy as sp

from bayesperiodic import checks


def smooth_sign(x: sp.Expr, width: float | sp.Expr) -> sp.Expr:
    """Return tanh(x / width), a smooth sign.

    Parameters
    ----------
    x : sympy expression
    width : number > 0 or sympy expression, in the units of `x`
        At |x| = width the value is 0.76, at 3 width 0.995. A transition crossed in only a few grid steps is
        not resolved by any difference scheme.

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.
    """
    return sp.tanh(x / _width(width))


def smooth_abs(x: sp.Expr, width: float | sp.Expr) -> sp.Expr:
    """Return sqrt(x² + width²) − width, a smooth absolute value that is zero at zero.

    Parameters
    ----------
    x : sympy expression
    width : number > 0 or sympy expression, in the units of `x`
        Far from zero the value is |x| − width; the curvature at zero is 1 / width.

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.
    """
    w = _width(width)
    return sp.sqrt(x**2 + w**2) - w


def _width(width: float | sp.Expr) -> sp.Expr:
    if isinstance(width, sp.Expr) and not width.is_number:
        return width
    return sp.Float(checks.positive("width", width))
