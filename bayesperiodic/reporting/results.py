"""The section on the estimates: MAP, Laplace and MCMC side by side."""

import numpy as np

from bayesperiodic.diagnostics.adequacy import ADEQUATE, LEVEL, MISSPECIFIED
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.identifiability import DETERMINED, NOTHING
from bayesperiodic.diagnostics.predictive import Prediction
from bayesperiodic.diagnostics.verdicts import FINE, MODE, UNCONVERGED
from bayesperiodic.reporting import figures, html
from bayesperiodic.reporting.html import (
    BAD,
    CAUTION,
    GOOD,
    NEUTRAL,
    Badge,
    Block,
    Column,
    Heading,
    Note,
    Paragraph,
    Row,
    Section,
    Table,
    code,
)
from bayesperiodic.reporting.inputs import Evidence

PROBABILITY = 0.9


def estimates_section(evidence: Evidence) -> Section:
    """Return the estimates of all free parameters and noise parameters."""
    blocks: list[Block] = [Note(CAUTION, f"Not determined by the data: {said}.") for said in evidence.fit.undetermined]
    blocks += [_parameters(evidence), _noise(evidence)]
    sentence = (
        "The MAP estimate is the maximum of the posterior density, the Laplace approximation the normal distribution "
        "around it; its intervals are Student’s t. The robust standard deviation holds also where the residual is not "
        "as the noise model says; far from the other one, the noise model is too sure of itself, or not sure enough."
    )
    if evidence.posterior is None:
        return Section("estimates", "Estimates", [*blocks, Paragraph(f"{sentence} There are no draws (MCMC).")])
    blocks += [
        Paragraph(f"{sentence} MCMC is the distribution of the draws."),
        figures.corner(evidence, evidence.posterior),
    ]
    return Section("estimates", "Estimates", blocks)


def _parameters(evidence: Evidence) -> Table:
    columns = (
        Column("Parameter", numeric=False),
        Column("Unit", numeric=False),
        Column("MAP"),
        Column("sd", group="Laplace"),
        Column("90 % interval", group="Laplace"),
        Column("robust sd", group="Laplace"),
        *_mcmc_columns(evidence),
    )
    fit, intervals = evidence.fit, evidence.fit.interval(PROBABILITY)
    rows = []
    for name, value in fit.theta.items():
        rounding = html.Rounding.of(value, fit.sd[name])
        rows.append(
            (
                code(name),
                evidence.unit(name),
                rounding.text(value),
                rounding.sd(fit.sd[name]),
                rounding.interval(*intervals[name]),
                rounding.sd(fit.robust_sd[name]),
                *mcmc_cells(evidence, name, rounding),
            )
        )
    return Table("table-estimates", "Estimates of the free parameters.", columns, tuple(rows))


def _noise(evidence: Evidence) -> Table:
    columns = (
        Column("Noise parameter", numeric=False),
        Column("Unit", numeric=False),
        Column("Independent values"),
        Column("Estimate (eq. 7)"),
        Column("relative sd", group="Laplace"),
        *_mcmc_columns(evidence),
    )
    fit, rows = evidence.fit, []
    for name, value in fit.noise.items():
        free = name in evidence.problem.free_noise
        place = list(fit.joint_covariance.index).index(name) if free else -1
        relative = np.sqrt(float(fit.joint_covariance.to_numpy()[place, place])) if free else np.nan
        rounding = html.Rounding.of(value, value * relative)
        rows.append(
            (
                code(name),
                evidence.unit(name),
                html.number(_independent(evidence, name), 6),
                rounding.text(value) if free else f"{html.number(value, 6)} (known)",
                html.percent(relative),
                *mcmc_cells(evidence, name, rounding),
            )
        )
    return Table("table-noise", "Estimates of the noise parameters.", columns, tuple(rows))


def _independent(evidence: Evidence, name: str) -> float:
    """Return the independent values behind a variance; the fit has those of a channel by the channel's name."""
    short = name.removeprefix("variance[").removesuffix("]")
    return evidence.fit.independent.get(short, evidence.fit.independent.get(name, np.nan))


def _mcmc_columns(evidence: Evidence) -> tuple[Column, ...]:
    titles = () if evidence.posterior is None else ("mean", "sd", "90 % interval")
    return tuple(Column(title, group="MCMC") for title in titles)


