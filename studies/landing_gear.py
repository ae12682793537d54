"""A landing gear on a shaker: fourteen synthetic experiments and a heat conduction that changes its sign.

Section 4 of de Kraker, Verbeek & van de Wouw (1997), whose measurements are not public, on a simulated rig: theta4,
theta6 and theta16 of eq. (9), experiment by experiment, for a gear that obeys eq. (9) (truth A) and for one with
effects that it lacks (truth B). Is a negative theta16 what the data cannot tell, or what the model gets wrong?
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import bayesperiodic as bp
from studies import (
    common,
    landing_gear_campaigns,
    landing_gear_drop,
    landing_gear_figures,
    landing_gear_force,
    landing_gear_quality,
    landing_gear_repair,
    landing_gear_slope,
    landing_gear_verdicts,
)
from studies.landing_gear_drop import Dropped
from studies.landing_gear_identification import DISPLACEMENT, FORCE, PRIORS, Identified, draw, estimate, fold
from studies.landing_gear_rig import FULL_SCALE, NOISE_SHARE, RUNS, SPEED_LIMIT, Run, measure
from studies.landing_gear_truth import GEAR, STRENGTHS, TRUTHS
from studies.landing_gear_verdicts import CONDUCTION, NEGATIVE, POSITIVE, UNDETERMINED, Verdict, judge

LARGE, SMALL, FIGURE_1 = "0.2 Hz 80 mm", "3 Hz 4 mm", "1 Hz 18 mm"
QUICK = tuple(run for run in RUNS if run.name in (FIGURE_1, SMALL))
LARGE_STROKE, TOLERANCE = 0.06, 0.25
DROPS, QUICK_DROPS = 200, 20
# Measurements of the reference, units of each kind.
UNITS, QUICK_UNITS = (10, 60), (1, 1)


def run(options: argparse.Namespace) -> None:
    """Run the study, or with ``--replicates`` campaigns of truth A alone."""
    if options.replicates < 0:
        raise ValueError(f"--replicates: {options.replicates} is not allowed; it must be at least 0.")
    if options.replicates:
        _campaigns(options)
        return
    watch, runs = common.Stopwatch(), QUICK if options.quick else RUNS
    truths = [options.truth] if options.truth else list(TRUTHS)
    print("All data are SYNTHETIC: a simulated rig, see studies/landing_gear_rig.py and landing_gear_truth.py.")
    recordings: dict[str, dict[str, bp.Recording]] = {}
    verdicts: dict[str, dict[str, Verdict]] = {}
    forced: dict[str, dict[str, Verdict]] = {}
    dropped: dict[str, Dropped] = {}
    results: dict[str, Any] = {}
    for truth in truths:
        with watch.part(f"rig {truth}", f"truth {truth}: simulating and recording {len(runs)} experiments"):
            recordings[truth] = {r.name: measure(r, TRUTHS[truth], options.seed) for r in runs}
        with watch.part(f"posteriors {truth}", f"truth {truth}: displacement given, one posterior an experiment"):
            verdicts[truth] = {n: _verdict(r, options.seed, options.quick) for n, r in recordings[truth].items()}
        with watch.part(f"joint {truth}", f"truth {truth}: all experiments at once, theta4 and theta6 in common"):
            joint = estimate([fold(r, DISPLACEMENT) for r in recordings[truth].values()], DISPLACEMENT)
        with watch.part(f"force {truth}", f"truth {truth}: force given, one posterior an experiment"):
            given = {n: r for n, r in recordings[truth].items() if n == SMALL or not options.quick}
            exact, forced[truth] = _with_force_given(given, options.seed, options.quick)
        with watch.part(f"drop {truth}", f"truth {truth}: the drop test, predicted from all experiments"):
            gear = landing_gear_drop.identify(recordings[truth].values(), options.seed, quick=options.quick)
            dropped[truth] = landing_gear_drop.predict(gear, TRUTHS[truth], QUICK_DROPS if options.quick else DROPS)
        results[truth] = collect(runs, verdicts[truth], joint)
        results[truth]["force_given"] = with_force_given(exact, forced[truth])
        results[truth]["drop"] = landing_gear_drop.account(dropped[truth])
        print(account(truth, results[truth]))
    drawn: dict[str, Any] = {}
    if "B" in truths:
        with watch.part("repair", "truth B: better models, compared by what they predict of experiments held out"):
            fits = landing_gear_repair.repair([r.name for r in runs], "B", options.seed, quick=options.quick)
        results["repair"] = landing_gear_repair.account(fits)
        print(landing_gear_repair.table(results["repair"]))
        drawn["repair"] = landing_gear_figures.repaired(results["repair"])
    with watch.part("quality", "quality control: a reference gear and units, good and faulty"):
        units = landing_gear_quality.examine_all(*(QUICK_UNITS if options.quick else UNITS), options.seed)
    results["quality"] = landing_gear_quality.account(*units)
    print(landing_gear_quality.table(results["quality"]))
    with watch.part("slope", "the friction's slope"):
        results["friction_slope"] = landing_gear_slope.account(runs)
    print(landing_gear_slope.line(results["friction_slope"]))
    with watch.part("figures", "drawing"):
        drawn |= figures(runs, recordings, verdicts, dropped, options.quick)
        drawn["theta16_force"] = landing_gear_figures.conductions(
            [run for run in runs if run.name in next(iter(forced.values()))], forced, FORCE
        )
        drawn["quality"] = landing_gear_figures.quality(*units)
        paths = common.save_figures(options.out, drawn)
    results |= {"rig": rig(), "study": {"synthetic": True, "seed": options.seed, "quick": options.quick}}
    results |= {"seconds": watch.total(), "versions": common.versions()}
    path = common.write_results(options.out, results)
    print(f"figures (synthetic data): {', '.join(map(str, paths))}\nresults: {path}")


def _campaigns(options: argparse.Namespace) -> None:
    watch, folder = common.Stopwatch(), options.out / "campaigns"
    with watch.part("campaigns", f"{options.replicates} SYNTHETIC campaigns of truth A"):
        lines = landing_gear_campaigns.campaigns(folder, options.replicates, options.seed)
    found = landing_gear_campaigns.account(lines)
    print(landing_gear_campaigns.table(found))
    found |= {"synthetic": True, "seed": options.seed, "seconds": watch.total(), "versions": common.versions()}
    print(f"results: {common.write_results(folder, found)}")


def _verdict(recording: bp.Recording, seed: int, quick: bool) -> Verdict:
    verdict = judge(draw(estimate([fold(recording, DISPLACEMENT)], DISPLACEMENT), seed, quick=quick))
    print(landing_gear_verdicts.line(recording.name, verdict), flush=True)
    return verdict


def _with_force_given(
    recordings: Mapping[str, bp.Recording], seed: int, quick: bool
) -> tuple[dict[str, Identified], dict[str, Verdict]]:
    exact, verdicts = {}, {}
    for name, recording in recordings.items():
        exact[name], verdicts[name] = landing_gear_force.judge(recording, seed, quick=quick)
        print(landing_gear_verdicts.line(name, verdicts[name]), flush=True)
    return exact, verdicts


def rig() -> dict[str, Any]:
    """Return the rig and the truths as results.json holds them."""
    return {
        "experiments": {r.name: {"frequency": r.frequency, "half_stroke": r.stroke, "speed": r.speed} for r in RUNS},
        "speed_limit": SPEED_LIMIT,
        "full_scale": FULL_SCALE,
        "noise_share_of_full_scale": NOISE_SHARE,
        "truth": GEAR,
        "effects_of_truth_B": STRENGTHS,
        "priors": {name: repr(prior) for name, prior in PRIORS.items()},
    }


def collect(runs: Sequence[Run], verdicts: Mapping[str, Verdict], joint: Identified) -> dict[str, Any]:
    """Return the content of results.json on one truth, the displacement given."""
    return _posteriors(verdicts) | {
        "joint": landing_gear_verdicts.laplace(joint),
        "surely_negative": [name for name, v in verdicts.items() if v.p_negative[0] > 0.99],
        "large_strokes_within_a_quarter": all(
            abs(verdicts[r.name].identified.fit.theta[CONDUCTION] / GEAR[CONDUCTION] - 1.0) < TOLERANCE
            for r in runs
            if r.stroke >= LARGE_STROKE
        ),
        "opposite_pairs": opposite_pairs(runs, verdicts),
    }


def with_force_given(exact: Mapping[str, Identified], verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    """Return the content of results.json on one truth, the force given."""
    return _posteriors(verdicts) | {
        "force_taken_for_exact": {name: landing_gear_verdicts.laplace(i) for name, i in exact.items()}
    }


def _posteriors(verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    posteriors = [v.identified.posterior for v in verdicts.values()]
    return {
        "experiments": {name: landing_gear_verdicts.account(v) for name, v in verdicts.items()},
        "signs": {s: [n for n, v in verdicts.items() if v.sign == s] for s in (POSITIVE, UNDETERMINED, NEGATIVE)},
        "misspecified": [name for name, v in verdicts.items() if v.misspecified],
        "posteriors_converged": sum(p is not None and p.converged for p in posteriors),
        "seconds": sum(v.identified.seconds for v in verdicts.values()),
        "cpu_seconds": sum(v.identified.cpu_seconds for v in verdicts.values()),
        "log_posterior_calls": sum(p.log_posterior_calls for p in posteriors if p is not None),
    }


def opposite_pairs(runs: Sequence[Run], verdicts: Mapping[str, Verdict]) -> list[dict[str, Any]]:
    """Return the pairs of experiments at one frequency whose theta16 differ in sign."""
    found = []
    for large in runs:
        for small in (r for r in runs if r.frequency == large.frequency and r.stroke < large.stroke):
            estimates = [verdicts[r.name].identified.fit.theta[CONDUCTION] for r in (large, small)]
            if estimates[0] * estimates[1] < 0.0:
                chances = [verdicts[r.name].p_negative[0] for r in (large, small)]
                found.append({"pair": [large.name, small.name], "theta16": estimates, "p_negative": chances})
    return found


def account(truth: str, results: Mapping[str, Any]) -> str:
    """Return what is printed of a truth."""
    forced = results["force_given"]
    signs, forced_signs = (
        "; ".join(f"{sign}: {', '.join(names) or 'none'}" for sign, names in found["signs"].items())
        for found in (results, forced)
    )
    wrong = sum(e["p_negative_laplace"][CONDUCTION] > 0.975 for e in forced["force_taken_for_exact"].values())
    drop = results["drop"]["displacement"]
    shares = list(drop["share_within_the_band"].values())
    pairs = "; ".join(" against ".join(p["pair"]) for p in results["opposite_pairs"]) or "none"
    return (
        f"  truth {truth}: {signs}\n"
        f"  called misspecified: {', '.join(results['misspecified']) or 'none'}\n"
        f"  pairs at one frequency that differ in sign: {pairs}\n"
        f"  {results['posteriors_converged']} of {len(results['experiments'])} posteriors converged; "
        f"{results['log_posterior_calls']} log-posteriors in {results['seconds']:.0f} s, "
        f"{results['cpu_seconds']:.0f} s of CPU\n"
        f"  force given: {forced_signs}; misspecified: {', '.join(forced['misspecified']) or 'none'}\n"
        f"  {forced['posteriors_converged']} of {len(forced['experiments'])} posteriors converged in "
        f"{forced['seconds']:.0f} s; taking the force for exact, {wrong} would be negative (Laplace)\n"
        f"  drop: true displacement within the 90 % band for {shares[0]:.0%} of the first 2.5 s and {shares[1]:.0%} of "
        f"the time until 30 s, off the median by up to {1e3 * drop['largest_error_of_the_median']:.3f} mm"
    )


def figures(
    runs: Sequence[Run],
    recordings: Mapping[str, Mapping[str, bp.Recording]],
    verdicts: Mapping[str, Mapping[str, Verdict]],
    dropped: Mapping[str, Dropped],
    quick: bool,
) -> dict[str, Any]:
    """Return the figures by name."""
    shown = {truth: by_run[FIGURE_1] for truth, by_run in recordings.items()}
    drawn = {
        "histories": landing_gear_figures.histories(shown, {t: verdicts[t][FIGURE_1].identified for t in shown}),
        "theta16": landing_gear_figures.conductions(runs, verdicts, DISPLACEMENT),
        "drop": landing_gear_figures.drops(dropped),
    }
    for stroke, name in (("large", FIGURE_1 if quick else LARGE), ("small", SMALL)):
        for truth in verdicts:
            identified = verdicts[truth][name].identified
            assert identified.posterior is not None
            drawn[f"corner_{stroke}_{truth}"] = bp.plot.corner(
                identified.posterior, laplace=identified.fit, names=list(PRIORS)
            )
    return drawn
