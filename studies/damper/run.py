"""A measured magneto-rheological damper: Dahl friction from displacement in, force out.

The record is 30 s at 100 Hz of a near-sinusoidal displacement, coil at 0 V (A. N. Vargas, doi 10.5281/zenodo.4445334;
github.com/labcontrol-data/mr-damper, mr_damper_4.1.csv). Model: F = Kx·v + K·x + F0 + Kw·w, w' = ρ (v − |v|·w),
in SI units; the source has mm, s and N.
"""

import argparse
import warnings
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common

FILE = "mr_damper/mr_damper_4.1.csv"
ADDRESS = "github.com/labcontrol-data/mr-damper (commit e42439f0), mr_damper_4.1.csv"
SHA256 = "86fde635ae4dc78174cdbd3bafafb415c8a05a89c6862004ebc4e7ff970a9d64"
PUBLISHED = {"Kx": 768.0, "K": 0.0, "F0": 0.0, "Kw": 57.4, "rho": 27_500.0}
PRIORS: dict[str, Any] = {
    "Kx": bp.LogNormal(1e3, 1.0),
    "K": bp.Normal(0.0, 5e3),
    "F0": bp.Normal(0.0, 50.0),
    "Kw": bp.LogNormal(50.0, 1.0),
    "rho": bp.LogNormal(2e4, 1.5),
}
# Numbers of displacement harmonics that are tried beside the rule's and twice as many, and what depends on them.
TRIED, SHARP = (7, 11, 16, 22), ("rho", "Kw")
RULE = (
    "the displacement keeps all harmonics up to the last one that exceeds the cycle-to-cycle scatter "
    "(F-test, false-alarm rate 1 % over all harmonics)"
)
SYNTHETIC_SHAPE = {1: 12.6e-3, 2: 0.05e-3, 3: 0.4e-3j, 9: 0.012e-3}
SYNTHETIC_FREQUENCY = 0.8397
SYNTHETIC_NOISE = {"displacement": 5e-5, "force": 4.0}


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    with watch.part("read", "reading the recording and folding it into its mean period"):
        recording, data = read_recording(options.data, options.seed)
        experiment = recording.fold()
    kind = "SYNTHETIC recording" if data["synthetic"] else "measured recording"
    harmonics = experiment.harmonics
    print(
        f"  {kind} {data['path']}: {experiment.frequency:.6f} ± {experiment.frequency_se:.1g} Hz, "
        f"{experiment.cycles} steady cycles, periodicity {experiment.periodicity:.4f}\n"
        f"  kept: {harmonics['displacement']} harmonics of the displacement, {harmonics['force']} of the force, "
        f"{experiment.independent['force']} independent values"
    )
    if data["synthetic"]:
        print(f"  the measured file was not found; it is at {ADDRESS}, sha256 {SHA256}")
    with watch.part("compile", "compiling the model, or loading it from the cache"):
        problem = bp.Problem(bp.models.dahl, [experiment], priors=PRIORS)
        solution = bp.solve_periodic(
            bp.models.dahl, PUBLISHED, experiment.inputs, frequency=experiment.frequency, samples=experiment.samples
        )
    print(f"  periodic solution at the published parameters: {solution.status} in {solution.iterations} iterations")
    with watch.part("map", "finding the MAP point and the Laplace covariance"):
        fit = bp.map_estimate(problem)
    with watch.part("missing", "searching for terms that the model lacks"):
        found = bp.missing_terms(problem, fit)
    with watch.part(
        "harmonics", "repeating it with other numbers of harmonics of an exact and of a noisy displacement"
    ):
        default = harmonics["displacement"]
        choices = [_with_harmonics(recording, count) for count in sorted({*TRIED, default, min(58, 2 * default)})]
    with watch.part("sample", "sampling the posterior with emcee"):
        posterior = bp.sample(problem, fit, seed=options.seed, max_steps=500 if options.quick else 20_000)
    print(f"  {posterior.reason}")
    with watch.part("figures", "drawing"):
        comparison = bp.compare(problem, fit, posterior)
        off = ", ".join(f"{name} {v}" for name, v in comparison.table["verdict"].items() if v != "fine")
        figures = {
            "fit": bp.plot.fit(problem, fit, bp.predict(problem, posterior)),
            "loops": bp.plot.loops(problem, fit),
            "corner": common.titled(
                bp.plot.corner(posterior, laplace=fit, problem=problem),
                f"Magnetorheological damper, verdicts on Laplace: {off or 'all'}{', the others' * bool(off)} fine",
            ),
            "traces": bp.plot.traces(posterior),
            "harmonics": _harmonics_figure(choices, default, synthetic=data["synthetic"]),
            "missing_terms": bp.plot.missing_terms(problem, fit, found),
        }
        paths = common.save_figures(options.out, figures)

    results = {"data": data, "seed": options.seed} | _collect(experiment, fit, posterior, comparison, choices)
    results["missing_terms"] = _missing(found)
    print(f"\n{_tables(results, fit, comparison)}\n\n{found}\n")
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def read_recording(given: Path | None, seed: int) -> tuple[bp.Recording, dict[str, Any]]:
    """Return the measured recording, or a generated one of the same kind, and its description."""
    found = common.find_data(given, FILE)
    if found is None:
        return generate(seed), common.described(found)
    recording = bp.Recording.from_csv(
        found[0], time="time_s", inputs={"displacement": "displacement_mm"}, outputs={"force": "force_N"},
        units={"displacement": ("mm", "m")}, name="magneto-rheological damper, 0 V",
    )  # fmt: skip
    return recording, common.described(found)


