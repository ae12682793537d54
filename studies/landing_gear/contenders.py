"""Time integration of one experiment of the landing gear until steady, at a given accuracy.

The compiled methods of `studies.landing_gear.integrators`, and SciPy's LSODA and Radau on the same compiled right-hand
side. For each experiment the largest steps and loosest tolerances are chosen with which the outputs of all draws agree
with the finest integration to the allowed fraction of their range.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from studies.benchmark.equations import table
from studies.gear import gear_at_rest
from studies.landing_gear.identification import DISPLACEMENT, SAMPLES
from studies.landing_gear.integrators import NAMES, Methods, methods

FIXED, CONTROLLED, LSODA, RADAU = "Runge-Kutta", "Dormand-Prince", "LSODA", "Radau"
COMPILED, SCIPY = (FIXED, CONTROLLED), (LSODA, RADAU)
STEPS = (16, 20, 25, 32, 40, 50, 80, 100, 160, 200, 400, 800, 1600, 3200, 6400, 12_800, 25_600)
RELATIVE = tuple(10.0**-k for k in range(3, 12))
# Of the gas temperature [K].
TOLERANCES = tuple(10.0**-k for k in range(10))
FINEST = 1e-11, 1e-9
# Points of a cycle between which inputs are interpolated, and what errors are measured by: [m], [m/s].
TABLE = 16_384
SCALE = (0.1, 0.1)

# From parameters and start to the states of a cycle (samples, size) and the number of cycles integrated, 0 for never.
Integrate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, int]]


@dataclass(frozen=True)
class Gear:
    """One experiment in the form of the integrators."""

    drive: str
    experiment: bp.Experiment
    parameters: np.ndarray  # (draws, parameters): In the order of `integrators.NAMES`
    estimate: np.ndarray  # (parameters,): The MAP estimate

    def still(self, parameters: np.ndarray) -> np.ndarray:
        """Return static equilibrium under the mean input, the gas as warm as the wall."""
        return gear_at_rest(self.experiment, dict(zip(NAMES, parameters, strict=True)))

    def outputs(self, parameters: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Return the outputs (SAMPLES, 2) that belong to states (points, size) over a cycle."""
        if len(path) != SAMPLES:
            path = np.fft.irfft(np.fft.rfft(path, axis=0) * (SAMPLES / len(path)), SAMPLES, axis=0)
        out = np.empty((SAMPLES, 2))
        self._methods.outputs(parameters, self._inputs, np.ascontiguousarray(path), out)
        return out

    @property
    def _methods(self) -> Methods:
        return methods(self.drive)

    def integrator(self, kind: str, fineness: float, tolerance: float) -> Integrate:
        """Return a compiled method with so many steps per cycle, or with this relative error of a step."""
        steps, frequency = int(fineness) if kind == FIXED else TABLE // 2, self.experiment.frequency
        inputs = self._table(2 * steps)

        def fixed(parameters: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
            path = np.empty((min(steps, SAMPLES), start.size))
            return path, self._methods.fixed(parameters, inputs, frequency, start.copy(), tolerance, path)

        def controlled(parameters: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
            path, scale = np.empty((SAMPLES, start.size)), self._scale(parameters)
            count = self._methods.controlled(
                parameters, inputs, frequency, start.copy(), scale, fineness, tolerance, path
            )
            return path, count

        return fixed if kind == FIXED else controlled

    def scipy(self, method: str, relative: float, cycles: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Return SciPy's integration of so many cycles: from parameters and start to the states of the last."""
        inputs, frequency = self._table(TABLE), self.experiment.frequency
        times = (cycles - 1 + np.arange(SAMPLES) / SAMPLES) / frequency

        def integrate(parameters: np.ndarray, start: np.ndarray) -> np.ndarray:
            solved = solve_ivp(  # type: ignore[call-overload]
                self._methods.rates_in_time,
                (0.0, cycles / frequency),
                start,
                method,
                times,
                rtol=relative,
                atol=relative * self._scale(parameters),
                args=(parameters, inputs, 1.0 / frequency),
            )
            return solved.y.T if solved.success else np.full((SAMPLES, start.size), np.nan)

        return integrate

    @cached_property
    def exact(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Steady state at the start of a cycle, and outputs of a cycle, of every draw, by the finest integration."""
        return [self._exact(parameters) for parameters in self.parameters]

    @property
    def steady(self) -> bool:
        """Whether the finest integration becomes steady at every draw."""
        integrate = self.integrator(CONTROLLED, *FINEST)
        return all(integrate(parameters, self.still(parameters))[1] for parameters in self.parameters)

    def _exact(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        path, cycles = self.integrator(CONTROLLED, *FINEST)(parameters, self.still(parameters))
        if not cycles:
            raise RuntimeError(f"{self.experiment.name}: the time integration does not become steady.")
        return path[0], self.outputs(parameters, path)

    @cached_property
    def _inputs(self) -> np.ndarray:
        return self._table(SAMPLES)

    def _table(self, points: int) -> np.ndarray:
        return table(self.experiment, [self.drive], points)

    def _scale(self, parameters: np.ndarray) -> np.ndarray:
        return np.array([-parameters[14]] if self.drive == DISPLACEMENT else [*SCALE, -parameters[14]])


@dataclass(frozen=True)
class Contender:
    """A method with the settings that an experiment needs."""

    integrate: Integrate
    fineness: float  # Steps a cycle, or relative error of a step
    tolerance: float  # Of the steady temperature [K]
    error: float  # The largest of any draw's outputs, of their range
    cycles: float  # The mean that it takes from static equilibrium


def error(outputs: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest error of outputs (samples, channels), of their range."""
    return float(np.max(np.abs(outputs - exact).max(axis=0) / np.ptp(exact, axis=0)))


def choose(gear: Gear, kind: str, allowed: float) -> Contender:
    """Return a compiled method with the cheapest settings that are no less accurate than allowed."""
    for fineness in STEPS if kind == FIXED else RELATIVE:
        if _judge(gear, gear.integrator(kind, fineness, TOLERANCES[-1]))[0] > allowed:
            continue
        for tolerance in TOLERANCES:
            integrate = gear.integrator(kind, fineness, tolerance)
            worst, cycles = _judge(gear, integrate)
            if worst <= allowed:
                return Contender(integrate, fineness, tolerance, worst, cycles)
    raise RuntimeError(f"{gear.experiment.name}: {kind} does not become as accurate as {allowed:.1e}.")


def _judge(gear: Gear, integrate: Integrate) -> tuple[float, float]:
    """Return the largest error of all draws, and how many cycles they take in the mean."""
    worst, count = 0.0, []
    for parameters, (_, exact) in zip(gear.parameters, gear.exact, strict=True):
        path, cycles = integrate(parameters, gear.still(parameters))
        worst = max(worst, error(gear.outputs(parameters, path), exact)) if cycles else np.inf
        if worst == np.inf:
            break
        count.append(cycles)
    return worst, float(np.mean(count)) if count else 0.0


def choose_scipy(gear: Gear, method: str, allowed: float) -> float | None:
    """Return the loosest relative tolerance with which a cycle from the first draw's steady state is right, or None."""
    parameters, (steady, exact) = gear.parameters[0], gear.exact[0]
    for relative in RELATIVE:
        path = gear.scipy(method, relative, 1)(parameters, steady)
        if error(gear.outputs(parameters, path), exact) <= allowed:
            return relative
    return None
