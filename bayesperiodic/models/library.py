"""Library of models; ``help(bayesperiodic.models.pendulum)`` shows the equations and the source of one."""

from functools import cache
from itertools import pairwise
from typing import Any

import sympy as sp

from bayesperiodic import _checks
from bayesperiodic.models.elements import smooth_sign
from bayesperiodic.models.model import Model

duffing = Model(
    "duffing",
    states=["x"],
    inputs=["force"],
    parameters={"m": "kg", "c": "N s/m", "k": "N/m", "k3": "N/m^3"},
    units={"x": "m", "force": "N", "displacement": "m"},
    equations=lambda s, p, u: [p.m * s.ddx + p.c * s.dx + p.k * s.x + p.k3 * s.x**3 - u.force],
    outputs=lambda s, p, u: {"displacement": s.x},
    description="""A mass on a damper and a hardening or softening spring: m ẍ + c ẋ + k x + k3 x³ = force.

    The cubic term is the first nonlinear term of any smooth symmetric restoring force (G. Duffing, Erzwungene
    Schwingungen bei veränderlicher Eigenfrequenz, Vieweg, 1918). For structures near a resonance, which have up to
    three periodic solutions at one frequency.

    Examples
    --------
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": np.ones(8)},
    ...                   frequency=0.2, duration=100, sampling_rate=10)
    """,
)

dahl = Model(
    "dahl",
    states=["w"],
    inputs=["displacement"],
    parameters={"Kx": "N s/m", "K": "N/m", "F0": "N", "Kw": "N", "rho": "1/m"},
    units={"displacement": "m", "force": "N", "w": "1"},
    equations=lambda s, p, u: [s.dw - p.rho * (u.ddisplacement - abs(u.ddisplacement) * s.w)],
    outputs=lambda s, p, u: {"force": p.Kx * u.ddisplacement + p.K * u.displacement + p.F0 + p.Kw * s.w},
    description="""A damper with Dahl friction: force = Kx v + K x + F0 + Kw w, ẇ = rho (v − ``|v|`` w), x given, v = ẋ.

    Dahl friction is elastic before it slides: by dw/dx = rho (1 − w sgn v), the friction force Kw w changes between its
    sliding values −Kw and Kw within a travel of a few 1/rho, at any speed (P. R. Dahl, Solid friction damping of
    mechanical vibrations, AIAA Journal 14, 1976, 1675-1682; exponent 1). Viscous damping Kx, a stiffness K and an
    offset F0 act in parallel. For dampers and joints whose displacement is prescribed.

    Examples
    --------
    With an amplitude of 10 mm, 50 times 1/rho, friction slides most of the time and dissipates almost the
    4·Kw·10 mm = 2 J per period of ideal Coulomb friction:

    >>> x = 0.01 * np.cos(2 * np.pi * np.arange(800) / 800)
    >>> theta = {"Kx": 0, "K": 0, "F0": 0, "Kw": 50.0, "rho": 5e3}
    >>> solution = bp.solve_periodic(bp.models.dahl, theta, {"displacement": x}, frequency=1.0)
    >>> round(float(np.sum(solution.outputs["force"] * np.gradient(x))), 2)
    1.96
    """,
)


def _pendulum(s: Any, p: Any, u: Any) -> list[sp.Expr]:
    inertia, omega = p.m * p.l**2, 2 * sp.pi * s.frequency
    friction = p.k1 * smooth_sign(s.dphi, p.v0) + p.k2 * s.dphi + p.k3 * s.dphi * abs(s.dphi)
    return [s.ddphi + friction / inertia + (p.g + p.a * omega**2 * sp.cos(2 * sp.pi * s.tau)) / p.l * sp.sin(s.phi)]


_PENDULUM_UNITS = {
    "m": "kg", "l": "m", "k1": "N m", "k2": "N m s", "k3": "N m s^2", "a": "m", "g": "m/s^2", "v0": "rad/s",
}  # fmt: skip

