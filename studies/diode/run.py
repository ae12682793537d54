"""A measured circuit of resistor, coil and diode: period doubling, windows and chaos, identified and predicted.

Records at fixed frequencies of a sinusoidal source (S. Diaz-Mansilla, A. Castillo Fernandez;
github.com/saul-diaz-mansilla/coupled-rlc-circuits, RL_diode_run_1): 8-bit voltages of the source and the resistor. Six
periodic records, of periods 1, 2, 3 and 8, are fitted; the motion at all other frequencies is predicted.
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.diode import prediction, rig

DRAWS, QUICK_DRAWS = 40, 8
# The model's diagram: frequencies [Hz], periods that are drawn.
FINE, DRAWN = 2_000.0, 40
# Draws whose orbits are followed to their period doublings, and those that are drawn.
FOLLOWED, SHOWN = 16, 6
# Records of the search for missing terms [kHz], and how many terms are tried.
SEARCHED, KEPT = (110.0, 170.0, 230.0), 2
# Period doublings: the orbit's record [kHz], and the frequency [kHz] up to which it is followed.
DOUBLINGS = ((110.0, 130.0), (170.0, 200.0), (230.0, 290.0))
RULE = (
    "tested_period: the largest P up to 8 whose lines are all significant (F-tests, 1 %) and that leaves at most 0.5 % "
    "of the variance between its lines; measured_period and predicted: the smallest P that leaves at most 1 %"
)


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, draws = common.Stopwatch(), QUICK_DRAWS if options.quick else DRAWS
    with watch.part("read", "reading the records, testing their periods and folding the periodic ones"):
        records, data, share = rig.read(options.data, options.seed)
        used = rig.fitted_records(records)
    kind = "SYNTHETIC" if data["synthetic"] else "measured"
    print(f"  {kind} records {data['path']}: {len(records)}, of which {sum(r.period is not None for r in records)} are "
          f"periodic and {len(used)} are fitted; {rig.RULE_OF_CHOICE}")  # fmt: skip
    if data["synthetic"]:
        print(f"  the measured file was not found; it is at {rig.ADDRESS}, sha256 {rig.SHA256}; true values {rig.TRUE}")
    fits = {}
    for step, free in rig.STEPS_OF_MODEL.items():
        with watch.part(f"map {step}", f"finding the MAP point of the model: {step}"):
            fits[step] = rig.estimate(used, free, share)
    with watch.part("missing terms", "searching for terms that the first model lacks"):
        first = rig.estimate([r for r in used if r.frequency / 1e3 in SEARCHED], (), share)
        found = bp.missing_terms(first.problem, first.fit, max_terms=1, keep=KEPT)
    final = fits[list(fits)[-1]]
    with watch.part("predict", f"integrating {draws} draws at the frequencies of all records"):
        sample = prediction.draws_of(final, draws, options.seed)
        frequencies, sources = [r.frequency for r in records], [prediction.source_of(r) for r in records]
        motions = [[prediction.period_of(v) for v in prediction.sweep(d, frequencies, sources)] for d in sample]
    with watch.part("orbits", "solving the orbits of periodic records that were not fitted, and their multipliers"):
        table = _records(records, used, final, motions, sample[:FOLLOWED])
        doublings = _doublings(records, final, sample[:FOLLOWED])
    with watch.part("figures", "drawing"):
        figures = {
            "bifurcation": _bifurcation(records, used, final, sample, synthetic=data["synthetic"]),
            "steps": _steps(fits, used, synthetic=data["synthetic"]),
        }
        paths = common.save_figures(options.out, figures)
    results: dict[str, Any] = {"data": data, "seed": options.seed, "quick": options.quick, "rule": RULE}
    results |= {
        "internal_resistance": share,
        "records": table,
        "steps": {step: _summary(own) for step, own in fits.items()},
        "missing_terms": _missing(found),
        "doublings": doublings,
        "score": _score(table),
    }
    print("\n" + _tables(results, final, found) + "\n")
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def _records(
    records: Sequence[rig.Record],
    used: Sequence[rig.Record],
    final: rig.Fitted,
    motions: list[list[int | None]],
    sample: list[dict[str, float]],
) -> list[dict[str, Any]]:
    """Return the row of every record."""
    fitted, rows = {record.frequency for record in used}, []
    for number, record in enumerate(records):
        at = record.frequency in fitted
        solution, unexplained = rig.solved(record, final) if record.experiment else (None, None)
        rows.append({
            "frequency_Hz": record.frequency,
            "used": at,
            "measured_period": prediction.measured_period(record),
            "tested_period": record.period,
            "predicted": prediction.probabilities([own[number] for own in motions]),
            "unexplained": unexplained,
            "multiplier": None if solution is None else float(solution.multipliers.real[0]),
            "multiplier_sd": prediction.multiplier_sd(record, solution, sample) if at and solution else None,
            "evidence": record.evidence,
        })  # fmt: skip
    return rows


def _doublings(records: Sequence[rig.Record], final: rig.Fitted, sample: list[dict[str, float]]) -> list[Any]:
    """Return the frequencies of period doublings with 90 % intervals, and the records that bracket them."""
    rows = []
    for start, until in DOUBLINGS:
        record = min((r for r in records if r.experiment), key=lambda own: abs(own.frequency - 1e3 * start))
        found = [prediction.doubling(draw, rig.orbit(record, draw), 1e3 * until) for draw in sample]
        at = np.array([own for own in found if own is not None])
        rows.append({
            "orbit": f"{record.frequency / 1e3:g} kHz, period {record.period}",
            "draws": len(sample),
            "found": int(at.size),
            "median_Hz": float(np.median(at)) if at.size else None,
            "interval_Hz": np.quantile(at, [0.05, 0.95]).tolist() if at.size else None,
        })  # fmt: skip
    return rows


def _score(table: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many records are predicted right: the measured motion is more probable than any other."""
    right = {"periodic": [0, 0], "others": [0, 0]}
    for row in table:
        truth = "chaos" if row["measured_period"] is None else str(row["measured_period"])
        counts = right["others" if row["measured_period"] is None else "periodic"]
        counts[0] += all(
            p < row["predicted"].get(truth, 0.0) for motion, p in row["predicted"].items() if motion != truth
        )
        counts[1] += 1
    unexplained = {
        key: max((r["unexplained"] for r in table if r["used"] is own and r["unexplained"] is not None), default=None)
        for key, own in (("used", True), ("not_used", False))
    }
    return {"right": right, "largest_unexplained": unexplained}