def generate(seed: int) -> bp.Recording:
    """Return a synthetic recording of the same kind: the published parameters, integrated in time, with noise."""
    amplitudes = np.zeros(max(SYNTHETIC_SHAPE) + 1, dtype=complex)
    for harmonic, amplitude in SYNTHETIC_SHAPE.items():
        amplitudes[harmonic] = amplitude
    phase = 2j * np.pi * np.arange(64)[:, None] / 64 * np.arange(amplitudes.size)
    displacement = (np.exp(phase) @ amplitudes).real
    return bp.simulate(
        bp.models.dahl, PUBLISHED, {"displacement": displacement}, frequency=SYNTHETIC_FREQUENCY, duration=30.0,
        sampling_rate=100.0, noise=SYNTHETIC_NOISE, seed=seed,
    )  # fmt: skip


def _with_harmonics(recording: bp.Recording, kept: int) -> dict[str, Any]:
    """Return rho and Kw with the displacement's noise integrated out, and with the displacement taken as exact."""
    experiment = recording.fold(harmonics={"displacement": kept})
    found: dict[str, Any] = {"kept": kept}
    for kind, ending in (("measured", ""), ("exact", "_exact")):
        problem = bp.Problem(bp.models.dahl, [experiment], priors=PRIORS, input_noise=kind)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The noise of the measured inputs")
            fit = bp.map_estimate(problem, progress=False)
        for name in SHARP:
            found |= {f"{name}{ending}": fit.theta[name], f"{name}_sd{ending}": fit.sd[name]}
        found |= {f"unexplained{ending}": fit.fvu["force"], "input_noise": fit.input_noise["force"]}
    return found


def _harmonics_figure(choices: list[dict[str, Any]], default: int, *, synthetic: bool) -> Figure:
    """Return rho and Kw ± a standard deviation by the number of harmonics of the displacement, the default marked."""
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.0), layout="constrained")
    kept = np.array([choice["kept"] for choice in choices])
    for ax, name, scale, label in zip(axes, SHARP, (1e-3, 1.0), ("ρ [1/mm]", "Kw [N]"), strict=True):
        ax.axvline(default, color="0.6", lw=0.9, ls=":", label="kept by the rule")
        for ending, text, marker, shift, colour in (
            ("_exact", "displacement taken as exact", "o", 0.98, common.ENSEMBLES[0]),
            ("", "its noise integrated out", "s", 1.02, common.ENSEMBLES[1]),
        ):
            values, sd = (
                scale * np.array([c[key] for c in choices]) for key in (f"{name}{ending}", f"{name}_sd{ending}")
            )
            ax.errorbar(shift * kept, values, sd, fmt=marker, color=colour, markersize=4, capsize=2, label=text)
        ax.set(xlabel="harmonics of the displacement", ylabel=label, xscale="log")
        ax.set_xticks(kept, [str(count) for count in kept])
        ax.minorticks_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    kind = ", synthetic data" * synthetic
    figure.suptitle(f"How sharply the displacement may reverse: estimates ± sd{kind}", fontsize="medium")
    return figure


def _summary(experiment: bp.Experiment, fit: bp.MapEstimate) -> dict[str, Any]:
    return {
        "map": fit.theta,
        "laplace_sd": fit.sd,
        "rms": fit.rms["force"],
        "fvu": fit.fvu["force"],
        "input_noise": fit.input_noise["force"],
    }