pendulum = Model(
    "pendulum",
    states=["phi"],
    angles=["phi", "angle"],
    parameters=_PENDULUM_UNITS,
    units={"phi": "rad", "angle": "rad", "rate": "rad/s"},
    equations=_pendulum,
    outputs=lambda s, p, u: {"angle": s.phi, "rate": s.dphi},
    description="""The parametrically driven pendulum of de Kraker, Verbeek & van de Wouw (1997), equation 10.

    A point mass m on an arm l, at the angle φ (state phi) from the downward position. The height of the pivot is
    −a cos ωt, ω = 2π·frequency, so that gravity relative to the pivot is g + a ω² cos ωt. The moments about the pivot,
    divided by the inertia m l², are::

        φ̈ + [k1 tanh(φ̇/v0) + k2 φ̇ + k3 φ̇|φ̇|]/(m l²) + (g + a ω² cos ωt)/l · sin φ = 0

    with Coulomb friction in the bearing (the paper's sgn φ̇, smoothed below the speed v0), viscous damping and air
    resistance. Only the ratios k1/m, k2/m and k3/m are identifiable, not m. For stable and unstable periodic orbits,
    including those of rotating and chaotic motion: φ may wind. With the values in the example the motion is, as in the
    paper, periodic at ω = 13 rad/s and chaotic at 9.09 rad/s.

    Examples
    --------
    >>> theta = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
    >>> run = bp.simulate(bp.models.pendulum, theta, frequency=1.4467, duration=7, sampling_rate=100, start={"phi": 1})
    """,
)

silverbox = Model(
    "silverbox",
    states=["y"],
    inputs=["drive"],
    parameters={"w0": "rad/s", "c": "1", "k1": "1", "k2": "1/V", "k3": "1/V^2", "g": "1", "u0": "V"},
    units={"y": "V", "drive": "V", "response": "V"},
    equations=lambda s, p, u: [
        s.ddy / p.w0**2 + p.c * s.dy / p.w0 + p.k1 * s.y + p.k2 * s.y**2 + p.k3 * s.y**3 - p.g * u.drive - p.u0
    ],
    outputs=lambda s, p, u: {"response": s.y},
    description="""An electronic Duffing oscillator: ÿ/w0² + c ẏ/w0 + k1 y + k2 y² + k3 y³ = g drive + u0, all in volts.

    The usual model of the Silverbox, an electronic circuit that is equivalent to a mass on a hardening spring
    (T. Wigren, J. Schoukens, Three free data sets for development and benchmarking in nonlinear system identification,
    European Control Conference, 2013). k2 and u0 represent offsets of the measured signals. w0 is a time scale and not
    identifiable: twice w0 with c/2 and a quarter of the other parameters gives the same response; fix it.

    Examples
    --------
    >>> theta = {"w0": 408.4, "c": 0.1, "k1": 1.1, "k2": 0, "k3": 4.4, "g": 1.1, "u0": 0}
    >>> run = bp.simulate(bp.models.silverbox, theta, {"drive": 0.1 * np.cos(2 * np.pi * np.arange(16) / 16)},
    ...                   frequency=60, duration=0.5, sampling_rate=600)
    """,
)

van_der_pol = Model(
    "van_der_pol",
    states=["x"],
    parameters={"mu": "1", "omega": "rad/s"},
    units={"x": "1", "displacement": "1"},
    equations=lambda s, p, u: [s.ddx - p.mu * p.omega * (1 - s.x**2) * s.dx + p.omega**2 * s.x],
    outputs=lambda s, p, u: {"displacement": s.x},
    description="""A self-excited oscillator without any input: ẍ − mu omega (1 − x²) ẋ + omega² x = 0.

    Van der Pol's equation (Philosophical Magazine 2, 1926, 978-992) with time scaled by omega. The damping is negative
    for ``|x|`` < 1 and positive for ``|x|`` > 1, so that every motion except rest converges to one limit cycle, with
    amplitude about 2 and, for small mu, period (2π/omega)(1 + mu²/16 + …).

    Examples
    --------
    >>> bp.models.van_der_pol.autonomous
    True
    """,
)

