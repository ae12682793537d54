"""How much the sign of theta16 leans on the parameters that are held at their values: all of them under priors.

Experiment by experiment, the displacement given. Mass, damping and friction are as uncertain as after a test of the
gear without gas, its amount and heat capacity as after filling it by a manometer. theta2, theta7 and theta12, zero in
this gear, stay fixed.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.landing_gear.identification import DISPLACEMENT, FIXED, PRIORS, TIED, fold
from studies.landing_gear.rig import Run, measure
from studies.landing_gear.truth import GEAR, TRUTHS
from studies.landing_gear.verdicts import CONDUCTION
from studies.tasks import each

SPREADS = {
    "theta1": 0.05, "theta3": 0.1, "theta5": 0.05, "theta8": 0.3, "theta9": 0.3, "theta10": 0.3, "theta15": 0.1,
}  # fmt: skip
WALL = bp.Normal(GEAR["theta17"], 5.0)
OTHERS = {name: bp.LogNormal(GEAR[name], spread) for name, spread in SPREADS.items()} | {"theta17": WALL}
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 24, "variances": "collapsed", "progress": False}
# Fewer draws than the stop rule asks for; what they are worth is reported.
STEPS, QUICK_STEPS = 2000, 250


def examine_all(runs: Sequence[Run], truth: str, seed: int, *, quick: bool) -> dict[str, dict[str, Any]]:
    """Return what every experiment says with the other parameters under priors."""
    tasks = [(run, truth, seed, quick) for run in runs]
    return dict(zip([run.name for run in runs], each(examine, tasks, here=quick), strict=True))


def examine(run: Run, truth: str, seed: int, quick: bool) -> dict[str, Any]:
    """Return theta16 and its sign, by draws and by the Laplace approximation."""
    stated = problem(fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT))
    with warnings.catch_warnings():
        # Of the wall's temperature, which the priors hold.
        warnings.filterwarnings("ignore", "The data do not change under")
        fit = bp.map_estimate(stated, progress=False)
    posterior = bp.sample(stated, fit, seed=seed, max_steps=QUICK_STEPS if quick else STEPS, **SAMPLING)
    table = bp.identifiability(stated, fit, posterior, profile=False, candidates=[]).table
    drawn = posterior.draws(CONDUCTION)
    return {
        "status": fit.status,
        "map": fit.theta[CONDUCTION],
        "laplace_sd": fit.sd[CONDUCTION],
        "mean": float(drawn.mean()),
        "sd": float(drawn.std()),
        "interval_90": np.quantile(drawn, [0.05, 0.95]).tolist(),
        "p_negative": float(table["p_negative"][CONDUCTION]),
        "p_negative_mcse": float(table["p_negative_mcse"][CONDUCTION]),
        "ess": float(posterior.summary()["ess"][CONDUCTION]),
        "stop_rule": posterior.converged,
    }


def problem(experiment: bp.Experiment) -> bp.Problem:
    """Return the problem of all parameters but those that are zero."""
    return bp.Problem(
        bp.models.landing_gear(DISPLACEMENT),
        [experiment],
        priors=PRIORS | OTHERS,
        fixed={name: value for name, value in FIXED.items() if name not in OTHERS},
        tied=TIED,
        noise=bp.noise.Independent(per="experiment"),
    )


def table(found: Mapping[str, Mapping[str, Any]], fixed: Mapping[str, Mapping[str, Any]]) -> str:
    """Return what is printed, beside the posteriors with the others fixed."""
    lines = ["  the other parameters under priors: theta16 [W/K] and P(< 0), beside those with the others fixed"]
    for name, one in found.items():
        other = fixed[name]
        lines.append(
            f"    {name:>14s}: {one['mean']:8.3f} ± {one['sd']:.3f}, {one['p_negative']:.3f}; fixed "
            f"{other['posterior'][CONDUCTION]['mean']:8.3f} ± {other['posterior'][CONDUCTION]['sd']:.3f}, "
            f"{other['p_negative']:.3f}"
        )
    return "\n".join(lines)
