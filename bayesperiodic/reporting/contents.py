"""Tables and figures of the report."""

import base64
import importlib.metadata
import io
import platform
from collections.abc import Iterator, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from bayesperiodic import plot
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.diagnostics.adequacy import ADEQUATE, LEVEL, MISSPECIFIED, TESTS, UNTESTED
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.identifiability import DETERMINED, NOTHING
from bayesperiodic.diagnostics.predictive import PROBABILITY, Prediction
from bayesperiodic.diagnostics.verdicts import FINE, MODE, UNCONVERGED
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.posterior.parameters import SHIFT
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.reporting import html
from bayesperiodic.reporting.inputs import ReportInputs, symbol
from bayesperiodic.sampling.checkpoint import fingerprint
from bayesperiodic.sampling.posterior import Posterior

LONGEST = 120
PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "xarray", "matplotlib")
MOST_PANELS = 7
TONES = {
    FINE: html.GOOD,
    DETERMINED: html.GOOD,
    ADEQUATE: html.GOOD,
    MISSPECIFIED: html.BAD,
    MODE: html.BAD,
    UNCONVERGED: html.BAD,
    NOTHING: html.BAD,
    UNTESTED: html.NEUTRAL,
}


def badge(verdict: str) -> html.Badge:
    """Return the badge of a verdict; verdicts without a tone of their own get "caution"."""
    return html.Badge(TONES.get(verdict, html.CAUTION), verdict)


def other_than(good: str, verdicts: Mapping[Any, str]) -> list[str]:
    """Return the verdicts that differ from `good`, with their names."""
    return [f"{name}: {verdict}" for name, verdict in verdicts.items() if verdict != good]


def embedded(drawing: Figure, name: str) -> str:
    """Return a figure as a data URL of an SVG image, reproducibly, and close it."""
    buffer = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    plt.close(drawing)
    return f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def experiments(given: ReportInputs) -> html.Table:
    """Return the table of the experiments."""
    rows = [
        {
            "Experiment": e.name,
            "Data": "synthetic" if e.synthetic else "measured",
            "Frequency [Hz]": html.number(e.frequency, 7),
            "Standard error [Hz]": html.number(e.frequency_se, 2) if e.frequency_se else html.NOTHING,
            "Cycles": html.Number(e.cycles),
            "Forcing periods per response": html.Number(e.periods),
            "Points per period": html.Number(e.samples),
            "Periodicity": html.number(e.periodicity, 5),
        }
        for e in given.problem.experiments
    ]
    caption = "Experiments. The periodicity is the fraction of the variance that the mean period explains."
    return html.Table("table-experiments", caption, rows)


def channels(given: ReportInputs) -> html.Table:
    """Return the table of the channels."""
    rows = [
        _channel(given, e, channel, kind)
        for e in given.problem.experiments
        for kind, channels in (("input", e.inputs), ("output", e.outputs))
        for channel in channels
    ]
    caption = "Channels: prescribed (inputs) and compared with the model (outputs)."
    return html.Table("table-channels", caption, rows)


def _channel(given: ReportInputs, e: Experiment, channel: str, kind: str) -> dict[str, str]:
    values = (e.inputs if kind == "input" else e.outputs)[channel]
    measured = values if e.mask is None or kind == "input" else values[e.mask]
    return {
        "Channel": html.code(channel),
        "Experiment": e.name,
        "Kind": kind if e.mask is None or kind == "input" else f"{kind}, at {measured.size} points",
        "Unit": given.unit(channel),
        "Minimum": html.number(float(measured.min()), 4),
        "Maximum": html.number(float(measured.max()), 4),
        "Harmonics kept": html.Number(e.harmonics.get(channel, "all")),
        "Independent values": html.Number(e.independent.get(channel, html.NOTHING)),
        "Standard deviation of one cycle": html.number(e.scatter.get(channel, np.nan)),
    }


def parameters(given: ReportInputs) -> html.Table:
    """Return the table of all parameters."""
    rows = [
        {
            "Parameter": html.code(name),
            "Symbol": symbol(name.partition("[")[0]),
            "Unit": given.unit(name),
            "Role": role,
            "Prior, value or expression": known,
        }
        for plain in (*given.problem.model.parameters, SHIFT)
        for name, role, known in _roles(given.problem, plain)
    ]
    return html.Table("table-parameters", "Parameters with their priors, fixed values or expressions.", rows)


