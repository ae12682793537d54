"""Angles of a section: wrapped, and suspected where they do not look like radians."""

import numpy as np

DEGREES = 180.0 / np.pi


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles in (−π, π]."""
    return np.pi - (np.pi - angle) % (2.0 * np.pi)


def check_angle(name: str, values: np.ndarray) -> None:
    """Raise a ValueError for an angle that jumps by other than 2π, or moves half a turn between samples.

    Parameters
    ----------
    name : str
    values : array (samples,)
    """
    step = np.abs(np.diff(values))
    smooth, largest, extent = float(np.quantile(step, 0.9)), float(step.max()), float(np.ptp(values))
    folded = largest > 0.75 * extent and largest > 4.0 * smooth
    if folded and abs(extent / 360.0 - 1.0) < 0.1:
        raise ValueError(
            f"outputs[{name!r}]: jumps of {largest:.4g} are not allowed; an angle in degrees is suspected, radians are "
            "needed."
        )
    if folded and largest > 1.0 and abs(extent / (2.0 * np.pi) - 1.0) > 0.1:
        raise ValueError(
            f"outputs[{name!r}]: jumps of {largest:.4g} are not allowed; an angle runs on or jumps by 2π (6.283 rad). "
            "Another unit than radians, or an angle of half a turn (arctan instead of arctan2), is suspected."
        )
    if np.quantile(np.abs(wrapped(np.diff(values))), 0.9) > 0.75 * np.pi or smooth > 2.0 * np.pi:
        raise ValueError(
            f"outputs[{name!r}]: steps of {smooth:.4g} between samples are not allowed; below half a turn its windings "
            "can be counted. Degrees instead of radians, or too slow a sampling, are suspected."
        )


def check_rate(name: str, other: str, time: np.ndarray, angle: np.ndarray, rate: np.ndarray) -> None:
    """Raise a ValueError where the other coordinate is the angle's rate in another unit of angle.

    Parameters
    ----------
    name, other : str
    time, angle, rate : array (samples,)
        The angle running on.
    """
    measured = np.diff(angle)
    expected = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    scale = np.sqrt(np.sum(measured**2) * np.sum(expected**2))
    if scale == 0.0 or np.sum(measured * expected) < 0.98 * scale:
        return
    ratio = np.sum(measured * expected) / np.sum(expected**2)
    for factor, unit in ((DEGREES, "degrees"), (1.0 / DEGREES, "radians and its rate in degrees per second")):
        if abs(ratio / factor - 1.0) < 0.1:
            raise ValueError(
                f"outputs[{name!r}]: {ratio:.3g} times the integral of {other!r} is not allowed; the angle in {unit} "
                "is suspected, radians and radians per second are needed."
            )
