"""Time integration with fixed steps, compiled: quick transients on the grid of a periodic problem."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic.models.cache import load
from bayesperiodic.models.model import Model


@cache
def _runge_kutta() -> Any:
    source = Path(__file__).with_name("integrate_kernels.py").read_text(encoding="utf-8")
    return load(source, ("runge_kutta",))["runge_kutta"]


def integrate(
    model: Model,
    start: np.ndarray,
    inputs: np.ndarray,
    parameters: np.ndarray,
    *,
    frequency: float,
    samples: int,
    steps: int,
    kept: int,
) -> np.ndarray | None:
    """Integrate by the classical fourth-order Runge-Kutta method; None if the states grow beyond all bounds.

    Parameters
    ----------
    model : Model
    start : array (size,)
        The states, then the rates of the second-order ones, at tau = 0.
    inputs : array (2·samples·periods, 3·inputs)
        u, u̇, ü at half steps over one response period, which is repeated.
    parameters : array (parameters,)
    frequency : float
        Forcing frequency [Hz].
    samples : int
        Steps per forcing period.
    steps, kept : int
        Steps to take, and how many of the last are returned.

    Returns
    -------
    array (kept, size)
        The states before each of the last steps.
    """
    orders = np.array([model.orders[state] for state in model.states])
    path = np.empty((kept, orders.sum()))
    finished = _runge_kutta()(
        model.kernels.residual_jacobian,
        np.array(start, dtype=float),
        np.ascontiguousarray(inputs),
        samples,
        parameters,
        frequency,
        orders,
        steps,
        path,
    )
    return path if finished else None
