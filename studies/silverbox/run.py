"""The Silverbox, an electronic Duffing oscillator, under a multisine: the same fit with every noise model.

The recording is the Schroeder-phased multisine of the Silverbox benchmark (T. Wigren, J. Schoukens, 2013;
nonlinearbenchmark.org): odd lines up to 200 Hz, nine steady periods of 1024 samples. Model, in volts and with w0 fixed:
ÿ/w0² + c ẏ/w0 + k1 y + k2 y² + k3 y³ = g u + u0. An offset of the output is left out: other k1, k2 and u0 do the same.
"""

from __future__ import annotations

import argparse
from typing import Any

import bayesperiodic as bp
from studies import common
from studies.silverbox import checks as silverbox_checks
from studies.silverbox import figures as silverbox_figures
from studies.silverbox.data import TRUE, W0, read_steady_parts
from studies.silverbox.problem import DRIVE_LINES, SCHEME, fold, medians, problem, solve, spread
from studies.silverbox.tables import introduction, tables

NOISES = ("independent", "measured", "circulant")
SAMPLES, QUICK_SAMPLES = 8192, 4096
RULE = (
    "the response keeps all harmonics up to the last one that stands out of the cycle-to-cycle scatter (F-test, "
    "false-alarm rate 1 % over all harmonics); the drive keeps its lines, up to 200 Hz"
)


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    samples = QUICK_SAMPLES if options.quick else SAMPLES
    with watch.part("read", "reading the recording and folding it into its mean period"):
        (recording, second), data = read_steady_parts(options.data, options.seed)
        experiment, in_drive = fold(recording, samples), fold(recording, samples, DRIVE_LINES)
    print(introduction(data, experiment))
    with watch.part("compile", "compiling the model, or loading it from the cache"):
        solve(medians(), experiment)
    every, within = {}, {}
    for noise in NOISES:
        with watch.part(f"map {noise}", f"finding the MAP point with the noise model {noise!r}"):
            every[noise], within[noise] = (bp.map_estimate(problem(e, noise)) for e in (experiment, in_drive))
    fit = every["independent"]
    with watch.part("checks", "checking the grid, the starts and the second steady part"):
        grid = silverbox_checks.discretisation(recording, experiment, fit.theta)
        rest, seconds = silverbox_checks.starts_from_rest(experiment, fit.theta)
        checks = {
            "from_rest": rest,
            "other_start": silverbox_checks.other_start(experiment, fit),
            "repetition": silverbox_checks.repetition(experiment, fit, second),
            "beyond_drive": silverbox_checks.beyond_drive(experiment, fit),
        }
    with watch.part("figures", "drawing"):
        choices = {f"{e.harmonics['response']} harmonics": f for e, f in ((experiment, every), (in_drive, within))}
        figures = {
            "spectrum": silverbox_figures.spectrum(experiment, fit, grid.difference, DRIVE_LINES),
            "estimates": silverbox_figures.estimates(choices, TRUE if data["synthetic"] else None),
        }
        paths = common.save_figures(options.out, figures)

    results = {"data": data, "seed": options.seed, "quick": options.quick}
    results |= collect(experiment, every, grid) | checks
    results["response_harmonics"] = {"rule": RULE, "choices": [by_noise(experiment, every), by_noise(in_drive, within)]}
    results |= {"seconds": watch.total() | {"from_rest": seconds}, "versions": common.versions()}
    print("\n" + tables(every, within, results) + "\n")
    path = common.write_results(options.out, results)
    print(f"figures{' (synthetic data)' if data['synthetic'] else ''}: {', '.join(map(str, paths))}\nresults: {path}")


def collect(
    experiment: bp.Experiment, fits: dict[str, bp.MapEstimate], grid: silverbox_checks.Discretisation
) -> dict[str, Any]:
    """Return the content of results.json that comes from the fits with all harmonics and from the grid."""
    fit, split = fits["independent"], fits["measured"].noise_split["response"]
    return {
        "units": {name: bp.models.silverbox.units[name] for name in ("w0", *fit.theta)},
        "w0": W0,
        "frequency": {"value": experiment.frequency, "se": experiment.frequency_se},
        "cycles": experiment.cycles,
        "periodicity": experiment.periodicity,
        "independent_values": experiment.independent["response"],
        "input_harmonics": experiment.harmonics["drive"],
        "scheme": SCHEME,
        "samples": experiment.samples,
        "map": fit.theta,
        "rms": fit.rms["response"],
        "sd_of_response": spread(experiment),
        "residual_fraction": fit.rms["response"] / spread(experiment),
        "noise_split": {"measurement": split.measurement, "model": split.model},
        "input_noise": fit.input_noise["response"],
        "discretisation_error_fraction": grid.fraction,
        "discretisation_allowed": grid.allowed,
    } | by_noise(experiment, fits)


def by_noise(experiment: bp.Experiment, fits: dict[str, bp.MapEstimate]) -> dict[str, Any]:
    """Return what the noise models lead to, side by side."""
    return {
        "harmonics": experiment.harmonics["response"],
        "status": {noise: f.status for noise, f in fits.items()},
        "estimates": {noise: f.theta for noise, f in fits.items()},
        "sd": {noise: f.sd for noise, f in fits.items()},
        "robust_sd": {noise: f.robust_sd for noise, f in fits.items()},
        "noise_parameters": {noise: f.noise for noise, f in fits.items()},
        "residual_fractions": {noise: f.rms["response"] / spread(experiment) for noise, f in fits.items()},
        "whiteness": {noise: f.whiteness["response"].p for noise, f in fits.items()},
        "lag1": {noise: f.whiteness["response"].lag1 for noise, f in fits.items()},
        "doubling_shift": {noise: f.doubling_shift for noise, f in fits.items()},
    }
