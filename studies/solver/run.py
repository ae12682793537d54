"""The periodic solver against independent references: orders, unstable and rotating orbits, branches with their folds.

All data are computed from the models' equations. The references come from multiple shooting and Taylor series that
share no code with the package; studies/shooting.py states their accuracy.
"""

import argparse
import dataclasses
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common, shooting

SCHEMES = {"backward2": "#D55E00", "central2": "#E69F00", "central4": "#009E73", "fourier": "#0072B2"}
LINES = {"central2": "--", "central4": "-", "backward2": ":", "fourier": "-."}
TURN = 2 * np.pi

DUFFING = {"m": 0.45, "c": 1.3, "k": 900.0, "k3": 4e5}
SMOOTH = {"force": 30.0, "frequency": 6.0}
MANUFACTURED_FREQUENCY = 5.0
GRIDS = (50, 100, 200, 400, 800, 1600, 3200)
FOURIER_GRIDS = (8, 12, 16, 20, 24, 32, 48, 64)
FITTED = (200, 400, 800)
LEVELS = (0.5, 1.5, 3.0)
SWEEP = (5.0, 12.0)

SHOWN = {1.0: "o", 5.0: "s"}

PENDULUM = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
LOCKED, CHAOTIC, LOWEST = 13.0, 9.09, 4.5
INTEGRATED = (12.6, 12.2, 11.2, 10.4, 9.8, 9.7, 9.57, 9.5, 9.434, 9.39)
# Angular frequencies [rad/s] where a multiplier passes −1 on the branches of periods 1, 2 and 4.
DOUBLINGS = dict(zip((1, 2, 4), (known.omega for known in shooting.DOUBLINGS), strict=True))
# Floquet multipliers at 9.09 rad/s on the branches of periods 1, 2 and 4, and of both rotations of period 1.
BRANCHES = dict(zip((1, 2, 4), (known.multipliers for known in shooting.UNSTABLE[:3]), strict=True))
ROTATIONS = {"first": BRANCHES[1], "second": shooting.UNSTABLE[3].multipliers}
# Prime orbits of periods 3 and 5 at 9.09 rad/s.
ORBITS = shooting.UNSTABLE[4:12]


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    from studies.solver import cost  # compiles

    watch = common.Stopwatch()
    quick = options.quick
    results: dict[str, Any] = {"data": "none; everything is computed", "quick": quick}
    with watch.part("orders", "errors of every scheme on smooth forced Duffing"):
        results["orders"] = measure_orders()
    with watch.part("van_der_pol", "periods of van der Pol's oscillator"):
        results["van_der_pol"] = measure_periods((0.1, *SHOWN) if quick else tuple(shooting.VAN_DER_POL))
    with watch.part("duffing", "frequency responses of the Duffing oscillator"):
        responses, results["duffing"] = follow_duffing(quick)
    with watch.part("pendulum", f"the pendulum from {LOCKED:g} down to {CHAOTIC:g} rad/s"):
        route, results["pendulum"] = follow_pendulum(quick)
    with watch.part("orbits", f"unstable orbits of periods 3 and 5 at {CHAOTIC:g} rad/s"):
        results["orbits"] = measure_orbits(ORBITS[1::4] if quick else ORBITS)
    with watch.part("cost", "time of a solve, compared with LAPACK"):
        results["cost"] = cost.run_cost(quick)
    with watch.part("time_integration", "the pendulum integrated in time, for the figure"):
        attractor = integrate_down(INTEGRATED[2:3] if quick else INTEGRATED)
    with watch.part("figures", "drawing"):
        figures = {
            "duffing": draw_duffing(responses),
            "pendulum": draw_pendulum(route, attractor),
            "orders": draw_orders(results["orders"]["forced"], results["van_der_pol"]),
        }
        paths = common.save_figures(options.out, figures)
    results["checks"] = checks(results)
    results["cost"]["checks"] = [verdict(*row) for row in cost.checks(results["cost"])]
    print("\n" + tables(results) + "\n")
    common.finish(options.out, results, watch, paths, synthetic=False)


