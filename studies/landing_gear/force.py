"""The landing gear with the force given, as in eq. (9): the noise of the measured force is carried along.

With the force as input its noise moves displacement and pressure together, by more than their own noise, and in a way
that a heat conduction can imitate: a fit that takes the force for exact is sure of wrong signs. Here displacement and
pressure have the covariance B S Bᵀ + J F Jᵀ, with S and F the variances of the amplitudes of outputs and force that the
scatter of the cycles shows, B the harmonics kept, and J the derivatives of the steady motion by the force's amplitudes,
at an estimate that is made twice; up to one common factor, which is 1 where the model holds. (Errors in variables, to
first order: W. A. Fuller, Measurement Error Models, Wiley, 1987.)
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

import bayesperiodic as bp
from studies.landing_gear.identification import (
    FIXED,
    FORCE,
    KEPT,
    PRIORS,
    SAMPLES,
    TIED,
    Identified,
    draw,
    estimate,
    fold,
)
from studies.landing_gear.verdicts import FALSE_ALARM, Verdict

# Points compared: as many as the harmonics kept allow, but for one. They are compared with the whole motion, so that
# harmonics must be kept as long as there are any.
POINTS = 80
# Of the force's amplitudes, in their standard deviations, for derivatives by differences.
STEP = 3.0
# The covariance is taken at a fit that takes the force for exact, then once more at the fit that it leads to.
ROUNDS = 2
SCHEME = "central4"


def judge(recording: bp.Recording, seed: int, quick: bool) -> tuple[Identified, Verdict]:
    """Return what a fit says that takes the force for exact, and the verdict with its noise carried along."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The noise of the measured inputs")
        exact = found = estimate([fold(recording, FORCE)], FORCE)
        for _ in range(ROUNDS):
            found = _fitted(with_noise_of_the_input(exact.problem.experiments[0], found.fit.theta))
    identified = draw(found, seed, quick=quick)
    stated, fit = identified.problem, identified.fit
    said = bp.identifiability(stated, fit, identified.posterior, profile=False, candidates=[])
    p = misfit(stated, fit)
    return exact, Verdict(identified, said, p < FALSE_ALARM, p)


def _fitted(experiment: bp.Experiment) -> Identified:
    stated = bp.Problem(
        bp.models.landing_gear(FORCE), [experiment], priors=PRIORS, fixed=FIXED, tied=TIED, scheme=SCHEME
    )
    return Identified(stated, bp.map_estimate(stated, progress=False), None, 0.0)


def misfit(stated: bp.Problem, fit: bp.MapEstimate) -> float:
    """Return the p-value of residuals as large as these, if the covariance is right: χ² of n − l values, eq. (7)."""
    free = stated.counted - len(stated.names)
    return float(chi2.sf(fit.noise["scale"] * free, free))


def with_noise_of_the_input(experiment: bp.Experiment, theta: Mapping[str, float]) -> bp.Experiment:
    """Return the experiment at points over the period, with the covariance at θ of all that was measured."""
    model = bp.models.landing_gear(FORCE)
    parameters = FIXED | dict(theta) | {"theta11": -1e5 * theta["theta4"]}
    at = np.arange(SAMPLES) % (SAMPLES // POINTS) == 0

    def moved(force: np.ndarray, guess: str | Mapping[str, np.ndarray]) -> bp.PeriodicSolution:
        return bp.solve_periodic(
            model,
            parameters,
            {FORCE: force},
            frequency=experiment.frequency,
            samples=SAMPLES,
            scheme=SCHEME,
            guess=guess,
        )

    columns = []
    with warnings.catch_warnings():
        # Of a grid that is coarse for the friction: the fit says so once.
        warnings.filterwarnings("ignore", "A smooth sign of")
        centre = moved(experiment.inputs[FORCE], "static")
        for wave in amplitudes(experiment, FORCE).T:
            ends = [moved(experiment.inputs[FORCE] + sign * STEP * wave, centre.states) for sign in (1.0, -1.0)]
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
    variance = experiment.amplitude_variance[channel]
    sd = np.sqrt(0.5 * np.mean(variance[1 : harmonics + 1]))
    phase = 2 * np.pi * np.outer(np.arange(SAMPLES) / SAMPLES, np.arange(1, harmonics + 1))
    return sd * np.hstack([np.full((SAMPLES, 1), np.sqrt(0.5)), np.cos(phase), np.sin(phase)])