def mcmc_cells(evidence: Evidence, name: str, rounding: html.Rounding) -> tuple[str, ...]:
    """Return mean, standard deviation and 90 % interval of the draws; nothing where there are none."""
    if evidence.posterior is None:
        return ()
    if name not in evidence.posterior.names:
        return (html.NOTHING,) * 3
    draws = evidence.posterior.draws(name)
    low, high = np.quantile(draws, [0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY])
    return rounding.text(draws.mean()), rounding.sd(draws.std(ddof=1)), rounding.interval(low, high)


TONES = {
    FINE: GOOD,
    DETERMINED: GOOD,
    ADEQUATE: GOOD,
    MISSPECIFIED: BAD,
    MODE: BAD,
    UNCONVERGED: BAD,
    NOTHING: BAD,
    "not tested": NEUTRAL,
}


def badge(verdict: str) -> Badge:
    """Return a verdict with its tone; what is neither good nor bad is a caution."""
    return Badge(TONES.get(verdict, CAUTION), verdict)


def verdicts_section(evidence: Evidence) -> Section:
    """Return what the data determine, whether Laplace will do, and whether the model explains the data."""
    blocks = _identifiability(evidence)
    blocks.append(Heading("laplace", "Is the Laplace approximation good enough?"))
    blocks += [Paragraph("Without draws this cannot be told.")] if evidence.comparison is None else _laplace(evidence)
    blocks.append(Heading("adequacy", "Does the model explain the data?"))
    if evidence.prediction is None:
        blocks.append(Paragraph(evidence.unpredicted or "Without draws this is not tested."))
    else:
        blocks += _adequacy(evidence.prediction)
    return Section("verdicts", "Verdicts", blocks)


def _identifiability(evidence: Evidence) -> list[Block]:
    found = evidence.identifiability
    columns = [Column(title, numeric=False) for title in ("Parameter", "Verdict", "Evidence", "What to do")]
    rows = [
        (code(str(name)), badge(row["verdict"]), row["evidence"], row["remedy"] or html.NOTHING)
        for name, row in found.table.iterrows()
    ]
    caption = "What the data say of each parameter, against what the prior says."
    blocks: list[Block] = [
        Heading("identifiability", "What do the data determine?"),
        Table("table-identifiability", caption, tuple(columns), tuple(rows)),
        Paragraph(
            "The contraction is 1 − (posterior sd / prior sd)²: 1 where the data say all, 0 where they say nothing. "
            f"Condition number of the Fisher information: {html.number(found.condition)}."
        ),
    ]
    if found.structure.symmetries:
        blocks.append(Paragraph("What the equations leave open whatever is measured:"))
        blocks += [Paragraph(f"{symmetry!r}.") for symmetry in found.structure.symmetries]
    return blocks


def _laplace(evidence: Evidence) -> list[Block]:
    found = evidence.comparison
    assert found is not None
    columns = (
        Column("Coordinate", numeric=False),
        Column("Verdict", numeric=False),
        Column("Shift"),
        Column("Ratio of sds"),
        Column("Skewness"),
        Column("Distance"),
        Column("What to do", numeric=False),
    )
    rows = [
        (
            code(row["coordinate"]),
            badge(row["verdict"]),
            *(_with_error(row[c], row[f"{c}_mcse"]) for c in ("shift", "sd_ratio", "skewness", "wasserstein")),
            row["recommendation"],
        )
        for _, row in found.table.iterrows()
    ]
    caption = (
        f"Laplace against MCMC in {found.coordinates} coordinates (± Monte Carlo error). Shift (mean − MAP) and "
        "distance (Wasserstein) in standard deviations of the draws; Laplace’s sd over that of the draws."
    )
    table = Table("table-laplace", caption, columns, tuple(rows))
    return [Paragraph(jointly(found)), table, figures.comparison(evidence)]


def jointly(found: Comparison) -> str:
    """Return the joint verdict on Laplace in words."""
    shares = ", ".join(html.percent(float(found.joint[f"share_{level}"])) for level in (50, 90, 95))
    return (
        f"Jointly: {found.joint['verdict']}; {found.joint['recommendation']}. Laplace’s ellipsoids of 50, 90 and 95 % "
        f"hold {shares} of the draws; Pareto k̂ {html.number(float(found.joint['pareto_k']), 2)}."
    )


