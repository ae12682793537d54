"""Gallery of small models with known truths and synthetic data: expected verdicts, and those of the diagnostics.

If only the noise of one run obscured the sign of a parameter, one data set in twenty would show the sign by chance.
The case with an undetermined sign therefore has an unknown delay of the recording, which acts as damping, and the one
with a truncated posterior has a prior that ends about two standard errors below the truth: the correct verdict is then
known for every data set.
"""

import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import sympy as sp

import bayesperiodic as bp

DETERMINED, PRIOR_ONLY = "determined", "only with the prior"
COMBINATION, SIGN = "only in combination", "sign undetermined"
FINE, WIDE, SHAPE, MODE = "fine", "too wide", "wrong shape", "wrong mode"
ADEQUATE, MISSPECIFIED = "adequate", "misspecified"
IDENTIFIABILITY, COMPARE, JOINT, PREDICT = "identifiability", "compare", "joint", "predict"
STROKE = 0.01

Expected = Mapping[str, Mapping[str, tuple[str, ...]]]


@dataclass(frozen=True)
class Case:
    """A case with known verdicts."""

    title: str  # The fault, in words
    truth: Mapping[str, float]  # Of every parameter, also of those that the fitted model lacks
    problem: Callable[[int], bp.Problem]  # Makes the problem of a data seed
    shown: str  # The parameter of the figure
    expected: Expected  # By tool and parameter: the verdicts that are right
    # By tool, the parameters whose verdicts name the fault, if there is one
    fault: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    sampling: Mapping[str, Any] = field(default_factory=dict)  # Arguments of `bp.sample`
    drawless: bool = False  # Whether the verdicts do not use draws, so that replicates over data seeds do without them


def _driven(name: str, parameters: Mapping[str, str], force: Callable[[Any, Any], sp.Expr]) -> bp.Model:
    """Return a model whose output is a force of a measured displacement; its state has no part in it."""
    return bp.Model(
        name, states=["w"], inputs=["x"], parameters=dict(parameters), units={"x": "m", "force": "N", "w": "m"},
        equations=lambda s, p, u: [s.dw + s.w - u.x], outputs=lambda s, p, u: {"force": force(p, u)},
    )  # fmt: skip


PRODUCT = _driven("product", {"a": "1", "b": "N/m"}, lambda p, u: p.a * p.b * u.x)
SUM = _driven("sum", {"a": "N/m", "b": "N/m"}, lambda p, u: (p.a + p.b) * u.x)
DAMPED = _driven("damped", {"k": "N/m", "c": "N s/m"}, lambda p, u: p.k * u.x + p.c * u.dx)
RUBBING = _driven(
    "rubbing", {"k": "N/m", "c": "N s/m", "coulomb": "N"},
    lambda p, u: p.k * u.x + p.c * u.dx + p.coulomb * sp.tanh(u.dx / 0.02),
)  # fmt: skip
BEAM = _driven("beam", {"position": "1", "k": "N/m"}, lambda p, u: p.k * sp.sin(sp.pi * p.position) * u.x)


def _generator(model: bp.Model, data_seed: int) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(model.name.encode()), data_seed])


