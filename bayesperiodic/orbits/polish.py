"""`polish_orbits`: orbits of a section become periodic solutions of a model, or are rejected with a reason."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.orbit import Orbit, Orbits, seeds
from bayesperiodic.orbits.section import wrapped
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, STATUSES
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.solution import describe
from bayesperiodic.periodic.solve import solve_forced

STILL = 1e-6


def section_points(outputs: np.ndarray, samples: int, angles: np.ndarray) -> np.ndarray:
    """Return outputs (points, coordinates) at tau = 0, 1, …, angles in (−π, π]."""
    points = np.array(outputs[::samples])
    points[:, angles] = wrapped(points[:, angles])
    return points


def differences(points: np.ndarray, others: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return points − others, (…, coordinates), angles by the shorter way."""
    result = points - others
    result[..., angles] = wrapped(result[..., angles])
    return result


def nearest_shift(points: np.ndarray, others: np.ndarray, angles: np.ndarray, scales: np.ndarray) -> tuple[int, float]:
    """Return the cyclic shift of others (period, coordinates) that is nearest to points, and their largest distance.

    Distances are in units of `scales` (coordinates,).
    """
    distances = [
        float(np.max(np.abs(differences(points, np.roll(others, -shift, axis=0), angles)) / scales))
        for shift in range(len(points))
    ]
    best = int(np.argmin(distances))
    return best, distances[best]


def is_still(outputs: np.ndarray, scales: np.ndarray) -> bool:
    """Return whether outputs (points, coordinates) move by no more than a millionth of `scales` (coordinates,)."""
    return bool(np.all(np.ptp(outputs, axis=0) <= STILL * scales))


def times_repeated(equations: PeriodicEquations, z: np.ndarray) -> int:
    """Return how many times an orbit repeats itself within its forcing periods."""
    return int(equations.kernels.repetitions(z, equations.grid.periods))


