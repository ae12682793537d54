"""Compiled functions of small dense systems and of time integration."""

from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from bayesperiodic._compile.cache import load
from bayesperiodic.models.model import Model


@cache
def dense_kernels(path: Path | None = None) -> ModuleType:
    """Return the compiled solution of small dense systems, or the compiled functions of a source that uses it."""
    text = (path or Path(__file__).with_name("_kernels") / "dense.py").read_text(encoding="utf-8")
    return load(text, shared=dense_kernels() if path else None)


@cache
def integration_kernels() -> ModuleType:
    """Return the compiled functions of time integration."""
    return dense_kernels(Path(__file__).with_name("_kernels") / "integrate.py")


def complete_states(
    model: Model, y: np.ndarray, inputs: np.ndarray, theta: np.ndarray, tau: np.ndarray, frequency: float
) -> np.ndarray:
    """Return q, q̇, q̈ (points, 3·states), with the highest derivatives solved from the equations.

    `y` (points, size) contains the states and then the rates of the second-order ones, `inputs` (points, 3·inputs) u,
    u̇, ü.
    """
    count, orders = len(model.states), np.array([model.orders[state] for state in model.states])
    second, highest = np.flatnonzero(orders == 2), orders * count + np.arange(count)
    states = np.zeros((len(y), 3 * count))
    states[:, :count] = y[:, :count]
    states[:, count + second] = y[:, count:]
    columns = model.kernels.evaluate("residual_jacobian", states, inputs, theta, tau, frequency)
    jacobian = columns[:, count:].reshape(-1, count, 3 * count)[:, :, highest]
    states[:, highest] = -np.linalg.solve(jacobian, columns[:, :count, None])[..., 0]
    return states
