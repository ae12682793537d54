"""Overview in one picture: following unstable motions, finding them in chaos, and identifiability of parameters.

The frequency response of a hardening spring is computed; the pendulum's section and the posterior of its mass and air
resistance come from synthetic recordings. With all parameters free only ratios of mass and friction are identifiable.
"""

import argparse

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

import bayesperiodic as bp
from studies import common
from studies.pendulum import recording as pendulum_recording
from studies.verdicts.cases import scaling_symmetry

PERIODS, QUICK_PERIODS = 15_000, 2_000
LONGEST = 3
SAMPLES = 200
MASS, AIR = "m", "k3"
PROBABILITIES = (0.5, 0.9)
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
    paths = common.save_figures(options.out, {"overview": figure})
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
    """Draw posterior draws of two parameters with the Laplace ellipses, and return the verdicts on both."""
    case = scaling_symmetry()
    problem = case.problem(seed)
    fit = bp.map_estimate(problem, progress=False)
    posterior = bp.sample(problem, fit, seed=seed, progress=False, **{**case.sampling, "max_steps": steps})
    mass, air = posterior.draws(MASS), posterior.draws(AIR)
    thin = np.random.default_rng(seed).permutation(mass.size)[:4000]
    ax.plot(mass[thin], air[thin], ".", ms=2.5, color=bp.plot.COLOURS["mcmc"], rasterized=True)
    ax.plot(*ellipses(fit), color=bp.plot.COLOURS["laplace"], ls="--")
    ax.plot(case.truth[MASS], case.truth[AIR], "x", ms=9, mew=2.5, color="black")
    ax.set(xlabel="mass m [kg]", ylabel="air resistance k3 [N m s²]", title="identifiability: only the ratio")
    handles = [
        plt.Line2D([], [], marker=".", ls="", color=bp.plot.COLOURS["mcmc"], label="MCMC"),
        plt.Line2D([], [], ls="--", color=bp.plot.COLOURS["laplace"], label="Laplace, 50 and 90 %"),
        plt.Line2D([], [], marker="x", ls="", ms=8, mew=2.5, color="black", label="truth (synthetic data)"),
    ]
    ax.legend(handles=handles, loc="lower right", fontsize=8, framealpha=0.95)
    verdicts = bp.identifiability(problem, fit, posterior, profile=False).verdicts
    return {MASS: verdicts[MASS], AIR: verdicts[AIR], "converged": posterior.converged}


def ellipses(fit: bp.MapEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipses of the Laplace approximation with the probabilities `PROBABILITIES`."""
    names = [MASS, AIR]
    factor = np.linalg.cholesky(fit.covariance.loc[names, names].to_numpy(float))
    turn = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.append(np.stack([np.cos(turn), np.sin(turn)]), [[np.nan], [np.nan]], axis=1)
    radii = np.sqrt(-2.0 * np.log1p(-np.array(PROBABILITIES)))
    wave = factor @ np.concatenate([radius * circle for radius in radii], axis=1)
    return fit.theta[MASS] + wave[0], fit.theta[AIR] + wave[1]
