"""The landing gear with the force given, as in eq. (9), with the noise of the measured force integrated out.

The noise of the force moves displacement and pressure together, by more than their own noise and like heat conduction:
a fit that treats the force as exact is confident of wrong signs.

Joint fits share theta4 and theta6; theta16 is local to each experiment. The steepness of the friction, theta10, is
varied from 30 to 3000 s/m, solved from static equilibrium.
"""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.landing_gear import identification
from studies.landing_gear.identification import DISPLACEMENT, FORCE, KEPT, SAMPLES, Identified, Verdict, estimate, fold
from studies.landing_gear.rig import GEAR, Run, imposed

SLOPES = (30.0, 100.0, 300.0, 1000.0, 3000.0)


def solve(run: Run, slope: float, drive: str) -> tuple[bp.PeriodicSolution, bool]:
    """Return the gear's motion in an experiment, and whether the solver warned that the grid is too coarse."""

    def moved(drive: str, signal: np.ndarray) -> tuple[bp.PeriodicSolution, bool]:
        model, gear = bp.models.landing_gear(drive), GEAR | {"theta10": slope}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = bp.solve_periodic(model, gear, {drive: signal}, frequency=run.frequency, samples=SAMPLES)
        return found, any("steps of the grid" in str(warning.message) for warning in caught)

    found, warned = moved(DISPLACEMENT, imposed(run, SAMPLES))
    if drive == DISPLACEMENT:
        return found, warned
    amplitudes = np.fft.rfft(found.outputs["force"])
    amplitudes[KEPT[FORCE]["force"] + 1 :] = 0.0
    return moved(FORCE, np.fft.irfft(amplitudes, SAMPLES))


def slope_account(runs: Sequence[Run]) -> dict[str, Any]:
    """Return by direction and slope how the solves of all experiments ended, and how many warned."""
    result: dict[str, Any] = {}
    for drive in identification.DRIVES:
        result[drive] = {}
        for slope in SLOPES:
            every = [solve(run, slope, drive) for run in runs]
            statuses = Counter(found.status for found, _ in every)
            result[drive][f"{slope:g}"] = {"status": dict(statuses), "warned": sum(warned for _, warned in every)}
    return result


def slope_line(found: Mapping[str, Any]) -> str:
    """Return the text to print."""
    statuses = sum((Counter(one["status"]) for by_slope in found.values() for one in by_slope.values()), Counter())
    warned = ", ".join(f"{one['warned']} at {slope} s/m" for slope, one in found[FORCE].items() if one["warned"])
    return (
        f"  friction slope 30 to 3000 s/m: {statuses['converged']} of {statuses.total()} solves converged on {SAMPLES} "
        f"points; force given, the solver warned that this is too coarse for {warned or 'none'}"
    )


# As accurate as the time integration with which `cost` compares it.
SETTINGS = {"scheme": "central4"}


def judge(recording: bp.Recording, seed: int, quick: bool) -> Verdict:
    """Return the verdict with the noise of the force integrated out, and the fit that treats the force as exact."""
    experiments = [fold(recording, FORCE)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The noise of the measured inputs")
        exact = estimate(experiments, FORCE, input_noise="exact", **SETTINGS)
    found = identification.judge(identification.draw(estimate(experiments, FORCE, **SETTINGS), seed, quick=quick))
    return replace(found, exact=exact)


# With the force given a log-posterior costs more, and the draws are fewer than the stop rule asks for.
STEPS_WITH_FORCE = 1000


def given_force(forced: Mapping[str, Verdict], seed: int, *, quick: bool) -> Identified | None:
    """Return estimate and draws with the force given; None for one experiment."""
    experiments = [verdict.identified.problem.experiments[0] for verdict in forced.values()]
    if len(experiments) < 2:
        return None
    found = estimate(experiments, FORCE, **SETTINGS)
    return identification.draw(found, seed, quick=quick, max_steps=STEPS_WITH_FORCE, executor=identification.ENSEMBLES)


def account(identified: Identified) -> dict[str, Any]:
    """Return the entries of results.json on a joint fit."""
    posterior = identified.posterior
    local = [name for name in identified.problem.names if name.startswith(identification.CONDUCTION)]
    return identification.drawn(identified, "ess", "rhat") | {
        "p_negative": {name: float((posterior.draws(name) < 0.0).mean()) for name in local},
        "reason": posterior.reason,
    }


def line(drive: str, found: Mapping[str, Any]) -> str:
    """Return the text to print."""
    sds = found["posterior"]
    common = ", ".join(f"{name} {sds[name]['mean']:.6g} ± {sds[name]['sd']:.1g}" for name in ("theta4", "theta6"))
    end = "converged" if found["converged"] else found["reason"]
    return f"jointly, {drive} given: {common}; {found['log_posterior_calls']} log-posteriors, {end}"
