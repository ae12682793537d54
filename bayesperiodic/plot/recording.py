"""The figure of a recording: all channels over time, with what its check found."""

import textwrap
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesperiodic import _checks
from bayesperiodic.data.recording import Recording
from bayesperiodic.data.recording_check import SEVERITIES, Finding, RecordingCheck
from bayesperiodic.plot.style import COLOURS, caveats, legend_entries, styled, wrapped_label

# Parts of the time axis in which the smallest and the largest sample are drawn, of recordings with more samples.
PARTS, MOST_SAMPLES = 1200, 8000
# Length of labels, and of the lines of the title in characters for each inch.
CHANNEL_LENGTH, TITLE_LENGTH = 16, 13
# Shortest span that is drawn, as a fraction of the time axis.
SHORTEST = 1 / 400
USED_STYLE: dict[str, Any] = {"color": "#009E73", "alpha": 0.15, "lw": 0.0}
SPANS: dict[str, dict[str, Any]] = {
    "gaps": {"facecolor": "#888888", "alpha": 0.5, "lw": 0.0},
    "stuck": {"facecolor": "#E69F00", "alpha": 0.5, "lw": 0.0},
    "ramp": {"facecolor": "none", "edgecolor": "#888888", "hatch": "//", "lw": 0.0},
    "transient": {"facecolor": "none", "edgecolor": "#888888", "hatch": "\\\\", "lw": 0.0},
}
LINES: dict[str, dict[str, Any]] = {
    "wraps": {"color": "#882255", "lw": 1.0},
    "amplitude step": {"color": "#E69F00", "lw": 1.6, "ls": "--"},
    "phase step": {"color": "#332288", "lw": 1.6, "ls": "-."},
}
POINTS: dict[str, dict[str, Any]] = {
    "outliers": {"color": "#882255", "ls": "none", "marker": "x", "ms": 5.0, "mew": 1.2},
    "clipped": {"color": "#0072B2", "ls": "none", "marker": "o", "ms": 3.5, "mew": 0.0},
}


@styled
def recording(recording: Recording, check: RecordingCheck | None = None, *, figure: Figure | None = None) -> Figure:
    """Draw all channels of a recording over time, what its check found, and the part that `Recording.fold` uses.

    Outliers are marked by crosses and clipped samples by dots, gaps, stuck samples, ramps and transients by spans,
    wraps and steps by lines; drifts and beats are named in the panel of their channel. The part used is shaded. Of long
    recordings the smallest and the largest of successive samples are drawn, so that single extreme ones remain visible.

    Parameters
    ----------
    recording : Recording
    check : RecordingCheck, optional
        By default ``recording.check()``; give ``recording.check(frequency)`` if the drive frequency is known.

    Raises
    ------
    ValueError
        For an object of another class, or the check of another recording.

    Examples
    --------
    >>> t = np.arange(0, 20, 0.01)
    >>> angle = 0.3 + 0.1 * np.cos(2 * np.pi * t) + 1e-3 * np.random.default_rng(1).standard_normal(t.size)
    >>> angle[1000:1003] = 6.283
    >>> figure = bp.plot.recording(bp.Recording.from_arrays(t, {"angle": angle}))
    >>> [axes.get_ylabel() for axes in figure.axes], [text.get_text() for text in figure.legends[0].get_texts()]
    (['angle'], ['part used', 'outliers (ruinous)'])
    """
    _checks.instance("recording", recording, Recording)
    check = recording.check() if check is None else check
    _checks.instance("check", check, RecordingCheck)
    channels = recording.inputs | recording.outputs
    _checks.same_names("check", dict.fromkeys(check.table.index), channels)
    times = recording.times
    if any(at.size and at.max() >= times[c].size for c, bad in check.bad.items() for at in bad.values()):
        raise ValueError("check: must be recording.check() of this recording, got that of one with more samples.")
    figure = figure or plt.figure(figsize=(8.0, 1.3 * len(channels) + 1.1), layout="constrained")
    panels = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (channel, values) in zip(panels, channels.items(), strict=True):
        shown = [finding for finding in check.findings if finding.channel in ("", channel)]
        gaps = np.concatenate([np.zeros((0, 2)), *(f.times for f in shown if f.kind == "gaps")])
        if not check.reason:
            axes.axvspan(check.start, check.stop, label="part used", zorder=0.5, **USED_STYLE)
        axes.plot(*_drawn(times[channel], values, gaps), color=COLOURS["measured"], lw=0.7)
        _mark(axes, shown, times[channel], values, check)
        axes.set_ylabel(wrapped_label(channel, recording.units.get(channel, ""), CHANNEL_LENGTH))
        axes.margins(x=0.0)
        axes.locator_params(axis="y", nbins=5)
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels(panels)
    caveat = f" ({caveats(True, True)})" if recording.synthetic else ""
    title = f"{check.name}{caveat}: {check.sentence}".replace("$", r"\$")
    panels[0].set_title(textwrap.fill(title, int(TITLE_LENGTH * figure.get_figwidth())), loc="left")
    entries = legend_entries(*panels)
    if entries:
        order = sorted(entries, key=lambda label: label != "part used")
        figure.legend([entries[label] for label in order], order, loc="outside lower center", ncols=4)
    return figure


