"""The figure of a recording shows every fault of its sensors where it is, and the part used."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.plot import COLOURS

TIME = np.arange(6000) / 100


def recorded(seed=1, time=TIME, **faults):
    """Return a recording of two channels at 1 Hz with noise of 1 %, in which samples of the output are replaced."""
    rng = np.random.default_rng(seed)
    x, force = (np.cos(2 * np.pi * time) + 0.01 * rng.standard_normal(time.size) for _ in range(2))
    for at, value in faults.values():
        x[at] = value
    return bp.Recording.from_arrays(time, {"x": x}, {"force": force}, name="run")


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def artist(axes, label):
    (found,) = [a for a in axes.get_children() if a.get_label() == label]
    return found


def spans(axes, label):
    """Return the first and last times of the spans with this label."""
    return [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in artist(axes, label).get_paths()]


def test_a_good_recording_is_drawn_with_the_part_used_and_nothing_else():
    figure = bp.plot.recording(recorded())
    force, x = figure.axes
    assert [force.get_ylabel(), x.get_ylabel(), x.get_xlabel()] == ["force", "x", "time [s]"]
    assert legend(figure) == ["part used"]
    assert figure.axes[0].get_title(loc="left") == "run: 60 of 60 cycles at 1 Hz are used, 0 to 59.99 s."
    assert np.array_equal(x.lines[0].get_xydata(), np.stack([TIME, recorded().outputs["x"]], axis=-1))
    synthetic = bp.plot.recording(replace(recorded(), synthetic=True)).axes[0].get_title(loc="left")
    assert synthetic.startswith("run (synthetic data): 60 of 60")
    assert x.lines[0].get_color() == COLOURS["measured"]
    assert force.get_shared_x_axes().joined(force, x)


def test_outliers_and_stuck_samples_are_marked_in_the_panel_of_their_channel():
    figure = bp.plot.recording(recorded(spikes=([1000, 1003], 6.283), stuck=(slice(3000, 3200), 0.3)))
    force, x = figure.axes
    assert legend(figure) == ["part used", "stuck (serious)", "outliers (serious)"]
    assert artist(x, "outliers (serious)").get_xydata().tolist() == [[10.0, 6.283], [10.03, 6.283]]
    assert spans(x, "stuck (serious)") == [pytest.approx((30.0, 31.99), abs=0.01)]
    assert [line.get_label() for line in force.lines[1:]] == []
    assert not [a for a in force.get_children() if a.get_label() == "stuck (serious)"]


def test_clipped_samples_are_marked_at_their_levels():
    recording = recorded()
    values = np.clip(recording.outputs["x"], -0.8, 0.9)
    figure = bp.plot.recording(replace(recording, outputs={"x": values}))
    x, y = artist(figure.axes[1], "clipped (ruinous)").get_data()
    # With them, the others at the same phases, which are left out too.
    assert {-0.8, 0.9} <= set(y) and np.mean(np.isin(y, [-0.8, 0.9])) > 0.7
    assert np.isin(y, values).all() and np.isin(x, TIME).all()


def test_ramps_are_hatched_outside_of_the_part_used():
    time = TIME
    rising = np.minimum(time / 20, 1.0)
    recording = recorded()
    figure = bp.plot.recording(replace(recording, outputs={"x": rising * recording.outputs["x"]}))
    ((first, last),) = spans(figure.axes[1], "ramp (harmless)")
    used = artist(figure.axes[1], "part used").get_extents().transformed(figure.axes[1].transData.inverted())
    assert first == pytest.approx(0.0) and 17.0 < last <= used.x0 < 22.5
    assert used.x1 == pytest.approx(time[-1])


def test_wraps_are_lines_and_nothing_is_used():
    angle = np.mod(3.0 + 2.5 * np.pi * np.sin(np.pi * TIME), 2 * np.pi)
    figure = bp.plot.recording(bp.Recording.from_arrays(TIME, {"angle": angle}))
    jumps = 1 + np.flatnonzero(np.abs(np.diff(angle)) > 4.0)
    lines = artist(figure.axes[0], "wraps (ruinous)").get_segments()
    assert [line[0, 0] for line in lines] == TIME[jumps].tolist()[:200]
    assert legend(figure) == ["wraps (ruinous)"]
    assert "no mean period" in figure.axes[0].get_title(loc="left")


def test_curves_are_interrupted_at_gaps():
    time = np.concatenate([TIME[:2000], TIME[2020:]])
    figure = bp.plot.recording(recorded(time=time))
    line = figure.axes[1].lines[0]
    assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [2000]
    assert spans(figure.axes[1], "gaps (harmless)") == [pytest.approx((19.99, 20.2), abs=0.01)]


def test_steps_are_lines_and_drifts_are_named():
    recording = recorded()
    check = recording.check()
    times, unknown = np.array([[20.0, 20.0]]), float("nan")
    given = [
        bp.Finding("phase step", "", "serious", times, 1, 0.01, unknown, "a step"),
        bp.Finding("amplitude step", "x", "serious", times + 1.0, 1, 0.01, unknown, "a step"),
        bp.Finding("drift", "x", "serious", np.array([[0.0, 60.0]]), 60, 1.0, unknown, "a drift"),
    ]
    figure = bp.plot.recording(recording, replace(check, findings=tuple(given)))
    force, x = figure.axes
    assert legend(figure) == ["part used", "phase step (serious)", "amplitude step (serious)"]
    for axes in (force, x):
        assert artist(axes, "phase step (serious)").get_segments()[0][:, 0].tolist() == [20.0, 20.0]
    assert artist(x, "amplitude step (serious)").get_segments()[0][0, 0] == 21.0
    assert [[text.get_text() for text in axes.texts] for axes in (force, x)] == [[], ["drift (serious)"]]


def test_single_spikes_of_long_recordings_remain_visible():
    time = np.arange(300_000) / 100
    recording = recorded(time=time, spike=(123_456, 7.0), dip=(200_000, -9.0))
    line = bp.plot.recording(recording).axes[1].lines[0]
    x, y = line.get_data()
    assert x.size < 5000 and (y.max(), y.min()) == (7.0, -9.0)
    assert abs(x[np.argmax(y)] - 1234.56) < 3.0
    # Every part reaches from the smallest to the largest of its samples.
    low, high = y[0::2], y[1::2]
    assert np.all(high >= low) and np.median(high - low) > 1.9


def test_a_given_check_and_figure_are_used_and_others_are_refused():
    recording, figure = recorded(), plt.figure()
    check = recording.check(1.0)
    assert bp.plot.recording(recording, check, figure=figure) is figure
    with pytest.raises(ValueError, match="recording: must be"):
        bp.plot.recording(recording.outputs["x"])
    with pytest.raises(ValueError, match="check: must be"):
        bp.plot.recording(recording, recording.fold(64))
    with pytest.raises(ValueError, match="check: must"):
        bp.plot.recording(replace(recording, outputs={"y": recording.outputs["x"]}), check)
    bad = recorded(spike=(5999 - 100, 6.0)).check()
    with pytest.raises(ValueError, match="check: must be recording.check.* more samples"):
        bp.plot.recording(recording.between(0.0, 30.0), bad)
