"""A measured circuit of resistor, coil and diode: period doubling, windows and chaos, identified and predicted.

Records at fixed frequencies of a sinusoidal source (S. Diaz-Mansilla, A. Castillo Fernandez;
github.com/saul-diaz-mansilla/coupled-rlc-circuits, RL_diode_run_1): 8-bit voltages of the source and the resistor. Six
periodic records, of periods 1, 2, 3 and 8, are fitted; the motion at all other frequencies is predicted.
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import bayesperiodic as bp
from studies import common
from studies.diode import chaos, figures, held_out, prediction, rig

DRAWS, QUICK_DRAWS = 100, 8
# Draws whose orbits are followed to their period doublings.
FOLLOWED = 16
# Records of the searches for missing terms [kHz], also of the last one, and how many terms are tried.
SEARCHED, SEARCHED_LAST, KEPT = (110.0, 170.0, 230.0), (170.0, 230.0, 350.0), 2
# The term that is added to each model, of those that the search cannot tell apart, for its physical meaning.
FIRST, *_, LAST = rig.STEPS_OF_MODEL
CHOSEN = dict(zip(rig.STEPS_OF_MODEL, ("i*m in equation of m", "dsource in resistor", "dq in resistor"), strict=False))
# Period doublings: the orbit's record [kHz], and the frequency [kHz] up to which it is followed.
DOUBLINGS = ((110.0, 130.0), (170.0, 200.0), (230.0, 290.0))
RULE = (
    "tested_period: the largest P up to 8 whose lines are all significant (F-tests, 1 %) and that leaves at most 0.5 % "
    "of the variance between its lines; measured_period and predicted: the smallest P that leaves at most 1 %"
)


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, draws = common.Stopwatch(), QUICK_DRAWS if options.quick else DRAWS
    with common.workers() as pool:
        with watch.part("read", "reading the records, testing their periods and folding the periodic ones"):
            records, data, share = rig.read(options.data, options.seed, pool)
            used = rig.fitted_records(records)
        kind = "SYNTHETIC" if data["synthetic"] else "measured"
        print(f"  {kind} records {data['path']}: {len(records)}, of which {sum(r.period is not None for r in records)} "
              f"are periodic and {len(used)} are fitted; {rig.RULE_OF_CHOICE}")  # fmt: skip
        if data["synthetic"]:
            print(f"  the measured file was not found; it is at {rig.ADDRESS}, sha256 {rig.SHA256}; "
                  f"true values {rig.TRUE}")  # fmt: skip
        # The last model first, for the predictions wait for it; then the search that takes longest.
        estimates = {LAST: pool.submit(rig.estimate, used, rig.STEPS_OF_MODEL[LAST], share)}
        others = {r.frequency: pool.submit(held_out.left_out, r, used, rig.STEPS_OF_MODEL[LAST], share) for r in used}
        searches = {model: pool.submit(_search, model, used, share) for model in CHOSEN}
        estimates |= {
            model: pool.submit(rig.estimate, used, free, share)
            for model, free in rig.STEPS_OF_MODEL.items() if model != LAST
        }  # fmt: skip
        with watch.part("map", "finding the MAP points of four models, and what three of them lack"):
            final = estimates[LAST].result()
        with watch.part("left out", "fitting the last model without each of the fitted records"):
            left = {frequency: own.result() for frequency, own in others.items()}
        with watch.part("predict", f"integrating {draws} draws of three forecasts at the frequencies of all records"):
            forecasts, motions = held_out.forecasts(records, final, left, draws, options.seed)
            sample = prediction.draws_of(final, draws, options.seed)
        with watch.part("orbits", "solving the orbits of periodic records that were not fitted, and their multipliers"):
            table = _records(records, used, final, motions, sample[:FOLLOWED])
            doublings = _doublings(records, final, sample[:FOLLOWED])
        with watch.part("chaos", "finding unstable orbits in the records without a period"):
            unstable = _unstable(records, final)
        with watch.part("figures", "drawing the bifurcation diagram"):
            drawn = {"bifurcation": figures.bifurcation(records, used, final, sample, synthetic=data["synthetic"])}
        with watch.part("missing terms", "waiting for the search for missing terms"):
            fits = {model: estimates[model].result() for model in rig.STEPS_OF_MODEL}
            found = {model: own.result() for model, own in searches.items()}
    measured = [held_out.label(row["measured_period"]) for row in table]
    for row, own, kind in zip(table, forecasts, measured, strict=True):
        row["held_out"] = {name: p[kind] for name, p in own.items()}
        row["next_record"] = own["next record"]
    with watch.part("figures", "drawing"):
        drawn["probabilities"] = figures.probabilities(table, synthetic=data["synthetic"])
        drawn["steps"] = figures.steps(fits, used, synthetic=data["synthetic"])
        if unstable:
            drawn["chaos"] = figures.unstable_orbits(records, unstable, synthetic=data["synthetic"])
        paths = common.save_figures(options.out, drawn)
    results: dict[str, Any] = {"data": data, "seed": options.seed, "quick": options.quick, "rule": RULE}
    results |= {
        "internal_resistance": share,
        "records": table,
        "steps": {step: _summary(own) for step, own in fits.items()},
        "missing_terms": [_missing(model, own) for model, own in found.items()],
        "doublings": doublings,
        "unstable_orbits": [{key: value for key, value in row.items() if key != "orbit"} for row in unstable],
        "score": _score(table),
        "log_scores": held_out.log_scores(forecasts, measured),
        "effective_drives": {f"{f / 1e3:g} kHz": own.drive and own.drive._asdict() for f, own in left.items()},
    }
    print("\n" + _tables(results, final, found) + "\n")
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def _records(
    records: Sequence[rig.Record],
    used: Sequence[rig.Record],
    final: rig.Fitted,
    motions: list[dict[str, list[str]]],
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
            "predicted": prediction.probabilities(motions[number]["robust"]),
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
        found = common.in_threads(partial(_doubling, record, 1e3 * until), sample)
        at = np.array([own for own in found if own is not None])
        rows.append({
            "orbit": f"{record.frequency / 1e3:g} kHz, period {record.period}",
            "draws": len(sample),
            "found": int(at.size),
            "median_Hz": float(np.median(at)) if at.size else None,
            "interval_Hz": np.quantile(at, [0.05, 0.95]).tolist() if at.size else None,
        })  # fmt: skip
    return rows


def _doubling(record: rig.Record, until: float, draw: dict[str, float]) -> float | None:
    return prediction.doubling(draw, rig.orbit(record, draw), until)


def _unstable(records: Sequence[rig.Record], final: rig.Fitted) -> list[dict[str, Any]]:
    """Return the unstable orbits in the records without a period."""
    values, chaotic = rig.values_of(final), [record for record in records if record.period is None]
    found = common.in_threads(partial(chaos.orbits, values=values), chaotic)
    return [
        {"frequency_Hz": record.frequency, **row} for record, own in zip(chaotic, found, strict=True) for row in own
    ]


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


def _search(model: str, used: Sequence[rig.Record], share: float) -> bp.MissingTerms:
    """Return what a model lacks by three of the records; but for the first model, candidates are only ranked."""
    searched = SEARCHED_LAST if model == list(CHOSEN)[-1] else SEARCHED
    nearest = [min(used, key=lambda record: abs(record.frequency - 1e3 * f)) for f in searched]
    three = list({record.frequency: record for record in nearest}.values())
    own = rig.estimate(three, rig.STEPS_OF_MODEL[model], share)
    return bp.missing_terms(own.problem, own.fit, max_terms=int(model == FIRST), keep=KEPT)


def _missing(model: str, found: bp.MissingTerms) -> dict[str, Any]:
    best, chosen = found.ranking[["candidate", "explains", "p"]].astype({"p": float}), CHOSEN[model]
    names = list(best["candidate"])
    return {
        "model": model,
        "candidates": found.tested,
        "chosen": chosen,
        "rank_of_chosen": names.index(chosen) + 1 if chosen in names else None,
        "best_before_refitting": best.head(10).to_dict("records"),
        "refused": {str(term): reason for term, reason in found.refused.items()},
        "steps": [
            {"term": s.term, "place": s.place, "alternatives": list(s.alternatives), "unexplained": s.unexplained}
            for s in found.steps
        ],
    }


def _ranked(found: bp.MissingTerms) -> str:
    """Return the best candidates before refitting as a table."""
    best = found.ranking[["candidate", "explains", "p"]].head(6)
    return "Candidates that explain most of what is left, before refitting:\n" + best.to_string(
        float_format="{:.3g}".format
    )


def _tables(results: Mapping[str, Any], final: rig.Fitted, searches: Mapping[str, bp.MissingTerms]) -> str:
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
        *(f"What the model '{model}' lacks, from three records:\n{found}\n{_ranked(found)}\n"
          for model, found in searches.items()),
        "All records; probabilities of the motion over the draws:",
        shown.to_string(index=False, float_format="{:.4g}".format, na_rep="-"), "",
        f"Most probable motion right at {right['periodic'][0]} of {right['periodic'][1]} periodic records and "
        f"{right['others'][0]} of {right['others'][1]} others.",
        f"Largest unexplained variance: {_percent(largest['used'])} of fitted records, "
        f"{_percent(largest['not_used'])} of periodic ones that were not fitted.",
        *(_doubling_line(row) for row in results["doublings"]), "",
        _forecasts_table(results), "",
        "Unstable orbits in records without a period, of periods 1 to 4; distances in % of the variance:",
        _unstable_table(results["unstable_orbits"]),
    ])  # fmt: skip


def _forecasts_table(results: Mapping[str, Any]) -> str:
    """Return the log scores of the forecasts, and the effective drives, as a table and a sentence."""
    drives = [own for own in results["effective_drives"].values() if own]
    sizes = " and ".join(
        f"{_percent(float(np.sqrt(np.mean([own[name] ** 2 for own in drives]))))} in {name}"
        for name in held_out.Drive._fields
    )
    return "\n".join([
        "Log scores, the sum of ln p of the measured motions over all records, each predicted without itself:",
        pd.DataFrame(results["log_scores"]).T.to_string(float_format="{:.2f}".format),
        "`expected`: of a calibrated forecast; `difference`: from draws as if the model were true.",
        f"The effective drives of {len(drives)} of {len(results['effective_drives'])} fitted records, in models of the "
        f"others, differ from the measured ones by {sizes} (rms).",
    ])  # fmt: skip


def _unstable_table(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return "none was found."
    columns = {"period": [], "orbits": [], "multipliers": [], "nearest": [], "median": []}  # type: dict[str, list[str]]
    for period, own in pd.DataFrame(rows).groupby("period"):
        for name, text in zip(columns, (
            f"{period}", f"{len(own)}", _between(own["multiplier"], "{:.1f}"), _between(100 * own["nearest"], "{:.2f}"),
            _between(100 * own["median"], "{:.1f}"),
        ), strict=True):  # fmt: skip
            columns[name].append(text)
    return pd.DataFrame(columns).to_string(index=False)


def _between(values: pd.Series, form: str) -> str:
    return f"{form.format(values.min())} to {form.format(values.max())}"


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
