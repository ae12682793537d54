"""The rig of the landing gear study: two dampers, fourteen experiments with an imposed displacement, recordings.

Everything is SYNTHETIC. A servo-hydraulic actuator moves the axle about a mean compression of 0.12 m. Its oil supply
limits the speed to 0.25 m/s (2.9 kW at the largest force), 2π · frequency · half stroke, so that large strokes are slow
and fast ones small. The motion is a sine with the harmonics of a servo valve, 0.4 % second and 0.3 % third. Recorded
are displacement, force on the axle and gas pressure over 40 cycles at 353.275 samples per cycle, with independent
normal noise: of full scale (0.2 m, 20 kN, 2.5 MPa) 0.02 % for the displacement, 0.3 % for force and pressure.

Truth A is eq. (9) of de Kraker, Verbeek & van de Wouw (1997). Truth B adds effects that it lacks, one switch each:

flexure
    The displacement is measured at the actuator, and rod, fork and frame between it and the strut deform by
    `flexibility` times the force less the static load. Friction changes sign with the motion, so that the gas follows
    the measured displacement with a lost motion of about flexibility · 450 N. The pressure lags, the opposite of the
    effect of heat conduction, and the more so the smaller the stroke. (Internal friction of struts: Milwitzky & Cook,
    Analysis of landing-gear behavior, NACA Report 1154, 1953.)
line
    The pressure reaches its transducer through a narrow line, a `delay` later; to first order p − delay · ṗ, whose
    error is below 1e-5 of the pressure at 6 Hz. Equal at all strokes, it grows with the frequency. (Bergh & Tijdeman,
    Theoretical and experimental results for the dynamic response of pressure measuring systems, NLR-TR F.238, 1965.)
convection
    The wall takes more heat from moving gas: theta16 is multiplied by 1 + |q̇|/`convection_speed`. (Newton's law with a
    constant coefficient fails in a periodically compressed gas: Hartig, Depp, Rexer & Pelz, arXiv:2012.06526, 2020.)
friction_heat
    The share `heat_share` of the friction's power warms the gas instead of the strut.
"""

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

import bayesperiodic as bp
from studies.gear import GEAR

STRENGTHS = {
    "flexure": {"flexibility": 9e-8, "static_load": 6650.0},
    "line": {"delay": 1e-4},
    "convection": {"convection_speed": 1.0},
    "friction_heat": {"heat_share": 0.02},
}
TRUTHS = {"A": frozenset[str](), "B": frozenset(STRENGTHS)}
UNITS = bp.models.landing_gear("force").units | {
    "flexibility": "m/N", "static_load": "N", "delay": "s", "convection_speed": "m/s", "heat_share": "1",
    "temperature": "K", "compression": "m",
}  # fmt: skip


def parameters(effects: Iterable[str]) -> dict[str, float]:
    """Return every parameter of the damper with these effects."""
    return GEAR | {name: value for effect in sorted(effects) for name, value in STRENGTHS[effect].items()}


class Strut(NamedTuple):
    """Eq. (9) at a compression, in the symbols of a model: velocity, gas pressure, friction and axial force."""

    q: sp.Expr
    v: sp.Expr
    pressure: sp.Expr
    friction: sp.Expr
    force: sp.Expr


def strut(p: Any, q: Any, v: Any, acceleration: Any, temperature: Any) -> Strut:
    """Return pressure, friction and force for a motion of the strut."""
    pressure = p.theta5 * temperature / (1 + p.theta6 * q + p.theta7 * temperature)
    friction = (p.theta8 + p.theta9 * pressure) * sp.atan(p.theta10 * v)
    oil = p.theta3 * v * abs(v)
    inertia = p.theta1 * (acceleration + p.theta2)
    return Strut(q, v, pressure, friction, inertia + oil + p.theta4 * pressure + friction + p.theta11)


def heat_balance(effects: frozenset[str], s: Any, p: Any, at: Strut) -> sp.Expr:
    """Return the energy balance of the gas."""
    conduction = p.theta16 * (1 + p.theta6 * at.q) * (s.T + p.theta17)
    if "convection" in effects:
        conduction *= 1 + abs(at.v) / p.convection_speed
    heat = p.theta15 * s.dT + conduction - (p.theta4 * at.pressure + p.theta11) * at.v
    return heat - p.heat_share * at.friction * at.v if "friction_heat" in effects else heat


@cache
def damper(effects: frozenset[str]) -> bp.Model:
    """Return the damper under an imposed displacement, with the effects named; without any, eq. (9).

    States are the gas temperature T [K] and, with "flexure", the compression q [m]; outputs force, pressure and, unseen
    by any instrument, temperature and compression.
    """
    flexure = "flexure" in effects

    def at(s: Any, p: Any, u: Any) -> Strut:
        given = u.displacement - p.theta12, u.ddisplacement, u.dddisplacement
        return strut(p, *((s.q, s.dq, s.ddq) if flexure else given), s.T)

    def equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
        here = at(s, p, u)
        heat = heat_balance(effects, s, p, here)
        if not flexure:
            return [heat]
        return [u.displacement - p.theta12 - here.q - p.flexibility * (here.force - p.static_load), heat]

    def outputs(s: Any, p: Any, u: Any) -> dict[str, sp.Expr]:
        here = at(s, p, u)
        rate = here.pressure.diff(s.T) * s.dT + here.pressure.diff(s.q if flexure else u.displacement) * here.v
        measured = here.pressure - p.delay * rate if "line" in effects else here.pressure
        return {"force": here.force, "pressure": measured, "temperature": s.T, "compression": here.q}

    states = ("q", "T") if flexure else ("T",)
    return bp.Model(
        "_".join(["landing_gear_truth", *sorted(effects)]), states=states, inputs=["displacement"],
        parameters={name: UNITS[name] for name in parameters(effects)},
        units={n: UNITS[n] for n in (*states, "displacement", "force", "pressure", "temperature", "compression")},
        equations=equations, outputs=outputs,
        description="A landing gear damper with effects that eq. (9) lacks, see `studies.landing_gear.rig`.",
    )  # fmt: skip