def _with_error(value: float, error: float) -> str:
    return f"{html.Rounding(0, 2).text(value)} ± {html.Rounding(0, 2).text(error)}"


def _adequacy(found: Prediction) -> list[Block]:
    tests = ("whiteness", "harmonics", "size", "amplitude", "consistency")
    columns = (
        Column("Experiment and channel", numeric=False),
        Column("Verdict", numeric=False),
        *(Column(test, group="p-values") for test in tests),
        Column("Model error’s share"),
    )
    rows: list[Row] = [
        (
            str(label),
            badge(row["verdict"]),
            *(html.p_value(row[test]) for test in tests),
            html.percent(row["model_error_share"]),
        )
        for label, row in found.table.iterrows()
    ]
    caption = (
        f"Tests of the model. A verdict weighs all p-values of the table at once (Holm), false alarms {LEVEL:.0%}; the "
        "last column is the share of the residual’s variance beyond the measured noise."
    )
    said = [Paragraph(f"{label}: {words}.") for label, words in found.findings.items()]
    blocks: list[Block] = [Table("table-adequacy", caption, columns, tuple(rows)), *said]
    if found.failed:
        blocks.append(Paragraph(f"Of {found.draws} draws {found.failed} had no periodic solution."))
    return [*blocks, Paragraph(found.note)] if found.note else blocks


NOT_WHITE, MUCH = 0.01, 1.5


def residuals_section(evidence: Evidence) -> Section:
    """Return the residual of every channel in numbers, and the figures."""
    blocks: list[Block] = [_channels(evidence)]
    if said := too_sure(evidence):
        blocks.append(Note(CAUTION, said))
    blocks.append(
        Paragraph(
            "Measurement noise is what the scatter of the measured cycles explains of the residual, model error what "
            "is left. The whiteness p is the probability of a residual at least as far from white noise; the "
            "autocorrelation is that from one independent value to the next."
        )
    )
    blocks += figures.fits(evidence)
    if evidence.problem.model.inputs:
        blocks.append(figures.loops(evidence))
    return Section("fit", "Fit and residual", blocks)


def too_sure(evidence: Evidence) -> str:
    """Return by how much standard deviations are too small where a residual is not white; nothing if they are not."""
    fit = evidence.fit
    colours = [channel for channel, white in fit.whiteness.items() if white.p < NOT_WHITE]
    ratios = {name: fit.robust_sd[name] / sd for name, sd in fit.sd.items() if sd > 0.0}
    wider = {name: ratio for name, ratio in ratios.items() if np.isfinite(ratio) and ratio > MUCH}
    if not colours or not wider:
        return ""
    worst = max(wider, key=lambda name: wider[name])
    return (
        f"The residual of {', '.join(colours)} is not white, so the standard deviations and intervals of "
        f"{', '.join(wider)} are too small; the robust ones are up to {html.number(wider[worst], 2)} times as large "
        f"({worst})."
    )


def _channels(evidence: Evidence) -> Table:
    columns = (
        Column("Channel", numeric=False),
        Column("Unit", numeric=False),
        Column("rms of the residual"),
        Column("Unexplained variance"),
        Column("Measurement noise"),
        Column("Model error"),
        Column("Noise of the inputs"),
        Column("Whiteness p"),
        Column("Autocorrelation"),
    )
    fit, rows = evidence.fit, []
    for channel, rms in fit.rms.items():
        split, white = fit.noise_split.get(channel), fit.whiteness[channel]
        rows.append(
            (
                code(channel),
                evidence.unit(channel),
                html.number(rms),
                html.percent(fit.fvu[channel]),
                html.number(np.nan if split is None else split.measurement),
                html.number(np.nan if split is None or np.isnan(split.measurement) else split.model),
                html.number(fit.input_noise.get(channel, np.nan)),
                html.p_value(white.p),
                html.number(white.lag1, 2),
            )
        )
    caption = "The residual of each channel, measured minus MAP; standard deviations in the channel’s unit."
    return Table("table-residuals", caption, columns, tuple(rows))
