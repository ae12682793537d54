"""A chaotic pendulum, identified from the unstable periodic orbits in its recording (section 5 of the paper).

φ'' + c1 tanh(φ'/v0) + c2 φ' + c3 φ'|φ'| + (g + a ω² cos ωt)/l · sin φ = 0 with c_i = k_i/(m l²), at ω = 9.09 rad/s.
Orbits with error bars are found in 42,754 drive periods; m and l, then k3, then all five parameters are estimated, of
which only combinations are identifiable. With --replicates N: the counterpart of the paper's table 1, over N
recordings.
"""

import argparse
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.pendulum import estimates as pendulum_estimates
from studies.pendulum import orbits
from studies.pendulum import recording as pendulum_recording
from studies.pendulum.estimates import ALL, FREE, LARGEST, LONGEST_USED, PAPER_ERRORS, START_ERRORS, Identified, Ridge
from studies.pendulum.recording import TRUTH, UNITS, section_of, with_noise


class Found(NamedTuple):
    """Orbits found in one section."""

    section: bp.PoincareSection
    chained: bp.Orbits  # By the default method
    boxes: bp.Orbits  # By the paper's recipe


def _section(recording: bp.Recording, noise: float, seed: int) -> bp.PoincareSection:
    return section_of(with_noise(recording, noise, seed) if noise > 0.0 else recording)


def _boxes(section: bp.PoincareSection, periods: Sequence[int]) -> bp.Orbits:
    return bp.find_orbits(section, periods=periods, method="boxes")


def _found(recording: bp.Recording, noise: float, seed: int, periods: Sequence[int]) -> Found:
    section = _section(recording, noise, seed)
    return Found(section, bp.find_orbits(section, periods=periods), _boxes(section, periods))


def _clean(recording: bp.Recording, seed: int, periods: Sequence[int]) -> tuple[Found, orbits.Confirmed]:
    """Return the orbits found without noise, and the same by shooting."""
    found = _found(recording, 0.0, seed, periods)
    return found, orbits.true_orbits(found.chained)


NOISE_LEVELS = (0.0, 0.001, 0.01)
TABLE_NOISE = (0.001, 0.01)
PERIODS, QUICK_PERIODS = range(1, 6), range(1, 4)


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    if not 0.0 <= options.noise < 1.0:
        raise ValueError(f"--noise: must be a fraction from 0 to 1, got {options.noise}.")
    if options.replicates:
        _replicates(options)
        return
    watch = common.Stopwatch()
    periods = QUICK_PERIODS if options.quick else PERIODS
    with common.workers(1) as pool:
        # Another process compiles the solver while this one simulates; then it finds the orbits of the other noise
        # levels, and those without noise by shooting.
        prepared = pool.submit(pendulum_estimates.prepare)
        with watch.part("recording", "the recording"):
            recording, about = pendulum_recording.get(options.data, options.quick, options.seed)
        kind = "SYNTHETIC" if about["synthetic"] else "measured"
        print(f"  {kind} recording: {about['drive_periods']} drive periods, {about['values']} numbers")
        noise = options.noise if about["synthetic"] else 0.0
        results: dict[str, Any] = {"recording": about, "noise": noise, "seed": options.seed, "quick": options.quick}
        clean = pool.submit(_clean, recording, options.seed, periods) if about["synthetic"] and noise > 0.0 else None
        others = {level: pool.submit(_found, recording, level, options.seed, periods) for level in NOISE_LEVELS
                  if level not in (0.0, noise) and about["synthetic"] and not options.quick}  # fmt: skip
        with watch.part("orbits", f"finding orbits without a model, noise {noise:.2%}"):
            section = _section(recording, noise, options.seed)
            boxes = pool.submit(_boxes, section, periods)
            chained = bp.find_orbits(section, periods=periods)
            print(f"  {len(chained)} candidates", flush=True)
        with watch.part("estimates", "m and l, k3, and all five, from the paper's start"):
            structure = prepared.result()
            identified = pendulum_estimates.identify(chained)
            eigenvalue_fits = {
                which: pendulum_estimates.with_eigenvalues(identified.selected, names) for which, names in FREE.items()
            }
        with watch.part("ridge", "sampling the posterior of all five with emcee"):
            posterior = pendulum_estimates.sample(identified, options.seed, options.quick)
            idle = pool if boxes.done() else None
            ridge = pendulum_estimates.diagnose(identified, structure, posterior, idle)
        found = Found(section, chained, boxes.result())
        if about["synthetic"]:
            with watch.part("reference", "waiting for the orbits at other noise levels, and by shooting"):
                without, confirmed = clean.result() if clean else (found, orbits.true_orbits(chained))
                every = {0.0: without, noise: found} | {level: other.result() for level, other in others.items()}
            results |= _against_shooting(dict(sorted(every.items())), confirmed)
            print(_orbit_account(results))
    results |= estimates(about, found, identified, eigenvalue_fits)
    print(_estimate_account(results))
    results["all_five"] = pendulum_estimates.collect(ridge)
    print(f"  {ridge.posterior.reason}\n{ridge.identifiability}\n{ridge.natural}\n{ridge.combinations}")
    with watch.part("figures", "drawing"):
        table = results.get("eigenvalues", {})
        drawn = figures(found.section, identified, ridge, table)
        paths = common.save_figures(options.out, drawn)
    common.finish(options.out, results, watch, paths, synthetic=about["synthetic"])


