"""Results of the landing gear study: content of results.json, and printed tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import bayesperiodic as bp
from studies.landing_gear import drop as landing_gear_drop
from studies.landing_gear import force
from studies.landing_gear import verdicts as landing_gear_verdicts
from studies.landing_gear.drop import Dropped
from studies.landing_gear.identification import PRIORS, Identified
from studies.landing_gear.rig import FULL_SCALE, GEAR, NOISE_SHARE, RUNS, SPEED_LIMIT, STRENGTHS, Run
from studies.landing_gear.verdicts import CONDUCTION, NEGATIVE, POSITIVE, UNDETERMINED, Verdict

LARGE_STROKE, TOLERANCE = 0.06, 0.25


@dataclass(frozen=True)
class OfTruth:
    """Results of one truth."""

    recordings: dict[str, bp.Recording]  # By experiment
    verdicts: dict[str, Verdict]  # The displacement given
    joint: dict[str, Identified]  # All experiments, theta4 and theta6 in common, by what is given
    sensitivity: dict[str, dict[str, Any]]  # The other parameters under priors, by experiment
    exact: dict[str, Identified]  # The force given and treated as exact
    forced: dict[str, Verdict]  # The force given, with its noise propagated
    dropped: Dropped


def rig() -> dict[str, Any]:
    """Return the entries of results.json on rig and truths."""
    return {
        "experiments": {r.name: {"frequency": r.frequency, "half_stroke": r.stroke, "speed": r.speed} for r in RUNS},
        "speed_limit": SPEED_LIMIT,
        "full_scale": FULL_SCALE,
        "noise_share_of_full_scale": NOISE_SHARE,
        "truth": GEAR,
        "effects_of_truth_B": STRENGTHS,
        "priors": {name: repr(prior) for name, prior in PRIORS.items()},
    }


def collect(runs: Sequence[Run], found: OfTruth) -> dict[str, Any]:
    """Return the content of results.json on one truth."""
    verdicts = found.verdicts
    return _posteriors(verdicts) | {
        "joint": {drive: force.account(joint) for drive, joint in found.joint.items()},
        "others_under_priors": found.sensitivity,
        "force_given": _with_force_given(found),
        "drop": landing_gear_drop.account(found.dropped),
        "surely_negative": [name for name, v in verdicts.items() if v.p_negative[0] > 0.99],
        "large_strokes_within_a_quarter": all(
            abs(verdicts[r.name].identified.fit.theta[CONDUCTION] / GEAR[CONDUCTION] - 1.0) < TOLERANCE
            for r in runs
            if r.stroke >= LARGE_STROKE
        ),
        "opposite_pairs": opposite_pairs(runs, verdicts),
    }


def _with_force_given(found: OfTruth) -> dict[str, Any]:
    return _posteriors(found.forced) | {
        "force_taken_for_exact": {name: landing_gear_verdicts.laplace(i) for name, i in found.exact.items()}
    }


def _posteriors(verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    posteriors = [v.identified.posterior for v in verdicts.values()]
    return {
        "experiments": {name: landing_gear_verdicts.account(v) for name, v in verdicts.items()},
        "signs": {s: [n for n, v in verdicts.items() if v.sign == s] for s in (POSITIVE, UNDETERMINED, NEGATIVE)},
        "misspecified": [name for name, v in verdicts.items() if v.misspecified],
        "posteriors_converged": sum(p is not None and p.converged for p in posteriors),
        "seconds": sum(v.identified.seconds for v in verdicts.values()),
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
    """Return the text to print on a truth."""
    forced = results["force_given"]
    signs, forced_signs = (
        "; ".join(f"{sign}: {', '.join(names) or 'none'}" for sign, names in found["signs"].items())
        for found in (results, forced)
    )
    wrong = sum(e["p_negative_laplace"][CONDUCTION] > 0.975 for e in forced["force_taken_for_exact"].values())
    drop = results["drop"]["displacement"]
    shares = list(drop["share_within_the_band"].values())
    joint = "\n".join(force.line(drive, one) for drive, one in results["joint"].items())
    pairs = "; ".join(" against ".join(p["pair"]) for p in results["opposite_pairs"]) or "none"
    return (
        f"  truth {truth}: {signs}\n"
        f"  called misspecified: {', '.join(results['misspecified']) or 'none'}\n"
        f"  pairs at one frequency that differ in sign: {pairs}\n"
        f"  {results['posteriors_converged']} of {len(results['experiments'])} posteriors converged; "
        f"{results['log_posterior_calls']} log-posteriors in {results['seconds']:.0f} s\n"
        f"{landing_gear_verdicts.table(results['others_under_priors'], results['experiments'])}\n{joint}\n"
        f"  force given: {forced_signs}; misspecified: {', '.join(forced['misspecified']) or 'none'}\n"
        f"  {forced['posteriors_converged']} of {len(forced['experiments'])} posteriors converged in "
        f"{forced['seconds']:.0f} s; taking the force for exact, {wrong} would be negative (Laplace)\n"
        f"  drop: true displacement within the 90 % band for {shares[0]:.0%} of the first 2.5 s and {shares[1]:.0%} of "
        f"the time until 30 s, off the median by up to {1e3 * drop['largest_error_of_the_median']:.3f} mm"
    )