def _summary(own: rig.Fitted) -> dict[str, Any]:
    fit = own.fit
    return {
        "status": fit.status, "map": fit.theta, "laplace_sd": fit.sd, "robust_sd": fit.robust_sd,
        "unexplained": {e.name: rig.unexplained(e, fit.solutions[e.name]) for e in own.problem.experiments},
        "p_white": fit.whiteness["resistor"].p,
    }  # fmt: skip


def _missing(found: bp.MissingTerms) -> dict[str, Any]:
    best = found.ranking.head(10)
    return {
        "candidates": found.tested,
        "refused": {str(term): reason for term, reason in found.refused.items()},
        "steps": [
            {"term": s.term, "place": s.place, "alternatives": list(s.alternatives), "unexplained": s.unexplained}
            for s in found.steps
        ],
        "best_before_refitting": best[["candidate", "explains", "p"]].astype({"p": float}).to_dict("records"),
    }


def _tables(results: Mapping[str, Any], final: rig.Fitted, found: bp.MissingTerms) -> str:
    rows = pd.DataFrame(results["records"])
    rows["predicted"] = [", ".join(f"{k}: {v:.0%}" for k, v in sorted(p.items())) for p in rows["predicted"]]
    rows["kHz"] = rows["frequency_Hz"] / 1e3
    for kind in ("measured_period", "tested_period"):
        rows[kind] = ["-" if pd.isna(p) else f"{p:.0f}" for p in rows[kind]]
    shown = rows[
        ["kHz", "used", "measured_period", "tested_period", "predicted", "unexplained", "multiplier", "multiplier_sd"]
    ]
    steps = pd.DataFrame({step: own["unexplained"] for step, own in results["steps"].items()}).T
    right, largest = results["score"]["right"], results["score"]["largest_unexplained"]
    return "\n".join([
        str(final.fit), "", "Unexplained variance by model and fitted record:",
        steps.to_string(float_format="{:.2%}".format), "",
        "What the first model lacks, from three records:", str(found), "",
        "All records; probabilities of the motion over the draws:",
        shown.to_string(index=False, float_format="{:.4g}".format, na_rep="-"), "",
        f"Most probable motion right at {right['periodic'][0]} of {right['periodic'][1]} periodic records and "
        f"{right['others'][0]} of {right['others'][1]} others.",
        f"Largest unexplained variance: {_percent(largest['used'])} of fitted records, "
        f"{_percent(largest['not_used'])} of periodic ones that were not fitted.",
        *(_doubling_line(row) for row in results["doublings"]),
    ])  # fmt: skip


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2%}"


