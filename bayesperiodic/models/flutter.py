"""A pitching and heaving aerofoil in a wind: the flutter rig of Lee, Barton and Renson."""

from typing import Any

import sympy as sp

from bayesperiodic.models.model import Model

# Jones's approximation of Wagner's function: 1 − c1 exp(−c2 s) − c3 exp(−c4 s) after s half chords.
C1, C2, C3, C4 = (sp.Rational(n, 10_000) for n in (1650, 455, 3350, 3000))
AT_ONCE = 1 - C1 - C3


def _equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
    air, arm = sp.pi * p.rho * p.b**2 * p.span, p.a + sp.Rational(1, 2)
    coupling = p.b * p.m * p.x_alpha - p.a * p.b * air
    lift = 2 * air / p.b * AT_ONCE * (p.U * s.dh + p.U**2 * s.alpha)
    lag = 2 * air / p.b * p.U**2 * ((C1 * C2 + C3 * C4) * s.dw + C2 * C4 * (C1 + C3) * p.U / p.b * s.w)
    heave = (
        (p.m_T + air) * s.ddh
        + coupling * s.ddalpha
        + p.c_h * s.dh
        + (1 + AT_ONCE * (1 - 2 * p.a)) * air * p.U * s.dalpha
        + p.k_h * s.h
        + lift
        + lag
    )
    pitch = (
        coupling * s.ddh
        + (p.I_alpha + (sp.Rational(1, 8) + p.a**2) * p.b**2 * air) * s.ddalpha
        + (p.c_alpha + (1 - arm) * (1 - 2 * AT_ONCE * arm) * air * p.b * p.U) * s.dalpha
        + p.k_alpha * s.alpha
        + p.k_alpha2 * s.alpha**2
        + p.k_alpha3 * s.alpha**3
        - p.b * arm * (lift + lag)
    )
    wake = (
        s.ddw
        - s.dh / p.b
        - (1 - arm) * s.dalpha
        + (C2 + C4) * p.U / p.b * s.dw
        - p.U / p.b * s.alpha
        + C2 * C4 * p.U**2 / p.b**2 * s.w
    )
    return [heave, pitch, wake]


flutter = Model(
    "flutter",
    states=["h", "alpha", "w"],
    parameters={
        "U": "m/s",
        "b": "m",
        "a": "1",
        "span": "m",
        "rho": "kg/m^3",
        "x_alpha": "1",
        "m": "kg",
        "m_T": "kg",
        "I_alpha": "kg m^2",
        "c_h": "N s/m",
        "c_alpha": "N m s",
        "k_h": "N/m",
        "k_alpha": "N m",
        "k_alpha2": "N m",
        "k_alpha3": "N m",
        "gain_heave": "1/m",
        "gain_pitch": "1",
        "offset_heave": "1",
        "offset_pitch": "1",
    },
    units={"h": "m", "alpha": "rad", "w": "s", "heave": "1", "pitch": "1"},
    equations=_equations,
    outputs=lambda s, p, u: {
        "heave": p.offset_heave + p.gain_heave * s.h,
        "pitch": p.offset_pitch + p.gain_pitch * s.alpha,
    },
    description="""An aerofoil on springs that may heave and pitch in a wind, and flutters from a certain wind speed on.

    Heave h and pitch α (state alpha) of a section of half chord b, with unsteady aerodynamics of one lag state w, as
    published with measured stable and unstable limit cycles by K. H. Lee, D. A. W. Barton and L. Renson (Modelling of
    physical systems with a Hopf bifurcation using mechanistic models and machine learning, Mechanical Systems and
    Signal Processing 191, 2023, 110173). With q = (h, α, w), M q̈ + D(U) q̇ + K(U) q + (0, k_alpha2 α² + k_alpha3 α³,
    0) = 0: the air (density rho, wing of length span) adds mass, damping and stiffness, lift grows with the wind speed
    U, and the wake, Wagner's function in Jones's approximation, remembers past motion. The spring in pitch hardens, so
    that cycles exist below the speed at which the equilibrium loses its stability: an unstable one inside a stable one.
    The wing, of mass m, pitches about an axis that lies a·b behind the middle of the chord and x_alpha·b ahead of its
    centre of mass, with the inertia I_alpha; all that heaves weighs m_T. Its springs and dampers are k_h, c_h in
    heave and k_alpha, k_alpha2, k_alpha3, c_alpha in pitch. The sensors' readings are linear: heave = offset_heave +
    gain_heave h, pitch = offset_pitch + gain_pitch α. For self-excited systems whose unstable cycles are measured too.

    Examples
    --------
    >>> import bayesperiodic as bp
    >>> rig = {"b": 0.15, "span": 1, "a": -0.5, "rho": 1.204, "x_alpha": 0.234, "m": 5.3, "m_T": 16.9,
    ...     "I_alpha": 0.1726, "c_h": 15.443, "c_alpha": 0.562767, "k_h": 3529.4, "k_alpha": 54.1162, "k_alpha2": 751.6,
    ...     "k_alpha3": 5006, "gain_heave": 1, "gain_pitch": 1, "offset_heave": 0, "offset_pitch": 0}
    >>> bp.hopf_points(bp.models.flutter, rig, "U", between=(5, 25))
    (HopfPoint('flutter', U = 18.2747, 2.4663 Hz),)
    """,
)
