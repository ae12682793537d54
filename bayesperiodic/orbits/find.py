"""find_orbits: unstable periodic orbits of a chaotic section, without a model."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.orbits.cycles import (
    Candidate,
    Estimate,
    box_orbits,
    candidates,
    has_shorter_period,
    refine,
    shift_between,
)
from bayesperiodic.orbits.local import REACH, Atlas, LocalMaps, check_chaos, noise_of
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.orbits.section import PoincareSection, wrapped

METHODS = ("chained", "boxes")
QUALITY_DEGREE = 3
FEWEST_NEIGHBOURS = 32
# Of a local fit in the search, in standard deviations of the noise.
SEARCH_WIDTH = 4.0
# Beyond, a point with this standard deviation is nowhere in particular; in units of the attractor's size.
LARGEST_SD = 0.02
# Beyond, the delta method says nothing of an eigenvalue.
LARGEST_LOGARITHM_SD = 0.5
# A state of rest moves by less than this share of the whole motion, and some standard deviations of the noise.
STILL, SPREAD = 0.02, 20.0


@dataclass(frozen=True)
class _Scaled:
    """A section in units of the attractor's size.

    Attributes
    ----------
    points : array (count, 2)
    size : array (2,)
        The unit.
    maps : LocalMaps
    extent : array (2,) or None
        Ranges of the recorded signals.
    quality_count : int
        Neighbours of the local fits that the quality of an orbit is judged by, at least.
    """

    points: np.ndarray
    size: np.ndarray
    maps: LocalMaps
    extent: np.ndarray | None
    quality_count: int


@in_one_thread
def find_orbits(
    section: PoincareSection,
    *,
    periods: Iterable[int],
    method: str = "chained",
    neighbours: int = 32,
    box: float = 0.01,
) -> Orbits:
    """Find the unstable periodic orbits in a section of a chaotic motion, without a model.

    "chained": a motion that nearly comes back after p returns is near an orbit of period p. The return map is fitted
    locally (quadratically) at its p points, and Newton's method moves all p points together until the chain of these
    maps closes. The orbits that this leads to are fitted once more with cubic polynomials in neighbourhoods that are
    as wide as the map's curvature allows; errors in the arguments do not bias these fits (deconvoluting kernels, see
    `LocalMaps`). Eigenvalues are those of the chained slopes. Covariances are sandwich estimates over runs of
    consecutive pairs, and hold the estimated bias.

    "boxes": the recipe of [1]_ as a baseline: boxes of 1 % of the attractor, recurrence to the own or a neighbouring
    box, and one linear fit of the map over the whole period, whose eigenvalues are biased where the noise or the
    curvature is felt.

    Parameters
    ----------
    section : PoincareSection
    periods : iterable of int
        Prime periods in returns.
    method : {"chained", "boxes"}
    neighbours : int
        Fewest (effective) neighbours of a local fit, at least 16.
    box : float
        Size of a box for "boxes", as a fraction of the attractor's size.

    Returns
    -------
    Orbits
        In the order of period, then of search. States of rest are found like others and marked `equilibrium`. The
        covariance of log|eigenvalue| is NaN ("not estimated") where the estimated bias exceeds the standard deviation,
        or the latter 0.5.

    Raises
    ------
    ValueError
        For a section that is periodic, quasi-periodic or has no return map (which says which), for unknown methods,
        for periods that are no whole numbers.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, in: D. H. van Campen (Ed.), Interaction between Dynamics and Control in Advanced
       Mechanical Systems, Kluwer, 1997, 191-198; section 5.

    Examples
    --------
    The Hénon map has one orbit of period 1 and one of period 2 on its attractor:

    >>> import numpy as np, bayesperiodic as bp
    >>> x = np.zeros((2000, 2))
    >>> for k in range(1999):
    ...     x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    >>> henon_section = bp.PoincareSection.from_points(x[100:], ("x", "y"), frequency=1.0)
    >>> [orbit.period for orbit in bp.find_orbits(henon_section, periods=[1, 2, 3])]
    [1, 2]
    """
    wanted = _periods(periods, len(section))
    _checks.one_of("method", method, METHODS)
    neighbours = _checks.integer("neighbours", neighbours, 16)
    box = _checks.positive("box", box)
    scaled = _scaled(section, neighbours)
    if method == "boxes":
        found = [pair for p in wanted for pair in box_orbits(scaled.maps, scaled.points, p, neighbours, box)]
    else:
        atlas = Atlas(scaled.maps, _search_count(scaled.maps, neighbours))
        found = [pair for p in wanted for pair in _chained(scaled, atlas, p, neighbours)]
    orbits = [_orbit(section, scaled, candidate, estimate) for candidate, estimate in found]
    orbits = _named(_with_partners(orbits, scaled))
    return Orbits(tuple(orbits), values=section.values, method=method)


def _periods(periods: Iterable[int], count: int) -> list[int]:
    try:
        wanted = sorted({_checks.integer("periods", p, 1) for p in periods})
    except TypeError:
        raise ValueError(f"periods: {periods!r} is not allowed; it is a collection such as range(1, 6).") from None
    if not wanted or wanted[-1] > count // 20:
        raise ValueError(
            f"periods: {wanted} is not allowed; one at least is needed and, with {count} points, none above "
            f"{count // 20}."
        )
    return wanted


def _chained(scaled: _Scaled, atlas: Atlas, period: int, neighbours: int) -> list[tuple[Candidate, Estimate]]:
    maps = scaled.maps
    found: list[tuple[Candidate, Estimate]] = []
    for candidate in candidates(maps, atlas, scaled.points, period):
        estimate = refine(maps, candidate.points, neighbours)
        if estimate is None or not _sound(maps, estimate):
            continue
        if not any(_same(maps, estimate, other) for _, other in found):
            found.append((candidate, estimate))
    return found


def _scaled(section: PoincareSection, neighbours: int) -> _Scaled:
    size = np.ptp(section.points, axis=0)
    if not np.all(size > 0.0):
        raise ValueError("section: a motion of period 1 is not allowed; a coordinate is the same at all points.")
    turn = np.array([2.0 * np.pi if name in section.angles else np.inf for name in section.coordinates]) / size
    points = section.points / size
    noise = np.zeros(2) if section.noise is None else section.noise / size
    maps = LocalMaps(points[:-1], section.increments / size, turn, section.winds, noise)
    check_chaos(maps, points)
    if section.noise is None:
        noise = noise_of(maps, neighbours)
        maps = LocalMaps(points[:-1], section.increments / size, turn, section.winds, noise)
    extent = None if section.signals is None else np.ptp(section.signals, axis=0)
    return _Scaled(points, size, maps, extent, _search_count(maps, FEWEST_NEIGHBOURS))


def _search_count(maps: LocalMaps, neighbours: int) -> int:
    """Return the neighbours of a local fit in the search: enough to be wide against the noise."""
    centres = maps.arguments[:: max(1, len(maps.arguments) // 500)]
    count = int(2.25 * neighbours)
    while count < len(maps.arguments) // 100:
        if np.median(maps.nearest(centres, count)[0][:, -1]) / REACH > SEARCH_WIDTH * maps.noise.max():
            break
        count = int(1.5 * count)
    return count


def _sound(maps: LocalMaps, estimate: Estimate) -> bool:
    size = estimate.points.size
    sd = np.sqrt(np.diag(estimate.covariance)[:size])
    tolerance = max(2e-3, 3.0 * float(sd.max()))
    return bool(sd.max() < LARGEST_SD and not has_shorter_period(estimate.points, maps.wrap, tolerance))


def _same(maps: LocalMaps, one: Estimate, other: Estimate) -> bool:
    distance, _ = shift_between(one.points, other.points, maps.wrap)
    sd = np.sqrt(max(np.diag(e.covariance)[: one.points.size].max() for e in (one, other)))
    return distance < max(1e-3, 2.0 * float(sd))


def _orbit(section: PoincareSection, scaled: _Scaled, candidate: Candidate, estimate: Estimate) -> Orbit:
    period = len(estimate.points)
    order = (np.arange(period) + candidate.shift) % period
    estimate = _begun_at(estimate, order)
    points = estimate.points * scaled.size
    for k, name in enumerate(section.coordinates):
        if name in section.angles:
            points[:, k] = wrapped(points[:, k])
    units = np.concatenate([np.tile(scaled.size, period), np.ones(2)])
    bias = estimate.bias * units
    covariance = estimate.covariance * np.outer(units, units)
    sd = np.sqrt(np.diag(covariance))
    covariance += np.outer(bias, bias)
    for k in (2 * period, 2 * period + 1):
        if not (abs(bias[k]) <= sd[k] and sd[k] < LARGEST_LOGARITHM_SD):
            covariance[k, :] = covariance[:, k] = np.nan
    cycle = section.cycle(candidate.closest, period)
    if cycle is not None:
        for k, name in enumerate(section.coordinates):
            if name in section.angles:
                cycle[name] = cycle[name] + 2.0 * np.pi * np.round((points[0, k] - cycle[name][0]) / (2.0 * np.pi))
    return Orbit(
        name="",
        coordinates=section.coordinates,
        angles=section.angles,
        frequency=section.frequency,
        period=period,
        winding=round(estimate.turns) if section.winds else None,
        points=points,
        joint_covariance=covariance,
        eigenvalues=estimate.eigenvalues,
        eigenvalue_bias=bias[2 * period :],
        returns=candidate.returns,
        quality=_quality(scaled, candidate, estimate),
        cycle=cycle,
        equilibrium=cycle is not None and _at_rest(section, scaled, cycle),
        synthetic=section.synthetic,
    )


def _at_rest(section: PoincareSection, scaled: _Scaled, cycle: dict[str, np.ndarray]) -> bool:
    """Return whether a measured cycle shows no motion but noise and the distance to the orbit."""
    assert scaled.extent is not None
    extent = np.where(np.isfinite(scaled.maps.turn), np.minimum(scaled.extent, 2.0 * np.pi), scaled.extent)
    limit = (STILL + SPREAD * scaled.maps.noise) * extent
    return all(np.ptp(cycle[name]) < limit[k] for k, name in enumerate(section.coordinates))


def _begun_at(estimate: Estimate, order: np.ndarray) -> Estimate:
    """Return the estimate with the orbit's points in another cyclic order."""
    size = 2 * len(order)
    index = np.concatenate([(2 * order[:, None] + np.arange(2)).ravel(), [size, size + 1]])
    return replace(
        estimate,
        points=estimate.points[order],
        covariance=estimate.covariance[np.ix_(index, index)],
        bias=estimate.bias[index],
    )