def _doubling_line(row: Mapping[str, Any]) -> str:
    if row["median_Hz"] is None:
        return f"The orbit of {row['orbit']} doubles its period in no draw."
    low, high = (f"{1e-3 * value:.1f}" for value in row["interval_Hz"])
    return (
        f"The orbit of {row['orbit']} doubles its period at {1e-3 * row['median_Hz']:.1f} kHz "
        f"(90 %: {low} to {high}; {row['found']} of {row['draws']} draws)."
    )


def _bifurcation(
    records: Sequence[rig.Record], used: Sequence[rig.Record], final: rig.Fitted, sample: list[dict[str, float]], *,
    synthetic: bool,
) -> Figure:  # fmt: skip
    """Return the predicted bifurcation diagram above the measured one."""
    frequencies = np.array([record.frequency for record in records])
    own = np.array([prediction.source_of(record) for record in records])
    fine = np.arange(max(frequencies[0] - 10e3, 0.0), frequencies[-1] + 10e3, FINE)
    sources = np.stack([np.interp(fine, frequencies, column) for column in own.T], axis=1)
    estimate = rig.values_of(final)
    figure, axes = plt.subplots(2, 1, figsize=(8.0, 6.6), sharex=True, sharey=True, layout="constrained")
    for draw, colour in [*((d, "#E69F00") for d in sample[:SHOWN]), (estimate, "#000000")]:
        values = prediction.sweep(draw, fine.tolist(), [tuple(row) for row in sources], DRAWN)
        at = np.repeat(1e-3 * fine, DRAWN)
        axes[0].plot(at, values[:, :, 0].ravel(), ".", ms=0.9, mew=0.0, color=colour, rasterized=True)
    fitted = {record.frequency for record in used}
    for record in records:
        kind = "fitted" if record.frequency in fitted else "periodic, not fitted" if record.period else "not periodic"
        colour = {"fitted": "#0072B2", "periodic, not fitted": "#56B4E9", "not periodic": "#555555"}[kind]
        values = rig.stroboscopic(record)
        axes[1].plot(np.full(values.size, 1e-3 * record.frequency), values, ".", ms=3, color=colour, label=kind)
        for ax in axes if record.frequency in fitted else ():
            ax.axvline(1e-3 * record.frequency, color="#0072B2", lw=0.6, alpha=0.5, zorder=0)
    axes[0].set_title(f"Predicted from {len(used)} periodic records (black: MAP point, orange: draws)")
    axes[1].set_title("SYNTHETIC records" if synthetic else "Measured")
    axes[1].set_xlabel("drive frequency [kHz]")
    for ax in axes:
        ax.set_ylabel("resistor voltage at the\nmaximum of the source, less mean [V]")
    handles, labels = axes[1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axes[1].legend(unique.values(), unique, loc="upper right", frameon=False, markerscale=2)
    return figure


def _steps(fits: Mapping[str, rig.Fitted], used: Sequence[rig.Record], *, synthetic: bool) -> Figure:
    """Return the unexplained variance of the fitted records by model."""
    figure, ax = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    names = [f"{record.frequency / 1e3:g} kHz\nP = {record.period}" for record in used]
    for (step, own), marker, colour in zip(fits.items(), "osD", ("#D55E00", "#E69F00", "#0072B2"), strict=False):
        values = [100 * rig.unexplained(e, own.fit.solutions[e.name]) for e in own.problem.experiments]
        ax.plot(names, values, marker, ls="-", lw=0.8, color=colour, label=step)
    floor = [100 * (1.0 - record.experiment.periodicity) for record in used if record.experiment]
    ax.plot(names, floor, "_", ms=14, color="#555555", label="between the cycles of the record")
    ax.set(yscale="log", ylabel="unexplained variance [%]")
    ax.set_title("What each term explains" + (" (synthetic data)" if synthetic else ""))
    ax.legend(frameon=False, fontsize="small")
    return figure
