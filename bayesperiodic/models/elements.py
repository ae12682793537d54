"""Elements: forces of nonlinear parts as symbolic expressions, for the equations of models.

Arguments called d, v, s and name or names are relative displacement [m], relative velocity [m/s], the states of the
model and the states of the element; all others are parameters of the element. A force acts against d and v, so that it
is added to the equation of motion on the side of the springs.
"""

from collections.abc import Mapping

import sympy as sp

from bayesperiodic import _checks
from bayesperiodic.models.hysteresis import Hysteretic, Number, bouc_wen, dahl, iwan, iwan_states, jenkins
from bayesperiodic.models.matrices import Element

__all__ = [
    "Element", "Hysteretic", "bouc_wen", "contact", "coulomb", "cubic", "dahl", "gap", "iwan", "iwan_states", "jenkins",
    "polynomial", "quadratic_damping", "ramp", "stribeck", "two_sided_gap",
]  # fmt: skip


def cubic(d: sp.Expr, k3: Number) -> sp.Expr:
    """Return the force of a cubic spring, k3·d³.

    Parameters
    ----------
    d : sympy expression [m]
        Displacement.
    k3 : sympy expression or number [N/m³]
        Hardening if positive.

    Returns
    -------
    sympy expression [N]

    Examples
    --------
    >>> import sympy as sp
    >>> bp.elements.cubic(sp.Symbol("d"), 2)
    2*d**3
    """
    return polynomial(d, {3: k3})


def polynomial(d: sp.Expr, coefficients: Mapping[int, Number]) -> sp.Expr:
    """Return the force of a polynomial spring, Σ k_n·dⁿ.

    Parameters
    ----------
    d : sympy expression [m]
        Displacement.
    coefficients : mapping of int to sympy expression or number
        k_n [N/mⁿ] by power n, at least 1.

    Returns
    -------
    sympy expression [N]

    Raises
    ------
    ValueError
        If a power is no integer or smaller than 1, or there is none.

    Examples
    --------
    >>> import sympy as sp
    >>> bp.elements.polynomial(sp.Symbol("d"), {2: -1, 3: 4})
    4*d**3 - d**2
    """
    if not _checks.mapping("coefficients", coefficients, "{2: p.k2, 3: p.k3}"):
        raise ValueError("coefficients: must have at least one power, got none.")
    powers = [_checks.integer("coefficients", power, minimum=1) for power in coefficients]
    return sum((k * d**n for n, k in zip(powers, coefficients.values(), strict=True)), sp.S.Zero)


def quadratic_damping(v: sp.Expr, c2: Number) -> sp.Expr:
    """Return the force of quadratic damping, c2·v·``|v|``, as of a body in a turbulent flow.

    It is not rounded: its first derivative is continuous. A cycle of X·cos(ωt) dissipates (8/3)·c2·ω²·X³.

    Parameters
    ----------
    v : sympy expression [m/s]
        Velocity.
    c2 : sympy expression or number [N s²/m²]

    Returns
    -------
    sympy expression [N]

    Examples
    --------
    >>> import sympy as sp
    >>> bp.elements.quadratic_damping(sp.Symbol("v", real=True), 3)
    3*v*Abs(v)
    """
    return c2 * v * abs(v)


