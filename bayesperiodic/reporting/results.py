"""Sections of the report on estimates, residuals and verdicts, with their figures."""

import base64
import io
from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from bayesperiodic import plot
from bayesperiodic.diagnostics.adequacy import ADEQUATE, LEVEL, MISSPECIFIED, TESTS, UNTESTED
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.identifiability import DETERMINED, NOTHING
from bayesperiodic.diagnostics.predictive import PROBABILITY, Prediction
from bayesperiodic.diagnostics.verdicts import FINE, MODE, UNCONVERGED
from bayesperiodic.reporting import html
from bayesperiodic.reporting.inputs import ReportInputs
from bayesperiodic.sampling.posterior import Posterior

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


def embedded(drawing: Figure, name: str) -> str:
    """Return a figure as a data URL of an SVG image, reproducibly, and close it."""
    buffer = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    plt.close(drawing)
    return f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def estimates_section(given: ReportInputs) -> html.Section:
    """Return the section on the estimates: MAP, Laplace and MCMC side by side."""
    text = (
        "The MAP estimate is the maximum of the posterior density. The Laplace approximation is the normal "
        "distribution around it; its intervals are those of Student’s t. The robust standard deviation remains valid "
        "if the residual violates the noise model; a large difference between the two indicates such a violation. "
    )
    notes = [html.Note(html.CAUTION, f"Not determined by the data: {found}.") for found in given.fit.undetermined]
    blocks: list[html.Block] = [*notes, _parameters(given)]
    if given.fit.noise:
        blocks.append(_noise(given))
    if given.posterior is None:
        blocks.append(html.Paragraph(f"{text}The posterior was not sampled. There are no draws (MCMC)."))
    else:
        blocks += [
            html.Paragraph(f"{text}MCMC refers to the distribution of the posterior draws."),
            _corner(given, given.posterior),
        ]
    return html.Section("estimates", "Estimates", blocks)


def _parameters(given: ReportInputs) -> html.Table:
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
                **mcmc_cells(given, name, rounding),
            }
        )
    return html.Table("table-estimates", "Estimates of the free parameters.", rows)


def _noise(given: ReportInputs) -> html.Table:
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
                **mcmc_cells(given, name, rounding),
            }
        )
    return html.Table("table-noise", "Estimates of the noise parameters.", rows)


def mcmc_cells(given: ReportInputs, name: str, rounding: html.Rounding) -> dict[str, str]:
    """Return mean, standard deviation and 90 % interval of the draws; no columns without draws."""
    if given.posterior is None:
        return {}
    titles = ("MCMC: mean", "MCMC: sd", "MCMC: 90 % interval")
    if name not in given.summary.index:
        return dict.fromkeys(titles, html.Number(html.NOTHING))
    mean, sd, low, high = given.summary.loc[name, ["mean", "sd", "q05", "q95"]].astype(float)
    return dict(zip(titles, (rounding.text(mean), rounding.sd(sd), rounding.interval(low, high)), strict=True))


def _corner(given: ReportInputs, posterior: Posterior) -> html.Figure:
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


def residuals_section(given: ReportInputs) -> html.Section:
    """Return the section on the fit and the residual of every channel."""
    fit, problem, rows = given.fit, given.problem, []
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
    blocks: list[html.Block] = [html.Table("table-residuals", caption, rows)]
    blocks += [html.Note(html.CAUTION, warning) for warning in underestimated_sds(given)]
    blocks.append(
        html.Paragraph(
            "Measurement noise is the part of the residual that the scatter of the measured cycles explains, model "
            "error is the remainder. The whiteness p is the probability that white noise deviates at least as much "
            "from a flat spectrum; the autocorrelation is that of successive independent values."
        )
    )
    blocks += _fits(given)
    if problem.model.inputs:
        axes = f"{problem.channels[0]} against {problem.model.inputs[0]}, and against its rate"
        blocks.append(
            html.Figure(
                "figure-loops",
                embedded(plot.loops(problem, fit), "loops"),
                f"Closed curves of {axes}, measured and fitted, for {len(problem.experiments)} experiments.",
                f"Measured and fitted: {axes}.",
                wide=True,
            )
        )
    return html.Section("fit", "Fit and residual", blocks)


