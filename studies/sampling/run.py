"""Accuracy and cost of sampling: a ridge known by quadrature, samplers compared, pools of workers and cores.

The ridge is computed; the damper is measured or synthetic, see studies/damper/run.py; other data are synthetic.
"""

import argparse
from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from scipy import stats

import bayesperiodic as bp
from studies import common
from studies.sampling import cost as sampling_cost
from studies.sampling import efficiency
from studies.sampling import ridge as sampling_ridge
from studies.sampling.efficiency import OURS

GAIN, LEAST_GAIN = (efficiency.DAMPER, efficiency.DUFFING), 8.0
FALSE_ALARM = 0.01
TRUTH, DRAWS, HISTOGRAM = "#000000", "#0072B2", "#56B4E9"
SHOWN = 1500
FARTHEST = 4.0
OTHERS, MARKERS = "#D55E00", "osD^"


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    with watch.part("cost", "overhead of a pool of workers, and gain of several cores"):
        cost = sampling_cost.run_cost(options.quick)
    busy = sampling_cost.loaded(cost)
    if busy:
        print(f"  note: {busy}")
    with watch.part("branches", "the ridge a·b = 1 in natural parameters, and with a second branch"):
        ridge = sampling_ridge.sample_ridge(options.seed, options.quick)
    found: dict[str, Any] = {"ridge": sampling_ridge.collect(ridge), "efficiency": {}}
    with watch.part("cases", "the densities of the comparison, with their MAP estimates"):
        cases, data = efficiency.cases(options.data, options.seed, options.quick)
    for name, case in cases.items():
        with watch.part(name, f"{name} by all samplers"):
            runs = efficiency.sample_all(case, options.seed, options.quick)
        found["efficiency"][name] = collect(case, runs)
    found |= {"data": data, "cost": cost | {"note": busy}}
    found["checks"] = sampling_ridge.rows(found["ridge"]) + rows(found["efficiency"], options.quick)
    found["checks"] += against_quadrature(found["efficiency"][efficiency.RIDGE]["samplers"])
    found["checks"] += sampling_cost.rows(cost)
    with watch.part("figures", "drawing"):
        # The ridge is the last case.
        figures = {"ridge": draw_ridge(runs), "samplers": draw_samplers(found["efficiency"])}
        figures["branches"] = draw_branches(ridge)
        paths = common.save_figures(options.out, figures)
    print("\n" + tables(found) + "\n")
    results = {"seed": options.seed, "quick": options.quick} | found
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


def collect(case: efficiency.Case, runs: Mapping[str, efficiency.Run | str]) -> dict[str, Any]:
    """Return the entries of results.json on one case."""
    samplers = {name: run.account(case.names) for name, run in runs.items() if isinstance(run, efficiency.Run)}
    differences = compare_all({name: e["moments"] for name, e in samplers.items() if e["length"] >= efficiency.LONG})
    return {
        "samplers": samplers,
        "without": {name: reason for name, reason in runs.items() if isinstance(reason, str)},
        "compared": len(differences),
        "largest_difference": max(differences, key=lambda d: d["errors"], default=None),
    }


