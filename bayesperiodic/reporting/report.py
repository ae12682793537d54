"""The report, written whole or not at all."""

from datetime import UTC, datetime
from pathlib import Path

from bayesperiodic.diagnosis.comparison import Comparison
from bayesperiodic.diagnosis.identifiability import Identifiability
from bayesperiodic.diagnosis.predictive import Prediction
from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.reporting import data, estimates, model, record, residuals, sampling, summary, text, verdicts
from bayesperiodic.reporting.blocks import BAD, CAUTION, NEUTRAL, Badge
from bayesperiodic.reporting.evidence import Evidence
from bayesperiodic.reporting.page import page
from bayesperiodic.store import in_folder, written_whole


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
    sections = [summary.section(evidence), data.section(evidence), model.section(evidence)]
    sections += [estimates.section(evidence), residuals.section(evidence), verdicts.section(evidence)]
    sections += [] if posterior is None else [sampling.section(posterior)]
    sections.append(record.section(evidence))
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
        text.counted("free parameter", len(problem.names)),
        text.counted("experiment", len(problem.experiments)),
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
