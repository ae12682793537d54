"""The Silverbox, an electronic Duffing oscillator, under a multisine: the same fit with every noise model.

The recording is the Schroeder-phased multisine of the Silverbox benchmark (T. Wigren, J. Schoukens, 2013;
nonlinearbenchmark.org): odd lines up to 200 Hz, nine steady periods of 1024 samples. Model, in volts and with w0 fixed:
ÿ/w0² + c ẏ/w0 + k1 y + k2 y² + k3 y³ = g u + u0. An offset of the output is omitted, because k1, k2 and u0 absorb it.
The estimates are checked on a finer grid, from another start, and with a second steady part of the recording.
"""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.timing import timed

FILE = "silverbox/Schroeder80mV.csv"
ADDRESS = "nonlinearbenchmark.org (Silverbox), copy in github.com/biaslab/nsi-silverbox (commit 728f07e4)"
SHA256 = "b22cbcba9c59d9b4b1b379967b669dc32959e515b24784da3254505f8563e36c"
SAMPLING_RATE = 1e7 / 2**14
PERIOD, PERIODS = 1024, 9
FREQUENCY = SAMPLING_RATE / PERIOD
# The second one is steady from row 119,548 on; this row has the phase of the first one's beginning.
FIRST_ROWS = (10_824, 119_608)
W0 = 2 * np.pi * 65.0
TRUE = {"c": 0.104, "k1": 1.105, "k2": -0.037, "k3": 4.37, "g": 1.115, "u0": -0.006}
SYNTHETIC_LINES, SYNTHETIC_AMPLITUDE, SYNTHETIC_OFFSET = range(1, 336, 2), 3e-3, 6.1e-3
SYNTHETIC_NOISE = {"drive": 3e-5, "response": 3e-4}

DRIVE_LINES = 335
SCHEME = "central4"
PRIORS: dict[str, Any] = {
    "c": bp.LogNormal(0.05, 1.0),
    "k1": bp.LogNormal(0.8, 0.7),
    "k2": bp.Normal(0.0, 5.0),
    "k3": bp.LogNormal(1.0, 1.5),
    "g": bp.LogNormal(0.8, 0.7),
    "u0": bp.Normal(0.0, 0.05),
}
NOISES = ("independent", "measured", "circulant")
SAMPLES, QUICK_SAMPLES = 8192, 4096
RULE = (
    "the response keeps all harmonics up to the last one that exceeds the cycle-to-cycle scatter (F-test, "
    "false-alarm rate 1 % over all harmonics); the drive keeps its lines, up to 200 Hz"
)
OTHER_START = {"c": 0.3, "k1": 1.6, "k2": 1.0, "k3": 20.0, "g": 2.0, "u0": 0.02}
# As a fraction of a period: below it the Matérn spectrum is flat up to the highest harmonic.
SHORT = 1e-4
WRONG_PHASE = 0.5
HUM, OVERSTATED = 50.0, 0.7
ERROR_OF_MEAN, GRID, TRUTH = "#999999", "#009E73", "#CC79A7"
MAP, LAPLACE = bp.plot.COLOURS["map"], bp.plot.COLOURS["laplace"]
MOST_TERMS = 3
# Of the spectrum's ordinate [V].
LOWEST = 1e-11


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    samples = QUICK_SAMPLES if options.quick else SAMPLES
    with watch.part("read", "reading the recording and folding it into its mean period"):
        (recording, second), data = read_steady_parts(options.data, options.seed)
        experiment, in_drive = fold(recording, samples), fold(recording, samples, DRIVE_LINES)
    kind = "SYNTHETIC" if data["synthetic"] else "measured"
    print(
        f"  {kind} recording {data['path']}: {experiment.cycles} steady cycles at {experiment.frequency:.6f} Hz, "
        f"periodicity {experiment.periodicity:.5f}\n  kept: {experiment.harmonics['drive']} harmonics of the drive, "
        f"{experiment.harmonics['response']} of the response, {experiment.independent['response']} independent values"
    )
    if data["synthetic"]:
        print(f"  the measured file was not found; it is at {ADDRESS}, sha256 {SHA256}")
    with watch.part("compile", "compiling the model, or loading it from the cache"):
        solve(_medians(), experiment)
    every, within = {}, {}
    for noise in NOISES:
        with watch.part(f"map {noise}", f"finding the MAP point with the noise model {noise!r}"):
            every[noise], within[noise] = (bp.map_estimate(problem(e, noise)) for e in (experiment, in_drive))
    fit = every["independent"]
    with watch.part("checks", "checking the grid, the starts and the second steady part"):
        grid = discretisation(recording, experiment, fit.theta)
        from_rest, seconds = _from_rest(experiment, fit.theta)
        other = bp.map_estimate(problem(experiment), start=OTHER_START)
        checks = {
            "from_rest": from_rest,
            "other_start": {"start": OTHER_START, "status": other.status, "shift": _shift(fit, other)},
            "repetition": _repetition(experiment, fit, second),
            "beyond_drive": _beyond_drive(experiment, fit),
        }
    with watch.part("missing terms", "looking for the terms that the model lacks"):
        checks["missing_terms"] = missing_terms(recording)
    with watch.part("figures", "drawing"):
        choices = {f"{e.harmonics['response']} harmonics": f for e, f in ((experiment, every), (in_drive, within))}
        truth = TRUE if data["synthetic"] else None
        figures = {"spectrum": _spectrum(experiment, fit, grid.difference), "estimates": _estimates(choices, truth)}
        paths = common.save_figures(options.out, figures)

    results = {"data": data, "seed": options.seed, "quick": options.quick}
    results |= _collect(experiment, every, grid) | checks
    results["response_harmonics"] = {
        "rule": RULE,
        "choices": [_by_noise(experiment, every), _by_noise(in_drive, within)],
    }
    results |= {"seconds": watch.total() | {"from_rest": seconds}, "versions": common.versions()}
    print(f"\nSilverbox, {kind} data, w0 = 2 pi·65 rad/s: estimate ± Laplace sd (robust sd) by noise model")
    print("\n".join([*_fits_lines(every), *_check_lines(results)]))
    kept, fraction = in_drive.harmonics["response"], within["independent"].rms["response"] / spread(in_drive)
    print(f"\nThe same with {kept} harmonics of the response, up to the drive's last line: residual {fraction:.3%}")
    print("\n".join([*_fits_lines(within), ""]))
    path = common.write_results(options.out, results)
    print(f"figures{' (synthetic data)' if data['synthetic'] else ''}: {', '.join(map(str, paths))}\nresults: {path}")