def _against_shooting(found: Mapping[float, Found], confirmed: orbits.Confirmed) -> dict[str, Any]:
    """Return the orbits found without noise, compared with shooting, and the multipliers by noise level and method."""
    polished, truths, refuted = confirmed
    return {
        "found_without_noise": {
            "candidates": len(found[0.0].chained),
            "polished": len(polished),
            "rejected": [[orbit.name, reason] for orbit, reason in polished.rejected],
            "classes": orbits.classes(polished),
            "classes_wanted": orbits.WANTED_CLASSES,
            "classes_known": orbits.KNOWN_CLASSES,
            "states_of_rest": sum(orbit.equilibrium for orbit in polished),
            "not_confirmed_by_shooting": refuted,
            "largest_difference_from_shooting": max(truth.off for truth in truths),
        },
        "eigenvalues": {
            f"{noise:g}": {m: orbits.eigenvalue_table(getattr(one, m), truths) for m in orbits.METHODS}
            for noise, one in found.items()
        },
        "error_bars": {
            f"{noise:g}": {
                kind: orbits.covered(values) for kind, values in orbits.pulls(one.chained, truths, LARGEST).items()
            }
            for noise, one in found.items()
        },
    }


def estimates(
    about: Mapping[str, Any], found: Found, identified: Identified, with_eigenvalues: Mapping[str, bp.MapEstimate]
) -> dict[str, Any]:
    """Return the estimates, the orbits used and those excluded."""
    used = sum(orbit.points.size for orbit in identified.selected)
    table = {}
    for which, fit in identified.fits.items():
        rows: dict[str, dict[str, float]] = {name: {"value": v, "sd": fit.sd[name]} for name, v in fit.theta.items()}
        for name, error in pendulum_estimates.errors(fit).items() if about["synthetic"] else ():
            rows[name]["relative_error"] = error
        table[which] = {
            "status": fit.status,
            "parameters": rows,
            "scale": fit.noise["scale"],
            "sd_with_eigenvalues_over_without": {n: with_eigenvalues[which].sd[n] / fit.sd[n] for n in fit.theta},
        }
    return {
        "candidates": {"chained": len(found.chained), "boxes": len(found.boxes)},
        "polished": len(identified.polished),
        "selected": [orbit.name for orbit in identified.selected],
        "left_out": [[orbit.name, reason] for orbit, reason in identified.selected.rejected],
        "lost_on_the_way": [list(pair) for pair in identified.lost],
        "estimates": table,
        "start_errors": START_ERRORS,
        "paper_errors": PAPER_ERRORS,
        "data_reduction": {"numbers_in_the_recording": about["values"], "numbers_used": used},
    }


def _orbit_account(results: Mapping[str, Any]) -> str:
    clean = results["found_without_noise"]
    rows = {
        f"noise {float(noise):.1%}, {method}, period {row['period']}": row
        for noise, methods in results["eigenvalues"].items()
        for method, every in methods.items()
        for row in every
    }
    return "\n".join([
        f"  without noise {clean['polished']} orbits of {clean['candidates']} candidates; classes by period "
        f"{clean['classes']}, wanted {clean['classes_wanted']}",
        f"  largest difference from shooting {clean['largest_difference_from_shooting']:.1e} rad, not confirmed: "
        f"{clean['not_confirmed_by_shooting'] or 'none'}",
        common.shown("unstable eigenvalues", rows, ["candidates", "orbits", "median_relative_error"]),
    ])  # fmt: skip


