"""The Silverbox, an electronic Duffing oscillator, under a multisine: the same fit with every noise model.

The recording is the Schroeder-phased multisine of the Silverbox benchmark (T. Wigren, J. Schoukens, 2013;
nonlinearbenchmark.org): odd lines up to 200 Hz, nine steady periods of 1024 samples. Model, in volts and with w0 fixed:
ÿ/w0² + c ẏ/w0 + k1 y + k2 y² + k3 y³ = g u + u0. An offset of the output is omitted, because k1, k2 and u0 absorb it.
"""

import argparse
from typing import Any

import pandas as pd

import bayesperiodic as bp
from studies import common
from studies.silverbox import checks as silverbox_checks
from studies.silverbox import figures as silverbox_figures
from studies.silverbox.data import (
    ADDRESS,
    DRIVE_LINES,
    FREQUENCY,
    SCHEME,
    SHA256,
    TRUE,
    W0,
    fold,
    medians,
    problem,
    read_steady_parts,
    solve,
    spread,
)

# As a fraction of a period: below it the Matérn spectrum is flat up to the highest harmonic.
SHORT = 1e-4
WRONG_PHASE = 0.5
HUM, OVERSTATED = 50.0, 0.7


def introduction(data: dict[str, Any], experiment: bp.Experiment) -> str:
    """Return the description of the data to print."""
    what = "SYNTHETIC recording" if data["synthetic"] else "measured recording"
    lines = [
        f"  {what} {data['path']}: {experiment.cycles} steady cycles at {experiment.frequency:.6f} Hz, "
        f"periodicity {experiment.periodicity:.5f}",
        f"  kept: {experiment.harmonics['drive']} harmonics of the drive, {experiment.harmonics['response']} of the "
        f"response, {experiment.independent['response']} independent values",
    ]
    if data["synthetic"]:
        lines.append(f"  the measured file was not found; it is at {ADDRESS}, sha256 {SHA256}")
    return "\n".join(lines)


def tables(every: dict[str, bp.MapEstimate], within: dict[str, bp.MapEstimate], results: dict[str, Any]) -> str:
    """Return the tables to print, with their interpretation."""
    kind = "SYNTHETIC data" if results["data"]["synthetic"] else "measured data"
    first, second = results["response_harmonics"]["choices"]
    return "\n".join(
        [
            f"Silverbox, {kind}, w0 = 2π·65 rad/s: estimate ± Laplace sd (sandwich sd) by noise model",
            _side_by_side(every),
            *_residual_lines(results),
            *_whiteness_lines(every),
            *_grid_lines(results),
            *_beyond_lines(results),
            "",
            f"The same with {second['harmonics']} instead of {first['harmonics']} harmonics of the response, those up "
            f"to the drive's last line: residual {second['residual_fractions']['independent']:.3%}",
            _side_by_side(within),
            *_whiteness_lines(within),
            "",
            *_start_lines(results),
        ]
    )


def _side_by_side(fits: dict[str, bp.MapEstimate]) -> str:
    names = list(fits["independent"].theta)
    columns = {
        noise: [f"{f.theta[p]:.6g} ± {f.sd[p]:.2g} ({f.robust_sd[p]:.2g})" for p in names] for noise, f in fits.items()
    }
    units = [bp.models.silverbox.units[name] for name in names]
    return pd.DataFrame({"unit": units} | columns, index=names).to_string()


def _residual_lines(results: dict[str, Any]) -> list[str]:
    split, repeat = results["noise_split"], results["repetition"]
    shifts = ", ".join(f"{name} {shift:+.1f}" for name, shift in repeat["shift"].items())
    lines = [
        f"residual {1e3 * results['rms']:.3f} mV rms, {results['residual_fraction']:.3%} of the response's standard "
        f"deviation; by the cycles' scatter: {1e3 * split['measurement']:.3f} mV\nmeasurement noise, "
        f"{1e3 * split['model']:.3f} mV model error; by a second steady part: {1e3 * repeat['does_not']:.3f} mV do not "
        f"come again, {1e3 * repeat['repeats']:.3f} mV do",
        f"the second part's estimates less the first's, in the first's Laplace sds: {shifts}",
    ]
    if repeat["does_not"] < OVERSTATED * split["measurement"]:
        lines.append(
            "The scatter overstates the noise of the mean, as mains hum does that these periods nearly average out: at "
            f"{HUM:.0f} Hz they hold {HUM * results['cycles'] / FREQUENCY:.2f} cycles."
        )
    return lines


def _whiteness_lines(fits: dict[str, bp.MapEstimate]) -> list[str]:
    tests = {noise: f.whiteness["response"] for noise, f in fits.items()}
    length = fits["circulant"].noise["lengthscale[response]"]
    lines = ["whitened residual: " + ", ".join(f"{n} p = {t.p:.2g} (lag 1 {t.lag1:.2f})" for n, t in tests.items())]
    wrong = [noise for noise, test in tests.items() if test.p < 0.01]
    if wrong:
        lines.append(
            f"It is not white with {', '.join(wrong)}: those standard deviations rest on an assumption that does not "
            f"hold.\nThe circulant model's correlation length is {length:.2g} of a period"
            + (": white noise, since its spectrum cannot rise with the frequency." if length < SHORT else ".")
        )
    return lines


def _grid_lines(results: dict[str, Any]) -> list[str]:
    error, allowed = results["discretisation_error_fraction"], results["discretisation_allowed"]
    shift = max(abs(s) for shifts in results["doubling_shift"].values() for s in shifts.values())
    verdict = "below" if error < allowed else "ABOVE"
    return [
        f"discretisation error ({results['scheme']}, {results['samples']} points) {error:.4%} of the response's "
        f"standard deviation, {verdict} the {allowed:.4%} allowed (a tenth of the\nmean period's standard error); "
        f"twice the points would shift no estimate by more than {shift:.2g} standard deviations"
    ]


def _beyond_lines(results: dict[str, Any]) -> list[str]:
    beyond = results["beyond_drive"]
    lines = [
        f"above the drive's last line ({FREQUENCY * DRIVE_LINES:.0f} Hz) lie {beyond['share_of_residual_power']:.0%} "
        f"of the residual's power; at {beyond['strongest']:.0f} Hz measured over model is "
        f"{beyond['measured_over_model']:.3f}, phase {beyond['phase_of_measured_over_model']:.2f} rad"
    ]
    if abs(beyond["phase_of_measured_over_model"]) > WRONG_PHASE:
        lines.append(
            "There the circuit's own third harmonics have the right size and the wrong phase, as filters of the "
            "measuring chain would make it:\nalike for drive and response they cancel on the lines of the drive, but "
            "not on those that the circuit makes."
        )
    return lines


def _start_lines(results: dict[str, Any]) -> list[str]:
    other = results["other_start"]
    return [
        f"Found from rest at full amplitude ({results['scheme']}, {results['samples']} points):",
        pd.DataFrame(results["from_rest"])
        .assign(seconds=results["seconds"]["from_rest"])
        .to_string(index=False, float_format="{:.3f}".format),
        f"From another start ({other['status']}) the estimates differ by at most "
        f"{max(map(abs, other['shift'].values())):.1g} standard deviations.",
    ]


NOISES = ("independent", "measured", "circulant")
SAMPLES, QUICK_SAMPLES = 8192, 4096
RULE = (
    "the response keeps all harmonics up to the last one that exceeds the cycle-to-cycle scatter (F-test, "
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
    """Return the results of the noise models."""
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