def compare_all(tables: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[dict[str, Any]]:
    """Return every difference of two samplers in a mean or sd, over the combined Monte Carlo error."""
    return [
        {
            "samplers": [one, other],
            "quantity": f"{kind} of {name}",
            "errors": abs(tables[one][name][kind] - tables[other][name][kind])
            / float(np.hypot(tables[one][name][f"{kind}_error"], tables[other][name][f"{kind}_error"])),
        }
        for one, other in combinations(tables, 2)
        for name in tables[one]
        for kind in ("mean", "sd")
    ]


def limit(count: int) -> float:
    """Return the limit that the largest of `count` differences exceeds with a probability of at most 1 % (Bonferroni).

    Each is Student's t; its degrees of freedom are at least those of one sampler's error, one less than it has batches.
    """
    return float(stats.t.isf(0.5 * FALSE_ALARM / max(count, 1), efficiency.ENSEMBLES * sampling_ridge.BATCHES - 1))


def rows(found: Mapping[str, Any], quick: bool) -> list[common.Row]:
    """Return the targets of efficiency; a quick run has no verdict on convergence."""
    result, own = [], OURS[0]
    for case, entry in found.items():
        samplers = entry["samplers"]
        for name in OURS:
            converged = samplers[name]["converged"] if name in samplers else None
            note = "" if converged else entry["without"].get(name) or samplers[name]["reason"]
            judged = common.row(f"{case}, {name}: called converged (1: yes)", converged, 1.0, 1.0, note)
            result.append(judged | ({"met": None, "note": f"a quick run: {note}"} if quick else {}))
        if case in GAIN:
            gain = samplers[own]["ess_per_1000"] / samplers["emcee"]["ess_per_1000"]
            what = f"{case}: effective samples per evaluation, {own} over emcee's default move"
            result.append(common.row(what, gain, LEAST_GAIN, None))
        worst, most = entry["largest_difference"], limit(entry["compared"])
        short = [name for name, e in samplers.items() if e["length"] < efficiency.LONG]
        note = f"{worst['quantity']}, {' against '.join(worst['samplers'])}" if worst else "no two long runs"
        note += f"; shorter than {efficiency.LONG:.0f} tau: {', '.join(short)}" if short else ""
        what = f"{case}: largest difference of samplers in Monte Carlo errors"
        result.append(common.row(what, worst and worst["errors"], 0.0, most, note))
    return result


def against_quadrature(samplers: Mapping[str, Any]) -> list[common.Row]:
    """Return of every sampler the error of sd(a) on the ridge, without a verdict if its run is too short."""
    truth, most, result = sampling_ridge.spread(cut=True), limit(len(samplers)), []
    for name, entry in samplers.items():
        sd, error = entry["moments"]["a"]["sd"], entry["moments"]["a"]["sd_error"]
        note = f"{name}: sd over that by quadrature {sd / truth:.3f} ± {error / truth:.3f}"
        what = f"ridge, {name}: sd(a) against quadrature, in Monte Carlo errors"
        judged = common.row(what, abs(sd - truth) / error, 0.0, most, note)
        why = f"only {entry['length']:.0f} tau long" if entry["length"] else "stopped before its end"
        short = {"met": None, "note": f"{note}; without a verdict, {why}"}
        result.append(judged if entry["length"] >= efficiency.LONG else judged | short)
    return result


def tables(found: dict[str, Any]) -> str:
    """Return the text to print."""
    columns, lines = ["evaluations", "seconds", "length", "ess_min", "ess_per_1000", "ess_per_second"], []
    for case, entry in found["efficiency"].items():
        lines += [common.shown(f"Effective samples, {case}", entry["samplers"], columns)]
        lines += [*(f"{name}: {reason}" for name, reason in entry["without"].items()), ""]
    pools = found["cost"]["pools"]
    if pools is not None:
        title = (
            f"Wall and processor time of a pool of one worker over a thread: {pools['walkers']} walkers, "
            f"{pools['log_posteriors']['piece']} log-posteriors a message; each {pools['milliseconds']['wall']:.2f} ms "
            f"by the clock, {pools['milliseconds']['processor']:.2f} ms of processor time"
        )
        lines += [common.shown(title, pools["ratios"], ["median", "processor_time"]), ""]
    lines += ["Targets", common.table_of_rows(found["checks"])]
    return "\n".join([*lines, *([f"Note: {found['cost']['note']}."] if found["cost"]["note"] else [])])


def draw_ridge(runs: Mapping[str, Any]) -> Figure:
    """Draw a and b of emcee's default move and of `bp.sample`, over the marginal densities of a."""
    figure = plt.figure(figsize=(10.0, 7.0), layout="constrained")
    above, below = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(1.0, 0.9))
    a, density = sampling_ridge.marginal(cut=True)
    inside = (a > 0.0) & (a < FARTHEST)
    truth = sampling_ridge.spread(cut=True)
    titles = {"emcee": "emcee's default move, natural parameters", OURS[0]: "bp.sample"}
    for top, bottom, (name, title) in zip(above, below, titles.items(), strict=True):
        run = runs[name]
        draws = dict(zip("ab", run.values.reshape(-1, 2).T, strict=True))
        some = np.linspace(0, draws["a"].size - 1, SHOWN).astype(int)
        curve = np.linspace(1.0 / FARTHEST, FARTHEST, 400)
        top.plot(curve, 1.0 / curve, color="0.6", lw=6.0, alpha=0.5, label="a·b = 1", zorder=1)
        label = f"{SHOWN} of the draws"
        top.plot(draws["a"][some], draws["b"][some], ".", color=DRAWS, ms=2.5, label=label, rasterized=True)
        length = f"{run.length:.0f} tau long" + ("" if run.length >= efficiency.LONG else ", too short")
        top.set_title(f"{title}:\n{run.calls} evaluations, {length}", fontsize=11)
        bins = np.linspace(0.0, FARTHEST, 81)
        bottom.hist(draws["a"], bins, density=True, color=HISTOGRAM, alpha=0.7, label="draws")
        bottom.plot(a[inside], density[inside], color=TRUTH, lw=1.4, label="by quadrature")
        spread = f"sd(a) of the draws {draws['a'].std():.3f}\nby quadrature {truth:.3f}"
        bottom.text(0.97, 0.55, spread, transform=bottom.transAxes, ha="right", va="top")
        bottom.set_xlabel("a")
        for axes in (top, bottom):
            axes.legend(frameon=False, loc="upper right", markerscale=3)
    above[0].set(xlim=(0.0, FARTHEST), ylim=(0.0, FARTHEST), ylabel="b")
    below[0].set_ylabel("density of a")
    figure.suptitle("The ridge a·b = 1 ± 2 %, priors N(1, 1) cut at zero")
    return figure