def _expected(**tools: Mapping[str, str]) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return one right verdict by tool and parameter; the prediction is adequate if not stated otherwise."""
    stated = {**tools, PREDICT: tools.get(PREDICT, {"all": ADEQUATE})}
    return {tool: {name: (verdict,) for name, verdict in verdicts.items()} for tool, verdicts in stated.items()}


QUICKLY = {"ensembles": 2, "walkers": 32, "variances": "collapsed", "max_steps": 6000}


def _one_run(
    title: str, shown: str, model: bp.Model, truth: Mapping[str, float], priors: Mapping[str, Any], expected: Expected,
    fault: Mapping[str, tuple[str, ...]], *, fitted: bp.Model | None = None, frequency: float = 2.0,
    noise: float = 1.0, samples: int = 40, fixed: Mapping[str, float] | None = None, start: str = "laplace",
) -> Case:  # fmt: skip
    """Return a case with one synthetic run of a model, fitted with the same model or another one.

    The displacement is a sine of 10 mm, every sample of the force has white noise of this sd [N].
    """
    values = {name: truth[name] for name in model.parameters}

    def problem(data_seed: int) -> bp.Problem:
        x = {"x": STROKE * np.sin(2 * np.pi * np.arange(samples) / samples)}
        exact = bp.solve_periodic(model, values, x, frequency=frequency, samples=samples, scheme="central4")
        force = exact.outputs["force"] + noise * _generator(model, data_seed).standard_normal(samples)
        run = bp.Experiment("run", frequency, {"force": force}, x, samples=samples, synthetic=True)
        return bp.Problem(fitted or model, [run], priors=priors, fixed=fixed or {})

    return Case(title, truth, problem, shown, expected, fault, {**QUICKLY, "start": start})


STIFFNESS = bp.Normal(8e3, 4e3)


def product_ridge(noise: float = 4.0) -> Case:
    """Return a·b, measured to 1 % (noise 4 N), of two factors known to a factor of two."""
    return _one_run(
        "only the product of a and b is identifiable", "a", PRODUCT, {"a": 1.0, "b": 1e4},
        {"a": bp.LogNormal(1.0, 0.7), "b": bp.LogNormal(1e4, 0.7)},
        _expected(identifiability={"a": COMBINATION, "b": COMBINATION}, compare={"a": SHAPE, "b": SHAPE}),
        {IDENTIFIABILITY: ("a", "b")}, noise=noise,
    )  # fmt: skip


def sum_ridge() -> Case:
    """Return a + b, measured to 1 %, of two springs side by side."""
    return _one_run(
        "only the sum of a and b is identifiable", "a", SUM, {"a": 6e3, "b": 4e3},
        {"a": bp.Normal(5e3, 2e3), "b": bp.Normal(5e3, 2e3)},
        _expected(
            identifiability={"a": COMBINATION, "b": COMBINATION}, compare={"a": FINE, "b": FINE}, joint={"all": FINE},
        ),
        {IDENTIFIABILITY: ("a", "b")}, noise=4.0,
    )  # fmt: skip


PENDULUM_TRUTH = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4}
PENDULUM_FIXED = {"a": 0.11, "g": 9.81, "v0": 0.05}
ROTATION = 13.0 / (2 * np.pi)


@cache
def _rotations(samples: int = 100) -> tuple[bp.PeriodicSolution, ...]:
    """Return locked rotations of the pendulum, one turn a forcing period, at two frequencies."""
    guess = {"phi": 2 * np.pi * (np.arange(samples) / samples) - 0.57}
    return tuple(
        bp.solve_periodic(
            bp.models.pendulum, PENDULUM_TRUTH | PENDULUM_FIXED, frequency=frequency, samples=samples,
            scheme="central4", winding=1, guess=guess,
        )
        for frequency in (ROTATION, 1.15 * ROTATION)
    )  # fmt: skip


def scaling_symmetry() -> Case:
    """Return the paper's pendulum with all five parameters free: m, k1, k2 and k3 may all grow by one factor."""

    def problem(data_seed: int) -> bp.Problem:
        generator, runs = _generator(bp.models.pendulum, data_seed), []
        for number, true in enumerate(_rotations(), 1):
            if not true.converged:
                raise RuntimeError(f"rotation {number}: no periodic solution ({true.status}).")
            size = true.samples
            angle = true.outputs["angle"] + 0.01 * generator.standard_normal(size)
            rate = true.outputs["rate"] + 0.1 * generator.standard_normal(size)
            outputs = {"angle": np.mod(angle + np.pi, 2 * np.pi) - np.pi, "rate": rate}
            settings: dict[str, Any] = {"winding": 1, "guess": true.states, "synthetic": True}
            runs.append(bp.Experiment(f"rotation {number}", true.frequency, outputs, samples=size, **settings))
        priors = {name: bp.LogNormal(value, 0.5) for name, value in PENDULUM_TRUTH.items()}
        return bp.Problem(bp.models.pendulum, runs, priors=priors, fixed=PENDULUM_FIXED, scheme="central4")

    return Case(
        "pendulum: m, k1, k2, k3 may all grow by one factor", PENDULUM_TRUTH, problem, "m",
        _expected(identifiability={name: COMBINATION for name in ("m", "k1", "k2", "k3")} | {"l": DETERMINED}),
        {IDENTIFIABILITY: ("m", "k1", "k2", "k3")},
        {"ensembles": 2, "variances": "collapsed", "max_steps": 12_000},
        drawless=True,
    )  # fmt: skip


