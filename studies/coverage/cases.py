"""Data sets with known truths, one kind of noise or of model each, and which intervals contain the truth."""

import warnings
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

import bayesperiodic as bp
from studies import common

COVERED = 0.9
# Arguments of `bp.sample`.
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 10, "max_steps": 300}
# Grid of a period, forcing frequency [Hz], samples per second and noise, relative to the amplitude of the displacement.
POINTS, FREQUENCY, RATE, NOISE = 64, 0.16, 3.317, 0.1
STROKE = {1: 1.0, 2: -0.5j, 3: 0.3}
WIDE = {"k": bp.Normal(1.0, 100.0), "c": bp.Normal(0.5, 100.0)}
TRUTH = {"k": 1.0, "c": 0.5}

LAPLACE, ROBUST, DRAWS = "laplace", "robust", "draws"
Task = tuple[str, str, int, int]


class Case(NamedTuple):
    """A problem with its data, and the values that the intervals of its parameters should contain."""

    problem: bp.Problem
    truth: dict[str, float]
    start: dict[str, float] | None = None


def _damper(name: str, parameters: tuple[str, ...], force: Any) -> bp.Model:
    """Return a model whose output is a force of the displacement and its rate; its state has no part in it."""
    return bp.Model(
        name, states=["w"], inputs=["x"], parameters=parameters, equations=lambda s, p, u: [s.dw + s.w - u.x],
        outputs=lambda s, p, u: {"y": force(p, u)},
    )  # fmt: skip


LINEAR = _damper("linear", ("k", "c"), lambda p, u: p.k * u.x + p.c * u.dx)
CUBIC = _damper("cubic", ("k", "c", "k3"), lambda p, u: p.k * u.x + p.c * u.dx + p.k3 * u.x**3)
IDLE = _damper("idle", ("k", "c", "s"), lambda p, u: p.k * u.x + p.c * u.dx + 1e-12 * p.s * u.x)
OSCILLATOR = bp.Model(
    "oscillator", states=["q"], inputs=["x"], parameters=["c", "k"], equations=["ddq + c*dq + k*q - x"],
    outputs={"y": "q"},
)  # fmt: skip


def stroke(phase: np.ndarray, rate: bool = False) -> np.ndarray:
    """Return the displacement, or its rate, at phases [cycles]."""
    lines = {h: c * (2j * np.pi * h * FREQUENCY if rate else 1.0) for h, c in STROKE.items()}
    return np.real(sum(c * np.exp(2j * np.pi * h * phase) for h, c in lines.items()))


def force(phase: np.ndarray, k3: float = 0.0) -> np.ndarray:
    """Return the force without noise."""
    x = stroke(phase)
    return TRUTH["k"] * x + TRUTH["c"] * stroke(phase, rate=True) + k3 * x**3


def kept(values: np.ndarray, highest: int) -> np.ndarray:
    """Return a period with its harmonics up to the highest one."""
    amplitudes = np.fft.rfft(values)
    amplitudes[highest + 1 :] = 0.0
    return np.fft.irfft(amplitudes, values.size)


def period(random: np.random.Generator, highest: int, *, sd: float = NOISE, k3: float = 0.0) -> bp.Experiment:
    """Return a period with white noise in the harmonics that are kept, as many values as these have."""
    phase = np.arange(2 * POINTS) / (2 * POINTS)
    noise = sd * np.sqrt(2 * POINTS / (2 * highest + 1)) * random.standard_normal(phase.size)
    y = kept(force(phase, k3) + noise, highest)
    return bp.Experiment(
        "run", FREQUENCY, {"y": y}, {"x": stroke(phase)}, samples=phase.size, synthetic=True, harmonics={"y": highest},
        independent={"y": 2 * highest + 1},
    )  # fmt: skip


