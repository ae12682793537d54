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
from studies.landing_gear.identification import Identified
from studies.landing_gear.rig import Strut, heat_balance, parameters, strut

FRAME, HEIGHT, WIDTH = 2.02, 1.16, 0.58
MASS, GRAVITY, HELD = 690.0, 9.81, 0.02
SHORT, LONG, SAMPLING = 2.5, 30.0, 200.0
# Of the final displacement [m].
SETTLED = 1e-3
CHANNELS = ("displacement", "force", "pressure")


@dataclass(frozen=True)
class Dropped:
    """One truth's drop test."""

    true: bp.Recording  # Without noise
    band: Any  # Posterior prediction


def _compression(psi: Any) -> sp.Expr:
    """Return the gear's compression [m] at an angle of the frame."""
    reach = sp.sqrt((FRAME * sp.cos(psi) - FRAME - WIDTH) ** 2 + (HEIGHT - FRAME * sp.sin(psi)) ** 2)
    return float(np.hypot(WIDTH, HEIGHT)) - reach


@cache
def drop_model(effects: frozenset[str]) -> bp.Model:
    """Return frame and gear; states: psi, the frame's angle below the horizontal [rad], and T, of the gas [K]."""

    def gear(s: Any, p: Any) -> tuple[sp.Expr, Strut]:
        q = _compression(s.psi)
        lever = sp.diff(q, s.psi)
        return lever, strut(p, q, lever * s.dpsi, sp.diff(lever, s.psi) * s.dpsi**2 + lever * s.ddpsi, s.T)

    def equations(s: Any, p: Any, u: Any) -> list[sp.Expr]:
        lever, at = gear(s, p)
        weight = p.mass * GRAVITY * FRAME * sp.cos(s.psi)
        return [p.mass * FRAME**2 * s.ddpsi - weight + at.force * lever, heat_balance(effects, s, p, at)]

    def outputs(s: Any, p: Any, u: Any) -> dict[str, sp.Expr]:
        _, at = gear(s, p)
        displacement, pressure = at.q + p.theta12, at.pressure
        if "flexure" in effects:
            displacement += p.flexibility * (at.force - p.static_load)
        if "line" in effects:
            pressure -= p.delay * (sp.diff(pressure, s.T) * s.dT + sp.diff(pressure, s.psi) * s.dpsi)
        return {"displacement": displacement, "force": at.force, "pressure": pressure}

    return bp.Model(
        "_".join(["landing_gear_drop", *sorted(effects)]), states=["psi", "T"],
        parameters=(*parameters(effects), "mass"), equations=equations, outputs=outputs,
        units={"psi": "rad", "T": "K", "displacement": "m", "force": "N", "pressure": "Pa"},
        description="A mass on a pivoting frame, carried by a landing gear; see `studies.landing_gear.drop`.",
    )  # fmt: skip


def drop(values: Mapping[str, float], effects: Iterable[str] = (), duration: float = LONG) -> bp.Recording:
    """Return the drop of a gear with these parameters, from rest at room temperature, without noise."""
    psi = sp.Symbol("psi")
    held = float(sp.nsolve(_compression(psi) - HELD, psi, 0.01))
    return bp.simulate(
        drop_model(frozenset(effects)), {**values, "mass": MASS}, frequency=1.0, duration=duration,
        sampling_rate=SAMPLING, start={"psi": held, "T": -values["theta17"]},
    )  # fmt: skip


def predict(identified: Identified, effects: Iterable[str], draws: int) -> Dropped:
    """Return the true drop under the effects of a truth, and its prediction from a joint fit with one theta16."""
    name = identified.problem.experiments[0].name
    found = bp.predict(identified.problem, identified.posterior, draws=draws, run=drop, experiment=name)
    return Dropped(drop(parameters(effects), effects), found.transient)


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
