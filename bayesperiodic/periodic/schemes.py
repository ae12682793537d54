"""Difference schemes on a cyclic grid."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Storable
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.periodic.compiled import Grid

UNROLLED_OFFSETS = 5


@dataclass(frozen=True)
class Scheme(Storable):
    """A difference scheme for first and second derivatives on an equidistant cyclic grid.

    Parameters
    ----------
    name : str
    order : int
        Order of accuracy.
    first, second : mapping of int to float
        Weight by offset for the first and the second derivative, for unit step.

    Raises
    ------
    ValueError
        For weights that do not differentiate 1, t and t² exactly (to rounding), or an order below 1.

    Examples
    --------
    >>> import bayesperiodic as bp
    >>> bp.Scheme("forward1", 1, first={0: -1, 1: 1}, second={0: 1, 1: -2, 2: 1}).reach
    2
    """

    name: str
    order: float
    first: Mapping[int, float] = field(kw_only=True)
    second: Mapping[int, float] = field(kw_only=True)

    def __post_init__(self) -> None:
        if not self.order >= 1:
            raise ValueError(f"order: must be at least 1, got {self.order!r}.")
        for argument, weights, derivative in (("first", self.first, 1), ("second", self.second, 2)):
            for power in range(derivative + 1):
                moment = sum(weight * offset**power for offset, weight in weights.items())
                wanted = math.factorial(power) if power == derivative else 0
                if weights and not abs(moment - wanted) < 1e-9:
                    raise ValueError(
                        f"{argument}: must give {wanted} for the derivative of t**{power} at 0, got {moment:.6g} by "
                        f"{dict(weights)!r}."
                    )

    @property
    def reach(self) -> int:
        """The largest distance in steps between a point and one that its derivatives use."""
        return max((abs(offset) for offset in (*self.first, *self.second)), default=1)

    def weights(self, points: int) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """Return the weights of the first and the second derivative on a cyclic grid.

        Parameters
        ----------
        points : int
            Number of points of the grid.

        Returns
        -------
        first, second : mapping of int to float
            Weight by offset, for unit step.
        """
        return self.first, self.second


@dataclass(frozen=True)
class FourierScheme(Scheme):
    """Collocation with trigonometric polynomials: the derivatives are those of the interpolating polynomial ([1]_).

    Every point uses all others, so the equations are those of harmonic balance with as many harmonics as the grid
    carries, and the error of a smooth solution falls faster than any power of the step.

    References
    ----------
    .. [1] L. N. Trefethen, Spectral Methods in MATLAB, SIAM, 2000, chapter 3.
    """

    def weights(self, points: int) -> tuple[Mapping[int, float], Mapping[int, float]]:
        """Return the weights of the first and the second derivative on a cyclic grid of that many points."""
        offsets = np.arange(points) - (points - 1) // 2
        rate = 2j * np.pi * np.arange(points // 2 + 1) / points
        second = np.fft.irfft(rate**2, n=points)
        if points % 2 == 0:
            rate[-1] = 0.0
        first = np.fft.irfft(rate, n=points)
        return _by_offset(offsets, first), _by_offset(offsets, second)


def _by_offset(offsets: np.ndarray, impulse: np.ndarray) -> dict[int, float]:
    return dict(zip(offsets.tolist(), impulse[-offsets % len(impulse)].tolist(), strict=True))


backward2 = Scheme("backward2", 2, first={0: 1.5, -1: -2.0, -2: 0.5}, second={0: 2.0, -1: -5.0, -2: 4.0, -3: -1.0})
central2 = Scheme("central2", 2, first={-1: -0.5, 1: 0.5}, second={-1: 1.0, 0: -2.0, 1: 1.0})
central4 = Scheme(
    "central4",
    4,
    first={-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12},
    second={-2: -1 / 12, -1: 4 / 3, 0: -5 / 2, 1: 4 / 3, 2: -1 / 12},
)
fourier = FourierScheme("fourier", math.inf, first={}, second={})

SCHEMES = {scheme.name: scheme for scheme in (backward2, central2, central4, fourier)}


def default_scheme(model: Model, *, tables: bool = False) -> str:
    """Return the name of the scheme for a model: "central4" if some state is of first order, else "central2".

    The first derivative of central2 at a point does not use the point, so that a state without second derivative falls
    into even and odd points that only the other terms relate: on an even grid the equations have solutions in which the
    two differ, and those of an autonomous model are nearly singular. central4 relates them. For such models it is also
    more accurate, kinks included, and a batch of solves takes 1.3 times (one state) to twice (two states) as long.
    For `tables` of responses, whose grids are coarse, it is central4 too. A condensed model has harmonics ("fourier").
    """
    if isinstance(model, CondensedModel):
        return fourier.name
    return central4.name if tables or 1 in model.orders.values() else central2.name


def find_scheme(scheme: str | Scheme) -> Scheme:
    """Return a scheme by value or by name; raise a ValueError for an unknown name."""
    if isinstance(scheme, Scheme):
        return scheme
    _checks.one_of("scheme", scheme, SCHEMES)
    return SCHEMES[scheme]


@dataclass(frozen=True)
class CyclicGrid:
    """A scheme on the grid of one response period.

    In the folded order 0, n−1, 1, n−2, … of the points, the cyclic band of the equations is an ordinary one.
    """

    scheme: Scheme
    samples: int  # points per forcing period
    periods: int = 1  # forcing periods per response period

    def __post_init__(self) -> None:
        _checks.integer("periods", self.periods, 1)
        _checks.integer("samples", self.samples, 2 * self.scheme.reach + 2)

    @property
    def points(self) -> int:
        """Number of grid points in the response period."""
        return self.samples * self.periods

    @cached_property
    def tau(self) -> np.ndarray:
        """Time in forcing periods, end point excluded."""
        return np.arange(self.points) / self.samples

    @cached_property
    def offsets(self) -> np.ndarray:
        """Offsets of the points that a point uses, ascending, (offsets,)."""
        first, second = self.scheme.weights(self.points)
        return np.array(sorted({0, *first, *second}))

    @cached_property
    def packed(self) -> Grid:
        """The grid as the compiled functions take it."""
        i, first, second = np.arange(self.points), *self.scheme.weights(self.points)
        rates = np.array([first.get(o, 0.0) for o in self.offsets.tolist()]) * self.samples
        accelerations = np.array([second.get(o, 0.0) for o in self.offsets.tolist()]) * self.samples**2
        neighbours = (i[:, None] + self.offsets) % self.points
        place = np.where(i < (self.points + 1) // 2, 2 * i, 2 * (self.points - 1 - i) + 1)
        shift = place[neighbours] - place[:, None]
        half_width, lead = int(np.max(np.abs(shift))), self._lead(rates, accelerations)
        return Grid(rates, accelerations, neighbours, shift, place, self.tau, half_width, lead)

    def _lead(self, first: np.ndarray, second: np.ndarray) -> int:
        """Return the largest offset if the scheme can be marched forward from point to point without growing, else −1.

        It can if the recurrences of both derivatives, solved for the value at that offset, have no root outside the
        unit circle.
        """
        if len(self.offsets) > self.points // 2:
            return -1
        roots = np.concatenate([np.roots(first[::-1]), np.roots(second[::-1])])
        marches = self._in_a_row and self.offsets[-1] >= 0 and np.all(abs(roots) < 1.001)
        return int(self.offsets[-1]) if marches else -1

    @property
    def reach(self) -> int:
        """Number of start points of a march, 0 where the scheme cannot be marched."""
        return len(self.offsets) - 1 if self.packed.lead >= 0 else 0

    @cached_property
    def stencil(self) -> tuple[int, int, int]:
        """Reach, number of offsets and half-width, or zeros if the offsets have gaps or are many."""
        few = len(self.offsets) <= UNROLLED_OFFSETS < self.points
        return (self.reach, len(self.offsets), self.packed.half_width) if few and self._in_a_row else (0, 0, 0)

    @property
    def _in_a_row(self) -> bool:
        return bool(np.all(np.diff(self.offsets) == 1))
