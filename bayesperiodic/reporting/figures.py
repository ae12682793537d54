"""Figures of the package within the page, as vector graphics that need no other file."""

import base64
import io
from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure as Drawing

from bayesperiodic import plot
from bayesperiodic.reporting import html
from bayesperiodic.reporting.html import Figure
from bayesperiodic.reporting.inputs import Evidence
from bayesperiodic.sampling.posterior import Posterior

MOST = 7


def embedded(drawing: Drawing, name: str) -> str:
    """Return a figure as the data address of a vector graphic, the same for the same figure, and close it."""
    buffer = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    plt.close(drawing)
    return f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def fits(evidence: Evidence) -> Iterator[Figure]:
    """Give a figure an experiment: measured and fitted periods, and the residual."""
    problem, fit, prediction = evidence.problem, evidence.fit, evidence.prediction
    for place, e in enumerate(problem.experiments):
        channels = ", ".join(f"{channel} [{evidence.unit(channel)}]" for channel in e.outputs)
        band = f", the {prediction.probability:.0%} predictive band of the draws" if prediction else ""
        residual = ", ".join(
            f"{html.number(float(np.sqrt(np.mean(fit.residuals[e.name][channel] ** 2))))} {evidence.unit(channel)}"
            for channel in e.outputs
        )
        yield Figure(
            f"figure-fit-{place + 1}",
            embedded(plot.fit(problem, fit, prediction, experiments=[e.name]), f"fit {place}"),
            f"Line plot over one period of experiment {e.name}: measured {channels}, the MAP fit on top{band}, and the "
            f"residual below; its root mean square is {residual}.",
            f"{e.name}: one period of {', '.join(e.outputs)}, measured and fitted, and the residual.",
        )


def loops(evidence: Evidence) -> Figure:
    """Return the figure of the first output against the first input and its rate."""
    problem = evidence.problem
    output, given = problem.channels[0], problem.model.inputs[0]
    what = f"{output} against {given}, and against its rate"
    return Figure(
        "figure-loops",
        embedded(plot.loops(problem, evidence.fit), "loops"),
        f"Closed curves of {what}, measured and fitted, for {len(problem.experiments)} experiments.",
        f"Measured and fitted: {what}.",
        wide=True,
    )


def corner(evidence: Evidence, posterior: Posterior) -> Figure:
    """Return the figure of all pairs of parameters, of those most correlated where there are many."""
    names, every = most_correlated(posterior), posterior.names
    chosen = "" if len(names) == len(every) else f" Shown are the {len(names)} most correlated of {len(every)}."
    strongest = strongest_pair(posterior)
    return Figure(
        "figure-corner",
        embedded(plot.corner(posterior, laplace=evidence.fit, names=names), "corner"),
        f"Matrix of plots: marginal distributions of {', '.join(names)} on the diagonal, contours of their pairs below "
        f"it, from the draws and from the Laplace approximation.{strongest}",
        "Posterior of parameters and noise parameters: draws (MCMC) and the Laplace approximation, with the regions "
        f"that hold 50 and 90 %.{strongest}{chosen}",
        wide=True,
    )


def most_correlated(posterior: Posterior) -> tuple[str, ...]:
    """Return as many names as a figure can hold, those with the largest correlation first to be taken."""
    names = posterior.names
    if len(names) <= MOST:
        return names
    largest = np.max(np.abs(_correlations(posterior)), axis=0)
    kept = set(np.argsort(-largest, kind="stable")[:MOST].tolist())
    return tuple(name for i, name in enumerate(names) if i in kept)


def strongest_pair(posterior: Posterior) -> str:
    """Return the strongest correlation between two quantities, in words; nothing where there is but one."""
    if len(posterior.names) < 2:
        return ""
    matrix = _correlations(posterior)
    i, j = np.unravel_index(np.argmax(np.abs(matrix)), matrix.shape)
    names = posterior.names
    value = html.number(float(matrix[i, j]), 2)
    return f" The strongest correlation is {value}, of {names[min(i, j)]} and {names[max(i, j)]}."


def _correlations(posterior: Posterior) -> np.ndarray:
    """Return the correlations of all that was sampled, zero on the diagonal."""
    matrix = np.atleast_2d(np.corrcoef(np.stack([posterior.draws(name) for name in posterior.names])))
    np.fill_diagonal(matrix, 0.0)
    return np.nan_to_num(matrix)


def comparison(evidence: Evidence) -> Figure:
    """Return the figure of Laplace against MCMC."""
    found = evidence.comparison
    assert found is not None
    said = ", ".join(f"{name} {verdict}" for name, verdict in found.table["verdict"].items())
    return Figure(
        "figure-comparison",
        embedded(plot.comparison(found), "comparison"),
        "Marginal distributions of the draws with the Laplace approximation's on top, their quantiles against each "
        f"other, and the share of draws in Laplace's ellipsoids. Verdicts: {said}; jointly {found.joint['verdict']}.",
        "The Laplace approximation against the draws: marginal distributions, quantiles (the grey band is what passes) "
        "and ellipsoids.",
        wide=True,
    )


def traces(posterior: Posterior) -> Figure:
    """Return the figure of the walkers' paths."""
    return Figure(
        "figure-traces",
        embedded(plot.traces(posterior, walkers=2), "traces"),
        f"Paths of some walkers of each ensemble for {', '.join(posterior.names)}; the largest R-hat is "
        f"{max(posterior.rhat.values()):.4f}.",
        "Paths of some walkers; each colour is an independent ensemble.",
        wide=True,
    )
