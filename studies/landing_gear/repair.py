"""Better models for truth B of the landing gear study, compared by their predictions of held-out experiments.

Each model is fitted to three quarters of the experiments, with common theta4, theta6 and theta16, and predicts the
others. The score of an experiment is the log-density of its data at the estimate, its variances integrated out,
−½ Σ n ln(M/n) up to a constant common to all models: n counts the independent values of a channel, M is its sum of
squared errors. Errors are correlated along a period, so scores are compared between models by experiment, and the
scatter over experiments gives the standard error of the mean difference.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

import bayesperiodic as bp
from studies import common
from studies.landing_gear import identification
from studies.landing_gear.identification import CONDUCTION, DISPLACEMENT, fold
from studies.landing_gear.rig import NOISE, RECORDED, RUNS, STRENGTHS, TRUTHS, damper, measure

PAPER, BEST = "eq. (9)", "all four"
MODELS: dict[str, frozenset[str]] = {
    PAPER: frozenset(),
    "pressure line": frozenset({"line"}),
    "lost motion": frozenset({"flexure"}),
    BEST: TRUTHS["B"],
}
QUICK_MODELS = (PAPER, "lost motion")
# The static load is the reference of the flexure, not a property of the gear.
EFFECT_PRIORS = {
    "flexibility": bp.LogNormal(5e-8, 1.0),
    "delay": bp.Normal(0.0, 1e-3),
    "convection_speed": bp.LogNormal(2.0, 1.0),
    "heat_share": bp.Uniform(0.0, 1.0),
}
KNOWN = {"static_load": STRENGTHS["flexure"]["static_load"]}
FOLDS, QUICK_FOLDS = 4, 2
SCHEME = "central4"


class Task(NamedTuple):
    """One fit."""

    model: str
    runs: tuple[str, ...]  # Names of experiments
    held_out: tuple[str, ...]  # Without any, theta16 is local to each experiment
    seed: int


class Fitted(NamedTuple):
    """Results of a fit."""

    task: Task
    status: str
    theta: dict[str, float]
    sd: dict[str, float]
    scores: dict[str, float]  # Of the experiments held out
    errors: dict[str, dict[str, float]]  # Root mean square prediction error, by experiment and channel


def repair(names: Sequence[str], seed: int, *, quick: bool) -> list[Fitted]:
    """Return the fits of all models without each fold of the experiments, and of the first and last with all."""
    folds = QUICK_FOLDS if quick else FOLDS
    models = QUICK_MODELS if quick else tuple(MODELS)
    tasks = []
    for k in range(folds):
        held_out = tuple(names[k::folds])
        rest = tuple(name for name in names if name not in held_out)
        tasks += [Task(model, rest, held_out, seed) for model in models]
    if quick:
        return [fit(task) for task in tasks]
    # The longest first.
    tasks = [Task(model, tuple(names), (), seed) for model in (BEST, PAPER)] + tasks[::-1]
    return list(common.each(fit, [(task,) for task in tasks]))


def fit(task: Task) -> Fitted:
    """Return one fit, and how it predicts the experiments held out."""
    found = bp.map_estimate(problem(task, task.runs), progress=False)
    scores, errors = {}, {}
    for name in task.held_out:
        scores[name], errors[name] = score(problem(task, (name,)), found.theta)
    return Fitted(task, found.status, dict(found.theta), dict(found.sd), scores, errors)


def problem(task: Task, names: Sequence[str]) -> bp.Problem:
    """Return the problem of some experiments under a model."""
    model = damper(MODELS[task.model])
    recordings = [measure(run, TRUTHS["B"], task.seed) for run in RUNS if run.name in names]
    return identification.problem(
        [fold(recording, DISPLACEMENT) for recording in recordings],
        DISPLACEMENT,
        one_conduction=bool(task.held_out),
        model=model,
        priors=identification.PRIORS | {n: prior for n, prior in EFFECT_PRIORS.items() if n in model.parameters},
        fixed=identification.FIXED | {name: value for name, value in KNOWN.items() if name in model.parameters},
        scheme=SCHEME,
    )


def score(one: bp.Problem, theta: Mapping[str, float]) -> tuple[float, dict[str, float]]:
    """Return the score of the only experiment of a problem, and the root mean square errors by channel."""
    (experiment,) = one.experiments
    predicted, converged = one.outputs(np.array([[theta[name] for name in one.names]]))
    if not converged.all():
        return -np.inf, dict.fromkeys(experiment.outputs, np.inf)
    total, errors = 0.0, {}
    for channel, values in experiment.outputs.items():
        error = experiment.project(channel, values - predicted[experiment.name][channel][0])
        square = float(np.mean(error**2))
        total -= 0.5 * experiment.independent[channel] * np.log(square)
        errors[channel] = float(np.sqrt(square))
    return total, errors


def account(fits: Sequence[Fitted]) -> dict[str, Any]:
    """Return the entries of results.json: scores by model, differences from eq. (9), theta16 with all experiments."""
    noise = {
        c: NOISE[c] * float(np.sqrt((2 * identification.KEPT[DISPLACEMENT][c] + 1) / RECORDED))
        for c in ("force", "pressure")
    }
    found: dict[str, Any] = {"noise_of_the_mean": noise, "models": {}, "theta16": {}}
    by_model = {model: [one for one in fits if one.task.model == model] for model in MODELS}
    every = {m: {name: v for one in own for name, v in one.scores.items()} for m, own in by_model.items() if own}
    for model, scores in every.items():
        held_out = [one for one in by_model[model] if one.task.held_out]
        gain = np.array([scores[name] - value for name, value in every[PAPER].items()])
        errors = {name: by_channel for one in held_out for name, by_channel in one.errors.items()}
        found["models"][model] = {
            "effects": sorted(MODELS[model]),
            "status": [one.status for one in held_out],
            "scores": scores,
            "gain_over_eq_9": [float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(gain.size))],
            "errors_held_out": errors,
            "experiments_predicted_better": int(np.sum(gain > 0.0)),
            "rms_error": {c: float(np.sqrt(np.mean([e[c] ** 2 for e in errors.values()]))) for c in noise},
        }
        for one in (one for one in by_model[model] if not one.task.held_out):
            names = [name for name in one.theta if name.startswith(CONDUCTION)]
            found["theta16"][model] = {
                "status": one.status,
                "estimates": {name: [one.theta[name], one.sd[name]] for name in names},
                "p_negative_laplace": {name: float(ndtr(-one.theta[name] / one.sd[name])) for name in names},
                "others": {n: [v, one.sd[n]] for n, v in one.theta.items() if n not in names},
            }
    return found


def table(found: Mapping[str, Any]) -> str:
    """Return the comparison to print."""
    rows = {}
    for model, one in found["models"].items():
        gain, error = one["gain_over_eq_9"]
        rows[model] = one["rms_error"] | {
            "gain": gain, "its error": error, "better in": one["experiments_predicted_better"]
        }  # fmt: skip
    lines = [common.shown("rms error held out, mean gain over eq. (9) of the score of an experiment", rows)]
    statuses = [status for one in found["models"].values() for status in one["status"]]
    statuses += [one["status"] for one in found["theta16"].values()]
    lines.append(f"  {statuses.count('converged')} of {len(statuses)} fits converged")
    for model, one in found["theta16"].items():
        chances = one["p_negative_laplace"].values()
        lines.append(f"  {model}: theta16 negative with P > 99 % in {sum(p > 0.99 for p in chances)} of {len(chances)}")
    return "\n".join(lines)
