"""Simulated recordings with noise of the input, and what the estimates from one of them are off."""

import warnings
from typing import Any

import numpy as np
from scipy import stats

import bayesperiodic as bp
from studies import common
from studies.damper import run as damper

LEVELS, KINDS = (0.01, 0.03, 0.1), ("exact", "measured")
COVERED = 0.9
STRIDE = 10_000
DUFFING = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 1.0}
DUFFING_HARMONICS = {1: 2.0, 3: 0.6}
# Time [s] after which the transient, with a time constant of 10 s, is gone; noise hides it from the fold.
SETTLING = 100.0
CASES = ("duffing", "damper")

Task = tuple[str, float, int, int]


def duffing(level: float, seed: int) -> tuple[bp.Experiment, dict[str, Any], dict[str, float]]:
    """Return an experiment, free parameters with priors, and the truth."""
    force = _signal(DUFFING_HARMONICS)
    recording = bp.simulate(
        bp.models.duffing, DUFFING, {"force": force}, frequency=0.25, duration=120.0 + SETTLING, sampling_rate=10.0,
        noise={"force": level * float(force.std()), "displacement": 0.02}, seed=seed,
    )  # fmt: skip
    priors = {name: bp.LogNormal(value, 1.0) for name, value in DUFFING.items() if name != "m"}
    steady = recording.between(SETTLING, np.inf)
    return steady.fold(256, harmonics={"force": 9}), priors, DUFFING


def dahl(level: float, seed: int) -> tuple[bp.Experiment, dict[str, Any], dict[str, float]]:
    """Return an experiment, free parameters with priors, and the truth."""
    displacement = _signal(damper.SYNTHETIC_SHAPE)
    recording = bp.simulate(
        bp.models.dahl, damper.PUBLISHED, {"displacement": displacement}, frequency=damper.SYNTHETIC_FREQUENCY,
        duration=30.0, sampling_rate=100.0, seed=seed,
        noise={"displacement": level * float(displacement.std()), "force": damper.SYNTHETIC_NOISE["force"]},
    )  # fmt: skip
    return recording.fold(512, harmonics={"displacement": 16}), damper.PRIORS, damper.PUBLISHED


def _signal(harmonics: dict[int, Any]) -> np.ndarray:
    """Return a signal on 64 points from the complex amplitudes of its harmonics."""
    turn = 2j * np.pi * np.arange(64) / 64
    return np.real(sum(amplitude * np.exp(order * turn) for order, amplitude in harmonics.items()))


def replicate(task: Task) -> dict[str, Any]:
    """Return the z, coverage by 90 % intervals and unexplained variance of one recording: case, level, number, seed."""
    case, level, number, seed = task
    line: dict[str, Any] = {"case": case, "level": level, "number": number, "seed": seed, "source": source()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        experiment, priors, truth = (duffing if case == "duffing" else dahl)(level, STRIDE * seed + number)
        model = bp.models.duffing if case == "duffing" else bp.models.dahl
        fixed = {name: value for name, value in truth.items() if name not in priors}
        start = {name: truth[name] for name in priors}
        for kind in KINDS:
            problem = bp.Problem(model, [experiment], priors=priors, fixed=fixed, input_noise=kind)
            try:
                fit = bp.map_estimate(problem, start=start, checks=False, progress=False)
            except (RuntimeError, ValueError) as error:
                line[kind] = {"error": f"{type(error).__name__}: {error}"}
                continue
            z = {name: _deviation(fit, name, truth[name], priors[name]) for name in priors}
            inside = {n: bool(2 * stats.t.sf(abs(z[n]), fit.degrees_of_freedom[n]) > 1 - COVERED) for n in z}
            line[kind] = {"z": z, "covered": inside, "unexplained": next(iter(fit.fvu.values())), "status": fit.status}
    return line


def _deviation(fit: bp.MapEstimate, name: str, truth: float, prior: Any) -> float:
    value, sd = fit.theta[name], fit.sd[name]
    if isinstance(prior, bp.LogNormal):
        return float(np.log(value / truth) * value / sd)
    return (value - truth) / sd


def source() -> str:
    """Return a key that identifies version and cases of the replicates."""
    return common.source_key(__file__, damper.__file__)
