"""Figures of populations: units, raw and shrunken, with the band of new units."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import _checks
from bayesperiodic.plot.style import COLOURS, caveats, chosen, panels, styled, wrapped_label
from bayesperiodic.sampling.population_result import PARAMETER, POPULATION_UNIT, Population

# Units that a panel can show with their names; points of the line over a covariate.
MOST_NAMED_UNITS, LINE_POINTS = 60, 15
BAND = (0.05, 0.5, 0.95)
RAW, SHRUNKEN = COLOURS["measured"], COLOURS["map"]


@styled
def population(
    result: Population,
    *,
    names: list[str] | None = None,
    covariate: str | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draw the units of a population: 90 % intervals of their own posteriors, and under the population.

    The band contains 90 % of new units; without `covariate` it is that at the mean covariates, and the units are one
    below the other. With it they are drawn over its values, the band about the line of the mean, other covariates at
    their means.

    Parameters
    ----------
    result : Population
    names : sequence of str, optional
        Parameters, one panel each; by default all.
    covariate : str, optional
        Of the population.

    Examples
    --------
    >>> units, spread = dict.fromkeys(["1", "2", "3"], posterior), {"k": bp.HalfNormal(0.01)}
    >>> springs = bp.population(units, ["k"], spread=spread, seed=1, progress=False)
    >>> len(bp.plot.population(springs).axes)
    1
    """
    _checks.instance("result", result, Population)
    if covariate is not None:
        _checks.one_of("covariate", covariate, result.covariates)
    names = list(chosen(names, result.names))
    units = result.units[POPULATION_UNIT].nunique()
    height = 3.2 if covariate else min(1.6 + 0.25 * units, 12.0)
    figure = figure or plt.figure(figsize=(3.4 * min(len(names), 3) + 0.8, height), layout="constrained")
    grid = panels(figure, len(names), across=3)
    for axes, name in zip(grid, names, strict=True):
        if covariate is None:
            _draw_forest(axes, result, name)
        else:
            _draw_line(axes, result, name, covariate)
    if covariate is None and units <= MOST_NAMED_UNITS:
        grid[0].set_yticks(range(units), list(dict.fromkeys(result.units[POPULATION_UNIT])))
    if remark := caveats(False, result.converged):
        figure.suptitle(remark)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _intervals(result: Population, name: str, start: str) -> tuple[np.ndarray, np.ndarray]:
    """Return medians (units,), and distances (2, units) of the ends of the 90 % intervals."""
    rows = result.units[result.units[PARAMETER] == name]
    low, middle, high = (rows[f"{start}{q}"].to_numpy() for q in ("q05", "q50", "q95"))
    return middle, np.stack([middle - low, high - middle])


def _label(result: Population, name: str) -> str:
    return wrapped_label(name, str(result.coordinates[name]["unit"]))


def _draw_forest(axes: Axes, result: Population, name: str) -> None:
    """Draw the units one below the other."""
    low, middle, high = np.quantile(result.predict()[name], BAND)
    axes.axvspan(low, high, color=COLOURS["mcmc"], alpha=0.25, lw=0, label="90 % of new units")
    axes.axvline(middle, color=COLOURS["mcmc"], lw=1.2)
    for start, shift, colour, text in (("", -0.15, RAW, "unit alone"), ("shrunken_", 0.15, SHRUNKEN, "in population")):
        centre, ends = _intervals(result, name, start)
        place = np.arange(centre.size) + shift
        axes.errorbar(centre, place, xerr=ends, fmt="o", ms=3, lw=1.1, color=colour, label=text)
    axes.set_ylim(centre.size - 0.4, -0.6)
    axes.set_yticks([])
    axes.set_xlabel(_label(result, name))


def _draw_line(axes: Axes, result: Population, name: str, covariate: str) -> None:
    """Draw the units over a covariate."""
    rows = result.units[result.units[PARAMETER] == name]
    x = rows[covariate].to_numpy()
    room = 0.06 * np.ptp(x)
    line = np.linspace(x.min() - room, x.max() + room, LINE_POINTS)
    means = {other: mean for other, (mean, _) in result.covariates.items()}
    band = np.array([np.quantile(result.predict(means | {covariate: float(v)})[name], BAND) for v in line])
    axes.fill_between(line, band[:, 0], band[:, 2], color=COLOURS["mcmc"], alpha=0.25, lw=0, label="90 % of new units")
    axes.plot(line, band[:, 1], color=COLOURS["mcmc"], lw=1.2)
    for start, shift, colour, text in (("", -0.3, RAW, "unit alone"), ("shrunken_", 0.3, SHRUNKEN, "in population")):
        centre, ends = _intervals(result, name, start)
        axes.errorbar(x + shift * room, centre, yerr=ends, fmt="o", ms=3, lw=1.1, color=colour, label=text)
    axes.set(xlabel=covariate, ylabel=_label(result, name))
