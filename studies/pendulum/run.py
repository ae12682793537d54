"""A chaotic pendulum, identified from the unstable periodic orbits in its recording (section 5 of the paper).

φ'' + c1 tanh(φ'/v0) + c2 φ' + c3 φ'|φ'| + (g + a ω² cos ωt)/l · sin φ = 0 with c_i = k_i/(m l²), at ω = 9.09 rad/s.
Orbits with error bars are found in 42,754 drive periods; m and l, then k3, then all five parameters are estimated, of
which only combinations are identifiable. With --replicates N: the counterpart of the paper's table 1, over N
recordings.
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import bayesperiodic as bp
from studies import common
from studies.pendulum import estimates as pendulum_estimates
from studies.pendulum import figures as pendulum_figures
from studies.pendulum import orbits, replicates
from studies.pendulum import recording as pendulum_recording
from studies.pendulum.estimates import PAPER_ERRORS, START_ERRORS, Identified
from studies.pendulum.recording import section_of, with_noise


class Found(NamedTuple):
    """Orbits found in one section."""

    section: bp.PoincareSection
    chained: bp.Orbits  # By the default method
    boxes: bp.Orbits  # By the paper's recipe


def search(recording: bp.Recording, noises: Sequence[float], seed: int, periods: Sequence[int]) -> dict[float, Found]:
    """Return the orbits found with each noise level added to the recording, as a fraction of the attractor's size."""
    # The noisiest takes longest, and comes first.
    levels = list(dict.fromkeys(noises))[::-1]
    tasks = [(recording, noise, seed, tuple(periods)) for noise in levels]
    found = dict(zip(levels, common.each(_found, tasks, here=len(tasks) == 1), strict=True))
    return {noise: found[noise] for noise in noises}


def _found(recording: bp.Recording, noise: float, seed: int, periods: tuple[int, ...]) -> Found:
    section = section_of(with_noise(recording, noise, seed) if noise > 0.0 else recording)
    return Found(section, *(bp.find_orbits(section, periods=periods, method=m) for m in orbits.METHODS))


NOISE_LEVELS = (0.0, 0.001, 0.01)
PERIODS, QUICK_PERIODS = range(1, 6), range(1, 4)


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    if options.replicates < 0 or not 0.0 <= options.noise < 1.0:
        raise ValueError(
            f"--replicates, --noise: must be at least 0 and a fraction from 0 to 1, got {options.replicates} and "
            f"{options.noise}."
        )
    if options.replicates:
        replicates.run(options)
        return
    watch = common.Stopwatch()
    with watch.part("recording", "the recording"):
        recording, about = pendulum_recording.get(options.data, options.quick, options.seed)
    kind = "SYNTHETIC" if about["synthetic"] else "measured"
    print(f"  {kind} recording: {about['drive_periods']} drive periods, {about['values']} numbers")
    noise = options.noise if about["synthetic"] else 0.0
    levels = (0.0, noise) if options.quick or not about["synthetic"] else (*NOISE_LEVELS, noise)
    with watch.part("orbits", f"finding orbits without a model, noise {', '.join(f'{n:.2%}' for n in set(levels))}"):
        found = search(recording, levels, options.seed, QUICK_PERIODS if options.quick else PERIODS)
    results: dict[str, Any] = {"recording": about, "noise": noise, "seed": options.seed, "quick": options.quick}
    if about["synthetic"]:
        with watch.part("reference", "the same orbits by shooting"):
            results |= _against_shooting(found)
        print(_orbit_account(results))
    with watch.part("estimates", "m and l, k3, and all five, from the paper's start"):
        identified = pendulum_estimates.identify(found[noise].chained)
        eigenvalue_fits = {
            which: pendulum_estimates.with_eigenvalues(identified.selected, names)
            for which, names in pendulum_estimates.FREE.items()
        }
    results |= estimates(about, found[noise], identified, eigenvalue_fits)
    print(_estimate_account(results))
    with watch.part("ridge", "sampling the posterior of all five with emcee"):
        ridge = pendulum_estimates.sample(identified, options.seed, options.quick)
    results["all_five"] = pendulum_estimates.collect(ridge)
    print(f"  {ridge.posterior.reason}\n{ridge.identifiability}\n{ridge.natural}\n{ridge.combinations}")
    with watch.part("figures", "drawing"):
        table = results.get("eigenvalues", {})
        figures = pendulum_figures.figures(found[noise].section, identified, ridge, table)
        paths = common.save_figures(options.out, figures)
    common.finish(options.out, results, watch, paths, synthetic=about["synthetic"])


def _against_shooting(found: Mapping[float, Found]) -> dict[str, Any]:
    """Return the orbits found without noise, compared with shooting, and the multipliers by noise level and method."""
    clean = found[0.0].chained
    polished = bp.polish_orbits(bp.models.pendulum, clean, pendulum_recording.TRUTH, samples=orbits.SAMPLES)
    truths, refuted = orbits.references(polished)
    return {
        "found_without_noise": {
            "candidates": len(clean),
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
                kind: orbits.covered(values)
                for kind, values in orbits.pulls(one.chained, truths, pendulum_estimates.LARGEST).items()
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
        table[which] = {
            "status": fit.status,
            "parameters": pendulum_estimates.estimate_table(fit, synthetic=about["synthetic"]),
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
        f"{which}: {name}": {**one, "paper": PAPER_ERRORS.get(name) if which != pendulum_estimates.ALL else None}
        for which, found in results["estimates"].items()
        for name, one in found["parameters"].items()
    }
    return common.shown(
        f"{len(results['selected'])} orbits selected of {results['polished']}: of "
        f"{reduction['numbers_in_the_recording']} numbers in the recording {reduction['numbers_used']} are used",
        rows,
    )
