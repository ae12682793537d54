"""Simulated recordings of systems with a term that the fitted model lacks, or with none, and what the search finds."""

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from scipy.signal import lfilter

import bayesperiodic as bp
from studies import common
from studies.damper import run as damper

STRIDE = 10_000
RIGHT, ALTERNATIVE, OTHER, NONE, ERROR = "right term first", "among the alternatives", "another term", "none", "error"
OUTCOMES = (RIGHT, ALTERNATIVE, OTHER, NONE, ERROR)
CYCLES, PER_CYCLE = 12, 100
# With differences of second order on 256 points the error of the limit cycles exceeds what the noise leaves uncertain.
SCHEME = "central4"
# Correlation time of the coloured noise, of a period.
CORRELATION = 0.05
# Frequency [Hz] and amplitude of the force [N]. With 0.6 N in three experiments the effects of dx*abs(dx) and dx**3, or
# of x**5 and x*abs(x), differ by less than the noise.
DUFFING_RUNS = ((0.10, 0.6), (0.16, 0.6), (0.14, 1.2), (0.20, 1.8))
# Of the damper [1/m]: friction slips after 1 mm. After the published 0.04 mm w is the sign of the speed, and a factor
# of w in the force cannot be told from one of its limit in the equation.
SLIP_RATE = 1000.0

Task = tuple[str, int, int]


class Run(NamedTuple):
    """One experiment: frequency [Hz], the input over a period by channel, and parameters that are set for it."""

    frequency: float
    inputs: dict[str, np.ndarray]
    set: dict[str, float] = {}


class Case(NamedTuple):
    """A system, the model that is fitted, and the experiments.

    `missing` are the texts of the true term, with the place, as `bp.missing_terms` may write it; empty if the model
    lacks nothing. `settling` is the time [s] that is left out of the recordings.
    """

    model: bp.Model
    truth: bp.Model
    values: dict[str, float]
    priors: dict[str, Any]
    runs: Sequence[Run]
    noise: dict[str, float]
    harmonics: dict[str, int]
    settling: float
    missing: str = ""
    correlated: bool = False
    start: Mapping[str, float] = {}


def wave(**harmonics: complex) -> np.ndarray:
    """Return a signal on 64 points from the complex amplitudes of its harmonics, h1 and so on."""
    turn = 2j * np.pi * np.arange(64) / 64
    return np.real(sum(amplitude * np.exp(int(order[1:]) * turn) for order, amplitude in harmonics.items()))


def duffing(extra: dict[str, float], term: Callable[..., Any], missing: str, *, correlated: bool = False) -> Case:
    """Return an oscillator on a hardening spring under a force, with a term in its equation."""
    truth = bp.Model(
        "duffing_and_more", states=["x"], inputs=["force"], parameters=["m", "c", "k", "k3", *extra],
        equations=lambda s, p, u: [p.m * s.ddx + p.c * s.dx + p.k * s.x + p.k3 * s.x**3 + term(s, p) - u.force],
        outputs=lambda s, p, u: {"displacement": s.x},
    )  # fmt: skip
    values = {"m": 1.0, "c": 0.15, "k": 1.0, "k3": 0.4}
    priors = {name: bp.LogNormal(values[name], 1.0) for name in ("c", "k", "k3")}
    runs = [Run(f, {"force": wave(h1=size)}) for f, size in DUFFING_RUNS]
    noise = {"displacement": 0.01, "force": 0.006}
    return Case(bp.models.duffing, truth, values | extra, priors, runs, noise, {"force": 3}, 80.0, missing, correlated)


def dahl(slope: float, missing: str) -> Case:
    """Return a damper whose friction force increases with the square of the displacement, at three strokes."""
    extra = {"b": slope} if slope else {}
    truth = bp.Model(
        "dahl_and_more", states=["w"], inputs=["displacement"],
        parameters=[*damper.PUBLISHED, *extra],
        equations=lambda s, p, u: [s.dw - p.rho * (u.ddisplacement - abs(u.ddisplacement) * s.w)],
        outputs=lambda s, p, u: {
            "force": p.Kx * u.ddisplacement + p.K * u.displacement + p.F0
            + p.Kw * s.w * (1 + (p.b * u.displacement**2 if slope else 0))
        },
    )  # fmt: skip
    values = damper.PUBLISHED | {"rho": SLIP_RATE}
    priors = damper.PRIORS | {"rho": bp.LogNormal(SLIP_RATE, 1.0)}
    shape = {f"h{order}": amplitude for order, amplitude in damper.SYNTHETIC_SHAPE.items()}
    runs = [
        Run(frequency, {"displacement": mean + size * wave(**shape)})
        for frequency, size, mean in ((0.8397, 1.0, 0.0), (1.2, 0.5, 6e-3), (0.5, 0.5, -6e-3))
    ]
    noise, harmonics = {"force": 4.0, "displacement": 2e-5}, {"displacement": 16, "force": 40}
    return Case(bp.models.dahl, truth, values | extra, priors, runs, noise, harmonics, 0.0, missing)