def _estimate_account(results: Mapping[str, Any]) -> str:
    reduction = results["data_reduction"]
    rows = {
        f"{which}: {name}": {**one, "paper": PAPER_ERRORS.get(name) if which != ALL else None}
        for which, found in results["estimates"].items()
        for name, one in found["parameters"].items()
    }
    return common.shown(
        f"{len(results['selected'])} orbits selected of {results['polished']}: of "
        f"{reduction['numbers_in_the_recording']} numbers in the recording {reduction['numbers_used']} are used",
        rows,
    )


def _replicates(options: argparse.Namespace) -> None:
    """Compute table 1 of the paper over many recordings: errors, coverage, failures, and multipliers as data."""
    watch = common.Stopwatch()
    print("All data are SYNTHETIC: simulated from the stated truth, with noise.")
    with watch.part("truths", "the true orbits, by shooting"):
        section = section_of(pendulum_recording.simulate(pendulum_recording.PERIODS, options.seed))
        _, truths, _ = orbits.true_orbits(bp.find_orbits(section, periods=range(1, LONGEST_USED + 1)))
    lines: list[dict[str, Any]] = []
    with watch.part("replicates", f"{options.replicates} recordings at {len(TABLE_NOISE)} noise levels"):
        tasks = [(options.seed + 1 + number, truths) for number in range(options.replicates)]
        for number, found in enumerate(common.each(_replicate, tasks), 1):
            lines += found
            print(f"  {number} of {len(tasks)}", flush=True)
    lines.sort(key=lambda line: (line["noise"], line["seed"]))
    table = {f"{noise:g}": _summary([line for line in lines if line["noise"] == noise]) for noise in TABLE_NOISE}
    print(_account(table))
    folder = options.out / "table"
    paths = common.save_figures(folder, {"errors": errors(lines)})
    results = {"synthetic": True, "seed": options.seed, "drive_periods": pendulum_recording.PERIODS, "table": table}
    results |= {"replicates": lines, "start_errors": START_ERRORS, "paper_errors": PAPER_ERRORS}
    common.finish(folder, results, watch, paths, synthetic=True)


def _replicate(seed: int, truths: Sequence[orbits.Reference]) -> list[dict[str, Any]]:
    """Return the results of one recording, whose start and noise the seed determines, at every noise level."""
    recording, lines = pendulum_recording.simulate(pendulum_recording.PERIODS, seed), []
    for noise in TABLE_NOISE:
        line: dict[str, Any] = {"seed": seed, "noise": noise, "errors": {}}
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                line |= _one(with_noise(recording, noise, seed), truths)
            except (ValueError, RuntimeError) as error:
                line["failure"] = f"{type(error).__name__}: {error}"
        lines.append(line | {"seconds": round(time.perf_counter() - start, 2)})
    return lines


def _one(recording: bp.Recording, truths: Sequence[orbits.Reference]) -> dict[str, Any]:
    found_orbits = bp.find_orbits(section_of(recording), periods=range(1, LONGEST_USED + 1))
    found = pendulum_estimates.identify(found_orbits, which=("m and l", "k3"))
    every = (
        list(found.fits.values()),
        [pendulum_estimates.with_eigenvalues(found.selected, FREE[n]) for n in found.fits],
    )
    line: dict[str, Any] = {
        "orbits": len(found_orbits),
        "selected": len(found.selected),
        "lost": [list(pair) for pair in found.lost],
        "not_orbits": sum(orbits.matched(orbit, truths) is None for orbit in found.selected),
        "pulls": orbits.pulls(found_orbits, truths, np.inf),
        "converged": all(fit.converged for fits in every for fit in fits),
    }
    for key, fits in zip(("", "eigenvalue_"), every, strict=True):
        line[f"{key}errors"] = {n: e for fit in fits for n, e in pendulum_estimates.errors(fit).items()}
        line[f"{key}sd"] = {n: fit.sd[n] / fit.theta[n] for fit in fits for n in fit.theta}
        line[f"{key}covers"] = {n: c for fit in fits for n, c in pendulum_estimates.covers(fit).items()}
    line["scale"] = found.fits["m and l"].noise["scale"]
    return line


