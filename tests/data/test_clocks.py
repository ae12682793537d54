"""Channels with times and clocks of their own, against the closed form of a linear oscillator."""

import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data import clocks

FREQUENCY, C, K = 3.0, 0.8, 400.0
OMEGA = 2 * np.pi * FREQUENCY
RESPONSE = 12.0 / (K - OMEGA**2 + 1j * OMEGA * C)
MODEL = bp.Model(
    "osc", states=["x"], inputs=["force"], parameters=["c", "k"],
    equations=["ddx + c*dx + k*x - force"], outputs={"x": "x"},
)  # fmt: skip
PRIORS = {"c": bp.LogNormal(1.0, 1.0), "k": bp.LogNormal(400.0, 0.5)}


def force_at(time):
    return 12.0 * np.cos(OMEGA * time)


def response_at(time):
    return np.real(RESPONSE * np.exp(1j * OMEGA * time))


def two_rates(seed, noise=5e-4):
    generator = np.random.default_rng(seed)
    fast, slow = np.arange(0, 20, 1e-3), 0.137 + np.arange(0, 19.5, 1 / 97)
    force = force_at(fast) + 0.05 * generator.standard_normal(fast.size)
    x = response_at(slow) + noise * generator.standard_normal(slow.size)
    return bp.Recording.from_arrays({"force": fast, "x": slow}, {"x": x}, {"force": force}, name="two rates")


def one_clock(ppm=0.0, seed=1, cycles=120, lost=(), delay=0.0, noise=0.01):
    """Return a force and a response at 20 samples a period, the response on a slow clock and without some samples."""
    generator = np.random.default_rng(seed)
    time = np.arange(20 * cycles) / (20 * FREQUENCY)
    x = response_at(time * (1 + 1e-6 * ppm) + delay) / abs(RESPONSE) + noise * generator.standard_normal(time.size)
    x = np.delete(x, lost)
    return bp.Recording.from_arrays(time[: x.size], {"x": x}, {"force": force_at(time)[: x.size]})


def amplitude(experiment, kind, channel):
    values = getattr(experiment, kind)[channel]
    return np.fft.rfft(values)[1] * 2 / values.size


def test_two_rates_give_the_closed_form_within_the_stated_errors():
    """z² of real and imaginary parts over 20 data sets: outside of the 99.9 % band of χ² by chance once in 1000."""
    scores = []
    for seed in range(20):
        run = two_rates(seed).fold(32, frequency=FREQUENCY, harmonics={"x": 4, "force": 1})
        error = amplitude(run, "outputs", "x") - RESPONSE
        scores += [z**2 / (0.5 * run.amplitude_variance["x"][1]) for z in (error.real, error.imag)]
        assert abs(amplitude(run, "inputs", "force") - 12.0) < 5 * np.sqrt(run.amplitude_variance["force"][1])
    assert 16.9 < sum(scores) < 76.1  # χ² with 40 degrees of freedom, widened for the estimated variances


def test_two_rates_identify_the_oscillator():
    run = two_rates(1).fold(32, harmonics={"x": 4, "force": 1})
    fit = bp.map_estimate(bp.Problem(MODEL, [run], priors=PRIORS, scheme="fourier"), progress=False)
    for name, true in (("c", C), ("k", K)):
        assert abs(fit.theta[name] - true) < 4.0 * fit.sd[name]


def test_each_group_informs_the_common_frequency():
    """At equal noise and rate, two groups have the information of one with both channels."""
    time, generator = np.arange(0, 20, 0.01), np.random.default_rng(3)
    a, b = (np.cos(OMEGA * time + p) + 0.1 * generator.standard_normal(time.size) for p in (0.0, 1.0))
    together = bp.Recording.from_arrays(time, {"a": a, "b": b}).fold(32)
    late = 0.004 + time
    other = np.cos(OMEGA * late + 1.0) + b - np.cos(OMEGA * time + 1.0)
    apart = bp.Recording.from_arrays({"a": time, "b": late}, {"a": a, "b": other}).fold(32)
    assert apart.frequency_se == pytest.approx(together.frequency_se, rel=0.2)
    assert apart.frequency == pytest.approx(together.frequency, abs=together.frequency_se)


