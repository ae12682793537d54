"""A measured chaotic motion: a bistable beam with a piezo element, identified from its unstable periodic orbits.

Velocity, voltage and the drive are measured in pieces, the displacement is not. Orbits are found without a model in
the first two thirds; restoring force, coupling and damping are estimated from their waveforms, one orbit after the
other, and sampled with emcee. The last third of the recording judges free runs of the model. `--part` has three
comparisons: orbits of a simulated recording with those that are there, parameters from several of them with the truth,
and multiple shooting of the measured one.
"""

import argparse
import json
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.harvester import beam, multiple_shooting, recording, synthetic
from studies.harvester.recording import Delays

COORDINATES = ("voltage", "voltage[-0.2]", "voltage[-0.4]", "voltage[-0.6]", "voltage[-0.8]")
SECTION = ("velocity", "voltage")
# Local maps a period, sections a period, and the share of the recording in which orbits are found.
STEPS, PHASES, SHARE = 7, 4, 2.0 / 3.0
# Orbits are used whose errors are at most this fraction of the waveform; quick runs have fewer and less accurate ones.
LARGEST_ERROR, QUICK_LARGEST_ERROR = 0.04, 0.1
DEGREES, COUPLING = (3, 5, 7, 9), 4
DELAY_SD = 2e-3  # s, of their priors
RUNS, RETURNS = 200, 30
REACH = 0.25  # largest displacement of the measured beam, in units of the laser times s


class Chosen(NamedTuple):
    """A model with its estimate."""

    degree: int
    estimate: bp.OrbitsEstimate
    alone: dict[str, dict[str, float]]  # see `alone_of`, by orbit and channel
    predicted: bp.AttractorPrediction  # Of the part of the recording from which the orbits are


def run(options: argparse.Namespace) -> None:
    """Run the study, or with ``--part`` only that."""
    if options.part:
        (shooting_part if options.part == "shooting" else simulated_part)(options)
        return
    watch = common.Stopwatch()
    with watch.part("recording", "the recording"):
        given = common.find_data(options.data, recording.RELATIVE)
        whole, about = recording.read(given[0]) if given else recording.simulated(options.seed)
        frequency = recording.frequency_of(whole)
        fitted, left_out = recording.divided(whole, SHARE)
    kind, count = "SYNTHETIC" if about["synthetic"] else "measured", sum(one.time.size for one in whole)
    print(f"  {kind}, {count} samples, drive {frequency:g} Hz")
    with watch.part("orbits", "finding orbits without a model, at several phases"):
        orbits = found_orbits(fitted, frequency, options.quick)
        used = reliable(orbits, QUICK_LARGEST_ERROR if options.quick else LARGEST_ERROR)
    print(f"{orbits}\n  {len(used)} are used")
    with watch.part("delays", "delays of the channels against the drive"):
        delays, errors = delays_of(used, options.seed)
    print(f"  velocity {1e3 * delays.velocity:.2f} ± {1e3 * errors.velocity:.2f} ms, voltage "
          f"{1e3 * delays.voltage:.2f} ± {1e3 * errors.voltage:.2f} ms later than the drive")  # fmt: skip
    runs = [beam.shifted(beam.experiment(orbit), *delays) for orbit in used]
    sections = [section_of([recording.aligned(one, delays) for one in part], frequency) for part in (fitted, left_out)]
    with watch.part("models", "models of several degrees, from the orbits one after the other"):
        starts = {degree: beam.start_from(used, degree, COUPLING, delays=True, seed=options.seed)
                  for degree in (DEGREES[:2] if options.quick else DEGREES)}  # fmt: skip
        tasks = [(degree, start, runs, sections[0], options.seed) for degree, start in starts.items()]
        tried = [one for one in common.each(fit_of, tasks, here=options.quick) if one is not None]
    best = simplest(tried)
    with watch.part("missing terms", "terms that this model, and that of the degree before, lack"):
        near = [one for one in tried if best.degree - 2 <= one.degree <= best.degree]
        terms = common.each(lacking, [(one,) for one in near], here=options.quick)
        lack = {one.degree: found for one, found in zip(near, terms, strict=True)}
    print(f"  missing: {lack}")
    problem, fit = best.estimate.problem, best.estimate.fit
    print(f"{best.estimate}\n  the force of degree {best.degree} is used")
    with watch.part("posterior", "sampling the posterior with emcee"):
        posterior = bp.sample(problem, fit, seed=options.seed, max_steps=100 if options.quick else 5000,
                              progress=False)  # fmt: skip
    print(posterior)
    with watch.part("prediction", "free runs against the last third of the recording"):
        predicted = bp.predict_attractor(problem, posterior, sections[1], runs=RUNS, periods=RETURNS,
                                         seed=options.seed, progress=False)  # fmt: skip
        known = bp.identifiability(problem, fit, posterior, profile=False)
    print(f"{predicted}\n{known}")
    with watch.part("figures", "drawing"):
        drawn = {
            "attractor": bp.plot.attractor(predicted),
            "orbits": drawn_orbits(best.estimate),
            "corner": corner(best.degree, problem, fit, posterior),
        }
        paths = common.save_figures(options.out, drawn)
    results = {
        "recording": about | {"frequency": frequency}, "seed": options.seed, "quick": options.quick,
        "orbits": [orbit_row(orbit, orbit in used) for orbit in orbits],
        "delays": {"seconds": delays._asdict(), "sd": errors._asdict()},
        "models": [model_row(one) for one in tried],
        "degree": best.degree, "missing": lack,
        "estimates": {n: [fit.theta[n], fit.robust_sd[n], fit.sd[n]] for n in fit.theta},
        "dropped": best.estimate.dropped,
        "multipliers": {n: str(m) for n, m in best.estimate.table["multiplier"].items()},
        "unexplained": dict(fit.fvu),
        "posterior": {n: np.quantile(posterior.draws(n), [0.05, 0.5, 0.95]).tolist() for n in fit.theta},
        "left_out": prediction_row(predicted),
    }  # fmt: skip
    common.finish(options.out, results, watch, paths, synthetic=about["synthetic"])