def measure_orders() -> dict[str, Any]:
    """Return errors and fitted orders on forced Duffing, the reference a fine solution, and on an exact solution."""
    fine = solve_duffing("fourier", harmonic_force(128), SMOOTH["frequency"])
    again = solve_duffing("fourier", harmonic_force(96), SMOOTH["frequency"])
    forced, manufactured = {}, {}
    for scheme in SCHEMES:
        grids = FOURIER_GRIDS if scheme == "fourier" else GRIDS
        solutions = {n: solve_duffing(scheme, harmonic_force(n), SMOOTH["frequency"]) for n in grids}
        forced[scheme] = convergence(solutions, {n: resampled(fine.states["x"], n) for n in grids})
        exact = {n: manufactured_solution(n) for n in grids}
        solutions = {n: solve_duffing(scheme, f, MANUFACTURED_FREQUENCY, 1.01 * x) for n, (x, f) in exact.items()}
        manufactured[scheme] = convergence(solutions, {n: x for n, (x, _) in exact.items()})
    return {
        "forced": forced,
        "manufactured": manufactured,
        "fitted_at": list(FITTED),
        "reference": "fourier with 128 points; error relative to the largest displacement",
        "reference_error": relative_error(again.states["x"], resampled(fine.states["x"], 96)),
    }


def harmonic_force(samples: int) -> np.ndarray:
    """Return the force [N] of the study of orders on a grid."""
    return SMOOTH["force"] * np.cos(TURN * np.arange(samples) / samples)