def read_steady_parts(given: Path | None, seed: int) -> tuple[tuple[bp.Recording, bp.Recording], dict[str, Any]]:
    """Return both measured steady parts, or generated ones of the same kind, and their description."""
    found = common.find_data(given, FILE)
    if found is None:
        return generate(seed), common.described(found)
    whole = bp.Recording.from_csv(
        found[0], sampling_rate=SAMPLING_RATE, inputs={"drive": "V1"}, outputs={"response": "V2"},
        name="Silverbox, Schroeder multisine",
    )  # fmt: skip
    first, second = (
        whole.between((row - 0.5) / SAMPLING_RATE, (row + PERIODS * PERIOD - 0.5) / SAMPLING_RATE) for row in FIRST_ROWS
    )
    rows = {"first_rows": FIRST_ROWS, "rows_each": PERIODS * PERIOD}
    return (first, second), common.described(found) | rows


def generate(seed: int) -> tuple[bp.Recording, bp.Recording]:
    """Return synthetic steady parts of the same kind: one period, integrated in time, repeated, with noise."""
    period = dict(zip(("drive", "response"), steady_period(), strict=True))
    generator = np.random.default_rng(seed)

    def part() -> bp.Recording:
        noisy = {
            name: np.tile(values, PERIODS) + SYNTHETIC_NOISE[name] * generator.standard_normal(PERIODS * PERIOD)
            for name, values in period.items()
        }
        time, drive = np.arange(PERIODS * PERIOD) / SAMPLING_RATE, {"drive": noisy.pop("drive")}
        return bp.Recording(time, noisy, drive, name="synthetic Silverbox, Schroeder multisine", synthetic=True)

    return part(), part()


def steady_period() -> tuple[np.ndarray, np.ndarray]:
    """Return a period of the drive and of the response; after one period the transient is below 1e-14.

    Schroeder's phases with this sign let the frequency fall with time, as in the measured drive.
    """
    lines = np.array(SYNTHETIC_LINES)
    phase = np.pi * np.arange(lines.size) * (np.arange(lines.size) + 1) / lines.size
    tau = np.arange(PERIOD)[:, None] / PERIOD
    drive = SYNTHETIC_OFFSET + SYNTHETIC_AMPLITUDE * np.cos(2 * np.pi * tau * lines + phase).sum(axis=1)
    run = bp.simulate(
        bp.models.silverbox, {"w0": W0, **TRUE}, {"drive": drive}, frequency=FREQUENCY, duration=2.0 / FREQUENCY,
        sampling_rate=SAMPLING_RATE,
    )  # fmt: skip
    return drive, run.outputs["response"][PERIOD : 2 * PERIOD]


