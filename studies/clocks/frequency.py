"""Coverage where the frequency is estimated: oscillators at resonance, and a limit cycle of wandering phase."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common

COVERED, STRIDE = 0.9, 10_000
# Lightly damped oscillators at resonance: quality factors, cycles recorded, samples a cycle, noise of both channels
# relative to their amplitude.
FACTORS, CYCLES, RATE, NOISE = (20, 50, 200), (10, 20, 100), 20.3, 0.02
# Standard deviation of the limit cycle's phase step in a cycle [cycles]; cycles, samples a cycle, noise.
STEPS, LIMIT_CYCLES, LIMIT_RATE, LIMIT_NOISE = (0.0, 0.001, 0.003, 0.01), 60, 25.3, 0.02
KINDS = {"estimated": "frequency estimated", "ignored": "its error ignored", "given": "frequency given"}
OSCILLATOR = bp.Model(
    "oscillator", states=["q"], inputs=["F"], parameters=["c", "k"], equations=["ddq + c*dq + k*q - F"],
    outputs={"y": "q"},
)  # fmt: skip
LIMIT_TRUTH = {"mu": 1.0, "omega": 2.0}

Task = tuple[str, int, int]


def cases() -> dict[str, tuple[float, ...]]:
    """Return Q and cycles, or the step of the phase, by the name of each case."""
    resonances: dict[str, tuple[float, ...]] = {f"Q = {q}, {n} cycles": (q, n) for q in FACTORS for n in CYCLES}
    return resonances | {f"van der Pol, step {step:g}": (step,) for step in STEPS}


def tasks(count: int, seed: int) -> list[Task]:
    """Return the recordings of all cases: case, number, seed."""
    return [(case, number, seed) for number in range(count) for case in cases()]


def replicate(task: Task) -> dict[str, Any]:
    """Return z and coverage of the parameters, and z of the frequency, from one recording."""
    case, number, seed = task
    line: dict[str, Any] = {"case": case, "number": number, "seed": seed, "source": source()}
    first, *rest = cases()[case]
    random = np.random.default_rng([seed, STRIDE + number, list(cases()).index(case)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return line | (resonance(first, rest[0], random) if rest else limit_cycle(first, random))


def resonance(quality: float, cycles: float, random: np.random.Generator) -> dict[str, Any]:
    """Return what the estimates from a resonance at 1 Hz are off, by how the frequency is treated."""
    omega = 2.0 * np.pi
    truth = {"c": omega / quality, "k": omega**2}
    time = np.arange(int(cycles * 20 + 8)) / RATE
    response = 1.0 / (truth["k"] - omega**2 + 1j * omega * truth["c"])
    y = np.real(response * np.exp(1j * omega * time))
    y += NOISE * abs(response) * random.standard_normal(time.size)
    force = np.cos(omega * time) + NOISE * random.standard_normal(time.size)
    recording, kept = bp.Recording.from_arrays(time, {"y": y}, {"F": force}), {"y": 3, "F": 1}
    free = recording.fold(16, harmonics=kept)
    runs = {
        "estimated": free,
        "ignored": replace(free, frequency_se=0.0),
        "given": recording.fold(16, harmonics=kept, frequency=1.0),
    }
    priors = {"c": bp.LogNormal(truth["c"], 1.0), "k": bp.LogNormal(truth["k"], 0.3)}
    result: dict[str, Any] = {"frequency": float((free.frequency - 1.0) / free.frequency_se)}
    for kind, run in runs.items():
        result[kind] = _deviations(bp.Problem(OSCILLATOR, [run], priors=priors, scheme="fourier"), truth)
    return result


def limit_cycle(step: float, random: np.random.Generator) -> dict[str, Any]:
    """Return what the estimates from a van der Pol oscillator are off, whose phase is a random walk."""
    frequency, amplitudes = _orbit()
    phase = np.arange(0.0, LIMIT_CYCLES + 0.5, 1.0 / LIMIT_RATE)
    time = phase / frequency
    phase = phase + step / np.sqrt(LIMIT_RATE) * np.cumsum(random.standard_normal(phase.size))
    x = np.real(np.exp(2j * np.pi * np.multiply.outer(phase, np.arange(amplitudes.size))) @ amplitudes)
    x += LIMIT_NOISE * random.standard_normal(phase.size)
    run = bp.Recording.from_arrays(time, {"displacement": x}).fold(48, origin="crossing")
    priors = {"mu": bp.LogNormal(1.0, 1.0), "omega": bp.LogNormal(2.0, 0.3)}
    problem = bp.Problem(bp.models.van_der_pol, [run], priors=priors, scheme="fourier")
    return {
        "frequency": float((run.frequency - frequency) / run.frequency_se),
        "walk": bool(run.phase_diffusion > 0.0),
        "estimated": _deviations(problem, LIMIT_TRUTH),
    }


def _orbit() -> tuple[float, np.ndarray]:
    """Return frequency and complex amplitudes of the limit cycle."""
    guess = {"x": 2.0 * np.cos(2 * np.pi * np.arange(256) / 256)}
    orbit = bp.solve_periodic(
        bp.models.van_der_pol, LIMIT_TRUTH, {}, frequency=1.0 / np.pi, samples=256, scheme="fourier", guess=guess
    )
    amplitudes = np.fft.rfft(orbit.outputs["displacement"])[:40] * (2.0 / 256)
    amplitudes[0] *= 0.5
    return orbit.frequency, amplitudes


def _deviations(problem: bp.Problem, truth: dict[str, float]) -> dict[str, Any]:
    """Return z and coverage of each parameter, or the error."""
    start = {name: truth.get(name, 0.0) for name in problem.names}
    try:
        fit = bp.map_estimate(problem, start=start, checks=False, progress=False)
    except (RuntimeError, ValueError) as error:
        return {"error": f"{type(error).__name__}: {error}"}
    ends = fit.interval(COVERED)
    return {
        "z": {name: float((fit.theta[name] - value) / fit.sd[name]) for name, value in truth.items()},
        "covered": {name: bool(ends[name][0] < value < ends[name][1]) for name, value in truth.items()},
        "status": fit.status,
    }


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage and root mean square of z, by case and treatment of the frequency."""
    found: dict[str, Any] = {}
    for case in cases():
        own = [line for line in lines if line["case"] == case]
        one: dict[str, Any] = {"frequency": _rms([line["frequency"] for line in own])}
        if "walk" in own[0]:
            one["walk"] = float(np.mean([line["walk"] for line in own]))
        for kind in KINDS:
            good = [line[kind] for line in own if kind in line and "error" not in line[kind]]
            if good:
                names = list(good[0]["z"])
                one[kind] = {
                    "coverage": {name: float(np.mean([each["covered"][name] for each in good])) for name in names},
                    "rms": {name: _rms([each["z"][name] for each in good]) for name in names},
                    "errors": sum(kind in line and "error" in line[kind] for line in own),
                }
        found[case] = one
    return found


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def checks(found: dict[str, Any], band: tuple[float, float]) -> list[common.Row]:
    """Return the coverage of each case against the band of a nominal share."""
    return [
        common.row(f"{case}: 90 % intervals of {name} that contain it", share, *band)
        for case, one in found.items()
        for name, share in one["estimated"]["coverage"].items()
    ]


