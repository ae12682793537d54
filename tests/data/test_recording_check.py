"""The check of a recording: faults by their times and effects, cures, false alarms, and what is printed and saved."""

import re
import warnings

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from tests.known import NOISES

RATE, CYCLES = 50, 40
TIME = np.arange(CYCLES * RATE) / RATE


def clean(time=TIME):
    """Return an angle of mean 0.3 with harmonics 1 and 3."""
    return 0.3 + 0.1 * np.cos(2 * np.pi * time + 0.4) + 0.02 * np.sin(6 * np.pi * time)


def measured(seed=0, noise=0.002):
    return clean() + noise * np.random.default_rng(seed).standard_normal(TIME.size)


def recorded(angle, time=TIME, **inputs):
    return bp.Recording.from_arrays(time, {"angle": angle}, inputs, name="run")


def amplitudes(experiment, channel="angle"):
    """Return the amplitudes of harmonics 0 to 3 at time 0."""
    values = experiment.outputs[channel]
    return np.fft.rfft(values)[:4] / values.size * [1, 2, 2, 2]


EXACT = np.array([0.3, 0.1 * np.exp(0.4j), 0.0, -0.02j])


def assert_right(experiment, channel="angle"):
    """Each amplitude is within four and a half of its standard errors."""
    error = np.sqrt(experiment.amplitude_variance[channel][:4]) + 1e-12
    assert np.all(np.abs(amplitudes(experiment, channel) - EXACT) < 4.5 * error)


def only(check, kind):
    """Return the single finding of a kind."""
    (finding,) = [finding for finding in check.findings if finding.kind == kind]
    return finding


# Faults of an angle: wrong reading 2π, a spike, a sensor that sticks, a limit.


def dropouts():
    angle, place = measured(), np.random.default_rng(1).choice(TIME.size, 90, replace=False)
    angle[place] = 6.283
    return angle, np.sort(place)


def dropouts_within_the_range():
    """Return an angle whose sensor reads the mean value at times, and those samples."""
    angle, place = measured(noise=0.0005), np.random.default_rng(1).choice(TIME.size, 60, replace=False)
    place = place[np.abs(clean()[place] - 0.3) > 0.05]
    angle[place] = 0.3
    return angle, np.sort(place)


def test_dropouts_are_found_counted_and_left_out():
    angle, place = dropouts()
    run = recorded(angle)
    check = run.check()
    finding = only(check, "outliers")
    assert check.severity == finding.severity == "ruinous"
    assert (finding.count, finding.channel) == (90, "angle")
    assert finding.share == 90 / TIME.size
    assert check.bad["angle"]["outliers"].tolist() == place.tolist()
    assert finding.times[:, 0].tolist() == TIME[place[np.r_[True, np.diff(place) > 1]]].tolist()
    assert check.frequency == pytest.approx(1.0, abs=0.01)
    assert "angle reads 6.283 at" in str(finding)
    assert "recording.without(outliers=True, channel='angle') leaves them out" in str(finding)
    cured = run.without(outliers=True, channel="angle")
    assert cured.time.tolist() == np.delete(TIME, place).tolist()
    assert_right(cured.fold(64, frequency=1.0))


def test_the_bias_that_is_stated_is_that_of_least_squares_without_the_cure():
    """A single spike of 0.5 in N samples moves each complex amplitude by 2·0.5/N, and the mean by 0.5/N.

    Of the three harmonics together it is √7·0.5/N, relative to a noise of sd/√N.
    """
    angle = clean() + 0.02 * np.random.default_rng(0).standard_normal(TIME.size)
    noise = angle[777] - clean()[777]
    angle[777] += 0.5
    finding = only(recorded(angle).check(1.0), "outliers")
    expected = np.sqrt(7) * (0.5 + noise) / np.sqrt(TIME.size) / 0.02
    assert finding.bias == pytest.approx(expected, rel=0.1)
    assert finding.severity == "serious"
    assert f"a bias of {finding.bias:.3g} standard errors" in str(finding)


