"""A landing gear on a shaker: fourteen synthetic experiments and a heat conduction that changes its sign.

Section 4 of de Kraker, Verbeek & van de Wouw (1997), whose measurements are not public, on a simulated rig: theta4,
theta6 and theta16 of eq. (9), by experiment, for a gear that obeys eq. (9) (truth A) and for one with effects that
eq. (9) lacks (truth B). The study examines whether a negative theta16 is due to lack of information or to model error.
"""

import argparse
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

import bayesperiodic as bp
from studies import common
from studies.landing_gear import cost, drop, force, identification, missing, quality, repair, rig
from studies.landing_gear import figures as landing_gear_figures
from studies.landing_gear.drop import Dropped
from studies.landing_gear.identification import CONDUCTION, DISPLACEMENT, FORCE, PRIORS, Identified, Verdict
from studies.landing_gear.rig import FULL_SCALE, GEAR, NOISE_SHARE, RUNS, SPEED_LIMIT, STRENGTHS, TRUTHS, Run, measure

# Folder for the results of each truth until the study ends.
PARTS = "parts"
LARGE, SMALL, FIGURE_1 = "0.2 Hz 80 mm", "3 Hz 4 mm", "1 Hz 18 mm"
QUICK = tuple(run for run in RUNS if run.name in (FIGURE_1, SMALL))
DROPS, QUICK_DROPS = 200, 20
# Good gears of the population; new gears of each kind; every so many experiments of a quick run.
REFERENCES, QUICK_REFERENCES, GOOD_GEARS, FAULTY_GEARS, QUICK_STEP = 10, 4, 20, 5, 4
LARGE_STROKE, TOLERANCE = 0.06, 0.25


@dataclass(frozen=True)
class OfTruth:
    """Results of one truth."""

    recordings: dict[str, bp.Recording]  # By experiment
    verdicts: dict[str, Verdict]  # The displacement given
    joint: dict[str, Identified]  # All experiments, theta4 and theta6 in common, by the given signal
    sensitivity: dict[str, dict[str, Any]]  # The other parameters under priors, by experiment
    forced: dict[str, Verdict]  # The force given, its noise integrated out
    dropped: Dropped