def test_a_merged_file_with_empty_cells_is_that_of_the_channels(tmp_path):
    recording = two_rates(2)
    rows = sorted({*recording.time["force"].round(9), *recording.time["x"].round(9)})
    cells = {
        c: dict(zip(recording.time[c].round(9), values, strict=True))
        for c, values in (recording.inputs | recording.outputs).items()
    }
    lines = [",".join([repr(float(t)), *(repr(float(v[t])) if t in v else "" for v in cells.values())]) for t in rows]
    (tmp_path / "run.csv").write_text("t,F,X\n" + "\n".join(lines))
    arguments = {"time": "t", "inputs": {"force": "F"}, "outputs": {"x": "X"}}
    with pytest.raises(ValueError, match="missing='drop' leaves such samples out"):
        bp.Recording.from_csv(tmp_path / "run.csv", **arguments)
    read = bp.Recording.from_csv(tmp_path / "run.csv", **arguments, missing="drop")
    for channel, values in (recording.inputs | recording.outputs).items():
        assert read.time[channel] == pytest.approx(recording.time[channel], abs=1e-9)
        assert np.array_equal((read.inputs | read.outputs)[channel], values)


def test_all_methods_work_on_channels_with_their_own_times(tmp_path):
    recording = two_rates(4)
    assert "['force'] (20000 samples at 1000 Hz)" in repr(recording) and "(1892 samples at 97 Hz)" in repr(recording)
    assert recording.sampling_rate == pytest.approx(97.0)
    part = recording.between(5.0, 10.0)
    assert all(5.0 <= time[0] and time[-1] <= 10.0 for time in part.times.values())
    recording.save(tmp_path / "run.bp")
    loaded = bp.load(tmp_path / "run.bp")
    assert all(np.array_equal(loaded.time[c], recording.time[c]) for c in recording.times)
    check = recording.check()
    assert not check.findings and check.cycles == 58
    assert len(recording.steady().fold(32).findings) == 0
    outliers = np.zeros(recording.time["x"].size, dtype=bool)
    outliers[100] = True
    fewer = recording.without(outliers=outliers, channel="x")
    assert fewer.time["x"].size == outliers.size - 1 and fewer.time["force"].size == recording.time["force"].size
    with pytest.raises(ValueError, match="outliers: must be True, False or a bool array with `channel`"):
        recording.without(outliers=outliers)
    assert [run.name for run in recording.split()] == ["two rates"]
    assert recording.unwrapped("x").time["x"].size == recording.time["x"].size
    axes = bp.plot.recording(recording, check).axes
    assert [one.get_ylabel() for one in axes] == ["force", "x"]
    with pytest.raises(ValueError, match="recording: must have the same times for all channels"):
        bp.PoincareSection.from_recording(
            bp.Recording.join(recording, bp.Recording.from_arrays(recording.time["x"], {"y": recording.outputs["x"]})),
            ("x", "y"),
            frequency=3.0,
        )


def test_recordings_are_joined_if_their_channels_differ():
    recording = two_rates(5)
    one = bp.Recording.from_arrays(recording.time["force"], {"force": recording.inputs["force"]})
    two = bp.Recording.from_arrays(recording.time["x"], {"x": recording.outputs["x"]}, name="second")
    assert bp.Recording.join(one, two, name="both").fold(32, frequency=3.0).outputs.keys() == {"force", "x"}
    with pytest.raises(ValueError, match="'x'"):
        bp.Recording.join(two, two)
    with pytest.raises(ValueError, match="recordings: must be one or more, got none"):
        bp.Recording.join()
    shifted = bp.Recording.from_arrays(recording.time["x"] + 100.0, {"y": recording.outputs["x"]})
    with pytest.raises(ValueError, match="must have at least 3 cycles that all channels have in common"):
        bp.Recording.join(one, shifted).fold(32)
    same = bp.Recording.join(two, bp.Recording.from_arrays(two.time.copy(), {"y": 2.0 * two.outputs["x"]}))
    assert isinstance(same.time, np.ndarray)


def test_one_clock_has_no_finding():
    """30 recordings; the false-alarm rate of each is 1e-4."""
    for seed in range(30):
        kinds = {finding.kind for finding in one_clock(seed=seed, cycles=60).check().findings}
        assert not kinds & {"clock", "phase step"}


