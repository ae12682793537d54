"""Smooth stand-ins for sign and absolute value, each with a width named in the units of its argument."""

import sympy as sp

from bayesperiodic import checks


def smooth_sign(x: sp.Expr, width: float | sp.Expr) -> sp.Expr:
    """Return tanh(x / width), a smooth sign.

    Parameters
    ----------
    x : sympy expression
    width : number > 0 or sympy expression, in the units of `x`
        At ``|x|`` = width the value is 0.76, at 3 width 0.995. A transition crossed in only a few grid steps is
        not resolved by any difference scheme.

    Returns
    -------
    sympy expression
        Without a unit.

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    Coulomb friction of 20 N whose sign changes over within about ±1 mm/s:

    >>> import sympy as sp, bayesperiodic as bp
    >>> v = sp.Symbol("v")
    >>> friction = 20 * bp.smooth_sign(v, 1e-3)
    >>> [round(float(friction.subs(v, speed)), 2) for speed in (-1e-3, 0, 1e-3, 1e-2)]
    [-15.23, 0.0, 15.23, 20.0]
    """
    return sp.tanh(x / _width(width))


def smooth_abs(x: sp.Expr, width: float | sp.Expr) -> sp.Expr:
    """Return sqrt(x² + width²) − width, a smooth absolute value that is zero at zero.

    Parameters
    ----------
    x : sympy expression
    width : number > 0 or sympy expression, in the units of `x`
        Far from zero the value is ``|x|`` − width; the curvature at zero is 1 / width.

    Returns
    -------
    sympy expression
        In the unit of `x`.

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    >>> import sympy as sp, bayesperiodic as bp
    >>> v = sp.Symbol("v")
    >>> [round(float(bp.smooth_abs(v, 0.1).subs(v, speed)), 3) for speed in (0, 0.1, 1, -10)]
    [0.0, 0.041, 0.905, 9.9]
    """
    w = _width(width)
    return sp.sqrt(x**2 + w**2) - w


def _width(width: float | sp.Expr) -> sp.Expr:
    if isinstance(width, sp.Expr) and not width.is_number:
        return width
    return sp.Float(checks.positive("width", width))
