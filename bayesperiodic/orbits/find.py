"""find_orbits: unstable periodic orbits of a chaotic section, without a model."""

import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.orbits import cycles
from bayesperiodic.orbits.coordinates import SHORT_RETURN, channels_of, crossed_of, longest_window_of_crossings, wrapped
from bayesperiodic.orbits.cycles import Estimate, MapCycle
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.orbits.phases import merged, phases_of, with_late_partners
from bayesperiodic.orbits.return_map import (
    FEWEST_FOLLOWED,
    KERNEL_REACH,
    NOISE_EXPLAINS,
    Atlas,
    ReturnMap,
    change_in_time,
    check_chaos,
    estimate_noise,
    prediction_error,
)
from bayesperiodic.orbits.return_times import return_times_of
from bayesperiodic.orbits.section import PoincareSection
from bayesperiodic.orbits.waveform import Following, waveform_of

SEARCHES = ("chained", "boxes")
QUALITY_DEGREE, FEWEST_NEIGHBOURS = 3, 32
# Bandwidth of the local fits of the search, in standard deviations of the noise.
SEARCH_WIDTH = 4.0
# Bandwidth with one coordinate: in standard deviations of the noise, and at most.
WIDTH_OF_ONE, WIDEST_OF_ONE = 20.0, 0.018
# Largest standard deviation of a point, in units of the attractor's size.
LARGEST_SD = 0.02
# Crossings: largest standard deviation of a period, in mean returns, and smallest quality of an orbit.
LARGEST_DURATION_SD, IMPLAUSIBLE = 0.01, 1e-3
# The delta method is not used for log|eigenvalue| beyond this standard deviation.
LARGEST_LOGARITHM_SD = 0.5
# False-alarm rate of the test for a return map that changes.
CHANGE_LEVEL = 1e-3
# Delays tried for a coordinate to add, in forcing periods, or in mean returns.
DELAYS_TRIED = (-0.25, -0.5)
# A coordinate to add reduces the errors of predictions to this fraction or less; smaller ones are not looked at.
REDUCED, LEAST_ERROR = 0.8, 0.01
# Times between crossings jump by more than this fraction of the shortest one, and distance from a cycle within which
# this is looked at.
RETURN_JUMP, BRANCH_REACH = 0.5, 0.3
# Standard deviations from which a determinant is impossible.
IMPOSSIBLE = 3.0
# Largest range of a state of rest: fraction of the range of the motion, and standard deviations of the noise.
STILL_RANGE, STILL_NOISE = 0.02, 20.0