def _quality(scaled: _Scaled, candidate: Candidate, estimate: Estimate) -> float:
    """Return the p-value of the closest return under the maps along the orbit."""
    maps, period = scaled.maps, len(estimate.points)
    steps = candidate.closest + np.arange(period + 1)
    away = maps.wrap(scaled.points[steps] - np.take(estimate.points, np.arange(period + 1), 0, mode="wrap"))
    statistic = 0.0
    for point, here, there in zip(estimate.points, away[:-1], away[1:], strict=True):
        count = scaled.quality_count
        while maps.nearest(point[None], count)[0][0, -1] < 1.5 * np.abs(here).max() and 4 * count < len(maps.arguments):
            count *= 2
        fit = maps.fit(point[None], count, QUALITY_DEGREE, influence=False)
        left = maps.wrap(there - (maps.predict(fit, here[None])[0] - fit.value[0]))
        statistic += float(np.sum(left**2 / maps.rest(point[None], fit)[0]))
    return float(chi2.sf(statistic, 2 * period))


def _with_partners(orbits: list[Orbit], scaled: _Scaled) -> list[Orbit]:
    """Return the orbits with the position of the one that has all signs changed."""
    result: list[Orbit] = []
    for orbit in orbits:
        partner = None
        closest = np.inf
        for k, other in enumerate(orbits):
            if other.period != orbit.period:
                continue
            distance, _ = shift_between(orbit.points / scaled.size, -other.points / scaled.size, scaled.maps.wrap)
            sd = np.sqrt([np.diag(o.covariance).reshape(-1, 2).max(0) / scaled.size**2 for o in (orbit, other)]).max()
            if distance < max(2e-3, 4.0 * sd) and distance < closest:
                partner, closest = k, distance
        # Points alone do not show whether there is motion between them.
        rest = orbit.equilibrium or (orbit.cycle is None and orbit.period == 1 and partner == len(result))
        result.append(replace(orbit, partner=partner, equilibrium=rest))
    return result


def _named(orbits: list[Orbit]) -> list[Orbit]:
    counts: dict[tuple[int, int | None], int] = {}
    result = []
    for orbit in orbits:
        key = (orbit.period, orbit.winding)
        counts[key] = counts.get(key, 0) + 1
        winding = "" if orbit.winding is None else f", winding {orbit.winding}"
        result.append(replace(orbit, name=f"period {orbit.period}{winding}, orbit {counts[key]}"))
    return result
