"""Matrices, places and elements of a model made by `Model.from_matrices`, without its symbolic equations."""

from dataclasses import dataclass
from inspect import signature
from typing import Any

import numpy as np

CONSTANT_PART = "1"
POWERS = {"mass": 2, "damping": 1, "stiffness": 0}  # of iω


@dataclass(frozen=True)
class Structure:
    """What `Model.from_matrices` was given, checked: the parts of the matrices, the places, and the elements."""

    parts: dict[str, dict[str, np.ndarray]]  # by "mass", "damping", "stiffness" and factor, each (n, n)
    inputs: dict[str, np.ndarray]  # weights (n,) of the place of each input
    measured: dict[str, tuple[np.ndarray, int]]  # weights (n,) of each output, and the order of its derivative
    elements: tuple[Any, ...]
    weights: np.ndarray  # (elements, n)

    @property
    def degrees(self) -> int:
        """Number of degrees of freedom."""
        return self.weights.shape[1]

    @property
    def memoryless(self) -> bool:
        """Whether the elements' forces are functions of displacement and velocity, without internal states."""
        return not any(e.states or "s" in signature(e.force).parameters for e in self.elements)
