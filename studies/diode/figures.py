"""The figures of the study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from studies.diode import chaos, prediction, rig

# The model's diagram: frequencies [Hz], periods that are drawn, draws.
FINE, DRAWN, SHOWN = 2_000.0, 40, 7


def bifurcation(
    records: Sequence[rig.Record], used: Sequence[rig.Record], final: rig.Fitted, sample: list[dict[str, float]], *,
    synthetic: bool,
) -> Figure:  # fmt: skip
    """Return the predicted bifurcation diagram above the measured one."""
    frequencies = np.array([record.frequency for record in records])
    own = np.array([prediction.source_of(record) for record in records])
    fine = np.arange(max(frequencies[0] - 10e3, 0.0), frequencies[-1] + 10e3, FINE)
    sources = np.stack([np.interp(fine, frequencies, column) for column in own.T], axis=1)
    estimate = rig.values_of(final)
    figure, axes = plt.subplots(2, 1, figsize=(8.0, 6.6), sharex=True, sharey=True, layout="constrained")
    drawn = [*sample[:SHOWN], estimate]
    swept = prediction.sweep(drawn, fine.tolist(), [tuple(row) for row in sources], DRAWN)
    for values, draw in zip(swept, drawn, strict=True):
        colour = "#000000" if draw is estimate else "#E69F00"
        at = np.repeat(1e-3 * fine, DRAWN)
        axes[0].plot(at, values[:, :, 0].ravel(), ".", ms=0.9, mew=0.0, color=colour, rasterized=True)
    fitted = {record.frequency for record in used}
    for record in records:
        kind = "fitted" if record.frequency in fitted else "periodic, not fitted" if record.period else "not periodic"
        colour = {"fitted": "#0072B2", "periodic, not fitted": "#56B4E9", "not periodic": "#555555"}[kind]
        values = rig.stroboscopic(record)
        axes[1].plot(
            np.full(values.size, 1e-3 * record.frequency), values, ".", ms=3, color=colour, label=kind, rasterized=True
        )
        for ax in axes if record.frequency in fitted else ():
            ax.axvline(1e-3 * record.frequency, color="#0072B2", lw=0.6, alpha=0.5, zorder=0)
    axes[0].set_title(f"Predicted from {len(used)} periodic records (black: MAP point, orange: draws)")
    axes[1].set_title("SYNTHETIC records" if synthetic else "Measured")
    axes[1].set_xlabel("drive frequency [kHz]")
    for ax in axes:
        ax.set_ylabel("resistor voltage at the\nmaximum of the source, less mean [V]")
    handles, labels = axes[1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axes[1].legend(unique.values(), unique, loc="upper right", frameon=False, markerscale=2)
    return figure


def unstable_orbits(records: Sequence[rig.Record], unstable: Sequence[Mapping[str, Any]], *, synthetic: bool) -> Figure:
    """Return where the record with most orbits of large multipliers passes by them."""
    by_frequency = {
        f: [row for row in unstable if row["frequency_Hz"] == f] for f in {r["frequency_Hz"] for r in unstable}
    }
    frequency = max(by_frequency, key=lambda f: (len(by_frequency[f]), -max(row["nearest"] for row in by_frequency[f])))
    measured = chaos.by_phase(next(record for record in records if record.frequency == frequency))
    rows = by_frequency[frequency]
    figure, axes = plt.subplots(len(rows), 1, figsize=(8.0, 1.6 * len(rows) + 0.6), sharey=True, layout="constrained")
    for ax, row in zip(np.atleast_1d(axes), rows, strict=True):
        first, length = row["index"], row["orbit"].size
        at = np.arange(max(first - 2 * chaos.PHASES, 0), min(first + length + 4 * chaos.PHASES, measured.size))
        turns = (at - first) / chaos.PHASES
        orbit = chaos.aligned(row["orbit"], measured, first)
        ax.plot(turns, measured[at], ".-", ms=3, lw=0.6, color="#555555", label="measured")
        ax.plot(
            turns, np.take(orbit, at - first, mode="wrap"), "-", lw=1.2, color="#D55E00", label="orbit of the model"
        )
        ax.axvspan(0.0, length / chaos.PHASES, color="#56B4E9", alpha=0.25, lw=0.0, label="nearest passage")
        ax.set_title(
            f"period {row['period']}, multiplier {row['multiplier']:.1f}: {100 * row['nearest']:.2f} % of the variance",
            fontsize="medium",
        )
        ax.set_ylabel("voltage [V]")
    low, high = np.atleast_1d(axes)[0].get_ylim()
    np.atleast_1d(axes)[0].set_ylim(top=high + 0.25 * (high - low))
    np.atleast_1d(axes)[0].legend(frameon=False, fontsize="small", loc="upper right", ncols=3)
    np.atleast_1d(axes)[-1].set_xlabel("time from the start of the passage [periods of the source]")
    kind = "SYNTHETIC" if synthetic else "measured"
    figure.suptitle(
        f"Unstable orbits of the model in the {kind} record at {frequency / 1e3:g} kHz, which has no period"
    )
    return figure


def steps(fits: Mapping[str, rig.Fitted], used: Sequence[rig.Record], *, synthetic: bool) -> Figure:
    """Return the unexplained variance of the fitted records by model."""
    figure, ax = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    names = [f"{record.frequency / 1e3:g} kHz\nP = {record.period}" for record in used]
    styles = zip("osD^", ("#D55E00", "#E69F00", "#009E73", "#0072B2"), strict=True)
    for (step, own), (marker, colour) in zip(fits.items(), styles, strict=True):
        values = [100 * rig.unexplained(e, own.fit.solutions[e.name]) for e in own.problem.experiments]
        ax.plot(names, values, marker, ls="-", lw=0.8, color=colour, label=step)
    floor = [100 * (1.0 - record.experiment.periodicity) for record in used if record.experiment]
    ax.plot(names, floor, "_", ms=14, color="#555555", label="between the cycles of the record")
    ax.set(yscale="log", ylabel="unexplained variance [%]", ylim=(None, 9.0))
    ax.set_title("What each term explains" + (" (synthetic data)" if synthetic else ""))
    ax.legend(frameon=False, fontsize="small", loc="upper left")
    return figure


def probabilities(table: Sequence[Mapping[str, Any]], *, synthetic: bool) -> Figure:
    """Return the probability that each forecast gives the measured motion of a record, that was not fitted."""
    figure, ax = plt.subplots(figsize=(8.0, 3.8), layout="constrained")
    frequencies = [1e-3 * row["frequency_Hz"] for row in table]
    styles = {
        "neighbours": ("two records on each side", "_", "#555555"),
        "posterior": ("draws as if the model were true", "v", "#E69F00"),
        "robust": ("robust covariance", "o", "#0072B2"),
        "next record": ("and model error of the next record", "D", "#D55E00"),
    }
    for name, (text, marker, colour) in styles.items():
        values = [row["held_out"][name] for row in table]
        ax.plot(frequencies, values, marker, ms=5, mew=1.4, mfc="none", color=colour, label=text)
    ax.set(yscale="log", ylim=(0.003, 1.3), xlabel="drive frequency [kHz]", ylabel="probability of the measured motion")
    ax.set_title("Predicted without the record itself" + (" (synthetic data)" if synthetic else ""))
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize="small")
    return figure
