"""A flutter rig identified from its measured limit cycles, stable and unstable.

An aerofoil on springs in a wind, whose stable limit cycles and unstable ones (stabilised by control-based continuation)
were measured at wind speeds from 14.9 to 17.3 m/s (K. H. Lee, D. A. W. Barton, L. Renson, Mechanical Systems and Signal
Processing 191, 2023, 110173). The study examines what the unstable cycles add, whether the model predicts cycles that
were not fitted, and which parameters are not identifiable while the sensors' scales are free. The cycles at the
authors' values, by continuation, are compared with eigenvalues and with a long time integration.
"""

import argparse
from typing import Any

import numpy as np
import pandas as pd

import bayesperiodic as bp
from studies import common
from studies.flutter import campaigns, questions
from studies.flutter import figures as flutter_figures
from studies.flutter.reference import hopf, settled
from studies.flutter.rig import (
    ADDRESS,
    AUTHORS,
    LARGEST_DRIFT,
    MODEL,
    RIG,
    RULE,
    SAMPLES,
    SENSORS,
    SHA256,
    TRUE,
    Fitted,
    Record,
    cycles,
    estimate,
    problem,
    read_records,
    spectral_frequency,
    usable,
)

Experiments = dict[str, bp.Experiment]
SAMPLING: dict[str, Any] = {
    "ensembles": 2, "walkers": 20, "max_steps": 12_000, "variances": "collapsed", "progress": False,
}  # fmt: skip
KINDS = ("stable", "unstable")
# Of the comparison with time integration: wind speeds [m/s]; the study's grid, and one on which the series converged.
SPEEDS = (15.6, 16.5, 17.3)
STATES = ("h", "alpha", "w")
GRIDS = (SAMPLES, 2 * SAMPLES)
CURVE = 4000


def run(options: argparse.Namespace) -> None:
    """Run the study, or the campaigns that count coverage."""
    if options.replicates:
        campaigns.run(options)
        return
    watch, draws = common.Stopwatch(), 20 if options.quick else 200
    with watch.part("read", "reading the records and folding them without an input"):
        records, data = read_records(options.data, options.seed)
        experiments, refused = usable(records)
        speeds = {r.recording.name: r.speed for r in records if r.recording.name in experiments}
    print(f"  {'SYNTHETIC records' if data['synthetic'] else 'measured records'} {data['path']}; {RULE}")
    if data["synthetic"]:
        print(f"  the measured file was not found; it is at {ADDRESS}, sha256 {SHA256}; true values {TRUE}")
    results = {"data": data, "seed": options.seed, "quick": options.quick, "rule": RULE, "refused": refused}
    results["records"] = of_records(records, experiments)
    columns = ["wind_speed", "used", "frequency", "frequency_se", "cycles", "drift"]
    print(pd.DataFrame(results["records"]).T.reindex(columns=columns).to_string())
    print("\n".join(f"  left out: {why}" for why in refused.values()))
    with watch.part("authors", "following the cycles of the authors' values from the Hopf point"):
        results["checks"], results["authors_branch"] = against_integration(), hopf_and_fold()
        authors = questions.authors_errors(experiments, speeds)
    print(integration_line(results["checks"]), flush=True)
    with watch.part("map", "estimating from all cycles"):
        both = estimate(experiments, speeds)
    with watch.part("parts", "estimating from stable or unstable cycles alone, and with wind speeds left out"):
        fits, results["predictions"] = parts(experiments, speeds, both, options.quick, draws)
    with watch.part("structure", "structural identifiability"):
        structure = bp.structure(MODEL, fixed=[n for n in MODEL.parameters if n in RIG or n in ("U", "c_h", "c_alpha")])
    with watch.part("known noise", "estimating with the noise's shape known"):
        stated = with_known_noise(both, experiments, speeds)
        fit = bp.map_estimate(stated, start=both.fit.theta, progress=False)
    posterior = verdict = compared = None
    if not options.quick:
        with watch.part("sample", "sampling the posterior"):
            posterior = bp.sample(stated, fit, seed=options.seed, **SAMPLING)
        with watch.part("verdicts", "identifiability, and Laplace against MCMC"):
            verdict = bp.identifiability(stated, fit, posterior, profile=False, candidates=[])
            compared = bp.compare(stated, fit, posterior)
    with watch.part("figures", "drawing"):
        figures = flutter_figures.all_of(experiments, speeds, fits, fit, posterior, draws)
        paths = common.save_figures(options.out, figures)

    results |= of_fits(fits, experiments, authors) | {
        "structure": {"text": str(structure), "free_scales": questions.FREE_SCALES},
        "verdicts": verdict and verdict.table["verdict"].to_dict(),
        "posterior": posterior and compared and of_draws(posterior, fit, compared),
    }
    print("\n".join(["", tables(results), str(structure), *(str(one) for one in (verdict, compared) if one), ""]))
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def parts(
    experiments: Experiments, speeds: dict[str, float], both: Fitted, quick: bool, draws: int
) -> tuple[dict[str, Fitted], dict[str, Any]]:
    """Return the fits by kind of cycle, and how cycles that were not fitted are predicted: by speed and by kind."""
    kinds = {kind: [name for name in experiments if questions.kind_of(name) != kind] for kind in KINDS}
    left_out = {f"{other} from {kind}": kinds[kind] for kind, other in zip(KINDS, KINDS[::-1], strict=True)}
    for group in questions.groups(speeds)[: 1 if quick else None]:
        label = " and ".join(sorted({f"{speeds[name]:g}" for name in group}))
        left_out[f"without {label} m/s"] = group
    tasks = [(experiments, speeds, dict(both.fit.theta), names, draws) for names in left_out.values()]
    found = dict(zip(left_out, common.each(questions.leave_out, tasks), strict=True))
    fits = dict(zip(KINDS, (fitted for fitted, _ in found.values()), strict=False)) | {"both": both}
    return fits, {label: predicted for label, (_, predicted) in found.items()}


