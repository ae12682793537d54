"""One orbit of a section polished with a model: solve, prime period, and whether it is still the measured orbit."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesperiodic import checks
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.identity import differences, is_still, section_points, times_repeated
from bayesperiodic.orbits.orbit import Orbit
from bayesperiodic.orbits.prime import once_round
from bayesperiodic.orbits.seeds import seeds
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, STATUSES
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.solution import describe
from bayesperiodic.periodic.solve import solve_forced

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
        checks.integer("samples", self.samples, 4)
        checks.positive("tolerance", self.tolerance)
        checks.same_names("parameters", self.parameters, self.model.parameters)
        for name, sd in self.parameter_sd.items():
            checks.one_of("parameter_sd", name, self.model.parameters)
            checks.positive(f"parameter_sd[{name!r}]", sd)
        checks.same_names("inputs", self.inputs, self.model.inputs)
        for name, values in self.inputs.items():
            checks.finite_vector(f"inputs[{name!r}]", values, self.samples, "samples")
        for orbit in self.orbits:
            for name in orbit.coordinates:
                checks.one_of("coordinates", name, self.model.outputs)
            if (orbit.coordinates, orbit.angles) != (self.orbits[0].coordinates, self.orbits[0].angles):
                raise ValueError(f"orbits: {orbit.name!r} is not allowed; all must be of one section.")

    @cached_property
    def theta(self) -> np.ndarray:
        """The parameters, (parameters,)."""
        values = [checks.finite_number(f"parameters[{n!r}]", self.parameters[n]) for n in self.model.parameters]
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