def _pendulum(name: str, extra: Mapping[str, float]) -> bp.Model:
    return bp.Model(
        name, states=["phi"], angles=["phi", "angle"], inputs=["torque"], parameters=["J", "c", "M", *extra],
        equations=lambda s, p, u: [
            p.J * s.ddphi + p.c * s.dphi + (p.a * bp.smooth_abs(s.dphi, 0.02) if extra else 0) + p.M * sp.sin(s.phi)
            - u.torque
        ],
        outputs=lambda s, p, u: {"angle": s.phi},
    )  # fmt: skip


def pendulum(asymmetry: float, missing: str) -> Case:
    """Return a pendulum under a torque, whose viscous friction is larger in one direction than in the other."""
    extra = {"a": asymmetry} if asymmetry else {}
    values = {"J": 1.0, "c": 0.15, "M": 1.0}
    priors = {name: bp.LogNormal(value, 1.0) for name, value in values.items()}
    runs = [Run(f, {"torque": wave(h1=size)}) for f, size in ((0.08, 0.6), (0.12, 0.25), (0.22, 1.6))]
    noise = {"angle": 0.01, "torque": 0.006}
    truth = _pendulum("pendulum_and_more", extra)
    model = _pendulum("driven_pendulum", {})
    return Case(model, truth, values | extra, priors, runs, noise, {"torque": 3}, 80.0, missing)


def van_der_pol(cubic: float, missing: str) -> Case:
    """Return a self-excited oscillator with a hardening spring, at three known settings of its gain mu."""
    extra = {"k3": cubic} if cubic else {}
    truth = bp.Model(
        "van_der_pol_and_more", states=["x"], parameters=["mu", "omega", *extra],
        equations=lambda s, p, u: [
            s.ddx - p.mu * p.omega * (1 - s.x**2) * s.dx + p.omega**2 * s.x + (p.k3 * s.x**3 if extra else 0)
        ],
        outputs=lambda s, p, u: {"displacement": s.x},
    )  # fmt: skip
    values = {"mu": 1.0, "omega": 1.0}
    priors = {"omega": bp.LogNormal(1.0, 1.0)}
    runs = [Run(1 / (2 * np.pi), {}, {"mu": mu}) for mu in (0.5, 1.0, 2.0)]
    return Case(
        bp.models.van_der_pol, truth, values | extra, priors, runs, {"displacement": 0.02}, {}, 80.0, missing,
        start={"x": 2.0},
    )  # fmt: skip


def _nothing(s: Any, p: Any) -> int:
    return 0


CASES: dict[str, Callable[[], Case]] = {
    "Duffing, quintic": lambda: duffing({"k5": 0.15}, lambda s, p: p.k5 * s.x**5, "x**5 in equation of x"),
    "Duffing, quadratic damping": lambda: duffing(
        {"c2": 0.05}, lambda s, p: p.c2 * s.dx * bp.smooth_abs(s.dx, 1e-3), "dx*abs(dx) in equation of x"
    ),
    "Duffing, dry friction": lambda: duffing(
        {"f": 0.02}, lambda s, p: p.f * bp.smooth_sign(s.dx, 0.05), "sign(dx) in equation of x"
    ),
    "damper, friction by position": lambda: dahl(2000.0, "w*displacement**2 in force"),
    "pendulum, asymmetric friction": lambda: pendulum(0.03, "abs(dphi) in equation of phi"),
    "van der Pol, cubic stiffness": lambda: van_der_pol(0.02, "x**3 in equation of x"),
    "Duffing": lambda: duffing({}, _nothing, ""),
    "Duffing, coloured noise": lambda: duffing({}, _nothing, "", correlated=True),
    "damper": lambda: dahl(0.0, ""),
    "pendulum": lambda: pendulum(0.0, ""),
    "van der Pol": lambda: van_der_pol(0.0, ""),
}  # fmt: skip


