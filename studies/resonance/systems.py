"""Systems, tables of their responses, and their estimates: with the periodic solver and with the averaged equation."""

import time
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

import bayesperiodic as bp

SAMPLES, NOISE, POINTS = 64, 0.01, 40
AMPLITUDE, PHASE, BOTH = "amplitude", "amplitude and phase", "amplitude, both sweeps"

TWO_MODES = bp.Model(
    "two_modes",
    states=["x1", "x2"],
    inputs=["force"],
    parameters={"c1": "N s/m", "c2": "N s/m", "k1": "N/m", "k2": "N/m", "k12": "N/m", "k3": "N/m³"},
    equations=lambda s, p, u: [
        s.ddx1 + p.c1 * s.dx1 + p.k1 * s.x1 + p.k12 * (s.x1 - s.x2) + p.k3 * s.x1**3 - u.force,
        s.ddx2 + p.c2 * s.dx2 + p.k2 * s.x2 + p.k12 * (s.x2 - s.x1),
    ],
    outputs=lambda s, p, u: {"x1": s.x1, "x2": s.x2},
    units={"x1": "m", "x2": "m", "force": "N"},
)


class System(NamedTuple):
    """A model with its truth, and the frequencies [Hz] and force [N] of its tables."""

    model: bp.Model
    truth: dict[str, float]
    fixed: dict[str, float]
    output: str
    span: tuple[float, float]
    force: float


SYSTEMS = {
    "duffing": System(bp.models.duffing, {"c": 0.1, "k": 1.0, "k3": 0.3}, {"m": 1.0}, "displacement", (0.1, 0.26), 0.2),
    "two modes": System(
        TWO_MODES, {"c1": 0.05, "c2": 0.06, "k1": 1.0, "k2": 2.0, "k12": 0.3, "k3": 0.4}, {}, "x1", (0.12, 0.3), 0.12
    ),
}


def force(system: System) -> np.ndarray:
    """Return the force over a period."""
    return system.force * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)


