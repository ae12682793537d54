"""The report of an identification: one self-contained HTML page, for readers who do not run Python."""

from datetime import UTC, datetime
from pathlib import Path

from bayesperiodic import plot
from bayesperiodic._files import in_folder, written_whole
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.comparison import Comparison
from bayesperiodic.diagnostics.identifiability import Identifiability
from bayesperiodic.diagnostics.missing_terms import MissingTerms
from bayesperiodic.diagnostics.predictive import Prediction
from bayesperiodic.estimation.adequacy import ADEQUACY_LEVEL
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.reporting import contents, html, pictures
from bayesperiodic.sampling.draws import Posterior


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
    missing: MissingTerms | None = None,
) -> Path:
    """Write an HTML report of an identification.

    The report contains what was found in the recordings, the data, the model with its equations, the estimates (MAP,
    Laplace and MCMC side by side), the residual, the verdicts, the diagnostics of the sampler, and settings, seed and
    versions, with figures. It is a single accessible file without external resources: figures are embedded SVG images,
    equations MathML. All text is escaped. An existing file is replaced only by a complete one.

    Where the browser runs its script, values are read from the figures by pointer, keyboard or screen reader,
    experiments, channels and curves are shown or hidden, and figures are enlarged. Without it the report is complete.

    Diagnostics that are not given are computed in a few seconds, except the profiles of `identifiability`, which solve
    anew for every parameter, and the search for missing terms: to include them, give
    ``identifiability=bp.identifiability(problem, fit, posterior)`` and ``missing=bp.missing_terms(problem, fit)``.

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
    identifiability : Identifiability, optional
    prediction : Prediction, optional
    missing : MissingTerms, optional
        By default there is no section on missing terms.

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
    >>> page[:15], 'src="http' in page
    ('<!DOCTYPE html>', False)
    """
    in_folder(path)
    text = html.page(
        title=title or problem.model.name,
        given=contents.ReportInputs(problem, fit, posterior, identifiability, comparison, prediction, missing),
        content=contents,
        pictures=pictures,
        plot=plot,
        level=ADEQUACY_LEVEL,
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )
    with written_whole(path) as draft:
        draft.write_text(text, encoding="utf-8")
    return Path(path)