MEAN_COMPRESSION = 0.12
SPEED_LIMIT = 0.25
HARMONICS = {1: 1.0, 2: 0.004j, 3: 0.003}
CYCLES, RECORDED = 40, 14_131
# [s], [K]
STRETCH, SETTLED, ROUNDS = 4.0, 1e-5, 12
FULL_SCALE = {"displacement": 0.2, "force": 2e4, "pressure": 2.5e6}
NOISE_SHARE = {"displacement": 2e-4, "force": 3e-3, "pressure": 3e-3}
NOISE = {channel: NOISE_SHARE[channel] * FULL_SCALE[channel] for channel in FULL_SCALE}

# Parameters of a gear that are not those of `GEAR`, with their values.
Changed = frozenset[tuple[str, float]]
SAME: Changed = frozenset()


@dataclass(frozen=True)
class Run:
    """One experiment of the rig: frequency [Hz] and half stroke, the displacement's amplitude [m]."""

    frequency: float
    stroke: float

    @property
    def name(self) -> str:
        """Name in tables, figures and parameters."""
        return f"{self.frequency:g} Hz {1e3 * self.stroke:g} mm"

    @property
    def speed(self) -> float:
        """The largest speed of the sine [m/s]."""
        return 2 * np.pi * self.frequency * self.stroke


RUNS = tuple(
    Run(frequency, 1e-3 * stroke)
    for frequency, stroke in (
        (0.05, 80), (0.1, 80), (0.2, 80), (0.2, 30), (0.4, 80), (0.5, 60), (0.5, 3),
        (1.0, 36), (1.0, 18), (2.0, 18), (2.0, 3), (3.0, 4), (4.0, 8), (6.0, 4),
    )
)  # fmt: skip


def imposed(run: Run, samples: int) -> np.ndarray:
    """Return the displacement [m] over a cycle."""
    phase = 2j * np.pi * np.arange(samples)[:, None] / samples * list(HARMONICS)
    return MEAN_COMPRESSION + run.stroke * (np.exp(phase) @ list(HARMONICS.values())).real


def measure(run: Run, effects: Iterable[str], seed: int, changed: Changed = SAME) -> bp.Recording:
    """Return the recording of one experiment with noise, of a gear with some parameters changed."""
    clean = steady(run, frozenset(effects), changed)
    generator = np.random.default_rng([zlib.crc32(run.name.encode()), seed])
    signals = {**clean.inputs, **clean.outputs}
    noisy = {name: signals[name] + NOISE[name] * generator.standard_normal(RECORDED) for name in NOISE}
    given = {"displacement": noisy.pop("displacement")}
    return bp.Recording(clean.time, noisy, given, name=run.name, synthetic=True)


@cache
def steady(run: Run, effects: frozenset[str], changed: Changed = SAME) -> bp.Recording:
    """Return 40 steady cycles without noise, by time integration.

    One cycle is integrated with a sample at each phase that the recorded ones have: their number, 14,131, and that of
    the cycles have no common divisor, so that sample k of the recording is that of phase 40·k mod 14,131.
    """
    cycle = integrate_steady(run, effects, RECORDED, changed)
    phase = np.arange(RECORDED) * CYCLES % RECORDED
    time = np.arange(RECORDED) * CYCLES / (RECORDED * run.frequency)
    outputs, inputs = ({n: v[phase] for n, v in signals.items()} for signals in (cycle.outputs, cycle.inputs))
    return bp.Recording(time, outputs, inputs, name=run.name, synthetic=True)


def integrate_steady(run: Run, effects: frozenset[str], samples: int, changed: Changed = SAME) -> bp.Recording:
    """Return one steady cycle without noise, end point excluded, by `bp.simulate`.

    The gas takes minutes to reach its mean temperature, to which its distance falls by the same factor in every cycle.
    So the integration starts again from the limit that three segments predict (Aitken), until it remains there.
    """
    values = parameters(effects) | dict(changed)
    start = {"T": -values["theta17"]}
    if "flexure" in effects:
        start["q"] = MEAN_COMPRESSION + run.stroke

    def integrate(cycles: int, samples: int) -> bp.Recording:
        return bp.simulate(
            damper(effects), values, {"displacement": imposed(run, 16)}, frequency=run.frequency,
            duration=(cycles + 0.5 / samples) / run.frequency, sampling_rate=samples * run.frequency, start=start,
        )  # fmt: skip

    stretch = int(np.ceil(STRETCH * run.frequency))
    for _ in range(ROUNDS):
        found = integrate(3 * stretch, 1).outputs
        first, second, third = found["temperature"][stretch::stretch]
        bend = first - 2 * second + third
        limit = third - (third - second) ** 2 / bend if bend else third
        settled = abs(limit - start["T"]) < SETTLED
        start["T"] = limit
        if "flexure" in effects:
            start["q"] = found["compression"][-1]
        if settled:
            # The error of the starting speed decays within milliseconds.
            two = integrate(2, samples)
            return two.between(two.time[samples], two.time[2 * samples - 1])
    raise RuntimeError(f"{run.name}: the gas temperature has not settled.")