def manufactured_solution(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x = 0.02 cos ωt + 0.006 sin(2ωt + 0.4) [m] and the force that makes it an exact solution of Duffing's."""
    angle, omega = TURN * np.arange(samples) / samples, TURN * MANUFACTURED_FREQUENCY
    first, second = 0.02 * np.exp(1j * angle), -0.006j * np.exp(1j * (2 * angle + 0.4))
    x, v = (first + second).real, (1j * omega * (first + 2 * second)).real
    a = (-(omega**2) * (first + 4 * second)).real
    return x, DUFFING["m"] * a + DUFFING["c"] * v + DUFFING["k"] * x + DUFFING["k3"] * x**3


def solve_duffing(
    scheme: str, force: np.ndarray, frequency: float, guess: np.ndarray | None = None
) -> bp.PeriodicSolution:
    """Return a solution on the grid of the force."""
    return bp.solve_periodic(
        bp.models.duffing, DUFFING, {"force": force}, frequency=frequency, samples=len(force), scheme=scheme,
        guess="static" if guess is None else {"x": guess},
    )  # fmt: skip


def convergence(solutions: dict[int, bp.PeriodicSolution], exact: dict[int, np.ndarray]) -> dict[str, Any]:
    """Return errors of x by number of points and the order fitted to them."""
    errors = {n: relative_error(s.states["x"], exact[n]) for n, s in solutions.items() if s.converged}
    fitted = [n for n in FITTED if n in errors]
    slope = np.polyfit(np.log(fitted), np.log([errors[n] for n in fitted]), 1)[0] if len(fitted) > 1 else None
    return {
        "order": None if slope is None else -float(slope),
        "samples": list(errors),
        "errors": list(errors.values()),
        "iterations": [solutions[n].iterations for n in errors],
    }


def relative_error(values: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest difference in units of the largest exact value."""
    return float(np.max(np.abs(values - exact)) / np.max(np.abs(exact)))


def resampled(values: np.ndarray, points: int) -> np.ndarray:
    """Return the trigonometric polynomial through the values, at other points of the same period."""
    amplitudes = np.fft.rfft(values) / len(values)
    weights = np.where(np.arange(amplitudes.size) % (len(values) / 2) == 0, 1.0, 2.0)
    angle = TURN * np.arange(points)[:, None] / points * np.arange(amplitudes.size)
    return (np.exp(1j * angle) @ (weights * amplitudes)).real


def measure_periods(values: tuple[float, ...]) -> dict[str, Any]:
    """Return the relative errors of van der Pol's period for some mu, two schemes and every number of points."""
    table: dict[str, Any] = {}
    for mu in values:
        period = shooting.VAN_DER_POL[mu][0]
        solve = partial(bp.solve_periodic, bp.models.van_der_pol, {"mu": mu, "omega": 1.0})
        start = solve(frequency=0.15, samples=256, scheme="fourier")
        table[str(mu)] = {"reference": period}
        for scheme, grids in (("central4", GRIDS), ("fourier", (16, 24, 32, 48, 64, 96, 128, 192, 256))):
            every = {n: solve(frequency=start.frequency, samples=n, scheme=scheme, guess=start) for n in grids}
            found = {n: solution for n, solution in every.items() if solution.converged}
            table[str(mu)][scheme] = {
                "samples": list(found),
                "periods": [s.period for s in found.values()],
                "relative_errors": [abs(s.period / period - 1.0) for s in found.values()],
                "iterations": [s.iterations for s in found.values()],
            }
    return table


def follow(
    start: bp.PeriodicSolution, until: float, step: float | None, model: bp.Model = bp.models.pendulum
) -> bp.Branch:
    """Return the branch from a solution to another frequency."""
    return bp.continue_periodic(model, start, "frequency", until=until, step=step, progress=False)


def follow_duffing(quick: bool) -> tuple[dict[float, bp.Branch], list[dict[str, Any]]]:
    """Return frequency responses by force amplitude, and their folds by two schemes."""
    branches, table, step = {}, [], 1.0 if quick else 0.2
    for level in LEVELS:
        both = []
        for scheme, samples in (("central4", 200), ("fourier", 64)):
            force = level * np.cos(TURN * np.arange(samples) / samples)
            both.append(follow(solve_duffing(scheme, force, SWEEP[0]), SWEEP[1], step, bp.models.duffing))
        branch = branches[level] = both[0]
        folds = [[fold.frequency for fold in b.folds] for b in both]
        unstable = [s for s, kind in zip(branch, branch.kinds, strict=True) if not kind and not s.stable]
        entry = {"force": level, "folds": folds[0], "folds_fourier": folds[1], "points": len(branch)}
        table.append(entry | {"complete": branch.complete, "unstable_points": len(unstable)})
    return branches, table


def follow_pendulum(quick: bool) -> tuple[dict[int, bp.Branch], dict[str, Any]]:
    """Return the branches of periods 1, 2, 4, … down from the locked rotation, and how they compare to shooting."""
    samples, step = 200 if quick else 800, 0.04 if quick else None
    guess = {"phi": TURN * (np.arange(samples) / samples) - 0.4}
    start = solve_pendulum(guess, samples, "central4", winding=1, omega=LOCKED)
    branches = {1: follow(start, CHAOTIC / TURN, step)}
    for periods in (2, 4) if quick else (2, 4, 8):
        doubling = first(branches[periods // 2].period_doublings, f"period {periods // 2}")
        doubled = bp.double_period(bp.models.pendulum, doubling, "frequency")
        branches[periods] = joined(*(follow(doubled, end, step) for end in (doubling.frequency, CHAOTIC / TURN)))
    down = follow(branches[1][-1], LOWEST / TURN, step)
    doubling, fold = first(down.period_doublings, "far below"), first(down.folds, "far below")
    doublings: dict[str, Any] = {}
    for periods, branch in branches.items():
        found = [s.frequency * TURN for s in branch.period_doublings]
        doublings[str(periods)] = {"found": found}
        if periods in DOUBLINGS:
            reference = DOUBLINGS[periods]
            doublings[str(periods)] |= {"reference": reference, "difference": abs(found[0] - reference)}
    table = {
        "scheme": "central4",
        "samples": samples,
        "parameters": PENDULUM,
        "iterations": start.iterations,
        "points": {str(p): len(b) for p, b in branches.items()},
        "doublings": doublings,
        "multipliers": {str(p): compared(branches[p][-1], BRANCHES[p]) for p in BRANCHES},
        "below": {
            "doubling": doubling.frequency * TURN,
            "doubling_difference": abs(doubling.frequency * TURN - shooting.RETURN.omega),
            "fold": fold.frequency * TURN,
            "fold_difference": abs(fold.frequency * TURN - shooting.FOLD.omega),
            "back_at": down[-1].frequency * TURN,
        },
        "rotations": measure_rotations({"first": branches[1][-1], "second": down[-1]}),
    }
    return branches, table


def first(points: tuple[bp.PeriodicSolution, ...], where: str) -> bp.PeriodicSolution:
    """Return the first of the special points of a branch."""
    if not points:
        raise RuntimeError(f"pendulum, {where}: the fold or period doubling was not found.")
    return points[0]


def joined(back: bp.Branch, ahead: bp.Branch) -> bp.Branch:
    """Return two branches from the same solution as one."""
    return dataclasses.replace(
        ahead,
        values=np.concatenate([back.values[:0:-1], ahead.values]),
        solutions=back.solutions[:0:-1] + ahead.solutions,
        kinds=back.kinds[:0:-1] + ahead.kinds,
    )


def compared(solution: bp.PeriodicSolution, reference: tuple[complex, ...]) -> dict[str, Any]:
    """Return real multipliers with their largest relative difference to a reference."""
    found = solution.multipliers
    return {
        "multipliers": found.real.tolist(),
        "reference": list(reference),
        "relative_difference": float(np.max(np.abs(found / np.array(reference) - 1.0))) if found.size else np.inf,
        "status": solution.status,
        "iterations": solution.iterations,
        "section": [solution.states["phi"][0], solution.outputs["rate"][0]],
    }


def measure_rotations(rotations: dict[str, bp.PeriodicSolution]) -> dict[str, Any]:
    """Return the two period-1 rotations at 9.09 rad/s by every scheme."""
    table: dict[str, Any] = {}
    for (name, known), scheme in product(rotations.items(), SCHEMES):
        samples = 100 if scheme == "fourier" else 800
        entry = {"samples": samples} | compared(solve_pendulum(known, samples, scheme, winding=1), ROTATIONS[name])
        table.setdefault(name, {})[scheme] = entry
    return table


def solve_pendulum(
    guess: dict[str, np.ndarray] | bp.PeriodicSolution, samples: int, scheme: str, winding: int, periods: int = 1,
    omega: float = CHAOTIC,
) -> bp.PeriodicSolution:  # fmt: skip
    """Return an orbit at an angular frequency [rad/s]."""
    return bp.solve_periodic(
        bp.models.pendulum, PENDULUM, frequency=omega / TURN, samples=samples, scheme=scheme, winding=winding,
        periods=periods, guess=guess,
    )  # fmt: skip


def measure_orbits(orbits: list[shooting.Known]) -> list[dict[str, Any]]:
    """Return unstable orbits by the central schemes, from guesses of which each period is integrated from its start."""
    samples, table = 800, []
    for known in orbits:
        # Five digits are enough for a guess.
        section, winding = np.round(known.section, 5), known.winding
        parts = [integrate(CHAOTIC, phi, rate, 1.0, samples)["angle"][:samples] for phi, rate in section]
        entry: dict[str, Any] = {"period": len(section), "winding": winding}
        for scheme in ("central2", "central4"):
            guess = {"phi": np.concatenate(parts)}
            solution = solve_pendulum(guess, samples, scheme, winding=winding, periods=len(section))
            entry[scheme] = compared(solution, known.multipliers)
        table.append(entry)
    return table


def integrate(omega: float, phi: float, rate: float, periods: float, samples: int) -> dict[str, np.ndarray]:
    """Return the pendulum's outputs over some forcing periods by integration in time."""
    frequency = omega / TURN
    recording = bp.simulate(
        bp.models.pendulum, PENDULUM, frequency=frequency, duration=(periods + 0.5 / samples) / frequency,
        sampling_rate=samples * frequency, start={"phi": phi, "dphi": rate},
    )  # fmt: skip
    return dict(recording.outputs)


def integrate_down(frequencies: tuple[float, ...], settling: int = 48, kept: int = 24) -> dict[float, np.ndarray]:
    """Return rates at tau = 0, 1, … by angular frequency, each run beginning where the last one ended."""
    phi, rate, points = -0.39, 17.1, {}
    for omega in frequencies:
        path = integrate(omega, phi, rate, settling + kept - 1, 1)
        phi, rate = float(np.remainder(path["angle"][-1], TURN)), float(path["rate"][-1])
        points[omega] = path["rate"][-kept:]
    return points


def draw_duffing(branches: dict[float, bp.Branch]) -> Figure:
    """Draw the frequency responses and shade where the strongest force has two stable states."""
    figure = bp.plot.branch(*branches.values(), labels=[f"force {level:g} N" for level in branches])
    axes = figure.axes[0]
    low, high = sorted(fold.frequency for fold in branches[LEVELS[-1]].folds)
    axes.axvspan(low, high, color="0.92", lw=0, zorder=0)
    axes.annotate(
        f"at {LEVELS[-1]:g} N two stable states\nand an unstable one", (high, 0.62), (high + 0.4, 0.62),
        xycoords=("data", "axes fraction"), va="center", arrowprops={"arrowstyle": "-"},
    )  # fmt: skip
    return figure


def draw_pendulum(branches: dict[int, bp.Branch], attractor: dict[float, np.ndarray]) -> Figure:
    """Draw the cascade of the pendulum's rotation, whole and enlarged, with the motion found by time integration."""
    figure = plt.figure(figsize=(10.0, 5.0), layout="constrained")
    whole, enlarged = figure.subplots(1, 2)
    for axes, most in ((whole, 4), (enlarged, 8)):
        shown = {f"period {p}": branch for p, branch in branches.items() if p <= most}
        labels = list(shown)
        bp.plot.branch(*shown.values(), measure="section", output="rate", labels=labels, angular=True, ax=axes)
        for omega, points in attractor.items():
            axes.plot(np.full(points.size, omega), points, ".", color="black", ms=4, zorder=5)
        dots = plt.Line2D([], [], color="black", marker=".", ms=4, ls="", label="time integration")
        legend = axes.get_legend()
        assert legend is not None
        handles = legend.legend_handles
        handles = [*handles, dots] if axes is whole else handles[1 : len(shown)]
        axes.legend(handles=handles, frameon=False, loc="lower right")
    whole.set(xlim=(9.0, 13.1), ylim=(7.0, 17.5), title=f"pendulum, from {LOCKED:g} to {CHAOTIC:g} rad/s")
    enlarged.set(xlim=(9.37, 9.71), ylim=(9.4, 12.6), title="the boxed part enlarged")
    if INTEGRATED[-1] in attractor:
        enlarged.text(INTEGRATED[-1] + 0.006, 11.1, "chaotic beyond\nthe cascade", fontsize=9, va="center")
    whole.indicate_inset(bounds=(9.37, 9.4, 0.34, 3.2), edgecolor="0.4")
    return figure


def draw_orders(forced: dict[str, Any], periods: dict[str, Any]) -> Figure:
    """Draw errors against the number of points: every scheme on Duffing, two of them on van der Pol's period."""
    figure = plt.figure(figsize=(10.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)

    def draw(axes: Axes, entry: dict[str, Any], errors: str, scheme: str, marker: str, label: str) -> None:
        line = marker + LINES[scheme]
        axes.loglog(entry["samples"], entry[errors], line, color=SCHEMES[scheme], ms=4, lw=1.4, label=label)

    for scheme in SCHEMES:
        order = forced[scheme]["order"]
        label = scheme if order is None else f"{scheme}, fitted order {order:.2f}"
        draw(left, forced[scheme], "errors", scheme, "o", label)
    for (mu, marker), scheme in product(SHOWN.items(), ("central4", "fourier")):
        draw(right, periods[str(mu)][scheme], "relative_errors", scheme, marker, f"{scheme}, mu = {mu:g}")
    for axes in (left, right):
        axes.set_xlabel("points per period n")
        axes.legend(frameon=False, fontsize=9)
    left.set(ylabel="largest error / largest displacement", title="Duffing, smooth forcing: displacement")
    right.set(ylabel="relative error of the period", title="van der Pol: period of the free oscillation")
    right.set_ylim(top=1.0)
    return figure


def checks(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the targets: value found and limits."""
    orders, pendulum, periods = results["orders"], results["pendulum"], results["van_der_pol"]
    rows: list[tuple[str, float, float, float]] = []
    for kind in ("forced", "manufactured"):
        for scheme, order, within in (("backward2", 2, 0.05), ("central2", 2, 0.05), ("central4", 4, 0.1)):
            rows.append((f"order of {scheme}, {kind}", orders[kind][scheme]["order"], order - within, order + within))
        rows.append((f"error of fourier at 64 points, {kind}", at(orders[kind]["fourier"], 64), 0.0, 1e-10))
    for scheme, samples, limit in (("central4", 800, 1e-5), ("fourier", 256, 1e-9)):
        worst = max(at(entry[scheme], samples, "relative_errors") for entry in periods.values())
        rows.append((f"van der Pol periods, {scheme} at {samples} points, relative", worst, 0.0, limit))
    for scheme, limit in (("backward2", 1e-3), ("central2", 1e-5), ("central4", 1e-8), ("fourier", 1e-8)):
        worst = max(by_scheme[scheme]["relative_difference"] for by_scheme in pendulum["rotations"].values())
        rows.append((f"multipliers of the period-1 rotations, {scheme}, relative", worst, 0.0, limit))
    for p, entry in pendulum["doublings"].items():
        if "difference" in entry:
            rows.append((f"doubling of period {p} [rad/s]", entry["difference"], 0.0, 1e-4))
    for what in ("doubling", "fold"):
        rows.append((f"{what} far below [rad/s]", pendulum["below"][f"{what}_difference"], 0.0, 1e-4))
    for scheme, limit in (("central2", 1e-4), ("central4", 1e-5)):
        worst = max(entry[scheme]["relative_difference"] for entry in results["orbits"])
        rows.append((f"multipliers of the orbits of periods 3 and 5, {scheme}, relative", worst, 0.0, limit))
    for entry in results["duffing"]:
        if entry["folds"]:
            worst = float(np.max(np.abs(np.subtract(entry["folds"], entry["folds_fourier"]))))
            rows.append((f"Duffing's folds at {entry['force']:g} N, central4 against fourier [Hz]", worst, 0.0, 1e-5))
    return [verdict(*row) for row in rows]


def verdict(what: str, found: float, low: float, high: float) -> dict[str, Any]:
    """Return a check as an entry of results.json."""
    return {"what": what, "found": found, "low": low, "high": high, "met": bool(low <= found <= high)}


def at(entry: dict[str, Any], samples: int, what: str = "errors") -> float:
    """Return the error at a number of points, infinite where the solve failed."""
    return dict(zip(entry["samples"], entry[what], strict=True)).get(samples, np.inf)


def tables(results: dict[str, Any]) -> str:
    """Return the text to print."""
    pendulum = results["pendulum"]
    doublings = {
        f"from period {p} to {2 * int(p)}": {
            "found": f"{e['found'][0]:.9f}" if e["found"] else "-",
            "by shooting": f"{e['reference']:.9f}" if "reference" in e else "-",
            "difference": e.get("difference"),
        }
        for p, e in pendulum["doublings"].items()
    }
    rotations = {
        f"{name}, {scheme}": {
            "points": e["samples"],
            "multipliers": ", ".join(f"{m:.10f}" for m in e["multipliers"]),
            "relative difference": e["relative_difference"],
            "iterations": e["iterations"],
        }
        for name, by_scheme in pendulum["rotations"].items()
        for scheme, e in by_scheme.items()
    }
    orbits = {
        f"period {e['period']}, winding {e['winding']:2d}, {number}": {
            "larger multiplier": f"{e['central4']['multipliers'][0]:.6f}"
        }
        | {f"difference, {s}": e[s]["relative_difference"] for s in ("central2", "central4")}
        for number, e in enumerate(results["orbits"], 1)
    }
    folds = [
        f"  force {e['force']:g} N: " + (" and ".join(f"{f:.6f} Hz" for f in sorted(e["folds"])) or "none")
        for e in results["duffing"]
    ]
    below = pendulum["below"]
    return "\n".join([
        common.shown(
            f"The pendulum's period doublings from {LOCKED:g} down to {CHAOTIC:g} rad/s ({pendulum['scheme']}, "
            f"{pendulum['samples']} points a forcing period) [rad/s]", doublings,
        ),
        f"Further down, the rotation turns in a fold at {below['fold']:.9f} rad/s and comes back as the second "
        f"rotation at {below['back_at']:.2f} rad/s.",
        common.shown(f"\nMultipliers of the two period-1 rotations at {CHAOTIC:g} rad/s", rotations),
        common.shown(f"\nUnstable prime orbits at {CHAOTIC:g} rad/s", orbits),
        "\nFolds of the Duffing oscillator",
        *folds,
        "\nTargets",
        judged(results["checks"]),
        "\nCost",
        judged(results["cost"]["checks"]),
    ])  # fmt: skip


def judged(checks: list[dict[str, Any]]) -> str:
    """Return checks as text."""
    return common.table_of_rows([check | {"value": check["found"], "note": ""} for check in checks])
