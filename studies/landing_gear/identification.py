"""Identification of theta4, theta6 and theta16 of the landing gear, per experiment as in the paper, and jointly.

The other parameters are fixed at their true values, and theta11 is tied to theta4 (it represents the ambient pressure).
The harmonics kept are fixed, so that the number of independent values does not depend on the noise. The verdicts on an
experiment are the sign of theta16 and the adequacy of the model.

The sensitivity of the sign to the fixed parameters is examined with all of them under priors: mass, damping and
friction are as uncertain as after a test of the gear without gas, the amount of gas and its heat capacity as after
filling by a manometer. theta2, theta7 and theta12, zero in this gear, stay fixed.
"""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtr

import bayesperiodic as bp
from studies.landing_gear.rig import GEAR, TRUTHS, Run, measure
from studies.timing import timed

DISPLACEMENT, FORCE = "displacement", "force"
DRIVES = (DISPLACEMENT, FORCE)
CONDUCTION = "theta16"
SAMPLES = 800
KEPT = {
    DISPLACEMENT: {"displacement": 3, "force": 60, "pressure": 20},
    FORCE: {"displacement": 40, "force": 60, "pressure": 40},
}
# Area and volume as known from drawings and a data sheet; of the conduction only the order of magnitude.
# Its median is off zero, where the mean temperature is undetermined and solves are at their worst.
PRIORS = {"theta4": bp.LogNormal(5.2e-3, 0.1), "theta6": bp.Normal(-2.3, 0.3), CONDUCTION: bp.Normal(3.0, 20.0)}
# The noise of a given displacement causes 1 to 9 % of the force's residual, 14 % at 6 Hz (standard deviations). With it
# integrated out estimates move by 0.06 standard deviations and these by 2 % at most, and the variances, 28 in a joint
# fit, would have to be sampled.
INPUT_NOISE = {DISPLACEMENT: "exact", FORCE: "measured"}
FIXED = {name: value for name, value in GEAR.items() if name not in (*PRIORS, "theta11")}
TIED = {"theta11": "-1e5*theta4"}
ENSEMBLES = 2
WALKERS, QUICK_WALKERS = 16, 8
MAX_STEPS, QUICK_STEPS = 20_000, 250


@dataclass(frozen=True)
class Identified:
    """Estimate and draws of one problem."""

    problem: bp.Problem
    fit: bp.MapEstimate
    posterior: Any = None  # bp.Posterior, None without draws
    seconds: float = 0.0  # Time of sampling


def fold(recording: bp.Recording, drive: str) -> bp.Experiment:
    """Return the mean period with the input that belongs to a direction."""
    signals = {**recording.inputs, **recording.outputs}
    given = {drive: signals.pop(drive)}
    turned = bp.Recording(recording.time, signals, given, name=recording.name, synthetic=recording.synthetic)
    return turned.fold(SAMPLES, harmonics=KEPT[drive])


def problem(
    experiments: Sequence[bp.Experiment], drive: str, *, one_conduction: bool = False, **changes: Any
) -> bp.Problem:
    """Return the problem of one experiment, or of several that share theta4 and theta6, and theta16 if it is one.

    `changes` replace arguments of `bp.Problem`.
    """
    settings: dict[str, Any] = {
        "model": bp.models.landing_gear(drive),
        "priors": PRIORS,
        "fixed": FIXED,
        "tied": TIED,
        "local": [] if one_conduction or len(experiments) == 1 else [CONDUCTION],
        "noise": bp.noise.Independent(per="experiment"),
        "input_noise": INPUT_NOISE[drive],
    } | changes
    return bp.Problem(experiments=experiments, **settings)


def estimate(experiments: Sequence[bp.Experiment], drive: str, **settings: Any) -> Identified:
    """Return MAP and Laplace approximation of a problem with these settings of `problem`."""
    stated = problem(experiments, drive, **settings)
    return Identified(stated, bp.map_estimate(stated, progress=False))


def draw(
    estimated: Identified, seed: int, *, quick: bool, max_steps: int = MAX_STEPS, executor: int | None = None
) -> Identified:
    """Return the same with draws of the posterior, the variances integrated out if the inputs are exact."""
    stated, fit = estimated.problem, estimated.fit
    exact = stated.input_noise == "exact"
    dimensions = len(stated.names) + (0 if exact else len(stated.noise_names))
    walkers = max(QUICK_WALKERS if quick else WALKERS, 2 * dimensions)
    variances = "collapsed" if exact else "sampled"
    run = partial(
        bp.sample, stated, fit, seed=seed, ensembles=ENSEMBLES, walkers=walkers, variances=variances,
        max_steps=QUICK_STEPS if quick else max_steps, executor=None if quick else executor, progress=False,
    )  # fmt: skip
    return Identified(stated, fit, *timed(run))


def jointly(recordings: Iterable[bp.Recording], seed: int, *, quick: bool, one_conduction: bool = False) -> Identified:
    """Return estimate and draws from all experiments with the displacement given."""
    experiments = [fold(recording, DISPLACEMENT) for recording in recordings]
    found = estimate(experiments, DISPLACEMENT, one_conduction=one_conduction)
    return draw(found, seed, quick=quick, executor=ENSEMBLES)


SIGNS = POSITIVE, UNDETERMINED, NEGATIVE = "positive", "undetermined", "negative"
ONE_SIGN, MONTE_CARLO_ERRORS = 0.975, 3.0