def recording(
    random: np.random.Generator, cycles: int, highest: int, *, correlation: float = 0.0, sd: float = NOISE,
    step: float = 0.0, input_sd: float = 0.0,
) -> bp.Experiment:  # fmt: skip
    """Return the mean period of a recording with AR(1) noise, whose values are multiples of a step if it is given."""
    time = np.arange(int(np.ceil(cycles * RATE / FREQUENCY)) + 1) / RATE
    white = random.standard_normal(time.size + 500)
    noise = sd * np.sqrt(1.0 - correlation**2) * lfilter([1.0], [1.0, -correlation], white)[500:]
    y, x = force(FREQUENCY * time) + noise, stroke(FREQUENCY * time)
    y = step * np.round(y / step) if step else y
    x = x + input_sd * random.standard_normal(time.size)
    run = bp.Recording.from_arrays(time, {"y": y}, {"x": x})
    return run.fold(POINTS, frequency=FREQUENCY, harmonics={"y": highest, "x": 3})


def of_damper(run: bp.Experiment, **settings: Any) -> Case:
    """Return the problem of stiffness and damping."""
    given: dict[str, Any] = {"priors": WIDE, "scheme": "fourier", "input_noise": "exact"}
    return Case(bp.Problem(LINEAR, [run], **(given | settings)), TRUTH)


def one_harmonic(random: np.random.Generator) -> Case:
    """Return the stiffness from three values."""
    case = of_damper(period(random, 1), priors={"k": WIDE["k"]}, fixed={"c": TRUTH["c"]})
    return Case(case.problem, {"k": TRUTH["k"]})


def bound(random: np.random.Generator) -> Case:
    """Return a hardening that cannot be negative, its truth a draw from its prior, which is as wide as the noise."""
    k3 = 0.05 * abs(random.standard_normal())
    run = period(random, 5, k3=k3)
    priors = WIDE | {"k3": bp.HalfNormal(0.05)}
    problem = bp.Problem(CUBIC, [run], priors=priors, scheme="fourier", input_noise="exact")
    return Case(problem, {"k3": k3, "k": TRUTH["k"]})


def undetermined(random: np.random.Generator) -> Case:
    """Return a parameter without influence, its truth a draw from its LogNormal prior."""
    priors = WIDE | {"s": bp.LogNormal(1.0, 1.0)}
    truth = {"s": float(np.exp(random.standard_normal())), "k": TRUTH["k"]}
    problem = bp.Problem(IDLE, [period(random, 5)], priors=priors, scheme="fourier", input_noise="exact")
    return Case(problem, truth)


def missing_cubic(random: np.random.Generator) -> Case:
    """Return data of a hardening spring for a linear one; the truth is its best fit to data without noise."""
    k3, highest = 0.3, 10
    phase = np.arange(2 * POINTS) / (2 * POINTS)
    regressors = np.stack([stroke(phase), stroke(phase, rate=True)], axis=-1)
    best = np.linalg.lstsq(regressors, kept(force(phase, k3), highest), rcond=None)[0]
    case = of_damper(period(random, highest, k3=k3, sd=0.03))
    return Case(case.problem, dict(zip(TRUTH, best.tolist(), strict=True)))


def estimated_frequency(random: np.random.Generator) -> Case:
    """Return an oscillator with Q = 50 at resonance, 20 cycles long, whose frequency is estimated."""
    omega = 2.0 * np.pi
    truth = {"k": omega**2, "c": omega / 50.0}
    time = np.arange(408) / 20.3
    response = 1.0 / (1j * omega * truth["c"])
    y = np.real(response * np.exp(1j * omega * time)) + 0.02 * abs(response) * random.standard_normal(time.size)
    x = np.cos(omega * time) + 0.02 * random.standard_normal(time.size)
    run = bp.Recording.from_arrays(time, {"y": y}, {"x": x}).fold(16, harmonics={"y": 3, "x": 1})
    priors = {"c": bp.LogNormal(truth["c"], 1.0), "k": bp.LogNormal(truth["k"], 0.3)}
    return Case(bp.Problem(OSCILLATOR, [run], priors=priors, scheme="fourier"), truth, truth)


