"""Compute the reference orbits of studies/shooting.py again: ``python -m tests.reference_orbits``."""

import json

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from studies.shooting import (
    DOUBLINGS,
    FOLD,
    PENDULUM,
    RETURN,
    STABLE,
    UNSTABLE,
    VAN_DER_POL,
    Field,
    Known,
    Orbit,
    pendulum,
    shoot,
)
from tests.shooting import divided, pendulum_doubling, pendulum_orbit, van_der_pol_cycle


def pendulum_with_omega(**changes: float) -> tuple[Field, Field]:
    """Return slope and Jacobian of the pendulum in time over T, with ω as a third, constant state."""
    p = PENDULUM | changes

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        inner, _, period = pendulum(y[2], **changes)
        return np.append(period * inner(t * period, y[:2]), 0.0)

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        inner, by_state, period = pendulum(y[2], **changes)
        j = np.zeros((3, 3))
        j[:2, :2] = period * by_state(t * period, y[:2])
        j[:2, 2] = -period / y[2] * inner(t * period, y[:2])
        j[1, 2] -= period * 2.0 * p["lift"] * y[2] * np.cos(2.0 * np.pi * t) / p["length"] * np.sin(y[0])
        return j

    return slope, jacobian


def pendulum_branch(
    start: float, end: float, step: float, section: np.ndarray, winding: int, parts: int = 2
) -> list[tuple[float, Orbit]]:
    """Return ω and the orbit in steps from `start` to `end`, each guessed from the two before."""
    found: list[tuple[float, Orbit]] = []
    guess = points = np.atleast_2d(section)
    for omega in np.linspace(start, end, 1 + round(abs(end - start) / step)):
        orbit = pendulum_orbit(omega, guess, winding, parts)
        before, points = points, orbit.states[::parts]
        guess = 2.0 * points - before if found else points
        found.append((float(omega), orbit))
    return found


def pendulum_crossing(
    value: float, rates: tuple[float, float], guess: np.ndarray, winding: int, parts: int = 2, **options: float | str
) -> tuple[float, Orbit]:
    """Return ω and the period-1 orbit with multiplier `value` and φ' at t = 0 between `rates`; it may lie at a fold.

    The guess is (φ, φ', ω). The states of the orbit are (φ, φ', ω).
    """
    slope, jacobian = pendulum_with_omega()

    def orbit(rate: float) -> Orbit:
        start = np.array([[guess[0], rate, guess[2]]])
        times, states = divided(slope, jacobian, np.array([0.0, 1.0]), start, parts)
        return shoot(slope, jacobian, times, states, [2.0 * np.pi * winding, 0.0, 0.0], pin=1, **options)

    rate = brentq(lambda r: float(np.prod(value - orbit(r).multipliers).real), *rates, xtol=1e-13, rtol=1e-14)
    found = orbit(rate)
    return float(found.states[0, 2]), found


def pendulum_attractor(omega: float, start: np.ndarray, periods: int, skip: int) -> np.ndarray:
    """Return section points of `periods` forcing periods after `skip` periods of plain integration, first φ in ±π."""
    slope, _, period = pendulum(omega)
    at = period * np.arange(skip, skip + periods)
    points = solve_ivp(slope, (0.0, at[-1]), start, method="DOP853", rtol=1e-9, atol=1e-9, t_eval=at).y.T
    points[:, 0] -= 2.0 * np.pi * np.round(points[0, 0] / (2.0 * np.pi))
    return points


def known(winding: int, omega: float, orbit: Orbit) -> Known:
    """Return an orbit in the form of the tables."""
    period = 2.0 * np.pi / omega if orbit.states.shape[1] == 2 else 1.0
    tau = orbit.times[:-1] / period
    section = tuple((float(q), float(v)) for q, v in orbit.states[np.abs(tau - np.round(tau)) < 1e-9, :2])
    return Known(float(omega), winding, section, tuple(m.item() for m in orbit.multipliers))


