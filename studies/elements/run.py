"""Elements: loops of friction, and what the rounding of an ideal slider does to the estimates."""

import argparse
from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from studies import common

STIFFNESS, LIMIT, AMPLITUDE = 2e5, 10.0, 2e-4
TRUTH = {"c": 0.1, "k": 1.0, "stiffness": 1.0, "limit": 0.4}
# Angular frequencies [rad/s] and amplitudes of the force [N]; in the first run the slider does not slide.
RUNS = ((0.9, 0.15), (0.9, 0.6), (1.2, 0.6))
WIDTHS, QUICK_WIDTHS = (0.3, 0.2, 0.1, 0.05, 0.02), (0.3, 0.05)
SAMPLES, NOISE = 800, 5e-3


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    with watch.part("loops", "drawing the loops of friction"):
        loops = bp.plot.elements(frictions(), AMPLITUDE)
    with watch.part("recordings", "integrating an oscillator with an ideal slider"):
        runs = [recorded(rate, force, options.seed + number) for number, (rate, force) in enumerate(RUNS)]
    with watch.part("estimates", "estimating its parameters with rounded sliders"):
        rows = [estimated(width, runs) for width in (QUICK_WIDTHS if options.quick else WIDTHS)]
    paths = common.save_figures(options.out, {"loops": loops, "width": drawn(rows)})
    common.finish(options.out, {"widths": rows, "truth": TRUTH, "seed": options.seed}, watch, paths, synthetic=True)


def frictions() -> dict[str, Callable[..., Any]]:
    """Return elements of dry friction with the same limit force, by label."""
    elements = bp.elements
    return {
        "Coulomb": lambda d, v, s: elements.coulomb(v, LIMIT, 1e-4),
        "Jenkins, width 0.05": lambda d, v, s: elements.jenkins(s, "z", v, STIFFNESS, LIMIT, 0.05),
        "Jenkins, width 0.5": lambda d, v, s: elements.jenkins(s, "z", v, STIFFNESS, LIMIT, 0.5),
        "Dahl": lambda d, v, s: elements.dahl(s, "z", v, STIFFNESS, LIMIT),
        "Iwan, chi = -0.5": lambda d, v, s: elements.iwan(
            s, elements.iwan_states("z", 9), v, STIFFNESS, LIMIT, -0.5, 0.5, 0.1
        ),
    }


def recorded(rate: float, amplitude: float, seed: int) -> bp.Experiment:
    """Return the folded response of an oscillator with an ideal slider to a harmonic force, by time integration."""
    period = 2 * np.pi / rate

    def rates(t: float, y: np.ndarray) -> list[float]:
        x, v, friction = y
        sliding = abs(friction) >= TRUTH["limit"] and friction * v > 0.0
        elastic = 0.0 if sliding else TRUTH["stiffness"] * v
        return [v, amplitude * np.cos(rate * t) - TRUTH["c"] * v - TRUTH["k"] * x - friction, elastic]

    time = np.arange(1000) * period / 50
    seen = 40 * period + time
    path = solve_ivp(rates, (0, 60 * period), np.zeros(3), t_eval=seen, max_step=period / 100, rtol=1e-6)
    x = path.y[0] + NOISE * np.random.default_rng(seed).standard_normal(time.size)
    recording = bp.Recording.from_arrays(time, {"x": x}, {"force": amplitude * np.cos(rate * time)})
    return recording.fold(SAMPLES, frequency=rate / (2 * np.pi), name=f"{amplitude:g} N, {rate / (2 * np.pi):.3f} Hz")


def estimated(width: float, runs: list[bp.Experiment]) -> common.Row:
    """Return estimates and their errors with a slider of this width."""
    model = bp.Model.from_matrices(
        "oscillator",
        mass=[[1.0]],
        damping={"c": [[1.0]]},
        stiffness={"k": [[1.0]]},
        forces={"force": 0},
        outputs={"x": (0, "displacement")},
        elements=[bp.elements.Element("joint", bp.elements.jenkins, 0, {"width": width})],
    )
    names = {"c": "c", "k": "k", "joint_stiffness": "stiffness", "joint_limit": "limit"}
    priors = {name: bp.LogNormal(1.3 * TRUTH[of], 0.7) for name, of in names.items()}
    fit = bp.map_estimate(bp.Problem(model, runs, priors=priors), progress=False)
    errors = {of: fit.theta[name] / TRUTH[of] - 1 for name, of in names.items()}
    deviations = {of: fit.sd[name] / TRUTH[of] for name, of in names.items()}
    print(f"  width {width:g}: " + ", ".join(f"{of} {100 * error:+.2f} %" for of, error in errors.items()))
    return {"width": width, "error": errors, "sd": deviations, "converged": fit.converged}


def drawn(rows: list[common.Row]) -> Figure:
    """Draw the errors of the estimates over the width."""
    figure, axes = plt.subplots(figsize=(5.6, 3.6), layout="constrained")
    for of, colour in zip(("stiffness", "limit", "c", "k"), common.ENSEMBLES, strict=False):
        values, bars = (100 * np.array([row[key][of] for row in rows]) for key in ("error", "sd"))
        label = {"stiffness": "stiffness of the slider", "limit": "limit force", "c": "damping", "k": "spring"}[of]
        axes.errorbar(
            [row["width"] for row in rows], values, bars, fmt="o-", ms=4, capsize=3, color=colour, label=label
        )
    axes.axhline(0.0, color="0.6", lw=0.8, zorder=0)
    axes.set(xlabel="width, as a part of the limit force", ylabel="error of the estimate [%]", xlim=(0, None))
    axes.legend(frameon=False)
    return figure
