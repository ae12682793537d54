"""What `bp.missing_terms` finds in eq. (9) for the data of both truths, all experiments with one theta16.

In truth B the missing terms are known. The effect of each on the outputs is that of a hundredth of it at the estimate:
strong ones change the mean temperature, for which theta16 of the estimate has already made up. It is compared with that
of the candidates and of the terms that the search adds: the fraction of the effect, in units of the residual's standard
deviations and less what the parameters can do instead, that the term explains (cos²).
"""

import time
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

import bayesperiodic as bp
from studies import common
from studies.landing_gear import identification
from studies.landing_gear.identification import DISPLACEMENT, FIXED, fold
from studies.landing_gear.rig import RUNS, STRENGTHS, TRUTHS, Run, damper, measure

SCHEME = "central4"
MOST, SHOWN, QUICK_SHOWN = 3, 30, 5
# Candidates that are fitted: of the truth B the best seven explain nearly the same before a fit.
KEEP = 8
ALL = "all four"
EFFECTS: dict[str, frozenset[str]] = {effect: frozenset({effect}) for effect in STRENGTHS} | {ALL: TRUTHS["B"]}
# Widths of smooth signs [1] relative to their argument's standard deviation, as in `bp.missing_terms`.
SIGN_WIDTH = 0.2
PART = 0.01
# Share (cos²) from which on a step counts as a missing effect in another name.
SAME = 0.95


def replicate(task: tuple[str, int]) -> dict[str, Any]:
    """Return the first step of the search in the data of a seed, and the share of each missing effect in it."""
    truth, seed = task
    found = search(truth, seed, quick=False, most=1, shown=1)
    step = found["steps"][0] if found["steps"] else {"term": None}
    shares = {effect: own["steps_shares"][0] for effect, own in found["effects"].items() if own["steps_shares"]}
    return {
        "truth": truth, "seed": seed, "source": source(), "first": step["term"], "shares": shares,
        "stopped": found["stopped"],
    }  # fmt: skip


def source() -> str:
    """Return a key that identifies the version of the replicates."""
    return common.source_key(__file__)


