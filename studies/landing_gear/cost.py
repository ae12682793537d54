"""Time of a log-posterior of the landing gear: the periodic solver against time integration until steady.

All fourteen experiments at draws of their joint posterior, interleaved in one run. The periodic solver is timed with
the whole log-posterior, the others with the integration alone, at the accuracy of the periodic solver or better. This
accuracy depends on the scheme: each direction is measured with the study's scheme, the smoother one also with the
finer scheme.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.benchmark.kernels import MAX_CYCLES
from studies.landing_gear.contenders import (
    COMPILED,
    SCIPY,
    Contender,
    Gear,
    choose,
    choose_scipy,
    error,
)
from studies.landing_gear.identification import DISPLACEMENT, FORCE, SAMPLES, Identified, problem
from studies.landing_gear.integrators import NAMES
from studies.landing_gear.verdicts import CONDUCTION
from studies.timing import Action, interleaved, spread

DRAWS, QUICK_DRAWS = 10, 2
REPEATS, QUICK_REPEATS = 9, 1
WALKERS = 64
SCHEMES = {DISPLACEMENT: ("central2", "central4"), FORCE: ("central4",)}
OUTPUTS = {DISPLACEMENT: ("force", "pressure"), FORCE: ("displacement", "pressure")}
STATIC, ESTIMATE = "from static equilibrium", "from the steady state at the estimate"
WARM, BATCHED, COLD = "warm", "batched", "cold"
# Of SciPy's integrators.
TIMED_CYCLES = 3


def measure(drive: str, identified: Identified, seed: int, *, quick: bool) -> dict[str, Any]:
    """Return times and their ratios for one direction, from the joint posterior of all experiments."""
    experiments = identified.problem.experiments

    def steady(theta: np.ndarray) -> bool:
        return all(_gear(drive, experiment, identified, theta).steady for experiment in experiments)

    theta, left_out = draws(identified, QUICK_DRAWS if quick else DRAWS, seed, steady)
    gears = [_gear(drive, experiment, identified, theta) for experiment in experiments]
    return {
        "draws": len(theta),
        "left_out": left_out,
        "cores": os.cpu_count(),
        "samples": SAMPLES,
        "schemes": {scheme: _by_scheme(drive, scheme, identified, theta, gears, quick) for scheme in SCHEMES[drive]},
    }


def _by_scheme(
    drive: str, scheme: str, identified: Identified, theta: np.ndarray, gears: Sequence[Gear], quick: bool
) -> dict[str, Any]:
    """Return the times of the other methods at the accuracy of one scheme of the periodic solver."""
    stated, fit = identified.problem, identified.fit
    if scheme != stated.scheme:
        stated = problem(stated.experiments, drive, scheme=scheme)
    warm = stated.anchored(fit.theta)
    own = _own_errors(warm, theta, gears)
    chosen = [{k: choose(gear, k, allowed) for k in COMPILED} for gear, allowed in zip(gears, own, strict=True)]
    noise = np.array(list(fit.noise.values()))
    times = interleaved(_actions(warm, scheme, noise, theta, gears, chosen), QUICK_REPEATS if quick else REPEATS)
    scipy = {method: _scipy(gears, own, chosen, method) for method in SCIPY}
    return {
        "milliseconds": {name: spread(1e3 * values) for name, values in times.items()},
        "scipy_milliseconds": {method: seconds and 1e3 * seconds for method, seconds in scipy.items()},
        "ratios": _ratios(times, scipy),
        "experiments": {
            gear.experiment.name: {"error": allowed}
            | {kind: _settings(contender) for kind, contender in by_kind.items()}
            for gear, allowed, by_kind in zip(gears, own, chosen, strict=True)
        },
    }


def _settings(found: Contender) -> dict[str, float]:
    return {name: getattr(found, name) for name in ("fineness", "tolerance", "error", "cycles")}


def draws(
    identified: Identified, count: int, seed: int, steady: Callable[[np.ndarray], bool]
) -> tuple[np.ndarray, dict[str, int]]:
    """Return draws (count, names) from which time integration becomes steady, and how many were left out.

    At theta16 ≤ 0 the gas has no steady state that an integration could reach. Of those with every theta16 positive
    some need more cycles than `MAX_CYCLES`.

    `steady`: Of a draw (1, names).
    """
    posterior, names = identified.posterior, identified.problem.names
    assert posterior is not None
    every = np.stack([posterior.draws(name) for name in names], axis=-1)
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


def _own_errors(warm: bp.Problem, theta: np.ndarray, gears: Sequence[Gear]) -> list[float]:
    """Return the periodic solver's largest error at any draw, by experiment."""
    outputs, converged = warm.outputs(theta)
    if not converged.all():
        raise RuntimeError("A periodic solve at a draw of the posterior did not converge.")
    found = []
    for gear in gears:
        own = np.stack([outputs[gear.experiment.name][name] for name in OUTPUTS[gear.drive]], axis=-1)
        found.append(max(error(one, exact) for one, (_, exact) in zip(own, gear.exact, strict=True)))
    return found