def fold(recording: bp.Recording, samples: int, response: int | None = None) -> bp.Experiment:
    """Return the mean period from the recording's first sample on.

    Generator and converter share a clock, so that the frequency is known exactly.
    """
    harmonics = {"drive": DRIVE_LINES} | ({} if response is None else {"response": response})
    return recording.fold(samples, frequency=FREQUENCY, harmonics=harmonics, origin=float(recording.time[0]))


def problem(experiment: bp.Experiment, noise: str = "independent", **changes: Any) -> bp.Problem:
    """Return the problem with a noise model, or other arguments changed; the noise of the drive is integrated out."""
    settings: dict[str, Any] = {"priors": PRIORS, "fixed": {"w0": W0}, "scheme": SCHEME, "noise": noise}
    return bp.Problem(bp.models.silverbox, [experiment], **settings | changes)


def missing_terms(recording: bp.Recording) -> list[dict[str, Any]]:
    """Return the terms that the model lacks, one after the other, and what they leave unexplained.

    The drive is taken as exact, for its noise hardly matters.
    """
    stated = problem(fold(recording, QUICK_SAMPLES), input_noise="exact")
    found = bp.missing_terms(stated, bp.map_estimate(stated, progress=False), max_terms=MOST_TERMS)
    return [
        {
            "term": step.term, "place": step.place, "alternatives": list(step.alternatives), "verdict": step.verdict,
            "unexplained": step.unexplained["response"], "p_white": step.p_white["response"],
        }
        for step in (found.before, *found.steps)
    ]  # fmt: skip


def _medians() -> dict[str, float]:
    return {name: float(prior.quantile(0.5)) for name, prior in PRIORS.items()}


def solve(theta: Mapping[str, float], experiment: bp.Experiment) -> bp.PeriodicSolution:
    """Return the periodic response, found from rest at full amplitude."""
    return bp.solve_periodic(
        bp.models.silverbox, {"w0": W0, **theta}, experiment.inputs, frequency=experiment.frequency,
        samples=experiment.samples, scheme=SCHEME,
    )  # fmt: skip


def spread(experiment: bp.Experiment) -> float:
    """Return the standard deviation of the measured mean response along the period [V]."""
    return float(experiment.outputs["response"].std())


class Discretisation(NamedTuple):
    """Error of the response on the grid, against one with twice the points."""

    difference: np.ndarray  # (points,)
    fraction: float  # Its root mean square over the measured standard deviation
    allowed: float  # A tenth of the standard error of the mean period, over the same


def discretisation(recording: bp.Recording, experiment: bp.Experiment, theta: Mapping[str, float]) -> Discretisation:
    """Return the error of the response at the estimate, against the response with twice the points."""
    finer = fold(recording, 2 * experiment.samples)
    difference = solve(theta, experiment).outputs["response"] - solve(theta, finer).outputs["response"][::2]
    error_of_mean = experiment.scatter["response"] / np.sqrt(experiment.cycles)
    return Discretisation(
        difference,
        float(np.sqrt(np.mean(difference**2))) / spread(experiment),
        0.1 * float(error_of_mean) / spread(experiment),
    )


def _from_rest(experiment: bp.Experiment, theta: Mapping[str, float]) -> tuple[list[dict[str, Any]], list[float]]:
    """Return how the solver finds the response from rest at full amplitude, and the seconds.

    With a fifth of the damping Newton's method stalls, and the drive is increased in steps.
    """
    points = {
        "prior medians": _medians(),
        "estimate": theta,
        "estimate, a fifth of its damping": {**theta, "c": 0.2 * theta["c"]},
    }
    found, seconds = [], []
    for at, values in points.items():
        s, taken = timed(partial(solve, values, experiment))
        seconds.append(taken)
        found.append({"at": at, "status": s.status, "found_by": s.found_by, "iterations": s.iterations})
    return found, seconds


def _repetition(experiment: bp.Experiment, fit: bp.MapEstimate, recording: bp.Recording) -> dict[str, Any]:
    """Return the part of the residual that a second recording reproduces, and the shift of the estimates.

    The reproducible part is model error; the rest is the noise of the mean period, whatever its spectrum.
    """
    again = fold(recording, experiment.samples, experiment.harmonics["response"])
    other = bp.map_estimate(problem(again))
    one, two = fit.residuals[experiment.name]["response"], other.residuals[again.name]["response"]
    return {
        "repeats": float(np.sqrt(max(np.mean(one * two), 0.0))),
        "does_not": float(np.sqrt(0.5 * np.mean((one - two) ** 2))),
        "map": other.theta,
        "shift": _shift(fit, other),
    }