@pytest.mark.parametrize("ppm", [12, 20, -50, 300])
def test_clocks_that_differ_are_refused_with_their_difference(ppm):
    recording = one_clock(ppm, cycles=300)
    (finding,) = [finding for finding in recording.check().findings if finding.kind == "clock"]
    assert finding.channel == "x" and finding.severity == "ruinous" and "fold(clocks=" in finding.cure
    words = finding.text.split("as if its frequency were ")[1].split()
    assert float(words[0]) == pytest.approx(abs(ppm), abs=4.5 * float(words[2]))
    assert words[4].startswith("above" if ppm > 0 else "below")
    with pytest.raises(ValueError, match="drifts steadily against force"):
        recording.fold(32)
    with pytest.warns(UserWarning, match="drifts steadily against force"):
        stated = recording.fold(32, clocks="one")
    assert [f.severity for f in stated.findings if f.kind == "clock"] == ["serious"]


@pytest.mark.parametrize("losses", [[(800, 7)], [(600, 3), (1300, 5)], [(200 * i + 100, 1) for i in range(11)]])
def test_lost_samples_of_one_channel_are_refused_with_the_delay(losses):
    lost = np.concatenate([np.arange(first, first + count) for first, count in losses])
    (finding,) = [f for f in one_clock(lost=lost).check().findings if f.kind == "phase step"]
    assert finding.channel == "x" and finding.severity == "ruinous" and finding.count == len(losses)
    for (at, *_), (first, _) in zip(finding.times, losses, strict=True):
        # Earlier losses have moved the later samples; a window is a cycle.
        before = sum(count for start, count in losses if start < first)
        assert at == pytest.approx((first - before) / 60, abs=2.0 / FREQUENCY)
    count = float(finding.text.split("as after ")[1].split()[0])
    assert count == pytest.approx(losses[0][1], abs=0.2) and "x is earlier by" in finding.text
    with pytest.raises(ValueError, match="x is earlier by .* lost samples of x"):
        one_clock(lost=lost).fold(32)


def beating(seed, lost=0, rate=60.0, decay=2.0):
    """Return 60 s from rest: a steady response and a free oscillation at 1.2 of its frequency, which decays."""
    time, generator = np.arange(int(60 * rate)) / rate, np.random.default_rng(seed)
    steady, free = response_at(time) / abs(RESPONSE), np.cos(1.2 * OMEGA * time + seed) * np.exp(-time / decay)
    x = np.delete(steady + free + 1e-3 * generator.standard_normal(time.size), np.arange(1500, 1500 + lost))
    return bp.Recording.from_arrays(time[: x.size], {"x": x}, {"force": force_at(time)[: x.size]})


@pytest.mark.parametrize("decay", [0.5, 1.0, 2.0, 3.0])
def test_beats_of_a_transient_are_no_lost_samples(decay):
    """The phase of the response steps by up to 10 degrees between windows, where its amplitude is nearly steady."""
    for seed in range(12):
        recording = beating(seed, decay=decay)
        assert not [f for f in recording.check().findings if f.kind == "phase step"]
        assert abs(amplitude(recording.fold(32), "outputs", "x")) == pytest.approx(1.0, abs=5e-4)


def test_samples_lost_after_a_transient_are_found():
    for seed in range(6):
        (finding,) = [f for f in beating(seed, 1).check().findings if f.kind == "phase step"]
        assert finding.severity == "ruinous" and finding.times[0, 0] == pytest.approx(25.0, abs=2.0 / FREQUENCY)


def test_samples_lost_by_the_force_are_attributed_to_it():
    time = np.arange(2400) / 60.0
    force = np.delete(force_at(time), np.arange(800, 806))
    x = response_at(time)[: force.size] / abs(RESPONSE)
    x += 0.01 * np.random.default_rng(1).standard_normal(x.size)
    found = bp.Recording.from_arrays(time[: x.size], {"x": x}, {"force": force}).check().findings
    (finding,) = [one for one in found if one.kind == "phase step"]
    assert finding.channel in ("force", "x") and "lost samples of force" in finding.text


