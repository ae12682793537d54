"""Accuracy and cost of sampling: a ridge known by quadrature, three samplers, pools of workers and cores.

The ridge is computed; the damper is measured or synthetic, see studies/damper/run.py.
"""

import argparse
import importlib.util
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

import bayesperiodic as bp
from studies import common
from studies.damper import run as damper
from studies.sampling import cost as sampling_cost
from studies.sampling import ridge as sampling_ridge
from studies.timing import timed

TRUTH, DRAWS, HISTOGRAM = "#000000", "#0072B2", "#56B4E9"
STYLES: dict[str, dict[str, Any]] = {
    "emcee": {"color": "#BBD7EA"},
    "emcee, collapsed": {"histtype": "step", "color": "#0072B2", "lw": 1.6},
    "NUTS": {"histtype": "step", "color": "#D55E00", "lw": 1.6, "ls": "--"},
}
BINS = 41
SHOWN = 1500
FARTHEST = 4.0
BAR, NEUTRAL, LIMIT = "#56B4E9", "#BBBBBB", "#D55E00"


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    with watch.part("cost", "overhead of a pool of workers, and gain of several cores"):
        cost = sampling_cost.run_cost(options.quick)
    busy = sampling_cost.loaded(cost)
    if busy:
        print(f"  note: {busy}")
    with watch.part("ridge", "the ridge a·b = 1, with known spread"):
        ridge = sampling_ridge.sample_ridge(options.seed, options.quick)
    with watch.part("damper", "the damper by three samplers"):
        sampled, data = sample_damper(options)
    found: dict[str, Any] = {
        "ridge": sampling_ridge.collect(ridge),
        "damper": collect(sampled, data),
        "cost": cost | {"note": busy},
    }
    found["checks"] = sampling_ridge.rows(found["ridge"]) + rows(found["damper"], options.quick)
    found["checks"] += sampling_cost.rows(cost)
    with watch.part("figures", "drawing"):
        figures = {
            "ridge": draw_ridge(ridge),
            "samplers": draw_samplers(sampled, found["damper"]),
            "costs": draw_costs(cost, busy),
        }
        paths = common.save_figures(options.out, figures)
    print("\n" + tables(found) + "\n")
    results = {"seed": options.seed, "quick": options.quick} | found
    common.finish(options.out, results, watch, paths, synthetic=data["synthetic"])


SAMPLERS: dict[str, dict[str, Any]] = {
    "emcee": {},
    "emcee, collapsed": {"variances": "collapsed"},
    "NUTS": {"sampler": "nuts"},
}
FALSE_ALARM = 0.01
MISSING = 'nutpie is not installed (pip install "bayesperiodic[nuts]")'


def sample_damper(options: argparse.Namespace) -> tuple[sampling_ridge.Runs, dict[str, Any]]:
    """Return the posterior by every sampler that is installed, and the data's path, digest and whether synthetic."""
    recording, data = damper.read_recording(options.data, options.seed)
    problem = bp.Problem(bp.models.dahl, [recording.fold()], priors=damper.PRIORS)
    fit = bp.map_estimate(problem, progress=False)
    found: sampling_ridge.Runs = {}
    for name, settings in SAMPLERS.items():
        if name == "NUTS" and importlib.util.find_spec("nutpie") is None:
            continue
        shorter: dict[str, Any] = {"max_steps": 250, "ensembles": 2} if options.quick else {}
        run = partial(bp.sample, problem, fit, seed=options.seed, progress=False, **shorter, **settings)
        found[name] = timed(run)
        print(f"  {name}: {found[name][0].reason}, {found[name][1]:.0f} s")
    return found, data


def moments(posterior: bp.Posterior) -> dict[str, dict[str, float]]:
    """Return mean and sd of every quantity with their Monte Carlo errors.

    What a draw contributes to the sd is, to first order, ((x − mean)² − sd²)/(2 sd).
    """
    found = {}
    for name in posterior.names:
        values = posterior.draws(name)
        mean, sd = float(values.mean()), float(values.std())
        found[name] = {
            "mean": mean,
            "sd": sd,
            "mean_error": sampling_ridge.standard_error(posterior, values),
            "sd_error": sampling_ridge.standard_error(posterior, (values - mean) ** 2 / (2.0 * sd)),
        }
    return found


def compare_all(posteriors: dict[str, bp.Posterior]) -> list[dict[str, Any]]:
    """Return every difference of two samplers in a mean or sd, over the combined Monte Carlo error."""
    tables = {name: moments(posterior) for name, posterior in posteriors.items()}
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


def limit(count: int, ensembles: int) -> float:
    """Return the limit that the largest of `count` differences exceeds with a probability of at most 1 % (Bonferroni).

    Each is Student's t; its degrees of freedom are at least those of one sampler's error, one less than it has batches.
    """
    return float(stats.t.isf(0.5 * FALSE_ALARM / count, ensembles * sampling_ridge.BATCHES - 1))


