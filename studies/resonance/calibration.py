"""Tables, jumps and resonance points of Duffing oscillators drawn from the prior, and whether posteriors cover them.

A sweep up may jump anywhere between the two folds, as a disturbance ends it, with the same probability at each row: so
that the jump says only what the likelihood assumes, that the branch exists at the rows before and after it.
"""

import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

import bayesperiodic as bp
from studies import common
from studies.resonance import systems
from studies.resonance.systems import NOISE, SAMPLES, averaged

AMPLITUDE, PHASE, BACKBONE, BACKBONE_FORCE, JUMPS, ALL = (
    "amplitudes", "amplitudes and phases", "backbone, force unknown", "backbone, force known", "jumps", "all together",
)  # fmt: skip
KINDS = (AMPLITUDE, PHASE, BACKBONE, BACKBONE_FORCE, JUMPS, ALL)
PRIORS = {"c": bp.LogNormal(0.1, 0.15), "k": bp.LogNormal(1.0, 0.03), "k3": bp.LogNormal(0.3, 0.15)}
FIXED = {"m": 1.0}
FORCE, LEVELS, AMPLITUDES = 0.2, (0.05, 0.1, 0.15, 0.2), (0.4, 0.8, 1.2, 1.6)
FREQUENCIES = np.linspace(0.1, 0.26, 33)
PLACE_SD, SHARE_SD = 2e-4, 0.02  # of places [Hz]; of amplitudes at resonance
MOST_JUMP_ROWS = 10  # rows between the folds, more than at nearly all truths
# Draws of each round of importance sampling, their degrees of freedom, the least effective number and most rounds.
ROUND, TAIL, LEAST_EFFECTIVE, MOST_ROUNDS = 600, 5, 200, 6


def branch(truth: dict[str, float]) -> tuple[list[list[bp.PeriodicSolution]], np.ndarray]:
    """Return the stable orbits at each frequency, in the order of the branch, and the frequencies of its folds."""
    wave = {"force": FORCE * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)}
    first = bp.solve_periodic(
        bp.models.duffing, truth | FIXED, wave, frequency=float(FREQUENCIES[0]), samples=SAMPLES, scheme="central4"
    )
    traced = bp.continue_periodic(bp.models.duffing, first, "frequency", until=float(FREQUENCIES[-1]), progress=False)
    each = [bp.solutions_at(bp.models.duffing, traced, float(f)) for f in FREQUENCIES]
    return [[orbit for orbit in orbits if orbit.stable] for orbits in each], np.asarray(traced.folds)


def drawn_truth(rng: np.random.Generator) -> dict[str, float]:
    """Return parameters drawn from the prior."""
    return {name: float(prior.quantile(np.array(rng.uniform()))) for name, prior in PRIORS.items()}


def drawn_sweep(rng: np.random.Generator) -> tuple[dict[str, float], np.ndarray]:
    """Return parameters and the exact complex amplitudes of a sweep up.

    Parameters and row of the jump have the density of the prior times a constant where the branch exists at all rows.
    """
    while True:
        truth = drawn_truth(rng)
        orbits, _ = branch(truth)
        both = [k for k, of_row in enumerate(orbits) if len(of_row) > 1]
        choices = len(both) + 1
        if rng.uniform() > choices / MOST_JUMP_ROWS:
            continue
        stay = rng.integers(choices)  # rows between the folds before the jump
        kept = [of_row[-1 if k in both[stay:] else 0] for k, of_row in enumerate(orbits)]
        return truth, np.array([2 / SAMPLES * np.fft.rfft(orbit.outputs["displacement"])[1] for orbit in kept])


def table(amplitudes: np.ndarray, rng: np.random.Generator, phases: bool) -> list[bp.Experiment]:
    """Return the experiments of a noisy table."""
    sd, size = NOISE * float(np.abs(amplitudes).max()), amplitudes.size
    noisy = amplitudes + sd * (rng.standard_normal(size) + 1j * rng.standard_normal(size))
    given = {"f": FREQUENCIES, "A": np.abs(noisy), "phi": np.degrees(np.angle(noisy)), "sd": np.full(size, sd)}
    return bp.response_table(
        given, frequency="f", outputs={"displacement": "A"}, inputs={"force": FORCE}, sweep="up", samples=SAMPLES,
        phases={"displacement": "phi"} if phases else None, sd={"displacement": "sd"},
    )  # fmt: skip


def points(kinds: tuple[str, ...], truth: dict[str, float], rng: np.random.Generator) -> list[bp.Experiment]:
    """Return jumps and resonance points with normal errors; of a sweep without jumps none."""
    runs: list[bp.Experiment] = []
    if JUMPS in kinds:
        runs += [
            bp.jump(f"jump {way}", 0.19, {"force": FORCE}, direction=way, sd=PLACE_SD, samples=SAMPLES)
            for way in ("up", "down")
        ]
    given: dict[str, Any] = {"frequency_sd": PLACE_SD, "samples": SAMPLES}
    if BACKBONE in kinds:
        runs += [bp.resonance_point(f"{a} m", 0.17, {"displacement": a}, {"force": None}, **given) for a in AMPLITUDES]
    if BACKBONE_FORCE in kinds:
        runs += [
            bp.resonance_point(f"{u} N", 0.17, {"displacement": 1.0}, {"force": u}, amplitude_sd=SHARE_SD, **given)
            for u in LEVELS
        ]
    exact = bp.Problem(bp.models.duffing, runs, priors=PRIORS, fixed=FIXED, scheme="central4").solve(truth)
    return [measured(run, exact[run.name], rng) for run in runs]


