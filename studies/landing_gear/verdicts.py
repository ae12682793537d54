"""What the landing gear study concludes from one experiment: the sign of theta16, and whether the model holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

import bayesperiodic as bp
from studies.landing_gear.identification import Identified

POSITIVE, NEGATIVE, UNDETERMINED = "positive", "negative", "undetermined"
ONE_SIGN, MONTE_CARLO_ERRORS = 0.975, 3.0
CONDUCTION = "theta16"
FALSE_ALARM = 0.01


@dataclass(frozen=True)
class Verdict:
    """What is said of one experiment.

    Attributes
    ----------
    identified : Identified
    identifiability : Identifiability
    misspecified : bool
        Whether the model is called that, at a false-alarm rate of 1 % an experiment.
    p : float
        Behind it.
    """

    identified: Identified
    identifiability: bp.Identifiability
    misspecified: bool
    p: float

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
    said = bp.identifiability(stated, fit, posterior, profile=False, candidates=[])
    table = bp.predict(stated, posterior).table
    return Verdict(identified, said, str(table["verdict"]["all"]) == "misspecified", float(table["p"]["all"]))


def account(verdict: Verdict) -> dict[str, Any]:
    """Return what results.json holds of an experiment."""
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
    """Return what results.json holds of a MAP estimate."""
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
    """Return what is printed of an experiment."""
    fit, (negative, error) = verdict.identified.fit, verdict.p_negative
    told = "misspecified" if verdict.misspecified else "adequate"
    if "scale" in fit.noise:
        size = f"scale of the errors {fit.noise['scale']:.2f}"
    else:
        split = fit.noise_split["force"]
        size = f"force: noise {split.measurement:.1f} N, model error {split.model:.1f} N"
    return (
        f"{name:>14s}: theta16 {fit.theta[CONDUCTION]:8.3f} ± {fit.sd[CONDUCTION]:.3f} W/K, "
        f"P(< 0) = {negative:.4f} ± {error:.4f} (Laplace {ndtr(-fit.theta[CONDUCTION] / fit.sd[CONDUCTION]):.4f}), "
        f"{verdict.sign}, {told}; {size}"
    )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