def collect(sampled: sampling_ridge.Runs, data: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of results.json on the damper."""
    differences = compare_all({name: posterior for name, (posterior, _) in sampled.items()})
    ensembles = [posterior.tree["posterior"].sizes["chain"] for posterior, _ in sampled.values()]
    return {
        "data": data,
        "units": {name: bp.models.dahl.units[name] for name in bp.models.dahl.parameters} | {"variance[force]": "N²"},
        "samplers": {name: _account(posterior, seconds) for name, (posterior, seconds) in sampled.items()},
        "differences": differences,
        "limit": limit(len(differences), min(ensembles)),
        "false_alarm_rate": FALSE_ALARM,
    }


def _account(posterior: bp.Posterior, seconds: float) -> dict[str, Any]:
    smallest = min(posterior.ess.values())
    return {
        "converged": posterior.converged,
        "reason": posterior.reason,
        "moments": moments(posterior),
        "ess_min": smallest,
        "rhat_max": max(posterior.rhat.values()),
        "log_posteriors": posterior.log_posterior_calls,
        "seconds": seconds,
        "ess_per_second": smallest / seconds,
        "ess_per_1000_log_posteriors": 1e3 * smallest / posterior.log_posterior_calls,
    }


def rows(found: dict[str, Any], quick: bool) -> list[common.Row]:
    """Return the targets of the damper: pairwise agreement of the samplers, and convergence unless `quick`."""
    kind = "damper, synthetic" if found["data"]["synthetic"] else "damper"
    result = []
    for name in SAMPLERS:
        entry = found["samplers"].get(name)
        what = f"{kind}, {name}: called converged (1: yes)"
        if entry is None:
            result.append(common.row(what, None, 1.0, 1.0, MISSING))
        else:
            judged = common.row(what, entry["converged"], 1.0, 1.0, "" if entry["converged"] else entry["reason"])
            result.append(judged | ({"met": None, "note": f"a quick run: {entry['reason']}"} if quick else {}))
    for one, other in combinations(SAMPLERS, 2):
        pair = [d for d in found["differences"] if d["samplers"] == [one, other]]
        worst = max(pair, key=lambda d: d["errors"], default=None)
        what = f"{kind}, {one} against {other}: largest difference over its Monte Carlo error"
        note = MISSING if worst is None else f"largest in the {worst['quantity']}"
        result.append(common.row(what, None if worst is None else worst["errors"], 0.0, found["limit"], note))
    return result


def table(found: dict[str, Any]) -> str:
    """Return the samplers' costs as text."""
    kind = "SYNTHETIC data" if found["data"]["synthetic"] else "measured data"
    columns = ["reason", "ess_min", "log_posteriors", "seconds", "ess_per_second", "ess_per_1000_log_posteriors"]
    return common.shown(f"The damper by three samplers, {kind}", found["samplers"], columns)


def tables(found: dict[str, Any]) -> str:
    """Return the text to print."""
    lines = [table(found["damper"]), ""]
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


def draw_ridge(ridge: sampling_ridge.Runs) -> Figure:
    """Draw a and b of the short natural chain and of the default run, over the marginal densities of a."""
    figure = plt.figure(figsize=(10.0, 7.0), layout="constrained")
    above, below = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(1.0, 0.9))
    a, density = sampling_ridge.marginal(cut=True)
    inside = (a > 0.0) & (a < FARTHEST)
    truth = sampling_ridge.spread(cut=True)
    titles = {"natural": "natural coordinates, short chain", "default": "default coordinates"}
    for top, bottom, (name, title) in zip(above, below, titles.items(), strict=True):
        posterior, _ = ridge[name]
        draws = {n: posterior.draws(n) for n in ("a", "b")}
        some = np.linspace(0, draws["a"].size - 1, SHOWN).astype(int)
        curve = np.linspace(1.0 / FARTHEST, FARTHEST, 400)
        top.plot(curve, 1.0 / curve, color="0.6", lw=6.0, alpha=0.5, label="a·b = 1", zorder=1)
        top.plot(draws["a"][some], draws["b"][some], ".", color=DRAWS, ms=2.5, label=f"{SHOWN} of the draws")
        verdict = "converged" if posterior.converged else "NOT converged by the stop rule"
        top.set_title(f"{title}:\n{verdict}", fontsize=11)
        bins = np.linspace(0.0, FARTHEST, 81)
        bottom.hist(draws["a"], bins, density=True, color=HISTOGRAM, alpha=0.7, label="draws")
        bottom.plot(a[inside], density[inside], color=TRUTH, lw=1.4, label="by quadrature")
        spread = f"sd(a) of the draws {draws['a'].std():.3f}\nby quadrature {truth:.3f}"
        bottom.text(0.97, 0.55, spread, transform=bottom.transAxes, ha="right", va="top")
        bottom.set_xlabel("a [1]")
        for axes in (top, bottom):
            axes.legend(frameon=False, loc="upper right", markerscale=3)
    above[0].set(xlim=(0.0, FARTHEST), ylim=(0.0, FARTHEST), ylabel="b [1]")
    below[0].set_ylabel("density of a [1]")
    figure.suptitle("The ridge a·b = 1 ± 2 %, priors N(1, 1) cut at zero")
    return figure


