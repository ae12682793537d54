"""The report, written whole or not at all."""

import importlib.metadata
import platform
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bayesperiodic._io import in_folder, written_whole
from bayesperiodic.diagnostics.adequacy import ADEQUATE, MISSPECIFIED
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.identifiability import DETERMINED, Identifiability
from bayesperiodic.diagnostics.predictive import Prediction
from bayesperiodic.diagnostics.verdicts import FINE
from bayesperiodic.estimation.map_estimate import remarks
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.reporting import figures, html, inputs, results
from bayesperiodic.reporting.html import (
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
    Paragraph,
    Row,
    Section,
    Table,
    code,
    page,
)
from bayesperiodic.reporting.inputs import Evidence
from bayesperiodic.reporting.results import PROBABILITY, badge, mcmc_cells, too_sure
from bayesperiodic.sampling.checkpoint import fingerprint
from bayesperiodic.sampling.posterior import Posterior

PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "xarray", "matplotlib")


def record_section(evidence: Evidence) -> Section:
    """Return settings and versions."""
    settings = _of_the_fit(evidence) | ({} if evidence.posterior is None else _of_the_draws(evidence.posterior))
    return Section(
        "record",
        "How this was made",
        [
            _two_columns("table-settings", "Settings.", ("Setting", "Value"), settings),
            _two_columns(
                "table-versions", "Versions in use when this page was written.", ("Program", "Version"), versions()
            ),
        ],
    )


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that matter."""
    return {"Python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}


def _of_the_fit(evidence: Evidence) -> dict[str, str]:
    problem, fit = evidence.problem, evidence.fit
    shifts = {name: abs(shift) for name, shift in fit.doubling_shift.items() if np.isfinite(shift)}
    worst = max(shifts, key=lambda name: shifts[name], default="")
    steps, starts = html.counted("step", len(fit.history) - 1), html.counted("start", len(fit.starts))
    finer = f"{html.number(shifts[worst], 2)} sd ({worst})" if worst else "not known"
    return {
        "Problem": fingerprint(problem).removeprefix("problem "),
        "Difference scheme": find_scheme(problem.scheme).name,
        "Noise model": repr(problem.noise),
        "Search for the MAP": f"{fit.status}, {steps}, {starts}",
        "Largest move of an estimate on twice as many points": finer,
        "Degrees of freedom": html.number(fit.degrees_of_freedom, 5),
    }


def _of_the_draws(posterior: Posterior) -> dict[str, str]:
    group, made_by = posterior.data["posterior"], posterior.data.attrs
    chains, steps = group.sizes["chain"], group.sizes["draw"]
    ensembles = np.unique(group["ensemble"].to_numpy()).size
    return {
        "Seed": str(posterior.seed),
        "Draws": f"{ensembles} ensembles, {chains // ensembles} chains each, {steps} draws a chain",
        "Drawn with": ", ".join(
            f"{name} {made_by[name]}" for name in ("bayesperiodic", "emcee", "nutpie") if name in made_by
        ),
    }


def _two_columns(id: str, caption: str, heads: tuple[str, str], content: dict[str, str]) -> Table:
    columns = tuple(Column(head, numeric=False) for head in heads)
    return Table(id, caption, columns, tuple((name, code(value)) for name, value in content.items()))


def summary_section(evidence: Evidence) -> Section:
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
    shares = ", ".join(f"{html.percent(share)} of the variance of {channel}" for channel, share in fit.fvu.items())
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
        f"{max(posterior.rhat.values()):.4f}, {html.percent(failed) if failed else 'none'} of the proposals failed.",
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
        rounding = html.Rounding.of(value, evidence.fit.sd[name])
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


def sampling_section(posterior: Posterior) -> Section:
    """Return the diagnostics of the draws."""
    blocks: list[Block] = []
    if not posterior.converged:
        blocks.append(
            Note(BAD, f"The draws have NOT CONVERGED, and what rests on them is provisional: {posterior.reason}.")
        )
    failed = ", ".join(f"{status} {html.percent(share)}" for status, share in posterior.failures.items() if share)
    blocks.append(
        Paragraph(
            f"Stopped: {posterior.reason}; {posterior.log_posterior_calls} evaluations of the "
            f"posterior, {html.percent(posterior.acceptance)} of the proposals accepted. Periodic solves that failed, "
            f"of all proposals: {failed or 'none'}."
        )
    )
    columns = (
        Column("Quantity", numeric=False),
        Column("Effective sample size"),
        Column("Autocorrelation time [steps]"),
        Column("R-hat between ensembles"),
    )
    rows = [
        (
            code(name),
            f"{posterior.ess[name]:.0f}",
            html.number(posterior.tau[name], 3),
            f"{posterior.rhat[name]:.4f}",
        )
        for name in posterior.names
    ]
    blocks += [
        Table("table-sampling", "Diagnostics of the draws, in sampling coordinates.", columns, tuple(rows)),
        figures.traces(posterior),
    ]
    return Section("sampling", "Sampling", blocks)


def report(
    problem: Problem,
    fit: MapEstimate,
    posterior: Posterior | None,
    path: str | Path,
    *,
    title: str | None = None,
    comparison: Comparison | None = None,
    identifiability: Identifiability | None = None,
    prediction: Prediction | None = None,
) -> Path:
    """Write one HTML page about an identification, for people who do not run Python.

    It tells of the data, the model with its equations, the estimates (MAP, Laplace and MCMC side by side, with units),
    the residual, the verdicts in words, the sampler's diagnostics, settings, seed and versions, with figures. It is a
    single file without scripts that needs no network: figures are vector graphics within it, equations MathML. It reads
    on a phone, in light and dark, and by screen readers, and is written whole or not at all. Whatever it is given as
    text is escaped.

    Verdicts that are not given are computed: a few seconds. Only the profiles of `identifiability` are left out then,
    because they solve anew for every parameter; give ``identifiability=bp.identifiability(problem, fit, posterior)`` to
    have them weighed too.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior or None
        Without draws the page has no MCMC, no comparison and no test of the model.
    path : path
        Of the file, such as "report.html"; an older one is replaced when the new one is complete.
    title : str, optional
        By default the model's name.
    comparison : Comparison, optional
        Such as ``bp.compare(problem, fit, posterior)``.
    identifiability : Identifiability, optional
    prediction : Prediction, optional
        Such as ``bp.predict(problem, posterior)``.

    Returns
    -------
    Path
        Where the page is.

    Raises
    ------
    ValueError
        If the fit, the posterior or a verdict is of another problem.
    FileNotFoundError
        If the folder of `path` does not exist.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(50) / 50)
    >>> true = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                          frequency=0.1, samples=50, scheme="central4")
    >>> run = bp.Experiment("run", 0.1, true.outputs, {"force": force}, samples=50)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.Normal(0.2, 0.1), "k": bp.Normal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5, "variance[displacement]": 1e-4}, scheme="central4")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = bp.report(problem, fit, None, f"{folder}/report.html").read_text(encoding="utf-8")
    >>> page[:15], "<script" in page
    ('<!DOCTYPE html>', False)
    """
    target = in_folder(path)
    evidence = Evidence.of(problem, fit, posterior, identifiability, comparison, prediction)
    sections = [summary_section(evidence), inputs.data_section(evidence), inputs.model_section(evidence)]
    sections += [
        results.estimates_section(evidence),
        results.residuals_section(evidence),
        results.verdicts_section(evidence),
    ]
    sections += [] if posterior is None else [sampling_section(posterior)]
    sections.append(record_section(evidence))
    written = page(
        title or problem.model.name,
        _subtitle(problem),
        _badges(evidence),
        sections,
        datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )
    with written_whole(target) as draft:
        draft.write_text(written, encoding="utf-8")
    return target


def _subtitle(problem: Problem) -> str:
    free, runs = (
        html.counted("free parameter", len(problem.names)),
        html.counted("experiment", len(problem.experiments)),
    )
    values = f"{problem.counted:.0f} independent values of {', '.join(problem.channels)}"
    return f"Model {problem.model.name}, {free}, {runs} with {values}"


def _badges(evidence: Evidence) -> list[Badge]:
    """Return what a reader must know before anything else."""
    found = [Badge(CAUTION, "synthetic data") if evidence.synthetic else Badge(NEUTRAL, "measured data")]
    if not evidence.fit.converged:
        found.append(Badge(BAD, f"fit {evidence.fit.status}"))
    if evidence.posterior is None:
        found.append(Badge(NEUTRAL, "no draws"))
    elif not evidence.posterior.converged:
        found.append(Badge(BAD, "draws NOT CONVERGED"))
    return found