def problem_of(case: Case, seed: int) -> bp.Problem:
    """Return the problem of the fitted model with one set of recordings."""
    experiments = [_experiment(case, i, seed) for i in range(len(case.runs))]
    free = {*case.priors}
    fixed: dict[str, Any] = {name: case.values[name] for name in case.model.parameters if name not in free}
    for name in case.runs[0].set:
        fixed[name] = {e.name: run.set[name] for e, run in zip(experiments, case.runs, strict=True)}
    return bp.Problem(case.model, experiments, priors=case.priors, fixed=fixed, scheme=SCHEME)


def _experiment(case: Case, i: int, seed: int) -> bp.Experiment:
    """Return the mean period of one recording."""
    run = case.runs[i]
    settling = np.ceil(case.settling * run.frequency) / run.frequency
    recording = bp.simulate(
        case.truth, case.values | run.set, run.inputs, frequency=run.frequency,
        duration=settling + CYCLES / run.frequency, sampling_rate=PER_CYCLE * run.frequency, start=case.start,
        noise={} if case.correlated else case.noise, seed=100 * seed + i,
    )  # fmt: skip
    if case.correlated:
        recording = _coloured(recording, case.noise, 100 * seed + i)
    folded = recording.between(settling, np.inf).fold(256, harmonics=case.harmonics)
    return dataclasses.replace(folded, name=f"run {i + 1}")


def _coloured(recording: bp.Recording, noise: Mapping[str, float], seed: int) -> bp.Recording:
    """Return a recording with white noise of inputs and a first-order autoregressive process on outputs."""
    generator, memory = np.random.default_rng(seed), np.exp(-1.0 / (CORRELATION * PER_CYCLE))
    size = recording.time.size
    inputs = {n: v + noise.get(n, 0.0) * generator.standard_normal(size) for n, v in recording.inputs.items()}
    drive = {n: np.sqrt(1.0 - memory**2) * generator.standard_normal(size) for n in recording.outputs}
    outputs = {n: v + noise[n] * lfilter([1.0], [1.0, -memory], drive[n]) for n, v in recording.outputs.items()}
    return bp.Recording(recording.time, outputs, inputs, name=recording.name, synthetic=True)


def replicate(task: Task) -> dict[str, Any]:
    """Return what the search finds in one set of recordings: case, number, seed."""
    name, number, seed = task
    case = CASES[name]()
    line: dict[str, Any] = {"case": name, "number": number, "seed": seed, "source": source()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem = problem_of(case, STRIDE * seed + number)
            fit = bp.map_estimate(problem, progress=False)
            begin = time.perf_counter()
            found = bp.missing_terms(problem, fit)
        except (RuntimeError, ValueError) as error:
            return line | {"outcome": ERROR, "error": f"{type(error).__name__}: {error}"}
    steps = [
        {
            "term": f"{step.term} in {step.place}", "alternatives": list(step.alternatives),
            "coefficient": step.coefficient, "robust_sd": step.robust_sd, "verdict": step.verdict,
        }
        for step in found.steps
    ]  # fmt: skip
    rank = [[one, *same] for one, same in zip(found.ranking["candidate"], found.ranking["same"], strict=True)]
    return line | {
        "outcome": outcome(steps, case.missing),
        "steps": steps,
        "rank": next((i for i, terms in enumerate(rank, 1) if case.missing in terms), None),
        "candidates": found.tested,
        "stopped": found.stopped,
        "verdict_before": found.before.verdict,
        "unexplained": next(iter(found.before.unexplained.values())),
        "seconds": time.perf_counter() - begin,
    }


def outcome(steps: Sequence[Mapping[str, Any]], missing: str) -> str:
    """Return how a search has ended, by its first step."""
    if not steps:
        return NONE
    if not missing:
        return OTHER
    if steps[0]["term"] == missing:
        return RIGHT
    return ALTERNATIVE if missing in steps[0]["alternatives"] else OTHER


def source() -> str:
    """Return a key that identifies version and cases of the replicates."""
    return common.source_key(__file__, damper.__file__)