def _beyond_drive(experiment: bp.Experiment, fit: bp.MapEstimate) -> dict[str, float]:
    """Return the share of the residual in harmonics above the drive's last line, and data against model there."""
    residual = np.fft.rfft(fit.residuals[experiment.name]["response"])
    measured = np.fft.rfft(experiment.outputs["response"])
    power = np.abs(residual[1:]) ** 2
    strongest = DRIVE_LINES + 1 + int(np.argmax(np.abs(measured[DRIVE_LINES + 1 :])))
    ratio = measured[strongest] / (measured[strongest] - residual[strongest])
    return {
        "share_of_residual_power": float(power[DRIVE_LINES:].sum() / power.sum()),
        "strongest": strongest * experiment.frequency,
        "measured_over_model": float(np.abs(ratio)),
        "phase_of_measured_over_model": float(np.angle(ratio)),
    }


def _shift(fit: bp.MapEstimate, other: bp.MapEstimate) -> dict[str, float]:
    """Return the difference of two estimates in standard deviations of the first."""
    return {name: (other.theta[name] - fit.theta[name]) / fit.sd[name] for name in fit.theta}


def _collect(experiment: bp.Experiment, fits: dict[str, bp.MapEstimate], grid: Discretisation) -> dict[str, Any]:
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
    } | _by_noise(experiment, fits)


def _by_noise(experiment: bp.Experiment, fits: dict[str, bp.MapEstimate]) -> dict[str, Any]:
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


def _fits_lines(fits: dict[str, bp.MapEstimate]) -> list[str]:
    names = list(fits["independent"].theta)
    columns = {"unit": [bp.models.silverbox.units[name] for name in names]} | {
        noise: [f"{f.theta[p]:.6g} ± {f.sd[p]:.2g} ({f.robust_sd[p]:.2g})" for p in names] for noise, f in fits.items()
    }
    tests = {noise: f.whiteness["response"] for noise, f in fits.items()}
    lines = [
        pd.DataFrame(columns, index=names).to_string(),
        "whitened residual: " + ", ".join(f"{n} p = {t.p:.2g} (lag 1 {t.lag1:.2f})" for n, t in tests.items()),
    ]
    if wrong := [noise for noise, test in tests.items() if test.p < 0.01]:
        length = fits["circulant"].noise["lengthscale[response]"]
        lines.append(
            f"It is not white with {', '.join(wrong)}, whose standard deviations are therefore invalid. The circulant "
            f"model's correlation\nlength is {length:.2g} of a period"
            + (": white noise, since its spectrum cannot rise with the frequency." if length < SHORT else ".")
        )
    return lines


def _check_lines(results: dict[str, Any]) -> list[str]:
    split, repeat, beyond = results["noise_split"], results["repetition"], results["beyond_drive"]
    error, allowed = results["discretisation_error_fraction"], results["discretisation_allowed"]
    other, doubled = results["other_start"], results["doubling_shift"].values()
    residual = {
        "rms": results["rms"], "noise by scatter": split["measurement"], "model error by scatter": split["model"],
        "not reproduced by a second part": repeat["does_not"], "reproduced": repeat["repeats"],
    }  # fmt: skip
    lines = [
        common.shown(f"residual [V], {results['residual_fraction']:.3%} of the response's sd", {"": residual}),
        common.shown("the second part's estimates less the first's [Laplace sd]", {"": repeat["shift"]}),
        f"discretisation error {error:.4%} of the response's sd, {'below' if error < allowed else 'ABOVE'} the "
        f"{allowed:.4%} allowed (a tenth of the mean period's standard error);\ntwice the points would shift no "
        f"estimate by more than {max(abs(s) for shifts in doubled for s in shifts.values()):.2g} standard deviations",
        common.shown(f"above the drive's last line ({FREQUENCY * DRIVE_LINES:.0f} Hz)", {"": beyond}),
        f"from rest at full amplitude ({results['scheme']}, {results['samples']} points):",
        pd.DataFrame(results["from_rest"]).assign(seconds=results["seconds"]["from_rest"]).to_string(index=False),
        f"from another start ({other['status']}) the estimates differ by at most "
        f"{max(map(abs, other['shift'].values())):.1g} standard deviations",
    ]
    lines.append("unexplained part of the response's variance with missing terms, in the response or the equation:")
    lines += [
        f"  {'+ ' + step['term'] + ' in ' + step['place'] if step['term'] else 'the model as it is'}: "
        f"{step['unexplained']:.2e}, {step['verdict']}"
        for step in results["missing_terms"]
    ]
    if repeat["does_not"] < OVERSTATED * split["measurement"]:
        lines.append(
            "The scatter overstates the noise of the mean, as mains hum does if these periods nearly average it out: "
            f"at {HUM:.0f} Hz they hold {HUM * results['cycles'] / FREQUENCY:.2f} cycles."
        )
    if abs(beyond["phase_of_measured_over_model"]) > WRONG_PHASE:
        lines.append(
            "The circuit's own third harmonics have the right size and the wrong phase, as filters of the measuring "
            "chain would make\nit: if alike for drive and response they cancel on the lines of the drive only."
        )
    return lines