def run(options: argparse.Namespace) -> None:
    """Run the study, or with ``--replicates`` campaigns of truth A, with ``--missing`` searches for missing terms.

    Both together repeat the first step of these searches on new data. ``--populations`` is about gears that differ and
    a theta16 that differs between experiments.
    """
    watch, runs = common.Stopwatch(), QUICK if options.quick else RUNS
    if options.replicates and options.missing:
        with watch.part("searches", f"terms that eq. (9) lacks, in {options.replicates} SYNTHETIC data sets a truth"):
            tasks = [(truth, options.seed + n) for n in range(options.replicates) for truth in TRUTHS]
            folder = options.out / "missing_terms_replicates"
            folder.mkdir(parents=True, exist_ok=True)
            lines = common.resumed(
                folder / "replicates.jsonl", tasks, missing.replicate, lambda line: (line["truth"], line["seed"]),
                missing.source(),
            )  # fmt: skip
        counts: dict[str, Any] = {"synthetic": True, "seed": options.seed, "truths": missing.counted(lines)}
        print(common.shown("first step of the search", counts["truths"]))
        common.finish(folder, counts, watch, synthetic=True)
        return
    if options.replicates:
        with watch.part("campaigns", f"{options.replicates} SYNTHETIC campaigns of truth A"):
            lines = campaigns(options.out / "campaigns", options.replicates, options.seed)
        found = account(lines)
        print(table(found))
        found |= {"synthetic": True, "seed": options.seed}
        common.finish(options.out / "campaigns", found, watch, synthetic=True)
        return
    truths = [options.truth] if options.truth else list(TRUTHS)
    if options.populations:
        _populations(truths, options, watch)
        return
    if options.missing:
        searches: dict[str, Any] = {"synthetic": True, "seed": options.seed}
        for truth in truths:
            with watch.part(f"search {truth}", f"terms that eq. (9) lacks for SYNTHETIC data of truth {truth}"):
                searches[truth] = missing.search(truth, options.seed, quick=options.quick, runs=runs)
            print(missing.table(truth, searches[truth]))
        common.finish(options.out / "missing_terms", searches, watch, synthetic=True)
        return
    print("All data are SYNTHETIC: a simulated rig, see studies/landing_gear/rig.py.")
    every: dict[str, OfTruth] = {}
    results: dict[str, Any] = {}
    for truth in truths:
        path, source = options.out / PARTS / f"{truth}.pkl", _source(options, truth)
        every[truth], seconds = common.remembered(path, source, partial(_of_truth, truth, runs, options))
        watch.seconds |= seconds
        results[truth] = _collect(runs, every[truth])
        print(_account(truth, results[truth]))
    if "A" in every:
        with watch.part("cost", "time of a log-posterior of truth A, against time integration until steady"):
            joint = every["A"].joint.items()
            results["cost"] = {d: cost.measure(d, one, options.seed, quick=options.quick) for d, one in joint}
        print("\n".join(cost.table(drive, one) for drive, one in results["cost"].items()))
    drawn = _of_all(runs, truths, options, watch, results)
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, drawn | _figures(runs, every, options.quick))
    results["rig"] = {
        "experiments": {r.name: {"frequency": r.frequency, "half_stroke": r.stroke, "speed": r.speed} for r in RUNS},
        "speed_limit": SPEED_LIMIT,
        "full_scale": FULL_SCALE,
        "noise_share_of_full_scale": NOISE_SHARE,
        "truth": GEAR,
        "effects_of_truth_B": STRENGTHS,
        "priors": {name: repr(prior) for name, prior in PRIORS.items()},
    }
    results["study"] = {"synthetic": True, "seed": options.seed, "quick": options.quick}
    common.finish(options.out, results, watch, paths, synthetic=True)
    shutil.rmtree(options.out / PARTS, ignore_errors=True)


def _populations(truths: Sequence[str], options: argparse.Namespace, watch: common.Stopwatch) -> None:
    """Test new gears against a population of good ones, and theta16 for a spread over the experiments."""
    each = {k: 1 if options.quick else GOOD_GEARS if k == quality.GOOD else FAULTY_GEARS for k in quality.CHANGES}
    with watch.part("quality", "quality control: a population of good gears, and new ones, good and faulty"):
        population, tested = quality.examine_all(QUICK_REFERENCES if options.quick else REFERENCES, each, options.seed)
    found: dict[str, Any] = {"synthetic": True, "seed": options.seed, "quality": quality.account(population, tested)}
    print(population, quality.table(found["quality"]), sep="\n")
    conductions = {}
    for truth in truths:
        with watch.part(f"theta16 {truth}", f"truth {truth}: theta16 as a population over the experiments"):
            runs = RUNS[::QUICK_STEP] if options.quick else RUNS
            conductions[truth] = quality.conductions(runs, truth, options.seed)
        print(conductions[truth])
    found["theta16"] = {truth: quality.account_of_population(one) for truth, one in conductions.items()}
    drawn = {
        "quality": landing_gear_figures.quality(found["quality"]),
        "theta16": landing_gear_figures.over_amplitude(conductions),
    }
    folder = options.out / "populations"
    common.finish(folder, found, watch, common.save_figures(folder, drawn), synthetic=True)


def _source(options: argparse.Namespace, truth: str) -> str:
    key = common.source_key(*(module.__file__ for module in (drop, force, identification, rig)), __file__)
    return f"{key} {truth} {options.seed} {options.quick}"