def _roles(problem: Problem, plain: str) -> Iterator[tuple[str, str, str]]:
    """Yield the full names of a parameter with its role and its prior, value or expression."""
    partners = {name: key for key in problem.priors if isinstance(key, tuple) for name in key}
    for name in (n for n in problem.names if n.partition("[")[0] == plain):
        prior = repr(problem.joint_prior.marginals[name])
        prior = prior if len(prior) <= LONGEST else f"{prior[:LONGEST]}…"
        others = ", ".join(other for other in partners.get(name, ()) if other != name)
        yield name, "free", prior + (f", jointly with {others}" if others else "")
    if plain in problem.tied:
        yield plain, "tied", problem.tied[plain]
    by_run = problem.fixed.get(plain, {})
    if len(by_run) == len(problem.experiments) and len(set(by_run.values())) == 1:
        by_run = {"": next(iter(by_run.values()))}
    for run, value in by_run.items():
        yield (f"{plain}[{run}]" if run else plain), "fixed", str(html.number(value, 6))


def summary(given: ReportInputs) -> html.Table:
    """Return the summary table of the free parameters."""
    fit, intervals, rows = given.fit, given.fit.interval(PROBABILITY), []
    robust = fit.interval(PROBABILITY, robust=True) if given.robust_ratios else {}
    laplace = {} if given.comparison is None else dict(given.comparison.table["verdict"])
    for name, value in fit.theta.items():
        rounding = html.Rounding.of(value, fit.sd[name])
        drawn = _mcmc_cells(given, name, rounding)
        row: dict[str, str | html.Badge] = {
            "Parameter": html.code(name),
            "Unit": given.unit(name),
            "MAP": rounding.text(value),
            "90 % interval": drawn["MCMC: 90 % interval"] if drawn else rounding.interval(*intervals[name]),
        }
        row |= {"Robust 90 % interval": rounding.interval(*robust[name])} if robust else {}
        row |= {"Identifiability": badge(given.identifiability.verdicts[name])}
        row |= {"Laplace approximation": badge(laplace[name])} if laplace else {}
        rows.append(row)
    source = "the Laplace approximation (Student’s t)" if given.posterior is None else "MCMC"
    return html.Table("table-summary", f"Free parameters; 90 % intervals from {source}.", rows)


def estimates(given: ReportInputs) -> html.Table:
    """Return the table of the estimates of the free parameters."""
    fit, intervals, rows = given.fit, given.fit.interval(PROBABILITY), []
    for name, value in fit.theta.items():
        rounding = html.Rounding.of(value, fit.sd[name])
        rows.append(
            {
                "Parameter": html.code(name),
                "Unit": given.unit(name),
                "MAP": rounding.text(value),
                "Laplace: sd": rounding.sd(fit.sd[name]),
                "Laplace: 90 % interval": rounding.interval(*intervals[name]),
                "Laplace: robust sd": rounding.sd(fit.robust_sd[name]),
                **_mcmc_cells(given, name, rounding),
            }
        )
    return html.Table("table-estimates", "Estimates of the free parameters.", rows)


def noise(given: ReportInputs) -> html.Table:
    """Return the table of the estimates of the noise parameters."""
    fit, rows = given.fit, []
    variances = dict(zip(fit.joint_covariance.index, np.diag(fit.joint_covariance), strict=True))
    for name, value in fit.noise.items():
        free = name in given.problem.free_noise
        relative = np.sqrt(float(variances[name])) if free else np.nan
        rounding = html.Rounding.of(value, value * relative)
        channel = name.removeprefix("variance[").removesuffix("]")
        independent = fit.independent.get(channel, fit.independent.get(name, np.nan))
        rows.append(
            {
                "Noise parameter": html.code(name),
                "Unit": given.unit(name),
                "Independent values": html.number(independent, 6),
                "Estimate (eq. 7)": rounding.text(value) if free else html.Number(f"{html.number(value, 6)} (known)"),
                "Laplace: relative sd": html.percent(relative),
                **_mcmc_cells(given, name, rounding),
            }
        )
    return html.Table("table-noise", "Estimates of the noise parameters.", rows)


def _mcmc_cells(given: ReportInputs, name: str, rounding: html.Rounding) -> dict[str, str]:
    """Return mean, standard deviation and 90 % interval of the draws; no columns without draws."""
    if given.posterior is None:
        return {}
    titles = ("MCMC: mean", "MCMC: sd", "MCMC: 90 % interval")
    if name not in given.summary.index:
        return dict.fromkeys(titles, html.Number(html.NOTHING))
    mean, sd, low, high = map(float, given.summary.loc[[name], ["mean", "sd", "q05", "q95"]].to_numpy()[0])
    return dict(zip(titles, (rounding.text(mean), rounding.sd(sd), rounding.interval(low, high)), strict=True))