@in_one_thread
def find_orbits(
    section: PoincareSection | Sequence[PoincareSection],
    *,
    periods: Iterable[int],
    method: str = "chained",
    neighbours: int = 32,
    box: float = 0.01,
    steps: int = 1,
    waveforms: bool = False,
) -> Orbits:
    """Find the unstable periodic orbits in a section of a chaotic motion, without a model.

    Orbits of a section by crossings have their own period, `Orbit.duration`, with an error: the times between crossings
    are fitted like the return map. Where some oscillations miss the level, the map jumps; an orbit is fitted to points
    that return after as many oscillations as it does. Orbits with a standard error of the period above 1 % of a mean
    return, or a quality below 0.001, are left out.

    "chained": points that nearly recur after p returns are near an orbit of period p. Local quadratic polynomials
    approximate the return map at the p points, and Newton's method moves all points together until the maps close the
    chain. The orbits found are fitted once more, with cubic polynomials in neighbourhoods as wide as the curvature of
    the map allows. Deconvoluting kernels remove the bias due to noise in the arguments. Eigenvalues are those of the
    product of the derivatives along the chain. Covariances are sandwich estimates over runs of consecutive points and
    include the estimated bias.

    "boxes": the method of de Kraker et al. (1997, see `Model`), section 5, as a baseline: recurrence to the same or an
    adjacent box, and one linear fit of the map over the whole period. Noise and curvature bias its eigenvalues.

    Parameters
    ----------
    section : PoincareSection or sequence of PoincareSection
        Several are of the same recordings, coordinates and frequency, with origins that differ by sixteenths of the
        forcing period: which orbits are found depends on the phase. Each orbit, as its waveform shows, is then
        returned once, at the phase of the first section, from the one where its errors are smallest.
    periods : iterable of int
        Prime periods in returns.
    method : {"chained", "boxes"}
    neighbours : int
        Smallest effective number of neighbours of a local fit, at least 16; more are used with one coordinate.
    box : float
        Size of a box for "boxes", as a fraction of the attractor's size.
    steps : int
        Local maps a return for "chained", from one phase of the forcing to the next, if the section is of a recording
        and not by crossings.
        A map over a part of the period stretches less and is closer to a polynomial: more orbits are found where one
        return stretches much, but each map needs the noise of its points to be small against its bandwidth.
    waveforms : bool
        Find also the attribute ``waveform`` of each orbit, which takes longer than the search, for "chained" and a
        section of a recording. With several sections they are always found.

    Returns
    -------
    Orbits
        Ordered by period, those of several sections also by the modulus of the largest eigenvalue. States of rest are
        found like other orbits and marked `equilibrium`. The covariance of log|eigenvalue| is NaN ("not estimated")
        where the estimated bias exceeds the standard deviation, or the standard deviation exceeds 0.5. Errors of points
        and of eigenvalues are taken as independent where an orbit is not of the first of several sections.

    Raises
    ------
    ValueError
        For a section that is periodic, quasi-periodic or shows no return map, because of unknown states (the message
        names which, and a delayed coordinate to add), for an unknown method, for periods that are not whole numbers,
        and for several sections that differ in more than their phase.

    Warns
    -----
    UserWarning
        If the return map of the first section has a trend in time, by a test whose false-alarm rate is 0.1 %; and if
        the coordinates of crossings do not determine the next point, because a delayed one reduces errors of
        predictions that noise does not explain.

    Examples
    --------
    `henon_section`: 1,900 points of the Hénon map x' = 1 − 1.4 x² + y, y' = 0.3 x. Its attractor contains one orbit of
    period 1 and one of period 2:

    >>> [orbit.period for orbit in bp.find_orbits(henon_section, periods=[1, 2, 3])]
    [1, 2]
    """
    if isinstance(section, PoincareSection):
        of_one = _of_section(section, periods, method, neighbours, box, steps, waveforms)
        _warn_of_change(section)
        _warn_of_coordinates(section, *of_one.prediction_error)
        return of_one
    _checks.instance("section", section, (list, tuple))
    for one in section:
        _checks.instance("section", one, PoincareSection)
    if not section or method == "boxes":
        raise ValueError("section: must be at least one section, for the method 'chained', where there are several.")
    late, wanted = phases_of(section), list(periods)
    each = [_of_section(one, wanted, method, neighbours, box, steps, waveforms=True) for one in section]
    maps, size, _ = _scaled(section[0], neighbours)
    _warn_of_change(section[0])
    orbits = with_late_partners(_finished(merged([one.orbits for one in each], late), maps, size))
    worst = max((one.prediction_error for one in each), key=lambda error: error[0])
    return Orbits(orbits, values=section[0].values, method=method, prediction_error=worst)


def _of_section(
    section: PoincareSection, periods: Iterable[int], method: str, neighbours: int, box: float, steps: int,
    waveforms: bool,
) -> Orbits:  # fmt: skip
    """Return the orbits of one section."""
    wanted = _periods(periods, section)
    _checks.one_of("method", method, SEARCHES)
    steps, box = _checks.integer("steps", steps, 1), _checks.positive("box", box)
    neighbours = _checks.integer("neighbours", neighbours, 16)
    maps, size, prediction = _scaled(section, neighbours)
    neighbours = _wide_enough(maps, neighbours)
    if method == "boxes":
        triples = [(maps, *pair) for p in wanted for pair in cycles.box_orbits(maps, p, neighbours, box)]
    else:
        if steps > 1:
            maps = _with_steps(section, maps, size, steps)
        atlas = Atlas(maps, _search_count(maps, neighbours))
        triples = [one for p in wanted for one in _chained(section, maps, atlas, p, neighbours)]
    quality_count = _search_count(maps, FEWEST_NEIGHBOURS)
    following = Following(section, maps, size) if waveforms and triples and section.measured is not None else None
    extent, orbits = _extent(section), []
    for branch, candidate, estimate in triples:
        motion = following if following is None or branch is maps else Following(section, branch, size)
        quality = _quality(branch, candidate, estimate, quality_count)
        orbit = _orbit(section, branch, size, extent, candidate, estimate, quality, motion)
        doubtful = orbit.duration_sd > LARGEST_DURATION_SD / section.frequency or quality < IMPLAUSIBLE
        if section.crossed is None or not doubtful:
            orbits.append(orbit)
    finished = with_late_partners(_finished(orbits, maps, size))
    return Orbits(finished, values=section.values, method=method, prediction_error=prediction)


