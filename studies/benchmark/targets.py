"""Targets of the benchmark, its results as text, and the regression guard.

The guard compares the ratios of a quick run with those kept, never absolute times.
"""

from collections.abc import Mapping
from typing import Any

from studies import common
from studies.benchmark.contenders import GRADIENT, OWN_GRADIENT
from studies.benchmark.floor import ALL_FREE
from studies.benchmark.integration import EQUILIBRIUM, ESTIMATE, STEADY
from studies.benchmark.peers import BALANCE, BVP, DIFFRAX_ROWS, INITIAL
from studies.benchmark.posteriors import NUMPYRO
from studies.benchmark.problems import DISPLACEMENT, DUFFING, FOLDED, FORCE
from studies.common import Row, row


def problem(name: str, found: Mapping[str, Any]) -> str:
    """Return the methods of one problem as text."""
    kind = "SYNTHETIC data" if found["synthetic"] else "measured data"
    experiments = "1 experiment" if found["experiments"] == 1 else f"{found['experiments']} experiments"
    title = (
        f"{name} ({kind}, {experiments}, {found['samples']} samples; |change of log-posterior| <= "
        f"{found['allowed']:g} at {found['draws']} draws, reference uncertain by {found['reference_uncertainty']:.0e})"
    )
    methods = {
        entry["name"]: {
            "ms": entry["milliseconds"] and entry["milliseconds"]["median"],
            "/ warm (least … largest)": between(entry["ratio"]), "error": entry["error"], "settings": entry["note"],
        }
        for entry in found["rows"]
    }  # fmt: skip
    return common.shown(title, methods)


def between(values: Mapping[str, float] | None) -> str:
    """Return a median with its range."""
    return "-" if values is None else f"{values['median']:.3g} ({values['least']:.3g} … {values['largest']:.3g})"


def posterior(found: Mapping[str, Any]) -> str:
    """Return the samplers, and emcee with the methods, as text."""
    title = "Effective samples per second, Duffing (SYNTHETIC data), the smallest of any parameter"
    against = f"{found['split']['best']} over emcee with these methods: ratio = sampler × solver"
    samplers = common.shown(title, found["samplers"], ["ess_per_second", "note"])
    return f"{samplers}\n{common.shown(against, found['split']['against'])}"


def floor(name: str, found: Mapping[str, Any]) -> str:
    """Return floor and stages of one problem as text."""
    by_scheme = {
        scheme: {f"floor, {part} [µs]": value["median"] for part, value in entry["floor_us"].items()}
        | {f"{stage} [µs]": value for stage, value in entry.get("stages_us", {}).items()}
        | {f"{what} / floor": between(value) for what, value in entry["ratio"].items()}
        for scheme, entry in found["schemes"].items()
    }
    title = f"{name}: floor and stages of a warm log-posterior on one core, and times over the floor"
    names = next(iter(by_scheme.values()))
    lines = [common.shown(title, {name: {scheme: one[name] for scheme, one in by_scheme.items()} for name in names})]
    if "emcee_us" in found:
        memory, own = between(found["bandwidth_gb_per_s"]), between(found["emcee_us"])
        lines.append(f"  memory bandwidth of one core {memory} GB/s; emcee's own time {own} µs per log-posterior")
    return "\n".join(lines)


# Allowed factor between medians. On a shared machine medians of a quick run vary by a third; if some vary more, the
# ranges over the repeats overlap.
TOLERANCE = 1.6
OWN = "this package"


def worse(now: Mapping[str, Any], kept: Mapping[str, Any], tolerance: float = TOLERANCE) -> list[str]:
    """Return a line for every ratio whose median is worse by more than the tolerance and whose range does not overlap.

    Methods are compared by their time relative to this package, which must not decrease, and this package by its time
    relative to the floor, which must not increase.
    """
    lines = []
    for name, (new, old) in pairs(now, kept).items():
        rises = "/ floor" in name
        factor = new["median"] / old["median"] if rises else old["median"] / new["median"]
        apart = new["least"] > old["largest"] if rises else new["largest"] < old["least"]
        if factor > tolerance and apart:
            lines.append(f"{name}: {new['median']:.3g}, kept {old['median']:.3g}, worse by a factor {factor:.2f}")
    return lines