_RL_DIODE_UNITS = {
    "L": "H", "R": "ohm", "R_s": "ohm", "R_L": "ohm", "C_L": "F", "V_f": "V", "C_j": "F", "Q_0": "C", "transit": "s",
    "lifetime": "s", "drift": "1/C", "C_s": "F", "bypass": "1", "offset": "V",
}  # fmt: skip


def _rl_diode(s: Any, p: Any, u: Any) -> tuple[sp.Expr, sp.Expr]:
    """Return the charge injected into the diode's base and the current of the source."""
    root = sp.sqrt(s.q**2 + p.Q_0**2)
    return (root + s.q) / 2, (u.source - s.v - p.V_f + (root - s.q) / (2 * p.C_j)) / (p.R + p.R_s)


def _rl_diode_equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
    injected, current = _rl_diode(s, p, u)
    diffusion = (injected - s.m) / p.transit
    return [
        p.L * s.di + p.R_L * s.i - s.v,
        p.C_L * s.dv + s.i - current,
        s.dq + diffusion - current,
        s.dm - diffusion + s.m / p.lifetime + p.drift * s.i * s.m,
    ]


rl_diode = Model(
    "rl_diode",
    states=["i", "v", "q", "m"],
    inputs=["source"],
    parameters=_RL_DIODE_UNITS,
    units={"i": "A", "v": "V", "q": "C", "m": "C", "source": "V", "resistor": "V"},
    equations=_rl_diode_equations,
    outputs=lambda s, p, u: {
        "resistor": p.R * (_rl_diode(s, p, u)[1] - p.bypass * s.dq + p.C_s * u.dsource) + p.offset
    },
    description="""A resistor, a coil and a diode in series with a voltage source: period doubling, windows and chaos.

    The current I of the source charges the diode, which is described by two charges (P. O. Lauritzen, C. L. Ma, IEEE
    Transactions on Power Electronics 6, 1991, 188-191): q at the junction, and m stored in the base. With the charge
    Q_0 that rounds the corner, the part q⁺ = (q + √(q² + Q_0²))/2 of q is injected carriers, and q⁻ = q⁺ − q is the
    charge of the depleted junction, with the capacitance C_j. The diode conducts at the voltage V_f until its stored
    charge is removed, and blocks then::

        source = (R + R_s) I + v + V_f − q⁻/C_j      R: resistor, R_s: in the source, v: voltage of the coil
        L i̇ + R_L i = v,  C_L v̇ = I − i              coil with its resistance and the capacitance of its winding
        q̇ = I − (q⁺ − m)/transit
        ṁ = (q⁺ − m)/transit − m/lifetime − drift i m

    transit is the time of diffusion into the base, lifetime that of recombination. The last term is empirical: current
    carries stored charge away. The output is offset + R (I − bypass q̇ + C_s d(source)/dt): C_s is a stray capacitance
    of the instrument, and a part bypass of the current into the junction is not measured (empirical). R_s is zero if
    the source is its voltage under load; for stability and other motions it has to be the voltage without load. Only
    ratios to R follow from voltages. The diode blocks within R C_j, far below a period.

    Examples
    --------
    >>> theta = {"L": 4.5e-3, "R": 1e3, "R_s": 0, "R_L": 55, "C_L": 6.4e-12, "V_f": 0.7, "C_j": 4.3e-12, "Q_0": 1.6e-11,
    ...          "transit": 5.7e-7, "lifetime": 2.8e-6, "drift": 3.4e8, "C_s": 0, "bypass": 0, "offset": 0}
    >>> wave = 10.6 * np.cos(2 * np.pi * np.arange(16) / 16)
    >>> run = bp.simulate(bp.models.rl_diode, theta, {"source": wave}, frequency=1.4e5, duration=1e-3,
    ...                   sampling_rate=1.4e5)
    >>> a, b, c = run.outputs["resistor"][-3:]
    >>> bool(abs(c - a) < 1e-3 < abs(b - a))  # the period is two periods of the source
    True
    """,
)

