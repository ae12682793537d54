"""A flutter rig identified from its measured limit cycles, stable and unstable.

An aerofoil on springs in a wind, whose stable limit cycles and unstable ones (held by control-based continuation) were
measured at wind speeds from 14.9 to 17.3 m/s (K. H. Lee, D. A. W. Barton, L. Renson, Mechanical Systems and Signal
Processing 191, 2023, 110173). Asked: what the unstable cycles add, whether the model predicts cycles that it was not
fitted to, and what cannot be known as long as the sensors' scales are free.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import bayesperiodic as bp
from studies import common
from studies import tasks as common_resumed
from studies.flutter import campaigns, questions
from studies.flutter import checks as flutter_checks
from studies.flutter import figures as flutter_figures
from studies.flutter import results as flutter_results
from studies.flutter.data import read_records, usable
from studies.flutter.rig import AUTHORS, MODEL, RIG, SENSORS, Fitted, cycles, estimate, problem

SAMPLING: dict[str, Any] = {
    "ensembles": 2,
    "walkers": 20,
    "max_steps": 12_000,
    "variances": "collapsed",
    "progress": False,
}
KINDS = ("stable", "unstable")


class Answers(NamedTuple):
    """What was asked of the cycles, and what came out."""

    checks: dict[str, Any]
    authors: dict[str, Any]
    authors_branch: dict[str, float]
    fits: dict[str, Fitted]
    left_out: dict[str, Any]
    structure: bp.Structure


class Sampled(NamedTuple):
    """The estimate with the noise's shape known, and the posterior, None in a quick run."""

    fit: bp.MapEstimate
    posterior: bp.Posterior | None = None
    verdict: bp.Identifiability | None = None
    compared: bp.Comparison | None = None


def run(options: argparse.Namespace) -> None:
    """Run the study, or the campaigns that count coverage."""
    if options.replicates:
        campaigns.run(options)
        return
    watch = common.Stopwatch()
    with watch.part("read", "reading the records and folding them without an input"):
        records, data = read_records(options.data, options.seed)
        experiments, refused = usable(records)
        speeds = {r.recording.name: r.speed for r in records if r.recording.name in experiments}
    print(flutter_results.introduction(data, records, experiments, refused))
    found = answers(watch, experiments, speeds, options.quick)
    sampled = sample(watch, found.fits["both"], experiments, speeds, options)
    with watch.part("figures", "drawing"):
        draws = 20 if options.quick else 200
        figures = flutter_figures.all_of(experiments, speeds, found.fits, sampled.fit, sampled.posterior, draws)
        paths = common.save_figures(options.out, figures)

    results = {"data": data, "seed": options.seed, "quick": options.quick}
    results |= flutter_results.of_records(records, experiments, refused)
    results |= flutter_results.of_fits(found.fits, experiments, found.authors)
    results |= {"checks": found.checks, "authors_branch": found.authors_branch, "predictions": found.left_out}
    results |= flutter_results.of_posterior(found.structure, sampled.fit, *sampled[1:])
    results |= {"seconds": watch.total(), "versions": common.versions()}
    print("\n" + flutter_results.tables(results) + f"\n{found.structure}\n{sampled.verdict or ''}")
    print(f"{sampled.compared or ''}\n")
    path = common.write_results(options.out, results)
    print(f"figures{' (synthetic data)' if data['synthetic'] else ''}: {', '.join(map(str, paths))}\nresults: {path}")


def answers(
    watch: common.Stopwatch, experiments: dict[str, bp.Experiment], speeds: dict[str, float], quick: bool
) -> Answers:
    """Return what the fits say: of the authors' values, to all cycles, to some of them, and of those left out."""
    with watch.part("authors", "following the cycles of the authors' values from the Hopf point"):
        checks = flutter_checks.account()
        print(flutter_checks.line(checks), flush=True)
        authors = questions.authors_errors(experiments, speeds)
        branch = hopf_and_fold()
    with watch.part("map", "estimating from all cycles"):
        both = estimate(experiments, speeds)
    with watch.part("parts", "estimating from stable or unstable cycles alone, and with wind speeds left out"):
        fits, left = parts(experiments, speeds, both, quick)
    with watch.part("structure", "asking what the equations leave open"):
        structure = bp.structure(MODEL, fixed=[n for n in MODEL.parameters if n in RIG or n in ("U", "c_h", "c_alpha")])
    return Answers(checks, authors, branch, fits, left, structure)


def sample(
    watch: common.Stopwatch,
    both: Fitted,
    experiments: dict[str, bp.Experiment],
    speeds: dict[str, float],
    options: argparse.Namespace,
) -> Sampled:
    """Return the estimate from all cycles with the noise's shape known and, unless the run is quick, the posterior."""
    with watch.part("known noise", "estimating with the noise's shape known"):
        stated = with_known_noise(both, experiments, speeds)
        fit = bp.map_estimate(stated, start=both.fit.theta, progress=False)
    if options.quick:
        return Sampled(fit)
    with watch.part("sample", "sampling the posterior"):
        posterior = bp.sample(stated, fit, seed=options.seed, **SAMPLING)
    with watch.part("verdicts", "asking what the data determine, and where Laplace and the draws differ"):
        verdict = bp.identifiability(stated, fit, posterior, profile=False, candidates=[])
        return Sampled(fit, posterior, verdict, bp.compare(stated, fit, posterior))


def hopf_and_fold() -> dict[str, float]:
    """Return where the authors' values have their Hopf point and their fold."""
    along = cycles(RIG | AUTHORS | SENSORS)
    fold = along.branches[0].folds[0]
    return {
        "hopf_speed": along.hopf.value,
        "hopf_frequency": along.hopf.frequency,
        "fold_speed": fold.parameters["U"],
        "fold_frequency": fold.frequency,
    }


def parts(
    experiments: dict[str, bp.Experiment], speeds: dict[str, float], both: Fitted, quick: bool
) -> tuple[dict[str, Fitted], dict[str, Any]]:
    """Return the fits by kind of cycle, and how cycles that were not fitted are predicted: by speed and by kind."""
    kinds = {kind: [name for name in experiments if questions.kind_of(name) != kind] for kind in KINDS}
    left_out = {f"{other} from {kind}": kinds[kind] for kind, other in zip(KINDS, KINDS[::-1], strict=True)}
    for group in questions.groups(speeds)[: 1 if quick else None]:
        label = " and ".join(sorted({f"{speeds[name]:g}" for name in group}))
        left_out[f"without {label} m/s"] = group
    draws, theta = 20 if quick else 200, dict(both.fit.theta)
    tasks = [(experiments, speeds, theta, names, draws) for names in left_out.values()]
    found = dict(zip(left_out, common_resumed.each(questions.leave_out, tasks), strict=True))
    fits = dict(zip(KINDS, (fitted for fitted, _ in found.values()), strict=False)) | {"both": both}
    return fits, {label: predicted for label, (_, predicted) in found.items()}


def with_known_noise(both: Fitted, experiments: dict[str, bp.Experiment], speeds: dict[str, float]) -> bp.Problem:
    """Return the problem whose noise has the shape found at the MAP point; the variances stay free."""
    shape = {name: value for name, value in both.fit.noise.items() if not name.startswith("variance")}
    guessed = list(both.problem.experiments)
    stated = problem(guessed, speeds, frequency_error=both.frequency_error, known=shape)
    return stated.anchored(stated.vector(both.fit.theta), {n: both.fit.solutions[n].states for n in experiments})
