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
from studies.flutter import figures as flutter_figures
from studies.flutter import questions, rig
from studies.flutter.reference import hopf, settled

SAMPLING: dict[str, Any] = {
    "ensembles": 2, "walkers": 20, "max_steps": 12_000, "variances": "collapsed", "progress": False,
}  # fmt: skip
KINDS = ("stable", "unstable")
# Of the comparison with time integration: wind speeds [m/s]; the study's grid, and one on which the series converged.
SPEEDS = (15.6, 16.5, 17.3)
STATES = ("h", "alpha", "w")
GRIDS = (rig.SAMPLES, 2 * rig.SAMPLES)
CURVE = 4000


def run(options: argparse.Namespace) -> None:
    """Run the study, or the campaigns that count coverage."""
    if options.replicates:
        questions.campaigns(options)
        return
    watch, draws = common.Stopwatch(), 20 if options.quick else 200
    with watch.part("read", "reading the records and folding them without an input"):
        records, data = rig.read_records(options.data, options.seed)
        experiments, refused = rig.usable(records)
        speeds = {r.recording.name: r.speed for r in records if r.recording.name in experiments}
    print(f"  {'SYNTHETIC records' if data['synthetic'] else 'measured records'} {data['path']}; {rig.RULE}")
    if data["synthetic"]:
        print(f"  the measured file was not found; it is at {rig.ADDRESS}, sha256 {rig.SHA256}; true values {rig.TRUE}")
    results = {"data": data, "seed": options.seed, "quick": options.quick, "rule": rig.RULE, "refused": refused}
    results["records"] = _of_records(records, experiments)
    columns = ["wind_speed", "used", "frequency", "frequency_se", "cycles", "drift.pitch"]
    print(common.shown("records", results["records"], columns), *refused.values(), sep="\n")
    with watch.part("authors", "following the cycles of the authors' values from the Hopf point"):
        results |= _authors_cycles()
        authors = questions.authors_errors(experiments, speeds)
    checked = dict(results["checks"])
    by_grid = checked.pop("stable_cycles")
    cycles = {f"{grid}, {at}": row for grid, rows in by_grid.items() for at, row in rows.items()}
    print(common.shown("Hopf point of the authors' values", checked))
    print(common.shown("relative difference of stable cycles from time integration", cycles), flush=True)
    with watch.part("map", "estimating from all cycles"):
        both = rig.estimate(experiments, speeds)
    with watch.part("parts", "estimating from stable or unstable cycles alone, and with wind speeds left out"):
        fits, results["predictions"] = _parts(experiments, speeds, both, options.quick, draws)
    with watch.part("structure", "structural identifiability"):
        known = (*rig.RIG, "U", "c_h", "c_alpha")
        structure = bp.structure(rig.MODEL, fixed=[name for name in rig.MODEL.parameters if name in known])
    with watch.part("known noise", "estimating with the noise's shape known"):
        stated = _with_known_noise(both, experiments, speeds)
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

    results |= _of_fits(fits, experiments, authors) | {
        "structure": {"text": str(structure), "free_scales": questions.FREE_SCALES},
        "verdicts": verdict and verdict.table["verdict"].to_dict(),
        "posterior": posterior and compared and _of_draws(posterior, fit, compared),
    }
    print("\n".join(["", _tables(results), str(structure), *(str(one) for one in (verdict, compared) if one), ""]))
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def _parts(
    experiments: rig.Experiments, speeds: dict[str, float], both: rig.Fitted, quick: bool, draws: int
) -> tuple[dict[str, rig.Fitted], dict[str, Any]]:
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


def _with_known_noise(both: rig.Fitted, experiments: rig.Experiments, speeds: dict[str, float]) -> bp.Problem:
    """Return the problem whose noise has the shape found at the MAP point; the variances stay free."""
    shape = {name: value for name, value in both.fit.noise.items() if not name.startswith("variance")}
    stated = rig.problem(both.problem.experiments, speeds, frequency_error=both.frequency_error, known=shape)
    return stated.anchored(stated.vector(both.fit.theta), {n: both.fit.solutions[n].states for n in experiments})