def test_dropouts_inside_the_range_of_the_signal_are_found():
    angle, place = dropouts_within_the_range()
    check = recorded(angle).check(1.0)
    found = check.bad["angle"]["outliers"]
    assert len(set(place) & set(found)) >= 0.8 * place.size
    assert len(set(found) - set(place)) == 0
    assert_right(recorded(angle).without(outliers=True).fold(64, frequency=1.0))


def test_a_stuck_sensor_is_named_with_its_value_and_times():
    angle = measured()
    angle[700:760] = angle[700]
    check = recorded(angle).check(1.0)
    finding = only(check, "stuck")
    assert finding.times.tolist() == [[TIME[700], TIME[759]]]
    assert f"angle is stuck at {angle[700]:.6g} from 14 to 15.18 s (60 samples" in str(finding)
    assert finding.severity in ("serious", "ruinous")
    assert "leaves them out" in str(finding)
    first, second = recorded(angle).without(stuck=True, frequency=1.0).split()
    assert (first.time[-1], second.time[0]) == (TIME[699], TIME[760])
    for part in (first, second):
        assert_right(part.fold(64, frequency=1.0))


def test_a_sensor_that_sticks_for_a_fifth_of_a_cycle_is_cured():
    angle = measured()
    angle[710:720] = angle[710]
    run = recorded(angle).without(stuck=True, frequency=1.0)
    assert run.time.size == TIME.size - 10
    assert_right(run.fold(64, frequency=1.0))


def test_samples_that_miss_at_the_same_phases_limit_the_harmonics_and_enlarge_the_variance():
    """A fifth of each cycle is missing: least squares for three harmonics, whose errors are those of the inverse."""
    phase = TIME % 1.0
    mask = (phase > 0.3) & (phase < 0.5)
    scores = []
    for seed in range(20):
        e = recorded(measured(seed)).without(outliers=mask).fold(64, frequency=1.0, harmonics=2)
        error = np.sqrt(e.amplitude_variance["angle"][:3])
        scores.append(np.abs(amplitudes(e)[:3] - EXACT[:3]) ** 2 / error**2)
    # Twenty recordings: three standard errors of the mean square are 0.7 to 1.
    assert np.all(np.mean(scores, axis=0) < 2.0)
    assert np.all(np.mean(scores, axis=0) > 0.3)


@pytest.mark.parametrize("limit", [0.385, 0.39])
def test_a_clipped_sensor_is_named_with_its_limit_and_its_cure_is_right(limit):
    """A fifth of the samples at most. Noise decides at the limit, which biases by less than one standard deviation."""
    angle = np.minimum(measured(), limit)
    run = recorded(angle)
    finding = only(run.check(1.0), "clipped")
    assert finding.count == np.count_nonzero(angle == limit)
    assert finding.severity == "serious"
    assert f"angle is clipped at {limit:.6g}" in str(finding)
    with pytest.warns(UserWarning, match=rf"run: angle is clipped at {limit:.6g}"):
        run.fold(64, frequency=1.0)
    cured = run.without(clipped=True, frequency=1.0)
    # The others at the same phases are left out too.
    assert not np.isin(TIME[angle == limit], cured.time).any()
    assert cured.time.size >= TIME.size - 2 * finding.count
    e = cured.fold(64, frequency=1.0, harmonics=3)
    assert np.abs(amplitudes(e) - EXACT) == pytest.approx(np.zeros(4), abs=0.002)


def test_a_sensor_clipped_for_more_than_a_quarter_of_the_period_has_no_cure():
    finding = only(recorded(np.minimum(measured(), 0.36)).check(1.0), "clipped")
    assert finding.severity == "ruinous"
    assert str(finding).endswith("record again with a larger range")


