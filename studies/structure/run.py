"""Structure: a beam of 100 degrees of freedom with a friction joint and a stop, from files to posterior and report.

Simulated tests of a steel cantilever by an integrator of its own, with exact friction and exact contact; the force and
two accelerometers have noise. Mass and stiffness matrix and the recordings are written to the folder `parts` of the
results and read from there; the chain is saved there too. ``--scaling`` measures the cost of chains of 10 to 300
degrees of freedom instead.
"""

import argparse
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.structure import beam
from studies.structure.scaling import scaling, table

TESTS = {"stuck": (5.0, 0.5), "sliding": (5.2, 1.5), "contact": (5.5, 3.0), "above": (6.5, 3.0)}  # Hz, N
FORCE_NOISE, ACCELERATION_NOISE, EVERY, POINTS = 0.02, 0.1, 16, 128  # N and m/s² of a sample
PRIORS = {
    "alpha": bp.LogNormal(1.0, 1.0),
    "joint_stiffness": bp.LogNormal(1000.0, 1.0),
    "joint_limit": bp.LogNormal(0.5, 1.0),
    "stop_k": bp.LogNormal(2000.0, 1.0),
    "stop_clearance": bp.LogNormal(3e-3, 0.5),
}
UNITS = {
    "alpha": "1/s",
    "joint_stiffness": "N/m",
    "joint_limit": "N",
    "stop_k": "N/m",
    "stop_clearance": "m",
    "variance[middle]": "(m/s²)²",
    "variance[outer]": "(m/s²)²",
}
FRICTION_WIDTH, STOP_WIDTH = 0.05, 2e-5  # of the limit; m


def write_files(folder: Path, seed: int) -> None:
    """Write the matrices (MatrixMarket) and the recordings (CSV) of all tests."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, matrix in zip(("mass", "stiffness"), beam.matrices(), strict=True):
        scipy.io.mmwrite(folder / f"{name}.mtx", scipy.sparse.coo_matrix(matrix), symmetry="symmetric", precision=17)
    generator = np.random.default_rng(seed)
    for name, (frequency, amplitude) in TESTS.items():
        motion = beam.integrated(frequency, amplitude, EVERY)
        noisy = [
            values + sd * generator.standard_normal(len(values))
            for values, sd in zip(motion[1:], (FORCE_NOISE, ACCELERATION_NOISE, ACCELERATION_NOISE), strict=True)
        ]
        columns, heading = np.column_stack([motion.time, *noisy]), "time_s,force_N,middle_m_s2,outer_m_s2"
        np.savetxt(folder / f"{name}.csv", columns, delimiter=",", header=heading, comments="", fmt="%.9g")


def model_from(folder: Path) -> bp.Model:
    """Return the beam of the matrices in a folder, with a Jenkins element and a gap."""
    mass, stiffness = (bp.read_matrix(folder / f"{name}.mtx") for name in ("mass", "stiffness"))
    return bp.Model.from_matrices(
        "beam", mass=mass, stiffness=stiffness, damping={"alpha": mass, "beta": stiffness},
        forces={"force": beam.place(beam.FORCED)},
        outputs={
            "middle": (beam.place(beam.MIDDLE), "acceleration"),
            "outer": (beam.place(beam.SECOND), "acceleration"),
        },
        elements=[
            bp.elements.Element("joint", bp.elements.jenkins, beam.place(beam.JOINT), {"width": FRICTION_WIDTH}),
            bp.elements.Element("stop", bp.elements.gap, beam.place(beam.STOP), {"width": STOP_WIDTH}),
        ],
    )  # fmt: skip


def problem_from(folder: Path) -> bp.Problem:
    """Return the problem of all tests in a folder."""
    experiments = []
    for name, (frequency, _) in TESTS.items():
        recording = bp.Recording.from_csv(
            folder / f"{name}.csv", time="time_s", inputs={"force": "force_N"},
            outputs={"middle": "middle_m_s2", "outer": "outer_m_s2"},
        )  # fmt: skip
        experiments.append(recording.fold(POINTS, frequency=frequency, name=name))
    return bp.Problem(model_from(folder), experiments, priors=PRIORS, fixed={"beta": beam.TRUTH["beta"]})


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    if options.scaling:
        with watch.part("scaling", "chains with a friction joint and a stop"):
            costs = scaling(quick=options.quick)
        print(table(costs))
        common.finish(options.out / "scaling", {"chains": costs}, watch, synthetic=True)
        return
    folder = options.out / "parts"
    with watch.part("data", "integrating the motion of the beam and writing files"):
        write_files(folder, options.seed)
    with watch.part("read", "reading them"):
        problem = problem_from(folder)
    processor = time.process_time()
    with watch.part("estimate", "estimate"):
        fit = bp.map_estimate(problem, progress=False)
    print(fit)
    with watch.part("posterior", "posterior"):
        steps = 50 if options.quick else 20_000
        chain = folder / "chain.h5"
        posterior = bp.sample(problem, fit, seed=options.seed, max_steps=steps, checkpoint=chain, progress=False)
    print(posterior)
    processor = time.process_time() - processor
    with watch.part("report", "report"):
        bp.report(problem, fit, posterior, folder / "report.html")
        figures = {"corner": corner(problem, fit, posterior)}
    results: dict[str, Any] = {
        "seed": options.seed,
        "degrees_of_freedom": 2 * beam.ELEMENTS,
        "truth": beam.TRUTH,
        "estimate": dict(fit.theta),
        "intervals": intervals(posterior),
        "processor_seconds": processor,
        "memory_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }
    saved = common.save_figures(options.out, figures)
    common.finish(options.out, results, watch, saved, synthetic=True)


def intervals(posterior: bp.Posterior) -> dict[str, list[float]]:
    """Return the 5, 50 and 95 % quantiles of the parameters."""
    return {n: np.quantile(posterior.draws(n), [0.05, 0.5, 0.95]).tolist() for n in PRIORS}


def corner(problem: bp.Problem, fit: bp.MapEstimate, posterior: bp.Posterior) -> Figure:
    """Return the joint posterior with the true values."""
    figure = bp.plot.corner(posterior, laplace=fit, problem=problem, truths={n: beam.TRUTH[n] for n in PRIORS})
    for axes in figure.axes:
        for set_label, name in ((axes.set_xlabel, axes.get_xlabel()), (axes.set_ylabel, axes.get_ylabel())):
            if name:
                set_label(f"{name}\n[{UNITS[name]}]")
    figure.subplots_adjust(left=figure.subplotpars.left + 0.02)
    return common.titled(figure, "Beam with joint and stop (synthetic data)")
