"""The section on the verdicts, in words."""

from bayesperiodic.diagnosis.adequacy import ADEQUATE, LEVEL, MISSPECIFIED
from bayesperiodic.diagnosis.comparison import Comparison
from bayesperiodic.diagnosis.identifiability import DETERMINED, NOTHING
from bayesperiodic.diagnosis.predictive import Prediction
from bayesperiodic.diagnosis.verdicts import FINE, MODE, UNCONVERGED
from bayesperiodic.reporting import figures, text
from bayesperiodic.reporting.blocks import (
    BAD,
    CAUTION,
    GOOD,
    NEUTRAL,
    Badge,
    Block,
    Column,
    Heading,
    Paragraph,
    Row,
    Section,
    Table,
    code,
)
from bayesperiodic.reporting.evidence import Evidence

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


def section(evidence: Evidence) -> Section:
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
        (code(str(name)), badge(row["verdict"]), row["evidence"], row["remedy"] or text.NOTHING)
        for name, row in found.table.iterrows()
    ]
    caption = "What the data say of each parameter, against what the prior says."
    blocks: list[Block] = [
        Heading("identifiability", "What do the data determine?"),
        Table("table-identifiability", caption, tuple(columns), tuple(rows)),
        Paragraph(
            "The contraction is 1 − (posterior sd / prior sd)²: 1 where the data say all, 0 where they say nothing. "
            f"Condition number of the Fisher information: {text.number(found.condition)}."
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
    shares = ", ".join(text.percent(float(found.joint[f"share_{level}"])) for level in (50, 90, 95))
    return (
        f"Jointly: {found.joint['verdict']}; {found.joint['recommendation']}. Laplace’s ellipsoids of 50, 90 and 95 % "
        f"hold {shares} of the draws; Pareto k̂ {text.number(float(found.joint['pareto_k']), 2)}."
    )


def _with_error(value: float, error: float) -> str:
    return f"{text.Rounding(0, 2).text(value)} ± {text.Rounding(0, 2).text(error)}"


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
            *(text.p_value(row[test]) for test in tests),
            text.percent(row["model_error_share"]),
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