def _actions(
    warm: bp.Problem,
    scheme: str,
    noise: np.ndarray,
    theta: np.ndarray,
    gears: Sequence[Gear],
    chosen: Sequence[Mapping[str, Contender]],
) -> dict[str, Action]:
    """Return what is timed, and of how many log-posteriors each call takes the time."""
    many = np.resize(theta, (WALKERS, theta.shape[1]))
    actions: dict[str, Action] = {
        WARM: Action(lambda: [warm.log_posterior(one, noise) for one in theta], len(theta)),
        BATCHED: Action(lambda: warm.log_posterior(many, noise), WALKERS),
        COLD: Action(lambda: [_cold(gear, scheme) for gear in gears]),
    }
    for kind in COMPILED:
        contenders = [by_kind[kind] for by_kind in chosen]
        known = [_steady(*one) for one in zip(gears, contenders, strict=True)]
        actions[f"{kind} {STATIC}"] = Action(partial(_integrate, gears, contenders, None), len(theta))
        actions[f"{kind} {ESTIMATE}"] = Action(partial(_integrate, gears, contenders, known), len(theta))
    return actions


def _steady(gear: Gear, contender: Contender) -> np.ndarray:
    """Return the steady state at the estimate, or static equilibrium where its theta16 ≤ 0 leaves it none."""
    path, cycles = contender.integrate(gear.estimate, gear.still(gear.estimate))
    return path[0] if cycles else gear.still(gear.estimate)


def _integrate(gears: Sequence[Gear], contenders: Sequence[Contender], starts: Sequence[np.ndarray] | None) -> None:
    for i, (gear, contender) in enumerate(zip(gears, contenders, strict=True)):
        for parameters in gear.parameters:
            contender.integrate(parameters, gear.still(parameters) if starts is None else starts[i])


def _cold(gear: Gear, scheme: str) -> bp.PeriodicSolution:
    """Solve from static equilibrium."""
    return bp.solve_periodic(
        bp.models.landing_gear(gear.drive),
        dict(zip(NAMES, gear.parameters[0], strict=True)),
        gear.experiment.inputs,
        frequency=gear.experiment.frequency,
        samples=SAMPLES,
        scheme=scheme,
    )


def _scipy(
    gears: Sequence[Gear], own: Sequence[float], chosen: Sequence[Mapping[str, Contender]], method: str
) -> float | None:
    """Return the seconds of one integration of all until steady, None where no tolerance is accurate enough."""
    relative = [choose_scipy(gear, method, allowed) for gear, allowed in zip(gears, own, strict=True)]
    total = 0.0
    for gear, tolerance, by_kind in zip(gears, relative, chosen, strict=True):
        if tolerance is None:
            return None
        cycles = min(contender.cycles for contender in by_kind.values())
        total += _few_cycles(gear, method, tolerance) * cycles / TIMED_CYCLES
    return total


def _few_cycles(gear: Gear, method: str, relative: float) -> float:
    """Return the seconds of `TIMED_CYCLES`; all the others cost the same."""
    integrate, parameters = gear.scipy(method, relative, TIMED_CYCLES), gear.parameters[0]
    start, times = gear.still(parameters), []
    for _ in range(2):
        before = time.perf_counter()
        integrate(parameters, start)
        times.append(time.perf_counter() - before)
    return min(times)


def _ratios(times: Mapping[str, np.ndarray], scipy: Mapping[str, float | None]) -> dict[str, Any]:
    """Return the time ratios of integration to the periodic solver, by the faster compiled method in each repeat."""
    quickest = {start: np.min([times[f"{kind} {start}"] for kind in COMPILED], axis=0) for start in (STATIC, ESTIMATE)}
    found = {f"compiled {start} / {WARM}": values / times[WARM] for start, values in quickest.items()}
    found |= {f"compiled {STATIC} / {BATCHED}": quickest[STATIC] / times[BATCHED]}
    found |= {f"compiled {STATIC} / {COLD}": quickest[STATIC] / times[COLD]}
    found |= {f"{method} {STATIC} / {WARM}": seconds / times[WARM] for method, seconds in scipy.items() if seconds}
    return {name: spread(values) for name, values in found.items()}


def table(drive: str, found: Mapping[str, Any]) -> str:
    """Return the text to print."""
    left_out = found["left_out"]
    lines = [
        f"  {drive} given: {left_out['not_positive']} of {left_out['draws']} draws excluded without a steady state, "
        f"{left_out['too_slow']} of {left_out['tried']} others, not steady after {MAX_CYCLES} cycles"
    ]
    for scheme, one in found["schemes"].items():
        worst = max(entry["error"] for entry in one["experiments"].values())
        lines.append(
            f"    {scheme}, error at most {worst:.0e} of the range: {one['milliseconds'][WARM]['median']:.2f} ms a "
            "log-posterior of all experiments"
        )
        for name, ratio in one["ratios"].items():
            lines.append(f"      {name}: {ratio['median']:.1f} ({ratio['least']:.1f} … {ratio['largest']:.1f})")
        for method, milliseconds in one["scipy_milliseconds"].items():
            lines += [] if milliseconds else [f"      {method}: not as accurate at any tolerance"]
    return "\n".join(lines)
