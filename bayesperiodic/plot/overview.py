"""One page on an identification: fit, residual, the two worst parameters, and the verdicts in words."""

import textwrap
from collections.abc import Iterator
from typing import Any, cast

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.comparison import Comparison, compare
from bayesperiodic.diagnostics.identifiability import DETERMINED, Identifiability, identifiability
from bayesperiodic.diagnostics.verdicts import FINE
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.plot.estimates import draw_period
from bayesperiodic.plot.pairs import corner
from bayesperiodic.plot.style import OF_TABLES, axis_label, styled
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.sampling.draws import Posterior

LINE_LENGTH, MOST_NAMES_LISTED = 58, 6
SMALLEST_WHITE_P = 0.01


@styled
def summary(problem: Problem, fit: MapEstimate, posterior: Posterior, *, figure: Figure | None = None) -> Figure:
    """Draw one page of four panels: fit, residual, corner plot of the two worst parameters, and verdicts in words.

    The channel is the one that is explained worst, in the experiment where its residual is largest. The worst
    parameters are those that are not determined, then those that the Laplace approximation describes wrongly, then
    those with the smallest contraction. Verdicts are those of `identifiability`, without profiles, and of `compare`.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior
    figure : Figure, optional
        To draw into: empty.

    Examples
    --------
    >>> figure = bp.plot.summary(problem, fit, posterior)
    >>> [axes.get_ylabel() for axes in figure.axes[:2]]
    ['displacement [m]', 'residual [m]']
    """
    problem = check_results(problem, fit=fit, posterior=posterior)
    if not problem.channels:
        raise ValueError(f"problem: must have time histories, got none; {OF_TABLES}.")
    identified, compared = identifiability(problem, fit, posterior, profile=False), compare(problem, fit, posterior)
    figure = figure or plt.figure(figsize=(10.0, 5.6))
    parts: Any = figure.subfigures(1, 2, width_ratios=[1.15, 1.0])
    left, right = parts
    above, below = right.subfigures(2, 1, height_ratios=[1.7, 1.0])
    channel = max(problem.channels, key=lambda name: fit.fvu[name])
    having = [e for e in problem.experiments if channel in e.outputs]
    worst = max(having, key=lambda e: float((fit.residuals[e.name][channel] ** 2).sum()))
    room = {"left": 0.15, "right": 0.97, "bottom": 0.1, "top": 0.93, "hspace": 0.08, "height_ratios": [2.2, 1.0]}
    top, bottom = left.subplots(2, 1, sharex=True, gridspec_kw=room)
    draw_period(top, bottom, problem, fit, worst, channel)
    names = _worst(problem, posterior, identified, compared)
    corner(posterior, laplace=fit, problem=problem, names=names, figure=cast(Figure, above))
    words = _words(fit, posterior, identified, compared)
    text = "\n".join(textwrap.fill(line, LINE_LENGTH, subsequent_indent="   ") for line in words)
    below.text(0.02, 0.97, axis_label(text), va="top", linespacing=1.35)
    return figure


def _worst(problem: Problem, posterior: Posterior, identified: Identifiability, compared: Comparison) -> list[str]:
    """Return the two worst parameters in the order of the problem; of one parameter it and a noise parameter."""
    fine = compared.table["verdict"].reindex(identified.table.index, fill_value=FINE) == FINE
    ranks = identified.table.assign(determined=identified.table["verdict"] == DETERMINED, fine=fine)
    worst = ranks.sort_values(["determined", "fine", "contraction"], kind="stable").index[:2]
    others = [name for name in posterior.names if name not in problem.names]
    return [*(name for name in problem.names if name in worst), *others][:2]


def _words(fit: MapEstimate, posterior: Posterior, identified: Identifiability, compared: Comparison) -> Iterator[str]:
    for channel, unexplained in fit.fvu.items():
        p = fit.whiteness[channel].p
        white = "" if p != p else f"; the residual is {'white' if p > SMALLEST_WHITE_P else 'NOT white'} (p = {p:.2g})"
        yield f"Fit: {100.0 * (1.0 - unexplained):.4g} % of the variance of {channel} explained{white}."
    for verdict, members in identified.table.groupby("verdict", sort=False).groups.items():
        names = [str(name) for name in members]
        more = f" and {len(names) - MOST_NAMES_LISTED} more" if len(names) > MOST_NAMES_LISTED else ""
        yield f"{str(verdict).capitalize()}: {', '.join(names[:MOST_NAMES_LISTED])}{more}."
    for name, remedy in [(n, text) for n, text in identified.table["remedy"].items() if text][:1]:
        yield f"Recommendation for {name}: {remedy}."
    joint = compared.joint
    advice = f"; {joint['recommendation']}" if joint["verdict"] != FINE else ""
    yield f"Laplace approximation: {joint['verdict']}{advice}."
    size = min(posterior.ess.values())
    yield f"Draws: {'converged' if posterior.converged else 'NOT CONVERGED'}, {size:.0f} effective ones."