def _summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    whole = [line for line in lines if "failure" not in line]
    found: dict[str, Any] = {
        "recordings": len(lines),
        "failures": [line["failure"] for line in lines if "failure" in line],
        "lost_orbits": sum(len(line["lost"]) for line in whole),
        "selected_that_are_no_orbits": sum(line["not_orbits"] for line in whole),
        "selected_median": float(np.median([line["selected"] for line in whole])),
        "seconds_each": float(np.mean([line["seconds"] for line in lines])),
    }
    for name, paper in PAPER_ERRORS.items():
        size = np.abs([line["errors"][name] for line in whole])
        found[name] = {
            "median_error": float(np.median(size)),
            "range_90": [float(q) for q in np.quantile(size, [0.05, 0.95])],
            "paper": paper,
            "covered": orbits.covered([0.0 if line["covers"][name] else np.inf for line in whole]),
            "covered_with_eigenvalues": orbits.covered(
                [0.0 if line["eigenvalue_covers"][name] else np.inf for line in whole]
            ),
            "sd_with_eigenvalues_over_without": float(
                np.median([line["eigenvalue_sd"][name] / line["sd"][name] for line in whole])
            ),
        }
    for kind in ("eigenvalue", "point"):
        found[f"{kind}_bars"] = orbits.covered([p for line in whole for p in line["pulls"][kind]])
    return found


def _account(table: dict[str, Any]) -> str:
    columns = ["median_error", "paper", "covered.cover", "covered.bars", "covered.band_low", "covered.band_high"]
    columns += ["covered_with_eigenvalues.cover", "sd_with_eigenvalues_over_without"]
    lines = []
    for noise, found in table.items():
        bars = found["eigenvalue_bars"]
        rows = {name: found[name] for name in PAPER_ERRORS}
        title = f"noise {float(noise):.1%}: relative errors, coverage of 90 % intervals"
        lines.append(common.shown(title, rows, columns))
        lines.append(
            f"failures {len(found['failures'])}, orbits lost {found['lost_orbits']}, selected but not true "
            f"{found['selected_that_are_no_orbits']}; eigenvalue error bars {bars['cover']} of {bars['bars']} "
            f"(band {bars['band_low']:.0f} … {bars['band_high']:.0f}); {found['seconds_each']:.1f} s each"
        )
    return "\n".join(lines)


BINS, SHOWN = 45, (0.001, 0.999)
TRUE = "#009E73"
METHODS = {"chained": ("#0072B2", "o", "-"), "boxes": ("#D55E00", "s", "--")}
SYNTHETIC = "synthetic data"


def figures(
    section: bp.PoincareSection, found: Identified, ridge: Ridge, table: Mapping[str, Any]
) -> dict[str, Figure]:
    """Return every figure of a run."""
    drawn = {
        "section": bp.plot.section(section, found.polished, units=UNITS),
        "orbits": bp.plot.orbits(found.selected, units=UNITS),
        "corner": corner(ridge, truth=section.synthetic),
        "ridge": marginals(ridge, truth=section.synthetic),
    }
    kind = f" ({SYNTHETIC})" * section.synthetic
    drawn["section"].suptitle(f"Unstable orbits found in the pendulum's chaotic motion{kind}", fontsize="medium")
    drawn["orbits"].legends[0].set_title(f"Unstable orbits of the pendulum{kind}")
    drawn["orbits"].legends[0].get_title().set_fontsize("medium")
    if table:
        drawn["eigenvalues"] = eigenvalues(table)
    return drawn


def corner(ridge: Ridge, *, truth: bool) -> Figure:
    """Draw the posterior of all five parameters."""
    names = pendulum_estimates.NATURAL
    truths = {name: TRUTH[name] for name in names} if truth else None
    figure = bp.plot.corner(ridge.posterior, laplace=ridge.fit, names=names, truths=truths)
    return common.titled(figure, "m, k1, k2 and k3 are determined only up to a common factor; l by itself")


def marginals(ridge: Ridge, *, truth: bool) -> Figure:
    """Draw Laplace and MCMC of the parameters above, and of the combinations that the data determine below."""
    figure = plt.figure(figsize=(11.0, 5.4), layout="constrained")
    grid = figure.subplots(2, 5)
    for axes, name in zip(grid[0], pendulum_estimates.NATURAL, strict=True):
        _marginal(axes, ridge.posterior.draws(name), ridge.fit.theta[name], ridge.fit.sd[name], TRUTH[name], truth)
        axes.set_xlabel(common.axis_label(name, bp.models.pendulum.units[name]))
    draws = pendulum_estimates.combinations({name: ridge.posterior.draws(name) for name in pendulum_estimates.NATURAL})
    truths = pendulum_estimates.combinations(TRUTH)
    for axes, name in zip(grid[1], pendulum_estimates.DETERMINED, strict=False):
        value, sd = (float(ridge.combinations[column].loc[name]) for column in ("value", "laplace_sd"))
        _marginal(axes, draws[name], value, sd, truths[name], truth)
        text = name if name == "l" else f"{name} = k{name[1]}/(m l²)"
        axes.set_xlabel(common.axis_label(text, pendulum_estimates.DETERMINED_UNITS[name]))
    handles, labels = grid[0, 0].get_legend_handles_labels()
    grid[1, 4].set_axis_off()
    grid[1, 4].legend(handles, labels, loc="center", frameon=False)
    for row, text in zip(grid, ("parameters", "what the data determine"), strict=True):
        row[0].set_ylabel(f"{text}:\ndensity")
    notes = ["synthetic data"] * truth + ["NOT CONVERGED"] * (not ridge.posterior.converged)
    figure.suptitle(", ".join(["All five free, from unstable orbits alone", *notes]))
    return figure


