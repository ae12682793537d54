"""Times measured side by side: every action in turn within every repeat, medians, and ratios repeat by repeat."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np


class Action(NamedTuple):
    """Something timed.

    Attributes
    ----------
    run : callable
        Returns its own seconds, or anything else where the clock shall be read here.
    of : int
        Of how many log-posteriors it takes the time.
    most : int
        Repeats at most; of a slow action fewer are worth their time.
    """

    run: Callable[[], Any]
    of: int = 1
    most: int = 10_000


def interleaved(actions: Mapping[str, Action], repeats: int) -> dict[str, np.ndarray]:
    """Return seconds (repeats,) a log-posterior of each action, NaN in repeats that leave it out.

    A first round, which fills caches, does not count for the actions that are repeated more than once.
    """
    found = {name: np.full(repeats, np.nan) for name in actions}
    for repeat in range(-1, repeats):
        for name, action in actions.items():
            if repeat >= action.most or (repeat < 0 and action.most == 1):
                continue
            before = time.perf_counter()
            own = action.run()
            seconds = own if isinstance(own, float) else time.perf_counter() - before
            if repeat >= 0:
                found[name][repeat] = seconds / action.of
    return found


def spread(values: np.ndarray) -> dict[str, float]:
    """Return median, least and largest of the values that are there."""
    there = values[np.isfinite(values)]
    return {"median": float(np.median(there)), "least": float(there.min()), "largest": float(there.max())}


def ratio(over: np.ndarray, under: np.ndarray) -> dict[str, float]:
    """Return the ratio of two actions repeat by repeat."""
    return spread(over / under)


def slope(sizes: Any, values: Any) -> float:
    """Return the exponent of a power law fitted by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