@pytest.mark.parametrize("turn", [2 * np.pi, 360.0, 1.0])
def test_wraps_are_refused_and_the_cure_gives_the_amplitudes(turn):
    angle = turn * (0.7 + clean()) + 1e-3 * turn * np.random.default_rng(0).standard_normal(TIME.size)
    run = recorded(angle % turn)
    finding = only(run.check(), "wraps")
    assert (finding.severity, finding.count) == ("ruinous", np.count_nonzero(np.diff(angle // turn)))
    with pytest.raises(ValueError, match=r"^recording: must be without wraps, got 'run': angle jumps by .* times") as e:
        run.fold(64)
    assert f"recording.unwrapped('angle', {turn:.6g}) removes the jumps" in str(e.value)
    cured = run.unwrapped("angle", turn)
    assert cured.check().severity == "harmless"
    found = amplitudes(cured.fold(64, frequency=1.0)) / turn
    assert found[0].real % 1.0 in (pytest.approx(0.0, abs=5e-4), pytest.approx(1.0, abs=5e-4))
    assert found[1:] == pytest.approx(EXACT[1:], abs=5e-4)


FAULTS = {
    "stuck": lambda y: np.where((TIME >= 14.0) & (TIME < 15.2), y[700], y),
    "clipped": lambda y: np.minimum(y, 0.36),
    "outliers": lambda y: y + 0.5 * (np.arange(TIME.size) == 777),
    "coarse": lambda y: np.round(y * 16) / 16,
    "drift": lambda y: y + 0.002 * TIME,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_findings_do_not_depend_on_the_unit_of_a_channel(fault):
    """Powers of two only change exponents."""
    angle = FAULTS[fault](measured(noise=0.0005 if fault == "coarse" else 0.002))
    checks = {size: recorded(angle * 2.0**size).check(1.0) for size in (-60, -40, 0, 60)}
    findings = {
        size: [(one.kind, one.severity, one.count, round(one.bias, 6)) for one in check.findings]
        for size, check in checks.items()
    }
    assert fault in [kind for kind, *_ in findings[0]]
    assert findings[-60] == findings[-40] == findings[60] == findings[0]


def test_other_channels_of_cured_recordings_are_unchanged():
    angle = np.r_[measured()]
    force = np.cos(2 * np.pi * TIME)
    run = recorded((2 * np.pi * (0.7 + angle)) % (2 * np.pi), force=force)
    cured = run.unwrapped("angle")
    assert cured.inputs["force"].tolist() == force.tolist()
    assert cured.time.tolist() == TIME.tolist()


def test_steady_returns_the_part_that_fold_uses():
    envelope = np.clip(np.minimum(TIME / 8, (CYCLES - TIME) / 5), 0, 1)
    run = recorded(0.3 + envelope * (measured() - 0.3))
    check, part, e = run.check(1.0), run.steady(1.0), run.fold(64, frequency=1.0)
    assert (part.time[0], part.time[-1]) == (check.start, check.stop)
    assert check.cycles == e.cycles
    assert part.time.size == e.averaged
    assert check.start >= 6.5 and check.stop <= CYCLES - 3.5
    assert {"ramp"} <= {f.kind for f in e.findings} <= {"ramp", "transient"}
    assert_right(part.fold(64, frequency=1.0))


def test_faults_outside_of_the_part_used_are_harmless():
    envelope = np.clip(TIME / 8, 0, 1)
    angle = 0.3 + envelope * (measured() - 0.3)
    angle[20:60] = angle[20]
    check = recorded(angle).check(1.0)
    finding = only(check, "stuck")
    assert (finding.severity, check.severity) == ("harmless", "harmless")
    assert "not used" in str(finding)


def test_outliers_outside_of_the_part_used_are_listed_and_left_out():
    envelope = np.clip(TIME / 8, 0, 1)
    angle, spikes = 0.3 + envelope * (measured() - 0.3), [150, 210, 1500]
    angle[spikes] = 6.283
    run = recorded(angle)
    check = run.check(1.0)
    assert check.start > TIME[210] and check.bad["angle"]["outliers"].tolist() == spikes
    assert only(check, "outliers").count == 3
    assert run.without(outliers=True, frequency=1.0).outputs["angle"].max() < 0.5


def test_lost_samples_step_the_phase_by_their_number():
    """At 50 samples a cycle, one lost sample is 7.2°, or 0.02 s; more of them end the part used."""
    longer = np.arange((CYCLES + 1) * RATE) / RATE
    angle = clean(longer) + 0.001 * np.random.default_rng(0).standard_normal(longer.size)
    finding = only(recorded(np.delete(angle, 1000)[: TIME.size]).check(1.0), "phase step")
    size, delay, samples, at = map(
        float,
        re.search(r"steps by ([\d.-]+)° \(([\d.-]+) s, ([\d.]+) samples\) at about ([\d.]+) s", str(finding)).groups(),
    )
    assert abs(size) == pytest.approx(7.2, abs=0.5)
    assert abs(delay) == pytest.approx(0.02, abs=0.002)
    assert samples == pytest.approx(1.0, abs=0.1)
    assert at == pytest.approx(20.0, abs=1.5)
    assert "samples were lost" in str(finding)
    with pytest.warns(UserWarning, match=r"only the last (1\d|20) of 40 cycles are used"):
        e = recorded(np.delete(angle, np.arange(1000, 1005))[: TIME.size]).fold(64, frequency=1.0)
    assert abs(amplitudes(e)[1]) == pytest.approx(0.1, abs=5e-4)


def test_a_step_of_the_amplitude_is_named_with_its_size_and_time():
    envelope = np.where(TIME < 20, 1.0, 1.06)
    finding = only(recorded(0.3 + envelope * (measured(noise=0.001) - 0.3)).check(1.0), "amplitude step")
    size, at = map(float, re.search(r"steps by \+([\d.]+)% at about ([\d.]+) s", str(finding)).groups())
    assert size == pytest.approx(6.0, abs=0.5)
    assert at == pytest.approx(20.0, abs=1.5)


def test_a_beat_is_named_with_its_frequency_and_size():
    """A second frequency of 1.125 Hz beats with 1 Hz at 0.125 Hz, 4 % of the amplitude."""
    angle = measured(noise=0.001) + 0.004 * np.cos(2 * np.pi * 1.125 * TIME)
    finding = only(recorded(angle).check(1.0), "beating")
    beat, size = map(float, re.search(r"beats at ([\d.]+) Hz by ([\d.]+)%", str(finding)).groups())
    assert beat == pytest.approx(0.125, abs=0.03)
    assert size == pytest.approx(4.0, abs=0.8)


def test_gaps_are_counted():
    keep = np.ones(TIME.size, dtype=bool)
    keep[[500, 501, 502, 503, 900, 901, 902, 903, 904]] = False
    finding = only(recorded(measured()[keep], TIME[keep]).check(1.0), "gaps")
    assert (finding.count, finding.severity) == (9, "harmless")
    assert "9 samples are missing in 2 gaps, the longest of 0.12 s" in str(finding)


def test_jitter_of_the_clock_is_the_standard_deviation_of_its_steps():
    generator = np.random.default_rng(0)
    step = (1.0 + 0.05 * generator.standard_normal(TIME.size)) / RATE
    time = np.cumsum(step)
    check = bp.Recording.from_arrays(time, {"angle": clean(time)}).check(1.0)
    assert check.jitter == pytest.approx(0.05, rel=0.06)
    assert "steps of time vary by 5" in str(check) or "steps of time vary by 4.9%" in str(check)


def test_table_has_range_resolution_and_bits():
    step = 0.4 / 4095
    angle = step * np.round(measured() / step)
    table = recorded(angle).check(1.0).table
    assert table.index.tolist() == ["angle"]
    assert table.lowest["angle"] == angle.min() and table.highest["angle"] == angle.max()
    assert table.resolution["angle"] == pytest.approx(step)
    assert table.bits["angle"] == pytest.approx(np.log2(np.ptp(angle) / step + 1))
    assert (table[["outliers", "stuck", "clipped", "wraps"]] == 0).all(axis=None)


def test_a_check_of_a_sound_recording_says_that_nothing_was_found():
    text = str(recorded(measured()).check(1.0))
    assert text.startswith("Recording 'run': 40 of 40 cycles at 1.00001 Hz are used, 0 to 39.98 s.\n")
    assert text.endswith("\nNothing was found.")
    assert "lowest" in text and "angle" in text


def test_a_check_prints_its_findings_by_severity_the_worst_first():
    angle, _ = dropouts()
    envelope = np.clip(TIME / 6, 0, 1)
    check = recorded(0.3 + envelope * (angle - 0.3)).check(1.0)
    severities = [finding.severity for finding in check.findings]
    assert severities[0] == "ruinous" and severities[-1] == "harmless"
    lines = [line for line in str(check).splitlines() if re.match("harmless|serious|ruinous", line)]
    assert [line.split(":")[0] for line in lines] == severities
    assert all(str(f) in line for f, line in zip(check.findings, lines, strict=True))


def test_a_check_without_a_mean_period_says_why():
    check = recorded(np.linspace(0, 1, TIME.size)).check()
    assert check.reason.startswith("recording: must have at least 3 cycles")
    assert check.cycles == 0 and np.isnan(check.frequency)
    assert "no mean period: recording: must have at least 3 cycles" in str(check)


def test_checks_and_experiments_with_findings_are_saved_and_loaded(tmp_path):
    envelope = np.clip(TIME / 6, 0, 1)
    angle = 0.3 + envelope * (measured() - 0.3)
    angle[1500] += 0.06
    run = recorded(angle)
    check = run.check(1.0)
    check.save(tmp_path / "check.h5")
    assert str(bp.load(tmp_path / "check.h5")) == str(check)
    loaded = bp.load(tmp_path / "check.h5")
    assert loaded.bad["angle"]["outliers"].tolist() == check.bad["angle"]["outliers"].tolist() == [1500]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        e = run.fold(64, frequency=1.0)
    assert {finding.kind for finding in e.findings} == {"ramp", "outliers"}
    e.save(tmp_path / "run.h5")
    again = bp.load(tmp_path / "run.h5")
    assert [str(f) for f in again.findings] == [str(f) for f in e.findings]
    assert [f.times.tolist() for f in again.findings] == [f.times.tolist() for f in e.findings]


def test_fold_refuses_ruinous_findings_and_warns_once_of_serious_ones():
    angle, _ = dropouts()
    with pytest.raises(ValueError, match=r"^recording: must be sound, got 'run', in which angle reads 6\.283 at"):
        recorded(angle).fold(64, frequency=1.0)
    angle = clean() + 0.02 * np.random.default_rng(0).standard_normal(TIME.size)
    angle[777] += 0.5
    with pytest.warns(UserWarning, match=r"^run: angle reads .*recording\.without\(outliers=True") as caught:
        e = recorded(angle).fold(64, frequency=1.0)
    assert len(caught) == 1 and caught[0].filename == __file__
    assert "angle reads" in repr(e)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"outliers": True, "channel": "force"}, "^channel: must be .*'angle'.*got 'force'"),
        ({"outliers": np.ones(3, dtype=bool)}, r"^outliers: must be .* of shape \(2000,\), got bool of shape \(3,\)"),
        ({"stuck": np.zeros(2000)}, r"^stuck: must be .* bool array of shape \(2000,\), got float64"),
        ({"clipped": np.ones(2000, dtype=bool)}, "^recording: must have at least two sound samples"),
    ],
)
def test_wrong_arguments_of_without_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        recorded(measured()).without(**arguments)


