"""A flutter rig identified from its measured limit cycles, stable and unstable.

An aerofoil on springs in a wind, whose stable limit cycles and unstable ones (stabilised by control-based continuation)
were measured at wind speeds from 14.9 to 17.3 m/s (K. H. Lee, D. A. W. Barton, L. Renson, Mechanical Systems and Signal
Processing 191, 2023, 110173). The study examines what the unstable cycles add, whether the model predicts cycles that
were not fitted, and which parameters are not identifiable while the sensors' scales are free. The cycles at the
authors' values, by continuation, are compared with eigenvalues and with a long time integration.
"""

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

import bayesperiodic as bp
from studies import common
from studies.flutter import missing, questions, rig
from studies.flutter.questions import CHANNELS, closed, contraction, drawn_sizes, laplace_draws, sizes
from studies.flutter.reference import hopf, settled
from studies.flutter.rig import AUTHORS, RIG, SENSORS, Experiments, Fitted, Speeds, cycles

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
    stable = {f"{grid}, {at}": row for grid, rows in by_grid.items() for at, row in rows.items()}
    print(common.shown("Hopf point of the authors' values", checked))
    print(common.shown("relative difference of stable cycles from time integration", stable), flush=True)
    with watch.part("map", "estimating from all cycles"):
        both = rig.estimate(experiments, speeds)
    with watch.part("parts", "estimating from stable or unstable cycles alone, and with wind speeds left out"):
        fits, results["predictions"] = _parts(experiments, speeds, both, options.quick, draws)
    with watch.part("missing terms", "looking for the terms that the model lacks"):
        results["missing_terms"] = missing.search(both, speeds, quick=options.quick)
    with watch.part("structure", "structural identifiability"):
        known = (*RIG, "U", "c_h", "c_alpha")
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
        figures = all_of(experiments, speeds, fits, fit, posterior, draws)
        paths = common.save_figures(options.out, figures)

    results |= _of_fits(fits, experiments, authors) | {
        "structure": {"text": str(structure), "free_scales": questions.FREE_SCALES},
        "verdicts": verdict and verdict.table["verdict"].to_dict(),
        "posterior": posterior and compared and _of_draws(posterior, fit, compared),
    }
    print(
        "\n".join(
            [
                "",
                _tables(results),
                missing.line(results["missing_terms"]),
                str(structure),
                *(str(one) for one in (verdict, compared) if one),
                "",
            ]
        )
    )
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def _parts(
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


def _with_known_noise(both: Fitted, experiments: Experiments, speeds: dict[str, float]) -> bp.Problem:
    """Return the problem whose noise has the shape found at the MAP point; the variances stay free."""
    shape = {name: value for name, value in both.fit.noise.items() if not name.startswith("variance")}
    stated = rig.problem(both.problem.experiments, speeds, frequency_error=both.frequency_error, known=shape)
    return stated.anchored(stated.vector(both.fit.theta), {n: both.fit.solutions[n].states for n in experiments})


def _authors_cycles() -> dict[str, Any]:
    """Return the branch of the authors' values, and how it differs from eigenvalues and time integration."""
    by_grid = {points: cycles(RIG | AUTHORS | SENSORS, points) for points in GRIDS}
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


def _of_records(records: list[rig.Record], experiments: Experiments) -> dict[str, Any]:
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
                "amplitude": sizes(e.outputs),
            }
    return found


def _of_fits(fits: dict[str, Fitted], experiments: Experiments, authors: dict[str, Any]) -> dict[str, Any]:
    fit, found = fits["both"].fit, questions.errors(fits["both"], experiments)
    by_kind = contraction(fits)
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
        "contraction": by_kind,
        "springs": questions.model_error_of_springs(by_kind),
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
    columns = [*(f"amplitude_error.{channel}" for channel in CHANNELS), "frequency_error"]
    missed = [f"{c}.{k}" for c in CHANNELS for k in ("error", "posterior_sds", "sds_with_model_error")]
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
        common.shown("springs by data: differences are model error", results["springs"]),
        *(
            common.shown(f"cycles that were not fitted, {case}: relative error, in sds; - without a cycle", one, missed)
            for case, one in results["predictions"].items()
        ),
    ])  # fmt: skip