def corner(given: ReportInputs, posterior: Posterior) -> html.Figure:
    """Return the corner plot of the most correlated quantities."""
    names = posterior.names
    correlations = np.atleast_2d(np.corrcoef(np.stack([posterior.draws(name) for name in names])))
    np.fill_diagonal(correlations, 0.0)
    correlations = np.nan_to_num(correlations)
    kept = np.sort(np.argsort(-np.abs(correlations).max(axis=0), kind="stable")[:MOST_PANELS])
    shown = [names[i] for i in kept]
    selection = "" if len(shown) == len(names) else f" Shown are the {len(shown)} most correlated of {len(names)}."
    strongest = ""
    if len(names) > 1:
        i, j = sorted(np.unravel_index(np.argmax(np.abs(correlations)), correlations.shape))
        value = html.number(float(correlations[i, j]), 2)
        strongest = f" The strongest correlation is {value}, between {names[i]} and {names[j]}."
    return html.Figure(
        "figure-corner",
        embedded(plot.corner(posterior, laplace=given.fit, names=shown), "corner"),
        f"Matrix of plots: marginal distributions of {', '.join(shown)} on the diagonal, contours of their pairs below "
        f"it, from the draws and from the Laplace approximation.{strongest}",
        "Posterior distribution of parameters and noise parameters: draws (MCMC) and Laplace approximation, with the "
        f"regions of 50 and 90 % probability.{strongest}{selection}",
        wide=True,
    )


def residuals(given: ReportInputs) -> html.Table:
    """Return the table of the residuals."""
    fit, rows = given.fit, []
    for channel, rms in fit.rms.items():
        split, white = fit.noise_split.get(channel), fit.whiteness[channel]
        noise, error = (np.nan, np.nan) if split is None else (split.measurement, split.model)
        rows.append(
            {
                "Channel": html.code(channel),
                "Unit": given.unit(channel),
                "rms of the residual": html.number(rms),
                "Unexplained variance": html.percent(fit.fvu[channel]),
                "Measurement noise": html.number(noise),
                "Model error": html.number(np.nan if np.isnan(noise) else error),
                "Input noise": html.number(fit.input_noise.get(channel, np.nan)),
                "Whiteness p": html.p_value(white.p),
                "Autocorrelation": html.number(white.lag1, 2),
            }
        )
    caption = "Residual of each channel, measured minus MAP; standard deviations in the unit of the channel."
    return html.Table("table-residuals", caption, rows)


def fits(given: ReportInputs) -> Iterator[html.Figure]:
    """Yield a figure of the fit for every experiment, and that of the loops."""
    problem, fit, prediction = given.problem, given.fit, given.prediction
    for place, e in enumerate(problem.experiments):
        channels = ", ".join(f"{channel} [{given.unit(channel)}]" for channel in e.outputs)
        band = f", the {prediction.probability:.0%} predictive band of the draws" if prediction else ""
        residual = ", ".join(
            f"{html.number(float(np.sqrt(np.mean(fit.residuals[e.name][channel] ** 2))))} {given.unit(channel)}"
            for channel in e.outputs
        )
        yield html.Figure(
            f"figure-fit-{place + 1}",
            embedded(plot.fit(problem, fit, prediction, experiments=[e.name]), f"fit {place}"),
            f"Line plot over one period of experiment {e.name}: measured {channels}, the MAP fit on top{band}, and the "
            f"residual below; its root mean square is {residual}.",
            f"{e.name}: one period of {', '.join(e.outputs)}, measured and fitted, and the residual.",
        )
    if problem.model.inputs:
        axes = f"{problem.channels[0]} against {problem.model.inputs[0]}, and against its rate"
        yield html.Figure(
            "figure-loops",
            embedded(plot.loops(problem, fit), "loops"),
            f"Closed curves of {axes}, measured and fitted, for {len(problem.experiments)} experiments.",
            f"Measured and fitted: {axes}.",
            wide=True,
        )


def verdicts(given: ReportInputs) -> html.Table:
    """Return the table of the identifiability of each parameter."""
    rows = [
        {
            "Parameter": html.code(str(name)),
            "Verdict": badge(row["verdict"]),
            "Evidence": row["evidence"],
            "Recommendation": row["remedy"] or html.NOTHING,
        }
        for name, row in given.identifiability.table.iterrows()
    ]
    return html.Table("table-identifiability", "Identifiability of each parameter: data against prior.", rows)


def laplace(found: Comparison) -> html.Table:
    """Return the table of the comparison of Laplace with MCMC."""
    two = html.Rounding(0, 2)
    columns = {"Shift": "shift", "Ratio of sds": "sd_ratio", "Skewness": "skewness", "Distance": "wasserstein"}
    rows = [
        {
            "Coordinate": html.code(row["coordinate"]),
            "Verdict": badge(row["verdict"]),
            **{t: html.Number(f"{two.text(row[c])} ± {two.text(row[f'{c}_mcse'])}") for t, c in columns.items()},
            "Recommendation": row["recommendation"],
        }
        for _, row in found.table.iterrows()
    ]
    caption = (
        f"Laplace against MCMC in {found.coordinates} coordinates (± Monte Carlo error). Shift: mean of the draws "
        "minus MAP, in standard deviations of the draws. Ratio: Laplace sd over sd of the draws. Distance: Wasserstein "
        "distance in standard deviations of the draws."
    )
    return html.Table("table-laplace", caption, rows)


