"""Conclusions from one experiment of the landing gear: the sign of theta16, and whether the model is adequate.

The sensitivity of the sign to the fixed parameters is examined with the displacement given, by experiment, with all of
them under priors: mass, damping and friction are as uncertain as after a test of the gear without gas, the amount of
gas and its heat capacity as after filling by a manometer. theta2, theta7 and theta12, zero in this gear, stay fixed.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

import bayesperiodic as bp
from studies.common import each
from studies.landing_gear.identification import DISPLACEMENT, FIXED, PRIORS, TIED, Identified, fold
from studies.landing_gear.rig import GEAR, TRUTHS, Run, measure

POSITIVE, NEGATIVE, UNDETERMINED = "positive", "negative", "undetermined"
ONE_SIGN, MONTE_CARLO_ERRORS = 0.975, 3.0
CONDUCTION = "theta16"
FALSE_ALARM = 0.01


@dataclass(frozen=True)
class Verdict:
    """Verdicts on one experiment."""

    identified: Identified
    identifiability: bp.Identifiability
    misspecified: bool  # At a false-alarm rate of 1 % per experiment
    p: float  # p-value of the misfit

    @property
    def p_negative(self) -> tuple[float, float]:
        """P(theta16 < 0) and its Monte Carlo error."""
        table = self.identifiability.table
        return float(table["p_negative"][CONDUCTION]), float(table["p_negative_mcse"][CONDUCTION])

    @property
    def sign(self) -> str:
        """Its sign; "undetermined" by the rule of `bp.identifiability`: above 2.5 % for either by three errors."""
        negative, error = self.p_negative
        if max(negative, 1.0 - negative) < ONE_SIGN - MONTE_CARLO_ERRORS * error:
            return UNDETERMINED
        return NEGATIVE if negative > 0.5 else POSITIVE


def judge(identified: Identified) -> Verdict:
    """Return the verdict on an experiment whose posterior was sampled."""
    assert identified.posterior is not None
    stated, fit, posterior = identified.problem, identified.fit, identified.posterior
    found = bp.identifiability(stated, fit, posterior, profile=False, candidates=[])
    table = bp.predict(stated, posterior).table
    return Verdict(identified, found, str(table["verdict"]["all"]) == "misspecified", float(table["p"]["all"]))


def account(verdict: Verdict) -> dict[str, Any]:
    """Return the entries of results.json on an experiment."""
    identified = verdict.identified
    posterior = identified.posterior
    assert posterior is not None
    negative, error = verdict.p_negative
    table = posterior.summary()
    return laplace(identified) | {
        "posterior": {
            name: {key: float(table[key][name]) for key in ("mean", "sd", "q05", "q50", "q95")}
            for name in identified.problem.names
        },
        "p_negative": negative,
        "p_negative_mcse": error,
        "sign": verdict.sign,
        "identifiability": verdict.identifiability.verdicts,
        "misspecified": verdict.misspecified,
        "misfit_p": verdict.p,
        "converged": posterior.converged,
        "log_posterior_calls": posterior.log_posterior_calls,
        "failures": posterior.failures,
        "seconds": identified.seconds,
    }


def laplace(identified: Identified) -> dict[str, Any]:
    """Return the entries of results.json on a MAP estimate."""
    fit = identified.fit
    return {
        "status": fit.status,
        "map": fit.theta,
        "laplace_sd": fit.sd,
        "robust_sd": fit.robust_sd,
        "p_negative_laplace": {
            name: float(ndtr(-fit.theta[name] / fit.sd[name])) for name in fit.theta if name.startswith(CONDUCTION)
        },
        "whiteness_p": {channel: w.p for channel, w in fit.whiteness.items()},
        "noise_split": {
            channel: {"measurement": split.measurement, "model": split.model}
            for channel, split in fit.noise_split.items()
        },
        "input_noise": fit.input_noise,
        "doubling_shift": {name: _finite(shift) for name, shift in fit.doubling_shift.items()},
    }


def line(name: str, verdict: Verdict) -> str:
    """Return the text to print on an experiment."""
    fit, (negative, error) = verdict.identified.fit, verdict.p_negative
    adequacy = "misspecified" if verdict.misspecified else "adequate"
    if "scale" in fit.noise:
        size = f"scale of the errors {fit.noise['scale']:.2f}"
    else:
        split = fit.noise_split["force"]
        size = f"force: noise {split.measurement:.1f} N, model error {split.model:.1f} N"
    return (
        f"{name:>14s}: theta16 {fit.theta[CONDUCTION]:8.3f} ± {fit.sd[CONDUCTION]:.3f} W/K, "
        f"P(< 0) = {negative:.4f} ± {error:.4f} (Laplace {ndtr(-fit.theta[CONDUCTION] / fit.sd[CONDUCTION]):.4f}), "
        f"{verdict.sign}, {adequacy}; {size}"
    )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


SPREADS = {
    "theta1": 0.05, "theta3": 0.1, "theta5": 0.05, "theta8": 0.3, "theta9": 0.3, "theta10": 0.3, "theta15": 0.1,
}  # fmt: skip
WALL = bp.Normal(GEAR["theta17"], 5.0)
OTHERS = {name: bp.LogNormal(GEAR[name], spread) for name, spread in SPREADS.items()} | {"theta17": WALL}
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 24, "variances": "collapsed", "progress": False}
# Fewer draws than the stop rule requires; their effective number is reported.
STEPS, QUICK_STEPS = 2000, 250


def examine_all(runs: Sequence[Run], truth: str, seed: int, *, quick: bool) -> dict[str, dict[str, Any]]:
    """Return the results of every experiment with the other parameters under priors."""
    tasks = [(run, truth, seed, quick) for run in runs]
    return dict(zip([run.name for run in runs], each(examine, tasks, here=quick), strict=True))


def examine(run: Run, truth: str, seed: int, quick: bool) -> dict[str, Any]:
    """Return theta16 and its sign, by draws and by the Laplace approximation."""
    stated = problem(fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT))
    with warnings.catch_warnings():
        # The warning on the wall's temperature, which the priors determine.
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
    """Return the text to print, with the posteriors at fixed other parameters."""
    lines = ["  the other parameters under priors: theta16 [W/K] and P(< 0), beside those with the others fixed"]
    for name, one in found.items():
        other = fixed[name]
        lines.append(
            f"    {name:>14s}: {one['mean']:8.3f} ± {one['sd']:.3f}, {one['p_negative']:.3f}; fixed "
            f"{other['posterior'][CONDUCTION]['mean']:8.3f} ± {other['posterior'][CONDUCTION]['sd']:.3f}, "
            f"{other['p_negative']:.3f}"
        )
    return "\n".join(lines)