def _periods(periods: Iterable[int], section: PoincareSection) -> list[int]:
    try:
        wanted = sorted({_checks.integer("periods", p, 1) for p in periods})
    except TypeError:
        raise ValueError(f"periods: must be a collection such as range(1, 6), got {periods!r}.") from None
    count, longest, where = len(section), len(section) // 20, ""
    if section.stretches is not None:
        lengths = np.unique(section.stretches, return_counts=True)[1]
        returns = (int(np.maximum(lengths - p, 0).sum()) for p in range(1, longest + 1))
        longest = sum(many >= FEWEST_FOLLOWED for many in returns)
        where = f" in {lengths.size} unbroken stretches"
    if not wanted or wanted[-1] > longest:
        raise ValueError(
            f"periods: must have at least one entry and, with {count} points{where}, none above {longest}, got "
            f"{wanted}."
        )
    return wanted


def _scaled(section: PoincareSection, neighbours: int) -> tuple[ReturnMap, np.ndarray, tuple[float, float]]:
    """Return the return map in units of the attractor's size, that size (d,), and errors of predictions."""
    maps, size = _return_map(section)
    prediction = check_chaos(maps, lambda error: _change(maps) + _remedy(section, maps, error))
    if section.noise is None:
        maps.noise = estimate_noise(maps, neighbours)
    return maps, size, prediction


def _return_map(section: PoincareSection) -> tuple[ReturnMap, np.ndarray]:
    """Return the return map in units of the attractor's size, and that size (d,)."""
    size = np.ptp(section.points, axis=0)
    if not np.all(size > 0.0):
        raise ValueError(
            "section: must be of a chaotic motion, got one of period 1: a coordinate is equal at all points."
        )
    turn = np.array([2.0 * np.pi if name in section.angles else np.inf for name in section.coordinates]) / size
    noise = np.zeros(size.size) if section.noise is None else section.noise / size
    maps = ReturnMap(
        section.points / size, section.increments / size, turn, section.winds, noise, section.stretches,
        noises=None if section.noises is None else section.noises / size,
    )  # fmt: skip
    return maps, size


def _warn_of_change(section: PoincareSection) -> None:
    """Warn if the return map has a trend in time."""
    if text := _change(_return_map(section)[0]):
        text += "Orbits and their errors are those of a mean over time; compare those of the parts."
        warnings.warn(f"section: {text[0].lower()}{text[1:]}", UserWarning, stacklevel=4)


def _warn_of_coordinates(section: PoincareSection, error: float, from_noise: float) -> None:
    """Warn if a delayed coordinate reduces errors of predictions of crossings that noise does not explain."""
    if section.crossed is None or error < LEAST_ERROR or from_noise > NOISE_EXPLAINS * error:
        return
    name, least = _best_delayed(section, _return_map(section)[0])
    if least < REDUCED * error:
        warnings.warn(
            f"section: coordinates must determine the next point, got errors of predictions of {error:.1%}, "
            f"{from_noise:.1%} from known noise, and {least:.1%} with {name!r}. Orbits and their errors may be wrong: "
            "add this coordinate.",
            UserWarning, stacklevel=4,
        )  # fmt: skip


def _change(maps: ReturnMap) -> str:
    """Return that the return map has a trend in time, and what to do, as text; empty if no trend is seen."""
    p = change_in_time(maps)
    if p > CHANGE_LEVEL:
        return ""
    return (
        f"The return map changes during the recording (p = {p:.1g}), as with parameters that drift, a transient or a "
        "sensor that drifts. Use shorter parts, recording.between(start, end). "
    )


def _remedy(section: PoincareSection, maps: ReturnMap, error: float) -> str:
    """Return what to do where local maps predict with an error: which delayed coordinate to add, or more points."""
    name, least = _best_delayed(section, maps)
    more = "If the system has more states than coordinates, add one: another output"
    if not name:
        return f"{more}."
    if least > REDUCED * error:
        return (
            f"{more}; delayed ones do not help, with {name!r} errors are {least:.1%}. {len(section)} points may "
            "be too few for local maps: record longer."
        )
    kind = "the interval" if crossed_of(name) else "a delayed one"
    return f"{more} or {kind}, with {name!r} errors are {least:.1%}."


