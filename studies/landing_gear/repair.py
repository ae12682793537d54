"""Better models for truth B of the landing gear study, compared by their predictions of held-out experiments.

Each model is fitted to three quarters of the experiments, with common theta4, theta6 and theta16, and predicts the
others. The score of an experiment is the log-density of its data at the estimate, its variances integrated out,
−½ Σ n ln(M/n) up to a constant common to all models: n counts the independent values of a channel, M is its sum of
squared errors. Errors are correlated along a period, so scores are compared between models by experiment, and the
scatter over experiments gives the standard error of the mean difference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

import bayesperiodic as bp
from studies.common import each
from studies.landing_gear.identification import DISPLACEMENT, FIXED, KEPT, PRIORS, TIED, fold
from studies.landing_gear.rig import NOISE, RECORDED, RUNS, STRENGTHS, TRUTHS, damper, measure

PAPER, BEST = "eq. (9)", "all four"
MODELS: dict[str, frozenset[str]] = {
    PAPER: frozenset(),
    "pressure line": frozenset({"line"}),
    "lost motion": frozenset({"flexure"}),
    BEST: TRUTHS["B"],
}
QUICK_MODELS = (PAPER, "lost motion")
# The static load is what the flexure is counted from, not a property of the gear.
EFFECT_PRIORS = {
    "flexibility": bp.LogNormal(5e-8, 1.0),
    "delay": bp.Normal(0.0, 1e-3),
    "convection_speed": bp.LogNormal(2.0, 1.0),
    "heat_share": bp.Uniform(0.0, 1.0),
}
KNOWN = {"static_load": STRENGTHS["flexure"]["static_load"]}
FOLDS, QUICK_FOLDS = 4, 2
SCHEME = "central4"
CONDUCTION = "theta16"


@dataclass(frozen=True)
class Task:
    """One fit.

    `runs, held_out`: Names of experiments; without any held out, theta16 is each experiment's own.
    """

    model: str
    runs: tuple[str, ...]
    held_out: tuple[str, ...]
    truth: str
    seed: int


@dataclass(frozen=True)
class Fitted:
    """Results of a fit."""

    task: Task
    status: str
    theta: dict[str, float]
    sd: dict[str, float]
    scores: dict[str, float]  # Of the experiments held out
    errors: dict[str, dict[str, float]]  # Root mean square prediction error, by experiment and channel


def repair(names: Sequence[str], truth: str, seed: int, *, quick: bool) -> list[Fitted]:
    """Return the fits of all models without each fold of the experiments, and of the first and last with all."""
    folds = QUICK_FOLDS if quick else FOLDS
    models = QUICK_MODELS if quick else tuple(MODELS)
    tasks = []
    for k in range(folds):
        held_out = tuple(names[k::folds])
        rest = tuple(name for name in names if name not in held_out)
        tasks += [Task(model, rest, held_out, truth, seed) for model in models]
    if quick:
        return [fit(task) for task in tasks]
    # The longest first.
    tasks = [Task(model, tuple(names), (), truth, seed) for model in (BEST, PAPER)] + tasks[::-1]
    return list(each(fit, [(task,) for task in tasks]))


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
    recordings = [measure(run, TRUTHS[task.truth], task.seed) for run in RUNS if run.name in names]
    return bp.Problem(
        model,
        [fold(recording, DISPLACEMENT) for recording in recordings],
        priors=PRIORS | {name: prior for name, prior in EFFECT_PRIORS.items() if name in model.parameters},
        fixed=FIXED | {name: value for name, value in KNOWN.items() if name in model.parameters},
        tied=TIED,
        local=[] if task.held_out else [CONDUCTION],
        noise=bp.noise.Independent(per="experiment"),
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
    kept = {channel: 2 * KEPT[DISPLACEMENT][channel] + 1 for channel in ("force", "pressure")}
    noise = {channel: NOISE[channel] * float(np.sqrt(count / RECORDED)) for channel, count in kept.items()}
    found: dict[str, Any] = {"noise_of_the_mean": noise, "models": {}, "theta16": {}}
    of_paper = _scores(fits, PAPER)
    done = {one.task.model for one in fits}
    for model in (name for name in MODELS if name in done):
        held_out = [one for one in fits if one.task.model == model and one.task.held_out]
        scores = _scores(fits, model)
        gain = np.array([scores[name] - of_paper[name] for name in of_paper])
        errors = {name: by_channel for one in held_out for name, by_channel in one.errors.items()}
        found["models"][model] = {
            "effects": sorted(MODELS[model]),
            "status": [one.status for one in held_out],
            "scores": scores,
            "gain_over_eq_9": [float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(gain.size))],
            "errors_held_out": errors,
            "experiments_predicted_better": int(np.sum(gain > 0.0)),
            "rms_error": {
                channel: float(np.sqrt(np.mean([e[channel] ** 2 for e in errors.values()])))
                for channel in next(iter(errors.values()))
            },
        }
    for one in sorted(fits, key=lambda one: list(MODELS).index(one.task.model)):
        if not one.task.held_out:
            names = [name for name in one.theta if name.startswith(CONDUCTION)]
            found["theta16"][one.task.model] = {
                "status": one.status,
                "estimates": {name: [one.theta[name], one.sd[name]] for name in names},
                "p_negative_laplace": {name: float(ndtr(-one.theta[name] / one.sd[name])) for name in names},
                "others": {n: [v, one.sd[n]] for n, v in one.theta.items() if n not in names},
            }
    return found


def _scores(fits: Sequence[Fitted], model: str) -> dict[str, float]:
    return {name: value for one in fits if one.task.model == model for name, value in one.scores.items()}


def table(found: Mapping[str, Any]) -> str:
    """Return the comparison as lines to print."""
    lines = [f"  {'model':16s}gain over eq. (9) an experiment   better in   rms error held out: force, pressure"]
    for model, one in found["models"].items():
        gain, error = one["gain_over_eq_9"]
        rms = one["rms_error"]
        lines.append(
            f"  {model:16s}{gain:17.1f} ± {error:<10.1f}{one['experiments_predicted_better']:11d}"
            f"{rms['force']:25.1f} N {1e-3 * rms['pressure']:8.2f} kPa"
        )
    for model, one in found["theta16"].items():
        negative = sum(p > 0.99 for p in one["p_negative_laplace"].values())
        lines.append(
            f"  {model}: theta16 negative with P > 99 % in {negative} of {len(one['p_negative_laplace'])} experiments"
        )
    return "\n".join(lines)