def draw_samplers(sampled: sampling_ridge.Runs, found: dict[str, Any]) -> Figure:
    """Draw the marginals of every parameter by every sampler, one over the other."""
    figure = plt.figure(figsize=(10.0, 6.2), layout="constrained")
    for axes, name in zip(figure.subplots(2, 3).flat, found["units"], strict=False):
        draws = {sampler: posterior.draws(name) for sampler, (posterior, _) in sampled.items()}
        low, high = np.quantile(np.concatenate(list(draws.values())), [0.0005, 0.9995])
        bins = np.linspace(low, high, BINS)
        for sampler, values in draws.items():
            entry = found["samplers"][sampler]
            label = f"{sampler}: {entry['ess_per_second']:.0f} independent draws/s"
            axes.hist(values, bins, density=True, label=label, **STYLES[sampler])
        axes.set(xlabel=f"{name} [{found['units'][name]}]", yticks=[], ylim=(0.0, None))
    for axes in figure.axes[::3]:
        axes.set_ylabel("density")
    common.shared_legend(figure, len(sampled))
    worst = max((d["errors"] for d in found["differences"]), default=np.nan)
    figure.suptitle(
        f"The damper, {'synthetic data' if found['data']['synthetic'] else 'measured'}: of all differences in means "
        f"and sds the largest is {worst:.1f} Monte Carlo errors (limit {found['limit']:.1f})",
        fontsize=11,
    )
    return figure


def draw_costs(cost: dict[str, Any], busy: str) -> Figure:
    """Draw the overhead of pools and the gain of cores, with the limits; grey without a verdict."""
    figure = plt.figure(figsize=(10.0, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    pools, gains = cost["pools"], cost["vectorised"]
    if pools is None:
        left.text(0.5, 0.4, "not measured", ha="center", va="center", transform=left.transAxes)
        left.set(xticks=[], ylim=(0.0, 8.0))
    else:
        values = 1e2 * (np.array([[e["median"], *e["quartiles"]] for e in pools["ratios"].values()]) - 1.0)
        names = [f"one {name}\nworker" for name in pools["ratios"]]
        _draw_bars(left, names, values, [NEUTRAL if busy else BAR] * len(names))
        left.axhline(0.0, color="black", lw=0.8)
        left.set_ylim(min(-1.0, 1.2 * values.min()), max(8.0, 1.5 * values.max()))
    _draw_limit(left, 1e2 * (sampling_cost.POOL_LIMIT - 1.0), "limit: at most {:g} %")
    title = f"A pool of one worker, log-posteriors of {1e3 * sampling_cost.LOG_POSTERIOR:g} ms"
    left.set(ylabel="wall time beyond that of one thread [%]", title=title)
    drives = {f"landing gear,\n{drive}-driven": gains[drive] for drive in ("force", "displacement")}
    colours = [NEUTRAL if busy or e["plain"] < sampling_cost.LEAST_GAIN else BAR for e in drives.values()]
    values = np.array([[e["ratio"], *e["ratio_quartiles"]] for e in drives.values()])
    _draw_bars(right, list(drives), values, colours)
    for at, entry in enumerate(drives.values()):
        right.text(at, 0.05, f"call × {entry['gain']:.2f}\nloop × {entry['plain']:.2f}", ha="center", va="bottom")
    right.set_ylim(0.0, max(1.35, 1.3 * values.max()))
    _draw_limit(right, sampling_cost.GAIN_LIMIT, "limit: at least {:g}")
    title = f"{gains['cores']} cores on a call of {gains['walkers']} walkers × {gains['experiments']} experiments"
    right.set(ylabel="gain of the call / gain of a plain loop [1]", title=title)
    figure.suptitle("Cost of sampling" + (f": {busy}" if busy else ""), fontsize=11)
    return figure


def _draw_bars(axes: Axes, names: list[str], values: np.ndarray, colours: list[str]) -> None:
    """Draw medians and quartiles, (bars, 3)."""
    at, ranges = np.arange(len(names)), np.abs(values[:, 1:] - values[:, :1]).T
    axes.bar(at, values[:, 0], width=0.5, color=colours, edgecolor="black")
    label = "quartiles of the repeats"
    axes.errorbar(at, values[:, 0], ranges, fmt="none", ecolor="black", capsize=5, label=label)
    axes.set_xticks(at, names)
    axes.set_xlim(-0.6, len(names) - 0.4)


def _draw_limit(axes: Axes, limit: float, what: str) -> None:
    axes.axhline(limit, color=LIMIT, lw=1.8, ls="--", label=what.format(round(limit, 6)))
    axes.legend(frameon=False, loc="upper right", ncols=2, fontsize=9)