@pytest.mark.parametrize("clocks", ["auto", {"second": ["x"]}])
def test_channels_of_another_clock_have_the_amplitude_at_its_frequency(clocks):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = one_clock(200.0, cycles=300, delay=0.05).fold(32, clocks=clocks, harmonics={"x": 4, "force": 1})
    assert [*run.clocks.values()] == [("x",)] and run.cycles >= 297
    assert run.frequency == pytest.approx(FREQUENCY, rel=1e-6)
    assert abs(amplitude(run, "outputs", "x")) == pytest.approx(1.0, abs=5 * np.sqrt(run.amplitude_variance["x"][1]))
    assert "other clocks" in repr(run)
    with pytest.raises(ValueError, match="experiments: must have known delays or free ones, .* 'x' has another clock"):
        bp.Problem(MODEL, [run], priors=PRIORS)
    late = bp.Problem(MODEL, [run], priors={**PRIORS, "shift": bp.Uniform(-0.16, 0.16)})
    assert "shift[recording]" in late.names


def test_one_clock_has_no_other_ones():
    assert not one_clock().fold(32, clocks="auto").clocks
    bp.Problem(MODEL, [one_clock().fold(32, clocks="auto")], priors=PRIORS)


@pytest.mark.parametrize(
    ("clocks", "message"),
    [
        ("two", "clocks: must be one of 'one', 'auto', got 'two'"),
        ({"second": ["y"]}, r"clocks\['second'\]: must be one of 'force', 'x', got 'y'"),
        ({"a": ["x"], "b": ["x"]}, "clocks: must name each channel once, got 'x' 2 times"),
    ],
)
def test_clocks_are_checked(clocks, message):
    with pytest.raises(ValueError, match=message):
        one_clock().fold(32, clocks=clocks)


def test_rounding_errors_of_an_exact_drive_do_not_explain_a_response_that_drifts():
    time = np.arange(15000) / 10
    x = np.cos(0.4 * np.pi * (1 + 2e-5) * time) + 0.01 * np.random.default_rng(1).standard_normal(time.size)
    with pytest.warns(UserWarning, match="drifts steadily"):
        e = bp.Recording.from_arrays(time, {"x": x}, {"force": np.cos(0.4 * np.pi * time)}).fold(32, clocks="one")
    assert e.error_slopes == {} and e.frequency_se == 0.0


@pytest.mark.parametrize("rate", [2.13, 0.7])
def test_a_channel_that_is_sampled_more_slowly_than_the_period_has_its_amplitude(rate):
    fast, slow, random = np.arange(0, 300, 0.02), 0.137 + np.arange(0, 299.5, 1 / rate), np.random.default_rng(1)
    x = 0.25 * np.cos(6 * np.pi * slow - 1.0) + 1e-3 * random.standard_normal(slow.size)
    force = np.cos(6 * np.pi * fast) + 1e-3 * random.standard_normal(fast.size)
    run = bp.Recording.from_arrays({"force": fast, "x": slow}, {"x": x}, {"force": force})
    e = run.fold(32, frequency=3.0, harmonics={"x": 2, "force": 1})
    error = np.fft.rfft(e.outputs["x"])[1] / 16 - 0.25 * np.exp(-1.0j)
    # Exceeded with a probability of 1e-4.
    assert np.abs(error) < 3.04 * np.sqrt(e.amplitude_variance["x"][1])


def test_noise_of_a_relative_phase_is_not_below_that_by_the_amplitudes():
    """A drift of 2.4 standard deviations whose other components happen to be a tenth of the noise is no drift."""
    cycle, count = np.arange(20.0), 20
    legendre = np.linalg.qr(np.polynomial.legendre.legvander((cycle - 9.5) / 9.5, 12))[0]
    quiet = 1e-4 * legendre[:, 3:] @ np.ones(10)
    relative = 3.4e-3 * legendre[:, 1] + quiet
    noise = np.random.default_rng(3).standard_normal((count, 2)) * 2 * np.pi * 1e-3
    for sizes, seen in ((np.zeros((count, 2)), 1), (noise, 0)):
        phases = clocks.Phases(
            cycle, cycle, 1, np.column_stack([np.zeros(count), relative]), sizes, np.ones(2), np.zeros(2)
        )
        listed = [*clocks.drifts(phases, np.ones(count, dtype=bool), [np.zeros(0, dtype=int)])]
        assert len(listed) == seen
