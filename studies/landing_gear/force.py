"""The landing gear with the force given, as in eq. (9), with the noise of the measured force propagated.

The noise of the force moves displacement and pressure together, by more than their own noise and like heat conduction:
a fit that treats the force as exact is confident of wrong signs. Here displacement and pressure have the covariance
B S Bᵀ + J F Jᵀ, with S and F the variances of the amplitudes of outputs and force from the scatter of the cycles, B the
harmonics kept, and J the derivatives of the steady motion by the force's amplitudes, at an estimate that is computed
twice; up to one common factor, which is 1 if the model is adequate. (Errors in variables, to first order: W. A. Fuller,
Measurement Error Models, Wiley, 1987.)

Joint fits share theta4 and theta6; theta16 is local to each experiment. The steepness of the friction, theta10, is
varied from 30 to 3000 s/m, solved from static equilibrium.
"""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

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


# Points compared: as many as the harmonics kept allow, but for one. They are compared with the whole motion, so that
# harmonics must be kept as long as there are any.
POINTS = 80
# Of the force's amplitudes, in their standard deviations, for derivatives by differences.
STEP = 3.0
# The covariance is computed at a fit that treats the force as exact, then again at the resulting fit.
ROUNDS = 2
# Noise "independent": one factor of the covariances.
SETTINGS: dict[str, Any] = {"noise": "independent", "scheme": "central4"}


def judge(recording: bp.Recording, seed: int, quick: bool) -> Verdict:
    """Return the verdict with the noise of the force propagated, and the fit that treats the force as exact."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The noise of the measured inputs")
        exact = found = estimate([fold(recording, FORCE)], FORCE)
        for _ in range(ROUNDS):
            experiment = with_noise_of_the_input(exact.problem.experiments[0], found.fit.theta)
            found = estimate([experiment], FORCE, **SETTINGS)
    identified = identification.draw(found, seed, quick=quick)
    # p-value of residuals as large as these, if the covariance is right: χ² of n − l values, eq. (7).
    free = identified.problem.counted - len(identified.problem.names)
    p = float(chi2.sf(identified.fit.noise["scale"] * free, free))
    return Verdict(identified, identification.identifiability(identified), p < identification.FALSE_ALARM, p, exact)


def with_noise_of_the_input(experiment: bp.Experiment, theta: Mapping[str, float]) -> bp.Experiment:
    """Return the experiment at points over the period, with the covariance at θ of all that was measured."""
    model, force = bp.models.landing_gear(FORCE), experiment.inputs[FORCE]
    parameters = identification.FIXED | dict(theta) | {"theta11": -1e5 * theta["theta4"]}
    at = np.arange(SAMPLES) % (SAMPLES // POINTS) == 0

    def moved(change: np.ndarray | float, guess: str | Mapping[str, np.ndarray]) -> bp.PeriodicSolution:
        return bp.solve_periodic(
            model, parameters, {FORCE: force + change}, frequency=experiment.frequency, samples=SAMPLES,
            scheme=SETTINGS["scheme"], guess=guess,
        )  # fmt: skip

    columns = []
    with warnings.catch_warnings():
        # The fit itself warns of a grid that is coarse for the friction.
        warnings.filterwarnings("ignore", "The transition of a smooth sign")
        centre = moved(0.0, "static")
        for wave in amplitudes(experiment, FORCE).T:
            ends = [moved(sign * STEP * wave, centre.states) for sign in (1.0, -1.0)]
            up, down = ([experiment.project(c, end.outputs[c])[at] for c in model.outputs] for end in ends)
            columns.append((np.stack(up, axis=-1) - np.stack(down, axis=-1)).ravel() / (2.0 * STEP))
    response = np.stack(columns, axis=-1)
    covariance = response @ response.T
    for c, channel in enumerate(model.outputs):
        own = amplitudes(experiment, channel)[at]
        covariance[c :: len(model.outputs), c :: len(model.outputs)] += own @ own.T
    return replace(experiment, mask=at, covariance=covariance, independent={}, harmonics={})


def amplitudes(experiment: bp.Experiment, channel: str) -> np.ndarray:
    """Return cosines and sines of the harmonics kept (points, 2·harmonics + 1), each as large as its noise.

    The scatter of the cycles is pooled over the harmonics, for the noise is white.
    """
    harmonics = KEPT[FORCE][channel]
    sd = np.sqrt(0.5 * np.mean(experiment.amplitude_variance[channel][1 : harmonics + 1]))
    phase = 2 * np.pi * np.outer(np.arange(SAMPLES) / SAMPLES, np.arange(1, harmonics + 1))
    return sd * np.hstack([np.full((SAMPLES, 1), np.sqrt(0.5)), np.cos(phase), np.sin(phase)])


# With the force given a log-posterior costs more, and the draws are fewer than the stop rule asks for.
STEPS_WITH_FORCE = 1000


def given_force(forced: Mapping[str, Verdict], seed: int, *, quick: bool) -> Identified | None:
    """Return estimate and draws with the force given, its noise propagated as in the single fits.

    None for one experiment.
    """
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
