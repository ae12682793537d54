"""Figures of the Silverbox study."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayesperiodic as bp

ERROR_OF_MEAN, GRID, TRUTH = "#999999", "#009E73", "#CC79A7"
LOWEST = 1e-11


def spectrum(experiment: bp.Experiment, fit: bp.MapEstimate, difference: np.ndarray, drive_lines: int) -> Figure:
    """Draw the amplitudes of response, residual, standard error and grid error, odd and even harmonics apart."""
    from matplotlib import pyplot as plt

    kept = experiment.harmonics["response"]
    frequency = experiment.frequency * np.arange(kept + 1)
    curves: dict[str, tuple[np.ndarray, str, dict[str, Any]]] = {
        "response": (_amplitudes(experiment.outputs["response"], kept), "measured", {"marker": ".", "ls": "none"}),
        "residual": (_amplitudes(fit.residuals[experiment.name]["response"], kept), "map", {"marker": ".", "lw": 0.6}),
        "standard error of the mean period": (
            np.sqrt(experiment.amplitude_variance["response"]), ERROR_OF_MEAN, {"lw": 1.6},
        ),
        "discretisation error": (_amplitudes(difference, kept), GRID, {"lw": 1.0, "ls": "--"}),
    }  # fmt: skip
    figure = plt.figure(figsize=(9.0, 7.0), layout="constrained")
    for axes, first, what in zip(
        figure.subplots(2, 1, sharex=True, sharey=True),
        (1, 2),
        ("odd harmonics, those of the drive", "even harmonics"),
        strict=True,
    ):
        for label, (values, colour, style) in curves.items():
            colour = bp.plot.COLOURS.get(colour, colour)
            axes.semilogy(frequency[first::2], values[first::2], color=colour, ms=4, label=label, **style)
        axes.axvline(experiment.frequency * drive_lines, color="black", lw=0.8, ls=":", label="last line of the drive")
        axes.set_ylabel("amplitude [V]")
        axes.set_title(what)
    axes.set_ylim(bottom=LOWEST)
    axes.set_xlabel("frequency [Hz]")
    figure.axes[0].legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.12))
    figure.suptitle(f"Silverbox{', synthetic data' if experiment.synthetic else ''}: response and residual")
    return figure


def estimates(choices: Mapping[str, Mapping[str, bp.MapEstimate]], truth: Mapping[str, float] | None) -> Figure:
    """Draw the estimates with their standard deviations, by noise model and choice of harmonics."""
    from matplotlib import pyplot as plt

    first = next(iter(choices.values()))
    noises, names = list(first), list(next(iter(first.values())).theta)
    figure = plt.figure(figsize=(10.0, 6.0), layout="constrained")
    for axes, name in zip(figure.subplots(2, 3).flat, names, strict=True):
        for number, (label, fits) in enumerate(choices.items()):
            at = np.arange(len(noises)) + 0.3 * (number - 0.5 * (len(choices) - 1))
            _draw_estimates(axes, at, list(fits.values()), name, label, filled=number == 0)
        if truth is not None:
            axes.axhline(truth[name], color=TRUTH, lw=1.2, ls="--", label="true value")
        axes.set_xticks(range(len(noises)), noises)
        axes.tick_params(axis="x", labelsize=9)
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.set_xlim(-0.5, len(noises) - 0.5)
        axes.set_ylabel(f"{name} [{bp.models.silverbox.units[name].replace('^2', '²')}]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), frameon=False, ncols=5, loc="outside lower center")
    figure.suptitle(f"Silverbox{'' if truth is None else ', synthetic data'}: estimates by noise model")
    return figure


def _draw_estimates(
    axes: Axes, at: np.ndarray, fits: list[bp.MapEstimate], name: str, label: str, *, filled: bool
) -> None:
    values, sds, robust = ([getattr(fit, kind)[name] for fit in fits] for kind in ("theta", "sd", "robust_sd"))
    laplace, colour = bp.plot.COLOURS["laplace"], bp.plot.COLOURS["map"]
    axes.errorbar(at, values, sds, fmt="none", ecolor=laplace, elinewidth=4.0, label="Laplace sd")
    axes.errorbar(at, values, robust, fmt="none", ecolor="black", elinewidth=1.0, capsize=4, label="sandwich sd")
    axes.plot(at, values, "o", color=colour, mfc=colour if filled else "white", ms=6, zorder=5, label=f"MAP, {label}")


def _amplitudes(values: np.ndarray, kept: int) -> np.ndarray:
    return 2.0 * np.abs(np.fft.rfft(values)[: kept + 1]) / values.size
