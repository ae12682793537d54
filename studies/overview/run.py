"""Overview in one picture: following unstable motions, finding them in chaos, and identifiability of parameters.

The frequency response of a hardening spring is computed; the pendulum's section and the posterior of two factors come
from synthetic recordings. Only the product is determined, and the Laplace approximation misses the ridge. A second
figure shows what the check of a recording finds.
"""

import argparse
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.pendulum import recording as pendulum_recording
from studies.verdicts.cases import product_ridge

PERIODS, QUICK_PERIODS = 15_000, 2_000
LONGEST = 3
SAMPLES = 200
# Of the force, whose amplitude is 100 N: the product is measured to 8 % [N].
NOISE = 35.0
# Above the section, for the legend [rad/s].
ROOM = 24.0


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    figure, panels = plt.subplots(1, 3, figsize=(13.0, 4.0), layout="constrained")
    with watch.part("follow", "following the periodic motions of a hardening spring"):
        folds = follow(panels[0])
    with watch.part("find", "finding unstable orbits in a chaotic recording"):
        found = find(panels[1], QUICK_PERIODS if options.quick else PERIODS, options.seed)
    with watch.part("judge", "sampling the posterior of the pendulum's parameters"):
        held = judge(panels[2], options.seed, 500 if options.quick else 12_000)
    paths = common.save_figures(options.out, {"overview": figure, "recording": faulty_recording()})
    results = {"folds_hz": folds, "orbits": found, "posterior": held, "seed": options.seed, "quick": options.quick}
    print(f"  folds at {folds} Hz; orbits by period {found}; {held}")
    common.finish(options.out, results, watch, paths, synthetic=True)


def follow(ax: Axes) -> list[float]:
    """Draw a frequency response, and return the frequencies of its folds."""
    force = {"force": 0.4 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)}
    values = {"m": 1.0, "c": 0.1, "k": 1.0, "k3": 0.5}
    start = bp.solve_periodic(bp.models.duffing, values, force, frequency=0.08, samples=SAMPLES, scheme="central4")
    branch = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, progress=False)
    bp.plot.branch(branch, ax=ax)
    ax.set_title("periodic motions, stable and unstable")
    return [round(fold.frequency, 4) for fold in branch.folds]


def find(ax: Axes, periods: int, seed: int) -> dict[str, int]:
    """Draw a chaotic section with its orbits, and return how many there are of each period."""
    recording = pendulum_recording.with_noise(pendulum_recording.simulate(periods, seed), 1e-3, seed)
    section = pendulum_recording.section_of(recording)
    orbits = [o for o in bp.find_orbits(section, periods=range(1, LONGEST + 1)) if not o.equilibrium]
    bp.plot.section(section, orbits, units=pendulum_recording.UNITS, ax=ax)
    legend = ax.get_legend()
    assert legend is not None
    ax.set_ylim(top=ROOM)
    ax.legend(handles=legend.legend_handles, loc="upper right", fontsize=7.5, ncols=2, columnspacing=1.0)
    ax.set_title("unstable orbits found in chaos without a model")
    return {str(p): sum(o.period == p for o in orbits) for p in range(1, LONGEST + 1)}


def judge(ax: Axes, seed: int, steps: int) -> dict[str, str | bool]:
    """Draw the posterior of two factors and its Laplace approximation, and return the verdicts on both."""
    case = product_ridge(NOISE)
    problem = case.problem(seed)
    fit = bp.map_estimate(problem, progress=False)
    posterior = bp.sample(problem, fit, seed=seed, progress=False, **{**case.sampling, "max_steps": steps})
    names, colours = list(problem.names), bp.plot.COLOURS
    draws = np.stack([posterior.draws(name) for name in names], axis=-1)
    common.draw_regions(ax, draws, [(0.0, np.inf)] * 2, colours["mcmc"])
    common.draw_ellipses(ax, np.array([fit.theta[name] for name in names]), fit.covariance.loc[names, names].to_numpy())
    ax.plot(*case.truth.values(), "x", ms=9, mew=2.5, color="black", zorder=6)
    for line in (ax.axhline, ax.axvline):
        line(0.0, color="0.6", lw=0.8, zorder=0.5)
    ax.set(xlabel="gain a", ylabel="stiffness b [N/m]", title="only a·b is determined; Laplace fails")
    handles = [
        plt.Line2D([], [], lw=6, alpha=0.7, color=colours["mcmc"], label="MCMC, 50 and 90 %"),
        plt.Line2D([], [], ls="--", color=colours["laplace"], label="Laplace, 50 and 90 %"),
        plt.Line2D([], [], marker="x", ls="", ms=8, mew=2.5, color="black", label="truth (synthetic data)"),
    ]
    ax.legend(handles=handles, loc="upper right", fontsize=8, frameon=False)
    verdicts = bp.identifiability(problem, fit, posterior, profile=False).verdicts
    return {name: verdicts[name] for name in names} | {"converged": posterior.converged}


def faulty_recording() -> Figure:
    """Draw the recording of the page docs/how_to/good_recording.md with what its check finds."""

    def motion(time: np.ndarray) -> np.ndarray:
        level = np.clip(np.minimum(time / 5, (30 - time) / 3), 0, 1)
        return np.asarray(0.0126 * level * np.cos(2 * np.pi * 0.84 * time))

    true = {"Kx": 770.0, "K": 300.0, "F0": 4.0, "Kw": 57.0, "rho": 27_000.0}
    rig = bp.simulate(
        bp.models.dahl, true, {"displacement": motion}, frequency=0.84, duration=30, sampling_rate=100,
        noise={"force": 4.0}, seed=2,
    )  # fmt: skip
    force = rig.outputs["force"].copy()
    force[[900, 1500, 1501]] = -500.0
    force[1250:1275] = force[1250]
    return bp.plot.recording(replace(rig, outputs={"force": force}, name="run 2"))
