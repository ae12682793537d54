"""An orbit measured over several turns of its prime period, brought to one."""

from dataclasses import replace

import numpy as np

from bayesperiodic.orbits.identity import differences
from bayesperiodic.orbits.orbit import Orbit


def once_round(orbit: Orbit, times: int, angles: np.ndarray) -> Orbit:
    """Return an orbit that goes `times` round within its period as one of its prime period.

    Points are averaged, log|eigenvalue| is divided by `times`, and the covariance follows. An even number of times
    leaves the signs of the eigenvalues open; the moduli are given.

    Parameters
    ----------
    orbit : Orbit
    times : int
        A divisor of its period.
    angles : bool array (coordinates,)
    """
    period, coordinates = orbit.period // times, orbit.points.shape[1]
    rounds = orbit.points.reshape(times, period, coordinates)
    mean = rounds[0] + differences(rounds, rounds[0], angles).mean(axis=0)
    size = orbit.points.size
    average = np.zeros((mean.size + 2, size + 2))
    average[: mean.size, :size] = np.tile(np.eye(mean.size), times) / times
    average[mean.size :, size:] = np.eye(2) / times
    moduli = np.abs(orbit.eigenvalues) ** (1.0 / times)
    kept = times % 2 and not np.iscomplexobj(orbit.eigenvalues)
    cycle = orbit.cycle and {name: values[: len(values) // times] for name, values in orbit.cycle.items()}
    return replace(
        orbit,
        name=f"{orbit.name}, once round",
        period=period,
        winding=None if orbit.winding is None else orbit.winding // times,
        points=differences(mean, np.zeros(coordinates), angles),
        joint_covariance=_sandwich(average, orbit.joint_covariance),
        eigenvalues=np.sign(orbit.eigenvalues) * moduli if kept else moduli,
        eigenvalue_bias=orbit.eigenvalue_bias / times,
        partner=None,
        cycle=cycle,
    )


def _sandwich(matrix: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return M C Mᵀ, NaN only where an unknown entry has a weight."""
    known = np.where(np.isnan(covariance), 0.0, covariance)
    unknown = np.abs(matrix) @ np.isnan(covariance) @ np.abs(matrix.T) > 0
    return np.where(unknown, np.nan, matrix @ known @ matrix.T)