def pairs(now: Mapping[str, Any], kept: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the ratios that both runs have, with their medians and ranges in each."""
    new, old = _ratios(now), _ratios(kept)
    return {name: (value, old[name]) for name, value in new.items() if name in old}


def _ratios(found: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    result = {
        f"{problem}: {row['name']} / {OWN}": row["ratio"]
        for problem, entry in found["problems"].items()
        for row in entry["rows"]
        if row["ratio"] and not row["name"].startswith(OWN)
    }
    for problem, floor in found["floor"].items():
        for scheme, entry in floor["schemes"].items():
            result |= {f"{problem}, {scheme}: {what} / floor": v for what, v in entry["ratio"].items()}
    return result


# Least ratios to one warm log-posterior.
LEAST = (
    (f"{STEADY} {EQUILIBRIUM}", 20.0, (DUFFING, FORCE)),
    (f"{STEADY} {ESTIMATE}", 5.0, (DUFFING, FORCE)),
    *((f"{method} {start}", 100.0, None) for method in INITIAL for start in (EQUILIBRIUM, ESTIMATE)),
    *((f"{BVP} {start}", 20.0, None) for start in (EQUILIBRIUM, ESTIMATE)),
    *((name, 50.0, None) for name in DIFFRAX_ROWS[:3]),
    (BALANCE, 10.0, None),
)
GRADIENT_LEAST, GRADIENT_ERROR, DIFFERENCES = 2.0, 1e-6, "against central differences"
# Largest ratios to the floor.
TIMED = {
    "near": "warm, one core", "far": "warm, one core, at three times their spread", "call": "warm, all cores",
    "batched": "64 walkers, all cores", "gradient": "value and gradient, 3 parameters",
    ALL_FREE: "value and gradient, 15 parameters",
}  # fmt: skip
GEAR_LIMITS = {"far": 0.35, ALL_FREE: 1.0}
FOLDED_LIMITS = {
    FORCE + FOLDED: {"near": 0.35, "call": 0.35, "batched": 0.18, "gradient": 1.0},
    DUFFING + FOLDED: {"near": 1.0, "call": 1.0, "batched": 1.0, "gradient": 3.5},
}
SAME_GRID = 1e-2
FASTEST, AROUND_SCIPY = 3.0, 20.0
START = (
    ("import_s", "import [s]", 1.0), ("names_s", "import with the names of an identification [s]", 1.0),
    ("first_solve_s", "first solve of a new model [s]", 10.0),
    ("from_cache_s", "first solve from the cache [s]", 1.0),
    ("peak_mb", "peak of a process, 64 walkers × 14 experiments [MB]", 500.0),
)  # fmt: skip


def rows(found: Mapping[str, Any]) -> list[Row]:
    """Return all targets whose measurements are there."""
    result = [row for name, problem in found["problems"].items() for row in _of_problem(name, problem)]
    for name, limits in {FORCE: GEAR_LIMITS, **FOLDED_LIMITS}.items():
        result += _of_floor(name, found["floor"][name], limits) if name in found["floor"] else []
    if "posterior" in found:
        result += _of_posterior(found["posterior"])
    if "scaling" in found:
        result += _of_scaling(found["scaling"])
    return result


def _of_problem(name: str, problem: Mapping[str, Any]) -> list[Row]:
    result, by_name = [], {entry["name"]: entry for entry in problem["rows"]}
    for contender, least, where in LEAST:
        if contender in by_name and (where is None or name in where):
            entry = by_name[contender]
            note = "" if entry["ratio"] else entry["note"]
            what = f"{name}: {contender} / this package, warm"
            result.append(row(what, entry["ratio"] and entry["ratio"]["median"], least, None, note))
    if name in (FORCE, DISPLACEMENT):
        given = problem["gradient_ratio"]
        result.append(row(f"{name}: {GRADIENT} / {OWN}", given and given["median"], GRADIENT_LEAST, None))
        if own := by_name.get(f"{OWN_GRADIENT}, {problem['scheme']}"):
            what = f"{name}: error of this package's gradient, of its largest component"
            result.append(row(what, own["gradient_error"], 0.0, GRADIENT_ERROR, DIFFERENCES))
    return result


def _of_floor(name: str, floor: Mapping[str, Any], limits: Mapping[str, float]) -> list[Row]:
    """Return the speed targets, which are those of folded recordings, and those of the gear's exact mean periods."""
    result = []
    for scheme, entry in floor["schemes"].items():
        for key, limit in limits.items():
            what = f"{name}, {scheme}: {TIMED[key]} / floor"
            result.append(row(what, entry["ratio"][key]["median"], 0.0, limit))
        if "gradient_error" in entry:
            what = f"{name}, {scheme}: error of the gradient by 15 parameters, of its largest component"
            result.append(row(what, entry["gradient_error"][ALL_FREE], 0.0, GRADIENT_ERROR, DIFFERENCES))
            what = f"{name}, {scheme}: |change of log-posterior| against solves anchored at the draw"
            result.append(row(what, entry["same_grid_error"], 0.0, SAME_GRID))
    return result


def _of_posterior(found: Mapping[str, Any]) -> list[Row]:
    best, what = found["split"]["best"], f"effective samples per second: {found['split']['best']} /"
    others = {name: e["ratio"] for name, e in found["split"]["against"].items() if not name.startswith(OWN)}
    scipy = {name: ratio for name, ratio in others.items() if name.startswith(INITIAL)}
    result = []
    for kind, ratios, least in (("the fastest", others, FASTEST), ("SciPy's integrators", scipy, AROUND_SCIPY)):
        if ratios:
            name = min(ratios, key=lambda n: ratios[n])
            result.append(row(f"{what} emcee around {kind} ({name})", ratios[name], least, None))
    numpyro, own = found["samplers"][NUMPYRO], found["samplers"][best]
    value = own["ess_per_second"] / numpyro["ess_per_second"] if "ess_per_second" in numpyro else None
    return [*result, row(f"{what} {NUMPYRO}", value, FASTEST, None, numpyro.get("note", ""))]


def _of_scaling(found: Mapping[str, Any]) -> list[Row]:
    result = [
        row(f"exponent of {kind} by {axis}", one[f"{kind}_exponent"], -1.0, 1.1)
        for axis, one in found["growth"].items()
        for kind in ("time", "memory")
    ]
    return result + [row(what, found["start"][key], 0.0, limit) for key, what, limit in START]
