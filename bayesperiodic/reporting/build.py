"""The HTML report: its first and last sections, and the page as a whole."""

import importlib.metadata
import platform
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bayesperiodic import plot
from bayesperiodic._io import in_folder, written_whole
from bayesperiodic.diagnostics.adequacy import ADEQUATE, MISSPECIFIED, UNTESTED
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.identifiability import DETERMINED, Identifiability
from bayesperiodic.diagnostics.predictive import PROBABILITY, Prediction
from bayesperiodic.diagnostics.verdicts import FINE
from bayesperiodic.estimation.map_estimate import remarks
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.reporting import html, inputs, results
from bayesperiodic.reporting.inputs import ReportInputs
from bayesperiodic.reporting.results import badge, embedded, mcmc_cells, underestimated_sds
from bayesperiodic.sampling.checkpoint import fingerprint
from bayesperiodic.sampling.posterior import Posterior

PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "xarray", "matplotlib")


def summary_section(given: ReportInputs) -> html.Section:
    """Return the summary: the main findings, the warnings and the free parameters."""
    blocks: list[html.Block] = [
        html.Findings((_estimate(given), _draws(given), _data(given), _laplace(given), _model(given))),
        *(html.Note(html.CAUTION, text) for text in (*remarks(given.problem, given.fit), *underestimated_sds(given))),
        _parameters(given),
    ]
    return html.Section("summary", "Summary", blocks)


def _estimate(given: ReportInputs) -> html.Finding:
    fit = given.fit
    unexplained = ", ".join(f"{html.percent(f)} of the variance of {channel}" for channel, f in fit.fvu.items())
    return html.Finding(
        "Did the search converge?",
        html.Badge(html.GOOD if fit.converged else html.BAD, fit.status),
        f"The search took {len(fit.history) - 1} steps. The fit leaves {unexplained} unexplained.",
    )


def _draws(given: ReportInputs) -> html.Finding:
    question, posterior = "Have the draws converged?", given.posterior
    if posterior is None:
        text = "The posterior was not sampled; intervals are those of the Laplace approximation."
        return html.Finding(question, html.Badge(html.NEUTRAL, "no draws"), text)
    failed = sum(posterior.failures.values())
    return html.Finding(
        question,
        html.Badge(html.GOOD, "converged") if posterior.converged else html.Badge(html.BAD, "not converged"),
        f"Stopped: {posterior.reason}; effective sample size at least {given.summary['ess'].min():.0f}, R-hat at most "
        f"{given.summary['rhat'].max():.4f}, {html.percent(failed) if failed else 'none'} of the proposals failed.",
    )


def _data(given: ReportInputs) -> html.Finding:
    verdicts = given.identifiability.verdicts
    others = [f"{name}: {verdict}" for name, verdict in verdicts.items() if verdict != DETERMINED]
    return html.Finding(
        "Do the data determine the parameters?",
        html.Badge(html.CAUTION if others else html.GOOD, f"{len(verdicts) - len(others)} of {len(verdicts)}"),
        f"{'; '.join(others) or 'Every free parameter is determined by the data'}.",
    )


def _laplace(given: ReportInputs) -> html.Finding:
    question, found = "Is the Laplace approximation accurate?", given.comparison
    if found is None:
        return html.Finding(question, badge(UNTESTED), "This requires draws.")
    others = [f"{name}: {verdict}" for name, verdict in found.table["verdict"].items() if verdict != FINE]
    text = f"Jointly: {found.joint['recommendation']}." + (f" Marginally {'; '.join(others)}." if others else "")
    return html.Finding(question, badge(str(found.joint["verdict"])), text)


def _model(given: ReportInputs) -> html.Finding:
    question, found = "Does the model explain the data?", given.prediction
    if found is None:
        return html.Finding(question, badge(UNTESTED), given.no_prediction or "This requires draws.")
    text = {
        MISSPECIFIED: f"The tests reject the model for {', '.join(found.findings)}.",
        ADEQUATE: "No test contradicts the model.",
    }.get(found.verdict, "There are too few values for a test.")
    return html.Finding(question, badge(found.verdict), text)


def _parameters(given: ReportInputs) -> html.Table:
    fit, intervals, rows = given.fit, given.fit.interval(PROBABILITY), []
    robust = fit.interval(PROBABILITY, robust=True) if given.robust_ratios else {}
    laplace = {} if given.comparison is None else dict(given.comparison.table["verdict"])
    for name, value in fit.theta.items():
        rounding = html.Rounding.of(value, fit.sd[name])
        drawn = mcmc_cells(given, name, rounding)
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


