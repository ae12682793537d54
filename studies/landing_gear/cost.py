"""Time of a log-posterior of the landing gear: the periodic solver against time integration until steady.

All fourteen experiments at draws of their joint posterior, interleaved in one run. The periodic solver is timed with
the whole log-posterior, by scheme; compiled methods, and SciPy's LSODA and Radau on the same compiled right-hand side,
with the integration alone. Inputs are the estimated ones. For each experiment the largest steps and loosest tolerances
are chosen with which the outputs of all draws are as accurate as those of the periodic solver, compared with the finest
integration.

The compiled methods are the classical Runge-Kutta method with fixed steps, and the pair of orders 5 and 4 of Dormand
and Prince with error control (Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, 1993, table 5.2).
They stop when the gas is within `tolerance` of its steady temperature, estimated from two successive changes over a
cycle, which decrease geometrically. States are the gas temperature T [K], preceded by compression q [m] and velocity
[m/s] if the force is given.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.integrate import RK45, solve_ivp

import bayesperiodic as bp
from studies import common
from studies.benchmark.kernels import MAX_CYCLES, NUMBA, FirstOrder, compiled, integrators, signals
from studies.benchmark.kernels import table as input_table
from studies.gear import GEAR, gear_at_rest
from studies.landing_gear.identification import CONDUCTION, DISPLACEMENT, FORCE, SAMPLES, Identified, problem
from studies.timing import Action, interleaved, spread, timed

DRAWS, QUICK_DRAWS = 10, 2
REPEATS, QUICK_REPEATS = 9, 1
WALKERS = 64
SCHEMES = {DISPLACEMENT: ("central2", "central4"), FORCE: ("central4",)}
OUTPUTS = {DISPLACEMENT: ("force", "pressure"), FORCE: ("displacement", "pressure")}
STATIC, ESTIMATE = "from static equilibrium", "from the steady state at the estimate"
WARM, BATCHED, COLD = "warm", "batched", "cold"
# Of SciPy's integrators.
TIMED_CYCLES = 3
FIXED, CONTROLLED, LSODA, RADAU = "Runge-Kutta", "Dormand-Prince", "LSODA", "Radau"
COMPILED, SCIPY = (FIXED, CONTROLLED), (LSODA, RADAU)
STEPS = (16, 20, 25, 32, 40, 50, 80, 100, 160, 200, 400, 800, 1600, 3200, 6400, 12_800, 25_600)
RELATIVE = tuple(10.0**-k for k in range(3, 12))
# Of the gas temperature [K].
TOLERANCES = tuple(10.0**-k for k in range(10))
FINEST = 1e-11, 1e-9
# Most cycles of the finest integration: less than `MAX_CYCLES`, as other methods take up to a few per cent more.
MOST_CYCLES = 4500
# Points of a cycle between which inputs are interpolated, and scales of the errors: [m], [m/s].
TABLE = 16_384
SCALE = (0.1, 0.1)

# The order of the parameters.
NAMES = tuple(GEAR)
# Nodes, stage weights and the difference of the two results of Dormand and Prince.
NODES, DIFFERENCE = np.append(RK45.C, 1.0), RK45.E
STAGES = np.vstack([np.pad(RK45.A, ((0, 0), (0, 1))), RK45.B])


@compiled
def settled(before, now, change, tolerance):
    """Return whether the temperature is steady, and its change over the last cycle."""
    new = now - before
    if new == 0.0:
        return True, new
    factor = new / change if change != 0.0 else 1.0
    # Not before the changes fall like those of a single exponential.
    near = 0.0 < factor < 1.0 and abs(new) * factor / (1.0 - factor) < tolerance
    return near or (abs(factor) < 0.1 and abs(new) < tolerance), new


def _fixed_steps(rates, size):
    @compiled
    def integrate(g, inputs, frequency, y, tolerance, path):
        """Integrate until steady and fill the states (samples, size) of the last cycle.

        Return the number of cycles, 0 if it never becomes steady. `inputs` holds a cycle at half steps (2·steps,
        signals); `y` is the start, and the end. The steps are a multiple of the samples.
        """
        steps, samples = inputs.shape[0] // 2, path.shape[0]
        h, each, change = 1.0 / (frequency * steps), steps // samples, 0.0
        k1, k2, k3, k4, trial = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
        for cycle in range(MAX_CYCLES):
            before = y[size - 1]
            for k in range(steps):
                here, middle = inputs[2 * k], inputs[2 * k + 1]
                after = inputs[2 * k + 2] if k + 1 < steps else inputs[0]
                if k % each == 0:
                    path[k // each] = y
                rates(y, here, g, k1)
                for i in range(size):
                    trial[i] = y[i] + 0.5 * h * k1[i]
                rates(trial, middle, g, k2)
                for i in range(size):
                    trial[i] = y[i] + 0.5 * h * k2[i]
                rates(trial, middle, g, k3)
                for i in range(size):
                    trial[i] = y[i] + h * k3[i]
                rates(trial, after, g, k4)
                for i in range(size):
                    y[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
            done, change = settled(before, y[size - 1], change, tolerance)
            if done:
                return cycle + 1
            if not abs(y[size - 1]) < 1e6:
                return 0
        return 0

    return integrate


def _controlled_steps(rates, size):
    @compiled
    def integrate(g, inputs, frequency, y, scale, relative, tolerance, path):
        """Integrate until steady, then through one more cycle for the states (samples, size).

        Return the number of cycles, 0 if it never becomes steady. `inputs` holds a cycle (points, signals), `scale`
        (size,) the scales of the errors.
        """
        rate, trial, u = np.empty((7, size)), np.empty(size), np.empty(inputs.shape[1])
        samples, change, step, done = path.shape[0], 0.0, 1e-3, False
        for cycle in range(MAX_CYCLES):
            before = y[size - 1]
            last = done
            for k in range(samples if last else 1):
                now, end = k / samples if last else 0.0, (k + 1) / samples if last else 1.0
                signals(inputs, now, u)
                if last:
                    path[k] = y
                rates(y, u, g, rate[0])
                while now < end:
                    used = min(step, end - now)
                    for stage in range(1, 7):
                        for i in range(size):
                            total = 0.0
                            for j in range(stage):
                                total += STAGES[stage, j] * rate[j, i]
                            trial[i] = y[i] + used / frequency * total
                        signals(inputs, now + NODES[stage] * used, u)
                        rates(trial, u, g, rate[stage])
                    error = 0.0
                    for i in range(size):
                        total = 0.0
                        for j in range(7):
                            total += DIFFERENCE[j] * rate[j, i]
                        error = max(error, abs(used / frequency * total) / (relative * scale[i]))
                    if error <= 1.0:
                        now = end if used == end - now else now + used
                        for i in range(size):
                            y[i], rate[0, i] = trial[i], rate[6, i]
                    elif used < 1e-12:
                        return 0
                    growth = min(5.0, max(0.2, 0.9 * error ** (-0.2))) if error > 0.0 else 5.0
                    step = max(step, used * growth) if error <= 1.0 and used < step else used * growth
            if last:
                return cycle + 1
            done, change = settled(before, y[size - 1], change, tolerance)
            if not abs(y[size - 1]) < 1e6:
                return 0
        return 0

    return integrate


@cache
def methods(drive: str) -> SimpleNamespace:
    """Return the compiled functions fixed, controlled, outputs and rates_in_time of one direction."""
    model = bp.models.landing_gear(drive)
    first, generic = FirstOrder(model, ()), integrators(model, NAMES[:1])
    rates = compiled(first.function(NUMBA, first.rates))
    return SimpleNamespace(
        fixed=_fixed_steps(rates, first.size),
        controlled=_controlled_steps(rates, first.size),
        outputs=generic.outputs,
        rates_in_time=generic.rates_in_time,
    )


# From parameters and start to the states of a cycle (samples, size) and the number of cycles integrated, 0 for never.
Integrate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, int]]


@dataclass(frozen=True)
class Gear:
    """One experiment in the form of the integrators."""

    drive: str
    experiment: bp.Experiment
    parameters: np.ndarray  # (draws, parameters): In the order of `NAMES`
    estimate: np.ndarray  # (parameters,): The MAP estimate

    def still(self, parameters: np.ndarray) -> np.ndarray:
        """Return static equilibrium under the mean input, the gas as warm as the wall."""
        return gear_at_rest(self.experiment, dict(zip(NAMES, parameters, strict=True)))

    def outputs(self, parameters: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Return the outputs (SAMPLES, 2) that belong to states (points, size) over a cycle."""
        if len(path) != SAMPLES:
            path = np.fft.irfft(np.fft.rfft(path, axis=0) * (SAMPLES / len(path)), SAMPLES, axis=0)
        out = np.empty((SAMPLES, 2))
        methods(self.drive).outputs(parameters, self._inputs, np.ascontiguousarray(path), out)
        return out

    def integrator(self, kind: str, fineness: float, tolerance: float) -> Integrate:
        """Return a compiled method; `fineness` is the number of steps per cycle, or the relative error of a step."""
        steps, frequency = int(fineness) if kind == FIXED else TABLE // 2, self.experiment.frequency
        inputs, points = self._table(2 * steps), min(steps, SAMPLES)

        def integrate(parameters: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
            path, given = np.empty((points, start.size)), (parameters, inputs, frequency, start.copy())
            if kind == FIXED:
                return path, methods(self.drive).fixed(*given, tolerance, path)
            return path, methods(self.drive).controlled(*given, self._scale(parameters), fineness, tolerance, path)

        return integrate

    def scipy(self, method: str, relative: float, cycles: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Return SciPy's integration over some cycles: from parameters and start to the states of the last one."""
        inputs, frequency = self._table(TABLE), self.experiment.frequency
        times = (cycles - 1 + np.arange(SAMPLES) / SAMPLES) / frequency

        def integrate(parameters: np.ndarray, start: np.ndarray) -> np.ndarray:
            solved = solve_ivp(  # type: ignore[call-overload]
                methods(self.drive).rates_in_time, (0.0, cycles / frequency), start, method, times, rtol=relative,
                atol=relative * self._scale(parameters), args=(parameters, inputs, 1.0 / frequency),
            )  # fmt: skip
            return solved.y.T if solved.success else np.full((SAMPLES, start.size), np.nan)

        return integrate

    @cached_property
    def exact(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Steady state at the start of a cycle, and outputs of a cycle, of every draw, by the finest integration."""
        integrate, found = self.integrator(CONTROLLED, *FINEST), []
        for parameters in self.parameters:
            path, cycles = integrate(parameters, self.still(parameters))
            if not cycles:
                raise RuntimeError(f"{self.experiment.name}: the time integration does not become steady.")
            found.append((path[0], self.outputs(parameters, path)))
        return found

    @property
    def steady(self) -> bool:
        """Whether the finest integration becomes steady in `MOST_CYCLES` at every draw."""
        integrate = self.integrator(CONTROLLED, *FINEST)
        return all(0 < integrate(one, self.still(one))[1] <= MOST_CYCLES for one in self.parameters)

    @cached_property
    def _inputs(self) -> np.ndarray:
        return self._table(SAMPLES)

    def _table(self, points: int) -> np.ndarray:
        return input_table(self.experiment, [self.drive], points)

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


def measure(drive: str, identified: Identified, seed: int, *, quick: bool) -> dict[str, Any]:
    """Return times and their ratios for one direction, from the joint posterior of all experiments."""
    stated = with_errors(identified)
    experiments = [replace(e, inputs=stated.true_inputs(e)) for e in stated.experiments]

    def steady(theta: np.ndarray) -> bool:
        return all(_gear(drive, experiment, identified, theta).steady for experiment in experiments)

    theta, left_out = draws(identified, QUICK_DRAWS if quick else DRAWS, seed, steady)
    gears = [_gear(drive, experiment, identified, theta) for experiment in experiments]
    return {
        "draws": len(theta),
        "left_out": left_out,
        "cores": os.cpu_count(),
        "samples": SAMPLES,
        "schemes": {scheme: _by_scheme(scheme, identified, theta, gears, quick) for scheme in SCHEMES[drive]},
    }


def with_errors(identified: Identified) -> bp.Problem:
    """Return the problem whose log-posterior was sampled, with the estimated errors of its inputs."""
    return identified.problem.with_input_errors(identified.fit.input_errors)


def draws(
    identified: Identified, count: int, seed: int, steady: Callable[[np.ndarray], bool]
) -> tuple[np.ndarray, dict[str, int]]:
    """Return draws (count, names) from which time integration becomes steady, and how many were left out.

    At theta16 ≤ 0 the gas has no steady state that an integration could reach. Of those with every theta16 positive
    some need more cycles than `MOST_CYCLES`. `steady` decides it for a draw (1, names).
    """
    names = identified.problem.names
    every = np.stack([identified.posterior.draws(name) for name in names], axis=-1)
    able = (every[:, [name.startswith(CONDUCTION) for name in names]] > 0.0).all(axis=1)
    found: list[np.ndarray] = []
    tried = 0
    for row in np.random.default_rng(seed).permutation(np.flatnonzero(able)):
        tried += 1
        if steady(every[row : row + 1]):
            found.append(every[row])
        if len(found) == count:
            break
    left_out = {"not_positive": int((~able).sum()), "draws": able.size, "too_slow": tried - len(found), "tried": tried}
    return np.array(found), left_out


def _gear(drive: str, experiment: bp.Experiment, identified: Identified, theta: np.ndarray) -> Gear:
    stated = identified.problem
    order = [list(stated.model.parameters).index(name) for name in NAMES]
    estimate = stated.vector(identified.fit.theta)
    values = np.ascontiguousarray(stated.parameters(np.vstack([theta, estimate]), experiment.name)[:, order])
    return Gear(drive, experiment, values[:-1], values[-1])


def _by_scheme(
    scheme: str, identified: Identified, theta: np.ndarray, gears: Sequence[Gear], quick: bool
) -> dict[str, Any]:
    """Return the times of the other methods at the accuracy of one scheme of the periodic solver."""
    stated, fit = with_errors(identified), identified.fit
    if scheme != stated.scheme:
        stated = problem(stated.experiments, gears[0].drive, scheme=scheme)
    warm = stated.anchored(fit.theta)
    own = _own_errors(warm, theta, gears)
    chosen = [{k: choose(gear, k, allowed) for k in COMPILED} for gear, allowed in zip(gears, own, strict=True)]
    noise = np.array(list(fit.noise.values()))
    times = interleaved(_actions(warm, noise, theta, gears, chosen), QUICK_REPEATS if quick else REPEATS)
    scipy = {method: _scipy(gears, own, chosen, method) for method in SCIPY}
    settings = "fineness", "tolerance", "error", "cycles"
    return {
        "milliseconds": {name: spread(1e3 * values) for name, values in times.items()},
        "scipy_milliseconds": {method: seconds and 1e3 * seconds for method, seconds in scipy.items()},
        "ratios": _ratios(times, scipy),
        "experiments": {
            gear.experiment.name: {"error": allowed}
            | {kind: {name: getattr(one, name) for name in settings} for kind, one in by_kind.items()}
            for gear, allowed, by_kind in zip(gears, own, chosen, strict=True)
        },
    }


def _own_errors(warm: bp.Problem, theta: np.ndarray, gears: Sequence[Gear]) -> list[float]:
    outputs, converged = warm.outputs(theta)
    if not converged.all():
        raise RuntimeError("A periodic solve at a draw of the posterior did not converge.")
    found = []
    for gear in gears:
        own = np.stack([outputs[gear.experiment.name][name] for name in OUTPUTS[gear.drive]], axis=-1)
        found.append(max(error(one, exact) for one, (_, exact) in zip(own, gear.exact, strict=True)))
    return found


def _actions(
    warm: bp.Problem, noise: np.ndarray, theta: np.ndarray, gears: Sequence[Gear],
    chosen: Sequence[Mapping[str, Contender]],
) -> dict[str, Action]:  # fmt: skip
    many = np.resize(theta, (WALKERS, theta.shape[1]))

    def cold(gear: Gear) -> bp.PeriodicSolution:
        values, e = dict(zip(NAMES, gear.parameters[0], strict=True)), gear.experiment
        model = bp.models.landing_gear(gear.drive)
        return bp.solve_periodic(model, values, e.inputs, frequency=e.frequency, samples=SAMPLES, scheme=warm.scheme)

    def steady(gear: Gear, contender: Contender) -> np.ndarray:
        # Static equilibrium if theta16 ≤ 0 at the estimate, without a steady state.
        path, cycles = contender.integrate(gear.estimate, gear.still(gear.estimate))
        return path[0] if cycles else gear.still(gear.estimate)

    actions: dict[str, Action] = {
        WARM: Action(lambda: [warm.log_posterior(one, noise) for one in theta], len(theta)),
        BATCHED: Action(lambda: warm.log_posterior(many, noise), WALKERS),
        COLD: Action(lambda: [cold(gear) for gear in gears]),
    }
    for kind in COMPILED:
        contenders = [by_kind[kind] for by_kind in chosen]
        known = [steady(*one) for one in zip(gears, contenders, strict=True)]
        actions[f"{kind} {STATIC}"] = Action(partial(_integrate, gears, contenders, None), len(theta))
        actions[f"{kind} {ESTIMATE}"] = Action(partial(_integrate, gears, contenders, known), len(theta))
    return actions


def _integrate(gears: Sequence[Gear], contenders: Sequence[Contender], starts: Sequence[np.ndarray] | None) -> None:
    for i, (gear, contender) in enumerate(zip(gears, contenders, strict=True)):
        for parameters in gear.parameters:
            contender.integrate(parameters, gear.still(parameters) if starts is None else starts[i])


def _scipy(
    gears: Sequence[Gear], own: Sequence[float], chosen: Sequence[Mapping[str, Contender]], method: str
) -> float | None:
    """Return the seconds of one integration of all until steady, None where no tolerance is accurate enough.

    A few cycles are timed; all the others cost the same.
    """
    relative = [choose_scipy(gear, method, allowed) for gear, allowed in zip(gears, own, strict=True)]
    total = 0.0
    for gear, tolerance, by_kind in zip(gears, relative, chosen, strict=True):
        if tolerance is None:
            return None
        parameters = gear.parameters[0]
        run = partial(gear.scipy(method, tolerance, TIMED_CYCLES), parameters, gear.still(parameters))
        seconds = min(timed(run)[1] for _ in range(2))
        total += seconds * min(contender.cycles for contender in by_kind.values()) / TIMED_CYCLES
    return total


def _ratios(times: Mapping[str, np.ndarray], scipy: Mapping[str, float | None]) -> dict[str, Any]:
    """Return the time ratios of integration to the periodic solver, by the faster compiled method in each repeat."""
    quickest = {start: np.min([times[f"{kind} {start}"] for kind in COMPILED], axis=0) for start in (STATIC, ESTIMATE)}
    found = {f"compiled {start} / {WARM}": values / times[WARM] for start, values in quickest.items()}
    found |= {f"compiled {STATIC} / {own}": quickest[STATIC] / times[own] for own in (BATCHED, COLD)}
    found |= {f"{method} {STATIC} / {WARM}": seconds / times[WARM] for method, seconds in scipy.items() if seconds}
    return {name: spread(values) for name, values in found.items()}


def table(drive: str, found: Mapping[str, Any]) -> str:
    """Return the times to print."""
    left_out = found["left_out"]
    lines = [
        f"  {drive} given: {left_out['not_positive']} of {left_out['draws']} draws excluded without a steady state, "
        f"{left_out['too_slow']} of {left_out['tried']} others, not steady after {MOST_CYCLES} cycles"
    ]
    for scheme, one in found["schemes"].items():
        worst = max(entry["error"] for entry in one["experiments"].values())
        title = (
            f"{scheme}, error at most {worst:.0e} of the range: {one['milliseconds'][WARM]['median']:.2f} ms a "
            "log-posterior of all experiments, and ratios of times"
        )
        inaccurate = [f"{m}: not as accurate at any tolerance" for m, ms in one["scipy_milliseconds"].items() if not ms]
        lines += [common.shown(title, one["ratios"]), *inaccurate]
    return "\n".join(lines)