def once_round(orbit: Orbit, times: int, angles: np.ndarray) -> Orbit:
    """Return an orbit that goes `times` round within its period as one of its prime period.

    Points are averaged, log|eigenvalue| is divided by `times`, and the covariance follows. An even number of times
    leaves the signs of the eigenvalues open; the moduli are given.

    Parameters
    ----------
    orbit : Orbit
    times : int
        A divisor of its period.
    angles : bool array (coordinates,)
    """
    period, coordinates = orbit.period // times, orbit.points.shape[1]
    rounds = orbit.points.reshape(times, period, coordinates)
    mean = rounds[0] + differences(rounds, rounds[0], angles).mean(axis=0)
    size = orbit.points.size
    average = np.zeros((mean.size + 2, size + 2))
    average[: mean.size, :size] = np.tile(np.eye(mean.size), times) / times
    average[mean.size :, size:] = np.eye(2) / times
    moduli = np.abs(orbit.eigenvalues) ** (1.0 / times)
    kept = times % 2 and not np.iscomplexobj(orbit.eigenvalues)
    cycle = orbit.cycle and {name: values[: len(values) // times] for name, values in orbit.cycle.items()}
    return replace(
        orbit,
        name=f"{orbit.name}, once round",
        period=period,
        winding=None if orbit.winding is None else orbit.winding // times,
        points=differences(mean, np.zeros(coordinates), angles),
        joint_covariance=_sandwich(average, orbit.joint_covariance),
        eigenvalues=np.sign(orbit.eigenvalues) * moduli if kept else moduli,
        eigenvalue_bias=orbit.eigenvalue_bias / times,
        partner=None,
        cycle=cycle,
    )


def _sandwich(matrix: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return M C Mᵀ, NaN only where an unknown entry has a weight."""
    known = np.where(np.isnan(covariance), 0.0, covariance)
    unknown = np.abs(matrix) @ np.isnan(covariance) @ np.abs(matrix.T) > 0
    return np.where(unknown, np.nan, matrix @ known @ matrix.T)


MOST_ERRORS = 5.0
SURE, REAL = 0.3, 1e-6


@dataclass(frozen=True)
class Polisher:
    """A model at certain parameters, and the section whose orbits it polishes; see `polish_orbits`."""

    model: Model
    orbits: tuple[Orbit, ...]
    parameters: Mapping[str, float]
    inputs: Mapping[str, np.ndarray]
    parameter_sd: Mapping[str, float]
    samples: int
    scheme: str | Scheme
    tolerance: float

    def __post_init__(self) -> None:
        if self.model.autonomous:
            raise ValueError(
                f"model: {self.model.name!r} is not allowed; it is autonomous, and a section needs forcing periods."
            )
        _checks.integer("samples", self.samples, 4)
        _checks.positive("tolerance", self.tolerance)
        _checks.same_names("parameters", self.parameters, self.model.parameters)
        for name, sd in self.parameter_sd.items():
            _checks.one_of("parameter_sd", name, self.model.parameters)
            _checks.positive(f"parameter_sd[{name!r}]", sd)
        _checks.same_names("inputs", self.inputs, self.model.inputs)
        for name, values in self.inputs.items():
            _checks.finite_vector(f"inputs[{name!r}]", values, self.samples, "samples")
        for orbit in self.orbits:
            for name in orbit.coordinates:
                _checks.one_of("coordinates", name, self.model.outputs)
            if (orbit.coordinates, orbit.angles) != (self.orbits[0].coordinates, self.orbits[0].angles):
                raise ValueError(f"orbits: {orbit.name!r} is not allowed; all must be of one section.")

    @cached_property
    def theta(self) -> np.ndarray:
        """The parameters, (parameters,)."""
        values = [_checks.finite_number(f"parameters[{n!r}]", self.parameters[n]) for n in self.model.parameters]
        return np.array(values)

    @cached_property
    def angles(self) -> np.ndarray:
        """Which coordinates are angles, (coordinates,)."""
        return np.array([name in self.orbits[0].angles for name in self.orbits[0].coordinates])

    @cached_property
    def scales(self) -> np.ndarray:
        """The attractor's size, (coordinates,): a turn for angles, the range of what was measured for others."""
        measured = [orbit.points for orbit in self.orbits]
        for orbit in self.orbits:
            if orbit.cycle is not None:
                measured.append(np.stack([orbit.cycle[name] for name in orbit.coordinates], axis=-1))
        spread = np.ptp(np.concatenate(measured), axis=0)
        spread[spread == 0.0] = 1.0
        return np.where(self.angles, 2 * np.pi, spread)

    def polish(self, orbit: Orbit) -> tuple[Orbit, str]:
        """Return the orbit with its solution and no reason, or as it was with the reason why it is rejected."""
        reasons = []
        for equations, z in seeds(orbit, lambda winding: self._equations(orbit, winding), self.theta):
            found, reason = self._from_seed(orbit, equations, z)
            if not reason:
                return found, ""
            reasons.append(reason)
        return orbit, reasons[0] if reasons else "the model's states grow beyond all bounds from its section points"

    def points(self, orbit: Orbit) -> np.ndarray:
        """Return the section points of a polished orbit's solution, (period, coordinates)."""
        assert orbit.solution is not None
        outputs = np.stack([orbit.solution.outputs[name] for name in orbit.coordinates], axis=-1)
        return section_points(outputs, self.samples, self.angles)

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

    def _from_seed(self, orbit: Orbit, equations: PeriodicEquations, z: np.ndarray) -> tuple[Orbit, str]:
        turning = z + equations.drift * equations.grid.tau[:, None]
        solved, found_by = solve_forced(equations, self.theta, dict(zip(self.model.states, turning.T, strict=True)))
        if solved.code not in (CONVERGED, OTHER_ORBIT):
            return orbit, f"the periodic solve ended with {STATUSES[solved.code]!r}"
        still = self._is_still(orbit, equations, solved.z)
        times = orbit.period if still else times_repeated(equations, solved.z)
        winding = sum(equations.winding.values()) // times
        if times > 1:
            orbit = once_round(orbit, times, self.angles)
            equations = self._equations(orbit, winding)
            solved = equations.solve(self.theta, solved.z[: equations.grid.points])
        solution = describe(equations, self.theta, solved._replace(code=CONVERGED), found_by)
        if not solution.converged:
            return orbit, f"the periodic solve ended with {solution.status!r}"
        if times % 2 == 0:
            orbit = replace(orbit, eigenvalues=np.copysign(np.abs(orbit.eigenvalues), solution.multipliers.real))
        orbit = replace(orbit, winding=winding, solution=solution, equilibrium=still)
        return orbit, self._elsewhere(orbit)

    def _is_still(self, orbit: Orbit, equations: PeriodicEquations, z: np.ndarray) -> bool:
        columns = [self.model.outputs.index(name) for name in orbit.coordinates]
        return not equations.drift.any() and is_still(equations.outputs(z, self.theta)[:, columns], self.scales)

    def _elsewhere(self, orbit: Orbit) -> str:
        """Return what tells a solution from the measured orbit; nothing where they agree."""
        solution, own = orbit.solution, self.points(orbit)
        assert solution is not None
        variance = np.diag(orbit.covariance).reshape(own.shape) + (self.tolerance * self.scales) ** 2
        for name, sd in self.parameter_sd.items():
            slopes = [solution.sensitivities[c][name][:: self.samples] for c in orbit.coordinates]
            variance = variance + (sd * np.stack(slopes, axis=-1)) ** 2
        off = np.abs(differences(own, orbit.points, self.angles)) / np.sqrt(variance)
        at, coordinate = np.unravel_index(int(np.argmax(off)), off.shape)
        if off.max() <= MOST_ERRORS:
            return self._flipped(orbit)
        kind = "a state of rest" if orbit.equilibrium else f"another orbit of period {orbit.period}"
        return (
            f"the solve landed on {kind}: {orbit.coordinates[coordinate]!r} at point {at} is {off.max():.3g} standard "
            "errors from the measured one"
        )

    def _flipped(self, orbit: Orbit) -> str:
        """Return that the solution's multiplier has another sign than the measured one; nothing where it has not.

        The sign of a multiplier above 1 cannot change while an orbit is followed in the parameters.
        """
        assert orbit.solution is not None
        measured, own = orbit.eigenvalues[0], orbit.solution.multipliers[0]
        sd = np.sqrt(orbit.joint_covariance[orbit.points.size, orbit.points.size])
        both_real = max(abs(np.angle(value**2)) for value in (measured, own)) < REAL
        sure = both_real and sd < SURE and min(abs(measured), abs(own)) > 1.0
        if not sure or measured.real * own.real > 0.0:
            return ""
        return f"the solve landed on another orbit, of multiplier {own.real:.4g} where {measured.real:.4g} was measured"


SAME = 1e-5


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
    """Solve a model for every orbit of a section, and keep those that are still the measured ones.

    Newton's method starts from the whole measured cycle with its winding number; from section points alone, from the
    model integrated over one forcing period from each of them, for the winding numbers that this leaves open. A
    solution that repeats itself is brought to its prime period, and the measured points with it. It is accepted if
    every section point lies within five standard errors of the measured one: the covariance of the points, the floor
    `tolerance` and the doubt about the parameters taken together, and if its unstable multiplier has the sign of the
    measured eigenvalue, where that is known to 30 %. Of several on one orbit (cyclic shifts included) the
    one with the most returns is kept. An orbit and its mirror image under the change of all signs are two orbits, whose
    noise is independent; they know each other as partners.

    Parameters
    ----------
    model : Model
        A forced one, whose states (and rates, where there is no measured cycle) follow from the section's coordinates.
    orbits : Orbits, or sequence of Orbit
        From `find_orbits`; what was rejected before stays rejected.
    parameters : mapping of str to float
        A value for every parameter.
    inputs : mapping of str to array (samples,), optional
        Every input over one forcing period.
    parameter_sd : mapping of str to float, optional
        Standard deviations of parameters that are but a rough guess: section points may be off by as much more as these
        would move them, to first order.
    samples : int
        Grid points per forcing period.
    scheme : str or Scheme
        See `solve_periodic`.
    tolerance : float
        Standard error that every measured coordinate may have beyond its covariance, as a fraction of the range of all
        that was measured, of a turn for an angle.

    Returns
    -------
    Orbits
        The accepted ones with `.solution`, `.winding` and `.partner`, states of rest marked `.equilibrium`; in
        `.rejected` all others with the reason.

    Raises
    ------
    ValueError
        For an autonomous model, unknown names, coordinates that do not tell the model's states, and arguments that
        `solve_periodic` refuses.

    Examples
    --------
    `pendulum_orbits`: the orbits of period 1 in 2,000 forcing periods of the pendulum in `PoincareSection`'s example.
    Newton's method on the return map of the integrated model gives the multiplier −1.7059 for the orbit with winding
    number 1:

    >>> import bayesperiodic as bp
    >>> polished = bp.polish_orbits(bp.models.pendulum, pendulum_orbits, pendulum_parameters, samples=200)
    >>> [turning] = [orbit for orbit in polished if orbit.winding == 1 and orbit.eigenvalues[0].real < 0]
    >>> print(f"{turning.solution.multipliers[0].real:.3f}")
    -1.706
    """
    given = orbits if isinstance(orbits, Orbits) else Orbits(tuple(orbits))
    polisher = Polisher(model, given.orbits, parameters, inputs or {}, parameter_sd or {}, samples, scheme, tolerance)
    rejected: list[tuple[Orbit, str]] = []
    polished: list[Orbit] = []
    for orbit in given:
        found, reason = polisher.polish(orbit)
        if reason:
            rejected.append((orbit, reason))
        else:
            polished.append(found)
    accepted, doubles = _without_doubles(polished, polisher)
    return replace(given, orbits=_with_partners(accepted, polisher), rejected=(*given.rejected, *rejected, *doubles))


def _without_doubles(orbits: list[Orbit], polisher: Polisher) -> tuple[list[Orbit], list[tuple[Orbit, str]]]:
    """Return each orbit once, as the candidate with the most returns, and the other candidates with the reason."""
    kept: list[int] = []
    doubles: list[tuple[Orbit, str]] = []
    for i in sorted(range(len(orbits)), key=lambda i: -orbits[i].returns):
        for k in kept:
            shift = _shift(orbits[i], orbits[k], polisher)
            if shift is not None:
                how = f", shifted by {shift} forcing periods" if shift else ""
                doubles.append((orbits[i], f"the same orbit as {orbits[k].name!r}{how}"))
                break
        else:
            kept.append(i)
    return [orbits[i] for i in sorted(kept)], doubles


def _shift(one: Orbit, other: Orbit, polisher: Polisher, sign: int = 1) -> int | None:
    """Return the cyclic shift under which two polished orbits, all signs of one changed, are the same; None if none."""
    if one.period != other.period or one.winding is None or one.winding * sign != other.winding:
        return None
    shift, distance = nearest_shift(
        sign * polisher.points(one), polisher.points(other), polisher.angles, polisher.scales
    )
    return shift if distance <= SAME else None


def _with_partners(orbits: list[Orbit], polisher: Polisher) -> tuple[Orbit, ...]:
    found = []
    for one in orbits:
        partner = next((j for j, other in enumerate(orbits) if _shift(one, other, polisher, -1) is not None), None)
        found.append(replace(one, partner=partner))
    return tuple(found)