def linear() -> Case:
    """Return stiffness, damping and dry friction, each determined by the data."""
    truth = {"k": 1e4, "c": 40.0, "coulomb": 15.0}
    return _one_run(
        "nothing", "c", RUBBING, truth,
        {"k": STIFFNESS, "c": bp.Normal(50.0, 50.0), "coulomb": bp.Normal(10.0, 20.0)},
        _expected(
            identifiability=dict.fromkeys(truth, DETERMINED), compare=dict.fromkeys(truth, FINE), joint={"all": FINE},
        ),
        {},
    )  # fmt: skip


def sign_undetermined() -> Case:
    """Return a small damping and a recording delay, known to 1 ms, that acts as ±10 N s/m."""
    return _one_run(
        "a delay of the recording may be the damping", "c", DAMPED, {"k": 1e4, "c": 3.0, "shift[run]": 0.0},
        {"k": STIFFNESS, "c": bp.Normal(0.0, 100.0), "shift": bp.Normal(0.0, 1e-3)},
        _expected(identifiability={"k": DETERMINED, "c": SIGN}, compare=dict.fromkeys(("k", "c", "shift[run]"), FINE)),
        {IDENTIFIABILITY: ("c",)},
    )  # fmt: skip


def prior_dominated() -> Case:
    """Return a damping that a slow run leaves ±7 N s/m wide, and the prior ±3."""
    return _one_run(
        "the damping is determined by its prior", "c", DAMPED, {"k": 1e4, "c": 20.0},
        {"k": STIFFNESS, "c": bp.Normal(20.0, 3.0)},
        _expected(
            identifiability={"k": DETERMINED, "c": PRIOR_ONLY}, compare={"k": FINE, "c": FINE}, joint={"all": FINE},
        ),
        {IDENTIFIABILITY: ("c",)}, frequency=0.5,
    )  # fmt: skip


def truncated() -> Case:
    """Return a damping whose prior ends at 20 N s/m, about two standard errors below the truth."""
    return _one_run(
        "the prior excludes the true value", "c", DAMPED, {"k": 1e4, "c": 24.5},
        {"k": STIFFNESS, "c": bp.Uniform(0.0, 20.0)},
        _expected(identifiability={"k": DETERMINED, "c": PRIOR_ONLY}) | {COMPARE: {"k": (FINE,), "c": (SHAPE, WIDE)}},
        {IDENTIFIABILITY: ("c",), COMPARE: ("c",)},
    )  # fmt: skip


def two_modes() -> Case:
    """Return where along a beam a force acts, from the first mode shape alone: p and 1 − p give the same."""
    truth = {"position": 0.25, "k": 1e4}
    return _one_run(
        "two positions on the beam fit equally well", "position", BEAM, truth,
        {"position": bp.TruncatedNormal(0.4, 0.3, 0.0, 1.0)},
        _expected(compare={"position": MODE}, joint={"all": MODE}),
        {COMPARE: ("position",)}, noise=4.0, fixed={"k": truth["k"]}, start="prior",
    )  # fmt: skip


def misspecified() -> Case:
    """Return dry friction that the fitted model lacks, with many data."""
    return _one_run(
        "the model lacks the dry friction", "c", RUBBING, {"k": 1e4, "c": 40.0, "coulomb": 5.0},
        {"k": STIFFNESS, "c": bp.Normal(50.0, 50.0)},
        _expected(
            identifiability={"k": DETERMINED, "c": DETERMINED}, compare={"k": FINE, "c": FINE}, joint={"all": FINE},
            predict={"all": MISSPECIFIED},
        ),
        {PREDICT: ("all",)}, fitted=DAMPED, samples=400,
    )  # fmt: skip


CASES: dict[str, Callable[[], Case]] = {
    case.__name__: case
    for case in (
        product_ridge, sum_ridge, scaling_symmetry, linear, sign_undetermined, prior_dominated, truncated, two_modes,
        misspecified,
    )
}  # fmt: skip

