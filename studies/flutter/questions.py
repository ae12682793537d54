"""Analysis of the flutter fits: gain from unstable cycles, predictions, misfit, coverage in synthetic campaigns."""

import argparse
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri
from scipy.stats import binom

import bayesperiodic as bp
from studies import common
from studies.flutter import rig

NEAR = 0.25
FEWEST = 3
FREE_SCALES = ("gain_heave", "gain_pitch")
CHANNELS = ("heave", "pitch")
CURVE = 240
LEVEL = 0.9


def closed(values: np.ndarray, points: int = CURVE) -> np.ndarray:
    """Return a closed curve through the samples of a cycle, by its Fourier series."""
    curve = np.fft.irfft(np.fft.rfft(values), points) * points / values.size
    return np.append(curve, curve[0])


def half_range(values: np.ndarray, points: int = CURVE) -> float:
    """Return half the range of a periodic signal, between its samples too."""
    return 0.5 * float(np.ptp(closed(values, points)))


def sizes(outputs: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return half the range of each channel over the cycle, in sensor units."""
    return {channel: half_range(outputs[channel]) for channel in CHANNELS}


def _errors_of(orbit: bp.PeriodicSolution, e: bp.Experiment) -> dict[str, Any]:
    measured = sizes(e.outputs)
    return {
        "amplitude_error": {c: v / measured[c] - 1.0 for c, v in sizes(orbit.outputs).items()},
        "frequency_error": orbit.frequency / e.frequency - 1.0,
    }


def errors(fitted: rig.Fitted, experiments: rig.Experiments) -> dict[str, Any]:
    """Return the errors of the fitted cycles, and whether their stability is correct."""
    found = {}
    for name, e in experiments.items():
        orbit = fitted.fit.solutions[name]
        as_measured = orbit.stable is (kind_of(name) == "stable")
        found[name] = _errors_of(orbit, e) | {"stable": orbit.stable, "as_measured": as_measured}
    return found


def authors_errors(experiments: rig.Experiments, speeds: rig.Speeds) -> dict[str, Any]:
    """Return the same for the authors' values and sensor units; None and the reason if there is no cycle."""
    along = rig.cycles(rig.RIG | rig.AUTHORS | rig.SENSORS)
    found: dict[str, Any] = {}
    for name, e in experiments.items():
        try:
            found[name] = _errors_of(along.at(name, speeds[name]), e)
        except ValueError as error:
            found[name] = {"amplitude_error": None, "frequency_error": None, "why": str(error)}
    return found


def mean_size(found: Mapping[str, Any]) -> float | None:
    """Return the root mean square of all amplitude errors, None where a cycle is missing altogether."""
    each = [v for one in found.values() if one["amplitude_error"] for v in one["amplitude_error"].values()]
    return float(np.sqrt(np.mean(np.square(each)))) if each else None


def kind_of(name: str) -> str:
    """Return "stable" or "unstable", from a record's name."""
    return "unstable" if name.startswith("unstable") else "stable"


def contraction(fits: Mapping[str, rig.Fitted]) -> dict[str, dict[str, dict[str, float]]]:
    """Return estimate, Laplace and robust sd, and sd over the prior's sd, by parameter and data."""
    generator = np.random.default_rng(0)
    prior = {name: float(np.std(one.sample(20_000, generator))) for name, one in rig.PRIORS.items()}
    gain = rig.PRIORS["gain_pitch"].sample(20_000, generator)
    draws = {n: rig.PRIORS[n].sample(20_000, generator) for n in ("k_alpha2", "k_alpha3")}
    prior["k_alpha2 at gain 1"] = float(np.std(draws["k_alpha2"] / gain))
    prior["k_alpha3 at gain 1"] = float(np.std(draws["k_alpha3"] / gain**2))
    table: dict[str, dict[str, dict[str, float]]] = {}
    for kind, fitted in fits.items():
        fit = fitted.fit
        # The nonlinear stiffnesses in units of the pitch sensor, independent of its scale.
        springs = fit.derive({name.replace(" ", "_"): text for name, text in rig.SPRINGS.items()})[["value", "sd"]]
        rows = {name: (value, fit.sd[name]) for name, value in fit.theta.items()}
        rows |= dict(zip(rig.SPRINGS, springs.itertuples(index=False, name=None), strict=True))
        for name, (value, sd) in rows.items():
            row = {"estimate": value, "sd": sd, "over_prior": sd / prior[name]}
            if name in fit.robust_sd:
                row["robust_sd"] = fit.robust_sd[name]
            table.setdefault(name, {})[kind] = row
    return table


def model_error_of_springs(table: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, Any]]:
    """Return how far the estimates of each spring from different cycles are apart, from the result of `contraction`.

    Without model error they would agree within their standard deviations. The interval contains the 90 % intervals of
    all of them, so that it covers the systematic difference too.
    """
    found: dict[str, dict[str, Any]] = {}
    for name in rig.SPRINGS:
        value, sd = (np.array([row[key] for row in table[name].values()]) for key in ("estimate", "sd"))
        margin = float(ndtri(0.5 + LEVEL / 2)) * sd
        apart = np.abs(value[:, None] - value) / np.hypot(sd[:, None], sd)
        found[name] = {
            "relative_sd": dict(zip(table[name], (sd / value).tolist(), strict=True)),
            "largest_over_smallest": float(value.max() / value.min()),
            "largest_difference_in_sds": float(apart.max()),
            "interval_with_model_error": [float(np.min(value - margin)), float(np.max(value + margin))],
        }
    return found