def section(random: np.random.Generator) -> Case:
    """Return eight points of the period with correlated errors, whose covariance is known up to a factor."""
    phase, places = np.arange(POINTS) / POINTS, np.arange(8)
    covariance = 0.5 ** abs(np.subtract.outer(places, places))
    mask = np.arange(POINTS) % (POINTS // 8) == 0
    y = force(phase)
    y[mask] += NOISE * np.linalg.cholesky(covariance) @ random.standard_normal(places.size)
    run = bp.Experiment(
        "run", FREQUENCY, {"y": y}, {"x": stroke(phase)}, samples=POINTS, synthetic=True, mask=mask,
        covariance=covariance,
    )  # fmt: skip
    return of_damper(run)


CASES: Mapping[str, Callable[[np.random.Generator], Case]] = {
    "white noise, 3 values": one_harmonic,
    "white noise, 11 values": lambda random: of_damper(period(random, 5)),
    "white noise, 101 values": lambda random: of_damper(period(random, 50)),
    "3 cycles": lambda random: of_damper(recording(random, 3, 5)),
    "4 cycles": lambda random: of_damper(recording(random, 4, 5)),
    "AR(0.9), circulant": lambda random: of_damper(recording(random, 20, 15, correlation=0.9), noise="circulant"),
    "AR(0.9), measured": lambda random: of_damper(recording(random, 20, 15, correlation=0.9), noise="measured"),
    "frequency estimated": estimated_frequency,
    "section points": section,
    "noisy input": lambda random: of_damper(recording(random, 10, 5, input_sd=0.1), input_noise="measured"),
    "ten levels": lambda random: of_damper(recording(random, 10, 5, sd=0.02, step=0.3)),
    "bound": bound,
    "no influence": undetermined,
    "missing cubic term": missing_cubic,
}


def tasks(count: int, sampled: int, seed: int) -> list[Task]:
    """Return case, kind of interval, number and seed: first `count` data sets of each case, then those to sample."""
    numbers = [(LAPLACE, number) for number in range(count)] + [(DRAWS, number) for number in range(sampled)]
    return [(case, kind, number, seed) for kind, number in numbers for case in CASES]


def replicate(task: Task) -> dict[str, Any]:
    """Return by parameter which intervals contain the truth, of one data set: robust ones with those by Laplace."""
    name, kind, number, seed = task
    line: dict[str, Any] = {"case": name, "kind": kind, "number": number, "seed": seed, "source": source()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            # A recording with noise is refused by chance now and then.
            case = CASES[name](np.random.default_rng([zlib.crc32(name.encode()), seed, number]))
            fit = bp.map_estimate(case.problem, start=case.start, starts=1, progress=False)
            if kind == DRAWS:
                ends = {DRAWS: drawn(case.problem, fit, number)}
            else:
                ends = {LAPLACE: fit.interval(COVERED, robust=False), ROBUST: fit.interval(COVERED, robust=True)}
        except (RuntimeError, ValueError) as error:
            return line | {"error": f"{type(error).__name__}: {error}"}
    found = {
        each: {q: bool(interval[q][0] < value < interval[q][1]) for q, value in case.truth.items()}
        for each, interval in ends.items()
    }
    return line | {"status": fit.status, "misspecified": fit.misspecified, "covered": found}


def drawn(problem: bp.Problem, fit: bp.MapEstimate, seed: int) -> dict[str, tuple[float, float]]:
    """Return the equal-tailed intervals of draws."""
    posterior = bp.sample(problem, fit, seed=seed, progress=False, **SAMPLING)
    tails = 0.5 * (1.0 - COVERED), 0.5 * (1.0 + COVERED)
    return {name: tuple(np.quantile(posterior.draws(name), tails)) for name in problem.names}


def source() -> str:
    """Return a key that identifies version and cases of the replicates."""
    return common.source_key(__file__)
