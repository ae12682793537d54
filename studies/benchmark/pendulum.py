"""An unstable period-3 orbit of the pendulum: time integration, begun on it to ten digits, leaves it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from studies.benchmark.equations import NUMPY, FirstOrder
from studies.pendulum.recording import FREQUENCY, OMEGA, QUICK_PERIODS, TRUTH, section_of, simulate
from studies.pendulum.shooting import shoot
from studies.shooting import TURN

PERIOD, SAMPLES = 3, 800
ORBITS, TOLERANCE = 12, 1e-12
# Of the distance at which the orbit is called left: rad, with rates in units of 5 rad/s a rad.
LEFT = 0.1


def measure(seed: int) -> dict[str, Any]:
    """Return the orbit's multiplier and how far the integration is from it after each of its periods (SYNTHETIC)."""
    found = bp.find_orbits(section_of(simulate(QUICK_PERIODS, seed)), periods=[PERIOD])
    polished = bp.polish_orbits(bp.models.pendulum, found, TRUTH, samples=SAMPLES)
    orbit = next(one for one in polished if one.period == PERIOD and not one.equilibrium)
    shot = shoot(TRUTH, OMEGA, orbit.points)
    if not shot.converged or orbit.solution is None:
        raise RuntimeError("The period-3 orbit of the pendulum is not confirmed by shooting.")
    off = distances(shot.points[0])
    left = next((k + 1 for k, d in enumerate(off) if d > LEFT), None)
    return {
        "synthetic": True,
        "status": orbit.solution.status,
        "multipliers": orbit.solution.multipliers.real.tolist(),
        "multipliers_by_shooting": shot.multipliers.real.tolist(),
        "distances": off,
        "left_after_periods": left,
    }


def distances(start: np.ndarray) -> list[float]:
    """Return how far the integration is from its start after each of the orbit's periods, angles modulo a turn."""
    model = bp.models.pendulum
    rates, p = FirstOrder(model, ()), np.array([*(TRUTH[name] for name in model.parameters), FREQUENCY])
    function = rates.function(NUMPY, rates.rates)

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        out = np.empty(2)
        function(y, [t * FREQUENCY], p, out)
        return out

    span = PERIOD / FREQUENCY
    path = solve_ivp(
        slope, (0.0, ORBITS * span), start, "DOP853", span * np.arange(1, ORBITS + 1), rtol=TOLERANCE, atol=TOLERANCE
    )
    angle, rate = path.y - start[:, None]
    turned = np.abs((angle + np.pi) % TURN - np.pi)
    return np.maximum(turned, np.abs(rate) / 5.0).tolist()


def account(found: dict[str, Any]) -> str:
    """Return what is printed."""
    steps = ", ".join(f"{d:.0e}" for d in found["distances"])
    largest = max(map(abs, found["multipliers"]))
    return (
        f"  period-3 orbit (SYNTHETIC), multiplier {largest:.4g}: this package {found['status']}; DOP853 at 1e-12, "
        f"begun on the orbit, is off by {steps} rad after each of its periods; it has left it after "
        f"{found['left_after_periods']}"
    )
