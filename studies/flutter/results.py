"""What the flutter study writes and prints."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.flutter import questions
from studies.flutter.data import ADDRESS, LARGEST_DRIFT, RULE, SHA256, Record, spectral_frequency
from studies.flutter.rig import MODEL, TRUE, Fitted


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


def of_records(records: list[Record], experiments: dict[str, bp.Experiment], refused: dict[str, str]) -> dict[str, Any]:
    """Return what each record is, used or not, and why."""
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
    return {"rule": RULE, "refused": refused, "records": found}


def of_fits(fits: dict[str, Fitted], experiments: dict[str, bp.Experiment], authors: dict[str, Any]) -> dict[str, Any]:
    """Return what comes from the fits."""
    both = fits["both"]
    fit, found = both.fit, questions.errors(both, experiments)
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
        "errors_rms": questions.mean_size(found),
        "branches_kept_apart": all(one["as_measured"] for one in found.values()),
        "authors_errors": authors,
        "authors_errors_rms_where_a_cycle_exists": questions.mean_size(authors),
        "contraction": questions.contraction(fits),
    }


def of_posterior(
    structure: bp.Structure,
    fit: bp.MapEstimate,
    posterior: bp.Posterior | None,
    verdict: bp.Identifiability | None,
    compared: bp.Comparison | None,
) -> dict[str, Any]:
    """Return what the equations leave open, and what the draws say."""
    return {
        "structure": {"text": str(structure), "free_scales": questions.FREE_SCALES},
        "verdicts": verdict and verdict.table["verdict"].to_dict(),
        "posterior": posterior and compared and draws_of(posterior, fit, compared),
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
