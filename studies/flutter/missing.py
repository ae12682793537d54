"""Which terms the model of the flutter rig lacks, and how the cycles that were left out are predicted with them."""

import warnings
from typing import Any

import bayesperiodic as bp
from studies.flutter import questions, rig

MOST = 4


def search(both: rig.Fitted, speeds: rig.Speeds, *, quick: bool) -> dict[str, Any]:
    """Return the terms that were added, and the errors of the amplitudes with 0, 1, … of them.

    Terms of the sensors are left out of the search: these have free scales and offsets.
    """
    found = bp.missing_terms(both.problem, both.fit, outputs=False, max_terms=1 if quick else MOST)
    steps = [
        {
            "term": step.term, "place": step.place, "alternatives": list(step.alternatives), "p_white": step.p_white,
            "unexplained": step.unexplained, "verdict": step.verdict, "evidence_gain": step.evidence_gain,
            "coefficient": step.coefficient, "robust_sd": step.robust_sd,
        }
        for step in found.steps
    ]  # fmt: skip
    fitted = [(found.problem(k), found.fit(k)) for k in range(len(steps) + 1)]
    models = [{"errors_rms": _rms(_errors(problem, fit)), **_left_out(problem, fit, speeds)} for problem, fit in fitted]
    return {"candidates": found.tested, "steps": steps, "models": models, "stopped": found.stopped}


def line(found: dict[str, Any]) -> str:
    """Return the text to print."""
    lines = [f"missing terms, of {found['candidates']} candidates; errors of the amplitudes, rms:"]
    for k, model in enumerate(found["models"]):
        step = found["steps"][k - 1] if k else {"term": "model as it is", "place": ""}
        where = f" in {step['place']}" if step["place"] else ""
        lines.append(
            f"  {step['term']}{where}: fitted cycles {_percent(model['errors_rms'])}, left out "
            f"{_percent(model['left_out_rms'])}, {model['without_a_cycle']} without a cycle"
        )
    return "\n".join([*lines, f"  {found['stopped']}"])


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _estimate(problem: bp.Problem, start: dict[str, float], near: bp.MapEstimate) -> bp.MapEstimate:
    guesses = {e.name: near.solutions[e.name].states for e in problem.experiments}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return bp.map_estimate(problem.anchored(start, guesses), start=start, checks=False, progress=False)


def _errors(problem: bp.Problem, fit: bp.MapEstimate) -> dict[str, dict[str, float]]:
    """Return the relative errors of the amplitudes of the fitted cycles."""
    found = {}
    for e in problem.experiments:
        measured = questions.sizes(e.outputs)
        found[e.name] = {c: v / measured[c] - 1.0 for c, v in questions.sizes(fit.solutions[e.name].outputs).items()}
    return found


def _left_out(problem: bp.Problem, fit: bp.MapEstimate, speeds: rig.Speeds) -> dict[str, Any]:
    """Return the errors of cycles that were left out of the fit, those of a wind speed at a time."""
    found: dict[str, dict[str, float] | None] = {}
    states = {name: solution.states for name, solution in fit.solutions.items()}
    whole = problem.anchored(fit.theta, states)
    for group in questions.groups(speeds):
        rest = problem.with_experiments([e for e in problem.experiments if e.name not in group])
        try:
            other = _estimate(rest, fit.theta, fit)
        except ValueError:
            found |= dict.fromkeys(group)
            continue
        outputs, there = whole.outputs(whole.vector(other.theta)[None])
        for e in problem.experiments:
            if e.name in group:
                predicted = questions.sizes({c: own[0] for c, own in outputs[e.name].items()})
                measured = questions.sizes(e.outputs)
                found[e.name] = {c: predicted[c] / measured[c] - 1.0 for c in measured} if there[0] else None
    known = {name: one for name, one in found.items() if one}
    return {"left_out": found, "left_out_rms": _rms(known), "without_a_cycle": len(found) - len(known)}


def _rms(found: dict[str, dict[str, float]]) -> float | None:
    values = [value for one in found.values() for value in one.values()]
    return (sum(value**2 for value in values) / len(values)) ** 0.5 if values else None
