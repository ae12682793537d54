"""Time of a periodic solve: relative to LAPACK on the same matrices, after a small change, with size, on several cores.

This is the one study module that imports the solver's internals, because it times single Newton iterations. Times in
microseconds are medians of interleaved repeats.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import lapack

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Anchor, Batch
from bayesperiodic.periodic.compiled import HALVINGS, MOST_NEWTON_STEPS, NO_BORDER, NO_UNKNOWNS
from bayesperiodic.periodic.equations import PeriodicEquations, workspace
from studies.common import available_cores
from studies.gear import GEAR, RIG, gear_problem, gear_runs
from studies.timing import Action, gain_of_cores, interleaved, slope, timed

SAMPLES = 800
CHANGE = 0.01
OFF = 1e-3
REPEATS = 15
CALLS = 20
LINEAR_SIZES = (200, 400, 800, 1600, 3200, 6400, 12800, 25600, 51200)
MASSES = (1, 2, 5, 10, 20, 30, 40, 50)
VARIANTS = [(drive, scheme) for drive in ("force", "displacement") for scheme in ("backward2", "central2")]
THETA = np.array(list(GEAR.values()))


def run_cost(quick: bool = False) -> dict[str, Any]:
    """Return everything measured, as plain data."""
    repeats = 5 if quick else REPEATS
    return {
        "newton_iteration": [newton_iteration(drive, scheme, repeats) for drive, scheme in VARIANTS],
        "warm_solve": [warm_solve(drive, scheme, repeats) for drive, scheme in VARIANTS],
        "with_samples": with_samples(LINEAR_SIZES[:5] if quick else LINEAR_SIZES, repeats),
        "with_systems": with_systems(repeats),
        "with_masses": with_masses(MASSES[:4] if quick else MASSES),
        "map": map_of_the_gear(repeats),
    }


def checks(cost: dict[str, Any]) -> list[tuple[str, float, float, float]]:
    """Return the targets: name, value found and limits."""
    rows = []
    for entry in cost["newton_iteration"]:
        what = f"Newton iteration / (sweep + gbtrf + gbtrs), {entry['drive']}, {entry['scheme']}"
        rows.append((what, entry["ratio_median"], 0.0, entry["target"]))
    for entry in cost["warm_solve"]:
        what = f"solve after a 1 % change in Newton iterations, {entry['drive']}, {entry['scheme']}"
        rows.append((what, entry["newton_iterations_median"], 0.0, entry["target"]))
    for scheme, entry in cost["with_samples"].items():
        rows.append((f"slope of the cost with n, {scheme}", entry["slope"], 0.9, 1.1))
    rows.append(("slope of the cost with the number of systems", cost["with_systems"]["slope"], 0.9, 1.1))
    rows.append(("gain of all cores / that of a plain loop", cost["with_systems"]["ratio"], 0.9, np.inf))
    rows.append(("slope of the cost with masses", cost["with_masses"]["slope"], 2.0, 3.2))
    rows.append(("whole MAP of 14 experiments from 30 % off [s]", cost["map"]["seconds_median"], 0.0, 2.0))
    return rows


def equations_of(
    model: bp.Model, inputs: dict[str, np.ndarray], frequency: float, samples: int, scheme: str
) -> PeriodicEquations:
    """Return the equations of one experiment."""
    return PeriodicEquations.build(
        model, inputs, frequency=frequency, samples=samples, scheme=scheme, periods=1, winding=0
    )


def gear_equations(drive: str, scheme: str) -> list[PeriodicEquations]:
    """Return the equations of the 14 experiments (synthetic inputs, pure sines)."""
    model = bp.models.landing_gear(drive)
    return [equations_of(model, inputs, frequency, SAMPLES, scheme) for frequency, inputs in gear_runs(drive)]


def newton_iteration(drive: str, scheme: str, repeats: int) -> dict[str, Any]:
    """Compare one Newton iteration with one sweep plus LAPACK's gbtrf and gbtrs on the same folded band.

    The iteration is the time of a solve from a guess 0.1 % off over its iterations, so it includes its share of the
    set-up of a solve. The copy that gbtrf needs, because it overwrites the band, is timed alone and subtracted.
    """
    measured = []
    for equations in gear_equations(drive, scheme):
        newton, iterations, z = _prepared(equations, THETA)
        columns = equations.residual_jacobian(z, THETA)
        band, lower = lapack_band(equations, columns)
        working, right = band.copy(order="F"), np.random.default_rng(1).standard_normal(band.shape[1])
        factored, pivots, _ = lapack.dgbtrf(band, lower, lower)
        sweep = equations.states(z), equations.inputs, THETA, equations.grid.tau, equations.frequency, columns

        def factor(working: np.ndarray = working, band: np.ndarray = band, lower: int = lower) -> None:
            working[:] = band
            lapack.dgbtrf(working, lower, lower, overwrite_ab=True)

        times = _interleaved(
            repeats,
            newton=newton,
            sweep=partial(equations.model.kernels.residual_jacobian, *sweep),
            copy=partial(np.copyto, working, band),
            factor=factor,
            gbtrs=partial(lapack.dgbtrs, factored, lower, lower, right, pivots),
        )
        gbtrf = times["factor"] - times["copy"]
        parts = times["newton"] / iterations, times["sweep"], gbtrf, times["gbtrs"]
        measured.append((sum(parts[1:]), *parts))
    floor, newton_us, *_ = np.transpose(measured)
    names = ("sweep_gbtrf_gbtrs_us", "newton_us", "sweep_us", "gbtrf_us", "gbtrs_us")
    return {
        "drive": drive,
        "scheme": scheme,
        **dict(zip(names, np.median(measured, axis=0).tolist(), strict=True)),
        "ratio_median": float(np.median(newton_us / floor)),
        "ratio_worst": float(np.max(newton_us / floor)),
        "target": 0.6 if (drive, scheme) == ("force", "backward2") else 1.0,
    }


def _prepared(equations: PeriodicEquations, theta: np.ndarray) -> tuple[Callable[[], Any], int, np.ndarray]:
    """Return a solve from a guess 0.1 % off with preallocated work arrays, its Newton iterations, and the solution."""
    solution = equations.solve(theta, equations.static_guess(theta)).z
    guess = solution * (1.0 + OFF)
    z, history = guess.copy(), np.empty((MOST_NEWTON_STEPS, 3))
    before = equations.functions, equations.grid.packed, equations.setting(theta), NO_UNKNOWNS, NO_BORDER, HALVINGS
    work = workspace(equations, bordered=False)

    def solve() -> tuple[int, int, float]:
        z[:] = guess
        return equations.kernels.newton(*before, z, history, work)

    return solve, solve()[1], solution


def _iteration(equations: PeriodicEquations, theta: np.ndarray, repeats: int, calls: int) -> float:
    newton, iterations, _ = _prepared(equations, theta)
    return _interleaved(repeats, calls, newton=newton)["newton"] / iterations


def warm_solve(drive: str, scheme: str, repeats: int, changes: int = 20) -> dict[str, Any]:
    """Time solves after every parameter has changed by 1 % up or down, from an anchor, in Newton iterations.

    They end when the next step expected is below 1e-9 of the state.
    """
    changed = THETA * (1.0 + CHANGE * np.random.default_rng(2).choice([-1.0, 1.0], (changes, THETA.size)))
    costs, steps = [], []
    for equations in gear_equations(drive, scheme):
        newton, iterations, z = _prepared(equations, THETA)
        batch = Batch([equations], [Anchor.at(equations, THETA, z)])
        solved = batch.solve(changed, threads=1)
        if solved.status.any():
            raise RuntimeError(f"A warm solve failed at {equations.frequency} Hz.")
        times = _interleaved(repeats, 3, warm=partial(batch.solve, changed, threads=1), newton=newton)
        costs.append(times["warm"] / changes / (times["newton"] / iterations))
        steps.append(float(solved.iterations.mean()))
    return {
        "drive": drive,
        "scheme": scheme,
        "change": CHANGE,
        "newton_iterations_median": float(np.median(costs)),
        "newton_iterations_worst": max(costs),
        "worst_at_hz": RIG[int(np.argmax(costs))][0],
        "steps_mean": steps,
        "target": 2.0,
    }


def map_of_the_gear(repeats: int) -> dict[str, Any]:
    """Time a whole MAP estimate of theta4, theta6 and theta16 on the 14 experiments, n = 800, from a start 30 % off.

    The data are synthetic: force-driven, displacement and pressure with noise of 0.3 % of their range.
    """
    problem = gear_problem("force", 4, scheme="backward2")
    start = {name: GEAR[name] * (1.3 if name == "theta4" else 0.7) for name in problem.names}
    estimate = partial(bp.map_estimate, problem, start=start, progress=False)
    fit, times = estimate(), [timed(estimate)[1] for _ in range(repeats)]
    return {
        "status": fit.status,
        "iterations": len(fit.history) - 1,
        "seconds_median": float(np.median(times)),
        "seconds_range": [min(times), max(times)],
        "off_in_sds": {name: (fit.theta[name] - GEAR[name]) / fit.sd[name] for name in problem.names},
    }


def with_samples(sizes: tuple[int, ...], repeats: int) -> dict[str, Any]:
    """Time a Newton iteration of the force-driven gear at 1 Hz for growing n; fit the log-log slope from n = 800."""
    model, result = bp.models.landing_gear(), {}
    for scheme in ("backward2", "central2"):
        times = []
        for samples in sizes:
            force = 4500.0 + 700.0 * np.cos(2 * np.pi * np.arange(samples) / samples)
            times.append(_iteration(equations_of(model, {"force": force}, 1.0, samples, scheme), THETA, repeats, 3))
        result[scheme] = {"samples": list(sizes), "us": times, "slope": slope(sizes[2:], times[2:])}
    return result


def with_systems(repeats: int, systems: int = 512) -> dict[str, Any]:
    """Compare the gain of both cores on a batch of solves with that on a plain loop in the same run."""
    equations = gear_equations("force", "backward2")[8]
    z = equations.solve(THETA, equations.static_guess(THETA)).z
    batch = Batch([equations], [Anchor.at(equations, THETA, z)])
    changed = THETA * (1.0 + CHANGE * np.random.default_rng(3).standard_normal((systems, THETA.size)))
    cores, counts = available_cores(), (64, 128, 256, systems)
    times = [_interleaved(repeats, 1, solves=partial(batch.solve, changed[:c], threads=1))["solves"] for c in counts]
    gains = gain_of_cores(lambda threads: batch.solve(changed, threads=threads), cores, 2 * repeats + 1)
    return {
        "systems": list(counts),
        "us": times,
        "slope": slope(counts, times),
        "cores": cores,
        "gain": gains["gain"],
        "gain_of_plain_loop": gains["plain"],
        "ratio": gains["ratio"],
        "ratio_quartiles": gains["ratio_quartiles"],
        "target_ratio": 0.9,
    }


def with_masses(masses: tuple[int, ...], samples: int = 100) -> dict[str, Any]:
    """Time a Newton iteration of chains of masses; both ways of factoring cost masses³ where the blocks are large.

    The slope is fitted from 10 masses on, where the blocks begin to outweigh the sweep over them.
    """
    times, force = [], np.cos(2 * np.pi * np.arange(samples) / samples)
    for count in masses:
        model = bp.models.chain(count)
        theta = np.array([{"m": 1.0, "c": 0.2, "k": 50.0, "k3": 10.0}[name] for name in model.parameters])
        times.append(_iteration(equations_of(model, {"force": force}, 0.3, samples, "central2"), theta, 5, 1))
    large = [m for m in masses if m >= 10] or list(masses[-2:])
    return {
        "masses": list(masses),
        "us": times,
        "slope": slope(large, times[-len(large) :]),
        "slope_from": large[0],
        "predicted_slope": 3.0,
    }


def _interleaved(repeats: int, calls: int = CALLS, **actions: Callable[[], Any]) -> dict[str, float]:
    """Return the median of microseconds a call of each action, all timed in turn within every repeat."""
    repeated = {name: Action(partial(_repeat, action, calls), calls) for name, action in actions.items()}
    return {name: 1e6 * float(np.median(seconds)) for name, seconds in interleaved(repeated, repeats).items()}


def _repeat(action: Callable[[], Any], calls: int) -> None:
    for _ in range(calls):
        action()


def lapack_band(equations: PeriodicEquations, columns: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the folded band of ∂g/∂z in LAPACK's storage, with room for pivoting, and its half-width."""
    grid, count = equations.grid, equations.count
    lower = grid.packed.half_width * count + count - 1
    size = grid.points * count
    rows = np.empty((size, 3 * lower + 1))
    equations.kernels.assemble(columns, grid.packed, count, equations.frequency, rows)
    band = np.zeros((3 * lower + 1, size), order="F")
    for i in range(size):
        for j in range(max(0, i - lower), min(size, i + lower + 1)):
            band[2 * lower + i - j, j] = rows[i, j - i + lower]
    return band, lower