def _of_truth(truth: str, runs: Sequence[Run], options: argparse.Namespace) -> tuple[OfTruth, dict[str, float]]:
    seed, quick, watch = options.seed, options.quick, common.Stopwatch()
    with watch.part(f"rig {truth}", f"truth {truth}: simulating and recording {len(runs)} experiments"):
        recordings = {r.name: measure(r, TRUTHS[truth], seed) for r in runs}
    with watch.part(f"posteriors {truth}", f"truth {truth}: displacement given, one posterior an experiment"):
        verdicts = _judged(identification.judge_recording, recordings, options)
    with watch.part(f"joint {truth}", f"truth {truth}: all experiments at once, theta4 and theta6 in common"):
        joint = {DISPLACEMENT: identification.jointly(recordings.values(), seed, quick=quick)}
    with watch.part(f"sensitivity {truth}", f"truth {truth}: the other parameters under priors"):
        tasks = [(r, truth, seed, quick) for r in runs if r.name == SMALL or not quick]
        free = common.each(identification.with_others_free, tasks, here=quick)
        sensitivity = dict(zip([task[0].name for task in tasks], free, strict=True))
    with watch.part(f"force {truth}", f"truth {truth}: force given, one posterior an experiment"):
        given = {name: recording for name, recording in recordings.items() if name == SMALL or not quick}
        forced = _judged(force.judge, given, options)
    with watch.part(f"force joint {truth}", f"truth {truth}: force given, all experiments at once"):
        together = force.given_force(forced, seed, quick=quick)
        joint |= {FORCE: together} if together else {}
    with watch.part(f"drop {truth}", f"truth {truth}: the drop test, predicted from all experiments"):
        gear = identification.jointly(recordings.values(), seed, quick=quick, one_conduction=True)
        dropped = drop.predict(gear, TRUTHS[truth], QUICK_DROPS if quick else DROPS)
    return OfTruth(recordings, verdicts, joint, sensitivity, forced, dropped), watch.seconds


def _judged(
    work: Callable[..., Verdict], recordings: Mapping[str, bp.Recording], options: argparse.Namespace
) -> dict[str, Verdict]:
    found = {}
    tasks = [(recording, options.seed, options.quick) for recording in recordings.values()]
    for name, verdict in zip(recordings, common.each(work, tasks, here=options.quick), strict=True):
        found[name] = verdict
        print(identification.line(name, verdict), flush=True)
    return found


def _of_all(
    runs: Sequence[Run], truths: Sequence[str], options: argparse.Namespace, watch: common.Stopwatch,
    results: dict[str, Any],
) -> dict[str, Any]:  # fmt: skip
    """Run the parts common to all truths, add their results, and return the figures by name."""
    drawn: dict[str, Any] = {}
    if "B" in truths:
        with watch.part("repair", "truth B: better models, compared by their predictions of held-out experiments"):
            fits = repair.repair([r.name for r in runs], options.seed, quick=options.quick)
        results["repair"] = repair.account(fits)
        print(repair.table(results["repair"]))
        drawn["repair"] = landing_gear_figures.repaired(results["repair"])
    with watch.part("slope", "the friction's slope"):
        results["friction_slope"] = force.slope_account(runs)
    print(force.slope_line(results["friction_slope"]))
    return drawn


def _figures(runs: Sequence[Run], every: Mapping[str, OfTruth], quick: bool) -> dict[str, Any]:
    verdicts = {truth: found.verdicts for truth, found in every.items()}
    forced = {truth: found.forced for truth, found in every.items()}
    with_force = [run for run in runs if run.name in next(iter(forced.values()))]
    drawn = {
        "histories": landing_gear_figures.histories({
            truth: (found.recordings[FIGURE_1], found.verdicts[FIGURE_1].identified) for truth, found in every.items()
        }),
        "theta16": landing_gear_figures.conductions(runs, verdicts, DISPLACEMENT),
        "theta16_force": landing_gear_figures.conductions(with_force, forced, FORCE),
        "drop": landing_gear_figures.drops({truth: found.dropped for truth, found in every.items()}),
    }  # fmt: skip
    chosen = {"large": FIGURE_1 if quick else LARGE, "small": SMALL}
    drawn["loops"] = landing_gear_figures.loops(
        {truth: [by_run[name].identified for name in chosen.values()] for truth, by_run in verdicts.items()}
    )
    for stroke, name in chosen.items():
        for truth, by_run in verdicts.items():
            drawn[f"corner_{stroke}_{truth}"] = landing_gear_figures.corner(by_run[name], truth)
    return drawn