def with_known_noise(both: Fitted, experiments: Experiments, speeds: dict[str, float]) -> bp.Problem:
    """Return the problem whose noise has the shape found at the MAP point; the variances stay free."""
    shape = {name: value for name, value in both.fit.noise.items() if not name.startswith("variance")}
    stated = problem(both.problem.experiments, speeds, frequency_error=both.frequency_error, known=shape)
    return stated.anchored(stated.vector(both.fit.theta), {n: both.fit.solutions[n].states for n in experiments})


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


def against_integration() -> dict[str, Any]:
    """Return the Hopf point and the stable cycles by both ways, and by how much they differ, by points of the grid."""
    by_grid = {points: cycles(RIG | AUTHORS | SENSORS, points) for points in GRIDS}
    point, (speed, frequency) = by_grid[SAMPLES].hopf, hopf()
    return {
        "hopf_speed": {"continuation": point.value, "eigenvalues": speed},
        "hopf_frequency": {"continuation": point.frequency, "eigenvalues": frequency},
        "stable_cycles": {
            f"{points} points": {f"{at:g} m/s": _differences(along.at("stable", at), at) for at in SPEEDS}
            for points, along in by_grid.items()
        },
    }


def _differences(orbit: bp.PeriodicSolution, speed: float) -> dict[str, float]:
    """Return the relative differences of the frequency and of each state's amplitude from a time integration's."""
    frequency, states = settled(speed)
    return {"frequency": float(orbit.frequency / frequency) - 1.0} | {
        name: questions.half_range(orbit.states[name], CURVE) / questions.half_range(own, CURVE) - 1.0
        for name, own in zip(STATES, states, strict=True)
    }