GOOD = (DETERMINED, FINE, ADEQUATE)


@dataclass(frozen=True)
class Outcome:
    """Estimate, draws and the verdicts of every tool; without draws the last three are None."""

    case: Case
    problem: bp.Problem
    fit: bp.MapEstimate
    identifiability: bp.Identifiability
    seconds: float
    posterior: Any = None
    comparison: Any = None
    prediction: Any = None

    @property
    def verdicts(self) -> dict[str, dict[str, str]]:
        """By tool and parameter; "all" for those on the whole."""
        found = {IDENTIFIABILITY: self.identifiability.verdicts}
        if self.posterior is not None:
            found[COMPARE] = dict(self.comparison.table["verdict"])
            found[JOINT] = {"all": str(self.comparison.joint["verdict"])}
            found[PREDICT] = dict(self.prediction.table["verdict"])
        return found

    @property
    def wrong(self) -> dict[str, str]:
        """Unexpected verdicts, by tool and parameter."""
        verdicts = self.verdicts
        return {
            f"{tool} {name}": verdicts[tool][name]
            for tool, rows in self.case.expected.items()
            if tool in verdicts
            for name, allowed in rows.items()
            if verdicts[tool][name] not in allowed
        }

    @property
    def named(self) -> bool:
        """Whether the expected tools name the fault; True if there is no fault."""
        faulty = {f"{tool} {name}" for tool, names in self.case.fault.items() for name in names}
        return not faulty & set(self.wrong)

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers behind the verdicts; those with a Monte Carlo error as pairs (value, error)."""
        found: dict[str, Any] = {}
        for name, row in self.identifiability.table.iterrows():
            columns = ["contraction"] if pd.isna(row["p_negative"]) else ["contraction", "p_negative"]
            found[str(name)] = {column: _pair(row, column) for column in columns}
        if self.posterior is None:
            return found
        for name, row in self.comparison.table.iterrows():
            found[str(name)] |= {c: _pair(row, c) for c in ("shift", "sd_ratio", "skewness", "wasserstein")}
        joint = self.comparison.joint
        found["joint"] = {key: _pair(joint, key) for key in ("share_50", "share_90", "share_95", "pareto_k")}
        found["joint"]["importance_efficiency"] = float(f"{float(joint['efficiency']):.5g}")
        return found

    def line(self) -> dict[str, Any]:
        """Return the stored results of a replicate."""
        warned = any(verdict not in GOOD for rows in self.verdicts.values() for verdict in rows.values())
        return {
            "right": not self.wrong,
            "named": self.named,
            "warned": warned,
            "converged": self.converged,
            "wrong": self.wrong,
            "verdicts": self.verdicts,
            "numbers": self.numbers,
            "seconds": round(self.seconds, 2),
        }

    @property
    def converged(self) -> bool:
        """Convergence of the estimate, and of the draws if any."""
        return self.fit.converged and (self.posterior is None or self.posterior.converged)


def examine(name: str, data_seed: int, sampler_seed: int, *, drawless: bool = False) -> Outcome:
    """Return the verdicts on the data of one seed, sampled with another seed, or `drawless` from the estimate alone."""
    start, case = time.perf_counter(), CASES[name]()
    problem = case.problem(data_seed)
    fit = bp.map_estimate(problem, progress=False)
    if drawless:
        found = bp.identifiability(problem, fit)
        return Outcome(case, problem, fit, found, time.perf_counter() - start)
    posterior = bp.sample(problem, fit, seed=sampler_seed, progress=False, **case.sampling)
    found = bp.identifiability(problem, fit, posterior)
    judged = bp.compare(problem, fit, posterior), bp.predict(problem, posterior)
    return Outcome(case, problem, fit, found, time.perf_counter() - start, posterior, *judged)


def _pair(row: Any, column: str) -> list[float | None]:
    """Return a number and its Monte Carlo error to five digits, None if not finite."""
    pair = float(row[column]), float(row[f"{column}_mcse"])
    return [float(f"{value:.5g}") if abs(value) < float("inf") else None for value in pair]