def measured(run: bp.Experiment, exact: bp.PeriodicSolution, rng: np.random.Generator) -> bp.Experiment:
    """Return the experiment of a special point with errors of its place and, for a known force, its amplitude."""
    if not exact.converged:
        raise LookupError(run.name)
    frequency = exact.frequency + PLACE_SD * rng.standard_normal()
    if run.name.startswith("jump"):
        way = run.name.removeprefix("jump ")
        return bp.jump(run.name, frequency, {"force": FORCE}, direction=way, sd=PLACE_SD, samples=SAMPLES)
    given: dict[str, Any] = {"frequency_sd": PLACE_SD, "samples": SAMPLES}
    value, unit = run.name.split()
    if unit == "m":
        return bp.resonance_point(run.name, frequency, {"displacement": float(value)}, {"force": None}, **given)
    size = 2 / SAMPLES * abs(np.fft.rfft(exact.outputs["displacement"])[1])
    size, sd = size * (1.0 + SHARE_SD * rng.standard_normal()), SHARE_SD * size
    return bp.resonance_point(
        run.name, frequency, {"displacement": size}, {"force": float(value)}, amplitude_sd=sd, **given
    )


def drawn_problem(kind: str, rng: np.random.Generator) -> tuple[bp.Problem, dict[str, float]]:
    """Return a problem of data of a kind, and its truth."""
    while True:
        runs: list[bp.Experiment] = []
        if kind in (AMPLITUDE, PHASE, ALL):
            truth, amplitudes = drawn_sweep(rng)
            runs = [replace(e, name=f"table {e.name}") for e in table(amplitudes, rng, kind == PHASE)]
        else:
            truth = drawn_truth(rng)
        kinds = (JUMPS, BACKBONE, BACKBONE_FORCE) if kind == ALL else (kind,)
        try:
            if kind not in (AMPLITUDE, PHASE):
                runs += points(kinds, truth, rng)
        except LookupError:
            continue
        return bp.Problem(bp.models.duffing, runs, priors=PRIORS, fixed=FIXED, scheme="central4"), truth


def weighted_draws(
    problem: bp.Problem, fit: bp.MapEstimate, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return draws of ln θ (draws, names), their weights, and the effective number, by adaptive importance sampling."""
    near = problem.anchored(fit.theta, {name: solution.states for name, solution in fit.solutions.items()})
    at = np.array([fit.theta[name] for name in problem.names])
    centre, spread = np.log(at), 2.0 * fit.covariance.to_numpy() / np.outer(at, at)
    for turn in range(MOST_ROUNDS):
        count = ROUND if turn == 0 else 2 * ROUND
        proposal = stats.multivariate_t(centre, spread, df=TAIL)
        draws = proposal.rvs(count, random_state=rng)
        values = near.log_posterior(np.exp(draws), {}) + draws.sum(axis=1) - proposal.logpdf(draws)
        weights = np.exp(values - values.max())
        weights /= weights.sum()
        effective = float(1.0 / np.sum(weights**2))
        if turn and effective > LEAST_EFFECTIVE:
            break
        centre = weights @ draws
        spread = np.cov(draws.T, aweights=weights) + 1e-3 * spread
    return draws, weights, effective


def source() -> str:
    """Return a key that identifies the version of the replicates."""
    return common.source_key(__file__, systems.__file__)


def averaged_z(problem: bp.Problem, truth: dict[str, float]) -> dict[str, float]:
    """Return the distances of the truth from the estimates with the averaged equation, in their standard deviations."""
    each: list[Any] = [run.measurements[0] for run in problem.experiments]
    given = {
        "f": FREQUENCIES, "A": np.array([one.value for one in each]), "sd": np.array([float(one.sd) for one in each])
    }  # fmt: skip
    at, sd = averaged(given, FORCE, truth)
    return {p: (at[p] - truth[p]) / sd[p] for p in truth}


def replicate(task: tuple[str, int, int]) -> dict[str, Any]:
    """Return the ranks of the truth in the posterior, and its distance in standard deviations of the estimate.

    The task is a kind of data, the number of the replicate, and the seed.
    """
    kind, number, seed = task
    rng, began = np.random.default_rng([seed, number, KINDS.index(kind)]), time.process_time()
    problem, truth = drawn_problem(kind, rng)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = bp.map_estimate(problem, start=truth, checks=False, progress=False)
    draws, weights, effective = weighted_draws(problem, fit, rng)
    names = problem.names
    mean = weights @ draws
    sd = np.sqrt(weights @ (draws - mean) ** 2)
    closed = averaged_z(problem, truth) if kind == AMPLITUDE else {}
    return {
        "kind": kind, "number": number, "seed": seed, "status": fit.status, "effective": effective,
        "warned": any("close to a fold" in str(one.message) for one in caught),
        "rank": {p: float(weights @ (draws[:, i] < np.log(truth[p]))) for i, p in enumerate(names)},
        "z": {p: (fit.theta[p] - truth[p]) / fit.sd[p] for p in names},
        "contraction": {p: float(sd[i] / PRIORS[p].spread) for i, p in enumerate(names)},
        "averaged": closed, "source": source(), "seconds": time.process_time() - began,
    }  # fmt: skip