def draw_branches(ridge: sampling_ridge.Runs) -> Figure:
    """Draw the ridge with priors over both signs, and over it the one with priors cut at zero.

    The package corner draws single points, so that a branch with 1 % of the mass is visible.
    """
    figure = None
    for name, label in (("uncut_prior", "priors over both signs"), ("natural", "priors cut at zero")):
        figure = bp.plot.corner(
            ridge[name][0], style="corner", names=["a", "b"], figure=figure, bins=60, plot_contours=False,
            plot_density=False, hist_kwargs={"label": label}, data_kwargs={"alpha": 0.4},
        )  # fmt: skip
    assert figure is not None
    return common.titled(figure, "The ridge a·b = 1 ± 2 %: the draws and their densities")


def draw_samplers(found: Mapping[str, Any]) -> Figure:
    """Draw effective samples per evaluation and per second, a row per sampler and a marker per posterior."""
    figure = plt.figure(figsize=(10.0, 4.6), layout="constrained")
    of = {name: [e["samplers"].get(name) for e in found.values()] for name in efficiency.CONTENDERS}
    medians = {name: np.median([e["ess_per_1000"] for e in own if e]) for name, own in of.items() if any(own)}
    order = sorted(medians, key=medians.__getitem__)
    units = {"ess_per_1000": "per 1000 evaluations", "ess_per_second": "per second"}
    for axes, (key, unit) in zip(figure.subplots(1, 2, sharey=True), units.items(), strict=True):
        for at, name in enumerate(order):
            colour = DRAWS if name in OURS else OTHERS
            for entry, marker in zip(of[name], MARKERS, strict=False):
                if entry is not None:
                    face = "white" if entry["length"] < efficiency.LONG else colour
                    axes.plot(entry[key], at, marker, color=colour, mfc=face, ms=7.5, mew=1.4)
        theirs = [own for name, own in of.items() if name not in OURS and all(own)]
        gains = [e[key] / max(own[k][key] for own in theirs) for k, e in enumerate(of[OURS[0]])] if theirs else []
        if gains:
            axes.set_title(f"bp.sample: {min(gains):.2g} to {max(gains):.2g} times the best other package", fontsize=10)
        axes.set(xscale="log", xlabel=f"effective samples {unit}", yticks=range(len(order)), yticklabels=order)
        axes.grid(color="0.9", zorder=0)
        axes.set_axisbelow(True)
    looks: list[dict[str, Any]] = [
        {"marker": m, "color": "0.4", "label": c} for c, m in zip(found, MARKERS, strict=False)
    ]
    looks += [{"marker": "s", "color": c, "label": k} for k, c in (("this package", DRAWS), ("others", OTHERS))]
    looks += [{"marker": "o", "color": "0.4", "mfc": "white", "label": f"shorter than {efficiency.LONG:.0f} tau"}]
    handles = [plt.Line2D([], [], ls="", ms=7, **look) for look in looks]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, handletextpad=0.2)
    figure.suptitle("Effective samples of the slowest quantity, by sampler and posterior", fontsize=11)
    return figure