_GEAR_UNITS = {
    "theta1": "kg", "theta2": "m/s^2", "theta3": "N s^2/m^2", "theta4": "m^2", "theta5": "Pa/K", "theta6": "1/m",
    "theta7": "1/K", "theta8": "N", "theta9": "m^2", "theta10": "s/m", "theta11": "N", "theta12": "m",
    "theta15": "J/K", "theta16": "W/K", "theta17": "K",
}  # fmt: skip
_GEAR_CHANNELS = {"displacement": "m", "force": "N", "pressure": "Pa", "q": "m", "T": "K"}


def landing_gear(drive: str = "force") -> Model:
    r"""Return the model of a nose landing gear damper, driven by a force or by a displacement.

    The equations are eq. (9) of de Kraker, Verbeek & van de Wouw (1997, see `Model`). q is the compression and T the
    absolute temperature of the gas. The force on the axle balances inertia, quadratic oil damping, the gas pressure on
    the area theta4, Coulomb friction (with a part proportional to the pressure) smoothed by an arctan, and a constant,
    which is the ambient pressure on the same area if theta11 = −theta4 · ambient pressure:

    .. math::

        \theta_1 (\ddot q + \theta_2) + \theta_3 \dot q |\dot q| + \theta_4 p
        + (\theta_8 + \theta_9 p) \arctan(\theta_{10} \dot q) + \theta_{11} &= \mathrm{force} \\
        \theta_{15} \dot T + \theta_{16} (1 + \theta_6 q)(T + \theta_{17}) - (\theta_4 p + \theta_{11}) \dot q &= 0 \\
        p = \frac{\theta_5 T}{1 + \theta_6 q + \theta_7 T}, \qquad \mathrm{displacement} &= q + \theta_{12}

    The second row is the energy balance of the gas: heat capacity theta15, heat conduction theta16 through the wall to
    the surroundings at temperature −theta17, and the work of compression. p is the absolute pressure of an ideal gas
    with relative volume 1 + theta6 q (theta6 < 0), corrected by theta7 T. There is no theta13 or theta14.

    Parameters
    ----------
    drive : {"force", "displacement"}
        "force": states q and T, input force, outputs displacement and pressure; for a gear under a prescribed load.
        "displacement": state T, input displacement, outputs force and pressure; for a test rig with prescribed motion,
        such as the paper's, and faster to solve.

    Returns
    -------
    Model
        If theta4 is free and theta11 represents the ambient pressure, tie them.

    Raises
    ------
    ValueError
        For another drive.

    Examples
    --------
    >>> bp.models.landing_gear("displacement").outputs
    ('force', 'pressure')
    """
    _checks.one_of("drive", drive, ("force", "displacement"))
    return _landing_gear(str(drive))