def difference(one: Known, other: Known) -> tuple[float, float, float]:
    """Return the largest differences in ω and section points, and relative in the multipliers."""
    points = np.abs(np.subtract(one.section, other.section)).max()
    relative = np.abs(np.subtract(one.multipliers, other.multipliers) / np.array(one.multipliers)).max()
    return abs(one.omega - other.omega), float(points), float(relative)


def branches() -> tuple[list[Known], list[Known], list[Known]]:
    """Compute STABLE, DOUBLINGS and the unstable orbits of periods 1, 2 and 4 along one cascade down from 13 rad/s."""
    omega, section = 13.0, np.array([[0.0, 13.0]])
    stable, doublings, unstable = [], [], []
    for periods, step, ahead in ((1, 0.1, 0.3), (2, 0.1, 0.03), (4, 0.02, 0.0)):
        section = pendulum_attractor(omega, section[0] + [0.01, 0.0], periods, skip=100 * periods)
        stable.append(known(periods, omega, pendulum_orbit(omega, section, periods)))
        path = pendulum_branch(omega, 9.09, step, np.array(stable[-1].section), periods)
        flips, folds = ([np.prod(v - o.multipliers).real for _, o in path] for v in (-1.0, 1.0))
        passed = [k for k in range(1, len(path)) if flips[k] * flips[k - 1] < 0.0]
        turned = [k for k in range(1, len(path)) if folds[k] * folds[k - 1] < 0.0]
        print(
            f"# period {periods}: {len(path) - 1} steps from {omega:.4f} to 9.09 rad/s; "
            f"a multiplier passes -1 {len(passed)} times and +1 {len(turned)} times"
        )
        for k in passed:
            omega, orbit = pendulum_doubling(path[k][0], path[k - 1][0], path[k][1].states[::2], periods)
            doublings.append(known(periods, omega, orbit))
        unstable.append(known(periods, 9.09, pendulum_orbit(9.09, path[-1][1].states[::2], periods)))
        omega, section = round(doublings[-1].omega - ahead, 2), np.array(doublings[-1].section)
    return stable, doublings, unstable


def row(orbit: Known) -> str:
    """Return an orbit as a row of ``reference_orbits.json``."""
    values = orbit._asdict()
    values["multipliers"] = [[m.real, m.imag] if isinstance(m, complex) else m for m in orbit.multipliers]
    return json.dumps(values)


def main() -> None:
    """Compute all orbits again; print them with their differences from the table and from LSODA in other segments."""
    for mu, values in VAN_DER_POL.items():
        again = van_der_pol_cycle(mu)
        print(f'"{mu}": {list(again)}  # {np.abs(np.divide(again, values) - 1.0).max():.0e} relative')
    stable, doublings, unstable = branches()
    other = {"parts": 3, "tolerance": 1e-13, "method": "LSODA"}
    low, low_again = [], []
    for value, rates, guess in ((-1.0, (3.8, 4.0), (-2.54, 0.0, 4.94)), (1.0, (3.2, 3.35), (-2.65, 0.0, 4.92))):
        low.append(known(1, *pendulum_crossing(value, rates, guess, 1)))
        low_again.append(known(1, *pendulum_crossing(value, rates, guess, 1, **other)))
    # The orbits that are on no branch start from their tabulated points, rounded.
    for k in UNSTABLE[3:]:
        unstable.append(known(k.winding, k.omega, pendulum_orbit(k.omega, np.round(k.section, 3), k.winding)))
    print("# differences (ω, section, relative in multipliers) to the table; to LSODA with three segments per period")
    for name, table, new in (
        ("STABLE", STABLE, stable),
        ("DOUBLINGS", DOUBLINGS, doublings),
        ("RETURN, FOLD", [RETURN, FOLD], low),
        ("UNSTABLE", UNSTABLE, unstable),
    ):
        print(name)
        for index, (old, k) in enumerate(zip(table, new, strict=True)):
            if new is low:
                second = low_again[index]
            else:
                second = known(k.winding, k.omega, pendulum_orbit(k.omega, k.section, k.winding, **other))
            to_table, to_second = (", ".join(f"{d:.0e}" for d in difference(k, one)) for one in (old, second))
            print(f"# {to_table}; {to_second}\n{row(k)}")


if __name__ == "__main__":
    main()