def counted(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return by truth how many first steps are a missing effect, and how many searches added nothing."""
    return {
        truth: {
            "count": len(own),
            "nothing": sum(line["first"] is None for line in own),
            "one_of_the_effects": sum(_nearest(line)[1] >= SAME for line in own),
            "which": {
                effect: sum(_nearest(line)[0] == effect and _nearest(line)[1] >= SAME for line in own)
                for effect in STRENGTHS
            },
            "terms": dict(Counter(line["first"] for line in own if line["first"] is not None)),
        }
        for truth in TRUTHS
        if (own := [line for line in lines if line["truth"] == truth])
    }


def _nearest(line: Mapping[str, Any]) -> tuple[str, float]:
    """Return the single effect with which the first step has most in common, and that share."""
    single = {effect: share for effect, share in line["shares"].items() if effect in STRENGTHS}
    return max(single.items(), key=lambda item: item[1], default=("", 0.0))


def search(
    truth: str, seed: int, *, quick: bool, runs: Sequence[Run] = RUNS, most: int = MOST, shown: int = SHOWN
) -> dict[str, Any]:
    """Return the ranking, the steps, and what they have in common with the terms that the truth has."""
    experiments = [fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT) for run in runs]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = identification.estimate(experiments, DISPLACEMENT, one_conduction=True, scheme=SCHEME)
        begin = time.perf_counter()
        found = bp.missing_terms(start.problem, start.fit, max_terms=0 if quick else most, keep=KEEP)
        seconds = time.perf_counter() - begin
        table = found.ranking.head(QUICK_SHOWN if quick else shown)
        rows = [(row["place"], row["term"], row["lag"]) for _, row in table.iterrows()]
        steps = [(step.place, step.term, step.lag) for step in found.steps]
        matches = compare(start, rows, steps) if truth == "B" else {}
    return {
        "experiments": len(experiments),
        "candidates": found.tested,
        "seconds": seconds,
        "before": _described(found.before),
        "steps": [_described(step) for step in found.steps],
        "dropped": list(found.dropped),
        "refused": {name: why for name, why in found.refused.items() if "parameters" not in why},
        "stopped": found.stopped,
        "ranking": [
            {"term": f"{row['term']} in {row['place']}", "explains": row["explains"], "p_adjusted": row["p_adjusted"]}
            for _, row in table.iterrows()
        ],
        "effects": matches,
    }


def _described(step: Any) -> dict[str, Any]:
    names = ("alternatives", "worse", "coefficient", "robust_sd", "lag", "lag_sd", "unexplained", "verdict", "held_out")
    return {"term": f"{step.term} in {step.place}" if step.term else ""} | {n: getattr(step, n) for n in names}


def compare(
    start: identification.Identified, ranked: Sequence[tuple[str, str, float]], steps: Sequence[tuple[str, str, float]]
) -> dict[str, Any]:
    """Return by effect what it is of the misfit, the best candidates of those ranked, and the share of the steps."""
    terms = list(dict.fromkeys([*ranked, *steps]))
    moved, residual = columns(start, terms), _joined(start, start.fit.residuals)
    basis, _ = np.linalg.qr(moved["parameters"].T)

    def left(values: np.ndarray) -> np.ndarray:
        return values - (values @ basis) @ basis.T

    candidates, effects, misfit = left(moved["terms"]), left(moved["effects"]), left(residual)
    found = {}
    for name, effect in zip(EFFECTS, effects, strict=True):
        shares = [_share(candidates[i : i + 1], effect) for i in range(len(terms))]
        best = int(np.argmax(shares[: len(ranked)]))
        added = candidates[[terms.index(step) for step in steps]]
        found[name] = {
            "of_the_misfit": _share(effect[None], misfit),
            "best": f"{ranked[best][1]} in {ranked[best][0]}",
            "best_rank": best + 1,
            "best_share": shares[best],
            "first_share": shares[0],
            "steps_shares": [shares[terms.index(step)] for step in steps],
            "all_steps_share": _share(added, effect) if steps else 0.0,
        }
    return found


def _share(columns: np.ndarray, vector: np.ndarray) -> float:
    """Return the fraction of a vector's square that columns explain (cos² for a single one)."""
    basis, _ = np.linalg.qr(columns.T)
    return float(np.sum((basis.T @ vector) ** 2) / (vector @ vector))


def columns(start: identification.Identified, terms: Sequence[tuple[str, str, float]]) -> dict[str, np.ndarray]:
    """Return the changes of the outputs by free parameters, terms, and the effects of truth B, (directions, size)."""
    fit, experiments = start.fit, start.problem.experiments
    gear = FIXED | fit.theta
    gear["theta11"] = -1e5 * gear["theta4"]
    model, lags = with_terms(terms, {e.name: fit.solutions[e.name].states["T"] for e in experiments}, experiments)
    names = [f"c{i}" for i in range(len(terms))]
    values = gear | dict.fromkeys(names, 0.0) | lags
    here: dict[str, bp.PeriodicSolution] = {}
    there: dict[str, dict[str, bp.PeriodicSolution]] = {}
    for e in experiments:
        settings: dict[str, Any] = {
            "inputs": e.inputs,
            "frequency": e.frequency,
            "samples": e.samples,
            "scheme": SCHEME,
        }
        here[e.name] = bp.solve_periodic(model, values, **settings)
        there[e.name] = {
            name: bp.solve_periodic(damper(effects), gear | _strengths(effects), **settings)
            for name, effects in EFFECTS.items()
        }

    def by(*weights: tuple[str, float]) -> np.ndarray:
        return _joined(start, {
            e.name: {c: sum(w * here[e.name].sensitivities[c][n] for n, w in weights) for c in e.outputs}
            for e in experiments
        })  # fmt: skip

    parameters = [by(("theta4", 1.0), ("theta11", -1e5)), by(("theta6", 1.0)), by(("theta16", 1.0))]
    changes = [
        _joined(start, {
            e.name: {c: there[e.name][effect].outputs[c] - here[e.name].outputs[c] for c in e.outputs}
            for e in experiments
        })
        for effect in EFFECTS
    ]  # fmt: skip
    return {
        "parameters": np.array(parameters), "terms": np.array([by((n, 1.0)) for n in names]),
        "effects": np.array(changes),
    }  # fmt: skip


def _strengths(effects: Iterable[str]) -> dict[str, float]:
    """Return the parameters of a small part of the effects: the convection is the inverse of its speed."""
    values = {name: value for effect in effects for name, value in STRENGTHS[effect].items()}
    powers = {"static_load": 0, "convection_speed": -1}
    return {name: value * PART ** powers.get(name, 1) for name, value in values.items()}


def _joined(start: identification.Identified, values: Mapping[str, Mapping[str, Any]]) -> np.ndarray:
    """Return histories of all experiments within the kept harmonics, in standard deviations of the residual."""
    fit, parts = start.fit, []
    for e in start.problem.experiments:
        for channel, history in values[e.name].items():
            rms = np.sqrt(np.mean(fit.residuals[e.name][channel] ** 2))
            parts.append(e.project(channel, history) / rms)
    return np.concatenate(parts)


def with_terms(
    terms: Sequence[tuple[str, str, float]], temperatures: Mapping[str, np.ndarray], experiments: Sequence[Any]
) -> tuple[bp.Model, dict[str, float]]:
    """Return eq. (9) with coefficients c0, c1, … of terms given by place, text and lag, and the lags by name."""
    base = bp.models.landing_gear(DISPLACEMENT)
    deviations = {"T": float(np.std(np.concatenate(list(temperatures.values()))))}
    moved = [np.fft.irfft(np.fft.rfft(e.inputs[DISPLACEMENT])[:4], e.samples) for e in experiments]
    speeds = [np.gradient(x) * e.samples * e.frequency for x, e in zip(moved, experiments, strict=True)]
    deviations["displacement"] = float(np.std(np.concatenate(moved)))
    deviations["ddisplacement"] = float(np.std(np.concatenate(speeds)))
    memory = {i: f"memory{i}" for i, (_, text, _) in enumerate(terms) if text.startswith("lag(")}

    def expressions(s: Any, p: Any, u: Any) -> tuple[list[Any], dict[str, Any]]:
        names = {n: s[n] for n in ("T", "dT")} | {n: u[n] for n in ("displacement", "ddisplacement", "dddisplacement")}
        names |= {n: p[n] for n in base.parameters} | dict(zip(base.outputs, base.output_expressions, strict=True))
        outputs, (balance,) = dict(zip(base.outputs, base.output_expressions, strict=True)), base.equations
        equations = [balance]

        def sign(x: sp.Expr) -> sp.Expr:
            name = next(n for n, e in names.items() if e == x)
            return sp.tanh(x / (SIGN_WIDTH * deviations[name]))

        for i, (place, text, _) in enumerate(terms):
            forces: list[sp.Expr] = []
            state = s[memory[i]] if i in memory else None

            def lag(force: sp.Expr, forces: list[sp.Expr] = forces, state: Any = state) -> sp.Expr:
                forces.append(force)
                return state

            term = p[f"c{i}"] * sp.sympify(text, names | {"sign": sign, "abs": sp.Abs, "lag": lag})
            if place in outputs:
                outputs[place] += term
            else:
                equations[0] += term
            equations += [p[f"lag{i}"] * s[f"dmemory{i}"] + state - force for force in forces]
        return equations, outputs

    return bp.Model(
        "landing_gear_and_candidates", states=["T", *memory.values()], inputs=[DISPLACEMENT],
        parameters=[*base.parameters, *(f"c{i}" for i in range(len(terms))), *(f"lag{i}" for i in memory)],
        equations=lambda s, p, u: expressions(s, p, u)[0], outputs=lambda s, p, u: expressions(s, p, u)[1],
    ), {f"lag{i}": terms[i][2] for i in memory}  # fmt: skip


def table(truth: str, found: Mapping[str, Any]) -> str:
    """Return the text to print on a truth."""
    steps = {str(k): one | {"alternatives": len(one["alternatives"])} for k, one in enumerate(_models(found))}
    shown = ["term", "unexplained.force", "unexplained.pressure", "held_out", "coefficient", "robust_sd", "verdict"]
    lines = [common.shown(f"truth {truth}: {found['candidates']} candidates, {found['seconds']:.0f} s", steps, shown)]
    lines.append(found["stopped"])
    lines += [f"  {i}. {one['term']}: explains {one['explains']:.0%}" for i, one in enumerate(found["ranking"][:5], 1)]
    if found["effects"]:
        lines.append(common.shown("missing effects, and the share of each that terms explain", found["effects"], [
            "of_the_misfit", "first_share", "best_share", "best_rank", "all_steps_share", "best",
        ]))  # fmt: skip
    return "\n".join(lines)


def _models(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [found["before"], *found["steps"]]
