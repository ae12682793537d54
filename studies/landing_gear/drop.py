"""Drop test of the landing gear study: a transient predicted from the posterior of periodic motions.

The rig of figure 2 of de Kraker, Verbeek & van de Wouw (1997), SYNTHETIC: a frame of 2.02 m pivots at one end and
carries a mass at the other, supported by the gear, 1.16 m high and 0.58 m wide between its joints. The mass is suddenly
released. The paper gives these three lengths; mass, inertia and initial compression are chosen so that pressures and
strokes are those of the shaker experiments. Rod and line of truth B act on the measured signals only; their effect on
the heavy frame, half a millimetre, is neglected.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import sympy as sp

import bayesperiodic as bp
from studies.landing_gear.identification import DISPLACEMENT, ENSEMBLES, Identified, draw, estimate, fold
from studies.landing_gear.rig import parameters

FRAME, HEIGHT, WIDTH = 2.02, 1.16, 0.58
MASS, GRAVITY, HELD = 690.0, 9.81, 0.02
SHORT, LONG, SAMPLING = 2.5, 30.0, 200.0
# Of the final displacement [m].
SETTLED = 1e-3
CHANNELS = ("displacement", "force", "pressure")


@dataclass(frozen=True)
class Dropped:
    """One truth's drop test."""

    identified: Identified  # All shaker experiments with theta4, theta6 and theta16 in common
    true: bp.Recording  # Without noise
    band: Any  # Posterior prediction


@cache
def drop_model(effects: frozenset[str]) -> bp.Model:
    """Return frame and gear; states: psi, the frame's angle below the horizontal [rad], and T, of the gas [K]."""
    names = (*parameters(effects), "mass")

    def compression(s: Any) -> sp.Expr:
        end = FRAME * sp.cos(s.psi), HEIGHT - FRAME * sp.sin(s.psi)
        reach = sp.sqrt((end[0] - FRAME - WIDTH) ** 2 + end[1] ** 2)
        return float(np.hypot(WIDTH, HEIGHT)) - reach

    def gear(s: Any, p: Any) -> dict[str, sp.Expr]:
        q = compression(s)
        lever = sp.diff(q, s.psi)
        v = lever * s.dpsi
        acceleration = sp.diff(lever, s.psi) * s.dpsi**2 + lever * s.ddpsi
        gas = p.theta5 * s.T / (1 + p.theta6 * q + p.theta7 * s.T)
        friction = (p.theta8 + p.theta9 * gas) * sp.atan(p.theta10 * v)
        force = p.theta1 * (acceleration + p.theta2) + p.theta3 * v * abs(v) + p.theta4 * gas + friction + p.theta11
        return {"q": q, "v": v, "lever": lever, "gas": gas, "friction": friction, "force": force}

    def equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
        at = gear(s, p)
        conduction = p.theta16 * (1 + p.theta6 * at["q"]) * (s.T + p.theta17)
        if "convection" in effects:
            conduction *= 1 + abs(at["v"]) / p.convection_speed
        heat = p.theta15 * s.dT + conduction - (p.theta4 * at["gas"] + p.theta11) * at["v"]
        if "friction_heat" in effects:
            heat -= p.heat_share * at["friction"] * at["v"]
        weight = p.mass * GRAVITY * FRAME * sp.cos(s.psi)
        return [p.mass * FRAME**2 * s.ddpsi - weight + at["force"] * at["lever"], heat]

    def outputs(s: Any, p: Any, u: Any) -> dict[str, sp.Expr]:
        at = gear(s, p)
        displacement, pressure = at["q"] + p.theta12, at["gas"]
        if "flexure" in effects:
            displacement += p.flexibility * (at["force"] - p.static_load)
        if "line" in effects:
            rate = sp.diff(pressure, s.T) * s.dT + sp.diff(pressure, s.psi) * s.dpsi
            pressure = pressure - p.delay * rate
        return {"displacement": displacement, "force": at["force"], "pressure": pressure}

    return bp.Model(
        "_".join(["landing_gear_drop", *sorted(effects)]),
        states=["psi", "T"],
        parameters=names,
        units={"psi": "rad", "T": "K", "displacement": "m", "force": "N", "pressure": "Pa"},
        equations=equations,
        outputs=outputs,
        description="A mass on a pivoting frame, carried by a landing gear; see `studies.landing_gear.drop`.",
    )


def held_angle() -> float:
    """Return the frame's angle [rad] at which the gear is compressed by `HELD`."""
    psi = sp.Symbol("psi")
    reach = sp.sqrt((FRAME * sp.cos(psi) - FRAME - WIDTH) ** 2 + (HEIGHT - FRAME * sp.sin(psi)) ** 2)
    return float(sp.nsolve(float(np.hypot(WIDTH, HEIGHT)) - HELD - reach, psi, 0.01))


def drop(values: Mapping[str, float], effects: Iterable[str] = (), duration: float = LONG) -> bp.Recording:
    """Return the drop of a gear with these parameters, from rest at room temperature, without noise."""
    return bp.simulate(
        drop_model(frozenset(effects)),
        {**values, "mass": MASS},
        frequency=1.0,
        duration=duration,
        sampling_rate=SAMPLING,
        start={"psi": held_angle(), "T": -values["theta17"]},
    )


def identify(recordings: Iterable[bp.Recording], seed: int, *, quick: bool) -> Identified:
    """Return the joint fit of all shaker experiments to the gear that is dropped."""
    experiments = [fold(recording, DISPLACEMENT) for recording in recordings]
    return draw(estimate(experiments, DISPLACEMENT, one_conduction=True), seed, quick=quick, executor=ENSEMBLES)


def predict(identified: Identified, effects: Iterable[str], draws: int) -> Dropped:
    """Return the true drop under the effects of a truth, and its posterior prediction."""
    assert identified.posterior is not None
    name = identified.problem.experiments[0].name
    found = bp.predict(identified.problem, identified.posterior, draws=draws, run=drop, experiment=name)
    return Dropped(identified, drop(parameters(effects), effects), found.transient)


def account(dropped: Dropped) -> dict[str, Any]:
    """Return the entries of results.json: shares of time within the 90 % band, and the settling."""
    time, band = dropped.true.time, dropped.band
    spans = {"0 to 2.5 s": time <= SHORT, "2.5 to 30 s": time > SHORT}
    found: dict[str, Any] = {"draws": band.draws, "failed": band.failed, "probability": band.probability}
    for channel in CHANNELS:
        true = dropped.true.outputs[channel]
        inside = (true >= band.low[channel]) & (true <= band.high[channel])
        off = band.median[channel] - true
        found[channel] = {
            "share_within_the_band": {span: float(np.mean(inside[at])) for span, at in spans.items()},
            "largest_error_of_the_median": float(np.abs(off).max()),
            "range": float(np.ptp(true)),
            "final": {
                "true": float(true[-1]),
                "median": float(band.median[channel][-1]),
                "band": [float(band.low[channel][-1]), float(band.high[channel][-1])],
            },
        }
    for name, signal in (("true", dropped.true.outputs["displacement"]), ("median", band.median["displacement"])):
        outside = np.flatnonzero(np.abs(signal - signal[-1]) > SETTLED)
        found[f"settled_to_1_mm_{name}"] = float(time[outside[-1]]) if outside.size else 0.0
    return found