def _collect(runs: Sequence[Run], found: OfTruth) -> dict[str, Any]:
    theta16 = {name: v.identified.fit.theta[CONDUCTION] for name, v in found.verdicts.items()}
    chances = {name: v.p_negative[0] for name, v in found.verdicts.items()}
    pairs = [(a.name, b.name) for a in runs for b in runs if a.frequency == b.frequency and a.stroke > b.stroke]
    exact = {name: identification.laplace(verdict.exact) for name, verdict in found.forced.items()}
    return _posteriors(found.verdicts) | {
        "joint": {drive: force.account(joint) for drive, joint in found.joint.items()},
        "others_under_priors": found.sensitivity,
        "force_given": _posteriors(found.forced) | {"force_taken_for_exact": exact},
        "drop": drop.account(found.dropped),
        "surely_negative": [name for name, chance in chances.items() if chance > 0.99],
        "large_strokes_within_a_quarter": all(
            abs(theta16[r.name] / GEAR[CONDUCTION] - 1.0) < TOLERANCE for r in runs if r.stroke >= LARGE_STROKE
        ),
        # Experiments at one frequency whose theta16 differ in sign.
        "opposite_pairs": [
            {"pair": list(pair), "theta16": [theta16[n] for n in pair], "p_negative": [chances[n] for n in pair]}
            for pair in pairs
            if theta16[pair[0]] * theta16[pair[1]] < 0.0
        ],
    }


def _posteriors(verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    posteriors = [v.identified.posterior for v in verdicts.values()]
    return {
        "experiments": {name: identification.account(v) for name, v in verdicts.items()},
        "signs": {s: [n for n, v in verdicts.items() if v.sign == s] for s in identification.SIGNS},
        "misspecified": [name for name, v in verdicts.items() if v.misspecified],
        "posteriors_converged": sum(posterior.converged for posterior in posteriors),
        "seconds": sum(v.identified.seconds for v in verdicts.values()),
        "log_posterior_calls": sum(posterior.log_posterior_calls for posterior in posteriors),
    }


def _account(truth: str, results: Mapping[str, Any]) -> str:
    forced, moved = results["force_given"], results["drop"]["displacement"]
    wrong = sum(e["p_negative_laplace"][CONDUCTION] > 0.975 for e in forced["force_taken_for_exact"].values())
    early, late = moved["share_within_the_band"].values()
    pairs = "; ".join(" against ".join(p["pair"]) for p in results["opposite_pairs"]) or "none"
    columns = [*(f"posterior.{CONDUCTION}.{key}" for key in ("mean", "sd")), "p_negative", "sign", "misspecified"]
    columns += ["converged", "log_posterior_calls", "seconds"]
    lines = [
        common.shown(f"truth {truth}, displacement given", results["experiments"], columns),
        common.shown("other parameters under priors", results["others_under_priors"], ["mean", "sd", "p_negative"]),
        common.shown("force given", forced["experiments"], columns),
        f"pairs at one frequency that differ in sign, displacement given: {pairs}",
        f"with the force treated as exact, {wrong} would be negative (Laplace)",
        *(force.line(drive, one) for drive, one in results["joint"].items()),
        f"drop: true displacement within the 90 % band for {early:.0%} of the first 2.5 s and {late:.0%} of the time "
        f"until 30 s, off the median by up to {1e3 * moved['largest_error_of_the_median']:.3f} mm",
    ]
    return "\n".join(lines)


# Every campaign has its own noise. Experiments are sampled briefly (two ensembles of eight walkers, at most 600 steps),
# which is enough for intervals and signs; intervals of the Laplace approximation are counted too.
FILE = "campaigns.jsonl"
FIRST_SEED = 100_000
SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 8, "max_steps": 600, "variances": "collapsed", "progress": False}
LEVEL = 0.9
FAMILY = 0.01


