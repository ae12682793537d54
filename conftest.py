"""Objects that the examples in the docstrings use without making them.

An example gets every object below whose name it contains. Each is made at its first use and kept for the test run.
"""

import re
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from _pytest.doctest import DoctestItem

import bayesperiodic as bp

PENDULUM = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}


@cache
def henon_section() -> bp.PoincareSection:
    """Return 1,900 points of the Hénon map."""
    x = np.zeros((2000, 2))
    for k in range(1999):
        x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    return bp.PoincareSection.from_points(x[100:], ("x", "y"), frequency=1.0)


@cache
def pendulum_recording() -> bp.Recording:
    """Return 2,000 forcing periods of a driven pendulum in chaotic motion."""
    return bp.simulate(
        bp.models.pendulum, PENDULUM, frequency=1.4467, duration=1400, sampling_rate=60, start={"phi": 1}
    )


@cache
def pendulum_orbits() -> bp.Orbits:
    """Return the orbits of period 1 in that recording."""
    section = bp.PoincareSection.from_recording(
        pendulum_recording(), ("angle", "rate"), frequency=1.4467, angles=["angle"]
    )
    return bp.find_orbits(section, periods=[1])


EXAMPLES: dict[str, Callable[[], Any]] = {
    "henon_section": henon_section,
    "pendulum_parameters": lambda: PENDULUM,
    "pendulum_recording": pendulum_recording,
    "pendulum_orbits": pendulum_orbits,
}


@pytest.fixture(autouse=True)
def example_objects(request: pytest.FixtureRequest, doctest_namespace: dict[str, Any]) -> Iterator[None]:
    """Provide the objects above that an example uses."""
    names: set[str] = set()
    if isinstance(request.node, DoctestItem) and request.node.dtest is not None:
        source = "".join(example.source for example in request.node.dtest.examples)
        names = set(re.findall(r"\w+", source)) & EXAMPLES.keys()
        doctest_namespace.update({name: EXAMPLES[name]() for name in names})
    yield
    for name in names:
        del doctest_namespace[name]
