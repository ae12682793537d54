"""The section on the fit: measured and fitted periods, and what the residual consists of."""

import numpy as np

from bayesperiodic.reporting import figures, text
from bayesperiodic.reporting.blocks import CAUTION, Block, Column, Note, Paragraph, Section, Table, code
from bayesperiodic.reporting.evidence import Evidence

NOT_WHITE, MUCH = 0.01, 1.5


def section(evidence: Evidence) -> Section:
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
        f"{', '.join(wider)} are too small; the robust ones are up to {text.number(wider[worst], 2)} times as large "
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
                text.number(rms),
                text.percent(fit.fvu[channel]),
                text.number(np.nan if split is None else split.measurement),
                text.number(np.nan if split is None or np.isnan(split.measurement) else split.model),
                text.number(fit.input_noise.get(channel, np.nan)),
                text.p_value(white.p),
                text.number(white.lag1, 2),
            )
        )
    caption = "The residual of each channel, measured minus MAP; standard deviations in the channel’s unit."
    return Table("table-residuals", caption, columns, tuple(rows))
