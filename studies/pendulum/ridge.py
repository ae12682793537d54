"""All five parameters of the pendulum free: the ridge, by structure, Laplace and MCMC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import bayesperiodic as bp
from studies.pendulum.estimates import ALL, Identified
from studies.pendulum.recording import KNOWN, TRUTH

NATURAL = ("m", "l", "k1", "k2", "k3")
COMBINATIONS = {f"c{i}": f"k{i}/(m*l**2)" for i in (1, 2, 3)}
DETERMINED = ("l", *COMBINATIONS)
DETERMINED_UNITS = {"l": "m", "c1": "1/s^2", "c2": "1/s", "c3": "1"}
QUICK_STEPS = 250


@dataclass(frozen=True)
class Ridge:
    """Draws of all five parameters, and what is said of them.

    Attributes
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior
    structure : Structure
        What the equations leave open, before any data.
    identifiability : Identifiability
    natural, sampling : Comparison
        Of Laplace with the draws, in natural values and in logarithms.
    combinations : DataFrame
        Mean and sd of what the data determine, by Laplace (columns value, laplace_sd) and MCMC (mean, sd).
    """

    problem: bp.Problem
    fit: bp.MapEstimate
    posterior: bp.Posterior
    structure: bp.Structure
    identifiability: bp.Identifiability
    natural: bp.Comparison
    sampling: bp.Comparison
    combinations: pd.DataFrame


def sample(identified: Identified, seed: int, quick: bool) -> Ridge:
    """Sample the posterior of all five, and let the package say what it says of it."""
    problem, fit = identified.problems[ALL], identified.fits[ALL]
    settings: dict[str, Any] = {"max_steps": QUICK_STEPS} if quick else {}
    posterior = bp.sample(problem, fit, seed=seed, ensembles=2, variances="collapsed", progress=False, **settings)
    laplace, draws = fit.derive(COMBINATIONS), posterior.derive(COMBINATIONS)
    table = laplace.rename(columns={"sd": "laplace_sd"}).join(draws[["mean", "sd"]])
    l_draws = posterior.draws("l")
    table.loc["l"] = [fit.theta["l"], fit.sd["l"], l_draws.mean(), l_draws.std()]
    return Ridge(
        problem,
        fit,
        posterior,
        bp.structure(bp.models.pendulum, fixed=list(KNOWN)),
        bp.identifiability(problem, fit, posterior),
        bp.compare(problem, fit, posterior),
        bp.compare(problem, fit, posterior, coordinates="sampling"),
        table.loc[list(DETERMINED)],
    )


def combination_draws(posterior: bp.Posterior) -> dict[str, np.ndarray]:
    """Return the draws of what the data determine."""
    mass, length, *torques = (posterior.draws(name) for name in NATURAL)
    return {"l": length} | {f"c{i}": torque / (mass * length**2) for i, torque in enumerate(torques, 1)}


def truths() -> dict[str, float]:
    """Return the true values of what the data determine."""
    inertia = TRUTH["m"] * TRUTH["l"] ** 2
    return {"l": TRUTH["l"]} | {f"c{i}": TRUTH[f"k{i}"] / inertia for i in (1, 2, 3)}


def collect(ridge: Ridge) -> dict[str, Any]:
    """Return what results.json tells of the ridge."""
    posterior, fit = ridge.posterior, ridge.fit
    table = ridge.identifiability.table
    return {
        "converged": posterior.converged,
        "sampler": posterior.reason,
        "smallest_ess": float(min(posterior.ess.values())),
        "structure": str(ridge.structure),
        "verdicts": {str(name): str(v) for name, v in table["verdict"].items()},
        "remedies": {str(name): str(text) for name, text in table["remedy"].items() if text},
        "natural": {
            name: {
                "map": fit.theta[name],
                "laplace_sd": fit.sd[name],
                "mcmc_mean": float(posterior.draws(name).mean()),
                "mcmc_sd": float(posterior.draws(name).std()),
                "laplace_against_mcmc": str(ridge.natural.table.loc[name, "verdict"]),
                "in_logarithms": str(ridge.sampling.table.loc[name, "verdict"]),
            }
            for name in NATURAL
        },
        "combinations": {
            str(name): {str(k): float(v) for k, v in row.items()} for name, row in ridge.combinations.iterrows()
        },
        "joint": {c: str(r.joint["verdict"]) for c, r in (("natural", ridge.natural), ("logarithms", ridge.sampling))},
        "recommendation": str(ridge.natural.joint["recommendation"]),
    }
