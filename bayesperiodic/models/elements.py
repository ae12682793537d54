"""Elements: forces of nonlinear parts as symbolic expressions, for the equations of models."""

import sympy as sp

from bayesperiodic import _checks

__all__ = ["gap", "ramp"]


def ramp(x: sp.Expr, width: float | sp.Expr) -> sp.Expr:
    """Return max(x, 0) with a quadratic transition where ``|x|`` is below half the width.

    Parameters
    ----------
    x : sympy expression
    width : number > 0 or sympy expression, in the unit of `x`
        Of the transition; outside it the value is exactly 0 or x, and the largest deviation is width/8, at x = 0. A
        difference scheme needs several grid steps within the transition.

    Returns
    -------
    sympy expression, in the unit of `x`
        With a continuous first derivative.

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    >>> import sympy as sp
    >>> x = sp.Symbol("x", real=True)
    >>> [round(float(bp.elements.ramp(x, 0.1).subs(x, value)), 4) for value in (-1, -0.05, 0, 0.05, 1)]
    [0.0, 0.0, 0.0125, 0.05, 1.0]
    """
    w = _width(width)
    return sp.Piecewise((sp.Integer(0), x <= -w / 2), (x, x >= w / 2), ((x + w / 2) ** 2 / (2 * w), True))


def gap(x: sp.Expr, k: sp.Expr | float, clearance: sp.Expr | float, width: float | sp.Expr) -> sp.Expr:
    """Return the force of a spring that is in contact beyond a clearance, k·max(x − clearance, 0).

    Parameters
    ----------
    x : sympy expression
        Displacement towards the stop [m].
    k : sympy expression or number
        Stiffness in contact [N/m].
    clearance : sympy expression or number
        Displacement at which contact begins [m].
    width : number > 0 or sympy expression
        Of the transition [m], see `ramp`. Farther than width/2 from contact the force is exactly zero.

    Returns
    -------
    sympy expression [N]

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    A stop of 20 N/m at 0.5 m:

    >>> model = bp.Model("stop", states=["x"], inputs=["force"], parameters=["c", "k", "kg"],
    ...     equations=lambda s, p, u: [s.ddx + p.c*s.dx + p.k*s.x + bp.elements.gap(s.x, p.kg, 0.5, 0.01) - u.force],
    ...     outputs=lambda s, p, u: {"x": s.x})
    >>> import sympy as sp
    >>> x = sp.Symbol("x", real=True)
    >>> [round(float(bp.elements.gap(x, 20, 0.5, 0.01).subs(x, value)), 9) for value in (0, 0.49, 0.6)]
    [0.0, 0.0, 2.0]
    """
    return k * ramp(x - clearance, width)


def smooth_sign(x: sp.Expr, width: float | sp.Expr) -> sp.Expr:
    """Return tanh(x / width), a smooth sign.

    Parameters
    ----------
    x : sympy expression
    width : number > 0 or sympy expression, in the units of `x`
        The value is 0.76 at ``|x|`` = width and 0.995 at 3 width. Difference schemes do not resolve a transition within
        a few grid steps.

    Returns
    -------
    sympy expression, dimensionless

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    Coulomb friction of 20 N with a transition within about ±1 mm/s:

    >>> import sympy as sp
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
    x, width : sympy expression, and number > 0 or sympy expression in the same unit
        The value tends to ``|x|`` − width for large ``|x|``; the curvature at zero is 1 / width. So
        (x + smooth_abs)/2 is no ramp: it tends to −width/2 for large negative x; see `ramp`.

    Returns
    -------
    sympy expression, in the unit of `x`

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    >>> import sympy as sp
    >>> v = sp.Symbol("v")
    >>> [round(float(bp.smooth_abs(v, 0.1).subs(v, speed)), 3) for speed in (0, 0.1, 1, -10)]
    [0.0, 0.041, 0.905, 9.9]
    """
    w = _width(width)
    return sp.sqrt(x**2 + w**2) - w


def _width(width: float | sp.Expr) -> sp.Expr:
    if isinstance(width, sp.Expr) and not width.is_number:
        return width
    return sp.Float(_checks.positive("width", width))