def _collect(
    experiment: bp.Experiment, fit: bp.MapEstimate, posterior: bp.Posterior, comparison: bp.Comparison,
    choices: list[dict[str, Any]],
) -> dict[str, Any]:  # fmt: skip
    return _summary(experiment, fit) | {
        "units": {name: bp.models.dahl.units[name] for name in fit.theta} | {"variance[force]": "N²"},
        "frequency": {"value": experiment.frequency, "se": experiment.frequency_se},
        "cycles": experiment.cycles,
        "periodicity": experiment.periodicity,
        "independent_values": experiment.independent["force"],
        "kept": dict(experiment.harmonics),
        "harmonics": choices,
        "whiteness": {"p": fit.whiteness["force"].p, "lag1": fit.whiteness["force"].lag1},
        "robust_sd": fit.robust_sd,
        "noise_split": {key: getattr(fit.noise_split["force"], key) for key in ("measurement", "model", "total")},
        "posterior": posterior.summary()[["mean", "sd", "q05", "q50", "q95"]].astype(float).to_dict("index"),
        "comparison": comparison.table["verdict"].to_dict(),
        "rule": RULE,
        "converged": posterior.converged,
        "reason": posterior.reason,
        "tau_max": max(posterior.tau.values()),
        "ess_min": min(posterior.ess.values()),
        "rhat_max": max(posterior.rhat.values()),
        "acceptance": posterior.acceptance,
        "failures": posterior.failures,
        "log_posterior_calls": posterior.log_posterior_calls,
    }


def _missing(found: bp.MissingTerms) -> list[dict[str, Any]]:
    """Return what is stored of each term that the model lacks."""
    return [
        {
            "term": step.term,
            "place": step.place,
            "alternatives": list(step.alternatives),
            "unexplained": step.unexplained["force"],
            "p_white": step.p_white["force"],
            "coefficient": step.coefficient,
            "robust_sd": step.robust_sd,
            "evidence_gain": step.evidence_gain,
            "verdict": step.verdict,
        }
        for step in found.steps
    ]


def _tables(results: dict[str, Any], fit: bp.MapEstimate, comparison: bp.Comparison) -> str:
    kind = "SYNTHETIC data" if results["data"]["synthetic"] else "measured data"
    columns = {
        "unit": pd.Series(results["units"]), "robust sd": pd.Series(fit.robust_sd),
        "published": pd.Series(PUBLISHED).replace(0.0, np.nan),
    }  # fmt: skip
    shown = ["map", "laplace_sd", "mean", "sd", "q05", "q95", "skewness", "verdict"]
    rows = comparison.table[shown].assign(**columns)
    white, split = fit.whiteness["force"], fit.noise_split["force"]
    lines = [
        f"Dahl model of the damper, {kind}, SI units (the source has mm): Laplace against MCMC",
        rows.to_string(float_format="{:.4g}".format, na_rep="-"),
        f"variance of one sample, the residual taken as white noise (prior 1/v): {fit.variances['force']:.3g} N² "
        f"(eq. 7), posterior mean {results['posterior']['variance[force]']['mean']:.3g} N²",
        f"residual {fit.rms['force']:.2f} N rms, {fit.fvu['force']:.2%} of the force's variance",
    ]
    if white.p < 0.01:
        lines.append(
            f"The residual is not white (p = {white.p:.1g}, autocorrelation {white.lag1:.2f} from one independent "
            "value to the next):\nit is dominated by model error. The Laplace standard deviations above are therefore "
            "too small; the robust ones use the\nspectrum of the residual. Of its "
            f"{split.total:.2f} N, {split.measurement:.2f} N are measurement noise and {split.model:.2f} N model error."
        )
    choices = results["harmonics"]
    by_choice = {
        c["kept"]: {
            f"{name}, {text}": f"{c[name + ending]:.4g} ± {c[name + '_sd' + ending]:.2g}"
            for name in SHARP
            for ending, text in (("_exact", "exact"), ("", "noisy"))
        }
        | {"unexplained, exact": f"{c['unexplained_exact']:.3%}", "noisy": f"{c['unexplained']:.3%}"}
        for c in choices
    }
    rho, widest = [c["rho"] for c in choices], max(c["rho_sd"] for c in choices)
    return "\n".join([
        *lines, "", f"Estimates by number of displacement harmonics; the rule: {RULE}:",
        f"{results['kept']['displacement']} harmonics. With an exact displacement, or its noise integrated out:",
        pd.DataFrame(by_choice).T.to_string(),
        f"rho runs from {min(rho):.3g} to {max(rho):.3g} 1/m over these choices, {np.ptp(rho) / widest:.1f} of its "
        "largest standard deviation: what is not\nnoise of the displacement depends on how sharply the measured motion "
        "reverses, which the posterior does not include.",
    ])  # fmt: skip
