"""All experiments of the landing gear at once: theta4 and theta6 in common, theta16 each experiment's own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import bayesperiodic as bp
from studies.landing_gear.force import SCHEME
from studies.landing_gear.identification import (
    DISPLACEMENT,
    ENSEMBLES,
    FIXED,
    FORCE,
    PRIORS,
    TIED,
    Identified,
    draw,
    estimate,
    fold,
)
from studies.landing_gear.verdicts import CONDUCTION, Verdict, laplace

# With the force given a log-posterior costs more, and the draws are fewer than the stop rule asks for.
STEPS_WITH_FORCE = 1000


def given_displacement(recordings: Iterable[bp.Recording], seed: int, *, quick: bool) -> Identified:
    """Return estimate and draws with the displacement given."""
    found = estimate([fold(recording, DISPLACEMENT) for recording in recordings], DISPLACEMENT)
    return draw(found, seed, quick=quick, executor=ENSEMBLES)


def given_force(forced: Mapping[str, Verdict], seed: int, *, quick: bool) -> Identified | None:
    """Return estimate and draws with the force given, its noise carried along as by the single fits.

    None for one experiment.
    """
    experiments = [verdict.identified.problem.experiments[0] for verdict in forced.values()]
    if len(experiments) < 2:
        return None
    stated = bp.Problem(
        bp.models.landing_gear(FORCE),
        experiments,
        priors=PRIORS,
        fixed=FIXED,
        tied=TIED,
        local=[CONDUCTION],
        scheme=SCHEME,
    )
    found = Identified(stated, bp.map_estimate(stated, progress=False), None, 0.0)
    return draw(found, seed, quick=quick, max_steps=STEPS_WITH_FORCE, executor=ENSEMBLES)


def account(identified: Identified) -> dict[str, Any]:
    """Return what results.json holds."""
    posterior = identified.posterior
    assert posterior is not None
    table = posterior.summary()
    return laplace(identified) | {
        "posterior": {
            name: {key: float(table[key][name]) for key in ("mean", "sd", "q05", "q50", "q95", "ess", "rhat")}
            for name in identified.problem.names
        },
        "p_negative": {
            name: float((posterior.draws(name) < 0.0).mean())
            for name in identified.problem.names
            if name.startswith(CONDUCTION)
        },
        "converged": posterior.converged,
        "reason": posterior.reason,
        "log_posterior_calls": posterior.log_posterior_calls,
        "failures": posterior.failures,
        "seconds": identified.seconds,
    }


def line(drive: str, found: Mapping[str, Any]) -> str:
    """Return what is printed."""
    sds = found["posterior"]
    common = ", ".join(f"{name} {sds[name]['mean']:.6g} ± {sds[name]['sd']:.1g}" for name in ("theta4", "theta6"))
    drawn = found["reason"]
    if found["converged"]:
        drawn = "converged"
    return f"  jointly, {drive} given: {common}; {found['log_posterior_calls']} log-posteriors, {drawn}"
