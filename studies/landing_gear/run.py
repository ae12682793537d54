"""A landing gear on a shaker: fourteen synthetic experiments and a heat conduction that changes its sign.

Section 4 of de Kraker, Verbeek & van de Wouw (1997), whose measurements are not public, on a simulated rig: theta4,
theta6 and theta16 of eq. (9), by experiment, for a gear that obeys eq. (9) (truth A) and for one with effects that
eq. (9) lacks (truth B). The study examines whether a negative theta16 is due to lack of information or to model error.
"""

import argparse
import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import bayesperiodic as bp
from studies import common
from studies.landing_gear import campaigns, cost, drop, force, identification, quality, repair, rig
from studies.landing_gear import figures as landing_gear_figures
from studies.landing_gear import results as landing_gear_results
from studies.landing_gear import verdicts as landing_gear_verdicts
from studies.landing_gear.identification import DISPLACEMENT, FORCE, PRIORS, Identified, draw, estimate, fold
from studies.landing_gear.results import OfTruth
from studies.landing_gear.rig import RUNS, TRUTHS, Run, measure
from studies.landing_gear.verdicts import Verdict, judge

# Folder for the results of each truth until the study ends.
PARTS = "parts"
LARGE, SMALL, FIGURE_1 = "0.2 Hz 80 mm", "3 Hz 4 mm", "1 Hz 18 mm"
QUICK = tuple(run for run in RUNS if run.name in (FIGURE_1, SMALL))
DROPS, QUICK_DROPS = 200, 20
# Measurements of the reference, units of each kind.
UNITS, QUICK_UNITS = (10, 60), (1, 1)


def run(options: argparse.Namespace) -> None:
    """Run the study, or with ``--replicates`` campaigns of truth A alone."""
    if options.replicates < 0:
        raise ValueError(f"--replicates: must be at least 0, got {options.replicates}.")
    if options.replicates:
        _campaigns(options)
        return
    watch, runs = common.Stopwatch(), QUICK if options.quick else RUNS
    truths = [options.truth] if options.truth else list(TRUTHS)
    print("All data are SYNTHETIC: a simulated rig, see studies/landing_gear/rig.py.")
    every: dict[str, OfTruth] = {}
    results: dict[str, Any] = {}
    for truth in truths:
        path, source = options.out / PARTS / f"{truth}.pkl", _source(options, truth)
        every[truth], seconds = common.remembered(path, source, partial(_of_truth, truth, runs, options))
        watch.seconds |= seconds
        results[truth] = landing_gear_results.collect(runs, every[truth])
        print(landing_gear_results.account(truth, results[truth]))
    if "A" in every:
        results["cost"] = _cost(every["A"].joint, options, watch)
    drawn = _of_all(runs, truths, options, watch, results)
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, drawn | figures(runs, every, options.quick))
    results |= {"rig": landing_gear_results.rig()}
    results |= {"study": {"synthetic": True, "seed": options.seed, "quick": options.quick}}
    results |= {"seconds": watch.total(), "versions": common.versions()}
    path = common.write_results(options.out, results)
    shutil.rmtree(options.out / PARTS, ignore_errors=True)
    print(f"figures (synthetic data): {', '.join(map(str, paths))}\nresults: {path}")


def _source(options: argparse.Namespace, truth: str) -> str:
    """Return a key that identifies version and settings of kept posteriors."""
    modules = drop, force, identification, landing_gear_results, rig, landing_gear_verdicts
    files = [common.sha256(Path(str(module.__file__))) for module in modules]
    return " ".join([common.versions()["bayesperiodic"], truth, str(options.seed), str(options.quick), *files])


def _of_truth(truth: str, runs: Sequence[Run], options: argparse.Namespace) -> tuple[OfTruth, dict[str, float]]:
    """Return the results of one truth, and the seconds of its parts."""
    seed, quick, watch = options.seed, options.quick, common.Stopwatch()
    with watch.part(f"rig {truth}", f"truth {truth}: simulating and recording {len(runs)} experiments"):
        recordings = {r.name: measure(r, TRUTHS[truth], seed) for r in runs}
    with watch.part(f"posteriors {truth}", f"truth {truth}: displacement given, one posterior an experiment"):
        verdicts = _with_displacement_given(recordings, seed, quick)
    with watch.part(f"joint {truth}", f"truth {truth}: all experiments at once, theta4 and theta6 in common"):
        joint = {DISPLACEMENT: force.given_displacement(recordings.values(), seed, quick=quick)}
    with watch.part(f"sensitivity {truth}", f"truth {truth}: the other parameters under priors"):
        varied = [r for r in runs if r.name == SMALL] if quick else runs
        sensitivity = landing_gear_verdicts.examine_all(varied, truth, seed, quick=quick)
    with watch.part(f"force {truth}", f"truth {truth}: force given, one posterior an experiment"):
        given = {name: recording for name, recording in recordings.items() if name == SMALL or not quick}
        exact, forced = _with_force_given(given, seed, quick)
    with watch.part(f"force joint {truth}", f"truth {truth}: force given, all experiments at once"):
        together = force.given_force(forced, seed, quick=quick)
        joint |= {FORCE: together} if together else {}
    with watch.part(f"drop {truth}", f"truth {truth}: the drop test, predicted from all experiments"):
        gear = drop.identify(recordings.values(), seed, quick=quick)
        dropped = drop.predict(gear, TRUTHS[truth], QUICK_DROPS if quick else DROPS)
    return OfTruth(recordings, verdicts, joint, sensitivity, exact, forced, dropped), watch.seconds


