"""The steady cycle that a model settles on, by time integration alone. Independent of the periodic solver."""

from collections.abc import Mapping

import numpy as np

from bayesperiodic.models.model import Model
from bayesperiodic.simulation import FirstOrder, integrate_periodic

TRANSIENT, ROUNDS, NEWTON = 5, 12, 12
SETTLED, STEP = 1e-9, 1e-5


class NotSettled(RuntimeError):
    """The motion has no stable steady cycle near where it was started, or did not come to it."""


def steady_cycle(
    model: Model,
    parameters: Mapping[str, float],
    inputs: Mapping[str, np.ndarray],
    *,
    frequency: float,
    samples: int,
    start: Mapping[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """Return one cycle of every output after the transient has died out, without noise.

    Five cycles are integrated from the start; then Newton's method looks for the state that a cycle leads back to,
    which takes slow transients such as those of heat to their end at once. What it finds counts only if it is stable,
    because a recording shows nothing else; otherwise ten times five more cycles are integrated before it is given up.

    Parameters
    ----------
    model : Model
    parameters : mapping of str to float
        A value for every parameter.
    inputs : mapping of str to array (points,)
        One forcing period each, end point excluded.
    frequency : float
        Forcing frequency [Hz].
    samples : int
        Of the cycle, end point excluded.
    start : mapping of str to float, optional
        As for `simulate`.

    Returns
    -------
    dict of str to array (samples,)

    Raises
    ------
    NotSettled
        If there is no stable steady cycle, or the integration fails.
    """
    system = FirstOrder.of(model, parameters, inputs, frequency)
    try:
        y = system.start(start or {})
        for _ in range(ROUNDS):
            y = _after(system, y, TRANSIENT)
            found = _returning(system, y)
            if found is not None:
                time = np.arange(samples) / (samples * frequency)
                values = system.outputs(time, integrate_periodic(system, found, time))
                return {name: values[:, i] for i, name in enumerate(model.outputs)}
    except (RuntimeError, np.linalg.LinAlgError) as error:
        raise NotSettled(f"{model.name!r}: {error}") from error
    raise NotSettled(f"{model.name!r} does not settle on a cycle in {ROUNDS * TRANSIENT} periods.")


def _after(system: FirstOrder, y: np.ndarray, periods: int) -> np.ndarray:
    return integrate_periodic(system, y, np.array([0.0, periods / system.frequency]))[-1]


def _returning(system: FirstOrder, y: np.ndarray) -> np.ndarray | None:
    """Return the state near y that a cycle leads back to; None if there is none, or it is not stable."""
    identity = np.eye(y.size)
    for _ in range(NEWTON):
        scale = np.maximum(np.abs(y), np.abs(y).max() * STEP) + np.finfo(float).tiny
        end = _after(system, y, 1)
        moved = [_after(system, y + STEP * scale[i] * identity[i], 1) for i in range(y.size)]
        monodromy = np.stack([(m - end) / (STEP * s) for m, s in zip(moved, scale, strict=True)], axis=1)
        step = np.linalg.solve(identity - monodromy, end - y)
        if not np.isfinite(step).all():
            return None
        y = y + step
        if np.all(np.abs(step) <= SETTLED * scale):
            return y if np.abs(np.linalg.eigvals(monodromy)).max() < 1.0 else None
    return None
