"""Difference schemes on a cyclic grid."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayesperiodic import checks


@dataclass(frozen=True)
class Scheme:
    """A difference scheme for first and second derivatives on an equidistant cyclic grid.

    Parameters
    ----------
    name : str
    order : int
        Order of accuracy.
    first, second : mapping of int to float
        Weight by offset for the first and the second derivative, for unit step.

    Examples
    --------
    >>> import bayesperiodic as bp
    >>> bp.Scheme("forward1", 1, first={0: -1, 1: 1}, second={0: 1, 1: -2, 2: 1}).reach
    2
    """

    name: str
    order: int
    first: Mapping[int, float] = field(kw_only=True)
    second: Mapping[int, float] = field(kw_only=True)

    @property
    def reach(self) -> int:
        """The largest distance in steps between a point and one that its derivatives use."""
        return max(abs(offset) for offset in (*self.first, *self.second))


backward2 = Scheme("backward2", 2, first={0: 1.5, -1: -2.0, -2: 0.5}, second={0: 2.0, -1: -5.0, -2: 4.0, -3: -1.0})
central2 = Scheme("central2", 2, first={-1: -0.5, 1: 0.5}, second={-1: 1.0, 0: -2.0, 1: 1.0})

SCHEMES = {scheme.name: scheme for scheme in (backward2, central2)}


def find_scheme(scheme: str | Scheme) -> Scheme:
    """Return a scheme by value or by name; raise a ValueError for an unknown name."""
    if isinstance(scheme, Scheme):
        return scheme
    checks.one_of("scheme", scheme, SCHEMES)
    return SCHEMES[scheme]


@dataclass(frozen=True)
class CyclicGrid:
    """A scheme laid on one response period: which points each point uses, and where they stand in the folded band.

    The points are taken in the order 0, n−1, 1, n−2, …, which turns the cyclic band into an ordinary one.

    Parameters
    ----------
    scheme : Scheme
    samples : int
        Points per forcing period.
    periods : int
        Forcing periods per response period.
    """

    scheme: Scheme
    samples: int
    periods: int = 1

    def __post_init__(self) -> None:
        checks.integer("periods", self.periods, 1)
        checks.integer("samples", self.samples, 2 * self.scheme.reach + 2)

    @property
    def points(self) -> int:
        """Number of grid points in the response period."""
        return self.samples * self.periods

    @cached_property
    def tau(self) -> np.ndarray:
        """Time in forcing periods, end point excluded."""
        return np.arange(self.points) / self.samples

    @cached_property
    def _offsets(self) -> list[int]:
        return sorted({0, *self.scheme.first, *self.scheme.second})

    @cached_property
    def first(self) -> np.ndarray:
        """Weights of the first derivative with respect to tau, one an offset."""
        return np.array([self.scheme.first.get(o, 0.0) for o in self._offsets]) * self.samples

    @cached_property
    def second(self) -> np.ndarray:
        """Weights of the second derivative with respect to tau, one an offset."""
        return np.array([self.scheme.second.get(o, 0.0) for o in self._offsets]) * self.samples**2

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Index of the point at each offset, (points, offsets)."""
        return (np.arange(self.points)[:, None] + np.array(self._offsets)) % self.points

    @cached_property
    def place(self) -> np.ndarray:
        """Place of each point in the folded order, (points,)."""
        i = np.arange(self.points)
        return np.where(i < (self.points + 1) // 2, 2 * i, 2 * (self.points - 1 - i) + 1)

    @cached_property
    def shift(self) -> np.ndarray:
        """Distance in the folded order to the point at each offset, (points, offsets)."""
        return self.place[self.neighbours] - self.place[:, None]

    @cached_property
    def half_width(self) -> int:
        """Half-width, in points, of the folded band."""
        return int(np.max(np.abs(self.shift)))