def integration_line(found: dict[str, Any]) -> str:
    """Return the text to print."""
    speed, frequency = found["hopf_speed"], found["hopf_frequency"]
    off = ", ".join(
        f"{max(abs(one[name]) for one in by_speed.values() for name in STATES):.1e} with {points}"
        for points, by_speed in found["stable_cycles"].items()
    )
    return (
        f"  the authors' values: Hopf point {speed['continuation']:.4f} m/s, {frequency['continuation']:.5f} Hz "
        f"(eigenvalues {speed['eigenvalues']:.4f}, {frequency['eigenvalues']:.5f}); amplitudes of stable cycles differ "
        f"from time integration by at most {off}"
    )


def of_records(records: list[Record], experiments: Experiments) -> dict[str, Any]:
    """Return the description of each record, and whether it is used."""
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
                "amplitude": questions.sizes(e.outputs),
            }
    return found


def of_fits(fits: dict[str, Fitted], experiments: Experiments, authors: dict[str, Any]) -> dict[str, Any]:
    """Return the results of the fits."""
    fit, found = fits["both"].fit, questions.errors(fits["both"], experiments)
    return {
        "units": {name: MODEL.units[name] for name in fit.theta},
        "map": fit.theta,
        "sd": fit.sd,
        "robust_sd": fit.robust_sd,
        "status": fit.status,
        "noise": fit.noise,
        "frequency_error_allowed": fits["both"].frequency_error,
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
        "errors_rms": questions.mean_size(found),
        "branches_kept_apart": all(one["as_measured"] for one in found.values()),
        "authors_errors": authors,
        "authors_errors_rms_where_a_cycle_exists": questions.mean_size(authors),
        "contraction": questions.contraction(fits),
    }


def of_draws(posterior: bp.Posterior, fit: bp.MapEstimate, compared: bp.Comparison) -> dict[str, Any]:
    """Return the results of the draws and of the Laplace approximation."""
    draws = {name: posterior.draws(name) for name in fit.theta}
    # On a ridge along which their ratio stays the correlation is 1.
    logarithms = [np.log(draws[name].ravel()) for name in ("k_alpha2", "gain_pitch")]
    return {
        "converged": posterior.converged,
        "reason": posterior.reason,
        "failures": posterior.failures,
        "mean": {n: float(values.mean()) for n, values in draws.items()},
        "sd": {n: float(values.std()) for n, values in draws.items()},
        "laplace_sd": dict(fit.sd),
        "correlation_of_logarithms": float(np.corrcoef(logarithms)[0, 1]),
        "laplace_verdicts": compared.table["verdict"].to_dict(),
    }


def tables(results: dict[str, Any]) -> str:
    """Return the tables to print."""
    kind = "SYNTHETIC data" if results["data"]["synthetic"] else "measured data"
    lines = [f"Flutter rig, {kind}: errors of amplitudes (heave, pitch) and of the frequency", ""]
    for name, fitted in results["errors"].items():
        own, theirs = (_per_cent(one) for one in (fitted, results["authors_errors"][name]))
        lines.append(f"  {name:17s} fitted {own}    authors' values {theirs}")
    lines.append(
        f"  rms of the amplitudes' errors {results['errors_rms']:.1%}; the authors' "
        f"{results['authors_errors_rms_where_a_cycle_exists']:.1%} where they have a cycle"
    )
    misfit = results["misfit"]
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
            missed = ", ".join(_missed(c, one[c]) for c in questions.CHANNELS if c in one)
            lines.append(f"  {case:22s} {name:17s} {missed or 'no cycle'}")
    return "\n".join(lines)


def _missed(channel: str, one: dict[str, float]) -> str:
    if "posterior_sds" not in one:
        return f"{channel} {one['error']:+.1%} (few draws have the cycle)"
    return f"{channel} {one['error']:+.1%} ({one['posterior_sds']:+.1f}, {one['sds_with_model_error']:+.1f})"


def _per_cent(one: dict[str, Any]) -> str:
    size = one["amplitude_error"]
    return f"{size['heave']:+6.1%} {size['pitch']:+6.1%} {one['frequency_error']:+6.2%}" if size else "no cycle"