@cache
def exact(name: str, direction: str) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies, in the order of a sweep, and complex amplitudes of the output at the truth."""
    system = SYSTEMS[name]
    ends = system.span if direction == "up" else system.span[::-1]
    first = bp.solve_periodic(
        system.model, system.truth | system.fixed, {"force": force(system)}, frequency=ends[0], samples=SAMPLES,
        scheme="fourier",
    )  # fmt: skip
    branch = bp.continue_periodic(system.model, first, "frequency", until=ends[1], progress=False)
    frequencies, amplitudes = np.linspace(*ends, POINTS), []
    for f in frequencies:
        # In the order of the branch, so that the first stable orbit is the one that the sweep has not left yet.
        orbit = next(orbit for orbit in bp.solutions_at(system.model, branch, float(f)) if orbit.stable)
        amplitudes.append(2 / SAMPLES * np.fft.rfft(orbit.outputs[system.output])[1])
    return frequencies, np.array(amplitudes)


def table(name: str, direction: str, seed: Any) -> dict[str, np.ndarray]:
    """Return a table with errors of real and imaginary part of `NOISE` of the largest amplitude."""
    frequencies, amplitudes = exact(name, direction)
    rng, sd = np.random.default_rng(seed), NOISE * np.abs(amplitudes).max()
    noisy = amplitudes + sd * (rng.standard_normal(POINTS) + 1j * rng.standard_normal(POINTS))
    return {"f": frequencies, "A": np.abs(noisy), "phi": np.degrees(np.angle(noisy)), "sd": np.full(POINTS, sd)}


def problem(name: str, kind: str, seed: int) -> bp.Problem:
    """Return the problem of one table, or of those of both sweeps."""
    system, runs = SYSTEMS[name], []
    for part, direction in enumerate(("up", "down") if kind == BOTH else ("up",)):
        given = table(name, direction, [seed, part])
        phases = {system.output: "phi"} if kind == PHASE else None
        these = bp.response_table(
            given, frequency="f", outputs={system.output: "A"}, inputs={"force": system.force}, phases=phases,
            sd={system.output: "sd"}, sweep=direction, samples=SAMPLES,
        )  # fmt: skip
        runs += [replace(e, name=f"{direction}, {e.name}") for e in these]
    priors = {p: bp.LogNormal(value, 0.3) for p, value in system.truth.items()}
    return bp.Problem(system.model, runs, priors=priors, fixed=system.fixed)


def averaged(
    given: dict[str, np.ndarray], level: float, start: dict[str, float]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return estimates and standard deviations, infinite if undetermined, by the averaged equation with m = 1.

    ((k + ¾ k3 A² − ω²)² + c²ω²) A² = F² ([1]_, section 4.1), of whose amplitudes A at a frequency the nearest to the
    measured one is taken.

    References
    ----------
    .. [1] A. H. Nayfeh, D. T. Mook, Nonlinear Oscillations, Wiley, 1979.
    """
    omega, names = 2 * np.pi * given["f"], list(start)

    def residuals(logs: np.ndarray) -> np.ndarray:
        c, k, k3 = np.exp(logs)
        result = []
        for w, a, sd in zip(omega, given["A"], given["sd"], strict=True):
            detuning, bend = k - w**2, 0.75 * k3
            squares = np.roots([bend**2, 2 * detuning * bend, detuning**2 + (c * w) ** 2, -(level**2)])
            real = np.sqrt(np.abs(squares[np.abs(squares.imag) < 1e-6 * np.abs(squares)].real))
            result.append((a - real[np.argmin(np.abs(real - a))]) / sd)
        return np.array(result)

    found: Any = least_squares(residuals, np.log([start[name] for name in names]), x_scale=1e-2)
    values = np.exp(found.x)
    try:
        sds = values * np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    except np.linalg.LinAlgError:  # all amplitudes lie where they do not depend on the damping
        sds = np.full(values.size, np.inf)
    return dict(zip(names, values.tolist(), strict=True)), dict(zip(names, sds.tolist(), strict=True))


def speed(seed: int, repeats: int = 5) -> dict[str, float]:
    """Return processor seconds of 64 log-posteriors of a Duffing table, and of the same table without its kinds.

    Without them a table of amplitudes is given as harmonics with a free delay of each frequency, on the default grid.
    The least of several times counts, taken in turns.
    """
    tabled = problem("duffing", AMPLITUDE, seed)
    given, system = table("duffing", "up", [seed, 0]), SYSTEMS["duffing"]
    wave = {"force": [0.0, system.force]}
    amplitudes = given["A"] * np.exp(1j * np.radians(given["phi"]))
    runs = [
        bp.Experiment.from_harmonics(f"{f:.6g} Hz", float(f), {system.output: [None, c]}, wave)
        for f, c in zip(given["f"], amplitudes, strict=True)
    ]
    priors = tabled.priors | {"shift": bp.Normal(0.0, 0.01)}
    improvised = bp.Problem(system.model, runs, priors=priors, fixed=system.fixed, local=["shift"])
    timed, result = {}, {}
    for label, one in (("table", tabled), ("improvised", improvised)):
        at, rng = np.array([system.truth.get(name, 0.0) for name in one.names]), np.random.default_rng(seed)
        theta = at + 1e-3 * np.abs(at) * rng.standard_normal((64, at.size))
        timed[label] = one.anchored(at), theta, {name: 1e-2 for name in one.free_noise}
        result[label] = np.inf
    for turn in range(repeats + 1):
        for label, (one, theta, noise) in timed.items():
            began = time.process_time()
            values = one.log_posterior(theta, noise)
            result[label] = min(result[label], time.process_time() - began if turn else np.inf)
            result[f"finite, {label}"] = float(np.mean(np.isfinite(values)))
    return result | {"ratio": result["improvised"] / result["table"]}