@cache
def _landing_gear(drive: str) -> Model:
    forced = drive == "force"

    def terms(s: Any, p: Any, u: Any) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
        """Return pressure, force and the energy balance."""
        q, v, a = (s.q, s.dq, s.ddq) if forced else (u.displacement - p.theta12, u.ddisplacement, u.dddisplacement)
        gas = p.theta5 * s.T / (1 + p.theta6 * q + p.theta7 * s.T)
        friction = (p.theta8 + p.theta9 * gas) * sp.atan(p.theta10 * v)
        force = p.theta1 * (a + p.theta2) + p.theta3 * v * abs(v) + p.theta4 * gas + friction + p.theta11
        conduction = p.theta16 * (1 + p.theta6 * q) * (s.T + p.theta17)
        return gas, force, p.theta15 * s.dT + conduction - (p.theta4 * gas + p.theta11) * v

    def equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
        _, force, energy = terms(s, p, u)
        return [force - u.force, energy] if forced else [energy]

    def outputs(s: Any, p: Any, u: Any) -> dict[str, sp.Expr]:
        pressure, force, _ = terms(s, p, u)
        return ({"displacement": s.q + p.theta12} if forced else {"force": force}) | {"pressure": pressure}

    return Model(
        f"landing_gear_{drive}",
        states=["q", "T"] if forced else ["T"],
        inputs=[drive],
        parameters=_GEAR_UNITS,
        units={name: unit for name, unit in _GEAR_CHANNELS.items() if forced or name != "q"},
        equations=equations,
        outputs=outputs,
        description=f"""A landing gear damper with a gas spring and oil damping, its {drive} prescribed.

        De Kraker, Verbeek & van de Wouw (1997), eq. (9): balances of forces and of the energy of the gas; see the
        docstring of `bayesperiodic.models.landing_gear`.
        """,
    )


def chain(masses: int) -> Model:
    r"""Return a chain of equal masses on nonlinear springs, with the first one grounded and a force on the last mass.

    Newton's law for mass i, with the elongations e_i = x_i − x_(i−1) and x_0 = 0, is

    .. math::

        m \ddot x_i + R(e_i, \dot e_i) - R(e_{i+1}, \dot e_{i+1}) = 0,
        \qquad R(e, \dot e) = c \dot e + k e + k_3 e^3,

    with the force in place of −R after the last mass. One mass is the Duffing oscillator.

    Parameters
    ----------
    masses : int
        Number of masses, >= 1.

    Returns
    -------
    Model
        States x1, x2, …; input force; parameters m, c, k, k3; output displacement, that of the last mass.

    Raises
    ------
    ValueError
        If the number of masses is not an integer >= 1.

    Examples
    --------
    >>> bp.models.chain(3).states
    ('x1', 'x2', 'x3')
    """
    return _chain(_checks.integer("masses", masses, 1))


@cache
def _chain(masses: int) -> Model:
    states = [f"x{i}" for i in range(1, masses + 1)]

    def equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
        x = [sp.S.Zero, *(getattr(s, name) for name in states)]
        v = [sp.S.Zero, *(getattr(s, f"d{name}") for name in states)]
        elongation, rate = ([b - a for a, b in pairwise(values)] for values in (x, v))
        pull = [p.c * de + p.k * e + p.k3 * e**3 for e, de in zip(elongation, rate, strict=True)]
        pull.append(u.force)
        return [p.m * getattr(s, f"dd{name}") + pull[i] - pull[i + 1] for i, name in enumerate(states)]

    return Model(
        f"chain_{masses}",
        states=states,
        inputs=["force"],
        parameters={"m": "kg", "c": "N s/m", "k": "N/m", "k3": "N/m^3"},
        units={**dict.fromkeys(states, "m"), "force": "N", "displacement": "m"},
        equations=equations,
        outputs=lambda s, p, u: {"displacement": getattr(s, states[-1])},
        description=f"""A chain of {masses} equal masses on dampers and cubic springs, with a force on the last one.

        Newton's law for each mass; see the docstring of `bayesperiodic.models.chain`.
        """,
    )


# Jones's approximation of Wagner's function: 1 − c1 exp(−c2 s) − c3 exp(−c4 s) after a travel of s half chords.
C1, C2, C3, C4 = (sp.Rational(n, 10_000) for n in (1650, 455, 3350, 3000))
INITIAL_LIFT = 1 - C1 - C3


