"""Figure of the terms that a model lacks: what each leaves unexplained, and the residual that led to the first."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from bayesperiodic import _checks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.candidates import of_elements
from bayesperiodic.diagnostics.missing_terms import MissingTerms
from bayesperiodic.diagnostics.score_tests import along_orbit
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.periodic.harmonics import harmonics, sampled
from bayesperiodic.plot import style
from bayesperiodic.plot.style import COLOURS, ENSEMBLES, axis_label, styled
from bayesperiodic.problem.fingerprint import check_results, fingerprint

# Colours without another meaning, one for each channel; and that of the residual with the terms.
CHANNELS, AFTER = ENSEMBLES[1:4], ENSEMBLES[2]
HELD_OUT_STYLE: dict[str, Any] = {"color": "grey", "ls": ":", "marker": "s", "ms": 4, "mfc": "white"}
# Values that are written above each other [decades], the distance of these lines [points], and the part of the axis to
# the left of the points, for them.
SIDE_BY_SIDE, LINE_HEIGHT, ROOM_FOR_VALUES = 0.5, 10, 0.5


@styled
def missing_terms(problem: Problem, fit: MapEstimate, found: MissingTerms, *, figure: Figure | None = None) -> Figure:
    """Draw what each term leaves unexplained, and the residual before and after.

    Left: fraction of the variance of each channel that is unexplained, and the mean of it in experiments that were left
    out of the fit, where known. Right: the residuals of the given model and with all terms, of the channel that the
    first term acts on (for a term in an equation, the channel that is explained worst), in the experiment where it is
    largest, against the variable of the first term. Of a term of several variables the one with the highest power is
    across, and the first of the others is the colour. For a constant, or if no term was found, the residual is drawn
    over the time in the period, as for terms that were loaded from a file. Variables are those of the given fit.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    found : MissingTerms

    Examples
    --------
    >>> figure = bp.plot.missing_terms(problem, fit, bp.missing_terms(problem, fit, max_terms=0))
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['unexplained variance', 'time in the period [s]']
    """
    problem = check_results(problem, fit=fit)
    _checks.instance("found", found, MissingTerms)
    if found.fit(0).fingerprint != fingerprint(problem):
        raise ValueError(
            "found: must be what missing_terms(problem, fit) returns for this problem, got terms of another problem."
        )
    shown = {"given model": fit}
    if count := len(found.steps):
        shown[f"with {found.steps[0].term}" if count == 1 else f"with {count} terms"] = found.fit()
    size = (3.6 + 3.4 * len(shown), 3.2 + 0.35 * len(found.steps))
    figure = figure or plt.figure(figsize=size, layout="constrained")
    left, *right = figure.subplots(1, 1 + len(shown))
    _steps(left, found)
    _residuals(right, problem, found, shown)
    figure.suptitle(style.caveats(any(e.synthetic for e in problem.experiments), converged=True), fontsize="medium")
    return figure


def _steps(axes: Axes, search: MissingTerms) -> None:
    """Draw the fraction of the variance that every model leaves unexplained, the given one at the top."""
    models = (search.before, *search.steps)
    rows = np.arange(len(models))
    held_out = np.array([step.held_out for step in models])
    if np.isfinite(held_out).any():
        axes.plot(held_out, rows, label="experiments left out", **HELD_OUT_STYLE)
    values = {name: np.array([step.unexplained[name] for step in models]) for name in search.before.unexplained}
    written = np.empty((0, len(rows)))
    for number, (channel, left) in enumerate(values.items()):
        colour = CHANNELS[number % len(CHANNELS)]
        axes.plot(left, rows, "o-", color=colour, lw=1.6, ms=5, label=axis_label(channel))
        with np.errstate(divide="ignore", invalid="ignore"):
            below = np.sum(np.abs(np.log10(written / left)) < SIDE_BY_SIDE, axis=0)
        written = np.vstack([written, left])
        for row, value, lines in zip(rows, left, below, strict=True):
            place, text = (-5, 1 + LINE_HEIGHT * lines), f"{100.0 * value:.2g} %"
            axes.annotate(text, (value, row), place, textcoords="offset points", ha="right", va="bottom", color=colour)
    known = np.concatenate([held_out, *values.values()])
    known = known[np.isfinite(known) & (known > 0.0)]
    axes.set(xscale="log", xlabel="unexplained variance", ylim=(len(models) - 0.6, -0.6))
    if known.size:
        low, high = np.log10([known.min(), known.max()])
        width = max(high - low, 1.0)
        axes.set_xlim(10.0 ** (low - ROOM_FOR_VALUES * width), 10.0 ** (high + 0.1 * width))
    axes.set_yticks(rows, ["given model", *(axis_label(f"+ {step.term}\nin {step.place}") for step in search.steps)])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="x", color="0.9")
    axes.legend(frameon=False, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)


def _residuals(panels: list[Axes], problem: Problem, search: MissingTerms, shown: dict[str, MapEstimate]) -> None:
    """Draw one channel's residual of each estimate against a variable of the first term, coloured by another."""
    fit = next(iter(shown.values()))
    place = search.steps[0].place if search.steps else ""
    channel = place if place in problem.channels else max(fit.fvu, key=lambda name: fit.fvu[name])
    if channel not in problem.channels:
        raise ValueError(f"problem: must have time histories, got none of {channel!r}; {style.OF_TABLES}.")
    having = [e for e in problem.experiments if channel in e.outputs]
    e = max(having, key=lambda run: float(np.sum(fit.residuals[run.name][channel] ** 2)))
    (across, x), *others = _variables(problem, fit, search, e).items()
    mask = e.measured_points
    reach = 1.08 * max(float(np.abs(estimate.residuals[e.name][channel][mask]).max()) for estimate in shown.values())
    points: Any = None
    for number, (axes, (title, estimate)) in enumerate(zip(panels, shown.items(), strict=True)):
        residual = estimate.residuals[e.name][channel]
        axes.axhline(0.0, color="grey", lw=0.8, zorder=0)
        if others:
            colour = others[0][1][mask]
            points = axes.scatter(x[mask], residual[mask], 10, colour, cmap="coolwarm", linewidths=0, rasterized=True)
        else:
            look = AFTER if number else COLOURS["measured"]
            axes.plot(x[mask], residual[mask], ".", ms=4, color=look, rasterized=True)
        axes.set(xlabel=across, ylim=(-reach, reach))
        axes.set_title(axis_label(title), fontsize="medium")
        axes.locator_params(axis="x", nbins=4)
        if number:
            axes.tick_params(labelleft=False)
    where = f" in {e.name}" * (len(problem.experiments) > 1)
    panels[0].set_ylabel(axis_label(f"residual of {channel}{where}", problem.model.units.get(channel, "")))
    if others:
        panels[0].figure.colorbar(points, ax=panels, label=others[0][0], pad=0.02)