def _authors_cycles() -> dict[str, Any]:
    """Return the branch of the authors' values, and how it differs from eigenvalues and time integration."""
    by_grid = {points: rig.cycles(rig.RIG | rig.AUTHORS | rig.SENSORS, points) for points in GRIDS}
    point, (speed, frequency) = by_grid[rig.SAMPLES].hopf, hopf()
    fold = by_grid[rig.SAMPLES].branches[0].folds[0]
    checks = {
        "hopf_speed": {"continuation": point.value, "eigenvalues": speed},
        "hopf_frequency": {"continuation": point.frequency, "eigenvalues": frequency},
        "stable_cycles": {
            f"{points} points": {f"{at:g} m/s": _differences(along.at("stable", at), at) for at in SPEEDS}
            for points, along in by_grid.items()
        },
    }
    branch = {"hopf_speed": point.value, "hopf_frequency": point.frequency}
    branch |= {"fold_speed": fold.parameters["U"], "fold_frequency": fold.frequency}
    return {"checks": checks, "authors_branch": branch}


def _differences(orbit: bp.PeriodicSolution, speed: float) -> dict[str, float]:
    """Return the relative differences of the frequency and of each state's amplitude from a time integration's."""
    frequency, states = settled(speed)
    return {"frequency": float(orbit.frequency / frequency) - 1.0} | {
        name: questions.half_range(orbit.states[name], CURVE) / questions.half_range(own, CURVE) - 1.0
        for name, own in zip(STATES, states, strict=True)
    }


def _of_records(records: list[rig.Record], experiments: rig.Experiments) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for record in records:
        name = record.recording.name
        found[name] = {"wind_speed": record.speed, "control": record.control, "used": name in experiments}
        if name in experiments:
            e = experiments[name]
            found[name] |= {
                "frequency": e.frequency,
                "frequency_se": e.frequency_se,
                "spectral_frequency": rig.spectral_frequency(record, e),
                "cycles": e.cycles,
                "periodicity": e.periodicity,
                "drift": dict(e.drift),
                "largest_drift": rig.LARGEST_DRIFT,
                "scatter_of_one_cycle": dict(e.scatter),
                "amplitude": questions.sizes(e.outputs),
            }
    return found


def _of_fits(fits: dict[str, rig.Fitted], experiments: rig.Experiments, authors: dict[str, Any]) -> dict[str, Any]:
    fit, found = fits["both"].fit, questions.errors(fits["both"], experiments)
    return {
        "units": {name: rig.MODEL.units[name] for name in fit.theta},
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


def _of_draws(posterior: bp.Posterior, fit: bp.MapEstimate, compared: bp.Comparison) -> dict[str, Any]:
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


def _tables(results: dict[str, Any]) -> str:
    kind = "SYNTHETIC data" if results["data"]["synthetic"] else "measured data"
    columns = [*(f"amplitude_error.{channel}" for channel in questions.CHANNELS), "frequency_error"]
    missed = [f"{c}.{k}" for c in questions.CHANNELS for k in ("error", "posterior_sds", "sds_with_model_error")]
    gained = [f"{kind}.{key}" for kind in (*KINDS, "both") for key in ("estimate", "over_prior")]
    return "\n".join([
        f"Flutter rig, {kind}",
        common.shown("relative errors of the fitted cycles", results["errors"], columns),
        common.shown("relative errors of the authors' values, - without a cycle", results["authors_errors"], columns),
        f"rms of the amplitudes' errors {results['errors_rms']:.1%}; the authors' "
        f"{results['authors_errors_rms_where_a_cycle_exists']:.1%} where they have a cycle",
        "misfit by channel (sensor units; whiteness: p of the whitened residual)",
        pd.DataFrame(results["misfit"]).to_string(float_format="{:.3g}".format),
        common.shown("estimate, and sd over the prior's sd, by data", results["contraction"], gained),
        *(
            common.shown(f"cycles that were not fitted, {case}: relative error, in sds; - without a cycle", one, missed)
            for case, one in results["predictions"].items()
        ),
    ])  # fmt: skip