def _best_delayed(section: PoincareSection, maps: ReturnMap) -> tuple[str, float]:
    """Return the coordinate to add with which local maps predict best, and their error; an empty name if none.

    It is a delayed one, or the interval between crossings where that is much better.
    """
    errors, size = {}, np.ptp(section.points, axis=0)
    channels = dict.fromkeys([*channels_of(section.coordinates), *filter(None, [section.crossed])])
    # For crossings, fractions of the mean return.
    delays = [f"{d / section.frequency:.2g} s" if section.crossed else str(d) for d in DELAYS_TRIED]
    names = [f"{channel}[{d}]" for channel in channels if channel not in section.angles for d in delays]
    interval = f"interval({section.crossed})"
    for name in [*names, interval] if section.crossed else names:
        values = None if name in section.coordinates or not _separate(section, name) else section.delayed(name)
        if values is None:
            continue
        column = values[:, None] / np.ptp(values[np.isfinite(values)])
        # No increments across breaks, where those of the section are NaN.
        increments = np.diff(column, axis=0) + 0.0 * section.increments[:, :1]
        points, added = np.hstack([maps.points, column]), np.hstack([section.increments / size, increments])
        turn, noise = np.append(maps.turn, np.inf), np.append(maps.noise, 0.0)
        errors[name] = prediction_error(ReturnMap(points, added, turn, maps.winds, noise, maps.stretches))[0]
    of_interval = errors.pop(interval, np.inf)
    best = min(errors.items(), key=lambda item: item[1], default=("", np.inf))
    return (interval, of_interval) if of_interval < REDUCED * best[1] else best


def _separate(section: PoincareSection, coordinate: str) -> bool:
    """Return whether a delayed coordinate shares no samples with those of crossings."""
    if section.crossed is None or section.measured is None:
        return True
    samples, instants, stretch = section.measured
    returns, rate = np.diff(instants)[np.diff(stretch) == 0], samples.sampling_rate
    try:
        longest_window_of_crossings((*section.coordinates, coordinate), section.crossed, rate, returns)
    except ValueError:
        return False
    return True


def _with_steps(section: PoincareSection, maps: ReturnMap, size: np.ndarray, steps: int) -> ReturnMap:
    """Return the return map in several steps a return, in the same units."""
    points, increments, noise = section.between(steps)
    stretches = np.repeat(maps.stretches, steps)
    return ReturnMap(points / size, increments / size, maps.turn, maps.winds, noise / size, stretches, steps)