@dataclass(frozen=True)
class Verdict:
    """Verdicts on one experiment."""

    identified: Identified
    identifiability: bp.Identifiability
    misspecified: bool  # At a false-alarm rate of 1 % per experiment
    p: float  # p-value of the misfit
    exact: Any = None  # Fit that treats the force as exact, None with the displacement given

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


def identifiability(identified: Identified) -> bp.Identifiability:
    """Return the identifiability by the draws, without profiles."""
    return bp.identifiability(identified.problem, identified.fit, identified.posterior, profile=False, candidates=[])


def judge(identified: Identified) -> Verdict:
    """Return the verdict on an experiment whose posterior was sampled."""
    found, table = identifiability(identified), bp.predict(identified.problem, identified.posterior).table
    return Verdict(identified, found, str(table["verdict"]["all"]) == "misspecified", float(table["p"]["all"]))


def judge_recording(recording: bp.Recording, seed: int, quick: bool) -> Verdict:
    """Return the verdict on one experiment with the displacement given."""
    return judge(draw(estimate([fold(recording, DISPLACEMENT)], DISPLACEMENT), seed, quick=quick))


def laplace(identified: Identified) -> dict[str, Any]:
    """Return the entries of results.json on a MAP estimate."""
    fit = identified.fit
    return {
        "status": fit.status,
        "map": fit.theta,
        "laplace_sd": fit.sd,
        "robust_sd": fit.robust_sd,
        "p_negative_laplace": {n: _p_negative(fit, n) for n in fit.theta if n.startswith(CONDUCTION)},
        "whiteness_p": {channel: w.p for channel, w in fit.whiteness.items()},
        "noise_split": {c: {"measurement": s.measurement, "model": s.model} for c, s in fit.noise_split.items()},
        "input_noise": fit.input_noise,
        "doubling_shift": {n: float(s) if np.isfinite(s) else None for n, s in fit.doubling_shift.items()},
    }


def _p_negative(fit: bp.MapEstimate, name: str) -> float:
    return float(ndtr(-fit.theta[name] / fit.sd[name]))


def drawn(identified: Identified, *columns: str) -> dict[str, Any]:
    """Return the entries of results.json on estimate and draws, with additional columns of the posterior's summary."""
    posterior = identified.posterior
    table = posterior.summary()[["mean", "sd", "q05", "q50", "q95", *columns]]
    return laplace(identified) | {
        "posterior": {name: table.loc[name].astype(float).to_dict() for name in identified.problem.names},
        "converged": posterior.converged,
        "log_posterior_calls": posterior.log_posterior_calls,
        "failures": posterior.failures,
        "seconds": identified.seconds,
    }


def account(verdict: Verdict) -> dict[str, Any]:
    """Return the entries of results.json on an experiment."""
    negative, error = verdict.p_negative
    return drawn(verdict.identified) | {
        "p_negative": negative,
        "p_negative_mcse": error,
        "sign": verdict.sign,
        "identifiability": verdict.identifiability.verdicts,
        "misspecified": verdict.misspecified,
        "misfit_p": verdict.p,
    }


def line(name: str, verdict: Verdict) -> str:
    """Return the text to print on an experiment."""
    fit, (negative, error) = verdict.identified.fit, verdict.p_negative
    return (
        f"{name:>14s}: theta16 {fit.theta[CONDUCTION]:8.3f} ± {fit.sd[CONDUCTION]:.3f} W/K, "
        f"P(< 0) = {negative:.4f} ± {error:.4f} (Laplace {_p_negative(fit, CONDUCTION):.4f}), "
        f"{verdict.sign}, {'misspecified' if verdict.misspecified else 'adequate'}"
    )


SPREADS = {
    "theta1": 0.05, "theta3": 0.1, "theta5": 0.05, "theta8": 0.3, "theta9": 0.3, "theta10": 0.3, "theta15": 0.1,
}  # fmt: skip
WALL = bp.Normal(GEAR["theta17"], 5.0)
OTHERS = {name: bp.LogNormal(GEAR[name], spread) for name, spread in SPREADS.items()} | {"theta17": WALL}
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 24, "variances": "collapsed", "progress": False}
# Fewer draws than the stop rule requires; their effective number is reported.
STEPS = 2000


def with_others_free(run: Run, truth: str, seed: int, quick: bool) -> dict[str, Any]:
    """Return theta16 and its sign, by draws and by the Laplace approximation, with the others under priors."""
    with warnings.catch_warnings():
        # The warning on the wall's temperature, which the priors determine.
        warnings.filterwarnings("ignore", "The data do not change under")
        found = estimate(
            [fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT)], DISPLACEMENT, priors=PRIORS | OTHERS,
            fixed={name: value for name, value in FIXED.items() if name not in OTHERS},
        )  # fmt: skip
    fit = found.fit
    posterior = bp.sample(found.problem, fit, seed=seed, max_steps=QUICK_STEPS if quick else STEPS, **SAMPLING)
    table = identifiability(Identified(found.problem, fit, posterior)).table
    draws = posterior.draws(CONDUCTION)
    return {
        "status": fit.status,
        "map": fit.theta[CONDUCTION],
        "laplace_sd": fit.sd[CONDUCTION],
        "mean": float(draws.mean()),
        "sd": float(draws.std()),
        "interval_90": np.quantile(draws, [0.05, 0.95]).tolist(),
        "p_negative": float(table["p_negative"][CONDUCTION]),
        "p_negative_mcse": float(table["p_negative_mcse"][CONDUCTION]),
        "ess": float(posterior.summary()["ess"][CONDUCTION]),
        "stop_rule": posterior.converged,
    }