def test_a_mask_of_samples_is_left_out():
    mask = np.zeros(TIME.size, dtype=bool)
    mask[[3, 500]] = True
    assert recorded(measured()).without(outliers=mask).time.tolist() == TIME[~mask].tolist()
    assert recorded(measured()).without().time.tolist() == TIME.tolist()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r.check(-1.0), "^frequency: must be .*got -1.0"),
        (lambda r: r.check(periods=0), "^periods: must be .*got 0"),
        (lambda r: r.unwrapped("force"), "^channel: must be .*got 'force'"),
        (lambda r: r.unwrapped("angle", 0.0), "^period: must be .*got 0.0"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(recorded(measured()))


def good(seed):
    """Return a sound recording: driven, subharmonic or autonomous; white or coloured noise, with or without steps."""
    generator = np.random.default_rng([59, seed])
    cycles, per_cycle = np.exp(generator.uniform(np.log(5.2), np.log(120))), generator.uniform(20, 40)
    time = np.arange(int(cycles * per_cycle)) / per_cycle
    angle = 2 * np.pi * time
    y = np.cos(angle + generator.uniform(0, 6)) + generator.uniform(0, 0.4) * np.cos(3 * angle + 1)
    y += generator.uniform(0, 0.2) * np.cos(2 * angle) + generator.uniform(-1, 1)
    kind, periods = generator.integers(3), 1
    if kind == 1 and cycles > 12:
        y, periods = y + generator.uniform(0.1, 0.5) * np.cos(angle / 2 + 1), 2
    noise = [*NOISES.values()][generator.integers(4)]
    y += generator.uniform(0.003, 0.1) * noise(time, generator)
    if generator.integers(2):
        step = np.ptp(y) / 2.0 ** generator.integers(7, 14)
        y = step * np.round(y / step)
    force = np.cos(angle) + 0.003 * generator.standard_normal(time.size)
    return bp.Recording.from_arrays(time, {"y": y}, {} if kind == 2 else {"force": force}), periods


def alarms(seeds):
    """Return the checks with serious findings or without a steady part."""
    checks = [recording.check(periods=periods) for recording, periods in map(good, seeds)]
    return [check for check in checks if check.severity != "harmless" or check.reason]


def test_sound_recordings_have_no_serious_findings():
    """At most 1 % of 40 recordings: more than two have probability 0.008."""
    assert len(alarms(range(40))) <= 2


@pytest.mark.slow
def test_false_alarm_rate_of_serious_findings_is_at_most_one_percent():
    """Of 300 recordings at most 8 (binomial, 99.5 % at 1 %)."""
    assert len(alarms(range(100, 400))) <= stats.binom.ppf(0.995, 300, 0.01)


@pytest.mark.parametrize("levels", [2, 3, 5, 8, 12, 25, 50])
def test_few_levels_with_little_noise_are_named_with_their_effect(levels):
    """The error of the amplitudes, by the mean period of the unrounded motion, is within a factor of four as stated."""
    angle = clean() + 1e-4 * np.random.default_rng(1).standard_normal(TIME.size)
    step = np.ptp(angle) / levels
    rounded = step * np.round(angle / step)
    finding = only(recorded(rounded).check(1.0), "coarse")
    assert finding.severity == "serious" and finding.bias > 0.5 and "repeat in every cycle" in finding.text
    with pytest.warns(UserWarning, match="levels, steps of"):
        found = recorded(rounded).fold(64, frequency=1.0, harmonics=3)
    off = np.abs(amplitudes(found) - amplitudes(recorded(angle).fold(64, frequency=1.0, harmonics=3)))
    stated = np.sqrt(found.amplitude_variance["angle"])
    assert 0.25 < np.sqrt(np.mean((off / stated) ** 2)) < 2.0


@pytest.mark.parametrize("kind", ["outputs", "inputs"])
def test_two_levels_are_named_if_noise_moves_their_changes_and_square_waves_are_not(kind):
    noise = 0.005 * np.random.default_rng(1).standard_normal(TIME.size)
    other = measured(noise=1e-3)
    for named, moved in ((True, noise), (False, 0.0)):
        switch = np.where(clean() + moved > 0.31, 1.0, 0.0)
        channels = ({"y": switch}, {"x": other}) if kind == "outputs" else ({"y": other}, {"x": switch})
        findings = [f for f in bp.Recording.from_arrays(TIME, *channels).check(1.0).findings if f.kind == "coarse"]
        assert len(findings) == named
    noisy = recorded(np.where(clean() + noise > 0.31, 1.0, 0.0))
    finding = only(noisy.check(1.0), "coarse")
    assert finding.severity == "serious" and "has only two levels, 1 apart" in finding.text
    assert "noise='measured'" in finding.cure and "as those of a switch" in finding.cure


@pytest.mark.parametrize(("levels", "noise"), [(12, 0.5), (400, 0.001)])
def test_levels_with_enough_noise_or_in_large_number_are_not_named(levels, noise):
    angle = clean()
    step = np.ptp(angle) / levels
    angle = angle + noise * step * np.random.default_rng(1).standard_normal(TIME.size)
    assert not recorded(step * np.round(angle / step)).check(1.0).findings
