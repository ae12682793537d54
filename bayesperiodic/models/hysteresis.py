"""Elements with internal states: friction that is elastic before it slides.

Their states are dimensionless, 1 at the limit force. All rates are proportional to the velocity, so that the force
depends on the path and not on its speed.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import sympy as sp

from bayesperiodic import _checks
from bayesperiodic.models.names import Names

# Slope of the slip of a Jenkins element below its limit: of a motion without sliding the mean force follows from it.
MICROSLIP = 1e-3
# Of the weakest slider of an Iwan element, its travel up to sliding as a part of that of the strongest one.
SMALLEST_TRAVEL = 0.02
# Added to squares, so that derivatives by an exponent exist at zero.
NEARLY_ZERO = 1e-20
Number: TypeAlias = "sp.Expr | float"


class Hysteretic(NamedTuple):
    """Force of an element with internal states, and the equations of these states.

    Parameters
    ----------
    force : sympy expression [N]
        To be added to the equation of motion, on the side of the springs.
    equations : tuple of sympy expressions [1/s]
        One per state, to be appended to the equations of the model.

    Examples
    --------
    >>> model = bp.Model("rubbing", states=["x", "joint"], inputs=["force"], parameters=["k", "kt", "limit"],
    ...     equations=lambda s, p, u: (lambda joint: [s.ddx + p.k*s.x + joint.force - u.force, *joint.equations])(
    ...         bp.elements.dahl(s, "joint", s.dx, p.kt, p.limit)),
    ...     outputs=lambda s, p, u: {"x": s.x})
    >>> model.orders
    {'x': 2, 'joint': 1}
    """

    force: sp.Expr
    equations: tuple[sp.Expr, ...]


def dahl(s: Names, name: str, v: sp.Expr, stiffness: Number, limit: Number) -> Hysteretic:
    """Return Dahl friction: elastic at small motions, and approaching a limit force exponentially.

    With the state z of this name the force is F = limit·z, and dF/dt = stiffness·(v − ``|v|`` z), [1]_ with exponent 1.
    In a cycle between −X and X it dissipates 4·limit·(X − travel·tanh(X/travel)), travel = limit/stiffness.

    Parameters
    ----------
    s : states of the model
        The argument of `equations`.
    name : str
        State of the element, to be listed in the `states` of the model.
    v : sympy expression [m/s]
        Relative velocity.
    stiffness : sympy expression or number > 0 [N/m]
        Just after a reversal from zero force.
    limit : sympy expression or number > 0 [N]
        Force of sliding.

    Returns
    -------
    Hysteretic

    Raises
    ------
    ValueError
        If the model has no such state, or a number is not positive and finite.

    References
    ----------
    .. [1] P. R. Dahl, Solid friction damping of mechanical vibrations, AIAA Journal 14, 1976, 1675-1682.

    Examples
    --------
    >>> def equations(s, p, u):
    ...     joint = bp.elements.dahl(s, "joint", s.dx, p.stiffness, p.limit)
    ...     return [s.ddx + p.k * s.x + joint.force - u.force, *joint.equations]
    >>> model = bp.Model("rubbing", states=["x", "joint"], inputs=["force"], parameters=["k", "stiffness", "limit"],
    ...                  equations=equations, outputs=lambda s, p, u: {"x": s.x})
    """
    return bouc_wen(s, name, v, stiffness, limit, exponent=1, shape=1)


def bouc_wen(
    s: Names, name: str, v: sp.Expr, stiffness: Number, limit: Number, exponent: Number, shape: Number
) -> Hysteretic:
    """Return the hysteretic force of Bouc and Wen without redundant parameters.

    With the state z of this name the force is F = limit·z, and [1]_::

        dF/dt = stiffness·(v − (shape·|v| sgn(z) + (1 − shape)·v)·|z|^exponent)

    The parallel spring of the usual form (stiffness after yield) is a spring of its own in the equation of motion.
    Exponent and shape 1 are Dahl friction. For large exponents the force tends to elastic, ideally plastic friction,
    `jenkins`. A force that does not reverse drifts under small superposed motions, unlike that of `jenkins`.

    Parameters
    ----------
    s : states of the model
        The argument of `equations`.
    name : str
        State of the element, to be listed in the `states` of the model.
    v : sympy expression [m/s]
        Relative velocity.
    stiffness : sympy expression or number > 0 [N/m]
        At zero force.
    limit : sympy expression or number > 0 [N]
        Force of sliding, which is approached.
    exponent : sympy expression or number > 0
        Sharpness of the yield.
    shape : sympy expression or number
        Of unloading: straight for 1/2, bulging above, pinched below; at least 1/2 for passive friction.

    Returns
    -------
    Hysteretic

    Raises
    ------
    ValueError
        If the model has no such state, or a number is not positive and finite.

    References
    ----------
    .. [1] F. Ma, H. Zhang, A. Bockstedte, G. C. Foliente, P. Paevere, Parameter analysis of the differential model of
       hysteresis, Journal of Applied Mechanics 71, 2004, 342-349.

    Examples
    --------
    >>> def equations(s, p, u):
    ...     mount = bp.elements.bouc_wen(s, "mount", s.dx, p.stiffness, p.limit, p.exponent, 0.5)
    ...     return [s.ddx + p.k * s.x + mount.force - u.force, *mount.equations]
    >>> model = bp.Model("isolator", states=["x", "mount"], inputs=["force"],
    ...                  parameters=["k", "stiffness", "limit", "exponent"], equations=equations,
    ...                  outputs=lambda s, p, u: {"x": s.x})
    """
    stiffness, limit = _positive("stiffness", stiffness), _positive("limit", limit)
    exponent = _positive("exponent", exponent)
    if _is_number(shape):
        _checks.finite_number("shape", shape)
    z, dz = s[name], s["d" + name]
    square = z**2 + NEARLY_ZERO
    slip = shape * abs(v) * z * square ** ((exponent - 1) / 2) + (1 - shape) * v * square ** (exponent / 2)
    return Hysteretic(limit * z, (dz - stiffness / limit * (v - slip),))


def jenkins(s: Names, name: str, v: sp.Expr, stiffness: Number, limit: Number, width: Number) -> Hysteretic:
    """Return elastic dry friction: a spring in series with a slider of a limit force, a Jenkins element.

    With the state z of this name the force is F = limit·z. It is elastic, dF/dt = stiffness·v, where ``|z|`` is below
    1 − width, and at every unloading. While the force rises from there to the limit, its rate falls linearly to zero.

    In a cycle between −X and X with sliding it dissipates 4·limit·(X − travel·(1 + width²/4)), travel =
    limit/stiffness. Without rounding the last term is missing, so that a width of 0.1 changes a quarter of a percent of
    4·limit·travel.

    If nothing slides, the mean force of an ideal element is any. Here the rate of loading is smaller by
    0.001·``|z|``, so that the mean of the periodic state is determined; the dissipation by this slip is below 0.1 % of
    4·limit·travel.

    Parameters
    ----------
    s : states of the model
        The argument of `equations`.
    name : str
        State of the element, to be listed in the `states` of the model.
    v : sympy expression [m/s]
        Relative velocity.
    stiffness : sympy expression or number > 0 [N/m]
    limit : sympy expression or number > 0 [N]
        Force of sliding.
    width : number > 0 and at most 1, or sympy expression
        Part of the limit force that is rounded. The displacement has to take several grid steps for a travel of
        width·limit/stiffness. Start with 0.05; precise data need less.

    Returns
    -------
    Hysteretic

    Raises
    ------
    ValueError
        If the model has no such state, or a number is not positive and finite, or a width above 1.

    Examples
    --------
    >>> def equations(s, p, u):
    ...     joint = bp.elements.jenkins(s, "joint", s.dx, p.stiffness, p.limit, 0.1)
    ...     return [s.ddx + p.k * s.x + joint.force - u.force, *joint.equations]
    >>> model = bp.Model("rubbing", states=["x", "joint"], inputs=["force"], parameters=["k", "stiffness", "limit"],
    ...                  equations=equations, outputs=lambda s, p, u: {"x": s.x})
    """
    stiffness, limit = _positive("stiffness", stiffness), _positive("limit", limit)
    z, dz = s[name], s["d" + name]
    return Hysteretic(limit * z, (dz - stiffness / limit * _elastoplastic(z, v, _part(width)),))


def iwan(
    s: Names,
    names: Sequence[str],
    v: sp.Expr,
    stiffness: Number,
    limit: Number,
    chi: Number,
    beta: Number,
    width: Number,
) -> Hysteretic:
    """Return the four-parameter Iwan element of a joint [1]_, by Jenkins elements in parallel.

    Sliders of equal stiffness density begin to slide at displacements φ that are distributed as φ^chi up to a largest
    one, with a part at the largest one, by beta. For amplitudes X below the largest φ the dissipation per cycle is
    proportional to X^(3 + chi). The distribution is divided at φ/φmax = 0.02 … 1, in geometric steps, into one Jenkins
    element for each name but the last, which represents the part at φmax. The stiffness and the limit force of every
    interval are exact, so that those of the joint are. For chi = −0.5 and X between 0.1 and 1 of φmax the dissipation
    is within −10 … 5 % of the power law with 8 intervals, and within −4 … 3 % with 12. The cost grows with the cube of
    the number of states.

    Parameters
    ----------
    s : states of the model
        The argument of `equations`.
    names : sequence of str
        At least three states, see `iwan_states`, to be listed in the `states` of the model.
    v : sympy expression [m/s]
        Relative velocity.
    stiffness : sympy expression or number > 0 [N/m]
        Tangent stiffness of small motions, K_T.
    limit : sympy expression or number > 0 [N]
        Force of complete sliding, F_S.
    chi : sympy expression or number
        Above −1, at most 0 for most joints; see above.
    beta : sympy expression or number
        At least 0: ratio of the stiffness of the sliders at φmax to that of the others.
    width : number > 0 and at most 1, or sympy expression
        Of every Jenkins element, see `jenkins`.

    Returns
    -------
    Hysteretic

    Raises
    ------
    ValueError
        If the model has no such states, fewer than three names are given, or a number is out of range.

    References
    ----------
    .. [1] D. J. Segalman, A four-parameter Iwan model for lap-type joints, Journal of Applied Mechanics 72, 2005,
       752-760.

    Examples
    --------
    >>> names = bp.elements.iwan_states("lap", 6)
    >>> def equations(s, p, u):
    ...     lap = bp.elements.iwan(s, names, s.dx, p.K_T, p.F_S, p.chi, p.beta, 0.2)
    ...     return [p.m * s.ddx + p.k * s.x + lap.force - u.force, *lap.equations]
    >>> model = bp.Model("lap_joint", states=["x", *names], inputs=["force"],
    ...                  parameters=["m", "k", "K_T", "F_S", "chi", "beta"], equations=equations,
    ...                  outputs=lambda s, p, u: {"x": s.x})
    """
    if isinstance(names, str) or len(names) < 3:
        raise ValueError(f"names: must be at least three states, such as iwan_states('joint', 8), got {names!r}.")
    stiffness, limit = _positive("stiffness", stiffness), _positive("limit", limit)
    _check_distribution(chi, beta)
    part = _part(width)
    total = beta + (chi + 1) / (chi + 2)
    largest = limit / stiffness * (1 + beta) / total
    edges = [0, *map(sp.Float, np.geomspace(SMALLEST_TRAVEL, 1.0, len(names) - 1))]
    stiffnesses = [b ** (chi + 1) - (a and a ** (chi + 1)) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    strengths = [
        (b ** (chi + 2) - (a and a ** (chi + 2))) * (chi + 1) / (chi + 2)
        for a, b in zip(edges[:-1], edges[1:], strict=True)
    ]
    travels = [largest * f / k for f, k in zip(strengths, stiffnesses, strict=True)] + [largest]
    forces = [limit / total * weight for weight in (*strengths, beta)]
    rates = [_elastoplastic(s[name], v, part) / travel for name, travel in zip(names, travels, strict=True)]
    return Hysteretic(
        sum((force * s[name] for name, force in zip(names, forces, strict=True)), sp.S.Zero),
        tuple(s["d" + name] - rate for name, rate in zip(names, rates, strict=True)),
    )


def iwan_states(name: str, count: int) -> tuple[str, ...]:
    """Return the names of the states of an Iwan element.

    Parameters
    ----------
    name : str
        Of the element.
    count : int
        Number of its Jenkins elements, at least 3.

    Returns
    -------
    tuple of str

    Raises
    ------
    ValueError
        If the count is smaller or no integer.

    Examples
    --------
    >>> bp.elements.iwan_states("lap", 3)
    ('lap_1', 'lap_2', 'lap_3')
    """
    return tuple(f"{name}_{number + 1}" for number in range(_checks.integer("count", count, minimum=3)))


def _elastoplastic(z: sp.Expr, v: sp.Expr, width: sp.Expr) -> sp.Expr:
    """Return v reduced by the velocity of the slider of a Jenkins element, whose force is z of its limit."""
    elastic = 1 - width
    slope = (1 - MICROSLIP * elastic) / width
    slip = sp.Piecewise(
        ((slope * (z + 1) - 1) * (abs(v) - v), z <= -elastic),
        ((slope * (z - 1) + 1) * (abs(v) + v), z >= elastic),
        (MICROSLIP * (abs(v) * z + v * abs(z)), True),
    )
    return v - slip / 2


def _positive(argument: str, value: Number) -> sp.Expr:
    if not _is_number(value):
        return value
    number = _checks.positive(argument, value)
    return sp.Integer(1) if number == 1.0 else sp.Float(number)


def _check_distribution(chi: Number, beta: Number) -> None:
    if _is_number(chi) and _checks.finite_number("chi", chi) <= -1.0:
        raise ValueError(f"chi: must be > -1, got {chi!r}.")
    if _is_number(beta) and _checks.finite_number("beta", beta) < 0.0:
        raise ValueError(f"beta: must be >= 0, got {beta!r}.")


def _is_number(value: Number) -> bool:
    return not isinstance(value, sp.Expr) or bool(value.is_number)


def _part(width: Number) -> sp.Expr:
    part = _positive("width", width)
    if part.is_number and part > 1:
        raise ValueError(f"width: must be a part of the limit force, at most 1, got {width!r}.")
    return part
