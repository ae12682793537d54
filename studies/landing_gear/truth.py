"""The two dampers behind the synthetic measurements of the landing gear study: eq. (9), and one with more physics.

Truth A is eq. (9) of de Kraker, Verbeek & van de Wouw (1997). Truth B adds effects that it lacks, one switch each:

flexure
    The displacement is measured at the actuator, and rod, fork and frame between it and the strut give way by
    `flexibility` times the force, counted from the static load. Friction turns its sign with the motion, so that the
    gas follows the measured displacement with a lost motion of about flexibility · 450 N, whatever the stroke. The
    pressure lags the measured displacement, the opposite of what heat conduction does, and the more so the smaller the
    stroke. (Internal friction of struts: Milwitzky & Cook, Analysis of landing-gear behavior, NACA Report 1154, 1953.)
line
    The pressure reaches its transducer through a narrow line, a `delay` later; taken to first order, p − delay · ṗ,
    whose error is below 1e-5 of the pressure at 6 Hz. The same at every stroke, it grows with the frequency. (Bergh &
    Tijdeman, Theoretical and experimental results for the dynamic response of pressure measuring systems, NLR-TR F.238,
    1965.)
convection
    The wall takes more heat from moving gas: theta16 is multiplied by 1 + |q̇|/`convection_speed`. (Newton's law with a
    constant coefficient fails in a periodically compressed gas: Hartig, Depp, Rexer & Pelz, arXiv:2012.06526, 2020.)
friction_heat
    The share `heat_share` of the friction's power warms the gas instead of the strut.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import sympy as sp

import bayesperiodic as bp

# The scale of a nose gear: pressures of 1 to 2.3 MPa, forces to 11 kN, 0.8 mol of nitrogen.
GEAR = {
    "theta1": 80.0, "theta2": 0.0, "theta3": 8e3, "theta4": 5e-3, "theta5": 1e6 / 293, "theta6": -2.5, "theta7": 0.0,
    "theta8": 150.0, "theta9": 1e-4, "theta10": 300.0, "theta11": -500.0, "theta12": 0.0, "theta15": 17.0,
    "theta16": 2.0, "theta17": -293.0,
}  # fmt: skip
STRENGTHS = {
    "flexure": {"flexibility": 9e-8, "static_load": 6650.0},
    "line": {"delay": 1e-4},
    "convection": {"convection_speed": 1.0},
    "friction_heat": {"heat_share": 0.02},
}
TRUTHS = {"A": frozenset[str](), "B": frozenset(STRENGTHS)}

_UNITS = {"flexibility": "m/N", "static_load": "N", "delay": "s", "convection_speed": "m/s", "heat_share": "1"}
_UNITS |= {name: unit for name, unit in bp.models.landing_gear("force").units.items() if name not in _UNITS}


def parameters(effects: Iterable[str]) -> dict[str, float]:
    """Return every parameter of the damper with these effects."""
    return GEAR | {name: value for effect in sorted(effects) for name, value in STRENGTHS[effect].items()}


@cache
def damper(effects: frozenset[str]) -> bp.Model:
    """Return the damper under an imposed displacement, with the effects named; without any, eq. (9).

    States are the gas temperature T [K] and, with "flexure", the compression q [m]; outputs force, pressure and, unseen
    by any instrument, temperature and compression.
    """
    flexure, names = "flexure" in effects, parameters(effects)

    def equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
        at = _At(effects, s, p, u)
        conduction = p.theta16 * (1 + p.theta6 * at.q) * (s.T + p.theta17)
        if "convection" in effects:
            conduction *= 1 + abs(at.v) / p.convection_speed
        heat = p.theta15 * s.dT + conduction - (p.theta4 * at.pressure + p.theta11) * at.v
        if "friction_heat" in effects:
            heat -= p.heat_share * at.friction * at.v
        if not flexure:
            return [heat]
        return [u.displacement - p.theta12 - at.q - p.flexibility * (at.force - p.static_load), heat]

    def outputs(s: Any, p: Any, u: Any) -> dict[str, sp.Expr]:
        at = _At(effects, s, p, u)
        rate = at.pressure.diff(s.T) * s.dT + at.pressure.diff(s.q if flexure else u.displacement) * at.v
        measured = at.pressure - p.delay * rate if "line" in effects else at.pressure
        return {"force": at.force, "pressure": measured, "temperature": s.T, "compression": at.q}

    states, channels = [*(["q"] if flexure else []), "T"], ("displacement", "force", "pressure")
    return bp.Model(
        "_".join(["landing_gear_truth", *sorted(effects)]),
        states=states,
        inputs=["displacement"],
        parameters={name: _UNITS[name] for name in names},
        units={name: _UNITS[name] for name in (*states, *channels)} | {"temperature": "K", "compression": "m"},
        equations=equations,
        outputs=outputs,
        description="A landing gear damper with effects that eq. (9) lacks, see `studies.landing_gear.truth`.",
    )


class _At:
    """Motion, gas pressure, friction and force of eq. (9) in the symbols of a model."""

    def __init__(self, effects: frozenset[str], s: Any, p: Any, u: Any):
        given = u.displacement - p.theta12, u.ddisplacement, u.dddisplacement
        self.q, self.v, acceleration = (s.q, s.dq, s.ddq) if "flexure" in effects else given
        self.pressure = p.theta5 * s.T / (1 + p.theta6 * self.q + p.theta7 * s.T)
        self.friction = (p.theta8 + p.theta9 * self.pressure) * sp.atan(p.theta10 * self.v)
        oil = p.theta3 * self.v * abs(self.v)
        inertia = p.theta1 * (acceleration + p.theta2)
        self.force = inertia + oil + p.theta4 * self.pressure + self.friction + p.theta11
