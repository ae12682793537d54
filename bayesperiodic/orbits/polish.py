"""polish_orbits and select_orbits: a model's solutions for the orbits of a section, and their choice as data."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.coordinates import is_output, wrapped
from bayesperiodic.orbits.cycles import shift_between
from bayesperiodic.orbits.orbit import TURN, Orbit, Orbits, counted_turns, resampled_cycle
from bayesperiodic.orbits.waveform import mean_of_repeats
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, STATUSES
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.solution import PeriodicSolution, describe, multiplier_sensitivities
from bayesperiodic.periodic.solve import integrate, solve_driven

# In units of the attractor's size: solutions that coincide, the largest range of a state of rest.
SAME_SOLUTION, SMALLEST_MOTION = 1e-5, 1e-6
# Largest distance of a solution from the measured orbit, in standard errors.
MOST_ERRORS = 5.0
# Signs of multipliers are compared up to this standard deviation of log|μ| and this phase.
SURE, REAL = 0.3, 1e-6
# Number of winding numbers tried for an orbit whose turns are not counted.
MOST_TRIED = 12
# Directions with less information than this fraction of the largest are ignored.
LEAST_EIGENVALUE = 1e-10


@in_one_thread
def polish_orbits(
    model: Model,
    orbits: Orbits | Sequence[Orbit],
    parameters: Mapping[str, float],
    *,
    inputs: Mapping[str, np.ndarray] | None = None,
    parameter_sd: Mapping[str, float] | None = None,
    samples: int = 800,
    scheme: str | Scheme = "central4",
    tolerance: float = 0.01,
) -> Orbits:
    """Solve a model for every orbit of a section, and accept the solutions that agree with the measured orbits.

    Newton's method starts from the measured cycle with its winding number; for points alone, from the model integrated
    over one forcing period from each section point, for all possible winding numbers. A solution that repeats itself is
    reduced to its prime period, and the measured points with it. It is accepted if every section point is within five
    standard errors of the measured one, and if its unstable multiplier has the sign of the measured eigenvalue, where
    that is known to 30 %. The standard error combines the covariance of the points, `tolerance` and the uncertainty of
    the parameters. Of several candidates for one orbit (cyclic shifts included), the one with the most returns is kept.
    An orbit and its mirror image under the change of all signs are two orbits with independent noise, and partners.

    Parameters
    ----------
    model : Model
        A forced one, whose states (and rates, if there is no measured cycle) follow from the section's coordinates.
    orbits : Orbits, or sequence of Orbit
        From `find_orbits`; those rejected before stay rejected.
    parameters, inputs, samples, scheme
        As for `solve_periodic`; inputs over one forcing period.
    parameter_sd : mapping of str to float, optional
        Standard deviations of uncertain parameters. They widen the accepted distances by their effect on the section
        points, to first order.
    tolerance : float
        Additional standard error of every measured coordinate, as a fraction of the range of all measured values, of a
        turn for an angle.

    Returns
    -------
    Orbits
        The accepted ones with `.solution`, `.winding` and `.partner`, states of rest marked `.equilibrium`; in
        `.rejected` all others with the reason.

    Raises
    ------
    ValueError
        As for `solve_periodic`, and for an autonomous model, delayed coordinates, or coordinates that do not determine
        the model's states.

    Examples
    --------
    `pendulum_orbits`: the orbits of period 1 in 2,000 forcing periods of the pendulum in `PoincareSection`'s example.
    Newton's method on the return map of the integrated model gives the multiplier −1.7059:

    >>> polished = bp.polish_orbits(bp.models.pendulum, pendulum_orbits, pendulum_parameters, samples=200)
    >>> [turning] = [orbit for orbit in polished if orbit.winding == 1 and orbit.eigenvalues[0].real < 0]
    >>> print(f"{turning.solution.multipliers[0].real:.3f}")
    -1.706
    """
    _checks.instance("model", model, Model)
    _checks.instance("orbits", orbits, (Orbits, list, tuple))
    given = orbits if isinstance(orbits, Orbits) else Orbits(tuple(orbits))
    polisher = _Polisher(model, given.orbits, parameters, inputs or {}, parameter_sd or {}, samples, scheme, tolerance)
    results = [(orbit, *polisher.polish(orbit)) for orbit in given]
    rejected = [*given.rejected, *((orbit, reason) for orbit, _, reason in results if reason)]
    polished = [solved for _, solved, reason in results if not reason]
    kept: list[int] = []
    for i in sorted(range(len(polished)), key=lambda i: -polished[i].returns):
        for k in kept:
            shift = polisher.shift(polished[i], polished[k])
            if shift is not None:
                how = f", shifted by {shift} forcing periods" if shift else ""
                rejected.append((polished[i], f"the same orbit as {polished[k].name!r}{how}"))
                break
        else:
            kept.append(i)
    accepted = [polished[i] for i in sorted(kept)]
    partners = [
        next((j for j, other in enumerate(accepted) if polisher.shift(one, other, sign=-1) is not None), None)
        for one in accepted
    ]
    return _selection(given, accepted, partners, rejected)


def _selection(
    orbits: Orbits, kept: list[Orbit], partners: list[int | None], rejected: list[tuple[Orbit, str]]
) -> Orbits:
    paired = tuple(replace(orbit, partner=partner) for orbit, partner in zip(kept, partners, strict=True))
    return replace(orbits, orbits=paired, rejected=tuple(rejected))


class _Polisher:
    """A model with given parameters, and the section to which the orbits belong; see `polish_orbits`."""

    def __init__(
        self,
        model: Model,
        orbits: Sequence[Orbit],
        parameters: Mapping[str, float],
        inputs: Mapping[str, np.ndarray],
        parameter_sd: Mapping[str, float],
        samples: int,
        scheme: str | Scheme,
        tolerance: float,
    ):
        if model.autonomous:
            raise ValueError(f"model: must be a forced one, got {model.name!r}, which is autonomous.")
        _checks.positive("tolerance", tolerance)
        _checks.same_names("parameters", parameters, model.parameters)
        for name, sd in parameter_sd.items():
            _checks.one_of("parameter_sd", name, model.parameters)
            _checks.positive(f"parameter_sd[{name!r}]", sd)
        PeriodicEquations.build(model, inputs, frequency=1.0, samples=samples, scheme=scheme)
        for orbit in orbits:
            if orbit.return_times is not None:
                raise ValueError(f"orbits: must be of a section with a forcing, got {orbit.name!r} between crossings.")
            if not all(map(is_output, orbit.coordinates)):
                raise ValueError(
                    f"orbits: must be of a section without delays and integrals, got {orbit.coordinates}. Use the "
                    "experiments of the orbits, orbit.experiment(states=…), in a Problem."
                )
            for name in orbit.coordinates:
                _checks.one_of("coordinates", name, model.outputs)
            if (orbit.coordinates, orbit.angles) != (orbits[0].coordinates, orbits[0].angles):
                raise ValueError(f"orbits: must be of one section, got {orbit.name!r} with other coordinates.")
        self.model, self.inputs, self.parameter_sd = model, inputs, parameter_sd
        self.samples, self.scheme, self.tolerance = samples, scheme, tolerance
        self.theta = np.array([_checks.finite_number(f"parameters[{n!r}]", parameters[n]) for n in model.parameters])
        if orbits:
            coordinates = orbits[0].coordinates
            self.angles = np.array([name in orbits[0].angles for name in coordinates])
            # The attractor's size: a turn for angles, the range of all measured values for others.
            measured = [orbit.points for orbit in orbits]
            measured += [np.stack([o.cycle[n] for n in coordinates], axis=-1) for o in orbits if o.cycle is not None]
            spread = np.ptp(np.concatenate(measured), axis=0)
            self.scales = np.where(self.angles, TURN, np.where(spread == 0.0, 1.0, spread))

    def polish(self, orbit: Orbit) -> tuple[Orbit, str]:
        """Return the orbit with its solution and an empty reason, or unchanged with the reason for its rejection."""
        first = ""
        for winding, states in self._starts(orbit):
            solved, reason = self._solve(orbit, winding, states)
            if not reason:
                return solved, ""
            first = first or reason
        return orbit, first or "the model's states diverge from its section points"

    def shift(self, one: Orbit, other: Orbit, sign: int = 1) -> int | None:
        """Return the cyclic shift under which two polished orbits, one of them times `sign`, coincide; None if none."""
        if one.period != other.period or one.winding is None or one.winding * sign != other.winding:
            return None
        points, others = sign * self._section_points(one), self._section_points(other)
        distance, shift = shift_between(points, others, lambda away: wrapped(away, self.angles) / self.scales)
        return shift if distance <= SAME_SOLUTION else None

    def _section_points(self, orbit: Orbit) -> np.ndarray:
        assert orbit.solution is not None
        outputs = np.stack([orbit.solution.outputs[name] for name in orbit.coordinates], axis=-1)
        return wrapped(outputs[:: self.samples], self.angles)

    def _equations(self, orbit: Orbit, winding: int) -> PeriodicEquations:
        return PeriodicEquations.build(
            self.model,
            {name: np.tile(values, orbit.period) for name, values in self.inputs.items()},
            frequency=orbit.frequency,
            samples=self.samples,
            scheme=self.scheme,
            periods=orbit.period,
            winding=winding,
        )

    def _solve(self, orbit: Orbit, winding: int, states: np.ndarray) -> tuple[Orbit, str]:
        equations = self._equations(orbit, winding)
        solved, found_by = solve_driven(equations, self.theta, dict(zip(self.model.states, states.T, strict=True)))
        if solved.code not in (CONVERGED, OTHER_ORBIT):
            return orbit, f"the periodic solve ended with {STATUSES[solved.code]!r}"
        columns = [self.model.outputs.index(name) for name in orbit.coordinates]
        outputs = equations.outputs(solved.z, self.theta)[:, columns]
        still = not equations.drift.any() and bool(np.all(np.ptp(outputs, axis=0) <= SMALLEST_MOTION * self.scales))
        repetitions = int(equations.kernels.repetitions(solved.z, equations.grid.periods))
        times = orbit.period if still else repetitions
        winding = sum(equations.winding.values()) // times
        if times > 1:
            orbit = self._reduced(orbit, times)
            equations = self._equations(orbit, winding)
            solved = equations.solve(self.theta, solved.z[: equations.grid.points])
        solution = describe(equations, self.theta, solved._replace(code=CONVERGED), found_by)
        if not solution.converged:
            return orbit, f"the periodic solve ended with {solution.status!r}"
        if times % 2 == 0:
            orbit = replace(orbit, eigenvalues=np.copysign(np.abs(orbit.eigenvalues), solution.multipliers.real))
        orbit = replace(orbit, winding=winding, solution=solution, equilibrium=still)
        return orbit, self._mismatch(orbit) or _sign_mismatch(orbit)

    def _reduced(self, orbit: Orbit, times: int) -> Orbit:
        """Return an orbit that repeats itself `times` times within its period with its prime period.

        Points are averaged and log|eigenvalue| is divided by `times`. For even `times`, the signs of the eigenvalues
        are undetermined, and the moduli are given.
        """
        period, coordinates = orbit.period // times, orbit.points.shape[1]
        repeats = orbit.points.reshape(times, period, coordinates)
        mean = repeats[0] + wrapped(repeats - repeats[0], self.angles).mean(axis=0)
        size = orbit.points.size
        average = np.zeros((mean.size + coordinates, size + coordinates))
        average[: mean.size, :size] = np.tile(np.eye(mean.size), times) / times
        average[mean.size :, size:] = np.eye(coordinates) / times
        unknown = np.isnan(orbit.joint_covariance)
        covariance = average @ np.where(unknown, 0.0, orbit.joint_covariance) @ average.T
        moduli = np.abs(orbit.eigenvalues) ** (1.0 / times)
        signed = times % 2 and not np.iscomplexobj(orbit.eigenvalues)
        return replace(
            orbit,
            name=f"{orbit.name}, reduced to period {period}",
            period=period,
            points=wrapped(mean, self.angles),
            joint_covariance=np.where(average @ unknown @ average.T > 0, np.nan, covariance),
            eigenvalues=np.sign(orbit.eigenvalues) * moduli if signed else moduli,
            eigenvalue_bias=orbit.eigenvalue_bias / times,
            cycle=orbit.cycle and {name: values[: len(values) // times] for name, values in orbit.cycle.items()},
            waveform=orbit.waveform and mean_of_repeats(orbit.waveform, times, orbit.angles),
        )

    def _mismatch(self, orbit: Orbit) -> str:
        """Return how the section points of the solution differ from the measured ones; empty if they agree."""
        solution = orbit.solution
        assert solution is not None
        variance = np.diag(orbit.covariance).reshape(orbit.points.shape) + (self.tolerance * self.scales) ** 2
        for name, sd in self.parameter_sd.items():
            variance = variance + (sd * _slopes(orbit, solution, name)) ** 2
        off = np.abs(wrapped(self._section_points(orbit) - orbit.points, self.angles)) / np.sqrt(variance)
        at, coordinate = np.unravel_index(int(np.argmax(off)), off.shape)
        if off.max() <= MOST_ERRORS:
            return ""
        kind = "a state of rest" if orbit.equilibrium else f"another orbit of period {orbit.period}"
        return (
            f"the solution is {kind}: {orbit.coordinates[coordinate]!r} at point {at} is {off.max():.3g} standard "
            "errors from the measured one"
        )

    def _starts(self, orbit: Orbit) -> Iterator[tuple[int, np.ndarray]]:
        """Yield winding numbers and states (points, states), whole turns included: the cycle, then integrated ones."""
        winding = counted_turns(orbit)
        equations = self._equations(orbit, 0)
        if orbit.cycle is not None:
            assert winding is not None
            phases = self._phases(orbit, equations, resampled_cycle(orbit, winding, self.samples))
            yield winding, phases[:, : equations.count]
        for turns, states in self._integrated(orbit, equations):
            if winding is None or turns == winding:
                yield turns, states

    def _integrated(self, orbit: Orbit, equations: PeriodicEquations) -> Iterator[tuple[int, np.ndarray]]:
        """Yield winding numbers and states through the section points.

        The model is integrated over one forcing period from each point, and the segments are corrected so that they
        meet. Several winding numbers are possible; they follow in the order of the corrections they need.
        """
        samples, count = self.samples, equations.count
        starts = self._phases(orbit, equations, orbit.points, rates=True)
        half = _fourier.on_grid(_fourier.coefficients(equations.inputs[:samples].T), 2 * samples).T
        paths = [
            integrate(equations, self.theta, start, half, samples + 1, samples + 1, equations.grid.samples)
            for start in starts
        ]
        segments = np.array([path[:, :count] for path in paths if path is not None])
        if len(segments) < orbit.period:
            return
        missed = segments[:, -1] - np.roll(starts[:, :count], -1, axis=0)
        # The unit vector of the angle; zero without one.
        angle = np.eye(count)[[state in self.model.angles for state in self.model.states]][:1].sum(axis=0)
        exact = missed @ angle / TURN
        choices = product(*(sorted({np.floor(turns), np.ceil(turns)}) for turns in exact))
        ranked = sorted(choices, key=lambda turns: float(np.sum((exact - np.array(turns)) ** 2)))
        # Errors grow along an unstable orbit, so most of the correction belongs to the end of a segment.
        fraction = (np.arange(samples) / samples)[:, None] ** 2
        for chosen in ranked[:MOST_TRIED]:
            turns = TURN * np.outer(chosen, angle)[:, None]
            before = np.cumsum(turns, axis=0) - turns
            corrected = segments[:, :-1] - fraction * (missed[:, None] - turns) + before
            yield int(sum(chosen)), corrected.reshape(-1, count)

    def _phases(
        self, orbit: Orbit, equations: PeriodicEquations, values: np.ndarray, rates: bool = False
    ) -> np.ndarray:
        """Return the states, then the rates of the second-order ones, (points, size), from the section's coordinates.

        The values of the coordinates are at whole tau if rates are needed; else on the grid, and the rates are invalid.
        """
        model, count, every = self.model, equations.count, self.samples if rates else 1
        tau, here = np.ascontiguousarray(equations.grid.tau[::every]), np.ascontiguousarray(equations.inputs[::every])
        columns = [model.outputs.index(name) for name in orbit.coordinates]
        second = [i for i, state in enumerate(model.states) if model.orders[state] == 2]
        places = [*range(count), *(count + i for i in second)]

        def outputs(phase: np.ndarray) -> np.ndarray:
            states = np.zeros((tau.size, 3 * count))
            states[:, places] = phase
            return model.kernels.evaluate("outputs", states, here, self.theta, tau, equations.frequency)[:, columns]

        step, offset = np.abs(values).max() or 1.0, outputs(np.zeros(len(places)))
        slopes = np.stack([outputs(unit) - offset for unit in step * np.eye(len(places))], axis=-1) / step
        inverse = np.linalg.pinv(slopes)
        wanted = len(places) if rates else count
        phases = np.einsum("nip,np->ni", inverse, values - offset)
        unique = np.allclose((inverse @ slopes)[:, :wanted], np.eye(len(places))[:wanted], atol=1e-6)
        missed = np.abs(outputs(phases) - values) > 1e-6 * np.abs(values).max(axis=0)
        if not unique or missed.any():
            what = "states and rates" if rates else "states"
            raise ValueError(
                f"coordinates: must determine the {what} of {model.name!r}, {list(model.states)}, by linear equations, "
                f"got {orbit.coordinates}. Make the section of outputs such as a state and its rate."
            )
        return phases


def _sign_mismatch(orbit: Orbit) -> str:
    """Return a message if the solution's multiplier has another sign than the measured one, else an empty text.

    The sign of a multiplier with modulus above 1 cannot change along a branch.
    """
    assert orbit.solution is not None
    measured, computed = orbit.eigenvalues[0], orbit.solution.multipliers[0]
    sd = np.sqrt(orbit.joint_covariance[orbit.points.size, orbit.points.size])
    both_real = max(abs(np.angle(value**2)) for value in (measured, computed)) < REAL
    sure = both_real and sd < SURE and min(abs(measured), abs(computed)) > 1.0
    if not sure or measured.real * computed.real > 0.0:
        return ""
    return f"the solution is another orbit: its multiplier is {computed.real:.4g}, the measured one {measured.real:.4g}"


@in_one_thread
def select_orbits(
    orbits: Orbits,
    parameters: Iterable[str],
    *,
    model: Model | None = None,
    largest_multiplier: float = 50.0,
    least_quality: float = 1e-3,
    least_gain: float = 0.01,
) -> Orbits:
    """Choose polished orbits as data for the estimation of some parameters.

    States of rest, orbits that disagree with their own returns, and very unstable orbits are left out: a return map
    with ``|μ|`` = 50 stretches 1 % of the attractor to half its size within one period; linear maps do not hold over
    such distances, and the error estimates become unreliable. The information of an orbit about the parameters is
    SᵀC⁻¹S, with the sensitivities S of its section points (and unstable eigenvalues) and their covariance C. The least
    informative orbit is removed repeatedly, as long as the standard deviation of no combination of the parameters rises
    by more than `least_gain` in total. Both of two symmetric partners may remain, because their noise is independent.

    Parameters
    ----------
    orbits : Orbits
        From `polish_orbits`.
    parameters : iterable of str
        Those to be estimated.
    model : Model, optional
        If given, unstable eigenvalues are included, as in ``orbit.experiment(multipliers=True)``.
    largest_multiplier, least_quality, least_gain : float
        Limits of the modulus of the largest multiplier of the model's orbit, of `Orbit.quality`, and of the relative
        rise of a standard deviation.

    Returns
    -------
    Orbits
        Those left out are added to `.rejected` with the reasons; partners are positions among the selected ones.

    Raises
    ------
    ValueError
        For an orbit that is not polished, an unknown parameter, or a limit that is not positive.

    Examples
    --------
    The pendulum at rest does not depend on the parameters:

    >>> polished = bp.polish_orbits(bp.models.pendulum, pendulum_orbits, pendulum_parameters, samples=200)
    >>> best = bp.select_orbits(polished, ["m", "l"])
    >>> 0 < len(best) < len(polished), "a state of rest" in [reason for _, reason in best.rejected]
    (True, True)
    """
    _checks.instance("orbits", orbits, Orbits)
    names = list(parameters)
    _checks.positive("largest_multiplier", largest_multiplier)
    _checks.finite_number("least_quality", least_quality)
    _checks.positive("least_gain", least_gain)
    reasons = [_unsuitable(orbit, largest_multiplier, least_quality) for orbit in orbits]
    rejected = [*orbits.rejected, *((orbit, why) for orbit, why in zip(orbits, reasons, strict=True) if why)]
    kept = [orbit for orbit, why in zip(orbits, reasons, strict=True) if not why]
    dropped = _uninformative([orbit_information(orbit, names, model) for orbit in kept], least_gain)
    for i, rise in dropped.items():
        rejected.append((kept[i], f"little information: without it, standard deviations rise by {rise:.2%} at most"))
    chosen = [orbit for i, orbit in enumerate(kept) if i not in dropped]
    position = {orbit.name: i for i, orbit in enumerate(chosen)}
    partners = [None if orbit.partner is None else position.get(orbits[orbit.partner].name) for orbit in chosen]
    return _selection(orbits, chosen, partners, rejected)


def _slopes(orbit: Orbit, solution: PeriodicSolution, parameter: str) -> np.ndarray:
    """Return the derivatives of the section points by a parameter, (period, d)."""
    columns = [solution.sensitivities[name][parameter][:: solution.samples] for name in orbit.coordinates]
    return np.stack(columns, axis=-1)


def _polished(orbit: Orbit) -> PeriodicSolution:
    if orbit.solution is None:
        raise ValueError(f"orbits: must be polished, got {orbit.name!r} without a solution. Use polish_orbits first.")
    return orbit.solution


def orbit_information(orbit: Orbit, parameters: list[str], model: Model | None = None) -> np.ndarray:
    """Return SᵀC⁻¹S (parameters, parameters), with the derivatives S by relative changes of the parameters."""
    solution = _polished(orbit)
    for name in parameters:
        _checks.one_of("parameters", name, solution.parameters)
    experiment = orbit.experiment(samples=solution.samples, multipliers=model is not None)
    by_name = multiplier_sensitivities(model, solution) if model is not None else {}
    count = experiment.measured_multipliers.size
    columns = []
    for name in parameters:
        column = _slopes(orbit, solution, name).ravel()
        if count:
            column = np.concatenate([column, (by_name[name] / solution.multipliers).real[:count]])
        columns.append(column * (solution.parameters[name] or 1.0))
    slopes = np.stack(columns, axis=-1)
    assert experiment.covariance is not None
    return slopes.T @ np.linalg.solve(experiment.covariance, slopes)


def _unsuitable(orbit: Orbit, largest_multiplier: float, least_quality: float) -> str:
    """Return why an orbit cannot be used as data; empty if it can."""
    modulus = float(np.abs(_polished(orbit).multipliers).max())
    if orbit.equilibrium:
        return "a state of rest"
    if orbit.quality < least_quality:
        return f"disagrees with its returns: quality {orbit.quality:.2g} < {least_quality:g}"
    if modulus > largest_multiplier:
        return f"too unstable: multiplier of modulus {modulus:.4g} > {largest_multiplier:g}"
    return ""


def _uninformative(information: list[np.ndarray], most: float) -> dict[int, float]:
    """Return the orbits to leave out, with the rise of standard deviations without them and all before them."""
    dropped: dict[int, float] = {}
    if not information:
        return dropped
    values, vectors = np.linalg.eigh(np.sum(information, axis=0))
    informed = values > LEAST_EIGENVALUE * values.max()
    whitening = vectors[:, informed] / np.sqrt(values[informed])
    parts = [whitening.T @ one @ whitening for one in information]
    remaining = np.eye(whitening.shape[1])
    while len(dropped) < len(parts) - 1:
        least = {i: np.linalg.eigvalsh(remaining - part)[0] for i, part in enumerate(parts) if i not in dropped}
        best = max(least, key=least.__getitem__)
        rise = float(1.0 / np.sqrt(least[best]) - 1.0) if least[best] > 0.0 else np.inf
        if rise > most:
            break
        dropped[best], remaining = rise, remaining - parts[best]
    return dropped