MEASURED, MODEL, THEIRS = "black", {True: "#0072B2", False: "#D55E00"}, "#999999"
KIND = {True: "stable", False: "unstable"}
# Parameters of the corner plot.
SHOWN = ("k_alpha", "k_alpha2", "k_alpha3", "gain_pitch")
# Points of a curve, wind speeds of the bands, and those above a fold [m/s].
FINE, COARSE, ABOVE_FOLD = 500, np.linspace(13.0, 19.0, 41), (0.005, 0.02, 0.05, 0.1)


def all_of(
    experiments: Experiments, speeds: Speeds, fits: Mapping[str, Fitted], fit: bp.MapEstimate,
    posterior: bp.Posterior | None, draws: int,
) -> dict[str, Figure]:  # fmt: skip
    """Return every figure by its name; without a posterior the bands are Laplace's, and there is no corner plot."""
    if posterior is None:
        chosen = laplace_draws(fit, draws)
    else:
        every = {name: posterior.draws(name).ravel() for name in fit.theta}
        chosen = {name: v[np.linspace(0, v.size - 1, draws).astype(int)] for name, v in every.items()}
    figures = {
        "bifurcation": bifurcation(experiments, speeds, fit, chosen),
        "portraits": portraits(experiments, speeds, fit),
        "contraction": contractions(fits, _kind(experiments)),
    }
    if posterior is None:
        return figures
    corner = bp.plot.corner(posterior, laplace=fit, names=list(SHOWN))
    title = f"Flutter rig{_kind(experiments)}: posterior of the springs and of the gain of the pitch sensor"
    return figures | {"corner": common.titled(corner, title)}


def curves(values: Mapping[str, float]) -> dict[tuple[str, bool], np.ndarray]:
    """Return wind speeds and amplitudes (2, points) along the branch, by channel and stability; NaN for the other one.

    Splines over the arc length, through all solutions, are smooth at folds.
    """
    try:
        branches = cycles(values).branches
    except ValueError:
        return {(channel, kind): np.empty((2, 0)) for channel in CHANNELS for kind in KIND}
    orbits = [orbit for along in branches for orbit in along]
    at = np.array([[o.parameters["U"], *(sizes(o.outputs)[c] for c in CHANNELS)] for o in orbits])
    steps = np.linalg.norm(np.diff(at, axis=0) / np.ptp(at, axis=0), axis=1)
    new = np.r_[True, steps > 0.0]
    length = np.r_[0.0, np.cumsum(steps)][new]
    fine = np.linspace(0.0, length[-1], FINE)
    speed, *amplitudes = CubicSpline(length, at[new])(fine).T
    stable = np.interp(fine, length, np.array([bool(o.stable) for o in orbits])[new]) > 0.5
    return {
        (channel, kind): np.array([speed, np.where(stable == kind, size, np.nan)])
        for channel, size in zip(CHANNELS, amplitudes, strict=True)
        for kind in KIND
    }