def groups(speeds: rig.Speeds) -> list[list[str]]:
    """Return the names of the records by wind speed, those within a quarter of a metre per second together."""
    found: list[list[str]] = []
    for name in sorted(speeds, key=lambda name: speeds[name]):
        if found and speeds[name] - speeds[found[-1][0]] < NEAR:
            found[-1].append(name)
        else:
            found.append([name])
    return found


def leave_out(
    experiments: rig.Experiments, speeds: rig.Speeds, theta: dict[str, float], left: list[str], draws: int
) -> tuple[rig.Fitted, dict[str, Any]]:
    """Return the fit without some cycles, started at the estimate θ from all, and the errors of its predictions.

    Errors are relative, in sds of draws of the Laplace approximation, and in sds with the model's error. There are no
    draws where the MAP point itself has no such cycle.
    """
    kept = {name: e for name, e in experiments.items() if name not in left}
    fitted = rig.estimate(kept, speeds, start=rig.START | theta)
    fit, along = fitted.fit, rig.cycles(rig.RIG | fitted.fit.theta)
    every = laplace_draws(fit, draws)
    model = mean_size({e.name: _errors_of(fit.solutions[e.name], e) for e in fitted.problem.experiments}) or 0.0
    found: dict[str, Any] = {}
    for name in left:
        try:
            orbit = along.at(name, speeds[name])
        except ValueError as error:
            found[name] = {"cycle_at_map": False, "why": str(error)}
            continue
        drawn, best = drawn_sizes(orbit, fit.theta, every), sizes(orbit.outputs)
        there = np.isfinite(drawn["heave"])
        found[name] = {"draws_with_a_cycle": int(there.sum()), "draws": draws, "cycle_at_map": True}
        for channel in CHANNELS:
            size = sizes(experiments[name].outputs)[channel]
            off = best[channel] - size
            found[name][channel] = {"error": off / size}
            if there.sum() >= FEWEST:
                sd = float(np.std(drawn[channel][there]))
                with_model = float(np.hypot(sd, model * size))
                found[name][channel] |= {"posterior_sds": off / sd, "sds_with_model_error": off / with_model}
    return fitted, found


def laplace_draws(fit: bp.MapEstimate, draws: int) -> dict[str, np.ndarray]:
    """Return draws (draws,) of each parameter from the Laplace approximation, in logarithms of positive parameters.

    There the ridges of products, such as a stiffness and a sensor's scale, are straight.
    """
    values = np.array(list(fit.theta.values()))
    positive = np.array([name in rig.SPREADS for name in fit.theta])
    slopes = np.where(positive, values, 1.0)
    covariance = fit.covariance.to_numpy() / np.outer(slopes, slopes)
    changes = np.random.default_rng(0).multivariate_normal(np.zeros(values.size), covariance, size=draws)
    rows = np.where(positive, values * np.exp(np.where(positive, changes, 0.0)), values + changes)
    return dict(zip(fit.theta, rows.T, strict=True))