def simulated_part(options: argparse.Namespace) -> None:
    """Compare the orbits, or the parameters, that simulated recordings give with those that are there."""
    compared, table, what = {
        "orbits": (synthetic.campaign, synthetic.table, "orbits of the flow, and those found in recordings of it"),
        "parameters": (synthetic.coverage, synthetic.coverage_table, "orbits and parameters of simulated recordings"),
    }[options.part]
    watch = common.Stopwatch()
    with watch.part(options.part, what):
        results = compared(PHASES, options.seed, quick=options.quick)
    print(table(results))
    common.finish(options.out / options.part, {"seed": options.seed, "quick": options.quick} | results, watch,
                  synthetic=True)  # fmt: skip


def shooting_part(options: argparse.Namespace) -> None:
    """Estimate the parameters by multiple shooting, from the study's estimate, and judge them like that."""
    watch, stored = common.Stopwatch(), options.out / "results.json"
    if not stored.is_file():
        raise ValueError(f"--part: must follow the study itself, got no {stored}. Run it without --part first.")
    study = json.loads(stored.read_text("utf-8"))
    if study["degree"] != multiple_shooting.DEGREE:
        raise ValueError(f"--part: must follow a study with a force of degree {multiple_shooting.DEGREE}, got "
                         f"{study['degree']}.")  # fmt: skip
    given = common.find_data(options.data, recording.RELATIVE)
    whole, about = recording.read(given[0]) if given else recording.simulated(options.seed)
    delays, parts = Delays(**study["delays"]["seconds"]), recording.divided(whole, SHARE)
    frequency = recording.frequency_of(whole)
    fitted, left_out = ([recording.aligned(one, delays) for one in part] for part in parts)
    theta, scale = ({name: row[k] for name, row in study["estimates"].items()} for k in (0, 1))
    with watch.part("problem", "a problem with the model, from an orbit"):
        orbits = bp.find_orbits(
            bp.PoincareSection.from_recordings(parts[0], COORDINATES, frequency=frequency), periods=[3, 4],
            steps=STEPS, waveforms=True,
        )  # fmt: skip
        start = beam.Start(theta, *delays, left=(0.0, 0.0), reach=REACH)
        problem = bp.Problem(
            beam.model(multiple_shooting.DEGREE, COUPLING),
            [
                beam.shifted(beam.experiment(one), *delays)
                for one in reliable(orbits, QUICK_LARGEST_ERROR if options.quick else LARGEST_ERROR)[:1]
            ],
            priors=beam.priors_about(start),
        )
        fit = bp.map_estimate(problem, start=theta, progress=False, checks=False)
    rows, section = [], section_of(left_out, frequency)
    for periods in multiple_shooting.LENGTHS_OF_SEGMENTS[: 1 if options.quick else None]:
        with watch.part(f"{periods:g}", f"segments of {periods:g} periods"):
            segments = multiple_shooting.segments_of(fitted, periods, frequency)
            shot = multiple_shooting.estimate(segments, theta, scale, REACH)
            covariance = pd.DataFrame(shot.covariance, [*shot.theta], [*shot.theta]).loc[[*fit.theta], [*fit.theta]]
            shooting = replace(fit, theta={name: shot.theta[name] for name in fit.theta}, covariance=covariance)
            predicted = bp.predict_attractor(problem, shooting, section, runs=RUNS, periods=RETURNS,
                                             seed=options.seed, progress=False)  # fmt: skip
        print(f"  {periods:g} periods: {shot.unexplained}, {shot.evaluations} evaluations\n{predicted}")
        rows.append({"periods": periods, **shot._asdict(), "covariance": shot.covariance.tolist(),
                     **prediction_row(predicted)})  # fmt: skip
    common.finish(options.out / "shooting", {"recording": about, "seed": options.seed, "lengths": rows}, watch,
                  synthetic=about["synthetic"])  # fmt: skip