def table(found: dict[str, Any]) -> str:
    """Return the text to print."""
    rows = {
        case: {"z of the frequency": f"{one['frequency']:.2f}"}
        | {
            f"{name}, {kind}": f"{one[kind]['rms'][name]:.2f}, {share:.1%}"
            for kind in KINDS
            if kind in one
            for name, share in one[kind]["coverage"].items()
            if name in ("k", "omega", "mu")
        }
        for case, one in found.items()
    }
    parts = ([c for c in rows if c.startswith("Q")], [c for c in rows if not c.startswith("Q")])
    title = "synthetic: root mean square of z, coverage of 90 % intervals"
    return "\n\n".join(common.shown(title, {case: rows[case] for case in part}) for part in parts)


def draw(found: dict[str, Any], band: Sequence[float]) -> Figure:
    """Return the coverage of 90 % intervals by Q/cycles, and by the random step of the phase."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.8), sharey=True, layout="constrained")
    ratios = np.array([values[0] / values[1] for values in cases().values() if len(values) == 2])
    resonances = [found[case] for case, values in cases().items() if len(values) == 2]
    marks = {"estimated": ("o", "C0"), "ignored": ("x", "C3"), "given": ("+", "0.4")}
    for kind, (marker, colour) in marks.items():
        share = [one[kind]["coverage"]["k"] for one in resonances]
        left.plot(ratios, share, ls="none", marker=marker, color=colour, label=KINDS[kind])
    left.set(xscale="log", xlabel="Q / cycles", ylabel="coverage of 90 % intervals", ylim=(0.0, 1.05))
    left.set_title("stiffness of an oscillator, synthetic", fontsize="medium")
    left.legend(frameon=False, loc="lower left")
    limit = [found[case] for case, values in cases().items() if len(values) == 1]
    for number, name in enumerate(LIMIT_TRUTH):
        share = [one["estimated"]["coverage"][name] for one in limit]
        right.plot(np.arange(len(share)), share, ls="none", marker="o", color=f"C{number}", label=name)
    right.set_xticks(np.arange(len(limit)), [f"{step:g}" for step in STEPS])
    right.set(xlabel="random step of the phase in a cycle [cycles]")
    right.set_title("van der Pol oscillator, synthetic", fontsize="medium")
    right.legend(frameon=False, loc="lower left")
    for axes in (left, right):
        axes.axhspan(*band, color="0.85", zorder=0)
    return figure


def source() -> str:
    """Return a key that identifies version and cases of the replicates."""
    return common.source_key(__file__)