def underestimated_sds(given: ReportInputs) -> list[str]:
    """Return a warning if standard deviations are too small because a residual is not white."""
    ratios = given.robust_ratios
    if not ratios:
        return []
    worst = max(ratios, key=lambda name: ratios[name])
    return [
        f"The residual of {', '.join(given.coloured)} is not white, so the standard deviations and intervals of "
        f"{', '.join(ratios)} are too small; the robust ones are up to {html.number(ratios[worst], 2)} times as large "
        f"({worst})."
    ]


def _fits(given: ReportInputs) -> Iterator[html.Figure]:
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


def verdicts_section(given: ReportInputs) -> html.Section:
    """Return the section on identifiability, the Laplace approximation and the adequacy of the model."""
    blocks = _identifiability(given)
    blocks.append(html.Heading("laplace", "Is the Laplace approximation accurate?"))
    blocks += (
        [html.Paragraph("Not tested: this requires draws.")] if given.comparison is None else _laplace(given.comparison)
    )
    blocks.append(html.Heading("adequacy", "Does the model explain the data?"))
    if given.prediction is None:
        blocks.append(html.Paragraph(given.no_prediction or "Not tested: this requires draws."))
    else:
        blocks += _adequacy(given.prediction)
    return html.Section("verdicts", "Verdicts", blocks)


def _identifiability(given: ReportInputs) -> list[html.Block]:
    found = given.identifiability
    rows = [
        {
            "Parameter": html.code(str(name)),
            "Verdict": badge(row["verdict"]),
            "Evidence": row["evidence"],
            "Recommendation": row["remedy"] or html.NOTHING,
        }
        for name, row in found.table.iterrows()
    ]
    blocks: list[html.Block] = [
        html.Heading("identifiability", "Which parameters do the data determine?"),
        html.Table("table-identifiability", "Identifiability of each parameter: data against prior.", rows),
        html.Paragraph(
            "The contraction is 1 − (posterior sd / prior sd)²: 1 if the parameter is determined by the data, 0 if its "
            "posterior equals its prior. The condition number of the Fisher information is "
            f"{html.number(found.condition)}."
        ),
    ]
    if found.structure.symmetries:
        blocks.append(html.Paragraph("Structural symmetries, which no measurement of these channels can resolve:"))
        blocks += [html.Paragraph(f"{symmetry!r}.") for symmetry in found.structure.symmetries]
    return blocks


def _laplace(found: Comparison) -> list[html.Block]:
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
    inside = ", ".join(html.percent(float(found.joint[f"share_{level}"])) for level in (50, 90, 95))
    verdicts = ", ".join(f"{name} {verdict}" for name, verdict in found.table["verdict"].items())
    joint = (
        f"Joint verdict: {found.joint['verdict']}; {found.joint['recommendation']}. Laplace ellipsoids of 50, 90 and "
        f"95 % contain {inside} of the draws; Pareto k̂ {html.number(float(found.joint['pareto_k']), 2)}."
    )
    figure = html.Figure(
        "figure-comparison",
        embedded(plot.comparison(found), "comparison"),
        "Marginal distributions of the draws with the Laplace approximation on top, their quantiles against each "
        f"other, and the fraction of draws in Laplace ellipsoids. Verdicts: {verdicts}; jointly "
        f"{found.joint['verdict']}.",
        "The Laplace approximation against the draws: marginal distributions, quantiles (grey: tolerance) and "
        "ellipsoids.",
        wide=True,
    )
    return [html.Paragraph(joint), html.Table("table-laplace", caption, rows), figure]


def _adequacy(found: Prediction) -> list[html.Block]:
    rows = [
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
    blocks: list[html.Block] = [html.Table("table-adequacy", caption, rows)]
    blocks += [html.Paragraph(f"{label}: {words}.") for label, words in found.findings.items()]
    if found.failed:
        blocks.append(html.Paragraph(f"Of {found.draws} draws {found.failed} had no periodic solution."))
    return [*blocks, html.Paragraph(found.note)] if found.note else blocks