def found_orbits(recordings: list[bp.Recording], frequency: float, quick: bool) -> bp.Orbits:
    """Return the orbits of sections at several phases of the drive."""
    sections = [
        bp.PoincareSection.from_recordings(
            recordings, COORDINATES, frequency=frequency, origin=k / (PHASES * frequency)
        )
        for k in range(PHASES)
    ]
    return bp.find_orbits(sections, periods=range(1, 4 if quick else 6), steps=STEPS)


def reliable(orbits: bp.Orbits, largest: float) -> list[bp.Orbit]:
    """Return the orbits that are used, by period and multiplier; raise a ValueError if there is none."""
    used = [one for one in orbits if beam.error_of(one) < largest]
    if not used:
        raise ValueError(
            f"--data: must be a recording with orbits whose errors are below {largest:.0%}, got none of "
            f"{len(orbits)}. Record more periods."
        )
    return used


def section_of(recordings: list[bp.Recording], frequency: float) -> bp.PoincareSection:
    """Return the section of the measured channels once a period."""
    return bp.PoincareSection.from_recordings(recordings, SECTION, frequency=frequency)


def delays_of(orbits: list[bp.Orbit], seed: int) -> tuple[Delays, Delays]:
    """Return the delays of velocity and voltage by a model with them as parameters, and their standard deviations."""
    degree = 7
    start = beam.start_from(orbits, degree, COUPLING, delays=True, seed=seed)
    near = {"velocity": start.velocity_delay, "voltage": start.voltage_delay}
    problem = bp.Problem(
        beam.model(degree, COUPLING), [beam.experiment(one) for one in orbits], priors=beam.priors_about(start),
        sensors={name: bp.Sensor(delay=bp.Normal(value, DELAY_SD)) for name, value in near.items()},
    )  # fmt: skip
    first = start.values | {f"delay[{name}]": value for name, value in near.items()}
    fit = bp.estimate_orbits(problem, start=first, progress=False).fit
    means, sds = ([by_name[f"delay[{name}]"] for name in near] for by_name in (fit.theta, fit.robust_sd))
    return Delays(*means), Delays(*sds)


def fit_of(
    degree: int, start: beam.Start, runs: list[bp.Experiment], section: bp.PoincareSection, seed: int
) -> Chosen | None:
    """Return the estimate with a restoring force of this degree, and its free runs; None without any orbit."""
    problem = bp.Problem(beam.model(degree, COUPLING), runs, priors=beam.priors_about(start))
    try:
        estimate = bp.estimate_orbits(problem, start=start.values, progress=False)
        predicted = bp.predict_attractor(
            estimate.problem, estimate.fit, section, runs=RUNS, periods=RETURNS, seed=seed, progress=False
        )
    except (ValueError, RuntimeError) as error:
        print(f"  degree {degree}: {error}")
        return None
    alone = alone_of(estimate)
    left = {name: f"{value:.2%}" for name, value in estimate.fit.fvu.items()}
    print(f"  degree {degree}: {len(estimate.problem.experiments)} of {len(runs)} orbits, unexplained {left}, "
          f"{np.mean(unexplained(alone)):.2%} if left out, {predicted.left} of {predicted.runs} leave")  # fmt: skip
    return Chosen(degree, estimate, alone, predicted)


def alone_of(estimate: bp.OrbitsEstimate) -> dict[str, dict[str, float]]:
    """Return the unexplained variance of each orbit by the estimate from the others; 1 if there is no such orbit."""
    shares, solutions = {}, estimate.fit.solutions
    runs = [replace(e, guess=dict(solutions[e.name].states)) for e in estimate.problem.experiments]
    for one in runs:
        explained: dict[str, np.ndarray] = {}
        try:
            others = estimate.problem.with_experiments([e for e in runs if e is not one])
            fit = bp.map_estimate(others, start=estimate.fit.theta, checks=False, progress=False)
            solution = estimate.problem.solve(fit.theta)[one.name]
            if fit.converged and solution.status == "converged":
                explained = solution.outputs
        except ValueError as error:  # too few others
            print(f"  without {one.name}: {error}")
        shares[one.name] = {
            name: float(np.mean((values - explained.get(name, values.mean())) ** 2) / np.var(values))
            for name, values in one.outputs.items()
        }
    return shares