def _cost(joint: Mapping[str, Identified], options: argparse.Namespace, watch: common.Stopwatch) -> dict[str, Any]:
    with watch.part("cost", "what a log-posterior of truth A costs, against time integration until steady"):
        found = {drive: cost.measure(drive, one, options.seed, quick=options.quick) for drive, one in joint.items()}
    print("\n".join(cost.table(drive, one) for drive, one in found.items()))
    return found


def _of_all(
    runs: Sequence[Run],
    truths: Sequence[str],
    options: argparse.Namespace,
    watch: common.Stopwatch,
    results: dict[str, Any],
) -> dict[str, Any]:
    """Run the parts common to all truths, add their results, and return the figures by name."""
    drawn: dict[str, Any] = {}
    if "B" in truths:
        with watch.part("repair", "truth B: better models, compared by what they predict of experiments held out"):
            fits = repair.repair([r.name for r in runs], "B", options.seed, quick=options.quick)
        results["repair"] = repair.account(fits)
        print(repair.table(results["repair"]))
        drawn["repair"] = landing_gear_figures.repaired(results["repair"])
    with watch.part("quality", "quality control: a reference gear and units, good and faulty"):
        units = quality.examine_all(*(QUICK_UNITS if options.quick else UNITS), options.seed)
    results["quality"] = quality.account(*units)
    print(quality.table(results["quality"]))
    drawn["quality"] = landing_gear_figures.quality(*units)
    with watch.part("slope", "the friction's slope"):
        results["friction_slope"] = force.slope_account(runs)
    print(force.slope_line(results["friction_slope"]))
    return drawn


def _campaigns(options: argparse.Namespace) -> None:
    watch, folder = common.Stopwatch(), options.out / "campaigns"
    with watch.part("campaigns", f"{options.replicates} SYNTHETIC campaigns of truth A"):
        lines = campaigns.campaigns(folder, options.replicates, options.seed)
    found = campaigns.account(lines)
    print(campaigns.table(found))
    found |= {"synthetic": True, "seed": options.seed, "seconds": watch.total(), "versions": common.versions()}
    print(f"results: {common.write_results(folder, found)}")


def _with_displacement_given(recordings: Mapping[str, bp.Recording], seed: int, quick: bool) -> dict[str, Verdict]:
    verdicts = {}
    tasks = [(recording, seed, quick) for recording in recordings.values()]
    for name, verdict in zip(recordings, common.each(_verdict, tasks, here=quick), strict=True):
        verdicts[name] = verdict
        print(landing_gear_verdicts.line(name, verdict), flush=True)
    return verdicts


def _verdict(recording: bp.Recording, seed: int, quick: bool) -> Verdict:
    return judge(draw(estimate([fold(recording, DISPLACEMENT)], DISPLACEMENT), seed, quick=quick))


def _with_force_given(
    recordings: Mapping[str, bp.Recording], seed: int, quick: bool
) -> tuple[dict[str, Identified], dict[str, Verdict]]:
    exact, verdicts = {}, {}
    tasks = [(recording, seed, quick) for recording in recordings.values()]
    for name, found in zip(recordings, common.each(force.judge, tasks, here=quick), strict=True):
        exact[name], verdicts[name] = found
        print(landing_gear_verdicts.line(name, verdicts[name]), flush=True)
    return exact, verdicts


def figures(runs: Sequence[Run], every: Mapping[str, OfTruth], quick: bool) -> dict[str, Any]:
    """Return the figures of all truths by name."""
    shown = {truth: found.recordings[FIGURE_1] for truth, found in every.items()}
    verdicts = {truth: found.verdicts for truth, found in every.items()}
    forced = {truth: found.forced for truth, found in every.items()}
    drawn = {
        "histories": landing_gear_figures.histories(shown, {t: verdicts[t][FIGURE_1].identified for t in shown}),
        "theta16": landing_gear_figures.conductions(runs, verdicts, DISPLACEMENT),
        "theta16_force": landing_gear_figures.conductions(
            [run for run in runs if run.name in next(iter(forced.values()))], forced, FORCE
        ),
        "drop": landing_gear_figures.drops({truth: found.dropped for truth, found in every.items()}),
    }
    chosen = {"large": FIGURE_1 if quick else LARGE, "small": SMALL}
    drawn["loops"] = landing_gear_figures.loops(
        {truth: [by_run[name].identified for name in chosen.values()] for truth, by_run in verdicts.items()}
    )
    for stroke, name in chosen.items():
        for truth in verdicts:
            identified = verdicts[truth][name].identified
            assert identified.posterior is not None
            drawn[f"corner_{stroke}_{truth}"] = bp.plot.corner(
                identified.posterior, laplace=identified.fit, names=list(PRIORS)
            )
    return drawn