def _spectrum(experiment: bp.Experiment, fit: bp.MapEstimate, difference: np.ndarray) -> Figure:
    """Draw the amplitudes of response, residual, standard error and grid error, odd and even harmonics apart."""
    kept = experiment.harmonics["response"]
    frequency = experiment.frequency * np.arange(kept + 1)
    curves: dict[str, tuple[np.ndarray, str, dict[str, Any]]] = {
        "response": (_amplitudes(experiment.outputs["response"], kept), "measured", {"marker": ".", "ls": "none"}),
        "residual": (_amplitudes(fit.residuals[experiment.name]["response"], kept), "map", {"marker": ".", "lw": 0.6}),
        "standard error of the mean period": (
            np.sqrt(experiment.amplitude_variance["response"]), ERROR_OF_MEAN, {"lw": 1.6},
        ),
        "discretisation error": (_amplitudes(difference, kept), GRID, {"lw": 1.0, "ls": "--"}),
    }  # fmt: skip
    figure = plt.figure(figsize=(9.0, 7.0), layout="constrained")
    titles = "odd harmonics, those of the drive", "even harmonics"
    for axes, first, what in zip(figure.subplots(2, 1, sharex=True, sharey=True), (1, 2), titles, strict=True):
        for label, (values, colour, style) in curves.items():
            colour = bp.plot.COLOURS.get(colour, colour)
            axes.semilogy(frequency[first::2], values[first::2], color=colour, ms=4, label=label, **style)
        axes.axvline(experiment.frequency * DRIVE_LINES, color="black", lw=0.8, ls=":", label="last line of the drive")
        axes.set_ylabel("amplitude [V]")
        axes.set_title(what)
    axes.set_ylim(bottom=LOWEST)
    axes.set_xlabel("frequency [Hz]")
    figure.axes[0].legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.12))
    figure.suptitle(f"Silverbox{', synthetic data' if experiment.synthetic else ''}: response and residual")
    return figure


def _estimates(choices: Mapping[str, Mapping[str, bp.MapEstimate]], truth: Mapping[str, float] | None) -> Figure:
    """Draw the estimates with their standard deviations, by noise model and choice of harmonics."""
    first = next(iter(choices.values()))
    noises, names = list(first), list(next(iter(first.values())).theta)
    figure = plt.figure(figsize=(10.0, 6.0), layout="constrained")
    for axes, name in zip(figure.subplots(2, 3).flat, names, strict=True):
        for number, (label, fits) in enumerate(choices.items()):
            at = np.arange(len(noises)) + 0.3 * (number - 0.5 * (len(choices) - 1))
            values, sds, robust = ([getattr(f, k)[name] for f in fits.values()] for k in ("theta", "sd", "robust_sd"))
            face = MAP if number == 0 else "white"
            axes.errorbar(at, values, sds, fmt="none", ecolor=LAPLACE, elinewidth=4.0, label="Laplace sd")
            axes.errorbar(at, values, robust, fmt="none", ecolor="black", elinewidth=1, capsize=4, label="robust sd")
            axes.plot(at, values, "o", color=MAP, mfc=face, ms=6, zorder=5, label=f"MAP, {label}")
        if truth is not None:
            axes.axhline(truth[name], color=TRUTH, lw=1.2, ls="--", label="true value")
        axes.set_xticks(range(len(noises)), noises)
        axes.tick_params(axis="x", labelsize=9)
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.set_xlim(-0.5, len(noises) - 0.5)
        axes.set_ylabel(common.axis_label(name, bp.models.silverbox.units[name]))
    common.shared_legend(figure, 5)
    figure.suptitle(f"Silverbox{'' if truth is None else ', synthetic data'}: estimates by noise model")
    return figure


def _amplitudes(values: np.ndarray, kept: int) -> np.ndarray:
    return 2.0 * np.abs(np.fft.rfft(values)[: kept + 1]) / values.size
