"""The section that is read first: answers, and one line a parameter."""

from collections.abc import Iterable

from bayesperiodic.diagnosis.adequacy import ADEQUATE, MISSPECIFIED
from bayesperiodic.diagnosis.identifiability import DETERMINED
from bayesperiodic.diagnosis.verdicts import FINE
from bayesperiodic.inference.estimation.map_estimate import remarks
from bayesperiodic.reporting import text
from bayesperiodic.reporting.blocks import (
    BAD,
    CAUTION,
    GOOD,
    NEUTRAL,
    Answer,
    Answers,
    Badge,
    Block,
    Column,
    Note,
    Row,
    Section,
    Table,
    code,
)
from bayesperiodic.reporting.estimates import PROBABILITY, mcmc_cells
from bayesperiodic.reporting.evidence import Evidence
from bayesperiodic.reporting.residuals import too_sure
from bayesperiodic.reporting.verdicts import badge


def section(evidence: Evidence) -> Section:
    """Return the answers to what a reader asks first."""
    warnings = [*remarks(evidence.problem, evidence.fit)]
    if said := too_sure(evidence):
        warnings.append(said)
    blocks: list[Block] = [
        Answers((_estimate(evidence), _draws(evidence), _data(evidence), _laplace(evidence), _model(evidence)))
    ]
    blocks += [Note(CAUTION, warning) for warning in warnings]
    return Section("summary", "In short", [*blocks, _parameters(evidence)])


def _estimate(evidence: Evidence) -> Answer:
    fit = evidence.fit
    shares = ", ".join(f"{text.percent(share)} of the variance of {channel}" for channel, share in fit.fvu.items())
    return Answer(
        "Was the best fit found?",
        Badge(GOOD if fit.converged else BAD, fit.status),
        f"The search took {len(fit.history) - 1} steps. The fit leaves {shares} unexplained.",
    )


def _draws(evidence: Evidence) -> Answer:
    question, posterior = "Can the draws be trusted?", evidence.posterior
    if posterior is None:
        return Answer(question, Badge(NEUTRAL, "no draws"), "The posterior was not sampled; intervals are Laplace’s.")
    failed = sum(posterior.failures.values())
    return Answer(
        question,
        Badge(GOOD, "converged") if posterior.converged else Badge(BAD, "not converged"),
        f"Stopped: {posterior.reason}; at least {min(posterior.ess.values()):.0f} effective draws, R-hat at most "
        f"{max(posterior.rhat.values()):.4f}, {text.percent(failed) if failed else 'none'} of the proposals failed.",
    )


def _data(evidence: Evidence) -> Answer:
    verdicts = evidence.identifiability.verdicts
    good = sum(verdict == DETERMINED for verdict in verdicts.values())
    label = f"{good} of {len(verdicts)}"
    words = _listed((name, verdict) for name, verdict in verdicts.items() if verdict != DETERMINED)
    return Answer(
        "Do the data determine the parameters?",
        Badge(GOOD if good == len(verdicts) else CAUTION, label),
        f"{words}." if words else "Every free parameter is determined by the data.",
    )


def _laplace(evidence: Evidence) -> Answer:
    question, found = "Is the Laplace approximation good enough?", evidence.comparison
    if found is None:
        return Answer(question, Badge(NEUTRAL, "not tested"), "That takes draws.")
    others = _listed((name, verdict) for name, verdict in found.table["verdict"].items() if verdict != FINE)
    return Answer(
        question,
        badge(str(found.joint["verdict"])),
        f"Jointly: {found.joint['recommendation']}." + (f" By itself {others}." if others else ""),
    )


def _model(evidence: Evidence) -> Answer:
    question, found = "Does the model explain the data?", evidence.prediction
    if found is None:
        return Answer(question, Badge(NEUTRAL, "not tested"), evidence.unpredicted or "That takes draws.")
    words = {
        MISSPECIFIED: f"Tests say no for {', '.join(found.findings)}.",
        ADEQUATE: "No test contradicts the model.",
    }.get(found.verdict, "There are too few values to test it.")
    return Answer(question, badge(found.verdict), words)


def _listed(pairs: Iterable[tuple[object, object]]) -> str:
    return "; ".join(f"{name}: {verdict}" for name, verdict in pairs)


def _parameters(evidence: Evidence) -> Table:
    by = "Laplace, Student’s t" if evidence.posterior is None else "MCMC"
    robust = evidence.fit.interval(PROBABILITY, robust=True) if too_sure(evidence) else {}
    laplace = {} if evidence.comparison is None else dict(evidence.comparison.table["verdict"])
    columns = [
        Column("Parameter", numeric=False),
        Column("Unit", numeric=False),
        Column("MAP"),
        Column("90 % interval"),
        *([Column("robust 90 % interval")] if robust else []),
        Column("The data say", numeric=False),
        *([Column("Laplace is", numeric=False)] if laplace else []),
    ]
    intervals, rows = evidence.fit.interval(PROBABILITY), []
    for name, value in evidence.fit.theta.items():
        rounding = text.Rounding.of(value, evidence.fit.sd[name])
        drawn = mcmc_cells(evidence, name, rounding)
        row: Row = (
            code(name),
            evidence.unit(name),
            rounding.text(value),
            drawn[-1] if drawn else rounding.interval(*intervals[name]),
            *([rounding.interval(*robust[name])] if robust else []),
            badge(evidence.identifiability.verdicts[name]),
            *([badge(laplace[name])] if laplace else []),
        )
        rows.append(row)
    caption = f"The free parameters in short; the 90 % interval is by {by}."
    return Table("table-summary", caption, tuple(columns), tuple(rows))