def sampling_section(given: ReportInputs, posterior: Posterior) -> html.Section:
    """Return the section on the convergence of the draws."""
    blocks: list[html.Block] = []
    if not posterior.converged:
        text = f"The draws have NOT CONVERGED, and all results from them are provisional: {posterior.reason}."
        blocks.append(html.Note(html.BAD, text))
    failed = ", ".join(f"{status} {html.percent(rate)}" for status, rate in posterior.failures.items() if rate)
    rows = [
        {
            "Quantity": html.code(str(name)),
            "Effective sample size": html.Number(f"{row['ess']:.0f}"),
            "Autocorrelation time [steps]": html.number(row["tau"], 3),
            "R-hat between ensembles": html.Number(f"{row['rhat']:.4f}"),
        }
        for name, row in given.summary.iterrows()
    ]
    blocks += [
        html.Paragraph(
            f"Stopped: {posterior.reason}; {posterior.log_posterior_calls} evaluations of the posterior density, "
            f"{html.percent(posterior.acceptance)} of the proposals accepted. Proposals with a failed periodic solve: "
            f"{failed or 'none'}."
        ),
        html.Table("table-sampling", "Convergence of the draws, in sampling coordinates.", rows),
        html.Figure(
            "figure-traces",
            embedded(plot.traces(posterior, walkers=2), "traces"),
            f"Traces of some walkers of each ensemble for {', '.join(posterior.names)}; the largest R-hat is "
            f"{given.summary['rhat'].max():.4f}.",
            "Traces of some walkers; each colour is an independent ensemble.",
            wide=True,
        ),
    ]
    return html.Section("sampling", "Sampling", blocks)


def record_section(given: ReportInputs) -> html.Section:
    """Return the section on settings and versions."""
    problem, fit, posterior = given.problem, given.fit, given.posterior
    shifts = {name: abs(shift) for name, shift in fit.doubling_shift.items() if np.isfinite(shift)}
    worst = max(shifts, key=lambda name: shifts[name], default="")
    steps, starts = html.counted("step", len(fit.history) - 1), html.counted("start", len(fit.starts))
    settings = {
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
        settings |= {
            "Seed": str(posterior.seed),
            "Draws": f"{count} ensembles, {chains // count} chains each, {draws} draws per chain",
            "Drawn with": ", ".join(programs),
        }
    versions = {"Python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}
    rows = [{"Setting": name, "Value": html.code(value)} for name, value in settings.items()]
    programs_used = [{"Program": name, "Version": html.code(value)} for name, value in versions.items()]
    return html.Section(
        "record",
        "Settings and versions",
        [
            html.Table("table-settings", "Settings.", rows),
            html.Table("table-versions", "Versions in use when this page was written.", programs_used),
        ],
    )


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
    """Write an HTML report of an identification.

    The report contains the data, the model with its equations, the estimates (MAP, Laplace and MCMC side by side), the
    residual, the verdicts, the diagnostics of the sampler, and settings, seed and versions, with figures. It is a
    single accessible file without scripts or external resources: figures are embedded SVG images, equations MathML. All
    text is escaped. An existing file is replaced only by a complete one.

    Diagnostics that are not given are computed in a few seconds, except the profiles of `identifiability`, which solve
    anew for every parameter: to include them, give ``identifiability=bp.identifiability(problem, fit, posterior)``.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior or None
        Without draws the report has no MCMC results, no comparison and no test of the model.
    path : path
        Of the file, such as "report.html".
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
        Of the file.

    Raises
    ------
    ValueError
        If the fit, the posterior or a diagnosis is of another problem.
    FileNotFoundError
        If the folder of `path` does not exist.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = bp.report(problem, fit, None, f"{folder}/report.html").read_text(encoding="utf-8")
    >>> page[:15], "<script" in page
    ('<!DOCTYPE html>', False)
    """
    target = in_folder(path)
    given = ReportInputs.of(problem, fit, posterior, identifiability, comparison, prediction)
    sections = [
        summary_section(given),
        inputs.data_section(given),
        inputs.model_section(given),
        results.estimates_section(given),
        results.residuals_section(given),
        results.verdicts_section(given),
        *([] if posterior is None else [sampling_section(given, posterior)]),
        record_section(given),
    ]
    written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    text = html.page(title or problem.model.name, _subtitle(problem), _badges(given), sections, written)
    with written_whole(target) as draft:
        draft.write_text(text, encoding="utf-8")
    return target


def _subtitle(problem: Problem) -> str:
    free = html.counted("free parameter", len(problem.names))
    runs = html.counted("experiment", len(problem.experiments))
    values = f"{problem.counted:.0f} independent values of {', '.join(problem.channels)}"
    return f"Model {problem.model.name}, {free}, {runs} with {values}"


def _badges(given: ReportInputs) -> list[html.Badge]:
    tone, data = (html.CAUTION, "synthetic") if given.synthetic else (html.NEUTRAL, "measured")
    found = [html.Badge(tone, f"{data} data")]
    if not given.fit.converged:
        found.append(html.Badge(html.BAD, f"fit {given.fit.status}"))
    if given.posterior is None:
        found.append(html.Badge(html.NEUTRAL, "no draws"))
    elif not given.posterior.converged:
        found.append(html.Badge(html.BAD, "draws NOT CONVERGED"))
    return found