def drawn_sizes(
    orbit: bp.PeriodicSolution, theta: Mapping[str, float], draws: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the amplitudes (draws,) of the cycle that continues one at θ, by channel; NaN where there is none."""
    like = bp.Experiment(
        "cycle", orbit.frequency, orbit.outputs, samples=orbit.samples, frequency_se=1e-3, guess=orbit.states
    )
    stated = rig.problem([like], {"cycle": orbit.parameters["U"]}, frequency_error=0.0, noise="independent")
    rows = np.stack([draws[name] for name in stated.names], axis=-1)
    outputs, there = stated.anchored(theta, {"cycle": orbit.states}).outputs(rows)
    curves = {channel: outputs["cycle"][channel] for channel in CHANNELS}
    found = [sizes({c: curves[c][i] for c in CHANNELS}) if there[i] else None for i in range(there.size)]
    return {c: np.array([np.nan if one is None else one[c] for one in found]) for c in CHANNELS}


# A campaign has the eight kinds of cycles of the true model, with its own noise of the measured records' size. Its fit
# differs in the noise: with a true model the scatter of the cycles estimates the noise of each record. The sensors'
# scales are fixed, since they and the stiffnesses are not separately identifiable.
FILE = "campaigns.jsonl"
FIRST_SEED = 100_000
STIFFNESSES = ("k_alpha2", "k_alpha3")
ALARM = 0.01


def campaigns(options: argparse.Namespace) -> None:
    """Compute the campaigns missing from the file in the folder, and report on all of them."""
    watch = common.Stopwatch()
    print("All data are SYNTHETIC: cycles of a stated truth, with noise.")
    folder = options.out / "campaigns"
    with watch.part("campaigns", f"{options.replicates} campaigns"):
        tasks = [(FIRST_SEED * options.seed + number,) for number in range(options.replicates)]
        lines = common.resumed(folder / FILE, tasks, campaign, lambda line: (line["seed"],), source())
    found = account(lines)
    print(table(found))
    results = {"synthetic": True, "seed": options.seed, "truth": rig.TRUE, "account": found, "campaigns": lines}
    common.finish(folder, results, watch, synthetic=True)


def source() -> str:
    """Return a key that identifies the version of the campaigns."""
    return common.source_key(__file__, rig.__file__)


def campaign(task: tuple[int]) -> dict[str, Any]:
    """Return the results of one campaign."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        records = rig.generate(task[0])
        experiments, refused = rig.usable(records)
        speeds = {record.recording.name: record.speed for record in records}
        try:
            known = {name: rig.TRUE[name] for name in FREE_SCALES}
            fitted = rig.estimate(experiments, speeds, start=rig.TRUE, known=known, noise=bp.noise.Measured())
        except ValueError as error:
            return {"seed": task[0], "source": source(), "refused": refused, "failure": str(error)}
    fit, intervals = fitted.fit, fitted.fit.interval(LEVEL, robust=False)
    return {
        "seed": task[0],
        "source": source(),
        "refused": refused,
        "converged": fit.converged,
        "covers": {name: bool(low < rig.TRUE[name] < high) for name, (low, high) in intervals.items()},
        "pulls": {name: (fit.theta[name] - rig.TRUE[name]) / fit.sd[name] for name in fit.theta},
        "sd": fit.sd,
        "kept_apart": all(one["as_measured"] for one in errors(fitted, experiments).values()),
    }


def account(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return coverage, in the two-sided 99 % band of the binomial distribution, failures and swaps."""
    whole = [line for line in lines if "failure" not in line]
    return {
        "campaigns": len(lines),
        "failures": [line["failure"] for line in lines if "failure" in line],
        "level": LEVEL,
        "band": [float(binom.ppf(p, len(whole), LEVEL)) for p in (ALARM / 2, 1 - ALARM / 2)] if whole else None,
        "covered": {
            name: sum(line["covers"][name] for line in whole) for name in (whole[0]["covers"] if whole else ())
        },
        "kept_apart": sum(line["kept_apart"] for line in whole),
        "not_converged": sum(not line["converged"] for line in whole),
        "records_refused": sum(len(line["refused"]) for line in lines),
    }


def table(found: Mapping[str, Any]) -> str:
    """Return the counts as text."""
    covered = ", ".join(f"{name} {found['covered'].get(name)}" for name in STIFFNESSES)
    return (
        f"  {found['campaigns']} campaigns, {len(found['failures'])} failures; {found['level']:.0%} intervals cover "
        f"{covered} (band {found['band']}); branches kept apart in {found['kept_apart']}, not converged "
        f"{found['not_converged']}"
    )