def _wide_enough(maps: ReturnMap, neighbours: int) -> int:
    """Return the neighbours for which fits in one coordinate are as wide as in two, or as the noise needs."""
    most = maps.as_wide_as_two(neighbours)
    if most == neighbours:
        return neighbours
    centres = maps.arguments[:: max(1, len(maps.arguments) // 500)]
    width = np.median(maps.nearest(centres, np.zeros(len(centres)), most)[0][:, -1]) / KERNEL_REACH
    wanted = min(WIDTH_OF_ONE * float(maps.noise.max()), WIDEST_OF_ONE)
    return int(np.clip(most * wanted / width, neighbours, most))


def _search_count(maps: ReturnMap, neighbours: int) -> int:
    """Return the neighbours of a local fit in the search: enough for a bandwidth well above the noise."""
    centres = maps.arguments[:: max(1, len(maps.arguments) // 500)]
    count = int(2.25 * neighbours)
    phases = maps.phases(maps.positions[:: max(1, len(maps.arguments) // 500)])
    while count < maps.count // 100:
        if np.median(maps.nearest(centres, phases, count)[0][:, -1]) / KERNEL_REACH > SEARCH_WIDTH * maps.noise.max():
            break
        count = int(1.5 * count)
    return count


def _chained(
    section: PoincareSection, maps: ReturnMap, atlas: Atlas, period: int, neighbours: int
) -> list[tuple[ReturnMap, MapCycle, Estimate]]:
    """Return the orbits of a period, each with the return map to which it was fitted."""
    triples: list[tuple[ReturnMap, MapCycle, Estimate]] = []
    before: list[np.ndarray] = []
    sds: list[float] = []
    for candidate in cycles.candidates(maps, atlas, period):
        branch = _on_branches(section, maps, candidate)
        estimate = cycles.refine(branch, candidate.points, neighbours)
        if estimate is None or not (sd := _largest_sd(estimate)) < LARGEST_SD:
            continue
        returns = estimate.points[:: maps.steps]
        repeats = cycles.has_shorter_period(returns, maps.wrap, max(2e-3, 3.0 * sd))
        distances, _ = cycles.shifts_between(returns, before, maps.wrap)
        if not repeats and np.all(distances >= np.maximum(1e-3, 2.0 * np.maximum(sd, sds))):
            triples.append((branch, candidate, estimate))
            before.append(returns)
            sds.append(sd)
    return triples


def _on_branches(section: PoincareSection, maps: ReturnMap, candidate: MapCycle) -> ReturnMap:
    """Return the return map without the points that return after another number of oscillations than the candidate.

    Where a motion touches the level, the map of crossings jumps, and so do the times between them. A polynomial across
    the jump does not approximate the map.
    """
    if section.crossed is None or section.instants is None:
        return maps
    returns, count = np.diff(section.instants), len(candidate.points)
    of_cycle = np.roll(returns[candidate.closest + np.arange(count)], candidate.shift)
    away = np.abs(maps.wrap(maps.arguments[:, None] - candidate.points)).max(axis=2)
    nearest, known = away.argmin(axis=1), returns[maps.positions]
    jumps = np.abs(known - of_cycle[nearest]) > RETURN_JUMP * np.quantile(known, SHORT_RETURN)
    if not np.any(jumps & (away.min(axis=1) < BRANCH_REACH)):
        return maps
    return maps.without(jumps)


def _largest_sd(estimate: Estimate) -> float:
    return float(np.sqrt(np.diag(estimate.covariance)[: estimate.points.size].max()))


def _extent(section: PoincareSection) -> np.ndarray | None:
    """Return the ranges (channels,) of the recorded signals, of angles at most a turn; None without a recording."""
    if section.signals is None:
        return None
    extent = np.array([np.ptp(signal) for signal in section.signals.T[: len(channels_of(section.coordinates))]])
    return np.where(np.isin(channels_of(section.coordinates), section.angles), np.minimum(extent, 2.0 * np.pi), extent)


def _orbit(
    section: PoincareSection, maps: ReturnMap, size: np.ndarray, extent: np.ndarray | None, candidate: MapCycle,
    estimate: Estimate, quality: float, following: Following | None,
) -> Orbit:  # fmt: skip
    count, d = estimate.points.shape
    period = count // maps.steps
    # The orbit starts at the point that belongs to the start of the measured cycle.
    order = maps.steps * ((np.arange(period) + candidate.shift) % period)
    index = np.concatenate([(d * order[:, None] + np.arange(d)).ravel(), d * count + np.arange(d)])
    points = wrapped(estimate.points[order] * size, maps.angle)
    units = np.concatenate([np.tile(size, period), np.ones(d)])
    bias = estimate.bias[index] * units
    covariance = estimate.covariance[np.ix_(index, index)] * np.outer(units, units)
    sd = np.sqrt(np.diag(covariance))
    covariance += np.outer(bias, bias)
    remark = _remark(estimate.eigenvalues, covariance[-d:, -d:])
    for k in range(-d, 0):
        if not (abs(bias[k]) <= sd[k] and sd[k] < LARGEST_LOGARITHM_SD):
            covariance[k, :] = covariance[:, k] = np.nan
    cycle = section.cycle(candidate.closest, period)
    still = False
    if cycle is not None and extent is not None:
        for column in np.flatnonzero(maps.angle):
            values = cycle[section.coordinates[column]]
            values += 2.0 * np.pi * np.round((points[0, column] - values[0]) / (2.0 * np.pi))
        # It moves no more than by noise and its distance to the orbit.
        limit = (STILL_RANGE + STILL_NOISE * maps.noise.max()) * extent
        still = bool(np.all(np.ptp(np.stack(list(cycle.values())), axis=1) < limit))
    times, waveform = return_times_of(section, maps, estimate, candidate.closest), None
    if following is not None and estimate.fits is not None:
        waveform = waveform_of(following, maps, estimate.fits, candidate.shift, times)
    return Orbit(
        name="", coordinates=section.coordinates, angles=section.angles,
        frequency=section.frequency if times is None else period / float(times.each.sum()), period=period,
        winding=round(estimate.turns) if section.winds else None, points=points, joint_covariance=covariance,
        eigenvalues=estimate.eigenvalues, eigenvalue_bias=bias[-d:], returns=candidate.returns, quality=quality,
        cycle=cycle, waveform=waveform, equilibrium=still, synthetic=section.synthetic, remark=remark,
        return_times=None if times is None else np.roll(times.each, -candidate.shift),
        duration_sd=0.0 if times is None else times.sd,
    )  # fmt: skip


def _remark(eigenvalues: np.ndarray, covariance: np.ndarray) -> str:
    """Return what is impossible about the determinant of a flow's map, given the covariance of log|eigenvalue|."""
    if len(eigenvalues) == 1:  # The map along a thin attractor, not that of the flow.
        return ""
    determinant, sd = float(np.prod(eigenvalues).real), float(np.sqrt(covariance.sum()))
    if determinant < 0.0 and IMPOSSIBLE * sd < 1.0:
        return f"determinant {determinant:.3g} ± {-determinant * sd:.2g}, negative in no flow"
    if determinant > 1.0 and np.log(determinant) > IMPOSSIBLE * sd:
        return f"determinant {determinant:.3g} ± {determinant * sd:.2g}, above one in no damped flow"
    return ""


def _quality(maps: ReturnMap, candidate: MapCycle, estimate: Estimate, neighbours: int) -> float:
    """Return the p-value of the closest return under the maps along the orbit."""
    steps = np.arange(len(estimate.points) + 1)
    points = np.roll(estimate.points, -maps.steps * candidate.shift, axis=0)
    away = maps.wrap(maps.points[maps.steps * candidate.closest + steps] - points[steps % len(points)])
    here, there, phases = away[:-1], away[1:], maps.phases(steps[:-1])
    counts, growing, reach = np.full(len(points), neighbours), np.arange(len(points)), 1.5 * np.abs(here).max(1)
    while growing.size and 4 * (count := counts[growing[0]]) < maps.count:
        farthest = maps.nearest(points[growing], phases[growing], count)[0][:, -1]
        growing = growing[farthest < reach[growing]]
        counts[growing] *= 2
    statistic = 0.0
    for count in np.unique(counts):
        some = np.flatnonzero(counts == count)
        fit = maps.fit(points[some], phases[some], count, QUALITY_DEGREE, influence=False)
        residual = maps.wrap(there[some] - (maps.predict(fit, here[some]) - fit.value))
        statistic += float(np.sum(residual**2 / maps.residual_variance(points[some], fit)))
    return float(chdtrc(estimate.points.size, statistic))


def _finished(orbits: list[Orbit], maps: ReturnMap, size: np.ndarray) -> tuple[Orbit, ...]:
    """Return the orbits with names, and with the positions of their mirror images under the change of all signs."""
    result: list[Orbit] = []
    counts: Counter[tuple[int, int | None]] = Counter()
    points = [orbit.points / size for orbit in orbits]
    sds = [np.sqrt(np.diag(o.covariance).reshape(o.points.shape).max(0) / size**2).max() for o in orbits]
    for number, orbit in enumerate(orbits):
        alike = [k for k, other in enumerate(orbits) if other.period == orbit.period]
        distances, _ = cycles.shifts_between(points[number], [-points[k] for k in alike], maps.wrap)
        away = dict(zip(alike, distances.tolist(), strict=True))
        near = [k for k, distance in away.items() if distance < max(2e-3, 4.0 * sds[number], 4.0 * sds[k])]
        partner = min(near, key=away.__getitem__, default=None)
        # Without a measured cycle, a symmetric fixed point is taken for a state of rest.
        rest = orbit.equilibrium or (orbit.cycle is None and orbit.period == 1 and partner == number)
        counts[orbit.period, orbit.winding] += 1
        winding = "" if orbit.winding is None else f", winding {orbit.winding}"
        name = f"period {orbit.period}{winding}, orbit {counts[orbit.period, orbit.winding]}"
        result.append(replace(orbit, name=name, partner=partner, equilibrium=rest))
    return tuple(result)