def gap(d: sp.Expr, k: Number, clearance: Number, width: Number) -> sp.Expr:
    """Return the force of a spring that is in contact beyond a clearance, k·max(d − clearance, 0).

    Parameters
    ----------
    d : sympy expression [m]
        Displacement towards the stop.
    k : sympy expression or number [N/m]
        Stiffness in contact.
    clearance : sympy expression or number [m]
        Displacement at which contact begins.
    width : number > 0 or sympy expression [m]
        Of the transition, see `ramp`. Farther than width/2 from contact the force is exact, and zero on one side; the
        largest deviation is k·width/8.

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
    return k * ramp(d - clearance, width)


def two_sided_gap(d: sp.Expr, k: Number, clearance: Number, width: Number) -> sp.Expr:
    """Return the force of free play: two stops at −clearance and clearance, each like `gap`.

    Parameters
    ----------
    d : sympy expression [m]
        Displacement from the middle.
    k : sympy expression or number [N/m]
        Stiffness in contact.
    clearance : sympy expression or number [m]
        Half of the free play, at least width/2.
    width : number > 0 or sympy expression [m]
        Of each transition, see `gap`.

    Returns
    -------
    sympy expression [N]

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    >>> import sympy as sp
    >>> d = sp.Symbol("d", real=True)
    >>> [round(float(bp.elements.two_sided_gap(d, 20, 0.5, 0.01).subs(d, value)), 9) for value in (-0.6, 0.3, 0.6)]
    [-2.0, 0.0, 2.0]
    """
    return gap(d, k, clearance, width) - gap(-d, k, clearance, width)


def contact(d: sp.Expr, v: sp.Expr, k: Number, damping: Number, width: Number) -> sp.Expr:
    """Return the force of a unilateral contact with losses, k·max(d, 0)·(1 + damping·v).

    The damping acts during contact only, and its force begins and ends at zero [1]_. A body that hits the contact at
    the speed v0 and is free otherwise leaves it at about v0·(1 − ⅔·damping·v0), and the contact never pulls. It pulls
    where another force separates it faster than 1/damping.

    Parameters
    ----------
    d : sympy expression [m]
        Penetration, positive in contact.
    v : sympy expression [m/s]
        Its rate.
    k : sympy expression or number [N/m]
        Stiffness in contact.
    damping : sympy expression or number [s/m]
        Zero for an elastic contact.
    width : number > 0 or sympy expression [m]
        Of the transition, see `ramp`. The force is exactly zero where d is below −width/2.

    Returns
    -------
    sympy expression [N]

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    References
    ----------
    .. [1] K. H. Hunt, F. R. E. Crossley, Coefficient of restitution interpreted as damping in vibroimpact, Journal of
       Applied Mechanics 42, 1975, 440-445; exponent 1.

    Examples
    --------
    >>> import sympy as sp
    >>> d, v = sp.symbols("d v", real=True)
    >>> force = bp.elements.contact(d, v, 1000, 0.2, 1e-3)
    >>> [round(float(force.subs({d: depth, v: 0.5})), 9) for depth in (-0.01, 0.01)]
    [0.0, 11.0]
    """
    return gap(d, k, 0, width) * (1 + damping * v)


def coulomb(v: sp.Expr, limit: Number, width: Number) -> sp.Expr:
    """Return Coulomb friction, limit·sgn(v) with the sign rounded by `bayesperiodic.smooth_sign`.

    A cycle with the amplitude X and the largest speed V dissipates 4·limit·X·(1 − 0.41·(width/V)²) for small widths.
    A body does not stick: under a force below the limit it creeps, with less than 0.55·width under half of it.

    Parameters
    ----------
    v : sympy expression [m/s]
        Sliding velocity.
    limit : sympy expression or number [N]
        Friction force.
    width : number > 0 or sympy expression [m/s]
        Of the transition: 76 % of the force at this speed, 99.5 % at three times it.

    Returns
    -------
    sympy expression [N]

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    Examples
    --------
    >>> import sympy as sp
    >>> v = sp.Symbol("v")
    >>> [round(float(bp.elements.coulomb(v, 20, 1e-3).subs(v, speed)), 2) for speed in (-1e-3, 0, 1e-2)]
    [-15.23, 0.0, 20.0]
    """
    return limit * smooth_sign(v, width)


def stribeck(v: sp.Expr, static: Number, sliding: Number, speed: Number, width: Number) -> sp.Expr:
    """Return friction that falls with the speed, (sliding + (static − sliding)·exp(−(v/speed)²))·sgn(v).

    The sign is rounded by `bayesperiodic.smooth_sign`, which lowers the maximum. The form is among those in [1]_.

    Parameters
    ----------
    v : sympy expression [m/s]
        Sliding velocity.
    static : sympy expression or number [N]
        Friction force at low speed.
    sliding : sympy expression or number [N]
        Friction force at high speed.
    speed : sympy expression or number [m/s]
        Stribeck's speed: at it 37 % of the difference is left.
    width : number > 0 or sympy expression [m/s]
        Of the transition. The largest force is lower than `static` by up to 7 % for a width of speed/10, and by up to
        1.5 % for speed/30.

    Returns
    -------
    sympy expression [N]

    Raises
    ------
    ValueError
        If a numeric width is not positive and finite.

    References
    ----------
    .. [1] B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, A survey of models, analysis tools and compensation
       methods for the control of machines with friction, Automatica 30, 1994, 1083-1138.

    Examples
    --------
    >>> import sympy as sp
    >>> v = sp.Symbol("v")
    >>> friction = bp.elements.stribeck(v, 30, 20, 0.1, 1e-3)
    >>> [round(float(friction.subs(v, speed)), 2) for speed in (0.01, 0.1, 1)]
    [29.9, 23.68, 20.0]
    """
    return (sliding + (static - sliding) * sp.exp(-((v / speed) ** 2))) * smooth_sign(v, width)


def ramp(x: sp.Expr, width: Number) -> sp.Expr:
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