def _marginal(axes: Axes, draws: np.ndarray, mean: float, sd: float, true: float, has_truth: bool) -> None:
    density, edges = np.histogram(draws, BINS, tuple(np.quantile(draws, SHOWN)), density=True)
    axes.stairs(density, edges, fill=True, color=bp.plot.COLOURS["mcmc"], label="MCMC")
    if np.isfinite(sd):
        x = np.linspace(min(edges[0], mean - 3 * sd), max(edges[-1], mean + 3 * sd), 300)
        normal = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        axes.plot(x, normal, color=bp.plot.COLOURS["laplace"], ls="--", lw=1.6, label="Laplace")
    if has_truth:
        axes.axvline(true, color=TRUE, lw=1.6, label="truth")
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=3)
    axes.ticklabel_format(axis="x", scilimits=(-3, 4))


def eigenvalues(table: Mapping[str, Any]) -> Figure:
    """Draw the median error of the unstable eigenvalue over the period, by noise and method, and the orbits found."""
    figure = plt.figure(figsize=(3.4 * len(table) + 0.8, 5.6), layout="constrained")
    above, below = figure.subplots(2, len(table), sharex=True, sharey="row", squeeze=False)
    for top, bottom, (noise, methods) in zip(above, below, table.items(), strict=True):
        for shift, (method, (colour, marker, style)) in zip((-0.2, 0.2), METHODS.items(), strict=True):
            rows = [row for row in methods[method] if row["candidates"] or row["orbits"]]
            matched = [row for row in rows if row["median_relative_error"] is not None]
            errors = [100 * row["median_relative_error"] for row in matched]
            top.semilogy([row["period"] for row in matched], errors, style, marker=marker, color=colour, label=method)
            periods = np.array([row["period"] for row in rows]) + shift
            bottom.bar(periods, [r["candidates"] for r in rows], 0.36, color="white", edgecolor=colour, hatch="///")
            bottom.bar(periods, [r["orbits"] for r in rows], 0.36, color=colour)
        top.set_title(f"noise {float(noise):.1%} of the attractor")
        bottom.set_xlabel("period [forcing periods]")
    above[0].set_ylabel("median error of the\nunstable eigenvalue [%]")
    below[0].set_ylabel("candidates found\n(filled: true orbits)")
    above[-1].legend(frameon=False)
    figure.suptitle(f"Local fits, chained, and the paper's boxes ({SYNTHETIC})")
    return figure


def errors(lines: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the errors of m, l and k3 over noise seeds, beside the paper's."""
    noises = sorted({line["noise"] for line in lines})
    figure = plt.figure(figsize=(7.6, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for number, noise in enumerate(noises):
        for place, name in enumerate(PAPER_ERRORS):
            values = [100 * abs(x["errors"][name]) for x in lines if x["noise"] == noise and name in x["errors"]]
            box = axes.boxplot([values], positions=[place + 0.28 * (number - 0.5 * (len(noises) - 1))], widths=0.2,
                               whis=(5, 95), patch_artist=True, manage_ticks=False, medianprops={"color": "black"},
                               flierprops={"ms": 4})  # fmt: skip
            box["boxes"][0].set(facecolor=("#56B4E9", "#E69F00")[number % 2], hatch=("", "///")[number % 2])
            if place == 0:
                box["boxes"][0].set_label(f"noise {noise:.1%} of the attractor")
    for place, error in enumerate(PAPER_ERRORS.values()):
        label = "the paper's table 1" if place == 0 else None
        axes.plot([place - 0.4, place + 0.4], [100 * error] * 2, color="black", lw=2.0, label=label)
    axes.set_yscale("log")
    axes.set_xticks(range(len(PAPER_ERRORS)), [f"{name}" for name in PAPER_ERRORS])
    axes.set_xlabel("parameter")
    axes.set_ylabel("error [%]")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    seeds = len(lines) // len(noises)
    figure.suptitle(f"Errors over {seeds} recordings, boxes: quartiles, whiskers: 90 % ({SYNTHETIC})")
    return figure
