"""Compiled time integration: fast transients on the grid of a periodic problem, and accurate ones at any times."""

from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from bayesperiodic.models.cache import load
from bayesperiodic.models.model import Model

TRIALS = 100_000


@cache
def _kernels() -> ModuleType:
    source = Path(__file__).with_name("_kernels").joinpath("integrate.py").read_text(encoding="utf-8")
    return load(source)


@cache
def _tableau() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stages, nodes and error weights of the method of order 8, with the step's end as the last stage."""
    from scipy.integrate import DOP853  # an import of half a second

    a = np.vstack([DOP853.A, DOP853.B])
    return a, np.append(DOP853.C, 1.0), np.stack([DOP853.E5, DOP853.E3])


def integrate_accurately(
    model: Model,
    start: np.ndarray,
    amplitudes: np.ndarray,
    parameters: np.ndarray,
    *,
    frequency: float,
    time: np.ndarray,
    absolute: np.ndarray,
    relative: np.ndarray,
) -> np.ndarray:
    """Integrate by the Runge-Kutta method of order 8 of Dormand and Prince, with error control.

    Parameters
    ----------
    model : Model
    start : array (size,)
        The states, then the rates of the second-order ones.
    amplitudes : complex array (harmonics, 3·inputs)
        Of u, u̇, ü, from harmonic 0 on; the signals are the real part of the Fourier series.
    parameters : array (parameters,)
    frequency : float
        Forcing frequency [Hz].
    time : array (times,)
        [forcing periods]; the integration starts at the first.
    absolute, relative : array (size,)
        Tolerances of a step.

    Returns
    -------
    array (times, size)
        Fewer rows if the integration fails.
    """
    path = np.empty((time.size, start.size))
    path[0] = start
    orders = np.array([model.orders[state] for state in model.states])
    known = _kernels().dormand_prince(
        model.kernels.residual_jacobian,
        np.ascontiguousarray(amplitudes, dtype=complex),
        parameters,
        frequency,
        orders,
        time,
        path,
        *_tableau(),
        absolute,
        relative,
        TRIALS,
    )
    return path[:known]


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
    """Integrate by the classical fourth-order Runge-Kutta method; None if the states overflow.

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
    finished = _kernels().runge_kutta(
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