def _drawn(time: np.ndarray, values: np.ndarray, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a curve: all, or the extremes of many, with breaks at gaps (first and last times)."""
    if time.size > MOST_SAMPLES:
        time, values = _extremes(time, values)
    place = np.searchsorted(time, gaps.mean(axis=1))
    return np.insert(time, place, np.nan), np.insert(values.astype(float), place, np.nan)


def _extremes(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each part of the time axis that has samples, at its first time."""
    first = np.unique(np.searchsorted(time, np.linspace(time[0], time[-1], PARTS + 1)[:-1]))
    low, high = np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
    return np.repeat(time[first], 2), np.column_stack([low, high]).ravel()


def _mark(axes: Axes, findings: list[Finding], time: np.ndarray, values: np.ndarray, check: RecordingCheck) -> None:
    """Mark findings in the panel of a channel."""
    named = []
    for finding in findings:
        worst = max((f.severity for f in check.findings if f.kind == finding.kind), key=SEVERITIES.index)
        label, kind = f"{finding.kind} ({worst})", finding.kind
        bad = check.bad.get(finding.channel, {}).get(kind, np.zeros(0, dtype=int))
        if kind in POINTS:
            at = (time[np.sort(bad)], values[np.sort(bad)])
            shown = np.unique(np.column_stack(_extremes(*at) if 2 * bad.size > PARTS else at), axis=0)
            axes.plot(*shown.T, label=label, **POINTS[kind])
        elif kind in LINES:
            axes.vlines(finding.times[:, 0], 0.0, 1.0, transform=axes.get_xaxis_transform(), label=label, **LINES[kind])
        elif kind in SPANS:
            spans = _spans(_times(time, bad) if bad.size else finding.times, np.ptp(time))
            axes.broken_barh(spans, (0.0, 1.0), transform=axes.get_xaxis_transform(), label=label, **SPANS[kind])
        else:
            named.append(f"{kind} ({finding.severity})")
    if named:
        axes.annotate(
            ", ".join(named), (0.0, 1.0), (4.0, -4.0), "axes fraction", "offset points", va="top", fontsize=8,
            bbox={"facecolor": "white", "alpha": 0.8, "lw": 0.0, "pad": 1.5},
        )  # fmt: skip


def _times(time: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the first and last times (parts, 2) of runs of samples."""
    samples = np.sort(samples)
    edges = np.flatnonzero(np.diff(samples) > 1)
    return np.column_stack([time[samples[np.r_[0, edges + 1]]], time[samples[np.r_[edges, samples.size - 1]]]])


def _spans(times: np.ndarray, duration: float) -> list[tuple[float, float]]:
    """Return starts and lengths of spans of at least the shortest length; those that are nearer are drawn as one."""
    shortest = SHORTEST * duration
    middle, half = times.mean(axis=1), np.maximum(0.5 * np.diff(times, axis=1)[:, 0], 0.5 * shortest)
    first, last = middle - half, np.maximum.accumulate(middle + half)
    new = np.r_[True, first[1:] > last[:-1]]
    starts = np.flatnonzero(new)
    stops = last[np.r_[starts[1:] - 1, last.size - 1]]
    return list(zip(first[starts].tolist(), (stops - first[starts]).tolist(), strict=True))