def _flutter(s: Any, p: Any, u: Any) -> list[sp.Expr]:
    air, arm = sp.pi * p.rho * p.b**2 * p.span, p.a + sp.Rational(1, 2)
    coupling = p.b * p.m * p.x_alpha - p.a * p.b * air
    lift = 2 * air / p.b * INITIAL_LIFT * (p.U * s.dh + p.U**2 * s.alpha)
    lag = 2 * air / p.b * p.U**2 * ((C1 * C2 + C3 * C4) * s.dw + C2 * C4 * (C1 + C3) * p.U / p.b * s.w)
    heave = (
        (p.m_T + air) * s.ddh
        + coupling * s.ddalpha
        + p.c_h * s.dh
        + (1 + INITIAL_LIFT * (1 - 2 * p.a)) * air * p.U * s.dalpha
        + p.k_h * s.h
        + lift
        + lag
    )
    pitch = (
        coupling * s.ddh
        + (p.I_alpha + (sp.Rational(1, 8) + p.a**2) * p.b**2 * air) * s.ddalpha
        + (p.c_alpha + (1 - arm) * (1 - 2 * INITIAL_LIFT * arm) * air * p.b * p.U) * s.dalpha
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


_FLUTTER_UNITS = {
    "U": "m/s", "b": "m", "a": "1", "span": "m", "rho": "kg/m^3", "x_alpha": "1", "m": "kg", "m_T": "kg",
    "I_alpha": "kg m^2", "c_h": "N s/m", "c_alpha": "N m s", "k_h": "N/m", "k_alpha": "N m", "k_alpha2": "N m",
    "k_alpha3": "N m", "gain_heave": "1/m", "gain_pitch": "1", "offset_heave": "1", "offset_pitch": "1",
}  # fmt: skip

flutter = Model(
    "flutter",
    states=["h", "alpha", "w"],
    parameters=_FLUTTER_UNITS,
    units={"h": "m", "alpha": "rad", "w": "s", "heave": "1", "pitch": "1"},
    equations=_flutter,
    outputs=lambda s, p, u: {
        "heave": p.offset_heave + p.gain_heave * s.h,
        "pitch": p.offset_pitch + p.gain_pitch * s.alpha,
    },
    description="""An aerofoil on springs with heave and pitch, which flutters above a critical wind speed.

    Heave h and pitch α (state alpha) of a section of half chord b, with unsteady aerodynamics of one lag state w, as
    published with measured stable and unstable limit cycles by K. H. Lee, D. A. W. Barton and L. Renson (Modelling of
    physical systems with a Hopf bifurcation using mechanistic models and machine learning, Mechanical Systems and
    Signal Processing 191, 2023, 110173). With q = (h, α, w), M q̈ + D(U) q̇ + K(U) q + (0, k_alpha2 α² + k_alpha3 α³,
    0) = 0. The air (density rho, wing of length span) adds mass, damping and stiffness; the lift increases with the
    wind speed U and depends on past motion through the wake, by Jones's approximation of Wagner's function. The spring
    in pitch hardens, so that limit cycles exist below the speed at which the equilibrium loses its stability: an
    unstable one inside a stable one. The wing has mass m and inertia I_alpha about its pitch axis, which is a·b behind
    the middle of the chord and x_alpha·b ahead of the centre of mass; the total heaving mass is m_T. The springs and
    dampers are k_h, c_h in heave and k_alpha, k_alpha2, k_alpha3, c_alpha in pitch. The sensors are linear: heave =
    offset_heave + gain_heave h, pitch = offset_pitch + gain_pitch α. For self-excited systems whose unstable cycles are
    also measured.

    Examples
    --------
    >>> rig = {"b": 0.15, "span": 1, "a": -0.5, "rho": 1.204, "x_alpha": 0.234, "m": 5.3, "m_T": 16.9,
    ...     "I_alpha": 0.1726, "c_h": 15.443, "c_alpha": 0.562767, "k_h": 3529.4, "k_alpha": 54.1162, "k_alpha2": 751.6,
    ...     "k_alpha3": 5006, "gain_heave": 1, "gain_pitch": 1, "offset_heave": 0, "offset_pitch": 0}
    >>> bp.hopf_points(bp.models.flutter, rig, "U", between=(5, 25))
    (HopfPoint('flutter', U = 18.2747, 2.4663 Hz),)
    """,
)