def _variables(problem: Problem, fit: MapEstimate, search: MissingTerms, e: Experiment) -> dict[str, np.ndarray]:
    """Return the variables of the first term along an orbit, by their labels; the time for a term without any."""
    model = of_elements(problem.model) if isinstance(problem.model, CondensedModel) else problem.model
    if search._terms:
        term, _ = search._terms[search.steps[0].name]
        expression = term.force or term.expression
        names = model.state_symbols | model.input_symbols
        powers = {
            name: sp.degree(expression, symbol) if expression.is_polynomial(symbol) else 1
            for name, symbol in names.items()
            if symbol in expression.free_symbols
        }
        chosen = sorted(powers, key=lambda name: -powers[name])
        if chosen:
            listed = [names[name] for name in chosen]
            values = along_orbit(problem, problem.vector(fit.theta), e, fit.solutions[e.name], listed)
            if values.shape[1] != e.time.size:  # of a condensed model
                values = sampled(harmonics(values.T), e.time.size).T
            return {_label(model, name): column for name, column in zip(chosen, values, strict=True)}
    return {"time in the period [s]": e.time}


def _label(model: Model, name: str) -> str:
    """Return the label of a variable of the model by its name there, of a derivative as that of the variable."""
    order = next(k for k in range(3) if name[k:] in (*model.states, *model.inputs))
    plain, unit = name[order:], model.units.get(name[order:], "")
    text = ("", "rate of ", "second derivative of ")[order] + plain
    return axis_label(text, f"{unit or '1'}{('', '/s', '/s²')[order]}" if order else unit)
