"""A flutter rig identified from its measured limit cycles, stable and unstable.

An aerofoil on springs in a wind, whose stable limit cycles and unstable ones (held by control-based continuation) were
measured at wind speeds from 14.9 to 17.3 m/s (K. H. Lee, D. A. W. Barton, L. Renson, Mechanical Systems and Signal
Processing 191, 2023, 110173). Asked: what the unstable cycles add, whether the model predicts cycles that it was not
fitted to, and what cannot be known as long as the sensors' scales are free.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common, flutter_campaigns, flutter_figures, flutter_questions
from studies.flutter_data import ADDRESS, LARGEST_DRIFT, RULE, SHA256, Record, read_records, spectral_frequency, usable
from studies.flutter_questions import FREE_SCALES
from studies.flutter_rig import AUTHORS, MODEL, RIG, SENSORS, TRUE, Fitted, cycles, estimate, problem

SAMPLING: dict[str, Any] = {"ensembles": 2, "walkers": 24, "max_steps": 12_000, "executor": 2, "progress": False}


def run(options: argparse.Namespace) -> None:
    """Run the study, or the campaigns that count coverage."""
    if options.replicates:
        flutter_campaigns.run(options)
        return
    watch = common.Stopwatch()
    with watch.part("read", "reading the records and folding them without an input"):
        records, data = read_records(options.data, options.seed)
        experiments, refused = usable(records)
        speeds = {r.recording.name: r.speed for r in records if r.recording.name in experiments}
    print(introduction(data, records, experiments, refused))
    with watch.part("authors", "following the cycles of the authors' values from the Hopf point"):
        authors = flutter_questions.authors_errors(experiments, speeds)
        known = hopf_and_fold()
    with watch.part("map", "estimating from all cycles"):
        both = estimate(experiments, speeds)
    with watch.part("subsets", "estimating from the stable cycles alone, and from the unstable ones alone"):
        fits = flutter_questions.subsets(experiments, speeds, both)
    with watch.part("left out", "leaving wind speeds out"):
        left = left_out(experiments, speeds, fits, options.quick)
    with watch.part("structure", "asking what the equations leave open"):
        structure = bp.structure(MODEL, fixed=[n for n in MODEL.parameters if n in RIG or n in ("U", "c_h", "c_alpha")])
    with watch.part("sample", "estimating with the noise's shape known" if options.quick else "sampling the posterior"):
        stated = with_known_noise(both, experiments, speeds)
        fit = bp.map_estimate(stated, start=both.fit.theta, progress=False)
        posterior = None if options.quick else bp.sample(stated, fit, seed=options.seed, **SAMPLING)
        verdict = posterior and bp.identifiability(stated, fit, posterior)
        compared = posterior and bp.compare(stated, fit, posterior)
    with watch.part("figures", "drawing"):
        draws = 4 if options.quick else 40
        figures = flutter_figures.all_of(experiments, speeds, fits, fit, posterior, draws)
        paths = common.save_figures(options.out, figures)

    results = {"data": data, "seed": options.seed, "quick": options.quick, "rule": RULE, "refused": refused}
    results |= {"records": account_of(records, experiments), "authors_branch": known}
    results |= collect(both, fits, experiments, authors, left)
    results["structure"] = {"text": str(structure), "free_scales": FREE_SCALES}
    results["verdicts"] = verdict and verdict.table["verdict"].to_dict()
    results["posterior"] = posterior and compared and draws_of(posterior, fit, compared)
    results |= {"seconds": watch.total(), "versions": common.versions()}
    print("\n" + tables(results) + f"\n{structure}\n{verdict or ''}\n{compared or ''}\n")
    path = common.write_results(options.out, results)
    print(f"figures{' (synthetic data)' if data['synthetic'] else ''}: {', '.join(map(str, paths))}\nresults: {path}")


def introduction(
    data: dict[str, Any], records: list[Record], experiments: dict[str, bp.Experiment], refused: dict[str, str]
) -> str:
    """Return what is said about the records before anything is fitted."""
    lines = [f"  {'SYNTHETIC records' if data['synthetic'] else 'measured records'} {data['path']}; {RULE}"]
    for record in records:
        name = record.recording.name
        if name in experiments:
            e = experiments[name]
            lines.append(
                f"  {name:17s} {record.speed:5.1f} m/s  {e.frequency:.5f} Hz ± {e.frequency_se / e.frequency:.4%}  "
                f"{e.cycles} cycles, drift of pitch {e.drift['pitch']:+.1%}"
            )
    lines += [f"  left out: {why}" for why in refused.values()]
    if data["synthetic"]:
        lines.append(f"  the measured file was not found; it is at {ADDRESS}, sha256 {SHA256}; true values {TRUE}")
    return "\n".join(lines)


def account_of(records: list[Record], experiments: dict[str, bp.Experiment]) -> dict[str, Any]:
    """Return what each record is, used or not."""
    found: dict[str, Any] = {}
    for record in records:
        name = record.recording.name
        found[name] = {"wind_speed": record.speed, "control": record.control, "used": name in experiments}
        if name in experiments:
            e = experiments[name]
            found[name] |= {
                "frequency": e.frequency,
                "frequency_se": e.frequency_se,
                "spectral_frequency": spectral_frequency(record, e),
                "cycles": e.cycles,
                "periodicity": e.periodicity,
                "drift": dict(e.drift),
                "largest_drift": LARGEST_DRIFT,
                "scatter_of_one_cycle": dict(e.scatter),
                "amplitude": flutter_questions.sizes(e.outputs),
            }
    return found


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


def left_out(
    experiments: dict[str, bp.Experiment], speeds: dict[str, float], fits: dict[str, Fitted], quick: bool
) -> dict[str, Any]:
    """Return the predictions of cycles that were not fitted, wind speed by wind speed and kind by kind."""
    both, draws = fits["both"], 4 if quick else 20
    names = {kind: [n for n in experiments if n.startswith("unstable") == (kind == "unstable")] for kind in fits}
    found = {
        "unstable from stable": flutter_questions.predictions(
            fits["stable"], experiments, speeds, names["unstable"], draws
        ),
        "stable from unstable": flutter_questions.predictions(
            fits["unstable"], experiments, speeds, names["stable"], draws
        ),
    }
    for group in flutter_questions.groups(speeds)[: 1 if quick else None]:
        label = " and ".join(sorted({f"{speeds[name]:g}" for name in group}))
        found[f"without {label} m/s"] = flutter_questions.leave_out(experiments, speeds, both, group, draws)
    return found


def with_known_noise(both: Fitted, experiments: dict[str, bp.Experiment], speeds: dict[str, float]) -> bp.Problem:
    """Return the problem whose noise has the shape found at the MAP point; the variances stay free."""
    shape = {name: value for name, value in both.fit.noise.items() if not name.startswith("variance")}
    guessed = list(both.problem.experiments)
    stated = problem(guessed, speeds, frequency_error=both.frequency_error, known=shape)
    return stated.anchored(stated.vector(both.fit.theta), {n: both.fit.solutions[n].states for n in experiments})


def collect(
    both: Fitted,
    fits: dict[str, Fitted],
    experiments: dict[str, bp.Experiment],
    authors: dict[str, Any],
    left: dict[str, Any],
) -> dict[str, Any]:
    """Return the content of results.json that comes from the fits."""
    fit, found = both.fit, flutter_questions.errors(both, experiments)
    return {
        "units": {name: MODEL.units[name] for name in fit.theta},
        "map": fit.theta,
        "sd": fit.sd,
        "robust_sd": fit.robust_sd,
        "status": fit.status,
        "noise": fit.noise,
        "frequency_error_allowed": both.frequency_error,
        "undetermined": list(fit.undetermined),
        "doubling_shift": fit.doubling_shift,
        "misfit": {
            "rms": fit.rms,
            "unexplained_variance": fit.fvu,
            "measurement_noise": {c: split.measurement for c, split in fit.noise_split.items()},
            "model_error": {c: split.model for c, split in fit.noise_split.items()},
            "whiteness": {c: test.p for c, test in fit.whiteness.items()},
        },
        "errors": found,
        "errors_rms": flutter_questions.mean_size(found),
        "branches_kept_apart": all(one["as_measured"] for one in found.values()),
        "authors_errors": authors,
        "authors_errors_rms_where_a_cycle_exists": flutter_questions.mean_size(authors),
        "contraction": flutter_questions.contraction(fits),
        "predictions": left,
    }


def draws_of(posterior: bp.Posterior, fit: bp.MapEstimate, compared: bp.Comparison) -> dict[str, Any]:
    """Return what the draws say, beside Laplace."""
    names = list(fit.theta)
    return {
        "converged": posterior.converged,
        "reason": posterior.reason,
        "failures": posterior.failures,
        "mean": {n: float(posterior.draws(n).mean()) for n in names},
        "sd": {n: float(posterior.draws(n).std()) for n in names},
        "laplace_sd": {n: fit.sd[n] for n in names},
        "correlation_of_logarithms": _correlation(posterior, "k_alpha2", "gain_pitch"),
        "laplace_verdicts": compared.table["verdict"].to_dict(),
    }


def _correlation(posterior: bp.Posterior, one: str, other: str) -> float:
    """Return the correlation of two parameters' logarithms: that of a ridge on which their ratio stays is 1."""
    return float(np.corrcoef(*(np.log(posterior.draws(name).ravel()) for name in (one, other)))[0, 1])