def lacking(one: Chosen) -> list[str]:
    """Return the terms that a model lacks, of further powers, and products with velocity and voltage."""
    powers = [f"x**{k}" for k in range(one.degree + 1, max(DEGREES) + 1)]
    candidates = {"equation of x": [*powers, "dx*x", "dx*x**2", "abs(dx)*dx", "v*x", "v*x**2", "v**3"],
                  "equation of v": ["dx*x**5", "dx*x**6", "abs(dx)*dx", "v*x", "v*x**2", "v**3"]}  # fmt: skip
    try:
        search = bp.missing_terms(one.estimate.problem, one.estimate.fit, candidates, equations=False, outputs=False,
                                  max_terms=1)  # fmt: skip
    except ValueError as error:
        print(f"  degree {one.degree}: {error}")
        return []
    return [f"{step.term} in {step.place}" for step in search.steps]


def unexplained(alone: dict[str, dict[str, float]]) -> np.ndarray:
    """Return the unexplained variance of orbits that were left out, the mean of the channels, (orbits,)."""
    return np.array([np.mean([*by_channel.values()]) for by_channel in alone.values()])


def simplest(tried: list[Chosen]) -> Chosen:
    """Return the lowest degree that predicts orbits it was not fitted to as well as the best, within a standard error.

    It is that of the mean difference over the orbits that both have.
    """
    best = min(tried, key=lambda one: float(np.mean(unexplained(one.alone))))
    for one in tried:
        both = [name for name in one.alone if name in best.alone]
        here, there = (unexplained({name: each.alone[name] for name in both}) for each in (one, best))
        if np.mean(here - there) <= np.std(here - there) / max(len(both) - 1, 1) ** 0.5:
            return one
    return best


def orbit_row(orbit: bp.Orbit, used: bool) -> dict[str, Any]:
    """Return a row of the results."""
    large = complex(orbit.eigenvalues[0])
    return {
        "name": orbit.name, "period": orbit.period, "eigenvalue": [large.real, large.imag],
        "eigenvalue_sd": float(orbit.eigenvalue_sd[0]), "returns": orbit.returns, "sections": orbit.sections,
        "error": beam.error_of(orbit), "used": used,
    }  # fmt: skip


def model_row(one: Chosen) -> dict[str, Any]:
    """Return a row of the results."""
    return {
        "degree": one.degree, "orbits": len(one.estimate.problem.experiments), "dropped": one.estimate.dropped,
        "unexplained": dict(one.estimate.fit.fvu), "alone": one.alone, **prediction_row(one.predicted),
    }  # fmt: skip


def prediction_row(predicted: bp.AttractorPrediction) -> dict[str, Any]:
    """Return the statistics of free runs."""
    return {
        "runs": predicted.runs, "left": predicted.left, "settled": predicted.settled, "unfitted": predicted.unfitted,
        "tests": predicted.table.to_dict(orient="index"), "exponents": predicted.exponents.to_dict(orient="index"),
    }  # fmt: skip


def drawn_orbits(estimate: bp.OrbitsEstimate) -> Figure:
    """Return the measured and the fitted waveforms, voltage over velocity, of each orbit."""
    experiments = estimate.problem.experiments
    columns = min(4, len(experiments))
    rows = -(-len(experiments) // columns)
    figure = Figure(figsize=(2.3 * columns, 2.3 * rows + 0.5), layout="constrained")
    every = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in every.flat[len(experiments) :]:
        axes.set_axis_off()
    for axes, one in zip(every.flat, experiments, strict=False):
        solution = estimate.fit.solutions[one.name]
        axes.plot(one.outputs["velocity"], one.outputs["voltage"], color="0.6", linewidth=3.0, label="measured")
        axes.plot(solution.outputs["velocity"], solution.outputs["voltage"], linewidth=1.0, label="model")
        large = complex(solution.multipliers[0]).real
        axes.set_title(f"{one.periods} periods, multiplier {large:.0f}", fontsize=8)
    every[0, 0].legend(fontsize=7)
    figure.supxlabel("velocity [u, the unit of the laser]", fontsize=9)
    figure.supylabel("voltage [V]", fontsize=9)
    return figure


def corner(degree: int, problem: bp.Problem, fit: bp.MapEstimate, posterior: bp.Posterior) -> Figure:
    """Return the joint posterior of restoring force, damping and gains, with Laplace's ellipses."""
    names = [n for n in ("f1", "f3", "f5", "f7", "damping", "cubic_damping", "back", "drive_gain") if n in fit.theta]
    units = beam.units_of(degree, COUPLING)
    labels = [f"{n}\n[{units[n]}]" for n in names]
    return bp.plot.corner(posterior, names=names, labels=labels, laplace=fit, problem=problem)