def campaigns(folder: Path, count: int, seed: int, truth: str = "A") -> list[dict[str, Any]]:
    """Compute the campaigns missing from the file in the folder, and return all of them."""
    tasks: list[tuple[str, int]] = [(truth, FIRST_SEED * seed + number) for number in range(count)]
    return common.resumed(folder / FILE, tasks, campaign, lambda line: (line["truth"], line["seed"]), source())


def source() -> str:
    """Return a key that identifies the version of the campaigns."""
    return common.source_key(__file__, identification.__file__, rig.__file__)


def campaign(task: tuple[str, int]) -> dict[str, Any]:
    """Return the results of one campaign, by experiment."""
    truth, seed = task
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {run.name: _examine(run, truth, seed) for run in RUNS}
    return {"truth": truth, "seed": seed, "source": source(), "experiments": found}


def _examine(run: Run, truth: str, seed: int) -> dict[str, Any]:
    experiment = identification.fold(measure(run, TRUTHS[truth], seed), DISPLACEMENT)
    fitted = identification.estimate([experiment], DISPLACEMENT)
    stated, fit = fitted.problem, fitted.fit
    posterior = bp.sample(stated, fit, seed=seed, **SAMPLING)
    verdict = identification.judge(Identified(stated, fit, posterior))
    ends = [0.5 - LEVEL / 2, 0.5 + LEVEL / 2]
    mcmc = {name: np.quantile(posterior.draws(name), ends) for name in stated.names}
    return {
        "mcmc_covers": {name: bool(low < GEAR[name] < high) for name, (low, high) in mcmc.items()},
        "laplace_covers": {
            name: bool(low < GEAR[name] < high) for name, (low, high) in fit.interval(LEVEL, robust=False).items()
        },
        "sd": {name: float(posterior.draws(name).std()) for name in stated.names},
        "sign": verdict.sign,
        "misspecified": verdict.misspecified,
        "map_converged": fit.converged,
        "stop_rule": posterior.converged,
    }


def account(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return coverage over all experiments of all campaigns, and how often a sign or the model is called wrong.

    The band of a parameter is the two-sided 99 % one of the binomial distribution, familywise over the parameters.
    """
    every = [one for line in lines for one in line["experiments"].values()]
    tail = 0.5 * FAMILY / len(PRIORS)
    low, high = (float(binom.ppf(p, len(every), LEVEL)) for p in (tail, 1.0 - tail))
    by_run = {run.name: [line["experiments"][run.name] for line in lines] for run in RUNS}
    return {
        "campaigns": len(lines),
        "experiments": len(every),
        "band": [low, high],
        "covered": {kind: _covered(every, kind) for kind in ("mcmc", "laplace")},
        "covered_by_experiment": {run: _covered(own, "mcmc") for run, own in by_run.items()},
        "median_sd_by_experiment": {
            run: {name: float(np.median([one["sd"][name] for one in own])) for name in PRIORS}
            for run, own in by_run.items()
        },
        "called_negative": sum(one["sign"] == identification.NEGATIVE for one in every),
        "called_misspecified": sum(one["misspecified"] for one in every),
        "map_not_converged": sum(not one["map_converged"] for one in every),
        "stop_rule_passed": sum(one["stop_rule"] for one in every),
    }


def _covered(every: Sequence[Mapping[str, Any]], kind: str) -> dict[str, int]:
    return {name: sum(one[f"{kind}_covers"][name] for one in every) for name in PRIORS}


def table(found: Mapping[str, Any]) -> str:
    """Return the counts as text."""
    low, high = found["band"]
    title = (
        f"{found['campaigns']} campaigns, {found['experiments']} posteriors; 90 % intervals with the truth (band "
        f"{low:.0f} … {high:.0f})"
    )
    return (
        f"{common.shown(title, found['covered'])}\n{CONDUCTION} called negative {found['called_negative']} times, the "
        f"model misspecified {found['called_misspecified']} times; {found['map_not_converged']} estimates not converged"
    )
