"""Orbits of the pendulum: solved from the tabulated ones, and measured on a section with noise of known covariance."""

from dataclasses import replace
from functools import cache

import numpy as np

import bayesperiodic as bp
from bayesperiodic.orbits.orbit import Orbit
from studies import shooting
from tests.shooting import pendulum_grid

TURN = 2 * np.pi
# The torques of shooting.PENDULUM for m = 0.1 kg: k = c m l².
PENDULUM = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
ROTATIONS = [k for k in shooting.UNSTABLE if len(k.section) == 1]
SIZE = np.array([TURN, 32.6])  # of the attractor, rad and rad/s
FREQUENCY = 9.09 / TURN
SAMPLES = 100
GENTLE = [k for k in shooting.UNSTABLE if abs(k.multipliers[0]) < 50]


@cache
def rates_and_angles(known: shooting.Known, samples: int) -> np.ndarray:
    """Return (φ, φ') of a tabulated orbit on a grid, integrated period by period."""
    points = samples * len(known.section)
    path = pendulum_grid(known.omega, known.section, np.arange(points) / samples)
    path.flags.writeable = False
    return path


def pendulum_solution(
    known: shooting.Known, samples: int, scheme: str, angle: np.ndarray | None = None, **changes
) -> bp.PeriodicSolution:
    """Return the solver's orbit near a tabulated one, or near another angle."""
    angle = rates_and_angles(known, samples)[:, 0] if angle is None else angle
    arguments = {
        "frequency": known.omega / TURN,
        "samples": samples,
        "scheme": scheme,
        "periods": len(known.section),
        "winding": known.winding,
    }
    return bp.solve_periodic(bp.models.pendulum, PENDULUM, **(arguments | changes), guess={"phi": angle})


def wrapped(points: np.ndarray) -> np.ndarray:
    """Return section points with the angle in (−π, π]."""
    return np.column_stack([np.pi - np.mod(np.pi - points[:, 0], TURN), points[:, 1]])


def measured(known: shooting.Known, *, noise: float = 1e-3, seed: int = 0, cycle: bool = True, **changes) -> Orbit:
    """Return a tabulated orbit with noise on its points and cycle, a fraction of the attractor's size."""
    generator, period = np.random.default_rng([seed, round(1e3 * abs(known.multipliers[0]))]), len(known.section)
    sd = noise * SIZE
    points = wrapped(np.array(known.section) + sd * generator.standard_normal((period, 2)))
    path = rates_and_angles(known, SAMPLES) + sd * generator.standard_normal((SAMPLES * period, 2))
    covariance = np.diag([*np.tile(sd**2, period), 0.02**2, np.nan])
    orbit = Orbit(
        name=f"period {period}, winding {known.winding}, multiplier {known.multipliers[0].real:.4g}",
        coordinates=("angle", "rate"),
        angles=("angle",),
        frequency=known.omega / TURN,
        period=period,
        winding=known.winding if cycle else None,
        points=points,
        joint_covariance=covariance,
        eigenvalues=np.array(known.multipliers).real,
        eigenvalue_bias=np.zeros(2),
        returns=30,
        quality=0.5,
        cycle=dict(zip(("angle", "rate"), path.T.copy(), strict=True)) if cycle else None,
        synthetic=True,
    )
    return replace(orbit, **changes)


def mirrored(orbit: Orbit) -> Orbit:
    """Return the orbit with all signs changed."""
    return replace(
        orbit,
        name=f"{orbit.name}, mirrored",
        winding=None if orbit.winding is None else -orbit.winding,
        points=wrapped(-orbit.points),
        cycle=orbit.cycle and {name: -values for name, values in orbit.cycle.items()},
    )


def shifted(orbit: Orbit, by: int) -> Orbit:
    """Return the orbit with its section shifted by some forcing periods."""
    rows = np.roll(np.arange(orbit.points.size), -2 * by)
    rows = np.concatenate([rows, orbit.points.size + np.arange(2)])
    angle, rate = (orbit.cycle[name] for name in ("angle", "rate"))
    turning = TURN * orbit.winding * (np.arange(angle.size) >= angle.size - by * SAMPLES)
    return replace(
        orbit,
        name=f"{orbit.name}, shifted",
        points=np.roll(orbit.points, -by, axis=0),
        joint_covariance=orbit.joint_covariance[np.ix_(rows, rows)],
        cycle={"angle": np.roll(angle, -by * SAMPLES) + turning, "rate": np.roll(rate, -by * SAMPLES)},
    )


def repeated(orbit: Orbit, times: int) -> Orbit:
    """Return the orbit repeated, as a candidate of a multiple of its period."""
    angle, rate = (orbit.cycle[name] for name in ("angle", "rate"))
    turns = TURN * orbit.winding * np.repeat(np.arange(times), angle.size)
    size = times * orbit.points.size
    covariance = np.full((size + 2, size + 2), np.nan)
    covariance[:size, :size] = np.kron(np.eye(times), orbit.covariance)
    covariance[size, :] = covariance[:, size] = 0.0
    covariance[size, size] = times**2 * orbit.joint_covariance[-2, -2]
    return replace(
        orbit,
        name=f"{orbit.name}, {times} times",
        period=times * orbit.period,
        winding=times * orbit.winding,
        points=np.tile(orbit.points, (times, 1)),
        joint_covariance=covariance,
        eigenvalues=orbit.eigenvalues**times,
        cycle={"angle": np.tile(angle, times) + turns, "rate": np.tile(rate, times)},
    )


def at_rest(angle: float = 0.0, noise: float = 1e-3) -> Orbit:
    """Return a noisy equilibrium of the section."""
    points, path = np.array([[angle, 0.0]]), np.tile([angle, 0.0], (SAMPLES, 1))
    generator = np.random.default_rng(5)
    path = path + noise * SIZE * generator.standard_normal(path.shape)
    like = measured(GENTLE[0], noise=noise)
    cycle = dict(zip(("angle", "rate"), path.T.copy(), strict=True))
    covariance = np.diag([*np.diag(like.covariance), np.nan, np.nan])
    return replace(
        like,
        name="rest",
        winding=0,
        points=wrapped(points + noise * SIZE * 0.5),
        joint_covariance=covariance,
        cycle=cycle,
    )


def section_problem(experiments: list[bp.Experiment], *names: str) -> bp.Problem:
    """Return the problem of some parameters of the pendulum under weak priors, the others known."""
    return bp.Problem(
        bp.models.pendulum,
        experiments,
        priors={name: bp.LogNormal(1.5 * PENDULUM[name], 2.0) for name in names},
        fixed={name: value for name, value in PENDULUM.items() if name not in names},
        scheme="central4",
    )