def bands(theta: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> dict[tuple[str, bool], np.ndarray]:
    """Return wind speeds and the 5 and 95 % quantiles of the draws' amplitudes (3, speeds), by channel and branch.

    Where fewer than half of the draws have the cycle, or θ itself has none, there is no band.
    """
    along = cycles(RIG | dict(theta))
    found: dict[tuple[str, bool], list[tuple[float, float, float]]] = {(c, k): [] for c in CHANNELS for k in KIND}
    folds = [fold.parameters["U"] for branch in along.branches for fold in branch.folds]
    for speed in np.unique([*COARSE, *(fold + more for fold in folds for more in ABOVE_FOLD)]):
        for kind in KIND:
            try:
                orbit = along.at(KIND[kind], speed)
            except ValueError:
                continue
            for channel, size in drawn_sizes(orbit, theta, draws).items():
                if np.mean(np.isfinite(size)) > 0.5:
                    found[channel, kind].append((speed, *np.nanquantile(size, [0.05, 0.95])))
    return {key: np.array(rows).reshape(-1, 3).T for key, rows in found.items()}


def bifurcation(
    experiments: Experiments, speeds: Speeds, fit: bp.MapEstimate, draws: Mapping[str, np.ndarray]
) -> Figure:
    """Draw amplitudes over wind speed: posterior bands of both branches, the authors' values, measurements."""
    drawn = bands(fit.theta, draws)
    best, theirs = curves(RIG | fit.theta), curves(RIG | AUTHORS | SENSORS)
    figure = plt.figure(figsize=(9.0, 8.0), layout="constrained")
    for axes, channel in zip(figure.subplots(2, 1, sharex=True), CHANNELS, strict=True):
        for kind in (True, False):
            colour, style = MODEL[kind], "-" if kind else "--"
            at, low, high = drawn[channel, kind]
            axes.fill_between(at, low, high, color=colour, alpha=0.25, lw=0, label=f"{KIND[kind]}, 90 % of draws")
            axes.plot(*best[channel, kind], color=colour, ls=style, label=f"{KIND[kind]}, MAP")
            label = "authors' values" if kind else None
            axes.plot(*theirs[channel, kind], color=THEIRS, lw=1.0, ls=style, label=label)
        for kind in (True, False):
            names = [name for name in experiments if name.startswith("unstable") != kind]
            axes.errorbar(
                [speeds[name] for name in names],
                [sizes(experiments[name].outputs)[channel] for name in names],
                [2.0 * experiments[name].scatter[channel] for name in names],
                fmt="o" if kind else "s", color=MEASURED, mfc=MODEL[kind], ms=6, capsize=3,
                label=f"{KIND[kind]}, measured ± 2 sd of one cycle",
            )  # fmt: skip
        axes.set_ylabel(f"amplitude of {channel} [sensor units]")
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel("wind speed [m/s]")
    common.shared_legend(figure, 3, fontsize=9)
    figure.suptitle(f"Flutter rig{_kind(experiments)}: limit cycles")
    return figure


def portraits(experiments: Experiments, speeds: Speeds, fit: bp.MapEstimate) -> Figure:
    """Draw pitch over heave, measured and fitted, a panel per cycle."""
    figure = plt.figure(figsize=(11.0, 6.0), layout="constrained")
    for axes, (name, e) in zip(figure.subplots(2, 4, sharex=True, sharey=True).flat, experiments.items(), strict=False):
        orbit = fit.solutions[name]
        kind = not name.startswith("unstable")
        for values, colour, label in ((e.outputs, MEASURED, "measured"), (orbit.outputs, MODEL[kind], "fitted")):
            axes.plot(*(closed(values[c]) for c in CHANNELS), color=colour, lw=1.4, label=f"{label}, {KIND[kind]}")
        axes.set_title(f"{speeds[name]:g} m/s, {KIND[kind]}", fontsize=10)
        axes.legend(frameon=False, fontsize=7, loc="lower right")
    for axes in figure.axes[4:]:
        axes.set_xlabel("heave [sensor units]")
    for axes in figure.axes[::4]:
        axes.set_ylabel("pitch [sensor units]")
    figure.suptitle(f"Flutter rig{_kind(experiments)}: measured and fitted cycles")
    return figure


def contractions(fits: Mapping[str, Fitted], kind_of_data: str) -> Figure:
    """Draw posterior sd over prior sd of each parameter, from the stable cycles, the unstable ones, and both."""
    table = contraction(fits)
    names = list(table)
    figure = plt.figure(figsize=(8.0, 5.5), layout="constrained")
    axes = figure.subplots()
    for number, (kind, colour) in enumerate(zip(fits, (MODEL[True], MODEL[False], MEASURED), strict=True)):
        at = np.arange(len(names)) + 0.26 * (number - 1)
        axes.barh(at, [table[name][kind]["over_prior"] for name in names], 0.24, color=colour, label=f"{kind} cycles")
    axes.axvline(1.0, color=THEIRS, lw=1.0, ls="--", label="prior")
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("Laplace sd over the prior's sd")
    common.shared_legend(figure, 4)
    figure.suptitle(f"Flutter rig{kind_of_data}: how far each kind of cycles narrows the priors")
    return figure


def _kind(experiments: Experiments) -> str:
    return ", synthetic data" if any(e.synthetic for e in experiments.values()) else ""