def tables(results: dict[str, Any]) -> str:
    """Return the tables, with what must be said about them."""
    kind = "SYNTHETIC data" if results["data"]["synthetic"] else "measured data"
    lines = [f"Flutter rig, {kind}: errors of amplitudes (heave, pitch) and of the frequency", ""]
    for name, one in results["errors"].items():
        theirs = results["authors_errors"][name]
        lines.append(
            f"  {name:17s} fitted {_per_cent(one)}    authors' values "
            + (_per_cent(theirs) if theirs["amplitude_error"] else "no cycle")
        )
    misfit = results["misfit"]
    lines.append(
        f"  rms of the amplitudes' errors {results['errors_rms']:.1%}; the authors' "
        f"{results['authors_errors_rms_where_a_cycle_exists']:.1%} where they have a cycle"
    )
    for channel, error in misfit["model_error"].items():
        lines.append(
            f"  {channel}: model error {error:.3g}, measurement noise {misfit['measurement_noise'][channel]:.3g} "
            f"(sensor units), whitened residual p = {misfit['whiteness'][channel]:.2g}"
        )
    lines += ["", "sd over the prior's sd by data (stable, unstable, both)"]
    for name, by in results["contraction"].items():
        lines.append(f"  {name:20s}" + "  ".join(f"{by[k]['estimate']:10.5g} ({by[k]['over_prior']:.3f})" for k in by))
    lines += ["", "cycles that were not fitted: error, in posterior sds, in sds with the model's error"]
    for case, found in results["predictions"].items():
        for name, one in found.items():
            said = [_missed(c, one[c]) for c in ("heave", "pitch") if c in one]
            lines.append(f"  {case:22s} {name:17s} " + (", ".join(said) or "no cycle"))
    return "\n".join(lines)


def _missed(channel: str, one: dict[str, float]) -> str:
    if "posterior_sds" not in one:
        return f"{channel} {one['error']:+.1%} (few draws have the cycle)"
    return f"{channel} {one['error']:+.1%} ({one['posterior_sds']:+.1f}, {one['sds_with_model_error']:+.1f})"


def _per_cent(one: dict[str, Any]) -> str:
    size = one["amplitude_error"]
    return f"{size['heave']:+6.1%} {size['pitch']:+6.1%} {one['frequency_error']:+6.2%}"