def comparison(found: Comparison) -> html.Figure:
    """Return the figure of the comparison of Laplace with MCMC."""
    verdicts = ", ".join(f"{name} {verdict}" for name, verdict in found.table["verdict"].items())
    return html.Figure(
        "figure-comparison",
        embedded(plot.comparison(found), "comparison"),
        "Marginal distributions of the draws with the Laplace approximation on top, their quantiles against each "
        f"other, and the fraction of draws in Laplace ellipsoids. Verdicts: {verdicts}; jointly "
        f"{found.joint['verdict']}.",
        "The Laplace approximation against the draws: marginal distributions, quantiles (grey: tolerance) and "
        "ellipsoids.",
        wide=True,
    )


def adequacy(found: Prediction) -> html.Table:
    """Return the table of the tests of the model."""
    rows: list[html.Row] = [
        {
            "Experiment and channel": str(label),
            "Verdict": badge(row["verdict"]),
            **{f"p-values: {test}": html.p_value(row[test]) for test in TESTS},
            "Fraction of model error": html.percent(row["model_error_share"]),
        }
        for label, row in found.table.iterrows()
    ]
    caption = (
        "Tests of the model. Verdicts use p-values adjusted for all tests of the table (Holm), with a false alarm rate "
        f"of {html.percent(LEVEL)}; the last column is the fraction of the residual variance beyond the measured noise."
    )
    return html.Table("table-adequacy", caption, rows)


def sampling(given: ReportInputs) -> html.Table:
    """Return the table of the convergence of the draws."""
    rows = [
        {
            "Quantity": html.code(str(name)),
            "Effective sample size": html.Number(f"{row['ess']:.0f}"),
            "Autocorrelation time [steps]": html.number(row["tau"], 3),
            "R-hat between ensembles": html.Number(f"{row['rhat']:.4f}"),
        }
        for name, row in given.summary.iterrows()
    ]
    return html.Table("table-sampling", "Convergence of the draws, in sampling coordinates.", rows)


def traces(given: ReportInputs, posterior: Posterior) -> html.Figure:
    """Return the figure of the traces."""
    return html.Figure(
        "figure-traces",
        embedded(plot.traces(posterior, walkers=2), "traces"),
        f"Traces of some walkers of each ensemble for {', '.join(posterior.names)}; the largest R-hat is "
        f"{given.summary['rhat'].max():.4f}.",
        "Traces of some walkers; each colour is an independent ensemble.",
        wide=True,
    )


def settings(given: ReportInputs) -> html.Table:
    """Return the table of the settings."""
    problem, fit, posterior = given.problem, given.fit, given.posterior
    shifts = {name: abs(shift) for name, shift in fit.doubling_shift.items() if np.isfinite(shift)}
    worst = max(shifts, key=lambda name: shifts[name], default="")
    steps, starts = html.counted(len(fit.history) - 1, "step"), html.counted(len(fit.starts), "start")
    values = {
        "Problem": fingerprint(problem).removeprefix("problem "),
        "Difference scheme": find_scheme(problem.scheme).name,
        "Noise model": repr(problem.noise),
        "Search for the MAP": f"{fit.status}, {steps}, {starts}",
        "Largest shift of an estimate with twice as many points": (
            f"{html.number(shifts[worst], 2)} sd ({worst})" if worst else "not known"
        ),
        "Degrees of freedom": html.number(fit.degrees_of_freedom, 5),
    }
    if posterior is not None:
        group, attributes = posterior.data["posterior"], posterior.data.attrs
        chains, draws = group.sizes["chain"], group.sizes["draw"]
        count = np.unique(group["ensemble"].to_numpy()).size
        programs = [f"{name} {attributes[name]}" for name in ("bayesperiodic", "emcee", "nutpie") if name in attributes]
        values |= {
            "Seed": str(posterior.seed),
            "Draws": f"{count} ensembles, {chains // count} chains each, {draws} draws per chain",
            "Drawn with": ", ".join(programs),
        }
    rows = [{"Setting": name, "Value": html.code(value)} for name, value in values.items()]
    return html.Table("table-settings", "Settings.", rows)


def versions() -> html.Table:
    """Return the table of the versions of Python and of the packages."""
    values = {"Python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}
    rows = [{"Program": name, "Version": html.code(value)} for name, value in values.items()]
    return html.Table("table-versions", "Versions in use when this page was written.", rows)
